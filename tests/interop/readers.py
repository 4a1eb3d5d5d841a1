"""Ray Data, Daft, DuckDB and Hugging Face's `datasets` open what we write, and find the numbers of the source in it."""

from __future__ import annotations

import importlib
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

Rows = list[dict[str, Any]]
# columns of an episode, as LeRobot names them
Episode = dict[str, np.ndarray]


def by_ray(root: Path, cameras: Sequence[str]) -> tuple[Rows, Rows]:
    """Frames by Ray Data's reader of LeRobot's sets, which decodes images; episodes by that of Parquet."""
    import ray

    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    try:
        ray.data.DataContext.get_current().enable_progress_bars = False
        frames = ray.data.read_lerobot(str(root)).take_all()
        return frames, ray.data.read_parquet(str(root / "meta/episodes")).take_all()
    finally:
        ray.shutdown()


def by_daft(root: Path, cameras: Sequence[str]) -> tuple[Rows, Rows]:
    """Both by Daft's reader of LeRobot's sets; it decodes videos by itself, images when asked."""
    import daft

    frames = daft.datasets.lerobot.read(str(root), load_video_frames=True)
    for key in cameras:
        if frames.schema()[key].dtype.is_struct():
            frames = frames.with_column(key, daft.col(key)["bytes"].decode_image())
    return frames.to_pylist(), daft.datasets.lerobot.read_episodes(str(root)).to_pylist()


def by_duckdb(root: Path, cameras: Sequence[str]) -> tuple[Rows, Rows]:
    """Both by DuckDB from the Parquet files; it gives images as the files that they are."""
    import duckdb

    def rows(pattern: str) -> Rows:
        found = duckdb.sql(f"SELECT * FROM '{root / pattern}'")
        return [dict(zip(found.columns, row, strict=True)) for row in found.fetchall()]

    frames = rows("data/*/*.parquet")
    for row in frames:
        row.update({key: Image.open(io.BytesIO(row[key]["bytes"])) for key in cameras})
    return frames, rows("meta/episodes/*/*.parquet")


def by_datasets(root: Path, cameras: Sequence[str]) -> tuple[Rows, Rows]:
    """Both by `datasets`, which knows from the files that a column holds images."""
    from datasets import load_dataset

    episodes = load_dataset("parquet", data_files=str(root / "meta/episodes/*/*.parquet"), split="train")
    return list(load_dataset(str(root), data_dir="data", split="train")), list(episodes)


READERS: dict[str, Callable[[Path, Sequence[str]], tuple[Rows, Rows]]] = {
    "Ray Data": by_ray,
    "Daft": by_daft,
    "DuckDB": by_duckdb,
    "datasets": by_datasets,
}


def compare(root: Path, episodes: list[Episode], task: str, readers: Sequence[str] = tuple(READERS)) -> str:
    """Every frame and every episode that these readers find in a set, against those of its source."""
    whole = {key: np.concatenate([episode[key] for episode in episodes]) for key in episodes[0]}
    lengths = [len(episode["action"]) for episode in episodes]
    whole["episode_index"] = np.repeat(np.arange(len(episodes)), lengths)
    whole["frame_index"] = np.concatenate([np.arange(length) for length in lengths])
    whole["index"] = np.arange(sum(lengths))
    ends = np.cumsum(lengths).tolist()
    bounds = [(i, n, end - n, end, [task]) for i, (n, end) in enumerate(zip(lengths, ends, strict=True))]
    cameras = [key for key in whole if key.startswith("observation.images.")]
    for reader in readers:
        frames, found = READERS[reader](root, cameras)
        frames.sort(key=lambda row: row["index"])
        for key, values in whole.items():
            got = np.array([np.asarray(row[key]) for row in frames])
            assert got.shape == values.shape, (reader, key, got.shape, values.shape)
            assert np.array_equal(got, values), (reader, key)
        assert all(row.get("task", task) == task for row in frames), reader
        names = ("episode_index", "length", "dataset_from_index", "dataset_to_index", "tasks")
        told = sorted(tuple(row[name] for name in names) for row in found)
        assert [(*row[:4], list(row[4])) for row in told] == bounds, (reader, told)
    return f"{', '.join(readers)}: {len(episodes)} episodes, {sum(lengths)} frames, {len(whole)} columns"


def compare_videos(root: Path, episodes: list[Episode], task: str) -> str:
    """The same of a set with videos, by readers that decode them: images are those that our package shows."""
    import actrm

    data, start = actrm.Dataset(root), 0
    for episode in episodes:
        samples = [data[start + step] for step in range(len(episode["action"]))]
        for key in (key for key in samples[0] if key.startswith("observation.images.")):
            shown = np.stack([sample[key] for sample in samples])
            episode[key] = np.rint(shown * 255).astype(np.uint8).transpose(0, 2, 3, 1)
        start += len(samples)
    try:
        # Ray Data decodes by it, which loads libraries of FFmpeg's that may not be there
        importlib.import_module("torchcodec.decoders")
    except (ImportError, RuntimeError, OSError):
        return compare(root, episodes, task, ["Daft"])
    return compare(root, episodes, task, ["Ray Data", "Daft"])
