"""Write parity fixtures of robomimic's BC-RNN-GMM and BC-Transformer-GMM on fresh random weights and inputs.

    python make_robomimic_fixture.py OUT_FOLDER [--seed N]

needs robomimic 0.3 and torch. Each fixture is a folder with config.json (`type` and options under our names),
model.safetensors (under ours, too), robomimic.npz (inputs, the mixtures' parameters, log-likelihoods, the loss) and
gradients.safetensors (of the loss, dropout off). `ACTRM_PARITY_DIR=OUT_FOLDER cargo test --release -p models
--test parity` then holds ours to them.
"""

import argparse
import json
import re
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import robomimic.utils.obs_utils as obs_utils
import torch
from robomimic.models.policy_nets import RNNGMMActorNetwork, TransformerGMMActorNetwork
from safetensors.torch import save_file

STATE, ENV, ACTION, ROWS = 5, 3, 4, 4

VARIANTS: dict[str, dict[str, Any]] = {
    "robomimic_bc_rnn": {
        "type": "bc_rnn",
        "action_horizon": 6,
        "hidden_dim": 12,
        "n_layers": 2,
        "n_modes": 5,
        "min_std": 1e-4,
    },
    "robomimic_bc_rnn_one_layer": {
        "type": "bc_rnn",
        "action_horizon": 3,
        "hidden_dim": 7,
        "n_layers": 1,
        "n_modes": 2,
        "min_std": 0.01,
    },
    "robomimic_bc_gru": {
        "type": "bc_rnn",
        "action_horizon": 5,
        "hidden_dim": 11,
        "n_layers": 2,
        "cell": "gru",
        "n_modes": 3,
        "min_std": 1e-4,
    },
    "robomimic_bc_transformer": {
        "type": "bc_transformer",
        "dim_model": 16,
        "n_heads": 4,
        "n_layers": 2,
        "dropout": 0.0,
        "n_modes": 5,
        "min_std": 1e-4,
    },
}
CONTEXT = 6
# numbers go in as they are
PLAIN = {"low_dim": {"core_class": None, "core_kwargs": {}, "obs_randomizer_class": None, "obs_randomizer_kwargs": {}}}

NAMES = (
    (r".*\b((?:weight|bias)_(?:ih|hh)_l\d+)$", r"rnn.\1"),
    (r".*nets\.(mean|scale|logits)\.(weight|bias)$", r"decoder.\1.\2"),
    (r"params\.embed_timestep$", r"embed_timestep"),
    (r"nets\.(embed_encoder|embed_ln)\.(weight|bias)$", r"\1.\2"),
    (r"nets\.transformer\.nets\.transformer\.(\d+)\.nets\.(.*)$", r"transformer.\1.\2"),
    (r"nets\.transformer\.nets\.output_ln\.(weight|bias)$", r"output_ln.\1"),
)


def our_name(theirs: str) -> str:
    """What a parameter of robomimic's is called here."""
    for pattern, name in NAMES:
        if re.match(pattern, theirs):
            return re.sub(pattern, name, theirs)
    raise KeyError(theirs)


def network(config: dict[str, Any]) -> torch.nn.Module:
    """robomimic's network with these options."""
    shapes = OrderedDict(state=(STATE,), env=(ENV,))
    common: dict[str, Any] = {
        "num_modes": config["n_modes"],
        "min_std": config["min_std"],
        "low_noise_eval": True,
        "encoder_kwargs": PLAIN,
    }
    if config["type"] == "bc_rnn":
        return RNNGMMActorNetwork(
            obs_shapes=shapes,
            ac_dim=ACTION,
            mlp_layer_dims=[],
            rnn_hidden_dim=config["hidden_dim"],
            rnn_num_layers=config["n_layers"],
            rnn_type=config.get("cell", "lstm").upper(),
            rnn_kwargs={},
            **common,
        )
    return TransformerGMMActorNetwork(
        obs_shapes=shapes,
        ac_dim=ACTION,
        transformer_embed_dim=config["dim_model"],
        transformer_num_layers=config["n_layers"],
        transformer_num_heads=config["n_heads"],
        transformer_context_length=CONTEXT,
        transformer_nn_parameter_for_timesteps=True,
        transformer_emb_dropout=0.0,
        transformer_attn_dropout=0.0,
        transformer_block_output_dropout=0.0,
        **common,
    )


def make(out: Path, config: dict[str, Any], seed: int) -> None:
    """Write one fixture."""
    torch.manual_seed(seed)
    recurrent = config["type"] == "bc_rnn"
    steps = config["action_horizon"] if recurrent else CONTEXT
    net = network(config)
    net.train()
    with torch.no_grad():  # what starts at 0 or 1 is moved, or errors in it would not show
        for parameter in net.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    observation = {"state": torch.randn(ROWS, steps, STATE), "env": torch.randn(ROWS, steps, ENV)}
    dists = net.forward_train(obs_dict=observation)
    mean = dists.component_distribution.base_dist.loc
    scale = dists.component_distribution.base_dist.scale
    logits = dists.mixture_distribution.logits
    if not recurrent:  # the last step alone is supervised
        mean, scale, logits = mean[:, -1], scale[:, -1], logits[:, -1]
        dists = torch.distributions.MixtureSameFamily(
            torch.distributions.Categorical(logits=logits),
            torch.distributions.Independent(torch.distributions.Normal(mean, scale), 1),
        )
    action = torch.rand(*logits.shape[:-1], ACTION) * 2 - 1
    log_prob = dists.log_prob(action)
    loss = -log_prob.mean()
    loss.backward()
    io = observation | {
        "action": action,
        "mean": mean,
        "scale": scale,
        "logits": logits,
        "log_prob": log_prob,
        "loss": loss,
    }
    if recurrent:  # the state carried from step to step at test time, begun anew where robomimic does
        net.eval()
        state, carried = None, []
        with torch.no_grad():
            for step in range(2 * steps):
                if step % steps == 0:
                    state = net.get_rnn_init_state(batch_size=ROWS, device=torch.device("cpu"))
                now = {name: values[:, step % steps] for name, values in observation.items()}
                dist, state = net.forward_train_step(now, rnn_state=state)
                carried.append(dist.component_distribution.base_dist.loc)
        io["carried"] = torch.stack(carried, 1)
    out.mkdir(parents=True, exist_ok=True)
    (out / "config.json").write_text(json.dumps(config, indent=4) + "\n")
    np.savez(out / "robomimic.npz", **{name: tensor.detach().numpy() for name, tensor in io.items()})
    parameters = {our_name(name): p for name, p in net.named_parameters()}
    save_file({name: p.detach().contiguous() for name, p in parameters.items()}, out / "model.safetensors")
    grads = {n: (torch.zeros_like(p) if p.grad is None else p.grad).contiguous() for n, p in parameters.items()}
    save_file(grads, out / "gradients.safetensors")
    print(out, sum(p.numel() for p in parameters.values()), float(loss.detach()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    obs_utils.initialize_obs_utils_with_obs_specs(
        {"obs": {"low_dim": ["state", "env"], "rgb": [], "depth": [], "scan": []}}
    )
    for index, (name, config) in enumerate(VARIANTS.items()):
        make(args.out / name, config, args.seed + index)


if __name__ == "__main__":
    main()
