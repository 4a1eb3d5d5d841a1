//! The rows of the data files: carried over in the types that they have, with new numbers, and looked at once on the way
//! for statistics and digests. Pictures stay the files that they are.

use super::super::chooser::index_columns;
use super::super::encode::{ColumnSummary, PartSummary, PictureSummary, add_to_histograms, sample};
use super::super::export::Rows;
use super::super::fingerprint::INDEX_COLUMNS;
use super::super::images;
use super::super::info::{FILES_PER_FOLDER, Feature, Features};
use super::super::open::{Dataset, EpisodeMeta};
use super::super::pictures::image_files;
use super::super::read::{self, BadColumn};
use super::super::schema;
use super::super::shards::{GroupEncoder, ShardWriter, WrittenFile};
use super::super::tally::{Tally, Told};
use super::super::tiff;
use super::super::values::Values;
use super::super::work::{GROUP_BYTES, Part};
use super::films::Copied as Filmed;
use super::groups::Groups;
use super::{Advance, Edit};
use crate::error::{DatasetError, Result};
use crate::stats::FeatureStats;
use arrow_array::{Array, ArrayRef, BooleanArray, Float32Array, Float64Array, Int64Array, RecordBatch, StructArray};
use arrow_cast::cast;
use arrow_schema::{DataType, Field, Schema, SchemaRef};
use parquet::file::metadata::KeyValue;
use rayon::prelude::*;
use serde_json::{Map, Value};
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, HashMap, VecDeque};
use std::path::Path;
use std::sync::Arc;

/// The data files of the result, and what its episodes say of themselves.
pub(super) struct Copied {
    pub files: Vec<WrittenFile>,
    /// Task texts in order of first use.
    pub tasks: Vec<String>,
    pub told: Told,
}

/// Whether the pictures of a feature are decoded for their statistics; others keep what is stored of them.
pub(in crate::lerobot) fn is_looked_at(feature: &Feature) -> bool {
    let channels = if feature.is_depth() { 1 } else { 3 };
    feature.dtype == "image"
        && matches!(feature.shape[..], [height, width, c] if height > 0 && width > 0 && c == channels)
}

/// Task texts, each with its number.
#[derive(Default)]
struct Tasks {
    texts: Vec<String>,
    numbers: HashMap<String, usize>,
}

impl Tasks {
    /// The number of a text, which is the next one where it has none.
    fn number(&mut self, text: &str) -> usize {
        if let Some(&number) = self.numbers.get(text) {
            return number;
        }
        self.texts.push(text.to_owned());
        self.numbers.insert(text.to_owned(), self.texts.len() - 1);
        self.texts.len() - 1
    }
}

