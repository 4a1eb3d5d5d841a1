//! What the end-to-end tests share: where the programs and the shipped demonstrations are, how a program is run and how
//! its refusal is checked. The tests themselves lie in `tests/tests/`; each drives the real binaries.

#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
pub mod faults;
pub mod options;
pub mod reference;
pub mod results;

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use tempfile::TempDir;

/// The root of the checkout.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the package lies in the checkout").to_owned()
}

/// The shipped demonstrations.
pub fn lift() -> PathBuf {
    root().join("data/lift.hdf5")
}

/// One of our programs, beside the running test in the target folder.
///
/// # Panics
/// If it has not been built: `make test` builds every program before it tests.
pub fn program(name: &str) -> Command {
    let test = std::env::current_exe().expect("a test knows its own path");
    let folder = test.parent().and_then(Path::parent).expect("tests lie in target/<profile>/deps");
    let path = folder.join(name);
    assert!(path.is_file(), "{} is not built: run `cargo build --release --workspace` first", path.display());
    Command::new(path)
}

/// `actrm-data` with arguments.
pub fn data<const N: usize>(arguments: [&str; N]) -> Command {
    let mut command = program("actrm-data");
    command.args(arguments);
    command
}

/// `actrm-zoo` with arguments.
pub fn zoo<const N: usize>(arguments: [&str; N]) -> Command {
    let mut command = program("actrm-zoo");
    command.args(arguments);
    command
}

/// Run a command that must succeed; returns what it printed.
///
/// # Panics
/// If it cannot be started or ends with another exit code than 0.
pub fn succeeds(command: &mut Command) -> Output {
    let output = command.output().expect("the program starts");
    assert!(
        output.status.success(),
        "{command:?}: {}\n{}\n{}",
        output.status,
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    output
}

/// Verifies what is in a zoo, if anything is.
pub fn verified(folder: &Path) {
    if folder.exists() {
        succeeds(&mut zoo(["verify", "--zoo", text(folder)]));
    }
}

/// Run a command that must be refused: an exit code (not a signal) other than 0, and one line on standard error that
/// holds every one of `words`. Returns the line.
///
/// # Panics
/// If it succeeds, dies of a signal, panics, prints several lines, or the line lacks a word.
pub fn refused(command: &mut Command, words: &[&str]) -> String {
    let output = command.env_remove("RUST_BACKTRACE").output().expect("the program starts");
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    let code = output.status.code();
    assert!(matches!(code, Some(1 | 2)), "{command:?}: {:?}\n{text}", output.status);
    let line = text.trim_end();
    assert!(!line.contains("panicked"), "{command:?}: {line}");
    assert!(code == Some(2) || line.lines().count() == 1, "{command:?}: more than one line:\n{line}");
    for word in words {
        assert!(line.contains(word), "{command:?}: no {word:?} in: {line}");
    }
    line.to_owned()
}

/// Names of what lies in a folder, sorted; nothing for a folder that is not there.
pub fn listing(folder: &Path) -> Vec<String> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut names: Vec<String> =
        entries.map(|entry| entry.expect("a readable folder").file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

/// A path as text, for argument lists.
///
/// # Panics
/// If the path is not UTF-8.
pub fn text(path: &Path) -> &str {
    path.to_str().expect("test paths are UTF-8")
}

/// A zoo with one entry, `lift-act@1`, trained on the shipped demonstrations for a few steps: `zoo` in this folder,
/// beside the data set `lift`. Made once in a test program.
///
/// # Panics
/// If it cannot be made.
pub fn trained() -> &'static Path {
    static TRAINED: OnceLock<TempDir> = OnceLock::new();
    TRAINED
        .get_or_init(|| {
            let folder = tempfile::tempdir().expect("a temporary folder");
            let at = |name: &str| folder.path().join(name);
            succeeds(&mut data(["convert", text(&lift()), text(&at("lift"))]));
            train_lift(&at("lift"), &at("zoo"), &at("runs"));
            folder
        })
        .path()
}

/// Train `lift-act` for two steps.
///
/// # Panics
/// If that fails.
pub fn train_lift(demonstrations: &Path, entries: &Path, runs: &Path) {
    let (demonstrations, entries, runs) = (text(demonstrations), text(entries), text(runs));
    succeeds(&mut zoo([
        "train",
        "act_lift",
        "--data",
        demonstrations,
        "--zoo",
        entries,
        "--runs",
        runs,
        "train.steps=2",
    ]));
}

/// A copy of the trained zoo that a test may change, and the temporary folder that it lies in.
///
/// # Panics
/// If it cannot be made.
pub fn copied_zoo() -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let to = folder.path().join("zoo");
    copy(&trained().join("zoo"), &to);
    (folder, to)
}

/// A zoo of these shipped entries and their results that a test may change, and the temporary folder that it lies in.
///
/// # Panics
/// If it cannot be made, or there is no such entry.
pub fn shipped(names: &[&str]) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (from, to) = (root().join("zoo"), folder.path().join("zoo"));
    std::fs::create_dir_all(to.join("results")).expect("creatable");
    for name in names {
        copy(&from.join(name), &to.join(name));
        let results =
            listing(&from.join("results")).into_iter().filter(|result| result.starts_with(&format!("{name}@")));
        results.for_each(|result| copy(&from.join("results").join(&result), &to.join("results").join(&result)));
    }
    (folder, to)
}

