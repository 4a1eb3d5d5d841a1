//! Where the zoo and the experiments are, and the names in them for completion.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use clap_complete::engine::{ArgValueCandidates, CompletionCandidate};
use cli::completions::{candidates, given};
use zoo::config::Library;
use zoo::protocols::{Block, Protocols};
use zoo::registry::Registry;

/// The error of an entry, which names the entry once.
pub fn of_entry(id: &impl Display, error: anyhow::Error) -> anyhow::Error {
    let name = format!("entry {id}");
    if error.to_string().starts_with(&name) { error } else { error.context(name) }
}

/// The folder of the zoo unless another one is named.
const USUAL_ZOO: &str = "zoo";

/// Where the zoo is.
#[derive(Args, Clone)]
pub struct ZooArgs {
    /// Folder of the zoo
    #[arg(long, value_name = "DIR", default_value = USUAL_ZOO, env = "ACTRM_ZOO_DIR")]
    pub zoo: PathBuf,
}

impl ZooArgs {
    /// Its folder, unless it is the usual one.
    pub fn named(&self) -> Option<String> {
        (self.zoo != Path::new(USUAL_ZOO)).then(|| cli::lossy(&self.zoo))
    }

    /// Refuses a folder that was named and is not there; the usual one may be yet to be made.
    ///
    /// # Errors
    /// Such a folder.
    pub fn check(&self) -> anyhow::Result<()> {
        check_folder("--zoo", self.named().is_some().then_some(&self.zoo))
    }

    /// Its entries.
    pub fn registry(&self) -> Registry {
        Registry::open(&self.zoo)
    }
}

/// Where results are.
#[derive(Args)]
pub struct ResultsArgs {
    /// Folder of results [default: `results` in the zoo]
    #[arg(long, value_name = "DIR")]
    results: Option<PathBuf>,
}

impl ResultsArgs {
    /// The folder, if one was named.
    pub fn named(&self) -> Option<String> {
        self.results.as_deref().map(cli::lossy)
    }

    /// Refuses a folder that was named and is not there.
    ///
    /// # Errors
    /// Such a folder.
    pub fn check(&self) -> anyhow::Result<()> {
        check_folder("--results", self.results.as_ref())
    }

    /// The folder that was named, or the zoo's.
    pub fn folder(&self, zoo: &ZooArgs) -> PathBuf {
        self.results.clone().unwrap_or_else(|| zoo.zoo.join("results"))
    }
}

fn check_folder(option: &str, folder: Option<&PathBuf>) -> anyhow::Result<()> {
    match folder.filter(|folder| !folder.is_dir()) {
        Some(folder) => anyhow::bail!("{option} {}: expected a folder, found none", cli::shown(folder)),
        None => Ok(()),
    }
}

/// Where experiments are.
#[derive(Args, Clone)]
pub struct ConfigArgs {
    /// Folder of your own experiment files, which take precedence over the built-in ones
    #[arg(long, value_name = "DIR", env = "ACTRM_CONFIGS")]
    pub configs: Option<PathBuf>,
}

impl ConfigArgs {
    /// The experiments.
    pub fn library(&self) -> anyhow::Result<Library> {
        library(self.configs.as_deref())
    }
}

/// Where named protocols are.
#[derive(Args)]
pub struct ProtocolArgs {
    /// Folder of your own protocol files, in addition to the built-in ones
    #[arg(long, value_name = "DIR", env = "ACTRM_PROTOCOLS")]
    protocols: Option<PathBuf>,
}

impl ProtocolArgs {
    /// The folder, if one was named.
    pub fn named(&self) -> Option<String> {
        self.protocols.as_deref().map(cli::lossy)
    }

    /// The protocols.
    pub fn protocols(&self) -> anyhow::Result<Protocols> {
        let Some(folder) = &self.protocols else { return Ok(Protocols::built_in()) };
        let all = Protocols::with_folder(folder)?;
        all.notes().iter().for_each(|note| cli::note(&format!("note: {note}")));
        Ok(all)
    }
}

/// A block of a named protocol, on the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum BlockArg {
    Test,
    Dev,
}

impl From<BlockArg> for Block {
    fn from(block: BlockArg) -> Self {
        match block {
            BlockArg::Test => Self::Test,
            BlockArg::Dev => Self::Dev,
        }
    }
}

fn library(folder: Option<&Path>) -> anyhow::Result<Library> {
    Ok(match folder {
        Some(folder) => Library::with_folder(folder)?,
        None => Library::built_in(),
    })
}

/// Completes names of entries, with and without version, of the zoo that the line names.
pub fn entry_names() -> ArgValueCandidates {
    ArgValueCandidates::new(|| {
        let folder = given("--zoo").or_else(|| std::env::var_os("ACTRM_ZOO_DIR")).unwrap_or_else(|| USUAL_ZOO.into());
        let ids = Registry::open(Path::new(&folder)).ids().unwrap_or_default();
        candidates(ids.iter().map(ToString::to_string))
    })
}

/// Completes names of experiments.
pub fn experiment_names() -> ArgValueCandidates {
    ArgValueCandidates::new(|| -> Vec<CompletionCandidate> {
        let folder = given("--configs").or_else(|| std::env::var_os("ACTRM_CONFIGS"));
        let names = library(folder.as_deref().map(Path::new)).and_then(|library| Ok(library.names()?));
        candidates(names.unwrap_or_default())
    })
}
