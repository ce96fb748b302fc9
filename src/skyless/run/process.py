"""Shared parts of a site's programs: event loop, tasks, links, folders, ports, resource usage."""

import asyncio
import contextlib
import ctypes
import errno
import fcntl
import gc
import os
import random
import resource
import select
import selectors
import signal
import socket
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from pathlib import Path
from typing import IO, Any, Final

from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import replace

from skyless.core.site import Site
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import NODE_KEEPALIVE_S, RESEND_S, Handler, Link
from skyless.run.mqtt.messages import SiteMessage, System, WrongMessageError, read_message, site_message
from skyless.run.mqtt.topics import floor_plan_topic, plan_of_floor_topic, site_topic

HEALTH_S: Final = 1.0
"""Interval of the health messages."""

Log = Callable[[str], None]
"""Called with one line for a person to read."""

_PR_SET_PDEATHSIG: Final = 1

_RESERVED: Final = "\0skyless-{}:{}"
"""Name of an abstract socket of Linux, which has one owner in the same namespace as its ports and ends with its
process."""

_MAX_FILES: Final = 65_536
"""Upper limit of open files: some systems allow billions, and some libraries iterate over all possible ones."""

_RADIO_NICE: Final = -10
"""Priority of programs that serve a radio, if the system allows it (root, or a limit in limits.conf)."""


# The event loop


def run(main: Coroutine[Any, Any, None], *, punctual: bool = False) -> None:
    """Run a program until it ends or is cancelled by SIGTERM, SIGHUP or Ctrl-C.

    ``punctual`` requests a higher priority, because a radio's slots do not wait.

    Raises:
        KeyboardInterrupt: it was Ctrl-C.
    """
    if punctual:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, _RADIO_NICE)
    gc.collect()
    gc.freeze()
    if callable(signal.getsignal(signal.SIGINT)) and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.default_int_handler)  # the only one that asyncio replaces by its own
    with asyncio.Runner(loop_factory=_new_loop) as runner, contextlib.suppress(asyncio.CancelledError):
        runner.run(_until_terminated(main))


def _new_loop() -> asyncio.AbstractEventLoop:
    """Create a loop for any number of connections, with timers exact to microseconds."""
    return asyncio.SelectorEventLoop(PunctualSelector() if hasattr(selectors, "EpollSelector") else None)


if hasattr(selectors, "EpollSelector"):

    class PunctualSelector(selectors.EpollSelector):
        """epoll(), whose own timeouts end up to a millisecond late, woken by select(), which is exact.

        select() takes no file beyond number 1023, so it waits only for epoll()'s own, which becomes readable as soon as
        any of the others is ready.
        """

        def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
            """Return the files that are ready, waiting for at most ``timeout`` s, or without limit if it is None."""
            if timeout is None:
                return super().select()
            if timeout > 0.0:
                select.select([self.fileno()], [], [], timeout)
            return super().select(0)


async def _until_terminated(main: Coroutine[Any, Any, None]) -> None:
    task = asyncio.ensure_future(main)
    with contextlib.suppress(NotImplementedError):
        for number in ending_signals():
            asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    await task


def ending_signals() -> tuple[signal.Signals, ...]:
    """Signals that end a program like Ctrl-C: SIGTERM and, except under ``nohup``, SIGHUP of a closed terminal."""
    is_ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return (signal.SIGTERM,) if is_ignored else (signal.SIGTERM, signal.SIGHUP)


def end_with_parent(number: signal.Signals = signal.SIGTERM) -> Callable[[], None] | None:
    """The ``preexec_fn`` of a child process that must end with its parent, however that ends; None except on Linux."""
    if not sys.platform.startswith("linux"):
        return None
    prctl = ctypes.CDLL(None).prctl
    parent = os.getpid()

    def request_signal() -> None:
        prctl(_PR_SET_PDEATHSIG, number, 0, 0, 0)
        if os.getppid() != parent:  # the parent died before the request
            os._exit(1)

    return request_signal


# Tasks


_CANCEL_AGAIN_S: Final = 10.0
"""Longer than any part takes to end; a library may have lost the first cancellation."""


async def together(*parts: Awaitable[None]) -> None:
    """Run until one part fails or all are cancelled. A failure cancels the others and is raised unwrapped."""
    tasks = [asyncio.ensure_future(part) for part in parts]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION)
        for task in done:
            task.result()
    finally:
        while left := [task for task in tasks if not task.done()]:
            for task in left:
                task.cancel()
            await asyncio.wait(left, timeout=_CANCEL_AGAIN_S)
        await asyncio.gather(*tasks, return_exceptions=True)


