"""A client of the worker, and the fixtures that start one."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
import pytest

HARNESS = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(HARNESS))

from actrm_harness import wire  # noqa: E402
from actrm_harness.wire import Array, Message, Tensors  # noqa: E402

TARGET = Path(os.environ.get("CARGO_TARGET_DIR", HARNESS.parents[1] / "target"))
LIBERO = Path(os.environ.get("ACTRM_PYTHON_LIBERO") or Path(sys.prefix).parent / ".venv-libero/bin/python")
LIBRARY = Path(os.environ.get("ACTRM_CONTROL_LIB") or TARGET / "release" / "libcontrol.so")


class WorkerError(Exception):
    """An error reply."""

    def __init__(self, message: Message) -> None:
        super().__init__(f"{message['kind']}: {message['message']}")
        self.message = message


class Client:
    """One worker process, spoken to as Rust does."""

    def __init__(self, *arguments: str, env: dict[str, str] | None = None, ready: bool = True) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "actrm_harness.worker", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE if not ready else None,
            # robosuite's own loop, unless the test names a compiled one
            env={k: v for k, v in os.environ.items() if k != "ACTRM_CONTROL_LIB"}
            | {"PYTHONPATH": str(HARNESS)}
            | (env or {}),
        )
        self.requests = cast(BinaryIO, self.process.stdin)
        self.replies = cast(BinaryIO, self.process.stdout)
        self.count = 0
        self.ready: Message = {}
        if ready:
            frame = wire.read_frame(self.replies)
            assert frame is not None
            self.ready = frame[0]
            assert self.ready["type"] == "ready", self.ready

    def ask(self, kind: str, tensors: Tensors | None = None, **fields: Any) -> tuple[Message, Tensors]:
        """Send one request and take its reply."""
        self.count += 1
        wire.write_frame(self.requests, {"type": kind, "id": self.count, **fields}, tensors)
        frame = wire.read_frame(self.replies)
        assert frame is not None, "the worker ended"
        message, data = frame
        assert message["id"] == self.count
        if message["type"] == "error":
            raise WorkerError(message)
        return message, data

    def step(self, action: Array) -> tuple[Message, Tensors]:
        """One control step."""
        return self.ask("step", {"action": action})

    def close(self) -> int:
        """Close the worker's input and wait for its end."""
        self.requests.close()
        code = self.process.wait(timeout=60)
        self.replies.close()
        return code


@pytest.fixture(scope="session")
def lift() -> Iterator[Client]:
    """A Lift worker shared by tests; every test begins with a reset of its own."""
    client = Client("--task", "Lift")
    yield client
    client.close()


@pytest.fixture(scope="session")
def libero() -> Path:
    """The interpreter that has LIBERO."""
    if not LIBERO.is_file():
        (pytest.fail if os.environ.get("CI") else pytest.skip)(f"{LIBERO} is missing: make libero")
    return LIBERO


@pytest.fixture(scope="session")
def cabinet(libero: Path) -> Iterator[Client]:
    """A worker of libero_goal/3, where a bowl goes onto a cabinet, shared as `lift` is."""
    assert libero.is_file()
    client = Client("--task", "libero_goal/3")
    yield client
    client.close()


def walk(seed: int, steps: int, dim: int = 7) -> Array:
    """A deterministic sequence of actions."""
    return np.random.default_rng(seed).uniform(-1, 1, size=(steps, dim))


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> Path:
    """The compiled control loop, where the worker looks for it."""
    assert LIBRARY.is_file(), f"{LIBRARY} is missing: cargo build --release -p control"
    monkeypatch.setenv("ACTRM_CONTROL_LIB", str(LIBRARY))
    return LIBRARY
