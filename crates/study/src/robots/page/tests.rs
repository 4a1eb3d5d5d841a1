//! The pages of made-up studies.
#![allow(clippy::unwrap_used)]
use super::super::cells::Cell;
use super::*;
use analysis::probe::{ProbeCell, ProbeResult, Reading};

const STUDY: &str = r#"
        title = "T"
        results = "RESULTS"
        page = "RESULTS/page.md"
        [data.chain]
        task = "PickChain"
        episodes = 200
        [arms.one]
        experiment = "actrm_pickchain"
        label = "one step"
        [arms.six]
        experiment = "actrm_pickchain"
        label = "six steps"
        set = ["policy.reasoning.supervision_steps=6"]
        [tests.t]
        task = "PickChain"
        episodes = 4
        seed_start = 40000
        [tests.t-32]
        task = "PickChain"
        episodes = 4
        seed_start = 40000
        thinking = { steps = 32 }
        [tests.t-halting]
        task = "PickChain"
        episodes = 4
        seed_start = 40000
        thinking = { halting = true, change_threshold = 0.01 }
        [[cells]]
        arms = ["one", "six"]
        data = "chain"
        seeds = 2
        tests = ["t"]
        [[cells]]
        arms = ["six"]
        data = "chain"
        seeds = 2
        tests = ["t-halting", "t-32"]
        stage = 2
        [[comparisons]]
        question = "Do they help?"
        first = "six"
        second = "one"
        data = "chain"
        test = "t"
        [[comparisons]]
        question = "Do they help at length?"
        first = "six"
        second = "one"
        data = "chain"
        test = "t"
        groups = ["4 hops"]
        stage = 2
    "#;

/// A result of `cell` in which these episodes are solved.
fn result(study: &Study, cell: &Cell, test: &str, solved: [bool; 4]) -> CellResult {
    let seeds = study.tests[test].seed_start;
    let episode = |(i, success): (usize, &bool)| {
        let failure = (!success).then_some("wrong");
        serde_json::json!({"seed": seeds + i as u64, "success": success, "steps": 60, "group": format!("{} hops", 3 + i % 2), "failure": failure})
    };
    serde_json::from_value(serde_json::json!({
        "format": 1, "arm": cell.arm, "arm_definition": study.arms[&cell.arm], "data": cell.data,
        "data_definition": study.data[&cell.data], "test": test, "test_definition": study.tests[test],
        "seed": cell.seed, "settings": "0123456789", "entry": {"name": "e", "version": 1, "hash": "h"},
        "training": {
            "policy": "actrm", "parameters": 340_000, "steps": 6000, "minutes": 3.0, "seed": cell.seed,
            "data_set": "d", "data_fingerprint": "f", "data_simulator": "1.5.1", "demos": 180,
        },
        "protocol": {
            "rules": 1, "task": "PickChain", "env_name": "PickChain", "env_module": null,
            "env_module_sha256": null, "env_args_sha256": null, "control": "compiled", "max_steps": 200,
        },
        "seeds": {"start": seeds, "count": 4}, "versions": {}, "query_ms": 1.25, "query_flops": 42.4e6,
        "episodes": solved.iter().enumerate().map(episode).collect::<Vec<_>>(),
    }))
    .unwrap()
}

#[test]
fn a_result_of_another_recipe_or_of_a_part_is_not_shown() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("study.toml");
    let text = STUDY.replace("RESULTS", &folder.path().display().to_string());
    std::fs::write(&file, &text).unwrap();
    let study = Study::open(&file).unwrap();
    let of_one: Vec<Cell> = cells(&study).into_iter().filter(|cell| cell.arm == "one").collect();
    let path = |cell: &Cell| folder.path().join(cell.file_name("t"));
    for cell in &of_one {
        result(&study, cell, "t", [true; 4]).write(&path(cell)).unwrap();
    }
    let page = |text: &str| {
        std::fs::write(&file, text).unwrap();
        robot_page(&Study::open(&file).unwrap(), &file)
    };
    assert!(page(&text).unwrap().contains("| one step | 100.0%"));
    assert!(page(&text.replace("\"one step\"", "\"1 step\"")).unwrap().contains("| 1 step | 100.0%"));
    let other = text.replace("label = \"one step\"", "label = \"one step\"\n        set = [\"train.steps=9\"]");
    assert!(!page(&other).unwrap().contains("one step"));
    let whole = result(&study, &of_one[1], "t", [true; 4]);
    let mut part = whole.clone();
    part.episodes.pop();
    let mut other_seed = whole.clone();
    other_seed.training.seed = 1;
    let mut too_far = whole.clone();
    too_far.episodes[2].progress = Some(7.0);
    for (wrong, words) in [(part, "episodes: "), (other_seed, "training.seed: "), (too_far, "episode 40002: ")] {
        wrong.write(&path(&of_one[1])).unwrap();
        let error = page(&text).unwrap_err().to_string();
        assert!(error.contains(&of_one[1].file_name("t")) && error.contains(words), "{error}");
    }
    let of_weights = |cell: &Cell| CellResult { weights: Some("w".to_owned()), ..result(&study, cell, "t", [true; 4]) };
    of_one.iter().for_each(|cell| of_weights(cell).write(&path(cell)).unwrap());
    assert!(page(&text).unwrap_err().to_string().contains("weights: those of seed 1"));
}

