//! The side folder `actrm/`: everything that LeRobotDataset v3.0 has no place for, so that the source can be
//! rebuilt exactly.
//!
//! - `actrm/frames/chunk-NNN/file-NNN.parquet`: a row a frame, in the order of the data files. Each dataset that
//!   has one row a step is a column of its path, in its own type; null over demos that lack it or have another
//!   type or shape there.
//! - `actrm/objects/chunk-NNN/file-NNN.parquet`: a row for each attribute, empty group and dataset that is no such
//!   column, with its bytes. `next_obs/x` is kept as the rows in which it differs from `obs/x` one step later.
//! - `actrm/info.json`: where the data came from (also without the rest of the folder).
//! - `actrm/layout.json`: the columns' types and shapes.
//! - `actrm/manifest.json`: sha256 of every other file of the data set.

use super::encode::{Job, Loaded};
use super::features::{Origin, VideoOptions};
use super::info::FILES_PER_FOLDER;
use super::schema::{element, writer_properties};
use super::shards::{EncodedGroup, GroupEncoder, Place, ShardWriter, WrittenFile};
use super::work::{BULK_ROW_BYTES, Part};
use crate::error::{DatasetError, InputError, Result};
use crate::plan::{DemoPlan, KeyPlan, Plan};
use crate::tree::{Array, Attrs, Demo, Dtype};
use arrow_array::builder::{BinaryBuilder, Int64Builder, ListBuilder, StringBuilder};
use arrow_array::types::{ArrowPrimitiveType, Float32Type, Float64Type, Int32Type, Int64Type};
use arrow_array::{ArrayRef, FixedSizeBinaryArray, FixedSizeListArray, PrimitiveArray};
use arrow_buffer::{BooleanBuffer, MutableBuffer, NullBuffer, ScalarBuffer};
use arrow_schema::{DataType, Field, Schema};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

/// Where the columns of the side folder are described.
pub(crate) const LAYOUT_FILE: &str = "actrm/layout.json";
/// Where the files' hashes are.
pub(crate) const MANIFEST_FILE: &str = "actrm/manifest.json";
/// Folder of the frames.
pub(crate) const FRAMES: &str = "actrm/frames";
/// Folder of the objects.
pub(crate) const OBJECTS: &str = "actrm/objects";
/// Bytes of objects in a row group.
const OBJECT_GROUP_BYTES: usize = 4 << 20;
/// Stands for the part of the source that belongs to no demo.
pub(crate) const NO_EPISODE: i64 = -1;

/// `actrm/layout.json`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Layout {
    /// Version of the side folder.
    pub format: u32,
    /// The columns of the frames.
    pub columns: Vec<SideColumn>,
}

/// A dataset with one row a step.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct SideColumn {
    /// Its path below the demo, which is the column's name.
    pub path: String,
    /// Type of its elements.
    pub dtype: Dtype,
    /// Shape of one row.
    pub row_shape: Vec<usize>,
}

/// `actrm/manifest.json`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Manifest {
    /// Version of this file.
    pub format: u32,
    /// sha256 of each file by its path in the data set.
    pub files: BTreeMap<String, String>,
}

/// What a row of the objects is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// An attribute of the demo (path empty) or of an object inside it.
    Attribute,
    /// A group that holds nothing.
    Group,
    /// A dataset, whole.
    Dataset,
    /// A dataset that is another one (`name`) a step later, except in `rows`.
    Shifted,
    /// A dataset that is the image column `name` of the data files.
    Picture,
}

impl Kind {
    pub(crate) const ALL: [(Self, &str); 5] = [
        (Self::Attribute, "attribute"),
        (Self::Group, "group"),
        (Self::Dataset, "dataset"),
        (Self::Shifted, "shifted"),
        (Self::Picture, "picture"),
    ];

    pub(crate) fn name(self) -> &'static str {
        Self::ALL.iter().find(|(kind, _)| *kind == self).map_or("", |(_, name)| name)
    }
}

/// One row of the objects.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Object {
    pub kind: Kind,
    pub path: String,
    pub name: String,
    pub rows: Vec<usize>,
    pub array: Option<Array>,
}

impl SideColumn {
    pub(crate) fn row_elements(&self) -> usize {
        self.row_shape.iter().product()
    }

