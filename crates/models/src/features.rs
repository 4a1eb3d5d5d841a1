//! What a policy sees, by name: specifications of features, and values that go with them.
//!
//! A [`Signature`] says what a model is fed and what it gives; [`Features`] holds one thing for each feature, in the
//! signature's order. Names are LeRobot's (`observation.state`, `observation.environment_state`,
//! `observation.images.<camera>`); entities, which LeRobot does not have, are `observation.entity.<name>`.

use crate::normaliser::{ENVIRONMENT_STATE, STATE};
use nn::{ModelError, Result, some_names};
use serde::{Deserialize, Serialize};
use std::fmt;

/// How a feature may be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FeatureKind {
    /// the robot's own state, one vector
    State,
    /// the rest of the world as one vector
    EnvironmentState,
    /// one thing of the world as a vector; things of one group are read alike
    Entity,
    /// an image, 8-bit, height x width x channels
    Image,
}

impl FeatureKind {
    /// The word that names it in files and messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::State => "state",
            Self::EnvironmentState => "environment_state",
            Self::Entity => "entity",
            Self::Image => "image",
        }
    }
}

impl fmt::Display for FeatureKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// One feature of an observation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FeatureSpec {
    /// its name, for example `observation.state`
    pub name: String,
    /// how it may be read
    pub kind: FeatureKind,
    /// extent of one step's value
    pub shape: Vec<usize>,
    /// of an entity: what shares its projection and its statistics; absent if nothing does
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub group: Option<String>,
    /// of an entity: whether it gets a learned position of its own, which tells it from the others of its group
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub position: bool,
    /// of an image: three features, each a colour, that take the place of red, green and blue: a channel shows how much of
    /// its colour a pixel has. Empty for an image as it is.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub colours: Vec<String>,
}

/// What the name of an entity begins with.
pub const ENTITY_PREFIX: &str = "observation.entity.";

impl FeatureSpec {
    /// `observation.state` of `width` numbers.
    pub fn state(width: usize) -> Self {
        Self::plain(STATE, FeatureKind::State, vec![width])
    }

    /// `observation.environment_state` of `width` numbers.
    pub fn environment_state(width: usize) -> Self {
        Self::plain(ENVIRONMENT_STATE, FeatureKind::EnvironmentState, vec![width])
    }

    /// `observation.entity.<name>` of `width` numbers, in `group`.
    pub fn entity(name: &str, width: usize, group: &str, position: bool) -> Self {
        let plain = Self::plain(&format!("{ENTITY_PREFIX}{name}"), FeatureKind::Entity, vec![width]);
        Self { group: Some(group.to_string()), position, ..plain }
    }

    /// An image of `height` by `width` pixels of three colours, under its whole name.
    pub fn image(name: &str, height: usize, width: usize) -> Self {
        Self::plain(name, FeatureKind::Image, vec![height, width, 3])
    }

    /// The same image in the colours that these features are.
    #[must_use]
    pub fn in_colours(self, colours: Vec<String>) -> Self {
        Self { colours, ..self }
    }

    /// A feature of which nothing more is said.
    fn plain(name: &str, kind: FeatureKind, shape: Vec<usize>) -> Self {
        Self { name: name.to_string(), kind, shape, group: None, position: false, colours: Vec::new() }
    }

    /// Number of values of one step.
    pub fn width(&self) -> usize {
        self.shape.iter().product()
    }

    /// Name without what all names of its kind begin with.
    pub fn short_name(&self) -> &str {
        self.name.strip_prefix(ENTITY_PREFIX).unwrap_or(&self.name)
    }

    /// Name of the group: its own unless it shares one.
    pub fn group(&self) -> &str {
        self.group.as_deref().unwrap_or_else(|| self.short_name())
    }
}

/// What a model is fed and what it gives.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Signature {
    /// the features of an observation, in the order in which they are read
    pub observation: Vec<FeatureSpec>,
    /// observations that are seen at once: the present one and those before it
    pub n_obs_steps: usize,
    /// numbers in an action
    pub action_dim: usize,
    /// numbers that are asked for in training alone
    #[serde(default, skip_serializing_if = "is_zero")]
    pub auxiliary_dim: usize,
}

