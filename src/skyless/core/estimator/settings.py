"""The estimator's assumptions: constants common to all sites, and the settings of a site and its tags."""

from math import inf, isnan, nan
from typing import Final

from skyless.core.integrity import RISK
from skyless.core.native.records import Record, record


@record
class Tuning(Record):
    """Constants of the estimator, the same at every site; ``docs/estimator_table.md`` shows what each one buys.

    Normalised means divided by the standard deviation. The weight of a running mean is that of the newest value.
    """

    # Clocks
    restart_m: float = 300.0
    """A change of path by more than this between packets is impossible [m]."""
    start_walk_scale: float = 100.0
    """Factor on the random walk of the tag's oscillator at a start, as it warms up after power-on."""
    mean_gain: float = 0.05
    """Weight in running means of normalised innovations (along each axis, of all anchors, of an anchor's relays), and
    decay of the counts of recent relays with each packet."""
    noise_growth: float = 1.2
    """Growth of adapted process noise with each innovation that requires more …"""
    max_walk_scale: float = 1e4
    """Largest factor on the random walk of a clock; for the tag's, at once when all innovations are on one side."""
    noise_loss: float = 0.99
    """… and its factor with every other innovation; that of a range error has 1 − ``mean_gain``."""
    common: float = 1.5
    """If the normalised innovations of all anchors are beyond this on one side, the tag's clock has left its rate."""
    rate_s: float = 0.5
    """Time over which rates of clocks are compared, while phases are in use, to learn how little they wander [s] …"""
    rate_changes: float = 20
    """… the number of changes remembered …"""
    least_walk_scale: float = 0.02
    """… and the smallest factor on that of the settings."""
    relays_in_row: float = 8
    """Consecutive relays of a pair beyond the gate that show that its path has jumped; fewer may be late."""
    steady_walk_scale: float = 4.0
    """Largest factor on the random walk of a clock at which an anchor's report is used: its filter assumes 1."""

    # Motion
    max_scale: float = 100.0
    """Largest factor on the process noise of motion, and on that of a range error that has jumped."""
    lag_limit: float = 3.5
    """Mean square of the innovations along the axes (1 if the filter is right) beyond which that noise grows …"""
    sudden_lag: float = 9.0
    """… and the square of their running mean beyond which it doubles with each innovation."""
    walking_mps: float = 4.0
    """Speed above which that noise is at least its setting × (speed over this)², for turns [m/s]."""
    better_known: float = 0.8
    """The position of a tag at rest is updated once its variance has shrunk to this fraction."""
    stationary_noise_share: float = 2e-7
    """Fraction of the process noise of motion kept at rest: 5 cm within half a minute."""
    stationary_std_mps: float = 0.01
    """Standard deviation of the velocity of a tag at rest [m/s]."""

    # Motion sensors
    longest_gap_s: float = 0.3
    """Without samples for longer, the tag moves by its motion model again [s]."""
    shock_mps2: float = 100.0
    """A specific force beyond this [m/s²] …"""
    shock_rps: float = 20.0
    """… or a rate beyond this [rad/s] exceeds many sensors' range: what it did to the tag is unknown."""
    short_gap_s: float = 0.05
    """Beyond this the newest sample does not stand for the present: process noise is that without a sensor [s]."""
    wrong_scale: float = 60.0
    """A factor on process noise beyond this shows that sensor and positions contradict each other, …"""
    wrong_speed_nis: float = 5.0
    """… or a mean NIS of wheels' speeds beyond this, …"""
    wrong_s: float = 1.5
    """… after this time [s]. It is then ignored …"""
    ignored_s: float = 20.0
    """… for this time [s], and its heading is looked for again."""
    level_s: float = 0.5
    """Time over which specific force is averaged to find the level [s]."""
    rest_rps: float = 0.1
    """A sensor's rate above this shows motion [rad/s] …"""
    rest_mps2: float = 0.5
    """… and a specific force that differs from its running mean by more [m/s²]."""
    rest_mps: float = 0.2
    """A tag that is faster is not at rest, whatever the sensor shows [m/s]."""
    tilt_s: float = 2.0
    """Time in which known errors of tilt and heading move into the attitude [s], …"""
    slow_tilt_s: float = 10.0
    """… in which the mean specific force corrects the level of a tag in motion whose heading is unknown [s] …"""
    bias_s: float = 20.0
    """… and in which those that come back move into the gyroscope's bias [s]."""
    heading_std: float = 0.7
    """Standard deviation of cosine and sine of an unknown heading."""
    heading_memory_s: float = 20.0
    """Time in which a tag at rest forgets what little it knows of its heading [s]."""
    heading_walk: float = 0.02
    """Random walk of both [1/√s]: the gyroscope's drift."""
    acceleration_std_mps2: float = 1.0
    """Standard deviation of an acceleration's error: six degrees of tilt [m/s²] …"""
    acceleration_walk: float = 0.08
    """… and its random walk [m/s²/√s]."""
    vertical_share: float = 0.02
    """Share of both variances for the vertical, which does not depend on tilt."""
    sensor_noise: float = 0.01
    """Process noise of motion with a sensor whose heading is known [m²/s³] …"""
    headless_noise: float = 0.1
    """… and while it is not known."""
    known_heading_variance: float = 0.05
    """Variance of the heading below which it is roughly known [rad²] …"""
    sure_heading_variance: float = 0.0076
    """… and below which it is well known, to five degrees: the gyroscope's bias is then learnt from its changes."""
    speed_std_mps: float = 0.02
    """Standard deviation of the speed that wheels show, over a second [m/s] …"""
    speed_share: float = 0.02
    """… and the part that is a fraction of it."""

    # Linearisation (docs/maths.md, section 6)
    held_step_m: float = 0.15
    """Distance of the estimate from the point of linearisation, of ranges or phases, that moves the point [m]."""
    held_max_m: float = 0.4
    """The point stays within ``suspect`` standard deviations of the estimate, and within this distance [m]."""
    curvature_share: float = 0.01
    """Share of the stamps' variance below which the curvature of ranges is neglected."""
    slope_from_m: float = 4.0
    """Range at which distance-dependent errors are zero, and over which they reach their full size [m] (APS011)."""

    # Which innovations are used
    forgetting: float = 0.02
    """Weight in the mean NIS, the share of rejected innovations and the mean square along axes: the last 50."""
    wrong_nis: float = 2.0
    """Mean NIS beyond which covariances are scaled by its square, phases are not used and a new start is abandoned,
    once: it was wrong, for example because of late packets."""
    slow_forgetting: float = 0.005
    """Weight in the shares of late receptions and of wild phases, and in the phases' noise: the last 200."""
    late_often_share: float = 0.02
    """Share of late receptions beyond which single receptions are often late."""
    reception_huber: float = 1.5
    """Normalised innovation beyond which receptions are down-weighted if they are often late, or one has just jumped
    (Huber 1964)."""
    difference_huber: float = 1.0
    """The same for time differences, always."""
    max_relays_rejected: float = 4.0
    """Count of recent relays beyond the gate that late packets may explain."""
    lost_in_row: float = 8
    """Consecutive rejected packets, without single late ones, at which the state is wrong."""
    lost_share: float = 0.5
    """Share of rejected innovations at which the state is wrong."""

    # Range errors that jump
    suspect: float = 3.0
    """Normalised innovation beyond which a reception may be a jump and two of them differ by more than chance; also for
    a running mean over its expectation, which then requires more process noise."""
    in_row: float = 2
    """Consecutive receptions of that kind that make a jump, and impossible ones that show a counter's restart …"""
    in_row_where_late: float = 5
    """… and the number if single receptions are often late."""
    together: float = 7.0
    """Sum of two such normalised innovations, reached by chance once in some million packets."""
    first_change_scale: float = 20.0
    """Factor on the process noise of a range error that has just jumped, as it may still be changing."""
    ended_log_odds: float = 7.0
    """Sum of logarithms of odds for no range error at which an obstruction has ended …"""
    ended_std_m: float = 0.05
    """… as it has once the range error is known to this, and within its standard deviation of zero [m]."""
    obstructed_walk: float = 0.004
    """Spectral density of the random walk of a range error that has jumped [m²/s]."""
    obstruction_memory_s: float = 10.0
    """Time constant of its return to zero, and of forgetting a jump [s]."""
    obstruction_return_m: float = 0.2
    """Largest return in that time [m]: long delays are no less likely to stay."""
    jump_rise: float = 0.5
    """Fraction of its full size by which a jump raises the process noise of all range errors."""
    recent_jumps: float = 0.25
    """Fraction from which on the next jump is expected, and large innovations are down-weighted."""
    obstructed_std_m: float = 0.04
    """Standard deviation by which all range errors change after jumps [m] …"""
    obstructed_s: float = 5.0
    """… and the time constant of that change [s]."""

    # Multipath, from range errors compared after each step of the tag and after two (a semivariogram, Matheron 1963)
    place_step_m: float = 0.1
    """Length of a step [m]."""
    place_first: float = 20
    """Number of comparisons that the stamps' noise counts for initially."""
    place_samples: float = 100
    """Comparisons needed …"""
    place_memory: float = 1000
    """… and remembered."""
    place_min_m2: float = 0.0012
    """Smallest variance between two steps that counts as multipath [m²]."""
    place_kept: float = 0.1
    """Smallest correlation over a step, and smallest loss of correlation."""
    max_change_std_m: float = 0.5
    """Largest standard deviation of the changing part of a range error, and of a pair's range after a jump [m]."""

    # Faults that the state does not hold (docs/maths.md, section 8)
    lasting_std_m: float = 0.3
    """Standard deviation of each coordinate of a misplaced anchor, and of a fault since the anchor joined [m] …"""
    recent_std_m: float = 0.08
    """… of one that began recently without a visible jump [m] …"""
    creeping_std_m: float = 0.2
    """… and of one that grows for seconds [m]."""
    recent_packets: float = 16.0
    """Packets of each anchor over which a fault is recent."""
    creeping_s: float = 3.0
    """Time in which a creeping fault grows by a factor of e [s]."""
    late_std_m: float = 1.0
    """Prior standard deviation of a fault that is added to the state, and of all faults at the start [m]."""
    sure_chi2: float = 50.0
    """Test beyond which there is a fault: χ² with eight degrees of freedom has a probability of 4·10⁻⁸."""
    early_weight: float = 0.8
    """Weight of what an early fault explains, as obstacles make packets late."""

    # Anchors that stand elsewhere
    open_pair_std_m: float = 0.1
    """Standard deviation of the range between two anchors against the survey, before it is measured [m]."""
    pair_relays: float = 12
    """Relays in each direction after which their mean is a range."""
    misplaced_pairs: float = 2
    """Number of such ranges beyond ``suspect``, more than at the other end, that mark an anchor as misplaced."""

    # Starts, and what is lost
    start_age_s: float = 0.5
    """Older packets are not used for a start, unless the superframe is longer [s]."""
    curved_std: float = 0.1
    """Fraction of the mean range beyond which ranges are curved within a standard deviation, and updates would make the
    filter overconfident in a wrong position. There is no level then, and no prediction."""
    start_patience_s: float = 0.5
    """Time for which a wide or contradicted start is withheld, as more anchors may be heard [s]."""
    start_tail: float = 1e-4
    """Tail probability below which residuals contradict a start, and weight below which other positions are no
    rivals."""
    new_start_s: float = 1.0
    """Time for which a start is new [s]. Until then a start with open range errors is not repeated, and phases are not
    used, as a position that still moves with the stamps' noise would turn the directions to the anchors."""
    start_margin: float = 4.0
    """Factor on the start's covariance, as the filter then processes the packets that it was computed from."""
    short_silence_s: float = 0.1
    """Shorter silences hardly widen the state, and packets late by less are delayed by the radio [s]."""
    longest_silence_s: float = 5.0
    """After a longer silence the state is worse than a new start [s]."""
    slow_superframe_s: float = 0.2
    """In longer superframes, where a new start takes seconds, a silence may widen the state more [s] …"""
    slow_curved_std: float = 0.7
    """… up to this fraction of the mean range …"""
    slow_start_std: float = 2.0
    """… and a start, which goes back to the packets before, up to this multiple of it; otherwise up to 1."""
    longest_superframe_s: float = 1.3
    """In longer superframes a tag may move by metres: each round of packets is a start of its own [s]."""
    heights_in_row: float = 20
    """Consecutive heights that do not fit at which the position is wrong."""
    open_survey_std_m: float = 0.15
    """Standard deviation of each coordinate of an anchor after a contradicted start [m]."""
    fitting_chi2: float = 2.0
    """χ² per anchor below which range errors agree with the settings."""
    most_late: float = 2
    """Most late anchors at the start: on the floor or behind metal one often is."""
    late_penalty: float = 2.0
    """Penalty on χ² for each of them: odds of 1 to 3."""
    staying_share: float = 0.2
    """Fraction of an anchor's lateness at the start that stays: its mean, and its standard deviation."""
    window: float = 60
    """Ready-made time differences used to find a start …"""
    window_s: float = 1.0
    """… or those of this time [s]."""
    moving_window: float = 20
    """Differences that take longer than that find the start of a tag that may be moving; in them it is searched …"""
    moving_std_m: float = 1.5
    """… from places with this standard deviation [m] …"""
    moving_nis: float = 1.5
    """… and found where the mean NIS is below this …"""
    moving_apart: float = 6.0
    """… and that of no other place, summed, is within this."""
    median_difference_std_m: float = 0.08
    """Standard deviation of the median of a pair's differences [m]."""
    late_start_std_m: float = 0.14
    """Standard deviation of each anchor's error at the start, before any are estimated [m]."""
    rival_m: float = 0.5
    """Distance from which two positions are rivals; after it a moving tag is late to other anchors [m]."""
    height_margin_m: float = 1.0
    """Starts are within this height above and below anchors of different heights, unless bounds are given [m]."""
    neighbourhood: float = 1.5
    """A tag without beacons that is farther from the anchors' centre than this fraction of their diagonal is lost."""
    most_horizontal_std_m: float = 3.0
    """Largest horizontal standard deviation of a fix [m]."""
    zero_variance_m2: float = 1e4
    """Initial variance of a barometer's zero [m²]."""

    # Phases of the carrier
    phases_start_s: float = 2.0
    """Time from a start until the tag's phases are used: by then constants of pairs of anchors are known [s]."""
    phase_start_std_m: float = 0.003
    """Standard deviation of a phase until innovations show another [m] …"""
    phase_max_std_m: float = 0.006
    """… and its upper limit, unless the settings exceed it [m]."""
    phase_mesh_std_m: float = 0.0012
    """Standard deviation of a phase that an anchor measured of another [m]."""
    phase_wander: float = 25.0
    """Change of an ambiguity by reflections as the tag walks, in variances of a phase per metre [1/m]."""
    phase_gate: float = 0.35
    """Fraction of a wavelength beyond which no innovation is used: near one half the sign is unknown."""
    phase_share: float = 0.1
    """Largest standard deviation of a prediction that determines the cycle, as a fraction of a wavelength."""
    phase_step_m: float = 0.02
    """Length of the steps by which reflections change phases [m]."""
    pair_share: float = 0.2
    """Largest standard deviation of a pair's constant at which its phases are used, and of one of these at which it
    changes the constant, as a fraction of a wavelength."""
    phases_nis: float = 1.6
    """Mean NIS beyond which all hypotheses on cycles are given up …"""
    slip_std_m: float = 0.05
    """… and what is then added to the standard deviation of the position, or to that of an anchor's clock whose relays'
    stamps contradict their phases: about a wavelength [m]."""
    phases_walk_scale: float = 8.0
    """Largest factor on the random walk of the tag's clock at which phases are taken at several cycles."""
    most_cycles: float = 4.0
    """Number of cycles within the gate beyond which hypotheses on them are of no use."""
    start_wild: float = 0.009
    """Share of wild phases at a start: hypotheses are possible, but not for long if one looks wild."""
    least_wild: float = 0.002
    """Share of wild phases that is expected at least, so that they can be found."""
    most_wild: float = 0.01
    """Share beyond which hypotheses on cycles are misleading."""
    unlikely_log_odds: float = 10.0
    """Logarithm of the odds against a hypothesis beyond which it is dropped."""
    alike: float = 0.15
    """Squared difference of two hypotheses, over the variance of each state, up to which they are merged."""
    phase_walking_mps: float = 0.75
    """The same as ``walking_mps`` while phases may be taken at several cycles [m/s] …"""
    speed_memory_s: float = 1.0
    """… for the largest speed within this time [s]."""
    phases_in_row: float = 4
    """Consecutive phases of an anchor beyond the gate at which its ambiguity restarts."""

    # Levels that are withheld
    uncovered_chi2: float = 240.0
    """Test beyond which faults exceed what levels cover."""
    max_open_level_std: float = 0.02
    """Fraction of the mean range: a larger standard deviation has no level while all range errors are open."""
    contradicted_start_s: float = 5.0
    """Time without a level after a contradicted start: several late anchors may agree on a wrong position [s]."""
    probe_m: float = 1.0
    """Smallest distance from the anchors' plane at which its two sides are compared [m]."""
    shift_part: float = 0.25
    """Standard deviation of the best position on the other side about the mirror image, over that distance."""
    apart_chi2: float = 20.0
    """Squared difference over its variance from which two things differ: ranges of both sides, two starts, or the
    explanations by faults of two anchors."""
    sensor_valid_s: float = 1.0
    """Time for which a sensor's height decides between them [s]."""


