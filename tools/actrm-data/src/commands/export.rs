use crate::work::Work;
use anyhow::Result;
use dataset::{ExportReport, WriteOptions};
use serde_json::json;
use std::path::PathBuf;
use std::process::ExitCode;

/// Write a data set as robomimic HDF5; the same as `convert DIR OUT --to robomimic`.
///
/// A data set with the side folder `actrm/` becomes the file that it was converted from: every group, dataset, type, shape,
/// attribute and value equals the original. The files of the side folder are first compared with their recorded hashes. Any
/// other data set becomes a file of its columns: an episode is a demo, a camera is obs/<camera>_image.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data export lift lift_again.hdf5
  actrm-data export lift small.hdf5 --gzip 4")]
pub struct Args {
    /// Data set directory
    pub(super) dir: PathBuf,
    /// File to create
    pub(super) out: PathBuf,
    /// Compress datasets with gzip of this level
    #[arg(long, value_parser = clap::value_parser!(u8).range(1..=9), value_name = "LEVEL")]
    pub(super) gzip: Option<u8>,
    /// Print the report as JSON
    #[arg(long)]
    pub(super) json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let _work = Work::begin(&args.out)?;
    let mut screen = cli::Screen::new();
    let options = WriteOptions { gzip: args.gzip };
    let report = dataset::export(&args.dir, &args.out, &options, &mut screen.advance("exporting"));
    screen.clear();
    tell(args, report?)
}

/// Says what was written.
pub(super) fn tell(args: &Args, report: ExportReport) -> Result<ExitCode> {
    for note in &report.notes {
        cli::note(&format!("note: {note}"));
    }
    if args.json {
        cli::print_json(&json!({
            "out": cli::lossy(&args.out), "demos": report.demos, "frames": report.frames, "notes": report.notes,
        }))?;
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
