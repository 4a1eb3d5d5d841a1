//! Named protocols: what an evaluation has to keep to so that its numbers may stand beside others' under that name.
//!
//! A file of `protocols/` says the task, the cap on an episode, the control loop, the simulator's versions and two blocks
//! of seeds: `dev` for choosing, `test` for reporting. The best of many, chosen on the seeds that it is reported on, looks
//! better than it is. Its name ends in its version; a file that was used is never changed.
//!
//! Whether an evaluation is of a protocol is read off its record: nothing has to be claimed, and evaluations that were
//! made before there were names have them, too.

use std::collections::BTreeMap;
use std::path::Path;

use rollout::Control;
use serde::Deserialize;

use crate::ZooError;
use crate::config::{from_value, nearest};
use crate::results::{EvaluationRecord, Execution, Protocol, Seeds};

/// The files of `protocols/`, built into the binary.
const BUILT_IN: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/protocols.rs"));
/// The rule of which expected and found are told.
const VERSIONS: &str = "versions";
/// More seeds than a block has, and more steps than an episode takes.
const MOST: u64 = 1_000_000;

/// Which of a protocol's seeds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Block {
    /// For reporting.
    Test,
    /// For choosing.
    Dev,
}

impl std::fmt::Display for Block {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Test => "test",
            Self::Dev => "dev",
        })
    }
}

/// One protocol.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedProtocol {
    /// Its name with its version: `lift-v1`.
    pub name: String,
    /// The task.
    pub task: String,
    /// Control steps after which an episode counts as failed.
    pub max_steps: usize,
    /// The control loop.
    pub control: Control,
    /// How predictions become actions, if the protocol says; each entry's own way otherwise.
    pub execution: Option<Execution>,
    /// Seeds for choosing.
    pub dev: Seeds,
    /// Seeds for reporting.
    pub test: Seeds,
    /// Versions of the simulator and what it stands on, as far as they are fixed.
    pub versions: BTreeMap<String, String>,
}

/// The file's own form.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Text {
    task: String,
    max_steps: i64,
    control: String,
    #[serde(default)]
    execution: Option<Execution>,
    dev: String,
    test: String,
    #[serde(default)]
    versions: BTreeMap<String, String>,
}

impl NamedProtocol {
    /// Reads the text of the file called `name`.
    ///
    /// # Errors
    /// [`ZooError::Protocol`]: a name without a version, text that is no protocol, a cap or a block that no evaluation can have,
    /// blocks that overlap.
    pub fn read(name: &str, text: &str) -> Result<Self, ZooError> {
        let refuse = |reason: String| Err(ZooError::Protocol { name: name.to_owned(), reason });
        let version = name.rsplit_once("-v").and_then(|(_, version)| version.parse::<u32>().ok());
        if version.is_none_or(|version| version == 0) {
            return refuse("expected a name that ends in its version, such as lift-v1".to_owned());
        }
        let table: toml::Table = match toml::from_str(text) {
            Ok(table) => table,
            Err(error) => return refuse(error.to_string().trim_end().replace('\n', "; ")),
        };
        let read: Text = from_value(&toml::Value::Table(table), &[name])?;
        let seeds = |key: &str, text: &str| {
            text.parse::<Seeds>()
                .map_err(|reason| ZooError::Protocol { name: name.to_owned(), reason: format!("{key}: {reason}") })
        };
        let (dev, test) = (seeds("dev", &read.dev)?, seeds("test", &read.test)?);
        if let Some((key, block)) = [("dev", dev), ("test", test)].into_iter().find(|(_, block)| block.count > MOST) {
            return refuse(format!("{key}: expected at most {MOST} seeds, found {} ({block})", block.count));
        }
        if dev.overlap(&test) {
            return refuse(format!("test: expected seeds that are none of dev, {dev}, found {test}"));
        }
        let Ok(control) = read.control.parse() else {
            return refuse(format!("control: expected compiled or robosuite, found {}", read.control));
        };
        let max_steps = match usize::try_from(read.max_steps) {
            Ok(steps @ 1..) if steps as u64 <= MOST => steps,
            _ => {
                return refuse(format!(
                    "max_steps: expected a positive integer up to {MOST}, found {}",
                    read.max_steps
                ));
            }
        };
        let Text { task, execution, versions, .. } = read;
        Ok(Self { name: name.to_owned(), task, max_steps, control, execution, dev, test, versions })
    }

