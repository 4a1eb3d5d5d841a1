//! `reference.safetensors`: observations, and the actions that the policy gave for them when its entry was sealed.
//!
//! Hashes say that the weights are the ones that were written. That they still mean the same in the program of today, on
//! this machine, only the policy's own answers say.

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{DType, Device, Tensor};
use models::{Backend, FeatureKind, FeatureSpec, Normaliser, Observation, Policy, Rng, Signature, Values};

use crate::evaluation::WallClock;
use crate::experiment::Experiment;
use crate::{ZooError, tensors};

use super::policy::assemble;
use super::{EntryId, LoadedEntry, REFERENCE_FILE};

/// Queries after the first observations, one step apart, in one episode.
const QUERIES: usize = 3;
/// Seed of the observations and of the episode.
const SEED: u64 = 0;
/// Name of the answers in the file.
const ACTION: &str = "action";
/// How far an action may be from the stored one, as a share of its size or of 1: what vectors of another length, or another
/// order of the same sums, make of a float.
const TOLERANCE: f32 = 1e-3;

/// How an entry's answers are beside those that were stored.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Repeats {
    /// None are stored: the entry is from before there were any, or thinks by the clock.
    NotStored,
    /// The same bits.
    Exactly,
    /// Not the same bits, nowhere further off than this.
    Within(f32),
}

/// What an entry with these weights is sealed with; nothing of one that thinks by the clock, whose answers are not the same
/// each time.
///
/// # Errors
/// Weights and statistics that do not fit, a prediction that fails.
pub fn reference(
    id: &EntryId,
    experiment: &Experiment,
    signature: &Signature,
    weights: &BTreeMap<String, Tensor>,
    statistics: &BTreeMap<String, Tensor>,
) -> Result<Option<Vec<u8>>, ZooError> {
    let (model, preprocess) = assemble(id, experiment, signature, weights, statistics, &Backend::CPU)?;
    if model.depends_on_time() {
        return Ok(None);
    }
    let failed =
        |source| ZooError::Model { operation: "ask for the reference output of", name: id.to_string(), source };
    let observations = drawn(signature, preprocess.normaliser()).map_err(|e| failed(e.into()))?;
    let mut policy = model.policy(preprocess, Box::new(WallClock::new()));
    let actions = answers(policy.as_mut(), &observations, signature).map_err(failed)?;
    let mut contents = observations;
    contents.insert(ACTION.to_owned(), actions);
    let about = serde_json::json!({"format": 1, "seed": SEED});
    tensors::to_bytes(Path::new(REFERENCE_FILE), &contents, &about).map(Some)
}

impl LoadedEntry {
    /// Asks the policy for what is stored of it.
    ///
    /// # Errors
    /// [`ZooError::UnfitEntry`] where it answers otherwise; a file that holds something else.
    pub fn repeats(&self) -> Result<Repeats, ZooError> {
        if !self.entry().meta().files.contains_key(REFERENCE_FILE) {
            return Ok(Repeats::NotStored);
        }
        let path = self.entry().folder().join(REFERENCE_FILE);
        let (mut contents, _) = tensors::read(&path)?;
        let lacks = || ZooError::Malformed { path: path.clone(), reason: format!("no tensor {ACTION}") };
        let stored = contents.remove(ACTION).ok_or_else(lacks)?;
        let failed = |source| self.failed("ask for the reference output of", source);
        let signature = &self.entry().meta().signature;
        let now = answers(self.policy().as_mut(), &contents, signature).map_err(failed)?;
        let unfit = |expected: String, found: String| ZooError::UnfitEntry {
            entry: self.entry().id().to_string(),
            task: self.entry().meta().task.clone(),
            what: "reference output".to_owned(),
            expected,
            found,
        };
        if stored.dims() != now.dims() {
            return Err(unfit(format!("actions {:?}", stored.dims()), format!("{:?}", now.dims())));
        }
        let values = |tensor: &Tensor| tensor.flatten_all().and_then(|flat| flat.to_vec1::<f32>());
        let (stored, now) =
            values(&stored).and_then(|stored| Ok((stored, values(&now)?))).map_err(|e| failed(e.into()))?;
        if stored.iter().zip(&now).all(|(stored, now)| stored.to_bits() == now.to_bits()) {
            return Ok(Repeats::Exactly);
        }
        let near = |stored: f32, now: f32| (stored - now).abs() <= TOLERANCE * stored.abs().max(1.0);
        match stored.iter().zip(&now).find(|&(stored, now)| !near(*stored, *now)) {
            Some((stored, now)) => Err(unfit(stored.to_string(), now.to_string())),
            None => Ok(Repeats::Within(
                stored.iter().zip(&now).map(|(stored, now)| (stored - now).abs()).fold(0.0, f32::max),
            )),
        }
    }
}