fn is_zero(count: &usize) -> bool {
    *count == 0
}

impl Default for Signature {
    /// Sees nothing, does nothing.
    fn default() -> Self {
        Self { observation: Vec::new(), n_obs_steps: 1, action_dim: 0, auxiliary_dim: 0 }
    }
}

impl Signature {
    /// Of one observation at a time: a state, and an environment state unless `environment_state` is 0.
    pub fn low_dimensional(state: usize, environment_state: usize, action_dim: usize) -> Self {
        let mut observation = vec![FeatureSpec::state(state)];
        if environment_state > 0 {
            observation.push(FeatureSpec::environment_state(environment_state));
        }
        Self { observation, n_obs_steps: 1, action_dim, auxiliary_dim: 0 }
    }

    /// The feature of this name.
    pub fn get(&self, name: &str) -> Option<&FeatureSpec> {
        self.observation.iter().find(|spec| spec.name == name)
    }

    /// The features of a kind, in order.
    pub fn of_kind(&self, kind: FeatureKind) -> impl Iterator<Item = &FeatureSpec> {
        self.observation.iter().filter(move |spec| spec.kind == kind)
    }

    /// Extent of a feature's value in a batch of `rows`: (rows, shape…), with the observation steps before the shape if
    /// there is more than one.
    pub fn batch_shape(&self, spec: &FeatureSpec, rows: usize) -> Vec<usize> {
        let steps = (self.n_obs_steps > 1).then_some(self.n_obs_steps);
        std::iter::once(rows).chain(steps).chain(spec.shape.iter().copied()).collect()
    }

    /// Checks that a model which reads `reads` can be built for it.
    ///
    /// # Errors
    /// The first feature that cannot be read, or that does not go with another, by name.
    pub fn check(&self, model: &'static str, reads: &[FeatureKind]) -> Result<()> {
        let refuse = |field: &'static str, found: String, expected: String| {
            Err(ModelError::Config { model, field, found, expected })
        };
        for (field, value) in [("n_obs_steps", self.n_obs_steps), ("action_dim", self.action_dim)] {
            if value == 0 {
                return refuse(field, "0".to_string(), "at least 1".to_string());
            }
        }
        for (i, spec) in self.observation.iter().enumerate() {
            if !reads.contains(&spec.kind) {
                let kinds: Vec<&str> = reads.iter().map(|kind| kind.name()).collect();
                return Err(ModelError::UnreadableFeature {
                    model,
                    feature: spec.name.clone(),
                    kind: spec.kind.name(),
                    reads: kinds.join(", "),
                });
            }
            if spec.width() == 0 {
                return refuse("observation", format!("{} of shape {:?}", spec.name, spec.shape), "values".to_string());
            }
            let before = &self.observation[..i];
            if before.iter().any(|other| other.name == spec.name) {
                return refuse("observation", format!("{} twice", spec.name), "every name once".to_string());
            }
            let single = matches!(spec.kind, FeatureKind::State | FeatureKind::EnvironmentState);
            if let Some(other) = before.iter().find(|other| single && other.kind == spec.kind) {
                let expected = format!("one feature of kind {}", spec.kind);
                return refuse("observation", format!("{} and {}", other.name, spec.name), expected);
            }
            let alike = |other: &&FeatureSpec| other.kind == spec.kind && other.group() == spec.group();
            if let Some(other) = before.iter().find(alike)
                && other.shape != spec.shape
            {
                let found = format!("{} of shape {:?} in group {}", spec.name, spec.shape, spec.group());
                return refuse("observation", found, format!("{:?}, as {}", other.shape, other.name));
            }
            if let Some(fault) = self.fault_of_colours(spec) {
                return refuse("colours", fault, "three features of 3 numbers each, of an image".to_string());
            }
        }
        Ok(())
    }

    /// What is wrong with a feature's colours, if anything is.
    fn fault_of_colours(&self, spec: &FeatureSpec) -> Option<String> {
        if spec.colours.is_empty() {
            return None;
        }
        if spec.kind != FeatureKind::Image || spec.colours.len() != 3 {
            return Some(format!("{} of {} of kind {}", spec.colours.join(", "), spec.name, spec.kind));
        }
        spec.colours.iter().find_map(|name| match self.get(name) {
            None => Some(format!("{name}, which is not there, of {}", spec.name)),
            Some(colour) if colour.kind == FeatureKind::Image || colour.width() != 3 => {
                Some(format!("{name} of kind {} and shape {:?}, of {}", colour.kind, colour.shape, spec.name))
            }
            Some(_) => None,
        })
    }
}

