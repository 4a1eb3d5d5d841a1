//! Depth as columns: converted, read, edited and exported, and as LeRobot's own recorder writes it.

#![allow(clippy::unwrap_used)]

use crate::common::{copy, going};
use arrow_array::{Array as _, ArrayRef, BinaryArray, RecordBatch, StructArray};
use arrow_schema::Field;
use dataset::edit::{Destination, Renames, Selection, keep, merge, rename, without};
use dataset::{
    Array, ConvertOptions, Dataset, Demo, DepthUnit, Dtype, FeatureStats, RobomimicWriter, SampleSpec, Source,
    VideoOptions, WriteOptions, convert, export, verify,
};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;

const FRONT: &str = "observation.images.front";
const FRONT_DEPTH: &str = "observation.images.front_depth";
const SIDE_DEPTH: &str = "observation.images.side_depth";
const WRIST_DEPTH: &str = "observation.images.wrist_depth";
const HEIGHT: usize = 12;
const WIDTH: usize = 9;

fn quiet(_: u64, _: u64) {}

fn theirs() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/depth/lerobot")
}

fn options() -> ConvertOptions {
    ConvertOptions { fps: Some(20.0), ..ConvertOptions::default() }
}

fn content(path: &Path) -> (Demo, Vec<Demo>) {
    let source = Source::open(path).unwrap().nonfinite(dataset::NonFinite::Keep);
    let demos = (0..source.plan().demos.len()).map(|i| source.read_demo(i).unwrap()).collect();
    (source.root().unwrap(), demos)
}

fn sound(root: &Path) {
    for check in verify(root, &mut quiet).unwrap() {
        assert_eq!(check.problem, None, "{}: {}", root.display(), check.name);
    }
}

fn uint16(shape: Vec<usize>, values: &[u16]) -> Array {
    Array { dtype: Dtype::U16, shape, bytes: values.iter().flat_map(|v| v.to_le_bytes()).collect() }
}

/// A demo with a colour camera and three of depth: float32 metres, float64 metres that float32 cannot hold, uint16
/// millimetres.
fn demo(number: usize, length: usize, (height, width): (usize, usize)) -> Demo {
    let mut demo = Demo { id: format!("demo_{number}"), ..Demo::default() };
    demo.attrs.insert("num_samples".to_owned(), Array::from_i64(vec![], &[length as i64]));
    demo.attrs.insert("ep_meta".to_owned(), Array::from_str("{\"lang\": \"look\"}"));
    let pixels = height * width;
    let metres = |i: usize| 0.3 + ((i * 7919 + number * 104_729) % 9973) as f64 / 3000.0;
    let count = length * pixels;
    let mut put = |key: &str, array: Array| drop(demo.datasets.insert(key.to_owned(), array));
    for (key, width) in [("robot0_eef_pos", 3), ("robot0_eef_quat", 4), ("robot0_gripper_qpos", 2)] {
        let values: Vec<f64> = (0..length * width).map(|i| metres(i + 1)).collect();
        put(&format!("obs/{key}"), Array::from_f64(vec![length, width], &values));
    }
    put("actions", Array::from_f64(vec![length, 7], &(0..length * 7).map(metres).collect::<Vec<_>>()));
    let colours: Vec<u8> = (0..count * 3).map(|i| (i * 31 + number) as u8).collect();
    put("obs/front_image", Array::from_u8(vec![length, height, width, 3], &colours));
    let shape = vec![length, height, width, 1];
    let narrow: Vec<f32> = (0..count + pixels).map(|i| metres(i) as f32).collect();
    put("obs/front_depth", Array::from_f32(shape.clone(), &narrow[..count]));
    put("next_obs/front_depth", Array::from_f32(shape.clone(), &narrow[pixels..]));
    let wide: Vec<f64> = (0..count).map(|i| metres(i + 3)).collect();
    put("obs/side_depth", Array::from_f64(shape.clone(), &wide));
    let whole: Vec<u16> = (0..count).map(|i| (metres(i + 5) * 20_000.0) as u16).collect();
    put("obs/wrist_depth", uint16(shape, &whole));
    demo
}

fn write(path: &Path, demos: &[Demo]) {
    let mut writer = RobomimicWriter::create(path, &WriteOptions::default()).unwrap();
    demos.iter().for_each(|demo| writer.add_demo(demo).unwrap());
    let total: usize = demos.iter().map(|d| d.datasets["actions"].shape[0]).sum();
    writer.set_data_attr("total", &Array::from_i64(vec![], &[total as i64])).unwrap();
    writer.finish().unwrap();
}

