//! ResNet and its tokens on slices, forwards and backwards: the maths of `encoders/resnet.rs`.
//!
//! All cameras of the same size go through the network as one batch. Feature maps are kept in frames of zeros for the
//! convolutions (`kernels/conv.rs`); normed values are kept for the backward pass, everything else is computed in passing.

use super::convolution::{framed, input_gradient, weight_gradient};
use super::keypoints::Keypoints;
use super::{Grads, Pass, slot};
use crate::encoders::{BACKBONE, ImageNorm, KEYPOINT_PROJECTION, PROJECTION, ResNetShape, Size, TokenKind};
use nn::kernels::{
    Conv, Frame, Shortcut, add, group_norm, group_norm_backward, max_pool, max_pool_backward, relu_backward,
    scale_backward, scale_relu,
};
use nn::layers::CONV_NORM_EPS as EPS;

fn convolve(pass: &mut Pass<'_>, name: &str, conv: &Conv, x: &[f32]) -> Vec<f32> {
    let mut y = pass.take(conv.made((0, 0)).inside());
    super::convolution::convolve(pass, name, conv, x, false, &mut y);
    y
}

/// Values of a convolution's output, normed if there are groups, and what the norm multiplies and adds.
#[derive(Debug)]
struct Normed {
    y: Vec<f32>,
    /// 1/std a picture and group; empty if the norm is frozen
    inverse: Vec<f32>,
    scale: Vec<f32>,
    shift: Vec<f32>,
}

/// Names and sizes of one block's convolutions.
struct Block {
    name: String,
    conv1: Conv,
    conv2: Conv,
    downsample: Option<Conv>,
    /// frame of its output
    out: Frame,
}

/// What the network's backward pass needs.
#[derive(Debug)]
struct Seen {
    /// the pictures in their frame
    pictures: Vec<f32>,
    stem: Normed,
    winner: Vec<f32>,
    /// what every block reads, and the last one's output, in frames
    maps: Vec<Vec<f32>>,
    /// a block each: after the first norm and ReLU; norms
    blocks: Vec<(Vec<f32>, Normed, Normed, Option<Normed>)>,
}

/// The network for pictures of one size.
struct Net<'a> {
    shape: &'a ResNetShape,
    stem: Conv,
    /// after the maximum, in a frame
    pooled: Frame,
    blocks: Vec<Block>,
}

impl<'a> Net<'a> {
    fn new(shape: &'a ResNetShape, pictures: usize, (height, width): Size) -> Self {
        let input = Frame { pictures, height, width, channels: 3, border: (3, 3) };
        let stem = Conv { input, output: shape.width, kernel: (7, 7), stride: (2, 2) };
        let made = stem.made((1, 1));
        let pooled = Frame { height: made.height.div_ceil(2), width: made.width.div_ceil(2), ..made };
        let (mut frame, mut blocks) = (pooled, Vec::new());
        let all = shape.all_blocks();
        let count = all.len();
        for (i, (name, before, after, stride)) in all.into_iter().enumerate() {
            let conv1 = Conv { input: frame, output: after, kernel: (3, 3), stride: (stride, stride) };
            let conv2 = Conv { input: conv1.made((1, 1)), output: after, kernel: (3, 3), stride: (1, 1) };
            let downsample = (stride != 1 || before != after).then_some(Conv {
                input: frame,
                output: after,
                kernel: (1, 1),
                stride: (stride, stride),
            });
            // nothing reads windows of the last map
            let border = usize::from(i + 1 < count);
            let out = conv2.made((border, border));
            blocks.push(Block { name: format!("{BACKBONE}.{name}"), conv1, conv2, downsample, out });
            frame = out;
        }
        Self { shape, stem, pooled, blocks }
    }

    fn norm(&self, pass: &mut Pass<'_>, name: &str, mut y: Vec<f32>, frame: &Frame) -> Normed {
        let (weight, bias) = (pass.weight(name, ".weight"), pass.weight(name, ".bias"));
        let mut scale = pass.space.pool.copy(weight);
        let mut shift = pass.space.pool.copy(bias);
        match self.shape.norm {
            ImageNorm::Group => {
                let groups = ResNetShape::groups(frame.channels);
                let mut inverse = pass.take(frame.pictures * groups);
                group_norm(&mut y, frame, groups, &mut inverse);
                Normed { y, inverse, scale, shift }
            }
            ImageNorm::Frozen => {
                let (mean, variance) = (pass.weight(name, ".running_mean"), pass.weight(name, ".running_var"));
                for (((scale, shift), mean), variance) in scale.iter_mut().zip(&mut shift).zip(mean).zip(variance) {
                    *scale /= (variance + EPS as f32).sqrt();
                    *shift -= mean * *scale;
                }
                Normed { y, inverse: Vec::new(), scale, shift }
            }
        }
    }

