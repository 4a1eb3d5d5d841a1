//! `actrm-zoo eval` and `merge` as users run them: stopped and gone on with, in parts, again, filmed, refused.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use e2e::{copied_zoo, data, lift, listing, refused, succeeds, text, train_lift, trained, wait_until, zoo};

/// An evaluation of the trained entry: short episodes, whose number does not matter to what is tested, by one worker
/// where `more` does not say how many.
fn eval(entries: &Path, episodes: &str, more: &[&str]) -> Command {
    let mut command = zoo(["eval", "lift-act@1", "--max-steps", "6", "--episodes", episodes, "--zoo", text(entries)]);
    command.args(if more.contains(&"--workers") { &[][..] } else { &["--workers", "1"] }).args(more);
    command
}

/// The only result folder whose name holds a text.
fn result(results: &Path, holding: &str) -> PathBuf {
    let names: Vec<String> = listing(results).into_iter().filter(|name| name.contains(holding)).collect();
    assert_eq!(names.len(), 1, "{holding}: {names:?} of {:?}", listing(results));
    results.join(&names[0])
}

fn outcomes(folder: &Path) -> Vec<u8> {
    fs::read(folder.join("outcomes.parquet")).expect("a finished evaluation")
}

/// What it printed.
fn said(command: &mut Command) -> String {
    String::from_utf8(succeeds(command).stdout).expect("text")
}

#[test]
fn ctrl_c_once_finishes_the_episode_and_saves_and_the_same_command_goes_on() {
    let (_folder, entries) = copied_zoo();
    let stopped = entries.join("stopped");
    let mut command = eval(&entries, "24", &["--workers", "2", "--results", text(&stopped)]);
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("it starts");
    // as soon as the first episode is on disk
    let journal = wait_until("an episode", || {
        let path = stopped.join(listing(&stopped).pop()?).join("journal.jsonl");
        fs::metadata(&path).is_ok_and(|m| m.len() > 0).then_some(path)
    });
    let killed = Command::new("kill").args(["-INT", &child.id().to_string()]).status().expect("kill");
    assert!(killed.success());
    let output = child.wait_with_output().expect("it ends");
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(130), "{error}");
    assert!(error.contains("of 24 episodes done") && error.contains("run the same command again"), "{error}");
    let done = fs::read_to_string(&journal).expect("a journal").lines().count();
    assert!((1..24).contains(&done), "{done} episodes on disk");

    let resumed = said(&mut eval(&entries, "24", &["--workers", "1", "--results", text(&stopped)]));
    let straight = entries.join("straight");
    assert_eq!(said(&mut eval(&entries, "24", &["--workers", "2", "--results", text(&straight)])), resumed);
    assert_eq!(outcomes(&result(&stopped, "lift-act")), outcomes(&result(&straight, "lift-act")));
}

#[test]
fn parts_are_joined_to_the_whole_and_others_are_refused() {
    let (_folder, entries) = copied_zoo();
    let results = entries.join("results");
    succeeds(&mut eval(&entries, "4", &["--shard", "2/2"]));
    refused(&mut zoo(["merge", "--zoo", text(&entries)]), &["shards 1/2 to 2/2", "no 1/2"]);
    succeeds(&mut eval(&entries, "4", &["--shard", "1/2"]));
    let parts = ["_shard-1-of-2", "_shard-2-of-2"].map(|mark| result(&results, mark));

    // the same seeds under other rules, and of another number of parts, do not belong to them
    let other = entries.join("other");
    succeeds(&mut eval(&entries, "4", &["--shard", "2/2", "--results", text(&other), "--n-action-steps", "4"]));
    let foreign = result(&other, "_shard-2-of-2");
    refused(&mut zoo(["merge", text(&parts[0]), text(&foreign), "--zoo", text(&entries)]), &["execution: expected"]);
    refused(&mut zoo(["merge", text(&parts[0]), text(&parts[0]), "--zoo", text(&entries)]), &["once"]);

    // an evaluation that lacks a part keeps no other from being joined
    let both = entries.join("both");
    for (episodes, part) in [("2", "1/2"), ("4", "1/2"), ("4", "2/2")] {
        succeeds(&mut eval(&entries, episodes, &["--shard", part, "--results", text(&both)]));
    }
    let output = zoo(["merge", "--zoo", text(&entries), "--results", text(&both)]).output().expect("it runs");
    let (out, error) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(out.contains("of 4 episodes succeeded"), "{out}");
    assert!(error.contains("10000-10001") && error.contains("no 2/2"), "{error}");

    assert!(said(&mut zoo(["merge", "--zoo", text(&entries)])).contains("of 4 episodes succeeded"));
    let whole = entries.join("whole");
    succeeds(&mut eval(&entries, "4", &["--results", text(&whole)]));
    let joined: Vec<String> = listing(&results).into_iter().filter(|name| !name.contains("_shard-")).collect();
    assert_eq!(joined.len(), 1, "{joined:?}");
    assert_eq!(outcomes(&results.join(&joined[0])), outcomes(&result(&whole, "lift-act")));
}

