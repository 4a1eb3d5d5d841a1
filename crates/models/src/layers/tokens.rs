//! Observations as tokens: one for the latent, one for each feature, through a dense layer each; entities of one group
//! share theirs.
//!
//! Names of parameters are LeRobot's; it has no entities. A history of observations is one token: its steps lie side by
//! side in the token's input.

use super::{Embedding, Linear};
use crate::encoders::{ImageEncoder, ResNetShape, Size, TokenKind, VisionConfig, position_table};
use crate::features::{FeatureKind, Features, Signature};
use candle_core::{DType, Tensor};
use nn::Params;
use nn::Rng;
use nn::ops::{cat_tokens, linear, select_tokens};
use nn::{Context, Value};
use nn::{ModelError, Result};

/// The latent's projection.
const LATENT: &str = "encoder_latent_input_proj";
/// Positions of latent, state and environment state.
const FEATURE_POSITIONS: &str = "encoder_1d_feature_pos_embed";
/// Positions of the entities that have one.
const ENTITY_POSITIONS: &str = "encoder_entity_pos_embed";

/// Where a token's position comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Position {
    /// a row of [`FEATURE_POSITIONS`]
    Feature(usize),
    /// a row of [`ENTITY_POSITIONS`]
    Entity(usize),
    /// it has none: zeros
    Nowhere,
}

/// One feature's token.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct TokenSpec {
    /// name of the feature
    pub(crate) feature: String,
    /// its kind
    pub(crate) kind: FeatureKind,
    /// prefix of its projection's parameters; the same for all entities of a group
    pub(crate) prefix: String,
    /// numbers that it reads
    pub(crate) width: usize,
    /// its position
    pub(crate) position: Position,
}

/// The cameras of a signature, and the tokens that their images become.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Cameras {
    pub(crate) config: VisionConfig,
    /// the network
    pub(crate) shape: ResNetShape,
    /// names of the features
    pub(crate) features: Vec<String>,
    /// sizes of their images
    pub(crate) given: Vec<Size>,
    /// sizes of what is seen of them
    pub(crate) seen: Vec<Size>,
    /// tokens of all cameras
    pub(crate) tokens: usize,
    /// fixed positions of the tokens, (tokens, D); empty where they are learned
    pub(crate) positions: Vec<f32>,
}

impl Cameras {
    fn new(signature: &Signature, config: &VisionConfig, dim: usize) -> Result<Option<Self>> {
        let specs: Vec<_> = signature.of_kind(FeatureKind::Image).collect();
        if specs.is_empty() {
            return Ok(None);
        }
        config.validate()?;
        let refuse = |field: &'static str, found: String, expected: &str| {
            Err(ModelError::Config { model: "vision", field, found, expected: expected.to_string() })
        };
        let (mut given, mut seen) = (Vec::new(), Vec::new());
        for spec in &specs {
            let &[h, w, 3] = spec.shape.as_slice() else {
                let found = format!("{} of shape {:?}", spec.name, spec.shape);
                return refuse("observation", found, "height, width and 3 colours");
            };
            given.push((h, w));
            seen.push(config.seen((h, w))?);
        }
        let shape = config.shape();
        let (mut tokens, mut positions) = (specs.len(), Vec::new());
        if config.tokens == TokenKind::Map {
            tokens = 0;
            for &size in &seen {
                let (h, w) = shape.map_size(size);
                tokens += h * w;
                positions.extend(position_table(dim, (h, w)));
            }
        }
        let features = specs.iter().map(|spec| spec.name.clone()).collect();
        Ok(Some(Self { config: config.clone(), shape, features, given, seen, tokens, positions }))
    }

    /// The same with the default encoder where nothing is said; to say something where nothing is seen is an error.
    pub(crate) fn asked(signature: &Signature, vision: Option<&VisionConfig>, dim: usize) -> Result<Option<Self>> {
        let cameras = Self::new(signature, vision.unwrap_or(&VisionConfig::default()), dim)?;
        if vision.is_some() && cameras.is_none() {
            let names: Vec<&str> = signature.observation.iter().map(|spec| spec.name.as_str()).collect();
            let (found, expected) = (names.join(", "), "a feature of kind image".to_string());
            return Err(ModelError::Config { model: "vision", field: "observation", found, expected });
        }
        Ok(cameras)
    }
}