/// Copies the rows of all episodes taken, whose videos are in `films`.
pub(super) fn copy(edit: &Edit<'_>, mut films: Vec<(usize, Filmed)>, advance: &mut Advance<'_>) -> Result<Copied> {
    let info = edit.inputs[0].set.info();
    let (names, schema, metadata) = written_as(edit)?;
    let encoder = schema::writer_properties(&schema, metadata.into_iter().collect())
        .and_then(|properties| GroupEncoder::new(Arc::clone(&schema), properties))
        .map_err(|source| DatasetError::Parquet {
            path: edit.root.join("data"),
            operation: "prepare writing it",
            source,
        })?;
    let limit = (info.data_files_size_in_mb * f64::from(1 << 20)) as u64;
    let mut shards = ShardWriter::new(edit.root, "data", &encoder, limit, FILES_PER_FOLDER);
    let mut append = |group, begins| shards.append(group, begins);
    let mut groups = Groups::new(edit.root, &encoder, limit);
    let (mut tasks, mut tally) = (Tasks::default(), Tally::new(&edit.features, info.fps, edit.root));
    for text in edit.tasks() {
        tasks.number(&text);
    }
    // episodes whose place is not known yet
    let mut waiting: VecDeque<(PartSummary, Vec<usize>)> = VecDeque::new();
    let mut settle = |groups: &mut Groups<'_>, waiting: &mut VecDeque<(PartSummary, Vec<usize>)>, texts: &[String]| {
        while !waiting.is_empty()
            && let Some(place) = groups.next_place()
            && let Some((mut summary, tasks)) = waiting.pop_front()
        {
            let number = summary.part.episode;
            for (column, film) in &mut films {
                summary.pictures.insert(*column, std::mem::take(&mut film.pictures[number]));
            }
            let stretch = |camera, _: &[video::Sample]| {
                let film = films.iter().find(|(column, _)| *column == camera);
                Ok(film.expect("each camera was copied").1.stretches[number])
            };
            let first = tasks.first().map_or("", |&task| texts[task].as_str());
            tally.add(summary, place, (&tasks, first), &mut { stretch })?;
        }
        Ok::<(), DatasetError>(())
    };
    let picture_bytes: usize =
        edit.features.0.iter().filter(|(_, f)| f.dtype == "image").map(|(_, f)| f.picture_bytes()).sum();
    let batch_rows = (GROUP_BYTES as usize / picture_bytes.max(1)).clamp(1, 1024);
    let (mut frames, mut number) = (0, 0);
    for (input, taken) in edit.inputs.iter().zip(&edit.taken) {
        let set = &input.set;
        let stored = stored_statistics(edit, set)?;
        let mut rows = Rows::open(set.root(), "data", None, batch_rows)?;
        for episode in set.episodes() {
            if taken.binary_search(&episode.index).is_err() {
                rows.skip(episode.length)?;
                continue;
            }
            let own = episode.tasks.iter().map(|text| tasks.number(text)).collect();
            let part = Part { episode: number, length: episode.length, first_frame: frames, rows: 0..episode.length };
            let mut seen = Seen::new(edit, set, &schema, part, episode);
            groups.begin(episode.length, &mut append)?;
            for from in (0..episode.length).step_by(batch_rows) {
                for batch in rows.take(batch_rows.min(episode.length - from))? {
                    let arrays = seen.numbered(columns(set.root(), &batch, &names, &schema)?, &mut tasks)?;
                    seen.look(&arrays)?;
                    groups.push(arrays, &mut append)?;
                }
            }
            frames += episode.length;
            advance(episode.length as u64)?;
            number += 1;
            waiting.push_back((seen.summary(&stored), own));
            settle(&mut groups, &mut waiting, &tasks.texts)?;
        }
    }
    groups.finish(&mut append)?;
    settle(&mut groups, &mut waiting, &tasks.texts)?;
    Ok(Copied { files: shards.finish()?, tasks: tasks.texts, told: tally.finish()? })
}

/// Adds the features of index columns that the first set's data files have and its `info.json` does not state.
pub(super) fn state_index_columns(features: &mut Features, set: &Dataset) -> Result<()> {
    let path = read::files(set.root(), "data")?.swap_remove(0);
    let schema = Arc::clone(read::open(&path)?.schema());
    for column in index_columns() {
        if features.get(&column.name).is_none() && schema.index_of(&column.name).is_ok() {
            features.0.push((column.name, column.feature));
        }
    }
    Ok(())
}

