//! Intervals for several trainings of one experiment, and across tasks.

use models::Rng;

use super::wilson;

/// Resamples drawn for a standard error.
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

/// What makes the mean of several trainings over the same episodes uncertain, `outcomes[training][episode]`.
struct Spread {
    mean: f64,
    /// Mean of each episode over the trainings.
    episodes: Vec<f64>,
    /// Variance of the trainings' means, with the number of trainings as divisor.
    between: f64,
    /// Mean square of what neither training nor episode explains.
    rest: f64,
}

impl Spread {
    /// `None` without outcomes or for ragged ones.
    fn of(outcomes: &[Vec<f64>]) -> Option<Self> {
        let (m, n) = (outcomes.len() as f64, outcomes.first()?.len());
        if n == 0 || outcomes.iter().any(|training| training.len() != n) {
            return None;
        }
        let trainings: Vec<f64> = outcomes.iter().map(|training| training.iter().sum::<f64>() / n as f64).collect();
        let episodes: Vec<f64> = (0..n).map(|k| outcomes.iter().map(|training| training[k]).sum::<f64>() / m).collect();
        let mean = trainings.iter().sum::<f64>() / m;
        let rest = outcomes.iter().zip(&trainings).flat_map(|(outcomes, training)| {
            outcomes.iter().zip(&episodes).map(move |(x, episode)| (x - training - episode + mean).powi(2))
        });
        Some(Self { mean, between: squares(&trainings, mean) / m, rest: rest.sum::<f64>() / (m * n as f64), episodes })
    }
}

/// The sum of squared distances from `mean`.
fn squares(values: &[f64], mean: f64) -> f64 {
    values.iter().map(|x| (x - mean).powi(2)).sum()
}

