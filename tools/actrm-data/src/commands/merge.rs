use crate::work::Work;
use anyhow::Result;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

/// Make a data set of all shards that `convert --shard` wrote.
///
/// The result has the bytes of a conversion in one run. Nothing is encoded again, so a merge takes about as long as copying the
/// files. A shard that is missing, that comes twice, that belongs to another conversion or that was damaged is refused by name.
/// OUT appears whole or not at all. Data sets are joined by `actrm-data edit merge`.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data convert many.hdf5 parts/1 --shard 1/2   # on one machine
  actrm-data convert many.hdf5 parts/2 --shard 2/2   # on another
  actrm-data merge many parts/1 parts/2")]
pub struct Args {
    /// Directory to create
    out: PathBuf,
    /// Folders of all shards, in any order
    #[arg(required = true, value_name = "SHARD")]
    shards: Vec<PathBuf>,
    /// Report as JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let work = Work::begin(&args.out)?;
    let start = Instant::now();
    let mut screen = cli::Screen::new();
    let mut advance = screen.advance("merging");
    let report = dataset::merge_shards(&args.out, &args.shards, &mut |done, total| {
        advance(done, total);
        work.goes_on()
    });
    drop(advance);
    screen.clear();
    super::convert::tell(&report?, None, &args.out, start.elapsed().as_secs_f64(), args.json)
}
