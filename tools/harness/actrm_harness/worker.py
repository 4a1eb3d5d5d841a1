"""The worker program: `python -m actrm_harness.worker --task Lift`.

It sends a handshake, then answers requests in order until its standard input ends. Standard output is kept for replies
before anything else is imported, and file descriptor 1 is pointed at standard error, so that nothing a library prints
can get into the stream.
"""

import argparse
import importlib
import json
import math
import os
import platform
import sys
import traceback
from collections.abc import Callable
from typing import Any, BinaryIO, NoReturn, cast

import numpy as np

from actrm_harness import PACKAGE, PROTOCOL, protocol, simulators, source, tasks, wire
from actrm_harness.protocol import RequestError, error_message
from actrm_harness.simulators import Episode, Simulation, Stored, finite, packages, verdict

# What has to be set before the interpreter starts. Sets of names must not be ordered by chance (robosuite draws from
# one), and one thread a library keeps their buffers small: a worker computes on one core.
SETTINGS = {
    "PYTHONHASHSEED": "0",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "2",
}


def main() -> NoReturn:
    """Take the pipes, start the environment, answer requests."""
    settle()
    requests = os.fdopen(os.dup(0), "rb")
    replies = os.fdopen(os.dup(1), "wb")
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(2, 1)
    # Leave without unwinding: graphics libraries and a half-closed simulator have nothing to save.
    code = run(requests, replies)
    sys.stderr.flush()
    os._exit(code)


def settle() -> None:
    """Start the interpreter again where `SETTINGS` were not there when it started."""
    if any(os.environ.get(name) != value for name, value in SETTINGS.items()):
        os.environ.update(SETTINGS)
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def run(requests: BinaryIO, replies: BinaryIO) -> int:
    """Start and serve; the exit code."""
    args = arguments()

    def move(simulator: str) -> None:
        """Start again in the interpreter that the simulator needs, with the same pipes, if that is another."""
        if python := simulators.interpreter(simulator):
            os.dup2(requests.fileno(), 0)
            os.dup2(replies.fileno(), 1)
            os.environ[simulators.MOVED] = simulator
            os.execv(python, [python, *sys.orig_argv[1:]])

    try:
        simulation = start(args, move)
        wire.write_frame(replies, protocol.ready_message(describe(args, simulation)))
    except RequestError as error:
        wire.write_frame(replies, error_message(error.kind, str(error)))
        return 1
    except ModuleNotFoundError as error:
        text = f"{error} (Python {platform.python_version()}, {sys.executable})"
        wire.write_frame(replies, error_message("missing_module", text))
        return 1
    except Exception as error:
        traceback.print_exc()
        wire.write_frame(replies, error_message("start_failed", f"{type(error).__name__}: {error} {place(error)}"))
        return 1
    try:
        return serve(simulation, requests, replies)
    except BrokenPipeError:
        return 1


def place(error: BaseException) -> str:
    """Where an error came from: a failed assertion of another library's says nothing else."""
    frames = traceback.extract_tb(error.__traceback__)
    return f"({os.path.basename(frames[-1].filename)}:{frames[-1].lineno}, {frames[-1].name})" if frames else ""


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="actrm_harness.worker", description=__doc__)
    parser.add_argument("--task", required=True, help="a task of the table, or an environment of the simulator")
    parser.add_argument(
        "--control", default="compiled", choices=["robosuite", "compiled"], help="the inner loop (default: %(default)s)"
    )
    parser.add_argument("--env-module", help="Python module to import first: it registers further environments")
    parser.add_argument("--env-args", help="robomimic's env_args as JSON: robots and controllers other than the usual")
    parser.add_argument("--cameras", default="", help="cameras to observe, separated by commas")
    parser.add_argument("--size", type=int, default=84, help="height and width of camera images")
    parser.add_argument("--fast-render", action="store_true", help="draw without reflections and multisampling")
    return parser.parse_args()


def start(args: argparse.Namespace, move: Callable[[str], None]) -> Simulation:
    """Import the simulator and make the environment."""
    if not args.env_module:
        move(tasks.row(args.task).simulator)
    simulators.prepare(tasks.row(args.task).simulator)
    if args.env_module:
        try:
            importlib.import_module(args.env_module)
        except ImportError as error:
            raise RequestError(
                "env_module", f"cannot import environment module {args.env_module!r}: {error}"
            ) from error
        # the module may have named another
        move(tasks.row(args.task).simulator)
    cameras = tuple(name for name in args.cameras.split(",") if name)
    return simulators.start(
        simulators.Options(
            tasks.row(args.task), args.control, cameras, args.size, args.fast_render, env_args(args.env_args)
        )
    )


def env_args(text: str | None) -> dict[str, Any] | None:
    """Robomimic's `env_args` from the command line."""
    if text is None:
        return None
    try:
        found: object = json.loads(text)
    except ValueError as error:
        raise RequestError("env_args", f"env_args are not JSON: {error}") from error
    if not isinstance(found, dict):
        raise RequestError("env_args", f"env_args must be an object, got {text[:60]!r}")
    return cast("dict[str, Any]", found)


