"""Trainings by the references themselves, judged by our harness: `tools/references.sh` runs this.

    python references.py --data FOLDER [--only WORD] [--train-only]

For every cell (policy, task, seed) the demonstrations of the cell in `studies/policies.toml` are learned from by
other people's code: ACT by LeRobot's `lerobot_train` on a data set that `actrm-data` converted, BC-RNN by robomimic's
`train` on the HDF5 file. Sizes, batches, steps and learning rates are read from the experiments of `configs/` that
our own cells were trained with. Each checkpoint becomes an entry of a zoo of its own by `actrm-zoo import` and is
evaluated on the test block of the task's protocol. Each result is a small file in `docs/results/references`. Cells
that have a result are skipped.
"""

import argparse
import hashlib
import json
import os
import platform
import resource
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
BIN = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release"
WORK = ROOT / "out" / "references"
RESULTS = ROOT / "docs/results/references"
ZOO = WORK / "zoo"
TASKS = {"lift": "Lift", "pickplacecan": "PickPlaceCan"}
# one thread, and no question to any hub
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "RAYON_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}


@dataclass(frozen=True)
class Arm:
    """Who trains which policy."""

    label: str
    package: str
    # what our experiments' names begin with, and our study's arm
    experiment: str
    ours: str
    # robomimic's normalisation, fixed
    normalise: bool = False


ARMS = {
    "lerobot-act": Arm("LeRobot's ACT", "lerobot", "act", "act"),
    "robomimic-bc-rnn": Arm("robomimic's BC-RNN", "robomimic", "bc_rnn", "bc-rnn"),
    "robomimic-bc-rnn-normalised": Arm(
        "robomimic's BC-RNN, normalisation fixed", "robomimic", "bc_rnn", "bc-rnn", normalise=True
    ),
}


@dataclass(frozen=True)
class Cell:
    """One training of one policy on one task."""

    arm: str
    task: str
    seed: int

    @property
    def name(self) -> str:
        """What its entry is called."""
        return f"{self.arm}-on-{self.task}-seed{self.seed}"

    @property
    def folder(self) -> Path:
        """Where its training is."""
        return WORK / "train" / self.name


CELLS = [Cell(arm, task, seed) for seed in (1,) for task in TASKS for arm in ARMS]


def experiment(name: str) -> dict[str, Any]:
    """An experiment as the program resolves it."""
    return tomllib.loads(run([BIN / "actrm-zoo", "train", name, "--print-config"]))


def write(path: Path, value: Any) -> None:
    """JSON that is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    with part.open("w") as out:
        # a line an episode: small files that a version control system can compare
        out.write(json.dumps(value).replace('{"seed": ', '\n{"seed": ') + "\n")
        out.flush()
        os.fsync(out.fileno())
    part.replace(path)


def run(command: Sequence[str | Path], log: Path | None = None, **more: str) -> str:
    """Run a program to its end; its error is ours."""
    words = [str(word) for word in command]
    out = log.open("a") if log else subprocess.PIPE
    # every program is our own or stands in the lock file
    done = subprocess.run(
        words, cwd=ROOT, env=os.environ | ENVIRONMENT | more, stdout=out, stderr=log and out, text=True, check=False
    )
    if log:
        out.close()
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(words)}: exit code {done.returncode}{f'; {log}' if log else ''}")
    return done.stdout or ""


def options(prefix: str, values: dict[str, Any]) -> list[str]:
    """LeRobot's way of writing options."""
    text = {True: "true", False: "false"}
    return [
        f"--{prefix}{name}={text[v] if isinstance(v, bool) else json.dumps(v) if isinstance(v, dict) else v}"
        for name, v in values.items()
    ]


def converted(task: str, settings: dict[str, Any], demonstrations: Path) -> Path:
    """The data set of the demonstrations, made where there is none."""
    whole = WORK / "data" / task
    keys = [f"--{name}-keys={','.join(settings['data'][f'{name}_keys'])}" for name in ("state", "env")]
    whole.parent.mkdir(parents=True, exist_ok=True)
    if not whole.exists():
        run([BIN / "actrm-data", "convert", demonstrations, whole, *keys])
    return whole


