use crate::output;
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
    /// Report as JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let bar = output::bar("frames").with_message("exporting");
    let options = WriteOptions { gzip: args.gzip };
    let report = dataset::export(&args.dir, &args.out, &options, &mut output::advance(&bar));
    bar.finish_and_clear();
    let report = report?;
    if args.json {
        output::print_json(&json!({"out": args.out, "demos": report.demos, "frames": report.frames}))?;
    } else {
        output::print(&format!(
            "{}: {} demos, {} steps\n",
            args.out.display(),
            output::count(report.demos),
            output::count(report.frames)
        ))?;
    }
    Ok(ExitCode::SUCCESS)
}
