"""Group-sequential comparisons of six tied and six untied refinement steps on PickChain: docs/results/study_plan.md.

    .venv/bin/python benches/tied_untied.py --simulate [FOLDER]     error rates and power of stage 4 [of stage 5]
    .venv/bin/python benches/tied_untied.py docs/results/recursion  the decisions after the trainings that are there

A training counts by its share of solved test episodes; all are tested on the same 200. At each look of stage 4 Welch's
t-test compares the arms, at each of stage 5 the Mann-Whitney test compares new trainings on new demonstrations.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import stats

ARMS = ("k6", "k6-untied")
MARGIN = 0.05
DEMONSTRATIONS = "8b7e7b64"
"""Fingerprint of the demonstrations that the study collects today; trainings on others do not count (study_plan.md)."""


@dataclass(frozen=True, slots=True)
class Look:
    """Trainings of each arm, two-sided level for a difference, one-sided level for equivalence (0: not tested)."""

    tied: int
    untied: int
    difference: float
    equivalence: float


# The first look had been made when this plan was written, on other demonstrations; here it is repeated on these.
LOOKS = (Look(8, 5, 0.001, 0.0), Look(10, 10, 0.005, 0.01), Look(13, 13, 0.015, 0.02), Look(16, 16, 0.04, 0.04))


NEW_DEMONSTRATIONS = "ead6b3a1"
"""Fingerprint of those of stage 5."""
RANK_LOOKS = ((10, 0.02), (16, 0.04))
"""Stage 5: trainings of each arm, two-sided level."""


def welch(tied: np.ndarray, untied: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Difference of means, its standard error and degrees of freedom; trainings are the last axis."""
    parts = [side.var(axis=-1, ddof=1) / side.shape[-1] for side in (tied, untied)]
    variance = np.maximum(parts[0] + parts[1], 1e-12)
    spread = parts[0] ** 2 / (tied.shape[-1] - 1) + parts[1] ** 2 / (untied.shape[-1] - 1)
    freedom = variance**2 / np.maximum(spread, 1e-30)
    return tied.mean(axis=-1) - untied.mean(axis=-1), np.sqrt(variance), freedom


def decide(tied: np.ndarray, untied: np.ndarray, look: Look) -> tuple[np.ndarray, np.ndarray]:
    """Whether the arms differ, and whether they are equivalent within MARGIN."""
    difference, error, freedom = welch(tied[..., : look.tied], untied[..., : look.untied])
    differ = 2 * stats.t.sf(np.abs(difference) / error, freedom) <= look.difference
    equivalent = np.zeros_like(differ)
    if look.equivalence > 0:
        equivalent = stats.t.sf((MARGIN - np.abs(difference)) / error, freedom) <= look.equivalence
    return differ, equivalent & ~differ


def simulate(gap: float, spread: tuple[float, float], failing: float, studies: int = 20_000) -> np.ndarray:
    """Shares of studies that end in a difference, in equivalence, undecided, and the mean number of trainings.

    A training's success is normal around its arm's mean, cut at 0 and 1; with probability `failing` it learns little
    and has 0.3. The means are such that the arms differ by `gap` in all.
    """
    rng = np.random.default_rng(57)
    last = LOOKS[-1]

    def draw(mean: float, deviation: float, trainings: int) -> np.ndarray:
        good = np.clip(rng.normal(mean, deviation, (studies, trainings)), 0, 1)
        return np.where(rng.random((studies, trainings)) < failing, 0.3, good)

    tied = draw(0.85 + gap / 2 / (1 - failing), spread[0], last.tied)
    untied = draw(0.85 - gap / 2 / (1 - failing), spread[1], last.untied)
    ended, outcome, used = np.zeros(studies, bool), np.full(studies, 2), np.full(studies, last.tied + last.untied)
    for look in LOOKS:
        for verdict, holds in enumerate(decide(tied, untied, look)):
            new = holds & ~ended
            outcome[new], used[new] = verdict, look.tied + look.untied
            ended |= new
    return np.array([*(np.mean(outcome == kind) for kind in range(3)), used.mean()])


def table() -> str:
    """The plan's error rates as a Markdown table."""
    rows = [
        "| true difference | deviation of trainings | that learn little "
        "| different | equivalent | undecided | trainings |",
        "|---|---|---|---|---|---|---|",
    ]
    for spread in ((0.046, 0.084), (0.084, 0.084)):
        for failing in (0.0, 0.1):
            for gap in (0.0, 0.05, 0.1):
                different, equivalent, undecided, trainings = simulate(gap, spread, failing)
                rows.append(
                    f"| {100 * gap:.0f} points | {100 * spread[0]:.1f}, {100 * spread[1]:.1f} | {100 * failing:.0f}% "
                    f"| {100 * different:.1f}% | {100 * equivalent:.1f}% | {100 * undecided:.1f}% | {trainings:.1f} |"
                )
    return "\n".join(rows)


