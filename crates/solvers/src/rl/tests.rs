#![allow(clippy::unwrap_used)]
use super::*;
use crate::WalkerConfig;
use candle_core::Device;

fn train(steps: u64, lr: f64) -> TrainConfig {
    TrainConfig {
        steps,
        lr,
        warmup_steps: 0,
        schedule: models::Schedule::Constant,
        clip_norm: 1.0,
        ..TrainConfig::default()
    }
}

fn algorithms() -> [Algorithm; 3] {
    [
        Algorithm::Reinforce,
        Algorithm::A2c,
        Algorithm::Ppo { clip: 0.2, epochs: 3, batch_size: 64, target_kl: Some(0.1) },
    ]
}

fn agent(algorithm: Algorithm, seed: u64) -> Agent {
    let value = !matches!(algorithm, Algorithm::Reinforce);
    let net = WalkerConfig::Mlp { hidden: vec![16], value }.build(5, 2, seed).unwrap();
    let config = RlConfig { reward_scale: 1.0, ..RlConfig::new(algorithm) };
    Agent::new(net, config, train(1000, 1e-2), seed).unwrap()
}

/// A corridor of five cells, one-hot; from the middle, action 1 goes right and action 0 left, the right end pays 1 and
/// the left end nothing, each step costs 0.02.
fn corridor(agent: &mut Agent, choice: Choice) -> Episode {
    let mut episode = Episode::default();
    let mut at = 2usize;
    loop {
        let mut observation = [0.0; 5];
        observation[at] = 1.0;
        let decision = agent.decide(&observation, &[episode.previous_action()], choice).unwrap()[0];
        at = if decision.action == 1 { at + 1 } else { at - 1 };
        let reward = if at == 4 { 0.98 } else { -0.02 };
        episode.push(&observation, decision, reward);
        if at == 0 || at == 4 || episode.len() == 20 {
            return episode;
        }
    }
}

#[test]
fn every_algorithm_learns_the_corridor() {
    for algorithm in algorithms() {
        for seed in 0..3 {
            let mut agent = agent(algorithm, seed);
            for _ in 0..60 {
                let episodes: Vec<Episode> = (0..8).map(|_| corridor(&mut agent, Choice::Sample)).collect();
                let metrics = agent.update(&episodes).unwrap();
                assert!(metrics.loss.is_finite() && metrics.grad_norm > 0.0);
                assert!(metrics.kl >= 0.0 && metrics.entropy <= 2f64.ln() + 1e-6);
            }
            let greedy = corridor(&mut agent, Choice::Greedy);
            assert_eq!(greedy.actions, [1, 1], "{algorithm:?}, seed {seed}");
            let sampled = (0..50).filter(|_| corridor(&mut agent, Choice::Sample).total_reward() > 0.5).count();
            assert!(sampled >= 45, "{algorithm:?}, seed {seed}: {sampled} of 50");
        }
    }
}

/// The gradient of `-mean(log p(a_i) A_i)` for one set of scores shared by all steps is `mean(A_i (p - onehot(a_i)))`.
/// The published study multiplied a column of log-probabilities with a row of returns: a matrix, whose mean is the
/// product of two means, of which the second is zero. This is the gradient that it should have had.
#[test]
fn the_policy_gradient_is_not_broadcast_away() {
    let scores = [0.3f32, -0.2, 0.5];
    let p: Vec<f32> = scores.iter().map(|x| x.exp() / scores.iter().map(|x| x.exp()).sum::<f32>()).collect();
    let actions = vec![0, 1, 2, 2, 0, 1];
    let mut advantages = vec![1.0, 0.5, -2.0, 0.3, 0.2, 1.7];
    standardise(&mut advantages, 1e-3);
    assert!(advantages.iter().sum::<f32>().abs() < 1e-5);
    let log_probs = actions.iter().map(|&a| p[a as usize].ln()).collect();
    let chosen = Chosen { actions, log_probs, advantages, returns: Vec::new() };
    let var = candle_core::Var::from_slice(&scores, (1, 3), &Device::Cpu).unwrap();
    for clip in [None, Some(0.2)] {
        // at ratio 1 the gradient of PPO's loss is that of REINFORCE's
        let logits = var.as_tensor().broadcast_as((6, 3)).unwrap();
        let loss = chosen.policy_loss(&log_softmax(&logits).unwrap(), clip).unwrap().loss;
        assert_eq!(loss.dims(), [0usize; 0]);
        let grad = loss.backward().unwrap().get(&var).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for (j, got) in grad.iter().enumerate() {
            let term = |(&a, &adv): (&u32, &f32)| adv * (p[j] - f32::from(u8::from(a as usize == j)));
            let expected = chosen.actions.iter().zip(&chosen.advantages).map(term).sum::<f32>() / 6.0;
            assert!((got - expected).abs() < 1e-6, "clip {clip:?}, score {j}: {got} against {expected}");
        }
        assert!(grad.iter().any(|g| g.abs() > 0.05));
    }
}

