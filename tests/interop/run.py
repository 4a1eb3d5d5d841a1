"""What we write, opened by the others; what the others write, opened by us; shards run by Ray. Run by `make interop`.

LeRobot, robomimic and Ray are the released packages from PyPI. Every check compares numbers with their source, and any
difference ends the run with exit code 1.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["HF_HUB_OFFLINE"] = "1"

import h5py
import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[2]
BIN = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release"
STATE_KEYS = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")
ENV_KEYS = ("object",)


def run(command: list[str | Path], given: str = "") -> str:
    """Run a program and return its standard output; its error ends the run."""
    done = subprocess.run([*map(str, command)], input=given, text=True, capture_output=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(map(str, command))}: exit code {done.returncode}\n{done.stderr[-4000:]}")
    return done.stdout


def ours(program: str, *args: str | Path) -> str:
    """Run one of our programs."""
    return run([BIN / program, *args])


def demos(file: h5py.File) -> list[str]:
    """Ids of the demos, in numeric order."""
    return sorted(file["data"], key=lambda name: int(name.removeprefix("demo_")))


def expected_columns(demo: h5py.Group) -> dict[str, np.ndarray]:
    """The LeRobot columns that a demo must become, in float32 as LeRobot stores them."""
    obs = demo["obs"]
    return {
        "observation.state": np.concatenate([obs[k][:] for k in STATE_KEYS], axis=1).astype(np.float32),
        "observation.environment_state": np.concatenate([obs[k][:] for k in ENV_KEYS], axis=1).astype(np.float32),
        "action": demo["actions"][:].astype(np.float32),
        "next.reward": demo["rewards"][:].astype(np.float32),
    }


def open_lerobot(root: Path, **options: Any) -> Any:
    """Open a data set offline with LeRobot."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset(f"actrm/{root.name}", root=root, **options)


def compare_lerobot(source: Path, root: Path) -> str:
    """Every frame, episode boundary, task and statistic of a converted directory, against the HDF5 file."""
    data = open_lerobot(root)
    with h5py.File(source) as file:
        names = demos(file)
        assert data.num_episodes == len(names), (data.num_episodes, len(names))
        whole: dict[str, list[np.ndarray]] = {}
        start = 0
        for index, name in enumerate(names):
            columns = expected_columns(file["data"][name])
            length = len(columns["action"])
            episode = data.meta.episodes[index]
            bounds = (episode["dataset_from_index"], episode["dataset_to_index"])
            assert bounds == (start, start + length), (name, bounds)
            rows = data.hf_dataset[start : start + length]
            assert [int(i) for i in rows["frame_index"]] == list(range(length)), name
            assert {int(i) for i in rows["episode_index"]} == {index}, name
            for key, values in columns.items():
                got = torch.stack(list(rows[key])).numpy()
                assert got.dtype == values.dtype and np.array_equal(got, values), (name, key)
                whole.setdefault(key, []).append(values)
            start += length
        assert data.num_frames == start, (data.num_frames, start)
    for key, parts in whole.items():
        values = np.concatenate(parts).astype(np.float64).reshape(start, -1)
        for statistic, want in {
            "mean": values.mean(0),
            "std": values.std(0),
            "min": values.min(0),
            "max": values.max(0),
        }.items():
            np.testing.assert_allclose(data.meta.stats[key][statistic], want, atol=1e-6, err_msg=f"{key} {statistic}")
    item = data[data.num_frames - 1]
    assert isinstance(item["task"], str) and item["task"], item["task"]
    return f"{data.num_episodes} episodes, {data.num_frames} frames, task {item['task']!r}"


def compare_windows(source: Path, root: Path) -> str:
    """Action chunks and padding flags at the end of an episode, as LeRobot's delta_timestamps give them."""
    horizon = 16
    data = open_lerobot(root, delta_timestamps={"action": [k / 20 for k in range(horizon)]})
    with h5py.File(source) as file:
        actions = file["data"][demos(file)[0]]["actions"][:].astype(np.float32)
    for start in (0, len(actions) - 3, len(actions) - 1):
        item = data[start]
        rows = np.minimum(np.arange(start, start + horizon), len(actions) - 1)
        assert np.array_equal(item["action"].numpy(), actions[rows]), start
        assert np.array_equal(item["action_is_pad"].numpy(), np.arange(start, start + horizon) >= len(actions)), start
    return f"chunks of {horizon}, three places"


