"""A DW1000 as a radio, driven by this process; its port says where the chip is: on SPI, or a model."""

import asyncio
import ctypes
import hashlib
import os
import shlex
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Final, Protocol, TypeVar

from skyless.core.air.frame import Reception, Transmission
from skyless.core.errors import SkylessError
from skyless.core.ticks import TICK_S, difference, from_seconds, wrap
from skyless.radio.interface import AntennaDelays, Gone, Hint, Late, Listener, RadioEvent, Restarted, Sent, ignore
from skyless.radio.serial.link import cycles, from_steps, start_failure

# The DW1000's driver, as the computer at its bus calls it: the C of the firmware in ``c/``, integers only.
#
# ``c/dw1000.h`` says which states there are and what its functions do, ``docs/dw1000.md`` where each register's value
# is from. It has never run on a chip. The machine's C compiler (``CC``, or ``cc``) makes a library of it at the first
# use, in the user's cache folder.

SOURCES: Final = Path(__file__).parent
COMPILED_WITH: Final = ("-std=c11", "-O2", "-fPIC", "-shared")

OFF: Final = 0
IDLE: Final = 1
LISTENING: Final = 2
SENDING: Final = 3
AWAITING: Final = 4
"""States of the chip."""

RECEIVED: Final = 1
SENT: Final = 2
FAILED: Final = 4
CLOCK_SLIPPED: Final = 8
LOST: Final = 16
NOTHING: Final = 32
"""Results of ``poll``: a frame was received; ours was sent; a reception failed; the clock's PLL was losing lock
(stamps around that time are unreliable); the chip does not answer or was reset; no frame came in the window."""

QUEUED: Final = 0
LATE: Final = 1
BUSY: Final = 2
NOT_READY: Final = 3
"""Results of ``transmit_at`` and ``receive_at``: queued; or not, because it was too late, the radio is busy, or the
chip is OFF."""

NOT_MEASURED: Final = -32768
"""Marks a missing measurement."""
NO_PHASE: Final = -1
MIN_PSDU_BYTES: Final = 3
MAX_PSDU_BYTES: Final = 127
"""Including the FCS, which the chip generates and checks (UM p. 80)."""
MAX_TRANSFER_BYTES: Final = 132

Value = TypeVar("Value")


class ChipError(Exception):
    """There is no DW1000 on the bus, or it does not start; the message says what was found."""


class Bus(Protocol):
    """Hardware access of the driver; each method may raise OSError."""

    def transfer(self, out: bytes) -> bytes:
        """One SPI transaction (mode 0): the octets that the chip returns while it receives ``out``."""

    def set_spi_fast(self, fast: bool) -> None:
        """Clock at most 20 MHz, or at most 3 MHz while the chip's PLL is not locked (UM 2.3.2)."""

    def reset_chip(self) -> None:
        """Pull RSTn low for a moment and release it (never drive it high), if it is wired."""

    def pause_us(self, microseconds: int) -> None:
        """Wait at least that long."""


@cache
def library() -> ctypes.CDLL:
    """The driver in C, compiled at its first use.

    Raises:
        SkylessError: there is no compiler, or no folder for its result.
    """
    loaded = ctypes.CDLL(str(_compiled()))
    declare(loaded)
    return loaded


def declare(loaded: ctypes.CDLL) -> None:
    """Declare the types of the driver's functions in a library."""
    for name in ("log10", "accumulated", "power_cdbm", "first_path_cdbm", "carrier_offset_ppb", "micros_until"):
        getattr(loaded, f"dw1000_{name}").restype = ctypes.c_int32
    loaded.dw1000_angle.restype = ctypes.c_uint32
    for name in ("start", "wake", "cancel", "check", "measure"):
        getattr(loaded, f"dw1000_{name}").restype = ctypes.c_bool
    loaded.dw1000_now.restype = ctypes.c_uint64
    loaded.dw1000_micros_until.argtypes = (ctypes.c_uint64, ctypes.c_uint64)
    loaded.dw1000_receive_at.argtypes = (ctypes.c_void_p, ctypes.c_uint64, ctypes.c_uint32)
    loaded.dw1000_transmit_at.argtypes = (ctypes.c_void_p, ctypes.c_uint64, ctypes.c_char_p, ctypes.c_uint32)


