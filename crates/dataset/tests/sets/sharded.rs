//! A conversion in shards has the bytes of a conversion in one run.

use super::{kinds, quiet, synthetic, write};
use crate::common::files;
use dataset::{
    Array, ConvertOptions, ConvertReport, Dataset, DatasetError, Shard, Source, convert, convert_shard, merge_shards,
    shard_files,
};
use serde_json::{Value, json};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

fn plain() -> ConvertOptions {
    ConvertOptions { fps: Some(20.0), ..ConvertOptions::default() }
}

fn on(_: u64, _: u64) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

/// Converts `source` in so many shards, in folders below `into`.
fn shards(source: &Path, into: &Path, of: usize, options: &ConvertOptions) -> Vec<PathBuf> {
    std::fs::create_dir_all(into).unwrap();
    let all = (1..=of).map(|index| {
        let folder = into.join(format!("{index}"));
        convert_shard(source, &folder, options, Shard { index, of }, &mut on).unwrap();
        folder
    });
    all.collect()
}

/// Makes sure that 1, 2 and 7 shards of `source` come to what one run makes.
fn is_the_same(name: &str, source: &Path, folder: &Path, options: &ConvertOptions) -> ConvertReport {
    let whole = folder.join(format!("{name}_whole"));
    let expected = convert(source, &whole, options, &mut quiet).unwrap();
    let bytes = files(&whole);
    for of in [1, 2, 7] {
        let mut parts = shards(source, &folder.join(format!("{name}_{of}")), of, options);
        parts.reverse();
        let merged = folder.join(format!("{name}_merged_{of}"));
        let report = merge_shards(&merged, &parts, &mut on).unwrap();
        assert_eq!(report, expected, "{name}: {of} shards");
        let found = files(&merged);
        assert_eq!(found.keys().collect::<Vec<_>>(), bytes.keys().collect::<Vec<_>>(), "{name}: {of} shards");
        let other = found.iter().find(|(path, content)| bytes[*path] != **content);
        assert_eq!(other.map(|(path, _)| path), None, "{name}: {of} shards");
    }
    expected
}

#[test]
fn shards_come_to_the_bytes_of_one_run() {
    let dir = tempfile::tempdir().unwrap();
    for (name, side, options) in kinds() {
        // small files, so that groups are cut and files roll over; an episode of several groups where there are images
        let length = |number| if options.video.is_some() { 3 + number } else { 20 + 13 * number };
        let mut demos: Vec<_> = (0..9).map(|number| synthetic(number, length(number), side)).collect();
        if name == "png" {
            for demo in &mut demos {
                let shape = vec![demo.datasets["actions"].shape[0], 24, 24, 1];
                let depth: Vec<f32> = (0..shape.iter().product()).map(|at| crate::made::value(1, at % 977)).collect();
                demo.datasets.insert("obs/agentview_depth".to_owned(), Array::from_f32(shape, &depth));
            }
        }
        let source = dir.path().join(format!("{name}.hdf5"));
        write(&source, &demos);
        let options = ConvertOptions { data_file_mb: 0.05, video_file_mb: 0.02, ..options };
        let report = is_the_same(name, &source, dir.path(), &options);
        assert!(report.files > 6, "{name}: {}", report.files);
    }
}

#[test]
fn shards_of_every_layout_come_to_the_bytes_of_one_run() {
    let dir = tempfile::tempdir().unwrap();
    for (at, source) in crate::made::each(dir.path()).into_iter().enumerate() {
        let options = ConvertOptions { fps: Some(10.0), ..ConvertOptions::default() };
        if convert(&source, &dir.path().join(format!("{at}_tried")), &options, &mut quiet).is_ok() {
            is_the_same(&at.to_string(), &source, dir.path(), &options);
        }
    }
    let zarr = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/zarr/umi.zarr");
    is_the_same("zarr", &zarr, dir.path(), &ConvertOptions::default());
    let rlds = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/rlds");
    is_the_same("rlds", &rlds, dir.path(), &ConvertOptions::default());
}

/// A folder of episodes of several row groups.
fn aloha(folder: &Path, episodes: usize) {
    std::fs::create_dir_all(folder).unwrap();
    for episode in 0..episodes {
        let file = hdf5::File::create(folder.join(format!("episode_{episode}.hdf5"))).unwrap();
        crate::made::floats(&file, "action", &[1500, 14], 1 + episode);
        crate::made::floats(&file, "observations/qpos", &[1500, 14], 50 + episode);
        file.close().unwrap();
    }
}

