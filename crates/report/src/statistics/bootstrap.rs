//! Intervals for several trainings of one experiment, and across tasks.

use models::Rng;

use super::wilson;

/// Resamples drawn for an interval.
const RESAMPLES: usize = 10_000;

/// An estimate with its 95% interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// The estimate.
    pub value: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// The mean success of several trainings over the same episodes, `outcomes[training][episode]`, with an interval that
/// holds the chance of training (another seed, other weights) and that of the episodes.
///
/// Hierarchical bootstrap: trainings and seeds are drawn with replacement, a seed for all trainings alike, because they
/// were evaluated on the same ones. Few trainings vary less than many would; Hesterberg's expanded percentiles make up
/// for it ("What teachers should know about the bootstrap", The American Statistician 69, 2015). A single training says
/// nothing about another: the interval is then that of its episodes. Draws from outcomes that are all alike have no
/// width, so the interval is never narrower than Wilson's of the episodes of one training. `None` without outcomes or for
/// ragged ones.
pub fn hierarchical(outcomes: &[Vec<f64>], seed: u64) -> Option<Estimate> {
    hierarchical_of(RESAMPLES, outcomes, seed)
}

fn hierarchical_of(resamples: usize, outcomes: &[Vec<f64>], seed: u64) -> Option<Estimate> {
    let (trainings, episodes) = (outcomes.len(), outcomes.first()?.len());
    if episodes == 0 || outcomes.iter().any(|training| training.len() != episodes) {
        return None;
    }
    let rng = &mut Rng::new(seed, "hierarchical bootstrap");
    let mut means = Vec::with_capacity(resamples);
    let mut weights = vec![0.0; episodes];
    for _ in 0..resamples {
        weights.fill(0.0);
        for _ in 0..episodes {
            weights[rng.below(episodes as u64) as usize] += 1.0;
        }
        let sum: f64 = (0..trainings)
            .map(|_| {
                let training = &outcomes[rng.below(trainings as u64) as usize];
                training.iter().zip(&weights).map(|(x, w)| x * w).sum::<f64>()
            })
            .sum();
        means.push(sum / (trainings * episodes) as f64);
    }
    let all: f64 = outcomes.iter().flatten().sum();
    let tail = expanded_tail(if trainings > 1 { trainings } else { episodes });
    let (low, high) = ends(means, tail);
    let value = all / (trainings * episodes) as f64;
    let (least, most) = wilson(value * episodes as f64, episodes as f64);
    // rounding must not leave an end beyond the estimate
    Some(Estimate { value, low: low.min(least).min(value), high: high.max(most).max(value) })
}

/// A difference of two means, with its 95% interval and a two-sided p-value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Difference {
    /// First less second, with its interval.
    pub estimate: Estimate,
    /// Probability of a difference at least as large if there were none.
    pub p_value: f64,
}

/// The mean success of the trainings in `first` less that of those in `second`, `outcomes[training][episode]`, both
/// evaluated on the same episodes.
///
/// The standard error is that of a hierarchical bootstrap which draws the trainings of each side and, for both alike, the
/// episodes; as trainings are few, it is widened by `sqrt(m / (m - 1))` and compared with Student's t of `m - 1` degrees
/// of freedom, where `m` is the smaller number of trainings. `None` for fewer than two trainings a side, which cannot
/// tell a training's luck from a difference, and for ragged outcomes.
pub fn difference(first: &[Vec<f64>], second: &[Vec<f64>], seed: u64) -> Option<Difference> {
    difference_of(RESAMPLES, first, second, seed)
}

