/* Made by tools/make_core.py from these modules; do not edit.

 * skyless.core.air.almanac
 * skyless.core.air.beacon
 * skyless.core.air.frame
 * skyless.core.air.neighbours
 * skyless.core.air.site_choice
 * skyless.core.air.site_pages
 * skyless.core.estimator.faults
 * skyless.core.estimator.hypotheses
 * skyless.core.estimator.kalman
 * skyless.core.estimator.levels
 * skyless.core.estimator.measurements
 * skyless.core.estimator.monitor
 * skyless.core.estimator.motion
 * skyless.core.estimator.phases
 * skyless.core.estimator.process
 * skyless.core.estimator.state
 * skyless.core.estimator.steady_state
 * skyless.core.integrity
 * skyless.core.native.arithmetic
 * skyless.core.tag.acquisition
 * skyless.core.tag.admission
 * skyless.core.tag.following
 * skyless.core.tag.hearing
 * skyless.core.tag.joint
 * skyless.core.tag.position
 * skyless.core.tag.search
 * skyless.core.ticks
 */

#ifndef SKYLESS_CORE_H
#define SKYLESS_CORE_H

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

#define ACCEPTED 1
#define ACCURACY_KIND 2
#define ACCURACY_PAGE 5
#define ACQUIRING 22
#define ADMITTED 0
#define AFTER_ALL_TICKS INT64_C(4611686018427387904)
#define ALL_RANGE_ERRORS 2
/* All flags allowed in a frame with a certificate. */
#define ALONGSIDE_CERTIFICATE 12
#define ANCHOR_PAGE 1
#define ANCHOR_RESTART 4
/* Lowest 16 bits of the interval, then the code. */
#define AUTHENTICATION_BYTES 10
#define AXES 3
#define BAD_FCS 3
#define BAD_FLAGS 6
#define BAD_GEOMETRY 24
#define BAD_HEARD 8
#define BAD_LENGTH 7
#define BAD_PAGE 9
#define BAD_PERIOD 10
/* Bytes 53 B0; the low half of the second is the version. */
#define BEACON_MAGIC 45139
/* An anchor replaces the weakest one if it is stronger by this. */
#define BETTER_DB REAL(3.0)
/* Difference of powers in dB at which the factor starts to rise and at which it is greatest: the maker's 6 and 10, plus
 * 1 dB. Lines of sight of the UTIL data set reach 8.4 dB; paths through metal, the only ones much later, start at 11.3. */
#define BLOCKED_DB REAL(11.0)
#define BOUND_SIGMAS REAL(3.0)
#define BROADCAST 65535
/* Length of a certificate (``skyless.core.keys.chain``). */
#define CERTIFICATE_BYTES 94
#define CHANGED 2
#define CHANGING_RANGE_ERRORS 1
/* A whole turn in steps of 1e-7 degree. */
#define CIRCLE INT64_C(3600000000)
#define CLEAR_DB REAL(7.0)
#define CLOCK_JUMPED 2
#define COLLINEAR REAL(1e-06)
#define COLLINEAR_ANCHORS 2
#define COMPLETE_CHANGE REAL(0.001)
#define CONTRADICTED 2
#define CONVERGED 0
#define COUNTER_JUMPED 1
/* Two consecutive stamps that go back by more than radios and hosts reorder them mean that the tag's own counter has
 * restarted; a single one is damaged. */
#define COUNTER_JUMP_TICKS INT64_C(63897600000)
#define COUNT_BITS 4
/* Number of receptions, and the mask of weak ones. */
#define COUNT_BYTES 2
#define COUNT_MASK 15
#define COVARIANCES (PACKED ? STATES * (STATES + 1) / 2 : STATES * STATES)
/* Polynomial of Ethernet's check sequence, bits reversed. */
#define CRC_32 INT64_C(3988292384)
#define CREEPING 2
/* Number of ticks with a whole number of carrier cycles in every channel: ``EstimatorSettings.carrier_cycles``. */
#define CYCLE_TICKS 128
#define DB_PER_LOG REAL(8.685889638065035)
/* DX_TIME ignores its low nine bits: transmissions start on 8.013 ns boundaries (DW1000 User Manual, p. 26). */
#define DELAYED_TX_GRANULARITY_TICKS 512
/* Columns are dependent if their smallest singular value is below this fraction of the largest. */
#define DEPENDENT REAL(1e-06)
#define DISTINCT_MINIMA_CHI2 REAL(9.0)
#define DIVERGED 2
/* An anchor leaves the estimator after this silence, or after four superframes if that is longer. */
#define DROP_S REAL(1.0)
#define DUPLICATE 1
#define EARTH_KIND 1
#define EXHAUSTED 3
#define FAR_EXTENTS REAL(10000.0)
/* From here on the normal tail's continued fraction converges faster than its series. */
#define FAR_TAIL REAL(3.0)
#define FAULTS (FAULT_KINDS * MAX_ANCHORS)
#define FAULT_KINDS 3
#define FCS_BYTES 2
#define FIRST_DAMPING REAL(0.01)
/* Index of the tests of faults in ``levels``, after ``HPL`` and ``VPL``. */
#define FIRST_TEST 2
#define FIX 20
/* Length of the fields that every beacon has. */
#define FIXED_BYTES 20
#define FLAGS_AT 11
#define FLAT REAL(1e-09)
/* Largest difference of flight times between anchors (300 m). */
#define FLIGHT_SLACK_TICKS 63898
#define FOREIGN 0
#define FOREIGN_SITE 5
#define FOUND 0
/* Data frame, PAN identifier compressed, 16-bit addresses. */
#define FRAME_CONTROL 34881
#define FREE 0
#define GAIN_TOLERANCE REAL(1e-13)
#define GEOREFERENCE_PAGE 4
#define GRAVITY_MPS2 REAL(9.80665)
#define HAS_AUTHENTICATION 4
#define HAS_CERTIFICATE 8
/* Whether positions are relative to whole metres near the first anchor, so that single precision suffices. */
#ifndef HAS_ORIGIN
#define HAS_ORIGIN false
#endif
#define HAS_PAGE 2
/* Set if receptions carry a phase each and stamps of 32 bits instead of 40. */
#define HAS_PHASES 64
#define HAS_POSITION 1
#define HAS_TOO_FEW 27
/* Length of the frame up to the magic number. */
#define HEADER_BYTES 11
#define HEADINGS 2
#define HEARD_BYTES 8
#define HEIGHT 1
/* Offset of the flags in a site page; the height follows. */
#define HEIGHT_FLAG_AT 8
/* Flag of a site or schedule page that states the height of the tags. */
#define HEIGHT_GIVEN 1
#define HOST_JUMPED 2
#define HPL 0
/* Most hypotheses on cycles of phases; 0 if phases are not used. */
#ifndef HYPOTHESES
#define HYPOTHESES 16
#endif
#define IMPOSSIBLE 3
#define IMPOSSIBLE_HOST_TIME 6
#define IMPOSSIBLE_SIGMAS REAL(6.0)
#define IMPOSSIBLE_STAMP 3
#define IMPULSES 4
#define INTACT 0
#define IS_MIRRORED 28
#define IS_UNSETTLED 29
#define JOINED 2
#define JOINS 0
/* Numbers in a 256-bit vector; rows of P start at vector boundaries. */
#define LANES (PACKED ? 1 : 4)
/* Limit in m or m². No site is larger, and nothing here overflows below it. */
#define LARGEST REAL(1000000000.0)
#define LASTING 0
/* Both last for at least this number of the anchor's mean times between beacons. */
#define LASTING_PERIODS 3
/* A year of ticks, so that differences fit into 64 bits; a host's clock that jumps by more was set. */
#define LAST_TICKS INT64_C(2305843009213693952)
/* Numbers written by ``levels.protect``: ``HPL``, ``VPL``, and the test of each kind of faults. */
#define LEVELS 5
#define LIGHT_2 REAL(8.987551787368176e+16)
/* The leading bits of ln 2: products with small whole numbers are exact. */
#define LN_2_HIGH REAL(0.6931471803691238)
#define LN_2_LOW REAL(1.9082149292705877e-10)
#define LOG_FACTOR REAL(3.58351893845611)
/* Longer jumps of a host's clock are limited to this: the ticks of three years fit into 64 bits. */
#define LONGEST_JUMP_S REAL(100000000.0)
/* 4 s: a gap of one and a half periods is shorter than half a wrap of a counter. */
#define LONGEST_PERIOD_CODE 159
/* Longest time update: beyond it, squares of variances overflow in single precision. */
#define LONGEST_S REAL(1000.0)
#define LOST 22
/* Exponentials of smaller numbers are 0. */
#define LOWEST REAL(-700.0)
#define MAGIC_MASK 61695
/* Added to the fault's number if the bytes are no beacon. */
#define MALFORMED 40
/* Factor on all standard deviations, as errors are not quite Gaussian and noise figures not quite right. */
#define MARGIN REAL(1.05)
/* Most anchors in the state. */
#ifndef MAX_ANCHORS
#define MAX_ANCHORS 32
#endif
/* Most anchors in a tag's state; more reduce accuracy, as each then sends less, and take time. */
#ifndef MAX_ANCHORS_IN_USE
#define MAX_ANCHORS_IN_USE 24
#endif
#define MAX_BEGINNING (2 * MAX_ANCHORS)
/* Coordinates and heights beyond 1000 km from the origin are errors; a page has 32-bit millimetres, ±2147 km. */
#define MAX_COORDINATE_MM 1000000000
/* Most anchors counted of each. */
#ifndef MAX_COUNTED
#define MAX_COUNTED 32
#endif
/* Magnitude above which a value is not a valid power. */
#define MAX_DIFFERENCE_DB REAL(1000.0)
/* Largest relative drift of two clocks: 20 ppm each (IEEE 802.15.4-2015, 16.4.9), and room for motion. */
#define MAX_DRIFT REAL(5e-05)
#define MAX_FAULTS 2
/* Longest PSDU (IEEE 802.15.4-2015, aMaxPhyPacketSize). */
#define MAX_FRAME_BYTES 127
/* Largest number of entries that the count and the flags of ``heard`` can hold. */
#define MAX_HEARD 12
#define MAX_ITERATIONS 200
#define MAX_LINKS (MAX_ANCHORS * (MAX_ANCHORS - 1))
/* Most anchors known from their own beacons. */
#ifndef MAX_NEIGHBOURS
#define MAX_NEIGHBOURS 256
#endif
/* 2⁻¹⁹ as a float32; non-negative float32 values are ordered by their bits. */
#define MAX_NOISE_BITS 905969664
/* Most collected pages of incomplete issues. */
#ifndef MAX_PAGES
#define MAX_PAGES 64
#endif
/* Larger magnitudes are not a radio's power. */
#define MAX_POWER_DBM REAL(1000.0)
#define MAX_RATE_MPS REAL(29979.2458)
/* Most relays with a packet; 13 fit into a frame. */
#ifndef MAX_RELAYS
#define MAX_RELAYS 32
#endif
#define MAX_ROWS (MAX_ANCHORS)
/* Most senders counted for a page. */
#ifndef MAX_SENDERS
#define MAX_SENDERS 16
#endif
/* Most sites whose anchors are counted. */
#ifndef MAX_SITES
#define MAX_SITES 8
#endif
#define MAX_STARTS 9
/* Longest superframe: under half a wrap of the counter (8.6 s), as stamps would become ambiguous. */
#define MAX_SUPERFRAME_TICKS INT64_C(549755813887)
/* Most sweeps over all pairs of columns; they converge quadratically, four columns in about six. */
#define MAX_SWEEPS 12
#define MAX_TRIALS 256
/* Factor on the variance of a blocked path: metal delayed messages by 0.2 to 0.4 m, 4 to 8 times the noise. */
#define MAX_VARIANCE_FACTOR REAL(36.0)
#define MERGED_SIGMAS REAL(2.0)
/* With fewer anchors no majority counts, unless the tag receives no more for ``PRESENT_TICKS``. */
#define MIN_ANCHORS 3
#define MIN_DAMPING REAL(0.0001)
/* An anchor exists if it relays at least this many receptions of anchors in use that fit. */
#define MIN_FITTING 2
#define MIRROR 7
#define MM_PER_M 1000
/* Upper limit of the share of late packets in ``is_lost``. */
#define MOST_LATE REAL(0.45)
/* One speed counts for no more than this in the mean. */
#define MOST_NIS REAL(100.0)
/* Most queued updates of the filter. */
#ifndef MOST_WAITING
#define MOST_WAITING 8
#endif
/* States for a motion sensor; 0 if none can be used. */
#ifndef MOTION_STATES
#define MOTION_STATES 5
#endif
#define MOVED_ANCHOR 31
#define MOVED_HOLD_TICKS INT64_C(19169280000)
/* A survey moves all anchors of a site, some of them seconds after the others, and positions from before and after it
 * must not be mixed. So a tag uses either the anchors that have stated another position or those that have not, until none
 * has moved for ``MOVE_TICKS``. It switches to the moved ones once they are the majority and none has moved for
 * ``MOVED_HOLD_TICKS``. */
