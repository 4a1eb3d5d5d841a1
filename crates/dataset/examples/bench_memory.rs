//! Measures the memory that converting a large image file takes: `cargo run --release --example bench_memory`.
//!
//!     bench_memory [--gb 3] [--gzip LEVEL] [--images png|ppm] [--keep]
//!
//! Makes a robomimic file of that size (two cameras of 256 x 256, 200 steps a demo) in a process of its own, converts it
//! here, with the isolated reader, and looks at the peak of resident memory of this process and of the reader all along.
//! Writes `target/bench/memory.json`; the file and the data set are removed afterwards. The exit code is 1 above the bar.

#![allow(clippy::print_stdout)]

use dataset::shuffle::SplitMix64;
use dataset::{Array, ConvertOptions, Demo, ImageForm, RobomimicWriter, WriteOptions, convert, isolation};
use serde_json::json;
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
    let file = work.join(format!("image_{}_{}.hdf5", args.gb, args.gzip.unwrap_or(0)));
    if args.make {
        make(&file, &args)?;
        return Ok(ExitCode::SUCCESS);
    }
    if !file.exists() {
        // elsewhere, so that what it takes is not counted here
        let made = Command::new(std::env::current_exe()?).args(std::env::args().skip(1)).arg("--make").status()?;
        if !made.success() {
            return Err("the file could not be made".into());
        }
    }
    let out = work.join("set");
    let _ = std::fs::remove_dir_all(&out); // left by a run that was killed
    let (done, start) = (AtomicBool::new(false), Instant::now());
    let options = ConvertOptions { images: args.images, fps: Some(20.0), ..ConvertOptions::default() };
    let (report, reader) = std::thread::scope(|scope| {
        let watch = scope.spawn(|| {
            let mut most = 0;
            while !done.load(Ordering::Relaxed) {
                most = most.max(children().iter().map(|pid| peak(pid)).sum::<u64>());
                std::thread::sleep(Duration::from_millis(5));
            }
            most
        });
        let report = convert(&file, &out, &options, &mut |_, _| {});
        done.store(true, Ordering::Relaxed);
        (report, watch.join().unwrap_or(0))
    });
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

fn parse() -> Result<Args, AnyError> {
    let mut args = Args { gb: 3.0, gzip: None, images: ImageForm::Ppm, keep: false, make: false };
    let mut given = std::env::args().skip(1);
    while let Some(name) = given.next() {
        let mut value = || given.next().ok_or(format!("{name} needs a value"));
        match name.as_str() {
            "--gb" => args.gb = value()?.parse()?,
            "--gzip" => args.gzip = Some(value()?.parse()?),
            "--images" => args.images = if value()? == "png" { ImageForm::Png } else { ImageForm::Ppm },
            "--keep" => args.keep = true,
            "--make" => args.make = true,
            _ => return Err(format!("{name}: there is --gb, --gzip, --images, --keep").into()),
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
        let mut demo = Demo { id: format!("demo_{number}"), ..Demo::default() };
        demo.attrs.insert("num_samples".to_owned(), Array::from_i64(Vec::new(), &[STEPS as i64]));
        for (key, width) in [("object", 10), ("robot0_eef_pos", 3), ("robot0_eef_quat", 4), ("robot0_gripper_qpos", 2)]
        {
            demo.datasets.insert(format!("obs/{key}"), numbers(&mut rng, width));
        }
        demo.datasets.insert("actions".to_owned(), numbers(&mut rng, 7));
        demo.datasets.insert("states".to_owned(), numbers(&mut rng, 32));
        for camera in ["agentview_image", "robot0_eye_in_hand_image"] {
            demo.datasets.insert(format!("obs/{camera}"), film(&mut rng));
        }
        writer.add_demo(&demo)?;
    }
    writer.set_data_attr("total", &Array::from_i64(Vec::new(), &[(demos * STEPS) as i64]))?;
    writer.finish()?;
    Ok(())
}

fn numbers(rng: &mut SplitMix64, width: usize) -> Array {
    let values: Vec<f64> = (0..STEPS * width).map(|_| rng.below(1 << 53) as f64 / (1_u64 << 52) as f64 - 1.0).collect();
    Array::from_f64(vec![STEPS, width], &values)
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
