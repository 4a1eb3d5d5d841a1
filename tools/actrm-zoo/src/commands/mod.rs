//! The commands and the arguments that several of them share.

mod completions;
mod eval;
mod export;
mod import;
mod leaderboard;
mod list;
mod merge;
mod puzzles;
mod show;
mod study;
mod trace;
mod train;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, Subcommand};
use zoo::config::Library;

#[derive(Subcommand)]
pub enum Command {
    Train(train::TrainArgs),
    Eval(eval::EvalArgs),
    Merge(merge::MergeArgs),
    Leaderboard(leaderboard::LeaderboardArgs),
    List(list::ListArgs),
    Show(show::ShowArgs),
    Trace(trace::TraceArgs),
    Study(study::StudyArgs),
    Import(import::ImportArgs),
    Export(export::ExportArgs),
    Completions(completions::CompletionsArgs),
}

impl Command {
    /// Runs the command; the code is what the program ends with.
    pub fn run(self) -> anyhow::Result<ExitCode> {
        match self {
            Self::Train(args) => train::cmd_train(&args),
            Self::Eval(args) => eval::cmd_eval(&args),
            Self::Merge(args) => merge::cmd_merge(&args),
            Self::Leaderboard(args) => leaderboard::cmd_leaderboard(&args),
            Self::List(args) => list::cmd_list(&args),
            Self::Show(args) => show::cmd_show(&args),
            Self::Trace(args) => trace::cmd_trace(&args),
            Self::Study(args) => study::cmd_study(&args),
            Self::Import(args) => import::cmd_import(args),
            Self::Export(args) => export::cmd_export(&args),
            Self::Completions(args) => completions::cmd_completions(&args),
        }
    }
}

/// Where the zoo is.
#[derive(Args)]
pub struct ZooArgs {
    /// Folder of the zoo
    #[arg(long, value_name = "DIR", default_value = "zoo", env = "ACTRM_ZOO_DIR")]
    pub zoo: PathBuf,
}

/// Where experiments are.
#[derive(Args)]
pub struct ConfigArgs {
    /// Folder of experiment files that come before those built in
    #[arg(long, value_name = "DIR", env = "ACTRM_CONFIGS")]
    pub configs: Option<PathBuf>,
}

impl ConfigArgs {
    fn library(&self) -> anyhow::Result<Library> {
        Ok(match &self.configs {
            Some(folder) => Library::with_folder(folder)?,
            None => Library::built_in(),
        })
    }
}

/// `data/lift.hdf5` for a path, without the tail of `/.`s that users type.
fn shown(path: &Path) -> String {
    path.components().collect::<PathBuf>().display().to_string()
}
