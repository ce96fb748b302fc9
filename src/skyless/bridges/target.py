"""What a target is: a program or device of another kind that gets a site's fixes.

A target whose readers get bytes consists of an ``Encoder``, which does no I/O, and a sender (``senders.py``).
"""

import os
import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Protocol

from msgspec import Struct

from skyless.bridges.feed import BridgedSite
from skyless.errors import SkylessError
from skyless.mqtt.address import MqttAddress
from skyless.mqtt.messages import AnchorHealth, FixMessage, StatusMessage, TagHealth


class BridgeContext(Struct, frozen=True):
    """What a target may need of the program that it runs in."""

    log: Callable[[str], None]
    """Shows a line to a person."""
    mqtt: MqttAddress | None = None
    """The site's broker, where there is one."""


class Target:
    """Base of all targets: does nothing with what it gets. The hub calls it from the event loop, and never waits."""

    one_tag = False
    """Whether its readers cannot distinguish tags."""

    def __init__(self, text: str) -> None:
        self.text = text
        """Its address, for messages."""
        self.dropped: Counter[str] = Counter()
        """What readers missed, by reason."""

    def on_site(self, site: BridgedSite) -> None:
        """The site is known, or has changed. Raises SkylessError where it lacks what this target needs."""

    def on_fix(self, fix: FixMessage) -> None:
        """A usable fix, no more often than the target's ``hz``; not before the site is known."""

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> None:
        """A known tag has had no usable fix for a second: now, and each further second."""

    def on_second(self, unix_s: float) -> None:
        """Another second has gone by."""

    def on_health(self, health: TagHealth | AnchorHealth) -> None:
        """State of a tag or an anchor, once a second."""

    def on_status(self, status: StatusMessage) -> None:
        """A program of the site has come or gone."""

    async def run(self) -> None:
        """Serve until cancelled."""


class Encoder:
    """Base of what makes bytes for readers: each element of a result is one datagram, or one write.

    Does no I/O and reads no clock.
    """

    one_tag = False
    """As of a ``Target``."""

    dropped: Counter[str]
    """As of its ``Target``: what it could not encode, by reason."""

    def greeting(self) -> list[bytes]:
        """For a reader that has just connected."""
        return []

    def on_site(self, site: BridgedSite) -> list[bytes]:  # noqa: ARG002 - most only keep it
        """As of a ``Target``."""
        return []

    def on_fix(self, fix: FixMessage) -> list[bytes]:  # noqa: ARG002 - see above
        """As of a ``Target``."""
        return []

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> list[bytes]:  # noqa: ARG002 - see above
        """As of a ``Target``."""
        return []

    def on_second(self, unix_s: float) -> list[bytes]:  # noqa: ARG002 - see above
        """As of a ``Target``."""
        return []

    def on_bytes(self, data: bytes, unix_ns: int) -> list[bytes]:  # noqa: ARG002 - see above
        """What a reader has sent, over UDP or a serial port, and when it came; the result answers it."""
        return []


class Sender(Protocol):
    """What carries bytes to readers."""

    dropped: Counter[str]
    """What readers missed, by reason."""

    def send(self, data: bytes) -> None:
        """Send to all readers, or drop; returns at once."""

    async def run(self) -> None:
        """Serve until cancelled. Raises SkylessError where it cannot begin."""


class StreamTarget(Target):
    """Bytes of an encoder, carried by a sender."""

    def __init__(self, text: str, encoder: Encoder, sender: Sender) -> None:
        super().__init__(text)
        self._encoder, self._sender = encoder, sender
        self.one_tag = encoder.one_tag
        self.dropped = encoder.dropped = sender.dropped

    def on_site(self, site: BridgedSite) -> None:
        """Let the encoder know it."""
        self._send(self._encoder.on_site(site))

    def on_fix(self, fix: FixMessage) -> None:
        """Send it."""
        self._send(self._encoder.on_fix(fix))

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> None:
        """Send that there is none."""
        self._send(self._encoder.on_no_fix(tag, unix_s, reason))

    def on_second(self, unix_s: float) -> None:
        """Send what is due once a second."""
        self._send(self._encoder.on_second(unix_s))

    def on_bytes(self, data: bytes) -> None:
        """Answer what a reader has just sent."""
        self._send(self._encoder.on_bytes(data, time.time_ns()))

    async def run(self) -> None:
        """Serve until cancelled."""
        await self._sender.run()

    def _send(self, messages: Iterable[bytes]) -> None:
        for message in messages:
            self._sender.send(message)


def cannot_listen(text: str, host: str, port: int, error: OSError) -> SkylessError:
    """What a server raises that cannot begin; asyncio's own words are longer and name the same."""
    reason = os.strerror(error.errno) if error.errno is not None and error.errno > 0 else error
    return SkylessError(f"the target {text!r} cannot listen on {host}:{port}: {reason}")
