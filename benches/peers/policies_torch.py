"""LeRobot's diffusion, robomimic's BC-RNN and BC-Transformer on PyTorch, driven step by step (`orders.py`).

Lines: {"policy": "diffusion" | "bc_rnn" | "bc_transformer", "work": "train" | "predict", "times": 3}, on one thread.
"predict" draws actions from one observation: diffusion with 10 steps of DDIM, BC-RNN and BC-Transformer one action.
"""

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import robomimic.utils.obs_utils as obs_utils
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from orders import Work, answer
from robomimic.models.policy_nets import RNNGMMActorNetwork, TransformerGMMActorNetwork

BATCH, STATE, ENV, ACTION, STEPS = 64, 9, 10, 7, 10
# numbers go in as they are
PLAIN: dict[str, Any] = {
    "low_dim": {"core_class": None, "core_kwargs": {}, "obs_randomizer_class": None, "obs_randomizer_kwargs": {}}
}


def trained(module: torch.nn.Module, loss: Callable[[], torch.Tensor]) -> Callable[[], None]:
    """A training step."""
    optimiser = torch.optim.AdamW(module.parameters(), lr=1e-4, weight_decay=1e-6)

    def step() -> None:
        module.train()
        loss().backward()
        torch.nn.utils.clip_grad_norm_(module.parameters(), 10.0)
        optimiser.step()
        optimiser.zero_grad()

    return step


def diffusion() -> Work:
    """LeRobot's, at the size of `configs/policy/_unet.toml`."""
    config = DiffusionConfig(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (STATE,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (ENV,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTION,))},
        horizon=16,
        n_action_steps=8,
        down_dims=(64, 128),
        diffusion_step_embed_dim=64,
        noise_scheduler_type="DDIM",
        num_inference_steps=10,
        device="cpu",
    )
    policy = DiffusionPolicy(config)
    batch = {
        "observation.state": torch.randn(BATCH, 2, STATE),
        "observation.environment_state": torch.randn(BATCH, 2, ENV),
        "action": torch.randn(BATCH, 16, ACTION),
        "action_is_pad": torch.zeros(BATCH, 16, dtype=torch.bool),
    }
    one = {name: value[:1] for name, value in batch.items() if "observation" in name}

    def predict() -> None:
        policy.eval()
        with torch.inference_mode():
            policy.diffusion.generate_actions(one)

    return {"train": trained(policy, lambda: policy.diffusion.compute_loss(batch)), "predict": predict}


def shapes() -> OrderedDict[str, tuple[int, ...]]:
    """What robomimic's networks see."""
    return OrderedDict(state=(STATE,), env=(ENV,))


def seen(rows: int) -> dict[str, torch.Tensor]:
    """Sequences of observations."""
    return {"state": torch.randn(rows, STEPS, STATE), "env": torch.randn(rows, STEPS, ENV)}


def bc_rnn() -> Work:
    """robomimic's, two layers of 400."""
    net: Any = RNNGMMActorNetwork(
        obs_shapes=shapes(),
        ac_dim=ACTION,
        mlp_layer_dims=[],
        rnn_hidden_dim=400,
        rnn_num_layers=2,
        rnn_kwargs={},
        min_std=1e-4,
        encoder_kwargs=PLAIN,
    )
    batch, actions = seen(BATCH), torch.rand(BATCH, STEPS, ACTION) * 2 - 1
    now = {name: value[:1, 0] for name, value in batch.items()}
    state = net.get_rnn_init_state(batch_size=1, device=torch.device("cpu"))

    def predict() -> None:
        net.eval()
        with torch.inference_mode():
            net.forward_step(now, rnn_state=state)

    return {"train": trained(net, lambda: -net.forward_train(batch).log_prob(actions).mean()), "predict": predict}


def bc_transformer() -> Work:
    """robomimic's, four blocks of 128; the loss of the last step alone."""
    net: Any = TransformerGMMActorNetwork(
        obs_shapes=shapes(),
        ac_dim=ACTION,
        transformer_embed_dim=128,
        transformer_num_layers=4,
        transformer_num_heads=8,
        transformer_context_length=STEPS,
        transformer_nn_parameter_for_timesteps=True,
        min_std=1e-4,
        encoder_kwargs=PLAIN,
    )
    batch, actions = seen(BATCH), torch.rand(BATCH, STEPS, ACTION) * 2 - 1
    one = {name: value[:1] for name, value in batch.items()}

    def predict() -> None:
        net.eval()
        with torch.inference_mode():
            net(one)

    return {
        "train": trained(net, lambda: -net.forward_train(batch).log_prob(actions)[:, -1].mean()),
        "predict": predict,
    }


def works(policy: str) -> Work:
    return {"diffusion": diffusion, "bc_rnn": bc_rnn, "bc_transformer": bc_transformer}[policy]()


if __name__ == "__main__":
    obs_utils.initialize_obs_utils_with_obs_specs(
        {"obs": {"low_dim": ["state", "env"], "rgb": [], "depth": [], "scan": []}}
    )
    answer(works)
