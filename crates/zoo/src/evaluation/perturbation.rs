//! Pictures changed on their way to a policy: how much of what it can do hangs on what it sees, and where.

use std::fmt;
use std::str::FromStr;

use models::{FeatureKind, Observation, Signature, Values};

use crate::experiment::IMAGE_PREFIX;

/// What becomes of a policy's pictures in an evaluation.
#[derive(Debug, Clone, PartialEq)]
pub enum Perturbation {
    /// The first two cameras are taken for each other.
    SwapCameras,
    /// This camera shows nothing: black pictures.
    Black(String),
    /// Colours are turned by this part of the colour circle.
    Hue(f32),
    /// Everything is so many times as bright.
    Light(f32),
}

/// `hue` without a number.
const HUE: f32 = 0.1;
/// `light` without a number.
const LIGHT: f32 = 0.6;

impl fmt::Display for Perturbation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::SwapCameras => f.write_str("swap-cameras"),
            Self::Black(camera) => write!(f, "black-{camera}"),
            Self::Hue(turn) => write!(f, "hue={turn}"),
            Self::Light(factor) => write!(f, "light={factor}"),
        }
    }
}

impl FromStr for Perturbation {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = |rest: &str, usual: f32| match rest.strip_prefix('=') {
            None if rest.is_empty() => Some(usual),
            None => None,
            Some(number) => number.parse().ok().filter(|x: &f32| x.is_finite()),
        };
        let hue = || Some(Self::Hue(number(text.strip_prefix("hue")?, HUE)?));
        let light = || Some(Self::Light(number(text.strip_prefix("light")?, LIGHT).filter(|x| *x >= 0.0)?));
        let black = || text.strip_prefix("black-").filter(|name| !name.is_empty()).map(|name| Self::Black(name.into()));
        let swap = (text == "swap-cameras").then_some(Self::SwapCameras);
        swap.or_else(black).or_else(hue).or_else(light).ok_or_else(|| {
            format!("perturbation {text:?}: expected swap-cameras, black-CAMERA, hue, hue=TURN, light or light=FACTOR")
        })
    }
}

impl Perturbation {
    /// Checks that a policy with this signature has what is to be changed.
    ///
    /// # Errors
    /// In words: what was expected of its cameras.
    pub fn check(&self, signature: &Signature) -> Result<(), String> {
        let cameras: Vec<_> = signature.of_kind(FeatureKind::Image).collect();
        let names: Vec<&str> = cameras.iter().map(|spec| short(&spec.name)).collect();
        let found = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
        match self {
            Self::SwapCameras => match cameras.as_slice() {
                [one, other, ..] if one.shape == other.shape => Ok(()),
                _ => Err(format!("two cameras of one size, found {found}")),
            },
            Self::Black(camera) if !names.contains(&camera.as_str()) => Err(format!("camera {camera}, found {found}")),
            _ if cameras.is_empty() => Err("a camera, found none".to_owned()),
            _ => Ok(()),
        }
    }

    /// Changes the pictures of a step.
    pub fn apply(&self, signature: &Signature, seen: &mut Observation) {
        let mut cameras = signature.of_kind(FeatureKind::Image).map(|spec| spec.name.as_str());
        match self {
            Self::SwapCameras => {
                if let (Some(one), Some(other)) = (cameras.next(), cameras.next())
                    && let (Some(a), Some(b)) = (seen.get(one).cloned(), seen.get(other).cloned())
                {
                    seen.insert(one, b);
                    seen.insert(other, a);
                }
            }
            Self::Black(camera) => {
                let chosen = cameras.find(|name| short(name) == camera);
                if let Some(Values::U8(bytes)) = chosen.and_then(|name| seen.get_mut(name)) {
                    bytes.fill(0);
                }
            }
            Self::Hue(turn) => cameras.for_each(|name| pixels(seen, name, |rgb| turned(rgb, *turn))),
            Self::Light(factor) => {
                cameras.for_each(|name| pixels(seen, name, |rgb| rgb.map(|x| rounded(f32::from(x) * factor))));
            }
        }
    }
}

/// A camera's feature by the simulator's name of the camera.
fn short(feature: &str) -> &str {
    feature.strip_prefix(IMAGE_PREFIX).unwrap_or(feature)
}

