"""Recorded fixes beside those of a replay: whether they are the same, bit by bit."""

from collections import OrderedDict
from typing import Final, TypeVar

import msgspec
from msgspec import Struct

from skyless.mqtt.messages import FixMessage
from skyless.nodes.fix_log import fix_message
from skyless.positioning.fix import Fix

_T = TypeVar("_T")

MOST_PENDING: Final = 20_000
"""Fixes that wait for their counterpart; those that the recording lacks never get one."""

SAME_FIX_S: Final = 2.0
"""Serial numbers begin anew with the tag; fixes of one number that are farther apart are different ones."""


class Identical(Struct, frozen=True):
    """Recorded fixes against those of the replay, bit by bit."""

    compared: int
    different: int


class Comparison:
    """Pairs of a recorded and a replayed fix, matched by serial number and time, whichever comes first."""

    def __init__(self, tag: str) -> None:
        self._tag = tag
        self._recorded: OrderedDict[int, FixMessage] = OrderedDict()
        self._replayed: OrderedDict[int, tuple[Fix, float]] = OrderedDict()
        self._compared = self._different = 0

    def result(self) -> Identical:
        """How they compare so far."""
        return Identical(self._compared, self._different)

    def recorded(self, message: FixMessage) -> None:
        """Take a recorded fix."""
        found = self._replayed.pop(message.serial, None)
        if found is None or abs(found[1] - message.unix_s) > SAME_FIX_S:
            _keep(self._recorded, message.serial, message)
        else:
            self._judge(found[0], message)

    def replayed(self, serial: int, fix: Fix, unix_s: float) -> None:
        """Take one of the replay."""
        found = self._recorded.pop(serial, None)
        if found is None or abs(found.unix_s - unix_s) > SAME_FIX_S:
            _keep(self._replayed, serial, (fix, unix_s))
        else:
            self._judge(fix, found)

    def _judge(self, fix: Fix, message: FixMessage) -> None:
        again = fix_message(self._tag, message.serial, fix, message.unix_s, message.latency_s)
        self._compared += 1
        self._different += msgspec.json.encode(again) != msgspec.json.encode(message)


def _keep(waiting: OrderedDict[int, _T], serial: int, value: _T) -> None:
    waiting[serial] = value
    if len(waiting) > MOST_PENDING:
        waiting.popitem(last=False)
