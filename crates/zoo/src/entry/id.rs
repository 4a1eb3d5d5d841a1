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

/// What a user asks for: `name` or `name@latest` (its newest version), `name@version` or `name@alias`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EntryRequest {
    /// The entry's name.
    pub name: String,
    /// The version, or the newest.
    pub version: Option<u32>,
    /// A name for a version, if one was given instead.
    pub alias: Option<String>,
}

/// The alias that always is the newest version.
pub const LATEST: &str = "latest";

/// Refuses what cannot be an alias: it must not look like a version.
pub fn check_alias(alias: &str) -> Result<(), ZooError> {
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
    let sound = alias.starts_with(|c: char| c.is_ascii_lowercase()) && alias.chars().all(allowed) && alias.len() <= 32;
    if sound {
        return Ok(());
    }
    let reason = "what follows `@` is a version, a number from 1, or an alias of lower-case letters, digits and `-`";
    Err(ZooError::EntryName { name: format!("@{alias}"), reason })
}

impl Display for EntryRequest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)?;
        self.version.map_or(Ok(()), |v| write!(f, "@{v}"))?;
        self.alias.as_ref().map_or(Ok(()), |alias| write!(f, "@{alias}"))
    }
}

impl FromStr for EntryRequest {
    type Err = ZooError;

    fn from_str(text: &str) -> Result<Self, ZooError> {
        let (name, version, alias) = match text.split_once('@') {
            None => (text, None, None),
            Some((name, LATEST)) => (name, None, None),
            Some((name, version)) => match version.parse::<u32>() {
                Ok(number) if number > 0 => (name, Some(number), None),
                _ => {
                    check_alias(version).map_err(|error| match error {
                        ZooError::EntryName { reason, .. } => ZooError::EntryName { name: text.to_owned(), reason },
                        other => other,
                    })?;
                    (name, None, Some(version.to_owned()))
                }
            },
        };
        check_name(name)?;
        Ok(Self { name: name.to_owned(), version, alias })
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
        assert_eq!("lift-act@latest".parse::<EntryRequest>().unwrap(), "lift-act".parse().unwrap());
        for text in ["lift-act", "lift-act@1", "a_b.c@4000000000", "lift-act@best"] {
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
            "a@X",
            "a@1x",
            "a@x@1",
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