def train_lerobot(cell: Cell, settings: dict[str, Any], demonstrations: Path, folder: Path) -> tuple[list[str], Path]:
    """LeRobot's command, and the checkpoint that it leaves; the data set is made where there is none."""
    whole, data = converted(cell.task, settings, demonstrations), WORK / "data" / f"{cell.task}_train"
    if not data.exists():
        run([BIN / "actrm-data", "edit", "keep", whole, data, "--mask", settings["data"]["train_mask"]])
    policy, train = settings["policy"], settings["train"]
    sizes = {k: v for k, v in policy.items() if k not in ("type", "action_horizon")}
    modes = {"STATE": "state", "ENV": "environment_state", "ACTION": "action"}
    script, out = str(Path(__file__).with_name("train_lerobot.py")), folder / "out"
    checkpoint = out / "checkpoints" / f"{train['steps']:06}" / "pretrained_model"
    begun = out / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    if begun.exists():  # LeRobot goes on where it was, with what it began with
        return [sys.executable, script, f"--config_path={begun}", "--resume=true"], checkpoint
    shutil.rmtree(out, ignore_errors=True)
    command = [sys.executable, script, f"--dataset.repo_id=actrm/{cell.task}", f"--dataset.root={data}"]
    command += [f"--output_dir={out}", "--wandb.enable=false", "--num_workers=0"]
    command += options("policy.", {"type": "act", "device": "cpu", "push_to_hub": False} | sizes)
    command += options("policy.", {"chunk_size": policy["action_horizon"]} | settings["rollout"])
    normalisation = {kind: settings["normalisation"][name].upper() for kind, name in modes.items()}
    command += options("policy.", {"normalization_mapping": normalisation})
    optimiser = {"lr": train["lr"], "weight_decay": train["weight_decay"], "grad_clip_norm": train["grad_clip_norm"]}
    command += ["--use_policy_training_preset=false", *options("optimizer.", {"type": "adamw"} | optimiser)]
    schedule = {"type": "cosine_annealing_with_warmup", "num_warmup_steps": train["warmup_steps"]}
    command += options("scheduler.", schedule)
    command += options("", {"steps": train["steps"], "batch_size": train["batch_size"], "seed": cell.seed})
    command += ["--save_freq=500", "--env_eval_freq=0", "--log_freq=100"]
    return command, checkpoint


def train_robomimic(cell: Cell, settings: dict[str, Any], demonstrations: Path, folder: Path) -> tuple[list[str], Path]:
    """The command that runs robomimic's training, and the checkpoint that it leaves."""
    policy, train, data = settings["policy"], settings["train"], settings["data"]
    checkpoint, file = folder / "model.pth", folder / "settings.json"
    write(
        file,
        {
            "data": str(demonstrations),
            "checkpoint": str(checkpoint),
            "filter_key": data["train_mask"],
            "keys": data["state_keys"] + data["env_keys"],
            "horizon": policy["action_horizon"],
            "hidden_dim": policy["hidden_dim"],
            "n_layers": policy["n_layers"],
            "n_modes": policy["n_modes"],
            "min_std": policy["min_std"],
            "steps": train["steps"],
            "batch_size": train["batch_size"],
            "lr": train["lr"],
            "linear_decay": train["schedule"] == "cosine",
            "weight_decay": train["weight_decay"],
            "seed": cell.seed,
            "normalise": ARMS[cell.arm].normalise,
        },
    )
    return [sys.executable, str(Path(__file__).with_name("train_robomimic.py")), str(file)], checkpoint


