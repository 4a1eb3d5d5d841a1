"""A training step of LeRobot's ACT or diffusion policy: python gpu_torch.py DEVICE WORK PRECISION ROUNDS STEPS

WORK is "act_d256", "act_images" or "diffusion_images"; sizes are those of tools/actrm-zoo/examples/gpu_check.rs.
PRECISION is "f32", "tf32" (what LeRobot trains in) or "bf16" (autocast).
Prints {"ms": least of all rounds, "parameters": number of weights, "torch": version}.
"""

import json
import sys
import time
from collections.abc import Callable

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

STATE, ENV, ACTION = 9, 10, 7
ACTIONS = {"action": PolicyFeature(FeatureType.ACTION, (ACTION,))}


def picture(side: int) -> PolicyFeature:
    return PolicyFeature(FeatureType.VISUAL, (3, side, side))


def act(device: str, rows: int, cameras: dict[str, PolicyFeature]) -> tuple[torch.nn.Module, dict[str, torch.Tensor]]:
    seen = cameras or {"observation.environment_state": PolicyFeature(FeatureType.ENV, (ENV,))}
    config = ACTConfig(
        input_features={"observation.state": PolicyFeature(FeatureType.STATE, (STATE,)), **seen},
        output_features=ACTIONS,
        dim_model=256,
        dim_feedforward=1024,
        chunk_size=32,
        n_action_steps=32,
        pretrained_backbone_weights=None,
        device=device,
    )
    batch = {name: torch.randn(rows, *feature.shape) for name, feature in config.input_features.items()}
    return ACTPolicy(config), batch | {"action": torch.randn(rows, 32, ACTION)}


def diffusion(device: str, rows: int) -> tuple[torch.nn.Module, dict[str, torch.Tensor]]:
    inputs = {
        "observation.state": PolicyFeature(FeatureType.STATE, (STATE,)),
        "observation.images.front": picture(96),
    }
    config = DiffusionConfig(
        input_features=inputs, output_features=ACTIONS, pretrained_backbone_weights=None, device=device
    )
    batch = {name: torch.rand(rows, 2, *feature.shape) for name, feature in inputs.items()}
    return DiffusionPolicy(config), batch | {"action": torch.randn(rows, config.horizon, ACTION)}


def step_of(policy: torch.nn.Module, batch: dict[str, torch.Tensor], device: str, precision: str) -> Callable[[], None]:
    optimiser = torch.optim.AdamW(policy.get_optim_params(), lr=1e-4, weight_decay=1e-4)
    policy.train()

    def step() -> None:
        # the policy adds names of its own
        with torch.autocast(device, torch.bfloat16, enabled=precision == "bf16"):
            loss, _ = policy(dict(batch))
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 10.0)
        optimiser.step()
        optimiser.zero_grad()

    return step


def main() -> None:
    device, work, precision, rounds, steps = *sys.argv[1:4], int(sys.argv[4]), int(sys.argv[5])
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = precision != "f32"
    torch.backends.cudnn.benchmark = True
    cameras = {f"observation.images.{name}": picture(224) for name in ("front", "wrist")}
    policy, batch = {
        "act_d256": lambda: act(device, 64, {}),
        "act_images": lambda: act(device, 32, cameras),
        "diffusion_images": lambda: diffusion(device, 64),
    }[work]()
    policy.to(device)
    batch["action_is_pad"] = torch.zeros(batch["action"].shape[:2], dtype=torch.bool)
    step = step_of(policy, {name: tensor.to(device) for name, tensor in batch.items()}, device, precision)

    def timed() -> float:
        begun = time.perf_counter()
        for _ in range(steps):
            step()
        if device == "cuda":
            torch.cuda.synchronize()
        return 1e3 * (time.perf_counter() - begun) / steps

    timed()
    parameters = sum(parameter.numel() for parameter in policy.parameters())
    ms = min(timed() for _ in range(rounds))
    print(json.dumps({"ms": ms, "parameters": parameters, "torch": torch.__version__}))


if __name__ == "__main__":
    main()
