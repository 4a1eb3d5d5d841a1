//! Entries: `name@version`, a trained policy sealed with everything needed to run and to trust it.
//!
//! An entry is a folder `<zoo>/<name>/<version>/` of five files: `model.safetensors`, `config.toml` (the
//! resolved experiment), `normaliser.safetensors`, `README.md` (the model card) and `entry.json`, which
//! holds the SHA-256 of the other four and of itself. A version is never rewritten.

mod card;
mod family;
mod format;
mod id;
mod meta;
mod open;
mod policy;
mod seal;
mod subject;

pub use card::{CardWords, grouped};
pub use family::{Families, key as family_of, member_name};
pub use id::{EntryId, EntryRequest, LATEST, check_alias, check_name};
pub use meta::{CamerasMeta, CurvePoint, DataMeta, EntryMeta, FileMeta, ModuleMeta, TrainingMeta};
pub use open::Entry;
pub use policy::LoadedEntry;
pub use seal::EntryDraft;
#[cfg(test)]
pub(crate) use seal::tests::draft as test_draft;
pub(crate) use seal::{REMOVED, lock_name};
pub use subject::training_facts;

/// The weights.
pub const MODEL_FILE: &str = "model.safetensors";
/// The resolved experiment.
pub const CONFIG_FILE: &str = "config.toml";
/// Statistics that inputs and outputs are normalised with.
pub const NORMALISER_FILE: &str = "normaliser.safetensors";
/// The model card.
pub const CARD_FILE: &str = "README.md";
/// Provenance and the hashes of the other files.
pub const ENTRY_FILE: &str = "entry.json";
