"""How anchors are named: by their numbers, and those of FiRa's systems by their MAC addresses, as ``C974``."""

import re
from typing import Final

_SHORT_DIGITS, _LONG_DIGITS = 4, 16
_ADDRESS: Final = re.compile(rf"[0-9A-Fa-f]{{{_SHORT_DIGITS}}}|[0-9A-Fa-f]{{{_LONG_DIGITS}}}")

IDENTIFIER: Final = (
    "a whole number, a hexadecimal one after 0x, or a MAC address of 4 or 16 hexadecimal digits, as C974"
)


def anchor_name(anchor: int, *, addresses: bool) -> str:
    """The name of an anchor; ``addresses``: whether identifiers are MAC addresses."""
    if not addresses:
        return str(anchor)
    return f"{anchor:0{_SHORT_DIGITS if anchor < 1 << 4 * _SHORT_DIGITS else _LONG_DIGITS}X}"


def is_address(text: str) -> bool:
    """Whether a name can only be a MAC address: one of the digits is a letter."""
    return _ADDRESS.fullmatch(text) is not None and not text.isdecimal()


def read_anchor(text: str, *, addresses: bool = False) -> int:
    """The identifier that a name stands for.

    ``addresses``: whether 4 or 16 decimal digits are a MAC address, too. Raises ValueError.
    """
    if is_address(text) or (addresses and _ADDRESS.fullmatch(text)):
        return int(text, 16)
    anchor = int(text, 0) if text.lower().startswith("0x") else int(text)
    if anchor < 0:
        raise ValueError(text)
    return anchor
