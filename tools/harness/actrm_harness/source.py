"""What a module of somebody else's says, as one number, so that no result outlives the rules it was played by."""

import hashlib
import sys
from pathlib import Path

from actrm_harness.protocol import RequestError


def digest(module: str) -> str:
    """SHA-256 of an imported module's source, with that of the modules beside it that it imported.

    A package counts as a whole. What lies elsewhere is a library: its version is its own affair.
    """
    file = _file(module)
    if file is None:
        raise RequestError("env_module", f"environment module {module!r} has no source file to take a sum of")
    folder = file.parent
    mine = {file}
    if folder.name != "site-packages":
        loaded = (_file(name) for name in list(sys.modules))
        mine |= {each for each in loaded if each is not None and folder in each.parents}
    total = hashlib.sha256()
    for each in sorted(mine):
        content = each.read_bytes()
        total.update(f"{each.relative_to(folder).as_posix()} {len(content)}\n".encode())
        total.update(content)
    return total.hexdigest()


def _file(module: str) -> Path | None:
    loaded = sys.modules.get(module)
    name = getattr(loaded, "__file__", None)
    return Path(name).resolve() if isinstance(name, str) and name.endswith(".py") else None
