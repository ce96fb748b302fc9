/* Made by tools/make_core.py from these modules; do not edit.

 * skyless.core.air.almanac
 * skyless.core.air.beacon
 * skyless.core.air.frame
 * skyless.core.air.neighbours
 * skyless.core.air.site_choice
 * skyless.core.air.site_pages
 * skyless.core.estimator.faults
 * skyless.core.estimator.kalman
 * skyless.core.estimator.levels
 * skyless.core.estimator.measurements
 * skyless.core.estimator.monitor
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
/* By which another anchor must be stronger to replace the weakest. */
#define BETTER_DB REAL(3.0)
/* Difference of powers in dB at which the factor starts to rise and at which it is greatest: the maker's 6 and 10, plus
 * 1 dB. Lines of sight of the UTIL data set reach 8.4 dB; paths through metal, the only ones much later, start at 11.3. */
#define BLOCKED_DB REAL(11.0)
#define BOUND_SIGMAS REAL(3.0)
#define BROADCAST 65535
/* After which silence an anchor leaves the estimator at least, where tags move from cell to cell. */
#define CELL_DROP_S REAL(1.0)
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
/* Two stamps in a row that go back farther than radios and hosts reorder them mean that the tag's own counter has
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
/* Whole cycles of each channel's carrier fit into this number of ticks: ``EstimatorSettings.carrier_cycles``. */
#define CYCLE_TICKS 128
#define DB_PER_LOG REAL(8.685889638065035)
/* DX_TIME ignores its low nine bits: transmissions start on 8.013 ns boundaries (DW1000 User Manual, p. 26). */
#define DELAYED_TX_GRANULARITY_TICKS 512
/* Columns are not independent if their smallest singular value is below this part of the largest. */
#define DEPENDENT REAL(1e-06)
#define DISTINCT_MINIMA_CHI2 REAL(9.0)
#define DIVERGED 2
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
/* Where ``protect`` writes the tests of all kinds of faults, after ``HPL`` and ``VPL``. */
#define FIRST_TEST 2
#define FIX 20
/* Length of the fields that every beacon has. */
#define FIXED_BYTES 20
#define FLAGS_AT 11
#define FLAT REAL(1e-09)
/* Flight times differ between anchors by less than this (300 m). */
#define FLIGHT_SLACK_TICKS 63898
#define FOREIGN 0
#define FOREIGN_SITE 5
#define FOUND 0
/* Data frame, PAN identifier compressed, 16-bit addresses. */
#define FRAME_CONTROL 34881
#define FREE 0
#define GAIN_TOLERANCE REAL(1e-13)
#define GEOREFERENCE_PAGE 4
#define HAS_AUTHENTICATION 4
#define HAS_CERTIFICATE 8
/* Whether positions are from whole metres near the first anchor, as far ones lose millimetres in single precision. */
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
#define HEARD_BYTES 8
#define HEIGHT 1
/* Offset of the flags in a site page; the height follows. */
#define HEIGHT_FLAG_AT 8
/* Flag of a site or schedule page that states the height of the tags. */
#define HEIGHT_GIVEN 1
#define HOST_JUMPED 2
#define HPL 0
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
/* Numbers in a vector of 256 bits, where rows of P begin at one. */
#define LANES (PACKED ? 1 : 4)
/* Metres, or m²: anything beyond is no site, and no number here overflows before it. */
#define LARGEST REAL(1000000000.0)
#define LASTING 0
/* A year of ticks, whose differences fit 64 bits; a host's clock that jumps by more was set. */
#define LAST_TICKS INT64_C(2305843009213693952)
/* Numbers that ``levels.protect`` writes: ``HPL``, ``VPL``, and the tests of all kinds of faults. */
#define LEVELS 5
#define LIGHT_2 REAL(8.987551787368176e+16)
/* The leading bits of ln 2: products with small whole numbers are exact. */
#define LN_2_HIGH REAL(0.6931471803691238)
#define LN_2_LOW REAL(1.9082149292705877e-10)
#define LOG_FACTOR REAL(3.58351893845611)
/* No jump of a host's clock counts as a longer one: the ticks of three years fit 64 bits. */
#define LONGEST_JUMP_S REAL(100000000.0)
/* 4 s: a gap of one and a half periods is shorter than half a wrap of a counter. */
#define LONGEST_PERIOD_CODE 159
/* The longest time update: of more, squares of variances are no numbers in single precision. */
#define LONGEST_S REAL(1000.0)
#define LOST 22
/* Its exponential counts as 0. */
#define LOWEST REAL(-700.0)
#define MAGIC_MASK 61695
/* The bytes are no beacon; the fault's number is added. */
#define MALFORMED 40
/* Factor on all standard deviations, as errors are not quite Gaussian and figures not quite the filter's. */
#define MARGIN REAL(1.05)
/* Most anchors at a time. */
#ifndef MAX_ANCHORS
#define MAX_ANCHORS 32
#endif
/* Most anchors in the estimator's state; more cost accuracy, as each then sends less, and time. */
#ifndef MAX_ANCHORS_IN_USE
#define MAX_ANCHORS_IN_USE 24
#endif
#define MAX_BEGINNING (2 * MAX_ANCHORS)
/* Coordinates and heights beyond 1000 km from the origin are errors; a page has 32-bit millimetres, ±2147 km. */
#define MAX_COORDINATE_MM 1000000000
/* Most anchors of each that are counted. */
#ifndef MAX_COUNTED
#define MAX_COUNTED 32
#endif
/* Magnitude above which a value is not a valid power. */
#define MAX_DIFFERENCE_DB REAL(1000.0)
/* Two clocks cannot drift apart faster: each within 20 ppm (IEEE 802.15.4-2015, 16.4.9), and room for motion. */
#define MAX_DRIFT REAL(5e-05)
#define MAX_FAULTS 2
/* Longest PSDU (IEEE 802.15.4-2015, aMaxPhyPacketSize). */
#define MAX_FRAME_BYTES 127
/* Largest number of entries that the count and the flags of ``heard`` can hold. */
#define MAX_HEARD 12
#define MAX_ITERATIONS 200
#define MAX_LINKS (MAX_ANCHORS * (MAX_ANCHORS - 1))
/* Most anchors that are known by their own beacons. */
#ifndef MAX_NEIGHBOURS
#define MAX_NEIGHBOURS 256
#endif
/* 2⁻¹⁹ as a float32; non-negative float32 values are ordered by their bits. */
#define MAX_NOISE_BITS 905969664
/* Pages of issues that are not complete. */
#ifndef MAX_PAGES
#define MAX_PAGES 64
#endif
/* No radio reports more, nor less than its negative. */
#define MAX_POWER_DBM REAL(1000.0)
#define MAX_RATE_MPS REAL(29979.2458)
/* Most relays with a packet; 13 fit into a frame. */
#ifndef MAX_RELAYS
#define MAX_RELAYS 32
#endif
#define MAX_ROWS (MAX_ANCHORS)
/* Anchors by whose number one page is preferred to another. */
#ifndef MAX_SENDERS
#define MAX_SENDERS 16
#endif
/* Most sites of which anchors are counted. */
#ifndef MAX_SITES
#define MAX_SITES 8
#endif
#define MAX_STARTS 9
/* Longest superframe: under half a wrap of the counter (8.6 s), as stamps would become ambiguous. */
#define MAX_SUPERFRAME_TICKS INT64_C(549755813887)
/* Rotations of all pairs of columns; they converge quadratically, with four columns after about six. */
#define MAX_SWEEPS 12
#define MAX_TRIALS 256
/* Factor on the variance of a blocked path: metal delayed messages by 0.2 to 0.4 m, 4 to 8 times the noise. */
#define MAX_VARIANCE_FACTOR REAL(36.0)
#define MERGED_SIGMAS REAL(2.0)
/* With fewer anchors no majority counts, unless the tag receives no more for ``PRESENT_TICKS``. */
#define MIN_ANCHORS 3
#define MIN_DAMPING REAL(0.0001)
/* An anchor that relays this number of receptions of anchors in use, and they fit, is there. */
#define MIN_FITTING 2
#define MIRROR 7
#define MM_PER_M 1000
/* A larger share of late packets counts as this. */
#define MOST_LATE REAL(0.45)
/* Most updates of the filter that wait. */
#ifndef MOST_WAITING
#define MOST_WAITING 8
#endif
#define MOVED_ANCHOR 31
#define MOVED_HOLD_TICKS INT64_C(19169280000)
/* A survey moves all anchors of a site, some of them seconds after the others, and positions from before and after it
 * must not be mixed. So a tag uses either the anchors that have stated another position or those that have not, until none
 * has moved for ``MOVE_TICKS``. It switches to the moved ones once they are the majority and none has moved for
 * ``MOVED_HOLD_TICKS``. */
