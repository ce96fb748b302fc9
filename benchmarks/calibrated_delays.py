"""What antenna delays are off after a calibration: by ranges alone, and by these and a tag (docs/calibration.md).

    python benchmarks/calibrated_delays.py [--seeds 6] [--seconds 6]

Simulated air; delays of 10 cm (TX and RX each, 1 sigma). Figures: rms of 2h over anchors without the master and over
seeds, and the stated standard deviation in brackets, centimetres.
"""

import argparse
from functools import partial

import numpy as np
from msgspec.structs import replace

from skyless.core.protocol1.anchor import Anchor
from skyless.core.site import EXACT
from skyless.core.ticks import TICK_M
from skyless.research.calibration.tags import at_positions
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.impairments import AnchorDisplacement, DelayError, PairError
from skyless.sim.lab import paper_lab_site
from skyless.sim.range_errors import RangeErrorModel
from skyless.sim.stations import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World
from skyless.site.file.template import rectangular_site
from skyless.site.survey.facts import Facts
from skyless.site.survey.relayed import RelayedDifferences
from skyless.site.survey.solve import run_survey
from skyless.site.survey.stamps.legs import LegCollector
from skyless.site.survey.stamps.pair_ranger import PairRanger
from skyless.site.survey.walk import EpochCollector

LAB = paper_lab_site()
ROOM = replace(rectangular_site(8.0, 6.0, 8, 3.0, None), accuracy=EXACT)
CASES = (
    ("lab, one point", LAB, ((3.0, 4.0, 0.0),)),
    ("lab, three points", LAB, ((3.0, 4.0, 0.0), (2.0, 1.0, 0.0), (5.0, 5.0, 0.0))),
    ("eight anchors in 3-D, one point", ROOM, ((3.0, 4.0, 1.2),)),
)
ERRORS = (("", 0.0, 0.0, 0.0), ("reflections", 0.03, 0.02, 0.0), ("reflections, by hand", 0.03, 0.02, 0.02))


def world_of(site, stays, seed, at_tag_m, of_pairs_m, by_hand_m):
    """A world with errors of its seed, and the true h of each anchor."""
    rng = np.random.default_rng(seed)
    delays = tuple(DelayError(anchor.id, *(rng.normal(0.0, 0.1, 2) / TICK_M)) for anchor in site.anchors)
    axes = 2 if site is LAB else 3
    moved = (AnchorDisplacement(one.id, *rng.normal(0.0, by_hand_m, axes)) for one in site.anchors if by_hand_m)
    ids = sorted(anchor.id for anchor in site.anchors)
    pairs = (PairError(a, b, float(rng.normal(0.0, of_pairs_m))) for a in ids for b in ids if a < b and of_pairs_m)
    faults = replace(
        impairments_of(Request(site), site),
        delay_errors=delays,
        anchor_displacements=tuple(moved),
        range_errors=RangeErrorModel(constant_m=at_tag_m * 3.0**0.5),
        anchor_pair_errors=tuple(pairs),
    )
    tags = [TagSpec(Static(*stay)) for stay in stays]
    true_m = {one.anchor: (one.tx_ticks + one.rx_ticks) / 2.0 * TICK_M for one in delays}
    return World(site, partial(Anchor, site), tags, faults, seed), true_m


def trial(site, stays, seconds, seed, errors):
    """Errors of 2h without the master and stated standard deviations, of both ways, shape (2, 2)."""
    world, true_m = world_of(site, stays, seed, *errors)
    legs, ranger = LegCollector(site.id), PairRanger()
    differences = [RelayedDifferences(site.id) for _ in stays]
    collectors = [EpochCollector(relayed=True) for _ in stays]
    for broadcast in world.run(seconds):
        for tag, reception, _ in broadcast.receptions():
            if reception.host_s < 1.0:  # clocks start
                continue
            for one in differences[tag].add(reception):
                collectors[tag].add(reception.host_s - one.age_s, one.first, one.second, one.difference_m)
            for leg in legs.add(reception) if tag == 0 else ():
                ranger.add(leg.sender, leg.receiver, leg.tx_ticks, leg.rx_ticks, leg.t_s)
    ranger.finish()
    positions_m = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors}
    master = site.master
    epochs = tuple(
        at_positions(one.epochs(), "a tag", lambda _, stay=stay: stay)
        for one, stay in zip(collectors, stays, strict=True)
    )
    facts = Facts(
        dimensions=3, sketch_m=positions_m, sketch_std_m=errors[2] or 1e-4, keep_positions=True, delay_std_m=0.15
    )
    found = []
    for tags in ((), epochs):
        survey = run_survey(ranger.ranges(), replace(facts, tags=tags))
        found.append({one.id: (2.0 * one.delay_m, 2.0 * one.delay_std_m) for one in survey.anchors})
    rows = [[(one[a][0] - 2.0 * true_m[a], one[a][1]) for a in true_m if a != master and a in one] for one in found]
    return np.array([np.sqrt(np.mean(np.square(row), axis=0)) for row in rows])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=6.0)
    asked = parser.parse_args()
    print(f"{'':56}{'ranges':>14}{'both':>14}")
    for name, site, stays in CASES:
        for what, *errors in ERRORS:
            trials = [trial(site, stays, asked.seconds, seed, errors) for seed in range(asked.seeds)]
            rms = 100.0 * np.sqrt(np.mean(np.square(trials), axis=0))
            cells = "".join(f"{error:8.2f} ({std:.2f})" for error, std in rms)
            print(f"{name + (', ' + what if what else ''):56}{cells}", flush=True)


if __name__ == "__main__":
    main()
