//! All help texts in one file, to be read in one go, and the length of their sentences and of the README's.

use std::fs;

use e2e::{data, root, succeeds, zoo};

/// Words of a sentence at most, and of a table's cell in the README.
const SENTENCE: usize = 35;
const CELL: usize = 30;

/// The help of a command and of all below it, each after a line with its name.
fn help(program: &str, path: &[&str], text: &mut String) {
    let mut command = if program == "actrm-zoo" { zoo([]) } else { data([]) };
    command.args(path);
    for variable in ["ACTRM_ZOO_DIR", "ACTRM_CONFIGS", "ACTRM_PROTOCOLS", "ACTRM_PYTHON"] {
        command.env_remove(variable);
    }
    let told = String::from_utf8(succeeds(command.arg("--help")).stdout).expect("text");
    let line = [&[program], path].concat().join(" ");
    text.push_str(&format!("──── {line}\n{}\n\n", told.trim_end()));
    // commands come before the options: two blanks, a name, and what it does
    let below = told.split("\nOptions:").next().unwrap_or_default();
    let names = below.lines().filter_map(|line| line.strip_prefix("  ")?.split_once("  ").map(|(name, _)| name));
    let plain = |name: &&str| !name.is_empty() && name.chars().all(|c| c.is_ascii_lowercase());
    for name in names.filter(plain).filter(|name| *name != "help") {
        help(program, &[path, &[name]].concat(), text);
    }
}

fn all_help() -> String {
    let mut text = String::new();
    for program in ["actrm-data", "actrm-zoo"] {
        help(program, &[], &mut text);
    }
    text
}

#[test]
fn the_help_texts_read_like_this() {
    let text = all_help();
    assert!(text.matches("────").count() > 40, "{text}");
    assert!(text.lines().all(|line| line.chars().count() <= 132), "no line is too wide");
    insta::assert_snapshot!("help", text);
}

/// Sentences of paragraphs that have more than `most` words.
fn long(paragraphs: &[String], most: usize) -> Vec<String> {
    let mut found = Vec::new();
    for paragraph in paragraphs {
        let mut sentence: Vec<&str> = Vec::new();
        for word in paragraph.split_whitespace() {
            sentence.push(word);
            if word.ends_with(['.', '?', '!']) || word.ends_with(".)") {
                found.extend((sentence.len() > most).then(|| sentence.join(" ")));
                sentence.clear();
            }
        }
        found.extend((sentence.len() > most).then(|| sentence.join(" ")));
    }
    found
}

/// Paragraphs and list items of Markdown without its code, and the cells of its tables.
fn parts(text: &str) -> (Vec<String>, Vec<String>) {
    let (mut paragraphs, mut cells) = (vec![String::new()], Vec::new());
    for line in text.lines() {
        match line {
            line if line.starts_with('|') => cells.extend(line.split('|').map(|cell| cell.trim().to_owned())),
            line if line.starts_with("    ") => {}
            line => {
                if line.is_empty() || line.starts_with(['-', '#']) {
                    paragraphs.push(String::new());
                }
                if let Some(last) = paragraphs.last_mut() {
                    last.push_str(&format!(" {line}"));
                }
            }
        }
    }
    (paragraphs, cells)
}

#[test]
fn sentences_are_short() {
    for page in ["README.md", "GLOSSARY.md", "CHANGELOG.md", "SECURITY.md"] {
        let text = fs::read_to_string(root().join(page)).expect("a page");
        let (paragraphs, cells) = parts(&text);
        assert_eq!(long(&paragraphs, SENTENCE), [""; 0], "{page}");
        let wide: Vec<&String> = cells.iter().filter(|cell| cell.split_whitespace().count() > CELL).collect();
        assert!(wide.is_empty(), "{page}: {wide:#?}");
    }
    let mut paragraphs = vec![String::new()];
    for block in all_help().split("\n\n").filter(|block| !block.starts_with("Examples:")) {
        paragraphs.push(String::new());
        for line in block.lines() {
            // a command or an option with its own text
            let named = line.strip_prefix("  ").is_some_and(|rest| !rest.starts_with(' '));
            if named || line.trim_start().starts_with('-') {
                paragraphs.push(String::new());
            }
            if let Some(last) = paragraphs.last_mut() {
                last.push_str(&format!(" {line}"));
            }
        }
    }
    assert_eq!(long(&paragraphs, SENTENCE), [""; 0], "help");
}

#[test]
fn long_sentences_are_found() {
    let (paragraphs, cells) =
        parts("One two three. Four five.\n\n    code that is not counted at all\n- six seven eight\n| a | b c |");
    assert_eq!(long(&paragraphs, 2), ["One two three.", "- six seven eight"]);
    assert!(cells.contains(&"b c".to_owned()));
}
