//! `nearest`: what the demonstrations did where they saw most nearly the same. Of all windows of the demonstrations the `k`
//! whose observations, in network units, have the smallest Euclidean distance from the present one; the mean of the actions
//! that followed there. Of several at the same distance the earlier ones.
//!
//! The k-nearest-neighbour policy as in Pari et al., "The Surprising Effectiveness of Representation Learning for Visual
//! Imitation" (arXiv 2112.01511). Deviations: on the observation itself, without a learned representation; the neighbours
//! weigh the same, theirs by the exponential of the negative distance.

pub use super::READS;
use super::{Floor, Rule, at_least_one, joined};
use crate::batch::Batch;
use crate::features::{Features, Signature};
use candle_core::Tensor;
use nn::Params;
use nn::Rng;
use nn::Size;
use nn::values::with_values;
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};

/// Table of the observations, (windows, everything seen).
const SEEN: &str = "seen";
/// Table of what followed, (windows, H*A).
const DONE: &str = "done";

/// The model.
pub type Nearest = Floor<Neighbours>;

/// Options.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// actions predicted at once
    pub action_horizon: usize,
    /// number of neighbours that are averaged
    pub k: usize,
}

impl Default for Config {
    fn default() -> Self {
        Self { action_horizon: 1, k: 1 }
    }
}

impl Config {
    /// It has no weights; what it remembers is not known before the demonstrations are.
    pub fn size(&self) -> Size {
        Size::default()
    }

    /// Checks that a policy with this configuration can exist.
    ///
    /// # Errors
    /// The first field that makes it impossible.
    pub fn validate(&self) -> Result<()> {
        at_least_one("nearest", "action_horizon", self.action_horizon)?;
        at_least_one("nearest", "k", self.k)
    }
}

/// Looking up what was done.
#[derive(Debug)]
pub struct Neighbours {
    config: Config,
}

impl Rule for Neighbours {
    const NAME: &'static str = "nearest";
    type Config = Config;

    fn new(config: &Config, signature: &Signature, params: &mut Params) -> Result<Self> {
        config.validate()?;
        let seen: usize = signature.observation.iter().map(|spec| spec.width() * signature.n_obs_steps).sum();
        params.insert_table(SEEN, seen)?;
        params.insert_table(DONE, config.action_horizon * signature.action_dim)?;
        Ok(Self { config: config.clone() })
    }

    fn action_horizon(&self) -> usize {
        self.config.action_horizon
    }

    fn chunk(
        &self,
        model: &Floor<Self>,
        rows: usize,
        observation: &Features<Tensor>,
        _: Option<&mut Rng>,
    ) -> Result<Tensor> {
        let (seen, done) = (model.params.table(SEEN)?, model.params.table(DONE)?);
        let (width, length) = (seen.dim(1)?, done.dim(1)?);
        let asked = joined(Self::NAME, &model.signature, rows, observation)?;
        let chunks = with_values(&asked, |asked| {
            with_values(&seen, |seen| {
                with_values(&done, |done| {
                    let mut chunks = Vec::with_capacity(rows * length);
                    for row in asked.chunks_exact(width) {
                        chunks.extend(mean(&nearest(row, seen, self.config.k), done, length));
                    }
                    chunks
                })
            })
        })???;
        let shape = (rows, self.config.action_horizon, model.signature.action_dim);
        Ok(Tensor::from_vec(chunks, shape, model.params.device())?)
    }

    fn remember(&self, model: &Floor<Self>, train: &[Batch], _held_out: &[Batch]) -> Result<()> {
        let (mut seen, mut done) = (Vec::new(), Vec::new());
        for episode in train {
            let rows = episode.rows();
            seen.push(joined(Self::NAME, &model.signature, rows, &episode.observation)?);
            done.push(episode.actions.reshape((rows, ()))?);
        }
        let windows: usize = train.iter().map(Batch::rows).sum();
        if windows < self.config.k {
            let (found, expected) = (self.config.k.to_string(), format!("at most the number of windows, {windows}"));
            return Err(ModelError::Config { model: Self::NAME, field: "k", found, expected });
        }
        model.params.set_table(SEEN, &Tensor::cat(&seen, 0)?)?;
        model.params.set_table(DONE, &Tensor::cat(&done, 0)?)
    }
}

/// The `k` rows of `seen` nearest to `row`, nearest first.
fn nearest(row: &[f32], seen: &[f32], k: usize) -> Vec<usize> {
    let distance = |other: &[f32]| row.iter().zip(other).map(|(a, b)| (a - b) * (a - b)).sum::<f32>();
    let mut found: Vec<(f32, usize)> = Vec::with_capacity(k + 1);
    for (i, other) in seen.chunks_exact(row.len()).enumerate() {
        let d = distance(other);
        let at = found.partition_point(|(best, _)| *best <= d);
        if at < k {
            found.insert(at, (d, i));
            found.truncate(k);
        }
    }
    found.into_iter().map(|(_, i)| i).collect()
}

/// The mean of these rows of `done`.
fn mean(rows: &[usize], done: &[f32], length: usize) -> Vec<f32> {
    let share = 1.0 / rows.len() as f32;
    let mut sum = vec![0.0; length];
    for &row in rows {
        sum.iter_mut().zip(&done[row * length..(row + 1) * length]).for_each(|(s, x)| *s += x * share);
    }
    sum
}
