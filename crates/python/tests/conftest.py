"""What the tests of the installed package share."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import actrm
import pytest

ROOT = Path(__file__).resolve().parents[3]
RELEASE = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release"
LIFT = ROOT / "data/lift.hdf5"

# workers run in the repository's Python, unless another is named
os.environ.setdefault("ACTRM_PYTHON", str(ROOT / ".venv/bin/python"))


def output(*command: str | Path, given: bytes = b"") -> bytes:
    """What a program writes."""
    return subprocess.run([str(word) for word in command], input=given, check=True, capture_output=True).stdout


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
