//! `[data.exchange]`: swap augmentation. Objects swap places and properties in training, all but the one that was taken.
//!
//! ```toml
//! [data.exchange.cubes]
//! taken = ["gripper_to_cube0", "gripper_to_cube1", "gripper_to_cube2"]
//! items = [["cube0_color"], ["cube1_color"], ["cube2_color"]]
//! places = [["cube0_pos", "gripper_to_cube0"], ["cube1_pos", "gripper_to_cube1"], ["cube2_pos", "gripper_to_cube2"]]
//! ```
//!
//! The end of each demonstration shows which object was meant: the one whose vector in `taken`, from the hand, is the shortest in
//! the last observation. Objects whose vector is zero are absent and stay as they are. Whatever the other objects are, the same
//! demonstration is right. So their `items` (as many lists as objects, of equal lengths) are shuffled among them in every sample.
//! With `places`, each of the others also moves to where another demonstration's taken object was, drawn from the [`NEAREST`] that are
//! nearest to it. It moves by the vector between the two at the beginnings of the demonstrations, which the first item of each list
//! gives; all items of the list move alike. Then every object is where something was taken once, and no position by itself shows
//! what was taken this time. A policy with a pointer (`[policy.pointer]`) learns from the same table which object was taken; with
//! `asked = 1` only at the first observation of a demonstration, before the motion of the hand shows it. Without this
//! augmentation a policy can memorise a few hundred demonstrations, each with an arrangement of its own, instead of learning the
//! rule that leads to the object. Objects may come to overlap a little.

use dataset::WindowBatch;
use dataset::shuffle::SplitMix64;
use models::{Batch, ENTITY_PREFIX, ModelError, Taken};
use serde::{Deserialize, Serialize};

use super::slices::{Slice, Slices};
use super::{DataSection, Fitted, Source, Transform};
use crate::ZooError;
use crate::experiment::Experiment;

/// Keeps the draws apart from those of the batches' order, which have the same seed.
const PURPOSE: u64 = 0x4558_4348_414e_4745;

/// Number of places to draw from for each object that is moved: few enough to stay in its neighbourhood.
const NEAREST: usize = 16;

/// `[data.exchange.NAME]`: objects that are swapped with each other in training, all but the one that was taken.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SwapSection {
    /// Position of each object relative to the gripper. The nearest one at the end of a demonstration is the one that was taken.
    pub taken: Vec<String>,
    /// Observation items of each object, in the same order for all.
    pub items: Vec<Vec<String>>,
    /// Position items of each object. All are moved by one vector, to where an object was taken in another demonstration.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub places: Vec<Vec<String>>,
    /// Number of first observations of a demonstration at which the pointer has a loss; absent: all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub asked: Option<usize>,
}

/// The section that says which of the objects was taken that the policy's pointer is about: the one whose items are in them.
fn pointed(experiment: &Experiment) -> Option<&str> {
    let group = &experiment.policy.pointer()?.among;
    let held = |item: &String| {
        let mut entities = experiment.data.entities.iter();
        entities.any(|(name, e)| e.keys.contains(item) && e.group_of(name) == *group && !e.position)
    };
    let about = experiment.data.exchange.iter().find(|(_, exchange)| exchange.taken.iter().all(held));
    about.map(|(name, _)| name.as_str())
}

pub(super) struct SwapAugmentation;

