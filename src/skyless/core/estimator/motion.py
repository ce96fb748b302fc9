"""A motion sensor as an input of the time update: gyroscope and accelerometer carried by the tag.

The gyroscope turns the accelerometer's specific force into a level frame, whose heading against the site is unknown and
drifts. The integrals of the force since the newest packet, V for velocity and S for position, move the state:

    v ← v + c·V + d·t        p ← p + c·S + d·t²/2

with c = cos ψ + i·sin ψ, x + i·y for vectors, and d for bias and tilt. Both are states, in which all of it is linear:
c begins as 0 ± 0.7, where the sensor has no effect, and finds the heading from the first metres of motion without a
search. What is known of c and d then moves into the attitude, and what returns of them into the gyroscope's bias.
"""

from typing import Final

from skyless.core.estimator.kalman import compute_fault_input, compute_ph, decay, speed_squared, update
from skyless.core.estimator.measurements import add_term
from skyless.core.estimator.state import AXES, Motion, State, at, expect_motion, set_covariance, use_motion
from skyless.core.fix import ORIENTATION, PROTECTED_ROWS
from skyless.core.native.arithmetic import exp, floor, sqrt, square
from skyless.core.native.records import Reals, Ticks
from skyless.core.ticks import NEVER, TICK_RATE_HZ, TICK_S

GRAVITY_MPS2: Final = 9.80665

# Samples


def hear_wheels(s: State, ticks: Ticks, rate_rps: Reals, speed_mps: float) -> bool:
    """Process a speed along x at a tag time, and a rate if no gyroscope gives one. Returns False if it is late."""
    m = s.motion
    if m.speeds > 0 and -s.tuning.longest_silence_s < (ticks - m.speed_ticks) * TICK_S <= 0.0:
        m.late += 1
        return False
    m.speeds += 1
    m.speed_ticks, m.speed_mps = ticks, speed_mps
    if abs(speed_mps) > s.tuning.speed_std_mps:
        m.rest_s = 0.0
    if m.has_force and abs(ticks - m.ticks) * TICK_S <= s.tuning.longest_gap_s:
        return True
    m.up_mps2[0], m.up_mps2[1], m.up_mps2[2] = 0.0, 0.0, GRAVITY_MPS2
    is_used = hear_motion(s, ticks, rate_rps, m.up_mps2)
    m.has_force = False
    return is_used


def hear_motion(s: State, ticks: Ticks, rate_rps: Reals, force_mps2: Reals) -> bool:
    """Process a sample of rate and specific force at a tag time. Returns False if it is late.

    After a gap or a shock, or on another scale of time, level and heading are looked for again.
    """
    m, tuning = s.motion, s.tuning
    dt, m.has_force = (ticks - m.ticks) * TICK_S, True
    if m.samples > 0 and -tuning.longest_silence_s < dt <= 0.0:
        m.late += 1
        return False
    pushed, turning = 0.0, 0.0
    for axis in range(AXES):
        pushed += square(force_mps2[axis])
        turning += square(rate_rps[axis])
    is_shocked = pushed > square(tuning.shock_mps2) or turning > square(tuning.shock_rps)
    if m.samples == 0 or not 0.0 < dt <= tuning.longest_gap_s or is_shocked:
        if m.samples > 0:
            m.gaps += 1
        m.is_level, m.level_s, dt = False, 0.0, 0.0
        for one in range(4):
            m.attitude[one] = 1.0 if one == 0 else 0.0
        for axis in range(AXES):
            m.mean_mps2[axis] = 0.0
    m.samples += 1
    m.ticks = ticks
    _step(m, rate_rps, force_mps2, dt)
    if m.is_level:
        _rest(s, rate_rps, dt)
    else:
        _find_level(s, dt)
    for axis in range(AXES):
        m.rate_rps[axis] = rate_rps[axis]
    return True


