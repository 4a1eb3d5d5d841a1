//! Pictures in a second of processor time on one core: reading AV1 and H.264, writing AV1, 84 x 84. Processor time,
//! because others may be at work on the machine.
//!
//! `bench_video [FILE ...]`: of these files, or else of the ones that LeRobot wrote for the tests.

use std::path::{Path, PathBuf};

use video::{EncodeOptions, Encoder, Rate, Video};

/// Processor time of this thread, in seconds, as Linux counts it.
fn cpu_seconds() -> Result<f64, Box<dyn std::error::Error>> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat")?;
    let nanoseconds: u64 = text.split(' ').next().unwrap_or_default().parse()?;
    Ok(nanoseconds as f64 / 1e9)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut files: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    if files.is_empty() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures");
        files.extend(["av1_agentview.mp4", "av1_robot0_eye_in_hand.mp4", "h264_agentview.mp4"].map(|f| folder.join(f)));
    }
    let mut pictures = Vec::new();
    for file in &files {
        let video = Video::open(file)?;
        let info = video.info();
        let mut rgb = vec![0; info.picture_bytes()];
        let mut rates = Vec::new();
        for _ in 0..5 {
            let (start, mut count) = (cpu_seconds()?, 0);
            while cpu_seconds()? - start < 1.0 {
                let mut frames = video.frames();
                while let Some(frame) = frames.next_into(&mut rgb) {
                    frame?;
                    count += 1;
                }
            }
            rates.push(f64::from(count) / (cpu_seconds()? - start));
        }
        rates.sort_by(f64::total_cmp);
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        println!(
            "read  {name}: {} x {}, {}, {:.0} images/s (least {:.0}, most {:.0} of 5 s)",
            info.width,
            info.height,
            info.codec.name(),
            rates[2],
            rates[0],
            rates[4]
        );
        if pictures.is_empty() {
            pictures = video.frames().map(|f| f.map(|f| f.rgb)).collect::<Result<Vec<_>, _>>()?;
            let rate = Rate::of(info.fps).ok_or("a rate that is no fraction")?;
            for quantizer in [60, 80, 100] {
                let options = EncodeOptions { quantizer, ..EncodeOptions::default() };
                let start = cpu_seconds()?;
                let mut bytes = 0;
                let rounds = 3;
                for _ in 0..rounds {
                    let mut encoder = Encoder::new(info.width, info.height, rate, &options)?;
                    pictures.iter().try_for_each(|p| encoder.push(p))?;
                    bytes += encoder.finish()?.iter().map(|s| s.bytes.len()).sum::<usize>();
                }
                let count = (rounds * pictures.len()) as f64;
                println!(
                    "write {name}: quantizer {quantizer}: {:.0} images/s, {:.0} bytes each",
                    count / (cpu_seconds()? - start),
                    bytes as f64 / count
                );
            }
        }
    }
    Ok(())
}
