//! Every hand-written operation beside its composition of candle's, forwards and backwards, on every instruction set, and the slope of
//! the loss along the gradient.
#![allow(clippy::unwrap_used)]

use super::*;
use crate::backend::Backend;
use crate::context::{Cache, Context};
use crate::gradients::{Gradients, ParamLayout};
use crate::layers::{
    Activation, Cell, Conv1d, FeedForward, GroupNorm, LayerNorm, Linear, MixtureHead, MixtureParts, Recurrent,
    Upsample1d,
};
use crate::loss::Loss;
use crate::params::{Init, Params};
use crate::rng::Rng;
use crate::simd::{Level, at_most};
use candle_core::{DType, Device};
use std::sync::Arc;

/// Parameters by name, the inputs among them: what is differentiated.
struct Case {
    params: Params,
    rng: Rng,
}

impl Case {
    fn new() -> Self {
        Self { params: Params::new(&Backend::CPU), rng: Rng::new(1, "case") }
    }

    fn tensor(&mut self, name: &str, shape: &[usize]) -> Tensor {
        self.params.create(name, shape, Init::Normal { std: 0.7 }, &mut self.rng).unwrap()
    }

    fn linear(&mut self, name: &str, input: usize, output: usize) -> Linear {
        let weight = self.tensor(&format!("{name}.weight"), &[output, input]);
        Linear { weight, bias: Some(self.tensor(&format!("{name}.bias"), &[output])) }
    }

    fn norm(&mut self, name: &str, dim: usize) -> LayerNorm {
        LayerNorm {
            weight: self.tensor(&format!("{name}.weight"), &[dim]),
            bias: self.tensor(&format!("{name}.bias"), &[dim]),
        }
    }

    /// Compares the weighted sum of what `op` gives, and its gradients.
    fn check(&self, what: &str, op: impl Fn(&mut Context<'_>) -> Result<Value>) {
        let loss = |cx: &mut Context<'_>| {
            let y = op(cx)?;
            let weights = Rng::new(9, "weights").normals(y.len());
            let composed = Tensor::from_slice(&weights, y.dims(), &Device::Cpu)?;
            let on_slices = move |y: &[f32], grad: Option<(&mut [f32], f64)>| {
                if let Some((grad, weight)) = grad {
                    grad.iter_mut().zip(&weights).for_each(|(grad, w)| *grad = (f64::from(*w) * weight) as f32);
                }
                y.iter().zip(&weights).map(|(y, w)| f64::from(*y) * f64::from(*w)).sum()
            };
            let mut loss = Loss::default();
            loss.add("sum", term_of(cx, &y, on_slices, |y| Ok(y.mul(&composed)?.sum_all()?))?, 0.8);
            Ok(loss)
        };
        self.check_loss(what, loss);
    }

