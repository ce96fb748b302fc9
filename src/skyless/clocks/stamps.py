"""TX stamps of many anchors as one tag hears them: unwrapped, and those that cannot be told apart from good ones."""

from collections import Counter
from typing import Final

from msgspec import Struct

from skyless.air.beacon import Beacon
from skyless.constants import MAX_DRIFT
from skyless.ticks import HALF_WRAP_TICKS, TICK_MASK, wrap

STAMPS_BEFORE_RESTART: Final = 3
"""So many impossible stamps of one anchor in a row mean that its counter has started anew."""

MOST_TRACKS: Final = 256
"""More anchors than a site can have; with more identifiers on the air, that heard longest ago is forgotten."""

NOISE_TICKS: Final = 64
"""0.3 m allow for the noise of two stamps."""


class _Track(Struct):
    """The last stamps of one anchor, unwrapped."""

    rx_ticks_tag: int
    tx_ticks: int
    sequence: int
    impossible: int = 0


class StampTracks(Struct):
    """What ``AnchorStamps`` remembers."""

    newest_rx_ticks: int | None = None
    """RX stamp of the newest frame that was taken, unwrapped: one impossible stamp must not make others late."""
    of_anchor: dict[int, _Track] = {}


class AnchorStamps:
    """Follows every anchor's counter by the tag's own; counts what it refuses in ``counters``."""

    def __init__(self, counters: Counter[str], tracks: StampTracks | None = None) -> None:
        """``tracks``: those to continue with."""
        self._counters = counters
        self.tracks = tracks or StampTracks()

    def forget(self) -> None:
        """Start anew."""
        self.tracks = StampTracks()

    def unwrap(self, beacon: Beacon, rx_ticks: int) -> int | None:
        """TX stamp on the anchor's own unwrapped scale; None if the frame is repeated, late, or its stamp impossible.

        ``rx_ticks`` is the tag's own reading, unwrapped. An anchor's first stamp keeps its own value.
        """
        tracks = self.tracks
        track, newest = tracks.of_anchor.get(beacon.anchor), tracks.newest_rx_ticks
        if newest is not None and rx_ticks <= newest:
            repeated = track is not None and _is_repeated(beacon, track)
            self._counters["duplicate" if repeated else "out-of-order"] += 1
            return None
        if track is None:
            tracks.newest_rx_ticks = rx_ticks
            return self._begin(beacon, rx_ticks)
        elapsed = rx_ticks - track.rx_ticks_tag
        least = track.tx_ticks + elapsed - HALF_WRAP_TICKS
        off = ((beacon.tx_ticks - least) & TICK_MASK) - HALF_WRAP_TICKS
        if abs(off) > MAX_DRIFT * elapsed + NOISE_TICKS:
            self._refuse(beacon, track)
            return None
        track.rx_ticks_tag = tracks.newest_rx_ticks = rx_ticks
        track.tx_ticks = tx_ticks = least + HALF_WRAP_TICKS + off
        track.sequence, track.impossible = beacon.sequence, 0
        return tx_ticks

    def _begin(self, beacon: Beacon, rx_ticks: int) -> int:
        tracks = self.tracks.of_anchor
        if len(tracks) >= MOST_TRACKS:
            del tracks[min(tracks, key=lambda anchor: tracks[anchor].rx_ticks_tag)]
        tracks[beacon.anchor] = _Track(rx_ticks, beacon.tx_ticks, beacon.sequence)
        return beacon.tx_ticks

    def _refuse(self, beacon: Beacon, track: _Track) -> None:
        """Count the stamp; after a few that are impossible the anchor's next one is a beginning."""
        if _is_repeated(beacon, track):
            self._counters["duplicate"] += 1
            return
        self._counters["impossible-stamp"] += 1
        track.impossible += 1
        if track.impossible >= STAMPS_BEFORE_RESTART:
            del self.tracks.of_anchor[beacon.anchor]
            self._counters["anchor-restart"] += 1


def _is_repeated(beacon: Beacon, track: _Track) -> bool:
    return wrap(track.tx_ticks) == beacon.tx_ticks and track.sequence == beacon.sequence
