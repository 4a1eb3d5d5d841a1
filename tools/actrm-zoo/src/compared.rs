//! What `compare` says of two runs; results that other programs measured, beside each other and beside sealed ones.

use std::path::Path;

use anyhow::{Context, bail};
use cli::shown;
use report::comparison::{Comparison, Flips, compare_runs};
use report::others::{By, Run, parse};
use report::statistics::{Bet, Unpaired};
use report::{Counts, LeaderboardRow, percent};
use serde_json::{Value, json};

/// One side of a comparison: a run and where it comes from.
pub struct Side {
    run: Run,
    /// the file; none of a sealed result
    file: Option<String>,
}

/// Whether `text` means a file of results: `FILE` or `FILE:POLICY`.
pub fn is_file(text: &str) -> bool {
    split(text).is_some()
}

/// The file and the policy in it that is meant.
fn split(text: &str) -> Option<(&Path, Option<&str>)> {
    let named = text.rsplit_once(':').map(|(file, policy)| (Path::new(file), Some(policy)));
    let is_file = |path: &Path| path.is_file() || path.extension().is_some_and(|end| end == "csv" || end == "json");
    [Some((Path::new(text), None)), named].into_iter().flatten().find(|(path, _)| is_file(path))
}

impl Side {
    /// The runs of a file, one for each task.
    ///
    /// # Errors
    /// A file that cannot be read; several policies, or another one than is asked for.
    pub fn of_file(text: &str) -> anyhow::Result<Vec<Self>> {
        let Some((path, policy)) = split(text) else { bail!("{text}: expected a file of results") };
        let file = shown(path);
        let mut runs = parse(&file, &std::fs::read_to_string(path).with_context(|| format!("cannot read {file}"))?)?;
        let mut policies: Vec<String> = runs.iter().map(|run| run.policy.clone()).collect();
        policies.sort();
        policies.dedup();
        match policy {
            Some(policy) => runs.retain(|run| run.policy == policy),
            None if policies.len() > 1 => {
                bail!("{file}: expected one policy, found {}; name one as {file}:POLICY", policies.join(", "))
            }
            None => {}
        }
        if runs.is_empty() {
            bail!("{text}: no such policy; {file} has {}", policies.join(", "));
        }
        for run in &runs {
            if run.partial {
                cli::note(&format!("note: {file}: task {}: the file says that episodes are missing", run.task));
            }
            if run.errors > 0 {
                let (task, errors) = (&run.task, run.errors);
                cli::note(&format!(
                    "note: {file}: task {task}: {errors} episodes ended with an error and count as failures"
                ));
            }
        }
        Ok(runs.into_iter().map(|run| Self { run, file: Some(file.clone()) }).collect())
    }

    /// A sealed row of one training.
    ///
    /// # Errors
    /// A row of several trainings.
    pub fn of_row(row: &LeaderboardRow) -> anyhow::Result<Self> {
        if row.n_trainings() > 1 {
            bail!("{}: expected one training beside a file of results, found {}", row.name(), row.n_trainings());
        }
        let episodes = row.evaluations().flat_map(|one| &one.episodes);
        let run = Run {
            task: row.task().to_owned(),
            policy: row.name(),
            by: By::Seed,
            outcomes: episodes.map(|episode| (episode.seed, episode.success)).collect(),
            errors: 0,
            partial: false,
        };
        Ok(Self { run, file: None })
    }

    /// What a reader has to know it by.
    fn name(&self) -> String {
        self.run.policy.clone()
    }

    fn counts(&self) -> Counts {
        let successes = self.run.outcomes.values().filter(|success| **success).count() as u64;
        Counts { successes, episodes: self.run.outcomes.len() as u64 }
    }

    fn seal_text(&self) -> String {
        self.file.as_ref().map_or("sealed".to_owned(), |file| format!("from {file}, not sealed"))
    }

    fn json(&self) -> Value {
        let Counts { successes, episodes } = self.counts();
        json!({
            "name": self.name(), "successes": successes, "episodes": episodes, "sealed": self.file.is_none(),
            "file": self.file, "errors": self.run.errors,
        })
    }
}

/// The runs of both sides on the same tasks. `task` names the only task of a file, which may call it otherwise.
///
/// # Errors
/// No task that both have.
pub fn matched(mut first: Vec<Side>, mut second: Vec<Side>, task: Option<&str>) -> anyhow::Result<Vec<Compared>> {
    if let Some(task) = task {
        for side in [&mut first, &mut second] {
            match side.as_mut_slice() {
                [only] if only.file.is_some() => only.run.task = task.to_owned(),
                _ => side.retain(|side| side.run.task == task),
            }
        }
    }
    let tasks = |side: &[Side]| side.iter().map(|side| side.run.task.clone()).collect::<Vec<_>>().join(", ");
    let told = (tasks(&first), tasks(&second));
    let mut found = Vec::new();
    for one in &first {
        for two in second.iter().filter(|two| two.run.task == one.run.task) {
            found.push(Compared::of(one, two));
        }
    }
    if found.is_empty() {
        bail!("no task that both have: found {} and {}; --task names the task of a file that has one", told.0, told.1);
    }
    Ok(found)
}

