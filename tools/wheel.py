"""The Python package actrm as a wheel in target/wheels, made of what cargo has built.

    .venv-wheel/bin/python tools/wheel.py

Nothing is compiled: the extension is `lib_actrm.so`, and both programs and the compiled control loop go along. maturin
would select the one crate, which has other features than the workspace, and compile nearly everything a second time.
The tag is the one that auditwheel finds.
"""

import base64
import hashlib
import os
import re
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CRATE = ROOT / "crates/python"
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
PROGRAMS = ("actrm-data", "actrm-zoo", "libcontrol.so")
# so that the same files make the same wheel
EPOCH = (2020, 1, 1, 0, 0, 0)


def stripped(path: Path) -> bytes:
    """A program or library without its symbols."""
    with tempfile.NamedTemporaryFile() as out:
        subprocess.run(["strip", "-o", out.name, path], check=True)
        return Path(out.name).read_bytes()


def metadata(project: dict, version: str) -> dict[str, str]:
    """The files that say what the wheel is; its tag is still to be found."""
    lines = ["Metadata-Version: 2.4", f"Name: {project['name']}", f"Version: {version}"]
    lines += [f"Summary: {project['description']}", f"Requires-Python: {project['requires-python']}"]
    lines += [f"License-Expression: {project['license']}"]
    lines += [f"Classifier: {classifier}" for classifier in project["classifiers"]]
    lines += [f"Requires-Dist: {needed}" for needed in project["dependencies"]]
    for extra, needs in project["optional-dependencies"].items():
        lines += [f"Provides-Extra: {extra}", *(f"Requires-Dist: {need}; extra == '{extra}'" for need in needs)]
    lines += ["Description-Content-Type: text/markdown", "", (CRATE / "README.md").read_text()]
    scripts = "".join(f"{name} = {place}\n" for name, place in project["scripts"].items())
    return {"METADATA": "\n".join(lines), "entry_points.txt": f"[console_scripts]\n{scripts}"}


def write(path: Path, files: dict[str, bytes], info: str) -> None:
    """The archive, with the list of its files and their hashes last."""
    rows = []
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, content in files.items():
            digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
            rows.append(f"{name},sha256={digest},{len(content)}\n")
            entry = zipfile.ZipInfo(name, EPOCH)
            entry.external_attr = (0o100755 if "/bin/" in name or name.endswith(".so") else 0o100644) << 16
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, content)
        entry = zipfile.ZipInfo(f"{info}/RECORD", EPOCH)
        entry.external_attr = 0o100644 << 16
        archive.writestr(entry, "".join(rows) + f"{info}/RECORD,,\n")


def main() -> None:
    """Write the wheel under the tag that fits what it holds."""
    project = tomllib.loads((CRATE / "pyproject.toml").read_text())["project"]
    version = tomllib.loads((ROOT / "Cargo.toml").read_text())["workspace"]["package"]["version"]
    info = f"actrm-{version}.dist-info"
    package = CRATE / "python"
    sources = sorted(path for path in (package / "actrm").glob("*") if path.suffix in {".py", ".pyi", ".typed"})
    files = {path.relative_to(package).as_posix(): path.read_bytes() for path in sources}
    files["actrm/_actrm.abi3.so"] = stripped(TARGET / "release/lib_actrm.so")
    files |= {f"actrm/bin/{name}": stripped(TARGET / "release" / name) for name in PROGRAMS}
    files |= {f"{info}/{name}": text.encode() for name, text in metadata(project, version).items()}
    files |= {f"{info}/licenses/{name}": (ROOT / name).read_bytes() for name in ("LICENSE-MIT", "LICENSE-APACHE")}
    out = TARGET / "wheels"
    out.mkdir(parents=True, exist_ok=True)
    for old in out.glob("actrm-*.whl"):
        old.unlink()
    tag = "linux_x86_64"
    # once to ask auditwheel, once with its answer
    for _ in range(2):
        name = f"cp311-abi3-{tag}"
        text = f"Wheel-Version: 1.0\nGenerator: actrm\nRoot-Is-Purelib: false\nTag: {name}\n"
        path = out / f"actrm-{version}-{name}.whl"
        write(path, files | {f"{info}/WHEEL": text.encode()}, info)
        command = [sys.executable, "-m", "auditwheel", "show", str(path)]
        said = " ".join(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split())
        found = re.search(r'platform tag: "(\w+)"', said)
        if found is None:
            raise SystemExit(f"error: {path}: auditwheel finds no tag: {said}")
        if found[1] != tag:
            path.unlink()
            tag = found[1]
        else:
            break
    if not path.exists():
        raise SystemExit(f"error: auditwheel finds another tag than {tag}: {said}")
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
