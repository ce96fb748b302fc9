"""``AnchorStamps``: every anchor's counter, unwrapped along the receiver's own."""

from collections import Counter
from typing import Final

from msgspec import Struct

from skyless.core.air.frame import AnyBeacon
from skyless.core.ticks import continued, from_seconds, wrap

# A counter has restarted once this number of stamps in a row were impossible and none has fitted for both of these
# times: forged frames in between do not replace an anchor that still sends.
STAMPS_BEFORE_RESTART: Final = 3
RESTART_SILENCE_TICKS: Final = from_seconds(0.2)
RESTART_SILENCE_PERIODS: Final = 4

MAX_TRACKS: Final = 256
"""More anchors than there are in reach; with more identifiers on the air, that received longest ago is forgotten, those
of a single stamp first."""


class _Track(Struct):
    """The last stamps of one anchor, unwrapped."""

    rx_ticks_tag: int
    tx_ticks: int
    sequence: int
    impossible: int = 0
    is_single: bool = True
    """Whether no stamp after the first has fitted."""
    rival: tuple[int, int] | None = None
    """The tag's stamp and the TX stamp of the last frame that did not fit a single one."""


class StampTracks(Struct):
    """What ``AnchorStamps`` keeps."""

    newest_rx_ticks: int | None = None
    """RX stamp of the newest accepted frame, unwrapped: one impossible stamp must not make others late."""
    of_anchor: dict[int, _Track] = {}


class AnchorStamps:
    """Unwraps every anchor's counter along the tag's own; counts what it rejects in ``counters``."""

    def __init__(self, counters: Counter[str], tracks: StampTracks | None = None) -> None:
        """``tracks``: those to continue with."""
        self._counters = counters
        self.tracks = tracks or StampTracks()

    def forget(self) -> None:
        """Start again."""
        self.tracks = StampTracks()

    def unwrap(self, beacon: AnyBeacon, rx_ticks: int, period_ticks: int = 0) -> int | None:
        """TX stamp on the anchor's own unwrapped scale; None if the frame is repeated, late, or its stamp impossible.

        ``rx_ticks`` is the tag's own reading, unwrapped; ``period_ticks`` the time between two frames of an anchor,
        as far as it is known. An anchor's first stamp keeps its own value.
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
        tx_ticks = continued(beacon.tx_ticks, track.tx_ticks, elapsed)
        if tx_ticks is None:
            silence_ticks = max(RESTART_SILENCE_TICKS, RESTART_SILENCE_PERIODS * period_ticks)
            self._reject(beacon, track, rx_ticks, is_silent=elapsed > silence_ticks)
            return None
        track.rx_ticks_tag = tracks.newest_rx_ticks = rx_ticks
        track.tx_ticks, track.sequence, track.impossible, track.is_single = tx_ticks, beacon.sequence, 0, False
        return tx_ticks

    def _begin(self, beacon: AnyBeacon, rx_ticks: int) -> int:
        tracks = self.tracks.of_anchor
        if len(tracks) >= MAX_TRACKS:
            del tracks[min(tracks, key=lambda anchor: (not tracks[anchor].is_single, tracks[anchor].rx_ticks_tag))]
        tracks[beacon.anchor] = _Track(rx_ticks, beacon.tx_ticks, beacon.sequence)
        return beacon.tx_ticks

    def _reject(self, beacon: AnyBeacon, track: _Track, rx_ticks: int, *, is_silent: bool) -> None:
        """Count the stamp; after a few that are impossible the next one of a silent anchor is a beginning.

        Where only the first stamp stands against it, which may have been a false one, two that fit each other are.
        """
        if _is_repeated(beacon, track):
            self._counters["duplicate"] += 1
            return
        self._counters["impossible-stamp"] += 1
        track.impossible += 1
        fits = track.rival and continued(beacon.tx_ticks, track.rival[1], rx_ticks - track.rival[0]) is not None
        if track.is_single and fits:
            self.tracks.of_anchor[beacon.anchor] = _Track(rx_ticks, beacon.tx_ticks, beacon.sequence, is_single=False)
            return
        track.rival = (rx_ticks, beacon.tx_ticks)
        if track.impossible >= STAMPS_BEFORE_RESTART and is_silent:
            del self.tracks.of_anchor[beacon.anchor]
            self._counters["anchor-restart"] += 1


def _is_repeated(beacon: AnyBeacon, track: _Track) -> bool:
    return wrap(track.tx_ticks) == beacon.tx_ticks and track.sequence == beacon.sequence