TUNING: Final = Tuning()
"""The constants in use. Each state holds a copy."""


# Standard deviation of the constant error of the range between two anchors, without that of their survey.
PAIR_STD_M: Final = 0.02


@record
class EstimatorSettings(Record):
    """The filter's assumptions at a site; standard deviations are one sigma."""

    qa: float = 0.5
    """Spectral density of the tag's acceleration, m²/s³ per axis."""
    start_speed_std_mps: float = 2.0
    """Standard deviation of the tag's speed at the start, when pseudoranges are not simultaneous."""
    white: float = 3.6e-5
    """White frequency noise of each oscillator, m²/s."""
    walk: float = 0.09
    """Random walk of each oscillator's rate, m²/s³."""
    tx_variance_m2: float = 9e-4
    rx_variance_m2: float = 9e-4
    """Variances of one stamp each."""
    gate: float = 4.0
    """Innovations beyond this number of standard deviations are not used."""
    height_m: float = nan
    """Given height of the tag; NaN to estimate it."""
    height_std_m: float = 0.0
    """Standard deviation of the given height."""
    lowest_m: float = -inf
    highest_m: float = inf
    """Bounds of the tag's height."""
    carrier_cycles: int = 13
    """Carrier cycles in 128 ticks for the use of phases, 13 for channel 5; 0: phases are not used."""
    phase_std_m: float = 0.0015
    """Smallest standard deviation of a phase as the tag measures it."""
    phase_wander: float = 3e-5
    """Smallest change of an anchor's phases by reflections as the tag walks, m²/m."""
    drop_s: float = 2.0
    """Anchors leave the state after this silence."""
    relay_age_s: float = 1.0
    """Relays of older packets are not used, as sequence numbers wrap around."""
    survey_std_m: float = 0.02
    """Standard deviation of each coordinate of an anchor."""
    range_std_m: float = 0.03
    """Standard deviation of the constant error of a tag's ranges to one anchor."""
    pair_std_m: float = PAIR_STD_M
    """Standard deviation of the constant error of the range between two anchors.

    It is not used where survey and ranges are exact."""
    slope_std_m: float = 0.05
    """Growth of ranges per unit of clip((range − 4 m)/4 m, −1, 1)."""
    place_std_m: float = 0.005
    """Standard deviation of the part of a range error that changes as the tag moves (named as in the site file)."""
    place_distance_m: float = 1.0
    """Distance over which that part changes."""
    place_time_s: float = 100.0
    """Time over which that part changes while the tag is stationary."""
    change_memory_s: float = 0.0
    """Time constant of estimating each anchor's changing part; 0 if it is ``place_std_m``."""
    barometer_walk: float = 2.5e-4
    """Random walk of a barometer's zero, m²/s: 5 cm in ten seconds, as when doors and windows are opened."""
    least_change_std_m: float = 0.05
    """Lower limit of the estimated changing part."""
    earliest_m: float = -inf
    """Lower bound of the changing part: obstacles only lengthen ranges."""
    difference_std_m: float = 0.12
    """Standard deviation of each ready-made time difference."""
    stationary_s: float = 0.0
    """A tag without motion for this time counts as stationary; 0: never."""
    integrity_risk: float = RISK
    alert_limit_m: float = nan
    """Fixes with a higher horizontal protection level have an alert; NaN for none."""

    @property
    def known_height_m(self) -> float | None:
        """The given height, or None."""
        return None if isnan(self.height_m) else self.height_m

    @property
    def alert_limit(self) -> float | None:
        """The alert limit [m], or None."""
        return None if isnan(self.alert_limit_m) else self.alert_limit_m

    @property
    def dim(self) -> int:
        """Number of estimated dimensions of the position."""
        return 3 if isnan(self.height_m) else 2