def compare_shards(source: Path, root: Path) -> str:
    """A set of several data files opens like one of a single file."""
    ours("actrm-data", "convert", source, root, "--file-size", "0.05")
    files = len(list((root / "data").glob("*/*.parquet")))
    assert files >= 3, f"{files} data files"
    return f"{files} files: {compare_lerobot(source, root)}"


def write_images(source: Path, path: Path) -> None:
    """Two demos of the source with two cameras, pixel values drawn at random."""
    rng = np.random.default_rng(1)
    with h5py.File(source) as file, h5py.File(path, "w") as out:
        for key, value in file["data"].attrs.items():
            out.require_group("data").attrs[key] = value
        total = 0
        for name in demos(file)[:2]:
            file.copy(file["data"][name], out["data"], name=name)
            length = len(file["data"][name]["actions"])
            total += length
            for key, side in (("agentview_image", 84), ("robot0_eye_in_hand_image", 60)):
                pixels = rng.integers(0, 256, (length, side, side, 3), dtype=np.uint8)
                out["data"][name]["obs"][key] = pixels
                out["data"][name]["next_obs"][key] = np.concatenate([pixels[1:], pixels[:1]])
        out["data"].attrs["total"] = total


def compare_images(source: Path, root: Path, form: str) -> str:
    """Every picture that LeRobot shows has the pixels of the file; its statistics are those of its pixels."""
    ours("actrm-data", "convert", source, root, "--images", form)
    data = open_lerobot(root)
    pictures = 0
    with h5py.File(source) as file:
        start = 0
        for name in demos(file):
            demo = file["data"][name]
            for key in ("agentview_image", "robot0_eye_in_hand_image"):
                column = f"observation.images.{key.removesuffix('_image')}"
                for index, pixels in enumerate(demo["obs"][key][:]):
                    shown = data[start + index][column]
                    assert shown.dtype == torch.float32 and shown.shape[0] == 3, (shown.dtype, shown.shape)
                    levels = np.rint(shown.numpy() * 255).astype(np.uint8).transpose(1, 2, 0)
                    assert np.array_equal(levels, pixels), (name, key, index)
                    pictures += 1
                assert np.shape(data.meta.stats[column]["mean"]) == (3, 1, 1), column
            start += len(demo["actions"])
        first = data.meta.stats["observation.images.agentview"]
        pixels = np.concatenate([file["data"][n]["obs/agentview_image"][:] for n in demos(file)]) / 255.0
        np.testing.assert_allclose(np.ravel(first["mean"]), pixels.mean((0, 1, 2)), atol=1e-6)
        np.testing.assert_allclose(np.ravel(first["std"]), pixels.std((0, 1, 2)), atol=1e-6)
    back = root.with_suffix(".hdf5")
    ours("actrm-data", "export", root, back)
    compare_trees(source, back)
    return f"{pictures} pictures, pixel by pixel, and back"


def train_lerobot(root: Path, out: Path) -> str:
    """LeRobot trains its ACT on one of our sets for two steps, as its own example does, and stores what it has."""
    from lerobot.configs.types import FeatureType
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.utils.feature_utils import dataset_to_policy_features

    torch.manual_seed(0)
    meta = open_lerobot(root).meta
    features = dataset_to_policy_features(meta.features)
    config = ACTConfig(
        input_features={k: f for k, f in features.items() if f.type in (FeatureType.STATE, FeatureType.ENV)},
        output_features={k: f for k, f in features.items() if f.type is FeatureType.ACTION},
        chunk_size=8,
        n_action_steps=8,
        dim_model=64,
        n_heads=4,
        dim_feedforward=128,
        device="cpu",
    )
    policy = ACTPolicy(config).train()
    before, after = make_pre_post_processors(config, dataset_stats=meta.stats)
    data = open_lerobot(root, delta_timestamps={"action": [k / meta.fps for k in config.action_delta_indices]})
    batches = iter(torch.utils.data.DataLoader(data, batch_size=16, shuffle=True))
    optimiser = torch.optim.AdamW(policy.get_optim_params(), lr=1e-3)
    losses: list[float] = []
    for _ in range(2):
        loss, _ = policy.forward(before(next(batches)))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert np.isfinite(losses).all(), losses
    for part in (policy, before, after):
        part.save_pretrained(out)
    return f"2 steps, loss {losses[0]:.1f} then {losses[1]:.1f}"


