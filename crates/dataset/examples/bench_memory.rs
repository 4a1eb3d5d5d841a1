//! Measures the memory that converting a large image file takes: `cargo run --release --example bench_memory`.
//!
//!     bench_memory [--gb 3] [--gzip LEVEL] [--images png|ppm] [--keep]
//!
//! Makes a robomimic file of that size (two cameras of 256 x 256, 200 steps a demo) in a process of its own, converts it
//! here, with the isolated reader, and looks at the peak of resident memory of this process and of the reader all along.
//! Writes `target/bench/memory.json`; the file and the data set are removed afterwards. The exit code is 1 above the bar.
//!
//!     bench_memory --frames 10000000 [--keep]
//!
//! The same with a low-dimensional file of so many frames (26 numbers a frame, about 200 frames a demo): converts it, drops an
//! episode from the data set, and merges two halves of it. Prints the CPU seconds and the peak memory of each.

#![allow(clippy::print_stdout)]

use dataset::edit::{self, Destination, Parts, Selection};
use dataset::shuffle::SplitMix64;
use dataset::{Array, ConvertOptions, Demo, ImageForm, RobomimicWriter, WriteOptions, convert, isolation};
use serde_json::json;
use std::ops::ControlFlow;
use std::path::Path;
use std::process::{Command, ExitCode};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Resident memory allowed to both processes together.
const BAR: u64 = 400 << 20;
/// Height and width of the images.
const SIDE: usize = 256;
const STEPS: usize = 200;

type AnyError = Box<dyn std::error::Error>;

struct Args {
    gb: f64,
    frames: Option<usize>,
    gzip: Option<u8>,
    images: ImageForm,
    keep: bool,
    make: bool,
}

