//! What a rerun found, step by step.

use serde::Serialize;

/// Whether the entry's files are as they were sealed.
pub const ENTRY: &str = "entry";
/// Whether the result is as it was sealed, and of this entry.
pub(super) const RESULT: &str = "result";
/// Whether the demonstrations have the recorded fingerprint.
pub(super) const DEMONSTRATIONS: &str = "demonstrations";
/// The normaliser's statistics.
pub(super) const STATISTICS: &str = "statistics";
/// What `entry.json` says of the training: its numbers, its losses on the way.
pub(super) const TRAINING: &str = "training";
/// The weights.
pub(super) const WEIGHTS: &str = "weights";
/// The protocol that the simulator plays by.
pub(super) const RULES: &str = "rules";
/// The episodes' outcomes.
pub const EPISODES: &str = "episodes";

/// Every step, in order.
const STEPS: [&str; 8] = [ENTRY, RESULT, DEMONSTRATIONS, STATISTICS, TRAINING, WEIGHTS, RULES, EPISODES];
/// Those between the demonstrations and the weights.
pub(super) const OF_TRAINING: [&str; 4] = [DEMONSTRATIONS, STATISTICS, TRAINING, WEIGHTS];

/// How a step came out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// As it is stored.
    Same,
    /// Not as it is stored.
    Differs,
    /// It was asked for and could not be compared.
    NotCompared,
    /// Nobody asked for it.
    NotAsked,
}

impl Outcome {
    /// The words for it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Same => "same",
            Self::Differs => "differs",
            Self::NotCompared => "not compared",
            Self::NotAsked => "not asked for",
        }
    }
}

/// One step.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Step {
    /// Its name.
    pub step: &'static str,
    /// How it came out.
    pub outcome: Outcome,
    /// What is the same, what differs and how far, or why it was not compared.
    pub told: String,
}

/// Something that is not as it was recorded, and that outcomes may depend on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Reason {
    /// What: `mujoco`, `rustc`.
    pub what: String,
    /// Its version then; none where it was not recorded.
    pub recorded: Option<String>,
    /// Its version now.
    pub now: String,
}

/// The steps that were taken, in order, and what may be behind a difference.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Report {
    steps: Vec<Step>,
    reasons: Vec<Reason>,
}

impl Report {
    /// The steps so far.
    pub fn steps(&self) -> &[Step] {
        &self.steps
    }

    /// Versions that are not as they were recorded. Those that were not recorded at all are among them only where something
    /// differs.
    pub fn reasons(&self) -> impl Iterator<Item = &Reason> {
        let differs = self.first_difference().is_some();
        self.reasons.iter().filter(move |reason| differs || reason.recorded.is_some())
    }

    /// Whether all that was asked for is the same.
    pub fn is_same(&self) -> bool {
        self.steps.iter().all(|step| matches!(step.outcome, Outcome::Same | Outcome::NotAsked))
    }

    /// The first step that differs.
    pub fn first_difference(&self) -> Option<&Step> {
        self.steps.iter().find(|step| step.outcome == Outcome::Differs)
    }

    /// Says that nobody asks for the training.
    pub fn skip_training(&mut self, why: &str) {
        OF_TRAINING.into_iter().for_each(|step| self.add(step, Outcome::NotAsked, why.to_owned()));
    }

    pub(super) fn same(&mut self, step: &'static str, told: String) {
        self.add(step, Outcome::Same, told);
    }

    pub(super) fn differs(&mut self, step: &'static str, told: String) {
        self.add(step, Outcome::Differs, told);
    }

    pub(super) fn not_compared(&mut self, step: &'static str, told: String) {
        self.add(step, Outcome::NotCompared, told);
    }

    /// Says that the steps that are left cannot be compared.
    pub fn stop(&mut self, why: &str) {
        let left = STEPS.iter().position(|step| !self.steps.iter().any(|taken| taken.step == *step));
        for step in STEPS.into_iter().skip(left.unwrap_or(STEPS.len())) {
            self.not_compared(step, why.to_owned());
        }
    }

    pub(super) fn add(&mut self, step: &'static str, outcome: Outcome, told: String) {
        self.steps.push(Step { step, outcome, told });
    }

    /// Takes in versions: name, recorded and now. What is the same is no reason for anything.
    pub(super) fn add_versions(&mut self, versions: impl IntoIterator<Item = (String, Option<String>, String)>) {
        let other = versions.into_iter().filter(|(_, recorded, now)| recorded.as_ref() != Some(now));
        self.reasons.extend(other.map(|(what, recorded, now)| Reason { what, recorded, now }));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stop_leaves_no_step_out() {
        let mut report = Report::default();
        report.same(ENTRY, String::new());
        report.differs(RESULT, "edited".to_owned());
        report.stop("why");
        let steps: Vec<_> = report.steps().iter().map(|step| step.step).collect();
        assert_eq!(steps, STEPS);
        assert!(report.steps()[2..].iter().all(|step| step.outcome == Outcome::NotCompared && step.told == "why"));
        assert!(!report.is_same());
        assert_eq!(report.first_difference().map(|step| step.step), Some(RESULT));
    }

    #[test]
    fn what_nobody_asked_for_is_no_difference() {
        let mut report = Report::default();
        report.skip_training("--skip-training");
        report.same(EPISODES, String::new());
        assert!(report.is_same());
        report.not_compared(EPISODES, "by the clock".to_owned());
        assert!(!report.is_same());
    }

    #[test]
    fn what_was_not_recorded_is_told_only_where_something_differs() {
        let versions = [("rustc", None, "1.95"), ("numpy", Some("1"), "2"), ("mujoco", Some("3"), "3")];
        let versions = versions.map(|(what, then, now)| (what.to_owned(), then.map(str::to_owned), now.to_owned()));
        let mut report = Report::default();
        report.add_versions(versions);
        let names = |report: &Report| report.reasons().map(|reason| reason.what.clone()).collect::<Vec<_>>();
        assert_eq!(names(&report), ["numpy"]);
        report.differs(WEIGHTS, String::new());
        assert_eq!(names(&report), ["rustc", "numpy"]);
    }
}
