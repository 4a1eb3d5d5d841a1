//! The UNet on slices, forwards and backwards: the maths of `unet.rs`, for diffusion, flow matching and MIP. Convolutions
//! are those of pictures of one row (`kernels/conv.rs`), and feature maps lie in frames of zeros for them; normed values are
//! kept for the backward pass, everything else is computed in passing.

use super::condition::Told;
use super::unet::{LAST_GROUPS, NetworkConfig, embedding};
use super::values;
use crate::fused::{
    Grads, Pass, Workspaces, convolution_gradient, convolve, framed, input_gradient, slot, with_weights,
};
use crate::layers::{Activation, Shape};
use candle_core::Tensor;
use nn::Gradients;
use nn::Params;
use nn::Result;
use nn::device::HERE;
use nn::kernels::{
    After, Conv, Film, Frame, add, add_bias, column_sums, group_norm, group_norm_backward, mish, mish_backward,
    norm_mish, norm_mish_backward,
};

/// What the network is apart from its weights, and the buffers of its passes.
#[derive(Debug)]
pub(crate) struct FusedUnet {
    config: NetworkConfig,
    prefix: &'static str,
    horizon: usize,
    action_dim: usize,
    workspaces: Workspaces,
}

/// What the network looks at: x (n, T, A), the step of each row, the condition (n, C).
#[derive(Clone, Copy)]
pub(super) struct Asked<'a> {
    pub(super) x: &'a [f32],
    pub(super) steps: &'a [f32],
    pub(super) cond: &'a [f32],
}

/// What its answer is held to: (n, T, A), how much each step counts, (n, T), or all alike, and over how many numbers and
/// with what share of the loss the mean is taken.
pub(crate) struct Wanted {
    pub(crate) values: Vec<f32>,
    pub(crate) valid: Option<Vec<f32>>,
    pub(crate) entries: f64,
    pub(crate) share: f64,
}

impl FusedUnet {
    pub(crate) fn new(config: &NetworkConfig, prefix: &'static str, (horizon, action_dim): (usize, usize)) -> Self {
        Self { config: config.clone(), prefix, horizon, action_dim, workspaces: Workspaces::default() }
    }

