use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, bail};
use cli::shown;
use zoo::results::merge_shards;

use crate::places::{ResultsArgs, ZooArgs};

/// Between an evaluation's name and the number of its shard.
const MARK: &str = "_shard-";

/// Merge the shards of an evaluation that several machines ran
///
/// Shards that differ in entry, protocol, seeds or versions are refused.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo eval lift-act --episodes 200 --shard 1/2
  actrm-zoo eval lift-act --episodes 200 --shard 2/2
  actrm-zoo merge
  actrm-zoo merge zoo/results/*_shard-*")]
pub struct Args {
    /// Result folders of all shards of one evaluation [default: every evaluation with shards in the results folder]
    #[arg(value_name = "FOLDER")]
    shards: Vec<PathBuf>,
    #[command(flatten)]
    results: ResultsArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let results = args.results.folder(&args.zoo);
    let mut groups: BTreeMap<String, Vec<PathBuf>> = BTreeMap::new();
    match args.shards.is_empty() {
        true => {
            for folder in shard_folders(&results)? {
                groups.entry(group(&folder)).or_default().push(folder);
            }
        }
        false => {
            groups.insert(String::new(), args.shards.clone());
        }
    }
    if groups.is_empty() {
        bail!("no shards in {}", shown(&results));
    }
    // one that lacks a shard does not keep the others from being merged
    let mut failures: Vec<anyhow::Error> = Vec::new();
    for (name, shards) in &groups {
        match merge_shards(shards, &results).map_err(anyhow::Error::from) {
            Ok(whole) => {
                let (won, all) = (whole.successes(), whole.episodes.len());
                cli::print(&format!("{won} of {all} episodes succeeded ({})\n", shown(&whole.folder)))?;
            }
            Err(error) if name.is_empty() => return Err(error),
            Err(error) => failures.push(error.context(name.clone())),
        }
    }
    for failure in &failures {
        cli::note(&format!("error: {failure:#}"));
    }
    Ok(if failures.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn shard_folders(results: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let mut folders = Vec::new();
    for item in results.read_dir().with_context(|| format!("cannot read folder {}", shown(results)))? {
        let path = item?.path();
        let marked = path.file_name().is_some_and(|name| name.to_string_lossy().contains(MARK));
        if marked && path.is_dir() {
            folders.push(path);
        }
    }
    folders.sort();
    Ok(folders)
}

/// What the folders of one evaluation's shards have in common.
fn group(folder: &Path) -> String {
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    name.split(MARK).next().unwrap_or_default().to_owned()
}
