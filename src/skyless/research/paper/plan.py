"""What the figures of the report share: amounts, positions, noises, and the pieces that a figure consists of."""

from collections.abc import Mapping
from enum import StrEnum
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from msgspec import Struct

from skyless.core.arrays import Array

Point = tuple[float, float]

P1: Final[Point] = (3.0, 4.0)
P2: Final[Point] = (1.2, 1.6)
"""Stand-ins for the paper's two static test positions, whose coordinates it does not give."""

RADIO_PS: Final = 100.0
"""Noise of every stamp where a figure does not vary it: the low end of what is reported for DW1000 stamps."""

PAPER_PS: Final = 15.65
"""The paper's largest stamp error, one tick."""

DW1000_PS: Final = (100.0, 150.0)
"""Range of a DW1000's stamp noise (``docs/radio.md``)."""

CLAIM_M: Final = 0.20
"""The paper's bound on the position error."""

P1_METHODS: Final = ("literal", "weighted", "bracketed", "joint")
"""What the tag at P1 computes with: figure 4 shows some of them, figure 9 all."""

Results = Mapping[str, Any]
"""What the tasks returned, by their names."""


class Plan(Struct, frozen=True):
    """Sizes of the simulations."""

    seed: int
    quick: bool = False
    fixes: int = 30_000
    """Fixes, one per superframe, at each static position with the usual stamps."""
    fewer_fixes: int = 3_000
    """Fixes with stamps of other noises, with biased ones, or by methods that figure 4 does not show."""
    noises_ps: tuple[float, ...] = (5.2, PAPER_PS, 50.0, RADIO_PS, 150.0, 200.0, 300.0, 500.0)
    laps: int = 12
    """Rounds of the walking test."""
    fleet_sizes: tuple[int, ...] = (1, 10, 100, 1_000, 10_000)
    rate_s: float = 10.0
    """Simulated seconds over which updates are counted."""
    draws: int = 2_000_000
    """Monte Carlo draws per anchor and kind of noise."""


def plan_of(seed: int, *, quick: bool) -> Plan:
    """The whole report, or one that is ready in seconds and scatters more."""
    if not quick:
        return Plan(seed)
    return Plan(
        seed,
        quick,
        fixes=1_200,
        fewer_fixes=1_200,
        noises_ps=(PAPER_PS, 50.0, RADIO_PS, 200.0, 500.0),
        laps=2,
        fleet_sizes=(1, 10, 100),
        rate_s=3.0,
        draws=50_000,
    )


class Verdict(StrEnum):
    """Whether a statement of the paper holds."""

    HOLDS = "holds"
    CORRECTED = "holds with a correction"
    FAILS = "does not hold"


class Panel(Struct, frozen=True):
    """One picture."""

    name: str
    """Name of its files, without the ending."""
    caption: str
    figure: Figure


class Section(Struct, frozen=True):
    """A figure and the statement that it tests."""

    key: str
    title: str
    label: str
    """The paper's label of the figure or section."""
    claim: str
    """The paper's statement in other words."""
    simulated: str
    verdict: Verdict
    reason: str
    panels: tuple[Panel, ...]
    table: tuple[tuple[str, ...], ...]
    """Rows of cells, the first one the heads."""
    numbers: dict[str, object]
    """The same and more for programs, SI units in the names."""
    command: str
    """A command that reproduces the central number."""


def gaussian(values: Array, std: float, mean: float = 0.0) -> Array:
    """Density of a Gaussian at some values."""
    density: Array = np.exp(-0.5 * ((values - mean) / std) ** 2) / (std * np.sqrt(2.0 * np.pi))
    return density


def grouped(count: int) -> str:
    """A whole number with thousands separated."""
    return f"{count:,}".replace(",", "\u00a0")
