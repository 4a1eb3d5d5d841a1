//! A forward pass: what operations share.

use crate::backend::{Backend, require_device};
use crate::error::{ModelError, Result};
use crate::gradients::Gradients;
use crate::kernels::{Mat, Pack, Packed, Pool};
use crate::layers::DropoutMask;
use crate::loss::{Loss, LossNumbers, LossParts};
use crate::params::Params;
use crate::precision::Precision;
use crate::rng::Rng;
use crate::tape::{Backward, Tape};
use crate::value::Value;
use candle_core::{DType, Device, Storage, Tensor};
use std::any::Any;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

/// Buffers of one thread, reused from step to step.
#[derive(Debug, Default)]
pub struct Workspace {
    /// free buffers
    pub pool: Pool,
    /// panels of matrix products
    pub pack: Pack,
}

/// What depends on the weights alone, made when first used: for predictions.
#[derive(Default)]
pub struct Prepared {
    version: u64,
    panels: Mutex<BTreeMap<(usize, usize), Arc<Packed>>>,
    fixed: Mutex<BTreeMap<String, Arc<dyn Any + Send + Sync>>>,
}

impl std::fmt::Debug for Prepared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Prepared").field("version", &self.version).finish_non_exhaustive()
    }
}

impl Prepared {
    /// w: (out, in), whole rows of a parameter, which keeps its place in memory; its transpose in panels
    pub(crate) fn panels(&self, w: &[f32], input: usize) -> Arc<Packed> {
        let mut panels = self.panels.lock().unwrap_or_else(PoisonError::into_inner);
        let make = || Arc::new(Packed::new(Mat::rows(w, input).t(), (w.len() / input, input)));
        panels.entry((w.as_ptr().addr(), w.len())).or_insert_with(make).clone()
    }
}

/// Buffers of a model's passes, and what its predictions keep.
#[derive(Debug, Default)]
pub struct Cache {
    free: Mutex<Vec<Workspace>>,
    prepared: Mutex<Arc<Prepared>>,
}

impl Cache {
    /// Calls `f` with a workspace that no other thread has.
    fn with<R>(&self, f: impl FnOnce(&mut Workspace) -> R) -> R {
        keep_freed_memory();
        let taken = self.free.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let mut space = taken.unwrap_or_default();
        let result = f(&mut space);
        self.free.lock().unwrap_or_else(PoisonError::into_inner).push(space);
        result
    }

    fn prepared(&self, params: &Params) -> Arc<Prepared> {
        let mut prepared = self.prepared.lock().unwrap_or_else(PoisonError::into_inner);
        if prepared.version != params.version() {
            *prepared = Arc::new(Prepared { version: params.version(), ..Prepared::default() });
        }
        prepared.clone()
    }

