"""Ranges of a site's anchors from simulated air: real machines, and what they receive of one another."""

from collections.abc import Callable

from skyless.core.air.frame import Malformed, Reception, Transmission
from skyless.core.any_receiver import AnchorMachine, decode_any, new_anchor
from skyless.core.site import Site
from skyless.sim.impairments import Impairments
from skyless.sim.world import World
from skyless.site.survey.pair_ranger import PairRanger

OnLeg = Callable[[int, int, int, int, float], None]
"""Sender, receiver, TX and RX ticks, true time: as ``PairRanger.add`` accepts them."""


def stamps_of(site: Site, impairments: Impairments, seconds: float, seed: int, *, settle_s: float = 0.0) -> PairRanger:
    """Ranges of ``seconds`` of a site, from all that its anchors receive.

    ``settle_s``: time that passes before the first leg. The last block is closed.
    """
    whole = PairRanger()
    until_s = settle_s + seconds

    def on_leg(sender: int, receiver: int, tx_ticks: int, rx_ticks: int, t_s: float) -> None:
        if t_s >= settle_s:
            whole.add(sender, receiver, tx_ticks, rx_ticks, t_s)

    def new_recorded(anchor: int) -> RecordedAnchor:
        return RecordedAnchor(new_anchor(site, anchor), site.id, on_leg)

    for _ in World(site, new_recorded, (), impairments, seed).run(until_s):
        pass
    whole.finish()
    return whole


class RecordedAnchor:
    """An anchor whose receptions of its site are handed on as legs."""

    def __init__(self, machine: AnchorMachine, site_id: int, on_leg: OnLeg) -> None:
        self._machine, self._site_id, self._on_leg = machine, site_id, on_leg

    @property
    def id(self) -> int:
        """Identifier of the anchor."""
        return self._machine.id

    def hear(self, reception: Reception) -> None:
        """Process one frame, and hand on its leg."""
        self._machine.hear(reception)
        beacon = decode_any(reception.frame)
        if not isinstance(beacon, Malformed) and beacon.site == self._site_id and beacon.anchor != self.id:
            t_s = 0.0 if reception.host_s is None else reception.host_s
            self._on_leg(beacon.anchor, self.id, beacon.tx_ticks, reception.rx_ticks, t_s)

    def next_transmission_ticks(self, now_ticks: int) -> int | None:
        """That of the wrapped machine."""
        return self._machine.next_transmission_ticks(now_ticks)

    def transmission(self, tx_ticks: int) -> Transmission:
        """That of the wrapped machine."""
        return self._machine.transmission(tx_ticks)