fn three() -> Vec<Demo> {
    [(0, 4), (1, 6), (2, 5)].into_iter().map(|(number, length)| demo(number, length, (HEIGHT, WIDTH))).collect()
}

/// The values of a column that a dataset becomes.
fn expected(demo: &Demo, key: &str) -> Vec<f32> {
    match demo.datasets[key].dtype {
        Dtype::U16 => {
            demo.datasets[key].bytes.chunks_exact(2).map(|b| f32::from(u16::from_le_bytes([b[0], b[1]]))).collect()
        }
        _ => demo.datasets[key].to_f32().unwrap(),
    }
}

/// The data file of a set with the picture files of one column changed.
fn with_files(root: &Path, column: &str, change: &dyn Fn(usize, &[u8]) -> Vec<u8>) {
    let path = root.join("data/chunk-000/file-000.parquet");
    let builder = ParquetRecordBatchReaderBuilder::try_new(File::open(&path).unwrap()).unwrap();
    let schema = builder.schema().clone();
    let batches: Vec<RecordBatch> = builder.build().unwrap().map(|batch| batch.unwrap()).collect();
    let mut writer = ArrowWriter::try_new(File::create(&path).unwrap(), schema.clone(), None).unwrap();
    let mut row = 0;
    for batch in batches {
        let at = schema.index_of(column).unwrap();
        let pictures = batch.column(at).as_any().downcast_ref::<StructArray>().unwrap().clone();
        let (fields, mut columns, nulls) = pictures.into_parts();
        let files = columns[0].as_any().downcast_ref::<BinaryArray>().unwrap();
        let files: Vec<Vec<u8>> = files.iter().enumerate().map(|(i, file)| change(row + i, file.unwrap())).collect();
        columns[0] = Arc::new(BinaryArray::from_iter_values(files));
        let mut all: Vec<ArrayRef> = batch.columns().to_vec();
        row += batch.num_rows();
        all[at] = Arc::new(StructArray::new(fields, columns, nulls));
        writer.write(&RecordBatch::try_new(schema.clone(), all).unwrap()).unwrap();
    }
    writer.close().unwrap();
}

/// How a set's data file describes a column.
fn field(root: &Path, column: &str) -> Field {
    let file = File::open(root.join("data/chunk-000/file-000.parquet")).unwrap();
    ParquetRecordBatchReaderBuilder::try_new(file).unwrap().schema().field_with_name(column).unwrap().clone()
}

fn numbers(episodes: &[usize]) -> Selection {
    Selection { episodes: episodes.to_vec(), ..Selection::default() }
}

fn near(found: &FeatureStats, wanted: &FeatureStats, tolerance: f64, quantiles: f64) {
    assert_eq!((found.count, &found.min, &found.max), (wanted.count, &wanted.min, &wanted.max));
    let pairs = found.quantiles().into_iter().zip(wanted.quantiles()).map(|(a, b)| (a[0], b[0], quantiles));
    let moments = [(found.mean[0], wanted.mean[0], tolerance), (found.std[0], wanted.std[0], tolerance)];
    for (a, b, tolerance) in pairs.chain(moments) {
        assert!((a - b).abs() <= tolerance, "{a} is not {b}: {found:?} {wanted:?}");
    }
}

