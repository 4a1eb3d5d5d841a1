//! The study file.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use models::actrm::{Intervention, Starts, Thinking};
use rollout::Skill;
use serde::{Deserialize, Serialize};
use zoo::ZooError;
use zoo::entry::CamerasMeta;
use zoo::evaluation::Perturbation;

/// A study, as its TOML file has it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Study {
    /// The page's heading.
    pub title: String,
    /// What the page begins with, beside the answers of its comparisons.
    #[serde(default)]
    pub verdict: String,
    /// How it was done, in Markdown.
    #[serde(default)]
    pub introduction: String,
    /// Folder of results, one file a training and test.
    pub results: PathBuf,
    /// The page.
    pub page: PathBuf,
    /// A zoo that gets the entries, named as families are (`stack-act-s1`), and their evaluations; where none is given they stay
    /// in the study's own folder, under the names of its cells.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub zoo: Option<PathBuf>,
    /// Demonstrations, by name.
    pub data: BTreeMap<String, Data>,
    /// What is trained, by name.
    pub arms: BTreeMap<String, Arm>,
    /// What is tested, by name.
    pub tests: BTreeMap<String, Test>,
    /// What is run, what decides most first.
    pub cells: Vec<CellRow>,
    /// Which arms are compared, the primary ones first.
    #[serde(default)]
    pub comparisons: Vec<Comparison>,
}

/// Demonstrations of the scripted expert.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Data {
    /// The task.
    pub task: String,
    /// How many that succeeded.
    pub episodes: u64,
    /// The collection's seed.
    #[serde(default = "one")]
    pub seed: u64,
    /// Another of the task's experts than the usual one, by its name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expert: Option<String>,
    /// How able whoever shows them is.
    #[serde(default, skip_serializing_if = "Skill::is_good")]
    pub skill: Skill,
    /// Cameras whose pictures they have.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cameras: Option<CamerasMeta>,
}

/// One kind of policy under study.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Arm {
    /// The experiment; `{data}` in it stands for the name of the demonstrations, `{task}` for their task's in small letters.
    pub experiment: String,
    /// Dotted settings laid over it.
    #[serde(default)]
    pub set: Vec<String>,
    /// What the page calls it.
    pub label: String,
}

/// Episodes that no training has seen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Test {
    /// The task.
    pub task: String,
    /// Episodes.
    pub episodes: u64,
    /// Seed of the first; the others count up.
    pub seed_start: u64,
    /// How policies think in it, where that is not as they were trained.
    #[serde(default, skip_serializing_if = "as_trained")]
    pub thinking: Thinking,
    /// What becomes of the pictures on their way to policies, as `actrm-zoo eval --perturb` has it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub perturb: Option<String>,
}

impl Data {
    /// Their file's name: of the task, what is not as usual, how many, and the seed.
    pub fn file_name(&self) -> String {
        let expert = self.expert.as_ref().map(|expert| format!("{expert}-")).unwrap_or_default();
        let skill = if self.skill.is_good() { String::new() } else { format!("{}-", self.skill) };
        let seen = self.cameras.as_ref().map(|cameras| {
            let usual = cameras.names == ["agentview", "robot0_eye_in_hand"];
            let names = if usual { String::new() } else { format!("{}-", cameras.names.join("+")) };
            let drawn = if cameras.fast_render { "" } else { "reflections-" };
            format!("seen{}-{names}{drawn}", cameras.size)
        });
        let seen = seen.unwrap_or_default();
        format!("{}-{expert}{skill}{seen}{}-seed{}.hdf5", self.task.to_lowercase(), self.episodes, self.seed)
    }

