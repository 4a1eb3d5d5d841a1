//! What two rows of a task say of each other, and what can be told apart in a whole table.

use std::collections::BTreeMap;

use crate::leaderboard::LeaderboardRow;
use crate::statistics::{Difference, Distinct, EProcess, Paired, barnard, difference, holm, mean_difference, pairs};

/// With fewer seeds in common two rows are compared as if they had none.
pub const FEWEST_SHARED: usize = 20;

/// Most rows of a task and protocol that are compared with each other: those that stand first.
pub const MOST_COMPARED: usize = 60;

/// Rows of a task and protocol whose comparisons with each other are kept: those that stand first.
pub const MOST_PAIRED: usize = 12;

/// Level of every decision.
pub const ALPHA: f64 = 0.05;

/// Which test a p-value comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Test {
    /// Exact McNemar, on the seeds that both were run on; between several trainings the largest of all pairs' p-values.
    McNemar,
    /// Barnard's exact test, where they share too few seeds; between several trainings the largest of all pairs'.
    Barnard,
    /// A bootstrap over trainings and seeds, where both have several trainings.
    Bootstrap,
}

impl Test {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::McNemar => "McNemar",
            Self::Barnard => "Barnard",
            Self::Bootstrap => "bootstrap",
        }
    }
}

/// How the first of two rows did beside the second.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Comparison {
    /// Success rate of the first less that of the second, on the seeds that both share or, if these are too few, on all.
    pub difference: f64,
    /// Its 95% interval, where the rows share seeds and either both have one training or both have several.
    pub interval: Option<(f64, f64)>,
    /// Probability of a difference at least as large if there were none.
    pub p_value: f64,
    /// Where that comes from.
    pub test: Test,
    /// Seeds that both were run on.
    pub shared: usize,
}

/// Outcomes of one training by seed, ascending.
type Outcomes = Vec<(u64, bool)>;

fn outcomes(row: &LeaderboardRow) -> Vec<Outcomes> {
    let of = |evaluation: &zoo::results::StoredEvaluation| {
        evaluation.episodes.iter().map(|episode| (episode.seed, episode.success)).collect()
    };
    row.evaluations().map(of).collect()
}

/// The outcomes on seeds that both have.
fn joined(first: &Outcomes, second: &Outcomes) -> Vec<(bool, bool)> {
    let mut rest = second.iter().peekable();
    let mut pairs = Vec::with_capacity(first.len().min(second.len()));
    for &(seed, success) in first {
        while rest.next_if(|(other, _)| *other < seed).is_some() {}
        if let Some((_, other)) = rest.next_if(|(other, _)| *other == seed) {
            pairs.push((success, *other));
        }
    }
    pairs
}

/// Compares two rows of the same task and protocol.
///
/// Two single trainings are compared on equal seeds by McNemar's exact test, or by Barnard's where they share fewer than
/// [`FEWEST_SHARED`]; two families by a bootstrap over trainings and seeds. A family beside a single training differs from it
/// only as far as each of its trainings does: one training says nothing about the others of its own.
pub fn compare(first: &LeaderboardRow, second: &LeaderboardRow) -> Comparison {
    compare_outcomes(&outcomes(first), &outcomes(second))
}

fn compare_outcomes(first: &[Outcomes], second: &[Outcomes]) -> Comparison {
    let shared = joined(&first[0], &second[0]).len();
    let paired = shared >= FEWEST_SHARED;
    if paired && first.len() > 1 && second.len() > 1 {
        let side = |side: &[Outcomes], other: &Outcomes| -> Vec<Vec<f64>> {
            let kept =
                |one: &Outcomes| joined(one, other).iter().map(|(success, _)| f64::from(u8::from(*success))).collect();
            side.iter().map(kept).collect()
        };
        if let Some(found) = difference(&side(first, &second[0]), &side(second, &first[0])) {
            let interval = Some((found.estimate.low, found.estimate.high));
            let (difference, p_value) = (found.estimate.value, found.p_value);
            return Comparison { difference, interval, p_value, test: Test::Bootstrap, shared };
        }
    }
    let single = first.len() == 1 && second.len() == 1;
    let (mut sum, mut largest, mut interval, mut signs) = (0.0, 0.0_f64, None, (false, false));
    for one in first {
        for two in second {
            let (difference, p_value) = if paired {
                let counts = Paired::of(joined(one, two));
                interval = single.then(|| counts.difference_interval());
                (counts.difference(), counts.mcnemar())
            } else {
                let counts =
                    |one: &Outcomes| (one.iter().filter(|(_, success)| *success).count() as u64, one.len() as u64);
                let rate = |(won, of): (u64, u64)| won as f64 / of.max(1) as f64;
                (rate(counts(one)) - rate(counts(two)), barnard(counts(one), counts(two)))
            };
            sum += difference;
            largest = largest.max(p_value);
            signs = (signs.0 || difference > 0.0, signs.1 || difference < 0.0);
        }
    }
    // trainings that differ in both directions differ in none
    let p_value = if signs == (true, true) { 1.0 } else { largest };
    let test = if paired { Test::McNemar } else { Test::Barnard };
    Comparison { difference: sum / (first.len() * second.len()) as f64, interval, p_value, test, shared }
}

