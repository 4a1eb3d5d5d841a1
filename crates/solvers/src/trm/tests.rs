#![allow(clippy::unwrap_used)]
use super::weights::PUZZLES;
use super::*;
use candle_core::Device;
use models::TrainConfig;
use nn::OptimiserConfig;
use nn::Rng;

fn configs() -> Vec<Config> {
    let base =
        Config { num_heads: 2, layers: 2, h_cycles: 2, l_cycles: 3, inner_size: Some(10), ..Config::new(5, 6, 8) };
    let puzzles = Config { puzzle_emb_ndim: 12, num_puzzle_identifiers: 3, ..base.clone() };
    vec![
        base.clone(),
        Config { positions: Positions::Learned, num_heads: 4, pooling: Pooling::Mean, ..base.clone() },
        Config { mixing: Mixing::MlpT, positions: Positions::None, ..base.clone() },
        Config {
            mixing: Mixing::Conv,
            positions: Positions::None,
            grid: Some([2, 3]),
            layers: 1,
            classes: Some(3),
            ..base.clone()
        },
        Config { mixing: Mixing::MlpT, positions: Positions::None, ..puzzles.clone() },
        puzzles,
    ]
}

/// Inputs and identifiers of `batch` puzzles.
fn puzzles(config: &Config, batch: usize) -> (Tensor, Tensor) {
    let mut rng = Rng::new(9, "puzzles");
    let tokens: Vec<u32> = (0..batch * config.seq_len).map(|_| rng.below(config.vocab_size as u64) as u32).collect();
    let inputs = Tensor::from_vec(tokens, (batch, config.seq_len), &Device::Cpu).unwrap();
    let identifiers: Vec<u32> = (0..batch as u32).map(|i| i % 3).collect();
    (inputs, Tensor::from_vec(identifiers, batch, &Device::Cpu).unwrap())
}

/// A loss that reads everything a step gives, in no symmetric way.
fn loss(out: &StepOutput) -> Tensor {
    let logits = out.logits.sin().unwrap().sqr().unwrap().sum_all().unwrap();
    (logits + out.q_halt.cos().unwrap().sum_all().unwrap()).unwrap()
}

fn distance(a: &Tensor, b: &Tensor) -> f32 {
    (a - b).unwrap().abs().unwrap().max_all().unwrap().to_scalar().unwrap()
}

#[test]
fn the_kernel_is_the_composed_model_forward_and_backward() {
    for config in configs() {
        let model = Trm::new(config.clone(), 3).unwrap();
        // the halting head starts at zero, which would hide its input's gradient
        let mut rng = Rng::new(1, "head");
        let head = model.params.get("inner.q_head.weight").unwrap();
        let values = Tensor::from_vec(rng.normals(head.elem_count()), head.shape(), &Device::Cpu).unwrap();
        head.set(&values).unwrap();
        let (inputs, identifiers) = puzzles(&config, 5);
        let carry = model.initial_carry(5).unwrap();
        let fused = model.supervision_step(&carry, &inputs, Some(&identifiers), Gradient::On).unwrap();
        let composed = model.supervision_step_composed(&carry, &inputs, Some(&identifiers), Gradient::On).unwrap();
        for (name, a, b) in [
            ("logits", &fused.logits, &composed.logits),
            ("q", &fused.q_halt, &composed.q_halt),
            ("z_h", &fused.carry.z_h, &composed.carry.z_h),
            ("z_l", &fused.carry.z_l, &composed.carry.z_l),
        ] {
            // rounding grows over the eight calls of the network
            let off = distance(a, b);
            assert!(off < 5e-5, "{config:?}: {name} is off by {off:e}");
        }
        let (a, b) = (loss(&fused).backward().unwrap(), loss(&composed).backward().unwrap());
        for (name, var) in model.params.iter() {
            let (a, b) = (a.get(var.as_tensor()).unwrap(), b.get(var.as_tensor()).unwrap());
            let size = b.abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
            assert!(size > 0.0, "{config:?}: {name} has a zero gradient");
            let off = distance(a, b) / size.max(1.0);
            assert!(off < 1e-4, "{config:?}: gradient of {name} is off by {off:e} of {size}");
        }
    }
}

#[test]
fn a_puzzle_is_answered_alone_as_among_others() {
    for config in configs() {
        let model = Trm::new(config.clone(), 3).unwrap();
        let (inputs, identifiers) = puzzles(&config, 7);
        let carry = model.initial_carry(7).unwrap();
        let all = model.supervision_step(&carry, &inputs, Some(&identifiers), Gradient::Off).unwrap();
        let one = Carry { z_h: carry.z_h.narrow(0, 6, 1).unwrap(), z_l: carry.z_l.narrow(0, 6, 1).unwrap() };
        let (x, id) = (inputs.narrow(0, 6, 1).unwrap(), identifiers.narrow(0, 6, 1).unwrap());
        let one = model.supervision_step(&one, &x, Some(&id), Gradient::Off).unwrap();
        assert!(distance(&all.logits.narrow(0, 6, 1).unwrap(), &one.logits) < 5e-5);
    }
}

