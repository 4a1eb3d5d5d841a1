//! Comparing two policies until it is decided, looking after every episode.

/// A bet against "on the seeds where they differ, either is as likely to succeed", valid however often one looks and
/// whenever one stops: under that hypothesis the probability that the wealth ever reaches `1 / alpha` is at most `alpha`.
///
/// Ville's inequality; the bets are Krichevsky and Trofimov's mixture, `wealth = 2^n B(w + 1/2, l + 1/2) / B(1/2, 1/2)`.
/// See Ramdas et al., "Game-theoretic statistics and safe anytime-valid inference", Statistical Science 38 (2023).
#[derive(Debug, Clone, PartialEq)]
pub struct EProcess {
    first_only: u64,
    second_only: u64,
    log_wealth: f64,
    /// the most that it ever was
    log_peak: f64,
}

impl Default for EProcess {
    fn default() -> Self {
        Self { first_only: 0, second_only: 0, log_wealth: 0.0, log_peak: 0.0 }
    }
}

impl EProcess {
    /// Adds the outcomes of both on one more seed.
    pub fn add(&mut self, first: bool, second: bool) {
        if first == second {
            return;
        }
        let seen = self.first_only + self.second_only;
        let count = if first { &mut self.first_only } else { &mut self.second_only };
        self.log_wealth += (2.0 * (*count as f64 + 0.5) / (seen as f64 + 1.0)).ln();
        *count += 1;
        self.log_peak = self.log_peak.max(self.log_wealth);
    }

    /// The evidence now.
    pub fn e_value(&self) -> f64 {
        self.log_wealth.exp()
    }

    /// A p-value that holds at every moment at once.
    pub fn p_value(&self) -> f64 {
        (-self.log_peak).exp().min(1.0)
    }

    /// Whether the two were told apart at level `alpha`, now or before.
    pub fn is_decided(&self, alpha: f64) -> bool {
        self.p_value() <= alpha
    }

    /// Which is ahead on the seeds where they differ: positive for the first.
    pub fn lead(&self) -> i64 {
        self.first_only as i64 - self.second_only as i64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use models::Rng;

    /// Share of 2,000 comparisons of `episodes` seeds each that are decided at 5%, looking after every seed.
    fn decided(first: f32, second: f32, episodes: usize) -> f64 {
        let mut rng = Rng::new(11, "sequential test");
        let runs = 2_000;
        let hits = (0..runs)
            .filter(|_| {
                let mut process = EProcess::default();
                (0..episodes).any(|_| {
                    process.add(rng.uniform() < first, rng.uniform() < second);
                    process.is_decided(0.05)
                })
            })
            .count();
        hits as f64 / f64::from(runs)
    }

    #[test]
    fn looking_after_every_episode_keeps_the_error_rate() {
        // 1.5 standard errors of 2,000 runs at 5%: 0.007
        for rate in [0.5, 0.9, 0.99] {
            let wrong = decided(rate, rate, 1_000);
            assert!(wrong <= 0.05 + 0.007, "rate {rate}: {wrong}");
        }
        // and it does decide: 95 against 75 of 100
        assert!(decided(0.95, 0.75, 300) > 0.95);
    }

    #[test]
    fn the_wealth_is_the_mixture() {
        let mut process = EProcess::default();
        for (first, second) in [(true, false), (true, true), (true, false), (false, true)] {
            process.add(first, second);
        }
        // 2^3 B(2.5, 1.5) / B(0.5, 0.5) = 8 * (pi / 16) / pi
        assert!((process.e_value() - 0.5).abs() < 1e-12, "{}", process.e_value());
        assert_eq!(process.lead(), 1);
        // after two wins it was 2^2 B(2.5, 0.5) / B(0.5, 0.5) = 1.5
        assert!((process.p_value() - 1.0 / 1.5).abs() < 1e-12);
    }
}
