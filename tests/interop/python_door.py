"""The Python package beside LeRobot: its samples, its policies, and the plugin by which LeRobot runs an entry.

The wheels are unpacked beside the peers' packages, where `run.py` finds them.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[2]
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
SITE = TARGET / "interop/python"
HORIZON = 16


def install() -> None:
    """Unpack both wheels beside the peers' packages, for this process and those that it starts."""
    wheels = [str(path) for path in sorted((TARGET / "wheels").glob("*.whl"))]
    assert len(wheels) == 2, wheels
    shutil.rmtree(SITE, ignore_errors=True)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--target", str(SITE)]
    subprocess.run([*pip, *wheels], check=True)
    sys.path.insert(0, str(SITE))
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(SITE), os.environ.get("PYTHONPATH")]))
    os.environ.setdefault("ACTRM_PYTHON", str(ROOT / ".venv/bin/python"))


def open_both(root: Path, deltas: dict[str, list[float]]) -> tuple[Any, Any]:
    """The same set, with these rows, opened by the package and by LeRobot."""
    import actrm
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return actrm.Dataset(root, deltas), LeRobotDataset(f"actrm/{root.name}", root=root, delta_timestamps=deltas)


def compare_samples(root: Path) -> str:
    """Keys, shapes, types and numbers of samples, at both ends of episodes and between; features and statistics."""
    import actrm

    columns = actrm.Dataset(root).features
    deltas = {"action": [k / 20 for k in range(HORIZON)], "observation.state": [-0.05, 0.0]}
    deltas |= {name: [0.0, 0.05] for name in ("next.done", "cells") if name in columns}
    deltas |= {name: [-0.05, 0.0] for name, feature in columns.items() if feature["dtype"] in {"image", "video"}}
    mine, theirs = open_both(root, deltas)
    assert len(mine) == len(theirs)
    ends = [edge for row in mine.episodes for edge in (row["dataset_from_index"], row["dataset_to_index"] - 1)]
    places = sorted({*ends[:8], 1, len(mine) // 2, len(mine) - 1})
    for i in places:
        one, other = mine[i], theirs[i]
        assert one.keys() == other.keys(), one.keys() ^ other.keys()
        for key, value in other.items():
            if isinstance(value, str):
                assert one[key] == value, key
                continue
            assert one[key].shape == tuple(value.shape), (key, one[key].shape, value.shape)
            assert str(one[key].dtype) == str(value.dtype).removeprefix("torch."), (key, one[key].dtype, value.dtype)
            assert np.array_equal(one[key], value.numpy()), (i, key)
    assert json.loads(json.dumps(mine.features)) == json.loads(json.dumps(theirs.meta.features))
    assert {key for key in theirs.meta.stats if key in mine.features} == mine.stats.keys()
    for key, stats in mine.stats.items():
        for statistic, value in stats.items():
            assert value.shape == np.shape(theirs.meta.stats[key][statistic]), (key, statistic)
    return f"{len(places)} samples, {len(mine[0])} keys"


def compare_loaders(root: Path) -> str:
    """PyTorch's loader gives the same with workers, forked and spawned; batches are shared with torch, not copied."""
    import actrm

    data = actrm.Dataset(root, {"action": range(8)}, split="valid")
    plain = list(torch.utils.data.DataLoader(data, batch_size=32))
    for method in ("fork", "spawn"):
        loader = torch.utils.data.DataLoader(data, batch_size=32, num_workers=2, multiprocessing_context=method)
        for ours, theirs in zip(plain, loader, strict=True):
            assert ours.keys() == theirs.keys()
            assert torch.equal(ours["action"], theirs["action"]) and ours["task"] == theirs["task"], method
    batch = next(iter(data.batches(32)))
    shared = torch.from_numpy(batch["action"])
    assert torch.equal(shared, plain[0]["action"])
    shared[0] = 3
    assert (batch["action"][0] == 3).all()
    return f"{len(plain)} batches, with workers forked and spawned"


def tensors_are_taken(entry: Path) -> str:
    """A policy takes PyTorch's tensors: with a gradient, of half precision and bfloat16."""
    import actrm

    policy = actrm.load_policy(entry)
    draw = np.random.default_rng(1)
    one = {
        name: draw.random(shape).astype(np.float16).astype(np.float32) for name, shape in policy.input_features.items()
    }
    wanted = policy.predict_action_chunk(one)
    for form in (lambda t: t, lambda t: t.requires_grad_(), lambda t: t.half()):
        given = {name: form(torch.from_numpy(value.copy())) for name, value in one.items()}
        np.testing.assert_array_equal(policy.predict_action_chunk(given), wanted)
    given = {name: torch.from_numpy(value).bfloat16() for name, value in one.items()}
    assert policy.predict_action_chunk(given).shape == wanted.shape
    return "float32, with a gradient, half precision, bfloat16"


def compare_chunks(root: Path, checkpoint: Path) -> str:
    """A checkpoint of LeRobot's, loaded by the package, plans what LeRobot plans, to 1e-5."""
    import actrm
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    mine, theirs = open_both(root, {})
    policy, other = actrm.load_policy(checkpoint), ACTPolicy.from_pretrained(checkpoint).eval()
    before, after = make_pre_post_processors(other.config, pretrained_path=str(checkpoint))
    keys, largest = list(policy.input_features), 0.0
    places = (0, 17, len(mine) // 2, len(mine) - 1)
    for i in places:
        with torch.no_grad():
            chunk = other.predict_action_chunk(before({key: theirs[i][key] for key in keys}))
        wanted = torch.stack([after(chunk[:, k]) for k in range(chunk.shape[1])], 1)[0].numpy()
        for seen in (mine[i], theirs[i]):
            planned = policy.predict_action_chunk(seen)
            assert planned.shape == wanted.shape, (planned.shape, wanted.shape)
            largest = max(largest, float(np.abs(planned - wanted).max()))
    assert largest <= 1e-5, f"actions differ by {largest:g}"
    return f"{len(places)} chunks of {', '.join(keys)}, largest difference {largest:.1e}"


def found_by_lerobot(entry: Path, task: str, folder: Path) -> str:
    """LeRobot's factory makes the policy of an entry, by its type and from what it saved, with the bits of ours."""
    import actrm
    from lerobot.configs import PreTrainedConfig
    from lerobot.envs.factory import make_env_config
    from lerobot.policies.factory import make_policy, make_policy_config, make_pre_post_processors
    from lerobot.utils.import_utils import register_third_party_plugins

    said: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: said.append(record.getMessage())
    disabled = logging.root.manager.disable
    logging.disable(logging.NOTSET)
    logging.getLogger().addHandler(handler)
    try:
        register_third_party_plugins()
    finally:
        logging.getLogger().removeHandler(handler)
        logging.disable(disabled)
    assert not [text for text in said if "Could not import" in text], said
    config = make_policy_config("actrm", entry=str(entry))
    env = make_env_config("actrm", task=task, entry=str(entry))
    policy, ours = make_policy(config, env_cfg=env), actrm.load_policy(entry)
    rng = torch.Generator().manual_seed(1)
    seen = {name: torch.rand((1, *shape), generator=rng) for name, shape in ours.input_features.items()}
    ours.reset(seed=config.seed)
    wanted, planned = ours.select_action(seen), ours.predict_action_chunk(seen)
    before, after = make_pre_post_processors(config)
    assert np.array_equal(after(policy.select_action(before(dict(seen)))).numpy(), wanted)
    assert np.array_equal(policy.predict_action_chunk(before(dict(seen))).numpy(), planned)
    # an episode may be of chunks alone; the next one has the next seed
    policy.reset()
    policy.predict_action_chunk(before(dict(seen)))
    assert policy.next_seed == config.seed + 2, policy.next_seed
    for _ in range(2):
        policy.save_pretrained(folder / "saved")
    loaded = PreTrainedConfig.from_pretrained(folder / "saved")
    loaded.pretrained_path = folder / "saved"
    again = make_policy(loaded, env_cfg=env)
    assert str(again.policy.path).startswith(str(folder)), again.policy.path
    again.save_pretrained(folder / "saved")
    before, after = make_pre_post_processors(loaded, pretrained_path=str(folder / "saved"))
    assert np.array_equal(after(again.select_action(before(dict(seen)))).numpy(), wanted)
    return f"{ours.id}, from its type and from what was saved"


def how_to(folder: Path) -> str:
    """The example of docs/howto/five_commands.md gives tensors of PyTorch."""
    section = (ROOT / "docs/howto/five_commands.md").read_text().split("## Load a data set in PyTorch")[1]
    example = textwrap.dedent("\n".join(line for line in section.splitlines() if line.startswith("    ")))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "data").symlink_to(ROOT / "data")
    names: dict[str, Any] = {}
    with contextlib.chdir(folder):
        exec(compile(example, "howto.md", "exec"), names)
    action = names["action"]
    assert isinstance(action, torch.Tensor) and tuple(action.shape[1:]) == (HORIZON, 7), action
    return f"{tuple(action.shape)}"


def lerobot_eval(entry: Path, task: str, folder: Path, episodes: int, expected: float | None) -> str:
    """`lerobot-eval` runs an entry in our task, by its folder and by what was saved of it."""
    said: list[str] = []
    for name, where in (("entry", ["--policy.type=actrm", f"--policy.entry={entry}"]), ("saved", [])):
        out = folder / name
        chosen = where or [f"--policy.path={folder / 'saved'}"]
        command = [sys.executable, "-m", "lerobot.scripts.lerobot_eval", *chosen, "--env.type=actrm"]
        command += [f"--env.task={task}", f"--env.entry={entry}", f"--eval.n_episodes={episodes}"]
        command += ["--eval.batch_size=1", f"--output_dir={out}", "--seed=10000"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-4000:]
        (report,) = out.rglob("eval_info.json")
        rate = json.loads(report.read_text())["overall"]["pc_success"]
        assert expected is None or rate == expected, (name, rate)
        said.append(f"{rate:g}%")
        if expected is None:
            break
    return f"{episodes} episodes of {task}: {', '.join(said)}"