def _compiled() -> Path:
    """Path of the library for these sources and this compiler, in the user's cache folder."""
    command = [*shlex.split(os.environ.get("CC", "cc")), *COMPILED_WITH, str(SOURCES / "dw1000.c"), "-o"]
    digest = hashlib.sha256(" ".join(command).encode())
    for path in sorted(SOURCES.glob("*.[ch]")):
        digest.update(path.read_bytes())
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "skyless"
    made = home / f"dw1000-{os.uname().machine}-{digest.hexdigest()[:16]}.so"
    if made.exists():
        return made
    try:
        home.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=home) as folder:
            unfinished = Path(folder) / made.name
            done = subprocess.run([*command, str(unfinished)], capture_output=True, text=True, check=False)
            if done.returncode:
                why = done.stderr.strip().partition("\n")[0]
                raise SkylessError(f"the DW1000's driver does not compile ({command[0]}): {why}")
            unfinished.replace(made)
    except FileNotFoundError:
        raise SkylessError(
            f"the DW1000's driver is compiled at its first use, and there is no C compiler {command[0]}: install one "
            "(Debian, Raspberry Pi OS: sudo apt install gcc libc6-dev)"
        ) from None
    except OSError as error:
        raise SkylessError(
            f"the DW1000's driver cannot be compiled into {home} ({error.strerror}); XDG_CACHE_HOME should name a "
            "folder that may be written"
        ) from None
    return made


class Hardware(ctypes.Structure):
    """The part of ``struct hardware`` (``c/hardware.h``) that the driver calls, backed by a Python object.

    C has no exceptions: the first is kept in ``failure``; from then on nothing is called and C reads zeros.
    """

    _fields_ = (
        ("transfer", ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32)),
        ("set_spi_fast", ctypes.CFUNCTYPE(None, ctypes.c_bool)),
        ("reset_chip", ctypes.CFUNCTYPE(None)),
        ("pause_us", ctypes.CFUNCTYPE(None, ctypes.c_uint32)),
    )

    def __init__(self, bus: Bus) -> None:
        super().__init__()
        self.failure: BaseException | None = None
        self._kept: dict[str, object] = {}

        def transfer(out: int, into: int, size: int) -> None:
            ctypes.memmove(into, self.call(bus.transfer, ctypes.string_at(out, size)) or bytes(size), size)

        self.connect(
            transfer=transfer,
            set_spi_fast=partial(self.call, bus.set_spi_fast),
            reset_chip=partial(self.call, bus.reset_chip),
            pause_us=partial(self.call, bus.pause_us),
        )

    def connect(self, **functions: Callable[..., object]) -> None:
        """Set members of the structure and keep their callables: ctypes drops some if a structure has a base."""
        kinds = dict(field[:2] for kind in type(self).__mro__ for field in vars(kind).get("_fields_", ()))
        for name, function in functions.items():
            self._kept[name] = kinds[name](function)
            setattr(self, name, self._kept[name])

    def call(self, function: Callable[..., Value], *values: object) -> Value | int:
        """Call a function for C; returns 0 after a failure."""
        if self.failure is None:
            try:
                return function(*values)
            except BaseException as error:  # noqa: BLE001 - raised when C has returned
                self.failure = error
        return 0

    def raise_failure(self) -> None:
        """Raise the exception of a function called by C."""
        failure, self.failure = self.failure, None
        if failure is not None:
            raise failure


