"""A policy of the user's, as evaluations ask it."""

from __future__ import annotations

import copy
import functools
import hashlib
import inspect
import types
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Observation = dict[str, NDArray[Any]]


# what is shown by itself, and never by an address
CONSTANTS = (bool, int, float, complex, str, bytes, type(None), types.EllipsisType)
# what counts of other things: of code neither its file nor its lines
PARTS: dict[type, tuple[str, ...]] = {
    types.CodeType: (
        *("co_code", "co_exceptiontable", "co_argcount", "co_posonlyargcount", "co_kwonlyargcount"),
        *("co_names", "co_varnames", "co_freevars", "co_cellvars", "co_consts"),
    ),
    types.FunctionType: ("__code__", "__defaults__", "__kwdefaults__", "__closure__"),
    property: ("fget", "fset", "fdel"),
    staticmethod: ("__func__",),
    classmethod: ("__func__",),
    slice: ("start", "stop", "step"),
    functools.cached_property: ("func",),
    functools.partial: ("func", "args", "keywords"),
    functools.partialmethod: ("func", "args", "keywords"),
}


def kind_of(policy: Any) -> Any:
    """A policy's class, or the function that it is; what a `functools.partial` calls."""
    while isinstance(policy, functools.partial):
        policy = policy.func  # pyright: ignore[reportUnknownMemberType]
    return policy if hasattr(policy, "__qualname__") else type(policy)  # pyright: ignore[reportUnknownVariableType]


def source(policy: Any) -> str:
    """Where a policy comes from: `python package.module.Class`."""
    kind = kind_of(policy)
    return f"python {kind.__module__}.{kind.__qualname__}"


def code(policy: Any) -> str | None:
    """SHA-256 of the code that runs when it is asked: of its class and what that inherits, or of a function.

    No file is read: it may have been edited since. Another version of Python compiles to other code.
    """
    seen: dict[int, Any] = {}
    told = running(policy if isinstance(policy, functools.partial) else kind_of(policy), seen)
    if not any(isinstance(one, types.FunctionType) for one in seen.values()):
        return None
    return hashlib.sha256(repr(told).encode()).hexdigest()


def running(thing: Any, seen: dict[int, Any]) -> Any:
    """Code and constants of a thing, as what has the same `repr` in every process.

    `seen`: the functions and classes so far.
    """
    if type(thing) in CONSTANTS:
        return thing
    if id(thing) in seen:
        return ("again", list(seen).index(id(thing)))
    if isinstance(thing, (types.FunctionType, type)):
        seen[id(thing)] = thing
    name, parts = type(thing).__name__, list[Any]()
    if isinstance(thing, frozenset):
        return ("frozenset", sorted(repr(running(one, seen)) for one in cast("frozenset[Any]", thing)))
    if isinstance(thing, tuple):
        parts = list(cast("tuple[Any, ...]", thing))
    elif isinstance(thing, types.CellType):
        parts = [contents(thing)]
    elif isinstance(thing, types.MethodType):
        parts = [thing.__func__, kind_of(thing.__self__)]
    elif isinstance(thing, type):
        parts = [by_name(members(kind)) for kind in thing.__mro__]
    elif kind := next((kind for kind in PARTS if isinstance(thing, kind)), None):
        found = [getattr(thing, part) for part in PARTS[kind]]
        parts = [by_name(cast("dict[str, Any]", part)) if isinstance(part, dict) else part for part in found]
    else:
        # what a wrapper of `functools` calls
        parts = [inspect.getattr_static(thing, "__wrapped__", None)]
    return (name, [running(part, seen) for part in parts])


def by_name(named: Mapping[str, Any]) -> tuple[Any, ...]:
    """Names and what they name, sorted by name."""
    return tuple(sorted(named.items()))


def contents(cell: types.CellType) -> Any:
    """What a function has of the variables around it, but classes: its own is one of them."""
    try:
        found = cell.cell_contents
    except ValueError:
        return None
    return None if isinstance(found, type) else found


def members(kind: type) -> dict[str, Any]:
    """Methods, constants and inner classes of a class of Python's."""
    if kind.__module__ == "builtins":
        return {}

    def counts(name: str, value: Any) -> bool:
        if isinstance(value, type):
            return value.__qualname__.startswith(f"{kind.__qualname__}.")
        # Python's own attributes have the number of a line among them
        return not name.startswith("__") or hasattr(value, "__get__")

    return {name: value for name, value in vars(kind).items() if counts(name, value)}


class Called:
    """A policy with a state of its own: `reset(seed)`, and `predict(observation)`, which gives actions (T, D)."""

    def __init__(self, policy: Any, ask: str | None, *, shared: bool) -> None:
        self.policy = policy
        self.ask = ask
        self.shared = shared
        self.predicted: Callable[[Observation], Any] = getattr(policy, ask) if ask else policy
        self.takes_seed = False
        if reset := getattr(policy, "reset", None):
            try:
                inspect.signature(reset).bind(0)
                self.takes_seed = True
            except TypeError:
                pass

    @classmethod
    def of(cls, policy: Any, *, workers: int, chunks: bool) -> Called:
        """The way in which `policy` is asked: for chunks of actions where they are wanted, for one action otherwise."""
        wanted = ("predict_action_chunk", "select_action")
        asks = [ask for ask in (wanted if chunks else wanted[::-1]) if callable(getattr(policy, ask, None))]
        if not asks and not callable(policy):
            raise TypeError(
                "policy: expected a function, or an object with select_action or predict_action_chunk, "
                f"found {type(policy).__name__}"
            )
        if chunks and asks[:1] == ["select_action"]:
            raise ValueError(
                "n_action_steps: expected a policy with predict_action_chunk, found one with select_action"
            )
        if not chunks and asks[:1] == ["predict_action_chunk"]:
            raise ValueError(
                "n_action_steps: expected how many actions of a chunk are executed before the next query, found none"
            )
        called = cls(policy, asks[0] if asks else None, shared=workers == 1 or not hasattr(policy, "reset"))
        called.copy()
        return called

    def copy(self) -> Called:
        """The same for another simulator."""
        if self.shared:
            return self
        try:
            return Called(copy.deepcopy(self.policy), self.ask, shared=False)
        except Exception as error:
            text = "workers: expected 1 with a policy that has reset and cannot be copied (copy.deepcopy)"
            raise ValueError(text) from error

    def reset(self, seed: int) -> None:
        """Begins the episode of `seed`."""
        if hasattr(self.policy, "reset"):
            self.policy.reset(*([seed] if self.takes_seed else []))

    def predict(self, observation: Observation) -> NDArray[np.float32]:
        """Actions for the next steps, float32 (T, D)."""
        import numpy as np

        found = self.predicted(observation)
        if hasattr(found, "detach"):
            # numpy has no bfloat16
            found = found.detach().cpu().float()
        actions = np.asarray(found, np.float32)
        # a batch of one
        if actions.ndim == 3 and actions.shape[0] == 1:
            actions = actions[0]
        if actions.ndim not in (1, 2) or actions.size == 0:
            raise ValueError(f"expected actions of shape (D,) or (T, D), found {actions.shape}")
        return np.atleast_2d(actions)
