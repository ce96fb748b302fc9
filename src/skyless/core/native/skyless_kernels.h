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

#ifndef SKYLESS_KERNELS_H
#define SKYLESS_KERNELS_H

#include <stdbool.h>
#include <stdint.h>

#ifdef SKYLESS_FLOAT
typedef float real;
#define REAL(x) x##f
#else
typedef double real;
#define REAL(x) x
#endif

#ifndef SKYLESS_EXPORT
#define SKYLESS_EXPORT __attribute__((visibility("default")))
#endif

#define ACCEPTED_STD REAL(2.5)
/* Further loss of the first path if the message is late or crossed a wall: as much as metal causes. */
#define BLOCKED_FIRST_PATH_DB REAL(8.0)
#define CLOSES REAL(0.9)
#define COLLISION 3
/* Extra path at which all but 1/e of ``BLOCKED_FIRST_PATH_DB`` is lost; less with a shorter one. */
#define FIRST_PATH_SCALE_M REAL(0.1)
/* Free-space loss over the first metre on channel 5, 48.7 dB (Friis). */
#define FREE_SPACE_LOSS_1_M_DB REAL(48.69214180150746)
#define GATE 0
#define GATE_STD REAL(3.0)
#define HALF_DUPLEX 2
#define HEARD 0
#define INFINITE ((real)__builtin_inf())
/* An anchor is in view where at least this share of its frames arrives. */
#define IN_VIEW REAL(0.5)
/* First path's power below the total power with a clear line of sight (assumed). */
#define LINE_OF_SIGHT_FIRST_PATH_DB REAL(2.0)
#define LONGEST_ADDED_S REAL(0.03)
#define LOST 4
#define MIN_HEARD REAL(0.5)
#define OPENS REAL(0.1)
#define OUTCOMES 5
#define POWER_BIASES 18
#define POWER_BIAS_FIRST_DBM REAL(-61.0)
#define POWER_BIAS_STEP_DB REAL(2.0)
/* A pivot below this fraction of its diagonal element is rounding noise: the matrix is singular. */
#define SINGULAR_PIVOT REAL(1e-12)
/* The slope's error is 0 at this distance and reaches its size at 0 and at twice the distance. */
#define SLOPE_MIDDLE_M REAL(4.0)
/* Speed of light in vacuum, exact (SI). Air slows it by 0.03 %, 1.6 mm over 6 m, and a calibration absorbs it. */
#define SPEED_OF_LIGHT_MPS REAL(299792458.0)
#define SUM_S REAL(0.3)
/* Distance that light travels in one tick, 4.692 mm. */
#define TICK_M REAL(0.0046917639786157855)
#define TICK_MASK INT64_C(1099511627775)
/* Rate of the DW1000's timestamp counter, 63.8976 GHz (DW1000 User Manual v2.12, 7.2.8). */
#define TICK_RATE_HZ REAL(63897600000.0)
/* One tick of the timestamp counter, 15.650040064 ps. */
#define TICK_S REAL(1.5650040064102565e-11)
#define TRUSTED_STD REAL(2.0)
#define WEAK 1

/* One node's oscillator and counter. */
typedef struct Clock {
    int64_t true_ticks;
    real true_fraction;
    int64_t local_ticks;
    real local_fraction;
    real rate;  /* Fractional frequency without the temperature's part. */
    real white_fm;
    real random_walk_fm;
    real per_kelvin;
    real warm_up_k;
    real warm_up_s;
    real swing_k;
    real swing_rad_per_s;
    real swing_phase_rad;
    real drift;  /* Fractional frequency that a warm-up adds in the end. */
    real drift_start_s;
    real drift_tau_s;
} Clock;

/* Standard normals of a node, drawn ahead. */
typedef struct Noise {
    int32_t used;
    real normals[1024];
} Noise;

/* A frame that is received at all nodes of a world, and what became of it. */
typedef struct OneFrame {
    int32_t sender;
    int32_t anchors;  /* Number of anchors; nodes that follow are tags. */
    int32_t nodes;
    int32_t others;  /* Number of frames that may overlap it. */
    int32_t barriers;
    bool is_diagnosed;  /* Whether rows have powers and carrier offsets. */
    int64_t ticks;  /* True time of the emission, whole ticks. */
    real fraction;
    real begin_s;  /* Begin and end relative to the RMARKER. */
    real end_s;
    real bias_m;  /* The sender's present bias at tags. */
    real slope_m;  /* That of ``RangeErrorModel``. */
    int32_t heard_by_anchors;
    int32_t heard;
    int32_t most_used;  /* Numbers used of that node's noise which used most. */
} OneFrame;

