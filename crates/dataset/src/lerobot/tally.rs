//! What the episodes of a data set that is being written say about themselves, as it comes in: their rows, the
//! statistics and the fingerprint of the whole. Conversion and editing go through it, so that both come to the same bits.

use super::encode::{ColumnSummary, PartSummary, PictureSummary};
use super::fingerprint::{Fingerprint, INDEX_COLUMNS};
use super::info::Features;
use super::meta::EpisodeRow;
use super::shards::Place;
use super::values::{Values, stats_of};
use super::videos::Stretch;
use super::work::Part;
use crate::error::Result;
use crate::stats::FeatureStats;
use std::collections::BTreeMap;
use video::Sample;

/// Where the samples of an episode go, for the camera in a column.
pub(crate) type Film<'f> = dyn FnMut(usize, &[Sample]) -> Result<Stretch> + 'f;

/// What the episodes said so far.
pub(crate) struct Tally<'a> {
    features: &'a Features,
    tasks: &'a [String],
    rows: Vec<EpisodeRow>,
    /// Values of each column, an entry an episode.
    values: Vec<Vec<Values>>,
    /// Pictures of each image column over all episodes (histograms only).
    totals: BTreeMap<usize, PictureSummary>,
    /// The episode that is being put together.
    open: Option<(Vec<ColumnSummary>, BTreeMap<usize, PictureSummary>)>,
    fingerprint: Fingerprint,
}

/// What is known once every episode was told.
pub(crate) struct Told {
    pub rows: Vec<EpisodeRow>,
    /// Statistics over all episodes of each column that has any.
    pub stats: BTreeMap<String, FeatureStats>,
    pub fingerprint: String,
}

impl<'a> Tally<'a> {
    /// Nothing yet; `tasks` are the texts that episodes count.
    pub(crate) fn new(features: &'a Features, fps: f64, tasks: &'a [String]) -> Self {
        Self {
            features,
            tasks,
            rows: Vec::new(),
            values: features.0.iter().map(|_| Vec::new()).collect(),
            totals: BTreeMap::new(),
            open: None,
            fingerprint: Fingerprint::new(features, fps),
        }
    }

    /// Takes the next part of the present episode, or the first of the next one, which lies at `place` and does `tasks`.
    pub(crate) fn add(
        &mut self,
        summary: PartSummary,
        place: Place,
        tasks: &[usize],
        film: &mut Film<'_>,
    ) -> Result<()> {
        let part = summary.part;
        if part.begins() {
            self.rows.push(EpisodeRow {
                length: part.length,
                from: part.first_frame,
                tasks: tasks.to_vec(),
                place,
                stats: BTreeMap::new(),
                videos: BTreeMap::new(),
            });
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
        let task = row.tasks.first().map_or("", |&task| self.tasks[task].as_str());
        self.fingerprint.episode(part.length, task);
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
                row.stats.insert(name.clone(), stats);
            }
            if !INDEX_COLUMNS.contains(&name.as_str()) {
                self.fingerprint.column(name, digest);
            }
            self.values[index].push(summary.values);
        }
        Ok(())
    }

    /// The statistics of the whole and the fingerprint.
    pub(crate) fn finish(self) -> Told {
        let mut stats = BTreeMap::new();
        for (index, (name, feature)) in self.features.0.iter().enumerate() {
            let of_column = match self.totals.get(&index) {
                Some(total) => FeatureStats::of_histograms(&total.histograms, total.sampled),
                // depth, and pictures that were not looked at: what their episodes say, taken together
                None if feature.is_visual() => {
                    let each: Option<Vec<&FeatureStats>> = self.rows.iter().map(|row| row.stats.get(name)).collect();
                    each.and_then(|each| FeatureStats::pooled(&each))
                }
                None => stats_of(&self.values[index].iter().collect::<Vec<_>>(), feature.dim()),
            };
            if let Some(of_column) = of_column {
                stats.insert(name.clone(), of_column);
            }
        }
        Told { rows: self.rows, stats, fingerprint: self.fingerprint.finish() }
    }
}
