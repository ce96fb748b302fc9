"""What the estimator assumes: constants that are the same everywhere, and settings of a site and its tags."""

from math import inf, isnan, nan
from typing import Final

from skyless.core.integrity import RISK
from skyless.core.native.records import Record, record


@record
class Tuning(Record):
    """Constants of the estimator, which are the same at every site; ``docs/estimator_table.md`` says what each buys.

    Normalised: over its standard deviation. A running mean's weight is that of the newest value.
    """

    # Clocks
    restart_m: float = 300.0
    """Paths that change by more than this between packets are impossible [m]."""
    start_walk_scale: float = 100.0
    """Factor on the random walk of the tag's oscillator at a start: it warms up after it was switched on."""
    mean_gain: float = 0.05
    """Weight in running means of normalised innovations (along each axis, of all anchors, of an anchor's relays), and
    loss of the counts of recent relays with each packet."""
    noise_growth: float = 1.2
    """Growth of adapted process noise with each innovation that calls for more …"""
    max_walk_scale: float = 1e4
    """Largest factor on the random walk of a clock, and that of the tag's once all innovations are on one side."""
    noise_loss: float = 0.99
    """… and its factor with each other one."""
    common: float = 1.5
    """Normalised innovations of all anchors beyond this on one side: the tag's clock has left its rate."""
    relays_in_row: float = 8
    """Number of relays of a pair in a row beyond the gate that show that its path has jumped; fewer may be late."""
    steady_walk_scale: float = 4.0
    """Factor on the random walk of a clock up to which an anchor's report of it is used: its filter assumes 1."""

    # Motion
    max_scale: float = 100.0
    """Largest factor on the process noise of motion, and of a range error that has jumped."""
    lag_limit: float = 3.5
    """Mean square of the innovations along the axes, 1 where the filter is right, beyond which that noise grows."""
    better_known: float = 0.8
    """The place of a tag at rest moves when its variance has shrunk to this part."""
    stationary_noise_share: float = 2e-7
    """Part of the process noise of motion that a tag at rest keeps: 5 cm within half a minute."""
    stationary_std_mps: float = 0.01
    """Standard deviation of the velocity of a tag at rest [m/s]."""

    # Linearisation (docs/maths.md, section 6)
    held_step_m: float = 0.15
    """Distance of the estimate from the point of linearisation, of ranges or of phases, at which that moves [m]."""
    held_max_m: float = 0.4
    """It stays within ``suspect`` standard deviations of the estimate, up to this distance [m]."""
    curvature_share: float = 0.01
    """Share of the stamps' variance below which the curvature of ranges is neglected."""
    slope_from_m: float = 4.0
    """Range at which errors that grow with distance pass through zero, and by which they change once [m] (APS011)."""

    # Which innovations are used
    forgetting: float = 0.02
    """Weight in the mean NIS, in the share of rejected innovations and in the mean square along axes: the last 50."""
    wrong_nis: float = 2.0
    """Mean NIS beyond which covariances are scaled by its square, phases are not used, and a new start is given up,
    once: it was wrong, for example by packets that were late."""
    slow_forgetting: float = 0.005
    """Weight in the shares of late receptions and of phases beyond the gate, and in the phases' noise: the last 200."""
    late_often_share: float = 0.02
    """Share of late receptions beyond which single ones are late often."""
    reception_huber: float = 1.5
    """Normalised innovation beyond which receptions have less weight where they are late often (Huber 1964)."""
    difference_huber: float = 1.0
    """The same of time differences, always."""
    max_relays_rejected: float = 4.0
    """Count of recent relays beyond the gate up to which they may be late ones."""
    lost_in_row: float = 8
    """Number of rejected packets in a row, single late ones left out, at which the state is wrong."""
    lost_share: float = 0.5
    """Share of rejected innovations at which it is."""

    # Range errors that jump
    suspect: float = 3.0
    """Normalised innovation beyond which a reception may be a jump, two of them differ by chance, and a running mean
    over its expectation calls for more process noise."""
    in_row: float = 2
    """Number of such receptions in a row that make a jump, and of impossible ones if a counter has restarted …"""
    in_row_where_late: float = 5
    """… and where single receptions are late often."""
    together: float = 7.0
    """Sum of two such normalised innovations: by chance once in some million packets."""
    first_change_scale: float = 10.0
    """Factor on the process noise of a range error that has just jumped: it may still be changing."""
    ended_std_m: float = 0.05
    """An obstruction has ended where the range error is known to this [m] …"""
    ended: float = 2.0
    """… and within this number of standard deviations of zero."""
    obstructed_walk: float = 0.004
    """Density with which a range error that has jumped wanders [m²/s]."""
    obstruction_memory_s: float = 10.0
    """Time in which it returns to zero, and in which a jump is forgotten [s]."""
    obstruction_return_m: float = 0.2
    """Largest return in that time [m]: long delays are no less likely to stay."""
    jump_rise: float = 0.5
    """Part of its full size by which a jump raises the process noise of all range errors."""
    obstructed_std_m: float = 0.05
    """Standard deviation by which all range errors change where some have jumped [m] …"""
    obstructed_s: float = 5.0
    """… and the time in which they do [s]."""

    # Multipath, from range errors compared after each step of the tag and after two (a semivariogram, Matheron 1963)
    place_step_m: float = 0.1
    """Length of a step [m]."""
    place_first: float = 20
    """Number of comparisons for which the stamps' noise stands beforehand."""
    place_samples: float = 100
    """Number of comparisons that are needed …"""
    place_memory: float = 1000
    """… and that are remembered."""
    place_min_m2: float = 0.0012
    """Least variance between two steps that counts as multipath [m²]."""
    place_kept: float = 0.1
    """Least correlation over a step, and least loss of it."""
    max_change_std_m: float = 0.5
    """Largest standard deviation of the part of a range error that changes as the tag moves, and that of a pair's range
    that has jumped [m]."""

    # Faults that the state does not hold (docs/maths.md, section 8)
    lasting_std_m: float = 0.3
    """Standard deviation of each coordinate of an anchor that stands elsewhere, and of a fault since it joined [m] …"""
    recent_std_m: float = 0.08
    """… of one that has begun recently without a visible jump [m] …"""
    creeping_std_m: float = 0.2
    """… and of one that grows for seconds [m]."""
    recent_packets: float = 16.0
    """Number of packets of each anchor over which a fault is recent."""
    creeping_s: float = 3.0
    """Time in which a creeping fault has become e times as large [s]."""
    late_std_m: float = 1.0
    """Standard deviation beforehand of a fault that is added to the state, and of all faults at the start [m]."""
    sure_chi2: float = 50.0
    """Test beyond which there is a fault: χ² of eight degrees of freedom with a probability of 4·10⁻⁸."""
    early_weight: float = 0.8
    """Weight of what an early fault explains: obstacles make packets late."""

    # Anchors that stand elsewhere
    open_pair_std_m: float = 0.1
    """Standard deviation of the range between two anchors against the survey, before it is measured [m]."""
    pair_relays: float = 12
    """Number of relays in either direction after which their mean is a range."""
    misplaced_pairs: float = 2
    """Number of such ranges beyond ``suspect``, and more than the other end has, that make an anchor misplaced."""

    # Starts, and what is lost
    start_age_s: float = 0.5
    """Older packets are not used for a start; where superframes are longer, for the rate of the clock only [s]."""
    curved_std: float = 0.1
    """Part of the mean range beyond which ranges are curved within a standard deviation: updates would make the filter
    sure of a wrong position. It has no level, and is not predicted further."""
    start_patience_s: float = 0.5
    """Time for which a start waits that is wide or contradicted: more anchors may come [s]."""
    start_tail: float = 1e-4
    """Probability with which residuals of a start are larger by chance than those that contradict it, and weight below
    which other positions are no rivals."""
    new_start_s: float = 1.0
    """Time for which a start is new [s]: one with open range errors is not repeated within it, and phases are not used,
    as places that still move by the stamps' noise would turn the directions to the anchors."""
    start_margin: float = 4.0
    """Factor on the start's covariance, as the filter is then given the packets that it rests on."""
    short_silence_s: float = 0.1
    """No state grows much wider over shorter silences; packets that are late by less are late from the radio [s]."""
    longest_silence_s: float = 5.0
    """After a longer one the state is worse than a new start [s]."""
    slow_superframe_s: float = 0.2
    """In longer superframes, where a new start takes seconds, a silence may widen the state more [s] …"""
    slow_curved_std: float = 0.2
    """… up to this part of the mean range."""
    longest_superframe_s: float = 2.0
    """In longer ones a tag may be metres away: nothing is predicted, and each round of packets is a start [s]."""
    heights_in_row: float = 20
    """Number of heights in a row that do not fit, after which the position is wrong."""
    open_survey_std_m: float = 0.15
    """Standard deviation of each coordinate of an anchor after a start that was contradicted [m]."""
    fitting_chi2: float = 2.0
    """χ² for each anchor below which range errors are as the settings state them."""
    most_late: float = 2
    """Number of anchors that are late at the start at most: on the floor or behind metal one often is."""
    late_penalty: float = 2.0
    """What each of them adds to χ²: odds of 1 to 3."""
    staying_share: float = 0.2
    """Part of an anchor's lateness at the start that stays: its mean, and its standard deviation."""
    window: float = 60
    """Number of ready-made time differences from which a start is looked for …"""
    window_s: float = 1.0
    """… or those of this time [s]."""
    median_difference_std_m: float = 0.08
    """Standard deviation of the median of a pair's differences [m]."""
    late_start_std_m: float = 0.14
    """Standard deviation of each anchor's error at the start, before any are estimated [m]."""
    rival_m: float = 0.5
    """Distance from which two positions are rivals; anchors lie elsewhere for a tag that has moved as far [m]."""
    height_margin_m: float = 1.0
    """Starts lie no higher above or below anchors of different heights than this, unless bounds are given [m]."""
    neighbourhood: float = 1.5
    """A tag without beacons that is farther from the anchors' centre than this part of their diagonal is lost."""
    most_horizontal_std_m: float = 3.0
    """While its horizontal standard deviation is larger, there is no fix [m]."""
    zero_variance_m2: float = 1e4
    """Variance of a barometer's zero at first [m²]."""

    # Phases of the carrier
    phase_start_std_m: float = 0.002
    """Standard deviation of a phase before innovations show another [m] …"""
    phase_max_std_m: float = 0.006
    """… and its upper bound, or that of the settings [m]."""
    phase_mesh_std_m: float = 0.0012
    """Standard deviation of a phase that an anchor measured of another [m]."""
    phase_wander: float = 25.0
    """What reflections change in an ambiguity as the tag walks, in variances of a phase for each metre [1/m]."""
    phase_gate: float = 0.35
    """Part of a wavelength beyond which no innovation is used: near half of one the sign is not known."""
    phase_share: float = 0.1
    """Part of a wavelength up to which the standard deviation of a predicted phase leaves no doubt of the cycle."""
    phase_step_m: float = 0.02
    """Length of the steps by which reflections change phases [m]."""
    phase_former_s: float = 0.5
    """Time for which an ambiguity from before a gap is kept to find by how many cycles it has changed [s]."""
    phases_in_row: float = 4
    """Number of phases of an anchor in a row beyond the gate at which its ambiguity begins again."""

    # Levels that are withheld
    uncovered_chi2: float = 240.0
    """Test beyond which faults are larger than levels cover."""
    max_open_level_std: float = 0.02
    """Part of the mean range beyond which, where all range errors are open, a standard deviation has no level."""
    contradicted_start_s: float = 5.0
    """Time without a level after a start that was contradicted: several late anchors may agree on a wrong place [s]."""
    probe_m: float = 1.0
    """Least distance from the anchors' plane at which its two sides are compared [m]."""
    shift_part: float = 0.25
    """Standard deviation of the best place on the other side about the mirror image, over that distance."""
    apart_chi2: float = 20.0
    """Squared difference over its variance from which two things differ: ranges of both sides, two starts, or what
    faults of other anchors explain."""
    sensor_valid_s: float = 1.0
    """Time for which a sensor's height decides between them [s]."""