#[test]
fn depth_becomes_columns_and_the_file_comes_back_bit_by_bit() {
    let dir = tempfile::tempdir().unwrap();
    let (file, out, back) = (dir.path().join("a.hdf5"), dir.path().join("set"), dir.path().join("b.hdf5"));
    let demos = three();
    write(&file, &demos);
    let report = convert(&file, &out, &options(), &mut quiet).unwrap();
    assert!(report.notes.iter().all(|note| !note.contains("becomes no column")), "{:?}", report.notes);
    let set = Dataset::open(&out).unwrap();
    assert_eq!(set.cameras().collect::<Vec<_>>(), [FRONT]);
    assert_eq!(set.depth_names().collect::<Vec<_>>(), [FRONT_DEPTH, SIDE_DEPTH, WRIST_DEPTH]);
    // otherwise `datasets` shows the files of images, not images
    assert_eq!(field(&out, FRONT), field(&theirs(), FRONT_DEPTH).with_name(FRONT));
    for (name, key, unit) in
        [(FRONT_DEPTH, "front_depth", "m"), (SIDE_DEPTH, "side_depth", "m"), (WRIST_DEPTH, "wrist_depth", "mm")]
    {
        let feature = set.info().features.get(name).unwrap();
        assert_eq!((feature.dtype.as_str(), &feature.shape[..]), ("image", &[HEIGHT, WIDTH, 1][..]));
        assert_eq!(feature.info, Some(serde_json::json!({"is_depth_map": true, "depth_unit": unit})));
        let mut each = Vec::new();
        for (episode, demo) in demos.iter().enumerate() {
            let maps = set.depth_maps(name, episode).unwrap();
            assert_eq!((maps.height, maps.width, maps.unit.as_deref()), (HEIGHT, WIDTH, Some(unit)));
            let wanted = expected(demo, &format!("obs/{key}"));
            assert!(maps.data == wanted, "{name} of episode {episode}");
            assert_eq!(maps.frame(2), &wanted[2 * HEIGHT * WIDTH..3 * HEIGHT * WIDTH]);
            let frames = (wanted.len() / HEIGHT / WIDTH) as u64;
            each.push(FeatureStats { count: frames, ..FeatureStats::of(&wanted, 1).unwrap() });
        }
        // quantiles of the whole are the episodes' means, as LeRobot has them
        let pooled = FeatureStats::pooled(&each.iter().collect::<Vec<_>>()).unwrap();
        near(&set.stats()[name], &pooled, 1e-9, 1e-9);
    }
    // nearest is white
    let (maps, picture) = (set.depth_maps(FRONT_DEPTH, 0).unwrap(), set.depth_maps(FRONT_DEPTH, 0).unwrap().picture(0));
    let least = maps.frame(0).iter().enumerate().min_by(|a, b| a.1.total_cmp(b.1)).unwrap().0;
    assert_eq!(
        (picture.height, picture.width, picture.rgb[3 * least]),
        (HEIGHT, WIDTH, *picture.rgb.iter().max().unwrap())
    );
    sound(&out);
    export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
    assert!(content(&back) == content(&file));
    // float64 alone is kept twice
    let layout = std::fs::read_to_string(out.join("actrm/layout.json")).unwrap();
    assert!(layout.contains("obs/side_depth") && !layout.contains("obs/front_depth"), "{layout}");
    // content, not storage, has a fingerprint, and threads and file sizes change neither
    let again = dir.path().join("again");
    let small = ConvertOptions { jobs: 1, data_file_mb: 0.01, lossless: false, ..options() };
    convert(&file, &again, &small, &mut quiet).unwrap();
    sound(&again);
    let other = Dataset::open(&again).unwrap();
    assert_eq!((other.fingerprint(), &other.stats()[FRONT_DEPTH]), (set.fingerprint(), &set.stats()[FRONT_DEPTH]));
    assert_eq!(other.depth_maps(WRIST_DEPTH, 2).unwrap(), set.depth_maps(WRIST_DEPTH, 2).unwrap());
}

#[test]
fn long_episodes_in_pieces_are_sampled_as_lerobot_does() {
    let dir = tempfile::tempdir().unwrap();
    let (file, out, back) = (dir.path().join("a.hdf5"), dir.path().join("set"), dir.path().join("b.hdf5"));
    // 320 on a side: every second pixel counts; 130 frames: 100 of them do
    let (length, height, width) = (130, 24, 320);
    let demos = [demo(0, length, (height, width))];
    write(&file, &demos);
    convert(&file, &out, &options(), &mut quiet).unwrap();
    let values = expected(&demos[0], "obs/front_depth");
    let frames = (0..100).map(|i| (i as f64 * 129.0 / 99.0).round_ties_even() as usize);
    let seen: Vec<f32> = frames
        .flat_map(|f| {
            (0..height).step_by(2).flat_map(move |y| (0..width).step_by(2).map(move |x| (f * height + y) * width + x))
        })
        .map(|i| values[i])
        .collect();
    let wanted = FeatureStats { count: 100, ..FeatureStats::of(&seen, 1).unwrap() };
    let set = Dataset::open(&out).unwrap();
    near(&set.stats()[FRONT_DEPTH], &wanted, 1e-9, 1e-9);
    assert!(set.depth_maps(FRONT_DEPTH, 0).unwrap().data == values);
    sound(&out);
    export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
    assert!(content(&back) == content(&file));
}

