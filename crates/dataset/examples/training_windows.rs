//! What a training reads, for tests in other languages.
//!
//!     training_windows SET SPLIT HORIZON BATCH SEED STEPS > windows.bin
//!
//! Of each step's batch the numbers in f32, little-endian: `observation.state`, `observation.environment_state` where there
//! is one, `action`, as 0 and 1 the padding, and as 0 to 255 the pictures of each camera.

use std::io::Write;
use std::path::Path;
use std::sync::Arc;

use dataset::shuffle::Sampler;
use dataset::{Dataset, ENVIRONMENT_STATE, STATE, WindowBatch, WindowSpec};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let given: Vec<String> = std::env::args().skip(1).collect();
    let [set, split, horizon, batch_size, seed, steps] = given.as_slice() else {
        return Err("usage: training_windows SET SPLIT HORIZON BATCH SEED STEPS > windows.bin".into());
    };
    let dataset = Dataset::open(Path::new(set))?;
    let numbers = [STATE, ENVIRONMENT_STATE].into_iter().filter(|name| dataset.column(name).is_some());
    let mut windows = dataset.windows(&WindowSpec {
        observation: numbers.map(str::to_owned).collect(),
        n_obs_steps: 1,
        action_horizon: horizon.parse()?,
        episodes: dataset.required_split(split)?,
        mistakes: false,
    })?;
    for camera in dataset.cameras() {
        windows = windows.with_pictures(camera, Arc::new(dataset.pictures(camera)?));
    }
    let mut sampler = Sampler::new(seed.parse()?, batch_size.parse()?);
    let mut batch = WindowBatch::default();
    let mut out = std::io::stdout().lock();
    for step in 0..steps.parse()? {
        windows.gather(&sampler.batch(windows.len(), step), &mut batch);
        let padding: Vec<f32> = batch.is_pad.iter().map(|&pad| f32::from(u8::from(pad))).collect();
        let seen = batch.pictures.iter().map(|(_, bytes)| bytes.iter().map(|&byte| f32::from(byte)).collect());
        let seen: Vec<Vec<f32>> = seen.collect();
        let observed = batch.observation.iter().map(|(_, values)| values);
        for values in observed.chain([&batch.actions, &padding]).chain(&seen) {
            let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
            out.write_all(&bytes)?;
        }
    }
    Ok(())
}
