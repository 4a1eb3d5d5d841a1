"""The Python package actrm and LeRobot's plugin as wheels in target/wheels, made of what cargo has built.

    .venv-wheel/bin/python tools/build_wheel.py

The extension is `lib_actrm.so`; both programs and the compiled control loop go along. maturin would select the one
crate, which has other features than the workspace, and compile nearly everything a second time. auditwheel finds the
tag.

This is also the build backend of `pip install .` (PEP 517, see pyproject.toml). pip shows cargo's output with `-v`.
"""

import base64
import hashlib
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CRATE = ROOT / "crates/python"
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
PLUGIN = CRATE / "lerobot_policy_actrm"
PACKED = ("actrm-data", "actrm-zoo", "control", "python")
PROGRAMS = ("actrm-data", "actrm-zoo", "libcontrol.so")
# so that the same files make the same wheel
EPOCH = (2020, 1, 1, 0, 0, 0)


def stripped(path: Path) -> bytes:
    """A program or library without its symbols."""
    with tempfile.NamedTemporaryFile() as out:
        subprocess.run(["strip", "-o", out.name, path], check=True)
        return Path(out.name).read_bytes()


def metadata(project: dict, version: str, page: str) -> dict[str, bytes]:
    """The files that say what the wheel is, but for its tag."""
    info = f"{project['name']}-{version}.dist-info"
    lines = ["Metadata-Version: 2.4", f"Name: {project['name']}", f"Version: {version}"]
    lines += [f"Summary: {project['description']}", f"Requires-Python: {project['requires-python']}"]
    lines += [f"License-Expression: {project['license']}"]
    lines += [f"Classifier: {classifier}" for classifier in project.get("classifiers", [])]
    lines += [f"Requires-Dist: {needed}" for needed in project["dependencies"]]
    for extra, needs in project.get("optional-dependencies", {}).items():
        lines += [f"Provides-Extra: {extra}", *(f"Requires-Dist: {need}; extra == '{extra}'" for need in needs)]
    files = {"METADATA": "\n".join([*lines, "Description-Content-Type: text/markdown", "", page])}
    if scripts := "".join(f"{name} = {place}\n" for name, place in project.get("scripts", {}).items()):
        files["entry_points.txt"] = f"[console_scripts]\n{scripts}"
    licences = {f"{info}/licenses/{name}": (ROOT / name).read_bytes() for name in ("LICENSE-MIT", "LICENSE-APACHE")}
    return {f"{info}/{name}": text.encode() for name, text in files.items()} | licences


def tag_file(info: str, tag: str, pure: bool) -> dict[str, bytes]:
    """The file that says where the wheel may be installed."""
    text = f"Wheel-Version: 1.0\nGenerator: actrm\nRoot-Is-Purelib: {str(pure).lower()}\nTag: {tag}\n"
    return {f"{info}/WHEEL": text.encode()}


def write(path: Path, files: dict[str, bytes], info: str, level: int = 9) -> None:
    """The archive, with the list of its files and their hashes last."""
    rows = []
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=level) as archive:
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


def plugin(version: str) -> Path:
    """The wheel of LeRobot's plugin, which is Python alone."""
    project = tomllib.loads((PLUGIN / "pyproject.toml").read_text())["project"]
    name = project["name"]
    sources = sorted((PLUGIN / name).glob("*.py"))
    files = {path.relative_to(PLUGIN).as_posix(): path.read_bytes() for path in sources}
    page = files[f"{name}/__init__.py"].decode().split('"""')[1]
    info = f"{name}-{version}.dist-info"
    files |= metadata(project, version, page) | tag_file(info, "py3-none-any", True)
    path = TARGET / "wheels" / f"{name}-{version}-py3-none-any.whl"
    write(path, files, info)
    return path


def platform(files: dict[str, bytes], info: str) -> str:
    """The platforms that auditwheel finds these files fit for."""
    tag = f"cp311-abi3-{sysconfig.get_platform().replace('-', '_')}"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{info.removesuffix('.dist-info')}-{tag}.whl"
        write(path, files | tag_file(info, tag, False), info, level=1)
        command = [sys.executable, "-m", "auditwheel", "show", str(path)]
        said = " ".join(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split())
    found = re.search(r'platform tag: "(\w+)"', said)
    if found is None:
        raise SystemExit(f"error: {path.name}: auditwheel finds no tag: {said}")
    return found[1]


def described(version: str) -> tuple[str, dict[str, bytes]]:
    """The folder of the package's metadata, and the files in it but for the tag's."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return f"actrm-{version}.dist-info", metadata(project, version, (ROOT / project["readme"]).read_text())


def package(version: str, out: Path) -> Path:
    """The wheel of the package in the folder `out`, under the tag that fits what it holds."""
    info, about = described(version)
    folder = CRATE / "python"
    sources = sorted(path for path in (folder / "actrm").glob("*") if path.suffix in {".py", ".pyi", ".typed"})
    files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in sources}
    files["actrm/_actrm.abi3.so"] = stripped(TARGET / "release/lib_actrm.so")
    files |= {f"actrm/bin/{name}": stripped(TARGET / "release" / name) for name in PROGRAMS}
    files |= about
    tag = f"cp311-abi3-{platform(files, info)}"
    path = out / f"actrm-{version}-{tag}.whl"
    write(path, files | tag_file(info, tag, False), info)
    return path


def workspace_version() -> str:
    """The version of every crate, which is the package's."""
    return tomllib.loads((ROOT / "Cargo.toml").read_text())["workspace"]["package"]["version"]


def build_wheel(wheel_directory: str, config_settings: object = None, metadata_directory: object = None) -> str:
    """PEP 517: compile what the wheel holds and write it to `wheel_directory`; the file's name."""
    del config_settings, metadata_directory
    if shutil.which("cargo") is None:
        raise SystemExit("error: no cargo on the PATH; install Rust from https://rustup.rs, then run pip again")
    packages = [word for name in PACKED for word in ("-p", name)]
    subprocess.run(["cargo", "build", "--release", "--locked", *packages], cwd=ROOT, check=True)
    return package(workspace_version(), Path(wheel_directory)).name


def prepare_metadata_for_build_wheel(metadata_directory: str, config_settings: object = None) -> str:
    """PEP 517: what the package is, without compiling it."""
    del config_settings
    info, files = described(workspace_version())
    for name, content in files.items():
        path = Path(metadata_directory) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return info


def build_sdist(sdist_directory: str, config_settings: object = None) -> str:
    """PEP 517: not offered, since a clone is the source."""
    raise SystemExit("error: actrm is built from a clone of its repository: pip install <clone>")


def main() -> None:
    """Write both wheels in the place of older ones."""
    version = workspace_version()
    out = TARGET / "wheels"
    out.mkdir(parents=True, exist_ok=True)
    for old in out.glob("*.whl"):
        old.unlink()
    for path in (package(version, out), plugin(version)):
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
