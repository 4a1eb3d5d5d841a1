use std::process::ExitCode;

use anyhow::{Context, bail};
use audit::{KnownEntries, audit};
use report::{LeaderboardRow, Reading, rank};
use zoo::entry::EntryId;
use zoo::protocols::Block;
use zoo::results::StoredEvaluation;

use crate::places::{ProtocolArgs, ResultsArgs, ZooArgs, entry_names};

/// Name a version of an entry, such as `lift-act@best` for `lift-act@3`
///
/// Versions are never rewritten. An alias points at one of them and can be moved. `latest` is always the newest version.
/// `--by-results` chooses the version whose interval has the highest lower end on the dev block of a named protocol. A choice
/// on the test seeds would make the reported results too good.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo alias lift-act@3 best
  actrm-zoo alias lift-act best --by-results
  actrm-zoo alias lift-act
  actrm-zoo alias lift-act best --remove")]
pub struct Args {
    /// Entry: `name@version`, or `name` to list its aliases
    #[arg(add = entry_names())]
    entry: String,
    /// Alias to set
    alias: Option<String>,
    /// Point the alias at the best version on a dev block
    #[arg(long, requires = "alias", conflicts_with = "remove")]
    by_results: bool,
    /// Remove the alias
    #[arg(long, requires = "alias")]
    remove: bool,
    #[command(flatten)]
    results: ResultsArgs,
    #[command(flatten)]
    protocols: ProtocolArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let registry = args.zoo.registry();
    let mut id = registry.resolve(&args.entry)?;
    let Some(alias) = &args.alias else {
        let aliases = registry.aliases(&id.name)?;
        let newest = registry.resolve(&id.name)?.version;
        let all = std::iter::once(("latest".to_owned(), newest)).chain(aliases);
        let name = &id.name;
        cli::print(&all.map(|(alias, version)| format!("{name}@{alias} is {name}@{version}\n")).collect::<String>())?;
        return Ok(ExitCode::SUCCESS);
    };
    if args.by_results {
        id = best(args, &id)?;
    } else if !args.remove && !args.entry.contains('@') {
        bail!("{}: expected a version, such as {id}, or --by-results", args.entry);
    }
    registry.set_alias(&id, alias, !args.remove)?;
    let name = &id.name;
    let said =
        if args.remove { format!("{name}@{alias} is nothing any more\n") } else { format!("{name}@{alias} is {id}\n") };
    cli::print(&said)?;
    Ok(ExitCode::SUCCESS)
}

/// The version whose rate is at least the highest on a dev block.
fn best(args: &Args, id: &EntryId) -> anyhow::Result<EntryId> {
    let entries = KnownEntries::open(&args.zoo.registry())?;
    let standing = audit(&args.results.folder(&args.zoo), &entries)?.standing;
    let own: Vec<StoredEvaluation> = standing.into_iter().filter(|one| one.record.entry.name == id.name).collect();
    // every version is a row of its own here, family or not
    let reading = Reading { protocols: args.protocols.protocols()?, ..Reading::default() };
    let on_dev = |row: &LeaderboardRow| row.named.as_ref().is_some_and(|(_, block)| *block == Block::Dev);
    let rows: Vec<LeaderboardRow> = rank(&own, &reading).into_iter().filter(on_dev).collect();
    let row = rows.iter().max_by(|a, b| a.interval.0.total_cmp(&b.interval.0)).with_context(|| {
        format!("{}: no version was evaluated on a dev block: actrm-zoo eval {0} --protocol NAME --block dev", id.name)
    })?;
    if rows.iter().any(|other| other.protocol_text() != row.protocol_text()) {
        bail!("{}: its versions were evaluated under several protocols, which cannot be compared", id.name);
    }
    Ok(EntryId { name: id.name.clone(), version: row.record().entry.version })
}
