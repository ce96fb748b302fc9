"""A tag's positioning method as the almanac of protocol 1 configures it."""

from skyless.core.air.almanac import AccuracyPage, NoisePage, SchedulePage
from skyless.core.method_names import FILTERS
from skyless.core.protocol1.snapshots import SnapshotMethod, Snapshots, SnapshotSettings
from skyless.core.tag.beacon_receiver import MethodOptions
from skyless.core.tag.factory import as_required, estimator_settings, stamp_variances
from skyless.core.tag.joint import Estimation
from skyless.core.tag.observations import FixTime
from skyless.core.ticks import to_seconds


def new_method(
    options: MethodOptions, master: int, schedule: SchedulePage, noise: NoisePage, accuracy: AccuracyPage, time: FixTime
) -> Estimation | Snapshots:
    """Make the method for a site with this schedule and noise, where that anchor is the master."""
    superframe_s = to_seconds(schedule.slot_ticks * schedule.slots)
    if options.method not in FILTERS:
        tx_variance, rx_variance = stamp_variances(noise)
        settings = SnapshotSettings(
            master, schedule.anchors, tx_variance, rx_variance, schedule.tag_height_m, options.z_bounds_m
        )
        return Snapshots(SnapshotMethod(options.method), settings, time)
    assumed = estimator_settings(options.qa, schedule.tag_height_m, noise, accuracy, superframe_s)
    return Estimation(as_required(assumed, options), options.z_bounds_m, time, superframe_s)