    /// Calls `run` with a pass over the weights and the network for `rows` sequences; a cell of what cameras see becomes
    /// `cell` numbers.
    fn pass<R>(
        &self,
        params: &Params,
        (rows, cell, packed): (usize, usize, bool),
        run: impl FnOnce(&Net, &mut Pass<'_>) -> R,
    ) -> Result<R> {
        let net = Net::new(self, rows);
        // of transformers alone, but for the width of a cell
        let (dim, activation) = (cell, Activation::Relu);
        let shape = Shape { dim, heads: 1, hidden: 1, activation, dropout: 0.0, pre_norm: false };
        let panels = packed.then(|| self.workspaces.packed(params));
        self.workspaces.with(|space| {
            with_weights(params, |weights| {
                let packed = panels.as_deref();
                run(&net, &mut Pass { weights, shape, space, rng: None, packed, on_seen: None })
            })
        })
    }

    /// The network's answer, (n, T, A).
    ///
    /// # Errors
    /// Weights that are not on the CPU.
    fn answer(&self, params: &Params, asked: Asked<'_>) -> Result<Vec<f32>> {
        self.pass(params, (asked.steps.len(), 1, true), |net, pass| {
            let (out, seen) = net.forward(pass, asked);
            seen.free(pass);
            // the workspace keeps its buffers
            let answer = out.clone();
            pass.give(out);
            answer
        })
    }

    /// The same for an x that is a tensor, (n, T, A) -> (n, T, A), without a gradient.
    ///
    /// # Errors
    /// As [`Self::answer`].
    pub(crate) fn answered(&self, params: &Params, x: &Tensor, steps: &[f32], cond: &[f32]) -> Result<Tensor> {
        let answer = self.answer(params, Asked { x: &values(x)?, steps, cond })?;
        Ok(Tensor::from_vec(answer, x.shape(), &HERE)?)
    }

    /// The condition, (n, C), with what the cameras see.
    ///
    /// # Errors
    /// As [`Self::answer`].
    pub(crate) fn seen(&self, params: &Params, rows: usize, told: Told<'_>) -> Result<Vec<f32>> {
        let Some(sight) = told.sight else { return Ok(told.numbers) };
        self.pass(params, (rows, sight.config().cell_features(), true), |_, pass| {
            let mut x = pass.take(rows * sight.width());
            sight.eyes().forward(pass, &told.pictures, &mut x, (0, sight.cameras().tokens)).free(pass);
            let cond = pass.beside(rows, &told.numbers, &x);
            pass.give(x);
            // the workspace keeps its buffers
            let out = cond.clone();
            pass.give(cond);
            out
        })
    }

    /// The mean squared errors of answers about the same observations: to x (n, T, A) at the steps of its rows. Gradients
    /// are added to `into`.
    ///
    /// # Errors
    /// Weights that are not on the CPU.
    pub(crate) fn squared_errors<const N: usize>(
        &self,
        params: &Params,
        told: Told<'_>,
        parts: [(&[f32], &[f32], Wanted); N],
        into: &mut Gradients,
    ) -> Result<[f64; N]> {
        let rows = parts.first().map_or(0, |(_, steps, _)| steps.len());
        let cell = told.sight.map_or(1, |sight| sight.config().cell_features());
        self.pass(params, (rows, cell, false), |net, pass| {
            let mut looked = None;
            let (mut cond, mut of_seen) = (pass.space.pool.copy(&told.numbers), Vec::new());
            if let Some(sight) = told.sight {
                let mut x = pass.take(rows * sight.width());
                let of_cameras = (0, sight.cameras().tokens);
                looked =
                    Some((sight.eyes(), of_cameras, sight.eyes().forward(pass, &told.pictures, &mut x, of_cameras)));
                let both = pass.beside(rows, &told.numbers, &x);
                pass.give(std::mem::replace(&mut cond, both));
                x.fill(0.0);
                of_seen = x;
            }
            let errors = parts.map(|(x, steps, wanted)| {
                let (mut out, seen) = net.forward(pass, Asked { x, steps, cond: &cond });
                let error = wanted.compare(&mut out, self.action_dim);
                net.backward(pass, seen, &out, &mut of_seen, &mut into.views());
                pass.give(out);
                error
            });
            if let Some((eyes, of_cameras, looked)) = looked {
                eyes.backward(pass, looked, &of_seen, of_cameras, &mut into.views());
            }
            pass.give(cond);
            pass.give(of_seen);
            errors
        })
    }
}

impl Wanted {
    /// The mean squared error of an answer, (n, T, A), which becomes its gradient.
    pub(super) fn compare(&self, out: &mut [f32], width: usize) -> f64 {
        let mut sum = 0.0;
        let slope = (2.0 * self.share / self.entries) as f32;
        for (step, (out, wanted)) in out.chunks_exact_mut(width).zip(self.values.chunks_exact(width)).enumerate() {
            let counts = self.valid.as_ref().map_or(1.0, |valid| valid[step]);
            for (out, wanted) in out.iter_mut().zip(wanted) {
                let away = *out - wanted;
                sum += f64::from(counts * away * away);
                *out = counts * away * slope;
            }
        }
        sum / self.entries
    }
}

/// A residual block's convolutions.
struct Block {
    name: String,
    first: Conv,
    second: Conv,
    around: Option<Conv>,
    /// frame of its output
    out: Frame,
}

/// The network for as many sequences.
struct Net<'a> {
    unet: &'a FusedUnet,
    /// two blocks, and what halves the number of steps except at the last level
    down: Vec<([Block; 2], Option<Conv>)>,
    mid: [Block; 2],
    /// two blocks, and the convolution whose way back doubles the number of steps
    up: Vec<([Block; 2], Conv)>,
    last: Conv,
    answer: Conv,
}

/// A convolution's output, normed.
struct Normed {
    y: Vec<f32>,
    /// 1/std a sequence and group
    inverse: Vec<f32>,
}

/// What a block's backward pass needs.
struct Kept {
    /// what it read, in its frame
    x: Vec<f32>,
    first: Normed,
    film: Vec<f32>,
    /// between its convolutions, in a frame
    a: Vec<f32>,
    second: Normed,
}

