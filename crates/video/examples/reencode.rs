//! Reads a video and writes it again as AV1, as `actrm-data convert --video` writes: `reencode IN OUT [QUANTIZER]`.

use std::io::Write;
use std::path::Path;

use video::{EncodeOptions, Encoder, Muxer, Rate, Video};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [from, to, rest @ ..] = arguments.as_slice() else { return Err("expected IN OUT [QUANTIZER]".into()) };
    let mut options = EncodeOptions::default();
    if let [quantizer] = rest {
        options.quantizer = quantizer.parse()?;
    }
    let video = Video::open(Path::new(from))?;
    let info = video.info();
    let rate = Rate::of(info.fps).ok_or("a rate that is no fraction")?;
    let mut encoder = Encoder::new(info.width, info.height, rate, &options)?;
    for frame in video.frames() {
        encoder.push(&frame?.rgb)?;
    }
    let samples = encoder.finish()?;
    let mut muxer = Muxer::new(u16::try_from(info.width)?, u16::try_from(info.height)?, rate);
    samples.iter().try_for_each(|sample| muxer.push(sample))?;
    let mut file = std::fs::File::create_new(to)?;
    file.write_all(&muxer.header())?;
    samples.iter().try_for_each(|sample| file.write_all(&sample.bytes))?;
    println!("{to}: {} frames, {} bytes", muxer.frames(), file.metadata()?.len());
    Ok(())
}
