//! What `actrm-data query` becomes: a program of its own, so that the other commands do not wait for the SQL engine to
//! be compiled.
#![deny(clippy::print_stdout, clippy::print_stderr)]

use anyhow::Result;
use clap::Parser;
use dataset::Dataset;
use std::path::PathBuf;
use std::process::ExitCode;

/// The program behind `actrm-data query`, which says how to ask.
#[derive(Parser)]
#[command(name = "actrm-query", version)]
struct Args {
    /// Data set directory
    dir: PathBuf,
    /// The query; without one, the tables and their columns
    sql: Option<String>,
    /// Rows to show at most; 0 shows all
    #[arg(long, default_value_t = 100)]
    limit: usize,
    /// As JSON: a list of objects, all rows
    #[arg(long)]
    json: bool,
}

fn main() -> ExitCode {
    cli::end(run(&Args::parse()))
}

fn run(args: &Args) -> Result<ExitCode> {
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