def describe(args: argparse.Namespace, simulation: Simulation) -> protocol.Ready:
    """The handshake: versions, shapes and the environment's arguments."""
    task = tasks.row(args.task)
    found = simulation.describe()
    arguments, sha256 = found.env_args, None
    if args.env_module:
        sha256 = source.digest(args.env_module)
        if sha256 is None:
            text = f"environment module {args.env_module!r} has no source file to take a sum of"
            raise RequestError("env_module", text)
        # robomimic's readers take what they know of it
        arguments = {**arguments, "env_module": {"name": args.env_module, "sha256": sha256}}
    return protocol.Ready(
        protocol=PROTOCOL,
        simulator=task.simulator,
        versions=found.versions,
        task=task.name,
        module_sha256=sha256,
        env_args_sha256=found.unusual,
        env_name=found.env_name,
        control=found.control,
        control_freq=found.control_freq,
        max_steps=task.max_steps,
        action_dim=int(found.action_low.shape[0]),
        action_low=limits(found.action_low, -math.inf),
        action_high=limits(found.action_high, math.inf),
        observations=found.observations,
        stages=found.stages,
        kernels=found.kernels,
        renderer=found.renderer,
        env_args=arguments,
        sources=source.sums({PACKAGE, task.simulator.split(".")[0], *found.packages, *packages(simulation)}),
    )


def limits(values: wire.Array, none: float) -> list[float | None]:
    """An action's limits; None where there is none, which is `none`."""
    if np.isnan(values).any():
        raise RequestError("environment", f"the environment's limits of an action are {values.tolist()}")
    return [None if limit == none else limit for limit in values.tolist()]


def serve(simulation: Simulation, requests: BinaryIO, replies: BinaryIO) -> int:
    """Answer requests until the stream ends or asks to close; the exit code."""
    while True:
        try:
            frame = wire.read_frame(requests)
        except wire.WireError as error:
            wire.write_frame(replies, error_message("bad_frame", str(error)))
            return 1
        if frame is None:
            return 0
        message, tensors = frame
        identity = message.get("id")
        number = identity if isinstance(identity, int) else None
        try:
            request = protocol.parse_request(message)
            if isinstance(request, protocol.Close):
                wire.write_frame(replies, {"type": "closed", "id": request.id})
                return 0
            reply, data = answer(simulation, request, tensors)
        except RequestError as error:
            reply, data = error_message(error.kind, str(error), number), {}
        except Exception as error:
            traceback.print_exc()
            reply, data = error_message("failed", protocol.brief(error), number), {}
        try:
            wire.write_frame(replies, reply, data)
        except ValueError as error:
            # JSON has no NaN and no infinity; nothing was written yet
            text = f"{message.get('type')}: what the environment gave cannot be sent: {error}: {reply}"
            wire.write_frame(replies, error_message("environment", text, number))
        except wire.WireError as error:
            # too long, or of a type that frames do not carry; nothing was written either
            wire.write_frame(replies, error_message("bad_request", f"{message.get('type')}: {error}", number))


Answer = tuple[wire.Message, wire.Tensors]


def answer(simulation: Simulation, request: protocol.Request, tensors: wire.Tensors) -> Answer:
    """The reply to one request."""
    # first what is asked most, between two steps of physics
    if isinstance(request, protocol.Step):
        stepped = simulation.step(tensor(tensors, "action"))
        rewards = finite("reward", stepped.rewards)
        reply: wire.Message = {
            "type": "step",
            "id": request.id,
            "reward": float(rewards[-1]),
            "success": verdict(stepped.success),
            "failure": stepped.failure,
            "progress": stepped.progress,
        }
        return drawn(reply, stepped.drawing_ms), {"rewards": rewards, **observed(stepped.observation)}
    if isinstance(request, protocol.Reset):
        first = simulation.reset(request.seed, request.split == "demonstration")
        reply = {
            "type": "reset",
            "id": request.id,
            "fingerprint": first.fingerprint,
            "split": request.split,
            "group": first.ep_meta.get("group"),
            "ep_meta": first.ep_meta,
        }
        return drawn(reply, first.drawing_ms), observed(first.observation)
    if isinstance(request, protocol.Expert):
        # a simulator of somebody else's may know of no skills
        skill = {} if request.skill is None else {"skill": request.skill}
        episode = simulation.expert(request.seed, request.split == "demonstration", request.expert, **skill)
        return episode_reply("expert", request.id, episode), episode.tensors
    if isinstance(request, protocol.Extract):
        stored = Stored(tensor(tensors, "states"), tensor(tensors, "actions"), request.model_file, request.ep_meta)
        episode = simulation.extract(stored)
        return episode_reply("extract", request.id, episode), episode.tensors
    if isinstance(request, protocol.Render):
        image = simulation.image(request.camera, *request.size)
        return {"type": "render", "id": request.id}, {"image": image}
    raise RequestError("unknown_request", f"request {request!r} cannot be answered")


def drawn(reply: wire.Message, milliseconds: float) -> wire.Message:
    """The reply, and how long its pictures took where it has any."""
    return {**reply, "drawing_ms": milliseconds} if milliseconds > 0 else reply


def observed(observation: wire.Tensors) -> wire.Tensors:
    """Observations, under the names that they travel by."""
    return {f"obs/{name}": value for name, value in observation.items()}


def episode_reply(kind: str, number: int, episode: Episode) -> wire.Message:
    """The message that goes with a recorded episode's tensors."""
    if "rewards" in episode.tensors:
        finite("reward", episode.tensors["rewards"])
    return {
        "type": kind,
        "id": number,
        "success": verdict(episode.success),
        "steps": episode.steps,
        "attrs": episode.attrs,
        "failure": episode.failure,
        "progress": episode.progress,
    }


def tensor(tensors: wire.Tensors, name: str) -> wire.Array:
    """A tensor that the request must carry."""
    if name not in tensors:
        raise RequestError("bad_request", f"tensor {name!r} is missing; the request carries {sorted(tensors)}")
    return tensors[name]


if __name__ == "__main__":
    main()
