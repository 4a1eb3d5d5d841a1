"""robomimic's checkpoints (`.pth`), read without torch and without running what stands in them.

    python -m actrm_harness.robomimic MODEL.pth

writes one frame (`wire`) to standard output: the weights as tensors and, as the message, what robomimic's `save_model`
stores beside them. What is wrong with a file is one line on standard error, and exit code 1.
"""

import math
import sys
import zipfile
from pathlib import Path
from typing import Any, cast

import numpy as np

from actrm_harness import pickles, wire
from actrm_harness.wire import Array, Message, Tensors

FORMAT = 1
PARTS = ("model", "config", "algo_name", "env_metadata", "shape_metadata")
STATISTICS = "obs_normalization_stats"
# plain values and characters: more of them, or deeper, is no checkpoint
MAX_VALUES = 4_000_000
MAX_DEPTH = 32


class CheckpointError(Exception):
    """A file that is no checkpoint of robomimic's; the text says what was expected and found."""


class Archive:
    """torch's archive: a zip file of stored members below one folder."""

    def __init__(self, path: Path) -> None:
        size = path.stat().st_size
        if size > wire.MAX_FRAME_BYTES:
            raise CheckpointError(f"expected at most {wire.MAX_FRAME_BYTES} bytes, found {size}")
        try:
            self._file = zipfile.ZipFile(path)
        except (zipfile.BadZipFile, NotImplementedError, ValueError) as error:
            raise CheckpointError(
                f"expected a zip archive, as torch.save writes since 1.6, found something else or half of one: {error}"
            ) from None
        self._members: dict[str, zipfile.ZipInfo] = {}
        for member in self._file.infolist():
            if member.filename in self._members:
                raise CheckpointError(f"member {member.filename!r} is there twice")
            if member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1:
                raise CheckpointError(f"member {member.filename!r}: expected stored bytes, found compressed ones")
            self._members[member.filename] = member
        if sum(member.file_size for member in self._members.values()) > size:
            raise CheckpointError(f"members: expected at most the archive's {size} bytes in all, found more")
        pickled = [name for name in self._members if name.count("/") == 1 and name.endswith("/data.pkl")]
        if len(pickled) != 1:
            raise CheckpointError(f"expected one FOLDER/data.pkl, found {len(pickled)} of them")
        self._folder = pickled[0].removesuffix("data.pkl")
        order = self.member("byteorder") if f"{self._folder}byteorder" in self._members else b"little"
        if order != b"little":
            raise CheckpointError(f"byteorder: expected little, found {order[:20]!r}")
        self._storages: dict[str, tuple[str, Array]] = {}

    def member(self, name: str) -> bytes:
        """The bytes of a member of the folder."""
        member = self._members.get(self._folder + name)
        if member is None:
            raise CheckpointError(f"member {self._folder + name!r} is missing")
        try:
            return self._file.read(member)
        except (zipfile.BadZipFile, NotImplementedError, RuntimeError, ValueError, EOFError) as error:
            raise CheckpointError(f"member {self._folder + name!r}: {error or 'it ends too early'}") from None

    def numbers(self, tensor: pickles.Tensor) -> Array:
        """A tensor's values, of which each is checked to lie in its storage."""
        storage = tensor.storage
        if not (storage.key.isascii() and storage.key.isdigit()):
            raise CheckpointError(f"storage: expected a number for a name, found {storage.key:.40}")
        if storage.key not in self._storages:
            data, item = self.member(f"data/{storage.key}"), np.dtype(storage.layout).itemsize
            expected = storage.count * item
            if len(data) != expected:
                raise CheckpointError(f"storage {storage.key}: expected {expected} bytes, found {len(data)}")
            self._storages[storage.key] = (storage.layout, np.frombuffer(data, dtype=storage.layout))
        layout, values = self._storages[storage.key]
        shape, strides = tensor.shape, tensor.strides
        last = tensor.offset + sum((n - 1) * step for n, step in zip(shape, strides, strict=False))
        fits = len(shape) == len(strides) and layout == storage.layout
        if not fits or not 0 < math.prod(shape) <= len(values) or last >= len(values):
            raise CheckpointError(
                f"a tensor of shape {shape}, strides {strides} and offset {tensor.offset} "
                f"does not lie in storage {storage.key} of {len(values)} numbers"
            )
        item = values.dtype.itemsize
        view = np.lib.stride_tricks.as_strided(values[tensor.offset :], shape, [step * item for step in strides])
        # frames carry no halves; as single numbers they are the same
        return np.array(view, dtype="<f4" if layout == "<f2" else layout, order="C")


