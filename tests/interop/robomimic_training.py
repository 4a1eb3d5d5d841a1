"""robomimic's own script trains on robomimic files that we make of LeRobot's data sets."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import torch

EPOCHS, STEPS = 2, 3


def train(source: Path, out: Path, low_dim: list[str], images: list[str]) -> str:
    """`robomimic.scripts.train` trains its BC for some steps on a file and stores what it has."""
    import robomimic

    out.mkdir()
    config = {
        "algo_name": "bc",
        "experiment": {
            "name": "ours",
            "logging": {"terminal_output_to_txt": False, "log_tb": False},
            "rollout": {"enabled": False},
            "render_video": False,
            "epoch_every_n_steps": STEPS,
            "save": {"every_n_epochs": EPOCHS},
        },
        "train": {
            "data": str(source),
            "output_dir": str(out),
            "batch_size": 4,
            "num_epochs": EPOCHS,
            "num_data_workers": 0,
            "hdf5_load_next_obs": False,
            "cuda": False,
        },
        "observation": {
            "modalities": {"obs": {"low_dim": low_dim, "rgb": images}},
        },
    }
    path = out / "config.json"
    path.write_text(json.dumps(config))
    script = Path(robomimic.__path__[0]) / "scripts" / "train.py"
    done = subprocess.run([sys.executable, script, "--config", path], capture_output=True, text=True, check=False)
    # it ends with exit code 0 whatever happened
    assert "finished run successfully!" in done.stdout, done.stdout[-4000:] + done.stderr[-4000:]
    (checkpoint,) = out.glob("ours/*/models/*.pth")
    weights = torch.load(checkpoint, map_location="cpu", weights_only=False)["model"]
    assert weights and all(torch.isfinite(tensor).all() for tensor in weights.values() if tensor.is_floating_point())
    losses = [json.loads(line.split(":")[1].rstrip(",")) for line in done.stdout.splitlines() if '"Loss":' in line]
    assert len(losses) == EPOCHS, losses
    return f"{EPOCHS * STEPS} steps, loss {losses[0]:.3f} then {losses[1]:.3f}"
