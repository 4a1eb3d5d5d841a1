//! From a file of demonstrations to a LeRobotDataset v3.0 directory.
//!
//! Threads read and encode row groups; this thread hands them over in order, to be put together ([`Assembly`]). The bytes
//! written do not depend on the number of threads.

use super::assembly::{Assembly, Encoders, Head, bytes_of};
use super::depth;
use super::doubts::Doubts;
use super::edit;
use super::encode::{GroupOutput, Job};
use super::encoded;
use super::features::{ConvertOptions, Mapping};
use super::info::{self, Info, Provenance, SkippedDemo, VideoProvenance};
use super::schema::CREATED_BY;
use super::side::{self, SideEncoder, SideOutput};
use super::skip;
use super::staging::Staging;
use super::v2::OldSet;
use super::verify::hash_files_unless;
use super::videos;
use super::work::{self, Part};
use crate::error::{DatasetError, InputError, Result};
use crate::ffmpeg;
use crate::plan::Plan;
use crate::source::Source;
use crate::tree::Demo;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

/// What a conversion did.
#[derive(Debug, Clone, PartialEq)]
pub struct ConvertReport {
    /// Layout of the source.
    pub dialect: &'static str,
    /// Episodes written.
    pub episodes: usize,
    /// Frames written.
    pub frames: usize,
    /// Task texts.
    pub tasks: Vec<String>,
    /// Columns with their type and shape.
    pub features: Vec<(String, String, Vec<usize>)>,
    /// Files written.
    pub files: usize,
    /// Bytes written.
    pub bytes: u64,
    /// sha256 of the content.
    pub fingerprint: String,
    /// Demos that were left out ([`ConvertOptions::skip_bad`]), and why.
    pub skipped: Vec<SkippedDemo>,
    /// Facts and faults of the source that did not prevent the conversion.
    pub notes: Vec<String>,
}

/// Converts the demonstrations at `source` into the directory `out`, which must not exist.
///
/// `progress` is told frames done and frames in all. Nothing appears at `out` unless everything went well.
pub fn convert(
    source: &Path,
    out: &Path,
    options: &ConvertOptions,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<ConvertReport> {
    convert_unless(source, out, options, &mut |done, total| {
        progress(done, total);
        ControlFlow::Continue(())
    })
}

/// [`convert`], unless `progress` says that it is enough.
///
/// # Errors
/// [`DatasetError::Stopped`] in that case; nothing stays behind.
pub fn convert_unless(
    source: &Path,
    out: &Path,
    options: &ConvertOptions,
    progress: &mut dyn FnMut(u64, u64) -> ControlFlow<()>,
) -> Result<ConvertReport> {
    if let Some(old) = OldSet::open(source)? {
        return old.convert(out, options, progress);
    }
    keep_freed_memory();
    let staging = Staging::create(out)?;
    let stop = AtomicBool::new(false);
    let report = std::thread::scope(|scope| {
        // after a failure nobody waits for the hash of a large file
        let _stop = StopWhenDropped(&stop);
        // the hash needs nothing of what the conversion does; most often the source is this one file
        let whole = source.is_file().then(|| scope.spawn(|| hash_files_unless(&[(source.to_owned(), 0)], &stop)));
        let opened = Opened::new(source, options, staging.path())?;
        let hash = match (&opened.input.plan().files[..], whole) {
            ([(single, _)], Some(whole)) if single == source => whole,
            (files, _) => {
                let (files, stop) = (files.to_vec(), &stop);
                scope.spawn(move || hash_files_unless(&files, stop))
            }
        };
        let head = opened.head(source, options);
        let encoders = Encoders::new(staging.path(), &head)?;
        let rest = opened.rest()?;
        let mut assembly = Assembly::new(staging.path(), &head, &encoders, rest.as_ref())?;
        let groups = opened.groups(options);
        let doubts =
            opened.each_group((source, options), &head, &encoders, &groups, progress, &mut |output, beside| {
                assembly.take(output, beside)
            })?;
        // the reading process ends before what all episodes say is put together: they need not be in memory at once
        drop(opened);
        let hash = hash.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
        let mut report = assembly.finish(hash)?;
        report.notes.extend(doubts.notes());
        Ok::<_, DatasetError>(report)
    })?;
    staging.publish()?;
    Ok(report)
}

pub(super) struct StopWhenDropped<'a>(pub &'a AtomicBool);

