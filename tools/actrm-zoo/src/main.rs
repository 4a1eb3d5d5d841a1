//! Command line for training, evaluation and the leaderboard.
//!
//! One file a command: its arguments with their help, and the function that runs it. Results go to
//! standard output, progress and errors to standard error.

mod commands;
mod stop;
mod terminal;

use std::process::ExitCode;

use clap::Parser;

/// Train policies on demonstrations, keep them in a zoo, and see how well they do.
#[derive(Parser)]
#[command(name = "actrm-zoo", version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: commands::Command,
}

fn main() -> ExitCode {
    // converting an HDF5 file reads it in a process of its own, which is this program again
    dataset::isolation::serve_if_child();
    match Cli::parse().command.run() {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_command_line_is_sound_and_every_command_shows_examples() {
        let command = Cli::command();
        command.clone().debug_assert();
        for sub in command.get_subcommands() {
            let help = sub.get_after_help().map(ToString::to_string).unwrap_or_default();
            assert!(help.contains("actrm-zoo "), "`{}` shows no example", sub.get_name());
        }
    }
}