/// What the backward pass needs.
struct Seen {
    embedding: Vec<f32>,
    /// the steps' layer before and after its activation
    hidden: [Vec<f32>; 2],
    /// steps and observation side by side, before and after the activation
    cond: [Vec<f32>; 2],
    /// blocks in the order in which they ran
    blocks: Vec<Kept>,
    /// what was halved, level by level, and what was doubled, in frames
    halved: Vec<Vec<f32>>,
    doubled: Vec<Vec<f32>>,
    /// what the last two convolutions read
    ends: [Vec<f32>; 2],
    last: Normed,
}

/// Sequences in a frame, `border` steps of zeros at both ends.
fn sequences(rows: usize, steps: usize, channels: usize, border: usize) -> Frame {
    Frame { pictures: rows, height: 1, width: steps, channels, border: (0, border) }
}

fn along(input: Frame, output: usize, kernel: usize, stride: usize) -> Conv {
    Conv { input, output, kernel: (1, kernel), stride: (1, stride) }
}

/// Sequences, side by side, in a frame of their own.
fn placed(pass: &mut Pass<'_>, parts: &[(&[f32], Frame)], to: &Frame) -> Vec<f32> {
    let mut out = framed(pass, to);
    let mut first = 0;
    for (values, frame) in parts {
        let c = frame.channels;
        for n in 0..frame.pictures {
            let rows = out[to.at(n, 0)..].chunks_exact_mut(to.channels).take(to.width);
            for (out, x) in rows.zip(values[frame.at(n, 0)..].chunks_exact(c)) {
                out[first..first + c].copy_from_slice(x);
            }
        }
        first += c;
    }
    out
}

/// `conv` of x, which lies in its frame, with the bias -> (n, steps, O)
fn with_bias(pass: &mut Pass<'_>, name: &str, conv: &Conv, x: &[f32]) -> Vec<f32> {
    let mut y = pass.take(conv.made((0, 0)).inside());
    add_bias(&mut y, pass.weight(name, ".bias"));
    convolve(pass, name, conv, x, true, &mut y);
    y
}

/// Adds the gradients of a convolution's parameters. grad: framed as the convolution's gradient is.
fn of_parameters(pass: &mut Pass<'_>, name: &str, conv: &Conv, x: &[f32], grad: &[f32], grads: &mut Grads<'_>) {
    let frame = conv.made(conv.grad_border());
    // of the border's zeros too
    column_sums(slot(grads, name, ".bias"), &grad[..frame.pictures * frame.picture()]);
    convolution_gradient(pass, name, conv, x, grad, grads);
}

/// `conv` of x, normed; GroupNorm's weights are applied by whoever reads it.
fn normed(pass: &mut Pass<'_>, name: &str, conv: &Conv, groups: usize, x: &[f32]) -> Normed {
    let mut y = with_bias(pass, &format!("{name}.block.0"), conv, x);
    let frame = conv.made((0, 0));
    let mut inverse = pass.take(frame.pictures * groups);
    group_norm(&mut y, &frame, groups, &mut inverse);
    Normed { y, inverse }
}

/// GroupNorm's weights.
fn affine<'a>(pass: &Pass<'a>, name: &str) -> (&'a [f32], &'a [f32]) {
    (pass.weight(name, ".block.1.weight"), pass.weight(name, ".block.1.bias"))
}

/// grad: that of a norm's output, (n, steps, C) -> that of the convolution before it, framed for its gradients; adds those of
/// norm and convolution. x: what the convolution read.
fn norm_backward(
    pass: &mut Pass<'_>,
    (name, conv): (&str, &Conv),
    norm: &Normed,
    x: &[f32],
    grad: &[f32],
    grads: &mut Grads<'_>,
) -> Vec<f32> {
    let frame = conv.made(conv.grad_border());
    let mut out = framed(pass, &frame);
    let (weight, _) = affine(pass, name);
    let (mut of_weight, mut of_bias) = (pass.space.pool.zeros(weight.len()), pass.space.pool.zeros(weight.len()));
    group_norm_backward(grad, &norm.y, &norm.inverse, weight, &frame, &mut of_weight, &mut of_bias, &mut out);
    add(slot(grads, name, ".block.1.weight"), &of_weight);
    add(slot(grads, name, ".block.1.bias"), &of_bias);
    pass.give(of_weight);
    pass.give(of_bias);
    of_parameters(pass, &format!("{name}.block.0"), conv, x, &out, grads);
    out
}

