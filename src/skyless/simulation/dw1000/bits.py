"""Bits of the registers that the model follows (DW1000 User Manual v2.12), as masks, and the air's settings in them."""

from typing import Final

from skyless.simulation.dw1000 import registers as r


def _bit(number: int) -> int:
    return 1 << number


# SYS_CTRL (UM 7.2.15, pp. 80-84)
SFCST: Final = _bit(0)
TXSTRT: Final = _bit(1)
TXDLYS: Final = _bit(2)
CANSFCS: Final = _bit(3)
TRXOFF: Final = _bit(6)
WAIT4RESP: Final = _bit(7)
RXENAB: Final = _bit(8)
RXDLYE: Final = _bit(9)
HRBPT: Final = _bit(24)

# SYS_STATUS (UM 7.2.17, pp. 86-93); SYS_MASK has the same places
IRQS: Final = _bit(0)
CPLOCK: Final = _bit(1)
ESYNCR: Final = _bit(2)
AAT: Final = _bit(3)
TXFRB: Final = _bit(4)
TXPRS: Final = _bit(5)
TXPHS: Final = _bit(6)
TXFRS: Final = _bit(7)
RXPRD: Final = _bit(8)
RXSFDD: Final = _bit(9)
LDEDONE: Final = _bit(10)
RXPHD: Final = _bit(11)
RXPHE: Final = _bit(12)
RXDFR: Final = _bit(13)
RXFCG: Final = _bit(14)
RXFCE: Final = _bit(15)
RXRFSL: Final = _bit(16)
RXRFTO: Final = _bit(17)
LDEERR: Final = _bit(18)
RXOVRR: Final = _bit(20)
RXPTO: Final = _bit(21)
GPIOIRQ: Final = _bit(22)
SLP2INIT: Final = _bit(23)
RFPLL_LL: Final = _bit(24)
CLKPLL_LL: Final = _bit(25)
RXSFDTO: Final = _bit(26)
HPDWARN: Final = _bit(27)
TXBERR: Final = _bit(28)
AFFREJ: Final = _bit(29)
HSRBP: Final = _bit(30)
ICRBP: Final = _bit(31)
RXRSCS: Final = _bit(32)
RXPREJ: Final = _bit(33)
TXPUTE: Final = _bit(34)

READ_ONLY: Final = IRQS | HPDWARN | HSRBP | ICRBP
"""What writing a 1 does not clear (pp. 86, 91, 92)."""
OF_SENDING: Final = AAT | TXFRB | TXPRS | TXPHS | TXFRS | TXPUTE
"""Forgotten when the transmitter is enabled again."""
OF_RECEIVING: Final = (
    RXPRD | RXSFDD | LDEDONE | RXPHD | RXPHE | RXDFR | RXFCG | RXFCE | RXRFSL | RXRFTO | LDEERR | RXOVRR | RXPTO
    | RXSFDTO | AFFREJ | RXRSCS | RXPREJ
)  # fmt: skip
"""Forgotten when the receiver is enabled again."""

# SYS_CFG (UM 7.2.6)
HIRQ_POL: Final = _bit(9)
DIS_DRXB: Final = _bit(12)
PHR_MODE: Final = 0b11 << 16
RXM110K: Final = _bit(22)
RXWTOE: Final = _bit(28)
RXAUTR: Final = _bit(29)

# PMSC (UM 7.2.50)
SYSCLKS: Final = 0b11
SYSCLKS_AUTO: Final = 0
SYSCLKS_XTI: Final = 1
SOFTRESET_SHIFT: Final = 28
SOFTRESET_ALL: Final = 0x0
SOFTRESET_RX: Final = 0xE
SOFTRESET_NONE: Final = 0xF
LDERUNE: Final = _bit(17)  # of PMSC_CTRL1
PMSC_FOR_LDE: Final = 0x0301
"""Low half of PMSC_CTRL0 while the microcode is loaded (UM 2.5.5.10)."""

# OTP_CTRL (UM 7.2.46.3)
OTPRDEN: Final = _bit(0)
OTPREAD: Final = _bit(1)
LDELOAD: Final = _bit(15)

TUNED: Final[dict[str, tuple[r.Register, int]]] = {
    "AGC_TUNE1": (r.AGC_TUNE1, 0x889B),  # table 24
    "AGC_TUNE2": (r.AGC_TUNE2, 0x2502A907),  # table 25
    "AGC_TUNE3": (r.AGC_TUNE3, 0x0035),  # table 26
    "DRX_TUNE0B": (r.DRX_TUNE0B, 0x0001),  # table 30
    "DRX_TUNE1A": (r.DRX_TUNE1A, 0x008D),  # table 31
    "DRX_TUNE1B": (r.DRX_TUNE1B, 0x0020),  # table 32
    "DRX_TUNE2": (r.DRX_TUNE2, 0x313B006B),  # table 33
    "DRX_TUNE4H": (r.DRX_TUNE4H, 0x0028),  # table 34
    "RF_RXCTRLH": (r.RF_RXCTRLH, 0xD8),  # table 37
    "FS_PLLCFG": (r.FS_PLLCFG, 0x0800041D),  # table 43
    "FS_PLLTUNE": (r.FS_PLLTUNE, 0xBE),  # table 44
    "LDE_CFG2": (r.LDE_CFG2, 0x0607),  # table 50
    "LDE_REPC": (r.LDE_REPC, 0x28F4),  # table 51, code 9
}
"""What a receiver on channel 5 at PRF 64 MHz, code 9, 6.8 Mbit/s with a preamble of 128 and PAC 8 is to be set to."""

TUNED_TO_SEND: Final[dict[str, tuple[r.Register, int]]] = {
    "RF_TXCTRL": (r.RF_TXCTRL, 0x001E3FE0),  # table 38
    "TC_PGDELAY": (r.TC_PGDELAY, 0xC0),  # table 40
    "FS_PLLCFG": (r.FS_PLLCFG, 0x0800041D),
    "FS_PLLTUNE": (r.FS_PLLTUNE, 0xBE),
}
