//! A map of names that is made once: a third of the memory of a `BTreeMap`, and maps with the same names share them.

use std::collections::BTreeMap;
use std::marker::PhantomData;
use std::ops::Index;
use std::sync::Arc;

use serde::de::{Deserialize, Deserializer, MapAccess, Visitor};
use serde::ser::{Serialize, Serializer};

/// Values by name, in the order of the names.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SortedMap<V>(Box<[(Arc<str>, V)]>);

impl<V> Default for SortedMap<V> {
    fn default() -> Self {
        Self(Box::default())
    }
}

impl<V> SortedMap<V> {
    /// The value of a name.
    pub fn get(&self, name: &str) -> Option<&V> {
        self.0.binary_search_by(|(known, _)| (**known).cmp(name)).ok().map(|at| &self.0[at].1)
    }

    /// Whether it has a name.
    pub fn contains_key(&self, name: &str) -> bool {
        self.get(name).is_some()
    }

    /// How many names there are.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there is no name.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// All names with their values.
    pub fn iter(&self) -> Iter<'_, V> {
        self.starting_at("")
    }

    /// All names.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.iter().map(|(name, _)| name)
    }

    /// All values.
    pub fn values(&self) -> impl Iterator<Item = &V> {
        self.iter().map(|(_, value)| value)
    }

    /// The names from this one on, with their values.
    pub(crate) fn starting_at(&self, name: &str) -> Iter<'_, V> {
        let at = self.0.partition_point(|(known, _)| **known < *name);
        let pair = (|(name, value)| (&**name, value)) as fn(&(Arc<str>, V)) -> (&str, &V);
        self.0[at..].iter().map(pair)
    }

    /// Adds values; those of names that are there take their place.
    pub(crate) fn extend(&mut self, more: impl IntoIterator<Item = (String, V)>) {
        let mut all: BTreeMap<Arc<str>, V> = std::mem::take(&mut self.0).into_iter().collect();
        all.extend(more.into_iter().map(|(name, value)| (Arc::from(name), value)));
        self.0 = all.into_iter().collect();
    }

    /// Names that another map has at the same place become the same memory.
    pub(crate) fn share_names(&mut self, other: &Self) {
        for ((mine, _), (theirs, _)) in self.0.iter_mut().zip(&other.0) {
            if mine == theirs {
                *mine = Arc::clone(theirs);
            }
        }
    }
}

/// Names with their values.
pub type Iter<'a, V> = std::iter::Map<std::slice::Iter<'a, (Arc<str>, V)>, fn(&'a (Arc<str>, V)) -> (&'a str, &'a V)>;

impl<'a, V> IntoIterator for &'a SortedMap<V> {
    type Item = (&'a str, &'a V);
    type IntoIter = Iter<'a, V>;

    fn into_iter(self) -> Iter<'a, V> {
        self.iter()
    }
}

impl<V> From<BTreeMap<String, V>> for SortedMap<V> {
    fn from(map: BTreeMap<String, V>) -> Self {
        Self(map.into_iter().map(|(name, value)| (Arc::from(name), value)).collect())
    }
}

impl<V> Index<&str> for SortedMap<V> {
    type Output = V;

    fn index(&self, name: &str) -> &V {
        self.get(name).expect("the name is there")
    }
}

impl<V: Serialize> Serialize for SortedMap<V> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self)
    }
}

impl<'de, V: Deserialize<'de>> Deserialize<'de> for SortedMap<V> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Names<V>(PhantomData<V>);

        impl<'de, V: Deserialize<'de>> Visitor<'de> for Names<V> {
            type Value = SortedMap<V>;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("a map")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<SortedMap<V>, A::Error> {
                let mut all: BTreeMap<String, V> = BTreeMap::new();
                while let Some((name, value)) = map.next_entry()? {
                    all.insert(name, value);
                }
                Ok(all.into())
            }
        }

        deserializer.deserialize_map(Names(PhantomData))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn it_has_what_a_btree_map_has() {
        let map: BTreeMap<String, usize> =
            ["obs/b", "obs/a", "actions", "obs"].map(str::to_owned).into_iter().zip(0..).collect();
        let mut sorted = SortedMap::from(map.clone());
        let pairs =
            |sorted: &SortedMap<usize>| sorted.iter().map(|(n, &v)| (n.to_owned(), v)).collect::<BTreeMap<_, _>>();
        assert_eq!(pairs(&sorted), map);
        assert!(sorted.keys().eq(map.keys().map(String::as_str)) && sorted.values().eq(map.values()));
        assert_eq!((sorted.get("obs/a"), sorted.get("obs/"), sorted["obs"], sorted.len()), (Some(&1), None, 3, 4));
        assert_eq!(sorted.starting_at("obs/").map(|(name, _)| name).collect::<Vec<_>>(), ["obs/a", "obs/b"]);
        let back: SortedMap<usize> = serde_json::from_str(&serde_json::to_string(&sorted).unwrap()).unwrap();
        assert_eq!(back, sorted);
        sorted.extend([("dones".to_owned(), 7), ("obs".to_owned(), 8)]);
        assert_eq!(sorted.keys().collect::<Vec<_>>(), ["actions", "dones", "obs", "obs/a", "obs/b"]);
        assert_eq!(sorted["obs"], 8);
    }

    #[test]
    fn names_are_shared() {
        let names =
            |names: &[&str]| SortedMap::from(names.iter().map(|n| ((*n).to_owned(), 0)).collect::<BTreeMap<_, _>>());
        let (first, mut second) = (names(&["a", "b", "c"]), names(&["a", "c"]));
        second.share_names(&first);
        assert!(Arc::ptr_eq(&first.0[0].0, &second.0[0].0));
        assert_eq!(second, names(&["a", "c"]));
    }
}