    pub(crate) fn row_bytes(&self) -> usize {
        self.dtype.size().unwrap_or(0) * self.row_elements()
    }

    fn fits(&self, dtype: &Dtype, shape: &[usize], length: usize) -> bool {
        *dtype == self.dtype && shape.split_first() == Some((&length, &self.row_shape[..]))
    }

    /// The Arrow type of the elements where the column is a list of numbers; `None` where rows are bytes.
    pub(crate) fn number_type(&self) -> Option<DataType> {
        if self.row_bytes() as u64 > BULK_ROW_BYTES {
            return None;
        }
        match self.dtype {
            Dtype::F64 => Some(DataType::Float64),
            Dtype::F32 => Some(DataType::Float32),
            Dtype::I64 => Some(DataType::Int64),
            Dtype::I32 => Some(DataType::Int32),
            _ => None,
        }
    }

    pub(crate) fn field(&self) -> Field {
        let data_type = match (self.number_type(), self.row_elements()) {
            (Some(number), 1) => number,
            (Some(number), n) => DataType::FixedSizeList(element(number), n as i32),
            (None, _) => DataType::FixedSizeBinary(self.row_bytes() as i32),
        };
        Field::new(&self.path, data_type, true)
    }

    fn array(&self, bytes: MutableBuffer, rows: usize, nulls: Option<NullBuffer>) -> ArrayRef {
        fn flat<T: ArrowPrimitiveType>(bytes: MutableBuffer, count: usize, nulls: Option<NullBuffer>) -> ArrayRef {
            Arc::new(PrimitiveArray::<T>::new(ScalarBuffer::new(bytes.into(), 0, count), nulls))
        }
        let n = self.row_elements();
        let Some(number) = self.number_type() else {
            return Arc::new(FixedSizeBinaryArray::new(self.row_bytes() as i32, bytes.into(), nulls));
        };
        let inner = if n == 1 { nulls.clone() } else { None };
        let values = match number {
            DataType::Float64 => flat::<Float64Type>(bytes, rows * n, inner),
            DataType::Float32 => flat::<Float32Type>(bytes, rows * n, inner),
            DataType::Int64 => flat::<Int64Type>(bytes, rows * n, inner),
            _ => flat::<Int32Type>(bytes, rows * n, inner),
        };
        match n {
            1 => values,
            n => Arc::new(FixedSizeListArray::new(element(number), n as i32, values, nulls)),
        }
    }
}

/// Decides what becomes a column, from the plan alone.
fn layout(plan: &Plan, pictures: &BTreeMap<String, String>, left_out: &BTreeSet<String>) -> Layout {
    let mut columns: BTreeMap<&str, SideColumn> = BTreeMap::new();
    for demo in &plan.demos {
        for (path, key) in &demo.keys {
            let elsewhere = pictures.contains_key(path) || left_out.contains(path);
            if columns.contains_key(path) || elsewhere || base_of(demo, path).is_some() {
                continue;
            }
            if let Some(column) = column_of(path, key, demo.length) {
                columns.insert(path, column);
            }
        }
    }
    Layout { format: 1, columns: columns.into_values().collect() }
}

fn column_of(path: &str, key: &KeyPlan, length: usize) -> Option<SideColumn> {
    let (&rows, row_shape) = key.shape.split_first()?;
    let row_bytes = row_shape.iter().try_fold(key.dtype.size()?, |n, &extent| n.checked_mul(extent))?;
    let fits = rows == length && (1..=i32::MAX as usize).contains(&row_bytes);
    fits.then(|| SideColumn { path: path.to_owned(), dtype: key.dtype.clone(), row_shape: row_shape.to_vec() })
}

/// `obs/x` for `next_obs/x`, where both have the same type and shape and a row a step.
fn base_of(demo: &DemoPlan, path: &str) -> Option<String> {
    let base = format!("obs/{}", path.strip_prefix("next_obs/")?);
    let (this, other) = (demo.keys.get(path)?, demo.keys.get(&base)?);
    let same = this.dtype == other.dtype && this.shape == other.shape && this.dtype.size().is_some();
    (same && this.shape.first() == Some(&demo.length) && demo.length > 0).then_some(base)
}

