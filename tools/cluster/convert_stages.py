"""The stages of a conversion in shards, each a command that a cluster runs on some node: plan, shard, merge.

    python tools/cluster/convert_stages.py plan  s3://lab/aloha s3://lab/set
    python tools/cluster/convert_stages.py shard s3://lab/aloha s3://lab/set 3/8 -- --video
    python tools/cluster/convert_stages.py merge s3://lab/set 8

SOURCE and OUT are plain paths or addresses that fsspec knows (s3://, gs://). What follows `--` are arguments of
`actrm-data convert`. A plain path is used where it lies. A file elsewhere is copied to the node, of a folder of HDF5
files those of the shard alone: `plan` keeps the headers of all of them in OUT.shards, from which every shard plans the
same conversion. A shard and a merge leave nothing on the node. A shard that is in OUT.shards is not converted again.
Addresses need the packages fsspec, s3fs or gcsfs, and h5py. ray_convert.py and slurm_convert.sh run these stages.
"""

from __future__ import annotations

import argparse
import gzip
import io
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, BinaryIO

# what actrm-data takes for HDF5 files in a folder
EXTENSIONS = {".hdf5", ".h5", ".hdf", ".he5"}
HEADERS = "headers.gz"
# datasets of a file that are smaller are kept whole, of larger ones the first rows
SMALL = 64 << 10
FIRST_ROWS = 16 << 20


def place(address: str) -> tuple[Any, str]:
    """The file system of an address and the path in it."""
    import fsspec

    return fsspec.url_to_fs(address)


def is_plain(address: str) -> bool:
    """Whether every node sees it as a path."""
    return "://" not in address


def shards_of(out: str) -> str:
    """Where the shards of a data set are kept."""
    return f"{out.rstrip('/')}.shards"


def files_of(fs: Any, folder: str) -> dict[str, int]:
    """Names and sizes of the files below a folder."""
    prefix = folder.rstrip("/") + "/"
    found = fs.find(folder, detail=True)
    return {below(name.removeprefix(prefix)): entry["size"] for name, entry in sorted(found.items())}


def below(name: str) -> str:
    """The name of a file below a folder; one that leads out of it ends the program."""
    if name.startswith("/") or ".." in name.split("/"):
        raise SystemExit(f"{name!r}: expected the name of a file below the source's folder")
    return name


def origin(source: str, arguments: list[str]) -> bytes:
    """What a conversion is made of: the arguments, and the names and sizes of the source's files."""
    if is_plain(source):
        root = Path(source)
        files = {
            str(file.relative_to(root)): file.stat().st_size
            for file in sorted([root, *root.rglob("*")])
            if file.is_file()
        }
    else:
        fs, path = place(source)
        files = files_of(fs, path) if fs.isdir(path) else {"": fs.size(path)}
    return json.dumps({"source": source, "arguments": arguments, "files": files}, indent=1).encode()


def check_origin(fs: Any, path: str, now: bytes, what: str) -> None:
    """End the program where something was made of other files or with other arguments."""
    if not fs.exists(path) or fs.cat_file(path) != now:
        raise SystemExit(f"{what}: made of other files or with other arguments; remove it or choose another OUT")


