use anyhow::Result;
use dataset::Dataset;
use std::path::PathBuf;
use std::process::ExitCode;

/// Ask a data set in SQL.
///
/// Tables: `frames` (episode_index, frame_index, index, timestamp, task, a column for each dimension such as
/// action_0 or object_3, and next_reward, next_done, next_success) and `episodes` (episode_index, demo, length, task,
/// return, success, and in_<mask> for every mask). `--tables` lists the columns.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data query lift \"SELECT demo, length FROM episodes ORDER BY length DESC LIMIT 5\"
  actrm-data query lift \"SELECT episode_index, MAX(action_2) AS up FROM frames GROUP BY episode_index\"
  actrm-data query lift --tables")]
pub struct Args {
    /// Data set directory
    dir: PathBuf,
    /// The query
    #[arg(required_unless_present = "tables")]
    sql: Option<String>,
    /// List the tables and their columns instead
    #[arg(long, conflicts_with = "sql")]
    tables: bool,
    /// Rows to show at most; 0 shows all
    #[arg(long, default_value_t = 100)]
    limit: usize,
    /// As JSON: a list of objects, all rows
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let set = Dataset::open(&args.dir)?;
    let Some(sql) = &args.sql else {
        let rows: Vec<Vec<String>> = query::tables(&set)?
            .into_iter()
            .map(|(table, column, dtype)| vec![table.to_owned(), column, dtype])
            .collect();
        cli::print(&cli::table(&["table", "column", "type"], &rows, &[]))?;
        return Ok(ExitCode::SUCCESS);
    };
    let result = query::query(&set, sql)?;
    if args.json {
        let list: Vec<serde_json::Map<String, serde_json::Value>> =
            result.rows.iter().map(|row| result.columns.iter().cloned().zip(row.iter().cloned()).collect()).collect();
        cli::print_json(&list)?;
        return Ok(ExitCode::SUCCESS);
    }
    let shown = if args.limit == 0 { result.rows.len() } else { args.limit.min(result.rows.len()) };
    let cell = |v: &serde_json::Value| match v {
        serde_json::Value::String(s) => s.clone(),
        serde_json::Value::Number(n) if n.is_f64() => cli::number(n.as_f64().unwrap_or(f64::NAN)),
        serde_json::Value::Null => String::new(),
        other => other.to_string(),
    };
    let rows: Vec<Vec<String>> = result.rows[..shown].iter().map(|row| row.iter().map(cell).collect()).collect();
    let header: Vec<&str> = result.columns.iter().map(String::as_str).collect();
    let numeric: Vec<usize> =
        (0..header.len()).filter(|&c| result.rows.iter().all(|row| row[c].is_number() || row[c].is_null())).collect();
    let mut text = cli::table(&header, &rows, &numeric);
    if shown < result.rows.len() {
        text.push_str(&format!("{shown} of {} rows; --limit 0 shows all\n", result.rows.len()));
    }
    cli::print(&text)?;
    Ok(ExitCode::SUCCESS)
}
