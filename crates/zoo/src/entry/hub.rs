//! Entries on the Hugging Face Hub: the YAML that a card begins with, and the folder that is pushed.
//!
//! A card's metadata is sealed with it. What evaluations say of the entry follows from results, which come later: it may
//! stand in a card besides, as `model-index`, the last key of its metadata. Opening an entry leaves it out of what is hashed.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;

use super::{CARD_FILE, ENTRY_FILE, Entry, EntryMeta};
use crate::files::new_folder;
use crate::{ZooError, write_atomic};

/// Before and after the metadata.
const FENCE: &str = "---\n";
/// The key of what evaluations say.
const RESULTS: &str = "model-index:\n";

/// The metadata that a card begins with, between its fences.
pub(super) fn metadata(meta: &EntryMeta) -> String {
    let mut text = format!("library_name: actrm\nlicense: {}\n", meta.license());
    // the Hub's own tags and ours, each once
    let mut tags: BTreeSet<&str> = ["actrm", &meta.policy, &meta.task].into();
    text.push_str(meta.hub_task(&mut tags));
    text.push_str("tags:\n");
    for tag in tags.into_iter().filter(|tag| !tag.is_empty()) {
        writeln!(text, "- {}", serde_json::Value::from(tag)).expect("writing into a String cannot fail");
    }
    text
}

/// A card's metadata and the text below it, where it has any.
fn split(card: &str) -> Option<(&str, &str)> {
    let rest = card.strip_prefix(FENCE)?;
    let end = rest.find(&format!("\n{FENCE}"))? + 1;
    Some((&rest[..end], &rest[end + FENCE.len()..]))
}

/// The text below a card's metadata.
pub(super) fn body(card: &str) -> &str {
    split(card).map_or(card, |(_, body)| body.trim_start_matches('\n'))
}

fn join(metadata: &str, body: &str) -> String {
    format!("{FENCE}{metadata}{FENCE}{body}")
}

/// What precedes `model-index` in metadata.
fn before_results(metadata: &str) -> &str {
    let place =
        if metadata.starts_with(RESULTS) { Some(0) } else { metadata.find(&format!("\n{RESULTS}")).map(|at| at + 1) };
    &metadata[..place.unwrap_or(metadata.len())]
}

/// The card with results, a YAML text that is a `model-index` or empty, in place of those that it has. A card that was
/// sealed before there was metadata gets it.
pub(super) fn with_results(card: &str, meta: &EntryMeta, model_index: &str) -> String {
    match split(card) {
        Some((own, body)) => join(&format!("{}{model_index}", before_results(own)), body),
        None => join(&format!("{}{model_index}", metadata(meta)), &format!("\n{card}")),
    }
}

/// What the card may have been when it was sealed, if results were written to it later: without them, and without any
/// metadata.
pub(super) fn without_results(card: &str) -> Vec<String> {
    let Some((metadata, body)) = split(card) else { return Vec::new() };
    let mut texts = vec![join(before_results(metadata), body)];
    texts.extend(body.strip_prefix('\n').map(str::to_owned));
    texts
}

/// Writes `entry` into the new folder `out`, to be pushed: its files, with results in its card ([`Entry::hub_card`]).
///
/// # Errors
/// When `out` exists or a file cannot be written.
pub fn export_hub(entry: &Entry, out: &Path, model_index: &str) -> Result<(), ZooError> {
    new_folder(out, |folder| {
        for name in entry.meta().files.keys().map(String::as_str).chain([ENTRY_FILE]) {
            let path = entry.folder().join(name);
            let bytes = match name {
                CARD_FILE => entry.hub_card(model_index)?.into_bytes(),
                _ => std::fs::read(&path).map_err(ZooError::io("read", &path))?,
            };
            write_atomic(&folder.join(name), &bytes)?;
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::testing::draft;
    use super::*;

    const INDEX: &str = "model-index:\n- name: \"lift-act@1\"\n  results: []\n";

    #[test]
    fn results_come_and_go_and_leave_the_card_as_it_was() {
        let meta = draft("lift-act").meta;
        let new = join(&metadata(&meta), "\n# lift-act@1\n\n---\nA rule is no fence.\n");
        let old = "# lift-act@1\n\nFrom before there was metadata.\n";
        for sealed in [new.as_str(), old] {
            let card = with_results(sealed, &meta, INDEX);
            assert!(
                card.starts_with("---\nlibrary_name: actrm\nlicense: apache-2.0\npipeline_tag: robotics\ntags:\n"),
                "{card}"
            );
            assert!(card.contains(&format!("{INDEX}---\n")), "{card}");
            assert!(without_results(&card).iter().any(|text| text == sealed), "{card}");
            assert_eq!(with_results(&card, &meta, INDEX), card, "once, however often");
            assert_eq!(body(&card), body(sealed));
            assert!(body(&card).starts_with("# lift-act@1"));
        }
        assert!(without_results(old).is_empty());
    }

    #[test]
    fn tags_are_told_once_and_quoted() {
        let mut meta = draft("lift-act").meta;
        meta.policy = "actrm".to_owned();
        meta.task = "Lift: \"two\"".to_owned();
        let text = metadata(&meta);
        assert_eq!(text.matches("- \"actrm\"\n").count(), 1, "{text}");
        assert!(text.contains("- \"Lift: \\\"two\\\"\"\n") && text.contains("- \"imitation-learning\"\n"), "{text}");
        meta.kind = Some("puzzle solver".to_owned());
        assert!(!metadata(&meta).contains("robotics"));
    }

    #[test]
    fn an_exported_entry_opens_and_any_other_change_of_its_card_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let zoo = folder.path().join("zoo");
        let id = draft("lift-act").seal(&zoo).unwrap();
        let entry = Entry::open(&zoo, &id).unwrap();
        let pushed = folder.path().join("hub/lift-act");
        std::fs::create_dir_all(&pushed).unwrap();
        let out = pushed.join("1");
        export_hub(&entry, &out, INDEX).unwrap();
        assert!(export_hub(&entry, &out, INDEX).unwrap_err().to_string().contains("create folder"));
        let opened = Entry::open(&folder.path().join("hub"), &id).unwrap();
        assert!(opened.card().unwrap().contains(INDEX));
        assert_eq!(opened.meta(), entry.meta());
        let path = out.join(CARD_FILE);
        let card = std::fs::read_to_string(&path).unwrap();
        for (from, to) in
            [("| steps", "| stepz"), ("A test.", "The best."), ("apache-2.0", "mit"), ("---\n\n", "---\n")]
        {
            let changed = card.replacen(from, to, 1);
            if changed == card {
                continue;
            }
            std::fs::write(&path, changed).unwrap();
            let error = Entry::open(&folder.path().join("hub"), &id).unwrap_err().to_string();
            assert!(error.contains("README.md: sha256 does not match"), "{from}: {error}");
        }
    }
}