/// Compares outcomes by episode; `paired` where the same number means the same initial state on both sides.
pub fn compare_runs(first: &BTreeMap<u64, bool>, second: &BTreeMap<u64, bool>, paired: bool) -> Comparison {
    let list = |run: &BTreeMap<u64, bool>, from: Option<u64>| -> Outcomes {
        let episodes = run.iter().zip(from.unwrap_or_default()..);
        episodes.map(|((&number, &success), place)| (from.map_or(number, |_| place), success)).collect()
    };
    let start = (!paired).then_some(0);
    let after = (!paired).then_some(first.len() as u64);
    compare_outcomes(&[list(first, start)], &[list(second, after)])
}

/// How much further the first comes on its way than the second, on the seeds that both were run on: two single trainings by
/// Student's t on paired differences, two families by the bootstrap that [`compare`] uses. `None` where not every episode
/// says how far it came, where a family stands beside a single training, and below [`FEWEST_SHARED`] seeds.
pub fn compare_progress(first: &LeaderboardRow, second: &LeaderboardRow) -> Option<Difference> {
    type Shares = BTreeMap<u64, f64>;
    let shares = |row: &LeaderboardRow| -> Option<Vec<Shares>> {
        let of = |one: &zoo::results::StoredEvaluation| -> Option<Shares> {
            one.episodes.iter().map(|episode| Some((episode.seed, episode.progress?))).collect()
        };
        row.evaluations().map(of).collect()
    };
    let (first, second) = (shares(first)?, shares(second)?);
    let shared: Vec<u64> = first[0].keys().filter(|seed| second[0].contains_key(seed)).copied().collect();
    if shared.len() < FEWEST_SHARED {
        return None;
    }
    let kept = |side: &[Shares]| -> Option<Vec<Vec<f64>>> {
        side.iter().map(|one| shared.iter().map(|seed| one.get(seed).copied()).collect()).collect()
    };
    let (first, second) = (kept(&first)?, kept(&second)?);
    match (first.as_slice(), second.as_slice()) {
        ([one], [two]) => mean_difference(&one.iter().zip(two).map(|(a, b)| a - b).collect::<Vec<_>>()),
        _ => difference(&first, &second),
    }
}

/// Two entries on the seeds that both were run on, one by one.
#[derive(Debug, Clone, PartialEq)]
pub struct Flips {
    /// Counts of the four cases.
    pub counts: Paired,
    /// Seeds on which only the first succeeded.
    pub first_only: Vec<u64>,
    /// Seeds on which only the second succeeded.
    pub second_only: Vec<u64>,
    /// The bet, seed after seed in ascending order.
    pub sequential: EProcess,
    /// Seeds after which the bet was decided at [`ALPHA`], if it was.
    pub decided_after: Option<usize>,
    /// Whether it was decided for the first; seeds after that may have turned the lead.
    pub first_is_better: Option<bool>,
}

