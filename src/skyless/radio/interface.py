"""The narrow interface between a program and its radio."""

from collections import Counter
from collections.abc import Callable
from typing import Protocol

from msgspec import Struct

from skyless.core.air.frame import Reception, Transmission
from skyless.core.ticks import DEFAULT_ANTENNA_DELAY_TICKS
from skyless.radio.tag_reports import Reported


class AntennaDelays(Struct, frozen=True):
    """Antenna delays for which a radio corrects its stamps, in ticks."""

    tx_ticks: int = DEFAULT_ANTENNA_DELAY_TICKS
    rx_ticks: int = DEFAULT_ANTENNA_DELAY_TICKS


class Sent(Struct, frozen=True, gc=False):
    """A frame has left the antenna."""

    tx_ticks: int


class Late(Struct, frozen=True, gc=False):
    """A frame was not sent, because it reached the radio too late."""

    tx_ticks: int


class Restarted(Struct, frozen=True, gc=False):
    """The radio is ready; its counter has no relation to earlier readings."""


class Gone(Struct, frozen=True, gc=False):
    """The radio does not answer; attempts to reach it continue."""

    reason: str


class Hint(Struct, frozen=True):
    """The radio still works, but a person should check something."""

    text: str


RadioEvent = Reception | Sent | Late | Restarted | Gone | Hint | Reported
Listener = Callable[[RadioEvent], None]
"""Called from the event loop as soon as something happens; must return quickly and not raise."""


def ignore(_event: object) -> None:
    """Do nothing; the listener of a radio that does not run yet."""


class Radio(Protocol):
    """One radio, used from one event loop."""

    @property
    def name(self) -> str:
        """The radio's name in messages."""

    @property
    def counters(self) -> Counter[str]:
        """Counts of data that were lost or unusable on the way from the radio, by reason."""

    @property
    def lead_s(self) -> float:
        """How long before its RMARKER to hand a frame to ``transmit``, at first; 0 if the radio cannot send."""

    async def run(self, listener: Listener) -> None:
        """Configure the radio and receive until cancelled; reconnect if it is lost."""

    def advice(self) -> str:
        """Return a hint for when nothing was received for some seconds; it must not contain changing numbers."""

    def now_ticks(self) -> int | None:
        """The radio's 40-bit counter now, to about 0.1 ms; None while the radio is not ready."""

    def transmit(self, transmission: Transmission) -> None:
        """Send a frame so that its RMARKER leaves at ``tx_ticks``; the listener then gets ``Sent`` or ``Late``."""
