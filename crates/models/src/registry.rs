//! The policy models by name. A new model is a row of this table and a folder of `models`.

use crate::features::{FeatureKind, Signature};
use crate::layers::{AuxiliaryConfig, GridConfig, PointerConfig};
use crate::model::PolicyModel;
use crate::models::floors::{expert, nearest, random, replay, zero};
use crate::models::{act, actrm, bc, bc_rnn, bc_transformer, diffusion, flow, mip};
use candle_core::Tensor;
use nn::{Backend, ModelError, Result, Size};
use serde::de::{DeserializeSeed, Deserializer};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What each row of the table becomes.
macro_rules! policies {
    ($($(#[$doc:meta])* $name:literal => $variant:ident: $module:ident::$model:ident,)+) => {
        /// The configuration of any policy model: `type = "act"` and so on, with the model's own keys beside it.
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(tag = "type")]
        pub enum PolicyConfig {
            $($(#[$doc])* #[serde(rename = $name)] $variant($module::Config),)+
        }

        impl PolicyConfig {
            /// The names of all types.
            pub const TYPES: &[&str] = &[$($name),+];

            /// The name of its type.
            pub fn policy_type(&self) -> &'static str {
                match self {
                    $(Self::$variant(_) => $name,)+
                }
            }

            /// The kinds of features that its models read.
            pub fn reads(&self) -> &'static [FeatureKind] {
                match self {
                    $(Self::$variant(_) => $module::READS,)+
                }
            }

            /// A model on a device, with initial weights drawn from `seed`.
            ///
            /// # Errors
            /// A configuration that describes no possible model, or a feature that it cannot read.
            pub fn build(&self, signature: &Signature, seed: u64, backend: &Backend) -> Result<Box<dyn PolicyModel>> {
                match self {
                    $(Self::$variant(config) => Ok(Box::new($module::$model::new(config, signature, seed, backend)?)),)+
                }
            }

            /// How large the model will be.
            pub fn size(&self) -> Size {
                match self {
                    $(Self::$variant(config) => config.size(),)+
                }
            }

            /// Checks that the model is not far larger than `weights` are: before it is built, of a file of anybody's.
            ///
            /// # Errors
            /// Options that say a model of more than twice the size, which [`Self::size`] only estimates.
            pub fn check_size(&self, weights: &BTreeMap<String, Tensor>) -> Result<()> {
                let (count, told) = (weights.values().map(Tensor::elem_count).sum::<usize>(), self.size().weights);
                if told <= 2.0 * count as f64 {
                    return Ok(());
                }
                let (found, expected) = (format!("{count} numbers"), format!("about {told:.0}, as the options say"));
                Err(ModelError::Input { operation: "load", object: "weights", found, expected })
            }

            /// Checks that a model with this configuration can exist.
            ///
            /// # Errors
            /// The first field that makes it impossible.
            pub fn validate(&self) -> Result<()> {
                match self {
                    $(Self::$variant(config) => config.validate(),)+
                }
            }

            /// Number of actions in a predicted chunk.
            pub fn action_horizon(&self) -> usize {
                match self {
                    $(Self::$variant(config) => config.action_horizon,)+
                }
            }
        }

        impl<'de> DeserializeSeed<'de> for PolicyType {
            type Value = PolicyConfig;

            fn deserialize<D: Deserializer<'de>>(self, keys: D) -> std::result::Result<PolicyConfig, D::Error> {
                match self.0 {
                    $($name => $module::Config::deserialize(keys).map(PolicyConfig::$variant),)+
                    _ => unreachable!("a type is made of a name of the table"),
                }
            }
        }
    };
}

policies! {
    /// Action Chunking with Transformers
    "act" => Act: act::Act,
    /// ACT with a recursive block that refines its actions
    "actrm" => Actrm: actrm::Actrm,
    /// Behaviour cloning with a multi-layer perceptron
    "bc" => Bc: bc::Bc,
    /// Behaviour cloning with an LSTM or gated recurrent units and a mixture of Gaussians
    "bc_rnn" => BcRnn: bc_rnn::BcRnn,
    /// Behaviour cloning with a causal transformer and a mixture of Gaussians
    "bc_transformer" => BcTransformer: bc_transformer::BcTransformer,
    /// Diffusion policy
    "diffusion" => Diffusion: diffusion::Diffusion,
    /// The task's scripted expert
    "expert" => Expert: expert::Expert,
    /// Flow matching
    "flow" => Flow: flow::Flow,
    /// MIP (minimal iterative policy): two steps of regression
    "mip" => Mip: mip::Mip,
    /// Nearest-neighbour lookup of the demonstrations' actions
    "nearest" => Nearest: nearest::Nearest,
    /// Random actions
    "random" => Random: random::Random,
    /// Open-loop replay of a held-out demonstration
    "replay" => Replay: replay::Replay,
    /// No action
    "zero" => Zero: zero::Zero,
}

