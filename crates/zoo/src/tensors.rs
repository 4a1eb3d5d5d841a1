//! Named tensors to safetensors bytes and back, the same bytes for the same tensors.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::io::Read;
use std::path::Path;

use candle_core::{DType, Device, Tensor};
use half::{bf16, f16};
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView, serialize};

use crate::ZooError;
use crate::files::open_file;

/// The one metadata key: safetensors keeps metadata in a hash map, and one key has one order.
const METADATA_KEY: &str = "actrm";

/// Tensors and the JSON stored beside them.
pub type Contents = (BTreeMap<String, Tensor>, serde_json::Value);

/// Serialises `tensors` with `metadata` (whose keys `serde_json` keeps sorted).
///
/// # Errors
/// A tensor of a type that such files do not hold; `path` is named.
pub fn to_bytes(
    path: &Path,
    tensors: &BTreeMap<String, Tensor>,
    metadata: &serde_json::Value,
) -> Result<Vec<u8>, ZooError> {
    let failed = |reason: String| ZooError::Malformed { path: path.to_owned(), reason };
    let mut parts: Vec<(&String, Dtype, Vec<usize>, Vec<u8>)> = Vec::with_capacity(tensors.len());
    for (name, tensor) in tensors {
        let (dtype, bytes) = raw(tensor).map_err(|e| failed(format!("tensor `{name}` cannot be stored: {e}")))?;
        parts.push((name, dtype, tensor.dims().to_vec(), bytes));
    }
    let mut views = Vec::with_capacity(parts.len());
    for (name, dtype, shape, bytes) in &parts {
        let view = TensorView::new(*dtype, shape.clone(), bytes)
            .map_err(|e| failed(format!("tensor `{name}` cannot be stored: {e}")))?;
        views.push(((*name).clone(), view));
    }
    let info = HashMap::from([(METADATA_KEY.to_owned(), metadata.to_string())]);
    serialize(views, Some(info)).map_err(|e| failed(format!("cannot be serialised: {e}")))
}

fn raw(tensor: &Tensor) -> candle_core::Result<(Dtype, Vec<u8>)> {
    macro_rules! bytes {
        ($t:ty) => {
            tensor.flatten_all()?.to_vec1::<$t>()?.into_iter().flat_map(<$t>::to_le_bytes).collect()
        };
    }
    let bytes = match tensor.dtype() {
        DType::F16 => bytes!(f16),
        DType::F32 => bytes!(f32),
        DType::F64 => bytes!(f64),
        DType::I64 => bytes!(i64),
        DType::U32 => bytes!(u32),
        DType::U8 => bytes!(u8),
        other => candle_core::bail!("dtype {other:?} is not one of f16, f32, f64, i64, u32, u8"),
    };
    Ok((tensor.dtype().into(), bytes))
}

/// Parses the bytes of `path`; the metadata is `null` where there is none of ours.
///
/// # Errors
/// Bytes that are something else.
pub fn from_bytes(path: &Path, bytes: &[u8]) -> Result<Contents, ZooError> {
    let failed = |reason: String| ZooError::Malformed { path: path.to_owned(), reason };
    let not_ours = |e: safetensors::SafeTensorError| failed(format!("not a safetensors file: {e}"));
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(not_ours)?;
    let parsed = SafeTensors::deserialize(bytes).map_err(not_ours)?;
    let metadata = match header.metadata().as_ref().and_then(|m| m.get(METADATA_KEY)) {
        Some(text) => {
            serde_json::from_str(text).map_err(|e| failed(format!("metadata `{METADATA_KEY}` is not JSON: {e}")))?
        }
        None => serde_json::Value::Null,
    };
    let mut tensors = BTreeMap::new();
    for (name, view) in parsed.iter() {
        let tensor = tensor(&view).map_err(|e| failed(format!("tensor `{name}`: {e}")))?;
        tensors.insert(name.to_owned(), tensor);
    }
    Ok((tensors, metadata))
}

fn tensor(view: &TensorView<'_>) -> candle_core::Result<Tensor> {
    macro_rules! values {
        ($t:ty) => {{
            let values: Vec<$t> = view.data().as_chunks().0.iter().map(|bytes| <$t>::from_le_bytes(*bytes)).collect();
            Tensor::from_vec(values, view.shape(), &Device::Cpu)
        }};
    }
    match view.dtype() {
        // what is stored in half is computed with in full
        Dtype::F16 => values!(f16)?.to_dtype(DType::F32),
        Dtype::BF16 => values!(bf16)?.to_dtype(DType::F32),
        Dtype::F32 => values!(f32),
        Dtype::F64 => values!(f64),
        Dtype::I64 => values!(i64),
        Dtype::U32 => values!(u32),
        Dtype::U8 => values!(u8),
        other => candle_core::bail!("expected dtype f16, bf16, f32, f64, i64, u32 or u8, found {other:?}"),
    }
}