impl Flips {
    /// Goes through the seeds that both were run on, ascending.
    pub fn of(first: &BTreeMap<u64, bool>, second: &BTreeMap<u64, bool>) -> Self {
        let mut flips = Self {
            counts: Paired::default(),
            first_only: Vec::new(),
            second_only: Vec::new(),
            sequential: EProcess::default(),
            decided_after: None,
            first_is_better: None,
        };
        let mut seen = Vec::new();
        for (&seed, &one) in first {
            let Some(&two) = second.get(&seed) else { continue };
            seen.push((one, two));
            match (one, two) {
                (true, false) => flips.first_only.push(seed),
                (false, true) => flips.second_only.push(seed),
                _ => {}
            }
            flips.sequential.add(one, two);
            if flips.decided_after.is_none() && flips.sequential.is_decided(ALPHA) {
                flips.decided_after = Some(seen.len());
                flips.first_is_better = Some(flips.sequential.lead() > 0);
            }
        }
        flips.counts = Paired::of(seen);
        flips
    }
}

/// Where a row stands among those that it is compared with.
#[derive(Debug, Clone, PartialEq)]
pub struct Standing {
    /// Rows that share a letter cannot be told apart.
    pub letters: String,
    /// The first and the last rank that it may have.
    pub ranks: (usize, usize),
    /// What it is beside each of the first [`MOST_PAIRED`] rows that it is compared with, in their order; none beside itself.
    /// Empty for the rows after those.
    pub beside: Vec<Option<Pair>>,
}

/// A row beside another one, after the correction over the whole table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pair {
    /// The comparison, the row first: its difference is the row's success rate less the other's, its p-value uncorrected.
    pub comparison: Comparison,
    /// The p-value after Holm's correction over all comparisons of the table.
    pub adjusted: f64,
    /// Whether that tells them apart, as letters and ranks do.
    pub distinct: bool,
}

impl Comparison {
    /// The same seen from the second row.
    fn turned(self) -> Self {
        let interval = self.interval.map(|(low, high)| (-high, -low));
        Self { difference: -self.difference, interval, ..self }
    }
}

