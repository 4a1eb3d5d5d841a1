//! A leaderboard of ten thousand results, and its page in a browser.
//!
//!     target/release/examples/bench_report [--rounds N] [--rows N]
//!
//! prints a table and writes `target/bench/report.json`; the exit code is 1 where a bar is missed. The results are those that
//! come with the repository, over and over: 200 entries on 50 tasks, 50 episodes each. Chromium opens the page without a
//! window and says, by its own clock, when everything was laid out, counted from the navigation, and how long sorting,
//! filtering and turning to other rows take, layout included. The least of all rounds. Once, `actrm-zoo leaderboard` reads
//! as many results from files: 200 small entries in 50 blocks of 20 seeds, written as trainings and evaluations write them.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

#[path = "../tests/common/mod.rs"]
mod common;

use std::path::Path;
use std::process::{Command, ExitCode};
use std::time::Instant;

use common::{TASKS, browser, results, visit};
use report::{Beside, COLUMNS, Reading, csv, rank, to_html};
use serde_json::{Value, json};
use zoo::entry::{CardWords, Entry, EntryDraft, training_facts};
use zoo::registry::Registry;
use zoo::results::{ResultsFolder, Seeds, list_evaluations};

/// What a reader does, and what the clock says to it.
const READER: &str = r##"
const laid = () => document.body.offsetHeight;
laid();
told.laid_out = performance.now();
told.elements = document.getElementsByTagName("*").length;
const timed = (name, act) => { const begin = performance.now(); act(); laid(); told[name] = performance.now() - begin; };
const heads = [...document.getElementById("all").tHead.rows[0].cells];
const button = (name) => heads.find((head) => head.textContent.startsWith(name)).querySelector("button");
timed("sort_numbers", () => button("rate").click());
timed("sort_words", () => button("entry").click());
const filter = (name, value) => {
  const field = document.querySelector(`[data-filter="${name}"]`);
  field.value = value;
  field.dispatchEvent(new Event("input", { bubbles: true }));
};
timed("filter", () => filter("text", "entry-19"));
timed("filter_off", () => filter("text", ""));
const next = document.getElementById("next");
if (next) timed("next", () => next.click());
"##;

/// A zoo with `count` results, each of which the leaderboard takes.
fn store(zoo: &Path, count: usize) {
    const EPISODES: u64 = 20;
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../zoo");
    let model = Registry::open(&shipped).entry("lift-act@1").unwrap();
    let stored = list_evaluations(&shipped.join("results")).unwrap();
    let stored =
        stored.into_iter().find(|one| one.record.entry.name == "lift-act" && one.episodes.len() == 200).unwrap();
    for number in 0..count.div_ceil(TASKS) {
        let mut meta = model.meta().clone();
        meta.name = format!("entry-{number}");
        let draft = EntryDraft {
            meta,
            model: format!("weights {number}").into_bytes(),
            config: model.config_text().unwrap(),
            normaliser: b"normaliser".to_vec(),
            card: CardWords::default(),
            metrics: None,
            reference: None,
            command: None,
        };
        let id = draft.seal(zoo).unwrap();
        let entry = Entry::open(zoo, &id).unwrap();
        for block in 0..TASKS.min(count - number * TASKS) {
            let mut record = stored.record.clone();
            record.entry.name = id.name.clone();
            record.entry.hash = entry.meta().content_sha256();
            record.training = training_facts(entry.meta());
            record.seeds = Seeds { start: 40_000 + 1_000 * block as u64, count: EPISODES };
            let mut folder = ResultsFolder::open(&zoo.join("results"), &record).unwrap();
            for (k, seed) in folder.missing().into_iter().enumerate() {
                let (mut episode, mut timing) = (stored.episodes[k].clone(), stored.timings[k].clone());
                (episode.seed, timing.seed) = (seed, seed);
                episode.success = !(seed as usize * 7919 + block).is_multiple_of(3);
                folder.add(episode, timing).unwrap();
            }
            folder.finish().unwrap();
        }
    }
}

