//! The recursion's memory: rounds without gradient leave nothing behind, so a supervision step that thinks six times as
//! long needs no more memory at its peak. Counted by the allocator, not by the operating system.
#![allow(clippy::unwrap_used)]
#![allow(unsafe_code)] // an allocator is an unsafe trait; this one counts and passes on

use candle_core::{Device, Tensor};
use models::trm::{Config, Gradient, Mixing, Positions, Trm};
use std::alloc::{GlobalAlloc, Layout, System};
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
}