/// The standing of each of some rows; inner lists are those that are compared with each other, best first. p-values are
/// corrected by Holm's method over all comparisons of all lists together.
pub fn standings(groups: &[Vec<&LeaderboardRow>]) -> Vec<Vec<Option<Standing>>> {
    let compared: Vec<Vec<Vec<Outcomes>>> =
        groups.iter().map(|rows| rows.iter().take(MOST_COMPARED).map(|row| outcomes(row)).collect()).collect();
    let found: Vec<Vec<Comparison>> = compared
        .iter()
        .map(|rows| pairs(rows.len()).map(|(i, j)| compare_outcomes(&rows[i], &rows[j])).collect())
        .collect();
    let p_values: Vec<f64> = found.iter().flatten().map(|comparison| comparison.p_value).collect();
    let mut adjusted = holm(&p_values).into_iter();
    let mut all = Vec::with_capacity(groups.len());
    for ((rows, outcomes), found) in groups.iter().zip(&compared).zip(&found) {
        let n = outcomes.len();
        let corrected: Vec<(f64, f64)> =
            found.iter().map(|comparison| (comparison.difference, adjusted.next().unwrap_or(1.0))).collect();
        let distinct = Distinct::new(n, &corrected, ALPHA);
        let kept = n.min(MOST_PAIRED);
        let mut beside = vec![Vec::new(); n];
        beside.iter_mut().take(kept).for_each(|others| others.resize(kept, None));
        for ((i, j), (&comparison, &(_, adjusted))) in pairs(n).zip(found.iter().zip(&corrected)) {
            if j < kept {
                let distinct = distinct.differ(i, j);
                beside[i][j] = Some(Pair { comparison, adjusted, distinct });
                beside[j][i] = Some(Pair { comparison: comparison.turned(), adjusted, distinct });
            }
        }
        let letters = distinct.letters().into_iter().zip(beside).enumerate();
        let standing = |(i, (letters, beside))| Some(Standing { letters, ranks: distinct.ranks(i), beside });
        let mut standings: Vec<Option<Standing>> = letters.map(standing).collect();
        standings.resize(rows.len(), None);
        all.push(standings);
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(start: u64, successes: &[bool]) -> Outcomes {
        successes.iter().enumerate().map(|(k, success)| (start + k as u64, *success)).collect()
    }

    /// `won` of `n` succeed, the first ones.
    fn first(start: u64, won: usize, n: usize) -> Outcomes {
        run(start, &(0..n).map(|k| k < won).collect::<Vec<_>>())
    }

    #[test]
    fn equal_seeds_are_paired_and_others_are_not() {
        let found = compare_outcomes(&[first(0, 30, 40)], &[first(0, 20, 40)]);
        assert_eq!((found.test, found.shared), (Test::McNemar, 40));
        assert!((found.difference - 0.25).abs() < 1e-12);
        // ten flips, all one way: 2 / 2^10
        assert!((found.p_value - 2.0 / 1024.0).abs() < 1e-12, "{found:?}");
        assert!(found.interval.is_some_and(|(low, high)| 0.0 < low && high < 0.5));
        let found = compare_outcomes(&[first(0, 30, 40)], &[first(30, 20, 40)]);
        assert_eq!((found.test, found.shared, found.interval), (Test::Barnard, 10, None));
        assert!((found.p_value - barnard((30, 40), (20, 40))).abs() < 1e-12);
        // a longer one and a shorter one meet on the seeds of the shorter
        let found = compare_outcomes(&[first(0, 90, 100)], &[first(0, 20, 30)]);
        assert_eq!((found.test, found.shared), (Test::McNemar, 30));
        assert!((found.difference - 1.0 / 3.0).abs() < 1e-12);
    }

    #[test]
    fn runs_of_others_are_paired_only_where_numbers_mean_the_same() {
        let (one, two): (BTreeMap<_, _>, BTreeMap<_, _>) =
            (first(0, 30, 40).into_iter().collect(), first(0, 20, 40).into_iter().collect());
        let found = compare_runs(&one, &two, true);
        assert_eq!((found.test, found.shared), (Test::McNemar, 40));
        let found = compare_runs(&one, &two, false);
        assert_eq!((found.test, found.shared), (Test::Barnard, 0));
        assert!((found.p_value - barnard((30, 40), (20, 40))).abs() < 1e-12);
    }

    #[test]
    fn a_family_differs_from_one_training_as_far_as_each_of_its_own_does() {
        let single = [first(0, 20, 60)];
        let all_better = [first(0, 50, 60), first(0, 45, 60), first(0, 40, 60)];
        let found = compare_outcomes(&all_better, &single);
        // the least of the three: twenty flips one way
        assert!((found.p_value - 2.0_f64.powi(-19)).abs() < 1e-15, "{found:?}");
        let mixed = [first(0, 50, 60), first(0, 10, 60)];
        assert_eq!(compare_outcomes(&mixed, &single).p_value, 1.0);
        let families = compare_outcomes(&all_better, &[first(0, 20, 60), first(0, 18, 60), first(0, 22, 60)]);
        assert_eq!(families.test, Test::Bootstrap);
        assert!(families.p_value < 0.05 && families.interval.is_some_and(|(low, _)| low > 0.0), "{families:?}");
    }

    #[test]
    fn flips_are_listed_seed_by_seed() {
        let one: BTreeMap<u64, bool> = [(3, true), (4, true), (5, false), (7, true)].into();
        let two: BTreeMap<u64, bool> = [(3, false), (4, true), (5, true), (6, true)].into();
        let flips = Flips::of(&one, &two);
        assert_eq!((flips.first_only.as_slice(), flips.second_only.as_slice()), (&[3][..], &[5][..]));
        assert_eq!(flips.counts, Paired { both: 1, first_only: 1, second_only: 1, neither: 0 });
        assert_eq!(flips.decided_after, None);
        let (all, none) = ((0..30).map(|s| (s, true)).collect(), (0..30).map(|s| (s, false)).collect());
        let flips = Flips::of(&all, &none);
        // 2^n B(n + 1/2, 1/2) / B(1/2, 1/2) first reaches 20 at n = 7
        assert_eq!(flips.decided_after, Some(7), "{:?}", flips.sequential);
        assert_eq!(flips.first_is_better, Some(true));
        // what was decided stays so, whatever came later
        let (early, late) = ((0..20).map(|s| (s, s < 7)).collect(), (0..20).map(|s| (s, s >= 7)).collect());
        let flips = Flips::of(&early, &late);
        assert_eq!((flips.decided_after, flips.first_is_better, flips.sequential.lead()), (Some(7), Some(true), -6));
        assert_eq!(Flips::of(&late, &early).first_is_better, Some(false));
    }
}
