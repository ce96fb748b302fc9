/* Made by tools/make_core.py from these modules; do not edit.

 * skyless.core.native.arithmetic
 * skyless.research.benchmark
 * skyless.sim.impairments
 * skyless.sim.listening
 * skyless.sim.oscillator
 * skyless.sim.streams
 * skyless.site.channel
 * skyless.site.planning.links
 * skyless.site.planning.optimise
 * skyless.site.planning.rates
 */

#include "skyless_kernels.h"

#include <math.h>

#ifndef INTERNAL
#define INTERNAL static
#endif

#ifdef SKYLESS_SOURCE_DIGEST
SKYLESS_EXPORT extern const char *const skyless_source_digest;
const char *const skyless_source_digest = SKYLESS_SOURCE_DIGEST;
#endif

#ifdef SKYLESS_FLOAT
#define SQRT(x) __builtin_sqrtf(x)
#define FABS(x) __builtin_fabsf(x)
#else
#define SQRT(x) __builtin_sqrt(x)
#define FABS(x) __builtin_fabs(x)
#endif

static inline real min_real(real one, real other) { return other < one ? other : one; }
static inline real max_real(real one, real other) { return other > one ? other : one; }
static inline int32_t min_32(int32_t one, int32_t other) { return other < one ? other : one; }
static inline int32_t max_32(int32_t one, int32_t other) { return other > one ? other : one; }
static inline int64_t min_64(int64_t one, int64_t other) { return other < one ? other : one; }
static inline int64_t max_64(int64_t one, int64_t other) { return other > one ? other : one; }
static inline real abs_real(real x) { return FABS(x); }
static inline int32_t abs_32(int32_t x) { return x < 0 ? -x : x; }
static inline int64_t abs_64(int64_t x) { return x < 0 ? -x : x; }
#ifdef SKYLESS_FLOAT
/* By two exact halves: a Cortex-M4F has no instruction for 64 bits, and its compiler's function uses double. */
static inline int64_t whole_of(real x) {
    const int32_t high = (int32_t)(x * (1 / REAL(4294967296.0)));
    const real low = x - (real)high * REAL(4294967296.0);
    return high * INT64_C(4294967296) + (low < 0 ? -(int64_t)(uint32_t)-low : (int64_t)(uint32_t)low);
}
#else
static inline int64_t whole_of(real x) { return (int64_t)x; }
#endif
static inline int64_t truncated(real x) { return REAL(-9e18) < x && x < REAL(9e18) ? whole_of(x) : 0; }
static inline int64_t floor_real(real x) {
    const int64_t found = truncated(x);
    return x > REAL(-9e18) && x < (real)found ? found - 1 : found;
}
static inline int32_t floor_div_32(int32_t x, int32_t y) { return x / y - (x % y != 0 && (x < 0) != (y < 0)); }
static inline int64_t floor_div_64(int64_t x, int64_t y) { return x / y - (x % y != 0 && (x < 0) != (y < 0)); }
static inline int32_t floor_mod_32(int32_t x, int32_t y) { return x - y * floor_div_32(x, y); }
static inline int64_t floor_mod_64(int64_t x, int64_t y) { return x - y * floor_div_64(x, y); }

typedef struct { real item_0; real item_1; } cross_walls_results;

INTERNAL real hypot_(real x, real y);
INTERNAL real square(real x);
INTERNAL bool factorise(real *A, int32_t size);
INTERNAL void solve_lower(real *L, int32_t size, real *x);
INTERNAL void solve(real *L, int32_t size, real *x);
INTERNAL void predict_plain(PlainTrack *t, real dt_s);
INTERNAL real find_variance(PlainTrack *t, real std_m);
INTERNAL void note_innovation(PlainTrack *t, real innovation, real std_m, real dt_s);
INTERNAL real draw_normal(Noise *n);
INTERNAL real draw_uniform(Noise *n);
INTERNAL real clock_rate(Clock *clock);
INTERNAL real temperature_phase_s(Clock *clock, real from_s, real to_s);
INTERNAL real drift_phase_s(Clock *clock, real from_s, real to_s);
INTERNAL bool cross_wall(Barrier *b, real x1_m, real y1_m, real z1_m, real x2_m, real y2_m, real z2_m);
INTERNAL cross_walls_results cross_walls(Barrier *barriers, int32_t count, real x1_m, real y1_m, real z1_m, real x2_m,
        real y2_m, real z2_m);
INTERNAL real received_power_dbm(real tx_power_dbm, real distance_m, real loss_db);
INTERNAL real power_bias_m(real rx_power_dbm, real *table_m);
INTERNAL real first_path_loss_db(real extra_m);
INTERNAL real delivery_probability(real rx_power_dbm, real sensitivity_dbm, real width_db);
INTERNAL real slope_error_m(real slope_m, real distance_m);
INTERNAL real coordinate_m(Station *s, int32_t axis, real t_s);
INTERNAL real velocity_mps(Station *s, int32_t axis, real t_s);
INTERNAL real body_delay_m(Station *sender, Station *listener, real t_s);
INTERNAL void find_link(OneFrame *f, Station *stations, ChannelModel *channel, Barrier *barriers, int32_t sender,
        int32_t listener, real t_s, Link *way);
