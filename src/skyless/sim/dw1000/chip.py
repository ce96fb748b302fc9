"""A register-level model of the DW1000 behind its SPI, on the emulated air (DW1000 User Manual v2.12).

This file: the chip as its host sees it, with clocks, reset, microcode, one-time memory and sensors, and a driver's bus.
"""

from collections import Counter
from collections.abc import Callable
from typing import Final

from msgspec import Struct

from skyless.core.air.frame import Diagnostics
from skyless.core.ticks import TICK_S, wrap
from skyless.sim.dw1000 import registers as r
from skyless.sim.dw1000.registers import Access, Memory, decode_header
from skyless.sim.dw1000.transceiver import Air, Fault, Transceiver

_STEP_MASK: Final = ~0x1FF
"""SYS_TIME steps by 512 ticks (UM 7.2.8)."""

_SLOW_HZ: Final = 2_000_000
_FAST_HZ: Final = 16_000_000
"""Rates at which the bus clocks the SPI."""

_LOCK_S: Final = 15e-6
"""Time for the PLL to lock after a reset; the manual guarantees no figure, drivers wait for CPLOCK."""
_LOAD_S: Final = 150e-6
"""Time to load the microcode (UM 2.5.5.10: table 4)."""
_MAX_CRYSTAL_HZ: Final = 3_000_000
"""Fastest SPI while the chip runs on the crystal (UM 2.3.2: INIT)."""
_MAX_PLL_HZ: Final = 20_000_000

_SELECTED_S: Final = 500e-6
"""Time for which chip select must be low to wake a sleeping chip (UM 2.3, p. 17)."""
_WAKE_S: Final = 4e-3
"""Time until it answers then: its crystal has to start (assumed; the data sheet gives some 3 ms)."""

RECEIVING_A: Final = 134e-3
IDLE_A: Final = 18e-3
ASLEEP_A: Final = 10e-6
"""What a DWM1001 draws, by the state of its chip; transmissions count as idle."""

_TEMPERATURE_STEP_C: Final = 1.14
_REFERENCE_C: Final = 23.0
_STEPS_PER_V: Final = 173.0
_REFERENCE_V: Final = 3.3
"""UM pp. 158-159; the readings at these references are in the OTP."""


class Sensors(Struct, frozen=True):
    """Temperature and supply of a chip, and its factory calibration."""

    temperature_c: float = 31.0
    supply_v: float = 3.3
    reading_at_23_c: int = 0x7E
    reading_at_3_3_v: int = 0x6C
    crystal_trim: int = 0x11
    part: int = 0x10205EAD

    def readings(self) -> tuple[int, int]:
        """SAR_LVBAT and SAR_LTEMP (UM 7.2.43.2)."""
        volts = round((self.supply_v - _REFERENCE_V) * _STEPS_PER_V) + self.reading_at_3_3_v
        kelvins = round((self.temperature_c - _REFERENCE_C) / _TEMPERATURE_STEP_C) + self.reading_at_23_c
        return min(max(volts, 0), 255), min(max(kelvins, 0), 255)

    def otp(self) -> dict[int, int]:
        """Words of the one-time programmable memory that are not 0 (UM 6.3.1)."""
        return {
            0x006: self.part,
            0x007: 0x4C4F5431,
            0x008: self.reading_at_3_3_v | 0xB0 << 8,
            0x009: self.reading_at_23_c | 0x8E << 8,
            0x01E: self.crystal_trim,
        }


