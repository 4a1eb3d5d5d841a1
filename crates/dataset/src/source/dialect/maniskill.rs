//! ManiSkill: `traj_<k>` in `trajectory.h5`, and `trajectory.json` beside it. Observations have one row more than actions:
//! the last is that of `next_obs`. `obs/agent/qpos` is `obs/qpos`, `obs/sensor_data/base_camera/rgb` is
//! `obs/base_camera_image`, and what `obs_mode state` writes is `obs/flat`.

use serde_json::{Value, json};

use super::{
    BESIDE, DemoDraft, Draft, Layout, Survey, beside, contents, list, missing, number_after, observed, wrong_lengths,
};
use crate::error::InputError;
use crate::plan::{DemoPlan, Dialect, Problem};
use crate::source::walk::Walked;

pub(super) struct Maniskill;

/// Numbers and names of the trajectories of a file.
fn trajectories(file: &Walked) -> Vec<(u64, &str)> {
    let of = |path: &'_ String| Some((number_after(path, "traj_")?, path.clone()));
    let mut found: Vec<(u64, &str)> = file.groups.keys().filter_map(|p| of(p).map(|(n, _)| (n, p.as_str()))).collect();
    found.sort_unstable();
    found
}

impl Layout for Maniskill {
    fn expected(&self) -> &'static str {
        "groups traj_<number> with actions (ManiSkill)"
    }

    fn recognises(&self, survey: &Survey) -> bool {
        survey.single().is_some_and(|file| !trajectories(file).is_empty())
    }

    fn draft(&self, survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
        let file = survey.single().expect("recognised as one file");
        let mut out = Draft::new(Dialect::Maniskill);
        for (number, home) in trajectories(file) {
            demo(file, number, home, &mut out)?;
            beat();
        }
        environment(file, &mut out);
        if !out.demos.iter().any(|demo| demo.plan.keys.keys().any(|key| key.starts_with("obs/"))) {
            out.notes.push(format!("no observations: {}", Dialect::Maniskill.observe()));
        }
        Ok(out)
    }
}

/// robomimic's names for ManiSkill's datasets.
fn name_of(path: &str) -> String {
    let Some(below) = path.strip_prefix("obs/") else {
        return if path == "obs" { "obs/flat".to_owned() } else { path.to_owned() };
    };
    let camera = below.strip_prefix("sensor_data/").or_else(|| below.strip_prefix("image/"));
    match camera.and_then(|camera| camera.split_once('/')) {
        Some((camera, "rgb" | "Color")) => format!("obs/{camera}_image"),
        Some((camera, what)) => format!("obs/{camera}_{what}"),
        None => {
            let plain = below.strip_prefix("agent/").or_else(|| below.strip_prefix("extra/"));
            format!("obs/{}", plain.unwrap_or(below))
        }
    }
}

fn demo(file: &Walked, number: u64, home: &str, out: &mut Draft) -> Result<(), InputError> {
    let id = format!("demo_{number}");
    let (attr_names, _) = file.some_attrs(home, &[])?;
    let mut found = contents((0, file), home, &id, &name_of, &mut out.problems);
    let length = found.keys.get("actions").and_then(|k| k.shape.first().copied()).unwrap_or(0);
    match found.keys.contains_key("actions") {
        true if length == 0 => out.problems.push(Problem::empty(&file.path, &id, "actions")),
        true => {
            observed(&mut found.keys, length);
            out.problems.extend(wrong_lengths(file, &id, (length, "actions"), &found.keys));
        }
        false => out.problems.push(missing(file, &id, "actions", &found.keys)),
    }
    // an empty group obs is what obs_mode none writes
    let plan = DemoPlan { id, number, length, keys: found.keys.into(), attr_names, task: None };
    out.demos.push(DemoDraft { plan, home: Some((0, home.to_owned())), groups: found.groups, inner: found.inner });
    Ok(())
}

/// What the JSON file says of environment and episodes.
fn environment(file: &Walked, out: &mut Draft) {
    let path = file.path.with_extension("json");
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let Some(text) = beside(&path) else {
        out.notes.push(format!("no {name} beside it: the environment is not known"));
        return;
    };
    let json = match serde_json::from_str::<Value>(&text) {
        Ok(json) => json,
        Err(e) => {
            let error = InputError::Unreadable { path, reason: format!("no JSON: {e}") };
            return out.problems.push(Problem::new(None, None, false, error));
        }
    };
    out.texts.insert(format!("{BESIDE}{name}"), text);
    let info = &json["env_info"];
    out.env_name = info["env_id"].as_str().map(str::to_owned);
    out.env_args = out.env_name.as_ref().map(|name| {
        let mut kwargs = info["env_kwargs"].clone();
        if let (Some(rate), Value::Object(kwargs)) = (kwargs["sim_config"]["control_freq"].as_f64(), &mut kwargs) {
            kwargs.insert("control_freq".to_owned(), json!(rate));
        }
        json!({"env_name": name, "env_kwargs": kwargs})
    });
    let listed = json["episodes"].as_array().map_or(&[][..], Vec::as_slice);
    let there = |id: u64| out.demos.iter().any(|demo| demo.plan.number == id);
    let absent: Vec<String> = listed
        .iter()
        .filter_map(|episode| episode["episode_id"].as_u64())
        .filter(|&id| !there(id))
        .map(|id| format!("traj_{id}"))
        .collect();
    if !absent.is_empty() {
        out.notes.push(format!(
            "{name} lists episodes that are not in the file: {}",
            list(absent.iter().map(String::as_str))
        ));
    }
}