/// The gradient of what a convolution read, (n, steps, I), from that of its output, framed.
fn of_input(pass: &mut Pass<'_>, name: &str, conv: &Conv, grad: &[f32]) -> Vec<f32> {
    let mut out = pass.take(conv.input.inside());
    input_gradient(pass, name, conv, grad, false, &mut out);
    out
}

impl Block {
    fn name(&self, last: &str) -> String {
        format!("{}.{last}", self.name)
    }

    /// x: in its frame, cond: (n, C) after the activation -> framed
    fn forward(&self, pass: &mut Pass<'_>, config: &NetworkConfig, x: Vec<f32>, cond: &[f32]) -> (Vec<f32>, Kept) {
        let film = pass.linear(&self.name("cond_encoder.1"), cond);
        let name = self.name("conv1");
        let first = normed(pass, &name, &self.first, config.n_groups, &x);
        let mut a = framed(pass, &self.second.input);
        let after = After::Film(Film { values: &film, scales: config.film_scale });
        norm_mish(&first.y, affine(pass, &name), after, &self.second.input, &mut a);
        let name = self.name("conv2");
        let second = normed(pass, &name, &self.second, config.n_groups, &a);
        let around = self.around.map(|conv| with_bias(pass, &self.name("residual_conv"), &conv, &x));
        let mut out = framed(pass, &self.out);
        let after = around.as_deref().map_or(After::Framed(&x, &self.first.input), After::Plain);
        norm_mish(&second.y, affine(pass, &name), after, &self.out, &mut out);
        around.into_iter().for_each(|around| pass.give(around));
        (out, Kept { x, first, film, a, second })
    }

    /// grad: that of the output, (n, steps, C) -> that of x unless nobody asks; adds to that of the condition.
    fn backward(
        &self,
        pass: &mut Pass<'_>,
        (config, kept): (&NetworkConfig, Kept),
        grad: Vec<f32>,
        (cond, of_cond): (&[f32], &mut [f32]),
        asked: bool,
        grads: &mut Grads<'_>,
    ) -> Option<Vec<f32>> {
        let Kept { x, first, film, a, second } = kept;
        let steps = self.out.width;
        let name = self.name("conv2");
        let mut inner = pass.space.pool.copy(&grad);
        norm_mish_backward(&mut inner, &second.y, affine(pass, &name), None, steps);
        let behind = norm_backward(pass, (&name, &self.second), &second, &a, &inner, grads);
        let mut of_a = of_input(pass, &format!("{name}.block.0"), &self.second, &behind);
        let name = self.name("conv1");
        let mut of_film = pass.take(film.len());
        let by = Film { values: &film, scales: config.film_scale };
        norm_mish_backward(&mut of_a, &first.y, affine(pass, &name), Some((by, &mut of_film)), steps);
        let encoder = self.name("cond_encoder.1");
        let width = cond.len() / self.out.pictures;
        pass.linear_backward(&encoder, cond, &of_film, width, grads);
        let through = pass.linear_input(&encoder, &of_film, width);
        add(of_cond, &through);
        let before = norm_backward(pass, (&name, &self.first), &first, &x, &of_a, grads);
        let around = self.around.as_ref().map(|conv| (self.name("residual_conv"), conv));
        if let Some((name, conv)) = &around {
            of_parameters(pass, name, conv, &x, &grad, grads);
        }
        let of_x = asked.then(|| {
            let mut of_x = of_input(pass, &format!("{name}.block.0"), &self.first, &before);
            match &around {
                Some((name, conv)) => input_gradient(pass, name, conv, &grad, true, &mut of_x),
                None => add(&mut of_x, &grad),
            }
            of_x
        });
        let Normed { y, inverse } = first;
        for buffer in
            [x, y, inverse, film, a, second.y, second.inverse, grad, inner, behind, of_a, of_film, through, before]
        {
            pass.give(buffer);
        }
        of_x
    }
}

