"""Other processes: forked and spawned workers, PyTorch's loader, programs, import time."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import actrm
import numpy as np
import pytest
from conftest import ROOT

# with a simulator that needs none
TOY = {**os.environ, "PYTHONPATH": str(ROOT / "tools/harness/tests")}


def asked(policy: actrm.Policy) -> dict[str, np.ndarray]:
    return {key: np.linspace(-0.5, 0.5, shape[0], dtype=np.float32) for key, shape in policy.input_features.items()}


def work(ds: actrm.Dataset, policy: actrm.Policy, queue: multiprocessing.Queue) -> None:
    queue.put((ds[7]["action"], policy.predict_action_chunk(asked(policy))))


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_data_and_policies_cross_into_other_processes(lift: Path, zoo: Path, method: str) -> None:
    context = multiprocessing.get_context(method)
    ds, policy = actrm.Dataset(lift, {"action": range(4)}), actrm.load_policy(zoo / "stack-act")
    wanted = policy.predict_action_chunk(asked(policy))
    queue = context.Queue()
    processes = [context.Process(target=work, args=(ds, policy, queue)) for _ in range(2)]
    [process.start() for process in processes]
    for _ in processes:
        action, chunk = queue.get(timeout=60)
        np.testing.assert_array_equal(action, ds[7]["action"])
        np.testing.assert_array_equal(chunk, wanted)
    [process.join(30) for process in processes]
    assert [process.exitcode for process in processes] == [0, 0]


def fly(queue: multiprocessing.Queue) -> None:
    """A simulator of this process's own: the first observation, by seed alone."""
    pytest.importorskip("gymnasium")
    from actrm.envs import RobotEnv

    env = RobotEnv("Lift")
    observation, info = env.reset(seed=5)
    env.step(np.zeros(7, np.float32))
    env.close()
    queue.put((info["fingerprint"], observation["observation.state"]))


def use_anothers(env: object, queue: multiprocessing.Queue) -> None:
    try:
        env.reset(seed=5)  # pyright: ignore
    except actrm.Error as error:
        queue.put(str(error))
    del env


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_simulators_run_in_other_processes(method: str) -> None:
    """After this process has started one of its own: its threads do not exist in a fork."""
    pytest.importorskip("gymnasium")
    from actrm.envs import RobotEnv

    env = RobotEnv("Lift")
    fingerprint = env.reset(seed=5)[1]["fingerprint"]
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    processes = [context.Process(target=fly, args=(queue,)) for _ in range(2)]
    [process.start() for process in processes]
    assert [queue.get(timeout=240)[0] for _ in processes] == [fingerprint] * 2
    [process.join(60) for process in processes]
    assert [process.exitcode for process in processes] == [0, 0]
    # and this one's still answers
    assert env.reset(seed=5)[1]["fingerprint"] == fingerprint
    env.close()


def test_a_simulator_of_the_process_before_a_fork_is_refused_and_lives_on() -> None:
    pytest.importorskip("gymnasium")
    from actrm.envs import RobotEnv

    env = RobotEnv("Lift")
    fingerprint = env.reset(seed=5)[1]["fingerprint"]
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    process = context.Process(target=use_anothers, args=(env, queue))
    process.start()
    assert "forked" in queue.get(timeout=60)
    process.join(60)
    assert process.exitcode == 0
    assert env.reset(seed=5)[1]["fingerprint"] == fingerprint
    env.close()


def test_gymnasium_s_vector_environments_run_in_forks() -> None:
    gymnasium = pytest.importorskip("gymnasium")
    import actrm.envs

    make = actrm.envs.RobotEnv
    alone = make("Lift")
    state = alone.reset(seed=3)[0]["observation.state"]
    both = gymnasium.vector.AsyncVectorEnv([lambda: make("Lift"), lambda: make("Lift")], context="fork")
    seen, _ = both.reset(seed=[3, 4])
    np.testing.assert_array_equal(seen["observation.state"][0], state)
    both.step(np.zeros((2, 7), np.float32))
    both.close()
    alone.close()


def ask_on(batches: Iterator[dict[str, object]], queue: multiprocessing.Queue) -> None:
    try:
        next(batches)
    except actrm.Error as error:
        queue.put(str(error))


def test_threads_of_another_process_are_not_waited_for(lift: Path) -> None:
    context = multiprocessing.get_context("fork")
    batches, queue = actrm.Dataset(lift).batches(64, threads=2), context.Queue()
    next(batches)
    process = context.Process(target=ask_on, args=(batches, queue))
    process.start()
    assert "another process" in queue.get(timeout=60)
    process.join(30)
    assert process.exitcode == 0 and len(next(batches)["action"]) == 64


