use anyhow::Result;
use dataset::WriteOptions;
use serde_json::json;
use std::path::PathBuf;
use std::process::ExitCode;

/// Rebuild the robomimic HDF5 file that a data set was converted from.
///
/// Every group, dataset, type, shape, attribute and value equals the original. Needs the side folder `actrm/`, whose
/// files are first compared with their recorded hashes.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data export lift lift_again.hdf5
  actrm-data export lift small.hdf5 --gzip 4")]
pub struct Args {
    /// Data set directory
    dir: PathBuf,
    /// File to create
    out: PathBuf,
    /// Compress datasets with gzip of this level
    #[arg(long, value_parser = clap::value_parser!(u8).range(1..=9), value_name = "LEVEL")]
    gzip: Option<u8>,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let mut screen = cli::Screen::new();
    let options = WriteOptions { gzip: args.gzip };
    let report = dataset::export(&args.dir, &args.out, &options, &mut screen.advance("exporting"));
    screen.clear();
    let report = report?;
    if args.json {
        cli::print_json(&json!({"out": cli::lossy(&args.out), "demos": report.demos, "frames": report.frames}))?;
    } else {
        cli::print(&format!(
            "{}: {} demos, {} steps\n",
            args.out.display(),
            cli::count(report.demos),
            cli::count(report.frames)
        ))?;
    }
    Ok(ExitCode::SUCCESS)
}