INTERNAL int32_t overlap_outcome(OneFrame *f, Station *stations, ChannelModel *channel, Barrier *barriers, Other
        *others, int32_t listener, real t_s, Link *way);
INTERNAL int32_t reception_outcome(ChannelModel *channel, Noise *noise, real power_dbm);
INTERNAL real extra_path_m(bool is_tag, ChannelModel *channel, Noise *noise, real bias_m);
INTERNAL int64_t stamp(Clock *clock, Noise *noise, real rx_noise_ticks, int64_t emission_ticks, real arrival_ticks, real
        error_ticks);
INTERNAL void measure(Clock *sender, Clock *own, ChannelModel *channel, Noise *noise, Link *way, Row *row);

/* Arithmetic that is also translated to C, with the same bits on every processor: functions, small matrices, tails. */

/* Length of a vector, without protection against overflow of the squares. */
INTERNAL real hypot_(real x, real y) {
    return SQRT(x * x + y * y);
}

/* x². */
INTERNAL real square(real x) {
    return x * x;
}

/* Cholesky's method */

/* Replace A by its lower Cholesky factor L, L·Lᵀ = A.
 *
 * Returns False, with undefined elements, if A is not positive definite, singular or not finite. */
INTERNAL bool factorise(real *A, int32_t size) {
    for (int32_t i = 0; i < size; i++) {
        int32_t row = floor_div_32(i * (i + 1), 2);
        real diagonal = A[row + i];
        for (int32_t j = 0; j < i + 1; j++) {
            int32_t other = floor_div_32(j * (j + 1), 2);
            real total = A[row + j];
            for (int32_t k = 0; k < j; k++) {
                total -= A[row + k] * A[other + k];
            }
            if (j < i) {
                A[row + j] = total / A[other + j];
            } else if (total > SINGULAR_PIVOT * diagonal && diagonal > REAL(0.0)) {
                A[row + j] = SQRT(total);
            } else {
                return false;
            }
        }
    }
    return true;
}

/* Replace x by L⁻¹·x. */
INTERNAL void solve_lower(real *L, int32_t size, real *x) {
    for (int32_t i = 0; i < size; i++) {
        int32_t row = floor_div_32(i * (i + 1), 2);
        real total = x[i];
        for (int32_t k = 0; k < i; k++) {
            total -= L[row + k] * x[k];
        }
        x[i] = total / L[row + i];
    }
}

/* Replace x by (L·Lᵀ)⁻¹·x. */
INTERNAL void solve(real *L, int32_t size, real *x) {
    solve_lower(L, size, x);
    for (int32_t i = size - 1; i > -1; i--) {
        real total = x[i];
        for (int32_t k = i + 1; k < size; k++) {
            total -= L[floor_div_32(k * (k + 1), 2) + i] * x[k];
        }
        x[i] = total / L[floor_div_32(i * (i + 1), 2) + i];
    }
}

/* ``skyless benchmark``: every method on every recording below a folder, judged, as a table and a page. */

/* errors of more than two and a half standard deviations; it opens again when the sum is nearly empty. */

/* Run the filter over differences; ``places_m``: of each, the first anchor's position and the second's. */
SKYLESS_EXPORT void skyless_run_plain(PlainTrack *t, int32_t rule, real std_m, real *times_s, real *tdoas_m, real
        *places_m, int32_t count, real *positions_m, real *covariances_m2) {
    bool used = 0;
    real *x = t->x;
    real (*P)[6] = t->P;
    for (int32_t n = 0; n < count; n++) {
        real dt_s = times_s[n] - t->time_s;
        t->time_s = times_s[n];
        predict_plain(t, dt_s);
        real range_a = REAL(0.0);
        real range_b = REAL(0.0);
        real apart_m = REAL(0.0);
        for (int32_t i = 0; i < 3; i++) {
            range_a += square(x[i] - places_m[6 * n + i]);
            range_b += square(x[i] - places_m[6 * n + 3 + i]);
            apart_m += square(places_m[6 * n + 3 + i] - places_m[6 * n + i]);
        }
        range_a = SQRT(range_a);
        range_b = SQRT(range_b);
        for (int32_t i = 0; i < 3; i++) {
            t->H[i] = (x[i] - places_m[6 * n + 3 + i]) / range_b - (x[i] - places_m[6 * n + i]) / range_a;
        }
        real innovation = tdoas_m[n] - (range_b - range_a);
        real S = find_variance(t, std_m);
        if (rule == GATE) {
            used = innovation * innovation <= GATE_STD * GATE_STD * S;
        } else if (abs_real(tdoas_m[n]) >= SQRT(apart_m)) {
            used = false;
        } else {
            used = t->is_open || abs_real(innovation) < ACCEPTED_STD * std_m;
            note_innovation(t, innovation, std_m, dt_s);
        }
        if (used) {
            for (int32_t i = 0; i < 6; i++) {
                x[i] += t->PH[i] * (innovation / S);
                for (int32_t j = 0; j < 6; j++) {
                    P[i][j] -= t->PH[i] * t->PH[j] / S;
                }
            }
        }
        for (int32_t i = 0; i < 3; i++) {
            positions_m[3 * n + i] = x[i];
            for (int32_t j = 0; j < 3; j++) {
                covariances_m2[9 * n + 3 * i + j] = P[i][j];
            }
        }
    }
}

