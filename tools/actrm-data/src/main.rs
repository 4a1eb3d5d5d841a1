//! Command line for demonstrations and data sets.
#![deny(clippy::print_stdout, clippy::print_stderr)]

mod cameras;
mod commands;
mod svg;
mod view;
mod work;

use clap::{CommandFactory, Parser};
use dataset::DatasetError;
use std::process::ExitCode;

/// Demonstrations for robot learning: look at them, collect them, convert them, check them.
///
/// Reads demonstrations of many kinds (HDF5, zarr, RLDS, LeRobot v2: `convert --help` lists them) and writes
/// LeRobotDataset v3.0 directories of Parquet files, from which the original file can be rebuilt.
#[derive(Parser)]
#[command(name = "actrm-data", version, propagate_version = true, arg_required_else_help = true, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: commands::Command,
}

fn main() -> ExitCode {
    // in a reading process this never returns
    dataset::isolation::serve_if_child();
    cli::completions::answer(command);
    let result = cli::parse::<Cli>(command(), &|_, _| None).command.run();
    let error = result.as_ref().err().and_then(|error| error.downcast_ref::<DatasetError>());
    if matches!(error, Some(DatasetError::Stopped { .. })) {
        cli::note(work::STOPPED);
        return ExitCode::from(cli::INTERRUPTED);
    }
    cli::end(result)
}

/// The command line, as its help shows it.
fn command() -> clap::Command {
    cli::dressed(Cli::command(), commands::Command::GROUPS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_sound_and_every_command_shows_examples() {
        cli::every_command_shows_examples(&command());
    }
}
