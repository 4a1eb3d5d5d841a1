//! The two tables and the answers.

use dataset::{Dataset, DatasetError, Feature, Wide};
use polars::prelude::{
    AnyValue, Column as Series, DataFrame, IntoColumn, IntoLazy, NamedFrom, PolarsError, Series as Values,
};
use polars::sql::SQLContext;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};

/// Why a query has no answer.
#[derive(Debug, thiserror::Error)]
pub enum QueryError {
    /// The engine refused the statement, or failed on it.
    #[error("cannot answer {sql:?}")]
    Refused {
        /// The statement.
        sql: String,
        /// The engine's words.
        source: Words,
    },
    /// A statement that changes something, or is none.
    #[error(
        "cannot answer {sql:?}: expected a statement that begins with SELECT, WITH, SHOW or EXPLAIN, found {found:?}"
    )]
    NoQuestion {
        /// The statement.
        sql: String,
        /// Its first word.
        found: String,
    },
    /// A table could not be made of the data set.
    #[error("cannot make the table {table}")]
    Table {
        /// Its name.
        table: &'static str,
        /// The engine's words.
        source: Words,
    },
    /// The data set's files could not be read.
    #[error(transparent)]
    Files(#[from] DatasetError),
}

/// The engine's words, in a line.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct Words(String);

impl From<PolarsError> for Words {
    fn from(error: PolarsError) -> Self {
        Self(error.to_string().lines().next().unwrap_or_default().to_owned())
    }
}

/// The answer to a query.
#[derive(Debug, Clone, PartialEq)]
pub struct QueryResult {
    /// Names of the columns.
    pub columns: Vec<String>,
    /// Rows, each with a value a column.
    pub rows: Vec<Vec<Value>>,
}

