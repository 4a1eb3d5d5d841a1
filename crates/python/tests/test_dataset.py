"""Data sets: LeRobot's keys and shapes, and the bits that training reads."""

from __future__ import annotations

import json
import pickle
import shutil
import signal
from pathlib import Path

import actrm
import numpy as np
import pytest
from conftest import RELEASE, output

FIXTURES = Path(__file__).parents[2] / "dataset/tests/fixtures"


def test_samples_have_lerobot_s_keys_and_shapes(lift: Path) -> None:
    ds = actrm.Dataset(lift, delta_timestamps={"action": range(16), "observation.state": [-0.05, 0.0]})
    sample = ds[0]
    shapes = {key: value.shape for key, value in sample.items() if isinstance(value, np.ndarray)}
    assert shapes == {
        "action": (16, 7),
        "action_is_pad": (16,),
        "observation.state": (2, 9),
        "observation.state_is_pad": (2,),
        "observation.environment_state": (10,),
        "next.reward": (),
        "next.done": (),
        "next.success": (),
        "timestamp": (),
        "frame_index": (),
        "episode_index": (),
        "index": (),
        "task_index": (),
    }
    assert {key: str(sample[key].dtype) for key in ("action", "action_is_pad", "next.done", "index", "timestamp")} == {
        "action": "float32",
        "action_is_pad": "bool",
        "next.done": "bool",
        "index": "int64",
        "timestamp": "float32",
    }
    assert sample["task"] == ds.tasks[0]
    assert sample["observation.state_is_pad"].tolist() == [True, False]
    assert (sample["observation.state"][0] == sample["observation.state"][1]).all()


def test_columns_have_the_types_that_lerobot_wrote() -> None:
    ds = actrm.Dataset(FIXTURES / "lerobot_texts", {"cells": [0, 1]})
    assert [(int(ds[i]["count"]), ds[i]["note"]) for i in (1, 3)] == [(-1, "step 1 of 0"), (100, "step 0 of 1")]
    last = actrm.Dataset(FIXTURES / "lerobot_texts", {"cells": [0, 1]}, episodes=[1]).batch([0, 1])
    assert last["note"] == ["step 0 of 1", "step 1 of 1"]
    assert str(last["count"].dtype) == str(last["cells"].dtype) == "int64" and last["count"].tolist() == [100, 99]
    assert last["cells"].tolist() == [[[0, 0], [1, -1]], [[1, -1], [1, -1]]]
    assert ds.features["cells"] == {"dtype": "int32", "shape": (2,), "names": ["row", "column"]}
    assert ds.features["note"]["names"] is None and ds.notes == []
    assert actrm.Dataset(FIXTURES / "lerobot_language").notes == [
        "language_persistent: samples lack columns of language",
        "language_events: samples lack columns of language",
    ]


def test_frames_without_a_text_large_numbers_and_tasks_within_an_episode(tmp_path: Path) -> None:
    """Of a set without statistics, whose episodes each name one task, and whose frames state another."""
    odd = Path(__file__).parent / "fixtures/lerobot_odd"
    ds = actrm.Dataset(odd)
    assert [ds[i]["note"] for i in (0, 1)] == ["step 0 of 0", None]
    for batch in (ds.batch([0, 1]), next(ds.batches(2)), next(ds.batches(2, threads=1))):
        assert batch["note"] == ["step 0 of 0", None] and batch["task"] == ["write", "erase"]
    assert ds.notes == ["count: whole numbers beyond 16777216 are rounded to float32"]
    # no frame's task is in the table
    bare = tmp_path / "bare"
    shutil.copytree(odd, bare)
    (bare / "meta/tasks.parquet").unlink()
    info = json.loads((bare / "meta/info.json").read_text())
    (bare / "meta/info.json").write_text(json.dumps({**info, "total_tasks": 0}))
    ds = actrm.Dataset(bare)
    assert "task" not in ds[0] and "samples have no task: " in " ".join(ds.notes)


