"""Write the oracle of the samplers: flow matching's Euler steps and MIP's two steps on fields with a formula, in NumPy.

    python make_sampler_fixture.py OUT_FILE

needs NumPy only; in double precision, from noise of a generator with a seed. Its output is
`crates/models/tests/fixtures/samplers.json`.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def velocity(x: Array, t: float) -> Array:
    """A field that depends on place and time."""
    return np.sin(3.0 * x) - 2.0 * t * x + t


def answer(x: Array, t: float) -> Array:
    """What a network might answer."""
    return np.cos(x + 2.0 * t) - 0.3 * x


def euler(z: Array, steps: int) -> Array:
    """Follow the field from time 0 to 1 in steps of one length."""
    x = z.copy()
    for t in np.linspace(0.0, 1.0, steps, endpoint=False):
        x = x + velocity(x, float(t)) / steps
    return x


def two_steps(time: float) -> float:
    """A first answer from nothing, a second one that looks at a share of it."""
    first = answer(np.zeros(1), 0.0)
    return float(answer(time * first, time)[0])


def main() -> None:
    noise = np.random.default_rng(3).standard_normal(8).astype(np.float32).astype(np.float64)
    fixture: dict[str, Any] = {
        "noise": noise.tolist(),
        "flow": {str(steps): euler(noise, steps).tolist() for steps in (1, 2, 5, 10)},
        "mip": {str(time): two_steps(time) for time in (0.5, 0.9)},
    }
    Path(sys.argv[1]).write_text(json.dumps(fixture, indent=1) + "\n")


if __name__ == "__main__":
    main()
