//! `[data.exchange]`: things that may change places with each other in training, all but the one that the hand took.
//!
//! ```toml
//! [data.exchange.cubes]
//! taken = ["gripper_to_cube0", "gripper_to_cube1", "gripper_to_cube2"]
//! items = [["cube0_color"], ["cube1_color"], ["cube2_color"]]
//! places = [["cube0_pos", "gripper_to_cube0"], ["cube1_pos", "gripper_to_cube1"], ["cube2_pos", "gripper_to_cube2"]]
//! ```
//!
//! Each demonstration shows by its end which thing was meant: the one whose vector in `taken`, from the hand, is the
//! shortest in the last observation, of those that are not zero, which are not there. Whatever the others are, the same demonstration is right. So what is known of them
//! (`items`, as many lists as things, alike) is dealt out among them at random in every sample. And where `places` are
//! named, each of them is moved to where another demonstration's taken thing lay, drawn for the sample from the
//! [`NEAREST`] that are nearest to it: by the vector between the two at the beginnings, as the first item of each list
//! tells them, all items of the list alike. Then everything lies where something was taken once, and no place by itself
//! tells the one that was taken this time. A policy that points (`[policy.pointer]`) learns from the same table which thing
//! was taken. Without this, a few hundred demonstrations, each with an arrangement of its own,
//! can be learned by heart instead of the rule that leads to the thing. Things may come to overlap a little. Validation
//! sees the observations as they are. A batch depends on the seed and the step alone, so that a resumed run needs no state
//! of this.

use std::path::Path;

use dataset::shuffle::SplitMix64;
use dataset::{Dataset, WindowBatch, Windows};
use models::Signature;

use crate::ZooError;
use crate::experiment::Experiment;

use super::places::{Place, Places};

/// Keeps the draws apart from those of the batches' order, which have the same seed.
const PURPOSE: u64 = 0x4558_4348_414e_4745;

/// So many places are there to draw from for each thing that is moved: few enough to stay in its neighbourhood.
const NEAREST: usize = 16;

/// The exchanges of a run.
#[derive(Default)]
pub(crate) struct Exchanges {
    seed: u64,
    all: Vec<Exchange>,
    /// of what a pointer is asked: which of `all` says what was taken, and of each thing its feature's place in the signature
    pointed: Option<(usize, Vec<u32>)>,
}

/// Things that change places.
#[derive(Debug, PartialEq)]
struct Exchange {
    /// What belongs to each thing, and goes from one to another.
    things: Vec<Vec<Place>>,
    /// What says where each thing is, and is moved; may be empty.
    moved: Vec<Vec<Place>>,
    episodes: Vec<Episode>,
}

/// What is known of a demonstration as a whole.
#[derive(Debug, PartialEq)]
struct Episode {
    /// The first window that is not this one's or an earlier one's.
    end: u32,
    /// The thing that the hand took.
    taken: usize,
    /// Where each thing lay at the beginning, if that is to be changed.
    beginning: Vec<Vec<f32>>,
}

impl Exchanges {
    /// Finds where the items stand in the columns of `dataset`, and what was taken in each episode of `windows`, which are
    /// seen as `signature` says.
    ///
    /// # Errors
    /// An item that stands nowhere, items of unequal lengths, by name; a file of pictures that cannot be read.
    pub fn new(
        experiment: &Experiment,
        dataset: &Dataset,
        windows: &Windows,
        signature: &Signature,
        path: &Path,
    ) -> Result<Self, ZooError> {
        let (mut all, mut pointed) = (Vec::new(), None);
        if !experiment.data.exchange.is_empty() {
            let places = Places::new(experiment, dataset, path, "data.exchange")?;
            for (name, section) in &experiment.data.exchange {
                let from_hand = places.alike(&format!("data.exchange.{name}.taken"), &section.taken)?;
                let things = of_things(&places, &format!("data.exchange.{name}.items"), &section.items)?;
                let moved = of_things(&places, &format!("data.exchange.{name}.places"), &section.places)?;
                if experiment.pointed_exchange() == Some(name.as_str()) {
                    let place =
                        |place: &Place| signature.observation.iter().position(|spec| spec.name == place.feature);
                    let features = from_hand.iter().filter_map(place).map(|at| at as u32).collect();
                    pointed = Some((all.len(), features));
                }
                let episodes = episodes(&from_hand, &moved, windows);
                let episodes = episodes.map_err(super::data::unreadable(&path.display().to_string()))?;
                all.push(Exchange { things, moved, episodes });
            }
        }
        Ok(Self { seed: experiment.train.seed ^ PURPOSE, all, pointed })
    }

