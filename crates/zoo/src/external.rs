//! Policies of others: a Python object, a server. Their weights are not in the zoo, so their owner runs them.
//!
//! Such a policy has an entry too: its name, where it comes from, what it reads and how its predictions become actions, but
//! no weights. Its results are sealed and ranked as those of any entry. The same name with other settings is a new version.

use std::collections::BTreeMap;
use std::path::Path;

use models::{FeatureKind, FeatureSpec, ModelError, Policy, Signature};
use rollout::Ready;
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::config::{Library, from_value};
use crate::conventions::Conventions;
use crate::entry::{CamerasMeta, CardWords, Entry, EntryDraft, EntryId, EntryMeta, training_facts};
use crate::evaluation::Subject;
use crate::experiment::{DataSection, Experiment, IMAGE_PREFIX, IMAGE_SUFFIX};
use crate::registry::Registry;
use crate::results::{EntryIdentity, Execution};
use crate::{FeatureKeys, ZooError, tensors};

/// The kind of policy that such entries name.
pub const EXTERNAL: &str = "external";

/// A policy whose weights are not in the zoo: `config.toml` of its entry.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct External {
    /// Where it comes from: `python package.module.Class`, or the address of a server.
    pub source: String,
    /// What its owner declares of its weights, such as a hash; another one is another version of the entry.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub declared: Option<String>,
    /// How the observations of a server are made of the features: a preset's name, or the text of the file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mapping: Option<String>,
    /// Side of the images that it reads, in pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub image_size: Option<usize>,
    /// How its predictions become actions.
    pub execution: Execution,
    /// Observation keys of its features, in order. An image is `observation.images.<camera> = ["<camera>_image"]`.
    pub inputs: FeatureKeys,
    /// What its owner, or its server, says of its conventions.
    #[serde(default, skip_serializing_if = "Conventions::is_empty")]
    pub conventions: Conventions,
}

/// The file's own form.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    /// SHA-256 of the text of the policy's class, where that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    code: Option<String>,
    external: External,
}

/// What an external policy is ranked as.
#[derive(Debug, Clone, PartialEq)]
pub struct Named {
    /// Name of its entry.
    pub name: String,
    /// One sentence on what it is; may be empty.
    pub description: String,
}

/// Whether some of these features are images.
pub fn reads_images(inputs: &FeatureKeys) -> bool {
    inputs.features().any(|feature| feature.starts_with(IMAGE_PREFIX))
}

/// The features that experiments on the task of `ready` read by default, as far as the environment has their keys.
///
/// # Errors
/// Keys that cannot be read.
pub fn usual_inputs(ready: &Ready) -> Result<FeatureKeys, ZooError> {
    let experiment = Experiment::load(&Library::built_in(), &format!("act_{}", ready.task.to_lowercase()), &[]);
    let of_task = experiment.ok().filter(|experiment| experiment.task.name == ready.task);
    let mut data = of_task.map_or_else(DataSection::default, |experiment| experiment.data);
    // a second robot shows what the first one does
    let first = data.state_keys.clone();
    let second = first.iter().map(|key| key.replace("robot0_", "robot1_"));
    let new = second.filter(|key| !first.contains(key) && ready.observations.contains_key(key));
    data.state_keys.extend(new);
    let features = [(models::STATE, data.state_keys), (models::ENVIRONMENT_STATE, data.env_keys)];
    let mut keys = FeatureKeys::default();
    for (feature, of) in features {
        keys.insert(feature, &of).map_err(|found| ZooError::InvalidValue {
            key: feature.to_owned(),
            expected: "observation keys".to_owned(),
            found,
        })?;
        if of.is_empty() || keys.width(feature, ready).is_err() {
            keys.retain(|other| other != feature);
        }
    }
    Ok(keys)
}

impl External {
    /// The cameras that it looks through; `None` if it reads no images.
    pub fn cameras(&self) -> Option<CamerasMeta> {
        let cameras = self.inputs.features().filter(|feature| feature.starts_with(IMAGE_PREFIX));
        let name = |feature: &str| {
            let key = self.inputs.of(feature).concat();
            key.strip_suffix(IMAGE_SUFFIX).unwrap_or(&key).to_owned()
        };
        let names: Vec<String> = cameras.map(name).collect();
        let size = self.image_size.unwrap_or(0);
        (!names.is_empty()).then_some(CamerasMeta { names, size, fast_render: false })
    }

