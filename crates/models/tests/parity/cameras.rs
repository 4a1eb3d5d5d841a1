//! Which camera saw something: map tokens of all cameras share their positions, as LeRobot's do, so that a policy is the same
//! whichever camera is called what. Keypoints, a token a camera, have a place each.
#![allow(clippy::unwrap_used)]

use candle_core::Tensor;
use models::encoders::{ImageNorm, TokenKind, VisionConfig};
use models::{
    Backend, FeatureSpec, Features, NormMode, Normaliser, PolicyConfig, Preprocess, Rng, Signature, ValuesRef, act,
    actrm,
};

const CAMERAS: [&str; 2] = ["observation.images.agentview", "observation.images.robot0_eye_in_hand"];
const SIDE: usize = 84;

fn signature() -> Signature {
    let images = CAMERAS.map(|name| FeatureSpec::image(name, SIDE, SIDE));
    let observation = std::iter::once(FeatureSpec::state(9)).chain(images).collect();
    Signature { observation, action_dim: 7, ..Signature::default() }
}

/// One observation, with its images in this order.
fn observation(horizon: usize, images: [&[u8]; 2]) -> Features<Tensor> {
    let modes = [("observation.state", NormMode::Identity), ("action", NormMode::Identity)];
    let modes = modes.map(|(name, mode)| (name.to_string(), mode)).into();
    let preprocess =
        Preprocess::new(signature(), Normaliser::new(&modes, &Default::default()).unwrap(), &candle_core::Device::Cpu)
            .unwrap();
    let state = Rng::new(1, "state").normals(9);
    let mut seen = Features::new();
    seen.insert("observation.state", ValuesRef::F32(&state));
    for (name, bytes) in CAMERAS.iter().zip(images) {
        seen.insert(name, ValuesRef::U8(bytes));
    }
    preprocess.batch(horizon, &seen, &vec![0.0; horizon * 7], &vec![false; horizon]).unwrap().observation
}

/// How far apart actions are when both cameras are taken for each other, of the largest action.
fn difference(config: &PolicyConfig) -> f32 {
    let model = config.build(&signature(), 3, &Backend::CPU).unwrap();
    let mut rng = Rng::new(2, "pictures");
    let [one, other] = [(); 2].map(|()| (0..SIDE * SIDE * 3).map(|_| rng.below(256) as u8).collect::<Vec<u8>>());
    let [usual, swapped] = [[&one[..], &other[..]], [&other[..], &one[..]]].map(|images| {
        let actions = model.predict(&observation(model.action_horizon(), images)).unwrap();
        actions.flatten_all().unwrap().to_vec1::<f32>().unwrap()
    });
    let scale = usual.iter().fold(1e-3f32, |m, x| m.max(x.abs()));
    usual.iter().zip(&swapped).fold(0f32, |m, (a, b)| m.max((a - b).abs())) / scale
}

fn policies(tokens: TokenKind) -> [PolicyConfig; 2] {
    let vision = VisionConfig { width: 16, norm: ImageNorm::Group, tokens, ..VisionConfig::default() };
    let act = act::Config { dim_model: 32, vision: Some(vision.clone()), ..Default::default() };
    let actrm = actrm::Config { dim_model: 32, vision: Some(vision), ..Default::default() };
    [PolicyConfig::Act(act), PolicyConfig::Actrm(actrm)]
}

#[test]
fn map_tokens_do_not_say_which_camera_saw_them() {
    for config in policies(TokenKind::Map) {
        let off = difference(&config);
        assert!(off <= 1e-5, "{config:?}: {off} of the largest action");
    }
}

#[test]
fn keypoints_do() {
    for config in policies(TokenKind::Keypoints { count: 8 }) {
        let off = difference(&config);
        assert!(off > 1e-3, "{config:?}: {off} of the largest action");
    }
}
