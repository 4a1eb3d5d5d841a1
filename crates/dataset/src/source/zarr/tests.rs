#![allow(clippy::unwrap_used)]
//! Stores that Python wrote in an unusual way; what it usually writes is in `tests/sets/sources/zarr.rs`.

use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use flate2::read::DeflateEncoder;
use flate2::{Compression, Crc};
use serde_json::{Value, json};
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

use crate::source::Source;

/// An array in chunks of two rows, of which the first is stored.
fn array(store: &Path, path: &str, dtype: &str, shape: &[usize], fill: Value, first: &[u8]) {
    let folder = store.join(path);
    std::fs::create_dir_all(&folder).unwrap();
    let chunks: Vec<usize> = std::iter::once(2).chain(shape[1..].iter().copied()).collect();
    let stated = json!({"zarr_format": 2, "shape": shape, "chunks": chunks, "dtype": dtype, "fill_value": fill,
        "compressor": null, "order": "C", "filters": null});
    std::fs::write(folder.join(".zarray"), stated.to_string()).unwrap();
    std::fs::write(folder.join(vec!["0"; shape.len()].join(".")), first).unwrap();
}

/// Two episodes, of two steps and of one.
fn store() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let store = dir.path().join("some.zarr");
    let ends: Vec<u8> = [2_i64, 3].iter().flat_map(|end| end.to_le_bytes()).collect();
    array(&store, "meta/episode_ends", "<i8", &[2], json!(0), &ends);
    array(&store, "data/action", "<f4", &[3, 1], json!(0.0), &[0; 8]);
    array(&store, "data/state", "<f4", &[3, 1], json!(0.0), &[0; 8]);
    (dir, store)
}

fn refused(store: &Path) -> String {
    Source::open(store).unwrap_err().to_string()
}

#[test]
fn fill_values_are_read_as_they_are_written() {
    let (_dir, store) = store();
    array(&store, "data/tag", "|S4", &[3], json!("eno="), &[b'a'; 8]);
    array(&store, "data/nan", "<f8", &[3], json!("0x7ff8000000000001"), &[0; 16]);
    array(&store, "data/junk", "<f8", &[3], json!("abc"), &[0; 16]);
    let source = Source::open(&store).unwrap().nonfinite(crate::source::NonFinite::Keep);
    assert!(source.plan().problems[0].message.ends_with("data/junk: the fill_value \"abc\" is not supported"));
    let last = source.read_demo_where(1, &|key| key != "obs/junk").unwrap();
    assert_eq!(last.datasets["obs/tag"].bytes, b"zz\0\0");
    assert_eq!(last.datasets["obs/nan"].bytes, 0x7ff8_0000_0000_0001_u64.to_le_bytes());
}

#[test]
fn groups_below_data_are_named() {
    let (_dir, store) = store();
    std::fs::create_dir_all(store.join("data/obs")).unwrap();
    std::fs::write(store.join("data/obs/.zgroup"), "{}").unwrap();
    assert_eq!(Source::open(&store).unwrap().plan().notes, ["groups below data are not read: data/obs"]);
    std::fs::remove_dir_all(store.join("data/state")).unwrap();
    let text = refused(&store);
    assert!(text.contains("no observations: groups below data are not read: data/obs"), "{text}");
}

