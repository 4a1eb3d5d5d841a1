//! What a page shows of a data set or of a file of demonstrations, an episode at a time.

use anyhow::Result;
use dataset::{Dataset, EpisodeMeta, NonFinite, Picture, Source, Wide};
use std::path::Path;

/// Dimensions of a column of which curves are drawn unless it was asked for.
const MOST_DIMENSIONS: usize = 64;
/// robomimic's number for robosuite environments, whose reward is 1 where the task is solved.
const ROBOSUITE: i64 = 1;

/// The column of rewards in a data set.
const REWARD: &str = "next.reward";

/// A column that is drawn.
pub struct Drawn {
    pub name: String,
    /// Names of its dimensions.
    pub names: Vec<String>,
}

/// One episode.
pub struct Episode {
    pub name: String,
    pub length: usize,
    pub task: String,
    /// Sum of the rewards, where there are any.
    pub total_reward: Option<f64>,
    /// Whether the task was solved, where that is known.
    pub success: Option<bool>,
    pub problems: Vec<String>,
    /// Row-major values of each column drawn; empty where the episode lacks it.
    pub columns: Vec<Vec<f32>>,
}

/// What is opened.
pub enum Opened {
    /// With its rewards, where they are numbers that float32 does not hold.
    Set(Box<Dataset>, Option<Wide>),
    File(Box<Source>),
}

impl Opened {
    pub fn open(path: &Path) -> Result<Self> {
        Ok(match path.join("meta/info.json").exists() {
            true => {
                let set = Dataset::open(path)?;
                let rewards = set.wide()?.remove(REWARD);
                Self::Set(Box::new(set), rewards)
            }
            false => Self::File(Box::new(Source::open_guarded(path)?.nonfinite(NonFinite::Keep))),
        })
    }

    pub fn episodes(&self) -> usize {
        match self {
            Self::Set(set, _) => set.episodes().len(),
            Self::File(source) => source.plan().demos.len(),
        }
    }

    /// Frames a second, where that is stated.
    pub fn fps(&self) -> Option<f64> {
        match self {
            Self::Set(set, _) => Some(set.info().fps),
            Self::File(source) => source.plan().env_args.as_ref()?.get("env_kwargs")?.get("control_freq")?.as_f64(),
        }
    }

    /// Names of the cameras, of colours and of depth: columns of a data set; those of colours: datasets of a file.
    pub fn cameras(&self) -> Vec<String> {
        match self {
            Self::Set(set, _) => set.cameras().chain(set.depth_names()).map(str::to_owned).collect(),
            Self::File(source) => {
                let first = source.plan().demos.first();
                let pictures = first.into_iter().flat_map(|demo| &demo.keys);
                let pictures =
                    pictures.filter(|(path, key)| path.starts_with("obs/") && key.is_image() && key.shape[3] == 3);
                pictures.map(|(path, _)| path.to_owned()).collect()
            }
        }
    }

    /// The columns that can be drawn: the actions first.
    pub fn columns(&self) -> Vec<Drawn> {
        let mut columns: Vec<Drawn> = match self {
            Self::Set(set, _) => {
                let drawn = |name: &str| {
                    let dim = set.column(name).map_or(0, |column| column.dim);
                    Drawn { name: name.to_owned(), names: names_of(&set.names(name), dim) }
                };
                set.column_names().map(drawn).collect()
            }
            Self::File(source) => {
                let first = source.plan().demos.first();
                let numeric =
                    first.into_iter().flat_map(|demo| demo.keys.iter().map(move |(path, key)| (demo, path, key)));
                let drawn = numeric.filter_map(|(demo, path, key)| {
                    let wanted = path == "actions" || path == "rewards" || path.starts_with("obs/");
                    let rows = key.shape.first() == Some(&demo.length);
                    let dim: usize = key.shape.get(1..).unwrap_or_default().iter().product();
                    (wanted && rows && key.dtype.is_numeric() && !key.is_image())
                        .then(|| Drawn { name: path.to_owned(), names: names_of(&usual_names(source, path, dim), dim) })
                });
                drawn.collect()
            }
        };
        columns.sort_by_key(|column| !matches!(column.name.as_str(), dataset::ACTION | "actions"));
        columns
    }

    /// The columns that are drawn unless others are asked for.
    pub fn usual(columns: &[Drawn]) -> Vec<String> {
        columns.iter().filter(|c| c.names.len() <= MOST_DIMENSIONS).map(|c| c.name.clone()).collect()
    }

    /// Episode `index` with the values of `columns`.
    pub fn episode(&self, index: usize, columns: &[Drawn]) -> Episode {
        match self {
            Self::Set(set, rewards) => of_set(set, rewards.as_ref(), &set.episodes()[index], columns),
            Self::File(source) => of_file(source, index, columns),
        }
    }

    /// Pictures of a camera in some frames of an episode.
    pub fn pictures(&self, camera: &str, episode: usize, frames: &[usize]) -> Result<Vec<Picture>> {
        Ok(match self {
            Self::Set(set, _) => pictures(set, camera, episode, frames)?,
            Self::File(source) => {
                let mut pictures = Vec::with_capacity(frames.len());
                for &frame in frames {
                    let array = source.read_rows(episode, camera, frame, 1)?;
                    let &[_, height, width, _] = array.shape.as_slice() else { continue };
                    pictures.push(Picture { height, width, rgb: array.bytes });
                }
                pictures
            }
        })
    }
}