/// Seconds that `actrm-zoo leaderboard`, which lies beside this program, takes for `count` results in files.
fn leaderboard(count: usize) -> f64 {
    // what is timed is reading: in memory, where there is such a folder
    let memory = Path::new("/dev/shm");
    let folder = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() }.unwrap();
    store(folder.path(), count);
    let program = std::env::current_exe().unwrap().ancestors().nth(2).unwrap().join("actrm-zoo");
    let begin = Instant::now();
    let output = Command::new(program).arg("leaderboard").arg("--zoo").arg(folder.path()).output().unwrap();
    let took = begin.elapsed().as_secs_f64();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let table = std::fs::read_to_string(folder.path().join("leaderboard.csv")).unwrap();
    assert_eq!(table.lines().count(), count + 1);
    took
}

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let value = |flag: &str, default: usize| {
        args.iter().position(|arg| arg == flag).map_or(default, |at| args[at + 1].parse().unwrap())
    };
    let (rounds, count) = (value("--rounds", 3), value("--rows", 10_000));
    let Some(browser) = browser() else {
        eprintln!("error: no Chromium on the PATH; name one by ACTRM_CHROMIUM");
        return ExitCode::FAILURE;
    };
    let all = results(count);
    let mut least = serde_json::Map::new();
    let mut note = |name: &str, value: f64| {
        let best = least.get(name).and_then(Value::as_f64).map_or(value, |known| known.min(value));
        least.insert(name.to_owned(), json!(best));
    };
    for _ in 0..rounds {
        let begin = Instant::now();
        let rows = rank(&all, &Reading::default());
        note("rank", begin.elapsed().as_secs_f64() * 1e3);
        let begin = Instant::now();
        let html = to_html(&rows, &Beside::default());
        let table = csv::table(COLUMNS, &rows);
        note("write", begin.elapsed().as_secs_f64() * 1e3);
        assert_eq!((rows.len(), table.lines().count()), (count, count + 1));
        note("size", html.len() as f64 / 1e6);
        for (name, value) in visit(&browser, &html, READER).as_object().unwrap() {
            note(name, value.as_f64().unwrap());
        }
    }
    note("leaderboard", leaderboard(count) * 1e3);
    let named = [
        ("leaderboard", "actrm-zoo leaderboard, from files to files", "ms", None),
        ("rank", "ranks, groups and intervals", "ms", None),
        ("write", "report.html and leaderboard.csv", "ms", None),
        ("size", "size of report.html", "MB", None),
        ("elements", "elements of the page", "", None),
        ("laid_out", "Chromium, everything laid out", "ms", Some(5000.0)),
        ("sort_numbers", "Chromium, sorted by a number", "ms", Some(500.0)),
        ("sort_words", "Chromium, sorted by words", "ms", Some(500.0)),
        ("filter", "Chromium, filtered", "ms", Some(500.0)),
        ("filter_off", "Chromium, all rows again", "ms", Some(500.0)),
        ("next", "Chromium, turned to the next rows", "ms", Some(500.0)),
    ];
    let rows: Vec<Value> = named
        .iter()
        .filter_map(|(key, work, unit, bar)| {
            let ours = least.get(*key)?.as_f64()?;
            let work = format!("leaderboard of {count} results: {work}");
            let met = bar.is_none_or(|bar| ours <= bar);
            let bar = bar.map(|bar| format!("<= {bar} {unit}"));
            println!("{work:<76} {ours:>10.1} {unit:<3} {}", bar.as_deref().unwrap_or("-"));
            Some(json!({"work": work, "unit": unit, "ours": ours, "peer": null, "ratio": null, "bar": bar, "met": met}))
        })
        .collect();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target/bench");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("report.json"), serde_json::to_string_pretty(&rows).unwrap()).unwrap();
    ExitCode::from(u8::from(rows.iter().any(|row| row["met"] == false)))
}
