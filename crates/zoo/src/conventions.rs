//! How a policy's numbers are meant: control rate, action space, rotations, gripper, images, order of the state.
//!
//! An entry, a simulator, a data set and a server each say some of them. What two sides say has to agree; what one of them
//! does not say is not compared. Two entries that differ in one of these can have the same shapes and no success.

use std::collections::BTreeMap;

use models::FeatureKind;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::entry::{Entry, EntryMeta, LoadedEntry};
use crate::experiment::Experiment;
use crate::external::External;
use crate::results::Execution;
use crate::{FeatureKeys, ZooError};

/// The names that conventions have, in the order of a page, and what each says.
pub const NAMES: [(&str, &str); 13] = [
    ("control_freq", "control steps per second"),
    ("action_space", "what an action commands, and what 1 means"),
    ("action_frame", "frame that the action is expressed in"),
    ("action_range", "smallest and largest value of an action"),
    ("rotation", "form of rotations in the action"),
    ("quaternion", "order of a quaternion's numbers in the state"),
    ("gripper", "which sign of the gripper's action opens"),
    ("image_size", "height x width in pixels"),
    ("image_flip", "which way up images are"),
    ("image_channels", "order and place of the colours"),
    ("state", "the numbers of each feature, in order"),
    ("horizon", "actions that the policy predicts at once"),
    ("executed", "actions that are executed before the next query"),
];

/// What somebody says of the conventions, by name.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "BTreeMap<String, String>")]
pub struct Conventions(BTreeMap<String, String>);

impl TryFrom<BTreeMap<String, String>> for Conventions {
    type Error = String;

    fn try_from(said: BTreeMap<String, String>) -> Result<Self, String> {
        match said.keys().find(|name| !NAMES.iter().any(|(known, _)| known == name)) {
            None => Ok(Self(said)),
            Some(other) => {
                let known: Vec<&str> = NAMES.iter().map(|(known, _)| *known).collect();
                Err(format!("unknown convention `{other}`, expected {}", known.join(", ")))
            }
        }
    }
}

/// A convention on which two sides differ.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Difference {
    /// Its name.
    pub name: String,
    /// What the first side says.
    pub expected: String,
    /// What the second one says.
    pub found: String,
}

/// robosuite's images as our workers draw them.
const UPRIGHT: &str = "upright";
/// Those of LIBERO's files, and of the simulator's cameras that are called as there: `agentview_rgb`.
const UPSIDE_DOWN: &str = "upside down";
const STORED: &str = "_rgb";
/// Begins the names of LIBERO's tasks.
const LIBERO: &str = "libero_";
/// All of them: an array (height, width, 3) of red, green and blue.
const RGB: &str = "RGB, last axis";

impl Conventions {
    /// Whether nothing is said.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// What is said of `name`.
    pub fn get(&self, name: &str) -> Option<&str> {
        self.0.get(name).map(String::as_str)
    }

    /// Says `value` of `name`.
    pub fn set(&mut self, name: &str, value: impl ToString) {
        debug_assert!(NAMES.iter().any(|(known, _)| *known == name));
        self.0.insert(name.to_owned(), value.to_string());
    }

