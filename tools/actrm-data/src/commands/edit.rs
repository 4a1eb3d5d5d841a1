use crate::work::Work;
use anyhow::Result;
use dataset::edit::{self, Destination, EditReport, Parts, Renames, Selection};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Make a data set of data sets: leave episodes out, split, merge, rename features, repair tables.
///
/// Works on LeRobotDataset v3.0 directories, ours or LeRobot's. Images and videos are carried over as they are stored;
/// numbers, tasks, masks, statistics, fingerprint and the side folder follow from the episodes that the result has, as if it
/// had been converted. Columns that other programs added to meta/episodes go with their episodes. Sources are never touched,
/// and a result appears whole or not at all. Of a video file of which some episodes are left out, those of the others are cut
/// out without encoding them again: AV1 can be cut, H.264 is refused.
#[derive(clap::Args)]
#[command(
    subcommand_required = true,
    arg_required_else_help = true,
    after_help = "Examples:
  actrm-data edit drop lift lift_good --episodes 3,7-9
  actrm-data edit keep lift lift_train --mask train
  actrm-data edit split lift parts --fractions train=0.8,valid=0.2
  actrm-data edit merge lift more_lift --out all
  actrm-data edit rename lift lift_front --feature observation.images.agentview=observation.images.front
  actrm-data edit repair recorded recorded_fixed"
)]
pub struct Args {
    #[command(subcommand)]
    operation: Operation,
}

#[derive(clap::Subcommand)]
enum Operation {
    /// Leave episodes out
    #[command(after_help = "Examples:
  actrm-data edit drop lift lift_good --episodes 3,7-9
  actrm-data edit drop lift --in-place --demos demo_12")]
    Drop(Chosen),
    /// Keep some episodes only
    #[command(after_help = "Examples:
  actrm-data edit keep lift lift_train --mask train
  actrm-data edit keep lift lift_10 --episodes 0-9")]
    Keep(Chosen),
    /// Make several sets of one, each a folder of its name in OUT
    #[command(after_help = "Examples:
  actrm-data edit split lift parts --fractions train=0.8,valid=0.2
  actrm-data edit split lift parts --counts small=10,large=50 --seed 1
  actrm-data edit split lift parts --masks train,valid")]
    Split(Split),
    /// Make one set of several with the same features, one after the other
    ///
    /// Tasks become one table and masks are joined: the episodes of a set without a mask are not in it, and a note says so. Demos
    /// whose ids two sets have get new numbers. Where env_args are the same, `actrm-data export` of the result gives one HDF5
    /// file; what else the files have of their own beside the demos (such as dates) is left out of it, and named.
    #[command(after_help = "Examples:
  actrm-data edit merge lift more_lift --out all")]
    Merge(Merge),
    /// Give features other names
    #[command(after_help = "Examples:
  actrm-data edit rename lift lift_front --feature observation.images.agentview=observation.images.front
  actrm-data edit rename lift --in-place --feature next.reward=reward")]
    Rename(Rename),
    /// Correct what follows from the frames: indices, tasks, episodes, statistics, totals, splits
    ///
    /// Frames stay as they are. What `actrm-data validate` finds wrong is corrected and printed; a set in which nothing is to be
    /// corrected is left alone, and nothing is written. The exit code is 1 when something is wrong that does not follow from the
    /// frames.
    #[command(after_help = "Examples:
  actrm-data edit repair recorded recorded_fixed
  actrm-data edit repair recorded --in-place
  actrm-data edit repair recorded --in-place --timestamps")]
    Repair(Repair),
}

#[derive(clap::Args)]
struct Repair {
    #[command(flatten)]
    sets: OneSet,
    /// Also rewrite timestamps that are not frame_index / fps. Times of a real clock are lost
    #[arg(long)]
    timestamps: bool,
}

#[derive(clap::Args)]
struct OneSet {
    /// Data set directory
    set: PathBuf,
    /// Directory to create
    #[arg(required_unless_present = "in_place", conflicts_with = "in_place")]
    out: Option<PathBuf>,
    /// Put the result in the place of SET, at once and only when it is complete. What lies in SET beside the data set
    /// (README.md, .git) stays
    #[arg(long)]
    in_place: bool,
    /// Report as JSON
    #[arg(long)]
    json: bool,
}