#define MOVE_TICKS INT64_C(638976000000)
/* Lower limit of a squared distance. */
#define NEAREST_M2 REAL(1e-18)
/* Earlier than any time. */
#define NEVER (INT64_C(-4611686018427387904))
/* The logarithm is concave and the first z too large, so each step doubles the number of correct digits. */
#define NEWTON_STEPS 10
/* Stands for no anchor. */
#define NOBODY (-1)
#define NOISE_KIND 0
#define NOISE_PAGE 3
/* Allowance of 0.3 m for the noise of two stamps of one anchor. */
#define NOISE_TICKS 64
/* Assumed power at 1 m if the radio reports none, so that nearer anchors count as stronger. */
#define NOMINAL_POWER_DBM REAL(-63.0)
#define NOT_A_BEACON 4
#define NO_COVARIANCE 1
#define NO_ISSUE (-1)
#define NO_PAGE (-1)
#define NO_PAGES 30
#define NO_POSITION 32
#define NO_RANGE_ERRORS 0
#define NO_SITE (-1)
#define OBSTRUCTED 1
#define ONES INT64_C(4294967295)
/* Quaternion w, x, y, z that turns the frame of a motion sensor into the site's, then the heading's standard deviation
 * [rad], in two rows; zeros if unknown. Only of methods that use one. Last the number of hypotheses on carrier phases. */
#define ORIENTATION 10
/* Columns are orthogonal if the cosine of their angle does not exceed this. */
#define ORTHOGONAL REAL(1e-14)
#define OTHER_PAGES 1
#define OTHER_SETTINGS 2
#define OUTLIER 21
#define OUT_OF_ORDER 2
/* Whether P is kept as a lower triangle: half the memory, but rows that do not fit vectors. */
#ifndef PACKED
#define PACKED false
#endif
/* Packets kept of each anchor for later relays; divides the range of sequence numbers. */
#ifndef PACKETS_KEPT
#define PACKETS_KEPT 16
#endif
/* A type, then 16 bytes of contents. */
#define PAGE_BYTES 17
#define PAGE_KINDS 4
/* States of each anchor for carrier phases; 0 if they are not used. */
#ifndef PHASE_STATES
#define PHASE_STATES 2
#endif
/* Phase steps in a cycle; also the bit that marks the presence of a phase. */
#define PHASE_STEPS 128
/* Squared differences of range errors are limited to this multiple of their mean, as jumps are not multipath. */
#define PLACE_LIMIT REAL(2.0)
#define PLACE_LIMITED_MEAN REAL(0.7421917)
#define PLANE 2
/* Columns of V for planning: walls, and four impulses along each axis. */
#ifndef PLANNED_FAULTS
#define PLANNED_FAULTS 13
#endif
/* The position, then three rows of its covariance. */
#define POSITION 0
#define POSITION_BYTES 12
/* Weight of the newest value in the running mean of an anchor's received power. */
#define POWER_GAIN REAL(0.1)
/* Anchors received within this time are present. */
#define PRESENT_TICKS INT64_C(63897600000)
#define PROTECTED_ROWS 12
/* The first three levels (``estimator/levels.py``); only of methods that compute them. */
#define PROTECTION 9
/* Row of chi-square and mean squared residual in m². */
#define QUALITY 4
#define RECENT 1
#define REJECTED 0
/* How long a reception confirms its sender, if received by an anchor in use or by one that is confirmed itself. */
#define RELAYED_TICKS INT64_C(127795200000)
/* Relays kept of each packet for the filter's start. */
#ifndef RELAYS_KEPT
#define RELAYS_KEPT 32
#endif
#define RELAY_AGE_S REAL(1.0)
#define RELAY_SUPERFRAMES REAL(2.5)
#define RESERVED_FLAGS 176
#define RESIDUALS 6
#define RESTARTED_CLOCK 4
#define RESTART_SILENCE_PERIODS 4
#define RESTART_SILENCE_TICKS INT64_C(12779520000)
#define RIVAL_MINIMUM_CHI2 REAL(9.0)
/* Smaller variances of lasting faults may be rounding errors of single precision. */
#define ROUNDING_M2 REAL(1e-07)
/* Variance of rounding to whole ticks. */
#define ROUNDING_S2 REAL(2.0410312834001283e-23)
#define SAME_PAGES 0
#define SAME_POINT REAL(1e-06)
#define SCHEDULE_PAGE 2
#define SEARCHING 26
/* Capacity for columns of V. */
#define SENSITIVITIES (FAULTS + PLANNED_FAULTS + HYPOTHESES)
/* Whether the search for a start uses the memory of the state, which is unused meanwhile. */
#ifndef SHARES_MEMORY
#define SHARES_MEMORY false
#endif
/* Shortest time between two packets of an anchor: a frame takes longer. */
#define SHORTEST_S REAL(5e-05)
/* Bits of the stamp of such an entry. */
#define SHORT_BITS 32
/* The highest bit of four bytes; as a float32 on its own it is −0. */
#define SIGN INT64_C(2147483648)
#define SINGULAR 5
/* A pivot below this fraction of its diagonal element is rounding noise: the matrix is singular. */
#define SINGULAR_PIVOT REAL(1e-12)
#define SITE_CHANGED 4
#define SITE_KIND 3
#define SITE_MASK 65535
#define SITE_PAGE 6
/* A tag that may choose its site leaves one that has been silent, or has given no fix, for this long. */
#define SITE_SILENCE_TICKS INT64_C(127795200000)
#define SOUND 0
/* Speed of light in vacuum, exact (SI). Air slows it by 0.03 %, 1.6 mm over 6 m, and a calibration absorbs it. */
#define SPEED_OF_LIGHT_MPS REAL(299792458.0)
#define SQRT_2_PI REAL(2.5066282746310002)
#define STALE 3
#define STAMPS_BEFORE_RESTART 3
#define STAMP_FITS 0
#define START_CONTRADICTED 23
#define START_FIX 25
#define STATE 2
/* Capacity for states; a multiple of ``LANES``. */
#define STATES ((2 * (AXES + MAX_ANCHORS) + (3 + PHASE_STATES + AXES) * MAX_ANCHORS + 2 + MOTION_STATES + LANES - 1) / LANES * LANES)
#define STD_STEPS_PER_M 10000
#define STEPS 16
#define STEPS_PER_M 100
/* Units of an accuracy page: standard deviations, distance, time. */
#define STEPS_PER_S 10
#define STEP_TOLERANCE REAL(1e-10)
/* Subdivisions of a tick: the unit of the site's time on the air, of which beacons carry 48 bits. */
#define SUBTICKS 256
#define SUBTICK_MASK INT64_C(281474976710655)
/* After silences up to this the filter predicts without a check. */
#define SURELY_IN_REACH_TICKS INT64_C(6389759999)
/* Sweeps of Jacobi rotations; each squares what is left off the diagonal. */
#define SWEEPS 8
#define TERMS 60
#define THIN_SIGMAS REAL(0.1)
/* Width of the timestamp counter (DW1000 User Manual v2.12, 7.2.8); it wraps every 17.2074 s. */
#define TICK_BITS 40
/* Distance that light travels in one tick, 4.692 mm. */
#define TICK_M REAL(0.0046917639786157855)
#define TICK_MASK INT64_C(1099511627775)
/* Rate of the DW1000's timestamp counter, 63.8976 GHz (DW1000 User Manual v2.12, 7.2.8). */
#define TICK_RATE_HZ REAL(63897600000.0)
/* One tick of the timestamp counter, 15.650040064 ps. */
#define TICK_S REAL(1.5650040064102565e-11)
#define TOO_FEW_ANCHORS 21
#define TOO_LONG 2
#define TOO_SHORT 1
/* A site that has given no fix for this long is left for another, whatever its number of anchors. */
#define TRIAL_TICKS INT64_C(319488000000)
#define TRIANGLE (MAX_ANCHORS * (MAX_ANCHORS - 1) / 2)
#define TWO_PI REAL(6.283185307179586)
#define UNAVAILABLE 3
#define UNCERTAIN 8
#define UNCONFIRMED_ANCHOR 33
#define UNDETERMINED 1
/* Unit of periods: 31,200 steps of the delayed transmission, a quarter of a millisecond. */
#define UNIT_STEPS 31200
#define UNKNOWN_VERSION 5
#define UNSETTLED 4
#define UNUSABLE 20
#define UNUSED 0
#define USED 1
/* The velocity, then three rows of its covariance; only of methods that estimate it. */
#define VELOCITY 5
#define VERSION_2 45651
#define VPL 1
#define WEAKER_ANCHOR 34
#define WORK_ROWS (MAX_ANCHORS + 1 + 2 * AXES)