impl<'a> Net<'a> {
    fn new(unet: &'a FusedUnet, rows: usize) -> Self {
        let FusedUnet { config, prefix, .. } = unet;
        let dims = &config.down_dims;
        // wide enough for every kernel; halving looks one step beyond the ends
        let border = (config.kernel_size / 2).max(1);
        let block = |name: String, (input, output): (usize, usize), steps: usize, behind: usize| {
            let first = along(sequences(rows, steps, input, border), output, config.kernel_size, 1);
            let second = along(first.made((0, border)), output, config.kernel_size, 1);
            let around = (input != output).then(|| along(first.input, output, 1, 1));
            Block { name: format!("{prefix}.{name}"), first, second, around, out: second.made((0, behind)) }
        };
        let pair = |name: &str, input: usize, output: usize, steps: usize, behind: usize| {
            let first = block(format!("{name}.0"), (input, output), steps, border);
            [first, block(format!("{name}.1"), (output, output), steps, behind)]
        };
        let (mut before, mut steps) = (unet.action_dim, unet.horizon);
        let mut down = Vec::new();
        for (level, &dim) in dims.iter().enumerate() {
            let blocks = pair(&format!("down_modules.{level}"), before, dim, steps, border);
            let halve = (level + 1 < dims.len()).then(|| along(blocks[1].out, dim, 3, 2));
            steps = halve.map_or(steps, |halve| halve.made((0, 0)).width);
            down.push((blocks, halve));
            before = dim;
        }
        let mid = pair("mid_modules", before, before, steps, border);
        let mut up = Vec::new();
        for (level, dim) in dims.windows(2).rev().enumerate() {
            steps *= 2;
            let double = along(sequences(rows, steps, dim[0], border), dim[0], 4, 2);
            // what is doubled is read as a gradient is
            let behind = double.grad_border().1;
            up.push((pair(&format!("up_modules.{level}"), 2 * dim[1], dim[0], steps / 2, behind), double));
        }
        let last = along(sequences(rows, steps, dims[0], border), dims[0], config.kernel_size, 1);
        let answer = along(last.made((0, 0)), unet.action_dim, 1, 1);
        Self { unet, down, mid, up, last, answer }
    }

    fn name(&self, last: &str) -> String {
        format!("{}.{last}", self.unet.prefix)
    }

    fn step_encoder(&self) -> [String; 2] {
        ["1", "3"].map(|layer| self.name(&format!("diffusion_step_encoder.{layer}")))
    }

