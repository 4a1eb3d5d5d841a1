//! What people see in a terminal of 80 columns.

use e2e::{copied_zoo, in_terminal, lift, program, root, screen, text};

fn path(name: &str) -> String {
    text(std::path::Path::new(program(name).get_program())).to_owned()
}

#[test]
fn the_leaderboard_fits_80_columns_and_wide_shows_all() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (zoo, shipped, out) = (path("actrm-zoo"), root().join("zoo"), folder.path());
    let line = format!("'{zoo}' leaderboard --zoo '{}' --out '{}'", text(&shipped), text(out));
    let (written, code) = in_terminal(80, &line);
    assert_eq!(code, Some(0), "{written}");
    let lines = screen(&written);
    let table: Vec<&String> = lines.iter().filter(|line| !line.contains(text(out))).collect();
    assert!(table.iter().all(|line| line.chars().count() <= 80), "{table:#?}");
    for word in ["entry", "protocol", "success", "rate [95%]", "lift-act@1", "left out:", "--wide"] {
        assert!(lines.iter().any(|line| line.contains(word)), "no {word}: {lines:#?}");
    }
    // blocks of seeds are told apart
    for block in ["lift-v1 dev", "lift-v1 test"] {
        assert!(lines.iter().any(|line| line.contains(block)), "{block}: {lines:#?}");
    }
    assert!(!lines[0].contains("demos"), "{}", lines[0]);
    let (wide, _) = in_terminal(80, &format!("{line} --wide"));
    for word in ["task", "demos", "seeds", "params"] {
        assert!(wide.contains(word), "no {word}: {wide}");
    }
    assert!(!wide.contains("left out"), "{wide}");
}

#[test]
fn a_training_shows_its_bar_and_leaves_none_behind() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (zoo, at) = (path("actrm-zoo"), |name: &str| folder.path().join(name));
    // of a file, which is converted first
    let line = format!(
        "'{zoo}' train act_lift train.steps=30 train.batch_size=4 policy.dim_model=32 --data '{}' --zoo '{}' --runs '{}'",
        text(&lift()),
        text(&at("zoo")),
        text(&at("runs"))
    );
    let (written, code) = in_terminal(80, &line);
    assert_eq!(code, Some(0), "{written}");
    let shown = |what: &str| written.split(['\r', '\n']).any(|line| line.contains(what) && line.contains(['█', '░']));
    assert!(shown("train"), "no bar: {written:?}");
    assert!(written.contains("loss "), "{written:?}");
    let left = screen(&written);
    assert!(!left.iter().any(|line| line.contains(['█', '░']) || line.contains("convert")), "{left:#?}");
    assert!(left.iter().any(|line| line.contains("lift-act@1 is in")), "{left:#?}");
    // and where it is refused after the bar was there
    let (written, code) = in_terminal(80, &line.replace("train.steps=30", "policy.n_heads=7"));
    assert_eq!(code, Some(1), "{written}");
    let left = screen(&written);
    assert!(!left.iter().any(|line| line.contains(['█', '░'])), "{left:#?}");
}

#[test]
fn lists_fit_as_well() {
    let (_folder, entries) = copied_zoo();
    let (written, _) = in_terminal(40, &format!("'{}' list --zoo '{}'", path("actrm-zoo"), text(&entries)));
    let lines = screen(&written);
    assert!(lines.iter().all(|line| line.chars().count() <= 40), "{lines:#?}");
    assert!(lines.iter().any(|line| line.starts_with("lift-act@1")), "{lines:#?}");
}