/// Encodes the side folder's row groups on any thread.
pub(crate) struct SideEncoder {
    pub layout: Layout,
    frames: GroupEncoder,
    /// Image column of each dataset that became one.
    pictures: BTreeMap<String, String>,
    /// Datasets of pictures that are videos only.
    left_out: BTreeSet<String>,
}

/// What the side folder gets from one row group of frames.
pub(crate) struct SideOutput {
    /// Absent where no dataset became a column.
    pub group: Option<EncodedGroup>,
    /// Objects by episode; `Shifted` ones may come in pieces.
    pub objects: Vec<(Part, Vec<Object>)>,
}

impl SideEncoder {
    pub(crate) fn new(
        root: &Path,
        plan: &Plan,
        job_columns: &[super::features::Column],
        video: Option<&VideoOptions>,
    ) -> Result<Self> {
        let (mut pictures, mut left_out) = (BTreeMap::new(), BTreeSet::new());
        for column in job_columns {
            match (&column.origin, video) {
                (Origin::Image { key, jpeg: false, .. }, None) => {
                    pictures.insert(key.clone(), column.name.clone());
                }
                // float64 is not exact in its column
                (Origin::Depth { key, dtype, kind, .. }, _) if kind.dtype() == *dtype => {
                    pictures.insert(key.clone(), column.name.clone());
                }
                (Origin::Image { key, .. }, Some(options)) if !options.side_pictures => {
                    left_out.insert(key.replacen("obs/", "next_obs/", 1));
                    left_out.insert(key.clone());
                }
                // video is not exact, and a JPEG file's row has more than the file: kept like any other dataset
                _ => {}
            }
        }
        let layout = layout(plan, &pictures, &left_out);
        let frames = frame_encoder(root, &layout)?;
        Ok(Self { layout, frames, pictures, left_out })
    }

    /// Encodes the part of the side folder that belongs to a row group.
    pub(crate) fn encode(&self, job: &Job<'_>, loaded: &[Loaded]) -> Result<SideOutput> {
        let total: usize = loaded.iter().map(|l| l.part.rows.len()).sum();
        let mut arrays = Vec::with_capacity(self.layout.columns.len());
        for column in &self.layout.columns {
            let width = column.row_bytes();
            let mut bytes = MutableBuffer::with_capacity(total * width);
            let mut present = Vec::with_capacity(loaded.len());
            for l in loaded {
                let demo = &job.source.plan().demos[l.part.episode];
                let key = demo.keys.get(&column.path);
                let here = key.is_some_and(|k| column.fits(&k.dtype, &k.shape, demo.length));
                present.push((l.part.rows.len(), here));
                if here {
                    self.rows(job, l, &column.path, width, l.part.rows.clone(), &mut |b| bytes.extend_from_slice(b))?;
                } else {
                    bytes.resize(bytes.len() + l.part.rows.len() * width, 0);
                }
            }
            let nulls = present.iter().any(|(_, here)| !here).then(|| {
                let flags = present.iter().flat_map(|&(rows, here)| std::iter::repeat_n(here, rows));
                NullBuffer::new(BooleanBuffer::from_iter(flags))
            });
            arrays.push(column.array(bytes, total, nulls));
        }
        let group = match arrays.is_empty() {
            true => None,
            false => Some(self.frames.encode(&arrays).map_err(|source| DatasetError::Parquet {
                path: job.path.to_path_buf(),
                operation: "encode a row group of the side folder for it",
                source,
            })?),
        };
        let mut objects = Vec::with_capacity(loaded.len());
        for l in loaded {
            objects.push((l.part.clone(), self.objects(job, l)?));
        }
        Ok(SideOutput { group, objects })
    }

