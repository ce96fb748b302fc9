"""Driver of the DW1000, over a bus that its caller gives; integers only.

Written from the DW1000 User Manual v2.12 ("UM", pages of that version); ``docs/dw1000.md`` lists which table was
compared with which other source. It has never run on a chip. The firmware in C (``firmware/source/dw1000.c``) does the
same, transaction by transaction. What the driver needs of the hardware is a ``Bus``.

States, in ``DW1000.state``:

    OFF         nothing is known of the chip. ``start`` resets and configures it, and leaves it IDLE.
    IDLE        the radio is off. ``receive`` turns the receiver on.
    LISTENING   the receiver is on, and stays on: after each frame, after each error, after each transmission.
    SENDING     a frame waits for its time or is on its way. The receiver is off during that time (one DX_TIME, one
                transceiver), so ``transmit_at`` is to be called as late as it safely can. Ends with SENT from
                ``poll``, or with ``cancel``.

``poll`` is to be called when the interrupt line is high, or periodically; it returns what happened as a sum of
RECEIVED, SENT, FAILED, CLOCK_SLIPPED and LOST, and has already turned the receiver on again. Until the next ``poll``,
what was received is in ``rx_ticks``, ``frame``, ``rx_power_cdbm``, ``first_path_cdbm`` and ``offset_ppb``, the stamp of
what was SENT in ``tx_ticks``. If SENT does not come within 1 ms after its time, call ``cancel``. After LOST the chip is
OFF and its counter has restarted: ``start`` again. Before ``transmit_at`` poll once, or a frame that has just come is
lost.
"""

import struct
from typing import Final, Protocol

from skyless.ticks import wrap

OFF: Final = 0
IDLE: Final = 1
LISTENING: Final = 2
SENDING: Final = 3
"""States."""

RECEIVED: Final = 1
SENT: Final = 2
FAILED: Final = 4
CLOCK_SLIPPED: Final = 8
LOST: Final = 16
"""Results of ``poll``: a frame was received, ours was sent; a reception failed; the clock's PLL was losing lock (stamps
around that time are unreliable); the chip does not answer or was reset."""

QUEUED: Final = 0
LATE: Final = 1
BUSY: Final = 2
NOT_READY: Final = 3
"""Results of ``transmit_at``: the frame will be sent at its time; or nothing is sent, because it was too late, another
frame waits, or the chip is OFF."""

NOT_MEASURED: Final = -32768
"""A measured value that is missing."""
MIN_PSDU_BYTES: Final = 3
MAX_PSDU_BYTES: Final = 127
"""FCS included, which the chip makes and checks (UM p. 80)."""

DEVICE_ID: Final = b"\x30\x01\xca\xde"
"""DEV_ID 0xDECA0130, low byte first (UM 7.2.2)."""

# SYS_STATUS (UM 7.2.17, pp. 86-92)
CPLOCK: Final = 1 << 1
TXFRS: Final = 1 << 7
LDEDONE: Final = 1 << 10
RXPHE: Final = 1 << 12
RXFCG: Final = 1 << 14
RXFCE: Final = 1 << 15
RXRFSL: Final = 1 << 16
RXRFTO: Final = 1 << 17
LDEERR: Final = 1 << 18
RXOVRR: Final = 1 << 20
RXPTO: Final = 1 << 21
SLP2INIT: Final = 1 << 23
CLKPLL_LL: Final = 1 << 25
RXSFDTO: Final = 1 << 26
HPDWARN: Final = 1 << 27
AFFREJ: Final = 1 << 29
TXPUTE: Final = 1 << 34
RX_ERRORS: Final = RXPHE | RXFCE | RXRFSL | RXRFTO | LDEERR | RXOVRR | RXPTO | RXSFDTO | AFFREJ
UNUSED: Final = 0xF8 << 32
"""Bits that do not exist."""
STATUS_OCTETS: Final = 5

CLEARED: Final = 0x07_37FF_FFF8
"""What is written back to SYS_STATUS at most: not CPLOCK, which shows that the chip still runs as it was started, nor
bits that cannot be written."""

# SYS_CTRL (UM 7.2.15, pp. 80-84)
TXSTRT_TXDLYS: Final = 0x06
TRXOFF: Final = 0x40
RXENAB: Final = 0x0100

