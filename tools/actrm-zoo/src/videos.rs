//! Videos of episodes in a zoo: `videos/ENTRY/TASK-SEED-failure-CONDITIONS.mp4`, with `-seen` after the outcome where they
//! show what the policy saw. The conditions are those of the result that an episode is of
//! ([`zoo::results::EvaluationRecord::conditions`]); older videos name none.

use std::path::{Path, PathBuf};

use cli::shown;
use report::{Film, LeaderboardRow, MOST_FILM_BYTES};
use zoo::results::{EntryIdentity, StoredEvaluation};

/// The folder of an entry's videos.
pub fn folder(zoo: &Path, entry: &EntryIdentity) -> PathBuf {
    zoo.join("videos").join(entry.to_string())
}

/// The file of a video.
pub fn name(task: &str, seed: u64, success: bool, seen: bool, conditions: &str) -> String {
    format!("{}-{conditions}.mp4", stem(task, seed, success, seen))
}

fn stem(task: &str, seed: u64, success: bool, seen: bool) -> String {
    let (word, task) = (if success { "success" } else { "failure" }, task.replace('/', "-"));
    format!("{task}-{seed}-{word}{}", if seen { "-seen" } else { "" })
}

/// The videos of episodes of these rows, in the rows' order, those of failures first. As many are read as a page takes, the
/// others are named.
///
/// A video without conditions counts where it can be of one result only.
pub fn of_episodes(rows: &[LeaderboardRow], zoo: &Path) -> Vec<Film> {
    let all: Vec<&StoredEvaluation> = rows.iter().flat_map(LeaderboardRow::evaluations).collect();
    let mut found = Vec::new();
    let mut room = MOST_FILM_BYTES;
    for one in &all {
        let (entry, task) = (&one.record.entry, &one.record.protocol.task);
        let folder = folder(zoo, entry);
        let Some(result) = one.folder.file_name().and_then(|name| name.to_str()).filter(|_| folder.is_dir()) else {
            continue;
        };
        let conditions = one.record.conditions();
        let mut episodes: Vec<(bool, u64)> =
            one.episodes.iter().map(|episode| (episode.success, episode.seed)).collect();
        episodes.sort_by_key(|(success, _)| *success);
        for (success, seed) in episodes {
            let holds = |other: &&&StoredEvaluation| {
                let record = &other.record;
                (&record.entry, &record.protocol.task) == (entry, task) && record.seeds.iter().contains(&seed)
            };
            for seen in [false, true] {
                let named = folder.join(name(task, seed, success, seen, &conditions));
                let unnamed = folder.join(format!("{}.mp4", stem(task, seed, success, seen)));
                let path = match (named.is_file(), unnamed.is_file()) {
                    (true, _) => named,
                    (false, true) if all.iter().filter(holds).count() == 1 => unnamed,
                    _ => continue,
                };
                let length =
                    path.metadata().map_or(usize::MAX, |meta| usize::try_from(meta.len()).unwrap_or(usize::MAX));
                let video = (length <= room).then(|| std::fs::read(&path).ok()).flatten();
                room -= video.as_ref().map_or(0, Vec::len).min(room);
                found.push(Film { result: result.to_owned(), seed, path: shown(&path), video });
            }
        }
    }
    found
}
