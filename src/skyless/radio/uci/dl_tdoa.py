"""FiRa's downlink TDoA as packets of a system without a master.

In a round an initiator sends a poll, responders answer it one after the other, and mostly the initiator sends a final
message. A response says how long after the poll it left, in its sender's clock: so its sender received the poll that
much before. That is what packets of a system without a master relay (``masterless_packets``), and positions are
estimated from both alike. The final message relays the responses in the same way.

Where anchors stamp in the initiator's time instead of their own clocks, the poll reached a responder one flight after
it left, in that time.
"""

from collections.abc import Mapping
from math import dist
from typing import Final

from msgspec import Struct

from skyless.core.air.masterless_packets import Packet, Point, Relay
from skyless.core.ticks import TICK_M, TICK_MASK, TICK_S, wrap
from skyless.radio.uci.uci import (
    DtMessageType,
)

MAX_ROUNDS_AT_ONCE: Final = 256
MAX_ANCHORS_KEPT: Final = 256
"""Bounds of what is kept: of rounds that go on, and of positions and responses by address; the oldest goes first."""


class DtMessage(Struct, frozen=True, gc=False):
    """One message of a round as a tag received it; stamps have 40 bits."""

    host_s: float | None
    address: int
    """MAC address of the sender."""
    kind: DtMessageType
    block: int
    round: int
    """Which of the rounds that go on at once: any number that its messages share, and those of no other."""
    tx_ticks: int
    """In the sender's clock, or in the initiator's time."""
    rx_ticks_tag: int
    common_time: bool
    """Whether ``tx_ticks`` is in the initiator's time."""
    responder_reply_ticks: int = 0
    initiator_reply_ticks: int = 0
    flight_ticks: float | None = None
    """Between initiator and responder, as the responder ranged it."""
    position_m: Point | None = None


def host_time_s(stamp_ticks: int) -> float | None:
    """Time of a stamp that shows more than a 40-bit counter, which bridges silences of any length; None for others.

    A counter of 40 bits may be given in 64; its wraps are no jumps in time.
    """
    return stamp_ticks * TICK_S if stamp_ticks > TICK_MASK else None


class _Round:
    """A round that goes on: its poll, and the responses to it."""

    __slots__ = ("poll", "responses")

    def __init__(self, poll: DtMessage) -> None:
        self.poll = poll
        self.responses: dict[int, DtMessage] = {}
        """By their senders, so that one that is reported twice counts once."""


class DtRounds:
    """From the messages that one tag received, in their order, to packets with relays."""

    def __init__(self, anchors_m: Mapping[int, Point] | None = None) -> None:
        """``anchors_m``: positions that are known, where messages may state none."""
        self._known_m = anchors_m or {}
        self._stated_m: dict[int, Point] = {}
        self._rounds: dict[int, _Round] = {}

    def on_message(self, message: DtMessage) -> Packet | str:
        """The packet of a message, or the reason why it is of no use."""
        if message.position_m is not None:
            self._stated_m.pop(message.address, None)
            if len(self._stated_m) >= MAX_ANCHORS_KEPT:
                del self._stated_m[next(iter(self._stated_m))]
            self._stated_m[message.address] = message.position_m
        if message.kind is DtMessageType.POLL:
            self._rounds.pop(message.round, None)
            if len(self._rounds) >= MAX_ROUNDS_AT_ONCE:
                del self._rounds[next(iter(self._rounds))]
            self._rounds[message.round] = _Round(message)
            return _packet(message, ())
        going_on = self._rounds.get(message.round)
        if going_on is None or going_on.poll.block != message.block:
            return "message-without-poll"
        if message.kind is DtMessageType.RESPONSE:
            return self._response(going_on, message)
        if message.address != going_on.poll.address:
            return "final-of-another-anchor"
        return _packet(message, tuple(_relay_of_response(one, message) for one in going_on.responses.values()))

    def _response(self, going_on: _Round, message: DtMessage) -> Packet | str:
        poll = going_on.poll
        if message.address == poll.address:
            return "response-of-the-initiator"
        flight = message.flight_ticks
        if message.common_time:
            flight = self._distance_ticks(poll.address, message.address) if flight is None else flight
            if flight is None:
                return "flight-unknown"
            rx_ticks = poll.tx_ticks + round(flight)
        elif message.responder_reply_ticks > 0:
            rx_ticks = message.tx_ticks - message.responder_reply_ticks
        else:
            return "reply-time-unknown"
        if message.initiator_reply_ticks > 0 and len(going_on.responses) < MAX_ANCHORS_KEPT:
            going_on.responses[message.address] = message
        return _packet(message, (Relay(poll.address, _sequence(poll), wrap(rx_ticks), flight),))

    def _distance_ticks(self, one: int, other: int) -> float | None:
        one_m, other_m = self._position_m(one), self._position_m(other)
        return None if one_m is None or other_m is None else dist(one_m, other_m) / TICK_M

    def _position_m(self, address: int) -> Point | None:
        return self._known_m.get(address, self._stated_m.get(address))


def _relay_of_response(response: DtMessage, final: DtMessage) -> Relay:
    rx_ticks = wrap(final.tx_ticks - response.initiator_reply_ticks)
    return Relay(response.address, _sequence(response), rx_ticks, response.flight_ticks)


def _packet(message: DtMessage, relays: tuple[Relay, ...]) -> Packet:
    return Packet(
        message.host_s,
        message.address,
        _sequence(message),
        message.tx_ticks,
        message.rx_ticks_tag,
        relays,
        message.position_m,
    )


def _sequence(message: DtMessage) -> int:
    """A number that the sender's other messages of late do not have."""
    return (message.block << 8 | message.round & 0xFF) << 1 | (message.kind is DtMessageType.FINAL)
