//! What is evaluated: an entry's policy with all that an evaluation has to know of it.

use dataset::Picture;
use models::{
    Actor, FeatureKind, FeatureSpec, ModelError, Observation, Policy, RecedingHorizon, Signature, TemporalEnsemble,
    Values,
};
use rollout::{EpisodePlan, Image, Observations, Ready, RolloutError};

use super::agent::{PolicyAgent, QueryTimes, Timed};
use super::{EvaluationOptions, Perturbation};
use crate::conventions::Conventions;
use crate::entry::CamerasMeta;
use crate::results::{EntryIdentity, EvaluationRecord, Execution, Protocol, Seeds, TrainingFacts};
use crate::{FeatureKeys, Past, ZooError};

/// The entry under evaluation, as far as an evaluation needs to know it.
pub struct Subject<'a> {
    /// Which entry.
    pub entry: EntryIdentity,
    /// Where it comes from.
    pub training: TrainingFacts,
    /// The task it was trained for.
    pub task: String,
    /// The seeds of its demonstrations, where its data set records them.
    pub demonstrations: Option<Seeds>,
    /// The simulator's version that its data set records.
    pub env_version: Option<String>,
    /// Observation keys of the features, in order.
    pub keys: FeatureKeys,
    /// How predictions become actions.
    pub execution: Execution,
    /// The cap on an episode, if the entry sets one; the task's own otherwise.
    pub max_steps: Option<usize>,
    /// Expected features and length of the action.
    pub signature: Signature,
    /// Whether its policies think by the clock, so that an episode may end otherwise next time.
    pub time_decides: bool,
    /// Whether the task's scripted expert acts in its place, inside the simulator.
    pub is_scripted: bool,
    /// How its numbers are meant, as far as that is known.
    pub conventions: Conventions,
    /// Of a policy that sees pictures: whether those it learned from were drawn without reflections and multisampling.
    pub fast_render: Option<bool>,
    /// What becomes of its pictures on their way to it.
    pub perturbation: Option<Perturbation>,
    /// The GPU that it predicts on; `None` on the CPU.
    pub gpu: Option<String>,
    /// Makes a policy of its own for one environment.
    pub policy: Box<dyn Fn() -> Result<Box<dyn Policy>, ModelError> + Sync + 'a>,
}

impl Subject<'_> {
    /// Everything that the outcome will depend on.
    ///
    /// # Errors
    /// [`ZooError::SimulatorGeneration`], [`ZooError::DemonstrationSeeds`] and [`ZooError::UnfitEntry`].
    pub fn record(&self, ready: &Ready, options: &EvaluationOptions) -> Result<EvaluationRecord, ZooError> {
        if !options.force {
            check_generation(&self.entry, self.env_version.as_deref(), &ready.simulator, ready.simulator_version())?;
        }
        let demonstrated = self.demonstrations.filter(|seeds| seeds.overlap(&options.seeds));
        if let (Some(demonstrations), false) = (demonstrated, options.force) {
            return Err(ZooError::DemonstrationSeeds {
                entry: self.entry.to_string(),
                seeds: options.seeds.to_string(),
                demonstrations: demonstrations.to_string(),
            });
        }
        self.check_signature(ready)?;
        Ok(EvaluationRecord {
            format: EvaluationRecord::FORMAT,
            entry: self.entry.clone(),
            training: self.training.clone(),
            protocol: Protocol {
                rules: Protocol::RULES,
                task: ready.task.clone(),
                env_name: ready.env_name.clone(),
                env_module: options.env_module.clone(),
                env_module_sha256: ready.module_sha256.clone(),
                env_args_sha256: ready.env_args_sha256.clone(),
                control: ready.control,
                max_steps: self.max_steps.unwrap_or(ready.max_steps),
                perturbation: self.perturbation.as_ref().map(Perturbation::to_string),
            },
            execution: self.execution,
            time_decides: self.time_decides,
            demonstrated: demonstrated.is_some(),
            seeds: options.seeds,
            shard: options.shard,
            versions: ready
                .versions
                .clone()
                .into_iter()
                .chain(self.gpu.clone().map(|gpu| ("gpu".to_owned(), gpu)))
                .collect(),
            kernels: ready.kernels.clone(),
            renderer: ready.renderer.clone(),
            sources: ready.sources.clone(),
        })
    }

    fn check_signature(&self, ready: &Ready) -> Result<(), ZooError> {
        EpisodePlan::new(ready, self.keys.keys(), 1)?;
        if let Some(perturbation) = &self.perturbation {
            perturbation.check(&self.signature).map_err(|expected| ZooError::Perturbation {
                entry: self.entry.to_string(),
                perturbation: perturbation.to_string(),
                expected,
            })?;
        }
        let simulator = Conventions::of_simulator(ready).without(&["image_size"]);
        self.conventions.check(&simulator, &ready.simulator, &self.entry.to_string(), &ready.task)?;
        let features = self.signature.observation.iter().map(|spec| {
            let found = self.keys.width(&spec.name, ready).map_or_else(|reason| reason, |width| width.to_string());
            (format!("length of {}", spec.name), spec.width().to_string(), found)
        });
        let way = |fast: bool| if fast { "without reflections" } else { "with reflections" }.to_owned();
        let drawn = self
            .fast_render
            .map(|fast| ("images drawn".to_owned(), way(fast), way(CamerasMeta::draws_fast(&ready.env_args))));
        let action =
            ("length of an action".to_owned(), self.signature.action_dim.to_string(), ready.action_dim.to_string());
        for (what, expected, found) in features.chain(drawn).chain([action]) {
            if expected != found {
                return Err(ZooError::UnfitEntry {
                    entry: self.entry.to_string(),
                    task: ready.task.clone(),
                    what,
                    expected,
                    found,
                });
            }
        }
        Ok(())
    }

    /// The pictures that a policy sees of an observation, side by side, each pixel as a square of `scale`; `None` without any.
    pub(super) fn seen(&self, observations: &Observations, scale: usize) -> Option<Image> {
        // pictures are not remembered
        let mut seen = self.keys.observe(observations, &mut Past::default()).ok()?;
        if let Some(perturbation) = &self.perturbation {
            perturbation.apply(&self.signature, &mut seen);
        }
        let cameras = self.signature.of_kind(FeatureKind::Image);
        let pictures: Vec<Picture> = cameras.filter_map(|camera| image(camera, &seen)).collect();
        if pictures.is_empty() {
            return None;
        }
        let Picture { height, width, rgb } = Picture::sheet(&[pictures], 2).enlarged(scale);
        Some(Image { height, width, rgb })
    }

    /// Refuses a subject whose queries cannot be observed.
    ///
    /// # Errors
    /// [`RolloutError::Refused`] of what acts inside the simulator, by itself from the first step to the last.
    pub fn check_watched(&self) -> Result<(), RolloutError> {
        if !self.is_scripted {
            return Ok(());
        }
        Err(RolloutError::Refused {
            task: self.task.clone(),
            kind: "scripted".to_owned(),
            message: "its expert acts inside the simulator and cannot be watched step by step; `actrm-data collect` \
                      records it, `actrm-data replay --video` shows what was recorded"
                .to_owned(),
        })
    }

    /// An agent of its own for one environment, and where its queries' durations go.
    ///
    /// # Errors
    /// The policy cannot be built.
    pub fn agent(&self) -> Result<(PolicyAgent, QueryTimes), ModelError> {
        let times = QueryTimes::default();
        let agent = self.acting(Timed::new((self.policy)()?, times.clone()))?;
        Ok((agent, times))
    }

    /// `policy` acting as the execution says.
    ///
    /// # Errors
    /// An execution that cannot be.
    pub fn acting(&self, policy: impl Policy + 'static) -> Result<PolicyAgent, ModelError> {
        let steps = match self.execution {
            // a policy that looks back itself is shown the last steps of a plan one by one
            Execution::RecedingHorizon { n_action_steps } if policy.n_obs_steps() == 1 => n_action_steps,
            Execution::RecedingHorizon { .. } | Execution::TemporalEnsemble { .. } => 1,
        };
        let actor = acting(policy, self.execution)?;
        Ok(PolicyAgent::new(actor, steps, self.keys.clone()).perturbed(self.perturbation.clone(), &self.signature))
    }
}

