//! Times one TRM supervision step (forward, loss, backward); prints one JSON line like its peer,
//! `benches/peers/trm_torch_replica.py`. Threads: `RAYON_NUM_THREADS`.
//!
//!     RAYON_NUM_THREADS=1 cargo bench -p models --bench trm -- attention 5
#![allow(clippy::unwrap_used, clippy::print_stdout)]

use candle_core::{Device, Tensor};
use models::classification::{ClassProbability, binary_cross_entropy, cross_entropy};
use models::trm::{Config, Gradient, Mixing, Positions, Trm};
use std::time::Instant;

fn main() {
    let args: Vec<String> = std::env::args().skip(1).filter(|arg| !arg.starts_with("--")).collect();
    let mixing = args.first().map_or("attention", String::as_str);
    let repeats: usize = args.get(1).map_or(5, |n| n.parse().unwrap());
    let (batch, len, vocab) = (64, 81, 11);
    let base = Config { num_heads: 8, ..Config::new(vocab, len, 64) };
    let config = match mixing {
        "mlp_t" => Config { mixing: Mixing::MlpT, positions: Positions::None, ..base },
        "conv" => Config { mixing: Mixing::Conv, positions: Positions::None, grid: Some([9, 9]), ..base },
        _ => base,
    };
    let model = Trm::new(config, 0).unwrap();
    let tokens: Vec<u32> = (0..batch * len).map(|i| (i * 7 % vocab) as u32).collect();
    let labels: Vec<i64> = tokens.iter().map(|t| i64::from((t + 3) % vocab as u32)).collect();
    let inputs = Tensor::from_vec(tokens, (batch, len), &Device::Cpu).unwrap();
    let states = model.initial_states(batch).unwrap();
    let targets = Tensor::zeros(batch, candle_core::DType::F32, &Device::Cpu).unwrap();
    let mut seconds = Vec::new();
    for repeat in 0..=repeats {
        let begun = Instant::now();
        let out = model.supervision_step(&states, &inputs, None, Gradient::On).unwrap();
        let flat = out.logits.reshape((batch * len, vocab)).unwrap();
        let class = cross_entropy(&flat, &labels, ClassProbability::Stablemax).unwrap().mean_all().unwrap();
        let halt = binary_cross_entropy(&out.q_halt, &targets).unwrap().mean_all().unwrap();
        let loss = (class.to_dtype(candle_core::DType::F32).unwrap() + (halt * 0.5).unwrap()).unwrap();
        let grads = loss.backward().unwrap();
        assert!(model.params().iter().all(|(_, var)| grads.get(var).is_some()));
        if repeat > 0 {
            seconds.push(begun.elapsed().as_secs_f64());
        }
    }
    seconds.sort_by(f64::total_cmp);
    println!(
        "{{\"work\": \"trm supervision step\", \"mixing\": \"{mixing}\", \"threads\": {}, \"batch\": {batch}, \
         \"wall_min\": {:.4}, \"wall_median\": {:.4}}}",
        candle_core::utils::get_num_threads(),
        seconds[0],
        seconds[seconds.len() / 2]
    );
}
