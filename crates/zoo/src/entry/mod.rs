//! Entries: `name@version`, a trained policy sealed with everything needed to run and to trust it.
//!
//! An entry is a folder `<zoo>/<name>/<version>/`: `model.safetensors`, `config.toml` (the resolved experiment),
//! `normaliser.safetensors`, `README.md` (the model card) and `entry.json`, which holds the SHA-256 of the others and of
//! itself. Those that were trained here also have `train.parquet` (the metrics on the way) and `command.txt` (the command
//! that trains it); older ones have their curve in `entry.json`. A version is never rewritten.
//!
//! Such a folder can be pushed to the Hugging Face Hub as it is: the card begins with the Hub's YAML. What an entry's
//! evaluations say is not sealed with it, because they come later: a card may hold it besides, under `model-index`.

mod card;
mod curve;
mod family;
mod format;
mod hub;
mod id;
mod kind;
mod meta;
mod open;
mod policy;
mod reference;
mod seal;
mod subject;
#[doc(hidden)]
pub mod testing;

pub use card::{CardWords, grouped};
pub(crate) use curve::thinned;
pub use family::{Families, key as family_of, member_name};
pub use hub::export_hub;
pub use id::{EntryId, EntryRequest, LATEST, check_alias, check_name};
pub use meta::{CamerasMeta, CurvePoint, DataMeta, EntryMeta, FileMeta, LICENSE, ModuleMeta, ParentMeta, TrainingMeta};
pub use open::Entry;
pub use policy::LoadedEntry;
pub use reference::{Repeats, reference};
pub use seal::EntryDraft;
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
/// The metrics of the training, row by row.
pub const TRAIN_FILE: &str = "train.parquet";
/// Observations, and the actions that the policy gave when it was sealed.
pub const REFERENCE_FILE: &str = "reference.safetensors";
/// The command that trains it.
pub const COMMAND_FILE: &str = "command.txt";
/// Provenance and the hashes of the other files.
pub const ENTRY_FILE: &str = "entry.json";
