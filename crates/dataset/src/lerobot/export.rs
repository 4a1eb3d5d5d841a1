//! From a converted data set back to the robomimic file that it was made of: every group, dataset, type, shape,
//! attribute and value.

use super::images;
use super::info::Info;
use super::open::{read_episodes, read_info, read_json};
use super::pictures::image_files;
use super::read;
use super::side::{
    FRAMES, Kind, LAYOUT_FILE, Layout, MANIFEST_FILE, Manifest, NO_EPISODE, OBJECTS, Object, SideColumn,
};
use super::tiff;
use super::to_robomimic;
use super::verify::hash_file;
use crate::error::{DatasetError, Result};
use crate::plan::Dialect;
use crate::source::{RobomimicWriter, WriteOptions};
use crate::tree::{Array, Attrs, Demo, Dtype};
use arrow_array::{
    Array as _, ArrayRef, BinaryArray, FixedSizeBinaryArray, FixedSizeListArray, Float32Array, Float64Array,
    Int32Array, Int64Array, ListArray, RecordBatch, StringArray,
};
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::ParquetRecordBatchReader;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What an export did.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ExportReport {
    /// Demos written.
    pub demos: usize,
    /// Steps written.
    pub frames: usize,
    /// What was left out or is not as it was.
    pub notes: Vec<String>,
}