#[test]
fn impossible_configurations_name_the_field() {
    let base = || Config { num_heads: 2, ..Config::new(5, 6, 8) };
    for (config, field) in [
        (Config { num_heads: 3, ..base() }, "num_heads"),
        (Config { num_heads: 8, ..base() }, "num_heads"),
        (Config { mixing: Mixing::Conv, ..base() }, "grid"),
        (Config { mixing: Mixing::Conv, grid: Some([2, 2]), ..base() }, "grid"),
        (Config { puzzle_emb_ndim: 8, ..base() }, "num_puzzle_identifiers"),
        (Config { halt_max_steps: 0, ..base() }, "halt_max_steps"),
        (Config { halt_max_steps: (1 << 32) + 2, ..base() }, "halt_max_steps"),
    ] {
        let error = Trm::new(config, 0).unwrap_err().to_string();
        assert!(error.contains(field), "{error}");
    }
}

#[test]
fn official_sizes_have_the_papers_parameter_counts() {
    let attention = Config { num_heads: 8, ..Config::new(11, 81, 512) };
    let mlp = Config { mixing: Mixing::MlpT, positions: Positions::None, ..Config::new(11, 81, 64) };
    let small = Config { num_heads: 8, ..Config::new(11, 81, 64) };
    let dfs10 = Config {
        mixing: Mixing::Conv,
        positions: Positions::None,
        grid: Some([10, 10]),
        layers: 1,
        classes: Some(2),
        inner_size: Some(64),
        q_outputs: 1,
        ..Config::new(4, 100, 32)
    };
    for (config, count) in [(attention, 6_828_034), (small, 132_610), (mlp, 224_258), (dfs10, 15_585)] {
        assert_eq!(Trm::new(config, 0).unwrap().params().count(), count);
    }
}

/// Puzzles whose answer is each cell's token plus one: what a few steps can learn.
fn examples(config: &Config, count: usize, seed: u64) -> Vec<Example> {
    let mut rng = Rng::new(seed, "examples");
    (0..count)
        .map(|_| {
            let inputs: Vec<u32> = (0..config.seq_len).map(|_| rng.below(config.vocab_size as u64) as u32).collect();
            let labels = inputs.iter().map(|&x| i64::from(x + 1) % config.classes() as i64).collect();
            Example { inputs, labels, identifier: rng.below(3) as u32 }
        })
        .collect()
}

fn trainer(config: &Config, release: Release) -> Trainer {
    trainer_with(config, learning(release))
}

fn disturbed_trainer(config: &Config, release: Release, disturbed: f64) -> Trainer {
    trainer_with(config, PuzzleConfig { disturbed, ..learning(release) })
}

fn learning(release: Release) -> PuzzleConfig {
    PuzzleConfig { batch_size: 8, release, ..PuzzleConfig::default() }
}

fn trainer_with(config: &Config, puzzles: PuzzleConfig) -> Trainer {
    let train = TrainConfig {
        steps: 400,
        lr: 1e-2,
        warmup_steps: 10,
        optimiser: OptimiserConfig::AdamAtan2 { beta1: 0.9, beta2: 0.95, weight_decay: 0.1 },
        clip_norm: 0.0,
        ema_decay: Some(0.9),
        ..TrainConfig::default()
    };
    Trainer::new(Trm::new(config.clone(), 2).unwrap(), train, puzzles, 4).unwrap()
}

#[test]
fn training_carries_puzzles_and_lowers_the_loss() {
    for config in [&configs()[0], &configs()[3], &configs()[5]] {
        let config = Config { halt_max_steps: 5, ..config.clone() };
        let mut trainer = trainer(&config, Release::Head);
        let table =
            |trainer: &Trainer| trainer.model().params().get(PUZZLES).map(|v| v.as_detached_tensor().copy().unwrap());
        let before = table(&trainer);
        let (mut first, mut last) = (0.0, 0.0);
        for step in 0..80 {
            let wanted = trainer.wanted();
            if step == 0 {
                assert_eq!(wanted, 8);
            }
            let kept = trainer.slots().steps().to_vec();
            let vacant = trainer.slots().vacant();
            let report = trainer.step(&examples(&config, wanted, step)).unwrap();
            assert_eq!(report.step, step + 1);
            for (slot, &steps) in trainer.slots().steps().iter().enumerate() {
                // a slot that kept its puzzle has gone on, a new one has begun
                let expected = if vacant.contains(&slot) { 1 } else { kept[slot] + 1 };
                assert_eq!(steps, expected);
                assert!(steps <= 5);
            }
            if step < 10 {
                first += report.class_loss;
            }
            if step >= 70 {
                last += report.class_loss;
            }
        }
        assert!(last < 0.9 * first, "{config:?}: {first} -> {last}");
        if let (Some(before), Some(after)) = (before, table(&trainer)) {
            assert!(distance(&before, &after) > 0.0, "the puzzle embeddings have not moved");
        }
    }
}

