//! The demonstrations of a run: found, converted if need be, split and normalised.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use candle_core::{Device, Tensor};
use dataset::{ConvertOptions, Dataset, FeatureStats, PictureStore, Pictures, WindowBatch, WindowSpec, Windows};
use models::{
    Backend, Batch, ENTITY_PREFIX, ENVIRONMENT_STATE, FeatureSpec, Features, ModelError, Normaliser, Preprocess, STATE,
    Signature, ValuesRef,
};

use crate::ZooError;
use crate::entry::DataMeta;
use crate::experiment::{DataSection, EntitySection, Experiment, IMAGE_PREFIX};
use crate::transforms::{self, Source, Stage, Transforms, is_auxiliary};

use super::agreement::{Agreed, agree, takes_keys};
use super::preflight::image_budget;

/// Folder of the run that a converted HDF5 file goes to.
pub(super) const CONVERTED: &str = "data";

/// Finds `path`: as given, or, when relative, above the current folder or the program.
///
/// # Errors
/// [`ZooError::DataNotFound`] with every place looked at.
pub fn locate(path: &Path) -> Result<PathBuf, ZooError> {
    let mut roots: Vec<PathBuf> = Vec::new();
    if let Ok(here) = std::env::current_dir() {
        roots.extend(here.ancestors().map(Path::to_owned));
    }
    if let Ok(program) = std::env::current_exe() {
        roots.extend(program.ancestors().skip(1).map(Path::to_owned));
    }
    locate_from(path, &roots)
}

fn locate_from(path: &Path, roots: &[PathBuf]) -> Result<PathBuf, ZooError> {
    let mut tried: Vec<String> = Vec::new();
    let candidates = match path.is_absolute() {
        true => vec![path.to_owned()],
        false => roots.iter().map(|root| root.join(path)).collect(),
    };
    for candidate in candidates {
        if candidate.exists() {
            return Ok(candidate);
        }
        let text = candidate.display().to_string();
        if !tried.contains(&text) {
            tried.push(text);
        }
    }
    Err(ZooError::DataNotFound { path: path.to_owned(), tried })
}

/// Whether `path` is a data set: anything else is recordings, in a file or in a folder of files, that are converted first.
pub(super) fn is_set(path: &Path) -> bool {
    path.join("meta/info.json").exists()
}

/// Begins the hash of recordings, or of a data set.
///
/// # Errors
/// Files that cannot be read.
pub fn short_hash(path: &Path) -> Result<String, ZooError> {
    let failed = |source| ZooError::Dataset { path: path.to_owned(), source: Box::new(source) };
    let mut hash = match path.is_dir() {
        true if is_set(path) => Dataset::open(path).map_err(failed)?.fingerprint().to_owned(),
        true => dataset::source_hash(path).map_err(failed)?,
        false => crate::sha256_file(path)?,
    };
    hash.truncate(8);
    Ok(hash)
}

