"""A DWM1001 that executes the firmware's image: an nRF52832 with a DW1000 on its SPI, in true time.

    image = Image(Seat(timeline, chip, send, can_transmit=True), elf=path)

The processor's costs and what is assumed of them: ``cycles.py``. Its peripherals: ``peripherals.py`` and
``serial_peripherals.py``. WFI ends 3 µs after the interrupt that ends it (assumed; the specification gives about that
for a regulator and a clock that have to start). The 64 MHz clock is exact but for ``clock_ppm``; a reset takes no time.
"""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final

from emulator.processor import peripherals as p
from emulator.processor.cortex_m4 import Core, EmulationError
from emulator.processor.cycles import CPU_HZ, CYCLES
from emulator.processor.elf import configuration_of
from emulator.processor.paths import Paths
from emulator.processor.processors import MIN_TICKS, TICKS_PER_CYCLE, Processors
from emulator.processor.radio import OnAir, Radio
from emulator.processor.serial_peripherals import Spim, Uarte
from emulator.seat import Seat
from skyless.core.ticks import TICK_S
from skyless.radio.serial.link import BoardSettings, pack
from skyless.sim.dw1000.registers import SYS_CTRL, SYS_STATUS

WAKE_UP_CYCLES: Final = 3 * 64
_LOCKUP_RESET_CYCLES: Final = 64

SELECT_PIN: Final = 17
INTERRUPT_PIN: Final = 19
RESET_PIN: Final = 24
ROLE_PIN: Final = 13
UART_RX_PIN: Final = 11
LED_PINS: Final = {"D9": 30, "D10": 31, "D11": 22, "D12": 14}
"""By the names that are printed on a DWM1001-DEV."""

_WINDOWS: Final = [
    (p.FlashPage.base, 0x1000),
    (0x10000000, 0x2000),
    (0x40000000, 0x20000),
    (0x50000000, 0x1000),
    (0xE000E000, 0x1000),
    (0xF0000000, 0x1000),
]
_CONFIGURATION, _RESET_PINS = 0x10001000, 0x200
"""UICR, and where PSELRESET is in it."""
_PULL_UP: Final = 3
_SPIM_START: Final = 0x40003010
_SPIM_END: Final = 0x40003118
_COUNT_OF_BYTES: Final = 0x40009040
"""TIMER1's CAPTURE[0], with which the firmware reads how many bytes have come."""
_WATCHDOG_FED: Final = 0x40010600
_READS_STATUS: Final = bytes((SYS_STATUS.file,))
"""Header of the transaction with which the firmware asks what has happened."""
_COMMANDS: Final = bytes((0x80 | SYS_CTRL.file,))


