//! What the commands that run the simulator share: their options, its start and end, and what its workers record as a
//! demo in robomimic's layout.

use anyhow::{Context, Result, bail};
use dataset::{Array, Demo, Dtype};
use rollout::{FrameTensor, Pool, PoolOptions, RecordedEpisode, WorkerSpec};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Exit code of a program that an interrupt ended, as shells have it.
pub const INTERRUPTED: u8 = 130;

/// Options of every command that runs the simulator.
#[derive(clap::Args)]
pub struct SimulatorArgs {
    /// Simulators at once [default: one a core]
    #[arg(long)]
    pub workers: Option<usize>,
    /// Python module of your own that registers environments
    #[arg(long, value_name = "MODULE")]
    pub env_module: Option<String>,
    /// Python with robosuite [default: $ACTRM_PYTHON, else .venv/bin/python here or above, else python3]
    #[arg(long)]
    pub python: Option<PathBuf>,
}

/// Cameras whose images are observed, and their size.
#[derive(clap::Args)]
pub struct CameraArgs {
    /// Cameras to render
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    pub cameras: Vec<String>,
    /// Side of the images, in pixels
    #[arg(long, default_value_t = 84, value_parser = clap::value_parser!(u16).range(1..=4096))]
    pub size: u16,
}

impl SimulatorArgs {
    /// The Python to use.
    pub fn python(&self) -> Result<rollout::Python> {
        Ok(rollout::find_python(self.python.as_deref())?)
    }

    /// Starts the workers. Ctrl-C sets `stop`; a second one ends the program at once.
    pub fn start(&self, task: &str, cameras: &[String], size: u16, stop: &Arc<AtomicBool>) -> Result<Pool> {
        let raise = Arc::clone(stop);
        ctrlc::set_handler(move || {
            if raise.swap(true, Ordering::SeqCst) {
                std::process::exit(i32::from(INTERRUPTED));
            }
        })
        .context("cannot catch ctrl-C")?;
        let mut spec = WorkerSpec::new(self.python()?, rollout::harness_folder()?, task);
        spec.cameras = cameras.to_vec();
        spec.image_size = usize::from(size);
        spec.env_module.clone_from(&self.env_module);
        let workers = self.workers.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from));
        let stop = Arc::clone(stop);
        let stopped = Arc::new(move || stop.load(Ordering::SeqCst));
        let pool = Pool::start(PoolOptions { stop: stopped, ..PoolOptions::new(spec, workers) })?;
        if let Some(why) = pool.fallback() {
            eprintln!("note: {why}");
        }
        Ok(pool)
    }
}

/// Says what went wrong on the way, and ends the workers.
pub fn close(pool: Pool) {
    for incident in pool.incidents() {
        eprintln!("note: {}", incident.text);
    }
    pool.close();
}

/// Refuses to begin long work whose result would have no place.
pub fn refuse_existing(out: &Path) -> Result<()> {
    match out.symlink_metadata() {
        Ok(_) => Err(dataset::DatasetError::OutputExists { path: out.to_owned() }.into()),
        Err(_) => Ok(()),
    }
}

/// A demo in robomimic's layout from what a worker recorded.
pub fn demo(id: &str, episode: RecordedEpisode, next_obs: bool) -> Result<Demo> {
    let mut demo = Demo { id: id.to_owned(), ..Demo::default() };
    for (name, value) in &episode.attrs {
        let text = match value {
            serde_json::Value::String(text) => text.clone(),
            other => other.to_string(),
        };
        demo.attrs.insert(name.clone(), Array::from_str(&text));
    }
    let steps = i64::try_from(episode.steps).context("number of steps")?;
    demo.attrs.insert("num_samples".to_owned(), Array::from_i64(Vec::new(), &[steps]));
    for (name, tensor) in episode.tensors {
        if next_obs || !name.starts_with("next_obs/") {
            let array = array(&name, tensor)?;
            demo.datasets.insert(name, array);
        }
    }
    Ok(demo)
}

fn array(name: &str, tensor: FrameTensor) -> Result<Array> {
    use safetensors::Dtype as Wire;
    let dtype = match tensor.dtype {
        Wire::F64 => Dtype::F64,
        Wire::F32 => Dtype::F32,
        Wire::I64 => Dtype::I64,
        Wire::U8 => Dtype::U8,
        Wire::BOOL => Dtype::Bool,
        other => bail!("{name}: a worker sent {other:?}, expected numbers that HDF5 files of demonstrations hold"),
    };
    Ok(Array { dtype, shape: tensor.shape, bytes: tensor.bytes })
}

/// What a demo holds that a simulator can be put into: states, actions, the model and what else the episode needs.
pub struct Recording {
    pub model: String,
    pub ep_meta: serde_json::Value,
    pub states: FrameTensor,
    pub actions: FrameTensor,
}

impl Recording {
    /// Of a demo that was read with `states` and `actions`.
    pub fn of(demo: &Demo) -> Result<Self> {
        let text = |name: &str| demo.attrs.get(name).and_then(Array::to_text);
        let ep_meta = match text("ep_meta") {
            Some(text) => serde_json::from_str(&text).with_context(|| format!("{}: attribute ep_meta", demo.id))?,
            None => serde_json::Value::Null,
        };
        let tensor = |key: &str| {
            let array = demo.datasets.get(key).with_context(|| format!("{}: no {key}", demo.id))?;
            let values = array.to_f64().with_context(|| format!("{}: {key}: expected numbers", demo.id))?;
            Ok::<_, anyhow::Error>(FrameTensor::from_f64(&array.shape, &values))
        };
        Ok(Self {
            model: text("model_file").unwrap_or_default(),
            ep_meta,
            states: tensor("states")?,
            actions: tensor("actions")?,
        })
    }
}
