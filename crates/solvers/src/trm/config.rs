//! Sizes and choices of a TRM.

use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};

/// How a layer lets positions see each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mixing {
    /// Multi-head self attention without a mask.
    #[default]
    Attention,
    /// A SwiGLU over the sequence axis, the same for every channel.
    MlpT,
    /// A zero-padded 3x3 convolution over `grid`.
    Conv,
}

/// How positions are distinguished.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Positions {
    /// Rotary embeddings of queries and keys (attention only).
    #[default]
    Rope,
    /// A learned vector per position, added to the input embedding.
    Learned,
    /// None; the mixing depends on positions itself.
    None,
}

/// What the halting head reads of `z_h`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Pooling {
    /// The first position (the reference's).
    #[default]
    First,
    /// The mean over positions.
    Mean,
}

/// Sizes and choices of a TRM.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Number of input tokens.
    pub vocab_size: usize,
    /// Number of output classes; the vocabulary's size when absent.
    #[serde(default)]
    pub classes: Option<usize>,
    /// Tokens per puzzle.
    pub seq_len: usize,
    /// Channels.
    pub hidden_size: usize,
    /// Attention heads; must divide `hidden_size`.
    #[serde(default = "default_heads")]
    pub num_heads: usize,
    /// Layers of the one network.
    #[serde(default = "default_layers")]
    pub layers: usize,
    /// Rounds per supervision step; only the last has gradients.
    #[serde(default = "default_h_cycles")]
    pub h_cycles: usize,
    /// Updates of `z_l` per round.
    #[serde(default = "default_l_cycles")]
    pub l_cycles: usize,
    /// How positions see each other.
    #[serde(default)]
    pub mixing: Mixing,
    /// Height and width, needed by [`Mixing::Conv`]; their product is `seq_len`.
    #[serde(default)]
    pub grid: Option<[usize; 2]>,
    /// How positions are distinguished.
    #[serde(default)]
    pub positions: Positions,
    /// Base of the rotary angles.
    #[serde(default = "default_rope_theta")]
    pub rope_theta: f64,
    /// Added to the mean square before its root.
    #[serde(default = "default_eps")]
    pub rms_norm_eps: f64,
    /// SwiGLU's width as a multiple of its input, before the 2/3 and the rounding up to 256.
    #[serde(default = "default_expansion")]
    pub expansion: f64,
    /// SwiGLU's width as it is, instead of through `expansion`.
    #[serde(default)]
    pub inner_size: Option<usize>,
    /// What the halting head reads.
    #[serde(default)]
    pub pooling: Pooling,
    /// Outputs of the halting head; the reference has 2 and uses the first.
    #[serde(default = "default_q_outputs")]
    pub q_outputs: usize,
    /// Length of a puzzle's own embedding; 0 for none.
    #[serde(default)]
    pub puzzle_emb_ndim: usize,
    /// Rows of the puzzle embedding's table.
    #[serde(default)]
    pub num_puzzle_identifiers: usize,
    /// Positions that the puzzle embedding takes; 0 for as many as it fills.
    #[serde(default)]
    pub puzzle_emb_len: usize,
    /// Supervision steps after which a puzzle is given up.
    #[serde(default = "default_halt_max_steps")]
    pub halt_max_steps: usize,
    /// Share of puzzles that must take a random minimum of steps.
    #[serde(default = "default_exploration")]
    pub halt_exploration_prob: f64,
}

fn default_heads() -> usize {
    1
}
fn default_layers() -> usize {
    2
}
fn default_h_cycles() -> usize {
    3
}
fn default_l_cycles() -> usize {
    6
}
fn default_rope_theta() -> f64 {
    1e4
}
fn default_eps() -> f64 {
    1e-5
}
fn default_expansion() -> f64 {
    4.0
}
fn default_q_outputs() -> usize {
    2
}
fn default_halt_max_steps() -> usize {
    16
}
fn default_exploration() -> f64 {
    0.1
}

/// Most supervision steps of a puzzle.
const MOST_STEPS: usize = 65_536;

