"""Convert a robomimic HDF5 file to Parquet with h5py and pyarrow: the same columns as `actrm-data convert` writes.

The frames in float32 as LeRobot stores them, and beside them every dataset with one row a step in its own type
(next_obs as the file has it). One row group an episode, zstd, one thread, as such scripts are written.

    convert_h5py_pyarrow.py FILE OUT [--level 3]

Prints one line of JSON: frames, CPU seconds, wall seconds, bytes written.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

STATE = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")


def vectors(values: np.ndarray) -> pa.Array:
    """A column of vectors, or of scalars."""
    flat = pa.array(values.reshape(-1))
    width = values.size // len(values)
    return flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)


def pictures(values: np.ndarray) -> pa.Array:
    """A column of PPM files."""
    height, width, _ = values.shape[1:]
    header = f"P6\n{width} {height}\n255\n".encode()
    files = pa.array([header + image.tobytes() for image in values], pa.binary())
    names = pa.array([f"frame-{i:06d}.ppm" for i in range(len(values))])
    return pa.StructArray.from_arrays([files, names], ["bytes", "path"])


def main() -> None:
    """Convert and report."""
    parser = argparse.ArgumentParser()
    parser.add_argument("file", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--level", type=int, default=1, help="of zstd: ours writes 1")
    args = parser.parse_args()
    wall, cpu = time.perf_counter(), time.process_time()
    args.out.mkdir(parents=True)
    options = {"compression": "zstd", "compression_level": args.level}
    frames_writer = side_writer = None
    start = 0
    with h5py.File(args.file) as file:
        demos = sorted(file["data"], key=lambda name: int(name.removeprefix("demo_")))
        for episode, name in enumerate(demos):
            demo = file["data"][name]
            found: dict[str, np.ndarray] = {}
            demo.visititems(
                lambda path, item, found=found: (
                    found.update({path: item[:]}) if isinstance(item, h5py.Dataset) else None
                )
            )
            length = len(found["actions"])
            images = {k: v for k, v in found.items() if v.dtype == np.uint8 and v.ndim == 4}
            low = {k: v for k, v in found.items() if k not in images}
            state = np.concatenate([low[f"obs/{k}"] for k in STATE], axis=1).astype(np.float32)
            index = np.arange(length, dtype=np.int64)
            columns = {
                "observation.state": vectors(state),
                "observation.environment_state": vectors(low["obs/object"].astype(np.float32)),
                **{
                    f"observation.images.{k.removeprefix('obs/').removesuffix('_image')}": pictures(v)
                    for k, v in images.items()
                    if k.startswith("obs/")
                },
                "action": vectors(low["actions"].astype(np.float32)),
                "next.reward": pa.array(low["rewards"].astype(np.float32)),
                "next.done": pa.array(low["dones"] != 0),
                "next.success": pa.array(low["rewards"] >= 1.0),
                "timestamp": pa.array((index / 20).astype(np.float32)),
                "frame_index": pa.array(index),
                "episode_index": pa.array(np.full(length, episode)),
                "index": pa.array(index + start),
                "task_index": pa.array(np.zeros(length, np.int64)),
            }
            frames = pa.table(columns)
            side = pa.table({k: vectors(v) for k, v in low.items()})
            if frames_writer is None:
                frames_writer = pq.ParquetWriter(args.out / "frames.parquet", frames.schema, **options)
                side_writer = pq.ParquetWriter(args.out / "side.parquet", side.schema, **options)
            frames_writer.write_table(frames)
            side_writer.write_table(side)
            start += length
    for writer in (frames_writer, side_writer):
        if writer is not None:
            writer.close()
    size = sum(path.stat().st_size for path in args.out.iterdir())
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    print(json.dumps({"frames": start, "cpu_seconds": cpu, "wall_seconds": wall, "bytes": size}))


if __name__ == "__main__":
    main()
