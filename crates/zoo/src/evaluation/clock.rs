//! The clock that policies think by.

use std::time::Instant;

use models::Clock;

/// The machine's clock, which never goes backwards.
#[derive(Debug, Clone, Copy)]
pub struct WallClock(Instant);

impl WallClock {
    /// Begins now.
    pub fn new() -> Self {
        Self(Instant::now())
    }
}

impl Default for WallClock {
    fn default() -> Self {
        Self::new()
    }
}

impl Clock for WallClock {
    fn milliseconds(&mut self) -> f64 {
        self.0.elapsed().as_secs_f64() * 1e3
    }
}
