"""The page of trainings by the references: its intervals, its settings, and that it is what the results say."""

import importlib
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def references(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(sys, "path", [*sys.path, str(ROOT / "benches" / "peers")])
    return importlib.import_module("references")


@pytest.fixture
def page(references: Any) -> Any:
    assert references.CELLS
    return importlib.import_module("references_page")


def test_intervals_are_wilsons_and_newcombes(page: Any) -> None:
    # the first rows of table II of Newcombe, Statistics in Medicine 17 (1998), page 873, method 10
    for first, second, low, high in (
        ((56, 70), (48, 80), 0.0524, 0.3339),
        ((9, 10), (3, 10), 0.1705, 0.8090),
        ((10, 10), (0, 20), 0.6791, 1.0),
    ):
        difference, below, above = page.newcombe(first, second)
        assert difference == pytest.approx(first[0] / first[1] - second[0] / second[1])
        assert (below, above) == pytest.approx((low, high), abs=1e-4)
    assert page.wilson(200, 200) == pytest.approx((0.9812, 1.0), abs=1e-4)
    assert page.wilson(0, 200) == pytest.approx((0.0, 0.0188), abs=1e-4)


def test_settings_are_those_of_our_own_trainings(references: Any) -> None:
    for name, entry in (("act_lift", "lift-act-s1"), ("act_pickplacecan", "pickplacecan-act-s1")):
        found = references.experiment(name)
        (config,) = (ROOT / "zoo" / entry).glob("*/config.toml")
        resolved = tomllib.loads(config.read_text())
        for table in ("policy", "train", "normalisation", "rollout"):
            for key, value in found[table].items():
                assert resolved[table][key] == value, (name, table, key)
        assert found["policy"]["type"] == "act" and found["train"]["steps"] > 0


def test_the_page_is_what_the_results_say(page: Any) -> None:
    assert page.PAGE.read_text() == page.page()
    results = sorted(page.RESULTS.glob("*.json"))
    assert results, "no results of references"
    names = {f"{cell.name}.json" for cell in page.CELLS}
    assert {path.name for path in results} <= names
