"""The chip as its host sees it: SPI transactions, an interrupt line and a reset pin."""

from collections import Counter
from collections.abc import Callable

from skyless.air.reception import Diagnostics
from skyless.simulation.dw1000 import bits
from skyless.simulation.dw1000 import registers as r
from skyless.simulation.dw1000.clocking import Clocking
from skyless.simulation.dw1000.measures import Senses
from skyless.simulation.dw1000.memory import Access, Memory, decode_header
from skyless.simulation.dw1000.reception import Fault, arrive
from skyless.simulation.dw1000.transceiver import Air, Transceiver
from skyless.ticks import wrap

_STEP_MASK = ~0x1FF
"""SYS_TIME steps by 512 ticks (UM 7.2.8)."""


class Chip:
    """One DW1000 with its antenna in an air. ``seconds`` is a clock for what has nothing to do with the air."""

    def __init__(
        self,
        air: Air,
        tx_delay_ticks: int,
        rx_delay_ticks: int,
        seconds: Callable[[], float],
        senses: Senses | None = None,
    ) -> None:
        """The delays are what truly lies between chip and antenna, whatever the host sets."""
        self.misuse: Counter[str] = Counter()
        """What the manual forbids and the host did."""
        self.arrivals: Counter[str] = Counter()
        """What became of the frames that were there to be heard."""
        self._air, self._rx_delay_ticks = air, rx_delay_ticks
        self.memory = Memory(self.misuse)
        self.clocking = Clocking(self.memory, self.misuse, seconds, senses or Senses())
        self.transceiver = Transceiver(self.memory, air, tx_delay_ticks, self.misuse)
        self.transfers = 0
        self._powered_on()

    def _powered_on(self) -> None:
        self.transceiver.reset()
        self.memory.reset()
        self.clocking.in_reset = False
        self.clocking.restart()
        self._lock_told = False
        self.memory.put(r.SYS_STATUS, bits.SLP2INIT)

    # Pins

    def pull_reset(self) -> None:
        """RSTn was low for a moment."""
        self._powered_on()

    @property
    def irq(self) -> bool:
        """The interrupt line: an event that SYS_MASK lets through, with the polarity of SYS_CFG."""
        self._settle()
        return self._is_pending() == bool(self.memory.get(r.SYS_CFG) & bits.HIRQ_POL)

    def _is_pending(self) -> bool:
        return bool(self.memory.get(r.SYS_STATUS) & self.memory.get(r.SYS_MASK) & ~bits.IRQS)

    # SPI

    def transfer(self, out: bytes, hz: int) -> bytes:
        """One transaction: what the chip says while it is told ``out``, as many octets."""
        self.transfers += 1
        access = decode_header(out)
        if access is None:
            self.misuse["transaction-without-header"] += 1
            return bytes(len(out))
        if not self.clocking.takes(hz):
            self.misuse["spi-too-fast"] += 1
            return self._garbled(access, len(out))
        self._settle()
        body = out[access.octets :]
        if access.is_write:
            self._write(access, body)
            return bytes(len(out))
        return bytes(access.octets) + self._read(access, len(body))

    def _garbled(self, access: Access, length: int) -> bytes:
        """Bits are lost on the way: what is read is shifted by one, what is written does not arrive."""
        if access.is_write:
            return bytes(length)
        right = int.from_bytes(self.memory.read(access.file, access.sub, length - access.octets), "big")
        return (right << 1 | 1).to_bytes(length + 1, "big")[1:]

    def _settle(self) -> None:
        if self.clocking.in_reset:
            return
        self.transceiver.settle()
        if self.clocking.pll_has_locked and not self._lock_told:
            self._lock_told = True
            self.transceiver.raise_bits(bits.CPLOCK)

    _lock_told = False

    def _read(self, access: Access, length: int) -> bytes:
        if access.file == r.SYS_TIME.file:
            self.memory.put(r.SYS_TIME, self._air.now_ticks() & _STEP_MASK)
        elif access.file == r.SYS_STATUS.file:
            status = self.memory.get(r.SYS_STATUS) & ~bits.IRQS
            self.memory.put(r.SYS_STATUS, status | (bits.IRQS if self._is_pending() else 0))
        elif access.file == r.TX_BUFFER.file:
            self.misuse["tx-buffer-read"] += 1  # UM p. 77
            return bytes(length)
        elif access.file == r.SYS_CTRL.file:
            return bytes(length)  # its bits clear themselves
        return self.memory.read(access.file, access.sub, length)

    def _write(self, access: Access, data: bytes) -> None:
        if self.clocking.in_reset and access.file != r.PMSC.file:
            self.misuse["write-in-reset"] += 1
        elif access.file == r.SYS_STATUS.file:
            value = int.from_bytes(data, "little") << 8 * access.sub
            self.transceiver.drop_bits(value & ~bits.READ_ONLY)
        elif access.file == r.SYS_CTRL.file:
            self._command(int.from_bytes(data, "little") << 8 * access.sub)
        else:
            self.memory.write(access.file, access.sub, data)
            self._follow(access, len(data))

    def _command(self, control: int) -> None:
        if control & (bits.TXSTRT | bits.RXENAB) and not self.clocking.locked:
            self.misuse["radio-without-pll"] += 1
        else:
            self.transceiver.command(control)

    def _follow(self, access: Access, length: int) -> None:
        """Do what writing these registers does."""
        if access.file == r.PMSC.file and access.sub < 4:
            kind = self.clocking.write_pmsc()
            if kind == bits.SOFTRESET_ALL:
                self._soft_reset()
            elif kind == bits.SOFTRESET_RX:
                self.transceiver.listening_since = None
                self.transceiver.suspect = False
        elif access.file == r.OTP_IF.file and access.sub < r.OTP_CTRL.sub + 2 and access.sub + length > r.OTP_CTRL.sub:
            self.clocking.write_otp()
        elif access.file == r.TX_CAL.file and access.sub == 0:
            self.clocking.write_sensor()

    def _soft_reset(self) -> None:
        """All registers but the bits that hold the chip in reset (UM 7.2.50.1)."""
        self.transceiver.reset()
        self.memory.reset()
        self.memory.put(r.PMSC_CTRL0, r.PMSC_CTRL0.reset & ~(0xF << bits.SOFTRESET_SHIFT))
        self.memory.put(r.SYS_STATUS, bits.SLP2INIT)
        self._lock_told = False

    # The air

    def hear(self, frame: bytes, rx_ticks: int, told: Diagnostics, fault: Fault | None = None) -> str:
        """A frame has ended whose RMARKER reached the antenna at ``rx_ticks`` of the counter; what became of it."""
        self._settle()
        ticks, microcode = wrap(rx_ticks + self._rx_delay_ticks), self.clocking.microcode_loaded
        outcome = arrive(self.memory, self.transceiver, frame, ticks, told, microcode=microcode, fault=fault)
        self.arrivals[outcome] += 1
        return outcome
