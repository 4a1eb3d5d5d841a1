//! What the rooms may do, read from their sources: who opens files, starts processes, prints, and which parts of a
//! crate know which others. And that the documents name no path that is not there.

use std::fs;
use std::path::{Path, PathBuf};

use e2e::options::options_page;
use e2e::reference::assert_current;
use e2e::results::results_page;
use e2e::{succeeds, text, zoo};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").canonicalize().expect("the repository is there")
}

/// Every file below `folder` with this ending, sorted.
fn files(folder: &Path, ending: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let entries = fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
    for path in entries.map(|entry| entry.expect("a folder can be read").path()) {
        if path.is_dir() {
            found.extend(files(&path, ending));
        } else if path.extension().is_some_and(|e| e == ending) {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// Lines of the library's own code below `folder`: without comments, tests and test modules.
fn code(folder: &str) -> Vec<(String, usize, String)> {
    let root = root();
    let mut lines = Vec::new();
    for path in files(&root.join(folder), "rs") {
        let shown = path.strip_prefix(&root).expect("below the root").display().to_string();
        let name = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
        if name == "tests" || name.ends_with("_tests") || name == "testing" || shown.contains("/tests/") {
            continue;
        }
        let text = fs::read_to_string(&path).expect("sources are text");
        // tests stand at the end of a file
        let own = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
        for (number, line) in own.lines().enumerate() {
            let line = line.split("//").next().unwrap_or_default();
            lines.push((shown.clone(), number + 1, line.to_owned()));
        }
    }
    assert!(lines.len() > 100, "{folder}: no sources found");
    lines
}

/// What is wrong: each place below `folder`, `but` these files left out, that says one of `words`.
fn said(folder: &str, words: &[&str], but: &[&str]) -> Vec<String> {
    let elsewhere = |(path, _, _): &&(String, usize, String)| !but.iter().any(|file| path.starts_with(file));
    let place = |(path, number, line): &(String, usize, String)| {
        let word = words.iter().find(|word| line.contains(**word))?;
        Some(format!("{path}:{number} says `{word}`"))
    };
    code(folder).iter().filter(elsewhere).filter_map(place).collect()
}

const FILES: &[&str] = &["std::fs", "File::open", "File::create", "OpenOptions", "tempfile"];
const PROCESSES: &[&str] = &["std::process", "Command::new"];
const PRINTING: &[&str] = &["println!", "eprintln!", "print!(", "eprint!(", "stdout()", "stderr()"];

#[test]
fn models_knows_tensors_and_numbers_only() {
    let words: Vec<&str> = [FILES, PROCESSES, PRINTING, &["std::env", "std::net"]].concat();
    assert_eq!(said("crates/nn/src", &words, &[]), [""; 0]);
    assert_eq!(said("crates/models/src", &words, &[]), [""; 0]);
    assert_eq!(said("crates/solvers/src", &words, &[]), [""; 0]);
    assert_eq!(said("crates/puzzles/src", &words, &[]), [""; 0]);
    // a message of a stranger opens no file
    assert_eq!(said("crates/serving/src", FILES, &[]), [""; 0]);
}

#[test]
fn a_report_is_a_function_of_results() {
    let words: Vec<&str> = [FILES, PROCESSES, PRINTING, &["std::env", "std::net", "SystemTime"]].concat();
    assert_eq!(said("crates/report/src", &words, &[]), [""; 0]);
}

#[test]
fn only_rollout_starts_processes_and_the_data_set_its_own_reader_and_ffmpeg() {
    let reader = ["crates/dataset/src/source/isolation.rs", "crates/dataset/src/ffmpeg.rs"];
    for room in [
        "analysis",
        "audit",
        "dataset",
        "interchange",
        "python",
        "query",
        "recording",
        "results",
        "serving",
        "study",
        "video",
        "zoo",
    ] {
        assert_eq!(said(&format!("crates/{room}/src"), PROCESSES, &reader), [""; 0]);
    }
    assert!(!said("crates/rollout/src", PROCESSES, &[]).is_empty(), "the test finds what it looks for");
    // what asks in SQL becomes another program, in the same process
    let becomes = ["tools/actrm-data/src/commands/query.rs"];
    for tool in ["actrm-data", "actrm-zoo"] {
        assert_eq!(said(&format!("tools/{tool}/src"), &["Command::new"], &becomes), [""; 0]);
    }
}

#[test]
fn only_tools_print_and_read_arguments() {
    let rooms = [
        "analysis",
        "audit",
        "dataset",
        "interchange",
        "results",
        "query",
        "recording",
        "rollout",
        "serving",
        "video",
        "zoo",
        "report",
        "study",
        "python",
    ];
    for room in rooms {
        // both speak to the program that started them
        let reader = ["crates/dataset/src/source/isolation.rs", "crates/dataset/src/source/video.rs"];
        let words: Vec<&str> = [PRINTING, &["env::args"]].concat();
        assert_eq!(said(&format!("crates/{room}/src"), &words, &reader), [""; 0]);
    }
}

/// Parts of a crate that must not know others of it.
#[test]
fn parts_of_a_crate_know_only_what_is_below_them() {
    for (folder, above) in [
        ("crates/zoo/src/config", &["crate::run", "crate::entry", "crate::experiment", "crate::evaluation"][..]),
        ("crates/zoo/src/run", &["crate::evaluation", "crate::results", "crate::registry"]),
        ("crates/zoo/src/transforms", &["crate::run", "crate::evaluation", "crate::entry", "crate::results"]),
        ("crates/models/src/layers", &["crate::models", "crate::registry", "crate::train"]),
        ("crates/nn/src/kernels", &["crate::ops", "crate::context", "crate::tape"]),
        ("crates/rollout/src", &["models::", "candle"]),
        ("crates/results/src", &["models::", "candle"]),
    ] {
        assert_eq!(said(folder, above, &[]), [""; 0]);
    }
}

#[test]
fn puzzles_are_behind_one_door() {
    let tool = ["tools/actrm-zoo/src/puzzles.rs"];
    let words = ["SolverEntry", "PuzzleExperiment", "PuzzleTrainRequest", "is_solver"];
    assert_eq!(said("tools/actrm-zoo/src", &words, &tool), [""; 0]);
    assert_eq!(said("crates/zoo/src", &["is_policy()", "kind.is_none()"], &["crates/zoo/src/entry/kind.rs"]), [""; 0]);
    assert_eq!(said("crates/study/src", &["Kind::Robot"], &["crates/study/src/puzzle/door.rs"]), [""; 0]);
}

/// Paths in `text`, with the line they stand in: what is written as code and begins with one of `folders`, or with the
/// name of a room and `/src`.
fn paths(text: &str, folders: &[String]) -> Vec<(usize, String)> {
    let mut found = Vec::new();
    for (number, line) in text.lines().enumerate() {
        for span in line.split('`').skip(1).step_by(2) {
            let plain = span.chars().all(|c| c.is_ascii_alphanumeric() || "._-/".contains(c));
            let first = span.split('/').next().unwrap_or_default();
            if !plain || !span.contains('/') {
                continue;
            }
            if folders.iter().any(|folder| folder == first) {
                found.push((number + 1, span.to_owned()));
            } else if span.starts_with(&format!("{first}/src/")) {
                found.push((number + 1, format!("crates/{span}")));
            }
        }
    }
    found
}

#[test]
fn documents_name_paths_that_are_there() {
    let root = root();
    let entries = fs::read_dir(&root).expect("the repository can be read").flatten();
    let folders: Vec<String> = entries
        .filter(|entry| entry.path().is_dir())
        .filter_map(|entry| entry.file_name().into_string().ok())
        .filter(|name| !name.starts_with('.') && !["target", "out", "runs"].contains(&name.as_str()))
        .collect();
    let mut documents = files(&root.join("docs"), "md");
    documents.extend(["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "GLOSSARY.md"].map(|name| root.join(name)));
    let (mut missing, mut seen) = (Vec::new(), 0);
    for document in documents {
        let text = fs::read_to_string(&document).expect("documents are text");
        for (line, path) in paths(&text, &folders) {
            seen += 1;
            // the group of a demo inside an HDF5 file
            if !path.starts_with("data/demo_") && !root.join(&path).exists() {
                let document = document.strip_prefix(&root).expect("below the root").display();
                missing.push(format!("{document}:{line} names `{path}`"));
            }
        }
    }
    assert_eq!(missing, [""; 0]);
    assert!(seen > 20, "the test finds what it looks for: {seen}");
}

#[test]
fn paths_are_found_in_documents() {
    let folders = ["crates".to_owned()];
    let text = "see `crates/a/b.rs` and `zoo/src/lib.rs`,\n`name@1/x`, `crates/*/src` and `a/b`";
    assert_eq!(paths(text, &folders), [(1, "crates/a/b.rs".to_owned()), (1, "crates/zoo/src/lib.rs".to_owned())]);
}

#[test]
fn the_reference_of_options_is_current() {
    let (text, options) = options_page();
    assert!(options > 190, "{options}");
    assert_current("docs/reference/options.md", &text);
    // what experiments really have is there
    let mut seen = 0;
    for config in files(&root().join("zoo"), "toml").iter().filter(|path| path.ends_with("config.toml")) {
        let mut section = String::new();
        for line in fs::read_to_string(config).expect("TOML is text").lines() {
            if let Some(name) = line.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
                let mut parts: Vec<&str> = name.split('.').collect();
                if let ["data", "entities" | "grids" | "exchange" | "symmetries" | "mirror", name, ..] =
                    parts.as_mut_slice()
                {
                    *name = "NAME";
                }
                section = format!("{}.", parts.join("."));
                continue;
            }
            let Some((key, _)) = line.split_once(" = ").filter(|(key, _)| !key.starts_with([' ', '"'])) else {
                continue;
            };
            let key = match section.as_str() {
                "data.entities." | "data.symmetries." | "data.mirror." => "NAME",
                _ => key,
            };
            seen += 1;
            let option = format!("| `{section}{key}` |");
            assert!(key == "type" || text.contains(&option), "{}: {option} is not on the page", config.display());
        }
    }
    assert!(seen > 1000, "{seen}");
}

/// Every page of a study with its charts, written anew in a folder where the results are links.
#[test]
fn the_reference_of_studies_is_current() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let results = folder.path().join("docs/results");
    for file in files(&root().join("docs/results"), "json") {
        let link = folder.path().join(file.strip_prefix(root()).expect("below the root"));
        fs::create_dir_all(link.parent().expect("a folder")).expect("a folder can be made");
        std::os::unix::fs::symlink(&file, &link).expect("a link can be made");
    }
    std::os::unix::fs::symlink(root().join("studies"), folder.path().join("studies")).expect("a link can be made");
    let mut pages = 1;
    for study in files(&root().join("studies"), "toml") {
        let study = Path::new("studies").join(study.file_name().expect("a name"));
        succeeds(zoo(["study", text(&study), "--page-only"]).current_dir(&folder));
        pages += 1;
    }
    succeeds(zoo(["study", "--page-only", "--page", "docs/results/puzzles.md"]).current_dir(&folder));
    let written = [files(&results, "md"), files(&results, "svg")];
    assert_eq!(written[0].len(), pages, "{written:?}");
    for file in written.iter().flatten() {
        let page = file.strip_prefix(&folder).expect("in the folder");
        assert_current(text(page), &fs::read_to_string(file).expect("text"));
    }
}

#[test]
fn the_reference_of_results_is_current() {
    let (page, of_readme) = results_page();
    assert_current("docs/results/README.md", &page);
    let words = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    let readme = words(&fs::read_to_string(root().join("README.md")).expect("the README"));
    for said in of_readme {
        assert!(readme.contains(&words(&said)), "README: expected what the results say:\n{said}");
    }
}