def timed(work: Callable[[], object], file: Path) -> dict[str, float]:
    """Seconds and processor seconds of the work, with those of earlier tries that were broken off."""
    spent: dict[str, float] = json.loads(file.read_text()) if file.exists() else {}
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    try:
        work()
    finally:
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        processor = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
        for name, seconds in (("seconds", time.monotonic() - start), ("processor_seconds", processor)):
            spent[name] = spent.get(name, 0.0) + seconds
        write(file, spent)
    return spent


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def train(cell: Cell, demonstrations: Path) -> tuple[dict[str, Any], Path]:
    """What the training says of itself, and its checkpoint; it is run where that has not been done."""
    arm = ARMS[cell.arm]
    settings = experiment(f"{arm.experiment}_{cell.task}")
    folder, record = cell.folder, cell.folder / "training.json"
    make = train_lerobot if arm.package == "lerobot" else train_robomimic
    if record.exists():
        said = json.loads(record.read_text())
        return said, folder / said["checkpoint"]
    folder.mkdir(parents=True, exist_ok=True)
    command, checkpoint = make(cell, settings, demonstrations, folder)
    print(f"{cell.name}: training", flush=True)
    spent = timed(lambda: run(command, folder / "log.txt"), folder / "spent.json")
    weights = checkpoint / "model.safetensors" if checkpoint.is_dir() else checkpoint
    said = {
        "arm": cell.arm,
        "task": TASKS[cell.task],
        "seed": cell.seed,
        "experiment": f"{arm.experiment}_{cell.task}",
        "steps": settings["train"]["steps"],
        **{name: round(value, 1) for name, value in spent.items()},
        "demonstrations_sha256": digest(demonstrations),
        "checkpoint_sha256": digest(weights),
        "versions": {name: version(name) for name in ("torch", arm.package)} | {"python": platform.python_version()},
        "checkpoint": str(checkpoint.relative_to(folder)),
    }
    write(record, said)
    return said, checkpoint


def evaluate(cell: Cell, said: dict[str, Any], checkpoint: Path, demonstrations: Path) -> None:
    """Import the checkpoint, evaluate it, and write what came of it."""
    import pyarrow.parquet as parquet

    out = RESULTS / f"{cell.name}.json"
    settings = experiment(said["experiment"])
    info = json.loads((converted(cell.task, settings, demonstrations) / "actrm" / "info.json").read_text())
    if info["source_sha256"] != said["demonstrations_sha256"]:
        raise SystemExit(f"{WORK / 'data' / cell.task}: not of the demonstrations that {cell.name} learned from")
    about = {"format": 1, "training": said, "data_fingerprint": info["fingerprint"]}
    if out.exists() and about.items() <= json.loads(out.read_text()).items():
        return
    if not (ZOO / cell.name).exists():
        task = ["--task", said["task"], "--zoo", ZOO]
        run([BIN / "actrm-zoo", "import", ARMS[cell.arm].package, checkpoint, "--name", cell.name, *task])
    print(f"{cell.name}: evaluating", flush=True)
    protocol = ["--protocol", f"{cell.task}-v1", "--block", "test", "--workers", "1", "--zoo", ZOO, "--json"]
    if ARMS[cell.arm].package == "lerobot":
        protocol.append("--force")  # its checkpoints do not say which simulator the demonstrations are of
    (row,) = json.loads(run([BIN / "actrm-zoo", "eval", cell.name, *protocol]))
    folder = ROOT / row["folder"]
    record = json.loads((folder / "evaluation.json").read_text())
    episodes = parquet.read_table(folder / "outcomes.parquet", columns=["seed", "success", "steps", "progress"])
    parts = ("entry", "protocol", "execution", "seeds", "versions", "kernels")
    write(
        out,
        about
        | {"parameters": row["parameters"]}
        | {part: record[part] for part in parts}
        | {"episodes": sorted(episodes.to_pylist(), key=lambda episode: episode["seed"])},
    )
    print(f"{cell.name}: {row['successes']} of {row['episodes']}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    # asked to end, it says how long it took before it does
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("stopped"))
    parser.add_argument("--data", type=Path, required=True, help="folder of TASK-200-seed1.hdf5")
    parser.add_argument("--only", action="append", help="only cells whose name holds this; may be repeated")
    parser.add_argument("--train-only", action="store_true", help="neither import nor evaluate")
    args = parser.parse_args()
    for cell in CELLS:
        if args.only and not any(word in cell.name for word in args.only):
            continue
        demonstrations = (args.data / f"{cell.task}-200-seed1.hdf5").resolve()
        said, checkpoint = train(cell, demonstrations)
        if not args.train_only:
            evaluate(cell, said, checkpoint, demonstrations)


if __name__ == "__main__":
    main()