def _find_level(s: State, dt: float) -> None:
    """Average the specific force, which on average points upwards, and turn it to z at the end.

    Until then the attitude is against the first sample's.
    """
    m, f, q = s.motion, s.motion.mean_mps2, s.motion.attitude
    for axis in range(AXES):
        f[axis] += m.force_mps2[axis] * dt
    m.level_s += dt
    length = sqrt(square(f[0]) + square(f[1]) + square(f[2]))
    if m.level_s < s.tuning.level_s or length == 0.0:
        return
    # a half turn about the sum of the two directions swaps them; upside down any horizontal axis is right
    w, x, y = length + f[2], f[1], -f[0]
    if w < 1e-6 * length:
        w, x, y = 0.0, 1.0, 0.0
    norm = sqrt(square(w) + square(x) + square(y))
    w, x, y = w / norm, x / norm, y / norm
    m.level[0], m.level[1], m.level[2], m.level[3] = w, x, y, 0.0
    _multiply(q, w, x, y, 0.0, q[0], q[1], q[2], q[3])
    turned(m.force_mps2, m.level, m.force_mps2)
    for axis in range(AXES):
        m.mean_mps2[axis] = GRAVITY_MPS2 if axis == 2 else 0.0
        m.position_m[axis] = m.velocity_mps[axis] = 0.0
    m.is_level, m.rest_s = True, 0.0
    m.used_ticks = NEVER
    if m.has_states:
        expect_motion(s)


def _step(m: Motion, rate_rps: Reals, force_mps2: Reals, dt: float) -> None:
    """Integrate a sample over the time since the one before, by the mean rate and the mean force of both."""
    q, b, half = m.attitude, m.bias_rps, 0.5 * dt
    x, y = 0.5 * (rate_rps[0] + m.rate_rps[0]) - b[0], 0.5 * (rate_rps[1] + m.rate_rps[1]) - b[1]
    z = 0.5 * (rate_rps[2] + m.rate_rps[2]) - b[2]
    x, y, z = x * half, y * half, z * half
    angle2 = square(x) + square(y) + square(z)
    w, scale = 1.0 - 0.5 * angle2, 1.0 - angle2 / 6.0
    _multiply(q, q[0], q[1], q[2], q[3], w, scale * x, scale * y, scale * z)
    x, y, z = m.force_mps2[0], m.force_mps2[1], m.force_mps2[2]
    turned(m.force_mps2, q, force_mps2)
    _push(m, 0, 0.5 * (x + m.force_mps2[0]), dt)
    _push(m, 1, 0.5 * (y + m.force_mps2[1]), dt)
    _push(m, 2, 0.5 * (z + m.force_mps2[2]) - GRAVITY_MPS2, dt)


def _push(m: Motion, axis: int, acceleration_mps2: float, dt: float) -> None:
    """Advance the path along an axis with constant acceleration."""
    m.position_m[axis] += dt * (m.velocity_mps[axis] + 0.5 * dt * acceleration_mps2)
    m.velocity_mps[axis] += dt * acceleration_mps2


def _multiply(to: Reals, a: float, b: float, c: float, d: float, w: float, x: float, y: float, z: float) -> None:
    """Write the product of the quaternions (a, b, c, d) and (w, x, y, z), of unit length."""
    to[0] = a * w - b * x - c * y - d * z
    to[1] = a * x + b * w + c * z - d * y
    to[2] = a * y - b * z + c * w + d * x
    to[3] = a * z + b * y - c * x + d * w
    norm = sqrt(square(to[0]) + square(to[1]) + square(to[2]) + square(to[3]))
    if norm > 0.0:
        for one in range(4):
            to[one] /= norm