    fn check_loss(&self, what: &str, loss: impl Fn(&mut Context<'_>) -> Result<Loss>) {
        let (cache, rng) = (Cache::default(), || Rng::new(4, "dropout"));
        let composed = cache.composed_loss(&self.params, Some(&mut rng()), &loss).unwrap();
        let (want, graph) = (composed.total.to_scalar::<f32>().unwrap(), composed.total.backward().unwrap());
        let step = || {
            let mut grads = Gradients::zeros(Arc::new(ParamLayout::new(&self.params))).unwrap();
            let values = cache.step(&self.params, Some(&mut rng()), &mut grads, &loss).unwrap();
            (values.read().unwrap().total, grads)
        };
        for level in Level::ALL {
            at_most(level, || {
                let (got, grads) = step();
                assert!((got - want).abs() < 1e-4 * want.abs().max(1.0), "{what} {level:?}: {got} {want}");
                for (name, var) in self.params.iter() {
                    let want = graph.get(var).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
                    let scale = want.iter().fold(1e-2f32, |m, x| m.max(x.abs()));
                    for (got, want) in grads.get(name).unwrap().iter().zip(&want) {
                        assert!((got - want).abs() < 1e-4 * scale, "{what} {level:?} {name}: {got} {want} of {scale}");
                    }
                }
            });
        }
        // along its gradient the loss rises by the gradient's square
        let (_, grads) = step();
        let square: f64 = grads.values().iter().map(|g| f64::from(*g).powi(2)).sum();
        let moved = |by: f64| {
            for (name, var) in self.params.iter() {
                let grad = Tensor::from_slice(grads.get(name).unwrap(), var.dims(), &Device::Cpu).unwrap();
                var.set(&(var.as_tensor() + (grad * by).unwrap()).unwrap().detach()).unwrap();
            }
            f64::from(step().0)
        };
        let h = 1e-3 / square.sqrt();
        let (up, down) = (moved(h), moved(-2.0 * h));
        moved(h);
        let slope = (up - down) / (2.0 * h);
        assert!((slope - square).abs() < 0.03 * square.max(1e-3), "{what}: slope {slope}, square {square}");
    }
}

fn value(cx: &mut Context<'_>, tensor: &Tensor) -> Value {
    cx.parameter(tensor).unwrap()
}

#[test]
fn linear_layers() {
    for (b, t, input, output) in [(1, 1, 3, 5), (2, 7, 12, 35), (5, 6, 33, 16)] {
        let mut case = Case::new();
        let (x, layer) = (case.tensor("x", &[b, t, input]), case.linear("layer", input, output));
        case.check("linear", |cx| {
            let x = value(cx, &x);
            linear(cx, &x, &layer)
        });
        let mut case = Case::new();
        let (x, pos) = (case.tensor("x", &[b, t, input]), case.tensor("pos", &[1, t, input]));
        let (w, bias) = (case.tensor("w", &[3 * input, input]), case.tensor("bias", &[3 * input]));
        case.check("rows with positions", |cx| {
            let (x, pos) = (value(cx, &x), value(cx, &pos));
            linear_rows(cx, &x, Some(&pos), (&w, Some(&bias)), input..3 * input)
        });
        let mut case = Case::new();
        let (x, w) = (case.tensor("x", &[b, t, input]), case.tensor("w", &[3 * input, input]));
        case.check("rows added in place, and an alias", |cx| {
            let x = value(cx, &x);
            let own = alias(cx, &x);
            let kv = linear_rows(cx, &x, None, (&w, None), input..3 * input)?;
            let q = linear_rows(cx, &own, None, (&w, None), 0..input)?;
            let sum = add(cx, &own, &x)?;
            let sum = add(cx, &sum, &q)?;
            cat_tokens(cx, b, &[&kv.reshape((b, 2 * t, input))?, &sum])
        });
    }
}

#[test]
fn norms_and_residuals() {
    for (b, t, all, dim, p) in [(1, 1, 1, 5, 0.0), (3, 4, 4, 12, 0.3), (3, 2, 5, 33, 0.2)] {
        let mut case = Case::new();
        let (x, norm) = (case.tensor("x", &[b, t, dim]), case.norm("norm", dim));
        case.check("norm", |cx| {
            let x = value(cx, &x);
            layer_norm(cx, &x, &norm)
        });
        for own in [b, 1] {
            let mut case = Case::new();
            let (x, branch) = (case.tensor("x", &[own, t, dim]), case.tensor("branch", &[b, t, dim]));
            let norm = case.norm("norm", dim);
            case.check("residual with its norm", |cx| {
                let (x, branch) = (value(cx, &x), value(cx, &branch));
                residual(cx, &x, &branch, (p, all), Some(&norm))
            });
            let mut case = Case::new();
            let (x, branch) = (case.tensor("x", &[own, t, dim]), case.tensor("branch", &[b, t, dim]));
            case.check("residual", |cx| {
                let (x, branch) = (value(cx, &x), value(cx, &branch));
                residual(cx, &x, &branch, (p, all), None)
            });
        }
    }
}

#[test]
fn attention_and_self_attention() {
    for (batch, own, t, queries, dropout, causal) in
        [(2, 2, 5, 5, 0.0, false), (3, 1, 4, 4, 0.2, false), (2, 2, 6, 1, 0.2, false), (2, 2, 5, 5, 0.1, true)]
    {
        let (heads, dim) = (3, 12);
        let pad: Vec<f32> = (0..batch * t).map(|i| f32::from(u8::from(i % t == 2 && t > 5))).collect();
        let pad = Tensor::from_vec(pad, (batch, t), &Device::Cpu).unwrap();
        let how = Attention { heads, batch, all_queries: t, causal, key_pad: Some(&pad), dropout };
        let mut case = Case::new();
        let (q, kv) = (case.tensor("q", &[own, queries, dim]), case.tensor("kv", &[batch, t, 2 * dim]));
        case.check("attention", |cx| {
            let (q, kv) = (value(cx, &q), value(cx, &kv));
            attention(cx, &q, &kv, how)
        });
        let mut case = Case::new();
        let (x, pos) = (case.tensor("x", &[own, t, dim]), case.tensor("pos", &[1, t, dim]));
        let (w, bias) = (case.tensor("w", &[3 * dim, dim]), case.tensor("bias", &[3 * dim]));
        case.check("self attention", |cx| {
            let (x, pos) = (value(cx, &x), value(cx, &pos));
            self_attention(cx, &x, &pos, queries, (&w, &bias), how)
        });
    }
}

#[test]
fn feed_forward_and_activations() {
    for (kind, p) in [(Activation::Relu, 0.2), (Activation::Gelu, 0.2), (Activation::Gelu, 0.0)] {
        let mut case = Case::new();
        let (b, t, all, dim, hidden) = (3, 2, 4, 12, 19);
        let x = case.tensor("x", &[b, t, dim]);
        let (linear1, linear2) = (case.linear("one", dim, hidden), case.linear("two", hidden, dim));
        let layer = FeedForward { linear1, linear2, activation: kind, dropout: p };
        case.check("feed forward", |cx| {
            let x = value(cx, &x);
            feed_forward(cx, &x, &layer, all)
        });
        let mut case = Case::new();
        let x = case.tensor("x", &[b, t, dim]);
        case.check("activation and dropout", |cx| {
            let x = value(cx, &x);
            let y = activation(cx, &x, kind)?;
            dropout(cx, &y, p)
        });
    }
}

#[test]
fn tokens() {
    let mut case = Case::new();
    let (a, b, scores) = (case.tensor("a", &[3, 2, 5]), case.tensor("b", &[1, 4, 5]), case.tensor("scores", &[3, 3]));
    case.check("tokens", |cx| {
        let (a, b, scores) = (value(cx, &a), value(cx, &b), value(cx, &scores));
        let all = cat_tokens(cx, 3, &[&a, &b, &a])?;
        let some = select_tokens(cx, &all, &[6, 0, 3])?;
        let mean = weighted_mean(cx, &scores, &some)?;
        let first = narrow_tokens(cx, &all, 1, 2)?;
        let both = cat_tokens(cx, 3, &[&mean, &first])?;
        let rows = both.reshape((3, 15))?;
        cat_rows(cx, &rows, &scores)
    });
}

#[test]
fn a_latent_and_losses() {
    let mut case = Case::new();
    let (latent, chunk) = (case.tensor("latent", &[4, 6]), case.tensor("chunk", &[4, 3, 2]));
    let mut rng = Rng::new(3, "data");
    let noise = Tensor::from_vec(rng.normals(12), (4, 3), &Device::Cpu).unwrap();
    let want = Tensor::from_vec(rng.normals(24), (4, 3, 2), &Device::Cpu).unwrap();
    let pad =
        Tensor::from_vec((0..12).map(|i| f32::from(u8::from(i % 5 == 0))).collect(), (4, 3), &Device::Cpu).unwrap();
    case.check("sample", |cx| {
        let (latent, chunk) = (value(cx, &latent), value(cx, &chunk));
        let sample = sample_latent(cx, &latent, &Value::from(&noise))?;
        cat_rows(cx, &sample, &chunk.reshape((4, 6))?)
    });
    for error in [Error::Absolute, Error::Squared] {
        case.check_loss("losses", |cx| {
            let (latent, chunk) = (value(cx, &latent), value(cx, &chunk));
            let mut loss = Loss::default();
            loss.add("error", chunk_error(cx, (&chunk, &want), &pad, error, 19)?.0, 1.5);
            loss.add("kld", kl_divergence(cx, &latent, 7)?, 10.0);
            Ok(loss)
        });
    }
}

#[test]
fn convolutions() {
    for (size, channels, output, k, stride, frozen) in [
        ((7, 6), 3, 16, 3, 1, false),
        ((9, 9), 16, 32, 3, 2, true),
        ((8, 7), 16, 16, 1, 2, false),
        ((12, 12), 3, 8, 7, 2, false),
    ] {
        let mut case = Case::new();
        let x = case.tensor("x", &[2, size.0, size.1, channels]);
        let weight = case.tensor("weight", &[output, channels, k, k]);
        let made = [2, size.0.div_ceil(stride), size.1.div_ceil(stride), output];
        let mut vector = |low: f32| {
            let values = case.rng.normals(output).into_iter().map(|x| low + x.abs()).collect::<Vec<_>>();
            Tensor::from_vec(values, output, &Device::Cpu).unwrap()
        };
        let fixed = [vector(0.5), vector(0.0), vector(0.0), vector(0.5)];
        let shortcut = case.tensor("shortcut", &made);
        let norm = match frozen {
            true => {
                let [weight, bias, mean, variance] = fixed;
                ConvNorm::Frozen { weight, bias, mean, variance }
            }
            false => {
                let norm = case.norm("norm", output);
                ConvNorm::Group { weight: norm.weight, bias: norm.bias, groups: 2 }
            }
        };
        case.check("convolution", |cx| {
            let (x, shortcut) = (value(cx, &x), value(cx, &shortcut));
            let y = conv2d(cx, &x, (&weight, stride), &norm, None, false)?;
            let one = activation(cx, &y, Activation::Gelu)?;
            let z = conv2d(cx, &x, (&weight, stride), &norm, Some(&shortcut), true)?;
            cat_tokens(cx, 1, &[&one.reshape((1, one.len(), 1))?, &z.reshape((1, z.len(), 1))?])
        });
    }
    let mut case = Case::new();
    let x = case.tensor("x", &[2, 5, 6, 3]);
    case.check("max pool and keypoints", |cx| {
        let x = value(cx, &x);
        let positive = activation(cx, &x, Activation::Relu)?;
        let pooled = max_pool(cx, &positive)?;
        let &[n, h, w, c] = pooled.dims() else { unreachable!("four dimensions") };
        spatial_softmax(cx, &pooled.reshape((n, h * w, c))?, (h, w))
    });
}

#[test]
fn convolutions_of_sequences() {
    for (steps, input, output, kernel, stride) in
        [(8, 3, 16, 5, 1), (8, 16, 8, 3, 2), (7, 24, 40, 1, 1), (5, 8, 24, 3, 2)]
    {
        let mut case = Case::new();
        let x = case.tensor("x", &[3, steps, input]);
        let layer = Conv1d::new(&mut case.params, "conv", (input, output, kernel), stride, &mut case.rng).unwrap();
        let norm = case.norm("norm", output);
        let norm = GroupNorm { weight: norm.weight, bias: norm.bias, groups: 4 };
        let double = Upsample1d::new(&mut case.params, "double", output, &mut case.rng).unwrap();
        let (scaled, shifted) = (case.tensor("scaled", &[3, 2 * output]), case.tensor("shifted", &[3, output]));
        case.check("convolution of sequences", |cx| {
            let (x, scaled, shifted) = (value(cx, &x), value(cx, &scaled), value(cx, &shifted));
            // read three times: gradients are added
            let y = conv1d(cx, &x, &layer)?;
            let kept = alias(cx, &y);
            let a = conv1d_mish(cx, &x, (&layer, &norm), Then::Film(&scaled))?;
            let b = conv1d_mish(cx, &x, (&layer, &norm), Then::Film(&shifted))?;
            let c = conv1d_mish(cx, &x, (&layer, &norm), Then::Add(&y))?;
            let d = conv1d_mish(cx, &x, (&layer, &norm), Then::Nothing)?;
            let up = upsample1d(cx, &y, &double)?;
            let up = mish(cx, &up)?;
            cat_tokens(cx, 3, &[&a, &b, &c, &d, &up, &kept])
        });
    }
}

#[test]
fn convolutions_over_a_grid() {
    for (b, rows, columns, dim, output) in [(1, 1, 1, 3, 3), (2, 3, 2, 5, 7), (3, 4, 5, 16, 16)] {
        let mut case = Case::new();
        let (x, layer) = (case.tensor("x", &[b, rows * columns, dim]), case.linear("layer", 9 * dim, output));
        case.check("grid convolution", |cx| {
            let x = value(cx, &x);
            grid_convolution(cx, &x, (rows, columns), &layer)
        });
    }
}

#[test]
fn recurrent_layers() {
    for (steps, rows, input, hidden) in [(1, 3, 4, 5), (4, 1, 3, 6), (3, 7, 12, 17)] {
        for cell in [Cell::Lstm, Cell::Gru] {
            let mut case = Case::new();
            let x = case.tensor("x", &[steps, rows, input]);
            let sizes = (input, hidden, 2);
            let layers = Recurrent::new(&mut case.params, "rnn", cell, sizes, &mut case.rng).unwrap();
            if steps > 1 {
                case.check("recurrent layers", |cx| {
                    let x = value(cx, &x);
                    layers.apply(cx, &x, None)
                });
            }
            // prediction one step at a time and over all steps, on kernels and on candle's operations
            let (cache, x) = (Cache::default(), Value::from(&x));
            let flat = |x: &Value| x.detached().flatten_all().unwrap().to_vec1::<f32>().unwrap();
            let whole = |cx: &mut Context<'_>| Ok(flat(&layers.apply(cx, &x, None)?));
            let by_step = |cx: &mut Context<'_>| {
                let (mut state, mut out) = (Vec::new(), Vec::new());
                for step in 0..steps {
                    let x = Value::from(&x.detached().narrow(0, step, 1)?.contiguous()?);
                    out.extend(flat(&layers.apply(cx, &x, Some(&mut state))?));
                }
                Ok(out)
            };
            let want = cache.composed_predict(&case.params, whole).unwrap();
            for got in [
                cache.predict(&case.params, &mut || {}, whole).unwrap(),
                cache.predict(&case.params, &mut || {}, by_step).unwrap(),
                cache.composed_predict(&case.params, by_step).unwrap(),
            ] {
                assert!(got.iter().zip(&want).all(|(a, b)| (a - b).abs() < 1e-5), "{cell:?}: {got:?} {want:?}");
            }
        }
    }
}

