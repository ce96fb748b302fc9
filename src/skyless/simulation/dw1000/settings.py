"""Whether the chip is set up for the emulated air: channel 5, PRF 64 MHz, 6.8 Mbit/s, a preamble of 128, code 9.

A chip with another setting hears nothing and is not heard. Tuning registers count as well: a real receiver that is
tuned otherwise would still hear something, but a driver with a wrong value is to show.
"""

from typing import Final

from skyless.simulation.dw1000 import bits
from skyless.simulation.dw1000 import registers as r
from skyless.simulation.dw1000.memory import Memory

CHANNEL: Final = 5
CODE: Final = 9
PRF_64: Final = 0b10
RATE_6M8: Final = 0b10
PREAMBLE_128: Final = 0b0101
"""TXPSR and, above it, PE (UM 7.2.10: table 16)."""


def why_deaf(memory: Memory) -> str | None:
    """What keeps the receiver from understanding the air's frames; None where nothing does."""
    control, config = memory.get(r.CHAN_CTRL), memory.get(r.SYS_CFG)
    if control >> 4 & 0xF != CHANNEL or control & 0xF != CHANNEL:
        return "channel"
    if control >> 18 & 0b11 != PRF_64:
        return "prf"
    if control >> 27 != CODE:
        return "code"
    if control & (1 << 17 | 1 << 21):  # DWSFD, RNSSFD: another start-of-frame delimiter
        return "sfd"
    if config & bits.RXM110K or config & bits.PHR_MODE:
        return "rate"
    return next((name for name, (register, value) in bits.TUNED.items() if memory.get(register) != value), None)


def is_tuned_to_send(memory: Memory) -> bool:
    """Whether the air's receivers understand what the transmitter would send."""
    control, frame = memory.get(r.CHAN_CTRL), memory.get(r.TX_FCTRL)
    return (
        control & 0xF == CHANNEL
        and control >> 22 & 0x1F == CODE
        and not control & (1 << 17 | 1 << 20)  # DWSFD, TNSSFD
        and frame >> 16 & 0b11 == PRF_64
        and frame >> 13 & 0b11 == RATE_6M8
        and frame >> 18 & 0b1111 == PREAMBLE_128
        and not memory.get(r.SYS_CFG) & bits.PHR_MODE
        and all(memory.get(register) == value for register, value in bits.TUNED_TO_SEND.values())
    )
