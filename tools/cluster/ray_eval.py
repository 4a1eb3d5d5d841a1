"""An evaluation over a Ray cluster: one shard a task, then a merge.

    python tools/cluster/ray_eval.py --shards 8 -- lift-act@1 --episodes 400 --zoo /shared/zoo

What follows `--` are arguments of `actrm-zoo eval`. The zoo must lie on a file system that all nodes see. A shard whose
node dies is run again by Ray and goes on where it was. Needs the package `ray`, on this machine and the nodes (tried
with 2.60.0). Ray runs its workers at a lower priority than everything else on a node (nice 15); where other programs
share it, RAY_worker_niceness=0 in the environment of `ray start` changes that.
"""

import argparse
import os
import subprocess
import sys

import ray


def main() -> int:
    """Run the shards, then merge them; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shards", type=int, required=True, help="number of parts")
    parser.add_argument("--cpus", type=int, default=1, help="cores, and workers, a shard (default: %(default)s)")
    parser.add_argument("--address", help="a running cluster; without it one is started on this machine")
    parser.add_argument("--program", default=os.environ.get("ACTRM_ZOO", "actrm-zoo"), help="actrm-zoo on the nodes")
    parser.add_argument("eval", nargs="+", metavar="ARGUMENT", help="arguments of `actrm-zoo eval`, after `--`")
    args = parser.parse_args()
    if args.shards < 1:
        parser.error("--shards must be at least 1")
    ray.init(address=args.address, include_dashboard=False, log_to_driver=False)

    folder = os.getcwd()
    environment = {name: value for name, value in os.environ.items() if name.startswith("ACTRM_")}

    def shard(index: int) -> tuple[int, str]:
        command = [args.program, "eval", *args.eval, "--workers", str(args.cpus), "--shard", f"{index}/{args.shards}"]
        done = subprocess.run(command, cwd=folder, env=os.environ | environment, capture_output=True, text=True)
        return done.returncode, (done.stdout + done.stderr).strip()

    # a node that dies is Ray's to replace; a command that fails is ours to report
    remote = ray.remote(num_cpus=args.cpus, max_retries=3)(shard)
    waiting = {remote.remote(index): index for index in range(1, args.shards + 1)}
    failed = 0
    while waiting:
        (ready,), _ = ray.wait(list(waiting), num_returns=1)
        index = waiting.pop(ready)
        code, text = ray.get(ready)
        failed += code != 0
        print(f"shard {index}/{args.shards}: {'ok' if code == 0 else f'exit code {code}'}\n{text}", flush=True)
    if failed:
        print(f"{failed} of {args.shards} shards failed; the same command tries these again", file=sys.stderr)
        return 1
    return subprocess.run([args.program, "merge", *places(args.eval)]).returncode


def places(arguments: list[str]) -> list[str]:
    """Where the shards are: what of the arguments of `eval` are folders that `merge` takes too."""
    names = ("--zoo", "--results")
    given = []
    for at, part in enumerate(arguments):
        if part in names:
            given += arguments[at : at + 2]
        elif part.startswith(tuple(f"{name}=" for name in names)):
            given.append(part)
    return given


if __name__ == "__main__":
    sys.exit(main())
