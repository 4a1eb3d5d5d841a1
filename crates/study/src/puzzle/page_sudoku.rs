//! The page's section on 9×9 Sudoku of few givens: accuracy against weights and processor seconds, and by the effort that a
//! search has.

use std::fmt::Write as _;

use super::evaluation::PuzzleEvaluation;
use super::grade::EffortBand;
use super::page::{mean, model, percent, spread};
use super::study::TestedRow as Row;

const HEAD: &str = "
### 9x9 Sudoku of few givens, and what it costs

`sudoku9-hard` are our own puzzles, rated by search effort. From a solved grid of sudoku9 as few cells are given as asked, or as few as leave
one solution. Thirty times some cells are then added and others removed; the result is kept if a search needs no fewer guesses. The
search fills in the only digit of a cell and the only cell of a digit. Otherwise it guesses in a cell with the fewest candidates; all
guesses are tried and counted. Where 17 givens are asked, grids have 21 to 26.

Models answer after up to 16 steps, hard puzzles after up to 64. *Views*: eight symmetric views with renamed digits, up to 64 steps each,
majority vote. The table shows the mean over trainings. Bold: no other row is better in weights, processor seconds and that column at
once (the cheaper one wins ties).

";

/// One column of the table: what is asked.
struct Asked {
    title: &'static str,
    rated: bool,
    givens: usize,
    views: u64,
}

const ASKED: [Asked; 9] = [
    Asked { title: "36 givens", rated: false, givens: 36, views: 1 },
    Asked { title: "30 givens", rated: false, givens: 30, views: 1 },
    Asked { title: "30, views", rated: false, givens: 30, views: 8 },
    Asked { title: "hard, 30", rated: true, givens: 30, views: 1 },
    Asked { title: "hard, 30, views", rated: true, givens: 30, views: 8 },
    Asked { title: "hard, 24", rated: true, givens: 24, views: 1 },
    Asked { title: "hard, 24, views", rated: true, givens: 24, views: 8 },
    Asked { title: "hard, fewest", rated: true, givens: 17, views: 1 },
    Asked { title: "hard, fewest, views", rated: true, givens: 17, views: 8 },
];

/// What a model costs, and the share it has right of each column's puzzles, if that was tested.
struct Priced {
    name: &'static str,
    parameters: u64,
    cpu: f64,
    trainings: usize,
    right: Vec<Option<f64>>,
}

impl Priced {
    /// Whether it costs no more than `other`, has no fewer right in a column, and is not the same in all.
    fn beats(&self, other: &Self, column: usize) -> bool {
        let (Some(mine), Some(its)) = (self.right[column], other.right[column]) else { return false };
        let no_worse = self.parameters <= other.parameters && self.cpu <= other.cpu && mine >= its;
        no_worse && (self.parameters < other.parameters || self.cpu < other.cpu || mine > its)
    }
}

fn right(results: &[PuzzleEvaluation]) -> f64 {
    mean(results.iter().map(|r| r.answers.share(r.answers.valid)))
}

/// The section for the rows of the study: `plain` tests, `further` ones and those of `rated` puzzles.
pub(super) fn section(plain: &[Row], further: &[Row], rated: &[Row]) -> String {
    let nine = |row: &&Row| row.0.experiment.ends_with("_sudoku9");
    let mut names: Vec<&'static str> = Vec::new();
    for (row, ..) in rated.iter().filter(nine) {
        if !names.contains(&row.experiment) {
            names.push(row.experiment);
        }
    }
    let all: Vec<&Row> = plain.iter().chain(further).chain(rated).filter(nine).collect();
    let mut text = String::from(HEAD);
    text.push_str(&prices(&names, &all));
    text.push_str("\nRight by the guesses of a search, all trainings together:\n\n");
    text.push_str(&efforts(rated));
    text
}

