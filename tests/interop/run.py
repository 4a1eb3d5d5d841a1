"""What we write, opened by the others; what the others write, opened by us; shards run by Ray. Run by `make interop`.

LeRobot, robomimic, Ray and the other readers are the released packages from PyPI. Every check compares numbers with
their source, and any difference ends the run with exit code 1.
"""

from __future__ import annotations

import importlib
import io
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

import depth
import h5py
import numpy as np
import onnx_check
import python_door
import readers
import robomimic_training
import sequential
import served
import shards
import torch
import vla_eval_client
from PIL import Image

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


def episodes_of(source: Path, cameras: tuple[str, ...] = ()) -> list[dict[str, np.ndarray]]:
    """What the columns of a converted set must hold, episode by episode."""
    with h5py.File(source) as file:
        found = [file["data"][name] for name in demos(file)]
        images = [{f"observation.images.{c}": demo[f"obs/{c}_image"][:] for c in cameras} for demo in found]
        return [expected_columns(demo) | seen for demo, seen in zip(found, images, strict=True)]


def write_jpeg_recording(folder: Path) -> None:
    """Two episodes as ALOHA's newer recordings: JPEG files in rows as long as the longest, the rest zeros."""
    rng = np.random.default_rng(4)
    folder.mkdir()
    for episode in range(2):
        files: list[bytes] = []
        for step in range(6):
            ramp = np.add.outer(np.arange(48) * 3, np.arange(64) * 2)[..., None] + np.array([0, 40, 90]) + step * 9
            picture = np.clip(ramp + rng.integers(-9, 10, (48, 64, 3)), 0, 255).astype(np.uint8)
            out = io.BytesIO()
            Image.fromarray(picture).save(out, "JPEG", quality=50 + 5 * step)
            files.append(out.getvalue())
        longest = max(map(len, files))
        rows = np.stack([np.frombuffer(file.ljust(longest, b"\0"), np.uint8) for file in files])
        with h5py.File(folder / f"episode_{episode}.hdf5", "w") as out_file:
            out_file["action"] = rng.normal(size=(6, 14)).astype(np.float32)
            out_file["observations/qpos"] = rng.normal(size=(6, 14)).astype(np.float32)
            out_file["observations/images/top"] = rows
            out_file["compress_len"] = np.array([[len(file) for file in files]], np.float32)


def compare_jpeg(folder: Path, root: Path) -> str:
    """LeRobot shows the recorded JPEG files, which it opens as we left them."""
    write_jpeg_recording(folder)
    ours("actrm-data", "convert", folder, root, "--fps", "50")
    data = open_lerobot(root)
    for episode in range(2):
        with h5py.File(folder / f"episode_{episode}.hdf5") as file:
            for step, row in enumerate(file["observations/images/top"][:]):
                shown = data[episode * 6 + step]["observation.images.top"]
                recorded = np.asarray(Image.open(io.BytesIO(row.tobytes())))
                levels = np.rint(shown.numpy() * 255).astype(np.uint8).transpose(1, 2, 0)
                assert np.array_equal(levels, recorded), (episode, step)
    pixels = np.stack([data[i]["observation.images.top"].numpy() for i in range(12)])
    # decoders differ by some levels where colours are stored at half the resolution
    mean = np.ravel(data.meta.stats["observation.images.top"]["mean"])
    np.testing.assert_allclose(mean, pixels.mean((0, 2, 3)), atol=2e-3)
    return "12 pictures, pixel by pixel"


def frames_of(data: Any, episode: int) -> list[dict[str, Any]]:
    """What LeRobot gives for every frame of an episode."""
    bounds = data.meta.episodes[episode]
    return [data[i] for i in range(bounds["dataset_from_index"], bounds["dataset_to_index"])]


def same_episode(one: Any, episode: int, two: Any, other: int, names: dict[str, str]) -> int:
    """Compare an episode of one set with one of another, frame by frame, under other names; returns its length."""
    ours_now, before = frames_of(one, episode), frames_of(two, other)
    assert len(ours_now) == len(before), (len(ours_now), len(before))
    for now, then in zip(ours_now, before, strict=True):
        assert now["task"] == then["task"], (now["task"], then["task"])
        for key in two.meta.features:
            if key not in ("episode_index", "index", "task_index"):
                a, b = now[names.get(key, key)], then[key]
                assert a == b if isinstance(b, str) else torch.equal(a, b), (key, episode, other)
        assert int(now["episode_index"]) == episode
    return len(before)


