//! Results that other programs measured: LeRobot's `eval_info.json`, vla-eval's result files, a CSV.
//!
//! They have no seal and no protocol of ours, so they are compared and never ranked.

use std::collections::BTreeMap;
use std::fmt;

use csv_core::{ReadRecordResult, ReaderBuilder};
use serde_json::Value;

/// Outcomes of one policy on one task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Run {
    /// The task, as the file names it.
    pub task: String,
    /// The policy; the file's name where it does not say.
    pub policy: String,
    /// What the numbers of the episodes are.
    pub by: By,
    /// Successes by number.
    pub outcomes: BTreeMap<u64, bool>,
    /// Episodes that ended with an error, which vla-eval counts as failures.
    pub errors: u64,
    /// Whether the file says that episodes are missing.
    pub partial: bool,
}

/// What numbers the episodes of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum By {
    /// The simulator's seeds.
    Seed,
    /// Episodes of vla-eval, which fixes the initial state of each.
    VlaEval,
    /// Their order alone.
    Order,
}

impl Run {
    /// Whether the same number means the same initial state in both.
    pub fn is_paired(&self, other: &Self) -> bool {
        self.by == other.by && self.by != By::Order
    }
}

/// A file of results that cannot be read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unreadable {
    /// The file.
    pub file: String,
    /// What is wrong with it.
    pub what: String,
}

impl fmt::Display for Unreadable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.file, self.what)
    }
}

impl std::error::Error for Unreadable {}

/// The forms that are known.
const KNOWN: &str = "LeRobot's eval_info.json, a result file of vla-eval, or a CSV with the columns task, policy, success, and \
                     seed or episode";

/// Reads the `text` of a file called `file`.
///
/// # Errors
/// A form that is not known; a value that is missing or of another kind; an episode that is there twice.
pub fn parse(file: &str, text: &str) -> Result<Vec<Run>, Unreadable> {
    let failed = |what: String| Unreadable { file: file.to_owned(), what };
    let whole = text.trim_start_matches('\u{feff}');
    let text = whole.trim_start();
    let mut runs = Runs::default();
    let mut names = file.rsplit(['/', '\\']);
    let name = names.next().unwrap_or(file);
    let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    // LeRobot names every file so: the folder tells policies apart
    let folder = names.next().filter(|folder| stem == "eval_info" && !["", ".", ".."].contains(folder));
    let policy = folder.unwrap_or(stem);
    if text.starts_with(['{', '[']) {
        let value: Value =
            serde_json::from_str(&plain_json(text)).map_err(|error| failed(format!("not JSON: {error}")))?;
        let read = match (value.get("benchmark"), value.get("per_task"), value.get("per_episode")) {
            (Some(_), _, _) => vla_eval(&value, policy, &mut runs),
            (None, Some(tasks), _) => lerobot(tasks, policy, &mut runs),
            (None, None, Some(episodes)) => lerobot_episodes(episodes, policy, &mut runs),
            (None, None, None) => Err(format!("expected {KNOWN}")),
        };
        read.map_err(failed)?;
    } else {
        let above = whole[..whole.len() - text.len()].matches('\n').count() as u64;
        csv(text, above + 1, &mut runs).map_err(failed)?;
    }
    let runs: Vec<Run> = runs.0.into_values().collect();
    if runs.iter().all(|run| run.outcomes.is_empty()) {
        return Err(failed("it holds no episodes".to_owned()));
    }
    Ok(runs)
}

/// Runs by task and policy.
#[derive(Default)]
struct Runs(BTreeMap<(String, String), Run>);

impl Runs {
    fn run(&mut self, task: &str, policy: &str, by: By) -> &mut Run {
        let new = || Run {
            task: task.to_owned(),
            policy: policy.to_owned(),
            by,
            outcomes: BTreeMap::new(),
            errors: 0,
            partial: false,
        };
        self.0.entry((task.to_owned(), policy.to_owned())).or_insert_with(new)
    }
}

impl Run {
    fn add(&mut self, number: u64, success: bool) -> Result<(), String> {
        match self.outcomes.insert(number, success) {
            None => Ok(()),
            Some(_) => Err(format!("task {}, policy {}: episode {number} is there twice", self.task, self.policy)),
        }
    }
}

/// The value of a success: a truth value, 0 or 1.
fn success(value: Option<&Value>, at: &str) -> Result<bool, String> {
    let found = match value {
        Some(Value::Bool(success)) => return Ok(*success),
        Some(Value::Number(number)) if number.as_f64() == Some(0.0) => return Ok(false),
        Some(Value::Number(number)) if number.as_f64() == Some(1.0) => return Ok(true),
        None => "nothing".to_owned(),
        Some(other) => other.to_string(),
    };
    Err(format!("{at}: success: expected true or false, found {found}"))
}