class DW1000(ctypes.Structure):
    """``struct dw1000`` of ``c/dw1000.h``: one chip. A failing bus leaves it OFF.

    Until the next ``poll``, the last reception is in ``rx_ticks``, ``frame``, ``rx_power_cdbm``, ``first_path_cdbm``,
    ``offset_ppb`` and ``phase``: the carrier's in 2**-16 turns if ``reads_phases`` is set, or NO_PHASE. The stamp of a
    SENT frame is in ``tx_ticks``. ``errors`` counts failed receptions of any kind. ``uses_both_buffers``, set before
    the start of a radio that only listens, keeps the receiver on while a frame is read.
    """

    state: int
    reads_phases: bool
    uses_both_buffers: bool
    received: int
    errors: int
    sent: int
    rx_ticks: int
    rx_power_cdbm: int
    first_path_cdbm: int
    offset_ppb: int
    phase: int
    tx_ticks: int
    temperature_cc: int
    millivolts: int
    start_step: int
    identifier: int
    _fields_ = (
        ("_functions", ctypes.c_void_p),
        ("state", ctypes.c_int),
        ("_is_listening", ctypes.c_bool),
        ("reads_phases", ctypes.c_bool),
        ("uses_both_buffers", ctypes.c_bool),
        *((name, ctypes.c_uint32) for name in ("received", "errors", "sent")),
        ("rx_ticks", ctypes.c_uint64),
        ("_frame", ctypes.c_void_p),
        ("_frame_bytes", ctypes.c_uint32),
        *((name, ctypes.c_int32) for name in ("rx_power_cdbm", "first_path_cdbm", "offset_ppb", "phase")),
        ("tx_ticks", ctypes.c_uint64),
        ("temperature_cc", ctypes.c_int32),
        ("millivolts", ctypes.c_uint32),
        ("start_step", ctypes.c_int),
        *((name, ctypes.c_uint32) for name in ("identifier", "_lock_us", "_clock_slips", "_carrier_slips")),
        *((name, ctypes.c_uint32) for name in ("_temperature_23", "_voltage_33")),
        ("_status", ctypes.c_uint64),
        *((name, ctypes.c_uint8 * MAX_TRANSFER_BYTES) for name in ("_out", "_into", "_frame_into")),
    )

    def __init__(self, bus: Bus) -> None:
        super().__init__()
        self._hardware = Hardware(bus)
        library().dw1000_init(ctypes.byref(self), ctypes.byref(self._hardware))

    @property
    def frame(self) -> bytes:
        """The last received frame."""
        return ctypes.string_at(self._frame, self._frame_bytes)

    def _call(self, name: str, *values: object) -> int:
        result: int = getattr(library(), f"dw1000_{name}")(ctypes.byref(self), *values)
        if self._hardware.failure is not None:
            self.state = OFF
            self._hardware.raise_failure()
        return result

    def start(self, tx_delay_ticks: int, rx_delay_ticks: int) -> None:
        """Reset and configure the chip; antenna delays of 16 bits.

        Raises:
            ChipError: no DW1000 answers, or its clock does not lock.
        """
        if not self._call("start", tx_delay_ticks, rx_delay_ticks):
            raise ChipError(start_failure(self.start_step, self.identifier))

    def receive(self) -> None:
        """Listen from now on; a queued frame is sent first."""
        self._call("receive")

    def idle(self) -> None:
        """Turn the receiver off; a queued frame is sent first."""
        self._call("idle")

    def receive_at(self, ticks: int, window: int) -> int:
        """Listen for one frame from ``ticks`` on, for ``window`` · 65536 ticks. Returns QUEUED, or why not."""
        return self._call("receive_at", ticks, window)

    def sleep(self) -> None:
        """Put the chip to sleep: it is OFF until ``wake``."""
        self._call("sleep")

    def wake(self, tx_delay_ticks: int, rx_delay_ticks: int) -> bool:
        """Wake and configure a sleeping chip. Returns False if none answers."""
        return bool(self._call("wake", tx_delay_ticks, rx_delay_ticks))

    def transmit_at(self, dx_ticks: int, frame: bytes) -> int:
        """Send a PSDU when the counter is at ``dx_ticks``. Returns QUEUED, or why not.

        The low nine bits are ignored (UM p. 26). The stamp will be ``dx_ticks`` plus the TX antenna delay. The chip
        replaces the last two bytes of the frame by the FCS. Poll before, or a frame that has just arrived is lost.

        Raises:
            ValueError: no PSDU has this length.
        """
        if not MIN_PSDU_BYTES <= len(frame) <= MAX_PSDU_BYTES:
            raise ValueError("a PSDU has 3 to 127 bytes")
        return self._call("transmit_at", dx_ticks, frame, len(frame))

    def cancel(self) -> bool:
        """Cancel an unsent frame. Returns False if it has been sent, which the next ``poll`` reports."""
        return bool(self._call("cancel"))

    def poll(self) -> int:
        """Events since the last call: a sum of RECEIVED, SENT, FAILED, CLOCK_SLIPPED, LOST; 0 for none.

        Call when the interrupt line is high, or periodically. The receiver is on again afterwards.
        """
        return self._call("poll")

    def check(self) -> bool:
        """Whether the chip still has its configuration; otherwise it is OFF.

        A chip whose supply failed may lock again unnoticed and never report anything, so call this periodically while
        nothing is received.
        """
        return bool(self._call("check"))

    def now(self) -> int:
        """The counter now, in steps of 512 ticks (UM 7.2.8)."""
        return self._call("now")

    def measure(self) -> bool:
        """Measure ``temperature_cc`` and ``millivolts`` in about 1.1 ms, during which nothing is received."""
        return bool(self._call("measure"))


