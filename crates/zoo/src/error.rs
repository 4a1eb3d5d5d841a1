//! Everything that can go wrong in this crate, one variant an operation and its object.

use std::path::{Path, PathBuf};

/// Writes names the way every message lists them: `a, b, c`, or `none`.
pub(crate) fn list(names: &[String]) -> String {
    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
}

/// ` (did you mean `x`?)`, or nothing.
fn hint(nearest: &Option<String>) -> String {
    nearest.as_ref().map(|n| format!(" (did you mean `{n}`?)")).unwrap_or_default()
}

/// ` (did you mean `x`, `y`?)`, or nothing.
fn hints(nearest: &[String]) -> String {
    if nearest.is_empty() { String::new() } else { format!(" (did you mean `{}`?)", nearest.join("`, `")) }
}

/// The entry that is not there, and those that are as far as they fit a line.
fn unknown_entry(name: &str, zoo: &Path, nearest: &Option<String>, available: &[String]) -> String {
    const FEW: usize = 8;
    let place = zoo.display();
    if !zoo.is_dir() {
        return format!("unknown entry `{name}`: there is no zoo {place}; name yours with --zoo DIR or ACTRM_ZOO_DIR");
    }
    let known = match available.len() {
        0..=FEW => format!("entries: {}", list(available)),
        many => format!("`actrm-zoo list` shows all {many}"),
    };
    format!("unknown entry `{name}` in zoo {place}{}; {known}", hint(nearest))
}