#define MOVE_TICKS INT64_C(638976000000)
/* A smaller square of a distance counts as this. */
#define NEAREST_M2 REAL(1e-18)
/* Earlier than any reading. */
#define NEVER (INT64_C(-4611686018427387904))
/* The logarithm is concave, and the first z too large: each step doubles the right digits. */
#define NEWTON_STEPS 10
/* The identifier of no anchor. */
#define NOBODY (-1)
#define NOISE_KIND 0
#define NOISE_PAGE 3
/* 0.3 m allow for the noise of two stamps of one anchor. */
#define NOISE_TICKS 64
/* Assumed power at 1 m where the radio reports none, so that nearer anchors count as stronger. */
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
/* Columns are orthogonal if the cosine of their angle is not larger. */
#define ORTHOGONAL REAL(1e-14)
#define OTHER_PAGES 1
#define OTHER_SETTINGS 2
#define OUTLIER 21
#define OUT_OF_ORDER 2
/* Whether P is kept as its lower triangle alone: half the memory, but rows that vectors do not fit. */
#ifndef PACKED
#define PACKED false
#endif
/* Packets of each anchor that are kept for relays to come; divides the range of sequence numbers. */
#ifndef PACKETS_KEPT
#define PACKETS_KEPT 16
#endif
/* A type, then 16 bytes of contents. */
#define PAGE_BYTES 17
#define PAGE_KINDS 4
#define PHASE_BEGINS 0
#define PHASE_REFUSED 1
/* States of each anchor for carrier phases; 0 where they are not used. */
#ifndef PHASE_STATES
#define PHASE_STATES 3
#endif
/* Phase steps in a cycle; also the bit that marks the presence of a phase. */
#define PHASE_STEPS 128
#define PHASE_USED 2
/* A comparison of range errors counts as this many times their mean at most, as jumps are not multipath. */
#define PLACE_LIMIT REAL(2.0)
#define PLACE_LIMITED_MEAN REAL(0.7421917)
#define PLANE 2
/* Columns of V for what planning adds: walls, and four impulses along each axis. */
#ifndef PLANNED_FAULTS
#define PLANNED_FAULTS 13
#endif
/* The position, then three rows of its covariance. */
#define POSITION 0
#define POSITION_BYTES 12
/* Weight of the newest value in the running mean of an anchor's received power. */
#define POWER_GAIN REAL(0.1)
/* Anchors received within this time count. */
#define PRESENT_TICKS INT64_C(63897600000)
#define PROTECTED_ROWS 10
/* The first three of the levels (``estimator/levels.py``), for methods that know some. */
#define PROTECTION 9
/* Chi-square and mean squared residual in m². */
#define QUALITY 4
#define RECENT 1
#define REJECTED 0
/* How long a reception confirms its sender, if received by an anchor in use or by one that is confirmed itself. */
#define RELAYED_TICKS INT64_C(127795200000)
/* Relays of each packet that are kept for the filter which begins. */
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
/* What rounding in single precision may make of a variance of lasting faults that is smaller. */
#define ROUNDING_M2 REAL(1e-07)
/* Variance of rounding to whole ticks. */
#define ROUNDING_S2 REAL(2.0410312834001283e-23)
#define SAME_PAGES 0
#define SAME_POINT REAL(1e-06)
#define SCHEDULE_PAGE 2
#define SEARCHING 26
/* Capacity for columns of V. */
#define SENSITIVITIES (FAULTS + AXES + PLANNED_FAULTS)
/* Whether the search for a start uses the memory of the state, which is not used meanwhile. */
#ifndef SHARES_MEMORY
#define SHARES_MEMORY false
#endif
/* Time between two packets of an anchor at least: a frame takes longer. */
#define SHORTEST_S REAL(5e-05)
/* Bits of the stamp of such an entry. */
#define SHORT_BITS 32
/* The highest bit of four bytes; as a float32 on its own it is −0. */
#define SIGN INT64_C(2147483648)
#define SINGULAR 5
/* A pivot below this part of its diagonal element is rounding noise: the matrix is singular. */
#define SINGULAR_PIVOT REAL(1e-12)
#define SITE_CHANGED 4
#define SITE_KIND 3
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
#define STATES (2 * (AXES + MAX_ANCHORS) + (3 + PHASE_STATES + AXES) * MAX_ANCHORS + 2)
#define STD_STEPS_PER_M 10000
#define STEPS 16
#define STEPS_PER_M 100
/* Units of an accuracy page: standard deviations, distance, time. */
#define STEPS_PER_S 10
#define STEP_TOLERANCE REAL(1e-10)
/* Parts of a tick; the air's unit of the site's time, of which beacons carry 48 bits. */
#define SUBTICKS 256
#define SUBTICK_MASK INT64_C(281474976710655)
/* Silences up to this need no check of the filter. */
#define SURELY_IN_REACH_TICKS INT64_C(6389759999)
/* Of Jacobi's rotations: each squares what is left off the diagonal. */
#define SWEEPS 8
#define TERMS 60
#define THIN_SIGMAS REAL(0.1)
/* Width of the timestamp counter (DW1000 User Manual v2.12, 7.2.8); it wraps every 17.2074 s. */
#define TICK_BITS 40
/* What light travels in one tick, 4.692 mm. */
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
/* The velocity, then three rows of its covariance, for methods that know it. */
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