/// Opens a LeRobotDataset folder, or converts recordings into the run's folder and opens that; with what the conversion noted.
///
/// # Errors
/// What `dataset` refuses.
pub(super) fn open(
    path: &Path,
    run: &Path,
    experiment: &Experiment,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<(Dataset, Vec<String>), ZooError> {
    let opened = |folder: PathBuf| {
        let dataset =
            Dataset::open(&folder).map_err(|source| ZooError::Dataset { path: folder, source: Box::new(source) })?;
        Ok((dataset, Vec::new()))
    };
    if is_set(path) {
        return opened(path.to_owned());
    }
    let folder = run.join(CONVERTED);
    if folder.exists() {
        // an earlier session's conversion, of this file or of another
        let (dataset, notes) = opened(folder)?;
        let expected = dataset.provenance().map_or_else(String::new, |p| p.source_sha256.clone());
        let found = dataset::source_hash(path)
            .map_err(|source| ZooError::Dataset { path: path.to_owned(), source: Box::new(source) })?;
        if expected != found {
            let (folder, what) = (run.to_owned(), "data set".to_owned());
            return Err(ZooError::ResumeMismatch { folder, what, expected, found });
        }
        return Ok((dataset, notes));
    }
    let keys = match lacks_usual_keys(path, experiment) {
        false => Some((experiment.data.state_keys.clone(), experiment.data.env_keys.clone())),
        // as `convert` does by itself; the experiment takes them over
        true => None,
    };
    let (state_keys, env_keys) = keys.unzip();
    let options = ConvertOptions {
        state_keys,
        env_keys,
        entities: experiment.data.columns().map(|(_, name, keys)| (name.to_owned(), keys.clone())).collect(),
        // no policy reads it
        depth: false,
        ..ConvertOptions::default()
    };
    let converted = dataset::convert(path, &folder, &options, progress)
        .map_err(|source| ZooError::Dataset { path: path.to_owned(), source: Box::new(source) })?;
    Ok((opened(folder)?.0, converted.notes))
}

/// Whether recordings, for a task that no simulator has, lack the keys that experiments have by default.
fn lacks_usual_keys(path: &Path, experiment: &Experiment) -> bool {
    let (data, usual) = (&experiment.data, DataSection::default());
    if !takes_keys(experiment) || data.state_keys != usual.state_keys {
        return false;
    }
    let Ok(source) = dataset::Source::open(path) else { return false };
    let Some(demo) = source.plan().demos.first() else { return false };
    usual.state_keys.iter().any(|key| !demo.keys.contains_key(&format!("obs/{key}")))
}

/// The data set that a training of `experiment` on `path` reads, and its folder: `path` itself, or what recordings are
/// converted to, below `work`.
///
/// # Errors
/// [`ZooError::DataNotFound`], and what `dataset` refuses.
pub fn demonstrations(
    path: &Path,
    work: &Path,
    experiment: &Experiment,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<(PathBuf, Dataset), ZooError> {
    let path = locate(path)?;
    if is_set(&path) {
        let (dataset, _) = open(&path, work, experiment, progress)?;
        return Ok((path, dataset));
    }
    // a folder for each file: another one may be tried in the same place
    let folder = work.join(format!("demonstrations-{}", short_hash(&path)?));
    std::fs::create_dir_all(&folder).map_err(ZooError::io("create folder", &folder))?;
    let (dataset, _) = open(&path, &folder, experiment, progress)?;
    Ok((folder.join(CONVERTED), dataset))
}

/// What pictures may take, and where those go that would take more.
pub(super) struct ImageMemory<'a> {
    pub budget: u64,
    pub folder: &'a Path,
    /// Where batches are made; a GPU keeps pictures itself, if they fit and no transform changes them.
    pub device: &'a Backend,
}

fn gigabytes(bytes: u64) -> String {
    format!("{:.2} GB", bytes as f64 / 1e9)
}

/// Windows to train and to validate on, with the statistics of the episodes trained on.
pub(super) struct Demonstrations {
    pub train: Windows,
    pub valid: Option<Windows>,
    pub preprocess: Preprocess,
    pub transforms: Transforms,
    /// Mean and standard deviation of each camera's colours, on the scale from 0 to 1, where the data set has them.
    pub image_statistics: Option<Vec<([f32; 3], [f32; 3])>>,
    /// By camera the pictures of all frames that a GPU keeps: (frames, height, width, 3) bytes.
    pub on_device: Features<Tensor>,
    pub meta: DataMeta,
    /// What a user should know: a missing mask, constant dimensions.
    pub notes: Vec<String>,
}

/// Splits a data set by the experiment's masks and takes the statistics of the training episodes. `stored` is the set as it is in
/// its files, `agreed` what is read of it.
pub(super) fn prepare(
    stored: &Dataset,
    path: &Path,
    name: &str,
    agreed: &Agreed,
    memory: &ImageMemory<'_>,
) -> Result<Demonstrations, ZooError> {
    let Agreed { dataset, experiment, .. } = agreed;
    let unfit = |reason: String| ZooError::UnfitData { path: path.to_owned(), reason };
    let failed = |source| ZooError::Dataset { path: path.to_owned(), source: Box::new(source) };
    let mut notes = dataset.notes().to_vec();
    let all: Vec<usize> = (0..dataset.episodes().len()).collect();
    let usual = DataSection::default();
    let mask = &experiment.data.train_mask;
    let there = dataset.split_names();
    let train = match dataset.split(mask) {
        Some(episodes) => episodes,
        None if mask.is_empty() => all,
        None if *mask != usual.train_mask || !there.is_empty() => {
            return Err(unfit(no_mask("train_mask", mask, &there)));
        }
        None => {
            notes.push(format!("no mask `{mask}`: training on all {} episodes", all.len()));
            all
        }
    };
    if train.is_empty() {
        return Err(unfit(format!("mask `{mask}`: expected at least one episode, found none")));
    }
    let held_out = &experiment.data.valid_mask;
    let valid: Vec<usize> = match dataset.split(held_out) {
        Some(episodes) => episodes,
        None if held_out.is_empty() => Vec::new(),
        None if *held_out != usual.valid_mask || there.iter().any(|name| name != mask) => {
            return Err(unfit(no_mask("valid_mask", held_out, &there)));
        }
        None => {
            notes.push(format!("no mask `{held_out}`: no episode is held out for validation"));
            Vec::new()
        }
    };
    notes.extend(dataset.provenance().map_or_else(Vec::new, |provenance| provenance.mask_notes()));
    if valid.is_empty() && dataset.split(held_out).is_some() {
        notes.push(format!("mask `{held_out}` names no episode: none is held out for validation"));
    }
    if let Some(both) = valid.iter().find(|episode| train.contains(episode)) {
        return Err(unfit(format!(
            "masks `{mask}` and `{}` share episode {both}: a validation on training data says nothing; \
             set data.valid_mask=\"\" to train without validation",
            held_out
        )));
    }

    let observation = observed(dataset, experiment);
    let used: Vec<usize> = train.iter().chain(&valid).copied().collect();
    for column in observation.iter().map(String::as_str).chain([dataset::ACTION]) {
        if let Some(found) = dataset.not_finite(column, &used).first() {
            return Err(unfit(format!(
                "{found}: training needs finite values (convert --skip-bad leaves such demos out)"
            )));
        }
    }
    let mut statistics = dataset.statistics_of(&train).map_err(failed)?;
    for columns in groups(&experiment.data.entities) {
        let pooled = dataset.pooled_statistics(&columns, &train).map_err(failed)?;
        statistics.extend(pooled.into_iter().flat_map(|stats| columns.iter().map(move |c| (c.clone(), stats.clone()))));
    }
    let statistics = tensors(&statistics).map_err(|e| unfit(e.to_string()))?;
    let action_horizon = experiment.policy.action_horizon();
    let windows = |episodes: Vec<usize>| {
        let mut spec = WindowSpec {
            observation: observation.clone(),
            n_obs_steps: experiment.data.n_obs_steps,
            action_horizon,
            episodes,
            mistakes: false,
        };
        transforms::select(&experiment.data, &mut spec);
        let past = experiment.policy.past_actions(experiment.data.n_obs_steps);
        dataset.windows(&spec).map(|windows| windows.with_past_actions(past)).map_err(failed)
    };
    let meta = DataMeta {
        name: name.to_owned(),
        fingerprint: dataset.fingerprint().to_owned(),
        train_fingerprint: Some(stored.fingerprint_of(&train)),
        train_episodes: train.len() as u64,
        train_frames: train.iter().map(|e| dataset.episodes()[*e].length as u64).sum(),
        valid_episodes: valid.len() as u64,
        seeds: dataset.env().and_then(|env| env.seeds.as_deref()?.parse().ok()),
        expert: dataset.env().and_then(|env| env.expert.clone()),
        skill: dataset.env().and_then(|env| env.skill.clone()),
        names: agreed.names.clone(),
    };
    let mut train = windows(train)?;
    let mut valid = match valid.is_empty() {
        true => None,
        false => Some(windows(valid)?),
    };
    let mut image_statistics = Vec::new();
    let cameras: Vec<String> = experiment.data.cameras.iter().map(|camera| format!("{IMAGE_PREFIX}{camera}")).collect();
    let each =
        cameras.iter().map(|name| dataset.decoded_bytes(name)).collect::<Result<Vec<u64>, _>>().map_err(failed)?;
    let bytes = each.iter().sum::<u64>();
    let fits = bytes <= memory.budget;
    if !fits {
        let (bytes, budget) = (gigabytes(bytes), gigabytes(memory.budget));
        notes.push(format!(
            "images take {bytes}, {budget} are for them: kept in a file in the run's folder, read ahead"
        ));
    }
    let data = &experiment.data;
    let unchanged = data.mirror.is_empty() && data.symmetries.is_empty() && data.picture_colours.is_empty();
    let free = memory.device.free_bytes();
    // candle's kernel that gathers them counts in 32 bits
    let counted = each.iter().all(|bytes| *bytes < 1 << 32);
    let resident = fits && unchanged && counted && free.is_some_and(|free| bytes <= free / 2);
    let mut on_device = Features::new();
    for name in cameras {
        let pictures: PictureStore = match fits {
            true if resident => {
                let pictures = dataset.pictures(&name).map_err(failed)?;
                let (height, width) = (pictures.height, pictures.width);
                on_device.insert(&name, placed(pictures, memory.device.device()).map_err(|e| unfit(e.to_string()))?);
                PictureStore::Elsewhere(height, width)
            }
            true => Arc::new(dataset.pictures(&name).map_err(failed)?).into(),
            false => dataset.picture_file(&name, memory.folder).map_err(failed)?.into(),
        };
        train = train.with_pictures(&name, pictures.clone());
        valid = valid.map(|valid| valid.with_pictures(&name, pictures));
        image_statistics.push(dataset.stats().get(&name).and_then(colours));
    }
    let signature = signature(&train, experiment);
    let modes = experiment.normalisation.modes(&signature);
    let mut normaliser =
        Normaliser::new(&modes, &statistics).map_err(experiment.model_error("take the statistics for"))?;
    for guarded in normaliser.guard_constant(!(data.mirror.is_empty() && data.symmetries.is_empty())) {
        notes.push(format!(
            "{}[{}] is constant (spread {:e}): normalised to 0",
            guarded.feature, guarded.dim, guarded.spread
        ));
    }
    let preprocess = Preprocess::new(signature, normaliser, memory.device.device())
        .map_err(experiment.model_error("take the statistics for"))?;
    let signature = preprocess.signature();
    let source = Source { experiment, dataset, path, windows: &train, statistics: &statistics, signature };
    let transforms = Transforms::fit(&source)?;
    let image_statistics = image_statistics.into_iter().collect();
    Ok(Demonstrations { train, valid, preprocess, transforms, image_statistics, on_device, meta, notes })
}

impl Demonstrations {
    /// Windows as a batch in network units, with the data transforms of the stage. The windows are changed.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn batch(&self, stage: Stage, windows: &mut WindowBatch, experiment: &Experiment) -> Result<Batch, ZooError> {
        self.transforms.apply(stage, windows);
        let numbers = windows.observation.iter().map(|(name, values)| (name.clone(), ValuesRef::F32(values)));
        let images = windows.pictures.iter().filter(|(name, _)| self.on_device.get(name).is_none());
        let images = images.map(|(name, values)| (name.clone(), ValuesRef::U8(values)));
        let observation = numbers.chain(images).collect();
        let action_horizon = experiment.policy.action_horizon();
        let made = seen_on_device(&self.on_device, self.preprocess.signature(), windows).and_then(|placed| {
            self.preprocess.batch_with(action_horizon, &observation, &placed, &windows.actions, &windows.is_pad)
        });
        let made = made.and_then(|mut batch| {
            self.transforms.targets(stage, windows, &mut batch)?;
            Ok(batch)
        });
        made.map_err(experiment.model_error("make a batch for"))
    }
}

