//! ACT and BC as ONNX models: weights and normalisation inside, observations and actions in the units of the data.

mod graph;

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::Tensor;
use models::layers::Activation;
use models::{FeatureKind, NormMode, PolicyConfig, Signature, act, bc};

use graph::{Attribute, Extent, Graph};
use zoo::entry::LoadedEntry;
use zoo::{ZooError, write_atomic};

/// Writes the policy of an entry to the new file `out`: an input for each feature, (batch, width) in the units of the data, and
/// the output `action`, (batch, horizon, width), in those of the environment.
///
/// # Errors
/// A policy other than ACT and BC, images, a history of observations, or a part of ACT that LeRobot's has not; a file that is
/// there or cannot be written.
pub fn export(entry: &LoadedEntry, out: &Path) -> Result<(), ZooError> {
    if out.exists() {
        let reason = "it exists already; choose another path or remove it first".to_owned();
        return Err(ZooError::NotPossible { what: out.display().to_string(), reason });
    }
    Ok(write_atomic(out, &model(entry)?)?)
}

fn model(entry: &LoadedEntry) -> Result<Vec<u8>, ZooError> {
    let (id, experiment) = (entry.entry().id(), entry.experiment());
    let signature = entry.preprocess().signature();
    let refuse = |found: String| {
        let reason = format!("ONNX export takes ACT and BC of one observation without images, found {found}");
        Err(ZooError::NotPossible { what: format!("entry {id}"), reason })
    };
    if signature.n_obs_steps != 1 {
        return refuse(format!("{} observations", signature.n_obs_steps));
    }
    if let Some(image) = signature.of_kind(FeatureKind::Image).next() {
        return refuse(image.name.clone());
    }
    let failed = |source| entry.failed("export", source);
    let numbers = |tensors: BTreeMap<String, Tensor>| -> Result<BTreeMap<String, Numbers>, ZooError> {
        let read = |tensor: &Tensor| -> candle_core::Result<Numbers> {
            Ok((tensor.dims().to_vec(), tensor.flatten_all()?.to_vec1::<f32>()?))
        };
        let all = tensors.iter().map(|(name, tensor)| Ok((name.clone(), read(tensor)?)));
        all.collect::<candle_core::Result<_>>().map_err(|error| failed(error.into()))
    };
    let mut network = Network {
        graph: Graph::default(),
        weights: numbers(entry.model().params().tensors())?,
        statistics: numbers(entry.preprocess().normaliser().tensors().map_err(failed)?)?,
        modes: experiment.normalisation.modes(signature),
    };
    let predicted = match &experiment.policy {
        PolicyConfig::Act(config) => {
            if config.pointer.is_some() || config.pre_norm || config.feedforward_activation != Activation::Relu {
                return refuse("ACT with a pointer, pre_norm or another activation than ReLU".to_owned());
            }
            network.act(config, signature)
        }
        PolicyConfig::Bc(config) => network.bc(config, signature),
        other => return refuse(other.policy_type().to_owned()),
    };
    network.unnormalised(&predicted, models::ACTION, "action");
    let horizon = experiment.policy.action_horizon();
    let shape = [Extent::Named("batch"), Extent::Fixed(horizon), Extent::Fixed(signature.action_dim)];
    network.graph.output("action", &shape);
    let mut about = vec![("entry".to_owned(), id.to_string())];
    about.extend(entry.conventions().iter().map(|(name, said)| (name.to_owned(), said.to_owned())));
    Ok(network.graph.into_model(&id.to_string(), &about))
}

/// A tensor: its shape and its values.
type Numbers = (Vec<usize>, Vec<f32>);

/// A network that becomes a graph.
struct Network {
    graph: Graph,
    weights: BTreeMap<String, Numbers>,
    statistics: BTreeMap<String, Numbers>,
    modes: BTreeMap<String, NormMode>,
}

impl Network {
    /// A weight as a constant.
    fn weight(&mut self, name: &str) -> String {
        let (dims, values) = self.weights[name].clone();
        self.graph.floats(name, &dims, &values)
    }

