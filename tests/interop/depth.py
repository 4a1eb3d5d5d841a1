"""Depth: what we convert is what LeRobot records of the same arrays, and LeRobot shows it bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow.parquet as pq
import torch

Program = Callable[..., str]
SIZE = (48, 40)
LENGTHS = (7, 9)
# data set of the file: its column, and the numbers that LeRobot gets
COLUMNS = {"front_depth": np.float32, "side_depth": np.float32, "wrist_depth": np.uint16}


def write_depth(path: Path) -> list[dict[str, np.ndarray]]:
    """Demos with colours, and depth as float32 and float64 metres and uint16 millimetres; returns their arrays."""
    rng, episodes = np.random.default_rng(6), []
    with h5py.File(path, "w") as file:
        for number, length in enumerate(LENGTHS):
            shape = (length, *SIZE, 1)
            arrays: dict[str, np.ndarray] = {
                "obs/robot0_eef_pos": rng.normal(size=(length, 3)),
                "obs/robot0_eef_quat": rng.normal(size=(length, 4)),
                "obs/robot0_gripper_qpos": rng.normal(size=(length, 2)),
                "obs/front_image": rng.integers(0, 256, (length, *SIZE, 3), dtype=np.uint8),
                "obs/front_depth": rng.uniform(0.2, 4, shape).astype(np.float32),
                "obs/side_depth": rng.uniform(0.2, 4, shape),
                "obs/wrist_depth": rng.integers(0, 9000, shape, dtype=np.uint16),
                "actions": rng.normal(size=(length, 7)),
                "rewards": np.zeros(length),
                "dones": np.arange(length) == length - 1,
            }
            arrays["next_obs/front_depth"] = np.roll(arrays["obs/front_depth"], -1, axis=0)
            for key, value in arrays.items():
                file[f"data/demo_{number}/{key}"] = value
            file[f"data/demo_{number}"].attrs["num_samples"] = length
            episodes.append(arrays)
        file["data"].attrs["total"] = sum(LENGTHS)
    return episodes


def record(episodes: list[dict[str, np.ndarray]], root: Path) -> None:
    """The same depth, recorded by LeRobot."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    names = ["height", "width", "channels"]
    depth = {"dtype": "image", "shape": (*SIZE, 1), "names": names}
    features: dict[str, Any] = {"action": {"dtype": "float32", "shape": (7,), "names": None}}
    features |= {f"observation.images.{key}": {**depth, "info": {"is_depth_map": True}} for key in COLUMNS}
    data = LeRobotDataset.create("actrm/recorded", fps=20, features=features, root=root, use_videos=False)
    for arrays in episodes:
        for step, action in enumerate(arrays["actions"]):
            frame = {f"observation.images.{key}": arrays[f"obs/{key}"][step].astype(t) for key, t in COLUMNS.items()}
            data.add_frame({**frame, "action": action.astype(np.float32), "task": "look"})
        data.save_episode()
    data.finalize()


def files_of(root: Path, column: str) -> list[dict[str, Any]]:
    """A column of pictures as it is stored."""
    (path,) = (root / "data").glob("*/*.parquet")
    return pq.read_table(path, columns=[column]).column(column).to_pylist()


def compare_depth(folder: Path, ours: Program, opened: Callable[..., Any], same: Callable[[Path, Path], str]) -> str:
    """Files, features, statistics and what LeRobot shows of depth, converted and recorded; edits; the source again."""
    folder.mkdir()
    source, root, recorded, back = (folder / name for name in ("source.hdf5", "set", "recorded", "back.hdf5"))
    episodes = write_depth(source)
    ours("actrm-data", "convert", source, root, "--fps", "20")
    record(episodes, recorded)
    (metres, millimetres), theirs = (opened(root, depth_output_unit=unit) for unit in ("m", "mm")), opened(recorded)
    frames = 0
    for key, dtype in COLUMNS.items():
        column = f"observation.images.{key}"
        assert files_of(root, column) == files_of(recorded, column), f"{column}: other files than LeRobot writes"
        assert metres.meta.features[column] == theirs.meta.features[column], column
        wanted = np.concatenate([arrays[f"obs/{key}"] for arrays in episodes]).astype(dtype).astype(np.float32)
        shown = metres if dtype is np.float32 else millimetres
        for index, depth in enumerate(wanted):
            got = shown[index][column]
            assert got.dtype == torch.float32 and np.array_equal(got.numpy(), depth.transpose(2, 0, 1)), (column, index)
            frames += 1
        # means are float32 there and quantiles those of a histogram of 5000 bins
        mine, other = millimetres.meta.stats[column], theirs.meta.stats[column]
        bins = float(np.ravel(other["max"] - other["min"])[0]) / 5000
        assert mine.keys() == other.keys(), mine.keys() ^ other.keys()
        for statistic, value in other.items():
            slack = bins * 4 if statistic.startswith("q") else bins / 5 if statistic in {"mean", "std"} else 0
            assert np.shape(mine[statistic]) == np.shape(value), (column, statistic)
            np.testing.assert_allclose(mine[statistic], value, atol=slack, rtol=0, err_msg=f"{column} {statistic}")
    ours("actrm-data", "validate", root)
    ours("actrm-data", "export", root, back)
    same(source, back)
    for original in (root, recorded):
        ours("actrm-data", "validate", original)
        cut, part = folder / f"cut-{original.name}", LENGTHS[0]
        ours("actrm-data", "edit", "drop", original, cut, "--episodes", "0")
        left, whole = opened(cut), opened(original)
        for column in (f"observation.images.{key}" for key in COLUMNS):
            assert torch.equal(left[2][column], whole[part + 2][column]), (cut.name, column)
    return f"{frames} frames, bit for bit, as LeRobot's own files; statistics; edits of both; and back"
