"""Write parity fixtures of Chi et al.'s TransformerForDiffusion on fresh random weights and inputs.

    python make_transformer_fixture.py OUT_FOLDER --reference CHECKOUT [--seed N]

needs torch and a checkout of https://github.com/real-stanford/diffusion_policy (5ba07ac6661d; it has no releases).
Each fixture is a folder with config.json, model.safetensors, transformer.npz (inputs, the network's output, the mean
squared error to `eps`) and gradients.safetensors (of that error).
`ACTRM_PARITY_DIR=OUT_FOLDER cargo test --release -p models --test parity` then holds ours to them.
"""

import argparse
import importlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file

# with one observation their mask over observations hides none, with more of them ours hides none and theirs some
VARIANTS: dict[str, dict[str, Any]] = {
    "diffusion_transformer": {"causal_attn": False, "n_obs_steps": 2},
    "diffusion_transformer_causal": {"causal_attn": True, "n_obs_steps": 1, "n_layer": 1},
}


def make(network: Any, out: Path, changes: dict[str, Any], seed: int) -> None:
    """Write one fixture."""
    torch.manual_seed(seed)
    state, env, action, rows, horizon = 5, 3, 4, 4, 8
    options = {"n_layer": 2, "n_head": 3, "n_emb": 12} | changes
    steps_seen = options["n_obs_steps"]
    model = network(
        input_dim=action,
        output_dim=action,
        horizon=horizon,
        cond_dim=state + env,
        p_drop_emb=0.0,
        p_drop_attn=0.0,
        **options,
    )
    with torch.no_grad():  # biases start at 0 and norms at 1: move them, or errors in them would not show
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    seen = {"state": torch.randn(rows, steps_seen, state), "env": torch.randn(rows, steps_seen, env)}
    noisy, eps = torch.randn(rows, horizon, action), torch.randn(rows, horizon, action)
    steps = torch.tensor([0, 99, 37, 64])
    output = model(noisy, steps, torch.cat([seen["state"], seen["env"]], dim=2))
    loss = torch.nn.functional.mse_loss(output, eps)
    loss.backward()
    out.mkdir(parents=True, exist_ok=True)
    names = {"n_layers": "n_layer", "n_heads": "n_head", "dim_model": "n_emb", "causal": "causal_attn"}
    ours = {name: options[theirs] for name, theirs in names.items()} | {"dropout": 0.0}
    config = {"n_obs_steps": steps_seen, "horizon": horizon, "transformer": ours}
    (out / "config.json").write_text(json.dumps(config, indent=2) + "\n")
    kept = {name: p for name, p in model.named_parameters() if "_dummy_variable" not in name}
    save_file({name: p.detach().contiguous() for name, p in kept.items()}, out / "model.safetensors")
    save_file({name: p.grad.contiguous() for name, p in kept.items()}, out / "gradients.safetensors")
    io = seen | {"noisy": noisy, "eps": eps, "steps": steps, "output": output, "loss": loss}
    np.savez(out / "transformer.npz", **{name: tensor.detach().numpy() for name, tensor in io.items()})
    print(out, sum(p.numel() for p in kept.values()), float(loss.detach()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--reference", type=Path, required=True, help="checkout of diffusion_policy")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    sys.path.insert(0, str(args.reference))
    module = importlib.import_module("diffusion_policy.model.diffusion.transformer_for_diffusion")
    for index, (name, changes) in enumerate(VARIANTS.items()):
        make(module.TransformerForDiffusion, args.out / name, changes, args.seed + index)


if __name__ == "__main__":
    main()
