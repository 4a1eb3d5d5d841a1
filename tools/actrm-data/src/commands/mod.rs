//! One file a command: its arguments, whose doc comment is its help, and what it does.

cli::commands! {
    "Look": inspect, view, stats, plot, query, replay;
    "Record": collect, extract, puzzle;
    "Convert and edit": convert, merge, validate, edit, export;
    "Shell": completions;
}
