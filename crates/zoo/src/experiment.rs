//! An experiment: what is trained, on which demonstrations, how, and how the result acts.

mod entities;
mod grids;

use std::collections::BTreeMap;

use models::{
    ACTION, ENTITY_PREFIX, ENVIRONMENT_STATE, FeatureKind, ModelError, NormMode, PolicyConfig, PolicyType, STATE,
    Signature,
};
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

pub use self::entities::EntitySection;
pub use self::grids::GridSection;
use crate::config::{Library, apply_overrides, from_value, from_value_as};
use crate::run::TrainSection;
pub use crate::transforms::{BeginningSection, DataSection, SwapSection};
use crate::{FeatureKeys, ZooError};

/// What the name of a camera's feature begins with, LeRobot's.
pub const IMAGE_PREFIX: &str = "observation.images.";
/// What a camera's observation key ends in, robomimic's.
pub(crate) const IMAGE_SUFFIX: &str = "_image";

/// A resolved experiment, as `config.toml` of runs and entries holds it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Experiment {
    /// Name of the entry that training makes.
    pub entry: String,
    /// One sentence for the model card.
    pub description: String,
    /// The task.
    pub task: TaskSection,
    /// The demonstrations.
    pub data: DataSection,
    /// How features are normalised.
    pub normalisation: NormalisationSection,
    /// The model.
    pub policy: PolicyConfig,
    /// The training.
    pub train: TrainSection,
    /// How predictions become actions.
    pub rollout: RolloutSection,
}

/// The same with the policy still a table: its type decides which keys it may have.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Sections {
    entry: String,
    #[serde(default)]
    description: String,
    task: TaskSection,
    #[serde(default)]
    data: DataSection,
    #[serde(default)]
    normalisation: NormalisationSection,
    policy: Table,
    train: TrainSection,
    rollout: RolloutSection,
}

/// `[task]`
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskSection {
    /// The task's name in the simulator.
    pub name: String,
}

/// The longest history.
const MOST_OBS_STEPS: usize = 1000;

impl DataSection {
    /// Which observation keys make which feature.
    ///
    /// # Errors
    /// The setting whose keys cannot be read.
    pub fn feature_keys(&self) -> Result<FeatureKeys, ZooError> {
        let mut keys = FeatureKeys::default();
        let mut add = |setting: String, feature: &str, of: &[String]| {
            let expected = "observation keys, parts of them (key[0:3]) and differences (a - b)".to_owned();
            keys.insert(feature, of).map_err(|found| ZooError::InvalidValue { key: setting, expected, found })
        };
        add("data.state_keys".to_owned(), STATE, &self.state_keys)?;
        if !self.env_keys.is_empty() {
            add("data.env_keys".to_owned(), ENVIRONMENT_STATE, &self.env_keys)?;
        }
        for (name, entity) in &self.entities {
            add(format!("data.entities.{name}"), &format!("{ENTITY_PREFIX}{name}"), &entity.keys)?;
        }
        for camera in &self.cameras {
            add("data.cameras".to_owned(), &format!("{IMAGE_PREFIX}{camera}"), &[format!("{camera}{IMAGE_SUFFIX}")])?;
        }
        Ok(keys)
    }

    /// The camera whose pictures an item stands for, if it does.
    pub(crate) fn camera_of(&self, item: &str) -> Option<&str> {
        let camera = item.strip_suffix(IMAGE_SUFFIX)?;
        self.cameras.iter().find(|known| *known == camera).map(String::as_str)
    }

