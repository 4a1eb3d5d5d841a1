//! One rollout: reset, then observe, act and step until success or the cap.

use std::time::{Duration, Instant};

use crate::error::{FaultKind, RolloutError, WorkerFault};
use crate::message::Ready;
use crate::pool::JobError;
use crate::worker::{Initial, Observations, Scripted, Worker};

/// What an agent's failure is to whoever runs it.
pub type AgentError = Box<dyn std::error::Error + Send + Sync>;

/// What acts in an episode: the observations of a step in, actions in the environment's units out.
pub trait Agent: Send {
    /// The action to execute now.
    ///
    /// # Errors
    /// Whatever keeps it from acting; it ends the episode and everything that it is a part of.
    fn act(&mut self, observations: &Observations) -> Result<Vec<f32>, AgentError>;

    /// The actions up to the next observation that matters, at least one: what as many calls of [`Agent::act`] would
    /// give, whatever they were shown after the first.
    ///
    /// # Errors
    /// As [`Agent::act`].
    fn act_ahead(&mut self, observations: &Observations) -> Result<Vec<Vec<f32>>, AgentError> {
        Ok(vec![self.act(observations)?])
    }

    /// Forgets the episode and begins that of `seed`.
    fn reset(&mut self, seed: u64);

    /// Says what is to be done in the episode that just began, in words; `None` where the environment does not say it.
    fn instruct(&mut self, _instruction: Option<&str>) {}
}

/// How an episode is run and when it ends.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodePlan {
    /// Control steps after which the episode has failed.
    pub max_steps: usize,
    /// The environment's smallest action.
    pub action_low: Vec<f64>,
    /// The environment's largest action.
    pub action_high: Vec<f64>,
}

/// How an episode ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Whether the task was done.
    pub success: bool,
    /// Control steps done.
    pub steps: usize,
    /// Sum of the rewards.
    pub total_reward: f64,
    /// Hash of the initial state.
    pub fingerprint: String,
    /// The group of episodes that this one belongs to, where the task has groups.
    pub group: Option<String>,
    /// In a word why the episode was lost before the cap, where the environment says so.
    pub failure: Option<String>,
    /// Which share of its way it came: the task's stages that were passed of all and success, 1 where the task was done;
    /// `None` where no stages are known.
    pub progress: Option<f64>,
    /// Time spent waiting for the simulator.
    pub simulator: Duration,
    /// Of that, what drawing took, once an observation that the agent was asked about; empty without pictures.
    pub drawing: Vec<Duration>,
    /// Time of the whole episode.
    pub wall: Duration,
}