/// One thing for each of some named features, in order.
#[derive(Debug, Clone, PartialEq)]
pub struct Features<T>(Vec<(String, T)>);

impl<T> Default for Features<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T> Features<T> {
    /// Nothing yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// A state, and an environment state where there is one.
    pub fn low_dimensional(state: T, environment_state: Option<T>) -> Self {
        let mut features = Self(vec![(STATE.to_string(), state)]);
        if let Some(value) = environment_state {
            features.insert(ENVIRONMENT_STATE, value);
        }
        features
    }

    /// Puts `value` under `name`: at the end, or in the place of what was there.
    pub fn insert(&mut self, name: &str, value: T) {
        match self.get_mut(name) {
            Some(old) => *old = value,
            None => self.0.push((name.to_string(), value)),
        }
    }

    /// What is under `name`.
    pub fn get(&self, name: &str) -> Option<&T> {
        self.0.iter().find(|(n, _)| n == name).map(|(_, value)| value)
    }

    /// The same, to change it.
    pub fn get_mut(&mut self, name: &str) -> Option<&mut T> {
        self.0.iter_mut().find(|(n, _)| n == name).map(|(_, value)| value)
    }

    /// What is under `name`.
    ///
    /// # Errors
    /// `MissingFeature` with the names that are there.
    pub fn require(&self, operation: &'static str, name: &str) -> Result<&T> {
        self.get(name).ok_or_else(|| missing(operation, name, self.names()))
    }

    /// Takes out what is under `name`.
    ///
    /// # Errors
    /// `MissingFeature` with the names that are there.
    pub fn take(&mut self, operation: &'static str, name: &str) -> Result<T> {
        match self.0.iter().position(|(n, _)| n == name) {
            Some(at) => Ok(self.0.remove(at).1),
            None => Err(missing(operation, name, self.names())),
        }
    }

    /// Number of features.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Names in order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.0.iter().map(|(name, _)| name.as_str())
    }

    /// Names and values in order.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &T)> {
        self.0.iter().map(|(name, value)| (name.as_str(), value))
    }

    /// The same names with other values.
    pub fn map<'s, U>(&'s self, mut f: impl FnMut(&'s str, &'s T) -> U) -> Features<U> {
        Features(self.0.iter().map(|(name, value)| (name.clone(), f(name, value))).collect())
    }

    /// The same names with other values, or the first error.
    ///
    /// # Errors
    /// What `f` gives.
    pub fn try_map<U, E>(
        &self,
        mut f: impl FnMut(&str, &T) -> std::result::Result<U, E>,
    ) -> std::result::Result<Features<U>, E> {
        let pairs = self.0.iter().map(|(name, value)| Ok((name.clone(), f(name, value)?)));
        Ok(Features(pairs.collect::<std::result::Result<_, E>>()?))
    }
}

fn missing<'a>(operation: &'static str, name: &str, given: impl Iterator<Item = &'a str>) -> ModelError {
    let given: Vec<String> = given.map(str::to_string).collect();
    ModelError::MissingFeature { operation, name: name.to_string(), given: some_names(&given) }
}

impl<T> FromIterator<(String, T)> for Features<T> {
    fn from_iter<I: IntoIterator<Item = (String, T)>>(pairs: I) -> Self {
        let mut features = Self::new();
        for (name, value) in pairs {
            features.insert(&name, value);
        }
        features
    }
}

