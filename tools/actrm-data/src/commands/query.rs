use anyhow::{Context, Result, bail};
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Command, ExitCode};

/// The program that has the SQL engine, beside this one: it takes longer to compile than all the rest.
const PROGRAM: &str = "actrm-query";

/// Query a data set in SQL.
///
/// The table `frames` has episode_index, frame_index, index, timestamp, task, next_reward, next_done, next_success, a column for
/// each dimension, such as action_0 or object_3, and columns of texts. The table `episodes` has episode_index, demo, length, task,
/// return, success, and in_<mask> for every mask. `--tables` lists the columns.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data query lift \"SELECT demo, length FROM episodes ORDER BY length DESC LIMIT 5\"
  actrm-data query lift \"SELECT episode_index, MAX(action_2) AS up FROM frames GROUP BY episode_index\"
  actrm-data query lift --tables")]
pub struct Args {
    /// Data set directory
    dir: PathBuf,
    /// SQL query
    #[arg(required_unless_present = "tables")]
    sql: Option<String>,
    /// List the tables and their columns instead
    #[arg(long, conflicts_with = "sql")]
    tables: bool,
    /// Largest number of rows to show; 0 shows all
    #[arg(long, default_value_t = 100)]
    limit: usize,
    /// Print all rows as a JSON list of objects
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let program = std::env::current_exe().context("cannot find this program")?.with_file_name(PROGRAM);
    if !program.is_file() {
        bail!(
            "{}: expected the program that answers queries, found nothing (`make build` in a clone builds it; the Python package comes without it)",
            program.display()
        );
    }
    let mut command = Command::new(&program);
    command.args(["--limit", &args.limit.to_string()]).args(args.json.then_some("--json"));
    // what follows is no option, whatever it begins with
    command.arg("--").arg(&args.dir).args(&args.sql);
    // on success this process is that program from here on
    Err(command.exec()).with_context(|| format!("cannot start {}", program.display()))
}
