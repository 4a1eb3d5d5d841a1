"""The Python door beside LeRobot's loader and beside runtimes for exported models.

    PYTHONPATH=target/bench/python .venv-peers/bin/python benches/python.py [--only WORD] [--rounds 3]

Runs in the peers' environment with the wheel unpacked beside it (`tools/bench.sh python` sees to that). Each pair
takes turns in this one process, on one thread; of the rounds the best counts. Writes target/bench/python.json; the exit
code is 1 where a bar is missed. A peer that is not installed leaves its row without a ratio.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

os.environ |= {"HF_HUB_OFFLINE": "1", "RAYON_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

ROOT = Path(__file__).resolve().parents[1]
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))

import actrm
import numpy as np
import torch

BATCH = 64
HORIZON = 32
ROUNDED = "OpenVINO as it is set"
SIZES = {
    "d256": {"dim_model": 256, "dim_feedforward": 1024, "chunk_size": 32},
    "d512": {"dim_model": 512, "dim_feedforward": 3200, "chunk_size": 100},
}


@dataclass(frozen=True, slots=True)
class Row:
    """One measurement beside its peer: more is better where the bar is a ratio, less where it is a time."""

    work: str
    unit: str
    ours: float
    peer: float | None
    ratio: float | None
    bar: str
    met: bool | None


def rate(work: str, unit: str, ours: float, peer: float | None, least: float, times: float) -> Row:
    """As fast as asked, and so many times as fast as the peer."""
    ratio = None if peer is None else ours / peer
    met = ours >= least and (ratio is None or ratio >= times)
    bar = f">= {times:g} times" + (f", >= {least:g}" if least else "")
    return Row(work, unit, ours, peer, ratio, bar, met)


def cost(work: str, unit: str, ours: float, peer: float | None, most: float) -> Row:
    """At most so much of the peer's time; of itself where there is no peer."""
    ratio = None if peer is None else ours / peer
    met = None if ratio is None else ratio <= most
    return Row(work, unit, ours, peer, ratio, f"<= {most:g} times", met)


def least(work: str, unit: str, ours: float, most: float) -> Row:
    """At most so much."""
    return Row(work, unit, ours, None, None, f"<= {most:g}", ours <= most)


def samples_per_second(batches: Callable[[], Iterator[dict[str, Any]]], count: int, rounds: int) -> float:
    """The best round."""
    best = 0.0
    for _ in range(rounds):
        going = batches()
        next(going)
        begun, seen = time.perf_counter(), 0
        for _ in range(count):
            seen += len(next(going)["action"])
        best = max(best, seen / (time.perf_counter() - begun))
    return best


def windows(folder: Path, cameras: bool, rounds: int) -> Iterator[Row]:
    """Random windows, batch by batch."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    ours = actrm.Dataset(folder, {"action": range(HORIZON)})
    deltas = {"action": [i / ours.fps for i in range(HORIZON)]}
    theirs = LeRobotDataset(f"actrm/{folder.name}", root=folder, delta_timestamps=deltas)

    def loader(workers: int) -> Callable[[], Iterator[dict[str, Any]]]:
        def batches() -> Iterator[dict[str, Any]]:
            options = {"batch_size": BATCH, "shuffle": True, "num_workers": workers, "drop_last": True}
            while True:
                yield from torch.utils.data.DataLoader(theirs, **options)

        return batches

    mine = samples_per_second(lambda: iter(ours.batches(BATCH, seed=1, steps=1 << 40)), 50 if cameras else 3000, rounds)
    counts = [0, *range(1, (os.cpu_count() or 1) + 1)]
    best = max(samples_per_second(loader(workers), 4, 1) for workers in counts)
    work = f"Python: windows of {HORIZON} steps, batch {BATCH}"
    if cameras:
        # ours are decoded once, when the set is opened, and stay in memory; both give float32 from 0 to 1
        yield rate(f"{work}, 2 x 84 x 84 pixels (peer: LeRobot)", "samples/s", mine, best, 0, 5)
        return
    yield rate(f"{work} (peer: LeRobotDataset + DataLoader)", "samples/s", mine, best, 300_000, 500)
    if has("rerun.experimental.dataloader") and has("datafusion"):
        theirs_too = of_rerun(folder, rounds)
        # of its samples only the actions, while ours have every column
        yield Row(f"{work} (peer: Rerun)", "samples/s", mine, theirs_too, mine / theirs_too, "", None)


def of_rerun(folder: Path, rounds: int) -> float:
    """Windows of actions a second through Rerun's loader, from its server on this machine."""
    import rerun
    from rerun.experimental import LeRobotReader
    from rerun.experimental.dataloader import DataSource, Field, NumericDecoder, RerunMapDataset

    reader = LeRobotReader(folder)
    with tempfile.TemporaryDirectory(prefix="actrm-bench-") as name:
        files = [Path(name) / f"{episode}.rrd" for episode in reader.episodes()]
        for episode, file in zip(reader.episodes(), files, strict=True):
            told = {"application_id": folder.name, "recording_id": f"episode_{episode}"}
            reader.stream(episode, video_mode="skip").write_rrd(file, **told)
        with rerun.server.Server(host="127.0.0.1", datasets={"set": files}) as server:
            source = DataSource(server.client().get_dataset("set"))
            action = Field("/action:Scalars:scalars", decode=NumericDecoder(), window=tuple(range(HORIZON)))
            data = RerunMapDataset(source, "frame_index", {"action": action})

            def batches() -> Iterator[dict[str, Any]]:
                while True:
                    yield from torch.utils.data.DataLoader(data, batch_size=BATCH, shuffle=True, drop_last=True)

            return samples_per_second(batches, 8, rounds)


