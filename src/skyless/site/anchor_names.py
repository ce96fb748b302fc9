"""How anchors are named: by their numbers, and those of FiRa's systems by their MAC addresses, as ``C974``."""

import re
from typing import Final

_ADDRESS: Final = re.compile(r"[0-9A-Fa-f]{4}|[0-9A-Fa-f]{16}")


def anchor_name(anchor: int, *, addresses: bool) -> str:
    """The name of an anchor; ``addresses``: whether identifiers are MAC addresses."""
    return (f"{anchor:04X}" if anchor <= 0xFFFF else f"{anchor:016X}") if addresses else str(anchor)


def is_address(text: str) -> bool:
    """Whether a name can only be a MAC address: one of the digits is a letter."""
    return _ADDRESS.fullmatch(text) is not None and not text.isdecimal()


def read_anchor(text: str, *, addresses: bool = False) -> int:
    """The anchor of a name; ``addresses``: whether digits alone are a MAC address, too. Raises ValueError.

    A spreadsheet leaves out the zeros before a short one.
    """
    if is_address(text) or (addresses and _ADDRESS.fullmatch(text.zfill(4))):
        return int(text, 16)
    anchor = int(text, 0) if text.lower().startswith("0x") else int(text)
    if anchor < 0:
        raise ValueError(text)
    return anchor
