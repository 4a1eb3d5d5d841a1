"""LeRobot's own policy behind examples/serve_lerobot.py has the episodes of the checkpoint that we import."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq

ROOT = Path(__file__).resolve().parents[2]
EPISODES = 5
# of waiting for the server, which imports torch
PATIENCE = 300


def free_port() -> int:
    """A port that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def compare(folder: Path, ours: Callable[..., str]) -> str:
    """The shipped ACT as LeRobot's checkpoint: imported by us, and run by PyTorch behind a server."""
    folder.mkdir()
    checkpoint, zoo, port = folder / "checkpoint", folder / "zoo", free_port()
    os.environ.setdefault("ACTRM_PYTHON", str(ROOT / ".venv" / "bin" / "python"))
    ours("actrm-zoo", "export", "lerobot", "lift-act@1", checkpoint, "--zoo", ROOT / "zoo")
    ours("actrm-zoo", "import", "lerobot", checkpoint, "--name", "imported", "--task", "Lift", "--zoo", zoo)
    run = ["--episodes", str(EPISODES), "--zoo", zoo]
    ours("actrm-zoo", "eval", "imported@1", *run)
    log = folder / "server.log"
    with log.open("w") as out:
        command = [sys.executable, ROOT / "examples/serve_lerobot.py", checkpoint, str(port)]
        server = subprocess.Popen(command, stdout=out, stderr=out)
    try:
        for _ in range(PATIENCE):
            assert server.poll() is None, log.read_text()[-4000:]
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(1)
        ours("actrm-zoo", "eval", "--policy", f"ws://127.0.0.1:{port}", "--name", "served", "--task", "Lift", *run)
    finally:
        server.kill()
        server.wait()
    found = []
    for name in ("imported", "served"):
        (result,) = (zoo / "results").glob(f"{name}@1_*/outcomes.parquet")
        found.append(pq.read_table(result, columns=["seed", "success", "steps"]).to_pylist())
    assert found[0] == found[1], found
    return f"{EPISODES} episodes of Lift, {[row['steps'] for row in found[0]]} steps"
