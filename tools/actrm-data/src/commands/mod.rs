//! One file a command: its arguments, whose doc comment is its help, and what it does.

cli::commands! {
    inspect, convert, collect, extract, replay, export, validate, edit, stats, query, plot, view, puzzle, completions,
}