def _rest(s: State, rate_rps: Reals, dt: float) -> None:
    """Update the time since the sensor last showed motion, and at rest level and gyroscope's bias."""
    m, tuning, turning, pushed = s.motion, s.tuning, 0.0, 0.0
    for axis in range(AXES):
        change = m.force_mps2[axis] - m.mean_mps2[axis]
        turning += square(rate_rps[axis])
        pushed += square(change)
        m.mean_mps2[axis] += min(dt / tuning.level_s, 1.0) * change
    m.rest_s += dt
    if turning > square(tuning.rest_rps) or pushed > square(tuning.rest_mps2):
        m.rest_s = 0.0
    if m.rest_s > tuning.level_s and speed_squared(s) < square(tuning.rest_mps):
        for axis in range(AXES):
            m.bias_rps[axis] += dt / tuning.tilt_s * (rate_rps[axis] - m.bias_rps[axis])
        share = dt / (tuning.tilt_s * GRAVITY_MPS2)
        _tilt(s, share * m.mean_mps2[1], -share * m.mean_mps2[0])
    elif m.has_force and not (m.has_states and is_heading_known(s)):
        # over a while even a tag in motion is on average not accelerated; later the positions show its level
        share = dt / (tuning.slow_tilt_s * GRAVITY_MPS2)
        x, y = share * m.mean_mps2[1], -share * m.mean_mps2[0]
        _tilt(s, x, y)
        _learn_bias(s, x, y, 0.0)


def _learn_bias(s: State, x: float, y: float, z: float) -> None:
    """Let a turn of the level frame, which the gyroscope's bias has made necessary, reduce that bias."""
    m = s.motion
    m.shown_m[0], m.shown_m[1], m.shown_m[2] = x, y, z
    turned_back(m.shown_mps, m.attitude, m.shown_m)
    for axis in range(AXES):
        m.bias_rps[axis] -= m.shown_mps[axis] / s.tuning.bias_s


def _tilt(s: State, x: float, y: float) -> None:
    """Turn the level frame by small angles about x and y; the acceleration's error becomes what is left of it."""
    m, q, where = s.motion, s.motion.attitude, s.layout
    _multiply(q, 1.0, 0.5 * x, 0.5 * y, 0.0, q[0], q[1], q[2], q[3])
    _tilt_vector(m.force_mps2, x, y)
    _tilt_vector(m.mean_mps2, x, y)
    if m.has_states:
        cos, sin, across, along = s.x[where.heading], s.x[where.heading + 1], y * GRAVITY_MPS2, -x * GRAVITY_MPS2
        s.x[where.acceleration] -= cos * across - sin * along
        s.x[where.acceleration + 1] -= cos * along + sin * across


def _tilt_vector(vector: Reals, x: float, y: float) -> None:
    """Turn a vector by small angles about x and y."""
    a, b, c = vector[0], vector[1], vector[2]
    vector[0], vector[1], vector[2] = a + y * c, b - x * c, c + x * b - y * a


def turned_back(to: Reals, attitude: Reals, vector: Reals) -> None:
    """Write a vector of the level frame in the sensor's."""
    attitude[0] = -attitude[0]
    turned(to, attitude, vector)
    attitude[0] = -attitude[0]


def turned(to: Reals, attitude: Reals, vector: Reals) -> None:
    """Write a vector of the sensor's frame in the level frame: v + 2·w·(u×v) + 2·u×(u×v) of the quaternion (w, u)."""
    w, x, y, z = attitude[0], attitude[1], attitude[2], attitude[3]
    a = 2.0 * (y * vector[2] - z * vector[1])
    b = 2.0 * (z * vector[0] - x * vector[2])
    c = 2.0 * (x * vector[1] - y * vector[0])
    d, e, f = vector[0] + w * a + y * c - z * b, vector[1] + w * b + z * a - x * c, vector[2] + w * c + x * b - y * a
    to[0], to[1], to[2] = d, e, f


# Time update


def look_at_sensor(s: State, rx_ticks: Ticks) -> None:
    """Before ``predict``: see whether the sensor shows the time up to then."""
    m, tuning = s.motion, s.tuning
    ahead_s = (rx_ticks - m.ticks) * TICK_S
    is_ignored = 0 < m.ignored_ticks - rx_ticks < tuning.ignored_s * TICK_RATE_HZ
    m.has_effect = m.is_level and not is_ignored and abs(ahead_s) <= tuning.longest_gap_s
    m.is_used = m.has_effect and m.has_force and m.used_ticks == s.status.epoch_ticks and ahead_s < tuning.short_gap_s