/// The list of files that a checkpoint in several files has beside them.
const INDEX_SUFFIX: &str = ".index.json";

/// Reads the weights that another program wrote to `path`, in f32 whatever floating-point type they are stored in. Where there is
/// no such file but Hugging Face's list of its parts (`model.safetensors.index.json`), all of those are read.
///
/// # Errors
/// A file that cannot be read or is something else; a tensor of another type, or too large for f32; parts that do not hold what
/// the list says.
pub fn read_weights(path: &Path) -> Result<BTreeMap<String, Tensor>, ZooError> {
    let mut index = path.as_os_str().to_owned();
    index.push(INDEX_SUFFIX);
    let index = Path::new(&index);
    match !path.exists() && index.exists() {
        true => read_parts(index),
        false => in_f32(path, read(path)?.0),
    }
}

#[derive(serde::Deserialize)]
struct Index {
    /// The file of each tensor.
    weight_map: BTreeMap<String, String>,
}

fn read_parts(index: &Path) -> Result<BTreeMap<String, Tensor>, ZooError> {
    let malformed = |reason: String| ZooError::Malformed { path: index.to_owned(), reason };
    let text = content(index)?;
    let Index { weight_map } =
        serde_json::from_slice(&text).map_err(|e| malformed(format!("not a list of safetensors files: {e}")))?;
    let mut all = BTreeMap::new();
    for file in weight_map.values().collect::<BTreeSet<_>>() {
        if file.contains(['/', '\\']) {
            return Err(malformed(format!("weight_map: expected files beside this one, found `{file}`")));
        }
        let path = index.with_file_name(file);
        for (name, tensor) in in_f32(&path, read(&path)?.0)? {
            match weight_map.get(&name) {
                Some(expected) if expected == file => all.insert(name, tensor),
                Some(expected) => {
                    return Err(malformed(format!("tensor `{name}`: expected in {expected}, found in {file}")));
                }
                None => return Err(malformed(format!("weight_map: no tensor `{name}`, which {file} holds"))),
            };
        }
    }
    match weight_map.iter().find(|(name, _)| !all.contains_key(*name)) {
        Some((name, file)) => Err(malformed(format!("tensor `{name}`: expected in {file}, which does not hold it"))),
        None => Ok(all),
    }
}

/// Weights that another program wrote to `path`, in f32.
///
/// # Errors
/// A number too large for f32, by name.
pub fn in_f32(path: &Path, tensors: BTreeMap<String, Tensor>) -> Result<BTreeMap<String, Tensor>, ZooError> {
    let single = |(name, tensor): (String, Tensor)| {
        let malformed = |reason: String| ZooError::Malformed { path: path.to_owned(), reason };
        if tensor.dtype() != DType::F64 {
            return Ok((name, tensor));
        }
        let values = tensor.flatten_all().and_then(|flat| flat.to_vec1::<f64>());
        let values = values.map_err(|e| malformed(format!("tensor `{name}`: {e}")))?;
        if let Some(large) = values.into_iter().find(|value| value.is_finite() && value.abs() > f64::from(f32::MAX)) {
            return Err(malformed(format!("tensor `{name}`: expected numbers that fit into f32, found {large:e}")));
        }
        let single = tensor.to_dtype(DType::F32).map_err(|e| malformed(format!("tensor `{name}`: {e}")))?;
        Ok((name, single))
    };
    tensors.into_iter().map(single).collect()
}

/// Tensors with their 32-bit numbers rounded to 16 bits; `path` is named.
///
/// # Errors
/// A number too large for 16 bits.
pub fn halved(path: &Path, tensors: BTreeMap<String, Tensor>) -> Result<BTreeMap<String, Tensor>, ZooError> {
    let half = |(name, tensor): (String, Tensor)| {
        let malformed = |reason: String| ZooError::Malformed { path: path.to_owned(), reason };
        if tensor.dtype() != DType::F32 {
            return Ok((name, tensor));
        }
        let values = tensor.flatten_all().and_then(|flat| flat.to_vec1::<f32>());
        let values = values.map_err(|e| malformed(format!("tensor `{name}`: {e}")))?;
        if let Some(large) = values.into_iter().find(|value| value.abs() > f16::MAX.to_f32()) {
            return Err(malformed(format!(
                "tensor `{name}`: expected numbers up to {} for f16, found {large}",
                f16::MAX
            )));
        }
        let half = tensor.to_dtype(DType::F16).map_err(|e| malformed(format!("tensor `{name}`: {e}")))?;
        Ok((name, half))
    };
    tensors.into_iter().map(half).collect()
}

/// Reads a safetensors file.
///
/// # Errors
/// A file that cannot be read or is something else.
pub fn read(path: &Path) -> Result<Contents, ZooError> {
    from_bytes(path, &content(path)?)
}