    /// What the level `level` up sees beside what comes from below: its twin down gave it.
    fn skipped<'s>(&self, level: usize, blocks: &'s [Kept], halved: &'s [Vec<f32>]) -> (&'s [f32], Frame) {
        let twin = self.down.len() - 1 - level;
        let values = halved.get(twin).unwrap_or_else(|| &blocks[2 * self.down.len()].x);
        (values, self.down[twin].0[1].out)
    }

    fn forward(&self, pass: &mut Pass<'_>, asked: Asked<'_>) -> (Vec<f32>, Seen) {
        let (config, rows) = (&self.unet.config, asked.steps.len());
        let width = config.step_embed_dim;
        let embedding = pass.space.pool.copy(&embedding(asked.steps, width));
        let [first, second] = self.step_encoder();
        let before = pass.linear(&first, &embedding);
        let mut after = pass.space.pool.copy(&before);
        mish(&mut after);
        let of_steps = pass.linear(&second, &after);
        let seen = asked.cond.len() / rows;
        let mut joined = pass.take(rows * (width + seen));
        for (n, joined) in joined.chunks_exact_mut(width + seen).enumerate() {
            joined[..width].copy_from_slice(&of_steps[n * width..][..width]);
            joined[width..].copy_from_slice(&asked.cond[n * seen..][..seen]);
        }
        pass.give(of_steps);
        // every block begins with the same activation of the same condition
        let mut cond = pass.space.pool.copy(&joined);
        mish(&mut cond);

        let mut blocks = Vec::with_capacity(2 * (self.down.len() + 1 + self.up.len()));
        let through = |pass: &mut Pass<'_>, pair: &[Block; 2], mut x: Vec<f32>, blocks: &mut Vec<Kept>| {
            for block in pair {
                let (out, kept) = block.forward(pass, config, x, &cond);
                blocks.push(kept);
                x = out;
            }
            x
        };
        let frame = self.down[0].0[0].first.input;
        let mut x = placed(pass, &[(asked.x, Frame { border: (0, 0), ..frame })], &frame);
        let mut halved = Vec::new();
        for (level, (pair, halve)) in self.down.iter().enumerate() {
            x = through(pass, pair, x, &mut blocks);
            if let Some(halve) = halve {
                let y = with_bias(pass, &self.name(&format!("down_modules.{level}.2")), halve, &x);
                let half = placed(pass, &[(&y, halve.made((0, 0)))], &halve.made((0, frame.border.1)));
                pass.give(y);
                halved.push(std::mem::replace(&mut x, half));
            }
        }
        x = through(pass, &self.mid, x, &mut blocks);
        let (mut out, mut doubled) = (self.mid[1].out, Vec::new());
        for (level, (pair, double)) in self.up.iter().enumerate() {
            let parts = [(&x[..], out), self.skipped(level, &blocks, &halved)];
            let both = placed(pass, &parts, &pair[0].first.input);
            pass.give(x);
            let read = through(pass, pair, both, &mut blocks);
            let name = self.name(&format!("up_modules.{level}.2"));
            x = pass.take(double.input.inside());
            add_bias(&mut x, pass.weight(&name, ".bias"));
            input_gradient(pass, &name, double, &read, true, &mut x);
            doubled.push(read);
            out = Frame { border: (0, 0), ..double.input };
        }
        let end = placed(pass, &[(&x, out)], &self.last.input);
        pass.give(x);
        let name = self.name("final_conv.0");
        let last = normed(pass, &name, &self.last, LAST_GROUPS, &end);
        let mut read = framed(pass, &self.answer.input);
        norm_mish(&last.y, affine(pass, &name), After::Nothing, &self.answer.input, &mut read);
        let answer = with_bias(pass, &self.name("final_conv.1"), &self.answer, &read);
        let (hidden, cond) = ([before, after], [joined, cond]);
        (answer, Seen { embedding, hidden, cond, blocks, halved, doubled, ends: [end, read], last })
    }

    /// grad: that of the answer, (n, T, A); adds that of the condition's last numbers to `of_seen`, (n, as many as there are).
    fn backward(&self, pass: &mut Pass<'_>, seen: Seen, grad: &[f32], of_seen: &mut [f32], grads: &mut Grads<'_>) {
        let Seen { embedding, hidden, cond: [joined, cond], mut blocks, mut halved, mut doubled, ends, last } = seen;
        let config = &self.unet.config;
        let mut of_cond = pass.space.pool.zeros(cond.len());
        let mut through =
            |pass: &mut Pass<'_>, pair: &[Block; 2], mut grad: Vec<f32>, first: bool, grads: &mut Grads<'_>| {
                for (i, block) in pair.iter().enumerate().rev() {
                    let kept = blocks.pop().expect("a block forwards for every block backwards");
                    let asked = i > 0 || !first;
                    let of_x = block.backward(pass, (config, kept), grad, (&cond, &mut of_cond), asked, grads);
                    grad = of_x.unwrap_or_default();
                }
                grad
            };

        let [end, read] = ends;
        let name = self.name("final_conv.1");
        of_parameters(pass, &name, &self.answer, &read, grad, grads);
        let mut inner = of_input(pass, &name, &self.answer, grad);
        let name = self.name("final_conv.0");
        norm_mish_backward(&mut inner, &last.y, affine(pass, &name), None, self.last.input.width);
        let before = norm_backward(pass, (&name, &self.last), &last, &end, &inner, grads);
        let mut grad = of_input(pass, &format!("{name}.block.0"), &self.last, &before);
        for buffer in [end, read, inner, before, last.y, last.inverse] {
            pass.give(buffer);
        }

        let mut of_skipped: Vec<Option<Vec<f32>>> = self.down.iter().map(|_| None).collect();
        for (level, (pair, double)) in self.up.iter().enumerate().rev() {
            let read = doubled.pop().expect("a level back for every level up");
            let name = self.name(&format!("up_modules.{level}.2"));
            column_sums(slot(grads, &name, ".bias"), &grad);
            let plain = Frame { border: (0, 0), ..double.input };
            let wide = placed(pass, &[(&grad, plain)], &double.input);
            convolution_gradient(pass, &name, double, &wide, &read, grads);
            let mut of_read = pass.take(double.made((0, 0)).inside());
            convolve(pass, &name, double, &wide, false, &mut of_read);
            for buffer in [grad, wide, read] {
                pass.give(buffer);
            }
            let both = through(pass, pair, of_read, false, grads);
            let half = pair[0].first.input.channels / 2;
            let (mut of_below, mut of_twin) = (pass.take(both.len() / 2), pass.take(both.len() / 2));
            let parts = of_below.chunks_exact_mut(half).zip(of_twin.chunks_exact_mut(half));
            for (both, (below, twin)) in both.chunks_exact(2 * half).zip(parts) {
                below.copy_from_slice(&both[..half]);
                twin.copy_from_slice(&both[half..]);
            }
            pass.give(both);
            of_skipped[self.down.len() - 1 - level] = Some(of_twin);
            grad = of_below;
        }
        grad = through(pass, &self.mid, grad, false, grads);
        for (level, ((pair, halve), of_skipped)) in self.down.iter().zip(of_skipped).enumerate().rev() {
            if let Some(halve) = halve {
                let x = halved.pop().expect("a level back for every level down");
                let name = self.name(&format!("down_modules.{level}.2"));
                let behind = placed(pass, &[(&grad, halve.made((0, 0)))], &halve.made(halve.grad_border()));
                of_parameters(pass, &name, halve, &x, &behind, grads);
                let before = of_input(pass, &name, halve, &behind);
                for buffer in [x, behind, std::mem::replace(&mut grad, before)] {
                    pass.give(buffer);
                }
            }
            if let Some(of_skipped) = of_skipped {
                add(&mut grad, &of_skipped);
                pass.give(of_skipped);
            }
            grad = through(pass, pair, grad, level == 0, grads);
        }

        mish_backward(&mut of_cond, &joined);
        let (width, [before, after], [first, second]) = (config.step_embed_dim, hidden, self.step_encoder());
        let per = joined.len() / self.answer.input.pictures;
        let last = of_seen.len() / self.answer.input.pictures;
        if last > 0 {
            for (to, from) in of_seen.chunks_exact_mut(last).zip(of_cond.chunks_exact(per)) {
                add(to, &from[per - last..]);
            }
        }
        let mut of_steps = pass.take(embedding.len());
        for (to, from) in of_steps.chunks_exact_mut(width).zip(of_cond.chunks_exact(per)) {
            to.copy_from_slice(&from[..width]);
        }
        pass.linear_backward(&second, &after, &of_steps, 4 * width, grads);
        let mut of_hidden = pass.linear_input(&second, &of_steps, 4 * width);
        mish_backward(&mut of_hidden, &before);
        pass.linear_backward(&first, &embedding, &of_hidden, width, grads);
        for buffer in [embedding, before, after, joined, cond, of_cond, of_steps, of_hidden] {
            pass.give(buffer);
        }
    }
}

impl Kept {
    fn free(self, pass: &mut Pass<'_>) {
        let Self { x, first, film, a, second } = self;
        for buffer in [x, first.y, first.inverse, film, a, second.y, second.inverse] {
            pass.give(buffer);
        }
    }
}

impl Seen {
    /// Gives the buffers back without a backward pass.
    fn free(self, pass: &mut Pass<'_>) {
        let Self { embedding, hidden, cond, blocks, halved, doubled, ends, last } = self;
        blocks.into_iter().for_each(|kept| kept.free(pass));
        let rest = halved.into_iter().chain(doubled).chain(hidden).chain(cond).chain(ends);
        for buffer in rest.chain([embedding, last.y, last.inverse]) {
            pass.give(buffer);
        }
    }
}
