//! The TRM's step on plain slices, forward and backward by hand (`kernel.rs`, `layer.rs`), as an operation of candle's graph:
//! embedded input and flat weights in, `z_h` out.

mod elementwise;
mod kernel;
mod layer;
mod plan;
mod product;

use super::{Carry, Config, Gradient, Mixing};
use candle_core::{CpuStorage, CustomOp2, Layout, Result as CandleResult, Shape, Storage, Tensor};
use layer::Direction;
use nn::Result;
use plan::{Plan, PlanMix};
use std::sync::{Arc, Mutex};

/// Tapes that are not in use, kept for the next step: fresh memory costs more than the arithmetic.
type Pool = Arc<Mutex<Vec<Vec<f32>>>>;

/// The kernel, ready for a configuration.
#[derive(Debug)]
pub struct Recursion {
    plan: Arc<Plan>,
    pool: Pool,
}

impl Recursion {
    /// The kernel of a configuration, with the angles of rotary positions if it has them.
    ///
    /// # Errors
    /// Angles that are not f32.
    pub fn new(config: &Config, rope: Option<&(Tensor, Tensor)>) -> Result<Self> {
        let mix = match config.mixing {
            Mixing::Attention => {
                let angles = match rope {
                    None => None,
                    Some((cos, sin)) => {
                        // the second half of each row repeats the first
                        let half = cos.dim(1)? / 2;
                        let first = |t: &Tensor| t.narrow(1, 0, half)?.flatten_all()?.to_vec1::<f32>();
                        Some((first(cos)?, first(sin)?))
                    }
                };
                PlanMix::Attention { heads: config.num_heads, angles }
            }
            Mixing::MlpT => PlanMix::MlpT { inner: config.inner(config.positions_len()) },
            Mixing::Conv => {
                let [height, width] = config.grid.expect("checked: convolution has a grid");
                PlanMix::Conv { height, width }
            }
        };
        let plan = Plan {
            mix,
            layers: config.layers,
            len: config.positions_len(),
            dim: config.hidden_size,
            inner: config.inner(config.hidden_size),
            eps: config.rms_norm_eps as f32,
        };
        Ok(Self { plan: Arc::new(plan), pool: Pool::default() })
    }

    /// All rounds of a supervision step; the last with a graph if `gradient` is on.
    pub fn step(
        &self,
        flat: &Tensor,
        carry: &Carry,
        embedded: &Tensor,
        (h_cycles, l_cycles): (usize, usize),
        gradient: Gradient,
    ) -> Result<Carry> {
        let threads = candle_core::utils::get_num_threads();
        let shape = carry.z_h.shape().clone();
        let embedded = embedded.contiguous()?;
        let mut z_h = carry.z_h.flatten_all()?.to_vec1::<f32>()?;
        let mut z_l = carry.z_l.flatten_all()?.to_vec1::<f32>()?;
        let quiet = match gradient {
            Gradient::On => h_cycles - 1,
            Gradient::Off => h_cycles,
        };
        let tape = with_slices(flat, &embedded, |weights, embedded| {
            let packs = self.plan.pack(weights, Direction::Forward);
            self.plan.run(&packs, (&mut z_h, &mut z_l, embedded), (quiet, l_cycles), threads);
            if gradient == Gradient::Off {
                return Vec::new();
            }
            let mut tape = self.pool.lock().map(|mut pool| pool.pop()).ok().flatten().unwrap_or_default();
            tape.resize(self.plan.tape_len(shape.dims()[0], l_cycles), 0.0);
            self.plan.record(&packs, (&mut z_h, &mut z_l, embedded), l_cycles, &mut tape, threads);
            tape
        })?;
        let z_l = Tensor::from_vec(z_l, shape.clone(), embedded.device())?;
        let z_h = match gradient {
            Gradient::Off => Tensor::from_vec(z_h, shape, embedded.device())?,
            Gradient::On => {
                let op = Recorded {
                    plan: Arc::clone(&self.plan),
                    pool: Arc::clone(&self.pool),
                    l_cycles,
                    threads,
                    z_h: Mutex::new(Some(z_h)),
                    tape: Mutex::new(Some(tape)),
                };
                embedded.apply_op2(flat, op)?
            }
        };
        Ok(Carry { z_h, z_l })
    }
}

