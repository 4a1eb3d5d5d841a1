//! `actrm-zoo trace` of robot policies, and evaluations of policies that think by the clock.

use std::path::Path;

use e2e::{data, lift, refused, root, succeeds, text, zoo};
use serde_json::Value;

/// What it printed.
fn said(command: &mut std::process::Command) -> String {
    String::from_utf8(succeeds(command).stdout).expect("text")
}

fn queries(trace: &Value) -> &Vec<Value> {
    trace["queries"].as_array().expect("a list of queries")
}

/// The actions that were executed, as JSON.
fn executed(trace: &Value) -> Vec<Value> {
    let of = |query: &Value| {
        let last = query["thought"].as_array().and_then(|steps| steps.last()).expect("a query has an answer");
        let count = query["executed"].as_u64().expect("a number") as usize;
        last["actions"].as_array().expect("a chunk")[..count].to_vec()
    };
    queries(trace).iter().flat_map(of).collect()
}

#[test]
fn a_shipped_entry_s_episode_is_shown_query_by_query() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let table = folder.path().join("new/trace.parquet");
    let entries = root().join("zoo");
    let trace = |more: &[&str]| {
        let mut command = zoo(["trace", "lift-act@1", "--seed", "10000", "--zoo", text(&entries)]);
        command.args(more);
        command
    };
    let shown = said(&mut trace(&["--parquet", text(&table)]));
    assert!(shown.starts_with("lift-act@1 on Lift, seed 10000: success after "), "{shown}");
    assert!(table.is_file());
    for option in ["--parquet", "--svg"] {
        refused(&mut trace(&[option, text(&table)]), &["trace.parquet: exists already"]);
    }
    let json = || serde_json::from_str::<Value>(&said(&mut trace(&["--json"]))).expect("JSON");
    let (one, two) = (json(), json());
    assert_eq!(one["success"], true);
    assert_eq!(executed(&one).len() as u64, one["steps"].as_u64().expect("a number"));
    assert_eq!(executed(&one), executed(&two), "an episode repeats");
    // ACT answers at once
    assert!(queries(&one).iter().all(|query| query["thought"].as_array().is_some_and(|steps| steps.len() == 1)));
    refused(&mut trace(&["--index", "3"]), &["--index", "lift-act@1", "robot policy"]);
}

/// A small `lift-actrm` that was trained for two steps.
fn thinker(folder: &Path, more: &[&str]) {
    let mut command = zoo(["train", "actrm_lift", "train.steps=2", "policy.dim_model=16", "policy.dim_feedforward=24"]);
    command.args(["--data", text(&folder.join("lift")), "--zoo", text(&folder.join("zoo"))]);
    command.args(["--runs", text(&folder.join("runs"))]).args(more);
    succeeds(&mut command);
}

#[test]
fn a_thought_is_shown_and_a_thought_by_the_clock_is_not_repeatable() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let folder = folder.path();
    succeeds(&mut data(["convert", text(&lift()), text(&folder.join("lift"))]));
    let always = ["policy.reasoning.halt_threshold=1.0", "policy.reasoning.change_threshold=0.0"];
    thinker(folder, &[&always[..], &["policy.reasoning.warm_start={}"]].concat());
    thinker(folder, &[&always[..], &["policy.reasoning.budget_ms=0.0"]].concat());
    let entries = folder.join("zoo");
    let depth = |entry: &str| {
        let text = said(&mut zoo(["trace", entry, "--json", "--zoo", text(&entries)]));
        let trace: Value = serde_json::from_str(&text).expect("JSON");
        queries(&trace).iter().map(|query| query["thought"].as_array().map_or(0, Vec::len)).max()
    };
    assert_eq!(depth("lift-actrm@1"), Some(3));
    assert_eq!(depth("lift-actrm@2"), Some(1));
    let eval = |entry: &'static str| {
        let mut command = zoo(["eval", entry, "--episodes", "2", "--max-steps", "10", "--zoo", text(&entries)]);
        command.args(["--workers", "1"]);
        command
    };
    assert!(!said(&mut eval("lift-actrm@1")).contains("clock"));
    assert!(said(eval("lift-actrm@1").arg("--again")).contains("2 episodes run again, every outcome the same"));
    assert!(said(&mut eval("lift-actrm@2")).contains("it has a time budget"));
    refused(eval("lift-actrm@2").arg("--again"), &["lift-actrm@2", "time budget"]);
}

