//! What policies are tried on, on the CPU by the tests and on a GPU by its check: small configurations, and random batches.

use crate::batch::{Batch, Taken};
use crate::encoders::VisionConfig;
use crate::features::{FeatureKind, FeatureSpec, Features, Signature, Values};
use crate::registry::PolicyConfig;
use candle_core::{Device, Tensor};
use nn::Rng;
use serde_json::json;

/// Random windows, some of them padded.
pub fn batch(signature: &Signature, horizon: usize, rows: usize, seed: u64) -> Batch {
    let mut rng = Rng::new(seed, "batch");
    let mut observation = Features::new();
    for spec in &signature.observation {
        let n = rows * signature.n_obs_steps * spec.width();
        let values = match spec.kind {
            FeatureKind::Image => Values::U8((0..n).map(|_| rng.below(256) as u8).collect()),
            _ => Values::F32(rng.normals(n)),
        };
        observation.insert(&spec.name, values);
    }
    let a = rng.normals(rows * horizon * signature.action_dim);
    let pad: Vec<bool> = (0..rows * horizon).map(|i| i / horizon % 2 == 1 && i % horizon > horizon / 2).collect();
    let mut batch = Batch::new(signature, horizon, observation, &Features::new(), a, &pad, &candle_core::Device::Cpu)
        .expect("random numbers fit");
    batch.seed = seed;
    // of a pointer: of every third row it is not asked
    let cubes = signature.observation.iter().enumerate().filter(|(_, spec)| spec.group() == "cube");
    let cubes: Vec<u32> = cubes.map(|(at, _)| at as u32).collect();
    let taken = (0..rows).map(|row| cubes.get(row % cubes.len().max(1)).copied().filter(|_| row % 3 != 2));
    batch.taken = Some(Taken::new(taken.collect()));
    let cells = signature.observation.iter().filter(|spec| spec.group() == "cell").count();
    let visited = (0..rows * cells).map(|_| rng.below(2) as f32).collect();
    batch.visited =
        (cells > 0).then(|| Tensor::from_vec(visited, (rows, cells), &Device::Cpu).expect("random numbers fit"));
    let shape = (rows, signature.auxiliary_dim);
    let values = rng.normals(shape.0 * shape.1);
    batch.auxiliary = (shape.1 > 0).then(|| Tensor::from_vec(values, shape, &Device::Cpu).expect("random numbers fit"));
    batch
}

/// What models are tried on: with and without an environment state, with a history, with entities in two groups, of which
/// one has positions, with a grid of cells and a thing beside it, with images of three cameras, and with a history of two images.
#[derive(Debug)]
pub struct Signatures {
    /// numbers alone
    pub plain: Signature,
    /// without an environment state
    pub no_env: Signature,
    /// things in two groups
    pub entities: Signature,
    /// cells of a grid
    pub grid: Signature,
    /// three observations at once
    pub history: Signature,
    /// three cameras
    pub images: Signature,
    /// two images at once
    pub image_history: Signature,
    /// `plain`, with three numbers of auxiliary supervision
    pub with_auxiliary: Signature,
}

/// Eyes for the images: parts at random, colours changed, tokens of all maps.
pub fn vision_config() -> VisionConfig {
    VisionConfig { width: 8, crop: Some(33), shift: 1, jitter: 0.2, ..VisionConfig::default() }
}

/// All of them.
pub fn signatures() -> Signatures {
    let (plain, no_env) = (Signature::low_dimensional(3, 2, 2), Signature::low_dimensional(3, 0, 2));
    let cube = |name: &str| FeatureSpec::entity(name, 5, "cube", false);
    let goal = |name: &str| FeatureSpec::entity(name, 2, "goal", true);
    let mut entities = no_env.clone();
    entities.observation.extend([cube("cube0"), cube("cube1"), cube("cube2"), goal("goal0"), goal("goal1")]);
    let mut grid = no_env.clone();
    grid.observation.extend((0..6).map(|i| FeatureSpec::entity(&format!("cell{i}"), 2, "cell", i == 4)));
    grid.observation.push(FeatureSpec::entity("peg", 3, "peg", false));
    let mut history = Signature { n_obs_steps: 3, ..plain.clone() };
    history.observation.extend([cube("cube0"), cube("cube1")]);
    let mut images = plain.clone();
    images.observation.extend(["a", "b"].map(|name| FeatureSpec::image(name, 40, 36)));
    images.observation.push(FeatureSpec::image("c", 34, 34));
    images.observation.push(cube("cube0"));
    let mut image_history = Signature { n_obs_steps: 2, ..no_env.clone() };
    image_history.observation.push(FeatureSpec::image("a", 36, 40));
    let with_auxiliary = Signature { auxiliary_dim: 3, ..plain.clone() };
    Signatures { plain, no_env, entities, grid, history, images, image_history, with_auxiliary }
}

