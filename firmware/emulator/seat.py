"""What a board is connected to, and what is asked of one, however it is made."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from skyless.sim.dw1000.chip import Chip
from skyless.sim.medium import Timeline


class Seat(NamedTuple):
    """What a board is connected to, which starts when it is made."""

    timeline: "Timeline[Any]"
    chip: Chip
    send: Callable[[bytes], None]
    """Called with bytes that have just left the TX pin completely."""
    can_transmit: bool = False
    """Else the role's pin is connected to ground."""
    identity: bytes = bytes(8)


class Board(Protocol):
    """A board."""

    def notify(self) -> None:
        """The chip's interrupt line may have risen."""

    def receive(self, data: bytes) -> None:
        """These bytes have just come completely on the UART."""

    def power_cycle(self) -> None:
        """The supply failed and is back."""


MakeBoard = Callable[[Seat], Board]
