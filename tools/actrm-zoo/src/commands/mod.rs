//! One file a command: its arguments, whose doc comment is its help, and what it does.

cli::commands! {
    "Train": train, runs, curves, study;
    "Evaluate": eval, score, merge, rerun, verify;
    "Compare": leaderboard, compare, diff;
    "Analyse": trace, saliency, depth, probe;
    "Use": serve;
    "Manage entries": list, show, alias, remove, import, export;
    "Shell": completions;
}