/* Turns one counter's wrapped stamps into int64 ticks that never wrap (``unwrap``). */
typedef struct Unwrapper {
    int32_t bits;  /* Width of the counter, 62 at most. */
    bool has_stamp;
    int64_t last_ticks;
    real last_host_s;  /* NaN where no stamp has had a host time. */
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
    int32_t site;  /* PAN identifier of the site in use. */
    int64_t heard_ticks;  /* RX stamp of its last accepted beacon. */
    int64_t since_ticks;  /* RX stamp of the beacon at which it was chosen. */
    bool has_fix;
    int64_t fix_ticks;  /* RX stamp of the last fix. */
    int32_t failed_count;
    int32_t failed[MAX_SITES];  /* Sites left since the last fix because they gave none, newest last. */
    int32_t count;
    CountedSite sites[MAX_SITES];
} SiteChoice;

/* Counts from the first fix of a receiver and never goes back, even if the master or the method changes. */
typedef struct FixTime {
    bool has_fix;
    int64_t first_ticks_master;
    int64_t last_ticks_master;
    int64_t last_rx_ticks_tag;
} FixTime;

/* What a tag knows of its own counter, of sites and of anchors. */
typedef struct Admission {
    Unwrapper own;
    Unwrapper former;  /* ``own`` before the frame at hand, restored where that is not admitted. */
    /* Whether the stamp of the newest frame is from before others by more than ``COUNTER_JUMP_TICKS``. */
    bool went_back;
    SiteChoice choice;
    FixTime time;
    Neighbours neighbours;
    int64_t rx_ticks;  /* The tag's stamp of the frame at hand, unwrapped. */
    int32_t events;  /* What has happened since its owner last looked. */
} Admission;