fn list<'v>(value: Option<&'v Value>, at: &str) -> Result<&'v Vec<Value>, String> {
    value.and_then(Value::as_array).ok_or_else(|| format!("{at}: expected a list"))
}

fn vla_eval(value: &Value, policy: &str, runs: &mut Runs) -> Result<(), String> {
    let partial = value.get("partial").is_some_and(|partial| partial == &Value::Bool(true));
    for task in list(value.get("tasks"), "tasks")? {
        let name = task.get("task").and_then(Value::as_str).ok_or("tasks: expected `task`, a text, in each")?;
        for episode in list(task.get("episodes"), &format!("task {name}: episodes"))? {
            let number = episode.get("episode_id").and_then(Value::as_u64);
            let number = number.ok_or_else(|| format!("task {name}: expected `episode_id`, an integer, in each"))?;
            let error = episode.get("failure_reason").is_some_and(|reason| !reason.is_null());
            let found = episode.pointer("/metrics/success");
            let success = match (found, error) {
                (None, true) => false,
                (found, _) => success(found, &format!("task {name}, episode {number}"))?,
            };
            let run = runs.run(name, policy, By::VlaEval);
            run.partial = partial;
            run.errors += u64::from(error && !success);
            run.add(number, success)?;
        }
    }
    Ok(())
}

fn lerobot(tasks: &Value, policy: &str, runs: &mut Runs) -> Result<(), String> {
    let tasks = list(Some(tasks), "per_task")?;
    let group = |task: &Value| task.get("task_group").and_then(Value::as_str).map(str::to_owned);
    for task in tasks {
        let name = group(task).ok_or("per_task: expected `task_group`, a text, in each")?;
        // LeRobot numbers the tasks of a group
        let alone = tasks.iter().filter(|other| group(other).as_ref() == Some(&name)).count() == 1;
        let id = task.get("task_id").and_then(Value::as_u64).unwrap_or_default();
        let name = if alone { name } else { format!("{name}_{id}") };
        for (number, found) in (0..).zip(list(task.pointer("/metrics/successes"), &format!("{name}: successes"))?) {
            runs.run(&name, policy, By::Order)
                .add(number, success(Some(found), &format!("{name}, episode {number}"))?)?;
        }
    }
    Ok(())
}

/// The form of one environment alone, which names the seeds.
fn lerobot_episodes(episodes: &Value, policy: &str, runs: &mut Runs) -> Result<(), String> {
    let episodes = list(Some(episodes), "per_episode")?;
    let seeds: Option<Vec<u64>> = episodes.iter().map(|episode| episode.get("seed")?.as_u64()).collect();
    let by = if seeds.is_some() { By::Seed } else { By::Order };
    for (place, episode) in episodes.iter().enumerate() {
        let number = seeds.as_ref().map_or(place as u64, |seeds| seeds[place]);
        let success = success(episode.get("success"), &format!("per_episode {place}"))?;
        runs.run("task", policy, by).add(number, success)?;
    }
    Ok(())
}

/// `first` is the number of the text's first line.
fn csv(text: &str, first: u64, runs: &mut Runs) -> Result<(), String> {
    let head = text.lines().next().unwrap_or_default();
    let delimiter = [b',', b';', b'\t'].into_iter().find(|byte| head.as_bytes().contains(byte)).unwrap_or(b',');
    let mut lines = records(text, first, delimiter).into_iter();
    let header = lines.next().map(|(_, cells)| cells).unwrap_or_default();
    let column = |name: &str| header.iter().position(|cell| cell.trim().eq_ignore_ascii_case(name));
    let missing =
        |name: &str| format!("line {first}: no column `{name}`, found {}; expected {KNOWN}", header.join(", "));
    let need = |name: &str| column(name).ok_or_else(|| missing(name));
    let (task, policy, success) = (need("task")?, need("policy")?, need("success")?);
    let (number, by) = match (column("seed"), column("episode")) {
        (Some(seed), _) => (seed, By::Seed),
        (None, Some(episode)) => (episode, By::Order),
        (None, None) => return Err(missing("seed")),
    };
    for (line, cells) in lines {
        let cell = |at: usize| cells.get(at).map(|cell| cell.trim()).filter(|cell| !cell.is_empty());
        let need = |at: usize| cell(at).ok_or_else(|| format!("line {line}: no {}", header[at].trim()));
        let wrong = |at: usize, expected: &str, found: &str| {
            format!("line {line}: {}: expected {expected}, found `{found}`", header[at].trim())
        };
        let text = need(number)?;
        let count = text.parse().ok().ok_or_else(|| wrong(number, "an integer from 0 on", text))?;
        let text = need(success)?;
        let won = match text.to_ascii_lowercase().as_str() {
            "true" | "1" | "1.0" => true,
            "false" | "0" | "0.0" => false,
            _ => return Err(wrong(success, "true, false, 1 or 0", text)),
        };
        let run = runs.run(need(task)?, need(policy)?, by);
        run.add(count, won).map_err(|what| format!("line {line}: {what}"))?;
    }
    Ok(())
}

