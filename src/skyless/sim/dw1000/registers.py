"""Registers of the DW1000 and their bits, from sections 7.2 and 2.5 of the User Manual v2.12 ("UM").

The driver has its own table; ``tests/sim/test_dw1000_tables.py`` compares both with a third.
"""

from collections import Counter
from typing import Final

from msgspec import Struct


class Register(Struct, frozen=True):
    """A register file or sub-register."""

    file: int
    sub: int
    length: int
    """Octets."""
    reset: int = 0
    """Value after a reset; of tuning registers, only those that section 2.5 says to change are known exactly."""
    access: str = "RW"
    """RW; RO, unaffected by writing; WO, reads as zeros."""


# Identity and configuration (UM 7.2.2 to 7.2.14)
DEV_ID: Final = Register(0x00, 0x00, 4, 0xDECA0130, "RO")  # 7.2.2
PANADR: Final = Register(0x03, 0x00, 4, 0xFFFFFFFF)  # 7.2.5, of the frame filter
SYS_CFG: Final = Register(0x04, 0x00, 4, 0x00001200)  # 7.2.6
SYS_TIME: Final = Register(0x06, 0x00, 5, 0, "RO")  # 7.2.8
TX_FCTRL: Final = Register(0x08, 0x00, 5, 0x0015400C)  # 7.2.10, pp. 73-77
TX_BUFFER: Final = Register(0x09, 0x00, 1024, 0, "WO")  # 7.2.11, p. 77
DX_TIME: Final = Register(0x0A, 0x00, 5)  # 7.2.12
RX_FWTO: Final = Register(0x0C, 0x00, 2)  # 7.2.14, p. 79
SYS_CTRL: Final = Register(0x0D, 0x00, 4)  # 7.2.15, pp. 80-84
SYS_MASK: Final = Register(0x0E, 0x00, 4)  # 7.2.16
SYS_STATUS: Final = Register(0x0F, 0x00, 5)  # 7.2.17, pp. 86-93

# What was received and sent (UM 7.2.18 to 7.2.26, pp. 94-103)
RX_FINFO: Final = Register(0x10, 0x00, 4, 0, "RO")
RX_BUFFER: Final = Register(0x11, 0x00, 1024, 0, "RO")
STD_NOISE: Final = Register(0x12, 0x00, 2, 0, "RO")
FP_AMPL2: Final = Register(0x12, 0x02, 2, 0, "RO")
FP_AMPL3: Final = Register(0x12, 0x04, 2, 0, "RO")
CIR_PWR: Final = Register(0x12, 0x06, 2, 0, "RO")
RX_TTCKO: Final = Register(0x14, 0x00, 5, 0, "RO")  # 7.2.22; octet 4 is RCPHASE
RX_STAMP: Final = Register(0x15, 0x00, 5, 0, "RO")
FP_INDEX: Final = Register(0x15, 0x05, 2, 0, "RO")
FP_AMPL1: Final = Register(0x15, 0x07, 2, 0, "RO")
TX_STAMP: Final = Register(0x17, 0x00, 5, 0, "RO")
TX_ANTD: Final = Register(0x18, 0x00, 2)
TX_POWER: Final = Register(0x1E, 0x00, 4, 0x1E080222)  # 7.2.31
CHAN_CTRL: Final = Register(0x1F, 0x00, 4, 0x21040055)  # 7.2.32; channel 5, PRF 16 MHz, code 4 (2.5.2)