impl Transform for SwapAugmentation {
    fn name(&self) -> &'static str {
        "exchange"
    }

    fn items<'d>(&self, data: &'d DataSection) -> Vec<(String, &'d Vec<String>)> {
        let lists = |(name, section): (&String, &'d SwapSection)| {
            let items = section.items.iter().map(|items| ("items", items));
            let places = section.places.iter().map(|items| ("places", items));
            let all = items.chain(places).chain([("taken", &section.taken)]);
            all.map(|(key, items)| (format!("data.exchange.{name}.{key}"), items)).collect::<Vec<_>>()
        };
        data.exchange.iter().flat_map(lists).collect()
    }

    fn check(&self, experiment: &Experiment, _: &[String]) -> Result<(), ZooError> {
        let data = &experiment.data;
        let invalid = |key: String, expected: &str, found: String| {
            Err(ZooError::InvalidValue { key, expected: expected.to_owned(), found })
        };
        for (name, exchange) in &data.exchange {
            let things = exchange.taken.len();
            if exchange.asked == Some(0) {
                return invalid(format!("data.exchange.{name}.asked"), "1 or more", "0".to_owned());
            }
            for (key, lists) in [("items", &exchange.items), ("places", &exchange.places)] {
                let here = format!("data.exchange.{name}.{key}");
                if lists.len() != things && !(key == "places" && lists.is_empty()) {
                    return invalid(here, &format!("{things} lists, one for each of `taken`"), lists.len().to_string());
                }
                if let Some(other) = lists.iter().find(|items| items.len() != lists[0].len()) {
                    return invalid(here, &format!("lists of {} items", lists[0].len()), other.join(", "));
                }
            }
        }
        if !data.exchange.is_empty() && !data.cameras.is_empty() {
            let names: Vec<&str> = data.exchange.keys().map(String::as_str).collect();
            let expected = "none with data.cameras, whose images show what was exchanged where it was";
            return invalid("data.exchange".to_owned(), expected, names.join(", "));
        }
        match experiment.policy.pointer() {
            Some(pointer) if pointed(experiment).is_none() => Err(ZooError::InvalidValue {
                key: "policy.pointer.among".to_owned(),
                expected: "a group of entities of which a data.exchange says which was `taken`".to_owned(),
                found: format!("`{}`", pointer.among),
            }),
            _ => Ok(()),
        }
    }

    fn fit(&self, source: &Source<'_>) -> Result<Option<Box<dyn Fitted>>, ZooError> {
        let experiment = source.experiment;
        if experiment.data.exchange.is_empty() {
            return Ok(None);
        }
        let slices = source.slices(self.name())?;
        let (mut all, mut pointer) = (Vec::new(), None);
        for (name, section) in &experiment.data.exchange {
            let from_hand = slices.of_each(&format!("data.exchange.{name}.taken"), &section.taken)?;
            // whichever feature has it: the pointer's entities before others
            let of_pointer =
                |slice: &&Slice| pointed(experiment) == Some(name.as_str()) && slice.feature.starts_with(ENTITY_PREFIX);
            let from_hand: Vec<Slice> =
                from_hand.iter().map(|found| found.iter().find(of_pointer).unwrap_or(&found[0]).clone()).collect();
            let objects = of_objects(&slices, &format!("data.exchange.{name}.items"), &section.items)?;
            let moved = of_objects(&slices, &format!("data.exchange.{name}.places"), &section.places)?;
            if pointed(experiment) == Some(name.as_str()) {
                let index = |slice: &Slice| {
                    source.signature.observation.iter().position(|spec| spec.name == slice.feature).map(|at| at as u32)
                };
                let features = from_hand.iter().filter_map(index).collect();
                let first = section.asked.map_or(u32::MAX, |first| u32::try_from(first).unwrap_or(u32::MAX));
                pointer = Some(Pointer { swap: all.len(), features, first });
            }
            let episodes = episodes(&from_hand, &moved, source)?;
            all.push(Swap { objects, moved, episodes });
        }
        Ok(Some(Box::new(Swaps { seed: experiment.train.seed ^ PURPOSE, all, pointer })))
    }
}

/// The swaps of a run.
struct Swaps {
    seed: u64,
    all: Vec<Swap>,
    pointer: Option<Pointer>,
}

/// The targets of a pointer.
struct Pointer {
    /// which swap says what was taken
    swap: usize,
    /// of each object its feature's index in the signature
    features: Vec<u32>,
    /// number of first observations of an episode that have a target
    first: u32,
}

/// Objects that are swapped with each other.
#[derive(Debug, PartialEq)]
struct Swap {
    /// What belongs to each object, and goes from one to another.
    objects: Vec<Vec<Slice>>,
    /// Where each object is, which is moved; may be empty.
    moved: Vec<Vec<Slice>>,
    episodes: Vec<Episode>,
}

/// What is known of a demonstration as a whole.
#[derive(Debug, PartialEq)]
struct Episode {
    /// The first window that is not this one's or an earlier one's.
    end: u32,
    /// The object that the hand took.
    taken: usize,
    /// The other objects that are present.
    others: Vec<usize>,
    /// Where each object was at the beginning, if that is to be changed.
    beginning: Vec<Vec<f32>>,
}

