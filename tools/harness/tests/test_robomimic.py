"""Checkpoints of robomimic's: what torch wrote is read right, what wants something else is refused and never run."""

import io
import os
import pickle
import pickletools
import random
import shutil
import struct
import subprocess
import sys
import types
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actrm_harness import pickles, robomimic, wire

# what every demonstration of this calls
SYSTEM: Any = vars(os)["system"]
# robomimic's own, of crates/zoo's tests
FIXTURES = Path(__file__).resolve().parents[3] / "crates" / "interchange" / "tests" / "fixtures" / "robomimic"
RNN = FIXTURES / "bc_rnn.pth"
PARTS: dict[str, Any] = {
    "model": OrderedDict(),
    "config": "{}",
    "algo_name": "bc",
    "env_metadata": {"type": 1},
    "shape_metadata": {"ac_dim": 7, "all_shapes": OrderedDict(object=[10])},
}


def archive(path: Path, pickled: bytes, members: dict[str, bytes] | None = None, **options: Any) -> Path:
    """A file like torch's around a pickle."""
    with zipfile.ZipFile(path, "w", **options) as out:
        out.writestr("model/data.pkl", pickled)
        for name, data in (members or {}).items():
            out.writestr(f"model/{name}", data)
    return path


def checkpoint(path: Path, members: dict[str, bytes] | None = None, **parts: Any) -> Path:
    """A checkpoint with other parts than a good one's, pickled by Python itself."""
    return archive(path, pickle.dumps(PARTS | parts, 2), members)


def refused(path: Path) -> str:
    with pytest.raises(robomimic.CheckpointError) as error:
        robomimic.read(path)
    return str(error.value)


def rewritten(path: Path, change: Callable[[str, bytes], bytes | None]) -> Path:
    """The fixture with its members changed, or left out."""
    with zipfile.ZipFile(RNN) as given, zipfile.ZipFile(path, "w") as out:
        for member in given.infolist():
            name = member.filename.split("/", 1)[1]
            data = change(name, given.read(member))
            if data is not None:
                out.writestr(f"model/{name}", data)
    return path


class Calls:
    """What a pickle would call when somebody loads it."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.what = (function, arguments)

    def __reduce__(self) -> Any:
        return self.what


class Named:
    """A storage, which torch names outside of the pickle."""

    def __init__(self, *name: Any) -> None:
        self.name = name


class _Pickler(pickle.Pickler):
    def persistent_id(self, obj: Any) -> Any:
        return obj.name if isinstance(obj, Named) else None


@pytest.fixture
def torch(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The names of torch's that a pickle of it holds; pickling checks that they are there."""

    def _rebuild_tensor_v2() -> None:
        raise NotImplementedError

    made, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
    _rebuild_tensor_v2.__module__, _rebuild_tensor_v2.__qualname__ = "torch._utils", "_rebuild_tensor_v2"
    utils.__dict__["_rebuild_tensor_v2"] = _rebuild_tensor_v2
    for name in ("FloatStorage", "HalfStorage", "DoubleStorage", "LongStorage", "QUInt8Storage"):
        made.__dict__[name] = type(name, (), {"__module__": "torch"})
    made.__dict__["_utils"] = utils
    monkeypatch.setitem(sys.modules, "torch", made)
    monkeypatch.setitem(sys.modules, "torch._utils", utils)
    return made


def tensor_file(torch: Any, path: Path, data: bytes, view: tuple[Any, ...], **named: Any) -> Path:
    """A checkpoint with one tensor, `view` being offset, shape and strides."""
    storage = Named("storage", getattr(torch, named.get("kind", "FloatStorage")), "0", "cpu", named.get("count", 6))
    tensor = Calls(torch._utils._rebuild_tensor_v2, storage, *view, False, OrderedDict())
    out = io.BytesIO()
    _Pickler(out, 2).dump(PARTS | {"model": OrderedDict(w=tensor)})
    return archive(path, out.getvalue(), {"data/0": data})


SIX = np.arange(6, dtype="<f4")


def test_what_robomimic_saved_is_read() -> None:
    message, weights = robomimic.read(FIXTURES / "bc_rnn_normalised.pth")
    assert message["algo_name"] == "bc" and '"rnn_type": "LSTM"' in message["config"]
    assert message["env_metadata"]["env_name"] == "Lift" and message["shape_metadata"]["ac_dim"] == 7
    assert [key for key, _ in message["all_shapes"]] == sorted(message["shape_metadata"]["all_shapes"])
    assert len(message["obs_normalization_stats"]["object"]["std"][0]) == 10
    assert weights["policy.nets.rnn.nets.weight_ih_l0"].shape == (32, 19)
    for name, values in weights.items():
        assert values.dtype == np.float32 and np.isfinite(values).all() and values.std() > 0.01, name
    message, weights = robomimic.read(FIXTURES / "bc_transformer.pth")
    assert message["obs_normalization_stats"] is None
    mask = weights["policy.nets.transformer.nets.transformer.0.nets.attention.mask"]
    assert np.array_equal(mask[0, 0], np.tril(np.ones((4, 4))))


