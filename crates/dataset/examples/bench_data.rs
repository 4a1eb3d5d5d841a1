//! Measures converting, opening and loading windows beside the peers: `cargo run --release --example bench_data`.
//!
//! Makes its own demonstrations (200 demos with 53,812 frames; a smaller set with two cameras of 84 x 84), does each
//! piece of work three times and takes the fastest, runs the peers' scripts of `benches/peers` on the same files in
//! `.venv-peers` (or `$ACTRM_PEER_PYTHON`), prints a table and writes `target/bench/data.json`. CPU time includes the
//! isolated reader's. Without the peers' Python only our own numbers are shown.
//!
//! `bench_data --pictures` measures pictures instead: into memory from PNG columns and from AV1 videos, random windows with
//! two of them, and writing videos by the built-in encoder and by FFmpeg beside LeRobot; it writes `target/bench/pictures.json`.

#![allow(clippy::print_stdout)]

use dataset::shuffle::SplitMix64;
use dataset::{
    Array, ConvertOptions, Dataset, DatasetError, Demo, ImageForm, RobomimicWriter, VideoEncoder, VideoOptions,
    WindowBatch, WindowSpec, WriteOptions, convert, isolation,
};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::time::Instant;

/// Pieces of work are done this often; the fastest counts.
const REPEATS: usize = 3;
/// Converting pictures, ours and the peer's in turns, is done this often.
const TURNS: usize = 6;
/// Bar for windows: samples a second on one core.
const WINDOWS_BAR: f64 = 1e6;
/// Bar for windows with two pictures: samples a second on one core.
const PICTURE_WINDOWS_BAR: f64 = 20e3;
/// Bar for reading videos: pictures a second on one core.
const READING_BAR: f64 = 1e3;
/// Bar for opening, in milliseconds.
const OPEN_BAR: f64 = 150.0;

type AnyError = Box<dyn std::error::Error>;

fn main() -> Result<(), AnyError> {
    isolation::serve_if_child();
    let repository = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize()?;
    let work = repository.join("target/bench/data");
    std::fs::create_dir_all(&work)?;
    let bench = Bench { peers: Peers::find(&repository), work };
    let mut rows = Vec::new();
    let name = match std::env::args().any(|word| word == "--pictures") {
        true => {
            bench.pictures(&mut rows)?;
            "pictures.json"
        }
        false => {
            bench.low_dim(&mut rows)?;
            bench.images(&mut rows)?;
            "data.json"
        }
    };
    let text = serde_json::to_string_pretty(&rows)?;
    std::fs::write(repository.join("target/bench").join(name), text + "\n")?;
    print_table(&rows);
    Ok(())
}

struct Bench {
    peers: Option<Peers>,
    work: PathBuf,
}

struct Peers {
    python: PathBuf,
    scripts: PathBuf,
}

impl Peers {
    fn find(repository: &Path) -> Option<Self> {
        let python = std::env::var_os("ACTRM_PEER_PYTHON")
            .map_or_else(|| repository.join(".venv-peers/bin/python"), PathBuf::from);
        python.exists().then(|| Self { python, scripts: repository.join("benches/peers") })
    }

    fn run(&self, script: &str, args: &[&str]) -> Result<Value, AnyError> {
        let output = Command::new(&self.python).arg(self.scripts.join(script)).args(args).output()?;
        if !output.status.success() {
            return Err(format!("{script}: {}", String::from_utf8_lossy(&output.stderr)).into());
        }
        let text = String::from_utf8(output.stdout)?;
        Ok(serde_json::from_str(text.lines().last().unwrap_or_default())?)
    }
}

/// The best rate of several runs of a peer, `count` a second of `seconds`.
fn best_rate(count: &str, seconds: &str, mut run: impl FnMut() -> Result<Value, AnyError>) -> Result<f64, AnyError> {
    let mut best = 0.0_f64;
    for _ in 0..REPEATS {
        let report = run()?;
        let number = |key: &str| report[key].as_f64().unwrap_or(f64::NAN);
        best = best.max(number(count) / number(seconds));
    }
    Ok(best)
}

/// CPU and wall seconds.
#[derive(Clone, Copy)]
struct Cost {
    cpu: f64,
    wall: f64,
}