def move(s: State, rx_ticks: Ticks) -> None:
    """Add to ``predict`` what the sensor shows of the time since the newest packet before."""
    m, tuning = s.motion, s.tuning
    if not m.has_effect:
        m.used_ticks = NEVER
        return
    use_motion(s)
    _find_antenna(m)
    ahead = (rx_ticks - m.ticks) * TICK_S
    dt = 0.0 if m.used_ticks == NEVER else (rx_ticks - m.used_ticks) * TICK_S
    for axis in range(AXES):
        a = m.force_mps2[axis] - (GRAVITY_MPS2 if axis == 2 else 0.0)
        m.shown_m[axis] = m.position_m[axis] + m.arm_m[axis] + ahead * (m.velocity_mps[axis] + 0.5 * ahead * a)
        m.shown_mps[axis] = m.velocity_mps[axis] + m.arm_mps[axis] + ahead * a
    for axis in range(AXES):  # the path begins again with the antenna's position and velocity at this packet
        m.velocity_mps[axis] -= m.shown_mps[axis]
        m.position_m[axis] -= m.shown_m[axis] - ahead * m.shown_mps[axis]
    m.used_ticks = rx_ticks
    if dt > 0.0:
        _check_agreement(s, dt)
        if m.has_force:
            _add_path(s, dt)
        _add_drift(s, dt)
        settle_heading(s, dt)
        if m.speeds > 0 and abs(rx_ticks - m.speed_ticks) * TICK_S <= tuning.longest_gap_s:
            _measure_speed(s, dt)


def _check_agreement(s: State, dt: float) -> None:
    """Ignore a sensor for a while if innovations call for much process noise; its heading is then unknown again."""
    m, tuning = s.motion, s.tuning
    is_wrong = s.status.q_scale > tuning.wrong_scale or m.speed_nis > tuning.wrong_speed_nis
    m.wrong_s = m.wrong_s + dt if is_wrong else max(m.wrong_s - dt, 0.0)
    if m.wrong_s > tuning.wrong_s:
        m.wrong_s = m.speed_nis = 0.0
        m.contradictions += 1
        m.ignored_ticks = m.used_ticks + floor(tuning.ignored_s * TICK_RATE_HZ)
        expect_motion(s)


def _find_antenna(m: Motion) -> None:
    """Write position and velocity of the antenna against the sensor, in the level frame."""
    rate, lever = m.rate_rps, m.lever_m
    m.shown_m[0] = rate[1] * lever[2] - rate[2] * lever[1]
    m.shown_m[1] = rate[2] * lever[0] - rate[0] * lever[2]
    m.shown_m[2] = rate[0] * lever[1] - rate[1] * lever[0]
    turned(m.arm_mps, m.attitude, m.shown_m)
    turned(m.arm_m, m.attitude, lever)


def _add_path(s: State, dt: float) -> None:
    """Move position and velocity by the path in ``shown_m`` and ``shown_mps``, by way of heading and acceleration."""
    _add_to(s, 0, s.motion.shown_m, 0.5 * dt * dt)
    _add_to(s, s.layout.velocity, s.motion.shown_mps, dt)


def _add_drift(s: State, dt: float) -> None:
    """Add the process noise of heading and acceleration."""
    where, tuning = s.layout, s.tuning
    is_slow, kept = speed_squared(s) < square(tuning.rest_mps), exp(-dt / tuning.heading_memory_s)
    for state in range(where.heading, where.acceleration):
        s.P[at(state, state)] += square(tuning.heading_walk) * s.status.q_scale * dt
        if is_slow and not is_heading_known(s):  # a sensor's errors at rest look like a heading without effect
            decay(s, state, kept, square(tuning.heading_std))
    for axis in range(s.dim):
        walk = square(tuning.acceleration_walk) * s.status.q_scale * dt * (tuning.vertical_share if axis == 2 else 1.0)
        s.P[at(where.acceleration + axis, where.acceleration + axis)] += walk