#[derive(clap::Args)]
struct Chosen {
    #[command(flatten)]
    sets: OneSet,
    #[command(flatten)]
    which: Which,
}

#[derive(clap::Args)]
#[group(required = true, multiple = true)]
struct Which {
    /// Episodes by number, from 0: 3,7-9
    #[arg(long, value_delimiter = ',', value_name = "NUMBERS", value_parser = numbers)]
    episodes: Vec<std::ops::RangeInclusive<usize>>,
    /// Episodes by the id of the demo that they were: demo_3,demo_12
    #[arg(long, value_delimiter = ',', value_name = "IDS")]
    demos: Vec<String>,
    /// Episodes of a mask. May be given again
    #[arg(long, value_name = "NAME")]
    mask: Vec<String>,
}

#[derive(clap::Args)]
struct Split {
    /// Data set directory
    set: PathBuf,
    /// Directory to create
    out: PathBuf,
    #[command(flatten)]
    parts: By,
    /// Draw the episodes of each part with this seed [default: the first ones go into the first part]
    #[arg(long, conflicts_with = "masks")]
    seed: Option<u64>,
    /// Report as JSON
    #[arg(long)]
    json: bool,
}

#[derive(clap::Args)]
#[group(required = true, multiple = false)]
struct By {
    /// Shares of the episodes, together 1 at most
    #[arg(long, value_delimiter = ',', value_name = "NAME=SHARE", value_parser = pair::<f64>)]
    fractions: Vec<(String, f64)>,
    /// Numbers of episodes
    #[arg(long, value_delimiter = ',', value_name = "NAME=N", value_parser = pair::<usize>)]
    counts: Vec<(String, usize)>,
    /// A part for each of these masks
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    masks: Vec<String>,
}

#[derive(clap::Args)]
struct Merge {
    /// Data set directories
    #[arg(required = true, num_args = 2..)]
    sets: Vec<PathBuf>,
    /// Directory to create
    #[arg(long)]
    out: PathBuf,
    /// Report as JSON
    #[arg(long)]
    json: bool,
}

#[derive(clap::Args)]
struct Rename {
    #[command(flatten)]
    sets: OneSet,
    /// A feature's name and its new one. May be given again
    #[arg(long = "feature", required = true, value_name = "OLD=NEW", value_parser = pair::<String>)]
    features: Vec<(String, String)>,
}

/// More than any data set has.
const MOST_EPISODES: usize = 100_000_000;

/// `7` or `7-9`
fn numbers(text: &str) -> Result<std::ops::RangeInclusive<usize>, String> {
    let (from, to) = text.split_once('-').unwrap_or((text, text));
    match (from.trim().parse(), to.trim().parse()) {
        (Ok(from), Ok(to)) if from <= to && to - from < MOST_EPISODES => Ok(from..=to),
        _ => Err("expected a number or a range such as 7-9".to_owned()),
    }
}

/// `name=value`
fn pair<T: std::str::FromStr>(text: &str) -> Result<(String, T), String> {
    let (name, value) = text.split_once('=').ok_or("expected NAME=VALUE")?;
    let value = value.trim().parse().ok().ok_or_else(|| format!("{name}: `{value}` is not of that kind"))?;
    Ok((name.trim().to_owned(), value))
}

impl Operation {
    /// Where the result is.
    fn out(&self) -> &Path {
        match self {
            Self::Drop(Chosen { sets, .. }) | Self::Keep(Chosen { sets, .. }) => sets.result(),
            Self::Rename(Rename { sets, .. }) | Self::Repair(Repair { sets, .. }) => sets.result(),
            Self::Split(split) => &split.out,
            Self::Merge(merge) => &merge.out,
        }
    }
}

impl OneSet {
    fn destination(&self) -> Destination {
        self.out.clone().map_or(Destination::InPlace, Destination::New)
    }

    /// Where the result is.
    fn result(&self) -> &Path {
        self.out.as_deref().unwrap_or(&self.set)
    }
}

impl Which {
    fn selection(&self) -> Selection {
        Selection {
            episodes: self.episodes.iter().cloned().flatten().collect(),
            demos: self.demos.clone(),
            masks: self.mask.clone(),
        }
    }
}