class Image:
    """A board that executes an ELF file's machine code; what is not modelled raises EmulationError when it is used."""

    def __init__(
        self, seat: Seat, *, elf: Path, clock_ppm: float = 0.0, revision: int = 5, baud: int | None = 1_000_000
    ) -> None:
        """``revision`` of the processor as it states it; ``baud``: the serial line's by its flash, None for empty."""
        self.misuse: Counter[str] = Counter()
        """What the firmware did to its processor that the specification forbids, and bytes that it lost."""
        self.resets: Counter[str] = Counter()
        """Resets after the first start, by their cause."""
        self._seat, self._timeline, self._chip = seat, seat.timeline, seat.chip
        self._ticks_per_cycle = TICKS_PER_CYCLE * (1 + 1e-6 * clock_ppm)
        self._processors = Processors.of(seat.timeline)
        self._epoch_ticks = seat.timeline.now_ticks
        self.paths = Paths()
        self._irq_was_high = False
        self._rise_ticks: int | None = None
        self.worst_latency_s = 0.0
        """From a rise of the chip's interrupt line until the firmware began to read SYS_STATUS, in s of true time."""
        self._executing = self.is_asleep = self._holds_chip = False
        self._asleep_since = self._slept_cycles = 0
        self._life = 0
        self.advertised: list[OnAir] = []
        """What has left the Bluetooth antenna."""
        self._revision = revision
        self.core = Core(elf, _WINDOWS, self._read, self._write)
        self.load, self.store = self.core.load, self.core.store
        self.settings, self._configuration = (
            p.FlashPage(self, self.core.spend, base) for base in (p.FlashPage.base, _CONFIGURATION)
        )
        self._configuration.hold(configuration_of(elf), _RESET_PINS)
        if baud is not None:
            self.settings.hold(pack(BoardSettings(baud=baud)))
        self._start(cause=0, watchdog=None)

    # What the site sees

    def notify(self) -> None:
        """The chip's interrupt line may have changed."""
        high = self._chip.irq
        if high == self._irq_was_high:
            return
        self._irq_was_high = high
        self._rise_ticks = self._timeline.now_ticks if high else None
        self._gpiote.on_edge(INTERRUPT_PIN, high)

    def receive(self, data: bytes) -> None:
        """Bytes have arrived on the UART's line."""
        self.paths.note_bytes(data)
        self._uarte.receive(data)

    def power_cycle(self) -> None:
        """The processor's supply failed and is back: RAM, registers and the cause of the reset are lost."""
        self.core.reset(keep_ram=False)
        self.resets["power"] += 1
        self._start(cause=0, watchdog=None)

    def pull_reset_pin(self) -> None:
        """The reset pin was low for a moment; all causes of resets are set then, as anomaly 136 has it."""
        self._reset(p.RESET_BY_PIN | p.RESET_WATCHDOG | p.RESET_SOFTWARE | p.RESET_LOCKUP, "pin")

    @property
    def keeps_ram(self) -> bool:
        """Whether the firmware has set what sleep needs for RAM not to be lost (anomaly 108)."""
        return self._clock.registers[0xEE4] == p.KEEP_RAM

    @property
    def debug_is_open(self) -> bool:
        """Whether a probe can reach the processor; from revision 3 on UICR and firmware both have to open it."""
        lock = self._configuration.registers[0x208] & 0xFF
        if self._revision < p.REVISION_3:
            return lock == 0xFF
        return lock == 0x5A and self._clock.registers[0x558] == 0x5A

    @property
    def leds(self) -> frozenset[str]:
        """Lights that are on (``LED_PINS``); they are so when their pin is low."""
        return frozenset(name for name, pin in LED_PINS.items() if self.gpio.is_driven(pin, high=False))

    @property
    def drawing(self) -> frozenset[str]:
        """What keeps a sleeping processor from drawing a few µA only."""
        draws = {
            "crystal": self._clock.crystal_cycles < 1 << 62,
            "timer": any(timer.draws_current for timer in self._timers),
            "uarte": self._uarte.registers[0x500] != 0,
            "spim": self._spim.draws_current,
            "gpiote": any(self._gpiote.registers[at] for at in self._gpiote.CONFIG),
            "radio": self.radio.is_busy,
        }
        return frozenset(name for name, draw in draws.items() if draw)

    @property
    def busy_share(self) -> float:
        """Share of the time since the first start in which the processor was awake, waits for transfers included."""
        passed = max(self._cycle_at(self._timeline.now_ticks), 1)
        return 1.0 - (self._slept_cycles + (passed - self._asleep_since if self.is_asleep else 0)) / passed

    def forget_paths(self) -> None:
        """Measure paths, functions and latencies from now on."""
        self.core.forget_spent()
        self.paths = Paths()
        self.paths.begin(self.cycles)
        self.worst_latency_s = 0.0

    # Start and resets

    def _start(self, cause: int, watchdog: p.Watchdog | None) -> None:
        """Peripherals as after a reset; a watchdog that is given runs on."""
        self._life += 1
        self._reset_asked = False
        self._clock = p.Clock(self, cause, self._revision)
        self._timers = [p.Timer(self, number) for number in range(3)]
        self._counters: list[p.Timer | p.Rtc] = [*self._timers, p.Rtc(self)]
        self.gpio = p.Gpio(self, self._level, self._on_output)
        self._gpiote = p.Gpiote(self)
        self._watchdog = watchdog or p.Watchdog(self, lambda: self._clock.is_slow_started)
        self._ppi = p.Ppi(self)
        self.settings.is_writable = False
        self._nvmc = p.Nvmc(self, self.core.use_cache, self.settings, self._configuration)
        status = lambda: (self.core.hfsr, self.core.cfsr, self.core.bfar)  # noqa: E731
        self._nvic = p.Nvic(self, status, self._ask_for_reset, self.core.use_fpu)
        self._uarte = Uarte(self, self._seat.send)
        self._spim = Spim(self, self._exchange)
        self.radio = Radio(self, lambda: self._clock.crystal_cycles <= self.cycles, self.advertised.append)
        self._pages: dict[int, p.Peripheral] = {
            one.base >> 12: one
            for one in (
                self._clock,
                *self._counters,
                self.radio,
                self.settings,
                self.gpio,
                self._gpiote,
                self._watchdog,
                self._ppi,
                self._nvmc,
                self._nvic,
                self._uarte,
                self._spim,
                p.factory_information(self, self._seat.identity),
                self._configuration,
                p.identification(self, self._revision),
            )
        }
        self._selected, self._selected_cycles = False, 0
        if self._holds_chip:
            self._chip.pull_reset()
        self._holds_chip = False
        self._stalled_until: int | None = None
        self._rise_ticks = None
        if self.is_asleep:
            self._slept_cycles += max(self._cycle_at(self._timeline.now_ticks) - self._asleep_since, 0)
        self.is_asleep = False
        self.core.cycles = max(self.core.cycles, self._cycle_at(self._timeline.now_ticks))
        self.paths.begin_start(self.core.cycles)
        self._processors.plan(self, self._ticks_at(self.core.cycles))

    def _ask_for_reset(self) -> None:
        self._reset_asked = True
        self.core.stop_at(0)

    def _reset(self, cause: int, name: str) -> None:
        """A reset other than that of power-on; only soft resets and lockups leave RAM and watchdog as they are."""
        self.resets[name] += 1
        soft = cause in {p.RESET_SOFTWARE, p.RESET_LOCKUP}
        causes = self._clock.registers[0x400] | cause
        watchdog = self._watchdog if soft and self._watchdog.is_running else None
        self.core.reset(keep_ram=soft)
        self._start(causes, watchdog)

    # True time

    def _ticks_at(self, cycles: int) -> int:
        """True time at which the clock has counted so far, rounded up."""
        return self._epoch_ticks + -int(-(cycles * self._ticks_per_cycle) // 1)

    def _cycle_at(self, ticks: int) -> int:
        return int((ticks - self._epoch_ticks) / self._ticks_per_cycle + 1e-6)

    @property
    def cycles(self) -> int:
        """The present in cycles of the processor's clock since the first start."""
        return self.core.state.item(CYCLES) if self._executing else self._cycle_at(self._timeline.now_ticks)

    def plan(self, cycles: int, happen: Callable[[], object]) -> None:
        """Let something happen, unless the processor is reset before."""
        life = self._life

        def act() -> None:
            if life == self._life:
                happen()

        self._timeline.at(self._ticks_at(cycles), act)
        if self._executing:
            self.core.stop_at(cycles)

    def advance(self, due_ticks: int, until_ticks: int) -> int | None:
        """Execute up to a true time (``processors.Processor``)."""
        if self.is_asleep:
            self.core.cycles = max(self._cycle_at(due_ticks), self._asleep_since)
            self._update_timers()
            if self._watchdog.due_cycles <= self.core.cycles:
                self._reset(p.RESET_WATCHDOG, "watchdog")
            elif self._nvic.wakes:
                return self._ticks_at(self._wake())
            else:
                return self._sleep_until()
        limit = self._cycle_at(until_ticks) + 1
        while self.core.cycles < limit:
            if self._stalled_until is not None:
                if self._spim.end_cycles is not None:
                    return max(self._ticks_at(self._spim.end_cycles) + 1, self._timeline.now_ticks + MIN_TICKS)
                self._end_stall()
            stop = self._execute(min(limit, self._watchdog.due_cycles))
            if self._after(stop):
                return self._sleep_until()
            if self._timeline.next_ticks is not None:
                limit = min(limit, self._cycle_at(self._timeline.next_ticks) + 1)
        return self._ticks_at(self.core.cycles)

    def _execute(self, limit: int) -> str:
        self._executing = True
        try:
            return self.core.run(limit)
        finally:
            self._executing = False

    def _after(self, stop: str) -> bool:
        """Deal with what ended a run; whether the processor sleeps now."""
        if stop == "lockup":
            self.core.spend(_LOCKUP_RESET_CYCLES)
            self._reset(p.RESET_LOCKUP, "lockup")
        elif self._reset_asked:
            self._reset(p.RESET_SOFTWARE, "software")
        elif self.core.cycles >= self._watchdog.due_cycles:
            self._reset(p.RESET_WATCHDOG, "watchdog")
        elif stop == "sleep":
            self._update_timers()
            if not self.core.masks_interrupts:
                raise EmulationError(
                    f"WFI at PC 0x{self.core.pc - 2:x} with PRIMASK clear: interrupts are not modelled"
                )
            if self.core.fpu_flags:
                self.misuse["sleep-with-fpu-flags"] += 1  # anomaly 87
            if not self._nvic.wakes:
                self.paths.end(self.core.cycles)
                self.is_asleep, self._asleep_since = True, self.core.cycles
                return True
        return False

    def _sleep_until(self) -> int | None:
        due = min(self._watchdog.due_cycles, *(counter.due_cycles for counter in self._counters))
        return self._ticks_at(max(due, self._asleep_since)) if due < 1 << 62 else None

    def _wake(self) -> int:
        """End the sleep; the count of cycles at which the processor goes on."""
        self._slept_cycles += self.core.cycles - self._asleep_since
        self.is_asleep = False
        self.core.spend(WAKE_UP_CYCLES)
        self.paths.begin(self.core.cycles)
        return self.core.cycles

    def _end_stall(self) -> None:
        """The transfer that the firmware polled for is over."""
        until = self._stalled_until or 0
        if until > self.core.cycles:
            self.paths.note_wait(until - self.core.cycles)
            self.core.cycles = until
        self._stalled_until = None

    def _update_timers(self) -> None:
        """Up to the processor's present."""
        self._executing = True
        for counter in self._counters:
            counter.update()
        self._executing = False

    # What the peripherals see

    def run_task(self, address: int) -> None:
        """Start a task by its address."""
        self._peripheral(address, 4).write(address & 0xFFF, 1)

    def run_channels(self, address: int) -> None:
        """Start what PPI connects to an event."""
        self._ppi.on_event(address)

    def has_input_buffer(self, pin: int) -> bool:
        """Whether the processor sees a pin's level."""
        return self.gpio.has_input_buffer(pin)

    def update_interrupt(self, peripheral: p.Peripheral) -> None:
        """A peripheral's line may have changed."""
        if peripheral.irq is None:
            return
        self._nvic.set_line(peripheral.irq, peripheral.line)
        if self.is_asleep and self._nvic.wakes:
            self._processors.plan(self, self._timeline.now_ticks)

    def _peripheral(self, address: int, size: int) -> p.Peripheral:
        if address >> 12 in self._pages and size == 4 and not address & 3:
            return self._pages[address >> 12]
        what = "whole words only" if address >> 12 in self._pages else "no peripheral is modelled there"
        raise EmulationError(
            f"access of {size} bytes at 0x{address:08x} (in the block at PC 0x{self.core.pc:x}): {what}"
        )

    def _read(self, address: int, size: int) -> int:
        value = self._peripheral(address, size).read(address & 0xFFF)
        if address == _SPIM_END and not value and self._spim.end_cycles is not None:
            self._stalled_until = self._spim.end_cycles
            self.core.stop_at(0)
        return value

    def _write(self, address: int, size: int, value: int) -> None:
        peripheral = self._peripheral(address, size)
        if address == _SPIM_START:
            self._note_transaction(self.core.load(self._spim.registers[0x544], self._spim.registers[0x548]))
        elif address == _COUNT_OF_BYTES:
            self.paths.note_count_of_bytes()
        elif address == _WATCHDOG_FED:
            self.paths.end_turn(self.core.cycles)
        peripheral.write(address & 0xFFF, value)

    # Pins

    def _level(self, pin: int, pull: int) -> bool:
        if pin == INTERRUPT_PIN:
            return self._irq_was_high  # of the last notification or transaction, since nothing else changes it
        if pin == ROLE_PIN:
            if self._seat.can_transmit and pull != _PULL_UP:
                self.misuse["role-pin-without-pull-up"] += 1
            return self._seat.can_transmit and pull == _PULL_UP
        if pin == RESET_PIN:
            return not self._holds_chip
        return pin == UART_RX_PIN or pull == _PULL_UP

    def _on_output(self) -> None:
        gpio = self.gpio
        selected = gpio.is_driven(SELECT_PIN, high=False)
        if selected != self._selected:
            self._selected = selected
            if not selected and not self._holds_chip:
                self._chip.select((self.cycles - self._selected_cycles) / CPU_HZ)
            self._selected_cycles = self.cycles
            self._spim.select(selected)
        if gpio.is_driven(RESET_PIN, high=True):
            self.misuse["chip-reset-driven-high"] += 1
        holds = gpio.is_driven(RESET_PIN, high=False)
        if holds != self._holds_chip:
            self._holds_chip = holds
            self.plan(self.cycles, self._pull_reset)

    def _pull_reset(self) -> None:
        """RSTn went low, or is released: either way the chip starts again there."""
        self._chip.pull_reset()
        self.notify()

    def _exchange(self, out: bytes, hz: int) -> bytes:
        """One whole SPI transaction; a chip in reset answers nothing."""
        if self._holds_chip:
            return bytes(len(out))
        answer = self._chip.transfer(out, hz)
        self.notify()
        left_ticks = self._chip.transceiver.window_left_ticks
        if out[:1] == _COMMANDS and left_ticks is not None:  # the chip's crystal may be slower than true time
            self._timeline.at(self._timeline.now_ticks + left_ticks + (left_ticks >> 13), self.notify)
        return answer

    def _note_transaction(self, out: bytes) -> None:
        """The firmware begins a transfer to the chip."""
        self.paths.note_transaction(out)
        if self._rise_ticks is not None and out[:1] == _READS_STATUS:
            taken_ticks = self._ticks_at(self.core.cycles) - self._rise_ticks
            self.worst_latency_s = max(self.worst_latency_s, taken_ticks * TICK_S)
            self._rise_ticks = None
