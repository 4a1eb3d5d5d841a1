"""Policies of the user's own: the outcomes of an entry, what is given, what is refused."""

from __future__ import annotations

import copy
import importlib
import json
import os
import subprocess
import sys
import textwrap
import warnings
from pathlib import Path
from typing import Any

import actrm
import numpy as np
import pytest
from actrm._policies import code  # pyright: ignore[reportPrivateUsage]
from conftest import ROOT, output

LIFT_ACT = ROOT / "zoo/lift-act"


class Entry:
    """An entry, posing as a policy of the user's."""

    def __init__(self) -> None:
        self.policy = actrm.load_policy(LIFT_ACT)

    def __deepcopy__(self, memo: dict[int, Any]) -> Entry:
        return Entry()

    def reset(self, seed: int) -> None:
        self.policy.reset(seed)

    def select_action(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return self.policy.select_action(observation)

    def predict_action_chunk(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return self.policy.predict_action_chunk(observation)


def test_an_entry_s_policy_has_the_entry_s_outcomes(zoo: Path, tmp_path: Path) -> None:
    own = actrm.evaluate(LIFT_ACT, episodes=6, results=tmp_path / "own", progress=False)
    steps = int(actrm.load_policy(LIFT_ACT).n_action_steps)
    for workers, options in ((1, {}), (3, {}), (2, {"n_action_steps": steps})):
        results = tmp_path / f"{workers}"
        given = {"name": "mine", "task": "Lift", "episodes": 6, "workers": workers, "zoo": zoo, "results": results}
        ours = actrm.evaluate(Entry(), progress=False, **given, **options)
        for column in ("seed", "success", "steps", "return", "fingerprint"):
            assert list(own[column]) == list(ours[column]), (workers, column)
    # the same settings are the same entry, others a new version
    assert sorted(path.name for path in (zoo / "mine").iterdir() if path.is_dir()) == ["1", "2"]
    rows = actrm.leaderboard(zoo, results=tmp_path / "3")
    assert [(row["entry"], row["policy"], row["successes"]) for row in rows] == [("mine", "external", 6)]


def test_the_page_s_policy_is_ranked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / "docs/howto/own_policy.md").read_text()
    lines = text[text.index("    import actrm\n") :].splitlines()
    end = next(i for i, line in enumerate(lines) if line and not line.startswith("    "))
    example = textwrap.dedent("\n".join(lines[:end])).strip()
    assert example.count("\n") < 16
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(example, "howto_own_policy.md", "exec"), names)
    assert names["episodes"]["success"].mean() > 0.8
    assert [row["entry"] for row in actrm.leaderboard("zoo")] == ["reach"]


def test_the_episode_s_instruction_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "tools/harness/tests"))
    seen: list[Any] = []

    def slide(observation: dict[str, Any]) -> np.ndarray:
        seen.append(observation["task"])
        return -np.ones(1)

    task = {"task": "Slide", "env_module": "toy_simulator", "inputs": {"observation.state": ["place"]}}
    actrm.evaluate(slide, episodes=2, workers=1, name="slide", zoo=tmp_path, progress=False, **task)
    assert len(seen) > 2 and set(seen) == {"slide to zero"}


def test_images_and_keys_that_are_asked_for_are_given(tmp_path: Path) -> None:
    seen: list[dict[str, np.ndarray]] = []

    def look(observation: dict[str, np.ndarray]) -> np.ndarray:
        seen.append(copy.deepcopy(observation))
        return np.zeros(7)

    inputs = {"observation.images.agentview": ["agentview_image"], "gripper": ["robot0_gripper_qpos"]}
    actrm.evaluate(
        look, episodes=1, workers=1, name="look", task="Lift", inputs=inputs, image_size=32, max_steps=2, zoo=tmp_path
    )
    assert len(seen) == 2
    assert {name: (value.shape, value.dtype.name) for name, value in seen[0].items()} == {
        "observation.images.agentview": ((32, 32, 3), "uint8"),
        "gripper": ((2,), "float32"),
    }
    assert seen[0]["observation.images.agentview"].std() > 10
    meta = json.loads((tmp_path / "look/1/entry.json").read_text())
    assert meta["policy"] == "external" and meta["parameters"] == 0


