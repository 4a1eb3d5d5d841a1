use std::path::PathBuf;
use std::process::ExitCode;

use zoo::run::{Score, ScoreRequest, score, score_folder};

use crate::places::{ZooArgs, entry_names};

/// Score an entry on demonstrations, without a simulator: the error of its actions
///
/// The policy is asked at the steps of episodes that it was not trained on. Its chunks are compared with the actions that follow
/// there: mean absolute error for each dimension and each step of the chunk, in the units of the data. The conventions of entry
/// and data set have to agree. A small error is no success rate: compare it between entries on the same data only.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo score lift-act --data data/lift.hdf5
  actrm-zoo score my-act --data recorded --mask test --json")]
pub struct Args {
    /// Entry: `name` (its newest version) or `name@version`
    #[arg(add = entry_names())]
    entry: String,
    /// Demonstrations: an HDF5 file or a data set
    #[arg(long, value_name = "PATH")]
    data: PathBuf,
    /// Mask or split of the episodes [default: that of the entry's validation, where the data set has it; else all episodes]
    #[arg(long, value_name = "NAME")]
    mask: Option<String>,
    /// Queries at most, evenly spread over the episodes
    #[arg(long, value_name = "N", default_value_t = 2000, value_parser = clap::value_parser!(u64).range(1..=10_000_000))]
    queries: u64,
    /// Score even if the demonstrations are of another task or their dimensions have other names
    #[arg(long)]
    force: bool,
    /// Folder that an HDF5 file is converted into
    #[arg(long, value_name = "DIR", default_value = "out/score")]
    work: PathBuf,
    /// Print JSON instead of tables
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let loaded = args.zoo.registry().locate(&args.entry)?.load()?;
    let work = score_folder(&args.work.join(loaded.entry().id().to_string()), &args.data)?;
    let found = score(&ScoreRequest {
        entry: &loaded,
        data: &args.data,
        work: &work,
        mask: args.mask.as_deref(),
        most: usize::try_from(args.queries)?,
        force: args.force,
    })?;
    found.notes.iter().for_each(|note| cli::note(&format!("note: {note}")));
    match args.json {
        true => cli::print_json(&found)?,
        false => cli::print(&text(&found))?,
    }
    Ok(ExitCode::SUCCESS)
}

/// A table of the dimensions, and one of the steps.
fn text(score: &Score) -> String {
    let mask = score.mask.as_ref().map_or(String::new(), |mask| format!(" of mask {mask}"));
    let mut text = format!(
        "{} on {}: {} queries in {} episodes{mask}\nmean absolute error {:.5}\n\n",
        score.entry, score.data, score.queries, score.episodes, score.mean
    );
    let number = |x: f64| format!("{x:.5}");
    let (first, last) = (score.errors.first(), score.errors.last());
    let dims = score.names.iter().zip(score.of_dimensions()).enumerate().map(|(dim, (name, error))| {
        let at = |row: Option<&Vec<f64>>| row.map_or_else(String::new, |row| number(row[dim]));
        vec![name.clone(), number(error), at(first), at(last)]
    });
    text += &cli::table(&["dimension", "all steps", "first step", "last step"], &dims.collect::<Vec<_>>(), &[1, 2, 3]);
    let steps = score.of_steps().into_iter().zip(&score.counts).enumerate();
    let steps = steps.map(|(step, (error, count))| vec![step.to_string(), number(error), count.to_string()]);
    text + "\n" + &cli::table(&["step", "all dimensions", "actions"], &steps.collect::<Vec<_>>(), &[0, 1, 2])
}