def compare_actions(root: Path, zoo: Path, entry: str, checkpoint: Path) -> str:
    """An entry and a checkpoint of LeRobot give the same action chunks to 1e-5, raw observation to raw action."""
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    data = open_lerobot(root)
    rows = [data[i] for i in (0, 17, 400, data.num_frames - 1)]
    keys = ("observation.state", "observation.environment_state")
    asked = [{key.removeprefix("observation."): row[key].tolist() for key in keys} for row in rows]
    answers = np.array(json.loads(run([BIN / "examples" / "predict", zoo, entry], json.dumps(asked))))
    policy = ACTPolicy.from_pretrained(checkpoint).eval()
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(checkpoint))
    largest = 0.0
    for row, answer in zip(rows, answers, strict=True):
        with torch.no_grad():
            chunk = policy.predict_action_chunk(before({key: row[key] for key in keys}))
        theirs = torch.stack([after(chunk[:, i]) for i in range(chunk.shape[1])], 1)[0].numpy()
        assert theirs.shape == answer.shape, (theirs.shape, answer.shape)
        largest = max(largest, float(np.abs(theirs - answer).max()))
    assert largest <= 1e-5, f"{entry}: actions differ by {largest:g}"
    return f"{len(rows)} chunks of {answers.shape[1]} x {answers.shape[2]}, largest difference {largest:.1e}"


def train_ours(root: Path, folder: Path, steps: int) -> Path:
    """The zoo in which we put an ACT of a few steps, as lift-act@1."""
    zoo, changes = folder / "zoo", f"train.steps={steps}"
    ours("actrm-zoo", "train", "act_lift", "--data", root, "--zoo", zoo, "--runs", folder / "runs", changes)
    return zoo


def export_entry(root: Path, folder: Path) -> str:
    """An entry that we trained answers the same in LeRobot."""
    zoo = train_ours(root, folder, 5)
    ours("actrm-zoo", "export", "lerobot", "lift-act@1", folder / "lift-act", "--zoo", zoo)
    return compare_actions(root, zoo, "lift-act@1", folder / "lift-act")


def import_entry(root: Path, folder: Path) -> str:
    """What LeRobot trained answers the same as an entry of ours."""
    zoo, checkpoint = folder / "zoo", folder / "trained"
    ours("actrm-zoo", "import", "lerobot", checkpoint, "--name", "theirs", "--task", "Lift", "--zoo", zoo)
    return compare_actions(root, zoo, "theirs@1", checkpoint)


def compare_robomimic(path: Path) -> str:
    """robomimic's SequenceDataset opens the file and gives its numbers."""
    from robomimic.utils.dataset import SequenceDataset

    keys = (*STATE_KEYS, *ENV_KEYS)
    data = SequenceDataset(
        hdf5_path=str(path),
        obs_keys=keys,
        dataset_keys=("actions", "rewards", "dones"),
        seq_length=10,
        frame_stack=1,
        pad_seq_length=True,
        hdf5_cache_mode=None,
        hdf5_use_swmr=False,
        filter_by_attribute="train",
        load_next_obs=True,
    )
    with h5py.File(path) as file:
        train = [name.decode() for name in file["mask/train"][:]]
        assert sum(len(file["data"][name]["actions"]) for name in train) == len(data), len(data)
        name = data.demos[0]
        first = data[0]
        assert np.array_equal(first["actions"], file["data"][name]["actions"][:10]), name
        for key in keys:
            assert np.array_equal(first["obs"][key], file["data"][name]["obs"][key][:10]), (name, key)
            assert np.array_equal(first["next_obs"][key], file["data"][name]["next_obs"][key][:10]), (name, key)
    return f"{len(data)} sequences of 10 steps from {len(train)} demos"


def compare_trees(one: Path, two: Path) -> str:
    """Two HDF5 files: every group, data set, dtype, shape, attribute and value the same."""

    def leaves(file: h5py.File) -> dict[str, Any]:
        found: dict[str, Any] = {}

        def visit(name: str, node: Any) -> None:
            shape = (node.dtype.str, node.shape, node[()].tobytes()) if isinstance(node, h5py.Dataset) else "group"
            found[name] = (shape, {key: str(value) for key, value in node.attrs.items()})

        visit("/", file)
        file.visititems(visit)
        return found

    with h5py.File(one) as a, h5py.File(two) as b:
        left, right = leaves(a), leaves(b)
    assert left.keys() == right.keys(), left.keys() ^ right.keys()
    for name, leaf in left.items():
        assert leaf == right[name], name
    return f"{len(left)} groups and data sets"


