//! Composed experiments say what the files that they replaced said.
#![allow(clippy::unwrap_used)]

use std::collections::BTreeSet;

use study::puzzle::AnyExperiment;
use zoo::config::Library;
use zoo::sha256_hex;

/// The resolved experiments of version 0.1, when each combination was a file: SHA-256 of the resolved TOML without its description,
/// and the name.
const RECORDED: &str = include_str!("experiments.sha256");

#[test]
fn every_experiment_of_version_0_1_resolves_to_the_same_settings() {
    let library = Library::built_in();
    let listed: BTreeSet<String> = library.names().unwrap().into_iter().collect();
    let mut other = Vec::new();
    for (hash, name) in RECORDED.lines().map(|line| line.split_once("  ").unwrap()) {
        let text = AnyExperiment::load(&library, name, &[]).unwrap().to_toml();
        let text: String =
            text.lines().filter(|line| !line.starts_with("description = ")).map(|l| format!("{l}\n")).collect();
        if sha256_hex(text.as_bytes()) != hash {
            other.push(name);
        }
        assert!(listed.contains(name), "{name} is not listed");
    }
    assert_eq!(other, Vec::<&str>::new());
    assert_eq!(RECORDED.lines().count(), 275);
}

#[test]
fn every_listed_experiment_loads_and_describes_itself() {
    let library = Library::built_in();
    let (mut entries, mut broken) = (BTreeSet::new(), Vec::new());
    for name in library.names().unwrap() {
        let experiment = match AnyExperiment::load(&library, &name, &[]) {
            Ok(experiment) => experiment,
            Err(error) => {
                broken.push(format!("{name}: {error}"));
                continue;
            }
        };
        assert!(experiment.description().ends_with('.'), "{name}: {}", experiment.description());
        assert!(
            entries.insert(experiment.entry().to_owned()),
            "{name}: another experiment makes {}",
            experiment.entry()
        );
    }
}

#[test]
fn parts_of_an_experiment_are_chosen_on_the_command_line() {
    let library = Library::built_in();
    let chosen = |words: &[&str]| library.choose(&words.iter().map(|w| (*w).to_owned()).collect::<Vec<_>>());
    let name = |words: &[&str]| chosen(words).unwrap().0;
    assert_eq!(name(&["policy=act", "task=stack"]), "act_stack");
    assert_eq!(name(&["act_stack", "inputs=image"]), "act_stack_image");
    assert_eq!(name(&["bc_rnn_lift_image", "task=stack", "inputs=state"]), "bc_rnn_stack");
    assert_eq!(
        chosen(&["act_stack", "train.steps=5"]).unwrap(),
        ("act_stack".to_owned(), vec!["train.steps=5".to_owned()])
    );
    assert_eq!(
        chosen(&["policy=act"]).unwrap_err().to_string(),
        "key `task`: expected the task as well: an experiment is policy=... task=... [inputs=...], found none"
    );
    assert!(chosen(&["act_stak", "inputs=image"]).unwrap_err().to_string().contains("did you mean `act_stack`"));
}
