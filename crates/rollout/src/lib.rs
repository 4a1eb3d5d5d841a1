//! Rollouts in worker processes: the only part of the project that starts processes of the simulator.
//!
//! What this crate is not: it knows no model, no tensor and no entry. What acts in an episode is an [`Agent`]: named
//! observations in, actions out.
//!
//! A [`Pool`] keeps N [`Worker`]s, each one Python process with one robosuite environment, and runs
//! episodes on them. Workers may die, hang or answer nonsense: their episode is then run again on a
//! fresh worker and its outcome is the same, because an episode depends only on task, seed and policy.

mod checkpoint;
pub mod collection;
mod episode;
mod error;
mod files;
mod frame;
mod greeting;
mod harness;
mod locks;
mod logs;
mod message;
mod pool;
mod process;
mod recorded;
mod spec;
mod stop;
mod worker;

pub use checkpoint::read_robomimic;
pub use episode::{Agent, AgentError, EpisodePlan, Outcome, Watch};
pub use error::{FaultKind, RolloutError, WorkerFault};
pub use frame::{FrameError, FrameTensor, MAX_FRAME_BYTES};
pub use greeting::remembered_greeting;
pub use harness::{Python, cache_folder, find_python, harness_folder};
pub use locks::{lock, try_lock, try_lock_shared, without_locks};
pub use message::{Control, PROTOCOL, Ready, Skill};
pub use pool::{Incident, JobError, Pool, PoolOptions, RunEnd};
pub use recorded::RecordedEpisode;
pub use spec::{TimeLimits, WorkerSpec, check_module, recorded_module, robots_of, set_control_library};
pub use worker::{Image, Initial, Observations, Stepped, Worker};
