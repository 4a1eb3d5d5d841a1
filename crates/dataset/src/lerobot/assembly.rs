//! A data set put together of encoded row groups in order: by a conversion as it encodes them, by a merge as it reads them
//! from shards. Both come to the same bytes.

use super::check;
use super::convert::ConvertReport;
use super::encode::GroupOutput;
use super::info::{FILES_PER_FOLDER, Feature, Info};
use super::meta;
use super::schema;
use super::shards::{GroupEncoder, ShardWriter};
use super::side::{self, Layout, SideOutput, SideWriter};
use super::tally::Tally;
use super::videos::VideoWriter;
use crate::error::{DatasetError, Result};
use crate::plan::Dialect;
use crate::stats::FeatureStats;
use crate::tree::Demo;
use std::collections::BTreeMap;
use std::path::Path;

/// What a data set says of itself before its frames are known.
pub(super) struct Head {
    pub dialect: Dialect,
    /// Still without fingerprint and hash of the source.
    pub info: Info,
    /// Task texts in order of first use, and each episode's.
    pub tasks: Vec<String>,
    pub task_of: Vec<usize>,
    /// Columns of the side folder, where there is one.
    pub layout: Option<Layout>,
    /// What is noted before and after what the values give rise to.
    pub notes: Vec<String>,
    pub last_notes: Vec<String>,
}

/// A size in MiB in bytes.
pub(super) fn bytes_of(mib: f64) -> u64 {
    (mib * f64::from(1 << 20)) as u64
}

/// What encodes the row groups of a data set.
pub(super) struct Encoders {
    pub data: GroupEncoder,
    /// Frames and objects of the side folder.
    side: Option<(GroupEncoder, GroupEncoder)>,
}

impl Encoders {
    pub(super) fn new(root: &Path, head: &Head) -> Result<Self> {
        let arrow_schema = schema::data_schema(&head.info.features);
        let metadata = vec![schema::huggingface_metadata(&head.info.features)];
        let data = schema::writer_properties(&arrow_schema, metadata)
            .and_then(|properties| GroupEncoder::new(arrow_schema, properties))
            .map_err(|source| DatasetError::Parquet {
                path: root.join("data"),
                operation: "prepare writing it",
                source,
            })?;
        let side = match &head.layout {
            Some(layout) => Some((side::frame_encoder(root, layout)?, side::object_encoder(root)?)),
            None => None,
        };
        Ok(Self { data, side })
    }

    /// That of the side folder's frames.
    pub(super) fn side_frames(&self) -> Option<&GroupEncoder> {
        self.side.as_ref().map(|(frames, _)| frames)
    }
}

/// A data set that is being put together.
pub(super) struct Assembly<'a> {
    root: &'a Path,
    head: &'a Head,
    data: ShardWriter<'a>,
    side: Option<SideWriter<'a>>,
    films: VideoWriter<'a>,
    tally: Tally<'a>,
}

impl<'a> Assembly<'a> {
    /// Nothing yet, in the empty folder `root`; `rest` is what the side folder keeps of no demo.
    pub(super) fn new(root: &'a Path, head: &'a Head, encoders: &'a Encoders, rest: Option<&Demo>) -> Result<Self> {
        let Info { features, fps, data_files_size_in_mb, video_files_size_in_mb, .. } = &head.info;
        let limit = bytes_of(*data_files_size_in_mb);
        let side = match (&head.layout, &encoders.side, rest) {
            (Some(layout), Some((frames, objects)), Some(rest)) => {
                Some(SideWriter::new(root, layout, frames, objects, limit, rest)?)
            }
            _ => None,
        };
        Ok(Self {
            root,
            head,
            data: ShardWriter::new(root, "data", &encoders.data, limit, FILES_PER_FOLDER),
            side,
            films: VideoWriter::new(root, bytes_of(*video_files_size_in_mb), features, *fps)?,
            tally: Tally::new(features, *fps, root),
        })
    }

    /// Takes the next row group.
    pub(super) fn take(&mut self, output: GroupOutput, beside: Option<SideOutput>) -> Result<()> {
        let begins = output.parts.first().is_some_and(|p| p.part.begins());
        let place = self.data.append(output.group, begins)?;
        for part in output.parts {
            let task = self.head.task_of[part.part.episode];
            let films = &mut self.films;
            self.tally.add(part, place, (&[task], &self.head.tasks[task]), &mut |camera, samples| {
                films.append(camera, samples)
            })?;
        }
        match (&mut self.side, beside) {
            (Some(writer), Some(beside)) => writer.append(beside),
            _ => Ok(()),
        }
    }

    /// Writes everything else.
    pub(super) fn finish(self, source_sha256: String) -> Result<ConvertReport> {
        let Self { root, head, data, side, films, tally } = self;
        let mut files = data.finish()?;
        if let Some(side) = side {
            files.extend(side.finish()?);
        }
        let told = tally.finish()?;
        files.extend(films.finish()?);
        let features = &head.info.features.0;
        let statistical: Vec<(String, bool)> = features.iter().map(|(name, f)| (name.clone(), f.is_visual())).collect();
        files.push(meta::write_tasks(root, &head.tasks)?);
        files.push(meta::write_episodes(root, &head.tasks, &statistical, &told.rows, &told.each, &[])?);
        files.push(meta::write_stats(root, &statistical, &told.stats)?);
        let mut info = head.info.clone();
        let mut skipped = Vec::new();
        if let Some(provenance) = &mut info.actrm {
            provenance.source_sha256 = source_sha256;
            provenance.fingerprint.clone_from(&told.fingerprint);
            skipped.clone_from(&provenance.skipped);
        }
        files.extend(meta::write_info(root, &check::sealed(info, root)?)?);
        if head.layout.is_some() {
            files.push(side::write_manifest(root, &files)?);
        }
        let doubtful = doubtful_depth(features, &told.stats);
        Ok(ConvertReport {
            dialect: head.dialect.name(),
            episodes: head.info.total_episodes,
            frames: head.info.total_frames,
            features: features.iter().map(|(name, f)| (name.clone(), f.dtype.clone(), f.shape.clone())).collect(),
            files: files.len(),
            bytes: files.iter().map(|f| f.bytes).sum(),
            fingerprint: told.fingerprint,
            tasks: head.tasks.clone(),
            skipped,
            notes: head.notes.iter().cloned().chain(doubtful).chain(head.last_notes.iter().cloned()).collect(),
        })
    }
}

/// Depth in metres that may be none: what MuJoCo gives before anyone makes distances of it.
fn doubtful_depth(features: &[(String, Feature)], stats: &BTreeMap<String, FeatureStats>) -> Vec<String> {
    let metres = features.iter().filter(|(_, feature)| feature.depth_unit() == Some("m"));
    let doubtful = metres.filter(|(name, _)| stats.get(name).is_some_and(|s| s.min[0] >= 0.0 && s.max[0] <= 1.0));
    let note = |(name, _): &(String, Feature)| {
        format!(
            "{name} lies between 0 and 1 throughout: it is taken as metres, which robosuite's own camera_depths are not \
             (get_real_depth_map in its camera_utils makes metres of them)"
        )
    };
    doubtful.map(note).collect()
}