SYS_MASK_EVENTS: Final = TXFRS | RXFCG | RX_ERRORS | CLKPLL_LL
"""Which events raise the interrupt line (UM 7.2.16)."""

TX_FCTRL: Final = 0x0016_C000
"""6.8 Mbit/s (TXBR 2), ranging bit, PRF 64 MHz (TXPRF 2), 128 symbols (TXPSR 1, PE 1); the length is added
(UM 7.2.10, Table 16)."""

TX_POWER: Final = 0x2545_6585
"""Smart power, channel 5, PRF 64 MHz: the manual's reference values (UM 7.2.31, Tables 19 and 20). A beacon of up to
67 bytes uses the third octet; the rule behind it is one frame per millisecond."""

CONFIGURATION: Final = (
    # file, sub-address, octets, value; channel 5, PRF 64 MHz, 6.8 Mbit/s, preamble of 128 symbols with code 9
    (0x04, 0x00, 4, 0x0000_1200),  # SYS_CFG: IRQ high, one RX buffer, smart power, no filter, no RXAUTR (UM 7.2.6)
    (0x1F, 0x00, 4, 0x4A48_0055),  # CHAN_CTRL: channels 5, RXPRF 2, codes 9, standard SFD (UM 7.2.32)
    (0x08, 0x00, 4, TX_FCTRL),
    (0x23, 0x04, 2, 0x889B),  # AGC_TUNE1 (UM 7.2.36, Table 24)
    (0x23, 0x0C, 4, 0x2502_A907),  # AGC_TUNE2 (Table 25)
    (0x23, 0x12, 2, 0x0035),  # AGC_TUNE3 (Table 26)
    (0x27, 0x02, 2, 0x0001),  # DRX_TUNE0b: 6.8 Mbit/s, standard SFD (UM 7.2.40.2, Table 30)
    (0x27, 0x04, 2, 0x008D),  # DRX_TUNE1a: PRF 64 (7.2.40.3, Table 31)
    (0x27, 0x06, 2, 0x0020),  # DRX_TUNE1b: preambles of 128 to 1024 (7.2.40.4, Table 32)
    (0x27, 0x08, 4, 0x313B_006B),  # DRX_TUNE2: PRF 64, PAC 8 (7.2.40.5, Table 33; PAC 8 for 128 symbols: Table 6)
    (0x27, 0x20, 2, 129),  # DRX_SFDTOC: preamble + 1 + SFD - PAC = 128 + 1 + 8 - 8; never 0 (7.2.40.7)
    (0x27, 0x26, 2, 0x0028),  # DRX_TUNE4H: preambles from 128 (7.2.40.10, Table 34)
    (0x28, 0x0B, 1, 0xD8),  # RF_RXCTRLH: channel 5 (UM 7.2.41, Table 37)
    (0x28, 0x0C, 4, 0x001E_3FE0),  # RF_TXCTRL: channel 5 (Table 38)
    (0x2A, 0x0B, 1, 0xC0),  # TC_PGDELAY: channel 5 (UM 7.2.43, Table 40)
    (0x2B, 0x07, 4, 0x0800_041D),  # FS_PLLCFG: channel 5 (UM 7.2.44, Table 43)
    (0x2B, 0x0B, 1, 0xBE),  # FS_PLLTUNE: channel 5 (Table 44)
    (0x2E, 0x0806, 1, 0x6D),  # LDE_CFG1: PMULT 3, NTM 13 (UM 7.2.47.2, 2.5.5.4)
    (0x2E, 0x1806, 2, 0x0607),  # LDE_CFG2: PRF 64 (7.2.47.6, 2.5.5.5)
    (0x2E, 0x2804, 2, 0x28F4),  # LDE_REPC: code 9 (7.2.47.7)
)

# Addresses in the one-time programmable memory (UM 6.3, Table 10)
OTP_LDOTUNE: Final = 0x04
OTP_PART_ID: Final = 0x06
OTP_LOT_ID: Final = 0x07
OTP_VOLTAGE: Final = 0x08
OTP_TEMPERATURE: Final = 0x09
OTP_CRYSTAL_TRIM: Final = 0x1E

