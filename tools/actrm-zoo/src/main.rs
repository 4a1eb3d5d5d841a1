//! Command line for training, evaluation and the leaderboard.

fn main() {}