#[test]
fn likelihoods_of_mixtures() {
    for (n, input, modes, action_dim) in [(1, 4, 1, 2), (5, 7, 3, 2)] {
        let mut case = Case::new();
        let x = case.tensor("x", &[n, input]);
        let head = MixtureHead::new(&mut case.params, "head", (input, modes, action_dim), 0.05, &mut case.rng).unwrap();
        let mut rng = Rng::new(3, "data");
        let actions = Tensor::from_vec(rng.normals(n * action_dim), (n, action_dim), &Device::Cpu).unwrap();
        let real = (0..n).map(|row| f32::from(u8::from(row % 3 != 2))).collect::<Vec<_>>();
        let real = Tensor::from_vec(real, n, &Device::Cpu).unwrap();
        case.check_loss("likelihood", |cx| {
            let x = value(cx, &x);
            let parts = head.apply(cx, &x)?;
            let (nll, l1) = mixture_likelihood(cx, &parts, (&actions, &real), n + 2)?;
            let mut loss = Loss::default();
            loss.add("nll", nll, 0.8);
            loss.report("l1_loss", l1);
            Ok(loss)
        });
    }
}

/// A call of an operation with these inputs.
type Call<'a> = Box<dyn Fn(&mut Context<'_>, &[Value]) -> Result<()> + 'a>;