RESET_US: Final = 5000
"""From the release of RSTn until the chip is in INIT (data sheet 5.6: some 3 ms)."""
LDE_LOAD_US: Final = 300
"""The microcode's load takes 150 µs (UM 2.5.5.10, Table 4)."""
LOCK_TRIES: Final = 50
LDE_TRIES: Final = 10
"""How often 100 µs for the PLL's lock, and 20 µs for the first path's search, are waited for."""

SFD_ACCUMULATED: Final = 5
"""Symbols of the standard SFD in RXPACC where it did not saturate (UM 7.2.18, p. 95, Table 18)."""
POWER_A: Final = 1_217_400
"""The constant A at PRF 64 MHz, 121.74 dB, in 1e-4 dB (UM 4.7.1, p. 46)."""
LOG10_2: Final = 30_103

# fmt: off
_LOG10: Final = (
    0, 1336, 2633, 3892, 5115, 6305, 7463, 8591, 9691, 10763, 11810,
    12832, 13830, 14806, 15761, 16695, 17609, 18505, 19382, 20242, 21085, 21913,
    22724, 23521, 24304, 25072, 25828, 26570, 27300, 28018, 28724, 29419, 30103,
)
# fmt: on
"""100 000 log10(1 + i/32)."""

_BIAS_MM: Final = (-110, -105, -100, -93, -82, -69, -51, -27, 0, 21, 35, 42, 49, 62, 71, 76, 81, 86)
"""How far off a received stamp is at -61, -63 … -95 dBm (Decawave APS011, Table 2: 500 MHz, PRF 64 MHz)."""


class ChipError(Exception):
    """There is no DW1000 on the bus, or it does not start; the message states what was found."""


class Bus(Protocol):
    """The hardware that the driver needs; each method may raise OSError."""

    def transfer(self, out: bytes) -> bytes:
        """One SPI transaction (mode 0): what the chip sends while it receives ``out``, as many octets."""

    def slow(self) -> None:
        """Clock at most 3 MHz from now on: the chip's PLL has no lock (UM 2.3.2)."""

    def fast(self) -> None:
        """Clock at most 20 MHz from now on."""

    def reset(self) -> bool:
        """Pull RSTn low for a moment and let go (never drive it high); False where it is not wired."""

    def pause_us(self, microseconds: int) -> None:
        """Wait at least that long."""


def header(is_write: bool, file: int, sub: int) -> bytes:
    """Header of one to three octets of an SPI transaction (UM 2.2.1.2, pp. 11-13)."""
    first = file | (0x80 if is_write else 0)
    if sub == 0:
        return bytes((first,))
    if sub < 0x80:
        return bytes((first | 0x40, sub))
    return bytes((first | 0x40, 0x80 | (sub & 0x7F), sub >> 7))


def log10(value: int) -> int:
    """100 000 log10 of a number from 1 to 2**30 - 1, to 8 of its units."""
    exponent = 15
    while value >= 0x10000:
        value >>= 1
        exponent += 1
    while value < 0x8000:
        value <<= 1
        exponent -= 1
    at = (value - 0x8000) >> 10
    return exponent * LOG10_2 + _LOG10[at] + (((_LOG10[at + 1] - _LOG10[at]) * (value & 0x3FF)) >> 10)


def accumulated(symbols: int) -> int:
    """What the formulas of power subtract for RXPACC symbols in 1e-4 dB: A, and 20 log10; 0 where there are none."""
    return POWER_A + 2 * log10(symbols) if symbols > 0 else 0


def power_cdbm(cir_power: int, level: int) -> int:
    """Received power in 0.01 dBm from CIR_PWR and what ``accumulated`` gave (UM 4.7.2), or NOT_MEASURED."""
    if cir_power == 0 or level == 0:
        return NOT_MEASURED
    power = log10(cir_power) + 17 * LOG10_2 - level
    return (power + 50) // 100


def first_path_cdbm(f1: int, f2: int, f3: int, level: int) -> int:
    """First path's power in 0.01 dBm from its amplitudes and ``accumulated`` (UM 4.7.1), or NOT_MEASURED."""
    if level == 0:
        return NOT_MEASURED
    while f1 >= 0x4000 or f2 >= 0x4000 or f3 >= 0x4000:
        f1 >>= 1
        f2 >>= 1
        f3 >>= 1
        level -= 2 * LOG10_2
    squares = f1 * f1 + f2 * f2 + f3 * f3
    if squares == 0:
        return NOT_MEASURED
    power = log10(squares) - level
    return (power + 50) // 100


