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
    let table = folder.path().join("trace.parquet");
    let entries = root().join("zoo");
    let trace = |more: &[&str]| {
        let mut command = zoo(["trace", "lift-act@1", "--seed", "10000", "--zoo", text(&entries)]);
        command.args(more);
        command
    };
    let shown = said(&mut trace(&["--parquet", text(&table)]));
    assert!(shown.starts_with("lift-act@1 on Lift, seed 10000: success after "), "{shown}");
    assert!(table.is_file());
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
    assert!(said(&mut eval("lift-actrm@2")).contains("it thinks by the clock"));
    refused(eval("lift-actrm@2").arg("--again"), &["lift-actrm@2", "by the clock"]);
}
