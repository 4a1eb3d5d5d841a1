//! The directions of the dependencies, as ARCHITECTURE.md draws them: `puzzles`, `rollout` and `models` know nothing
//! of ours, nothing knows the tools, and only the rooms named for it know HDF5, candle or a terminal.

use std::collections::BTreeMap;
use std::process::Command;

use e2e::root;

/// For each of our packages, the packages (ours and others) that it depends on, test dependencies left out.
fn dependencies() -> BTreeMap<String, Vec<String>> {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version=1", "--no-deps", "--offline", "--manifest-path"])
        .arg(concat!(env!("CARGO_MANIFEST_DIR"), "/../Cargo.toml"))
        .output()
        .expect("cargo runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let metadata: serde_json::Value = serde_json::from_slice(&output.stdout).expect("cargo prints JSON");
    metadata["packages"]
        .as_array()
        .expect("a list of packages")
        .iter()
        .map(|package| {
            let names = package["dependencies"]
                .as_array()
                .expect("a list of dependencies")
                .iter()
                .filter(|dependency| dependency["kind"] != "dev")
                .map(|dependency| dependency["name"].as_str().expect("a name").to_owned())
                .collect();
            (package["name"].as_str().expect("a name").to_owned(), names)
        })
        .collect()
}

/// Our packages, lowest first: each may depend on those before it, as far as `ALLOWED` says.
const ALLOWED: &[(&str, &[&str])] = &[
    ("puzzles", &[]),
    ("control", &[]),
    ("rollout", &[]),
    ("nn", &[]),
    ("models", &["nn"]),
    ("solvers", &["models", "nn"]),
    ("serving", &["models"]),
    ("video", &[]),
    ("dataset", &["puzzles", "video"]),
    ("query", &["dataset"]),
    ("results", &["rollout"]),
    ("zoo", &["dataset", "models", "results", "rollout"]),
    ("interchange", &["models", "results", "rollout", "zoo"]),
    ("audit", &["results", "rollout", "zoo"]),
    ("analysis", &["dataset", "models", "rollout", "zoo"]),
    ("recording", &["dataset", "rollout"]),
    ("report", &["audit", "models", "zoo"]),
    ("study", &["analysis", "audit", "models", "puzzles", "recording", "report", "rollout", "solvers", "zoo"]),
    ("python", &["audit", "dataset", "interchange", "models", "report", "rollout", "zoo"]),
    ("cli", &["rollout", "video"]),
    ("actrm-data", &["cli", "dataset", "puzzles", "recording", "rollout"]),
    ("actrm-query", &["cli", "dataset", "query"]),
    (
        "actrm-zoo",
        &[
            "analysis",
            "audit",
            "cli",
            "dataset",
            "interchange",
            "models",
            "puzzles",
            "recording",
            "report",
            "rollout",
            "serving",
            "study",
            "zoo",
        ],
    ),
    ("e2e", &[]),
];

#[test]
fn dependencies_go_one_way() {
    let dependencies = dependencies();
    let ours: Vec<&str> = ALLOWED.iter().map(|(name, _)| *name).collect();
    assert_eq!(
        dependencies.keys().map(String::as_str).collect::<std::collections::BTreeSet<_>>(),
        ours.iter().copied().collect(),
        "every package of the workspace stands in this test"
    );
    for (package, allowed) in ALLOWED {
        for name in &dependencies[*package] {
            assert!(
                !ours.contains(&name.as_str()) || allowed.contains(&name.as_str()),
                "{package} must not depend on {name}"
            );
        }
    }
}

#[test]
fn each_heavy_dependency_has_one_room() {
    let rooms: &[(&str, &[&str])] = &[
        ("hdf5-metno", &["dataset", "e2e"]),
        ("polars", &["query"]),
        ("re_rav1d", &["video"]),
        ("rust_h264", &["video"]),
        ("rav1e", &["video"]),
        ("candle-core", &["nn", "models", "solvers", "zoo", "interchange", "audit", "analysis", "study"]),
        ("candle-nn", &["nn", "solvers"]),
        ("clap", &["cli", "actrm-data", "actrm-query", "actrm-zoo"]),
        ("anyhow", &["cli", "actrm-data", "actrm-query", "actrm-zoo"]),
        ("indicatif", &["cli"]),
        ("comfy-table", &["cli"]),
        ("ctrlc", &["cli"]),
        ("pyo3", &["python"]),
        ("tungstenite", &["serving"]),
        ("rmp", &["serving"]),
    ];
    for (package, names) in dependencies() {
        for (dependency, allowed) in rooms {
            assert!(
                !names.iter().any(|name| name == dependency) || allowed.contains(&package.as_str()),
                "{package} must not depend on {dependency}; it belongs to {allowed:?}"
            );
        }
    }
}

#[test]
fn the_programs_alone_are_compiled_as_they_are_with_everything() {
    let makefile = std::fs::read_to_string(root().join("Makefile")).expect("there is a Makefile");
    let line = makefile.lines().find(|line| line.contains("$(CARGO) build") && line.contains("-p actrm-data"));
    let selection: Vec<&str> =
        line.and_then(|l| Some(l.split_at(l.find("-p ")?).1)).expect("`make demo` builds").split(' ').collect();
    // each dependency with its features; another set of them is another compilation
    let resolved = |selection: &[&str], kinds: &str| -> std::collections::BTreeSet<String> {
        let mut cargo = Command::new(env!("CARGO"));
        cargo.args(["tree", "--locked", "--offline", "--prefix", "none", "--format", "{p} {f}"]);
        let output = cargo.args(["-e", kinds]).args(selection).current_dir(root()).output().expect("cargo runs");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let text = String::from_utf8_lossy(&output.stdout);
        // `(*)`: what it depends on was listed before
        text.lines().map(|line| line.trim_end_matches(" (*)").to_owned()).filter(|line| !line.is_empty()).collect()
    };
    let (alone, everything) = (resolved(&selection, "normal,build"), resolved(&["--workspace"], "normal,build,dev"));
    assert!(alone.len() > 100 && alone.len() < everything.len(), "{} of {}", alone.len(), everything.len());
    let twice: Vec<&String> = alone.difference(&everything).collect();
    assert!(twice.is_empty(), "name these features in tools/cli, or they are compiled twice: {twice:#?}");
}
