//! What linear probes decode from the latent reasoning, as a part of a study's page.

use std::collections::BTreeSet;
use std::fmt::Write as _;

use analysis::probe::{ProbeCell, ProbeResult};
use zoo::ZooError;

use super::folded;
use crate::robots::file::Study;

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
    if files.is_empty() {
        return Ok(());
    }
    let _ = writeln!(
        text,
        "## What a probe decodes from the latent reasoning\n\nA linear probe (`actrm-zoo probe`) predicts the colour of the cube after i \
         hops. It is fitted to the first frames of demonstrations, with colours renamed at random. It is tested on the first frames of new \
         episodes: those with chains as long as in the demonstrations, and longer ones (in brackets). Guessing is right one time in \
         twelve. An untrained network shows what the observation alone gives away.\n"
    );
    for path in files {
        let (result, mut part) = (ProbeResult::read(&path)?, String::new());
        let title = format!(
            "`{}`: {} demonstrations, {} renamings of each, new episodes of seeds {}",
            result.entry, result.demonstrations, result.renamings, result.seeds
        );
        for reading in &result.readings {
            let steps: BTreeSet<usize> = reading.cells.iter().map(|cell| cell.step).collect();
            let head = |cell: &ProbeCell| cell.hops.map_or("the end".to_owned(), |hops| format!("{hops} hops"));
            let of_step = |step: usize| reading.cells.iter().filter(move |cell| cell.step == step);
            let heads: Vec<String> = steps.first().map(|&step| of_step(step).map(head).collect()).unwrap_or_default();
            let _ = writeln!(part, "| {}, after step | {} |", reading.state, heads.join(" | "));
            let _ = writeln!(part, "|---|{}", "---|".repeat(heads.len()));
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
                let _ = writeln!(part, "| {step} | {} |", cells.join(" | "));
            }
            part.push('\n');
        }
        let counts: Vec<String> = result
            .readings
            .first()
            .map(|reading| reading.cells.iter().filter(|cell| cell.step == 1))
            .into_iter()
            .flatten()
            .map(|cell| format!("{} ({})", cell.of, cell.of_beyond))
            .collect();
        let _ = writeln!(part, "Episodes per column: {}.\n", counts.join(", "));
        folded(text, &title, &part);
    }
    Ok(())
}