    /// A training step: the loss that `forward` gives, and its gradient added to `into`. Dropout is drawn from `rng`; without it
    /// nothing is dropped.
    ///
    /// # Errors
    /// Those of `forward`; `NoGradient` if the loss does not reach a parameter of a pass on candle's operations.
    pub fn step(
        &self,
        params: &Params,
        rng: Option<&mut Rng>,
        into: &mut Gradients,
        forward: impl FnOnce(&mut Context<'_>) -> Result<Loss>,
    ) -> Result<LossNumbers> {
        if params.backend().is_composed() {
            let loss = self.composed_loss(params, rng, forward)?;
            into.add_graph(params, &loss.total.backward()?)?;
            return Ok(LossNumbers::from(&loss));
        }
        self.with(|space| {
            let mut cx = Context { tape: Some(Tape::default()), rng, ..Context::new(space, params.backend()) };
            let loss = forward(&mut cx)?;
            if let Some(tape) = cx.tape.take() {
                let mut backward = Backward::new(params, into, cx.space)?;
                loss.seed(&mut backward);
                tape.backward(&mut backward)?;
            }
            loss.numbers()
        })
    }

    /// The loss on candle's operations, with its graph: what a step runs where no hand-written kernel does, and what the others are
    /// tested by.
    ///
    /// # Errors
    /// Those of `forward`.
    pub fn composed_loss(
        &self,
        params: &Params,
        rng: Option<&mut Rng>,
        forward: impl FnOnce(&mut Context<'_>) -> Result<Loss>,
    ) -> Result<LossParts> {
        self.with(|space| {
            let mut cx = Context { composed: true, rng, ..Context::new(space, params.backend()) };
            forward(&mut cx)?.composed(cx.device())
        })
    }

    /// A prediction: no graph, weights prepared once.
    ///
    /// # Errors
    /// Those of `forward`.
    pub fn predict<R>(
        &self,
        params: &Params,
        on_seen: &mut dyn FnMut(),
        forward: impl FnOnce(&mut Context<'_>) -> Result<R>,
    ) -> Result<R> {
        self.with(|space| {
            let prepared = (!params.backend().is_composed()).then(|| self.prepared(params));
            let mut cx = Context { prepared, on_seen: Some(on_seen), ..Context::new(space, params.backend()) };
            forward(&mut cx)
        })
    }

    /// A prediction on candle's operations.
    ///
    /// # Errors
    /// Those of `forward`.
    pub fn composed_predict<R>(
        &self,
        params: &Params,
        forward: impl FnOnce(&mut Context<'_>) -> Result<R>,
    ) -> Result<R> {
        self.with(|space| forward(&mut Context { composed: true, ..Context::new(space, params.backend()) }))
    }
}

/// Runs `f` on candle's operations, without dropout, with their graph.
///
/// # Errors
/// Those of `f`.
#[doc(hidden)]
pub fn compose<R>(device: &Device, f: impl FnOnce(&mut Context<'_>) -> Result<R>) -> Result<R> {
    f(&mut Context::new(&mut Workspace::default(), &Backend::composed(device.clone())))
}

/// glibc gives blocks back to the system until one of up to 32 MiB was freed; from then on it keeps blocks of that size, and
/// twice as much at the end of its heap. Without this every tensor of a step is made of fresh pages.
fn keep_freed_memory() {
    static ONCE: std::sync::Once = std::sync::Once::new();
    ONCE.call_once(|| drop(std::hint::black_box(Vec::<u8>::with_capacity((32 << 20) - (1 << 16)))));
}

/// A forward pass.
pub struct Context<'a> {
    pub(crate) space: &'a mut Workspace,
    /// what the backward pass will need; `None` where there is none
    pub(crate) tape: Option<Tape>,
    /// operations are candle's, with its graph
    composed: bool,
    pub(crate) prepared: Option<Arc<Prepared>>,
    rng: Option<&'a mut Rng>,
    on_seen: Option<&'a mut dyn FnMut()>,
    device: Device,
    /// of composed products
    precision: Precision,
}

impl std::fmt::Debug for Context<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Context")
            .field("composed", &self.composed)
            .field("device", &self.device)
            .finish_non_exhaustive()
    }
}

impl<'a> Context<'a> {
    fn new(space: &'a mut Workspace, backend: &Backend) -> Self {
        let (composed, device, precision) = (backend.is_composed(), backend.device().clone(), backend.precision());
        Self { space, tape: None, composed, prepared: None, rng: None, on_seen: None, device, precision }
    }

    /// Whether an operation is candle's, after a look at its inputs: every operation begins with it.
    ///
    /// # Errors
    /// A tensor that is not f32, or on another device.
    pub(crate) fn composed<'t>(
        &self,
        operation: &'static str,
        tensors: impl IntoIterator<Item = &'t Tensor>,
    ) -> Result<bool> {
        for tensor in tensors {
            require_device(operation, tensor.device(), &self.device)?;
            if tensor.dtype() != DType::F32 {
                let (found, expected) = (format!("of {:?}", tensor.dtype()), "of F32".to_string());
                return Err(ModelError::Input { operation, object: "tensor", found, expected });
            }
        }
        Ok(self.composed)
    }

    /// Whether operations are candle's.
    pub fn is_composed(&self) -> bool {
        self.composed
    }

    /// In which precision composed products are computed.
    pub(crate) fn precision(&self) -> Precision {
        self.precision
    }

    /// Where tensors are made.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Whether this is a prediction that keeps what depends on the weights alone.
    pub fn is_prepared(&self) -> bool {
        self.prepared.is_some()
    }

    /// Whether something is kept for a hand-written backward pass.
    pub(crate) fn records(&self) -> bool {
        self.tape.is_some()
    }

    /// The generator of a training pass.
    ///
    /// # Errors
    /// A pass that does not train.
    pub fn rng(&mut self) -> Result<&mut Rng> {
        self.rng.as_deref_mut().ok_or_else(|| ModelError::State {
            object: "forward pass",
            detail: "random numbers are drawn in training alone".to_string(),
        })
    }

    /// A mask that drops with probability `p`, in training.
    pub fn dropout(&mut self, p: f64) -> Option<DropoutMask> {
        match &mut self.rng {
            Some(rng) if p > 0.0 => Some(DropoutMask::draw(p, rng)),
            _ => None,
        }
    }

    /// Standard normal numbers.
    ///
    /// # Errors
    /// A pass that does not train.
    pub fn normals(&mut self, shape: &[usize]) -> Result<Value> {
        let values = self.rng()?.normals(shape.iter().product());
        Value::of(values, shape, &self.device)
    }

    /// Says that the images have been encoded.
    pub fn seen(&mut self) {
        if let Some(on_seen) = self.on_seen.take() {
            on_seen();
        }
    }

    /// Runs `f` without dropout and without a gradient.
    ///
    /// # Errors
    /// Those of `f`.
    pub fn no_grad<R>(&mut self, f: impl FnOnce(&mut Self) -> Result<R>) -> Result<R> {
        let (tape, rng) = (self.tape.take(), self.rng.take());
        let result = f(self);
        (self.tape, self.rng) = (tape, rng);
        result
    }

    /// A parameter as a value.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn parameter(&mut self, parameter: &Tensor) -> Result<Value> {
        if self.composed {
            return Ok(Value::constant(parameter.clone()));
        }
        let node = self.tape.as_mut().map(|tape| {
            let of = parameter.clone();
            tape.push(move |grad, backward| {
                if let Some((into, _)) = backward.parameter(&of) {
                    crate::kernels::add(into, &grad);
                }
                backward.space.pool.give(grad);
                Ok(())
            })
        });
        Ok(Value { tensor: parameter.detach(), node })
    }

