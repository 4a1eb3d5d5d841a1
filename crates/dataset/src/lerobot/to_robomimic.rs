//! robomimic files of data sets that keep no source to rebuild, and of sources of another layout: a demo an episode. A file that
//! is made of a data set states its columns (`lerobot` of the group `data`), so that converting it gives the same frames.

use super::convert::without_observations;
use super::depth::DepthKind;
use super::edit;
use super::encoded;
use super::export::{ExportReport, Rows, each_file, picture_pixels};
use super::features::{Column, Mapping, Origin};
use super::fingerprint::INDEX_COLUMNS;
use super::images;
use super::info::{Feature, Info};
use super::open::{Dataset, EpisodeMeta};
use super::read::{self, BadColumn, cast_all, leaf, texts};
use super::skip;
use super::tiff;
use crate::error::{DatasetError, InputError, Result};
use crate::plan::Plan;
use crate::source::{NonFinite, RobomimicWriter, Source, WriteOptions, list};
use crate::tree::{Array, Attrs, Demo, Dtype};
use arrow_array::ArrayRef;
use arrow_array::cast::AsArray;
use arrow_array::types::{
    Float32Type, Float64Type, Int8Type, Int16Type, Int32Type, Int64Type, UInt8Type, UInt16Type, UInt32Type, UInt64Type,
};
use arrow_schema::DataType;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The attribute of `data` that states the columns.
const STATED: &str = "lerobot";

/// The columns of a data set, and the dataset of a demo that each is in.
#[derive(Serialize, Deserialize)]
pub(crate) struct Stated {
    fps: f64,
    /// Whether `env_args` are those of the demonstrations; otherwise they only satisfy robomimic.
    environment: bool,
    #[serde(default)]
    state_keys: Vec<String>,
    #[serde(default)]
    env_keys: Vec<String>,
    columns: Vec<StatedColumn>,
}

#[derive(Serialize, Deserialize)]
struct StatedColumn {
    name: String,
    key: String,
    feature: Feature,
}

/// Where a column of a data set goes.
fn key_of(name: &str, feature: &Feature) -> String {
    let plain = |name: &str| name.replace(['.', '/'], "_");
    match name {
        "action" => "actions".to_owned(),
        "next.reward" => "rewards".to_owned(),
        "next.done" => "dones".to_owned(),
        "next.success" => "success".to_owned(),
        super::MISTAKE => "mistakes".to_owned(),
        _ => match name.strip_prefix("observation.") {
            Some(below) => {
                let camera = below.strip_prefix("images.");
                let colour = if camera.is_some() && !feature.is_depth() { "_image" } else { "" };
                format!("obs/{}{colour}", plain(camera.unwrap_or(below)))
            }
            None => plain(name),
        },
    }
}

/// The type of a column's dataset.
fn dtype_of(feature: &Feature) -> Dtype {
    match feature.dtype.as_str() {
        "float64" => Dtype::F64,
        "int64" => Dtype::I64,
        "int32" => Dtype::I32,
        "int16" => Dtype::I16,
        "int8" => Dtype::I8,
        "uint64" => Dtype::U64,
        "uint32" => Dtype::U32,
        "uint16" => Dtype::U16,
        "uint8" => Dtype::U8,
        "bool" => Dtype::Bool,
        "string" => Dtype::VarStr,
        _ => Dtype::F32,
    }
}

/// Values as a dataset of this type holds them.
fn bytes_of(array: &ArrayRef, dtype: &Dtype) -> Result<Vec<u8>, String> {
    macro_rules! numbers {
        ($kind:ty, $type:expr) => {{
            let array = cast_all(array, &$type).map_err(|e| e.to_string())?;
            array.as_primitive::<$kind>().values().iter().flat_map(|v| v.to_le_bytes()).collect()
        }};
    }
    Ok(match dtype {
        Dtype::F64 => numbers!(Float64Type, DataType::Float64),
        Dtype::I64 => numbers!(Int64Type, DataType::Int64),
        Dtype::I32 => numbers!(Int32Type, DataType::Int32),
        Dtype::I16 => numbers!(Int16Type, DataType::Int16),
        Dtype::I8 => numbers!(Int8Type, DataType::Int8),
        Dtype::U64 => numbers!(UInt64Type, DataType::UInt64),
        Dtype::U32 => numbers!(UInt32Type, DataType::UInt32),
        Dtype::U16 => numbers!(UInt16Type, DataType::UInt16),
        Dtype::U8 => numbers!(UInt8Type, DataType::UInt8),
        Dtype::Bool => {
            let array = cast_all(array, &DataType::Boolean).map_err(|e| e.to_string())?;
            array.as_boolean().values().iter().map(u8::from).collect()
        }
        _ => numbers!(Float32Type, DataType::Float32),
    })
}