    /// What is said, in the order of a page.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &str)> {
        NAMES.iter().filter_map(|(name, _)| Some((*name, self.get(name)?)))
    }

    /// The same without what is said of `names`.
    #[must_use]
    pub fn without(mut self, names: &[&str]) -> Self {
        names.iter().for_each(|name| drop(self.0.remove(*name)));
        self
    }

    /// What this side says, and what `other` says of the rest.
    #[must_use]
    pub fn or(mut self, other: Self) -> Self {
        for (name, value) in other.0 {
            self.0.entry(name).or_insert(value);
        }
        self
    }

    /// The first convention that both sides name and name differently.
    pub fn difference(&self, other: &Self) -> Option<Difference> {
        let both = self.iter().filter_map(|(name, expected)| Some((name, expected, other.get(name)?)));
        let (name, expected, found) = both.into_iter().find(|(_, expected, found)| expected != found)?;
        Some(Difference { name: name.to_owned(), expected: expected.to_owned(), found: found.to_owned() })
    }

    /// Compares with `other`, that of `whose`.
    ///
    /// # Errors
    /// [`ZooError::UnfitEntry`] of `entry` with the first convention that differs.
    pub fn check(&self, other: &Self, whose: &str, entry: &str, task: &str) -> Result<(), ZooError> {
        let Some(Difference { name, expected, found }) = self.difference(other) else { return Ok(()) };
        Err(ZooError::UnfitEntry {
            entry: entry.to_owned(),
            task: task.to_owned(),
            what: format!("convention {name}"),
            expected,
            found: format!("{found} in {whose}"),
        })
    }

    /// What robomimic's `env_args` of an environment say: those of a simulator, or of demonstrations.
    pub fn of_env_args(env_args: &Value) -> Self {
        /// robomimic's number of robosuite's environments.
        const ROBOSUITE: u64 = 1;
        /// robosuite's rate where the arguments do not say it.
        const USUAL_RATE: f64 = 20.0;
        let mut all = Self::default();
        let Some(kwargs) = env_args.get("env_kwargs").filter(|kwargs| kwargs.is_object()) else { return all };
        if env_args.get("type").and_then(Value::as_u64) != Some(ROBOSUITE) {
            return all;
        }
        all.set("control_freq", kwargs.get("control_freq").and_then(Value::as_f64).unwrap_or(USUAL_RATE));
        all.set("quaternion", "x, y, z, w");
        let sides = [kwargs.get("camera_heights"), kwargs.get("camera_widths")].map(|side| side?.as_u64());
        if let [Some(height), Some(width)] = sides {
            all.set("image_size", format!("{height} x {width}"));
        }
        let arms = arms(kwargs.get("controller_configs").unwrap_or(&Value::Null));
        let says: Vec<Self> = arms.iter().map(|arm| Self::of_arm(arm)).collect();
        // two arms that differ have no common convention
        if let Some((first, others)) = says.split_first() {
            let common = first.0.iter().filter(|(name, value)| others.iter().all(|o| o.0.get(*name) == Some(*value)));
            all.0.extend(common.map(|(name, value)| (name.clone(), value.clone())));
        }
        all
    }

    /// What the configuration of an arm's controller says.
    fn of_arm(arm: &Value) -> Self {
        let mut all = Self::default();
        let Some(kind) = arm.get("type").and_then(Value::as_str) else { return all };
        let pose = kind.ends_with("_POSE");
        let absolute = match (arm.get("input_type"), arm.get("control_delta")) {
            (Some(Value::String(input)), _) => input == "absolute",
            (_, Some(delta)) => delta == &Value::Bool(false),
            _ => false,
        };
        let size = arm.get("output_max").filter(|size| !absolute && !size.is_null());
        let size = size.map_or(String::new(), |size| format!(", 1 is {}", numbers(size)));
        let way = if absolute { "absolute" } else { "delta" };
        all.set("action_space", format!("{way} {kind}{size}"));
        if pose {
            all.set("rotation", "axis-angle");
        }
        if let Some(frame) = arm.get("input_ref_frame").and_then(Value::as_str) {
            all.set("action_frame", frame);
        }
        if let [Some(low), Some(high)] = ["input_min", "input_max"].map(|key| arm.get(key)?.as_f64()) {
            all.set("action_range", format!("{low} to {high}"));
        }
        if arm.get("gripper").is_some_and(|gripper| !gripper.is_null()) {
            all.set("gripper", "-1 opens, 1 closes");
        }
        all
    }

    /// What the environment that a worker greets with says.
    pub fn of_simulator(ready: &rollout::Ready) -> Self {
        let mut all = Self::of_env_args(&ready.env_args);
        all.set("control_freq", ready.control_freq);
        let limit = |all: &[f64], pick: fn(f64, f64) -> f64| all.iter().copied().reduce(pick);
        if let (Some(low), Some(high)) = (limit(&ready.action_low, f64::min), limit(&ready.action_high, f64::max))
            && low.is_finite()
            && high.is_finite()
            && all.get("action_range").is_none()
        {
            all.set("action_range", format!("{low} to {high}"));
        }
        // our workers turn and order what any simulator draws, unless its cameras are named as those of LIBERO's files
        let opengl = ready.env_args.get("image_convention").is_some_and(|convention| convention == "opengl");
        all.set("image_flip", if opengl { UPSIDE_DOWN } else { UPRIGHT });
        all.set("image_channels", RGB);
        all
    }

    /// What an entry's metadata say, without its experiment.
    fn of_meta(meta: &EntryMeta) -> Self {
        let mut all = meta.env_args.as_ref().map(Self::of_env_args).unwrap_or_default();
        let known = !all.is_empty();
        all = all.without(&["image_size"]);
        if let Some(image) = meta.signature.of_kind(FeatureKind::Image).next() {
            if let [height, width, _] = image.shape.as_slice() {
                all.set("image_size", format!("{height} x {width}"));
            }
            if known && meta.data.is_some() {
                let as_stored = meta.task.starts_with(LIBERO) && image.name.ends_with(STORED);
                all.set("image_flip", if as_stored { UPSIDE_DOWN } else { UPRIGHT });
                all.set("image_channels", RGB);
            }
        }
        all.set_state(&meta.keys);
        all
    }

    /// Says the order of the features' numbers.
    pub fn set_state(&mut self, keys: &FeatureKeys) {
        let images = |feature: &&str| !feature.starts_with(crate::experiment::IMAGE_PREFIX);
        let features: Vec<String> = keys
            .features()
            .filter(images)
            .map(|feature| format!("{feature}: {}", keys.of(feature).join(", ")))
            .collect();
        if !features.is_empty() {
            self.set("state", features.join("; "));
        }
    }

    /// Says how predictions become actions.
    pub fn set_execution(&mut self, execution: Execution) {
        match execution {
            Execution::RecedingHorizon { n_action_steps } => self.set("executed", n_action_steps),
            Execution::TemporalEnsemble { coefficient } => {
                self.set("executed", format!("1, temporal ensemble {coefficient}"));
            }
        }
    }

    fn set_policy(&mut self, experiment: &Experiment, meta: &EntryMeta) {
        let past = experiment.policy.past_actions(meta.signature.n_obs_steps);
        self.set("horizon", experiment.policy.action_horizon().saturating_sub(past));
        self.set_execution(match experiment.rollout.temporal_ensemble {
            Some(coefficient) => Execution::TemporalEnsemble { coefficient },
            None => Execution::RecedingHorizon { n_action_steps: experiment.rollout.n_action_steps },
        });
    }
}