    /// Its conventions: what is said of them, and what follows from how it is asked.
    pub fn said(&self) -> Conventions {
        self.conventions.clone().or(self.asked())
    }

    /// Compares what is said of its conventions with how it is asked, and with the simulator.
    fn check_said(&self, named: &Named, ready: &Ready) -> Result<(), ZooError> {
        let mut asked = self.asked();
        if let (Some(horizon), Execution::RecedingHorizon { n_action_steps }) =
            (self.conventions.get("horizon").and_then(|text| text.parse::<usize>().ok()), self.execution)
            && n_action_steps > horizon
        {
            asked.set("horizon", format!("at least {n_action_steps} for n_action_steps"));
        }
        self.conventions.check(&asked, "this evaluation", &named.name, &ready.task)?;
        let simulator = Conventions::of_simulator(ready).without(&["image_size"]);
        self.said().check(&simulator, &ready.simulator, &named.name, &ready.task)
    }

    /// What follows from how it is asked.
    fn asked(&self) -> Conventions {
        let mut known = Conventions::default();
        known.set_state(&self.inputs);
        known.set_execution(self.execution);
        if let Some(side) = self.image_size {
            known.set("image_size", format!("{side} x {side}"));
        }
        known
    }

    /// The features of its inputs in the environment that `ready` describes.
    fn signature(&self, ready: &Ready) -> Result<Signature, ZooError> {
        let spec = |feature: &str| -> Result<FeatureSpec, ZooError> {
            if feature.starts_with(IMAGE_PREFIX) {
                let side = self.image_size.unwrap_or(0);
                return Ok(FeatureSpec::image(feature, side, side));
            }
            let width = self.inputs.width(feature, ready).map_err(|found| ZooError::InvalidValue {
                key: format!("inputs: {feature}"),
                expected: format!(
                    "observation keys of task {}: {}",
                    ready.task,
                    ready.observations.keys().cloned().collect::<Vec<_>>().join(", ")
                ),
                found,
            })?;
            Ok(match feature {
                models::STATE => FeatureSpec::state(width),
                models::ENVIRONMENT_STATE => FeatureSpec::environment_state(width),
                _ => FeatureSpec { name: feature.to_owned(), kind: FeatureKind::Entity, ..FeatureSpec::state(width) },
            })
        };
        let observation = self.inputs.features().map(spec).collect::<Result<_, _>>()?;
        Ok(Signature { observation, action_dim: ready.action_dim, ..Signature::default() })
    }

    /// Its entry in `zoo`: the newest version under its name that says the same, else a new one.
    ///
    /// # Errors
    /// A name that is an entry with weights; conventions that do not hold here; keys that the environment does not have;
    /// files that cannot be written.
    pub fn entry(&self, zoo: &Path, named: &Named, ready: &Ready) -> Result<Entry, ZooError> {
        self.entry_of_code(zoo, named, ready, None)
    }

    /// As [`External::entry`], for a policy whose class has a text of this SHA-256: another text is another version.
    ///
    /// # Errors
    /// As [`External::entry`].
    pub fn entry_of_code(
        &self,
        zoo: &Path,
        named: &Named,
        ready: &Ready,
        code: Option<&str>,
    ) -> Result<Entry, ZooError> {
        self.check_said(named, ready)?;
        let (signature, config) = (self.signature(ready)?, self.to_toml(code));
        let registry = Registry::open(zoo);
        for id in registry.ids()?.into_iter().rev().filter(|id| id.name == named.name) {
            let entry = registry.entry(&id.to_string())?;
            let meta = entry.meta();
            if !meta.is_external() {
                return Err(ZooError::InvalidValue {
                    key: "name".to_owned(),
                    expected: "a name that no entry with weights has".to_owned(),
                    found: id.to_string(),
                });
            }
            if entry.config_text()? == config && meta.signature == signature && meta.task == ready.task {
                return Ok(entry);
            }
        }
        let empty = |name: &str| tensors::to_bytes(Path::new(name), &BTreeMap::new(), &json!({"format": 1}));
        let draft = EntryDraft {
            meta: EntryMeta {
                format: 0,
                name: named.name.clone(),
                version: 0,
                description: named.description.clone(),
                experiment: self.source.clone(),
                policy: EXTERNAL.to_owned(),
                task: ready.task.clone(),
                env_name: Some(ready.env_name.clone()),
                env_version: None,
                env_module: None,
                env_args: None,
                parameters: 0,
                signature,
                keys: self.inputs.clone(),
                data: None,
                kind: None,
                section: None,
                training: None,
                parent: None,
                license: None,
                versions: crate::versions(),
                files: BTreeMap::new(),
            },
            model: empty(crate::entry::MODEL_FILE)?,
            config,
            normaliser: empty(crate::entry::NORMALISER_FILE)?,
            card: CardWords {
                rows: vec![("weights".to_owned(), "not in this zoo; the owner runs the policy".to_owned())],
                usage: match self.source.starts_with("ws://") {
                    true => "rank it again with `actrm-zoo eval --policy ws://... --name ... --task ...`".to_owned(),
                    false => "rank it again with `actrm.evaluate(policy, name=..., task=...)` in Python".to_owned(),
                },
                ..CardWords::default()
            },
            metrics: None,
            command: None,
            reference: None,
        };
        let id: EntryId = draft.seal(zoo)?;
        Entry::open(zoo, &id)
    }

