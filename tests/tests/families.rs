//! Families of trainings and what compares entries, as users run them: one row with n trainings, flips seed by seed,
//! aliases, what is removed and what is not.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use e2e::{SHIPPED_ACT, copied_zoo, listing, refused, shipped, succeeds, text, trained, zoo};
use serde_json::Value;

fn said(command: &mut Command) -> String {
    String::from_utf8(succeeds(command).stdout).expect("text")
}

fn json(command: &mut Command) -> Value {
    serde_json::from_str(&said(command)).expect("JSON")
}

/// Trains two steps with each of the seeds.
fn train(folder: &Path, seeds: &str, more: &[&str]) -> Command {
    train_into(&folder.join("zoo"), folder, seeds, more)
}

fn train_into(entries: &Path, folder: &Path, seeds: &str, more: &[&str]) -> Command {
    let mut command =
        zoo(["train", "act_lift", "train.steps=2", "train.batch_size=4", "policy.dim_model=32", "--seeds", seeds]);
    command.args(["--data", text(&trained().join("lift")), "--zoo", text(entries)]);
    command.args(["--runs", text(&folder.join("runs"))]).args(more);
    command
}

#[test]
fn several_seeds_make_a_family_that_is_one_row() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (folder, entries) = (folder.path(), folder.path().join("zoo"));
    let first = said(&mut train(folder, "1..2", &[]));
    assert!(first.contains("lift-act-s1@1 is in") && first.contains("lift-act-s2@1 is in"), "{first}");
    // the same again with one more: the others are there
    let more = said(&mut train(folder, "1..3", &[]));
    assert_eq!(more.matches(" already (run ").count(), 2, "{more}");
    assert!(more.contains("lift-act-s3@1 is in"), "{more}");
    // other settings are another family, with runs of its own
    let other = said(&mut train(folder, "1", &["train.lr=0.002"]));
    assert!(other.contains("lift-act-s1@2 is in"), "{other}");
    // an entry of the same name in another zoo is another training's
    let elsewhere = folder.join("elsewhere");
    fs::create_dir_all(elsewhere.join("lift-act-s1")).expect("a folder");
    for name in listing(&entries.join("lift-act-s1/2")) {
        let there = elsewhere.join("lift-act-s1/1");
        fs::create_dir_all(&there).expect("a folder");
        fs::copy(entries.join("lift-act-s1/2").join(&name), there.join(&name)).expect("copied");
    }
    refused(&mut train_into(&elsewhere, folder, "1", &[]), &["seed 1", "not in", "remove that folder"]);
    refused(&mut train(folder, "1..2", &["train.seed=4"]), &["--seeds", "train.seed=4"]);
    refused(&mut train(folder, "2..1", &[]), &["2..1"]);
    assert_eq!(json(&mut zoo(["list", "--json", "--zoo", text(&entries)])).as_array().map(Vec::len), Some(4));

    let mut eval = zoo(["eval", "lift-act-s*@1", "--episodes", "6", "--max-steps", "4", "--json"]);
    let evaluated = json(eval.args(["--zoo", text(&entries)]));
    assert_eq!(evaluated.as_array().map(Vec::len), Some(3), "{evaluated}");
    assert_eq!((&evaluated[0]["episodes"], &evaluated[0]["evaluated_before"]), (&6.into(), &false.into()));

    let board = json(&mut zoo(["leaderboard", "--json", "--zoo", text(&entries)]));
    let rows = board["rows"].as_array().expect("rows");
    assert_eq!(rows.len(), 1, "{board}");
    let row = &rows[0];
    assert_eq!((&row["entry"], &row["trainings"], &row["episodes"]), (&"lift-act-s".into(), &3.into(), &18.into()));
    assert_eq!(row["training_seed"], "1 2 3");
    assert_eq!(board["trainings"].as_array().map(Vec::len), Some(3));
    let each = fs::read_to_string(entries.join("leaderboard_trainings.csv")).expect("each training");
    assert_eq!(each.lines().count(), 4, "{each}");
    let table = said(&mut zoo(["leaderboard", "--trainings", "--zoo", text(&entries)]));
    assert!(
        table.contains("lift-act-s*@1") && table.contains("lift-act-s2@1") && table.contains("3 trainings"),
        "{table}"
    );
}