/// The fastest of several runs.
fn measure(run: impl FnMut() -> Result<(), DatasetError>) -> Result<Cost, AnyError> {
    measure_after(|| (), run)
}

/// The fastest of several runs; what is prepared before each is not timed.
fn measure_after(
    mut prepare: impl FnMut(),
    mut run: impl FnMut() -> Result<(), DatasetError>,
) -> Result<Cost, AnyError> {
    let mut best = Cost { cpu: f64::INFINITY, wall: f64::INFINITY };
    for _ in 0..REPEATS {
        prepare();
        let (cpu, wall) = (cpu_seconds()?, Instant::now());
        run()?;
        best.cpu = best.cpu.min(cpu_seconds()? - cpu);
        best.wall = best.wall.min(wall.elapsed().as_secs_f64());
    }
    Ok(best)
}

/// CPU time of this process and of its children that have ended.
fn cpu_seconds() -> Result<f64, AnyError> {
    // fields 14 to 17 of /proc/self/stat, in ticks of 10 ms; the name before them may hold spaces
    let stat = std::fs::read_to_string("/proc/self/stat")?;
    let (_, fields) = stat.rsplit_once(')').ok_or("an odd /proc/self/stat")?;
    let ticks: Result<Vec<f64>, _> = fields.split_whitespace().skip(11).take(4).map(str::parse).collect();
    Ok(ticks?.iter().sum::<f64>() / 100.0)
}

fn row(
    work: &str,
    unit: &str,
    ours: f64,
    peer: Option<(&str, f64)>,
    ratio_bar: Option<f64>,
    own_bar: Option<f64>,
) -> Value {
    // rates: more is better; times: less is better
    let is_time = unit == "ms";
    let ratio = peer.map(|(_, theirs)| if is_time { theirs / ours } else { ours / theirs });
    let meets = |value: f64, bar: f64| if is_time { value <= bar } else { value >= bar };
    let met = own_bar.is_none_or(|bar| meets(ours, bar)) && ratio_bar.is_none_or(|bar| ratio.is_none_or(|r| r >= bar));
    json!({
        "work": work, "unit": unit, "ours": ours, "peer": peer.map(|p| p.0), "theirs": peer.map(|p| p.1),
        "ratio": ratio, "ratio_bar": ratio_bar, "bar": own_bar, "met": met,
    })
}

impl Bench {
    fn low_dim(&self, rows: &mut Vec<Value>) -> Result<(), AnyError> {
        let file = self.work.join("low_dim.hdf5");
        if !file.exists() {
            make(&file, 200, 53_812, false)?;
        }
        let out = self.fresh("low_dim")?;
        let cost = measure_after(
            || remove(&out),
            || convert(&file, &out, &options(ImageForm::Png), &mut |_, _| {}).map(drop),
        )?;
        let set = Dataset::open(&out)?;
        let frames = set.frames() as f64;
        let ours = frames / cost.cpu;
        let (file_text, out_text) = (text(&file)?, text(&out)?);
        let work = "low-dim convert, CPU";
        match &self.peers {
            None => rows.push(row(work, "frames/s", ours, None, None, None)),
            Some(peers) => {
                let script = |name: &str| {
                    best_rate("frames", "cpu_seconds", || {
                        let peer_out = self.fresh("peer")?;
                        peers.run(name, &[file_text, text(&peer_out)?])
                    })
                };
                let theirs = script("convert_h5py_pyarrow.py")?;
                rows.push(row(work, "frames/s", ours, Some(("h5py + pyarrow", theirs)), Some(3.0), None));
                let theirs = script("convert_lerobot.py")?;
                rows.push(row(work, "frames/s", ours, Some(("LeRobot", theirs)), Some(100.0), None));
            }
        }
        let open = measure(|| Dataset::open(&out).map(drop))?;
        let per_50k = open.wall * 1e3 * 50_000.0 / frames;
        rows.push(row("open 50,000 frames, wall", "ms", per_50k, None, None, Some(OPEN_BAR)));
        let ours = windows(&set)?;
        let work = "windows of 32 actions, batch 64, CPU";
        rows.push(row(work, "samples/s", ours, None, None, Some(WINDOWS_BAR)));
        if let Some(peers) = &self.peers {
            let rate = |name, path| best_rate("samples", "cpu_seconds", || peers.run(name, &[path]));
            let robomimic = rate("windows_robomimic.py", file_text)?;
            rows.push(row(work, "samples/s", ours, Some(("robomimic, cache all", robomimic)), Some(25.0), None));
            let lerobot = rate("windows_lerobot.py", out_text)?;
            rows.push(row(work, "samples/s", ours, Some(("LeRobot", lerobot)), Some(3000.0), None));
        }
        Ok(())
    }