def edit_and_open(root: Path, folder: Path) -> str:
    """Edits of a set: LeRobot opens each result and shows in it what the source shows; statistics follow."""
    folder.mkdir()
    source = open_lerobot(root)
    last = source.num_episodes - 1
    frames = 0
    ours("actrm-data", "edit", "drop", root, folder / "dropped", "--episodes", "0")
    ours("actrm-data", "edit", "keep", root, folder / "kept", "--episodes", f"0,{last}")
    ours("actrm-data", "edit", "split", root, folder / "parts", "--counts", f"a=1,b={last}")
    ours("actrm-data", "edit", "merge", folder / "parts/b", folder / "parts/a", "--out", folder / "merged")
    key = (source.meta.camera_keys or ["observation.environment_state"])[-1]
    ours("actrm-data", "edit", "rename", folder / "kept", folder / "renamed", "--feature", f"{key}=observation.renamed")
    everything = list(range(last + 1))
    expected = {
        "dropped": everything[1:],
        "kept": [0, last],
        "parts/a": [0],
        "parts/b": everything[1:],
        "merged": [*everything[1:], 0],
        "renamed": [0, last],
    }
    for name, episodes in expected.items():
        ours("actrm-data", "validate", folder / name)
        data = open_lerobot(folder / name)
        assert data.num_episodes == len(episodes), (name, data.num_episodes)
        names = {key: "observation.renamed"} if name == "renamed" else {}
        frames += sum(same_episode(data, i, source, episode, names) for i, episode in enumerate(episodes))
        actions = np.stack([data.hf_dataset[i]["action"].numpy() for i in range(data.num_frames)]).astype(np.float64)
        for statistic, want in {"mean": actions.mean(0), "std": actions.std(0), "max": actions.max(0)}.items():
            np.testing.assert_allclose(data.meta.stats["action"][statistic], want, atol=1e-6, err_msg=name)
    return f"{len(expected)} results, {frames} frames"


