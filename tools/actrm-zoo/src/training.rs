//! What the commands that train show while they do.

use cli::{Screen, Stop, shown};
use zoo::run::{MetricsRow, TrainEvent};

/// Shows what a training tells: a bar with the last losses, lines above it.
pub fn show(event: &TrainEvent<'_>, screen: &mut Screen, stop: &Stop) {
    match event {
        TrainEvent::Folder(path) => screen.note(&format!("run folder: {}", shown(path))),
        TrainEvent::Converting(done, total) => screen.advance("convert")(*done, *total),
        TrainEvent::Note(note) => screen.note(&format!("note: {note}")),
        TrainEvent::Begin { from, steps, parameters, windows } => {
            // from here on there is a checkpoint to save first
            stop.wait_for_work(from < steps);
            screen.clear();
            let examples = match windows {
                0 => "puzzles drawn as they are needed".to_owned(),
                n => format!("{n} examples"),
            };
            screen.note(&format!("{parameters} parameters, {examples}, {steps} steps"));
            if *from > 0 {
                screen.note(&format!("resumed after step {from}"));
            }
            screen.begin_at("train", *from, *steps);
        }
        TrainEvent::Step(row) => {
            screen.at(row.step);
            // without numbers where a GPU is not waited for
            if !row.values.is_empty() {
                screen.message(&summary(row));
            }
        }
        TrainEvent::Saved(_) => stop.wait_for_work(!screen.is_full()),
    }
}

/// `loss 0.1234 (kld 0.0012, l1 0.1100) grad 1.2 lr 9.8e-4 580/s valid 0.0921`
fn summary(row: &MetricsRow) -> String {
    let value = |name: &str| row.values.get(name).copied();
    let named = ["loss", "grad_norm", "lr", "samples_per_s", "valid_loss"];
    let parts: Vec<String> = row
        .values
        .iter()
        .filter(|(name, _)| !named.contains(&name.as_str()))
        .map(|(name, x)| format!("{} {x:.4}", name.trim_end_matches("_loss")))
        .collect();
    let mut text = format!(
        "loss {:.4} ({}) grad {:.2} lr {:.1e}",
        value("loss").unwrap_or(f64::NAN),
        parts.join(", "),
        value("grad_norm").unwrap_or(f64::NAN),
        value("lr").unwrap_or(f64::NAN),
    );
    if let Some(rate) = value("samples_per_s") {
        text.push_str(&format!(" {rate:.0}/s"));
    }
    if let Some(valid) = value("valid_loss") {
        text.push_str(&format!(" valid {valid:.4}"));
    }
    text
}