    /// Gives rows of a dataset to `take`: from memory where it was read whole, from the source otherwise.
    fn rows(
        &self,
        job: &Job<'_>,
        l: &Loaded,
        path: &str,
        width: usize,
        rows: std::ops::Range<usize>,
        take: &mut dyn FnMut(&[u8]),
    ) -> Result<()> {
        let wrong = |found: usize| InputError::WrongShape {
            path: job.path.to_path_buf(),
            demo: l.demo.id.clone(),
            key: path.to_owned(),
            expected: format!("{width} bytes a step in steps {rows:?}"),
            found: format!("{found} bytes"),
        };
        match l.demo.datasets.get(path) {
            Some(array) => {
                let part = array.bytes.get(rows.start * width..rows.end * width);
                take(part.ok_or_else(|| wrong(array.bytes.len()))?);
            }
            None => {
                let array = job.source.read_rows(l.part.episode, path, rows.start, rows.len())?;
                if array.bytes.len() != rows.len() * width {
                    return Err(wrong(array.bytes.len()).into());
                }
                take(&array.bytes);
            }
        }
        Ok(())
    }

    fn objects(&self, job: &Job<'_>, l: &Loaded) -> Result<Vec<Object>> {
        let demo = &job.source.plan().demos[l.part.episode];
        let mut objects = Vec::new();
        if l.part.begins() {
            objects.extend(attributes_and_groups(&l.demo));
            for (path, column) in &self.pictures {
                if let Some(key) = demo.keys.get(path) {
                    let array = Array { dtype: key.dtype.clone(), shape: key.shape.to_vec(), bytes: Vec::new() };
                    objects.push(Object {
                        kind: Kind::Picture,
                        path: path.clone(),
                        name: column.clone(),
                        rows: Vec::new(),
                        array: Some(array),
                    });
                }
            }
            let columns: BTreeSet<&str> = self
                .layout
                .columns
                .iter()
                .filter(|c| demo.keys.get(&c.path).is_some_and(|k| c.fits(&k.dtype, &k.shape, demo.length)))
                .map(|c| c.path.as_str())
                .collect();
            for (path, key) in &demo.keys {
                let elsewhere = self.pictures.contains_key(path) || self.left_out.contains(path);
                if columns.contains(path) || elsewhere || base_of(demo, path).is_some() {
                    continue;
                }
                let array = match l.demo.datasets.get(path) {
                    Some(array) => array.clone(),
                    None => job.source.read_rows(l.part.episode, path, 0, key.shape.first().copied().unwrap_or(0))?,
                };
                objects.push(Object::dataset(path, array));
            }
        }
        for (path, key) in &demo.keys {
            if let Some(base) = base_of(demo, path)
                && !self.left_out.contains(path)
                && !self.layout.columns.iter().any(|c| c.path == *path && c.fits(&key.dtype, &key.shape, demo.length))
            {
                objects.push(self.shifted(job, l, path, key, base)?);
            }
        }
        Ok(objects)
    }

    /// The rows in which `path` differs from `base` a step later; the last row always counts as different.
    fn shifted(&self, job: &Job<'_>, l: &Loaded, path: &str, key: &KeyPlan, base: String) -> Result<Object> {
        let width = key.dtype.size().unwrap_or(0) * key.shape[1..].iter().product::<usize>();
        let Part { rows, length, .. } = &l.part;
        let mut later = Vec::new();
        let until = (rows.end + 1).min(*length);
        if rows.start + 1 < until {
            self.rows(job, l, &base, width, rows.start + 1..until, &mut |b| later.extend_from_slice(b))?;
        }
        let mut different = Vec::new();
        let mut bytes = Vec::new();
        self.rows(job, l, path, width, rows.clone(), &mut |mine| {
            for (i, row) in rows.clone().enumerate() {
                let value = &mine[i * width..(i + 1) * width];
                if later.get(i * width..(i + 1) * width) != Some(value) || row + 1 == *length {
                    different.push(row);
                    bytes.extend_from_slice(value);
                }
            }
        })?;
        let array = Array { dtype: key.dtype.clone(), shape: key.shape.to_vec(), bytes };
        Ok(Object { kind: Kind::Shifted, path: path.to_owned(), name: base, rows: different, array: Some(array) })
    }
}

impl Object {
    pub(crate) fn dataset(path: &str, array: Array) -> Self {
        Self { kind: Kind::Dataset, path: path.to_owned(), name: String::new(), rows: Vec::new(), array: Some(array) }
    }

    fn size(&self) -> usize {
        64 + self.path.len() + 8 * self.rows.len() + self.array.as_ref().map_or(0, |a| a.bytes.len())
    }
}

