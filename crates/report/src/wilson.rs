//! The interval around a success rate.

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
}
