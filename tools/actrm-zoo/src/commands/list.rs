use std::collections::BTreeSet;
use std::process::ExitCode;

use anyhow::Context;
use cli::{Column, Table, shown};
use serde_json::Value;
use study::puzzle::{AnyExperiment, PuzzleMeta, Summary};
use zoo::entry::Entry;

use crate::places::{ConfigArgs, ZooArgs};

/// List the entries of the zoo, or the experiments
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo list
  actrm-zoo list --zoo my-zoo
  actrm-zoo list --json
  actrm-zoo list --experiments --policy act --task Lift
  actrm-zoo list --experiments --json")]
pub struct Args {
    /// List experiments instead of entries
    #[arg(long)]
    experiments: bool,
    /// Only entries or experiments of this policy
    #[arg(long)]
    policy: Option<String>,
    /// Only entries or experiments of this task
    #[arg(long)]
    task: Option<String>,
    /// Print JSON: the metadata of each entry without its training curve, or the names of the experiments
    #[arg(long)]
    json: bool,
    /// Show all columns, even in a narrow terminal
    #[arg(long)]
    wide: bool,
    #[command(flatten)]
    configs: ConfigArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

/// The policies and tasks of all rows, whatever was asked for.
#[derive(Default)]
struct Seen {
    policies: BTreeSet<String>,
    tasks: BTreeSet<String>,
}

impl Args {
    /// Whether a row of this policy and task is asked for.
    fn wanted(&self, policy: &str, task: &str, seen: &mut Seen) -> bool {
        seen.policies.insert(policy.to_owned());
        seen.tasks.insert(task.to_owned());
        let is = |wanted: &Option<String>, found: &str| wanted.as_ref().is_none_or(|w| w.eq_ignore_ascii_case(found));
        is(&self.policy, policy) && is(&self.task, task)
    }

    /// Notes that no row has the policy or task asked for, and lists those that rows have.
    fn note_no_match(&self, seen: &Seen) {
        for (option, wanted, there) in [("--policy", &self.policy, &seen.policies), ("--task", &self.task, &seen.tasks)]
        {
            let Some(wanted) = wanted else { continue };
            if !there.iter().any(|name| name.eq_ignore_ascii_case(wanted)) {
                let names: Vec<&str> = there.iter().map(String::as_str).collect();
                cli::note(&format!("no match for {option} {wanted}; expected one of: {}", names.join(", ")));
            }
        }
    }
}

/// The experiments: what each trains, on which task, and what the policy gets.
fn experiments(args: &Args) -> anyhow::Result<ExitCode> {
    let library = args.configs.library()?;
    let mut table = Table::new(["experiment", "policy", "task", "inputs"].map(Column::new).to_vec());
    let (mut names, mut failures, mut seen) = (Vec::new(), Vec::new(), Seen::default());
    for name in library.names()? {
        let Summary { policy, task, inputs } = match AnyExperiment::load(&library, &name, &[]) {
            Ok(experiment) => experiment.summary(&name),
            // one bad file must not hide the others
            Err(error) => {
                failures.push(anyhow::Error::new(error).context(format!("experiment {name}")));
                continue;
            }
        };
        if args.wanted(&policy, &task, &mut seen) {
            table.push(vec![name.clone(), policy, task, inputs]);
            names.push(name);
        }
    }
    match args.json {
        true => cli::print_json(&names)?,
        false => cli::print(&table.text(args.wide))?,
    }
    args.note_no_match(&seen);
    for failure in &failures {
        cli::note(&format!("error: {failure:#}"));
    }
    Ok(if failures.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if args.experiments {
        return experiments(args);
    }
    let registry = args.zoo.registry();
    let ids = registry.ids()?;
    if ids.is_empty() && !args.json {
        cli::note(&format!("no entries in {}; make one with: actrm-zoo train act_lift", shown(&args.zoo.zoo)));
        return Ok(ExitCode::SUCCESS);
    }
    let mut table = Table::new(vec![
        Column::new("entry"),
        Column::new("policy"),
        Column::new("task"),
        Column::new("parameters").right().dispensable(1),
        Column::new("steps").right().dispensable(2),
        Column::new("minutes").right().dispensable(3),
        Column::new("data").dispensable(4),
    ]);
    let (mut all, mut failures, mut seen) = (Vec::new(), Vec::new(), Seen::default());
    for id in ids {
        // one bad entry must not hide the others
        let entry = match Entry::open_meta(registry.folder(), &id) {
            Ok(entry) => entry,
            Err(error) => {
                failures.push(anyhow::Error::new(error).context(format!("entry {id}")));
                continue;
            }
        };
        let meta = entry.meta();
        if !args.wanted(&meta.policy, &meta.task, &mut seen) {
            continue;
        }
        if args.json {
            all.push(json(&entry)?);
            continue;
        }
        let training = meta.training.as_ref();
        let number = |value: Option<String>| value.unwrap_or_else(|| "-".to_owned());
        table.push(vec![
            id.to_string(),
            meta.policy.clone(),
            meta.task.clone(),
            meta.parameters.to_string(),
            number(training.map(|t| t.steps.to_string())),
            number(training.map(|t| format!("{:.1}", t.minutes))),
            number(match (&meta.data, PuzzleMeta::of(&entry)?) {
                (Some(data), _) => Some(format!("{} ({} demos)", data.name, data.train_episodes)),
                (None, Some(puzzle)) => Some(format!("{} puzzles", puzzle.train_puzzles)),
                (None, None) => None,
            }),
        ]);
    }
    match args.json {
        true => cli::print_json(&all)?,
        false => cli::print(&table.text(args.wide))?,
    }
    args.note_no_match(&seen);
    for failure in &failures {
        cli::note(&format!("error: {failure:#}"));
    }
    Ok(if failures.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// `entry.json` without the curve, and with the hash that results know the entry by.
fn json(entry: &Entry) -> anyhow::Result<Value> {
    let mut value = serde_json::to_value(entry.meta()).context("cannot write JSON")?;
    if let Some(training) = value.get_mut("training").and_then(Value::as_object_mut) {
        training.remove("curve");
    }
    value["entry"] = entry.id().to_string().into();
    value["content_sha256"] = entry.meta().content_sha256().into();
    Ok(value)
}