def rank_table(folder: Path) -> str:
    """The error rates of stage 5, whose trainings are drawn from those of stage 4 (20,000 studies a row)."""
    rng, last = np.random.default_rng(57), RANK_LOOKS[-1][0]
    arms = [successes(folder, arm)[: LOOKS[-1].tied] for arm in ARMS]
    pool = np.concatenate(arms)
    rows = ["| trainings | different | trainings needed |", "|---|---|---|"]
    for name, alike in (("both arms from all 32", 1.0), ("half from all 32", 0.5), ("as in stage 4", 0.0)):
        from_pool = rng.random((2, 20_000, last)) < alike
        drawn = [
            np.where(common, rng.choice(pool, common.shape), rng.choice(arm, common.shape))
            for common, arm in zip(from_pool, arms, strict=True)
        ]
        differ, used = np.zeros(20_000, bool), np.full(20_000, 2 * last)
        for trainings, level in RANK_LOOKS:
            new = (rank_test(*(side[:, :trainings] for side in drawn)) <= level) & ~differ
            differ |= new
            used[new] = 2 * trainings
        rows.append(f"| {name} | {100 * differ.mean():.1f}% | {used.mean():.1f} |")
    return "\n".join(rows)


def rank_test(tied: np.ndarray, untied: np.ndarray) -> np.ndarray:
    """Two-sided p values of the Mann-Whitney test, corrected for ties; trainings are the last axis."""
    return stats.mannwhitneyu(tied, untied, axis=-1, method="asymptotic").pvalue


def successes(folder: Path, arm: str, data: str = "pickchain", fingerprint: str = DEMONSTRATIONS) -> np.ndarray:
    """Success of an arm's trainings on these demonstrations by seed, up to the first that is missing."""
    shares: list[float] = []
    for seed in range(1, 100):
        file = folder / f"{arm}-on-{data}-seed{seed}_chain.json"
        if not file.exists():
            break
        result = json.loads(file.read_text())
        if result["training"]["data_fingerprint"].startswith(fingerprint):
            episodes = result["episodes"]
            shares.append(sum(episode["success"] for episode in episodes) / len(episodes))
    return np.array(shares)


def report(folder: Path) -> str:
    """A line a look that can be made; a look after the decision is not made."""
    tied, untied = (successes(folder, arm) for arm in ARMS)
    lines = [f"tied: {len(tied)} trainings, untied: {len(untied)}"]
    for number, look in enumerate(LOOKS, 1):
        if len(tied) < look.tied or len(untied) < look.untied:
            lines.append(f"look {number} ({look.tied} and {look.untied} trainings): to be made")
            break
        difference, error, freedom = welch(tied[: look.tied], untied[: look.untied])
        p = 2 * stats.t.sf(abs(difference) / error, freedom)
        differ, equivalent = decide(tied, untied, look)
        verdict = "different" if differ else "equivalent" if equivalent else "undecided"
        lines.append(
            f"look {number} ({look.tied} and {look.untied} trainings): {100 * difference:+.1f} points, standard error "
            f"{100 * error:.1f}, p = {p:.4f} against {look.difference}: {verdict}"
        )
        if differ or equivalent:
            break
    new = [successes(folder, arm, "pickchain-new", NEW_DEMONSTRATIONS) for arm in ARMS]
    lines.append(f"stage 5: tied: {len(new[0])} trainings, untied: {len(new[1])}")
    for trainings, level in RANK_LOOKS:
        if min(map(len, new)) < trainings:
            lines.append(f"look at {trainings} and {trainings} trainings: to be made")
            break
        tied, untied = (side[:trainings] for side in new)
        p = rank_test(tied, untied)
        better = (np.sign(tied[:, None] - untied) + 1).mean() / 2
        lines.append(
            f"look at {trainings} and {trainings} trainings: medians {100 * np.median(tied):.1f}% and "
            f"{100 * np.median(untied):.1f}%, a tied training is better in {100 * better:.0f}% of pairs, p = {p:.4f} "
            f"against {level}: {'different' if p <= level else 'undecided'}"
        )
        if p <= level:
            break
    return "\n".join(lines)


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["--simulate"]:
            print(table())
        case ["--simulate", folder]:
            print(rank_table(Path(folder)))
        case [folder]:
            print(report(Path(folder)))
        case _:
            sys.exit("usage: tied_untied.py --simulate [FOLDER] | FOLDER")
