"""`actrm-zoo compare` beside the packages of N-SCORE and SAVI; STEP by its authors' package on two shipped results."""

import csv
import json
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = runpy.run_path(str(ROOT / "crates" / "report" / "fixtures" / "make.py"))
# the scripted expert is far ahead
BETTER, WORSE = "nutassemblysquare-expert-s1@1", "nutassemblysquare-act-s1@1"


def two_sided(one: float, other: float) -> float:
    """The p-value of two one-sided tests at once."""
    return min(1.0, 2.0 * min(one, other))


def compare_p_values(folder: Path, ours: Callable[..., str], tables: int = 40) -> float:
    """Random tables; returns the largest relative difference."""
    folder.mkdir()
    rng = np.random.default_rng()
    hypothesis = PACKAGES["SaviHypothesis"]
    largest = 0.0
    for table in range(tables):
        count = int(rng.integers(5, 300))
        first, second = (
            [int(draw < rate) for draw in rng.random(count)] for rate in rng.choice([0.05, 0.3, 0.5, 0.8, 0.95], 2)
        )
        path = folder / f"{table}.csv"
        with path.open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(["task", "policy", "success", "episode"])
            for policy, outcomes in (("one", first), ("two", second)):
                rows.writerows(["Lift", policy, outcome, episode] for episode, outcome in enumerate(outcomes))
        [found] = json.loads(ours("actrm-zoo", "compare", f"{path}:one", f"{path}:two", "--json"))
        nscore, savi = PACKAGES["nscore"], PACKAGES["savi"]
        expected = {
            "nscore_p_value": two_sided(nscore(second, first), nscore(first, second)),
            "savi_p_value": two_sided(
                savi(first, second, hypothesis.P0MoreThanP1), savi(first, second, hypothesis.P0LessThanP1)
            ),
        }
        for name, value in expected.items():
            difference = abs(found[name] / value - 1.0)
            assert difference < 1e-9, f"{path}: {name} {found[name]}, the package says {value}"
            largest = max(largest, difference)
    return largest


def compare_step(run: Callable[..., str]) -> str:
    """examples/step.py on two results, in both orders, and on one beside itself."""

    def decide(one: str, other: str) -> str:
        [one], [other] = (
            [str(path) for path in (ROOT / "zoo" / "results").glob(f"{name}_*_40000-40199_*")] for name in (one, other)
        )
        return run([sys.executable, ROOT / "examples" / "step.py", one, other]).strip()

    first, second, same = decide(BETTER, WORSE), decide(WORSE, BETTER), decide(BETTER, BETTER)
    assert first.startswith("the first succeeds more often"), first
    assert second.startswith("the second succeeds more often"), second
    assert first.split()[-6:] == second.split()[-6:], (first, second)
    assert same.startswith("not decided after 200 episodes"), same
    return first


def compare(folder: Path, ours: Callable[..., str], run: Callable[..., str]) -> str:
    """Both checks."""
    largest = compare_p_values(folder, ours)
    return f"p-values within {largest:.0e} on 40 random tables; STEP: {compare_step(run)}"