impl Fitted for Swaps {
    /// Shuffles and moves the objects of each window, in the same way in all its observations.
    fn apply(&self, step: u64, windows: &mut WindowBatch) {
        let mut rng = SplitMix64::new(self.seed, step);
        for swap in &self.all {
            for row in 0..windows.n {
                let episode = &swap.episodes[swap.number(windows.indices[row])];
                swap.shuffle(&episode.others, row, windows, &mut rng);
                if !swap.moved.is_empty() {
                    swap.relocate(episode, row, windows, &mut rng);
                }
            }
        }
    }

    fn targets(&self, windows: &WindowBatch, batch: &mut Batch) -> Result<(), ModelError> {
        batch.taken = self.taken(windows);
        Ok(())
    }
}

impl Swaps {
    /// What was taken, for the pointer.
    fn taken(&self, windows: &WindowBatch) -> Option<Taken> {
        let pointer = self.pointer.as_ref()?;
        let swap = &self.all[pointer.swap];
        let of = |&window: &u32| {
            let at = swap.number(window);
            let begins = at.checked_sub(1).map_or(0, |before| swap.episodes[before].end);
            (window - begins < pointer.first).then(|| pointer.features[swap.episodes[at].taken])
        };
        Some(Taken::new(windows.indices.iter().map(of).collect()))
    }
}

impl Swap {
    /// Of the episode of a window.
    fn number(&self, window: u32) -> usize {
        self.episodes.partition_point(|episode| episode.end <= window)
    }

    fn shuffle(&self, others: &[usize], row: usize, windows: &mut WindowBatch, rng: &mut SplitMix64) {
        let (mut shuffled, mut before) = (others.to_vec(), Vec::new());
        rng.shuffle(&mut shuffled);
        for at in 0..self.objects[0].len() {
            for observation in 0..windows.n_obs_steps {
                before.clear();
                for &object in &shuffled {
                    before.extend_from_slice(self.objects[object][at].of(windows, row, observation));
                }
                for (&object, values) in others.iter().zip(before.chunks_exact(self.objects[0][at].width)) {
                    self.objects[object][at].of_mut(windows, row, observation).copy_from_slice(values);
                }
            }
        }
    }

    fn relocate(&self, own: &Episode, row: usize, windows: &mut WindowBatch, rng: &mut SplitMix64) {
        let mut near: Vec<(f32, usize)> = Vec::with_capacity(self.episodes.len());
        for &object in &own.others {
            let here = &own.beginning[object];
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
            for slice in &self.moved[object] {
                for observation in 0..windows.n_obs_steps {
                    let vector = slice.of_mut(windows, row, observation);
                    vector.iter_mut().zip(here.iter().zip(there)).for_each(|(x, (a, b))| *x += b - a);
                }
            }
        }
    }
}

/// The slices of each object's items; the first items of all objects have one length, and so have the second ones, ...
fn of_objects(slices: &Slices, key: &str, items: &[Vec<String>]) -> Result<Vec<Vec<Slice>>, ZooError> {
    let mut objects = vec![Vec::new(); items.len()];
    for at in 0..items.first().map_or(0, Vec::len) {
        let alike: Vec<String> = items.iter().map(|object| object[at].clone()).collect();
        let found = slices.of_each(key, &alike)?;
        if let Some(other) = (0..found.len()).find(|object| found[*object].len() != found[0].len()) {
            let (first, other) = ((&alike[0], found[0].len()), (&alike[other], found[other].len()));
            return Err(
                slices.unfit(key, format!("{} is in {} features, {} in {}", first.0, first.1, other.0, other.1))
            );
        }
        for (object, found) in objects.iter_mut().zip(found) {
            object.extend(found);
        }
    }
    Ok(objects)
}

