//! Which observation keys make which feature: the seam between a simulator's or a data set's names and a policy's.

use std::collections::BTreeMap;

use dataset::{KeyItem, Moment};
use models::{Observation, Values};
use rollout::{Observations, Ready};
use serde::{Deserialize, Serialize};

/// By feature, the observation keys whose numbers it is made of, in order.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct FeatureKeys(BTreeMap<String, Vec<KeyItem>>);

impl FeatureKeys {
    /// Adds a feature.
    ///
    /// # Errors
    /// A key that cannot be read, in words.
    pub fn insert(&mut self, feature: &str, keys: &[String]) -> Result<(), String> {
        let items = keys.iter().map(|key| key.parse()).collect::<Result<_, String>>()?;
        self.0.insert(feature.to_owned(), items);
        Ok(())
    }

    /// Leaves only the features that `keep` names.
    pub fn retain(&mut self, keep: impl Fn(&str) -> bool) {
        self.0.retain(|feature, _| keep(feature));
    }

    /// The items of a feature, as they are written; empty if there is no such feature.
    pub fn of(&self, feature: &str) -> Vec<String> {
        self.0.get(feature).into_iter().flatten().map(KeyItem::to_string).collect()
    }

    /// The items of a feature; none if there is no such feature.
    pub fn items(&self, feature: &str) -> &[KeyItem] {
        self.0.get(feature).map_or(&[], Vec::as_slice)
    }

    /// The features, sorted.
    pub fn features(&self) -> impl Iterator<Item = &str> {
        self.0.keys().map(String::as_str)
    }

    /// Every observation key that is read.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.0.values().flatten().flat_map(KeyItem::keys)
    }

    /// How many numbers a feature has in the environment that `ready` describes.
    ///
    /// # Errors
    /// In words: a part of a key that is not there, a difference of unequal lengths.
    pub fn width(&self, feature: &str, ready: &Ready) -> Result<usize, String> {
        let width_of = |key: &str| ready.observations.get(key).map(|shape| shape.iter().product());
        self.0.get(feature).into_iter().flatten().map(|item| item.width(width_of)).sum()
    }

    /// The keys that are read at an earlier step than the present one, and when.
    fn remembered(&self) -> impl Iterator<Item = (&str, Moment)> {
        self.0.values().flatten().flat_map(KeyItem::remembered)
    }

    /// How many steps are done between observations, so that of plans of `steps` every step is seen that is asked about later;
    /// `None` if none is.
    pub fn stride(&self, steps: usize) -> Option<usize> {
        let lags = self.remembered().filter_map(|(_, moment)| match moment {
            Moment::Before(steps) => Some(steps),
            Moment::Now | Moment::First => None,
        });
        lags.reduce(greatest_common_divisor).map(|lag| greatest_common_divisor(lag, steps))
    }

    /// The observation of the step at which `past` is, which remembers of it what is asked about later. A feature of which a key is
    /// missing is left out.
    ///
    /// # Errors
    /// In words: a step that `past` was not shown.
    pub fn observe(&self, observations: &Observations, past: &mut Past) -> Result<Observation, String> {
        let values = |key| Some(observations.get(key)?.iter().map(|&value| value as f32).collect::<Vec<f32>>());
        past.remember(self.remembered().map(|(key, moment)| (key, moment, values(key))));
        for (_, moment) in self.remembered() {
            let step = moment.step(past.step);
            if !past.seen.contains_key(&step) {
                return Err(format!("the observation of step {step} is needed at step {} and was not seen", past.step));
            }
        }
        let now: BTreeMap<&str, Vec<f32>> = self.keys().filter_map(|key| Some((key, values(key)?))).collect();
        let values_of = |key: &str, moment: Moment| match moment {
            Moment::Now => now.get(key).map(Vec::as_slice),
            Moment::First | Moment::Before(_) => past.seen[&moment.step(past.step)].get(key).map(Vec::as_slice),
        };
        let feature = |items: &Vec<KeyItem>| {
            let mut values = Vec::new();
            items.iter().try_for_each(|item| item.append(values_of, &mut values))?;
            Some(Values::F32(values))
        };
        let picture = |items: &Vec<KeyItem>| match items.as_slice() {
            [item] => observations.picture(&item.to_string()).map(|bytes| Values::U8(bytes.to_vec())),
            _ => None,
        };
        let seen = |items| picture(items).or_else(|| feature(items));
        Ok(self.0.iter().filter_map(|(name, items)| Some((name.clone(), seen(items)?))).collect())
    }
}

/// What an episode showed before, as far as it is asked about again.
#[derive(Debug, Clone, Default)]
pub struct Past {
    /// of the episode, the present one
    step: usize,
    /// by step, the numbers of the keys that are remembered
    seen: BTreeMap<usize, BTreeMap<String, Vec<f32>>>,
}

