use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::bail;
use cli::{Column, Table, shown};
use report::{Curve, curves_svg};
use serde_json::json;
use zoo::entry::Entry;
use zoo::write_atomic;

use crate::places::{ZooArgs, entry_names};

/// Show training losses of entries as a table or a chart
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo curves lift-act
  actrm-zoo curves 'lift-act-s*' --svg curves.svg
  actrm-zoo curves lift-act-s1 lift-act-s2 --json")]
pub struct Args {
    /// Entries: `name` (its newest version), `name@version`, or a pattern with `*`
    #[arg(required = true, add = entry_names())]
    entries: Vec<String>,
    /// Write a chart to this SVG file
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Print every point as JSON
    #[arg(long, conflicts_with = "svg")]
    json: bool,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let registry = args.zoo.registry();
    let mut entries = Vec::new();
    for text in &args.entries {
        for id in registry.matching(text)? {
            entries.push(Entry::open(registry.folder(), &id)?);
        }
    }
    let trained = |entry: &&Entry| entry.meta().training.as_ref().is_some_and(|training| !training.curve.is_empty());
    let Some(_) = entries.iter().find(trained) else {
        bail!("{}: no curve: these entries were not trained here", args.entries.join(", "));
    };
    if args.json {
        let one = |entry: &Entry| {
            let training = entry.meta().training.as_ref()?;
            Some(json!({"entry": entry.id().to_string(), "seed": training.seed, "curve": training.curve}))
        };
        cli::print_json(&entries.iter().filter_map(one).collect::<Vec<_>>())?;
        return Ok(ExitCode::SUCCESS);
    }
    if let Some(path) = &args.svg {
        let curve = |entry: &Entry| {
            let points = entry.meta().training.as_ref()?.curve.iter().map(|p| (p.step, p.loss)).collect();
            Some(Curve { entry: entry.id().to_string(), points })
        };
        let curves: Vec<Curve> = entries.iter().filter_map(curve).collect();
        let _parents = cli::new_file(path)?;
        write_atomic(path, curves_svg(&curves).as_bytes())?;
        cli::print(&(shown(path) + "\n"))?;
        return Ok(ExitCode::SUCCESS);
    }
    let mut table = Table::new(vec![
        Column::new("entry"),
        Column::new("seed").right().dispensable(2),
        Column::new("steps").right().dispensable(3),
        Column::new("first loss").right(),
        Column::new("last loss").right(),
        Column::new("valid").right(),
        Column::new("curve (logarithmic)").dispensable(1),
    ]);
    for entry in &entries {
        let Some(training) = &entry.meta().training else { continue };
        let losses: Vec<f64> = training.curve.iter().map(|point| point.loss).collect();
        let number = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.5}"));
        table.push(vec![
            entry.id().to_string(),
            training.seed.to_string(),
            training.steps.to_string(),
            number(losses.first().copied()),
            number(losses.last().copied()),
            number(training.curve.iter().rev().find_map(|point| point.valid_loss)),
            blocks(&losses, 32),
        ]);
    }
    cli::print(&table.text(false))?;
    Ok(ExitCode::SUCCESS)
}

/// A curve as a line of at most `width` blocks, each the mean of its stretch on a logarithmic scale.
fn blocks(losses: &[f64], width: usize) -> String {
    const BLOCKS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
    let logs: Vec<f64> = losses.iter().filter(|loss| loss.is_finite() && **loss > 0.0).map(|loss| loss.ln()).collect();
    let stretch = logs.len().div_ceil(width).max(1);
    let means: Vec<f64> = logs.chunks(stretch).map(|part| part.iter().sum::<f64>() / part.len() as f64).collect();
    let low = means.iter().copied().fold(f64::INFINITY, f64::min);
    let high = means.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let block = |mean: &f64| {
        let share = if high > low { (mean - low) / (high - low) } else { 0.0 };
        BLOCKS[((share * 7.0).round() as usize).min(7)]
    };
    means.iter().map(block).collect()
}

#[cfg(test)]
mod tests {
    use super::blocks;

    #[test]
    fn a_falling_curve_falls() {
        let losses: Vec<f64> = (0..64).map(|step| (-f64::from(step) / 8.0).exp()).collect();
        let line: Vec<char> = blocks(&losses, 8).chars().collect();
        assert_eq!(line, ['█', '▇', '▆', '▅', '▄', '▃', '▂', '▁']);
        assert_eq!(blocks(&[f64::NAN, 0.0], 8), "");
        assert_eq!(blocks(&[1.0, 1.0], 8), "▁▁");
    }
}
