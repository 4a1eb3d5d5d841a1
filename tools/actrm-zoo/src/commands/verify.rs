use std::collections::BTreeMap;
use std::process::ExitCode;

use audit::{KnownEntries, LeftOut, audit};
use cli::shown;
use study::puzzle::audit_puzzles;
use zoo::entry::{Entry, EntryId, MODEL_FILE, NORMALISER_FILE, Repeats};
use zoo::tensors;

use crate::places::{ResultsArgs, ZooArgs, entry_names, of_entry};
use crate::puzzles;

/// Check the hashes and seals of entries and results, and with --deep every tensor and predicted action
///
/// A valid result equals its seal, lies in the folder that its record names, and agrees with its entry in the zoo about the
/// training. Hashes detect damage and edits. `eval --again` shows whether a result can be measured again.
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
    /// with it
    #[arg(long)]
    deep: bool,
    #[command(flatten)]
    results: ResultsArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
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
    for LeftOut { folder, reason } in robots.left_out.into_iter().chain(solvers.left_out) {
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        // a folder is called after its entry; asked for nothing in particular, all that is wrong is told
        if args.entries.is_empty() || ids.iter().any(|id| name.starts_with(&format!("{id}_"))) {
            failures.push(anyhow::Error::new(reason).context(format!("result {}", shown(&folder))));
        }
    }
    cli::print(&text)?;
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
    Ok(match entry.load()?.repeats()? {
        Repeats::NotStored => "; no reference output is stored".to_owned(),
        Repeats::Exactly => "; it gives the stored actions again, bit for bit".to_owned(),
        Repeats::Within(far) => format!("; it gives the stored actions again, no value further off than {far:.1e}"),
    })
}
