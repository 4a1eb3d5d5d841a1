//! The network of the TRM on plain slices, forward and backward, several puzzles at a time.
//!
//! The recursion treats every puzzle by itself, so a few puzzles are taken through a whole layer
//! while its activations stay in the cache, and groups of puzzles are shared out over threads. A
//! pass with gradient writes its activations to a tape that the backward pass reads; one without
//! uses a tape of a single layer again and again.

use super::elementwise as ew;
use super::layer::{LayerPacks, Scratch, sized};
use super::plan::Plan;
use std::ops::Range;

/// The states of some puzzles and what is injected, as plain slices.
pub(super) struct Round<'a> {
    pub(super) z_h: &'a mut [f32],
    pub(super) z_l: &'a mut [f32],
    pub(super) embedded: &'a [f32],
}

impl Plan {
    /// The network on `state + injected`, result in `state`; layers write to successive stretches
    /// of `tape`, or all to the same if it holds only one.
    fn network(
        &self,
        packs: &[LayerPacks],
        state: &mut [f32],
        injected: &[f32],
        tape: &mut [f32],
        keep: bool,
        scratch: &mut Scratch,
    ) {
        let puzzles = state.len() / (self.len * self.dim);
        let size = self.layer_tape(puzzles);
        let marks = self.marks(puzzles);
        ew::sum_into(&mut tape[..state.len()], state, injected);
        for (layer, packs) in packs.iter().enumerate() {
            let at = if keep { layer * size } else { 0 };
            self.layer_forward(packs, puzzles, &mut tape[at..at + size], scratch);
            let last = layer + 1 == self.layers;
            if last {
                state.copy_from_slice(&tape[at..at + size][marks.out.clone()]);
            } else {
                let to = if keep { at + size } else { 0 };
                tape.copy_within(at + marks.out.start..at + marks.out.end, to);
            }
        }
    }

    /// `cycles` rounds of `l_cycles` updates of `z_l` and one of `z_h` on one group of puzzles.
    /// With `keep` there is one round, and everything goes to the tape.
    fn rounds(
        &self,
        packs: &[LayerPacks],
        round: &mut Round<'_>,
        (cycles, l_cycles): (usize, usize),
        tape: &mut [f32],
        keep: bool,
        scratch: &mut Scratch,
    ) {
        let puzzles = round.z_h.len() / (self.len * self.dim);
        let size = self.layers * self.layer_tape(puzzles);
        let mut injected = vec![0.0; round.z_h.len()];
        for _ in 0..cycles {
            ew::sum_into(&mut injected, round.z_h, round.embedded);
            for cycle in 0..l_cycles {
                let tape = if keep { &mut tape[cycle * size..(cycle + 1) * size] } else { &mut *tape };
                self.network(packs, round.z_l, &injected, tape, keep, scratch);
            }
            let tape = if keep { &mut tape[l_cycles * size..(l_cycles + 1) * size] } else { &mut *tape };
            self.network(packs, round.z_h, round.z_l, tape, keep, scratch);
        }
    }

    /// Numbers in the tape of one round for `puzzles`.
    fn round_tape(&self, puzzles: usize, l_cycles: usize) -> usize {
        (l_cycles + 1) * self.layers * self.layer_tape(puzzles)
    }

    /// Cuts `batch` puzzles into groups.
    fn groups(&self, batch: usize) -> impl Iterator<Item = Range<usize>> {
        let size = self.group().min(batch.max(1));
        (0..batch.div_ceil(size)).map(move |i| i * size..((i + 1) * size).min(batch))
    }

    /// Rounds without gradient over the whole batch, in place, on `threads` threads.
    pub(super) fn run(
        &self,
        packs: &[LayerPacks],
        (z_h, z_l, embedded): (&mut [f32], &mut [f32], &[f32]),
        cycles: (usize, usize),
        threads: usize,
    ) {
        let jobs = self.jobs(z_h, z_l, embedded);
        share(jobs, threads, |jobs| {
            let (mut scratch, mut tape) = (Scratch::default(), Vec::new());
            for (puzzles, mut round) in jobs {
                let tape = sized(&mut tape, self.layer_tape(puzzles.len()));
                self.rounds(packs, &mut round, cycles, tape, false, &mut scratch);
            }
        });
    }

