//! What a list of numbers says: means, intervals, tests, and comparisons of many.
//!
//! Counts and outcomes come in, numbers go out; nothing here knows an entry or a file.

mod bootstrap;
mod multiple;
mod paired;
mod sequential;

pub use bootstrap::{Difference, Estimate, difference, hierarchical, interquartile};
pub use multiple::{Distinct, holm, pairs};
pub use paired::{Paired, barnard};
pub use sequential::EProcess;

/// 97.5% quantile of the standard normal distribution.
const Z: f64 = 1.959_963_984_540_054;

/// The 95% Wilson score interval of `successes` out of `trials`; all of `[0, 1]` for no trials.
///
/// Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22 (1927).
pub fn wilson_interval(successes: u64, trials: u64) -> (f64, f64) {
    if trials == 0 {
        return (0.0, 1.0);
    }
    let n = trials as f64;
    let p = successes as f64 / n;
    let z2 = Z * Z;
    let centre = (p + z2 / (2.0 * n)) / (1.0 + z2 / n);
    let half = Z / (1.0 + z2 / n) * (p * (1.0 - p) / n + z2 / (4.0 * n * n)).sqrt();
    // rounding must not leave a bound beyond what it bounds
    let low = if successes == 0 { 0.0 } else { (centre - half).max(0.0) };
    let high = if successes == trials { 1.0 } else { (centre + half).min(1.0) };
    (low, high)
}

/// The mean; none of none.
pub fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (mut sum, mut count) = (0.0, 0_u64);
    for value in values {
        sum += value;
        count += 1;
    }
    (count > 0).then(|| sum / count as f64)
}

/// The `q`-quantile of ascending `values` by linear interpolation; none of none.
pub fn quantile(values: &[f64], q: f64) -> Option<f64> {
    let at = q * values.len().checked_sub(1)? as f64;
    let (below, share) = (at.floor() as usize, at.fract());
    let above = (below + 1).min(values.len() - 1);
    Some(values[below] + (values[above] - values[below]) * share)
}

/// ln(k!) for k = 0 … n.
fn log_factorials(n: u64) -> Vec<f64> {
    let mut logs = Vec::with_capacity(n as usize + 1);
    let mut sum = 0.0;
    logs.push(sum);
    for k in 1..=n {
        sum += (k as f64).ln();
        logs.push(sum);
    }
    logs
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agrees_with_published_values() {
        // Newcombe, Statistics in Medicine 17 (1998), table I, method 3 (score, no correction)
        for (successes, trials, low, high) in
            [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0000, 0.1611), (1, 29, 0.0061, 0.1718)]
        {
            let (l, h) = wilson_interval(successes, trials);
            // the table gives four decimals
            assert!((l - low).abs() < 5e-5, "{successes}/{trials}: {l} against {low}");
            assert!((h - high).abs() < 5e-5, "{successes}/{trials}: {h} against {high}");
        }
    }

    #[test]
    fn holds_the_rate_and_narrows_with_trials() {
        for trials in 1..200 {
            for successes in 0..=trials {
                let (low, high) = wilson_interval(successes, trials);
                let rate = successes as f64 / trials as f64;
                assert!(0.0 <= low && low <= rate && rate <= high && high <= 1.0);
                let (l10, h10) = wilson_interval(successes * 10, trials * 10);
                assert!(h10 - l10 < high - low);
                let (flipped, _) = wilson_interval(trials - successes, trials);
                assert!((flipped - (1.0 - high)).abs() < 1e-12);
            }
        }
        assert_eq!(wilson_interval(0, 0), (0.0, 1.0));
    }

    #[test]
    fn quantiles_interpolate_as_numpy_s() {
        let values = [1.0, 2.0, 3.0, 4.0];
        assert_eq!(quantile(&values, 0.5), Some(2.5));
        assert!((quantile(&values, 0.95).expect("of four") - 3.85).abs() < 1e-12);
        assert_eq!(quantile(&values, 0.0), Some(1.0));
        assert_eq!(quantile(&values, 1.0), Some(4.0));
        assert_eq!(quantile(&[7.0], 0.95), Some(7.0));
        assert_eq!(quantile(&[], 0.5), None);
        assert_eq!((mean([1.0, 2.0].into_iter()), mean(std::iter::empty())), (Some(1.5), None));
    }
}
