//! One file a command: its arguments, whose doc comment is its help, and what it does.

cli::commands! {
    train, runs, eval, rerun, merge, compare, leaderboard, list, show, diff, curves, alias, remove,
    verify, trace, saliency, depth, probe, study, import, export, completions,
}
