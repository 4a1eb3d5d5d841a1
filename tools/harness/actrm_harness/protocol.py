"""The messages of worker protocol 2, as dataclasses. They travel as JSON beside the tensors of a frame (`wire`).

docs/reference/worker_protocol.md describes them with their replies. A field with a default may be left out.
"""

from dataclasses import MISSING, asdict, dataclass, field
from typing import Any, cast

from actrm_harness.wire import Message


@dataclass(frozen=True, slots=True)
class Ready:
    """Sent unasked after start: what this worker is and what its environment takes and gives."""

    protocol: int
    simulator: str
    versions: dict[str, str]
    """The simulator's version under its name, and those of what it stands on."""
    task: str
    module_sha256: str | None
    """What the environment module says, where one was named."""
    env_args_sha256: str | None
    """What the environment's arguments are, where they are not the task's usual ones."""
    env_name: str
    control: str
    control_freq: int
    max_steps: int
    action_dim: int
    action_low: list[float | None]
    """Of each value its smallest; None where it has no limit."""
    action_high: list[float | None]
    observations: dict[str, list[int]]
    stages: list[str]
    """What an episode passes before the task is solved, in order, where that is known."""
    env_args: dict[str, Any]
    kernels: str | None = None
    """Which kernels numpy's linear algebra runs, where that can be told: the last bits depend on them."""
    renderer: str | None = None
    """What draws the pictures, where there are cameras: another device or driver draws others."""
    sources: dict[str, str] = field(default_factory=dict[str, str])
    """SHA-256 by package of what was imported to simulate: the simulator, what it stands on, this harness."""


@dataclass(frozen=True, slots=True)
class Reset:
    """Begin the episode of `seed`, as an evaluation sees it or, with `split`, as a demonstration does."""

    id: int
    seed: int
    split: str = "evaluation"


@dataclass(frozen=True, slots=True)
class Step:
    """Control steps; the tensor "action" is one action, or one a row, done until the task is solved or lost."""

    id: int


@dataclass(frozen=True, slots=True)
class Expert:
    """One whole episode of the task's scripted expert."""

    id: int
    seed: int
    split: str = "demonstration"
    expert: str | None = None
    """Another of the task's experts than the usual one, by its name."""
    skill: str | None = None
    """How able whoever shows it is: good, which is also meant where nothing is said, mixed or poor."""


@dataclass(frozen=True, slots=True)
class Extract:
    """Observations, rewards and dones of stored states; tensors "states" and "actions".

    `ep_meta` is the demonstration's own: what an environment has to know of the episode beyond its states.
    """

    id: int
    model_file: str
    ep_meta: dict[str, Any] = field(default_factory=dict[str, Any])


@dataclass(frozen=True, slots=True)
class Render:
    """An image of the current state, `size` is [height, width]."""

    id: int
    camera: str
    size: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Close:
    """End the worker."""

    id: int


Request = Reset | Step | Expert | Extract | Render | Close

SPLITS = ("demonstration", "evaluation")

_REQUESTS: dict[str, type[Request]] = {
    "reset": Reset,
    "step": Step,
    "expert": Expert,
    "extract": Extract,
    "render": Render,
    "close": Close,
}


def _fields_of(cls: type[Request]) -> tuple[frozenset[str], frozenset[str]]:
    """The names of the fields that a request must have, and of those it may have."""
    known = cls.__dataclass_fields__.values()
    required = [entry.name for entry in known if entry.default is MISSING and entry.default_factory is MISSING]
    return frozenset(required), frozenset(entry.name for entry in known)


_FIELDS = {kind: _fields_of(cls) for kind, cls in _REQUESTS.items()}


LONGEST = 200
"""Characters of another library's error that a message takes."""


class RequestError(Exception):
    """A request that cannot be answered; `kind` is a stable word, the text says what was wrong."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


def brief(error: BaseException) -> str:
    """What an error of another library says, in one line: MuJoCo lists every name that it knows."""
    text = str(error).strip().partition("\n")[0]
    return f"{type(error).__name__}: {text if len(text) <= LONGEST else text[:LONGEST] + ' ...'}"


def parse_request(message: Message) -> Request:
    """The request a message stands for; RequestError where a field is missing, unknown or of another type."""
    kind = message.get("type")
    if not isinstance(kind, str) or kind not in _REQUESTS:
        raise RequestError("unknown_request", f"unknown request {kind!r}; known: {', '.join(_REQUESTS)}")
    fields = {name: value for name, value in message.items() if name != "type"}
    cls = _REQUESTS[kind]
    required, expected = _FIELDS[kind]
    if not required <= fields.keys() <= expected:
        raise RequestError("bad_request", f"{kind} takes {sorted(expected)}, got {sorted(fields)}")
    for name in ("id", "seed"):
        if name in fields and not _is_count(fields[name]):
            raise RequestError("bad_request", f"{kind}: {name} must be a non-negative integer, got {fields[name]!r}")
    for name in ("camera", "model_file"):
        if name in fields and not isinstance(fields[name], str):
            raise RequestError("bad_request", f"{kind}: {name} must be text, got {fields[name]!r}")
    if not isinstance(fields.get("skill"), str | None):
        raise RequestError("bad_request", f"{kind}: skill must be text, got {fields['skill']!r}")
    if fields.get("split", SPLITS[0]) not in SPLITS:
        raise RequestError("bad_request", f"{kind}: split must be one of {list(SPLITS)}, got {fields['split']!r}")
    if not isinstance(fields.get("ep_meta", {}), dict):
        raise RequestError("bad_request", f"{kind}: ep_meta must be an object, got {fields['ep_meta']!r}")
    if "size" in fields:
        fields["size"] = _image_size(fields["size"])
    return cls(**fields)


def _image_size(value: object) -> tuple[int, int]:
    items = cast("list[object]", value) if isinstance(value, list) else []
    sizes = [item for item in items if isinstance(item, int) and not isinstance(item, bool) and 1 <= item <= 4096]
    if len(items) != 2 or len(sizes) != 2:
        raise RequestError("bad_request", f"render: size must be [height, width] from 1 to 4096, got {value!r}")
    return sizes[0], sizes[1]


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def ready_message(ready: Ready) -> Message:
    """The handshake as a message."""
    return {"type": "ready", **asdict(ready)}


def error_message(kind: str, text: str, request: int | None = None) -> Message:
    """An error reply, its text folded into one line; without `request` it ends the worker's start."""
    line = " ".join(text.split())
    message: Message = {"type": "error", "kind": kind, "message": line}
    return message if request is None else {**message, "id": request}
