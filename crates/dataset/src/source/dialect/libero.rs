//! LIBERO: robomimic's layout with a BDDL problem; the instruction is in `problem_info`.

use super::{Draft, Layout, Survey, family};
use crate::error::InputError;
use crate::plan::Dialect;

pub(super) struct Libero;

impl Layout for Libero {
    fn expected(&self) -> &'static str {
        "a group data with the attribute problem_info or bddl_file_name (LIBERO)"
    }

    fn recognises(&self, survey: &Survey) -> bool {
        survey.single().is_some_and(|file| {
            file.groups.contains_key("data")
                && family::data_attr_names(file)
                    .iter()
                    .any(|name| matches!(name.as_str(), "problem_info" | "bddl_file_name"))
        })
    }

    fn draft(&self, survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
        let mut draft = family::draft(survey, Dialect::Libero, beat)?;
        let instruction = draft
            .texts
            .get("data/problem_info")
            .and_then(|text| serde_json::from_str::<serde_json::Value>(text).ok())
            .and_then(|info| match info.get("language_instruction")? {
                serde_json::Value::String(text) => Some(text.clone()),
                // some tasks store the words one by one
                serde_json::Value::Array(words) => {
                    let words: Option<Vec<&str>> = words.iter().map(|w| w.as_str()).collect();
                    Some(words?.join(" "))
                }
                _ => None,
            })
            .map(|text| text.trim_matches('"').to_owned())
            .filter(|text| !text.is_empty());
        if let Some(instruction) = instruction {
            for demo in &mut draft.demos {
                demo.plan.task.get_or_insert_with(|| instruction.clone());
            }
        }
        if draft.env_name.is_none() {
            draft.env_name = draft.texts.get("data/env_name").cloned();
        }
        if draft.demos.iter().any(|d| d.plan.keys.values().any(|k| k.is_image())) {
            draft.notes.push(
                "images are kept as stored: in the simulator's OpenGL orientation, upside down \
                 against robomimic's"
                    .to_owned(),
            );
        }
        Ok(draft)
    }
}
