//! How many puzzles a second one core makes: a table on standard output, `target/bench/puzzles.json` beside it.
//!
//! There is no peer to put beside these; the bars are what training needs so that making puzzles never limits it.

use std::hint::black_box;
use std::time::Instant;

use puzzles::{MazeTask, PuzzleRng, Split, SudokuTask};

/// Puzzles a second, over at least half a second.
fn rate(mut make: impl FnMut(&mut PuzzleRng)) -> f64 {
    let mut rng = PuzzleRng::new(1, 0);
    let begin = Instant::now();
    let mut made = 0.0;
    while begin.elapsed().as_secs_f64() < 0.5 {
        for _ in 0..10 {
            make(&mut rng);
        }
        made += 10.0;
    }
    made / begin.elapsed().as_secs_f64()
}

fn main() -> std::io::Result<()> {
    let mut rows = Vec::new();
    for (name, task) in MazeTask::ALL {
        rows.push((name.to_owned(), rate(|rng| drop(black_box(task.draw(rng)))), 100_000.0));
    }
    for (name, task, givens, bar) in [
        ("sudoku4", SudokuTask::FOUR, 6, 100_000.0),
        ("sudoku6", SudokuTask::SIX, 14, f64::NAN),
        ("sudoku9, 36 givens", SudokuTask::NINE, 36, 1_000.0),
        ("sudoku9, 30 givens", SudokuTask::NINE, 30, 1_000.0),
    ] {
        rows.push((name.to_owned(), rate(|rng| drop(black_box(task.draw_from(Split::Train, givens, rng)))), bar));
    }
    println!("{:<24} {:>14} {:>12}", "puzzles/s on one core", "ours", "bar");
    let mut json = Vec::new();
    for (name, rate, bar) in rows {
        let bar = if bar.is_nan() { "null".to_owned() } else { format!("{bar:.0}") };
        println!("{name:<24} {rate:>14.0} {bar:>12}");
        json.push(format!("{{\"work\":\"{name}\",\"per_second\":{rate:.1},\"bar\":{bar}}}"));
    }
    std::fs::create_dir_all("target/bench")?;
    std::fs::write("target/bench/puzzles.json", format!("[{}]\n", json.join(",")))
}