#[test]
fn a_finished_evaluation_or_part_of_it_runs_again_to_the_same_outcomes() {
    let (_folder, entries) = copied_zoo();
    refused(&mut eval(&entries, "3", &["--again"]), &["nothing to run again"]);
    succeeds(&mut eval(&entries, "3", &[]));
    assert!(said(&mut eval(&entries, "3", &["--again"])).contains("3 episodes run again, every outcome the same"));
    refused(&mut eval(&entries, "4", &["--again"]), &["nothing to run again", "10000-10003", "stored: 10000-10002"]);
    assert_eq!(listing(&entries.join("results")).len(), 1);
    // under another version of what was there: run, compared, and told
    let record = result(&entries.join("results"), "lift-act").join("evaluation.json");
    let text = fs::read_to_string(&record).expect("a record");
    let value = |name: &str| {
        let rest = text.split(&format!("\"{name}\": \"")).nth(1).and_then(|rest| rest.split('"').next());
        rest.unwrap_or_else(|| panic!("no {name} in {text}"))
    };
    let (numpy, kernels) = (value("numpy"), value("kernels"));
    let changed = text.replace(&format!("\"numpy\": \"{numpy}\""), "\"numpy\": \"1.0.0\"");
    let changed = changed.replace(kernels, "openblas Other");
    fs::write(&record, changed).expect("writable");
    fs::remove_file(record.with_file_name("seal.json")).expect("results made before seals have none");
    let output = succeeds(&mut eval(&entries, "2", &["--again"]));
    let told = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(told.contains("2 of 3 episodes run again, every outcome the same"), "{told}");
    let note = String::from_utf8_lossy(&output.stderr).into_owned();
    for told in ["numpy 1.0.0", numpy, "kernels openblas Other", kernels] {
        assert!(note.contains(told), "{told}: {note}");
    }
    // results of another entry of that name
    fs::write(&record, text.replace("\"demos\": 45", "\"demos\": 44")).expect("writable");
    refused(&mut eval(&entries, "2", &["--again"]), &["evaluation.json: training differs", "44", "45"]);
}

#[test]
fn more_episodes_run_only_what_is_missing_and_none_starts_no_simulator() {
    let (_folder, entries) = copied_zoo();
    succeeds(&mut eval(&entries, "3", &[]));
    let logs = entries.join("logs");
    let line = said(&mut eval(&entries, "5", &["--workers", "1", "--worker-logs", text(&logs)]));
    assert!(!line.contains("evaluated before"), "{line}");
    let straight = entries.join("straight");
    assert_eq!(said(&mut eval(&entries, "5", &["--results", text(&straight)])), line);
    assert_eq!(outcomes(&result(&entries.join("results"), "10004")), outcomes(&result(&straight, "10004")));
    assert_eq!(listing(&logs).len(), 1, "{:?}", listing(&logs));
    // shown again: no worker has a log
    let none = entries.join("none");
    let shown = said(&mut eval(&entries, "5", &["--workers", "1", "--worker-logs", text(&none)]));
    assert_eq!(shown, line.replace('\n', " (evaluated before; --again runs it again)\n"));
    assert!(listing(&none).is_empty(), "{:?}", listing(&none));
}

#[test]
fn all_is_the_newest_versions_and_one_bad_entry_keeps_no_other_from_being_evaluated() {
    let (folder, entries) = copied_zoo();
    for _ in 0..2 {
        train_lift(&trained().join("lift"), &entries, &folder.path().join("runs"));
    }
    let model = entries.join("lift-act/2/model.safetensors");
    let mut bytes = fs::read(&model).expect("a model");
    bytes[3000] ^= 4;
    fs::write(&model, bytes).expect("writable");
    let all = |flag: &str| zoo(["eval", flag, "--episodes", "1", "--max-steps", "2", "--zoo", text(&entries)]);
    let newest = said(&mut all("--all"));
    assert!(newest.contains("lift-act@3 on") && !newest.contains("lift-act@1 on"), "{newest}");
    let output = all("--all-versions").output().expect("it runs");
    let (out, error) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(out.contains("lift-act@1 on") && out.contains("lift-act@3 on") && !out.contains("lift-act@2"), "{out}");
    assert!(error.contains("error: entry lift-act@2") && error.contains("model.safetensors"), "{error}");
}