/// Every kind of policy, small, with what it sees.
pub fn policies() -> Vec<(PolicyConfig, Signature)> {
    let of = signatures();
    let act = json!({"action_horizon": 5, "dim_model": 12, "n_heads": 3, "dim_feedforward": 19, "latent_dim": 3});
    let with = |base: &serde_json::Value, key: &str, value: serde_json::Value| {
        let mut config = base.clone();
        config[key] = value;
        config
    };
    let actrm = |reasoning| with(&act, "reasoning", reasoning);
    let pointing = with(&actrm(json!({"over": "tokens"})), "pointer", json!({"among": "cube", "weight": 0.7}));
    let grid = json!({"over": "tokens", "grid": {"among": "cell", "columns": 3, "way": 0.5}});
    let memory = json!({"over": "memory", "n_layers": 1, "h_cycles": 2, "l_cycles": 2, "supervision_steps": 2});
    let bc = json!({"action_horizon": 3, "hidden": [11, 7]});
    let rnn = |cell| json!({"action_horizon": 3, "hidden_dim": 9, "n_modes": 2, "min_std": 0.05, "cell": cell});
    let transformer = json!({"dim_model": 12, "n_heads": 2, "n_layers": 2, "n_modes": 2, "min_std": 0.05});
    let unet = json!({"down_dims": [8, 16], "n_groups": 4, "step_embed_dim": 8});
    let denoising = json!({"action_horizon": 4, "network": unet});
    let clean = with(&denoising, "prediction", json!("sample"));
    let tokens = json!({"dim_model": 12, "n_heads": 3, "n_layers": 1, "dropout": 0.1});
    let encoded = with(&tokens, "n_encoder_layers", json!(2));
    let encoded = with(&encoded, "pointer", json!({"among": "cube", "weight": 0.7}));
    let vision = json!({"width": 8, "blocks": [1, 0, 0, 0], "crop": 17, "shift": 1, "jitter": 0.2, "cell_features": 4});
    let frozen = with(&vision, "norm", json!("frozen"));
    let keypoints = with(&vision, "tokens", json!({"keypoints": {"count": 3}}));
    let all = [
        ("act", act.clone(), &of.plain),
        ("act", with(&act, "vision", vision.clone()), &of.images),
        ("act", with(&act, "auxiliary", json!({"weight": 0.5})), &of.with_auxiliary),
        ("actrm", actrm(json!({"h_cycles": 2, "l_cycles": 2})), &of.entities),
        ("actrm", actrm(json!({"warm_start": {"noise": 0.1}})), &of.plain),
        ("actrm", pointing, &of.entities),
        ("actrm", actrm(grid), &of.grid),
        ("actrm", actrm(memory), &of.plain),
        ("bc", bc.clone(), &of.plain),
        ("bc", with(&bc, "vision", frozen), &of.image_history),
        ("bc_rnn", rnn("lstm"), &of.history),
        ("bc_rnn", rnn("gru"), &of.history),
        ("bc_transformer", transformer, &of.history),
        ("diffusion", denoising.clone(), &of.history),
        ("diffusion", with(&clean, "vision", keypoints), &of.image_history),
        ("diffusion", with(&denoising, "transformer", tokens), &of.entities),
        ("flow", denoising.clone(), &of.plain),
        ("flow", with(&denoising, "vision", vision.clone()), &of.image_history),
        ("flow", with(&denoising, "transformer", encoded.clone()), &of.entities),
        ("mip", with(&denoising, "vision", vision), &of.image_history),
        ("mip", with(&denoising, "transformer", encoded), &of.entities),
        ("mip", denoising, &of.history),
    ];
    let configured = all.into_iter().map(|(kind, mut policy, signature)| {
        policy["type"] = kind.into();
        (serde_json::from_value(policy).expect("these are options of that policy"), signature.clone())
    });
    configured.collect()
}
