//! One file a command: its arguments, whose doc comment is its help, and what it does.

pub mod collect;
pub mod completions;
pub mod convert;
pub mod export;
pub mod extract;
pub mod inspect;
pub mod plot;
pub mod puzzle;
pub mod query;
pub mod replay;
pub mod stats;
pub mod validate;