#[test]
fn another_way_to_act_is_another_evaluation() {
    let (_folder, entries) = copied_zoo();
    succeeds(&mut eval(&entries, "1", &[]));
    succeeds(&mut eval(&entries, "1", &["--temporal-ensemble", "0.01"]));
    assert_eq!(listing(&entries.join("results")).len(), 2);
    refused(
        &mut eval(&entries, "1", &["--n-action-steps", "17"]),
        &["--n-action-steps", "1 to the action horizon, 16", "17"],
    );
    refused(&mut eval(&entries, "1", &["--temporal-ensemble", "nan"]), &["--temporal-ensemble", "finite", "NaN"]);
    let mut robots = zoo(["eval", "lift-act@1", "--protocol", "lift-v1", "--robots", "UR5e", "--zoo", text(&entries)]);
    refused(&mut robots, &["--protocol", "--robots", "cannot be used with"]);
}

/// Say of a file that robosuite 1.4.1 recorded it.
fn of_another_generation(file: &Path) {
    of_other_arguments(file, |env_args| env_args.replace("\"1.5.2\"", "\"1.4.1\""));
}

/// Change what a file says of the environment that it was recorded in.
fn of_other_arguments(file: &Path, change: impl Fn(&str) -> String) {
    let file = hdf5::File::open_rw(file).expect("the copy opens");
    let attribute = file.group("data").and_then(|group| group.attr("env_args")).expect("env_args");
    let stored: hdf5::types::VarLenUnicode = attribute.read_scalar().expect("text");
    let changed = change(stored.as_str());
    assert_ne!(changed, stored.as_str());
    let changed: hdf5::types::VarLenUnicode = changed.parse().expect("text");
    attribute.write_scalar(&changed).expect("writable");
    // what is written reaches the file when the last handle is gone, at the end of this function
}

#[test]
fn demonstrations_of_another_simulator_generation_are_refused_unless_forced() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (file, entries) = (folder.path().join("old.hdf5"), folder.path().join("zoo"));
    fs::copy(lift(), &file).expect("the shipped demonstrations");
    of_another_generation(&file);
    train_lift(&file, &entries, &folder.path().join("runs"));
    refused(&mut eval(&entries, "1", &[]), &["lift-act@1", "1.4.1", "1.5.2", "--force"]);
    assert!(!entries.join("results").exists());
    succeeds(&mut eval(&entries, "1", &["--force"]));
}

#[test]
fn a_module_that_a_file_names_runs_only_if_the_user_names_it() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (file, entries) = (folder.path().join("theirs.hdf5"), folder.path().join("zoo"));
    fs::copy(lift(), &file).expect("the shipped demonstrations");
    let module = format!("{{\"env_module\": {{\"name\": \"theirs\", \"sha256\": \"{}\"}}, ", "0".repeat(64));
    of_other_arguments(&file, |env_args| env_args.replacen('{', &module, 1));
    // Python finds it in the folder that the commands are run in
    fs::write(folder.path().join("theirs.py"), "import pathlib\npathlib.Path('ran').touch()\n").expect("writable");
    let ran = folder.path().join("ran");
    let film = folder.path().join("film.mp4");
    let mut replay = data(["replay", text(&file), "--demo", "0", "--video", text(&film)]);
    refused(replay.current_dir(folder.path()), &["task Lift", "\"theirs\"", "--env-module"]);
    train_lift(&file, &entries, &folder.path().join("runs"));
    let mut asked = eval(&entries, "1", &[]);
    refused(asked.current_dir(folder.path()), &["entry lift-act@1", "\"theirs\"", "--env-module"]);
    assert!(!ran.exists());
    succeeds(eval(&entries, "1", &["--env-module", "theirs"]).current_dir(folder.path()));
    assert!(ran.exists());
}

/// What a page says between `before` and `after`, again and again.
fn between<'a>(page: &'a str, before: &str, after: &str) -> Vec<&'a str> {
    page.split(before).skip(1).filter_map(|rest| rest.split(after).next()).collect()
}

