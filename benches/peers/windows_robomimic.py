"""Random windows with a chunk of actions from robomimic's SequenceDataset, everything cached in memory.

    windows_robomimic.py FILE [--horizon 32] [--batch 64] [--batches 200]

Prints one line of JSON: samples, CPU seconds, wall seconds (loading not counted) and seconds to load.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import time
from pathlib import Path

import robomimic.utils.obs_utils as obs_utils
import torch
from robomimic.utils.dataset import SequenceDataset

KEYS = ("object", "robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")


def main() -> None:
    """Load and report."""
    parser = argparse.ArgumentParser()
    parser.add_argument("file", type=Path)
    parser.add_argument("--horizon", type=int, default=32)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--batches", type=int, default=200)
    args = parser.parse_args()
    torch.set_num_threads(1)
    loading = time.perf_counter()
    # it announces itself on stdout
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": list(KEYS), "rgb": []}})
        data = SequenceDataset(
            hdf5_path=str(args.file),
            obs_keys=KEYS,
            dataset_keys=("actions",),
            frame_stack=1,
            seq_length=args.horizon,
            pad_frame_stack=True,
            pad_seq_length=True,
            get_pad_mask=True,
            goal_mode=None,
            hdf5_cache_mode="all",
            hdf5_use_swmr=False,
            load_next_obs=False,
        )
    loading = time.perf_counter() - loading
    batches = iter(torch.utils.data.DataLoader(data, batch_size=args.batch, shuffle=True, num_workers=0))
    next(batches)
    wall, cpu = time.perf_counter(), time.process_time()
    samples = 0
    for _ in range(args.batches):
        samples += len(next(batches)["actions"])
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    report = {"samples": samples, "cpu_seconds": cpu, "wall_seconds": wall, "load_seconds": loading}
    print(json.dumps(report))


if __name__ == "__main__":
    main()