def waits(folder: Path, rounds: int) -> Row:
    """What a training step of LeRobot's ACT waits for its batch, as a share of the step."""
    policy = lerobot_act("d256")
    ours = actrm.Dataset(folder, {"action": range(SIZES["d256"]["chunk_size"])})
    optimiser = torch.optim.AdamW(policy.parameters(), 1e-5)
    shares = []
    for _ in range(rounds):
        waited = stepped = 0.0
        batches = iter(ours.batches(BATCH, seed=1, steps=4))
        for _ in range(4):
            begun = time.perf_counter()
            batch = {k: torch.from_numpy(v) for k, v in next(batches).items() if isinstance(v, np.ndarray)}
            waited += time.perf_counter() - begun
            begun = time.perf_counter()
            loss, _ = policy.forward(batch)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            stepped += time.perf_counter() - begun
        shares.append(100 * waited / stepped)
    return least("Python: a PyTorch ACT step (d256, batch 64) waits for data", "%", min(shares), 1)


def lerobot_act(size: str) -> Any:
    """LeRobot's ACT with weights drawn at random."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    torch.manual_seed(0)
    config = ACTConfig(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (9,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (10,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        n_action_steps=SIZES[size]["chunk_size"],
        device="cpu",
        push_to_hub=False,
        **SIZES[size],
    )
    return ACTPolicy(config)


def exported(policy: Any, folder: Path) -> dict[str, Callable[[dict[str, np.ndarray]], Any]]:
    """The runtimes that are there, each with the network that was exported for it."""

    class Net(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.model = policy.model

        def forward(self, state: torch.Tensor, environment: torch.Tensor) -> torch.Tensor:
            batch = {"observation.state": state, "observation.environment_state": environment}
            return self.model(batch)[0]

    net, given = Net().eval(), (torch.zeros(1, 9), torch.zeros(1, 10))
    names = ("observation.state", "observation.environment_state")
    ask: dict[str, Callable[[dict[str, np.ndarray]], Any]] = {}
    if has("onnxruntime") and has("onnx"):
        import onnxruntime

        torch.onnx.export(net, given, folder / "net.onnx", input_names=["a", "b"], dynamo=has("onnxscript"))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        session = onnxruntime.InferenceSession(folder / "net.onnx", options, providers=["CPUExecutionProvider"])
        ask["ONNX Runtime"] = lambda seen: session.run(None, {"a": seen[names[0]], "b": seen[names[1]]})
    if has("openvino"):
        import openvino

        core = openvino.Core()
        core.set_property("CPU", {"INFERENCE_NUM_THREADS": 1})
        model = openvino.convert_model(net, example_input=given)
        # left to itself it rounds weights and values to bfloat16 where the processor can multiply them
        for peer, precision in (("OpenVINO", {"INFERENCE_PRECISION_HINT": "f32"}), (ROUNDED, {})):
            compiled = core.compile_model(model, "CPU", {"PERFORMANCE_HINT": "LATENCY"} | precision)
            ask[peer] = lambda seen, compiled=compiled: compiled([seen[name] for name in names])
    return ask


def first(answer: Any) -> np.ndarray:
    """The first output of a runtime's answer."""
    return np.asarray(answer[0])


def has(module: str) -> bool:
    """Whether it can be imported."""
    try:
        importlib.import_module(module)
    except ImportError:
        return False
    return True


def milliseconds(work: Callable[[], Any], count: int) -> float:
    """One call, of so many."""
    begun = time.perf_counter()
    for _ in range(count):
        work()
    return 1e3 * (time.perf_counter() - begun) / count


