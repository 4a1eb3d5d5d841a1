use super::inspect;
use crate::view::{BEGINNING, Head, Opened, Page};
use anyhow::{Result, bail};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Make one HTML page of a data set or a file of demonstrations, which needs no network.
///
/// The page has a summary, the features with their ranges, problems, histograms of lengths and actions, and every episode with
/// its length, return and success. An episode that is opened shows images of its cameras and the curves of its actions and
/// observations. Curves of long episodes are thinned. Episodes that would make the page larger than --limit are listed without
/// curves and images. The page says where that is so.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data view lift
  actrm-data view data/lift.hdf5 --out lift.html
  actrm-data view lift_image --frames 8 --limit 100M
  actrm-data view lift --column action --column observation.state")]
pub struct Args {
    /// Data set directory, HDF5 file, or folder with one file an episode
    set: PathBuf,
    /// File to create; a page that this command made is replaced, another file is not
    #[arg(long, short, default_value = "view.html")]
    out: PathBuf,
    /// Images of each camera in an episode, evenly spread; 0 for none
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u16).range(..=1000))]
    frames: u16,
    /// Largest number of points of a curve
    #[arg(long, value_name = "N", default_value_t = 400, value_parser = clap::value_parser!(u32).range(2..))]
    points: u32,
    /// Column to draw, by name; may be repeated [default: actions, observations and rewards of up to 64 dimensions]
    #[arg(long, value_name = "NAME")]
    column: Vec<String>,
    /// Size of the page beyond which episodes are only listed
    #[arg(long, value_name = "SIZE", default_value = "32M", value_parser = cli::limits::bytes)]
    limit: u64,
    /// Do not check every value and image, which is faster but finds fewer problems
    #[arg(long)]
    quick: bool,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    replaces(&args.out)?;
    let opened = Opened::open(&args.set)?;
    let mut columns = opened.columns();
    let there: Vec<String> = columns.iter().map(|column| column.name.clone()).collect();
    if let Some(name) = args.column.iter().find(|name| !there.contains(name)) {
        bail!("{}: no column {name}; there is {}", args.set.display(), there.join(", "));
    }
    let usual = Opened::usual(&columns);
    let wanted = if args.column.is_empty() { &usual } else { &args.column };
    columns.retain(|column| wanted.contains(&column.name));
    let cameras = if args.frames == 0 { Vec::new() } else { opened.cameras() };
    let mut head = head(args, &opened)?;
    let limit = usize::try_from(args.limit).unwrap_or(usize::MAX);
    let mut screen = cli::Screen::new();
    let mut page = Page::new(columns, cameras.clone(), args.points as usize, limit);
    screen.begin("reading episodes", opened.episodes() as u64);
    for index in 0..opened.episodes() {
        let episode = opened.episode(index, page.columns());
        let count = usize::from(args.frames).min(episode.length);
        let frames: Vec<usize> = (0..count).map(|i| i * (episode.length - 1) / (count - 1).max(1)).collect();
        let mut pictures = Vec::with_capacity(cameras.len());
        for camera in cameras.iter().filter(|_| page.has_room()) {
            // one that cannot be read does not keep the others from being seen
            match opened.pictures(camera, index, &frames) {
                Ok(found) => pictures.push(found.iter().map(|p| p.to_png()).collect::<Result<Vec<_>, _>>()?),
                Err(error) => {
                    head.problems.push(format!("episode {index}, {camera}: {error}"));
                    pictures.push(Vec::new());
                }
            }
        }
        head.problems
            .extend(episode.problems.iter().filter(|p| !head.problems.contains(p)).cloned().collect::<Vec<_>>());
        page.push(&episode, &frames, &pictures);
        screen.step();
    }
    screen.clear();
    let html = page.html(&head);
    // once more: the work takes a while
    let replaced = if replaces(&args.out)? { "; replaced an earlier page" } else { "" };
    super::plot::write(&args.out, html.as_bytes())?;
    let size = cli::bytes(html.len() as u64);
    let episodes = cli::count(opened.episodes());
    cli::print(&format!("{}: {episodes} episodes, {size}{replaced}\n", args.out.display()))?;
    Ok(ExitCode::SUCCESS)
}

/// Whether a page of this command is there, which the new one replaces. Another file is refused.
fn replaces(out: &Path) -> Result<bool> {
    if !out.exists() {
        return Ok(false);
    }
    if !is_page(out) {
        bail!(
            "{}: exists already and is no page of this command; choose another path or remove it first",
            out.display()
        );
    }
    Ok(true)
}

/// Whether a file is a page that this command made.
fn is_page(path: &Path) -> bool {
    let mut beginning = Vec::new();
    let read = File::open(path).and_then(|file| file.take(BEGINNING.len() as u64).read_to_end(&mut beginning));
    read.is_ok() && beginning == BEGINNING.as_bytes()
}

/// What `inspect` says, and what `validate` finds.
fn head(args: &Args, opened: &Opened) -> Result<Head> {
    let summary = inspect::summary(&args.set)?;
    let mut facts = vec![
        ("layout".to_owned(), summary.layout.clone()),
        ("size".to_owned(), cli::bytes(summary.bytes)),
        ("episodes".to_owned(), cli::count(summary.demos)),
        (
            "frames".to_owned(),
            format!(
                "{} (shortest episode {}, mean {:.1}, longest {})",
                cli::count(summary.frames),
                summary.length_min,
                summary.length_mean,
                summary.length_max
            ),
        ),
    ];
    facts.extend(opened.fps().map(|fps| ("frames a second".to_owned(), cli::number(fps))));
    facts.extend(summary.env_name.iter().map(|name| {
        let version = summary.env_version.as_ref().map_or_else(String::new, |version| format!(", version {version}"));
        ("environment".to_owned(), format!("{name}{version}"))
    }));
    if !summary.tasks.is_empty() {
        facts.push(("tasks".to_owned(), summary.tasks.join("; ")));
    }
    if !summary.masks.is_empty() {
        let masks: Vec<String> = summary.masks.iter().map(|(name, n)| format!("{name} {n}")).collect();
        facts.push(("masks".to_owned(), masks.join(", ")));
    }
    let mut problems = summary.problems.clone();
    if let (false, Opened::Set(..)) = (args.quick, opened) {
        let mut screen = cli::Screen::new();
        for check in dataset::verify(&args.set, &mut screen.advance("checking"))? {
            problems.extend(check.problem.map(|problem| format!("{}: {problem}", check.name)));
        }
    }
    let name = args.set.file_name().map_or_else(|| "data set".to_owned(), |name| name.to_string_lossy().into_owned());
    let features = summary.features();
    Ok(Head { title: name, facts, features, notes: summary.notes, problems })
}
