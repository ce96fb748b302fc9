"""``FreeAnchor``: an anchor that sends at random instants of its own counter and knows of no other time."""

from collections import Counter

from skyless.air.beacon2 import Beacon2
from skyless.air.codec2 import encode_2, heard_capacity_2
from skyless.air.reception import Reception, Transmission
from skyless.anchor import anchor_of, delay_change_ticks
from skyless.anchors.authentication import BeaconAuthentication, contents_of, sealed
from skyless.anchors.neighbours import Neighbours, on_radio_grid
from skyless.constants import DELAYED_TX_GRANULARITY_TICKS
from skyless.site.free_access import first_free_window, free_instant_ticks, free_window_ticks
from skyless.site.local_almanac import site_issue, site_pages_of
from skyless.site.model import Site
from skyless.ticks import from_seconds, wrap


class FreeAnchor:
    """One anchor of a site of mode free. Like ``Anchor`` it does no I/O and reads no clock."""

    def __init__(
        self, site: Site, anchor_id: int, lead_s: float = 1e-3, authentication: BeaconAuthentication | None = None
    ) -> None:
        """``lead_s``: how long before its RMARKER a frame must be in the driver's hands.

        ``authentication``: the keys; None for an anchor that sends without codes and accepts all frames.

        Raises:
            KeyError: the site has no such anchor.
        """
        self.id = anchor_id
        self.counters: Counter[str] = Counter()
        self._lead_ticks = from_seconds(lead_s)
        self._window_ticks = free_window_ticks(site.schedule.rate_hz)
        self._site = site
        self._delay_ticks = anchor_of(site, anchor_id).tx_antenna_delay_ticks
        self._correction_ticks = 0
        self._pages = site_pages_of(site)
        self._issue = site_issue(self._pages)
        self.authentication = authentication
        self._neighbours = Neighbours(site, anchor_id, self.counters, authentication)
        self._sequence = 0

    def place(self, site: Site) -> None:
        """Use other positions and antenna delays of the same anchors, as ``Anchor.place``."""
        self._correction_ticks = delay_change_ticks(self._site, site, self.id)
        self._pages = site_pages_of(site)
        self._issue = site_issue(self._pages)
        self._neighbours.place(site)

    def hear(self, reception: Reception) -> None:
        """Process a frame from the air; one that does not belong here is counted and dropped."""
        self._neighbours.admit(reception)

    def next_transmission_ticks(self, now_ticks: int) -> int:
        """TX stamp (40-bit, own counter) of the next frame that can still be made."""
        now = self._neighbours.own_ticks.unwrap(now_ticks)
        earliest = now + self._lead_ticks + DELAYED_TX_GRANULARITY_TICKS
        window = first_free_window(self.id, earliest, self._window_ticks)
        return wrap(on_radio_grid(free_instant_ticks(self.id, window, self._window_ticks), self._delay_ticks))

    def transmission(self, tx_ticks: int) -> Transmission:
        """The frame for a time that ``next_transmission_ticks`` gave."""
        added = contents_of(self.authentication, tx_ticks, self._sequence, self.id)
        position = None if added.certificate else self._neighbours.position
        capacity = heard_capacity_2(position=position is not None, certificate=added.certificate is not None)
        heard, weak = self._neighbours.relayed(self._neighbours.own_ticks.expect(tx_ticks), capacity)
        beacon = Beacon2(
            self._site.id, self.id, self._sequence, wrap(tx_ticks + self._correction_ticks), self._issue, None,
            position, None, heard, weak, added.page(self._pages, self._sequence, self.id), added.certificate,
        )  # fmt: skip
        self._sequence = (self._sequence + 1) & 0xFF
        self.counters["sent"] += 1
        return Transmission(sealed(self.authentication, encode_2(beacon), added), tx_ticks)
