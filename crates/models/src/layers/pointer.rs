//! Pointing: which of several things is meant, told beside the actions.
//!
//! A score for each candidate, read off its token after everything was encoded; softmax over them. The candidate's token
//! as it came in, averaged by these shares, becomes one more token for whatever decodes the actions. Where demonstrations
//! show which thing was taken, cross-entropy trains the scores: of a chunk of actions a choice is a small part only.

use super::tokens::TokenLayout;
use super::{Embedding, Linear};
use crate::batch::Batch;
use crate::classification::{ClassProbability, cross_entropy};
use crate::device::HERE;
use crate::error::{ModelError, Result};
use crate::features::{FeatureKind, Signature};
use crate::params::Params;
use crate::rng::Rng;
use candle_core::{D, DType, Tensor};
use serde::{Deserialize, Serialize};

/// `[policy.pointer]`: ask which entity a demonstration took, and let the actions see the answer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PointerConfig {
    /// the group of entities of which one is taken; those of them that have a position of their own are no candidates
    pub among: String,
    /// weight of the loss on which was taken
    #[serde(default = "default_weight")]
    pub weight: f64,
}

fn default_weight() -> f64 {
    1.0
}

impl PointerConfig {
    /// # Errors
    /// A weight that is none.
    pub(crate) fn validate(&self, model: &'static str) -> Result<()> {
        if self.weight.is_finite() && self.weight >= 0.0 {
            return Ok(());
        }
        let (found, expected) = (self.weight.to_string(), "a finite number, at least 0".to_string());
        Err(ModelError::Config { model, field: "pointer.weight", found, expected })
    }

    /// The features of a signature among which one is taken, by their places in it.
    pub fn candidates(&self, signature: &Signature) -> Vec<usize> {
        let specs = signature.observation.iter().enumerate();
        let among = specs.filter(|(_, s)| s.kind == FeatureKind::Entity && s.group() == self.among && !s.position);
        among.map(|(at, _)| at).collect()
    }
}

/// The layer.
#[derive(Debug)]
pub(crate) struct Pointer {
    score: Linear,
    /// (1, D), of the token that is read
    position: Embedding,
    /// places of the candidates among the tokens
    tokens: Tensor,
    /// and of their features in the signature
    features: Vec<usize>,
    pub(crate) weight: f64,
}

/// What a pointer says.
#[derive(Debug)]
pub(crate) struct Pointed {
    /// (b, candidates)
    pub(crate) scores: Tensor,
    /// (b, 1, D)
    pub(crate) token: Tensor,
}

impl Pointer {
    /// # Errors
    /// Fewer than two candidates.
    pub(crate) fn new(
        p: &mut Params,
        config: &PointerConfig,
        (model, signature, layout): (&'static str, &Signature, &TokenLayout),
        dim: usize,
        rng: &mut Rng,
    ) -> Result<Self> {
        let features = config.candidates(signature);
        if features.len() < 2 {
            let found = format!("{} of group {}", features.len(), config.among);
            let expected = "a group of at least two entities without a position".to_string();
            return Err(ModelError::Config { model, field: "pointer.among", found, expected });
        }
        let place = |&feature: &usize| {
            let name = &signature.observation[feature].name;
            // the latent's token comes first
            let at = layout.tokens.iter().position(|token| token.feature == *name);
            1 + at.expect("an entity is a token") as u32
        };
        let places: Vec<u32> = features.iter().map(place).collect();
        Ok(Self {
            score: Linear::new(p, "pointer.score", dim, 1, rng)?,
            position: Embedding::new(p, "pointer.pos_embed", 1, dim, rng)?,
            tokens: Tensor::new(places, &HERE)?,
            features,
            weight: config.weight,
        })
    }

    /// encoded and tokens: (b, M, D), after and before everything was encoded
    pub(crate) fn forward(&self, encoded: &Tensor, tokens: &Tensor) -> Result<Pointed> {
        let scores = self.score.forward(&encoded.index_select(&self.tokens, 1)?)?.squeeze(2)?;
        let shares = scores.broadcast_sub(&scores.max_keepdim(D::Minus1)?.detach())?.exp()?;
        let shares = shares.broadcast_div(&shares.sum_keepdim(D::Minus1)?)?;
        let token = shares.unsqueeze(1)?.matmul(&tokens.index_select(&self.tokens, 1)?.contiguous()?)?;
        Ok(Pointed { scores, token })
    }

    /// What a decoder reads, (b, M, D), and its positions, (1, M, D), with the token that is pointed at after them.
    pub(crate) fn beside(&self, memory: &Tensor, pos: &Tensor, pointed: &Pointed) -> Result<(Tensor, Tensor)> {
        let own = self.position.weight.unsqueeze(0)?;
        Ok((Tensor::cat(&[memory, &pointed.token], 1)?, Tensor::cat(&[pos, &own], 1)?))
    }

    /// The candidate that was taken in each row.
    ///
    /// # Errors
    /// A batch that does not say, or names something else.
    pub(crate) fn taken(&self, model: &'static str, batch: &Batch) -> Result<Vec<i64>> {
        let refuse = |found: String| {
            let expected = "one of the candidates of `pointer.among` for each row".to_string();
            ModelError::Input { operation: model, object: "what was taken", found, expected }
        };
        let taken = batch.taken.as_ref().ok_or_else(|| refuse("nothing".to_string()))?;
        if taken.len() != batch.rows() {
            return Err(refuse(format!("{} for {} rows", taken.len(), batch.rows())));
        }
        let label = |&feature: &u32| {
            let at = self.features.iter().position(|&candidate| candidate == feature as usize);
            at.map(|at| at as i64).ok_or_else(|| refuse(format!("feature {feature}")))
        };
        taken.iter().map(label).collect()
    }

    /// Cross-entropy, a share of the mean over the whole batch.
    pub(crate) fn loss(&self, pointed: &Pointed, taken: &[i64], batch: &Batch) -> Result<Tensor> {
        let each = cross_entropy(&pointed.scores, taken, ClassProbability::Softmax)?.to_dtype(DType::F32)?;
        Ok((each.sum_all()? / batch.total_rows.max(1) as f64)?)
    }

    /// Rows whose highest score is that of what was taken, a share of all rows of the batch.
    pub(crate) fn right(&self, pointed: &Pointed, taken: &[i64], batch: &Batch) -> Result<Tensor> {
        let highest = pointed.scores.detach().argmax(D::Minus1)?.to_vec1::<u32>()?;
        let right = highest.iter().zip(taken).filter(|(a, b)| i64::from(**a) == **b).count();
        Ok(Tensor::new(right as f32 / batch.total_rows.max(1) as f32, pointed.scores.device())?)
    }
}
