"""Sums of what is imported."""

import json
import subprocess
import sys
from pathlib import Path

from conftest import HARNESS


def summed(folder: Path, *names: str) -> dict[str, str]:
    """What `actrm_harness.source` says of packages, imported by nobody."""
    command = [sys.executable, "-m", "actrm_harness.source", "python", "--", *names]
    said = subprocess.run(
        command, env={"PYTHONPATH": f"{folder}:{HARNESS}"}, capture_output=True, text=True, check=True
    )
    return json.loads(said.stdout)["sources"]


def imported(folder: Path, name: str, first: str = "") -> dict[str, str]:
    """What is said of a package that was imported."""
    script = (
        f"{first}\nimport {name}, json\nfrom actrm_harness import source\nprint(json.dumps(source.sums(['{name}'])))"
    )
    said = subprocess.run(
        [sys.executable, "-c", script],
        env={"PYTHONPATH": f"{folder}:{HARNESS}"},
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(said.stdout)


def test_a_package_is_its_code_its_models_and_the_sizes_of_its_meshes(tmp_path: Path) -> None:
    package = tmp_path / "world"
    (package / "assets").mkdir(parents=True)
    (package / "__init__.py").write_text("from world import rules\n")
    (package / "rules.py").write_text("HEIGHT = 0.04\n")
    (package / "assets" / "arena.xml").write_text("<mujoco/>")
    (package / "assets" / "cube.stl").write_bytes(b"12345")
    first = summed(tmp_path, "world", "nowhere", "json")
    assert list(first) == ["world"] and first == imported(tmp_path, "world")
    assert summed(tmp_path, "world") == first, "the compiled copies beside it count for nothing"
    (package / "notes.txt").write_text("nothing\n")
    (package / ".hidden.py").write_text("nothing\n")
    assert summed(tmp_path, "world") == first
    seen = {first["world"]}
    changes = {
        "rules.py": b"HEIGHT = 0.05\n",
        "assets/arena.xml": b"<mujoco />",
        "assets/cube.stl": b"123456",
        "more.py": b"",
    }
    for name, content in changes.items():
        (package / name).write_bytes(content)
        seen.add(summed(tmp_path, "world")["world"])
    assert len(seen) == 1 + len(changes)


def test_modules_that_were_imported_from_elsewhere_count(tmp_path: Path) -> None:
    package = tmp_path / "world"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "rules.py").write_text("HEIGHT = 0.04\n")
    (tmp_path / "other_rules.py").write_text("HEIGHT = 0.05\n")
    swapped = "import sys, other_rules\nsys.modules['world.rules'] = other_rules"
    assert imported(tmp_path, "world", swapped) != imported(tmp_path, "world")


def test_a_modules_sum_is_not_of_what_is_installed_below_its_folder(tmp_path: Path) -> None:
    """As where a module lies in the folder of a repository: with a virtual environment in it, and the harness."""
    installed, harness = tmp_path / ".venv/lib/site-packages", tmp_path / "tools/actrm_harness"
    for folder in (installed, harness):
        folder.mkdir(parents=True)
    for name in ("__init__.py", "source.py"):
        (harness / name).write_text((HARNESS / "actrm_harness" / name).read_text())
    (installed / "library.py").write_text("")
    (tmp_path / "rules.py").write_text("")
    (tmp_path / "mine.py").write_text("import library, rules\n")

    def digest() -> str:
        command = [sys.executable, "-c", "import mine; from actrm_harness import source; print(source.digest('mine'))"]
        paths = {"PYTHONPATH": f"{tmp_path}:{installed}:{harness.parent}"}
        return subprocess.run(command, env=paths, capture_output=True, text=True, check=True).stdout

    first = digest()
    for name in (installed / "library.py", harness / "__init__.py"):
        name.write_text("# another\n")
        assert digest() == first, name
    (tmp_path / "rules.py").write_text("# another\n")
    assert digest() != first
