"""UARTE0 and SPIM0: what moves data by DMA, in the time that its bits take."""

from collections.abc import Callable
from functools import partial

from emulator.processor.peripherals import Peripheral, System
from skyless.sim.dw1000.registers import decode_header


class Uarte(Peripheral):
    """UARTE0. ``send`` gets the bytes that have left completely, up to a 0 or to the transfer's end.

    A receiver that has not been started loses bytes. One that is stopped keeps up to four more of those that arrive in
    five bytes' time, until RXTO (assumed from what the specification says of flow control); FLUSHRX or the next STARTRX
    writes them to RAM. Parity, flow control and line errors are not modelled.
    """

    base = 0x40002000
    irq = 2
    _ENDRX, _ENDTX, _RXDRDY, _TXDRDY, _RXTO, _TXSTOPPED = 0x110, 0x120, 0x108, 0x11C, 0x144, 0x158
    _DMA_CYCLES = 32
    """From RXDRDY until the byte is in RAM (assumed; the specification promises nothing)."""
    _SET_UP = (0x508, 0x50C, 0x510, 0x514, 0x524, 0x56C)
    """PSEL, BAUDRATE, CONFIG."""

    def __init__(self, system: System, send: Callable[[bytes], None]) -> None:
        tasks = {0x000: self._start_rx, 0x004: self._stop_rx, 0x02C: self._flush_rx}
        super().__init__(
            system,
            tasks=tasks | {0x008: self._start_tx, 0x00C: self._stop_tx},
            events=(0x100, 0x104, 0x108, 0x110, 0x11C, 0x120, 0x124, 0x144, 0x14C, 0x150, 0x158),
            registers=(0x200, 0x480, 0x500, *self._SET_UP, 0x534, 0x538, 0x53C, 0x544, 0x548, 0x54C),
        )
        self._send = send
        self._into = self._room = self._filled = 0
        self._is_receiving = self._is_stopping = False
        self._kept = b""
        """Bytes that came while it stopped."""
        self._transfer = 0
        """Number of the transfer that is being sent; 0 while none is."""
        self._transfers = 0

    def write(self, offset: int, value: int) -> None:
        """A store; ones clear ERRORSRC, and a transfer has at most 255 bytes."""
        if offset == 0x480:
            value = self.registers[offset] & ~value
        if offset in {0x538, 0x548} and value > 255:
            self.system.misuse["uarte-transfer-too-long"] += 1
            value &= 255
        if offset in self._SET_UP and self.registers[0x500]:
            self.system.misuse["uarte-set-while-enabled"] += 1
        super().write(offset, value)

    @property
    def _byte_cycles(self) -> float:
        """Ten bits; BAUDRATE is in 16 MHz / 2³²."""
        return 10 * 64e6 / (self.registers[0x524] * 16e6 / 2**32)

    def _is_ready(self, pin: int) -> bool:
        """Whether the UARTE is switched on and has its pin."""
        if self.registers[0x500] == 8 and self.registers[0x524] and not self.registers[pin] >> 31:
            return True
        self.system.misuse["uarte-not-enabled"] += 1
        return False

    # To the processor

    def _start_rx(self) -> None:
        if self._is_ready(0x514):
            self._into, self._room, self._filled = self.registers[0x534], self.registers[0x538], len(self._kept)
            self._write_kept()
            self._is_receiving = True
            self.happen(0x14C)

    def _stop_rx(self) -> None:
        """Receive no more, unless ENDRX starts it again."""
        if self._is_receiving:
            self._end_rx()
        if not self._is_receiving:
            self._is_stopping = True
            self.system.plan(self.system.cycles + round(5 * self._byte_cycles), self._stopped)

    def _stopped(self) -> None:
        self._is_stopping = False
        self.happen(self._RXTO)

    def _flush_rx(self) -> None:
        self.registers[0x53C] = len(self._kept)
        self._write_kept()
        self.happen(self._ENDRX)

    def _write_kept(self) -> None:
        if self._kept:
            self.system.store(self.registers[0x534], self._kept)
            self._kept = b""

    def _end_rx(self) -> None:
        self.registers[0x53C] = self._filled
        self._is_receiving = False
        self.happen(self._ENDRX)
        if self.registers[0x200] & 1 << 5:
            self._start_rx()

    def receive(self, data: bytes) -> None:
        """These bytes have arrived."""
        for byte in data:
            if self._is_stopping and len(self._kept) < 4:
                self._kept += bytes((byte,))
                self.happen(self._RXDRDY)
                continue
            if not self._is_receiving or self._filled == self._room:
                self.system.misuse["uarte-byte-lost"] += 1
                continue
            store = partial(self.system.store, self._into + self._filled, bytes((byte,)))
            self.system.plan(self.system.cycles + self._DMA_CYCLES, store)
            self._filled += 1
            self.happen(self._RXDRDY)
            if self._filled == self._room:
                self._end_rx()

    # From the processor

    def _start_tx(self) -> None:
        if not self._is_ready(0x50C):
            return
        if self._transfer:
            self.system.misuse["uarte-started-while-sending"] += 1
            return
        address, size = self.registers[0x544], self.registers[0x548]
        data = self.system.load(address, size)
        self._transfers += 1
        self._transfer = number = self._transfers
        begun, byte_cycles, piece_begin = self.system.cycles, self._byte_cycles, 0
        self.happen(0x150)
        for at, byte in enumerate(data):
            if byte == 0 or at == size - 1:
                cycles = begun + round((at + 1) * byte_cycles)
                self._plan_piece(cycles, number, address + piece_begin, data[piece_begin : at + 1])
                piece_begin = at + 1
        self.system.plan(begun + round(size * byte_cycles), lambda: self._end_tx(number, size))

    def _plan_piece(self, cycles: int, number: int, address: int, expected: bytes) -> None:
        def leave() -> None:
            if number != self._transfer:
                return
            data = self.system.load(address, len(expected))
            if data != expected:
                self.system.misuse["uarte-buffer-changed"] += 1
            self._send(data)

        self.system.plan(cycles, leave)

    def _end_tx(self, number: int, size: int) -> None:
        if number == self._transfer:
            self._transfer = 0
            self.registers[0x54C] = size
            self.happen(self._TXDRDY)
            self.happen(self._ENDTX)

    def _stop_tx(self) -> None:
        """Send no more; a record that is cut off is lost as a whole."""
        self._transfer = 0
        self.happen(self._TXSTOPPED)