#[test]
fn depth_is_no_colour_camera() {
    let dir = tempfile::tempdir().unwrap();
    let (file, out) = (dir.path().join("a.hdf5"), dir.path().join("set"));
    write(&file, &three());
    convert(&file, &out, &options(), &mut quiet).unwrap();
    let set = Dataset::open(&out).unwrap();
    let cameras = vec![FRONT_DEPTH.to_owned()];
    let asked = SampleSpec { cameras, episodes: vec![0], ..SampleSpec::default() };
    for told in [
        set.pictures(FRONT_DEPTH).unwrap_err(),
        set.episode_pictures(FRONT_DEPTH, 0).unwrap_err(),
        set.picture_file(FRONT_DEPTH, dir.path()).unwrap_err(),
        set.samples(&asked).map(drop).unwrap_err(),
    ] {
        let told = told.to_string();
        let wanted = format!("no camera {FRONT_DEPTH}; there is depth of that name, which has no colours, and {FRONT}");
        assert!(told.ends_with(&wanted), "{told}");
    }
    let told = set.depth_maps(FRONT, 0).unwrap_err().to_string();
    assert!(told.contains(&format!("no depth {FRONT}; there is {FRONT_DEPTH}, {SIDE_DEPTH}")), "{told}");
}

#[test]
fn samples_hold_depth_in_the_unit_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    let (file, out) = (dir.path().join("a.hdf5"), dir.path().join("set"));
    write(&file, &three());
    convert(&file, &out, &options(), &mut quiet).unwrap();
    let set = Dataset::open(&out).unwrap();
    let depth = vec![WRIST_DEPTH.to_owned(), FRONT_DEPTH.to_owned()];
    let (front, wrist) = (set.depth_maps(FRONT_DEPTH, 2).unwrap(), set.depth_maps(WRIST_DEPTH, 2).unwrap());
    for unit in [DepthUnit::Metres, DepthUnit::Millimetres] {
        let offsets = BTreeMap::from([(FRONT_DEPTH.to_owned(), vec![-1, 0])]);
        let asked =
            SampleSpec { offsets, depth: depth.clone(), depth_unit: unit, episodes: vec![0, 2], cameras: vec![] };
        let samples = set.samples(&asked).unwrap();
        let at = |name: &str| samples.numbers().position(|column| column.name == name).unwrap();
        assert_eq!(samples.numbers().nth(at(FRONT_DEPTH)).unwrap().shape, [1, HEIGHT, WIDTH]);
        assert!(samples.numbers().is_sorted_by_key(|column| &column.name));
        // the second frame of the third episode, behind the four of the first
        let (mut two, mut one) = (vec![0.0; 2 * HEIGHT * WIDTH], vec![0.0; HEIGHT * WIDTH]);
        samples.copy_numbers(at(FRONT_DEPTH), &[5], &mut two);
        samples.copy_numbers(at(WRIST_DEPTH), &[5], &mut one);
        let scaled = |values: &[f32], stored: &str| -> Vec<f32> {
            values.iter().map(|&value| unit.of(Some(stored), value)).collect()
        };
        assert_eq!(two, scaled(&front.data[..2 * HEIGHT * WIDTH], "m"));
        assert_eq!(one, scaled(wrist.frame(1), "mm"));
    }
    assert_eq!(DepthUnit::Millimetres.of(Some("m"), 1.5), 1500.0);
    assert_eq!(DepthUnit::Metres.of(Some("mm"), 1500.0), 1.5);
    assert_eq!((DepthUnit::Metres.of(None, 7.0), DepthUnit::Metres.factor(Some("mm"))), (7.0, 1.0 / 1000.0));
    let asked = SampleSpec { depth: vec![FRONT.to_owned()], episodes: vec![0], ..SampleSpec::default() };
    let told = set.samples(&asked).map(drop).unwrap_err().to_string();
    assert!(told.contains(&format!("no depth {FRONT}; there is {FRONT_DEPTH}")), "{told}");
}