/// Observations about as the demonstrations': `(steps, …)` by feature, numbers around the mean that they are normalised with,
/// pictures of noise.
fn drawn(signature: &Signature, normaliser: &Normaliser) -> candle_core::Result<BTreeMap<String, Tensor>> {
    let steps = signature.n_obs_steps.max(1) - 1 + QUERIES;
    let statistics = normaliser.tensors().unwrap_or_default();
    let mut rng = Rng::new(SEED, REFERENCE_FILE);
    let mut observations = BTreeMap::new();
    for spec in &signature.observation {
        let count = steps * spec.shape.iter().product::<usize>();
        let shape: Vec<usize> = [steps].into_iter().chain(spec.shape.iter().copied()).collect();
        let tensor = match spec.kind {
            FeatureKind::Image => {
                let bytes: Vec<u8> = (0..count).map(|_| rng.below(256) as u8).collect();
                Tensor::from_vec(bytes, shape, &Device::Cpu)?
            }
            _ => {
                let noise = Tensor::from_vec(rng.normals(count), shape, &Device::Cpu)?;
                let of = |name: &str| statistics.get(&format!("{}.{name}", spec.name));
                match (of("mean"), of("std"), of("min"), of("max")) {
                    (Some(mean), Some(std), ..) => noise.broadcast_mul(std)?.broadcast_add(mean)?,
                    (_, _, Some(min), Some(max)) => {
                        let (centre, spread) = (((min + max)? / 2.0)?, ((max - min)? / 4.0)?);
                        noise.broadcast_mul(&spread)?.broadcast_add(&centre)?
                    }
                    _ => noise,
                }
            }
        };
        observations.insert(spec.name.clone(), tensor);
    }
    Ok(observations)
}

/// What the policy gives in an episode of these observations: `(queries, action_horizon, action_dim)`.
fn answers(
    policy: &mut dyn Policy,
    observations: &BTreeMap<String, Tensor>,
    signature: &Signature,
) -> Result<Tensor, models::ModelError> {
    let steps = signature.n_obs_steps.max(1) - 1 + QUERIES;
    policy.reset(SEED);
    let mut chunks = Vec::new();
    for step in 0..steps {
        let observation = at(observations, &signature.observation, step)?;
        if step + QUERIES < steps {
            policy.observe(&observation);
            continue;
        }
        let chunk = policy.predict(&observation)?;
        policy.executed(1);
        chunks.push(Tensor::from_vec(chunk.actions, (chunk.action_horizon, chunk.action_dim), &Device::Cpu)?);
    }
    Ok(Tensor::stack(&chunks, 0)?)
}

/// The observation of one step.
fn at(
    observations: &BTreeMap<String, Tensor>,
    specs: &[FeatureSpec],
    step: usize,
) -> Result<Observation, models::ModelError> {
    let mut observation = Observation::new();
    for spec in specs {
        let missing = || models::ModelError::Input {
            operation: "reference output",
            object: "observation",
            found: "none".to_owned(),
            expected: spec.name.clone(),
        };
        let values = observations.get(&spec.name).ok_or_else(missing)?.get(step)?.flatten_all()?;
        observation.insert(
            &spec.name,
            match values.dtype() {
                DType::U8 => Values::U8(values.to_vec1()?),
                _ => Values::F32(values.to_vec1()?),
            },
        );
    }
    Ok(observation)
}
