//! Tokens side by side.

use super::Pass;
use nn::kernels::add;

/// Tokens of a context: of every sequence, (b, t, width), or of one that stands for all, (t, width).
#[derive(Clone, Copy)]
pub(crate) struct Part<'a> {
    pub(crate) values: &'a [f32],
    pub(crate) tokens: usize,
}

/// (b, s, width): the parts one after the other in every sequence.
pub(crate) fn gather(pass: &mut Pass<'_>, batch: usize, width: usize, parts: &[Part<'_>]) -> Vec<f32> {
    let all: usize = parts.iter().map(|p| p.tokens).sum();
    let mut out = pass.take(batch * all * width);
    for (b, sequence) in out.chunks_exact_mut(all * width).enumerate() {
        let mut rest = sequence;
        for part in parts {
            let len = part.tokens * width;
            let (head, tail) = rest.split_at_mut(len);
            let from = if part.values.len() == len { 0 } else { b * len };
            head.copy_from_slice(&part.values[from..from + len]);
            rest = tail;
        }
    }
    out
}

/// The reverse of `gather`: adds each part of (b, s, width) to its buffer, given with its tokens.
pub(crate) fn scatter(x: &[f32], width: usize, parts: &mut [(&mut [f32], usize)]) {
    let all: usize = parts.iter().map(|(_, tokens)| tokens).sum();
    for (b, sequence) in x.chunks_exact(all * width).enumerate() {
        let mut rest = sequence;
        for (into, tokens) in parts.iter_mut() {
            let len = *tokens * width;
            let (head, tail) = rest.split_at(len);
            let from = if into.len() == len { 0 } else { b * len };
            add(&mut into[from..from + len], head);
            rest = tail;
        }
    }
}