#[test]
fn films_leave_depth_exact() {
    let dir = tempfile::tempdir().unwrap();
    let (file, out, back) = (dir.path().join("a.hdf5"), dir.path().join("set"), dir.path().join("b.hdf5"));
    let demos: Vec<Demo> = (0..2).map(|number| demo(number, 3, (16, 16))).collect();
    write(&file, &demos);
    let video = Some(VideoOptions { speed: 10, ..VideoOptions::default() });
    let report = convert(&file, &out, &ConvertOptions { video, ..options() }, &mut quiet).unwrap();
    let told: Vec<&String> = report.notes.iter().filter(|n| n.contains("TIFF file a frame")).collect();
    assert_eq!(told.len(), 3, "{:?}", report.notes);
    assert!(told[0].starts_with(FRONT_DEPTH) && told[0].contains("12-bit HEVC"), "{}", told[0]);
    let set = Dataset::open(&out).unwrap();
    let dtype = |name: &str| set.info().features.get(name).unwrap().dtype.clone();
    assert_eq!((dtype(FRONT), dtype(FRONT_DEPTH)), ("video".to_owned(), "image".to_owned()));
    assert!(set.depth_maps(WRIST_DEPTH, 1).unwrap().data == expected(&demos[1], "obs/wrist_depth"));
    sound(&out);
    export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
    assert!(content(&back) == content(&file));
    let part = dir.path().join("part");
    keep(&out, &Destination::New(part.clone()), &numbers(&[1]), &mut going).unwrap();
    sound(&part);
    assert_eq!(
        Dataset::open(&part).unwrap().depth_maps(SIDE_DEPTH, 0).unwrap(),
        set.depth_maps(SIDE_DEPTH, 1).unwrap()
    );
}

#[test]
fn what_is_no_distance_is_named_and_can_stay_beside() {
    let dir = tempfile::tempdir().unwrap();
    let cases = [("nan", "obs/front_depth", f64::NAN, "NaN"), ("far", "obs/side_depth", 1e300, "inf")];
    for (name, key, value, shown) in cases {
        let (file, out) = (dir.path().join(format!("{name}.hdf5")), dir.path().join(name));
        let mut demos = three();
        let array = demos[1].datasets.get_mut(key).unwrap();
        let at = 3 * HEIGHT * WIDTH + 2 * WIDTH + 5;
        match array.dtype {
            Dtype::F32 => array.bytes[4 * at..4 * at + 4].copy_from_slice(&(value as f32).to_le_bytes()),
            _ => array.bytes[8 * at..8 * at + 8].copy_from_slice(&value.to_le_bytes()),
        }
        write(&file, &demos);
        let told = convert(&file, &out, &options(), &mut quiet).unwrap_err().to_string();
        assert!(told.contains(&format!("{name}.hdf5: demo_1 {key} frame 3")), "{told}");
        assert!(told.contains("--no-depth") && told.ends_with(&format!("{shown} in row 2, column 5")), "{told}");
        assert!(!out.exists());
        let report = convert(&file, &out, &ConvertOptions { depth: false, ..options() }, &mut quiet).unwrap();
        let note = report.notes.iter().find(|n| n.starts_with(key)).unwrap();
        assert!(note.contains("(--no-depth); the side folder keeps it as stored"), "{note}");
        assert_eq!(Dataset::open(&out).unwrap().depth_names().count(), 0);
        let back = dir.path().join(format!("{name}-back.hdf5"));
        export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
        assert!(content(&back) == content(&file));
    }
    // nor does a column of depth that the file of a data set states
    let [file, bare, through, out] = ["a.hdf5", "bare", "through.hdf5", "out"].map(|name| dir.path().join(name));
    write(&file, &three());
    convert(&file, &bare, &ConvertOptions { lossless: false, ..options() }, &mut quiet).unwrap();
    export(&bare, &through, &WriteOptions::default(), &mut quiet).unwrap();
    let notes = convert(&through, &out, &ConvertOptions { depth: false, ..options() }, &mut quiet).unwrap().notes;
    let note = format!("{FRONT_DEPTH} becomes no column: no depth does (--no-depth)");
    assert!(notes.contains(&note), "{notes:?}");
    let set = Dataset::open(&out).unwrap();
    assert_eq!((set.depth_names().count(), set.cameras().collect::<Vec<_>>()), (0, vec![FRONT]));
}