#[test]
fn a_shard_reads_its_own_files_alone() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("aloha");
    aloha(&source, 12);
    let options = ConvertOptions::default();
    is_the_same("aloha", &source, dir.path(), &options);
    let of = 3;
    let mut named = Vec::new();
    for index in 1..=of {
        let shard = Shard { index, of };
        let mine = shard_files(&source, &options, shard).unwrap();
        assert!(!mine.is_empty() && mine.len() < 12, "{}", mine.len());
        // what is no file of the shard loses its values, but for the first ones
        let other = dir.path().join(format!("stage_{index}/aloha"));
        crate::common::copy(&source, &other);
        for entry in std::fs::read_dir(&other).unwrap() {
            let path = entry.unwrap().path();
            if !mine.contains(&source.join(path.file_name().unwrap())) {
                let keys = Source::open(&path).unwrap().plan().demos[0].keys.clone();
                let mut content = std::fs::read(&path).unwrap();
                for key in keys.values() {
                    let at = key.place.offset.unwrap() as usize;
                    content[at + 64..at + key.bytes().unwrap() as usize].fill(0);
                }
                std::fs::write(&path, content).unwrap();
            }
        }
        convert_shard(&other, &dir.path().join(format!("part_{index}")), &options, shard, &mut on).unwrap();
        named.extend(mine);
    }
    named.sort();
    named.dedup();
    assert_eq!(named.len(), 12);
    let parts: Vec<_> = (1..=of).map(|index| dir.path().join(format!("part_{index}"))).collect();
    merge_shards(&dir.path().join("all"), &parts, &mut on).unwrap();
    assert_eq!(files(&dir.path().join("all")), files(&dir.path().join("aloha_whole")));
}

#[test]
fn a_shard_that_was_stopped_is_converted_again_and_a_complete_one_stays() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("a.hdf5");
    write(&source, &(0..40).map(|number| synthetic(number, 300, None)).collect::<Vec<_>>());
    let options = plain();
    let (shard, folder) = (Shard { index: 2, of: 2 }, dir.path().join("two"));
    let mut calls = 0;
    let stop = &mut |_, _| {
        calls += 1;
        if calls > 1 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let stopped = convert_shard(&source, &folder, &options, shard, stop).unwrap_err();
    assert!(matches!(stopped, DatasetError::Stopped { .. }), "{stopped}");
    assert!(!folder.exists());
    // nor is a hash of a file of 64 GiB, most of it a hole, waited for
    let (opened, first) = (std::fs::File::options().write(true).open(&source).unwrap(), Shard { index: 1, of: 2 });
    let (size, start) = (opened.metadata().unwrap().len(), std::time::Instant::now());
    opened.set_len(64 << 30).unwrap();
    let stopped = convert_shard(&source, &dir.path().join("one"), &options, first, &mut |_, _| ControlFlow::Break(()));
    assert!(matches!(stopped, Err(DatasetError::Stopped { .. })) && start.elapsed().as_secs() < 15, "{stopped:?}");
    opened.set_len(size).unwrap();
    // as a kill leaves it
    std::fs::create_dir_all(dir.path().join(".two.partial-1/rows")).unwrap();
    let made = convert_shard(&source, &folder, &options, shard, &mut on).unwrap();
    assert!(!made.resumed && made.episodes > 0 && made.total_episodes == 40);
    let bytes = files(&folder);
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 2);
    let again = convert_shard(&source, &folder, &options, shard, &mut on).unwrap();
    assert!(again.resumed && (again.episodes, again.bytes) == (made.episodes, made.bytes));
    assert_eq!(files(&folder), bytes);
    // a shard that lacks a file is not complete
    std::fs::rename(folder.join("rest.bin"), dir.path().join("rest.bin")).unwrap();
    let refused = convert_shard(&source, &folder, &options, shard, &mut on).unwrap_err().to_string();
    assert!(refused.contains("rest.bin: shard 2/2: expected the file") && refused.contains("again"), "{refused}");
    std::fs::rename(dir.path().join("rest.bin"), folder.join("rest.bin")).unwrap();
    // another shard, other options
    let other = ConvertOptions { lossless: false, ..plain() };
    for (options, shard) in [(&options, Shard { index: 1, of: 2 }), (&other, shard)] {
        let refused = convert_shard(&source, &folder, options, shard, &mut on).unwrap_err();
        assert!(matches!(refused, DatasetError::OutputExists { .. }), "{refused}");
    }
    std::fs::remove_dir_all(&folder).unwrap();
    convert_shard(&source, &folder, &options, shard, &mut on).unwrap();
    assert_eq!(files(&folder), bytes);
}

