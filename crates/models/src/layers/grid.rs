//! A grid of things that lie in rows: tokens that see their neighbours, and which of them a demonstration still comes by.
//!
//! Attention would have to learn which thing lies beside which; a convolution knows. As in `trm`, whose mazes and Sudoku
//! it serves, it is what passes something on from cell to cell, one cell at each application.

use super::pointer::{Answers, Question};
use super::tokens::TokenLayout;
use super::{FeedForward, LayerInit, LayerNorm, Linear, Shape};
use crate::batch::Batch;
use crate::classification::binary_cross_entropy;
use candle_core::{DType, Tensor};
use nn::ops::{cat_tokens, feed_forward, grid_convolution, layer_norm, linear, narrow_tokens, residual};
use nn::values::with_values;
use nn::{Context, Init, ModelError, Params, Result, Rng, Value};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Cells that a convolution reads: a cell and those around it.
pub(crate) const NEIGHBOURS: usize = 9;
/// The way's parameters.
const WAY: &str = "way.score";

/// `[policy.reasoning.grid]`: the tokens of a group of entities are cells of a grid, and the recursion goes over them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GridConfig {
    /// group of entities that are the cells, row by row in the order of their names
    pub among: String,
    /// cells per row
    pub columns: usize,
    /// weight of the auxiliary loss on the cells that the demonstration still visits; 0: none
    #[serde(default)]
    pub way: f64,
}

impl GridConfig {
    /// # Errors
    /// No columns, a weight that is none.
    pub(crate) fn validate(&self, model: &'static str) -> Result<()> {
        let refuse = |field: &'static str, found: String, expected: &str| {
            Err(ModelError::Config { model, field, found, expected: expected.to_string() })
        };
        if self.columns == 0 {
            return refuse("reasoning.grid.columns", "0".into(), "at least 1");
        }
        if !(self.way.is_finite() && self.way >= 0.0) {
            return refuse("reasoning.grid.way", self.way.to_string(), "a finite number, at least 0");
        }
        Ok(())
    }
}

/// Where the cells are among the tokens, latent first, and how they lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Grid {
    pub(crate) first: usize,
    pub(crate) rows: usize,
    pub(crate) columns: usize,
}

impl Grid {
    /// # Errors
    /// A group that is not there, or that does not fill its rows.
    pub(crate) fn new(model: &'static str, config: &GridConfig, layout: &TokenLayout) -> Result<Self> {
        let prefix = format!("encoder_entity_input_proj.{}", config.among);
        let mut places = (layout.tokens.iter().enumerate()).filter(|(_, t)| t.prefix == prefix).map(|(at, _)| 1 + at);
        let first = places.next().unwrap_or_default();
        let cells = usize::from(first > 0) + places.clone().count();
        let adjacent = places.enumerate().all(|(i, place)| place == first + 1 + i);
        if cells == 0 || !cells.is_multiple_of(config.columns) || !adjacent {
            let what = if adjacent { "" } else { " with others between them" };
            let found = format!("{cells} of group {}{what}", config.among);
            let expected = format!("a group of entities in whole rows of {}", config.columns);
            return Err(ModelError::Config { model, field: "reasoning.grid.among", found, expected });
        }
        Ok(Self { first, rows: cells / config.columns, columns: config.columns })
    }

    pub(crate) fn cells(self) -> usize {
        self.rows * self.columns
    }
}

/// A layer over the cells: a zero-padded 3x3 convolution and a dense part, each after a norm and with a residual.
#[derive(Debug)]
pub(crate) struct GridLayer {
    /// (D, 9 D): of every channel the nine cells' channels, row by row
    conv: Linear,
    ff: FeedForward,
    norm1: LayerNorm,
    norm2: LayerNorm,
}

impl GridLayer {
    pub(crate) fn new(params: &mut Params, prefix: &str, shape: Shape, rng: &mut Rng) -> Result<Self> {
        let (dim, init) = (shape.dim, LayerInit::Recursive.dense());
        let bias = Init::Uniform { bound: 1.0 / ((NEIGHBOURS * dim) as f64).sqrt() };
        let (conv, sizes) = (format!("{prefix}.conv"), (NEIGHBOURS * dim, dim));
        let (dense, hidden) = (format!("{prefix}."), (dim, shape.hidden));
        Ok(Self {
            conv: Linear::with_init(params, &conv, sizes, init, Some(bias), rng)?,
            ff: FeedForward::new(params, &dense, hidden, shape.activation, 0.0, init, rng)?,
            norm1: LayerNorm::new(params, &format!("{prefix}.norm1"), dim, rng)?,
            norm2: LayerNorm::new(params, &format!("{prefix}.norm2"), dim, rng)?,
        })
    }