@pytest.mark.parametrize("kind", ["FloatStorage", "HalfStorage", "DoubleStorage", "LongStorage"])
def test_views_of_a_storage_are_their_numbers(torch: Any, tmp_path: Path, kind: str) -> None:
    data = SIX.astype({"F": "<f4", "H": "<f2", "D": "<f8", "L": "<i8"}[kind[0]]).tobytes()
    for view, expected in (
        ((0, (2, 3), (3, 1)), [[0, 1, 2], [3, 4, 5]]),
        ((0, (3, 2), (1, 3)), [[0, 3], [1, 4], [2, 5]]),
        ((4, (2,), (1,)), [4, 5]),
        ((5, (), ()), 5),
    ):
        _, weights = robomimic.read(tensor_file(torch, tmp_path / "m.pth", data, view, kind=kind))
        assert weights["w"].tolist() == expected


def test_views_beyond_a_storage_are_refused(torch: Any, tmp_path: Path) -> None:
    def error(view: tuple[Any, ...], data: bytes = SIX.tobytes(), **named: Any) -> str:
        return refused(tensor_file(torch, tmp_path / "m.pth", data, view, **named))

    for view in (
        (1, (6,), (1,)),
        (0, (2, 3), (4, 1)),
        (0, (7,), (0,)),
        (0, (2, 3), (1,)),
        (0, (0, 1 << 31), (1, 1)),
        (1 << 31, (1,), (1,)),
        (0, (1 << 31, 1 << 31), (1 << 31, 1 << 31)),
    ):
        assert "does not lie in storage 0 of 6 numbers" in error(view), view
    for view in ((-1, (6,), (1,)), (0, (6,), (-1,)), (0, (1 << 64,), (1,)), (0, (True,), (1,)), (0, ("6",), (1,))):
        assert "expected whole numbers from 0" in error(view), view
    assert "storage 0: expected 28 bytes, found 24" in error((0, (6,), (1,)), count=7)
    assert "storage 0: expected 24 bytes, found 0" in error((0, (6,), (1,)), b"")
    assert "global torch.QUInt8Storage is not allowed" in error((0, (6,), (1,)), kind="QUInt8Storage")
    # the shape is a nest that doubles thirty times: to print it would take for ever
    nest: Any = ()
    for _ in range(30):
        nest = (nest, nest)
    assert "expected whole numbers from 0" in error((0, (nest,), (1,)))


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize(
    ("function", "name"),
    [(SYSTEM, "posix.system"), (eval, "eval"), (shutil.rmtree, "shutil.rmtree")],
)
def test_what_a_pickle_would_run_is_named_and_not_run(tmp_path: Path, protocol: int, function: Any, name: str) -> None:
    marker = tmp_path / "it was run"
    text = f"open({str(marker)!r}, 'w')" if function is eval else f"touch '{marker}'"
    pickled = pickle.dumps(PARTS | {"config": Calls(function, text)}, protocol)
    error = refused(archive(tmp_path / "m.pth", pickled))
    # the oldest protocols write numbers as text, which torch never does
    assert f"{name} is not allowed" in error or (protocol < 2 and "is not one of torch's" in error), error
    assert not marker.exists()
    # it would have been
    if function is SYSTEM:
        pickle.loads(pickled)
        assert marker.exists()


def test_instructions_that_torch_does_not_use_are_named(tmp_path: Path) -> None:
    for pickled, named in (
        (b"\x80\x02(S'touch x'\nios\nsystem\n.", "STRING"),
        (b"\x80\x02(ios\nsystem\n.", "instruction INST"),
        (b"\x80\x02cos\nsystem\n.", "global os.system is not allowed"),
        (b"\x80\x04\x8c\x02os\x8c\x06system\x93.", "global os.system is not allowed"),
        (b"\x80\x02cos\nsystem\nX\x01\x00\x00\x00xo.", "global os.system"),
        (b"\x80\x02ccollections\nOrderedDict\n)\x81.", "instruction NEWOBJ"),
        (b"\x80\x02}}b.", "instruction BUILD of dict"),
        (b"\x80\x02\x82\x01.", "instruction EXT1"),
        (b"\x80\x02K\x01)R.", "call of int"),
        (b"\x80\x02ctorch\nFloatStorage\n)R.", "call of torch.FloatStorage"),
        (b"\x80\x02R.", "IndexError"),
        (b"\x80\x02h\x07.", "memory 7 is empty"),
        (b"\x80\x02u.", "no mark"),
        (b"\x80\x02K\x01", "pickle exhausted before seeing STOP"),
        (b"\x80\x02K\x01.x", "expected one value and the end"),
        (b"\x80\x02(K\x01.", "expected one value and the end"),
        (b"\x80\x02X\xff\xff\xff\x7fabc.", "expected 2147483647 bytes"),
        (b"\x80\x02]]Q.", "persistent name"),
        (b"\x80\x02})K\x01s.", "key: expected text or a number, found tuple"),
        (b"", "pickle exhausted"),
    ):
        error = refused(archive(tmp_path / "m.pth", pickled))
        assert "data.pkl" in error and named in error, (pickled, error)


