use std::path::PathBuf;
use std::process::ExitCode;

use analysis::depth::starts;
use analysis::probe::{ProbeCell, ProbeRequest, ProbeResult, probe};
use cli::{INTERRUPTED, SimulatorArgs, Stop, limits, shown};
use rollout::Control;
use zoo::results::Seeds;

use crate::places::{ZooArgs, entry_names};
use crate::simulation::{drawn, worker};

/// Probe the latent state of a recursive policy: which object of a chain it has reached at each step
///
/// The probe is a linear regression for every supervision step and number of hops. It predicts the colour of the cube after that
/// number of hops from the latent state, in tasks such as PickChain. It is fitted to the beginnings of demonstrations, with
/// colours renamed at random, and tested on the beginnings of new episodes. An untrained network of the same shape shows what
/// the observation alone reveals.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo probe pickchain-actrm --data out/robots/pickchain.hdf5
  actrm-zoo probe pickchain-actrm --data out/robots/pickchain.hdf5 --steps 12 --out probe.json")]
pub struct Args {
    /// Entry: `name` (its newest version) or `name@version`
    #[arg(add = entry_names())]
    entry: String,
    /// Demonstrations of the entry: an HDF5 file or a data set
    #[arg(long, value_name = "PATH")]
    data: PathBuf,
    /// Supervision steps [default: the entry's largest number]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1000))]
    steps: Option<u64>,
    /// Number of random colour renamings of each demonstration
    #[arg(long, value_name = "N", default_value_t = 16, value_parser = clap::value_parser!(u64).range(1..=1000))]
    renamings: u64,
    /// New episodes to test on
    #[arg(long, short = 'n', value_name = "N", default_value_t = 400, value_parser = limits::episodes)]
    episodes: u64,
    /// Seed of the first new episode; the seeds after it count up
    #[arg(long = "seed-start", value_name = "SEED", default_value_t = 30_000)]
    seed: u64,
    #[command(flatten)]
    simulator: SimulatorArgs,
    /// Folder that an HDF5 file is converted into
    #[arg(long, value_name = "DIR", default_value = "out/probe")]
    work: PathBuf,
    /// Also write the result to this file
    #[arg(long, short, value_name = "FILE")]
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
    let _parents = args.out.as_deref().map(cli::new_file).transpose()?;
    let meta = loaded.entry().meta();
    let environment = drawn(&args.simulator, None, meta)?;
    let stop = Stop::install("stopped")?;
    let spec = worker(&environment, &args.simulator, Control::Compiled)?;
    let Some(mut pool) = args.simulator.start(spec, None, &stop)? else { return Ok(ExitCode::from(INTERRUPTED)) };
    let seeds = Seeds { start: args.seed, count: args.episodes };
    let ready = pool.ready().clone();
    let fresh = starts(&meta.keys, &mut pool, &seeds.iter().collect::<Vec<_>>())?;
    cli::close(pool);
    let Some(fresh) = fresh else { return Ok(ExitCode::from(INTERRUPTED)) };
    let result = probe(&request, &ready, seeds, &fresh)?;
    match args.json {
        true => cli::print_json(&result)?,
        false => cli::print(&tables(&result))?,
    }
    if let Some(path) = &args.out {
        result.write(path)?;
        cli::note(&shown(path));
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