/* Position that an anchor states, as frames carry it. */
typedef struct StatedPlace {
    int32_t position_mm[3];
    int32_t std_mm;
    int32_t floor_;
    int32_t zone;
} StatedPlace;

/* Contents of a frame, and the offsets of the parts that are passed on unread. */
typedef struct BeaconFields {
    int32_t site;
    int32_t anchor;
    int32_t sequence;
    int64_t tx_ticks;  /* TX stamp in the sender's clock, 40 bits. */
    int32_t almanac_issue;
    int32_t period_code;
    bool has_place;
    StatedPlace place;
    int32_t heard_at;  /* Offset of the receptions of other anchors. */
    int32_t heard_count;
    int32_t weak;  /* Bit k is set if the first path of reception k was weak, so that its stamp may be late. */
    bool has_phases;  /* Whether the receptions have phases (``SHORT_BITS``). */
    int32_t page_at;  /* Offset of the page; 0 if there is none, as for the next two. */
    int32_t certificate_at;
    int32_t authentication_at;
    int32_t relay_bytes;
    uint8_t relays[96];  /* Receptions without the weak ones, encoded as in the frame. */
} BeaconFields;

/* One anchor. */
typedef struct Neighbour {
    int32_t anchor;  /* Its identifier. */
    int64_t changed_ticks;  /* Receiver's reading when anything was last learnt about it. */
    int32_t frames;  /* Frames whose stamps have fitted since its counter began: 0, 1, or 2 for more. */
    int32_t sequence;  /* Sequence number of the newest frame. */
    int64_t rx_ticks;  /* Receiver's stamp of the newest frame. */
    int64_t tx_ticks;  /* Anchor's stamp of the newest frame, unwrapped. */
    int32_t impossible;  /* Number of impossible stamps in a row. */
    bool has_rival;  /* Whether an impossible stamp may be the right one, as only one frame stands against it. */
    int64_t rival_rx_ticks;
    int64_t rival_tx_ticks;
    int32_t almanac_issue;
    int32_t period_code;
    bool has_place;
    StatedPlace place;  /* Position in use. */
    bool has_other;
    StatedPlace other;  /* Another position, stated once; used when it is stated twice in a row. */
    bool has_moved;  /* Whether it has stated a different position, until all anchors are used together again. */
    bool was_relayed;  /* Whether others had received it by its newest frame. */
    int64_t relayed_ticks;  /* Receiver's reading when another anchor last relayed a reception of this one. */
    /* Receiver's reading when the anchor's own relays last fitted, if no other has relayed it since. */
    int64_t own_relays_ticks;
    /* Receiver's reading when the filter last got a packet of this anchor, if it has the anchor. */
    int64_t used_ticks;
    bool has_power;
    real power_dbm;  /* Running mean of the received power. */
    bool is_misfit;  /* Whether it contradicted the others at the start. */
} Neighbour;

/* All rows of the table. */
typedef struct Neighbours {
    int32_t count;
    /* Row of the anchor whose frame is being processed, which is then not forgotten; −1 if not known yet. */
    int32_t row;
    bool has_newest;
    /* RX stamp of the newest accepted frame, so that one impossible stamp does not make others late. */
    int64_t newest_rx_ticks;
    Neighbour rows[MAX_NEIGHBOURS];
} Neighbours;

/* Converts one counter's wrapped stamps to int64 ticks that never wrap (``unwrap``). */
typedef struct Unwrapper {
    int32_t bits;  /* Width of the counter, at most 62. */
    bool has_stamp;
    int64_t last_ticks;
    real last_host_s;  /* NaN if no stamp has had a host time. */
} Unwrapper;

/* An anchor of a counted site. */
typedef struct CountedAnchor {
    int32_t anchor;
    int64_t rx_ticks;  /* RX stamp of its last beacon. */
} CountedAnchor;

/* A site that is received. */
typedef struct CountedSite {
    int32_t site;
    int64_t newest_ticks;  /* RX stamp of its last beacon. */
    int32_t count;
    CountedAnchor anchors[MAX_COUNTED];
} CountedSite;

/* The site in use and, if the tag may choose, how many anchors of other sites it receives.
 *
 * The tag uses the first site that it receives, but until there are fixes one with more anchors, so that a single
 * foreign anchor cannot hold it. A site without fixes gives way to others and returns only after those have failed. */
typedef struct SiteChoice {
    int32_t only_site;  /* Configured site; ``NO_SITE`` if the tag may choose. */
    int32_t site;  /* The site in use: its PAN identifier, and ``OF_PROTOCOL_1``. */
    int64_t heard_ticks;  /* RX stamp of its last accepted beacon. */
    int64_t since_ticks;  /* RX stamp of the beacon at which it was chosen. */
    bool has_fix;
    int64_t fix_ticks;  /* RX stamp of the last fix. */
    int32_t failed_count;
    int32_t failed[MAX_SITES];  /* Sites left since the last fix because they gave none, newest last. */
    int32_t count;
    CountedSite sites[MAX_SITES];
} SiteChoice;

/* Time of fixes, counted from a receiver's first one; it never goes back, even if master or method change. */
typedef struct FixTime {
    bool has_fix;
    int64_t first_ticks_master;
    int64_t last_ticks_master;
    int64_t last_rx_ticks_tag;
} FixTime;

/* What a tag knows of its own counter, of the sites and of the anchors. */
typedef struct Admission {
    Unwrapper own;
    Unwrapper former;  /* ``own`` before the current frame; restored if that is rejected. */
    bool went_back;  /* Whether the newest frame's stamp is earlier than others by more than ``COUNTER_JUMP_TICKS``. */
    SiteChoice choice;
    FixTime time;
    Neighbours neighbours;
    int64_t rx_ticks;  /* The tag's unwrapped stamp of the current frame. */
    int32_t events;  /* Events since the owner last looked. */
} Admission;

/* The filter's assumptions at a site; standard deviations are one sigma. */
typedef struct EstimatorSettings {
    real qa;  /* Spectral density of the tag's acceleration, m²/s³ per axis. */
    /* Standard deviation of the tag's speed at the start, when pseudoranges are not simultaneous. */
    real start_speed_std_mps;
    real white;  /* White frequency noise of each oscillator, m²/s. */
    real walk;  /* Random walk of each oscillator's rate, m²/s³. */
    real tx_variance_m2;
    real rx_variance_m2;  /* Variances of one stamp each. */
    real gate;  /* Innovations beyond this number of standard deviations are not used. */
    real height_m;  /* Given height of the tag; NaN to estimate it. */
    real height_std_m;  /* Standard deviation of the given height. */
    real lowest_m;
    real highest_m;  /* Bounds of the tag's height. */
    /* Carrier cycles in 128 ticks for the use of phases, 13 for channel 5; 0: phases are not used. */
    int32_t carrier_cycles;
    real phase_std_m;  /* Smallest standard deviation of a phase as the tag measures it. */
    real phase_wander;  /* Smallest change of an anchor's phases by reflections as the tag walks, m²/m. */
    real drop_s;  /* Anchors leave the state after this silence. */
    real relay_age_s;  /* Relays of older packets are not used, as sequence numbers wrap around. */
    real survey_std_m;  /* Standard deviation of each coordinate of an anchor. */
    real range_std_m;  /* Standard deviation of the constant error of a tag's ranges to one anchor. */
    /* Standard deviation of the constant error of the range between two anchors.
     *
     * It is not used where survey and ranges are exact. */
    real pair_std_m;
    real slope_std_m;  /* Growth of ranges per unit of clip((range − 4 m)/4 m, −1, 1). */
    /* Standard deviation of the part of a range error that changes as the tag moves (named as in the site file). */
    real place_std_m;
    real place_distance_m;  /* Distance over which that part changes. */
    real place_time_s;  /* Time over which that part changes while the tag is stationary. */
    real change_memory_s;  /* Time constant of estimating each anchor's changing part; 0 if it is ``place_std_m``. */
    /* Random walk of a barometer's zero, m²/s: 5 cm in ten seconds, as when doors and windows are opened. */
    real barometer_walk;
    real least_change_std_m;  /* Lower limit of the estimated changing part. */
    real earliest_m;  /* Lower bound of the changing part: obstacles only lengthen ranges. */
    real difference_std_m;  /* Standard deviation of each ready-made time difference. */
    real stationary_s;  /* A tag without motion for this time counts as stationary; 0: never. */
    real integrity_risk;
    real alert_limit_m;  /* Fixes with a higher horizontal protection level have an alert; NaN for none. */
} EstimatorSettings;

