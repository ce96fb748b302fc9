"""The program ``skyless``: its table of commands, and their common start and end."""

import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from errno import EDQUOT, EFBIG, EIO, ENOSPC
from io import TextIOWrapper
from types import FrameType
from typing import TYPE_CHECKING, Final

from cyclopts import App, CycloptsError, Group, Parameter, UnknownCommandError
from cyclopts.help import DefaultFormatter

from skyless.core.errors import SkylessError
from skyless.core.version import installed_version
from skyless.machine import what_to_install

if TYPE_CHECKING:
    from cyclopts.help import HelpPanel
    from rich.console import Console, ConsoleOptions

_GROUPS: Final = {
    "Start here": (
        # name, module below skyless.cli (imported only when it is called) and its App (:app), what it does
        ("demo", "nodes.demo", "Show a site and walking tags in real time: no radio and no site file needed."),
        ("simulate", "simulate", "Run a site in the simulated world and judge it against the truth."),
    ),
    "Set up and check a site": (
        ("site", "site", "Write and check site files."),
        ("plan", "plan", "Predict a site's errors before it is mounted, and place its anchors."),
        ("survey", "survey", "Find where anchors hang, and their antenna delays."),
        ("calibrate", "survey:calibrate_app", "Correct antenna delays by a tag at known positions."),
        ("flash", "nodes.flash", "Put the firmware onto a board through a debug probe."),
        ("flash-config", "nodes.boards:flash_app", "Set up a board that computes its own position."),
        ("selftest", "nodes.selftest", "Test one or two boards in two minutes, before there is a site."),
        ("doctor", "nodes.doctor", "Check a computer, its boards and a running site in two minutes."),
    ),
    "Run a site": (
        ("broker", "nodes.broker", "Run the MQTT broker that comes with Skyless."),
        ("hub", "nodes.broker:hub_app", "Set up the servers where several sites meet."),
        ("gather", "nodes.broker:gather_app", "Pack the fixes of a site with thousands of tags into a stream of NATS."),
        ("anchor", "nodes.anchor", "Run anchors of a site."),
        ("tag", "nodes.tag", "Run listening tags; with --print, --csv or --json their positions on standard output."),
        ("dashboard", "dashboard", "Show a site live in the browser."),
        ("watch", "nodes.site_view:watch_app", "Show a running site as text, for a terminal."),
        ("sites", "nodes.site_view:sites_app", "List the sites of a broker or at a hub, and how they are."),
        ("bridge", "nodes.bridge", "Give positions to other tools: gpsd, ROS 2, autopilots, Home Assistant and more."),
    ),
    "Record and replay": (
        ("record", "nodes.record", "Record a running site into a file."),
        ("replay", "replay", "Turn a recording into fixes and judge them against the truth."),
        ("history", "history", "Keep and ask what happened at a site."),
        (
            "export",
            "nodes.record:export_app",
            "Write a recording as a bag of ROS 2, for its tools, Foxglove, Rerun and PlotJuggler.",
        ),
    ),
    "Emulate what is not there": (
        ("ether", "nodes.boards:ether_app", "Emulate a site's air in real time, for the programs of anchors and tags."),
        (
            "board",
            "nodes.boards:board_app",
            "Emulate a board with a radio on a serial port, to try programs without one.",
        ),
    ),
    "Research": (
        ("study", "study", "Measure the receiver's errors over many simulated runs."),
        ("paper", "study:paper_app", "Reproduce the paper's figures and claims in one report."),
        ("benchmark", "study:benchmark_app", "Compare methods on every recording below a folder."),
    ),
}
"""The commands, in the groups and in the order of the help."""

_INTERRUPTED = 130
_TERMINATED = 143
_BROKEN_PIPE = 1
_CANNOT_WRITE = (ENOSPC, EDQUOT, EFBIG, EIO)
_USER_ERROR = 2
_IMPORT_SYSTEM: Final = "<frozen importlib._bootstrap>"
_CONVERSION: Final = "from_param"  # the method by which ctypes converts an argument
_TRY_AGAIN_S: Final = 0.02


class _Help(DefaultFormatter):
    """Cyclopts's format, with line breaks of the source within help texts replaced by spaces."""

    def __call__(self, console: "Console", options: "ConsoleOptions", panel: "HelpPanel") -> None:
        from rich.text import Text

        for entry in panel.entries:
            text = getattr(entry.description, "primary_renderable", None)
            if isinstance(text, Text):
                text.plain = " ".join(text.plain.split())
        super().__call__(console, options, panel)