#[test]
fn entries_are_compared_seed_by_seed() {
    let (_folder, entries) = copied_zoo();
    e2e::train_lift(&trained().join("lift"), &entries, &entries.join("runs"));
    let eval = |more: &[&str]| {
        let mut command =
            zoo(["eval", "--all-versions", "--episodes", "20", "--max-steps", "4", "--zoo", text(&entries)]);
        succeeds(command.args(more));
    };
    eval(&[]);
    let compare = |more: &[&str]| {
        let mut command = zoo(["compare", "lift-act@1", "lift-act@2", "--zoo", text(&entries)]);
        command.args(more);
        command
    };
    let told = said(&mut compare(&[]));
    assert!(told.contains("20 seeds that both were run on") && told.contains("McNemar p 1.0000"), "{told}");
    assert!(told.contains("sequential: not decided"), "{told}");
    let value = json(&mut compare(&["--json"]));
    assert_eq!((&value[0]["shared_seeds"], &value[0]["flips"]["neither"]), (&20.into(), &20.into()), "{value}");
    // two trainings alike are not told apart, however many episodes are run; those that are there are not run again
    let value = json(&mut compare(&["--until-decided", "--most", "24", "--max-steps", "4", "--json"]));
    assert_eq!((&value["seeds"], &value["flips"]["decided_after"]), (&24.into(), &Value::Null), "{value}");
    refused(&mut zoo(["compare", "lift-act@1", "lift-act@1", "--until-decided", "--zoo", text(&entries)]), &["twice"]);
    assert_eq!(json(&mut compare(&["--task", "Lift", "--json"])).as_array().map(Vec::len), Some(1));
    refused(&mut compare(&["--task", "Door"]), &["lift-act@1: no evaluations of Door in"]);
    refused(&mut compare(&["--max-steps", "4"]), &["--max-steps: expected --until-decided"]);
    refused(&mut zoo(["compare", "lift-act", "door", "--zoo", text(&entries)]), &["unknown entry `door`"]);
}

#[test]
fn what_was_not_run_under_the_same_rules_is_not_compared() {
    let (_folder, entries) = shipped(&["lift-act", "stack-act"]);
    let arguments = ["compare", "lift-act", "stack-act", "--zoo", text(&entries)];
    refused(&mut zoo(arguments), &["lift-act@1", "stack-act@1", "same protocol: the tasks differ, Lift and Stack"]);
    let beside_itself = ["compare", "lift-act", "lift-act@1", "--zoo", text(&entries)];
    refused(&mut zoo(beside_itself), &["lift-act@1: both names are the same entry"]);
}

/// LeRobot's and other files stand beside sealed rows, are told from them, and are paired by seeds alone.
#[test]
fn results_of_other_programs_are_compared() {
    let (_folder, entries) = shipped(&["lift-act"]);
    let file = |name: &str, text: &str| {
        let path = entries.join(name);
        fs::write(&path, text).expect("writable");
        path
    };
    let mut lines = "task,policy,seed,success\n".to_owned();
    for seed in 40_000..40_200 {
        lines.push_str(&format!("Lift,mine,{seed},{}\nLift,theirs,{seed},true\n", seed >= 40_010));
    }
    let csv = file("results.csv", &lines);
    let outcomes: Vec<bool> = (0..50).map(|place| place < 40).collect();
    let info =
        serde_json::json!({"per_task": [{"task_group": "lift", "task_id": 0, "metrics": {"successes": outcomes}}]});
    let info = file("eval_info.json", &info.to_string());
    let compare = |first: &str, second: &str, more: &[&str]| {
        let mut command = zoo(["compare", first, second, "--zoo", text(&entries)]);
        command.args(more);
        command
    };
    let (mine, theirs) = (format!("{}:mine", text(&csv)), format!("{}:theirs", text(&csv)));
    let both = json(&mut compare(&mine, &theirs, &["--json"]));
    assert_eq!(
        (&both[0]["test"], &both[0]["flips"]["second_only"].as_array().map(Vec::len)),
        (&"McNemar".into(), &Some(10))
    );
    let told = said(&mut compare("lift-act", &mine, &[]));
    assert!(told.contains("sealed") && told.contains("results.csv, not sealed"), "{told}");
    let unpaired = said(&mut compare("lift-act", text(&info), &["--task", "Lift"]));
    for words in ["0 episodes from the same initial state", "40 of 50", "Barnard p", "N-SCORE p", "SAVI p"] {
        assert!(unpaired.contains(words), "{unpaired}");
    }
    refused(&mut compare("lift-act", text(&info), &[]), &["no task that both have", "Lift", "lift", "--task"]);
    refused(&mut compare(text(&csv), "lift-act", &[]), &["expected one policy, found mine, theirs", ":POLICY"]);
    refused(&mut compare(&mine, &theirs, &["--until-decided"]), &["--until-decided", "file of results"]);
    refused(&mut compare("nothing.csv", "lift-act", &[]), &["nothing.csv"]);
}

