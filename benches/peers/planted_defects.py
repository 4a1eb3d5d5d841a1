"""Defects planted in a LeRobot data set, and which of three programs find them: a table in Markdown.

    python benches/peers/planted_defects.py --program target/release/actrm-data [--doctor PATH]

The set is written by LeRobot itself (6 episodes, two tasks). Each defect is planted in a copy of its own. A program
finds it if it says something of the copy that it does not say of the sound set: `actrm-data validate` a problem,
lerobot-doctor a warning or a failure, lerobot-lint an error or a warning. False alarms are what it says of two sound
sets: this one, and six of the demonstrations in data/lift.hdf5. Needs the packages of
benches/peers/requirements.lock, lerobot-doctor 0.2.0 and lerobot-lint 0.1.1.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["HF_HUB_OFFLINE"] = "1"
ROOT = Path(__file__).resolve().parents[2]

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

EPISODES, FRAMES, FPS = 6, 60, 20
DATA = "data/chunk-000/file-000.parquet"
ROWS = "meta/episodes/chunk-000/file-000.parquet"
TASKS = "meta/tasks.parquet"
INFO = "meta/info.json"
STATS = "meta/stats.json"
Edit = Callable[[Path], None]


def write(root: Path) -> None:
    """A sound set: smooth motion of seven joints that follow their actions."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    names = [f"joint_{i}.pos" for i in range(7)]
    vector = {"dtype": "float32", "shape": (7,), "names": names}
    features = {"observation.state": vector, "action": vector}
    data = LeRobotDataset.create("actrm/planted", fps=FPS, root=root, features=features, use_videos=False)
    for episode in range(EPISODES):
        phase = np.random.default_rng(episode).uniform(0, 6, 7)
        for frame in range(FRAMES):
            at = 0.8 * np.sin(frame / 12 + phase)
            to = 0.8 * np.sin((frame + 1) / 12 + phase)
            state, action = at.astype(np.float32), to.astype(np.float32)
            data.add_frame({"observation.state": state, "action": action, "task": f"task {episode % 2}"})
        data.save_episode()
    data.finalize()


def table(name: str, edit: Callable[[pa.Table], pa.Table]) -> Edit:
    """An edit of a Parquet file that keeps what the file says of itself."""

    def apply(root: Path) -> None:
        before = pq.read_table(root / name)
        after = edit(before)
        pq.write_table(after.replace_schema_metadata(before.schema.metadata), root / name)

    return apply


def column(name: str, key: str, edit: Callable[[list[Any]], None]) -> Edit:
    """An edit of the values of a column."""

    def apply(before: pa.Table) -> pa.Table:
        at = before.column_names.index(key)
        values = before.column(key).to_pylist()
        edit(values)
        return before.set_column(at, before.schema.field(key), pa.array(values, before.schema.field(key).type))

    return table(name, apply)


def rows(name: str, choose: Callable[[list[int]], list[int]]) -> Edit:
    """An edit of the order or the number of rows."""
    return table(name, lambda before: before.take(choose(list(range(before.num_rows)))))


def document(name: str, edit: Callable[[Any], None]) -> Edit:
    """An edit of a JSON file."""

    def apply(root: Path) -> None:
        value = json.loads((root / name).read_text())
        edit(value)
        (root / name).write_text(json.dumps(value, indent=4))

    return apply


def put(row: int, value: Any, dimension: int | None = None) -> Callable[[list[Any]], None]:
    """Sets one value of a column."""

    def apply(values: list[Any]) -> None:
        if dimension is None:
            values[row] = value(values[row]) if callable(value) else value
        else:
            values[row][dimension] = value

    return apply


def content(name: str, edit: Callable[[bytes], bytes]) -> Edit:
    """An edit of the bytes of a file."""
    return lambda root: (root / name).write_bytes(edit((root / name).read_bytes())) and None


def swap(values: list[Any]) -> None:
    """Exchanges two neighbours."""
    values[70], values[71] = values[71], values[70]


