"""What the tests of the installed package share."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
from pathlib import Path

import actrm
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[3]
RELEASE = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release"
LIFT = ROOT / "data/lift.hdf5"

# workers run in the repository's Python, unless another is named
os.environ.setdefault("ACTRM_PYTHON", str(ROOT / ".venv/bin/python"))

# what starts the tests may have Ctrl-C ignored, as shells do for what runs in the background; here it is tested
signal.signal(signal.SIGINT, signal.default_int_handler)


def output(*command: str | Path, given: bytes = b"", env: dict[str, str] | None = None) -> bytes:
    """What a program writes."""
    words = [str(word) for word in command]
    return subprocess.run(words, input=given, check=True, capture_output=True, env=env).stdout


@pytest.fixture(scope="session")
def lift(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped demonstrations as a data set."""
    folder = tmp_path_factory.mktemp("data") / "lift"
    actrm.convert(LIFT, folder, progress=False)
    return folder


@pytest.fixture(scope="session")
def zoo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped zoo, to write results into."""
    folder = tmp_path_factory.mktemp("zoo") / "zoo"
    shutil.copytree(ROOT / "zoo", folder)
    return folder


def train(experiment: str, data: Path, folder: Path, *settings: str) -> Path:
    """The entry of a training of two steps."""
    name = experiment.replace("_", "-")
    where = ("--data", data, "--zoo", folder / "zoo", "--runs", folder / "runs")
    output(
        RELEASE / "actrm-zoo",
        "train",
        experiment,
        *where,
        f"entry={name}",
        "train.steps=2",
        "train.batch_size=4",
        *settings,
    )
    return folder / "zoo" / name


def computed(entry: Path, asked: list[dict[str, np.ndarray]]) -> np.ndarray:
    """The chunks that an entry computes without Python."""
    given = [{key.removeprefix("observation."): value.ravel().tolist() for key, value in one.items()} for one in asked]
    text = output(RELEASE / "examples/predict", entry.parent, entry.name, given=json.dumps(given).encode())
    return np.array(json.loads(text), np.float32)