/* Predict the state: x = F·x and P = F·P·Fᵀ + Q. */
INTERNAL void predict_plain(PlainTrack *t, real dt_s) {
    real *x = t->x;
    real (*P)[6] = t->P;
    for (int32_t i = 0; i < 3; i++) {
        x[i] += dt_s * x[i + 3];
        for (int32_t j = 0; j < 6; j++) {
            P[i][j] += dt_s * P[i + 3][j];
        }
    }
    for (int32_t i = 0; i < 3; i++) {
        for (int32_t j = 0; j < 6; j++) {
            P[j][i] += dt_s * P[j][i + 3];
        }
    }
    for (int32_t i = 0; i < 3; i++) {
        P[i][i] += t->qa[i] * dt_s * dt_s * dt_s / REAL(3.0);
        P[i][i + 3] += t->qa[i] * dt_s * dt_s / REAL(2.0);
        P[i + 3][i] += t->qa[i] * dt_s * dt_s / REAL(2.0);
        P[i + 3][i + 3] += t->qa[i] * dt_s;
    }
}

/* Compute P·Hᵀ. Returns the innovation's variance S = H·P·Hᵀ + R. */
INTERNAL real find_variance(PlainTrack *t, real std_m) {
    real S = std_m * std_m;
    for (int32_t i = 0; i < 6; i++) {
        t->PH[i] = t->P[i][0] * t->H[0] + t->P[i][1] * t->H[1] + t->P[i][2] * t->H[2];
    }
    for (int32_t i = 0; i < 3; i++) {
        S += t->H[i] * t->PH[i];
    }
    return S;
}

/* Open or close the filter by Bitcraze's rule. */
INTERNAL void note_innovation(PlainTrack *t, real innovation, real std_m, real dt_s) {
    real added_s = min_real(dt_s, LONGEST_ADDED_S);
    if (abs_real(innovation) < TRUSTED_STD * std_m) {
        t->good_s = min_real(t->good_s + added_s, SUM_S);
    } else {
        t->good_s = max_real(t->good_s - added_s, REAL(0.0));
    }
    t->is_open = t->is_open ? t->good_s <= CLOSES * SUM_S : t->good_s < OPENS * SUM_S;
}

/* Random numbers for many nodes: every node draws from its own stream.
 *
 * A node's stream depends only on the seed and the node's own key, so that another tag or anchor does not change what
 * others draw. */

/* Next standard normal of a node. */
INTERNAL real draw_normal(Noise *n) {
    real value = n->normals[n->used];
    n->used += 1;
    return value;
}

/* Next uniform number of a node in (0, 1): a normal mapped by its distribution function. */
INTERNAL real draw_uniform(Noise *n) {
    return REAL(0.5) * erfc(-draw_normal(n) / SQRT(REAL(2.0)));
}

/* Crystal oscillators and the 40-bit counters driven by them.
 *
 * A node's state is its counter's value at one instant of true time. Both are a whole number of ticks and a fraction: true
 * time counts ideal ticks from the start of the world; the counter is kept unwrapped, so that no precision is lost over
 * months (``docs/maths.md`` section 3).
 *
 * The noise is the two-state model, sampled exactly between any two instants dt apart: phase and fractional frequency gain
 * a normal pair of covariance [[q_w dt + q_rw dt³/3, q_rw dt²/2], [q_rw dt²/2, q_rw dt]], with q_w = white_fm² and q_rw =
 * random_walk_fm². Allan deviation: σ_y(τ)² = q_w/τ + q_rw τ/3. */

/* Fractional frequency of a counter at its last instant, temperature included, dimensionless. */
INTERNAL real clock_rate(Clock *clock) {
    real rate = clock->rate;
    if (clock->per_kelvin != REAL(0.0)) {
        real t_s = (real)clock->true_ticks * TICK_S;
        real warm_up_k = clock->warm_up_k * (REAL(1.0) - exp(-t_s / clock->warm_up_s));
        real swing_k = clock->swing_k * sin(clock->swing_rad_per_s * t_s + clock->swing_phase_rad);
        rate += clock->per_kelvin * (warm_up_k + swing_k);
    }
    if (clock->drift != REAL(0.0)) {
        real since_s = max_real((real)clock->true_ticks * TICK_S - clock->drift_start_s, REAL(0.0));
        rate += clock->drift * (REAL(1.0) - exp(-since_s / clock->drift_tau_s));
    }
    return rate;
}

/* Phase in seconds added by temperature between two true times: the closed-form integral of its rate. */
INTERNAL real temperature_phase_s(Clock *clock, real from_s, real to_s) {
    real tau_s = clock->warm_up_s;
    real warmed = to_s - from_s + tau_s * (exp(-to_s / tau_s) - exp(-from_s / tau_s));
    real swing = REAL(0.0);
    real omega = clock->swing_rad_per_s;
    real phase = clock->swing_phase_rad;
    if (omega != REAL(0.0)) {
        swing = (cos(omega * from_s + phase) - cos(omega * to_s + phase)) / omega;
    }
    return clock->per_kelvin * (clock->warm_up_k * warmed + clock->swing_k * swing);
}