/// What a camera shows in an observation.
pub fn image(camera: &FeatureSpec, seen: &Observation) -> Option<Picture> {
    match (seen.get(&camera.name)?, camera.shape.as_slice()) {
        (Values::U8(rgb), &[height, width, _]) => Some(Picture { height, width, rgb: rgb.clone() }),
        _ => None,
    }
}

/// `policy` acting as `execution` says.
///
/// # Errors
/// An execution that cannot be.
pub fn acting(policy: impl Policy + 'static, execution: Execution) -> Result<Box<dyn Actor>, ModelError> {
    Ok(match execution {
        Execution::RecedingHorizon { n_action_steps } => Box::new(RecedingHorizon::new(policy, n_action_steps)?),
        Execution::TemporalEnsemble { coefficient } => Box::new(TemporalEnsemble::new(policy, coefficient)?),
    })
}

/// A simulator's generation: major and minor version.
fn generation(version: &str) -> Option<(u32, u32)> {
    let mut parts = version.split('.');
    Some((parts.next()?.trim().parse().ok()?, parts.next()?.trim().parse().ok()?))
}

fn check_generation(
    entry: &EntryIdentity,
    recorded: Option<&str>,
    simulator: &str,
    running: Option<&str>,
) -> Result<(), ZooError> {
    // what nobody wrote down is no other generation
    let Some(recorded) = recorded else { return Ok(()) };
    if generation(recorded).is_some() && generation(recorded) == running.and_then(generation) {
        return Ok(());
    }
    Err(ZooError::SimulatorGeneration {
        entry: entry.to_string(),
        recorded: recorded.to_owned(),
        simulator: simulator.to_owned(),
        running: running.unwrap_or("of an unknown version").to_owned(),
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn generations_are_major_and_minor() {
        let entry = EntryIdentity { name: "a".into(), version: 1, hash: String::new() };
        let check = |recorded| check_generation(&entry, recorded, "robosuite", Some("1.5.2"));
        check(Some("1.5.2")).unwrap();
        check(Some("1.5.0")).unwrap();
        check(None).unwrap();
        for other in [Some("1.4.1"), Some("2.5.2"), Some("")] {
            let error = check(other).unwrap_err().to_string();
            assert!(error.contains("a@1") && error.contains("--force"), "{error}");
        }
        assert!(check(Some("1.4.1")).unwrap_err().to_string().contains("robosuite 1.4.1"));
    }
}
