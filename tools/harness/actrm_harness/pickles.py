"""What a pickle of torch's says, without doing what it asks for.

A pickle is a program, and unpickling runs it. Here a small machine walks over its instructions and keeps what they
name: text, numbers, lists, dictionaries, and of the globals only those in `GLOBALS`, each by a function of ours that
makes a plain value. Nothing is imported or called that the file names; another global and another instruction are
errors with their name.
"""

import io
import math
import pickletools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np


class PickleError(Exception):
    """A pickle that says something else than tensors and plain values; the text says what and where."""


@dataclass(frozen=True, slots=True)
class Global:
    """A name of Python's that the pickle asks for."""

    name: str


@dataclass(frozen=True, slots=True)
class Storage:
    """The numbers of one or more tensors: a file of its own in torch's archive."""

    layout: str
    key: str
    count: int


@dataclass(frozen=True, slots=True)
class Tensor:
    """A view of a storage, in numbers."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


@dataclass(slots=True)
class _Layout:
    """A dtype of numpy's under construction."""

    kind: str
    order: str = "="

    def of(self, data: bytes) -> "np.ndarray[Any, Any]":
        return np.frombuffer(data, dtype=np.dtype(self.kind).newbyteorder(cast(Any, self.order)))


@dataclass(slots=True)
class _Array:
    """An array of numpy's under construction."""

    value: list[Any] | None = None


@dataclass(slots=True)
class _Marked:
    """The stack below a mark."""

    items: list[Any] = field(default_factory=list[Any])