/// Lends the numbers of two contiguous f32 tensors.
fn with_slices<R>(a: &Tensor, b: &Tensor, f: impl FnOnce(&[f32], &[f32]) -> R) -> CandleResult<R> {
    let (a_storage, a_layout) = a.storage_and_layout();
    let (b_storage, b_layout) = b.storage_and_layout();
    match (&*a_storage, &*b_storage) {
        (Storage::Cpu(a), Storage::Cpu(b)) => Ok(f(slice(a, a_layout)?, slice(b, b_layout)?)),
        _ => candle_core::bail!(
            "trm: the recursion runs on the CPU only; its weights are on {:?}, its input on {:?}",
            a.device().location(),
            b.device().location()
        ),
    }
}

fn slice<'a>(storage: &'a CpuStorage, layout: &Layout) -> CandleResult<&'a [f32]> {
    match layout.contiguous_offsets() {
        Some((from, to)) => Ok(&storage.as_slice::<f32>()?[from..to]),
        None => candle_core::bail!("trm: the fused network wants contiguous tensors"),
    }
}

/// A round that has run, waiting for its backward pass.
struct Recorded {
    plan: Arc<Plan>,
    pool: Pool,
    l_cycles: usize,
    threads: usize,
    z_h: Mutex<Option<Vec<f32>>>,
    tape: Mutex<Option<Vec<f32>>>,
}

impl Drop for Recorded {
    fn drop(&mut self) {
        if let (Ok(mut tape), Ok(mut pool)) = (self.tape.lock(), self.pool.lock()) {
            pool.extend(tape.take());
        }
    }
}

fn taken<T>(slot: &Mutex<Option<T>>, what: &str) -> CandleResult<T> {
    match slot.lock().map(|mut slot| slot.take()) {
        Ok(Some(value)) => Ok(value),
        _ => candle_core::bail!("trm: the {what} of a recorded round was used already"),
    }
}

impl CustomOp2 for Recorded {
    fn name(&self) -> &'static str {
        "trm-round"
    }

    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        layout: &Layout,
        _: &CpuStorage,
        _: &Layout,
    ) -> CandleResult<(CpuStorage, Shape)> {
        Ok((CpuStorage::F32(taken(&self.z_h, "result")?), layout.shape().clone()))
    }

    fn bwd(
        &self,
        embedded: &Tensor,
        flat: &Tensor,
        _: &Tensor,
        grad: &Tensor,
    ) -> CandleResult<(Option<Tensor>, Option<Tensor>)> {
        let mut tape = taken(&self.tape, "tape")?;
        let mut grad = grad.flatten_all()?.to_vec1::<f32>()?;
        let mut d_embedded = vec![0f32; grad.len()];
        let d_flat = with_slices(flat, embedded, |weights, _| {
            let packs = self.plan.pack(weights, Direction::Backward);
            let grads = (grad.as_mut_slice(), d_embedded.as_mut_slice());
            self.plan.backward(&packs, self.l_cycles, &mut tape, grads, self.threads)
        })?;
        if let Ok(mut pool) = self.pool.lock() {
            pool.push(tape);
        }
        let d_embedded = Tensor::from_vec(d_embedded, embedded.shape(), embedded.device())?;
        let d_flat = Tensor::from_vec(d_flat, flat.shape(), flat.device())?;
        Ok((Some(d_embedded), Some(d_flat)))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use nn::Rng;

    #[test]
    fn the_number_of_threads_changes_no_bit_of_the_forward_pass() {
        for mixing in [Mixing::Attention, Mixing::MlpT, Mixing::Conv] {
            let sizes = Config { num_heads: 2, inner_size: Some(10), ..Config::new(5, 6, 8) };
            let config = Config { mixing, grid: Some([2, 3]), ..sizes };
            let plan = Recursion::new(&config, None).unwrap().plan;
            let mut rng = Rng::new(1, "threads");
            let weights: Vec<f32> = rng.normals(plan.weights_len()).into_iter().map(|x| 0.3 * x).collect();
            let packs = plan.pack(&weights, Direction::Forward);
            // two groups and one puzzle more: three jobs
            let numbers = (2 * plan.group() + 1) * plan.len * plan.dim;
            let [z_h, z_l, embedded] = [(); 3].map(|()| rng.normals(numbers));
            let run = |threads| {
                let (mut h, mut l) = (z_h.clone(), z_l.clone());
                plan.run(&packs, (&mut h, &mut l, &embedded), (2, 3), threads);
                [h, l].concat().into_iter().map(f32::to_bits).collect::<Vec<u32>>()
            };
            let one = run(1);
            assert!(one == run(2) && one == run(3), "{mixing:?}");
        }
    }
}