def jitter(values: list[Any]) -> None:
    """Times of a clock that is a third of a frame off here and there."""
    for row in range(10, len(values), 17):
        values[row] += 0.3 / FPS


def without(value: Any, key: str) -> None:
    """Removes a key."""
    del value[key]


DEFECTS: dict[str, Edit] = {
    "NaN in a state": column(DATA, "observation.state", put(77, float("nan"), 2)),
    "NaN in an action": column(DATA, "action", put(130, float("nan"), 0)),
    "infinity in an action": column(DATA, "action", put(200, float("inf"), 5)),
    "wrong `index`": column(DATA, "index", put(90, lambda old: old + 1)),
    "wrong `frame_index`": column(DATA, "frame_index", put(90, lambda old: old + 1)),
    "a frame of another `episode_index`": column(DATA, "episode_index", put(90, 4)),
    "`task_index` beyond the table": column(DATA, "task_index", put(90, 7)),
    "`task_index` of the other task": column(DATA, "task_index", put(90, 0)),
    "timestamps that jitter": column(DATA, "timestamp", jitter),
    "two timestamps exchanged": column(DATA, "timestamp", swap),
    "a timestamp that is the one before": column(DATA, "timestamp", put(90, 29 / FPS)),
    "a frame twice": rows(DATA, lambda order: [*order[:91], 90, *order[91:]]),
    "a frame missing": rows(DATA, lambda order: [*order[:90], *order[91:]]),
    "an episode missing in the data": rows(DATA, lambda order: [*order[:120], *order[180:]]),
    "two episodes exchanged": rows(DATA, lambda order: [*order[60:120], *order[:60], *order[120:]]),
    "wrong `length` of an episode": column(ROWS, "length", put(2, FRAMES - 1)),
    "wrong `dataset_from_index`": column(ROWS, "dataset_from_index", put(2, 119)),
    "wrong `dataset_to_index`": column(ROWS, "dataset_to_index", put(2, 181)),
    "`data/file_index` of no file": column(ROWS, "data/file_index", put(2, 3)),
    "a row of the episodes missing": rows(ROWS, lambda order: [*order[:2], *order[3:]]),
    "the other task in an episode's row": column(ROWS, "tasks", put(2, ["task 1"])),
    "statistics of an episode wrong": column(ROWS, "stats/action/mean", put(2, 9.0, 3)),
    "wrong `total_frames`": document(INFO, lambda info: info.update(total_frames=359)),
    "wrong `total_episodes`": document(INFO, lambda info: info.update(total_episodes=5)),
    "wrong `total_tasks`": document(INFO, lambda info: info.update(total_tasks=3)),
    "a split beyond the end": document(INFO, lambda info: info.update(splits={"train": "0:9"})),
    "another `fps`": document(INFO, lambda info: info.update(fps=30)),
    "a feature without a column": document(
        INFO, lambda info: info["features"].update({"next.reward": {"dtype": "float32", "shape": [1], "names": None}})
    ),
    "a column without a feature": document(INFO, lambda info: without(info["features"], "action")),
    "another shape in info.json": document(INFO, lambda info: info["features"]["action"].update(shape=[6])),
    "wrong mean in stats.json": document(STATS, lambda stats: put(0, 5.0)(stats["action"]["mean"])),
    "a maximum below the data": document(STATS, lambda stats: put(0, -0.5)(stats["observation.state"]["max"])),
    "NaN in stats.json": document(STATS, lambda stats: put(0, float("nan"))(stats["action"]["std"])),
    "the tasks' numbers exchanged": column(TASKS, "task_index", lambda values: values.reverse()),
    "a truncated data file": content(DATA, lambda old: old[: len(old) // 2]),
    "a git-lfs pointer": content(DATA, lambda _: b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"),
}


def said_by_actrm(program: str, root: Path) -> set[str]:
    """Problems that `actrm-data validate` names."""
    done = subprocess.run([program, "validate", root], capture_output=True, text=True, check=False)
    return {done.stdout + done.stderr} if done.returncode else set()


def said_by_doctor(program: str, root: Path) -> set[str]:
    """Warnings and failures of lerobot-doctor; what it dies of."""
    done = subprocess.run([program, "check", root, "--json"], capture_output=True, text=True, check=False)
    try:
        report = json.loads(done.stdout)
    except ValueError:
        return {f"exit code {done.returncode}"}
    messages = [message for check in report["checks"] for message in check["messages"]]
    return {f"{m['severity']}: {m['message']}" for m in messages if m["severity"] != "PASS"}


def run_lint(root: Path, report: Path) -> int | str | None:
    """The program `lelint` on a set; its exit code."""
    from lerobot_lint.cli import app

    with (
        Path(os.devnull).open("w") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        try:
            app(["check", str(root), "--json", str(report)])
        except SystemExit as done:
            return done.code
    return 0


def said_by_lint(root: Path) -> set[str]:
    """Errors and warnings of lerobot-lint; what it dies of."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        # started by itself it would import LeRobot anew, 20 times as long as it looks at the set
        with multiprocessing.get_context("fork").Pool(1) as pool:
            code = pool.apply(run_lint, (root, report))
        if not report.exists():
            # it writes none of what it cannot open
            return {f"exit code {code}"}
        findings = json.loads(report.read_text()).get("findings", [])
    return {f"{f['severity']}: {f['check']} {f['episode']} {f['joint']}" for f in findings if f["severity"] != "info"}


def main() -> int:
    """Print the table; the exit code is 1 where actrm-data misses a defect or has a false alarm."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", default="target/release/actrm-data", help="actrm-data")
    parser.add_argument("--doctor", default="lerobot-doctor", help="lerobot-doctor")
    args = parser.parse_args()
    tools: dict[str, Callable[[Path], set[str]]] = {
        "actrm-data validate": lambda root: said_by_actrm(args.program, root),
        "lerobot-doctor 0.2.0": lambda root: said_by_doctor(args.doctor, root),
        "lerobot-lint 0.1.1": said_by_lint,
    }
    found = dict.fromkeys(tools, 0)
    print(f"| defect | {' | '.join(tools)} |\n|---|{'---|' * len(tools)}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # copies of all these sets go when they go
        os.environ["HF_DATASETS_CACHE"] = str(folder / "cache")
        sound, lift = folder / "sound", folder / "lift"
        write(sound)
        for command in (("convert", ROOT / "data/lift.hdf5", folder / "all"), ("edit", "keep", folder / "all", lift)):
            given = ("--episodes", "0-5") if command[0] == "edit" else ()
            subprocess.run([args.program, *command, *given], check=True, capture_output=True)
        alarms = {tool: say(sound) for tool, say in tools.items()}
        false = {tool: len(alarms[tool]) + len(say(lift)) for tool, say in tools.items()}
        for defect, plant in DEFECTS.items():
            root = folder / "planted"
            shutil.copytree(sound, root)
            plant(root)
            cells = []
            for tool, say in tools.items():
                # the same words about another folder are the same
                plain = {re.sub(r"/\S*/(sound|planted)", "SET", text) for text in say(root)}
                known = {re.sub(r"/\S*/(sound|planted)", "SET", text) for text in alarms[tool]}
                new = bool(plain - known)
                found[tool] += new
                cells.append("found" if new else "-")
            print(f"| {defect} | {' | '.join(cells)} |", flush=True)
            shutil.rmtree(root)
    count = len(DEFECTS)
    print(f"| **found of {count}** | {' | '.join(f'**{found[tool]}**' for tool in tools)} |")
    print(f"| **false alarms on two sound sets** | {' | '.join(f'**{false[tool]}**' for tool in tools)} |")
    return int(found["actrm-data validate"] < count or bool(false["actrm-data validate"]))


if __name__ == "__main__":
    sys.exit(main())