    /// x: (b, cells, D) -> (b, cells, D)
    pub(crate) fn apply(&self, cx: &mut Context<'_>, grid: Grid, x: &Value) -> Result<Value> {
        let cells = grid.cells();
        let y = layer_norm(cx, x, &self.norm1)?;
        let branch = grid_convolution(cx, &y, (grid.rows, grid.columns), &self.conv)?;
        let x = residual(cx, x, &branch, (0.0, cells), None)?;
        let y = layer_norm(cx, &x, &self.norm2)?;
        let branch = feed_forward(cx, &y, &self.ff, cells)?;
        residual(cx, &x, &branch, (0.0, cells), None)
    }
}

/// A grid among the tokens, and what is asked of it.
#[derive(Debug)]
pub(crate) struct Cells {
    pub(crate) grid: Grid,
    way: Option<Linear>,
    pub(crate) weight: f64,
}

impl Cells {
    /// # Errors
    /// As [`Grid::new`].
    pub(crate) fn new(
        p: &mut Params,
        config: &GridConfig,
        (model, layout): (&'static str, &TokenLayout),
        dim: usize,
        rng: &mut Rng,
    ) -> Result<Self> {
        let way = if config.way > 0.0 { Some(Linear::new(p, WAY, dim, 1, rng)?) } else { None };
        Ok(Self { grid: Grid::new(model, config, layout)?, way, weight: config.way })
    }

    /// Of all tokens, (b, M, D), the cells, (b, cells, D).
    pub(crate) fn of(&self, cx: &mut Context<'_>, tokens: &Value) -> Result<Value> {
        narrow_tokens(cx, tokens, self.grid.first, self.grid.cells())
    }

    /// All tokens with these cells in their places.
    pub(crate) fn put(&self, cx: &mut Context<'_>, tokens: &Value, cells: &Value) -> Result<Value> {
        let (b, all, _) = tokens.dims3()?;
        let (first, after) = (self.grid.first, self.grid.first + self.grid.cells());
        let before = narrow_tokens(cx, tokens, 0, first)?;
        if after == all {
            return cat_tokens(cx, b, &[&before, cells]);
        }
        let rest = narrow_tokens(cx, tokens, after, all - after)?;
        cat_tokens(cx, b, &[&before, cells, &rest])
    }

    /// tokens: (b, M, D) -> (b, cells), positive where the way is thought to go on; `None` where that is not asked
    pub(crate) fn way(&self, cx: &mut Context<'_>, tokens: &Value) -> Result<Option<Value>> {
        let Some(way) = &self.way else { return Ok(None) };
        let cells = self.of(cx, tokens)?;
        let (b, n, _) = cells.dims3()?;
        Ok(Some(linear(cx, &cells, way)?.reshape((b, n))?))
    }

    /// What is asked of a batch; `None` if nothing is.
    ///
    /// # Errors
    /// A batch that does not say which cells are come by.
    pub(crate) fn asked(&self, model: &'static str, batch: &Batch) -> Result<Option<Arc<dyn Question>>> {
        if self.way.is_none() {
            return Ok(None);
        }
        let (rows, cells) = (batch.rows(), self.grid.cells());
        let refuse = |found: String| {
            let expected = format!("({rows}, {cells}), 1 where a demonstration comes by later");
            ModelError::Input { operation: model, object: "cells that are visited", found, expected }
        };
        let visited = batch.visited.as_ref().ok_or_else(|| refuse("nothing".to_string()))?;
        if visited.dims() != [rows, cells] {
            return Err(refuse(format!("{:?}", visited.dims())));
        }
        let values = with_values(visited, <[f32]>::to_vec)?;
        Ok(Some(Arc::new(Visited { values, cells, total: (batch.total_rows * cells).max(1) })))
    }
}

/// What is asked of a shard: of each row the cells that its demonstration still comes by.
#[derive(Debug)]
struct Visited {
    /// (b, cells) of 0 and 1
    values: Vec<f32>,
    cells: usize,
    /// cells of the whole batch
    total: usize,
}

impl Question for Visited {
    /// scores: (b, cells) -> binary cross-entropy, a share of the mean over all cells of the batch.
    fn loss(&self, scores: &Tensor) -> Result<Tensor> {
        let targets = Tensor::from_slice(&self.values, scores.shape(), scores.device())?;
        Ok((binary_cross_entropy(scores, &targets)?.sum_all()? / self.total as f64)?)
    }

    fn right(&self, scores: &Tensor) -> Result<Tensor> {
        let targets = Tensor::from_slice(&self.values, scores.shape(), scores.device())?;
        let cells = scores.gt(0.0)?.eq(&targets.gt(0.5)?)?.to_dtype(DType::F32)?;
        Ok((cells.min(1)?.sum_all()? * (self.cells as f64 / self.total as f64))?)
    }

