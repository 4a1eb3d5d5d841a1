//! What a policy did and thought in one episode, query by query: as text, as JSON and as a Parquet table.

use std::fmt::Write as _;
use std::path::Path;
use std::sync::Arc;

use arrow_array::builder::{Float64Builder, ListBuilder};
use arrow_array::{ArrayRef, BooleanArray, Float64Array, UInt32Array, UInt64Array};
use models::actrm::{Actrm, Config, Over};
use models::{ActionChunk, ModelError, Observation, Preprocess, ThoughtStep, Values};
use rollout::{Pool, RolloutError};
use serde::Serialize;
use zoo::ZooError;
use zoo::entry::LoadedEntry;
use zoo::evaluation::Subject;
use zoo::results::write_table;

use crate::episode::{Answered, Note, Noted, record};

/// One episode of a policy.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PolicyTrace {
    /// The entry, `name@version`.
    pub entry: String,
    /// The task.
    pub task: String,
    /// The episode's seed.
    pub seed: u64,
    /// Whether the task was done.
    pub success: bool,
    /// Control steps done.
    pub steps: usize,
    /// Sum of the rewards.
    pub total_reward: f64,
    /// What the numbers of an attention stand for; empty where nobody looked.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub attended: Vec<String>,
    /// Cells of a row, of a policy that thinks over a grid; absent where nobody looked.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub columns: Option<usize>,
    /// Every time that the policy was asked.
    pub queries: Vec<TracedQuery>,
}

/// One query of a policy.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TracedQuery {
    /// Control steps done before it.
    pub step: usize,
    /// Actions of its answer that were executed, or went into the average that was.
    pub executed: usize,
    /// How long it took.
    pub milliseconds: f64,
    /// What each cell of the grid showed; empty where nobody looked.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub cells: Vec<Vec<f32>>,
    /// What it thought, step by step; the last answer is the one that counts. A policy that does not think has one.
    pub thought: Vec<TracedThought>,
}

/// Looks into a policy's thoughts while its episode is traced.
#[derive(Clone)]
pub struct Examiner {
    model: Arc<Actrm>,
    preprocess: Arc<Preprocess>,
}

impl Examiner {
    /// Of an entry that thinks step by step about its actions, each thought from the same start, or over a grid of which it is
    /// asked for the way; `None` of others.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn of(entry: &LoadedEntry) -> Result<Option<Self>, ZooError> {
        let fits = |config: &Config| {
            let over_actions = config.reasoning.over == Over::Actions && config.reasoning.warm_start.is_none();
            over_actions || config.reasoning.grid.as_ref().is_some_and(|grid| grid.way > 0.0)
        };
        if !entry.experiment().policy.reasoner().is_some_and(fits) {
            return Ok(None);
        }
        let of = |model| Self { model, preprocess: Arc::clone(entry.preprocess()) };
        Ok(entry.reasoner()?.map(of))
    }

    /// What the attention's numbers stand for; nothing of a policy that thinks over a grid.
    pub fn names(&self) -> Vec<String> {
        if self.columns().is_some() { Vec::new() } else { self.model.context_names() }
    }

    /// Cells of a row of the grid that it thinks over.
    pub fn columns(&self) -> Option<usize> {
        self.model.config().reasoning.grid.as_ref().map(|grid| grid.columns)
    }

    /// What each cell of the grid shows.
    fn cells(&self, seen: &Observation) -> Vec<Vec<f32>> {
        let Some(grid) = &self.model.config().reasoning.grid else { return Vec::new() };
        let cells = self.preprocess.signature().observation.iter().filter(|spec| spec.group() == grid.among);
        let numbers = |values: &Values| match values {
            Values::F32(numbers) => numbers.clone(),
            Values::U8(_) => Vec::new(),
        };
        cells.filter_map(|spec| seen.get(&spec.name).map(numbers)).collect()
    }

    /// Looks at the steps of a thought: by action the attention to each of [`Examiner::names`], by cell the probability that
    /// the way goes there.
    fn look(&self, seen: &[Observation], thought: &mut [TracedThought]) -> Result<(), ModelError> {
        let steps = self.model.examine(&self.preprocess.observation(seen)?, thought.len(), None)?;
        for (step, thought) in steps.iter().zip(thought) {
            if let Some(attention) = &step.attention {
                thought.attention = attention.squeeze(0)?.to_vec2()?;
            }
            if let (Some(scores), Some(_)) = (&step.scores, self.columns()) {
                let scores: Vec<f32> = scores.squeeze(0)?.to_vec1()?;
                thought.way = scores.into_iter().map(|score| 1.0 / (1.0 + (-score).exp())).collect();
            }
        }
        Ok(())
    }
}