#[test]
fn attention_is_drawn_and_other_depths_are_counted() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    succeeds(&mut data(["convert", text(&lift()), text(&folder.path().join("lift"))]));
    thinker(folder.path(), &[]);
    let entries = folder.path().join("zoo");
    let (svg, table) = (folder.path().join("attention.svg"), folder.path().join("trace.parquet"));
    let mut command = zoo(["trace", "lift-actrm", "--seed", "10000", "--json", "--zoo", text(&entries)]);
    let trace: Value = serde_json::from_str(&said(command.args(["--parquet", text(&table)]))).expect("JSON");
    let names: Vec<&str> = trace["attended"].as_array().expect("names").iter().filter_map(Value::as_str).collect();
    assert!(names.contains(&"observation.environment_state"), "{names:?}");
    for step in queries(&trace)[0]["thought"].as_array().expect("steps") {
        let attention = step["attention"].as_array().expect("a row an action");
        assert_eq!(attention.len(), 16);
        let row = attention[3].as_array().expect("numbers");
        let sum: f64 = row.iter().filter_map(Value::as_f64).sum();
        assert!(row.len() == names.len() && (sum - 1.0).abs() < 1e-4, "{row:?}");
    }
    said(zoo(["trace", "lift-actrm", "--zoo", text(&entries)]).args(["--svg", text(&svg)]));
    assert!(std::fs::read_to_string(&svg).expect("a drawing").contains("environment_state</text>"));

    let depth = |more: &[&str]| {
        let mut command = zoo(["depth", "lift-actrm", "--episodes", "2", "--workers", "1", "--zoo", text(&entries)]);
        command.args(["--work", text(&folder.path().join("depth"))]).args(more);
        command
    };
    let rows: Value = serde_json::from_str(&said(&mut depth(&["--steps", "1,5", "--json"]))).expect("JSON");
    let of = |row: usize, key: &str| rows[row][key].as_f64().expect("a number");
    assert_eq!((of(0, "steps"), of(1, "steps"), of(0, "episodes")), (1.0, 5.0, 2.0));
    assert!(of(1, "query_flops") > of(0, "query_flops"));
    let shuffled = said(&mut depth(&["--steps", "3", "--intervene", "shuffle"]));
    assert!(shuffled.contains("success"), "{shuffled}");
    assert!(!entries.join("results").exists(), "what it does otherwise is no result of the entry");
    let mut board = zoo(["leaderboard", "--json", "--zoo", text(&entries)]);
    let told: Value =
        serde_json::from_str(&said(board.args(["--depths", text(&folder.path().join("depth"))]))).expect("JSON");
    let told = told["depths"].as_array().expect("a list");
    let of = |key: &str| told.iter().map(|depth| depth[key].clone()).collect::<Vec<_>>();
    assert_eq!(
        (of("steps"), of("episodes")),
        (vec![1.into(), 3.into(), 5.into()], vec![Value::from(2); 3]),
        "{told:?}"
    );
    assert_eq!(of("thinking"), ["whole", "shuffle", "whole"], "{told:?}");
    let page = std::fs::read_to_string(entries.join("report.html")).expect("a page");
    for words in ["lift-actrm@1 on Lift", "every step done", "reasoning of another episode"] {
        assert!(page.contains(words), "no {words}");
    }
    refused(&mut depth(&["--intervene", "melt"]), &["freeze or shuffle"]);
    let mut act = zoo(["depth", "lift-act@1", "--steps", "2", "--zoo", text(&root().join("zoo"))]);
    refused(&mut act, &["lift-act@1", "does not think step by step"]);
    let mut probe = zoo(["probe", "lift-actrm", "--episodes", "2", "--workers", "1", "--zoo", text(&entries)]);
    probe.args(["--data", text(&folder.path().join("lift")), "--work", text(&folder.path().join("probe"))]);
    refused(&mut probe, &["NAME_points", "lift-actrm"]);
    refused(probe.args(["--out", text(&table)]), &["trace.parquet: exists already"]);
}
