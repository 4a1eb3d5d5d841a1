"""Frames: a little-endian u64 byte length, then that many bytes in safetensors layout.

The safetensors header carries one metadata key, "actrm", holding a JSON message; the tensors ride behind it. The
header is parsed here because the safetensors package does not give metadata back from bytes.
"""

import json
import math
import struct
import sys
from functools import lru_cache
from typing import Any, BinaryIO, cast

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Tensors = dict[str, Array]
Message = dict[str, Any]

METADATA_KEY = "actrm"
MAX_FRAME_BYTES = 2 * 1024 * 1024 * 1024

_DTYPES = {"F64": "<f8", "F32": "<f4", "I64": "<i8", "U8": "|u1"}
_LAYOUTS = {name: np.dtype(layout) for name, layout in _DTYPES.items()}
_NAMES = {layout: name for name, layout in _LAYOUTS.items()}


class WireError(Exception):
    """A frame that is not what the protocol says; the text says where and how."""


# A worker encodes and decodes between two steps of physics, with cold caches: what counts is how much code runs.
_ENCODER = json.JSONEncoder(allow_nan=False, separators=(",", ":"))
_decode = json.JSONDecoder().raw_decode
_LITTLE = sys.byteorder == "little"
_LENGTH = struct.Struct("<Q")


def encode(message: Message, tensors: Tensors | None = None) -> bytes:
    """One frame's payload: the message and its tensors in safetensors layout."""
    arrays = tensors or {}
    names = _order(tuple(arrays))
    sorted_arrays = [np.asarray(arrays[name]) for name in names]
    entries, native = _entries(names, tuple([(array.dtype, array.shape) for array in sorted_arrays]))
    metadata = json.encoder.encode_basestring_ascii(_ENCODER.encode(message))
    text = f'{{"__metadata__":{{"{METADATA_KEY}":{metadata}}}{entries}}}'.encode()
    text += b" " * (-len(text) % 8)
    if not native:
        sorted_arrays = [array.astype(array.dtype.newbyteorder("<")) for array in sorted_arrays]
    return b"".join([_LENGTH.pack(len(text)), text, *[array.tobytes() for array in sorted_arrays]])


@lru_cache(maxsize=64)
def _order(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(sorted(names))


@lru_cache(maxsize=64)
def _entries(names: tuple[str, ...], arrays: tuple[tuple["np.dtype[Any]", tuple[int, ...]], ...]) -> tuple[str, bool]:
    """The header's text for these tensors, the same for every step of an episode, and whether they lie as they go."""
    entries = ""
    end = 0
    for name, (dtype, shape) in zip(names, arrays, strict=True):
        kind = _NAMES.get(dtype.newbyteorder("<"))
        if kind is None:
            raise WireError(f"tensor {name!r} has dtype {dtype}; a frame carries {', '.join(_DTYPES)}")
        begin, end = end, end + math.prod(shape) * dtype.itemsize
        entry = {"dtype": kind, "shape": list(shape), "data_offsets": [begin, end]}
        entries += f",{json.dumps(name)}:{json.dumps(entry, separators=(',', ':'))}"
    return entries, _LITTLE and all(dtype.isnative for dtype, _ in arrays)


def decode(payload: bytes) -> tuple[Message, Tensors]:
    """The message and the tensors of one frame's payload."""
    if len(payload) < 8:
        raise WireError(f"a payload of {len(payload)} bytes has no safetensors header")
    (size,) = _LENGTH.unpack_from(payload)
    if size > len(payload) - 8:
        raise WireError(f"safetensors header of {size} bytes in a payload of {len(payload)} bytes")
    try:
        text = payload[8 : 8 + size].decode()
    except UnicodeDecodeError as error:
        raise WireError(f"safetensors header is not JSON: {error}") from error
    header = _json_object(text, "safetensors header")
    metadata = header.pop("__metadata__", None)
    if not isinstance(metadata, dict) or not isinstance(cast(Message, metadata).get(METADATA_KEY), str):
        raise WireError(f"safetensors metadata has no text under {METADATA_KEY!r}")
    message = _json_object(cast(Message, metadata)[METADATA_KEY], "message")
    body = memoryview(payload)[8 + size :]
    return message, {name: _tensor(name, entry, body) for name, entry in header.items()}


def _json_object(text: str, what: str) -> Message:
    value: object = None
    try:
        if text.startswith("{"):
            value, end = _decode(text)
            if end < len(text) and text[end:].strip():
                raise WireError(f"{what} is followed by {text[end:].strip()[:20]!r}")
    except json.JSONDecodeError as error:
        raise WireError(f"{what} is not JSON: {error}") from error
    if not isinstance(value, dict):
        raise WireError(f"{what} is not a JSON object")
    return cast(Message, value)


def _tensor(name: str, entry: object, body: memoryview) -> Array:
    try:
        fields = cast(Message, entry)
        dtype = _LAYOUTS[fields["dtype"]]
        shape = tuple([int(size) for size in fields["shape"]])
        begin, end = [int(offset) for offset in fields["data_offsets"]]
    except (KeyError, TypeError, ValueError) as error:
        raise WireError(f"tensor {name!r} has a bad header entry: {entry!r}") from error
    count = math.prod(shape) if min(shape, default=0) >= 0 else -1
    if count < 0 or not 0 <= begin <= end <= len(body) or end - begin != count * dtype.itemsize:
        raise WireError(f"tensor {name!r}: shape {shape} of {dtype} does not fit bytes {begin}..{end} of {len(body)}")
    return np.frombuffer(body, dtype=dtype, count=count, offset=begin).reshape(shape)


def write_frame(stream: BinaryIO, message: Message, tensors: Tensors | None = None) -> None:
    """Write one frame and flush it."""
    payload = encode(message, tensors)
    if len(payload) > MAX_FRAME_BYTES:
        raise WireError(f"a frame of {len(payload)} bytes; at most {MAX_FRAME_BYTES} are allowed")
    stream.write(_LENGTH.pack(len(payload)) + payload)
    stream.flush()


def read_frame(stream: BinaryIO) -> tuple[Message, Tensors] | None:
    """Read one frame; None when the stream ended before a frame began."""
    head = _read_exactly(stream, 8)
    if not head:
        return None
    if len(head) < 8:
        raise WireError(f"the stream ended {len(head)} bytes into a frame length")
    (size,) = _LENGTH.unpack(head)
    if size > MAX_FRAME_BYTES:
        raise WireError(f"a frame of {size} bytes is announced; at most {MAX_FRAME_BYTES} are allowed")
    payload = _read_exactly(stream, size)
    if len(payload) < size:
        raise WireError(f"the stream ended {len(payload)} bytes into a frame of {size}")
    return decode(payload)


def _read_exactly(stream: BinaryIO, size: int) -> bytes:
    first = stream.read(size)
    if len(first) == size:
        return first
    parts = [first]
    left = size - len(first)
    while first and left > 0:
        part = stream.read(left)
        if not part:
            break
        parts.append(part)
        left -= len(part)
    return b"".join(parts)
