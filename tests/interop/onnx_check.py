"""Exported ONNX models in onnxruntime, beside our own predictions."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
from safetensors.numpy import load_file

ROWS = 1000
# of the largest action; onnxruntime with and without its optimisations differs from itself by half of this
TOLERANCE = 1e-5


def observations(zoo: Path, entry: str) -> dict[str, np.ndarray]:
    """Normal observations with the mean and the deviation that the entry's demonstrations had, (ROWS, width) each."""
    name, version = entry.split("@")
    statistics = load_file(zoo / name / version / "normaliser.safetensors")
    features = {key.rsplit(".", 1)[0] for key in statistics if key.startswith("observation.")}
    rng = np.random.default_rng(7)
    drawn = {}
    for feature in sorted(features):
        mean, std = statistics[f"{feature}.mean"], statistics[f"{feature}.std"]
        drawn[feature] = (mean + std * rng.standard_normal((ROWS, mean.size))).astype(np.float32)
    return drawn


def compare(
    zoo: Path, entry: str, out: Path, predict: Path, ours: Callable[..., str], run: Callable[..., str]
) -> float:
    """The largest difference of an entry's exported model from its own predictions, relative to the largest action."""
    drawn = observations(zoo, entry)
    asked = [
        {key.removeprefix("observation."): [float(x) for x in values[row]] for key, values in drawn.items()}
        for row in range(ROWS)
    ]
    expected = np.array(json.loads(run([predict, zoo, entry], json.dumps(asked))), dtype=np.float64)
    ours("actrm-zoo", "export", "onnx", entry, out, "--zoo", zoo)
    session = onnxruntime.InferenceSession(str(out), providers=["CPUExecutionProvider"])
    inputs = {node.name: drawn[node.name] for node in session.get_inputs()}
    assert set(inputs) == set(drawn), (sorted(inputs), sorted(drawn))
    (action,) = session.run(["action"], inputs)
    assert action.shape == expected.shape, (action.shape, expected.shape)
    return float(np.abs(action - expected).max() / np.abs(expected).max())


def check(
    shipped: Path, trained: Path, folder: Path, predict: Path, ours: Callable[..., str], run: Callable[..., str]
) -> str:
    """Three shipped ACT entries and a BC answer the same in onnxruntime, to 1e-5 of the largest action."""
    folder.mkdir()
    found = {}
    cases = [(shipped, f"{task}-act@1") for task in ("lift", "door", "stack")] + [(trained, "lift-bc@1")]
    for zoo, entry in cases:
        found[entry] = compare(zoo, entry, folder / f"{entry}.onnx", predict, ours, run)
    far = {entry: off for entry, off in found.items() if off > TOLERANCE}
    assert not far, f"actions differ by more than {TOLERANCE:g}: {far}"
    return f"{ROWS} observations each, largest differences " + ", ".join(f"{e} {off:.1e}" for e, off in found.items())