#[test]
fn names_say_what_is_depth_and_every_demo_must_have_it() {
    let dir = tempfile::tempdir().unwrap();
    let (file, out, back) = (dir.path().join("a.hdf5"), dir.path().join("set"), dir.path().join("b.hdf5"));
    let mut demos = three();
    for demo in &mut demos {
        let length = demo.datasets["actions"].shape[0];
        let depth = demo.datasets["obs/front_depth"].clone();
        // a colour picture of the name that depth would have
        let colours = Array::from_u8(vec![length, 8, 8, 3], &vec![9; length * 192]);
        demo.datasets.insert("obs/top_depth_image".to_owned(), colours);
        demo.datasets.insert("obs/top_depth".to_owned(), depth.clone());
        demo.datasets.insert("obs/images_depth/high".to_owned(), depth.clone());
        demo.datasets.insert("obs/heat".to_owned(), depth);
    }
    for demo in &mut demos {
        let raw: Vec<f32> = demo.datasets["obs/front_depth"].to_f32().unwrap().iter().map(|v| v / 4.0).collect();
        let shape = demo.datasets["obs/front_depth"].shape.clone();
        demo.datasets.insert("obs/raw_depth".to_owned(), Array::from_f32(shape, &raw));
    }
    demos[2].datasets.remove("obs/side_depth");
    let late = demos[1].datasets["obs/front_depth"].clone();
    demos[1].datasets.insert("obs/late_depth".to_owned(), late);
    demos[1].datasets.get_mut("obs/wrist_depth").unwrap().shape = vec![6, WIDTH, HEIGHT, 1];
    write(&file, &demos);
    let report = convert(&file, &out, &options(), &mut quiet).unwrap();
    let set = Dataset::open(&out).unwrap();
    assert_eq!(set.cameras().collect::<Vec<_>>(), [FRONT, "observation.images.top_depth"]);
    let depth = ["front_depth", "images_depth.high", "raw_depth", "depth.top_depth"]
        .map(|name| format!("observation.images.{name}"));
    assert_eq!(set.depth_names().collect::<Vec<_>>(), depth);
    // z-buffers go from 0 to 1
    let doubts: Vec<&String> = report.notes.iter().filter(|n| n.contains("lies between 0 and 1 throughout")).collect();
    assert!(doubts.len() == 1 && doubts[0].starts_with("observation.images.raw_depth"), "{doubts:?}");
    let reason = |key: &str| report.notes.iter().find(|n| n.starts_with(key)).unwrap().clone();
    assert!(reason("obs/side_depth").contains("demo_2 has other depth than demo_0 or none"));
    assert!(reason("obs/wrist_depth").contains("demo_1 has other depth than demo_0 or none"));
    assert!(reason("obs/late_depth").contains("not every demo has this depth"));
    assert!(reason("obs/heat").contains("nothing in its name says that it is depth"));
    sound(&out);
    export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
    assert!(content(&back) == content(&file));
}

#[test]
fn depth_needs_no_axis_for_its_channel() {
    let dir = tempfile::tempdir().unwrap();
    let (file, out, back) = (dir.path().join("a.hdf5"), dir.path().join("set"), dir.path().join("b.hdf5"));
    let mut demos = three();
    for demo in &mut demos {
        for key in ["obs/front_depth", "next_obs/front_depth", "obs/side_depth", "obs/wrist_depth"] {
            let shape = &mut demo.datasets.get_mut(key).unwrap().shape;
            assert_eq!(shape.pop(), Some(1));
        }
        // too small for a picture
        let table = Array::from_f32(
            vec![demo.datasets["actions"].shape[0], 2, 3],
            &vec![0.5; 6 * demo.datasets["actions"].shape[0]],
        );
        demo.datasets.insert("obs/depth_quantiles".to_owned(), table);
    }
    write(&file, &demos);
    convert(&file, &out, &options(), &mut quiet).unwrap();
    let set = Dataset::open(&out).unwrap();
    assert_eq!(set.depth_names().collect::<Vec<_>>(), [FRONT_DEPTH, SIDE_DEPTH, WRIST_DEPTH]);
    for (name, key) in [(FRONT_DEPTH, "front_depth"), (SIDE_DEPTH, "side_depth"), (WRIST_DEPTH, "wrist_depth")] {
        for (episode, demo) in demos.iter().enumerate() {
            assert!(set.depth_maps(name, episode).unwrap().data == expected(demo, &format!("obs/{key}")), "{name}");
        }
    }
    sound(&out);
    export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
    assert!(content(&back) == content(&file));
    assert_eq!(content(&back).1[0].datasets["obs/front_depth"].shape, [4, HEIGHT, WIDTH]);
}

