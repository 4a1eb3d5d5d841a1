//! What `features.json` states.

use serde_json::Value;

use super::MAX_ROWS;
use crate::tree::Dtype;

/// What a list holds.
#[derive(Debug, Clone, PartialEq)]
pub enum Form {
    Numbers(Dtype),
    Text,
    Images,
}

/// Finds the leaves below a feature: name, and what is stated of it.
pub fn leaves<'v>(feature: &'v Value, name: &str, depth: usize, found: &mut Vec<(String, &'v Value)>) {
    let dict = feature.pointer("/featuresDict/features").and_then(Value::as_object);
    match (dict, feature.pointer("/sequence/feature")) {
        (Some(dict), _) if depth > 0 => {
            for (child, feature) in dict {
                let name = if name.is_empty() { child.clone() } else { format!("{name}/{child}") };
                leaves(feature, &name, depth - 1, found);
            }
        }
        (None, Some(step)) if name == "steps" && depth > 0 => leaves(step, name, depth - 1, found),
        _ => found.push((name.to_owned(), feature)),
    }
}

/// Form and shape of a leaf; what it is in words where it cannot be read.
pub fn form(feature: &Value) -> Result<(Form, Vec<usize>), String> {
    let what = || {
        let class = feature.get("pythonClassName").and_then(Value::as_str).unwrap_or("a feature without a class");
        class.rsplit('.').next().unwrap_or(class).to_owned()
    };
    if feature.get("text").is_some() {
        return Ok((Form::Text, Vec::new()));
    }
    if feature.get("classLabel").is_some() {
        return Ok((Form::Numbers(Dtype::I64), Vec::new()));
    }
    let (stated, is_image) = match (feature.get("tensor"), feature.get("image")) {
        (Some(tensor), _) => (tensor, false),
        (None, Some(image)) => (image, true),
        _ => return Err(what()),
    };
    let of = |key: &str| stated.get(key).and_then(Value::as_str).unwrap_or("");
    let dimensions = stated.pointer("/shape/dimensions").and_then(Value::as_array);
    let extent = |d: &Value| d.as_i64().or_else(|| d.as_str()?.parse().ok());
    let shape: Option<Vec<i64>> = dimensions.into_iter().flatten().map(extent).collect();
    let shape = shape.ok_or_else(what)?;
    if is_image {
        return match (of("dtype"), shape.last()) {
            ("uint8" | "", Some(3)) => Ok((Form::Images, Vec::new())),
            (dtype, channels) => Err(format!("{} of {dtype} with {} channels", what(), channels.unwrap_or(&0))),
        };
    }
    let shape: Vec<usize> = shape
        .into_iter()
        .map(|n| usize::try_from(n).ok())
        .collect::<Option<_>>()
        .ok_or("an extent that is not stated")?;
    if !matches!(of("encoding"), "" | "none") {
        return Err(format!("{} with encoding {}", what(), of("encoding")));
    }
    if shape.iter().try_fold(1_usize, |n, &extent| n.checked_mul(extent)).is_none_or(|n| n == 0 || n > MAX_ROWS / 8) {
        return Err(format!("{} of shape {shape:?}", what()));
    }
    let dtype = match of("dtype") {
        "float32" | "float16" | "bfloat16" => Dtype::F32,
        "float64" => Dtype::F64,
        "bool" => Dtype::Bool,
        "uint8" => Dtype::U8,
        "int8" => Dtype::I8,
        "uint16" => Dtype::U16,
        "int16" => Dtype::I16,
        "uint32" => Dtype::U32,
        "int32" => Dtype::I32,
        "uint64" => Dtype::U64,
        "int64" => Dtype::I64,
        "string" if shape.is_empty() => return Ok((Form::Text, shape)),
        other => return Err(format!("{} of {other}", what())),
    };
    Ok((Form::Numbers(dtype), shape))
}

/// robomimic's names for those of RLDS.
pub fn key_of(name: &str) -> String {
    match name.split_once('/') {
        None if name == "action" => "actions".to_owned(),
        None if name == "reward" => "rewards".to_owned(),
        None if name == "is_terminal" => "dones".to_owned(),
        Some(("action", rest)) => format!("action_dict/{rest}"),
        Some(("observation", rest)) => format!("obs/{rest}"),
        _ => name.to_owned(),
    }
}