#[test]
fn a_page_shows_the_film_of_a_failure_and_its_commands_are_taken() {
    let (folder, entries) = copied_zoo();
    // of two results that differ in how chunks are executed, one is filmed
    let results = folder.path().join("kept apart");
    let kept = ["--results", text(&results)];
    succeeds(&mut eval(&entries, "3", &[&kept[..], &["--n-action-steps", "2"]].concat()));
    succeeds(&mut eval(&entries, "3", &[&kept[..], &["--video", "2", "--video-size", "32"]].concat()));
    let board = |out: &Path| {
        succeeds(&mut zoo(["leaderboard", "--zoo", text(&entries), kept[0], kept[1], "--out", text(out)]));
        fs::read_to_string(out.join("report.html")).expect("a page")
    };
    let page = board(&folder.path().join("out"));
    let films = between(&page, "<video controls preload=\"none\" aria-label=\"", "\"");
    let expected = [10_000, 10_001].map(|seed| format!("lift-act@1, seed {seed}: failure after 6 steps"));
    assert_eq!(films, expected, "each once: in the row that was filmed");
    let mp4 = between(&page, "src=\"data:video/mp4;base64,", "\"");
    assert!(mp4.len() == 2 && mp4.iter().all(|film| film.starts_with("AAAA") && film.len() > 1000), "{}", mp4.len());

    let mut commands: Vec<String> = between(&page, "<code class=\"command\">", "</code>")
        .into_iter()
        .map(|line| line.replace("&#39;", "'"))
        .collect();
    commands.sort();
    commands.dedup();
    // of each result: its episodes, all of it, its first failure; and the second film
    assert_eq!(commands.len(), 7, "{commands:#?}");
    let program = zoo([]).get_program().to_owned();
    let run = |line: &str| {
        let mut shell = Command::new("sh");
        let words = line.strip_prefix("actrm-zoo ").expect("our program");
        // two steps of training and short episodes: what is asked here is whether the line is taken
        let quick = if words.starts_with("rerun") { " --skip-training" } else { "" };
        // what rerun leaves behind lies below the folder that it is run in
        shell.current_dir(folder.path());
        said(shell.args(["-c", &format!("exec \"$0\" {words}{quick}")]).arg(&program))
    };
    // one of each kind is run, and all of the result that has a flag of its own
    let reruns = commands.iter().filter(|line| line.contains(" rerun ")).take(1);
    let own = ["--n-action-steps 2", "--seed-start 10001"];
    let others = commands.iter().filter(|line| own.iter().any(|flag| line.contains(flag)));
    let chosen: Vec<&String> = reruns.chain(others).collect();
    assert_eq!(chosen.len(), 4, "{commands:#?}");
    for line in chosen {
        let told = run(line);
        let word = if line.contains(" rerun ") { "is the same" } else { "every outcome the same" };
        assert!(told.contains(word), "{line}: {told}");
        assert_eq!(told.contains(".mp4"), line.contains(" --video 1"), "{line}: {told}");
    }
    assert_eq!(listing(&results).len(), 2, "no command leaves another result");
    // now the other result has a film of its first failure as well
    let page = board(&folder.path().join("out"));
    assert_eq!(between(&page, "<video controls", "</video>").len(), 3);
    // one from before films said of what result they are belongs to no row where it may be of two
    let videos = entries.join("videos/lift-act@1");
    let film = listing(&videos).into_iter().find(|name| name.contains("-10001-")).expect("a film");
    fs::rename(videos.join(film), videos.join("Lift-10001-failure.mp4")).expect("renamed");
    let page = board(&folder.path().join("out"));
    assert_eq!(between(&page, "<video controls", "</video>").len(), 2);
}

