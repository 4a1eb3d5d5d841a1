use anyhow::{Result, bail};
use dataset::{Check, NonFinite, Source};
use serde_json::json;
use std::path::PathBuf;
use std::process::ExitCode;

/// Make every check of a data set or of a file of demonstrations.
///
/// A data set: hashes of its files, agreement of columns, episodes, tasks, totals and timestamps with its frames, finite
/// numbers, statistics, splits, images, and the fingerprint of its content. With --source also whether the file that it was
/// converted from is still the same, down to the last bit. `actrm-data edit repair` corrects what follows from the frames. A
/// file: its structure, and every value of every demo. The exit code is 1 when
/// anything is wrong.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data validate lift
  actrm-data validate lift --source data/lift.hdf5
  actrm-data validate data/lift.hdf5
  actrm-data validate lift --json")]
pub struct Args {
    /// Data set directory, HDF5 file, or folder with one file an episode
    path: PathBuf,
    /// File or folder that the data set was converted from: compare it with the hash recorded then
    #[arg(long, value_name = "FILE")]
    source: Option<PathBuf>,
    /// Seconds that timestamps of a data set may be off, as LeRobot's tolerance_s [default: 0.0001]
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    tolerance: Option<f64>,
    /// As JSON
    #[arg(long)]
    json: bool,
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if v.is_finite() && v >= 0.0 => Ok(v),
        _ => Err("expected a number, 0 or more".to_owned()),
    }
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let mut notes = Vec::new();
    let checks = if args.path.join("meta/info.json").exists() {
        let mut screen = cli::Screen::new();
        let tolerance = args.tolerance.unwrap_or(dataset::TIME_TOLERANCE);
        let checks = dataset::verify_within(&args.path, tolerance, &mut screen.advance("checking"));
        screen.clear();
        let mut checks = checks?;
        // where they cannot be had, a check says why
        notes = dataset::notes(&args.path).unwrap_or_default();
        if let Some(source) = &args.source {
            checks.push(dataset::verify_source(&args.path, source)?);
        }
        checks
    } else if let Some(option) = args.source.as_ref().map(|_| "--source").or(args.tolerance.map(|_| "--tolerance")) {
        bail!("{}: {option} belongs to a data set directory, expected meta/info.json in it", args.path.display());
    } else {
        check_source(args, &mut notes)?
    };
    let problems = checks.iter().filter(|c| c.problem.is_some()).count();
    if args.json {
        let list: Vec<_> = checks
            .iter()
            .map(|c| json!({"check": c.name, "ok": c.problem.is_none(), "problem": c.problem, "notes": c.notes}))
            .collect();
        cli::print_json(&json!({"path": cli::lossy(&args.path), "ok": problems == 0, "checks": list, "notes": notes}))?;
    } else {
        let mut text = String::new();
        for check in &checks {
            match &check.problem {
                None => text.push_str(&format!("ok      {}\n", check.name)),
                Some(problem) => {
                    let problem = problem.replace('\n', "\n        ");
                    text.push_str(&format!("WRONG   {}: {problem}\n", check.name));
                }
            }
            check.notes.iter().for_each(|note| text.push_str(&format!("note    {note}\n")));
        }
        for note in &notes {
            text.push_str(&format!("note    {note}\n"));
        }
        cli::print(&text)?;
    }
    Ok(if problems == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Bytes of a large dataset that are read at once.
const BLOCK_BYTES: u64 = 8 << 20;

fn check_source(args: &Args, notes: &mut Vec<String>) -> Result<Vec<Check>> {
    let source = Source::open_guarded(&args.path)?.nonfinite(NonFinite::Keep);
    let plan = source.plan();
    notes.extend(plan.notes.iter().cloned());
    let mut checks = Vec::new();
    let mut note = |name, problem| checks.push(Check { name, problem, notes: Vec::new() });
    note("it opens: a known layout with demos", None);
    let structure: Vec<&str> = plan.problems.iter().map(|p| p.message.as_str()).collect();
    note("demos have what they must have", (!structure.is_empty()).then(|| structure.join("; ")));
    let mut screen = cli::Screen::new();
    let mut advance = screen.advance("reading");
    let mut failed = Vec::new();
    for (index, demo) in plan.demos.iter().enumerate() {
        // large datasets by rows, the rest whole
        let large = |key: &str| demo.keys.get(key).and_then(|k| k.bytes()).is_some_and(|b| b > BLOCK_BYTES);
        let wanted = |key: &str| demo.keys.contains_key(key) && !large(key);
        let mut outcome = source.read_demo_where(index, &wanted).map(|read| {
            let found = read.datasets.iter().filter_map(|(key, array)| source.not_finite(&demo.id, key, array, 0));
            failed.extend(found.map(|error| error.to_string()));
        });
        for (path, key) in demo.keys.iter().filter(|(path, _)| large(path)) {
            let rows = key.shape.first().copied().unwrap_or(0);
            let step = (BLOCK_BYTES as usize * rows / key.bytes().unwrap_or(1).max(1) as usize).max(1);
            let mut finite = true;
            for first in (0..rows).step_by(step) {
                if outcome.is_ok() {
                    outcome = source.read_rows(index, path, first, step.min(rows - first)).map(|array| {
                        let found = source.not_finite(&demo.id, path, &array, first).filter(|_| finite);
                        finite &= found.is_none();
                        failed.extend(found.map(|error| error.to_string()));
                    });
                }
            }
        }
        if let Err(e) = outcome {
            failed.push(e.to_string());
        }
        advance(index as u64 + 1, plan.demos.len() as u64);
    }
    note("every demo can be read and every number is finite", (!failed.is_empty()).then(|| failed.join("; ")));
    Ok(checks)
}