/// Name of an operation, shapes that fit, an input and a shape that does not fit there, a call.
type Row<'a> = (&'a str, Vec<&'a [usize]>, (usize, &'a [usize]), Call<'a>);

/// Every operation refuses by its name inputs of another type and shape, on kernels and on candle's operations.
#[test]
fn every_operation_names_what_it_refuses() {
    let mut case = Case::new();
    let (layer, norm, wide) = (case.linear("layer", 4, 4), case.norm("norm", 4), case.linear("wide", 36, 4));
    let (one, two) = (case.linear("one", 4, 8), case.linear("two", 8, 4));
    let ff = FeedForward { linear1: one, linear2: two, activation: Activation::Relu, dropout: 0.0 };
    let (inner, bias) = (case.tensor("inner", &[12, 4]), case.tensor("bias", &[12]));
    let conv = Conv1d::new(&mut case.params, "conv", (4, 8, 3), 1, &mut case.rng).unwrap();
    let double = Upsample1d::new(&mut case.params, "double", 4, &mut case.rng).unwrap();
    let of_conv = case.norm("of_conv", 8);
    let of_conv = GroupNorm { weight: of_conv.weight, bias: of_conv.bias, groups: 4 };
    let (weight, of_map) = (case.tensor("weight", &[4, 4, 3, 3]), case.norm("of_map", 4));
    let of_map = ConvNorm::Group { weight: of_map.weight, bias: of_map.bias, groups: 2 };
    let gates =
        |case: &mut Case, n: usize| (case.linear(&format!("{n} in"), 4, 4 * n), case.linear(&format!("{n}"), 4, 4 * n));
    let (of_lstm, of_gru) = (gates(&mut case, 4), gates(&mut case, 3));
    let how = Attention { heads: 2, batch: 2, all_queries: 3, causal: false, key_pad: None, dropout: 0.0 };
    let likelihood = |means: &Value, scales: &Value, logits: &Value| MixtureParts {
        means: means.clone(),
        scales: scales.clone(),
        logits: logits.clone(),
        min_std: 0.1,
        action_dim: 2,
    };
    let seq: &[usize] = &[2, 3, 4];
    let table: Vec<Row<'_>> = vec![
        ("linear", vec![seq], (0, &[2, 3, 5]), Box::new(|cx, x| linear(cx, &x[0], &layer).map(drop))),
        (
            "linear",
            vec![seq, &[1, 3, 4]],
            (1, &[1, 3, 5]),
            Box::new(|cx, x| linear_rows(cx, &x[0], Some(&x[1]), (&inner, Some(&bias)), 4..12).map(drop)),
        ),
        ("norm", vec![seq], (0, &[2, 3, 5]), Box::new(|cx, x| layer_norm(cx, &x[0], &norm).map(drop))),
        (
            "residual",
            vec![seq, seq],
            (0, &[2, 2, 4]),
            Box::new(|cx, x| residual(cx, &x[0], &x[1], (0.0, 3), Some(&norm)).map(drop)),
        ),
        ("residual", vec![seq, seq], (0, &[3, 3, 4]), Box::new(|cx, x| add(cx, &x[0], &x[1]).map(drop))),
        (
            "attention",
            vec![seq, &[2, 5, 8]],
            (1, &[2, 5, 7]),
            Box::new(|cx, x| attention(cx, &x[0], &x[1], how).map(drop)),
        ),
        (
            "attention",
            vec![seq, &[2, 5, 8], &[2, 5]],
            (2, &[2, 4]),
            Box::new(|cx, x| attention(cx, &x[0], &x[1], Attention { key_pad: Some(&x[2].tensor), ..how }).map(drop)),
        ),
        (
            "self attention",
            vec![seq, &[1, 3, 4]],
            (1, &[1, 2, 4]),
            Box::new(|cx, x| self_attention(cx, &x[0], &x[1], 3, (&inner, &bias), how).map(drop)),
        ),
        ("feed forward", vec![seq], (0, &[2, 3, 5]), Box::new(|cx, x| feed_forward(cx, &x[0], &ff, 3).map(drop))),
        ("activation", vec![seq], (0, seq), Box::new(|cx, x| activation(cx, &x[0], Activation::Gelu).map(drop))),
        ("mish", vec![seq], (0, seq), Box::new(|cx, x| mish(cx, &x[0]).map(drop))),
        ("mean", vec![seq], (0, &[2, 3]), Box::new(|cx, x| detached_mean(cx, &x[0]).map(drop))),
        ("cat", vec![seq, &[2, 1, 4]], (1, &[2, 1, 5]), Box::new(|cx, x| cat_tokens(cx, 2, &[&x[0], &x[1]]).map(drop))),
        ("cat rows", vec![&[2, 3], &[2, 4]], (1, &[3, 4]), Box::new(|cx, x| cat_rows(cx, &x[0], &x[1]).map(drop))),
        ("narrow", vec![seq], (0, &[2, 2, 4]), Box::new(|cx, x| narrow_tokens(cx, &x[0], 1, 2).map(drop))),
        ("select", vec![seq], (0, &[2, 2, 4]), Box::new(|cx, x| select_tokens(cx, &x[0], &[2, 0]).map(drop))),
        (
            "weighted mean",
            vec![&[2, 3], seq],
            (0, &[2, 2]),
            Box::new(|cx, x| weighted_mean(cx, &x[0], &x[1]).map(drop)),
        ),
        ("sample", vec![&[2, 6], &[2, 3]], (1, &[3, 3]), Box::new(|cx, x| sample_latent(cx, &x[0], &x[1]).map(drop))),
        ("KL divergence", vec![&[2, 6]], (0, &[2, 5]), Box::new(|cx, x| kl_divergence(cx, &x[0], 2).map(drop))),
        (
            "loss",
            vec![seq, seq, &[2, 3]],
            (2, &[2, 4]),
            Box::new(|cx, x| chunk_error(cx, (&x[0], &x[1].tensor), &x[2].tensor, Error::Squared, 6).map(drop)),
        ),
        (
            "likelihood",
            vec![&[2, 6], &[2, 6], &[2, 3], &[2, 2], &[2]],
            (1, &[2, 5]),
            Box::new(|cx, x| {
                let parts = likelihood(&x[0], &x[1], &x[2]);
                mixture_likelihood(cx, &parts, (&x[3].tensor, &x[4].tensor), 2).map(drop)
            }),
        ),
        ("convolution", vec![seq], (0, &[2, 3, 5]), Box::new(|cx, x| conv1d(cx, &x[0], &conv).map(drop))),
        (
            "convolution",
            vec![seq, &[2, 16]],
            (1, &[2, 9]),
            Box::new(|cx, x| conv1d_mish(cx, &x[0], (&conv, &of_conv), Then::Film(&x[1])).map(drop)),
        ),
        ("upsample", vec![seq], (0, &[2, 3, 5]), Box::new(|cx, x| upsample1d(cx, &x[0], &double).map(drop))),
        (
            "convolution",
            vec![&[2, 5, 6, 4], &[2, 3, 3, 4]],
            (1, &[2, 3, 4, 4]),
            Box::new(|cx, x| conv2d(cx, &x[0], (&weight, 2), &of_map, Some(&x[1]), true).map(drop)),
        ),
        ("max pool", vec![&[2, 5, 6, 4]], (0, seq), Box::new(|cx, x| max_pool(cx, &x[0]).map(drop))),
        (
            "spatial softmax",
            vec![&[2, 6, 4]],
            (0, &[2, 5, 4]),
            Box::new(|cx, x| spatial_softmax(cx, &x[0], (2, 3)).map(drop)),
        ),
        (
            "grid convolution",
            vec![&[2, 6, 4]],
            (0, &[2, 5, 4]),
            Box::new(|cx, x| grid_convolution(cx, &x[0], (2, 3), &wide).map(drop)),
        ),
        (
            "lstm",
            vec![seq],
            (0, &[2, 3, 5]),
            Box::new(|cx, x| lstm(cx, &x[0], (&of_lstm.0, &of_lstm.1), None).map(drop)),
        ),
        ("gru", vec![seq], (0, &[2, 3]), Box::new(|cx, x| gru(cx, &x[0], (&of_gru.0, &of_gru.1), None).map(drop))),
    ];
    let cache = Cache::default();
    for (name, shapes, (changed, misfit), call) in &table {
        let zeros = |shape: &[usize], dtype| Value::constant(Tensor::zeros(shape, dtype, &Device::Cpu).unwrap());
        let fitting: Vec<Value> = shapes.iter().map(|shape| zeros(shape, DType::F32)).collect();
        let both = |inputs: &[Value]| {
            let fast = cache.predict(&case.params, &mut || {}, |cx| call(cx, inputs));
            [fast, cache.composed_predict(&case.params, |cx| call(cx, inputs))]
        };
        for result in both(&fitting) {
            result.unwrap_or_else(|error| panic!("{name}: {error}"));
        }
        let mut cases: Vec<(usize, Value)> = (0..fitting.len()).map(|i| (i, zeros(shapes[i], DType::F64))).collect();
        if misfit != &shapes[*changed] {
            cases.push((*changed, zeros(misfit, DType::F32)));
        }
        for (at, wrong) in cases {
            let mut inputs = fitting.clone();
            inputs[at] = wrong;
            for result in both(&inputs) {
                let error = result.expect_err(name).to_string();
                // an operation made of others may fail in one of them
                let named =
                    error.starts_with(&format!("{name}: ")) || (*name == "cat rows" && error.starts_with("cat: "));
                assert!(named, "{name}, input {at}: {error}");
            }
        }
    }
}