/// Pictures of a camera of a set in some frames of an episode; depth in grey, what is near in white.
pub fn pictures(set: &Dataset, camera: &str, episode: usize, frames: &[usize]) -> Result<Vec<Picture>> {
    if set.depth_names().any(|name| name == camera) {
        let all = set.depth_maps(camera, episode)?;
        return Ok(frames.iter().map(|&frame| all.picture(frame)).collect());
    }
    let mut sorted = frames.to_vec();
    sorted.sort_unstable();
    sorted.dedup();
    let some = set.pictures_of(camera, episode, &mut |frame| sorted.binary_search(&frame).is_ok())?;
    let one = |frame: &usize| {
        let at = sorted.partition_point(|other| other < frame);
        Picture { height: some.height, width: some.width, rgb: some.frame(at).to_vec() }
    };
    Ok(frames.iter().map(one).collect())
}

/// Names of the dimensions of a dataset of a file, as robosuite and robomimic order them; none where that is not known.
fn usual_names(source: &Source, path: &str, dim: usize) -> Vec<String> {
    const POSE: [&str; 7] = ["x", "y", "z", "rotation x", "rotation y", "rotation z", "gripper"];
    let poses = || source.plan().env_args.as_ref().is_some_and(|args| args.to_string().contains("\"OSC_POSE\""));
    let names: &[&str] = match dim {
        7 if path == "actions" && poses() => &POSE,
        3 if path.ends_with("_pos") => &POSE[..3],
        4 if path.ends_with("_quat") => &["x", "y", "z", "w"],
        _ => &[],
    };
    names.iter().map(|name| (*name).to_owned()).collect()
}

/// Names of dimensions: those that are stated, or numbers.
fn names_of(stated: &[String], dim: usize) -> Vec<String> {
    (0..dim).map(|d| stated.get(d).cloned().unwrap_or_else(|| d.to_string())).collect()
}

fn of_set(set: &Dataset, rewards: Option<&Wide>, episode: &EpisodeMeta, columns: &[Drawn]) -> Episode {
    let values = |name: &str| {
        let column = set.column(name)?;
        Some(column.data[episode.from * column.dim..episode.to * column.dim].to_vec())
    };
    Episode {
        name: episode.demo.clone().unwrap_or_default(),
        length: episode.length,
        task: episode.tasks.join("; "),
        total_reward: match rewards {
            Some(exact) => Some(exact.sum(episode.from..episode.to)),
            None => values(REWARD).map(|rewards| rewards.iter().map(|&r| f64::from(r)).sum()),
        },
        success: values("next.success").map(|solved| solved.contains(&1.0)),
        problems: Vec::new(),
        columns: columns.iter().map(|column| values(&column.name).unwrap_or_default()).collect(),
    }
}

fn of_file(source: &Source, index: usize, columns: &[Drawn]) -> Episode {
    let plan = source.plan();
    let demo = &plan.demos[index];
    let mut problems: Vec<String> =
        plan.problems.iter().filter(|p| p.demo.as_ref() == Some(&demo.id)).map(|p| p.message.clone()).collect();
    let wanted = |key: &str| key == "rewards" || columns.iter().any(|column| column.name == key);
    let read = match source.read_demo_where(index, &wanted) {
        Ok(read) => read.datasets,
        Err(error) => {
            let text = error.to_string();
            if !problems.contains(&text) {
                problems.push(text);
            }
            Default::default()
        }
    };
    let values = |column: &Drawn| {
        let values = read.get(&column.name).and_then(dataset::Array::to_f32).unwrap_or_default();
        // another shape than the first demo's is not drawn
        if values.len() == demo.length * column.names.len() { values } else { Vec::new() }
    };
    let rewards = read.get("rewards").and_then(dataset::Array::to_f64);
    let robosuite = plan.env_args.as_ref().and_then(|args| args.get("type")?.as_i64()) == Some(ROBOSUITE);
    Episode {
        name: demo.id.clone(),
        length: demo.length,
        task: demo.task.clone().or_else(|| plan.env_name.clone()).unwrap_or_default(),
        success: rewards.as_ref().filter(|_| robosuite).map(|rewards| rewards.iter().any(|&r| r >= 1.0)),
        total_reward: rewards.map(|rewards| rewards.iter().sum()),
        problems,
        columns: columns.iter().map(values).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dataset::edit::{Destination, Renames, rename};
    use std::ops::ControlFlow;

    #[test]
    fn a_return_is_the_sum_of_the_rewards_as_they_are_stored() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../crates/python/tests/fixtures/lerobot_odd");
        let set = folder.path().join("set");
        // of the first episode 0, 16777217 and -2
        let renames = Renames::from([("count".to_owned(), REWARD.to_owned())]);
        rename(&fixture, &Destination::New(set.clone()), &renames, &mut |_, _| ControlFlow::Continue(()))
            .expect("a data set");
        let opened = Opened::open(&set).expect("a data set");
        assert_eq!(opened.episode(0, &[]).total_reward, Some(16_777_215.0));
    }
}