#[test]
fn arms_of_several_tasks_stand_in_one_table() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("study.toml");
    let text = STUDY.replace("RESULTS", &folder.path().display().to_string()).replace(
        "experiment = \"actrm_pickchain\"\n        label = \"one",
        "experiment = \"act_{data}\"\n        label = \"one",
    ) + "[data.lift]\ntask = \"Lift\"\nepisodes = 200\n[tests.lift]\ntask = \"Lift\"\nepisodes = 4\nseed_start = 40000\n\
           [[cells]]\narms = [\"one\"]\ndata = \"lift\"\nfirst_seed = 2\nseeds = 4\ntests = [\"lift\"]\n";
    std::fs::write(&file, text).unwrap();
    // a changed definition makes other results of them
    let ran = || {
        let study = Study::open(&file).unwrap();
        for cell in cells(&study).iter().filter(|cell| cell.arm == "one" && cell.seed < 4) {
            for test in &cell.tests {
                result(&study, cell, test, [true; 4]).write(&folder.path().join(cell.file_name(test))).unwrap();
            }
        }
        study
    };
    let page = robot_page(&ran(), &file).unwrap();
    for there in [
        "| | PickChain | Lift |\n|---|---|---|\n| one step | 100.0% [",
        "], 2 of 3 |\n\n",
        "| one step | `act_chain` |  | 340000 |",
        "| one step | `act_lift` |  | 340000 |",
        "<summary>PickChain: 200 demonstrations of PickChain; seeds 40000 to 40003</summary>",
    ] {
        assert!(page.contains(there), "{there}\n---\n{page}");
    }
    assert!(!page.contains("six steps"), "what was not run is no part of the page: {page}");
    // of one task, how many demonstrations tell columns apart
    let fewer = std::fs::read_to_string(&file)
        .unwrap()
        .replace("task = \"Lift\"\nepisodes = 200", "task = \"PickChain\"\nepisodes = 25");
    std::fs::write(&file, fewer).unwrap();
    let page = robot_page(&Study::open(&file).unwrap(), &file).unwrap();
    assert!(
        !page.contains("PickChain, 25") && !page.contains(" 25 demonstrations"),
        "results of other demonstrations: {page}"
    );
    let page = robot_page(&ran(), &file).unwrap();
    assert!(page.contains("| | PickChain, 200 | PickChain, 25 |\n"), "{page}");
    // and who showed them
    let others =
        std::fs::read_to_string(&file).unwrap().replace("episodes = 25", "episodes = 25\nexpert = \"careful\"");
    std::fs::write(&file, others).unwrap();
    let page = robot_page(&ran(), &file).unwrap();
    assert!(page.contains("| | PickChain, 200 | PickChain, 25, careful |\n"), "{page}");
    assert!(!page.contains("Do they help"), "one of its sides has no result: {page}");
    let shown = std::fs::read_to_string(&file).unwrap().replace("expert = \"careful\"", "skill = \"mixed\"");
    std::fs::write(&file, &shown).unwrap();
    let study = ran();
    let page = robot_page(&study, &file).unwrap();
    assert!(page.contains("| | PickChain, 200 | PickChain, 25, mixed |\n"), "{page}");
    assert_eq!(study.data["lift"].file_name(), "pickchain-mixed-25-seed1.hdf5");
    std::fs::write(&file, shown.replace("\"mixed\"", "\"careless\"")).unwrap();
    let error = format!("{:?}", Study::open(&file).unwrap_err());
    assert!(error.contains("careless"), "{error}");
    std::fs::write(&file, shown).unwrap();
}

