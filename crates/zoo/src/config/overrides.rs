//! `train.steps=5000` on the command line.

use toml::{Table, Value};

use crate::ZooError;

/// Lays dotted overrides over `table`, in order.
///
/// The value is TOML (`5000`, `0.1`, `true`, `["a", "b"]`); what is not TOML is taken as a string, so that
/// `task.name=Stack` needs no quotes. Whether the key exists is decided when the table is read.
///
/// # Errors
/// When an override is not `dotted.key=value`, or goes through a key that is not a table.
pub fn apply_overrides(table: &mut Table, overrides: &[String]) -> Result<(), ZooError> {
    for text in overrides {
        apply(table, text).map_err(|reason| ZooError::Override { text: text.clone(), reason })?;
    }
    Ok(())
}

fn apply(table: &mut Table, text: &str) -> Result<(), String> {
    let (path, value) = text.split_once('=').ok_or_else(|| "expected `section.key=value`".to_owned())?;
    let keys: Vec<&str> = path.split('.').collect();
    if keys.iter().any(|key| key.trim() != *key || key.is_empty()) {
        return Err(format!("`{path}` is not a dotted key"));
    }
    let (last, sections) = keys.split_last().expect("split gives at least one part");
    let mut here = table;
    for (depth, section) in sections.iter().enumerate() {
        here = here
            .entry((*section).to_owned())
            .or_insert_with(|| Value::Table(Table::new()))
            .as_table_mut()
            .ok_or_else(|| format!("`{}` is a value, not a section", keys[..=depth].join(".")))?;
    }
    if here.get(*last).is_some_and(Value::is_table) {
        return Err(format!("`{path}` is a section, not a value"));
    }
    here.insert((*last).to_owned(), parse(value));
    Ok(())
}

fn parse(text: &str) -> Value {
    toml::from_str::<Table>(&format!("value = {text}"))
        .ok()
        .filter(|table| table.len() == 1)
        .and_then(|mut table| table.remove("value"))
        .unwrap_or_else(|| Value::String(text.to_owned()))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn with(overrides: &[&str]) -> Result<Table, String> {
        let mut table: Table = toml::from_str("name = 'x'\n[train]\nsteps = 1\n[train.lr]\nmax = 0.5").unwrap();
        let overrides: Vec<String> = overrides.iter().map(|o| (*o).to_owned()).collect();
        apply_overrides(&mut table, &overrides).map(|()| table).map_err(|e| e.to_string())
    }

    #[test]
    fn values_are_toml_or_else_strings() {
        let table = with(&[
            "train.steps=5_000",
            "train.lr.max=1e-3",
            "task.name=Stack",
            "data.keys=[\"a\"]",
            "data.path=a=b.hdf5",
            "ema=true",
            "task.empty=",
        ])
        .unwrap();
        assert_eq!(table["train"]["steps"], Value::Integer(5000));
        assert_eq!(table["train"]["lr"]["max"], Value::Float(1e-3));
        assert_eq!(table["task"]["name"], Value::String("Stack".to_owned()));
        assert_eq!(table["data"]["keys"][0], Value::String("a".to_owned()));
        assert_eq!(table["data"]["path"], Value::String("a=b.hdf5".to_owned()));
        assert_eq!(table["ema"], Value::Boolean(true));
        assert_eq!(table["task"]["empty"], Value::String(String::new()));
    }

    #[test]
    fn a_value_cannot_smuggle_in_other_keys() {
        let table = with(&["name=1\nother = 2"]).unwrap();
        assert!(!table.contains_key("other"));
    }

    #[test]
    fn what_is_not_an_override_is_refused() {
        assert_eq!(with(&["train"]).unwrap_err(), "override `train`: expected `section.key=value`");
        assert_eq!(
            with(&["train..steps=1"]).unwrap_err(),
            "override `train..steps=1`: `train..steps` is not a dotted key"
        );
        assert_eq!(
            with(&["train.steps.x=1"]).unwrap_err(),
            "override `train.steps.x=1`: `train.steps` is a value, not a section"
        );
        assert_eq!(with(&["train.lr=1"]).unwrap_err(), "override `train.lr=1`: `train.lr` is a section, not a value");
    }
}