def train_lerobot(root: Path, out: Path, pictures: bool = False, **options: Any) -> str:
    """LeRobot trains its ACT on one of our sets for two steps, as its own example does, and stores what it has."""
    from lerobot.configs.types import FeatureType
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.utils.feature_utils import dataset_to_policy_features

    torch.manual_seed(0)
    meta = open_lerobot(root).meta
    features = dataset_to_policy_features(meta.features)
    seen = {FeatureType.STATE, FeatureType.VISUAL if pictures else FeatureType.ENV}
    config = ACTConfig(
        input_features={k: f for k, f in features.items() if f.type in seen},
        pretrained_backbone_weights=None,
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
    deltas = {"action": [k / meta.fps for k in config.action_delta_indices]}
    data = open_lerobot(root, delta_timestamps=deltas, **options)
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


def video_backends() -> list[str]:
    """Those of LeRobot's video readers that work here; torchcodec loads libraries of FFmpeg's that may not be there."""
    found: list[str] = []
    for name, module in (("torchcodec", "torchcodec.decoders"), ("pyav", "av")):
        try:
            importlib.import_module(module)
        except (ImportError, RuntimeError, OSError) as error:
            print(f"[{name}: {str(error).splitlines()[0]}]", end=" ")
        else:
            found.append(name)
    assert found, "LeRobot has no video reader here"
    return found


def compare_videos(source: Path, root: Path, encoder: str) -> str:
    """A video set of ours: LeRobot's readers see the pictures that we see, bit by bit, and LeRobot trains on it."""
    asked = "import imageio_ffmpeg; print(imageio_ffmpeg.get_ffmpeg_exe())"
    os.environ["ACTRM_FFMPEG"] = run([ROOT / ".venv" / "bin" / "python", "-c", asked]).strip()
    ours("actrm-data", "convert", source, root, "--video", "--video-encoder", encoder)
    said: list[str] = []
    for backend in video_backends():
        data = open_lerobot(root, video_backend=backend)
        pictures = 0
        for index, episode in enumerate(data.meta.episodes):
            start, length = episode["dataset_from_index"], episode["length"]
            for camera in data.meta.camera_keys:
                sheet = root.with_suffix(f".{backend}.{index}.{camera}.png")
                chosen = ["--episode", str(index), "--column", camera, "--frames", str(length)]
                ours("actrm-data", "plot", root, *chosen, "--out", sheet)
                drawn = np.asarray(Image.open(sheet))
                side = drawn.shape[0]
                for frame in range(length):
                    shown = data[start + frame][camera]
                    levels = np.rint(shown.numpy() * 255).astype(np.uint8).transpose(1, 2, 0)
                    mine = drawn[:, frame * (side + 4) : frame * (side + 4) + side]
                    assert np.array_equal(levels, mine), (backend, camera, index, frame)
                    pictures += 1
        trained = train_lerobot(root, root.with_suffix(f".{backend}.trained"), pictures=True, video_backend=backend)
        said.append(f"{backend}: {pictures} pictures, {trained}")
    return "; ".join(said)


def compare_actions(root: Path, zoo: Path, entry: str, checkpoint: Path, pictures: bool = False) -> str:
    """An entry and a checkpoint of LeRobot give the same action chunks to 1e-5, raw observation to raw action."""
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    data = open_lerobot(root)
    rows = [data[i] for i in (0, 17, data.num_frames // 2, data.num_frames - 1)]
    cameras = tuple(data.meta.camera_keys) if pictures else ()
    keys = ("observation.state", *(cameras or ("observation.environment_state",)))

    def given(row: dict[str, Any], key: str) -> list[Any]:
        if key not in cameras:
            return row[key].tolist()
        return np.rint(row[key].numpy() * 255).astype(int).transpose(1, 2, 0).ravel().tolist()

    asked = [{key.removeprefix("observation."): given(row, key) for key in keys} for row in rows]
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


def export_onnx(root: Path, folder: Path) -> str:
    """Exported ACT and BC answer the same in onnxruntime."""
    zoo, changes = folder / "zoo-bc", "train.steps=20"
    ours("actrm-zoo", "train", "bc_lift", "--data", root, "--zoo", zoo, "--runs", folder / "runs", changes)
    return onnx_check.check(ROOT / "zoo", zoo, folder / "onnx", BIN / "examples" / "predict", ours, run)


def read_by_the_hub(root: Path, folder: Path) -> str:
    """The cards of entries, read by the Hub's own library, with the results that the leaderboard has."""
    from huggingface_hub import ModelCard

    zoo = train_ours(root, folder, 2)
    sealed = ModelCard((zoo / "lift-act" / "1" / "README.md").read_text(), ignore_metadata_errors=False)
    assert sealed.data.eval_results is None, "no result was measured when it was sealed"
    ours("actrm-zoo", "export", "hub", "lift-act@1", folder / "unmeasured", "--zoo", zoo)
    bare = ModelCard((folder / "unmeasured" / "README.md").read_text(), ignore_metadata_errors=False)
    assert bare.content == sealed.content

    out = folder / "lift-act"
    ours("actrm-zoo", "export", "hub", "lift-act@1", out, "--zoo", ROOT / "zoo")
    card = ModelCard((out / "README.md").read_text(), ignore_metadata_errors=False)
    data = card.data.to_dict()
    for given in (data, sealed.data.to_dict()):
        assert given["library_name"] == "actrm" and given["license"] == "apache-2.0", given
        assert given["pipeline_tag"] == "robotics" and {"robotics", "act", "Lift"} <= set(given["tags"]), given
        assert "datasets" not in given, given
    found = {(r.dataset_config, r.dataset_split): r for r in card.data.eval_results or []}
    assert set(found) == {("lift-v1", "dev"), ("lift-v1", "test")}, found.keys()
    test = found["lift-v1", "test"]
    assert (test.task_type, test.dataset_type, test.metric_type) == ("robotics", "Lift", "success_rate"), test
    assert test.metric_value == 100.0 and test.metric_args["episodes"] == 200, test
    assert "95% interval 98.1-100.0" in test.metric_name, test
    assert card.text.lstrip().startswith("# lift-act@1"), card.text[:80]
    # what is pushed and pulled again is the entry
    pulled = folder / "pulled" / "lift-act"
    pulled.mkdir(parents=True)
    out.rename(pulled / "1")
    said = ours("actrm-zoo", "verify", "--deep", "--zoo", folder / "pulled")
    assert "lift-act@1: 5 files and 0 results are as they were made" in said, said
    return f"{len(found)} results, {test.metric_name}"


def import_entry(root: Path, folder: Path) -> str:
    """What LeRobot trained answers the same as an entry of ours."""
    zoo, checkpoint = folder / "zoo", folder / "trained"
    ours("actrm-zoo", "import", "lerobot", checkpoint, "--name", "theirs", "--task", "Lift", "--zoo", zoo)
    return compare_actions(root, zoo, "theirs@1", checkpoint)


def export_seeing_entry(root: Path, folder: Path) -> str:
    """An entry of ours that sees answers the same in LeRobot; one that crops its pictures is refused by name."""
    zoo = folder / "zoo"
    cameras = json.dumps([key.removeprefix("observation.images.") for key in open_lerobot(root).meta.camera_keys])
    where = ["--data", root, "--zoo", zoo, "--runs", folder / "runs", "train.steps=2", "train.batch_size=4"]
    sees = [f"data.cameras={cameras}", "data.env_keys=[]", "policy.vision.width=64", "policy.vision.norm=frozen"]
    small = ["policy.dim_model=64", "policy.n_heads=4", "policy.dim_feedforward=128", "policy.n_encoder_layers=1"]
    ours("actrm-zoo", "train", "act_lift", "entry=seeing", *sees, *small, *where)
    ours("actrm-zoo", "export", "lerobot", "seeing@1", folder / "seeing", "--zoo", zoo)
    ours("actrm-zoo", "train", "act_lift", "entry=cropping", *sees, *small, *where, "policy.vision.crop=48")
    refused = subprocess.run(
        [BIN / "actrm-zoo", "export", "lerobot", "cropping@1", folder / "cropping", "--zoo", zoo],
        text=True,
        capture_output=True,
        check=False,
    )
    assert refused.returncode == 1 and "crop" in refused.stderr, refused
    return compare_actions(root, zoo, "seeing@1", folder / "seeing", pictures=True)


def import_seeing_entry(root: Path, folder: Path) -> str:
    """LeRobot's ACT with pictures answers the same as an entry of ours."""
    zoo, checkpoint = folder / "zoo", folder / "trained"
    train_lerobot(root, checkpoint, pictures=True)
    ours("actrm-zoo", "import", "lerobot", checkpoint, "--name", "theirs", "--task", "Lift", "--zoo", zoo)
    return compare_actions(root, zoo, "theirs@1", checkpoint, pictures=True)


def train_seeing(folder: Path) -> Path:
    """An entry of ours that sees Lift through two cameras, hardly trained."""
    seen = folder / "seen.hdf5"
    folder.mkdir()
    cameras = ["--cameras", "agentview,robot0_eye_in_hand", "--image-size", "24", "--fast-render", "--no-next-obs"]
    ours("actrm-data", "collect", "--task", "Lift", "--episodes", "2", *cameras, "--out", seen)
    where = ["--data", seen, "--zoo", folder / "zoo", "--runs", folder / "runs", "train.steps=2", "train.batch_size=4"]
    small = ["policy.dim_model=16", "policy.n_heads=2", "policy.dim_feedforward=16", "policy.vision.crop=20"]
    ours("actrm-zoo", "train", "act_lift_image", *where, *small)
    return folder / "zoo" / "lift-act-image"


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


def write_lerobot(root: Path, form: str | None = None) -> int:
    """A small data set written by LeRobot itself, with a camera where a form is given; returns its number of frames."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features: dict[str, Any] = {
        "observation.state": {"dtype": "float32", "shape": (3,), "names": None},
        "observation.environment_state": {"dtype": "float32", "shape": (2,), "names": None},
        "action": {"dtype": "float32", "shape": (2,), "names": None},
    }
    if form:
        features["note"] = {"dtype": "string", "shape": (1,), "names": None}
        features["next.reward"] = {"dtype": "float64", "shape": (1,), "names": None}
        features["count"] = {"dtype": "int64", "shape": (1,), "names": None}
        features["cells"] = {"dtype": "int32", "shape": (2,), "names": ["row", "column"]}
        pictures = {"dtype": form, "shape": (64, 64, 3), "names": ["height", "width", "channels"]}
        features["observation.images.front"] = pictures
    data = LeRobotDataset.create("actrm/theirs", fps=20, features=features, root=root, use_videos=form == "video")
    rng = np.random.default_rng(0)
    lengths = (7, 11, 5)

    def value(key: str, feature: dict[str, Any], step: int) -> Any:
        if key == "note":
            return f"step {step}"
        if key.startswith("observation.images."):
            return rng.integers(0, 256, feature["shape"], dtype=np.uint8)
        if feature["dtype"].startswith("int"):
            return rng.integers(-(1 << 24), 1 << 24, feature["shape"], dtype=feature["dtype"], endpoint=True)
        return rng.normal(size=feature["shape"]).astype(feature["dtype"])

    for episode, length in enumerate(lengths):
        for step in range(length):
            frame = {key: value(key, feature, step) for key, feature in features.items()}
            data.add_frame({**frame, "task": ("wander", "rest")[episode % 2]})
        data.save_episode()
    data.finalize()
    return sum(lengths)


def edit_theirs(folder: Path, form: str) -> str:
    """Edits of a set that LeRobot wrote, with pictures of this form."""
    write_lerobot(folder / f"theirs-{form}", form)
    return edit_and_open(folder / f"theirs-{form}", folder / f"edits-of-theirs-{form}")


def open_theirs(folder: Path) -> str:
    """A LeRobot-written data set opens in ours, with its frames, and is found whole."""
    frames = write_lerobot(folder / "theirs")
    report = json.loads(ours("actrm-data", "inspect", "--json", folder / "theirs"))
    assert report["frames"] == frames, report
    ours("actrm-data", "validate", folder / "theirs")
    return f"{frames} frames"


def through_robomimic(folder: Path) -> str:
    """A set of LeRobot's becomes a robomimic file, on which robomimic trains, and comes back with every frame."""
    file, back = folder / "theirs-image.hdf5", folder / "theirs-back"
    ours("actrm-data", "convert", folder / "theirs-image", file, "--to", "robomimic")
    said = robomimic_training.train(file, folder / "trained-on-theirs", ["state", "environment_state"], ["front_image"])
    ours("actrm-data", "convert", file, back)
    before, after = open_lerobot(folder / "theirs-image"), open_lerobot(back)
    frames = sum(same_episode(before, i, after, i, {}) for i in range(before.num_episodes))
    # robomimic has no text at a frame: the file keeps it, a policy's features do not
    assert before.meta.features.keys() - after.meta.features.keys() == {"note"}, after.meta.features.keys()
    return f"{said}; {frames} frames there and back"


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


def study_on_ray(folder: Path) -> str:
    """The driver for Ray: cells of a study on a cluster of two cores, and the page of them all."""
    folder.mkdir()
    (folder / "study.toml").write_bytes((ROOT / "tests" / "fixtures" / "small_study.toml").read_bytes())
    driver = [sys.executable, ROOT / "tools" / "cluster" / "ray_study.py", "study.toml", "--program", BIN / "actrm-zoo"]
    os.environ.setdefault("ACTRM_PYTHON", str(ROOT / ".venv" / "bin" / "python"))
    command = [*map(str, driver), "--", "--work", "work"]
    done = subprocess.run(command, cwd=folder, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert all(f"act-on-lift-seed{seed}: ok" in done.stdout for seed in (1, 2)), done.stdout
    assert sorted(path.name for path in (folder / "zoo").iterdir()) == ["lift-act-s1", "lift-act-s2", "results"]
    page = (folder / "page.md").read_text()
    assert "0, 0 of 2" in page and "Not run" not in page, page
    return "2 cells, one page"


def main() -> None:
    """Run every check; the first difference ends it."""
    python_door.install()
    # LeRobot warns of video decoders that are not needed here
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
        lift = ROOT / "zoo" / "lift-act"
        images, plain = folder / "images.hdf5", folder / "plain"
        write_images(source, images)
        ours("actrm-data", "convert", images, plain, "--env-keys", "")
        checks: dict[str, Callable[[], str]] = {
            "LeRobot opens the converted data set": lambda: compare_lerobot(source, root),
            "LeRobot pads action chunks as we do": lambda: compare_windows(source, root),
            "LeRobot opens a set of several files": lambda: compare_shards(source, folder / "shards"),
            "LeRobot shows PNG pictures pixel by pixel": lambda: compare_images(images, folder / "png", "png"),
            "LeRobot shows PPM pictures pixel by pixel": lambda: compare_images(images, folder / "ppm", "ppm"),
            "LeRobot shows recorded JPEG pictures": lambda: compare_jpeg(folder / "aloha", folder / "jpeg"),
            "LeRobot shows depth as it was recorded": lambda: depth.compare_depth(
                folder / "depth", ours, open_lerobot, compare_trees
            ),
            "Ray Data, Daft, DuckDB, datasets read our frames": lambda: readers.compare(
                folder / "shards", episodes_of(source), "Lift"
            ),
            "Ray Data, Daft, DuckDB, datasets decode images": lambda: readers.compare(
                folder / "png", episodes_of(images, ("agentview", "robot0_eye_in_hand")), "Lift"
            ),
            "LeRobot reads and trains on our videos": lambda: compare_videos(images, folder / "video", "builtin"),
            "LeRobot reads and trains on FFmpeg's videos": lambda: compare_videos(images, folder / "svt", "ffmpeg"),
            "other readers decode our videos": lambda: readers.compare_videos(
                folder / "video", episodes_of(images), "Lift"
            ),
            "LeRobot trains its ACT on our set": lambda: train_lerobot(root, folder / "trained"),
            "our entry answers the same in LeRobot": lambda: export_entry(root, folder),
            "LeRobot's policy answers the same in ours": lambda: import_entry(root, folder),
            "LeRobot's policy served has our episodes": lambda: served.compare(folder / "served", ours),
            "vla-eval's connection gets an entry's actions": lambda: vla_eval_client.compare(BIN / "actrm-zoo"),
            "onnxruntime answers the same as our entries": lambda: export_onnx(root, folder),
            "the Hub's library reads our model cards": lambda: read_by_the_hub(root, folder / "hub"),
            "our entry that sees answers the same in LeRobot": lambda: export_seeing_entry(plain, folder / "seeing"),
            "LeRobot's policy that sees answers the same": lambda: import_seeing_entry(plain, folder / "seen"),
            "from Python: LeRobot's samples": lambda: python_door.compare_samples(root),
            "from Python: LeRobot's samples with pictures": lambda: python_door.compare_samples(plain),
            "from Python: LeRobot's samples with depth": lambda: python_door.compare_samples(folder / "depth" / "set"),
            "from Python: LeRobot's samples with videos": lambda: python_door.compare_samples(folder / "video"),
            "from Python: PyTorch's loader": lambda: python_door.compare_loaders(root),
            "from Python: a policy takes tensors": lambda: python_door.tensors_are_taken(ROOT / "zoo" / "lift-act"),
            "from Python: the PyTorch example of docs/howto/five_commands.md": lambda: python_door.how_to(
                folder / "howto"
            ),
            "from Python: LeRobot's policy": lambda: python_door.compare_chunks(root, folder / "trained"),
            "from Python: LeRobot's policy that sees": lambda: python_door.compare_chunks(
                plain, folder / "seen" / "trained"
            ),
            "LeRobot finds an entry by our plugin": lambda: python_door.found_by_lerobot(lift, "Lift", folder / "a"),
            "lerobot-eval runs it": lambda: python_door.lerobot_eval(lift, "Lift", folder / "a", 2, 100.0),
            "LeRobot finds an entry that sees": lambda: python_door.found_by_lerobot(
                train_seeing(folder / "eyes"), "Lift", folder / "b"
            ),
            "lerobot-eval runs it before cameras": lambda: python_door.lerobot_eval(
                folder / "eyes/zoo/lift-act-image", "Lift", folder / "b", 1, None
            ),
            "compare has the p-values of other packages": lambda: sequential.compare(folder / "sequential", ours, run),
            "robomimic reads the collected file": lambda: compare_robomimic(source),
            "export rebuilds the source": lambda: compare_trees(source, exported),
            "robomimic reads the exported file": lambda: compare_robomimic(exported),
            "robomimic's script trains on the exported file": lambda: robomimic_training.train(
                exported, folder / "trained-by-robomimic", [*STATE_KEYS, *ENV_KEYS], []
            ),
            "a data set written by LeRobot opens in ours": lambda: open_theirs(folder),
            "LeRobot opens edited sets of ours": lambda: edit_and_open(root, folder / "edits"),
            "LeRobot opens them with PNG pictures": lambda: edit_and_open(folder / "png", folder / "png-edits"),
            "LeRobot opens them with videos": lambda: edit_and_open(folder / "video", folder / "video-edits"),
            "LeRobot opens edited sets of its own": lambda: edit_theirs(folder, "image"),
            "from Python: samples of LeRobot's set": lambda: python_door.compare_samples(folder / "theirs-image"),
            "LeRobot opens them with its own videos": lambda: edit_theirs(folder, "video"),
            "LeRobot's set trains in robomimic and comes back": lambda: through_robomimic(folder),
            "shards on a Ray cluster make one evaluation": lambda: evaluate_on_ray(root, folder / "ray"),
            "shards by Ray and Slurm, from and to s3://": lambda: shards.compare_shards(
                BIN / "actrm-data", source, folder / "staged"
            ),
            "cells of a study run on a Ray cluster": lambda: study_on_ray(folder / "ray-study"),
        }
        for title, check in checks.items():
            print(f"{title:<48} ", end="", flush=True)
            print(f"ok   {check()}")
    print(f"{len(checks)} passed, 0 failed")


if __name__ == "__main__":
    sys.exit(main())