/// Raw values of a feature: numbers in the units of the data, or the bytes of an image.
#[derive(Debug, Clone, PartialEq)]
pub enum Values {
    /// numbers
    F32(Vec<f32>),
    /// bytes of an image
    U8(Vec<u8>),
}

/// [`Values`] that lie elsewhere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ValuesRef<'a> {
    /// numbers
    F32(&'a [f32]),
    /// bytes of an image
    U8(&'a [u8]),
}

impl Values {
    /// The numbers; `None` for an image.
    pub fn numbers(&self) -> Option<&[f32]> {
        match self {
            Self::F32(values) => Some(values),
            Self::U8(_) => None,
        }
    }

    /// The same values, borrowed.
    pub fn as_ref(&self) -> ValuesRef<'_> {
        match self {
            Self::F32(values) => ValuesRef::F32(values),
            Self::U8(values) => ValuesRef::U8(values),
        }
    }
}

impl From<Vec<f32>> for Values {
    fn from(values: Vec<f32>) -> Self {
        Self::F32(values)
    }
}

impl<'a> From<&'a [f32]> for ValuesRef<'a> {
    fn from(values: &'a [f32]) -> Self {
        Self::F32(values)
    }
}

impl ValuesRef<'_> {
    /// Number of values.
    pub fn len(self) -> usize {
        match self {
            Self::F32(values) => values.len(),
            Self::U8(values) => values.len(),
        }
    }

    /// Whether there is none.
    pub fn is_empty(self) -> bool {
        self.len() == 0
    }

    /// A copy.
    pub fn to_values(self) -> Values {
        match self {
            Self::F32(values) => Values::F32(values.to_vec()),
            Self::U8(values) => Values::U8(values.to_vec()),
        }
    }
}

impl<'a> Features<ValuesRef<'a>> {
    /// Of a state and, unless `environment_state` is empty, an environment state.
    pub fn of_slices(state: &'a [f32], environment_state: &'a [f32]) -> Self {
        let environment_state = (!environment_state.is_empty()).then_some(environment_state.into());
        Self::low_dimensional(state.into(), environment_state)
    }
}

/// One step's observation in raw units.
pub type Observation = Features<Values>;

