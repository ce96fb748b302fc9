"""``skyless selftest``: tests of one or two boards before there is a site, and their report file."""

from pathlib import Path

import msgspec
from cyclopts import App

from skyless.arguments import Options, Positive
from skyless.cli.common import (
    JsonOptions,
    check_folder,
    check_new,
    command,
    say_written,
    to_json,
    write_file,
)
from skyless.cli.nodes.doctor import EMULATED, report_text, show_checks
from skyless.cli.nodes.options import log
from skyless.core.errors import SkylessError
from skyless.radio.serial.serial_port import check_path
from skyless.run.process import run
from skyless.run.selftest.facts import Report, judge
from skyless.run.selftest.measure import Bench, measure, report_of

app = App(
    name="selftest",
    help_epilogue="Example: skyless selftest --radio serial:/dev/ttyACM0,/dev/ttyACM1 --separation 1.5 --report b.json",
)


class SelftestOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless selftest``."""

    radio: str | None = None
    """Radio of a board that no other program uses: serial:PATH, or two boards that lie 1 to 2 m apart with a comma."""
    separation: Positive | None = None
    """Metres between the antennas of two boards, as measured: it shows whether their antenna delays are right."""
    report: Path | None = None
    """File to write the report to, JSON: all that was measured."""
    read: Path | None = None
    """Judge the report of an earlier test again instead of testing."""
    force: bool = False
    """Overwrite what is there, if the report exists."""


@app.default
@command
def selftest(*, asked: SelftestOptions, output: JsonOptions) -> int:
    """Test one or two boards in two minutes: serial line, processor, radio chip and the air between them.

    Each fault has one sentence; the exit code is 1 if there is one. The report file is what to attach to an issue.
    """
    if asked.read is None:
        return _test(asked, output)
    asked.leave_out("radio", "report", "separation", why="--read judges a report again")
    return _show(_load(asked.read), None, output)


def _test(asked: SelftestOptions, output: JsonOptions) -> int:
    """Test the boards; an interrupted test shows and writes what it has found, too. Raises SkylessError."""
    if asked.radio is None:
        raise SkylessError("--radio is missing; it should name the board, as serial:/dev/ttyACM0; or --read a report")
    kind, _, ports = asked.radio.partition(":")
    paths = [one.removeprefix("serial:") for one in ports.split(",")]
    if kind != "serial" or not 1 <= len(paths) <= 2 or not all(paths) or len(set(paths)) < len(paths):
        right = "one board or two, as serial:/dev/ttyACM0 or serial:/dev/ttyACM0,/dev/ttyACM1"
        raise SkylessError(f"--radio is {asked.radio!r}; it should be {right}")
    for path in paths:
        check_path(asked.radio, path)
    if asked.report is not None:
        check_folder("--report", asked.report)
        check_new(asked.report, force=asked.force)
    benches: list[Bench] = []
    is_whole = False

    async def work() -> None:
        nonlocal is_whole
        benches.extend(Bench(name, path) for name, path in zip("AB", paths, strict=False))
        await measure(benches, reach=log)
        is_whole = True

    try:
        run(work(), punctual=True)
    finally:
        for bench in benches if not is_whole else ():
            bench.facts.trouble = bench.facts.trouble or "The test was interrupted."
        code = _show(report_of(benches, asked.separation), asked.report, output)
    return code


def _show(report: Report, file: Path | None, output: JsonOptions) -> int:
    """Print what a report means before it is written, as the disk may be full. Returns the exit code."""
    checks, title = judge(report), f"skyless selftest {report.skyless_version}, {report.made}"
    code = show_checks(checks, report_text(title, EMULATED, checks), file, output)
    if file is not None:
        write_file(file, to_json(report).encode())
        say_written(file)
    return code


def _load(path: Path) -> Report:
    """Read a report file. Raises SkylessError."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Report)
    except OSError as error:
        raise SkylessError(f"--read is {str(path)!r}, which cannot be read: {error.strerror}") from None
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise SkylessError(f"--read is {str(path)!r}; it should be a report of skyless selftest: {error}") from None
