//! Entries as they are pushed to the Hugging Face Hub: what is sealed with them, and cards with results. That the Hub's own
//! library reads the cards, `make interop` shows.

use std::fs;
use std::path::Path;
use std::process::Command;

use e2e::{copied_zoo, listing, refused, root, succeeds, text, trained, zoo};

/// What it printed.
fn said(command: &mut Command) -> String {
    String::from_utf8(succeeds(command).stdout).expect("text")
}

fn card(entries: &Path) -> String {
    said(&mut zoo(["show", "lift-act", "--card", "--zoo", text(entries)]))
}

#[test]
fn metrics_and_command_are_sealed_with_an_entry() {
    let (_folder, entries) = copied_zoo();
    let folder = entries.join("lift-act/1");
    let files = [
        "README.md",
        "command.txt",
        "config.toml",
        "entry.json",
        "model.safetensors",
        "normaliser.safetensors",
        "reference.safetensors",
        "train.parquet",
    ];
    assert_eq!(listing(&folder), files);
    let data = trained().join("lift");
    let command = fs::read_to_string(folder.join("command.txt")).expect("text");
    assert_eq!(command, format!("actrm-zoo train act_lift train.steps=2 --data {}\n", text(&data)));
    assert!(!fs::read_to_string(folder.join("entry.json")).expect("text").contains("\"curve\""));
    let curves = said(&mut zoo(["curves", "lift-act", "--json", "--zoo", text(&entries)]));
    assert!(curves.contains("\"step\": 2") && curves.contains("valid_loss"), "{curves}");
    for name in ["train.parquet", "command.txt", "reference.safetensors"] {
        let original = fs::read(folder.join(name)).expect("readable");
        let mut bytes = original.clone();
        bytes[7] ^= 1;
        fs::write(folder.join(name), bytes).expect("writable");
        refused(&mut zoo(["show", "lift-act", "--zoo", text(&entries)]), &[name, "sha256 does not match"]);
        fs::write(folder.join(name), original).expect("writable");
    }
}

#[test]
fn a_card_has_the_results_that_stand_and_no_others() {
    let (folder, entries) = copied_zoo();
    let sealed = fs::read_to_string(entries.join("lift-act/1/README.md")).expect("a card");
    assert!(
        sealed.starts_with("---\nlibrary_name: actrm\nlicense: apache-2.0\npipeline_tag: robotics\ntags:\n"),
        "{sealed}"
    );
    assert_eq!(card(&entries), sealed, "there are no results yet");
    let people = said(&mut zoo(["show", "lift-act", "--zoo", text(&entries)]));
    assert!(people.starts_with("# lift-act@1\n"), "{people}");

    succeeds(&mut zoo(["eval", "lift-act", "--episodes", "2", "--max-steps", "4", "--zoo", text(&entries)]));
    let measured = card(&entries);
    for line in [
        "\nmodel-index:\n- name: \"lift-act@1\"\n",
        "\n      type: robotics\n",
        "\n    - type: success_rate\n",
        "\n      value: 0.0\n",
        "\"episodes\":2,",
        "95% interval 0.0-65.8",
    ] {
        assert!(measured.contains(line), "{line:?} in\n{measured}");
    }
    // pushed and pulled, it is the entry; the one in the zoo is as it was
    let pulled = folder.path().join("pulled/lift-act");
    fs::create_dir_all(&pulled).expect("creatable");
    succeeds(&mut zoo(["export", "hub", "lift-act", text(&pulled.join("1")), "--zoo", text(&entries)]));
    assert_eq!(fs::read_to_string(pulled.join("1/README.md")).expect("a card"), measured);
    succeeds(&mut zoo(["verify", "--deep", "--zoo", text(&folder.path().join("pulled"))]));
    assert_eq!(fs::read_to_string(entries.join("lift-act/1/README.md")).expect("a card"), sealed);
    refused(&mut zoo(["export", "hub", "lift-act", text(&pulled.join("1")), "--zoo", text(&entries)]), &["exists"]);

    // a result that does not stand is no claim
    let results = entries.join("results");
    let outcomes = results.join(listing(&results).remove(0)).join("outcomes.parquet");
    let mut bytes = fs::read(&outcomes).expect("readable");
    bytes[40] ^= 1;
    fs::write(&outcomes, bytes).expect("writable");
    assert_eq!(card(&entries), sealed);
}

#[test]
fn entries_from_before_get_their_metadata_where_they_are_pushed() {
    let shipped = root().join("zoo");
    let text = card(&shipped);
    let old = fs::read_to_string(shipped.join("lift-act/1/README.md")).expect("a card");
    assert!(!old.starts_with("---") && text.ends_with(&format!("---\n\n{old}")), "{text}");
    assert_eq!(text.matches("- type: success_rate").count(), 2, "{text}");
    assert!(text.contains("split: \"test\"") && text.contains("split: \"dev\""), "{text}");
}