def program() -> App:
    """The program with all its commands, which are imported only when called."""
    app = App(
        name="skyless",
        help="GPS without a sky: fixed UWB anchors broadcast, tags only listen and compute their own position.",
        help_epilogue=(
            "Every command has its own help: skyless COMMAND --help. Example: skyless demo, which shows a page in "
            "the browser until Ctrl-C; then: skyless site new site.toml && skyless site check site.toml"
        ),
        help_format="plaintext",
        help_formatter=_Help(),
        version=installed_version,
        print_error=False,
        exit_on_error=False,
        result_action="return_value",
        suppress_keyboard_interrupt=False,
        default_parameter=Parameter(negative=()),
    )
    for number, (title, commands) in enumerate(_GROUPS.items()):
        group = Group(title, sort_key=number)
        for index, (name, module, summary) in enumerate(commands):
            at = f"skyless.cli.{module}" if ":" in module else f"skyless.cli.{module}:app"
            app.command(at, name=name, help=summary, group=group, sort_key=index)
    options = Group("Options", sort_key=len(_GROUPS))
    for option in ("--help", "--version"):
        app[option].group = (options,)
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code: 0, 2 for a user's error, 130 after Ctrl-C, 143 after SIGTERM.

    A command returns its own exit code, or None for 0.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # which may be unable to show a character
            stream.reconfigure(errors="backslashreplace")
    interrupted = [_INTERRUPTED]
    try:
        with _interrupts_where_they_are_kept(), _ended_by_sigterm(lambda: interrupted.append(_TERMINATED)):
            result = program()(arguments)
        if sys.stdout is not None:
            sys.stdout.flush()
    except KeyboardInterrupt:
        return interrupted[-1]
    except BrokenPipeError:
        _drop_output()
        return _BROKEN_PIPE
    except (SkylessError, CycloptsError, ModuleNotFoundError, OSError) as error:
        if (line := _line_for_the_user(error)) is None:
            raise
        from skyless.cli.common import plain  # loads more than --help needs

        print(f"skyless: {plain(line, chr(10))}", file=sys.stderr)
        return _USER_ERROR
    return result if isinstance(result, int) else 0


def _line_for_the_user(error: Exception) -> str | None:
    """Say what is wrong and what to do about it; None for a defect of the program."""
    if isinstance(error, OSError):
        return _trouble(error)
    if isinstance(error, ModuleNotFoundError):
        return what_to_install(error)
    return f"{' '.join(str(error).split())}{_meant(error)}" if isinstance(error, CycloptsError) else str(error)


def _meant(error: CycloptsError) -> str:
    """Suggest commands whose summaries contain the name of an unknown command."""
    if not isinstance(error, UnknownCommandError) or "Did you mean" in str(error) or not error.unused_tokens:
        return ""
    word = error.unused_tokens[0].lower()
    known = (one for commands in _GROUPS.values() for one in commands)
    fitting = [f'skyless {name} ("{does}")' for name, _, does in known if word in re.findall(r"[a-z]+", does.lower())]
    return f" Did you mean {' or '.join(fitting)}?" if fitting else ""


@contextmanager
def _interrupts_where_they_are_kept() -> Iterator[None]:
    """Delay Ctrl-C where it would be lost.

    That is during an import, where Python itself and NumPy's modules can drop it, and while ctypes converts an
    argument, where it becomes an ArgumentError.
    """
    if threading.current_thread() is not threading.main_thread() or not callable(signal.getsignal(signal.SIGINT)):
        yield
        return

    def interrupt(_: int, frame: FrameType | None) -> None:
        caller = frame
        while caller and not (caller.f_code.co_filename == _IMPORT_SYSTEM or caller.f_code.co_name == _CONVERSION):
            caller = caller.f_back
        if caller is None:
            signal.default_int_handler(signal.SIGINT, frame)
        signal.signal(signal.SIGALRM, interrupt)
        signal.setitimer(signal.ITIMER_REAL, _TRY_AGAIN_S)

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if signal.getsignal(signal.SIGALRM) is interrupt:
            signal.setitimer(signal.ITIMER_REAL, 0.0)


@contextmanager
def _ended_by_sigterm(note: Callable[[], None]) -> Iterator[None]:
    """Let SIGTERM end the command in the block like Ctrl-C, after ``note()``, unless the signal is already handled.

    An event loop turns Ctrl-C into the cancellation of its task; an exception raised inside the loop, for instance
    while it starts a process, could leave it waiting for ever.
    """
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return

    def end(_: int, frame: FrameType | None) -> None:
        note()
        interrupt = signal.getsignal(signal.SIGINT)
        (interrupt if callable(interrupt) else signal.default_int_handler)(signal.SIGINT, frame)

    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _trouble(error: OSError) -> str:
    """Message for a file or standard output that cannot be used; other errors are raised as defects."""
    if error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    if error.errno not in _CANNOT_WRITE:
        raise error
    _drop_output()
    return f"standard output cannot be written: {error.strerror}"


def _drop_output() -> None:
    """Redirect a broken standard output, so that the interpreter does not complain when it flushes at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    sys.exit(main())
