#![allow(clippy::unwrap_used)]
//! Whatever a file of demonstrations can hold is the same after writing and reading it.

use proptest::collection::{btree_map, btree_set, vec};
use proptest::prelude::*;

use super::*;
use crate::tree::Attrs;
use crate::tree::Dtype;

fn dtype() -> impl Strategy<Value = Dtype> {
    prop_oneof![
        Just(Dtype::U8),
        Just(Dtype::I8),
        Just(Dtype::U16),
        Just(Dtype::I16),
        Just(Dtype::U32),
        Just(Dtype::I32),
        Just(Dtype::U64),
        Just(Dtype::I64),
        Just(Dtype::F32),
        Just(Dtype::F64),
        Just(Dtype::Bool),
        (1..80_usize).prop_map(Dtype::FixedStr),
        (1..80_usize).prop_map(Dtype::FixedUtf8),
        Just(Dtype::VarStr),
        Just(Dtype::VarAscii),
    ]
}

/// An array of any type with up to three axes; some are scalars, some empty, some without a dataspace.
fn array() -> impl Strategy<Value = Array> {
    let shape = prop_oneof![1 => Just(None), 12 => vec(0..5_usize, 0..4).prop_map(Some)];
    (dtype(), shape, vec(any::<u8>(), 64)).prop_map(|(dtype, shape, noise)| {
        let Some(shape) = shape else {
            return Array { dtype, shape: vec![], bytes: vec![] };
        };
        let count: usize = shape.iter().product();
        let at = |i: usize| noise[i % noise.len()].wrapping_add(i as u8);
        // text without a zero byte inside: HDF5 ends strings there
        let word = |i: usize, most: usize| -> String {
            let length = usize::from(at(i)) % (most + 1);
            (0..length).map(|j| char::from(33 + (at(i + j) % 90))).collect()
        };
        let bytes = match &dtype {
            Dtype::Bool => (0..count).map(|i| at(i) % 2).collect(),
            Dtype::FixedStr(n) => (0..count * n).map(at).collect(),
            Dtype::FixedUtf8(n) => (0..count)
                .flat_map(|i| {
                    let mut field = word(i, *n).into_bytes();
                    field.resize(*n, 0);
                    field
                })
                .collect(),
            Dtype::VarStr | Dtype::VarAscii => {
                let words: Vec<String> = (0..count)
                    .map(|i| if dtype == Dtype::VarStr { format!("ä{}", word(i, 40)) } else { word(i, 40) })
                    .collect();
                Array::from_strings(shape.clone(), &words).bytes
            }
            other => (0..count * other.size().unwrap()).map(at).collect(),
        };
        Array { dtype, shape, bytes }
    })
}

fn attrs() -> impl Strategy<Value = Attrs> {
    btree_map("[a-z_]{1,8}", array(), 0..4)
}

/// What a demo has beyond the datasets that every demo has to have.
fn demo(number: usize) -> impl Strategy<Value = Demo> {
    let key = "(obs_x|datagen_info|action_x)/[a-z]{1,3}(/[A-Z]{1,2})?";
    (1..6_usize, btree_map(key, array(), 0..6), attrs(), btree_set("(empty|datagen_info)/[0-9]{1,2}", 0..3), attrs())
        .prop_map(move |(steps, mut datasets, mut own, groups, inner)| {
            // a path cannot be a dataset and the group around another
            let paths: Vec<String> = datasets.keys().cloned().collect();
            datasets.retain(|path, _| !paths.iter().any(|p| p.starts_with(&format!("{path}/"))));
            let action = |i: usize| (i % 11) as f64 / 11.0;
            let actions: Vec<f64> = (0..steps * 3).map(action).collect();
            datasets.insert("actions".to_owned(), Array::from_f64(vec![steps, 3], &actions));
            datasets.insert("obs/object".to_owned(), Array::from_f32(vec![steps, 1], &vec![0.25; steps]));
            own.insert("num_samples".to_owned(), Array::from_i64(vec![], &[steps as i64]));
            let mut demo = Demo { id: format!("demo_{number}"), attrs: own, datasets, groups, ..Demo::default() };
            if !inner.is_empty() {
                demo.inner_attrs.insert("obs/object".to_owned(), inner.clone());
                demo.inner_attrs.insert("obs".to_owned(), inner);
            }
            demo
        })
}

fn root() -> impl Strategy<Value = Demo> {
    (attrs(), btree_map("extra/[a-z]{1,3}", array(), 0..3), attrs(), btree_set("(mask|other)", 0..2)).prop_map(
        |(attrs, datasets, data, groups)| {
            let mut root = Demo { attrs, datasets, groups, ..Demo::default() };
            if !data.is_empty() {
                root.inner_attrs.insert("data".to_owned(), data);
            }
            root
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn written_is_read_again(
        root in root(),
        demos in (demo(0), demo(3), demo(20)),
        gzip in prop_oneof![Just(None), (1..9_u8).prop_map(Some)],
    ) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("any.hdf5");
        let mut writer = RobomimicWriter::create(&path, &WriteOptions { gzip }).unwrap();
        writer.set_root(&root).unwrap();
        let demos = [demos.0, demos.1, demos.2];
        for demo in &demos {
            writer.add_demo(demo).unwrap();
        }
        writer.finish().unwrap();
        let source = Source::open(&path).unwrap().nonfinite(NonFinite::Keep);
        prop_assert_eq!(&source.root().unwrap(), &root);
        for (i, demo) in demos.iter().enumerate() {
            prop_assert_eq!(&source.read_demo(i).unwrap(), demo);
        }
    }

    #[test]
    fn trees_cross_the_pipe_unchanged(demo in demo(7)) {
        let mut bytes = Vec::new();
        codec::put_demo(&mut bytes, &demo);
        prop_assert_eq!(codec::Taker(&bytes).demo(), Some(demo));
        for cut in [0, 1, bytes.len() / 2, bytes.len() - 1] {
            prop_assert_eq!(codec::Taker(&bytes[..cut]).demo(), None);
        }
    }
}
