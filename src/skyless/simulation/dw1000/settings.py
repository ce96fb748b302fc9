"""Whether the chip is set up for the emulated air: channel 5, PRF 64 MHz, 6.8 Mbit/s, a preamble of 128, code 9.

A chip with other settings receives nothing and is not received. Tuning registers count as well: a real receiver that
is tuned otherwise would still receive something, but a wrong value in a driver has to show.
"""

from typing import Final

from skyless.simulation.dw1000 import registers as r
from skyless.simulation.dw1000.memory import Memory

_CHANNEL: Final = 5
_CODE: Final = 9
_PRF_64: Final = 0b10
_RATE_6M8: Final = 0b10
_PREAMBLE_128: Final = 0b0101
"""TXPSR and, above it, PE (UM 7.2.10: table 16)."""

TUNED_TO_RECEIVE: Final[dict[str, int]] = {
    "AGC_TUNE1": 0x889B,  # table 24
    "AGC_TUNE2": 0x2502A907,  # table 25
    "AGC_TUNE3": 0x0035,  # table 26
    "DRX_TUNE0B": 0x0001,  # table 30
    "DRX_TUNE1A": 0x008D,  # table 31
    "DRX_TUNE1B": 0x0020,  # table 32
    "DRX_TUNE2": 0x313B006B,  # table 33
    "DRX_TUNE4H": 0x0028,  # table 34
    "RF_RXCTRLH": 0xD8,  # table 37
    "FS_PLLCFG": 0x0800041D,  # table 43
    "FS_PLLTUNE": 0xBE,  # table 44
    "LDE_CFG2": 0x0607,  # table 50
    "LDE_REPC": 0x28F4,  # table 51, code 9
}
"""Values of registers for channel 5, PRF 64 MHz, code 9, 6.8 Mbit/s, a preamble of 128 and PAC 8."""

TUNED_TO_SEND: Final[dict[str, int]] = {
    "RF_TXCTRL": 0x001E3FE0,  # table 38
    "TC_PGDELAY": 0xC0,  # table 40
    "FS_PLLCFG": 0x0800041D,
    "FS_PLLTUNE": 0xBE,
}


def can_receive(memory: Memory) -> bool:
    """Whether the receiver understands the frames on the air."""
    control, config = memory.get(r.CHAN_CTRL), memory.get(r.SYS_CFG)
    return (
        control >> 4 & 0xF == control & 0xF == _CHANNEL
        and control >> 18 & 0b11 == _PRF_64
        and control >> 27 == _CODE
        and not control & (1 << 17 | 1 << 21)  # DWSFD, RNSSFD: another start-of-frame delimiter
        and not config & (r.RXM110K | r.PHR_MODE)
        and _has(memory, TUNED_TO_RECEIVE)
    )


def can_send(memory: Memory) -> bool:
    """Whether receivers understand what the transmitter would send."""
    control, frame = memory.get(r.CHAN_CTRL), memory.get(r.TX_FCTRL)
    return (
        control & 0xF == _CHANNEL
        and control >> 22 & 0x1F == _CODE
        and not control & (1 << 17 | 1 << 20)  # DWSFD, TNSSFD
        and frame >> 16 & 0b11 == _PRF_64
        and frame >> 13 & 0b11 == _RATE_6M8
        and frame >> 18 & 0b1111 == _PREAMBLE_128
        and not memory.get(r.SYS_CFG) & r.PHR_MODE
        and _has(memory, TUNED_TO_SEND)
    )


def _has(memory: Memory, values: dict[str, int]) -> bool:
    return all(memory.get(r.ALL_REGISTERS[name]) == value for name, value in values.items())