fn difference_of(resamples: usize, first: &[Vec<f64>], second: &[Vec<f64>], seed: u64) -> Option<Difference> {
    let episodes = first.first()?.len();
    let m = first.len().min(second.len());
    if m < 2 || episodes == 0 || first.iter().chain(second).any(|training| training.len() != episodes) {
        return None;
    }
    let rng = &mut Rng::new(seed, "bootstrap of a difference");
    let mut weights = vec![0.0; episodes];
    let mut drawn = Vec::with_capacity(resamples);
    for _ in 0..resamples {
        weights.fill(0.0);
        for _ in 0..episodes {
            weights[rng.below(episodes as u64) as usize] += 1.0;
        }
        let mut mean = |side: &[Vec<f64>]| {
            let sum: f64 = side
                .iter()
                .map(|_| {
                    let training = &side[rng.below(side.len() as u64) as usize];
                    training.iter().zip(&weights).map(|(x, w)| x * w).sum::<f64>()
                })
                .sum();
            sum / (side.len() * episodes) as f64
        };
        drawn.push(mean(first) - mean(second));
    }
    let mean = |side: &[Vec<f64>]| side.iter().flatten().sum::<f64>() / (side.len() * episodes) as f64;
    let value = mean(first) - mean(second);
    let centre = drawn.iter().sum::<f64>() / drawn.len() as f64;
    let variance = drawn.iter().map(|x| (x - centre).powi(2)).sum::<f64>() / drawn.len() as f64;
    let error = (variance * m as f64 / (m - 1) as f64).sqrt();
    let (t, p_value) = match error > 1e-12 {
        true => (student_quantile(m), 2.0 * student_tail(value.abs() / error, m - 1)),
        false => (0.0, if value.abs() < 1e-12 { 1.0 } else { 0.0 }),
    };
    let half = t * error;
    let estimate = Estimate { value, low: (value - half).max(-1.0), high: (value + half).min(1.0) };
    Some(Difference { estimate, p_value })
}

/// The mean of shares between 0 and 1 with its 95% interval by Student's t, cut off at 0 and 1; `None` of none. Shares that
/// are all alike have an interval without width, as one value has: Wilson's, of so many trials, then takes its place.
pub fn mean_interval(shares: &[f64]) -> Option<Estimate> {
    let n = shares.len();
    let value = super::mean(shares.iter().copied())?;
    let variance = shares.iter().map(|x| (x - value).powi(2)).sum::<f64>() / (n.max(2) - 1) as f64;
    if variance < 1e-24 {
        let (low, high) = wilson(value * n as f64, n as f64);
        return Some(Estimate { value, low: low.min(value), high: high.max(value) });
    }
    let half = student_quantile(n) * (variance / n as f64).sqrt();
    Some(Estimate { value, low: (value - half).max(0.0), high: (value + half).min(1.0) })
}

/// The mean of paired differences, with its interval and p-value by Student's t; `None` of fewer than two.
pub fn mean_difference(differences: &[f64]) -> Option<Difference> {
    let n = differences.len();
    if n < 2 {
        return None;
    }
    let value = super::mean(differences.iter().copied())?;
    let variance = differences.iter().map(|x| (x - value).powi(2)).sum::<f64>() / (n - 1) as f64;
    let error = (variance / n as f64).sqrt();
    let p_value = match error > 1e-12 {
        true => 2.0 * student_tail(value.abs() / error, n - 1),
        false if value.abs() < 1e-12 => 1.0,
        // all alike: as if signs were tossed
        false => 0.5_f64.powi(i32::try_from(n - 1).unwrap_or(i32::MAX)),
    };
    let half = student_quantile(n) * error;
    let estimate = Estimate { value, low: (value - half).max(-1.0), high: (value + half).min(1.0) };
    Some(Difference { estimate, p_value })
}

/// The 97.5% quantile of Student's t of `m - 1` degrees of freedom.
fn student_quantile(m: usize) -> f64 {
    STUDENT.get(m - 2).copied().unwrap_or(1.96 + 2.4 / (m - 1) as f64)
}

