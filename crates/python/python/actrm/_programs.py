"""The command line programs that the wheel carries."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from pathlib import Path

CONTROL = "libcontrol.so"


def folder() -> Path:
    """Where they lie."""
    return Path(__file__).parent / "bin"


def data() -> None:
    """`actrm-data`."""
    _become("actrm-data")


def zoo() -> None:
    """`actrm-zoo`."""
    _become("actrm-zoo")


def _become(name: str) -> None:
    program = folder() / name
    if not program.is_file():
        raise SystemExit(f"error: this installation of actrm carries no programs: {program} is not there")
    if not os.environ.get("ACTRM_PYTHON") and find_spec("robosuite"):
        os.environ["ACTRM_PYTHON"] = sys.executable
    os.execv(program, [name, *sys.argv[1:]])