/// By camera the pictures of these windows, of those that a GPU keeps: (frames, height, width, 3) -> (n, …, height, width, 3)
fn seen_on_device(
    pictures: &Features<Tensor>,
    signature: &Signature,
    windows: &WindowBatch,
) -> Result<Features<Tensor>, ModelError> {
    let Some((_, any)) = pictures.iter().next() else { return Ok(Features::new()) };
    let frames = Tensor::from_slice(&windows.frames, windows.frames.len(), any.device())?;
    let mut seen = Features::new();
    for (name, pictures) in pictures.iter() {
        if let Some(spec) = signature.get(name) {
            let shape = signature.batch_shape(spec, windows.n);
            seen.insert(name, pictures.index_select(&frames, 0)?.reshape(shape)?);
        }
    }
    Ok(seen)
}

/// Pictures on a device: (frames, height, width, 3)
fn placed(pictures: Pictures, device: &Device) -> candle_core::Result<Tensor> {
    let (height, width) = (pictures.height, pictures.width);
    let frames = pictures.data.len() / (height * width * 3).max(1);
    Tensor::from_vec(pictures.data, (frames, height, width, 3), device)
}

/// The windows of the episodes that a training of `experiment` learns from, its data transforms, and the number of each episode's
/// first window; an episode that begins with a marked mistake has none. An HDF5 file is converted into `work`.
///
/// # Errors
/// What a training would refuse.
pub fn first_windows(
    path: &Path,
    work: &Path,
    experiment: &Experiment,
) -> Result<(Windows, Transforms, Vec<u32>), ZooError> {
    std::fs::create_dir_all(work).map_err(ZooError::io("create folder", work))?;
    let (dataset, _) = open(path, work, experiment, &mut |_, _| {})?;
    let all = || (0..dataset.episodes().len()).collect();
    let episodes: Vec<usize> = dataset.split(&experiment.data.train_mask).unwrap_or_else(all);
    let begins: BTreeSet<usize> = episodes.iter().map(|&episode| dataset.episodes()[episode].from).collect();
    let memory = ImageMemory { budget: image_budget(), folder: work, device: &Backend::CPU };
    // what an entry was trained on is not asked again
    let agreed = agree(&dataset, path, experiment, true)?;
    let demonstrations = prepare(&dataset, path, &path.display().to_string(), &agreed, &memory)?;
    let firsts = demonstrations.train.of_frames(|frame| begins.contains(&frame));
    Ok((demonstrations.train, demonstrations.transforms, firsts))
}