impl EpisodePlan {
    /// A plan for the environment that `ready` describes and an agent that reads `keys` of its observations.
    ///
    /// # Errors
    /// [`RolloutError::ObservationKey`] for a key that the environment does not give.
    pub fn new<'k>(
        ready: &Ready,
        keys: impl IntoIterator<Item = &'k str>,
        max_steps: usize,
    ) -> Result<Self, RolloutError> {
        for key in keys {
            if !ready.observations.contains_key(key) {
                let available: Vec<&str> = ready.observations.keys().map(String::as_str).collect();
                return Err(RolloutError::ObservationKey {
                    key: key.to_owned(),
                    task: ready.task.clone(),
                    available: available.join(", "),
                });
            }
        }
        Ok(Self { max_steps, action_low: ready.action_low.clone(), action_high: ready.action_high.clone() })
    }

    /// The action that is executed: of the right length, finite, inside the environment's limits.
    fn clipped(&self, action: &[f32]) -> Result<Vec<f64>, String> {
        if action.len() != self.action_low.len() {
            return Err(format!("{} values", action.len()));
        }
        if let Some(at) = action.iter().position(|value| !value.is_finite()) {
            return Err(format!("{} at index {at}", action[at]));
        }
        let limits = self.action_low.iter().zip(&self.action_high);
        let clip = |(&value, (&low, &high)): (&f32, (&f64, &f64))| f64::from(value).clamp(low, high);
        Ok(action.iter().zip(limits).map(clip).collect())
    }

    /// The actions that can be executed, and why the one after them cannot, if so.
    fn executable(&self, planned: &[Vec<f32>]) -> (Vec<Vec<f64>>, Option<String>) {
        let mut good = Vec::with_capacity(planned.len());
        for action in planned {
            match self.clipped(action) {
                Ok(action) => good.push(action),
                Err(found) => return (good, Some(found)),
            }
        }
        (good, None)
    }

    /// Runs the episode of `seed`. Actions that the policy plans ahead go to the worker together, unless `watch` wants
    /// to be called with the worker after the reset and after every step.
    ///
    /// # Errors
    /// A failure of the worker, or one of the policy.
    pub fn run(
        &self,
        worker: &mut Worker,
        agent: &mut dyn Agent,
        seed: u64,
        mut watch: Option<Watch<'_>>,
    ) -> Result<Outcome, JobError> {
        let begun = Instant::now();
        agent.reset(seed);
        let Initial { fingerprint, group, instruction, mut observations, mut drawing } = worker.reset(seed)?;
        agent.instruct(instruction.as_deref());
        let mut simulator = begun.elapsed();
        if let Some(watch) = &mut watch {
            watch(worker, &observations)?;
        }
        let (mut success, mut failure, mut progress, mut steps, mut total_reward) = (false, None, None, 0, 0.0);
        let mut drawn = Vec::new();
        while !success && failure.is_none() && steps < self.max_steps {
            if !drawing.is_zero() {
                drawn.push(std::mem::take(&mut drawing));
            }
            let planned = match watch.is_some() {
                true => agent.act(&observations).map(|one| vec![one]),
                false => agent.act_ahead(&observations),
            };
            let mut planned = planned.map_err(|source| {
                let operation = "querying the policy";
                RolloutError::Policy { seed, step: steps, operation, source }
            })?;
            planned.truncate(self.max_steps - steps);
            let (actions, unusable) = self.executable(&planned);
            if !actions.is_empty() {
                let asked = Instant::now();
                let stepped = worker.step(&actions)?;
                simulator += asked.elapsed();
                steps += stepped.rewards.len();
                total_reward = stepped.rewards.iter().fold(total_reward, |sum, reward| sum + reward);
                (success, failure, progress) = (stepped.success, stepped.failure, stepped.progress);
                (observations, drawing) = (stepped.observations, stepped.drawing);
            }
            if let Some(found) = unusable.filter(|_| !success && failure.is_none()) {
                let expected = format!("{} finite values", self.action_low.len());
                return Err(RolloutError::Action { seed, step: steps, expected, found }.into());
            }
            if let Some(watch) = &mut watch {
                watch(worker, &observations)?;
            }
        }
        worker.check_quiet()?;
        let (drawing, wall) = (drawn, begun.elapsed());
        Ok(Outcome { success, steps, total_reward, fingerprint, group, failure, progress, simulator, drawing, wall })
    }

    /// Runs the task's scripted expert in the episode of `seed`, until it has done the task or the cap is reached.
    ///
    /// # Errors
    /// A failure of the worker; a task without an expert, or a cap beyond the task's own, where the expert ends.
    pub fn run_expert(&self, worker: &mut Worker, seed: u64) -> Result<Outcome, JobError> {
        let begun = Instant::now();
        let Ready { task, max_steps: longest, .. } = worker.ready();
        if self.max_steps > *longest {
            let message =
                format!("expected --max-steps of at most {longest}, where its expert ends, found {}", self.max_steps);
            return Err(RolloutError::Refused { task: task.clone(), kind: "max_steps".to_owned(), message }.into());
        }
        let Initial { fingerprint, group, .. } = worker.reset(seed)?;
        let Scripted { rewards, solved, failure, progress } =
            worker.expert_evaluated(seed).map_err(|fault| no_expert(worker, fault))?;
        worker.check_quiet()?;
        let end = solved.iter().take(self.max_steps).position(|solved| *solved);
        let steps = end.map_or(solved.len().min(self.max_steps), |at| at + 1);
        // how far it had come by a cap that is shorter than its episode is not known, nor why it was lost after that
        let whole = solved.len() <= self.max_steps;
        let progress = progress.filter(|_| end.is_some() || whole);
        let failure = failure.filter(|_| end.is_none() && whole);
        let (wall, drawing) = (begun.elapsed(), Vec::new());
        Ok(Outcome {
            success: end.is_some(),
            steps,
            total_reward: rewards.iter().take(steps).sum(),
            fingerprint,
            group,
            failure,
            progress,
            simulator: wall,
            drawing,
            wall,
        })
    }
}

/// Called with the worker and what it shows after an episode's reset and after every step of it.
pub type Watch<'a> = &'a mut dyn FnMut(&mut Worker, &Observations) -> Result<(), JobError>;

/// What a worker says that has no such expert, or none of such a skill, is the same for a fresh worker.
pub(crate) fn no_expert(worker: &Worker, fault: WorkerFault) -> JobError {
    match &fault.kind {
        FaultKind::Reported { kind, message } if kind == "no_expert" || kind == "no_skill" => {
            let task = worker.ready().task.clone();
            RolloutError::Refused { task, kind: kind.clone(), message: message.clone() }.into()
        }
        _ => fault.into(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn plan() -> EpisodePlan {
        EpisodePlan { max_steps: 5, action_low: vec![-1.0, -0.5], action_high: vec![1.0, 0.5] }
    }

    #[test]
    fn actions_are_clipped_and_must_be_finite_and_complete() {
        assert_eq!(plan().clipped(&[2.0, -0.25]).unwrap(), [1.0, -0.25]);
        assert_eq!(plan().clipped(&[-7.0, 0.75]).unwrap(), [-1.0, 0.5]);
        assert_eq!(plan().clipped(&[0.0, f32::NAN]).unwrap_err(), "NaN at index 1");
        assert_eq!(plan().clipped(&[f32::INFINITY, 0.0]).unwrap_err(), "inf at index 0");
        assert_eq!(plan().clipped(&[0.0]).unwrap_err(), "1 values");
        let (good, unusable) = plan().executable(&[vec![0.0, 2.0], vec![f32::NAN, 0.0], vec![0.0, 0.0]]);
        assert_eq!((good, unusable), (vec![vec![0.0, 0.5]], Some("NaN at index 0".to_owned())));
    }
}