    fn check(&self, reads: &[FeatureKind]) -> Result<(), ZooError> {
        let invalid = |key: String, expected: &str, found: String| {
            Err(ZooError::InvalidValue { key, expected: expected.to_owned(), found })
        };
        if self.state_keys.is_empty() {
            return invalid("data.state_keys".to_owned(), "at least one key", "none".to_owned());
        }
        // more is no history of a robot, and would be read into memory for every window
        if !(1..=MOST_OBS_STEPS).contains(&self.n_obs_steps) {
            let expected = format!("1 to {MOST_OBS_STEPS}");
            return invalid("data.n_obs_steps".to_owned(), &expected, self.n_obs_steps.to_string());
        }
        let good = |word: &str| {
            !word.is_empty() && word.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
        };
        for (name, entity) in &self.entities {
            let key = format!("data.entities.{name}");
            for word in [name.as_str(), entity.group_of(name)] {
                if !good(word) {
                    return invalid(key, "names of lower-case letters, digits and _", format!("`{word}`"));
                }
            }
            if entity.keys.is_empty() {
                return invalid(key, "at least one key", "none".to_owned());
            }
        }
        if !self.entities.is_empty() && !reads.contains(&FeatureKind::Entity) {
            let kinds: Vec<&str> = reads.iter().map(|kind| kind.name()).collect();
            let expected = format!("none: this policy reads {}", kinds.join(", "));
            let names: Vec<&str> = self.entities.keys().map(String::as_str).collect();
            return invalid("data.entities".to_owned(), &expected, names.join(", "));
        }
        if let Some(camera) =
            self.cameras.iter().find(|camera| !camera.chars().all(|c| c.is_ascii_alphanumeric() || c == '_'))
        {
            return invalid("data.cameras".to_owned(), "names of letters, digits and _", format!("`{camera}`"));
        }
        if let Some(twice) = self.cameras.iter().enumerate().find(|(i, camera)| self.cameras[..*i].contains(camera)) {
            return invalid("data.cameras".to_owned(), "every camera once", format!("`{}` twice", twice.1));
        }
        if !self.cameras.is_empty() && !reads.contains(&FeatureKind::Image) {
            let kinds: Vec<&str> = reads.iter().map(|kind| kind.name()).collect();
            let expected = format!("none: this policy reads {}", kinds.join(", "));
            return invalid("data.cameras".to_owned(), &expected, self.cameras.join(", "));
        }
        let colours = &self.picture_colours;
        if !colours.is_empty()
            && (colours.len() != 3 || self.cameras.is_empty() || colours.iter().any(|n| !self.entities.contains_key(n)))
        {
            let names: Vec<&str> = self.entities.keys().map(String::as_str).collect();
            let expected = format!("none without data.cameras, or three of the entities: {}", names.join(", "));
            return invalid("data.picture_colours".to_owned(), &expected, colours.join(", "));
        }
        Ok(())
    }
}

/// `[normalisation]`: mean and standard deviation everywhere unless said otherwise.
///
/// LeRobot's ACT leaves the environment state raw; `environment_state = "identity"` does the same.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NormalisationSection {
    /// Normalisation of `observation.state`.
    pub state: NormMode,
    /// Normalisation of `observation.environment_state`.
    pub environment_state: NormMode,
    /// Normalisation of entities.
    #[serde(skip_serializing_if = "is_default")]
    pub entities: NormMode,
    /// Normalisation of `action`.
    pub action: NormMode,
}

impl NormalisationSection {
    /// The modes of the actions and of the signature's features, by name; pictures have none.
    pub fn modes(&self, signature: &Signature) -> BTreeMap<String, NormMode> {
        let mut modes = BTreeMap::from([(ACTION.to_owned(), self.action)]);
        for spec in &signature.observation {
            let mode = match spec.kind {
                FeatureKind::State => self.state,
                FeatureKind::EnvironmentState => self.environment_state,
                FeatureKind::Entity => self.entities,
                FeatureKind::Image => continue,
            };
            modes.insert(spec.name.clone(), mode);
        }
        modes
    }
}

fn is_default(mode: &NormMode) -> bool {
    *mode == NormMode::default()
}

/// `[rollout]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RolloutSection {
    /// Number of actions of a chunk that are executed before the policy is queried again.
    pub n_action_steps: usize,
    /// Temporal ensemble: query at every step and average all predictions with this coefficient (ACT: 0.01).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub temporal_ensemble: Option<f64>,
    /// Steps after which an episode has failed; absent: the task's own limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_steps: Option<usize>,
}