def latency(size: str, rounds: int) -> Iterator[Row]:
    """One observation to one chunk, called from Python."""
    from lerobot.policies.factory import make_pre_post_processors

    theirs = lerobot_act(size).eval()
    stats = {
        name: {
            "mean": torch.zeros(width),
            "std": torch.ones(width),
            "min": -torch.ones(width),
            "max": torch.ones(width),
        }
        for name, width in (("observation.state", 9), ("observation.environment_state", 10), ("action", 7))
    }
    with tempfile.TemporaryDirectory(prefix="actrm-bench-") as name:
        folder = Path(name)
        theirs.save_pretrained(folder)
        for pipeline in make_pre_post_processors(theirs.config, dataset_stats=stats):
            pipeline.save_pretrained(folder)
        ours = actrm.load_policy(folder)
        peers = exported(theirs, folder)
        seen = {key: np.full((1, *shape), 0.1, np.float32) for key, shape in ours.input_features.items()}
        tensors = {key: torch.from_numpy(value) for key, value in seen.items()}
        wanted = theirs.predict_action_chunk(dict(tensors)).detach().numpy()
        np.testing.assert_allclose(ours.predict_action_chunk(seen), wanted, atol=1e-4)
        off = {peer: float(np.abs(first(ask(seen)) - wanted).max()) for peer, ask in peers.items()}
        for peer in off.keys() - {ROUNDED}:
            assert off[peer] <= 1e-4, f"{peer} computes something else: {off[peer]}"
        count = 200 if size == "d256" else 20
        asked: dict[str, Callable[[], Any]] = {"ours": lambda: ours.predict_action_chunk(seen)}
        asked |= {peer: (lambda ask=ask: ask(seen)) for peer, ask in peers.items()}
        asked["PyTorch"] = lambda: theirs.predict_action_chunk(dict(tensors))
        best = {who: float("inf") for who in asked}
        for _ in range(rounds):
            for who, work in asked.items():
                work()
                best[who] = min(best[who], milliseconds(work, count))
    for peer in ("ONNX Runtime", "OpenVINO", ROUNDED, "PyTorch"):
        work = f"Python: predict_action_chunk {size}, batch 1, one thread (peer: {peer})"
        if peer != ROUNDED:
            yield cost(work, "ms", best["ours"], best.get(peer), 1.0)
        elif peer in best:
            # no bar: where it rounds, it is another network
            work = f"{work[:-1]}, off by {off[peer]:.1g})"
            yield Row(work, "ms", best["ours"], best[peer], best["ours"] / best[peer], "", None)


def imports(rounds: int) -> Row:
    """`import actrm` in a new interpreter."""
    script = "import time; t = time.perf_counter(); import actrm; print(time.perf_counter() - t)"
    took = [float(subprocess.check_output([sys.executable, "-c", script])) for _ in range(max(rounds, 3))]
    return least("Python: import actrm", "s", min(took), 0.1)


def wheel() -> Row:
    """The wheel, programs and all."""
    (path,) = (TARGET / "wheels").glob("actrm-*.whl")
    return least("Python: the wheel, with both programs", "MB", path.stat().st_size / 1e6, 60)


def with_cameras(source: Path, out: Path) -> None:
    """A data set of two cameras, pixels drawn at random."""
    import h5py

    rng = np.random.default_rng(1)
    path = out.with_suffix(".hdf5")
    with h5py.File(source) as file, h5py.File(path, "w") as made:
        data = made.require_group("data")
        for key, value in file["data"].attrs.items():
            data.attrs[key] = value
        for name in sorted(file["data"])[:4]:
            file.copy(file["data"][name], data, name=name)
            length = len(data[name]["actions"])
            for key in ("agentview_image", "robot0_eye_in_hand_image"):
                data[name]["obs"][key] = rng.integers(0, 256, (length, 84, 84, 3), dtype=np.uint8)
    actrm.convert(path, out, progress=False, lossless=False)


def main() -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="groups whose name has this word: windows, waits, latency, package")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=TARGET / "bench/python.json")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="actrm-bench-") as name:
        folder = Path(name)
        actrm.convert(ROOT / "data/lift.hdf5", folder / "lift", progress=False)
        if args.only in "windows":
            rows += windows(folder / "lift", False, args.rounds)
            with_cameras(ROOT / "data/lift.hdf5", folder / "cameras")
            rows += windows(folder / "cameras", True, args.rounds)
        if args.only in "waits":
            rows.append(waits(folder / "lift", args.rounds))
    if args.only in "latency":
        rows += [row for size in SIZES for row in latency(size, args.rounds)]
    if args.only in "package":
        rows += [imports(args.rounds), wheel()]
    for row in rows:
        shown = [f"{value:.4g}" if value is not None else "-" for value in (row.ours, row.peer, row.ratio)]
        verdict = "-" if row.met is None else "ok" if row.met else "MISSED"
        print(f"{row.work:<100} {shown[0]:>10} {row.unit:<10} {shown[1]:>10} {shown[2]:>9}  {row.bar:<24} {verdict}")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps({"bench": "python", "rows": [asdict(row) for row in rows]}, indent=1) + "\n")
    print(f"written: {args.out}")
    return 0 if all(row.met is not False for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
