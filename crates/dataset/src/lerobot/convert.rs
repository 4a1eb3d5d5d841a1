//! From a file of demonstrations to a LeRobotDataset v3.0 directory.
//!
//! Threads read and encode row groups; this thread splices them into files in order and collects what the
//! episodes say about themselves. The bytes written do not depend on the number of threads.

use super::check;
use super::depth;
use super::encode::{GroupOutput, Job};
use super::encoded;
use super::features::{Column, ConvertOptions, Mapping};
use super::info::{self, Info, Provenance, SkippedDemo, VideoProvenance};
use super::meta;
use super::schema::{self, CREATED_BY};
use super::shards::{GroupEncoder, ShardWriter, WrittenFile};
use super::side::{self, SideEncoder, SideOutput, SideWriter};
use super::skip;
use super::staging::Staging;
use super::tally::{Tally, Told};
use super::v2::OldSet;
use super::verify::hash_files;
use super::videos::{self, VideoWriter};
use super::work;
use crate::error::{DatasetError, InputError, Result};
use crate::plan::{Plan, Problem};
use crate::source::Source;
use crate::stats::FeatureStats;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::ControlFlow;
use std::path::Path;

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
    let mut input = Source::open_guarded(source)?.nonfinite(options.nonfinite);
    without_observations(&input)?;
    if !options.depth {
        // the side folder keeps it, whatever its values
        let keys = input.plan().demos.iter().flat_map(|demo| &demo.keys);
        let depth = keys.filter(|(path, key)| depth::size(&path.replacen("next_obs/", "obs/", 1), key).is_some());
        let depth: BTreeSet<String> = depth.map(|(path, _)| path.clone()).collect();
        input.exempt(depth);
    }
    let staging = Staging::create(out)?;
    let (mapping, skipped) = match options.skip_bad {
        true => skip::bad(&mut input, options, staging.path())?,
        false => {
            skip::none(&input)?;
            let mapping = Mapping::resolve(input.plan(), options, &encoded::sizes(&input)?)?;
            input.exempt(mapping.depth_keys());
            (mapping, Vec::new())
        }
    };
    let plan = input.plan();
    let conversion = Conversion { source, plan, mapping: &mapping, options, skipped, root: staging.path() };
    let report = std::thread::scope(|scope| {
        // the file's hash needs nothing of what the conversion does
        let hash = scope.spawn(|| hash_files(&plan.files));
        let frames = conversion.write_frames(&input, progress)?;
        let hash = hash.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
        conversion.write_meta(frames, hash)
    })?;
    staging.publish()?;
    Ok(report)
}

/// Refuses demonstrations that have no observations, and says how they get them.
pub(crate) fn without_observations(input: &Source) -> Result<()> {
    let plan = input.plan();
    if plan.demos.is_empty() || plan.demos.iter().any(|demo| demo.keys.keys().any(|key| key.starts_with("obs/"))) {
        return Ok(());
    }
    Err(InputError::NoObservations { path: plan.path.clone(), advice: plan.dialect.observe().to_owned() }.into())
}

/// Task texts in order of first use, and each episode's.
pub(crate) fn tasks(source: &Path, plan: &Plan) -> (Vec<String>, Vec<usize>) {
    let mut tasks: Vec<String> = Vec::new();
    let mut task_of = Vec::with_capacity(plan.demos.len());
    let stem = source.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    for demo in &plan.demos {
        // no instruction: the environment names the task; a file that names none is known by its own name
        let text = demo.task.as_ref().or(plan.env_name.as_ref()).unwrap_or(&stem);
        let index = tasks.iter().position(|t| t == text).unwrap_or_else(|| {
            tasks.push(text.clone());
            tasks.len() - 1
        });
        task_of.push(index);
    }
    (tasks, task_of)
}

struct Conversion<'a> {
    source: &'a Path,
    plan: &'a Plan,
    mapping: &'a Mapping,
    options: &'a ConvertOptions,
    skipped: Vec<SkippedDemo>,
    root: &'a Path,
}

/// What is known once all frames are written.
struct Frames {
    tasks: Vec<String>,
    told: Told,
    files: Vec<WrittenFile>,
}

