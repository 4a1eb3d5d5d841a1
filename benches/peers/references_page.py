"""Writes docs/results/references.md: python references_page.py. Run from the root of the checkout.

It reads docs/results/references/*.json, which `references.py` makes, and our own results in docs/results/policies,
which `actrm-zoo study studies/policies.toml` makes; `--check` fails where the page is not what this would write.
"""

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

from references import ARMS, CELLS, RESULTS, ROOT, TASKS, Cell

PAGE = ROOT / "docs/results/references.md"
ZOO = ROOT / "docs/results/policies"
# 97.5% quantile of the standard normal distribution
Z = 1.959963984540054


def wilson(solved: int, n: int) -> tuple[float, float]:
    """The 95% score interval of a share (Wilson 1927), as crates/report has it."""
    p, z2 = solved / n, Z * Z
    centre = (p + z2 / (2 * n)) / (1 + z2 / n)
    half = Z / (1 + z2 / n) * math.sqrt(p * (1 - p) / n + z2 / (4 * n * n))
    return (0.0 if solved == 0 else centre - half), (1.0 if solved == n else centre + half)


def newcombe(first: tuple[int, int], second: tuple[int, int]) -> tuple[float, float, float]:
    """The difference of two shares and its 95% interval (Newcombe 1998, method 10: of Wilson's intervals)."""
    (p, (low, high)), (q, (other_low, other_high)) = [(s / n, wilson(s, n)) for s, n in (first, second)]
    below = math.sqrt((p - low) ** 2 + (other_high - q) ** 2)
    above = math.sqrt((high - p) ** 2 + (q - other_low) ** 2)
    return p - q, p - q - below, p - q + above


# what the fingerprints of two sets of demonstrations say of each other
OTHERS = ", of another collection by the same seeds"


def outcomes(result: dict[str, Any]) -> dict[int, bool]:
    """Success by seed."""
    return {episode["seed"]: episode["success"] for episode in result["episodes"]}


def counted(result: dict[str, Any]) -> tuple[int, int]:
    """Solved, of how many."""
    found = outcomes(result).values()
    return sum(found), len(found)


def share(solved: int, n: int) -> str:
    low, high = wilson(solved, n)
    return f"{solved} of {n} [{100 * low:.0f}-{100 * high:.0f}%]"


def row(cell: Cell) -> str:
    """One training of theirs beside ours of the same policy, task and seed."""
    arm, task = ARMS[cell.arm], TASKS[cell.task]
    own = json.loads((ZOO / f"{arm.ours}-on-{cell.task}-seed{cell.seed}_{cell.task}.json").read_text())
    mine = counted(own)
    path = RESULTS / f"{cell.name}.json"
    start = f"| {task} | {arm.label} | {cell.seed} |"
    if not path.exists():
        return f"{start} not run | {share(*mine)} | | | | {60 * own['training']['minutes']:.0f} |"
    result = json.loads(path.read_text())
    rules = ("task", "env_name", "control", "max_steps", "rules")
    if any(result["protocol"][key] != own["protocol"][key] for key in rules) or result["seeds"] != own["seeds"]:
        raise SystemExit(f"{path}: protocol: expected that of our own result, {own['protocol']} on {own['seeds']}")
    theirs, said = counted(result), result["training"]
    same = result["data_fingerprint"] == own["training"]["data_fingerprint"]
    difference, low, high = newcombe(theirs, mine)
    by_seed, others = outcomes(result), outcomes(own)
    only = [sum(a[seed] and not b[seed] for seed in a) for a, b in ((by_seed, others), (others, by_seed))]
    points = f"{100 * difference:+.1f} [{100 * low:+.1f} to {100 * high:+.1f}]"
    return (
        f"{start} {share(*theirs)} | {share(*mine)}{'' if same else OTHERS} | {points} "
        f"| {only[0]}, {only[1]} | {said['processor_seconds']:.0f} ({said['seconds']:.0f}) "
        f"| {60 * own['training']['minutes']:.0f} |"
    )


def page() -> str:
    """The whole page."""
    results = [json.loads(path.read_text()) for path in sorted(RESULTS.glob("*.json"))]
    versions: dict[str, str] = {}
    for result in results:
        versions |= result["training"]["versions"] | {k: v for k, v in result["versions"].items() if k != "python"}
    listed = ", ".join(f"{name} {versions[name]}" for name in sorted(versions))
    rows = "\n".join(row(cell) for cell in CELLS)
    table = "\n".join(["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|", rows])
    return HEAD.format(table=table, versions=listed) + FOUND


COLUMNS = (
    "task",
    "trained by",
    "seed",
    "theirs, solved",
    "ours, solved",
    "difference in points",
    "only theirs, only ours",
    "theirs, processor seconds (seconds)",
    "ours, seconds",
)

HEAD = """# LeRobot's and robomimic's own trainers

LeRobot's ACT and ours solve as many episodes. robomimic 0.3.0's BC-RNN, as released, solves none of Lift and two
thirds of PickPlaceCan, because its observations are not normalised. With that fixed it solves as many as ours.

LeRobot and robomimic train on the same 180 demonstrations with our sizes, batches, steps and learning rates
(`configs/`). `actrm-zoo import` makes entries of the results, which play the test block of the task's protocol, as
our own did ([policies and tasks](policies.md)). Each row is one training beside one of ours with the same seed.

{table}

95% intervals: Wilson's of a share, Newcombe's of the difference, theirs minus ours. "Only theirs" counts seeds that
theirs solved and ours did not. Seconds are of a machine of two cores that also did other work. They are no
comparison of speed ([speed](speed_policies.md)). Versions: {versions}.

## Differences in training

- **LeRobot** (`lerobot-train`, its data loader, AdamW, clipping and cosine with warm-up): no moving average of the
  weights, which ours has on PickPlaceCan. Frames of the data set are cached (`benches/peers/train_lerobot.py`),
  which changes time only.
- **robomimic** (`train`, data loader and Adam): the learning rate falls to 0 every hundred steps, without clipping
  and moving average. Actions are raw in -1 to 1; ours are scaled to their range.
- **Normalisation.** robomimic 0.3.0 has `hdf5_normalize_obs`. With sequences it fails an assertion (`shape mismatch
  in @normalize obs`), and its loop then normalises batches a second time. The rows "normalisation fixed" change
  these two places (`benches/peers/train_robomimic.py`), and nothing else.

"""

FOUND = """## Remarks

- On PickPlaceCan our ACT row comes from another collection of demonstrations with the same seeds.
- In robomimic's own log the loss of the last hundred steps on Lift is -18.3 without normalisation and -20.3 with it;
  on PickPlaceCan -18.6 and -20.2.
- 1,500 and 6,000 steps are few for robomimic, whose default is 200,000. More steps were not tried.

## The commands

    tools/references.sh                          # trains and evaluates what is missing, and writes this page
    tools/references.sh --data FOLDER --only act-on-lift
    actrm-zoo import robomimic MODEL.pth --name lift-theirs --task Lift
    actrm-zoo eval lift-theirs --protocol lift-v1 --block test

Commands of the trainings are in `benches/peers/references.py`; logs, checkpoints and times are in
`out/references/train`.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, and fail where the page is another")
    args = parser.parse_args()
    text = page()
    if args.check:
        if PAGE.read_text() != text:
            sys.exit(f"{PAGE}: not what the results say; write it anew with {Path(__file__).name}")
        return
    part = PAGE.with_name(f".{PAGE.name}.part")
    part.write_text(text)
    part.replace(PAGE)


if __name__ == "__main__":
    main()
