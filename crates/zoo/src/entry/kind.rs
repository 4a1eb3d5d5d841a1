//! What an entry is: a policy, which acts in simulators, or something that another crate made and knows how to use (`kind` and
//! `section` of its metadata). Nothing else asks which of the two an entry is.

use std::collections::BTreeSet;

use super::{Entry, EntryMeta};
use crate::ZooError;
use crate::experiment::Experiment;
use crate::results::TrainingFacts;

impl EntryMeta {
    fn is_policy(&self) -> bool {
        self.kind.is_none() && self.section.is_none()
    }

    /// Refuses an entry that is no policy; `expected` says what is needed.
    ///
    /// # Errors
    /// [`ZooError::UnfitEntry`].
    pub fn require_policy(&self, expected: &str) -> Result<(), ZooError> {
        if self.is_policy() {
            return Ok(());
        }
        Err(ZooError::UnfitEntry {
            entry: self.id().to_string(),
            task: self.task.clone(),
            what: "kind of entry".to_owned(),
            expected: expected.to_owned(),
            found: self.kind.clone().unwrap_or_else(|| "another kind".to_owned()),
        })
    }

    /// The name of the data set that a result's facts have to agree with; what is no policy has none of its own.
    pub fn data_set_of<'f>(&self, expected: &'f TrainingFacts, found: &'f TrainingFacts) -> &'f str {
        if self.is_policy() { &found.data_set } else { &expected.data_set }
    }

    /// The Hugging Face Hub's task and its tags; none of what is no policy.
    pub(super) fn hub_task(&self, tags: &mut BTreeSet<&str>) -> &'static str {
        if !self.is_policy() {
            return "";
        }
        tags.insert("robotics");
        if self.data.is_some() {
            tags.insert("imitation-learning");
        }
        "pipeline_tag: robotics\n"
    }
}

impl Entry {
    /// The experiment that a policy was trained by; none of what is no policy.
    ///
    /// # Errors
    /// A config that cannot be read.
    pub(crate) fn policy_experiment(&self) -> Result<Option<Experiment>, ZooError> {
        let read = || Experiment::from_toml(&self.id().to_string(), &self.config_text()?);
        self.meta().is_policy().then(read).transpose()
    }
}