fn prices(names: &[&'static str], all: &[&Row]) -> String {
    let mut text = String::from("| model | weights | trainings | CPU s |");
    for asked in &ASKED {
        let _ = write!(text, " {} |", asked.title);
    }
    text.push_str("\n|---|---|---|---|");
    text.push_str(&"---|".repeat(ASKED.len()));
    text.push('\n');
    let priced: Vec<Priced> = names.iter().filter_map(|name| price(name, all)).collect();
    for name in names {
        let Some(its) = priced.iter().find(|its| its.name == *name) else { continue };
        let _ = write!(text, "| {} | {} | {} | {:.0} |", short(name), its.parameters, its.trainings, its.cpu);
        for (column, right) in its.right.iter().enumerate() {
            let text = &mut text;
            let _ = match right {
                None => write!(text, " – |"),
                Some(right) if priced.iter().any(|other| other.beats(its, column)) => {
                    write!(text, " {} |", percent(*right))
                }
                Some(right) => write!(text, " **{}** |", percent(*right)),
            };
        }
        text.push('\n');
    }
    text
}

/// What experiment `name` costs and reaches, if any of it was run.
fn price(name: &'static str, all: &[&Row]) -> Option<Priced> {
    let its: Vec<&&Row> =
        all.iter().filter(|(row, _, results)| row.experiment == name && !results.is_empty()).collect();
    let first = its.first()?.2.first()?;
    let of = |asked: &Asked| {
        let found = its.iter().find(|(_, test, results)| {
            (test.is_rated(), test.views, results[0].givens) == (asked.rated, asked.views, asked.givens)
        });
        found.map(|(.., results)| right(results))
    };
    let trainings = its.iter().map(|(.., results)| results.len()).max()?;
    let cpu = its.iter().map(|(.., results)| results).max_by_key(|results| results.len())?;
    Some(Priced {
        name,
        parameters: first.training.parameters,
        cpu: mean(cpu.iter().map(|r| r.cpu_seconds)),
        trainings,
        right: ASKED.iter().map(of).collect(),
    })
}

fn short(name: &'static str) -> &'static str {
    name.rsplit_once('_').map_or(name, |(model, _)| model)
}

fn efforts(rated: &[Row]) -> String {
    let mut text = String::from("| model | puzzles | trainings | givens |");
    let from = EffortBand::FROM;
    for (place, first) in from.iter().enumerate() {
        let _ = match from.get(place + 1) {
            Some(next) if next - first == 1 => write!(text, " {first} |"),
            Some(next) => write!(text, " {first}-{} |", next - 1),
            None => write!(text, " {first} and more |"),
        };
    }
    text.push_str(" all |\n|---|---|---|---|");
    text.push_str(&"---|".repeat(from.len() + 1));
    text.push('\n');
    for (row, test, results) in rated {
        let views = if test.views == 1 { "" } else { ", views" };
        let givens = match test.givens {
            Some(17) => "fewest".to_owned(),
            givens => format!("{} givens", givens.unwrap_or_default()),
        };
        let _ = write!(text, "| {} | hard, {givens}{views} |", model(row));
        let bands = || results.iter().flat_map(|r| &r.by_effort);
        let (cells, puzzles) = bands().fold((0, 0), |(g, n), band| (g + band.givens, n + band.puzzles));
        let _ = write!(text, " {} | {:.1} |", results.len(), cells as f64 / puzzles.max(1) as f64);
        for first in from {
            let mine = bands().filter(|band| band.guesses_from == first);
            let (valid, of) = mine.fold((0, 0), |(v, n), band| (v + band.valid, n + band.puzzles));
            let _ = match of {
                0 => write!(text, " - |"),
                of => write!(text, " {}<br>{valid} of {of} |", percent(valid as f64 / of as f64)),
            };
        }
        let _ = writeln!(text, " {} |", spread(results, |r| (r.answers.valid, r.answers.puzzles)));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn priced(parameters: u64, cpu: f64, right: f64) -> Priced {
        Priced { name: "trm_sudoku9", parameters, cpu, trainings: 1, right: vec![Some(right), None] }
    }

    #[test]
    fn what_is_cheaper_and_no_worse_beats() {
        let base = priced(100, 10.0, 0.5);
        assert!(priced(100, 9.0, 0.5).beats(&base, 0) && priced(90, 10.0, 0.6).beats(&base, 0));
        assert!(!priced(90, 11.0, 0.6).beats(&base, 0) && !priced(100, 10.0, 0.5).beats(&base, 0));
        assert!(!priced(1, 1.0, 0.4).beats(&base, 0) && !priced(1, 1.0, 1.0).beats(&base, 1), "not tested there");
    }
}