    /// The seeds of a block.
    pub fn seeds(&self, block: Block) -> Seeds {
        match block {
            Block::Dev => self.dev,
            Block::Test => self.test,
        }
    }

    /// Whether it is built into the binary.
    fn is_built_in(&self) -> bool {
        BUILT_IN.iter().any(|(name, _)| *name == self.name)
    }

    /// Whether both play by the same rules, whatever their seeds.
    fn plays_as(&self, other: &Self) -> bool {
        self.task == other.task && self.max_steps == other.max_steps && self.control == other.control
    }

    /// The block that an evaluation ran, whole and by these rules; nothing for any other.
    pub fn block_of(&self, record: &EvaluationRecord) -> Option<Block> {
        let whole = |block: &Block| self.seeds(*block) == record.seeds;
        let block = [Block::Test, Block::Dev].into_iter().find(whole);
        block.filter(|_| record.shard.is_none() && self.broken_by(record).is_none())
    }

    /// The first rule that an evaluation did not keep to, whatever its seeds.
    fn broken_by(&self, record: &EvaluationRecord) -> Option<&'static str> {
        let rules = &record.protocol;
        let fixed = |(name, version): (&String, &String)| record.versions.get(name) == Some(version);
        Some(if rules.task != self.task {
            "task"
        } else if rules.max_steps != self.max_steps {
            "max_steps"
        } else if rules.control != self.control {
            "control loop"
        } else if rules.perturbation.is_some() {
            "perturbation"
        } else if rules.rules != Protocol::RULES {
            "version of the rules"
        } else if rules.env_name != self.task && !self.task.contains('/') {
            // those of a suite, `suite/task`, are of the suite's class
            "environment"
        } else if rules.env_module.is_some() {
            "environment module"
        } else if rules.env_args_sha256.is_some() {
            "robot or controller"
        } else if !record.changed_sources().is_empty() {
            "source of the simulator"
        } else if self.execution.is_some_and(|execution| execution != record.execution) {
            "execution"
        } else if !self.versions.iter().all(fixed) {
            VERSIONS
        } else {
            return None;
        })
    }

    /// What is said of an evaluation that ran a block of this protocol, but does not count as its; nothing where it does.
    pub fn doubt(&self, record: &EvaluationRecord) -> Option<String> {
        let rule = self.broken_by(record)?;
        let (entry, name) = (&record.entry, &self.name);
        Some(match rule {
            VERSIONS => {
                format!("{entry}: not of {name}, which fixes {:?}: found {:?}", self.versions, record.versions)
            }
            rule => format!("{entry}: not of {name}: its {rule} is not the protocol's"),
        })
    }
}

/// Named protocols, sorted by name.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Protocols(Vec<NamedProtocol>);

impl Protocols {
    /// Those built into the binary.
    ///
    /// # Panics
    /// If one of them cannot be read; a test reads them.
    pub fn built_in() -> Self {
        let read = |(name, text): &(&str, &str)| NamedProtocol::read(name, text).expect("a test reads every one");
        Self(BUILT_IN.iter().map(read).collect())
    }

    /// Those built in and the files of `folder`, which must have names of their own.
    ///
    /// # Errors
    /// Files that are no protocols; a name that is built in with another text.
    pub fn with_folder(folder: &Path) -> Result<Self, ZooError> {
        let mut all = Self::built_in();
        let mut paths = Vec::new();
        for item in std::fs::read_dir(folder).map_err(ZooError::io("open folder of protocols", folder))? {
            paths.push(item.map_err(ZooError::io("read folder", folder))?.path());
        }
        paths.sort();
        for path in paths.into_iter().filter(|path| path.extension().is_some_and(|extension| extension == "toml")) {
            all.add(&path)?;
        }
        all.0.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(all)
    }

    fn add(&mut self, path: &Path) -> Result<(), ZooError> {
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let text = std::fs::read_to_string(path).map_err(ZooError::io("read", path))?;
        let read = NamedProtocol::read(&name, &text)?;
        match self.0.iter().find(|known| known.name == name) {
            Some(known) if *known == read => Ok(()),
            Some(_) => {
                let reason =
                    format!("{} says otherwise than the one built in; another rule is another version", path.display());
                Err(ZooError::Protocol { name, reason })
            }
            None => {
                self.0.push(read);
                Ok(())
            }
        }
    }

