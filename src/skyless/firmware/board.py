"""A board that receives and sends for its host: the chip's driver on one side, the serial link on the other.

Runs unchanged in MicroPython and in CPython; it has never run on a board. UART, clock and garbage collector are given.
The host decides (``docs/serial.md``); the board holds at most one frame until shortly before its time, because the
receiver is off from then on. Nothing is allocated per frame or record, and the garbage of starts and measurements is
collected in free slots only: see ``_is_free``.
"""

try:
    from skyless.firmware import dw1000, link
except ImportError:  # a board, where these files stand side by side
    import dw1000  # type: ignore[import-not-found,no-redef]
    import link  # type: ignore[import-not-found,no-redef]

FIRMWARE = (0, 1, 0)

LEAD_US = 1000
"""How long before its time a frame is handed to the chip: a reception that is being reported then, the SPI and the
preamble (``docs/hardware.md``), and two steps of a clock of 30 µs."""
CLOSE_US = 60
"""A time closer than this is not checked again against the chip's counter."""
OVERDUE_US = 2000
"""After its time a frame is cancelled if the chip has not reported that it was sent."""
POLL_US = 50_000
"""How often the chip is polled without its interrupt line being high: one that has lost its settings raises none."""
QUIET_US = 2400
"""A silence of this length is an empty slot of 2.1 ms, with 1.6 ms left of it."""
CLEARANCE_US = 5000
"""Nothing long is begun in this time before a frame is due."""
MEASURE_US = 10_000_000
"""How often temperature and supply are measured, which takes 1.1 ms without the receiver, and the chip is checked for
its settings: after a failed supply it may receive nothing for ever and look normal."""
GARBLED_IN_A_ROW = 20
"""After this many the UART is restarted: it may have lost count."""
READ_BYTES = 64

NO_FRAME = 0
HELD = 1
HANDED_OVER = 2
"""State of the frame that the host wants to be sent."""


class Uart:
    """The serial port that a board needs; neither method waits."""

    def read(self, into: bytearray) -> int:
        """Read what was received into the buffer's beginning; return how many bytes that is."""
        raise NotImplementedError

    def write(self, line: bytearray, end: int) -> bool:
        """Send ``line[:end]``, now or later; False where it does not fit, and nothing is sent."""
        raise NotImplementedError

    def restart(self) -> None:
        """Discard all that was received."""


class Clock:
    """MicroPython's module ``time``, as far as it is needed."""

    def ticks_us(self) -> int:
        """Microseconds, modulo something."""
        raise NotImplementedError

    def ticks_add(self, ticks: int, change: int) -> int:
        """A later time."""
        raise NotImplementedError

    def ticks_diff(self, later: int, earlier: int) -> int:
        """Between two times."""
        raise NotImplementedError


class Collector:
    """MicroPython's module ``gc``, as far as it is needed."""

    def collect(self) -> None:
        """Collect garbage, which needs over a millisecond on a board."""


class Pin:
    """The interrupt line."""

    def value(self) -> int:
        """1 where it is high."""
        raise NotImplementedError