#[test]
fn shards_that_do_not_belong_together_are_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let demos = |first: usize| (first..first + 4).map(|number| synthetic(number, 60, None)).collect::<Vec<_>>();
    write(&at("a.hdf5"), &demos(0));
    std::fs::create_dir(at("other")).unwrap();
    let mut changed = demos(0);
    changed[3].datasets.get_mut("actions").unwrap().bytes[5] ^= 1;
    write(&at("other/a.hdf5"), &changed);
    write(&at("b.hdf5"), &demos(4));
    let options = plain();
    let a = shards(&at("a.hdf5"), &at("parts"), 3, &options);
    let told = |shards: &[PathBuf], words: &[&str]| {
        let error = merge_shards(&at("out"), shards, &mut on).unwrap_err().to_string();
        words.iter().for_each(|word| assert!(error.contains(word), "{error}"));
        assert!(!at("out").exists());
    };
    told(&a[..2], &["parts/1: shards of a.hdf5: expected all 3, found 2 of them; missing: 3"]);
    told(&[a[0].clone(), a[1].clone(), a[1].clone()], &["parts/2: shard 2/3: expected each shard once", "parts/2"]);
    let mixed = |more: &Path| [a[0].clone(), a[1].clone(), more.to_path_buf()];
    let b = shards(&at("b.hdf5"), &at("b"), 3, &options);
    told(&mixed(&b[2]), &["b/3: shard 3/3: expected one of the 3 of a.hdf5", "parts/1", "found one of b.hdf5"]);
    let twin = shards(&at("other/a.hdf5"), &at("twin"), 3, &options);
    told(&mixed(&twin[2]), &["twin/3: shard 3/3: expected", "found one of another source of that name"]);
    let four = shards(&at("a.hdf5"), &at("four"), 4, &options);
    told(&mixed(&four[2]), &["four/3: shard 3/4: expected", "found one of 4 shards"]);
    let lean = shards(&at("a.hdf5"), &at("lean"), 3, &ConvertOptions { lossless: false, ..options.clone() });
    told(&mixed(&lean[2]), &["lean/3: shard 3/3: expected", "of other options"]);
    told(&mixed(&at("nothing")), &["nothing: shard: expected a folder", "nothing at that path"]);
    let set = at("set");
    convert(&at("a.hdf5"), &set, &options, &mut quiet).unwrap();
    told(&mixed(&set), &["set: shard: expected a folder that", "without shard.json"]);
    // a damaged one
    for name in ["episodes.bin", "rows/chunk-000/file-000.parquet", "rest.bin"] {
        let path = a[0].join(name);
        let content = std::fs::read(&path).unwrap();
        let mut bad = content.clone();
        bad[content.len() / 2] ^= 1;
        std::fs::write(&path, bad).unwrap();
        told(&a, &[&format!("parts/1/{name}: shard 1/3: expected sha256"), "convert this shard again"]);
        std::fs::write(&path, content).unwrap();
    }
    // one that was made up
    type Change = fn(&mut Value);
    let made_up: [(Change, &str); 2] = [
        (
            |state| state["head"]["features"][0][0] = json!("../../x"),
            "parts/1/shard.json: features: expected names that stay inside the folder",
        ),
        (|state| state["shard"]["of"] = json!(1_000_000_000_000_000_u64), "from 1/N to N/N, of 100000 at most"),
    ];
    for (change, words) in made_up {
        let path = a[0].join("shard.json");
        let content = std::fs::read(&path).unwrap();
        let mut state: Value = serde_json::from_slice(&content).unwrap();
        change(&mut state);
        std::fs::write(&path, state.to_string()).unwrap();
        told(&a, &[words]);
        std::fs::write(&path, content).unwrap();
    }
    merge_shards(&at("out"), &a, &mut on).unwrap();
    // a shard is no data set, and no source
    let said =
        "shard 1/3 of a conversion cannot be read: it is no data set yet; `actrm-data merge` makes one of all shards";
    for error in [
        Dataset::open(&a[0]).unwrap_err(),
        dataset::verify(&a[0], &mut quiet).err().unwrap_or_else(|| Dataset::open(&a[0]).unwrap_err()),
        Source::open(&a[0]).unwrap_err(),
        convert(&a[0], &at("x"), &options, &mut quiet).unwrap_err(),
        dataset::export(&a[0], &at("x.hdf5"), &dataset::WriteOptions::default(), &mut quiet).unwrap_err(),
    ] {
        assert!(error.to_string().contains(said), "{error}");
    }
    for (index, of) in [(0, 3), (4, 3)] {
        let error = convert_shard(&at("a.hdf5"), &at("x"), &options, Shard { index, of }, &mut on).unwrap_err();
        assert!(error.to_string().contains("counted from 1/N to N/N"), "{error}");
    }
    let skipping = ConvertOptions { skip_bad: true, ..options };
    let error = convert_shard(&at("a.hdf5"), &at("x"), &skipping, Shard { index: 1, of: 3 }, &mut on).unwrap_err();
    assert!(error.to_string().contains("leaving out bad demos"), "{error}");
}