/// The names of the columns of the first set's data files that are written, their schema under the new names, and what the
/// files tell Hugging Face's `datasets`. What is no feature is left out, unless the tables alone are made anew.
fn written_as(edit: &Edit<'_>) -> Result<(Vec<String>, SchemaRef, Option<KeyValue>)> {
    use DataType::{FixedSizeList, LargeList, List};
    let (set, renames) = (&edit.inputs[0].set, edit.renames);
    let path = read::files(set.root(), "data")?.swap_remove(0);
    let builder = read::open(&path)?;
    let features = &set.info().features;
    let known =
        |name: &String| edit.repair.is_some() || features.get(name).is_some() || INDEX_COLUMNS.contains(&name.as_str());
    let fields: Vec<&Arc<Field>> = builder.schema().fields().iter().filter(|f| known(f.name())).collect();
    let names: Vec<String> = fields.iter().map(|f| f.name().clone()).collect();
    let new = |name: &String| known(name).then(|| renames.get(name).unwrap_or(name).clone());
    let is_list = |field: &Field| matches!(field.data_type(), List(_) | LargeList(_) | FixedSizeList(_, _));
    let listed = fields.iter().any(|field| is_list(field) && INDEX_COLUMNS.contains(&field.name().as_str()));
    let field = |field: &Arc<Field>| {
        let mut kind = field.data_type();
        // one number a row, whose feature LeRobot takes for no list
        while let (true, List(inner) | LargeList(inner) | FixedSizeList(inner, _)) =
            (INDEX_COLUMNS.contains(&field.name().as_str()), kind)
        {
            kind = inner.data_type();
        }
        Field::clone(field)
            .with_data_type(kind.clone())
            .with_name(renames.get(field.name()).unwrap_or(field.name()))
            .with_metadata(std::collections::HashMap::<String, String>::new())
    };
    let schema = Schema::new(fields.iter().copied().map(field).collect::<Vec<_>>());
    let pairs = builder.metadata().file_metadata().key_value_metadata();
    let told = pairs.into_iter().flatten().find(|pair| pair.key == "huggingface").cloned();
    let told = match told {
        Some(pair) if listed || !renames.is_empty() || names.len() < builder.schema().fields().len() => {
            renamed_entry(&pair, &new)
        }
        told => told,
    };
    Ok((names, Arc::new(schema), told))
}

/// The entry with its columns under other names, or without them; none where it is not what `datasets` writes.
fn renamed_entry(pair: &KeyValue, new: &dyn Fn(&String) -> Option<String>) -> Option<KeyValue> {
    let told: Value = serde_json::from_str(pair.value.as_ref()?).ok()?;
    let columns = told.get("info")?.get("features")?.as_object()?;
    let flat = |name: &String, mut what: &Value| {
        while let (true, Some(inner)) = (INDEX_COLUMNS.contains(&name.as_str()), what.get("feature")) {
            what = inner;
        }
        what.clone()
    };
    let columns: Map<String, Value> =
        columns.iter().filter_map(|(name, what)| Some((new(name)?, flat(name, what)))).collect();
    Some(schema::described_as(columns))
}

/// The columns of a batch, in the types of the result.
fn columns(root: &Path, batch: &RecordBatch, names: &[String], schema: &Schema) -> Result<Vec<ArrayRef>> {
    let path = root.join("data");
    let column = |(name, field): (&String, &Arc<Field>)| {
        let array = batch.column_by_name(name).ok_or_else(|| DatasetError::NotInDataset {
            path: path.clone(),
            wanted: format!("column {name}"),
            found: batch.schema().fields().iter().map(|f| f.name().as_str()).collect::<Vec<_>>().join(", "),
        })?;
        let mut array = with_bytes(root, name, array)?;
        if INDEX_COLUMNS.contains(&name.as_str()) {
            array = read::leaf(&BadColumn { path: &path, name }, &array, array.len(), 1)?;
        }
        match array.data_type() == field.data_type() {
            true => Ok(array),
            false => read::cast_all(&array, field.data_type()).map_err(|e| {
                let found = format!("{}: {e}", array.data_type());
                BadColumn { path: &path, name }.because(field.data_type().to_string(), found)
            }),
        }
    };
    names.iter().zip(schema.fields()).map(column).collect()
}

/// An image column whose rows have their files in them: those that are named by path are read, for the result lies elsewhere.
fn with_bytes(root: &Path, name: &str, array: &ArrayRef) -> Result<ArrayRef> {
    let Some(images) = array.as_any().downcast_ref::<StructArray>() else { return Ok(ArrayRef::clone(array)) };
    let Some(at) = images.column_names().iter().position(|field| *field == "bytes") else {
        return Ok(ArrayRef::clone(array));
    };
    if images.column(at).null_count() == 0 {
        return Ok(ArrayRef::clone(array));
    }
    let path = root.join("data");
    let column = BadColumn { path: &path, name };
    let bad = |found: String| column.because("an image in every row", found);
    let files: ArrayRef = Arc::new(image_files(root, array).map_err(bad)?);
    let mut columns = images.columns().to_vec();
    columns[at] = cast(&files, images.column(at).data_type()).map_err(|e| bad(e.to_string()))?;
    let whole = StructArray::try_new(images.fields().clone(), columns, images.nulls().cloned());
    Ok(Arc::new(whole.map_err(|e| bad(e.to_string()))?))
}

