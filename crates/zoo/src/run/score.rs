//! How far an entry's actions are from those of demonstrations, without a simulator.

use std::path::{Path, PathBuf};

use dataset::WindowBatch;
use models::{ACTION, Backend, Observation, PolicyConfig, Values};
use serde::Serialize;

use crate::ZooError;
use crate::conventions::Conventions;
use crate::entry::LoadedEntry;
use crate::transforms::unreadable;

use super::agreement::agree;
use super::data::{self, ImageMemory};
use super::preflight::image_budget;

/// Windows gathered at once.
const BATCH: usize = 64;

/// What is scored on what.
pub struct ScoreRequest<'a> {
    /// The entry.
    pub entry: &'a LoadedEntry,
    /// Demonstrations: an HDF5 file or a data set.
    pub data: &'a Path,
    /// Where an HDF5 file is converted to.
    pub work: &'a Path,
    /// Mask of the episodes; where none is given, that of the entry's validation if the data set has it, else all episodes.
    pub mask: Option<&'a str>,
    /// Windows at most, evenly spread.
    pub most: usize,
    /// Score although the data set is of another task, or its dimensions have other names.
    pub force: bool,
}

/// Errors of actions, in the units of the data.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Score {
    /// The entry.
    pub entry: String,
    /// Name of the demonstrations.
    pub data: String,
    /// The mask that chose the episodes; none for all.
    pub mask: Option<String>,
    /// Episodes.
    pub episodes: u64,
    /// Queries of the policy.
    pub queries: u64,
    /// What the data set calls the dimensions of an action.
    pub names: Vec<String>,
    /// Mean absolute error over all dimensions and steps.
    pub mean: f64,
    /// Mean absolute errors: a row for each step of the chunk, in it the dimensions of an action.
    pub errors: Vec<Vec<f64>>,
    /// Actions behind each row of `errors`: those that the episode still had.
    pub counts: Vec<u64>,
    /// What a user should know.
    pub notes: Vec<String>,
}

impl Score {
    /// Mean absolute error of each dimension, over all actions.
    pub fn of_dimensions(&self) -> Vec<f64> {
        let all: u64 = self.counts.iter().sum();
        let rows = || self.errors.iter().zip(&self.counts);
        (0..self.names.len())
            .map(|dim| rows().map(|(row, count)| row[dim] * *count as f64).sum::<f64>() / all.max(1) as f64)
            .collect()
    }

    /// Mean absolute error of each step of the chunk, over all dimensions.
    pub fn of_steps(&self) -> Vec<f64> {
        self.errors.iter().map(|row| row.iter().sum::<f64>() / row.len().max(1) as f64).collect()
    }
}

