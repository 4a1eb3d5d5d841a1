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
//! shortest in the last observation, of those that are not zero, which are not there and stay as they are. Whatever the others are, the same demonstration is right. So what is known of them
//! (`items`, as many lists as things, alike) is dealt out among them at random in every sample. And where `places` are
//! named, each of them is moved to where another demonstration's taken thing lay, drawn for the sample from the
//! [`NEAREST`] that are nearest to it: by the vector between the two at the beginnings, as the first item of each list
//! tells them, all items of the list alike. Then everything lies where something was taken once, and no place by itself
//! tells the one that was taken this time. A policy that points (`[policy.pointer]`) learns from the same table which thing
//! was taken; with `asked = 1` it is asked at the first observation of a demonstration alone, before the way of the hand
//! tells. Without this, a few hundred demonstrations, each with an arrangement of its own,
//! can be learned by heart instead of the rule that leads to the thing. Things may come to overlap a little. Validation
//! sees the observations as they are. A batch depends on the seed and the step alone, so that a resumed run needs no state
//! of this.

use std::path::Path;

use dataset::shuffle::SplitMix64;
use dataset::{Dataset, WindowBatch, Windows};
use models::{Signature, Taken};

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
    pointed: Option<Asked>,
}

/// What a pointer is asked.
struct Asked {
    /// which exchange says what was taken
    exchange: usize,
    /// of each thing its feature's place in the signature
    features: Vec<u32>,
    /// at so many observations of an episode, the first ones
    first: u32,
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
    /// The others that are there.
    others: Vec<usize>,
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
                    let first = section.asked.map_or(u32::MAX, |first| u32::try_from(first).unwrap_or(u32::MAX));
                    pointed = Some(Asked { exchange: all.len(), features, first });
                }
                let episodes = episodes(&from_hand, &moved, windows);
                let episodes = episodes.map_err(super::data::unreadable(&path.display().to_string()))?;
                all.push(Exchange { things, moved, episodes });
            }
        }
        Ok(Self { seed: experiment.train.seed ^ PURPOSE, all, pointed })
    }

    /// What the demonstrations of the windows took; `None` where no pointer asks.
    pub fn taken(&self, windows: &WindowBatch) -> Option<Taken> {
        let asked = self.pointed.as_ref()?;
        let exchange = &self.all[asked.exchange];
        let of = |&window: &u32| {
            let at = exchange.number(window);
            let begins = at.checked_sub(1).map_or(0, |before| exchange.episodes[before].end);
            (window - begins < asked.first).then(|| asked.features[exchange.episodes[at].taken])
        };
        Some(Taken::new(windows.indices.iter().map(of).collect()))
    }

    /// Deals out and moves the things of the windows of step `step`, each window by itself, alike in all its observations.
    pub fn apply(&self, step: u64, windows: &mut WindowBatch) {
        let mut rng = SplitMix64::new(self.seed, step);
        for exchange in &self.all {
            for row in 0..windows.n {
                let episode = exchange.episode(windows.indices[row]);
                exchange.deal(&episode.others, row, windows, &mut rng);
                if !exchange.moved.is_empty() {
                    exchange.lay(episode, row, windows, &mut rng);
                }
            }
        }
    }
}

impl Exchange {
    /// Of a window, by its number.
    fn episode(&self, window: u32) -> &Episode {
        &self.episodes[self.number(window)]
    }