#[test]
fn clipping_takes_the_gradient_of_what_went_far_enough() {
    // twice as probable as when it was drawn: more is not rewarded, less is still punished
    let far = (0.5f32.ln(), 0.25f32.ln());
    for (advantage, moves) in [(1.0, false), (-1.0, true)] {
        let chosen =
            Chosen { actions: vec![0], log_probs: vec![far.1], advantages: vec![advantage], returns: Vec::new() };
        let var = candle_core::Var::from_slice(&[0f32, 0.0], (1, 2), &Device::Cpu).unwrap();
        let out = chosen.policy_loss(&log_softmax(var.as_tensor()).unwrap(), Some(0.2)).unwrap();
        assert_eq!(out.clipped, 1.0);
        let grads = out.loss.backward().unwrap();
        let grad = grads.get(&var).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(grad[0].abs() > 1e-3, moves, "advantage {advantage}: {grad:?}");
    }
}

#[test]
fn a_restored_agent_goes_on_with_the_same_bits() {
    for algorithm in algorithms() {
        let play = |agent: &mut Agent, updates: usize| {
            for _ in 0..updates {
                let episodes: Vec<Episode> = (0..20).map(|_| corridor(agent, Choice::Sample)).collect();
                agent.update(&episodes).unwrap();
            }
        };
        let mut one = agent(algorithm, 5);
        play(&mut one, 3);
        let (tensors, meta) = one.state().unwrap();
        play(&mut one, 3);
        let mut two = agent(algorithm, 6);
        play(&mut two, 1);
        two.restore(&tensors, &meta).unwrap();
        play(&mut two, 3);
        let bits = |agent: &Agent| {
            let tensors = agent.eval_tensors().unwrap();
            tensors
                .values()
                .flat_map(|t| t.flatten_all().unwrap().to_vec1::<f32>().unwrap())
                .map(f32::to_bits)
                .collect()
        };
        let (a, b): (Vec<u32>, Vec<u32>) = (bits(&one), bits(&two));
        assert_eq!(a, b, "{algorithm:?}");
        assert_eq!(corridor(&mut one, Choice::Sample), corridor(&mut two, Choice::Sample));
    }
}

#[test]
fn an_expert_is_imitated() {
    let mut agent = agent(Algorithm::Reinforce, 0);
    let observations: Vec<f32> = (0..25).map(|i| f32::from(u8::from(i / 5 == i % 5))).collect();
    let targets = [1.0, 0.0, 0.0, 1.0, 0.5, 0.5, 1.0, 0.0, 0.0, 1.0];
    let first = agent.imitate(&observations, &[0; 5], &targets).unwrap().loss;
    for _ in 0..150 {
        agent.imitate(&observations, &[0; 5], &targets).unwrap();
    }
    let decisions = agent.decide(&observations, &[0; 5], Choice::Greedy).unwrap();
    for (row, action) in [(0, 0), (1, 1), (3, 0), (4, 1)] {
        assert_eq!(decisions[row].action, action);
    }
    let undecided = decisions[2].log_prob.exp();
    assert!((undecided - 0.5).abs() < 0.1, "{undecided}");
    let last = agent.imitate(&observations, &[0; 5], &targets).unwrap().loss;
    // the entropy of the undecided row is what cannot be learnt
    assert!(last < first && last > 2f32.ln() / 5.0 - 1e-3, "{first} -> {last}");
    let error = agent.imitate(&observations, &[0; 5], &[0.3; 10]).unwrap_err().to_string();
    assert!(error.contains("row 0"), "{error}");
}

#[test]
fn sampling_follows_the_policy_and_the_seed() {
    let mut one = agent(Algorithm::A2c, 1);
    let observation = [1.0, 0.0, 0.0, 0.0, 0.0];
    let many = observation.repeat(4000);
    let decisions = one.decide(&many, &[0; 4000], Choice::Sample).unwrap();
    let p = decisions.iter().find(|d| d.action == 1).unwrap().log_prob.exp();
    let share = decisions.iter().filter(|d| d.action == 1).count() as f32 / 4000.0;
    assert!((share - p).abs() < 4.0 * (p * (1.0 - p) / 4000.0).sqrt(), "{share} against {p}");
    assert_eq!(agent(Algorithm::A2c, 1).decide(&many, &[0; 4000], Choice::Sample).unwrap(), decisions);
}

#[test]
fn what_does_not_fit_is_named() {
    let net = WalkerConfig::Mlp { hidden: vec![4], value: true }.build(5, 2, 0).unwrap();
    let error = Agent::new(net, RlConfig::new(Algorithm::Reinforce), train(1, 1e-3), 0).unwrap_err().to_string();
    assert!(error.contains("value head"), "{error}");
    let config = RlConfig { advantage_std_floor: 0.0, ..RlConfig::new(Algorithm::A2c) };
    assert!(config.check().unwrap_err().to_string().contains("advantage_std_floor"));
    let mut agent = agent(Algorithm::A2c, 0);
    assert!(agent.update(&[]).unwrap_err().to_string().contains("episodes"));
    let mut episode = corridor(&mut agent, Choice::Sample);
    episode.rewards.pop();
    assert!(agent.update(&[episode]).unwrap_err().to_string().contains("rewards"));
    assert!(agent.decide(&[0.0; 4], &[0], Choice::Greedy).unwrap_err().to_string().contains("observations"));
}