def test_numbers_of_numpys_are_numbers(tmp_path: Path) -> None:
    grid = np.arange(6, dtype=np.float64).reshape(2, 3)
    stats = {"object": {"mean": grid[:1], "std": np.asfortranarray(grid), "n": np.int64(7), "x": np.float32(0.5)}}
    shapes: dict[str, Any] = {"ac_dim": np.int64(7), "all_shapes": OrderedDict(object=[10])}
    message, _ = robomimic.read(checkpoint(tmp_path / "m.pth", obs_normalization_stats=stats, shape_metadata=shapes))
    found = message["obs_normalization_stats"]["object"]
    assert found == {"mean": grid[:1].tolist(), "std": grid.tolist(), "n": 7, "x": 0.5}
    assert message["shape_metadata"]["ac_dim"] == 7
    # with objects in it an array is another pickle
    error = refused(checkpoint(tmp_path / "m.pth", obs_normalization_stats=np.array([SYSTEM], dtype=object)))
    assert "not allowed" in error or "dtype: expected one of" in error, error


def test_plain_values_stay_plain_and_small(tmp_path: Path) -> None:
    doubled: Any = ["x" * 1000]
    for _ in range(40):
        doubled = [doubled, doubled]
    deep: Any = 1
    for _ in range(200):
        deep = [deep]
    endless: list[Any] = []
    endless.append(endless)
    for value, named in (
        ({"a": doubled}, "values and characters, 32 deep, found more"),
        ({"a": deep}, "32 deep, found more"),
        ({"a": endless}, "32 deep, found more"),
        ({"a": ["x" * 100_000] * 100}, "values and characters"),
        ({"a": float("nan")}, "env_metadata.a: expected a finite number, found nan"),
        ({"a": b"bytes"}, "env_metadata.a: expected text, numbers, lists or dictionaries, found bytes"),
        ({"a": 1 << 64}, "env_metadata.a: expected a whole number of 64 bits"),
        ({1: 1}, "env_metadata: expected text, found int"),
    ):
        error = refused(checkpoint(tmp_path / "m.pth", env_metadata=value))
        assert named in error, error


def test_parts_of_a_checkpoint_are_named(tmp_path: Path) -> None:
    def error(**parts: Any) -> str:
        return refused(checkpoint(tmp_path / "m.pth", **parts))

    assert "unknown: action_normalization_stats" in error(action_normalization_stats={"a": 1})
    assert "model.nets: expected a tensor, found dict" in error(model={"nets": {}})
    assert "model: expected a dictionary, found list" in error(model=[])
    assert "shape_metadata.all_shapes: expected a dictionary" in error(shape_metadata={"ac_dim": 7})
    lacking = {key: value for key, value in PARTS.items() if key != "config"}
    assert "missing: config" in refused(archive(tmp_path / "m.pth", pickle.dumps(lacking, 2)))
    assert "checkpoint: expected a dictionary, found list" in refused(archive(tmp_path / "m.pth", pickle.dumps([1], 2)))


def test_archives_that_are_not_torchs_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.pth"
    good = pickle.dumps(PARTS, 2)
    compressed = archive(path, good, compression=zipfile.ZIP_DEFLATED)
    assert "member 'model/data.pkl': expected stored bytes" in refused(compressed)
    assert "byteorder: expected little, found b'big'" in refused(archive(path, good, {"byteorder": b"big"}))
    with zipfile.ZipFile(archive(path, good), "a") as out:
        out.writestr("other/data.pkl", good)
    assert "found 2 of them" in refused(path)
    with zipfile.ZipFile(path, "w") as out:
        out.writestr("data.pkl", good)
    assert "expected one FOLDER/data.pkl, found 0" in refused(path)
    with pytest.warns(UserWarning, match="Duplicate name"):
        archive(path, good, {"data.pkl": good})
    assert "is there twice" in refused(path)
    for bytes_ in (b"", b"PK", good, b"\x80\x02" + b"x" * 100):
        path.write_bytes(bytes_)
        assert "expected a zip archive" in refused(path)
    missing = rewritten(path, lambda name, data: None if name == "data/3" else data)
    assert "member 'model/data/3' is missing" in refused(missing)
    short = rewritten(path, lambda name, data: data[:-4] if name == "data/3" else data)
    assert "storage 3: expected" in refused(short)
    path.write_bytes(b"")
    os.truncate(path, wire.MAX_FRAME_BYTES + 1)
    assert "expected at most" in refused(path)


