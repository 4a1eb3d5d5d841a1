"""The interpreter that environments are made of."""

import os
import subprocess
import sys
import venv
from pathlib import Path

FIND = Path(__file__).resolve().parents[2] / "find-python"
VERSION = f"{sys.version_info.major}.{sys.version_info.minor}"


def found(path: str) -> str:
    """What is printed with these folders in front of the path."""
    environment = os.environ | {"PATH": f"{path}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run([FIND, VERSION, VERSION], env=environment, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_an_environment_is_not_made_of_itself(tmp_path: Path) -> None:
    """Making `.venv` anew removes it first: what is found must still be there then."""
    made = tmp_path / "made"
    venv.create(made, with_pip=False)
    python = Path(found(str(made / "bin")))
    assert python.is_file()
    assert made not in python.parents


def test_what_is_no_python_is_passed_over(tmp_path: Path) -> None:
    (tmp_path / "python3").write_text("#!/nowhere/python3\n")
    (tmp_path / "python3").chmod(0o755)
    python = Path(found(str(tmp_path)))
    assert python.is_file()
    assert tmp_path not in python.parents