/* Phase in seconds added by a warm-up between two true times: the closed-form integral of its rate. */
INTERNAL real drift_phase_s(Clock *clock, real from_s, real to_s) {
    real start_s = clock->drift_start_s;
    real tau_s = clock->drift_tau_s;
    real since_s = max_real(from_s - start_s, REAL(0.0));
    real until_s = max_real(to_s - start_s, REAL(0.0));
    real warmed_s = until_s - since_s;
    real bent_s = tau_s * exp(-since_s / tau_s) * expm1(-warmed_s / tau_s);
    return clock->drift * (warmed_s + bent_s);
}

/* Advance a counter to a true time, drawing two normals for the noise of the interval.
 *
 * A step backwards by at most a flight time (two frames in flight at once) is extrapolated without noise. */
SKYLESS_EXPORT void skyless_advance(Clock *clock, Noise *noise, int64_t true_ticks, real true_fraction) {
    int64_t whole = true_ticks - clock->true_ticks;
    real part = true_fraction - clock->true_fraction;
    real gain = clock->rate * ((real)whole + part);
    real dt_s = ((real)whole + part) * TICK_S;
    real from_s = (real)clock->true_ticks * TICK_S;
    if (clock->per_kelvin != REAL(0.0)) {
        gain += temperature_phase_s(clock, from_s, from_s + dt_s) * TICK_RATE_HZ;
    }
    if (clock->drift != REAL(0.0)) {
        gain += drift_phase_s(clock, from_s, from_s + dt_s) * TICK_RATE_HZ;
    }
    if (dt_s > REAL(0.0)) {
        real white = clock->white_fm;
        real walk = clock->random_walk_fm;
        real rate_gain = walk * SQRT(dt_s) * draw_normal(noise);
        real own_std_s = SQRT(dt_s * (white * white + walk * walk * dt_s * dt_s / REAL(12.0)));
        gain += (REAL(0.5) * rate_gain * dt_s + own_std_s * draw_normal(noise)) * TICK_RATE_HZ;
        clock->rate += rate_gain;
    }
    real fraction = clock->local_fraction + part + gain;
    int64_t carry = floor_real(fraction);
    clock->local_ticks += whole + carry;
    clock->local_fraction = fraction - (real)carry;
    clock->true_ticks = true_ticks;
    clock->true_fraction = true_fraction;
}

/* True time, in whole ticks, at which an unwrapped counter will show a value if its rate stays. */
SKYLESS_EXPORT int64_t skyless_foresee(Clock *clock, int64_t local_ticks) {
    real ahead = (real)(local_ticks - clock->local_ticks) / (REAL(1.0) + clock_rate(clock));
    return clock->true_ticks + floor_real(ahead);
}

/* Advance a counter to the instant at which it shows a value. Returns when its frame really leaves.
 *
 * The instant is predicted, the oscillator's noise sampled up to there, and the remaining error removed to first
 * order. The result is in ticks from the clock's ``true_ticks``: the instant's fraction, the antenna delay error
 * ``tx_error_ticks``, and emission noise of standard deviation ``tx_noise_ticks``. */
SKYLESS_EXPORT real skyless_emit(Clock *clock, Noise *noise, int64_t local_ticks, real tx_noise_ticks, real
        tx_error_ticks) {
    int64_t forecast = skyless_foresee(clock, local_ticks);
    skyless_advance(clock, noise, forecast, REAL(0.0));
    real error = (real)(clock->local_ticks - local_ticks) + clock->local_fraction;
    real instant = -error / (REAL(1.0) + clock_rate(clock));
    int64_t shift = floor_real(instant);
    clock->true_ticks += shift;
    clock->true_fraction = instant - (real)shift;
    clock->local_ticks = local_ticks;
    clock->local_fraction = REAL(0.0);
    real fraction = clock->true_fraction + tx_error_ticks;
    return fraction + tx_noise_ticks * draw_normal(noise);
}

/* Channel model for a frame between two antennas: flight, walls, power, and the errors of the stamp.
 *
 * Powers follow free space at channel 5. A DW1000 at the regulatory limit sends -41.3 dBm/MHz over 499.2 MHz, -14.3 dBm in
 * total; at 5 m this arrives with -77.0 dBm, where APS011's range bias crosses zero. */

/* Whether the straight line from one point to another crosses a wall or slab. */
INTERNAL bool cross_wall(Barrier *b, real x1_m, real y1_m, real z1_m, real x2_m, real y2_m, real z2_m) {
    if (b->is_slab) {
        return (z1_m < b->low_m) != (z2_m < b->low_m);
    }
    real side_1 = (x2_m - x1_m) * (b->y1_m - y1_m) - (y2_m - y1_m) * (b->x1_m - x1_m);
    real side_2 = (x2_m - x1_m) * (b->y2_m - y1_m) - (y2_m - y1_m) * (b->x2_m - x1_m);
    real side_a = (b->x2_m - b->x1_m) * (y1_m - b->y1_m) - (b->y2_m - b->y1_m) * (x1_m - b->x1_m);
    real side_b = (b->x2_m - b->x1_m) * (y2_m - b->y1_m) - (b->y2_m - b->y1_m) * (x2_m - b->x1_m);
    return side_1 * side_2 < REAL(0.0) && side_a * side_b < REAL(0.0);
}

