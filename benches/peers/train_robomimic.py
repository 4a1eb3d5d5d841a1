"""robomimic's own training of BC-RNN-GMM on an HDF5 file, without rollouts: `python train_robomimic.py SETTINGS.json`.

The settings name what our experiment files do; what they do not name is robomimic's default. Writes the last
checkpoint, robomimic's `.pth`, to the settings' `checkpoint`. The loop, the data loader, the optimiser and the file are
robomimic's.

With `normalise` two lines of robomimic 0.3.0 are fixed: its normalisation of observations (`hdf5_normalize_obs`) fails
an assertion for sequences, and where it does not it is applied twice, by the data set and by the loop.
"""

import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import robomimic.utils.obs_utils as obs_utils
import torch
from robomimic.config import config_factory
from robomimic.config.base_config import BaseConfig
from robomimic.scripts import train as script

# gradient steps between which robomimic may change its learning rate
EPOCH = 100


def config(settings: dict[str, Any], out: str) -> BaseConfig:
    """robomimic's configuration, as `--config` would read it."""
    epochs, rest = divmod(settings["steps"], EPOCH)
    if rest:
        raise SystemExit(f"{settings['steps']} steps are not epochs of {EPOCH}")
    made: Any = config_factory("bc")
    with made.values_unlocked():
        made.experiment.name = "reference"
        made.experiment.logging.terminal_output_to_txt = False
        made.experiment.logging.log_tb = False
        made.experiment.rollout.enabled = False
        made.experiment.render_video = False
        made.experiment.epoch_every_n_steps = EPOCH
        made.experiment.save.every_n_epochs = epochs
        made.train.data = settings["data"]
        made.train.output_dir = out
        made.train.hdf5_normalize_obs = settings["normalise"]
        made.train.hdf5_filter_key = settings["filter_key"]
        made.train.seq_length = settings["horizon"]
        made.train.batch_size = settings["batch_size"]
        made.train.num_epochs = epochs
        made.train.seed = settings["seed"]
        made.train.cuda = False
        made.observation.modalities.obs.low_dim = settings["keys"]
        policy = made.algo.optim_params.policy
        policy.learning_rate.initial = settings["lr"]
        if settings["linear_decay"]:  # to nothing: of what robomimic has the nearest to a cosine
            policy.learning_rate.scheduler_type = "linear"
            policy.learning_rate.decay_factor = 0.0
            policy.learning_rate.epoch_schedule = [epochs]
        policy.regularization.L2 = settings["weight_decay"]
        made.algo.actor_layer_dims = ()
        made.algo.gmm.enabled = True
        made.algo.gmm.num_modes = settings["n_modes"]
        made.algo.gmm.min_std = settings["min_std"]
        made.algo.rnn.enabled = True
        made.algo.rnn.horizon = settings["horizon"]
        made.algo.rnn.hidden_dim = settings["hidden_dim"]
        made.algo.rnn.num_layers = settings["n_layers"]
    made.lock()
    return made


def normalised(obs_dict: dict[str, Any], obs_normalization_stats: dict[str, Any]) -> dict[str, Any]:
    """robomimic's `normalize_obs` for as many steps as there are: its statistics are of shape (1, D)."""
    for key, values in obs_dict.items():
        stats = obs_normalization_stats[key]
        obs_dict[key] = ((values - stats["mean"]) / stats["std"]).astype(np.float32)
    return obs_dict


def mend() -> None:
    """The data set normalises sequences, and the loop does not do it again."""
    obs_utils.normalize_obs = normalised
    epoch = script.TrainUtils.run_epoch

    def once(*args: Any, **kwargs: Any) -> Any:
        return epoch(*args, **kwargs | {"obs_normalization_stats": None})

    script.TrainUtils.run_epoch = once


def main() -> None:
    settings = json.loads(Path(sys.argv[1]).read_text())
    # its script asks for two threads, whatever the machine is lent for
    torch.set_num_threads(1)
    torch.set_num_threads = lambda threads: None
    if settings["normalise"]:
        mend()
    checkpoint = Path(settings["checkpoint"])
    with tempfile.TemporaryDirectory(dir=checkpoint.parent) as out:
        script.train(config(settings, out), device=torch.device("cpu"))
        (made,) = Path(out).glob("reference/*/models/*.pth")
        os.replace(made, checkpoint)


if __name__ == "__main__":
    main()