/* A page in use. */
typedef struct UsedPage {
    uint8_t contents[17];  /* All zeros if there is none. */
} UsedPage;

/* A page of an issue that is not complete yet. */
typedef struct CollectedPage {
    int32_t issue;
    int32_t support;  /* How many of the anchors that sent it are received by others. */
    uint8_t contents[17];
    int32_t sender_count;
    int32_t senders[MAX_SENDERS];
} CollectedPage;

/* What a tag has learnt of the site's common pages.
 *
 * Pages count once a majority of the recently received anchors states their issue and they match it; those in use
 * stay until all pages of another such issue are there. */
typedef struct SitePages {
    int32_t issue;  /* Issue of the pages in use. */
    UsedPage used[4];
    bool has_first;
    int64_t first_ticks;  /* When the first beacon was received. */
    int32_t count;
    CollectedPage collected[MAX_PAGES];
} SitePages;

/* Constants of the estimator, the same at every site; ``docs/estimator_table.md`` shows what each one buys.
 *
 * Normalised means divided by the standard deviation. The weight of a running mean is that of the newest value. */
typedef struct Tuning {
    real restart_m;  /* A change of path by more than this between packets is impossible [m]. */
    /* Factor on the random walk of the tag's oscillator at a start, as it warms up after power-on. */
    real start_walk_scale;
    /* Weight in running means of normalised innovations (along each axis, of all anchors, of an anchor's relays), and
     * decay of the counts of recent relays with each packet. */
    real mean_gain;
    real noise_growth;  /* Growth of adapted process noise with each innovation that requires more … */
    /* Largest factor on the random walk of a clock; for the tag's, at once when all innovations are on one side. */
    real max_walk_scale;
    real noise_loss;  /* … and its factor with every other innovation; that of a range error has 1 − ``mean_gain``. */
    /* If the normalised innovations of all anchors are beyond this on one side, the tag's clock has left its rate. */
    real common;
    /* Time over which rates of clocks are compared, while phases are in use, to learn how little they wander [s] … */
    real rate_s;
    real rate_changes;  /* … the number of changes remembered … */
    real least_walk_scale;  /* … and the smallest factor on that of the settings. */
    /* Consecutive relays of a pair beyond the gate that show that its path has jumped; fewer may be late. */
    real relays_in_row;
    /* Largest factor on the random walk of a clock at which an anchor's report is used: its filter assumes 1. */
    real steady_walk_scale;
    real max_scale;  /* Largest factor on the process noise of motion, and on that of a range error that has jumped. */
    /* Mean square of the innovations along the axes (1 if the filter is right) beyond which that noise grows … */
    real lag_limit;
    real sudden_lag;  /* … and the square of their running mean beyond which it doubles with each innovation. */
    real walking_mps;  /* Speed above which that noise is at least its setting × (speed over this)², for turns [m/s]. */
    real better_known;  /* The position of a tag at rest is updated once its variance has shrunk to this fraction. */
    real stationary_noise_share;  /* Fraction of the process noise of motion kept at rest: 5 cm within half a minute. */
    real stationary_std_mps;  /* Standard deviation of the velocity of a tag at rest [m/s]. */
    real longest_gap_s;  /* Without samples for longer, the tag moves by its motion model again [s]. */
    real shock_mps2;  /* A specific force beyond this [m/s²] … */
    /* … or a rate beyond this [rad/s] exceeds many sensors' range: what it did to the tag is unknown. */
    real shock_rps;
    /* Beyond this the newest sample does not stand for the present: process noise is that without a sensor [s]. */
    real short_gap_s;
    /* A factor on process noise beyond this shows that sensor and positions contradict each other, … */
    real wrong_scale;
    real wrong_speed_nis;  /* … or a mean NIS of wheels' speeds beyond this, … */
    real wrong_s;  /* … after this time [s]. It is then ignored … */
    real ignored_s;  /* … for this time [s], and its heading is looked for again. */
    real level_s;  /* Time over which specific force is averaged to find the level [s]. */
    real rest_rps;  /* A sensor's rate above this shows motion [rad/s] … */
    real rest_mps2;  /* … and a specific force that differs from its running mean by more [m/s²]. */
    real rest_mps;  /* A tag that is faster is not at rest, whatever the sensor shows [m/s]. */
    real tilt_s;  /* Time in which known errors of tilt and heading move into the attitude [s], … */
    /* … in which the mean specific force corrects the level of a tag in motion whose heading is unknown [s] … */
    real slow_tilt_s;
    real bias_s;  /* … and in which those that come back move into the gyroscope's bias [s]. */
    real heading_std;  /* Standard deviation of cosine and sine of an unknown heading. */
    real heading_memory_s;  /* Time in which a tag at rest forgets what little it knows of its heading [s]. */
    real heading_walk;  /* Random walk of both [1/√s]: the gyroscope's drift. */
    real acceleration_std_mps2;  /* Standard deviation of an acceleration's error: six degrees of tilt [m/s²] … */
    real acceleration_walk;  /* … and its random walk [m/s²/√s]. */
    real vertical_share;  /* Share of both variances for the vertical, which does not depend on tilt. */
    real sensor_noise;  /* Process noise of motion with a sensor whose heading is known [m²/s³] … */
    real headless_noise;  /* … and while it is not known. */
    real known_heading_variance;  /* Variance of the heading below which it is roughly known [rad²] … */
    /* … and below which it is well known, to five degrees: the gyroscope's bias is then learnt from its changes. */
    real sure_heading_variance;
    real speed_std_mps;  /* Standard deviation of the speed that wheels show, over a second [m/s] … */
    real speed_share;  /* … and the part that is a fraction of it. */
    /* Distance of the estimate from the point of linearisation, of ranges or phases, that moves the point [m]. */
    real held_step_m;
    /* The point stays within ``suspect`` standard deviations of the estimate, and within this distance [m]. */
    real held_max_m;
    real curvature_share;  /* Share of the stamps' variance below which the curvature of ranges is neglected. */
    /* Range at which distance-dependent errors are zero, and over which they reach their full size [m] (APS011). */
    real slope_from_m;
    /* Weight in the mean NIS, the share of rejected innovations and the mean square along axes: the last 50. */
    real forgetting;
    /* Mean NIS beyond which covariances are scaled by its square, phases are not used and a new start is abandoned,
     * once: it was wrong, for example because of late packets. */
    real wrong_nis;
    /* Weight in the shares of late receptions and of wild phases, and in the phases' noise: the last 200. */
    real slow_forgetting;
    real late_often_share;  /* Share of late receptions beyond which single receptions are often late. */
    /* Normalised innovation beyond which receptions are down-weighted if they are often late, or one has just jumped
     * (Huber 1964). */
    real reception_huber;
    real difference_huber;  /* The same for time differences, always. */
    real max_relays_rejected;  /* Count of recent relays beyond the gate that late packets may explain. */
    real lost_in_row;  /* Consecutive rejected packets, without single late ones, at which the state is wrong. */
    real lost_share;  /* Share of rejected innovations at which the state is wrong. */
    /* Normalised innovation beyond which a reception may be a jump and two of them differ by more than chance; also for
     * a running mean over its expectation, which then requires more process noise. */
    real suspect;
    /* Consecutive receptions of that kind that make a jump, and impossible ones that show a counter's restart … */
    real in_row;
    real in_row_where_late;  /* … and the number if single receptions are often late. */
    real together;  /* Sum of two such normalised innovations, reached by chance once in some million packets. */
    /* Factor on the process noise of a range error that has just jumped, as it may still be changing. */
    real first_change_scale;
    real ended_log_odds;  /* Sum of logarithms of odds for no range error at which an obstruction has ended … */
    /* … as it has once the range error is known to this, and within its standard deviation of zero [m]. */
    real ended_std_m;
    real obstructed_walk;  /* Spectral density of the random walk of a range error that has jumped [m²/s]. */
    real obstruction_memory_s;  /* Time constant of its return to zero, and of forgetting a jump [s]. */
    real obstruction_return_m;  /* Largest return in that time [m]: long delays are no less likely to stay. */
    real jump_rise;  /* Fraction of its full size by which a jump raises the process noise of all range errors. */
    real recent_jumps;  /* Fraction from which on the next jump is expected, and large innovations are down-weighted. */
    real obstructed_std_m;  /* Standard deviation by which all range errors change after jumps [m] … */
    real obstructed_s;  /* … and the time constant of that change [s]. */
    real place_step_m;  /* Length of a step [m]. */
    real place_first;  /* Number of comparisons that the stamps' noise counts for initially. */
    real place_samples;  /* Comparisons needed … */
    real place_memory;  /* … and remembered. */
    real place_min_m2;  /* Smallest variance between two steps that counts as multipath [m²]. */
    real place_kept;  /* Smallest correlation over a step, and smallest loss of correlation. */
    /* Largest standard deviation of the changing part of a range error, and of a pair's range after a jump [m]. */
    real max_change_std_m;
    /* Standard deviation of each coordinate of a misplaced anchor, and of a fault since the anchor joined [m] … */
    real lasting_std_m;
    real recent_std_m;  /* … of one that began recently without a visible jump [m] … */
    real creeping_std_m;  /* … and of one that grows for seconds [m]. */
    real recent_packets;  /* Packets of each anchor over which a fault is recent. */
    real creeping_s;  /* Time in which a creeping fault grows by a factor of e [s]. */
    /* Prior standard deviation of a fault that is added to the state, and of all faults at the start [m]. */
    real late_std_m;
    /* Test beyond which there is a fault: χ² with eight degrees of freedom has a probability of 4·10⁻⁸. */
    real sure_chi2;
    real early_weight;  /* Weight of what an early fault explains, as obstacles make packets late. */
    /* Standard deviation of the range between two anchors against the survey, before it is measured [m]. */
    real open_pair_std_m;
    real pair_relays;  /* Relays in each direction after which their mean is a range. */
    /* Number of such ranges beyond ``suspect``, more than at the other end, that mark an anchor as misplaced. */
    real misplaced_pairs;
    real start_age_s;  /* Older packets are not used for a start, unless the superframe is longer [s]. */
    /* Fraction of the mean range beyond which ranges are curved within a standard deviation, and updates would make the
     * filter overconfident in a wrong position. There is no level then, and no prediction. */
    real curved_std;
    /* Time for which a wide or contradicted start is withheld, as more anchors may be heard [s]. */
    real start_patience_s;
    /* Tail probability below which residuals contradict a start, and weight below which other positions are no
     * rivals. */
    real start_tail;
    /* Time for which a start is new [s]. Until then a start with open range errors is not repeated, and phases are not
     * used, as a position that still moves with the stamps' noise would turn the directions to the anchors. */
    real new_start_s;
    /* Factor on the start's covariance, as the filter then processes the packets that it was computed from. */
    real start_margin;
    /* Shorter silences hardly widen the state, and packets late by less are delayed by the radio [s]. */
    real short_silence_s;
    real longest_silence_s;  /* After a longer silence the state is worse than a new start [s]. */
    /* In longer superframes, where a new start takes seconds, a silence may widen the state more [s] … */
    real slow_superframe_s;
    real slow_curved_std;  /* … up to this fraction of the mean range … */
    /* … and a start, which goes back to the packets before, up to this multiple of it; otherwise up to 1. */
    real slow_start_std;
    /* In longer superframes a tag may move by metres: each round of packets is a start of its own [s]. */
    real longest_superframe_s;
    real heights_in_row;  /* Consecutive heights that do not fit at which the position is wrong. */
    real open_survey_std_m;  /* Standard deviation of each coordinate of an anchor after a contradicted start [m]. */
    real fitting_chi2;  /* χ² per anchor below which range errors agree with the settings. */
    real most_late;  /* Most late anchors at the start: on the floor or behind metal one often is. */
    real late_penalty;  /* Penalty on χ² for each of them: odds of 1 to 3. */
    /* Fraction of an anchor's lateness at the start that stays: its mean, and its standard deviation. */
    real staying_share;
    real window;  /* Ready-made time differences used to find a start … */
    real window_s;  /* … or those of this time [s]. */
    /* Differences that take longer than that find the start of a tag that may be moving; in them it is searched … */
    real moving_window;
    real moving_std_m;  /* … from places with this standard deviation [m] … */
    real moving_nis;  /* … and found where the mean NIS is below this … */
    real moving_apart;  /* … and that of no other place, summed, is within this. */
    real median_difference_std_m;  /* Standard deviation of the median of a pair's differences [m]. */
    real late_start_std_m;  /* Standard deviation of each anchor's error at the start, before any are estimated [m]. */
    /* Distance from which two positions are rivals; after it a moving tag is late to other anchors [m]. */
    real rival_m;
    /* Starts are within this height above and below anchors of different heights, unless bounds are given [m]. */
    real height_margin_m;
    /* A tag without beacons that is farther from the anchors' centre than this fraction of their diagonal is lost. */
    real neighbourhood;
    real most_horizontal_std_m;  /* Largest horizontal standard deviation of a fix [m]. */
    real zero_variance_m2;  /* Initial variance of a barometer's zero [m²]. */
    /* Time from a start until the tag's phases are used: by then constants of pairs of anchors are known [s]. */
    real phases_start_s;
    real phase_start_std_m;  /* Standard deviation of a phase until innovations show another [m] … */
    real phase_max_std_m;  /* … and its upper limit, unless the settings exceed it [m]. */
    real phase_mesh_std_m;  /* Standard deviation of a phase that an anchor measured of another [m]. */
    /* Change of an ambiguity by reflections as the tag walks, in variances of a phase per metre [1/m]. */
    real phase_wander;
    /* Fraction of a wavelength beyond which no innovation is used: near one half the sign is unknown. */
    real phase_gate;
    /* Largest standard deviation of a prediction that determines the cycle, as a fraction of a wavelength. */
    real phase_share;
    real phase_step_m;  /* Length of the steps by which reflections change phases [m]. */
    /* Largest standard deviation of a pair's constant at which its phases are used, and of one of these at which it
     * changes the constant, as a fraction of a wavelength. */
    real pair_share;
    real phases_nis;  /* Mean NIS beyond which all hypotheses on cycles are given up … */
    /* … and what is then added to the standard deviation of the position, or to that of an anchor's clock whose relays'
     * stamps contradict their phases: about a wavelength [m]. */
    real slip_std_m;
    /* Largest factor on the random walk of the tag's clock at which phases are taken at several cycles. */
    real phases_walk_scale;
    real most_cycles;  /* Number of cycles within the gate beyond which hypotheses on them are of no use. */
    /* Share of wild phases at a start: hypotheses are possible, but not for long if one looks wild. */
    real start_wild;
    real least_wild;  /* Share of wild phases that is expected at least, so that they can be found. */
    real most_wild;  /* Share beyond which hypotheses on cycles are misleading. */
    real unlikely_log_odds;  /* Logarithm of the odds against a hypothesis beyond which it is dropped. */
    /* Squared difference of two hypotheses, over the variance of each state, up to which they are merged. */
    real alike;
    real phase_walking_mps;  /* The same as ``walking_mps`` while phases may be taken at several cycles [m/s] … */
    real speed_memory_s;  /* … for the largest speed within this time [s]. */
    real phases_in_row;  /* Consecutive phases of an anchor beyond the gate at which its ambiguity restarts. */
    real uncovered_chi2;  /* Test beyond which faults exceed what levels cover. */
    /* Fraction of the mean range: a larger standard deviation has no level while all range errors are open. */
    real max_open_level_std;
    /* Time without a level after a contradicted start: several late anchors may agree on a wrong position [s]. */
    real contradicted_start_s;
    real probe_m;  /* Smallest distance from the anchors' plane at which its two sides are compared [m]. */
    /* Standard deviation of the best position on the other side about the mirror image, over that distance. */
    real shift_part;
    /* Squared difference over its variance from which two things differ: ranges of both sides, two starts, or the
     * explanations by faults of two anchors. */
    real apart_chi2;
    real sensor_valid_s;  /* Time for which a sensor's height decides between them [s]. */
} Tuning;