/// The answer after one step of a thought.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TracedThought {
    /// The chunk: actions in the environment's units, in order of time.
    pub actions: Vec<Vec<f32>>,
    /// Mean absolute change since the step before, in the network's units; the first has none.
    pub change: Option<f32>,
    /// The probability that the policy gave another step not to help; absent if it does not think.
    pub halt: Option<f32>,
    /// How long the step took.
    pub milliseconds: f64,
    /// Of each action: its share of attention to each of the trace's `attended`; absent where nobody looked.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub attention: Vec<Vec<f32>>,
    /// Of each cell of a grid the probability that the way goes there; absent where nobody looked.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub way: Vec<f32>,
}

fn rows(chunk: &ActionChunk) -> Vec<Vec<f32>> {
    chunk.rows().map(<[f32]>::to_vec).collect()
}

/// A query and what was thought about it; its place in the episode is known later.
fn traced(answered: &Answered<'_>, examiner: Option<&Examiner>) -> Result<TracedQuery, ModelError> {
    let milliseconds = answered.milliseconds;
    let of = |step: ThoughtStep| {
        let ThoughtStep { chunk, change, halt, milliseconds } = step;
        let (attention, way) = (Vec::new(), Vec::new());
        TracedThought { actions: rows(&chunk), change, halt: Some(halt), milliseconds, attention, way }
    };
    let mut thought: Vec<TracedThought> = answered.policy.thought()?.into_iter().map(of).collect();
    if thought.is_empty() {
        let (actions, attention, way) = (rows(answered.chunk), Vec::new(), Vec::new());
        thought.push(TracedThought { actions, change: None, halt: None, milliseconds, attention, way });
    }
    let mut cells = Vec::new();
    if let (Some(examiner), Some(now)) = (examiner, answered.seen.last()) {
        examiner.look(answered.seen, &mut thought)?;
        cells = examiner.cells(now);
    }
    Ok(TracedQuery { step: 0, executed: 0, milliseconds, cells, thought })
}