class Spim(Peripheral):
    """SPIM0 with one chip behind a chip select on a pin.

    A transaction reaches the chip when its bits are over: a read at the end of each transfer, with what was sent since
    the chip was selected, and a write when the chip select rises. The start of a transfer costs no time of its own.
    """

    base = 0x40003000
    irq = 3
    _END = 0x118

    def __init__(self, system: System, exchange: Callable[[bytes, int], bytes]) -> None:
        """``exchange`` is one whole transaction: what is sent and the clock's rate; the answer."""
        super().__init__(
            system,
            tasks={0x010: self._start, 0x014: lambda: self.happen(0x104)},  # a transfer that runs goes on to its end
            events=(0x104, 0x110, 0x118, 0x120, 0x14C),  # STOPPED, ENDRX, END, ENDTX, STARTED
            # SHORTS, ENABLE, PSEL, FREQUENCY, DMA, CONFIG, ORC
            registers=(*(0x200, 0x500, 0x508, 0x50C, 0x510, 0x524), *range(0x534, 0x550, 4), 0x554, 0x5C0, 0xFFC),
        )
        self.draws_current = False
        """Also switched off, beside GPIOTE, until its block was without power (anomaly 89)."""
        self._exchange = exchange
        self.end_cycles: int | None = None
        """When the transfer that runs will be over."""
        self.selected = False
        self._sent = b""
        self._hz = 0

    def write(self, offset: int, value: int) -> None:
        """A store; a transfer has at most 255 bytes."""
        if offset in {0x538, 0x548} and value > 255:
            self.system.misuse["spim-transfer-too-long"] += 1
            value &= 255
        super().write(offset, value)
        if offset == 0xFFC and not value & 1:
            self.registers = dict.fromkeys(self.registers, 0)
            self.draws_current = False
        elif offset == 0x500 and value:
            self.draws_current = True

    @property
    def hz(self) -> int:
        """The clock's rate: 0x02000000 is 125 kHz, and twice the value is twice the rate."""
        return self.registers[0x524] * 125_000 // 0x02000000

    def _start(self) -> None:
        if self.registers[0x500] != 7 or not self.hz:
            self.system.misuse["spim-not-enabled"] += 1
            return
        if self.end_cycles is not None:
            self.system.misuse["spim-started-while-busy"] += 1
            return
        if self.registers[0x554]:
            self.system.misuse["spim-wrong-mode"] += 1  # the chip uses mode 0, most significant bit first
        if not self.system.has_input_buffer(self.registers[0x508]):
            self.system.misuse["spim-clock-without-input-buffer"] += 1  # hardware does not finish the transfer then
        receive, transmit = self.registers[0x538], self.registers[0x548]
        if receive == 1 and transmit <= 1:
            self.system.misuse["spim-erratum-58"] += 1  # one byte more would be clocked
        out = self.system.load(self.registers[0x544], transmit) if transmit else b""
        out += bytes([self.registers[0x5C0] & 0xFF]) * (receive - transmit)
        self.end_cycles = self.system.cycles + round(8 * len(out) * 64_000_000 / self.hz)
        self.happen(0x14C)
        self.system.plan(self.end_cycles, lambda: self._end(out, receive, transmit))

    def _end(self, out: bytes, receive: int, transmit: int) -> None:
        self.end_cycles = None
        data = bytes(len(out))
        if self.selected:
            self._sent += out
            self._hz = self.hz
            access = decode_header(self._sent)
            if access is not None and not access.is_write and len(self._sent) > access.octets:
                data = self._exchange(self._sent, self._hz)[-len(out) :] if out else b""
        else:
            self.system.misuse["spim-without-chip-select"] += 1
        if receive:
            self.system.store(self.registers[0x534], data[:receive])
        self.registers[0x53C], self.registers[0x54C] = receive, transmit
        self.happen(0x110)
        self.happen(0x120)
        self.happen(self._END)

    def select(self, selected: bool) -> None:
        """The chip select has changed."""
        if self.end_cycles is not None:
            self.system.misuse["spim-deselected-while-busy"] += 1
        if not selected and self._sent:
            access, sent, hz = decode_header(self._sent), self._sent, self._hz
            if access is None or access.is_write:
                self.system.plan(self.system.cycles, lambda: self._exchange(sent, hz))
        self._sent, self.selected = b"", selected
