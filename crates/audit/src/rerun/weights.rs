//! Two files of tensors: the same bytes, the same values, or how far apart.

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{DType, Tensor};

use super::report::Outcome;
use zoo::entry::Entry;
use zoo::{ZooError, tensors};

/// Compares the file `name` of two entries by hash and, where that differs, tensor by tensor.
///
/// # Errors
/// Files that are no tensors.
pub(super) fn compare(name: &str, recorded: &Entry, now: &Entry) -> Result<(Outcome, String), ZooError> {
    let hash = |entry: &Entry| entry.meta().files.get(name).map(|file| file.sha256.clone()).unwrap_or_default();
    let (expected, found) = (hash(recorded), hash(now));
    if expected == found {
        return Ok((Outcome::Same, format!("byte for byte, sha256 {}", &found[..12])));
    }
    let path = now.folder().join(name);
    let (one, _) = tensors::read(&recorded.folder().join(name))?;
    let (two, _) = tensors::read(&path)?;
    let far = apart(&path, &one, &two)?;
    Ok(match far {
        None => (Outcome::Same, "every value the same; the file is another: it is written otherwise now".to_owned()),
        Some(far) => (Outcome::Differs, far),
    })
}

/// How far two sets of tensors are apart, in words; nothing where each value has the same bits.
fn apart(
    path: &Path,
    expected: &BTreeMap<String, Tensor>,
    found: &BTreeMap<String, Tensor>,
) -> Result<Option<String>, ZooError> {
    if let Some(name) = expected.keys().find(|name| !found.contains_key(*name)) {
        return Ok(Some(format!("tensor `{name}`: recorded, and not there now")));
    }
    let values = |name: &str, tensor: &Tensor| {
        let values = tensor.flatten_all().and_then(|flat| flat.to_dtype(DType::F64)?.to_vec1::<f64>());
        values.map_err(|e| ZooError::Malformed { path: path.to_owned(), reason: format!("tensor `{name}`: {e}") })
    };
    let mut differing: Vec<&str> = Vec::new();
    let (mut absolute, mut relative) = ((0.0_f64, ""), (0.0_f64, ""));
    for (name, now) in found {
        let Some(then) = expected.get(name) else {
            return Ok(Some(format!("tensor `{name}`: there now, and not recorded")));
        };
        if then.dims() != now.dims() {
            return Ok(Some(format!("tensor `{name}`: recorded {:?}, now {:?}", then.dims(), now.dims())));
        }
        let (then, now) = (values(name, then)?, values(name, now)?);
        let others = then.iter().zip(&now).filter(|(a, b)| a.to_bits() != b.to_bits());
        let mut same = true;
        for (a, b) in others {
            same = false;
            // not a number is as far as can be
            let far = Some((a - b).abs()).filter(|far| !far.is_nan()).unwrap_or(f64::INFINITY);
            let share = if far == 0.0 { 0.0 } else { far / a.abs().max(b.abs()) };
            let share = if share.is_nan() { f64::INFINITY } else { share };
            if far >= absolute.0 {
                absolute = (far, name);
            }
            if share >= relative.0 {
                relative = (share, name);
            }
        }
        if !same {
            differing.push(name);
        }
    }
    let Some(first) = differing.first() else { return Ok(None) };
    Ok(Some(format!(
        "{} of {} tensors, the first `{first}`; at most by {:.1e} (`{}`), relatively by {:.1e} (`{}`)",
        differing.len(),
        found.len(),
        absolute.0,
        absolute.1,
        relative.0,
        relative.1
    )))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use candle_core::Device;

    use super::*;

    fn tensors(of: &[(&str, &[f32])]) -> BTreeMap<String, Tensor> {
        of.iter().map(|(name, values)| ((*name).to_owned(), Tensor::new(*values, &Device::Cpu).unwrap())).collect()
    }

    fn told(one: &[(&str, &[f32])], two: &[(&str, &[f32])]) -> Option<String> {
        apart(Path::new("x"), &tensors(one), &tensors(two)).unwrap()
    }

    #[test]
    fn how_far_tensors_are_apart_is_told_by_name() {
        let one: &[(&str, &[f32])] = &[("a", &[1.0, 2.0]), ("b", &[100.0]), ("c", &[1e-6])];
        assert_eq!(told(one, one), None);
        assert_eq!(
            told(one, &[("a", &[1.0, 2.0]), ("b", &[100.5]), ("c", &[2e-6])]).unwrap(),
            "2 of 3 tensors, the first `b`; at most by 5.0e-1 (`b`), relatively by 5.0e-1 (`c`)"
        );
        // another sign of zero is another bit
        assert!(told(&[("a", &[0.0])], &[("a", &[-0.0])]).unwrap().starts_with("1 of 1 tensors, the first `a`"));
        assert!(told(&[("a", &[0.0])], &[("a", &[f32::NAN])]).unwrap().contains("at most by inf (`a`)"));
    }

    #[test]
    fn tensors_of_other_names_and_shapes_are_told() {
        let one: &[(&str, &[f32])] = &[("a", &[1.0])];
        assert_eq!(told(one, &[("b", &[1.0])]).unwrap(), "tensor `a`: recorded, and not there now");
        assert_eq!(told(one, &[("a", &[1.0]), ("b", &[1.0])]).unwrap(), "tensor `b`: there now, and not recorded");
        assert_eq!(told(one, &[("a", &[1.0, 2.0])]).unwrap(), "tensor `a`: recorded [1], now [2]");
    }
}