    fn binary(&mut self, operator: &str, one: &str, two: &str) -> String {
        self.graph.node(operator, &[one, two], &[])
    }

    /// x W^T + b; `name` is the prefix of weight and bias.
    fn linear(&mut self, x: &str, name: &str) -> String {
        let (weight, bias) = (self.weights[&format!("{name}.weight")].clone(), format!("{name}.bias"));
        let rows = weight.0[0];
        let bias = self.weights[&bias].1.clone();
        self.dense(x, name, (&weight.1, &bias), rows)
    }

    /// The same of a matrix with so many rows.
    fn dense(&mut self, x: &str, name: &str, (weight, bias): (&[f32], &[f32]), rows: usize) -> String {
        let columns = weight.len() / rows;
        let turned: Vec<f32> = (0..weight.len()).map(|at| weight[at % rows * columns + at / rows]).collect();
        let matrix = self.graph.floats(&format!("{name}.weight_transposed"), &[columns, rows], &turned);
        let bias = self.graph.floats(&format!("{name}.bias"), &[rows], bias);
        let product = self.binary("MatMul", x, &matrix);
        self.binary("Add", &product, &bias)
    }

    fn norm(&mut self, x: &str, name: &str) -> String {
        let (scale, bias) = (self.weight(&format!("{name}.weight")), self.weight(&format!("{name}.bias")));
        self.graph.node(
            "LayerNormalization",
            &[x, &scale, &bias],
            &[Attribute::Int("axis", -1), Attribute::Float("epsilon", 1e-5)],
        )
    }

    /// A feature's input in network units, (batch, width).
    fn feature(&mut self, name: &str, width: usize) -> String {
        self.graph.input(name, &[Extent::Named("batch"), Extent::Fixed(width)]);
        let Some((a, b, mode)) = self.statistics_of(name) else { return name.to_owned() };
        let centred = self.binary("Sub", name, &a);
        match mode {
            NormMode::MinMax => {
                let (two, one) = (self.scalar(name, "two", 2.0), self.scalar(name, "one", 1.0));
                let doubled = self.binary("Mul", &centred, &two);
                let scaled = self.binary("Div", &doubled, &b);
                self.binary("Sub", &scaled, &one)
            }
            NormMode::MeanStd | NormMode::Identity => self.binary("Div", &centred, &b),
        }
    }

    /// The value `x` in the units of the feature, under the name `out`.
    fn unnormalised(&mut self, x: &str, feature: &str, out: &str) {
        let Some((a, b, mode)) = self.statistics_of(feature) else {
            self.graph.named("Identity", &[x], &[], out);
            return;
        };
        let scaled = match mode {
            NormMode::MinMax => {
                let (two, one) = (self.scalar(feature, "two", 2.0), self.scalar(feature, "one", 1.0));
                let moved = self.binary("Add", x, &one);
                let half = self.binary("Div", &moved, &two);
                self.binary("Mul", &half, &b)
            }
            NormMode::MeanStd | NormMode::Identity => self.binary("Mul", x, &b),
        };
        self.graph.named("Add", &[&scaled, &a], &[], out);
    }

    fn scalar(&mut self, feature: &str, name: &str, value: f32) -> String {
        self.graph.floats(&format!("{feature}.{name}"), &[1], &[value])
    }

    /// What is subtracted of a feature and what it is divided by, as constants; nothing where it is taken as it is.
    fn statistics_of(&mut self, feature: &str) -> Option<(String, String, NormMode)> {
        /// What keeps spreads from zero, as [`models::Normaliser`] does.
        const EPS: f32 = 1e-8;
        let mode = self.modes.get(feature).copied().unwrap_or(NormMode::Identity);
        let get = |name: &str| self.statistics[&format!("{feature}.{name}")].1.clone();
        let is_action = feature == models::ACTION;
        let (centre, spread) = match mode {
            NormMode::Identity => return None,
            // only on the way in
            NormMode::MeanStd => {
                (get("mean"), get("std").iter().map(|std| if is_action { *std } else { std + EPS }).collect())
            }
            NormMode::MinMax => {
                let (low, high) = (get("min"), get("max"));
                let spread = low.iter().zip(&high).map(|(low, high)| if low == high { EPS } else { high - low });
                let spread: Vec<f32> = spread.collect();
                (low, spread)
            }
        };
        let centre = self.graph.floats(&format!("{feature}.centre"), &[centre.len()], &centre);
        let spread = self.graph.floats(&format!("{feature}.spread"), &[spread.len()], &spread);
        Some((centre, spread, mode))
    }

