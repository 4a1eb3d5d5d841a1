//! One file a command: its arguments, whose doc comment is its help, and what it does.

cli::commands! {
    train, runs, eval, merge, leaderboard, list, show, verify, trace, study, import, export, completions,
}
