//! `[data.entities]`: observation keys grouped into things, a token each.
//!
//! ```toml
//! [data.entities]
//! cube0 = ["cube0_pos", "cube0_pos - robot0_eef_pos"]
//! cube1 = ["cube1_pos", "cube1_pos - robot0_eef_pos"]
//! goal0 = { keys = ["goal_rgb[0:3]"], group = "place", position = true }
//! ```
//!
//! Entities of one group share their projection and their statistics. A group that is not named is the entity's name
//! without the digits at its end: `cube` here.

use std::fmt;

use serde::de::{self, Deserializer, MapAccess, SeqAccess, Visitor};
use serde::ser::{SerializeMap, Serializer};
use serde::{Deserialize, Serialize};

/// One entity of `[data.entities]`: a list of keys, or a table.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct EntitySection {
    /// Observation keys of its vector, in order.
    pub keys: Vec<String>,
    /// Group, which shares projection and statistics; absent: the name without the digits at its end.
    pub group: Option<String>,
    /// Whether it gets a learned position, which distinguishes it from the others of its group.
    pub position: bool,
}

impl EntitySection {
    /// The group of the entity `name`.
    pub fn group_of<'n>(&'n self, name: &'n str) -> &'n str {
        let stem = name.trim_end_matches(|c: char| c.is_ascii_digit()).trim_end_matches('_');
        self.group.as_deref().unwrap_or(if stem.is_empty() { name } else { stem })
    }
}

impl Serialize for EntitySection {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if self.group.is_none() && !self.position {
            return self.keys.serialize(serializer);
        }
        let mut map = serializer.serialize_map(None)?;
        map.serialize_entry("keys", &self.keys)?;
        if let Some(group) = &self.group {
            map.serialize_entry("group", group)?;
        }
        if self.position {
            map.serialize_entry("position", &true)?;
        }
        map.end()
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    keys: Vec<String>,
    group: Option<String>,
    #[serde(default)]
    position: bool,
}

impl<'de> Deserialize<'de> for EntitySection {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Either;
        impl<'de> Visitor<'de> for Either {
            type Value = EntitySection;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a list of observation keys, or a table with keys, group and position")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, items: A) -> Result<EntitySection, A::Error> {
                let keys = Vec::deserialize(de::value::SeqAccessDeserializer::new(items))?;
                Ok(EntitySection { keys, ..EntitySection::default() })
            }

            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<EntitySection, A::Error> {
                let Table { keys, group, position } = Table::deserialize(de::value::MapAccessDeserializer::new(map))?;
                Ok(EntitySection { keys, group, position })
            }
        }
        deserializer.deserialize_any(Either)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn groups_are_named_or_follow_from_names() {
        let group = |name: &str| EntitySection::default().group_of(name).to_owned();
        assert_eq!([group("cube0"), group("cube_12"), group("peg"), group("7")], ["cube", "cube", "peg", "7"]);
        let named = EntitySection { group: Some("thing".to_owned()), ..EntitySection::default() };
        assert_eq!(named.group_of("cube0"), "thing");
    }
}
