//! What an entry does, asked from another language: observations in, action chunks out.
//!
//!     predict ZOO ENTRY < observations.json
//!
//! Reads `[{"state": [...], "environment_state": [...]}, ...]` and prints a list of chunks, each a list of actions, all
//! raw: the entry normalises on its own. `make interop` compares them with LeRobot's answers.

#![allow(clippy::print_stdout)]

use models::{Observation, Policy};
use serde_json::Value;
use std::path::Path;
use zoo::registry::Registry;

type AnyError = Box<dyn std::error::Error>;

fn main() -> Result<(), AnyError> {
    let given: Vec<String> = std::env::args().skip(1).collect();
    let [zoo, entry] = given.as_slice() else { return Err("usage: predict ZOO ENTRY < observations.json".into()) };
    let observations: Vec<Value> = serde_json::from_reader(std::io::stdin().lock())?;
    let mut policy = Registry::open(Path::new(zoo)).entry(entry)?.load()?.policy();
    let mut chunks = Vec::new();
    for observation in &observations {
        let numbers = |key: &str| -> Result<Vec<f32>, AnyError> {
            let list = observation[key].as_array().ok_or_else(|| format!("an observation has no list {key}"))?;
            list.iter().map(|v| v.as_f64().map(|v| v as f32).ok_or_else(|| format!("{key}: {v}").into())).collect()
        };
        let asked = Observation::of_state(numbers("state")?, numbers("environment_state")?);
        let chunk = policy.predict(&asked)?;
        chunks.push(chunk.actions.chunks_exact(chunk.action_dim).map(<[f32]>::to_vec).collect::<Vec<_>>());
    }
    println!("{}", serde_json::to_string(&chunks)?);
    Ok(())
}
