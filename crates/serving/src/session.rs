//! One client's policy: observations in, action chunks out, as messages.

use std::time::Instant;

use models::{FeatureKind, FeatureSpec, Observation, Policy, Signature, Values};

use crate::codec::{Array, Value, decode, encode, shown};
use crate::error::{Result, ServingError};
use crate::vla_eval::Steps;

/// Keys of an observation that belong to no feature.
pub(crate) const RESET: &str = "reset";
pub(crate) const SEED: &str = "seed";
pub(crate) const EXECUTED: &str = "executed";
/// What the metadata lists them under.
pub(crate) const EPISODE_KEYS: &str = "episode_keys";

/// What is served.
pub struct Service {
    /// What the policy reads, and the length of its actions.
    pub signature: Signature,
    /// Actions of a chunk.
    pub action_horizon: usize,
    /// Actions that are executed before the next query.
    pub n_action_steps: usize,
    /// What else the metadata says.
    pub facts: Vec<(String, Value<'static>)>,
    /// Makes the policy of one client; weights are shared behind it.
    pub policy: Box<dyn Fn() -> Box<dyn Policy> + Send + Sync>,
    /// The same, asked at every step: for vla-eval.
    pub steps: Option<Steps>,
}

impl Service {
    /// What a client is told first.
    pub(crate) fn metadata(&self, max_message_bytes: usize) -> Value<'static> {
        let features = self.signature.observation.iter().map(|spec| {
            let dtype = if spec.kind == FeatureKind::Image { "uint8" } else { "float32" };
            let shape = spec.shape.iter().map(|extent| integer(*extent)).collect();
            (spec.name.clone(), Value::map([("dtype", Value::text(dtype)), ("shape", Value::List(shape))]))
        });
        let features = Value::map(features);
        let mut all = self.facts.clone();
        let keys = [RESET, SEED, EXECUTED].map(Value::text).to_vec();
        let own = [
            ("observation", features),
            ("action_dim", integer(self.signature.action_dim)),
            ("action_horizon", integer(self.action_horizon)),
            ("n_action_steps", integer(self.n_action_steps)),
            ("n_obs_steps", integer(self.signature.n_obs_steps)),
            (EPISODE_KEYS, Value::List(keys)),
            ("max_message_bytes", integer(max_message_bytes)),
        ];
        all.extend(own.map(|(key, value)| (key.to_owned(), value)));
        Value::map(all)
    }
}

pub(crate) fn integer(number: usize) -> Value<'static> {
    Value::Integer(number as i128)
}

/// The policy of one client and where its episode is.
pub struct Session<'a> {
    service: &'a Service,
    policy: Box<dyn Policy>,
    asked: bool,
}

impl<'a> Session<'a> {
    /// Begins with the episode of seed 0.
    pub fn new(service: &'a Service) -> Self {
        let mut policy = (service.policy)();
        policy.reset(0);
        Self { service, policy, asked: false }
    }

    /// The answer to an observation.
    ///
    /// # Errors
    /// What is wrong with the observation, by its key: the episode is then as it was. A policy that fails, or whose actions
    /// are not finite.
    pub fn answer(&mut self, message: &[u8]) -> Result<Vec<u8>> {
        let begun = Instant::now();
        let message = decode(message)?;
        let Value::Map(_) = &message else {
            return Err(ServingError::message("message", "a map of observation keys", message.to_string()));
        };
        let observations = observations(&self.service.signature, &message)?;
        let seed = seed(&message)?;
        let executed = number(&message, EXECUTED, self.service.action_horizon as u64)?;
        if let Some(seed) = seed {
            self.policy.reset(seed);
            self.asked = false;
        }
        if std::mem::replace(&mut self.asked, true) {
            let executed = executed.and_then(|count| usize::try_from(count).ok());
            self.policy.executed(executed.unwrap_or(self.service.n_action_steps));
        }
        let Some((last, before)) = observations.split_last() else {
            return Err(ServingError::message("message", "an observation", "none"));
        };
        before.iter().for_each(|observation| self.policy.observe(observation));
        let chunk = self.policy.predict(last)?;
        if let Some(at) = chunk.actions.iter().position(|action| !action.is_finite()) {
            let found = format!("{} in action {}", chunk.actions[at], at / chunk.action_dim);
            return Err(ServingError::message("actions", "finite numbers from the policy", found));
        }
        let actions = Array::of_f32(vec![chunk.action_horizon, chunk.action_dim], &chunk.actions)?;
        let timing = Value::map([("infer_ms", Value::Float(1e3 * begun.elapsed().as_secs_f64()))]);
        Ok(encode(&Value::map([("actions", Value::Array(actions)), ("server_timing", timing)])))
    }
}

