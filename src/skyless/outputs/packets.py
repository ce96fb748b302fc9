"""Packets of MQTT 3.1.1 (OASIS standard, 2014), as far as a client of QoS 0 and 1 needs them."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Final

from msgspec import Struct

CONNECT: Final = 1
CONNACK: Final = 2
PUBLISH: Final = 3
PUBACK: Final = 4
SUBSCRIBE: Final = 8
SUBACK: Final = 9
UNSUBSCRIBE: Final = 10
PINGREQ: Final = 12
DISCONNECT: Final = 14

PING: Final = bytes((PINGREQ << 4, 0))
GOODBYE: Final = bytes((DISCONNECT << 4, 0))

NOT_SUBSCRIBED: Final = 0x80

_REFUSALS: Final = {
    1: "it does not speak MQTT 3.1.1",
    2: "it does not accept the client's name",
    3: "it is not available",
    4: "wrong user name or password",
    5: "wrong user name or password, or no permission",
}


class PacketError(Exception):
    """The other side has sent what is no packet."""


class Will(Struct, frozen=True):
    """What the broker publishes, retained and at QoS 1, when the client goes without a goodbye."""

    topic: str
    payload: bytes


class Message(Struct, frozen=True, gc=False):
    """A PUBLISH as it came; ``packet`` is 0 at QoS 0."""

    topic: str
    payload: bytes
    packet: int


def connect(
    client: str, *, clean: bool, keepalive_s: int, user: str | None, password: str | None, will: Will | None
) -> bytes:
    """A CONNECT."""
    flags = 0x02 if clean else 0
    payload = _text(client)
    if will is not None:
        flags |= 0x04 | 0x08 | 0x20
        payload += _text(will.topic) + _bytes(will.payload)
    if user is not None:
        flags |= 0x80
        payload += _text(user)
        if password is not None:
            flags |= 0x40
            payload += _text(password)
    return _packet(CONNECT << 4, _text("MQTT") + bytes((4, flags)) + keepalive_s.to_bytes(2, "big") + payload)


def publish(topic: str, payload: bytes, *, packet: int = 0, retain: bool = False, again: bool = False) -> bytes:
    """A PUBLISH, at QoS 1 where ``packet`` is not 0."""
    name = topic.encode()
    head = PUBLISH << 4 | again << 3 | (packet > 0) << 1 | retain
    number = packet.to_bytes(2, "big") if packet else b""
    size = 2 + len(name) + len(number) + len(payload)
    return b"".join((bytes((head,)), _length(size), len(name).to_bytes(2, "big"), name, number, payload))


def puback(packet: int) -> bytes:
    """The answer to a PUBLISH of QoS 1."""
    return bytes((PUBACK << 4, 2)) + packet.to_bytes(2, "big")


def subscribe(packet: int, filters: Mapping[str, int]) -> bytes:
    """A SUBSCRIBE to topic filters, each with its QoS."""
    body = b"".join(_text(name) + bytes((qos,)) for name, qos in filters.items())
    return _packet(SUBSCRIBE << 4 | 2, packet.to_bytes(2, "big") + body)


def unsubscribe(packet: int, filters: Iterable[str]) -> bytes:
    """An UNSUBSCRIBE from topic filters."""
    return _packet(UNSUBSCRIBE << 4 | 2, packet.to_bytes(2, "big") + b"".join(map(_text, filters)))


def refusal(body: bytes) -> str | None:
    """Why a CONNACK refuses; None where it accepts.

    Raises:
        PacketError: it is none.
    """
    if len(body) != 2:
        raise PacketError("a CONNACK of the wrong length")
    code = body[1]
    return None if code == 0 else _REFUSALS.get(code, f"code {code}")


def read_message(head: int, body: bytes) -> Message:
    """The PUBLISH of QoS 0 or 1 in a packet's first byte and body.

    Raises:
        PacketError: it is none.
    """
    end = 2 + int.from_bytes(body[:2], "big")
    qos = head >> 1 & 3
    start = end + 2 * (qos > 0)
    if qos > 1 or len(body) < max(2, start):
        raise PacketError("a PUBLISH of a wrong form")
    try:
        topic = body[2:end].decode()
    except UnicodeDecodeError:
        raise PacketError("a topic that is not UTF-8") from None
    return Message(topic, body[start:], int.from_bytes(body[end:start], "big"))


class Splitter:
    """Cuts a stream of bytes into packets."""

    def __init__(self) -> None:
        self._rest = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """First byte and body of each packet that is complete by now.

        Raises:
            PacketError: the stream holds no MQTT.
        """
        rest = self._rest
        rest += data
        begin = 0
        try:
            while (found := _body_at(rest, begin)) is not None:
                start, end = found
                if end > len(rest):
                    break
                head, body = rest[begin], bytes(rest[start:end])
                begin = end
                yield head, body
        finally:
            del rest[:begin]


def _body_at(data: bytearray, begin: int) -> tuple[int, int] | None:
    """Where the body of the packet at ``begin`` starts and ends; None while its length has not come."""
    size = shift = 0
    for place in range(begin + 1, min(begin + 5, len(data))):
        byte = data[place]
        size |= (byte & 0x7F) << shift
        if byte < 0x80:
            return place + 1, place + 1 + size
        shift += 7
    if shift == 28:
        raise PacketError("a length of more than four bytes")
    return None


def _packet(head: int, body: bytes) -> bytes:
    return bytes((head,)) + _length(len(body)) + body


def _length(size: int) -> bytes:
    if size < 0x80:
        return bytes((size,))
    if size < 0x4000:
        return bytes((size & 0x7F | 0x80, size >> 7))
    digits = bytearray()
    while True:
        size, digit = size >> 7, size & 0x7F
        digits.append(digit | 0x80 if size else digit)
        if not size:
            return bytes(digits)


def _text(text: str) -> bytes:
    return _bytes(text.encode())


def _bytes(data: bytes) -> bytes:
    return len(data).to_bytes(2, "big") + data