impl Past {
    /// Takes in that `steps` were done since the last observation.
    pub fn pass(&mut self, steps: usize) {
        self.step += steps;
    }

    /// Takes in the present values of keys and when they are asked about; forgets what never is again.
    fn remember<'k>(&mut self, values: impl Iterator<Item = (&'k str, Moment, Option<Vec<f32>>)>) {
        let (step, mut longest) = (self.step, 0);
        for (key, moment, values) in values {
            if let Moment::Before(steps) = moment {
                longest = longest.max(steps);
            }
            let present = self.seen.entry(step).or_default();
            if let Some(values) = values {
                present.insert(key.to_owned(), values);
            }
        }
        self.seen.retain(|&seen, _| seen == 0 || seen + longest >= step);
    }
}

fn greatest_common_divisor(a: usize, b: usize) -> usize {
    if b == 0 { a } else { greatest_common_divisor(b, a % b) }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use models::{ENVIRONMENT_STATE, STATE};

    use super::*;

    #[test]
    fn keys_are_joined_in_their_order() {
        let mut keys = FeatureKeys::default();
        keys.insert(STATE, &["b".into(), "a".into()]).unwrap();
        keys.insert(ENVIRONMENT_STATE, &["c".into()]).unwrap();
        keys.insert("observation.entity.thing", &["b[1:2]".into(), "a - c".into()]).unwrap();
        keys.insert("observation.entity.gone", &["a".into(), "d".into()]).unwrap();
        let observations = [("a", vec![1.0]), ("b", vec![2.0, 3.0]), ("c", vec![4.0])];
        keys.insert("observation.entity.kept", &["a".into(), "first(b)[0:1]".into()]).unwrap();
        let first = [("b", vec![9.0, 8.0])].map(|(key, values)| (key.to_owned(), values)).into();
        let mut past = Past::default();
        keys.observe(&first, &mut past).unwrap();
        past.pass(7);
        let seen = keys.observe(&observations.map(|(key, values)| (key.to_owned(), values)).into(), &mut past).unwrap();
        let numbers = |name: &str| seen.get(name).cloned();
        assert_eq!(numbers(STATE), Some(vec![2.0, 3.0, 1.0].into()));
        assert_eq!(numbers(ENVIRONMENT_STATE), Some(vec![4.0].into()));
        assert_eq!(numbers("observation.entity.thing"), Some(vec![3.0, -3.0].into()));
        assert_eq!(numbers("observation.entity.kept"), Some(vec![1.0, 9.0].into()));
        assert_eq!(numbers("observation.entity.gone"), None);
    }

    #[test]
    fn steps_before_are_those_of_the_episode() {
        let mut keys = FeatureKeys::default();
        keys.insert(STATE, &["a".into(), "before(a:4)".into(), "a - before(a:6)".into(), "first(a)".into()]).unwrap();
        assert_eq!([8, 4, 3].map(|steps| keys.stride(steps)), [2, 2, 1].map(Some));
        let at = |value: f64| [("a".to_owned(), vec![value])].into();
        let mut past = Past::default();
        // every second step is seen
        for step in 0..20_usize {
            let value = |step: usize| 10.0 + step as f64;
            if step > 0 {
                past.pass(2);
            }
            let seen = keys.observe(&at(value(2 * step)), &mut past).unwrap();
            let before = |steps: usize| value((2 * step).saturating_sub(steps));
            let now = value(2 * step);
            let expected: Vec<f32> = [now, before(4), now - before(6), value(0)].map(|value| value as f32).into();
            assert_eq!(seen.get(STATE).cloned(), Some(expected.into()), "step {step}");
        }
        // what nobody asks about is not kept: the first step, the present one and six steps before it
        assert_eq!(past.seen.len(), 5);
        past.pass(3);
        let error = keys.observe(&at(0.0), &mut past).unwrap_err();
        assert_eq!(error, "the observation of step 37 is needed at step 41 and was not seen");
        keys.insert(STATE, &["a".into()]).unwrap();
        assert_eq!(keys.stride(8), None);
    }

    #[test]
    fn they_are_written_as_they_are_read() {
        let mut keys = FeatureKeys::default();
        keys.insert(STATE, &["b[0:2]".into(), "a - c".into()]).unwrap();
        let text = serde_json::to_string(&keys).unwrap();
        assert_eq!(text, r#"{"observation.state":["b[0:2]","a - c"]}"#);
        assert_eq!(serde_json::from_str::<FeatureKeys>(&text).unwrap(), keys);
        assert_eq!(keys.insert(STATE, &["b[".into()]).unwrap_err(), "`b[`: expected key[from:to] with from below to");
    }
}
