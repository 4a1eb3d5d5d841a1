"""The documentation site: every page of the navigation, and the files that pages link to, as out/site.

.venv-docs/bin/python tools/site/build.py

The pages lie where the repository has them (README.md, docs/, zoo/README.md, ...). They are copied to out/site-pages
under the same paths, so that links between them work in the repository and on the site.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from mkdocs.config import load_config

ROOT = Path(__file__).resolve().parents[2]
CONFIG = Path(__file__).with_name("mkdocs.yml")
LINK = re.compile(r"\]\(([^)#\s]+)")


def pages(nav: list | dict | str) -> list[str]:
    """The files of a navigation, in order."""
    if isinstance(nav, str):
        return [nav]
    parts = nav.values() if isinstance(nav, dict) else nav
    return [page for part in parts for page in pages(part)]


def main() -> None:
    """Copy, then build."""
    staged = ROOT / "out/site-pages"
    shutil.rmtree(staged, ignore_errors=True)
    staged.mkdir(parents=True)
    config = load_config(str(CONFIG))
    left = pages(config.nav or [])
    lost = {str(file.relative_to(ROOT)) for file in ROOT.glob("docs/**/*.md")} - set(left)
    if lost:
        sys.exit(f"tools/site/mkdocs.yml: its nav misses {', '.join(sorted(lost))}")
    while left:
        name = left.pop()
        source, target = ROOT / name, staged / name
        if target.exists() or not source.is_file():
            continue  # a link to what is not there is MkDocs' to report
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
        if source.suffix == ".md":
            links = [link for link in LINK.findall(source.read_text()) if ":" not in link]
            linked = [(source.parent / link).resolve() for link in links]
            left += [str(file.relative_to(ROOT)) for file in linked if file.suffix != ".md"]
    command = [sys.executable, "-m", "mkdocs", "build", "--config-file", str(CONFIG)]
    if subprocess.run(command, check=False, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}).returncode:
        sys.exit(1)
    sys.stdout.write("out/site/index.html; searching needs a server: python3 -m http.server --directory out/site\n")


if __name__ == "__main__":
    main()