#[test]
fn demonstrations_of_one_kind_are_told_apart_and_arms_of_one_label_share_a_row() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("study.toml");
    let text = STUDY.replace("RESULTS", &folder.path().display().to_string())
        + "[data.chain-new]\ntask = \"PickChain\"\nepisodes = 200\nseed = 2\n[arms.new]\n\
           experiment = \"actrm_pickchain\"\nlabel = \"one step\"\n[[cells]]\narms = [\"new\", \"six\"]\n\
           data = \"chain-new\"\nseeds = 2\ntests = [\"t\", \"t-32\"]\n";
    std::fs::write(&file, &text).unwrap();
    let run = || {
        let study = Study::open(&file).unwrap();
        for cell in &cells(&study) {
            for test in &cell.tests {
                result(&study, cell, test, [true; 4]).write(&folder.path().join(cell.file_name(test))).unwrap();
            }
        }
        study
    };
    let study = run();
    let page = robot_page(&study, &file).unwrap();
    for there in [
        "| | PickChain, 200 | PickChain, 200, collection seed 2 |\n|---|---|---|\n| one step | 100.0% [",
        "<summary>PickChain: 200 demonstrations of PickChain; seeds",
        "<summary>PickChain: 200 demonstrations of PickChain, collection seed 2; seeds",
        "<summary>PickChain after 200 demonstrations</summary>",
        "<summary>PickChain after 200 demonstrations, collection seed 2</summary>",
    ] {
        assert!(page.contains(there), "{there}\n---\n{page}");
    }
    let overview = page.split("## Trainings").next().unwrap();
    assert_eq!(overview.matches("\n| one step |").count(), 1, "{page}");
    let chart = &robot_charts(&study).unwrap()[0].1;
    for there in [">PickChain (200 demonstrations)</text>", ">PickChain (200 demonstrations, collection seed 2)</text>"]
    {
        assert!(chart.contains(there), "{there}\n---\n{chart}");
    }
    // of the same seed as well, they go by their names
    std::fs::write(&file, text.replace("episodes = 200\nseed = 2", "episodes = 200")).unwrap();
    let page = robot_page(&run(), &file).unwrap();
    assert!(page.contains("| | PickChain, 200, chain | PickChain, 200, chain-new |\n"), "{page}");
    // with images they say so
    let cameras = "cameras = { names = [\"agentview\"], size = 84, fast_render = true }";
    std::fs::write(&file, text.replace("seed = 2", cameras)).unwrap();
    let page = robot_page(&run(), &file).unwrap();
    assert!(page.contains("| | PickChain, 200 | PickChain, 200, images |\n"), "{page}");
    // both arms of the label have a result there
    std::fs::write(&file, text.replace("[\"one\", \"six\"]", "[\"one\", \"new\", \"six\"]")).unwrap();
    let page = robot_page(&run(), &file).unwrap();
    let overview = page.split("## Trainings").next().unwrap();
    assert_eq!(overview.matches("\n| one step |").count(), 2, "{page}");
}

#[test]
fn a_comparison_of_groups_that_no_episode_has_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("study.toml");
    let text = STUDY.replace("RESULTS", &folder.path().display().to_string());
    std::fs::write(&file, text.replace("[\"4 hops\"]", "[\"3 hop\", \"4 hops\"]")).unwrap();
    let study = Study::open(&file).unwrap();
    robot_page(&study, &file).unwrap();
    let cell = &cells(&study)[0];
    result(&study, cell, "t", [true; 4]).write(&folder.path().join(cell.file_name("t"))).unwrap();
    assert_eq!(
        robot_page(&study, &file).unwrap_err().to_string(),
        "key `comparisons[1].groups`: expected some of 3 hops, 4 hops, found 3 hop"
    );
}

#[test]
fn tests_of_two_trainings_are_named_where_their_weights_may_differ() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("study.toml");
    std::fs::write(&file, STUDY.replace("RESULTS", &folder.path().display().to_string())).unwrap();
    let study = Study::open(&file).unwrap();
    let six: Vec<Cell> = cells(&study).into_iter().filter(|cell| cell.arm == "six" && cell.seed == 1).collect();
    let (first, later) = (&six[0], six.last().unwrap());
    let page = |hash: &str, weights: Option<&str>| {
        for (cell, test, hash) in [(first, "t", "h"), (later, "t-32", hash)] {
            let mut one = result(&study, cell, test, [true; 4]);
            one.entry.hash = hash.to_owned();
            one.weights = weights.map(str::to_owned);
            one.write(&folder.path().join(cell.file_name(test))).unwrap();
        }
        robot_page(&study, &file).unwrap()
    };
    assert!(!page("h", None).contains("Trained twice"));
    assert!(!page("other", Some("w")).contains("Trained twice"));
    let page = page("other", None);
    assert!(page.contains("<summary>Trained twice</summary>"), "{page}");
    assert!(page.contains("- six on chain, seed 1: t; t-32\n") || page.contains("seed 1: t-32; t\n"), "{page}");
}