/// Mean and standard deviation of three colours.
fn colours(stats: &FeatureStats) -> Option<([f32; 3], [f32; 3])> {
    let three = |values: &[f64]| -> Option<[f32; 3]> {
        let values: [f32; 3] = values.iter().map(|&x| x as f32).collect::<Vec<_>>().try_into().ok()?;
        values.iter().all(|x| x.is_finite()).then_some(values)
    };
    Some((three(&stats.mean)?, three(&stats.std)?))
}

/// The columns that the experiment's observation is made of.
fn observed(dataset: &Dataset, experiment: &Experiment) -> Vec<String> {
    let mut columns = vec![STATE.to_owned()];
    // a set that LeRobot wrote may lack it
    if !experiment.data.env_keys.is_empty() && dataset.column(ENVIRONMENT_STATE).is_some() {
        columns.push(ENVIRONMENT_STATE.to_owned());
    }
    columns.extend(experiment.data.columns().map(|(_, name, _)| format!("{ENTITY_PREFIX}{name}")));
    columns
}

/// The columns of each group of entities.
fn groups(entities: &BTreeMap<String, EntitySection>) -> impl Iterator<Item = Vec<String>> + use<> {
    let mut groups: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for (name, entity) in entities {
        groups.entry(entity.group_of(name).to_owned()).or_default().push(format!("{ENTITY_PREFIX}{name}"));
    }
    groups.into_values()
}