#[test]
fn what_does_not_fit_is_named() {
    let mut case = Case::new();
    let (x, layer) = (case.tensor("x", &[2, 3, 5]), case.linear("layer", 4, 5));
    let cache = Cache::default();
    let error = |op: &dyn Fn(&mut Context<'_>) -> Result<Value>| {
        cache.predict(&case.params, &mut || {}, |cx| op(cx)).map(|_| ()).unwrap_err().to_string()
    };
    let wrong = error(&|cx| linear(cx, &Value::from(&x), &layer));
    assert_eq!(wrong, "linear: input has shape [2, 3, 5], expected [2, 3, 4]");
    let wide = x.to_dtype(DType::F64).unwrap();
    let wrong = error(&|cx| activation(cx, &Value::from(&wide), Activation::Relu));
    assert_eq!(wrong, "activation: tensor is of F64, expected of F32");
    let turned = x.transpose(1, 2).unwrap();
    let wrong = error(&|cx| activation(cx, &Value::from(&turned), Activation::Relu));
    assert!(wrong.starts_with("activation: tensor is with strides"), "{wrong}");
    let conv = Conv1d::new(&mut Params::new(&Backend::CPU), "conv", (4, 8, 3), 1, &mut Rng::new(1, "init")).unwrap();
    let wrong = error(&|cx| conv1d(cx, &Value::from(&x), &conv));
    assert_eq!(wrong, "convolution: input has shape [2, 3, 5], expected [2, 3, 4]");
    let fits = Value::from(&x.narrow(2, 0, 4).unwrap().contiguous().unwrap());
    let weight = Tensor::zeros(8, DType::F32, &Device::Cpu).unwrap();
    let norm = GroupNorm { weight: weight.clone(), bias: weight, groups: 4 };
    let wrong = error(&|cx| conv1d_mish(cx, &fits, (&conv, &norm), Then::Film(&fits)));
    assert_eq!(wrong, "convolution: film has shape [2, 3, 4], expected [2, 8]");
    let wrong = error(&|cx| grid_convolution(cx, &Value::from(&x), (2, 2), &layer));
    assert_eq!(wrong, "grid convolution: cells has shape [2, 3, 5], expected [2, 4, 0]");
    let wrong = error(&|cx| Ok(lstm(cx, &Value::from(&x), (&layer, &layer), None)?.0));
    assert_eq!(wrong, "lstm: weight of the input has shape [5, 4], expected [16, 5]");
    let wrong = error(&|cx| select_tokens(cx, &Value::from(&x), &[3]));
    assert_eq!(wrong, "select: token is 3, expected below 3");
}
