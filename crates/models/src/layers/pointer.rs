//! Pointer: a classification head over entity tokens; which of several entities the policy acts on.
//!
//! A score for each candidate, read off its token after everything was encoded; softmax over them. The candidate's token
//! as it came in, averaged by these shares, becomes one more token for whatever decodes the actions. Where demonstrations
//! show which thing was taken, cross-entropy trains the scores: of a chunk of actions a choice is a small part only.

use super::tokens::TokenLayout;
use super::{Embedding, Linear};
use crate::batch::Batch;
use crate::checks::check_weight;
use crate::classification::{ClassProbability, IGNORE_LABEL, cross_entropy};
use crate::features::{FeatureKind, Signature};
use candle_core::{DType, Tensor};
use nn::Params;
use nn::Rng;
use nn::ops::{cat_tokens, linear, select_tokens, term_of, weighted_mean};
use nn::values::with_values;
use nn::{Context, Number, Term, Value};
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// `[policy.pointer]`: ask which entity a demonstration took, and let the actions see the answer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PointerConfig {
    /// group of entities of which one is taken; those with a learned position are no candidates
    pub among: String,
    /// weight of the loss
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
        check_weight(model, "pointer.weight", self.weight)
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
    places: Vec<u32>,
    /// and of their features in the signature
    features: Vec<usize>,
    pub(crate) weight: f64,
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
            places,
            features,
            weight: config.weight,
        })
    }

    /// Of tokens, (b, M, D), those of the candidates, (b, candidates, D).
    pub(crate) fn candidates(&self, cx: &mut Context<'_>, tokens: &Value) -> Result<Value> {
        select_tokens(cx, tokens, &self.places.iter().map(|place| *place as usize).collect::<Vec<_>>())
    }

    /// encoded: (b, M, D), the candidates as they came in, (b, candidates, D), pos: (1, M, D) -> what a decoder reads and its
    /// positions, with the token that is pointed at after them, and the scores, (b, candidates)
    pub(crate) fn apply(
        &self,
        cx: &mut Context<'_>,
        (encoded, candidates): (&Value, &Value),
        pos: &Value,
    ) -> Result<(Value, Value, Value)> {
        let (b, n, _) = candidates.dims3()?;
        let read = self.candidates(cx, encoded)?;
        let scores = linear(cx, &read, &self.score)?.reshape((b, n))?;
        let token = weighted_mean(cx, &scores, candidates)?;
        let memory = cat_tokens(cx, b, &[encoded, &token])?;
        let own = cx.parameter(&self.position.weight)?.reshape((1, 1, pos.width()))?;
        Ok((memory, cat_tokens(cx, 1, &[pos, &own])?, scores))
    }

    /// What is asked of a batch.
    ///
    /// # Errors
    /// A batch that does not say what was taken, or names something else than the candidates.
    pub(crate) fn asked(&self, model: &'static str, batch: &Batch) -> Result<Arc<dyn Question>> {
        let refuse = |found: String| {
            let expected = "one of the candidates of `pointer.among` for each row".to_string();
            ModelError::Input { operation: model, object: "what was taken", found, expected }
        };
        let taken = batch.taken.as_ref().ok_or_else(|| refuse("nothing".to_string()))?;
        if taken.features.len() != batch.rows() {
            return Err(refuse(format!("{} for {} rows", taken.features.len(), batch.rows())));
        }
        let candidate = |feature: u32| {
            let at = self.features.iter().position(|&candidate| candidate == feature as usize);
            at.ok_or_else(|| refuse(format!("feature {feature}")))
        };
        let candidates = taken.features.iter().map(|feature| feature.map(candidate).transpose());
        Ok(Arc::new(Asked { candidates: candidates.collect::<Result<_>>()?, total: taken.total.max(1) }))
    }
}

/// What a pointer is asked of a shard: of each row the candidate that was taken, where it is asked.
#[derive(Debug)]
struct Asked {
    candidates: Vec<Option<usize>>,
    /// rows of the whole batch that are asked
    total: usize,
}

