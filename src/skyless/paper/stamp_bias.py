"""Systematic stamp errors, and the mean position error that they leave (figure 4)."""

from typing import Final

import numpy as np
from msgspec.structs import replace

from skyless.constants import TICK_M
from skyless.kernels.arrays import Array
from skyless.paper.plan import RADIO_PS, Place
from skyless.simulation.channel import ChannelModel, power_bias_m, received_power_dbm
from skyless.simulation.impairments import DelayError, Impairments, lab_impairments
from skyless.site.lab import ideal_lab_site

DELAY_STD_M: Final = 0.05
"""Spread of the antenna delays that the biased world's anchors are wrong by, TX and RX each (assumed)."""


def impairments_of(name: str, seed: int) -> Impairments:
    """The lab, with one kind of systematic stamp error or none."""
    lab = lab_impairments(RADIO_PS)
    if name == "power":
        return replace(lab, channel=ChannelModel(power_bias=True))
    return replace(lab, delay_errors=delay_errors(seed)) if name == "delay" else lab


def delay_errors(seed: int) -> tuple[DelayError, ...]:
    """Antenna delays that nobody calibrated: normal, ``DELAY_STD_M`` for TX and for RX of every anchor."""
    anchors = ideal_lab_site().anchors
    errors = np.random.default_rng([seed, 4]).normal(0.0, DELAY_STD_M / TICK_M, (len(anchors), 2)).tolist()
    return tuple(DelayError(anchor.id, tx, rx) for anchor, (tx, rx) in zip(anchors, errors, strict=True))


def expected_bias_m(name: str, place: Place, seed: int) -> Array:
    """Mean position error of ``literal`` to first order, shape (2,).

    A DTDoA is late by what its RX stamps at the tag are late, less the master's, plus what the anchor's stamp of the
    master is late (its offset carries that on), plus the anchor's own TX delay; the master's TX delay cancels. The
    unweighted least squares make (JᵀJ)⁻¹Jᵀ of it.
    """
    anchors_m = np.array([(anchor.x_m, anchor.y_m) for anchor in ideal_lab_site().anchors])
    away = np.array(place) - anchors_m
    ranges_m = np.linalg.norm(away, axis=1)
    late_m = np.zeros(len(anchors_m))
    if name == "power":
        at_tag, at_anchors = _power_bias_m(ranges_m), _power_bias_m(np.linalg.norm(anchors_m - anchors_m[0], axis=1))
        late_m = at_tag - at_tag[0] + at_anchors
    elif name == "delay":
        late_m = np.array([error.tx_ticks + error.rx_ticks for error in delay_errors(seed)]) * TICK_M
    units = away / ranges_m[:, None]
    bias, *_ = np.linalg.lstsq(units[1:] - units[0], late_m[1:], rcond=None)
    return np.asarray(bias)


def _power_bias_m(ranges_m: Array) -> Array:
    power_dbm = ChannelModel().tx_power_dbm
    return np.array([power_bias_m(received_power_dbm(power_dbm, float(range_m), 0.0)) for range_m in ranges_m])