    /// What is not as usual with them, in words, each after a comma.
    pub fn words(&self) -> String {
        let expert = self.expert.as_ref().map(|expert| format!(", expert `{expert}`")).unwrap_or_default();
        let skill = if self.skill.is_good() { String::new() } else { format!(", skill `{}`", self.skill) };
        let of_cameras = |cameras: &CamerasMeta| {
            let CamerasMeta { names, size, fast_render } = cameras;
            let drawn = if *fast_render { "" } else { " with reflections" };
            format!(", images of {} ({size} x {size}{drawn})", names.join(" and "))
        };
        format!("{expert}{skill}{}", self.cameras.as_ref().map(of_cameras).unwrap_or_default())
    }
}

impl Test {
    /// Whether policies act in it as they were trained, their pictures as they are drawn.
    pub fn is_plain(&self) -> bool {
        as_trained(&self.thinking) && self.perturb.is_none()
    }

    /// What becomes of the pictures.
    pub fn perturbation(&self) -> Option<Perturbation> {
        self.perturb.as_ref().and_then(|text| text.parse().ok())
    }

    /// How policies think in it, in words; `None` where it is as they were trained.
    pub fn thinking_words(&self) -> Option<String> {
        let Thinking { steps, halting, halt_threshold, change_threshold, intervene, starts } = self.thinking;
        let steps = steps.map(|n| format!("{n} step{}", if n == 1 { "" } else { "s" }));
        let halting = halting.map(|halting| if halting { "early stopping" } else { "no early stopping" }.to_owned());
        let sure = halt_threshold.map(|threshold| format!("halting probability above {threshold}"));
        let still = change_threshold.map(|threshold| format!("chunk change below {threshold}"));
        let intervene = intervene.map(|intervention| match intervention {
            Intervention::Freeze => "reasoning frozen after the first step".to_owned(),
            Intervention::Shuffle => "reasoning of another episode".to_owned(),
        });
        let starts = starts.map(|Starts { count, noise }| format!("best of {count} samples, noise {noise}"));
        let words: Vec<String> = [steps, halting, sure, still, intervene, starts].into_iter().flatten().collect();
        (!words.is_empty()).then(|| words.join(", "))
    }
}

/// Trainings of some arms on the same demonstrations.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellRow {
    /// The arms, each trained once for a seed before the next seed is begun.
    pub arms: Vec<String>,
    /// The demonstrations.
    pub data: String,
    /// Trainings of each arm; their seeds are `first_seed` to this.
    pub seeds: u64,
    /// The seed of the first training.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub first_seed: u64,
    /// What each training is tested on.
    pub tests: Vec<String>,
    /// 1 for what was planned first; what was added later is run and reported after it.
    #[serde(default = "first", skip_serializing_if = "is_first")]
    pub stage: u8,
}

/// Two arms whose difference is a question of the study.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Comparison {
    /// The question, in words.
    pub question: String,
    /// The arm expected to be better.
    pub first: String,
    /// The other.
    pub second: String,
    /// The demonstrations of both, or of the first.
    pub data: String,
    /// Those of the second, where they are others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub second_data: Option<String>,
    /// The test of both.
    pub test: String,
    /// Only episodes of these groups; of all where empty.
    #[serde(default)]
    pub groups: Vec<String>,
    /// 1 for what was planned first; Holm's correction is made stage by stage.
    #[serde(default = "first", skip_serializing_if = "is_first")]
    pub stage: u8,
}

impl Comparison {
    /// Arm and demonstrations of both sides.
    pub(super) fn sides(&self) -> [(&String, &String); 2] {
        [(&self.first, &self.data), (&self.second, self.second_data.as_ref().unwrap_or(&self.data))]
    }
}

fn one() -> u64 {
    1
}

fn is_one(seed: &u64) -> bool {
    *seed == 1
}

fn first() -> u8 {
    1
}

fn is_first(stage: &u8) -> bool {
    *stage == 1
}

fn as_trained(thinking: &Thinking) -> bool {
    *thinking == Thinking::default()
}

impl Study {
    /// The experiment of an arm on the demonstrations called `data`.
    pub fn experiment_on(&self, arm: &str, data: &str) -> String {
        let task = self.data[data].task.to_lowercase();
        self.arms[arm].experiment.replace("{data}", data).replace("{task}", &task)
    }

