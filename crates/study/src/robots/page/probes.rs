//! What linear probes read from thoughts, as a part of a study's page.

use std::collections::BTreeSet;
use std::fmt::Write as _;

use zoo::ZooError;
use zoo::probe::{ProbeCell, ProbeResult};

use crate::robots::file::{Study, Test};

/// The section, from the files `probe_*.json` of the study's results.
pub(super) fn probes(text: &mut String, study: &Study) -> Result<(), ZooError> {
    let failed = |source| ZooError::Io { operation: "read folder", path: study.results.clone(), source };
    let mut files = Vec::new();
    if study.results.is_dir() {
        for entry in std::fs::read_dir(&study.results).map_err(failed)? {
            let path = entry.map_err(failed)?.path();
            if path.file_name().and_then(|name| name.to_str()).is_some_and(|name| name.starts_with("probe_")) {
                files.push(path);
            }
        }
    }
    files.sort();
    // the probe reads chains off thoughts: a study that asks nothing about thoughts on them misses none
    let asks = |test: &Test| test.task == "PickChain" && test.thinking_words().is_some();
    if files.is_empty() && !study.tests.values().any(asks) {
        return Ok(());
    }
    let _ = writeln!(
        text,
        "## What can be read from a thought\n\nA linear probe (`actrm-zoo probe`): which cube, by its colour, is it after i hops? \
         Fitted to how demonstrations begin, with their colours renamed at random; read on the beginnings of fresh episodes whose \
         chains have at least i hops, those as long as demonstrations have them, and (in brackets) longer ones. A guess is right \
         one time in twelve; what an untrained network shows is what the observation gives away.\n"
    );
    if files.is_empty() {
        let _ = writeln!(text, "Not run.\n");
    }
    for path in files {
        let result = ProbeResult::read(&path)?;
        let _ = writeln!(
            text,
            "`{}`, {} demonstrations shown {} times each, fresh episodes of seeds {}:\n",
            result.entry, result.demonstrations, result.renamings, result.seeds
        );
        for reading in &result.readings {
            let steps: BTreeSet<usize> = reading.cells.iter().map(|cell| cell.step).collect();
            let head = |cell: &ProbeCell| cell.hops.map_or("the end".to_owned(), |hops| format!("{hops} hops"));
            let of_step = |step: usize| reading.cells.iter().filter(move |cell| cell.step == step);
            let heads: Vec<String> = steps.first().map(|&step| of_step(step).map(head).collect()).unwrap_or_default();
            let _ = writeln!(text, "| {}, after step | {} |", reading.state, heads.join(" | "));
            let _ = writeln!(text, "|---|{}", "---|".repeat(heads.len()));
            for step in steps {
                let cells: Vec<String> = of_step(step)
                    .map(|cell| {
                        let share = |right: u64, of: u64| match of {
                            0 => "-".to_owned(),
                            _ => format!("{:.0}%", 100.0 * right as f64 / of as f64),
                        };
                        format!("{} ({})", share(cell.right, cell.of), share(cell.right_beyond, cell.of_beyond))
                    })
                    .collect();
                let _ = writeln!(text, "| {step} | {} |", cells.join(" | "));
            }
            text.push('\n');
        }
        let counts: Vec<String> = result
            .readings
            .first()
            .map(|reading| reading.cells.iter().filter(|cell| cell.step == 1))
            .into_iter()
            .flatten()
            .map(|cell| format!("{} ({})", cell.of, cell.of_beyond))
            .collect();
        let _ = writeln!(text, "Episodes behind the columns: {}.\n", counts.join(", "));
    }
    Ok(())
}
