//! The model card: what `entry.json` says, for people.

use std::fmt::Write;

use models::ACTION;

use super::{EntryMeta, hub};
use crate::run::is_whole;

/// What the card of another kind of entry says differently from a robot policy's.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CardWords {
    /// Rows in place of the observations that a policy reads.
    pub rows: Vec<(String, String)>,
    /// What a batch is made of; empty: windows.
    pub examples: String,
    /// What to do with it: the commands after "Use:", with `{id}` for the entry; empty: a robot policy's, and what it is intended for.
    pub usage: String,
}

/// Renders the README.md of an entry.
pub(super) fn render(meta: &EntryMeta, words: &CardWords) -> String {
    let mut card = String::new();
    render_into(meta, words, &mut card).expect("writing into a String cannot fail");
    card
}

fn render_into(meta: &EntryMeta, words: &CardWords, card: &mut String) -> std::fmt::Result {
    writeln!(card, "---\n{}---\n\n# {}\n", hub::metadata(meta), meta.id())?;
    if !meta.description.is_empty() {
        writeln!(card, "{}\n", meta.description)?;
    }
    writeln!(card, "| | |\n|---|---|")?;
    let mut row = |what: &str, value: String| writeln!(card, "| {what} | {value} |");
    row("policy", meta.policy.clone())?;
    row("task", meta.task.clone())?;
    row("experiment", meta.experiment.clone())?;
    row("parameters", grouped(meta.parameters))?;
    for spec in &meta.signature.observation {
        row(&spec.name, feature(meta, &spec.name))?;
    }
    if let Some(names) = meta.data.as_ref().and_then(|data| data.names.get(ACTION)) {
        row(ACTION, format!("{} numbers, {}", meta.signature.action_dim, called(names)))?;
    }
    for (what, value) in &words.rows {
        row(what, value.clone())?;
    }
    if let Some(data) = &meta.data {
        row(
            "demonstrations",
            format!(
                "{}: {} episodes, {} frames trained on, {} episodes held out",
                data.name,
                data.train_episodes,
                grouped(data.train_frames),
                data.valid_episodes
            ),
        )?;
        row("data set", format!("`{}`", data.fingerprint))?;
    }
    if let Some(env) = &meta.env_name {
        let version = meta.env_version.as_deref().unwrap_or("unknown version");
        row("recorded in", format!("{env}, {version}"))?;
    }
    if let Some(training) = &meta.training {
        row(
            "training",
            format!(
                "{} steps of {} {}, seed {}, {:.1} minutes on {} threads",
                grouped(training.steps),
                training.batch_size,
                if words.examples.is_empty() { "windows" } else { &words.examples },
                training.seed,
                training.minutes,
                training.threads
            ),
        )?;
        if let Some(last) = training.curve.last() {
            row("last training loss", format!("{:.5}", last.loss))?;
        }
        let valid = training.curve.iter().rev().find_map(|point| point.valid_loss);
        if let Some(valid) = valid {
            row("last validation loss", format!("{valid:.5}"))?;
        }
    }
    let versions: Vec<String> = meta.versions.iter().map(|(n, v)| format!("{n} {v}")).collect();
    row("made with", versions.join(", "))?;
    if !words.usage.is_empty() {
        return writeln!(
            card,
            "\nUse: {}. Provenance and the hash of every file: `entry.json`; the whole experiment: `config.toml`.",
            words.usage.replace("{id}", &meta.id().to_string())
        );
    }
    if meta.is_of_data_alone() {
        return writeln!(
            card,
            "\nUse: `actrm.load_policy(\"{id}\")` in Python; no simulator has the task above. Provenance and the hash of every \
             file: `entry.json`; the whole experiment: `config.toml`.\n\n\
             Intended for the robot and the task of its demonstrations, in their observation and action spaces; nothing is known \
             about it elsewhere.",
            id = meta.id()
        );
    }
    let module = meta.env_module.as_ref().map_or_else(String::new, |module| format!(" --env-module {}", module.name));
    writeln!(
        card,
        "\nUse: `actrm-zoo eval {id} --episodes 50{module}`. Provenance and the hash of every file: `entry.json`; \
         the whole experiment: `config.toml`.\n\n\
         Intended for the task above in simulation, in the observation and action spaces that it was trained in; \
         nothing is known about it elsewhere.",
        id = meta.id()
    )
}

/// What a feature is made of, and what the data set calls its numbers where that is something else.
fn feature(meta: &EntryMeta, name: &str) -> String {
    let keys = meta.keys.of(name);
    let names = meta.data.as_ref().and_then(|data| data.names.get(name));
    let whole = is_whole(name, &keys);
    match (names, keys.is_empty()) {
        (Some(names), _) if whole => {
            let width = meta.signature.get(name).map_or(names.len(), models::FeatureSpec::width);
            format!("{width} numbers, {}", called(names))
        }
        (Some(names), _) => format!("{}; {}", keys.join(", "), called(names)),
        (None, true) => "none".to_owned(),
        (None, false) => keys.join(", "),
    }
}

/// What a data set calls numbers.
fn called(names: &[String]) -> String {
    match names.is_empty() {
        true => "which the data set does not name".to_owned(),
        false => format!("in the data set: {}", names.join(", ")),
    }
}

/// 1503751 as `1,503,751`.
pub fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_card_says_what_the_data_set_calls_its_numbers() {
        let mut meta = super::super::testing::draft("cube").meta;
        let names = |text: &str| text.split(' ').map(str::to_owned).collect::<Vec<_>>();
        let data = meta.data.as_mut().unwrap();
        data.names.insert(models::STATE.to_owned(), names("z y x"));
        data.names.insert(ACTION.to_owned(), Vec::new());
        let card = render(&meta, &CardWords::default());
        for expected in [
            "| observation.state | robot0_eef_pos; in the data set: z, y, x |",
            "| observation.environment_state | object |",
            "| action | 7 numbers, which the data set does not name |",
            "actrm-zoo eval",
        ] {
            assert!(card.contains(expected), "{expected} in\n{card}");
        }
        // a task of one's own on columns of one's own
        (meta.task, meta.env_name, meta.env_version) = ("transfer_cube".to_owned(), None, None);
        meta.keys.insert(models::STATE, &[models::STATE.to_owned()]).unwrap();
        let card = render(&meta, &CardWords::default());
        assert!(card.contains("| observation.state | 9 numbers, in the data set: z, y, x |"), "{card}");
        assert!(card.contains("no simulator has the task") && !card.contains("actrm-zoo eval"), "{card}");
    }

    #[test]
    fn the_card_says_what_it_is() {
        let mut meta = super::super::testing::draft("lift-act").meta;
        meta.version = 3;
        meta.parameters = 1_503_751;
        let card = render(&meta, &CardWords::default());
        for expected in [
            "---\nlibrary_name: actrm\n",
            "---\n\n# lift-act@3",
            "| parameters | 1,503,751 |",
            "| demonstrations | lift.hdf5: 45 episodes, 2,000 frames trained on, 5 episodes held out |",
            "| training | 3 steps of 64 windows, seed 1, 1.2 minutes on 2 threads |",
            "| last validation loss | 0.50000 |",
        ] {
            assert!(card.contains(expected), "{expected} in\n{card}");
        }
    }
}
