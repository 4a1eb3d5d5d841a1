"""A bar as tqdm draws it, without tqdm."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager

Progress = bool | Callable[[int, int], object] | None

WIDTH = 30
EVERY = 0.1


@contextmanager
def teller(what: str, progress: Progress) -> Generator[Callable[[int, int], object], None, None]:
    """What is called with how much is done of how much: the caller's function, a bar, or nothing."""
    if callable(progress):
        yield progress
        return
    stream = sys.stderr
    shown = progress if progress is not None else "ipykernel" in sys.modules or bool(stream and stream.isatty())
    # programs with windows and no terminal have no standard error
    if not shown or stream is None:  # pyright: ignore[reportUnnecessaryComparison]
        yield lambda _done, _total: None
        return
    bar = Bar(what)
    try:
        yield bar.at
    finally:
        bar.end()


class Bar:
    """One line on standard error that is drawn anew."""

    def __init__(self, what: str) -> None:
        self.what = what
        self.begun = time.monotonic()
        self.first: int | None = None
        self.drawn = 0.0
        self.line = ""

    def at(self, done: int, total: int) -> None:
        """So much is done."""
        now = time.monotonic()
        if self.first is None:
            self.first = done
        if now - self.drawn < EVERY and done < total:
            return
        self.drawn = now
        elapsed = now - self.begun
        rate = (done - self.first) / elapsed if elapsed > 0 else 0.0
        left = clock((total - done) / rate) if rate > 0 else "?"
        share = done / total if total else 1.0
        filled = "█" * round(share * WIDTH)
        line = f"{self.what}: {share:4.0%}|{filled:<{WIDTH}}| {done}/{total} [{clock(elapsed)}<{left}, {rate:.2f}it/s]"
        sys.stderr.write("\r" + line + " " * max(0, len(self.line) - len(line)))
        sys.stderr.flush()
        self.line = line

    def end(self) -> None:
        """Leave the line."""
        if self.line:
            sys.stderr.write("\n")
            sys.stderr.flush()


def clock(seconds: float) -> str:
    """`mm:ss`, with hours where there are any."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes:02d}:{rest:02d}"