/// The entry of each task that one training of ACT made.
pub const SHIPPED_ACT: [&str; 6] =
    ["door-act", "lift-act", "nutassemblysquare-act", "pickplacecan-act", "stack-act", "stackthreecubes-act"];

/// Copy a folder with everything in it.
///
/// # Panics
/// If that fails.
pub fn copy(from: &Path, to: &Path) {
    std::fs::create_dir(to).expect("creatable");
    for entry in std::fs::read_dir(from).expect("readable") {
        let entry = entry.expect("readable");
        let target = to.join(entry.file_name());
        if entry.file_type().expect("known").is_dir() {
            copy(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).expect("copied");
        }
    }
}

/// Sends a signal (`INT`, `TERM`) to a program that a test started, as soon as it handles signals.
///
/// # Panics
/// If it cannot be sent.
pub fn signal(child: &Child, name: &str) {
    wait_until("a program that handles SIGINT", || handles_interrupts(child.id()).then_some(()));
    let sent = Command::new("kill").args([&format!("-{name}"), &child.id().to_string()]).status();
    assert!(sent.expect("kill runs").success(), "no signal to {}", child.id());
}

/// Whether a process has a handler for SIGINT.
fn handles_interrupts(process: u32) -> bool {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
    let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).expect("a process of Linux").trim();
    u64::from_str_radix(caught, 16).expect("a mask") & (1 << (2 - 1)) != 0
}

/// Runs a shell command in a terminal of this many columns; returns all that was written to it, and its exit code.
///
/// # Panics
/// If there is no `script` to make a terminal.
pub fn in_terminal(columns: usize, command: &str) -> (String, Option<i32>) {
    let script = format!("stty cols {columns} rows 40; {command}");
    let output = Command::new("script")
        .args(["-qefc", &script, "/dev/null"])
        .env("SHELL", "/bin/bash")
        .env("TERM", "xterm")
        .stdin(Stdio::null())
        .output()
        .expect("`script` of util-linux");
    (String::from_utf8_lossy(&output.stdout).into_owned(), output.status.code())
}

/// What a terminal shows after a text was written to it: its lines, without blanks at their ends.
pub fn screen(written: &str) -> Vec<String> {
    let mut lines: Vec<Vec<char>> = vec![Vec::new()];
    let (mut row, mut column) = (0_usize, 0_usize);
    let mut rest = written.chars().peekable();
    while let Some(c) = rest.next() {
        match c {
            '\r' => column = 0,
            '\n' => row += 1,
            '\u{1b}' if rest.peek() == Some(&'[') => {
                rest.next();
                let mut number = String::new();
                while rest.peek().is_some_and(|c| !c.is_ascii_alphabetic()) {
                    number.extend(rest.next());
                }
                let count = number.parse::<usize>().ok();
                match rest.next() {
                    Some('A') => row = row.saturating_sub(count.unwrap_or(1)),
                    Some('B') => row += count.unwrap_or(1),
                    Some('C') => column += count.unwrap_or(1),
                    Some('G') => column = count.unwrap_or(1) - 1,
                    Some('K') if count == Some(2) => lines[row].clear(),
                    Some('K') => lines[row].truncate(column),
                    Some('J') => {
                        lines.truncate(row + 1);
                        lines[row].truncate(column);
                    }
                    _ => {}
                }
            }
            _ => {
                let line = &mut lines[row];
                line.resize(line.len().max(column + 1), ' ');
                line[column] = c;
                column += 1;
            }
        }
        lines.resize(lines.len().max(row + 1), Vec::new());
    }
    lines.iter().map(|line| line.iter().collect::<String>().trim_end().to_owned()).collect()
}

/// The commands of a how-to: indented lines under the heading of `docs/howto/five_commands.md` that begins like this, word by word.
///
/// # Panics
/// If there is no such heading, or it has no commands or more than five.
pub fn howto(heading: &str) -> Vec<Vec<String>> {
    let page = std::fs::read_to_string(root().join("docs/howto/five_commands.md")).expect("the page");
    let section = page.split("\n## ").find(|section| section.starts_with(heading)).expect("a heading of the page");
    let lines = section.lines().filter_map(|line| line.strip_prefix("    "));
    let commands: Vec<Vec<String>> = lines.map(|line| line.split_whitespace().map(str::to_owned).collect()).collect();
    assert!((1..=5).contains(&commands.len()), "{heading}: {} commands", commands.len());
    commands
}

/// Waits until something has come about, looking every few milliseconds.
///
/// # Panics
/// After two minutes; with `what` was to be.
pub fn wait_until<T>(what: &str, mut found: impl FnMut() -> Option<T>) -> T {
    let until = Instant::now() + Duration::from_secs(120);
    loop {
        if let Some(found) = found() {
            return found;
        }
        assert!(Instant::now() < until, "{what}: not within two minutes");
        std::thread::sleep(Duration::from_millis(5));
    }
}
