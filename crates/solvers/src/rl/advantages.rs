//! How much better each action turned out than expected.

use super::{Algorithm, Episode, RlConfig};

/// Per step of an episode: the advantage, and the return that the value head should have predicted.
pub(super) fn advantages(episode: &Episode, config: &RlConfig) -> (Vec<f32>, Vec<f32>) {
    let rewards: Vec<f64> = episode.rewards.iter().map(|&r| f64::from(r) * config.reward_scale).collect();
    match config.algorithm {
        Algorithm::Reinforce => {
            let returns = discounted(&rewards, f64::from(episode.last_value), config.gamma);
            (returns.clone(), returns)
        }
        Algorithm::A2c | Algorithm::Ppo { .. } => {
            let advantages =
                generalised(&rewards, &episode.values, episode.last_value, config.gamma, config.gae_lambda);
            let returns = advantages.iter().zip(&episode.values).map(|(a, v)| a + v).collect();
            (advantages, returns)
        }
    }
}

/// `G_t = r_t + gamma G_{t+1}`, after the last step `last`.
fn discounted(rewards: &[f64], last: f64, gamma: f64) -> Vec<f32> {
    let mut returns = vec![0.0; rewards.len()];
    let mut after = last;
    for (to, &reward) in returns.iter_mut().zip(rewards).rev() {
        after = reward + gamma * after;
        *to = after as f32;
    }
    returns
}

/// `A_t = d_t + gamma lambda A_{t+1}` with `d_t = r_t + gamma V_{t+1} - V_t`.
fn generalised(rewards: &[f64], values: &[f32], last: f32, gamma: f64, lambda: f64) -> Vec<f32> {
    let mut advantages = vec![0.0; rewards.len()];
    let (mut after, mut next) = (0.0, f64::from(last));
    for ((to, &reward), &value) in advantages.iter_mut().zip(rewards).zip(values).rev() {
        let value = f64::from(value);
        after = reward + gamma * next - value + gamma * lambda * after;
        *to = after as f32;
        next = value;
    }
    advantages
}

/// Takes the mean from all and divides by the standard deviation, or by `floor` if that is larger. Returns the standard
/// deviation.
pub(super) fn standardise(values: &mut [f32], floor: f64) -> f64 {
    let n = values.len() as f64;
    let mean = values.iter().map(|&x| f64::from(x)).sum::<f64>() / n;
    let variance = values.iter().map(|&x| (f64::from(x) - mean).powi(2)).sum::<f64>() / n;
    let std = variance.sqrt();
    for value in values {
        *value = ((f64::from(*value) - mean) / std.max(floor)) as f32;
    }
    std
}

#[cfg(test)]
mod tests {
    use super::*;
    use nn::Rng;

    #[test]
    fn advantages_are_their_definitions_sums() {
        let mut rng = Rng::new(3, "advantages");
        let (gamma, lambda, last) = (0.9, 0.8, 0.3f32);
        let rewards: Vec<f64> = rng.normals(7).into_iter().map(f64::from).collect();
        let values = rng.normals(7);
        let value = |t: usize| f64::from(if t < 7 { values[t] } else { last });
        let returns = discounted(&rewards, f64::from(last), gamma);
        let advantages = generalised(&rewards, &values, last, gamma, lambda);
        for t in 0..7 {
            let rest = (t..7).map(|k| gamma.powi((k - t) as i32) * rewards[k]).sum::<f64>();
            let expected = rest + gamma.powi(7 - t as i32) * f64::from(last);
            assert!((f64::from(returns[t]) - expected).abs() < 1e-6);
            let surprise = |k: usize| rewards[k] + gamma * value(k + 1) - value(k);
            let expected: f64 = (t..7).map(|k| (gamma * lambda).powi((k - t) as i32) * surprise(k)).sum();
            assert!((f64::from(advantages[t]) - expected).abs() < 1e-6);
        }
    }

    #[test]
    fn a_solved_task_keeps_small_advantages_small() {
        let solved: Vec<f32> = (0..50).map(|i| 1.0 + 1e-4 * (i % 5) as f32).collect();
        let mut floored = solved.clone();
        let std = standardise(&mut floored, 0.1);
        assert!(std < 2e-4);
        assert!(floored.iter().all(|a| a.abs() < 3e-3), "noise stays noise");
        let mut spread: Vec<f32> = (0..50).map(|i| i as f32).collect();
        let std = standardise(&mut spread, 0.1);
        let square = spread.iter().map(|&a| f64::from(a * a)).sum::<f64>() / 50.0;
        assert!((std - 14.43).abs() < 0.01 && (square - 1.0).abs() < 1e-5);
    }
}
