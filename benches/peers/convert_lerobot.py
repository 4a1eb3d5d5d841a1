"""Convert the first demos of a robomimic HDF5 file with LeRobot's own API: `add_frame` and `save_episode`.

The same frame columns as `actrm-data convert` writes; there is no side folder, which this API has no place for.

    convert_lerobot.py FILE OUT [--demos 6]

Prints one line of JSON: frames, CPU seconds, wall seconds. The API is slow; its rate does not depend on how many
episodes it is given.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

os.environ["HF_HUB_OFFLINE"] = "1"

import h5py
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

STATE = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")


def main() -> None:
    """Convert and report."""
    parser = argparse.ArgumentParser()
    parser.add_argument("file", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--demos", type=int, default=6)
    args = parser.parse_args()
    wall, cpu = time.perf_counter(), time.process_time()
    with h5py.File(args.file) as file:
        demos = sorted(file["data"], key=lambda name: int(name.removeprefix("demo_")))[: args.demos]
        obs = file["data"][demos[0]]["obs"]
        vector = lambda n: {"dtype": "float32", "shape": (n,), "names": [f"x{i}" for i in range(n)]}  # noqa: E731
        scalar = lambda dtype: {"dtype": dtype, "shape": (1,), "names": None}  # noqa: E731
        features = {
            "observation.state": vector(sum(obs[k].shape[1] for k in STATE)),
            "observation.environment_state": vector(obs["object"].shape[1]),
            "action": vector(file["data"][demos[0]]["actions"].shape[1]),
            "next.reward": scalar("float32"),
            "next.done": scalar("bool"),
            "next.success": scalar("bool"),
        }
        data = LeRobotDataset.create("actrm/bench", fps=20, root=args.out, features=features, use_videos=False)
        frames = 0
        for name in demos:
            demo = file["data"][name]
            state = np.concatenate([demo["obs"][k][:] for k in STATE], axis=1).astype(np.float32)
            env = demo["obs/object"][:].astype(np.float32)
            actions = demo["actions"][:].astype(np.float32)
            rewards = demo["rewards"][:].astype(np.float32)
            dones = demo["dones"][:] != 0
            for i in range(len(actions)):
                frame = {
                    "observation.state": state[i],
                    "observation.environment_state": env[i],
                    "action": actions[i],
                    "next.reward": rewards[i : i + 1],
                    "next.done": dones[i : i + 1],
                    "next.success": rewards[i : i + 1] >= 1.0,
                    "task": "Lift",
                }
                data.add_frame(frame)
            data.save_episode()
            frames += len(actions)
        data.finalize()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    print(json.dumps({"frames": frames, "cpu_seconds": cpu, "wall_seconds": wall}))


if __name__ == "__main__":
    main()
