"""A policy of the user's, as evaluations ask it."""

from __future__ import annotations

import copy
import hashlib
import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Observation = dict[str, NDArray[Any]]


def kind_of(policy: Any) -> Any:
    """A policy's class, or the function that it is."""
    return policy if hasattr(policy, "__qualname__") else type(policy)  # pyright: ignore[reportUnknownVariableType]


def source(policy: Any) -> str:
    """Where a policy comes from: `python package.module.Class`."""
    kind = kind_of(policy)
    return f"python {kind.__module__}.{kind.__qualname__}"


def code(policy: Any) -> str | None:
    """SHA-256 of the text of its class, where there is one."""
    kind = kind_of(policy)
    try:
        text = inspect.getsource(kind)
    except (OSError, TypeError):
        # a notebook's classes are in no file; their methods are known
        try:
            parts: list[Any] = list(getattr(kind, "__dict__", {}).values())
            text = "".join(inspect.getsource(part) for part in parts if inspect.isfunction(part))
        except (OSError, TypeError):
            return None
    return hashlib.sha256(text.encode()).hexdigest() if text else None


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
