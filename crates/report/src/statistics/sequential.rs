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

/// How the evidence of two unpaired policies grows with every pair of episodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Bet {
    /// N-SCORE for successes: the wealth grows by `1 + lambda (better - worse)`, where `lambda` is best for the rates so far.
    ///
    /// Agrees with `nscore.nsm.BernoulliNsmTest` (alternative `P0LessThanP1`) of the Python package `nscore`.
    NScore,
    /// Likelihood of the rates so far over that of their mean.
    ///
    /// Turner and Grünwald, "Exact anytime-valid confidence intervals for contingency tables and beyond", Statistics &
    /// Probability Letters 198 (2023), section 2. Agrees with `SaviTest` of the Python package `sequentialized-barnard-tests`.
    Savi,
}

/// Evidence for "one of two is better", valid however often one looks: the i-th episode of one beside the i-th of the other.
/// Episodes need not share seeds.
#[derive(Debug, Clone, PartialEq)]
pub struct Unpaired {
    /// for the first, for the second
    sides: [OneSided; 2],
}

/// Evidence for "the second is better".
#[derive(Debug, Clone, PartialEq)]
struct OneSided {
    bet: Bet,
    /// successes and failures of each, with one success before the first episode for the better and one failure for the worse
    counts: [[f64; 2]; 2],
    log_wealth: f64,
    log_peak: f64,
}

impl OneSided {
    fn new(bet: Bet) -> Self {
        Self { bet, counts: [[1.0, 2.0], [2.0, 1.0]], log_wealth: 0.0, log_peak: 0.0 }
    }

    fn add(&mut self, outcomes: [bool; 2]) {
        let [worse, better] = self.counts.map(|[won, lost]| won / (won + lost));
        let gap = better - worse;
        if gap > 0.0 {
            self.log_wealth += match self.bet {
                Bet::NScore => {
                    let share = gap / (gap + 2.0 * worse * (1.0 - better));
                    let [first, second] = outcomes.map(|outcome| f64::from(u8::from(outcome)));
                    (share * (second - first)).ln_1p()
                }
                Bet::Savi => {
                    let mean = (worse + better) / 2.0;
                    let log = |rate: f64, outcome: bool| if outcome { rate.ln() } else { (-rate).ln_1p() };
                    let of = |rate: f64, outcome: bool| log(rate, outcome) - log(mean, outcome);
                    of(worse, outcomes[0]) + of(better, outcomes[1])
                }
            };
        }
        self.log_peak = self.log_peak.max(self.log_wealth);
        for (counts, outcome) in self.counts.iter_mut().zip(outcomes) {
            counts[usize::from(!outcome)] += 1.0;
        }
    }

    fn p_value(&self) -> f64 {
        (-self.log_peak).exp().min(1.0)
    }
}

impl Unpaired {
    /// No episode yet.
    pub fn new(bet: Bet) -> Self {
        Self { sides: [OneSided::new(bet), OneSided::new(bet)] }
    }

    /// The episodes of both, in order, as far as both have one.
    pub fn of(bet: Bet, episodes: impl IntoIterator<Item = (bool, bool)>) -> Self {
        let mut all = Self::new(bet);
        episodes.into_iter().for_each(|(first, second)| all.add(first, second));
        all
    }

    /// Adds an episode of each.
    pub fn add(&mut self, first: bool, second: bool) {
        self.sides[0].add([second, first]);
        self.sides[1].add([first, second]);
    }

    /// One-sided p-values of "the first is better" and "the second is better", each valid at every moment.
    pub fn one_sided(&self) -> [f64; 2] {
        [self.sides[0].p_value(), self.sides[1].p_value()]
    }

    /// The p-value of "one of them is better".
    pub fn p_value(&self) -> f64 {
        let [first, second] = self.one_sided();
        (2.0 * first.min(second)).min(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use models::Rng;

    /// `fixtures/make.py` writes the tables and what the Python packages say of them.
    #[test]
    fn unpaired_bets_agree_with_the_python_packages() {
        let text = include_str!("../../fixtures/sequential.json");
        let tables: Vec<serde_json::Value> = serde_json::from_str(text).expect("JSON");
        assert!(tables.len() >= 60);
        for table in &tables {
            let code = table["outcomes"].as_str().expect("a text");
            // 0: neither, 1: only the first, 2: only the second, 3: both
            let episodes = || code.bytes().map(|byte| (byte & 1 == 1, byte & 2 == 2));
            for (name, bet) in [("nscore", Bet::NScore), ("savi", Bet::Savi)] {
                let found = Unpaired::of(bet, episodes()).one_sided();
                for (side, found) in found.iter().enumerate() {
                    let expected = table[name][side].as_f64().expect("a number");
                    // sums of up to 400 logarithms
                    assert!((found / expected - 1.0).abs() < 1e-9, "{name} {side} of {code}: {found} {expected}");
                }
            }
        }
    }

    #[test]
    fn unpaired_bets_keep_the_error_rate() {
        for bet in [Bet::NScore, Bet::Savi] {
            let mut rng = Rng::new(12, "unpaired sequential test");
            let mut decided = |first: f32, second: f32| {
                let runs = 1_000;
                let hits = (0..runs).filter(|_| {
                    let mut evidence = Unpaired::new(bet);
                    (0..300).for_each(|_| evidence.add(rng.uniform() < first, rng.uniform() < second));
                    evidence.p_value() <= 0.05
                });
                hits.count() as f64 / f64::from(runs)
            };
            for rate in [0.1, 0.5, 0.9] {
                // 1.5 standard errors of 1,000 runs at 5%: 0.01
                assert!(decided(rate, rate) <= 0.05 + 0.01, "{bet:?} at {rate}");
            }
            assert!(decided(0.9, 0.6) > 0.95, "{bet:?}");
        }
    }

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
