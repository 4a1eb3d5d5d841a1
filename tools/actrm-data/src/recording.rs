//! What the commands that run the simulator share: cameras, and what its workers record as a demo in robomimic's layout.

use anyhow::{Context, Result, bail};
use dataset::{Array, Demo, Dtype};
use rollout::{FrameTensor, RecordedEpisode, WorkerSpec};
use std::path::Path;

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

impl CameraArgs {
    /// Has a worker draw what these cameras see.
    pub fn set(&self, spec: &mut WorkerSpec) {
        spec.cameras.clone_from(&self.cameras);
        spec.image_size = usize::from(self.size);
    }
}

/// Refuses to begin long work whose result would have no place.
pub fn refuse_existing(out: &Path) -> Result<()> {
    match out.symlink_metadata() {
        Ok(_) => Err(dataset::DatasetError::OutputExists { path: out.to_owned() }.into()),
        Err(_) => Ok(()),
    }
}

/// Removes the unfinished files that a writer of `out` keeps beside it.
pub fn remove_unfinished(out: &Path) {
    let folder = out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let begins = format!(".{}.", out.file_name().unwrap_or_default().to_string_lossy());
    let Ok(items) = std::fs::read_dir(folder) else { return };
    for item in items.flatten() {
        let name = item.file_name();
        let name = name.to_string_lossy();
        if name.starts_with(&begins) && name.ends_with(".part") {
            // what stays is as a killed program leaves it
            let _ = std::fs::remove_file(item.path());
        }
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