impl Experiment {
    /// Resolves experiment `name` of `library` with dotted `overrides` laid over it. With another task than its own it is no longer
    /// what its description says, and gets one that is true.
    ///
    /// # Errors
    /// Unknown experiments, keys and values; combinations that cannot work.
    pub fn load(library: &Library, name: &str, overrides: &[String]) -> Result<Self, ZooError> {
        let mut table = library.resolve(name)?;
        let task = |table: &Table| table.get("task").and_then(|task| task.get("name")).cloned();
        let (own_task, own_description) = (task(&table), table.get("description").cloned());
        apply_overrides(&mut table, overrides)?;
        let mut experiment = Self::from_table(table)?;
        let own = |own: Option<Value>, now: &str| own.as_ref().and_then(Value::as_str) == Some(now);
        if !own(own_task, &experiment.task.name) && own(own_description, &experiment.description) {
            let Self { policy, task, .. } = &experiment;
            experiment.description =
                format!("A policy of type {} for {}, with the settings of {name}.", policy.policy_type(), task.name);
        }
        Ok(experiment)
    }

    /// Reads the text of a saved `config.toml`.
    ///
    /// # Errors
    /// As [`Experiment::load`].
    pub fn from_toml(name: &str, text: &str) -> Result<Self, ZooError> {
        let table = toml::from_str(text)
            .map_err(|source| ZooError::ExperimentSyntax { experiment: name.to_owned(), source: Box::new(source) })?;
        Self::from_table(table)
    }

    /// Reads a resolved table.
    ///
    /// # Errors
    /// As [`Experiment::load`].
    pub fn from_table(table: Table) -> Result<Self, ZooError> {
        let sections: Sections = from_value(&Value::Table(table), &[])?;
        let experiment = Self {
            entry: sections.entry,
            description: sections.description,
            task: sections.task,
            data: sections.data.with_cells()?,
            normalisation: sections.normalisation,
            policy: policy(sections.policy)?,
            train: sections.train,
            rollout: sections.rollout,
        };
        experiment.check()?;
        Ok(experiment)
    }

    /// What serde cannot see: values that do not go together.
    ///
    /// # Errors
    /// The first key that does not fit.
    pub fn check(&self) -> Result<(), ZooError> {
        let invalid = |key: &str, expected: String, found: String| {
            Err(ZooError::InvalidValue { key: key.to_owned(), expected, found })
        };
        crate::entry::check_name(&self.entry)?;
        let steps = self.rollout.n_action_steps;
        let action_horizon = self.policy.action_horizon();
        let past = self.policy.past_actions(self.data.n_obs_steps);
        if steps == 0 || steps + past > action_horizon {
            let expected = match past {
                0 => format!("1 to policy.action_horizon, {action_horizon}"),
                _ => format!(
                    "1 to policy.action_horizon, {action_horizon}, less the {past} actions before the present one"
                ),
            };
            return invalid("rollout.n_action_steps", expected, steps.to_string());
        }
        if self.rollout.temporal_ensemble.is_some() && steps != 1 {
            let expected = "1, because rollout.temporal_ensemble asks at every step".to_owned();
            return invalid("rollout.n_action_steps", expected, steps.to_string());
        }
        if let Some(coefficient) = self.rollout.temporal_ensemble {
            let checked = crate::results::Execution::TemporalEnsemble { coefficient }.check(action_horizon);
            if let Err(crate::results::ResultsError::InvalidValue { key, expected, found }) = checked {
                return invalid(&format!("rollout.{key}"), expected, found);
            }
        }
        if self.rollout.max_steps == Some(0) {
            return invalid("rollout.max_steps", "at least 1".to_owned(), "0".to_owned());
        }
        let possible = self.policy.validate();
        let possible =
            possible.and_then(|()| self.policy.check_data(self.data.n_obs_steps, !self.data.cameras.is_empty()));
        possible.map_err(self.model_error("build the policy of"))?;
        self.data.check(self.policy.reads())?;
        crate::transforms::check(self)?;
        self.train.check()
    }

    /// Kind of policy, as the config names it.
    pub fn policy_type(&self) -> String {
        self.policy.policy_type().to_owned()
    }

    /// The resolved experiment as TOML: the same text for the same experiment.
    pub fn to_toml(&self) -> String {
        // through a table: its keys are sorted, and values come before sections
        let table = Table::try_from(self).expect("an experiment read from TOML can be written as TOML");
        toml::to_string_pretty(&table).expect("a table is TOML")
    }

    /// Dotted keys and values, for comparing two experiments.
    pub fn flat(&self) -> BTreeMap<String, String> {
        let mut flat = BTreeMap::new();
        let table = Table::try_from(self).expect("an experiment read from TOML can be written as TOML");
        flatten("", &table, &mut flat);
        flat
    }

