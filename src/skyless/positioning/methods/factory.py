"""A tag's positioning method as the almanac configures it."""

from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from skyless.air.almanac import AccuracyPage, NoisePage, SchedulePage
from skyless.clocks.filter import clock_noise, stamp_variance_m2
from skyless.method_names import FILTERS
from skyless.positioning.estimator.state import EstimatorSettings
from skyless.positioning.integrity import IntegrityRequirement
from skyless.positioning.methods.joint import Estimation
from skyless.positioning.methods.observations import FixTime
from skyless.positioning.methods.selection import MOST_ANCHORS_IN_USE
from skyless.positioning.methods.snapshots import SnapshotMethod, Snapshots, SnapshotSettings
from skyless.site.local_almanac import CommonPages
from skyless.ticks import to_seconds

DROP_S: Final = 2.0
"""An anchor that is silent for longer, or for four superframes, is out of view (``joint``)."""

CELL_DROP_S: Final = 1.0
"""The same at a site of protocol 2, where tags move from cell to cell."""

RELAY_AGE_S: Final = 1.0
RELAY_SUPERFRAMES: Final = 2.5
"""Relays of packets that are older than the one, or than this number of superframes, are not used."""


class MethodOptions(Struct, frozen=True):
    """What the tag's owner configures."""

    method: str
    """One of ``METHODS``."""
    qa: float
    """Spectral density of the tag's acceleration, m²/s³ per axis (filters)."""
    z_bounds_m: tuple[float, float] | None
    """Decides between mirror solutions."""
    integrity: IntegrityRequirement
    """What is required of the protection levels (``joint``)."""


def new_method(
    options: MethodOptions, master: int, schedule: SchedulePage, noise: NoisePage, accuracy: AccuracyPage, time: FixTime
) -> Estimation | Snapshots:
    """Make the method for a site with this schedule and noise, where that anchor is the master."""
    superframe_s = to_seconds(schedule.slot_ticks * schedule.slots)
    if options.method not in FILTERS:
        tx_variance, rx_variance = _stamp_variances(noise)
        settings = SnapshotSettings(
            master, schedule.anchors, tx_variance, rx_variance, schedule.tag_height_m, options.z_bounds_m
        )
        return Snapshots(SnapshotMethod(options.method), settings, time)
    assumed = estimator_settings(options.qa, schedule.tag_height_m, noise, accuracy, superframe_s)
    return Estimation(_as_required(assumed, options), options.z_bounds_m, time, superframe_s)


def new_method_2(options: MethodOptions, pages: CommonPages, superframe_ticks: int, time: FixTime) -> Estimation | None:
    """Make the method for a site of protocol 2; None for methods that need a master."""
    if options.method not in FILTERS:
        return None
    superframe_s = to_seconds(superframe_ticks)
    settings = estimator_settings(options.qa, pages.site.tag_height_m, pages.noise, pages.accuracy, superframe_s)
    settings = replace(_as_required(settings, options), drop_s=max(CELL_DROP_S, 4.0 * superframe_s))
    return Estimation(settings, options.z_bounds_m, time, superframe_s, MOST_ANCHORS_IN_USE)


def _as_required(settings: EstimatorSettings, options: MethodOptions) -> EstimatorSettings:
    """The settings with what is required of the protection levels."""
    return replace(
        settings,
        max_acceleration_mps2=options.integrity.max_acceleration_mps2,
        integrity_risk=options.integrity.risk,
        alert_limit_m=options.integrity.alert_limit_m,
        height_std_m=options.integrity.height_std_m,
    )


def _stamp_variances(noise: NoisePage) -> tuple[float, float]:
    """Of a TX and of an RX stamp, m²."""
    return stamp_variance_m2(noise.tx_stamp_s, rounded=False), stamp_variance_m2(noise.rx_stamp_s, rounded=True)


def estimator_settings(
    qa: float, height_m: float | None, noise: NoisePage, accuracy: AccuracyPage, superframe_s: float
) -> EstimatorSettings:
    """What the estimator assumes at a site with this noise and accuracy; of its integrity and the tag the defaults."""
    tx_variance, rx_variance = _stamp_variances(noise)
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
