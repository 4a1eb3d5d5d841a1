"""What sources say, as SHA-256 sums, so that no result outlives the code that it was made by.

`python -m actrm_harness.source NAME...` prints versions and sums of packages as this Python would import them now.
"""

import hashlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import sys
from collections.abc import Iterable
from pathlib import Path

CONTENT = frozenset(
    {".py", ".xml", ".mjcf", ".urdf", ".xacro", ".json", ".yaml", ".yml", ".so", ".dylib", ".dll", ".pyd"}
)
"""Files whose content counts: code, models, configurations, libraries."""
SIZE = frozenset({".obj", ".stl", ".msh", ".dae", ".mtl", ".png", ".jpg", ".jpeg"})
"""Meshes and textures, of which name and size count: robosuite has half a gigabyte of them."""
HARNESS = Path(__file__).resolve().parent
"""This package, which has a sum of its own."""


def digest(module: str) -> str | None:
    """SHA-256 of an imported module's source, with that of the modules beside it that it imported.

    A package counts as a whole. What lies elsewhere is a library (`sums`), and so is what is installed below the folder
    in a virtual environment. None for a module without a source file.
    """
    file = _file(module)
    if file is None:
        return None
    folder = file.parent
    mine = {file}
    if folder.name != "site-packages":
        loaded = (_file(name) for name in list(sys.modules))
        mine |= {each for each in loaded if each is not None and _beside(folder, each)}
    total = hashlib.sha256()
    for each in sorted(mine):
        content = each.read_bytes()
        total.update(f"{each.relative_to(folder).as_posix()} {len(content)}\n".encode())
        total.update(content)
    return total.hexdigest()


def _beside(folder: Path, file: Path) -> bool:
    """Whether a file lies below a folder and is neither installed there nor this package's."""
    if folder not in file.parents or HARNESS in file.parents:
        return False
    return "site-packages" not in file.relative_to(folder).parts


def sums(names: Iterable[str]) -> dict[str, str]:
    """SHA-256 of each of these top-level modules as imported, or as they would be; what nobody finds is left out.

    A package counts with every file below its folders: `CONTENT` by content, `SIZE` by size, nothing else, and with
    those of its modules that were imported from elsewhere.
    """
    found: dict[str, str] = {}
    for name in sorted(set(names) - sys.stdlib_module_names - {"__main__"}):
        files = _files(name)
        if files:
            found[name] = _sum(files)
    return found


def _sum(files: dict[str, str]) -> str:
    total = hashlib.sha256()
    for name, path in sorted(files.items()):
        if _suffix(name) in SIZE:
            total.update(f"{name} {os.stat(path).st_size}\n".encode())
            continue
        with open(path, "rb") as file:
            content = file.read()
        total.update(f"{name} {len(content)}\n".encode())
        total.update(content)
    return total.hexdigest()


def _files(name: str) -> dict[str, str]:
    """The files of a top-level module, by their names below its folder."""
    folders, file = _place(name)
    if not folders:
        return {} if file is None else {os.path.basename(file): file}
    files: dict[str, str] = {}
    seen: set[str] = set()
    for number, folder in enumerate(folders):
        for parent, children, inside in os.walk(folder, followlinks=True):
            if (real := os.path.realpath(parent)) in seen:
                children.clear()
                continue
            seen.add(real)
            children[:] = sorted(child for child in children if not child.startswith((".", "__pycache__")))
            for each in inside:
                if not each.startswith(".") and _suffix(each) in CONTENT | SIZE:
                    path = os.path.join(parent, each)
                    prefix = f"{number}/" if number else ""
                    files[prefix + os.path.relpath(path, folder).replace(os.sep, "/")] = path
    # by the names that they were imported by: an installation may be made of links
    own = tuple(os.path.join(folder, "") for folder in folders)
    for module, loaded in list(sys.modules.items()):
        path = getattr(loaded, "__file__", None) if module.startswith(f"{name}.") else None
        if isinstance(path, str) and path.endswith(".py") and not os.path.abspath(path).startswith(own):
            files[f"{module} from elsewhere"] = path
    return files


def _place(name: str) -> tuple[list[str], str | None]:
    """The folders of a package, or the file of a module."""
    loaded = sys.modules.get(name)
    if loaded is not None:
        folders, file = getattr(loaded, "__path__", None), getattr(loaded, "__file__", None)
    else:
        try:
            spec = importlib.util.find_spec(name)
        except (ImportError, ValueError):
            spec = None
        if spec is None:
            return [], None
        folders, file = spec.submodule_search_locations, spec.origin
    paths = [os.path.abspath(folder) for folder in folders or ()]
    return paths, file if isinstance(file, str) and os.path.isfile(file) else None


def _suffix(name: str) -> str:
    """What a file is; `.so` of a library with its version behind it."""
    name = name.lower()
    return ".so" if ".so." in name else os.path.splitext(name)[1]


def _file(module: str) -> Path | None:
    loaded = sys.modules.get(module)
    name = getattr(loaded, "__file__", None)
    return Path(name).resolve() if isinstance(name, str) and name.endswith(".py") else None


def main() -> None:
    """Versions of what stands before `--`, sums of what stands behind it, as one line of JSON."""
    names, _, packages = " ".join(sys.argv[1:]).partition("--")
    versions = {
        name: platform.python_version() if name == "python" else importlib.metadata.version(name)
        for name in names.split()
    }
    print(json.dumps({"versions": versions, "sources": sums(packages.split())}))


if __name__ == "__main__":
    main()