#[test]
fn an_edited_set_is_what_conversion_makes_of_the_same_demos() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let converted = |name: &str, demos: &[Demo]| {
        write(&at(&format!("{name}.hdf5")), demos);
        convert(&at(&format!("{name}.hdf5")), &at(name), &options(), &mut quiet).unwrap();
    };
    let demos = three();
    converted("all", &demos);
    converted("some", &[demos[0].clone(), demos[2].clone()]);
    without(&at("all"), &Destination::New(at("cut")), &numbers(&[1]), &mut going).unwrap();
    converted("first", &demos[..1]);
    converted("rest", &demos[1..]);
    merge(&[at("first"), at("rest")], &at("joined"), &mut going).unwrap();
    for (made, wanted) in [("cut", "some"), ("joined", "all")] {
        sound(&at(made));
        let (a, b) = (Dataset::open(&at(made)).unwrap(), Dataset::open(&at(wanted)).unwrap());
        assert_eq!((a.fingerprint(), a.stats()), (b.fingerprint(), b.stats()), "{made}");
        let back = at(&format!("{made}-back.hdf5"));
        export(&at(made), &back, &WriteOptions::default(), &mut quiet).unwrap();
        assert!(content(&back).1 == content(&at(&format!("{wanted}.hdf5"))).1, "{made}");
    }
    let new = "observation.images.near_depth";
    let renames = Renames::from([(FRONT_DEPTH.to_owned(), new.to_owned())]);
    rename(&at("all"), &Destination::New(at("named")), &renames, &mut going).unwrap();
    sound(&at("named"));
    let (named, all) = (Dataset::open(&at("named")).unwrap(), Dataset::open(&at("all")).unwrap());
    assert_eq!(named.depth_maps(new, 2).unwrap(), all.depth_maps(FRONT_DEPTH, 2).unwrap());
    export(&at("named"), &at("named.hdf5"), &WriteOptions::default(), &mut quiet).unwrap();
    assert!(content(&at("named.hdf5")) == content(&at("all.hdf5")));
    // metres and millimetres are not joined silently
    copy(&theirs(), &at("mm"));
    let info = at("mm/meta/info.json");
    let text = std::fs::read_to_string(&info).unwrap();
    std::fs::write(&info, text.replacen("\"depth_unit\": \"m\"", "\"depth_unit\": \"mm\"", 1)).unwrap();
    let told = merge(&[theirs(), at("mm")], &at("mixed"), &mut going).unwrap_err().to_string();
    let wanted = format!("features.{FRONT_DEPTH}.info: expected depth in m, as in ");
    assert!(told.contains(&wanted) && told.ends_with("found depth in mm"), "{told}");
}

#[test]
fn what_lerobot_recorded_is_read_checked_and_edited() {
    let dir = tempfile::tempdir().unwrap();
    let set = Dataset::open(&theirs()).unwrap();
    assert_eq!(set.cameras().collect::<Vec<_>>(), [FRONT]);
    assert_eq!(set.depth_names().collect::<Vec<_>>(), [FRONT_DEPTH, WRIST_DEPTH]);
    sound(&theirs());
    let lengths = [4, 6, 5];
    for (episode, length) in lengths.into_iter().enumerate() {
        let (metres, millimetres) =
            (set.depth_maps(FRONT_DEPTH, episode).unwrap(), set.depth_maps(WRIST_DEPTH, episode).unwrap());
        assert_eq!((metres.unit.as_deref(), millimetres.unit.as_deref()), (Some("m"), Some("mm")));
        assert_eq!(metres.data.len(), length * 140);
        for (i, (&m, &mm)) in metres.data.iter().zip(&millimetres.data).enumerate() {
            let (t, y, x) = (i / 140, i / 14 % 10, i % 14);
            let k = ((((episode * 31 + t) * 17 + y) * 13 + x) % 997) as f32;
            assert!(m.to_bits() == (k / 100.0).to_bits() && mm == 5.0 * k, "frame {t} of {episode}: {m} {mm}");
        }
    }
    // statistics computed anew are LeRobot's, up to its float32 means; its quantiles come from a histogram and lie
    // anywhere between two values, which are up to 0.3 m apart in so few frames
    let all = dir.path().join("all");
    keep(&theirs(), &Destination::New(all.clone()), &numbers(&[0, 1, 2]), &mut going).unwrap();
    let again = Dataset::open(&all).unwrap();
    near(&again.stats()[FRONT_DEPTH], &set.stats()[FRONT_DEPTH], 1e-5, 0.15);
    near(&again.stats()[WRIST_DEPTH], &set.stats()[WRIST_DEPTH], 5e-3, 75.0);
    let cut = dir.path().join("cut");
    without(&theirs(), &Destination::New(cut.clone()), &numbers(&[0]), &mut going).unwrap();
    sound(&cut);
    let cut = Dataset::open(&cut).unwrap();
    assert_eq!(cut.depth_maps(FRONT_DEPTH, 1).unwrap(), set.depth_maps(FRONT_DEPTH, 2).unwrap());
    assert_eq!(cut.info().features, set.info().features);
}