/* Total loss in dB and delay in metres of the barriers that the straight line from one point to another crosses. */
INTERNAL cross_walls_results cross_walls(Barrier *barriers, int32_t count, real x1_m, real y1_m, real z1_m, real x2_m,
        real y2_m, real z2_m) {
    real loss_db = REAL(0.0);
    real delay_m = REAL(0.0);
    for (int32_t index_ = 0; index_ < count; index_++) {
        Barrier *b = &barriers[index_];
        if (cross_wall(b, x1_m, y1_m, z1_m, x2_m, y2_m, z2_m)) {
            loss_db += b->loss_db;
            delay_m += b->delay_m;
        }
    }
    return (cross_walls_results){loss_db, delay_m};
}

/* Received power after free space and walls; distances below 1 cm count as 1 cm. */
INTERNAL real received_power_dbm(real tx_power_dbm, real distance_m, real loss_db) {
    return tx_power_dbm - FREE_SPACE_LOSS_1_M_DB - REAL(20.0) * log10(max_real(distance_m, REAL(0.01))) - loss_db;
}

/* Range bias of an RX stamp (APS011 in docs/radio.md), linearly interpolated and held beyond the ends. */
INTERNAL real power_bias_m(real rx_power_dbm, real *table_m) {
    real position = (POWER_BIAS_FIRST_DBM - rx_power_dbm) / POWER_BIAS_STEP_DB;
    position = min_real(max_real(position, REAL(0.0)), (real)POWER_BIASES - REAL(1.0));
    int64_t low = min_64(floor_real(position), POWER_BIASES - 2);
    return table_m[low] + (position - (real)low) * (table_m[low + 1] - table_m[low]);
}

/* First path's power below the total power, for a message that is ``extra_m`` late. */
INTERNAL real first_path_loss_db(real extra_m) {
    real late = REAL(1.0) - exp(-max_real(extra_m, REAL(0.0)) / FIRST_PATH_SCALE_M);
    return LINE_OF_SIGHT_FIRST_PATH_DB + BLOCKED_FIRST_PATH_DB * late;
}

/* Probability of receiving a frame: logistic in the power, 1/2 at the sensitivity. */
INTERNAL real delivery_probability(real rx_power_dbm, real sensitivity_dbm, real width_db) {
    return REAL(1.0) / (REAL(1.0) + exp(min_real((sensitivity_dbm - rx_power_dbm) / width_db, REAL(700.0))));
}

/* Everything in a world that is not ideal: crystals, channel, range errors, carrier phases, faults. */

/* processes (exponential correlation) along time or along the path of a tag, drawn at knots and interpolated. */

/* Range error that depends on the true distance (``RangeErrorModel.slope_m``). */
INTERNAL real slope_error_m(real slope_m, real distance_m) {
    return slope_m * min_real(max_real((distance_m - SLOPE_MIDDLE_M) / SLOPE_MIDDLE_M, -REAL(1.0)), REAL(1.0));
}

/* Which nodes receive a frame, with which stamp, and why others do not: one compiled step over all nodes.
 *
 * A sending node receives nothing (half duplex). Frames that overlap at a listener destroy each other unless one is
 * stronger than every other by the capture margin. Not modelled: real receivers that locked on the weaker one first lose
 * both. */

/* Positions, motion and radio noise of a world's nodes, as records for the kernels. */

/* One coordinate of a node at a true time. */
INTERNAL real coordinate_m(Station *s, int32_t axis, real t_s) {
    real dt_s = t_s - s->origin_s;
    real turned = s->velocity_mps[axis] + REAL(0.5) * dt_s * s->acceleration_mps2[axis];
    return s->position_m[axis] + dt_s * turned;
}

/* One component of a node's velocity at a true time. */
INTERNAL real velocity_mps(Station *s, int32_t axis, real t_s) {
    return s->velocity_mps[axis] + (t_s - s->origin_s) * s->acceleration_mps2[axis];
}

/* Delay of a sender's messages through the body that carries a listener, 0 if it is not in between. */
INTERNAL real body_delay_m(Station *sender, Station *listener, real t_s) {
    if (listener->body_m == REAL(0.0)) {
        return REAL(0.0);
    }
    real east_m = coordinate_m(sender, 0, t_s) - coordinate_m(listener, 0, t_s);
    real north_m = coordinate_m(sender, 1, t_s) - coordinate_m(listener, 1, t_s);
    real heading = atan2(velocity_mps(listener, 1, t_s), velocity_mps(listener, 0, t_s));
    real towards = heading + listener->body_direction_rad;
    real along_m = east_m * cos(towards) + north_m * sin(towards);
    return along_m >= listener->body_cosine * hypot_(east_m, north_m) ? listener->body_m : REAL(0.0);
}