/* An anchor whose packets were accepted recently. */
typedef struct UsedAnchor {
    int32_t anchor;
    real position_m[3];
    int64_t rx_ticks;  /* Tag time of its last accepted packet. */
} UsedAnchor;

/* The history of the tag's starts, and the anchors in use. */
typedef struct Course {
    EstimatorSettings settings;  /* Settings of the next filter, as are the next four fields. */
    Tuning tuning;
    int32_t dim;
    real horizontal_k;
    real vertical_k;
    real superframe_s;  /* Superframe of slow sites, otherwise 0. */
    /* A filter starts with at most this many anchors: those of the start, nearest first. 0: with all. */
    int32_t most_anchors;
    /* Whether there is no position yet. While True the search is in use, otherwise the filter's state. */
    bool is_starting;
    real late_share;  /* Share of late packets that the last filter estimated. */
    int32_t misfit;  /* The anchor that was inconsistent with the others at the start. */
    real alone[12][3];  /* Rows of a fix that comes from a start alone, without a filter. */
    bool open_range_errors;  /* Whether the next start expects larger range errors than the settings state. */
    bool is_open;  /* Whether the last start did so. */
    bool start_was_contradicted;
    bool relays_may_contradict;
    bool may_begin_again;  /* Whether a start with a poor fit may be abandoned: not twice in a row. */
    int32_t heights_rejected;
    int64_t started_ticks;
    int64_t newest_ticks;
    real in_use_s;  /* An anchor counts as in use while its last accepted packet is younger than this. */
    int64_t checked_ticks;  /* Tag time of the last such check. */
    real extent_m;  /* Largest span of the anchors in use along x, y or z since the start. */
    int64_t changes;  /* Number of changes of the anchors in use or of their positions. */
    int32_t count;
    UsedAnchor used[MAX_ANCHORS];
    int64_t time_ticks;  /* Time of the newest fix, counted from the first one. */
} Course;

/* An anchor and its position. */
typedef struct Place {
    int32_t anchor;  /* Identifier. */
    real position_m[3];
    real std_m;  /* Standard deviation of each coordinate; if negative, that of the settings. */
    bool is_open;  /* Whether it joins with range errors beyond those of the settings. */
} Place;

