//! A trained policy that thinks otherwise than its experiment says: other numbers of steps, with or without halting, its
//! reasoning tampered with, several thoughts from noise.
//!
//! What such a policy does is no result of the entry: keep it apart from the zoo's results.

use std::ops::ControlFlow;
use std::sync::Arc;

use models::Observation;
use models::actrm::{DisturbedPolicy, Intervention, RestartedPolicy, Thinking};
use rollout::{Pool, RolloutError, Worker};
use zoo::entry::LoadedEntry;
use zoo::evaluation::Subject;
use zoo::{FeatureKeys, Past, ZooError};

/// The first observation of an episode.
#[derive(Debug, Clone, PartialEq)]
pub struct Start {
    /// The episode's seed.
    pub seed: u64,
    /// What a policy sees there, in the environment's units.
    pub observation: Observation,
}

/// How the episodes of `seeds` begin, as a policy that reads `keys` sees it; nothing if it was stopped.
///
/// # Errors
/// A failure of ours, or of a worker that could not be made good.
pub fn starts(keys: &FeatureKeys, pool: &mut Pool, seeds: &[u64]) -> Result<Option<Vec<Start>>, RolloutError> {
    let seed_of = |job: u64| seeds[usize::try_from(job).expect("a job is an index of seeds")];
    let work = |(): &mut (), worker: &mut Worker, job: u64| {
        let seed = seed_of(job);
        let begun = worker.reset(seed)?.observations;
        let observation = keys.observe(&begun, &mut Past::default()).expect("an episode that begins has no past");
        Ok(Start { seed, observation })
    };
    let (mut found, mut failure) = (Vec::new(), None);
    pool.run(0..seeds.len() as u64, &seed_of, &|| Ok(()), &work, &mut |_, result| match result {
        Ok(start) => {
            found.push(start);
            ControlFlow::Continue(())
        }
        Err(error) => {
            failure = Some(error);
            ControlFlow::Break(())
        }
    })?;
    match failure {
        Some(error) => Err(error),
        None => Ok((found.len() == seeds.len()).then_some(found)),
    }
}

/// The first seed of the episodes whose beginnings a shuffled thought takes its reasoning from: neither of demonstrations
/// nor of tests.
const OTHERS_FROM: u64 = 30_000;
/// How many they are.
const OTHERS: u64 = 16;

/// `entry` as the subject of an evaluation in which it thinks as `thinking` says. Where its reasoning is shuffled, `pool`
/// shows how other episodes begin. Nothing if it was stopped.
///
/// # Errors
/// A policy that cannot think so, a worker that cannot be made good.
pub fn thinking_subject(
    entry: &LoadedEntry,
    thinking: &Thinking,
    pool: &mut Pool,
) -> Result<Option<Subject<'static>>, ZooError> {
    let entry = entry.thinking(thinking)?;
    let mut subject = entry.subject();
    if let (Some(intervene), Some(model)) = (thinking.intervene, entry.reasoner()?) {
        let seeds: Vec<u64> = (OTHERS_FROM..OTHERS_FROM + OTHERS).collect();
        let others = match intervene {
            Intervention::Freeze => Vec::new(),
            Intervention::Shuffle => match starts(&subject.keys, pool, &seeds)? {
                Some(starts) => starts.into_iter().map(|start| start.observation).collect(),
                None => return Ok(None),
            },
        };
        let (preprocess, others) = (Arc::clone(entry.preprocess()), Arc::new(others));
        subject.policy = Box::new(move || {
            let (model, preprocess) = (Arc::clone(&model), Arc::clone(&preprocess));
            Ok(Box::new(DisturbedPolicy::new(model, preprocess, intervene, Arc::clone(&others))?))
        });
    }
    if let (Some(starts), Some(model)) = (thinking.starts, entry.reasoner()?) {
        let preprocess = Arc::clone(entry.preprocess());
        subject.policy =
            Box::new(move || Ok(Box::new(RestartedPolicy::new(Arc::clone(&model), Arc::clone(&preprocess), starts))));
    }
    Ok(Some(subject))
}
