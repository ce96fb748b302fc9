"""What a tag with its site's public key makes of receptions, some of them forged, and whether any of those mattered."""

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
from msgspec import Struct

from skyless.air.beacon import Malformed
from skyless.air.frames import AnyBeacon, decode_any
from skyless.air.reception import Reception
from skyless.evaluation.attacked_air import Received
from skyless.evaluation.trusted_air import START_UNIX_S
from skyless.positioning.fix import Fix
from skyless.receiver import Receiver
from skyless.trusted_receiver import GivenFix, SiteTrust, Trust, TrustedReceiver

FixKey = tuple[int, bytes]
"""By which a reception is recognised: its RX stamp and its frame."""


class Given(Struct, frozen=True):
    """A fix, and when it was given."""

    given_s: float
    fix: Fix
    key: FixKey
    """The reception that made it."""


class TagRun(Struct, frozen=True):
    """What a tag did with its receptions."""

    given: tuple[Given, ...]
    accepted: tuple[FixKey, ...]
    """Receptions of which verified fixes were made."""
    counters: Counter[str]
    faults: Counter[str]
    """Faults that were reported at some time, by anchor and reason."""


class Comparison(Struct, frozen=True):
    """Verified fixes against those of a plain receiver with the genuine frames only."""

    fixes: int
    moved: int
    """Fixes that are not, bit for bit, those of the accepted frames that are genuine."""
    forged: int
    """Accepted receptions that no anchor of the site sent at that time."""
    refused: int
    """Genuine receptions that were not accepted, those aside whose keys have not come yet."""
    most_moved_m: float
    """The farthest that a fix is from the one that a plain receiver makes with the same reception."""


class _Noting(Receiver):
    """A receiver that notes what it processes."""

    def __init__(self, site: int, accepted: list[FixKey]) -> None:
        super().__init__(site=site)
        self._accepted = accepted

    def hear_beacon(self, beacon: AnyBeacon, reception: Reception) -> Fix | None:
        """As ``Receiver``."""
        self._accepted.append(key_of(reception))
        return super().hear_beacon(beacon, reception)


def key_of(reception: Reception) -> FixKey:
    """What a reception is recognised by."""
    return reception.rx_ticks, reception.frame


def run_tag(
    received: Iterable[Received], trust: SiteTrust, certificates: Iterable[bytes] = (), clock_error_s: float = 0.0
) -> TagRun:
    """Let a tag that is switched on process receptions; ``clock_error_s``: how far its host's clock is ahead."""
    accepted: list[FixKey] = []
    plain = trust.trust is Trust.OPEN
    tag = TrustedReceiver(
        trust, lambda: Receiver(site=trust.site) if plain else _Noting(trust.site, accepted), certificates
    )
    given, faults = list[Given](), Counter[str]()
    for number, one in enumerate(received):
        host_s = one.reception.host_s or 0.0
        fixes: list[GivenFix] = tag.hear(one.reception, START_UNIX_S + host_s + clock_error_s)
        given += [Given(host_s, each.fix, key_of(each.reception)) for each in fixes]
        if number % 64 == 0:
            faults.update({str(fault) for fault in tag.faults().values()})
    return TagRun(tuple(given), tuple(accepted), tag.counters, faults)


def compare(run: TagRun, received: Sequence[Received], site: int) -> Comparison:
    """Compare verified fixes with those that a plain receiver makes of the same genuine frames alone."""
    genuine = {key_of(one.reception) for one in received if one.is_genuine}
    accepted = set(run.accepted)
    plain = Receiver(site=site)
    expected = {}
    last = max((number for number, one in enumerate(received) if key_of(one.reception) in accepted), default=-1)
    refused = 0
    for one in received[: last + 1]:
        key = key_of(one.reception)
        if not one.is_genuine or isinstance(decode_any(one.reception.frame), Malformed):
            continue
        if key not in accepted:
            refused += 1
            continue
        fix = plain.hear(one.reception)
        if fix is not None:
            expected[key] = fix
    moved, most_moved_m = 0, 0.0
    for each in run.given:
        right = expected.get(each.key)
        if right is None or right.rows != each.fix.rows:
            moved += 1
        if right is not None:
            most_moved_m = max(most_moved_m, float(np.linalg.norm(right.position_m - each.fix.position_m)))
    forged = sum(key not in genuine for key in run.accepted)
    return Comparison(len(run.given), moved, forged, refused, most_moved_m)


def errors_m(run: TagRun, received: Iterable[Received]) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Horizontal errors of fixes, shape (n, 2): when each was given, and its error."""
    truth = {key_of(one.reception): one.position_m for one in received}
    rows = [(one.given_s, float(np.hypot(*(one.fix.position_m - truth[one.key])[:2]))) for one in run.given]
    return np.array(rows).reshape(-1, 2)
