//! Chooses the columns of the demos of a source, and notes what is taken for granted or left out.

use super::check;
use super::depth::{self, DepthKind};
use super::encoded::{Files, may_hold_files};
use super::features::{Column, ConvertOptions, IndexColumn, MISTAKE, Mapping, Origin};
use super::info::{ActionKind, ActionProvenance, Feature, RotationForm};
use super::to_robomimic::{Stated, in_statement, stated};
use crate::error::{DatasetError, InputError, Result};
use crate::keys::KeyItem;
use crate::plan::{DemoPlan, Dialect, KeyPlan, Plan, at_odds};
use crate::tree::Dtype;
use crate::words::{INSTRUCTION_WIDTH, INSTRUCTION_WORDS};
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};

/// Default keys of `observation.state`: the first set that is there whole wins. Robots after the first
/// (`robot1_...`) are added to robomimic's. If a file has none of these keys, all its vectors are used.
const STATE_DEFAULTS: [&[&str]; 7] = [
    &["robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"],
    // UMI
    &["robot0_eef_pos", "robot0_eef_rot_axis_angle", "robot0_gripper_width"],
    // LIBERO, ALOHA and others, D4RL, Isaac Lab, DROID
    &["ee_pos", "ee_ori", "gripper_states"],
    &["qpos"],
    &["flat"],
    &["eef_pos", "eef_quat", "gripper_pos"],
    &["joint_positions", "gripper_position"],
];

/// Default key of `observation.environment_state`.
const ENV_DEFAULT: &str = "object";

/// The longest row that is a vector and no image or cloud of points.
const VECTOR: usize = 4096;

/// Control frequency of robosuite environments whose arguments state none, in Hz.
const ROBOSUITE_CONTROL_FREQ: f64 = 20.0;

/// The most frames a second.
const MOST_FPS: f64 = 100_000.0;

/// The first of the demos whose datasets most demos have, by type and shape of a step.
pub(super) fn usual(plan: &Plan) -> Option<&DemoPlan> {
    type Kind<'a> = Vec<(&'a str, &'a Dtype, &'a [usize])>;
    let mut kinds: BTreeMap<Kind<'_>, (usize, usize)> = BTreeMap::new();
    for (index, demo) in plan.demos.iter().enumerate() {
        let step = |key: &'_ KeyPlan| key.shape.len().min(1);
        let keys = demo.keys.iter().map(|(path, key)| (path, &key.dtype, &key.shape[step(key)..])).collect();
        kinds.entry(keys).or_insert((0, index)).0 += 1;
    }
    let most = kinds.into_values().max_by_key(|&(count, index)| (count, std::cmp::Reverse(index)));
    most.map(|(_, index)| &plan.demos[index])
}

/// Chooses the columns of a plan's demos.
pub(super) struct Chooser<'a> {
    pub plan: &'a Plan,
    /// What the others are compared with.
    pub first: &'a DemoPlan,
    pub files: &'a Files,
    /// So many demos that have a dataset make it one that all should have.
    pub least: usize,
}

