"""What a figure of the report consists of."""

from enum import StrEnum

from matplotlib.figure import Figure
from msgspec import Struct


class Verdict(StrEnum):
    """What became of a statement of the paper."""

    HOLDS = "holds"
    CORRECTED = "holds with a correction"
    FAILS = "does not hold"


class Panel(Struct, frozen=True):
    """One picture."""

    name: str
    """Of its files, without ending."""
    caption: str
    figure: Figure


class Section(Struct, frozen=True):
    """A figure beside the statement that it tests."""

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
    """A command that makes the central number again."""


def grouped(count: int) -> str:
    """A whole number with its thousands apart."""
    return f"{count:,}".replace(",", "\u00a0")
