"""What the peers on PyTorch have in common: orders come in and answers go out, a line of JSON each.

An order is {"work": "train", "times": 3, "threads": 1}, and with the other keys what to make that can do it.
Its answer is {"wall": seconds, "cpu": seconds} for one of the `times` repetitions (their mean).
{"work": "memory"} is answered by {"peak": bytes, "import": bytes}: the most that this process has had so far, and had
before the first order.
"""

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

Work = dict[str, Callable[[], None]]


def peak_memory() -> int:
    """In bytes, of this process alone (`ru_maxrss` would begin with the parent's)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))


def answer(make: Callable[..., Work]) -> None:
    """Answer all orders; `make` is called once for each of the other keys' values."""
    # libraries print what they build: the channel is for answers alone
    channel = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def tell(values: dict[str, Any]) -> None:
        print(json.dumps(values), file=channel, flush=True)

    imported = peak_memory()
    made: dict[str, Work] = {}
    tell({"torch": torch.__version__})
    for line in sys.stdin:
        order = json.loads(line)
        work = order.pop("work")
        if work == "memory":
            tell({"peak": peak_memory(), "import": imported})
            continue
        torch.set_num_threads(order.pop("threads", 1))
        times = order.pop("times")
        key = json.dumps(order, sort_keys=True)
        if key not in made:
            torch.manual_seed(0)
            made[key] = make(**order)
        run = made[key][work]
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(times):
            run()
        tell({"wall": (time.perf_counter() - wall) / times, "cpu": (time.process_time() - cpu) / times})
