//! Is one policy better than another? Exact tests on counts of successes.

use super::{Z, log_factorials};

/// How two policies did on the same seeds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Paired {
    /// Seeds on which both succeeded.
    pub both: u64,
    /// Seeds on which only the first succeeded.
    pub first_only: u64,
    /// Seeds on which only the second succeeded.
    pub second_only: u64,
    /// Seeds on which neither succeeded.
    pub neither: u64,
}

impl Paired {
    /// Counts pairs of outcomes, one pair a seed.
    pub fn of(outcomes: impl IntoIterator<Item = (bool, bool)>) -> Self {
        let mut counts = Self::default();
        for outcome in outcomes {
            let count = match outcome {
                (true, true) => &mut counts.both,
                (true, false) => &mut counts.first_only,
                (false, true) => &mut counts.second_only,
                (false, false) => &mut counts.neither,
            };
            *count += 1;
        }
        counts
    }

    /// Number of seeds.
    pub fn seeds(&self) -> u64 {
        self.both + self.first_only + self.second_only + self.neither
    }

    /// Success rate of the first less that of the second; 0 without seeds.
    pub fn difference(&self) -> f64 {
        (self.first_only as f64 - self.second_only as f64) / self.seeds().max(1) as f64
    }

    /// The 95% interval of [`Paired::difference`]; all of `[-1, 1]` without seeds.
    ///
    /// Tango, "Equivalence test and confidence interval for the difference in proportions for the paired-sample design",
    /// Statistics in Medicine 17 (1998): the differences that a score test on the same counts does not reject.
    pub fn difference_interval(&self) -> (f64, f64) {
        if self.seeds() == 0 {
            return (-1.0, 1.0);
        }
        let estimate = self.difference();
        let rejected = |delta: f64| self.tango_score(delta).abs() > Z;
        let bound = |mut outside: f64| {
            let mut inside = estimate;
            if !rejected(outside) {
                return outside;
            }
            for _ in 0..60 {
                let middle = 0.5 * (inside + outside);
                if rejected(middle) {
                    outside = middle;
                } else {
                    inside = middle;
                }
            }
            inside
        };
        (bound(-1.0), bound(1.0))
    }

    /// The score statistic of "the difference is `delta`".
    fn tango_score(&self, delta: f64) -> f64 {
        let (n, b, c) = (self.seeds() as f64, self.first_only as f64, self.second_only as f64);
        let distance = b - c - n * delta;
        // the share of `second_only` that is likeliest under `delta`
        let linear = -b - c + (2.0 * n - b + c) * delta;
        let constant = -c * delta * (1.0 - delta);
        let root = (linear * linear - 8.0 * n * constant).max(0.0).sqrt();
        let share = (root - linear) / (4.0 * n);
        let variance = n * (2.0 * share + delta * (1.0 - delta));
        if variance <= 1e-12 {
            if distance.abs() < 1e-9 { 0.0 } else { f64::INFINITY }
        } else {
            distance / variance.sqrt()
        }
    }

    /// The exact two-sided p-value of McNemar's test: could the seeds on which they differ be coin flips?
    ///
    /// McNemar, Psychometrika 12 (1947), with the binomial distribution instead of chi-squared; 1 where they never differ.
    pub fn mcnemar(&self) -> f64 {
        let n = self.first_only + self.second_only;
        let fewer = self.first_only.min(self.second_only);
        if 2 * fewer >= n {
            return 1.0;
        }
        let logs = log_factorials(n);
        let choose = |k: u64| logs[n as usize] - logs[k as usize] - logs[(n - k) as usize];
        let half = n as f64 * std::f64::consts::LN_2;
        let tail: f64 = (0..=fewer).map(|k| (choose(k) - half).exp()).sum();
        (2.0 * tail).min(1.0)
    }
}