    /// Of each window the feature that its demonstration took, by its place in the signature; `None` where no pointer asks.
    pub fn taken(&self, windows: &WindowBatch) -> Option<Vec<u32>> {
        let (at, features) = self.pointed.as_ref()?;
        let exchange = &self.all[*at];
        Some(windows.indices.iter().map(|&index| features[exchange.episode(index).taken]).collect())
    }

    /// Deals out and moves the things of the windows of step `step`, each window by itself, alike in all its observations.
    pub fn apply(&self, step: u64, windows: &mut WindowBatch) {
        let mut rng = SplitMix64::new(self.seed, step);
        for exchange in &self.all {
            for row in 0..windows.n {
                let episode = exchange.episode(windows.indices[row]);
                let others: Vec<usize> = (0..exchange.things.len()).filter(|thing| *thing != episode.taken).collect();
                exchange.deal(&others, row, windows, &mut rng);
                if !exchange.moved.is_empty() {
                    exchange.lay(&others, episode, row, windows, &mut rng);
                }
            }
        }
    }
}

impl Exchange {
    /// Of a window, by its number.
    fn episode(&self, window: u32) -> &Episode {
        &self.episodes[self.episodes.partition_point(|episode| episode.end <= window)]
    }

    fn deal(&self, others: &[usize], row: usize, windows: &mut WindowBatch, rng: &mut SplitMix64) {
        let (mut dealt, mut before) = (others.to_vec(), Vec::new());
        rng.shuffle(&mut dealt);
        for at in 0..self.things[0].len() {
            for observation in 0..windows.n_obs_steps {
                before.clear();
                for &thing in &dealt {
                    before.extend_from_slice(self.things[thing][at].of(windows, row, observation));
                }
                for (&thing, values) in others.iter().zip(before.chunks_exact(self.things[0][at].width)) {
                    self.things[thing][at].of_mut(windows, row, observation).copy_from_slice(values);
                }
            }
        }
    }

    fn lay(&self, others: &[usize], own: &Episode, row: usize, windows: &mut WindowBatch, rng: &mut SplitMix64) {
        let mut near: Vec<(f32, usize)> = Vec::with_capacity(self.episodes.len());
        for &thing in others {
            let here = &own.beginning[thing];
            let squared = |there: &[f32]| here.iter().zip(there).map(|(a, b)| (a - b) * (a - b)).sum::<f32>();
            near.clear();
            near.extend(
                (self.episodes.iter().enumerate().filter(|(_, other)| other.end != own.end))
                    .map(|(at, other)| (squared(&other.beginning[other.taken]), at)),
            );
            let order = |a: &(f32, usize), b: &(f32, usize)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
            if near.len() > NEAREST {
                near.select_nth_unstable_by(NEAREST, order);
                near.truncate(NEAREST);
            }
            near.sort_unstable_by(order);
            if near.is_empty() {
                continue;
            }
            let other = &self.episodes[near[rng.below(near.len() as u64) as usize].1];
            let there = &other.beginning[other.taken];
            for place in &self.moved[thing] {
                for observation in 0..windows.n_obs_steps {
                    let vector = place.of_mut(windows, row, observation);
                    vector.iter_mut().zip(here.iter().zip(there)).for_each(|(x, (a, b))| *x += b - a);
                }
            }
        }
    }
}

/// The places of each thing's items, of which the first ones of all things are alike, and the second ones, ...
fn of_things(places: &Places, key: &str, items: &[Vec<String>]) -> Result<Vec<Vec<Place>>, ZooError> {
    let mut things = vec![Vec::new(); items.len()];
    for at in 0..items.first().map_or(0, Vec::len) {
        let alike: Vec<String> = items.iter().map(|thing| thing[at].clone()).collect();
        for (thing, place) in things.iter_mut().zip(places.alike(key, &alike)?) {
            thing.push(place);
        }
    }
    Ok(things)
}