/* Find the way between two nodes at a true time. */
INTERNAL void find_link(OneFrame *f, Station *stations, ChannelModel *channel, Barrier *barriers, int32_t sender,
        int32_t listener, real t_s, Link *way) {
    Station *one = &stations[sender];
    Station *other = &stations[listener];
    real squared_m2 = REAL(0.0);
    real product = REAL(0.0);
    for (int32_t axis = 0; axis < 3; axis++) {
        real step_m = coordinate_m(other, axis, t_s) - coordinate_m(one, axis, t_s);
        squared_m2 += step_m * step_m;
        product += step_m * (velocity_mps(other, axis, t_s) - velocity_mps(one, axis, t_s));
    }
    way->distance_m = SQRT(squared_m2);
    real loss_db = REAL(0.0);
    real delay_m = REAL(0.0);
    if (f->barriers > 0) {
        const cross_walls_results results_1 = cross_walls(barriers, f->barriers, coordinate_m(one, 0, t_s),
                coordinate_m(one, 1, t_s), coordinate_m(one, 2, t_s), coordinate_m(other, 0, t_s), coordinate_m(other,
                1, t_s), coordinate_m(other, 2, t_s));
        loss_db = results_1.item_0;
        delay_m = results_1.item_1;
        if (!other->is_tag && !channel->walls_between_anchors) {
            delay_m = REAL(0.0);
        }
    }
    way->delay_m = delay_m;
    way->power_dbm = received_power_dbm(channel->tx_power_dbm, way->distance_m, loss_db);
    way->range_rate_mps = product / max_real(way->distance_m, REAL(1e-09));
}

/* Outcome at a listener of overlapping frames: heard, half duplex or collision. */
INTERNAL int32_t overlap_outcome(OneFrame *f, Station *stations, ChannelModel *channel, Barrier *barriers, Other
        *others, int32_t listener, real t_s, Link *way) {
    real flight_s = (way->distance_m + way->delay_m) / SPEED_OF_LIGHT_MPS;
    real begin_s = f->begin_s + flight_s;
    real end_s = f->end_s + flight_s;
    Link its = {0};
    int32_t outcome = HEARD;
    for (int32_t index_ = 0, index__end = f->others; index_ < index__end; index_++) {
        Other *other = &others[index_];
        if (other->sender == listener) {
            if (other->begin_s < end_s && other->end_s > begin_s) {
                return HALF_DUPLEX;
            }
            continue;
        }
        find_link(f, stations, channel, barriers, other->sender, listener, t_s, &its);
        flight_s = (its.distance_m + its.delay_m) / SPEED_OF_LIGHT_MPS;
        bool overlaps = other->begin_s + flight_s < end_s && other->end_s + flight_s > begin_s;
        if (overlaps && way->power_dbm - its.power_dbm < channel->capture_db) {
            outcome = COLLISION;
        }
    }
    return outcome;
}

/* Outcome at a listener by power and chance: heard, weak or lost. Draws only if chance decides. */
INTERNAL int32_t reception_outcome(ChannelModel *channel, Noise *noise, real power_dbm) {
    real margin = (power_dbm - channel->sensitivity_dbm) / channel->sensitivity_width_db;
    if (margin < -REAL(30.0)) {
        return WEAK;
    }
    if (margin < REAL(30.0)) {
        real probability = delivery_probability(power_dbm, channel->sensitivity_dbm, channel->sensitivity_width_db);
        real drawn = draw_uniform(noise);
        if (drawn > probability) {
            return WEAK;
        }
    }
    if (channel->loss_probability > REAL(0.0)) {
        real drawn = draw_uniform(noise);
        if (drawn < channel->loss_probability) {
            return LOST;
        }
    }
    return HEARD;
}

/* Extra path of a message: the sender's present bias (tags only) and, by chance, an exponential delay. */
INTERNAL real extra_path_m(bool is_tag, ChannelModel *channel, Noise *noise, real bias_m) {
    real extra_m = is_tag ? bias_m : REAL(0.0);
    if ((is_tag || channel->nlos_between_anchors) && channel->nlos_probability > REAL(0.0)) {
        real drawn = draw_uniform(noise);
        if (drawn < channel->nlos_probability) {
            drawn = draw_uniform(noise);
            extra_m -= channel->nlos_mean_m * log(drawn);
        }
    }
    return extra_m;
}

/* RX stamp of a node, rounded to ticks; ``arrival_ticks`` counts from ``emission_ticks``. */
INTERNAL int64_t stamp(Clock *clock, Noise *noise, real rx_noise_ticks, int64_t emission_ticks, real arrival_ticks, real
        error_ticks) {
    int64_t carry = floor_real(arrival_ticks);
    skyless_advance(clock, noise, emission_ticks + carry, arrival_ticks - (real)carry);
    real noise_ticks = rx_noise_ticks * draw_normal(noise);
    real fraction = clock->local_fraction + error_ticks + noise_ticks;
    return (clock->local_ticks + floor_real(fraction + REAL(0.5))) & TICK_MASK;
}

/* Fill in the diagnostics of a reception. */
INTERNAL void measure(Clock *sender, Clock *own, ChannelModel *channel, Noise *noise, Link *way, Row *row) {
    row->rx_power_dbm = way->power_dbm + channel->power_noise_db * draw_normal(noise);
    row->first_path_power_dbm = row->rx_power_dbm - first_path_loss_db(row->extra_m);
    real offset = clock_rate(sender) - clock_rate(own) - way->range_rate_mps / SPEED_OF_LIGHT_MPS;
    real noise_ppm = channel->carrier_noise_ppm * draw_normal(noise);
    row->carrier_offset_ppm = REAL(1000000.0) * offset + noise_ppm;
}

