use std::collections::{BTreeMap, BTreeSet};
use std::process::ExitCode;

use anyhow::Context;
use cli::{Column, Table};
use report::{LeaderboardRow, Reading, rank};
use serde_json::json;
use zoo::audit::{KnownEntries, audit};
use zoo::entry::Entry;
use zoo::results::StoredEvaluation;

use crate::places::{ProtocolArgs, ResultsArgs, ZooArgs, entry_names};

/// Show in what two entries differ: settings, demonstrations, training, files and results
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo diff lift-act@1 lift-act@2
  actrm-zoo diff lift-act lift-actrm --json")]
pub struct Args {
    /// Entry: `name` (its newest version), `name@version` or `name@alias`
    #[arg(add = entry_names())]
    first: String,
    /// The same
    #[arg(add = entry_names())]
    second: String,
    /// As JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    results: ResultsArgs,
    #[command(flatten)]
    protocols: ProtocolArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

/// Values by what they are of.
type Facts = BTreeMap<String, String>;

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let registry = args.zoo.registry();
    let (first, second) = (registry.entry(&args.first)?, registry.entry(&args.second)?);
    let standing = audit(&args.results.folder(&args.zoo), &KnownEntries::open(&registry)?)?.standing;
    let reading = Reading { protocols: args.protocols.protocols()?, ..Reading::default() };
    let facts = |entry: &Entry| -> anyhow::Result<Facts> {
        let mut facts = facts(entry).with_context(|| format!("entry {}", entry.id()))?;
        let own = |one: &&StoredEvaluation| one.record.entry.to_string() == entry.id().to_string();
        let own: Vec<StoredEvaluation> = standing.iter().filter(own).cloned().collect();
        facts.extend(rank(&own, &reading).iter().map(result));
        Ok(facts)
    };
    let (one, two) = (facts(&first)?, facts(&second)?);
    let names: BTreeSet<&String> = one.keys().chain(two.keys()).collect();
    let differing: Vec<(&String, Option<&String>, Option<&String>)> =
        names.into_iter().map(|name| (name, one.get(name), two.get(name))).filter(|(_, one, two)| one != two).collect();
    if args.json {
        let all: Vec<_> =
            differing.iter().map(|(name, one, two)| json!({"what": name, "first": one, "second": two})).collect();
        cli::print_json(
            &json!({"first": first.id().to_string(), "second": second.id().to_string(), "differences": all}),
        )?;
        return Ok(ExitCode::SUCCESS);
    }
    if differing.is_empty() {
        cli::print(&format!("{} and {} differ in nothing\n", first.id(), second.id()))?;
        return Ok(ExitCode::SUCCESS);
    }
    let mut table = Table::new(vec![
        Column::new("what"),
        Column::new(first.id().to_string()),
        Column::new(second.id().to_string()),
    ]);
    let text = |value: Option<&String>| value.map_or("-".to_owned(), Clone::clone);
    differing.iter().for_each(|(name, one, two)| table.push(vec![(*name).clone(), text(*one), text(*two)]));
    cli::print(&table.text(false))?;
    Ok(ExitCode::SUCCESS)
}

/// What an entry says of itself, by dotted names.
fn facts(entry: &Entry) -> anyhow::Result<Facts> {
    let config: toml::Table = entry.config_text()?.parse().context("config.toml")?;
    let mut facts = Facts::new();
    flatten("config", &toml::Value::Table(config), &mut facts);
    let meta = entry.meta();
    let mut add = |name: &str, value: String| drop(facts.insert(name.to_owned(), value));
    add("parameters", meta.parameters.to_string());
    add("policy", meta.policy.clone());
    add("task", meta.task.clone());
    for spec in &meta.signature.observation {
        add(&format!("observation {}", spec.name), format!("{:?}", spec.shape));
    }
    if let Some(data) = &meta.data {
        add("data name", data.name.clone());
        add("data fingerprint", data.fingerprint.chars().take(12).collect());
        add("data episodes", data.train_episodes.to_string());
        add("data frames", data.train_frames.to_string());
        if let Some(seeds) = data.seeds {
            add("data seeds", seeds.to_string());
        }
    }
    if let Some(training) = &meta.training {
        add("training steps", training.steps.to_string());
        add("training minutes", format!("{:.1}", training.minutes));
        add("training threads", training.threads.to_string());
        if let Some(last) = training.curve.last() {
            add("training loss at the end", format!("{:.5}", last.loss));
        }
        if let Some(loss) = training.curve.iter().rev().find_map(|point| point.valid_loss) {
            add("validation loss at the end", format!("{loss:.5}"));
        }
    }
    for (name, version) in &meta.versions {
        add(&format!("version of {name}"), version.clone());
    }
    for (name, file) in &meta.files {
        add(&format!("file {name}"), file.sha256.chars().take(12).collect());
    }
    Ok(facts)
}

fn flatten(path: &str, value: &toml::Value, facts: &mut Facts) {
    match value {
        toml::Value::Table(table) => {
            table.iter().for_each(|(key, value)| flatten(&format!("{path}.{key}"), value, facts));
        }
        other => drop(facts.insert(path.to_owned(), other.to_string())),
    }
}

/// `result Lift lift-v1 test`, and its counts.
fn result(row: &LeaderboardRow) -> (String, String) {
    let name = format!("result {} {}, seeds {}", row.task(), row.protocol_text(), row.seeds_text());
    (name, format!("{} ({})", row.counts, row.counts.percent(1)))
}