#[test]
fn rows_of_a_protocol_stand_under_its_name() {
    let (_folder, entries) =
        shipped(&[&SHIPPED_ACT[..], &["lift-act-s1", "lift-act-s2", "lift-actrm-s1", "lift-expert-s1"]].concat());
    let board = json(&mut zoo(["leaderboard", "--json", "--zoo", text(&entries)]));
    let rows = board["rows"].as_array().expect("rows");
    assert!(rows.iter().all(|row| row["named_protocol"].as_str().is_some_and(|name| name.ends_with("-v1"))));
    // the two blocks of each task are ranked apart
    let mut ranks: BTreeMap<(&str, &str), Vec<u64>> = BTreeMap::new();
    for row in rows {
        let (block, task) = (row["block"].as_str().expect("a block"), row["task"].as_str().expect("a task"));
        // floors and ceilings have none
        if row["policy"].as_str().is_some_and(|policy| ["zero", "random", "replay", "expert"].contains(&policy)) {
            assert!(row["rank"].is_null(), "{row}");
            continue;
        }
        ranks.entry((block, task)).or_default().push(row["rank"].as_u64().expect("a rank"));
    }
    assert_eq!(ranks.keys().filter(|(block, _)| *block == "dev").count(), 6);
    for (place, mut ranks) in ranks {
        ranks.sort_unstable();
        // rows that are alike share a rank
        assert_eq!(ranks[0], 1, "{place:?}");
        assert!(ranks.iter().zip(1..).all(|(rank, at)| *rank <= at), "{place:?}: {ranks:?}");
    }
    let eval = |name: &str, protocol: &str| zoo(["eval", name, "--protocol", protocol, "--zoo", text(&entries)]);
    refused(&mut eval("lift-act", "stack-v1"), &["protocol stack-v1: task: expected Stack, found Lift"]);
    refused(&mut eval("lift-act", "lfit-v1"), &["protocol `lfit-v1`", "lift-v1"]);
    refused(eval("lift-act", "lift-v1").args(["--episodes", "3"]), &["--episodes"]);
}

#[test]
fn aliases_point_and_what_something_stands_on_stays() {
    let (_folder, entries) = shipped(&["lift-act"]);
    let command = |name: &str, arguments: &[&str]| {
        let mut command = zoo([name]);
        command.args(arguments).args(["--zoo", text(&entries)]);
        command
    };
    refused(&mut command("show", &["lift-act@best"]), &["no alias `best`", "actrm-zoo alias"]);
    assert_eq!(said(&mut command("alias", &["lift-act", "best", "--by-results"])), "lift-act@best is lift-act@1\n");
    assert!(said(&mut command("show", &["lift-act@best"])).starts_with("# lift-act@1"));
    assert_eq!(
        said(&mut command("alias", &["lift-act"])),
        "lift-act@latest is lift-act@1\nlift-act@best is lift-act@1\n"
    );
    refused(&mut command("remove", &["lift-act@1"]), &["not removed", "lift-act@1_Lift_10000-10099", "alias best"]);
    refused(&mut command("remove", &["lift-act"]), &["expected a version"]);
    for name in listing(&entries.join("results")).into_iter().filter(|name| name.starts_with("lift-act@1_")) {
        fs::remove_dir_all(entries.join("results").join(name)).expect("removable");
    }
    refused(&mut command("alias", &["lift-act", "bst", "--remove"]), &["no alias `bst`", "best = 1"]);
    succeeds(&mut command("alias", &["lift-act", "best", "--remove"]));
    // twice by mistake is once
    succeeds(&mut command("remove", &["lift-act@1", "lift-act@1"]));
    refused(&mut command("show", &["lift-act"]), &["unknown entry `lift-act`"]);
}