    /// What the entry says of its policy; `None` for an entry with weights.
    ///
    /// # Errors
    /// A file that says something else.
    pub fn of(entry: &Entry) -> Result<Option<Self>, ZooError> {
        if !entry.meta().is_external() {
            return Ok(None);
        }
        let name = entry.id().to_string();
        let table: toml::Table = toml::from_str(&entry.config_text()?)
            .map_err(|source| ZooError::ExperimentSyntax { experiment: name.clone(), source: Box::new(source) })?;
        let file: File = from_value(&toml::Value::Table(table), &[&name])?;
        Ok(Some(file.external))
    }

    fn to_toml(&self, code: Option<&str>) -> String {
        toml::to_string(&File { code: code.map(str::to_owned), external: self.clone() })
            .expect("texts, numbers and lists become TOML")
    }

    /// The policy of `entry` as an evaluation takes it; `policy` makes one for each simulator.
    pub fn subject<'a>(
        &self,
        entry: &Entry,
        policy: impl Fn() -> Result<Box<dyn Policy>, ModelError> + Sync + 'a,
    ) -> Subject<'a> {
        let meta = entry.meta();
        Subject {
            entry: EntryIdentity { name: meta.name.clone(), version: meta.version, hash: meta.content_sha256() },
            training: training_facts(meta),
            task: meta.task.clone(),
            demonstrations: None,
            env_version: None,
            keys: meta.keys.clone(),
            execution: self.execution,
            max_steps: None,
            signature: meta.signature.clone(),
            time_decides: false,
            is_scripted: false,
            conventions: self.said(),
            fast_render: self.cameras().map(|cameras| cameras.fast_render),
            gpu: None,
            perturbation: None,
            policy: Box::new(policy),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::entry::testing::draft as test_draft;

    /// A greeting with these observations and actions of 7 numbers.
    fn ready(observations: serde_json::Value) -> Ready {
        serde_json::from_value(json!({
            "protocol": 2, "simulator": "robosuite", "versions": {}, "task": "Lift", "env_name": "Lift",
            "control": "compiled", "control_freq": 20.0, "max_steps": 400, "action_dim": 7,
            "action_low": vec![-1.0; 7], "action_high": vec![1.0; 7], "observations": observations,
        }))
        .unwrap()
    }

    fn external() -> External {
        let mut inputs = FeatureKeys::default();
        inputs.insert(models::STATE, &["robot0_eef_pos".to_owned()]).unwrap();
        External {
            source: "python mine.Policy".to_owned(),
            declared: None,
            mapping: None,
            image_size: None,
            execution: Execution::RecedingHorizon { n_action_steps: 1 },
            inputs,
            conventions: Conventions::default(),
        }
    }

    #[test]
    fn both_robots_are_seen() {
        let pose = |robot: u8| [format!("robot{robot}_eef_pos"), format!("robot{robot}_eef_quat")];
        let mut keys = json!({"object": [10]});
        for (robot, [position, rotation]) in [(0, pose(0)), (1, pose(1))] {
            (keys[position], keys[rotation]) = (json!([3]), json!([4]));
            keys[format!("robot{robot}_gripper_qpos")] = json!([2]);
        }
        let two = Ready { task: "TwoArmUnknown".to_owned(), ..ready(keys.clone()) };
        let seen = usual_inputs(&two).unwrap().of(models::STATE);
        assert_eq!(seen.len(), 6);
        assert_eq!(seen[3..], ["robot1_eef_pos", "robot1_eef_quat", "robot1_gripper_qpos"]);
        keys.as_object_mut().unwrap().retain(|key, _| !key.starts_with("robot1"));
        assert_eq!(usual_inputs(&ready(keys)).unwrap().of(models::STATE).len(), 3);
    }

    #[test]
    fn the_same_policy_is_the_same_entry_and_another_is_another_version() {
        let zoo = tempfile::tempdir().unwrap();
        let named = Named { name: "mine".to_owned(), description: String::new() };
        let ready = ready(json!({"robot0_eef_pos": [3], "object": [10]}));
        let one = external().entry(zoo.path(), &named, &ready).unwrap();
        assert_eq!(external().entry(zoo.path(), &named, &ready).unwrap().id(), one.id());
        assert_eq!(External::of(&one).unwrap().unwrap(), external());
        assert_eq!(one.meta().signature, Signature::low_dimensional(3, 0, 7));
        assert!(one.card().unwrap().contains("not in this zoo"));
        let declared = External { declared: Some("abc".to_owned()), ..external() };
        let two = declared.entry(zoo.path(), &named, &ready).unwrap();
        assert_eq!(two.id().to_string(), "mine@2");
        assert_ne!(one.meta().content_sha256(), two.meta().content_sha256());
        // so is another text of its class; who comes back finds the version of before
        for (code, version) in [(Some("abc"), 3), (Some("abd"), 4), (Some("abc"), 3), (None, 1)] {
            let entry = external().entry_of_code(zoo.path(), &named, &ready, code).unwrap();
            assert_eq!((entry.id().version, External::of(&entry).unwrap().unwrap()), (version, external()));
        }

        let error = one.load().err().unwrap().to_string();
        assert!(error.contains("mine@1") && error.contains("not in this zoo"), "{error}");
    }

    #[test]
    fn conventions_that_do_not_hold_here_are_refused_by_name() {
        let zoo = tempfile::tempdir().unwrap();
        let named = Named { name: "mine".to_owned(), description: String::new() };
        let ready = ready(json!({"robot0_eef_pos": [3]}));
        let mut usual = external();
        usual.conventions.set("quaternion", "x, y, z, w");
        usual.conventions.set("horizon", 16);
        let entry = usual.entry(zoo.path(), &named, &ready).unwrap();
        assert_eq!(External::of(&entry).unwrap().unwrap(), usual);
        assert_eq!(entry.conventions().unwrap().get("executed"), Some("1"));
        for (name, value) in [
            ("executed", "8"),
            ("state", "observation.state: robot0_eef_quat"),
            ("image_size", "224 x 224"),
            ("horizon", "0"),
        ] {
            let mut other = External { image_size: Some(84), ..usual.clone() };
            other.conventions.set(name, value);
            let error = other.entry(zoo.path(), &named, &ready).unwrap_err().to_string();
            assert!(error.contains(&format!("convention {name}: expected {value}, found")), "{error}");
        }
        // and what the simulator says otherwise, before there is an entry
        let mut other = usual;
        other.conventions.set("control_freq", 10);
        let error = other.entry(zoo.path(), &named, &ready).unwrap_err().to_string();
        assert_eq!(error, "entry mine in task Lift: convention control_freq: expected 10, found 20 in robosuite");
        assert_eq!(Registry::open(zoo.path()).ids().unwrap().len(), 1);
    }

    #[test]
    fn a_name_with_weights_and_unknown_keys_are_refused() {
        let zoo = tempfile::tempdir().unwrap();
        let named = Named { name: "lift-act".to_owned(), description: String::new() };
        let id = test_draft("lift-act").seal(zoo.path()).unwrap();
        assert!(External::of(&Entry::open(zoo.path(), &id).unwrap()).unwrap().is_none());
        let ready = ready(json!({"robot0_eef_pos": [3]}));
        let error = external().entry(zoo.path(), &named, &ready).unwrap_err().to_string();
        assert!(error.contains("lift-act@1"), "{error}");
        let mut other = external();
        other.inputs.insert(models::STATE, &["robot0_eef_pso".to_owned()]).unwrap();
        let named = Named { name: "mine".to_owned(), ..named };
        let error = other.entry(zoo.path(), &named, &ready).unwrap_err().to_string();
        assert!(error.contains("robot0_eef_pso") && error.contains("robot0_eef_pos"), "{error}");
    }
}
