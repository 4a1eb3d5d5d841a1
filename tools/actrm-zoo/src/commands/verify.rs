use std::collections::BTreeMap;
use std::path::Path;
use std::process::ExitCode;

use anyhow::bail;
use audit::{KnownEntries, LeftOut, SameWeights, audit, is_of};
use cli::shown;
use study::puzzle::audit_puzzles;
use zoo::entry::{CONFIG_FILE, ENTRY_FILE, Entry, EntryId, LoadedEntry, MODEL_FILE, NORMALISER_FILE, Repeats};
use zoo::tensors;

use crate::places::{ResultsArgs, ZooArgs, entry_names, of_entry};
use crate::puzzles;

/// Check the hashes and seals of entries and results, and with --deep every tensor and predicted action
///
/// A valid result equals its seal, lies in the folder that its record names, and agrees with its entry in the zoo about the
/// training. Results that are not finished are named. Hashes detect damage and edits. `eval --again` shows whether a result can be measured again.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo verify
  actrm-zoo verify lift-act stack-act@1 --deep
  actrm-zoo verify --zoo my-zoo --results elsewhere")]
pub struct Args {
    /// Entries: `name` (its newest version) or `name@version` [default: all entries and all results]
    #[arg(add = entry_names())]
    entries: Vec<String>,
    /// Also build each network, check the names, shapes and values of its tensors, and compare its actions with those stored
    /// with it. `entry.json` must agree with the network and with `config.toml`
    #[arg(long)]
    deep: bool,
    #[command(flatten)]
    results: ResultsArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    args.zoo.check()?;
    args.results.check()?;
    let (registry, results) = (args.zoo.registry(), args.results.folder(&args.zoo));
    let entries = KnownEntries::open(&registry)?;
    let ids: Vec<EntryId> = match args.entries.is_empty() {
        true => registry.ids()?,
        false => args.entries.iter().map(|name| registry.resolve(name)).collect::<Result<_, _>>()?,
    };
    let (robots, solvers) = (audit(&results, &entries)?, audit_puzzles(&results, &entries)?);
    let mut whole: BTreeMap<(String, u32), usize> = BTreeMap::new();
    let of_robots = robots.standing.iter().map(|stored| &stored.record.entry);
    for entry in of_robots.chain(solvers.standing.iter().map(|record| &record.entry)) {
        *whole.entry((entry.name.clone(), entry.version)).or_default() += 1;
    }
    let mut failures = Vec::new();
    let mut text = String::new();
    for id in &ids {
        match check(id, &entries, args.deep).map_err(|error| of_entry(id, error)) {
            Ok((count, repeats)) => {
                let results = whole.get(&(id.name.clone(), id.version)).copied().unwrap_or_default();
                text.push_str(&format!("{id}: {count} files and {results} results are as they were made{repeats}\n"));
            }
            Err(error) => failures.push(error),
        }
    }
    // asked for nothing in particular, all that is wrong is told
    let asked = |folder: &Path| args.entries.is_empty() || ids.iter().any(|id| is_of(folder, id));
    let mut notes = Vec::new();
    for found in robots.under_way.iter().filter(|found| asked(&found.folder)) {
        notes.push(format!("result {}: {found}", shown(&found.folder)));
    }
    for (folder, doubt) in robots.doubts.iter().filter(|(folder, _)| asked(folder)) {
        notes.push(format!("result {}: {doubt}", shown(folder)));
    }
    for SameWeights { entries, impossible } in entries.same_weights() {
        if args.entries.is_empty() || entries.iter().any(|id| ids.contains(id)) {
            let names: Vec<String> = entries.iter().map(ToString::to_string).collect();
            let said = format!("entries {}: the same weights", names.join(", "));
            match impossible {
                true => failures.push(anyhow::anyhow!("{said}, though trainings of one family say other seeds")),
                false => notes.push(format!("{said} under several names")),
            }
        }
    }
    for LeftOut { folder, reason } in robots.left_out.into_iter().chain(solvers.left_out) {
        if asked(&folder) {
            failures.push(anyhow::Error::new(reason).context(format!("result {}", shown(&folder))));
        }
    }
    cli::print(&text)?;
    notes.iter().for_each(|note| cli::note(&format!("note: {note}")));
    for failure in &failures {
        cli::note(&format!("error: {failure:#}"));
    }
    if ids.is_empty() && failures.is_empty() {
        cli::note(&format!("no entries in {}; make one with: actrm-zoo train act_lift", shown(&args.zoo.zoo)));
    }
    Ok(if failures.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// How many files an entry has, all of which are what was written, and what a deep check says of its answers.
fn check(id: &EntryId, entries: &KnownEntries, deep: bool) -> anyhow::Result<(usize, String)> {
    let entry = match entries.get(id) {
        Some(entry) => entry,
        None => {
            let bad = entries.bad().find(|(bad, _)| *bad == id);
            anyhow::bail!("{}", bad.map_or_else(|| "not in the zoo".to_owned(), |(_, error)| error.to_string()))
        }
    };
    let repeats = if deep { deep_check(entry)? } else { String::new() };
    // entry.json is hashed in itself
    Ok((entry.meta().files.len() + 1, repeats))
}

fn deep_check(entry: &Entry) -> anyhow::Result<String> {
    if entry.meta().is_external() {
        return Ok("; its weights are not in this zoo".to_owned());
    }
    for name in [MODEL_FILE, NORMALISER_FILE] {
        let path = entry.folder().join(name);
        let (values, _) = tensors::read(&path)?;
        tensors::check_finite(&path, &values)?;
    }
    // names and shapes are compared where the network is built
    if puzzles::deep_check(entry)? {
        return Ok(String::new());
    }
    let loaded = entry.load()?;
    check_meta(&loaded)?;
    Ok(match loaded.repeats()? {
        Repeats::NotStored => "; no reference output is stored".to_owned(),
        Repeats::Exactly => "; it predicts the stored actions bit for bit".to_owned(),
        Repeats::Within(far) => format!("; it predicts the stored actions to within {far:.1e}"),
    })
}

/// Compares what `entry.json` says with the network and with the experiment in `config.toml`.
fn check_meta(loaded: &LoadedEntry) -> anyhow::Result<()> {
    let (entry, experiment) = (loaded.entry(), loaded.experiment());
    let meta = entry.meta();
    let parameters = loaded.model().params().count();
    let said = |key: &str| format!("as {key} of {CONFIG_FILE}");
    let mut facts = vec![
        ("parameters", "as the network has".to_owned(), parameters.to_string(), meta.parameters.to_string()),
        ("name", said("entry"), experiment.entry.clone(), meta.name.clone()),
        ("policy", said("policy.type"), experiment.policy_type(), meta.policy.clone()),
        ("task", said("task.name"), experiment.task.name.clone(), meta.task.clone()),
    ];
    // the config of an imported entry says nothing of its training
    if let Some(training) = meta.training.as_ref().filter(|_| meta.parent.is_none()) {
        let train = &experiment.train;
        facts.push(("training.steps", said("train.steps"), train.steps.to_string(), training.steps.to_string()));
        facts.push(("training.seed", said("train.seed"), train.seed.to_string(), training.seed.to_string()));
    }
    for (key, of, expected, found) in facts {
        if expected != found {
            bail!("{}: {key}: expected {expected} {of}, found {found}", shown(&entry.folder().join(ENTRY_FILE)));
        }
    }
    Ok(())
}