    fn images(&self, rows: &mut Vec<Value>) -> Result<(), AnyError> {
        let file = self.work.join("image.hdf5");
        if !file.exists() {
            make(&file, 20, 5_400, true)?;
        }
        let work = "image convert (2 x 84 x 84, PPM), wall";
        let (mut ours, mut theirs) = (0.0_f64, 0.0_f64);
        // in turns, because both take less time than a machine keeps one speed
        for _ in 0..TURNS {
            let (out, began) = (self.fresh("image")?, Instant::now());
            convert(&file, &out, &options(ImageForm::Ppm), &mut |_, _| {})?;
            ours = ours.max(5_400.0 / began.elapsed().as_secs_f64());
            if let Some(peers) = &self.peers {
                let peer_out = self.fresh("peer")?;
                let args = [text(&file)?, text(&peer_out)?];
                let report = peers.run("convert_h5py_pyarrow.py", &args)?;
                let number = |key: &str| report[key].as_f64().unwrap_or(f64::NAN);
                theirs = theirs.max(number("frames") / number("wall_seconds"));
            }
        }
        let peer = self.peers.as_ref().map(|_| ("h5py + pyarrow", theirs));
        rows.push(row(work, "frames/s", ours, peer, Some(2.0), None));
        remove(&self.work.join("peer"));
        Ok(())
    }

    /// Two cameras of 84 x 84, as PNG columns and as AV1 videos.
    fn pictures(&self, rows: &mut Vec<Value>) -> Result<(), AnyError> {
        let frames = 900;
        let file = self.work.join("pictures.hdf5");
        if !file.exists() {
            make(&file, 6, frames, true)?;
        }
        let (png, video) = (self.fresh("png")?, self.fresh("video")?);
        convert(&file, &png, &options(ImageForm::Png), &mut |_, _| {})?;
        let as_video = ConvertOptions { video: Some(VideoOptions::default()), ..options(ImageForm::Png) };
        let begun = cpu_seconds()?;
        convert(&file, &video, &as_video, &mut |_, _| {})?;
        let both = 2.0 * frames as f64;
        let written = both / (cpu_seconds()? - begun);
        rows.push(row("write AV1 84 x 84 (convert --video), CPU", "pictures/s", written, None, None, None));
        self.film(&file, both, rows)?;
        for (form, folder, bar) in [("PNG", &png, None), ("AV1", &video, Some(READING_BAR))] {
            let set = Dataset::open(folder)?;
            let cameras: Vec<String> = set.cameras().map(str::to_owned).collect();
            let cost = measure(|| cameras.iter().try_for_each(|camera| set.pictures(camera).map(drop)))?;
            let work = format!("{form} 84 x 84 into memory, CPU");
            rows.push(row(&work, "pictures/s", both / cost.cpu, None, None, bar));
            let work = format!("windows with 2 images ({form}), batch 64, CPU");
            let ours = windows(&set)?;
            let peer = match &self.peers {
                None => None,
                Some(peers) => {
                    let args = [text(folder)?, "--batches", "4"];
                    let lerobot = best_rate("samples", "cpu_seconds", || peers.run("windows_lerobot.py", &args))?;
                    Some(("LeRobot", lerobot))
                }
            };
            rows.push(row(&work, "samples/s", ours, peer, Some(20.0), Some(PICTURE_WINDOWS_BAR)));
        }
        Ok(())
    }