    /// Reads and checks a study file.
    ///
    /// # Errors
    /// A file that cannot be read, an unknown key, a name that stands for nothing.
    pub fn open(path: &Path) -> Result<Self, ZooError> {
        let text = std::fs::read_to_string(path).map_err(|source| ZooError::Io {
            operation: "read",
            path: path.to_owned(),
            source,
        })?;
        let study: Self = toml::from_str(&text).map_err(|source| ZooError::ExperimentSyntax {
            experiment: path.display().to_string(),
            source: Box::new(source),
        })?;
        study.check()?;
        Ok(study)
    }

    fn check(&self) -> Result<(), ZooError> {
        let arms = |key: String, name: &str| known(key, name, &self.arms);
        let data = |key: String, name: &str| known(key, name, &self.data);
        let tests = |key: String, name: &str| known(key, name, &self.tests);
        for (i, row) in self.cells.iter().enumerate() {
            row.arms.iter().try_for_each(|name| arms(format!("cells[{i}].arms"), name))?;
            data(format!("cells[{i}].data"), &row.data)?;
            row.tests.iter().try_for_each(|name| tests(format!("cells[{i}].tests"), name))?;
            row.tests.iter().try_for_each(|name| self.check_camera(name, &row.data))?;
            if !(1..=row.seeds).contains(&row.first_seed) {
                return Err(ZooError::InvalidValue {
                    key: format!("cells[{i}].first_seed"),
                    expected: format!("1 to the last seed, {}", row.seeds),
                    found: row.first_seed.to_string(),
                });
            }
        }
        for (i, comparison) in self.comparisons.iter().enumerate() {
            arms(format!("comparisons[{i}].first"), &comparison.first)?;
            arms(format!("comparisons[{i}].second"), &comparison.second)?;
            data(format!("comparisons[{i}].data"), &comparison.data)?;
            if let Some(second) = &comparison.second_data {
                data(format!("comparisons[{i}].second_data"), second)?;
            }
            tests(format!("comparisons[{i}].test"), &comparison.test)?;
            for (arm, on) in comparison.sides() {
                let runs =
                    |row: &CellRow| row.arms.contains(arm) && row.data == *on && row.tests.contains(&comparison.test);
                if !self.cells.iter().any(runs) {
                    return Err(ZooError::InvalidValue {
                        key: format!("comparisons[{i}]"),
                        expected: "arms, demonstrations and a test that a cell has".to_owned(),
                        found: format!("{arm} on {on}, test {}", comparison.test),
                    });
                }
            }
        }
        for (name, test) in &self.tests {
            let Some(Err(expected)) = test.perturb.as_ref().map(|text| text.parse::<Perturbation>()) else { continue };
            let found = test.perturb.clone().unwrap_or_default();
            return Err(ZooError::InvalidValue { key: format!("tests.{name}.perturb"), expected, found });
        }
        for (kind, names) in [
            ("data", self.data.keys().collect::<Vec<_>>()),
            ("arms", self.arms.keys().collect()),
            ("tests", self.tests.keys().collect()),
        ] {
            if let Some(name) = names.iter().find(|name| !is_plain(name)) {
                return Err(ZooError::InvalidValue {
                    key: format!("{kind}.{name}"),
                    expected: "a name of lower-case letters, digits and hyphens".to_owned(),
                    found: (*name).clone(),
                });
            }
        }
        Ok(())
    }

    /// A test that changes pictures, after demonstrations that have them: said before anything is trained.
    fn check_camera(&self, test: &str, data: &str) -> Result<(), ZooError> {
        let Some(change) = self.tests[test].perturbation() else { return Ok(()) };
        let names = self.data[data].cameras.as_ref().map_or(&[][..], |cameras| cameras.names.as_slice());
        let there = match &change {
            Perturbation::Black(camera) => names.contains(camera),
            Perturbation::SwapCameras => names.len() > 1,
            _ => !names.is_empty(),
        };
        if there {
            return Ok(());
        }
        let cameras = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
        Err(ZooError::InvalidValue {
            key: format!("tests.{test}.perturb"),
            expected: format!("a change of cameras that data.{data} has: {cameras}"),
            found: change.to_string(),
        })
    }
}

