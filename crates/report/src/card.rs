//! What the evaluations of an entry say in its model card on the Hugging Face Hub: `model-index`.

use std::fmt::Write as _;

use serde_json::{Value, json};

use crate::LeaderboardRow;
use crate::leaderboard::interval_text;

/// The YAML of `model-index` for the entry called `name`, a result a row; empty without rows. Rates and their 95% intervals
/// are in percent.
///
/// The environment stands where the Hub expects a data set, as cards of reinforcement learning have it; the named protocol
/// is its configuration and the block of seeds its split.
pub fn model_index(name: &str, rows: &[LeaderboardRow]) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let mut text = String::new();
    write(name, rows, &mut text).expect("writing into a String cannot fail");
    text
}

fn write(name: &str, rows: &[LeaderboardRow], text: &mut String) -> std::fmt::Result {
    // strings of JSON are strings of YAML
    let quoted = |word: &str| Value::from(word).to_string();
    writeln!(text, "model-index:\n- name: {}\n  results:", quoted(name))?;
    for row in rows {
        let record = row.record();
        let (config, split) = match &row.named {
            Some((protocol, block)) => (protocol.clone(), block.to_string()),
            None => (record.protocol.id(), format!("seeds {}", record.seeds)),
        };
        let task = quoted(row.task());
        writeln!(text, "  - task:\n      type: robotics\n      name: {task}")?;
        writeln!(text, "    dataset:\n      type: {task}\n      name: {task}")?;
        writeln!(text, "      config: {}\n      split: {}", quoted(&config), quoted(&split))?;
        let args = json!({
            "seeds": record.seeds.to_string(), "max_steps": record.protocol.max_steps,
            "control": record.protocol.control.to_string(), "versions": record.versions,
        });
        writeln!(text, "      args: {args}")?;
        let percents = [row.interval.0, row.interval.1].map(rounded);
        let counts = row.counts;
        let label = format!("success rate in % (95% interval {})", interval_text(row.interval, 1, '-'));
        writeln!(text, "    metrics:\n    - type: success_rate\n      name: {}", quoted(&label))?;
        writeln!(text, "      value: {}", Value::from(rounded(counts.rate())))?;
        let args = json!({"successes": counts.successes, "episodes": counts.episodes, "interval_95": percents});
        writeln!(text, "      args: {args}")?;
    }
    Ok(())
}

/// A share in percent, to two decimals.
fn rounded(share: f64) -> f64 {
    (share * 1e4).round() / 1e2
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use zoo::results::testing::{finished, sample};

    #[test]
    fn a_row_is_a_result_with_its_interval() {
        let folder = tempfile::tempdir().unwrap();
        let row = LeaderboardRow::new(&finished(folder.path(), &sample("lift-act", 1, 20)));
        let text = model_index("lift-act@1", &[row]);
        for line in [
            "model-index:\n- name: \"lift-act@1\"\n  results:\n  - task:\n      type: robotics\n      name: \"Lift\"\n",
            "    metrics:\n    - type: success_rate\n      name: \"success rate in % (95% interval 58.4-91.9)\"\n      value: 80.0\n",
            "      args: {\"episodes\":20,\"interval_95\":[58.4,91.93],\"successes\":16}\n",
            "      split: \"seeds 10000-10019\"\n",
        ] {
            assert!(text.contains(line), "{line}\nin\n{text}");
        }
        assert_eq!(model_index("lift-act@1", &[]), "");
    }
}