/// Runs the episode of `seed` as an evaluation would and keeps what the policy thought, with what its action tokens
/// attended to where `examiner` looks; nothing if it was stopped.
///
/// # Errors
/// As for an evaluation.
pub fn trace(
    subject: &Subject<'_>,
    pool: &mut Pool,
    seed: u64,
    examiner: Option<&Examiner>,
) -> Result<Option<PolicyTrace>, RolloutError> {
    let task = pool.ready().task.clone();
    let own = examiner.cloned();
    let note: Note<TracedQuery> = Arc::new(move |answered: &Answered<'_>| traced(answered, own.as_ref()));
    let Some((outcome, noted)) = record(subject, pool, seed, &note)? else { return Ok(None) };
    let query = |Noted { step, executed, what }: Noted<TracedQuery>| {
        // the last of what was planned ahead is not executed where the episode ends before
        TracedQuery { step, executed: executed.min(outcome.steps.saturating_sub(step)), ..what }
    };
    let queries = noted.into_iter().map(query).collect();
    Ok(Some(PolicyTrace {
        entry: subject.entry.to_string(),
        task,
        seed,
        success: outcome.success,
        steps: outcome.steps,
        total_reward: outcome.total_reward,
        attended: examiner.map(Examiner::names).unwrap_or_default(),
        columns: examiner.and_then(Examiner::columns),
        queries,
    }))
}

impl PolicyTrace {
    /// As text: a line for each step of a thought, with the first action of its answer.
    pub fn to_text(&self) -> String {
        let how = if self.success { "success" } else { "failure" };
        let mut text = format!(
            "{} on {}, seed {}: {how} after {} steps, return {:.2}, {} queries\n\n",
            self.entry,
            self.task,
            self.seed,
            self.steps,
            self.total_reward,
            self.queries.len()
        );
        text.push_str("  step  thought   change   halt       ms  executed  first action\n");
        for query in &self.queries {
            for (at, thought) in query.thought.iter().enumerate() {
                let last = at + 1 == query.thought.len();
                let step = if at == 0 { query.step.to_string() } else { String::new() };
                let executed = if last { query.executed.to_string() } else { String::new() };
                let change = thought.change.map_or("-".to_owned(), |change| format!("{change:.4}"));
                let halt = thought.halt.map_or("-".to_owned(), |halt| format!("{halt:.3}"));
                let first = thought.actions.first().map_or(&[][..], Vec::as_slice);
                let action: Vec<String> = first.iter().map(|x| format!("{x:+.3}")).collect();
                let _ = writeln!(
                    text,
                    "{step:>6}  {:>7}  {change:>7}  {halt:>5}  {:>7.3}  {executed:>8}  {}",
                    at + 1,
                    thought.milliseconds,
                    action.join(" ")
                );
            }
        }
        text
    }

    /// As a table with a row for each action of each answer: `step` of the query, `thought` from 1, `ahead` from 0,
    /// `executed`, `change`, `halt`, `milliseconds` of the thought's step, `action`, and a column `attention to NAME` for each
    /// token that actions attended to, if somebody looked.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write_parquet(&self, path: &Path) -> Result<(), ZooError> {
        let rows: Vec<_> = self
            .queries
            .iter()
            .flat_map(|query| {
                let thoughts = query.thought.len();
                query.thought.iter().enumerate().flat_map(move |(at, thought)| {
                    let last = at + 1 == thoughts;
                    let actions = thought.actions.iter().enumerate();
                    actions.map(move |(ahead, action)| {
                        (query.step, at + 1, ahead, last && ahead < query.executed, thought, action)
                    })
                })
            })
            .collect();
        let whole = |x: usize| u32::try_from(x).unwrap_or(u32::MAX);
        let mut actions = ListBuilder::new(Float64Builder::new());
        for (.., action) in &rows {
            actions.values().append_slice(&action.iter().map(|&x| f64::from(x)).collect::<Vec<_>>());
            actions.append(true);
        }
        let numbers = |of: &dyn Fn(&TracedThought) -> Option<f64>| -> ArrayRef {
            Arc::new(rows.iter().map(|(_, _, _, _, thought, _)| of(thought)).collect::<Float64Array>())
        };
        let seeds = std::iter::repeat_n(self.seed, rows.len());
        let columns: Vec<(&str, ArrayRef)> = vec![
            ("seed", Arc::new(UInt64Array::from_iter_values(seeds))),
            ("step", Arc::new(UInt32Array::from_iter_values(rows.iter().map(|row| whole(row.0))))),
            ("thought", Arc::new(UInt32Array::from_iter_values(rows.iter().map(|row| whole(row.1))))),
            ("ahead", Arc::new(UInt32Array::from_iter_values(rows.iter().map(|row| whole(row.2))))),
            ("executed", Arc::new(rows.iter().map(|row| Some(row.3)).collect::<BooleanArray>())),
            ("change", numbers(&|thought| thought.change.map(f64::from))),
            ("halt", numbers(&|thought| thought.halt.map(f64::from))),
            ("milliseconds", numbers(&|thought| Some(thought.milliseconds))),
            ("action", Arc::new(actions.finish())),
        ];
        let names: Vec<String> = self.attended.iter().map(|name| format!("attention to {name}")).collect();
        let attended = names.iter().enumerate().map(|(token, name)| {
            let of = |row: &(usize, usize, usize, bool, &TracedThought, &Vec<f32>)| {
                Some(f64::from(*row.4.attention.get(row.2)?.get(token)?))
            };
            (name.as_str(), Arc::new(rows.iter().map(of).collect::<Float64Array>()) as ArrayRef)
        });
        Ok(write_table(path, columns.into_iter().chain(attended).collect())?)
    }

    /// What the actions attended to as a drawing: a row a step of thought, a column a token, mean over the actions; darker is
    /// more. `None` where nobody looked.
    pub fn attention_svg(&self) -> Option<String> {
        const CELL: usize = 14;
        const TOP: usize = 190;
        const LEFT: usize = 120;
        let columns = self.attended.len();
        let rows: Vec<(String, Vec<f32>)> = self
            .queries
            .iter()
            .flat_map(|query| {
                query.thought.iter().enumerate().map(move |(at, thought)| {
                    let label = if at == 0 { format!("step {}, thought 1", query.step) } else { (at + 1).to_string() };
                    let actions = thought.attention.len().max(1) as f32;
                    let mean = |token: usize| thought.attention.iter().map(|row| row[token]).sum::<f32>() / actions;
                    (label, (0..columns).map(mean).collect())
                })
            })
            .collect();
        if columns == 0 || rows.is_empty() {
            return None;
        }
        let (width, height) = (LEFT + columns * CELL + 10, TOP + rows.len() * CELL + 10);
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" \
             font-size=\"10\">\n<rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n\
             <text x=\"6\" y=\"16\" font-size=\"12\">{} on {}, seed {}: what actions attend to</text>\n",
            self.entry, self.task, self.seed
        );
        for (column, name) in self.attended.iter().enumerate() {
            let (x, y) = (LEFT + column * CELL + CELL - 4, TOP - 4);
            let short = name.rsplit('.').next().unwrap_or(name);
            let _ = writeln!(svg, "<text transform=\"translate({x} {y}) rotate(-90)\">{short}</text>");
        }
        for (row, (label, shares)) in rows.iter().enumerate() {
            let y = TOP + row * CELL;
            let _ = writeln!(svg, "<text x=\"{}\" y=\"{}\" text-anchor=\"end\">{label}</text>", LEFT - 4, y + CELL - 4);
            for (column, share) in shares.iter().enumerate() {
                let (x, size) = (LEFT + column * CELL, CELL - 1);
                // the root, so that small shares can be told apart
                let dark = share.max(0.0).sqrt();
                let _ = writeln!(
                    svg,
                    "<rect x=\"{x}\" y=\"{y}\" width=\"{size}\" height=\"{size}\" fill=\"#1b3a6b\" \
                     fill-opacity=\"{dark:.3}\"><title>{share:.3}</title></rect>"
                );
            }
        }
        svg.push_str("</svg>\n");
        Some(svg)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use arrow_array::cast::AsArray;
    use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;

    use super::*;

    fn sample() -> PolicyTrace {
        let thought = |first: f32, change, halt| TracedThought {
            actions: vec![vec![first, -1.0], vec![0.5, 0.25]],
            change,
            halt,
            milliseconds: 0.25,
            attention: vec![vec![0.25, 0.75], vec![1.0, 0.0]],
            way: Vec::new(),
        };
        PolicyTrace {
            entry: "lift-actrm@1".into(),
            task: "Lift".into(),
            seed: 7,
            success: true,
            steps: 3,
            total_reward: 1.0,
            attended: vec!["z0".into(), "observation.entity.cube0".into()],
            columns: None,
            queries: vec![
                TracedQuery {
                    step: 0,
                    executed: 2,
                    milliseconds: 0.5,
                    cells: Vec::new(),
                    thought: vec![thought(0.125, None, Some(0.1)), thought(0.25, Some(0.0625), Some(0.95))],
                },
                TracedQuery {
                    step: 2,
                    executed: 1,
                    milliseconds: 0.25,
                    cells: Vec::new(),
                    thought: vec![thought(1.0, None, None)],
                },
            ],
        }
    }

    #[test]
    fn text_has_a_line_for_each_step_of_a_thought() {
        let text = sample().to_text();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[0], "lift-actrm@1 on Lift, seed 7: success after 3 steps, return 1.00, 2 queries");
        assert_eq!(lines[2], "  step  thought   change   halt       ms  executed  first action");
        assert_eq!(lines[3], "     0        1        -  0.100    0.250            +0.125 -1.000");
        assert_eq!(lines[4], "              2   0.0625  0.950    0.250         2  +0.250 -1.000");
        assert_eq!(lines[5], "     2        1        -      -    0.250         1  +1.000 -1.000");
    }

    #[test]
    fn the_table_has_a_row_for_each_action() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trace.parquet");
        sample().write_parquet(&path).unwrap();
        let reader = ParquetRecordBatchReaderBuilder::try_new(std::fs::File::open(&path).unwrap()).unwrap();
        let batch = reader.build().unwrap().next().unwrap().unwrap();
        assert_eq!(batch.num_rows(), 6);
        let executed = batch.column_by_name("executed").unwrap().as_boolean();
        let executed: Vec<bool> = executed.iter().map(|x| x.unwrap()).collect();
        assert_eq!(executed, [false, false, true, true, true, false]);
        let halt = batch.column_by_name("halt").unwrap();
        assert_eq!(halt.null_count(), 2);
        let actions = batch.column_by_name("action").unwrap().as_list::<i32>();
        let cube = batch.column_by_name("attention to observation.entity.cube0").unwrap();
        assert_eq!(cube.as_primitive::<arrow_array::types::Float64Type>().values()[..3], [0.75, 0.0, 0.75]);
        let last = actions.value(4);
        assert_eq!(last.as_primitive::<arrow_array::types::Float64Type>().values()[..], [1.0, -1.0]);
    }

    #[test]
    fn the_drawing_has_a_row_for_each_step_of_a_thought() {
        let svg = sample().attention_svg().unwrap();
        assert_eq!(svg.matches("<title>").count(), 3 * 2);
        assert!(svg.contains(">cube0</text>") && svg.contains(">step 2, thought 1</text>"), "{svg}");
        assert!(svg.contains("<title>0.625</title>"), "the mean over both actions: {svg}");
        assert_eq!(PolicyTrace { attended: Vec::new(), ..sample() }.attention_svg(), None);
    }
}