/// Pixels of a picture.
enum Pixels {
    Colours(Vec<u8>),
    Depth(Vec<f32>),
}

/// A picture's digest, and its pixels where they count; neither of one that is not looked at.
type Looked = Option<([u8; 32], Option<Pixels>)>;

/// An episode while its rows pass.
struct Seen<'a> {
    edit: &'a Edit<'a>,
    set: &'a Dataset,
    part: Part,
    /// Rows that have passed.
    rows: usize,
    /// Its number in its own set.
    episode: usize,
    /// Column of the data files of each feature; none for videos.
    columns: Vec<Option<usize>>,
    /// Columns of the numbers of episodes, frames (in the set and in the episode) and tasks.
    numbers: [Option<usize>; 4],
    /// The column of times, where they are made anew.
    times: Option<usize>,
    /// Frames whose pictures enter the statistics.
    sampled: Vec<usize>,
    values: Vec<Values>,
    pictures: BTreeMap<usize, PictureSummary>,
}

impl<'a> Seen<'a> {
    fn new(edit: &'a Edit<'a>, set: &'a Dataset, schema: &Schema, part: Part, episode: &EpisodeMeta) -> Self {
        let place = |name: &str| schema.index_of(name).ok();
        let doubles = |name: &str| schema.field_with_name(name).is_ok_and(|f| *f.data_type() == DataType::Float64);
        let values = edit.features.0.iter().map(|(name, feature)| match feature.dtype.as_str() {
            _ if feature.is_visual() || feature.is_text() => Values::Pictures,
            "bool" => Values::Bool(Vec::new()),
            // beyond what int64 holds
            "float64" | "uint64" => Values::F64(Vec::new()),
            // times of a clock, of which float32 leaves nothing
            _ if name == "timestamp" && doubles(name) => Values::F64(Vec::new()),
            whole if whole.contains("int") => Values::I64(Vec::new()),
            _ => Values::F32(Vec::new()),
        });
        Self {
            edit,
            set,
            rows: 0,
            episode: episode.index,
            columns: edit.features.0.iter().map(|(name, _)| place(name)).collect(),
            numbers: ["episode_index", "index", "frame_index", "task_index"].map(place),
            times: edit.repair.and_then(|repair| if repair.timestamps { place("timestamp") } else { None }),
            sampled: sample(part.length),
            values: values.collect(),
            pictures: BTreeMap::new(),
            part,
        }
    }

    /// The columns with the numbers that they have in the result.
    fn numbered(&self, mut arrays: Vec<ArrayRef>, tasks: &mut Tasks) -> Result<Vec<ArrayRef>> {
        let path = self.set.root().join("data");
        let rows = arrays.first().map_or(0, |a| a.len());
        let as_type = |array: &ArrayRef, to: &DataType| {
            read::cast_all(array, to).map_err(|source| DatasetError::Parquet {
                path: path.clone(),
                operation: "number its rows",
                source: source.into(),
            })
        };
        let [episode, index, frame, task] = self.numbers;
        let counting = |from: usize| (from as i64..(from + rows) as i64).collect::<Vec<_>>();
        let mut numbers = vec![
            (episode, vec![self.part.episode as i64; rows]),
            (index, counting(self.part.first_frame + self.rows)),
            (frame, counting(self.rows)),
        ];
        if let (Some(at), Some(_), [task]) = (task, self.edit.repair, self.tasks()) {
            numbers.push((Some(at), vec![tasks.number(task) as i64; rows]));
        } else if let Some(at) = task {
            let mut known: BTreeMap<i64, i64> = BTreeMap::new();
            let mut new = Vec::with_capacity(rows);
            for &old in read::integers(&path, "task_index", &arrays[at])?.iter() {
                new.push(match known.get(&old) {
                    Some(&new) => new,
                    None => {
                        let number = tasks.number(self.task(&path, old)?) as i64;
                        *known.entry(old).or_insert(number)
                    }
                });
            }
            numbers.push((task, new));
        }
        for (column, numbers) in numbers {
            let Some(at) = column else { continue };
            let numbers: ArrayRef = Arc::new(Int64Array::from(numbers));
            arrays[at] = as_type(&numbers, arrays[at].data_type())?;
        }
        if let Some(at) = self.times {
            let fps = self.set.info().fps;
            let times = (self.rows..self.rows + rows).map(|frame| frame as f64 / fps);
            let times: ArrayRef = Arc::new(Float64Array::from_iter_values(times));
            arrays[at] = as_type(&times, arrays[at].data_type())?;
        }
        Ok(arrays)
    }

