//! `lift-act@1`.

use std::fmt::{self, Display};
use std::str::FromStr;

use crate::ZooError;

/// Names that stand for something else inside a zoo's folder.
const RESERVED: [&str; 6] = ["results", "runs", "videos", "report.html", "leaderboard.csv", "leaderboard_puzzles.csv"];
/// The longest name: file systems take 255 bytes, and results' folders are called after it and more.
const LONGEST: usize = 100;

/// One version of one entry.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct EntryId {
    /// Lower-case letters, digits, `-`, `_` and `.`, beginning with a letter or digit.
    pub name: String,
    /// From 1 upward.
    pub version: u32,
}

impl Display for EntryId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}@{}", self.name, self.version)
    }
}

/// What a user asks for: `name` (its newest version) or `name@version`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EntryRequest {
    /// The entry's name.
    pub name: String,
    /// The version, or the newest.
    pub version: Option<u32>,
}

impl Display for EntryRequest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)?;
        self.version.map_or(Ok(()), |v| write!(f, "@{v}"))
    }
}

impl FromStr for EntryRequest {
    type Err = ZooError;

    fn from_str(text: &str) -> Result<Self, ZooError> {
        let (name, version) = match text.split_once('@') {
            None => (text, None),
            Some((name, version)) => match version.parse::<u32>() {
                Ok(number) if number > 0 => (name, Some(number)),
                _ => {
                    return Err(ZooError::EntryName {
                        name: text.to_owned(),
                        reason: "the version after `@` is a number from 1",
                    });
                }
            },
        };
        check_name(name)?;
        Ok(Self { name: name.to_owned(), version })
    }
}

/// Refuses names that cannot be a folder's, or that the zoo uses itself.
pub fn check_name(name: &str) -> Result<(), ZooError> {
    let refuse = |reason| Err(ZooError::EntryName { name: name.to_owned(), reason });
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "-_.".contains(c);
    if RESERVED.contains(&name) {
        return refuse("the zoo uses this name itself");
    }
    if name.len() > LONGEST {
        return refuse("at most 100 letters");
    }
    if !name.starts_with(|c: char| c.is_ascii_lowercase() || c.is_ascii_digit()) || !name.chars().all(allowed) {
        return refuse("lower-case letters, digits, `-`, `_` and `.` only, beginning with a letter or digit");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn requests_read_back() {
        for text in ["lift-act", "lift-act@1", "a_b.c@4000000000"] {
            assert_eq!(text.parse::<EntryRequest>().unwrap().to_string(), text);
        }
    }

    #[test]
    fn what_is_not_a_name_is_refused() {
        for text in [
            "",
            "@1",
            "a@",
            "a@0",
            "a@x",
            "a@-1",
            "../x",
            "A",
            "a/b",
            ".hidden",
            "results",
            "a b",
            "videos",
            "report.html",
        ] {
            assert!(text.parse::<EntryRequest>().is_err(), "{text}");
        }
        assert!(check_name(&"x".repeat(100)).is_ok());
        assert!(check_name(&"x".repeat(300)).unwrap_err().to_string().ends_with("at most 100 letters"));
    }
}
