//! One episode in which something is noted of each query.

use std::mem::take;
use std::ops::ControlFlow;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use models::{ActionChunk, ModelError, Observation, Policy, ThoughtStep};
use rollout::{EpisodePlan, Outcome, Pool, RolloutError, Worker};
use zoo::evaluation::{PolicyAgent, Subject};

/// A query that was just answered.
pub(crate) struct Answered<'a> {
    /// The policy that answered it.
    pub policy: &'a dyn Policy,
    /// The observations that the policy sees at once, oldest first.
    pub seen: &'a [Observation],
    /// The answer.
    pub chunk: &'a ActionChunk,
    /// How long it took.
    pub milliseconds: f64,
}

/// Makes what is noted of a query.
pub(crate) type Note<T> = Arc<dyn Fn(&Answered<'_>) -> Result<T, ModelError> + Send + Sync>;

/// A query of which something was noted.
pub(crate) struct Noted<T> {
    /// Control steps done before it.
    pub step: usize,
    /// Actions of its answer that were executed, or went into the average that was.
    pub executed: usize,
    /// What was noted.
    pub what: T,
}

/// The queries of an episode, shared with the policy that is asked.
type Log<T> = Arc<Mutex<Vec<Noted<T>>>>;

fn locked<T>(log: &Log<T>) -> MutexGuard<'_, Vec<Noted<T>>> {
    log.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A policy of whose queries something is noted.
struct Watched<T> {
    policy: Box<dyn Policy>,
    note: Note<T>,
    log: Log<T>,
    /// the observations that the policy sees at once, oldest first
    seen: Vec<Observation>,
    step: usize,
}

impl<T> Watched<T> {
    fn see(&mut self, observation: &Observation) {
        self.seen.push(observation.clone());
        let surplus = self.seen.len().saturating_sub(self.policy.n_obs_steps());
        self.seen.drain(..surplus);
    }
}

impl<T: Send> Policy for Watched<T> {
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk, ModelError> {
        self.see(observation);
        let asked = Instant::now();
        let chunk = self.policy.predict(observation)?;
        let milliseconds = asked.elapsed().as_secs_f64() * 1e3;
        let answered = Answered { policy: &*self.policy, seen: &self.seen, chunk: &chunk, milliseconds };
        let what = (self.note)(&answered)?;
        locked(&self.log).push(Noted { step: self.step, executed: 0, what });
        Ok(chunk)
    }

    fn n_obs_steps(&self) -> usize {
        self.policy.n_obs_steps()
    }

    fn observe(&mut self, observation: &Observation) {
        self.see(observation);
        self.policy.observe(observation);
    }

    fn executed(&mut self, actions: usize) {
        self.step += actions;
        if let Some(query) = locked(&self.log).last_mut() {
            query.executed += actions;
        }
        self.policy.executed(actions);
    }

    fn reset(&mut self, seed: u64) {
        self.step = 0;
        self.seen.clear();
        locked(&self.log).clear();
        self.policy.reset(seed);
    }

    fn instruct(&mut self, instruction: Option<&str>) {
        self.policy.instruct(instruction);
    }

    fn thought(&self) -> Result<Vec<ThoughtStep>, ModelError> {
        self.policy.thought()
    }
}

/// The outcome of an episode and what was noted of its queries; nothing if it was stopped.
pub(crate) type Recorded<T> = Option<(Outcome, Vec<Noted<T>>)>;

/// Runs the episode of `seed` as an evaluation would; the outcome and what was noted of the queries, nothing if it was stopped.
///
/// # Errors
/// As for an evaluation.
pub(crate) fn record<T: Send + 'static>(
    subject: &Subject<'_>,
    pool: &mut Pool,
    seed: u64,
    note: &Note<T>,
) -> Result<Recorded<T>, RolloutError> {
    subject.check_watched()?;
    let max_steps = subject.max_steps.unwrap_or(pool.ready().max_steps);
    let plan = EpisodePlan::new(pool.ready(), subject.keys.keys(), max_steps)?;
    let state = || {
        let log = Log::default();
        let (note, own) = (Arc::clone(note), Arc::clone(&log));
        let watched = |policy| Watched { policy, note, log: own, seen: Vec::new(), step: 0 };
        let made = (subject.policy)().and_then(|policy| subject.acting(watched(policy)));
        let operation = "building the policy";
        let made =
            made.map_err(|source| RolloutError::Policy { seed, step: 0, operation, source: Box::new(source) })?;
        Ok((made, log))
    };
    let work = |(agent, log): &mut (PolicyAgent, Log<T>), worker: &mut Worker, _| {
        let outcome = plan.run(worker, agent, seed, None)?;
        Ok((outcome, take(&mut *locked(log))))
    };
    let mut ended = None;
    pool.run(0..1, &|_| seed, &state, &work, &mut |_, result| {
        ended = Some(result);
        ControlFlow::Continue(())
    })?;
    ended.transpose()
}