    /// The gradient after a norm, (n, pixels, C), becomes that before it, in a frame for the convolution behind it.
    fn norm_backward(
        &self,
        pass: &mut Pass<'_>,
        name: &str,
        normed: Normed,
        frame: &Frame,
        grad: &[f32],
        grads: &mut Grads<'_>,
    ) -> Vec<f32> {
        let mut out = pass.take(frame.buffer_len());
        frame.clear_border(&mut out);
        match self.shape.norm {
            ImageNorm::Group => {
                let (mut weight, mut bias) =
                    (pass.space.pool.zeros(frame.channels), pass.space.pool.zeros(frame.channels));
                let scale = &normed.scale;
                group_norm_backward(grad, &normed.y, &normed.inverse, scale, frame, &mut weight, &mut bias, &mut out);
                add(slot(grads, name, ".weight"), &weight);
                add(slot(grads, name, ".bias"), &bias);
                pass.give(weight);
                pass.give(bias);
            }
            ImageNorm::Frozen => scale_backward(grad, &normed.scale, frame, &mut out),
        }
        normed.free(pass);
        out
    }

    /// pictures: framed -> the last map, (n, pixels, C), and what the backward pass needs
    fn forward(&self, pass: &mut Pass<'_>, pictures: Vec<f32>) -> Seen {
        let made = self.stem.made((1, 1));
        let y = convolve(pass, &format!("{BACKBONE}.conv1"), &self.stem, &pictures);
        let stem = self.norm(pass, &format!("{BACKBONE}.bn1"), y, &made);
        let mut x = framed(pass, &made);
        scale_relu(&stem.y, &stem.scale, &stem.shift, Shortcut::None, &made, &mut x);
        let mut pooled = framed(pass, &self.pooled);
        let mut winner = pass.take(self.pooled.inside());
        max_pool(&x, &made, &self.pooled, &mut pooled, &mut winner);
        pass.give(x);
        let mut maps = vec![pooled];
        let mut blocks = Vec::with_capacity(self.blocks.len());
        for block in &self.blocks {
            let x = maps.last().expect("begins with one");
            let (out, kept) = self.block(pass, block, x);
            blocks.push(kept);
            maps.push(out);
        }
        Seen { pictures, stem, winner, maps, blocks }
    }

    #[allow(clippy::type_complexity)] // what `Seen` holds of a block
    fn block(
        &self,
        pass: &mut Pass<'_>,
        block: &Block,
        x: &[f32],
    ) -> (Vec<f32>, (Vec<f32>, Normed, Normed, Option<Normed>)) {
        let name = |last: &str| format!("{}.{last}", block.name);
        let middle = block.conv2.input;
        let y = convolve(pass, &name("conv1"), &block.conv1, x);
        let first = self.norm(pass, &name("bn1"), y, &middle);
        let mut a = framed(pass, &middle);
        scale_relu(&first.y, &first.scale, &first.shift, Shortcut::None, &middle, &mut a);
        let y = convolve(pass, &name("conv2"), &block.conv2, &a);
        let second = self.norm(pass, &name("bn2"), y, &block.out);
        let down = block.downsample.map(|conv| {
            let y = convolve(pass, &name("downsample.0"), &conv, x);
            self.norm(pass, &name("downsample.1"), y, &block.out)
        });
        let shortcut = match &down {
            Some(down) => Shortcut::Scaled(&down.y, &down.scale, &down.shift),
            None => Shortcut::Framed(x, &block.conv1.input),
        };
        let mut out = framed(pass, &block.out);
        scale_relu(&second.y, &second.scale, &second.shift, shortcut, &block.out, &mut out);
        (out, (a, first, second, down))
    }