def test_a_file_that_ends_too_early_is_refused(tmp_path: Path) -> None:
    whole = RNN.read_bytes()
    path = tmp_path / "m.pth"
    for cut in [*range(0, len(whole), 997), *range(len(whole) - 23, len(whole))]:
        path.write_bytes(whole[:cut])
        refused(path)
    # and a pickle that does, in an archive that is whole
    with zipfile.ZipFile(RNN) as given:
        pickled = given.read("bc_rnn/data.pkl")
    for cut in range(0, len(pickled), 19):
        refused(archive(path, pickled[:cut]))


def test_changed_bits_are_refused_or_read_and_nothing_else(tmp_path: Path) -> None:
    """Neither run nor failed on: of the pickle, where every bit counts, and of the archive around it."""
    rng = random.Random(1)
    path = tmp_path / "m.pth"
    with zipfile.ZipFile(RNN) as given:
        members = {name.split("/", 1)[1]: given.read(name) for name in given.namelist()}
    pickled = members.pop("data.pkl")
    # not the text of the configuration, which is half of it
    text = next(arg for _, arg, _ in pickletools.genops(pickled) if isinstance(arg, str) and len(arg) > 1000)
    begin = pickled.index(text.encode())
    places = [place for place in range(len(pickled)) if not begin <= place < begin + len(text)]
    outcomes = {True: 0, False: 0}
    for _ in range(500):
        changed = bytearray(pickled)
        for _ in range(rng.choice((1, 1, 2, 8))):
            changed[rng.choice(places)] ^= 1 << rng.randrange(8)
        try:
            robomimic.read(archive(path, bytes(changed), members))
            outcomes[True] += 1
        except robomimic.CheckpointError:
            outcomes[False] += 1
    assert min(outcomes.values()) > 20, outcomes
    whole = RNN.read_bytes()
    for _ in range(100):
        changed = bytearray(whole)
        changed[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        path.write_bytes(changed)
        try:
            robomimic.read(path)
        except robomimic.CheckpointError:
            continue


def run(*arguments: str | Path) -> subprocess.CompletedProcess[bytes]:
    harness = Path(__file__).resolve().parents[1]
    command = [sys.executable, "-m", "actrm_harness.robomimic", *map(str, arguments)]
    return subprocess.run(command, env=os.environ | {"PYTHONPATH": str(harness)}, capture_output=True, check=False)


def test_the_program_writes_one_frame_or_one_line(tmp_path: Path) -> None:
    done = run(RNN)
    assert done.returncode == 0 and done.stderr == b""
    frame = wire.read_frame(io.BytesIO(done.stdout))
    assert frame is not None and struct.unpack("<Q", done.stdout[:8])[0] + 8 == len(done.stdout)
    message, weights = frame
    expected, arrays = robomimic.read(RNN)
    assert message == expected and sorted(weights) == sorted(arrays)
    assert all(np.array_equal(weights[name], arrays[name]) for name in arrays)
    for arguments, said in (
        ((tmp_path / "none.pth",), b"reading it: No such file or directory"),
        ((tmp_path,), b"reading it: Is a directory"),
        ((), b"expected one argument, the file"),
        ((checkpoint(tmp_path / "m.pth", config=Calls(SYSTEM, "x")),), b"global posix.system is not allowed"),
    ):
        done = run(*arguments)
        assert done.returncode == 1 and done.stdout == b"" and said in done.stderr, done.stderr
        assert done.stderr.count(b"\n") == 1


def test_every_allowed_global_makes_a_plain_value() -> None:
    assert set(pickles.GLOBALS) == {
        "collections.OrderedDict",
        "torch._utils._rebuild_tensor_v2",
        *(f"torch.{kind}Storage" for kind in ("Float", "Double", "Half", "Long")),
        *("numpy.ndarray", "numpy.dtype", "_codecs.encode"),
        *(f"numpy.{core}.multiarray.{name}" for core in ("core", "_core") for name in ("scalar", "_reconstruct")),
    }
