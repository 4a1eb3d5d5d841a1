//! The statistics of the leaderboard: everything that writes it walks this list.

use super::row::LeaderboardRow;
use crate::column::{Column, count, number, text};

/// The statistics of the leaderboard, in their order.
pub const COLUMNS: &[Column<LeaderboardRow>] = &[
    text(LeaderboardRow::name_lines).table("entry").page("entry").left().kept(),
    text(LeaderboardRow::stem).csv("entry"),
    text(|row: &LeaderboardRow| row.joined(|one| one.record.entry.version.to_string())).csv("version"),
    text(|row: &LeaderboardRow| row.policy().to_owned()).csv("policy").page("policy").left().more(),
    text(|row: &LeaderboardRow| row.task().to_owned()).csv("task").table("task").page("task").left().kept(),
    text(|row: &LeaderboardRow| row.record().protocol.id()).csv("protocol"),
    text(LeaderboardRow::protocol_lines).table("protocol").page("protocol").left().kept(),
    text(|row: &LeaderboardRow| row.counts.percent(1)).page("rate"),
    text(|row: &LeaderboardRow| format!("{}%", super::row::interval_text(row.interval, 1, '–'))).page("95% interval"),
    text(|row: &LeaderboardRow| row.named.as_ref().map_or(String::new(), |(name, _)| name.clone()))
        .csv("named_protocol"),
    text(|row: &LeaderboardRow| row.named.as_ref().map_or(String::new(), |(_, block)| block.to_string())).csv("block"),
    text(LeaderboardRow::execution_text).csv("execution"),
    count(|row: &LeaderboardRow| Some(row.n_trainings() as u64)).csv("trainings").page("trainings").more(),
    count(|row: &LeaderboardRow| Some(row.counts.successes)).csv("successes"),
    count(|row: &LeaderboardRow| Some(row.counts.episodes)).csv("episodes"),
    text(|row: &LeaderboardRow| row.each_text(" ")).csv("successes_each"),
    text(LeaderboardRow::success_text).table("success").kept(),
    text(LeaderboardRow::success_intervals_text).page("success").more(),
    number(|row: &LeaderboardRow| Some(row.counts.rate()), 4, 4).csv("success_rate"),
    number(|row: &LeaderboardRow| Some(row.median_rate()), 4, 4).csv("median_rate"),
    number(|row: &LeaderboardRow| Some(row.interval.0), 4, 4).csv("ci95_low"),
    number(|row: &LeaderboardRow| Some(row.interval.1), 4, 4).csv("ci95_high"),
    text(LeaderboardRow::rate_text).table("rate [95%]").kept(),
    count(|row: &LeaderboardRow| row.rank).csv("rank"),
    text(|row: &LeaderboardRow| row.rank.map_or(String::new(), |rank| rank.to_string())).table("rank").kept(),
    text(|row: &LeaderboardRow| row.rank.map_or(row.unranked_text().to_owned(), |rank| rank.to_string())).page("rank"),
    count(|row: &LeaderboardRow| Some(row.standing.as_ref()?.ranks.0 as u64)).csv("rank_first"),
    count(|row: &LeaderboardRow| Some(row.standing.as_ref()?.ranks.1 as u64)).csv("rank_last"),
    text(ranks_text).table("ranks").page("ranks").more(),
    text(letters).csv("letters").table("letters").page("letters"),
    text(|row: &LeaderboardRow| row.progress_text(0)).table("progress"),
    text(|row: &LeaderboardRow| row.progress_text(1)).page("progress").more(),
    number(LeaderboardRow::mean_return, 4, 2).csv("mean_return").table("return").page("return").more(),
    number(LeaderboardRow::mean_steps_to_success, 2, 1)
        .csv("mean_steps_to_success")
        .table("steps")
        .page("steps to success"),
    number(LeaderboardRow::median_steps_to_success, 1, 1).csv("median_steps_to_success").page("median steps").more(),
    count(|row: &LeaderboardRow| Some(row.record().training.parameters)).csv("parameters"),
    text(|row: &LeaderboardRow| count_text(row.record().training.parameters)).table("params").page("parameters"),
    number(|row: &LeaderboardRow| Some(row.inference_ms()?.0), 3, 3).csv("inference_ms_median"),
    number(|row: &LeaderboardRow| Some(row.inference_ms()?.1), 3, 3).csv("inference_ms_p95"),
    text(|row: &LeaderboardRow| row.inference_text(1)).table("ms med/p95"),
    text(|row: &LeaderboardRow| row.inference_text(2)).page("inference ms\nmedian / p95"),
    count(|row: &LeaderboardRow| Some(row.record().training.steps)).csv("training_steps"),
    number(|row: &LeaderboardRow| Some(row.minutes()), 2, 2).csv("training_minutes"),
    text(|row: &LeaderboardRow| row.trained_text(", ")).table("trained"),
    text(|row: &LeaderboardRow| row.trained_text("\n")).page("training").left().more(),
    text(|row: &LeaderboardRow| row.record().training.data_set.clone()).csv("data_set"),
    count(|row: &LeaderboardRow| Some(row.record().training.demos)).csv("demos"),
    text(|row: &LeaderboardRow| format!("{} {}", row.record().training.demos, row.record().training.data_set))
        .table("demos"),
    text(|row: &LeaderboardRow| format!("{}\n{} demos", row.record().training.data_set, row.record().training.demos))
        .page("data")
        .left()
        .more(),
    text(LeaderboardRow::versions_text).csv("versions"),
    text(LeaderboardRow::seeds_text).csv("seeds").table("seeds").page("seeds").more(),
    text(|row: &LeaderboardRow| row.joined(|one| one.record.training.seed.to_string())).csv("training_seed"),
    text(|row: &LeaderboardRow| row.joined(|one| one.record.entry.hash.clone())).csv("entry_hash"),
    text(|row: &LeaderboardRow| row.record().training.data_fingerprint.clone()).csv("data_fingerprint"),
    text(LeaderboardRow::groups_text).csv("groups"),
    text(|row: &LeaderboardRow| row.family.as_ref().map_or(String::new(), |key| key.chars().take(12).collect()))
        .csv("family"),
    // columns of the CSV that came later stand at its end
    number(|row: &LeaderboardRow| Some(row.progress?.value), 4, 4).csv("progress"),
    number(|row: &LeaderboardRow| Some(row.progress?.low), 4, 4).csv("progress_ci95_low"),
    number(|row: &LeaderboardRow| Some(row.progress?.high), 4, 4).csv("progress_ci95_high"),
    text(|row: &LeaderboardRow| row.cameras.join(" ")).csv("cameras"),
    number(|row: &LeaderboardRow| Some(row.seeing()?.rendering), 3, 3).csv("rendering_ms_median"),
    number(|row: &LeaderboardRow| Some(row.seeing()?.encoding), 3, 3).csv("encoding_ms_median"),
];

/// `1-3`: the ranks that it may have.
fn ranks_text(row: &LeaderboardRow) -> String {
    match row.standing.as_ref().map(|standing| standing.ranks) {
        Some((first, last)) if first == last => first.to_string(),
        Some((first, last)) => format!("{first}-{last}"),
        None => String::new(),
    }
}

fn letters(row: &LeaderboardRow) -> String {
    row.standing.as_ref().map_or(String::new(), |standing| standing.letters.clone())
}

/// `9,922` stays as it is, `1500000` becomes `1.50M`.
pub fn count_text(count: u64) -> String {
    match count {
        0..100_000 => count.to_string(),
        100_000..1_000_000 => format!("{}k", (count + 500) / 1000),
        _ => format!("{:.2}M", count as f64 / 1e6),
    }
}