impl Observation {
    /// Of a state and, unless `environment_state` is empty, an environment state.
    pub fn of_state(state: Vec<f32>, environment_state: Vec<f32>) -> Self {
        let environment_state = (!environment_state.is_empty()).then_some(environment_state);
        Self::low_dimensional(state.into(), environment_state.map(Values::F32))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    const READS: [FeatureKind; 3] = [FeatureKind::State, FeatureKind::EnvironmentState, FeatureKind::Entity];

    proptest! {
        /// Against a map and a list of first occurrences.
        #[test]
        fn features_are_a_map_that_keeps_its_order(inserted in prop::collection::vec(("[a-d]{1,2}", any::<u8>()), 0..20)) {
            let (mut order, mut map) = (Vec::new(), BTreeMap::new());
            let mut features = Features::new();
            for (name, value) in &inserted {
                if map.insert(name.clone(), *value).is_none() {
                    order.push(name.clone());
                }
                features.insert(name, *value);
            }
            prop_assert_eq!(features.names().collect::<Vec<_>>(), order.iter().map(String::as_str).collect::<Vec<_>>());
            prop_assert_eq!(features.len(), map.len());
            for (name, value) in &map {
                prop_assert_eq!(features.get(name), Some(value));
            }
            let doubled = features.map(|_, value| u16::from(*value) * 2);
            prop_assert!(doubled.iter().all(|(name, value)| *value == u16::from(map[name]) * 2));
            prop_assert_eq!(inserted.into_iter().collect::<Features<u8>>(), features);
        }
    }

    #[test]
    fn a_feature_that_is_not_there_is_named_with_those_that_are() {
        let features = Features::low_dimensional(1, Some(2));
        assert_eq!(
            features.require("batch", "observation.images.front").unwrap_err().to_string(),
            "batch: feature observation.images.front is missing; given: observation.environment_state, observation.state"
        );
    }

    #[test]
    fn a_feature_that_a_model_cannot_read_is_refused_by_name() {
        let mut signature = Signature::low_dimensional(3, 2, 2);
        signature.check("act", &READS).unwrap();
        signature.observation.push(FeatureSpec::image("observation.images.front", 8, 8));
        assert_eq!(
            signature.check("act", &READS).unwrap_err().to_string(),
            "act cannot read feature observation.images.front of kind image; it reads state, environment_state, entity"
        );
    }

    #[test]
    fn features_that_do_not_go_together_are_refused_by_name() {
        let error = |specs: Vec<FeatureSpec>| {
            let signature = Signature { observation: specs, action_dim: 1, ..Signature::default() };
            signature.check("act", &READS).unwrap_err().to_string()
        };
        let cube = |name: &str, width| FeatureSpec::entity(name, width, "cubes", false);
        let message = error(vec![cube("a", 3), cube("b", 4)]);
        assert!(message.contains("observation.entity.b of shape [4] in group cubes"), "{message}");
        assert!(message.contains("[3], as observation.entity.a"), "{message}");
        assert!(error(vec![cube("a", 3), cube("a", 3)]).contains("observation.entity.a twice"));
        assert!(error(vec![cube("a", 0)]).contains("observation.entity.a of shape [0]"));
        let other = FeatureSpec { name: "observation.arm".to_string(), ..FeatureSpec::state(2) };
        assert!(error(vec![FeatureSpec::state(3), other]).contains("one feature of kind state"));
        let none = Signature::default().check("act", &READS).unwrap_err().to_string();
        assert!(none.contains("action_dim is 0"), "{none}");
    }

    #[test]
    fn colours_of_a_image_are_three_features_of_three_numbers() {
        let error = |width: usize, colours: &[&str], of: usize| {
            let colours = colours.iter().map(|name| format!("{ENTITY_PREFIX}{name}")).collect();
            let mut observation = vec![FeatureSpec::state(2), FeatureSpec::image("front", 8, 8)];
            observation.extend(["a", "b", "c"].map(|name| FeatureSpec::entity(name, width, "place", true)));
            observation[of] = observation[of].clone().in_colours(colours);
            let signature = Signature { observation, action_dim: 1, ..Signature::default() };
            let checked = signature.check("act", &[FeatureKind::State, FeatureKind::Entity, FeatureKind::Image]);
            checked.err().map(|e| e.to_string())
        };
        assert_eq!(error(3, &["a", "b", "c"], 1), None);
        let faults = [
            (error(3, &["a", "b"], 1), "observation.entity.a, observation.entity.b of front of kind image"),
            (error(3, &["a", "b", "d"], 1), "observation.entity.d, which is not there, of front"),
            (error(4, &["a", "b", "c"], 1), "observation.entity.a of kind entity and shape [4], of front"),
            (error(3, &["a", "b", "c"], 0), "of observation.state of kind state"),
        ];
        for (error, expected) in faults {
            let error = error.unwrap();
            assert!(error.contains(expected), "{error}");
            assert!(error.contains("three features of 3 numbers each, of an image"), "{error}");
        }
    }

    #[test]
    fn signatures_are_written_as_they_are_read() {
        let mut signature = Signature::low_dimensional(3, 0, 2);
        signature.observation.push(FeatureSpec::entity("cube0", 6, "cube", true));
        let text = serde_json::to_string(&signature).unwrap();
        assert!(text.contains(r#"{"name":"observation.state","kind":"state","shape":[3]}"#), "{text}");
        assert_eq!(serde_json::from_str::<Signature>(&text).unwrap(), signature);
        assert_eq!(signature.batch_shape(&signature.observation[1], 4), [4, 6]);
        let history = Signature { n_obs_steps: 2, ..signature };
        assert_eq!(history.batch_shape(&history.observation[1], 4), [4, 2, 6]);
    }
}