def test_timestamps_are_those_of_the_files(tmp_path: Path) -> None:
    shutil.copytree(FIXTURES / "lerobot_texts", tmp_path / "set")
    path = tmp_path / "set/meta/info.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "fps": 10}))
    ds = actrm.Dataset(tmp_path / "set")
    assert ds.fps == 10 and ds.batch(range(5))["timestamp"].tolist() == np.float32([0, 0.05, 0.1, 0, 0.05]).tolist()


def test_rows_follow_each_other_and_end_with_the_episode(lift: Path) -> None:
    ds = actrm.Dataset(lift, delta_timestamps={"action": range(4)})
    plain = actrm.Dataset(lift)
    first = ds.episodes[0]
    assert first["dataset_from_index"] == 0
    end = first["dataset_to_index"]
    last = ds[end - 2]
    assert last["action_is_pad"].tolist() == [False, False, True, True]
    actions = np.stack([plain[i]["action"] for i in (end - 2, end - 1, end - 1, end - 1)])
    np.testing.assert_array_equal(last["action"], actions)
    assert [int(ds[i]["frame_index"]) for i in (0, end - 1, end)] == [0, end - 1, 0]
    assert float(ds[3]["timestamp"]) == np.float32(3 / ds.fps)
    assert int(ds[-1]["index"]) == len(ds) - 1


def test_whole_numbers_are_frames_and_floats_are_seconds(lift: Path) -> None:
    frames = actrm.Dataset(lift, {"action": range(-2, 3)})
    seconds = actrm.Dataset(lift, {"action": [k / frames.fps for k in range(-2, 3)]})
    for i in (0, 1, 77):
        np.testing.assert_array_equal(frames[i]["action"], seconds[i]["action"])
    with pytest.raises(actrm.Error, match=r"no frame of action at 0.03 s from another; there is one every 1/20 s"):
        actrm.Dataset(lift, {"action": [0.03]})


def test_a_split_is_its_episodes(lift: Path) -> None:
    whole, train, valid = actrm.Dataset(lift), actrm.Dataset(lift, split="train"), actrm.Dataset(lift, split="valid")
    assert len(train) + len(valid) == len(whole) == whole.num_frames
    chosen = [episode["episode_index"] for episode in train.episodes]
    assert sorted({int(train[i]["episode_index"]) for i in range(len(train))}) == chosen
    assert len(actrm.Dataset(lift, episodes=[3])) == whole.episodes[3]["length"]
    with pytest.raises(actrm.Error, match="no split tarin; there is .*train"):
        actrm.Dataset(lift, split="tarin")


def test_statistics_are_numpy_s(lift: Path) -> None:
    ds = actrm.Dataset(lift)
    actions = ds.batch(range(len(ds)))["action"].astype(np.float64)
    stats = ds.stats["action"]
    np.testing.assert_allclose(stats["mean"], actions.mean(0), atol=1e-12)
    np.testing.assert_allclose(stats["std"], actions.std(0), atol=1e-12)
    np.testing.assert_array_equal(stats["max"], actions.max(0))
    assert stats["count"].tolist() == [len(ds)]


def test_statistics_that_are_not_stored_are_absent(tmp_path: Path) -> None:
    shutil.copytree(FIXTURES / "lerobot_texts", tmp_path / "set")
    path = tmp_path / "set/meta/stats.json"
    kept = {
        name: {key: value for key, value in of.items() if not key.startswith("q")}
        for name, of in json.loads(path.read_text()).items()
    }
    path.write_text(json.dumps(kept))
    assert sorted(actrm.Dataset(tmp_path / "set").stats["action"]) == ["count", "max", "mean", "min", "std"]


def test_batches_are_what_training_reads(lift: Path) -> None:
    """Bit for bit, over the end of an epoch, in training's order."""
    horizon, size, seed, steps = 16, 64, 5, 40
    ds = actrm.Dataset(lift, {"action": range(horizon)}, split="train")
    assert steps * size > len(ds)
    program = RELEASE / "examples/training_windows"
    read = np.frombuffer(output(program, lift, "train", *map(str, (horizon, size, seed, steps))), np.float32)
    ours = []
    for batch in ds.batches(size, seed=seed, steps=steps):
        keys = ("observation.state", "observation.environment_state", "action", "action_is_pad")
        ours += [batch[key].astype(np.float32).ravel() for key in keys]
    ours = np.concatenate(ours)
    np.testing.assert_array_equal(ours.view(np.uint32), read.view(np.uint32))


