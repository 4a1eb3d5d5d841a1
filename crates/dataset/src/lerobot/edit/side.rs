//! The side folder of a result: the rows and objects of the episodes taken, so that `export` gives a file of these demos.

use super::super::export::{Objects, Rows, column_array, rest};
use super::super::info::Provenance;
use super::super::shards::WrittenFile;
use super::super::side::{
    FRAMES, Kind, Layout, NO_EPISODE, Object, SideColumn, SideWriter, count, frame_encoder, object_encoder,
};
use super::Edit;
use super::groups::Groups;
use crate::error::{DatasetError, Result};
use crate::tree::{Array, Demo, Dtype};
use arrow_array::{ArrayRef, RecordBatch, new_null_array};
use std::collections::BTreeMap;
use std::sync::atomic::Ordering;

/// Rows of the side folder that are moved at once: pictures may be among them.
const ROWS: usize = 64;
/// Rows of numbers that are read at once.
const NUMBER_ROWS: usize = 1024;

/// Writes the side folder; `origin` has the demos' ids. Gives its files, and what of the inputs could not be kept.
pub(super) fn copy(edit: &Edit<'_>, origin: &Provenance) -> Result<(Vec<WrittenFile>, Vec<String>)> {
    let mut notes = Vec::new();
    let layout = layout(edit);
    let (frames, objects) = (frame_encoder(edit.root, &layout)?, object_encoder(edit.root)?);
    let limit = (edit.inputs[0].set.info().data_files_size_in_mb * f64::from(1 << 20)) as u64;
    let mut stored = edit.inputs.iter().map(|input| Objects::open(input.set.root())).collect::<Result<Vec<_>>>()?;
    let mut rests = Vec::with_capacity(stored.len());
    for (input, objects) in edit.inputs.iter().zip(&mut stored) {
        rests.push(rest(input.set.root(), objects.of(NO_EPISODE)?)?);
    }
    let belongs_to_none = Rest { edit, ids: &origin.demos }.of(rests, origin, &mut notes);
    let mut writer = SideWriter::new(edit.root, &layout, &frames, &objects, limit, &belongs_to_none)?;
    let mut groups = Groups::new(edit.root, &frames, limit);
    let mut number = 0;
    for ((input, taken), objects) in edit.inputs.iter().zip(&edit.taken).zip(&mut stored) {
        let root = input.set.root();
        let own = input.layout.as_ref().map_or(&[][..], |layout| &layout.columns);
        let mut rows = match own.is_empty() {
            true => None,
            false => {
                let bulk = own.iter().any(|column| column.number_type().is_none());
                Some(Rows::open(root, FRAMES, None, if bulk { ROWS } else { NUMBER_ROWS })?)
            }
        };
        for episode in input.set.episodes() {
            if edit.ended.load(Ordering::Relaxed) {
                return Err(DatasetError::Stopped { path: root.to_path_buf() });
            }
            let mine = objects.of(episode.index as i64)?;
            if taken.binary_search(&episode.index).is_err() {
                rows.as_mut().map_or(Ok(()), |rows| rows.skip(episode.length))?;
                continue;
            }
            let mut append = |group, begins| writer.append_frames(group, begins);
            if !layout.columns.is_empty() {
                groups.begin(episode.length, &mut append)?;
            }
            let mut apart: Vec<RecordBatch> = Vec::new();
            let misfits: Vec<usize> = (0..own.len()).filter(|&at| !layout.columns.contains(&own[at])).collect();
            // pieces of an episode that is cut end where they always did
            let at_once = if groups.holds(episode.length) { NUMBER_ROWS } else { ROWS };
            for from in (0..episode.length).step_by(at_once) {
                let count = at_once.min(episode.length - from);
                let batches = match &mut rows {
                    Some(rows) => rows.take(count)?,
                    None => Vec::new(),
                };
                for arrays in columns(&layout, own, &batches, count).into_iter().filter(|arrays| !arrays.is_empty()) {
                    groups.push(arrays, &mut append)?;
                }
                if !misfits.is_empty() {
                    apart.extend(batches);
                }
            }
            for object in mine {
                writer.push(number, edit.renamed(object))?;
            }
            // a column of another type or shape than the first set's is kept whole
            for at in misfits {
                if let Some(array) = column_array(root, &own[at], &apart, at, episode.length)? {
                    writer.push(number, Object::dataset(&own[at].path, array))?;
                }
            }
            number += 1;
        }
    }
    groups.finish(&mut |group, begins| writer.append_frames(group, begins))?;
    Ok((writer.finish()?, notes))
}

/// The columns of all inputs; of those with one path the first.
fn layout(edit: &Edit<'_>) -> Layout {
    let mut columns: BTreeMap<&str, &SideColumn> = BTreeMap::new();
    for column in edit.inputs.iter().flat_map(|input| &input.layout).flat_map(|layout| &layout.columns) {
        columns.entry(&column.path).or_insert(column);
    }
    Layout { format: 1, columns: columns.into_values().cloned().collect() }
}

/// Rows of an input as the result's columns have them, null where the input has no such column.
fn columns(layout: &Layout, own: &[SideColumn], batches: &[RecordBatch], count: usize) -> Vec<Vec<ArrayRef>> {
    let piece = |batch: Option<&RecordBatch>, rows: usize| -> Vec<ArrayRef> {
        let column = |column: &SideColumn| match (own.iter().position(|mine| mine == column), batch) {
            (Some(at), Some(batch)) => ArrayRef::clone(batch.column(at)),
            _ => new_null_array(column.field().data_type(), rows),
        };
        layout.columns.iter().map(column).collect()
    };
    match batches.is_empty() {
        true => vec![piece(None, count)],
        false => batches.iter().map(|batch| piece(Some(batch), batch.num_rows())).collect(),
    }
}