/// The records of a CSV with the line at which each begins; empty lines are none.
fn records(text: &str, first: u64, delimiter: u8) -> Vec<(u64, Vec<String>)> {
    let mut reader = ReaderBuilder::new().delimiter(delimiter).build();
    let mut input = text.as_bytes();
    let (mut all, mut cells) = (Vec::new(), vec![0; text.len().max(1)]);
    // a record has at most one cell more than its line has bytes
    let mut ends = vec![0; 64];
    let (mut line, newlines) = (first, |part: &[u8]| part.iter().filter(|byte| **byte == b'\n').count() as u64);
    loop {
        let empty = input.iter().take_while(|byte| b"\r\n".contains(byte)).count();
        line += newlines(&input[..empty]);
        input = &input[empty..];
        let (begun, mut written, mut count) = (input, 0, 0);
        let finished = loop {
            let (result, read, out, ended) = reader.read_record(input, &mut cells[written..], &mut ends[count..]);
            input = &input[read..];
            written += out;
            count += ended;
            match result {
                // what is left of the text follows; an empty rest is its end
                ReadRecordResult::InputEmpty => {}
                ReadRecordResult::OutputFull => cells.resize(2 * cells.len(), 0),
                ReadRecordResult::OutputEndsFull => ends.resize(2 * ends.len(), 0),
                ReadRecordResult::Record => break false,
                ReadRecordResult::End => break true,
            }
        };
        if finished {
            return all;
        }
        let starts = std::iter::once(0).chain(ends[..count].iter().copied());
        let cut =
            starts.zip(&ends[..count]).map(|(start, end)| String::from_utf8_lossy(&cells[start..*end]).into_owned());
        all.push((line, cut.collect()));
        line += newlines(&begun[..begun.len() - input.len()]);
    }
}