@pytest.mark.parametrize("threads", [1, 3])
def test_threads_make_the_same_batches_ahead(lift: Path, threads: int) -> None:
    ds = actrm.Dataset(lift, {"action": range(4)})
    for options in ({"seed": 1}, {"seed": 1, "drop_last": True}, {"seed": 1, "steps": 90}, {}):
        alone, ahead = ds.batches(64, **options), ds.batches(64, **options, threads=threads)
        assert len(alone) == len(ahead)
        for left, (one, other) in zip(reversed(range(len(alone))), zip(alone, ahead, strict=True), strict=True):
            assert one.keys() == other.keys() and len(ahead) == left
            for key, value in one.items():
                np.testing.assert_array_equal(value, other[key])
                assert type(value) is type(other[key]) and getattr(value, "dtype", 0) == getattr(other[key], "dtype", 0)
        assert next(ahead, None) is None
    # given up early
    assert len(next(ds.batches(64, seed=1, threads=threads))["action"]) == 64
    with pytest.raises(ValueError, match="^threads: expected 0 to 256, found 257$"):
        ds.batches(64, threads=257)


@pytest.mark.parametrize("threads", [0, 1])
def test_a_batch_without_memory_for_it_is_an_exception(threads: int) -> None:
    ds = actrm.Dataset(FIXTURES / "lerobot_texts", {"action": range(100_000)})
    with pytest.raises(MemoryError):
        next(ds.batches(1 << 24, seed=1, steps=1, threads=threads))


def test_a_signal_takes_no_batch_away() -> None:
    class Enough(Exception):
        pass

    def enough(*_: object) -> None:
        raise Enough

    ds = actrm.Dataset(FIXTURES / "lerobot_texts", {"action": range(100_000)})
    before = signal.signal(signal.SIGALRM, enough)
    try:
        batches = ds.batches(300, seed=1, steps=3, threads=1)
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        with pytest.raises(Enough):
            next(batches)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    wanted = [batch["index"].tolist() for batch in actrm.Dataset(ds.root).batches(300, seed=1, steps=3)]
    assert [batch["index"].tolist() for batch in batches] == wanted