/// An operation of this crate that failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ZooError {
    // ---- files -------------------------------------------------------------------------------
    /// The operating system refused a file operation.
    #[error("cannot {operation} {}", path.display())]
    Io {
        /// What was tried: `read`, `write`, `create folder`, …
        operation: &'static str,
        /// On which file or folder.
        path: PathBuf,
        /// Why it failed.
        #[source]
        source: std::io::Error,
    },
    /// A file that this crate wrote does not have the form it was written in.
    #[error("{}: {reason}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },

    // ---- experiments -------------------------------------------------------------------------
    /// No experiment of that name.
    #[error("unknown experiment `{name}`{}. `actrm-zoo list --experiments` lists all of them", hints(nearest))]
    UnknownExperiment {
        /// The name asked for.
        name: String,
        /// The most similar names, as far as they are similar.
        nearest: Vec<String>,
    },
    /// Not a name that an experiment can have.
    #[error("experiment name `{name}`: {reason}")]
    ExperimentName {
        /// The name.
        name: String,
        /// The rule it breaks.
        reason: &'static str,
    },
    /// A training would take more memory than there is.
    #[error(
        "experiment `{experiment}` needs at least {needed} of memory, {available} are there; lower the policy's sizes or train.batch_size, or raise train.accumulation"
    )]
    TooLarge {
        /// The experiment.
        experiment: String,
        /// What its weights and a batch take.
        needed: String,
        /// What may still be taken.
        available: String,
    },
    /// An experiment file is not TOML.
    #[error("experiment `{experiment}` is not valid TOML")]
    ExperimentSyntax {
        /// The experiment.
        experiment: String,
        /// Line and column.
        #[source]
        source: Box<toml::de::Error>,
    },
    /// `extends` leads back to where it came from.
    #[error("experiment `{}` extends itself: {}", chain.first().map_or("", String::as_str), chain.join(" -> "))]
    ExtendsCycle {
        /// The experiments in order of extension.
        chain: Vec<String>,
    },
    /// A key that no part of an experiment has.
    #[error("unknown key `{key}`{}; keys here: {}", hint(nearest), list(alternatives))]
    UnknownKey {
        /// Dotted path of the key.
        key: String,
        /// The most similar key, where one is similar at all.
        nearest: Option<String>,
        /// Keys allowed at this place.
        alternatives: Vec<String>,
    },
    /// A key that has to be there is not.
    #[error("key `{key}` is missing")]
    MissingKey {
        /// Dotted path of the key.
        key: String,
    },
    /// A key holds something that it cannot.
    #[error("key `{key}`: expected {expected}, found {found}")]
    InvalidValue {
        /// Dotted path of the key.
        key: String,
        /// What would be allowed.
        expected: String,
        /// What is there.
        found: String,
    },
    /// An override is not of the form `section.key=value`.
    #[error("override `{text}`: {reason}")]
    Override {
        /// The override as given.
        text: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The demonstrations are nowhere.
    #[error("data `{}` not found; looked at {}", path.display(), list(tried))]
    DataNotFound {
        /// The path as the experiment or the command line gives it.
        path: PathBuf,
        /// Every place looked at.
        tried: Vec<String>,
    },
    /// The data set cannot serve this experiment.
    #[error("data set {}: {reason}", path.display())]
    UnfitData {
        /// Folder of the data set.
        path: PathBuf,
        /// What does not fit: expected and found.
        reason: String,
    },

    /// The data set refused.
    #[error("data {}", path.display())]
    Dataset {
        /// File or folder.
        path: PathBuf,
        /// What it refused.
        #[source]
        source: Box<dataset::DatasetError>,
    },
    /// The model refused.
    #[error("cannot {operation} `{name}`")]
    Model {
        /// What was tried: `build the policy of`, `load the weights of`, …
        operation: &'static str,
        /// Entry or experiment.
        name: String,
        /// What it refused.
        #[source]
        source: models::ModelError,
    },

    /// Something that cannot be done with what was named.
    #[error("{what}: {reason}")]
    NotPossible {
        /// The entry or the run.
        what: String,
        /// Why, and what can be done.
        reason: String,
    },

    // ---- training runs -----------------------------------------------------------------------
    /// Another process trains in this folder.
    #[error("run folder {} is in use by another training (lock file {})", folder.display(), folder.join("lock").display())]
    RunLocked {
        /// The run's folder.
        folder: PathBuf,
    },
    /// A fresh training was asked for where one already is.
    #[error("run folder {} already holds a run; use --resume to go on with it, or another folder", folder.display())]
    RunExists {
        /// The run's folder.
        folder: PathBuf,
    },
    /// A fresh training was asked for among files of others.
    #[error("run folder {}: expected a new or empty folder, found {found} in it", folder.display())]
    NotARun {
        /// The folder.
        folder: PathBuf,
        /// What is in it.
        found: String,
    },
    /// Nothing to resume.
    #[error("nothing to resume in {}: {reason}", folder.display())]
    NothingToResume {
        /// Folder that was looked at.
        folder: PathBuf,
        /// What is there instead.
        reason: String,
    },
    /// A run can only go on with what it began with.
    #[error("cannot resume {}: {what} differs: the run has {expected}, asked for {found}", folder.display())]
    ResumeMismatch {
        /// The run's folder.
        folder: PathBuf,
        /// Dotted key, or `data set`.
        what: String,
        /// What the run was started with.
        expected: String,
        /// What is asked for now.
        found: String,
    },
    /// The loss or a tensor stopped being a finite number.
    #[error("step {step}: {tensor} is {value}; training stopped, last good checkpoint: {}", checkpoint.as_ref().map_or("none yet".to_owned(), |p| p.display().to_string()))]
    NotFinite {
        /// Optimiser step, from 1.
        step: u64,
        /// Loss part, gradient or parameter by name.
        tensor: String,
        /// NaN or an infinity.
        value: f64,
        /// Where training can go on from.
        checkpoint: Option<PathBuf>,
    },

    // ---- entries -----------------------------------------------------------------------------
    /// No entry of that name in the zoo.
    #[error("{}", unknown_entry(name, zoo, nearest, available))]
    UnknownEntry {
        /// The entry asked for, `name` or `name@version`.
        name: String,
        /// The zoo's folder.
        zoo: PathBuf,
        /// The most similar name, where one is similar at all.
        nearest: Option<String>,
        /// Every `name@version` there is.
        available: Vec<String>,
    },
    /// No version of that entry has this alias.
    #[error("entry `{name}`: no alias `{alias}`; aliases: latest{}; set one with: actrm-zoo alias {name}@VERSION {alias}", known.iter().map(|k| format!(", {k}")).collect::<String>())]
    UnknownAlias {
        /// The entry's name.
        name: String,
        /// The alias that was asked for.
        alias: String,
        /// Aliases that there are, `best = 3`.
        known: Vec<String>,
    },
    /// An entry that something else stands on.
    #[error("entry {entry}: not removed, because {} of it: {}", if users.len() == 1 { "this is" } else { "these are" }, users.join(", "))]
    InUse {
        /// The entry.
        entry: String,
        /// Results and aliases of it.
        users: Vec<String>,
    },
    /// Not a name an entry can have.
    #[error("entry name `{name}`: {reason}")]
    EntryName {
        /// The name.
        name: String,
        /// The rule it breaks.
        reason: &'static str,
    },
    /// A file of an entry is not the one that was written.
    #[error("{}: sha256 does not match: expected {expected}, found {found}", path.display())]
    Tampered {
        /// The file.
        path: PathBuf,
        /// The recorded hash.
        expected: String,
        /// The hash of what is there, or `no such file`.
        found: String,
    },

    // ---- rollouts and results ----------------------------------------------------------------
    /// Pictures that are to be changed are not what the policy sees.
    #[error("entry {entry}: perturbation {perturbation} needs {expected}")]
    Perturbation {
        /// The entry.
        entry: String,
        /// What was to be done.
        perturbation: String,
        /// What it needs, and what was found.
        expected: String,
    },
    /// A rollout in a worker process.
    #[error(transparent)]
    Rollout(#[from] rollout::RolloutError),
    /// Results of evaluations, and files.
    #[error(transparent)]
    Results(#[from] results::ResultsError),
    /// A table of results cannot be read or written.
    #[error("cannot {operation} {}", path.display())]
    Table {
        /// What was tried.
        operation: &'static str,
        /// The file.
        path: PathBuf,
        /// What the Parquet library said.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// There is no finished evaluation to compare with.
    #[error(
        "entry {entry}: nothing to run again: no finished evaluation in {} holds the seeds {seeds} under this protocol; stored: {}",
        results.display(), if stored.is_empty() { "none".to_owned() } else { stored.join(", ") }
    )]
    NothingToCompare {
        /// The entry.
        entry: String,
        /// The seeds that were asked for.
        seeds: String,
        /// The folder of results.
        results: PathBuf,
        /// Seeds of the evaluations of this entry under this protocol.
        stored: Vec<String>,
    },
    /// Not exactly one result is meant.
    #[error(
        "row `{row}`: expected one result in {}, found {}; name its folder, or the entry with --protocol and --block, or with --task",
        results.display(), list(found)
    )]
    WhichRow {
        /// What was asked for.
        row: String,
        /// The folder of results.
        results: PathBuf,
        /// Folders of the results that it fits.
        found: Vec<String>,
    },
    /// A named protocol that is not there, or a file that is none.
    #[error("protocol `{name}`: {reason}")]
    Protocol {
        /// Its name.
        name: String,
        /// What is wrong, and what was expected.
        reason: String,
    },
    /// Demonstrations that the entry was trained on began as the evaluation's episodes would.
    #[error(
        "entry {entry}: the seeds {seeds} were asked for, and its training demonstrations began with {demonstrations}; use --force to evaluate anyway, and the row says so"
    )]
    DemonstrationSeeds {
        /// The entry.
        entry: String,
        /// The seeds that were asked for.
        seeds: String,
        /// The demonstrations' seeds.
        demonstrations: String,
    },
    /// The entry was trained on demonstrations of another simulator generation.
    #[error(
        "entry {entry} was trained on data recorded in {simulator} {recorded}; this is {simulator} {running}. Behaviour differs between these versions and success rates are not comparable. Use --force to evaluate anyway"
    )]
    SimulatorGeneration {
        /// The entry.
        entry: String,
        /// The simulator.
        simulator: String,
        /// The version recorded with the data set.
        recorded: String,
        /// The version that the worker runs.
        running: String,
    },
    /// A policy of somebody else's, which only its owner can run.
    #[error(
        "entry {entry}: its weights are not in this zoo; whoever has the policy runs it, in Python with \
         actrm.evaluate(policy, name=..., task=...)"
    )]
    External {
        /// The entry.
        entry: String,
    },
    /// The entry and the environment do not fit each other.
    #[error("entry {entry} in task {task}: {what}: expected {expected}, found {found}")]
    UnfitEntry {
        /// The entry.
        entry: String,
        /// The task.
        task: String,
        /// What does not fit.
        what: String,
        /// What the entry was made for.
        expected: String,
        /// What the environment has.
        found: String,
    },
}

impl ZooError {
    /// Builds the closure that `map_err` wants around a file operation.
    pub fn io(operation: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { operation, path, source }
    }
}
