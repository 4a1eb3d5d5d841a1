"""vla-eval's own connection to `actrm-zoo serve` gets the actions that openpi's client gets of the same entry."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import anyio
import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy
from vla_eval.benchmarks.libero.benchmark import _quat_to_axisangle_robosuite, preprocess_libero_image
from vla_eval.connection import Connection

ROOT = Path(__file__).resolve().parents[2]
ENTRY = "lift-act-image-s1@1"
STEPS, EXECUTED = 20, 8
# of quaternions that were axis-angles in between
TOLERANCE = 1e-5


def shown(rng: np.random.Generator) -> dict[str, Any]:
    """What robosuite could show: images as OpenGL has them, upside down, and a state."""
    turn = rng.normal(size=4)
    images = {name: rng.integers(0, 256, (84, 84, 3), dtype=np.uint8) for name in ("agentview", "robot0_eye_in_hand")}
    state = {"pos": rng.normal(size=3), "quat": turn / np.linalg.norm(turn), "fingers": rng.normal(size=2)}
    return {"images": images, **state}


def libero(seen: dict[str, Any]) -> dict[str, Any]:
    """What vla-eval's benchmark makes of it."""
    agentview, wrist = (preprocess_libero_image(image) for image in seen["images"].values())
    states = np.concatenate([seen["pos"], _quat_to_axisangle_robosuite(seen["quat"]), seen["fingers"]])
    return {"images": {"agentview": agentview, "wrist": wrist}, "task_description": "lift", "states": states}


def features(seen: dict[str, Any]) -> dict[str, Any]:
    """The entry's own features of it; its images are upright."""
    images = {f"observation.images.{name}": image[::-1] for name, image in seen["images"].items()}
    state = np.concatenate([seen["pos"], seen["quat"], seen["fingers"]]).astype(np.float32)
    return {"observation.state": state, **images}


async def stepped(url: str, episode: list[dict[str, Any]]) -> np.ndarray:
    """The action of every step, as vla-eval's runner asks for it."""
    async with Connection(url) as connection:
        assert connection.server_info["model_server"] == ENTRY, connection.server_info
        await connection.start_episode({"task": {"name": "lift", "task_id": 0, "episode_idx": 0}})
        actions = [(await connection.act(libero(seen)))["actions"] for seen in episode]
        await connection.end_episode({})
        return np.stack(actions)


def compare(program: Path) -> str:
    """Two episodes over one connection's server, asked both ways."""
    command = [program, "serve", ENTRY, "--port", "0", "--zoo", ROOT / "zoo"]
    server = subprocess.Popen([*map(str, command)], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        address = server.stdout.readline().strip().rpartition("ws://")[2]
        host, _, port = address.partition(":")
        chunks = WebsocketClientPolicy(host, int(port))
        rng = np.random.default_rng(11)
        largest = 0.0
        for _ in range(2):
            episode = [shown(rng) for _ in range(STEPS)]
            found = anyio.run(stepped, f"ws://{address}/vla-eval", episode)
            asked = [chunks.infer({**features(seen), "seed": 0})["actions"] for seen in episode[::EXECUTED]]
            expected = np.concatenate([chunk[:EXECUTED] for chunk in asked])[:STEPS]
            largest = max(largest, float(np.abs(found - expected).max()))
        assert largest < TOLERANCE, largest
    finally:
        server.kill()
        server.wait()
    return f"2 episodes of {STEPS} steps, actions differ by at most {largest:.1e}"
