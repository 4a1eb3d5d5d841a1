//! Demonstrations: robomimic-family HDF5 in, LeRobot-ready Parquet out, windows for training.
//!
//! [`Source`] reads a file or folder of demonstrations of any known layout, [`convert`] makes a LeRobotDataset v3.0
//! directory of it, [`export`] rebuilds the file from that, [`Dataset`] opens a directory (ours or LeRobot's) with its
//! numeric columns in memory, [`Windows`] cuts training samples out of them, and [`Samples`] those that LeRobot's
//! `delta_timestamps` ask for. [`edit`] makes data sets of data sets. [`RobomimicWriter`] writes
//! demonstrations that were just collected, [`write_puzzles`] a table of puzzles.
//!
//! It is the only crate that knows HDF5. It knows nothing of models, tensors or simulators, starts no process but its
//! own isolated reader, and prints nothing.

// an error names file, demo, key, expected and found; it ends the work, so its size costs nothing
#![allow(clippy::result_large_err)]

mod error;
mod ffmpeg;
mod keys;
mod lerobot;
mod plan;
mod puzzle_table;
mod rotation;
mod samples;
mod sheet;
pub mod shuffle;
mod sorted_map;
mod source;
mod stats;
mod tree;
mod windows;
mod words;

pub use error::{DatasetError, InputError, Result};
pub use keys::{KeyItem, Moment};
pub use lerobot::{
    ACTION, ActionKind, ActionProvenance, CameraFile, Check, Column, ConvertOptions, ConvertReport, Dataset, DepthMaps,
    DepthUnit, ENTITY_PREFIX, ENVIRONMENT_STATE, EnvMeta, EpisodeMeta, ExportReport, Feature, Features, ImageForm,
    Info, MISTAKE, OldSet, PictureFile, PictureStore, Pictures, Provenance, RotationForm, STATE, Shard, ShardReport,
    SkippedDemo, TIME_TOLERANCE, Texts, VideoEncoder, VideoOptions, VideoProvenance, Wide, convert, convert_shard,
    convert_unless, edit, export, merge_shards, notes, remove_unfinished, rewrite, shard_files, source_hash, verify,
    verify_source, verify_within,
};
pub use plan::{DemoPlan, Dialect, Join, KeyPlan, Place, Plan, Problem};
pub use puzzle_table::{PuzzleSet, write_puzzles};
pub use samples::{NumberKind, SampleColumn, SamplePlace, SampleSpec, Samples};
pub use sheet::Picture;
pub use sorted_map::SortedMap;
pub use source::{NonFinite, RobomimicWriter, Source, VideoFile, VideoInfo, WriteOptions, isolation};
pub use stats::FeatureStats;
pub use tree::{Array, Attrs, Demo, Dtype};
pub use windows::{WindowBatch, WindowSpec, Windows};
pub use words::{INSTRUCTION_WIDTH, INSTRUCTION_WORDS, instruction_words};
