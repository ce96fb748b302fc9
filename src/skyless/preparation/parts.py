"""Parts of the kernels: what one process compiles, by running it.

Two parts of one computation differ in the packages whose kernels they compile: the others' run as plain Python, slowly,
which a fifth of a second of the lab can afford. A part never becomes stale, as it runs what the programs run.
"""

from typing import Final

from msgspec import Struct

from skyless.method_names import FILTERS, SNAPSHOTS


class Part(Struct, frozen=True):
    """Kernels that one process compiles."""

    name: str
    run: str
    """``module:function`` to call."""
    arguments: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    """Packages whose kernels are compiled; those with a minus are left out; empty: those of all."""
    typical_s: float = 10.0
    """Seconds of one core of 2024, for the time left until the process can tell better."""


_ESTIMATOR: Final = "skyless.positioning.estimator"
_LAB: Final = "skyless.evaluation.compile_ahead:compile_kernels"

ESTIMATOR: Final = Part("estimator", _LAB, FILTERS, (_ESTIMATOR, "skyless.kernels"), typical_s=30.0)
AIR: Final = Part("air", _LAB, SNAPSHOTS, (f"-{_ESTIMATOR}",), typical_s=8.0)
"""The simulated radio world, anchors, and positions from snapshots, from which the estimator starts, too."""

PAIRS: Final = Part("pairs", "skyless.evaluation.compile_ahead:compile_pair_kernels", typical_s=20.0)
PACKETS: Final = Part("packets", "skyless.evaluation.compile_ahead:compile_packet_kernels", typical_s=20.0)

LAB: Final = (ESTIMATOR, AIR)


def parts_of(method: str) -> tuple[Part, ...]:
    """What the programs of a site with this method need."""
    return LAB if method in FILTERS else (AIR,)