/// What becomes of a picture's file.
type Change<'c> = &'c dyn Fn(&[u8]) -> Vec<u8>;

#[test]
fn damaged_frames_are_named_wherever_they_are_read() {
    let dir = tempfile::tempdir().unwrap();
    let broken = |name: &str, change: Change<'_>| {
        let root = dir.path().join(name);
        copy(&theirs(), &root);
        // the third frame of the second episode
        with_files(&root, FRONT_DEPTH, &|row, file| if row == 6 { change(file) } else { file.to_vec() });
        root
    };
    let cases: [(&str, Change<'_>, &str); 4] = [
        ("cut", &|file| file[..file.len() - 9].to_vec(), "a broken TIFF file"),
        ("empty", &|_| Vec::new(), "no TIFF file"),
        ("png", &|_| b"\x89PNG\r\n".to_vec(), "no TIFF file"),
        ("wide", &|file| [&file[..18], &[15_u8], &file[19..]].concat(), "an image of 10 x 15 instead of 10 x 14"),
    ];
    for (name, change, what) in cases {
        let root = broken(name, change);
        let named = |told: &str| {
            let wanted = format!("{FRONT_DEPTH}, frame 2 of episode 1: expected ");
            assert!(told.contains(&wanted) && told.contains(what), "{name}: {told}");
        };
        let set = Dataset::open(&root).unwrap();
        set.depth_maps(FRONT_DEPTH, 0).unwrap();
        let told = set.depth_maps(FRONT_DEPTH, 1).unwrap_err().to_string();
        assert!(told.contains("file-000.parquet"), "{told}");
        named(&told);
        let checks = verify(&root, &mut quiet).unwrap();
        named(&checks.iter().find_map(|c| c.problem.clone()).unwrap());
        let out = dir.path().join("out");
        named(&keep(&root, &Destination::New(out.clone()), &numbers(&[1]), &mut going).unwrap_err().to_string());
        assert!(!out.exists());
    }
    let root = broken("nan", &|file| [&file[..134], &f32::NAN.to_le_bytes(), &file[138..]].concat());
    let checks = verify(&root, &mut quiet).unwrap();
    let told = checks.iter().find_map(|c| c.problem.clone()).unwrap();
    assert_eq!(told, format!("{FRONT_DEPTH}: frame 2 of episode 1: NaN in row 0, column 0"));
    // what a set holds already is no reason to refuse an edit of it
    keep(&root, &Destination::New(dir.path().join("kept")), &numbers(&[1]), &mut going).unwrap();
}

#[test]
fn depth_as_video_is_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("set");
    copy(&theirs(), &root);
    let info = root.join("meta/info.json");
    let mut told: serde_json::Value = serde_json::from_slice(&std::fs::read(&info).unwrap()).unwrap();
    let feature = &mut told["features"][FRONT_DEPTH];
    feature["dtype"] = "video".into();
    feature["info"]["video.codec"] = "hevc".into();
    std::fs::write(&info, told.to_string()).unwrap();
    let set = Dataset::open(&root).unwrap();
    let out = dir.path().join("out");
    for told in [
        set.depth_maps(FRONT_DEPTH, 0).unwrap_err().to_string(),
        keep(&root, &Destination::New(out.clone()), &numbers(&[1]), &mut going).unwrap_err().to_string(),
        // one check of several, so that the others are made
        verify(&root, &mut quiet).unwrap().into_iter().find_map(|check| check.problem).unwrap(),
    ] {
        let wanted = format!("{FRONT_DEPTH}: expected depth as images, found depth as a hevc video, which is not read");
        assert!(told.contains(&wanted), "{told}");
    }
    // the others can be read
    assert_eq!(set.depth_maps(WRIST_DEPTH, 0).unwrap().unit.as_deref(), Some("mm"));
}

#[test]
fn depth_of_an_impossible_size_is_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("set");
    copy(&theirs(), &root);
    let info = root.join("meta/info.json");
    let mut told: serde_json::Value = serde_json::from_slice(&std::fs::read(&info).unwrap()).unwrap();
    told["features"][FRONT_DEPTH]["shape"] = serde_json::json!([3_000_000_000_u64, 3_000_000_000_u64, 1]);
    std::fs::write(&info, told.to_string()).unwrap();
    let found = Dataset::open(&root).and_then(|set| set.depth_maps(FRONT_DEPTH, 0)).unwrap_err().to_string();
    assert!(found.contains(FRONT_DEPTH) && found.contains("3000000000"), "{found}");
}
