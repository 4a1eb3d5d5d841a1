//! Numbers, paths and names as people read them.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

/// Text without what would command the terminal: names and task texts come from files of anywhere. Lines stay.
pub fn plain(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        let harmless = c == '\n' || !(c.is_control() || turns_the_line(c));
        if harmless { out.push(c) } else { out.extend(c.escape_default()) }
    }
    out
}

/// Marks that make a terminal show text in another order than it is written.
fn turns_the_line(c: char) -> bool {
    matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// `data/lift.hdf5` for a path, without the `.` and the doubled slashes that users type. What is not UTF-8 is shown as
/// U+FFFD.
pub fn shown(path: &Path) -> String {
    lossy(&path.components().collect::<PathBuf>())
}

/// A path as it was typed, for JSON: what is not UTF-8 is shown as U+FFFD.
pub fn lossy(path: &Path) -> String {
    path.display().to_string()
}

/// A word as a shell reads it back: quoted where it has to be.
pub fn shell_quoted(word: &OsStr) -> String {
    let harmless = |c: char| c.is_ascii_alphanumeric() || "_-./=:,@%+".contains(c);
    match word.to_str() {
        Some(text) if !text.is_empty() && text.chars().all(harmless) => text.to_owned(),
        Some(text) if !text.chars().any(char::is_control) => format!("'{}'", text.replace('\'', "'\\''")),
        _ => {
            let byte = |&b: &u8| match b {
                b'\'' | b'\\' => format!("\\{}", b as char),
                b' '..=b'~' => (b as char).to_string(),
                other => format!("\\x{other:02x}"),
            };
            format!("$'{}'", word.as_encoded_bytes().iter().map(byte).collect::<String>())
        }
    }
}

/// A command that can be pasted into a shell.
pub fn command_line<S: AsRef<OsStr>>(words: &[S]) -> String {
    words.iter().map(|word| shell_quoted(word.as_ref())).collect::<Vec<_>>().join(" ")
}

/// A number with four significant digits.
pub fn number(value: f64) -> String {
    let magnitude = value.abs();
    if value == 0.0 {
        "0".to_owned()
    } else if !(1e-3..1e6).contains(&magnitude) {
        format!("{value:.3e}")
    } else if value.fract() == 0.0 {
        format!("{value}")
    } else {
        let decimals = (3 - magnitude.log10().floor() as i64).clamp(0, 6) as usize;
        let text = format!("{value:.decimals$}");
        match text.contains('.') {
            true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
            false => text,
        }
    }
}

/// Bytes in a readable unit.
pub fn bytes(count: u64) -> String {
    const UNITS: [&str; 5] = ["kB", "MB", "GB", "TB", "PB"];
    let mut value = count as f64;
    let mut unit = "B";
    for next in UNITS {
        if value < 1000.0 {
            break;
        }
        value /= 1000.0;
        unit = next;
    }
    if unit == "B" { format!("{count} B") } else { format!("{value:.1} {unit}") }
}

/// Thousands set apart.
pub fn count(value: usize) -> String {
    let digits = value.to_string();
    let mut out = String::new();
    for (i, c) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            out.push(',');
        }
        out.push(c);
    }
    out
}

/// `10 x 3`; `scalar` for an empty shape.
pub fn shape(extents: &[usize]) -> String {
    if extents.is_empty() {
        return "scalar".to_owned();
    }
    extents.iter().map(usize::to_string).collect::<Vec<_>>().join(" x ")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::os::unix::ffi::OsStrExt;

    use super::*;

    #[test]
    fn a_text_from_a_file_does_not_command_the_terminal() {
        assert_eq!(plain("lift\tthe \u{1b}[31mred\ncube ß"), "lift\\tthe \\u{1b}[31mred\ncube ß");
        assert_eq!(plain("a\u{202e}b\u{9b}c"), "a\\u{202e}b\\u{9b}c");
    }

    #[test]
    fn numbers_are_short_and_right() {
        let shown: Vec<String> =
            [0.0, 1.0, -0.123_456, 12_345.678, 1e-9, 20.0, 0.5].iter().map(|&v| number(v)).collect();
        assert_eq!(shown, ["0", "1", "-0.1235", "12346", "1.000e-9", "20", "0.5"]);
        assert_eq!(
            (bytes(999), bytes(389_552), bytes(5_000_000_000)),
            ("999 B".into(), "389.6 kB".into(), "5.0 GB".into())
        );
        assert_eq!((count(7), count(1000), count(1_234_567)), ("7".into(), "1,000".into(), "1,234,567".into()));
    }

    #[test]
    fn a_shell_reads_back_every_word_that_is_quoted() {
        let words: [&[u8]; 8] = [
            b"plain-1.2=x",
            b"",
            b"two words",
            b"it's",
            b"$HOME `a` \"b\" *",
            b"a\nb\t\\",
            b"caf\xe9",
            "ä ö".as_bytes(),
        ];
        for word in words {
            let quoted = shell_quoted(OsStr::from_bytes(word));
            assert!(!quoted.contains('\n'), "{quoted}");
            let shell =
                std::process::Command::new("bash").args(["-c", &format!("printf %s {quoted}")]).output().unwrap();
            assert_eq!(shell.stdout, word, "{quoted}");
        }
    }
}
