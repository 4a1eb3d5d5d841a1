//! Families: trainings of one experiment on the same demonstrations that differ in nothing but their seed.
//!
//! Another seed gives other weights, and often another success rate: what an experiment is worth, several trainings say.

use std::collections::BTreeMap;

use crate::results::EntryIdentity;
use crate::sha256_hex;

use super::{Entry, EntryId};

/// Which entries belong to one family.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Families(BTreeMap<(String, u32), String>);

impl Families {
    /// The families among `entries`.
    ///
    /// A seed counts once: of several trainings with the same one, the newest version is of the family, and each other is
    /// of a family of its own, because it is no further draw of chance.
    pub fn of<'a>(entries: impl IntoIterator<Item = &'a Entry>) -> Self {
        let mut found: Vec<(EntryId, u64, String)> = entries
            .into_iter()
            .filter_map(|entry| Some((entry.id(), entry.meta().training.as_ref()?.seed, key(entry)?)))
            .collect();
        found.sort_by(|(a, ..), (b, ..)| (b.version, &a.name).cmp(&(a.version, &b.name)));
        let mut before: BTreeMap<(String, u64), usize> = BTreeMap::new();
        let mut families = Self::default();
        for (id, seed, key) in found {
            let count = before.entry((key.clone(), seed)).or_default();
            let key = if *count == 0 { key } else { format!("{key}.{count}") };
            *count += 1;
            families.insert(&id.name, id.version, key);
        }
        families
    }

    /// Says that `name@version` is of the family called `key`.
    pub fn insert(&mut self, name: &str, version: u32, key: String) {
        self.0.insert((name.to_owned(), version), key);
    }

    /// The family of an entry; none for one that was not trained here.
    pub fn key(&self, entry: &EntryIdentity) -> Option<&str> {
        self.0.get(&(entry.name.clone(), entry.version)).map(String::as_str)
    }
}

/// A hash over everything that trainings of one family share: the resolved experiment without its seed and its names, and
/// the content of the demonstrations. None for an entry that was not trained here.
pub fn key(entry: &Entry) -> Option<String> {
    let meta = entry.meta();
    meta.training.as_ref()?;
    let data = meta.data.as_ref().map_or("", |data| data.fingerprint.as_str());
    family_key(&entry.config_text().ok()?, data)
}

/// The same of an experiment's text and the fingerprint of its demonstrations.
pub(crate) fn family_key(config: &str, fingerprint: &str) -> Option<String> {
    let mut table: toml::Table = toml::from_str(config).ok()?;
    table.remove("entry");
    table.remove("description");
    table.get_mut("train")?.as_table_mut()?.remove("seed");
    let text = toml::to_string(&table).ok()?;
    Some(sha256_hex(format!("{text}\n{fingerprint}").as_bytes()))
}

/// The name of the entry that training `name` with `seed` makes: `lift-act-s3`.
pub fn member_name(name: &str, seed: u64) -> String {
    format!("{name}-s{seed}")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::testing::draft;
    use super::*;

    fn seal(zoo: &std::path::Path, name: &str, seed: u64, steps: u64, data: &str) -> Entry {
        let mut draft = draft(name);
        draft.meta.training.as_mut().unwrap().seed = seed;
        draft.meta.data.as_mut().unwrap().fingerprint = data.repeat(64);
        draft.config = format!("entry = \"{name}\"\n[train]\nseed = {seed}\nsteps = {steps}\n");
        Entry::open(zoo, &draft.seal(zoo).unwrap()).unwrap()
    }

    #[test]
    fn the_seed_and_the_names_alone_make_no_other_family() {
        let zoo = tempfile::tempdir().unwrap();
        let entries = [
            seal(zoo.path(), "lift-act-s1", 1, 500, "a"),
            seal(zoo.path(), "lift-act-s2", 2, 500, "a"),
            seal(zoo.path(), "lift-act-s3", 3, 501, "a"),
            seal(zoo.path(), "lift-act-s4", 4, 500, "b"),
        ];
        let keys: Vec<String> = entries.iter().map(|entry| key(entry).unwrap()).collect();
        assert_eq!(keys[0], keys[1]);
        assert!(keys[0] != keys[2] && keys[0] != keys[3] && keys[2] != keys[3]);
    }

    #[test]
    fn a_seed_counts_once() {
        let zoo = tempfile::tempdir().unwrap();
        let entries: Vec<Entry> =
            [(1, "a"), (2, "a"), (2, "a")].map(|(seed, data)| seal(zoo.path(), "x", seed, 500, data)).into();
        let families = Families::of(&entries);
        let of = |version| {
            let entry = EntryIdentity { name: "x".into(), version, hash: String::new() };
            families.key(&entry).map(str::to_owned)
        };
        // of the two with seed 2, the newer one
        assert_eq!(of(1), of(3));
        assert_ne!(of(1), of(2));
        assert_eq!(of(4), None);
    }

    #[test]
    fn an_imported_entry_has_no_family() {
        let zoo = tempfile::tempdir().unwrap();
        let mut draft = draft("theirs");
        draft.meta.training = None;
        let entry = Entry::open(zoo.path(), &draft.seal(zoo.path()).unwrap()).unwrap();
        assert_eq!(key(&entry), None);
        assert_eq!(Families::of([&entry]), Families::default());
    }
}
