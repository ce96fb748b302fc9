"""A recorded site once more, as if its anchors had had other antenna delays.

A node's TX stamp is what its counter shows plus its TX delay, its RX stamp the same less its RX delay. An anchor's
clock rests on its RX stamps of the master and on the master's TX stamps, so its site time moves with all three.
"""

from msgspec import Struct, structs

from skyless.air.beacon import Beacon, Malformed
from skyless.air.codec import decode_cached, encode
from skyless.air.reception import Reception
from skyless.site.model import Site
from skyless.ticks import wrap

_SITE_TIME_MASK = (1 << 48) - 1


class DelayChange(Struct, frozen=True):
    """New less old antenna delays of one anchor, ticks."""

    tx_ticks: int
    rx_ticks: int


UNCHANGED = DelayChange(0, 0)


def delay_changes(recorded: Site, wanted: Site) -> dict[int, DelayChange]:
    """Changes by anchor, of those that both sites have."""
    old = {anchor.id: anchor for anchor in recorded.anchors}
    return {
        new.id: DelayChange(
            new.tx_antenna_delay_ticks - old[new.id].tx_antenna_delay_ticks,
            new.rx_antenna_delay_ticks - old[new.id].rx_antenna_delay_ticks,
        )
        for new in wanted.anchors
        if new.id in old
    }


def with_delays(reception: Reception, changes: dict[int, DelayChange]) -> Reception:
    """The reception of the same frame as its sender would have filled it."""
    beacon = decode_cached(reception.frame)
    if isinstance(beacon, Malformed):
        return reception
    return structs.replace(reception, frame=encode(_beacon(beacon, changes)))


def _beacon(beacon: Beacon, changes: dict[int, DelayChange]) -> Beacon:
    own, master = changes.get(beacon.anchor, UNCHANGED), changes.get(beacon.master, UNCHANGED)
    later = master.tx_ticks if beacon.anchor == beacon.master else own.tx_ticks + own.rx_ticks + master.tx_ticks
    time = beacon.master_time
    if time is not None:
        time = structs.replace(time, tx_subticks_master=(time.tx_subticks_master + 256 * later) & _SITE_TIME_MASK)
    heard, *others = (
        None if one is None else structs.replace(one, rx_ticks=wrap(one.rx_ticks - own.rx_ticks))
        for one in (beacon.master_heard, *beacon.heard)
    )
    return structs.replace(
        beacon,
        tx_ticks=wrap(beacon.tx_ticks + own.tx_ticks),
        master_time=time,
        master_heard=heard,
        heard=tuple(one for one in others if one is not None),
    )