def test_a_policy_that_fails_is_no_failed_episode(tmp_path: Path) -> None:
    asked = []

    def fails(observation: dict[str, np.ndarray]) -> np.ndarray:
        asked.append(0)
        if len(asked) > 15:
            raise KeyError("weights")
        return np.zeros(7)

    options = {"name": "fails", "task": "Lift", "episodes": 3, "workers": 1, "max_steps": 10, "zoo": tmp_path}
    with pytest.raises(actrm.Error, match="seed 10001, step 5: querying the policy: .*KeyError") as raised:
        actrm.evaluate(fails, progress=False, **options)
    assert isinstance(raised.value.__cause__, KeyError)
    # the first episode is kept
    told: list[int] = []
    asked.clear()
    with pytest.raises(actrm.Error):
        actrm.evaluate(fails, progress=lambda done, _: told.append(done), **options)
    assert told[0] == 1

    for answer, words in (
        (np.zeros(6), "6 values"),
        (np.full(7, np.nan), "NaN at index 0"),
        (np.zeros((2, 2, 2)), r"found \(2, 2, 2\)"),
        ("no", "could not convert"),
    ):
        with pytest.raises(actrm.Error, match=words):
            actrm.evaluate(lambda _, answer=answer: answer, progress=False, **{**options, "name": "other"})


def test_another_policy_under_one_name_is_not_taken_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An edited class is another version; what nobody can tell apart is said."""
    monkeypatch.syspath_prepend(tmp_path)
    text = "class Policy:\n    def select_action(self, observation):\n        return [{}] * 7\n"
    options = {"name": "mine", "task": "Lift", "workers": 1, "max_steps": 3, "zoo": tmp_path / "zoo", "progress": False}
    for number, version in (("0.0", 1), ("0.25", 2), ("0.0", 1)):
        (tmp_path / f"policy_{version}.py").write_text(text.format(number))
        module = importlib.import_module(f"policy_{version}")
        module.Policy.__module__ = "policy"
        monkeypatch.setitem(sys.modules, "policy", module)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            actrm.evaluate(module.Policy(), episodes=2, **options)
        versions = sorted(path.name for path in (tmp_path / "zoo/mine").iterdir() if path.is_dir())
        assert versions == ["1", "2"][: len(versions)] and str(version) in versions
    # the last one is the first one again
    assert [str(one.message) for one in said if "earlier call" in str(one.message)] == [
        "2 of the episodes are those of an earlier call, of entry mine@1: another policy needs another name=, and "
        "other weights need another declared="
    ]
    with pytest.warns(actrm.ResultsTakenOver, match="^2 of the episodes are those of an earlier call, of entry mine@1"):
        actrm.evaluate(module.Policy(), episodes=3, **options)


def test_results_that_are_taken_over_are_said_every_time(tmp_path: Path) -> None:
    """At the line of the caller's."""
    script = """
import sys
import actrm
slide = {"task": "Slide", "env_module": "toy_simulator", "inputs": {"observation.state": ["place"]}}
for turn in range(4):
    actrm.evaluate(lambda _: [-1.0], name="own", episodes=2, workers=1, zoo=sys.argv[1], progress=False, **slide)
"""
    (tmp_path / "own.py").write_text(script)
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "tools/harness/tests")}
    said = subprocess.run(
        [sys.executable, str(tmp_path / "own.py"), str(tmp_path)], capture_output=True, text=True, env=environment
    )
    assert said.returncode == 0 and said.stderr.count("own.py:6: ResultsTakenOver: 2 of the episodes") == 3


CLASS = """
import dataclasses
import functools

class Base:
    gain = {gain}
    @staticmethod
    def limit(x):
        return x {limit} 2
    @property
    def half(self):
        return self.gain / {half}

@dataclasses.dataclass
class Policy(Base):
    weight: float = 1.0
    def select_action(self, observation):
        kinds = observation["kind"] in {{"a", "b", "c", {kind!r}}}
        return [self.limit(kinds)] * 7

part = functools.partial(lambda k, seen: k {limit} 1, {half})
"""


def test_the_code_that_runs_tells_versions_apart(tmp_path: Path) -> None:
    """Not the file, which may have been edited since, or be a notebook; the same in every process."""

    def made(**other: Any) -> dict[str, Any]:
        names: dict[str, Any] = {"__name__": "own"}
        text = CLASS.format(**{"gain": 1, "limit": "+", "half": 2, "kind": "d", **other})
        lines = "\n" * other.get("lines", 0)
        exec(compile(lines + text, "nowhere.py", "exec", dont_inherit=True), names)
        return names

    usual = made()
    known = code(usual["Policy"]())
    assert known == code(made(lines=3)["Policy"]()) and code(usual["part"]) == code(made(gain=3)["part"])
    others = [{"gain": 2}, {"limit": "-"}, {"half": 3}, {"kind": "e"}]
    assert len({known, *(code(made(**other)["Policy"]()) for other in others)}) == 5
    assert len({code(made(**other)["part"]) for other in others}) == 3
    for _ in range(100):
        # Python rewrites code that has run often
        usual["Policy"]().select_action({"kind": "a"})
    assert code(usual["Policy"]()) == known and code(usual["Policy"]().select_action) not in (known, None)
    assert code(len) is code(actrm.load_policy(LIFT_ACT)) is None
    (tmp_path / "own.py").write_text(CLASS.format(gain=1, limit="+", half=2, kind="d"))
    script = "import own; from actrm._policies import code; print(code(own.Policy()))"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONHASHSEED": "7"}
    assert output(sys.executable, "-c", script, env=environment).decode().strip() == known