    /// Task texts of the episode.
    fn tasks(&self) -> &[String] {
        &self.set.episodes()[self.episode].tasks
    }

    fn task(&self, path: &Path, number: i64) -> Result<&str> {
        self.set.task(number).ok_or_else(|| DatasetError::BadDataset {
            path: path.to_path_buf(),
            object: format!("task_index in episode {}", self.episode),
            expected: format!("one of {} tasks", self.set.tasks().len()),
            found: number.to_string(),
        })
    }

    /// Takes note of the values of the next rows.
    fn look(&mut self, arrays: &[ArrayRef]) -> Result<()> {
        let path = self.set.root().join("data");
        let edit = self.edit;
        for (index, (name, feature)) in edit.features.0.iter().enumerate() {
            let Some(array) = self.columns[index].map(|at| &arrays[at]) else { continue };
            if is_looked_at(feature) {
                self.look_at(index, edit.before(name), feature, array)?;
                continue;
            }
            let column = BadColumn { path: &path, name: edit.before(name) };
            let wrong = |e: arrow_schema::ArrowError| column.because(feature.dtype.clone(), e.to_string());
            let leaf = |to: DataType| -> Result<ArrayRef> {
                read::cast_all(&read::leaf(&column, array, array.len(), feature.dim())?, &to).map_err(wrong)
            };
            match &mut self.values[index] {
                Values::Pictures => {}
                Values::F32(values) => {
                    values.extend_from_slice(down::<Float32Array>(&leaf(DataType::Float32)?).values())
                }
                Values::F64(values) => {
                    values.extend_from_slice(down::<Float64Array>(&leaf(DataType::Float64)?).values())
                }
                Values::I64(values) => values.extend_from_slice(down::<Int64Array>(&leaf(DataType::Int64)?).values()),
                Values::Bool(values) => values.extend(down::<BooleanArray>(&leaf(DataType::Boolean)?).values()),
            }
        }
        self.rows += arrays.first().map_or(0, |a| a.len());
        Ok(())
    }

    /// Decodes the pictures of the next rows of a column, as far as their pixels are asked for.
    fn look_at(&mut self, index: usize, name: &str, feature: &Feature, array: &ArrayRef) -> Result<()> {
        let (height, width) = (feature.shape[0], feature.shape[1]);
        let files = self.set.files(name, array)?;
        let (digests, first, sampled) = (self.edit.digests(), self.rows, &self.sampled);
        let look = |row: usize| -> Result<Looked> {
            let counts = sampled.binary_search(&(first + row)).is_ok();
            if !counts && !digests {
                return Ok(None);
            }
            let mut pixels = Vec::with_capacity(feature.picture_bytes());
            let file = files.value(row);
            // depth that is not finite was kept on purpose, and statistics are those of the rest
            let decoded = match feature.is_depth() {
                true => tiff::decode(file, height, width, &mut pixels).map(Some),
                false => images::decode(file, height, width, &mut pixels).map(|()| None),
            };
            let kind = decoded.map_err(|found| DatasetError::BadDataset {
                path: self.set.root().join("data"),
                object: format!("column {name}, frame {} of episode {}", first + row, self.episode),
                expected: match feature.is_depth() {
                    true => format!("a TIFF file with {height} x {width} of depth"),
                    false => format!("a PNG or PPM image of {height} x {width}"),
                },
                found,
            })?;
            let digest = if digests { Sha256::digest(&pixels).into() } else { [0; 32] };
            let pixels = match kind {
                Some(kind) => Pixels::Depth(kind.values(&pixels).collect()),
                None => Pixels::Colours(pixels),
            };
            Ok(Some((digest, counts.then_some(pixels))))
        };
        let looked: Vec<_> = (0..files.len()).into_par_iter().map(look).collect();
        let summary = self.pictures.entry(index).or_default();
        if !feature.is_depth() {
            summary.histograms.resize(3, [0; 256]);
        }
        for one in looked {
            let Some((digest, pixels)) = one? else { continue };
            if digests {
                summary.digests.push(digest);
            }
            match pixels {
                Some(Pixels::Colours(pixels)) => add_to_histograms(summary, height, width, &pixels),
                Some(Pixels::Depth(values)) => summary.add_depth(height, width, &values),
                None => {}
            }
        }
        Ok(())
    }

