use std::collections::{BTreeMap, BTreeSet};
use std::process::ExitCode;

use anyhow::Context;
use audit::{KnownEntries, audit};
use cli::{Column, Table};
use report::{LeaderboardRow, Reading, rank};
use serde::Serialize;
use serde_json::json;
use zoo::entry::{CurvePoint, Entry};
use zoo::results::StoredEvaluation;

use crate::places::{ProtocolArgs, ResultsArgs, ZooArgs, entry_names};

/// Show how two entries differ: settings, demonstrations, training, files and results
///
/// Training curves are compared at every step that both have: the first step at which they differ, and the difference at
/// some steps.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo diff lift-act-s1 lift-act-s2
  actrm-zoo diff lift-act-s1 lift-actrm-s1 --json")]
pub struct Args {
    /// First entry: `name` (its newest version), `name@version` or `name@alias`
    #[arg(add = entry_names())]
    first: String,
    /// Second entry, named like the first
    #[arg(add = entry_names())]
    second: String,
    /// Print JSON instead of text
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
    let mut curves = Vec::new();
    for (what, of) in LOSSES {
        let points = |entry: &Entry| -> anyhow::Result<Points> {
            let curve = entry.whole_curve().with_context(|| format!("entry {}", entry.id()))?;
            Ok(curve.iter().filter_map(|point| Some((point.step, of(point)?))).collect())
        };
        curves.extend(Curves::of(what, &points(&first)?, &points(&second)?));
    }
    if args.json {
        let all: Vec<_> =
            differing.iter().map(|(name, one, two)| json!({"what": name, "first": one, "second": two})).collect();
        cli::print_json(
            &json!({"first": first.id().to_string(), "second": second.id().to_string(), "differences": all, "curves": curves}),
        )?;
        return Ok(ExitCode::SUCCESS);
    }
    let same = |curves: &Curves| curves.common_steps > 0 && curves.first_difference.is_none();
    if differing.is_empty() && curves.iter().all(same) {
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
    let mut told = vec![table.text(false)];
    told.extend(curves.iter().map(|curves| curves.text(&first.id().to_string(), &second.id().to_string())));
    cli::print(&told.join("\n"))?;
    Ok(ExitCode::SUCCESS)
}

/// A loss at a point, where it was computed.
type Loss = fn(&CurvePoint) -> Option<f64>;

/// The losses that a training curve has.
const LOSSES: [(&str, Loss); 2] =
    [("training loss", |point| Some(point.loss)), ("validation loss", |point| point.valid_loss)];

/// A loss by step.
type Points = BTreeMap<u64, f64>;

/// Common steps at which two curves are shown.
const SHOWN: usize = 6;

/// Two curves beside each other.
#[derive(Debug, Serialize)]
struct Curves {
    what: &'static str,
    /// Steps that both have.
    common_steps: usize,
    /// Where they are first not the same to the last bit.
    first_difference: Option<Beside>,
    /// Some of the common steps, the first and the last among them.
    at: Vec<Beside>,
}

/// Two losses at one step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct Beside {
    step: u64,
    first: f64,
    second: f64,
    /// The second less the first.
    difference: f64,
}

impl Curves {
    /// Nothing where one has no curve.
    fn of(what: &'static str, first: &Points, second: &Points) -> Option<Self> {
        if first.is_empty() || second.is_empty() {
            return None;
        }
        let beside = |(&step, &first): (&u64, &f64)| {
            let second = *second.get(&step)?;
            Some(Beside { step, first, second, difference: second - first })
        };
        let common: Vec<Beside> = first.iter().filter_map(beside).collect();
        let last = common.len().saturating_sub(1);
        let mut places: Vec<usize> = (0..SHOWN).map(|k| k * last / (SHOWN - 1)).collect();
        places.dedup();
        Some(Self {
            what,
            common_steps: common.len(),
            first_difference: common.iter().find(|at| at.first.to_bits() != at.second.to_bits()).copied(),
            at: places.into_iter().filter_map(|place| common.get(place).copied()).collect(),
        })
    }

    fn text(&self, first: &str, second: &str) -> String {
        let Self { what, common_steps, .. } = self;
        let steps = if *common_steps == 1 { "step" } else { "steps" };
        let Some(apart) = &self.first_difference else {
            return match common_steps {
                0 => format!("{what}: no step in common\n"),
                _ => format!("{what}: the same at all {common_steps} common {steps}\n"),
            };
        };
        let mut table = Table::new(vec![
            Column::new("step").right(),
            Column::new(first).right(),
            Column::new(second).right(),
            Column::new("difference").right(),
        ]);
        for at in &self.at {
            let loss = |loss: f64| format!("{loss:.5}");
            table.push(vec![at.step.to_string(), loss(at.first), loss(at.second), signed(at.difference)]);
        }
        let by = signed(apart.difference);
        format!(
            "{what}: {common_steps} common {steps}, first apart at step {} by {by}\n{}",
            apart.step,
            table.text(false)
        )
    }
}

/// A difference: five decimals, or what is left of it where they would say nothing.
fn signed(difference: f64) -> String {
    match difference.abs() {
        0.0 => "0".to_owned(),
        ..5e-6 => format!("{difference:+.1e}"),
        _ => format!("{difference:+.5}"),
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_are_compared_at_their_common_steps() {
        let every = |pitch: u64, from: u64| -> Points {
            (1..=120)
                .map(|k| k * pitch)
                .map(|step| (step, 1.0 / step as f64 + if step >= from { 0.25 } else { 0.0 }))
                .collect()
        };
        // common: 30, 60, … 240; the second is 0.25 higher from 100 on
        let found = Curves::of("training loss", &every(2, u64::MAX), &every(15, 100)).expect("both have points");
        assert_eq!(found.common_steps, 8);
        let apart = found.first_difference.expect("they differ");
        assert_eq!((apart.step, apart.difference), (120, 0.25 + 1.0 / 120.0 - 1.0 / 120.0));
        let steps: Vec<u64> = found.at.iter().map(|at| at.step).collect();
        assert_eq!(steps, [30, 60, 90, 150, 180, 240]);
        let text = found.text("a@1", "b@1");
        assert!(text.starts_with("training loss: 8 common steps, first apart at step 120 by +0.25000\n"), "{text}");
        assert!(text.contains("0.03333") && text.lines().count() == 9, "{text}");
    }

    #[test]
    fn equal_curves_are_the_same_and_others_may_share_no_step() {
        let one: Points = [(10, 0.5), (20, 0.25)].into();
        let found = Curves::of("training loss", &one, &one).expect("both have points");
        assert_eq!((found.first_difference, found.at.len()), (None, 2));
        assert_eq!(found.text("a@1", "b@1"), "training loss: the same at all 2 common steps\n");
        let other: Points = [(15, 0.5)].into();
        let found = Curves::of("validation loss", &one, &other).expect("both have points");
        assert_eq!(found.text("a@1", "b@1"), "validation loss: no step in common\n");
        assert!(Curves::of("training loss", &one, &Points::new()).is_none());
        // a bit is a difference, and is shown
        let near: Points = [(10, 0.5), (20, 0.25 + f64::EPSILON)].into();
        let text = Curves::of("training loss", &one, &near).expect("both have points").text("a@1", "b@1");
        assert!(text.contains("first apart at step 20 by +2.2e-16"), "{text}");
    }
}
