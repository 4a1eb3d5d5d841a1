//! `[model]` of a puzzle experiment: the recursive model and those that it is compared with.

use models::ModelError;
use models::Size;
use models::classification::ClassProbability;
use puzzles::{MOVES, MazeTask, Task};
use serde::{Deserialize, Serialize};
use solvers::trm::{self, Mixing, Pooling, Positions};
use solvers::{GridConfig, GridDims, SmallTrmConfig, WalkerConfig};
use toml::{Table, Value};

use zoo::ZooError;
use zoo::config::from_value;

use super::solver::Solver;
use super::walk;

/// `[model]` with `type = "trm"`; the task decides vocabulary, classes and grid.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrmSection {
    /// Channels.
    pub hidden_size: usize,
    /// Width of the SwiGLU.
    pub inner_size: usize,
    /// Layers of the one network.
    #[serde(default = "one")]
    pub layers: usize,
    /// Attention heads.
    #[serde(default = "one")]
    pub num_heads: usize,
    /// Rounds per supervision step; only the last has gradients.
    #[serde(default = "two")]
    pub h_cycles: usize,
    /// Updates of `z_l` per round.
    #[serde(default = "four")]
    pub l_cycles: usize,
    /// How positions exchange information.
    pub mixing: Mixing,
    /// How positions are distinguished.
    #[serde(default = "no_positions")]
    pub positions: Positions,
    /// What the halting head reads.
    #[serde(default = "mean")]
    pub pooling: Pooling,
    /// Largest number of supervision steps per puzzle in training.
    #[serde(default = "eight")]
    pub halt_max_steps: usize,
    /// Share of puzzles that must take a random minimum of steps in training.
    #[serde(default)]
    pub halt_exploration_prob: f64,
}

fn one() -> usize {
    1
}
fn two() -> usize {
    2
}
fn four() -> usize {
    4
}
fn eight() -> usize {
    8
}
fn no_positions() -> Positions {
    Positions::None
}
fn mean() -> Pooling {
    Pooling::Mean
}

/// `[model]`: the recursive model or one of those that it is compared with.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum SolverConfig {
    /// The Tiny Recursive Model.
    Trm(TrmSection),
    /// A small recursion per cell.
    SmallTrm(SmallTrmConfig),
    /// Convolutions.
    Cnn(CnnSection),
    /// A Transformer encoder over cells.
    Transformer(TransformerSection),
    /// Dense layers over the flattened grid, or over a walker's observation.
    Mlp(MlpSection),
    /// For walkers: a recursion of a high and a low state.
    Hierarchical(HierarchicalSection),
    /// For walkers: a recursion of one 3x3 convolution over the cells.
    Conv(ConvSection),
}

/// `[model]` with `type = "cnn"`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CnnSection {
    /// Channels after each convolution.
    pub channels: Vec<usize>,
}

/// `[model]` with `type = "transformer"`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TransformerSection {
    /// Width.
    pub dim: usize,
    /// Heads.
    pub heads: usize,
    /// Layers.
    pub layers: usize,
    /// Width of the feed-forward part.
    pub feedforward: usize,
}

/// `[model]` with `type = "mlp"`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MlpSection {
    /// Widths of the hidden layers.
    pub hidden: Vec<usize>,
}

/// `[model]` with `type = "hierarchical"`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HierarchicalSection {
    /// Width of the high state.
    pub high: usize,
    /// Width of the low state.
    pub low: usize,
    /// Cycles of the recursion.
    pub cycles: usize,
    /// Whether the previous action is an input.
    #[serde(default)]
    pub previous_action: bool,
}

/// `[model]` with `type = "conv"`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConvSection {
    /// Width of the state per cell.
    pub hidden: usize,
    /// Hidden width of the block's dense part.
    pub inner: usize,
    /// Applications of the block.
    pub cycles: usize,
}

