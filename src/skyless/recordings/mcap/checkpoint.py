"""A receiver as bytes and back, so that a replay can begin in the middle of a tag's life and go on with the same bits.

The bytes are a graph of values in MessagePack, not a pickle: reading them makes only plain objects of the protocol
machine's own classes, so that a recording of unknown origin can be read. Arrays go into compiled code that checks no
bounds; the classes that hold some are therefore listed with what must hold of them (``_SOUND``).
"""

from importlib.metadata import version
from typing import Any, Final

import msgspec
import numpy as np
from msgspec import Struct

from skyless.positioning.estimator.estimator import Estimator, is_sound
from skyless.positioning.methods.acquisition import Start
from skyless.positioning.methods.joint import AnchorsInUse
from skyless.positioning.observation import Observation
from skyless.receiver import Receiver
from skyless.recordings.mcap.checkpoint_graph import Arrays
from skyless.recordings.mcap.checkpoint_reader import DamagedGraphError, read_graph
from skyless.recordings.mcap.checkpoint_writer import write_graph

FORMAT: Final = 14
MAX_BYTES: Final = 1 << 23
"""Enough for an estimator of a hundred anchors."""


class _Envelope(Struct, frozen=True):
    """What stands around a state."""

    format: int
    version: str
    nodes: list[list[Any]]


class RefusedError(Exception):
    """A checkpoint that cannot be used; ``reason`` is what it is counted by."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


def save(receiver: Receiver) -> bytes:
    """Return the receiver's whole state.

    Raises:
        TypeError: it holds something that has no form here, a fault of the program.
    """
    return msgspec.msgpack.encode(_Envelope(FORMAT, version("skyless"), write_graph(receiver, _SOUND)))


def load(state: bytes) -> Receiver:
    """Return the receiver as it was when ``state`` was taken.

    Raises:
        RefusedError: ``checkpoint-of-another-version``, ``checkpoint-damaged``.
    """
    if len(state) > MAX_BYTES:
        raise RefusedError("checkpoint-damaged")
    try:
        envelope = msgspec.msgpack.decode(state, type=_Envelope)
    except (msgspec.DecodeError, RecursionError, ValueError):
        raise RefusedError("checkpoint-damaged") from None
    if envelope.format != FORMAT or envelope.version != version("skyless"):
        raise RefusedError("checkpoint-of-another-version")
    try:
        receiver = read_graph(envelope.nodes, _SOUND)
    except DamagedGraphError:
        raise RefusedError("checkpoint-damaged") from None
    if type(receiver) is not Receiver:
        raise RefusedError("checkpoint-damaged")
    return receiver


def _floats(value: object, *shape: int) -> bool:
    return isinstance(value, np.ndarray) and value.shape == shape and value.dtype == np.float64


def _observation(value: Observation) -> bool:
    return _floats(value.anchor_m, 3)


def _start(value: Start) -> bool:
    n = len(value.solution)
    return n in (3, 4) and _floats(value.solution, n) and _floats(value.covariance, n, n)


def _in_use(value: AnchorsInUse) -> bool:
    return _floats(value.anchors_m, len(value.anchors), 3)


def _receiver(value: Receiver) -> bool:
    return all(_floats(place, 3) for place in vars(value)["_positions"].values())


_SOUND: Final[Arrays] = {
    Observation: _observation,
    Start: _start,
    AnchorsInUse: _in_use,
    Estimator: is_sound,
    Receiver: _receiver,
}
"""The classes that hold arrays, and whether one's arrays have the shapes that its kernels count on."""