impl PolicyConfig {
    /// Actions in a chunk that lie before its observation's frame, for models that give one to every observation they see.
    pub fn past_actions(&self, n_obs_steps: usize) -> usize {
        match self {
            Self::BcRnn(_) | Self::Diffusion(_) | Self::Flow(_) | Self::Mip(_) => n_obs_steps.saturating_sub(1),
            _ => 0,
        }
    }
}

impl PolicyConfig {
    /// Checks that a model can be built for data with so many observation steps, and with images if there are any, before the
    /// data is opened.
    ///
    /// # Errors
    /// What the model cannot read.
    pub fn check_data(&self, n_obs_steps: usize, images: bool) -> Result<()> {
        let refuse = |field: &'static str, found: String, expected: String| {
            Err(ModelError::Config { model: self.policy_type(), field, found, expected })
        };
        match self {
            Self::Act(_) | Self::Actrm(_) if images && n_obs_steps != 1 => {
                refuse("data.n_obs_steps", n_obs_steps.to_string(), "1 with data.cameras".to_string())
            }
            Self::BcRnn(bc_rnn::Config { action_horizon, .. }) if *action_horizon != n_obs_steps => {
                refuse("action_horizon", action_horizon.to_string(), format!("data.n_obs_steps, {n_obs_steps}"))
            }
            Self::Diffusion(diffusion::Config { transformer: Some(_), .. })
            | Self::Flow(flow::Config { transformer: Some(_), .. })
            | Self::Mip(mip::Config { transformer: Some(_), .. })
                if images =>
            {
                refuse("data.cameras", "given".to_string(), "none with a transformer, which sees no images".to_string())
            }
            _ => Ok(()),
        }
    }

    /// The configuration of a policy that thinks step by step; `None` of the others.
    pub fn reasoner(&self) -> Option<&actrm::Config> {
        match self {
            Self::Actrm(config) => Some(config),
            _ => None,
        }
    }

    /// What it asks of the entities, if it asks which one is meant.
    pub fn pointer(&self) -> Option<&PointerConfig> {
        match self {
            Self::Act(config) => config.pointer.as_ref(),
            Self::Actrm(config) => config.pointer.as_ref(),
            Self::Diffusion(diffusion::Config { transformer: Some(of), .. })
            | Self::Flow(flow::Config { transformer: Some(of), .. })
            | Self::Mip(mip::Config { transformer: Some(of), .. }) => of.pointer.as_ref(),
            _ => None,
        }
    }

    /// What training asks for that it does not see, if it asks.
    pub fn auxiliary(&self) -> Option<&AuxiliaryConfig> {
        match self {
            Self::Act(config) => config.auxiliary.as_ref(),
            Self::Actrm(config) => config.auxiliary.as_ref(),
            _ => None,
        }
    }

    /// The grid that it thinks over, if it does.
    pub fn grid(&self) -> Option<&GridConfig> {
        match self {
            Self::Actrm(config) => config.reasoning.grid.as_ref(),
            _ => None,
        }
    }

    /// The same policy thinking as `thinking` says.
    ///
    /// # Errors
    /// A thought that cannot be; a policy that does not think, unless nothing is asked of it.
    pub fn thinking(&self, thinking: &actrm::Thinking) -> Result<Self> {
        match self {
            Self::Actrm(config) => Ok(Self::Actrm(config.thinking(thinking)?)),
            other if *thinking == actrm::Thinking::default() => Ok(other.clone()),
            other => Err(ModelError::Config {
                model: other.policy_type(),
                field: "thinking",
                found: "steps, halting, starts or an intervention".to_string(),
                expected: "none: it does not think step by step".to_string(),
            }),
        }
    }
}

/// The type of a policy whose own keys are still to be read: with them, as a `DeserializeSeed`, it gives the
/// [`PolicyConfig`], and what is wrong with a key is said at that key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PolicyType(&'static str);

impl PolicyType {
    /// The type of this name, if there is one.
    pub fn named(name: &str) -> Option<Self> {
        PolicyConfig::TYPES.iter().find(|known| **known == name).map(|known| Self(known))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn every_type_reads_its_keys_with_and_without_its_name() {
        for name in PolicyConfig::TYPES {
            let tagged: PolicyConfig =
                serde_json::from_value(serde_json::json!({"type": name, "action_horizon": 7})).unwrap();
            let keys = serde_json::json!({"action_horizon": 7});
            let read = PolicyType::named(name).unwrap().deserialize(keys).unwrap();
            assert_eq!(read, tagged);
            assert_eq!((read.policy_type(), read.action_horizon()), (*name, 7));
            assert_eq!(serde_json::to_value(&read).unwrap()["type"], *name);
        }
        assert_eq!(PolicyType::named("atc"), None);
    }
}
