//! Whether sets can become one: the same features, rate, robot and origin of the columns.

use super::super::info::{Feature, Features};
use super::Input;
use crate::error::{DatasetError, Result};
use crate::source::list;
use serde_json::Value;
use std::collections::BTreeMap;

/// The features that all inputs have, as the first one lists them.
///
/// # Errors
/// The first difference, with both sides of it.
pub(super) fn features(inputs: &[Input]) -> Result<Features> {
    let (first, others) = inputs.split_first().expect("an edit has an input");
    let mut agreed = first.set.info().features.clone();
    let of = first.set.root().display();
    for other in others {
        let (one, two) = (first.set.info(), other.set.info());
        let differ = |object: &str, expected: String, found: String| DatasetError::BadDataset {
            path: other.set.root().to_path_buf(),
            object: object.to_owned(),
            expected: format!("{expected}, as in {of}"),
            found,
        };
        if one.fps != two.fps {
            return Err(differ("fps", one.fps.to_string(), two.fps.to_string()));
        }
        if one.robot_type != two.robot_type {
            let text = |robot: &Option<String>| robot.clone().unwrap_or_else(|| "none".to_owned());
            return Err(differ("robot_type", text(&one.robot_type), text(&two.robot_type)));
        }
        for (name, feature) in &mut agreed.0 {
            let found = two.features.get(name);
            let object = format!("features.{name}");
            let Some(found) = found else {
                return Err(differ(&object, shown(feature), "no such feature".to_owned()));
            };
            if (&found.dtype, &found.shape) != (&feature.dtype, &feature.shape) {
                return Err(differ(&object, shown(feature), shown(found)));
            }
            if found.names != feature.names {
                return Err(differ(&format!("{object}.names"), feature.names.to_string(), found.names.to_string()));
            }
            let kind = |f: &Feature| match f.is_depth() {
                true => format!("depth in {}", f.depth_unit().unwrap_or("a unit that is not stated")),
                false => "no depth".to_owned(),
            };
            if kind(found) != kind(feature) {
                return Err(differ(&format!("{object}.info"), kind(feature), kind(found)));
            }
            join_info(feature, found);
        }
        if let Some(more) = two.features.names().find(|name| one.features.get(name).is_none()) {
            return Err(differ(&format!("features.{more}"), "no such feature".to_owned(), "one".to_owned()));
        }
        if let (Some(a), Some(b)) = (first.set.provenance(), other.set.provenance()) {
            let pairs = [
                ("actrm.env_name", format!("{:?}", a.env_name), format!("{:?}", b.env_name)),
                ("actrm.state_keys", format!("{:?}", a.state_keys), format!("{:?}", b.state_keys)),
                ("actrm.env_keys", format!("{:?}", a.env_keys), format!("{:?}", b.env_keys)),
                ("actrm.entities", format!("{:?}", a.entities), format!("{:?}", b.entities)),
                ("actrm.action", format!("{:?}", a.action), format!("{:?}", b.action)),
            ];
            if let Some((key, expected, found)) = pairs.into_iter().find(|(_, a, b)| a != b) {
                return Err(differ(key, expected, found));
            }
        }
    }
    Ok(agreed)
}

/// What `info.json` says besides, as far as all inputs say the same.
pub(super) fn others(inputs: &[Input], notes: &mut Vec<String>) -> BTreeMap<String, Value> {
    let each = || inputs.iter().map(|input| &input.set.info().other);
    let all: BTreeMap<&String, &Value> = each().flatten().collect();
    let (same, differ): (Vec<_>, Vec<_>) =
        all.into_iter().partition(|(key, value)| each().all(|other| other.get(*key) == Some(*value)));
    if !differ.is_empty() {
        let keys = list(differ.iter().map(|(key, _)| key.as_str()));
        notes.push(format!("the sets differ in {keys} of meta/info.json, which is left out"));
    }
    same.into_iter().map(|(key, value)| (key.clone(), value.clone())).collect()
}

fn shown(feature: &Feature) -> String {
    format!("{} {:?}", feature.dtype, feature.shape)
}

/// What is said of a camera's encoding, as far as both say it.
fn join_info(feature: &mut Feature, other: &Feature) {
    if let (Some(Value::Object(mine)), Some(Value::Object(theirs))) = (&mut feature.info, &other.info) {
        mine.retain(|key, value| theirs.get(key) == Some(value));
    }
}