#[test]
fn disturbed_puzzles_go_on_from_noise_or_from_another_puzzles_states() {
    let config = Config { halt_max_steps: 50, ..configs()[0].clone() };
    let states = |trainer: &Trainer| {
        let rows: Vec<Vec<f32>> = trainer.slots().carry().z_h.flatten_from(1).unwrap().to_vec2().unwrap();
        rows
    };
    let stepped = |disturbed: f64| {
        let mut trainer = disturbed_trainer(&config, Release::Solved(0.0), disturbed);
        let wanted = trainer.wanted();
        trainer.step(&examples(&config, wanted, 1)).unwrap();
        states(&trainer)
    };
    let (calm, lost) = (stepped(0.0), stepped(0.4));
    let kept = (0..8).filter(|&slot| lost[slot] == calm[slot]).count();
    let moved = (0..8).filter(|&slot| lost[slot] == calm[(slot + 1) % 8]).count();
    let noisy: Vec<&Vec<f32>> = lost.iter().filter(|row| !calm.contains(row)).collect();
    assert!(kept > 0 && moved > 0 && !noisy.is_empty() && kept + moved + noisy.len() == 8, "{kept} {moved}");
    for row in noisy {
        let square = row.iter().map(|x| x * x).sum::<f32>() / row.len() as f32;
        assert!((0.5..2.0).contains(&square), "{square}");
    }
    assert!(stepped(1.0).iter().zip(&calm).all(|(lost, calm)| lost != calm));
}

#[test]
fn states_are_blurred_by_as_much_noise_as_was_asked_for() {
    let config = Config { halt_max_steps: 50, ..configs()[0].clone() };
    let stepped = |state_noise: f64| {
        let mut trainer = trainer_with(&config, PuzzleConfig { state_noise, ..learning(Release::Solved(0.0)) });
        let wanted = trainer.wanted();
        trainer.step(&examples(&config, wanted, 1)).unwrap();
        let Carry { z_h, z_l } = trainer.slots().carry().clone();
        Tensor::cat(&[z_h, z_l], 0).unwrap()
    };
    let off = (stepped(0.5) - stepped(0.0)).unwrap();
    let deviation = off.sqr().unwrap().mean_all().unwrap().to_scalar::<f32>().unwrap().sqrt();
    assert!((0.45..0.55).contains(&deviation), "{deviation}");
    let mean = off.mean_all().unwrap().to_scalar::<f32>().unwrap();
    assert!(mean.abs() < 0.06, "{mean}");
}

#[test]
fn a_restored_trainer_goes_on_with_the_same_bits() {
    let config = Config { halt_max_steps: 3, ..configs()[5].clone() };
    let run = |trainer: &mut Trainer, from: u64, to: u64| {
        for step in from..to {
            let wanted = trainer.wanted();
            trainer.step(&examples(&config, wanted, step)).unwrap();
        }
    };
    let noisy = PuzzleConfig { disturbed: 0.3, state_noise: 0.1, ..learning(Release::Solved(0.5)) };
    let mut one = trainer_with(&config, noisy);
    run(&mut one, 0, 5);
    let (tensors, meta) = one.state().unwrap();
    run(&mut one, 5, 9);
    let mut two = trainer_with(&config, noisy);
    run(&mut two, 0, 2);
    two.restore(&tensors, &meta).unwrap();
    run(&mut two, 5, 9);
    for ((name, a), (_, b)) in one.eval_tensors().unwrap().iter().zip(&two.eval_tensors().unwrap()) {
        assert_eq!(distance(a, b), 0.0, "{name}");
    }
    assert_eq!(one.slots().steps(), two.slots().steps());
    let mut broken = tensors.clone();
    broken.remove("carry.z_l");
    let error = two.restore(&broken, &meta).unwrap_err().to_string();
    assert!(error.contains("carry.z_l is missing"), "{error}");
}

#[test]
fn no_parameter_ends_a_step_without_a_gradient() {
    // `Learner` refuses such a step by name; what it does not train is the puzzle table, checked above
    for config in configs() {
        let mut trainer = trainer(&config, Release::Head);
        trainer.step(&examples(&config, 8, 0)).unwrap();
    }
}
