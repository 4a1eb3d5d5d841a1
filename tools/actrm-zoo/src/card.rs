//! What a model card says of results.

use audit::{KnownEntries, audit};
use cli::shown;
use report::{Reading, model_index, rank};
use zoo::entry::Entry;
use zoo::results::StoredEvaluation;

use crate::places::{ProtocolArgs, ResultsArgs, ZooArgs};

/// The `model-index` of an entry: its whole results that stand. Those that do not are named and left out.
pub fn model_index_of(
    entry: &Entry,
    zoo: &ZooArgs,
    results: &ResultsArgs,
    protocols: &ProtocolArgs,
) -> anyhow::Result<String> {
    let id = entry.id();
    let audit = audit(&results.folder(zoo), &KnownEntries::only(&zoo.registry(), [id.clone()]))?;
    for left in &audit.left_out {
        let name = left.folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if name.starts_with(&format!("{id}_")) {
            cli::note(&format!("note: left out: {}: {}", shown(&left.folder), left.reason));
        }
    }
    let own = |one: &StoredEvaluation| one.record.entry.to_string() == id.to_string() && one.record.shard.is_none();
    let own: Vec<StoredEvaluation> = audit.standing.into_iter().filter(own).collect();
    let reading = Reading { protocols: protocols.protocols()?, ..Reading::default() };
    Ok(model_index(&id.to_string(), &rank(&own, &reading)))
}