def unneeded(file: Any) -> list[tuple[int, int]]:
    """Parts (offset, end) of an opened HDF5 file that hold no more than values of its demos."""
    import h5py

    parts: list[tuple[int, int]] = []

    def look(_: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or item.id.get_storage_size() <= SMALL:
            return
        if "data" in file and not item.name.startswith("/data/"):
            return
        if item.chunks is None:
            offset = item.id.get_offset()
            if offset is not None:
                row = item.id.get_storage_size() // max(1, item.shape[0] if item.shape else 1)
                parts.append((offset + max(SMALL, row), offset + item.id.get_storage_size()))
            return
        for index in range(item.id.get_num_chunks()):
            chunk = item.id.get_chunk_info(index)
            if chunk.chunk_offset[0] > 0 or chunk.size > FIRST_ROWS:
                parts.append((chunk.byte_offset, chunk.byte_offset + chunk.size))

    if file.userblock_size == 0:
        file.visititems(look)
    return sorted(part for part in parts if part[1] > part[0])


def write_header(to: BinaryIO, fs: Any, path: str, name: str, size: int) -> None:
    """Everything of an HDF5 file but its demos' values: a line that says where it lies, and the bytes."""
    import h5py

    with fs.open(path, "rb") as source:
        try:
            with h5py.File(source, "r") as file:
                gaps = unneeded(file)
        except OSError:
            # no HDF5 file, or cut off: actrm-data says what it is
            gaps = []
        kept, at = [], 0
        for start, end in [*gaps, (size, size)]:
            if start > at:
                kept.append((at, start - at))
            at = max(at, end)
        to.write(json.dumps({"name": name, "size": size, "kept": kept}).encode() + b"\n")
        for start, length in kept:
            source.seek(start)
            to.write(source.read(length))


def plan(source: str, out: str) -> str:
    """Keep the headers of a folder of HDF5 files that is elsewhere; what was done, in words."""
    if is_plain(source):
        return f"{source}: read where it lies"
    fs, folder = place(source)
    if not fs.isdir(folder):
        return f"{source}: one file; read whole by every shard"
    files = files_of(fs, folder)
    if not any(Path(name).suffix.lower() in EXTENSIONS for name in files):
        return f"{source}: no folder of HDF5 files; read whole by every shard"
    target, path = place(f"{shards_of(out)}/{HEADERS}")
    made_of, record = origin(source, []), f"{path}.json"
    if target.exists(path):
        check_origin(target, record, made_of, f"{shards_of(out)}/{HEADERS}")
    else:
        target.makedirs(path.rpartition("/")[0], exist_ok=True)
        target.pipe_file(record, made_of)
        with tempfile.TemporaryFile() as packed:
            with gzip.GzipFile(fileobj=packed, mode="wb", compresslevel=1, mtime=0) as to:
                for name, size in files.items():
                    if Path(name).suffix.lower() in EXTENSIONS:
                        write_header(to, fs, f"{folder}/{name}", name, size)
                    else:
                        to.write(json.dumps({"name": name, "size": size, "kept": [(0, size)]}).encode() + b"\n")
                        with fs.open(f"{folder}/{name}", "rb") as whole:
                            while block := whole.read(1 << 20):
                                to.write(block)
            packed.seek(0)
            with target.open(path, "wb") as sink:
                while block := packed.read(1 << 20):
                    sink.write(block)
    return f"{source}: headers of {len(files)} files in {shards_of(out)}"


def unpack(headers: BinaryIO, folder: Path) -> None:
    """Make the files that `plan` kept the headers of: as long as they were, with holes."""
    with gzip.GzipFile(fileobj=headers) as packed, io.BufferedReader(packed) as stream:
        while line := stream.readline():
            entry = json.loads(line)
            path = folder / below(entry["name"])
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("wb") as file:
                file.truncate(entry["size"])
                for start, length in entry["kept"]:
                    file.seek(start)
                    file.write(stream.read(length))


def stage(source: str, out: str, shard: str, scratch: Path, arguments: list[str]) -> Path:
    """The source as this node sees it, with the files that the shard needs."""
    if is_plain(source):
        return Path(source)
    fs, path = place(source)
    local = scratch / path.rstrip("/").rpartition("/")[2]
    headers, name = place(f"{shards_of(out)}/{HEADERS}")
    if fs.isdir(path) and headers.exists(name):
        with headers.open(name, "rb") as packed:
            unpack(packed, local)
        listed = call(["convert", local, scratch / "none", "--shard", shard, "--list-files", "--json", *arguments])
        for file in json.loads(listed):
            fs.get_file(f"{path}/{Path(file).relative_to(local)}", file)
    else:
        fs.get(path, str(local), recursive=fs.isdir(path))
        beside = path.rpartition(".")[0] + ".json"
        if fs.isfile(path) and fs.exists(beside):
            fs.get_file(beside, str(local.with_suffix(".json")))
    return local


def call(arguments: list[Any]) -> str:
    """Run actrm-data, which ACTRM_DATA may name; its output. Its error ends this program."""
    command = [os.environ.get("ACTRM_DATA", "actrm-data"), *map(str, arguments)]
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except FileNotFoundError:
        raise SystemExit(f"{command[0]}: no such program; ACTRM_DATA names it where it is not on the PATH") from None
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: exit code {done.returncode}\n{done.stderr.strip()}")
    sys.stderr.write(done.stderr)
    return done.stdout


def put(folder: Path, address: str, last: str) -> None:
    """Copy a folder to an address, with the file that says that it is whole at the end."""
    fs, path = place(address)
    files = sorted(file for file in folder.rglob("*") if file.is_file() and str(file.relative_to(folder)) != last)
    for file in [*files, folder / last]:
        target = f"{path}/{file.relative_to(folder)}"
        fs.makedirs(target.rpartition("/")[0], exist_ok=True)
        fs.put_file(str(file), target)


def convert(source: str, out: str, shard: str, arguments: list[str], scratch: str | None = None) -> str:
    """Convert one shard into OUT.shards; what was done, in words."""
    kept = f"{shards_of(out)}/{shard.replace('/', '-of-')}"
    if not is_plain(out):
        fs, path = place(kept)
        made_of, record = origin(source, arguments), f"{path}.json"
        if fs.exists(f"{path}/shard.json"):
            check_origin(fs, record, made_of, kept)
            return f"{kept}: there already"
    with tempfile.TemporaryDirectory(dir=scratch, prefix="actrm-shard-") as folder:
        local = Path(folder)
        staged = stage(source, out, shard, local, arguments)
        made = Path(kept) if is_plain(out) else local / "shard"
        made.parent.mkdir(parents=True, exist_ok=True)
        said = call(["convert", staged, made, "--shard", shard, *arguments])
        if not is_plain(out):
            fs.makedirs(record.rpartition("/")[0], exist_ok=True)
            fs.pipe_file(record, made_of)
            put(made, kept, "shard.json")
        return said.strip().replace(str(made), kept)


def merge(out: str, count: int, scratch: str | None = None) -> str:
    """Put all shards together as OUT; what was done, in words."""
    names = [f"{index}-of-{count}" for index in range(1, count + 1)]
    if is_plain(out):
        return call(["merge", out, *(f"{shards_of(out)}/{name}" for name in names)]).strip()
    fs, path = place(out)
    if fs.exists(f"{path}/meta/info.json"):
        raise SystemExit(f"{out}: exists already; choose another address or remove it first")
    with tempfile.TemporaryDirectory(dir=scratch, prefix="actrm-merge-") as folder:
        local = Path(folder)
        shards, kept = place(shards_of(out))
        for name in names:
            if not shards.exists(f"{kept}/{name}/shard.json"):
                raise SystemExit(f"{shards_of(out)}/{name}: no such shard, or not complete; convert it first")
            shards.get(f"{kept}/{name}", str(local / name), recursive=True)
        made = local / path.rstrip("/").rpartition("/")[2]
        said = call(["merge", made, *(local / name for name in names)])
        put(made, out, "meta/info.json")
        return said.strip().replace(str(made), out)


def main() -> int:
    """Run one stage; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scratch", help="folder on the node for what is staged (default: the system's)")
    stages = parser.add_subparsers(dest="stage", required=True)
    for name in ("plan", "shard"):
        command = stages.add_parser(name)
        command.add_argument("source", help="what is converted")
        command.add_argument("out", help="the data set")
    command.add_argument("shard", metavar="I/N", help="which shard of how many")
    command = stages.add_parser("merge")
    command.add_argument("out", help="the data set")
    command.add_argument("shards", type=int, help="how many shards there are")
    words = sys.argv[1:]
    cut = words.index("--") if "--" in words else len(words)
    args = parser.parse_args(words[:cut])
    if args.stage == "plan":
        print(plan(args.source, args.out))
    elif args.stage == "shard":
        print(convert(args.source, args.out, args.shard, words[cut + 1 :], args.scratch))
    else:
        print(merge(args.out, args.shards, args.scratch))
    return 0


if __name__ == "__main__":
    sys.exit(main())
