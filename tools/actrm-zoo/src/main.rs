//! Command line for training, evaluation and the leaderboard.
//!
//! One file a command: its arguments with their help, and the function that runs it. Results go to
//! standard output, progress and errors to standard error.
#![deny(clippy::print_stdout, clippy::print_stderr)]

mod card;
mod commands;
mod compared;
mod places;
mod puzzles;
mod remote;
mod simulation;
mod training;
mod videos;

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

/// Train policies on demonstrations, keep them in a zoo, and see how well they do.
#[derive(Parser)]
#[command(name = "actrm-zoo", version, propagate_version = true, arg_required_else_help = true, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: commands::Command,
}

fn main() -> ExitCode {
    // converting an HDF5 file reads it in a process of its own, which is this program again
    dataset::isolation::serve_if_child();
    cli::completions::answer(command);
    cli::end(cli::parse::<Cli>(command(), &setting_hint).command.run())
}

/// The command line, as its help shows it.
fn command() -> clap::Command {
    cli::dressed(Cli::command(), commands::Command::GROUPS)
}

/// For `train --steps 100`: the setting of an experiment that is called so, as an override.
fn setting_hint(option: &str, value: Option<&str>) -> Option<String> {
    let name = option.strip_prefix("--")?.replace('-', "_");
    if std::env::args().nth(1)? != "train" {
        return None;
    }
    let settings = zoo::config::Library::built_in().resolve("act_lift").ok()?;
    let mut sections = settings.iter().filter_map(|(section, keys)| Some((section, keys.as_table()?)));
    let (section, _) = sections.find(|(_, keys)| keys.contains_key(&name))?;
    Some(format!("settings of an experiment have no dashes: `{section}.{name}={}`", value.unwrap_or("VALUE")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_sound_and_every_command_shows_examples() {
        cli::every_command_shows_examples(&command());
    }
}
