"""README's example and the notebook do what they say."""

from __future__ import annotations

import json
import shutil
import sys
import textwrap
from pathlib import Path

import pytest
from conftest import ROOT


def test_readme_s_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / "README.md").read_text()
    start = text.index("    import actrm\n")
    lines = text[start:].splitlines()
    end = next(i for i, line in enumerate(lines) if line and not line.startswith("    "))
    example = textwrap.dedent("\n".join(lines[:end]))
    assert example.count("\n") < 20
    shutil.copytree(ROOT / "zoo", tmp_path / "zoo")
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(example, "README.md", "exec"), names)
    assert names["batch"]["action"].shape[1:] == (16, 7)  # type: ignore[index]
    assert names["action"].shape == (7,)  # type: ignore[attr-defined]
    assert names["episodes"]["success"].mean() > 0.9  # type: ignore[index]
    assert len(names["rows"]) >= 6  # type: ignore[arg-type]


def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    notebook = json.loads((ROOT / "examples/quickstart.ipynb").read_text())
    assert len(notebook["cells"]) <= 20
    monkeypatch.chdir(ROOT / "examples")
    monkeypatch.setenv("ACTRM_QUICKSTART", str(tmp_path))
    names: dict[str, object] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    said = capsys.readouterr().out
    assert "windows a second" in said and "of 20" in said and "stack-act" in said
    assert names["curve"][-1][1] > 0.9  # type: ignore[index]


def test_the_api_page_is_the_docstrings() -> None:
    import subprocess

    command = [sys.executable, str(ROOT / "tools/python_api.py")]
    page = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert page == (ROOT / "docs/reference/python.md").read_text()