def test_batches_end_with_the_epoch(lift: Path) -> None:
    ds = actrm.Dataset(lift, split="train")
    batches = ds.batches(64, seed=1)
    assert len(batches) == -(-len(ds) // 64)
    seen = np.concatenate([batch["index"] for batch in batches])
    assert len(batches) == 0
    assert len(seen) == len(ds) == len(set(seen.tolist()))
    again = np.concatenate([batch["index"] for batch in ds.batches(64, seed=1)])
    np.testing.assert_array_equal(seen, again)
    other = np.concatenate([batch["index"] for batch in ds.batches(64, seed=1, epoch=1)])
    assert (seen != other).any()
    stream = np.concatenate([batch["index"] for batch in ds.batches(len(ds), seed=1, start=1, steps=1)])
    np.testing.assert_array_equal(stream, other)
    full = list(ds.batches(64, seed=1, drop_last=True))
    assert {len(batch["index"]) for batch in full} == {64} and len(full) == len(ds) // 64
    in_order = np.concatenate([batch["frame_index"] for batch in ds.batches(50)])
    assert in_order[:3].tolist() == [0, 1, 2]


def test_arrays_are_the_caller_s_own(lift: Path) -> None:
    ds = actrm.Dataset(lift)
    before = ds[0]["action"].copy()
    mine = ds[0]["action"]
    mine[:] = 7
    np.testing.assert_array_equal(ds[0]["action"], before)
    assert mine.flags.writeable and mine.flags.c_contiguous and mine.flags.aligned


def test_a_data_set_pickles(lift: Path) -> None:
    ds = actrm.Dataset(lift, {"action": range(3)}, split="valid")
    again = pickle.loads(pickle.dumps(ds))
    assert repr(again) == repr(ds) and len(again) == len(ds)
    for key, value in ds[5].items():
        np.testing.assert_array_equal(value, again[5][key])


def test_loaders_ask_for_several_at_once(lift: Path) -> None:
    ds = actrm.Dataset(lift, {"action": range(3)})
    several, batch = ds.__getitems__([4, 0, -1]), ds.batch([4, 0, -1])
    for key in ("action", "action_is_pad", "index", "next.done"):
        np.testing.assert_array_equal(np.stack([one[key] for one in several]), batch[key])
    assert batch["task"] == [one["task"] for one in several]


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"path": "nowhere"}, actrm.Error, "nowhere: data set: expected a LeRobotDataset v3.0 directory"),
        ({"delta_timestamps": {"acton": [0]}}, actrm.Error, "no column acton; there is action, "),
        ({"delta_timestamps": {"action": []}}, actrm.Error, "no sample with 0 rows of action"),
        ({"delta_timestamps": {"action": ["x"]}}, TypeError, "real number"),
        ({"delta_timestamps": {"action": [float("nan")]}}, actrm.Error, "no frame of action at NaN s"),
        ({"delta_timestamps": {"action": [1 << 70]}}, (actrm.Error, OverflowError), "."),
        ({"delta_timestamps": 3}, AttributeError, "items"),
        ({"episodes": [1000]}, actrm.Error, "no episode 1000; there is 0 to 49"),
        ({"episodes": [-1]}, ValueError, "episodes: expected a whole number from 0"),
        ({"cameras": ["front"]}, actrm.Error, "no camera front; there is no camera"),
        ({"split": "train", "episodes": [0]}, ValueError, "expected one of them"),
        ({"path": "a\0b"}, (ValueError, actrm.Error, OSError), "."),
    ],
)
def test_what_cannot_be_is_an_exception(lift: Path, arguments: dict, error: type, words: str) -> None:
    with pytest.raises(error, match=words):
        actrm.Dataset(**{"path": lift, **arguments})


def test_what_cannot_be_asked_for_is_an_exception(lift: Path) -> None:
    ds = actrm.Dataset(lift)
    for index in (len(ds), -len(ds) - 1, 1 << 62):
        with pytest.raises(IndexError, match="no sample"):
            ds[index]
    with pytest.raises(TypeError):
        ds["action"]  # type: ignore[call-overload]
    for size in (0, 1 << 40):
        with pytest.raises(ValueError, match="batch_size"):
            ds.batches(size)
    with pytest.raises(ValueError, match="steps"):
        ds.batches(4, steps=3)
    with pytest.raises(ValueError, match="steps: expected samples to make batches of, found none"):
        actrm.Dataset(lift, episodes=[]).batches(4, seed=1, steps=3)
    with pytest.raises(ValueError, match="more samples"):
        ds.batches(1 << 20, seed=1, steps=1, start=1 << 60)
    for arguments, words in (
        ({"start": 5}, "start: expected steps with it"),
        ({"epoch": 1}, "epoch: expected a seed with it and no steps, found no seed"),
        ({"seed": 1, "epoch": 1, "steps": 3}, "epoch: expected a seed with it and no steps, found steps"),
        ({"seed": -1}, "seed: expected a whole number from 0"),
        ({"threads": -1}, "threads: expected a whole number from 0"),
    ):
        with pytest.raises(ValueError, match=words):
            ds.batches(4, **arguments)
    with pytest.raises(TypeError, match="not an acceptable base type"):
        type("Mine", (actrm.Dataset,), {})
    far = actrm.Dataset(lift, {"action": [-(1 << 62), 0, 1 << 62]})[10]
    assert far["action_is_pad"].tolist() == [True, False, True]


def test_a_damaged_data_set_is_an_exception(lift: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad"
    shutil.copytree(lift, bad)
    for path in sorted(bad.rglob("*.parquet")) + [bad / "meta/info.json"]:
        whole = path.read_bytes()
        for cut in (0, len(whole) // 2, len(whole) - 4):
            path.write_bytes(whole[:cut])
            if "actrm" not in path.parts:
                with pytest.raises(actrm.Error):
                    actrm.Dataset(bad)
        path.write_bytes(whole)
    actrm.Dataset(bad)