/// The tokens after the latent's: state, environment state, entities, then images.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TokenLayout {
    /// one token a feature
    pub(crate) tokens: Vec<TokenSpec>,
    pub(crate) cameras: Option<Cameras>,
}

impl TokenLayout {
    /// Of a signature that was checked, for tokens of width `dim`; images are seen as `vision` says.
    pub(crate) fn new(signature: &Signature, vision: Option<&VisionConfig>, dim: usize) -> Result<Self> {
        let cameras = Cameras::asked(signature, vision, dim)?;
        if cameras.is_some() && signature.n_obs_steps != 1 {
            let (found, expected) = (signature.n_obs_steps.to_string(), "1 with images".to_string());
            return Err(ModelError::Config { model: "vision", field: "n_obs_steps", found, expected });
        }
        let mut specs: Vec<_> = signature.observation.iter().filter(|spec| spec.kind != FeatureKind::Image).collect();
        specs.sort_by_key(|spec| spec.kind);
        // the latent has the first row
        let (mut features, mut entities) = (1, 0);
        let next = |rows: &mut usize| {
            *rows += 1;
            *rows - 1
        };
        let tokens = specs.into_iter().map(|spec| TokenSpec {
            feature: spec.name.clone(),
            kind: spec.kind,
            prefix: match spec.kind {
                FeatureKind::State => "encoder_robot_state_input_proj".to_string(),
                FeatureKind::EnvironmentState => "encoder_env_state_input_proj".to_string(),
                FeatureKind::Entity | FeatureKind::Image => format!("encoder_entity_input_proj.{}", spec.group()),
            },
            width: signature.n_obs_steps * spec.width(),
            position: match (spec.kind, spec.position) {
                (FeatureKind::State | FeatureKind::EnvironmentState, _) => Position::Feature(next(&mut features)),
                (FeatureKind::Entity | FeatureKind::Image, true) => Position::Entity(next(&mut entities)),
                (FeatureKind::Entity | FeatureKind::Image, false) => Position::Nowhere,
            },
        });
        Ok(Self { tokens: tokens.collect(), cameras })
    }

    /// Tokens with the latent's, without those of images.
    pub(crate) fn vectors(&self) -> usize {
        1 + self.tokens.len()
    }

    /// All tokens.
    pub(crate) fn len(&self) -> usize {
        self.vectors() + self.cameras.as_ref().map_or(0, |cameras| cameras.tokens)
    }

    fn rows(&self, of: fn(Position) -> bool) -> usize {
        self.tokens.iter().filter(|token| of(token.position)).count()
    }

    /// Rows of [`FEATURE_POSITIONS`].
    pub(crate) fn feature_rows(&self) -> usize {
        1 + self.rows(|position| matches!(position, Position::Feature(_)))
    }

    /// Rows of [`ENTITY_POSITIONS`].
    pub(crate) fn entity_rows(&self) -> usize {
        self.rows(|position| matches!(position, Position::Entity(_)))
    }

    fn of_kind(&self, kind: FeatureKind) -> impl Iterator<Item = &TokenSpec> {
        self.tokens.iter().filter(move |token| token.kind == kind)
    }

    /// The state's token.
    pub(crate) fn state(&self) -> &TokenSpec {
        self.of_kind(FeatureKind::State).next().expect("a checked signature has a state")
    }
}

/// The environment state's projection, where there is one. It is drawn before the others.
pub(crate) fn environment_state(
    p: &mut Params,
    layout: &TokenLayout,
    dim: usize,
    rng: &mut Rng,
) -> Result<Option<Linear>> {
    let token = layout.of_kind(FeatureKind::EnvironmentState).next();
    token.map(|token| Linear::new(p, &token.prefix, token.width, dim, rng)).transpose()
}

/// Observations as tokens.
#[derive(Debug)]
pub(crate) struct InputTokens {
    layout: TokenLayout,
    latent: Linear,
    /// one for each token of the layout; those of a group share their weights
    projections: Vec<Linear>,
    feature_positions: Embedding,
    entity_positions: Option<Embedding>,
    image_encoder: Option<ImageEncoder>,
}

