//! What a list of numbers says: means, intervals, tests, and comparisons of many.
//!
//! Counts and outcomes come in, numbers go out; nothing here knows an entry or a file.

mod bootstrap;
mod multiple;
mod paired;
mod sequential;

pub use bootstrap::{Difference, Estimate, difference, interquartile, mean_difference, mean_interval, over_trainings};
pub use multiple::{Distinct, holm, pairs};
pub use paired::{Paired, barnard};
pub use sequential::{Bet, EProcess, Unpaired};

/// 97.5% quantile of the standard normal distribution.
const Z: f64 = 1.959_963_984_540_054;

/// The 95% Wilson score interval of `successes` out of `trials`; all of `[0, 1]` for no trials.
///
/// Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22 (1927).
pub fn wilson_interval(successes: u64, trials: u64) -> (f64, f64) {
    if trials == 0 {
        return (0.0, 1.0);
    }
    let (low, high) = wilson(successes as f64, trials as f64);
    // rounding must not leave a bound beyond what it bounds
    (if successes == 0 { 0.0 } else { low }, if successes == trials { 1.0 } else { high })
}

/// The same for a mean number of successes, which may lie between two whole ones.
fn wilson(successes: f64, n: f64) -> (f64, f64) {
    let p = successes / n;
    let z2 = Z * Z;
    let centre = (p + z2 / (2.0 * n)) / (1.0 + z2 / n);
    let half = Z / (1.0 + z2 / n) * (p * (1.0 - p) / n + z2 / (4.0 * n * n)).sqrt();
    ((centre - half).max(0.0), (centre + half).min(1.0))
}

/// A share in percent, with `digits` decimal places and more where those would say that all or none succeeded: 6,597 of
/// 6,600 is `99.95`, never `100.0`.
pub fn percent(part: u64, of: u64, digits: usize) -> String {
    share_percent(part as f64 / of.max(1) as f64, digits)
}

/// A share between 0 and 1 in percent, like [`percent`].
pub fn share_percent(share: f64, digits: usize) -> String {
    let rate = share * 1e2;
    let some = 0.0 < share && share < 1.0;
    let text = |digits: usize| format!("{rate:.digits$}");
    let edge = |text: &str| text.parse::<f64>().is_ok_and(|shown| shown == 0.0 || shown == 100.0);
    (digits..12).map(text).find(|text| !some || !edge(text)).unwrap_or_else(|| text(12))
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
    fn edges_agree_with_statsmodels() {
        // statsmodels.stats.proportion.proportion_confint(k, n, method="wilson")
        for (successes, trials, low, high) in [
            (0, 1, 0.0, 0.793_450_685_622_762_6),
            (1, 1, 0.206_549_314_377_237_4, 1.0),
            (0, 100, 0.0, 0.036_993_498_206_985_68),
            (100, 100, 0.963_006_501_793_014_3, 1.0),
            (1, 2, 0.094_531_205_734_230_74, 0.905_468_794_265_769_3),
        ] {
            let (l, h) = wilson_interval(successes, trials);
            assert!((l - low).abs() < 1e-12 && (h - high).abs() < 1e-12, "{successes}/{trials}: {l} {h}");
        }
    }

    #[test]
    fn a_share_is_not_rounded_to_all_or_none() {
        for (part, of, digits, text) in [
            (6_597, 6_600, 1, "99.95"),
            (6_600, 6_600, 1, "100.0"),
            (0, 6_600, 1, "0.0"),
            (1, 6_600, 1, "0.02"),
            (199, 200, 0, "99.5"),
            (151, 200, 0, "76"),
            (1, 1_000_000_000, 0, "0.0000001"),
            (0, 0, 1, "0.0"),
        ] {
            assert_eq!(percent(part, of, digits), text, "{part}/{of}");
        }
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