/// P(T > t) for t >= 0 and whole degrees of freedom (Abramowitz and Stegun 26.7.3 and 26.7.4).
fn student_tail(t: f64, degrees: usize) -> f64 {
    let theta = (t / (degrees as f64).sqrt()).atan();
    let (sin, cos) = theta.sin_cos();
    let series = |first: f64, from: usize| {
        // first + first * k/(k+1) cos^2 + ..., up to cos^(degrees - 2)
        let (mut term, mut sum, mut k) = (first, 0.0, from);
        while k <= degrees.saturating_sub(2) {
            sum += term;
            term *= cos * cos * (k + 1) as f64 / (k + 2) as f64;
            k += 2;
        }
        sum
    };
    let inside = match degrees % 2 {
        1 => std::f64::consts::FRAC_2_PI * (theta + sin * series(cos, 1)),
        _ => sin * series(1.0, 0),
    };
    (0.5 * (1.0 - inside)).clamp(0.0, 0.5)
}

/// The interquartile mean over tasks and trainings, `scores[task][training]`, with a bootstrap that draws trainings
/// within each task.
///
/// Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", NeurIPS 2021. `None` without
/// scores, or where a task has none.
pub fn interquartile(scores: &[Vec<f64>], seed: u64) -> Option<Estimate> {
    if scores.is_empty() || scores.iter().any(Vec::is_empty) {
        return None;
    }
    let rng = &mut Rng::new(seed, "stratified bootstrap");
    let value = trimmed_mean(scores.concat());
    let means = (0..RESAMPLES)
        .map(|_| {
            let drawn = scores.iter().flat_map(|task| {
                let picks: Vec<f64> = task.iter().map(|_| task[rng.below(task.len() as u64) as usize]).collect();
                picks
            });
            trimmed_mean(drawn.collect())
        })
        .collect();
    let (low, high) = ends(means, 0.025);
    Some(Estimate { value, low: low.min(value), high: high.max(value) })
}

/// The mean of what lies between the quartiles, as `scipy.stats.trim_mean(values, 0.25)`.
fn trimmed_mean(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let cut = values.len() / 4;
    let kept = &values[cut..values.len() - cut];
    kept.iter().sum::<f64>() / kept.len() as f64
}

/// The values that leave a share of `tail` beyond them on either side.
fn ends(mut values: Vec<f64>, tail: f64) -> (f64, f64) {
    values.sort_by(f64::total_cmp);
    let last = values.len() - 1;
    let at = (tail * last as f64).floor() as usize;
    (values[at], values[last - at])
}

/// 97.5% quantiles of Student's t for 1 to 29 degrees of freedom.
const STUDENT: [f64; 29] = [
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131, 2.120,
    2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045,
];

/// The share beyond an end of the interval for `n` independent units: the normal tail at `sqrt(n / (n - 1)) t(n - 1)`.
fn expanded_tail(n: usize) -> f64 {
    if n < 2 {
        return 0.0;
    }
    normal_tail((n as f64 / (n - 1) as f64).sqrt() * student_quantile(n))
}