/// Two runs on a task.
pub struct Compared {
    text: String,
    json: Value,
}

impl Compared {
    /// What people read.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// What programs read.
    pub fn json(&self) -> &Value {
        &self.json
    }

    fn of(one: &Side, two: &Side) -> Self {
        let paired = one.run.is_paired(&two.run);
        let comparison = compare_runs(&one.run.outcomes, &two.run.outcomes, paired);
        let flips = (paired && comparison.shared > 0).then(|| Flips::of(&one.run.outcomes, &two.run.outcomes));
        let episodes = || one.run.outcomes.values().copied().zip(two.run.outcomes.values().copied());
        let [nscore, savi] = [Bet::NScore, Bet::Savi].map(|bet| Unpaired::of(bet, episodes()));
        let Comparison { difference, interval, p_value, test, shared } = comparison;
        let (first, second) = (one.name(), two.name());
        let width = first.chars().count().max(second.chars().count());
        let points = |x: f64| format!("{:+.1}", x * 1e2);
        let mut text = format!("{}: {shared} episodes from the same initial state\n", one.run.task);
        for (name, side) in [(&first, one), (&second, two)] {
            text.push_str(&format!("  {name:width$}  {}  {}\n", counts(side.counts()), side.seal_text()));
        }
        let within = interval.map_or(String::new(), |(low, high)| format!(" [{}, {}]", points(low), points(high)));
        let (name, p) = (test.name(), p_text(p_value));
        text.push_str(&format!("  difference {} points{within}, {name} p {p}\n", points(difference)));
        let mut json = json!({
            "task": one.run.task, "first": one.json(), "second": two.json(), "shared_seeds": shared,
            "difference": difference, "ci95": interval.map(|(low, high)| [low, high]), "test": name, "p_value": p_value,
            "nscore_p_value": nscore.p_value(), "savi_p_value": savi.p_value(),
        });
        match &flips {
            Some(flips) => {
                text.push_str(&format!("  {}\n", sequential_text(flips, &first, &second)));
                for (name, seeds) in [(&first, &flips.first_only), (&second, &flips.second_only)] {
                    if !seeds.is_empty() {
                        text.push_str(&format!("  only {name}: {}\n", list(seeds)));
                    }
                }
                json["flips"] = flips_json(flips);
            }
            None => text.push_str(&format!(
                "  sequential, in the order of the episodes: N-SCORE p {}, SAVI p {} at any time\n",
                p_text(nscore.p_value()),
                p_text(savi.p_value())
            )),
        }
        Self { text, json }
    }
}

/// Seeds on which only one succeeded, and the sequential test, for programs.
pub fn flips_json(flips: &Flips) -> Value {
    json!({
        "both": flips.counts.both, "neither": flips.counts.neither, "first_only": flips.first_only,
        "second_only": flips.second_only, "e_value": flips.sequential.e_value(),
        "sequential_p_value": flips.sequential.p_value(), "decided_after": flips.decided_after,
        "decided_for_first": flips.first_is_better,
    })
}

/// `95 of 100 (95.0%)`
pub fn counts(Counts { successes, episodes }: Counts) -> String {
    format!("{successes} of {episodes} ({}%)", percent(successes, episodes, 1))
}

/// A p-value, with an exponent where it is small.
pub fn p_text(p: f64) -> String {
    if p < 1e-4 { format!("{p:.1e}") } else { format!("{p:.4}") }
}

/// What the sequential test says.
pub fn sequential_text(flips: &Flips, first: &str, second: &str) -> String {
    let p = format!("p {} at any time", p_text(flips.sequential.p_value()));
    match flips.decided_after {
        Some(seeds) => {
            let better = if flips.first_is_better == Some(true) { first } else { second };
            format!("sequential: decided after {seeds} seeds, {better} is better ({p})")
        }
        None => format!("sequential: not decided ({p})"),
    }
}

/// The first seeds, and how many more.
pub fn list(seeds: &[u64]) -> String {
    const SHOWN: usize = 20;
    let shown: Vec<String> = seeds.iter().take(SHOWN).map(u64::to_string).collect();
    let more = seeds.len().saturating_sub(SHOWN);
    shown.join(" ") + &if more > 0 { format!(" and {more} more") } else { String::new() }
}
