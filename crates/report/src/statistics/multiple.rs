//! Many comparisons at once: Holm's correction, and what can be told apart afterwards.

/// Holm's step-down adjusted p-values, in the order given; comparing them with `alpha` bounds the probability of any
/// false rejection by `alpha`.
///
/// Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6 (1979).
pub fn holm(p_values: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..p_values.len()).collect();
    order.sort_by(|&a, &b| p_values[a].total_cmp(&p_values[b]).then(a.cmp(&b)));
    let mut adjusted = vec![0.0; p_values.len()];
    let mut largest: f64 = 0.0;
    for (place, &i) in order.iter().enumerate() {
        largest = largest.max((p_values.len() - place) as f64 * p_values[i]).min(1.0);
        adjusted[i] = largest;
    }
    adjusted
}

/// The pairs `(i, j)`, `i < j`, of `n` things, in the order in which [`holm`] and [`Distinct`] expect them.
pub fn pairs(n: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..n).flat_map(move |i| (i + 1..n).map(move |j| (i, j)))
}

/// Which of some policies can be told apart.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Distinct {
    n: usize,
    /// `better[i][j]`: `i` is better than `j`, and not by chance
    better: Vec<Vec<bool>>,
}

impl Distinct {
    /// From every pair's difference (positive: the first is better) and adjusted p-value, in the order of [`pairs`].
    ///
    /// # Panics
    /// If there are not as many comparisons as pairs.
    pub fn new(n: usize, comparisons: &[(f64, f64)], alpha: f64) -> Self {
        assert_eq!(comparisons.len(), n * n.saturating_sub(1) / 2, "one comparison a pair");
        let mut better = vec![vec![false; n]; n];
        for ((i, j), &(difference, p)) in pairs(n).zip(comparisons) {
            if p < alpha && difference != 0.0 {
                let (winner, loser) = if difference > 0.0 { (i, j) } else { (j, i) };
                better[winner][loser] = true;
            }
        }
        Self { n, better }
    }

    /// Whether `i` and `j` can be told apart.
    pub fn differ(&self, i: usize, j: usize) -> bool {
        self.better[i][j] || self.better[j][i]
    }

    /// The ranks that `i` may have, first and last: 1 for every other one that is shown to be better, and so on.
    pub fn ranks(&self, i: usize) -> (usize, usize) {
        let above = (0..self.n).filter(|&j| self.better[j][i]).count();
        let below = (0..self.n).filter(|&j| self.better[i][j]).count();
        (above + 1, self.n - below)
    }

    /// A compact letter display: two share a letter exactly where they cannot be told apart. Letters are given in the
    /// order of the things, so that sorted best first, the best has an `a`.
    ///
    /// Piepho, "An algorithm for a letter-based representation of all-pairwise comparisons", JCGS 13 (2004).
    pub fn letters(&self) -> Vec<String> {
        let mut groups: Vec<Vec<bool>> = vec![vec![true; self.n]];
        for (i, j) in pairs(self.n).filter(|&(i, j)| self.differ(i, j)) {
            let mut split = Vec::with_capacity(groups.len() + 1);
            for group in groups {
                if group[i] && group[j] {
                    for out in [j, i] {
                        let mut part = group.clone();
                        part[out] = false;
                        split.push(part);
                    }
                } else {
                    split.push(group);
                }
            }
            groups = absorb(split);
        }
        groups.sort_by(|a, b| b.cmp(a));
        (0..self.n)
            .map(|i| groups.iter().enumerate().filter(|(_, group)| group[i]).map(|(g, _)| letter(g)).collect())
            .collect()
    }
}

/// Leaves out groups that lie within another.
fn absorb(groups: Vec<Vec<bool>>) -> Vec<Vec<bool>> {
    let within = |a: &[bool], b: &[bool]| a.iter().zip(b).all(|(a, b)| !a || *b);
    let mut kept: Vec<Vec<bool>> = Vec::with_capacity(groups.len());
    for group in groups {
        if kept.iter().any(|other| within(&group, other)) {
            continue;
        }
        kept.retain(|other| !within(other, &group));
        kept.push(group);
    }
    kept
}

/// a … z, aa, ab, …
fn letter(mut index: usize) -> String {
    let mut text = Vec::new();
    loop {
        text.push(b'a' + (index % 26) as u8);
        if index < 26 {
            break;
        }
        index = index / 26 - 1;
    }
    text.reverse();
    let text: String = text.into_iter().map(char::from).collect();
    if text.len() == 1 { text } else { format!("({text})") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn holm_agrees_with_statsmodels() {
        // statsmodels.stats.multitest.multipletests(p, method="holm")[1]
        let adjusted = holm(&[0.01, 0.04, 0.03, 0.005]);
        for (found, expected) in adjusted.iter().zip([0.03, 0.06, 0.06, 0.02]) {
            assert!((found - expected).abs() < 1e-12, "{adjusted:?}");
        }
        assert_eq!(holm(&[]), Vec::<f64>::new());
        assert_eq!(holm(&[0.9, 0.8]), [1.0, 1.0]);
    }

    #[test]
    fn letters_and_ranks_of_a_small_table() {
        // 0 beats 2 and 3, 1 beats 3; 0-1, 1-2, 2-3 cannot be told apart
        let p = |yes| if yes { 0.001 } else { 0.5 };
        let comparisons: Vec<(f64, f64)> =
            pairs(4).map(|pair| (0.1, p([(0, 2), (0, 3), (1, 3)].contains(&pair)))).collect();
        let distinct = Distinct::new(4, &comparisons, 0.05);
        assert_eq!(distinct.letters(), ["a", "ab", "bc", "c"]);
        assert_eq!((0..4).map(|i| distinct.ranks(i)).collect::<Vec<_>>(), [(1, 2), (1, 3), (2, 4), (3, 4)]);
        assert_eq!(Distinct::new(1, &[], 0.05).letters(), ["a"]);
        assert_eq!(Distinct::new(0, &[], 0.05).letters(), Vec::<String>::new());
    }

    proptest! {
        #[test]
        fn sharing_a_letter_is_not_being_told_apart(n in 1_usize..9, seed in proptest::collection::vec(any::<bool>(), 36)) {
            let comparisons: Vec<(f64, f64)> =
                pairs(n).zip(&seed).map(|(_, &s)| (0.1, if s { 0.01 } else { 0.5 })).collect();
            let distinct = Distinct::new(n, &comparisons, 0.05);
            let letters = distinct.letters();
            for (i, j) in pairs(n) {
                let shared = letters[i].chars().any(|c| letters[j].contains(c));
                prop_assert_eq!(shared, !distinct.differ(i, j), "{:?}", letters);
            }
            prop_assert!(letters.iter().all(|l| !l.is_empty()));
        }
    }
}
