//! An instruction as numbers that need no vocabulary, the same as the harness observes (`actrm_harness/words.py`).

use sha2::{Digest, Sha256};

/// Observation key of the words of an episode's instruction. A conversion makes it of the instruction of LIBERO's own files,
/// which do not hold it.
pub const INSTRUCTION_WORDS: &str = "instruction_words";

/// Numbers of [`instruction_words`].
pub const INSTRUCTION_WIDTH: usize = 32;

/// The mean over the words of (2 b - 255) / 255, b being the bytes of a word's SHA-256: numbers from -1 to 1. Words are
/// ASCII letters, digits and all characters that are not ASCII; capitals are as small letters. A text without words
/// gives zeros.
pub fn instruction_words(text: &str) -> [f32; INSTRUCTION_WIDTH] {
    let text = text.to_ascii_lowercase();
    let words = text.as_bytes().split(|b| b.is_ascii() && !b.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
    let (mut sums, mut count) = ([0_i64; INSTRUCTION_WIDTH], 0_i64);
    for word in words {
        count += 1;
        for (sum, byte) in sums.iter_mut().zip(Sha256::digest(word)) {
            *sum += 2 * i64::from(byte) - 255;
        }
    }
    sums.map(|sum| (sum as f64 / (255 * count.max(1)) as f64) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The numbers are those of `tools/harness/tests/test_words.py`.
    #[test]
    fn words_are_those_of_the_harness() {
        let words = instruction_words("Pick the CUBE, naïve_1!");
        let expected = [243, 27, -19].map(|sum| (f64::from(sum) / 1275.0) as f32);
        assert_eq!(words[..3], expected);
        assert_eq!(words, instruction_words("cube naïve 1 the pick"));
        assert_ne!(words, instruction_words("pick the cube"));
        assert_eq!(instruction_words(" ,"), [0.0; INSTRUCTION_WIDTH]);
    }
}
