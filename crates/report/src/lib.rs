//! What readers see of a zoo's results: statistics, the leaderboard, and the forms that it is written in.
//!
//! A table is a list of columns ([`column`]); [`csv`], [`json`], [`markdown`] and [`html`] each write any such list, and so do
//! the programs to a terminal.
//!
//! Pure functions of results: no file, no clock, the same bytes for the same evaluations. What this crate is not: it
//! runs nothing and knows no kind of entry but robot policies; other kinds bring their own section (`study`).

mod across;
mod card;
mod charts;
pub mod column;
pub mod comparison;
pub mod csv;
pub mod html;
pub mod json;
mod leaderboard;
pub mod markdown;
pub mod others;
mod page;
pub mod statistics;

pub use across::{ACROSS_COLUMNS, AcrossTasks, across_tasks};
pub use card::model_index;
pub use charts::curves_svg;
pub use leaderboard::{Bound, COLUMNS, Counts, FEWEST_TO_RANK, LeaderboardRow, Reading, Seeing, count_text, rank};
pub use page::{
    Beside, Curve, DEPTH_COLUMNS, Depth, EntryFacts, Film, MOST_FILM_BYTES, OTHERS_COLUMNS, Places, shell_quoted,
    to_html,
};
pub use statistics::{mean, percent, quantile, share_percent, wilson_interval};