impl Drop for StopWhenDropped<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Row groups are made and freed one after the other. After a large block has been freed, glibc keeps freed memory of up to
/// twice its size instead of returning it, and getting it back would cost a page fault for every 4 KiB. Nothing is touched
/// here, so this takes no memory; other allocators do not mind.
fn keep_freed_memory() {
    const LARGE: usize = 12 << 20;
    drop(std::hint::black_box(Vec::<u8>::with_capacity(LARGE)));
}

/// Refuses demonstrations that have no observations, and says how they get them.
pub(crate) fn without_observations(input: &Source) -> Result<()> {
    let plan = input.plan();
    if plan.demos.is_empty() || plan.demos.iter().any(|demo| demo.keys.keys().any(|key| key.starts_with("obs/"))) {
        return Ok(());
    }
    Err(InputError::NoObservations { path: plan.path.clone(), advice: plan.dialect.observe().to_owned() }.into())
}

/// What a file or folder is called, however it was named: `.` is the folder that it is.
fn name_of(source: &Path) -> String {
    let found = match source.file_name() {
        Some(_) => None,
        None => source.canonicalize().ok(),
    };
    found.as_deref().unwrap_or(source).file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// [`name_of`] without what says its format; what follows a dot in a folder's name belongs to it.
fn name_without_ending(source: &Path) -> String {
    let name = name_of(source);
    let ending = Path::new(&name).extension().filter(|ending| source.is_file() || *ending == "zarr");
    match ending {
        Some(ending) => name[..name.len() - ending.len() - 1].to_owned(),
        None => name,
    }
}

/// Task texts in order of first use, and each episode's.
pub(crate) fn tasks(source: &Path, plan: &Plan) -> (Vec<String>, Vec<usize>) {
    let (mut tasks, mut numbers): (Vec<String>, HashMap<&String, usize>) = Default::default();
    let mut task_of = Vec::with_capacity(plan.demos.len());
    let stem = name_without_ending(source);
    for demo in &plan.demos {
        // no instruction: the environment names the task; a file that names none is known by its own name
        let text = demo.task.as_ref().or(plan.env_name.as_ref()).unwrap_or(&stem);
        let index = *numbers.entry(text).or_insert_with(|| {
            tasks.push(text.clone());
            tasks.len() - 1
        });
        task_of.push(index);
    }
    (tasks, task_of)
}

/// A source with the columns that its demos become.
pub(super) struct Opened {
    pub input: Source,
    mapping: Mapping,
    side: Option<SideEncoder>,
    skipped: Vec<SkippedDemo>,
}

/// Takes an encoded row group and what the side folder gets with it.
pub(super) type TakeGroup<'f> = dyn FnMut(GroupOutput, Option<SideOutput>) -> Result<()> + 'f;

impl Opened {
    /// Opens a source and chooses the columns. `root` is a folder for what is tried.
    pub(super) fn new(source: &Path, options: &ConvertOptions, root: &Path) -> Result<Self> {
        let mut input = Source::open_guarded(source)?.nonfinite(options.nonfinite);
        without_observations(&input)?;
        if !options.depth {
            // the side folder keeps it, whatever its values
            let keys = input.plan().demos.iter().flat_map(|demo| &demo.keys);
            let depth = keys.filter(|(path, key)| depth::size(&path.replacen("next_obs/", "obs/", 1), key).is_some());
            let depth: BTreeSet<String> = depth.map(|(path, _)| path.to_owned()).collect();
            input.exempt(depth);
        }
        let (mapping, skipped) = match options.skip_bad {
            true => skip::bad(&mut input, options, root)?,
            false => {
                skip::none(&input)?;
                let mapping = Mapping::resolve(input.plan(), options, &encoded::sizes(&input)?)?;
                input.exempt(mapping.depth_keys());
                (mapping, Vec::new())
            }
        };
        let side = match options.lossless {
            true => Some(SideEncoder::new(root, input.plan(), &mapping.columns, options.video.as_ref())?),
            false => None,
        };
        Ok(Self { input, mapping, side, skipped })
    }

    /// The row groups of the result.
    pub(super) fn groups(&self, options: &ConvertOptions) -> Vec<Vec<Part>> {
        work::cut(&self.input.plan().demos, &self.mapping, options.lossless, bytes_of(options.data_file_mb))
    }

    /// What belongs to no demo, where there is a side folder for it.
    pub(super) fn rest(&self) -> Result<Option<Demo>> {
        if self.side.is_none() {
            return Ok(None);
        }
        let mut rest = self.input.root()?;
        if self.skipped.is_empty() {
            return Ok(Some(rest));
        }
        if let Some(data) = rest.inner_attrs.get_mut("data") {
            side::count(data, "total", self.input.plan().frames());
            side::count(data, "num_demos", self.input.plan().demos.len());
        }
        for (_, mask) in rest.datasets.iter_mut().filter(|(path, _)| path.starts_with("mask/")) {
            let Some(ids) = mask.to_strings().filter(|_| mask.shape.len() == 1) else { continue };
            let there: Vec<String> = ids.iter().filter(|id| !self.is_skipped(id)).cloned().collect();
            if there.len() < ids.len() {
                *mask = edit::texts_like(mask, &there);
            }
        }
        Ok(Some(rest))
    }

    /// Whether a demo was left out.
    fn is_skipped(&self, demo: &str) -> bool {
        self.skipped.iter().any(|skipped| skipped.demo == demo)
    }

    /// Reads and encodes row groups on several threads and hands them over in order, on this one. Gives what is to be noted
    /// of their values.
    pub(super) fn each_group(
        &self,
        (source, options): (&Path, &ConvertOptions),
        head: &Head,
        encoders: &Encoders,
        groups: &[Vec<Part>],
        progress: &mut dyn FnMut(u64, u64) -> ControlFlow<()>,
        take: &mut TakeGroup<'_>,
    ) -> Result<Doubts> {
        let mut tell = |done, total| match progress(done, total) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(DatasetError::Stopped { path: source.to_owned() }),
        };
        let job = Job {
            path: source,
            source: &self.input,
            mapping: &self.mapping,
            images: options.images,
            video: options.video.as_ref(),
            nonfinite: options.nonfinite,
            lossless: options.lossless,
            encoder: &encoders.data,
            task_of: &head.task_of,
        };
        let total = groups.iter().flatten().map(|part| part.rows.len() as u64).sum();
        let (mut done, mut doubts) = (0, Doubts::default());
        tell(0, total)?;
        work::in_order(
            groups.len(),
            options.threads(),
            |index| {
                let mut loaded = job.load(&groups[index])?;
                let beside = self.side.as_ref().map(|side| side.encode(&job, &loaded)).transpose()?;
                let doubts = Doubts::of(&self.mapping.columns, &loaded);
                Ok((job.encode(&mut loaded)?, beside, doubts))
            },
            |(output, beside, found): (GroupOutput, Option<SideOutput>, Doubts)| {
                done += output.group.rows as u64;
                doubts.extend(&found);
                take(output, beside)?;
                tell(done, total)
            },
        )?;
        Ok(doubts)
    }

    /// What the result says of itself, as far as that is known before its frames are.
    pub(super) fn head(&self, source: &Path, options: &ConvertOptions) -> Head {
        let plan = self.input.plan();
        let (tasks, task_of) = tasks(source, plan);
        let (left_out, left_out_notes) =
            plan.left_out(if options.lossless { ", from the side folder too" } else { "" });
        let features = self.mapping.features();
        let films = features.0.iter().any(|(_, feature)| feature.dtype == "video");
        let positions = plan.positions();
        // demos that a mask names and the file lacks are a note; the side folder keeps the mask as it is
        let masks = plan.masks.iter().map(|(name, demos)| {
            let mut episodes: Vec<usize> =
                demos.iter().filter_map(|demo| positions.get(demo.as_str()).copied()).collect();
            episodes.sort_unstable();
            (name.clone(), episodes)
        });
        let masks: BTreeMap<String, Vec<usize>> = masks.collect();
        let lacks = |demo: &&String| !positions.contains_key(demo.as_str()) && !self.is_skipped(demo);
        let absent = plan
            .masks
            .iter()
            .map(|(name, demos)| (name.clone(), demos.iter().filter(&lacks).cloned().collect::<Vec<_>>()));
        let masks_absent = absent.filter(|(_, demos)| !demos.is_empty()).collect();
        let robots = plan.env_args.as_ref().and_then(|args| args.get("env_kwargs")?.get("robots").cloned());
        let robot_type = match robots {
            Some(serde_json::Value::String(name)) => Some(name),
            Some(serde_json::Value::Array(names)) => {
                let names: Vec<&str> = names.iter().filter_map(|n| n.as_str()).collect();
                (!names.is_empty()).then(|| names.join("+"))
            }
            _ => None,
        };
        let info = Info {
            codebase_version: info::CODEBASE_VERSION.to_owned(),
            robot_type,
            total_episodes: plan.demos.len(),
            total_frames: plan.frames(),
            total_tasks: tasks.len(),
            chunks_size: info::FILES_PER_FOLDER,
            data_files_size_in_mb: options.data_file_mb,
            video_files_size_in_mb: options.video_file_mb,
            fps: self.mapping.fps,
            splits: BTreeMap::from([("train".to_owned(), format!("0:{}", plan.demos.len()))]),
            data_path: info::DATA_PATH.to_owned(),
            video_path: films.then(|| videos::VIDEO_PATH.to_owned()),
            features,
            other: BTreeMap::new(),
            actrm: Some(Provenance {
                format: 1,
                writer: CREATED_BY.to_owned(),
                source: name_of(source),
                source_sha256: String::new(),
                dialect: plan.dialect.name().to_owned(),
                fingerprint: String::new(),
                env_name: plan.env_name.clone(),
                env_version: plan.env_version.clone(),
                env_args: plan.env_args.clone(),
                seeds: plan.texts.get("data/seeds").cloned(),
                expert: plan.texts.get("data/expert").cloned(),
                skill: plan.texts.get("data/skill").cloned(),
                state_keys: self.mapping.state_keys.clone(),
                env_keys: self.mapping.env_keys.clone(),
                entities: self.mapping.entities.clone(),
                action: self.mapping.action.clone(),
                demos: plan.demos.iter().map(|d| d.id.clone()).collect(),
                masks,
                masks_absent,
                skipped: self.skipped.clone(),
                left_out,
                lossless: options.lossless,
                seal: None,
                video: options.video.filter(|_| films).map(|v| VideoProvenance {
                    encoder: match ffmpeg::chosen(v.encoder) {
                        Ok(Some(chosen)) => chosen.name(),
                        _ => videos::ENCODER.to_owned(),
                    },
                    speed: v.speed,
                    quantizer: v.quantizer,
                    key_interval: v.key_interval,
                    side_pictures: v.side_pictures && options.lossless,
                }),
            }),
        };
        let problems = plan.problems.iter().filter(|p| !p.fatal).map(|p| p.message.clone());
        Head {
            dialect: plan.dialect,
            info,
            tasks,
            task_of,
            layout: self.side.as_ref().map(|side| side.layout.clone()),
            notes: plan.notes.iter().chain(&self.mapping.notes).cloned().collect(),
            last_notes: left_out_notes.into_iter().chain(problems).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_source_has_its_own_name_however_it_is_named() {
        let dir = tempfile::tempdir().unwrap();
        for (name, expected) in [("pour.v2", "pour.v2"), ("push.zarr", "push"), ("plain", "plain")] {
            let folder = dir.path().join(name);
            std::fs::create_dir_all(folder.join("below")).unwrap();
            for path in [folder.clone(), folder.join("."), folder.join("below/..")] {
                assert_eq!(name_without_ending(&path), expected, "{}", path.display());
            }
        }
        std::fs::write(dir.path().join("low_dim.hdf5"), "").unwrap();
        assert_eq!(name_without_ending(&dir.path().join("low_dim.hdf5")), "low_dim");
        let here = std::env::current_dir().unwrap();
        assert_eq!(name_of(Path::new(".")), here.file_name().unwrap().to_string_lossy());
    }
}
