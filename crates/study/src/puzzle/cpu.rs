//! The processor's time that this process has used: what a training costs on one core, however busy the machine is.

use std::fs;

/// User and system time of all threads of this process, in seconds, to the hundredth; 0 where `/proc` cannot be read.
pub fn cpu_seconds() -> f64 {
    // proc(5): fields 14 and 15, in ticks of which every Linux reports 100 a second
    let text = fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let mut fields = text.rsplit(')').next().unwrap_or_default().split_whitespace().skip(11);
    let mut ticks = || fields.next().and_then(|field| field.parse::<f64>().ok()).unwrap_or(0.0);
    (ticks() + ticks()) / 100.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_takes_processor_time() {
        let before = cpu_seconds();
        let mut sum = 0_u64;
        while cpu_seconds() < before + 0.05 {
            sum = (0..100_000_u64).fold(sum, |sum, x| sum.wrapping_mul(31).wrapping_add(x));
        }
        assert!(std::hint::black_box(sum) != 1);
    }
}