/// Sets an attribute that is there to a number, in its type where that is a whole number.
pub(crate) fn count(attrs: &mut Attrs, name: &str, value: usize) {
    let Some(array) = attrs.get_mut(name) else { return };
    let bytes = (value as u64).to_le_bytes();
    *array = match (&array.dtype, array.len()) {
        (Dtype::I64 | Dtype::U64 | Dtype::I32 | Dtype::U32, 1) => {
            let size = array.dtype.size().unwrap_or(8);
            Array { bytes: bytes[..size].to_vec(), ..array.clone() }
        }
        _ => Array::from_i64(Vec::new(), &[value as i64]),
    };
}

fn attributes(path: &str, attrs: &Attrs, objects: &mut Vec<Object>) {
    objects.extend(attrs.iter().map(|(name, value)| Object {
        kind: Kind::Attribute,
        path: path.to_owned(),
        name: name.clone(),
        rows: Vec::new(),
        array: Some(value.clone()),
    }));
}

fn attributes_and_groups(demo: &Demo) -> Vec<Object> {
    let mut objects = Vec::new();
    attributes("", &demo.attrs, &mut objects);
    for (path, attrs) in &demo.inner_attrs {
        attributes(path, attrs, &mut objects);
    }
    objects.extend(demo.groups.iter().map(|path| Object {
        kind: Kind::Group,
        path: path.clone(),
        name: String::new(),
        rows: Vec::new(),
        array: None,
    }));
    objects
}

fn encoder(root: &Path, schema: Schema) -> Result<GroupEncoder> {
    writer_properties(&schema, Vec::new())
        .and_then(|properties| GroupEncoder::new(Arc::new(schema), properties))
        .map_err(|source| DatasetError::Parquet { path: root.join("actrm"), operation: "prepare writing it", source })
}

/// The encoder of the frames.
pub(crate) fn frame_encoder(root: &Path, layout: &Layout) -> Result<GroupEncoder> {
    encoder(root, Schema::new(layout.columns.iter().map(SideColumn::field).collect::<Vec<_>>()))
}

/// The encoder of the objects.
pub(crate) fn object_encoder(root: &Path) -> Result<GroupEncoder> {
    encoder(
        root,
        Schema::new(vec![
            Field::new("episode", DataType::Int64, false),
            Field::new("kind", DataType::Utf8, false),
            Field::new("path", DataType::Utf8, false),
            Field::new("name", DataType::Utf8, false),
            Field::new("dtype", DataType::Utf8, true),
            Field::new("shape", DataType::List(element(DataType::Int64)), false),
            Field::new("rows", DataType::List(element(DataType::Int64)), false),
            Field::new("bytes", DataType::Binary, true),
        ]),
    )
}

/// Writes the side folder: called in order, on one thread.
pub(crate) struct SideWriter<'a> {
    root: &'a Path,
    layout: &'a Layout,
    frames: ShardWriter<'a>,
    objects: ShardWriter<'a>,
    encoder: &'a GroupEncoder,
    waiting: Vec<(i64, Object)>,
    waiting_bytes: usize,
    /// Objects of the episode that comes in pieces.
    open: Vec<Object>,
}

impl<'a> SideWriter<'a> {
    /// Starts with what belongs to no demo. `frames` encodes the columns of `layout`, `encoder` the objects; files are
    /// closed at `limit` bytes.
    pub(crate) fn new(
        root: &'a Path,
        layout: &'a Layout,
        frames: &'a GroupEncoder,
        encoder: &'a GroupEncoder,
        limit: u64,
        rest: &Demo,
    ) -> Result<Self> {
        let mut writer = Self {
            root,
            layout,
            frames: ShardWriter::new(root, FRAMES, frames, limit, FILES_PER_FOLDER),
            objects: ShardWriter::new(root, OBJECTS, encoder, limit, FILES_PER_FOLDER),
            encoder,
            waiting: Vec::new(),
            waiting_bytes: 0,
            open: Vec::new(),
        };
        let mut objects = attributes_and_groups(rest);
        objects.extend(rest.datasets.iter().map(|(path, array)| Object::dataset(path, array.clone())));
        for object in objects {
            writer.push(NO_EPISODE, object)?;
        }
        Ok(writer)
    }

