//! What readers see of a zoo's results: statistics, the leaderboard, and the forms that it is written in.
//!
//! Pure functions of results: no file, no clock, the same bytes for the same evaluations. What this crate is not: it
//! runs nothing and knows no kind of entry but robot policies; other kinds bring their own section (`study`).

mod charts;
mod html;
mod leaderboard;
#[cfg(test)]
mod testing;
mod wilson;

pub use html::{Curve, escape, to_html};
pub use leaderboard::{
    CSV_COLUMNS, Counts, LeaderboardRow, TABLE_COLUMNS, count_text, rank, to_csv, to_markdown, to_table,
};
pub use wilson::wilson_interval;