class Board:
    """One chip and one host. ``turn`` is to be called repeatedly."""

    def __init__(
        self,
        chip: dw1000.DW1000,
        uart: Uart,
        clock: Clock,
        collector: Collector,
        can_transmit: bool,
        identity: bytearray,
        interrupt: "Pin | None" = None,
        lead_us: int = LEAD_US,
    ) -> None:
        """Without an interrupt line the chip is polled in every turn.

        Raises:
            ValueError: ``identity`` has not 8 bytes.
        """
        if len(identity) != 8:
            raise ValueError("a board's identity has 8 bytes")
        self.unsent = 0
        """Records that did not fit into the serial port."""
        self.chores = 0
        """Collections and measurements in free slots."""
        self._chip, self._uart, self._clock, self._collector = chip, uart, clock, collector
        self._can_transmit, self._identity, self._interrupt = can_transmit, identity, interrupt
        self._lead_us = lead_us
        self._writer, self._reader = link.Writer(), link.Reader()
        self._in = bytearray(READ_BYTES)
        self._configured = self._receiving = False
        self._stage = NO_FRAME
        self._dx = bytearray(5)
        self._unwanted_dx = bytearray(5)
        self._frame = bytearray(link.MAX_FRAME_BYTES)
        self._frame_end = 0
        self._late = 0
        self._strange = 0
        self._understood = 0
        self._counts = [0, 0, 0, 0, 0, 0]
        self._no_ticks = bytearray(5)
        self._temperature_cc, self._millivolts = link.NOT_MEASURED, link.NO_VOLTAGE
        self._litter = True
        self._own_slot = False
        self._due_us = self._polled_us = self._busy_us = clock.ticks_us()
        self._measured_us = clock.ticks_add(self._busy_us, -MEASURE_US)

    def begin(self) -> None:
        """Send the identity, after a 0 that ends whatever was on the line."""
        self._uart.write(self._no_ticks, 1)
        self._hello()

    def turn(self) -> None:
        """Serve the chip, the host and the time once."""
        now_us = self._clock.ticks_us()
        self._own_slot = False
        if self._configured and self._is_poll_due(now_us):
            self._polled_us = now_us
            self._poll()
        size = self._uart.read(self._in)
        if size > 0:
            self._process(size)
            self._busy_us = self._clock.ticks_us()
        if self._stage != NO_FRAME and self._clock.ticks_diff(now_us, self._due_us) >= 0:
            self._serve_frame()
        elif self._has_chore(now_us) and self._is_free(now_us):
            self._do_chore(now_us)

    # The chip

    def _is_poll_due(self, now_us: int) -> bool:
        interrupt = self._interrupt
        if interrupt is None or interrupt.value():
            return True
        return self._clock.ticks_diff(now_us, self._polled_us) >= POLL_US

    def _poll(self) -> None:
        """Report what has happened at the chip."""
        chip, writer = self._chip, self._writer
        events = chip.poll()
        if events == 0:
            return
        if events & dw1000.RECEIVED:
            self._send(
                writer.rx(
                    chip.rx_ticks,
                    chip.rx_power_cdbm,
                    chip.first_path_cdbm,
                    chip.offset_ppb,
                    chip.frame,
                    chip.frame_bytes,
                )
            )
        if events & dw1000.SENT and self._stage == HANDED_OVER:
            self._stage = NO_FRAME
            self._own_slot = True
            self._send(writer.tx_done(self._dx, chip.tx_ticks))
        if events & dw1000.LOST:
            self._on_lost()
        self._busy_us = self._clock.ticks_us()

    def _on_lost(self) -> None:
        """The chip has lost its settings; after a HELLO the host asks for its state, and configures it again."""
        self._forget_frame()
        self._configured = self._receiving = False
        self._hello()

    def _forget_frame(self) -> None:
        """Report that the frame held will not be sent."""
        if self._stage != NO_FRAME:
            self._report_late(self._dx, link.LATE_NOT_READY)
            self._stage = NO_FRAME

    # The frame to be sent

    def _hold(self, record: bytearray, length: int) -> None:
        """Hold a frame to be sent; its time is checked in this turn."""
        link.copy(record, link.BODY_AT, link.TX_FRAME_AT, self._dx, 0)
        self._frame_end = link.copy(record, link.TX_FRAME_AT, length, self._frame, 0)
        self._stage = HELD
        self._due_us = self._clock.ticks_us()

    def _serve_frame(self) -> None:
        """The frame held is due by the board's clock: hand it over, or cancel it when it is overdue.

        That clock may be off by a few per cent, so the time left is read from the chip until it is short.
        """
        clock, chip = self._clock, self._chip
        if self._stage == HANDED_OVER:
            self._due_us = clock.ticks_add(clock.ticks_us(), OVERDUE_US)
            if chip.cancel():
                self._stage = NO_FRAME
                self._report_late(self._dx, link.LATE_FOR_RADIO)
            return
        left_us = dw1000.micros_until(chip.now(), self._dx) - self._lead_us
        if left_us > CLOSE_US:
            self._due_us = clock.ticks_add(clock.ticks_us(), left_us - (left_us >> 4))
        else:
            self._hand_over()

    def _hand_over(self) -> None:
        if self._interrupt is None or self._interrupt.value():
            self._poll()  # or a frame that has just come would be lost
            if self._stage != HELD:
                return
        result = self._chip.transmit_at(self._dx, self._frame, 0, self._frame_end)
        if result == dw1000.QUEUED:
            self._stage = HANDED_OVER
            self._due_us = self._clock.ticks_add(self._clock.ticks_us(), self._lead_us + OVERDUE_US)
        else:
            self._stage = NO_FRAME
            self._report_late(self._dx, result)  # the driver's reasons have the link's numbers

    def _report_late(self, dx: bytearray, reason: int) -> None:
        self._late += 1
        self._send(self._writer.tx_late(dx, reason))

    # The host

    def _process(self, size: int) -> None:
        """Obey the commands in what was received."""
        reader, at = self._reader, 0
        while at < size:
            at = reader.read(self._in, at, size)
            if reader.length > 0:
                self._understood = reader.garbled + reader.overlong
                self._obey(reader.record, reader.length)
        if reader.garbled + reader.overlong - self._understood >= GARBLED_IN_A_ROW:
            self._understood = reader.garbled + reader.overlong
            self._uart.restart()

    def _obey(self, record: bytearray, length: int) -> None:
        kind = record[0]
        if kind == link.TX_AT:
            self._accept_frame(record, length)
        elif kind == link.ASK_STATUS:
            self._status()
        elif kind == link.ASK_HELLO:
            self._hello()
        elif kind == link.CONFIG:
            self._configure(record, length)
        elif kind == link.RX_ON:
            self._receive()
        else:
            self._strange += 1

    def _accept_frame(self, record: bytearray, length: int) -> None:
        size = length - link.TX_FRAME_AT
        if size < dw1000.MIN_PSDU_BYTES or size > dw1000.MAX_PSDU_BYTES:
            self._send(self._writer.refused(link.TX_AT, link.REFUSED_MALFORMED))
        elif self._configured and self._can_transmit and self._stage == NO_FRAME:
            self._hold(record, length)
        else:
            ready = self._configured and self._can_transmit
            link.copy(record, link.BODY_AT, link.TX_FRAME_AT, self._unwanted_dx, 0)
            self._report_late(self._unwanted_dx, link.LATE_BUSY if ready else link.LATE_NOT_READY)

    def _receive(self) -> None:
        if self._configured:
            self._receiving = True
            self._chip.receive()
            self._status()
        else:
            self._send(self._writer.refused(link.RX_ON, link.REFUSED_MALFORMED))

    def _configure(self, record: bytearray, length: int) -> None:
        """Start the chip with the antenna delays of the command; other settings must be the only ones supported."""
        if length < link.CONFIG_BYTES:
            self._send(self._writer.refused(link.CONFIG, link.REFUSED_MALFORMED))
            return
        if not is_known_setting(record):
            self._send(self._writer.refused(link.CONFIG, link.REFUSED_SETTING))
            return
        self._forget_frame()
        self._configured = self._receiving = False
        self._litter = True
        try:
            self._chip.start(link.unsigned(record, 8, 2), link.unsigned(record, 10, 2))
        except dw1000.ChipError:
            self._send(self._writer.refused(link.CONFIG, link.REFUSED_RADIO))
            return
        self._configured = True
        self._status()

    def _hello(self) -> None:
        capabilities = link.CAN_TRANSMIT if self._can_transmit else 0
        self._send(self._writer.hello(FIRMWARE, self._identity, capabilities))

    def _status(self) -> None:
        chip, counts = self._chip, self._counts
        state = link.IS_CONFIGURED if self._configured else 0
        if self._receiving:
            state |= link.IS_RECEIVING
        if self._stage != NO_FRAME:
            state |= link.HAS_FRAME_WAITING
        counts[0] = chip.received
        counts[1] = chip.errors
        counts[2] = chip.sent
        counts[3] = self._late
        counts[4] = self._strange + self._reader.garbled + self._reader.overlong
        counts[5] = self.unsent
        ticks = chip.now() if self._configured else self._no_ticks
        self._send(self._writer.status(ticks, state, counts, self._temperature_cc, self._millivolts))

    def _send(self, end: int) -> None:
        if not self._uart.write(self._writer.line, end):
            self.unsent += 1

    # What can wait

    def _has_chore(self, now_us: int) -> bool:
        return self._litter or self._clock.ticks_diff(now_us, self._measured_us) >= MEASURE_US

    def _is_free(self, now_us: int) -> bool:
        """Whether a millisecond and a half is free: the rest of the own slot, or of an empty one.

        Never where a frame is on its way out, nor shortly before one is due.
        """
        clock = self._clock
        if self._stage == HANDED_OVER:
            return False
        if self._stage == HELD and clock.ticks_diff(self._due_us, now_us) < CLEARANCE_US:
            return False
        return self._own_slot or clock.ticks_diff(now_us, self._busy_us) >= QUIET_US

    def _do_chore(self, now_us: int) -> None:
        """Collect garbage, or check and measure the chip, which leaves some."""
        self.chores += 1
        if self._litter:
            self._litter = False
            self._collector.collect()
            return
        self._measured_us = now_us
        if not self._configured:
            return
        self._litter = True
        if not self._chip.check():
            self._on_lost()
        elif self._chip.measure():
            self._temperature_cc, self._millivolts = self._chip.temperature_cc, self._chip.millivolts


def is_known_setting(record: bytearray) -> bool:
    """Whether CONFIG asks for channel 5, PRF 64 MHz, 6.8 Mbit/s, code 9 and 128 symbols."""
    if record[2] != 5 or record[3] != 64 or record[4] != 2 or record[5] != 9:
        return False
    return link.unsigned(record, 6, 2) == 128
