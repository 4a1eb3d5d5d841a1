//! Films of episodes, in the page as far as there is room.

use std::fmt::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use super::{Beside, command, commands};
use crate::html::escape;
use crate::leaderboard::LeaderboardRow;

/// Characters that the films of a page may have together; those after are named by their paths.
pub const MOST_FILM_BYTES: usize = 20_000_000;

/// A film of an episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Film {
    /// Name of the folder of the result that the episode is of.
    pub result: String,
    /// The episode's seed.
    pub seed: u64,
    /// Where the film lies, as it is told.
    pub path: String,
    /// The file, MP4; `None` where it is only named.
    pub video: Option<Vec<u8>>,
}

/// The films of a row of one training, each with the command that shows it again; `room`, in characters, becomes less by what
/// they take.
pub(super) fn filmed(row: &LeaderboardRow, beside: &Beside, room: &mut usize) -> String {
    let mut html = String::new();
    for one in row.evaluations() {
        let Some(folder) = one.folder.file_name().and_then(|name| name.to_str()) else { continue };
        for film in beside.films.iter().filter(|film| film.result == folder) {
            let Some(episode) = one.episodes.iter().find(|e| e.seed == film.seed) else { continue };
            let why = episode.failure.as_ref().map_or(String::new(), |word| format!(", {word}"));
            let outcome = if episode.success { "success" } else { "failure" };
            let title = format!("{}, seed {}: {outcome} after {} steps{why}", row.name(), film.seed, episode.steps);
            let fits = film.video.as_ref().filter(|video| base64_length(video.len()) <= *room);
            let shown = match fits {
                Some(video) => {
                    *room -= base64_length(video.len());
                    format!(
                        "<video controls preload=\"none\" aria-label=\"{}\" src=\"data:video/mp4;base64,{}\"></video>",
                        escape(&title),
                        STANDARD.encode(video)
                    )
                }
                None => format!("<p>Not in this page: <code>{}</code></p>", escape(&film.path)),
            };
            let again = command(&commands::watch(row, film.seed, beside.task(row), &beside.places));
            let said = escape(&title);
            let _ = writeln!(html, "<figure class=\"film\">{shown}<figcaption>{said}<br>{again}</figcaption></figure>");
        }
    }
    html
}

/// Characters of so many bytes in base64.
fn base64_length(bytes: usize) -> usize {
    bytes.div_ceil(3) * 4
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use zoo::results::testing::{finished, sample};

    #[test]
    fn films_are_shown_while_there_is_room() {
        let dir = tempfile::tempdir().unwrap();
        let stored = finished(dir.path(), &sample("a", 1, 20));
        let result = stored.folder.file_name().unwrap().to_str().unwrap().to_owned();
        let film = |result: &str, seed: u64, path: &str| Film {
            result: result.to_owned(),
            seed,
            path: path.to_owned(),
            video: Some(b"foobar".to_vec()),
        };
        // every fifth seed fails
        let mut beside = Beside {
            films: vec![
                film(&result, 10_000, "one.mp4"),
                film(&result, 10_001, "solved.mp4"),
                film("another", 10_005, "other.mp4"),
                film(&result, 10_005, "two.mp4"),
                film(&result, 10_010, "three.mp4"),
            ],
            ..Beside::default()
        };
        beside.films[3].video = None;
        let row = LeaderboardRow::new(&stored);
        let mut room = 15;
        let html = filmed(&row, &beside, &mut room);
        assert_eq!((html.matches("<video").count(), html.matches("<figure").count(), room), (1, 4, 7), "{html}");
        assert!(html.contains("src=\"data:video/mp4;base64,Zm9vYmFy\""), "{html}");
        assert!(html.contains("<code>two.mp4</code>") && html.contains("<code>three.mp4</code>"), "{html}");
        assert!(
            html.contains("a@1, seed 10000: failure after 400 steps") && html.contains("--seed-start 10000 "),
            "{html}"
        );
        assert!(html.contains("a@1, seed 10001: success after ") && html.contains("<code>solved.mp4</code>"), "{html}");
        assert!(!html.contains("other.mp4"), "{html}");
    }
}
