import sys, time, numpy as np
from msgspec.structs import replace
from skyless.air.beacon import Heard, Malformed
from skyless.air.beacon2 import Beacon2, StatedPosition
from skyless.air.codec2 import encode_2, heard_capacity_2, decode_2_cached
from skyless.air.frames import decode_any
from skyless.air.reception import Reception, Transmission
from skyless.receiver import Receiver
from skyless.site.lab import lab_site, ideal_lab_site
from skyless.site.local_almanac import *
from skyless.site.free_access import free_instant_ticks
from skyless.simulation.world import World
from skyless.simulation.stations import TagSpec
from skyless.simulation.trajectory import Static
from skyless.evaluation.scenarios import Request, impairments_of
from skyless.ticks import Unwrapper, wrap, from_seconds
from collections import Counter


class Free:
    def __init__(self, site, anchor):
        self.id = anchor
        self.site = site
        self.own = {a.id: a for a in site.anchors}[anchor]
        self.u = Unwrapper()
        self.heard_ = {}
        self.seq = 0
        self.pages = site_pages_of(site)
        self.issue = site_issue(self.pages)
        self.win = from_seconds(1 / site.schedule.rate_hz)

    def hear(self, r):
        b = decode_any(r.frame)
        if isinstance(b, Malformed):
            return
        t = self.u.unwrap(r.rx_ticks, r.host_s)
        self.heard_.pop(b.anchor, None)
        self.heard_[b.anchor] = (Heard(b.anchor, b.sequence, r.rx_ticks), t)

    def next_transmission_ticks(self, now):
        n = self.u.unwrap(now) + from_seconds(1.2e-3)
        k = n // self.win
        while True:
            t = free_instant_ticks(self.id, k, self.win)
            if t > n:
                break
            k += 1
        t -= (t - self.own.tx_antenna_delay_ticks) % 512
        return wrap(t)

    def transmission(self, tx):
        t = self.u.expect(tx)
        cap = heard_capacity_2(False, True, False, True)
        hs = tuple(h for h, x in reversed(self.heard_.values()) if x > t - from_seconds(1.0))[:cap]
        b = Beacon2(
            self.site.id,
            self.id,
            self.seq,
            tx,
            self.issue,
            None,
            StatedPosition(self.own.x_m, self.own.y_m, self.own.z_m, 0.0),
            None,
            hs,
            0,
            site_page_for(self.pages, self.seq, self.id),
        )
        self.seq = self.seq + 1 & 255
        return Transmission(encode_2(b), tx)


def new_anchor(site, anchor):
    return Free(site, anchor)