    /// What depends on the weights alone: predictions make it once, steps every time.
    ///
    /// # Errors
    /// Those of `make`.
    pub fn fixed<T: Clone + Send + Sync + 'static>(
        &mut self,
        name: impl Fn() -> String,
        make: impl FnOnce(&mut Self) -> Result<T>,
    ) -> Result<T> {
        let Some(prepared) = self.prepared.clone() else { return make(self) };
        let name = name();
        let kept = prepared.fixed.lock().unwrap_or_else(PoisonError::into_inner).get(&name).cloned();
        if let Some(kept) = kept.as_ref().and_then(|kept| kept.downcast_ref::<T>()) {
            return Ok(kept.clone());
        }
        let made = make(self)?;
        prepared.fixed.lock().unwrap_or_else(PoisonError::into_inner).insert(name, Arc::new(made.clone()));
        Ok(made)
    }

    /// A result of a hand-written operation; with a gradient if anything that it depends on has one.
    pub(crate) fn result(
        &mut self,
        values: Vec<f32>,
        shape: &[usize],
        has_gradient: bool,
        backward: impl FnOnce(Vec<f32>, &mut Backward<'_>) -> Result<()> + 'static,
    ) -> Result<Value> {
        self.result_of(Tensor::from_vec(values, shape, &Device::Cpu)?, has_gradient, backward)
    }

    /// The same of a tensor.
    pub(crate) fn result_of(
        &mut self,
        tensor: Tensor,
        has_gradient: bool,
        backward: impl FnOnce(Vec<f32>, &mut Backward<'_>) -> Result<()> + 'static,
    ) -> Result<Value> {
        let node = self.tape.as_mut().filter(|_| has_gradient).map(|tape| tape.push(backward));
        Ok(Value { tensor, node })
    }
}

/// Lends the values of contiguous f32 tensors on the CPU.
pub(crate) fn read<const N: usize, R>(
    operation: &'static str,
    tensors: [&Tensor; N],
    f: impl FnOnce([&[f32]; N]) -> Result<R>,
) -> Result<R> {
    let guards = tensors.map(Tensor::storage_and_layout);
    let mut slices = [&[][..]; N];
    for (slot, (storage, layout)) in slices.iter_mut().zip(&guards) {
        let refuse = |found: String, expected: &str| {
            Err(ModelError::Input { operation, object: "tensor", found, expected: expected.to_string() })
        };
        let Storage::Cpu(storage) = &**storage else {
            return refuse("on another device".to_string(), "on the CPU");
        };
        let Ok(values) = storage.as_slice::<f32>() else {
            return refuse(format!("of {:?}", candle_core::backend::BackendStorage::dtype(storage)), "of F32");
        };
        let Some((from, to)) = layout.contiguous_offsets() else {
            return refuse(format!("with strides {:?}", layout.stride()), "contiguous");
        };
        *slot = &values[from..to];
    }
    f(slices)
}
