//! What can go wrong in a study of robot policies: what its parts refuse.

/// An operation of a study that failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StudyError {
    /// A file, an experiment, a training or an evaluation.
    #[error(transparent)]
    Zoo(#[from] zoo::ZooError),
    /// The demonstrations could not be collected.
    #[error(transparent)]
    Recording(#[from] recording::RecordingError),
    /// A simulator could not be started.
    #[error(transparent)]
    Rollout(#[from] rollout::RolloutError),
}
