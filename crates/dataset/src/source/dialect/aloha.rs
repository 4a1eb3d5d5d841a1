//! ALOHA and ACT: one file per episode. Names become robomimic's: `action` is `actions`, `observations/qpos` is
//! `obs/qpos`, a camera `observations/images/top` is `obs/images/top`. Cameras may hold JPEG files: rows of bytes, byte
//! strings or uint8 of any length.

use super::{DemoDraft, Draft, Layout, Survey, contents, id_of, stranger, wrong_lengths};
use crate::error::InputError;
use crate::plan::{DemoPlan, Dialect, Problem};
use crate::source::walk::Walked;

pub(super) struct Aloha;

fn is_episode(file: &Walked) -> bool {
    file.datasets.contains_key("action") && file.datasets.contains_key("observations/qpos")
}

impl Layout for Aloha {
    fn expected(&self) -> &'static str {
        "action and observations/qpos, in one file or in every file of a folder (ALOHA, ACT)"
    }

    fn recognises(&self, survey: &Survey) -> bool {
        survey.any(is_episode)
    }

    fn draft(&self, survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
        let mut out = Draft::new(Dialect::Aloha);
        for (index, file) in survey.files.iter().enumerate() {
            if is_episode(file) {
                episode(index, file, &mut out)?;
            } else {
                out.problems.push(stranger(file, "action and observations/qpos as in the other files"));
            }
            beat();
        }
        Ok(out)
    }
}

/// robomimic's names for ALOHA's datasets.
fn name_of(path: &str) -> String {
    match path.strip_prefix("observations/") {
        Some(rest) => format!("obs/{rest}"),
        None if path == "action" => "actions".to_owned(),
        None => path.to_owned(),
    }
}

fn episode(index: usize, file: &Walked, out: &mut Draft) -> Result<(), InputError> {
    let (attr_names, _) = file.some_attrs("/", &[])?;
    let (number, id) = id_of(&file.path, index, &out.demos);
    let found = contents((index, file), "", &id, &name_of, &mut out.problems);
    let length = file.datasets["action"].shape.first().copied().unwrap_or(0);
    match length {
        0 => out.problems.push(Problem::empty(&file.path, &id, "action")),
        _ => out.problems.extend(wrong_lengths(file, &id, (length, "action"), &found.keys)),
    }
    let plan = DemoPlan { id, number, length, keys: found.keys.into(), attr_names, task: None };
    out.demos.push(DemoDraft { plan, home: Some((index, String::new())), groups: found.groups, inner: found.inner });
    Ok(())
}