    /// The same on a slice; writes `weight` times the gradient of the loss into `grad`, (b, cells). Right is a row of which
    /// every cell is.
    fn answers(&self, scores: &[f32], grad: Option<(&mut [f32], f64)>) -> Answers {
        let cells = || scores.iter().zip(&self.values).map(|(&score, &target)| (f64::from(score), f64::from(target)));
        let loss: f64 = cells().map(|(x, target)| x.max(0.0) - x * target + (-x.abs()).exp().ln_1p()).sum();
        let is_right = |(score, target): (&f32, &f32)| (*score > 0.0) == (*target > 0.5);
        let rows = scores.chunks_exact(self.cells).zip(self.values.chunks_exact(self.cells));
        let right = rows.filter(|(scores, targets)| scores.iter().zip(*targets).all(is_right)).count();
        let total = self.total as f64;
        if let Some((grad, weight)) = grad {
            for (grad, (x, target)) in grad.iter_mut().zip(cells()) {
                *grad = ((1.0 / (1.0 + (-x).exp()) - target) * weight / total) as f32;
            }
        }
        Answers { loss: loss / total, right: (right * self.cells) as f32 / self.total as f32 }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::features::{FeatureSpec, Signature};

    fn layout(names: &[(&str, &str)]) -> TokenLayout {
        let mut signature = Signature::low_dimensional(3, 2, 2);
        let entities = names.iter().map(|(name, group)| FeatureSpec::entity(name, 2, group, false));
        signature.observation.extend(entities);
        TokenLayout::new(&signature, None, 8).unwrap()
    }

    #[test]
    fn cells_lie_in_rows_among_the_tokens() {
        let names = [("cell0", "cell"), ("cell1", "cell"), ("cell2", "cell"), ("cell3", "cell"), ("peg", "peg")];
        let config = |columns| GridConfig { among: "cell".into(), columns, way: 0.0 };
        let grid = Grid::new("test", &config(2), &layout(&names)).unwrap();
        // after latent, state and environment state
        assert_eq!(grid, Grid { first: 3, rows: 2, columns: 2 });
        let error = |columns, names: &[(&str, &str)]| {
            Grid::new("test", &config(columns), &layout(names)).unwrap_err().to_string()
        };
        assert!(error(3, &names).contains("4 of group cell"), "{}", error(3, &names));
        assert!(error(2, &names[4..]).contains("0 of group cell"));
        let torn = [("a", "cell"), ("b", "other"), ("c", "cell")];
        assert!(error(1, &torn).contains("2 of group cell with others between them"));
    }

    #[test]
    fn a_layer_is_the_sum_over_the_neighbours() {
        let (mut p, rng) = (Params::new(&nn::Backend::CPU), &mut Rng::new(1, "init"));
        let shape = Shape {
            dim: 4,
            heads: 1,
            hidden: 6,
            activation: super::super::Activation::Relu,
            dropout: 0.0,
            pre_norm: true,
        };
        let layer = GridLayer::new(&mut p, "layer", shape, rng).unwrap();
        let grid = Grid { first: 0, rows: 3, columns: 2 };
        let x = Tensor::from_vec(rng.normals(6 * 4), (1, 6, 4), &candle_core::Device::Cpu).unwrap();
        let cache = nn::Cache::default();
        let got = cache.predict(&p, &mut || {}, |cx| layer.apply(cx, grid, &Value::from(&x))).unwrap();
        let got = got.detached().squeeze(0).unwrap();
        let y = layer.norm1.forward(&x).unwrap().squeeze(0).unwrap();
        for cell in 0..6 {
            let mut sum = layer.conv.bias.as_ref().unwrap().clone();
            for tap in 0..NEIGHBOURS {
                let (down, right) = (cell / 2 + tap / 3, cell % 2 + tap % 3);
                if (1..=3).contains(&down) && (1..=2).contains(&right) {
                    let at = (down - 1) * 2 + right - 1;
                    let w = layer.conv.weight.narrow(1, tap * 4, 4).unwrap();
                    sum = (sum + w.matmul(&y.narrow(0, at, 1).unwrap().t().unwrap()).unwrap().squeeze(1).unwrap())
                        .unwrap();
                }
            }
            let after = (x.squeeze(0).unwrap().narrow(0, cell, 1).unwrap() + sum.unsqueeze(0).unwrap()).unwrap();
            let dense = layer.ff.forward(&layer.norm2.forward(&after).unwrap()).unwrap();
            let off = ((&after + dense).unwrap() - got.narrow(0, cell, 1).unwrap()).unwrap();
            assert!(off.abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap() < 1e-5);
        }
    }
}