/// Names become parts of file and entry names.
fn is_plain(name: &str) -> bool {
    !name.is_empty() && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-')
}

fn known<T>(key: String, name: &str, there: &BTreeMap<String, T>) -> Result<(), ZooError> {
    if there.contains_key(name) {
        return Ok(());
    }
    let names: Vec<&str> = there.keys().map(String::as_str).collect();
    Err(ZooError::InvalidValue { key, expected: format!("one of {}", names.join(", ")), found: name.to_owned() })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    const TEXT: &str = r#"
        title = "T"
        results = "docs/t"
        page = "docs/t.md"
        [data.lift]
        task = "Lift"
        episodes = 10
        [arms.act]
        experiment = "act_lift"
        label = "ACT"
        [tests.lift]
        task = "Lift"
        episodes = 5
        seed_start = 40000
        [[cells]]
        arms = ["act"]
        data = "lift"
        seeds = 2
        tests = ["lift"]
    "#;

    fn open(text: &str) -> Result<Study, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("study.toml");
        std::fs::write(&path, text).unwrap();
        Study::open(&path).map_err(|e| match std::error::Error::source(&e) {
            Some(source) => format!("{e}: {source}"),
            None => e.to_string(),
        })
    }

    #[test]
    fn names_that_stand_for_nothing_are_named() {
        let study = open(TEXT).unwrap();
        assert_eq!(study.data["lift"].seed, 1);
        let error = open(&TEXT.replace("arms = [\"act\"]", "arms = [\"atc\"]")).unwrap_err();
        assert_eq!(error, "key `cells[0].arms`: expected one of act, found atc");
        let error = open(&TEXT.replace("[arms.act]", "[arms.Act_1]")).unwrap_err();
        assert!(error.contains("cells[0].arms") || error.contains("arms.Act_1"), "{error}");
        assert!(open(&TEXT.replace("seeds = 2", "seed = 2")).unwrap_err().contains("seed"));
        let error = open(&TEXT.replace("seeds = 2", "seeds = 2\nfirst_seed = 3")).unwrap_err();
        assert_eq!(error, "key `cells[0].first_seed`: expected 1 to the last seed, 2, found 3");
        let other = "[tests.other]\ntask = \"Lift\"\nepisodes = 5\nseed_start = 50000\n";
        let compared = |test: &str| {
            format!(
                "{TEXT}{other}[[comparisons]]\nquestion = \"?\"\nfirst = \"act\"\nsecond = \"act\"\ndata = \"lift\"\n\
                 test = \"{test}\"\n"
            )
        };
        open(&compared("lift")).unwrap();
        assert_eq!(
            open(&compared("other")).unwrap_err(),
            "key `comparisons[0]`: expected arms, demonstrations and a test that a cell has, found act on lift, test other"
        );
    }

    #[test]
    fn a_test_may_ask_for_another_thought() {
        let with =
            |thinking: &str| TEXT.replace("seed_start = 40000", &format!("seed_start = 40000\nthinking = {thinking}"));
        let words = |thinking: &str| open(&with(thinking)).unwrap().tests["lift"].thinking_words();
        assert_eq!(open(TEXT).unwrap().tests["lift"].thinking_words(), None);
        assert_eq!(words("{ steps = 1 }").unwrap(), "1 step");
        assert_eq!(words("{ steps = 8, halting = true }").unwrap(), "8 steps, early stopping");
        assert_eq!(words("{ halting = false }").unwrap(), "no early stopping");
        assert_eq!(
            words("{ halting = true, halt_threshold = 0.9, change_threshold = 0.005 }").unwrap(),
            "early stopping, halting probability above 0.9, chunk change below 0.005"
        );
        assert_eq!(words("{ steps = 6, intervene = \"shuffle\" }").unwrap(), "6 steps, reasoning of another episode");
        let starts = "{ steps = 6, starts = { count = 8, noise = 0.5 } }";
        assert_eq!(words(starts).unwrap(), "6 steps, best of 8 samples, noise 0.5");
        assert!(open(&with("{ step = 1 }")).unwrap_err().contains("step"));
        // a test as trained keeps its text
        assert!(!serde_json::to_string(&open(TEXT).unwrap().tests["lift"]).unwrap().contains("thinking"));
    }

    #[test]
    fn demonstrations_may_have_pictures_and_tests_may_change_them() {
        let cameras = r#"episodes = 10
        cameras = { names = ["agentview", "robot0_eye_in_hand"], size = 84, fast_render = true }"#;
        let study = open(&TEXT.replace("episodes = 10", cameras)).unwrap();
        let data = &study.data["lift"];
        assert_eq!(data.file_name(), "lift-seen84-10-seed1.hdf5");
        assert_eq!(data.words(), ", images of agentview and robot0_eye_in_hand (84 x 84)");
        assert_eq!(open(TEXT).unwrap().data["lift"].file_name(), "lift-10-seed1.hdf5");
        let with =
            |perturb: &str| TEXT.replace("seed_start = 40000", &format!("seed_start = 40000\nperturb = \"{perturb}\""));
        let error = open(&with("black-agentview")).unwrap_err();
        assert_eq!(
            error,
            "key `tests.lift.perturb`: expected a change of cameras that data.lift has: none, found black-agentview"
        );
        let seen = "[data.lift]\ncameras = { names = [\"agentview\"], size = 84, fast_render = true }";
        let with = |perturb: &str| with(perturb).replace("[data.lift]", seen);
        assert!(open(&with("black-sideview")).unwrap_err().contains("data.lift has: agentview, found black-sideview"));
        let test = open(&with("black-agentview")).unwrap().tests["lift"].clone();
        assert_eq!((test.is_plain(), test.perturbation()), (false, Some(Perturbation::Black("agentview".to_owned()))));
        assert!(open(TEXT).unwrap().tests["lift"].is_plain());
        let error = open(&with("blck-agentview")).unwrap_err();
        assert!(error.contains("tests.lift.perturb") && error.contains("black-CAMERA"), "{error}");
        // what has neither keeps its text
        let plain = serde_json::to_string(&open(TEXT).unwrap()).unwrap();
        assert!(!plain.contains("cameras") && !plain.contains("perturb"), "{plain}");
    }

    #[test]
    fn the_zoo_is_tested_as_named_protocols_say() {
        let study = Study::open(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../../studies/policies.toml")).unwrap();
        let protocols = zoo::protocols::Protocols::built_in();
        for (name, test) in &study.tests {
            let protocol = protocols.get(&format!("{name}-v1")).unwrap();
            assert_eq!(
                (&test.task, test.seed_start, test.episodes),
                (&protocol.task, protocol.test.start, protocol.test.count)
            );
        }
        let library = zoo::config::Library::built_in();
        for cell in super::super::cells::cells(&study) {
            let name = study.experiment_on(&cell.arm, &cell.data);
            let experiment = zoo::experiment::Experiment::load(&library, &name, &study.arms[&cell.arm].set);
            assert_eq!(experiment.unwrap().task.name, study.data[&cell.data].task, "{name}");
        }
    }

    #[test]
    fn every_study_that_is_shipped_is_sound() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../studies");
        let mut studies = 0;
        for file in std::fs::read_dir(folder).unwrap() {
            let study = Study::open(&file.unwrap().path()).unwrap();
            assert!(!study.cells.is_empty());
            studies += 1;
        }
        assert!(studies > 0);
    }
}