impl Conversion<'_> {
    fn write_frames(&self, input: &Source, progress: &mut dyn FnMut(u64, u64) -> ControlFlow<()>) -> Result<Frames> {
        let mut tell = |done, total| match progress(done, total) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(DatasetError::Stopped { path: self.source.to_owned() }),
        };
        let (tasks, task_of) = tasks(self.source, self.plan);
        let features = self.mapping.features();
        let arrow_schema = schema::data_schema(&features);
        let metadata = vec![schema::huggingface_metadata(&features)];
        let encoder = schema::writer_properties(&arrow_schema, metadata)
            .and_then(|properties| GroupEncoder::new(arrow_schema, properties))
            .map_err(|source| DatasetError::Parquet {
                path: self.root.join("data"),
                operation: "prepare writing it",
                source,
            })?;
        let job = Job {
            path: self.source,
            source: input,
            mapping: self.mapping,
            images: self.options.images,
            video: self.options.video.as_ref(),
            nonfinite: self.options.nonfinite,
            encoder: &encoder,
            task_of: &task_of,
        };
        let limit = (self.options.data_file_mb * f64::from(1 << 20)) as u64;
        let groups = work::cut(&self.plan.demos, self.mapping, self.options.lossless, limit);
        let mut shards = ShardWriter::new(self.root, "data", &encoder, limit, info::FILES_PER_FOLDER);
        let side = match self.options.lossless {
            true => {
                let side = SideEncoder::new(self.root, self.plan, &self.mapping.columns, self.options.video.as_ref())?;
                let mut rest = input.root()?;
                if let (false, Some(data)) = (self.skipped.is_empty(), rest.inner_attrs.get_mut("data")) {
                    side::count(data, "total", self.plan.frames());
                    side::count(data, "num_demos", self.plan.demos.len());
                }
                Some((side, side::object_encoder(self.root)?, rest))
            }
            false => None,
        };
        let mut side_writer = match &side {
            Some((side, objects, rest)) => {
                Some(SideWriter::new(self.root, &side.layout, side.frames(), objects, limit, rest)?)
            }
            None => None,
        };
        let video_limit = (self.options.video_file_mb * f64::from(1 << 20)) as u64;
        let mut films = VideoWriter::new(self.root, video_limit, &self.mapping.columns, self.mapping.fps)?;
        let mut tally = Tally::new(&features, self.mapping.fps, self.root);
        let total = self.plan.frames() as u64;
        let mut done = 0;
        tell(0, total)?;
        work::in_order(
            groups.len(),
            self.options.threads(),
            |index| {
                let mut loaded = job.load(&groups[index])?;
                let beside = side.as_ref().map(|(side, _, _)| side.encode(&job, &loaded)).transpose()?;
                Ok((job.encode(&mut loaded)?, beside))
            },
            |(output, beside): (GroupOutput, Option<SideOutput>)| {
                let begins = output.parts.first().is_some_and(|p| p.part.begins());
                done += output.group.rows as u64;
                let place = shards.append(output.group, begins)?;
                for part in output.parts {
                    let task = task_of[part.part.episode];
                    tally.add(part, place, (&[task], &tasks[task]), &mut |camera, samples| {
                        films.append(camera, samples)
                    })?;
                }
                if let (Some(writer), Some(beside)) = (&mut side_writer, beside) {
                    writer.append(beside)?;
                }
                tell(done, total)
            },
        )?;
        let mut files = shards.finish()?;
        if let Some(writer) = side_writer {
            files.extend(writer.finish()?);
        }
        let told = tally.finish()?;
        files.extend(films.finish()?);
        Ok(Frames { tasks, told, files })
    }

    /// Depth in metres that may be none: what MuJoCo gives before anyone makes distances of it.
    fn doubtful_depth(&self, stats: &BTreeMap<String, FeatureStats>) -> Vec<String> {
        let metres = self.mapping.columns.iter().filter(|c| c.feature.depth_unit() == Some("m"));
        let doubtful = metres.filter(|c| stats.get(&c.name).is_some_and(|s| s.min[0] >= 0.0 && s.max[0] <= 1.0));
        let note = |c: &Column| {
            format!(
                "{} lies between 0 and 1 throughout: it is taken as metres, which robosuite's own camera_depths are not \
                 (get_real_depth_map in its camera_utils makes metres of them)",
                c.name
            )
        };
        doubtful.map(note).collect()
    }

    /// Whether any column becomes videos.
    fn films(&self) -> bool {
        self.mapping.columns.iter().any(|c| c.feature.dtype == "video")
    }

    fn write_meta(&self, frames: Frames, source_sha256: String) -> Result<ConvertReport> {
        let statistical: Vec<(String, bool)> =
            self.mapping.columns.iter().map(|c| (c.name.clone(), c.feature.is_visual())).collect();
        let mut files = frames.files;
        files.push(meta::write_tasks(self.root, &frames.tasks)?);
        files.push(meta::write_episodes(self.root, &frames.tasks, &statistical, &frames.told.rows, &frames.told.each)?);
        files.push(meta::write_stats(self.root, &statistical, &frames.told.stats)?);
        let (left_out, left_out_notes) = self.left_out();
        let info = self.info(&frames.tasks, &frames.told.fingerprint, source_sha256, left_out);
        let info = check::sealed(info, self.root)?;
        files.extend(meta::write_info(self.root, &info)?);
        if self.options.lossless {
            files.push(side::write_manifest(self.root, &files)?);
        }
        Ok(ConvertReport {
            dialect: self.plan.dialect.name(),
            episodes: info.total_episodes,
            frames: info.total_frames,
            features: info
                .features
                .0
                .iter()
                .map(|(name, f)| (name.clone(), f.dtype.clone(), f.shape.clone()))
                .collect(),
            files: files.len(),
            bytes: files.iter().map(|f| f.bytes).sum(),
            fingerprint: frames.told.fingerprint,
            tasks: frames.tasks,
            skipped: self.skipped.clone(),
            notes: self
                .plan
                .notes
                .iter()
                .chain(&self.mapping.notes)
                .cloned()
                .chain(self.doubtful_depth(&frames.told.stats))
                .chain(left_out_notes)
                .chain(self.plan.problems.iter().filter(|p| !p.fatal).map(|p| p.message.clone()))
                .collect(),
        })
    }

    /// Datasets that cannot be read and that no column needs, and what to say about them.
    fn left_out(&self) -> (Vec<String>, Vec<String>) {
        let mut found: BTreeMap<&str, (usize, String)> = BTreeMap::new();
        for demo in &self.plan.demos {
            let mine = |p: &&Problem| p.fatal && p.demo.as_ref().is_none_or(|id| *id == demo.id);
            let keys = self.plan.problems.iter().filter(mine).filter_map(|p| p.key.as_deref());
            let keys: BTreeSet<&str> = keys.collect();
            for key in keys {
                if let Some(error) = self.plan.unreadable(demo, key) {
                    found.entry(key).or_insert_with(|| (0, error.to_string())).0 += 1;
                }
            }
        }
        let demos = self.plan.demos.len();
        let note = |(key, (count, error)): (&&str, &(usize, String))| {
            let side = if self.options.lossless { ", from the side folder too" } else { "" };
            format!("{key} is left out in {count} of {demos} demos{side}: {error}")
        };
        (found.keys().map(|key| (*key).to_owned()).collect(), found.iter().map(note).collect())
    }

    fn info(&self, tasks: &[String], fingerprint: &str, source_sha256: String, left_out: Vec<String>) -> Info {
        let plan = self.plan;
        // demos that a mask names and the file lacks are a note; the side folder keeps the mask as it is
        let masks = plan.masks.iter().map(|(name, demos)| {
            let mut episodes: Vec<usize> = demos.iter().filter_map(|demo| plan.position(demo)).collect();
            episodes.sort_unstable();
            (name.clone(), episodes)
        });
        let masks: BTreeMap<String, Vec<usize>> = masks.collect();
        let absent = plan.masks.iter().map(|(name, demos)| {
            (name.clone(), demos.iter().filter(|demo| plan.position(demo).is_none()).cloned().collect::<Vec<_>>())
        });
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
        Info {
            codebase_version: info::CODEBASE_VERSION.to_owned(),
            robot_type,
            total_episodes: plan.demos.len(),
            total_frames: plan.frames(),
            total_tasks: tasks.len(),
            chunks_size: info::FILES_PER_FOLDER,
            data_files_size_in_mb: self.options.data_file_mb,
            video_files_size_in_mb: self.options.video_file_mb,
            fps: self.mapping.fps,
            splits: BTreeMap::from([("train".to_owned(), format!("0:{}", plan.demos.len()))]),
            data_path: info::DATA_PATH.to_owned(),
            video_path: self.films().then(|| videos::VIDEO_PATH.to_owned()),
            features: self.mapping.features(),
            other: BTreeMap::new(),
            actrm: Some(Provenance {
                format: 1,
                writer: CREATED_BY.to_owned(),
                source: self.source.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default(),
                source_sha256,
                dialect: plan.dialect.name().to_owned(),
                fingerprint: fingerprint.to_owned(),
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
                lossless: self.options.lossless,
                seal: None,
                video: self.options.video.filter(|_| self.films()).map(|v| VideoProvenance {
                    encoder: videos::ENCODER.to_owned(),
                    speed: v.speed,
                    quantizer: v.quantizer,
                    key_interval: v.key_interval,
                    side_pictures: v.side_pictures && self.options.lossless,
                }),
            }),
        }
    }
}