# Tuning (UM 7.2.36 to 7.2.44, 7.2.47)
AGC_CTRL: Final = Register(0x23, 0x00, 33)
AGC_TUNE1: Final = Register(0x23, 0x04, 2, 0x889B)
AGC_TUNE2: Final = Register(0x23, 0x0C, 4)
AGC_TUNE3: Final = Register(0x23, 0x12, 2)
EXT_SYNC: Final = Register(0x24, 0x00, 12)
EC_CTRL: Final = Register(0x24, 0x00, 4)
ACC_MEM: Final = Register(0x25, 0x00, 4064, 0, "RO")  # 7.2.38
DRX_CONF: Final = Register(0x27, 0x00, 46)
DRX_TUNE0B: Final = Register(0x27, 0x02, 2)
DRX_TUNE1A: Final = Register(0x27, 0x04, 2, 0x0087)
DRX_TUNE1B: Final = Register(0x27, 0x06, 2)
DRX_TUNE2: Final = Register(0x27, 0x08, 4, 0x311E0035)
DRX_SFDTOC: Final = Register(0x27, 0x20, 2, 4161)
DRX_TUNE4H: Final = Register(0x27, 0x26, 2)
DRX_CAR_INT: Final = Register(0x27, 0x28, 3, 0, "RO")  # p. 151
RXPACC_NOSAT: Final = Register(0x27, 0x2C, 2, 0, "RO")
RF_CONF: Final = Register(0x28, 0x00, 58)
RF_RXCTRLH: Final = Register(0x28, 0x0B, 1, 0xD8)
RF_TXCTRL: Final = Register(0x28, 0x0C, 4, 0x001E3DE0)
RF_SENSOR_1: Final = Register(0x28, 0x11, 1)  # UM 6.4: without a name, for temperature and supply
RF_SENSOR_2: Final = Register(0x28, 0x12, 1)
TX_CAL: Final = Register(0x2A, 0x00, 52)
TC_SARC: Final = Register(0x2A, 0x00, 2)  # p. 158
TC_SARL: Final = Register(0x2A, 0x03, 3, 0, "RO")  # pp. 158-159
TC_PGDELAY: Final = Register(0x2A, 0x0B, 1, 0xC5)
FS_CTRL: Final = Register(0x2B, 0x00, 21)
FS_PLLCFG: Final = Register(0x2B, 0x07, 4, 0x0800041D)
FS_PLLTUNE: Final = Register(0x2B, 0x0B, 1, 0x46)
FS_XTALT: Final = Register(0x2B, 0x0E, 1, 0x60)
AON: Final = Register(0x2C, 0x00, 12)
AON_WCFG: Final = Register(0x2C, 0x00, 2)
AON_CTRL: Final = Register(0x2C, 0x02, 1)
AON_CFG0: Final = Register(0x2C, 0x06, 4)
AON_CFG1: Final = Register(0x2C, 0x0A, 2, 0x0007)
OTP_IF: Final = Register(0x2D, 0x00, 19)
OTP_ADDR: Final = Register(0x2D, 0x04, 2)
OTP_CTRL: Final = Register(0x2D, 0x06, 2)
OTP_RDAT: Final = Register(0x2D, 0x0A, 4, 0, "RO")
OTP_SF: Final = Register(0x2D, 0x12, 1)
LDE_IF: Final = Register(0x2E, 0x0000, 0x2806)
LDE_CFG1: Final = Register(0x2E, 0x0806, 1, 0x6C)
LDE_RXANTD: Final = Register(0x2E, 0x1804, 2)
LDE_CFG2: Final = Register(0x2E, 0x1806, 2)
LDE_REPC: Final = Register(0x2E, 0x2804, 2)
PMSC: Final = Register(0x36, 0x00, 44)
PMSC_CTRL0: Final = Register(0x36, 0x00, 4, 0xF0300200)  # 7.2.50.1
PMSC_CTRL1: Final = Register(0x36, 0x04, 4, 0x81020738)  # 7.2.50.2

ALL_REGISTERS: Final = {name: value for name, value in globals().items() if isinstance(value, Register)}
FILE_LENGTHS: Final = {
    file: max(one.sub + one.length for one in ALL_REGISTERS.values() if one.file == file)
    for file in {one.file for one in ALL_REGISTERS.values()}
}

# SYS_CTRL (UM 7.2.15, pp. 80-84)
TXSTRT: Final = 1 << 1
TXDLYS: Final = 1 << 2
TRXOFF: Final = 1 << 6
RXENAB: Final = 1 << 8
RXDLYE: Final = 1 << 9
HRBPT: Final = 1 << 24

# SYS_STATUS (UM 7.2.17, pp. 86-93); SYS_MASK has the same bits
IRQS: Final = 1 << 0
CPLOCK: Final = 1 << 1
TXFRB: Final = 1 << 4
TXPRS: Final = 1 << 5
TXPHS: Final = 1 << 6
TXFRS: Final = 1 << 7
RXPRD: Final = 1 << 8
RXSFDD: Final = 1 << 9
LDEDONE: Final = 1 << 10
RXPHD: Final = 1 << 11
RXPHE: Final = 1 << 12
RXDFR: Final = 1 << 13
RXFCG: Final = 1 << 14
RXFCE: Final = 1 << 15
RXRFSL: Final = 1 << 16
RXRFTO: Final = 1 << 17
LDEERR: Final = 1 << 18
RXOVRR: Final = 1 << 20
SLP2INIT: Final = 1 << 23
CLKPLL_LL: Final = 1 << 25
RXSFDTO: Final = 1 << 26
HPDWARN: Final = 1 << 27
HSRBP: Final = 1 << 30
ICRBP: Final = 1 << 31
TXPUTE: Final = 1 << 34

READ_ONLY: Final = IRQS | HPDWARN | HSRBP | ICRBP
"""Bits that writing a 1 does not clear (pp. 86, 91, 92)."""
OF_BUFFER: Final = LDEDONE | RXDFR | RXFCG | RXFCE
"""Each of the two receive buffers has its own (UM 4.3.1)."""
OF_SENDING: Final = TXFRB | TXPRS | TXPHS | TXFRS | TXPUTE
"""Cleared when the transmitter is enabled again."""
OF_RECEIVING: Final = OF_BUFFER | RXPRD | RXSFDD | RXPHD | RXPHE | RXRFSL | RXRFTO | LDEERR | RXSFDTO
"""Cleared when the receiver is enabled again."""

