"""Sizes of records."""

from typing import Final

MAX_ANCHORS: Final = 32
"""Most anchors at a time."""
