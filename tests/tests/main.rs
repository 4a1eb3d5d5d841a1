//! Every end-to-end test, in one program: one link, and no core waits while the last test of a file runs.

mod architecture;
mod bad_data;
mod bad_zoo;
mod cluster;
mod collecting;
mod completing;
mod depth;
mod evaluating;
mod extract;
mod families;
#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
mod faults;
mod help;
mod house;
mod hub;
mod killed;
mod main_line;
mod page;
mod paths;
mod pipes;
mod rerun;
mod serving;
mod shipped_zoo;
mod sizes;
mod stopping;
mod terminal;
mod tracing;
mod trust;
mod vision;

#[test]
fn no_file_is_forgotten() {
    let source = std::fs::read_to_string(e2e::root().join("tests/tests/main.rs")).expect("this file");
    for file in std::fs::read_dir(e2e::root().join("tests/tests")).expect("a folder") {
        let path = file.expect("an entry").path();
        let name = path.file_stem().expect("a name").to_string_lossy();
        let rust = path.extension().is_some_and(|extension| extension == "rs") && name != "main";
        assert!(!rust || source.contains(&format!("mod {name};")), "{} is in no `mod`", path.display());
    }
}
