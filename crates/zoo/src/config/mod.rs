//! Experiments: TOML, composed from the files of `configs/`, changed by dotted overrides.
//!
//! An experiment is a policy on a task with some inputs. Its name says so, `act_stack` or `act_stack_image`, and its settings are laid
//! over each other in this order (`compose.rs`):
//!
//! `base.toml` < `policy/` < `task/` < `inputs/` < `recipe/` < the command line
//!
//! The files are built into the binary. A folder given by the user comes first: its own experiments, and files of the same groups.

mod compose;
mod embedded;
mod overrides;
mod value;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use toml::Table;

use crate::ZooError;

pub use overrides::apply_overrides;
pub use value::{from_value, from_value_as};

/// The name most like `name`, if one is like it: at most a third of its letters differ.
pub fn nearest(name: &str, names: &[String]) -> Option<String> {
    nearest_of(name, names, 1).pop()
}

/// The names most like `name`, best first, at most `count` of them.
pub fn nearest_of(name: &str, names: &[String], count: usize) -> Vec<String> {
    let mut near: Vec<(usize, &String)> = names
        .iter()
        .map(|n| (strsim::damerau_levenshtein(&name.to_lowercase(), &n.to_lowercase()), n))
        .filter(|(distance, n)| *distance <= (name.len().max(n.len()) / 3).max(1))
        .collect();
    near.sort();
    near.into_iter().take(count).map(|(_, n)| n.clone()).collect()
}

/// Refuses names that are not the plain name of a file: an experiment's folder of runs is called like it.
///
/// # Errors
/// [`ZooError::ExperimentName`].
pub fn check_experiment_name(name: &str) -> Result<(), ZooError> {
    const LONGEST: usize = 200;
    let refuse = |reason| Err(ZooError::ExperimentName { name: name.to_owned(), reason });
    if name.is_empty() || name == "." || name == ".." || name.contains(['/', '\\', '\0']) {
        return refuse("expected the plain name of a file, without its folder");
    }
    if name.len() > LONGEST {
        return refuse("expected at most 200 bytes");
    }
    Ok(())
}

/// Where experiments come from: a folder, if the user has one, and then those built in.
#[derive(Debug, Clone, Default)]
pub struct Library {
    folder: Option<PathBuf>,
}

impl Library {
    /// The experiments built into the binary.
    pub fn built_in() -> Self {
        Self::default()
    }

    /// Files of `folder` first, then the experiments built in.
    ///
    /// # Errors
    /// When `folder` is not a folder.
    pub fn with_folder(folder: &Path) -> Result<Self, ZooError> {
        std::fs::read_dir(folder).map_err(ZooError::io("open experiment folder", folder))?;
        Ok(Self { folder: Some(folder.to_owned()) })
    }

    /// Names of the files of a group (`policy`, `task`, ...; the empty one: the user's own experiments), sorted, without parts that
    /// others extend (`_name`).
    fn group(&self, group: &str) -> Result<Vec<String>, ZooError> {
        let mut names: Vec<String> = embedded::FILES
            .iter()
            .filter_map(|(path, _)| path.rsplit_once('/').filter(|(folder, _)| *folder == group))
            .map(|(_, name)| name.to_owned())
            .collect();
        if let Some(folder) = self.folder.as_ref().map(|f| f.join(group)).filter(|folder| folder.is_dir()) {
            for item in std::fs::read_dir(&folder).map_err(ZooError::io("read folder", &folder))? {
                let path = item.map_err(ZooError::io("read folder", &folder))?.path();
                let stem = path.file_stem().and_then(|s| s.to_str());
                if let (Some(stem), Some("toml")) = (stem, path.extension().and_then(|e| e.to_str())) {
                    names.push(stem.to_owned());
                }
            }
        }
        names.retain(|n| !n.starts_with('_'));
        names.sort();
        names.dedup();
        Ok(names)
    }

    /// The file `path` (`policy/act`, `base`, or the user's `my_experiment`), if there is one.
    fn file(&self, path: &str) -> Result<Option<Table>, ZooError> {
        let own = self.folder.as_ref().map(|folder| folder.join(format!("{path}.toml"))).filter(|file| file.is_file());
        let text = match own {
            Some(file) => std::fs::read_to_string(&file).map_err(ZooError::io("read", file))?,
            None => match embedded::FILES.iter().find(|(name, _)| *name == path) {
                Some((_, text)) => (*text).to_owned(),
                None => return Ok(None),
            },
        };
        toml::from_str(&text)
            .map(Some)
            .map_err(|source| ZooError::ExperimentSyntax { experiment: path.to_owned(), source: Box::new(source) })
    }
}

/// Whether an experiment that is built in is about this task: one that a simulator has.
pub(crate) fn is_built_in_task(name: &str) -> bool {
    static TASKS: OnceLock<BTreeSet<String>> = OnceLock::new();
    let tasks = TASKS.get_or_init(|| {
        let tables = embedded::FILES.iter().filter_map(|(_, text)| toml::from_str::<Table>(text).ok());
        tables.filter_map(|table| Some(table.get("task")?.get("name")?.as_str()?.to_owned())).collect()
    });
    tasks.contains(name)
}