fn main() -> Result<ExitCode, AnyError> {
    isolation::serve_if_child();
    let args = parse()?;
    let work = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize()?.join("target/bench/memory");
    std::fs::create_dir_all(&work)?;
    let file = match args.frames {
        Some(frames) => work.join(format!("low_dim_{frames}.hdf5")),
        None => work.join(format!("image_{}_{}.hdf5", args.gb, args.gzip.unwrap_or(0))),
    };
    if args.make {
        match args.frames {
            Some(frames) => make_low_dim(&file, frames)?,
            None => make(&file, &args)?,
        }
        return Ok(ExitCode::SUCCESS);
    }
    if !file.exists() {
        // elsewhere, so that what it takes is not counted here
        let made = Command::new(std::env::current_exe()?).args(std::env::args().skip(1)).arg("--make").status()?;
        if !made.success() {
            return Err("the file could not be made".into());
        }
    }
    if args.frames.is_some() {
        return low_dim(&file, &work, args.keep);
    }
    let out = work.join("set");
    let _ = std::fs::remove_dir_all(&out); // left by a run that was killed
    let start = Instant::now();
    let options = ConvertOptions { images: args.images, fps: Some(20.0), ..ConvertOptions::default() };
    let (report, reader) = watched(|| convert(&file, &out, &options, &mut |_, _| {}));
    let report = report?;
    let (own, seconds) = (peak("self"), start.elapsed().as_secs_f64());
    let bytes = std::fs::metadata(&file)?.len();
    std::fs::remove_dir_all(&out)?;
    if !args.keep {
        std::fs::remove_file(&file)?;
    }
    let met = own + reader <= BAR;
    let form = if args.images == ImageForm::Png { "png" } else { "ppm" };
    let result = json!({
        "file_bytes": bytes, "frames": report.frames, "gzip": args.gzip, "images": form, "seconds": seconds,
        "peak_converter": own, "peak_reader": reader, "bar": BAR, "met": met,
    });
    std::fs::write(work.with_extension("json"), serde_json::to_string_pretty(&result)? + "\n")?;
    println!(
        "{:.2} GB, {} frames as {form} in {seconds:.0} s: {} MiB resident at most here, {} MiB in the reader, bar {} MiB: {}",
        bytes as f64 / 1e9,
        report.frames,
        own >> 20,
        reader >> 20,
        BAR >> 20,
        if met { "met" } else { "MISSED" }
    );
    Ok(if met { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Runs something; the peak of resident memory of the processes that it started, too.
fn watched<T>(run: impl FnOnce() -> T) -> (T, u64) {
    let done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let watch = scope.spawn(|| {
            let mut most = 0;
            while !done.load(Ordering::Relaxed) {
                most = most.max(children().iter().map(|pid| peak(pid)).sum::<u64>());
                std::thread::sleep(Duration::from_millis(5));
            }
            most
        });
        let result = run();
        done.store(true, Ordering::Relaxed);
        (result, watch.join().unwrap_or(0))
    })
}

fn low_dim(file: &Path, work: &Path, keep: bool) -> Result<ExitCode, AnyError> {
    let at = |name: &str| work.join(name);
    let made = ["set", "dropped", "halves", "merged"].map(at);
    let clear = || made.iter().for_each(|folder| drop(std::fs::remove_dir_all(folder)));
    clear();
    let [set, dropped, halves, merged] = &made;
    let mut going = |_, _| ControlFlow::Continue(());
    let mut met = true;
    let mut measure = |name: &str, run: &mut dyn FnMut() -> Result<usize, AnyError>| -> Result<(), AnyError> {
        // the peak starts anew
        std::fs::write("/proc/self/clear_refs", "5")?;
        let (cpu, wall) = (cpu_seconds()?, Instant::now());
        let (frames, reader) = watched(run);
        let (frames, own) = (frames?, peak("self"));
        met &= own + reader <= BAR;
        println!(
            "{name:<8} {frames} frames: {:.1} s of CPU, {:.1} s, {} MiB resident at most here, {} MiB in the reader",
            cpu_seconds()? - cpu,
            wall.elapsed().as_secs_f64(),
            own >> 20,
            reader >> 20,
        );
        Ok(())
    };
    let options = ConvertOptions { fps: Some(20.0), ..ConvertOptions::default() };
    measure("convert", &mut || Ok(convert(file, set, &options, &mut |_, _| {})?.frames))?;
    let chosen = Selection { episodes: vec![3], ..Selection::default() };
    let to = Destination::New(dropped.clone());
    measure("drop", &mut || Ok(edit::without(set, &to, &chosen, &mut going)?.frames))?;
    let parts = Parts::Fractions(vec![("a".to_owned(), 0.5), ("b".to_owned(), 0.5)]);
    edit::split(set, halves, &parts, None, &mut going)?;
    let sets = [halves.join("a"), halves.join("b")];
    measure("merge", &mut || Ok(edit::merge(&sets, merged, &mut going)?.frames))?;
    clear();
    if !keep {
        std::fs::remove_file(file)?;
    }
    Ok(if met { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// CPU time of this process and of its children that have ended.
fn cpu_seconds() -> Result<f64, AnyError> {
    // fields 14 to 17 of /proc/self/stat, in ticks of 10 ms; the name before them may hold spaces
    let stat = std::fs::read_to_string("/proc/self/stat")?;
    let (_, fields) = stat.rsplit_once(')').ok_or("an odd /proc/self/stat")?;
    let ticks: Result<Vec<f64>, _> = fields.split_whitespace().skip(11).take(4).map(str::parse).collect();
    Ok(ticks?.iter().sum::<f64>() / 100.0)
}

fn parse() -> Result<Args, AnyError> {
    let mut args = Args { gb: 3.0, frames: None, gzip: None, images: ImageForm::Ppm, keep: false, make: false };
    let mut given = std::env::args().skip(1);
    while let Some(name) = given.next() {
        let mut value = || given.next().ok_or(format!("{name} needs a value"));
        match name.as_str() {
            "--gb" => args.gb = value()?.parse()?,
            "--frames" => args.frames = Some(value()?.parse()?),
            "--gzip" => args.gzip = Some(value()?.parse()?),
            "--images" => args.images = if value()? == "png" { ImageForm::Png } else { ImageForm::Ppm },
            "--keep" => args.keep = true,
            "--make" => args.make = true,
            _ => return Err(format!("{name}: there is --gb, --frames, --gzip, --images, --keep").into()),
        }
    }
    Ok(args)
}

fn make(file: &Path, args: &Args) -> Result<(), AnyError> {
    println!("making {}", file.display());
    let mut writer = RobomimicWriter::create(file, &WriteOptions { gzip: args.gzip })?;
    let demo_bytes = 2 * STEPS * SIDE * SIDE * 3;
    let demos = (args.gb * 1e9 / demo_bytes as f64).ceil() as usize;
    for number in 0..demos {
        let mut rng = SplitMix64::new(number as u64, 11);
        let mut demo = low_dim_demo(number, STEPS, &mut rng);
        demo.datasets.insert("states".to_owned(), numbers(&mut rng, STEPS, 32));
        for camera in ["agentview_image", "robot0_eye_in_hand_image"] {
            demo.datasets.insert(format!("obs/{camera}"), film(&mut rng));
        }
        writer.add_demo(&demo)?;
    }
    writer.set_data_attr("total", &Array::from_i64(Vec::new(), &[(demos * STEPS) as i64]))?;
    writer.finish()?;
    Ok(())
}

fn make_low_dim(file: &Path, frames: usize) -> Result<(), AnyError> {
    println!("making {}", file.display());
    let mut writer = RobomimicWriter::create(file, &WriteOptions::default())?;
    let (mut made, mut number) = (0, 0);
    while made < frames {
        let steps = (STEPS - 50 + number * 37 % 101).min(frames - made);
        writer.add_demo(&low_dim_demo(number, steps, &mut SplitMix64::new(number as u64, 11)))?;
        (made, number) = (made + steps, number + 1);
    }
    writer.set_data_attr("total", &Array::from_i64(Vec::new(), &[frames as i64]))?;
    writer.finish()?;
    Ok(())
}

fn low_dim_demo(number: usize, steps: usize, rng: &mut SplitMix64) -> Demo {
    let mut demo = Demo { id: format!("demo_{number}"), ..Demo::default() };
    demo.attrs.insert("num_samples".to_owned(), Array::from_i64(Vec::new(), &[steps as i64]));
    for (key, width) in [("object", 10), ("robot0_eef_pos", 3), ("robot0_eef_quat", 4), ("robot0_gripper_qpos", 2)] {
        demo.datasets.insert(format!("obs/{key}"), numbers(rng, steps, width));
    }
    demo.datasets.insert("actions".to_owned(), numbers(rng, steps, 7));
    demo.datasets.insert("rewards".to_owned(), Array::from_f64(vec![steps], &vec![0.0; steps]));
    demo.datasets.insert("dones".to_owned(), Array::from_i64(vec![steps], &vec![0; steps]));
    demo
}

fn numbers(rng: &mut SplitMix64, steps: usize, width: usize) -> Array {
    let values: Vec<f64> = (0..steps * width).map(|_| rng.below(1 << 53) as f64 / (1_u64 << 52) as f64 - 1.0).collect();
    Array::from_f64(vec![steps, width], &values)
}

/// A flat background with noise in the low bits and a moving patch: packs about as well as a rendered scene.
fn film(rng: &mut SplitMix64) -> Array {
    let mut bytes = Vec::with_capacity(STEPS * SIDE * SIDE * 3);
    for frame in 0..STEPS {
        for row in 0..SIDE {
            let noise = rng.next_u64();
            for column in 0..SIDE {
                let patch = row.abs_diff(40 + frame % 100) < 20 && column.abs_diff(60 + frame % 120) < 20;
                let low = (noise >> (column % 61)) as u8 & 3;
                let base = if patch { [200, 40, 30] } else { [90 + (row / 4) as u8, 110, 80 + (column / 4) as u8] };
                bytes.extend(base.map(|c: u8| c | low));
            }
        }
    }
    Array::from_u8(vec![STEPS, SIDE, SIDE, 3], &bytes)
}

/// The processes that this one has started.
fn children() -> Vec<String> {
    let me = std::process::id();
    // a child belongs to the thread that started it
    let tasks = std::fs::read_dir(format!("/proc/{me}/task")).into_iter().flatten().flatten();
    tasks
        .flat_map(|task| {
            let list = std::fs::read_to_string(task.path().join("children")).unwrap_or_default();
            list.split_whitespace().map(str::to_owned).collect::<Vec<_>>()
        })
        .collect()
}

/// Peak of resident memory of a process, in bytes.
fn peak(pid: &str) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap_or_default();
    line.split_whitespace().next().and_then(|n| n.parse::<u64>().ok()).unwrap_or(0) << 10
}
