"""docs/reference/python.md from the docstrings of the installed package.

target/wheel-venvs/3.11/bin/python tools/python_api.py > docs/reference/python.md
"""

import ast
import inspect
import sys
from pathlib import Path

import actrm
import actrm.envs

PLUGIN = Path(__file__).resolve().parents[1] / "crates/python/lerobot_policy_actrm/lerobot_policy_actrm/__init__.py"

HEAD = """# actrm in Python

Written by `tools/python_api.py` from the package's docstrings; `make test` compares.
"""


def signature(thing: object) -> str:
    """Its arguments, as it is called."""
    try:
        found = inspect.signature(thing)  # type: ignore[arg-type]
    except ValueError:
        return "()"
    nameless = {name: p.replace(annotation=inspect.Parameter.empty) for name, p in found.parameters.items()}
    nameless.pop("self", None)
    return str(found.replace(parameters=list(nameless.values()), return_annotation=inspect.Signature.empty))


def doc(thing: object) -> str:
    """Its docstring as Markdown: what is set in underlined under `Parameters` becomes a list."""
    lines = inspect.cleandoc(thing.__doc__ or "").splitlines()
    out: list[str] = []
    listed = False
    for line in lines:
        if line == "Parameters":
            continue
        if line.startswith("---"):
            listed = True
        elif listed and line and not line.startswith(" "):
            name, colon, rest = line.partition(": ")
            listed = bool(colon)
            out.append(f"- `{name}`: {rest}" if colon else line)
        elif listed and line:
            out.append("  " + line.strip())
        else:
            listed = listed and bool(line)
            out.append(line)
    return "\n".join(out).strip()


def main() -> None:
    """Write the page."""
    parts = [HEAD, inspect.cleandoc(actrm.__doc__ or "").split("\n", 1)[0]]
    for name in actrm.__all__:
        if name == "__version__":
            continue
        thing = getattr(actrm, name)
        if not isinstance(thing, type) or issubclass(thing, Exception):
            shown = "" if isinstance(thing, type) else signature(thing)
            parts.append(f"## `actrm.{name}{shown}`\n\n{doc(thing)}")
            continue
        parts.append(f"## `actrm.{name}{signature(thing)}`\n\n{doc(thing)}")
        for part, member in sorted(vars(thing).items()):
            if not part.startswith("_"):
                shown = signature(member) if callable(member) else ""
                parts.append(f"**`{part}{shown}`** {doc(member)}")
    parts += ["## `actrm.envs`", doc(actrm.envs)]
    parts.append(f"### `actrm.envs.RobotEnv{signature(actrm.envs.RobotEnv)}`\n\n{doc(actrm.envs.RobotEnv)}")
    parts += ["## LeRobot's plugin", ast.get_docstring(ast.parse(PLUGIN.read_text())) or ""]
    sys.stdout.write("\n\n".join(part.strip() for part in parts) + "\n")


if __name__ == "__main__":
    main()