/// The controller of each robot's (right) arm in robosuite's configuration, in its forms of 1.4 and 1.5.
fn arms(configs: &Value) -> Vec<&Value> {
    if let Some(each) = configs.as_array() {
        return each.iter().flat_map(arms).collect();
    }
    let Some(parts) = configs.get("body_parts") else {
        // the form of 1.4: the configuration of the arms alone
        return configs.get("type").map(|_| configs).into_iter().collect();
    };
    // recordings list a left arm of robots that have none
    let parts = [Some(parts), parts.get("arms")].into_iter().flatten();
    parts.filter_map(|parts| parts.get("right").or_else(|| parts.get("left"))).collect()
}

/// Numbers of a list, or one.
fn numbers(value: &Value) -> String {
    match value {
        Value::Array(all) => all.iter().map(Value::to_string).collect::<Vec<_>>().join(" "),
        other => other.to_string(),
    }
}

impl LoadedEntry {
    /// The conventions that the entry's policy was trained by.
    pub fn conventions(&self) -> Conventions {
        let meta = self.entry().meta();
        let mut all = Conventions::of_meta(meta);
        all.set_policy(self.experiment(), meta);
        all
    }
}

impl Entry {
    /// The conventions of its policy, as far as they are known.
    ///
    /// # Errors
    /// A config that cannot be read.
    pub fn conventions(&self) -> Result<Conventions, ZooError> {
        if let Some(external) = External::of(self)? {
            return Ok(external.said());
        }
        let mut all = Conventions::of_meta(self.meta());
        if let Some(experiment) = self.policy_experiment()? {
            all.set_policy(&experiment, self.meta());
        }
        Ok(all)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use serde_json::json;

    fn env_args() -> Value {
        json!({
            "type": 1, "env_name": "Lift", "env_kwargs": {
                "camera_heights": 84, "camera_widths": 84,
                "controller_configs": {"type": "BASIC", "body_parts": {"right": {
                    "type": "OSC_POSE", "input_type": "delta", "input_ref_frame": "base", "input_min": -1, "input_max": 1,
                    "output_max": [0.05, 0.5], "gripper": {"type": "GRIP"}
                }}}
            }
        })
    }

    /// What an entry, a simulator and a server can say, every name of it.
    fn whole() -> Conventions {
        let mut all = Conventions::of_env_args(&env_args());
        all.set("image_flip", UPRIGHT);
        all.set("image_channels", RGB);
        all.set("state", "observation.state: robot0_eef_pos, robot0_eef_quat");
        all.set("horizon", 16);
        all.set_execution(Execution::RecedingHorizon { n_action_steps: 8 });
        all
    }

    #[test]
    fn every_flip_is_refused_by_name() {
        let (usual, mut flipped) = (whole(), 0);
        assert_eq!(usual.iter().count(), NAMES.len());
        for (name, other) in [
            ("control_freq", "10"),
            ("action_space", "absolute OSC_POSE"),
            ("action_frame", "world"),
            ("action_range", "0 to 1"),
            ("rotation", "6D"),
            ("quaternion", "w, x, y, z"),
            ("gripper", "1 opens, -1 closes"),
            ("image_size", "224 x 224"),
            ("image_flip", "upside down"),
            ("image_channels", "BGR, last axis"),
            ("state", "observation.state: robot0_eef_quat, robot0_eef_pos"),
            ("horizon", "100"),
            ("executed", "1"),
        ] {
            let mut flip = usual.clone();
            flip.set(name, other);
            let error = usual.check(&flip, "the simulator", "a@1", "Lift").unwrap_err().to_string();
            let words = format!("entry a@1 in task Lift: convention {name}: expected {}", usual.get(name).unwrap());
            assert!(error.starts_with(&words), "{error}");
            assert!(error.ends_with(&format!("found {other} in the simulator")), "{error}");
            usual.check(&flip.without(&[name]), "the simulator", "a@1", "Lift").unwrap();
            flipped += 1;
        }
        assert_eq!(flipped, NAMES.len());
    }

    #[test]
    fn the_arguments_of_an_environment_say_them() {
        let usual = Conventions::of_env_args(&env_args());
        let expected = [
            ("control_freq", "20"),
            ("action_space", "delta OSC_POSE, 1 is 0.05 0.5"),
            ("action_frame", "base"),
            ("action_range", "-1 to 1"),
            ("rotation", "axis-angle"),
            ("quaternion", "x, y, z, w"),
            ("gripper", "-1 opens, 1 closes"),
            ("image_size", "84 x 84"),
        ];
        assert_eq!(usual.iter().collect::<Vec<_>>(), expected);
        let changed = |pointer: &str, value: Value| {
            let mut args = env_args();
            *args.pointer_mut(pointer).unwrap() = value;
            usual.difference(&Conventions::of_env_args(&args)).map(|difference| difference.name)
        };
        let arm = "/env_kwargs/controller_configs/body_parts/right";
        for (key, value, name) in [
            ("input_type", json!("absolute"), "action_space"),
            ("type", json!("JOINT_POSITION"), "action_space"),
            ("output_max", json!([0.1, 0.5]), "action_space"),
            ("input_ref_frame", json!("world"), "action_frame"),
            ("input_min", json!(-2), "action_range"),
        ] {
            assert_eq!(changed(&format!("{arm}/{key}"), value).as_deref(), Some(name));
        }
        // of another kind of environment nothing is known, and what robosuite 1.4 wrote is read
        assert_eq!(changed("/type", json!(2)), None);
        let old = json!({"type": 1, "env_kwargs": {"control_freq": 10, "controller_configs":
            {"type": "OSC_POSE", "control_delta": false, "input_max": 1, "input_min": -1}}});
        let old = Conventions::of_env_args(&old);
        assert_eq!((old.get("control_freq"), old.get("action_space")), (Some("10"), Some("absolute OSC_POSE")));
        let two = json!({"type": 1, "env_kwargs": {"controller_configs": [
            {"type": "OSC_POSE", "control_delta": false}, {"type": "JOINT_POSITION"}]}});
        let two = Conventions::of_env_args(&two);
        assert_eq!((two.get("action_space"), two.get("quaternion")), (None, Some("x, y, z, w")));
    }

    #[test]
    fn unknown_names_are_refused() {
        let said = BTreeMap::from([("griper".to_owned(), "x".to_owned())]);
        let error = Conventions::try_from(said).unwrap_err();
        assert!(error.contains("griper") && error.contains("gripper"), "{error}");
    }
}