/// What the windows say of each episode: what lies nearest to the hand in its last observation, by `from_hand`, and where
/// what is `moved` lay in its first.
fn episodes(from_hand: &[Slice], moved: &[Vec<Slice>], source: &Source<'_>) -> Result<Vec<Episode>, ZooError> {
    let mut ends = WindowBatch::default();
    let episode = |range: std::ops::Range<u32>| {
        source.gather(&[range.start, range.end - 1], &mut ends)?;
        let last = ends.n_obs_steps - 1;
        let squared = |slice: &Slice| slice.of(&ends, 1, last).iter().map(|x| x * x).sum::<f32>();
        // an object that is absent is seen as zeros
        let there = || (0..from_hand.len()).filter(|object| squared(&from_hand[*object]) > 0.0);
        let nearest = there().min_by(|a, b| squared(&from_hand[*a]).total_cmp(&squared(&from_hand[*b])));
        let beginning = moved.iter().map(|object| object[0].of(&ends, 0, last).to_vec()).collect();
        let taken = nearest.unwrap_or(0);
        Ok(Episode { end: range.end, taken, others: there().filter(|object| *object != taken).collect(), beginning })
    };
    source.demonstrations("exchange")?.into_iter().map(episode).collect()
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

    fn swaps(seed: u64) -> Swaps {
        let slice = |feature: &str, from, width| Slice { feature: feature.to_owned(), from, width };
        let objects = (0..4).map(|i| vec![slice("a", i, 1), slice("b", 1 + 2 * i, 2)]).collect();
        let episode = |at: usize| {
            let taken = taken_in(3 * at);
            let others = (0..4).filter(|thing| *thing != taken).collect();
            Episode { end: 3 * (at as u32 + 1), taken, others, beginning: Vec::new() }
        };
        let episodes = (0..N / 3).map(episode).collect();
        Swaps { seed, all: vec![Swap { objects, moved: Vec::new(), episodes }], pointer: None }
    }

    /// What was taken in the demonstration of a window; each has three.
    fn taken_in(window: usize) -> usize {
        window / 3 % 4
    }

    #[test]
    fn all_but_the_one_that_was_taken_change_places_with_all_that_is_theirs() {
        let (mut batch, mut seen) = (windows(), BTreeSet::new());
        swaps(1).apply(3, &mut batch);
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
        let mut swaps = swaps(1);
        // the things' numbers of `a` are where they are, and the first ones of `b` stand by them
        let slice = |feature: &str, from| Slice { feature: feature.to_owned(), from, width: 1 };
        swaps.all[0].objects = vec![Vec::new(); 4];
        swaps.all[0].moved = (0..4).map(|i| vec![slice("a", i), slice("b", 1 + 2 * i)]).collect();
        // at whole tens, each demonstration's a little further
        let offset = |at: usize| at as f32 / 128.0;
        for (at, episode) in swaps.all[0].episodes.iter_mut().enumerate() {
            episode.beginning = (1..5).map(|thing| vec![10.0 * thing as f32 + offset(at)]).collect();
        }
        let mut batch = windows();
        swaps.apply(3, &mut batch);
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
            swaps(seed).apply(step, &mut batch);
            batch.observation
        };
        assert_eq!(after(1, 7), after(1, 7));
        assert_ne!(after(1, 7), after(1, 8));
        assert_ne!(after(1, 7), after(2, 7));
    }

    #[test]
    fn what_is_not_there_stays_as_it_is() {
        let mut swaps = swaps(1);
        for episode in &mut swaps.all[0].episodes {
            episode.others.retain(|thing| *thing != 0);
        }
        let (mut batch, mut moved) = (windows(), 0);
        swaps.apply(3, &mut batch);
        for row in 0..N {
            let (a, b) = (&batch.column("a").unwrap()[row * 8..][..8], &batch.column("b").unwrap()[row * 18..][..18]);
            assert_eq!((a[0], a[4], b[1], b[2]), (10.0, 11.0, 10.0, 15.0));
            moved += usize::from(a[1] != 20.0);
        }
        assert!(moved > N / 4, "the others change places: {moved}");
    }

    #[test]
    fn a_pointer_is_asked_as_often_as_told() {
        let (mut swaps, batch) = (swaps(1), windows());
        for first in [1, 2, 3, u32::MAX] {
            swaps.pointer = Some(Pointer { swap: 0, features: vec![5, 6, 7, 8], first });
            let taken = swaps.taken(&batch).unwrap();
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
        let slice = |from| Slice { feature: "things".to_owned(), from, width: 12 };
        let items = (0..12).map(|i| vec![slice(24 * i), slice(24 * i + 12)]).collect();
        let all = vec![Swap { objects: items, moved: Vec::new(), episodes }];
        let pointer = Pointer { swap: 0, features: (100..112).collect(), first: 1 };
        let swaps = Swaps { seed: 1, all, pointer: Some(pointer) };
        swaps.apply(3, &mut batch);
        let taken = swaps.taken(&batch).unwrap();
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
        assert_eq!(super::tests::swaps(1).taken(&batch), None, "without a pointer");
    }
}
