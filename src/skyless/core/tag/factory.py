"""A tag's positioning method as the almanac configures it, and a receiver's state as values."""

from typing import Final

from msgspec import Struct

from skyless.core.air.almanac import AccuracyPage, NoisePage
from skyless.core.air.local_almanac import CommonPages, LocalAlmanacState
from skyless.core.clock_filter import clock_noise, stamp_variance_m2
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.observation import Observation
from skyless.core.tag.beacon_receiver import AdmissionState, MethodOptions
from skyless.core.tag.joint import Estimation, EstimationState
from skyless.core.tag.selection import MAX_ANCHORS_IN_USE
from skyless.core.ticks import FixTime, to_seconds

DROP_S: Final = 2.0
"""An anchor that is silent for longer, or for four superframes, leaves the estimator."""

CELL_DROP_S: Final = 1.0
"""Replaces ``DROP_S`` at a site of protocol 2, where tags move from cell to cell."""

# Relays of packets that are older than both are not used.
RELAY_AGE_S: Final = 1.0
RELAY_SUPERFRAMES: Final = 2.5


def new_method(options: MethodOptions, pages: CommonPages, period_ticks: int, time: FixTime) -> Estimation:
    """Make the method for a site of protocol 2 whose anchors have mean periods of at most this."""
    superframe_s = to_seconds(period_ticks)
    settings = estimator_settings(options.qa, pages.site.tag_height_m, pages.noise, pages.accuracy, superframe_s)
    settings = as_required(settings, options).changed(drop_s=max(CELL_DROP_S, 4.0 * superframe_s))
    return Estimation(settings, options.z_bounds_m, time, superframe_s, MAX_ANCHORS_IN_USE)


def as_required(settings: EstimatorSettings, options: MethodOptions) -> EstimatorSettings:
    """The settings with what is required of the protection levels."""
    return settings.changed(
        max_acceleration_mps2=options.integrity.max_acceleration_mps2,
        integrity_risk=options.integrity.risk,
        alert_limit_m=options.integrity.alert_limit_m,
        height_std_m=options.integrity.height_std_m,
    )


def stamp_variances(noise: NoisePage) -> tuple[float, float]:
    """Variances of a TX and of an RX stamp, m²."""
    return stamp_variance_m2(noise.tx_stamp_s, rounded=False), stamp_variance_m2(noise.rx_stamp_s, rounded=True)


def estimator_settings(
    qa: float, height_m: float | None, noise: NoisePage, accuracy: AccuracyPage, superframe_s: float
) -> EstimatorSettings:
    """What the estimator assumes at a site with this noise and accuracy."""
    tx_variance, rx_variance = stamp_variances(noise)
    own = clock_noise(noise.white_fm, noise.random_walk_fm, clocks=1)
    return EstimatorSettings(
        qa=qa,
        white=own.white,
        walk=own.walk,
        tx_variance_m2=tx_variance,
        rx_variance_m2=rx_variance,
        height_m=height_m,
        drop_s=max(DROP_S, 4.0 * superframe_s),
        relay_age_s=max(RELAY_AGE_S, RELAY_SUPERFRAMES * superframe_s),
        survey_std_m=accuracy.survey_std_m,
        range_std_m=accuracy.range_std_m,
        slope_std_m=accuracy.slope_std_m,
        place_std_m=accuracy.place_std_m,
        place_distance_m=accuracy.place_distance_m,
        place_time_s=accuracy.place_time_s,
    )


class ReceiverState(Struct, frozen=True, tag="protocol-2"):
    """All that a ``Receiver`` keeps; to be used or encoded before its next frame, as they share some parts."""

    admission: AdmissionState
    hearing: bytes
    almanac: LocalAlmanacState
    method_period_ticks: int
    method: EstimationState | None
    waiting: tuple[Observation, ...]
    moved_ticks: dict[int, int]
    uses_moved: bool