impl Chooser<'_> {
    /// The columns that the file states, unless others are asked for.
    pub fn stated(&self, options: &ConvertOptions) -> Option<Stated> {
        let chosen = options.state_keys.is_some() || options.env_keys.is_some() || !options.entities.is_empty();
        let chosen = chosen || options.actions != ActionKind::Delta || options.rotation != RotationForm::AxisAngle;
        if chosen { None } else { stated(self.plan) }
    }

    pub fn as_stated(&self, stated: &Stated, options: &ConvertOptions) -> Result<Mapping> {
        let action =
            ActionProvenance { key: "actions".to_owned(), kind: ActionKind::Delta, rotation: RotationForm::AxisAngle };
        let mut mapping = Mapping {
            columns: Vec::new(),
            fps: 0.0,
            state_keys: Vec::new(),
            env_keys: Vec::new(),
            entities: BTreeMap::new(),
            action,
            notes: Vec::new(),
        };
        stated.mapping(self.plan, &mut mapping)?;
        if !options.depth {
            for column in mapping.columns.extract_if(.., |column| column.feature.is_depth()) {
                mapping.notes.push(format!("{} becomes no column: no depth does (--no-depth)", column.name));
            }
        }
        mapping.columns.extend(index_columns());
        check::names(&self.plan.path, &mapping.features()).map_err(in_statement)?;
        mapping.fps = self.checked(options.fps.unwrap_or(mapping.fps))?;
        self.filmed(&mut mapping, options)?;
        Ok(mapping)
    }

    /// Makes videos of the cameras where they are asked for.
    pub fn filmed(&self, mapping: &mut Mapping, options: &ConvertOptions) -> Result<()> {
        if let Some(video) = &options.video {
            self.check_films(&mapping.columns)?;
            mapping.film(video, options.lossless)?;
        }
        Ok(())
    }

    /// Refuses pictures of a size that no video has.
    fn check_films(&self, columns: &[Column]) -> Result<()> {
        for column in columns {
            let Origin::Image { key, height, width, .. } = &column.origin else { continue };
            video::check_size(*width, *height).map_err(|reason| InputError::WrongShape {
                path: self.plan.path.clone(),
                demo: self.first.id.clone(),
                key: key.clone(),
                expected: "images that can become a video (without --video every size can be converted)".to_owned(),
                found: format!("{height} x {width}: {reason}"),
            })?;
        }
        Ok(())
    }

    /// Observations of floating-point numbers, a vector or a number a step, in order of their names. What follows from
    /// others is none: the environment's state, the action before, what Mimic notes for itself and what a text was embedded as.
    fn vectors(&self) -> Vec<String> {
        let fits = |key: &KeyPlan| {
            matches!(key.dtype, Dtype::F32 | Dtype::F64) && matches!(key.shape[..], [_] | [_, 1..=VECTOR])
        };
        let other = |name: &str| {
            matches!(name, ENV_DEFAULT | "actions") || name.starts_with("datagen_info/") || name.contains("embedding")
        };
        let keys = self.first.keys.iter().filter(|(path, key)| fits(key) && self.usual(path));
        let names = keys.filter_map(|(path, _)| path.strip_prefix("obs/"));
        names.filter(|name| !other(name)).map(str::to_owned).collect()
    }

    pub fn state_keys(&self, options: &ConvertOptions, notes: &mut Vec<String>) -> Result<Vec<String>> {
        if let Some(keys) = &options.state_keys {
            return Ok(keys.clone());
        }
        let has = |key: &str| self.usual(&format!("obs/{key}"));
        let chosen = STATE_DEFAULTS.iter().find(|set| set.iter().all(|key| has(key)));
        let Some(set) = chosen else {
            // a part of robomimic's set is a file that lost the others
            let lacking = STATE_DEFAULTS[0].iter().find(|key| !has(key)).expect("one is lacking");
            let vectors = if STATE_DEFAULTS[0].iter().any(|key| has(key)) { Vec::new() } else { self.vectors() };
            if vectors.is_empty() {
                return Err(self.missing(self.first, &format!("obs/{lacking}")).into());
            }
            notes.push(format!("observation.state is made of {} (--state-keys chooses others)", vectors.join(", ")));
            return Ok(vectors);
        };
        let mut keys: Vec<String> = set.iter().map(|&k| k.to_owned()).collect();
        for robot in 1.. {
            let more: Vec<String> = set.iter().map(|k| k.replace("robot0", &format!("robot{robot}"))).collect();
            if !set[0].starts_with("robot0") || !more.iter().all(|key| has(key)) {
                break;
            }
            keys.extend(more);
        }
        Ok(keys)
    }

    pub fn env_keys(&self, options: &ConvertOptions) -> Result<Vec<String>> {
        Ok(match &options.env_keys {
            Some(keys) => keys.clone(),
            None if self.usual(&format!("obs/{ENV_DEFAULT}")) => {
                vec![ENV_DEFAULT.to_owned()]
            }
            None => Vec::new(),
        })
    }

    pub fn concat(&self, name: &str, keys: &[String]) -> Result<Column> {
        let mut parts = Vec::with_capacity(keys.len());
        let mut names = Vec::new();
        for key in keys {
            let unfit = |reason: String| {
                DatasetError::from(InputError::ObservationKeys {
                    path: self.plan.path.clone(),
                    column: name.to_owned(),
                    reason,
                })
            };
            let item: KeyItem = key.parse().map_err(unfit)?;
            let mut widths = BTreeMap::new();
            for key in item.keys() {
                let width = match self.made_of_words(key).map_err(unfit)? {
                    true => INSTRUCTION_WIDTH,
                    false => self.width_everywhere(&format!("obs/{key}"))?,
                };
                widths.insert(key.to_owned(), width);
            }
            let width = item.width(|key| widths.get(key).copied()).map_err(unfit)?;
            names.extend(item.names(width));
            parts.push((item, widths));
        }
        Ok(Column {
            name: name.to_owned(),
            feature: Feature { dtype: "float32".to_owned(), shape: vec![names.len()], names: json!(names), info: None },
            origin: Origin::Concat(parts),
        })
    }

    /// Whether a conversion makes this observation of the instructions: LIBERO's own files do not hold it. Others may word
    /// their tasks (`ep_meta`) in another way than the simulator does.
    fn made_of_words(&self, key: &str) -> std::result::Result<bool, String> {
        let place = format!("obs/{key}");
        if key != INSTRUCTION_WORDS || self.plan.demos.iter().any(|demo| demo.keys.contains_key(&place)) {
            return Ok(false);
        }
        let own = |demo: &DemoPlan| demo.task.is_some() && !demo.attr_names.iter().any(|name| name == "ep_meta");
        match self.plan.demos.iter().find(|demo| self.plan.dialect != Dialect::Libero || !own(demo)) {
            Some(demo) => Err(format!(
                "{key} is made from the instruction of LIBERO's own files alone, and {} comes from another file, which lacks \
                 it; collect the demonstrations again, or leave the key out",
                demo.id
            )),
            None => Ok(true),
        }
    }

    pub fn action(&self, options: &ConvertOptions) -> Result<(Column, ActionProvenance)> {
        let key = match options.actions {
            ActionKind::Delta => "actions",
            ActionKind::Absolute => "actions_abs",
        };
        let stored = self.width_everywhere(key)?;
        let width = match options.rotation {
            RotationForm::AxisAngle => stored,
            RotationForm::SixD if stored % 7 == 0 => stored / 7 * 10,
            RotationForm::SixD => {
                return Err(self
                    .wrong_shape(self.first, key, "7 numbers an arm (position, axis-angle, gripper) for 6D rotations")
                    .into());
            }
        };
        let names: Vec<String> = (0..width).map(|i| format!("action_{i}")).collect();
        let column = Column {
            name: "action".to_owned(),
            feature: Feature { dtype: "float32".to_owned(), shape: vec![width], names: json!(names), info: None },
            origin: Origin::Action { key: key.to_owned(), width: stored, rotation: options.rotation },
        };
        let provenance = ActionProvenance { key: key.to_owned(), kind: options.actions, rotation: options.rotation };
        Ok((column, provenance))
    }

    /// Every dataset of colour images becomes `observation.images.<camera>`.
    pub fn images(&self) -> Result<Vec<Column>> {
        let mut columns = Vec::new();
        let mut taken = BTreeSet::new();
        let mut cameras: BTreeMap<&str, &KeyPlan> = BTreeMap::new();
        for (path, key) in std::iter::once(self.first).chain(&self.plan.demos).flat_map(|demo| &demo.keys) {
            if self.files.sizes.contains_key(path) || key.is_image() {
                cameras.entry(path).or_insert(key);
            }
        }
        for (path, key) in cameras.into_iter().filter(|(path, _)| self.usual(path)) {
            let Some(name) = path.strip_prefix("obs/") else { continue };
            let (jpeg, (height, width)) = match (self.files.sizes.get(path), key.is_image()) {
                (Some(&size), _) => (true, size),
                (None, true) if key.shape[3] == 3 => (false, (key.shape[1], key.shape[2])),
                _ => continue,
            };
            // LIBERO's `agentview_rgb` is upside down, `agentview_image` of the same simulator is not
            let colour = if self.plan.dialect == Dialect::Libero { None } else { name.strip_suffix("_rgb") };
            let camera =
                name.strip_suffix("_image").or(colour).unwrap_or(name).trim_start_matches("images/").replace('/', ".");
            // two datasets of one camera name keep their full names apart
            let camera = if taken.insert(camera.clone()) { camera } else { name.replace('/', ".") };
            for demo in &self.plan.demos {
                let other = self.key(demo, path)?;
                let (fits, expected) = match jpeg {
                    // their rows are as long as the longest file of the demo
                    true => (may_hold_files(path, other), "a row of bytes a step, a JPEG file in each".to_owned()),
                    false => (
                        other.is_image() && other.shape[1..] == key.shape[1..],
                        format!("uint8 images {height} x {width} x 3"),
                    ),
                };
                if !fits {
                    return Err(self.wrong_shape(demo, path, &expected).into());
                }
            }
            columns.push(Column {
                name: format!("observation.images.{camera}"),
                feature: Feature {
                    dtype: "image".to_owned(),
                    shape: vec![height, width, 3],
                    names: json!(["height", "width", "channels"]),
                    info: None,
                },
                origin: Origin::Image { key: path.to_owned(), height, width, jpeg },
            });
        }
        Ok(columns)
    }

    /// Every dataset of depth becomes `observation.images.<camera>_depth`, as LeRobot's recorder would store it; why one
    /// does not goes to `left_out`.
    pub fn depth(&self, options: &ConvertOptions, columns: &mut Vec<Column>, left_out: &mut BTreeMap<String, String>) {
        for (path, key) in &self.first.keys {
            let (Some((height, width)), Some(kind)) = (depth::size(path, key), DepthKind::of(&key.dtype)) else {
                continue;
            };
            let differs = self.plan.demos.iter().find(|demo| {
                let fits = |other: &KeyPlan| {
                    (&other.dtype, other.shape.split_first()) == (&key.dtype, Some((&demo.length, &key.shape[1..])))
                };
                !demo.keys.get(path).is_some_and(fits)
            });
            let reason = match (options.depth, differs) {
                (true, None) => {
                    let name = path.trim_start_matches("obs/");
                    // a colour camera keeps its name, and depth that has it already its whole path
                    let short = name.trim_start_matches("images/").replace('/', ".");
                    let taken = columns.iter().any(|c| c.name == format!("observation.images.{short}"));
                    let camera = if taken { format!("depth.{}", name.replace('/', ".")) } else { short };
                    columns.push(Column {
                        name: format!("observation.images.{camera}"),
                        feature: depth::feature(height, width, kind),
                        origin: Origin::Depth { key: path.to_owned(), height, width, dtype: key.dtype.clone(), kind },
                    });
                    continue;
                }
                (true, Some(demo)) => format!("{} has other depth than {} or none", demo.id, self.first.id),
                (false, _) => "no depth does (--no-depth)".to_owned(),
            };
            left_out.insert(path.to_owned(), reason);
        }
    }

    /// What looks like pictures and becomes no column, with the reason: that of `known`, or that LeRobot has no place for
    /// it. Its recorder takes pictures of three channels and depth alone; a made-up channel would not be the recording's.
    pub fn pictures_left_out(
        &self,
        columns: &[Column],
        known: BTreeMap<String, String>,
        options: &ConvertOptions,
    ) -> Vec<String> {
        const NO_COLOUR: &str = "only uint8 [height, width, 3] and JPEG files do";
        let of_camera = |path: &str| path.starts_with("obs/images/") || path.ends_with("_image");
        let numbers: BTreeSet<String> = columns.iter().flat_map(Column::keys).collect();
        let mut found: BTreeMap<&str, (String, &str)> = BTreeMap::new();
        for (path, key) in self.plan.demos.iter().flat_map(|d| &d.keys) {
            let shape = key.shape.get(1..).unwrap_or_default();
            let is_column = |c: &Column| matches!(&c.origin, Origin::Depth { key, .. } if key == path);
            let reason = match (shape, &key.dtype) {
                _ if !path.starts_with("obs/") || self.files.sizes.contains_key(path) => continue,
                _ if columns.iter().any(is_column) || numbers.contains(path) => continue,
                ([_, _, 3], _) if key.is_image() => continue,
                ([_, _, 1], Dtype::U8) => "LeRobot records no grey images, and its ACT takes three channels",
                ([_, _, 4], Dtype::U8) => "LeRobot records no fourth channel, and its ACT takes three",
                _ if depth::size(path, key).is_some() => "not every demo has this depth",
                ([_, _, 1], Dtype::F32 | Dtype::F64 | Dtype::U16) => "nothing in its name says that it is depth",
                ([_, _, 1], _) => "LeRobot's depth is float or uint16",
                ([_, _, 3 | 4], _) => NO_COLOUR,
                // bytes for each step under the name of a camera that are no JPEG file
                ([_] | [], _) if of_camera(path) => NO_COLOUR,
                // grey, channels first, or several pictures a step
                ([_, _, ..], kind) if *kind == Dtype::U8 || of_camera(path) || path.contains("rgb") => NO_COLOUR,
                ([], Dtype::VarBytes) => NO_COLOUR,
                _ => continue,
            };
            let reason = known.get(path).or_else(|| self.files.others.get(path)).map_or(reason, String::as_str);
            let encoded = if shape.len() < 2 { "encoded images, " } else { "" };
            found.entry(path).or_insert((format!("{encoded}{} {shape:?}", key.dtype), reason));
        }
        let fate = match options.lossless {
            true => "the side folder keeps it as stored",
            false => "it is left out (--no-lossless)",
        };
        let note = |(path, (what, reason))| format!("{path} ({what}) becomes no column: {reason}; {fate}");
        found.into_iter().map(note).collect()
    }

    /// Rewards, dones and success, where the demos have them. A file that has none gets no such columns.
    pub fn outcomes(&self, notes: &mut Vec<String>) -> Result<Vec<Column>> {
        let scalar = |name: &str, dtype: &str, origin| Column {
            name: name.to_owned(),
            feature: Feature { dtype: dtype.to_owned(), shape: vec![1], names: Value::Null, info: None },
            origin,
        };
        let mut columns = Vec::new();
        if self.usual("rewards") {
            self.one_a_step("rewards")?;
            columns.push(scalar("next.reward", "float32", Origin::Reward));
        }
        if self.usual("dones") {
            self.one_a_step("dones")?;
            columns.push(scalar("next.done", "bool", Origin::Flag("dones".to_owned())));
        }
        if self.usual("rewards") && self.rewards_tell_success()? {
            columns.push(scalar("next.success", "bool", Origin::Success));
        } else if self.usual("success") {
            self.one_a_step("success")?;
            columns.push(scalar("next.success", "bool", Origin::Flag("success".to_owned())));
        } else if self.usual("rewards") && self.is_robosuite() {
            notes.push(
                "no next.success is made: env_args say reward_shaping, and shaped rewards do not show success"
                    .to_owned(),
            );
        }
        if self.usual("mistakes") {
            self.one_a_step("mistakes")?;
            columns.push(scalar(MISTAKE, "bool", Origin::Flag("mistakes".to_owned())));
        }
        Ok(columns)
    }

    /// robosuite's sparse reward, and that of everything built on it, is 1 exactly when the task is solved; a shaped one tells
    /// nothing. LIBERO's own files say `reward_shaping`, but its tasks know no shaped reward.
    fn rewards_tell_success(&self) -> Result<bool, InputError> {
        if !self.is_robosuite() || self.plan.dialect == Dialect::Libero {
            return Ok(self.is_robosuite());
        }
        let shaped = self.env_kwargs().and_then(|kwargs| kwargs.get("reward_shaping")?.as_bool());
        at_odds(&self.plan.problems, "reward_shaping").map_or(Ok(shaped != Some(true)), |error| Err(error.clone()))
    }

    fn env_kwargs(&self) -> Option<&Value> {
        self.plan.env_args.as_ref()?.get("env_kwargs")
    }

    /// Whether `env_args` says so: robomimic numbers the kinds of environments.
    fn is_robosuite(&self) -> bool {
        const ROBOSUITE: i64 = 1;
        let kind = self.plan.env_args.as_ref().and_then(|args| args.get("type")?.as_i64());
        kind == Some(ROBOSUITE)
    }

    fn one_a_step(&self, path: &str) -> Result<()> {
        match self.width_everywhere(path)? {
            1 => Ok(()),
            _ => Err(self.wrong_shape(self.first, path, "one number a step").into()),
        }
    }

    pub fn fps(&self, options: &ConvertOptions, notes: &mut Vec<String>) -> Result<f64> {
        let stated = self.env_kwargs().and_then(|kwargs| kwargs.get("control_freq")).filter(|rate| !rate.is_null());
        let stated = match stated {
            Some(rate) if options.fps.is_none() => {
                let number = rate.as_f64().or_else(|| rate.as_str()?.trim().parse().ok());
                Some(number.ok_or_else(|| {
                    self.bad_rate("env_args", "a number as env_kwargs.control_freq (--fps decides)", rate)
                })?)
            }
            _ => None,
        };
        if let (None, Some(error)) = (options.fps, at_odds(&self.plan.problems, "control_freq")) {
            return Err(error.clone().into());
        }
        // Isaac Lab states its steps
        let sim = self.plan.env_args.as_ref().and_then(|args| args.get("sim_args"));
        let step = sim.and_then(|sim| Some(sim.get("dt")?.as_f64()? * sim.get("decimation")?.as_f64()?));
        let stated = stated.or(step.filter(|&step| step > 0.0).map(|step| (1e6 / step).round() / 1e6));
        let mut default = || {
            if self.is_robosuite() {
                notes.push(format!(
                    "env_args state no control_freq; {ROBOSUITE_CONTROL_FREQ} Hz is taken, robosuite's default (--fps decides)"
                ));
                return Some(ROBOSUITE_CONTROL_FREQ);
            }
            let usual = self.plan.dialect.usual_fps()?;
            let name = self.plan.dialect.name();
            notes.push(format!("no rate is stated; {usual} Hz is taken, as is usual of {name} (--fps decides)"));
            Some(usual)
        };
        let fps = options.fps.or(stated).or_else(&mut default).ok_or_else(|| {
            self.bad_rate(
                "env_args",
                "env_kwargs.control_freq, or a rate given to `actrm-data convert` (--fps)",
                "neither",
            )
        })?;
        self.checked(fps)
    }

    /// A frame rate that can be stored: at a higher one two frames would have the same timestamp.
    fn checked(&self, fps: f64) -> Result<f64> {
        match fps > 0.0 && fps <= MOST_FPS {
            true => Ok(fps),
            false => {
                let expected = format!("a number above 0, at most {MOST_FPS}");
                Err(self.bad_rate("frames a second", &expected, fps).into())
            }
        }
    }

    fn bad_rate(&self, attribute: &str, expected: &str, found: impl ToString) -> InputError {
        InputError::BadAttribute {
            path: self.plan.path.clone(),
            object: "data".to_owned(),
            attribute: attribute.to_owned(),
            expected: expected.to_owned(),
            found: found.to_string(),
        }
    }

    /// Values a step of dataset `path`, the same in every demo.
    fn width_everywhere(&self, path: &str) -> Result<usize> {
        let shape_of = |demo| -> Result<usize> {
            let key = self.key(demo, path)?;
            if !key.dtype.is_numeric() || key.shape.is_empty() {
                return Err(self.wrong_shape(demo, path, "one or more numbers a step").into());
            }
            Ok(key.shape[1..].iter().product())
        };
        let width = shape_of(self.first)?;
        if width == 0 {
            return Err(self.wrong_shape(self.first, path, "one or more numbers a step").into());
        }
        for demo in &self.plan.demos {
            if shape_of(demo)? != width {
                let expected = format!("{width} numbers a step, as in {}", self.first.id);
                return Err(self.wrong_shape(demo, path, &expected).into());
            }
        }
        Ok(width)
    }

    /// Whether enough demos have this dataset for all to need it.
    fn usual(&self, path: &str) -> bool {
        self.plan.demos.iter().filter(|demo| demo.keys.contains_key(path)).take(self.least).count() == self.least
    }

    fn key<'d>(&self, demo: &'d DemoPlan, path: &str) -> Result<&'d KeyPlan> {
        demo.keys.get(path).ok_or_else(|| DatasetError::from(self.missing(demo, path)))
    }

    fn missing(&self, demo: &DemoPlan, path: &str) -> InputError {
        if let Some(error) = self.plan.unreadable(demo, path) {
            return error.clone();
        }
        let folder = path.rsplit_once('/').map_or("", |(folder, _)| folder);
        let near: Vec<&str> =
            demo.keys.keys().filter(|k| k.rsplit_once('/').map_or("", |(f, _)| f) == folder).collect();
        let found = if near.is_empty() { demo.keys.keys().collect::<Vec<_>>() } else { near };
        InputError::MissingKey {
            path: self.plan.path.clone(),
            demo: demo.id.clone(),
            key: path.to_owned(),
            found: match self.plan.demos.iter().filter(|demo| demo.keys.contains_key(path)).count() {
                0 => found.join(", "),
                n => format!(
                    "{}; {n} of {} demos have it (--skip-bad leaves out the others)",
                    found.join(", "),
                    self.plan.demos.len()
                ),
            },
        }
    }

    fn wrong_shape(&self, demo: &DemoPlan, path: &str, expected: &str) -> InputError {
        InputError::WrongShape {
            path: self.plan.path.clone(),
            demo: demo.id.clone(),
            key: path.to_owned(),
            expected: expected.to_owned(),
            found: demo.keys.get(path).map_or_else(|| "nothing".to_owned(), |k| format!("{} {:?}", k.dtype, k.shape)),
        }
    }
}

/// The five columns that every data set has.
pub(super) fn index_columns() -> Vec<Column> {
    [
        ("timestamp", "float32", IndexColumn::Timestamp),
        ("frame_index", "int64", IndexColumn::FrameIndex),
        ("episode_index", "int64", IndexColumn::EpisodeIndex),
        ("index", "int64", IndexColumn::Index),
        ("task_index", "int64", IndexColumn::TaskIndex),
    ]
    .into_iter()
    .map(|(name, dtype, index)| Column {
        name: name.to_owned(),
        feature: Feature { dtype: dtype.to_owned(), shape: vec![1], names: Value::Null, info: None },
        origin: Origin::Index(index),
    })
    .collect()
}