async def every(seconds: float, act: Callable[[], None]) -> None:
    """Call a function at an interval until cancelled."""
    while True:
        await asyncio.sleep(seconds)
        act()


async def outlasting(lasting: Coroutine[Any, Any, None], others: Coroutine[Any, Any, None]) -> None:
    """Run both until one ends or all are cancelled. ``lasting`` is cancelled when the others have ended."""
    last, first = asyncio.ensure_future(lasting), asyncio.ensure_future(others)
    try:
        done, _ = await asyncio.wait((last, first), return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in (first, last):
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


# Links


def link_of(address: MqttAddress | None, name: int | str, *, site: int, kind: str) -> Link | None:
    """Create the node's connection to the broker; None without a broker."""
    return None if address is None else Link(address, name, site=site, kind=kind, keepalive_s=NODE_KEEPALIVE_S)


async def keep(link: Link, log: Log) -> None:
    """Run a link until cancelled. A fault in it is logged, and affects neither fixes nor beacons."""
    while True:
        try:
            await link.run()
        except Exception as error:  # noqa: BLE001 - whatever it is, positioning goes on
            log(f"the link to {link.address} failed ({error!r}); started again")
        await asyncio.sleep(HEALTH_S)


def reader(
    kind: type[Struct] | Callable[[bytes], Struct], act: Callable[[Any], None], on_wrong: Callable[[], None]
) -> Handler:
    """Make a handler that decodes messages of a kind, or with a function. ``on_wrong`` is called if that fails.

    An empty payload, a withdrawn retained message, is skipped.
    """

    def read(_topic: str, payload: bytes) -> None:
        if not payload:
            return
        try:
            message = read_message(payload, kind) if isinstance(kind, type) else kind(payload)
        except WrongMessageError:
            on_wrong()
        else:
            act(message)

    return read


class SitePublisher:
    """Publishes a site, retained: when it or ``simulated`` has changed, and at intervals.

    The repetitions are for bridged brokers, which may have missed or lost it.
    """

    def __init__(
        self, site: Site, is_simulated: Callable[[], bool], plans: Mapping[int | None, Path] | None = None
    ) -> None:
        """``plans`` are the images of the floors by number, or of the whole site by None."""
        self._site, self._is_simulated, self._plans = site, is_simulated, dict(plans or {})
        self.system: System | UnsetType = UNSET
        """Whose anchors they are, if not Skyless's own."""
        self._restarts: int | None = None
        self._simulated = False
        self._published: SiteMessage | None = None
        self._repeat_s = 0.0  # when to publish it again, by the host's monotonic clock

    def place(self, site: Site) -> None:
        """Publish a survey's site from now on."""
        if site != self._site:
            self._site, self._published = site, None

    def update(self, restarts: int) -> None:
        """Call ``is_simulated`` after each restart of a radio, as its port may lead to another device."""
        if restarts != self._restarts:
            self._restarts, self._simulated = restarts, self._is_simulated()

    def publish(self, link: Link) -> None:
        """Publish the site if it is new or due, retained for later subscribers."""
        now_s = time.monotonic()
        if self._published is None or self._published.simulated is not self._simulated:
            message = site_message(self._site, simulated=self._simulated, unix_s=time.time())
            self._published = replace(message, system=self.system)
        elif now_s < self._repeat_s:
            return
        self._repeat_s = now_s + RESEND_S * random.uniform(0.5, 1.0)
        link.publish(site_topic(self._site.id), self._published, qos=1, retain=True)
        site, plans, self._plans = self._site.id, self._plans, {}
        for floor, file in plans.items():
            topic = floor_plan_topic(site) if floor is None else plan_of_floor_topic(site, floor)
            link.publish(topic, file.read_bytes(), qos=1, retain=True)


# Folders and files


def data_folder() -> Path:
    """``skyless`` in the user's data folder (XDG), or a temporary folder if that cannot be written."""
    shared = os.environ.get("XDG_DATA_HOME")
    try:
        home = Path(shared) if shared and Path(shared).is_absolute() else Path("~/.local/share").expanduser()
        folder = home / "skyless"
        if home == Path("/.local/share"):
            raise PermissionError("HOME is empty")
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError("it cannot be written")
    except (OSError, RuntimeError):  # RuntimeError: a user without a home
        folder = Path(tempfile.gettempdir()) / f"skyless-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
    return folder


def recordings_folder() -> Path:
    """Folder of the recordings that the page shows, created if missing."""
    folder = data_folder() / "recordings"
    folder.mkdir(exist_ok=True)
    return folder


def locked(file: Path) -> IO[str]:
    """Lock a file for this process until it is closed. Raises OSError."""
    lock = file.open("a", encoding="utf-8")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.close()
        raise
    return lock


# Ports


def is_free(host: str, port: int) -> bool:
    """Whether a program could listen on the port.

    Raises OSError: no program could: not an address of this machine, or a privileged port.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return False
            raise
    return True


def reserve(host: str, port: int) -> socket.socket | None:
    """Reserve a port among Skyless's programs while the returned socket is open; None if one of them has it."""
    held = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    if sys.platform.startswith("linux"):
        try:
            held.bind(_RESERVED.format(host, port))
        except OSError:
            held.close()
            return None
    return held


def reserve_free(host: str, port: int) -> socket.socket | None:
    """Reserve a port that is free; None if any program has it. Raises OSError as ``is_free`` does."""
    held = reserve(host, port)
    if held is None or is_free(host, port):
        return held
    held.close()
    return None


def reserve_next(host: str, first: int) -> tuple[int, socket.socket]:
    """Return the first free, unreserved port from ``first`` on, and the socket that reserves it."""
    port = first
    while (held := reserve_free(host, port)) is None:
        port += 1
    return port, held


def hold_any(host: str) -> tuple[int, socket.socket]:
    """Return a free port and its socket; while that is open, the system assigns the port to no other program."""
    held = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    held.bind((host, 0))
    return int(held.getsockname()[1]), held


# Resource usage


def most_files() -> int:
    """Raise the limit of open files of this process as far as the system allows, and return it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == hard:
        return soft
    most = min(hard, _MAX_FILES) if hard != resource.RLIM_INFINITY else _MAX_FILES
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(most, soft), hard))
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


class Usage:
    """Share of a core that this process uses, and its resident memory."""

    def __init__(self) -> None:
        self._wall_s = time.monotonic()
        self._cpu_s = time.process_time()

    def sample(self) -> tuple[float, int]:
        """Return the share of a core since the last call, and the resident memory in bytes."""
        wall_s, cpu_s = time.monotonic(), time.process_time()
        share = (cpu_s - self._cpu_s) / max(wall_s - self._wall_s, 1e-9)
        self._wall_s, self._cpu_s = wall_s, cpu_s
        return share, resident_bytes()


def resident_bytes() -> int:
    """Resident memory of this process, or its peak where the system does not report the present value."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError, ValueError):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
    return pages * os.sysconf("SC_PAGE_SIZE")


_LATE_SHARE: Final = 0.5
"""An event that is late by up to this share of the interval does not lower the average rate."""

_EARLY_SHARE: Final = 0.25
"""An event that is early by up to this share passes; otherwise some events at exactly this rate would not."""


class RateLimit:
    """Passes at most a given number of events a second on average."""

    def __init__(self, max_hz: float) -> None:
        self._interval_s = 1.0 / max_hz
        self._due_s = 0.0

    def is_due(self, now_s: float) -> bool:
        """Whether an event at this time passes."""
        if now_s < self._due_s - _EARLY_SHARE * self._interval_s:
            return False
        self._due_s = max(self._due_s, now_s - _LATE_SHARE * self._interval_s) + self._interval_s
        return True


# Child programs: watched, restarted when they die, ended together.

_RESTART_S: Final = 0.2
_LONGEST_RESTART_S: Final = 5.0
"""Longest pause before a program is restarted. The pause doubles while the program ends soon after each start."""
_GOOD_RUN_S: Final = 10.0  # a program that has run for this time was not faulty from the start

_STOP_S: Final = 5.0
_LINE_BYTES: Final = 500
_COMMAND: Final = (sys.executable, "-m", "skyless.cli.main")


class Program(Struct, frozen=True):
    """A command to run."""

    name: str
    arguments: tuple[str, ...]
    new_file: int | None = None
    """Index of an argument that names a file to create: later starts get another name. The program is not restarted if
    it ends by itself (a full disk, its limit reached)."""
    start_after_s: float = 0.0
    """Delay of its first start."""
    logs_lines: bool = False
    """Whether lines on standard error are logged as they come; otherwise only the last one, at its end."""
    environment: Mapping[str, str] = {}
    """Variables in addition to those of this program."""
    command: tuple[str, ...] = _COMMAND
    """What takes the arguments; by default ``skyless``."""

    def start(self, number: int) -> tuple[str, ...]:
        """Arguments of the start with this number, counted from 1."""
        if self.new_file is None or number == 1:
            return self.arguments
        path = Path(self.arguments[self.new_file])
        renamed = str(path.with_stem(f"{path.stem}-{number}"))
        return (*self.arguments[: self.new_file], renamed, *self.arguments[self.new_file + 1 :])


class Child:
    """One program, restarted whenever it ends."""

    def __init__(self, program: Program, log: Log) -> None:
        self.program = program
        self.starts = 0
        self.pid: int | None = None  # of the running process
        self._log = log
        self._is_asked = False
        self._last_lines: deque[str] = deque(maxlen=20)
        self._line = b""

    def restart(self) -> None:
        """Restart it now without logging, because the input that it read at its start has changed."""
        if self.pid is not None:
            self._is_asked = True
            with contextlib.suppress(ProcessLookupError):  # it has just ended by itself
                os.kill(self.pid, signal.SIGTERM)

    async def run(self) -> None:
        """Keep it running until cancelled, or until it has ended for good."""
        if self.program.start_after_s > 0.0:
            await asyncio.sleep(self.program.start_after_s)
        wait_s = _RESTART_S
        while True:
            begun_s = asyncio.get_running_loop().time()
            code = await self._run_once()
            if self._is_asked:
                self._is_asked = False
                self.starts -= 1
                continue
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            ended = f"{self.program.name} ended ({how}); {self._last_message()}"
            if self.program.new_file is not None and code >= 0:
                self._log(ended)
                return
            self._log(f"{ended}; started again")
            was_good = asyncio.get_running_loop().time() - begun_s > _GOOD_RUN_S
            wait_s = _RESTART_S if was_good else min(2.0 * wait_s, _LONGEST_RESTART_S)
            await asyncio.sleep(wait_s)

    async def _run_once(self) -> int:
        self.starts += 1
        self._last_lines.clear()
        self._line = b""
        # asyncio's own pipes report a program's end only after its children have closed them, too
        read_end, write_end = os.pipe()
        os.set_blocking(read_end, False)
        loop = asyncio.get_running_loop()
        loop.add_reader(read_end, self._read_lines, read_end)
        try:
            process = await self._start(write_end)
            self.pid = process.pid
            try:
                code = await process.wait()
                self._read_lines(read_end)
                return code
            finally:
                self.pid = None
                await end(process)
        finally:
            loop.remove_reader(read_end)
            os.close(read_end)

    async def _start(self, stderr: int) -> asyncio.subprocess.Process:
        """Start the program. Standard error goes to a pipe, whose writing end is closed on this side."""
        try:
            return await asyncio.create_subprocess_exec(
                *(*self.program.command, *self.program.start(self.starts)),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.DEVNULL,
                stderr=stderr,
                env={**os.environ, **self.program.environment},
                start_new_session=True,  # Ctrl-C in a terminal reaches only the parent
                preexec_fn=end_with_parent(),
            )
        finally:
            os.close(stderr)

    def _read_lines(self, pipe: int) -> None:
        """Keep the last lines, and only the end of a very long one."""
        with contextlib.suppress(BlockingIOError):
            while piece := os.read(pipe, _LINE_BYTES):
                *lines, self._line = (self._line + piece).split(b"\n")
                self._line = self._line[-_LINE_BYTES:]
                for line in (line.decode(errors="replace").rstrip() for line in lines):
                    self._last_lines.append(line)
                    if self.program.logs_lines:
                        self._log(f"{self.program.name}: {line}")
            asyncio.get_running_loop().remove_reader(pipe)

    def _last_message(self) -> str:
        """Describe its last line, which need not explain its end: a killed program cannot say why."""
        if begun := self._line.decode(errors="replace").strip():
            return f'its last message, unfinished: "{begun}"'
        line = next((line for line in reversed(self._last_lines) if line), None)
        return "it wrote no message" if line is None else f'its last message: "{line}"'


async def end(process: asyncio.subprocess.Process) -> None:
    """Terminate a process, and kill it if it does not end."""
    if process.returncode is not None:
        return
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    try:
        async with asyncio.timeout(_STOP_S):
            await process.wait()
    except TimeoutError:
        process.kill()
        await process.wait()