    /// Takes the gradient of the last map, (n, pixels, C).
    fn backward(&self, pass: &mut Pass<'_>, seen: Seen, mut grad: Vec<f32>, grads: &mut Grads<'_>) {
        let Seen { pictures, stem, winner, mut maps, blocks } = seen;
        for (block, kept) in self.blocks.iter().zip(blocks).rev() {
            let out = maps.pop().expect("a map a block");
            relu_backward(&mut grad, &block.out, &out);
            pass.give(out);
            let x = maps.last().expect("what the first block read");
            grad = self.block_backward(pass, block, kept, x, grad, grads);
        }
        let pooled = maps.pop().expect("what the first block read");
        relu_backward(&mut grad, &self.pooled, &pooled);
        let made = self.stem.made(self.stem.grad_border());
        let mut before = pass.take(made.inside());
        max_pool_backward(&grad, &winner, &made, &self.pooled, &mut before);
        let framed = self.norm_backward(pass, &format!("{BACKBONE}.bn1"), stem, &made, &before, grads);
        weight_gradient(pass, &format!("{BACKBONE}.conv1"), &self.stem, &pictures, &framed, grads);
        for buffer in [pictures, winner, pooled, grad, before, framed] {
            pass.give(buffer);
        }
    }

    /// grad: that of the sum before the last ReLU -> that of x
    fn block_backward(
        &self,
        pass: &mut Pass<'_>,
        block: &Block,
        (a, first, second, down): (Vec<f32>, Normed, Normed, Option<Normed>),
        x: &[f32],
        grad: Vec<f32>,
        grads: &mut Grads<'_>,
    ) -> Vec<f32> {
        let name = |last: &str| format!("{}.{last}", block.name);
        let middle = block.conv2.input;
        let made = block.conv2.made((1, 1));
        let framed = self.norm_backward(pass, &name("bn2"), second, &made, &grad, grads);
        weight_gradient(pass, &name("conv2"), &block.conv2, &a, &framed, grads);
        let mut inner = pass.take(middle.inside());
        input_gradient(pass, &name("conv2"), &block.conv2, &framed, false, &mut inner);
        pass.give(framed);
        relu_backward(&mut inner, &middle, &a);
        pass.give(a);
        let framed = self.norm_backward(pass, &name("bn1"), first, &middle, &inner, grads);
        pass.give(inner);
        weight_gradient(pass, &name("conv1"), &block.conv1, x, &framed, grads);
        let mut out = pass.take(block.conv1.input.inside());
        input_gradient(pass, &name("conv1"), &block.conv1, &framed, false, &mut out);
        pass.give(framed);
        match (down, block.downsample) {
            (Some(down), Some(conv)) => {
                let made = conv.made((0, 0));
                let framed = self.norm_backward(pass, &name("downsample.1"), down, &made, &grad, grads);
                weight_gradient(pass, &name("downsample.0"), &conv, x, &framed, grads);
                input_gradient(pass, &name("downsample.0"), &conv, &framed, true, &mut out);
                pass.give(framed);
            }
            _ => add(&mut out, &grad),
        }
        pass.give(grad);
        out
    }
}

impl Normed {
    fn free(self, pass: &mut Pass<'_>) {
        for buffer in [self.y, self.inverse, self.scale, self.shift] {
            pass.give(buffer);
        }
    }
}

impl Seen {
    fn free(self, pass: &mut Pass<'_>) {
        for buffer in [self.pictures, self.winner].into_iter().chain(self.maps) {
            pass.give(buffer);
        }
        self.stem.free(pass);
        for (a, first, second, down) in self.blocks {
            pass.give(a);
            for normed in [first, second].into_iter().chain(down) {
                normed.free(pass);
            }
        }
    }
}

/// Cameras, and the network that all of them go through.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Eyes<'a> {
    pub(crate) shape: &'a ResNetShape,
    pub(crate) sizes: &'a [Size],
    pub(crate) tokens: TokenKind,
}

/// What the backward pass of `Eyes` needs: for every size of picture the network's values, and the keypoints.
#[derive(Debug)]
pub(crate) struct Looked(Vec<(Seen, Option<Keypoints>)>);