impl InputTokens {
    /// `env_state` is the layout's [`environment_state`].
    pub(crate) fn new(
        p: &mut Params,
        layout: TokenLayout,
        latent_dim: usize,
        dim: usize,
        env_state: Option<Linear>,
        rng: &mut Rng,
    ) -> Result<Self> {
        let latent = Linear::new(p, LATENT, latent_dim, dim, rng)?;
        let mut made: Vec<(&str, Linear)> = Vec::new();
        for token in layout.of_kind(FeatureKind::State) {
            made.push((&token.prefix, Linear::new(p, &token.prefix, token.width, dim, rng)?));
        }
        let feature_positions = Embedding::new(p, FEATURE_POSITIONS, layout.feature_rows(), dim, rng)?;
        for token in layout.of_kind(FeatureKind::EnvironmentState) {
            made.extend(env_state.clone().map(|layer| (token.prefix.as_str(), layer)));
        }
        for token in layout.of_kind(FeatureKind::Entity) {
            if made.iter().all(|(prefix, _)| *prefix != token.prefix) {
                made.push((&token.prefix, Linear::new(p, &token.prefix, token.width, dim, rng)?));
            }
        }
        let entity_positions = match layout.entity_rows() {
            0 => None,
            rows => Some(Embedding::new(p, ENTITY_POSITIONS, rows, dim, rng)?),
        };
        let layer = |prefix: &str| made.iter().find(|(name, _)| *name == prefix).map(|(_, layer)| layer.clone());
        let projections = layout.tokens.iter();
        let projections = projections.map(|token| layer(&token.prefix).expect("one was made for every token"));
        let projections = projections.collect();
        let image_encoder = match &layout.cameras {
            Some(cameras) => Some(ImageEncoder::new(p, &cameras.config, &cameras.given, dim, rng)?),
            None => None,
        };
        Ok(Self { layout, latent, projections, feature_positions, entity_positions, image_encoder })
    }

    /// The observation with images as the network reads them: random parts in training, with `rng`. Images that
    /// are prepared already stay.
    pub(crate) fn prepare(
        &self,
        observation: &Features<Tensor>,
        mut rng: Option<&mut Rng>,
    ) -> Result<Features<Tensor>> {
        let mut seen = observation.clone();
        if let (Some(image_encoder), Some(cameras)) = (&self.image_encoder, &self.layout.cameras) {
            for (i, name) in cameras.features.iter().enumerate() {
                let images = observation.require("see", name)?;
                if images.dtype() == DType::U8 {
                    seen.insert(name, image_encoder.prepare(i, images, rng.as_deref_mut())?);
                }
            }
        }
        Ok(seen)
    }

    /// How images are seen, if there are any.
    pub(crate) fn vision(&self) -> Option<&VisionConfig> {
        self.layout.cameras.as_ref().map(|cameras| &cameras.config)
    }

    /// Which tokens.
    pub(crate) fn layout(&self) -> &TokenLayout {
        &self.layout
    }

    /// latent: (b, L), the features of the observation -> (b, M, D)
    pub(crate) fn apply(&self, cx: &mut Context<'_>, latent: &Value, observation: &Features<Tensor>) -> Result<Value> {
        let (b, width) = latent.dims2()?;
        // backwards, so that gradients of a projection that entities share are added in their order
        let mut tokens = Vec::with_capacity(2 + self.projections.len());
        for (token, layer) in self.layout.tokens.iter().zip(&self.projections).rev() {
            let values = observation.require("tokens", &token.feature)?.flatten_from(1)?.unsqueeze(1)?;
            tokens.push(linear(cx, &Value::from(&values.contiguous()?), layer)?);
        }
        tokens.push(linear(cx, &latent.reshape((b, 1, width))?, &self.latent)?);
        tokens.reverse();
        if let (Some(image_encoder), Some(cameras)) = (&self.image_encoder, &self.layout.cameras) {
            let images = cameras.features.iter().map(|name| Ok(observation.require("tokens", name)?.clone()));
            tokens.push(image_encoder.apply(cx, &images.collect::<Result<Vec<_>>>()?)?);
        }
        cat_tokens(cx, b, &tokens.iter().collect::<Vec<_>>())
    }