#[test]
fn episodes_and_demonstrations_become_videos() {
    let (folder, entries) = copied_zoo();
    let is_video = |path: &Path| {
        let bytes = fs::read(path).expect("a video");
        bytes.len() > 1000 && &bytes[4..8] == b"ftyp"
    };
    let printed = said(&mut eval(&entries, "2", &["--video", "1", "--video-size", "64"]));
    let videos = entries.join("videos/lift-act@1");
    let films = listing(&videos);
    assert!(films.len() == 1 && films[0].starts_with("Lift-10000-failure-"), "{printed}: {films:?}");
    assert!(printed.contains(&films[0]) && is_video(&videos.join(&films[0])), "{printed}");
    // of a part of the episodes, its own first
    let part = said(&mut eval(&entries, "2", &["--shard", "2/2", "--video", "1", "--video-size", "64"]));
    assert!(part.contains("Lift-10001-") && !part.contains("Lift-10000-"), "{part}");
    refused(&mut eval(&entries, "1", &["--video", "1", "--video-size", "65"]), &["--video-size", "an even number"]);

    // of a robomimic file, and of the data set that was converted from it: the same images
    let set = trained().join("lift");
    let mut made = Vec::new();
    for (name, input, demo) in [("file.mp4", &lift(), "3"), ("set.mp4", &set, "demo_3")] {
        let path = folder.path().join(name);
        let arguments =
            ["replay", text(input), "--demo", demo, "--video", text(&path), "--size", "64", "--workers", "1"];
        let printed = said(&mut data(arguments));
        assert!(printed.contains("Lift demo_3") && printed.contains("images at 20 Hz, success"), "{printed}");
        assert!(is_video(&path));
        made.push(fs::read(path).expect("a video"));
    }
    assert!(made[0] == made[1], "the videos differ");

    let at = |name: &str| folder.path().join(name);
    let replay = |demo: &str, name: &str| {
        data(["replay", text(&lift()), "--demo", demo, "--video", text(&at(name)), "--size", "64"])
    };
    refused(&mut replay("50", "none.mp4"), &["no demo \"50\"", "demo_0"]);
    refused(&mut replay("3", "file.mp4"), &["file.mp4", "exists"]);
    // a machine that can draw but is told not to
    refused(replay("3", "none.mp4").env("MUJOCO_GL", "glx"), &["egl or osmesa"]);
    refused(eval(&entries, "1", &["--video", "1"]).env("MUJOCO_GL", "glx"), &["egl or osmesa"]);
    assert!(!at("none.mp4").exists());
}

/// A copy of robosuite under `folder`, made of links but for `lift.py`, whose cube has to be lifted by 1 m.
fn shadow_of_robosuite(folder: &Path) {
    let python = std::env::var("ACTRM_PYTHON").unwrap_or_else(|_| {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../.venv/bin/python").to_str().expect("text").to_owned()
    });
    let script = "import importlib.util as u; print(u.find_spec('robosuite').submodule_search_locations[0])";
    let package = said(Command::new(python).args(["-c", script]));
    let (mut from, mut to) = (PathBuf::from(package.trim()), folder.join("robosuite"));
    for inside in ["environments", "manipulation", "lift.py"] {
        fs::create_dir(&to).expect("a folder");
        for entry in fs::read_dir(&from).expect("a package").flatten() {
            let name = entry.file_name();
            if name != inside && name != "__pycache__" {
                std::os::unix::fs::symlink(entry.path(), to.join(name)).expect("a link");
            }
        }
        (from, to) = (from.join(inside), to.join(inside));
    }
    let source = fs::read_to_string(from).expect("robosuite's lift.py");
    let changed = source.replace("cube_height > table_height + 0.04", "cube_height > table_height + 1.0");
    assert_ne!(source, changed, "robosuite says otherwise what success is");
    fs::write(to, changed).expect("a file");
}

/// The same version under another success: its episodes join none of the installed simulator's, and say whose they are.
#[test]
fn another_simulator_of_the_same_version_is_kept_apart() {
    let (folder, entries) = copied_zoo();
    shadow_of_robosuite(folder.path());
    let results = entries.join("told");
    let command = |shadow: bool, episodes: &str| {
        let mut command = eval(&entries, episodes, &["--workers", "1", "--results", text(&results)]);
        if shadow {
            command.env("PYTHONPATH", folder.path());
        }
        command
    };
    said(&mut command(false, "3"));
    // not shown as the answer, and nothing of it taken over
    let output = succeeds(&mut command(true, "3"));
    let (out, error) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(!out.contains("evaluated before"), "{out}");
    assert!(error.contains("3 episodes of another simulator (robosuite: there sources"), "{error}");
    said(&mut command(true, "4"));
    let sources = |name: &String| {
        let record = fs::read(results.join(name).join("evaluation.json")).expect("a record");
        let record: serde_json::Value = serde_json::from_slice(&record).expect("JSON");
        assert_eq!(record["versions"]["robosuite"], "1.5.2");
        record["sources"]["robosuite"].as_str().expect("a sum").to_owned()
    };
    let sums: Vec<String> = listing(&results).iter().map(sources).collect();
    let kinds: std::collections::BTreeSet<&String> = sums.iter().collect();
    assert_eq!((sums.len(), kinds.len()), (3, 2), "{sums:?}");
    // each is shown again to its own simulator
    for shadow in [false, true] {
        let again = said(&mut command(shadow, "3"));
        assert!(again.contains("evaluated before"), "{again}");
    }
    assert_eq!(listing(&results).len(), 3);
    let table = said(&mut zoo(["leaderboard", "--json", "--zoo", text(&entries), "--results", text(&results)]));
    assert!(table.contains("(sources "), "{table}");
}