def test_a_policy_in_use_elsewhere_begins_anew_in_a_fork(zoo: Path) -> None:
    script = """
import os, sys, threading, time
import actrm, numpy as np
policy = actrm.load_policy(sys.argv[1])
seen = {key: np.zeros(shape, np.float32) for key, shape in policy.input_features.items()}
wanted = policy.predict_action_chunk(seen)
def ask():
    while True:
        policy.predict_action_chunk(seen)
threading.Thread(target=ask, daemon=True).start()
for _ in range(10):
    time.sleep(0.03)
    child = os.fork()
    if child == 0:
        policy.reset(1)
        os._exit(0 if (policy.predict_action_chunk(seen) == wanted).all() else 1)
    assert os.waitpid(child, 0)[1] == 0
"""
    command = [sys.executable, "-W", "ignore", "-c", script, str(zoo / "lift-act")]
    subprocess.run(command, check=True, timeout=60)


@pytest.mark.parametrize("what", ["policy.predict_action_chunk(seen)", "list(ds.batches(16, threads=2))", "own()"])
def test_python_ends_while_a_daemon_thread_is_at_work(lift: Path, zoo: Path, tmp_path: Path, what: str) -> None:
    script = """
import sys, threading, time
import actrm, numpy as np
policy, ds = actrm.load_policy(sys.argv[1]), actrm.Dataset(sys.argv[2])
seen = {key: np.zeros(shape, np.float32) for key, shape in policy.input_features.items()}
asked = threading.Event()
def act(observation):
    asked.set()
    return [sum(range(10_000)) * 0.0] * 7
def own():
    actrm.evaluate(act, name="own", task="Lift", episodes=9, workers=2, zoo=sys.argv[3], progress=False)
def work():
    while True:
        WHAT
        asked.set()
threading.Thread(target=work, daemon=True).start()
asked.wait()
time.sleep(0.1)
""".replace("WHAT", what)
    for turn in range(3):
        command = [sys.executable, "-c", script, str(zoo / "lift-act"), str(lift), str(tmp_path / f"{turn}")]
        said = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        assert (said.returncode, said.stderr) == (0, "")


def test_exit_handlers_wait_for_threads_and_evaluate(zoo: Path, tmp_path: Path) -> None:
    """Those too that were there before the package was imported, which Python calls last."""
    script = """
import atexit, sys, threading
stop, begun = threading.Event(), threading.Event()
def close():
    stop.set()
    thread.join()
    slide = {"task": "Slide", "env_module": "toy_simulator", "inputs": {"observation.state": ["place"]}}
    own = {"name": "own", "episodes": 1, "workers": 1, "zoo": sys.argv[2], "progress": False}
    print(actrm.evaluate(lambda _: [-1.0], **slide, **own)["success"])
atexit.register(close)
import actrm, numpy as np
policy = actrm.load_policy(sys.argv[1])
seen = {key: np.zeros(shape, np.float32) for key, shape in policy.input_features.items()}
def work():
    while not stop.is_set():
        policy.select_action(seen)
        begun.set()
thread = threading.Thread(target=work, daemon=True)
thread.start()
begun.wait()
"""
    command = [sys.executable, "-c", script, str(zoo / "lift-act"), str(tmp_path)]
    said = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env=TOY)
    assert (said.returncode, said.stdout, said.stderr) == (0, "[ True]\n", "")


def test_a_simulator_in_use_elsewhere_is_refused_in_a_fork() -> None:
    script = """
import os, signal, sys, threading, time
import actrm, numpy as np
simulator = actrm.Simulator("Slide", keys={"observation.state": ["place"]}, env_module="toy_simulator")
simulator.reset(1)
going = True
def step():
    while going:
        simulator.step(np.zeros(1, np.float32))
thread = threading.Thread(target=step)
thread.start()
codes = []
for turn in range(10):
    time.sleep(0.02)
    child = os.fork()
    if child == 0:
        signal.alarm(5)
        try:
            simulator.reset(2)
        except actrm.Error as error:
            simulator.close()
            del simulator
            os._exit(0 if "forked" in str(error) else 1)
    codes.append(os.waitpid(child, 0)[1])
going = False
thread.join()
simulator.close()
print(codes)
"""
    command = [sys.executable, "-W", "ignore", "-c", script]
    said = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False, env=TOY)
    assert (said.returncode, said.stdout, said.stderr) == (0, f"{[0] * 10}\n", "")


def test_the_programs_are_there() -> None:
    folder = Path(sys.executable).parent
    for name in ("actrm-data", "actrm-zoo"):
        program = folder / name
        if not program.exists():
            pytest.skip("the package is not installed here")
        said = subprocess.run([program, "--version"], capture_output=True, text=True, check=True).stdout
        assert said == f"{name} {actrm.__version__}\n"


def test_importing_brings_no_more_than_itself() -> None:
    script = "import sys, actrm; print(*sys.modules)"
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert not {"numpy", "torch", "gymnasium"} & set(said.split())


def test_everything_public_says_what_it_is() -> None:
    for name in actrm.__all__:
        thing = getattr(actrm, name)
        if name == "__version__":
            continue
        assert thing.__doc__, name
        for part, member in vars(thing).items() if isinstance(thing, type) else ():
            if not part.startswith("_"):
                assert member.__doc__, f"{name}.{part}"