OVERDUE_TICKS: Final = from_seconds(1e-3)
"""A frame whose end is not reported within this time after its RMARKER is cancelled."""
CHECK_S: Final = 1.0
"""A chip silent for this time is asked whether it still has its settings."""

SPI_LEAD_S: Final = 1.5e-3
"""The preamble, seven transfers of up to 0.1 ms, a reception that is served before, and a host's timers
(``benchmarks/host_latency.py``)."""

_FAILURES: Final = {FAILED: "rx-error", CLOCK_SLIPPED: "clock-slipped"}


class ChipSession:
    """One chip from start to loss. Its only I/O is the driver's bus; no clock."""

    def __init__(
        self, bus: Bus, delays: AntennaDelays, listener: Listener, counters: Counter[str], *, phases: bool = False
    ) -> None:
        """``phases``: receptions include carrier phases."""
        self.driver = DW1000(bus)
        self.driver.reads_phases = phases
        self._delays, self._listener, self._counters = delays, listener, counters
        self._pending: int | None = None
        self.idle = False
        """Whether the chip had no event when last served."""

    def start(self) -> None:
        """Reset and configure the chip, and listen. Raises ChipError if no DW1000 answers."""
        self._pending = None
        self.driver.start(self._delays.tx_ticks, self._delays.rx_ticks)
        self.driver.receive()

    def read_ticks(self) -> int | None:
        """The chip's counter, read over the bus; None for a chip that is off."""
        return None if self.driver.state == OFF else self.driver.now()

    @property
    def overdue_ticks(self) -> int | None:
        """Counter reading at which to call ``cancel_overdue``; None if no frame is queued."""
        return None if self._pending is None else wrap(self._pending + OVERDUE_TICKS)

    def transmit(self, transmission: Transmission, host_s: float | None = None) -> None:
        """Queue a frame for its tick; a frame just received is read first."""
        self.serve(host_s)
        dx_ticks = wrap(transmission.tx_ticks - self._delays.tx_ticks)
        if self.driver.transmit_at(dx_ticks, transmission.frame) == QUEUED:
            self._pending = transmission.tx_ticks
        else:
            self._listener(Late(transmission.tx_ticks))

    def serve(self, host_s: float | None = None) -> bool:
        """Process the chip's events; False when it has lost its settings and must be started again.

        ``host_s`` is what receptions carry as the host's time.
        """
        driver = self.driver
        events = driver.poll()
        self.idle = events == 0
        if events & LOST:
            self._counters["chip-lost"] += 1
            return False
        for event, reason in _FAILURES.items():
            if events & event:
                self._counters[reason] += 1
        if events & SENT:
            self._on_sent()
        if events & RECEIVED:
            measured = from_steps(driver.rx_power_cdbm, driver.first_path_cdbm, driver.offset_ppb)
            phase_cycles = None if driver.phase == NO_PHASE else cycles(driver.phase)
            self._listener(Reception(driver.frame, driver.rx_ticks, host_s, measured, phase_cycles))
        return True

    def is_alive(self) -> bool:
        """Ask a chip from which nothing has come whether it still has its settings."""
        alive = self.driver.check()
        self._counters["chip-lost"] += not alive
        return alive

    def _on_sent(self) -> None:
        tx_ticks, self._pending = self._pending, None
        if tx_ticks is None:
            return
        if self.driver.tx_ticks != tx_ticks:
            self._counters["sent-at-another-time"] += 1
        self._listener(Sent(tx_ticks))

    def cancel_overdue(self) -> None:
        """Cancel a frame whose end has not been reported."""
        if self._pending is None or not self.serve() or self._pending is None:
            return
        if self.driver.cancel():
            tx_ticks, self._pending = self._pending, None
            self._counters["sending-given-up"] += 1
            self._listener(Late(tx_ticks))
        else:
            self.serve()


class Port(Protocol):
    """Where a chip is."""

    async def run(self, radio: "Dw1000Radio") -> None:
        """Find the chip, and find it again when it is lost, until cancelled; call the radio with its events."""


