use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;

use cli::{Column, Table, command_line, lossy, shown};
use serde_json::json;
use zoo::run::{FoundRun, RunState, list_runs};

/// List trainings that are running or can be resumed, with their progress
///
/// For each stopped training the list has the command that resumes it. A resumed training ends in the same bytes as an
/// uninterrupted one.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo runs
  actrm-zoo runs --runs my-runs --all
  actrm-zoo runs --json")]
pub struct Args {
    /// Folder of runs
    #[arg(long, value_name = "DIR", default_value = "runs")]
    runs: PathBuf,
    /// Also list finished trainings
    #[arg(long)]
    all: bool,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let mut runs = list_runs(&args.runs, &mut |error| cli::note(&format!("note: left out: {error}")))?;
    runs.retain(|run| args.all || run.state != RunState::Finished);
    if args.json {
        let one = |run: &FoundRun| {
            json!({
                "folder": lossy(&run.folder), "experiment": run.experiment, "state": run.state, "step": run.step,
                "steps": run.steps, "command": command(run),
            })
        };
        cli::print_json(&runs.iter().map(one).collect::<Vec<_>>())?;
        return Ok(ExitCode::SUCCESS);
    }
    if runs.is_empty() {
        cli::note(&format!(
            "no trainings under way in {}; begin one with: actrm-zoo train act_lift",
            shown(&args.runs)
        ));
        return Ok(ExitCode::SUCCESS);
    }
    let mut table = Table::new(vec![
        Column::new("run"),
        Column::new("state"),
        Column::new("step").right(),
        Column::new("of").right(),
    ]);
    for run in &runs {
        let steps = run.steps.map_or_else(|| "?".to_owned(), |steps| steps.to_string());
        table.push(vec![shown(&run.folder), run.state.as_str().to_owned(), run.step.to_string(), steps]);
    }
    let mut text = table.text(false);
    let commands: Vec<String> = runs.iter().filter_map(command).collect();
    if !commands.is_empty() {
        text.push_str("\nresume with:\n");
        text.extend(commands.iter().map(|command| format!("  {command}\n")));
    }
    cli::print(&text)?;
    Ok(ExitCode::SUCCESS)
}

/// The command that goes on with a run that was stopped; one begun by an older program has none on record.
fn command(run: &FoundRun) -> Option<String> {
    if run.state != RunState::Stopped {
        return None;
    }
    let words = || {
        let mut words: Vec<OsString> =
            ["actrm-zoo", "train", &run.experiment, "--resume", "--run"].map(OsString::from).to_vec();
        words.push(run.folder.as_os_str().to_owned());
        command_line(&words)
    };
    Some(run.command.clone().unwrap_or_else(words))
}
