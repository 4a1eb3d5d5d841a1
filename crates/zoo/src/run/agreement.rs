//! Whether a data set is what an experiment is about: its task, and what its numbers are called.

use std::collections::BTreeMap;
use std::path::Path;

use dataset::Dataset;
use models::{ACTION, ENTITY_PREFIX, ENVIRONMENT_STATE, STATE};

use crate::config::is_built_in_task;
use crate::experiment::{DataSection, Experiment, IMAGE_PREFIX};
use crate::{FeatureKeys, ZooError};

use super::names::{self, Names};

/// A data set and an experiment that say the same.
pub(super) struct Agreed {
    /// With its columns in the order that the experiment reads.
    pub dataset: Dataset,
    /// With the keys of the data set, where it named none itself for a task without a simulator.
    pub experiment: Experiment,
    /// What the data set calls the numbers of its columns, where those are not the experiment's keys; none where it does not name them.
    pub names: BTreeMap<String, Vec<String>>,
    /// What a user should know.
    pub notes: Vec<String>,
}

/// Whether keys that `experiment` leaves as they are by default may be taken from the data instead: nobody knows what a task
/// without a simulator reads.
pub(super) fn takes_keys(experiment: &Experiment) -> bool {
    !is_built_in_task(&experiment.task.name)
}

/// Compares `dataset` with `experiment`. `force`: another task and other names are notes.
///
/// # Errors
/// [`ZooError::UnfitData`]: demonstrations of another task, numbers of other names or keys.
pub(super) fn agree(dataset: &Dataset, path: &Path, experiment: &Experiment, force: bool) -> Result<Agreed, ZooError> {
    let unfit = |reason: String| ZooError::UnfitData { path: path.to_owned(), reason };
    let mut agreed =
        Agreed { dataset: dataset.clone(), experiment: experiment.clone(), names: BTreeMap::new(), notes: Vec::new() };
    let doubt = |notes: &mut Vec<String>, reason: String, remedy: &str| match force {
        true => {
            notes.push(format!("{reason}; trained anyway (--force)"));
            Ok(())
        }
        false => Err(unfit(format!("{reason}; {remedy}"))),
    };
    let task = &experiment.task.name;
    // LIBERO's files say which suite, which is all that `SUITE/NUMBER` and they have to share
    let other = |recorded: &String| recorded != task && task.split_once('/').is_none_or(|(suite, _)| suite != recorded);
    if let Some(recorded) = recorded_task(dataset).filter(other) {
        let reason = format!("demonstrations of {recorded}, but the experiment's task is {task}");
        let remedy = format!("train with task.name={recorded}, with demonstrations of {task}, or with --force");
        doubt(&mut agreed.notes, reason, &remedy)?;
    }
    let free = takes_keys(experiment);
    if free {
        take_keys(&mut agreed);
    }
    let keys = agreed.experiment.data.all_keys()?;
    check_keys(dataset, &agreed.experiment, &keys).map_err(unfit)?;
    let features: Vec<String> =
        keys.features().filter(|feature| !feature.starts_with(IMAGE_PREFIX)).map(str::to_owned).collect();
    for feature in features.iter().map(String::as_str).chain([ACTION]) {
        let Some(column) = dataset.column(feature) else {
            if feature == ENVIRONMENT_STATE {
                agreed.notes.push(format!("{feature}: not in the data set, trained without it"));
            }
            continue;
        };
        let (items, stated) = (keys.items(feature), dataset.names(feature));
        // nobody knows what the actions of a task without a simulator are
        let any_action = free && feature == ACTION && !names::is_counted(&stated);
        if is_whole(feature, &keys.of(feature)) || any_action {
            agreed.names.insert(feature.to_owned(), stated);
            continue;
        }
        let (found, wanted) = match feature {
            ACTION => (names::of_action(&stated), "position, rotation and gripper".to_owned()),
            _ => (names::of_items(items, &stated), keys.of(feature).join(", ")),
        };
        let ours = dataset.provenance().is_some() && stated.is_empty();
        let count = column.dim;
        match found {
            // what a converter of ours chose is in its provenance
            Names::Silent if ours => {}
            Names::Silent => {
                let called = if stated.is_empty() { "has no names".to_owned() } else { stated.join(", ") };
                agreed.notes.push(format!(
                    "{feature}: the data set does not say what its {count} numbers are ({called}); taken as {wanted}, in this order"
                ));
                agreed.names.insert(feature.to_owned(), stated);
            }
            Names::Other => {
                let reason = format!("{feature}: expected {wanted}, found {}", stated.join(", "));
                let remedy = match feature {
                    ACTION => "the simulator would be sent other numbers (--force trains anyway)",
                    _ => {
                        "name the keys (data.state_keys, data.env_keys), give a task of your own (task.name), or --force"
                    }
                };
                doubt(&mut agreed.notes, reason, remedy)?;
                agreed.names.insert(feature.to_owned(), stated);
            }
            Names::Are { order, names } => {
                let moved = !order.iter().copied().eq(0..count);
                if moved {
                    agreed.notes.push(format!(
                        "{feature}: put into the order {wanted}; the data set has {}",
                        stated.join(", ")
                    ));
                    agreed.dataset = agreed
                        .dataset
                        .reordered(feature, &order, &names)
                        .map_err(|source| ZooError::Dataset { path: path.to_owned(), source: Box::new(source) })?;
                }
                if stated != names {
                    agreed.names.insert(feature.to_owned(), stated);
                }
            }
        }
    }
    Ok(agreed)
}

