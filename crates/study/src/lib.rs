//! Studies: what is trained and compared over many experiments and seeds, and the pages that say what came of it.
//!
//! It stands above the zoo: puzzles are the first of its subjects. What this crate is not: it contains no model and no
//! optimiser (`models`), no puzzle (`puzzles`), and neither reads the command line nor prints (`tools`).

mod charts;
pub mod puzzle;
pub mod robots;
