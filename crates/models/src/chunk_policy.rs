//! The policy of a model whose prediction depends on what it is shown, and perhaps on chance: nothing else is carried from
//! query to query.

use crate::features::Observation;
use crate::history::History;
use crate::model::PolicyModel;
use crate::policy::{ActionChunk, Clock, Policy};
use crate::preprocess::Preprocess;
use nn::Result;
use nn::Rng;
use std::sync::Arc;

/// A model's policy in one environment, in raw units.
pub struct ChunkPolicy {
    model: Arc<dyn PolicyModel>,
    preprocess: Arc<Preprocess>,
    history: History,
    rng: Rng,
    clock: Option<Box<dyn Clock>>,
    encoding: Option<f64>,
    /// actions that a chunk begins with and that were due before its observation
    past: usize,
}

impl ChunkPolicy {
    /// Shares `model` with others; begins with the episode of seed 0.
    pub fn new(model: Arc<dyn PolicyModel>, preprocess: Arc<Preprocess>) -> Self {
        let history = History::new(preprocess.signature().n_obs_steps);
        Self { model, preprocess, history, rng: generator(0), clock: None, encoding: None, past: 0 }
    }

    /// Leaves out the first `past` actions of every chunk: those of steps that were.
    #[must_use]
    pub fn without_past(self, past: usize) -> Self {
        Self { past, ..self }
    }

    /// The same with a clock, by which it tells what its images took.
    #[must_use]
    pub fn with_clock(mut self, clock: Box<dyn Clock>) -> Self {
        self.clock = Some(clock);
        self
    }
}

/// The generator of an episode's policy.
fn generator(seed: u64) -> Rng {
    Rng::new(seed, "policy")
}

impl Policy for ChunkPolicy {
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk> {
        let begun = self.clock.as_mut().map(|clock| clock.milliseconds());
        let seen = self.history.see(&self.preprocess, observation)?;
        let (mut clock, mut encoding) = (self.clock.as_mut(), None);
        let mut on_seen = || encoding = clock.as_mut().zip(begun).map(|(clock, begun)| clock.milliseconds() - begun);
        let actions = self.model.sample_seen(&seen, &mut self.rng, &mut on_seen)?;
        self.encoding = encoding;
        let left = actions.dim(1)?.saturating_sub(self.past);
        self.preprocess.chunk(&actions.narrow(1, self.past, left)?)
    }

    fn encoding(&self) -> Option<f64> {
        self.encoding
    }

    fn n_obs_steps(&self) -> usize {
        self.history.steps()
    }

    fn observe(&mut self, observation: &Observation) {
        self.history.observe(observation);
    }

    fn reset(&mut self, seed: u64) {
        self.history.clear();
        self.rng = generator(seed);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::batch::Batch;
    use crate::features::{Features, Signature};
    use crate::models::act::{self, Act};
    use crate::normaliser::{ACTION, NormMode, Normaliser, STATE};
    use crate::policy::{Actor, RecedingHorizon};
    use candle_core::{Device, Tensor};
    use nn::LossParts;
    use nn::Params;
    use std::collections::BTreeMap;

    fn preprocess(n_obs_steps: usize) -> Arc<Preprocess> {
        let signature = Signature { n_obs_steps, ..Signature::low_dimensional(2, 0, 1) };
        let modes = [STATE, ACTION].map(|name| (name.to_string(), NormMode::Identity));
        let normaliser = Normaliser::new(&BTreeMap::from(modes), &BTreeMap::new()).unwrap();
        Arc::new(Preprocess::new(signature, normaliser, &Device::Cpu).unwrap())
    }

    fn act(preprocess: &Preprocess) -> Act {
        let config = act::Config {
            action_horizon: 4,
            dim_model: 8,
            n_heads: 2,
            dim_feedforward: 8,
            use_vae: false,
            n_encoder_layers: 1,
            ..Default::default()
        };
        Act::new(&config, preprocess.signature(), 3, &nn::Backend::CPU).unwrap()
    }

    /// ACT with noise on its chunks.
    struct Noisy(Act);

    impl PolicyModel for Noisy {
        fn params(&self) -> &Params {
            self.0.params()
        }
        fn signature(&self) -> &Signature {
            self.0.signature()
        }
        fn loss(&self, batch: &Batch, rng: &mut Rng) -> Result<LossParts> {
            self.0.loss(batch, rng)
        }
        fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor> {
            self.0.predict(observation)
        }
        fn sample(&self, observation: &Features<Tensor>, rng: &mut Rng) -> Result<Tensor> {
            let chunk = self.0.predict(observation)?;
            let noise = Tensor::from_vec(rng.normals(chunk.elem_count()), chunk.shape(), &Device::Cpu)?;
            Ok((chunk + noise)?)
        }
        fn policy(self: Arc<Self>, preprocess: Arc<Preprocess>, _clock: Box<dyn Clock>) -> Box<dyn Policy> {
            Box::new(ChunkPolicy::new(self, preprocess))
        }
        fn action_horizon(&self) -> usize {
            self.0.action_horizon()
        }
    }

    fn seen(k: usize) -> Observation {
        Observation::of_state(vec![k as f32 * 0.1, 1.0], vec![])
    }

    #[test]
    fn an_episode_s_chance_is_its_seed() {
        let preprocess = preprocess(1);
        let mut policy = ChunkPolicy::new(Arc::new(Noisy(act(&preprocess))), Arc::clone(&preprocess));
        let mut episode = |seed: u64| -> Vec<ActionChunk> {
            policy.reset(seed);
            (0..3).map(|k| policy.predict(&seen(k)).unwrap()).collect()
        };
        let first = episode(5);
        assert_ne!(episode(6), first);
        assert_eq!(episode(5), first);
        assert_ne!(first[0], first[1]);
    }

    #[test]
    fn a_policy_remembers_as_many_steps_as_its_model_sees() {
        let preprocess = preprocess(2);
        let model = Arc::new(act(&preprocess));
        let policy = ChunkPolicy::new(model.clone(), Arc::clone(&preprocess));
        let mut actor = RecedingHorizon::new(policy, 3).unwrap();
        for seed in 0..2 {
            actor.reset(seed);
            for step in 0..9_usize {
                let action = actor.act(&seen(step)).unwrap();
                // asked at 0, 3, 6, with the step before beside it, if there is one
                let query = step / 3 * 3;
                let history: Vec<Observation> = (query.saturating_sub(1)..=query).map(seen).collect();
                let chunk = model.predict(&preprocess.observation(&history).unwrap()).unwrap();
                let chunk = preprocess.chunk(&chunk).unwrap();
                assert_eq!(action, chunk.rows().nth(step - query).unwrap(), "step {step}");
            }
        }
    }
}