/// The first of `from..to` that `is` holds for, and for all after it; `to` if there is none.
fn first(mut from: u64, mut to: u64, is: impl Fn(u64) -> bool) -> u64 {
    while from < to {
        let middle = from + (to - from) / 2;
        if is(middle) {
            to = middle;
        } else {
            from = middle + 1;
        }
    }
    from
}

/// Points at which the unknown common success rate is tried.
const NUISANCE_GRID: usize = 200;

/// The two-sided p-value of Barnard's exact test of two unpaired success rates, `(successes, trials)` each: the pooled
/// score statistic, maximised over the common rate.
///
/// Barnard, "Significance tests for 2 x 2 tables", Biometrika 34 (1947). 1 where a side has no trials.
pub fn barnard((x1, n1): (u64, u64), (x2, n2): (u64, u64)) -> f64 {
    if n1 == 0 || n2 == 0 {
        return 1.0;
    }
    let statistic = |a: u64, b: u64| {
        let (m1, m2) = (n1 as f64, n2 as f64);
        let pooled = (a + b) as f64 / (m1 + m2);
        let variance = pooled * (1.0 - pooled) * (1.0 / m1 + 1.0 / m2);
        if variance <= 0.0 { 0.0 } else { (a as f64 / m1 - b as f64 / m2).abs() / variance.sqrt() }
    };
    // what rounding alone tells apart is the same
    let observed = statistic(x1, x2) * (1.0 - 1e-12) - 1e-12;
    if observed <= 0.0 {
        return 1.0;
    }
    // for each count of the first, the counts of the second that are as extreme: so many from 0 on, and those from one on
    let extreme: Vec<(usize, usize)> = (0..=n1)
        .map(|a| {
            let middle = (u128::from(a) * u128::from(n2) / u128::from(n1)) as u64;
            let below = first(0, middle + 1, |b| statistic(a, b) < observed);
            (below as usize, first(middle + 1, n2 + 1, |b| statistic(a, b) >= observed) as usize)
        })
        .collect();
    let (logs1, logs2) = (log_factorials(n1), log_factorials(n2));
    let probabilities = |n: u64, logs: &[f64], rate: f64| -> Vec<f64> {
        let (yes, no) = (rate.ln(), (-rate).ln_1p());
        (0..=n)
            .map(|k| {
                let choose = logs[n as usize] - logs[k as usize] - logs[(n - k) as usize];
                (choose + k as f64 * yes + (n - k) as f64 * no).exp()
            })
            .collect()
    };
    let p_value = |rate: f64| -> f64 {
        let (p1, p2) = (probabilities(n1, &logs1, rate), probabilities(n2, &logs2, rate));
        let summed = |sum: &mut f64, p: f64| {
            *sum += p;
            Some(*sum)
        };
        let below: Vec<f64> = std::iter::once(0.0).chain(p2.iter().copied().scan(0.0, summed)).collect();
        let above: Vec<f64> = std::iter::once(0.0).chain(p2.iter().rev().copied().scan(0.0, summed)).collect();
        p1.iter().zip(&extreme).map(|(p, &(low, high))| p * (below[low] + above[p2.len() - high])).sum()
    };
    let step = 1.0 / NUISANCE_GRID as f64;
    let (mut best, mut at) = (0.0, 0.5);
    for i in 1..NUISANCE_GRID {
        let rate = i as f64 * step;
        let p = p_value(rate);
        if p > best {
            (best, at) = (p, rate);
        }
    }
    // the peak between the neighbours of the best point
    let (mut low, mut high) = ((at - step).max(1e-9), (at + step).min(1.0 - 1e-9));
    for _ in 0..40 {
        let (a, b) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
        let (pa, pb) = (p_value(a), p_value(b));
        best = best.max(pa).max(pb);
        if pa < pb {
            low = a;
        } else {
            high = b;
        }
    }
    best.min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn differing(first_only: u64, second_only: u64) -> Paired {
        Paired { first_only, second_only, both: 7, neither: 5 }
    }

    #[test]
    fn mcnemar_agrees_with_scipy() {
        // scipy.stats.binomtest(min(b, c), b + c, 0.5).pvalue
        for (b, c, p) in [
            (0, 0, 1.0),
            (0, 1, 1.0),
            (1, 0, 1.0),
            (0, 5, 6.25e-2),
            (3, 3, 1.0),
            (2, 9, 6.542_968_75e-2),
            (10, 25, 1.667_384_780_012_071e-2),
            (0, 20, 1.907_348_632_812_5e-6),
            (100, 140, 1.166_409_231_767_769e-2),
        ] {
            let found = differing(b, c).mcnemar();
            assert!((found - p).abs() < 1e-12, "{b} {c}: {found} against {p}");
        }
    }

    #[test]
    fn barnard_agrees_with_scipy() {
        // scipy.stats.barnard_exact([[a, c], [n1 - a, n2 - c]]).pvalue, except for 150 of 200: there its search stops at
        // 0.09404, beside the highest point, which 4,001 binomial sums show
        for (a, n1, c, n2, p) in [
            (7, 12, 8, 9, 1.451_293_100_655e-1),
            (0, 1, 1, 1, 0.5),
            (0, 10, 10, 10, 1.907_348_632_812e-6),
            (3, 20, 3, 20, 1.0),
            (45, 50, 38, 50, 6.753_400_544_529e-2),
            (150, 200, 164, 200, 9.599_244e-2),
            (0, 5, 0, 5, 1.0),
            (5, 5, 5, 5, 1.0),
            (1, 2, 0, 3, 0.375),
        ] {
            let found = barnard((a, n1), (c, n2));
            assert!((found - p).abs() < 1e-4 * p, "{a}/{n1} {c}/{n2}: {found} against {p}");
            let turned = barnard((c, n2), (a, n1));
            assert!((found - turned).abs() < 1e-9, "{found} and, the other way round, {turned}");
        }
        assert_eq!(barnard((0, 0), (3, 4)), 1.0);
    }

    #[test]
    fn the_interval_of_a_difference_is_the_inverted_score_test() {
        // an independent inversion of the score test, its restricted likelihood maximised numerically (scipy)
        for (both, first_only, second_only, neither, low, high) in [
            (43, 0, 1, 0, -0.118_077, 0.059_393),
            (14, 5, 0, 22, 0.025_836, 0.255_442),
            (36, 12, 2, 0, 0.061_112, 0.344_709),
            (150, 14, 3, 33, 0.016_511, 0.101_306),
            (20, 0, 0, 0, -0.161_125, 0.161_125),
            (3, 1, 1, 1, -0.481_337, 0.481_337),
        ] {
            let counts = Paired { both, first_only, second_only, neither };
            let found = counts.difference_interval();
            assert!((found.0 - low).abs() < 2e-6 && (found.1 - high).abs() < 2e-6, "{counts:?}: {found:?}");
        }
        // what a score interval must do: hold the estimate, and leave 0 out exactly where the score test rejects
        for b in 0..12 {
            for c in 0..12 {
                let counts = Paired { both: 9, first_only: b, second_only: c, neither: 4 };
                let (low, high) = counts.difference_interval();
                assert!(low <= counts.difference() && counts.difference() <= high);
                let z = if b + c == 0 { 0.0 } else { (b as f64 - c as f64).abs() / ((b + c) as f64).sqrt() };
                assert_eq!(low > 0.0 || high < 0.0, z > Z, "{b} {c}: {low} {high}");
            }
        }
        assert_eq!(Paired::default().difference_interval(), (-1.0, 1.0));
    }

    #[test]
    fn pairs_are_counted() {
        let counts = Paired::of([(true, true), (true, false), (true, false), (false, true), (false, false)]);
        assert_eq!(counts, Paired { both: 1, first_only: 2, second_only: 1, neither: 1 });
        assert!((counts.difference() - 0.2).abs() < 1e-12);
    }
}