    fn number(&self, window: u32) -> usize {
        self.episodes.partition_point(|episode| episode.end <= window)
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

    fn lay(&self, own: &Episode, row: usize, windows: &mut WindowBatch, rng: &mut SplitMix64) {
        let mut near: Vec<(f32, usize)> = Vec::with_capacity(self.episodes.len());
        for &thing in &own.others {
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
        let there = || (0..from_hand.len()).filter(|thing| squared(&from_hand[*thing]) > 0.0);
        let nearest = there().min_by(|a, b| squared(&from_hand[*a]).total_cmp(&squared(&from_hand[*b])));
        let beginning = moved.iter().map(|thing| thing[0].of(&ends, 0, last).to_vec()).collect();
        let taken = nearest.unwrap_or(0);
        Ok(Episode { end: range.end, taken, others: there().filter(|thing| *thing != taken).collect(), beginning })
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
        let episode = |at: usize| {
            let taken = taken_in(3 * at);
            let others = (0..4).filter(|thing| *thing != taken).collect();
            Episode { end: 3 * (at as u32 + 1), taken, others, beginning: Vec::new() }
        };
        let episodes = (0..N / 3).map(episode).collect();
        Exchanges { seed, all: vec![Exchange { things, moved: Vec::new(), episodes }], pointed: None }
    }

    /// What was taken in the demonstration of a window; each has three.
    fn taken_in(window: usize) -> usize {
        window / 3 % 4
    }

    #[test]
    fn all_but_the_one_that_was_taken_change_places_with_all_that_is_theirs() {
        let (mut batch, mut seen) = (windows(), BTreeSet::new());
        exchange(1).apply(3, &mut batch);
        let (a, b) = (batch.column("a").unwrap(), batch.column("b").unwrap());
        for row in 0..N {
            let taken = taken_in(N - 1 - row);
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
            let (window, taken) = (N - 1 - row, taken_in(N - 1 - row));
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

    #[test]
    fn what_is_not_there_stays_as_it_is() {
        let mut exchanges = exchange(1);
        for episode in &mut exchanges.all[0].episodes {
            episode.others.retain(|thing| *thing != 0);
        }
        let (mut batch, mut moved) = (windows(), 0);
        exchanges.apply(3, &mut batch);
        for row in 0..N {
            let (a, b) = (&batch.column("a").unwrap()[row * 8..][..8], &batch.column("b").unwrap()[row * 18..][..18]);
            assert_eq!((a[0], a[4], b[1], b[2]), (10.0, 11.0, 10.0, 15.0));
            moved += usize::from(a[1] != 20.0);
        }
        assert!(moved > N / 4, "the others change places: {moved}");
    }

    #[test]
    fn a_pointer_is_asked_as_often_as_told() {
        let (mut exchanges, batch) = (exchange(1), windows());
        for first in [1, 2, 3, u32::MAX] {
            exchanges.pointed = Some(Asked { exchange: 0, features: vec![5, 6, 7, 8], first });
            let taken = exchanges.taken(&batch).unwrap();
            let of = |window: usize| ((window % 3) < first as usize).then_some(5 + taken_in(window) as u32);
            assert_eq!(taken.features, (0..N).rev().map(of).collect::<Vec<_>>());
            assert_eq!(taken.total, N / 3 * first.min(3) as usize);
        }
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
            let others = (0..12).filter(|thing| *thing != end).collect();
            episodes.push(Episode { end: row as u32 + 1, taken: end, others, beginning: Vec::new() });
        }
        let observation = vec![("goal".to_owned(), goals), ("things".to_owned(), things)];
        let indices = (0..N as u32).collect();
        let mut batch = WindowBatch { n: N, n_obs_steps: 1, observation, indices, ..WindowBatch::default() };
        let before = batch.clone();
        let place = |from| Place { feature: "things".to_owned(), from, width: 12 };
        let items = (0..12).map(|i| vec![place(24 * i), place(24 * i + 12)]).collect();
        let all = vec![Exchange { things: items, moved: Vec::new(), episodes }];
        let asked = Asked { exchange: 0, features: (100..112).collect(), first: 1 };
        let exchanges = Exchanges { seed: 1, all, pointed: Some(asked) };
        exchanges.apply(3, &mut batch);
        let taken = exchanges.taken(&batch).unwrap();
        let mut moved = 0;
        for (row, taken) in taken.features.iter().enumerate() {
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
            assert_eq!(*taken, Some(100 + end.unwrap() as u32), "row {row}");
            moved += (0..12).filter(|&i| thing(&batch, i) != thing(&before, i)).count();
        }
        assert!(moved > 9 * N, "most of the other eleven lie elsewhere: {moved}");
        assert_eq!(exchange(1).taken(&batch), None, "where no pointer asks");
    }
}