impl Edit<'_> {
    /// An object that names a column of pictures, with the column's new name.
    fn renamed(&self, mut object: Object) -> Object {
        if object.kind == Kind::Picture
            && let Some(new) = self.renames.get(&object.name)
        {
            object.name.clone_from(new);
        }
        object
    }
}

/// What belongs to no demo.
struct Rest<'a> {
    edit: &'a Edit<'a>,
    /// Ids of the result's demos.
    ids: &'a [String],
}

impl Rest<'_> {
    /// What all inputs have alike, with masks and counts that follow from the demos.
    fn of(&self, rests: Vec<Demo>, origin: &Provenance, notes: &mut Vec<String>) -> Demo {
        let masks = self.masks(&rests);
        let mut rests = rests.into_iter();
        let mut agreed = rests.next().unwrap_or_default();
        let counted = |name: &str| ["total", "num_demos", "seeds"].contains(&name);
        for other in rests {
            let mut left_out = Vec::new();
            agreed.datasets.retain(|path, array| {
                let same = path.starts_with("mask/") || other.datasets.get(path) == Some(array);
                if !same {
                    left_out.push(path.clone());
                }
                same
            });
            for (path, attrs) in std::iter::once((String::new(), &mut agreed.attrs))
                .chain(agreed.inner_attrs.iter_mut().map(|(path, attrs)| (path.clone(), attrs)))
            {
                let theirs = if path.is_empty() { Some(&other.attrs) } else { other.inner_attrs.get(&path) };
                attrs.retain(|name, value| {
                    let same = path == "data" && counted(name) || theirs.and_then(|t| t.get(name)) == Some(value);
                    if !same {
                        left_out.push(format!("{path}/{name}"));
                    }
                    same
                });
            }
            agreed.groups.retain(|path| other.groups.contains(path));
            if !left_out.is_empty() {
                notes.push(format!("the sets differ in {}, which the side folder leaves out", left_out.join(", ")));
            }
        }
        agreed.inner_attrs.retain(|_, attrs| !attrs.is_empty());
        agreed.datasets.extend(masks);
        let paths: Vec<String> = agreed.datasets.keys().cloned().collect();
        agreed.groups.retain(|group| !paths.iter().any(|path| path.starts_with(&format!("{group}/"))));
        if let Some(data) = agreed.inner_attrs.get_mut("data").filter(|_| !self.is_whole()) {
            let lengths = self.edit.inputs.iter().zip(&self.edit.taken);
            let frames: usize = lengths.flat_map(|(i, taken)| taken.iter().map(|&e| i.set.episodes()[e].length)).sum();
            count(data, "total", frames);
            count(data, "num_demos", self.ids.len());
            if let (Some(seeds), true) = (&origin.seeds, data.contains_key("seeds")) {
                data.insert("seeds".to_owned(), Array::from_str(seeds));
            }
        }
        agreed
    }

    /// Whether nothing was dropped and nothing added.
    fn is_whole(&self) -> bool {
        matches!((self.edit.inputs, self.edit.taken.as_slice()), ([input], [taken]) if taken.len() == input.set.episodes().len())
    }

    /// The masks as datasets, without the demos that were dropped.
    fn masks(&self, rests: &[Demo]) -> BTreeMap<String, Array> {
        let mut masks: BTreeMap<String, (Array, Option<Vec<String>>)> = BTreeMap::new();
        let mut ids = self.ids.iter();
        for ((input, taken), rest) in self.edit.inputs.iter().zip(&self.edit.taken).zip(rests) {
            let new: BTreeMap<usize, &String> = taken.iter().copied().zip(&mut ids).collect();
            let known: BTreeMap<&str, usize> =
                input.set.episodes().iter().filter_map(|e| Some((e.demo.as_deref()?, e.index))).collect();
            let stays = |id: String| match known.get(id.as_str()) {
                Some(episode) => new.get(episode).map(|id| (*id).clone()),
                // named, but not there: in another set it would be another demo
                None => (self.edit.inputs.len() == 1).then_some(id),
            };
            for (path, array) in rest.datasets.iter().filter(|(path, _)| path.starts_with("mask/")) {
                let named = array.to_strings().filter(|_| array.shape.len() == 1);
                let named = named.map(|ids| ids.into_iter().filter_map(stays).collect::<Vec<_>>());
                match masks.get_mut(path) {
                    Some((_, Some(before))) => before.extend(named.unwrap_or_default()),
                    Some(_) => {}
                    None => drop(masks.insert(path.clone(), (array.clone(), named))),
                }
            }
        }
        let stored =
            |(like, ids): (Array, Option<Vec<String>>)| ids.map_or(like.clone(), |ids| texts_like(&like, &ids));
        masks.into_iter().map(|(path, mask)| (path, stored(mask))).collect()
    }
}

/// Texts in the type of another array of texts, at least as wide.
pub(in crate::lerobot) fn texts_like(like: &Array, texts: &[String]) -> Array {
    let shape = vec![texts.len()];
    match like.dtype {
        Dtype::FixedStr(width) | Dtype::FixedUtf8(width) => {
            let width = texts.iter().map(String::len).max().unwrap_or(0).max(width);
            let mut bytes = Vec::with_capacity(width * texts.len());
            for text in texts {
                bytes.extend_from_slice(text.as_bytes());
                bytes.resize(bytes.len() + width - text.len(), 0);
            }
            let dtype = match like.dtype {
                Dtype::FixedUtf8(_) => Dtype::FixedUtf8(width),
                _ => Dtype::FixedStr(width),
            };
            Array { dtype, shape, bytes }
        }
        _ => Array { dtype: like.dtype.clone(), ..Array::from_strings(shape, texts) },
    }
}
