//! What the episodes of a data set that is being written say about themselves, as it comes in: their rows, the
//! statistics and the fingerprint of the whole. Conversion and editing go through it, so that both come to the same bits.

use super::encode::{ColumnSummary, PartSummary, PictureSummary};
use super::fingerprint::{Fingerprint, INDEX_COLUMNS};
use super::info::Features;
use super::meta::EpisodeRow;
use super::shards::Place;
use super::totals::{ColumnTotal, EpisodeStats};
use super::videos::Stretch;
use super::work::Part;
use crate::error::Result;
use crate::stats::FeatureStats;
use std::collections::BTreeMap;
use std::path::Path;
use video::Sample;

/// Where the samples of an episode go, for the camera in a column.
pub(crate) type Film<'f> = dyn FnMut(usize, &[Sample]) -> Result<Stretch> + 'f;

/// What the episodes said so far.
pub(crate) struct Tally<'a> {
    features: &'a Features,
    rows: Vec<EpisodeRow>,
    /// Statistics of each episode.
    each: EpisodeStats,
    /// Values of each column.
    values: Vec<ColumnTotal>,
    /// Pictures of each image column over all episodes (histograms only).
    totals: BTreeMap<usize, PictureSummary>,
    /// The episode that is being put together.
    open: Option<(Vec<ColumnSummary>, BTreeMap<usize, PictureSummary>)>,
    /// The first task of that episode.
    task: String,
    fingerprint: Fingerprint,
}

/// What is known once every episode was told.
pub(crate) struct Told {
    pub rows: Vec<EpisodeRow>,
    /// Statistics of each episode.
    pub each: EpisodeStats,
    /// Statistics over all episodes of each column that has any.
    pub stats: BTreeMap<String, FeatureStats>,
    pub fingerprint: String,
}

impl<'a> Tally<'a> {
    /// Nothing yet; what does not fit memory goes into files without a name in `folder`.
    pub(crate) fn new(features: &'a Features, fps: f64, folder: &Path) -> Self {
        Self {
            features,
            rows: Vec::new(),
            each: EpisodeStats::new(folder),
            values: features.0.iter().map(|(_, feature)| ColumnTotal::new(folder, feature.dim())).collect(),
            totals: BTreeMap::new(),
            open: None,
            task: String::new(),
            fingerprint: Fingerprint::new(features, fps),
        }
    }

    /// Takes the next part of the present episode, or the first of the next one, which lies at `place` and does
    /// `tasks`, the first of which is `task`.
    pub(crate) fn add(
        &mut self,
        summary: PartSummary,
        place: Place,
        (tasks, task): (&[usize], &str),
        film: &mut Film<'_>,
    ) -> Result<()> {
        let part = summary.part;
        if part.begins() {
            self.rows.push(EpisodeRow {
                length: part.length,
                from: part.first_frame,
                tasks: tasks.to_vec(),
                place,
                videos: BTreeMap::new(),
            });
            task.clone_into(&mut self.task);
            self.open = Some((summary.values, summary.pictures));
        } else if let Some((_, pictures)) = &mut self.open {
            for (column, next) in summary.pictures {
                pictures.entry(column).or_default().extend(next);
            }
        }
        if part.ends() { self.close(&part, film) } else { Ok(()) }
    }

    fn close(&mut self, part: &Part, film: &mut Film<'_>) -> Result<()> {
        let Some((columns, mut pictures)) = self.open.take() else { return Ok(()) };
        let row = self.rows.last_mut().expect("an open episode has its row");
        self.fingerprint.episode(part.length, &self.task);
        let mut of_episode = BTreeMap::new();
        for (index, ((name, feature), summary)) in self.features.0.iter().zip(columns).enumerate() {
            let (mut stats, mut digest) = (summary.stats, summary.digest);
            if let Some(found) = pictures.remove(&index) {
                if feature.dtype == "video" {
                    row.videos.insert(name.clone(), film(index, &found.samples)?);
                }
                digest = found.digest();
                if found.sampled > 0 && !feature.is_depth() {
                    self.totals.entry(index).or_default().add_counts(&found.histograms, found.sampled);
                }
                stats = found.stats().or(stats);
            }
            if let Some(stats) = stats {
                of_episode.insert(name.clone(), stats);
            }
            if !INDEX_COLUMNS.contains(&name.as_str()) {
                self.fingerprint.column(name, digest);
            }
            self.values[index].add(summary.values)?;
        }
        self.each.add(&of_episode, part.length)
    }

    /// The statistics of the whole and the fingerprint.
    pub(crate) fn finish(self) -> Result<Told> {
        let mut stats = BTreeMap::new();
        for (index, (name, feature)) in self.features.0.iter().enumerate() {
            let of_column = match self.totals.get(&index) {
                Some(total) => FeatureStats::of_histograms(&total.histograms, total.sampled),
                // depth, and pictures that were not looked at: what their episodes say, taken together
                None if feature.is_visual() => {
                    let each = self.each.of_feature(name)?;
                    each.and_then(|each| FeatureStats::pooled(&each.iter().collect::<Vec<_>>()))
                }
                None => self.values[index].stats()?,
            };
            if let Some(of_column) = of_column {
                stats.insert(name.clone(), of_column);
            }
        }
        Ok(Told { rows: self.rows, each: self.each, stats, fingerprint: self.fingerprint.finish() })
    }
}
