use anyhow::{Result, bail};
use dataset::{Dataset, FeatureStats};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::ExitCode;

/// Show a data set's statistics, dimension by dimension.
///
/// Statistics of the whole set are read from its files. Statistics of a split or of single episodes are computed, without
/// those of images, depth and index columns.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data stats lift
  actrm-data stats lift --split train --feature action
  actrm-data stats lift --episodes 0,1,2 --json")]
pub struct Args {
    /// Data set directory
    dir: PathBuf,
    /// Only the episodes of this mask
    #[arg(long, conflicts_with = "episodes")]
    split: Option<String>,
    /// Only these episodes
    #[arg(long, value_delimiter = ',', value_name = "NUMBERS")]
    episodes: Option<Vec<usize>>,
    /// Only features whose name contains this
    #[arg(long, value_name = "TEXT")]
    feature: Option<String>,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let set = Dataset::open(&args.dir)?;
    let mut stats = match (&args.split, &args.episodes) {
        (Some(split), _) => set.exact_statistics_of(&set.required_split(split)?)?,
        (None, Some(episodes)) => set.exact_statistics_of(episodes)?,
        (None, None) => set.stats().clone(),
    };
    let left_out: Vec<&str> =
        set.stats().keys().map(String::as_str).filter(|name| !stats.contains_key(*name)).collect();
    if !left_out.is_empty() {
        cli::note(&format!("note: not computed, and left out: {}", left_out.join(", ")));
    }
    if let Some(text) = &args.feature {
        stats.retain(|name, _| name.contains(text.as_str()));
        if stats.is_empty() {
            bail!("{}: no feature with {text:?} in its name", args.dir.display());
        }
    }
    if args.json {
        cli::print_json(&stats)?;
    } else {
        cli::print(&show(&set, &stats))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn show(set: &Dataset, stats: &BTreeMap<String, FeatureStats>) -> String {
    let mut rows = Vec::new();
    for (name, s) in stats {
        let names = set.names(name);
        for d in 0..s.mean.len() {
            let dimension = match names.get(d) {
                Some(text) if s.mean.len() > 1 => text.clone(),
                _ => d.to_string(),
            };
            let mut row = vec![if d == 0 { name.clone() } else { String::new() }, dimension];
            let values = [&s.mean, &s.std, &s.min, &s.q01, &s.q50, &s.q99, &s.max];
            row.extend(values.map(|v| v.get(d).map_or_else(|| "-".to_owned(), |&v| cli::number(v))));
            rows.push(row);
        }
    }
    let header = ["feature", "dimension", "mean", "std", "min", "1%", "50%", "99%", "max"];
    cli::table(&header, &rows, &[2, 3, 4, 5, 6, 7, 8])
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    #[test]
    fn dimensions_have_the_names_of_numbers_alone() {
        let fixture =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../../crates/dataset/tests/fixtures/lerobot_video_av1");
        let set = Dataset::open(&fixture).expect("a data set");
        let text = show(&set, set.stats());
        assert!(text.contains("agentview") && !text.contains("height") && !text.contains("channels"), "{text}");
    }
}
