"""Policies of others in our evaluation, and ours behind a server.

    PYTHONPATH=target/bench/python .venv-peers/bin/python benches/external.py [--episodes 50] [--queries 2000]

Two parts. A policy that answers in a millisecond: `actrm-zoo eval --policy` with two workers beside two processes of
robosuite's own loop, start of the simulators included; processor seconds are those of all processes. An ACT of width
256 behind `actrm-zoo serve`, asked by openpi-client, beside the same entry in this process, in turns; the answers are
the same bytes. Runs in the peers' environment with the wheel unpacked beside it (`tools/bench.sh external` sees to
that). Writes target/bench/external.json; the exit code is 1 where a bar is missed.
"""

import argparse
import importlib
import json
import logging
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

os.environ |= {"RAYON_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

from constant_policy import ConstantPolicy
from libero_suite import timed

ROOT = Path(__file__).resolve().parents[1]
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
BIN = TARGET / "release"
SIMULATOR = os.environ.get("ACTRM_PYTHON") or str(ROOT / ".venv/bin/python")
ACTION = [0.1, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]
CHUNK = 8
SPEED_BAR, MEDIAN_BAR, TAIL_BAR = 3.0, 0.3, 1.0
CLIENTS = 8


@dataclass(frozen=True, slots=True)
class Row:
    """One measurement beside its peer; `ratio` is peer to ours for seconds, for a query the milliseconds added."""

    work: str
    unit: str
    ours: float
    peer: float
    ratio: float
    bar: str
    met: bool


def own(task: str, episodes: int, steps: int) -> None:
    """robosuite's own loop; the policy is a sleep."""
    logging.disable(logging.INFO)
    robosuite: Any = importlib.import_module("robosuite")
    np: Any = importlib.import_module("numpy")
    env = robosuite.make(
        task, robots="Panda", has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False, seed=10_000
    )
    for _ in range(episodes):
        env.reset()
        for step in range(steps):
            if step % CHUNK == 0:
                time.sleep(0.001)
            env.step(np.array(ACTION))
            if env._check_success():
                break


def whole(task: str, episodes: int, steps: int) -> list[Row]:
    """A whole evaluation of somebody's policy."""
    server = ConstantPolicy([ACTION] * CHUNK)
    with tempfile.TemporaryDirectory(prefix="actrm-bench-") as folder:
        command = [str(BIN / "actrm-zoo"), "eval", "--policy", server.address, "--name", "constant", "--task", task]
        command += ["--episodes", str(episodes), "--max-steps", str(steps), "--n-action-steps", str(CHUNK)]
        command += ["--seed", "10000", "--workers", "2", "--zoo", folder]
        ours = timed([command], os.environ | {"ACTRM_PYTHON": SIMULATOR})
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    shared = [SIMULATOR, __file__, "--task", task, "--steps", str(steps), "--own"]
    peer = timed([[*shared, str(count)] for count in (episodes // 2, episodes - episodes // 2)], plain)
    work = f"{task}: a policy of 1 ms, {episodes} episodes of {steps} steps, 2 workers"
    bar = f">= {SPEED_BAR:g} times"
    rows: list[Row] = []
    for what, a, b in (("wall", ours[0], peer[0]), ("processor", ours[1], peer[1])):
        rows.append(Row(f"{work}, {what}", "s", a, b, b / a, bar, b / a >= SPEED_BAR))
    return rows


def entry(folder: Path) -> None:
    """An ACT of width 256 for Lift; how well it acts does not matter here."""
    subprocess.run(
        [BIN / "actrm-data", "convert", ROOT / "data/lift.hdf5", folder / "lift"], check=True, stderr=subprocess.DEVNULL
    )
    command = [BIN / "actrm-zoo", "train", "act_lift", "entry=bench", "policy.dim_model=256", "train.steps=20"]
    command += ["--data", folder / "lift", "--zoo", folder / "zoo", "--runs", folder / "runs"]
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


def served(queries: int) -> list[Row]:
    """What a server adds to a query."""
    actrm: Any = importlib.import_module("actrm")
    np: Any = importlib.import_module("numpy")
    client: Any = importlib.import_module("openpi_client.websocket_client_policy").WebsocketClientPolicy
    with tempfile.TemporaryDirectory(prefix="actrm-bench-") as name:
        folder = Path(name)
        entry(folder)
        command = [BIN / "actrm-zoo", "serve", "bench", "--port", "0", "--zoo", folder / "zoo"]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        try:
            assert server.stdout
            port = next(
                int(line.split("127.0.0.1:")[1].split()[0].rstrip(",/."))
                for line in server.stdout
                if "127.0.0.1:" in line
            )
            policy = actrm.load_policy(folder / "zoo/bench")
            rng = np.random.default_rng(0)
            shapes = policy.input_features
            seen = [{k: rng.normal(0, 0.5, s).astype(np.float32) for k, s in shapes.items()} for _ in range(queries)]
            remote = client("127.0.0.1", port)
            here: list[float] = []
            there: list[float] = []
            for one in seen:
                begun = time.perf_counter()
                wanted = policy.predict_action_chunk(one)
                between = time.perf_counter()
                found = remote.infer(one)["actions"]
                there.append(1e3 * (time.perf_counter() - between))
                here.append(1e3 * (between - begun))
                assert found.tobytes() == wanted.tobytes(), "the served answer is another one"
            together(client, port, policy, seen[: min(queries, 200)])
        finally:
            server.terminate()
            server.wait()
    rows: list[Row] = []
    for what, bar, pick in (("median", MEDIAN_BAR, 50), ("99th percentile", TAIL_BAR, 99)):
        ours, peer = (float(np.percentile(all_times, pick)) for all_times in (there, here))
        added = ours - statistics.median(here)
        work = f"ACT d256 behind serve, openpi-client beside in-process, {what}; added"
        rows.append(Row(work, "ms", ours, peer, added, f"<= {bar:g} ms added", added <= bar))
    return rows


def together(client: Any, port: int, policy: Any, seen: list[dict[str, Any]]) -> None:
    """Eight clients at once have their own answers."""
    wanted = [policy.predict_action_chunk(one).tobytes() for one in seen]
    wrong: list[int] = []

    def ask(number: int) -> None:
        remote = client("127.0.0.1", port)
        for at in range(number, len(seen), CLIENTS):
            if remote.infer(seen[at])["actions"].tobytes() != wanted[at]:
                wrong.append(at)

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(CLIENTS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong, f"answers of another client: {wrong}"


def main() -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Stack")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--steps", type=int, default=120, help="length of an episode (default: %(default)s)")
    parser.add_argument("--queries", type=int, default=2000)
    parser.add_argument("--own", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.own:
        own(args.task, args.own, args.steps)
        return 0
    rows = served(args.queries) + whole(args.task, args.episodes, args.steps)
    print(f"{'work':<92} {'ours':>9} {'peer':>9} {'':<4} {'ratio':>7}  bar")
    for row in rows:
        verdict = "met" if row.met else "MISSED"
        print(f"{row.work:<92} {row.ours:>9.3f} {row.peer:>9.3f} {row.unit:<4} {row.ratio:>7.3f}  {row.bar}: {verdict}")
    report = {
        "bench": "external",
        "peer": "robosuite's own loop; the entry in this process",
        "rows": [asdict(row) for row in rows],
    }
    (TARGET / "bench").mkdir(parents=True, exist_ok=True)
    (TARGET / "bench/external.json").write_text(json.dumps(report, indent=1) + "\n")
    return 0 if all(row.met for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
