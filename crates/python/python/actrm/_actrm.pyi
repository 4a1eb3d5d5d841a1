from collections.abc import Callable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, SupportsIndex, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._policies import Called

_Path = str | PathLike[str]
_Indices = Sequence[int] | NDArray[np.integer[Any]]
_Offsets = Sequence[int] | Sequence[float] | NDArray[np.integer[Any]] | NDArray[np.floating[Any]]
_External = tuple[Called, str, str, str | None, str | None, dict[str, list[str]] | None, int, dict[str, str]]

__version__: str

class Error(Exception): ...
class ResultsTakenOver(RuntimeWarning): ...

@final
class Dataset:
    def __init__(
        self,
        path: _Path,
        delta_timestamps: Mapping[str, _Offsets] | None = None,
        split: str | None = None,
        *,
        episodes: _Indices | None = None,
        cameras: Sequence[str] | None = None,
        depth: Sequence[str] | None = None,
        depth_output_unit: str = "mm",
        return_uint8: bool = False,
    ) -> None: ...
    def __len__(self) -> int: ...
    def __getitem__(self, index: SupportsIndex, /) -> dict[str, Any]: ...
    def __getitems__(self, indices: _Indices) -> list[dict[str, Any]]: ...
    def batch(self, indices: _Indices) -> dict[str, Any]: ...
    def batches(
        self,
        batch_size: int,
        seed: int | None = None,
        *,
        epoch: int = 0,
        steps: int | None = None,
        start: int = 0,
        drop_last: bool = False,
        threads: int = 0,
    ) -> Batches: ...
    @property
    def stats(self) -> dict[str, dict[str, NDArray[Any]]]: ...
    @property
    def episodes(self) -> list[dict[str, Any]]: ...
    @property
    def features(self) -> dict[str, dict[str, Any]]: ...
    @property
    def root(self) -> Path: ...
    @property
    def fps(self) -> float: ...
    @property
    def tasks(self) -> list[str]: ...
    @property
    def splits(self) -> list[str]: ...
    @property
    def notes(self) -> list[str]: ...
    @property
    def num_frames(self) -> int: ...
    @property
    def num_episodes(self) -> int: ...
    @property
    def fingerprint(self) -> str: ...

@final
class Batches:
    def __iter__(self) -> Iterator[dict[str, Any]]: ...
    def __next__(self) -> dict[str, Any]: ...
    def __len__(self) -> int: ...

@final
class Policy:
    def reset(self, seed: int | _Indices | None = None) -> None: ...
    def select_action(self, observation: Mapping[str, Any]) -> NDArray[np.float32]: ...
    def predict_action_chunk(
        self, observation: Mapping[str, Any], executed: int | None = None
    ) -> NDArray[np.float32]: ...
    def observe(self, observation: Mapping[str, Any]) -> None: ...
    @property
    def id(self) -> str: ...
    @property
    def path(self) -> Path: ...
    @property
    def task(self) -> str: ...
    @property
    def kind(self) -> str: ...
    @property
    def parameters(self) -> int: ...
    @property
    def input_features(self) -> dict[str, tuple[int, ...]]: ...
    @property
    def output_features(self) -> dict[str, tuple[int, ...]]: ...
    @property
    def observation_keys(self) -> dict[str, list[str]]: ...
    @property
    def conventions(self) -> dict[str, str]: ...
    @property
    def action_horizon(self) -> int: ...
    @property
    def n_action_steps(self) -> int: ...
    @property
    def n_obs_steps(self) -> int: ...
    @property
    def card(self) -> str: ...

@final
class Simulator:
    def __init__(
        self,
        task: str | None = None,
        *,
        entry: _Path | None = None,
        zoo: _Path | None = None,
        keys: Mapping[str, Sequence[str]] | None = None,
        control: str = "compiled",
        python: _Path | None = None,
        env_module: str | None = None,
    ) -> None: ...
    def reset(self, seed: int) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]: ...
    def step(self, action: ArrayLike) -> tuple[dict[str, NDArray[Any]], float, bool, str | None]: ...
    def render(self, camera: str = "agentview", height: int = 256, width: int = 256) -> NDArray[np.uint8]: ...
    def close(self) -> None: ...
    @property
    def task(self) -> str: ...
    @property
    def max_steps(self) -> int: ...
    @property
    def control_freq(self) -> float: ...
    @property
    def action_limits(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]: ...
    @property
    def features(self) -> dict[str, tuple[int, ...]]: ...
    @property
    def versions(self) -> dict[str, str]: ...

def set_places(reader: str, control: str) -> None: ...
def panics() -> None: ...
def load_policy(
    path: _Path, zoo: _Path | None = None, *, conventions: dict[str, str] | None = None, device: str = "cpu"
) -> Policy: ...
def leaderboard(zoo: _Path | None = None, *, results: _Path | None = None) -> list[dict[str, Any]]: ...
def convert(
    src: _Path,
    dst: _Path,
    tell: Callable[[int, int], object],
    *,
    state_keys: list[str] | None,
    env_keys: list[str] | None,
    entities: dict[str, list[str]],
    fps: float | None,
    images: str,
    depth: bool,
    actions: str,
    rotation: str,
    nonfinite: str,
    skip_bad: bool,
    lossless: bool,
    jobs: int,
) -> dict[str, Any]: ...
def evaluate(
    entry: _Path | None,
    external: _External | None,
    tell: Callable[[int, int], object],
    *,
    protocol: str | None,
    episodes: int | None,
    workers: int,
    seed: int | None,
    task: str | None,
    max_steps: int | None,
    n_action_steps: int | None,
    temporal_ensemble: float | None,
    control: str | None,
    python: _Path | None,
    env_module: str | None,
    zoo: _Path | None,
    results: _Path | None,
    force: bool,
) -> dict[str, Any]: ...
