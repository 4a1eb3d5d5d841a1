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

    /// Whether it is remembered how an episode began.
    pub fn remember(&self) -> bool {
        self.0.values().flatten().any(KeyItem::remembers)
    }

    /// The observation of a step, of an episode that began with `first`. A feature of which a key is missing is left out.
    pub fn observe(&self, observations: &Observations, first: &Observations) -> Observation {
        let read = |observations: &Observations| -> BTreeMap<&str, Vec<f32>> {
            let of = |key| Some((key, observations.get(key)?.iter().map(|&value| value as f32).collect()));
            self.keys().filter_map(of).collect()
        };
        let (now, begun) = (read(observations), if self.remember() { read(first) } else { BTreeMap::new() });
        let values_of = |key: &str, moment: Moment| {
            let read = if moment == Moment::First { &begun } else { &now };
            read.get(key).map(Vec::as_slice)
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
        self.0.iter().filter_map(|(name, items)| Some((name.clone(), seen(items)?))).collect()
    }
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
        let seen = keys.observe(&observations.map(|(key, values)| (key.to_owned(), values)).into(), &first);
        let numbers = |name: &str| seen.get(name).cloned();
        assert_eq!(numbers(STATE), Some(vec![2.0, 3.0, 1.0].into()));
        assert_eq!(numbers(ENVIRONMENT_STATE), Some(vec![4.0].into()));
        assert_eq!(numbers("observation.entity.thing"), Some(vec![3.0, -3.0].into()));
        assert_eq!(numbers("observation.entity.kept"), Some(vec![1.0, 9.0].into()));
        assert_eq!(numbers("observation.entity.gone"), None);
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