/* A node's antenna and radio. */
typedef struct Station {
    bool is_on;
    bool is_tag;
    real origin_s;  /* Time at which position and velocity apply; the acceleration is constant around it. */
    real position_m[3];
    real velocity_mps[3];
    real acceleration_mps2[3];
    real tx_noise_ticks;
    real rx_noise_ticks;
    real tx_error_ticks;  /* True minus configured antenna delay. */
    real rx_error_ticks;
    real body_m;  /* Delay through the person who carries the tag, 0 for none. */
    real body_direction_rad;
    real body_cosine;  /* Cosine of half the sector's width. */
} Station;

/* Propagation at a site, and errors of its receivers. */
typedef struct ChannelModel {
    real tx_power_dbm;  /* Power sent, antenna gains included (EIRP). */
    /* Power at which half of the frames are lost (assumed for 6.8 Mb/s: free space carries 31 m). */
    real sensitivity_dbm;
    real sensitivity_width_db;  /* Scale of the loss as a logistic function of the power. */
    real capture_db;  /* A frame survives concurrent frames if it is stronger than each of them by this (assumed). */
    real loss_probability;  /* Probability that any listener loses a message. */
    real nlos_probability;  /* Probability that a message is late at a tag. */
    real nlos_mean_m;  /* Mean of the exponentially distributed delay of late messages. */
    bool nlos_between_anchors;  /* Whether messages between anchors can also be late. */
    /* Whether walls also delay messages between anchors; they weaken all messages either way. */
    bool walls_between_anchors;
    bool power_bias;  /* Whether RX stamps carry the power-dependent bias (APS011, 500 MHz, PRF 64 MHz). */
    real power_noise_db;  /* Noise of the reported powers (assumed). */
    real carrier_noise_ppm;  /* Noise of the reported carrier offset (assumed: the resolution of RX_TTCKO). */
} ChannelModel;

/* A wall, or a slab: the ground of a floor above the lowest. */
typedef struct Barrier {
    bool is_slab;
    real x1_m;
    real y1_m;
    real x2_m;
    real y2_m;
    real low_m;  /* Height of a slab. */
    real loss_db;
    real delay_m;
} Barrier;

/* A frame that may overlap the one that is received; times from that frame's RMARKER. */
typedef struct Other {
    int32_t sender;
    real begin_s;
    real end_s;
} Other;

/* One frame at one node that received it. */
typedef struct Row {
    int32_t node;
    int64_t rx_ticks;  /* The listener's 40-bit counter. */
    real position_m[3];  /* The true one at the frame's emission. */
    real rx_power_dbm;
    real first_path_power_dbm;
    real carrier_offset_ppm;
    real reading_ticks;  /* The listener's counter modulo 128 when the carrier arrived, without noise. */
    real extra_m;  /* By how much the way was longer than the distance. */
    real phase_cycles;  /* Of the carrier (``Carriers``), where that is simulated. */
} Row;

/* The way between two nodes at a true time. */
typedef struct Link {
    real distance_m;
    real delay_m;  /* By walls. */
    real power_dbm;
    real range_rate_mps;
} Link;

/* Errors over the points of a lattice, and memory to compute them. */
typedef struct Verdict {
    real mean;
    real worst;
    real normal[10];
    real column[4];
} Verdict;

/* State of ``run_plain``. */
typedef struct PlainTrack {
    real time_s;
    real good_s;
    bool is_open;
    real x[6];
    real qa[3];
    real P[6][6];
    real H[3];
    real PH[6];
} PlainTrack;

SKYLESS_EXPORT void skyless_run_plain(PlainTrack *t, int32_t rule, real std_m, real *times_s, real *tdoas_m, real
        *places_m, int32_t count, real *positions_m, real *covariances_m2);
SKYLESS_EXPORT void skyless_advance(Clock *clock, Noise *noise, int64_t true_ticks, real true_fraction);
SKYLESS_EXPORT int64_t skyless_foresee(Clock *clock, int64_t local_ticks);
SKYLESS_EXPORT real skyless_emit(Clock *clock, Noise *noise, int64_t local_ticks, real tx_noise_ticks, real
        tx_error_ticks);
SKYLESS_EXPORT void skyless_receive_frame(OneFrame *f, Clock *clocks, Noise *noises, Station *stations, ChannelModel
        *channel, real *power_biases_m, Barrier *barriers, Other *others, real *range_errors_m, Row *heard, int64_t
        *tally);
SKYLESS_EXPORT void skyless_fill_links(real *senders_m, int32_t senders, real *listeners_m, int32_t listeners, real
        *budget, Barrier *barriers, int32_t count, real *share, real *delays_m);
SKYLESS_EXPORT void skyless_judge(int64_t *chosen, int32_t count, real *heard, int32_t candidates, real *rows, real
        *weights, int32_t points, int32_t size, real cap_m, Verdict *v);
SKYLESS_EXPORT void skyless_fill_rates(real *points_m, int32_t points, real *anchors_m, int32_t anchors, real *settings,
        Barrier *barriers, int32_t count, real *powers_dbm, real *table);

#endif