/// The mean success of several trainings over the same episodes, `outcomes[training][episode]`, with an interval that
/// holds the chance of training (another seed, other weights) and that of the episodes.
///
/// Both variances of the mean are estimated from the means of the trainings and of the episodes. Each is widened by Student's t
/// of its own degrees of freedom (Cochran and Cox, Experimental Designs, 1957): `sqrt(t(m - 1)^2 v + t(n - 1)^2 w)`. A single
/// training says nothing about another: the interval is then that of its episodes. Outcomes that are all alike have no
/// variance, so the interval is never narrower than Wilson's of the episodes of one training. `None` without outcomes or for
/// ragged ones.
pub fn over_trainings(outcomes: &[Vec<f64>]) -> Option<Estimate> {
    let Spread { mean: value, episodes, between, .. } = Spread::of(outcomes)?;
    let (m, n) = (outcomes.len(), episodes.len());
    let widened = |variance: f64, of: usize| match of {
        1 => 0.0,
        of => student_quantile(of).powi(2) * variance / (of - 1) as f64,
    };
    let half = (widened(between, m) + widened(squares(&episodes, value) / n as f64, n)).sqrt();
    let (least, most) = wilson(value * n as f64, n as f64);
    // rounding must not leave an end beyond the estimate
    let (low, high) = ((value - half).max(0.0).min(least), (value + half).min(1.0).max(most));
    Some(Estimate { value, low: low.min(value), high: high.max(value) })
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
/// episodes (Owen, "The pigeonhole bootstrap", Annals of Applied Statistics 1, 2007), computed rather than drawn. As trainings
/// are few, it is widened by `sqrt(m / (m - 1))` and compared with Student's t of `m - 1` degrees of freedom, where `m` is the
/// smaller number of trainings. Outcomes that are all alike have no error: the interval is Newcombe's of two rates over so many
/// episodes then, and the error of the p-value that of one episode of one training that is otherwise. `None` for fewer than two trainings a side, which cannot tell a training's luck from a difference, and for ragged outcomes.
pub fn difference(first: &[Vec<f64>], second: &[Vec<f64>]) -> Option<Difference> {
    let (one, two) = (Spread::of(first)?, Spread::of(second)?);
    let (m, n) = (first.len().min(second.len()), one.episodes.len());
    if m < 2 || two.episodes.len() != n {
        return None;
    }
    let value = one.mean - two.mean;
    let apart: Vec<f64> = one.episodes.iter().zip(&two.episodes).map(|(a, b)| a - b).collect();
    let of_trainings = |side: &Spread, count: usize| (side.between + side.rest / n as f64) / count as f64;
    let of_episodes = squares(&apart, value) / (n * n) as f64;
    let variance = of_trainings(&one, first.len()) + of_trainings(&two, second.len()) + of_episodes;
    let error = (variance * m as f64 / (m - 1) as f64).sqrt();
    let p_value = match error > 1e-12 {
        true => 2.0 * student_tail(value.abs() / error, m - 1),
        false if value.abs() < 1e-12 => 1.0,
        // as if one episode of one training had been otherwise, which is the smallest error that there is
        false => {
            let (m, n) = (m as f64, n as f64);
            let others = 1.0 - 1.0 / n;
            let variance = ((1.0 - 1.0 / m) * (1.0 + others) + others) / (m * n).powi(2);
            2.0 * student_tail(value.abs() / (variance * m / (m - 1.0)).sqrt(), first.len().min(second.len()) - 1)
        }
    };
    let half = student_quantile(m) * error;
    let (low, high) = match error > 1e-12 {
        true => ((value - half).max(-1.0), (value + half).min(1.0)),
        false => newcombe(one.mean, two.mean, n as f64),
    };
    Some(Difference { estimate: Estimate { value, low, high }, p_value: p_value.min(1.0) })
}

/// Newcombe's 95% interval of a difference of two rates over `n` episodes each (Statistics in Medicine 17, 1998, method 10).
fn newcombe(first: f64, second: f64, n: f64) -> (f64, f64) {
    let ((low, high), (other_low, other_high)) = (wilson(first * n, n), wilson(second * n, n));
    let value = first - second;
    let far = |a: f64, b: f64| (a * a + b * b).sqrt();
    (value - far(first - low, other_high - second), value + far(high - first, second - other_low))
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
    // differences that are all alike have no variance: so many could hide others
    let hidden = if error > 1e-12 { 0.0 } else { wilson(0.0, n as f64).1 };
    let half = student_quantile(n) * error + hidden;
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

/// The interquartile mean over tasks and trainings, `scores[task][training]`, with the standard error of a bootstrap that draws
/// trainings within each task.
///
/// Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", NeurIPS 2021. Few trainings a task
/// vary less than many would: the error is widened by `sqrt(m / (m - 1))`, where `m` is the smallest number of trainings, and by
/// Student's t of `m - 1` degrees of freedom for every task. Scores that are all alike have no error: the interval is never
/// narrower than Wilson's of `episodes`, those of one training. `None` without scores, or where a task has none.
pub fn interquartile(scores: &[Vec<f64>], episodes: u64, seed: u64) -> Option<Estimate> {
    let m = scores.iter().map(Vec::len).min().filter(|least| *least > 0)?;
    let rng = &mut Rng::new(seed, "stratified bootstrap");
    let value = trimmed_mean(scores.concat());
    let drawn: Vec<f64> = (0..RESAMPLES)
        .map(|_| {
            let drawn = scores.iter().flat_map(|task| {
                let picks: Vec<f64> = task.iter().map(|_| task[rng.below(task.len() as u64) as usize]).collect();
                picks
            });
            trimmed_mean(drawn.collect())
        })
        .collect();
    let centre = drawn.iter().sum::<f64>() / drawn.len() as f64;
    let error = (squares(&drawn, centre) / drawn.len() as f64).sqrt();
    let half = match m {
        1 => 0.0,
        m => student_quantile(scores.len() * (m - 1) + 1) * (m as f64 / (m - 1) as f64).sqrt() * error,
    };
    let (low, high) = wilson(value * episodes as f64, episodes as f64);
    Some(Estimate { value, low: (value - half).max(0.0).min(low), high: (value + half).min(1.0).max(high) })
}

/// The mean of what lies between the quartiles, as `scipy.stats.trim_mean(values, 0.25)`.
fn trimmed_mean(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let cut = values.len() / 4;
    let kept = &values[cut..values.len() - cut];
    kept.iter().sum::<f64>() / kept.len() as f64
}

/// 97.5% quantiles of Student's t for 1 to 29 degrees of freedom.
const STUDENT: [f64; 29] = [
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131, 2.120,
    2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045,
];

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::statistics::wilson_interval;

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
        let even = interquartile(&[vec![0.5; 3], vec![0.7; 3]], 200, 1).unwrap();
        assert!((even.value - 0.6).abs() < 1e-12 && even.low < 0.55 && even.high > 0.65);
        let all = interquartile(&[vec![1.0; 3], vec![1.0; 3]], 200, 1).unwrap();
        assert_eq!((all.value, all.high), (1.0, 1.0));
        assert!((all.low - wilson_interval(200, 200).0).abs() < 1e-12, "{all:?}");
        assert_eq!(interquartile(&[], 1, 1), None);
        assert_eq!(interquartile(&[vec![]], 1, 1), None);
    }

    /// Share of intervals that hold the true mean, for `trainings` whose rates vary by `spread` around `rate`.
    fn coverage(trainings: usize, rate: f64, spread: f64) -> f64 {
        let rng = &mut Rng::new(5, "coverage test");
        let (runs, episodes) = (2000, 200);
        let hits = (0..runs)
            .filter(|_| {
                let outcomes: Vec<Vec<f64>> = (0..trainings)
                    .map(|_| {
                        let own = rate + spread * (2.0 * f64::from(rng.uniform()) - 1.0);
                        (0..episodes).map(|_| f64::from(u8::from(f64::from(rng.uniform()) < own))).collect()
                    })
                    .collect();
                let found = over_trainings(&outcomes).unwrap();
                found.low <= rate && rate <= found.high
            })
            .count();
        hits as f64 / runs as f64
    }

    #[test]
    fn the_interval_holds_the_truth_as_often_as_it_says() {
        // 2000 runs at 95%: two standard errors are a point. Three rates from a flat distribution have longer tails than
        // Student's t. The last one is near an edge
        for (trainings, rate, spread, least) in
            [(3, 0.7, 0.0, 0.94), (3, 0.7, 0.2, 0.925), (5, 0.5, 0.1, 0.94), (8, 0.7, 0.3, 0.94), (3, 0.97, 0.02, 0.94)]
        {
            let found = coverage(trainings, rate, spread);
            assert!(found >= least, "{trainings} trainings at {rate} +- {spread}: {found}");
        }
    }

    /// The computed error of a difference beside that of 40,000 draws of trainings and episodes.
    #[test]
    fn errors_are_those_of_crossed_draws() {
        let rng = &mut Rng::new(2, "crossed draws");
        let mut outcomes = |m: usize, rate: f64| -> Vec<Vec<f64>> {
            (0..m).map(|_| (0..30).map(|_| f64::from(u8::from(f64::from(rng.uniform()) < rate))).collect()).collect()
        };
        let (first, second) = (outcomes(4, 0.6), outcomes(3, 0.4));
        let mut drawn = Vec::new();
        for _ in 0..40_000 {
            let columns: Vec<usize> = (0..30).map(|_| rng.below(30) as usize).collect();
            let mut mean = |side: &[Vec<f64>]| {
                let of = |rng: &mut Rng| {
                    let training = &side[rng.below(side.len() as u64) as usize];
                    columns.iter().map(|&k| training[k]).sum::<f64>()
                };
                side.iter().map(|_| of(rng)).sum::<f64>() / (30 * side.len()) as f64
            };
            drawn.push(mean(&first) - mean(&second));
        }
        let centre = drawn.iter().sum::<f64>() / drawn.len() as f64;
        let by_draws = (squares(&drawn, centre) / drawn.len() as f64 * 1.5).sqrt();
        let Estimate { value, low, high } = difference(&first, &second).unwrap().estimate;
        let found = (high - low) / 2.0 / student_quantile(3);
        assert!((found / by_draws - 1.0).abs() < 0.02, "{found} {by_draws}");
        assert!((value - centre).abs() < 0.003);
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
        let found = difference(&high, &low).unwrap();
        assert!(found.p_value < 0.05 && found.estimate.low > 0.05, "{found:?}");
        let turned = difference(&low, &high).unwrap();
        assert!((turned.estimate.value + found.estimate.value).abs() < 1e-12);
        // under no difference, 5% of the tests may say otherwise: two standard errors of 100 are 4.4 points
        let wrong = (0..100)
            .filter(|_| {
                let [a, b] = sides([0.7, 0.7]);
                difference(&a, &b).unwrap().p_value < 0.05
            })
            .count();
        assert!(wrong <= 9, "{wrong} of 100");
        assert_eq!(difference(&high[..1], &low), None);
        // without any variance: as uncertain as so few episodes and trainings are
        let [all, none] = [1.0, 0.0].map(|outcome| vec![vec![outcome; 20]; 3]);
        let same = difference(&all, &all).unwrap();
        assert_eq!((same.estimate.value, same.p_value), (0.0, 1.0));
        assert!(same.estimate.low < -0.1 && same.estimate.high > 0.1, "{same:?}");
        let most = difference(&all, &none).unwrap();
        let mut one = none.clone();
        one[1][7] = 1.0;
        let nearly = difference(&all, &one).unwrap();
        assert!(
            most.estimate.value == 1.0 && 0.0 < most.p_value && most.p_value < nearly.p_value,
            "{most:?} {nearly:?}"
        );
        assert!(nearly.p_value < 0.001 && most.estimate.low < 0.8, "{most:?} {nearly:?}");
    }

    #[test]
    fn edges_are_told() {
        assert_eq!(over_trainings(&[]), None);
        assert_eq!(over_trainings(&[vec![]]), None);
        assert_eq!(over_trainings(&[vec![1.0], vec![1.0, 0.0]]), None);
        // all of 20 and none of 20, in both trainings: as uncertain as one training of 20
        let all = over_trainings(&[vec![1.0; 20], vec![1.0; 20]]).unwrap();
        assert_eq!((all.value, all.low, all.high), (1.0, wilson_interval(20, 20).0, 1.0));
        let none = over_trainings(&[vec![0.0; 20], vec![0.0; 20]]).unwrap();
        assert_eq!((none.value, none.low, none.high), (0.0, 0.0, wilson_interval(0, 20).1));
        // one episode of one training
        let one = over_trainings(&[vec![1.0]]).unwrap();
        assert_eq!((one.value, one.high), (1.0, 1.0));
        assert!(one.low <= wilson_interval(1, 1).0, "{one:?}");
    }
}