#[test]
fn what_lies_beside_the_steps_is_named() {
    let (dir, store) = store();
    for path in ["labels", "meta/lang", "extra/deep"] {
        array(&store, path, "<f4", &[2], json!(0.0), &[0; 8]);
    }
    std::fs::write(store.join("extra/.zgroup"), "{}").unwrap();
    for (path, text) in [("", r#"{"fps": 10}"#), ("meta", "{}"), ("data/state", r#"{"unit": "m"}"#)] {
        std::fs::write(store.join(path).join(".zattrs"), text).unwrap();
    }
    let expected = "only the arrays in data and meta/episode_ends are read: left out are labels, extra, meta/lang, .zattrs, \
                    data/state/.zattrs";
    assert_eq!(Source::open(&store).unwrap().plan().notes, [expected]);
    // the same in a zip file
    let path = dir.path().join("some.zip");
    let mut archive = ZipWriter::new(std::fs::File::create(&path).unwrap());
    for file in crate::source::zarr::Store::Folder(store.clone()).files(&store) {
        let name = file.0.strip_prefix(&store).unwrap().display().to_string();
        archive.start_file(name, SimpleFileOptions::default()).unwrap();
        archive.write_all(&std::fs::read(&file.0).unwrap()).unwrap();
    }
    archive.finish().unwrap();
    assert_eq!(Source::open(&path).unwrap().plan().notes, [expected]);
}

#[test]
fn an_array_that_ends_early_loses_the_episodes_beyond() {
    let (_dir, store) = store();
    array(&store, "data/state", "<f4", &[2, 1], json!(0.0), &[0; 8]);
    let source = Source::open(&store).unwrap();
    assert_eq!(source.plan().demos.len(), 1);
    let problem = &source.plan().problems[0];
    assert!(problem.message.ends_with("demo_1: data/state: expected 3 (meta/episode_ends) steps, found shape [2, 1]"));
}

#[test]
fn observations_that_cannot_be_unpacked_are_the_reason() {
    let (_dir, store) = store();
    let stated = store.join("data/state/.zarray");
    let text = std::fs::read_to_string(&stated).unwrap();
    std::fs::write(&stated, text.replace("\"compressor\":null", "\"compressor\":{\"id\":\"bz2\"}")).unwrap();
    assert!(refused(&store).contains("data/state: compressor bz2"), "{}", refused(&store));
}

#[test]
fn zip_files_may_be_packed_and_begin_with_a_folder() {
    let (dir, store) = store();
    let files = ["meta/episode_ends/.zarray", "meta/episode_ends/0", "data/action/.zarray", "data/action/0.0"];
    for (above, packed) in [("some.zarr/", false), ("./", false), ("", true)] {
        let path = dir.path().join("some.zip");
        let mut archive = ZipWriter::new(std::fs::File::create(&path).unwrap());
        let contents = files.map(|file| std::fs::read(store.join(file)).unwrap());
        for (file, content) in files.iter().zip(&contents) {
            archive.start_file(format!("{above}{file}"), SimpleFileOptions::default()).unwrap();
            let mut deflated = Vec::new();
            DeflateEncoder::new(&content[..], Compression::default()).read_to_end(&mut deflated).unwrap();
            archive.write_all(if packed { &deflated } else { content }).unwrap();
        }
        archive.finish().unwrap();
        let mut whole = std::fs::read(&path).unwrap();
        if packed {
            // the directory at the end says how the files are packed, their checksums and their lengths
            let entries: Vec<usize> =
                (0..whole.len() - 4).filter(|&at| whole[at..].starts_with(b"PK\x01\x02")).collect();
            for (at, content) in entries.into_iter().zip(&contents) {
                let mut crc = Crc::new();
                crc.update(content);
                whole[at + 10] = 8;
                whole[at + 16..at + 20].copy_from_slice(&crc.sum().to_le_bytes());
                whole[at + 24..at + 28].copy_from_slice(&(content.len() as u32).to_le_bytes());
            }
            std::fs::write(&path, &whole).unwrap();
        }
        let source = Source::open(&path).unwrap();
        assert_eq!(source.read_rows(0, "actions", 0, 2).unwrap().bytes, contents[3], "{above} {packed}");
        std::fs::write(&path, &whole[..whole.len() - 40]).unwrap();
        assert!(refused(&path).ends_with("it may be cut off"), "{}", refused(&path));
    }
}

#[test]
fn zarr_3_is_told_what_is_read() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("zarr.json"), "{}").unwrap();
    assert!(refused(dir.path()).contains("zarr 2 is read: copy its arrays"), "{}", refused(dir.path()));
}

#[test]
fn steps_that_are_stated_alone_are_refused() {
    let (_dir, store) = store();
    let steps = 1_000_000_000_000_usize;
    array(&store, "meta/episode_ends", "<i8", &[1], json!(0), &[&steps.to_le_bytes()[..], &[0; 8]].concat());
    for path in ["data/action", "data/state"] {
        array(&store, path, "<f4", &[steps, 1], json!(0.0), &[0; 8]);
    }
    let text = refused(&store);
    assert!(text.ends_with("meta/episode_ends: expected at most 16777216 steps, found 1000000000000"), "{text}");
}

#[test]
fn the_files_of_a_linked_array_are_the_stores() {
    let (dir, store) = store();
    std::fs::rename(store.join("data/state"), dir.path().join("state")).unwrap();
    std::os::unix::fs::symlink(dir.path().join("state"), store.join("data/state")).unwrap();
    let files = Source::open(&store).unwrap().plan().files.clone();
    assert!(files.contains(&(store.join("data/state/0.0"), 8)), "{files:?}");
    assert!(files.iter().all(|(path, _)| path.is_file()), "{files:?}");
}