/// The content of a regular file; a pipe or a device could be read for ever.
fn content(path: &Path) -> Result<Vec<u8>, ZooError> {
    let mut bytes = Vec::new();
    open_file(path).and_then(|mut file| file.read_to_end(&mut bytes)).map_err(ZooError::io("read", path))?;
    Ok(bytes)
}

/// Refuses values that are no finite numbers.
///
/// # Errors
/// [`ZooError::Malformed`] with the file, the first such tensor and the place in it.
pub fn check_finite(path: &Path, tensors: &BTreeMap<String, Tensor>) -> Result<(), ZooError> {
    for (name, tensor) in tensors {
        let malformed = |reason: String| ZooError::Malformed { path: path.to_owned(), reason };
        let values = tensor.flatten_all().and_then(|flat| flat.to_dtype(DType::F64)?.to_vec1::<f64>());
        let values = values.map_err(|e| malformed(format!("tensor `{name}`: {e}")))?;
        if let Some(place) = values.iter().position(|value| !value.is_finite()) {
            let value = values[place];
            return Err(malformed(format!("tensor `{name}`: expected finite numbers, found {value} at place {place}")));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn halves_are_rounded_once_and_come_back_in_full() {
        let values = vec![0.1_f32, -1.0, 1e-9, 6e4, 0.333_333];
        let tensor = Tensor::from_vec(values.clone(), 5, &Device::Cpu).unwrap();
        let path = Path::new("x.safetensors");
        let halves = |tensor: &Tensor| halved(path, BTreeMap::from([("w".to_owned(), tensor.clone())]));
        let store = |tensor: &Tensor| to_bytes(path, &halves(tensor).unwrap(), &serde_json::Value::Null).unwrap();
        let bytes = store(&tensor);
        let back = from_bytes(path, &bytes).unwrap().0["w"].clone();
        assert_eq!(back.dtype(), DType::F32);
        for (value, stored) in values.iter().zip(back.to_vec1::<f32>().unwrap()) {
            assert!((value - stored).abs() <= value.abs() / 2048.0 + 3e-8, "{value} {stored}");
        }
        assert_eq!(store(&back), bytes);
        let large = Tensor::new(&[1e5_f32], &Device::Cpu).unwrap();
        let refused = halves(&large).unwrap_err().to_string();
        assert!(
            refused.contains("x.safetensors: tensor `w`: expected numbers up to 65504 for f16, found 100000"),
            "{refused}"
        );
    }

    #[test]
    fn a_pipe_in_place_of_weights_or_their_list_is_refused() {
        use rustix::fs::{CWD, FileType, Mode, mknodat};
        for name in ["model.safetensors", "model.safetensors.index.json"] {
            let folder = tempfile::tempdir().unwrap();
            mknodat(CWD, folder.path().join(name), FileType::Fifo, Mode::RWXU, 0).unwrap();
            let error = read_weights(&folder.path().join("model.safetensors")).unwrap_err();
            let cause = std::error::Error::source(&error).unwrap().to_string();
            assert!(error.to_string().contains(name) && cause.contains("found a pipe"), "{error}: {cause}");
        }
    }

    /// A safetensors file of one tensor `w` of these bytes.
    fn stored(dtype: Dtype, bytes: &[u8]) -> Vec<u8> {
        let count = 8 * bytes.len() / dtype.bitsize();
        serialize([("w", TensorView::new(dtype, vec![count], bytes).unwrap())], None).unwrap()
    }

    #[test]
    fn weights_of_others_are_read_in_f32_whatever_they_are_stored_in() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        let read_as = |dtype: Dtype, bytes: &[u8]| {
            std::fs::write(&path, stored(dtype, bytes)).unwrap();
            read_weights(&path).map(|weights| weights["w"].to_vec1::<f32>().unwrap()).map_err(|e| e.to_string())
        };
        let values = [1.5_f64, -0.25, 3e4];
        let expected = values.map(|value| value as f32);
        let bytes = |of: fn(f64) -> Vec<u8>| values.iter().flat_map(|&value| of(value)).collect::<Vec<u8>>();
        assert_eq!(read_as(Dtype::F64, &bytes(|x| x.to_le_bytes().to_vec())).unwrap(), expected);
        assert_eq!(read_as(Dtype::F32, &bytes(|x| (x as f32).to_le_bytes().to_vec())).unwrap(), expected);
        assert_eq!(read_as(Dtype::F16, &bytes(|x| f16::from_f64(x).to_le_bytes().to_vec())).unwrap(), expected);
        let rounded = values.map(|x| bf16::from_f64(x).to_f32());
        assert_eq!(read_as(Dtype::BF16, &bytes(|x| bf16::from_f64(x).to_le_bytes().to_vec())).unwrap(), rounded);
        let place = path.display();
        assert_eq!(
            read_as(Dtype::F64, &1e300_f64.to_le_bytes()).unwrap_err(),
            format!("{place}: tensor `w`: expected numbers that fit into f32, found 1e300")
        );
        let expected = format!("{place}: tensor `w`: expected dtype f16, bf16, f32, f64, i64, u32 or u8, found I8");
        let refused = read_as(Dtype::I8, &[1, 2]).unwrap_err();
        assert!(refused.starts_with(&expected), "{refused}");
    }

    #[test]
    fn weights_in_several_files_are_read_and_must_be_what_the_list_says() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let put = |file: &str, names: &[&str]| {
            let one = Tensor::new(&[1.0_f32], &Device::Cpu).unwrap();
            let tensors = names.iter().map(|name| ((*name).to_owned(), one.clone())).collect();
            std::fs::write(at(file), to_bytes(&at(file), &tensors, &serde_json::Value::Null).unwrap()).unwrap();
        };
        let read_by = |map: serde_json::Value| {
            let text = serde_json::json!({"metadata": {"total_size": 12}, "weight_map": map}).to_string();
            std::fs::write(at("model.safetensors.index.json"), text).unwrap();
            read_weights(&at("model.safetensors")).map(|weights| weights.into_keys().collect::<Vec<_>>())
        };
        put("model-1.safetensors", &["a", "b"]);
        put("model-2.safetensors", &["c"]);
        let (one, two) = ("model-1.safetensors", "model-2.safetensors");
        assert_eq!(read_by(serde_json::json!({"a": one, "b": one, "c": two})).unwrap(), ["a", "b", "c"]);
        for (map, expected) in [
            (serde_json::json!({"a": one, "b": one, "c": two, "d": two}), "tensor `d`: expected in model-2"),
            (serde_json::json!({"a": one, "c": two}), "no tensor `b`, which model-1.safetensors holds"),
            (serde_json::json!({"a": one, "b": two, "c": two}), "tensor `b`: expected in model-2"),
            (serde_json::json!({"a": "../x.safetensors"}), "expected files beside this one, found `../x"),
            (serde_json::json!({"a": "gone.safetensors"}), "gone.safetensors"),
            (serde_json::json!(["a"]), "not a list of safetensors files"),
        ] {
            let error = read_by(map).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }

    #[test]
    fn tensors_come_back_and_bytes_repeat() {
        let device = &Device::Cpu;
        let tensors = BTreeMap::from([
            ("b.weight".to_owned(), Tensor::from_vec(vec![1.5_f32, -0.0, f32::MIN_POSITIVE], (3, 1), device).unwrap()),
            ("a".to_owned(), Tensor::from_vec(vec![7_i64, -1], 2, device).unwrap()),
            ("s".to_owned(), Tensor::new(2.5_f64, device).unwrap()),
            ("r".to_owned(), Tensor::from_vec(vec![1_u8, 2, 255], 3, device).unwrap()),
        ]);
        let metadata = serde_json::json!({"z": 1, "a": [1.5, "x"]});
        let path = Path::new("x.safetensors");
        let bytes = to_bytes(path, &tensors, &metadata).unwrap();
        assert_eq!(bytes, to_bytes(path, &tensors, &metadata).unwrap());
        let (back, meta) = from_bytes(path, &bytes).unwrap();
        assert_eq!(meta, metadata);
        assert_eq!(back.len(), tensors.len());
        for (name, tensor) in &tensors {
            assert_eq!(raw(tensor).unwrap(), raw(&back[name]).unwrap(), "{name}");
            assert_eq!(tensor.dims(), back[name].dims());
        }
    }

    #[test]
    fn a_value_that_is_no_number_is_named() {
        let device = &Device::Cpu;
        let mut tensors = BTreeMap::from([("a".to_owned(), Tensor::new(&[1_i64, i64::MAX], device).unwrap())]);
        check_finite(Path::new("x"), &tensors).unwrap();
        tensors.insert("b".to_owned(), Tensor::new(&[[0.0_f32, f32::NAN]], device).unwrap());
        let error = check_finite(Path::new("x"), &tensors).unwrap_err().to_string();
        assert_eq!(error, "x: tensor `b`: expected finite numbers, found NaN at place 1");
    }

    #[test]
    fn a_truncated_file_is_an_error_that_names_it() {
        let tensors = BTreeMap::from([("a".to_owned(), Tensor::zeros(100, DType::F32, &Device::Cpu).unwrap())]);
        let path = Path::new("some/model.safetensors");
        let bytes = to_bytes(path, &tensors, &serde_json::Value::Null).unwrap();
        for cut in [0, 5, 40, bytes.len() - 1] {
            let error = from_bytes(path, &bytes[..cut]).unwrap_err().to_string();
            assert!(error.starts_with("some/model.safetensors: not a safetensors file"), "{error}");
        }
    }
}