def _add_to(s: State, first: int, path: Reals, of_acceleration: float) -> None:
    """Add c·path to the horizontal states from ``first`` on, its third element to the vertical one, and the error d."""
    error = s.layout.acceleration
    add_motion(s, first, path[0], -path[1], error, of_acceleration)
    add_motion(s, first + 1, path[1], path[0], error + 1, of_acceleration)
    if s.dim == AXES:
        add_motion(s, first + 2, 0.0, 0.0, error + 2, of_acceleration)
        s.x[first + 2] += path[2]


def add_motion(s: State, target: int, a: float, b: float, error: int, c: float) -> None:
    """Add a·cos + b·sin + c·error to a state, with covariances and sensitivities."""
    cos, sin = s.layout.heading, s.layout.heading + 1
    s.x[target] += a * s.x[cos] + b * s.x[sin] + c * s.x[error]
    both = a * s.P[at(target, cos)] + b * s.P[at(target, sin)] + c * s.P[at(target, error)]
    own = a * a * s.P[at(cos, cos)] + b * b * s.P[at(sin, sin)] + c * c * s.P[at(error, error)]
    own += 2.0 * (a * b * s.P[at(cos, sin)] + a * c * s.P[at(cos, error)] + b * c * s.P[at(sin, error)])
    for other in range(s.used):
        if other != target:
            added = a * s.P[at(cos, other)] + b * s.P[at(sin, other)] + c * s.P[at(error, other)]
            set_covariance(s, target, other, s.P[at(target, other)] + added)
    s.P[at(target, target)] += 2.0 * both + own
    for fault in range(s.rows):
        s.V[target][fault] += a * s.V[cos][fault] + b * s.V[sin][fault] + c * s.V[error][fault]


# Heading


def is_heading_known(s: State) -> bool:
    """Whether the heading is roughly known, so that its vector is about as long as it should be."""
    length2 = square(s.x[s.layout.heading]) + square(s.x[s.layout.heading + 1])
    return length2 > square(s.tuning.heading_std) and _heading_variance(s) < s.tuning.known_heading_variance


def _heading_variance(s: State) -> float:
    """Variance of the heading [rad²]: of its vector across its direction, over its length."""
    first = s.layout.heading
    cos, sin = s.x[first], s.x[first + 1]
    across = cos * cos * s.P[at(first + 1, first + 1)] + sin * sin * s.P[at(first, first)]
    return (across - 2.0 * cos * sin * s.P[at(first, first + 1)]) / max(square(cos * cos + sin * sin), 1e-12)


def heading_std_rad(s: State) -> float:
    """Standard deviation of the heading; negative until it is known to five degrees."""
    if not s.motion.has_effect or not is_heading_known(s):
        return -1.0
    variance = _heading_variance(s)
    return sqrt(variance) if variance < s.tuning.sure_heading_variance else -1.0


def fill_orientation(s: State) -> None:
    """Fill the rows of a fix with the rotation from the sensor's frame to the site's, if its heading is known."""
    m, q, std_rad = s.motion, s.motion.attitude, heading_std_rad(s)
    for row in range(ORIENTATION, PROTECTED_ROWS):
        for axis in range(AXES):
            s.fix[row][axis] = 0.0
    if std_rad >= 0.0:
        cos, sin = s.x[s.layout.heading], s.x[s.layout.heading + 1]
        length = sqrt(square(cos) + square(sin))
        half = sqrt(max(0.5 + 0.5 * cos / length, 1e-12))
        _multiply(m.level, half, 0.0, 0.0, 0.5 * sin / (half * length), q[0], q[1], q[2], q[3])
        for one in range(4):
            row, axis = ORIENTATION + one // AXES, one % AXES
            s.fix[row][axis] = m.level[one]
        s.fix[ORIENTATION + 1][1] = std_rad


