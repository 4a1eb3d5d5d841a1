//! What a shard keeps of a row group beside its encoded columns: what the group's episodes say of themselves, and the objects
//! of the side folder.

use super::super::encode::{ColumnSummary, GroupOutput, PartSummary, PictureSummary};
use super::super::shards::StoredGroups;
use super::super::side::{Kind, Object, SideOutput};
use super::super::values::Values;
use super::super::work::Part;
use crate::source::codec::{Taker, put_array, put_bytes, put_count, put_text};
use crate::stats::{FeatureStats, Sample};
use std::collections::BTreeMap;

/// The record of a row group.
pub(super) fn put(output: &GroupOutput, beside: Option<&SideOutput>) -> Vec<u8> {
    let mut out = Vec::new();
    put_count(&mut out, output.group.bytes as usize);
    let of_side = beside.and_then(|side| side.group.as_ref());
    put_count(&mut out, usize::from(of_side.is_some()));
    put_count(&mut out, of_side.map_or(0, |group| group.bytes as usize));
    put_count(&mut out, output.parts.len());
    for summary in &output.parts {
        let Part { episode, length, first_frame, rows } = &summary.part;
        [*episode, *length, *first_frame, rows.start, rows.end].into_iter().for_each(|n| put_count(&mut out, n));
        put_count(&mut out, summary.values.len());
        for column in &summary.values {
            put_values(&mut out, &column.values);
            put_stats(&mut out, column.stats.as_ref());
            out.extend_from_slice(&column.digest);
        }
        put_count(&mut out, summary.pictures.len());
        for (column, pictures) in &summary.pictures {
            put_count(&mut out, *column);
            put_pictures(&mut out, pictures);
        }
    }
    put_count(&mut out, beside.map_or(0, |side| side.objects.len()));
    for (_, objects) in beside.iter().flat_map(|side| &side.objects) {
        put_count(&mut out, objects.len());
        for object in objects {
            put_text(&mut out, object.kind.name());
            put_text(&mut out, &object.path);
            put_text(&mut out, &object.name);
            put_count(&mut out, object.rows.len());
            object.rows.iter().for_each(|&row| put_count(&mut out, row));
            put_count(&mut out, usize::from(object.array.is_some()));
            object.array.iter().for_each(|array| put_array(&mut out, array));
        }
    }
    out
}

/// Takes a record back, with the row groups that belong to it; `None` where the bytes are something else.
pub(super) fn take(
    bytes: &[u8],
    data: &mut StoredGroups,
    side: Option<&mut StoredGroups>,
    lossless: bool,
) -> Option<(GroupOutput, Option<SideOutput>)> {
    let mut from = Taker(bytes);
    let group = data.next(from.count()? as u64)?;
    let (has_side, side_bytes) = (from.count()? == 1, from.count()?);
    let of_side = if has_side { Some(side?.next(side_bytes as u64)?) } else { None };
    let mut parts = Vec::new();
    for _ in 0..from.count()? {
        let part = Part {
            episode: from.count()?,
            length: from.count()?,
            first_frame: from.count()?,
            rows: from.count()?..from.count()?,
        };
        let values = (0..from.count()?).map(|_| {
            Some(ColumnSummary { values: values(&mut from)?, stats: stats(&mut from)?, digest: digest(&mut from)? })
        });
        let values = values.collect::<Option<_>>()?;
        let pictures = (0..from.count()?).map(|_| Some((from.count()?, pictures(&mut from)?)));
        let pictures = pictures.collect::<Option<BTreeMap<_, _>>>()?;
        parts.push(PartSummary { part, values, pictures });
    }
    let mut objects = Vec::new();
    for at in 0..from.count()? {
        let of_part = (0..from.count()?).map(|_| object(&mut from)).collect::<Option<_>>()?;
        objects.push((parts.get(at)?.part.clone(), of_part));
    }
    let beside = lossless.then_some(SideOutput { group: of_side, objects });
    from.0.is_empty().then_some((GroupOutput { group, parts }, beside))
}

