"""What an estimator was given of a recording as arrays, one row a reception or a time difference."""

from array import array
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec import Struct

from skyless.cli.api._result import data_frame
from skyless.core.air.masterless_packets import Packet, PairTdoa
from skyless.core.arrays import Integers, Mask, Vector

if TYPE_CHECKING:
    from pandas import DataFrame

_NONE: Final = -1
_WHOLE: Final = 7


class Measurements(Struct, frozen=True, eq=False):
    """n measurements in the order in which the estimator got them: receptions of anchors, or time differences.

    Where a measurement has no such value, there is -1, or NaN in ``tdoa_m``. What packets relay of other anchors is not
    here; ``skyless.open_recording`` gives packets whole.
    """

    tags: tuple[str, ...]
    """Names of the tags."""
    tag: Integers
    """Shape (n,): which of ``tags`` measured it."""
    time_s: Vector
    """Shape (n,): when, on the scale of the fixes' times."""
    anchor_a: Integers
    """Shape (n,): the anchor that a time difference is counted from."""
    anchor_b: Integers
    """Shape (n,): the anchor that it is counted to, or the sender of a packet."""
    tdoa_m: Vector
    """Shape (n,): range to b less range to a."""
    sequence: Integers
    """Shape (n,): number of the packet."""
    tx_ticks: Integers
    """Shape (n,): when it was sent, in the sender's clock."""
    rx_ticks: Integers
    """Shape (n,): when the tag received it, in the tag's own clock."""
    used: Mask
    """Shape (n,): whether the filter took it; of an own estimator, of methods that wait for whole superframes, and with
    ``smooth``, whether it made a fix."""

    def __len__(self) -> int:
        return len(self.time_s)

    def to_dataframe(self) -> "DataFrame":
        """One row a measurement: ``t_s``, ``tag`` (its name), and the other arrays by their names.

        Raises:
            SkylessError: pandas is not installed.
        """
        others = "anchor_a", "anchor_b", "tdoa_m", "sequence", "tx_ticks", "rx_ticks", "used"
        return data_frame(
            {
                "t_s": self.time_s,
                "tag": np.array(self.tags, dtype=object)[self.tag],
                **{name: getattr(self, name) for name in others},
            }
        )


class MeasurementRecorder:
    """Gathers measurements as they come, 72 bytes each."""

    def __init__(self, tags: tuple[str, ...]) -> None:
        self._tags = tags
        self._whole = array("q")
        self._numbers = array("d")

    def add(self, tag: str, time_s: float, measured: Packet | PairTdoa, used: bool) -> None:
        """Add what the estimator of a tag was given."""
        number = self._tags.index(tag)
        if isinstance(measured, PairTdoa):
            self._whole.extend((number, measured.anchor_a, measured.anchor_b, _NONE, _NONE, _NONE, used))
            self._numbers.extend((time_s, measured.tdoa_m))
        else:
            stamps = measured.sequence, measured.tx_ticks, measured.rx_ticks
            self._whole.extend((number, _NONE, measured.anchor, *stamps, used))
            self._numbers.extend((time_s, np.nan))

    def measurements(self) -> Measurements:
        """All so far."""
        whole = np.array(self._whole, dtype=np.int64).reshape(-1, _WHOLE)
        numbers = np.array(self._numbers).reshape(-1, 2)
        for rows in (whole, numbers):
            rows.setflags(write=False)
        tag, anchor_a, anchor_b, sequence, tx_ticks, rx_ticks, used = whole.T
        return Measurements(
            tags=self._tags,
            tag=tag,
            time_s=numbers[:, 0],
            anchor_a=anchor_a,
            anchor_b=anchor_b,
            tdoa_m=numbers[:, 1],
            sequence=sequence,
            tx_ticks=tx_ticks,
            rx_ticks=rx_ticks,
            used=used > 0,
        )