impl Eyes<'_> {
    /// Cells of a map.
    fn cells(&self, size: Size) -> usize {
        let (h, w) = self.shape.map_size(size);
        h * w
    }

    /// Tokens of a picture.
    fn tokens(&self, size: Size) -> usize {
        match self.tokens {
            TokenKind::Map => self.cells(size),
            TokenKind::Keypoints { .. } => 1,
        }
    }

    /// Every size of picture with its cameras and where each one's tokens begin.
    fn by_size(&self) -> Vec<(Size, Vec<(usize, usize)>)> {
        let mut groups: Vec<(Size, Vec<(usize, usize)>)> = Vec::new();
        let mut token = 0;
        for (camera, &size) in self.sizes.iter().enumerate() {
            match groups.iter_mut().find(|(known, _)| *known == size) {
                Some((_, cameras)) => cameras.push((camera, token)),
                None => groups.push((size, vec![(camera, token)])),
            }
            token += self.tokens(size);
        }
        groups
    }

    /// pictures: one (b, H, W, 3) a camera; writes tokens `first..` of x, (b, `all`, D)
    pub(crate) fn forward(
        &self,
        pass: &mut Pass<'_>,
        pictures: &[Vec<f32>],
        x: &mut [f32],
        (first, all): (usize, usize),
    ) -> Looked {
        let dim = pass.shape.dim;
        let rows = x.len() / (all * dim);
        let mut looked = Vec::new();
        for ((height, width), cameras) in self.by_size() {
            let net = Net::new(self.shape, rows * cameras.len(), (height, width));
            let frame = net.stem.input;
            let mut input = framed(pass, &frame);
            let line = width * 3;
            for (i, &(camera, _)) in cameras.iter().enumerate() {
                for (r, from) in pictures[camera].chunks_exact(line).enumerate() {
                    let at = frame.at(i * rows + r / height, r % height);
                    input[at..at + line].copy_from_slice(from);
                }
            }
            let seen = net.forward(pass, input);
            let map = seen.maps.last().expect("a map a block");
            let size = (height, width);
            let map = &map[..rows * cameras.len() * self.cells(size) * self.shape.channels_out()];
            let keypoints = match self.tokens {
                TokenKind::Map => None,
                TokenKind::Keypoints { count } => Some(Keypoints::find(pass, map, count, self.shape.map_size(size))),
            };
            let tokens = match &keypoints {
                None => pass.linear(PROJECTION, map),
                Some(keypoints) => pass.linear(KEYPOINT_PROJECTION, &keypoints.places),
            };
            let len = self.tokens(size) * dim;
            for (n, from) in tokens.chunks_exact(len).enumerate() {
                let (row, (_, token)) = (n % rows, cameras[n / rows]);
                x[(row * all + first + token) * dim..][..len].copy_from_slice(from);
            }
            pass.give(tokens);
            looked.push((seen, keypoints));
        }
        Looked(looked)
    }

    /// grad: that of x in `forward`
    pub(crate) fn backward(
        &self,
        pass: &mut Pass<'_>,
        looked: Looked,
        grad: &[f32],
        (first, all): (usize, usize),
        grads: &mut Grads<'_>,
    ) {
        let dim = pass.shape.dim;
        let rows = grad.len() / (all * dim);
        for ((size, cameras), (seen, keypoints)) in self.by_size().into_iter().zip(looked.0) {
            let (count, len) = (rows * cameras.len(), self.tokens(size) * dim);
            let mut tokens = pass.take(count * len);
            for (n, to) in tokens.chunks_exact_mut(len).enumerate() {
                let (row, (_, token)) = (n % rows, cameras[n / rows]);
                to.copy_from_slice(&grad[(row * all + first + token) * dim..][..len]);
            }
            let channels = self.shape.channels_out();
            let map = &seen.maps.last().expect("a map a block")[..count * self.cells(size) * channels];
            let map_grad = match keypoints {
                None => {
                    pass.linear_backward(PROJECTION, map, &tokens, channels, grads);
                    pass.linear_input(PROJECTION, &tokens, channels)
                }
                Some(keypoints) => {
                    let numbers = keypoints.places.len() / count;
                    pass.linear_backward(KEYPOINT_PROJECTION, &keypoints.places, &tokens, numbers, grads);
                    let places = pass.linear_input(KEYPOINT_PROJECTION, &tokens, numbers);
                    let map_grad = keypoints.backward(pass, (map, channels), &places, grads);
                    pass.give(places);
                    map_grad
                }
            };
            pass.give(tokens);
            Net::new(self.shape, count, size).backward(pass, seen, map_grad, grads);
        }
    }
}

impl Looked {
    /// Gives the buffers back without a backward pass.
    pub(crate) fn free(self, pass: &mut Pass<'_>) {
        for (seen, keypoints) in self.0 {
            seen.free(pass);
            if let Some(keypoints) = keypoints {
                keypoints.free(pass);
            }
        }
    }
}

#[cfg(test)]
#[path = "vision_tests.rs"]
mod tests;