#[test]
fn entries_differ_in_what_they_say() {
    let (_folder, entries) = shipped(&[&SHIPPED_ACT[..], &["lift-act-s1", "lift-act-s2"]].concat());
    let command = |arguments: &[&str]| {
        let mut command = zoo([]);
        command.args(arguments).args(["--zoo", text(&entries)]);
        command
    };
    let told = said(&mut command(&["diff", "lift-act", "stack-act"]));
    for word in ["config.task.name", "config.train.steps", "data fingerprint", "result Lift lift-v1 test", "12000"] {
        assert!(told.contains(word), "no {word}: {told}");
    }
    assert!(said(&mut command(&["diff", "lift-act", "lift-act@1"])).contains("differ in nothing"));
    // their curves: 500 and 12,000 steps of other tasks; two trainings that differ in their seed alone
    assert!(told.contains("training loss: "), "{told}");
    let told = said(&mut command(&["diff", "lift-act-s1", "lift-act-s2", "--json"]));
    let told: serde_json::Value = serde_json::from_str(&told).expect("JSON");
    let training = &told["curves"][0];
    let apart = &training["first_difference"];
    assert_eq!((&training["what"], &apart["step"]), (&"training loss".into(), &training["at"][0]["step"]), "{told}");
    assert_eq!(training["at"].as_array().map(Vec::len), Some(6), "{told}");
    let number = |key: &str| apart[key].as_f64().expect("a number");
    assert!((number("second") - number("first") - number("difference")).abs() < 1e-12, "{told}");
    assert!(number("difference") != 0.0, "{told}");
    let curves = said(&mut command(&["curves", "lift-act", "stack-act"]));
    assert!(curves.contains("lift-act@1") && curves.contains('█'), "{curves}");
    let picture = entries.join("curves.svg");
    succeeds(&mut command(&["curves", "*-act", "--svg", text(&picture)]));
    refused(&mut command(&["curves", "*-act", "--svg", text(&picture)]), &["curves.svg: exists already"]);
    let svg = fs::read_to_string(&picture).expect("a picture");
    assert!(svg.starts_with("<svg xmlns=") && svg.matches("<polyline").count() == 6, "{}", &svg[..200]);
}

#[test]
fn puzzles_refuse_what_is_the_robots_and_answer_again() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let entries = folder.path().join("zoo");
    let (runs, at) = (folder.path().join("runs"), text(&entries));
    let mut train = zoo(["train", "trm_maze8-original", "train.steps=2", "train.validate_every=1000000", "--zoo", at]);
    succeeds(train.args(["--runs", text(&runs)]));
    let name = listing(&entries).into_iter().find(|name| !name.starts_with('.')).expect("an entry");
    let eval = |more: &[&str]| {
        let mut command = zoo(["eval", &name, "--puzzles", "20", "--depth", "2", "--zoo", at]);
        command.args(more);
        command
    };
    refused(&mut eval(&["--again"]), &["nothing to run again"]);
    let first = said(&mut eval(&[]));
    let again = said(&mut eval(&[]));
    assert_eq!(again, first.replace('\n', " (evaluated before; --again runs it again)\n"));
    assert!(said(&mut eval(&["--again"])).contains("20 puzzles answered again, every answer the same"));
    assert!(!said(&mut eval(&["--seed-start", "7"])).contains("evaluated before"));
    for option in [["--episodes", "3"], ["--max-steps", "3"], ["--video", "1"]] {
        refused(&mut eval(&option), &[option[0], "a solver of puzzles"]);
    }
    let Output { stdout, .. } = succeeds(&mut zoo(["leaderboard", "--zoo", at]));
    let table = String::from_utf8(stdout).expect("text");
    assert!(table.contains(", seed 7"), "{table}");
}

#[test]
fn a_training_takes_the_threads_it_is_given_and_comes_to_the_same() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let trained_on = |threads: &str| {
        let folder = folder.path().join(threads);
        let mut command = train(&folder, "1", &[]);
        said(command.env("RAYON_NUM_THREADS", threads));
        let entry = folder.join("zoo/lift-act-s1/1");
        let meta = fs::read_to_string(entry.join("entry.json")).expect("an entry");
        let meta: Value = serde_json::from_str(&meta).expect("JSON");
        (meta["training"]["threads"].clone(), fs::read(entry.join("model.safetensors")).expect("weights"))
    };
    let (one, two) = (trained_on("1"), trained_on("2"));
    assert_eq!((one.0, two.0), (1.into(), 2.into()));
    assert!(one.1 == two.1, "the weights depend on the number of threads");
}
