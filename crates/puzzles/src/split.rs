//! Training, validation and test puzzles that never share a maze or a solution: the split is a property of the puzzle's
//! content, not of the order in which it was drawn.

/// Which part of a family a puzzle belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Split {
    /// 70% of the shapes.
    Train,
    /// 10%: for choosing between settings and checkpoints.
    Valid,
    /// 20%: for the numbers that are reported.
    Test,
}

impl Split {
    /// All three.
    pub const ALL: [Self; 3] = [Self::Train, Self::Valid, Self::Test];

    /// `train`, `valid` or `test`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Valid => "valid",
            Self::Test => "test",
        }
    }

    /// The split of that name.
    pub fn by_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|split| split.name() == name)
    }

    /// The split of a puzzle by the [`fingerprint`] of what must not be shared.
    pub fn of(fingerprint: u64) -> Self {
        match fingerprint % 10 {
            0..7 => Self::Train,
            7 => Self::Valid,
            _ => Self::Test,
        }
    }
}

/// A well-mixed number for a sequence of values (FNV-1a, finished with SplitMix64): fixed for ever, since it decides
/// which puzzle may be trained on.
pub fn fingerprint(values: impl IntoIterator<Item = u64>) -> u64 {
    let mut hash = values
        .into_iter()
        .fold(0xcbf2_9ce4_8422_2325_u64, |hash, value| (hash ^ value).wrapping_mul(0x0000_0100_0000_01b3));
    hash = (hash ^ (hash >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    hash = (hash ^ (hash >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    hash ^ (hash >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_70_10_20() {
        let mut counts = [0_usize; 3];
        for value in 0..100_000 {
            counts[Split::of(fingerprint([value, value / 3])) as usize] += 1;
        }
        for (count, expected) in counts.into_iter().zip([70_000, 10_000, 20_000]) {
            assert!(count.abs_diff(expected) < 800, "{counts:?}");
        }
    }

    #[test]
    fn the_split_of_a_puzzle_never_changes() {
        assert_eq!(fingerprint([]), 0xf52a_15e9_a9b5_e89b);
        assert_eq!(fingerprint([1, 2, 3]), fingerprint([1, 2, 3]));
        assert_ne!(fingerprint([1, 2, 3]), fingerprint([3, 2, 1]));
    }
}
