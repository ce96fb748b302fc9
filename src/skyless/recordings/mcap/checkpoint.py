"""A receiver as bytes and back, so that a replay can begin in the middle of a tag's life and go on with the same bits.

The bytes are the receiver's explicit state (``ReceiverState``) in MessagePack. Recordings may come from anywhere: types
and sizes are checked as they are read, and nothing in the bytes names code.
"""

from importlib.metadata import version
from typing import Final

import msgspec
import numpy as np
from msgspec import Struct

from skyless.kernels.arrays import Array
from skyless.receiver import Receiver
from skyless.receiver_state import ReceiverState

_FORMAT: Final = 17
_MAX_BYTES: Final = 1 << 23
"""Enough for an estimator of a hundred anchors."""


class _Header(Struct, frozen=True):
    """What every checkpoint says first."""

    format: int
    version: str


class _Checkpoint(_Header, frozen=True):
    receiver: ReceiverState


class RefusedError(Exception):
    """A checkpoint that cannot be used; ``reason`` is what it is counted by."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


def save(receiver: Receiver) -> bytes:
    """The receiver's whole state."""
    return _ENCODER.encode(_Checkpoint(_FORMAT, version("skyless"), receiver.state()))


def load(state: bytes) -> Receiver:
    """The receiver as it was when ``state`` was made.

    Raises:
        RefusedError: ``checkpoint-of-another-version``, ``checkpoint-damaged``.
    """
    if len(state) > _MAX_BYTES:
        raise RefusedError("checkpoint-damaged")
    try:
        header = msgspec.msgpack.decode(state, type=_Header)
        if header.format != _FORMAT or header.version != version("skyless"):
            raise RefusedError("checkpoint-of-another-version")
        return Receiver.from_state(_DECODER.decode(state).receiver)
    except (msgspec.MsgspecError, ValueError, ArithmeticError, LookupError, RecursionError):
        raise RefusedError("checkpoint-damaged") from None


def _encode_array(value: object) -> bytes:
    """A position, the only array in a state that is not bytes already."""
    assert isinstance(value, np.ndarray)
    return value.tobytes()


def _decode_array(_: type, data: object) -> Array:
    if not isinstance(data, bytes) or len(data) != 24:
        raise ValueError("a position is three numbers")
    return np.frombuffer(data, np.float64).copy()


_ENCODER: Final = msgspec.msgpack.Encoder(enc_hook=_encode_array)
_DECODER: Final = msgspec.msgpack.Decoder(_Checkpoint, dec_hook=_decode_array)
