"""A study of robot policies over a Ray cluster: the demonstrations, then one cell a task, then the page.

    python tools/cluster/ray_study.py studies/policies.toml -- --work /shared/study

What follows `--` are arguments of `actrm-zoo study`. The folders that the study names, and that of --work, must lie on
a file system that all nodes see. What has a result is not run again; a cell whose node dies is run again by Ray and
goes on where it was. Needs the package `ray`, on this machine and the nodes (tried with 2.60.0).
"""

import argparse
import os
import subprocess
import sys

import ray


def main() -> int:
    """Collect, run the cells, write the page; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", help="the study file")
    parser.add_argument("--cpus", type=int, default=1, help="cores a cell (default: %(default)s)")
    parser.add_argument("--address", help="a running cluster; without it one is started on this machine")
    parser.add_argument("--program", default=os.environ.get("ACTRM_ZOO", "actrm-zoo"), help="actrm-zoo on the nodes")
    parser.usage = "%(prog)s [OPTIONS] STUDY [-- ARGUMENTS OF actrm-zoo study]"
    words = sys.argv[1:]
    cut = words.index("--") if "--" in words else len(words)
    args = parser.parse_args(words[:cut])
    base = [args.program, "study", args.study, *words[cut + 1 :]]
    listed = subprocess.run([*base, "--list"], capture_output=True, text=True)
    if listed.returncode:
        sys.stderr.write(listed.stderr)
        return listed.returncode
    cells = [line.split(":")[0] for line in listed.stdout.splitlines()]
    if (code := subprocess.run([*base, "--data-only"]).returncode) != 0:
        return code
    ray.init(address=args.address, include_dashboard=False, log_to_driver=False)

    folder = os.getcwd()
    environment = {name: value for name, value in os.environ.items() if name.startswith("ACTRM_")}
    environment["RAYON_NUM_THREADS"] = str(args.cpus)

    def run(cell: str) -> tuple[int, str]:
        command = [*base, "--cell", cell]
        done = subprocess.run(command, cwd=folder, env=os.environ | environment, capture_output=True, text=True)
        return done.returncode, (done.stdout + done.stderr).strip()

    # a node that dies is Ray's to replace; a command that fails is ours to report
    remote = ray.remote(num_cpus=args.cpus, max_retries=3)(run)
    waiting = {remote.remote(cell): cell for cell in cells}
    failed = 0
    while waiting:
        (ready,), _ = ray.wait(list(waiting), num_returns=1)
        cell = waiting.pop(ready)
        code, text = ray.get(ready)
        failed += code != 0
        print(f"{cell}: {'ok' if code == 0 else f'exit code {code}'}\n{text}", flush=True)
    if failed:
        print(f"{failed} of {len(cells)} cells failed; the same command tries these again", file=sys.stderr)
    return subprocess.run([*base, "--page-only"]).returncode or int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