    /// (batch, width) each -> (batch, H, A)
    fn bc(&mut self, config: &bc::Config, signature: &Signature) -> String {
        let features: Vec<String> =
            signature.observation.iter().map(|spec| self.feature(&spec.name, spec.width())).collect();
        let features: Vec<&str> = features.iter().map(String::as_str).collect();
        let mut x = self.graph.node("Concat", &features, &[Attribute::Int("axis", 1)]);
        for layer in 0..config.hidden.len() {
            let hidden = self.linear(&x, &format!("hidden.{layer}"));
            x = self.graph.node("Relu", &[&hidden], &[]);
        }
        let flat = self.linear(&x, "action_head");
        self.reshaped(&flat, &[0, config.action_horizon as i64, signature.action_dim as i64])
    }

    fn reshaped(&mut self, x: &str, shape: &[i64]) -> String {
        let shape = self.graph.ints(shape);
        self.graph.node("Reshape", &[x, &shape], &[])
    }

    /// (batch, width) each -> (batch, C, A)
    fn act(&mut self, config: &act::Config, signature: &Signature) -> String {
        let dim = config.dim_model;
        let mut specs: Vec<_> = signature.observation.iter().collect();
        specs.sort_by_key(|spec| spec.kind);
        let (of_features, of_entities) = ("encoder_1d_feature_pos_embed.weight", "encoder_entity_pos_embed.weight");
        let row = |all: &Numbers, at: usize| all.1[at * dim..(at + 1) * dim].to_vec();
        let (mut features, mut entities) = (1, 0);
        let mut positions = row(&self.weights[of_features], 0);
        let mut tokens = Vec::new();
        for spec in specs {
            let prefix = match spec.kind {
                FeatureKind::State => "encoder_robot_state_input_proj".to_owned(),
                FeatureKind::EnvironmentState => "encoder_env_state_input_proj".to_owned(),
                FeatureKind::Entity | FeatureKind::Image => format!("encoder_entity_input_proj.{}", spec.group()),
            };
            positions.extend(match (spec.kind, spec.position) {
                (FeatureKind::State | FeatureKind::EnvironmentState, _) => {
                    features += 1;
                    row(&self.weights[of_features], features - 1)
                }
                (_, true) => {
                    entities += 1;
                    row(&self.weights[of_entities], entities - 1)
                }
                (_, false) => vec![0.0; dim],
            });
            let x = self.feature(&spec.name, spec.width());
            let of = |part: &str| self.weights[&format!("{prefix}.{part}")].1.clone();
            let (weight, bias) = (of("weight"), of("bias"));
            // entities of a group share their weights, and constants have a name each
            let token = self.dense(&x, &format!("{prefix}#{}", spec.name), (&weight, &bias), dim);
            let axes = self.graph.ints(&[1]);
            tokens.push(self.graph.node("Unsqueeze", &[&token, &axes], &[]));
        }
        // at latent zero its token is the bias, once for each of the batch
        let first = signature.observation[0].name.clone();
        let batch = self.graph.node("Shape", &[&first], &[Attribute::Int("start", 0), Attribute::Int("end", 1)]);
        let rest = self.graph.ints(&[1, dim as i64]);
        let shape = self.graph.node("Concat", &[&batch, &rest], &[Attribute::Int("axis", 0)]);
        let latent = self.weights["encoder_latent_input_proj.bias"].1.clone();
        let latent = self.graph.floats("latent_token", &[1, 1, dim], &latent);
        let latent = self.graph.node("Expand", &[&latent, &shape], &[]);
        let all: Vec<&str> = std::iter::once(latent.as_str()).chain(tokens.iter().map(String::as_str)).collect();
        let mut x = self.graph.node("Concat", &all, &[Attribute::Int("axis", 1)]);
        let pos = self.graph.floats("encoder_positions", &[positions.len() / dim, dim], &positions);
        for layer in 0..config.n_encoder_layers {
            let name = format!("encoder.layers.{layer}");
            let placed = self.binary("Add", &x, &pos);
            let seen = self.attention(&placed, &placed, &x, &format!("{name}.self_attn"), config);
            x = self.added(&x, &seen, &format!("{name}.norm1"));
            x = self.feed_forward(&x, &name, "norm2");
        }
        let memory = x;
        let placed_memory = self.binary("Add", &memory, &pos);
        let queries = self.weight("decoder_pos_embed.weight");
        let zeros = vec![0.0; config.action_horizon * dim];
        let mut x = self.graph.floats("decoder_input", &[1, config.action_horizon, dim], &zeros);
        for layer in 0..config.n_decoder_layers {
            let name = format!("decoder.layers.{layer}");
            let placed = self.binary("Add", &x, &queries);
            let seen = self.attention(&placed, &placed, &x, &format!("{name}.self_attn"), config);
            x = self.added(&x, &seen, &format!("{name}.norm1"));
            let placed = self.binary("Add", &x, &queries);
            let seen = self.attention(&placed, &placed_memory, &memory, &format!("{name}.multihead_attn"), config);
            x = self.added(&x, &seen, &format!("{name}.norm2"));
            x = self.feed_forward(&x, &name, "norm3");
        }
        let x = self.norm(&x, "decoder.norm");
        self.linear(&x, "action_head")
    }