    /// Why a user's protocol is not used: by the same rules it chooses by seeds that another one reports on, or reports on seeds
    /// by which one that is built in chooses.
    fn clash(&self, own: &NamedProtocol) -> Option<String> {
        if own.is_built_in() {
            return None;
        }
        self.0.iter().filter(|other| other.plays_as(own)).find_map(|other| {
            let (block, of_other, seeds, found) = if own.dev.overlap(&other.test) {
                ("dev", "test", other.test, own.dev)
            } else if other.is_built_in() && own.test.overlap(&other.dev) {
                ("test", "dev", other.dev, own.test)
            } else {
                return None;
            };
            let name = &other.name;
            Some(format!("{block}: expected seeds that are none of {of_other} of {name}, {seeds}, found {found}"))
        })
    }

    /// What is to be said of protocols that are not used.
    pub fn notes(&self) -> Vec<String> {
        let told = |own: &NamedProtocol| Some(format!("protocol `{}` is not used: {}", own.name, self.clash(own)?));
        self.0.iter().filter_map(told).collect()
    }

    /// Every one.
    pub fn iter(&self) -> impl Iterator<Item = &NamedProtocol> {
        self.0.iter()
    }

    /// The protocol of that name.
    ///
    /// # Errors
    /// [`ZooError::Protocol`] with what there is, or with why it is not used.
    pub fn get(&self, name: &str) -> Result<&NamedProtocol, ZooError> {
        let found = self.0.iter().find(|protocol| protocol.name == name).ok_or_else(|| {
            let names: Vec<String> = self.0.iter().map(|protocol| protocol.name.clone()).collect();
            let hint = nearest(name, &names).map_or(String::new(), |near| format!(" (did you mean `{near}`?)"));
            let reason = format!("not found{hint}; protocols: {}", names.join(", "));
            ZooError::Protocol { name: name.to_owned(), reason }
        })?;
        match self.clash(found) {
            Some(reason) => Err(ZooError::Protocol { name: name.to_owned(), reason }),
            None => Ok(found),
        }
    }

