"""Conversion, evaluation and leaderboard: the work itself, its progress, and Ctrl-C."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import actrm
import numpy as np
import pytest
from actrm import _actrm  # pyright: ignore[reportPrivateUsage]
from conftest import LIFT, RELEASE, ROOT, output


def test_a_conversion_is_the_program_s(lift: Path, tmp_path: Path) -> None:
    output(RELEASE / "actrm-data", "convert", LIFT, tmp_path / "other")
    files = sorted(path.relative_to(lift) for path in lift.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(tmp_path / "other") for path in (tmp_path / "other").rglob("*.*"))
    for file in files:
        assert (lift / file).read_bytes() == (tmp_path / "other" / file).read_bytes(), file


def test_progress_is_told_and_the_report_says_what_was_written(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    report = actrm.convert(LIFT, tmp_path / "set", progress=lambda done, total: told.append((done, total)))
    ds = actrm.Dataset(tmp_path / "set")
    assert (report["episodes"], report["frames"]) == (ds.num_episodes, len(ds))
    assert report["fingerprint"] == ds.fingerprint
    assert told[0] == (0, len(ds)) and told[-1] == (len(ds), len(ds)) and told == sorted(told)


def test_a_bar_is_drawn_where_it_is_wanted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    actrm.convert(LIFT, tmp_path / "a", progress=True)
    shown = capsys.readouterr()
    assert "\rconvert:" in shown.err and "100%|" in shown.err and shown.out == ""
    actrm.convert(LIFT, tmp_path / "b")
    assert capsys.readouterr().err == ""
    # a program with windows has no standard error
    monkeypatch.setattr(sys, "stderr", None)
    for progress in (None, True):
        actrm.convert(LIFT, tmp_path / f"c{progress}", progress=progress)


def test_a_caller_that_fails_ends_the_conversion(tmp_path: Path) -> None:
    def fail(done: int, total: int) -> None:
        raise LookupError("enough")

    with pytest.raises(LookupError, match="enough"):
        actrm.convert(LIFT, tmp_path / "set", progress=fail)
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_ends_a_conversion_and_leaves_nothing(tmp_path: Path) -> None:
    """While it is told of the first frames the process gets what a terminal sends."""
    script = """
import actrm, os, signal, sys, time
def told(done, total):
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)
try:
    actrm.convert(sys.argv[1], sys.argv[2], progress=told)
except KeyboardInterrupt:
    sys.exit(42)
"""
    begun = time.monotonic()
    done = subprocess.run([sys.executable, "-c", script, str(LIFT), str(tmp_path / "set")], check=False)
    assert done.returncode == 42 and time.monotonic() - begun < 10
    assert list(tmp_path.iterdir()) == []


def test_other_threads_run_meanwhile(tmp_path: Path) -> None:
    """Whoever counts on another thread gets on while frames are written."""
    import threading

    going, count = True, 0

    def work() -> None:
        nonlocal count
        while going:
            count += 1
            time.sleep(0)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        before = count
        actrm.convert(LIFT, tmp_path / "set", progress=False)
        assert count > before + 100
    finally:
        going = False
        thread.join()


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "not an HDF5 file"), (b"hello" * 100, "not an HDF5 file"), (LIFT.read_bytes()[:100_000], ".")],
)
def test_a_hostile_file_is_an_exception(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "bad.hdf5").write_bytes(content)
    with pytest.raises(actrm.Error, match=words):
        actrm.convert(tmp_path / "bad.hdf5", tmp_path / "set")
    assert [path.name for path in tmp_path.iterdir()] == ["bad.hdf5"]


def test_what_cannot_be_converted_is_an_exception(lift: Path, tmp_path: Path) -> None:
    with pytest.raises(actrm.Error, match="no such file or folder"):
        actrm.convert("nowhere.hdf5", tmp_path / "set")
    with pytest.raises(actrm.Error, match="exists already"):
        actrm.convert(LIFT, lift)
    with pytest.raises(actrm.Error, match="no_such_key"):
        actrm.convert(LIFT, tmp_path / "set", state_keys=["no_such_key"])
    with pytest.raises(ValueError, match="images: expected png, ppm or video, found jpg"):
        actrm.convert(LIFT, tmp_path / "set", images="jpg")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="state_keys: expected a list of names, such as ..object"):
        actrm.convert(LIFT, tmp_path / "set", state_keys="object")
    with pytest.raises(ValueError, match="jobs: expected a whole number from 0"):
        actrm.convert(LIFT, tmp_path / "set", jobs=-1)
    assert list(tmp_path.iterdir()) == []


def test_the_leaderboard_is_the_program_s(zoo: Path, tmp_path: Path) -> None:
    rows = actrm.leaderboard(ROOT / "zoo")
    output(RELEASE / "actrm-zoo", "leaderboard", "--zoo", ROOT / "zoo", "--out", tmp_path)
    with (tmp_path / "leaderboard.csv").open() as file:
        wanted = list(csv.DictReader(file))
    assert len(rows) == len(wanted) >= 6
    assert list(rows[0]) == list(wanted[0])
    for row, text in zip(rows, wanted, strict=True):
        for key, value in row.items():
            match value:
                case None:
                    assert text[key] == ""
                case float():
                    assert abs(value - float(text[key])) < 5.1e-3, key
                case _:
                    assert str(value) == text[key], key
    stack = next(row for row in rows if row["entry"] == "stack-act" and row["episodes"] == 200)
    assert (stack["successes"], stack["episodes"], stack["rank"]) == (199, 200, 1)
    for given in ({"zoo": tmp_path / "no zoo"}, {"zoo": ROOT / "zoo", "results": tmp_path / "no zoo"}):
        with pytest.raises(FileNotFoundError, match=f"{list(given)[-1]}: expected a folder, found none: .*no zoo"):
            actrm.leaderboard(**given)
    (tmp_path / "empty").mkdir()
    assert actrm.leaderboard(tmp_path / "empty") == []


def test_results_that_do_not_stand_are_left_out_and_named(zoo: Path, tmp_path: Path) -> None:
    import shutil

    other = tmp_path / "zoo"
    shutil.copytree(ROOT / "zoo", other)
    outcomes = next((other / "results").glob("lift-act@1_*/outcomes.parquet"))
    outcomes.write_bytes(outcomes.read_bytes()[:-1] + b"?")
    with pytest.warns(UserWarning, match="left out: .*lift-act.*outcomes.parquet"):
        rows = actrm.leaderboard(other)
    assert len(rows) == len(actrm.leaderboard(ROOT / "zoo")) - 1


def test_an_evaluation_repeats_what_was_stored(zoo: Path, tmp_path: Path) -> None:
    """The shipped outcomes of a seed are what its policy does, asked step by step from Python."""
    stored = actrm.evaluate(zoo / "stack-act", episodes=200, seed=40_000, progress=False)
    assert stored["success"].sum() == 199 and stored["seed"][:2].tolist() == [40_000, 40_001]
    again = actrm.evaluate(zoo / "stack-act", episodes=2, workers=2, seed=40_000, results=tmp_path / "results")
    for key in ("seed", "success", "steps", "return"):
        np.testing.assert_array_equal(again[key], stored[key][:2])
    assert again["fingerprint"] == stored["fingerprint"][:2]
    assert (again["inference_ms"] > 0).all() and again["failure"] == [None, None]
    policy = actrm.load_policy(zoo / "stack-act")
    simulator = actrm.Simulator(entry=zoo / "stack-act", python=os.environ["ACTRM_PYTHON"])
    for i in range(2):
        seed = int(stored["seed"][i])
        policy.reset(seed=seed)
        observation, info = simulator.reset(seed)
        assert info["fingerprint"] == stored["fingerprint"][i]
        rewards, success = [], False
        while not success and len(rewards) < simulator.max_steps:
            observation, reward, success, _ = simulator.step(policy.select_action(observation))
            rewards.append(reward)
        assert (success, len(rewards)) == (bool(stored["success"][i]), int(stored["steps"][i]))
        assert sum(rewards) == stored["return"][i]
    simulator.close()


def test_ctrl_c_ends_an_evaluation_which_then_goes_on(zoo: Path, tmp_path: Path) -> None:
    script = """