def write_lerobot(root: Path) -> int:
    """A small data set written by LeRobot itself; returns its number of frames."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features = {
        "observation.state": {"dtype": "float32", "shape": (3,), "names": None},
        "observation.environment_state": {"dtype": "float32", "shape": (2,), "names": None},
        "action": {"dtype": "float32", "shape": (2,), "names": None},
    }
    data = LeRobotDataset.create("actrm/theirs", fps=20, features=features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    lengths = (7, 11, 5)
    for length in lengths:
        for _ in range(length):
            frame = {key: rng.normal(size=f["shape"]).astype(np.float32) for key, f in features.items()}
            data.add_frame({**frame, "task": "wander"})
        data.save_episode()
    data.finalize()
    return sum(lengths)


def open_theirs(folder: Path) -> str:
    """A LeRobot-written data set opens in ours, with its frames, and is found whole."""
    frames = write_lerobot(folder / "theirs")
    report = json.loads(ours("actrm-data", "inspect", "--json", folder / "theirs"))
    assert report["frames"] == frames, report
    ours("actrm-data", "validate", folder / "theirs")
    return f"{frames} frames"


def evaluate_on_ray(root: Path, folder: Path) -> str:
    """The driver for Ray: shards on a cluster of two cores, merged, are the bytes of an evaluation in one piece."""
    # enough steps for some of the episodes to succeed
    zoo, whole = train_ours(root, folder, 60), folder / "whole"
    asked = ["lift-act@1", "--episodes", "6", "--max-steps", "60", "--zoo", str(zoo)]
    program = BIN / "actrm-zoo"
    driver = [sys.executable, ROOT / "tools" / "cluster" / "ray_eval.py", "--shards", "2", "--program", program, "--"]
    os.environ.setdefault("ACTRM_PYTHON", str(ROOT / ".venv" / "bin" / "python"))
    shown = run([*driver, *asked])
    assert "shard 1/2: ok" in shown and "shard 2/2: ok" in shown, shown
    ours("actrm-zoo", "eval", *asked, "--results", whole)
    (merged,) = (path for path in (zoo / "results").iterdir() if "_shard-" not in path.name)
    expected = (whole / merged.name / "outcomes.parquet").read_bytes()
    assert (merged / "outcomes.parquet").read_bytes() == expected, merged
    # a shard that cannot run is told of, and nothing is merged
    unknown = ["no-such-entry@1", *asked[1:]]
    failed = subprocess.run([*map(str, driver), *unknown], text=True, capture_output=True, check=False)
    assert failed.returncode == 1 and "2 of 2 shards failed" in failed.stderr, failed
    return shown.splitlines()[-1].split(" (")[0]


def main() -> None:
    """Run every check; the first difference ends it."""
    # LeRobot warns of video decoders that are not needed here, and of our entry in info.json
    logging.disable(logging.WARNING)
    source = ROOT / "data" / "lift.hdf5"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # read when LeRobot is imported: its copies of our data sets go when we go
        os.environ["HF_HOME"] = str(folder / "hf")
        root = folder / "lift"
        ours("actrm-data", "convert", source, root)
        exported = folder / "exported.hdf5"
        ours("actrm-data", "export", root, exported)
        images = folder / "images.hdf5"
        write_images(source, images)
        checks: dict[str, Callable[[], str]] = {
            "LeRobot opens the converted data set": lambda: compare_lerobot(source, root),
            "LeRobot pads action chunks as we do": lambda: compare_windows(source, root),
            "LeRobot opens a set of several files": lambda: compare_shards(source, folder / "shards"),
            "LeRobot shows PNG pictures pixel by pixel": lambda: compare_images(images, folder / "png", "png"),
            "LeRobot shows PPM pictures pixel by pixel": lambda: compare_images(images, folder / "ppm", "ppm"),
            "LeRobot trains its ACT on our set": lambda: train_lerobot(root, folder / "trained"),
            "our entry answers the same in LeRobot": lambda: export_entry(root, folder),
            "LeRobot's policy answers the same in ours": lambda: import_entry(root, folder),
            "robomimic reads the collected file": lambda: compare_robomimic(source),
            "export rebuilds the source": lambda: compare_trees(source, exported),
            "robomimic reads the exported file": lambda: compare_robomimic(exported),
            "a data set written by LeRobot opens in ours": lambda: open_theirs(folder),
            "shards on a Ray cluster make one evaluation": lambda: evaluate_on_ray(root, folder / "ray"),
        }
        for title, check in checks.items():
            print(f"{title:<48} ", end="", flush=True)
            print(f"ok   {check()}")
    print(f"{len(checks)} passed, 0 failed")


if __name__ == "__main__":
    sys.exit(main())