/* Deliver one frame to every node that is on, or lose it.
 *
 * ``power_biases_m``: those of stamps, as ``power_bias_m`` takes them. ``range_errors_m``: node by node those of all
 * anchors, infinite if the sender does not reach the listener. Fills ``heard``, one row for each node that received
 * the frame, and counts into ``tally``, for anchors and then for tags each outcome. */
SKYLESS_EXPORT void skyless_receive_frame(OneFrame *f, Clock *clocks, Noise *noises, Station *stations, ChannelModel
        *channel, real *power_biases_m, Barrier *barriers, Other *others, real *range_errors_m, Row *heard, int64_t
        *tally) {
    real t_s = ((real)f->ticks + f->fraction) * TICK_S;
    Link way = {0};
    f->heard_by_anchors = 0;
    f->heard = 0;
    f->most_used = 0;
    for (int32_t node = 0, node_end = f->nodes; node < node_end; node++) {
        Station *station = &stations[node];
        Noise *noise = &noises[node];
        if (node == f->sender || !station->is_on) {
            continue;
        }
        find_link(f, stations, channel, barriers, f->sender, node, t_s, &way);
        int32_t outcome = overlap_outcome(f, stations, channel, barriers, others, node, t_s, &way);
        real error_m = range_errors_m[node * f->anchors + f->sender];
        if (outcome == HEARD && error_m == INFINITE) {
            outcome = WEAK;
        } else if (outcome == HEARD) {
            outcome = reception_outcome(channel, noise, way.power_dbm);
        }
        tally[(station->is_tag ? OUTCOMES : 0) + outcome] += 1;
        if (outcome == HEARD) {
            Row *row = &heard[f->heard];
            Clock *clock = &clocks[node];
            row->node = node;
            for (int32_t axis = 0; axis < 3; axis++) {
                row->position_m[axis] = coordinate_m(station, axis, t_s);
            }
            real extra_m = extra_path_m(station->is_tag, channel, noise, f->bias_m);
            row->extra_m = way.delay_m + (extra_m + body_delay_m(&stations[f->sender], station, t_s));
            if (station->is_tag) {
                error_m += slope_error_m(f->slope_m, way.distance_m);
            }
            real arrival_ticks = f->fraction + (way.distance_m + row->extra_m + error_m) / TICK_M;
            if (f->is_diagnosed) {
                measure(&clocks[f->sender], clock, channel, noise, &way, row);
            }
            real error_ticks = station->rx_error_ticks + power_bias_m(way.power_dbm, power_biases_m) / TICK_M;
            row->rx_ticks = stamp(clock, noise, station->rx_noise_ticks, f->ticks, arrival_ticks, error_ticks);
            row->reading_ticks = (real)(clock->local_ticks & 127) + clock->local_fraction - error_m / TICK_M;
            f->heard += 1;
            if (!station->is_tag) {
                f->heard_by_anchors += 1;
            }
        }
        f->most_used = max_32(f->most_used, noise->used);
    }
}

/* Predicted reception of anchors, from the simulated channel's formulas without randomness; columns of predictions.
 *
 * Also the floor of a site and the places where anchors may be mounted. */

/* Fill the results of ``links``, listener by listener; points are x, y and z one after the other. */
SKYLESS_EXPORT void skyless_fill_links(real *senders_m, int32_t senders, real *listeners_m, int32_t listeners, real
        *budget, Barrier *barriers, int32_t count, real *share, real *delays_m) {
    for (int32_t i = 0; i < listeners; i++) {
        real x_m = listeners_m[3 * i];
        real y_m = listeners_m[3 * i + 1];
        real z_m = listeners_m[3 * i + 2];
        for (int32_t j = 0; j < senders; j++) {
            int32_t k = i * senders + j;
            share[k] = REAL(0.0);
            delays_m[k] = REAL(0.0);
            real from_x_m = senders_m[3 * j];
            real from_y_m = senders_m[3 * j + 1];
            real from_z_m = senders_m[3 * j + 2];
            real squared_m2 = square(x_m - from_x_m) + square(y_m - from_y_m) + square(z_m - from_z_m);
            if (squared_m2 > budget[4]) {
                continue;
            }
            const cross_walls_results results_1 = cross_walls(barriers, count, from_x_m, from_y_m, from_z_m, x_m, y_m,
                    z_m);
            real loss_db = results_1.item_0;
            real delay_m = results_1.item_1;
            delays_m[k] = delay_m;
            if (loss_db == REAL(0.0) && squared_m2 < budget[5]) {
                share[k] = REAL(1.0) - budget[3];
                continue;
            }
            real power_dbm = received_power_dbm(budget[0], SQRT(squared_m2), loss_db);
            share[k] = (REAL(1.0) - budget[3]) * delivery_probability(power_dbm, budget[1], budget[2]);
        }
    }
}

/* Optimise anchor positions: the best of several starts, first on a lattice, then by the filter's prediction.
 *
 * A quick search exchanges anchors on a lattice of mounts. Its error measure is (HᵀWH)⁻¹ with each anchor weighted by the
 * share of its frames that arrives. The results are then improved and judged by the filter's prediction. The evenly spaced
 * layout is one of the starts, so the result is never worse. Mean and worst error over the region count equally, relative
 * to those of that layout. The same seed gives the same result, unless time runs out. */

