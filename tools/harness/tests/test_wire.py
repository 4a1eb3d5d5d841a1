"""Frames: what is written comes back, safetensors agrees, and broken ones are named."""

import importlib
import io
import json
import struct
from typing import Any

import numpy as np
import pytest

from actrm_harness import wire

# The package that others read and write frames with; its type hints are incomplete.
safetensors_numpy: Any = importlib.import_module("safetensors.numpy")


def test_what_is_written_comes_back() -> None:
    tensors = {
        "a/b": np.arange(6, dtype=np.float64).reshape(2, 3),
        "flags": np.array([1, 0, 1], dtype=np.uint8),
        "empty": np.zeros((0, 4), dtype=np.float32),
        "scalar": np.array(7, dtype=np.int64),
    }
    stream = io.BytesIO()
    wire.write_frame(stream, {"type": "step", "text": "grün"}, tensors)
    wire.write_frame(stream, {"type": "close"})
    stream.seek(0)
    first = wire.read_frame(stream)
    assert first is not None
    message, back = first
    assert message == {"type": "step", "text": "grün"}
    assert sorted(back) == sorted(tensors)
    for name, value in tensors.items():
        assert back[name].dtype == value.dtype and back[name].shape == value.shape
        assert back[name].tobytes() == value.tobytes()
    second = wire.read_frame(stream)
    assert second is not None and second[0] == {"type": "close"}
    assert wire.read_frame(stream) is None


def test_the_safetensors_package_reads_the_payload() -> None:
    value = np.linspace(0, 1, 12).reshape(3, 4)
    back = safetensors_numpy.load(wire.encode({"x": 1}, {"value": value, "image": np.eye(3, dtype=np.uint8)}))
    assert np.array_equal(back["value"], value)
    assert np.array_equal(back["image"], np.eye(3))


def test_a_payload_of_the_safetensors_package_is_read() -> None:
    payload = safetensors_numpy.save({"v": np.ones((2, 2))}, metadata={"actrm": json.dumps({"type": "reset"})})
    message, back = wire.decode(payload)
    assert message == {"type": "reset"}
    assert np.array_equal(back["v"], np.ones((2, 2)))


def test_a_frame_cut_anywhere_is_an_error() -> None:
    stream = io.BytesIO()
    wire.write_frame(stream, {"type": "step"}, {"action": np.ones(7)})
    whole = stream.getvalue()
    for cut in range(1, len(whole)):
        with pytest.raises(wire.WireError):
            wire.read_frame(io.BytesIO(whole[:cut]))


def payload_with(header: object, body: bytes = b"") -> bytes:
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + body


META = {"__metadata__": {"actrm": "{}"}}


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        (b"abc", "no safetensors header"),
        (struct.pack("<Q", 1 << 40), "header of"),
        (payload_with([1]), "not a JSON object"),
        (payload_with({}), "actrm"),
        (payload_with({"__metadata__": {"actrm": "[]"}}), "message is not a JSON object"),
        (payload_with({**META, "t": {"dtype": "F16", "shape": [1], "data_offsets": [0, 2]}}, b"12"), "'t'"),
        (payload_with({**META, "t": {"dtype": "F64", "shape": [2], "data_offsets": [0, 8]}}, b"12345678"), "'t'"),
        (payload_with({**META, "t": {"dtype": "F64", "shape": [1], "data_offsets": [8, 16]}}, b"12345678"), "'t'"),
        (payload_with({**META, "t": {"dtype": "U8", "shape": [-1], "data_offsets": [0, 0]}}), "'t'"),
    ],
)
def test_a_broken_payload_is_named(payload: bytes, words: str) -> None:
    with pytest.raises(wire.WireError, match=words.replace("[", r"\[")):
        wire.decode(payload)


def test_a_frame_that_is_too_long_is_refused_before_it_is_read() -> None:
    with pytest.raises(wire.WireError, match="announced"):
        wire.read_frame(io.BytesIO(struct.pack("<Q", wire.MAX_FRAME_BYTES + 1)))


def test_a_tensor_of_another_type_is_refused() -> None:
    with pytest.raises(wire.WireError, match="float16"):
        wire.encode({}, {"x": np.zeros(3, dtype=np.float16)})
