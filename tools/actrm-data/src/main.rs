//! Command line for demonstrations and data sets.

mod commands;
mod output;
mod simulator;
mod svg;

use clap::{Parser, Subcommand};
use std::process::ExitCode;

/// Demonstrations for robot learning: look at them, collect them, convert them, check them.
///
/// Reads robomimic-family HDF5 (robomimic, robosuite, MimicGen, LIBERO, robocasa, D4RL, ALOHA) and writes
/// LeRobotDataset v3.0 directories of Parquet files, from which the original file can be rebuilt.
#[derive(Parser)]
#[command(name = "actrm-data", version, propagate_version = true, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Inspect(commands::inspect::Args),
    Convert(commands::convert::Args),
    Collect(commands::collect::Args),
    Extract(commands::extract::Args),
    Replay(commands::replay::Args),
    Export(commands::export::Args),
    Validate(commands::validate::Args),
    Stats(commands::stats::Args),
    Query(commands::query::Args),
    Plot(commands::plot::Args),
    Puzzle(commands::puzzle::Args),
    Completions(commands::completions::Args),
}

fn main() -> ExitCode {
    // in a reading process this never returns
    dataset::isolation::serve_if_child();
    let result = match Cli::parse().command {
        Command::Inspect(args) => commands::inspect::run(&args),
        Command::Convert(args) => commands::convert::run(&args),
        Command::Collect(args) => commands::collect::run(&args),
        Command::Extract(args) => commands::extract::run(&args),
        Command::Replay(args) => commands::replay::run(&args),
        Command::Export(args) => commands::export::run(&args),
        Command::Validate(args) => commands::validate::run(&args),
        Command::Stats(args) => commands::stats::run(&args),
        Command::Query(args) => commands::query::run(&args),
        Command::Plot(args) => commands::plot::run(&args),
        Command::Puzzle(args) => commands::puzzle::run(&args),
        Command::Completions(args) => {
            use clap::CommandFactory;
            commands::completions::run(&args, &mut Cli::command())
        }
    };
    match result {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }
}