/* A packet received by the tag, with unwrapped stamps. */
typedef struct Packet {
    Place place;
    int32_t sequence;
    int64_t rx_ticks;  /* RX time on the tag's clock. */
    int64_t tx_ticks;  /* TX time on the anchor's own clock. */
    real variance_factor;  /* Factor on the variance of the tag's reception. */
    bool has_phase;
    real phase_cycles;  /* Carrier phase as the tag received it, in [0, 1). */
    int32_t master;  /* Identifier of the anchor against whose clock this one reports its own; −1 without a report. */
    int64_t subticks;  /* The anchor's reading minus the master's at the packet's TX stamp, modulo 2⁴⁸. */
    real report_variance_m2;
    bool relays_have_phases;  /* Whether its frame carries phases in its relays, and therefore short stamps. */
} Packet;

/* One anchor's reception of another's packet. The listener is usually the sender of the packet with the relay. */
typedef struct Relay {
    int32_t listener;  /* Identifier of the receiving anchor. */
    int32_t anchor;  /* Identifier of the received anchor. */
    int32_t sequence;
    /* The listener's stamp: unwrapped, or only the lowest bits if it is short (``relay_rx_ticks``). */
    int64_t rx_ticks;
    bool is_short;
    bool has_phase;
    real phase_cycles;  /* Carrier phase as the listener received it, in [0, 1). */
} Relay;

/* The relays of a packet. */
typedef struct Relays {
    int32_t count;
    Relay rows[MAX_RELAYS];
} Relays;

/* A tag of protocol 2. */
typedef struct Tag {
    EstimatorSettings owner;  /* Settings chosen by the tag's owner; the site's pages state the rest. */
    Admission admission;
    SitePages pages;
    Course course;
    bool has_settings;  /* Whether the pages are known, so that the tag searches for a start or has a filter. */
    int64_t period_ticks;  /* Longest mean beacon period of an anchor when the settings were derived. */
    bool is_moving;  /* Whether anchors have stated other positions recently (``Neighbour.has_moved``). */
    int64_t moved_ticks;  /* Time of the last such statement. */
    bool uses_moved;  /* Whether the moved anchors are in use rather than the others. */
    int32_t origin_mm[3];  /* Origin of all positions, if ``HAS_ORIGIN``. */
    bool has_origin;
    /* Relays used of each beacon while there is a filter, newest first: fewer on a processor that falls behind. */
    int32_t most_relays;
    BeaconFields beacon;
    bool has_moved;  /* Whether its sender states another position than before. */
    Packet packet;  /* The beacon as the filter takes it. */
    Relays relays;
    int32_t events;  /* Its events (``COUNTER_JUMPED`` and others). */
} Tag;

/* Index of the first state of each block. */
typedef struct Layout {
    int32_t offset;  /* That of the first anchor; the others follow, as in all blocks. */
    int32_t velocity;
    int32_t rate;
    int32_t tx_noise;
    int32_t heading;
    /* These two exist only with a motion sensor; without, they equal ``ambiguity`` and are not used. */
    int32_t acceleration;
    int32_t ambiguity;
    int32_t mesh;  /* The last two exist only with phases; without, they equal ``change`` and are not used. */
    int32_t change;
    int32_t constant;
    int32_t slope;
    int32_t height;  /* In 2-D; in 3-D it is the position's third element. */
    int32_t zero;  /* In 3-D; in 2-D it equals ``slope`` and is not used. */
    int32_t survey;  /* ``dim`` states for each anchor. */
    int32_t end;
} Layout;

/* Counters and running means of the estimator. */
typedef struct Status {
    int64_t epoch_ticks;  /* Tag time of the newest packet. */
    int64_t start_ticks;  /* Tag time of the start. */
    int64_t faded_ticks;  /* Tag time when faults that are not lasting were last faded. */
    int64_t packets;
    int64_t accepted;
    int64_t rejected;
    int32_t rejected_in_row;
    int64_t stale;
    int32_t stale_in_row;
    int64_t impossible;
    int64_t relays_used;
    int64_t relays_rejected;
    int64_t reports_used;
    int64_t reports_rejected;
    int64_t clock_restarts;
    int64_t obstructions;
    int64_t faults_opened;
    real mean_nis;
    real mean_square_m2;  /* Mean square of innovations. */
    real rejected_share;
    real late_share;
    real relays_lately_accepted;  /* Running counts that fade. */
    real relays_lately_rejected;
    real lag[3];  /* Running mean of innovations along each axis. */
    real lag_square;
    real q_scale;  /* Factor on qa. */
    real common_mean;  /* Running mean of all innovations, which shows the tag's own clock. */
    real walk_scale;  /* Factor on its random walk. */
    int32_t place_samples;  /* Number of comparisons of range errors one step apart. */
    real place_square_m2[2];  /* Half the mean square of their differences after one and after two steps. */
    real place_variance_m2;  /* Variance of range errors by multipath; 0 if no larger than stated. */
    real place_distance_m;  /* Distance over which multipath changes. */
    real obstruction;  /* 1 if range errors have jumped recently, 0 if not. */
    real walked_m;
    real stationary_s;  /* Time since the tag last showed motion. */
    real stationary_m[3];  /* Its position then … */
    real stationary_m2[3];  /* … and the variance along each axis. */
    /* ``CONTRADICTED`` or ``UNAVAILABLE`` if levels are withheld from outside the filter, otherwise ``SOUND``. */
    int32_t withheld;
    int64_t height_ticks;  /* Tag time of the last height used from a sensor. */
    real plane_m[3];  /* A point of the plane that fits the anchors best. */
    real plane_normal[3];  /* Normal of that plane. */
    bool has_phases;  /* Whether phases are in use, so that there are ambiguities. */
    /* Whether relays are processed before the reception of the packet that brings them, the oldest first. */
    bool is_in_order;
    int64_t rate_ticks;  /* Tag time at which rates of clocks were compared. */
    int64_t rate_changes;
    real anchors_walk;  /* Random walk of the anchors' clocks by changes of their rates [m²/s³]. */
    real tag_walk;  /* The same of the tag's. */
    /* Square of the largest recent speed, with a memory of ``speed_memory_s``, while phases are in use. */
    real recent_square;
    /* Point at which phases are linearised: a position of the tag, moved from then on by its velocity alone. */
    real line_m[3];
    real step_m[3];  /* The tag's position after its last step … */
    real way_m;  /* … and the length of all steps: unlike ``walked_m`` it does not grow at rest. */
    real phase_variance_m2;  /* Variance of a phase, learnt from innovations. */
    real wild_share;  /* Running share of phases beyond the gate. */
    int64_t phases_used;
    int64_t phases_refused;
    int64_t phases_opened;  /* Ambiguities that began or restarted. */
    bool has_open_ranges;  /* Whether anchors join with range errors beyond those of the settings. */
    int32_t range_errors;  /* ``NO_RANGE_ERRORS``, ``CHANGING_RANGE_ERRORS`` or ``ALL_RANGE_ERRORS``. */
    real fault_std_m[3];  /* Prior standard deviation of each kind of faults. */
} Status;

/* A motion sensor's attitude and path since the newest packet, in a level frame with a heading of its own. */
typedef struct Motion {
    real lever_m[3];  /* Position of the antenna seen from the sensor, in the sensor's frame. */
    bool has_states;  /* Whether heading and acceleration are states. */
    bool is_level;  /* Whether the attitude is known but for the heading. */
    bool has_force;  /* Whether samples have a specific force; wheels have none. */
    bool is_used;  /* Whether the newest time update was one by a specific force. */
    bool has_effect;  /* Whether the newest time update was one by the sensor or its wheels. */
    real speed_nis;  /* Running mean of the NIS of speeds, over a second. */
    real wrong_s;  /* Time for which innovations have called for much process noise. */
    int64_t contradictions;  /* How often that has lasted long. */
    int64_t ignored_ticks;  /* Tag time until which the sensor is ignored for it. */
    int64_t ticks;  /* Tag time of the newest sample that turned the attitude. */
    int64_t speed_ticks;  /* Tag time of the newest speed of wheels, … */
    real speed_mps;  /* … along x of the sensor's frame. */
    int64_t used_ticks;  /* Tag time at which the path begins: that of the newest packet. */
    real attitude[4];  /* Quaternion w, x, y, z that turns the sensor's frame into the level one. */
    /* Quaternion that turned the first sample's frame into the level one; then that of the newest fix. */
    real level[4];
    real bias_rps[3];  /* Bias of the gyroscope. */
    /* Path at the newest sample, against a uniform motion with the antenna's velocity where it begins. */
    real position_m[3];
    real velocity_mps[3];
    real rate_rps[3];  /* The newest sample's rate, in the sensor's frame. */
    real force_mps2[3];  /* Its specific force, in the level frame. */
    real arm_m[3];  /* Position of the antenna against the sensor in the level frame … */
    real arm_mps[3];  /* … and its velocity. */
    real shown_m[3];  /* Path of the antenna since the newest packet … */
    real shown_mps[3];  /* … and the change of its velocity. */
    real up_mps2[3];  /* What a sensor at rest would show, for wheels. */
    real mean_mps2[3];  /* Running mean of the specific force. */
    real rest_s;  /* Time since the newest sample that showed motion. */
    real level_s;  /* Time over which the specific force has been averaged to find the level. */
    int64_t samples;  /* Samples that turned the attitude … */
    int64_t speeds;  /* … speeds of wheels … */
    int64_t late;  /* … those not in order, or too old when they came … */
    int64_t gaps;  /* … and gaps after which level and heading were looked for again. */
} Motion;

/* Hypotheses on the cycles of phases (``hypotheses``); their deviations from x are columns of V behind the faults.
 *
 * Arrays have one element more than is used, as there may be no hypotheses at all. */
