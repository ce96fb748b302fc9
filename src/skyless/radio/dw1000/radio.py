"""A DW1000 as a radio, driven by this process; its port says where the chip is: on SPI, or a model of one."""

import asyncio
import time
from collections import Counter
from typing import Final, Protocol

from skyless.core.air.frame import Reception, Transmission
from skyless.core.ticks import TICK_S, difference, from_seconds, wrap
from skyless.radio.dw1000 import driver as dw1000
from skyless.radio.dw1000.driver import DW1000, Bus, ChipError
from skyless.radio.interface import AntennaDelays, Gone, Hint, Late, Listener, RadioEvent, Restarted, Sent, ignore
from skyless.radio.serial.link import cycles, from_steps

OVERDUE_TICKS: Final = from_seconds(1e-3)
"""A frame whose end is not reported within this time after its RMARKER is cancelled."""
CHECK_S: Final = 1.0
"""A chip from which nothing came for this time is asked whether it still has its settings."""

SPI_LEAD_S: Final = 1.5e-3
"""The preamble, seven transfers of up to 0.1 ms, a reception that is served before, and a host's timers
(``benchmarks/host_latency.py``)."""

_FAILURES: Final = {dw1000.FAILED: "rx-error", dw1000.CLOCK_SLIPPED: "clock-slipped"}


class ChipSession:
    """One chip from its start until it is lost. No I/O but the driver's bus, no clock."""

    def __init__(
        self,
        bus: Bus,
        delays: AntennaDelays,
        listener: Listener,
        counters: Counter[str],
        *,
        phases: bool = False,
    ) -> None:
        """``phases``: receptions have the phase of their carrier."""
        self.driver = DW1000(bus)
        self.driver.reads_phases = phases
        self._delays, self._listener, self._counters = delays, listener, counters
        self._pending: int | None = None
        self.idle = False
        """Whether the chip had no event when it was last served."""

    def start(self) -> None:
        """Reset and configure the chip, and listen.

        Raises:
            ChipError: no DW1000 answers.
        """
        self._pending = None
        self.driver.start(self._delays.tx_ticks, self._delays.rx_ticks)
        self.driver.receive()

    def read_ticks(self) -> int | None:
        """The chip's counter, read over the bus; None for a chip that is off."""
        return None if self.driver.state == dw1000.OFF else self.driver.now()

    @property
    def overdue_ticks(self) -> int | None:
        """Reading of the counter at which to call ``cancel_overdue``; None while no frame waits."""
        return None if self._pending is None else wrap(self._pending + OVERDUE_TICKS)

    def transmit(self, transmission: Transmission, host_s: float | None = None) -> None:
        """Have a frame sent at its tick; a frame that has just been received is read first."""
        self.serve(host_s)
        dx_ticks = wrap(transmission.tx_ticks - self._delays.tx_ticks)
        if self.driver.transmit_at(dx_ticks, transmission.frame) == dw1000.QUEUED:
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
        if events & dw1000.LOST:
            self._counters["chip-lost"] += 1
            return False
        for event, reason in _FAILURES.items():
            if events & event:
                self._counters[reason] += 1
        if events & dw1000.SENT:
            self._on_sent()
        if events & dw1000.RECEIVED:
            measured = from_steps(driver.rx_power_cdbm, driver.first_path_cdbm, driver.offset_ppb)
            phase_cycles = None if driver.phase == dw1000.NO_PHASE else cycles(driver.phase)
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
        dw1000.library()
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
        """Process the chip's events, False if there were none; start a chip again that has lost its settings.

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
        """Count a fault of the wiring, and report it once."""
        self.counters[counter] += 1
        if counter not in self._hinted:
            self._hinted.add(counter)
            self._listener(Hint(text))

    def end(self, reason: str) -> None:
        """The chip is out of reach; each reason is reported once."""
        self._end_session()
        self._report_gone(reason)