# SYS_CFG (UM 7.2.6)
HIRQ_POL: Final = 1 << 9
DIS_DRXB: Final = 1 << 12
RXWTOE: Final = 1 << 28
PHR_MODE: Final = 0b11 << 16
RXM110K: Final = 1 << 22

# PMSC (UM 7.2.50)
SYSCLKS: Final = 0b11
SYSCLKS_XTI: Final = 1
SOFTRESET_SHIFT: Final = 28
SOFTRESET_ALL: Final = 0x0
SOFTRESET_RX: Final = 0xE
SOFTRESET_NONE: Final = 0xF
LDERUNE: Final = 1 << 17  # of PMSC_CTRL1
FACE: Final = 1 << 6
AMCE: Final = 1 << 15
PMSC_FOR_LDE: Final = 0x0301
"""Low half of PMSC_CTRL0 while the microcode is loaded (UM 2.5.5.10)."""

# AON_CTRL, AON_CFG0, AON_CFG1 (UM 7.2.45)
SAVE: Final = 1 << 1
SLEEP_EN: Final = 1 << 0
WAKE_SPI: Final = 1 << 2
SLEEP_CEN: Final = 1 << 0

# OTP_CTRL (UM 7.2.46.3)
OTPREAD: Final = 1 << 1
LDELOAD: Final = 1 << 15


# Octets, and transactions on them (UM 2.2.1.2, pp. 11-13)


class Access(Struct, frozen=True):
    """A transaction's header."""

    is_write: bool
    file: int
    sub: int
    octets: int
    """Length of the header."""


def decode_header(out: bytes) -> Access | None:
    """Decode a header of one to three octets: bit 7 writes, bit 6 announces a sub-address of 7 or (its bit 7) 15 bits.

    Returns None if the transaction ends within its header.
    """
    octets = 1 if not out[:1] or not out[0] & 0x40 else 2 if len(out) < 2 or not out[1] & 0x80 else 3
    if len(out) < octets:
        return None
    sub = out[1] & 0x7F if octets == 2 else (out[1] & 0x7F) | out[2] << 7 if octets == 3 else 0
    return Access(bool(out[0] & 0x80), out[0] & 0x3F, sub, octets)


class Memory:
    """All register files; reserved parts read as 0."""

    def __init__(self, misuse: Counter[str]) -> None:
        self._misuse = misuse
        self._files = {file: bytearray(length) for file, length in FILE_LENGTHS.items()}
        self._fixed = {file: bytearray(length) for file, length in FILE_LENGTHS.items()}
        for one in ALL_REGISTERS.values():
            if one.access == "RO":
                self._fixed[one.file][one.sub : one.sub + one.length] = b"\1" * one.length
        self.reset()

    def reset(self) -> None:
        """Set all registers to their power-on values."""
        for octets in self._files.values():
            octets[:] = bytes(len(octets))
        for one in ALL_REGISTERS.values():
            if one.reset:
                self.set(one, one.reset)

    def get(self, register: Register) -> int:
        """A register's value."""
        octets = self._files[register.file]
        return int.from_bytes(octets[register.sub : register.sub + register.length], "little")

    def exchange(self, hidden: dict[int, bytearray]) -> None:
        """Swap register files with others of the same numbers."""
        for file, octets in hidden.items():
            hidden[file], self._files[file] = self._files[file], octets

    def set(self, register: Register, value: int) -> None:
        """Set a register from within the chip."""
        value &= (1 << 8 * register.length) - 1
        octets = value.to_bytes(register.length, "little")
        self._files[register.file][register.sub : register.sub + register.length] = octets

    def fill(self, register: Register, octets: bytes, at: int = 0) -> None:
        """Set octets of a buffer from within the chip."""
        begin = register.sub + at
        self._files[register.file][begin : begin + len(octets)] = octets

    def octets(self, register: Register) -> bytes:
        """A register's octets, lowest first."""
        return bytes(self._files[register.file][register.sub : register.sub + register.length])

    def read(self, file: int, sub: int, length: int) -> bytes:
        """The host's read."""
        octets = self._files.get(file)
        if octets is None or sub + length > len(octets):
            self._misuse["read-beyond-register"] += 1
        return bytes(octets[sub : sub + length] if octets is not None else b"").ljust(length, b"\0")

    def write(self, file: int, sub: int, data: bytes) -> None:
        """The host's write, except to read-only registers; it must not exceed a register (UM p. 11)."""
        octets = self._files.get(file)
        if octets is None or sub + len(data) > len(octets):
            self._misuse["write-beyond-register"] += 1
            return
        fixed = self._fixed[file]
        for at, octet in enumerate(data, sub):
            if not fixed[at]:
                octets[at] = octet