#[test]
fn one_training_on_a_side_is_too_few() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("study.toml");
    std::fs::write(&file, STUDY.replace("RESULTS", &folder.path().display().to_string())).unwrap();
    let study = Study::open(&file).unwrap();
    let row = "| Do they help? | six steps | one step | all |";
    assert!(!robot_page(&study, &file).unwrap().contains("Do they help"));
    for cell in cells(&study).iter().filter(|cell| cell.stage == 1 && cell.seed == 1) {
        let result = result(&study, cell, "t", [true, cell.arm == "six", true, true]);
        result.write(&folder.path().join(cell.file_name("t"))).unwrap();
    }
    let page = robot_page(&study, &file).unwrap();
    assert!(page.contains(&format!("{row} 1, 1 | - | - | too few trainings |")), "{page}");
}

#[test]
fn progress_stands_where_every_episode_has_it() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("study.toml");
    std::fs::write(&file, STUDY.replace("RESULTS", &folder.path().display().to_string())).unwrap();
    let study = Study::open(&file).unwrap();
    let write = |ways: [Option<f64>; 4]| {
        for cell in cells(&study).iter().filter(|cell| cell.stage == 1) {
            let mut result = result(&study, cell, "t", [true, true, false, false]);
            for (episode, way) in result.episodes.iter_mut().zip(ways).filter(|_| cell.arm == "six") {
                episode.progress = way;
            }
            result.write(&folder.path().join(cell.file_name("t"))).unwrap();
        }
        robot_page(&study, &file).unwrap()
    };
    let page = write([Some(1.0), Some(1.0), Some(0.25), Some(0.75)]);
    assert!(page.contains("| arm | all | 3 hops | 4 hops | progress | wrong |\n|---|---|---|---|---|---|\n"), "{page}");
    assert!(page.contains(" | 0.750 | 50.0% |\n") && page.contains(" | - | 50.0% |\n"), "{page}");
    assert!(page.contains("Progress: "), "{page}");
    // of some episodes it would be another mean
    let page = write([Some(1.0), None, Some(0.25), Some(0.75)]);
    assert!(!page.to_lowercase().contains("progress"), "{page}");
}

#[test]
fn charts_are_drawn_where_there_are_groups_enough_and_shown_where_they_lie() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("study.toml");
    std::fs::write(&file, STUDY.replace("RESULTS", &folder.path().display().to_string()).replace("4 hops", "0 hops"))
        .unwrap();
    let study = Study::open(&file).unwrap();
    let write = |groups: usize| {
        for cell in cells(&study).iter().filter(|cell| cell.stage == 1) {
            let mut result = result(&study, cell, "t", [true, cell.arm == "six", true, false]);
            for (i, episode) in result.episodes.iter_mut().enumerate() {
                episode.group = Some(format!("{} hops", i.min(groups - 1)));
            }
            result.write(&folder.path().join(cell.file_name("t"))).unwrap();
        }
        (robot_charts(&study).unwrap(), robot_page(&study, &file).unwrap())
    };
    let (charts, page) = write(3);
    assert_eq!(charts.len(), 1, "success of every arm");
    assert!(
        charts[0].1.contains(">PickChain (200 demonstrations)</text>") && charts[0].1.contains(">six steps</text>")
    );
    let verdict = "- Do they help? **not significant**: 75.0% (six steps) against 50.0% (one step), +25.0 points [";
    let begins = page.split("![").next().unwrap();
    assert!(begins.starts_with(&format!("# T\n\n{verdict}")), "the verdict, then the chart: {page}");
    let (charts, page) = write(4);
    let [_, (path, drawing)] = charts.as_slice() else { panic!("{} charts", charts.len()) };
    assert_eq!(path, &folder.path().join("t_chain_by-arm.svg"));
    assert!(page.contains("t_chain_by-arm.svg)\n"), "{page}");
    assert!(drawing.contains(">six steps (2)</text>") && drawing.contains(">one step (2)</text>"), "{drawing}");
}

