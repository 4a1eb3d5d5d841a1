//! zarr replay buffers: every compressor, and what Diffusion Policy and UMI store.

use super::{fixture, quiet};
use crate::common::copy;
use dataset::{ConvertOptions, Dataset, Dtype, Source, convert};
use std::path::Path;

const ENDS: [usize; 4] = [0, 7, 11, 20];

/// Number k of step t, of an array of this width.
fn wide(steps: std::ops::Range<usize>, width: usize) -> Vec<f64> {
    steps.flat_map(|t| (0..width).map(move |k| (3 * t + k) as f64)).collect()
}

fn images(steps: std::ops::Range<usize>) -> Vec<u8> {
    let pixel = |t: usize, y: usize, x: usize| [9 * x + 5 * t, 11 * y + t, 3 * t].map(|v| v as u8);
    steps.flat_map(|t| (0..8).flat_map(move |y| (0..6).flat_map(move |x| pixel(t, y, x)))).collect()
}

#[test]
fn every_compressor_gives_what_zarr_reads() {
    for name in ["blosclz", "lz4", "zlib", "zstd", "gzip", "plain_lz4", "none"] {
        let source = Source::open(&fixture(&format!("zarr/{name}.zarr.zip"))).unwrap();
        assert_eq!(source.plan().problems, [], "{name}");
        for (demo, steps) in ENDS.windows(2).map(|e| e[0]..e[1]).enumerate() {
            let read = source.read_demo(demo).unwrap();
            assert_eq!(read.datasets["actions"].to_f64().unwrap(), wide(steps.clone(), 40), "{name}");
            assert_eq!(read.datasets["obs/state"].to_f64().unwrap(), wide(steps.clone(), 3), "{name}");
            assert_eq!(read.datasets["obs/img"].bytes, images(steps), "{name}");
        }
        // rows across the border of two chunks
        assert_eq!(source.read_rows(1, "obs/img", 1, 3).unwrap().bytes, images(8..11), "{name}");
    }
}

#[test]
fn types_and_chunks_of_any_kind_are_read() {
    let source = Source::open(&fixture("zarr/odd.zarr.zip")).unwrap();
    for (demo, steps) in ENDS.windows(2).map(|e| e[0]..e[1]).enumerate() {
        let read = source.read_demo(demo).unwrap().datasets;
        assert_eq!((&read["actions"].dtype, read["actions"].to_f64().unwrap()), (&Dtype::F64, wide(steps.clone(), 5)));
        assert_eq!(
            (&read["obs/half"].dtype, read["obs/half"].to_f64().unwrap()),
            (&Dtype::F32, wide(steps.clone(), 3))
        );
        assert_eq!(read["obs/keypoint"].to_f64().unwrap(), wide(steps.clone(), 18));
        assert_eq!(read["obs/count"].to_f64().unwrap(), wide(steps.clone(), 1));
        let even: Vec<f64> = wide(steps.clone(), 2).iter().map(|v| f64::from(u8::from(v % 2.0 == 0.0))).collect();
        assert_eq!((&read["obs/flag"].dtype, read["obs/flag"].to_f64().unwrap()), (&Dtype::Bool, even));
        assert_eq!((&read["obs/img"].dtype, &read["obs/img"].bytes), (&Dtype::U8, &images(steps)));
    }
    assert!(source.plan().notes.iter().any(|note| note.contains("float32 images")), "{:?}", source.plan().notes);
}

#[test]
fn a_folder_of_umi_converts_without_options() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    let report = convert(&fixture("zarr/umi.zarr"), &out, &ConvertOptions::default(), &mut quiet).unwrap();
    assert_eq!((report.dialect, report.episodes, report.frames), ("zarr replay buffer", 3, 20));
    assert!(report.notes.iter().any(|note| note.contains("no action is stored")), "{:?}", report.notes);
    assert!(report.notes.iter().any(|note| note.contains("10 Hz")), "{:?}", report.notes);
    let set = Dataset::open(&out).unwrap();
    let (state, action) = (set.column("observation.state").unwrap(), set.column("action").unwrap());
    let pose = |t: usize| [0, 1, 2, 100, 101, 102, 200].map(|offset| (3 * t + offset) as f32);
    assert_eq!((state.dim, action.dim), (7, 7));
    assert_eq!(action.data, (0..20).flat_map(pose).collect::<Vec<_>>());
    assert_eq!(state.data, action.data);
    assert!(set.pictures("observation.images.camera0").unwrap().data == images(0..20));
}

#[test]
fn what_cannot_be_read_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let broken = |name: &str, change: &dyn Fn(&Path)| {
        let store = dir.path().join(name);
        copy(&fixture("zarr/umi.zarr"), &store);
        change(&store);
        let out = dir.path().join(format!("{name}.out"));
        let text = convert(&store, &out, &ConvertOptions::default(), &mut quiet).unwrap_err().to_string();
        assert!(!out.exists() && !text.contains('\n'), "{text}");
        text
    };
    let edit = |store: &Path, array: &str, from: &str, to: &str| {
        let path = store.join(array).join(".zarray");
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.contains(from), "{text}");
        std::fs::write(path, text.replace(from, to)).unwrap();
    };
    let text = broken("jpegxl", &|store| edit(store, "data/camera0_rgb", "\"blosc\"", "\"imagecodecs_jpegxl\""));
    assert!(text.contains("data/camera0_rgb: compressor imagecodecs_jpegxl"), "{text}");
    let text = broken("short", &|store| edit(store, "data/robot0_eef_pos", "20", "19"));
    assert!(text.contains("demo_2: data/robot0_eef_pos: expected 20 (meta/episode_ends) steps"), "{text}");
    let text = broken("huge", &|store| edit(store, "data/camera0_rgb", "8", "80000000"));
    assert!(text.contains("more than 192 MiB"), "{text}");
    let text = broken("cut", &|store| {
        let chunk = store.join("data/robot0_eef_pos/1.0");
        let bytes = std::fs::read(&chunk).unwrap();
        std::fs::write(chunk, &bytes[..bytes.len() - 9]).unwrap();
    });
    assert!(text.contains("data/robot0_eef_pos of demo_1") && text.contains("data/robot0_eef_pos/1.0"), "{text}");
}