    /// One round with gradient over the whole batch, in place; `tape` must have
    /// [`Self::tape_len`] numbers.
    pub(super) fn record(
        &self,
        packs: &[LayerPacks],
        (z_h, z_l, embedded): (&mut [f32], &mut [f32], &[f32]),
        l_cycles: usize,
        tape: &mut [f32],
        threads: usize,
    ) {
        let mut rest = tape;
        let jobs: Vec<_> = self
            .jobs(z_h, z_l, embedded)
            .into_iter()
            .map(|(puzzles, round)| {
                let size = self.round_tape(puzzles.len(), l_cycles);
                let (mine, others) = std::mem::take(&mut rest).split_at_mut(size);
                rest = others;
                (round, mine)
            })
            .collect();
        share(jobs, threads, |jobs| {
            let mut scratch = Scratch::default();
            for (mut round, tape) in jobs {
                self.rounds(packs, &mut round, (1, l_cycles), tape, true, &mut scratch);
            }
        });
    }

    /// Numbers in the tape of [`Self::record`] for `batch` puzzles.
    pub(super) fn tape_len(&self, batch: usize, l_cycles: usize) -> usize {
        self.groups(batch).map(|puzzles| self.round_tape(puzzles.len(), l_cycles)).sum()
    }

    /// The backward of [`Self::record`]: `grad` of the new `z_h` is used up, the gradient of the
    /// embedded input is added to `d_embedded`, and that of the weights is returned.
    pub(super) fn backward(
        &self,
        packs: &[LayerPacks],
        l_cycles: usize,
        tape: &mut [f32],
        (grad, d_embedded): (&mut [f32], &mut [f32]),
        threads: usize,
    ) -> Vec<f32> {
        let per = self.len * self.dim;
        let (mut tapes, mut grads, mut outs) = (tape, grad, d_embedded);
        let batch = grads.len() / per;
        let jobs: Vec<_> = self
            .groups(batch)
            .map(|puzzles| {
                let (mine, others) = std::mem::take(&mut tapes).split_at_mut(self.round_tape(puzzles.len(), l_cycles));
                tapes = others;
                let (grad, others) = std::mem::take(&mut grads).split_at_mut(puzzles.len() * per);
                grads = others;
                let (out, others) = std::mem::take(&mut outs).split_at_mut(puzzles.len() * per);
                outs = others;
                (puzzles.len(), mine, grad, out)
            })
            .collect();
        let parts = share(jobs, threads, |jobs| {
            let mut scratch = Scratch::default();
            let mut into = vec![0.0; self.weights_len()];
            for (puzzles, tape, grad, out) in jobs {
                let size = self.layer_tape(puzzles);
                // the last call updated z_h, every one before it z_l; the gradient of each call's
                // input is that of the state before it, and of what was injected
                for call in (0..=l_cycles).rev() {
                    for layer in (0..self.layers).rev() {
                        let at = (call * self.layers + layer) * size;
                        let tape = &mut tape[at..at + size];
                        let into = (&self.spans(layer), into.as_mut_slice());
                        self.layer_backward(&packs[layer], into, puzzles, tape, grad, &mut scratch);
                    }
                    if call < l_cycles {
                        ew::add(out, grad);
                    }
                }
            }
            into
        });
        // in the order of the threads: the same numbers for the same number of them
        let mut parts = parts.into_iter();
        let mut total = parts.next().unwrap_or_default();
        for part in parts {
            ew::add(&mut total, &part);
        }
        total
    }

    fn jobs<'a>(&self, z_h: &'a mut [f32], z_l: &'a mut [f32], embedded: &'a [f32]) -> Vec<(Range<usize>, Round<'a>)> {
        let per = self.len * self.dim;
        let batch = z_h.len() / per;
        let (mut z_h, mut z_l) = (z_h, z_l);
        self.groups(batch)
            .map(|puzzles| {
                let (h, others) = std::mem::take(&mut z_h).split_at_mut(puzzles.len() * per);
                z_h = others;
                let (l, others) = std::mem::take(&mut z_l).split_at_mut(puzzles.len() * per);
                z_l = others;
                let embedded = &embedded[puzzles.start * per..puzzles.end * per];
                (puzzles, Round { z_h: h, z_l: l, embedded })
            })
            .collect()
    }
}

/// Shares `jobs` out over threads in consecutive stretches; results in the order of the jobs.
fn share<J: Send, R: Send>(jobs: Vec<J>, threads: usize, work: impl Fn(Vec<J>) -> R + Sync) -> Vec<R> {
    let threads = threads.clamp(1, jobs.len().max(1));
    let mut lists: Vec<Vec<J>> = (0..threads).map(|_| Vec::new()).collect();
    let total = jobs.len();
    for (i, job) in jobs.into_iter().enumerate() {
        lists[i * threads / total].push(job);
    }
    if threads == 1 {
        return lists.into_iter().map(work).collect();
    }
    std::thread::scope(|scope| {
        let handles: Vec<_> = lists.into_iter().map(|jobs| scope.spawn(|| work(jobs))).collect();
        handles.into_iter().map(|handle| handle.join().expect("a worker does not panic")).collect()
    })
}
