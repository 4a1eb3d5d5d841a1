"""All rows of a run of the benchmarks in one table, from what each wrote to target/bench.

    .venv/bin/python benches/summary.py data=0 act=0 control=1

A word a benchmark: its name and the exit code it ended with. Exit code 1 where a bar is missed or a benchmark failed.
"""

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FOLDER = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "bench"
WIDTHS = (76, 14, 14, 9, 32)


@dataclass(frozen=True, slots=True)
class Line:
    """A row of any benchmark, as the table shows it."""

    work: str
    ours: str
    peer: str
    ratio: str
    bar: str
    verdict: str


def number(value: float | None) -> str:
    """Four digits, or a dash for nothing."""
    return "-" if value is None else f"{value:.4g}"


def verdict(row: dict[str, Any], met: bool | None) -> str:
    """One word; what is only wished for is never missed."""
    if met is None:
        return "no bar"
    return "ok" if met else "over" if row.get("aim") else "MISSED"


def line(row: dict[str, Any]) -> Line:
    """A row in the form of whichever benchmark wrote it."""
    unit = row.get("unit", "")
    if "ours_s" in row:  # trm: seconds, and the ratio is ours by theirs
        met = None if row["ratio"] is None else row["ratio"] <= row["bar"]
        ours, peer = (number(row[key] and 1e3 * row[key]) for key in ("ours_s", "peer_s"))
        return Line(
            row["work"], f"{ours} ms", f"{peer} ms", number(row["ratio"]), f"<= {row['bar']}", verdict(row, met)
        )
    if "ratio_bar" in row:  # data: more is better
        bar, own = row["ratio_bar"], row["bar"]
        shown = (
            f">= {bar} times"
            if bar is not None
            else "none"
            if own is None
            else f"{'<=' if unit == 'ms' else '>='} {own}"
        )
        measured = bar is None or row["ratio"] is not None
        met = row["met"] if measured and shown != "none" else None
        return Line(
            row["work"],
            f"{number(row['ours'])} {unit}",
            number(row["theirs"]),
            number(row["ratio"]),
            shown,
            verdict(row, met),
        )
    bar = row.get("bar")
    shown = bar if isinstance(bar, str) else "none" if bar is None else f"<= {bar}"
    met = row.get("met") if bar is not None and bar != "none" else None
    return Line(
        row["work"],
        f"{number(row['ours'])} {unit}",
        number(row["peer"]),
        number(row["ratio"]),
        shown,
        verdict(row, met),
    )


def lines(name: str, code: int) -> Iterator[Line]:
    """The rows of a benchmark; one that says so where it ended without any."""
    path = FOLDER / f"{name}.json"
    try:
        text = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        yield Line(f"{name}: {error}", "-", "-", "-", "ends with exit code 0", "FAILED")
        return
    rows: list[dict[str, Any]] = text["rows"] if isinstance(text, dict) else text
    shown = [line(row) for row in rows]
    yield from shown
    if code and not any(each.verdict == "MISSED" for each in shown):
        yield Line(f"{name}: exit code {code}", "-", "-", "-", "ends with exit code 0", "FAILED")


def processor() -> str:
    """Which processor this is: ratios differ between those that compute 512 bits at a time and those that do not."""
    facts = [line.partition(":") for line in Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()]
    known = {name.strip(): value.strip() for name, _, value in facts}
    return (
        f"{known.get('model name', 'unknown')}, family {known.get('cpu family', '?')}, model {known.get('model', '?')}"
    )


def main() -> int:
    """Print the table; say whether a bar was missed."""
    found = [each for word in sys.argv[1:] for each in lines(word.partition("=")[0], int(word.partition("=")[2] or 0))]
    head = Line("work", "ours", "peer", "ratio", "bar", "")
    for each in (head, *found):
        cells = (each.work, each.ours, each.peer, each.ratio, each.bar)
        text = "  ".join(cell.strip().ljust(width) for cell, width in zip(cells, WIDTHS, strict=True))
        print(f"{text}  {each.verdict}".rstrip())
    missed = [each for each in found if each.verdict in {"MISSED", "FAILED"}]
    print(f"{len(found)} rows, {len(missed)} bars missed, on {processor()}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