/* What the filter assumes; standard deviations are one sigma. */
typedef struct EstimatorSettings {
    real qa;  /* Spectral density of the tag's acceleration, m²/s³ per axis. */
    /* Standard deviation of the tag's speed at the start. It smears pseudoranges, which are not taken at once. */
    real start_speed_std_mps;
    real white;  /* White frequency noise of each oscillator, m²/s. */
    real walk;  /* Random walk of each oscillator's rate, m²/s³. */
    real tx_variance_m2;
    real rx_variance_m2;  /* Variances of one stamp each. */
    real gate;  /* Innovations beyond this number of standard deviations are not used. */
    real height_m;  /* Height of the tag where it is given; NaN to estimate it. */
    real height_std_m;  /* Standard deviation of the given height. */
    real lowest_m;
    real highest_m;  /* Bounds of the tag's height. */
    /* Cycles of the carrier in 128 ticks, 13 of channel 5, whose phases count where packets have them; 0: never. */
    int32_t carrier_cycles;
    real phase_std_m;  /* Least standard deviation of a phase as the tag measures it. */
    real phase_wander;  /* What reflections at least change in the phases of an anchor as the tag walks, m²/m. */
    real drop_s;  /* Anchors that are silent for longer leave the state. */
    real relay_age_s;  /* Older packets are not relayed, as sequence numbers come around. */
    real survey_std_m;  /* Standard deviation of each coordinate of an anchor. */
    real range_std_m;  /* Standard deviation of the constant error of a tag's ranges to one anchor. */
    /* Standard deviation of the constant error of the range between two anchors.
     *
     * It is not used where survey and ranges are exact. */
    real pair_std_m;
    real slope_std_m;  /* By how much ranges lengthen for each unit of clip((range − 4 m)/4 m, −1, 1). */
    /* Standard deviation of the part of a range's error that changes as the tag moves (the site file's name). */
    real place_std_m;
    real place_distance_m;  /* Distance over which that part changes. */
    real place_time_s;  /* Time over which that part changes while the tag is stationary. */
    /* Time within which the size of each anchor's changing part is estimated again; 0 where it is ``place_std_m``. */
    real change_memory_s;
    /* Random walk of a barometer's zero, m²/s: 5 cm in ten seconds, as where doors and windows are opened. */
    real barometer_walk;
    real least_change_std_m;  /* No changing part is estimated to be smaller. */
    real earliest_m;  /* No changing part is below this: obstacles only lengthen ranges. */
    real difference_std_m;  /* Standard deviation of each ready-made time difference. */
    real stationary_s;  /* A tag that has not shown any motion for this time counts as stationary; 0: never. */
    real max_acceleration_mps2;  /* The tag's largest acceleration, as far as levels are to cover it beyond ``qa``. */
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

/* Constants of the estimator, which are the same at every site; ``docs/estimator_table.md`` says what each buys.
 *
 * Normalised: over its standard deviation. A running mean's weight is that of the newest value. */
typedef struct Tuning {
    real restart_m;  /* Paths that change by more than this between packets are impossible [m]. */
    /* Factor on the random walk of the tag's oscillator at a start: it warms up after it was switched on. */
    real start_walk_scale;
    /* Weight in running means of normalised innovations (along each axis, of all anchors, of an anchor's relays), and
     * loss of the counts of recent relays with each packet. */
    real mean_gain;
    real noise_growth;  /* Growth of adapted process noise with each innovation that calls for more … */
    /* Largest factor on the random walk of a clock, and that of the tag's once all innovations are on one side. */
    real max_walk_scale;
    real noise_loss;  /* … and its factor with each other one. */
    /* Normalised innovations of all anchors beyond this on one side: the tag's clock has left its rate. */
    real common;
    /* Number of relays of a pair in a row beyond the gate that show that its path has jumped; fewer may be late. */
    real relays_in_row;
    /* Factor on the random walk of a clock up to which an anchor's report of it is used: its filter assumes 1. */
    real steady_walk_scale;
    real max_scale;  /* Largest factor on the process noise of motion, and of a range error that has jumped. */
    /* Mean square of the innovations along the axes, 1 where the filter is right, beyond which that noise grows. */
    real lag_limit;
    real better_known;  /* The place of a tag at rest moves when its variance has shrunk to this part. */
    /* Part of the process noise of motion that a tag at rest keeps: 5 cm within half a minute. */
    real stationary_noise_share;
    real stationary_std_mps;  /* Standard deviation of the velocity of a tag at rest [m/s]. */
    /* Distance of the estimate from the point of linearisation, of ranges or of phases, at which that moves [m]. */
    real held_step_m;
    real held_max_m;  /* It stays within ``suspect`` standard deviations of the estimate, up to this distance [m]. */
    real curvature_share;  /* Share of the stamps' variance below which the curvature of ranges is neglected. */
    /* Range at which errors that grow with distance pass through zero, and by which they change once [m] (APS011). */
    real slope_from_m;
    /* Weight in the mean NIS, in the share of rejected innovations and in the mean square along axes: the last 50. */
    real forgetting;
    /* Mean NIS beyond which covariances are scaled by its square, phases are not used, and a new start is given up,
     * once: it was wrong, for example by packets that were late. */
    real wrong_nis;
    /* Weight in the shares of late receptions and of phases beyond the gate, and in the phases' noise: the last 200. */
    real slow_forgetting;
    real late_often_share;  /* Share of late receptions beyond which single ones are late often. */
    /* Normalised innovation beyond which receptions have less weight where they are late often (Huber 1964). */
    real reception_huber;
    real difference_huber;  /* The same of time differences, always. */
    real max_relays_rejected;  /* Count of recent relays beyond the gate up to which they may be late ones. */
    /* Number of rejected packets in a row, single late ones left out, at which the state is wrong. */
    real lost_in_row;
    real lost_share;  /* Share of rejected innovations at which it is. */
    /* Normalised innovation beyond which a reception may be a jump, two of them differ by chance, and a running mean
     * over its expectation calls for more process noise. */
    real suspect;
    /* Number of such receptions in a row that make a jump, and of impossible ones if a counter has restarted … */
    real in_row;
    real in_row_where_late;  /* … and where single receptions are late often. */
    real together;  /* Sum of two such normalised innovations: by chance once in some million packets. */
    /* Factor on the process noise of a range error that has just jumped: it may still be changing. */
    real first_change_scale;
    real ended_std_m;  /* An obstruction has ended where the range error is known to this [m] … */
    real ended;  /* … and within this number of standard deviations of zero. */
    real obstructed_walk;  /* Density with which a range error that has jumped wanders [m²/s]. */
    real obstruction_memory_s;  /* Time in which it returns to zero, and in which a jump is forgotten [s]. */
    real obstruction_return_m;  /* Largest return in that time [m]: long delays are no less likely to stay. */
    real jump_rise;  /* Part of its full size by which a jump raises the process noise of all range errors. */
    real obstructed_std_m;  /* Standard deviation by which all range errors change where some have jumped [m] … */
    real obstructed_s;  /* … and the time in which they do [s]. */
    real place_step_m;  /* Length of a step [m]. */
    real place_first;  /* Number of comparisons for which the stamps' noise stands beforehand. */
    real place_samples;  /* Number of comparisons that are needed … */
    real place_memory;  /* … and that are remembered. */
    real place_min_m2;  /* Least variance between two steps that counts as multipath [m²]. */
    real place_kept;  /* Least correlation over a step, and least loss of it. */
    /* Largest standard deviation of the part of a range error that changes as the tag moves, and that of a pair's range
     * that has jumped [m]. */
    real max_change_std_m;
    /* Standard deviation of each coordinate of an anchor that stands elsewhere, and of a fault since it joined [m] … */
    real lasting_std_m;
    real recent_std_m;  /* … of one that has begun recently without a visible jump [m] … */
    real creeping_std_m;  /* … and of one that grows for seconds [m]. */
    real recent_packets;  /* Number of packets of each anchor over which a fault is recent. */
    real creeping_s;  /* Time in which a creeping fault has become e times as large [s]. */
    /* Standard deviation beforehand of a fault that is added to the state, and of all faults at the start [m]. */
    real late_std_m;
    /* Test beyond which there is a fault: χ² of eight degrees of freedom with a probability of 4·10⁻⁸. */
    real sure_chi2;
    real early_weight;  /* Weight of what an early fault explains: obstacles make packets late. */
    /* Standard deviation of the range between two anchors against the survey, before it is measured [m]. */
    real open_pair_std_m;
    real pair_relays;  /* Number of relays in either direction after which their mean is a range. */
    /* Number of such ranges beyond ``suspect``, and more than the other end has, that make an anchor misplaced. */
    real misplaced_pairs;
    /* Older packets are not used for a start; where superframes are longer, for the rate of the clock only [s]. */
    real start_age_s;
    /* Part of the mean range beyond which ranges are curved within a standard deviation: updates would make the filter
     * sure of a wrong position. It has no level, and is not predicted further. */
    real curved_std;
    real start_patience_s;  /* Time for which a start waits that is wide or contradicted: more anchors may come [s]. */
    /* Probability with which residuals of a start are larger by chance than those that contradict it, and weight below
     * which other positions are no rivals. */
    real start_tail;
    /* Time for which a start is new [s]: one with open range errors is not repeated within it, and phases are not used,
     * as places that still move by the stamps' noise would turn the directions to the anchors. */
    real new_start_s;
    /* Factor on the start's covariance, as the filter is then given the packets that it rests on. */
    real start_margin;
    /* No state grows much wider over shorter silences; packets that are late by less are late from the radio [s]. */
    real short_silence_s;
    real longest_silence_s;  /* After a longer one the state is worse than a new start [s]. */
    /* In longer superframes, where a new start takes seconds, a silence may widen the state more [s] … */
    real slow_superframe_s;
    real slow_curved_std;  /* … up to this part of the mean range. */
    /* In longer ones a tag may be metres away: nothing is predicted, and each round of packets is a start [s]. */
    real longest_superframe_s;
    real heights_in_row;  /* Number of heights in a row that do not fit, after which the position is wrong. */
    /* Standard deviation of each coordinate of an anchor after a start that was contradicted [m]. */
    real open_survey_std_m;
    real fitting_chi2;  /* χ² for each anchor below which range errors are as the settings state them. */
    /* Number of anchors that are late at the start at most: on the floor or behind metal one often is. */
    real most_late;
    real late_penalty;  /* What each of them adds to χ²: odds of 1 to 3. */
    /* Part of an anchor's lateness at the start that stays: its mean, and its standard deviation. */
    real staying_share;
    real window;  /* Number of ready-made time differences from which a start is looked for … */
    real window_s;  /* … or those of this time [s]. */
    real median_difference_std_m;  /* Standard deviation of the median of a pair's differences [m]. */
    real late_start_std_m;  /* Standard deviation of each anchor's error at the start, before any are estimated [m]. */
    /* Distance from which two positions are rivals; anchors lie elsewhere for a tag that has moved as far [m]. */
    real rival_m;
    /* Starts lie no higher above or below anchors of different heights than this, unless bounds are given [m]. */
    real height_margin_m;
    /* A tag without beacons that is farther from the anchors' centre than this part of their diagonal is lost. */
    real neighbourhood;
    real most_horizontal_std_m;  /* While its horizontal standard deviation is larger, there is no fix [m]. */
    real zero_variance_m2;  /* Variance of a barometer's zero at first [m²]. */
    real phase_start_std_m;  /* Standard deviation of a phase before innovations show another [m] … */
    real phase_max_std_m;  /* … and its upper bound, or that of the settings [m]. */
    real phase_mesh_std_m;  /* Standard deviation of a phase that an anchor measured of another [m]. */
    /* What reflections change in an ambiguity as the tag walks, in variances of a phase for each metre [1/m]. */
    real phase_wander;
    /* Part of a wavelength beyond which no innovation is used: near half of one the sign is not known. */
    real phase_gate;
    /* Part of a wavelength up to which the standard deviation of a predicted phase leaves no doubt of the cycle. */
    real phase_share;
    real phase_step_m;  /* Length of the steps by which reflections change phases [m]. */
    /* Time for which an ambiguity from before a gap is kept to find by how many cycles it has changed [s]. */
    real phase_former_s;
    /* Number of phases of an anchor in a row beyond the gate at which its ambiguity begins again. */
    real phases_in_row;
    real uncovered_chi2;  /* Test beyond which faults are larger than levels cover. */
    /* Part of the mean range beyond which, where all range errors are open, a standard deviation has no level. */
    real max_open_level_std;
    /* Time without a level after a start that was contradicted: several late anchors may agree on a wrong place [s]. */
    real contradicted_start_s;
    real probe_m;  /* Least distance from the anchors' plane at which its two sides are compared [m]. */
    /* Standard deviation of the best place on the other side about the mirror image, over that distance. */
    real shift_part;
    /* Squared difference over its variance from which two things differ: ranges of both sides, two starts, or what
     * faults of other anchors explain. */
    real apart_chi2;
    real sensor_valid_s;  /* Time for which a sensor's height decides between them [s]. */
} Tuning;

/* An anchor in use. */
typedef struct UsedAnchor {
    int32_t anchor;
    real position_m[3];
    int64_t rx_ticks;  /* The tag's stamp of its last accepted packet. */
} UsedAnchor;

/* What has become of the starts so far, and whose packets were accepted recently. */
typedef struct Course {
    EstimatorSettings settings;  /* Those with which a filter begins, as the next four. */
    Tuning tuning;
    int32_t dim;
    real horizontal_k;
    real vertical_k;
    real superframe_s;  /* Of slow sites, else 0. */
    /* With which a filter begins, the nearest, and none that does not belong to the start; 0: with all. */
    int32_t most_anchors;
    bool is_starting;  /* Whether no position is known; else the search is not used, now the state is not. */
    real late_share;  /* That of the last filter. */
    int32_t misfit;  /* The anchor that contradicted the others at the start. */
    real alone[10][3];  /* What a fix carries that is a start's, without a filter. */
    bool open_range_errors;  /* Whether the next start expects larger range errors than the settings state. */
    bool is_open;  /* Whether the last start did. */
    bool start_was_contradicted;
    bool relays_may_contradict;
    bool may_begin_again;  /* Whether a start that fits badly from the beginning is given up: not twice in a row. */
    int32_t heights_rejected;
    int64_t master_less_tag_ticks;
    int64_t started_ticks;
    int64_t newest_ticks;
    real in_use_s;  /* An anchor counts as in use while its last accepted packet is younger than this. */
    int64_t checked_ticks;  /* When that was checked last. */
    real extent_m;  /* The largest span in x, y or z that anchors in use have had since the start. */
    int64_t changes;  /* How often the anchors in use, or their positions, have changed. */
    int32_t count;
    UsedAnchor used[MAX_ANCHORS];
    int64_t time_ticks;  /* Of the newest fix, since the first one. */
} Course;

/* An anchor and where it stands. */
typedef struct Place {
    int32_t anchor;  /* Identifier. */
    real position_m[3];
    real std_m;  /* Standard deviation of each coordinate; below 0 for that of the settings. */
    bool is_open;  /* Whether it joins with range errors beyond those of the settings. */
} Place;

/* A TX time on a scale that packets of several anchors have in common. */
typedef struct ScaledTime {
    int64_t ticks;
    real fraction_ticks;
    real variance_m2;
} ScaledTime;

/* A packet that the tag received; all stamps are unwrapped. */
typedef struct Packet {
    Place place;
    int32_t sequence;
    int64_t rx_ticks;  /* The tag's stamp. */
    int64_t tx_ticks;  /* The anchor's own. */
    real variance_factor;  /* On the variance of the tag's reception. */
    bool has_phase;
    real phase_cycles;  /* Phase of the carrier as the tag received it, in [0, 1). */
    /* Identifier of the anchor against whose clock this one reports its own; −1 where it reports nothing. */
    int32_t master;
    int64_t subticks;  /* The anchor's reading less the master's at the packet's TX stamp, modulo 2⁴⁸. */
    real report_variance_m2;
    bool is_stated;  /* Whether the anchor states its TX time on the master's scale … */
    ScaledTime stated;  /* … and that time, which only starts use. */
    bool relays_have_phases;  /* Whether its frame carries phases of its relays, and short stamps. */
} Packet;

/* When an anchor, that of the packet as a rule, received a packet of another. */
typedef struct Relay {
    int32_t listener;  /* Identifier of the one that received it. */
    int32_t anchor;  /* Identifier of the other. */
    int32_t sequence;
    int64_t rx_ticks;  /* The listener's stamp, unwrapped; where it is short its lowest bits (``relay_rx_ticks``). */
    bool is_short;
    bool has_phase;
    real phase_cycles;  /* Phase of the carrier as the listener received it, in [0, 1). */
} Relay;

/* What came with a packet. */
typedef struct Relays {
    int32_t count;
    Relay rows[MAX_RELAYS];
} Relays;

/* A tag of protocol 2. */
typedef struct Tag {
    EstimatorSettings owner;  /* What its owner has chosen; the site's pages state the rest. */
    Admission admission;
    SitePages pages;
    Course course;
    bool has_settings;  /* Whether the pages are known, so that it looks for a start or follows its course. */
    int64_t period_ticks;  /* Longest mean time between two beacons of an anchor, when the settings were made. */
    bool is_moving;  /* Whether anchors of the site have stated other positions recently (``Neighbour.has_moved``). */
    int64_t moved_ticks;  /* When the last one did. */
    bool uses_moved;  /* Whether those are in use, and not the others. */
    int32_t origin_mm[3];  /* To be added to all positions, where ``HAS_ORIGIN``. */
    bool has_origin;
    int32_t most_relays;  /* Of a beacon that follows its course, the newest ones: fewer where its processor is late. */
    BeaconFields beacon;
    bool has_moved;  /* Whether its sender states another position than before. */
    Packet packet;  /* The same for the filter. */
    Relays relays;
    int32_t events;  /* What has happened with it (``admission.COUNTER_JUMPED`` and others). */
} Tag;

/* A packet. */
typedef struct HeardPacket {
    Packet packet;
    int32_t relay_count;
    Relay relays[RELAYS_KEPT];
    ScaledTime scaled;  /* Its TX time on the scale of the trial at hand. */
} HeardPacket;

/* An anchor's newest packets. */
typedef struct HeardAnchor {
    int32_t count;
    int64_t fitted_ticks;  /* The tag's reading when it last had a place on the common scale, at a possible rate. */
    HeardPacket older;
    HeardPacket newer;
} HeardAnchor;

/* Reading of one anchor's clock less that of another's, when the tag's read ``rx_ticks_tag``. */
typedef struct ClockLink {
    int32_t listener;
    int32_t sender;
    int64_t rx_ticks_tag;
    int64_t ticks;
    real fraction_ticks;
} ClockLink;

/* A first position. */
typedef struct Start {
    int64_t rx_ticks_tag;
    int32_t count;
    int32_t used[MAX_ANCHORS];  /* Where the anchors that it uses stand in the table of those that are heard. */
    real position_m[3];
    real covariance_m2[3][3];
    bool is_contradicted;  /* Whether the messages of all anchors contradict each other. */
    bool has_misfit;
    int32_t misfit;  /* An anchor that is not in ``used``: without it there is no contradiction. */
} Start;

/* Along which links an anchor's TX times become those of the reference: a tree. */
typedef struct Reach {
    int32_t count;
    int32_t order[MAX_ANCHORS];  /* Pairs in the order in which they are reached; the first is the reference. */
    int32_t is_reached[MAX_ANCHORS];
    int32_t parent[MAX_ANCHORS];
    int32_t link[MAX_ANCHORS];
    int32_t sign[MAX_ANCHORS];
} Reach;

/* A minimum of the cost, in the problem's axes. */
typedef struct Minimum {
    int32_t iterations;
    real cost;
    real chi2;  /* rᵀΣ⁻¹r, also where the cost is not weighted by Σ⁻¹. */
    real state[3];
    real covariance[10];  /* A lower triangle; zeros for a given height. */
} Minimum;

/* A set of TDoAs ``tdoa_m[i] = |p − anchors_m[i + 1]| − |p − anchors_m[0]|``, and how far its solution is. */
typedef struct LocateProblem {
    int32_t anchors;
    bool knows_height;
    bool is_weighted;
    bool has_bounds;  /* Whether the height is between ``low_m`` and ``high_m``. */
    real height_m;
    real low_m;
    real high_m;
    real residual_tail;  /* Residuals that noise exceeds more rarely are not noise. */
    real anchors_m[MAX_ANCHORS][3];  /* The reference first; ``choose_axes`` moves them into its axes. */
    real tdoa_m[MAX_ANCHORS];
    real covariance[TRIANGLE];  /* The lower triangle of Σ, and then of its factor L. */
    int32_t kind;
    int32_t dims;  /* Number of unknowns. */
    real extent_m;  /* Size of the anchors' figure. */
    real origin_m[3];
    real axes[3][3];  /* Its rows; a position is origin + axesᵀ·state. */
    real scale[3];  /* What the extent is for each unknown. */
    int32_t start_count;
    int32_t minimum_count;
    real starts[9][3];
    Minimum minima[9];  /* The best first. */
    int32_t iterations;
    real state[3];
    real trial[3];
    real step[3];
    real system[MAX_ANCHORS][4];  /* Rows [∂TDoA/∂state, measured − predicted]. */
    real normal[10];  /* The lower triangle of systemᵀ·system. */
    real next_normal[10];
    real factor[10];
} LocateProblem;

/* A position and how well it is known. Metres, site frame. */
typedef struct Found {
    bool has_mirror;
    int32_t dof;
    int32_t iterations;
    real chi2;
    real position_m[3];
    real mirror_m[3];  /* The other position that fits as well. */
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
    real variance_m2;  /* Of a TX and an RX stamp together. */
    real max_age_s;
    real speed_std_mps;  /* Assumed speed of the tag. */
    real error_variance_m2;  /* Of survey and ranges. */
    Tuning tuning;
    int32_t count;
    HeardAnchor heard[MAX_ANCHORS];  /* In the order in which they were first heard. */
    int32_t link_count;
    ClockLink links[MAX_LINKS];
    bool has_been_wide;
    int64_t wide_ticks;  /* When a start was first possible, but wide. */
    bool is_linked;  /* Whether TX times are on a common scale by relays, and not as anchors state them. */
    bool is_contradicted;
    int64_t contradicted_ticks;  /* When packets first contradicted each other. */
    /* Anchors with which two positions fitted alike; as many of them are tried again once a superframe only. */
    int32_t rival_count;
    Start start;
    int32_t pair_count;
    int32_t pairs[MAX_ANCHORS];  /* Anchors with two packets, by their place in ``heard``. */
    real rates[MAX_ANCHORS];  /* How much faster the clock of each runs than the tag's, as a fraction … */
    real rate_variances[MAX_ANCHORS];  /* … and the variance of that in m²/s². */
    /* Rates of the tag's clock against the common scale, one of each anchor; ``_solve_start`` sorts them. */
    real clock_rates_mps[MAX_ANCHORS];
    Reach reach;
    Reach best;
    Start found_alone;
    real ranges_m[MAX_ANCHORS];  /* Pseudoranges at one time … */
    real variances_m2[MAX_ANCHORS];  /* … and their variances. */
    LocateProblem problem;
    Found found;
} Acquisition;

/* Where the states stand: the index of the first of each block. */
typedef struct Layout {
    int32_t offset;  /* Of the first anchor; the others' follow, as in all blocks. */
    int32_t velocity;
    int32_t rate;
    int32_t tx_noise;
    int32_t ambiguity;
    int32_t mesh;
    int32_t former;  /* All where phases are used; else they are the change's place, and not used. */
    int32_t change;
    int32_t constant;
    int32_t slope;
    int32_t height;  /* In two dimensions; in three it is one of the position. */
    int32_t zero;  /* In three dimensions; in two it is the slope's place, and not used. */
    int32_t survey;  /* ``dim`` states for each anchor. */
    int32_t end;
} Layout;

/* The estimator's counters and running means. */
typedef struct Status {
    int64_t epoch_ticks;  /* The tag's reading at the newest packet. */
    int64_t start_ticks;  /* The tag's reading at the start. */
    int64_t faded_ticks;  /* The tag's reading when faults that are not lasting last faded. */
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
    int64_t ends_of_obstructions;
    int64_t faults_opened;
    real mean_nis;
    real mean_square_m2;  /* Of innovations. */
    real rejected_share;
    real late_share;
    real relays_lately_accepted;  /* Running counts that fade. */
    real relays_lately_rejected;
    real lag[3];  /* Running mean of innovations along each axis. */
    real lag_square;
    real q_scale;  /* Factor on qa. */
    real common_mean;  /* Running mean of all innovations: the tag's own clock. */
    real walk_scale;  /* Factor on its random walk. */
    int32_t place_samples;  /* Comparisons of range errors at places a step apart. */
    real place_square_m2[2];  /* Half their mean square after one and two steps. */
    real place_variance_m2;  /* Of what multipath changes in them, 0 where not more than stated. */
    real place_distance_m;  /* Distance over which multipath changes. */
    real obstruction;  /* 1 where range errors have jumped recently, 0 where they do not. */
    real walked_m;
    real stationary_s;  /* Since the tag last showed motion. */
    real stationary_m[3];  /* Where it was then. */
    real stationary_m2[3];  /* Variance of that on each axis. */
    bool withholds_levels;  /* Whether the anchors' positions are known to be wrong. */
    int64_t height_ticks;  /* The tag's reading when a sensor's height was used last. */
    real plane_m[3];  /* A point of the plane that lies closest to the anchors. */
    real plane_normal[3];  /* Normal of that plane. */
    bool has_phases;  /* Whether phases are used, so that there are ambiguities. */
    real line_m[3];  /* Where phases are linearised: a place of the tag, from there on moved by its velocity alone. */
    real step_m[3];  /* The tag's place after its last step … */
    real way_m;  /* … and the sum of all steps: unlike ``walked_m`` it does not grow at rest. */
    real phase_variance_m2;  /* Of a phase, as innovations show it. */
    real wild_share;  /* Running share of phases beyond the gate. */
    int64_t phases_used;
    int64_t phases_refused;
    int64_t phases_opened;  /* Ambiguities that began, or began again … */
    /* … and of these the ones of which it was then found by how many cycles they differ from the former. */
    int64_t phases_rejoined;
    bool has_open_ranges;  /* Whether anchors join with range errors beyond those of the settings. */
    int32_t range_errors;  /* NO_RANGE_ERRORS, CHANGING_RANGE_ERRORS or ALL_RANGE_ERRORS. */
    real fault_std_m[3];  /* Of each kind of faults, beforehand. */
} Status;

/* What is kept of an ambiguity in addition to its state. */
typedef struct Ambiguity {
    bool is_known;
    int32_t refused_in_row;  /* Phases beyond the gate. */
    int64_t ticks;  /* The tag's reading at its newest phase. */
} Ambiguity;

/* What is kept of an anchor in addition to its states. */
typedef struct Anchor {
    int32_t identifier;
    real position_m[3];
    int64_t tx_ticks;  /* Newest packet, by its own clock. */
    int64_t rx_ticks;  /* Newest packet, by the tag's clock. */
    int64_t offset_ticks;  /* Whole ticks of the offset. */
    real range_m;  /* At its newest packet. */
    real held_m[3];  /* The tag's position at which ranges to it are linearised. */
    real held_range_m;  /* Distance of that point. */
    real walked_m;  /* The tag's walked distance at its newest packet. */
    bool is_relayed;  /* Whether others relay its packets. */
    bool has_rate;  /* Whether its clock's rate is known: more than its first packet has shown its offset. */
    bool has_tx_noise;  /* Whether its newest packet's TX noise is a state. */
    int64_t packets;
    real innovation;  /* Its newest one, normalised. */
    int32_t outliers_in_row;
    real outlier_m;  /* The newest of them. */
    bool is_obstructed;  /* Whether its range error has jumped and not come back. */
    real change_mean;  /* Running mean of its innovations since then, normalised. */
    real change_scale;  /* Factor on the process noise of a range error that has jumped. */
    bool has_fault;  /* Whether a lasting fault of it was added to the state. */
    real relay_mean;  /* Running mean of what relays show of its clock, normalised. */
    real walk_scale;  /* Factor on its oscillator's random walk. */
    real change_variance_m2;  /* Of the part of its range error that changes as the tag moves. */
    int32_t place_steps;  /* Steps of the tag after which its range error was compared, in a row. */
    real place_walked_m;  /* The tag's walked distance at the newest of them. */
    real place_residual_m[2];  /* What its reception left after the last two. */
    Ambiguity own;  /* Of the tag's receptions of it. */
    Ambiguity mesh;  /* Of its receptions of its partner. */
    int32_t partner;  /* Identifier of that, −1 for none. */
    bool has_former;
    int64_t former_ticks;  /* The tag's reading when its former ambiguity ended. */
    real phase_way_m;  /* The tag's way at its newest phase. */
} Anchor;

/* A packet that others may relay. */
typedef struct KeptPacket {
    int32_t sequence;
    int64_t tx_ticks;
    int64_t rx_ticks;
} KeptPacket;

/* A pair of anchors, listener and sender. */
typedef struct Link {
    int64_t tx_ticks;  /* Newest packet of the sender whose reception by the listener was processed. */
    int64_t relays;  /* Used in this direction. */
    real constant_m;  /* Estimated constant of the pair, in the row of the lower index. */
    real variance_m2;  /* Variance of that. */
    int32_t outliers_in_row;
    bool contradicts;  /* Whether its range contradicts the survey. */
} Link;

/* Everything that the estimator keeps of one tag. What loops run over stands first: its rows fill cache lines. */
typedef struct State {
    real x[STATES];
    real P[COVARIANCES];  /* Row by row, symmetric to the bit; see ``at``. */
    /* What faults do to x: of each kind for each metre by which receptions of an anchor are late, then for each m/s² of
     * acceleration along an axis, then what planning adds. */
    real V[STATES][SENSITIVITIES];
    EstimatorSettings settings;
    Tuning tuning;
    real horizontal_k;  /* How many standard deviations the risk of levels allows. */
    real vertical_k;
    int32_t dim;  /* Dimensions of the position: 2 where the height is given, else 3. */
    int32_t count;  /* Anchors in the state. */
    int32_t used;  /* States that are not known to be exact; covariances with all others are zero. */
    int32_t n;  /* The same up to a multiple of ``LANES``: what loops along rows of P go to. */
    int32_t rows;  /* Columns of V in use. */
    Layout layout;
    Status status;
    real information[FAULTS][FAULTS];  /* Information of the innovations on all faults; the lower half. */
    real evidence[FAULTS];  /* What innovations show of them. */
    /* Of the lasting faults: (M + I/σ_f²)⁻¹. Their M grows without end, next to which 1/σ_f² would be lost. */
    real lasting_covariance[MAX_ANCHORS][MAX_ANCHORS];
    real lasting_m[MAX_ANCHORS];  /* Their estimate: that times y. */
    Anchor anchors[MAX_ANCHORS];
    KeptPacket packets[MAX_ANCHORS][PACKETS_KEPT];
    Link links[MAX_ANCHORS][MAX_ANCHORS];  /* Of listener and sender. */
    int32_t terms;  /* Terms of the measurement at hand, which stand in ``h``. */
    real h[20];  /* The measurement where it is not zero, at the indices in ``h_index``. */
    int32_t h_index[20];
    int32_t waiting;  /* Updates that are not in P and V yet: those of a packet's relays go there together. */
    real U[MOST_WAITING][STATES];  /* Of each its u = P·h/√S; then P·h of the measurement at hand. */
    /* Of each, over √S, by how much each fault is in its innovation; then the same of the measurement at hand. */
    real G[MOST_WAITING][SENSITIVITIES];
    real work[WORK_ROWS][MAX_ANCHORS];  /* Scratch for systems of equations of all faults of one kind. */
    real levels[5];
    real fix[10][3];  /* What a fix carries (``POSITION`` and the following). */
} State;

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

/* Linear equations of a start. */
typedef struct Equations {
    Columns left;
    real right[MAX_ANCHORS];  /* What is known: (|a_i|² − d_i²)/2, less what a given height contributes. */
    real u[4];
    real v[4];
} Equations;

/* What a filter begins with. */
typedef struct Beginning {
    Start start;
    int32_t count;
    HeardPacket packets[MAX_BEGINNING];  /* In the order of their receptions. */
} Beginning;

/* A packet of a batch. */
typedef struct BatchPacket {
    int32_t place;  /* Row of its anchor in the table of places. */
    int32_t sequence;
    int64_t rx_ticks;
    int64_t tx_ticks;
    real variance_factor;
    bool has_phase;
    real phase_cycles;
    int32_t end;  /* Where its relays end in their table; they begin where those of the packet before end. */
} BatchPacket;

/* The state after a packet of a batch. */
typedef struct BatchRow {
    real position_m[3];
    real velocity_mps[3];
    real covariance_m2[3][3];
    real levels[5];  /* As ``protect`` writes them, where they are asked for. */
    int32_t integrity;
    int32_t outcome;
} BatchRow;

/* A message of a superframe. */
typedef struct PlannedMessage {
    int32_t anchor;  /* Index of its anchor in the state; −1 where the tag does not receive it. */
    int64_t gap_ticks;  /* Time since the message before. */
    real share;  /* Share of its anchor's messages that arrive. */
    real late_m;  /* By how much walls delay them. */
    int32_t end;  /* Where its relays end in their table; they begin where those of the message before end. */
} PlannedMessage;

/* A reception that is relayed with a message. */
typedef struct PlannedRelay {
    int32_t sender;  /* Index of the anchor that was received; −1 where the tag does not receive it itself. */
    real age_s;
    real share;  /* Share of its receptions of which the tag gets to know. */
    real late_m;
} PlannedRelay;

/* What a superframe's fixes sum up to, each by how often its message arrives. */
typedef struct SteadyState {
    real fixes;
    real variance_m2[3];  /* Of each axis as the filter claims it. */
    real square_bias_m2;  /* Of the error that walls leave. */
    real motion_m2[3];  /* What accelerations have of each axis' variance, for one fix. */
} SteadyState;

SKYLESS_EXPORT int32_t skyless_unwrap_stamp(Neighbours *t, int32_t anchor, int32_t sequence, int64_t tx_counter, int64_t
        rx_ticks, int64_t period_ticks);
SKYLESS_EXPORT int32_t skyless_read_frame(uint8_t *frame, int32_t length, BeaconFields *b);
SKYLESS_EXPORT void skyless_restart(State *s, int64_t rx_ticks, real late_share, real fault_std_m, bool
        has_open_ranges);
SKYLESS_EXPORT int32_t skyless_find_anchor(State *s, int32_t identifier);
SKYLESS_EXPORT int32_t skyless_add_anchor(State *s, int32_t identifier, real *position_m, real std_m, bool is_open);
SKYLESS_EXPORT void skyless_fit_plane(State *s);
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
        real max_acceleration_mps2, real integrity_risk, real alert_limit_m);
SKYLESS_EXPORT void skyless_wake(Tag *t, State *s, Acquisition *q, int64_t rx_counter, real slept_s);
SKYLESS_EXPORT void skyless_begin_here(Tag *t, Acquisition *q);
SKYLESS_EXPORT int32_t skyless_hear_frame(Tag *t, State *s, Acquisition *q, uint8_t *frame, int32_t length, int64_t
        rx_counter, real host_s, real rx_power_dbm, real first_path_power_dbm, real phase_cycles);
SKYLESS_EXPORT int32_t skyless_hear_fields(Tag *t, State *s, Acquisition *q, uint8_t *frame, int64_t rx_counter, real
        host_s, real rx_power_dbm, real first_path_power_dbm, real phase_cycles);

#endif
