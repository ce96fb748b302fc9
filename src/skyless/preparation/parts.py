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
    after: tuple[str, ...] = ()
    """Parts that have to be compiled first, because this one is made of them."""
    typical_s: float = 15.0
    """Seconds of one core of 2024, only to compare parts: what the running ones take gives those that wait."""
    timeline: tuple[float, ...] = (0.0, 1.0)
    """Shares of its time that are over when 0 ... 100 % of its kernels are compiled, at equal distances."""


_ESTIMATOR: Final = "skyless.positioning.estimator"
_LAB: Final = "skyless.evaluation.compile_ahead:compile_kernels"

_AIR_TIMELINE: Final = (0.0, 0.22, 0.44, 0.7, 0.73, 0.83, 0.96, 1.0, 1.0, 1.0, 1.0)
_ESTIMATOR_TIMELINE: Final = (0.0, 0.07, 0.11, 0.14, 0.18, 0.23, 0.29, 0.41, 0.61, 0.99, 1.0)

ESTIMATOR: Final = Part(
    "estimator", _LAB, FILTERS, (_ESTIMATOR, "skyless.kernels"), typical_s=60.0, timeline=_ESTIMATOR_TIMELINE
)
SIMULATED: Final = Part("air", _LAB, SNAPSHOTS, (f"-{_ESTIMATOR}",), typical_s=12.0, timeline=_AIR_TIMELINE)
"""The simulated radio world, anchors, and positions from snapshots, from which the estimator starts, too."""

PAIRS: Final = Part("pairs", "skyless.evaluation.compile_ahead:compile_pair_kernels", typical_s=20.0)
"""Differences of ranges, as some recordings hold them."""

_PACKETS: Final = Part(
    "packets", "skyless.evaluation.compile_ahead:compile_packet_kernels", after=("estimator",), typical_s=5.0
)

LAB: Final = (ESTIMATOR, SIMULATED)
SNIFFERS: Final = (ESTIMATOR, _PACKETS)
EVERY_PART: Final = (*LAB, PAIRS, _PACKETS)
"""Every method, at sites of every kind of radio."""


def parts_of(method: str) -> tuple[Part, ...]:
    """What the programs of a site with this method need."""
    return LAB if method in FILTERS else (SIMULATED,)
