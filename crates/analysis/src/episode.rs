//! One episode whose queries are recorded.

use std::mem::take;
use std::ops::ControlFlow;
use std::sync::{Arc, Mutex, PoisonError};

use models::Policy;
use rollout::{EpisodePlan, Outcome, Pool, RolloutError, Worker};
use zoo::evaluation::{PolicyAgent, Subject};

/// What a policy's queries recorded, shared with the policy that fills it.
#[derive(Debug)]
pub(crate) struct Log<T>(Arc<Mutex<Vec<T>>>);

impl<T> Clone for Log<T> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<T> Log<T> {
    pub(crate) fn push(&self, query: T) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(query);
    }

    pub(crate) fn with_last(&self, change: impl FnOnce(&mut T)) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).last_mut().map(change);
    }

    pub(crate) fn take(&self) -> Vec<T> {
        take(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// Runs the episode of `seed` as an evaluation would, with a policy that `wrap` makes to record its queries in the log; the
/// outcome and the queries, nothing if it was stopped.
///
/// # Errors
/// As for an evaluation.
pub(crate) fn record<T: Send, P: Policy + 'static>(
    subject: &Subject<'_>,
    pool: &mut Pool,
    seed: u64,
    wrap: &(dyn Fn(Box<dyn Policy>, Log<T>) -> P + Sync),
) -> Result<Option<(Outcome, Vec<T>)>, RolloutError> {
    subject.check_watched()?;
    let max_steps = subject.max_steps.unwrap_or(pool.ready().max_steps);
    let plan = EpisodePlan::new(pool.ready(), subject.keys.keys(), max_steps)?;
    let state = || {
        let log = Log(Arc::default());
        let made = (subject.policy)().and_then(|policy| subject.acting(wrap(policy, log.clone())));
        let operation = "building the policy";
        let made =
            made.map_err(|source| RolloutError::Policy { seed, step: 0, operation, source: Box::new(source) })?;
        Ok((made, log))
    };
    let work = |(agent, log): &mut (PolicyAgent, Log<T>), worker: &mut Worker, _| {
        let outcome = plan.run(worker, agent, seed, None)?;
        Ok((outcome, log.take()))
    };
    let mut ended = None;
    pool.run(0..1, &|_| seed, &state, &work, &mut |_, result| {
        ended = Some(result);
        ControlFlow::Continue(())
    })?;
    ended.transpose()
}