def plain(value: Any, where: str, left: list[int], depth: int = 0) -> Any:
    """Text, numbers, lists and dictionaries, as JSON has them; `left` counts how many there may still be."""
    left[0] -= 1 + (len(value) if isinstance(value, str) else 0)
    if left[0] < 0 or depth > MAX_DEPTH:
        raise CheckpointError(
            f"{where}: expected at most {MAX_VALUES} values and characters, {MAX_DEPTH} deep, found more"
        )
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, int):
        if not -(1 << 63) <= value < 1 << 63:
            raise CheckpointError(f"{where}: expected a whole number of 64 bits, found a larger one")
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise CheckpointError(f"{where}: expected a finite number, found {value}")
        return value
    if isinstance(value, list | tuple):
        items = enumerate(cast(list[Any], value))
        return [plain(item, f"{where}[{index}]", left, depth + 1) for index, item in items]
    if isinstance(value, dict):
        pairs = cast(dict[Any, Any], value).items()
        return {_text(key, where): plain(item, f"{where}.{key}", left, depth + 1) for key, item in pairs}
    raise CheckpointError(f"{where}: expected text, numbers, lists or dictionaries, found {type(value).__name__}")


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str):
        raise CheckpointError(f"{where}: expected text, found {type(value).__name__}")
    return value


def _table(value: Any, where: str) -> dict[Any, Any]:
    if not isinstance(value, dict):
        raise CheckpointError(f"{where}: expected a dictionary, found {type(value).__name__}")
    return cast(dict[Any, Any], value)


def read(path: Path) -> tuple[Message, Tensors]:
    """What `save_model` stored, and the weights by robomimic's names."""
    archive = Archive(path)
    try:
        whole = _table(pickles.read(archive.member("data.pkl")), "checkpoint")
    except pickles.PickleError as error:
        raise CheckpointError(f"data.pkl {error}") from None
    missing = [part for part in PARTS if part not in whole]
    # what is there and says nothing may stay
    unknown = [key for key, value in whole.items() if key not in (*PARTS, STATISTICS) and value is not None]
    if missing or unknown:
        raise CheckpointError(
            f"checkpoint: expected {', '.join(PARTS)} and at most {STATISTICS}; "
            f"missing: {', '.join(missing) or 'none'}; unknown: {', '.join(map(str, unknown)) or 'none'}"
        )
    weights: Tensors = {}
    for name, tensor in _table(whole["model"], "model").items():
        if not isinstance(tensor, pickles.Tensor):
            raise CheckpointError(f"model.{name}: expected a tensor, found {type(tensor).__name__}")
        weights[_text(name, "model")] = archive.numbers(tensor)
        if sum(array.nbytes for array in weights.values()) > wire.MAX_FRAME_BYTES:
            raise CheckpointError(f"model: expected at most {wire.MAX_FRAME_BYTES} bytes of weights, found more")
    left = [MAX_VALUES]
    message: Message = {"format": FORMAT}
    for part in (*PARTS[1:], STATISTICS):
        message[part] = plain(whole.get(part), part, left)
    # in the order in which the network takes them, which a dictionary of JSON has not
    shapes = _table(_table(message["shape_metadata"], "shape_metadata").get("all_shapes"), "shape_metadata.all_shapes")
    message["all_shapes"] = [[key, shape] for key, shape in shapes.items()]
    return message, weights


def main() -> int:
    """Read the file that is named, and write its frame."""
    if len(sys.argv) != 2:
        print("expected one argument, the file", file=sys.stderr)
        return 1
    path = Path(sys.argv[1])
    try:
        wire.write_frame(sys.stdout.buffer, *read(path))
    except (CheckpointError, wire.WireError) as error:
        print(error, file=sys.stderr)
        return 1
    except OSError as error:
        print(f"reading it: {error.strerror or error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
