//! What an entry does, asked from another language: observations in, action chunks out.
//!
//!     predict ZOO ENTRY < observations.json
//!
//! Reads `[{"state": [...], "environment_state": [...], "images.front": [...]}, ...]` (numbers as they are, bytes of
//! pictures row by row from the top; what an entry does not see may be missing) and prints a list of chunks, each a list of actions, all
//! raw: the entry normalises on its own. The observations are those of one episode, that of seed 0. `make interop` compares them with LeRobot's answers.

#![allow(clippy::print_stdout)]

use models::{Observation, Policy, Values};
use serde_json::Value;
use std::path::Path;
use zoo::registry::Registry;

type AnyError = Box<dyn std::error::Error>;

fn main() -> Result<(), AnyError> {
    let given: Vec<String> = std::env::args().skip(1).collect();
    let [zoo, entry] = given.as_slice() else { return Err("usage: predict ZOO ENTRY < observations.json".into()) };
    let observations: Vec<Value> = serde_json::from_reader(std::io::stdin().lock())?;
    let mut policy = Registry::open(Path::new(zoo)).entry(entry)?.load()?.policy();
    policy.reset(0);
    let mut chunks = Vec::new();
    for observation in &observations {
        let mut asked = Observation::new();
        for (key, value) in observation.as_object().ok_or("an observation is no object")? {
            let list = value.as_array().ok_or_else(|| format!("{key}: no list"))?;
            let number = |v: &Value| v.as_f64().map(|v| v as f32).ok_or_else(|| format!("{key}: {v}"));
            let byte = |v: &Value| v.as_u64().and_then(|v| u8::try_from(v).ok()).ok_or_else(|| format!("{key}: {v}"));
            let values = match key.starts_with("images.") {
                true => Values::U8(list.iter().map(byte).collect::<Result<_, _>>()?),
                false => Values::F32(list.iter().map(number).collect::<Result<_, _>>()?),
            };
            asked.insert(&format!("observation.{key}"), values);
        }
        let chunk = policy.predict(&asked)?;
        chunks.push(chunk.actions.chunks_exact(chunk.action_dim).map(<[f32]>::to_vec).collect::<Vec<_>>());
    }
    println!("{}", serde_json::to_string(&chunks)?);
    Ok(())
}