impl By {
    fn parts(&self) -> Parts {
        match (self.fractions.is_empty(), self.counts.is_empty()) {
            (false, _) => Parts::Fractions(self.fractions.clone()),
            (_, false) => Parts::Counts(self.counts.clone()),
            _ => Parts::Masks(self.masks.clone()),
        }
    }
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let work = Work::begin(args.operation.out())?;
    let mut screen = cli::Screen::new();
    let mut copied = screen.advance("copying");
    let mut advance = |done, total| {
        copied(done, total);
        work.goes_on()
    };
    let (made, json) = match &args.operation {
        Operation::Drop(Chosen { sets, which }) => {
            let report = edit::without(&sets.set, &sets.destination(), &which.selection(), &mut advance)?;
            (vec![(sets.result().to_path_buf(), report)], sets.json)
        }
        Operation::Keep(Chosen { sets, which }) => {
            let report = edit::keep(&sets.set, &sets.destination(), &which.selection(), &mut advance)?;
            (vec![(sets.result().to_path_buf(), report)], sets.json)
        }
        Operation::Split(split) => {
            let made = edit::split(&split.set, &split.out, &split.parts.parts(), split.seed, &mut advance)?;
            (made.into_iter().map(|(name, report)| (split.out.join(name), report)).collect(), split.json)
        }
        Operation::Merge(merge) => {
            let report = edit::merge(&merge.sets, &merge.out, &mut advance)?;
            (vec![(merge.out.clone(), report)], merge.json)
        }
        Operation::Rename(Rename { sets, features }) => {
            let renames: Renames = super::convert::once("--feature", features)?;
            let report = edit::rename(&sets.set, &sets.destination(), &renames, &mut advance)?;
            (vec![(sets.result().to_path_buf(), report)], sets.json)
        }
        Operation::Repair(Repair { sets, timestamps }) => {
            let what = edit::Repair { timestamps: *timestamps };
            let report = edit::repair(&sets.set, &sets.destination(), what, &mut advance)?;
            drop(copied);
            screen.clear();
            return tell_repair(sets, report);
        }
    };
    drop(copied);
    screen.clear();
    tell(&made, json)?;
    Ok(ExitCode::SUCCESS)
}

fn tell_repair(sets: &OneSet, report: edit::RepairReport) -> Result<ExitCode> {
    let code = if report.left.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE };
    if sets.json {
        let made = report.made.as_ref();
        made.iter().flat_map(|made| &made.notes).for_each(|note| cli::note(&format!("note: {note}")));
        cli::print_json(&json!({
            "out": made.map(|_| cli::lossy(sets.result())), "corrected": report.corrected, "left": report.left,
            "fingerprint": made.map(|made| &made.fingerprint), "notes": made.map(|made| &made.notes),
        }))?;
        return Ok(code);
    }
    let mut text = String::new();
    report.corrected.iter().for_each(|line| text.push_str(&format!("corrected  {line}\n")));
    report.left.iter().for_each(|line| text.push_str(&format!("left       {line}\n")));
    if report.made.is_none() {
        text.push_str(&format!("{}: nothing to repair; nothing was written\n", sets.set.display()));
    }
    cli::print(&text)?;
    if let Some(made) = report.made {
        tell(&[(sets.result().to_path_buf(), made)], false)?;
    }
    Ok(code)
}

fn tell(made: &[(PathBuf, EditReport)], json: bool) -> Result<()> {
    for (path, report) in made {
        report.notes.iter().for_each(|note| cli::note(&format!("note: {}: {note}", path.display())));
    }
    if json {
        let each: Vec<Value> = made
            .iter()
            .map(|(path, r)| {
                json!({
                    "out": cli::lossy(path), "episodes": r.episodes, "frames": r.frames, "tasks": r.tasks,
                    "files": r.files, "bytes": r.bytes, "fingerprint": r.fingerprint, "notes": r.notes,
                })
            })
            .collect();
        return cli::print_json(&each);
    }
    let line = |(path, r): &(PathBuf, EditReport)| {
        let (episodes, frames) = (cli::count(r.episodes), cli::count(r.frames));
        format!(
            "{}: {episodes} episodes, {frames} frames, {} files, {}\n",
            path.display(),
            r.files,
            cli::bytes(r.bytes)
        )
    };
    cli::print(&made.iter().map(line).collect::<String>())
}