import actrm, os, signal, sys
def told(done, total):
    if done >= 1:
        os.kill(os.getpid(), signal.SIGINT)
try:
    actrm.evaluate(sys.argv[1], episodes=12, workers=1, results=sys.argv[2], progress=told)
except KeyboardInterrupt:
    sys.exit(42)
"""
    results = tmp_path / "results"
    done = subprocess.run([sys.executable, "-c", script, str(zoo / "lift-act"), str(results)], check=False)
    assert done.returncode == 42
    told: list[int] = []
    episodes = actrm.evaluate(
        zoo / "lift-act", episodes=12, workers=1, results=results, progress=lambda done, _: told.append(done)
    )
    assert told[0] >= 1 and told[-1] == 12 and len(episodes["seed"]) == 12


def test_what_cannot_be_evaluated_is_an_exception(zoo: Path, tmp_path: Path) -> None:
    evaluate = actrm.evaluate
    for arguments, words in [
        ({"episodes": 0}, "episodes: expected 1"),
        ({"episodes": -1}, "episodes: expected a whole number from 0"),
        ({"workers": 5000}, "workers: expected 1 to 1024"),
        ({"workers": 0}, "workers: expected 1 to 1024"),
        ({"max_steps": 0}, "max_steps"),
        ({"n_action_steps": 3, "temporal_ensemble": 0.1}, "expected one of them"),
        ({"control": "none"}, 'expected "robosuite" or "compiled"'),
    ]:
        with pytest.raises(ValueError, match=words):
            evaluate(zoo / "lift-act", **arguments)
    for arguments, words in [
        ({"temporal_ensemble": float("nan")}, "temporal_ensemble`: expected a finite number"),
        ({"temporal_ensemble": float("inf")}, "temporal_ensemble`: expected a finite number"),
        ({"n_action_steps": 0}, "n_action_steps`: expected 1 to the action horizon"),
        ({"n_action_steps": 10_000}, "n_action_steps`: expected 1 to the action horizon"),
    ]:
        with pytest.raises(actrm.Error, match=words):
            evaluate(zoo / "lift-act", results=tmp_path / "none", **arguments)
    assert not (tmp_path / "none").exists()
    with pytest.raises(actrm.Error, match="unknown entry `x`"):
        evaluate("x", zoo=zoo)
    with pytest.raises(actrm.Error, match="/no/such/python"):
        evaluate(zoo / "lift-act", python="/no/such/python", seed=123)


def test_a_signal_handler_of_the_caller_s_stays() -> None:
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_panic_is_an_exception_like_others() -> None:
    with pytest.raises(actrm.Error, match="^a defect of actrm, please report it: as the test asked$"):
        _actrm.panics()