impl Config {
    /// A configuration of the reference's defaults for the given sizes.
    pub fn new(vocab_size: usize, seq_len: usize, hidden_size: usize) -> Self {
        Self {
            vocab_size,
            classes: None,
            seq_len,
            hidden_size,
            num_heads: default_heads(),
            layers: default_layers(),
            h_cycles: default_h_cycles(),
            l_cycles: default_l_cycles(),
            mixing: Mixing::default(),
            grid: None,
            positions: Positions::default(),
            rope_theta: default_rope_theta(),
            rms_norm_eps: default_eps(),
            expansion: default_expansion(),
            inner_size: None,
            pooling: Pooling::default(),
            q_outputs: default_q_outputs(),
            puzzle_emb_ndim: 0,
            num_puzzle_identifiers: 0,
            puzzle_emb_len: 0,
            halt_max_steps: default_halt_max_steps(),
            halt_exploration_prob: default_exploration(),
        }
    }

    /// Number of output classes.
    pub fn classes(&self) -> usize {
        self.classes.unwrap_or(self.vocab_size)
    }

    /// Positions before the puzzle's tokens that hold its embedding.
    pub fn prefix_len(&self) -> usize {
        match (self.puzzle_emb_ndim, self.puzzle_emb_len) {
            (0, _) => 0,
            (n, 0) => n.div_ceil(self.hidden_size),
            (_, len) => len,
        }
    }

    /// Positions of the states.
    pub fn positions_len(&self) -> usize {
        self.prefix_len() + self.seq_len
    }

    /// SwiGLU's width over `n` inputs.
    pub fn inner(&self, n: usize) -> usize {
        self.inner_size.unwrap_or_else(|| {
            let wanted = (self.expansion * n as f64 * 2.0 / 3.0).round_ties_even() as usize;
            wanted.div_ceil(256) * 256
        })
    }

    /// Refuses what cannot work, naming the field.
    ///
    /// # Errors
    /// [`ModelError::Config`] with the field, what it is and what it should be.
    pub fn check(&self) -> Result<()> {
        fn refuse(field: &'static str, found: impl ToString, expected: impl Into<String>) -> Result<()> {
            Err(ModelError::Config { model: "trm", field, found: found.to_string(), expected: expected.into() })
        }
        for (field, value) in [
            ("vocab_size", self.vocab_size),
            ("classes", self.classes()),
            ("seq_len", self.seq_len),
            ("hidden_size", self.hidden_size),
            ("num_heads", self.num_heads),
            ("layers", self.layers),
            ("h_cycles", self.h_cycles),
            ("l_cycles", self.l_cycles),
            ("inner_size", self.inner_size.unwrap_or(1)),
            ("q_outputs", self.q_outputs),
            ("halt_max_steps", self.halt_max_steps),
        ] {
            if value == 0 {
                return refuse(field, value, "at least 1");
            }
        }
        if self.halt_max_steps > MOST_STEPS {
            return refuse("halt_max_steps", self.halt_max_steps, format!("at most {MOST_STEPS}"));
        }
        let (d, heads) = (self.hidden_size, self.num_heads);
        match self.mixing {
            Mixing::Attention if !d.is_multiple_of(heads) => {
                return refuse("num_heads", heads, format!("a divisor of hidden_size {d}"));
            }
            Mixing::Attention if self.positions == Positions::Rope && !(d / heads).is_multiple_of(2) => {
                return refuse("num_heads", heads, "an even size per head for rotary positions");
            }
            Mixing::Conv if self.prefix_len() > 0 => {
                return refuse("puzzle_emb_ndim", self.puzzle_emb_ndim, "0 with mixing conv");
            }
            Mixing::Conv => match self.grid {
                Some([h, w]) if h * w == self.seq_len => {}
                Some([h, w]) => {
                    return refuse("grid", format!("{h}x{w}"), format!("{} cells", self.seq_len));
                }
                None => return refuse("grid", "absent", "height and width with mixing conv"),
            },
            Mixing::Attention | Mixing::MlpT => {}
        }
        if self.puzzle_emb_ndim > 0 {
            if self.num_puzzle_identifiers == 0 {
                return refuse("num_puzzle_identifiers", 0, "at least 1 with puzzle embeddings");
            }
            if self.prefix_len() * d < self.puzzle_emb_ndim {
                let least = self.puzzle_emb_ndim.div_ceil(d);
                return refuse("puzzle_emb_len", self.puzzle_emb_len, format!("at least {least}"));
            }
        }
        if !(0.0..=1.0).contains(&self.halt_exploration_prob) {
            return refuse("halt_exploration_prob", self.halt_exploration_prob, "0 to 1");
        }
        Ok(())
    }
}
