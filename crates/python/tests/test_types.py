"""The stub states what the extension has: the same names, the same arguments with the same defaults."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

import actrm
import pytest
from actrm import _actrm  # pyright: ignore[reportPrivateUsage]

STUB = ast.parse((Path(actrm.__file__).parent / "_actrm.pyi").read_text())
CLASSES = {node.name: node for node in STUB.body if isinstance(node, ast.ClassDef)}
FUNCTIONS = {node.name: node for node in STUB.body if isinstance(node, ast.FunctionDef)}


def stated(function: ast.FunctionDef) -> list[tuple[str, bool, str]]:
    """By argument its name, whether it is one by name only, and its default."""
    given = function.args
    positional = [*given.posonlyargs, *given.args]
    missing = [None] * (len(positional) - len(given.defaults))
    defaults = [*missing, *given.defaults, *given.kw_defaults]
    named = [(one.arg, i >= len(positional)) for i, one in enumerate([*positional, *given.kwonlyargs])]
    text = [repr(ast.literal_eval(default)) if default else "" for default in defaults]
    return [(name, only, value) for (name, only), value in zip(named, text, strict=True) if name != "self"]


def found(thing: object) -> list[tuple[str, bool, str]]:
    """The same of the extension."""
    given = inspect.signature(thing).parameters.values()  # type: ignore[arg-type]
    empty = inspect.Parameter.empty
    return [
        (one.name, one.kind is inspect.Parameter.KEYWORD_ONLY, "" if one.default is empty else repr(one.default))
        for one in given
        if one.name != "self"
    ]


def test_names_are_the_extension_s() -> None:
    public = {name for name in vars(_actrm) if not name.startswith("_")}
    assert CLASSES.keys() | FUNCTIONS.keys() == public


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_take_what_is_stated(name: str) -> None:
    assert stated(FUNCTIONS[name]) == found(getattr(_actrm, name))


@pytest.mark.parametrize("name", sorted(CLASSES.keys() - {"Error", "ResultsTakenOver"}))
def test_classes_have_what_is_stated(name: str) -> None:
    thing = getattr(_actrm, name)
    members = {node.name: node for node in CLASSES[name].body if isinstance(node, ast.FunctionDef)}
    public = {part for part in vars(thing) if not part.startswith("_")}
    assert {part for part in members if not part.startswith("_")} == public
    for part, node in members.items():
        if part == "__init__":
            assert stated(node) == found(thing)
        elif node.decorator_list:
            assert not callable(vars(thing)[part]), part
        elif not part.startswith("__"):
            assert stated(node) == found(getattr(thing, part)), part
        else:
            assert part in vars(thing), part