/// What the windows say of each episode: what lies nearest to the hand in its last observation, by `from_hand`, and where
/// what is `moved` lay in its first.
fn episodes(
    from_hand: &[Place],
    moved: &[Vec<Place>],
    windows: &Windows,
) -> Result<Vec<Episode>, dataset::DatasetError> {
    let mut ends = WindowBatch::default();
    let episode = |range: std::ops::Range<u32>| {
        windows.try_gather(&[range.start, range.end - 1], &mut ends)?;
        let last = ends.n_obs_steps - 1;
        let squared = |place: &Place| place.of(&ends, 1, last).iter().map(|x| x * x).sum::<f32>();
        // a thing that is not there is seen as zeros
        let there = (0..from_hand.len()).filter(|thing| squared(&from_hand[*thing]) > 0.0);
        let nearest = there.min_by(|a, b| squared(&from_hand[*a]).total_cmp(&squared(&from_hand[*b])));
        let beginning = moved.iter().map(|thing| thing[0].of(&ends, 0, last).to_vec()).collect();
        Ok(Episode { end: range.end, taken: nearest.unwrap_or(0), beginning })
    };
    windows.episodes().into_iter().map(episode).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::collections::BTreeSet;

    use super::*;

    const N: usize = 300;

    /// Four things in two observations: a number of `a` and two of `b` each, told by their tens.
    fn windows() -> WindowBatch {
        let a = (0..N).flat_map(|_| [10.0, 20.0, 30.0, 40.0, 11.0, 21.0, 31.0, 41.0]).collect();
        let things = |step: f32| (1..5).flat_map(move |thing| [10.0 * thing as f32 + step, 10.0 * thing as f32 + 5.0]);
        let b = (0..N).flat_map(|_| [7.0].into_iter().chain(things(0.0)).chain([7.0]).chain(things(1.0))).collect();
        let observation = vec![("a".to_owned(), a), ("b".to_owned(), b)];
        let indices = (0..N as u32).rev().collect();
        WindowBatch { n: N, n_obs_steps: 2, observation, indices, ..WindowBatch::default() }
    }

    fn exchange(seed: u64) -> Exchanges {
        let place = |feature: &str, from, width| Place { feature: feature.to_owned(), from, width };
        let things = (0..4).map(|i| vec![place("a", i, 1), place("b", 1 + 2 * i, 2)]).collect();
        let episode = |at: usize| Episode { end: 3 * (at as u32 + 1), taken: taken(3 * at), beginning: Vec::new() };
        let episodes = (0..N / 3).map(episode).collect();
        Exchanges { seed, all: vec![Exchange { things, moved: Vec::new(), episodes }], pointed: None }
    }

    /// What was taken in the demonstration of a window; each has three.
    fn taken(window: usize) -> usize {
        window / 3 % 4
    }

    #[test]
    fn all_but_the_one_that_was_taken_change_places_with_all_that_is_theirs() {
        let (mut batch, mut seen) = (windows(), BTreeSet::new());
        exchange(1).apply(3, &mut batch);
        let (a, b) = (batch.column("a").unwrap(), batch.column("b").unwrap());
        for row in 0..N {
            let taken = taken(N - 1 - row);
            let (a, b) = (&a[row * 8..][..8], &b[row * 18..][..18]);
            assert_eq!(a[taken], 10.0 * (taken + 1) as f32);
            assert_eq!((b[0], b[9]), (7.0, 7.0), "what is not named stays");
            for (i, first) in a[..4].iter().enumerate() {
                assert_eq!(a[4 + i], first + 1.0, "the observation before is put into the same order");
                assert_eq!(b[1 + 2 * i..][..2], [*first, first + 5.0]);
                assert_eq!(b[10 + 2 * i..][..2], [first + 1.0, first + 5.0]);
            }
            let order: Vec<u32> = a[..4].iter().map(|x| *x as u32).collect();
            assert_eq!(order.iter().copied().collect::<BTreeSet<u32>>(), BTreeSet::from([10, 20, 30, 40]));
            seen.insert((taken, order));
        }
        assert_eq!(seen.len(), 4 * 6, "every order of the other three");
    }

    #[test]
    fn the_others_lie_where_something_was_taken_in_another_demonstration() {
        let mut exchanges = exchange(1);
        // the things' numbers of `a` are where they are, and the first ones of `b` stand by them
        let place = |feature: &str, from| Place { feature: feature.to_owned(), from, width: 1 };
        exchanges.all[0].things = vec![Vec::new(); 4];
        exchanges.all[0].moved = (0..4).map(|i| vec![place("a", i), place("b", 1 + 2 * i)]).collect();
        // at whole tens, each demonstration's a little further
        let offset = |at: usize| at as f32 / 128.0;
        for (at, episode) in exchanges.all[0].episodes.iter_mut().enumerate() {
            episode.beginning = (1..5).map(|thing| vec![10.0 * thing as f32 + offset(at)]).collect();
        }
        let mut batch = windows();
        exchanges.apply(3, &mut batch);
        let (a, b) = (batch.column("a").unwrap(), batch.column("b").unwrap());
        let mut seen = BTreeSet::new();
        for row in 0..N {
            let (window, taken) = (N - 1 - row, taken(N - 1 - row));
            let own = window / 3;
            let (a, b) = (&a[row * 8..][..8], &b[row * 18..][..18]);
            for thing in 0..4 {
                let before = 10.0 * (thing + 1) as f32;
                let by = a[thing] - before;
                assert_eq!((a[thing], a[4 + thing]), (before + by, before + 1.0 + by));
                assert_eq!((b[1 + 2 * thing], b[10 + 2 * thing]), (before + by, before + 1.0 + by));
                assert_eq!((b[2 + 2 * thing], b[11 + 2 * thing]), (before + 5.0, before + 5.0), "not named");
                if thing == taken {
                    assert_eq!(by, 0.0);
                    continue;
                }
                let other = (own as f32 + by * 128.0) as usize;
                assert_eq!(other as f32, own as f32 + by * 128.0);
                assert_eq!(other % 4, thing, "the one that was taken there");
                let nearer = (0..N / 3).filter(|at| at % 4 == thing && at.abs_diff(own) < other.abs_diff(own));
                assert!(nearer.count() < NEAREST);
                seen.insert((own, thing, other));
            }
        }
        assert!(seen.len() > 2 * N, "drawn anew for every sample: {}", seen.len());
    }

    #[test]
    fn a_batch_depends_on_seed_and_step_alone() {
        let after = |seed: u64, step: u64| {
            let mut batch = windows();
            exchange(seed).apply(step, &mut batch);
            batch.observation
        };
        assert_eq!(after(1, 7), after(1, 7));
        assert_ne!(after(1, 7), after(1, 8));
        assert_ne!(after(1, 7), after(2, 7));
        let mut batch = windows();
        Exchanges::default().apply(7, &mut batch);
        assert_eq!(batch, windows());
    }

    /// Twelve things of twelve names that each point to a name, in three chains, and the name that one begins at.
    fn chains(rng: &mut SplitMix64) -> (Vec<usize>, Vec<usize>, usize, usize) {
        let mut shuffled = || {
            let mut order: Vec<usize> = (0..12).collect();
            rng.shuffle(&mut order);
            order
        };
        let (names, order) = (shuffled(), shuffled());
        let mut points = vec![0; 12];
        for chain in [&order[..5], &order[5..9], &order[9..]] {
            for (i, &thing) in chain.iter().enumerate() {
                points[thing] = names[chain[(i + 1).min(chain.len() - 1)]];
            }
        }
        (names.clone(), points, names[order[rng.below(5) as usize]], order[4])
    }

    #[test]
    fn whoever_follows_the_chain_in_what_is_dealt_finds_what_was_taken() {
        let mut rng = SplitMix64::new(5, 0);
        let (mut things, mut goals, mut episodes) = (Vec::new(), Vec::new(), Vec::new());
        for row in 0..N {
            let (names, points, start, end) = chains(&mut rng);
            let one_hot = |name: usize| (0..12).map(move |i| f32::from(u8::from(i == name)));
            things.extend((0..12).flat_map(|i| one_hot(names[i]).chain(one_hot(points[i]))));
            goals.extend(one_hot(start));
            episodes.push(Episode { end: row as u32 + 1, taken: end, beginning: Vec::new() });
        }
        let observation = vec![("goal".to_owned(), goals), ("things".to_owned(), things)];
        let indices = (0..N as u32).collect();
        let mut batch = WindowBatch { n: N, n_obs_steps: 1, observation, indices, ..WindowBatch::default() };
        let before = batch.clone();
        let place = |from| Place { feature: "things".to_owned(), from, width: 12 };
        let items = (0..12).map(|i| vec![place(24 * i), place(24 * i + 12)]).collect();
        let all = vec![Exchange { things: items, moved: Vec::new(), episodes }];
        let exchanges = Exchanges { seed: 1, all, pointed: Some((0, (100..112).collect())) };
        exchanges.apply(3, &mut batch);
        let taken = exchanges.taken(&batch).unwrap();
        let mut moved = 0;
        for (row, &taken) in taken.iter().enumerate() {
            let name = |values: &[f32]| values.iter().position(|x| *x == 1.0).unwrap();
            let thing = |batch: &WindowBatch, i: usize| {
                let numbers = &batch.column("things").unwrap()[row * 288 + 24 * i..][..24];
                (name(&numbers[..12]), name(&numbers[12..]))
            };
            let mut at = name(&batch.column("goal").unwrap()[row * 12..][..12]);
            let end = (0..12).find_map(|_| {
                let here = (0..12).find(|&i| thing(&batch, i).0 == at).unwrap();
                at = thing(&batch, here).1;
                (at == thing(&batch, here).0).then_some(here)
            });
            assert_eq!(taken, 100 + end.unwrap() as u32, "row {row}");
            moved += (0..12).filter(|&i| thing(&batch, i) != thing(&before, i)).count();
        }
        assert!(moved > 9 * N, "most of the other eleven lie elsewhere: {moved}");
        assert_eq!(exchange(1).taken(&batch), None, "where no pointer asks");
    }
}