    /// All that is known once every row has passed; `stored` are statistics of features that were not looked at.
    fn summary(mut self, stored: &BTreeMap<String, Vec<FeatureStats>>) -> PartSummary {
        // every episode's is kept until all have passed
        self.pictures.values_mut().for_each(PictureSummary::settle);
        let column = |(values, (name, feature)): (Values, &(String, Feature))| ColumnSummary {
            stats: match stored.get(name) {
                Some(each) => each.get(self.episode).cloned(),
                None => values.stats(feature.dim()),
            },
            // as opening the result hashes them
            digest: values.digest_as_read(),
            values,
        };
        let values = self.values.into_iter().zip(&self.edit.features.0).map(column).collect();
        PartSummary { part: self.part, values, pictures: self.pictures }
    }
}

fn down<T: 'static>(array: &ArrayRef) -> &T {
    array.as_any().downcast_ref::<T>().expect("it was just made one")
}

/// What a set's episodes say of the features that are not looked at, by their new names.
fn stored_statistics(edit: &Edit<'_>, set: &Dataset) -> Result<BTreeMap<String, Vec<FeatureStats>>> {
    let mut stored = BTreeMap::new();
    for (name, _) in edit.features.0.iter().filter(|(_, f)| f.is_visual() && !is_looked_at(f)) {
        let mut each = Vec::with_capacity(set.episodes().len());
        for path in read::files(set.root(), "meta/episodes")? {
            each.extend(statistics_in(&path, edit.before(name))?);
        }
        if !each.is_empty() {
            stored.insert(name.clone(), set.in_order(each)?);
        }
    }
    Ok(stored)
}

/// A feature's statistics in one file of episodes; nothing where it has none, no quantiles where they were not stored yet.
pub(crate) fn statistics_in(path: &Path, feature: &str) -> Result<Vec<FeatureStats>> {
    let read = |statistics: [&str; 5]| -> Result<Option<Vec<Vec<Vec<f64>>>>> {
        let names = statistics.map(|statistic| format!("stats/{feature}/{statistic}"));
        match read::columns(path, &names.each_ref().map(String::as_str)) {
            Err(DatasetError::NotInDataset { .. }) => Ok(None),
            Err(e) => Err(e),
            Ok((_, arrays)) => {
                let each = arrays.iter().zip(&names).map(|(array, name)| read::number_lists(path, name, array));
                each.collect::<Result<Vec<_>>>().map(Some)
            }
        }
    };
    let Some(known) = read(["min", "max", "mean", "std", "count"])? else { return Ok(Vec::new()) };
    let quantiles = read(["q01", "q10", "q50", "q90", "q99"])?;
    let of_row = |row: usize| {
        let vector = |i: usize| known[i][row].clone();
        let quantile = |i: usize| quantiles.as_ref().map_or_else(Vec::new, |q| q[i][row].clone());
        FeatureStats {
            min: vector(0),
            max: vector(1),
            mean: vector(2),
            std: vector(3),
            count: known[4][row].first().map_or(0, |&count| count as u64),
            q01: quantile(0),
            q10: quantile(1),
            q50: quantile(2),
            q90: quantile(3),
            q99: quantile(4),
        }
    };
    Ok((0..known[0].len()).map(of_row).collect())
}