    /// norm(x + y)
    fn added(&mut self, x: &str, y: &str, norm: &str) -> String {
        let sum = self.binary("Add", x, y);
        self.norm(&sum, norm)
    }

    fn feed_forward(&mut self, x: &str, layer: &str, norm: &str) -> String {
        let hidden = self.linear(x, &format!("{layer}.linear1"));
        let hidden = self.graph.node("Relu", &[&hidden], &[]);
        let out = self.linear(&hidden, &format!("{layer}.linear2"));
        self.added(x, &out, &format!("{layer}.{norm}"))
    }

    /// torch's multi-head attention; batches of one are those of the others
    fn attention(&mut self, query: &str, key: &str, value: &str, name: &str, config: &act::Config) -> String {
        let (dim, heads) = (config.dim_model, config.n_heads);
        let weight = self.weights[&format!("{name}.in_proj_weight")].1.clone();
        let bias = self.weights[&format!("{name}.in_proj_bias")].1.clone();
        let mut parts = Vec::new();
        for (part, (x, word)) in [(query, "query"), (key, "key"), (value, "value")].into_iter().enumerate() {
            let weight = &weight[part * dim * dim..(part + 1) * dim * dim];
            let projected =
                self.dense(x, &format!("{name}.{word}"), (weight, &bias[part * dim..(part + 1) * dim]), dim);
            let split = self.reshaped(&projected, &[0, 0, heads as i64, (dim / heads) as i64]);
            // keys are turned for their product with queries
            let order = if word == "key" { vec![0, 2, 3, 1] } else { vec![0, 2, 1, 3] };
            parts.push(self.graph.node("Transpose", &[&split], &[Attribute::Ints("perm", order)]));
        }
        let scores = self.binary("MatMul", &parts[0], &parts[1]);
        let scale = self.graph.floats(&format!("{name}.scale"), &[1], &[((dim / heads) as f32).sqrt().recip()]);
        let scores = self.binary("Mul", &scores, &scale);
        let shares = self.graph.node("Softmax", &[&scores], &[Attribute::Int("axis", -1)]);
        let seen = self.binary("MatMul", &shares, &parts[2]);
        let seen = self.graph.node("Transpose", &[&seen], &[Attribute::Ints("perm", vec![0, 2, 1, 3])]);
        let joined = self.reshaped(&seen, &[0, 0, dim as i64]);
        self.linear(&joined, &format!("{name}.out_proj"))
    }
}