class Dw1000Radio:
    """One node's chip (``skyless.radio.interface.Radio``)."""

    def __init__(self, port: Port, name: str, delays: AntennaDelays, *, phases: bool = False) -> None:
        """``phases``: receptions have the phase of their carrier.

        Raises SkylessError where the driver cannot be compiled.
        """
        library()
        self.name = name
        self.counters: Counter[str] = Counter()
        self.lead_s = SPI_LEAD_S
        self._port, self._delays, self._phases = port, delays, phases
        self._listener: Listener = ignore
        self._session: ChipSession | None = None
        self._reported = ""
        """The reason of the newest ``Gone``; empty once the chip works."""
        self._active = False
        """Whether the chip had an event since the last check."""
        self._hinted: set[str] = set()
        self._trouble: Exception | None = None
        self._timer: asyncio.TimerHandle | None = None

    async def run(self, listener: Listener) -> None:
        """Receive until cancelled; a chip that does not answer is looked for."""
        self._listener = listener
        checks = asyncio.ensure_future(self._check())
        try:
            await self._port.run(self)
        finally:
            checks.cancel()
            self._end_session()

    def advice(self) -> str:
        """Where to look when nothing comes though the chip answers."""
        return "the DW1000 answers, but receives no frame: are anchors on the air, is its antenna free?"

    def now_ticks(self) -> int | None:
        """The chip's counter, read over the bus; None while it is not ready."""
        try:
            return None if self._session is None else self._session.read_ticks()
        except OSError:
            return None

    def transmit(self, transmission: Transmission) -> None:
        """Send a frame; without a chip it is late."""
        session = self._session
        if session is None:
            self._listener(Late(transmission.tx_ticks))
            return
        try:
            session.transmit(transmission, time.monotonic())
            self._set_timer(session)
        except OSError as error:
            self._fail(error)
            self._listener(Late(transmission.tx_ticks))

    def _set_timer(self, session: ChipSession) -> None:
        """For a frame whose end is not reported."""
        overdue, now = session.overdue_ticks, session.read_ticks()
        if overdue is not None and now is not None:
            if self._timer is not None:
                self._timer.cancel()
            wait_s = max(difference(overdue, now) * TICK_S, 0.0)
            self._timer = asyncio.get_running_loop().call_later(wait_s, self._on_overdue, session)

    def _on_overdue(self, session: ChipSession) -> None:
        overdue, now = session.overdue_ticks, self.now_ticks()
        if session is self._session and overdue is not None and now is not None and difference(now, overdue) >= 0:
            try:
                session.cancel_overdue()
            except OSError as error:
                self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Let ``serve`` raise the error, so that the port looks for the chip again."""
        self._session, self._trouble = None, error

    async def _check(self) -> None:
        """Check a silent chip: one whose supply failed may have started again without an event."""
        while True:
            await asyncio.sleep(CHECK_S)
            session, self._active = self._session if not self._active else None, False
            try:
                if session is not None and not session.is_alive():
                    self._restart(session)
            except (OSError, ChipError) as error:
                self._fail(error)

    def _restart(self, session: ChipSession) -> None:
        self._report_gone("the DW1000 has lost its configuration; is its supply good?")
        session.start()
        self._session = session
        self._listener(Restarted())

    def _report_gone(self, reason: str) -> None:
        self._session = None
        if reason != self._reported:
            self._reported = reason
            self._listener(Gone(reason))

    def _end_session(self) -> None:
        self._session = None
        if self._timer is not None:
            self._timer.cancel()

    def _on_event(self, event: RadioEvent) -> None:
        self._active = True
        self._listener(event)

    # What the port calls

    def begin(self, bus: Bus) -> None:
        """Start the chip that has been found. Raises OSError and ChipError."""
        self._end_session()
        self._trouble = None
        session = ChipSession(bus, self._delays, self._on_event, self.counters, phases=self._phases)
        session.start()
        self._session, self._reported = session, ""
        self._listener(Restarted())

    def serve(self) -> bool:
        """Process the chip's events. Returns False if there were none. Restarts a chip that has lost its settings.

        Raises OSError and ChipError.
        """
        trouble, self._trouble = self._trouble, None
        if trouble is not None:
            raise trouble
        session = self._session
        if session is not None and not session.serve(time.monotonic()):
            self._restart(session)
        return session is not None and not session.idle

    def report_fault(self, counter: str, text: str) -> None:
        """Count a wiring fault, and report it once."""
        self.counters[counter] += 1
        if counter not in self._hinted:
            self._hinted.add(counter)
            self._listener(Hint(text))

    def end(self, reason: str) -> None:
        """The chip is out of reach; each reason is reported once."""
        self._end_session()
        self._report_gone(reason)