/// What the windows show, as a policy sees it.
fn signature(windows: &Windows, experiment: &Experiment) -> Signature {
    let spec = |(column, width): (&str, usize)| match column {
        STATE => FeatureSpec::state(width),
        ENVIRONMENT_STATE => FeatureSpec::environment_state(width),
        column => {
            let name = column.strip_prefix(ENTITY_PREFIX).unwrap_or(column);
            let entity = experiment.data.entities.get(name).cloned().unwrap_or_default();
            FeatureSpec::entity(name, width, entity.group_of(name), entity.position)
        }
    };
    let colours = experiment.data.picture_colours.iter().map(|name| format!("{ENTITY_PREFIX}{name}"));
    let colours: Vec<String> = colours.collect();
    let pictures = windows.pictures();
    let pictures = pictures.map(|(camera, (h, w))| FeatureSpec::image(camera, h, w).in_colours(colours.clone()));
    let (told, seen): (Vec<_>, Vec<_>) = windows.observation().partition(|(column, _)| is_auxiliary(column));
    let observation = seen.into_iter().map(spec).chain(pictures).collect();
    let auxiliary_dim = told.iter().map(|(_, width)| width).sum();
    Signature { observation, n_obs_steps: windows.n_obs_steps(), action_dim: windows.action_dim(), auxiliary_dim }
}

