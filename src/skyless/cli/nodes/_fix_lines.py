"""Fixes as lines on standard output: for people, as CSV, or as JSON; ``skyless tag`` writes them while it runs.

A reader that takes lines too slowly must not delay the tags. So a thread writes them; what it cannot keep up with is
dropped and counted.
"""

import asyncio
import os
import queue
import sys
import threading
import time
from collections.abc import Callable
from typing import Final, TextIO

from skyless.cli.common.output import cm, to_json
from skyless.core.arguments import Options
from skyless.core.errors import SkylessError
from skyless.core.integrity import Alert
from skyless.run.mqtt.messages import FixMessage
from skyless.run.process import Log

CSV_COLUMNS: Final = (
    *("unix_s", "tag", "x_m", "y_m", "z_m", "std_m", "vx_mps", "vy_mps", "vz_mps"),
    *("anchors", "latency_s", "hpl_m", "vpl_m", "alert", "time_s", "verified_until_s", "unverified"),
)
"""Columns of ``--csv``."""

_NO_ALERTS: Final = (None, Alert.NONE, Alert.UNAVAILABLE)
"""Those that are not shown to people: that there is no protection level is usual after a start."""

_MAX_WAITING: Final = 1000
"""Lines that wait for the reader: twenty tags' for a second."""

_CLOSE_S: Final = 1.0
"""How long the last lines may take."""


class LineOptions(Options, frozen=True, kw_only=True):
    """Which lines are written on standard output."""

    print: bool = False
    """Write each fix as a line for people on standard output: time, tag, position, sigma."""
    csv: bool = False
    """Write each fix as a row of a CSV table on standard output, whose header names the units."""
    json: bool = False
    """Write one JSON object for each fix on standard output, a line each, as on MQTT."""

    def lines(self, log: Log) -> "FixLines | None":
        """What writes them; None where no lines are asked for. Raises SkylessError."""
        asked = {"print": self.print, "csv": self.csv, "json": self.json}
        chosen = [name for name, is_asked in asked.items() if is_asked]
        if len(chosen) > 1:
            raise SkylessError(f"{' and '.join(f'--{name}' for name in chosen)} exclude each other; give one of them")
        if not chosen:
            return None
        if sys.stdout is None:
            raise SkylessError(f"--{chosen[0]} writes on standard output, which is closed")
        line = {"print": line_for_people, "csv": csv_row, "json": to_json}[chosen[0]]
        return FixLines(line, ",".join(CSV_COLUMNS) if self.csv else None, log)


def line_for_people(fix: FixMessage) -> str:
    """Local time, tag, position in metres, its standard deviation and alert in one line."""
    x_m, y_m, z_m = fix.position_m
    clock = time.strftime("%H:%M:%S", time.localtime(fix.unix_s))
    height = f"z {z_m:.3f} m (given)" if fix.height_known else f"z {z_m:.3f} m"
    alert = "" if fix.alert in _NO_ALERTS else f"  {fix.alert}"
    moment = f"{clock}.{int(fix.unix_s % 1.0 * 1e3):03d}"
    return f"{moment}  {fix.tag}  x {x_m:.3f}  y {y_m:.3f}  {height}  ± {cm(fix.std_m)}{alert}"


def csv_row(fix: FixMessage) -> str:
    """The values of ``CSV_COLUMNS``; empty where there is none, anchors with spaces between."""
    velocity = (None, None, None) if fix.velocity_mps is None else fix.velocity_mps
    moved = [_figure(value) for value in (*fix.position_m, fix.std_m, *velocity)]
    levels = [_figure(value) for value in (fix.latency_s, fix.hpl_m, fix.vpl_m)]
    trust = [_figure(value) for value in (fix.time_s, fix.verified_until_s, fix.unverified)]
    anchors = " ".join(map(str, fix.anchors))
    return ",".join([f"{fix.unix_s:.6f}", fix.tag, *moved, anchors, *levels, fix.alert or "", *trust])


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.5f}"


class FixLines:
    """Writes fixes as lines, each flushed at once."""

    def __init__(self, line: Callable[[FixMessage], str], header: str | None, log: Log) -> None:
        self._line, self._log = line, log
        self._waiting: queue.Queue[str | None] = queue.Queue(_MAX_WAITING)
        self._ended = asyncio.Event()
        self._trouble: OSError | None = None
        self.dropped = 0
        """Lines for which the reader was too slow."""
        if header is not None:
            self._waiting.put_nowait(header)

    def on_fix(self, fix: FixMessage) -> None:
        """Write a fix soon, or drop it."""
        try:
            self._waiting.put_nowait(self._line(fix))
        except queue.Full:
            self.dropped += 1

    async def run(self) -> None:
        """Write until cancelled.

        Raises:
            OSError: standard output takes no more; a ``BrokenPipeError`` where its reader is gone.
        """
        loop = asyncio.get_running_loop()
        thread = threading.Thread(target=self._write_all, args=(loop,), daemon=True)
        thread.start()
        try:
            await self._ended.wait()
            assert self._trouble is not None
            raise self._trouble
        finally:
            self._close(thread)

    def _close(self, thread: threading.Thread) -> None:
        """Write what waits; leave a reader alone that takes nothing."""
        try:
            self._waiting.put_nowait(None)
        except queue.Full:
            self.dropped += self._waiting.qsize()
        else:
            thread.join(_CLOSE_S)
        if self.dropped:
            self._log(f"{self.dropped} fixes were not written on standard output: its reader is too slow")

    def _write_all(self, loop: asyncio.AbstractEventLoop) -> None:
        try:
            with _standard_output() as out:
                while (line := self._waiting.get()) is not None:
                    out.write(f"{line}\n")
        except OSError as error:
            self._trouble = error
            loop.call_soon_threadsafe(self._ended.set)


def _standard_output() -> TextIO:
    """Standard output, flushed with each line.

    It is apart from ``sys.stdout``, which Python flushes at its end: a reader that takes nothing must not delay that.
    """
    return os.fdopen(os.dup(sys.stdout.fileno()), "w", 1, sys.stdout.encoding, "backslashreplace")