impl SolverConfig {
    const TYPES: [&'static str; 7] = ["cnn", "conv", "hierarchical", "mlp", "small_trm", "transformer", "trm"];

    pub(super) fn from_table(mut table: Table) -> Result<Self, ZooError> {
        let Some(kind) = table.remove("type") else {
            return Err(ZooError::MissingKey { key: "model.type".to_owned() });
        };
        let rest = Value::Table(table);
        let at = &["model"];
        Ok(match kind.as_str() {
            Some("trm") => Self::Trm(from_value(&rest, at)?),
            Some("small_trm") => Self::SmallTrm(from_value(&rest, at)?),
            Some("cnn") => Self::Cnn(from_value(&rest, at)?),
            Some("transformer") => Self::Transformer(from_value(&rest, at)?),
            Some("mlp") => Self::Mlp(from_value(&rest, at)?),
            Some("hierarchical") => Self::Hierarchical(from_value(&rest, at)?),
            Some("conv") => Self::Conv(from_value(&rest, at)?),
            _ => {
                return Err(ZooError::InvalidValue {
                    key: "model.type".to_owned(),
                    expected: format!("one of {}", Self::TYPES.join(", ")),
                    found: kind.to_string(),
                });
            }
        })
    }

    /// How large the model for a grid of `cells` will be: the widest layers alone.
    pub fn size(&self, cells: usize) -> Size {
        let (width, inner, layers) = match self {
            Self::Trm(section) => (section.hidden_size, section.inner_size, section.layers),
            Self::Transformer(section) => (section.dim, section.feedforward, section.layers),
            Self::Cnn(section) => section.channels.iter().max().map_or((0, 0, 0), |&widest| (widest, 0, 1)),
            Self::Mlp(section) => {
                // not cell by cell: one vector a puzzle
                let weights = section.hidden.windows(2).map(|pair| pair[0] as f64 * pair[1] as f64).sum();
                return Size { weights, activations: cells as f64 };
            }
            _ => (0, 0, 0),
        };
        let (width, inner, layers) = (width as f64, inner as f64, layers as f64);
        Size { weights: layers * width * inner, activations: layers * cells as f64 * (width + inner) }
    }

    /// Its sizes by their keys, with the least that each can be. The TRM refuses its own.
    pub(super) fn sizes(&self) -> Vec<(&'static str, usize, usize)> {
        match self {
            Self::Trm(_) => Vec::new(),
            Self::SmallTrm(of) => vec![
                ("model.features", of.features, 1),
                ("model.latent", of.latent, 1),
                ("model.answer", of.answer, 1),
                ("model.hidden", of.hidden, 1),
                ("model.head", of.head, 1),
                ("model.inner_steps", of.inner_steps, 1),
                ("model.supervision_steps", of.supervision_steps, 1),
            ],
            Self::Cnn(of) => of.channels.iter().map(|&width| ("model.channels", width, 1)).collect(),
            // its head has half the width
            Self::Transformer(of) => vec![
                ("model.dim", of.dim, 2),
                ("model.heads", of.heads, 1),
                ("model.layers", of.layers, 0),
                ("model.feedforward", of.feedforward, 1),
            ],
            Self::Mlp(of) => of.hidden.iter().map(|&width| ("model.hidden", width, 1)).collect(),
            // likewise
            Self::Hierarchical(of) => {
                vec![("model.high", of.high, 2), ("model.low", of.low, 1), ("model.cycles", of.cycles, 2)]
            }
            Self::Conv(of) => {
                vec![("model.hidden", of.hidden, 1), ("model.inner", of.inner, 1), ("model.cycles", of.cycles, 2)]
            }
        }
    }

    /// The name that `type` gives it.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Trm(_) => "trm",
            Self::SmallTrm(_) => "small_trm",
            Self::Cnn(_) => "cnn",
            Self::Transformer(_) => "transformer",
            Self::Mlp(_) => "mlp",
            Self::Hierarchical(_) => "hierarchical",
            Self::Conv(_) => "conv",
        }
    }

    /// The model of this configuration that marks the cells of `task`.
    pub(super) fn build(&self, task: Task, probability: ClassProbability, seed: u64) -> Result<Solver, ModelError> {
        let grid = match self {
            Self::Trm(section) => {
                let model = Box::new(trm::Trm::new(section.config(task), seed)?);
                return Ok(Solver::Trm { model, task, probability });
            }
            Self::SmallTrm(config) => GridConfig::SmallTrm(config.clone()),
            Self::Cnn(CnnSection { channels }) => GridConfig::Cnn { channels: channels.clone() },
            &Self::Transformer(TransformerSection { dim, heads, layers, feedforward }) => {
                GridConfig::Transformer { dim, heads, layers, feedforward }
            }
            Self::Mlp(MlpSection { hidden }) => GridConfig::Mlp { hidden: hidden.clone() },
            Self::Hierarchical(_) | Self::Conv(_) => return Err(self.misplaced("one that marks cells")),
        };
        let dims = GridDims {
            channels: task.vocabulary() - 1,
            height: task.side(),
            width: task.side(),
            classes: task.classes(),
        };
        Ok(Solver::Grid { model: grid.build(dims, seed)?, dims, task, probability })
    }
}

impl SolverConfig {
    /// The walker of this configuration for mazes of `task`.
    pub(super) fn build_walker(&self, task: MazeTask, value: bool, seed: u64) -> Result<Solver, ModelError> {
        let net = match self {
            Self::Mlp(MlpSection { hidden }) => WalkerConfig::Mlp { hidden: hidden.clone(), value },
            &Self::Hierarchical(HierarchicalSection { high, low, cycles, previous_action }) => {
                WalkerConfig::Trm { high, low, cycles, previous_action, value }
            }
            &Self::Conv(ConvSection { hidden, inner, cycles }) => {
                let (height, width) = (task.side(), task.side());
                WalkerConfig::Conv { channels: 3, height, width, hidden, inner, cycles, value }
            }
            _ => return Err(self.misplaced("mlp, hierarchical or conv with [rl]")),
        };
        let net = net.build(walk::observation_len(task), MOVES.len(), seed)?;
        Ok(Solver::Walker { net, task })
    }

    pub(super) fn misplaced(&self, expected: &str) -> ModelError {
        ModelError::Config {
            model: "puzzle solver",
            field: "type",
            found: self.kind().to_owned(),
            expected: expected.to_owned(),
        }
    }
}

impl TrmSection {
    fn config(&self, task: Task) -> trm::Config {
        let side = task.side();
        trm::Config {
            classes: Some(task.classes()),
            grid: Some([side, side]),
            num_heads: self.num_heads,
            layers: self.layers,
            h_cycles: self.h_cycles,
            l_cycles: self.l_cycles,
            mixing: self.mixing,
            positions: self.positions,
            inner_size: Some(self.inner_size),
            pooling: self.pooling,
            q_outputs: 1,
            halt_max_steps: self.halt_max_steps,
            halt_exploration_prob: self.halt_exploration_prob,
            ..trm::Config::new(task.vocabulary(), task.cells(), self.hidden_size)
        }
    }
}