/// Makes a robomimic file of the data set `root` at `out`, which must not exist: rebuilds the one that it was converted from
/// where the side folder keeps all of it, and makes one of the columns otherwise.
///
/// The files of the side folder are first compared with their recorded hashes. `progress` is told frames done
/// and frames in all.
pub fn export(
    root: &Path,
    out: &Path,
    options: &WriteOptions,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<ExportReport> {
    let info = read_info(root)?;
    let of_side = info.actrm.as_ref().filter(|p| p.lossless);
    let exact = of_side.is_some_and(|p| p.video.as_ref().is_none_or(|video| video.side_pictures));
    if !exact {
        return to_robomimic::from_columns(root, out, options, progress);
    }
    let layout = side_folder(root, &info)?;
    let episodes = read_episodes(root, &info)?;
    let demos = info.actrm.as_ref().map_or(&[][..], |p| &p.demos);
    if demos.len() != episodes.len() {
        return Err(DatasetError::BadDataset {
            path: root.to_path_buf(),
            object: "demo ids".to_owned(),
            expected: format!("one for each of {} episodes", episodes.len()),
            found: demos.len().to_string(),
        });
    }
    let mut objects = Objects::open(root)?;
    let mut frames = match layout.columns.is_empty() {
        true => None,
        false => Some(Rows::open(root, FRAMES, None, 1024)?),
    };
    let mut pictures: BTreeMap<String, Rows> = BTreeMap::new();
    let mut writer = RobomimicWriter::create(out, options)?;
    let mut outside = rest(root, objects.of(NO_EPISODE)?)?;
    // a recording of another layout lacks what robomimic needs
    let foreign = info.actrm.as_ref().is_some_and(|p| !Dialect::is_robomimics(&p.dialect));
    if foreign {
        to_robomimic::complete_root(&mut outside, &info);
    }
    writer.set_root(&outside)?;
    let total = info.total_frames as u64;
    progress(0, total);
    for (episode, id) in episodes.iter().zip(demos) {
        let mut demo = Demo { id: id.clone(), ..Demo::default() };
        if let Some(frames) = &mut frames {
            let batches = frames.take(episode.length)?;
            for (index, column) in layout.columns.iter().enumerate() {
                if let Some(array) = column_array(root, column, &batches, index, episode.length)? {
                    demo.datasets.insert(column.path.clone(), array);
                }
            }
        }
        let mut shifted = Vec::new();
        for object in objects.of(episode.index as i64)? {
            match object.kind {
                Kind::Shifted => shifted.push(object),
                Kind::Picture => {
                    let array = picture_array(root, &object, &mut pictures, &info, episode.length)?;
                    demo.datasets.insert(object.path, array);
                }
                _ => insert(root, &mut demo, object)?,
            }
        }
        for object in shifted {
            let array = unshift(root, &demo, &object)?;
            demo.datasets.insert(object.path, array);
        }
        if foreign {
            to_robomimic::complete(&mut demo, episode.length, episode.tasks.first().map(String::as_str));
        }
        writer.add_demo(&demo)?;
        progress(episode.to as u64, total);
    }
    writer.finish()?;
    let notes = to_robomimic::columns_of_others(root)?.into_iter().collect();
    Ok(ExportReport { demos: episodes.len(), frames: info.total_frames, notes })
}

/// The layout of the side folder, once its files are known to be those that were written.
pub(crate) fn side_folder(root: &Path, info: &Info) -> Result<Layout> {
    side_folder_of(root, info, &|_| true)
}

/// [`side_folder`] that compares only the hashes of the files that are `checked`.
pub(crate) fn side_folder_of(root: &Path, info: &Info, checked: &dyn Fn(&str) -> bool) -> Result<Layout> {
    let manifest_path = root.join(MANIFEST_FILE);
    if !manifest_path.exists() {
        let found = match info.actrm {
            Some(_) => "a data set that was converted without one (--no-lossless)",
            None => "a data set that was not converted from demonstrations",
        };
        return Err(DatasetError::NotInDataset {
            path: root.to_path_buf(),
            wanted: "side folder actrm/ to rebuild the file from".to_owned(),
            found: found.to_owned(),
        });
    }
    let manifest: Manifest = read_json(&manifest_path)?;
    for (name, expected) in manifest.files.iter().filter(|(name, _)| checked(name)) {
        let found = hash_file(&root.join(name))?;
        if found != *expected {
            return Err(DatasetError::BadDataset {
                path: root.join(name),
                object: "sha256".to_owned(),
                expected: expected.clone(),
                found,
            });
        }
    }
    let layout: Layout = read_json(&root.join(LAYOUT_FILE))?;
    if layout.format != 1 {
        return Err(DatasetError::BadDataset {
            path: root.join(LAYOUT_FILE),
            object: "format".to_owned(),
            expected: "1".to_owned(),
            found: layout.format.to_string(),
        });
    }
    Ok(layout)
}

fn bad_object(root: &Path, object: &Object, expected: &str) -> DatasetError {
    DatasetError::BadDataset {
        path: root.join(OBJECTS),
        object: format!("{} {}", object.path, object.name),
        expected: expected.to_owned(),
        found: format!("{:?} in {} rows", object.array.as_ref().map(|a| (&a.dtype, &a.shape)), object.rows.len()),
    }
}

/// What belongs to no demo.
pub(crate) fn rest(root: &Path, objects: Vec<Object>) -> Result<Demo> {
    let mut demo = Demo::default();
    for object in objects {
        insert(root, &mut demo, object)?;
    }
    Ok(demo)
}

fn insert(root: &Path, demo: &mut Demo, object: Object) -> Result<()> {
    match (object.kind, object.array) {
        (Kind::Group, _) => {
            demo.groups.insert(object.path);
        }
        (Kind::Attribute, Some(array)) => {
            let attrs: &mut Attrs = match object.path.is_empty() {
                true => &mut demo.attrs,
                false => demo.inner_attrs.entry(object.path).or_default(),
            };
            attrs.insert(object.name, array);
        }
        (Kind::Dataset, Some(array)) => {
            demo.datasets.insert(object.path, array);
        }
        (kind, array) => {
            let object = Object { kind, array, ..object };
            return Err(bad_object(root, &object, "an attribute, group or dataset with its value"));
        }
    }
    Ok(())
}

/// Puts the rows that differ over the base dataset, moved by a step.
fn unshift(root: &Path, demo: &Demo, object: &Object) -> Result<Array> {
    let wrong = || bad_object(root, object, "the rows in which it differs from its base dataset");
    let patch = object.array.as_ref().ok_or_else(wrong)?;
    let base = demo.datasets.get(&object.name).ok_or_else(wrong)?;
    let (rows, row_shape) = patch.shape.split_first().ok_or_else(wrong)?;
    let width = patch.dtype.size().ok_or_else(wrong)? * row_shape.iter().product::<usize>();
    if base.bytes.len() != rows * width || patch.bytes.len() != object.rows.len() * width || *rows == 0 {
        return Err(wrong());
    }
    let mut bytes = base.bytes[width..].to_vec();
    bytes.resize(rows * width, 0);
    for (i, &row) in object.rows.iter().enumerate() {
        let place = bytes.get_mut(row * width..(row + 1) * width).ok_or_else(wrong)?;
        place.copy_from_slice(&patch.bytes[i * width..(i + 1) * width]);
    }
    Ok(Array { dtype: patch.dtype.clone(), shape: patch.shape.clone(), bytes })
}

/// One dataset of a demo from the side folder's frames; `None` where the demo has none.
pub(crate) fn column_array(
    root: &Path,
    column: &SideColumn,
    batches: &[RecordBatch],
    index: usize,
    length: usize,
) -> Result<Option<Array>> {
    let mut bytes = Vec::with_capacity(length * column.row_bytes());
    let mut nulls = 0;
    for batch in batches {
        nulls += batch.column(index).null_count();
        append_bytes(batch.column(index), &mut bytes);
    }
    if nulls == length && length > 0 {
        return Ok(None);
    }
    if nulls > 0 || bytes.len() != length * column.row_bytes() {
        return Err(DatasetError::BadDataset {
            path: root.join(FRAMES),
            object: format!("column {}", column.path),
            expected: format!("{length} rows of {} bytes", column.row_bytes()),
            found: format!("{} bytes and {nulls} nulls", bytes.len()),
        });
    }
    let shape = std::iter::once(length).chain(column.row_shape.iter().copied()).collect();
    Ok(Some(Array { dtype: column.dtype.clone(), shape, bytes }))
}

fn append_bytes(array: &ArrayRef, out: &mut Vec<u8>) {
    let any = array.as_any();
    if let Some(list) = any.downcast_ref::<FixedSizeListArray>() {
        append_bytes(list.values(), out);
    } else if let Some(a) = any.downcast_ref::<Float64Array>() {
        out.extend(a.values().iter().flat_map(|v| v.to_le_bytes()));
    } else if let Some(a) = any.downcast_ref::<Float32Array>() {
        out.extend(a.values().iter().flat_map(|v| v.to_le_bytes()));
    } else if let Some(a) = any.downcast_ref::<Int64Array>() {
        out.extend(a.values().iter().flat_map(|v| v.to_le_bytes()));
    } else if let Some(a) = any.downcast_ref::<Int32Array>() {
        out.extend(a.values().iter().flat_map(|v| v.to_le_bytes()));
    } else if let Some(a) = any.downcast_ref::<FixedSizeBinaryArray>() {
        out.extend((0..a.len()).flat_map(|i| a.value(i)));
    }
}

fn picture_array(
    root: &Path,
    object: &Object,
    open: &mut BTreeMap<String, Rows>,
    info: &Info,
    length: usize,
) -> Result<Array> {
    let wrong = || bad_object(root, object, "an image column of the data files");
    let feature = info.features.get(&object.name).ok_or_else(wrong)?;
    let (dtype, shape) = object.array.as_ref().map(|a| (a.dtype.clone(), a.shape.clone())).ok_or_else(wrong)?;
    let channels = if feature.is_depth() { 1 } else { 3 };
    let (rows, height, width, found) = match *shape.as_slice() {
        [rows, height, width, found] => (rows, height, width, found),
        // depth may come without an axis for its channel
        [rows, height, width] if feature.is_depth() => (rows, height, width, 1),
        _ => return Err(wrong()),
    };
    if rows != length || found != channels || feature.shape != [height, width, channels] {
        return Err(wrong());
    }
    if !open.contains_key(&object.name) {
        open.insert(object.name.clone(), Rows::open(root, "data", Some(&object.name), 32)?);
    }
    let cursor = open.get_mut(&object.name).expect("it was just opened");
    let mut bytes = Vec::with_capacity(shape.iter().product());
    for batch in cursor.take(length)? {
        match feature.is_depth() {
            true => depth_pixels(root, &object.name, &batch, (height, width), &dtype, &mut bytes)?,
            false => picture_pixels(root, &object.name, batch.column(0), height, width, &mut bytes)?,
        }
    }
    let dtype = if feature.is_depth() { dtype } else { Dtype::U8 };
    Ok(Array { dtype, shape, bytes })
}

/// Decodes the depth of a column, one frame after the other, which must be of the type that the source had.
fn depth_pixels(
    root: &Path,
    name: &str,
    batch: &RecordBatch,
    (height, width): (usize, usize),
    dtype: &Dtype,
    out: &mut Vec<u8>,
) -> Result<()> {
    each_file(root, name, batch.column(0), (height, width), &mut |file| match tiff::decode(file, height, width, out) {
        Ok(kind) if kind.dtype() == *dtype => Ok(()),
        Ok(kind) => Err(format!("{} instead of {dtype}", kind.dtype())),
        Err(found) => Err(found),
    })
}

/// Decodes the pictures of a column, one after the other.
pub(crate) fn picture_pixels(
    root: &Path,
    name: &str,
    column: &ArrayRef,
    height: usize,
    width: usize,
    out: &mut Vec<u8>,
) -> Result<()> {
    each_file(root, name, column, (height, width), &mut |file| images::decode(file, height, width, out))
}

/// Calls `take` with the file of every picture of a column; what it finds wrong is an error of the column's.
pub(super) fn each_file(
    root: &Path,
    name: &str,
    column: &ArrayRef,
    (height, width): (usize, usize),
    take: &mut dyn FnMut(&[u8]) -> Result<(), String>,
) -> Result<()> {
    let bad = |found: String| DatasetError::BadDataset {
        path: root.join("data"),
        object: format!("column {name}"),
        expected: format!("{height} x {width} images"),
        found,
    };
    let files = image_files(root, column).map_err(bad)?;
    files.iter().flatten().try_for_each(|file| take(file).map_err(bad))
}

/// The objects in order, an episode at a time.
pub(crate) struct Objects {
    root: PathBuf,
    /// None in a set without objects.
    rows: Option<Rows>,
    /// The first object of an episode that was not asked for yet.
    peeked: std::collections::VecDeque<(i64, Object)>,
}

impl Objects {
    /// Before the first one.
    pub(crate) fn open(root: &Path) -> Result<Self> {
        let rows = root.join(OBJECTS).exists().then(|| Rows::open(root, OBJECTS, None, 256)).transpose()?;
        Ok(Self { root: root.to_path_buf(), rows, peeked: std::collections::VecDeque::new() })
    }

    /// Those of an episode, or of [`NO_EPISODE`]; to be asked for in order.
    pub(crate) fn of(&mut self, episode: i64) -> Result<Vec<Object>> {
        let mut found = Vec::new();
        loop {
            if self.peeked.is_empty() {
                match self.rows.as_mut().map(Rows::next_batch).transpose()?.flatten() {
                    Some(batch) => self.peeked.extend(parse_objects(&self.root, &batch)?),
                    None => return Ok(found),
                }
            }
            match self.peeked.front() {
                Some((owner, _)) if *owner == episode => found.extend(self.peeked.pop_front().map(|(_, o)| o)),
                _ => return Ok(found),
            }
        }
    }
}

fn parse_objects(root: &Path, batch: &RecordBatch) -> Result<Vec<(i64, Object)>> {
    let bad = |what: &str| DatasetError::BadDataset {
        path: root.join(OBJECTS),
        object: "row".to_owned(),
        expected: "episode, kind, path, name, dtype, shape, rows and bytes".to_owned(),
        found: what.to_owned(),
    };
    fn column<'b, T: 'static>(batch: &'b RecordBatch, name: &str) -> Option<&'b T> {
        batch.column_by_name(name)?.as_any().downcast_ref::<T>()
    }
    let (Some(episode), Some(kind), Some(path), Some(name)) = (
        column::<Int64Array>(batch, "episode"),
        column::<StringArray>(batch, "kind"),
        column::<StringArray>(batch, "path"),
        column::<StringArray>(batch, "name"),
    ) else {
        return Err(bad("other columns"));
    };
    let (Some(dtype), Some(shape), Some(rows), Some(bytes)) = (
        column::<StringArray>(batch, "dtype"),
        column::<ListArray>(batch, "shape"),
        column::<ListArray>(batch, "rows"),
        column::<BinaryArray>(batch, "bytes"),
    ) else {
        return Err(bad("other columns"));
    };
    let sizes = |list: &ListArray, row: usize| -> Result<Vec<usize>> {
        let values = list.value(row);
        let values = values.as_any().downcast_ref::<Int64Array>().ok_or_else(|| bad("a list of no numbers"))?;
        values.values().iter().map(|&v| usize::try_from(v).ok().ok_or_else(|| bad("a negative number"))).collect()
    };
    let mut objects = Vec::with_capacity(batch.num_rows());
    for row in 0..batch.num_rows() {
        let (kind, _) =
            Kind::ALL.into_iter().find(|(_, text)| *text == kind.value(row)).ok_or_else(|| bad(kind.value(row)))?;
        let array = match dtype.is_null(row) {
            true => None,
            false => Some(Array {
                dtype: serde_json::from_str(dtype.value(row)).ok().ok_or_else(|| bad(dtype.value(row)))?,
                shape: sizes(shape, row)?,
                bytes: bytes.value(row).to_vec(),
            }),
        };
        let (path, name) = (path.value(row).to_owned(), name.value(row).to_owned());
        objects.push((episode.value(row), Object { kind, path, name, rows: sizes(rows, row)?, array }));
    }
    Ok(objects)
}

/// Rows of a folder of Parquet files, one after the other, with few in memory.
pub(crate) struct Rows {
    root: PathBuf,
    prefix: &'static str,
    files: std::vec::IntoIter<PathBuf>,
    column: Option<String>,
    batch_rows: usize,
    reader: Option<(PathBuf, ParquetRecordBatchReader)>,
    /// Rows of the files not yet opened that are passed over.
    passed: usize,
    /// What is left of the batch that was read last.
    rest: Option<RecordBatch>,
}

impl Rows {
    /// All columns, or one.
    pub(crate) fn open(root: &Path, prefix: &'static str, column: Option<&str>, batch_rows: usize) -> Result<Self> {
        Ok(Self {
            root: root.to_path_buf(),
            prefix,
            files: read::files(root, prefix)?.into_iter(),
            column: column.map(str::to_owned),
            batch_rows,
            reader: None,
            passed: 0,
            rest: None,
        })
    }

    fn next_batch(&mut self) -> Result<Option<RecordBatch>> {
        if let Some(rest) = self.rest.take() {
            return Ok(Some(rest));
        }
        loop {
            if let Some((path, reader)) = &mut self.reader
                && let Some(batch) = reader.next()
            {
                let failed = |source| DatasetError::Parquet { path: path.clone(), operation: "read it", source };
                return batch.map(Some).map_err(|e| failed(e.into()));
            }
            let Some(path) = self.files.next() else { return Ok(None) };
            let failed = |source| DatasetError::Parquet { path: path.clone(), operation: "read it", source };
            let mut builder = read::open(&path)?.with_batch_size(self.batch_rows);
            if let Some(column) = &self.column {
                let index = builder.schema().index_of(column).ok();
                let index = index.ok_or_else(|| read::missing_column(&path, column, &builder))?;
                let mask = ProjectionMask::roots(builder.parquet_schema(), [index]);
                builder = builder.with_projection(mask);
            }
            let passed = self.passed.min(usize::try_from(builder.metadata().file_metadata().num_rows()).unwrap_or(0));
            self.passed -= passed;
            let reader = builder.with_offset(passed).build().map_err(failed)?;
            self.reader = Some((path, reader));
        }
    }

    /// The next `rows` rows, in one or more pieces.
    pub(crate) fn take(&mut self, rows: usize) -> Result<Vec<RecordBatch>> {
        let mut pieces = Vec::new();
        let mut missing = rows;
        while missing > 0 {
            let piece = self.next_rows(missing)?;
            missing -= piece.num_rows();
            pieces.push(piece);
        }
        Ok(pieces)
    }

    /// The next rows, `missing` of them or fewer: they lie in [`Rows::file`].
    pub(crate) fn next_rows(&mut self, missing: usize) -> Result<RecordBatch> {
        let Some(batch) = self.next_batch()? else {
            return Err(DatasetError::BadDataset {
                path: self.root.join(self.prefix),
                object: "rows".to_owned(),
                expected: format!("{missing} more"),
                found: "the end".to_owned(),
            });
        };
        if batch.num_rows() > missing {
            self.rest = Some(batch.slice(missing, batch.num_rows() - missing));
        }
        Ok(batch.slice(0, batch.num_rows().min(missing)))
    }

    /// Passes over the next rows, with few of them in memory.
    pub(crate) fn skip(&mut self, rows: usize) -> Result<()> {
        let mut missing = rows;
        if self.reader.is_none() {
            // nothing is unpacked of what comes before the first row
            self.passed += std::mem::take(&mut missing);
        }
        while missing > 0 {
            missing -= self.next_rows(missing)?.num_rows();
        }
        Ok(())
    }

    /// The file that was read last.
    pub(crate) fn file(&self) -> &Path {
        self.reader.as_ref().map_or(&self.root, |(path, _)| path)
    }
}