/// P(Z > x) for x >= 0, to 1.5e-7 (Abramowitz and Stegun 7.1.26).
fn normal_tail(x: f64) -> f64 {
    let z = x / std::f64::consts::SQRT_2;
    let t = 1.0 / (1.0 + 0.327_591_1 * z);
    let series =
        t * (0.254_829_592 + t * (-0.284_496_736 + t * (1.421_413_741 + t * (-1.453_152_027 + t * 1.061_405_429))));
    0.5 * series * (-z * z).exp()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::statistics::wilson_interval;

    /// Resamples where hundreds of intervals are drawn.
    const FEW: usize = 1000;

    #[test]
    fn tails_agree_with_scipy() {
        // scipy.stats.norm.cdf(-sqrt(m / (m - 1)) * scipy.stats.t.ppf(0.975, m - 1))
        for (m, tail) in [(4, 1.1903e-4), (5, 9.541e-4), (8, 5.7375e-3), (12, 1.07566e-2)] {
            assert!((expanded_tail(m) - tail).abs() < 1e-5, "{m}: {}", expanded_tail(m));
        }
        assert!((normal_tail(1.959_963_985) - 0.025).abs() < 1e-6);
        assert!((expanded_tail(200) - 0.0243).abs() < 5e-4);
    }

    /// `scipy.stats.ttest_1samp` and `scipy.stats.t.interval`.
    #[test]
    fn means_and_their_differences_agree_with_scipy() {
        let near = |found: f64, expected: f64| (found - expected).abs() < 1e-3;
        let found = mean_difference(&[0.1, 0.2, 0.0, -0.1, 0.3]).unwrap();
        let Estimate { value, low, high } = found.estimate;
        assert!((found.p_value - 0.230_199_641).abs() < 1e-8, "{found:?}");
        assert!(near(value, 0.1) && near(low, -0.096_324) && near(high, 0.296_324), "{found:?}");
        let shares: Vec<f64> = (0..40).map(|k| 0.2 * f64::from((k * 7) % 6)).collect();
        let found = mean_difference(&shares.iter().map(|share| share - 0.4).collect::<Vec<_>>()).unwrap();
        assert!((found.p_value - 0.146_299_150).abs() < 1e-8, "{found:?}");
        let interval = mean_interval(&shares).unwrap();
        assert!(near(interval.low, 0.370_834) && near(interval.high, 0.589_166), "{interval:?}");
        let skewed = mean_interval(&[0.0, 0.25, 0.25, 0.5, 0.75, 1.0, 1.0, 1.0, 1.0, 1.0]).unwrap();
        assert!(near(skewed.low, 0.394_755) && near(skewed.high, 0.955_245), "{skewed:?}");
        // all alike: nothing says how far the next may be from them, but how many they are
        let all = mean_interval(&[1.0; 20]).unwrap();
        assert_eq!((all.value, all.high), (1.0, 1.0));
        assert!((all.low - wilson_interval(20, 20).0).abs() < 1e-12);
        assert_eq!(mean_interval(&[0.5]).map(|one| one.value), Some(0.5));
        assert!(mean_interval(&[]).is_none() && mean_difference(&[0.5]).is_none());
        let alike = [mean_difference(&[0.0; 30]).unwrap(), mean_difference(&[0.25; 30]).unwrap()];
        assert_eq!(alike.map(|one| one.p_value), [1.0, 2.0_f64.powi(-29)]);
    }

    #[test]
    fn the_interquartile_mean_is_scipy_s() {
        assert!((trimmed_mean(vec![0.1, 0.5, 0.9, 0.3, 0.7, 1.0, 0.2]) - 0.52).abs() < 1e-12);
        assert!((trimmed_mean(vec![1.0, 2.0, 3.0, 4.0]) - 2.5).abs() < 1e-12);
        assert_eq!(trimmed_mean(vec![3.0]), 3.0);
        let even = interquartile(&[vec![0.5; 3], vec![0.7; 3]], 1).unwrap();
        assert!((even.value - 0.6).abs() < 1e-12 && even.low <= 0.6 && even.high >= 0.6);
        assert_eq!(interquartile(&[], 1), None);
        assert_eq!(interquartile(&[vec![]], 1), None);
    }

    /// Share of intervals that hold the true mean, for `trainings` whose rates vary by `spread` around `rate`.
    fn coverage(trainings: usize, rate: f64, spread: f64) -> f64 {
        let rng = &mut Rng::new(5, "coverage test");
        let (runs, episodes) = (300, 50);
        let hits = (0..runs)
            .filter(|&run| {
                let outcomes: Vec<Vec<f64>> = (0..trainings)
                    .map(|_| {
                        let own = rate + spread * (2.0 * f64::from(rng.uniform()) - 1.0);
                        (0..episodes).map(|_| f64::from(u8::from(f64::from(rng.uniform()) < own))).collect()
                    })
                    .collect();
                let found = hierarchical_of(FEW, &outcomes, run).unwrap();
                found.low <= rate && rate <= found.high
            })
            .count();
        hits as f64 / runs as f64
    }

    #[test]
    fn the_interval_holds_the_truth_as_often_as_it_says() {
        // 300 runs at 95%: two standard errors are 2.5 points
        // the last one near an edge, where a bootstrap alone often has no width
        for (trainings, rate, spread) in [(3, 0.7, 0.2), (5, 0.5, 0.0), (3, 0.97, 0.02)] {
            let found = coverage(trainings, rate, spread);
            assert!(found >= 0.925, "{trainings} trainings at {rate} +- {spread}: {found}");
        }
    }

    const TAILS: [(f64, usize, f64); 7] = [
        (0.0, 3, 5.000000000000e-01),
        (1.0, 1, 2.500000000000e-01),
        (2.5, 2, 6.480586011076e-02),
        (2.776, 4, 2.501138915999e-02),
        (3.3, 5, 1.073775015000e-02),
        (1.3, 7, 1.173839176962e-01),
        (4.2, 10, 9.143482401338e-04),
    ];

    #[test]
    fn student_s_tail_agrees_with_scipy() {
        // scipy.stats.t.sf(t, degrees)
        for (t, degrees, tail) in TAILS {
            let found = student_tail(t, degrees);
            assert!((found - tail).abs() < 1e-9, "t {t}, {degrees}: {found} against {tail}");
        }
    }

    #[test]
    fn a_difference_is_found_and_none_is_not() {
        let rng = &mut Rng::new(9, "difference test");
        let mut sides = |rates: [f64; 2]| {
            rates.map(|rate| -> Vec<Vec<f64>> {
                let one = |own: f64, rng: &mut Rng| {
                    (0..60).map(|_| f64::from(u8::from(f64::from(rng.uniform()) < own))).collect()
                };
                (0..5).map(|i| one(rate + 0.04 * (i as f64 - 2.0), rng)).collect()
            })
        };
        let [high, low] = sides([0.85, 0.5]);
        let found = difference(&high, &low, 1).unwrap();
        assert!(found.p_value < 0.05 && found.estimate.low > 0.05, "{found:?}");
        let turned = difference(&low, &high, 1).unwrap();
        assert!((turned.estimate.value + found.estimate.value).abs() < 1e-12);
        // under no difference, 5% of the tests may say otherwise: two standard errors of 100 are 4.4 points
        let wrong = (0..100)
            .filter(|&run| {
                let [a, b] = sides([0.7, 0.7]);
                difference_of(FEW, &a, &b, run).unwrap().p_value < 0.05
            })
            .count();
        assert!(wrong <= 9, "{wrong} of 100");
        assert_eq!(difference(&high[..1], &low, 1), None);
        let same = difference(&vec![vec![1.0; 4]; 3], &vec![vec![1.0; 4]; 3], 1).unwrap();
        assert_eq!((same.estimate.value, same.p_value), (0.0, 1.0));
    }

    #[test]
    fn edges_are_told() {
        assert_eq!(hierarchical(&[], 1), None);
        assert_eq!(hierarchical(&[vec![]], 1), None);
        assert_eq!(hierarchical(&[vec![1.0], vec![1.0, 0.0]], 1), None);
        // all of 20 and none of 20, in both trainings: as uncertain as one training of 20
        let all = hierarchical(&[vec![1.0; 20], vec![1.0; 20]], 1).unwrap();
        assert_eq!((all.value, all.low, all.high), (1.0, wilson_interval(20, 20).0, 1.0));
        let none = hierarchical(&[vec![0.0; 20], vec![0.0; 20]], 1).unwrap();
        assert_eq!((none.value, none.low, none.high), (0.0, 0.0, wilson_interval(0, 20).1));
        // one episode of one training
        let one = hierarchical(&[vec![1.0]], 1).unwrap();
        assert_eq!((one.value, one.high), (1.0, 1.0));
        assert!(one.low <= wilson_interval(1, 1).0, "{one:?}");
        let same = hierarchical(&[vec![1.0, 0.0, 1.0]], 4);
        assert_eq!(same, hierarchical(&[vec![1.0, 0.0, 1.0]], 4));
    }
}
