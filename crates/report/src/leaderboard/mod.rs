//! The leaderboard: a row a training or a family of them, ranked inside its task and protocol, and the list of its columns.
//!
//! A row holds what was measured and counts; rates are derived. The same results give the same rows, and the same
//! rows the same bytes.

mod columns;
mod rank;
mod row;

pub use columns::{COLUMNS, count_text};
pub(crate) use rank::{Asked, Group, asked, group};
pub use rank::{Reading, rank};
pub(crate) use row::interval_text;
pub use row::{Bound, Counts, FEWEST_TO_RANK, LeaderboardRow, Seeing};

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::column::cells;
    use crate::{csv, markdown};
    use zoo::protocols::{Block, Protocols};
    use zoo::results::testing::{finished, sample};
    use zoo::results::{Execution, Seeds, Shard, StoredEvaluation, list_evaluations};

    /// The rows where no entry is of a family.
    fn rank(evaluations: &[StoredEvaluation]) -> Vec<LeaderboardRow> {
        super::rank(evaluations, &Reading::default())
    }

    #[test]
    fn a_rate_is_not_rounded_to_all_or_none() {
        let texts = [(0, "0%"), (1, "0.5%"), (2, "1%"), (151, "76%"), (198, "99%"), (199, "99.5%"), (200, "100%")];
        for (successes, text) in texts {
            assert_eq!(Counts { successes, episodes: 200 }.percent(0), text);
        }
        assert_eq!(Counts { successes: 6_597, episodes: 6_600 }.percent(1), "99.95%");
    }

    fn board(folder: &std::path::Path) -> Vec<LeaderboardRow> {
        for (name, version, count) in [("lift-act", 1, 20), ("lift-act", 2, 4), ("lift, \"b\"", 1, 20)] {
            finished(folder, &sample(name, version, count));
        }
        let mut shard = sample("lift-act", 3, 20);
        shard.shard = Some(Shard { index: 1, count: 2 });
        finished(folder, &shard);
        let mut none = sample("none", 1, 1);
        none.protocol.task = "Stack".into();
        none.execution = Execution::TemporalEnsemble { coefficient: 0.01 };
        finished(folder, &none);
        rank(&list_evaluations(folder).unwrap())
    }

    #[test]
    fn csv_and_table_read_like_this() {
        let dir = tempfile::tempdir().unwrap();
        let rows = board(dir.path());
        insta::assert_snapshot!("leaderboard_csv", csv::table(COLUMNS, &rows));
        let table: Vec<String> = cells(COLUMNS, &rows).rows.iter().map(|cells| cells.join(" | ")).collect();
        insta::assert_snapshot!("leaderboard_table", table.join("\n"));
    }

    #[test]
    fn the_order_of_the_folders_does_not_matter() {
        let dir = tempfile::tempdir().unwrap();
        let expected = csv::table(COLUMNS, &board(dir.path()));
        let mut all = list_evaluations(dir.path()).unwrap();
        for _ in 0..all.len() {
            all.rotate_left(1);
            assert_eq!(csv::table(COLUMNS, &rank(&all)), expected);
        }
    }

    #[test]
    fn ranks_go_by_what_the_rate_is_at_least_and_few_episodes_have_none() {
        let dir = tempfile::tempdir().unwrap();
        let stored = |name: &str, successes: u64, episodes: u64| {
            let mut stored = finished(dir.path(), &sample(name, 1, episodes));
            stored.episodes.iter_mut().enumerate().for_each(|(k, e)| e.success = (k as u64) < successes);
            stored
        };
        let all = [
            stored("one-of-one", 1, 1),
            stored("all-of-nineteen", 19, 19),
            stored("all-of-twenty", 20, 20),
            stored("none", 0, 200),
            stored("same-as-best", 199, 200),
            stored("best", 199, 200),
            stored("half", 100, 200),
        ];
        let ranked: Vec<(String, Option<u64>)> =
            rank(&all).into_iter().map(|row| (row.record().entry.name.clone(), row.rank)).collect();
        let expected = [
            ("best", Some(1)),
            ("same-as-best", Some(1)),
            ("all-of-twenty", Some(3)),
            ("half", Some(4)),
            ("none", Some(5)),
            ("all-of-nineteen", None),
            ("one-of-one", None),
        ];
        assert_eq!(ranked, expected.map(|(name, rank)| (name.to_owned(), rank)));
        assert!(rank(&all)[5].rate_text().contains("too few to rank"));
        // a ceiling between two equal rows takes no place
        let mut ceiling = stored("middle", 199, 200);
        ceiling.record.training.policy = "expert".to_owned();
        let ranks = rank(&[all[4].clone(), all[5].clone(), all[6].clone(), ceiling]);
        assert_eq!(ranks.iter().map(|row| row.rank).collect::<Vec<_>>(), [Some(1), None, Some(1), Some(3)]);
        // another protocol begins anew
        let mut other = all[3].clone();
        other.record.protocol.max_steps = 500;
        assert!(rank(&[all[5].clone(), other]).iter().all(|row| row.rank == Some(1)));
    }

    /// Who sees pictures is ranked apart from who is told the state, in the same task and protocol.
    #[test]
    fn pictures_have_ranks_of_their_own() {
        let dir = tempfile::tempdir().unwrap();
        let stored = |name: &str, successes: usize| {
            let mut stored = finished(dir.path(), &sample(name, 1, 40));
            stored.episodes.iter_mut().enumerate().for_each(|(k, e)| e.success = k < successes);
            stored
        };
        let all = [stored("told", 40), stored("told-less", 38), stored("sees", 36), stored("sees-less", 20)];
        let mut reading = Reading::default();
        for name in ["sees", "sees-less"] {
            let id = zoo::entry::EntryId { name: name.to_owned(), version: 1 };
            reading.cameras.insert(id, vec!["agentview".into(), "robot0_eye_in_hand".into()]);
        }
        let rows = super::rank(&all, &reading);
        let places: Vec<(String, Option<u64>)> =
            rows.iter().map(|row| (row.record().entry.name.clone(), row.rank)).collect();
        let expected = [("told", 1), ("told-less", 2), ("sees", 1), ("sees-less", 2)];
        assert_eq!(places, expected.map(|(name, rank)| (name.to_owned(), Some(rank))));
        // two that differ beyond doubt, and no letter of theirs is another group's
        assert_eq!(rows[2].standing.as_ref().unwrap().ranks, (1, 1));
        assert_eq!(rows[3].standing.as_ref().unwrap().ranks, (2, 2));
        assert_eq!((rows[0].kind().as_str(), rows[2].kind().as_str()), ("act", "act from images"));
        let table = csv::table(COLUMNS, &rows);
        let ends: Vec<bool> =
            table.lines().skip(1).map(|line| line.ends_with(",agentview robot0_eye_in_hand,,")).collect();
        assert_eq!(ends, [false, false, true, true]);
        assert_eq!(rows[2].details()[0].cameras, rows[2].cameras);
        assert!(cells(COLUMNS, &rows).rows[2][0].ends_with("from images"));
    }

    /// Where pictures are seen a row says what drawing and encoding them takes, beside the query that holds the second.
    #[test]
    fn what_pictures_take_is_split() {
        let dir = tempfile::tempdir().unwrap();
        let mut evaluation = finished(dir.path(), &sample("sees", 1, 20));
        assert!(LeaderboardRow::new(&evaluation).seeing().is_none());
        assert!(!LeaderboardRow::new(&evaluation).summary().contains("rendering"));
        for timing in &mut evaluation.timings {
            (timing.rendering_ms, timing.encoding_ms) = (vec![8.0, 9.0, 100.0], vec![3.0, 4.0, 50.0]);
            timing.inference_ms = vec![5.0, 6.5, 60.0];
        }
        let row = LeaderboardRow::new(&evaluation);
        assert_eq!(row.seeing(), Some(Seeing { rendering: 9.0, encoding: 4.0 }));
        let shown = cells(COLUMNS, [&row]).rows[0].join("|");
        assert!(shown.contains("|6.5 / 60.0\nencoding 4.0\nrendering +9.0|"), "{shown}");
        assert!(csv::table(COLUMNS, [&row]).trim_end().ends_with(",9.000,4.000"));
        assert!(
            row.summary().contains("9.0 ms of rendering before it, 6.5 ms of its own: 4.0 of encoding, 2.5 of policy")
        );
    }

    #[test]
    fn progress_is_shown_where_every_episode_says_it() {
        let dir = tempfile::tempdir().unwrap();
        let mut evaluation = finished(dir.path(), &sample("staged", 1, 20));
        assert_eq!(LeaderboardRow::new(&evaluation).progress, None);
        // 16 of 20 succeed, the others came half of the way
        for episode in &mut evaluation.episodes {
            episode.progress = Some(if episode.success { 1.0 } else { 0.5 });
        }
        let row = LeaderboardRow::new(&evaluation);
        let progress = row.progress.unwrap();
        assert!((progress.value - 0.9).abs() < 1e-12 && progress.low < 0.9 && progress.high > 0.9, "{progress:?}");
        assert!(cells(COLUMNS, [&row]).rows[0].iter().any(|cell| cell.starts_with("90% [")));
        assert!(row.summary().contains(", mean progress 90.0%"), "{}", row.summary());
        let mut further = evaluation.clone();
        for (k, episode) in further.episodes.iter_mut().enumerate() {
            episode.progress = Some(if episode.success || k % 2 == 0 { 1.0 } else { 0.75 });
        }
        let found = crate::comparison::compare_progress(&LeaderboardRow::new(&further), &row).unwrap();
        // two of the four failures came all of the way instead of half, two came a quarter further
        let gained = further.episodes.iter().zip(&evaluation.episodes);
        let gained: f64 = gained.map(|(a, b)| a.progress.unwrap() - b.progress.unwrap()).sum::<f64>() / 20.0;
        assert!(gained > 0.0 && (found.estimate.value - gained).abs() < 1e-12, "{found:?}");
        evaluation.episodes[3].progress = None;
        let row = LeaderboardRow::new(&evaluation);
        assert_eq!((row.progress, row.progress_text(0).as_str()), (None, "-"));
        assert!(crate::comparison::compare_progress(&row, &LeaderboardRow::new(&further)).is_none());
    }

    /// docs/reference/leaderboard.md says what each column of the CSV is, in their order.
    #[test]
    fn every_column_of_the_csv_is_documented() {
        let page = include_str!("../../../../docs/reference/leaderboard.md");
        let told: Vec<&str> = page.lines().filter_map(|line| line.strip_prefix("| `")?.split('`').next()).collect();
        let names: Vec<&str> = COLUMNS.iter().filter_map(crate::column::Column::csv_name).collect();
        assert_eq!(told, names);
    }

    #[test]
    fn groups_are_counted_apart() {
        let dir = tempfile::tempdir().unwrap();
        let mut evaluation = finished(dir.path(), &sample("color", 1, 20));
        for (k, episode) in evaluation.episodes.iter_mut().enumerate() {
            episode.group = Some(if k < 15 { "seen" } else { "unseen" }.to_owned());
        }
        let row = LeaderboardRow::new(&evaluation);
        // the sample fails for every fifth seed
        assert_eq!(row.groups_text(), "seen 12/15, unseen 4/5");
        assert_eq!(cells(COLUMNS, [&row]).rows[0][3], "16/20\nseen 12/15\nunseen 4/5");
        assert!(markdown::table(COLUMNS, [&row]).contains(" | 16/20<br>seen 12/15<br>unseen 4/5 | "));
        assert!(csv::table(COLUMNS, [&row]).trim_end().ends_with(",\"seen 12/15, unseen 4/5\",,,,,,,"));
        assert!(!row.summary().contains(" in "), "{}", row.summary());
        for (k, episode) in evaluation.episodes.iter_mut().enumerate().filter(|(_, episode)| !episode.success) {
            episode.failure = Some(if k < 5 { "late" } else { "wrong" }.to_owned());
        }
        let summary = LeaderboardRow::new(&evaluation).summary();
        assert!(summary.contains("late in 1, wrong in 2\n") && summary.ends_with(", wrong in 1"), "{summary}");
    }

    #[test]
    fn rates_are_derived_from_counts() {
        let dir = tempfile::tempdir().unwrap();
        let rows = board(dir.path());
        let row = rows.iter().find(|row| row.record().entry.to_string() == "lift-act@1").unwrap();
        // the sample fails for every fifth seed
        assert_eq!((row.counts.successes, row.counts.episodes), (16, 20));
        assert_eq!(row.counts.rate(), 0.8);
        assert_eq!(row.mean_return(), Some(0.8));
        let steps: u64 = (10_000..10_020).filter(|s| s % 5 != 0).map(|s| 40 + s % 7).sum();
        assert_eq!(row.mean_steps_to_success(), Some(steps as f64 / 16.0));
        let none = rows.iter().find(|row| row.task() == "Stack").unwrap();
        assert_eq!((none.counts.successes, none.mean_steps_to_success()), (0, None));
    }

    /// `name@1`, trained with `seed`, of the family `key`; `won` of 40 episodes succeed, the first ones.
    fn trained(folder: &std::path::Path, name: &str, seed: u64, won: usize) -> StoredEvaluation {
        let mut record = sample(name, 1, 40);
        record.training.seed = seed;
        let mut stored = finished(folder, &record);
        stored.episodes.iter_mut().enumerate().for_each(|(k, episode)| episode.success = k < won);
        stored
    }

    #[test]
    fn a_family_is_one_row_with_each_training_in_the_details() {
        let dir = tempfile::tempdir().unwrap();
        let all = [
            trained(dir.path(), "lift-act-s2", 2, 30),
            trained(dir.path(), "lift-act-s10", 10, 20),
            trained(dir.path(), "lift-act-s1", 1, 36),
            trained(dir.path(), "other", 1, 5),
        ];
        let mut reading = Reading::default();
        for name in ["lift-act-s1", "lift-act-s2", "lift-act-s10"] {
            reading.families.insert(name, 1, "key".to_owned());
        }
        let rows = super::rank(&all, &reading);
        let names: Vec<String> = rows.iter().map(LeaderboardRow::name).collect();
        assert_eq!(names, ["lift-act-s*@1", "other@1"]);
        let row = &rows[0];
        assert_eq!((row.n_trainings(), row.counts), (3, Counts { successes: 86, episodes: 120 }));
        assert_eq!((row.median_rate(), row.each_text(" ").as_str()), (0.75, "36 30 20"));
        // wider than the episodes alone would have it
        let (low, high) = row.counts.interval();
        assert!(row.interval.0 < low && high < row.interval.1, "{:?}", row.interval);
        assert!(row.rate_text().contains("\n3 trainings, median 75%"), "{}", row.rate_text());
        let details: Vec<(String, u64)> = row.details().iter().map(|one| (one.name(), one.counts.successes)).collect();
        assert_eq!(
            details,
            [("lift-act-s1@1", 36), ("lift-act-s2@1", 30), ("lift-act-s10@1", 20)].map(|(n, k)| (n.to_owned(), k))
        );
        let line = csv::table(COLUMNS, &rows).lines().nth(1).unwrap().to_owned();
        assert!(
            line.starts_with("lift-act-s,1,act,Lift,") && line.contains(",3,86,120,36 30 20,0.7167,0.7500,"),
            "{line}"
        );
        // versions of one name that differ in their seed
        let mut versions = all[..2].to_vec();
        for (k, version) in versions.iter_mut().enumerate() {
            version.record.entry.name = "lift-act".to_owned();
            version.record.entry.version = 2 - k as u32;
            reading.families.insert("lift-act", 2 - k as u32, "another".to_owned());
        }
        assert_eq!(super::rank(&versions, &reading)[0].name(), "lift-act@2,1");
        // trainings on other seeds are rows of their own
        let mut other = all[0].clone();
        other.record.seeds = Seeds { start: 20_000, count: 40 };
        assert_eq!(super::rank(&[all[2].clone(), other], &reading).len(), 2);
    }

    #[test]
    fn what_cannot_be_told_apart_shares_a_letter() {
        let dir = tempfile::tempdir().unwrap();
        let all = [("a", 40), ("b", 38), ("c", 20), ("d", 19)].map(|(name, won)| trained(dir.path(), name, 1, won));
        let rows = rank(&all);
        let told: Vec<(String, String)> =
            rows.iter().map(|row| (row.name(), row.standing.clone().unwrap().letters)).collect();
        let expected = [("a@1", "a"), ("b@1", "a"), ("c@1", "b"), ("d@1", "b")];
        assert_eq!(told, expected.map(|(name, letter)| (name.to_owned(), letter.to_owned())));
        assert_eq!(rows[1].standing.as_ref().unwrap().ranks, (1, 2));
        assert_eq!(rows[3].standing.as_ref().unwrap().ranks, (3, 4));
    }

    #[test]
    fn floors_and_ceilings_stand_in_the_table_without_a_rank() {
        let dir = tempfile::tempdir().unwrap();
        let mut all = [("learned", 20), ("random", 1), ("expert", 40), ("worse", 10)]
            .map(|(name, won)| trained(dir.path(), name, 1, won));
        all[1].record.training.policy = "random".to_owned();
        all[2].record.training.policy = "expert".to_owned();
        let rows = rank(&all);
        let told: Vec<(String, Option<u64>, &str)> =
            rows.iter().map(|row| (row.name(), row.rank, row.unranked_text())).collect();
        let expected = [
            ("expert@1", None, "ceiling"),
            ("learned@1", Some(1), ""),
            ("worse@1", Some(2), ""),
            ("random@1", None, "floor"),
        ];
        assert_eq!(told, expected.map(|(name, rank, word)| (name.to_owned(), rank, word)));
        assert!(rows[0].standing.is_none() && rows[1].standing.is_some());
    }

    #[test]
    fn blocks_of_a_protocol_are_told_apart_and_ranked_apart() {
        let dir = tempfile::tempdir().unwrap();
        let with = |name: &str, seeds: Seeds| {
            let mut record = sample(name, 1, seeds.count);
            record.seeds = seeds;
            record.protocol.control = rollout::Control::Compiled;
            finished(dir.path(), &record)
        };
        let (dev, test) = (Seeds { start: 10_000, count: 100 }, Seeds { start: 40_000, count: 200 });
        let all = [with("a", dev), with("a", test), with("b", test), with("a", Seeds { start: 10_000, count: 120 })];
        let reading = Reading { protocols: Protocols::built_in(), ..Reading::default() };
        let rows = super::rank(&all, &reading);
        let told: Vec<(String, String, Option<u64>)> =
            rows.iter().map(|row| (row.name(), row.protocol_text(), row.rank)).collect();
        let id = all[0].record.protocol.id();
        let expected = [
            ("a@1", id.as_str(), 1),
            ("a@1", "lift-v1 dev", 1),
            ("a@1", "lift-v1 test", 1),
            ("b@1", "lift-v1 test", 1),
        ];
        assert_eq!(told, expected.map(|(name, protocol, rank)| (name.to_owned(), protocol.to_owned(), Some(rank))));
        assert_eq!(rows[2].named, Some(("lift-v1".to_owned(), Block::Test)));
    }

    #[test]
    fn seeds_and_executions_of_one_entry_are_told_apart_beside_its_protocol() {
        let dir = tempfile::tempdir().unwrap();
        let with = |name: &str, start: u64, n_action_steps: usize| {
            let mut record = sample(name, 1, 40);
            record.seeds.start = start;
            record.execution = zoo::results::Execution::RecedingHorizon { n_action_steps };
            finished(dir.path(), &record)
        };
        let rows = rank(&[with("a", 100, 8), with("a", 900, 8), with("a", 900, 1), with("b", 100, 8)]);
        let mut told: Vec<(String, String)> = rows.iter().map(|row| (row.name(), row.apart.clone())).collect();
        told.sort();
        let expected = [
            ("a@1", "seeds 100-139, 8 steps"),
            ("a@1", "seeds 900-939, 1 steps"),
            ("a@1", "seeds 900-939, 8 steps"),
            ("b@1", ""),
        ];
        assert_eq!(told, expected.map(|(name, apart)| (name.to_owned(), apart.to_owned())));
        let table = crate::markdown::table(COLUMNS, &rows);
        assert!(table.contains("seeds 900-939, 1 steps"), "{table}");
    }

    #[test]
    fn simulators_of_other_versions_are_ranked_apart_and_told_apart() {
        let dir = tempfile::tempdir().unwrap();
        let with = |name: &str, package: &str, version: &str| {
            let mut record = sample(name, 1, 40);
            record.versions.insert(package.to_owned(), version.to_owned());
            finished(dir.path(), &record)
        };
        let all = [with("a", "mujoco", "3.2.7"), with("a", "python", "3.11.7"), with("b", "python", "3.11.9")];
        let rows = rank(&all);
        let told: Vec<(String, String, Option<u64>)> =
            rows.iter().map(|row| (row.name(), row.protocol_text(), row.rank)).collect();
        let id = all[0].record.protocol.id();
        // Python's own version moves no simulated body: the same table
        let expected = [("a@1", "mujoco 3.2.7"), ("a@1", "mujoco 3.3.7"), ("b@1", "mujoco 3.3.7")]
            .map(|(name, simulator)| (name.to_owned(), format!("{id} {simulator}"), Some(1)));
        assert_eq!(told, expected);
        assert_eq!(rank(&all[1..])[0].protocol_text(), id, "where all are alike nothing is said");
    }

    #[test]
    fn another_simulator_under_the_same_version_is_ranked_apart_and_told_apart() {
        let dir = tempfile::tempdir().unwrap();
        let with = |name: &str, sum: Option<&str>| {
            let mut record = sample(name, 1, 40);
            record.sources.extend(sum.map(|sum| ("robosuite".to_owned(), sum.to_owned())));
            finished(dir.path(), &record)
        };
        let shadow = "1".repeat(64);
        let all = [with("a", None), with("a", Some(&shadow)), with("b", None)];
        let id = all[0].record.protocol.id();
        let rows = rank(&all);
        let told: Vec<(String, String, Option<u64>)> =
            rows.iter().map(|row| (row.name(), row.protocol_text(), row.rank)).collect();
        let expected = [
            ("a@1", "robosuite 1.5.2", Some(1)),
            ("b@1", "robosuite 1.5.2", Some(1)),
            ("a@1", "robosuite 1.5.2 (sources 11111111)", Some(1)),
        ];
        assert_eq!(told, expected.map(|(name, text, rank)| (name.to_owned(), format!("{id} {text}"), rank)));
        // trainings of one family are no one row where one of them ran on another simulator
        let mut reading = Reading::default();
        let family = [("c-s1", None), ("c-s2", Some(shadow.as_str()))].map(|(name, sum)| {
            reading.families.insert(name, 1, "c".to_owned());
            with(name, sum)
        });
        assert_eq!(super::rank(&family, &reading).iter().map(|row| row.each().len()).collect::<Vec<_>>(), [1, 1]);
    }

    #[test]
    fn one_entry_drawn_by_two_renderers_is_not_two_trainings() {
        let dir = tempfile::tempdir().unwrap();
        let by = |name: &str, renderer: Option<&str>| {
            let mut record = sample(name, 1, 40);
            record.renderer = renderer.map(str::to_owned);
            finished(dir.path(), &record)
        };
        let all = [by("a", Some("llvmpipe (LLVM 15.0.6), OpenGL 4.5")), by("a", Some("a GPU")), by("b", Some("a GPU"))];
        let mut told: Vec<(String, String, usize)> =
            rank(&all).iter().map(|row| (row.name(), row.apart.clone(), row.each().len())).collect();
        told.sort();
        let expected = [("a@1", "drawn by a GPU", 1), ("a@1", "drawn by llvmpipe (LLVM 15.0.6)", 1), ("b@1", "", 1)];
        assert_eq!(told, expected.map(|(name, apart, count)| (name.to_owned(), apart.to_owned(), count)));
        // one of before, and another training of now: nothing says that they differ
        let mut reading = Reading::default();
        let family = ["c-s1", "c-s2"].map(|name| {
            reading.families.insert(name, 1, "c".to_owned());
            by(name, (name == "c-s2").then_some("a GPU"))
        });
        assert_eq!(super::rank(&family, &reading).iter().map(|row| row.each().len()).collect::<Vec<_>>(), [2]);
    }

    #[test]
    fn a_row_that_another_one_holds_is_left_out() {
        let dir = tempfile::tempdir().unwrap();
        let all = [10, 12, 30].map(|count| finished(dir.path(), &sample("a", 1, count)));
        let rows = rank(&all);
        assert_eq!(rows.iter().map(|row| row.counts.episodes).collect::<Vec<_>>(), [30]);
        // under other rules, or of another entry, it stays
        let mut other = all[0].clone();
        other.record.protocol.max_steps += 1;
        let another = finished(dir.path(), &sample("b", 1, 10));
        assert_eq!(rank(&[all[2].clone(), other, another]).len(), 3);
        // or drawn by another renderer
        let mut drawn = all[1].clone();
        drawn.record.renderer = Some("a GPU".to_owned());
        assert_eq!(rank(&[all[2].clone(), drawn]).len(), 2);
    }
}
