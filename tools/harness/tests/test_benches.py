"""What the benchmarks conclude from their numbers."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

BENCHES = Path(__file__).resolve().parents[3] / "benches"


def load(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(f"bench_{name}", BENCHES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_two_of_one_distribution_rarely_miss_and_a_coarser_loop_is_noticed() -> None:
    further = load("control").further
    rng = np.random.default_rng(1)

    def missed(decades: float) -> float:
        """Share of comparisons that miss: as here, distances spread over many orders of magnitude."""
        runs = 1500
        misses = 0
        for _ in range(runs):
            ours = list(10.0 ** rng.normal(-9.0 + decades, 2.5, size=20))
            theirs = list(10.0 ** rng.normal(-9.0, 2.5, size=20))
            share, most = further(ours, theirs)
            misses += share > most
        return misses / runs

    # a run in a thousand; three times that would be noticed here with 99.9%
    assert missed(0.0) < 0.005
    assert missed(5.0) > 0.95


def test_ranks_count_ties_as_half() -> None:
    further = load("control").further
    assert further([0.0] * 20, [0.0] * 20)[0] == 0.5
    assert further([1.0] * 20, [0.0] * 20)[0] == 1.0
    assert further([1.0, 3.0], [2.0, 3.0])[0] == (0.0 + 0.0 + 1.0 + 0.5) / 4


def summary(folder: Path, *words: str) -> tuple[int, str]:
    command = [sys.executable, str(BENCHES / "summary.py"), *words]
    done = subprocess.run(command, env={"CARGO_TARGET_DIR": str(folder)}, capture_output=True, text=True, check=False)
    assert not done.stderr, done.stderr
    return done.returncode, done.stdout


def test_the_table_holds_every_row_and_goes_on_past_a_missed_one(tmp_path: Path) -> None:
    folder = tmp_path / "bench"
    folder.mkdir()
    written: dict[str, Any] = {
        "data": [
            {"work": "convert", "unit": "frames/s", "ours": 9.0, "peer": "LeRobot", "theirs": 1.0, "ratio": 9.0}
            | {"ratio_bar": 3.0, "bar": None, "met": True},
            {"work": "no peer here", "unit": "frames/s", "ours": 9.0, "peer": None, "theirs": None, "ratio": None}
            | {"ratio_bar": 3.0, "bar": None, "met": False},
        ],
        "act": [{"work": "train", "unit": "ms", "ours": 1.0, "peer": 2.0, "ratio": 0.5, "bar": 1.0, "met": True}],
        "trm": [{"work": "step", "ours_s": 0.1, "peer_s": 0.3, "ratio": 0.333, "bar": 0.2}],
        "control": {
            "rows": [
                {"work": "env.step", "unit": "ms", "ours": 1.0, "peer": 5.0, "ratio": 5.0, "bar": ">= 5", "met": True},
                {
                    "work": "wish",
                    "unit": "ms",
                    "ours": 1.0,
                    "peer": 1.0,
                    "ratio": 1.0,
                    "bar": "aim",
                    "met": False,
                    "aim": True,
                },
            ]
        },
    }
    for name, rows in written.items():
        (folder / f"{name}.json").write_text(json.dumps(rows))
    code, text = summary(tmp_path, "data=0", "act=0", "trm=1", "control=0", "evaluation=134")
    assert code == 1
    lines = text.splitlines()
    verdicts = [line.split()[-1] for line in lines[1:-1]]
    assert verdicts == ["ok", "bar", "ok", "MISSED", "ok", "over", "FAILED"], text
    assert lines[-1].startswith("7 rows, 2 bars missed, on ")
    code, text = summary(tmp_path, "act=0", "control=0")
    assert code == 0, text
    code, text = summary(tmp_path, "act=101")
    assert code == 1 and "exit code 101" in text