/// Asks the policy at the steps of demonstrations and compares its chunks with the actions that follow there. Every query begins
/// an episode of its own with seed 0.
///
/// # Errors
/// A data set that cannot be read or is of other conventions, keys or names, by name; a policy that fails; no episodes.
pub fn score(request: &ScoreRequest<'_>) -> Result<Score, ZooError> {
    let (loaded, path) = (request.entry, data::locate(request.data)?);
    let (meta, id) = (loaded.entry().meta(), loaded.entry().id().to_string());
    let unfit = |reason: String| ZooError::UnfitData { path: path.clone(), reason };
    if loaded.model().is_scripted() {
        return Err(unfit(format!("entry {id}: its expert acts inside the simulator and predicts nothing")));
    }
    std::fs::create_dir_all(request.work).map_err(ZooError::io("create folder", request.work))?;
    let mut experiment = loaded.experiment().clone();
    let (dataset, mut notes) = data::open(&path, request.work, &experiment, &mut |_, _| {})?;
    if let Some(env) = dataset.env() {
        let said = Conventions::of_env_args(&env.env_args).without(&["image_size"]);
        loaded.conventions().check(&said, &path.display().to_string(), &id, &meta.task)?;
    }
    let held_out = Some(experiment.data.valid_mask.clone()).filter(|mask| dataset.split(mask).is_some());
    let mask = request.mask.map(str::to_owned).or(held_out);
    (experiment.data.train_mask, experiment.data.valid_mask) = (mask.clone().unwrap_or_default(), String::new());
    let agreed = agree(&dataset, &path, &experiment, request.force)?;
    let memory = ImageMemory { budget: image_budget(), folder: request.work, device: &Backend::CPU };
    let name = path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    let demonstrations = data::prepare(&dataset, &path, &name, &agreed, &memory)?;
    let windows = &demonstrations.train;
    if demonstrations.preprocess.signature().observation != meta.signature.observation {
        let text = |signature: &models::Signature| {
            let specs = signature.observation.iter().map(|spec| format!("{} {:?}", spec.name, spec.shape));
            specs.collect::<Vec<_>>().join(", ")
        };
        let (expected, found) = (text(&meta.signature), text(demonstrations.preprocess.signature()));
        return Err(unfit(format!("entry {id}: features: expected {expected}, found {found}")));
    }
    let trained = meta.data.as_ref().and_then(|data| data.train_fingerprint.as_ref());
    if trained == demonstrations.meta.train_fingerprint.as_ref() && trained.is_some() {
        notes.push(format!("entry {id} was trained on these episodes"));
    } else if meta.data.as_ref().is_some_and(|data| data.fingerprint == dataset.fingerprint()) {
        let all = || (0..dataset.episodes().len()).collect::<Vec<_>>();
        let of = |mask: &str| dataset.split(mask).unwrap_or_else(all);
        let (learned, asked) = (of(&loaded.experiment().data.train_mask), of(mask.as_deref().unwrap_or_default()));
        let both = asked.iter().filter(|episode| learned.contains(episode)).count();
        if both > 0 {
            notes.push(format!("entry {id} was trained on {both} of these {} episodes", asked.len()));
        }
    }
    let past = experiment.policy.past_actions(experiment.data.n_obs_steps);
    let (horizon, dim) = (windows.action_horizon() - past, windows.action_dim());
    if windows.is_empty() || dim != meta.signature.action_dim {
        return Err(unfit(format!("entry {id}: action: expected {} numbers, found {dim}", meta.signature.action_dim)));
    }
    let stride = windows.len().div_ceil(request.most.max(1)).max(1);
    let indices: Vec<u32> = (0..windows.len()).step_by(stride).map(|at| at as u32).collect();
    let (mut sums, mut counts) = (vec![vec![0.0; dim]; horizon], vec![0_u64; horizon]);
    let mut policy = loaded.policy();
    // what a query leaves behind is all that it knows of the past
    let carries = matches!(experiment.policy, PolicyConfig::BcRnn(_));
    let mut batch = WindowBatch::default();
    for chunk in indices.chunks(BATCH) {
        windows.try_gather(chunk, &mut batch).map_err(unreadable(&demonstrations.meta.name))?;
        for at in 0..batch.n {
            policy.reset(0);
            let failed = |source| loaded.failed("ask", source);
            let last = batch.n_obs_steps - 1;
            for seen in (0..last).map(|step| observation(&batch, at, step)) {
                match carries {
                    true => drop(policy.predict(&seen).map_err(failed)?),
                    false => policy.observe(&seen),
                }
            }
            let predicted = policy.predict(&observation(&batch, at, last)).map_err(failed)?;
            let first = at * (past + horizon) + past;
            for step in (0..horizon.min(predicted.action_horizon)).filter(|step| !batch.is_pad[first + step]) {
                let shown = &batch.actions[(first + step) * dim..][..dim];
                let own = &predicted.actions[step * dim..][..dim];
                for (sum, (own, shown)) in sums[step].iter_mut().zip(own.iter().zip(shown)) {
                    *sum += f64::from((own - shown).abs());
                }
                counts[step] += 1;
            }
        }
    }
    let reached = counts.iter().rposition(|count| *count > 0).map_or(0, |last| last + 1);
    sums.truncate(reached);
    counts.truncate(reached);
    let all: u64 = counts.iter().sum();
    let mean = sums.iter().flatten().sum::<f64>() / (all as f64 * dim as f64);
    let errors = sums.iter().zip(&counts).map(|(row, n)| row.iter().map(|sum| sum / *n as f64).collect()).collect();
    let stated = dataset.names(ACTION);
    let names = if stated.len() == dim { stated } else { (0..dim).map(|at| at.to_string()).collect() };
    notes.extend(agreed.notes);
    Ok(Score {
        entry: id,
        data: demonstrations.meta.name.clone(),
        mask: mask.filter(|mask| !mask.is_empty()),
        episodes: demonstrations.meta.train_episodes,
        queries: indices.len() as u64,
        names,
        mean,
        errors,
        counts,
        notes,
    })
}

/// One observation of a window, in the units of the data.
fn observation(batch: &WindowBatch, window: usize, step: usize) -> Observation {
    let row = window * batch.n_obs_steps + step;
    let rows = batch.n * batch.n_obs_steps;
    let numbers = batch.observation.iter().map(|(name, all)| {
        let width = all.len() / rows;
        (name.clone(), Values::F32(all[row * width..][..width].to_vec()))
    });
    let pictures = batch.pictures.iter().map(|(name, all)| {
        let width = all.len() / rows;
        (name.clone(), Values::U8(all[row * width..][..width].to_vec()))
    });
    numbers.chain(pictures).collect()
}

/// The folder in which an entry's scores convert HDF5 files, one for each file.
///
/// # Errors
/// A file that cannot be read.
pub fn score_folder(work: &Path, data: &Path) -> Result<PathBuf, ZooError> {
    let data = data::locate(data)?;
    Ok(if data::is_set(&data) { work.to_owned() } else { work.join(data::short_hash(&data)?) })
}