/// The seed of the episode that an observation begins, if it begins one.
fn seed(message: &Value<'_>) -> Result<Option<u64>> {
    let seed = number(message, SEED, u64::MAX)?;
    match message.get(RESET) {
        None | Some(Value::Nil) => Ok(seed),
        Some(Value::Bool(false)) if seed.is_none() => Ok(None),
        Some(Value::Bool(true)) => Ok(Some(seed.unwrap_or(0))),
        Some(Value::Bool(false)) => Err(ServingError::message(RESET, "true, beside a seed", "false")),
        Some(other) => Err(ServingError::message(RESET, "true or false", other.to_string())),
    }
}

fn number(message: &Value<'_>, key: &str, most: u64) -> Result<Option<u64>> {
    match message.get(key) {
        None | Some(Value::Nil) => Ok(None),
        Some(value) => match value.count().filter(|count| *count <= most) {
            Some(count) => Ok(Some(count)),
            None => Err(ServingError::message(key, format!("an integer from 0 to {most}"), value.to_string())),
        },
    }
}

/// The observations of a message, oldest first: one, or as many as its features have rows.
fn observations(signature: &Signature, message: &Value<'_>) -> Result<Vec<Observation>> {
    let mut steps: Option<(usize, &str)> = None;
    let mut features = Vec::new();
    for spec in &signature.observation {
        let key = spec.name.as_str();
        let Some(value) = message.get(key) else {
            return Err(ServingError::message(key, wanted(spec), format!("no such key in {message}")));
        };
        let (rows, values) = feature(spec, signature.n_obs_steps, value)?;
        match steps {
            Some((before, other)) if before != rows => {
                return Err(ServingError::message(key, format!("{before} observations, as {other}"), rows.to_string()));
            }
            _ => steps = Some((rows, key)),
        }
        features.push((spec, values));
    }
    let row = |row: usize| {
        let cut = |(spec, values): &(&FeatureSpec, Values)| {
            let range = row * spec.width()..(row + 1) * spec.width();
            let part = match values {
                Values::F32(all) => Values::F32(all[range].to_vec()),
                Values::U8(all) => Values::U8(all[range].to_vec()),
            };
            (spec.name.clone(), part)
        };
        features.iter().map(cut).collect()
    };
    Ok((0..steps.map_or(1, |(rows, _)| rows)).map(row).collect())
}

/// What a feature's value has to be.
fn wanted(spec: &FeatureSpec) -> String {
    match spec.kind {
        FeatureKind::Image => format!("uint8 {:?}, or float from 0 to 1", spec.shape),
        _ => format!("float32 {:?}", spec.shape),
    }
}

/// The values of a feature, and how many observations they are of.
fn feature(spec: &FeatureSpec, n_obs_steps: usize, value: &Value<'_>) -> Result<(usize, Values)> {
    let wrong = |found: String| ServingError::message(shown(&spec.name), wanted(spec), found);
    let array = value.to_array().ok_or_else(|| wrong(value.to_string()))?;
    let rows = |shape: &[usize]| match array.shape().strip_suffix(shape) {
        Some([]) => Some(1),
        Some(&[rows]) if (1..=n_obs_steps).contains(&rows) => Some(rows),
        _ => None,
    };
    if spec.kind != FeatureKind::Image {
        let rows = rows(&spec.shape).ok_or_else(|| wrong(array_text(&array)))?;
        let numbers = array.numbers();
        if let Some(at) = numbers.iter().position(|number| !number.is_finite()) {
            return Err(wrong(format!("{} at {at}", numbers[at])));
        }
        return Ok((rows, Values::F32(numbers)));
    }
    let &[height, width, colours] = spec.shape.as_slice() else {
        return Err(wrong(array_text(&array)));
    };
    let last = rows(&spec.shape);
    let Some(count) = last.or_else(|| rows(&[colours, height, width])) else { return Err(wrong(array_text(&array))) };
    let mut pixels = array.pixels().map_err(wrong)?;
    if last.is_none() {
        // channels first, as PyTorch has them
        let area = height * width;
        pixels = pixels
            .chunks_exact(colours * area)
            .flat_map(|image| (0..area).flat_map(move |at| (0..colours).map(move |colour| image[colour * area + at])))
            .collect();
    }
    Ok((count, Values::U8(pixels)))
}

fn array_text(array: &Array<'_>) -> String {
    format!("{} {:?}", array.dtype(), array.shape())
}