    /// Videos of the same images by FFmpeg's SVT-AV1 and by LeRobot's, with the same settings; ours read them from HDF5, and
    /// decode what they wrote.
    fn film(&self, file: &Path, images: f64, rows: &mut Vec<Value>) -> Result<(), AnyError> {
        let out = self.fresh("film")?;
        // LeRobot's crf 30
        let video = VideoOptions {
            encoder: VideoEncoder::SvtAv1,
            quantizer: 120,
            side_pictures: false,
            ..VideoOptions::default()
        };
        let plan = ConvertOptions { video: Some(video), lossless: false, ..options(ImageForm::Png) };
        let cost = measure(|| {
            remove(&out);
            convert(file, &out, &plan, &mut |_, _| {}).map(drop)
        });
        let cost = match cost {
            Ok(cost) => cost,
            Err(error) => {
                println!("videos by FFmpeg are not measured: {error}");
                return Ok(());
            }
        };
        let peer = match &self.peers {
            None => None,
            Some(peers) => {
                let folder = self.fresh("peer")?;
                let mut bytes = 0.0;
                let rate = best_rate("images", "cpu_seconds", || {
                    let report = peers.run("encode_lerobot.py", &[text(file)?, text(&folder)?])?;
                    bytes = report["bytes"].as_f64().unwrap_or(f64::NAN) / images;
                    Ok(report)
                })?;
                Some((format!("LeRobot, {bytes:.0} bytes"), rate))
            }
        };
        let bytes = films(&out.join("videos"))? as f64 / images;
        let work = format!("SVT-AV1 84 x 84, {bytes:.0} bytes each, CPU");
        let peer = peer.as_ref().map(|(name, rate)| (name.as_str(), *rate));
        rows.push(row(&work, "images/s", images / cost.cpu, peer, Some(1.0), None));
        Ok(())
    }

    /// A path in the work folder with nothing at it.
    fn fresh(&self, name: &str) -> Result<PathBuf, AnyError> {
        let path = self.work.join(name);
        remove(&path);
        Ok(path)
    }
}

/// Bytes of all files below a folder.
fn films(folder: &Path) -> std::io::Result<u64> {
    let mut bytes = 0;
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        bytes += if entry.file_type()?.is_dir() { films(&entry.path())? } else { entry.metadata()?.len() };
    }
    Ok(bytes)
}

fn text(path: &Path) -> Result<&str, AnyError> {
    path.to_str().ok_or_else(|| "a path that is no text".into())
}

fn remove(path: &Path) {
    // it may not be there
    let _ = std::fs::remove_dir_all(path);
}

fn options(images: ImageForm) -> ConvertOptions {
    ConvertOptions { images, fps: Some(20.0), ..ConvertOptions::default() }
}

/// Samples a second of random batches over the whole set, on this thread.
fn windows(set: &Dataset) -> Result<f64, AnyError> {
    let episodes = (0..set.episodes().len()).collect();
    let observation = [dataset::STATE, dataset::ENVIRONMENT_STATE].map(str::to_owned);
    let observation = observation.into_iter().filter(|name| set.column(name).is_some()).collect();
    let mut windows =
        set.windows(&WindowSpec { observation, n_obs_steps: 1, action_horizon: 32, episodes, mistakes: false })?;
    for camera in set.cameras() {
        windows = windows.with_pictures(camera, Arc::new(set.pictures(camera)?));
    }
    let mut batch = WindowBatch::default();
    let mut samples = 0_usize;
    let mut checksum = 0.0_f32;
    let (cpu, start) = (cpu_seconds()?, Instant::now());
    for epoch in 0.. {
        let order = dataset::shuffle::order(1, epoch, windows.len());
        for indices in order.chunks_exact(64) {
            windows.gather(indices, &mut batch);
            checksum += batch.actions[0];
            samples += 64;
        }
        if start.elapsed().as_secs_f64() > 2.0 {
            break;
        }
    }
    assert!(checksum.is_finite(), "the batches were really filled");
    Ok(samples as f64 / (cpu_seconds()? - cpu))
}

