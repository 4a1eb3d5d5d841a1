"""Write parity fixtures of LeRobot's DiffusionPolicy on fresh random weights and inputs.

    python make_diffusion_fixture.py OUT_FOLDER [--seed N]

needs LeRobot 0.6.1 with its extra `diffusion` (diffusers 0.38), and torch. Each fixture is a folder with config.json,
model.safetensors, draws.npz (inputs, noise, the network's output, the loss, actions drawn with DDIM and DDPM) and
gradients.safetensors (of the loss).
`ACTRM_PARITY_DIR=OUT_FOLDER cargo test --release -p models --test parity` then holds ours to them.
"""

import argparse
from pathlib import Path
from typing import Any

import diffusers.schedulers.scheduling_ddpm as ddpm
import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy, _make_noise_scheduler
from safetensors.torch import save_file

VARIANTS: dict[str, dict[str, Any]] = {
    "diffusion_film": {},
    "diffusion_shift_sample": {"use_film_scale_modulation": False, "prediction_type": "sample", "kernel_size": 3},
    "diffusion_three_levels_masked": {
        "down_dims": (8, 16, 24),
        "do_mask_loss_for_padding": True,
        "clip_sample_range": 2.0,
        "n_obs_steps": 1,
    },
}
SIZES: dict[str, Any] = {
    "horizon": 8,
    "n_obs_steps": 2,
    "n_action_steps": 4,
    "down_dims": (8, 16),
    "n_groups": 4,
    "diffusion_step_embed_dim": 8,
}


def make(out: Path, changes: dict[str, Any], seed: int) -> None:
    """Write one fixture."""
    torch.manual_seed(seed)
    state, env, action, rows = 5, 3, 4, 4
    config = DiffusionConfig(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (state,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (env,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (action,))},
        device="cpu",
        **(SIZES | changes),
    )
    policy = DiffusionPolicy(config)
    with torch.no_grad():  # norms start at 1 and 0: move them, or errors in them would not show
        for parameter in policy.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    pad = torch.zeros(rows, config.horizon, dtype=torch.bool)
    for row in range(rows):
        pad[row, config.horizon - row :] = True  # the first row has none
    batch = {
        "observation.state": torch.randn(rows, config.n_obs_steps, state),
        "observation.environment_state": torch.randn(rows, config.n_obs_steps, env),
        "action": torch.randn(rows, config.horizon, action).clamp(-1, 1),
        "action_is_pad": pad,
    }
    eps = torch.randn(rows, config.horizon, action)
    steps = torch.tensor([0, 99, 37, 64])
    model = policy.diffusion
    randn, randint = torch.randn, torch.randint
    torch.randn = lambda *_, **__: eps
    torch.randint = lambda *_, **__: steps
    try:
        loss = model.compute_loss(batch)
    finally:
        torch.randn, torch.randint = randn, randint
    loss.backward()
    cond = model._prepare_global_conditioning(batch)
    noisy = model.noise_scheduler.add_noise(batch["action"], eps, steps)
    io = {
        "state": batch["observation.state"],
        "env": batch["observation.environment_state"],
        "action": batch["action"],
        "pad": pad,
        "eps": eps,
        "steps": steps,
        "noisy": noisy,
        "output": model.unet(noisy, steps, global_cond=cond),
        "loss": loss,
    }
    between = torch.randn(9, rows, config.horizon, action)  # DDPM's own noise, at every step but the last
    io["between"] = between
    policy.eval()
    for name, count in (("DDIM", 10), ("DDIM", 1), ("DDPM", 10)):
        model.noise_scheduler = _make_noise_scheduler(
            name,
            num_train_timesteps=config.num_train_timesteps,
            beta_start=config.beta_start,
            beta_end=config.beta_end,
            beta_schedule=config.beta_schedule,
            clip_sample=config.clip_sample,
            clip_sample_range=config.clip_sample_range,
            prediction_type=config.prediction_type,
        )
        model.num_inference_steps = count
        left = iter(between)
        drawn = ddpm.randn_tensor
        ddpm.randn_tensor = lambda *_, **__: next(left)  # noqa: B023 - called in this turn only
        try:
            with torch.no_grad():
                io[f"{name.lower()}_{count}"] = model.conditional_sample(rows, global_cond=cond, noise=eps)
        finally:
            ddpm.randn_tensor = drawn
    out.mkdir(parents=True, exist_ok=True)
    policy.save_pretrained(out)
    for extra in out.glob("*.md"):
        extra.unlink()
    np.savez(out / "draws.npz", **{name: tensor.detach().numpy() for name, tensor in io.items()})
    grads = {n: p.grad.contiguous() for n, p in policy.named_parameters() if p.grad is not None}
    save_file(grads, out / "gradients.safetensors")
    print(out, sum(p.numel() for p in policy.parameters()), float(loss.detach()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for index, (name, changes) in enumerate(VARIANTS.items()):
        make(args.out / name, changes, args.seed + index)


if __name__ == "__main__":
    main()
