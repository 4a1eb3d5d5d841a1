//! What a result says of where it came from.

use super::super::features::ENTITY_PREFIX;
use super::super::info::Provenance;
use super::super::open::{ENVIRONMENT_STATE, STATE};
use super::super::schema::{CREATED_BY, hex};
use super::Edit;
use crate::error::Result;
use crate::source::file_number;
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Seeds, as sources state them: `FIRST-LAST`.
fn seeds_of(text: &str) -> Option<(u64, u64)> {
    let (first, last) = text.split_once('-').unwrap_or((text, text));
    Some((first.trim().parse().ok()?, last.trim().parse().ok()?))
}

/// The seeds from the least to the greatest: some between may not have been used, none that was is missing.
fn seeds_of_all(texts: &[Option<String>]) -> Option<String> {
    let mut all = texts.iter().flatten();
    let first = all.next()?;
    if all.all(|text| text == first) {
        return Some(first.clone());
    }
    let ranges: Option<Vec<(u64, u64)>> = texts.iter().flatten().map(|text| seeds_of(text)).collect();
    let ranges = ranges?;
    Some(format!("{}-{}", ranges.iter().map(|r| r.0).min()?, ranges.iter().map(|r| r.1).max()?))
}

/// The provenance of the result, still without its fingerprint; none unless every input has one.
pub(super) fn of(edit: &Edit<'_>, notes: &mut Vec<String>) -> Result<Option<Provenance>> {
    let all: Vec<&Provenance> = edit.inputs.iter().filter_map(|input| input.set.provenance()).collect();
    let first = match all.first() {
        Some(first) if all.len() == edit.inputs.len() => *first,
        Some(_) => {
            notes.push(
                "some of the sets were not converted by actrm: masks, demo ids and side folders are left out"
                    .to_owned(),
            );
            return Ok(None);
        }
        None => return Ok(None),
    };
    let sources: BTreeSet<(&str, &str)> = all.iter().map(|p| (p.source.as_str(), p.source_sha256.as_str())).collect();
    let mut sources: Vec<(&str, &str)> = sources.into_iter().collect();
    sources.sort_by_key(|(name, _)| file_number(Path::new(name)));
    let (source, source_sha256) = match sources.len() {
        1 => (first.source.clone(), first.source_sha256.clone()),
        // as a folder of these files
        _ => {
            let lines: String = sources.iter().map(|(name, sha256)| format!("{sha256}  {name}\n")).collect();
            let names: Vec<&str> = sources.iter().map(|(name, _)| *name).collect();
            (names.join(" + "), hex(&Sha256::digest(lines)))
        }
    };
    let mut shared = |what: &str, same: bool| {
        if !same {
            notes.push(format!("the sets differ in {what}, which is left out"));
        }
        same
    };
    let same = |get: &dyn Fn(&Provenance, &Provenance) -> bool| all.iter().all(|p| get(p, first));
    let env_version =
        first.env_version.clone().filter(|_| shared("env_version", same(&|a, b| a.env_version == b.env_version)));
    let same_expert = same(&|a, b| a.expert == b.expert);
    let expert = first.expert.clone().filter(|_| shared("the expert that recorded them", same_expert));
    let same_skill = same(&|a, b| a.skill == b.skill);
    let skill = first.skill.clone().filter(|_| shared("the skill of who showed them", same_skill));
    let same_args = same(&|a, b| a.env_args == b.env_args);
    let env_args = first.env_args.clone().filter(|_| shared("env_args", same_args));
    let same_video = same(&|a, b| a.video == b.video);
    let video = first.video.clone().filter(|_| shared("how their videos were encoded", same_video));
    let exact = same_video || all.iter().all(|p| p.video.as_ref().is_none_or(|v| v.side_pictures));
    let lossless = all.iter().all(|p| p.lossless) && exact && same_args;
    if !lossless && all.iter().any(|p| p.lossless) {
        let why = match (same_args, exact) {
            (false, _) => "one file has one env_args",
            (_, false) => "some have no exact images",
            _ => "some have none",
        };
        notes.push(format!("the side folders are left out ({why}): no HDF5 file can be rebuilt from the result"));
    }
    let seeds: Vec<Option<String>> = all.iter().map(|p| p.seeds.clone()).collect();
    let all_seeds = seeds_of_all(&seeds);
    let silent = seeds.iter().filter(|text| text.is_none()).count();
    if all_seeds.is_none() && silent < seeds.len() {
        notes.push("the sets differ in seeds, which are left out: they are no ranges".to_owned());
    } else if let (Some(range), 1..) = (&all_seeds, silent) {
        notes.push(format!("{silent} of {} sets state no seeds: {range} are those of the others", seeds.len()));
    }
    notes.extend(lacking_masks(edit));
    let dialects: BTreeSet<&str> = all.iter().map(|p| p.dialect.as_str()).collect();
    let keys = |name: &str| edit.features.get(name).and_then(|_| keys_of(first, edit.before(name)));
    let entities =
        edit.features.names().filter_map(|name| Some((name.strip_prefix(ENTITY_PREFIX)?.to_owned(), keys(name)?)));
    Ok(Some(Provenance {
        format: 1,
        writer: CREATED_BY.to_owned(),
        source,
        source_sha256,
        dialect: dialects.into_iter().collect::<Vec<_>>().join(" + "),
        fingerprint: String::new(),
        env_name: first.env_name.clone(),
        env_version,
        env_args,
        seeds: all_seeds,
        expert,
        skill,
        state_keys: keys(STATE).unwrap_or_default(),
        env_keys: keys(ENVIRONMENT_STATE).unwrap_or_default(),
        entities: entities.collect(),
        action: first.action.clone(),
        demos: demos(edit, notes),
        masks: masks(edit),
        // of several sets a mask's demos get new numbers, and those that are not there none
        masks_absent: if all.len() == 1 { first.masks_absent.clone() } else { BTreeMap::new() },
        skipped: all.iter().flat_map(|p| p.skipped.clone()).collect(),
        left_out: all.iter().flat_map(|p| p.left_out.clone()).collect::<BTreeSet<_>>().into_iter().collect(),
        lossless,
        seal: None,
        video,
    }))
}