/// Lays `above` over `below`: tables merge key by key, anything else is replaced.
fn merge(below: &mut Table, above: Table) {
    for (key, value) in above {
        match (below.get_mut(&key), value) {
            (Some(toml::Value::Table(inner)), toml::Value::Table(outer)) => merge(inner, outer),
            (_, value) => {
                below.insert(key, value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn library(files: &[(&str, &str)]) -> (tempfile::TempDir, Library) {
        let folder = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let file = folder.path().join(format!("{name}.toml"));
            std::fs::create_dir_all(file.parent().unwrap()).unwrap();
            std::fs::write(file, text).unwrap();
        }
        let library = Library::with_folder(folder.path()).unwrap();
        (folder, library)
    }

    #[test]
    fn tasks_of_the_experiments_are_known() {
        for task in ["Lift", "PickPlaceCan", "TwoArmTransport"] {
            assert!(is_built_in_task(task), "{task}");
        }
        assert!(!is_built_in_task("transfer_cube") && !is_built_in_task("lift"));
    }

    #[test]
    fn extending_files_win_key_by_key() {
        let (_folder, library) = library(&[
            ("_a", "x = 1\n[train]\nsteps = 10\nlr = 0.1\nkeys = [1, 2]"),
            ("_b", "extends = '_a'\n[train]\nsteps = 20"),
            ("c", "extends = '_b'\ny = 2\n[train]\nkeys = [3]"),
        ]);
        let table = library.resolve("c").unwrap();
        let expected: Table =
            toml::from_str("x = 1\ny = 2\nentry = 'c'\n[train]\nsteps = 20\nlr = 0.1\nkeys = [3]").unwrap();
        assert_eq!(table, expected);
        let names = library.names().unwrap();
        assert!(names.contains(&"c".to_owned()) && !names.contains(&"_a".to_owned()));
    }

    #[test]
    fn a_name_with_a_folder_is_refused_before_any_file_is_opened() {
        let (folder, library) = library(&[("up", "x = 1"), ("down", "extends = '../up'")]);
        let inner = folder.path().join("inner");
        std::fs::create_dir(&inner).unwrap();
        let below = Library::with_folder(&inner).unwrap();
        for name in ["../up", "/etc/passwd", "", ".."] {
            let error = below.resolve(name).unwrap_err().to_string();
            assert!(error.starts_with(&format!("experiment name `{name}`: expected the plain name")), "{error}");
        }
        assert!(library.resolve("down").unwrap_err().to_string().contains("`../up`"));
        assert!(library.resolve(&"x".repeat(300)).unwrap_err().to_string().ends_with("at most 200 bytes"));
    }

    #[test]
    fn of_several_that_are_extended_the_later_ones_win() {
        let (_folder, library) = library(&[
            ("_base", "x = 1\ny = 1"),
            ("_policy", "extends = '_base'\ny = 2\nz = 2"),
            ("_task", "z = 3"),
            ("e", "extends = ['_policy', '_task']\nw = 4"),
            ("f", "extends = ['_policy', 5]"),
        ]);
        let table = library.resolve("e").unwrap();
        let value = |key: &str| table[key].as_integer().unwrap();
        assert_eq!([value("x"), value("y"), value("z"), value("w")], [1, 2, 3, 4]);
        assert!(library.resolve("f").unwrap_err().to_string().contains("or a list of names, found 5"));
    }

    #[test]
    fn a_file_that_extends_itself_is_named() {
        let (_folder, library) = library(&[
            ("p", "extends = 'q'"),
            ("q", "extends = 'p'"),
            ("task/here", "extends = '_there'"),
            ("task/_there", "extends = 'here'"),
        ]);
        assert_eq!(library.resolve("p").unwrap_err().to_string(), "experiment `p` extends itself: p -> q -> p");
        let error = library.resolve("act_here").unwrap_err().to_string();
        assert!(error.ends_with("task/here -> task/_there -> task/here"), "{error}");
    }

    #[test]
    fn an_unknown_experiment_has_the_nearest_names() {
        let message = Library::built_in().resolve("act_lfit").unwrap_err().to_string();
        assert!(message.starts_with("unknown experiment `act_lfit` (did you mean `act_lift`, `"), "{message}");
        assert!(message.ends_with("`?). `actrm-zoo list --experiments` lists all of them"), "{message}");
        assert_eq!(message.matches('`').count(), 8, "two names: {message}");
    }

    #[test]
    fn a_part_that_is_not_there_is_named_with_those_that_are() {
        let choose = |words: &[&str]| {
            let words: Vec<String> = words.iter().map(|word| (*word).to_owned()).collect();
            Library::built_in().choose(&words).map(|(name, _)| name).map_err(|error| error.to_string())
        };
        let error = choose(&["act_lift", "policy=nope"]).unwrap_err();
        assert!(
            error.starts_with("key `policy`: expected one of act, actrm, ") && error.ends_with("`nope`"),
            "{error}"
        );
        let error = choose(&["policy=act", "task=lfit"]).unwrap_err();
        assert!(error.ends_with("found `lfit` (did you mean `lift`?)"), "{error}");
        assert_eq!(choose(&["policy=trm", "task=dfs10"]).unwrap(), "trm_dfs10");
    }

    #[test]
    fn settings_that_would_be_lost_are_refused() {
        let (_folder, library) =
            library(&[("act_lift", "extends = 'bc_lift'"), ("task/here", "[for.imgae.train]\nsteps = 7")]);
        let error = library.choose(&["act_lift".to_owned(), "inputs=image".to_owned()]).unwrap_err().to_string();
        assert!(error.starts_with("key `inputs`: expected no change to act_lift, whose file"), "{error}");
        let error = library.resolve("act_here").unwrap_err().to_string();
        assert!(error.contains("`task/here: for.imgae`") && error.contains("did you mean `image`?"), "{error}");
        // what no combination reads
        for (file, text, named) in [
            ("task/here", "[for.here_image.train]\nsteps = 7", "`task/here: for.here_image`: expected inputs"),
            ("inputs/seen", "[for.lift.train]\nsteps = 7", "`inputs/seen: for.lift`: expected no `for`"),
        ] {
            let (_folder, library) = super::tests::library(&[(file, text), ("task/sees", "inputs = ['seen']")]);
            let name = if file == "task/here" { "act_here" } else { "act_sees_seen" };
            let error = library.resolve(name).unwrap_err().to_string();
            assert!(error.contains(named), "{error}");
        }
    }

    #[test]
    fn every_file_of_configs_is_built_in() {
        fn below(folder: &Path, group: &str, into: &mut Vec<(String, String)>) {
            for item in std::fs::read_dir(folder).unwrap() {
                let path = item.unwrap().path();
                let name = format!("{group}{}", path.file_stem().unwrap().to_str().unwrap());
                match path.is_dir() {
                    true => below(&path, &format!("{name}/"), into),
                    false => into.push((name, std::fs::read_to_string(path).unwrap())),
                }
            }
        }
        let mut on_disk = Vec::new();
        below(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs"), "", &mut on_disk);
        on_disk.sort();
        let mut built_in: Vec<(String, String)> =
            embedded::FILES.iter().map(|(n, t)| ((*n).to_owned(), (*t).to_owned())).collect();
        built_in.sort();
        assert_eq!(on_disk, built_in);
        assert!(on_disk.len() <= 120, "{} files: a combination is composed, not listed", on_disk.len());
    }

    #[test]
    fn far_away_names_are_not_suggested() {
        let names = ["steps".to_owned(), "lr".to_owned()];
        assert_eq!(nearest("stpes", &names), Some("steps".to_owned()));
        assert_eq!(nearest("batch_size", &names), None);
    }

    #[test]
    fn the_user_s_groups_come_first_and_numbers_of_one_combination_are_laid_over_all_others() {
        let (_folder, library) = library(&[
            (
                "policy/mine",
                "title = 'Mine'\n[policy]\ntype = 'bc'\n[train]\nsteps = 1\n[for.image.train]\nsteps = 2\n\
                 [for.sweep.train]\nsteps = 3\n[for.sweep_image.train]\nlr = 0.5",
            ),
            (
                "task/sweep",
                "title = 'Sweep'\ninputs = ['state', 'image']\n[task]\nname = 'Sweep'\n[for.state.data]\nenv_keys = ['dirt']\n\
                 [for.image.data]\npath = 'seen.hdf5'",
            ),
            ("recipe/mine_sweep", "[train]\nlr = 0.25"),
        ]);
        let state = library.resolve("mine_sweep").unwrap();
        assert_eq!(state["train"]["steps"].as_integer(), Some(3));
        assert_eq!(state["train"]["lr"].as_float(), Some(0.25), "a recipe lies over everything");
        assert_eq!(state["data"]["env_keys"][0].as_str(), Some("dirt"));
        assert_eq!(state["entry"].as_str(), Some("sweep-mine"));
        assert_eq!(state["description"].as_str(), Some("Mine on Sweep, low-dimensional observations."));
        let image = library.resolve("mine_sweep_image").unwrap();
        assert_eq!(
            image["train"]["steps"].as_integer(),
            Some(2),
            "the numbers of the combination with state are not its"
        );
        assert_eq!(image["train"]["lr"].as_float(), Some(0.5));
        assert_eq!(image["data"]["env_keys"].as_array().unwrap().len(), 0);
        assert_eq!(image["data"]["path"].as_str(), Some("seen.hdf5"));
        assert_eq!(image["entry"].as_str(), Some("sweep-mine-image"));
        let names = library.names().unwrap();
        for name in ["mine_sweep", "mine_sweep_image", "mine_stack", "act_sweep_image", "trm_sudoku9"] {
            assert!(names.contains(&name.to_owned()), "{name}");
        }
        let refused = library.resolve("mine_sweep_image_told").unwrap_err().to_string();
        assert_eq!(
            refused,
            "key `inputs`: expected one of those that task `sweep` has (state, image), found `image_told`"
        );
    }
}