/// The text without the numbers that JSON does not have, as Python writes them: they become null.
fn plain_json(text: &str) -> String {
    let (mut plain, mut quoted, mut escaped) = (String::with_capacity(text.len()), false, false);
    let mut rest = text;
    while let Some(next) = rest.chars().next() {
        let word = ["NaN", "-Infinity", "Infinity"].into_iter().find(|word| !quoted && rest.starts_with(word));
        if let Some(word) = word {
            plain.push_str("null");
            rest = &rest[word.len()..];
            continue;
        }
        quoted ^= next == '"' && !escaped;
        escaped = quoted && next == '\\' && !escaped;
        plain.push(next);
        rest = &rest[next.len_utf8()..];
    }
    plain
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn error(file: &str, text: &str) -> String {
        parse(file, text).unwrap_err().to_string()
    }

    #[test]
    fn lerobot_s_forms_are_read() {
        let text = r#"{"per_task": [
            {"task_group": "libero_spatial", "task_id": 0, "metrics": {"successes": [true, false, true], "sum_rewards": [NaN]}},
            {"task_group": "libero_spatial", "task_id": 1, "metrics": {"successes": [false]}},
            {"task_group": "Lift", "task_id": 0, "metrics": {"successes": [1.0, 0]}}
        ], "overall": {"pc_success": NaN, "eval_s": -Infinity, "note": "NaN \" NaN"}}"#;
        let runs = parse("outputs/act/eval_info.json", text).unwrap();
        let found: Vec<(&str, &str, Vec<bool>)> = runs
            .iter()
            .map(|run| (run.task.as_str(), run.policy.as_str(), run.outcomes.values().copied().collect()))
            .collect();
        let expected = [
            ("Lift", "act", vec![true, false]),
            ("libero_spatial_0", "act", vec![true, false, true]),
            ("libero_spatial_1", "act", vec![false]),
        ];
        assert_eq!(found, expected);
        assert!(!runs[0].is_paired(&runs[1]));
        let text = r#"{"per_episode": [{"episode_ix": 0, "seed": 100, "success": true},
            {"episode_ix": 1, "seed": 101, "success": false}], "aggregated": {}}"#;
        let runs = parse("eval_info.json", text).unwrap();
        assert_eq!((runs[0].by, runs[0].outcomes.clone()), (By::Seed, [(100, true), (101, false)].into()));
        let none = r#"{"per_episode": [{"seed": null, "success": true}]}"#;
        assert_eq!(parse("e.json", none).unwrap()[0].by, By::Order);
    }

    #[test]
    fn vla_eval_s_form_is_read() {
        let text = r#"{"benchmark": "LIBERO", "mode": "sync", "harness_version": "0.8.0", "partial": true, "tasks": [
            {"task": "pick", "episodes": [
                {"episode_id": 0, "metrics": {"success": true}, "steps": 90},
                {"episode_id": 1, "metrics": {"success": 0.0}, "steps": 90},
                {"episode_id": 2, "metrics": {}, "failure_reason": "timeout"},
                {"episode_id": 3, "metrics": {"success": true}, "failure_reason": "server disconnected"}
            ], "num_episodes": 4, "avg_steps": 60.0}], "config": {}}"#;
        let runs = parse("pi0.json", text).unwrap();
        assert_eq!((runs[0].policy.as_str(), runs[0].errors, runs[0].partial), ("pi0", 1, true));
        assert_eq!(runs[0].outcomes, [(0, true), (1, false), (2, false), (3, true)].into());
        assert!(runs[0].is_paired(&runs[0]));
        let twice = text.replace("\"episode_id\": 1", "\"episode_id\": 0");
        assert_eq!(error("pi0.json", &twice), "pi0.json: task pick, policy pi0: episode 0 is there twice");
        let none = text.replace("{\"success\": true}", "{\"reward\": 1}");
        assert_eq!(
            error("a.json", &none),
            "a.json: task pick, episode 0: success: expected true or false, found nothing"
        );
    }

    #[test]
    fn csv_files_are_read() {
        let text = "\u{feff}Policy,seed,task,success,note\r\nmine,7,Lift,True,\"a, b\"\r\nmine,8,Lift,0,\r\n\r\nother,7,Lift,1,x\n";
        let runs = parse("r.csv", text).unwrap();
        assert_eq!(runs.len(), 2);
        assert_eq!((runs[0].policy.as_str(), runs[0].outcomes.clone()), ("mine", [(7, true), (8, false)].into()));
        assert!(runs[0].is_paired(&runs[1]));
        assert_eq!(parse("r.csv", &text.replace(",\"a, b\"", "").replace(',', ";")).unwrap(), runs);
        let orders = parse("r.csv", "task,policy,episode,success\nLift,mine,0,1").unwrap();
        assert_eq!(orders[0].by, By::Order);
        for (text, words) in [
            ("task,policy,success\nLift,a,1", "r.csv: line 1: no column `seed`, found task, policy, success"),
            ("task,seed,success\nLift,1,1", "no column `policy`"),
            (
                "task,policy,seed,success\nLift,a,1,maybe",
                "line 2: success: expected true, false, 1 or 0, found `maybe`",
            ),
            ("task,policy,seed,success\nLift,a,-1,1", "line 2: seed: expected an integer from 0 on, found `-1`"),
            ("task,policy,seed,success\nLift,a,1", "line 2: no success"),
            ("\n\ntask,policy,seed,success\r\n\r\nLift,\"a\nb\",1,1\n\nLift,a,1,maybe", "line 8: success"),
            (
                "task,policy,seed,success\nLift,a,1,1\nLift,a,1,0",
                "line 3: task Lift, policy a: episode 1 is there twice",
            ),
            ("task,policy,seed,success\n", "it holds no episodes"),
            ("", "no column `task`"),
            ("{\"a\": 1}", "expected LeRobot's eval_info.json"),
            ("{\"per_task\": 3}", "per_task: expected a list"),
            ("{", "not JSON"),
        ] {
            let found = error("r.csv", text);
            assert!(found.contains(words), "{found}");
        }
    }

    #[test]
    fn many_cells_in_a_line_are_read() {
        let wide: String = (0..200).map(|at| format!(",c{at}")).collect();
        let text = format!("task,policy,seed,success{wide}\nLift,a,1,1{}", ",".repeat(200));
        assert_eq!(parse("r.csv", &text).unwrap()[0].outcomes, [(1, true)].into());
    }
}
