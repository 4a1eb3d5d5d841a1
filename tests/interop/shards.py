"""Conversions in shards by Ray and Slurm, from and to a server of S3's protocol, with the bytes of one run."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

ROOT = Path(__file__).resolve().parents[2]


@contextmanager
def s3_server() -> Iterator[None]:
    """A server of S3's protocol that the environment names."""
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer("127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    given = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "nobody",
        "AWS_SECRET_ACCESS_KEY": "nothing",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    before = os.environ.copy()
    os.environ.update(given)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
        server.stop()


def write_aloha(folder: Path, episodes: int) -> None:
    """A folder of episodes with a camera, contiguous and packed, and one file that is larger than the others."""
    rng = np.random.default_rng(3)
    folder.mkdir()
    for episode in range(episodes):
        steps = 40 + 7 * episode
        with h5py.File(folder / f"episode_{episode}.hdf5", "w") as file:
            for name in ("action", "observations/qpos"):
                file[name] = rng.normal(size=(steps, 14)).astype(np.float32)
            packed = {"chunks": (8, 96, 128, 3), "compression": "gzip"} if episode % 2 else {}
            pixels = rng.integers(0, 256, (steps, 96, 128, 3), dtype=np.uint8)
            file.create_dataset("observations/images/top", data=pixels, **packed)


def content(folder: Path) -> dict[str, bytes]:
    """Every file below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def convert(program: Path, *args: str | Path, fails: bool = False) -> str:
    """Run the driver; what it says."""
    driver = [sys.executable, ROOT / "tools" / "cluster" / "ray_convert.py", "--program", program, *args]
    done = subprocess.run([*map(str, driver)], capture_output=True, text=True, check=False)
    said = done.stdout + done.stderr
    if (done.returncode != 0) != fails:
        raise SystemExit(f"{' '.join(map(str, driver))}: exit code {done.returncode}\n{said[-4000:]}")
    return said


# runs at once what would be queued, an array's tasks one after the other
SBATCH = """#!/usr/bin/env bash
set -euo pipefail
export SLURM_CPUS_PER_TASK=2
tasks=1
for option in "$@"; do
    case $option in
    --array=1-*) tasks=${option#--array=1-} ;;
    --wrap=*) wrap=${option#--wrap=} ;;
    esac
done
for ((task = 1; task <= tasks; task++)); do SLURM_ARRAY_TASK_ID=$task bash -c "$wrap" >&2; done
echo 1
"""


def on_slurm(program: Path, shards: int, source: str, out: str | Path, folder: Path) -> None:
    """Run the driver with a stand-in for Slurm."""
    sbatch = folder / "bin" / "sbatch"
    sbatch.parent.mkdir()
    sbatch.write_text(SBATCH)
    sbatch.chmod(0o755)
    path = f"{sbatch.parent}:{os.environ['PATH']}"
    given = os.environ | {"PATH": path, "ACTRM_DATA": str(program), "ACTRM_CLUSTER_PYTHON": sys.executable}
    driver = [ROOT / "tools" / "cluster" / "slurm_convert.sh", str(shards), source, out]
    done = subprocess.run([*map(str, driver)], capture_output=True, text=True, check=False, env=given)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, driver))}: exit code {done.returncode}\n{done.stderr[-4000:]}")


def compare_shards(program: Path, lift: Path, folder: Path) -> str:
    """Shards of a file and of a folder in a bucket, one of them lost and converted again."""
    import fsspec

    folder.mkdir(exist_ok=True)
    source, scratch = folder / "aloha", folder / "scratch"
    scratch.mkdir()
    write_aloha(source, 6)
    for given, name in ((source, "set"), (lift, "lift")):
        subprocess.run([program, "convert", given, folder / name], check=True, capture_output=True)
    with s3_server():
        fs = fsspec.filesystem("s3")
        fs.mkdir("lab")
        fs.put(str(source), "lab/aloha", recursive=True)
        fs.put_file(str(lift), "lab/lift.hdf5")
        staged = ("--scratch", scratch, "--cpus", "2")
        said = convert(program, "s3://lab/aloha", "s3://lab/set", "--shards", "3", *staged)
        assert "shard 2/3: s3://lab/set.shards/2-of-3: shard 2/3" in said, said
        assert "exists already" in convert(
            program, "s3://lab/aloha", "s3://lab/set", "--shards", "3", *staged, fails=True
        )
        # shards of other arguments are not taken for those that are asked for
        said = convert(program, "s3://lab/aloha", "s3://lab/set", "--shards", "3", *staged, "--", "--video", fails=True)
        assert "with other arguments" in said, said
        first = content_of(fs, "lab/set", folder / "fetched")
        assert first == content(folder / "set")
        # headers are no more than a part of the files
        assert fs.size("lab/set.shards/headers.gz") < sum(path.stat().st_size for path in source.iterdir()) / 3
        fs.rm("lab/set", recursive=True)
        fs.rm("lab/set.shards/2-of-3", recursive=True)
        said = convert(program, "s3://lab/aloha", "s3://lab/set", "--shards", "3", *staged)
        assert "1-of-3: there already" in said and "2-of-3: shard 2/3" in said, said
        assert content_of(fs, "lab/set", folder / "again") == first
        # one file, to a plain path
        on_slurm(program, 2, "s3://lab/lift.hdf5", folder / "lift_merged", folder)
        assert content(folder / "lift_merged") == content(folder / "lift")
        assert not list(scratch.iterdir()), list(scratch.iterdir())
    return f"{len(first)} files from s3:// to s3://, one shard removed and converted again, one file to a plain path"


def content_of(fs: object, path: str, local: Path) -> dict[str, bytes]:
    """Every file below an address."""
    fs.get(path, str(local), recursive=True)  # type: ignore[attr-defined]
    return content(local)


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as temporary:
        print(compare_shards(Path(sys.argv[1]).resolve(), ROOT / "data" / "lift.hdf5", Path(temporary)))
