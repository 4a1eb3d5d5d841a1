"""The worker with a clock inside: how much of its CPU time went into env.step. `evaluation.py` puts it in the worker's
place, in a copy of the harness where the worker's own module is called `untimed`.

Into the file that ACTRM_BENCH_TIMES names it writes a line when its standard input ends: the CPU seconds of the whole
process, of answering requests for steps (reading and writing frames included), of env.step in them, and their number.
With ACTRM_BENCH_LOOK=1 every step makes its observations, as env.step does, even where nobody will see them.
"""

import json
import os
import time
from dataclasses import dataclass
from typing import Any

from actrm_harness import untimed, wire


@dataclass(slots=True)
class Spent:
    """CPU seconds."""

    stepping: float = 0.0
    inner: float = 0.0
    steps: int = 0


SPENT = Spent()
ALWAYS = os.environ.get("ACTRM_BENCH_LOOK") == "1"


class TimedControl:
    """The compiled loop, its steps timed."""

    def __init__(self, control: Any) -> None:
        self._control = control

    def step(self, action: wire.Array, look: bool = True) -> Any:
        """A control step."""
        begun = time.thread_time()
        result = self._control.step(action, look or ALWAYS)
        SPENT.inner += time.thread_time() - begun
        SPENT.steps += 1
        return result

    def __getattr__(self, name: str) -> Any:
        return getattr(self._control, name)


def start(args: Any) -> Any:
    """The simulation, with a clock around its control loop."""
    simulation = _start(args)
    session = simulation.session
    if session.control is None:
        raise SystemExit("benches/timed_worker.py: the compiled loop could not be attached")
    session.control = TimedControl(session.control)
    return simulation


def run(requests: Any, replies: Any) -> int:
    """What the worker does, and then the line with its times."""
    code = _run(requests, replies)
    times = {
        "process": time.process_time(),
        "stepping": SPENT.stepping,
        "inner": SPENT.inner,
        "steps": SPENT.steps,
    }
    with open(os.environ["ACTRM_BENCH_TIMES"], "a") as file:
        file.write(json.dumps(times) + "\n")
    return code


def read_frame(stream: Any) -> Any:
    """The next request; from here on time counts, until the next one is waited for."""
    global _begun, _steps
    if SPENT.steps > _steps:
        SPENT.stepping += time.thread_time() - _begun
    _begun, _steps = time.thread_time(), SPENT.steps
    return _read_frame(stream)


_begun = 0.0
_steps = 0
_start, _run, _read_frame = untimed.start, untimed.run, wire.read_frame
untimed.start, untimed.run, wire.read_frame = start, run, read_frame

if __name__ == "__main__":
    untimed.main()