/// The observation keys that a column was made of.
fn keys_of(provenance: &Provenance, column: &str) -> Option<Vec<String>> {
    match column {
        STATE => Some(provenance.state_keys.clone()),
        ENVIRONMENT_STATE => Some(provenance.env_keys.clone()),
        other => provenance.entities.get(other.strip_prefix(ENTITY_PREFIX)?).cloned(),
    }
}

/// The demos' ids; one that is taken already becomes the next number that no demo has.
fn demos(edit: &Edit<'_>, notes: &mut Vec<String>) -> Vec<String> {
    let stored = |input: &super::Input| input.set.episodes().iter().filter_map(|e| e.demo.clone()).collect::<Vec<_>>();
    let number = |id: &String| id.rsplit_once('_').and_then(|(_, number)| number.parse::<u64>().ok());
    let mut next = edit.inputs.iter().flat_map(stored).filter_map(|id| number(&id)).max().map_or(0, |n| n + 1);
    let (mut ids, mut known, mut others) = (Vec::new(), BTreeSet::new(), 0);
    for (input, taken) in edit.inputs.iter().zip(&edit.taken) {
        for &episode in taken {
            let mut id = input.set.episodes()[episode].demo.clone().unwrap_or_default();
            if !known.insert(id.clone()) {
                id = format!("demo_{next}");
                next += 1;
                others += 1;
                known.insert(id.clone());
            }
            ids.push(id);
        }
    }
    if others > 0 {
        notes.push(format!("{others} demos have a new number: another set has a demo of theirs"));
    }
    ids
}

/// A note of each set that lacks masks which another one has.
fn lacking_masks(edit: &Edit<'_>) -> Vec<String> {
    fn names(input: &super::Input) -> impl Iterator<Item = &str> {
        input.set.provenance().into_iter().flat_map(|p| p.masks.keys().map(String::as_str))
    }
    let all: BTreeSet<&str> = edit.inputs.iter().flat_map(names).collect();
    let note = |input: &super::Input| {
        let mine: BTreeSet<&str> = names(input).collect();
        let lacking: Vec<&str> = all.difference(&mine).copied().collect();
        let (set, episodes, masks) = (input.set.root().display(), input.set.episodes().len(), lacking.join(", "));
        (!lacking.is_empty())
            .then(|| format!("{set} has no mask {masks}: its {episodes} episodes are in none of the result's"))
    };
    edit.inputs.iter().filter_map(note).collect()
}

/// The masks of all inputs, in the numbers of the result.
fn masks(edit: &Edit<'_>) -> BTreeMap<String, Vec<usize>> {
    let mut masks: BTreeMap<String, Vec<usize>> = BTreeMap::new();
    for (input, numbers) in edit.inputs.iter().zip(edit.numbers()) {
        for (name, episodes) in input.set.provenance().iter().flat_map(|p| &p.masks) {
            let mine = masks.entry(name.clone()).or_default();
            mine.extend(episodes.iter().filter_map(|episode| numbers.get(episode)));
            mine.sort_unstable();
        }
    }
    masks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_of_several_sets_leave_none_out() {
        let some = |texts: &[&str]| texts.iter().map(|t| Some((*t).to_owned())).collect::<Vec<_>>();
        assert_eq!(seeds_of_all(&some(&["10-19", "10-19"])).as_deref(), Some("10-19"));
        assert_eq!(seeds_of_all(&some(&["10-19", "40-49", "7"])).as_deref(), Some("7-49"));
        assert_eq!(seeds_of_all(&[None, Some("3-4".to_owned())]).as_deref(), Some("3-4"));
        assert_eq!(seeds_of_all(&[None, None]), None);
    }
}