    /// (1, M, D)
    pub(crate) fn apply_positions(&self, cx: &mut Context<'_>) -> Result<Value> {
        let (rows, dim) = self.feature_positions.weight.dims2()?;
        let features = cx.parameter(&self.feature_positions.weight)?.reshape((1, rows, dim))?;
        if self.layout.len() == self.layout.feature_rows() {
            return Ok(features);
        }
        let entities = match &self.entity_positions {
            Some(entities) => {
                let rows = entities.weight.dim(0)?;
                Some(cx.parameter(&entities.weight)?.reshape((1, rows, dim))?)
            }
            None => None,
        };
        let nowhere = Value::zeros((1, 1, dim), &cx.device().clone())?;
        let mut parts = vec![select_tokens(cx, &features, &[0])?];
        for token in &self.layout.tokens {
            parts.push(match (token.position, &entities) {
                (Position::Feature(row), _) => select_tokens(cx, &features, &[row])?,
                (Position::Entity(row), Some(entities)) => select_tokens(cx, entities, &[row])?,
                (Position::Entity(_) | Position::Nowhere, _) => nowhere.clone(),
            });
        }
        if let Some(image_encoder) = &self.image_encoder {
            let positions = image_encoder.positions()?;
            let (rows, dim) = positions.dims2()?;
            let positions =
                if image_encoder.learns_positions() { cx.parameter(&positions)? } else { Value::from(&positions) };
            parts.push(positions.reshape((1, rows, dim))?);
        }
        cat_tokens(cx, 1, &parts.iter().collect::<Vec<_>>())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::features::FeatureSpec;

    #[test]
    fn tokens_come_by_kind_and_share_projections_by_group() {
        let observation = vec![
            FeatureSpec::entity("cube0", 3, "cube", false),
            FeatureSpec::environment_state(4),
            FeatureSpec::entity("goal0", 2, "goal", true),
            FeatureSpec::state(5),
            FeatureSpec::entity("cube1", 3, "cube", false),
            FeatureSpec::entity("goal1", 2, "goal", true),
        ];
        let signature = Signature { observation, n_obs_steps: 2, action_dim: 1, ..Signature::default() };
        let layout = TokenLayout::new(&signature, None, 8).unwrap();
        let seen: Vec<_> = layout.tokens.iter().map(|t| (t.prefix.as_str(), t.width, t.position)).collect();
        assert_eq!(
            seen,
            [
                ("encoder_robot_state_input_proj", 10, Position::Feature(1)),
                ("encoder_env_state_input_proj", 8, Position::Feature(2)),
                ("encoder_entity_input_proj.cube", 6, Position::Nowhere),
                ("encoder_entity_input_proj.goal", 4, Position::Entity(0)),
                ("encoder_entity_input_proj.cube", 6, Position::Nowhere),
                ("encoder_entity_input_proj.goal", 4, Position::Entity(1)),
            ]
        );
        assert_eq!((layout.len(), layout.feature_rows(), layout.entity_rows()), (7, 3, 2));
        assert_eq!(layout.state().feature, "observation.state");

        let (mut p, rng) = (Params::new(&nn::Backend::CPU), &mut Rng::new(1, "init"));
        let env_state = environment_state(&mut p, &layout, 8, rng).unwrap();
        let tokens = InputTokens::new(&mut p, layout, 3, 8, env_state, rng).unwrap();
        let positions = nn::compose(&candle_core::Device::Cpu, |cx| tokens.apply_positions(cx)).unwrap().detached();
        let positions = positions.squeeze(0).unwrap().to_vec2::<f32>().unwrap();
        let rows = |name: &str| p.get(name).unwrap().to_vec2::<f32>().unwrap();
        let (features, entities) =
            (rows("encoder_1d_feature_pos_embed.weight"), rows("encoder_entity_pos_embed.weight"));
        assert_eq!(positions[..3], features);
        assert_eq!((&positions[4], &positions[6]), (&entities[0], &entities[1]));
        assert!(positions[3].iter().chain(&positions[5]).all(|x| *x == 0.0));
    }
}
