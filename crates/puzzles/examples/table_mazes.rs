//! Prints the mazes that the robot's TableMaze is laid out from, as JSON:
//! `cargo run --release -p puzzles --example table_mazes > tools/harness/actrm_harness/environments/mazes.json`

use std::io::Write as _;

fn main() -> std::io::Result<()> {
    std::io::stdout().write_all(puzzles::table_mazes().as_bytes())
}