/// Makes a robomimic file of the columns of the data set `root`.
pub(super) fn from_columns(
    root: &Path,
    out: &Path,
    options: &WriteOptions,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<ExportReport> {
    let set = Dataset::open(root)?;
    let info = set.info();
    let mut notes = set.notes().to_vec();
    let mut columns = Vec::new();
    let mut taken = BTreeSet::new();
    for (name, feature) in info.features.0.iter().filter(|(name, _)| !INDEX_COLUMNS.contains(&name.as_str())) {
        if feature.dtype == "language" || (feature.is_depth() && feature.dtype == "video") {
            let what = if feature.is_depth() { "depth as video" } else { "language" };
            notes.push(format!("{name} is left out: {what} has no place in a robomimic file"));
            continue;
        }
        let mut key = key_of(name, feature);
        while !taken.insert(key.clone()) {
            key.push('_');
        }
        columns.push(StatedColumn { name: name.clone(), key, feature: feature.clone() });
    }
    if notes.iter().any(|note| note.starts_with("timestamp: ")) {
        notes.push("timestamp is left out: a robomimic file has steps, and no times of a clock".to_owned());
    }
    let lacking: Vec<&str> = ["rewards", "dones"].into_iter().filter(|key| !taken.contains(*key)).collect();
    if !lacking.is_empty() {
        notes.push(format!(
            "the data set has no {}, which robomimic wants: rewards are 0, and a demo is done at its last step",
            lacking.join(" and no ")
        ));
    }
    let mut cursors = BTreeMap::new();
    for column in columns.iter().filter(|c| c.feature.dtype != "video") {
        let rows = if column.feature.is_visual() { 32 } else { 1024 };
        cursors.insert(column.name.clone(), Rows::open(root, "data", Some(&column.name), rows)?);
    }
    let provenance = set.provenance();
    let env_args = provenance.and_then(|p| p.env_args.clone());
    let stated = Stated {
        fps: info.fps,
        environment: env_args.is_some(),
        state_keys: provenance.map(|p| p.state_keys.clone()).unwrap_or_default(),
        env_keys: provenance.map(|p| p.env_keys.clone()).unwrap_or_default(),
        columns,
    };
    let ids: Vec<String> =
        set.episodes().iter().map(|e| e.demo.clone().unwrap_or_else(|| format!("demo_{}", e.index))).collect();
    let empty: Vec<&str> =
        set.episodes().iter().zip(&ids).filter(|(e, _)| e.length == 0).map(|(_, id)| &**id).collect();
    notes.extend(columns_of_others(root)?);
    if !empty.is_empty() {
        notes.push(format!("episodes without frames become demos without steps: {}", list(empty.into_iter())));
    }
    let several = set.episodes().iter().filter(|episode| episode.tasks.len() > 1).count();
    if several > 0 {
        notes.push(format!("{several} episodes have several tasks: a demo has one, and the first of them is kept"));
    }
    let mut writer = RobomimicWriter::create(out, options)?;
    let total = set.frames() as u64;
    let text =
        serde_json::to_string(&stated).map_err(|source| DatasetError::Json { path: out.to_path_buf(), source })?;
    writer.set_data_attr("total", &Array::from_i64(Vec::new(), &[total as i64]))?;
    writer.set_data_attr("env_args", &Array::from_str(&env_args_of(env_args, info).to_string()))?;
    writer.set_data_attr(STATED, &Array::from_str(&text))?;
    progress(0, total);
    for (episode, id) in set.episodes().iter().zip(&ids) {
        let mut demo = Demo { id: id.clone(), ..Demo::default() };
        for column in &stated.columns {
            let array = episode_array(&set, column, &mut cursors, episode)?;
            demo.datasets.insert(column.key.clone(), array);
        }
        complete(&mut demo, episode.length, episode.tasks.first().map(String::as_str));
        writer.add_demo(&demo)?;
        progress(episode.to as u64, total);
    }
    for name in set.split_names() {
        let episodes = set.split(name).unwrap_or_default();
        let demos: Vec<String> = episodes.iter().filter_map(|&episode| ids.get(episode).cloned()).collect();
        // a range that LeRobot writes of every set is no mask
        if provenance.is_some() || (!demos.is_empty() && demos.len() < ids.len()) {
            writer.set_mask(name, &demos)?;
        }
    }
    writer.finish()?;
    Ok(ExportReport { demos: ids.len(), frames: set.frames(), notes })
}

/// A note of what other programs say of the episodes.
pub(super) fn columns_of_others(root: &Path) -> Result<Option<String>> {
    let mut names = BTreeSet::new();
    for path in read::files(root, "meta/episodes")? {
        let builder = read::open(&path)?;
        names.extend(builder.schema().fields().iter().map(|f| f.name().clone()).filter(|name| !edit::is_own(name)));
    }
    let found = || list(names.iter().map(String::as_str));
    Ok((!names.is_empty())
        .then(|| format!("columns of meta/episodes that have no place in a robomimic file are left out: {}", found())))
}

/// Arguments of an environment that robomimic accepts.
fn env_args_of(known: Option<Value>, info: &Info) -> Value {
    let name = info.robot_type.as_deref().unwrap_or("LeRobot");
    let mut args = known.unwrap_or_else(|| json!({"env_name": name, "env_kwargs": {"control_freq": info.fps}}));
    with_kind(&mut args);
    args
}

/// robomimic numbers the kinds of environments and wants one; 2 is Gym.
fn with_kind(args: &mut Value) {
    if let Some(args) = args.as_object_mut() {
        args.entry("type").or_insert(json!(2));
        args.entry("env_kwargs").or_insert(json!({}));
    }
}

/// Adds what robomimic expects of the group `data` and a recording of another layout lacks.
pub(super) fn complete_root(root: &mut Demo, info: &Info) {
    let known = info.actrm.as_ref().and_then(|p| p.env_args.clone());
    let name = info.actrm.as_ref().and_then(|p| p.env_name.clone().or(Some(p.dialect.clone())));
    let mut args = known.unwrap_or_else(|| json!({"env_name": name}));
    with_kind(&mut args);
    if let Some(kwargs) = args.get_mut("env_kwargs").and_then(Value::as_object_mut) {
        kwargs.entry("control_freq").or_insert(json!(info.fps));
    }
    let data = root.inner_attrs.entry("data".to_owned()).or_default();
    let total = || Array::from_i64(Vec::new(), &[info.total_frames as i64]);
    data.entry("total".to_owned()).or_insert_with(total);
    data.entry("env_args".to_owned()).or_insert_with(|| Array::from_str(&args.to_string()));
}

/// Adds what robomimic expects of every demo and this one lacks.
pub(super) fn complete(demo: &mut Demo, length: usize, task: Option<&str>) {
    let count = || Array::from_i64(Vec::new(), &[length as i64]);
    demo.attrs.entry("num_samples".to_owned()).or_insert_with(count);
    if let Some(task) = task {
        let meta = || Array::from_str(&json!({"lang": task}).to_string());
        demo.attrs.entry("ep_meta".to_owned()).or_insert_with(meta);
    }
    let ends: Vec<i64> = (1..=length).map(|step| i64::from(step == length)).collect();
    demo.datasets.entry("dones".to_owned()).or_insert_with(|| Array::from_i64(vec![length], &ends));
    demo.datasets.entry("rewards".to_owned()).or_insert_with(|| Array::from_f64(vec![length], &vec![0.0; length]));
}

/// The values of a column over an episode.
fn episode_array(
    set: &Dataset,
    column: &StatedColumn,
    cursors: &mut BTreeMap<String, Rows>,
    episode: &EpisodeMeta,
) -> Result<Array> {
    let StatedColumn { name, key, feature } = column;
    let data = set.root().join("data");
    let bad = |found: String| BadColumn { path: &data, name }.because(format!("values of {}", feature.dtype), found);
    let length = episode.length;
    let Some(cursor) = cursors.get_mut(name) else {
        let images = set.episode_pictures(name, episode.index)?;
        let shape = vec![length, images.height, images.width, 3];
        return Ok(Array { dtype: Dtype::U8, shape, bytes: images.data });
    };
    let mut bytes = Vec::new();
    if feature.is_depth() {
        let &[height, width, 1] = feature.shape.as_slice() else {
            return Err(bad(format!("shape {:?}", feature.shape)));
        };
        let mut kind = DepthKind::F32;
        for batch in cursor.take(length)? {
            each_file(set.root(), name, batch.column(0), (height, width), &mut |file| {
                kind = tiff::decode(file, height, width, &mut bytes)?;
                Ok(())
            })?;
        }
        return Ok(Array { dtype: kind.dtype(), shape: vec![length, height, width, 1], bytes });
    }
    if feature.is_visual() {
        let (_, height, width) = set.camera(name)?;
        for batch in cursor.take(length)? {
            picture_pixels(set.root(), name, batch.column(0), height, width, &mut bytes)?;
        }
        return Ok(Array { dtype: Dtype::U8, shape: vec![length, height, width, 3], bytes });
    }
    let mut dtype = dtype_of(feature);
    if dtype == Dtype::VarStr {
        let mut all = Vec::with_capacity(length);
        for batch in cursor.take(length)? {
            all.extend(texts(&data, name, batch.column(0))?);
        }
        return Ok(Array::from_strings(vec![length], &all));
    }
    for batch in cursor.take(length)? {
        let values = leaf(&BadColumn { path: &data, name }, batch.column(0), batch.num_rows(), feature.dim())?;
        bytes.extend(bytes_of(&values, &dtype).map_err(bad)?);
    }
    let mut shape = vec![length];
    match key.as_str() {
        // robomimic has one number a step of these, and whole numbers as dones
        "dones" if dtype == Dtype::Bool => {
            bytes = bytes.iter().flat_map(|&done| i64::from(done).to_le_bytes()).collect();
            dtype = Dtype::I64;
        }
        "rewards" | "dones" if feature.dim() == 1 => {}
        _ => shape.extend_from_slice(&feature.shape),
    }
    Ok(Array { dtype, shape, bytes })
}

/// The columns that a file states, where it was made of a data set.
pub(crate) fn stated(plan: &Plan) -> Option<Stated> {
    serde_json::from_str(plan.texts.get(&format!("data/{STATED}"))?).ok()
}

/// What is wrong with the columns that a file states, as an error of that file.
pub(super) fn in_statement(error: DatasetError) -> DatasetError {
    match error {
        DatasetError::BadDataset { path, object, expected, found } => {
            let (of, attribute) = ("data".to_owned(), format!("{STATED}: {object}"));
            InputError::BadAttribute { path, object: of, attribute, expected, found }.into()
        }
        other => other,
    }
}

impl Stated {
    /// The columns as they were, and what is noted of those that cannot be.
    pub(crate) fn mapping(&self, plan: &Plan, mapping: &mut Mapping) -> Result<()> {
        for StatedColumn { name, key, feature } in &self.columns {
            let mut feature = feature.clone();
            let first = plan.demos.iter().find_map(|demo| demo.keys.get(key));
            let origin = match (feature.dtype.as_str(), first) {
                ("string", _) => {
                    mapping.notes.push(format!("{name} becomes no column: texts are not written"));
                    continue;
                }
                (_, None) => {
                    let found = plan.demos.first().map(|demo| demo.keys.keys().collect::<Vec<_>>().join(", "));
                    return Err(InputError::MissingKey {
                        path: plan.path.clone(),
                        demo: plan.demos.first().map(|demo| demo.id.clone()).unwrap_or_default(),
                        key: key.clone(),
                        found: found.unwrap_or_default(),
                    }
                    .into());
                }
                (_, Some(array)) if feature.is_depth() => {
                    let &[_, height, width, 1] = &*array.shape else { return Err(self.shape(plan, key)) };
                    let Some(kind) = DepthKind::of(&array.dtype) else { return Err(self.shape(plan, key)) };
                    Origin::Depth { key: key.clone(), height, width, dtype: array.dtype.clone(), kind }
                }
                ("image" | "video", Some(array)) => {
                    let &[_, height, width, 3] = &*array.shape else { return Err(self.shape(plan, key)) };
                    feature = Feature {
                        dtype: "image".to_owned(),
                        shape: vec![height, width, 3],
                        names: json!(["height", "width", "channels"]),
                        info: None,
                    };
                    Origin::Image { key: key.clone(), height, width, jpeg: false }
                }
                (dtype, Some(_)) => {
                    if !matches!(dtype, "float32" | "float64" | "int64" | "bool") {
                        let as_type = if dtype.contains("int") { "int64" } else { "float32" };
                        mapping.notes.push(format!("{name} was {dtype} and is written as {as_type}"));
                        feature.dtype = as_type.to_owned();
                    }
                    if feature.shape.len() > 1 {
                        mapping
                            .notes
                            .push(format!("{name} was of shape {:?} and is written as a vector", feature.shape));
                        (feature.shape, feature.names) = (vec![feature.dim()], Value::Null);
                    }
                    Origin::Stored(key.clone())
                }
            };
            let shape = |array: &crate::plan::KeyPlan| array.shape.iter().skip(1).product::<usize>();
            let differs = plan.demos.iter().any(|demo| {
                !demo.keys.get(key).is_some_and(|k| shape(k) == feature.dim() && k.shape.first() == Some(&demo.length))
            });
            if differs {
                return Err(self.shape(plan, key));
            }
            mapping.columns.push(Column { name: name.clone(), feature, origin });
        }
        (mapping.state_keys, mapping.env_keys) = (self.state_keys.clone(), self.env_keys.clone());
        mapping.fps = self.fps;
        Ok(())
    }

    fn shape(&self, plan: &Plan, key: &str) -> DatasetError {
        let column = self.columns.iter().find(|column| column.key == key);
        let demo = plan.demos.iter().find(|demo| {
            let rows = |k: &crate::plan::KeyPlan| k.shape.iter().skip(1).product::<usize>();
            demo.keys.get(key).is_none_or(|k| column.is_none_or(|c| rows(k) != c.feature.dim()))
        });
        let demo = demo.or(plan.demos.first());
        InputError::WrongShape {
            path: plan.path.clone(),
            demo: demo.map(|demo| demo.id.clone()).unwrap_or_default(),
            key: key.to_owned(),
            expected: column
                .map_or_else(String::new, |c| format!("{:?} a step, as `{STATED}` of data says", c.feature.shape)),
            found: demo
                .and_then(|demo| demo.keys.get(key))
                .map_or_else(|| "nothing".to_owned(), |k| format!("{} {:?}", k.dtype, k.shape)),
        }
        .into()
    }
}

/// Makes a robomimic file of demonstrations of any layout: under robomimic's names, JPEG files as pixels.
pub fn rewrite(
    source: &Path,
    out: &Path,
    nonfinite: NonFinite,
    options: &WriteOptions,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<ExportReport> {
    let input = Source::open_guarded(source)?.nonfinite(nonfinite);
    without_observations(&input)?;
    skip::none(&input)?;
    let plan = input.plan();
    let files = encoded::sizes(&input)?.sizes;
    let mut root = input.root()?;
    let data: &mut Attrs = root.inner_attrs.entry("data".to_owned()).or_default();
    data.insert("total".to_owned(), Array::from_i64(Vec::new(), &[plan.frames() as i64]));
    let known = plan.env_args.clone();
    let mut env_args =
        known.unwrap_or_else(|| json!({"env_name": plan.env_name.as_deref().unwrap_or(plan.dialect.name())}));
    with_kind(&mut env_args);
    data.insert("env_args".to_owned(), Array::from_str(&env_args.to_string()));
    let mut writer = RobomimicWriter::create(out, options)?;
    writer.set_root(&root)?;
    let (mut done, total) = (0, plan.frames() as u64);
    progress(done, total);
    for (index, planned) in plan.demos.iter().enumerate() {
        let readable = |key: &str| planned.keys.contains_key(key);
        let mut demo = input.read_demo_where(index, &readable)?;
        for (key, &(height, width)) in &files {
            for key in [key.clone(), key.replacen("obs/", "next_obs/", 1)] {
                let Some(array) = demo.datasets.get_mut(&key) else { continue };
                *array = pixels(array, (height, width)).map_err(|found| InputError::WrongShape {
                    path: source.to_path_buf(),
                    demo: planned.id.clone(),
                    key,
                    expected: format!("JPEG files of {height} x {width}"),
                    found,
                })?;
            }
        }
        complete(&mut demo, planned.length, planned.task.as_deref());
        writer.add_demo(&demo)?;
        done += planned.length as u64;
        progress(done, total);
    }
    writer.finish()?;
    let problems = plan.problems.iter().filter(|problem| !problem.fatal).map(|problem| problem.message.clone());
    let notes = plan.notes.iter().cloned().chain(plan.left_out("").1).chain(problems).collect();
    Ok(ExportReport { demos: plan.demos.len(), frames: plan.frames(), notes })
}

/// The pixels of JPEG files, one a step.
fn pixels(files: &Array, (height, width): (usize, usize)) -> Result<Array, String> {
    let rows = files.byte_rows().ok_or("other values")?;
    let mut bytes = Vec::with_capacity(rows.len() * height * width * 3);
    for (frame, row) in rows.iter().enumerate() {
        let file = images::jpeg(row).ok_or_else(|| format!("other bytes in frame {frame}"))?;
        images::decode(file, height, width, &mut bytes).map_err(|found| format!("{found} in frame {frame}"))?;
    }
    Ok(Array { dtype: Dtype::U8, shape: vec![rows.len(), height, width, 3], bytes })
}