    /// The protocol and the block that an evaluation ran, if it is one of these. One that is built in comes before a user's.
    pub fn block_of(&self, record: &EvaluationRecord) -> Option<(String, Block)> {
        let of = |built_in: bool| {
            let known = self.0.iter().filter(move |protocol| protocol.is_built_in() == built_in);
            let mut of_record = known.filter_map(|protocol| Some((protocol, protocol.block_of(record)?)));
            let found = of_record.find(|(protocol, _)| self.clash(protocol).is_none());
            found.map(|(protocol, block)| (protocol.name.clone(), block))
        };
        of(true).or_else(|| of(false))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::results::testing::sample;

    const LIFT: &str = "task = 'Lift'\nmax_steps = 400\ncontrol = 'robosuite'\ndev = '10000-10099'\ntest = '40000-40199'\n\
                        [versions]\nmujoco = '3.3.7'";

    #[test]
    fn every_protocol_that_is_built_in_reads_and_no_two_are_of_one_evaluation() {
        let all = Protocols::built_in();
        assert_eq!(all.iter().count(), BUILT_IN.len());
        assert!(all.get("lift-v1").is_ok());
        for (k, one) in all.0.iter().enumerate() {
            for two in &all.0[k + 1..] {
                let tells = one.task != two.task || one.max_steps != two.max_steps || one.test != two.test;
                assert!(
                    tells || one.versions != two.versions || one.control != two.control,
                    "{}, {}",
                    one.name,
                    two.name
                );
            }
        }
        let message = all.get("lfit-v1").unwrap_err().to_string();
        assert!(message.contains("did you mean `lift-v1`"), "{message}");
    }

    #[test]
    fn an_evaluation_is_of_a_protocol_if_it_kept_to_it() {
        let protocol = NamedProtocol::read("lift-v1", LIFT).unwrap();
        let mut record = sample("a", 1, 100);
        assert_eq!(protocol.block_of(&record), Some(Block::Dev));
        record.seeds = Seeds { start: 40_000, count: 200 };
        assert_eq!(protocol.block_of(&record), Some(Block::Test));
        assert_eq!(protocol.doubt(&record), None);
        #[allow(clippy::type_complexity)]
        let changes: [fn(&mut EvaluationRecord); 10] = [
            |r| r.seeds.count = 199,
            |r| r.protocol.rules = 2,
            |r| r.protocol.env_name = "LiftEasy".into(),
            |r| r.protocol.max_steps = 500,
            |r| r.protocol.control = Control::Compiled,
            |r| r.protocol.env_args_sha256 = Some("0".repeat(64)),
            |r| r.shard = Some(crate::results::Shard { index: 1, count: 2 }),
            |r| drop(r.versions.insert("mujoco".into(), "3.9.0".into())),
            |r| drop(r.sources.insert("robosuite".into(), "0".repeat(64))),
            |r| r.protocol.task = "Stack".into(),
        ];
        for change in changes {
            let mut other = record.clone();
            change(&mut other);
            assert_eq!(protocol.block_of(&other), None, "{other:?}");
        }
        let doubt = |change: fn(&mut EvaluationRecord)| {
            let mut other = record.clone();
            change(&mut other);
            protocol.doubt(&other).unwrap()
        };
        let versions = doubt(|r| drop(r.versions.insert("mujoco".into(), "3.9.0".into())));
        assert!(versions.contains("3.3.7") && versions.contains("3.9.0"), "{versions}");
        let robot = doubt(|r| r.protocol.env_args_sha256 = Some("0".repeat(64)));
        assert_eq!(robot, "a@1: not of lift-v1: its robot or controller is not the protocol's");
    }

    #[test]
    fn what_is_no_protocol_is_refused_by_name() {
        for (name, text, word) in [
            ("lift", LIFT.to_owned(), "ends in its version"),
            ("lift-v0", LIFT.to_owned(), "ends in its version"),
            ("lift-v1", LIFT.replace("40000-40199", "10050-10200"), "none of dev"),
            ("lift-v1", LIFT.replace("10000-10099", "ten"), "dev: "),
            ("lift-v1", LIFT.replace("max_steps", "max_stepz"), "max_stepz"),
            ("lift-v1", LIFT.replace("'robosuite'", "'other'"), "control: expected"),
            ("lift-v1", "task = ".to_owned(), "lift-v1"),
            ("lift-v1", LIFT.replace("= 400", "= 0"), "max_steps: expected a positive integer up to 1000000, found 0"),
            (
                "lift-v1",
                LIFT.replace("= 400", "= -1"),
                "max_steps: expected a positive integer up to 1000000, found -1",
            ),
            ("lift-v1", LIFT.replace("40199", "2000000"), "test: expected at most 1000000 seeds, found 1960001"),
        ] {
            let error = NamedProtocol::read(name, &text).unwrap_err().to_string();
            assert!(error.contains(word), "{word}: {error}");
        }
    }

    #[test]
    fn a_folder_adds_protocols_and_changes_none() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("mine-v2.toml"), LIFT).unwrap();
        let all = Protocols::with_folder(folder.path()).unwrap();
        assert_eq!(all.get("mine-v2").unwrap().dev, Seeds { start: 10_000, count: 100 });
        std::fs::write(folder.path().join("lift-v1.toml"), LIFT).unwrap();
        let error = Protocols::with_folder(folder.path()).unwrap_err().to_string();
        assert!(error.contains("another version"), "{error}");
        std::fs::remove_file(folder.path().join("lift-v1.toml")).unwrap();

        // the block that lift-v1 reports on is for choosing nowhere, and keeps its name
        let mine = LIFT.replace("'robosuite'", "'compiled'");
        let write = |text: String| std::fs::write(folder.path().join("a-v1.toml"), text).unwrap();
        write(mine.replace("40000-40199", "50000-50199").replace("10000-10099", "40100-40299"));
        let refused = || Protocols::with_folder(folder.path()).unwrap().get("a-v1").unwrap_err().to_string();
        let expected =
            "protocol `a-v1`: dev: expected seeds that are none of test of lift-v1, 40000-40199, found 40100-40299";
        assert_eq!(refused(), expected);
        write(mine.replace("10000-10099", "50000-50199").replace("40000-40199", "10050-10149"));
        assert!(refused().contains("test: expected seeds that are none of dev of lift-v1, 10000-10099"));
        let all = Protocols::with_folder(folder.path()).unwrap();
        assert!(all.notes()[0].starts_with("protocol `a-v1` is not used: test: ") && all.get("mine-v2").is_ok());
        let mut record = sample("a", 1, 100);
        record.protocol.control = Control::Compiled;
        record.seeds.start = 10_050;
        assert_eq!(all.block_of(&record), None);
        write(mine);
        let all = Protocols::with_folder(folder.path()).unwrap();
        let mut record = sample("a", 1, 200);
        (record.seeds.start, record.protocol.control) = (40_000, Control::Compiled);
        assert_eq!(all.block_of(&record), Some(("lift-v1".to_owned(), Block::Test)));
    }
}
