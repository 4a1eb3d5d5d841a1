use std::path::PathBuf;
use std::process::ExitCode;

use cli::{INTERRUPTED, SimulatorArgs, Stop, limits, shown};
use zoo::evaluation::starts;
use zoo::probe::{ProbeCell, ProbeRequest, ProbeResult, probe};
use zoo::results::Seeds;

use crate::places::{ZooArgs, entry_names};

/// Read from a policy's thoughts, step by step, which thing a chain has reached
///
/// A linear regression for every supervision step and number of hops, from the recursion's state to the colour of the cube
/// after so many hops (tasks such as PickChain, whose things point to one another). It is fitted to how demonstrations
/// begin, with colours renamed at random, and read on the beginnings of fresh episodes; an untrained network of the same shape
/// says what the observation alone gives away.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo probe pickchain-actrm --data out/robots/pickchain.hdf5
  actrm-zoo probe pickchain-actrm --data out/robots/pickchain.hdf5 --steps 12 --out docs/thinking/probe_k6.json")]
pub struct Args {
    /// Entry: `name` (its newest version) or `name@version`
    #[arg(add = entry_names())]
    entry: String,
    /// Its demonstrations: an HDF5 file or a data set
    #[arg(long, value_name = "PATH")]
    data: PathBuf,
    /// Supervision steps [default: as many as it may take]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1000))]
    steps: Option<u64>,
    /// How often each demonstration is shown, each time with other names for its colours
    #[arg(long, value_name = "N", default_value_t = 16, value_parser = clap::value_parser!(u64).range(1..=1000))]
    renamings: u64,
    /// Fresh episodes
    #[arg(long, default_value_t = 400, value_parser = clap::value_parser!(u64).range(1..=limits::MOST_EPISODES))]
    episodes: u64,
    /// Seed of the first fresh episode; the others count up from it
    #[arg(long = "seed-start", value_name = "SEED", default_value_t = 30_000)]
    seed: u64,
    #[command(flatten)]
    simulator: SimulatorArgs,
    /// Folder that an HDF5 file is converted into
    #[arg(long, value_name = "DIR", default_value = "out/probe")]
    work: PathBuf,
    /// Write the result to this file too
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Print JSON instead of tables
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    limits::check_seeds(args.seed, args.episodes)?;
    let loaded = args.zoo.registry().entry(&args.entry)?.load()?;
    let longest = loaded.experiment().policy.reasoner().map_or(1, |config| config.reasoning.max_steps());
    let request = ProbeRequest {
        entry: &loaded,
        data: args.data.clone(),
        work: args.work.join(loaded.entry().id().to_string()),
        steps: args.steps.map(usize::try_from).transpose()?.unwrap_or(longest),
        renamings: args.renamings,
    };
    let stop = Stop::install("stopped")?;
    let meta = loaded.entry().meta();
    let spec = args.simulator.recorded_spec(&meta.task, meta.env_args.as_ref())?;
    let Some(mut pool) = args.simulator.start(spec, None, &stop)? else { return Ok(ExitCode::from(INTERRUPTED)) };
    let seeds = Seeds { start: args.seed, count: args.episodes };
    let ready = pool.ready().clone();
    let fresh = starts(&meta.keys, &mut pool, &seeds.iter().collect::<Vec<_>>())?;
    cli::close(pool);
    let Some(fresh) = fresh else { return Ok(ExitCode::from(INTERRUPTED)) };
    let result = probe(&request, &ready, seeds, &fresh)?;
    if let Some(path) = &args.out {
        result.write(path)?;
        cli::note(&shown(path));
    }
    match args.json {
        true => cli::print_json(&result)?,
        false => cli::print(&tables(&result))?,
    }
    Ok(ExitCode::SUCCESS)
}

/// One table a state: a row a step, a column a number of hops; in brackets longer chains than demonstrated.
fn tables(result: &ProbeResult) -> String {
    let share = |right: u64, of: u64| match of {
        0 => "-".to_owned(),
        _ => format!("{:.0}%", 100.0 * right as f64 / of as f64),
    };
    let cell_text = |c: &ProbeCell| format!("{} ({})", share(c.right, c.of), share(c.right_beyond, c.of_beyond));
    let mut text = String::new();
    for reading in &result.readings {
        let width = reading.cells.iter().filter(|cell| cell.step == 1).count();
        let heads = reading.cells[..width].iter();
        let heads: Vec<String> =
            heads.map(|c| c.hops.map_or("end".to_owned(), |hops| format!("{hops} hops"))).collect();
        let header: Vec<&str> = std::iter::once("step").chain(heads.iter().map(String::as_str)).collect();
        let rows: Vec<Vec<String>> = reading
            .cells
            .chunks(width.max(1))
            .map(|cells| std::iter::once(cells[0].step.to_string()).chain(cells.iter().map(cell_text)).collect())
            .collect();
        let right: Vec<usize> = (0..header.len()).collect();
        text += &format!("{}\n{}\n", reading.state, cli::table(&header, &rows, &right));
    }
    text
}
