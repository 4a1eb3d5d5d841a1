//! Times one prediction for one observation: ACTRM at its default depth beside ACT of the same width, taking turns.
//! Prints one JSON line a width.
//!
//!     RAYON_NUM_THREADS=1 cargo bench -p models --bench actrm -- 30
#![allow(clippy::unwrap_used, clippy::print_stdout)]

use candle_core::{Device, Tensor};
use models::act::{self, Act};
use models::actrm::{self, Actrm};
use models::{Backend, Features, PolicyModel, Signature};
use std::time::Instant;

fn main() {
    let args: Vec<String> = std::env::args().skip(1).filter(|arg| !arg.starts_with("--")).collect();
    let repeats: usize = args.first().map_or(30, |n| n.parse().unwrap());
    let signature = Signature::low_dimensional(9, 10, 7);
    let state = Tensor::from_vec(vec![0.3f32; 9], (1, 9), &Device::Cpu).unwrap();
    let env = Tensor::from_vec(vec![-0.2f32; 10], (1, 10), &Device::Cpu).unwrap();
    let observation = Features::low_dimensional(state, Some(env));
    for (dim_model, dim_feedforward, action_horizon) in [(128, 512, 16), (256, 1024, 32), (512, 3200, 100)] {
        let act = act::Config { dim_model, dim_feedforward, action_horizon, ..act::Config::default() };
        let mut ours = actrm::Config { dim_model, dim_feedforward, action_horizon, ..actrm::Config::default() };
        // every step runs: the worst case of the default depth
        ours.reasoning.halt_threshold = 1.0;
        ours.reasoning.change_threshold = 0.0;
        let models: [Box<dyn PolicyModel>; 2] = [
            Box::new(Act::new(&act, &signature, 0, &Backend::CPU).unwrap()),
            Box::new(Actrm::new(&ours, &signature, 0, &Backend::CPU).unwrap()),
        ];
        let mut seconds = [Vec::new(), Vec::new()];
        for _ in 0..repeats {
            for (model, seconds) in models.iter().zip(&mut seconds) {
                let begun = Instant::now();
                model.predict(&observation).unwrap();
                seconds.push(begun.elapsed().as_secs_f64());
            }
        }
        let [act, ours] = seconds.map(|mut s| {
            s.sort_by(f64::total_cmp);
            (s[0], s[s.len() / 2])
        });
        let count = |i: usize| models[i].params().count();
        println!(
            "{{\"work\": \"prediction of one chunk\", \"dim_model\": {dim_model}, \"threads\": {}, \"act_ms\": {:.3}, \
             \"actrm_ms\": {:.3}, \"ratio_of_minima\": {:.3}, \"ratio_of_medians\": {:.3}, \"act_parameters\": {}, \
             \"actrm_parameters\": {}}}",
            candle_core::utils::get_num_threads(),
            act.0 * 1e3,
            ours.0 * 1e3,
            ours.0 / act.0,
            ours.1 / act.1,
            count(0),
            count(1)
        );
    }
}
