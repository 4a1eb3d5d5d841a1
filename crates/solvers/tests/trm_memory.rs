//! The recursion's memory: rounds without gradient leave nothing behind, so a supervision step that thinks six times as
//! long needs no more memory at its peak. Counted by the allocator, not by the operating system.
#![allow(clippy::unwrap_used)]
#![allow(unsafe_code)] // an allocator is an unsafe trait; this one counts and passes on

use candle_core::{Device, Tensor};
use models::actrm::{self, Actrm, Over, ReasoningConfig};
use models::{Backend, Batch, Features, Gradients, ParamLayout, PolicyModel, Rng, Signature};
use solvers::trm::{Config, Gradient, Mixing, Positions, Trm};
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::SeqCst};

struct Counting;

static LIVE: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call goes to the system's allocator as it is.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let live = LIVE.fetch_add(layout.size(), SeqCst) + layout.size();
        PEAK.fetch_max(live, SeqCst);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        LIVE.fetch_sub(layout.size(), SeqCst);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Bytes that one supervision step with its backward pass needs at its peak, beyond what is there before it.
fn peak(config: &Config, composed: bool) -> usize {
    let model = Trm::new(config.clone(), 0).unwrap();
    let (batch, len) = (8, config.seq_len);
    let tokens: Vec<u32> = (0..batch * len).map(|i| (i % config.vocab_size) as u32).collect();
    let inputs = Tensor::from_vec(tokens, (batch, len), &Device::Cpu).unwrap();
    let carry = model.initial_carry(batch).unwrap();
    let before = LIVE.load(SeqCst);
    PEAK.store(before, SeqCst);
    let out = if composed {
        model.supervision_step_composed(&carry, &inputs, None, Gradient::On).unwrap()
    } else {
        model.supervision_step(&carry, &inputs, None, Gradient::On).unwrap()
    };
    let loss = (out.logits.sqr().unwrap().mean_all().unwrap() + out.q_halt.mean_all().unwrap()).unwrap();
    let gradients = loss.backward().unwrap();
    assert!(model.params().iter().all(|(_, var)| gradients.get(var).is_some()));
    PEAK.load(SeqCst) - before
}

/// The same of a training step of ACTRM.
fn peak_of_actrm(over: Over, (h_cycles, l_cycles): (usize, usize)) -> usize {
    let reasoning = ReasoningConfig { over, h_cycles, l_cycles, supervision_steps: 1, ..ReasoningConfig::default() };
    let config = actrm::Config { dim_model: 16, n_heads: 2, action_horizon: 4, reasoning, ..Default::default() };
    let (signature, rows) = (Signature::low_dimensional(3, 2, 2), 8);
    let model = Actrm::new(&config, &signature, 0, &Backend::CPU).unwrap();
    let mut rng = Rng::new(1, "data");
    let (state, environment, actions) = (rng.normals(rows * 3), rng.normals(rows * 2), rng.normals(rows * 4 * 2));
    let observation = Features::of_slices(&state, &environment);
    let batch = Batch::from_slices(&signature, 4, &observation, &actions, &vec![false; rows * 4]).unwrap();
    let mut gradients = Gradients::zeros(Arc::new(ParamLayout::new(model.params()))).unwrap();
    let before = LIVE.load(SeqCst);
    PEAK.store(before, SeqCst);
    model.accumulate_gradients(&batch, &mut rng, &mut gradients).unwrap();
    PEAK.load(SeqCst) - before
}

// one test: the counters are the process's
#[test]
fn memory_is_flat_in_the_rounds_without_gradient() {
    for mixing in [Mixing::Attention, Mixing::MlpT, Mixing::Conv] {
        for composed in [false, true] {
            let config = |h_cycles, l_cycles| Config {
                mixing,
                positions: if mixing == Mixing::Attention { Positions::Rope } else { Positions::None },
                grid: Some([6, 6]),
                num_heads: 2,
                layers: 1,
                inner_size: Some(32),
                h_cycles,
                l_cycles,
                ..Config::new(5, 36, 16)
            };
            // what a process or one of its threads allocates once, whenever that has its first turn, is no part of a step
            let least = |config: Config| (0..4).map(|_| peak(&config, composed)).min().unwrap();
            let (short, long) = (least(config(2, 3)), least(config(12, 3)));
            let what = format!("{mixing:?}, composed {composed}: {short} bytes with 2 rounds, {long} with 12");
            assert!(long as f64 <= 1.02 * short as f64, "{what}");
            // what this counts does grow where it must: with the cycles that keep a graph
            let deep = peak(&config(2, 12), composed);
            assert!(deep as f64 > 1.5 * short as f64, "{what}; {deep} with four times the cycles with gradient");
        }
    }
    for over in [Over::Actions, Over::Memory] {
        let least = |cycles| (0..4).map(|_| peak_of_actrm(over, cycles)).min().unwrap();
        let (short, long, deep) = (least((2, 2)), least((12, 2)), least((2, 12)));
        assert!(long as f64 <= 1.02 * short as f64, "{over:?}: {short} bytes with 2 rounds, {long} with 12");
        assert!(deep as f64 > 1.3 * short as f64, "{over:?}: {short} bytes, {deep} with six times the cycles");
    }
}