typedef struct Hypotheses {
    int32_t count;  /* 1 if all cycles are certain; 0 as long as no phases are used. */
    real weight[HYPOTHESES + 1];
    /* Logarithms of the present weights, up to a constant; ``weight`` is as of the newest mean. */
    real log_weight[HYPOTHESES + 1];
    /* Number of hypotheses that follow from these by a phase, the most likely first, and what each consists of. */
    int32_t found;
    real new_log_weight[HYPOTHESES + 1];
    int32_t parent[HYPOTHESES + 1];
    real shift_m[HYPOTHESES + 1];
    real old[HYPOTHESES + 1];
} Hypotheses;

/* Record of an ambiguity beside its state. */
typedef struct Ambiguity {
    bool is_known;
    int32_t refused_in_row;  /* Consecutive phases beyond the gate. */
    int64_t ticks;  /* Tag time of its newest phase. */
} Ambiguity;

/* Record of an anchor beside its states. */
typedef struct Anchor {
    int32_t identifier;
    real position_m[3];
    int64_t tx_ticks;  /* Its newest packet's TX time, on its own clock. */
    int64_t rx_ticks;  /* Its newest packet's RX time, on the tag's clock. */
    int64_t offset_ticks;  /* Whole ticks of the offset. */
    real range_m;  /* Range at its newest packet. */
    real held_m[3];  /* Position at which ranges to it are linearised. */
    real held_range_m;  /* Range from there. */
    real walked_m;  /* The tag's walked distance at its newest packet. */
    bool is_relayed;  /* Whether others relay its packets. */
    bool has_rate;  /* Whether its clock's rate is known: the offset has been measured more than once. */
    bool has_tx_noise;  /* Whether its newest packet's TX noise is a state. */
    int64_t packets;
    real innovation;  /* Its newest innovation, normalised. */
    int32_t outliers_in_row;
    real outlier_m;  /* Innovation of the newest outlier. */
    bool is_obstructed;  /* Whether its range error has jumped and not returned. */
    real change_mean;  /* Running mean of its normalised innovations since then. */
    real change_scale;  /* Factor on the process noise of a range error that has jumped. */
    real ended_log_odds;  /* Sum of the logarithms of odds that it has returned to zero, since they began to show it. */
    bool has_fault;  /* Whether a lasting fault of it has been added to the state. */
    real relay_mean;  /* Running mean of its clock's normalised innovations in relays. */
    real walk_scale;  /* Factor on its oscillator's random walk. */
    real change_variance_m2;  /* Variance of the changing part of its range error. */
    int32_t place_steps;  /* Consecutive steps of the tag after which its range error was compared. */
    real place_walked_m;  /* The tag's walked distance at the newest step. */
    real place_residual_m[2];  /* Residuals of its receptions after the last two steps. */
    Ambiguity own;  /* Ambiguity of the tag's receptions of it. */
    Ambiguity mesh;  /* Difference between its clock as phases of relays show it and that of its stamps. */
    int64_t rate_offset_ticks;  /* Its offset when rates of clocks were compared … */
    real rate_offset_m;  /* … and the rest of it. */
    real mean_rate_mps;  /* Its mean rate from the comparison before. */
    int32_t rates;  /* Consecutive comparisons that it took part in. */
    /* Tag time up to which P contains the noise of its own clock, if relays are processed in order. */
    int64_t noise_ticks;
    real phase_way_m;  /* ``Status.way_m`` at its newest phase. */
} Anchor;

/* A packet that other anchors may relay. */
typedef struct KeptPacket {
    int32_t sequence;
    int64_t tx_ticks;
    int64_t rx_ticks;
} KeptPacket;

/* An ordered pair of anchors: listener and sender. */
typedef struct Link {
    int64_t tx_ticks;  /* Newest packet of the sender whose reception by the listener was processed. */
    int64_t relays;  /* Relays used in this direction. */
    real constant_m;  /* Estimated constant of the pair, in the row of the lower index … */
    real variance_m2;  /* … and its variance. */
    int32_t outliers_in_row;
    bool contradicts;  /* Whether its range contradicts the survey. */
    bool has_phase;  /* Whether the constant of phases in this direction has been measured … */
    real phase_m;  /* … its value modulo the wavelength … */
    real phase_variance_m2;  /* … and its variance. */
    int32_t phases_refused;  /* Consecutive phases beyond the gate. */
} Link;

/* The estimator's state of one tag. What loops run over comes first, so that its rows fill cache lines. */
typedef struct State {
    real x[STATES];
    real P[COVARIANCES];  /* Row by row, symmetric to the bit; see ``at``. */
    /* Sensitivity of x to faults: for each kind to each metre by which an anchor is received late, then to faults added
     * by planning; or the deviations of hypotheses on cycles. */
    real V[STATES][SENSITIVITIES];
    EstimatorSettings settings;
    Tuning tuning;
    real horizontal_k;  /* Standard deviations that cover the risk of the levels. */
    real vertical_k;
    int32_t dim;  /* Dimensions of the position: 2 if the height is given, otherwise 3. */
    int32_t count;  /* Number of anchors. */
    int32_t used;  /* Number of uncertain states; all covariances with others are zero. */
    int32_t n;  /* The same rounded up to a multiple of ``LANES``: the end of loops along rows of P. */
    int32_t rows;  /* Columns of V in use. */
    Layout layout;
    Status status;
    Motion motion;
    Hypotheses hypotheses;
    real information[FAULTS][FAULTS];  /* Information of the innovations on all faults, M; lower triangle. */
    real evidence[FAULTS];  /* Evidence of the innovations for all faults, y. */
    /* Covariance of the lasting faults, (M + I/σ_f²)⁻¹, as M grows without limit and 1/σ_f² would be lost in it. */
    real lasting_covariance[MAX_ANCHORS][MAX_ANCHORS];
    real lasting_m[MAX_ANCHORS];  /* Estimate of the lasting faults: that times y. */
    Anchor anchors[MAX_ANCHORS];
    KeptPacket packets[MAX_ANCHORS][PACKETS_KEPT];
    Link links[MAX_ANCHORS][MAX_ANCHORS];  /* By listener and sender. */
    int32_t terms;  /* Terms of the current measurement, in ``h``. */
    real h[20];  /* Nonzero elements of the current measurement, at the indices in ``h_index``. */
    int32_t h_index[20];
    int32_t waiting;  /* Queued updates, not yet in P and V: a packet's relays are applied together. */
    real U[MOST_WAITING][STATES];  /* u = P·h/√S of each queued update, then P·h of the current measurement. */
    /* Fault inputs over √S of each queued update, then those of the current measurement. */
    real G[MOST_WAITING][SENSITIVITIES];
    real shows_faults[MOST_WAITING];  /* 1 for queued updates by measurements that show faults, and 0 for the others. */
    real work[WORK_ROWS][MAX_ANCHORS];  /* Scratch for systems of equations of all faults of one kind. */
    real levels[5];
    real fix[12][3];  /* Rows of a fix (``POSITION`` and the following). */
} State;

/* A TX time on a scale common to packets of several anchors. */
typedef struct ScaledTime {
    int64_t ticks;
    real fraction_ticks;
    real variance_m2;
} ScaledTime;

/* A received packet with the relays that it carried. */
typedef struct HeardPacket {
    Packet packet;
    int32_t relay_count;
    Relay relays[RELAYS_KEPT];
    ScaledTime scaled;  /* TX time on the common scale of the current attempt. */
} HeardPacket;

/* An anchor's two newest packets. */
typedef struct HeardAnchor {
    int32_t count;
    int64_t fitted_ticks;  /* Tag time when the anchor was last on the common scale with a plausible clock rate. */
    HeardPacket older;
    HeardPacket newer;
} HeardAnchor;

/* Listener's clock minus sender's clock at the tag's time ``rx_ticks_tag``. */
typedef struct ClockLink {
    int32_t listener;
    int32_t sender;
    int64_t rx_ticks_tag;
    int64_t ticks;
    real fraction_ticks;
} ClockLink;

/* A start: the first position and its covariance. */
typedef struct Start {
    int64_t rx_ticks_tag;
    int32_t count;
    int32_t used[MAX_ANCHORS];  /* Indices into ``heard`` of the anchors used. */
    real position_m[3];
    real covariance_m2[3][3];
    bool is_contradicted;  /* Whether the packets of all anchors are inconsistent with each other. */
    bool has_misfit;
    int32_t misfit;  /* The excluded anchor; the others agree without it. */
} Start;

/* Tree of links that lead from each anchor's clock to the reference anchor's. */
typedef struct Reach {
    int32_t count;
    int32_t order[MAX_ANCHORS];  /* Pairs in breadth-first order; the first is the reference. */
    int32_t is_reached[MAX_ANCHORS];
    int32_t parent[MAX_ANCHORS];
    int32_t link[MAX_ANCHORS];
    int32_t sign[MAX_ANCHORS];
} Reach;

/* A local minimum of the cost, in the problem's axes. */
typedef struct Minimum {
    int32_t iterations;
    real cost;
    real chi2;  /* rᵀΣ⁻¹r, even if the cost is not weighted by Σ⁻¹. */
    real state[3];
    real covariance[10];  /* Lower triangle; zeros for a given height. */
} Minimum;