/// How a question is answered.
#[derive(Debug)]
pub(crate) struct Answers {
    /// cross-entropy, a share of the mean over all of the batch that is asked
    pub(crate) loss: f64,
    /// rows that are answered rightly, a share likewise
    pub(crate) right: f32,
}

/// What scores are asked about.
pub(crate) trait Question {
    /// The answers that scores give; writes `weight` times the gradient of their loss beside them.
    fn answers(&self, scores: &[f32], grad: Option<(&mut [f32], f64)>) -> Answers;

    /// Their loss on candle's graph.
    fn loss(&self, scores: &Tensor) -> Result<Tensor>;

    /// The share of rows that are answered rightly, of candle's operations.
    fn right(&self, scores: &Tensor) -> Result<Tensor>;
}

/// The loss of these scores, and the share of rows that are answered rightly.
pub(crate) fn ask(cx: &mut Context<'_>, question: &Arc<dyn Question>, scores: &Value) -> Result<(Term, Number)> {
    let right = match cx.is_composed() {
        true => Number::There(question.right(&scores.detached())?),
        false => with_values(&scores.detached(), |scores| question.answers(scores, None).right)?.into(),
    };
    let on_slices = Arc::clone(question);
    let on_slices = move |scores: &[f32], grad: Option<(&mut [f32], f64)>| on_slices.answers(scores, grad).loss;
    Ok((term_of(cx, scores, on_slices, |scores| question.loss(scores))?, right))
}

impl Question for Asked {
    /// scores: (b, candidates) -> cross-entropy, a share of the mean over all rows of the batch that are asked.
    fn loss(&self, scores: &Tensor) -> Result<Tensor> {
        let label = |candidate: &Option<usize>| candidate.map_or(IGNORE_LABEL, |at| at as i64);
        let labels: Vec<i64> = self.candidates.iter().map(label).collect();
        let each = cross_entropy(scores, &labels, ClassProbability::Softmax)?.to_dtype(DType::F32)?;
        Ok((each.sum_all()? / self.total as f64)?)
    }

    fn right(&self, scores: &Tensor) -> Result<Tensor> {
        let of = |f: fn(&Option<usize>) -> u32| self.candidates.iter().map(f).collect::<Vec<u32>>();
        let rows = self.candidates.len();
        let taken = Tensor::from_vec(of(|taken| taken.unwrap_or(0) as u32), rows, scores.device())?;
        let asked = Tensor::from_vec(of(|taken| u32::from(taken.is_some())), rows, scores.device())?;
        let right = scores.argmax(1)?.eq(&taken)?.to_dtype(DType::F32)?.mul(&asked.to_dtype(DType::F32)?)?;
        Ok((right.sum_all()? / self.total as f64)?)
    }

    /// The same on a slice; writes `weight` times the gradient of the loss into `grad`, (b, candidates).
    fn answers(&self, scores: &[f32], grad: Option<(&mut [f32], f64)>) -> Answers {
        let width = scores.len() / self.candidates.len();
        let rows = || self.candidates.iter().zip(scores.chunks_exact(width));
        let asked = || rows().filter_map(|(taken, scores)| taken.map(|taken| (taken, scores)));
        let loss: f64 = asked().map(|(taken, scores)| ClassProbability::Softmax.loss(scores, taken)).sum();
        let highest = |scores: &[f32]| (1..width).fold(0, |best, at| if scores[at] > scores[best] { at } else { best });
        let right = asked().filter(|(taken, scores)| highest(scores) == *taken).count();
        if let Some((grad, weight)) = grad {
            let share = weight / self.total as f64;
            for ((taken, scores), grad) in rows().zip(grad.chunks_exact_mut(width)) {
                match taken {
                    Some(taken) => ClassProbability::Softmax.gradient(scores, *taken, share, grad),
                    None => grad.fill(0.0),
                }
            }
        }
        Answers { loss: loss / self.total as f64, right: right as f32 / self.total as f32 }
    }
}
