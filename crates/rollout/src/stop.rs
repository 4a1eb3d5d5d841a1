//! Whether the user wants an end, and how long ago that was.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// How long an episode under way may go on after the request to stop: those that are nearly done are kept.
const GRACE: Duration = Duration::from_millis(1000);

/// A request to stop, shared by everything that waits for a worker.
#[derive(Clone)]
pub(crate) struct Stop {
    asked: Arc<dyn Fn() -> bool + Send + Sync>,
    since: Arc<Mutex<Option<Instant>>>,
    grace: Duration,
}

impl Stop {
    /// Nobody asks.
    #[cfg(test)]
    pub(crate) fn never() -> Self {
        Self::new(Arc::new(|| false))
    }

    /// Asked for as `asked` says.
    pub(crate) fn new(asked: Arc<dyn Fn() -> bool + Send + Sync>) -> Self {
        Self { asked, since: Arc::default(), grace: GRACE }
    }

    /// The same request where there is nothing to keep: it is due at once.
    pub(crate) fn at_once(&self) -> Self {
        Self { grace: Duration::ZERO, ..self.clone() }
    }

    /// Whether the end was asked for.
    pub(crate) fn asked(&self) -> bool {
        (self.asked)()
    }

    /// Whether it was asked for, and long enough ago.
    pub(crate) fn due(&self) -> bool {
        let mut since = self.since.lock().unwrap_or_else(PoisonError::into_inner);
        if !(self.asked)() {
            *since = None;
            return false;
        }
        since.get_or_insert_with(Instant::now).elapsed() >= self.grace
    }
}