/// Demonstrations with smooth random courses: noise alone would compress like nothing real.
fn make(path: &Path, demos: usize, frames: usize, pictures: bool) -> Result<(), AnyError> {
    println!("making {}", path.display());
    let mut writer = RobomimicWriter::create(path, &WriteOptions::default())?;
    for number in 0..demos {
        let length = frames * (number + 1) / demos - frames * number / demos;
        let mut rng = SplitMix64::new(number as u64, 7);
        let mut demo = Demo { id: format!("demo_{number}"), ..Demo::default() };
        demo.attrs.insert("num_samples".to_owned(), Array::from_i64(vec![], &[length as i64]));
        demo.attrs.insert("model_file".to_owned(), Array::from_str(&"<geom name=\"table\"/>\n".repeat(1500)));
        let keys = [
            ("object", 10),
            ("robot0_eef_pos", 3),
            ("robot0_eef_quat", 4),
            ("robot0_gripper_qpos", 2),
            ("robot0_gripper_qvel", 2),
            ("robot0_joint_pos", 7),
            ("robot0_joint_vel", 7),
        ];
        for (key, width) in keys {
            demo.datasets.insert(format!("obs/{key}"), course(&mut rng, length, width));
        }
        demo.datasets.insert("actions".to_owned(), course(&mut rng, length, 7));
        demo.datasets.insert("states".to_owned(), course(&mut rng, length, 32));
        let mut rewards = vec![0.0; length];
        rewards[length - 1] = 1.0;
        demo.datasets.insert("rewards".to_owned(), Array::from_f64(vec![length], &rewards));
        let dones: Vec<i64> = rewards.iter().map(|&r| r as i64).collect();
        demo.datasets.insert("dones".to_owned(), Array::from_i64(vec![length], &dones));
        if pictures {
            for camera in ["agentview_image", "robot0_eye_in_hand_image"] {
                demo.datasets.insert(format!("obs/{camera}"), film(&mut rng, length));
            }
        }
        writer.add_demo(&demo)?;
    }
    writer.set_data_attr("total", &Array::from_i64(vec![], &[frames as i64]))?;
    let env = json!({"env_name": "Lift", "env_version": "1.5.2", "type": 1, "env_kwargs": {"control_freq": 20}});
    writer.set_data_attr("env_args", &Array::from_str(&env.to_string()))?;
    writer.finish()?;
    Ok(())
}

fn course(rng: &mut SplitMix64, length: usize, width: usize) -> Array {
    let mut uniform = || rng.below(1 << 53) as f64 / (1_u64 << 53) as f64 - 0.5;
    let mut state: Vec<f64> = (0..width).map(|_| uniform()).collect();
    let mut values = Vec::with_capacity(length * width);
    for _ in 0..length {
        for v in &mut state {
            *v = (*v + 0.05 * uniform()).clamp(-1.0, 1.0);
        }
        values.extend_from_slice(&state);
    }
    Array::from_f64(vec![length, width], &values)
}

/// A scene of flat surfaces with a patch that moves and a little noise, as a simulator's images are.
fn film(rng: &mut SplitMix64, length: usize) -> Array {
    const SIDE: usize = 84;
    let mut bytes = Vec::with_capacity(length * SIDE * SIDE * 3);
    for frame in 0..length {
        let (x, y) = (10 + frame % 60, 30 + frame / 7 % 40);
        for row in 0..SIDE {
            for column in 0..SIDE {
                let patch = row.abs_diff(y) < 6 && column.abs_diff(x) < 6;
                let base = if patch { [200, 40, 30] } else { [90 + row as u8, 110, 80 + column as u8 / 2] };
                let noise = rng.below(4) as u8;
                bytes.extend(base.map(|c: u8| c.wrapping_add(noise)));
            }
        }
    }
    Array::from_u8(vec![length, SIDE, SIDE, 3], &bytes)
}

fn print_table(rows: &[Value]) {
    println!("{:<40} {:>16} {:>22} {:>14} {:>9}  bar", "work", "ours", "peer", "theirs", "ratio");
    for r in rows {
        let number = |key: &str| r[key].as_f64().map_or_else(|| "-".to_owned(), |v| format!("{v:.1}"));
        let bar = match (r["ratio_bar"].as_f64(), r["bar"].as_f64()) {
            (Some(ratio), _) => format!(">= {ratio}x"),
            (None, Some(own)) if r["unit"] == "ms" => format!("<= {own}"),
            (None, Some(own)) => format!(">= {own}"),
            (None, None) => "-".to_owned(),
        };
        println!(
            "{:<40} {:>16} {:>22} {:>14} {:>9}  {bar} {}",
            r["work"].as_str().unwrap_or_default(),
            format!("{} {}", number("ours"), r["unit"].as_str().unwrap_or_default()),
            r["peer"].as_str().unwrap_or("-"),
            number("theirs"),
            number("ratio"),
            match (r["ratio_bar"].is_null(), r["ratio"].is_null(), r["met"] == json!(true)) {
                (false, true, _) => "not measured: no peer",
                (_, _, true) => "met",
                (_, _, false) => "MISSED",
            },
        );
    }
}
