//! Pointing: the maths of `layers/pointer.rs`, written out forwards and backwards.

use super::{Grads, Pass, slot};
use crate::layers::Pointer;
use nn::kernels::{add, dot};

/// What a pointer says, and what its backward pass needs.
#[derive(Debug)]
pub(crate) struct Pointed {
    /// the candidates' tokens that scores are read off, (b, N, D)
    encoded: Vec<f32>,
    /// (b, N)
    pub(crate) scores: Vec<f32>,
    /// their softmax
    shares: Vec<f32>,
}

/// Gradients that pointing adds to, (b, M, D) each.
pub(crate) struct PointerGrads<'a> {
    pub(crate) encoded: &'a mut [f32],
    pub(crate) tokens: &'a mut [f32],
}

impl Pointed {
    /// encoded and tokens: (b, M, D), after and before everything was encoded -> (b, M + 1, D): the encoded ones, and the
    /// token that is pointed at after them.
    pub(crate) fn forward(
        pass: &mut Pass<'_>,
        pointer: &Pointer,
        encoded: &[f32],
        tokens: &[f32],
        rows: usize,
    ) -> (Vec<f32>, Self) {
        let (dim, n) = (pass.shape.dim, pointer.places.len());
        let sequence = encoded.len() / rows;
        let place = |p: u32| p as usize * dim..(p as usize + 1) * dim;
        let mut read = pass.take(rows * n * dim);
        for (read, encoded) in read.chunks_exact_mut(n * dim).zip(encoded.chunks_exact(sequence)) {
            for (read, &p) in read.chunks_exact_mut(dim).zip(&pointer.places) {
                read.copy_from_slice(&encoded[place(p)]);
            }
        }
        let scores = pass.linear("pointer.score", &read);
        let mut shares = pass.space.pool.copy(&scores);
        for shares in shares.chunks_exact_mut(n) {
            let max = shares.iter().fold(f32::NEG_INFINITY, |max, x| max.max(*x));
            shares.iter_mut().for_each(|x| *x = (*x - max).exp());
            let sum: f32 = shares.iter().sum();
            shares.iter_mut().for_each(|x| *x /= sum);
        }
        let mut beside = pass.space.pool.zeros(rows * (sequence + dim));
        let each = encoded.chunks_exact(sequence).zip(tokens.chunks_exact(sequence)).zip(shares.chunks_exact(n));
        for (beside, ((encoded, tokens), shares)) in beside.chunks_exact_mut(sequence + dim).zip(each) {
            let (all, last) = beside.split_at_mut(sequence);
            all.copy_from_slice(encoded);
            for (share, &p) in shares.iter().zip(&pointer.places) {
                last.iter_mut().zip(&tokens[place(p)]).for_each(|(x, token)| *x += share * token);
            }
        }
        (beside, Self { encoded: read, scores, shares })
    }

    /// The positions of what `forward` returns, (M + 1, D).
    pub(crate) fn positions(pass: &mut Pass<'_>, pos: &[f32]) -> Vec<f32> {
        let own = pass.weight("pointer.pos_embed", ".weight");
        let mut all = pass.take(pos.len() + own.len());
        all[..pos.len()].copy_from_slice(pos);
        all[pos.len()..].copy_from_slice(own);
        all
    }

    /// The gradient of these positions into that of the parameter; what is left is of (M, D).
    pub(crate) fn positions_backward<'g>(grad: &'g [f32], dim: usize, grads: &mut Grads<'_>) -> &'g [f32] {
        let (pos, own) = grad.split_at(grad.len() - dim);
        add(slot(grads, "pointer.pos_embed", ".weight"), own);
        pos
    }

    /// `tokens` as they were; the gradients of what `forward` returned, (b, M + 1, D), and of the scores themselves.
    pub(crate) fn backward(
        self,
        pass: &mut Pass<'_>,
        pointer: &Pointer,
        tokens: &[f32],
        (beside, scores): (&[f32], Option<&[f32]>),
        into: PointerGrads<'_>,
        grads: &mut Grads<'_>,
    ) {
        let (dim, n) = (pass.shape.dim, pointer.places.len());
        let sequence = tokens.len() / (self.shares.len() / n);
        let place = |p: u32| p as usize * dim..(p as usize + 1) * dim;
        let mut scores_grad = match scores {
            Some(scores) => pass.space.pool.copy(scores),
            None => pass.space.pool.zeros(self.shares.len()),
        };
        let mut of_shares = pass.take(n);
        let of_rows = beside.chunks_exact(sequence + dim).zip(tokens.chunks_exact(sequence));
        let into_rows = into.encoded.chunks_exact_mut(sequence).zip(into.tokens.chunks_exact_mut(sequence));
        let of_scores = self.shares.chunks_exact(n).zip(scores_grad.chunks_exact_mut(n));
        for (((beside, tokens), (encoded_grad, tokens_grad)), (shares, scores)) in of_rows.zip(into_rows).zip(of_scores)
        {
            let (all, last) = beside.split_at(sequence);
            add(encoded_grad, all);
            for ((of_share, share), &p) in of_shares.iter_mut().zip(shares).zip(&pointer.places) {
                *of_share = dot(last, &tokens[place(p)]);
                tokens_grad[place(p)].iter_mut().zip(last).for_each(|(x, grad)| *x += share * grad);
            }
            let mean = dot(shares, &of_shares);
            let softmax = shares.iter().zip(&of_shares).map(|(share, of_share)| share * (of_share - mean));
            scores.iter_mut().zip(softmax).for_each(|(score, grad)| *score += grad);
        }
        pass.linear_backward("pointer.score", &self.encoded, &scores_grad, dim, grads);
        let w = pass.weight("pointer.score", ".weight");
        for (encoded_grad, scores) in into.encoded.chunks_exact_mut(sequence).zip(scores_grad.chunks_exact(n)) {
            for (score, &p) in scores.iter().zip(&pointer.places) {
                encoded_grad[place(p)].iter_mut().zip(w).for_each(|(x, w)| *x += score * w);
            }
        }
        pass.give(of_shares);
        pass.give(scores_grad);
        self.free(pass);
    }

    /// Gives the buffers back without a backward pass.
    pub(crate) fn free(self, pass: &mut Pass<'_>) {
        for buffer in [self.encoded, self.scores, self.shares] {
            pass.give(buffer);
        }
    }
}