class Chunks:
    def predict_action_chunk(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return np.zeros((4, 7))


class Uncopied:
    def __init__(self) -> None:
        self.file = (one for one in ())
        self.begun = 0

    def reset(self) -> None:
        self.begun += 1

    def select_action(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return np.zeros(7)


def test_one_simulator_takes_the_object_itself(tmp_path: Path) -> None:
    policy = Uncopied()
    actrm.evaluate(policy, name="mine", task="Lift", episodes=2, workers=1, max_steps=2, zoo=tmp_path, progress=False)
    assert policy.begun == 2


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="there is one core anyway")
def test_a_process_on_one_core_has_one_simulator(tmp_path: Path) -> None:
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        # several would need copies of the policy
        with pytest.raises(actrm.Error, match="`task`: expected a task"):
            actrm.evaluate(Uncopied(), name="mine", zoo=tmp_path)
    finally:
        os.sched_setaffinity(0, cores)


def test_what_cannot_be_asked_is_refused_by_name(zoo: Path, tmp_path: Path) -> None:
    for policy, options, words in (
        (Chunks(), {"task": "Lift"}, "n_action_steps: expected how many"),
        (Uncopied(), {"task": "Lift", "workers": 2}, "workers: expected 1"),
        (
            Uncopied(),
            {"task": "Lift", "n_action_steps": 2},
            "n_action_steps: expected a policy with predict_action_chunk",
        ),
        (Chunks(), {"task": "Lift", "n_action_steps": 1, "image_size": 0}, "image_size: expected at least 1, found 0"),
        (Chunks(), {"task": "Lift", "n_action_steps": 0}, "n_action_steps: expected at least 1, found 0"),
        (Chunks(), {"task": "Lift", "temporal_ensemble": float("nan")}, "temporal_ensemble`: expected a finite number"),
        (Chunks(), {"task": "Lift", "temporal_ensemble": 0.0, "workers": 0}, "workers: expected 1 to 1024, found 0"),
        (Chunks().predict_action_chunk, {"task": "Stack", "protocol": "lift-v1"}, "task: protocol lift-v1 fixes it"),
        (Chunks().predict_action_chunk, {"seed": 7, "protocol": "lift-v1"}, "seed: protocol lift-v1 fixes it"),
        (
            Chunks().predict_action_chunk,
            {"control": "compiled", "protocol": "lift-v1"},
            "control: protocol lift-v1 fixes it",
        ),
    ):
        with pytest.raises(ValueError, match=words):
            actrm.evaluate(policy, name="mine", zoo=tmp_path, **options)
    for options, words in (
        ({}, "`task`: expected a task"),
        ({"task": "Lift", "name": "lift-act", "zoo": zoo}, "lift-act@"),
        ({"task": "Lift", "inputs": {"observation.state": ["robot0_eef_pso"]}}, "robot0_eef_pso"),
        ({"protocol": "lfit-v1"}, "did you mean `lift-v1`"),
        ({"task": "Lift", "conventions": {"control_freq": "10"}}, "control_freq: expected 10, found 20"),
    ):
        with pytest.raises(actrm.Error, match=words):
            actrm.evaluate(lambda _: np.zeros(7), **{"name": "mine", "zoo": tmp_path, **options})
    # and leaves nothing behind
    assert not (tmp_path / "mine").exists() and not (tmp_path / "results").exists()
    with pytest.raises(TypeError, match=r"inputs\['a'\]: expected a list of names, such as \['object'\]"):
        actrm.evaluate(Chunks(), name="mine", task="Lift", n_action_steps=1, inputs={"a": "object"})
    with pytest.raises(TypeError, match="found int"):
        actrm.evaluate(3, name="mine", task="Lift")
    with pytest.raises(ValueError, match="name: expected"):
        actrm.evaluate(Chunks(), task="Lift")
    with pytest.raises(ValueError, match="name: expected with a policy of yours"):
        actrm.evaluate(LIFT_ACT, name="mine")
    # an entry without weights is not loaded, and says why
    with pytest.raises(actrm.Error, match="not in this zoo"):
        actrm.evaluate(lambda _: np.zeros(7), name="here", task="Lift", episodes=1, max_steps=1, zoo=tmp_path)
        actrm.load_policy("here", zoo=tmp_path)