    /// Wraps an error of the model's configuration with where it comes from.
    pub fn model_error(&self, operation: &'static str) -> impl FnOnce(ModelError) -> ZooError + use<> {
        let name = self.entry.clone();
        move |source| ZooError::Model { operation, name, source }
    }
}

/// Reads `[policy]` as the config of the model that its `type` names.
fn policy(mut table: Table) -> Result<PolicyConfig, ZooError> {
    let Some(name) = table.remove("type") else {
        return Err(ZooError::MissingKey { key: "policy.type".to_owned() });
    };
    let Some(kind) = name.as_str().and_then(PolicyType::named) else {
        return Err(ZooError::InvalidValue {
            key: "policy.type".to_owned(),
            expected: format!("one of {}", PolicyConfig::TYPES.join(", ")),
            found: name.to_string(),
        });
    };
    from_value_as(kind, &Value::Table(table), &["policy"])
}

/// Puts the dotted keys and values of `table` into `flat`.
pub fn flatten(prefix: &str, table: &Table, flat: &mut BTreeMap<String, String>) {
    for (key, value) in table {
        let path = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
        match value {
            Value::Table(inner) => flatten(&path, inner, flat),
            other => {
                flat.insert(path, other.to_string());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn load(overrides: &[&str]) -> Result<Experiment, String> {
        let overrides: Vec<String> = overrides.iter().map(|o| (*o).to_owned()).collect();
        Experiment::load(&Library::built_in(), "act_lift", &overrides).map_err(|e| e.to_string())
    }

    #[test]
    fn saved_experiments_read_back() {
        let experiment = load(&["rollout.max_steps=300", "data.env_keys=[]"]).unwrap();
        let text = experiment.to_toml();
        let back = Experiment::from_toml("x", &text).unwrap();
        assert_eq!(back, experiment);
        assert_eq!(back.to_toml(), text);
    }

    #[test]
    fn another_task_has_another_description() {
        let lift = load(&[]).unwrap();
        assert!(lift.description.contains("robosuite's Lift"));
        assert_eq!(load(&["task.name=Lift"]).unwrap(), lift);
        let other = load(&["task.name=transfer_cube"]).unwrap();
        assert_eq!(other.description, "A policy of type act for transfer_cube, with the settings of act_lift.");
        assert_eq!(load(&["task.name=transfer_cube", "description='Mine.'"]).unwrap().description, "Mine.");
    }

    #[test]
    fn overrides_reach_every_section() {
        let experiment = load(&["train.steps=7", "policy.dim_model=64", "task.name=Stack"]).unwrap();
        assert_eq!(experiment.train.steps, 7);
        assert_eq!(experiment.task.name, "Stack");
        assert_eq!(experiment.flat()["policy.dim_model"], "64");
    }

    #[test]
    fn typos_name_the_key_and_its_alternatives() {
        let error = |o: &str| load(&[o]).unwrap_err();
        let message = error("train.stesp=5");
        assert!(message.starts_with("unknown key `train.stesp` (did you mean `steps`?); keys here: "), "{message}");
        let message = error("policy.dim_modle=5");
        assert!(message.starts_with("unknown key `policy.dim_modle` (did you mean `dim_model`?)"), "{message}");
        let message = error("trian.steps=5");
        assert!(message.starts_with("unknown key `trian` (did you mean `train`?)"), "{message}");
        assert_eq!(error("policy.dim_model=wide"), "key `policy.dim_model`: expected usize, found string \"wide\"");
        assert!(error("policy.type=atc").starts_with("key `policy.type`: expected one of act"));
        assert!(error("normalisation.state=none").starts_with("key `normalisation.state`: expected one of identity, "));
    }

    #[test]
    fn combinations_that_cannot_work_are_refused() {
        let error = |o: &[&str]| load(o).unwrap_err();
        assert_eq!(
            error(&["rollout.n_action_steps=17"]),
            "key `rollout.n_action_steps`: expected 1 to policy.action_horizon, 16, found 17"
        );
        assert!(error(&["rollout.temporal_ensemble=0.01"]).starts_with("key `rollout.n_action_steps`: expected 1, "));
        assert!(load(&["rollout.temporal_ensemble=0.01", "rollout.n_action_steps=1"]).is_ok());
        assert_eq!(
            error(&["rollout.temporal_ensemble=nan", "rollout.n_action_steps=1"]),
            "key `rollout.temporal_ensemble`: expected a finite number from -10.0 to 10, found NaN"
        );
        assert_eq!(error(&["rollout.max_steps=0"]), "key `rollout.max_steps`: expected at least 1, found 0");
        assert_eq!(error(&["policy.kl_weight=-1"]), "cannot build the policy of `lift-act`");
        assert!(error(&["train.batch_size=0"]).starts_with("key `train.batch_size`: expected at least 1"));
        assert!(error(&["entry=Lift"]).starts_with("entry name `Lift`"));
        assert!(error(&["data.state_keys=[]"]).starts_with("key `data.state_keys`"));
        assert_eq!(error(&["data.n_obs_steps=0"]), "key `data.n_obs_steps`: expected 1 to 1000, found 0");
        // known before the data is opened
        let images = "data.cameras=['agentview']";
        assert_eq!(error(&["data.n_obs_steps=2", images]), "cannot build the policy of `lift-act`");
        let often = error(&["data.beginning={steps=8,times=1000000000000}"]);
        assert!(often.starts_with("key `data.beginning`: expected 1 to 1000"), "{often}");
    }

    #[test]
    fn entities_are_lists_or_tables() {
        let experiment = load(&[
            "data.entities.cube0=['a', 'a - b']",
            "data.entities.goal={keys = ['c[0:3]'], group = 'places', position = true}",
        ])
        .unwrap();
        let entities = &experiment.data.entities;
        assert_eq!((entities["cube0"].group_of("cube0"), entities["cube0"].position), ("cube", false));
        assert_eq!((entities["goal"].group_of("goal"), entities["goal"].position), ("places", true));
        let keys = experiment.data.feature_keys().unwrap();
        assert_eq!(keys.of("observation.entity.cube0"), ["a", "a - b"]);
        assert_eq!(Experiment::from_toml("x", &experiment.to_toml()).unwrap(), experiment);
        let error = |o: &str| load(&[o]).unwrap_err();
        assert_eq!(
            error("data.entities.cube=['a[']"),
            "key `data.entities.cube`: expected observation keys, parts of them (key[0:3]) and differences (a - b), \
             found `a[`: expected key[from:to] with from below to"
        );
        assert!(
            error("data.entities.cube={keys=['a'], grup='x'}").starts_with("unknown key `data.entities.cube.grup`")
        );
        assert!(error("data.entities.Cube=['a']").contains("lower-case letters, digits and _, found `Cube`"));
        assert!(error("data.entities.cube=[]").contains("at least one key"));
        let colours = "data.picture_colours=['cube0', 'goal', 'cube0']";
        let things = ["data.entities.cube0=['a']", "data.entities.goal=['c[0:3]']"];
        let experiment = load(&[things[0], things[1], colours, "data.cameras=['front']"]).unwrap();
        assert_eq!(Experiment::from_toml("x", &experiment.to_toml()).unwrap(), experiment);
        let blind = load(&[things[0], things[1], colours]).unwrap_err();
        assert_eq!(
            blind,
            "key `data.picture_colours`: expected none without data.cameras, or three of the entities: cube0, goal, \
             found cube0, goal, cube0"
        );
        let one = load(&[things[0], colours, "data.cameras=['front']"]).unwrap_err();
        assert!(one.ends_with("three of the entities: cube0, found cube0, goal, cube0"), "{one}");
        assert!(load(&["data.symmetries.axes=['robot0_eef_pos', 'object']"]).is_ok());
        let message = error("data.symmetries.axes=['robot0_eef_pos', 'cube_rgb']");
        assert!(
            message.contains("key `data.symmetries.axes`") && message.ends_with("gripper_qpos, found `cube_rgb`"),
            "{message}"
        );
        let exchange = |of: &str| format!("data.exchange.things={{ {of} }}");
        let both = "taken = ['robot0_eef_pos', 'robot0_eef_quat']";
        assert!(load(&[&exchange(&format!("{both}, items = [['object'], ['object']]"))]).is_ok());
        let message = error(&exchange(&format!("{both}, items = [['object']]")));
        assert!(message.contains("expected 2 lists, one for each of `taken`, found 1"), "{message}");
        let message = error(&exchange(&format!("{both}, items = [['object'], ['object', 'object']]")));
        assert!(message.contains("expected lists of 1 items, found object, object"), "{message}");
        let message = error(&exchange(&format!("{both}, items = [['object'], ['object']], places = [['object']]")));
        assert!(message.contains("key `data.exchange.things.places`: expected 2 lists"), "{message}");
        assert!(error(&exchange("taken = [], items = []")).contains("`data.exchange.things.taken`: expected at least"));
        assert!(error(&exchange("taken = ['cube_pos'], items = [['object']]")).contains("found `cube_pos`"));
        let never = exchange(&format!("{both}, items = [['object'], ['object']], asked = 0"));
        assert!(error(&never).contains("`data.exchange.things.asked`: expected 1 or more, found 0"));
        let things = ["data.entities.thing0=['cube0']", "data.entities.thing1=['cube1']"];
        let taken = "data.exchange.things={ taken = ['cube0', 'cube1'], items = [['cube0'], ['cube1']] }";
        let pointing = "policy.pointer={ among = 'thing' }";
        let experiment = load(&[things[0], things[1], taken, pointing]).unwrap();
        assert_eq!(Experiment::from_toml("x", &experiment.to_toml()).unwrap(), experiment);
        let refused = load(&[things[0], things[1], pointing]).unwrap_err();
        assert!(refused.starts_with("key `policy.pointer.among`: expected a group of entities of which"), "{refused}");
        assert!(
            load(&[things[0], things[1], taken, "policy.pointer={ among = 'cube' }"]).unwrap_err().ends_with("`cube`")
        );
        let (told, asks) = ("data.auxiliary_keys=['object[0:3] - robot0_eef_pos']", "policy.auxiliary.weight=0.5");
        let experiment = load(&["data.env_keys=[]", told, asks]).unwrap();
        assert_eq!(experiment.policy.auxiliary().unwrap().weight, 0.5);
        assert_eq!(Experiment::from_toml("x", &experiment.to_toml()).unwrap(), experiment);
        assert!(experiment.data.feature_keys().unwrap().keys().all(|key| key != "object"), "nobody sends it");
        assert!(error(told).ends_with("expected none without policy.auxiliary, found object[0:3] - robot0_eef_pos"));
        assert!(error(asks).contains("`data.auxiliary_keys`: expected observation keys, for policy.auxiliary asks"));
        assert!(load(&["data.auxiliary_keys=['a[']", asks]).unwrap_err().contains("`a[`: expected key[from:to]"));
        let alike = "data.symmetries.axes=['robot0_eef_pos', 'object[0:3] - robot0_eef_pos']";
        assert!(load(&[told, asks, alike]).is_ok(), "what is told can be permuted alike");
        let both = load(&[told, asks, &exchange(&format!("{both}, items = [['object'], ['object']]"))]).unwrap_err();
        assert!(both.contains("expected none with data.exchange"), "{both}");
        let pictured = load(&[things[0], things[1], taken, "data.cameras=['front']"]).unwrap_err();
        assert!(pictured.contains("key `data.exchange`: expected none with data.cameras"), "{pictured}");
        let mirror = |of: &str| format!("data.mirror={{ {of} }}");
        let signs = "robot0_eef_pos = [1, -1, 1], robot0_eef_quat = [1, -1, 1, -1], robot0_gripper_qpos = [1, 1]";
        let all = mirror(&format!("{signs}, action = [1, -1], object = [1]"));
        assert_eq!(load(&[&all]).unwrap().data.mirror["action"], [1, -1]);
        assert!(error(&mirror(signs)).ends_with("expected signs of every item and of action, found none of `action`"));
        let other = error(&mirror(&format!("{signs}, cube = [1]")));
        assert!(
            other.starts_with("key `data.mirror`: expected items of the lists of keys: action, object, rob"),
            "{other}"
        );
        let twos = error(&mirror(&format!("{signs}, action = [1, 2], object = [1]")));
        assert!(twos.ends_with("expected 1 or -1 for each number, found [1, 2] of `action`"), "{twos}");
        assert!(load(&["data.beginning={ steps = 8, times = 4 }"]).is_ok());
        assert!(error("data.beginning={ steps = 8, times = 0 }").contains("found steps 8, times 0"));
        assert!(error("data.entities.cube=3").contains("a list of observation keys, or a table"));
    }
}
