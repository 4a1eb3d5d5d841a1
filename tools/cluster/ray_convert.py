"""A conversion over a Ray cluster: one shard a task, then a merge.

    python tools/cluster/ray_convert.py s3://lab/aloha s3://lab/set --shards 8 -- --video

What follows `--` are arguments of `actrm-data convert`. SOURCE and OUT are plain paths that all nodes see, or addresses
that fsspec knows (s3://, gs://); then a node needs disk for a shard only, and the one that merges for the data set. A
shard whose node dies is run again by Ray. Shards are kept in OUT.shards, and the same command goes on where it was.
Needs the package `ray` (tried with 2.60.0), and for addresses `fsspec`, `s3fs` or `gcsfs`, and `h5py`, on this machine
and the nodes.
"""

import argparse
import os
import sys

import convert_stages
import ray


def main() -> int:
    """Plan, convert the shards, merge them; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="what is converted")
    parser.add_argument("out", help="the data set")
    parser.add_argument("--shards", type=int, required=True, help="number of parts")
    parser.add_argument("--cpus", type=int, default=1, help="cores a shard (default: %(default)s)")
    parser.add_argument("--scratch", help="folder on the nodes for what is staged (default: the system's)")
    parser.add_argument("--address", help="a running cluster; without it one is started on this machine")
    parser.add_argument("--program", default=os.environ.get("ACTRM_DATA", "actrm-data"), help="actrm-data on the nodes")
    parser.usage = "%(prog)s [OPTIONS] SOURCE OUT --shards N [-- ARGUMENTS OF actrm-data convert]"
    words = sys.argv[1:]
    cut = words.index("--") if "--" in words else len(words)
    args = parser.parse_args(words[:cut])
    if args.shards < 1:
        parser.error("--shards must be at least 1")
    known = ("ACTRM_", "AWS_", "GOOGLE_", "FSSPEC_")
    environment = {name: value for name, value in os.environ.items() if name.startswith(known)}
    environment["ACTRM_DATA"] = args.program
    ray.init(address=args.address, include_dashboard=False, log_to_driver=False)
    # the nodes need not have this folder: they get the functions themselves
    ray.cloudpickle.register_pickle_by_value(convert_stages)
    stages = {stage.__name__: stage for stage in (convert_stages.plan, convert_stages.convert, convert_stages.merge)}
    arguments = ["--jobs", str(args.cpus), *words[cut + 1 :]]
    folder = os.getcwd()

    def stage(name: str, *given: object) -> tuple[bool, str]:
        os.environ.update(environment)
        os.chdir(folder)
        try:
            return True, stages[name](*given)
        except SystemExit as error:
            return False, str(error)

    # a node that dies is Ray's to replace; a command that fails is ours to report
    remote = ray.remote(num_cpus=args.cpus, max_retries=3)(stage)

    def one(name: str, *given: object) -> bool:
        good, text = ray.get(remote.remote(name, *given))
        print(f"{name}: {text}", flush=True)
        return good

    if not one("plan", args.source, args.out):
        return 1
    waiting = {}
    for index in range(1, args.shards + 1):
        shard = f"{index}/{args.shards}"
        waiting[remote.remote("convert", args.source, args.out, shard, arguments, args.scratch)] = shard
    failed = 0
    while waiting:
        (ready,), _ = ray.wait(list(waiting), num_returns=1)
        shard = waiting.pop(ready)
        good, text = ray.get(ready)
        failed += not good
        print(f"shard {shard}: {'' if good else 'failed: '}{text}", flush=True)
    if failed:
        print(f"{failed} of {args.shards} shards failed; the same command tries these again", file=sys.stderr)
        return 1
    return 0 if one("merge", args.out, args.shards, args.scratch) else 1


if __name__ == "__main__":
    sys.exit(main())