/* A set of TDoAs ``tdoa_m[i] = |p − anchors_m[i + 1]| − |p − anchors_m[0]|``, and the state of its solution. */
typedef struct LocateProblem {
    int32_t anchors;
    bool knows_height;
    bool is_weighted;
    bool has_bounds;  /* Whether the height is between ``low_m`` and ``high_m``. */
    real height_m;
    real low_m;
    real high_m;
    real residual_tail;  /* Residuals with a smaller tail probability are not noise. */
    real anchors_m[MAX_ANCHORS][3];  /* The reference first; ``choose_axes`` transforms them into its axes. */
    real tdoa_m[MAX_ANCHORS];
    real covariance[TRIANGLE];  /* Lower triangle of Σ, later of its factor L. */
    int32_t kind;
    int32_t dims;  /* Number of unknowns. */
    real extent_m;  /* Distance of the farthest anchor from the reference. */
    real origin_m[3];
    real axes[3][3];  /* In rows; a position is origin + axesᵀ·state. */
    real scale[3];  /* Scale of each unknown: the extent, or its square for s. */
    int32_t start_count;
    int32_t minimum_count;
    real starts[9][3];
    Minimum minima[9];  /* Ascending in cost. */
    int32_t iterations;
    real state[3];
    real trial[3];
    real step[3];
    real system[MAX_ANCHORS][4];  /* Rows [∂TDoA/∂state, measured − predicted]. */
    real normal[10];  /* Lower triangle of systemᵀ·system. */
    real next_normal[10];
    real factor[10];
} LocateProblem;

/* A position and its uncertainty. Metres, site frame. */
typedef struct Found {
    bool has_mirror;
    int32_t dof;
    int32_t iterations;
    real chi2;
    real position_m[3];
    real mirror_m[3];  /* The other position that fits equally well. */
    real covariance_m2[3][3];
    real residuals_m[MAX_ANCHORS];  /* Measured minus predicted TDoAs. */
} Found;

/* Gathers packets until a start is possible. */
typedef struct Acquisition {
    bool knows_height;
    real height_m;
    bool has_bounds;
    real low_m;
    real high_m;
    real variance_m2;  /* Variance of a TX and an RX timestamp together. */
    real max_age_s;
    real start_age_s;  /* Packets that are older are used only for rates. */
    real speed_std_mps;  /* Assumed standard deviation of the tag's speed. */
    real error_variance_m2;  /* Variance of survey and range errors. */
    Tuning tuning;
    int32_t count;
    HeardAnchor heard[MAX_ANCHORS];  /* In the order in which they were first heard. */
    int32_t link_count;
    ClockLink links[MAX_LINKS];
    bool has_been_wide;
    int64_t wide_ticks;  /* Time of the first start that was too wide to use. */
    bool is_contradicted;
    int64_t contradicted_ticks;  /* When packets first contradicted each other. */
    /* Number of anchors when two positions last fitted equally well; the same number is retried once a superframe. */
    int32_t rival_count;
    Start start;
    int32_t pair_count;
    int32_t pairs[MAX_ANCHORS];  /* Indices into ``heard`` of the anchors with two packets. */
    real rates[MAX_ANCHORS];
    real rate_variances[MAX_ANCHORS];
    /* Rate of the tag's clock against the common scale, measured with each anchor; ``_solve_start`` sorts them. */
    real clock_rates_mps[MAX_ANCHORS];
    Reach reach;
    Reach best;
    Start found_alone;
    real ranges_m[MAX_ANCHORS];
    real variances_m2[MAX_ANCHORS];
    LocateProblem problem;
    Found found;
} Acquisition;

/* Candidates for each page of an issue. */
typedef struct Choices {
    int32_t counts[4];
    int32_t places[4][MAX_PAGES];  /* Their rows in the table, those of most anchors first. */
    int32_t chosen[4];
} Choices;

/* A matrix A of few columns; ``orthogonalise`` replaces it by A·V, whose columns are orthogonal. */
typedef struct Columns {
    int32_t rows;
    int32_t columns;
    real A[MAX_ROWS][4];
    real V[4][4];  /* A rotation; its columns are the right singular vectors of A. */
    real squares[4];  /* Squares of the singular values, the largest first. */
} Columns;

/* The linear equations of a closed-form start. */
typedef struct Equations {
    Columns left;
    real right[MAX_ANCHORS];  /* Right-hand side: (|a_i|² − d_i²)/2, less the contribution of a given height. */
    real u[4];
    real v[4];
} Equations;

/* What a filter starts from. */
typedef struct Beginning {
    Start start;
    int32_t count;
    HeardPacket packets[MAX_BEGINNING];  /* In order of reception. */
} Beginning;

/* A packet of a batch. */
typedef struct BatchPacket {
    int32_t place;  /* Index of its anchor in the table of places. */
    int32_t sequence;
    int64_t rx_ticks;
    int64_t tx_ticks;
    real variance_factor;
    bool has_phase;
    real phase_cycles;
    int32_t end;  /* End of its relays in their table; they begin at the end of the previous packet's. */
} BatchPacket;

/* The state after a packet of a batch. */
typedef struct BatchRow {
    real position_m[3];
    real velocity_mps[3];
    real covariance_m2[3][3];
    real levels[5];  /* As written by ``protect``, if requested. */
    int32_t integrity;
    int32_t outcome;
} BatchRow;

/* A message of a superframe. */
typedef struct PlannedMessage {
    int32_t anchor;  /* Index of its anchor in the state; −1 if the tag does not receive it. */
    int64_t gap_ticks;  /* Time since the previous message. */
    real share;  /* Share of its anchor's messages that arrive. */
    real late_m;  /* Delay by walls. */
    int32_t end;  /* End of its relays in their table; they begin at the end of the previous message's. */
} PlannedMessage;

/* A relay carried by a message. */
typedef struct PlannedRelay {
    int32_t sender;  /* Index of the received anchor; −1 if the tag does not receive it itself. */
    real age_s;
    real share;  /* Share of these receptions that reach the tag. */
    real late_m;
} PlannedRelay;

/* Sums over the fixes of a superframe, each weighted by the share of its message that arrives. */
typedef struct SteadyState {
    real fixes;
    real variance_m2[3];  /* Variance of each axis as the filter claims it. */
    real square_bias_m2;  /* Squared error caused by walls. */
    real motion_m2[3];  /* Contribution of accelerations to the variance of each axis, for one fix. */
} SteadyState;

SKYLESS_EXPORT int32_t skyless_unwrap_stamp(Neighbours *t, int32_t anchor, int32_t sequence, int64_t tx_counter, int64_t
        rx_ticks, int64_t period_ticks);
SKYLESS_EXPORT int32_t skyless_read_frame(uint8_t *frame, int32_t length, BeaconFields *b);
SKYLESS_EXPORT void skyless_restart(State *s, int64_t rx_ticks, real late_share, real fault_std_m, bool
        has_open_ranges);
SKYLESS_EXPORT int32_t skyless_find_anchor(State *s, int32_t identifier);
SKYLESS_EXPORT int32_t skyless_add_anchor(State *s, int32_t identifier, real *position_m, real std_m, bool is_open);
SKYLESS_EXPORT void skyless_fit_plane(State *s);
SKYLESS_EXPORT bool skyless_hear_wheels(State *s, int64_t ticks, real *rate_rps, real speed_mps);
SKYLESS_EXPORT bool skyless_hear_motion(State *s, int64_t ticks, real *rate_rps, real *force_mps2);
SKYLESS_EXPORT void skyless_leave(State *s, int32_t identifier);
SKYLESS_EXPORT int32_t skyless_process_frame(State *s, Packet *packet, Relays *relays, uint8_t *packed, int32_t
        packed_bytes);
SKYLESS_EXPORT int32_t skyless_process_difference(State *s, Place *a, Place *b, int64_t rx_ticks, real difference_m);
SKYLESS_EXPORT int32_t skyless_process_height(State *s, real height_m, real std_m, bool is_barometer);
SKYLESS_EXPORT void skyless_track(State *s, Place *places, BatchPacket *packets, Relay *relays, BatchRow *rows, int32_t
        count, bool has_levels);
SKYLESS_EXPORT void skyless_find_steady_state(State *s, PlannedMessage *messages, PlannedRelay *relays, int32_t count,
        int32_t most, int32_t step, SteadyState *found);
SKYLESS_EXPORT void skyless_find_walked(State *s, PlannedMessage *messages, PlannedRelay *relays, int32_t count, int32_t
        at_rest, real *velocity_mps, int32_t walked, SteadyState *found);
SKYLESS_EXPORT void skyless_process_known(State *s, int32_t sender, int64_t rx_ticks, real *position_m, uint8_t *known,
        int32_t first, real elapsed_s, real walked_m);
SKYLESS_EXPORT int32_t skyless_find_position(LocateProblem *p, Found *found);
SKYLESS_EXPORT void skyless_begin_course(Course *c, Acquisition *q);
SKYLESS_EXPORT void skyless_begin_again(Course *c, State *s, Acquisition *q);
SKYLESS_EXPORT int32_t skyless_follow(Course *c, State *s, Acquisition *q, FixTime *time, Packet *packet, Relays
        *relays, uint8_t *packed, int32_t packed_bytes);
SKYLESS_EXPORT int32_t skyless_admit_sender(Admission *a, int32_t site, int32_t anchor, int64_t rx_counter, real
        host_s);
SKYLESS_EXPORT int32_t skyless_admit_stamp(Admission *a, int32_t anchor, int32_t sequence, int64_t tx_counter, int64_t
        period_ticks);
SKYLESS_EXPORT void skyless_begin_tag(Tag *t, int32_t site, real qa, real lowest_m, real highest_m, real height_std_m,
        real integrity_risk, real alert_limit_m);
SKYLESS_EXPORT void skyless_wake(Tag *t, State *s, Acquisition *q, int64_t rx_counter, real slept_s);
SKYLESS_EXPORT int32_t skyless_hear_frame(Tag *t, State *s, Acquisition *q, uint8_t *frame, int32_t length, int64_t
        rx_counter, real host_s, real rx_power_dbm, real first_path_power_dbm, real phase_cycles);
SKYLESS_EXPORT int32_t skyless_hear_fields(Tag *t, State *s, Acquisition *q, uint8_t *frame, int64_t rx_counter, real
        host_s, real rx_power_dbm, real first_path_power_dbm, real phase_cycles);

#endif
