"""Random windows with a chunk of actions from a LeRobotDataset, batch by batch through a DataLoader.

    windows_lerobot.py DIR [--horizon 32] [--batch 64] [--batches 8]

Prints one line of JSON: samples, CPU seconds, wall seconds (opening not counted).
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

os.environ["HF_HUB_OFFLINE"] = "1"

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset


def main() -> None:
    """Load and report."""
    parser = argparse.ArgumentParser()
    parser.add_argument("dir", type=Path)
    parser.add_argument("--horizon", type=int, default=32)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--batches", type=int, default=8)
    args = parser.parse_args()
    torch.set_num_threads(1)
    fps = json.loads((args.dir / "meta/info.json").read_text())["fps"]
    deltas = {"action": [i / fps for i in range(args.horizon)]}
    data = LeRobotDataset(f"actrm/{args.dir.name}", root=args.dir, delta_timestamps=deltas)
    loader = torch.utils.data.DataLoader(data, batch_size=args.batch, shuffle=True, num_workers=0)
    batches = iter(loader)
    next(batches)
    wall, cpu = time.perf_counter(), time.process_time()
    samples = 0
    for _ in range(args.batches):
        samples += len(next(batches)["action"])
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    print(json.dumps({"samples": samples, "cpu_seconds": cpu, "wall_seconds": wall}))


if __name__ == "__main__":
    main()
