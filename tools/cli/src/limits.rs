//! Sizes on the command line that no machine has room or time for: refused before any work.

use anyhow::{Result, bail};

/// Most episodes of one command.
pub const MOST_EPISODES: u64 = 1_000_000;
/// Most control steps of one episode: days of a simulator.
pub const MOST_STEPS: u64 = 1_000_000;
/// What a worker takes with a scene of robosuite, in bytes: between 200 and 450 MB, by task.
const WORKER_BYTES: u64 = 300_000_000;

/// The seeds `start..start + count` as far as they are numbers.
///
/// # Errors
/// Where the last one would be beyond the largest number.
pub fn check_seeds(start: u64, count: u64) -> Result<()> {
    if start.checked_add(count).is_none() {
        bail!("--seed-start {start}: expected room for {count} seeds, the largest is {}", u64::MAX);
    }
    Ok(())
}

/// A number of episodes on the command line.
///
/// # Errors
/// Anything else, in words.
pub fn episodes(text: &str) -> Result<u64, String> {
    let count = text.parse().ok().filter(|count| (1..=MOST_EPISODES).contains(count));
    count.ok_or_else(|| format!("expected a number from 1 to {MOST_EPISODES}"))
}

/// A size on the command line: `500M`, `2G`, `1.5G`, or a number of bytes.
///
/// # Errors
/// Anything else, in words.
pub fn bytes(text: &str) -> Result<u64, String> {
    let (number, unit) = match text.char_indices().next_back() {
        Some((at, letter)) if letter.is_ascii_alphabetic() => (&text[..at], letter.to_ascii_uppercase()),
        _ => (text, 'B'),
    };
    let factor = match unit {
        'B' => Some(1.0),
        'K' => Some(1e3),
        'M' => Some(1e6),
        'G' => Some(1e9),
        'T' => Some(1e12),
        _ => None,
    };
    let size = number.parse::<f64>().ok().zip(factor).map(|(number, factor)| number * factor);
    match size.filter(|size| (0.0..=1e18).contains(size)) {
        Some(size) => Ok(size as u64),
        None => Err("expected a size such as 500M or 2G".to_owned()),
    }
}

/// The side of a square video on the command line, in pixels, at most `MOST`.
///
/// # Errors
/// Anything else, in words.
pub fn video_side<const MOST: u16>(text: &str) -> Result<u16, String> {
    let fits = |side: &u16| *side <= MOST && video::check_size(usize::from(*side), usize::from(*side)).is_ok();
    text.parse().ok().filter(fits).ok_or_else(|| format!("expected an even number from 16 to {MOST}"))
}

/// How many simulators to start: one a core unless another number was asked for.
///
/// # Errors
/// Where memory has no room for them.
pub fn workers(asked: Option<usize>) -> Result<usize> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let Some(asked) = asked else { return Ok(cores) };
    if asked == 0 {
        bail!("--workers 0: expected at least 1");
    }
    if let Some(there) = available_memory().filter(|_| asked > cores) {
        let needed = (asked as u64).saturating_mul(WORKER_BYTES);
        if needed > there {
            bail!(
                "--workers {asked}: need about {} of memory ({} each), {} are free",
                crate::bytes(needed),
                crate::bytes(WORKER_BYTES),
                crate::bytes(there)
            );
        }
    }
    Ok(asked)
}

/// Memory that can be had, in bytes, where the system tells.
fn available_memory() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn sizes_have_units() {
        assert_eq!(["500M", "2G", "1.5g", "7", "7k"].map(bytes), [500e6, 2e9, 1.5e9, 7.0, 7e3].map(|x| Ok(x as u64)));
        for wrong in ["", "G", "-1G", "2Q", "nan", "1e30T", "2 G 1"] {
            assert!(bytes(wrong).unwrap_err().contains("500M or 2G"), "{wrong}");
        }
    }

    #[test]
    fn sides_of_videos_are_even() {
        assert_eq!(["16", "84", "256"].map(video_side::<256>), [Ok(16), Ok(84), Ok(256)]);
        for wrong in ["85", "14", "258", "-16", ""] {
            assert_eq!(video_side::<256>(wrong).unwrap_err(), "expected an even number from 16 to 256", "{wrong}");
        }
    }

    #[test]
    fn what_is_usual_passes_and_what_is_absurd_does_not() {
        check_seeds(10_000, 1_000_000).unwrap();
        check_seeds(u64::MAX - 1, 1).unwrap();
        assert!(check_seeds(u64::MAX, 1).unwrap_err().to_string().contains("--seed-start"));
        workers(None).unwrap();
        workers(Some(1)).unwrap();
        let error = workers(Some(usize::MAX)).unwrap_err().to_string();
        assert!(error.contains("--workers") && error.contains("memory"), "{error}");
        assert!(workers(Some(0)).is_err());
    }
}