/// A mask that was asked for and is not there.
fn no_mask(key: &str, mask: &str, there: &[&str]) -> String {
    let there = if there.is_empty() { "no mask".to_owned() } else { there.join(", ") };
    format!("data.{key}: no mask `{mask}`; there is {there} (data.{key}=\"\" asks for none)")
}

fn tensors(statistics: &BTreeMap<String, FeatureStats>) -> candle_core::Result<BTreeMap<String, Tensor>> {
    let mut tensors = BTreeMap::new();
    for (feature, stats) in statistics {
        for (name, values) in [("mean", &stats.mean), ("std", &stats.std), ("min", &stats.min), ("max", &stats.max)] {
            let values: Vec<f32> = values.iter().map(|v| *v as f32).collect();
            let tensor = Tensor::from_slice(&values, values.len(), &Device::Cpu)?;
            tensors.insert(format!("{feature}.{name}"), tensor);
        }
    }
    Ok(tensors)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_batch_has_the_pictures_of_its_frames() {
        let mut signature = Signature { n_obs_steps: 2, ..Signature::low_dimensional(1, 0, 1) };
        signature.observation.push(FeatureSpec::image("front", 1, 2));
        let pictures = Pictures { height: 1, width: 2, data: (0..5 * 6).collect() };
        let mut kept = Features::new();
        kept.insert("front", placed(pictures.clone(), &Device::Cpu).unwrap());
        let windows = WindowBatch { n: 3, n_obs_steps: 2, frames: vec![2, 2, 3, 4, 0, 1], ..WindowBatch::default() };
        let seen = seen_on_device(&kept, &signature, &windows).unwrap();
        let front = seen.get("front").unwrap();
        assert_eq!(front.dims(), [3, 2, 1, 2, 3]);
        let expected: Vec<u8> = windows.frames.iter().flat_map(|&f| pictures.frame(f as usize).to_vec()).collect();
        assert_eq!(front.flatten_all().unwrap().to_vec1::<u8>().unwrap(), expected);
    }

    #[test]
    fn a_folder_without_info_holds_recordings() {
        let root = tempfile::tempdir().unwrap();
        std::fs::write(root.path().join("a_demo.hdf5"), "").unwrap();
        assert!(!is_set(root.path()) && !is_set(&root.path().join("a_demo.hdf5")));
        assert_eq!(short_hash(&root.path().join("a_demo.hdf5")).unwrap(), "e3b0c442", "SHA-256 of nothing");
        std::fs::create_dir(root.path().join("meta")).unwrap();
        assert!(!is_set(root.path()), "zarr replay buffers have a group of this name");
        std::fs::write(root.path().join("meta/info.json"), "{}").unwrap();
        assert!(is_set(root.path()));
    }

    #[test]
    fn data_is_found_above_and_every_place_is_named() {
        let root = tempfile::tempdir().unwrap();
        let deep = root.path().join("a/b");
        std::fs::create_dir_all(&deep).unwrap();
        std::fs::create_dir_all(root.path().join("data")).unwrap();
        std::fs::write(root.path().join("data/x.hdf5"), "").unwrap();
        let roots: Vec<PathBuf> = deep.ancestors().take(3).map(Path::to_owned).collect();
        let found = locate_from(Path::new("data/x.hdf5"), &roots).unwrap();
        assert_eq!(found, root.path().join("data/x.hdf5"));
        let error = locate_from(Path::new("data/y.hdf5"), &roots).unwrap_err().to_string();
        for place in &roots {
            assert!(error.contains(&place.join("data/y.hdf5").display().to_string()), "{error}");
        }
        let error = locate_from(Path::new("/nonexistent/y.hdf5"), &roots).unwrap_err().to_string();
        assert_eq!(error, "data `/nonexistent/y.hdf5` not found; looked at /nonexistent/y.hdf5");
    }
}