fn put_values(out: &mut Vec<u8>, values: &Values) {
    fn numbers<T: Sample>(out: &mut Vec<u8>, kind: usize, values: &[T]) {
        put_count(out, kind);
        put_count(out, values.len() * T::BYTES);
        values.iter().for_each(|value| value.put(out));
    }
    match values {
        Values::F32(v) => numbers(out, 0, v),
        Values::F64(v) => numbers(out, 1, v),
        Values::I64(v) => numbers(out, 2, v),
        Values::Bool(v) => {
            put_count(out, 3);
            put_bytes(out, &v.iter().map(|&b| u8::from(b)).collect::<Vec<u8>>());
        }
        Values::Pictures => put_count(out, 4),
    }
}

fn values(from: &mut Taker<'_>) -> Option<Values> {
    fn numbers<T: Sample>(from: &mut Taker<'_>) -> Option<Vec<T>> {
        Some(from.bytes()?.chunks_exact(T::BYTES).map(T::from_bytes).collect())
    }
    Some(match from.count()? {
        0 => Values::F32(numbers(from)?),
        1 => Values::F64(numbers(from)?),
        2 => Values::I64(numbers(from)?),
        3 => Values::Bool(from.bytes()?.iter().map(|&b| b == 1).collect()),
        4 => Values::Pictures,
        _ => return None,
    })
}

fn put_stats(out: &mut Vec<u8>, stats: Option<&FeatureStats>) {
    put_count(out, usize::from(stats.is_some()));
    let Some(stats) = stats else { return };
    put_count(out, stats.count as usize);
    for vector in stats.vectors() {
        put_count(out, vector.len() * f64::BYTES);
        vector.iter().for_each(|value| value.put(out));
    }
}

fn stats(from: &mut Taker<'_>) -> Option<Option<FeatureStats>> {
    if from.count()? == 0 {
        return Some(None);
    }
    let count = from.count()? as u64;
    let mut vectors: [Vec<f64>; 9] = Default::default();
    for vector in &mut vectors {
        *vector = from.bytes()?.chunks_exact(f64::BYTES).map(f64::from_bytes).collect();
    }
    Some(Some(FeatureStats::from_vectors(count, vectors)))
}

fn digest(from: &mut Taker<'_>) -> Option<[u8; 32]> {
    let (digest, rest) = from.0.split_first_chunk()?;
    from.0 = rest;
    Some(*digest)
}

fn put_pictures(out: &mut Vec<u8>, pictures: &PictureSummary) {
    let PictureSummary { digests, samples, histograms, depth, sampled, settled: _ } = pictures;
    put_bytes(out, digests.as_flattened());
    put_count(out, samples.len());
    for sample in samples {
        // 2: a key frame with parameters
        put_count(out, usize::from(sample.key) + usize::from(!sample.parameters.is_empty()));
        put_bytes(out, &sample.bytes);
        if !sample.parameters.is_empty() {
            put_bytes(out, &sample.parameters);
        }
    }
    put_count(out, histograms.len());
    histograms.as_flattened().iter().for_each(|&count| put_count(out, count as usize));
    put_count(out, depth.len() * f32::BYTES);
    depth.iter().for_each(|value| value.put(out));
    put_count(out, *sampled as usize);
}

fn pictures(from: &mut Taker<'_>) -> Option<PictureSummary> {
    let digests = from.bytes()?.as_chunks().0.to_vec();
    let samples = (0..from.count()?)
        .map(|_| {
            let (kind, bytes) = (from.count()?, from.bytes()?.to_vec());
            let parameters = if kind == 2 { from.bytes()?.to_vec() } else { Vec::new() };
            Some(video::Sample { bytes, key: kind > 0, parameters })
        })
        .collect::<Option<_>>()?;
    let mut histograms = Vec::new();
    for _ in 0..from.count()? {
        let mut histogram = [0; 256];
        for count in &mut histogram {
            *count = from.count()? as u64;
        }
        histograms.push(histogram);
    }
    let depth = from.bytes()?.chunks_exact(f32::BYTES).map(f32::from_bytes).collect();
    Some(PictureSummary { digests, samples, histograms, depth, sampled: from.count()? as u64, settled: None })
}

fn object(from: &mut Taker<'_>) -> Option<Object> {
    let kind = from.text()?;
    Some(Object {
        kind: Kind::ALL.iter().find(|(_, name)| *name == kind)?.0,
        path: from.text()?,
        name: from.text()?,
        rows: (0..from.count()?).map(|_| from.count()).collect::<Option<_>>()?,
        array: match from.count()? {
            0 => None,
            _ => Some(from.array()?),
        },
    })
}
