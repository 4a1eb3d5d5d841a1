//! LIBERO: robomimic's layout with a BDDL problem; the instruction is in `problem_info`. A folder of them, one a task, is one
//! data set.

use serde_json::Value;

use super::{Draft, Layout, Survey, family};
use crate::error::InputError;
use crate::plan::Dialect;
use crate::source::walk::Walked;

pub(super) struct Libero;

impl Layout for Libero {
    fn expected(&self) -> &'static str {
        "a group data with the attribute problem_info or bddl_file_name (LIBERO)"
    }

    fn recognises(&self, survey: &Survey) -> bool {
        survey.any(|file| {
            file.groups.contains_key("data")
                && family::data_attr_names(file)
                    .iter()
                    .any(|name| matches!(name.as_str(), "problem_info" | "bddl_file_name"))
        })
    }

    fn draft(&self, survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
        let mut draft = family::draft(survey, Dialect::Libero, beat)?;
        let instructions: Vec<Option<String>> = survey.files.iter().map(instruction).collect();
        for demo in &mut draft.demos {
            let file = demo.home.as_ref().map_or(0, |(file, _)| *file);
            demo.plan.task = demo.plan.task.take().or_else(|| instructions[file].clone());
        }
        let suites: Vec<Option<String>> = survey.files.iter().map(suite).collect();
        if let [Some(suite), others @ ..] = suites.as_slice()
            && others.iter().all(|other| other.as_ref() == Some(suite))
            && !draft.env_name.as_ref().is_some_and(|name| name.starts_with(suite))
        {
            // LIBERO says how its scene is made: `Libero_Floor_Manipulation`
            draft.env_name = Some(suite.clone());
        }
        if draft.env_name.is_none() {
            draft.env_name = draft.texts.get("data/env_name").cloned();
        }
        if draft.demos.iter().any(|d| d.plan.keys.values().any(|k| k.is_image())) {
            draft.notes.push(
                "images are kept as stored: upside down, as OpenGL reads them. Cameras keep LIBERO's names, such as \
                 agentview_rgb. The tasks of LIBERO have cameras of these names, which are upside down as well"
                    .to_owned(),
            );
        }
        Ok(draft)
    }
}

/// The suite of a file's task: the folder that its problem is in.
fn suite(file: &Walked) -> Option<String> {
    let problem = family::data_attr(file, "bddl_file_name")?;
    let (folder, _) = problem.rsplit_once('/')?;
    Some(folder.rsplit('/').next().unwrap_or(folder).to_owned()).filter(|suite| !suite.is_empty())
}

/// What a file's robot is told to do.
fn instruction(file: &Walked) -> Option<String> {
    let info: Value = serde_json::from_str(&family::data_attr(file, "problem_info")?).ok()?;
    let text = match info.get("language_instruction")? {
        Value::String(text) => text.clone(),
        // some tasks store the words one by one
        Value::Array(words) => words.iter().map(Value::as_str).collect::<Option<Vec<&str>>>()?.join(" "),
        _ => return None,
    };
    Some(text.trim_matches('"').to_owned()).filter(|text| !text.is_empty())
}
