"""The settings of a tag's filter from pages and options, and a receiver's state as values."""

from msgspec import Struct

from skyless.core.air.almanac import AccuracyPage, NoisePage
from skyless.core.clock_filter import stamp_variance_m2
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.tag.beacon_receiver import AdmissionState, MethodOptions
from skyless.core.tag.joint import EstimationState
from skyless.core.tag.site_settings import DROP_S, fill_ages, fill_noise


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
    settings = EstimatorSettings(
        qa=qa,
        height_m=height_m,
        survey_std_m=accuracy.survey_std_m,
        range_std_m=accuracy.range_std_m,
        slope_std_m=accuracy.slope_std_m,
        place_std_m=accuracy.place_std_m,
        place_distance_m=accuracy.place_distance_m,
        place_time_s=accuracy.place_time_s,
    )
    fill_noise(settings, noise.tx_stamp_s, noise.rx_stamp_s, noise.white_fm, noise.random_walk_fm)
    fill_ages(settings, superframe_s, DROP_S)
    return settings


class ReceiverState(Struct, frozen=True, tag="protocol-2"):
    """All that a ``Receiver`` keeps; to be used or encoded before its next frame, as they share some parts."""

    admission: AdmissionState
    tag: bytes
    method: EstimationState
