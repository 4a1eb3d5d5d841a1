use std::path::PathBuf;
use std::process::ExitCode;

use analysis::Saliency;
use anyhow::{Context, bail};
use cli::{INTERRUPTED, Screen, SimulatorArgs, Stop, shown};
use models::FeatureKind;
use rollout::Control;
use zoo::evaluation::FIRST_SEED;
use zoo::write_atomic;

use crate::places::{ZooArgs, entry_names};
use crate::simulation::{drawn, worker};

/// Show what an image policy looks at: images of an episode with the important regions in red, as PNG
///
/// Each region of an image is covered in turn, and the predicted actions are compared with those for the whole image. The file
/// has one column per query. For each camera it shows the image, and below it the image in grey with the regions in red that
/// change the actions most. The table has the change of the actions without each camera (mean over the chunk, in standard
/// deviations of the demonstrations' actions) and the place of the most important square.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo saliency lift-act-image-s1 --out saliency.png
  actrm-zoo saliency lift-act-image-s1 --seed 40007 --queries 4 --out queries.png")]
pub struct Args {
    /// Entry: `name` (its newest version) or `name@version`
    #[arg(add = entry_names())]
    entry: String,
    /// Seed of the episode
    #[arg(long, value_name = "SEED", default_value_t = FIRST_SEED)]
    seed: u64,
    /// Number of queries, evenly spread over the episode
    #[arg(long, value_name = "N", default_value_t = 6, value_parser = clap::value_parser!(u16).range(1..=100))]
    queries: u16,
    /// PNG file to write
    #[arg(long, short, value_name = "FILE.png")]
    out: PathBuf,
    /// Task, if not the entry's
    #[arg(long)]
    task: Option<String>,
    /// Control loop inside the simulator: `compiled` or `robosuite`
    #[arg(long, default_value_t = Control::Compiled)]
    control: Control,
    #[command(flatten)]
    simulator: SimulatorArgs,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let entry = args.zoo.registry().entry(&args.entry)?;
    let id = entry.id();
    if entry.meta().signature.of_kind(FeatureKind::Image).next().is_none() {
        let names: Vec<&str> = entry.meta().signature.observation.iter().map(|spec| spec.name.as_str()).collect();
        let seen = if names.is_empty() { "no observation".to_owned() } else { names.join(", ") };
        bail!("entry {id} is not an image policy; its inputs are {seen}");
    }
    let _parents = cli::new_file(&args.out)?;
    let loaded = entry.load()?;
    let subject = loaded.subject();
    let environment = drawn(&args.simulator, args.task.as_deref(), entry.meta())?;
    let stop = Stop::install("stopped")?;
    let SimulatorArgs { env_module, python, .. } = &args.simulator;
    let one = SimulatorArgs { workers: Some(1), env_module: env_module.clone(), python: python.clone() };
    let spec = worker(&environment, &one, args.control)?;
    let Some(mut pool) = one.start(spec, None, &stop)? else { return Ok(ExitCode::from(INTERRUPTED)) };
    let mut screen = Screen::new();
    let queries = usize::from(args.queries);
    let looked = analysis::saliency(&loaded, &subject, &mut pool, args.seed, queries, &mut screen.advance("looking"));
    drop(screen);
    cli::close(pool);
    let Some(looked) = looked.with_context(|| format!("entry {id}"))? else {
        return Ok(ExitCode::from(INTERRUPTED));
    };
    let file = looked.strip().to_png().with_context(|| format!("{}: cannot draw it", shown(&args.out)))?;
    write_atomic(&args.out, &file)?;
    match args.json {
        true => cli::print_json(&looked)?,
        false => cli::print(&text(&looked, &shown(&args.out)))?,
    }
    Ok(ExitCode::SUCCESS)
}

fn text(looked: &Saliency, out: &str) -> String {
    let how = if looked.success { "success" } else { "failure" };
    let Saliency { entry, task, seed, steps, .. } = looked;
    let mut text = format!("{entry} on {task}, seed {seed}: {how} after {steps} steps; {out}\n");
    let rows: Vec<Vec<String>> = looked
        .queries
        .iter()
        .flat_map(|query| query.cameras.iter().map(|camera| (query.step, camera)))
        .map(|(step, camera)| {
            let (row, column) = camera.place;
            let (whole, most) = (format!("{:.3}", camera.whole), format!("{:.3}", camera.most));
            vec![step.to_string(), camera.camera.clone(), whole, most, format!("{row}, {column}")]
        })
        .collect();
    let head = ["step", "camera", "without it", "without its best square", "which is at (row, column)"];
    text.push_str(&cli::table(&head, &rows, &[0, 2, 3]));
    text
}