Items = tuple[Any, ...]
# of a tensor, in numbers
LONGEST = 1 << 32
# numbers alone: an array of objects would be a pickle in the pickle
_KINDS = {"f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1"}
_STORAGES = {"FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "LongStorage": "<i8"}


def _texts(args: Items, *kinds: type) -> None:
    # bool is an int to Python, and True no length
    if len(args) < len(kinds) or any(type(arg) is not kind for arg, kind in zip(args, kinds, strict=False)):
        found = ", ".join(type(arg).__name__ for arg in args)
        raise PickleError(f"arguments: expected {', '.join(kind.__name__ for kind in kinds)}, found {found or 'none'}")


def _lengths(values: Any, what: str) -> tuple[int, ...]:
    # never shown: what lies deep in itself takes for ever to print
    if not isinstance(values, tuple) or any(type(n) is not int or not 0 <= n < LONGEST for n in cast(Items, values)):
        raise PickleError(f"{what}: expected whole numbers from 0 to {LONGEST}, found something else")
    return cast(tuple[int, ...], values)


def _ordered_dict(args: Items) -> dict[Any, Any]:
    if args:
        raise PickleError("OrderedDict: expected no arguments: its items come after it")
    return {}


def _tensor(args: Items) -> Tensor:
    _texts(args, Storage, int, tuple, tuple)
    storage, offset, shape, strides = args[:4]
    return Tensor(storage, _lengths((offset,), "offset")[0], _lengths(shape, "shape"), _lengths(strides, "strides"))


def _layout(args: Items) -> _Layout:
    _texts(args, str)
    if args[0] not in _KINDS:
        raise PickleError(f"dtype: expected one of {', '.join(sorted(_KINDS))}, found {args[0]:.40}")
    return _Layout(args[0])


def _scalar(args: Items) -> Any:
    _texts(args, _Layout, bytes)
    values = args[0].of(args[1])
    if len(values) != 1:
        raise PickleError(f"scalar: expected one number, found {len(values)}")
    return values.tolist()[0]


def _array(args: Items) -> _Array:
    _texts(args, Global)
    if args[0].name != "numpy.ndarray":
        raise PickleError(f"array: expected numpy.ndarray, found {args[0].name}")
    return _Array()


def _bytes(args: Items) -> bytes:
    _texts(args, str, str)
    if args[1] != "latin1":
        raise PickleError(f"encode: expected latin1, found {args[1]:.40}")
    return args[0].encode("latin1")


# every global that may be asked for; what has no function here is a name and cannot be called
GLOBALS: dict[str, Callable[[Items], Any] | None] = {
    "collections.OrderedDict": _ordered_dict,
    "torch._utils._rebuild_tensor_v2": _tensor,
    **{f"torch.{name}": None for name in _STORAGES},
    "numpy.ndarray": None,
    "numpy.dtype": _layout,
    "_codecs.encode": _bytes,
    **{
        f"numpy.{core}.multiarray.{name}": make
        for core in ("core", "_core")
        for name, make in (("scalar", _scalar), ("_reconstruct", _array))
    },
}


def _storage(named: Any) -> Storage:
    """What torch names outside of the pickle."""
    if not isinstance(named, tuple):
        raise PickleError(f"persistent name: expected torch's storage, found {type(named).__name__}")
    args = cast(Items, named)
    _texts(args, str, Global, str, str, int)
    what, kind, key, _device, count = args[:5]
    layout = _STORAGES.get(kind.name.removeprefix("torch."))
    if what != "storage" or layout is None:
        raise PickleError(f"persistent name: expected torch's storage of numbers, found {what:.40} of {kind.name}")
    return Storage(layout, key, _lengths((count,), "count")[0])


def _built(made: Any, state: Any) -> None:
    """The second half of making something."""
    if isinstance(made, dict) and isinstance(state, dict) and list(cast(dict[Any, Any], state)) == ["_metadata"]:
        return  # a state dict's versions of modules
    if isinstance(made, _Layout) and isinstance(state, tuple) and cast(Items, state)[1:2] in (("<",), ("|",)):
        made.order = cast(Items, state)[1]
        return
    if isinstance(made, _Array) and isinstance(state, tuple):
        _texts(cast(Items, state), int, tuple, _Layout, bool, bytes)
        _version, shape, layout, fortran, data = cast(Items, state)
        shape, values = _lengths(shape, "array's shape"), layout.of(data)
        if math.prod(shape) != len(values):
            raise PickleError(f"array: shape {shape} of {len(values)} numbers")
        made.value = cast(list[Any], values.reshape(shape, order="F" if fortran else "C").tolist())
        return
    kind = type(cast(object, made)).__name__
    raise PickleError(f"instruction BUILD of {kind} is not one of torch's")


# instructions that bring a value of their own, and those that bring the one they carry
_FRESH: dict[str, Callable[[], Any]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_DICT": dict,
    "EMPTY_LIST": list,
    "EMPTY_TUPLE": tuple,
}
_NUMBERS = {"BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"}
_GIVEN = _NUMBERS | {"BINUNICODE", "SHORT_BINUNICODE", "BINBYTES", "SHORT_BINBYTES"}


class _Machine:
    """The stack, the memory and the instructions that torch's pickles use."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.memory: dict[int, Any] = {}
        self.waiting: list[_Marked] = []

    def marked(self) -> list[Any]:
        """What lies above the last mark, which is taken away."""
        if not self.waiting:
            raise PickleError("no mark")
        items, self.stack = self.stack, self.waiting.pop().items
        return items

    def found(self, name: str) -> Global:
        if name not in GLOBALS:
            raise PickleError(f"global {name:.80} is not allowed; allowed are {', '.join(sorted(GLOBALS))}")
        return Global(name)

    def put(self, pairs: list[Any]) -> None:
        """Key, value, key, value, into the dictionary on top."""
        into: object = self.stack[-1]
        if not isinstance(into, dict) or len(pairs) % 2:
            raise PickleError(f"items into {type(cast(object, into)).__name__}")
        into = cast(dict[Any, Any], into)
        for key, value in zip(pairs[::2], pairs[1::2], strict=True):
            if type(key) not in (str, int):
                raise PickleError(f"key: expected text or a number, found {type(key).__name__}")
            into[key] = finished(value)

    def add(self, items: list[Any]) -> None:
        """Items, to the list on top."""
        into: object = self.stack[-1]
        if not isinstance(into, list):
            raise PickleError(f"items into {type(into).__name__}")
        cast(list[Any], into).extend(finished(item) for item in items)

    def tuple_of(self, count: int) -> None:
        if count > len(self.stack):
            raise PickleError(f"a tuple of {count} from {len(self.stack)}")
        self.stack[len(self.stack) - count :] = [tuple(self.stack[len(self.stack) - count :])]

    def call(self) -> None:
        args, what = self.stack.pop(), self.stack.pop()
        make = GLOBALS.get(what.name) if isinstance(what, Global) else None
        if make is None or not isinstance(args, tuple):
            raise PickleError(f"call of {what.name if isinstance(what, Global) else type(what).__name__}")
        self.stack.append(make(cast(Items, args)))

    def do(self, name: str, arg: Any) -> None:  # noqa: PLR0912 (one branch an instruction)
        """One instruction."""
        match name:
            case "PROTO" | "FRAME" | "STOP":
                pass
            case "MARK":
                self.waiting.append(_Marked(self.stack))
                self.stack = []
            case _ if name in _FRESH:
                self.stack.append(_FRESH[name]())
            case _ if name in _GIVEN:
                self.stack.append(arg)
            case "TUPLE":
                items = self.marked()
                self.stack.append(tuple(items))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                self.tuple_of(int(name[-1]))
            case "SETITEM" | "APPEND":
                count = 2 if name == "SETITEM" else 1
                self.tuple_of(count)
                items = list(self.stack.pop())
                (self.put if name == "SETITEM" else self.add)(items)
            case "SETITEMS" | "APPENDS":
                items = self.marked()
                (self.put if name == "SETITEMS" else self.add)(items)
            case "BINPUT" | "LONG_BINPUT":
                self.memory[arg] = self.stack[-1]
            case "MEMOIZE":
                self.memory[len(self.memory)] = self.stack[-1]
            case "BINGET" | "LONG_BINGET":
                if arg not in self.memory:
                    raise PickleError(f"memory {arg} is empty")
                self.stack.append(self.memory[arg])
            case "GLOBAL":
                self.stack.append(self.found(arg.replace(" ", ".")))
            case "STACK_GLOBAL":
                self.tuple_of(2)
                self.stack.append(self.found(".".join(map(str, self.stack.pop()))))
            case "BINPERSID":
                self.stack.append(_storage(self.stack.pop()))
            case "REDUCE":
                self.call()
            case "BUILD":
                state = self.stack.pop()
                _built(self.stack[-1], state)
            case _:
                raise PickleError(f"instruction {name} is not one of torch's")


def finished(value: Any) -> Any:
    """A value that goes into another: an array is its numbers by then."""
    return value.value if isinstance(value, _Array) else value


def read(data: bytes) -> Any:
    """What the pickle says: plain values, with `Tensor` where a tensor is."""
    machine = _Machine()
    where = 0
    try:
        for instruction, arg, position in pickletools.genops(io.BytesIO(data)):
            where = position or 0
            machine.do(instruction.name, arg)
    except PickleError as error:
        raise PickleError(f"at byte {where}: {error}") from None
    except (ValueError, IndexError, OverflowError, TypeError, MemoryError) as error:
        # of pickletools: bytes that are no instructions, or end among them; of ours: a stack that is empty
        raise PickleError(f"after byte {where}: {type(error).__name__}: {error}") from None
    if where + 1 != len(data) or len(machine.stack) != 1 or machine.waiting:
        raise PickleError(f"after byte {where}: expected one value and the end")
    return finished(machine.stack[0])