/// Both tables by name.
fn both(dataset: &Dataset) -> Result<[(&'static str, DataFrame); 2], QueryError> {
    let made = |table, columns: Vec<Series>, rows| {
        DataFrame::new(rows, columns).map_err(|e| QueryError::Table { table, source: e.into() })
    };
    let wide = dataset.wide()?;
    Ok([
        ("frames", made("frames", frames(dataset, &wide)?, dataset.frames())?),
        ("episodes", made("episodes", episodes(dataset, &wide), dataset.episodes().len())?),
    ])
}

/// Answers `sql` over the tables `frames` and `episodes`.
///
/// # Errors
/// When the engine refuses the statement.
pub fn query(dataset: &Dataset, sql: &str) -> Result<QueryResult, QueryError> {
    let first = first_word(sql);
    if !["SELECT", "WITH", "SHOW", "EXPLAIN"].iter().any(|word| first.eq_ignore_ascii_case(word)) {
        return Err(QueryError::NoQuestion { sql: sql.to_owned(), found: first.to_owned() });
    }
    let refused = |error: PolarsError| QueryError::Refused { sql: sql.to_owned(), source: error.into() };
    let mut context = SQLContext::new();
    for (name, table) in both(dataset)? {
        context.register(name, table.lazy());
    }
    let answer = context.execute(sql).and_then(|plan| plan.collect()).map_err(refused)?;
    let columns: Vec<String> = answer.get_column_names().iter().map(|n| n.to_string()).collect();
    let mut rows = vec![Vec::with_capacity(columns.len()); answer.height()];
    for column in answer.columns() {
        for (index, row) in rows.iter_mut().enumerate() {
            row.push(json(column.get(index).map_err(refused)?));
        }
    }
    Ok(QueryResult { columns, rows })
}

/// The first word of a statement, behind comments and brackets.
fn first_word(sql: &str) -> &str {
    let mut rest = sql;
    loop {
        rest = rest.trim_start_matches(|c: char| c.is_whitespace() || c == '(');
        let behind = match (rest.strip_prefix("--"), rest.strip_prefix("/*")) {
            (Some(comment), _) => comment.split_once('\n'),
            (None, Some(comment)) => comment.split_once("*/"),
            (None, None) => return rest.split(|c: char| !c.is_alphanumeric()).next().unwrap_or_default(),
        };
        rest = behind.map_or("", |(_, rest)| rest);
    }
}

/// Table, column and type of everything that can be asked for.
///
/// # Errors
/// When a table cannot be made of the data set.
pub fn tables(dataset: &Dataset) -> Result<Vec<(&'static str, String, String)>, QueryError> {
    let mut all = Vec::new();
    for (name, table) in both(dataset)? {
        for column in table.columns() {
            all.push((name, column.name().to_string(), column.dtype().to_string()));
        }
    }
    Ok(all)
}

fn json(value: AnyValue<'_>) -> Value {
    match value {
        AnyValue::Null => Value::Null,
        AnyValue::Boolean(b) => b.into(),
        AnyValue::Float32(v) => shortest(v),
        AnyValue::Float64(v) => float(v),
        AnyValue::String(s) => s.into(),
        AnyValue::StringOwned(s) => s.to_string().into(),
        AnyValue::UInt64(v) => v.into(),
        AnyValue::List(values) => values.iter().map(json).collect(),
        other => match other.extract::<i64>() {
            Some(v) => v.into(),
            None => other.to_string().into(),
        },
    }
}

/// An f32 as the shortest decimal that reads back as itself, not as its f64 neighbour's digits.
fn shortest(value: f32) -> Value {
    value.to_string().parse().map_or(Value::Null, float)
}

/// A number; what JSON has no number for as the text `NaN`, `inf` or `-inf`, for it is not missing.
fn float(value: f64) -> Value {
    if value.is_finite() { value.into() } else { value.to_string().into() }
}

fn column<T>(name: &str, values: T) -> Series
where
    Values: NamedFrom<T, [<T as Elements>::Item]>,
    T: Elements,
{
    Values::new(name.into(), values).into_column()
}

/// Names the element type of a vector, for [`column`].
trait Elements {
    type Item;
}

impl<T> Elements for Vec<T> {
    type Item = T;
}

/// A name that SQL takes without quotes.
fn plain(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect()
}

/// A name that no other column has: with underscores behind it where one has it.
fn named(mut name: String, taken: &mut BTreeSet<String>) -> String {
    while !taken.insert(name.clone()) {
        name.push('_');
    }
    name
}

/// One dimension of a column.
fn dimension<T: Copy>(all: &[T], d: usize, dim: usize) -> Vec<T> {
    all.iter().skip(d).step_by(dim).copied().collect()
}

fn frames(dataset: &Dataset, wide: &BTreeMap<String, Wide>) -> Result<Vec<Series>, DatasetError> {
    let episodes = dataset.episodes();
    let total = dataset.frames();
    let mut episode_index = Vec::with_capacity(total);
    let mut frame_index = Vec::with_capacity(total);
    let (stored, single) = dataset.frame_times()?.unzip();
    // frames whose task no table has are shown with their episode's
    let known = dataset.frame_tasks().ok().flatten();
    let mut timestamp = stored.unwrap_or_default();
    let timed = !timestamp.is_empty();
    let mut task = Vec::with_capacity(total);
    for episode in episodes {
        for i in 0..episode.length {
            episode_index.push(episode.index as i64);
            frame_index.push(i as i64);
            if !timed {
                timestamp.push(i as f64 / dataset.info().fps);
            }
            let own = known.as_ref().map(|tasks| &dataset.tasks()[tasks[episode.from + i]]);
            task.push(own.or(episode.tasks.first()).cloned().unwrap_or_default());
        }
    }
    let mut columns = vec![
        column("episode_index", episode_index),
        column("frame_index", frame_index),
        column("index", (0..total as i64).collect::<Vec<i64>>()),
        match single {
            Some(true) => column("timestamp", timestamp.iter().map(|&seconds| seconds as f32).collect::<Vec<f32>>()),
            _ => column("timestamp", timestamp),
        },
        column("task", task),
    ];
    let mut taken: BTreeSet<String> = columns.iter().map(|c| c.name().to_string()).collect();
    let own = |name: &str, dim: usize, d: usize| match dim {
        1 => plain(name),
        _ => format!("{}_{d}", plain(name)),
    };
    let known = || dataset.info().features.0.iter().filter_map(|(name, f)| Some((name, f, dataset.column(name)?)));
    let texts = dataset.texts()?;
    // no number of one feature takes the name of another
    let mut reserved: BTreeSet<String> =
        known().flat_map(|(name, _, values)| (0..values.dim).map(move |d| own(name, values.dim, d))).collect();
    reserved.extend(texts.keys().map(|name| plain(name)));
    let given = |feature: &Feature, d: usize| feature.names.get(d).and_then(Value::as_str).map(plain);
    // nor one that two features give their numbers, as LeRobot does with joints in actions and states
    let mut claimed = BTreeSet::new();
    for (_, feature, values) in known().filter(|(_, _, values)| values.dim > 1) {
        let names: BTreeSet<String> = (0..values.dim).filter_map(|d| given(feature, d)).collect();
        reserved.extend(names.into_iter().filter(|name| !claimed.insert(name.clone())));
    }
    for (name, feature, values) in known() {
        for d in 0..values.dim {
            let free = |given: &String| values.dim > 1 && !taken.contains(given) && !reserved.contains(given);
            let unique = given(feature, d).filter(free).unwrap_or_else(|| own(name, values.dim, d));
            let unique = named(unique, &mut taken);
            let data = dimension(values.data, d, values.dim);
            columns.push(match (wide.get(name), feature.dtype.as_str()) {
                (Some(Wide::Doubles(all)), _) => column(&unique, dimension(all, d, values.dim)),
                (Some(Wide::Longs(all)), _) => column(&unique, dimension(all, d, values.dim)),
                (None, "bool") => column(&unique, data.iter().map(|&v| v != 0.0).collect::<Vec<bool>>()),
                (None, _) => column(&unique, data),
            });
        }
    }
    for (name, texts) in &texts {
        let of_frames: Vec<Option<&str>> = (0..total).map(|frame| texts.get(frame)).collect();
        columns.push(column(&named(plain(name), &mut taken), of_frames));
    }
    Ok(columns)
}

fn episodes(dataset: &Dataset, wide: &BTreeMap<String, Wide>) -> Vec<Series> {
    let episodes = dataset.episodes();
    let mut columns = vec![
        column("episode_index", episodes.iter().map(|e| e.index as i64).collect::<Vec<_>>()),
        column("demo", episodes.iter().map(|e| e.demo.clone().unwrap_or_default()).collect::<Vec<_>>()),
        column("length", episodes.iter().map(|e| e.length as i64).collect::<Vec<_>>()),
        column("task", episodes.iter().map(|e| e.tasks.first().cloned().unwrap_or_default()).collect::<Vec<_>>()),
    ];
    if let Some(reward) = dataset.column("next.reward") {
        let returns = episodes.iter().map(|e| match wide.get("next.reward") {
            Some(exact) => exact.sum(e.from..e.to),
            None => reward.data[e.from..e.to].iter().map(|&v| f64::from(v)).sum(),
        });
        columns.push(column("return", returns.collect::<Vec<f64>>()));
    }
    if let Some(success) = dataset.column("next.success") {
        let any = episodes.iter().map(|e| success.data[e.from..e.to].iter().any(|&v| v != 0.0));
        columns.push(column("success", any.collect::<Vec<bool>>()));
    }
    let mut taken: BTreeSet<String> = columns.iter().map(|c| c.name().to_string()).collect();
    for name in dataset.split_names() {
        let members: BTreeSet<usize> = dataset.split(name).unwrap_or_default().into_iter().collect();
        let inside = episodes.iter().map(|e| members.contains(&e.index)).collect::<Vec<bool>>();
        columns.push(column(&named(format!("in_{}", plain(name)), &mut taken), inside));
    }
    columns
}
