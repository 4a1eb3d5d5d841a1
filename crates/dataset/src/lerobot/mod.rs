//! LeRobotDataset v3.0 directories: written from demonstrations, opened for training.

mod assembly;
mod check;
mod chooser;
mod columns;
mod convert;
mod depth;
mod doubts;
pub mod edit;
mod encode;
mod encoded;
mod export;
mod features;
mod fingerprint;
mod images;
mod info;
mod meta;
mod notes;
mod open;
mod pictures;
mod read;
mod schema;
mod sharded;
mod shards;
mod side;
mod skip;
mod staging;
mod tables;
mod tally;
mod tiff;
mod to_robomimic;
mod totals;
mod v2;
mod values;
mod verify;
mod videos;
mod work;

pub use check::TIME_TOLERANCE;
pub use convert::{ConvertReport, convert, convert_unless};
pub use depth::{DepthMaps, DepthUnit};
pub use export::{ExportReport, export};
pub use features::{ConvertOptions, ENTITY_PREFIX, ImageForm, MISTAKE, VideoEncoder, VideoOptions};
pub(crate) use images::{decode as decode_image, encode_png, is_jpeg};
pub use info::{
    ActionKind, ActionProvenance, Feature, Features, Info, Provenance, RotationForm, SkippedDemo, VideoProvenance,
};
pub(crate) use meta::python_json;
pub use notes::notes;
pub(crate) use notes::{mask_note, shared_notes};
pub use open::{ACTION, Column, Dataset, ENVIRONMENT_STATE, EnvMeta, EpisodeMeta, STATE, Texts};
pub use pictures::{CameraFile, PictureFile, PictureStore, Pictures};
pub(crate) use sharded::refuse as refuse_shard;
pub use sharded::{Shard, ShardReport, convert_shard, merge_shards, shard_files};
pub use to_robomimic::rewrite;
pub use v2::OldSet;
pub(crate) use v2::version as old_version;
pub use verify::{Check, source_hash, verify, verify_source, verify_within};