def carrier_offset_ppb(integrator: int) -> int:
    """The sender's carrier against ours in 1e-9 from DRX_CAR_INT; positive: the sender is fast (UM p. 151, Table 35).

    One step is -1e9 / (6.5 · 2**28) = -0.57311 of them on channel 5. NOT_MEASURED beyond 32 767.
    """
    if integrator > 57_170 or integrator < -57_170:
        return NOT_MEASURED
    return (8192 - integrator * 9390) >> 14


def bias_ticks(rx_power_cdbm: int) -> int:
    """How many ticks late a stamp is at that power: straight lines between the values of APS011, held beyond them."""
    below = -6100 - rx_power_cdbm  # 0.01 dB
    below = 0 if below < 0 else 3399 if below > 3399 else below
    at = below // 200
    low = _BIAS_MM[at]
    parts = low * 200 + (_BIAS_MM[at + 1] - low) * (below - at * 200)
    return (parts * 1000 + 469_176) // 938_353  # a tick is 4.691764 mm


class DW1000:
    """One chip. ``errors`` are failed receptions of any kind."""

    def __init__(self, bus: Bus) -> None:
        self.state = OFF
        self.measuring = True
        """Whether powers and carrier offset are read with each frame, in two transactions more; else NOT_MEASURED."""
        self.correct_bias = False
        """Whether ``rx_ticks`` are corrected for received power (APS011); needs ``measuring``."""
        self.received = 0
        self.errors = 0
        self.sent = 0
        self.late = 0
        self.error_status = 0
        """SYS_STATUS of the last error; 0 for a frame that was too short."""
        self.frame = b""
        self.rx_ticks = 0
        self.tx_ticks = 0
        self.rx_power_cdbm = NOT_MEASURED
        self.first_path_cdbm = NOT_MEASURED
        self.offset_ppb = NOT_MEASURED
        self.carrier_integrator = 0
        self.temperature_cc = NOT_MEASURED
        self.millivolts = 0
        """Of the last ``measure``."""
        self.identity = bytes(8)
        """Part and lot number, from ``start``."""
        self._bus = bus
        self._listening = False
        self._temperature_23 = 0
        self._voltage_33 = 0
        self._status = 0
        """SYS_STATUS as it was read last."""

    # Starting

    def start(
        self, tx_delay_ticks: int, rx_delay_ticks: int, tx_power: int = TX_POWER, crystal_trim: int | None = None
    ) -> None:
        """Reset and configure the chip; antenna delays of 16 bits, crystal trim from OTP unless it is given.

        Raises:
            ChipError: no DW1000 answers, or its clock does not lock.
        """
        self.state = OFF
        self._listening = False
        self._bus.slow()
        if self._bus.reset():
            self._bus.pause_us(RESET_US)
        self._identify("")
        self._soft_reset()
        self._calibrate(crystal_trim)
        self._load_microcode()
        self._wait_for_lock()
        self._bus.fast()
        self._identify(" at full speed")
        for file, sub, size, value in CONFIGURATION:
            self._write(file, sub, size, value)
        self._write(0x1E, 0, 4, tx_power)
        self.set_antenna_delays(tx_delay_ticks, rx_delay_ticks)
        self._write(0x0E, 0, 4, SYS_MASK_EVENTS)
        self._off_and_clear()
        self.state = IDLE

    def set_antenna_delays(self, tx_delay_ticks: int, rx_delay_ticks: int) -> None:
        """TX_ANTD (UM 7.2.26, p. 103) and LDE_RXANTD (7.2.47.5), which the chip includes in all its stamps."""
        self._write(0x18, 0, 2, tx_delay_ticks)
        self._write(0x2E, 0x1804, 2, rx_delay_ticks)

    def _write(self, file: int, sub: int, size: int, value: int) -> None:
        self._bus.transfer(header(True, file, sub) + value.to_bytes(size, "little"))

    def _read(self, file: int, sub: int, size: int) -> bytes:
        head = header(False, file, sub)
        return self._bus.transfer(head + bytes(size))[len(head) :]

    def _read_number(self, file: int, sub: int, size: int) -> int:
        return int.from_bytes(self._read(file, sub, size), "little")

    def _identify(self, when: str) -> None:
        found = self._read(0x00, 0, 4)
        if found != DEVICE_ID:
            number = found[::-1].hex().upper()
            raise ChipError(f"no DW1000{when}: its identifier is DECA0130, read was {number}")

    def _soft_reset(self) -> None:
        """Crystal clock; nothing to be restored by the always-on block; SOFTRESET (UM 7.2.50.1, 7.2.45)."""
        self._write(0x36, 0, 2, 0x0201)  # PMSC_CTRL0: SYSCLKS 1
        self._write(0x2C, 0x00, 2, 0)  # AON_WCFG
        self._write(0x2C, 0x06, 1, 0)  # AON_CFG0: no sleep
        self._write(0x2C, 0x02, 1, 0)  # AON_CTRL
        self._write(0x2C, 0x02, 1, 0x02)  # AON_CTRL: SAVE
        self._write(0x36, 3, 1, 0x00)
        self._bus.pause_us(1000)
        self._write(0x36, 3, 1, 0xF0)
        self._bus.pause_us(1000)
        self._write(0x36, 0, 2, 0x0201)

    def _read_otp(self, address: int) -> bytes:
        """One word of the one-time programmable memory (UM 6.3.2, 7.2.46)."""
        self._write(0x2D, 0x04, 2, address)
        self._write(0x2D, 0x06, 1, 0x03)  # OTP_CTRL: OTPRDEN, OTPREAD
        self._write(0x2D, 0x06, 1, 0x00)
        return self._read(0x2D, 0x0A, 4)

    def _calibrate(self, crystal_trim: int | None) -> None:
        """What was measured when the chip or module was made: supply, crystal, temperature (UM 2.5.5.11, 8.1, 6.4)."""
        self._write(0x24, 0x00, 4, 0x04)  # EC_CTRL: PLLLDT, without which CPLOCK means nothing (UM 7.2.37.1)
        if self._read_otp(OTP_LDOTUNE)[0] != 0:
            self._write(0x2D, 0x12, 1, 0x02)  # OTP_SF: LDO_KICK
        self._voltage_33 = self._read_otp(OTP_VOLTAGE)[0]
        self._temperature_23 = self._read_otp(OTP_TEMPERATURE)[0]
        self.identity = self._read_otp(OTP_PART_ID) + self._read_otp(OTP_LOT_ID)
        if crystal_trim is None:
            crystal_trim = self._read_otp(OTP_CRYSTAL_TRIM)[0] & 0x1F or 0x10  # not trimmed: mid-range
        self._write(0x2B, 0x0E, 1, 0x60 | crystal_trim & 0x1F)  # FS_XTALT: the upper three bits are 011 (UM 7.2.44.5)

    def _load_microcode(self) -> None:
        """The leading-edge search, without which there are no RX stamps (UM 2.5.5.10, Table 4)."""
        self._write(0x36, 0, 2, 0x0301)
        self._write(0x2D, 0x06, 2, 0x8000)  # OTP_CTRL: LDELOAD
        self._bus.pause_us(LDE_LOAD_US)

    def _wait_for_lock(self) -> None:
        """Let the PLL lock, without a transaction while the clock changes, which would garble it (UM 2.3.2)."""
        self._write(0x36, 0, 2, 0x0200)  # PMSC_CTRL0: clocks by themselves
        for _ in range(LOCK_TRIES):
            self._bus.pause_us(100)
            if self._read_status() & CPLOCK:
                return
        raise ChipError("the DW1000's clock does not lock: is its crystal or supply sound?")

    # Running

    def receive(self) -> None:
        """Listen from now on; a frame that waits to be sent is sent before."""
        if self.state == OFF:
            return
        self._listening = True
        if self.state == IDLE:
            self._resume()

    def stop(self) -> None:
        """Leave LISTENING or SENDING for IDLE, whatever is under way."""
        if self.state != OFF:
            self._listening = False
            self._off_and_clear()
            self.state = IDLE

    def transmit_at(self, dx_ticks: int, frame: bytes) -> int:
        """Send a PSDU when the counter is at ``dx_ticks``; QUEUED, or why not.

        Its low nine bits are ignored (UM p. 26). The stamp will be that + the TX antenna delay. The last two bytes of
        the frame are replaced by the FCS, which the chip makes.

        Raises:
            ValueError: no PSDU has this length.
        """
        size = len(frame)
        if not MIN_PSDU_BYTES <= size <= MAX_PSDU_BYTES:
            raise ValueError("a PSDU has 3 to 127 bytes")
        if self.state == OFF:
            return NOT_READY
        if self.state == SENDING:
            return BUSY
        self._bus.transfer(header(True, 0x09, 0) + frame[:-2])
        self._write(0x08, 0, 4, TX_FCTRL | size)
        self._write(0x0A, 0, 5, dx_ticks & ~0x1FF)
        self._off_and_clear()
        self._write(0x0D, 0, 1, TXSTRT_TXDLYS)
        self.state = SENDING
        return self._was_in_time()

    def _was_in_time(self) -> int:
        """Check whether the frame will be sent at its time, and cancel it if not (UM pp. 27, 91, 92).

        HPDWARN: its time has passed, and it would leave after 17 s. TXPUTE: the transmitter had no time to power up;
        the stamp would be right, but the preamble is damaged. What is already out when TRXOFF comes counts as sent.
        """
        status = self._read_status()
        if status & TXFRS or not status & (HPDWARN | TXPUTE):
            return QUEUED
        if not self.cancel():
            return QUEUED
        self.late += 1
        return LATE

    def cancel(self) -> bool:
        """Cancel a frame that has not been sent; False where it has, which the next ``poll`` will return."""
        if self.state != SENDING:
            return True
        self._turn_off()
        if self._read_status() & TXFRS:
            return False
        self._resume()
        return True

    def poll(self) -> int:
        """What has happened since: a sum of RECEIVED, SENT, FAILED, CLOCK_SLIPPED, LOST; 0 for nothing."""
        if self.state == OFF:
            return LOST
        status = self._read_status()
        if (not status & CPLOCK or status & (SLP2INIT | UNUSED)) and not self.check():
            return LOST
        events = 0
        if status & CLKPLL_LL:
            events = CLOCK_SLIPPED
            self._write(0x0F, 0, STATUS_OCTETS, CLKPLL_LL)  # alone: a frame may be coming in
        if self.state == SENDING:
            if status & TXFRS:
                events |= self._finish_sending()
        elif self.state == LISTENING:
            if status & RX_ERRORS:
                events |= self._recover(status)
            elif status & RXFCG:
                events |= self._read_frame()
        return events

    def check(self) -> bool:
        """Whether the chip still has its configuration; if not it is OFF.

        ``poll`` calls this when SYS_STATUS looks implausible. A chip whose supply failed may lock again unnoticed and
        report nothing for ever, so this is to be called periodically where nothing is received for long.
        """
        if self.state == OFF:
            return False
        if self._read(0x1F, 0, 4) == CONFIGURATION[1][3].to_bytes(4, "little"):
            return True
        self.state = OFF
        self._listening = False
        return False

    def now(self) -> int:
        """The counter now, in steps of 512 ticks (UM 7.2.8)."""
        return self._read_number(0x06, 0, 5)

    def measure(self) -> bool:
        """Measure temperature and supply in some 1.1 ms, in which nothing is received (UM 6.4, pp. 158-159)."""
        if self.state in (OFF, SENDING):
            return False
        self._off_and_clear()
        self._write(0x28, 0x11, 1, 0x80)  # bias of the temperature sensor
        self._write(0x28, 0x12, 1, 0x0A)  # bias of the converter
        self._write(0x28, 0x12, 1, 0x0F)  # outputs
        self._write(0x2A, 0x00, 1, 0x00)  # TC_SARC
        self._write(0x2A, 0x00, 1, 0x01)
        self._bus.pause_us(1000)
        self._convert(self._read(0x2A, 0x03, 1)[0], self._read(0x2A, 0x04, 1)[0])
        self._write(0x2A, 0x00, 1, 0x00)
        if self._listening:
            self._resume()
        return True

    def _convert(self, voltage: int, temperature: int) -> None:
        """From the converter's readings; with typical values where the chip brought none of its own."""
        if self._temperature_23 != 0:
            self.temperature_cc = (temperature - self._temperature_23) * 114 + 2300
        else:
            self.temperature_cc = temperature * 113 - 11_300
        if self._voltage_33 != 0:
            self.millivolts = (voltage - self._voltage_33) * 1000 // 173 + 3300
        else:
            self.millivolts = voltage * 57 // 10 + 2300

    def _read_status(self) -> int:
        self._status = self._read_number(0x0F, 0, STATUS_OCTETS)
        return self._status

    def _clear(self) -> None:
        """Clear what the last reading of SYS_STATUS has shown; what came since stays."""
        self._write(0x0F, 0, STATUS_OCTETS, self._status & CLEARED)

    def _turn_off(self) -> None:
        self._write(0x0D, 0, 1, TRXOFF)

    def _enable(self) -> None:
        self._write(0x0D, 0, 2, RXENAB)

    def _off_and_clear(self) -> None:
        """Turn the transceiver off and forget all events (UM 7.2.15)."""
        self._turn_off()
        self._write(0x0F, 0, STATUS_OCTETS, CLEARED)

    def _resume(self) -> None:
        """LISTENING or IDLE again, with all events forgotten."""
        self._off_and_clear()
        self._listen_again()

    def _listen_again(self) -> None:
        """Listen, or be IDLE, after an error or after the receiver was turned off, perhaps in the middle of a frame.

        It must be reset then, or the next stamp may be wrong (UM 4.1.6, pp. 34-35).
        """
        if self._listening:
            self._write(0x36, 3, 1, 0xE0)
            self._write(0x36, 3, 1, 0xF0)
            self._enable()
            self.state = LISTENING
        else:
            self.state = IDLE

    def _finish_sending(self) -> int:
        self.tx_ticks = self._read_number(0x17, 0, 5)
        self.sent += 1
        self._clear()
        self._listen_again()
        return SENT

    def _recover(self, status: int) -> int:
        """Count an error and listen on."""
        self.errors += 1
        self.error_status = status
        self._resume()
        return FAILED

    def _read_frame(self) -> int:
        """Read a frame and all that was measured of it, and listen on."""
        tries = LDE_TRIES
        while not self._status & LDEDONE:
            if tries == 0:
                return self._recover(RXFCG)
            tries -= 1
            self._bus.pause_us(20)
            if self._read_status() & LDEERR:
                return self._recover(RXFCG | LDEERR)
        info = self._read_number(0x10, 0, 4)
        size = info & 0x7F
        if size < MIN_PSDU_BYTES:
            return self._recover(0)
        self.frame = self._read(0x11, 0, size)
        time = self._read(0x15, 0, 9)
        self.rx_ticks = int.from_bytes(time[:5], "little")
        if self.measuring:
            self._read_diagnostics(symbols=info >> 20, first_amplitude=time[7] | time[8] << 8)
        else:
            self.rx_power_cdbm = self.first_path_cdbm = self.offset_ppb = NOT_MEASURED
        self.received += 1
        self._clear()
        self._enable()
        return RECEIVED

    def _read_diagnostics(self, *, symbols: int, first_amplitude: int) -> None:
        """Powers and carrier offset from RXPACC and FP_AMPL1 (UM 4.7, 7.2.18, 7.2.20, 7.2.23, 7.2.40.11)."""
        _, second_amplitude, third_amplitude, cir_power = struct.unpack("<4H", self._read(0x12, 0, 8))
        carrier = self._read(0x27, 0x28, 6)
        if symbols == int.from_bytes(carrier[4:], "little"):
            symbols -= SFD_ACCUMULATED
        level = accumulated(symbols)
        self.rx_power_cdbm = power_cdbm(cir_power, level)
        self.first_path_cdbm = first_path_cdbm(first_amplitude, second_amplitude, third_amplitude, level)
        integrator = int.from_bytes(carrier[:3], "little") & 0x1F_FFFF
        self.carrier_integrator = integrator - 0x20_0000 if integrator & 0x10_0000 else integrator
        self.offset_ppb = carrier_offset_ppb(self.carrier_integrator)
        if self.correct_bias and self.rx_power_cdbm != NOT_MEASURED:
            self.rx_ticks = wrap(self.rx_ticks - bias_ticks(self.rx_power_cdbm))