/* The quick search on a lattice */

/* Fill the verdict on the chosen candidates, with the best received one as the master. */
SKYLESS_EXPORT void skyless_judge(int64_t *chosen, int32_t count, real *heard, int32_t candidates, real *rows, real
        *weights, int32_t points, int32_t size, real cap_m, Verdict *v) {
    real best = -REAL(1.0);
    int32_t master = 0;
    for (int32_t one = 0; one < count; one++) {
        real total = REAL(0.0);
        for (int32_t other = 0; other < count; other++) {
            total += min_real(heard[chosen[one] * candidates + chosen[other]], REAL(0.9));
        }
        if (total > best) {
            best = total;
            master = one;
        }
    }
    v->mean = REAL(0.0);
    v->worst = REAL(0.0);
    for (int32_t m = 0; m < points; m++) {
        for (int32_t k = 0; k < floor_div_32(size * (size + 1), 2); k++) {
            v->normal[k] = REAL(0.0);
        }
        for (int32_t one = 0; one < count; one++) {
            real factor = min_real(heard[chosen[one] * candidates + chosen[master]] / MIN_HEARD, REAL(1.0));
            int64_t begin = (chosen[one] * points + m) * size;
            for (int32_t a = 0; a < size; a++) {
                for (int32_t b = 0; b < a + 1; b++) {
                    v->normal[floor_div_32(a * (a + 1), 2) + b] += factor * rows[begin + a] * rows[begin + b];
                }
            }
        }
        real error = cap_m;
        if (factorise(v->normal, size)) {
            real trace = REAL(0.0);
            for (int32_t a = 1; a < size; a++) {
                for (int32_t b = 0; b < size; b++) {
                    v->column[b] = a == b ? REAL(1.0) : REAL(0.0);
                }
                solve(v->normal, size, v->column);
                trace += v->column[a];
            }
            error = min_real(SQRT(trace), error);
        }
        v->mean += weights[m] * error;
        v->worst = max_real(v->worst, error);
    }
}

/* Beacons per second that reach tags at a site of protocol 2, whose anchors send at random instants.
 *
 * A frame arrives if its power is above the sensitivity and exceeds that of each concurrent frame by the capture margin. */

/* Fill beacons per period, anchors in reach and anchors received, point by point; anchors in the order of x.
 *
 * ``settings``: transmit power, sensitivity, its width, capture margin, share not lost at random, exponent, distance
 * beyond which anchors are ignored, share of the time in which another anchor's frame would overlap, and share of an
 * anchor's frames that makes it count as received. ``powers_dbm`` has room for one number of each anchor. */
SKYLESS_EXPORT void skyless_fill_rates(real *points_m, int32_t points, real *anchors_m, int32_t anchors, real *settings,
        Barrier *barriers, int32_t count, real *powers_dbm, real *table) {
    real tx_dbm = settings[0];
    real sensitivity_dbm = settings[1];
    real width_db = settings[2];
    real capture_db = settings[3];
    real kept = settings[4];
    real exponent = settings[5];
    real farthest_m = settings[6];
    real overlap = settings[7];
    real useful = settings[8];
    for (int32_t i = 0; i < points; i++) {
        real x_m = points_m[3 * i];
        real y_m = points_m[3 * i + 1];
        real z_m = points_m[3 * i + 2];
        int32_t near = 0;
        for (int32_t j = 0; j < anchors; j++) {
            real from_x_m = anchors_m[3 * j];
            real from_y_m = anchors_m[3 * j + 1];
            real from_z_m = anchors_m[3 * j + 2];
            if (from_x_m > x_m + farthest_m) {
                break;
            }
            if (from_x_m < x_m - farthest_m) {
                continue;
            }
            real distance_m = SQRT(square(from_x_m - x_m) + square(from_y_m - y_m) + square(from_z_m - z_m));
            if (distance_m > farthest_m) {
                continue;
            }
            real loss_db = REAL(10.0) * (exponent - REAL(2.0)) * log10(max_real(distance_m, REAL(1.0)));
            const cross_walls_results results_1 = cross_walls(barriers, count, from_x_m, from_y_m, from_z_m, x_m, y_m,
                    z_m);
            real walls_db = results_1.item_0;
            real delay_m = results_1.item_1;
            powers_dbm[near] = received_power_dbm(tx_dbm, distance_m, loss_db + walls_db);
            near += 1;
        }
        for (int32_t k = 0; k < near; k++) {
            real power_dbm = powers_dbm[k];
            real delivered = kept * delivery_probability(power_dbm, sensitivity_dbm, width_db);
            if (delivered < REAL(1e-06)) {
                continue;
            }
            int32_t rivals = -1;  /* itself */
            for (int32_t other = 0; other < near; other++) {
                if (power_dbm - powers_dbm[other] < capture_db) {
                    rivals += 1;
                }
            }
            real arrives = delivered * exp(-overlap * (real)rivals);
            table[3 * i] += arrives;
            table[3 * i + 1] += delivered >= IN_VIEW * kept ? REAL(1.0) : REAL(0.0);
            table[3 * i + 2] += arrives >= useful ? REAL(1.0) : REAL(0.0);
        }
    }
}