    /// Appends the next row group.
    pub(crate) fn append(&mut self, output: SideOutput) -> Result<()> {
        let begins = output.objects.first().is_some_and(|(part, _)| part.begins());
        if let Some(group) = output.group {
            self.frames.append(group, begins)?;
        }
        for (part, objects) in output.objects {
            for object in objects {
                self.join(object);
            }
            if part.ends() {
                for object in std::mem::take(&mut self.open) {
                    self.push(part.episode as i64, object)?;
                }
            }
        }
        Ok(())
    }

    /// Appends rows of the frames.
    pub(crate) fn append_frames(&mut self, group: EncodedGroup, begins_episode: bool) -> Result<Place> {
        self.frames.append(group, begins_episode)
    }

    /// Adds an object to the open episode; the pieces of a shifted dataset become one.
    fn join(&mut self, object: Object) {
        if object.kind == Kind::Shifted
            && let Some(before) = self.open.iter_mut().find(|o| o.kind == Kind::Shifted && o.path == object.path)
        {
            before.rows.extend(object.rows);
            if let (Some(a), Some(b)) = (&mut before.array, object.array) {
                a.bytes.extend(b.bytes);
            }
        } else {
            self.open.push(object);
        }
    }

    /// Appends an object of an episode.
    pub(crate) fn push(&mut self, episode: i64, object: Object) -> Result<()> {
        self.waiting_bytes += object.size();
        self.waiting.push((episode, object));
        if self.waiting_bytes > OBJECT_GROUP_BYTES { self.flush() } else { Ok(()) }
    }

    fn flush(&mut self) -> Result<()> {
        if self.waiting.is_empty() {
            return Ok(());
        }
        let arrays = object_arrays(&self.waiting);
        self.waiting.clear();
        self.waiting_bytes = 0;
        let group = self.encoder.encode(&arrays).map_err(|source| DatasetError::Parquet {
            path: self.root.join(OBJECTS),
            operation: "encode a row group of it",
            source,
        })?;
        self.objects.append(group, true)?;
        Ok(())
    }

    /// Closes everything; returns the files written.
    pub(crate) fn finish(mut self) -> Result<Vec<WrittenFile>> {
        self.flush()?;
        let mut files = self.frames.finish()?;
        files.extend(self.objects.finish()?);
        files.push(super::meta::write_json(self.root, LAYOUT_FILE, self.layout)?);
        Ok(files)
    }
}

fn object_arrays(objects: &[(i64, Object)]) -> Vec<ArrayRef> {
    let mut episode = Int64Builder::new();
    let (mut kind, mut path, mut name, mut dtype) =
        (StringBuilder::new(), StringBuilder::new(), StringBuilder::new(), StringBuilder::new());
    let list = || ListBuilder::new(Int64Builder::new()).with_field(element(DataType::Int64));
    let (mut shape, mut rows) = (list(), list());
    let mut bytes = BinaryBuilder::new();
    for (number, object) in objects {
        episode.append_value(*number);
        kind.append_value(object.kind.name());
        path.append_value(&object.path);
        name.append_value(&object.name);
        match &object.array {
            Some(array) => {
                dtype.append_value(serde_json::to_string(&array.dtype).expect("a type name is JSON"));
                shape.append_value(array.shape.iter().map(|&n| Some(n as i64)));
                bytes.append_value(&array.bytes);
            }
            None => {
                dtype.append_null();
                shape.append_value([]);
                bytes.append_null();
            }
        }
        rows.append_value(object.rows.iter().map(|&n| Some(n as i64)));
    }
    vec![
        Arc::new(episode.finish()),
        Arc::new(kind.finish()),
        Arc::new(path.finish()),
        Arc::new(name.finish()),
        Arc::new(dtype.finish()),
        Arc::new(shape.finish()),
        Arc::new(rows.finish()),
        Arc::new(bytes.finish()),
    ]
}

/// `actrm/manifest.json` over all other files.
pub(crate) fn write_manifest(root: &Path, files: &[WrittenFile]) -> Result<WrittenFile> {
    let files = files.iter().map(|f| (f.path.clone(), f.sha256.clone())).collect();
    super::meta::write_json(root, MANIFEST_FILE, &Manifest { format: 1, files })
}
