"""Sizes of records on a computer; a board has others (``firmware/source/core_sizes.h``), which its compiler gives C."""

from typing import Final

MAX_ANCHORS: Final = 32
"""Most anchors at a time."""
PACKETS_KEPT: Final = 16
"""Packets of each anchor that are kept for relays to come; divides the range of sequence numbers."""
MAX_RELAYS: Final = 32
"""Most relays with a packet; 13 fit into a frame."""
PHASE_STATES: Final = 3
"""States of each anchor for carrier phases; 0 where they are not used."""
PLANNED_FAULTS: Final = 13
"""Columns of V for what planning adds: walls, and four impulses along each axis."""
MOST_WAITING: Final = 8
"""Most updates of the filter that wait."""
PACKED: Final = False
"""Whether P is kept as its lower triangle alone: half the memory, but rows that vectors do not fit."""
MAX_NEIGHBOURS: Final = 256
"""Most anchors that are known by their own beacons."""
MAX_SITES: Final = 8
"""Most sites of which anchors are counted."""
MAX_COUNTED: Final = 32
"""Most anchors of each that are counted."""
MAX_ANCHORS_IN_USE: Final = 24
"""Most anchors in the estimator's state; more cost accuracy, as each then sends less, and time."""
RELAYS_KEPT: Final = 32
"""Relays of each packet that are kept for the filter which begins."""
MAX_PAGES: Final = 64
"""Pages of issues that are not complete."""
MAX_SENDERS: Final = 16
"""Anchors by whose number one page is preferred to another."""
SHARES_MEMORY: Final = False
"""Whether the search for a start uses the memory of the state, which is not used meanwhile."""
HAS_ORIGIN: Final = False
"""Whether positions are from whole metres near the first anchor, as far ones lose millimetres in single precision."""