fn pixels(seen: &mut Observation, camera: &str, change: impl Fn([u8; 3]) -> [u8; 3]) {
    let Some(Values::U8(bytes)) = seen.get_mut(camera) else { return };
    for pixel in bytes.chunks_exact_mut(3) {
        pixel.copy_from_slice(&change([pixel[0], pixel[1], pixel[2]]));
    }
}

fn rounded(x: f32) -> u8 {
    // saturates
    x.round() as u8
}

/// A colour whose hue is turned by a part of the circle; lightness and saturation (of HSV) stay.
fn turned(rgb: [u8; 3], turn: f32) -> [u8; 3] {
    let [r, g, b] = rgb.map(f32::from);
    let (most, least) = (r.max(g).max(b), r.min(g).min(b));
    let range = most - least;
    if range == 0.0 {
        return rgb;
    }
    let sixth = match most {
        m if m == r => (g - b) / range,
        m if m == g => (b - r) / range + 2.0,
        _ => (r - g) / range + 4.0,
    };
    // the circle is round: of many turns the last part counts
    let sixth = (sixth + 6.0 * turn.fract()).rem_euclid(6.0);
    [5.0, 3.0, 1.0].map(|n| {
        let k = (n + sixth) % 6.0;
        rounded(most - range * k.min(4.0 - k).clamp(0.0, 1.0))
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use models::FeatureSpec;

    fn signature(cameras: &[(&str, usize)]) -> Signature {
        let pictures =
            cameras.iter().map(|(name, side)| FeatureSpec::image(&format!("{IMAGE_PREFIX}{name}"), *side, *side));
        let observation = std::iter::once(FeatureSpec::state(2)).chain(pictures).collect();
        Signature { observation, action_dim: 1, ..Signature::default() }
    }

    fn seen() -> Observation {
        let mut seen = Observation::of_state(vec![0.0; 2], vec![]);
        seen.insert("observation.images.a", Values::U8(vec![200, 100, 0]));
        seen.insert("observation.images.b", Values::U8(vec![10, 10, 10]));
        seen
    }

    fn bytes(text: &str) -> (Vec<u8>, Vec<u8>) {
        let mut seen = seen();
        let perturbation: Perturbation = text.parse().unwrap();
        assert_eq!(perturbation.to_string().parse(), Ok(perturbation.clone()));
        perturbation.apply(&signature(&[("a", 1), ("b", 1)]), &mut seen);
        let of = |name: &str| match seen.get(name) {
            Some(Values::U8(bytes)) => bytes.clone(),
            other => panic!("{other:?}"),
        };
        (of("observation.images.a"), of("observation.images.b"))
    }

    #[test]
    fn pictures_are_changed_as_it_says() {
        assert_eq!(bytes("swap-cameras"), (vec![10, 10, 10], vec![200, 100, 0]));
        assert_eq!(bytes("black-a"), (vec![0, 0, 0], vec![10, 10, 10]));
        assert_eq!(bytes("light=1.5"), (vec![255, 150, 0], vec![15, 15, 15]));
        // orange by a third of the circle, and grey has no hue
        assert_eq!(bytes("hue=0.33333334"), (vec![0, 200, 100], vec![10, 10, 10]));
        assert_eq!(bytes("hue=1"), (vec![200, 100, 0], vec![10, 10, 10]));
        assert_eq!("hue".parse(), Ok(Perturbation::Hue(HUE)));
    }

    #[test]
    fn words_and_cameras_that_do_not_fit_are_named() {
        for wrong in ["", "black-", "hue=", "hue=x", "light=-1", "huee", "swap"] {
            let error = wrong.parse::<Perturbation>().unwrap_err();
            assert!(error.contains("swap-cameras, black-CAMERA"), "{error}");
        }
        let check =
            |text: &str, cameras: &[(&str, usize)]| text.parse::<Perturbation>().unwrap().check(&signature(cameras));
        check("swap-cameras", &[("a", 1), ("b", 1)]).unwrap();
        assert_eq!(check("swap-cameras", &[("a", 1), ("b", 2)]).unwrap_err(), "two cameras of one size, found a, b");
        assert_eq!(check("black-c", &[("a", 1)]).unwrap_err(), "camera c, found a");
        assert_eq!(check("hue", &[]).unwrap_err(), "a camera, found none");
    }
}