class Clocking:
    """Preconditions of sending and receiving. ``seconds`` is any monotonic clock."""

    def __init__(self, memory: Memory, misuse: Counter[str], seconds: Callable[[], float], sensors: Sensors) -> None:
        self._memory, self._misuse, self._seconds, self.sensors = memory, misuse, seconds, sensors
        self._lock_s = seconds() + _LOCK_S
        self._loaded_s: float | None = None
        self.in_reset = False

    def restart(self) -> None:
        """Return to the state after power-on or reset: nothing is loaded, the PLL starts to lock."""
        self._loaded_s = None
        self._lock_s = self._seconds() + _LOCK_S

    @property
    def locked(self) -> bool:
        """Whether the chip runs on its PLL."""
        forced = self._memory.get(r.PMSC_CTRL0) & r.SYSCLKS == r.SYSCLKS_XTI
        return not forced and self.pll_has_locked

    @property
    def pll_has_locked(self) -> bool:
        """CPLOCK: the PLL may have locked while the crystal is still forced."""
        return not self.in_reset and self._seconds() >= self._lock_s

    @property
    def microcode_loaded(self) -> bool:
        """Whether the leading-edge search works."""
        return self._loaded_s is not None and self._seconds() >= self._loaded_s

    def accepts(self, hz: int) -> bool:
        """Whether a transfer at this rate arrives intact."""
        return hz <= (_MAX_PLL_HZ if self.locked else _MAX_CRYSTAL_HZ)

    def on_pmsc_written(self) -> int | None:
        """Apply PMSC_CTRL0. Returns SOFTRESET if it resets something."""
        kind = self._memory.get(r.PMSC_CTRL0) >> r.SOFTRESET_SHIFT
        if kind == r.SOFTRESET_ALL and not self.in_reset:
            if self._memory.get(r.PMSC_CTRL0) & r.SYSCLKS != r.SYSCLKS_XTI:
                self._misuse["reset-not-on-crystal"] += 1  # UM 7.2.50.1
            self.in_reset = True
            return kind
        if kind == r.SOFTRESET_NONE and self.in_reset:
            self.in_reset = False
            self.restart()
        return kind if kind == r.SOFTRESET_RX else None

    def on_otp_written(self) -> None:
        """Apply OTP_CTRL: read a word, or load the microcode (UM 6.3.2, 2.5.5.10)."""
        control = self._memory.get(r.OTP_CTRL)
        if control & r.OTPREAD:
            self._memory.set(r.OTP_RDAT, self.sensors.otp().get(self._memory.get(r.OTP_ADDR) & 0x7FF, 0))
        if control & r.LDELOAD:
            if self._memory.get(r.PMSC_CTRL0) & 0xFFFF == r.PMSC_FOR_LDE:
                self._loaded_s = self._seconds() + _LOAD_S
            else:
                self._misuse["microcode-without-its-clock"] += 1
        self._memory.set(r.OTP_CTRL, control & ~(r.OTPREAD | r.LDELOAD))  # they clear themselves

    def on_sensor_written(self) -> None:
        """Apply TC_SARC: its bit 0 lets the converter sample (UM 6.4, 7.2.43.1)."""
        memory = self._memory
        ready = memory.get(r.RF_SENSOR_1) == 0x80 and memory.get(r.RF_SENSOR_2) == 0x0F
        if memory.get(r.TC_SARC) & 1 and ready:
            volts, kelvins = self.sensors.readings()
            memory.set(r.TC_SARL, volts | kelvins << 8)