def settle_heading(s: State, dt: float) -> None:
    """Turn the level frame into the site's, once the heading is roughly known."""
    if not is_heading_known(s):
        return
    m, tuning, where, q = s.motion, s.tuning, s.layout, s.motion.attitude
    cos, sin, share = where.heading, where.heading + 1, min(dt / tuning.tilt_s, 1.0)
    length = sqrt(square(s.x[cos]) + square(s.x[sin]))
    # what has been learnt of tilt and heading moves into the attitude, and what had to move into the bias
    c, d = s.x[cos], s.x[sin]
    x = -share * (c * s.x[where.acceleration + 1] - d * s.x[where.acceleration]) / GRAVITY_MPS2
    y = share * (c * s.x[where.acceleration] + d * s.x[where.acceleration + 1]) / GRAVITY_MPS2
    if m.has_force:
        _tilt(s, x, y)
    if c < 0.5 * length:  # at once
        share = 1.0
    c, d = 1.0 - share + share * c / length, share * d / length
    length = sqrt(square(c) + square(d))
    c, d = c / length, d / length
    turn_states(s, cos, sin, c, d)
    half = sqrt(max(0.5 + 0.5 * c, 1e-12))
    _multiply(q, half, 0.0, 0.0, 0.5 * d / half, q[0], q[1], q[2], q[3])
    _turn_vector(m.force_mps2, c, d)
    _turn_vector(m.mean_mps2, c, d)
    if share < 1.0 and _heading_variance(s) < tuning.sure_heading_variance:
        _learn_bias(s, x, y, d)


def _turn_vector(vector: Reals, cos: float, sin: float) -> None:
    """Turn a vector about z."""
    a, b = vector[0], vector[1]
    vector[0], vector[1] = cos * a - sin * b, sin * a + cos * b


def turn_states(s: State, one: int, other: int, cos: float, sin: float) -> None:
    """Turn two states back by an angle, with covariances and sensitivities."""
    a, b = s.x[one], s.x[other]
    s.x[one], s.x[other] = cos * a + sin * b, cos * b - sin * a
    for fault in range(s.rows):
        a, b = s.V[one][fault], s.V[other][fault]
        s.V[one][fault], s.V[other][fault] = cos * a + sin * b, cos * b - sin * a
    first, both, second = s.P[at(one, one)], s.P[at(one, other)], s.P[at(other, other)]
    for state in range(s.used):
        a, b = s.P[at(one, state)], s.P[at(other, state)]
        set_covariance(s, one, state, cos * a + sin * b)
        set_covariance(s, other, state, cos * b - sin * a)
    s.P[at(one, one)] = cos * cos * first + 2.0 * cos * sin * both + sin * sin * second
    s.P[at(other, other)] = cos * cos * second - 2.0 * cos * sin * both + sin * sin * first
    set_covariance(s, one, other, (cos * cos - sin * sin) * both + cos * sin * (second - first))


# Wheels

_MOST_NIS: Final = 100.0
"""One speed counts for no more than this in the mean."""


def _measure_speed(s: State, dt: float) -> None:
    """Measure v − c·u as 0, with the velocity u of the antenna in the level frame that wheels and turning show.

    Their errors last, so that a second of speeds counts as one.
    """
    m, tuning = s.motion, s.tuning
    cos, sin, velocity = s.layout.heading, s.layout.heading + 1, s.layout.velocity
    m.shown_m[0], m.shown_m[1], m.shown_m[2] = m.speed_mps, 0.0, 0.0
    turned(m.shown_mps, m.attitude, m.shown_m)
    x, y = m.shown_mps[0] + m.arm_mps[0], m.shown_mps[1] + m.arm_mps[1]
    noise = (square(tuning.speed_std_mps) + square(tuning.speed_share * m.speed_mps)) * max(1.0 / dt, 1.0)
    for axis in range(2):
        of_cos, of_sin = x, -y
        if axis == 1:
            of_cos, of_sin = y, x
        s.terms = 0
        add_term(s, velocity + axis, 1.0)
        add_term(s, cos, -of_cos)
        add_term(s, sin, -of_sin)
        innovation = s.x[cos] * of_cos + s.x[sin] * of_sin - s.x[velocity + axis]
        predicted = compute_ph(s)
        nis = min(square(innovation) / (predicted + noise), _MOST_NIS)
        m.speed_nis += min(dt, 1.0) * (nis - m.speed_nis)
        variance = predicted + noise * s.status.q_scale
        if innovation * innovation < square(tuning.suspect) * variance:
            compute_fault_input(s, -1)
            update(s, innovation, variance)
