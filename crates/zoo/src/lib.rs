//! Experiments, training runs, entries, rollouts, results, leaderboard.