#[test]
fn what_changed_pictures_cost_stands_beside_what_is_drawn_and_nowhere_else() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("study.toml");
    let dark = "[tests.t-dark]\ntask = \"PickChain\"\nepisodes = 4\nseed_start = 40000\nperturb = \"black-agentview\"\n\
                [[cells]]\narms = [\"one\", \"six\"]\ndata = \"chain\"\nseeds = 1\ntests = [\"t-dark\"]\nstage = 2\n\
                [tests.t-later]\ntask = \"PickChain\"\nepisodes = 4\nseed_start = 50000\nperturb = \"black-agentview\"\n\
                [[cells]]\narms = [\"one\"]\ndata = \"chain\"\nseeds = 1\ntests = [\"t-later\"]\nstage = 3\n";
    let seen = "[data.chain]\ncameras = { names = [\"agentview\"], size = 84, fast_render = true }";
    let text = STUDY.replace("RESULTS", &folder.path().display().to_string()).replace("[data.chain]", seen) + dark;
    std::fs::write(&file, text).unwrap();
    let study = Study::open(&file).unwrap();
    let page = || robot_page(&study, &file).unwrap();
    assert!(!page().contains("## Changed images"), "{}", page());
    for cell in cells(&study).iter().filter(|cell| cell.seed == 1) {
        for test in cell.tests.iter().filter(|test| !["t-32", "t-halting"].contains(&test.as_str())) {
            let solved = [true, test == "t", test == "t", cell.arm == "six" || test == "t"];
            result(&study, cell, test, solved).write(&folder.path().join(cell.file_name(test))).unwrap();
        }
    }
    let page = page();
    let row = |arm: &str| {
        let begins = format!("| {arm} | 100.0% [");
        let rows: Vec<&str> = page.lines().filter(|line| line.starts_with(&begins)).collect();
        rows.last().copied().unwrap_or_default().to_owned()
    };
    assert!(page.contains("| PickChain | unchanged | black-agentview |\n|---|---|---|\n"), "{page}");
    // two tests of one change: both are shown, each by its name
    assert!(
        row("one step").contains("<br>4 of 4 | t-dark: 25.0% [") && row("one step").ends_with("<br>1 of 4 |"),
        "{page}"
    );
    assert!(row("one step").contains("<br>1 of 4<br>t-later: 25.0% ["), "{page}");
    assert!(row("six steps").ends_with("<br>2 of 4 |"), "{page}");
    assert!(!page.contains("<summary>PickChain after 200 demonstrations</summary>"), "{page}");
}

#[test]
fn stages_thoughts_and_probes_have_places_of_their_own() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("study.toml");
    std::fs::write(&file, STUDY.replace("RESULTS", &folder.path().display().to_string())).unwrap();
    let study = Study::open(&file).unwrap();
    for cell in cells(&study).iter().filter(|cell| cell.seed == 1 || cell.stage == 1) {
        for test in &cell.tests {
            let result = result(&study, cell, test, [cell.arm == "six", true, test == "t-32", true]);
            result.write(&folder.path().join(cell.file_name(test))).unwrap();
        }
    }
    let page = || robot_page(&study, &file).unwrap();
    assert!(!page().contains("probe decodes"));
    let cell = |step, hops, right| ProbeCell { step, hops, right, of: 10, right_beyond: 1, of_beyond: 4 };
    let six = result(&study, &cells(&study)[1], "t", [true; 4]);
    let cells = vec![cell(1, Some(0), 9), cell(1, None, 3), cell(2, Some(0), 10), cell(2, None, 8)];
    let readings = vec![Reading { state: "reasoning".into(), cells }];
    let (entry, training, seeds) = (six.entry, six.training, six.seeds);
    let probe = ProbeResult { format: 1, entry, training, demonstrations: 180, renamings: 16, seeds, readings };
    probe.write(&folder.path().join("probe_six.json")).unwrap();
    let page = page();
    for there in [
        "| arm | all | 3 hops | 4 hops | wrong |",
        "| one step | 50.0%",
        "<summary>Planned comparisons</summary>",
        "| Do they help? | six steps | one step | all | 2, 2 |",
        "<summary>Comparisons that were added later</summary>",
        "| Do they help at length? |",
        "## Other refinement settings\n",
        "| six steps | 32 steps | 100.0%",
        "| 1.25 | 42.4 |",
        "| six steps | early stopping, chunk change below 0.01 | 75.0%",
        "| 1.25 | at most 42.4 |",
        "| reasoning, after step | 0 hops | the end |\n|---|---|---|\n| 1 | 90% (25%) | 30% (25%) |",
    ] {
        assert!(page.contains(there), "{there}\n---\n{page}");
    }
    // what is done to trained weights is no cost of an arm
    assert_eq!(page.matches("| six steps | `actrm_pickchain`").count(), 1);
    assert!(!page.contains("seed2"), "{page}");
}
