//! Forms of `entry.json`: the present one, and how older ones are read.
//!
//! Form 1 had the lengths of the features in `dims`, and `state_keys` and `env_keys`; form 2 has a `signature`, and
//! `keys` by feature.

use models::{ENVIRONMENT_STATE, STATE, Signature};
use serde_json::{Value, json};

/// Version of the form that is written.
pub(super) const FORMAT: u32 = 2;

/// Brings the text of an `entry.json`, parsed, into the present form.
///
/// # Errors
/// In words: a form that is not known, a key that its form must have.
pub(super) fn upgrade(mut entry: Value) -> Result<Value, String> {
    let format = entry.get("format").and_then(Value::as_u64);
    match format {
        Some(1) => {}
        Some(format) if format == u64::from(FORMAT) => return Ok(entry),
        _ => {
            let found = format.map_or_else(|| "none".to_owned(), |format| format.to_string());
            return Err(format!("format: expected 1 to {FORMAT}, found {found}"));
        }
    }
    let fields = entry.as_object_mut().ok_or("not an object")?;
    let mut take = |key: &str| fields.remove(key).ok_or_else(|| format!("no {key}, which form 1 has"));
    let (dims, state_keys, env_keys) = (take("dims")?, take("state_keys")?, take("env_keys")?);
    let length = |key: &str| {
        let length = dims.get(key).and_then(Value::as_u64).and_then(|length| usize::try_from(length).ok());
        length.ok_or_else(|| format!("dims.{key}: expected a length, found {}", dims.get(key).unwrap_or(&Value::Null)))
    };
    let (state, env, action) = (length("state")?, length("environment_state")?, length("action")?);
    let mut signature = Signature { action_dim: action, ..Signature::default() };
    let mut keys = json!({});
    if state > 0 {
        signature = Signature::low_dimensional(state, env, action);
        keys[STATE] = state_keys;
    }
    if env > 0 {
        keys[ENVIRONMENT_STATE] = env_keys;
    }
    entry["signature"] = serde_json::to_value(signature).expect("names and numbers become JSON");
    entry["keys"] = keys;
    entry["format"] = json!(FORMAT);
    Ok(entry)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_first_form_is_read_into_the_present_one() {
        let old = json!({
            "format": 1, "name": "lift-act", "state_keys": ["a", "b"], "env_keys": ["object"],
            "dims": {"state": 9, "environment_state": 10, "action": 7}
        });
        let new = upgrade(old.clone()).unwrap();
        let signature: Signature = serde_json::from_value(new["signature"].clone()).unwrap();
        assert_eq!(signature, Signature::low_dimensional(9, 10, 7));
        assert_eq!(new["keys"], json!({"observation.state": ["a", "b"], "observation.environment_state": ["object"]}));
        assert_eq!((&new["format"], &new["name"]), (&json!(2), &json!("lift-act")));
        assert_eq!(upgrade(new.clone()).unwrap(), new);

        // a solver of puzzles
        let mut none = old.clone();
        none["dims"] = json!({"state": 0, "environment_state": 0, "action": 0});
        let none = upgrade(none).unwrap();
        assert_eq!(serde_json::from_value::<Signature>(none["signature"].clone()).unwrap(), Signature::default());
        assert_eq!(none["keys"], json!({}));

        let mut lacking = old.clone();
        lacking.as_object_mut().unwrap().remove("dims");
        assert_eq!(upgrade(lacking).unwrap_err(), "no dims, which form 1 has");
        let mut later = old;
        later["format"] = json!(3);
        assert_eq!(upgrade(later).unwrap_err(), "format: expected 1 to 2, found 3");
    }
}