class Chip:
    """One DW1000 with its antenna in an air. ``seconds`` is a clock for everything that does not concern the air."""

    def __init__(
        self,
        air: Air,
        tx_delay_ticks: int,
        rx_delay_ticks: int,
        seconds: Callable[[], float],
        sensors: Sensors | None = None,
    ) -> None:
        """``tx_delay_ticks``, ``rx_delay_ticks``: the true antenna delays, independent of the host's settings."""
        self.misuse: Counter[str] = Counter()
        """Violations of the manual by the host."""
        self.arrivals: Counter[str] = Counter()
        """Outcomes of the frames that reached the antenna."""
        self.on_wake: Callable[[], None] = lambda: None
        """Called when it wakes: the counter restarts, and the crystal may have another rate; both belong to the air."""
        self._air, self._rx_delay_ticks, self._seconds = air, rx_delay_ticks, seconds
        self._begin_s, self._slept_s = seconds(), 0.0
        self._asleep_since_s: float | None = None
        self._awake_s = 0.0
        self.memory = Memory(self.misuse)
        self.clocking = Clocking(self.memory, self.misuse, seconds, sensors or Sensors())
        self.transceiver = Transceiver(self.memory, air, tx_delay_ticks, self.misuse)
        self.pull_reset()

    # Pins

    def power_cycle(self) -> None:
        """The supply has failed and returned."""
        self._slept_s, self._asleep_since_s = self.asleep_s, None
        self.pull_reset()

    def pull_reset(self) -> None:
        """RSTn was low for a moment; as after power-on. A sleeping chip ignores it (assumed)."""
        if self._asleep_since_s is not None:
            self.misuse["reset-while-asleep"] += 1
            return
        self.transceiver.reset()
        self.memory.reset()
        self.clocking.in_reset = False
        self.clocking.restart()
        self._lock_shown = False
        self.memory.set(r.SYS_STATUS, r.SLP2INIT)

    def select(self, seconds: float) -> None:
        """Chip select was low for this time, which wakes a sleeping chip if it is long enough."""
        if self._asleep_since_s is not None and seconds >= _SELECTED_S:
            self.on_wake()
            self.power_cycle()
            self._awake_s = self._seconds() + _WAKE_S

    def _sleep(self) -> None:
        """SAVE with SLEEP_EN: all registers are lost (UM 2.3; the configuration is not restored here)."""
        config = self.memory.get(r.AON_CFG0)
        if self.transceiver.listening_since is not None or self.transceiver.sending is not None:
            self.misuse["sleep-while-busy"] += 1
        if not config & r.WAKE_SPI:
            self.misuse["sleep-without-end"] += 1
        if self.memory.get(r.AON_CFG1) & r.SLEEP_CEN or self.memory.get(r.AON_WCFG):
            self.misuse["sleep-with-counter-or-restoration"] += 1
        self.pull_reset()
        self.memory.set(r.SYS_STATUS, 0)
        self._asleep_since_s = self._seconds()

    @property
    def receiving_s(self) -> float:
        """Total time that the receiver has been on."""
        self.transceiver.update()
        return self.transceiver.receiving_ticks * TICK_S

    @property
    def asleep_s(self) -> float:
        """Total time that the chip has slept."""
        return self._slept_s + (0.0 if self._asleep_since_s is None else self._seconds() - self._asleep_since_s)

    @property
    def charge_c(self) -> float:
        """Charge drawn by the module since power-on."""
        receiving_s, asleep_s = self.receiving_s, self.asleep_s
        idle_s = self._seconds() - self._begin_s - receiving_s - asleep_s
        return RECEIVING_A * receiving_s + IDLE_A * idle_s + ASLEEP_A * asleep_s

    @property
    def irq(self) -> bool:
        """The interrupt line: an event enabled in SYS_MASK, with the polarity of SYS_CFG."""
        if self._asleep_since_s is not None:
            return False
        self._update()
        return self._is_pending() == bool(self.memory.get(r.SYS_CFG) & r.HIRQ_POL)

    def _is_pending(self) -> bool:
        return bool(self.memory.get(r.SYS_STATUS) & self.memory.get(r.SYS_MASK) & ~r.IRQS)

    # SPI

    def transfer(self, out: bytes, hz: int) -> bytes:
        """One transaction: the octets that the chip returns while it receives ``out``."""
        if self._asleep_since_s is not None or self._seconds() < self._awake_s:
            if self._asleep_since_s is None or 8 * len(out) / hz < _SELECTED_S:
                self.misuse["spi-while-asleep"] += 1
            self.select(8 * len(out) / hz)
            return bytes(len(out))
        access = decode_header(out)
        if access is None:
            self.misuse["transaction-without-header"] += 1
            return bytes(len(out))
        if not self.clocking.accepts(hz):
            self.misuse["spi-too-fast"] += 1
            if access.is_write:  # and is lost; reads are shifted by a bit
                return bytes(len(out))
            right = int.from_bytes(self.memory.read(access.file, access.sub, len(out) - access.octets), "big")
            return (right << 1 | 1).to_bytes(len(out) + 1, "big")[1:]
        self._update()
        body = out[access.octets :]
        if access.is_write:
            self._write(access, body)
            return bytes(len(out))
        return bytes(access.octets) + self._read(access, len(body))

    def _update(self) -> None:
        """Update the registers to the present."""
        if self.clocking.in_reset:
            return
        self.transceiver.update()
        if self.clocking.pll_has_locked and not self._lock_shown:
            self._lock_shown = True
            self.transceiver.raise_bits(r.CPLOCK)

    def _read(self, access: Access, length: int) -> bytes:
        if access.file == r.SYS_TIME.file:
            self.memory.set(r.SYS_TIME, self._air.now_ticks() & _STEP_MASK)
        elif access.file == r.SYS_STATUS.file:
            status = self.memory.get(r.SYS_STATUS) & ~(r.IRQS | r.HSRBP | r.ICRBP) | self.transceiver.buffer_pointers
            self.memory.set(r.SYS_STATUS, status | (r.IRQS if self._is_pending() else 0))
        elif access.file == r.TX_BUFFER.file:
            self.misuse["tx-buffer-read"] += 1  # UM p. 77
            return bytes(length)
        elif access.file == r.SYS_CTRL.file:
            return bytes(length)  # its bits clear themselves
        elif access.file == r.ACC_MEM.file:
            return self._read_accumulator(access.sub, length)
        return self.memory.read(access.file, access.sub, length)

    def _read_accumulator(self, sub: int, length: int) -> bytes:
        """Read after one dummy octet, and only with its own clock enabled (UM 7.2.38, 7.2.50.1)."""
        clocks = r.FACE | r.AMCE
        if self.memory.get(r.PMSC_CTRL0) & clocks != clocks:
            self.misuse["accumulator-without-its-clock"] += 1
            return bytes(length)
        if self.transceiver.listening_since is not None:
            self.misuse["accumulator-while-receiving"] += 1
        return b"\xff" + self.memory.read(r.ACC_MEM.file, sub, length - 1)

    def _write(self, access: Access, data: bytes) -> None:
        if self.clocking.in_reset and access.file != r.PMSC.file:
            self.misuse["write-in-reset"] += 1
        elif access.file == r.SYS_STATUS.file:
            value = int.from_bytes(data, "little") << 8 * access.sub
            self.transceiver.drop_bits(value & ~r.READ_ONLY)
        elif access.file == r.SYS_CTRL.file:
            self._command(int.from_bytes(data, "little") << 8 * access.sub)
        else:
            self.memory.write(access.file, access.sub, data)
            self._apply_written(access, len(data))

    def _command(self, control: int) -> None:
        if control & (r.TXSTRT | r.RXENAB) and not self.clocking.locked:
            self.misuse["radio-without-pll"] += 1
        else:
            self.transceiver.command(control)

    def _apply_written(self, access: Access, length: int) -> None:
        """Execute what writing these registers triggers."""
        if access.file == r.PMSC.file and access.sub < 4:
            kind = self.clocking.on_pmsc_written()
            if kind == r.SOFTRESET_ALL:
                self._soft_reset()
            elif kind == r.SOFTRESET_RX:
                self.transceiver.stop_listening()
                self.transceiver.suspect = False
        elif access.file == r.OTP_IF.file and access.sub < r.OTP_CTRL.sub + 2 and access.sub + length > r.OTP_CTRL.sub:
            self.clocking.on_otp_written()
        elif access.file == r.TX_CAL.file and access.sub == 0:
            self.clocking.on_sensor_written()
        elif access.file == r.AON.file and self.memory.get(r.AON_CTRL) & r.SAVE:
            self.memory.set(r.AON_CTRL, self.memory.get(r.AON_CTRL) & ~r.SAVE)  # it clears itself
            if self.memory.get(r.AON_CFG0) & r.SLEEP_EN:
                self._sleep()

    def _soft_reset(self) -> None:
        """Reset all registers but the bits that hold the chip in reset (UM 7.2.50.1)."""
        self.transceiver.reset()
        self.memory.reset()
        self.memory.set(r.PMSC_CTRL0, r.PMSC_CTRL0.reset & ~(0xF << r.SOFTRESET_SHIFT))
        self.memory.set(r.SYS_STATUS, r.SLP2INIT)
        self._lock_shown = False

    # The air

    def receive(
        self,
        frame: bytes,
        rx_ticks: int,
        diagnostics: Diagnostics,
        fault: Fault | None = None,
        *,
        carrier_phase_cycles: float | None = None,
    ) -> str:
        """Process a frame that has ended, whose RMARKER reached the antenna at ``rx_ticks``. Returns the outcome.

        ``carrier_phase_cycles`` is that of its first path (``Reception``); None if the air has none.
        """
        if self._asleep_since_s is not None:
            self.arrivals["receiver-off"] += 1
            return "receiver-off"
        self._update()
        ticks, microcode = wrap(rx_ticks + self._rx_delay_ticks), self.clocking.microcode_loaded
        outcome = self.transceiver.receive(
            frame, ticks, diagnostics, microcode=microcode, fault=fault, carrier_phase_cycles=carrier_phase_cycles
        )
        self.arrivals[outcome] += 1
        return outcome


class ModelBus:
    """A driver's bus to a model of the chip (``skyless.radio.dw1000.radio.Bus``).

    ``spend`` advances the host's time; a transfer reaches the chip at its end.
    """

    def __init__(
        self, chip: Chip, spend: Callable[[float], None] | None = None, latency_s: Callable[[], float] | None = None
    ) -> None:
        self.chip = chip
        self._spend, self._latency_s = spend, latency_s
        self._hz = _SLOW_HZ

    def transfer(self, out: bytes) -> bytes:
        """One transaction in both directions."""
        if self._spend is not None:
            self._spend((0.0 if self._latency_s is None else self._latency_s()) + 8 * len(out) / self._hz)
        return self.chip.transfer(out, self._hz)

    def set_spi_fast(self, fast: bool) -> None:
        """Use the fast or the slow clock."""
        self._hz = _FAST_HZ if fast else _SLOW_HZ

    def reset_chip(self) -> None:
        """Pull RSTn low for a moment."""
        self.chip.pull_reset()

    def pause_us(self, microseconds: int) -> None:
        """Wait."""
        if self._spend is not None:
            self._spend(1e-6 * microseconds)
