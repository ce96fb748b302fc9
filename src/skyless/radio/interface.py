"""The narrow interface between a program and its radio."""

from collections import Counter
from collections.abc import Callable
from typing import Final, Protocol

from msgspec import Struct

from skyless.core.air.frame import Reception, Transmission
from skyless.core.ticks import DEFAULT_ANTENNA_DELAY_TICKS
from skyless.radio.tag_reports import Reported

NOTABLE_SHARE: Final = 0.005
"""Share of a radio's records that are spoilt on their way, from which on it matters: 1 % when rounded."""


class AntennaDelays(Struct, frozen=True):
    """Delays that a radio subtracts from its stamps, in ticks."""

    tx_ticks: int = DEFAULT_ANTENNA_DELAY_TICKS
    rx_ticks: int = DEFAULT_ANTENNA_DELAY_TICKS


class Sent(Struct, frozen=True, gc=False):
    """The frame has left the antenna."""

    tx_ticks: int


class Late(Struct, frozen=True, gc=False):
    """The frame came too late and was not sent."""

    tx_ticks: int


class Restarted(Struct, frozen=True, gc=False):
    """The radio is ready, with a counter unrelated to its earlier one."""


class Gone(Struct, frozen=True, gc=False):
    """The radio does not answer; it is searched for automatically."""

    reason: str


class Hint(Struct, frozen=True):
    """The radio works, but a person should check something."""

    text: str


RadioEvent = Reception | Sent | Late | Restarted | Gone | Hint | Reported
Listener = Callable[[RadioEvent], None]
"""Called from the event loop for each event; must return quickly and not raise."""


def ignore(_event: object) -> None:
    """The listener of a radio that does not run yet."""


class Radio(Protocol):
    """One radio, used from one event loop."""

    @property
    def name(self) -> str:
        """Its name in messages."""

    @property
    def counters(self) -> Counter[str]:
        """What was lost or unusable on the way from the radio, by reason."""

    @property
    def lead_s(self) -> float:
        """Initial lead time of ``transmit`` before a frame's RMARKER; 0 if it cannot send."""

    async def run(self, listener: Listener) -> None:
        """Configure the radio and receive until cancelled; a lost radio is searched for."""

    def advice(self) -> str:
        """Where to look if nothing has been received for some seconds; without changing numbers."""

    def now_ticks(self) -> int | None:
        """The radio's 40-bit counter now, to about 0.1 ms; None while it is not ready."""

    def transmit(self, transmission: Transmission) -> None:
        """Send a frame so that its RMARKER leaves at ``tx_ticks``; answered by ``Sent`` or ``Late``."""
