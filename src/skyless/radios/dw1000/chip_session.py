"""A DW1000 as a radio: its driver between events and transmissions. No I/O but the driver's bus, no clock."""

from collections import Counter
from typing import Final

from skyless.air.reception import Diagnostics, Reception, Transmission
from skyless.firmware import dw1000
from skyless.firmware.dw1000 import DW1000, Bus
from skyless.radios.interface import AntennaDelays, Late, Listener, Sent
from skyless.ticks import from_seconds, wrap

OVERDUE_TICKS: Final = from_seconds(1e-3)
"""When a frame whose end has not been told so long after its RMARKER is taken back."""
_FAILURES: Final = {dw1000.FAILED: "rx-error", dw1000.CLOCK_SLIPPED: "clock-slipped"}


class ChipSession:
    """One chip from its start until it is lost."""

    def __init__(self, bus: Bus, delays: AntennaDelays, tell: Listener, counters: Counter[str]) -> None:
        self.driver = DW1000(bus)
        self._delays, self._tell, self._counters = delays, tell, counters
        self._pending: int | None = None
        self.idle = False
        """Whether the chip had nothing to tell when it was last served."""

    def start(self) -> None:
        """Reset and configure the chip, and listen.

        Raises:
            ChipError: no DW1000 answers.
        """
        self._pending = None
        self.driver.start(self._delays.tx_ticks, self._delays.rx_ticks)
        self.driver.receive()

    def read_ticks(self) -> int | None:
        """The chip's counter now, over the bus; None for a chip that is off."""
        return None if self.driver.state == dw1000.OFF else _ticks(self.driver.now())

    @property
    def overdue_ticks(self) -> int | None:
        """Reading of the counter at which to call ``give_up``; None while no frame waits."""
        return None if self._pending is None else wrap(self._pending + OVERDUE_TICKS)

    def transmit(self, transmission: Transmission, host_s: float | None = None) -> None:
        """Have a frame sent at its tick; what has just been received is taken before."""
        self.serve(host_s)
        dx = bytearray(wrap(transmission.tx_ticks - self._delays.tx_ticks).to_bytes(5, "little"))
        frame = bytearray(transmission.frame)
        if self.driver.transmit_at(dx, frame, 0, len(frame)) == dw1000.QUEUED:
            self._pending = transmission.tx_ticks
        else:
            self._tell(Late(transmission.tx_ticks))

    def serve(self, host_s: float | None = None) -> bool:
        """Take what the chip has to tell; False when it has forgotten everything and must be started again.

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
            self._sent()
        if events & dw1000.RECEIVED:
            frame = bytes(driver.frame[: driver.frame_bytes])
            self._tell(Reception(frame, _ticks(driver.rx_ticks), host_s, self._diagnostics()))
        return True

    def is_alive(self) -> bool:
        """Ask a chip from which nothing has come for long whether it still has its settings."""
        alive = self.driver.check()
        self._counters["chip-lost"] += not alive
        return alive

    def _sent(self) -> None:
        tx_ticks, self._pending = self._pending, None
        if tx_ticks is None:
            return
        if _ticks(self.driver.tx_ticks) != tx_ticks:
            self._counters["sent-at-another-time"] += 1
        self._tell(Sent(tx_ticks))

    def _diagnostics(self) -> Diagnostics:
        driver = self.driver
        return Diagnostics(
            _value(driver.rx_power_cdbm, 100), _value(driver.first_path_cdbm, 100), _value(driver.offset_ppb, 1000)
        )

    def give_up(self) -> None:
        """Take back a frame of which nothing has been heard."""
        if self._pending is None or not self.serve() or self._pending is None:
            return
        if self.driver.cancel():
            tx_ticks, self._pending = self._pending, None
            self._counters["sending-given-up"] += 1
            self._tell(Late(tx_ticks))
        else:
            self.serve()


def _ticks(stamp: memoryview) -> int:
    return int.from_bytes(stamp, "little")


def _value(told: int, steps: int) -> float | None:
    return None if told == dw1000.NOT_MEASURED else told / steps