TUNING: Final = Tuning()
"""The constants in use. Each state holds a copy."""


MAX_CLOCK_RATE: Final = 50e-6  # two crystals of ±20 ppm, and margin
# Standard deviation of the constant error of the range between two anchors, without that of their survey.
PAIR_STD_M: Final = 0.02


@record
class EstimatorSettings(Record):
    """What the filter assumes; standard deviations are one sigma."""

    qa: float = 0.5
    """Spectral density of the tag's acceleration, m²/s³ per axis."""
    start_speed_std_mps: float = 2.0
    """Standard deviation of the tag's speed at the start. It smears pseudoranges, which are not taken at once."""
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
    """Height of the tag where it is given; NaN to estimate it."""
    height_std_m: float = 0.0
    """Standard deviation of the given height."""
    lowest_m: float = -inf
    highest_m: float = inf
    """Bounds of the tag's height."""
    carrier_cycles: int = 13
    """Cycles of the carrier in 128 ticks, 13 of channel 5, whose phases count where packets have them; 0: never."""
    phase_std_m: float = 0.0005
    """Least standard deviation of a phase as the tag measures it."""
    phase_wander: float = 3e-5
    """What reflections at least change in the phases of an anchor as the tag walks, m²/m."""
    drop_s: float = 2.0
    """Anchors that are silent for longer leave the state."""
    relay_age_s: float = 1.0
    """Older packets are not relayed, as sequence numbers come around."""
    survey_std_m: float = 0.02
    """Standard deviation of each coordinate of an anchor."""
    range_std_m: float = 0.03
    """Standard deviation of the constant error of a tag's ranges to one anchor."""
    pair_std_m: float = PAIR_STD_M
    """Standard deviation of the constant error of the range between two anchors.

    It is not used where survey and ranges are exact."""
    slope_std_m: float = 0.05
    """By how much ranges lengthen for each unit of clip((range − 4 m)/4 m, −1, 1)."""
    place_std_m: float = 0.005
    """Standard deviation of the part of a range's error that changes as the tag moves (the site file's name)."""
    place_distance_m: float = 1.0
    """Distance over which that part changes."""
    place_time_s: float = 100.0
    """Time over which that part changes while the tag is stationary."""
    change_memory_s: float = 0.0
    """Time within which the size of each anchor's changing part is estimated again; 0 where it is ``place_std_m``."""
    barometer_walk: float = 2.5e-4
    """Random walk of a barometer's zero, m²/s: 5 cm in ten seconds, as where doors and windows are opened."""
    least_change_std_m: float = 0.05
    """No changing part is estimated to be smaller."""
    earliest_m: float = -inf
    """No changing part is below this: obstacles only lengthen ranges."""
    difference_std_m: float = 0.12
    """Standard deviation of each ready-made time difference."""
    stationary_s: float = 0.0
    """A tag that has not shown any motion for this time counts as stationary; 0: never."""
    max_acceleration_mps2: float = 0.0
    """The tag's largest acceleration, as far as levels are to cover it beyond ``qa``."""
    integrity_risk: float = RISK
    alert_limit_m: float = nan
    """Fixes with a higher horizontal protection level have an alert; NaN for none."""

    @property
    def known_height_m(self) -> float | None:
        """The height where it is given."""
        return None if isnan(self.height_m) else self.height_m

    @property
    def alert_limit(self) -> float | None:
        """The alert limit [m] where there is one."""
        return None if isnan(self.alert_limit_m) else self.alert_limit_m

    @property
    def dim(self) -> int:
        """Dimensions of the position that are estimated."""
        return 3 if isnan(self.height_m) else 2