/// The task that the demonstrations are of, as the data set states it: the environment, or an instruction that is the name of
/// one of our tasks.
fn recorded_task(dataset: &Dataset) -> Option<String> {
    match (dataset.env(), dataset.tasks()) {
        (Some(env), _) => Some(env.env_name.clone()),
        (None, [task]) if is_built_in_task(task) => Some(task.clone()),
        _ => None,
    }
}

/// Whether a feature is read as the column that the data set calls so, whatever it holds.
pub(crate) fn is_whole(feature: &str, items: &[String]) -> bool {
    matches!(items, [item] if item == feature)
}

/// Takes the keys of the data set where the experiment has the usual ones and the data set others.
fn take_keys(agreed: &mut Agreed) {
    let (usual, dataset) = (DataSection::default(), &agreed.dataset);
    let stated = |feature: &str, keys: &[String]| match dataset.provenance() {
        Some(provenance) if feature == STATE => provenance.state_keys.clone(),
        Some(provenance) => provenance.env_keys.clone(),
        None if dataset.column(feature).is_none() => Vec::new(),
        None => {
            let items: Vec<_> = keys.iter().filter_map(|key| key.parse().ok()).collect();
            match names::of_items(&items, &dataset.names(feature)) {
                Names::Are { .. } => keys.to_vec(),
                Names::Silent | Names::Other => vec![feature.to_owned()],
            }
        }
    };
    let (state, env) = (stated(STATE, &usual.state_keys), stated(ENVIRONMENT_STATE, &usual.env_keys));
    let data = &mut agreed.experiment.data;
    if data.state_keys == usual.state_keys && !state.is_empty() {
        data.state_keys = state;
    }
    if data.env_keys == usual.env_keys {
        data.env_keys = env;
    }
    if is_whole(STATE, &data.state_keys) {
        let task = &agreed.experiment.task.name;
        agreed.notes.push(format!("no simulator is known to have {task}: what is read are the data set's own columns"));
    }
}

/// Refuses, in words, a set that was converted with other keys. The same in another order are told by their names.
fn check_keys(dataset: &Dataset, experiment: &Experiment, keys: &FeatureKeys) -> Result<(), String> {
    let Some(provenance) = dataset.provenance() else { return Ok(()) };
    let (data, none) = (&experiment.data, Vec::new());
    let named = [
        ("data.state_keys".to_owned(), STATE.to_owned(), &data.state_keys, &provenance.state_keys),
        ("data.env_keys".to_owned(), ENVIRONMENT_STATE.to_owned(), &data.env_keys, &provenance.env_keys),
    ];
    let entities = data.columns().map(|(setting, name, keys)| {
        let found = provenance.entities.get(name).unwrap_or(&none);
        (setting, format!("{ENTITY_PREFIX}{name}"), keys, found)
    });
    for (setting, feature, expected, found) in named.into_iter().chain(entities) {
        let reordered = || matches!(names::of_items(keys.items(&feature), &dataset.names(&feature)), Names::Are { .. });
        if expected != found && !is_whole(&feature, expected) && !(dataset.column(&feature).is_some() && reordered()) {
            let found = if found.is_empty() { "none".to_owned() } else { found.join(", ") };
            return Err(format!("{setting}: expected {}, found {found}", expected.join(", ")));
        }
    }
    Ok(())
}
