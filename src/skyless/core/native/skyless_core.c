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

#include "skyless_core.h"

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

typedef struct { real item_0; real item_1; } spread_of_h_results;
typedef struct { real item_0; real item_1; real item_2; } range_error_decay_results;

INTERNAL real exp_(real x);
INTERNAL real log_(real x);
INTERNAL real hypot_(real x, real y);
INTERNAL real square(real x);
INTERNAL bool factorise(real *A, int32_t size);
INTERNAL void solve_lower(real *L, int32_t size, real *x);
INTERNAL void solve(real *L, int32_t size, real *x);
INTERNAL void orthogonalise(Columns *m);
INTERNAL bool has_rotated(Columns *m, int32_t one, int32_t other);
INTERNAL real scalar_product(Columns *m, int32_t one, int32_t other);
INTERNAL void rotate_columns(real (*A)[4], int32_t rows, int32_t one, int32_t other, real cosine, real sine);
INTERNAL bool least_squares(Columns *m, real *right, real *x);
INTERNAL real normal_tail(real z);
INTERNAL real normal_quantile(real tail);
INTERNAL real continued_fraction(real z, int32_t first);
INTERNAL real chi2_tail(int32_t dof, real chi2);
INTERNAL real mean_if_positive(real mean, real sigma);
INTERNAL int64_t nearest(int64_t counter, int64_t expected_ticks, int32_t bits);
INTERNAL bool may_elapse(int64_t counter_ticks, int64_t elapsed_ticks, real slack_ticks);
INTERNAL int64_t unwrap(Unwrapper *u, int64_t counter, real host_s);
INTERNAL int64_t fix_time_ticks(FixTime *time, int64_t ticks_master, int64_t rx_ticks_tag);
INTERNAL int64_t unsigned_(uint8_t *data, int32_t at, int32_t size);
INTERNAL int32_t two_bytes(uint8_t *data, int32_t at);
INTERNAL int64_t signed_(uint8_t *data, int32_t at);
INTERNAL real variance_factor(real rx_power_dbm, real first_path_power_dbm);
INTERNAL int64_t period_ticks(int32_t code);
INTERNAL int32_t find_neighbour(Neighbours *t, int32_t anchor);
INTERNAL int32_t neighbour_of(Neighbours *t, int32_t anchor, int64_t rx_ticks);
INTERNAL int32_t least_important(Neighbours *t, int64_t rx_ticks);
INTERNAL bool is_confirmed(Neighbour *n, int64_t rx_ticks);
INTERNAL bool is_relayed(Neighbour *n, int64_t rx_ticks);
INTERNAL bool is_present(Neighbour *n, int64_t rx_ticks);
INTERNAL int64_t lasting_ticks(Neighbour *n, int64_t least_ticks);
INTERNAL void forget_times(Neighbours *t);
INTERNAL void wake_times(Neighbours *t, int64_t rx_ticks, int64_t rx_counter);
INTERNAL void forget_row(Neighbour *n);
INTERNAL bool is_newest(Neighbour *n, int32_t sequence, int64_t tx_counter);
INTERNAL void keep(Neighbour *n, int32_t sequence, int64_t tx_ticks, int64_t rx_ticks, int32_t frames);
INTERNAL int32_t reject(Neighbour *n, int32_t sequence, int64_t tx_counter, int64_t rx_ticks, bool is_silent);
INTERNAL bool is_possible_page(uint8_t *data, int32_t at);
INTERNAL bool is_coordinate(uint8_t *data, int32_t at);
INTERNAL bool is_noise(uint8_t *data, int32_t at);
INTERNAL int32_t note_page(SitePages *p, Neighbours *t, uint8_t *frame, int32_t page_at, int64_t rx_ticks);
INTERNAL void collect(SitePages *p, Neighbours *t, uint8_t *frame, int32_t page_at);
INTERNAL bool is_page(SitePages *p, int32_t place, uint8_t *frame, int32_t page_at);
INTERNAL int32_t worst(SitePages *p, Neighbours *t);
INTERNAL int32_t supporters(CollectedPage *one, Neighbours *t);
INTERNAL bool is_majority(SitePages *p, Neighbours *t, int32_t issue, int64_t rx_ticks);
INTERNAL int32_t complete(SitePages *p, Neighbours *t, int32_t issue);
INTERNAL int32_t options(Choices *c, int32_t kind);
INTERNAL void add_choice(Choices *c, SitePages *p, int32_t place);
INTERNAL int32_t issue_of(SitePages *p, Choices *c);
INTERNAL int32_t use_chosen(SitePages *p, Choices *c, int32_t issue);
INTERNAL int32_t header_fault(uint8_t *frame, int32_t length);
INTERNAL int32_t length_fault(uint8_t *frame, int32_t length);
INTERNAL int32_t bare_bytes(int32_t flags);
INTERNAL void read_place(uint8_t *frame, int32_t at, StatedPlace *place);
INTERNAL bool read_relays(uint8_t *frame, BeaconFields *b);
INTERNAL int32_t checksum(uint8_t *data, int32_t length);
INTERNAL int32_t choose_site(SiteChoice *choice, int32_t site, int32_t anchor, int64_t rx_ticks);
INTERNAL void note_fix(SiteChoice *choice, int64_t rx_ticks);
INTERNAL void restart_choice(SiteChoice *choice, int64_t rx_ticks);
INTERNAL int32_t find_site(SiteChoice *choice, int32_t site);
INTERNAL int32_t index_of(SiteChoice *choice, int32_t site);
INTERNAL void count_anchor(CountedSite *counted, int32_t anchor, int64_t rx_ticks);
INTERNAL bool prefers(SiteChoice *choice, int32_t other, int64_t rx_ticks);
INTERNAL bool has_failed(SiteChoice *choice, int64_t rx_ticks);
INTERNAL void note_failed(SiteChoice *choice);
INTERNAL int32_t received(SiteChoice *choice, int32_t counted, int64_t rx_ticks);
INTERNAL real horizontal_limit(real risk);
INTERNAL real vertical_limit(real risk);
INTERNAL int32_t row_of(int32_t state);
INTERNAL int32_t row_end(int32_t state, int32_t end);
INTERNAL int32_t at(int32_t one, int32_t other);
INTERNAL void set_covariance(State *s, int32_t one, int32_t other, real value);
INTERNAL void clear(State *s);
INTERNAL void prepare(State *s);
INTERNAL void set_layout(State *s);
INTERNAL void make_uncertain(State *s, int32_t range_errors);
INTERNAL void use_phases(State *s);
INTERNAL void use_motion(State *s);
INTERNAL void expect_motion(State *s);
INTERNAL void clear_link(Link *link, real variance_m2);
INTERNAL void forget_pair_phase(Link *link);
INTERNAL void remove_anchor(State *s, int32_t anchor);
INTERNAL void insert_state(State *s, int32_t index_);
INTERNAL void remove_state(State *s, int32_t index_);
INTERNAL void insert_fault(State *s, int32_t index_, int32_t faults);
INTERNAL void remove_fault(State *s, int32_t index_, int32_t faults);
INTERNAL void remove_lasting(State *s, int32_t anchor);
INTERNAL void insert(real *numbers, int32_t index_, int32_t end);
INTERNAL void remove_(real *numbers, int32_t index_, int32_t end);
INTERNAL void learn_lasting(State *s, real *m, real weight, real shown);
INTERNAL void forget_lasting(State *s, int32_t anchor);
INTERNAL void weigh_zero(State *s, int32_t anchor, real weight);
INTERNAL void predict(State *s, int64_t rx_ticks);
INTERNAL bool has_order(State *s);
INTERNAL void add_clock_noise(State *s, int32_t anchor, int64_t until_ticks);
INTERNAL real speed_squared(State *s);
INTERNAL real motion_noise(State *s);
INTERNAL bool has_phase(State *s, int32_t anchor);
INTERNAL bool follows_cycles(State *s);
INTERNAL bool are_phases_reliable(State *s);
INTERNAL real unseen_noise(State *s);
INTERNAL bool is_stationary(State *s);
INTERNAL void advance(State *s, real dt);
INTERNAL void advance_packed(State *s, int32_t values, real dt);
INTERNAL void add_noise(State *s, int32_t value, int32_t other, real of_values, real of_both, real of_rates);
INTERNAL real jump_share(State *s);
INTERNAL real clear_variance(State *s, int32_t anchor);
INTERNAL range_error_decay_results range_error_decay(State *s, int32_t anchor, real dt, real walked_m);
INTERNAL void relax_range_error(State *s, int32_t anchor, real dt, real walked_m);
INTERNAL void decay(State *s, int32_t state, real kept, real variance);
INTERNAL void reset_state(State *s, int32_t state, real variance);
INTERNAL void open_direction(State *s, real variance, int32_t faults);
INTERNAL real compute_ph(State *s);
INTERNAL real h_dot(State *s, real *states);
INTERNAL void compute_fault_input(State *s, int32_t own);
INTERNAL void update(State *s, real innovation, real innovation_variance, real gain_scale);
INTERNAL void update_later(State *s, real innovation, real innovation_variance, bool shows_faults);
INTERNAL void note_update(State *s, real innovation, real innovation_variance, real gain_scale);
INTERNAL void finish_updates(State *s);
INTERNAL void inform(State *s);
INTERNAL int32_t fill_groups(State *s);
INTERNAL void apply_updates(State *s);
INTERNAL void apply_one(State *s, int32_t one);
INTERNAL void apply_four(State *s, int32_t k);
INTERNAL void subtract_fault_input(State *s, int32_t anchor);
INTERNAL void fade_faults(State *s);
INTERNAL void whiten(State *s, int32_t count, int32_t vectors);
INTERNAL real fault_chi2(State *s, int32_t kind, int32_t axes);
INTERNAL real explained_chi2(State *s, int32_t one, int32_t other);
INTERNAL real explained_alone(State *s, int32_t kind, int32_t anchor);
INTERNAL real largest(State *s, int32_t kind);
INTERNAL void open_faults(State *s);
INTERNAL void open_new_faults(State *s, int32_t kind);
INTERNAL void begin_obstruction(State *s, int32_t anchor);
INTERNAL void note_jump(State *s);
INTERNAL void open_lasting_faults(State *s, real chi2);
INTERNAL void open_lasting_fault(State *s, int32_t anchor);
INTERNAL void end_lasting_fault(State *s, int32_t anchor);
INTERNAL void open_fault(State *s, int32_t kind, int32_t anchor);
INTERNAL bool is_late_often(State *s);
INTERNAL bool rejects_most(State *s);
INTERNAL bool is_lost(State *s);
INTERNAL bool relays_contradict(State *s);
INTERNAL bool relays_fit(State *s);
INTERNAL real horizontal_variance_m2(State *s, real ahead_s);
INTERNAL bool fits_settings(State *s);
INTERNAL real wavelength_m(State *s);
INTERNAL bool take_cycles(State *s, real innovation, real variance, real limit_m);
INTERNAL real innovation_of(State *s, real innovation, int32_t one);
INTERNAL void branch(State *s, real innovation, real variance, real limit_m);
INTERNAL real likelihood(State *s, real innovation, real variance);
INTERNAL void keep_likely(State *s, int32_t parent, real shift_m, real log_weight);
INTERNAL void replace(State *s, real inverse);
INTERNAL void settle_hypotheses(State *s);
INTERNAL void merge(State *s, int32_t one);
INTERNAL bool are_alike(State *s, int32_t one, int32_t other);
INTERNAL void drop(State *s, int32_t one);
INTERNAL void set_count(State *s, int32_t count);
INTERNAL real scatter(State *s, int32_t state, int32_t other);
INTERNAL spread_of_h_results spread_of_h(State *s);
INTERNAL void give_up_hypotheses(State *s);
INTERNAL bool is_warm(State *s);
INTERNAL void note_outlier(State *s, int32_t anchor, real innovation, real innovation_variance);
INTERNAL bool has_jumped(State *s, int32_t anchor);
INTERNAL bool is_common(State *s, real normalised);
INTERNAL bool is_of_clock(State *s, int32_t anchor, real innovation);
INTERNAL void open_range_error(State *s, int32_t anchor, real innovation);
INTERNAL void adapt_change_noise(State *s, int32_t anchor, real normalised);
INTERNAL real adapted(State *s, real scale, bool is_too_small, real least, real largest);
INTERNAL bool is_off_zero(State *s, real mean);
INTERNAL bool judge_end(State *s, int32_t anchor, real sign, real innovation, real innovation_variance);
INTERNAL void note_innovation(State *s, real innovation, real innovation_variance, bool is_difference);
INTERNAL bool is_within_gate(State *s, real normalised);
INTERNAL real variance_scale(State *s, real normalised, bool is_difference);
INTERNAL void adapt_change_variance(State *s, int32_t anchor, real elapsed_s);
INTERNAL void learn_place(State *s, int32_t anchor, real residual_m);
INTERNAL void update_stationary(State *s, real dt);
INTERNAL void adapt_process_noise(State *s, real normalised);
INTERNAL void adapt_clock_noise(State *s, int32_t anchor, real normalised);
INTERNAL real least_scale(State *s, real walk);
INTERNAL void learn_least_walk(State *s);
INTERNAL real covariance_scale(State *s);
INTERNAL real motion_covariance(State *s, int32_t state, int32_t other);
INTERNAL void protect(State *s);
INTERNAL real largest_test(State *s);
INTERNAL void find_least_axis(State *s, int32_t dim);
INTERNAL void rotate(State *s, int32_t dim, int32_t one, int32_t other);
INTERNAL bool is_side_open(State *s);
INTERNAL real left_by_image(State *s, real off_m, real variance);
INTERNAL int32_t integrity_state(State *s);
INTERNAL void add_term(State *s, int32_t state, real weight);
INTERNAL real h_dot_x(State *s, int32_t begin);
INTERNAL int32_t direction_terms(State *s);
INTERNAL real add_direction(State *s, int32_t anchor, real sign);
INTERNAL real add_direction_from(State *s, int32_t anchor, real sign, real *point_m, real point_range_m);
INTERNAL void hold_direction(State *s, int32_t anchor);
INTERNAL void add_range_errors(State *s, int32_t anchor, real sign);
INTERNAL real find_curvature_m(State *s, real range_m, real variance);
INTERNAL real reception_terms(State *s, int32_t anchor, bool has_tx_noise);
INTERNAL int32_t own_reception(State *s, int32_t anchor, int64_t rx_ticks, int64_t tx_ticks, real variance_factor);
INTERNAL bool use_reception(State *s, int32_t anchor, real innovation, real innovation_variance, real variance_factor);
INTERNAL void carry_ticks(State *s, int32_t anchor);
INTERNAL real end_obstruction(State *s, int32_t anchor);
INTERNAL real jump(State *s, int32_t anchor, real innovation, real rx_variance);
INTERNAL void first_reception(State *s, int32_t anchor, int64_t rx_ticks, int64_t tx_ticks, real variance_factor);
INTERNAL void open_state(State *s, int32_t state, int32_t own, real variance);
INTERNAL void find_rate(State *s, int32_t anchor, real innovation, real innovation_variance, real elapsed_s);
INTERNAL void relay_terms(State *s, int32_t listener, int32_t sender, real age_s, bool has_tx_noise);
INTERNAL real relay_variance(State *s, int32_t listener, int32_t sender, real age_s);
INTERNAL real noise_since(State *s, int32_t anchor, real age_s);
INTERNAL real relay_age_s(State *s, int32_t listener, int32_t sender, int64_t packet_rx_ticks);
INTERNAL bool relay(State *s, int32_t listener, int32_t sender, int64_t tx_ticks, int64_t packet_rx_ticks, int64_t
        rx_ticks);
INTERNAL Link *pair(State *s, int32_t one, int32_t other);
INTERNAL real find_distance_m(State *s, int32_t one, int32_t other);
INTERNAL void use(State *s, real innovation, real innovation_variance);
INTERNAL void survey_pair(State *s, int32_t one, int32_t other);
INTERNAL void pair_range(State *s, int32_t one, int32_t other);
INTERNAL void add_pair_survey(State *s, int32_t one, int32_t other);
INTERNAL void report(State *s, int32_t anchor, int32_t master, int64_t subticks, real variance_m2);
INTERNAL real difference_terms(State *s, int32_t a, int32_t b);
INTERNAL int32_t difference(State *s, int32_t a, int32_t b, int64_t rx_ticks, real difference_m);
INTERNAL void bound_changes(State *s);
INTERNAL int32_t height(State *s, real height_m, real std_m, bool is_barometer);
INTERNAL void zero_velocity(State *s);
INTERNAL void find_level(State *s, real dt);
INTERNAL void step(Motion *m, real *rate_rps, real *force_mps2, real dt);
INTERNAL void push(Motion *m, int32_t axis, real acceleration_mps2, real dt);
INTERNAL void multiply(real *to, real a, real b, real c, real d, real w, real x, real y, real z);
INTERNAL void rest(State *s, real *rate_rps, real dt);
INTERNAL void learn_bias(State *s, real x, real y, real z);
INTERNAL void tilt(State *s, real x, real y);
INTERNAL void tilt_vector(real *vector, real x, real y);
INTERNAL void turned_back(real *to, real *attitude, real *vector);
INTERNAL void turned(real *to, real *attitude, real *vector);
INTERNAL void look_at_sensor(State *s, int64_t rx_ticks);
INTERNAL void move(State *s, int64_t rx_ticks);
INTERNAL void check_agreement(State *s, real dt);
INTERNAL void find_antenna(Motion *m);
INTERNAL void add_path(State *s, real dt);
INTERNAL void add_drift(State *s, real dt);
INTERNAL void add_to(State *s, int32_t first, real *path, real of_acceleration);
INTERNAL void add_motion(State *s, int32_t target, real a, real b, int32_t error, real c);
INTERNAL bool is_heading_known(State *s);
INTERNAL real heading_variance(State *s);
INTERNAL real heading_std_rad(State *s);
INTERNAL void fill_orientation(State *s);
INTERNAL void settle_heading(State *s, real dt);
INTERNAL void turn_vector(real *vector, real cos, real sin);
INTERNAL void turn_states(State *s, int32_t one, int32_t other, real cos, real sin);
INTERNAL void measure_speed(State *s, real dt);
INTERNAL void own_phase(State *s, int32_t anchor, real phase_cycles);
INTERNAL void relay_phase(State *s, int32_t listener, int32_t sender, int64_t packet_rx_ticks, real phase_cycles);
INTERNAL bool has_mesh(State *s, int32_t anchor);
INTERNAL bool has_pairs(State *s, int32_t anchor);
INTERNAL real whole_cycles(State *s, int64_t ticks);
INTERNAL real certain_m2(State *s);
INTERNAL real innovation_m(State *s, real cycles, real expected_m);
INTERNAL bool use_phase(State *s, int32_t state, Ambiguity *own, real innovation, real predicted, real variance);
INTERNAL bool are_few(State *s, real within_m2);
INTERNAL real limit_m2(State *s, real predicted, real variance);
INTERNAL void count_wild(State *s, real innovation, real variance);
INTERNAL void learn_noise(State *s, real shown_m2);
INTERNAL bool may_count(State *s);
INTERNAL bool agree(State *s);
INTERNAL void close_phases(State *s);
INTERNAL void measure_way(State *s);
INTERNAL void follow_line(State *s);
INTERNAL void turn(State *s, int32_t anchor, int32_t ambiguity);
INTERNAL void subtract(State *s, int32_t state, int32_t other, real weight);
INTERNAL real line_range_m(State *s, int32_t anchor, real *point_m);
INTERNAL real phase_terms(State *s, int32_t anchor);
INTERNAL void open(State *s, int32_t state, Ambiguity *one, real innovation, real variance);
INTERNAL void known_phase(State *s, int32_t anchor, real walked_m);
INTERNAL real expected_phase(State *s, int32_t anchor);
INTERNAL int32_t process(State *s, Packet *packet, Relays *relays);
INTERNAL void take_relays(Packet *packet, Relays *relays, uint8_t *packed, int32_t packed_bytes);
INTERNAL int64_t relay_rx_ticks(Relay *relayed, int64_t tx_ticks, int64_t elapsed);
INTERNAL int32_t process_packet(State *s, Packet *packet, Relays *relays);
INTERNAL int32_t present(State *s, Place *place);
INTERNAL void remove_silent(State *s, int64_t rx_ticks);
INTERNAL int32_t process_of(State *s, int32_t anchor, Packet *packet, Relays *relays);
INTERNAL void advance_to(State *s, int64_t rx_ticks);
INTERNAL int32_t admit(State *s, int32_t anchor, int64_t rx_ticks, int64_t tx_ticks);
INTERNAL bool is_impossible(State *s, int32_t anchor, int64_t rx_ticks, int64_t tx_ticks);
INTERNAL void keep_packet(State *s, int32_t anchor, Packet *packet);
INTERNAL void process_phase(State *s, int32_t anchor, real phase_cycles, bool is_used);
INTERNAL void process_relays(State *s, Packet *packet, Relays *relays);
INTERNAL void process_relay(State *s, Packet *packet, Relay *relayed);
INTERNAL void check_motion_and_faults(State *s, real elapsed_s);
INTERNAL void fill_fix(State *s);
INTERNAL void note_difference(State *s, int32_t anchor, int64_t rx_ticks);
INTERNAL void fill_row(State *s, BatchRow *row, bool has_levels);
INTERNAL int32_t walls(State *s);
INTERNAL void process_superframe(State *s, PlannedMessage *messages, PlannedRelay *relays, int32_t count, int64_t now,
        int64_t impulses_ticks, int64_t superframe, SteadyState *found);
INTERNAL void add_fix(State *s, real share, SteadyState *found);
INTERNAL void predict_with_impulses(State *s, int64_t now, int64_t impulses_ticks, int64_t superframe);
INTERNAL void receive(State *s, PlannedMessage *message, int64_t rx_ticks);
INTERNAL void receive_relay(State *s, PlannedMessage *message, PlannedRelay *relayed);
INTERNAL bool choose_axes(LocateProblem *p);
INTERNAL real sigma_m(LocateProblem *p, int32_t index_);
INTERNAL real least_sigma_m(LocateProblem *p);
INTERNAL int32_t descend(LocateProblem *p);
INTERNAL real assemble(LocateProblem *p, real *state, real *normal);
INTERNAL void linearise(LocateProblem *p, real *state);
INTERNAL void whiten_system(LocateProblem *p);
INTERNAL bool find_damped_step(LocateProblem *p, real damping);
INTERNAL bool is_far(LocateProblem *p);
INTERNAL real eased(real damping, real ratio);
INTERNAL void add_algebraic_starts(LocateProblem *p);
INTERNAL void add_intersections(LocateProblem *p, int32_t coordinates);
INTERNAL void add_at_distance(LocateProblem *p, Equations *e, real distance_m);
INTERNAL void add_interpolation(LocateProblem *p, int32_t coordinates);
INTERNAL void fill(LocateProblem *p, Equations *e, int32_t coordinates, bool has_distance);
INTERNAL real given_height_m(LocateProblem *p);
INTERNAL void add_central_starts(LocateProblem *p);
INTERNAL void add_image(LocateProblem *p);
INTERNAL void add(LocateProblem *p, real x, real y, real z);
INTERNAL int32_t find_minima(LocateProblem *p);
INTERNAL bool is_found(LocateProblem *p);
INTERNAL void assess(LocateProblem *p);
INTERNAL void find_gain(LocateProblem *p, int32_t index_);
INTERNAL void keep_rivals(LocateProblem *p);
INTERNAL bool is_outside(LocateProblem *p, Minimum *minimum, real *state);
INTERNAL int32_t why_none(LocateProblem *p, int32_t status);
INTERNAL real below_plane(Minimum *minimum);
INTERNAL void unfold(LocateProblem *p);
INTERNAL int32_t decide(LocateProblem *p, Found *found);
INTERNAL int32_t chosen_by_height(LocateProblem *p);
INTERNAL void fill_position(LocateProblem *p, Minimum *minimum, real *position_m);
INTERNAL real site_coordinate(LocateProblem *p, Minimum *minimum, int32_t k);
INTERNAL real site_covariance(LocateProblem *p, Minimum *minimum, int32_t a, int32_t b);
INTERNAL void fill_residuals(LocateProblem *p, Found *found, Minimum *minimum);
INTERNAL void forget_all(Acquisition *q);
INTERNAL void forget_packets(Acquisition *q, int32_t anchor);
INTERNAL int32_t try_start(Acquisition *q, Packet *packet, Relays *relays);
INTERNAL int32_t find_heard(Acquisition *q, int32_t anchor);
INTERNAL void remove_heard(Acquisition *q, int32_t place);
INTERNAL void forget_old_packets(Acquisition *q, int64_t now);
INTERNAL bool gather_packet(Acquisition *q, Packet *packet, Relays *relays);
INTERNAL int32_t longest_unfitting(Acquisition *q);
INTERNAL void add_links(Acquisition *q, Packet *packet, Relays *relays);
INTERNAL void add_link(Acquisition *q, Packet *listener, Packet *sent, Relay *relayed);
INTERNAL int32_t oldest_link(Acquisition *q);
INTERNAL void forget_links_before(Acquisition *q, int64_t now);
INTERNAL void choose_pairs(Acquisition *q, int64_t now);
INTERNAL int32_t anchor_of(Acquisition *q, int32_t pair);
INTERNAL void put_on_one_scale(Acquisition *q, int64_t now);
INTERNAL void measure_rate(Acquisition *q, int32_t pair, Packet *first, Packet *second);
INTERNAL void reach_from(Acquisition *q, int32_t reference);
INTERNAL int32_t find_pair(Acquisition *q, int32_t anchor);
INTERNAL void convert(Acquisition *q, int32_t pair, HeardPacket *one);
INTERNAL real clock_rate_mps(HeardAnchor *one);
INTERNAL void drop_impossible(Acquisition *q, int64_t now);
INTERNAL int32_t solve_start(Acquisition *q, int32_t left_out, int64_t now, real residual_tail);
INTERNAL int32_t locate(Acquisition *q, int32_t count, real residual_tail);
INTERNAL bool is_wide(Acquisition *q);
INTERNAL bool is_worth_waiting(Acquisition *q);
INTERNAL int32_t solve_without_one(Acquisition *q, int64_t now);
INTERNAL int32_t process_in_course(Course *c, State *s, FixTime *time, Packet *packet, Relays *relays, uint8_t *packed,
        int32_t packed_bytes);
INTERNAL int32_t settle(Course *c, State *s, FixTime *time, int64_t rx_ticks);
INTERNAL bool is_surely_in_reach(Course *c, int64_t rx_ticks);
INTERNAL bool judge_start(Course *c, State *s, int64_t rx_ticks);
INTERNAL void use_anchor(Course *c, Place *place, int64_t rx_ticks);
INTERNAL int32_t longest_silent(Course *c);
INTERNAL void forget_silent(Course *c, int64_t rx_ticks);
INTERNAL void widen(Course *c, int32_t axis);
INTERNAL void begin_search(Course *c, Acquisition *q);
INTERNAL int32_t outcome_of(int32_t found);
INTERNAL bool was_late_often(Course *c);
INTERNAL bool is_out_of_reach(Course *c, State *s, int64_t rx_ticks);
INTERNAL real mean_range_m(Course *c, real *position_m);
INTERNAL real distance_m(Course *c, real *one_m, real *other_m);
INTERNAL void use_only(Course *c, Acquisition *q);
INTERNAL void fill_alone(Course *c, Acquisition *q);
INTERNAL bool begin_filter(Course *c, State *s, Acquisition *q, Relays *relays);
INTERNAL void choose_packets(Course *c, Acquisition *q, Beginning *b);
INTERNAL void insert_packet(Beginning *b, HeardPacket *one, real factor);
INTERNAL bool is_chosen(Course *c, Acquisition *q, int32_t place);
INTERNAL void add_power(Neighbour *n, real power_dbm);
INTERNAL void add_relays(Neighbours *t, BeaconFields *b, int64_t rx_ticks);
INTERNAL int32_t fitting_relays(Neighbours *t, State *s, BeaconFields *b, int64_t rx_ticks);
INTERNAL int32_t replaced_by(Neighbours *t, State *s, int32_t *origin_mm);
INTERNAL real power_dbm(Neighbour *n, State *s, int32_t *origin_mm);
INTERNAL real place_m(Neighbour *n, int32_t *origin_mm, int32_t axis);
INTERNAL void read_accuracy(EstimatorSettings *e, uint8_t *noise, uint8_t *accuracy);
INTERNAL void fill_noise(EstimatorSettings *e, real tx_stamp_s, real rx_stamp_s, real white_fm, real random_walk_fm);
INTERNAL void fill_ages(EstimatorSettings *e, real superframe_s);
INTERNAL real float_at(uint8_t *data, int32_t at);
INTERNAL void handle_events(Tag *t, Acquisition *q);
INTERNAL void forget_stamps(Tag *t, Acquisition *q);
INTERNAL void read_pages(Tag *t);
INTERNAL void begin_here(Tag *t, Acquisition *q);
INTERNAL void begin_with_pages(Tag *t, Acquisition *q);
INTERNAL void forget_unconfirmed(Tag *t, Acquisition *q);
INTERNAL int32_t process_rare(Tag *t, State *s, Acquisition *q, uint8_t *frame);
INTERNAL int32_t join(Tag *t, State *s, Neighbour *n);
INTERNAL void forget_moves(Tag *t);
INTERNAL void separate_moved(Tag *t, State *s, Acquisition *q, Neighbour *n);
INTERNAL void follow_moves(Tag *t, Acquisition *q, Neighbour *n);
INTERNAL bool is_kept_apart(Tag *t, Neighbour *n);
INTERNAL bool have_most_moved(Tag *t);
INTERNAL int32_t hear_admitted(Tag *t, State *s, Acquisition *q, Neighbour *n, uint8_t *frame);
INTERNAL bool confirm(Tag *t, State *s);
INTERNAL bool has_too_few(State *s, int64_t rx_ticks);
INTERNAL bool keep_place(Neighbour *n, StatedPlace *place);
INTERNAL bool is_same(StatedPlace *one, StatedPlace *other);
INTERNAL void fill_packet(Tag *t, Neighbour *n, real factor);

/* Arithmetic that is also translated to C, with the same bits on every processor: functions, small matrices, tails. */

/* The exponential of a number up to 0, to four units in the last place.
 *
 * x = k·ln 2 + r with |r| ≤ ½·ln 2, where the error of the diagonal Padé approximant of order 6 is below rounding. */
INTERNAL real exp_(real x) {
    if (x < LOWEST) {
        return REAL(0.0);
    }
    int64_t halvings = -floor_real(x / REAL(0.6931471805599453) + REAL(0.5));
    real r = x + (real)halvings * LN_2_HIGH + (real)halvings * LN_2_LOW;
    real square = r * r;
    real even = REAL(665280.0) + square * (REAL(75600.0) + square * (REAL(840.0) + square));
    real odd = r * (REAL(332640.0) + square * (REAL(10080.0) + square * REAL(42.0)));
    real result = (even + odd) / (even - odd);
    for (int64_t time_1 = 0; time_1 < halvings; time_1++) {
        result *= REAL(0.5);
    }
    return result;
}

/* The natural logarithm of a positive number, to four units in the last place.
 *
 * x = m·2ᵏ with m between √½ and √2, and log m = 2·artanh((m − 1)/(m + 1)) by its series. */
INTERNAL real log_(real x) {
    int32_t twos = 0;
    while (x > REAL(1.4142135623730951)) {
        x *= REAL(0.5);
        twos += 1;
    }
    while (x < REAL(0.7071067811865476) && twos > -1100) {
        x *= REAL(2.0);
        twos -= 1;
    }
    real s = (x - REAL(1.0)) / (x + REAL(1.0));
    real square = s * s;
    real total = REAL(0.0);
    for (int32_t term = 12; term > -1; term--) {
        total = total * square + REAL(1.0) / (real)(2 * term + 1);
    }
    return (real)twos * REAL(0.6931471805599453) + REAL(2.0) * s * total;
}

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

/* Rotations of columns */

/* Rotate pairs of columns, the longer one to the front, until all are orthogonal (M. R. Hestenes 1958). */
INTERNAL void orthogonalise(Columns *m) {
    for (int32_t i = 0, i_end = m->columns; i < i_end; i++) {
        for (int32_t j = 0, j_end = m->columns; j < j_end; j++) {
            m->V[i][j] = i == j ? REAL(1.0) : REAL(0.0);
        }
    }
    for (int32_t time_1 = 0; time_1 < MAX_SWEEPS; time_1++) {
        bool is_done = true;
        for (int32_t one = 0, one_end = m->columns - 1; one < one_end; one++) {
            for (int32_t other = one + 1, other_end = m->columns; other < other_end; other++) {
                if (has_rotated(m, one, other)) {
                    is_done = false;
                }
            }
        }
        if (is_done) {
            break;
        }
    }
    for (int32_t j = 0, j_end = m->columns; j < j_end; j++) {
        m->squares[j] = scalar_product(m, j, j);
    }
}

/* Make two columns orthogonal and order them by the smallest rotation. Returns False if they are so already. */
INTERNAL bool has_rotated(Columns *m, int32_t one, int32_t other) {
    real square = scalar_product(m, one, one);
    real square_other = scalar_product(m, other, other);
    real product = scalar_product(m, one, other);
    bool is_orthogonal = !(abs_real(product) > ORTHOGONAL * SQRT(square * square_other));
    if (is_orthogonal && square >= square_other) {
        return false;
    }
    real tangent = REAL(0.0);
    if (!is_orthogonal) {
        real cotangent = (square_other - square) / (REAL(2.0) * product);  /* of twice the angle */
        tangent = REAL(1.0) / (abs_real(cotangent) + SQRT(REAL(1.0) + cotangent * cotangent));
        if (cotangent < REAL(0.0)) {
            tangent = -tangent;
        }
    }
    real cosine = REAL(1.0) / SQRT(REAL(1.0) + tangent * tangent);
    real sine = tangent * cosine;
    if (square < square_other) {
        const real new_1 = -sine;
        const real new_2 = cosine;
        cosine = new_1;
        sine = new_2;
    }
    rotate_columns(m->A, m->rows, one, other, cosine, sine);
    rotate_columns(m->V, m->columns, one, other, cosine, sine);
    return true;
}

/* The scalar product of two columns. */
INTERNAL real scalar_product(Columns *m, int32_t one, int32_t other) {
    real total = REAL(0.0);
    for (int32_t i = 0, i_end = m->rows; i < i_end; i++) {
        real *row = m->A[i];
        total += row[one] * row[other];
    }
    return total;
}

INTERNAL void rotate_columns(real (*A)[4], int32_t rows, int32_t one, int32_t other, real cosine, real sine) {
    for (int32_t i = 0; i < rows; i++) {
        real *row = A[i];
        real first = row[one];
        real second = row[other];
        row[one] = cosine * first - sine * second;
        row[other] = sine * first + cosine * second;
    }
}

/* Find the x that minimises |A·x − right|, after ``orthogonalise``. Returns False if A does not determine it. */
INTERNAL bool least_squares(Columns *m, real *right, real *x) {
    if (!(m->squares[m->columns - 1] > DEPENDENT * DEPENDENT * m->squares[0])) {
        return false;
    }
    for (int32_t k = 0, k_end = m->columns; k < k_end; k++) {
        x[k] = REAL(0.0);
    }
    for (int32_t j = 0, j_end = m->columns; j < j_end; j++) {
        real total = REAL(0.0);
        for (int32_t i = 0, i_end = m->rows; i < i_end; i++) {
            total += m->A[i][j] * right[i];
        }
        total /= m->squares[j];
        for (int32_t k = 0, k_end = m->columns; k < k_end; k++) {
            x[k] += m->V[k][j] * total;
        }
    }
    return true;
}

/* Tails of the normal and the chi2 distribution. */

/* Probability that a standard normal variable exceeds z, to 10⁻¹² of itself.
 *
 * With its density φ it is ½ − φ(z)·Σ z²ⁿ⁺¹/(1·3·…·(2n + 1)), or φ(z)/(z + 1/(z + 2/(z + …))) after Laplace. */
INTERNAL real normal_tail(real z) {
    real tail = 0;
    real size = abs_real(z);
    real density = exp_(-REAL(0.5) * size * size) / SQRT_2_PI;
    if (size < FAR_TAIL) {
        real term = size;
        real total = size;
        for (int32_t n = 1; n < TERMS; n++) {
            term *= size * size / (real)(2 * n + 1);
            total += term;
        }
        tail = REAL(0.5) - density * total;
    } else {
        tail = density / continued_fraction(size, 1);
    }
    return z >= REAL(0.0) ? tail : REAL(1.0) - tail;
}

/* The value that a standard normal variable exceeds with this probability below ½, by Newton's method. */
INTERNAL real normal_quantile(real tail) {
    real z = SQRT(-REAL(2.0) * log_(tail));
    for (int32_t time_1 = 0; time_1 < NEWTON_STEPS; time_1++) {
        real found = normal_tail(z);
        z += (log_(found) - log_(tail)) * found * SQRT_2_PI / exp_(-REAL(0.5) * z * z);
    }
    return z;
}

/* The value of z + n/(z + (n + 1)/(z + …)) for the first n. */
INTERNAL real continued_fraction(real z, int32_t first) {
    real fraction = z;
    for (int32_t n = TERMS; n > first - 1; n--) {
        fraction = z + (real)n / fraction;
    }
    return fraction;
}

/* Probability that chi2 with at least one degree of freedom exceeds a value, by the finite sum. */
INTERNAL real chi2_tail(int32_t dof, real chi2) {
    real half = REAL(0.5) * chi2;
    if (!(half < REAL(700.0))) {
        return REAL(0.0);
    }
    bool is_odd = floor_mod_32(dof, 2) == 1;
    real term = is_odd ? REAL(2.0) * SQRT(chi2) / SQRT_2_PI : REAL(1.0);
    real total = REAL(0.0);
    for (int32_t k = 0; k < floor_div_32(dof, 2); k++) {
        total += term;
        term *= half / ((real)k + (is_odd ? REAL(1.5) : REAL(1.0)));
    }
    return (is_odd ? REAL(2.0) * normal_tail(SQRT(chi2)) : REAL(0.0)) + exp_(-half) * total;
}

/* Mean of a normal variable given that it is positive: E[w²] if w² was measured and may be near 0. */
INTERNAL real mean_if_positive(real mean, real sigma) {
    real z = mean / sigma;
    if (z < -FAR_TAIL) {  /* where the mean and what is added to it would cancel */
        return sigma / continued_fraction(-z, 2);
    }
    return mean + sigma * exp_(-REAL(0.5) * z * z) / (SQRT_2_PI * normal_tail(-z));
}

/* Time as the radio counts it: 40-bit counters of 15.65 ps ticks, unwrapped to integers.
 *
 * Ticks are subtracted as integers and only then turned into seconds or metres (``docs/maths.md`` section 3):
 * float64 seconds lose 0.6 mm after an hour, integers lose nothing. */

/* Physical and radio constants, each with its source. */

/* The unwrapped time nearest to the expected one that agrees with the counter. */
INTERNAL int64_t nearest(int64_t counter, int64_t expected_ticks, int32_t bits) {
    int64_t half = 1;
    half = (int64_t)((uint64_t)half << (bits - 1));
    return expected_ticks - half + ((counter - expected_ticks + half) & (2 * half - 1));
}

/* Whether one crystal's counter may advance by ``counter_ticks`` while another's advances by ``elapsed_ticks``. */
INTERNAL bool may_elapse(int64_t counter_ticks, int64_t elapsed_ticks, real slack_ticks) {
    return (real)abs_64(counter_ticks - elapsed_ticks) <= MAX_DRIFT * (real)elapsed_ticks + slack_ticks;
}

/* Unwrapped ticks of a counter value; the first stamp keeps its own value.
 *
 * Without a host time, NaN, a stamp is assumed to lie within half a wrap (8.6 s for 40 bits) of the stamp before it,
 * before or after. With one, the host's clock decides which wrap it is, however long the gap, as long as the host's
 * clock errs by less than half a wrap over that gap. Stamps with and without a host time may alternate. A stamp out of
 * order is placed where it belongs, before the ones already seen. */
INTERNAL int64_t unwrap(Unwrapper *u, int64_t counter, real host_s) {
    int64_t ticks = counter;
    if (u->has_stamp) {
        int64_t expected_ticks = u->last_ticks;
        real elapsed_s = host_s - u->last_host_s;
        if (abs_real(elapsed_s) >= REAL(0.0)) {  /* it is a number */
            elapsed_s = max_real(min_real(elapsed_s, LONGEST_JUMP_S), -LONGEST_JUMP_S);
            expected_ticks += floor_real(elapsed_s * TICK_RATE_HZ + REAL(0.5));
        }
        ticks = nearest(counter, expected_ticks, u->bits);
        if (!(abs_real(host_s) >= REAL(0.0))) {
            host_s = u->last_host_s + (real)(ticks - u->last_ticks) * TICK_S;
        }
    }
    u->has_stamp = true;
    u->last_ticks = ticks;
    u->last_host_s = host_s;
    return ticks;
}

/* Time of a fix at this master time, given the tag's time of it, both unwrapped. */
INTERNAL int64_t fix_time_ticks(FixTime *time, int64_t ticks_master, int64_t rx_ticks_tag) {
    if (!time->has_fix) {
        time->has_fix = true;
        time->first_ticks_master = ticks_master;
    } else {
        int64_t elapsed = rx_ticks_tag - time->last_rx_ticks_tag;
        int64_t gone = ticks_master - time->last_ticks_master;
        if (elapsed <= 0 || !may_elapse(gone, elapsed, (real)FLIGHT_SLACK_TICKS)) {
            time->first_ticks_master += gone - max_64(elapsed, 1);
        }
    }
    time->last_ticks_master = ticks_master;
    time->last_rx_ticks_tag = rx_ticks_tag;
    return ticks_master - time->first_ticks_master;
}

/* What the frames of both protocols share: the header, relayed receptions, and reasons why bytes are not a beacon.
 *
 * A beacon is an IEEE 802.15.4 data frame of at most 127 bytes, little endian throughout. 40-bit stamps travel as a low
 * word of 32 bits and a high byte. */

/* Whole numbers in frames, lowest byte first. */

/* Read an unsigned integer of this many bytes. */
INTERNAL int64_t unsigned_(uint8_t *data, int32_t at, int32_t size) {
    int64_t number = 0;
    for (int32_t byte = size - 1; byte > -1; byte--) {
        number = (int64_t)((uint64_t)number << 8) | data[at + byte];
    }
    return number;
}

/* Read an unsigned integer of two bytes, in an ``int``. */
INTERNAL int32_t two_bytes(uint8_t *data, int32_t at) {
    return data[at] | (int32_t)((uint32_t)data[at + 1] << 8);
}

/* Read a signed integer of four bytes. */
INTERNAL int64_t signed_(uint8_t *data, int32_t at) {
    int64_t number = unsigned_(data, at, 4);
    return number < SIGN ? number : number - 2 * SIGN;
}

/* Receptions with a weak first path: they may be late, so they get less weight. */

/* Return the factor on a reception's variance, 1 to ``MAX_VARIANCE_FACTOR``, growing with the powers' difference.
 *
 * The factor is 1 if a power is missing (NaN), not finite or impossible (a first path above the total). */
INTERNAL real variance_factor(real rx_power_dbm, real first_path_power_dbm) {
    real difference_db = rx_power_dbm - first_path_power_dbm;
    if (!(CLEAR_DB < difference_db && difference_db <= MAX_DIFFERENCE_DB)) {
        return REAL(1.0);
    }
    real part = min_real((difference_db - CLEAR_DB) / (BLOCKED_DB - CLEAR_DB), REAL(1.0));
    return MAX_VARIANCE_FACTOR * exp_((part * part * (REAL(3.0) - REAL(2.0) * part) - REAL(1.0)) * LOG_FACTOR);
}

/* The almanac's pages, all that a tag must know about a site, and the published instants of beacons. */

/* Periods are coded in 8 bits like floating-point numbers: 16 steps per doubling, from 4 ms on. */

/* Return the mean time between two beacons of an anchor that states this code. */
INTERNAL int64_t period_ticks(int32_t code) {
    int64_t unit = UNIT_STEPS * DELAYED_TX_GRANULARITY_TICKS;
    return unit * (int32_t)((uint32_t)(STEPS + (code & 15)) << (code >> 4));
}

/* Table of the anchors that are received, or that others relay: one row each. */

/* Return the row of an anchor, −1 if there is none. */
INTERNAL int32_t find_neighbour(Neighbours *t, int32_t anchor) {
    for (int32_t row = 0, row_end = t->count; row < row_end; row++) {
        if (t->rows[row].anchor == anchor) {
            return row;
        }
    }
    return -1;
}

/* Return the row of an anchor about which something is learnt; a new one may replace the least important. */
INTERNAL int32_t neighbour_of(Neighbours *t, int32_t anchor, int64_t rx_ticks) {
    Neighbour fresh;
    int32_t row = find_neighbour(t, anchor);
    if (row < 0) {
        row = t->count < MAX_NEIGHBOURS ? t->count : least_important(t, rx_ticks);
        t->count = max_32(t->count, row + 1);
        fresh = (Neighbour){0};
        t->rows[row] = fresh;
        t->rows[row].anchor = anchor;
        t->rows[row].used_ticks = NEVER;
        t->rows[row].own_relays_ticks = NEVER;
        t->rows[row].relayed_ticks = NEVER;
    }
    t->rows[row].changed_ticks = rx_ticks;
    return row;
}

/* Return the row to forget: the one of lowest rank and, among equals, the longest silent.
 *
 * Anchors in use rank highest, then confirmed ones, then strangers with several frames. */
INTERNAL int32_t least_important(Neighbours *t, int64_t rx_ticks) {
    int32_t least = -1;
    int32_t least_rank = 0;
    for (int32_t row = 0, row_end = t->count; row < row_end; row++) {
        Neighbour *n = &t->rows[row];
        int32_t rank = 0;
        if (n->frames > 0) {
            bool is_used = rx_ticks - n->used_ticks < lasting_ticks(n, RELAYED_TICKS);
            rank = is_used ? 3 : is_confirmed(n, rx_ticks) ? 2 : n->frames > 1 ? 1 : 0;
        }
        bool is_less = least < 0 || rank < least_rank;
        if (!is_less && rank == least_rank) {
            is_less = n->changed_ticks < t->rows[least].changed_ticks;
        }
        if (row != t->row && is_less) {
            least = row;
            least_rank = rank;
        }
    }
    return least;
}

/* Whether another anchor has recently received this one, or its own relays have fitted. */
INTERNAL bool is_confirmed(Neighbour *n, int64_t rx_ticks) {
    return rx_ticks - max_64(n->relayed_ticks, n->own_relays_ticks) < lasting_ticks(n, RELAYED_TICKS);
}

/* Whether another anchor has recently received this one. */
INTERNAL bool is_relayed(Neighbour *n, int64_t rx_ticks) {
    return rx_ticks - n->relayed_ticks < lasting_ticks(n, RELAYED_TICKS);
}

/* Whether the anchor has recently been received. */
INTERNAL bool is_present(Neighbour *n, int64_t rx_ticks) {
    return rx_ticks - n->rx_ticks < lasting_ticks(n, PRESENT_TICKS);
}

INTERNAL int64_t lasting_ticks(Neighbour *n, int64_t least_ticks) {
    return max_64(least_ticks, LASTING_PERIODS * period_ticks(n->period_code));
}

/* Forget when each anchor was received, after a restart of the receiver's counter. */
INTERNAL void forget_times(Neighbours *t) {
    t->has_newest = false;
    for (int32_t row = 0, row_end = t->count; row < row_end; row++) {
        forget_row(&t->rows[row]);
    }
}

/* Reset times after a sleep from ``rx_ticks`` on: anchors confirmed then count as confirmed at ``rx_counter``. */
INTERNAL void wake_times(Neighbours *t, int64_t rx_ticks, int64_t rx_counter) {
    t->has_newest = false;
    for (int32_t row = 0, row_end = t->count; row < row_end; row++) {
        bool was_confirmed = is_confirmed(&t->rows[row], rx_ticks);
        forget_row(&t->rows[row]);
        if (was_confirmed) {
            t->rows[row].relayed_ticks = rx_counter;
        }
    }
}

INTERNAL void forget_row(Neighbour *n) {
    n->frames = 0;
    n->impossible = 0;
    n->has_rival = false;
    n->was_relayed = false;
    n->changed_ticks = NEVER;
    n->used_ticks = NEVER;
    n->own_relays_ticks = NEVER;
    n->relayed_ticks = NEVER;
}

/* times: forged frames in between do not replace an anchor that still sends. */

/* Unwrap the TX stamp of a frame along the anchor's own counter. Return the kind of the stamp.
 *
 * ``rx_ticks`` is the receiver's own reading, unwrapped; ``period_ticks`` the time between two frames of an anchor,
 * if known. If the stamp fits, ``row`` is the anchor's and holds the result; a first stamp keeps its own value. */
SKYLESS_EXPORT int32_t skyless_unwrap_stamp(Neighbours *t, int32_t anchor, int32_t sequence, int64_t tx_counter, int64_t
        rx_ticks, int64_t period_ticks) {
    t->row = -1;
    int32_t known = find_neighbour(t, anchor);
    bool is_repeated = known >= 0 && is_newest(&t->rows[known], sequence, tx_counter);
    if (t->has_newest && rx_ticks <= t->newest_rx_ticks) {
        return is_repeated ? DUPLICATE : OUT_OF_ORDER;
    }
    t->row = neighbour_of(t, anchor, rx_ticks);
    Neighbour *n = &t->rows[t->row];
    if (n->frames > 0) {
        int64_t elapsed = rx_ticks - n->rx_ticks;
        int64_t tx_ticks = nearest(tx_counter, n->tx_ticks + elapsed, 40);
        if (!may_elapse(tx_ticks - n->tx_ticks, elapsed, (real)NOISE_TICKS)) {
            int64_t silence_ticks = max_64(RESTART_SILENCE_TICKS, RESTART_SILENCE_PERIODS * period_ticks);
            return is_repeated ? DUPLICATE : reject(n, sequence, tx_counter, rx_ticks, elapsed > silence_ticks);
        }
        keep(n, sequence, tx_ticks, rx_ticks, 2);
    } else {
        keep(n, sequence, tx_counter, rx_ticks, 1);
    }
    t->has_newest = true;
    t->newest_rx_ticks = rx_ticks;
    return STAMP_FITS;
}

INTERNAL bool is_newest(Neighbour *n, int32_t sequence, int64_t tx_counter) {
    return n->frames > 0 && (n->tx_ticks & TICK_MASK) == tx_counter && n->sequence == sequence;
}

INTERNAL void keep(Neighbour *n, int32_t sequence, int64_t tx_ticks, int64_t rx_ticks, int32_t frames) {
    n->frames = frames;
    n->impossible = 0;
    n->has_rival = false;
    n->sequence = sequence;
    n->tx_ticks = tx_ticks;
    n->rx_ticks = rx_ticks;
}

/* Count an impossible stamp. After a few of them the next stamp of a silent anchor is a beginning.
 *
 * If only the first stamp, which may be false, stands against it, two stamps that fit each other are one. */
INTERNAL int32_t reject(Neighbour *n, int32_t sequence, int64_t tx_counter, int64_t rx_ticks, bool is_silent) {
    n->impossible += 1;
    if (n->frames == 1 && n->has_rival) {
        int64_t elapsed = rx_ticks - n->rival_rx_ticks;
        int64_t tx_ticks = nearest(tx_counter, n->rival_tx_ticks + elapsed, 40);
        if (may_elapse(tx_ticks - n->rival_tx_ticks, elapsed, (real)NOISE_TICKS)) {
            keep(n, sequence, tx_counter, rx_ticks, 2);
            return IMPOSSIBLE_STAMP;
        }
    }
    n->has_rival = true;
    n->rival_rx_ticks = rx_ticks;
    n->rival_tx_ticks = tx_counter;
    if (n->impossible >= STAMPS_BEFORE_RESTART && is_silent) {
        n->frames = 0;
        return ANCHOR_RESTART;
    }
    return IMPOSSIBLE_STAMP;
}

/* Choice of the pages in use, among those that beacons carry, by a majority of the anchors. */

/* Checks of page contents (``docs/protocol.md``, "Pages"): frames may carry any values. */

/* Whether the page at ``at`` has possible values; pages of unknown types count as possible. */
INTERNAL bool is_possible_page(uint8_t *data, int32_t at) {
    int32_t kind = data[at];
    if (kind == ANCHOR_PAGE) {
        return is_coordinate(data, at + 3) && is_coordinate(data, at + 7) && is_coordinate(data, at + 11);
    }
    if (kind == SCHEDULE_PAGE) {
        int32_t slots = data[at + 5];
        int32_t frames_per_node = data[at + 6];
        int32_t anchors = data[at + 9];
        int64_t slot_ticks = unsigned_(data, at + 1, 4);
        if (slot_ticks == 0 || slot_ticks * slots > MAX_SUPERFRAME_TICKS || frames_per_node == 0) {
            return false;
        }
        return (0 < anchors * frames_per_node && anchors * frames_per_node <= slots) && is_coordinate(data, at + 11);
    }
    if (kind == NOISE_PAGE) {
        return is_noise(data, at + 1) && is_noise(data, at + 5) && is_noise(data, at + 9) && is_noise(data, at + 13);
    }
    if (kind == GEOREFERENCE_PAGE) {
        bool is_on_earth = abs_64(signed_(data, at + 1)) <= floor_div_64(CIRCLE, 4) && abs_64(signed_(data, at + 5)) <=
                floor_div_64(CIRCLE, 2);
        return is_on_earth && is_coordinate(data, at + 9) && unsigned_(data, at + 13, 4) < CIRCLE;
    }
    if (kind == ACCURACY_PAGE) {
        return unsigned_(data, at + 9, 2) > 0 && unsigned_(data, at + 11, 2) > 0;
    }
    if (kind == SITE_PAGE) {
        return data[at + 1] > 0 && is_coordinate(data, at + HEIGHT_FLAG_AT + 1);
    }
    return true;
}

INTERNAL bool is_coordinate(uint8_t *data, int32_t at) {
    return abs_64(signed_(data, at)) <= MAX_COORDINATE_MM;
}

INTERNAL bool is_noise(uint8_t *data, int32_t at) {
    int64_t bits = unsigned_(data, at, 4);
    return bits <= MAX_NOISE_BITS || bits == SIGN;
}

/* Process the page at ``page_at`` (0: none) of the newest anchor's beacon. Return what this changed. */
INTERNAL int32_t note_page(SitePages *p, Neighbours *t, uint8_t *frame, int32_t page_at, int64_t rx_ticks) {
    Neighbour *n = &t->rows[t->row];
    if (!p->has_first) {
        p->has_first = true;
        p->first_ticks = rx_ticks;
    }
    if (n->almanac_issue == p->issue) {
        return SAME_PAGES;
    }
    if (page_at > 0 && (NOISE_PAGE <= frame[page_at] && frame[page_at] <= SITE_PAGE)) {
        collect(p, t, frame, page_at);
    }
    return is_majority(p, t, n->almanac_issue, rx_ticks) ? complete(p, t, n->almanac_issue) : SAME_PAGES;
}

/* Note that the newest anchor has sent a page; if there is no space, replace the worst page. */
INTERNAL void collect(SitePages *p, Neighbours *t, uint8_t *frame, int32_t page_at) {
    Neighbour *n = &t->rows[t->row];
    int32_t place = 0;
    while (place < p->count && !(p->collected[place].issue == n->almanac_issue && is_page(p, place, frame, page_at))) {
        place += 1;
    }
    if (place == p->count) {
        if (p->count == MAX_PAGES) {
            place = worst(p, t);
        }
        p->count = max_32(p->count, place + 1);
        p->collected[place].issue = n->almanac_issue;
        p->collected[place].sender_count = 0;
        for (int32_t byte = 0; byte < PAGE_BYTES; byte++) {
            p->collected[place].contents[byte] = frame[page_at + byte];
        }
    }
    CollectedPage *one = &p->collected[place];
    for (int32_t sender = 0, sender_end = one->sender_count; sender < sender_end; sender++) {
        if (one->senders[sender] == n->anchor) {
            return;
        }
    }
    if (one->sender_count < MAX_SENDERS) {
        one->senders[one->sender_count] = n->anchor;
        one->sender_count += 1;
    }
}

INTERNAL bool is_page(SitePages *p, int32_t place, uint8_t *frame, int32_t page_at) {
    int32_t same = 0;
    while (same < PAGE_BYTES && p->collected[place].contents[same] == frame[page_at + same]) {
        same += 1;
    }
    return same == PAGE_BYTES;
}

/* Return the page to replace: of the issue, then of the senders, with the fewest supporters that others receive.
 *
 * The number of strangers does not matter. */
INTERNAL int32_t worst(SitePages *p, Neighbours *t) {
    int32_t worst = 0;
    int32_t least_issue = 0;
    int32_t least = 0;
    for (int32_t place = 0, place_end = p->count; place < place_end; place++) {
        CollectedPage *one = &p->collected[place];
        int32_t of_issue = 0;
        for (int32_t row = 0, row_end = t->count; row < row_end; row++) {
            if (t->rows[row].was_relayed && t->rows[row].almanac_issue == one->issue) {
                of_issue += 1;
            }
        }
        int32_t support = supporters(one, t);
        if (place == 0 || of_issue < least_issue || (of_issue == least_issue && support < least)) {
            worst = place;
            least_issue = of_issue;
            least = support;
        }
    }
    return worst;
}

INTERNAL int32_t supporters(CollectedPage *one, Neighbours *t) {
    int32_t support = 0;
    for (int32_t row = 0, row_end = t->count; row < row_end; row++) {
        for (int32_t sender = 0, sender_end = one->sender_count; sender < sender_end; sender++) {
            if (t->rows[row].was_relayed && t->rows[row].anchor == one->senders[sender]) {
                support += 1;
            }
        }
    }
    return support;
}

/* Whether most of the anchors present state this issue. */
INTERNAL bool is_majority(SitePages *p, Neighbours *t, int32_t issue, int64_t rx_ticks) {
    int32_t present = 0;
    int32_t stating = 0;
    for (int32_t row = 0, row_end = t->count; row < row_end; row++) {
        Neighbour *n = &t->rows[row];
        if (n->was_relayed && is_present(n, rx_ticks)) {
            present += 1;
            stating += n->almanac_issue == issue ? 1 : 0;
        }
    }
    bool is_enough = present >= MIN_ANCHORS || (present > 0 && rx_ticks - p->first_ticks >= PRESENT_TICKS);
    return is_enough && 2 * stating > present;
}

/* Use the pages of an issue if all are there; among several contents, those of most anchors that match it. */
INTERNAL int32_t complete(SitePages *p, Neighbours *t, int32_t issue) {
    Choices c = {0};
    int32_t trials = 1;
    for (int32_t place = 0, place_end = p->count; place < place_end; place++) {
        if (p->collected[place].issue == issue) {
            p->collected[place].support = supporters(&p->collected[place], t);
            add_choice(&c, p, place);
        }
    }
    for (int32_t kind = 0; kind < PAGE_KINDS; kind++) {
        trials *= options(&c, kind);
    }
    for (int32_t trial = 0, trial_end = min_32(trials, MAX_TRIALS); trial < trial_end; trial++) {
        int32_t rest = trial;
        int32_t pages = 0;
        for (int32_t kind = 0; kind < PAGE_KINDS; kind++) {
            int32_t option = floor_mod_32(rest, options(&c, kind));
            rest = floor_div_32(rest, options(&c, kind));
            c.chosen[kind] = option < c.counts[kind] ? c.places[kind][option] : NO_PAGE;
            pages += option < c.counts[kind] ? 1 : 0;
        }
        if (p->collected[c.chosen[SITE_KIND]].contents[1] == pages && issue_of(p, &c) == issue) {
            return use_chosen(p, &c, issue);
        }
    }
    return SAME_PAGES;
}

/* Return the number of candidates for a page; a site may have no georeference. */
INTERNAL int32_t options(Choices *c, int32_t kind) {
    return c->counts[kind] + (kind == EARTH_KIND ? 1 : 0);
}

/* Add a page to those of its type, after those that more anchors support. */
INTERNAL void add_choice(Choices *c, SitePages *p, int32_t place) {
    int32_t kind = p->collected[place].contents[0] - NOISE_PAGE;
    int32_t index_ = c->counts[kind];
    while (index_ > 0 && p->collected[c->places[kind][index_ - 1]].support < p->collected[place].support) {
        c->places[kind][index_] = c->places[kind][index_ - 1];
        index_ -= 1;
    }
    c->places[kind][index_] = place;
    c->counts[kind] += 1;
}

/* Return ``site_issue`` of the chosen pages. */
INTERNAL int32_t issue_of(SitePages *p, Choices *c) {
    int64_t crc = ONES;
    for (int32_t kind = 0; kind < PAGE_KINDS; kind++) {
        if (c->chosen[kind] != NO_PAGE) {
            for (int32_t byte = 0; byte < PAGE_BYTES; byte++) {
                crc = crc ^ p->collected[c->chosen[kind]].contents[byte];
                for (int32_t time_1 = 0; time_1 < 8; time_1++) {
                    crc = (crc >> 1) ^ (CRC_32 * (crc & 1));
                }
            }
        }
    }
    crc = crc ^ ONES;
    return (crc ^ (crc >> 16)) & 65535;
}

/* Use the chosen pages. */
INTERNAL int32_t use_chosen(SitePages *p, Choices *c, int32_t issue) {
    int32_t outcome = OTHER_PAGES;
    for (int32_t kind = 0; kind < PAGE_KINDS; kind++) {
        for (int32_t byte = 0; byte < PAGE_BYTES; byte++) {
            int32_t place = c->chosen[kind];
            int32_t value = place != NO_PAGE ? p->collected[place].contents[byte] : 0;
            bool is_setting = kind != EARTH_KIND && (kind != SITE_KIND || byte >= HEIGHT_FLAG_AT);
            if (is_setting && value != p->used[kind].contents[byte]) {
                outcome = OTHER_SETTINGS;
            }
            p->used[kind].contents[byte] = value;
        }
    }
    p->issue = issue;
    p->count = 0;
    return outcome;
}

/* Beacons of protocol 2 and their bytes (``docs/protocol2.md``); little endian throughout, 127 bytes at most. */

/* Read a whole frame, FCS included. Return ``INTACT``, or why it is not a beacon of version 2. */
SKYLESS_EXPORT int32_t skyless_read_frame(uint8_t *frame, int32_t length, BeaconFields *b) {
    int32_t fault = header_fault(frame, length);
    if (fault != INTACT) {
        return fault;
    }
    int32_t flags = frame[FLAGS_AT];
    int32_t at = FIXED_BYTES;
    b->sequence = frame[2];
    b->period_code = frame[19];
    const int32_t new_1 = two_bytes(frame, 3);
    const int32_t new_2 = two_bytes(frame, 7);
    const int32_t new_3 = two_bytes(frame, 17);
    b->site = new_1;
    b->anchor = new_2;
    b->almanac_issue = new_3;
    b->tx_ticks = unsigned_(frame, 12, 5);
    b->has_place = (flags & HAS_POSITION) != 0;
    b->has_phases = (flags & HAS_PHASES) != 0;
    b->relay_bytes = 0;
    b->certificate_at = 0;
    b->page_at = 0;
    b->weak = 0;
    b->heard_count = 0;
    b->heard_at = 0;
    if (b->has_place) {
        read_place(frame, at, &b->place);
        at += POSITION_BYTES;
    }
    if ((flags & HAS_CERTIFICATE) != 0) {
        b->certificate_at = at;
        at += CERTIFICATE_BYTES;
    } else {
        int32_t entries = two_bytes(frame, at);
        b->heard_at = at + COUNT_BYTES;
        b->heard_count = entries & COUNT_MASK;
        b->weak = entries >> COUNT_BITS;
        at = b->heard_at + b->heard_count * HEARD_BYTES;
    }
    if ((flags & HAS_PAGE) != 0) {
        b->page_at = at;
        at += PAGE_BYTES;
    }
    b->authentication_at = (flags & HAS_AUTHENTICATION) != 0 ? at : 0;
    if (b->period_code > LONGEST_PERIOD_CODE) {
        return BAD_PERIOD;
    }
    if (b->heard_count > MAX_HEARD || (b->weak) >> (b->heard_count) != 0 || !read_relays(frame, b)) {
        return BAD_HEARD;
    }
    return b->page_at > 0 && !is_possible_page(frame, b->page_at) ? BAD_PAGE : INTACT;
}

/* Return why bytes are not a beacon of version 2, judging by length, check sequence, header and flags. */
INTERNAL int32_t header_fault(uint8_t *frame, int32_t length) {
    if (length > MAX_FRAME_BYTES) {
        return TOO_LONG;
    }
    if (length <= FCS_BYTES) {
        return TOO_SHORT;
    }
    if (checksum(frame, length) != 0) {
        return BAD_FCS;
    }
    if (length < HEADER_BYTES + FCS_BYTES || two_bytes(frame, 0) != FRAME_CONTROL || two_bytes(frame, 5) != BROADCAST) {
        return NOT_A_BEACON;
    }
    int32_t magic = two_bytes(frame, 9);
    if ((magic & MAGIC_MASK) != BEACON_MAGIC) {
        return NOT_A_BEACON;
    }
    if (magic != VERSION_2) {
        return UNKNOWN_VERSION;
    }
    if (length < FIXED_BYTES + COUNT_BYTES + FCS_BYTES) {
        return TOO_SHORT;
    }
    return length_fault(frame, length);
}

INTERNAL int32_t length_fault(uint8_t *frame, int32_t length) {
    int32_t flags = frame[FLAGS_AT];
    if ((flags & RESERVED_FLAGS) != 0 || ((flags & HAS_CERTIFICATE) != 0 && (flags & ~ALONGSIDE_CERTIFICATE) != 0)) {
        return BAD_FLAGS;
    }
    int32_t bare = bare_bytes(flags);
    if (length < bare) {
        return BAD_LENGTH;
    }
    if ((flags & HAS_CERTIFICATE) == 0) {
        int32_t at = FIXED_BYTES + ((flags & HAS_POSITION) != 0 ? POSITION_BYTES : 0);
        bare += (two_bytes(frame, at) & COUNT_MASK) * HEARD_BYTES;
    }
    return length == bare ? INTACT : BAD_LENGTH;
}

/* Return the length of a frame with these flags and no relayed receptions. */
INTERNAL int32_t bare_bytes(int32_t flags) {
    int32_t size = FIXED_BYTES + FCS_BYTES + ((flags & HAS_CERTIFICATE) != 0 ? CERTIFICATE_BYTES : COUNT_BYTES);
    size += (flags & HAS_POSITION) != 0 ? POSITION_BYTES : 0;
    size += (flags & HAS_PAGE) != 0 ? PAGE_BYTES : 0;
    return size + ((flags & HAS_AUTHENTICATION) != 0 ? AUTHENTICATION_BYTES : 0);
}

INTERNAL void read_place(uint8_t *frame, int32_t at, StatedPlace *place) {
    for (int32_t axis = 0; axis < 3; axis++) {
        int32_t low = two_bytes(frame, at + 3 * axis);
        int32_t high = frame[at + 3 * axis + 2];
        place->position_mm[axis] = low + 65536 * (high > 127 ? high - 256 : high);
    }
    int32_t floor_ = frame[at + 10];
    place->std_mm = frame[at + 9];
    place->floor_ = floor_ > 127 ? floor_ - 256 : floor_;
    place->zone = frame[at + 11];
}

/* Copy the receptions that are not weak. Return False if one is of the sender, or two are of the same anchor. */
INTERNAL bool read_relays(uint8_t *frame, BeaconFields *b) {
    for (int32_t one = 0, one_end = b->heard_count; one < one_end; one++) {
        int32_t at = b->heard_at + one * HEARD_BYTES;
        int32_t anchor = two_bytes(frame, at);
        if (anchor == b->anchor) {
            return false;
        }
        for (int32_t before = 0; before < one; before++) {
            if (two_bytes(frame, b->heard_at + before * HEARD_BYTES) == anchor) {
                return false;
            }
        }
        if ((((b->weak) >> one) & 1) == 0) {
            for (int32_t byte = 0; byte < HEARD_BYTES; byte++) {
                b->relays[b->relay_bytes + byte] = frame[at + byte];
            }
            b->relay_bytes += HEARD_BYTES;
        }
    }
    return true;
}

/* Return CRC-16 x¹⁶ + x¹² + x⁵ + 1, initially 0, bit 0 of each byte first (clause 7.2.10); 0 with the frame's FCS.
 *
 * The polynomial is applied to four bits at a time, so no table is needed. Python uses the faster ``ieee802154.fcs``. */
INTERNAL int32_t checksum(uint8_t *data, int32_t length) {
    int32_t crc = 0;
    for (int32_t at = 0; at < length; at++) {
        int32_t low = (crc ^ data[at]) & 255;
        int32_t mixed = (low ^ (int32_t)((uint32_t)low << 4)) & 255;
        crc = (((crc >> 8) ^ (int32_t)((uint32_t)mixed << 8)) ^ (int32_t)((uint32_t)mixed << 3)) ^ (mixed >> 4);
    }
    return crc;
}

/* Choice of the site that a tag uses, among those it receives. */

/* Count an anchor of a site. Return whether its beacon is to be used. */
INTERNAL int32_t choose_site(SiteChoice *choice, int32_t site, int32_t anchor, int64_t rx_ticks) {
    if (choice->only_site != NO_SITE && choice->only_site != (site & SITE_MASK)) {
        return FOREIGN;
    }
    int32_t counted = index_of(choice, site);
    choice->sites[counted].newest_ticks = rx_ticks;
    count_anchor(&choice->sites[counted], anchor, rx_ticks);
    if (site == choice->site) {
        return USED;
    }
    if (choice->site != NO_SITE) {
        if (!prefers(choice, counted, rx_ticks)) {
            return FOREIGN;
        }
        if (has_failed(choice, rx_ticks)) {
            note_failed(choice);
        }
    }
    choice->site = site;
    choice->has_fix = false;
    choice->since_ticks = rx_ticks;
    choice->heard_ticks = rx_ticks;
    return CHANGED;
}

/* Note that the site in use has given a fix. */
INTERNAL void note_fix(SiteChoice *choice, int64_t rx_ticks) {
    choice->has_fix = true;
    choice->fix_ticks = rx_ticks;
    choice->failed_count = 0;
}

/* Restart all times after the tag's counter has restarted at this reading. */
INTERNAL void restart_choice(SiteChoice *choice, int64_t rx_ticks) {
    choice->since_ticks = rx_ticks;
    choice->heard_ticks = rx_ticks;
    choice->has_fix = false;
    choice->count = 0;
}

INTERNAL int32_t find_site(SiteChoice *choice, int32_t site) {
    for (int32_t one = 0, one_end = choice->count; one < one_end; one++) {
        if (choice->sites[one].site == site) {
            return one;
        }
    }
    return -1;
}

/* Return a site's index; a new site may replace the one received longest ago, except the one in use. */
INTERNAL int32_t index_of(SiteChoice *choice, int32_t site) {
    int32_t found = find_site(choice, site);
    if (found < 0) {
        found = choice->count;
        if (choice->count == MAX_SITES) {
            found = choice->sites[0].site != choice->site ? 0 : 1;
            for (int32_t one = 0; one < MAX_SITES; one++) {
                bool is_older = choice->sites[one].newest_ticks < choice->sites[found].newest_ticks;
                if (is_older && choice->sites[one].site != choice->site) {
                    found = one;
                }
            }
        }
        choice->count = max_32(choice->count, found + 1);
        choice->sites[found].site = site;
        choice->sites[found].count = 0;
    }
    return found;
}

/* Note when an anchor was received; if there are too many, forget the one received longest ago. */
INTERNAL void count_anchor(CountedSite *counted, int32_t anchor, int64_t rx_ticks) {
    int32_t place = -1;
    int32_t oldest = 0;
    for (int32_t one = 0, one_end = counted->count; one < one_end; one++) {
        if (counted->anchors[one].anchor == anchor) {
            place = one;
        }
        if (counted->anchors[one].rx_ticks < counted->anchors[oldest].rx_ticks) {
            oldest = one;
        }
    }
    if (place < 0) {
        place = counted->count < MAX_COUNTED ? counted->count : oldest;
        counted->count = max_32(counted->count, place + 1);
    }
    counted->anchors[place].anchor = anchor;
    counted->anchors[place].rx_ticks = rx_ticks;
}

/* Whether another site is better than the one in use. */
INTERNAL bool prefers(SiteChoice *choice, int32_t other, int64_t rx_ticks) {
    if (rx_ticks - choice->heard_ticks >= SITE_SILENCE_TICKS) {
        return true;
    }
    if (choice->has_fix && rx_ticks - choice->fix_ticks < SITE_SILENCE_TICKS) {
        return false;
    }
    int32_t present = received(choice, other, rx_ticks);
    if (has_failed(choice, rx_ticks)) {
        return present >= MIN_ANCHORS;
    }
    for (int32_t one = 0, one_end = choice->failed_count; one < one_end; one++) {
        if (choice->failed[one] == choice->sites[other].site) {
            return false;
        }
    }
    int32_t used = find_site(choice, choice->site);
    return present > (used >= 0 ? received(choice, used, rx_ticks) : 0);
}

/* Whether the site in use has given no fix for too long. */
INTERNAL bool has_failed(SiteChoice *choice, int64_t rx_ticks) {
    return rx_ticks - (choice->has_fix ? choice->fix_ticks : choice->since_ticks) >= TRIAL_TICKS;
}

/* Note that the site in use has failed; if there are too many, forget the first. */
INTERNAL void note_failed(SiteChoice *choice) {
    if (choice->failed_count == MAX_SITES) {
        for (int32_t one = 1; one < MAX_SITES; one++) {
            choice->failed[one - 1] = choice->failed[one];
        }
        choice->failed_count -= 1;
    }
    choice->failed[choice->failed_count] = choice->site;
    choice->failed_count += 1;
}

/* Return how many anchors of a site are being received. */
INTERNAL int32_t received(SiteChoice *choice, int32_t counted, int64_t rx_ticks) {
    CountedSite *one = &choice->sites[counted];
    int32_t present = 0;
    for (int32_t index_ = 0, index__end = one->count; index_ < index__end; index_++) {
        if (0 <= rx_ticks - one->anchors[index_].rx_ticks && rx_ticks - one->anchors[index_].rx_ticks < PRESENT_TICKS) {
            present += 1;
        }
    }
    return present;
}

/* Integrity of ``joint``'s fixes: fault tests, protection levels, alerts (``docs/maths.md`` section 8). */

/* ``limits_of`` for the horizontal plane. */
INTERNAL real horizontal_limit(real risk) {
    return MARGIN * SQRT(-REAL(2.0) * log_(risk));
}

/* ``limits_of`` for one axis. */
INTERNAL real vertical_limit(real risk) {
    return MARGIN * normal_quantile(REAL(0.5) * risk);
}

/* The estimator's state: one record of fixed capacity, in which anchors join and leave by moving blocks.
 *
 * The state vector, all clocks against the tag's own counter, in metres and m/s:
 *
 *     values      position (dim), then for each anchor its clock's offset: tag's reading − anchor's reading (whole ticks
 *                 are in ``Anchor``)
 *     rates       velocity (dim), then the rate of each offset
 *     tx noises   of each anchor's newest TX stamp, common to all who received it
 *     ambiguities for each anchor what its carrier phase shows beyond range and offset, once phases are in use
 *     meshes      for each anchor the difference between its clock as phases of relays show it and that of its stamps
 *     changes     for each anchor the part of the range error that changes as the tag moves
 *     constants   the part that stays
 *     slope       growth of ranges with distance
 *     height      true − given height of the tag, in 2-D
 *     zero        barometer reading − true height of the tag, in 3-D
 *     surveys     for each anchor (dim) its true position − its position in the almanac
 *
 * Behind the tx noises, once a motion sensor is in use (``motion``):
 *
 *     heading       cosine and sine of the angle from the sensor's level frame to the site's
 *     acceleration  (dim) what the sensor's accelerations lack in the site's frame: its bias, and its tilt times gravity
 *
 * Range errors and surveys are last because many sites state that they are exact. Exact states have no variance and no
 * covariance and are left out of all arithmetic (``State.n``), until a jump or a fault proves otherwise. Everything
 * behind the states in use is zero. */

/* Indices of the covariances */

/* Index in P of a state's row. */
INTERNAL int32_t row_of(int32_t state) {
    return PACKED ? (state * (state + 1)) >> 1 : state * STATES;
}

/* Length of a row of P up to ``end``: the whole row, or up to the diagonal. */
INTERNAL int32_t row_end(int32_t state, int32_t end) {
    return PACKED ? min_32(state + 1, end) : end;
}

/* Index in P of the covariance of two states. */
INTERNAL int32_t at(int32_t one, int32_t other) {
    return PACKED && other > one ? row_of(other) + one : row_of(one) + other;
}

/* Write the covariance of two states; if P is square, in both places. */
INTERNAL void set_covariance(State *s, int32_t one, int32_t other, real value) {
    s->P[at(one, other)] = value;
    if (!PACKED) {
        s->P[at(other, one)] = value;
    }
}

/* Start again without anchors at the origin, with the same settings.
 *
 * ``fault_std_m``: range errors of all anchors that the levels have to cover. ``has_open_ranges``: expect range errors
 * of half a metre and misplaced anchors, because the settings have been contradicted. */
SKYLESS_EXPORT void skyless_restart(State *s, int64_t rx_ticks, real late_share, real fault_std_m, bool has_open_ranges)
        {
    Status status = {0};
    clear(s);
    s->status = status;
    s->status.has_open_ranges = has_open_ranges;
    prepare(s);
    s->status.late_share = late_share;
    s->status.fault_std_m[LASTING] = fault_std_m;
    s->status.faded_ticks = rx_ticks;
    s->status.start_ticks = rx_ticks;
    s->status.epoch_ticks = rx_ticks;
}

/* Clear all states and anchors. Unused memory is zero already unless a search has used it. */
INTERNAL void clear(State *s) {
    int32_t states = s->layout.end;
    int32_t rows = s->rows;
    int32_t count = s->count;
    if (SHARES_MEMORY) {
        states = STATES;
        rows = SENSITIVITIES;
        count = MAX_ANCHORS;
    }
    for (int32_t state = 0; state < states; state++) {
        s->x[state] = REAL(0.0);
        for (int32_t other = 0; other < states; other++) {
            s->P[at(state, other)] = REAL(0.0);
        }
        for (int32_t row = 0; row < rows; row++) {
            s->V[state][row] = REAL(0.0);
        }
    }
    for (int32_t fault = 0; fault < FAULT_KINDS * count; fault++) {
        s->evidence[fault] = REAL(0.0);
        for (int32_t other = 0; other < FAULT_KINDS * count; other++) {
            s->information[fault][other] = REAL(0.0);
        }
    }
    for (int32_t anchor = 0; anchor < count; anchor++) {
        s->lasting_m[anchor] = REAL(0.0);
        for (int32_t other = 0; other < count; other++) {
            s->lasting_covariance[anchor][other] = REAL(0.0);
        }
    }
    for (int32_t row = 0; row < PROTECTED_ROWS; row++) {
        for (int32_t axis = 0; axis < AXES; axis++) {
            s->fix[row][axis] = REAL(0.0);
        }
    }
    s->hypotheses.count = 0;
    s->waiting = 0;
    s->count = 0;
}

/* Initialise a state that is zero except for its settings and dimensions. */
INTERNAL void prepare(State *s) {
    Status *status = &s->status;
    EstimatorSettings *settings = &s->settings;
    Tuning *tuning = &s->tuning;
    real stamps_m2 = settings->tx_variance_m2 + settings->rx_variance_m2;
    s->hypotheses.weight[0] = REAL(1.0);
    status->mean_nis = REAL(1.0);
    status->q_scale = REAL(1.0);
    status->height_ticks = NEVER;
    status->walk_scale = tuning->start_walk_scale;
    status->fault_std_m[LASTING] = tuning->lasting_std_m;
    status->fault_std_m[RECENT] = tuning->recent_std_m;
    status->fault_std_m[CREEPING] = tuning->creeping_std_m;
    status->mean_square_m2 = stamps_m2;
    status->place_square_m2[1] = stamps_m2;
    status->place_square_m2[0] = stamps_m2;
    status->place_distance_m = settings->place_distance_m;
    status->wild_share = tuning->start_wild;
    status->phase_variance_m2 = square(max_real(tuning->phase_start_std_m, settings->phase_std_m));
    if (settings->place_std_m > REAL(0.0)) {
        status->range_errors = CHANGING_RANGE_ERRORS;
    }
    real stated = max_real(max_real(max_real(settings->survey_std_m, settings->range_std_m), settings->slope_std_m),
            settings->height_std_m);
    if (status->has_open_ranges || stated > REAL(0.0)) {
        status->range_errors = ALL_RANGE_ERRORS;
    }
    set_layout(s);
    if (MOTION_STATES > 0) {
        expect_motion(s);
    }
    s->P[at(s->layout.slope, s->layout.slope)] = square(settings->slope_std_m);
    if (s->dim == 2) {
        s->P[at(s->layout.height, s->layout.height)] = square(settings->height_std_m);
    }
}

/* Compute the layout for the present number of anchors. */
INTERNAL void set_layout(State *s) {
    Layout *where = &s->layout;
    int32_t count = s->count;
    int32_t dim = s->dim;
    where->offset = dim;
    where->velocity = dim + count;
    where->rate = where->velocity + dim;
    where->tx_noise = where->rate + count;
    where->heading = where->tx_noise + count;
    where->acceleration = where->heading + (s->motion.has_states ? HEADINGS : 0);
    where->ambiguity = where->acceleration + (s->motion.has_states ? dim : 0);
    int32_t ambiguities = s->status.has_phases ? count : 0;
    where->mesh = where->ambiguity + ambiguities;
    where->change = where->mesh + ambiguities;
    where->constant = where->change + count;
    where->slope = where->constant + count;
    where->height = dim == 2 ? where->slope + 1 : 2;
    where->zero = dim == 2 ? where->slope : where->slope + 1;
    where->survey = where->slope + 2;
    where->end = where->survey + dim * count;
    s->rows = FAULT_KINDS * count + s->hypotheses.count;
    make_uncertain(s, s->status.range_errors);
}

/* Treat at least these range errors as uncertain, and update the number of uncertain states. */
INTERNAL void make_uncertain(State *s, int32_t range_errors) {
    s->status.range_errors = max_32(s->status.range_errors, range_errors);
    int32_t end = s->layout.change;
    if (s->status.range_errors == CHANGING_RANGE_ERRORS) {
        end = s->layout.constant;
    } else if (s->status.range_errors == ALL_RANGE_ERRORS) {
        end = s->layout.end;
    }
    s->used = end;
    s->n = floor_div_32(end + LANES - 1, LANES) * LANES;
}

/* Anchors join and leave */

/* The index of an anchor in the state, or −1. */
SKYLESS_EXPORT int32_t skyless_find_anchor(State *s, int32_t identifier) {
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        if (s->anchors[anchor].identifier == identifier) {
            return anchor;
        }
    }
    return -1;
}

/* Add an anchor with an unknown clock and, if ``is_open``, an unknown range error. Returns its index.
 *
 * ``std_m``: survey standard deviation of each coordinate; the settings' if negative. There must be room. */
SKYLESS_EXPORT int32_t skyless_add_anchor(State *s, int32_t identifier, real *position_m, real std_m, bool is_open) {
    EstimatorSettings *settings = &s->settings;
    Tuning *tuning = &s->tuning;
    int32_t dim = s->dim;
    int32_t anchor = s->count;
    Layout *where = &s->layout;
    Anchor *a = &s->anchors[anchor];
    for (int32_t time_1 = 0; time_1 < dim; time_1++) {
        insert_state(s, where->end);
    }
    insert_state(s, where->slope);  /* from the last block to the first, as each index is behind those inserted before */
    insert_state(s, where->constant);
    if (s->status.has_phases) {
        insert_state(s, where->change);
        insert_state(s, where->mesh);
    }
    insert_state(s, where->heading);
    insert_state(s, where->tx_noise);
    insert_state(s, where->velocity);
    for (int32_t kind = 0; kind < FAULT_KINDS; kind++) {
        insert_fault(s, (FAULT_KINDS - kind) * anchor, FAULT_KINDS * anchor + kind);
    }
    s->count += 1;
    set_layout(s);
    s->anchors[anchor] = (Anchor){0};
    a->identifier = identifier;
    for (int32_t axis = 0; axis < AXES; axis++) {
        a->position_m[axis] = position_m[axis];
    }
    a->rx_ticks = NEVER;
    a->tx_ticks = NEVER;
    a->walk_scale = REAL(1.0);
    a->change_variance_m2 = square(settings->place_std_m);
    s->lasting_covariance[anchor][anchor] = square(s->status.fault_std_m[LASTING]);
    for (int32_t kept = 0; kept < PACKETS_KEPT; kept++) {
        KeptPacket *packet = &s->packets[anchor][kept];
        packet->sequence = -1;
        packet->rx_ticks = NEVER;
        packet->tx_ticks = NEVER;
    }
    bool has_errors = settings->range_std_m > REAL(0.0) || settings->survey_std_m > REAL(0.0) || std_m > REAL(0.0);
    for (int32_t other = 0, other_end = s->count; other < other_end; other++) {
        clear_link(&s->links[anchor][other], has_errors ? square(tuning->open_pair_std_m) : REAL(0.0));
        clear_link(&s->links[other][anchor], has_errors ? square(tuning->open_pair_std_m) : REAL(0.0));
    }
    real range_std_m = settings->range_std_m;
    real survey_std_m = std_m < REAL(0.0) ? settings->survey_std_m : std_m;
    if (is_open || s->status.has_open_ranges) {
        range_std_m = tuning->late_std_m;
        survey_std_m = tuning->open_survey_std_m;
    }
    if (survey_std_m > REAL(0.0)) {
        make_uncertain(s, ALL_RANGE_ERRORS);
    }
    s->P[at(where->change + anchor, where->change + anchor)] = a->change_variance_m2;
    s->P[at(where->constant + anchor, where->constant + anchor)] = square(range_std_m);
    for (int32_t axis = 0; axis < dim; axis++) {
        int32_t survey = where->survey + dim * anchor + axis;
        s->P[at(survey, survey)] = square(survey_std_m);
    }
    return anchor;
}

/* Add ambiguities for all anchors, none of them known yet. */
INTERNAL void use_phases(State *s) {
    if (!s->status.has_phases) {
        for (int32_t time_1 = 0, time_1_end = 2 * s->count; time_1 < time_1_end; time_1++) {
            insert_state(s, s->layout.change);
        }
        s->status.is_in_order = true;
        s->status.has_phases = true;
        s->hypotheses.count = 1;
        set_layout(s);
        for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
            s->anchors[anchor].noise_ticks = s->status.epoch_ticks;
        }
    }
}

/* Add heading and acceleration of a motion sensor, both unknown. */
INTERNAL void use_motion(State *s) {
    if (!s->motion.has_states) {
        for (int32_t time_1 = 0, time_1_end = HEADINGS + s->dim; time_1 < time_1_end; time_1++) {
            insert_state(s, s->layout.ambiguity);
        }
        s->motion.has_states = true;
        set_layout(s);
        expect_motion(s);
    }
}

/* Reset heading and acceleration of a motion sensor, if there is one, to what is known of any sensor. */
INTERNAL void expect_motion(State *s) {
    Layout *where = &s->layout;
    Tuning *tuning = &s->tuning;
    s->motion.used_ticks = NEVER;
    for (int32_t state = where->heading, state_end = where->ambiguity; state < state_end; state++) {
        s->x[state] = REAL(0.0);
        for (int32_t other = 0, other_end = s->used; other < other_end; other++) {
            set_covariance(s, state, other, REAL(0.0));
        }
        for (int32_t row = 0, row_end = s->rows; row < row_end; row++) {
            s->V[state][row] = REAL(0.0);
        }
        real std = state < where->acceleration ? tuning->heading_std : tuning->acceleration_std_mps2;
        s->P[at(state, state)] = square(std) * (state == where->acceleration + 2 ? tuning->vertical_share : REAL(1.0));
    }
}

/* Reset a link to no relays. */
INTERNAL void clear_link(Link *link, real variance_m2) {
    link->tx_ticks = NEVER;
    link->constant_m = REAL(0.0);
    link->variance_m2 = variance_m2;
    link->outliers_in_row = 0;
    link->relays = 0;
    link->contradicts = false;
    forget_pair_phase(link);
}

/* Forget the constant of phases in a direction of a pair. */
INTERNAL void forget_pair_phase(Link *link) {
    link->has_phase = false;
    link->phases_refused = 0;
    link->phase_variance_m2 = REAL(0.0);
    link->phase_m = REAL(0.0);
}

/* Remove an anchor from the state. */
INTERNAL void remove_anchor(State *s, int32_t anchor) {
    Layout *where = &s->layout;
    int32_t dim = s->dim;
    int32_t last = s->count - 1;
    for (int32_t time_1 = 0; time_1 < dim; time_1++) {
        remove_state(s, where->survey + dim * anchor);
    }
    remove_state(s, where->constant + anchor);
    remove_state(s, where->change + anchor);
    if (s->status.has_phases) {
        remove_state(s, where->mesh + anchor);
        remove_state(s, where->ambiguity + anchor);
    }
    remove_state(s, where->tx_noise + anchor);
    remove_state(s, where->rate + anchor);
    remove_state(s, where->offset + anchor);
    remove_lasting(s, anchor);
    for (int32_t kind = 0; kind < FAULT_KINDS; kind++) {
        remove_fault(s, (FAULT_KINDS - 1 - kind) * s->count + anchor, FAULT_KINDS * s->count - kind);
    }
    for (int32_t moved = anchor; moved < last; moved++) {
        s->anchors[moved] = s->anchors[moved + 1];
        for (int32_t kept = 0; kept < PACKETS_KEPT; kept++) {
            s->packets[moved][kept] = s->packets[moved + 1][kept];
        }
        for (int32_t other = 0, other_end = s->count; other < other_end; other++) {
            s->links[moved][other] = s->links[moved + 1][other];
        }
    }
    for (int32_t moved = anchor; moved < last; moved++) {
        for (int32_t other = 0; other < last; other++) {
            s->links[other][moved] = s->links[other][moved + 1];
        }
    }
    s->count = last;
    set_layout(s);
}

/* Move all states from an index on back by one, and set the state at the index to zero. */
INTERNAL void insert_state(State *s, int32_t index_) {
    int32_t end = s->layout.end;
    for (int32_t state = end; state > index_; state--) {
        s->x[state] = s->x[state - 1];
        for (int32_t row = 0, row_end = s->rows; row < row_end; row++) {
            s->V[state][row] = s->V[state - 1][row];
        }
    }
    s->x[index_] = REAL(0.0);
    for (int32_t row = 0, row_end = s->rows; row < row_end; row++) {
        s->V[index_][row] = REAL(0.0);
    }
    for (int32_t state = end; state > -1; state--) {
        int32_t to = row_of(state);
        int32_t source = row_of(state > index_ ? state - 1 : state);
        for (int32_t other = row_end(state, end + 1) - 1; other > -1; other--) {
            s->P[to + other] = s->P[source + (other > index_ ? other - 1 : other)];
        }
    }
    for (int32_t other = 0; other < end + 1; other++) {
        set_covariance(s, index_, other, REAL(0.0));
    }
    s->layout.end = end + 1;
}

/* Move all states behind an index forward by one. */
INTERNAL void remove_state(State *s, int32_t index_) {
    int32_t end = s->layout.end;
    for (int32_t state = index_; state < end - 1; state++) {
        s->x[state] = s->x[state + 1];
        for (int32_t row = 0, row_end = s->rows; row < row_end; row++) {
            s->V[state][row] = s->V[state + 1][row];
        }
    }
    s->x[end - 1] = REAL(0.0);
    for (int32_t row = 0, row_end = s->rows; row < row_end; row++) {
        s->V[end - 1][row] = REAL(0.0);
    }
    for (int32_t state = 0; state < end - 1; state++) {
        int32_t to = row_of(state);
        int32_t source = row_of(state >= index_ ? state + 1 : state);
        for (int32_t other = 0, other_end = row_end(state, end - 1); other < other_end; other++) {
            s->P[to + other] = s->P[source + (other >= index_ ? other + 1 : other)];
        }
    }
    for (int32_t other = 0; other < end; other++) {
        set_covariance(s, end - 1, other, REAL(0.0));
    }
    s->layout.end = end - 1;
}

/* Move all faults from an index on back by one, and set the fault at the index to zero. */
INTERNAL void insert_fault(State *s, int32_t index_, int32_t faults) {
    for (int32_t state = 0, state_end = s->layout.end; state < state_end; state++) {
        insert(s->V[state], index_, s->rows);
    }
    s->rows += 1;
    for (int32_t row = faults; row > index_; row--) {
        for (int32_t other = 0; other < faults; other++) {
            s->information[row][other] = s->information[row - 1][other];
        }
    }
    for (int32_t other = 0; other < faults; other++) {
        s->information[index_][other] = REAL(0.0);
    }
    for (int32_t row = 0; row < faults + 1; row++) {
        insert(s->information[row], index_, faults);
    }
    insert(s->evidence, index_, faults);
}

/* Move all faults behind an index forward by one. */
INTERNAL void remove_fault(State *s, int32_t index_, int32_t faults) {
    for (int32_t state = 0, state_end = s->layout.end; state < state_end; state++) {
        remove_(s->V[state], index_, s->rows);
    }
    s->rows -= 1;
    for (int32_t row = index_; row < faults - 1; row++) {
        for (int32_t other = 0; other < faults; other++) {
            s->information[row][other] = s->information[row + 1][other];
        }
    }
    for (int32_t other = 0; other < faults; other++) {
        s->information[faults - 1][other] = REAL(0.0);
    }
    for (int32_t row = 0; row < faults; row++) {
        remove_(s->information[row], index_, faults);
    }
    remove_(s->evidence, index_, faults);
}

/* Remove an anchor from the lasting faults, given that it has none. */
INTERNAL void remove_lasting(State *s, int32_t anchor) {
    real (*covariance)[MAX_ANCHORS] = s->lasting_covariance;
    int32_t end = s->count;
    weigh_zero(s, anchor, REAL(1.0) / ROUNDING_M2);
    for (int32_t row = anchor; row < end - 1; row++) {
        for (int32_t other = 0; other < end; other++) {
            covariance[row][other] = covariance[row + 1][other];
        }
    }
    for (int32_t other = 0; other < end; other++) {
        covariance[end - 1][other] = REAL(0.0);
    }
    for (int32_t row = 0; row < end; row++) {
        remove_(covariance[row], anchor, end);
    }
    remove_(s->lasting_m, anchor, end);
}

/* Move numbers from an index up to an end back by one, and set the number at the index to zero. */
INTERNAL void insert(real *numbers, int32_t index_, int32_t end) {
    for (int32_t place = end; place > index_; place--) {
        numbers[place] = numbers[place - 1];
    }
    numbers[index_] = REAL(0.0);
}

/* Move numbers behind an index forward by one. */
INTERNAL void remove_(real *numbers, int32_t index_, int32_t end) {
    for (int32_t place = index_; place < end - 1; place++) {
        numbers[place] = numbers[place + 1];
    }
    numbers[end - 1] = REAL(0.0);
}

/* Lasting faults */

/* Add weight·m·mᵀ to M of the lasting faults and weight·m·shown to y (Sherman and Morrison 1950). */
INTERNAL void learn_lasting(State *s, real *m, real weight, real shown) {
    real *c = s->work[1];
    real variance = REAL(1.0);
    real innovation = shown;
    for (int32_t one = 0, one_end = s->count; one < one_end; one++) {
        real total = REAL(0.0);
        real *row = s->lasting_covariance[one];
        for (int32_t other = 0, other_end = s->count; other < other_end; other++) {
            total += row[other] * m[other];
        }
        c[one] = total;
        variance += weight * m[one] * total;
        innovation -= m[one] * s->lasting_m[one];
    }
    real gain = weight / variance;
    for (int32_t one = 0, one_end = s->count; one < one_end; one++) {
        real share = gain * c[one];
        real *row = s->lasting_covariance[one];
        s->lasting_m[one] += share * innovation;
        for (int32_t other = 0, other_end = s->count; other < other_end; other++) {
            row[other] -= share * c[other];
        }
    }
}

/* Reset a lasting fault to its prior, because it has become a state of its own. */
INTERNAL void forget_lasting(State *s, int32_t anchor) {
    real variance = square(s->status.fault_std_m[LASTING]);
    weigh_zero(s, anchor, REAL(1.0) / square(s->tuning.late_std_m) - REAL(1.0) / variance);
    for (int32_t other = 0, other_end = s->count; other < other_end; other++) {
        s->lasting_covariance[other][anchor] = REAL(0.0);
        s->lasting_covariance[anchor][other] = REAL(0.0);
    }
    s->lasting_covariance[anchor][anchor] = variance;
    s->lasting_m[anchor] = REAL(0.0);
}

/* Add the information, with this weight, that an anchor's lasting fault is zero. */
INTERNAL void weigh_zero(State *s, int32_t anchor, real weight) {
    real *m = s->work[2];
    for (int32_t one = 0, one_end = s->count; one < one_end; one++) {
        m[one] = one == anchor ? REAL(1.0) : REAL(0.0);
    }
    learn_lasting(s, m, weight, REAL(0.0));
}

/* The filter itself: time update and scalar measurement update of state, covariance and fault sensitivities.
 *
 * All loops run over the states that are not exact (``State.n``); what stands behind them stays as it is. */

/* Time update */

/* Time update to a tag time: F·P·Fᵀ + Q for constant velocity and constant clock rates.
 *
 * All offsets contain the tag's oscillator, so its noise is common to them. */
INTERNAL void predict(State *s, int64_t rx_ticks) {
    real walk = 0;
    Status *status = &s->status;
    EstimatorSettings *settings = &s->settings;
    Layout *where = &s->layout;
    real dt = min_real((real)(rx_ticks - status->epoch_ticks) * TICK_S, LONGEST_S);
    status->walked_m += SQRT(speed_squared(s)) * dt;
    if (status->obstruction > REAL(0.0)) {
        status->obstruction *= exp_(-dt / s->tuning.obstruction_memory_s);
    }
    if (PHASE_STATES > 0) {
        for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
            status->line_m[axis] += s->x[where->velocity + axis] * dt;
        }
        status->recent_square = max_real(status->recent_square * exp_(-dt / s->tuning.speed_memory_s),
                speed_squared(s));
    }
    advance(s, dt);
    real motion = motion_noise(s);
    real white_m2 = settings->white * dt;
    if (MOTION_STATES > 0 && s->motion.is_used) {
        motion = unseen_noise(s);
    }
    if (is_stationary(s)) {
        motion *= s->tuning.stationary_noise_share;
    }
    real square_s = dt * dt / REAL(2.0);
    real cube_s = dt * dt * dt / REAL(3.0);
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        add_noise(s, axis, axis, motion * cube_s, motion * square_s, motion * dt);
    }
    if (!has_order(s)) {
        for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
            int32_t offset = where->offset + anchor;
            walk = settings->walk * s->anchors[anchor].walk_scale;
            add_noise(s, offset, offset, white_m2 + walk * cube_s, walk * square_s, walk * dt);
        }
    }
    walk = settings->walk * status->walk_scale;
    for (int32_t one = where->offset, one_end = where->velocity; one < one_end; one++) {
        for (int32_t other = where->offset; other < one + 1; other++) {
            add_noise(s, one, other, white_m2 + walk * cube_s, walk * square_s, walk * dt);
        }
    }
    status->epoch_ticks = rx_ticks;
}

/* Whether relays are processed before the reception of the packet that brings them, the oldest first. */
INTERNAL bool has_order(State *s) {
    return PHASE_STATES > 0 && s->status.is_in_order;
}

/* Add the noise of an anchor's own clock up to a tag time, as it acts on the state at the newest packet.
 *
 * Before the next packet nothing is known of this clock. So its noise is added when that comes, from relay to relay:
 * each tells of the clock at the time of an earlier packet, and after it only the noise of the rest is unknown. */
INTERNAL void add_clock_noise(State *s, int32_t anchor, int64_t until_ticks) {
    Anchor *a = &s->anchors[anchor];
    EstimatorSettings *settings = &s->settings;
    int32_t offset = s->layout.offset + anchor;
    real dt = (real)(until_ticks - a->noise_ticks) * TICK_S;
    real lead = (real)(s->status.epoch_ticks - until_ticks) * TICK_S;
    if (dt > REAL(0.0)) {
        real walk = settings->walk * a->walk_scale;
        real of_both = walk * dt * (dt / REAL(2.0) + lead);
        real of_values = settings->white * dt + walk * dt * (dt * dt / REAL(3.0) + lead * (dt + lead));
        add_noise(s, offset, offset, of_values, of_both, walk * dt);
        a->noise_ticks = until_ticks;
    }
}

/* Square of the tag's speed. */
INTERNAL real speed_squared(State *s) {
    real total = REAL(0.0);
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        total += square(s->x[s->layout.velocity + axis]);
    }
    return total;
}

/* Spectral density of the tag's acceleration, m²/s³: as innovations require, and what a fast tag's turns need.
 *
 * Hypotheses on cycles need it to be large beforehand: if it is too small, wrong cycles explain the motion. */
INTERNAL real motion_noise(State *s) {
    Tuning *tuning = &s->tuning;
    Status *status = &s->status;
    real least = speed_squared(s) / square(s->tuning.walking_mps);
    if (are_phases_reliable(s)) {
        least = status->recent_square / square(tuning->phase_walking_mps);
    }
    return s->settings.qa * max_real(status->q_scale, least);
}

/* Whether an anchor's phases are in use: its ambiguity is confirmed, and phases still come and are not rejected. */
INTERNAL bool has_phase(State *s, int32_t anchor) {
    Ambiguity *own = &s->anchors[anchor].own;
    Tuning *tuning = &s->tuning;
    bool is_recent = (real)(s->status.epoch_ticks - own->ticks) * TICK_S < REAL(2.0) * tuning->rate_s;
    return own->is_known && is_recent && own->refused_in_row < truncated(tuning->phases_in_row) - 1;
}

/* Whether phases of enough anchors are in use to determine the tag's clock. */
INTERNAL bool follows_cycles(State *s) {
    int32_t found = 0;
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        if (has_phase(s, anchor)) {
            found += 1;
        }
    }
    return PHASE_STATES > 0 && found > s->dim;
}

/* Whether phases may be taken at several cycles: they are rarely wild, and no range error has jumped recently. */
INTERNAL bool are_phases_reliable(State *s) {
    bool has_phases = PHASE_STATES > 0 && s->status.has_phases;
    return has_phases && s->status.wild_share < s->tuning.most_wild && jump_share(s) < REAL(1.0);
}

/* The same of what a motion sensor does not show. */
INTERNAL real unseen_noise(State *s) {
    Tuning *tuning = &s->tuning;
    real known = min_real(square(s->x[s->layout.heading]) + square(s->x[s->layout.heading + 1]), REAL(1.0));
    real unknown = tuning->headless_noise + known * (tuning->sensor_noise - tuning->headless_noise);
    return unknown * s->status.q_scale + s->settings.qa * square(s->status.rejected_share / tuning->lost_share);
}

/* Whether the tag has shown no motion for long enough to count as stationary.
 *
 * Never while phases are in use: they show rest by themselves, and ambiguities would absorb the onset of motion. */
INTERNAL bool is_stationary(State *s) {
    return (REAL(0.0) < s->settings.stationary_s && s->settings.stationary_s < s->status.stationary_s) &&
            !s->status.has_phases;
}

/* Add dt·(rates) to the values; the values are the first states, their rates follow in the same order. F·P·Fᵀ. */
INTERNAL void advance(State *s, real dt) {
    int32_t values = s->layout.velocity;
    for (int32_t value = 0; value < values; value++) {
        s->x[value] += dt * s->x[values + value];
        real *effects = s->V[value];
        real *of_rate = s->V[values + value];
        for (int32_t fault = 0, fault_end = s->rows; fault < fault_end; fault++) {
            effects[fault] += dt * of_rate[fault];
        }
    }
    if (PACKED) {
        advance_packed(s, values, dt);
        return;
    }
    for (int32_t state = 0, state_end = s->used; state < state_end; state++) {
        int32_t row = row_of(state);
        for (int32_t value = 0; value < values; value++) {
            s->P[row + value] += dt * s->P[row + values + value];
        }
    }
    for (int32_t value = 0; value < values; value++) {
        int32_t row = row_of(value);
        int32_t rates = row_of(values + value);
        for (int32_t state = 0, state_end = s->n; state < state_end; state++) {
            s->P[row + state] += dt * s->P[rates + state];
        }
    }
    for (int32_t value = 0; value < values; value++) {
        for (int32_t other = 0; other < value; other++) {
            s->P[at(value, other)] = s->P[at(other, value)];
        }
    }
}

/* ``_advance`` for a lower triangle: values among each other in two steps, between which their rates change. */
INTERNAL void advance_packed(State *s, int32_t values, real dt) {
    for (int32_t value = 0; value < values; value++) {
        int32_t row = row_of(value);
        int32_t rates = row_of(values + value);
        for (int32_t other = 0; other < value + 1; other++) {
            s->P[row + other] += dt * s->P[rates + other];
        }
    }
    for (int32_t state = values, state_end = s->used; state < state_end; state++) {
        int32_t row = row_of(state);
        int32_t within = max_32(min_32(values, state - values + 1), 0);
        for (int32_t value = 0; value < within; value++) {
            s->P[row + value] += dt * s->P[row + values + value];
        }
        for (int32_t value = within; value < values; value++) {
            s->P[row + value] += dt * s->P[row_of(values + value) + state];
        }
    }
    for (int32_t value = 0; value < values; value++) {
        for (int32_t other = 0; other < value + 1; other++) {
            s->P[at(value, other)] += dt * s->P[at(values + other, value)];
        }
    }
}

/* Add Q of a value and its rate, or of two such pairs with common noise: white for values, a walk for rates. */
INTERNAL void add_noise(State *s, int32_t value, int32_t other, real of_values, real of_both, real of_rates) {
    int32_t rate = s->layout.velocity + value;
    int32_t other_rate = s->layout.velocity + other;
    set_covariance(s, value, other, s->P[at(value, other)] + of_values);
    set_covariance(s, rate, other, s->P[at(rate, other)] + of_both);
    if (value != other) {
        set_covariance(s, value, other_rate, s->P[at(value, other_rate)] + of_both);
    }
    set_covariance(s, rate, other_rate, s->P[at(rate, other_rate)] + of_rates);
}

/* Range errors that change */

/* 1 if range errors have jumped recently, 0 if none has. */
INTERNAL real jump_share(State *s) {
    return min_real(s->status.obstruction, REAL(1.0));
}

/* Variance of the changing part of a range error that has not jumped. */
INTERNAL real clear_variance(State *s, int32_t anchor) {
    real usual = max_real(s->anchors[anchor].change_variance_m2, s->status.place_variance_m2);
    return usual + jump_share(s) * square(s->tuning.obstructed_std_m);
}

/* Decay of an anchor's range errors over the time and the walked distance since its newest packet.
 *
 * Returns the kept share of the changing part, its long-term variance, and the kept share of the constant part. The
 * changing part is a Gauss–Markov process of walked distance and time. Where range errors jump, a part of its variance
 * and the constant part are forgotten within seconds; one that has jumped itself wanders and returns to zero. */
INTERNAL range_error_decay_results range_error_decay(State *s, int32_t anchor, real dt, real walked_m) {
    real variance = 0;
    real kept = 0;
    Status *status = &s->status;
    Tuning *tuning = &s->tuning;
    EstimatorSettings *settings = &s->settings;
    Anchor *a = &s->anchors[anchor];
    real share = jump_share(s);
    real obstructed = share * dt / tuning->obstructed_s;
    if (a->is_obstructed) {
        real change_m = s->x[s->layout.change + anchor];
        real memory_s = tuning->obstruction_memory_s * max_real(REAL(1.0), abs_real(change_m) /
                tuning->obstruction_return_m);
        variance = REAL(0.5) * memory_s * tuning->obstructed_walk * a->change_scale;
        kept = exp_(-dt / memory_s);
    } else {
        variance = clear_variance(s, anchor);  /* of two processes as one, whose rates are weighted by their variances */
        real after_jumps = share * square(tuning->obstructed_std_m) / max_real(variance, REAL(1e-09));
        real usual = dt / settings->place_time_s + walked_m / status->place_distance_m;
        kept = exp_(-after_jumps * dt / tuning->obstructed_s - (REAL(1.0) - after_jumps) * usual);
    }
    real kept_constant = obstructed > REAL(1e-06) && settings->range_std_m > REAL(0.0) ? exp_(-obstructed) : REAL(1.0);
    return (range_error_decay_results){kept, variance, kept_constant};
}

/* Time update of an anchor's range errors since its newest packet, by ``range_error_decay``. */
INTERNAL void relax_range_error(State *s, int32_t anchor, real dt, real walked_m) {
    const range_error_decay_results results_1 = range_error_decay(s, anchor, dt, walked_m);
    real kept = results_1.item_0;
    real variance = results_1.item_1;
    real kept_constant = results_1.item_2;
    if (variance > REAL(0.0)) {  /* also if the site states exact ranges: multipath is learnt there too */
        make_uncertain(s, CHANGING_RANGE_ERRORS);
        decay(s, s->layout.change + anchor, kept, variance);
    }
    if (kept_constant < REAL(1.0)) {
        decay(s, s->layout.constant + anchor, kept_constant, square(s->settings.range_std_m));
    }
}

/* Decay a state towards zero with the given long-term variance (Gauss–Markov). */
INTERNAL void decay(State *s, int32_t state, real kept, real variance) {
    s->x[state] *= kept;
    for (int32_t other = 0, other_end = s->used; other < other_end; other++) {
        set_covariance(s, state, other, s->P[at(state, other)] * kept);
    }
    s->P[at(state, state)] = kept * s->P[at(state, state)] + (REAL(1.0) - kept * kept) * variance;
    for (int32_t fault = 0, fault_end = s->rows; fault < fault_end; fault++) {
        s->V[state][fault] *= kept;
    }
}

/* Reset a state to zero, uncorrelated, with the given variance. */
INTERNAL void reset_state(State *s, int32_t state, real variance) {
    s->x[state] = REAL(0.0);
    for (int32_t other = 0, other_end = s->used; other < other_end; other++) {
        set_covariance(s, state, other, REAL(0.0));
    }
    s->P[at(state, state)] = variance;
    for (int32_t fault = 0, fault_end = s->rows; fault < fault_end; fault++) {
        s->V[state][fault] = REAL(0.0);
    }
}

/* Add uncertainty along the first of ``U``, which depends on each fault by the first of ``G``. */
INTERNAL void open_direction(State *s, real variance, int32_t faults) {
    real *opened = s->U[0];
    real *shared = s->G[0];
    for (int32_t one = 0, one_end = s->used; one < one_end; one++) {
        int32_t row = row_of(one);
        for (int32_t other = 0, other_end = row_end(one, s->n); other < other_end; other++) {
            s->P[row + other] += opened[one] * opened[other] * variance;
        }
        for (int32_t fault = 0; fault < faults; fault++) {
            s->V[one][fault] += shared[fault] * opened[one];
        }
    }
}

#ifndef SKYLESS_BY_HAND
/* Measurement update */

/* Write P·h of the measurement in ``h`` into the next of ``U``, including queued updates. Returns hᵀ·P·h. */
INTERNAL real compute_ph(State *s) {
    if (s->waiting == MOST_WAITING) {
        finish_updates(s);
    }
    real *ph = s->U[s->waiting];
    for (int32_t state = 0, state_end = s->n; state < state_end; state++) {
        ph[state] = REAL(0.0);
    }
    for (int32_t term = 0, term_end = s->terms; term < term_end; term++) {
        if (s->h_index[term] < s->n) {
            real weight = s->h[term];
            int32_t index_ = s->h_index[term];
            int32_t row = row_of(index_);
            int32_t end = row_end(index_, s->n);
            for (int32_t state = 0; state < end; state++) {
                ph[state] += weight * s->P[row + state];
            }
            for (int32_t state = end, state_end = s->n; state < state_end; state++) {
                ph[state] += weight * s->P[row_of(state) + index_];
            }
        }
    }
    for (int32_t one = 0, one_end = s->waiting; one < one_end; one++) {
        real weight = h_dot(s, s->U[one]);
        real *u = s->U[one];
        for (int32_t state = 0, state_end = s->n; state < state_end; state++) {
            ph[state] -= weight * u[state];
        }
    }
    return h_dot(s, ph);
}
#endif

/* The scalar product of ``h`` and a vector over the states. */
INTERNAL real h_dot(State *s, real *states) {
    real total = REAL(0.0);
    for (int32_t term = 0, term_end = s->terms; term < term_end; term++) {
        if (s->h_index[term] < s->n) {
            total += s->h[term] * states[s->h_index[term]];
        }
    }
    return total;
}

#ifndef SKYLESS_BY_HAND
/* Write s = [own reception] − h·V into the next of ``G``; ``own`` is the anchor that the tag received, or −1. */
INTERNAL void compute_fault_input(State *s, int32_t own) {
    real *shares = s->G[s->waiting];
    for (int32_t fault = 0, fault_end = s->rows; fault < fault_end; fault++) {
        shares[fault] = REAL(0.0);
    }
    for (int32_t term = 0, term_end = s->terms; term < term_end; term++) {
        real weight = s->h[term];
        real *effects = s->V[s->h_index[term]];
        for (int32_t fault = 0, fault_end = s->rows; fault < fault_end; fault++) {
            shares[fault] -= weight * effects[fault];
        }
    }
    for (int32_t one = 0, one_end = s->waiting; one < one_end; one++) {
        real weight = h_dot(s, s->U[one]);
        real *effects = s->G[one];
        for (int32_t fault = 0, fault_end = s->rows; fault < fault_end; fault++) {
            shares[fault] -= weight * effects[fault];
        }
    }
    if (own >= 0) {
        for (int32_t kind = 0; kind < FAULT_KINDS; kind++) {
            shares[kind * s->count + own] += REAL(1.0);
        }
    }
}
#endif

/* Scalar update by the measurement whose P·h and fault inputs are the next of ``U`` and ``G``.
 *
 * K = gain_scale·P·h/S. A scale of 1 is the Kalman gain; an inflated variance is in S, with a scale of 1. P changes by
 * −u·uᵀ with u = P·h/√S, which is symmetric to the bit. No updates may be queued. */
INTERNAL void update(State *s, real innovation, real innovation_variance, real gain_scale) {
    note_update(s, innovation, innovation_variance, gain_scale);
    apply_updates(s);
}

/* Queue an update by a measurement. If it also shows faults: y ← y + s·ν/S and M ← M + s·sᵀ/S.
 *
 * P, V and M follow in ``finish_updates``; until then only ``compute_ph`` and ``compute_fault_input`` may read P and
 * V. Lasting faults are updated at once. */
INTERNAL void update_later(State *s, real innovation, real innovation_variance, bool shows_faults) {
    real *g = s->G[s->waiting];
    real normalised = innovation / SQRT(innovation_variance);
    s->shows_faults[s->waiting] = shows_faults ? REAL(1.0) : REAL(0.0);
    note_update(s, innovation, innovation_variance, REAL(1.0));
    if (shows_faults) {
        for (int32_t fault = 0, fault_end = FAULT_KINDS * s->count; fault < fault_end; fault++) {
            s->evidence[fault] += g[fault] * normalised;
        }
        learn_lasting(s, g, REAL(1.0), normalised);
    }
}

/* Update x, and scale the next of ``U`` and ``G`` to u = P·h/√S and g = s/√S for P and V. */
INTERNAL void note_update(State *s, real innovation, real innovation_variance, real gain_scale) {
    real inverse = REAL(1.0) / SQRT(innovation_variance);
    real step = gain_scale * inverse;
    real *u = s->U[s->waiting];
    real *g = s->G[s->waiting];
    for (int32_t state = 0, state_end = s->n; state < state_end; state++) {
        u[state] *= inverse;
    }
    for (int32_t fault = 0, fault_end = s->rows; fault < fault_end; fault++) {
        g[fault] *= step;
    }
    if (PHASE_STATES > 0) {
        for (int32_t one = 0, one_end = s->hypotheses.count; one < one_end; one++) {
            real off = innovation * inverse + g[FAULT_KINDS * s->count + one];
            s->hypotheses.log_weight[one] -= min_real(REAL(0.5) * off * off, REAL(1000000.0));  /* a square may overflow */
        }
    }
    step *= innovation;
    for (int32_t state = 0, state_end = s->used; state < state_end; state++) {
        s->x[state] += u[state] * step;
    }
    s->waiting += 1;
}

/* Apply the queued updates to P, V and M. */
INTERNAL void finish_updates(State *s) {
    if (s->waiting > 0) {
        inform(s);
        apply_updates(s);
    }
}

#ifndef SKYLESS_BY_HAND
/* M ← M + Σ s·sᵀ/S over the queued updates that show faults; their s/√S are in ``G``. */
INTERNAL void inform(State *s) {
    int32_t faults = FAULT_KINDS * s->count;
    for (int32_t group = 0, group_end = fill_groups(s); group < group_end; group++) {
        int32_t k = 4 * group;
        for (int32_t fault = 0; fault < faults; fault++) {
            real a = s->shows_faults[k] * s->G[k][fault];
            real b = s->shows_faults[k + 1] * s->G[k + 1][fault];
            real c = s->shows_faults[k + 2] * s->G[k + 2][fault];
            real d = s->shows_faults[k + 3] * s->G[k + 3][fault];
            for (int32_t other = 0; other < fault + 1; other++) {
                s->information[fault][other] += a * s->G[k][other] + b * s->G[k + 1][other] + c * s->G[k + 2][other] + d
                        * s->G[k + 3][other];
            }
        }
    }
}
#endif

/* Pad the queued updates with zeros to a multiple of four. Returns the number of groups of four. */
INTERNAL int32_t fill_groups(State *s) {
    int32_t groups = floor_div_32(s->waiting + 3, 4);
    for (int32_t one = s->waiting; one < 4 * groups; one++) {
        for (int32_t state = 0, state_end = s->n; state < state_end; state++) {
            s->U[one][state] = REAL(0.0);
        }
        for (int32_t fault = 0, fault_end = s->rows; fault < fault_end; fault++) {
            s->G[one][fault] = REAL(0.0);
        }
    }
    return groups;
}

#ifndef SKYLESS_BY_HAND
/* P ← P − Σ u·uᵀ and V ← V + Σ u·gᵀ over the queued updates, four at a time: P is read and written once. */
INTERNAL void apply_updates(State *s) {
    if (s->waiting <= 2) {
        for (int32_t one = 0, one_end = s->waiting; one < one_end; one++) {
            apply_one(s, one);
        }
    } else {
        for (int32_t group = 0, group_end = fill_groups(s); group < group_end; group++) {
            apply_four(s, 4 * group);
        }
    }
    s->waiting = 0;
}
#endif

INTERNAL void apply_one(State *s, int32_t one) {
    for (int32_t state = 0, state_end = s->used; state < state_end; state++) {
        real u = s->U[one][state];
        int32_t row = row_of(state);
        for (int32_t other = 0, other_end = row_end(state, s->n); other < other_end; other++) {
            s->P[row + other] -= u * s->U[one][other];
        }
        for (int32_t fault = 0, fault_end = s->rows; fault < fault_end; fault++) {
            s->V[state][fault] += u * s->G[one][fault];
        }
    }
}

INTERNAL void apply_four(State *s, int32_t k) {
    for (int32_t state = 0, state_end = s->used; state < state_end; state++) {
        real a = s->U[k][state];
        real b = s->U[k + 1][state];
        real c = s->U[k + 2][state];
        real d = s->U[k + 3][state];
        int32_t row = row_of(state);
        for (int32_t other = 0, other_end = row_end(state, s->n); other < other_end; other++) {
            s->P[row + other] -= a * s->U[k][other] + b * s->U[k + 1][other] + c * s->U[k + 2][other] + d * s->U[k +
                    3][other];
        }
        for (int32_t fault = 0, fault_end = s->rows; fault < fault_end; fault++) {
            s->V[state][fault] += a * s->G[k][fault] + b * s->G[k + 1][fault] + c * s->G[k + 2][fault] + d * s->G[k +
                    3][fault];
        }
    }
}

/* Faults of anchors: their effect on the state, the evidence for them in innovations, and the tests.
 *
 * If all that the tag receives of anchor j is late by b metres, the estimate errs by V_j·b, and the innovation of a
 * measurement h contains s_j·b (Friedland 1969):
 *
 *     s = [own reception of j] − h·V        V ← F·V  (time)        V ← V + K·s  (update)
 *
 * With y = Σ s·ν/S and M = Σ s·sᵀ/S over the innovations ν of variance S, and the prior variances σ_f²·I of the faults,
 * the estimate of all anchors' faults is b̂ = (M + I/σ_f²)⁻¹·y with the covariance (M + I/σ_f²)⁻¹, and
 * yᵀ·(M + I/σ_f²)⁻¹·y tests whether there are any. Where V, y and M are faded, b is the present size of a fault that
 * has grown as fast as they fade: within packets (recent) or seconds (creeping). A detected fault is added to the
 * anchor's range error, which gives the state that the filter would have if that error had been open from the beginning. */

/* What innovations show (gathered by ``kalman.update_later``) */

/* Subtract the input of the first anchor of a difference, whose faults have the opposite sign. */
INTERNAL void subtract_fault_input(State *s, int32_t anchor) {
    for (int32_t kind = 0; kind < FAULT_KINDS; kind++) {
        s->G[s->waiting][kind * s->count + anchor] -= REAL(1.0);
    }
}

/* Fade the effect of, and the evidence for, recent and creeping faults; once a round of packets. */
INTERNAL void fade_faults(State *s) {
    Status *status = &s->status;
    Tuning *tuning = &s->tuning;
    int32_t count = s->count;
    if (floor_mod_64(status->packets, count) != 0) {
        return;
    }
    real elapsed_s = (real)(status->epoch_ticks - status->faded_ticks) * TICK_S;
    status->faded_ticks = status->epoch_ticks;
    for (int32_t kind = RECENT; kind < FAULT_KINDS; kind++) {
        int32_t begin = kind * count;
        int32_t end = (kind + 1) * count;
        real kept = kind == RECENT ? REAL(1.0) - REAL(1.0) / tuning->recent_packets : exp_(-elapsed_s /
                tuning->creeping_s);
        for (int32_t state = 0, state_end = s->used; state < state_end; state++) {
            for (int32_t fault = begin; fault < end; fault++) {
                s->V[state][fault] *= kept;
            }
        }
        for (int32_t fault = begin; fault < end; fault++) {
            s->evidence[fault] *= kept;
            for (int32_t other = 0; other < fault + 1; other++) {
                s->information[fault][other] *= kept;
            }
            for (int32_t other = end; other < FAULT_KINDS * count; other++) {
                s->information[other][fault] *= kept;
            }
        }
    }
}

/* The test of all faults of a kind */

/* Compute L⁻¹·r of the vectors r in the rows behind a symmetric matrix M = L·Lᵀ in ``work``, by Cholesky's method.
 *
 * The scalar product of two results is r·M⁻¹·q. Rows of vectors are treated like rows of the matrix. */
INTERNAL void whiten(State *s, int32_t count, int32_t vectors) {
    for (int32_t column = 0; column < count; column++) {
        real *pivot = s->work[column];
        real total = s->work[column][column];
        for (int32_t k = 0; k < column; k++) {
            total -= pivot[k] * pivot[k];
        }
        real inverse = REAL(1.0) / SQRT(max_real(total, REAL(1e-30)));
        for (int32_t place = column + 1; place < count + vectors; place++) {
            real *row = s->work[place];
            total = row[column];
            for (int32_t k = 0; k < column; k++) {
                total -= row[k] * pivot[k];
            }
            row[column] = total * inverse;
        }
    }
}

/* Test all faults of a kind. Leaves their effect on the first ``axes`` states, as factors, in rows of ``work``.
 *
 * Row ``count`` is f, those behind it are A: the estimated faults move a position by A·f. With L·Lᵀ = M + I/σ_f² these
 * are L⁻¹·y and L⁻¹·V, and A·Aᵀ is the covariance of that shift; for lasting faults it is A·Bᵀ, with B behind A. */
INTERNAL real fault_chi2(State *s, int32_t kind, int32_t axes) {
    int32_t count = s->count;
    int32_t begin = kind * s->count;
    int32_t first = s->count + 1;
    real total = REAL(0.0);
    if (kind == LASTING) {  /* whose covariance is kept explicitly */
        for (int32_t axis = 0; axis < axes; axis++) {
            real *a = s->work[first + axis];
            real *b = s->work[first + AXES + axis];
            for (int32_t one = 0; one < count; one++) {
                total = REAL(0.0);
                real *row = s->lasting_covariance[one];
                for (int32_t other = 0; other < count; other++) {
                    total += row[other] * s->V[axis][other];
                }
                a[one] = s->V[axis][one];
                b[one] = total;
            }
        }
        total = REAL(0.0);
        for (int32_t one = 0; one < count; one++) {
            s->work[count][one] = s->lasting_m[one];
            total += s->lasting_m[one] * s->evidence[one];
        }
        return total;
    }
    for (int32_t one = 0; one < count; one++) {
        for (int32_t other = 0; other < one + 1; other++) {
            s->work[one][other] = s->information[begin + one][begin + other];
        }
        s->work[one][one] += REAL(1.0) / square(s->status.fault_std_m[kind]);
        s->work[count][one] = s->evidence[begin + one];
        for (int32_t axis = 0; axis < axes; axis++) {
            s->work[first + axis][one] = s->V[axis][begin + one];
        }
    }
    whiten(s, count, 1 + axes);
    for (int32_t one = 0; one < count; one++) {
        total += square(s->work[count][one]);
    }
    return total;
}

/* How much of the test of all lasting faults one anchor or two explain.
 *
 * ``other`` is not above ``one``; equal for one anchor. */
INTERNAL real explained_chi2(State *s, int32_t one, int32_t other) {
    real weight = REAL(1.0) / square(s->tuning.late_std_m);
    real y_one = s->evidence[one];
    real y_other = s->evidence[other];
    real a = s->information[one][one] + weight;
    real b = s->information[other][other] + weight;
    real both = s->information[one][other];
    if (one == other) {
        return y_one * y_one / a;
    }
    return (b * square(y_one) - REAL(2.0) * both * y_one * y_other + a * square(y_other)) / (a * b - both * both);
}

/* How much an anchor's fault explains. An early one is less likely, and weighted less. */
INTERNAL real explained_alone(State *s, int32_t kind, int32_t anchor) {
    int32_t fault = kind * s->count + anchor;
    real y = s->evidence[fault];
    real information = s->information[fault][fault];
    return (y > REAL(0.0) ? REAL(1.0) : s->tuning.early_weight) * y * y / (information + REAL(1.0) /
            square(s->tuning.late_std_m));
}

/* The most that the fault of a single anchor explains. */
INTERNAL real largest(State *s, int32_t kind) {
    real most = REAL(0.0);
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        most = max_real(most, explained_alone(s, kind, anchor));
    }
    return most;
}

/* Adding faults to the state */

/* If the test of all faults of a kind exceeds its limit, add faults of the kind that explains most to the state.
 *
 * None are selected after a start that was contradicted: any number of anchors may be late then, and those that
 * explain the test best are sometimes the wrong ones. */
INTERNAL void open_faults(State *s) {
    real sure_chi2 = s->tuning.sure_chi2;
    if (s->status.fault_std_m[LASTING] > s->tuning.lasting_std_m) {
        return;
    }
    real lasting_chi2 = fault_chi2(s, LASTING, 0);
    real creeping_chi2 = fault_chi2(s, CREEPING, 0);
    real lasting = largest(s, LASTING);
    real recent = largest(s, RECENT);
    real creeping = largest(s, CREEPING);
    if (creeping_chi2 > max_real(sure_chi2, lasting_chi2) && creeping > recent && creeping >= lasting) {
        open_new_faults(s, CREEPING);
    } else if (fault_chi2(s, RECENT, 0) > sure_chi2 && recent >= lasting) {
        open_new_faults(s, RECENT);
    } else if (lasting_chi2 > sure_chi2) {
        open_lasting_faults(s, lasting_chi2);
    }
}

/* Open the range errors of the anchors whose faults explain the innovations about as well as the best one.
 *
 * If several explain them, all of these are opened, as long as enough anchors are left; none if too few anchors remain
 * to contradict the choice later. */
INTERNAL void open_new_faults(State *s, int32_t kind) {
    int32_t spare = s->count - s->dim - 1;
    real *explained = s->work[0];
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        spare -= (int32_t)s->anchors[anchor].is_obstructed;
        explained[anchor] = explained_alone(s, kind, anchor);
    }
    if (s->count < s->dim + 3) {
        return;
    }
    real limit = largest(s, kind) - s->tuning.apart_chi2;
    int32_t first = 0;
    while (spare > 0 && first >= 0) {
        first = -1;
        for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
            if (explained[anchor] > limit && (first < 0 || explained[anchor] > explained[first])) {
                first = anchor;
            }
        }
        if (first >= 0) {
            explained[first] = REAL(0.0);
            spare -= 1;
            open_fault(s, kind, first);
            begin_obstruction(s, first);
        }
    }
}

/* Mark that an anchor's range error has jumped and may still be changing. */
INTERNAL void begin_obstruction(State *s, int32_t anchor) {
    Anchor *a = &s->anchors[anchor];
    a->outliers_in_row = 0;
    a->is_obstructed = true;
    a->ended_log_odds = REAL(0.0);
    a->change_mean = REAL(0.0);
    a->change_scale = s->tuning.first_change_scale;
    note_jump(s);
}

/* Raise the estimated rate of jumps of range errors. */
INTERNAL void note_jump(State *s) {
    s->status.obstruction = min_real(s->status.obstruction + s->tuning.jump_rise, REAL(2.0));
}

/* Add the lasting faults of one or two anchors to the state, if no others explain the test as well. */
INTERNAL void open_lasting_faults(State *s, real chi2) {
    real apart_chi2 = s->tuning.apart_chi2;
    for (int32_t faults = 1, faults_end = min_32(MAX_FAULTS, s->count - s->dim - 2) + 1; faults < faults_end; faults++)
            {
        int32_t first = -1;
        int32_t second = -1;
        real most = REAL(0.0);
        real rival = REAL(0.0);
        for (int32_t one = 0, one_end = s->count; one < one_end; one++) {
            for (int32_t other = 0; other < one + 1; other++) {
                if ((one == other) == (faults == 1)) {
                    real explained = explained_chi2(s, one, other);
                    if (explained > most) {
                        const int32_t new_1 = one;
                        const int32_t new_2 = other;
                        const real new_3 = explained;
                        const real new_4 = most;
                        first = new_1;
                        second = new_2;
                        most = new_3;
                        rival = new_4;
                    } else if (explained > rival) {
                        rival = explained;
                    }
                }
            }
        }
        if (chi2 - most < apart_chi2 && most - rival > apart_chi2) {
            open_lasting_fault(s, first);
            if (faults == 2) {
                open_lasting_fault(s, second);
            }
            return;
        }
    }
}

/* Add a lasting fault to the state and to the anchor's record.
 *
 * Nothing makes ranges much shorter. If single packets are often late, the first packet was, which initialised the
 * anchor's clock: the anchor leaves the state instead, and joins again with its next packet. */
INTERNAL void open_lasting_fault(State *s, int32_t anchor) {
    if (s->status.late_share > s->tuning.late_often_share && s->lasting_m[anchor] < -s->tuning.lasting_std_m) {
        remove_anchor(s, anchor);
        return;
    }
    open_fault(s, LASTING, anchor);
    s->anchors[anchor].has_fault = true;
}

/* End a fault: the anchor's packets had been late since it joined, and no longer are. */
INTERNAL void end_lasting_fault(State *s, int32_t anchor) {
    open_fault(s, LASTING, anchor);
    reset_state(s, s->layout.constant + anchor, square(s->settings.range_std_m));
    note_jump(s);
}

/* Add a fault to its anchor's range error, and condition all other hypotheses on it (Schur's complement). */
INTERNAL void open_fault(State *s, int32_t kind, int32_t anchor) {
    bool is_lasting = kind == LASTING;
    int32_t chosen = kind * s->count + anchor;
    int32_t faults = FAULT_KINDS * s->count;
    make_uncertain(s, is_lasting ? ALL_RANGE_ERRORS : CHANGING_RANGE_ERRORS);
    real gain = REAL(1.0) / (s->information[chosen][chosen] + REAL(1.0) / square(s->tuning.late_std_m));
    real fault_m = gain * s->evidence[chosen];
    real variance = is_lasting ? gain : gain + fault_m * fault_m;
    real *opened = s->U[0];  /* change of each state per metre: 1 − V for the range error, −V for the others */
    real *shared = s->G[0];
    for (int32_t state = 0, state_end = s->n; state < state_end; state++) {
        opened[state] = -s->V[state][chosen];
    }
    opened[(is_lasting ? s->layout.constant : s->layout.change) + anchor] += REAL(1.0);
    for (int32_t one = 0; one < faults; one++) {
        shared[one] = gain * s->information[max_32(one, chosen)][min_32(one, chosen)];
    }
    shared[chosen] = REAL(0.0);
    if (is_lasting) {
        forget_lasting(s, anchor);
    } else {
        learn_lasting(s, shared, -REAL(1.0) / gain, fault_m);
    }
    open_direction(s, variance, faults);
    for (int32_t state = 0, state_end = s->used; state < state_end; state++) {
        s->x[state] += opened[state] * fault_m;
        s->V[state][chosen] = REAL(0.0);
    }
    for (int32_t one = 0; one < faults; one++) {
        s->evidence[one] -= shared[one] * s->evidence[chosen];
        for (int32_t other = 0; other < one + 1; other++) {
            s->information[one][other] -= shared[one] * shared[other] / gain;
        }
    }
    s->evidence[chosen] = REAL(0.0);
    for (int32_t one = 0; one < faults; one++) {
        s->information[max_32(one, chosen)][min_32(one, chosen)] = REAL(0.0);
    }
    s->status.faults_opened += 1;
}

/* Verdicts on the state: whether a new start is needed, and what it has to expect */

/* Whether single packets are often late. */
INTERNAL bool is_late_often(State *s) {
    return s->status.late_share > s->tuning.late_often_share;
}

/* Whether most measurements are beyond the gate. */
INTERNAL bool rejects_most(State *s) {
    return s->status.rejected_share > s->tuning.lost_share;
}

/* Whether more packets are rejected than a correct state would reject. */
INTERNAL bool is_lost(State *s) {
    int32_t in_row = s->status.rejected_in_row + s->status.stale_in_row;
    real late = min_real(s->status.late_share, MOST_LATE);
    return rejects_most(s) || (real)in_row * (REAL(1.0) - REAL(2.0) * late) >= s->tuning.lost_in_row;
}

/* Whether most relays do not fit: a wrong position shifts all clocks. */
INTERNAL bool relays_contradict(State *s) {
    Status *status = &s->status;
    return status->relays_lately_rejected > max_real(s->tuning.max_relays_rejected, status->relays_lately_accepted);
}

/* Whether most relays fit, and enough of them for a judgement. */
INTERNAL bool relays_fit(State *s) {
    Status *status = &s->status;
    return status->relays_lately_accepted > max_real(s->tuning.max_relays_rejected, REAL(4.0) *
            status->relays_lately_rejected);
}

/* Sum of the variances of x and y after ``ahead_s`` without receptions. */
INTERNAL real horizontal_variance_m2(State *s, real ahead_s) {
    real total = REAL(2.0) * motion_noise(s) * ahead_s * ahead_s * ahead_s / REAL(3.0);
    for (int32_t axis = 0; axis < 2; axis++) {
        int32_t speed = s->layout.velocity + axis;
        total += s->P[at(axis, axis)] + ahead_s * (REAL(2.0) * s->P[at(axis, speed)] + ahead_s * s->P[at(speed,
                speed)]);
    }
    return total;
}

/* Whether the range constants are as small as the settings state, as far as they are known. */
INTERNAL bool fits_settings(State *s) {
    int32_t first = s->layout.constant;
    int32_t count = s->count;
    for (int32_t one = 0; one < count; one++) {
        for (int32_t other = 0; other < one + 1; other++) {
            s->work[one][other] = s->P[at(first + one, first + other)];
        }
        s->work[one][one] += square(s->settings.range_std_m);
        s->work[count][one] = s->x[first + one];
    }
    whiten(s, count, 1);
    real chi2 = REAL(0.0);
    for (int32_t one = 0; one < count; one++) {
        chi2 += square(s->work[count][one]);
    }
    return chi2 < s->tuning.fitting_chi2 * (real)count;
}

/* Cycles that phases may have, as hypotheses which share one covariance.
 *
 * A phase whose cycle is not certain is processed at each cycle that is possible. These updates have the same row h and
 * the same variance. So the states that result have one P in common, and differ from their weighted mean, which is x, by a
 * vector each. These deviations are columns of V behind those of the faults, and every time update and measurement update
 * treats them as such: the innovation of a hypothesis is ν − h·deviation. Its weight is the likelihood of all stamps and
 * phases since. Unlikely hypotheses are dropped, alike ones are merged, and only the most likely ones are kept. */

/* The carrier's wavelength in use. */
INTERNAL real wavelength_m(State *s) {
    return (real)CYCLE_TICKS * TICK_M / (real)s->settings.carrier_cycles;
}

/* Process the phase in ``h`` at each cycle within a limit, for each hypothesis. Returns False if there is none.
 *
 * P·h and the fault inputs are the next of ``U`` and ``G``; ``innovation`` is the mean's, at any cycle; ``variance``:
 * of innovations. If each hypothesis has one cycle, the update is queued. */
INTERNAL bool take_cycles(State *s, real innovation, real variance, real limit_m) {
    bool is_possible = false;
    bool is_certain = true;
    real cycle_m = wavelength_m(s);
    for (int32_t one = 0, one_end = s->hypotheses.count; one < one_end; one++) {
        real nearest_m = abs_real(innovation_of(s, innovation, one));
        is_possible = is_possible || nearest_m <= limit_m;
        is_certain = is_certain && cycle_m - nearest_m > limit_m;
    }
    if (is_possible && is_certain) {
        for (int32_t one = 0, one_end = s->hypotheses.count; one < one_end; one++) {
            s->G[s->waiting][FAULT_KINDS * s->count + one] = innovation_of(s, innovation, one) - innovation;
        }
        update_later(s, innovation, variance, false);
    } else if (is_possible) {
        branch(s, innovation, variance, limit_m);
    }
    return is_possible;
}

/* The innovation of a hypothesis at the nearest cycle. */
INTERNAL real innovation_of(State *s, real innovation, int32_t one) {
    real off_m = innovation + s->G[s->waiting][FAULT_KINDS * s->count + one];
    return off_m - (real)floor_real(off_m / wavelength_m(s) + REAL(0.5)) * wavelength_m(s);
}

/* Replace the hypotheses by those that follow from them by a phase at each cycle within a limit. */
INTERNAL void branch(State *s, real innovation, real variance, real limit_m) {
    Hypotheses *hypotheses = &s->hypotheses;
    int32_t first = FAULT_KINDS * s->count;
    real cycle_m = wavelength_m(s);
    finish_updates(s);
    compute_ph(s);
    compute_fault_input(s, -1);
    hypotheses->found = 0;
    for (int32_t parent = 0, parent_end = hypotheses->count; parent < parent_end; parent++) {
        real off_m = innovation + s->G[0][first + parent];
        for (int64_t cycle = -floor_real((limit_m + off_m) / cycle_m), cycle_end = floor_real((limit_m - off_m) /
                cycle_m) + 1; cycle < cycle_end; cycle++) {
            real shift_m = (real)cycle * cycle_m;
            keep_likely(s, parent, shift_m, hypotheses->log_weight[parent] - REAL(0.5) * square(off_m + shift_m) /
                    variance);
        }
    }
    update(s, innovation, variance, REAL(1.0));
    replace(s, REAL(1.0) / SQRT(variance));
    settle_hypotheses(s);
}

/* Likelihood of the phase in ``h`` for all hypotheses together, of 1 for a certain cycle and an innovation of zero.
 *
 * The fault inputs are the next of ``G``. */
INTERNAL real likelihood(State *s, real innovation, real variance) {
    real total = REAL(0.0);
    for (int32_t one = 0, one_end = s->hypotheses.count; one < one_end; one++) {
        real nearest_m = innovation_of(s, innovation, one);
        for (int32_t cycle = -1; cycle < 2; cycle++) {
            real off_m = nearest_m + (real)cycle * wavelength_m(s);
            total += s->hypotheses.weight[one] * exp_(-REAL(0.5) * square(off_m) / variance);
        }
    }
    return total;
}

/* Keep a hypothesis that follows from another one by a cycle, if it is among the most likely ones, in order. */
INTERNAL void keep_likely(State *s, int32_t parent, real shift_m, real log_weight) {
    Hypotheses *hypotheses = &s->hypotheses;
    if (hypotheses->found == HYPOTHESES && log_weight <= hypotheses->new_log_weight[HYPOTHESES - 1]) {
        return;
    }
    int32_t place = min_32(hypotheses->found, HYPOTHESES - 1);
    hypotheses->found = place + 1;
    while (place > 0 && hypotheses->new_log_weight[place - 1] < log_weight) {
        hypotheses->new_log_weight[place] = hypotheses->new_log_weight[place - 1];
        hypotheses->parent[place] = hypotheses->parent[place - 1];
        hypotheses->shift_m[place] = hypotheses->shift_m[place - 1];
        place -= 1;
    }
    hypotheses->new_log_weight[place] = log_weight;
    hypotheses->parent[place] = parent;
    hypotheses->shift_m[place] = shift_m;
}

/* Replace all hypotheses by those found: a parent's deviation, and the gain times the shift by cycles.
 *
 * The first of ``U`` is P·h/√S of the phase, and ``inverse`` 1/√S. */
INTERNAL void replace(State *s, real inverse) {
    Hypotheses *hypotheses = &s->hypotheses;
    int32_t first = FAULT_KINDS * s->count;
    for (int32_t state = 0, state_end = s->used; state < state_end; state++) {
        real *effects = s->V[state];
        real gain = s->U[0][state] * inverse;
        for (int32_t one = 0, one_end = hypotheses->count; one < one_end; one++) {
            hypotheses->old[one] = effects[first + one];
        }
        for (int32_t one = 0, one_end = hypotheses->found; one < one_end; one++) {
            effects[first + one] = hypotheses->old[hypotheses->parent[one]] + gain * hypotheses->shift_m[one];
        }
    }
    for (int32_t one = 0, one_end = hypotheses->found; one < one_end; one++) {
        hypotheses->log_weight[one] = hypotheses->new_log_weight[one];
    }
    set_count(s, hypotheses->found);
}

/* Drop unlikely hypotheses, merge those that have become alike, and make x the mean. No updates may be queued. */
INTERNAL void settle_hypotheses(State *s) {
    Hypotheses *hypotheses = &s->hypotheses;
    int32_t first = FAULT_KINDS * s->count;
    real total = REAL(0.0);
    if (hypotheses->count == 0) {
        return;
    }
    real largest = hypotheses->log_weight[0];
    for (int32_t one = 1, one_end = hypotheses->count; one < one_end; one++) {
        largest = max_real(largest, hypotheses->log_weight[one]);
    }
    for (int32_t one = 0, one_end = hypotheses->count; one < one_end; one++) {
        hypotheses->log_weight[one] -= largest;
        hypotheses->weight[one] = exp_(hypotheses->log_weight[one]);
    }
    for (int32_t one = hypotheses->count - 1; one > -1; one--) {
        if (hypotheses->log_weight[one] < -s->tuning.unlikely_log_odds) {
            drop(s, one);
        } else {
            merge(s, one);
        }
    }
    for (int32_t one = 0, one_end = hypotheses->count; one < one_end; one++) {
        total += hypotheses->weight[one];
    }
    for (int32_t one = 0, one_end = hypotheses->count; one < one_end; one++) {
        hypotheses->weight[one] /= total;
    }
    for (int32_t state = 0, state_end = s->used; state < state_end; state++) {
        real *effects = s->V[state];
        real mean = REAL(0.0);
        for (int32_t one = 0, one_end = hypotheses->count; one < one_end; one++) {
            mean += hypotheses->weight[one] * effects[first + one];
        }
        s->x[state] += mean;
        for (int32_t one = 0, one_end = hypotheses->count; one < one_end; one++) {
            effects[first + one] -= mean;
        }
    }
}

/* Add a hypothesis to an earlier one from which it does not differ any more. */
INTERNAL void merge(State *s, int32_t one) {
    Hypotheses *hypotheses = &s->hypotheses;
    for (int32_t other = 0; other < one; other++) {
        if (are_alike(s, one, other)) {
            hypotheses->weight[other] += hypotheses->weight[one];
            hypotheses->log_weight[other] = log_(hypotheses->weight[other]);
            drop(s, one);
            return;
        }
    }
}

/* Whether two hypotheses differ by far less than their covariance in all states, of phases modulo a wavelength. */
INTERNAL bool are_alike(State *s, int32_t one, int32_t other) {
    int32_t first = FAULT_KINDS * s->count;
    real cycle_m = wavelength_m(s);
    for (int32_t state = 0, state_end = s->n; state < state_end; state++) {
        real off = s->V[state][first + one] - s->V[state][first + other];
        if (s->layout.ambiguity <= state && state < s->layout.change) {
            off -= (real)floor_real(off / cycle_m + REAL(0.5)) * cycle_m;
        }
        if (square(off) > s->tuning.alike * s->P[at(state, state)]) {
            return false;
        }
    }
    return true;
}

/* Drop a hypothesis; the last one takes its place. */
INTERNAL void drop(State *s, int32_t one) {
    Hypotheses *hypotheses = &s->hypotheses;
    int32_t first = FAULT_KINDS * s->count;
    int32_t last = s->hypotheses.count - 1;
    hypotheses->log_weight[one] = hypotheses->log_weight[last];
    hypotheses->weight[one] = hypotheses->weight[last];
    for (int32_t state = 0, state_end = s->used; state < state_end; state++) {
        s->V[state][first + one] = s->V[state][first + last];
    }
    set_count(s, last);
}

/* Set the number of hypotheses; unused columns of V are zero. */
INTERNAL void set_count(State *s, int32_t count) {
    int32_t first = FAULT_KINDS * s->count;
    for (int32_t state = 0, state_end = s->used; state < state_end; state++) {
        for (int32_t one = count, one_end = s->hypotheses.count; one < one_end; one++) {
            s->V[state][first + one] = REAL(0.0);
        }
    }
    s->hypotheses.count = count;
    s->rows = first + count;
}

/* Covariance of two states over the hypotheses. */
INTERNAL real scatter(State *s, int32_t state, int32_t other) {
    real total = REAL(0.0);
    int32_t first = FAULT_KINDS * s->count;
    if (HYPOTHESES > 0) {
        for (int32_t one = 0, one_end = s->hypotheses.count; one < one_end; one++) {
            total += s->hypotheses.weight[one] * s->V[state][first + one] * s->V[other][first + one];
        }
    }
    return total;
}

/* Deviation of the measurement in ``h`` by the most likely hypothesis, and the others' variance modulo a cycle.
 *
 * The fault inputs, which contain the deviations, are the next of ``G``. */
INTERNAL spread_of_h_results spread_of_h(State *s) {
    Hypotheses *hypotheses = &s->hypotheses;
    int32_t likely = 0;
    int32_t first = FAULT_KINDS * s->count;
    real cycle_m = wavelength_m(s);
    real total = REAL(0.0);
    for (int32_t one = 0, one_end = hypotheses->count; one < one_end; one++) {
        if (hypotheses->weight[one] > hypotheses->weight[likely]) {
            likely = one;
        }
    }
    real likely_m = -s->G[s->waiting][first + likely];
    for (int32_t one = 0, one_end = hypotheses->count; one < one_end; one++) {
        real off_m = -s->G[s->waiting][first + one] - likely_m;
        total += hypotheses->weight[one] * square(off_m - (real)floor_real(off_m / cycle_m + REAL(0.5)) * cycle_m);
    }
    return (spread_of_h_results){likely_m, total};
}

/* Replace all hypotheses by their mean. P gains their scatter. */
INTERNAL void give_up_hypotheses(State *s) {
    Hypotheses *hypotheses = &s->hypotheses;
    int32_t first = FAULT_KINDS * s->count;
    for (int32_t state = 0, state_end = s->used; state < state_end; state++) {
        int32_t row = row_of(state);
        real *effects = s->V[state];
        for (int32_t other = 0, other_end = row_end(state, s->n); other < other_end; other++) {
            for (int32_t one = 0, one_end = hypotheses->count; one < one_end; one++) {
                s->P[row + other] += hypotheses->weight[one] * effects[first + one] * s->V[other][first + one];
            }
        }
    }
    set_count(s, 0);
    set_count(s, 1);
    hypotheses->log_weight[0] = REAL(0.0);
    hypotheses->weight[0] = REAL(1.0);
}

/* Which measurements are used, and how process noise adapts to innovations.
 *
 * Covered are
 *
 * 1. single late receptions, as paths are blocked for a moment: the gate;
 * 2. an anchor behind a new obstacle, and its return: its range error jumps and is estimated again;
 * 3. a person or a wall that obstructs several anchors in turn: a jump raises the process noise of all range errors;
 * 4. reflections that change as the tag walks: learnt from the differences of range errors from step to step;
 * 5. a tag that moves more than assumed: innovations along an axis stay on one side;
 * 6. the tag's oscillator warming up, suddenly or slowly: innovations of all anchors are on one side;
 * 7. an anchor's oscillator warming up, or its counter jumping: relays show it;
 * 8. a tag at rest, which noise must not move;
 * 9. everything else: covariances grow with the mean NIS.
 *
 * Anchors that are late from the start, or increasingly late without a jump, are found by ``faults``.
 * ``docs/estimator_table.md`` shows what each mechanism buys. */

/* Whether two packets of each anchor have been processed since the start. */
INTERNAL bool is_warm(State *s) {
    return s->status.packets > 2 * s->count;
}

/* Count consecutive receptions of an anchor that are off by the same amount. */
INTERNAL void note_outlier(State *s, int32_t anchor, real innovation, real innovation_variance) {
    Anchor *a = &s->anchors[anchor];
    Tuning *tuning = &s->tuning;
    EstimatorSettings *settings = &s->settings;
    if (innovation * innovation <= square(tuning->suspect) * innovation_variance) {
        a->outliers_in_row = 0;
    } else {
        real stamps = REAL(2.0) * (settings->tx_variance_m2 + settings->rx_variance_m2);
        real apart = innovation - a->outlier_m;
        real both = innovation + a->outlier_m;
        bool agrees = a->outliers_in_row > 0 && apart * apart <= square(tuning->suspect) * stamps;
        agrees = agrees && both * both > square(tuning->together) * innovation_variance;
        a->outliers_in_row = agrees ? a->outliers_in_row + 1 : 1;
        a->outlier_m = innovation;
    }
}

/* Whether enough consecutive receptions are off to show that the anchor's range error has jumped. */
INTERNAL bool has_jumped(State *s, int32_t anchor) {
    real needed = is_late_often(s) ? s->tuning.in_row_where_late : s->tuning.in_row;
    return (real)s->anchors[anchor].outliers_in_row >= needed;
}

/* Whether the newest innovations of all anchors but at most one small one are on the side of this innovation.
 *
 * The tag's clock is the cause then. A faulty anchor draws the others to the opposite side of its own. While phases
 * determine the clock, stamps of all anchors may well err to one side. */
INTERNAL bool is_common(State *s, real normalised) {
    int32_t others = 0;
    real limit = follows_cycles(s) ? s->tuning.suspect : s->tuning.common;
    if (abs_real(normalised) <= limit) {
        return false;
    }
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        real newest = s->anchors[anchor].innovation;
        if (abs_real(newest) <= limit) {
            others += 1;
        } else if (newest * normalised <= REAL(0.0)) {
            others += 2;
        }
    }
    return s->count > s->dim && others <= 1;
}

/* Whether the anchor's clock has jumped rather than its range error.
 *
 * The mean of its relays' innovations is then off zero with the sign of its reception's. After a jump of the range
 * error the sign is opposite: the receptions have pulled the clock's estimate away from what relays show. */
INTERNAL bool is_of_clock(State *s, int32_t anchor, real innovation) {
    real relay_mean = s->anchors[anchor].relay_mean;
    return is_off_zero(s, relay_mean) && relay_mean * innovation > REAL(0.0);
}

/* Estimate an anchor's range error again after a jump. */
INTERNAL void open_range_error(State *s, int32_t anchor, real innovation) {
    int32_t change = s->layout.change + anchor;
    s->status.obstructions += 1;
    begin_obstruction(s, anchor);
    s->P[at(change, change)] += innovation * innovation;
    make_uncertain(s, CHANGING_RANGE_ERRORS);
}

/* Adapt the process noise of an anchor's range error to an innovation, if it is obstructed.
 *
 * It becomes smaller soon: if it were large, the error's end would look like another change. */
INTERNAL void adapt_change_noise(State *s, int32_t anchor, real normalised) {
    Anchor *a = &s->anchors[anchor];
    if (a->is_obstructed) {
        a->change_mean += s->tuning.mean_gain * (normalised - a->change_mean);
        a->change_scale *= is_off_zero(s, a->change_mean) ? s->tuning.noise_growth : REAL(1.0) - s->tuning.mean_gain;
        a->change_scale = min_real(max_real(a->change_scale, REAL(1.0)), s->tuning.max_scale);
    }
}

/* Factor on process noise after an innovation, which shows whether the noise is too small. */
INTERNAL real adapted(State *s, real scale, bool is_too_small, real least, real largest) {
    scale *= is_too_small ? s->tuning.noise_growth : s->tuning.noise_loss;
    return min_real(max_real(scale, least), largest);
}

/* Whether a running mean of normalised innovations is farther from zero than chance explains. */
INTERNAL bool is_off_zero(State *s, real mean) {
    real gain = s->tuning.mean_gain;
    return mean * mean * (REAL(2.0) - gain) / gain > square(s->tuning.suspect);
}

/* Sum the evidence of a measurement that an obstruction has ended, and return whether its error must be reset.
 *
 * Measurements are then more likely without the range error: the logarithms of the ratios are summed from the first
 * one on that favours the end (CUSUM, Page 1954), each squared error up to the gate, as single packets are late. An
 * error that returns slowly ends as it is, once it is known and close to zero. P·h of the newest measurement, which
 * contains the range error with ``sign``, is the first of ``U``. */
INTERNAL bool judge_end(State *s, int32_t anchor, real sign, real innovation, real innovation_variance) {
    Anchor *a = &s->anchors[anchor];
    int32_t change = s->layout.change + anchor;
    Tuning *tuning = &s->tuning;
    real most = square(s->settings.gate);
    if (!a->is_obstructed) {
        return false;
    }
    real error_m = s->x[change];
    real variance = s->P[at(change, change)];
    real left_variance = max_real(innovation_variance - REAL(2.0) * sign * s->U[0][change] + variance,
            s->settings.rx_variance_m2);
    left_variance += clear_variance(s, anchor);
    real shown = min_real(square(innovation) / innovation_variance, most);
    shown -= min_real(square(innovation + sign * error_m) / left_variance, most);
    a->ended_log_odds = max_real(REAL(0.0), a->ended_log_odds + REAL(0.5) * (shown + log_(innovation_variance /
            left_variance)));
    real usual = s->status.place_variance_m2;
    a->is_obstructed = variance >= square(tuning->ended_std_m) + usual || square(error_m) >= variance + usual;
    return a->is_obstructed && a->ended_log_odds > tuning->ended_log_odds;
}

/* Count an innovation as rejected or accepted, and update the running means. */
INTERNAL void note_innovation(State *s, real innovation, real innovation_variance, bool is_difference) {
    Status *status = &s->status;
    Tuning *tuning = &s->tuning;
    real forgetting = tuning->forgetting;
    real normalised = innovation / SQRT(innovation_variance);
    bool is_beyond = !is_within_gate(s, normalised);
    real beyond = is_beyond ? REAL(1.0) : REAL(0.0);
    if (!is_difference) {
        status->late_share += tuning->slow_forgetting * (beyond - status->late_share);
    }
    status->rejected_share += forgetting * (beyond - status->rejected_share);
    if (is_beyond) {
        status->rejected += 1;
        status->rejected_in_row += 1;
    } else {
        status->accepted += 1;
        status->rejected_in_row = 0;
        status->mean_nis += forgetting * (normalised * normalised - status->mean_nis);
        status->mean_square_m2 += forgetting * (innovation * innovation - status->mean_square_m2);
    }
}

/* Whether a normalised innovation is within the gate; False for NaN. */
INTERNAL bool is_within_gate(State *s, real normalised) {
    return -s->settings.gate <= normalised && normalised <= s->settings.gate;
}

/* Factor on the variance of a measurement with this normalised innovation; 0 beyond the gate.
 *
 * Large innovations are down-weighted if receptions are often late or a range error has just jumped, as the next one
 * may, and always in time differences, of which either anchor may be late. */
INTERNAL real variance_scale(State *s, real normalised, bool is_difference) {
    Tuning *tuning = &s->tuning;
    if (!is_within_gate(s, normalised)) {
        return REAL(0.0);
    }
    if (is_difference) {
        return max_real(REAL(1.0), abs_real(normalised) / tuning->difference_huber);
    }
    bool may_be_late = is_late_often(s) || jump_share(s) > tuning->recent_jumps;
    return may_be_late ? max_real(REAL(1.0), abs_real(normalised) / tuning->reception_huber) : REAL(1.0);
}

/* Track the variance of an anchor's changing range error: the mean square of its estimate.
 *
 * The maximisation step of expectation maximisation (Shumway and Stoffer 1982) with fading memory. */
INTERNAL void adapt_change_variance(State *s, int32_t anchor, real elapsed_s) {
    Tuning *tuning = &s->tuning;
    EstimatorSettings *settings = &s->settings;
    Anchor *a = &s->anchors[anchor];
    real memory_s = settings->change_memory_s;
    if (memory_s > REAL(0.0)) {
        finish_updates(s);
        int32_t change = s->layout.change + anchor;
        real present = square(s->x[change]) + s->P[at(change, change)];
        real variance = a->change_variance_m2 + min_real(elapsed_s / memory_s, REAL(0.5)) * (present -
                a->change_variance_m2);
        variance = max_real(variance, square(settings->least_change_std_m));
        a->change_variance_m2 = min_real(variance, square(tuning->max_change_std_m));
    }
}

/* Learn how range errors change with walked distance, from their differences after one and after two steps.
 *
 * For a Gauss–Markov process of variance σ² with correlation c over a step, half the mean square difference is noise +
 * σ²·(1 − c) after one step and noise + σ²·(1 − c²) after two (a semivariogram, Matheron 1963). */
INTERNAL void learn_place(State *s, int32_t anchor, real residual_m) {
    Tuning *tuning = &s->tuning;
    EstimatorSettings *settings = &s->settings;
    Status *status = &s->status;
    Anchor *a = &s->anchors[anchor];
    real step_m = status->walked_m - a->place_walked_m;
    if (step_m < tuning->place_step_m) {
        return;
    }
    a->place_steps = step_m < REAL(2.0) * tuning->place_step_m ? a->place_steps + 1 : 0;
    if (a->place_steps >= 2) {
        status->place_samples = min_64(status->place_samples + 1, truncated(tuning->place_memory));
        for (int32_t lag = 0; lag < 2; lag++) {
            real half = REAL(0.5) * square(residual_m - a->place_residual_m[lag]);
            real mean = status->place_square_m2[lag];
            real limited = min_real(half, PLACE_LIMIT * mean) / PLACE_LIMITED_MEAN;
            status->place_square_m2[lag] += (limited - mean) / (tuning->place_first + (real)status->place_samples);
        }
    }
    a->place_residual_m[1] = a->place_residual_m[0];
    a->place_residual_m[0] = residual_m;
    a->place_walked_m = status->walked_m;
    real noise = settings->tx_variance_m2 + settings->rx_variance_m2;
    real near = status->place_square_m2[0] - noise;
    real far = status->place_square_m2[1] - noise;
    status->place_variance_m2 = REAL(0.0);
    status->place_distance_m = settings->place_distance_m;
    if ((real)status->place_samples >= tuning->place_samples && near > tuning->place_min_m2) {
        real kept = min_real(max_real(far / near - REAL(1.0), tuning->place_kept), REAL(1.0) - tuning->place_kept);
        real variance = min_real(near / (REAL(1.0) - kept), square(tuning->max_change_std_m));
        if (variance > square(settings->place_std_m)) {
            status->place_variance_m2 = variance;
            status->place_distance_m = -tuning->place_step_m / log_(kept);
        }
    }
}

/* Update the time without motion, shown by the position or by innovations that stay on one side. */
INTERNAL void update_stationary(State *s, real dt) {
    Status *status = &s->status;
    Tuning *tuning = &s->tuning;
    real chi2 = REAL(0.0);
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        chi2 += square(s->x[axis] - status->stationary_m[axis]) / s->P[at(axis, axis)];
    }
    status->stationary_s += dt;
    bool moved = chi2 > (real)s->dim || status->lag_square > tuning->lag_limit || status->rejected_in_row > 1;
    if (MOTION_STATES > 0 && s->motion.has_effect) {
        moved = moved || s->motion.rest_s < tuning->level_s;
    }
    if (moved) {
        status->stationary_s = REAL(0.0);
    }
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {  /* also if the position has become better known */
        if (moved || s->P[at(axis, axis)] < tuning->better_known * status->stationary_m2[axis]) {
            status->stationary_m[axis] = s->x[axis];
            status->stationary_m2[axis] = s->P[at(axis, axis)];
        }
    }
}

/* Adapt the process noise of the tag's motion and clock to an innovation.
 *
 * The direction to the anchor is in the first terms of ``h``. */
INTERNAL void adapt_process_noise(State *s, real normalised) {
    Tuning *tuning = &s->tuning;
    Status *status = &s->status;
    real gain = tuning->mean_gain;
    real lag_square = REAL(0.0);
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        status->lag[axis] += gain * (s->h[axis] * normalised - status->lag[axis]);
        lag_square += square(status->lag[axis]);
    }
    lag_square *= (REAL(2.0) - gain) / gain;
    status->lag_square += tuning->forgetting * (lag_square - status->lag_square);
    if (lag_square > tuning->sudden_lag) {
        status->q_scale = min_real(REAL(2.0) * status->q_scale, tuning->max_scale);
    } else {
        status->q_scale = adapted(s, status->q_scale, status->lag_square > tuning->lag_limit, REAL(1.0),
                tuning->max_scale);
    }
    status->common_mean += gain * (normalised - status->common_mean);
    bool is_clock_off = is_off_zero(s, status->common_mean) && !follows_cycles(s);
    real least = max_real(least_scale(s, status->tag_walk), least_scale(s, status->anchors_walk));
    status->walk_scale = adapted(s, status->walk_scale, is_clock_off, least, tuning->max_walk_scale);
}

/* Adapt the process noise of an anchor's clock to a relay's innovation. */
INTERNAL void adapt_clock_noise(State *s, int32_t anchor, real normalised) {
    Anchor *a = &s->anchors[anchor];
    a->relay_mean += s->tuning.mean_gain * (normalised - a->relay_mean);
    real least = least_scale(s, s->status.anchors_walk);
    bool is_off = is_off_zero(s, a->relay_mean);
    if (PHASE_STATES > 0 && a->mesh.is_known) {  /* rather than its clock wander, its cycles are wrong */
        if (is_off_zero(s, a->relay_mean * s->tuning.suspect / s->settings.gate)) {
            int32_t offset = s->layout.offset + anchor;
            s->P[at(offset, offset)] += square(s->tuning.slip_std_m);
            a->mesh.is_known = false;
            a->relay_mean = REAL(0.0);
        }
        is_off = false;
    }
    a->walk_scale = adapted(s, a->walk_scale, is_off, least, s->tuning.max_walk_scale);
}

/* Factor on the settings' random walk of a clock below which it is not adapted, by what its rates have shown. */
INTERNAL real least_scale(State *s, real walk) {
    if (PHASE_STATES > 0 && s->status.rate_changes > 1 && s->settings.walk > REAL(0.0)) {
        return min_real(max_real(walk / s->settings.walk, s->tuning.least_walk_scale), s->tuning.max_walk_scale);
    }
    return REAL(1.0);
}

/* Learn how little the clocks wander, from the changes of their mean rates.
 *
 * From one interval τ to the next a rate changes with the variance 2/3·walk·τ; the stamps' noise only adds to it. The
 * mean change of all offsets is the tag's clock, and the rest are the anchors'. */
INTERNAL void learn_least_walk(State *s) {
    Status *status = &s->status;
    Tuning *tuning = &s->tuning;
    real elapsed_s = (real)(status->epoch_ticks - status->rate_ticks) * TICK_S;
    if (elapsed_s < tuning->rate_s) {
        return;
    }
    bool is_long = elapsed_s > REAL(2.0) * tuning->rate_s;
    int32_t found = 0;
    real mean = REAL(0.0);
    real square_sum = REAL(0.0);
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        Anchor *a = &s->anchors[anchor];
        real offset_m = s->x[s->layout.offset + anchor];
        real rate_mps = ((real)(a->offset_ticks - a->rate_offset_ticks) * TICK_M + (offset_m - a->rate_offset_m)) /
                elapsed_s;
        real change_mps = rate_mps - a->mean_rate_mps;
        a->rate_offset_ticks = a->offset_ticks;
        a->rate_offset_m = offset_m;
        a->mean_rate_mps = rate_mps;
        a->rates = is_long || !a->has_rate ? 1 : a->rates + 1;
        if (a->rates > 2) {
            found += 1;
            square_sum += square(change_mps - mean) * (real)(found - 1) / (real)found;
            mean += (change_mps - mean) / (real)found;
        }
    }
    if (found > s->dim) {
        real walk_s = REAL(1.5) / elapsed_s;
        status->rate_changes += 1;
        real gain = REAL(1.0) / (real)min_64(status->rate_changes, truncated(tuning->rate_changes));
        status->tag_walk += gain * (square(mean) * walk_s - status->tag_walk);
        status->anchors_walk += gain * (square_sum / (real)(found - 1) * walk_s - status->anchors_walk);
    }
    status->rate_ticks = status->epoch_ticks;
}

/* Factor on the position's covariance while innovations are larger than expected.
 *
 * Most of an innovation is the stamps' noise, so the state errs by more than the innovations show. */
INTERNAL real covariance_scale(State *s) {
    real nis = s->status.mean_nis;
    return nis > s->tuning.wrong_nis ? nis * nis : REAL(1.0);
}

/* Covariance of two states of position or velocity, as a fix and its levels state it. */
INTERNAL real motion_covariance(State *s, int32_t state, int32_t other) {
    return covariance_scale(s) * s->P[at(state, other)] + scatter(s, state, other);
}

/* Protection levels: bounds on the position error even if receptions are late (``docs/maths.md`` section 8).
 *
 * Hypothesis: the tag's receptions of every anchor are late (or early) by a constant of its own, all at once. With the
 * faults b̂ and their sensitivities V (``faults``) the estimate under the hypothesis and its covariance are
 *
 *     x + V·b̂        P + V·(M + I/σ_f²)⁻¹·Vᵀ
 *
 * so the error exceeds |V·b̂| + k·σ only with the stated risk, whichever anchors are at fault. Three kinds are considered:
 * constants since an anchor joined, recent changes, and growth over seconds. A fault larger than σ_f is detected as a
 * jump or by yᵀ·(M + I/σ_f²)⁻¹·y, which is χ² without faults; then no level is stated. */

/* Compute the levels in metres and the tests of faults. */
INTERNAL void protect(State *s) {
    real *levels = s->levels;
    levels[VPL] = REAL(0.0);
    levels[HPL] = REAL(0.0);
    for (int32_t kind = 0; kind < FAULT_KINDS; kind++) {
        levels[FIRST_TEST + kind] = fault_chi2(s, kind, s->dim);
        real *faults = s->work[s->count];
        real *x = s->work[s->count + 1];
        real *y = s->work[s->count + 2];
        real *z = s->work[s->count + 3];
        int32_t first = s->count + 1 + (kind == LASTING ? AXES : 0);
        real *of_x = s->work[first];
        real *of_y = s->work[first + 1];
        real *of_z = s->work[first + 2];
        real shift_x = REAL(0.0);
        real shift_y = REAL(0.0);
        real shift_z = REAL(0.0);
        real xx = motion_covariance(s, 0, 0);
        real xy = motion_covariance(s, 0, 1);
        real yy = motion_covariance(s, 1, 1);
        real zz = REAL(0.0);
        for (int32_t one = 0, one_end = s->count; one < one_end; one++) {
            shift_x += x[one] * faults[one];
            shift_y += y[one] * faults[one];
            xx += x[one] * of_x[one];
            xy += x[one] * of_y[one];
            yy += y[one] * of_y[one];
            if (s->dim == 3) {
                shift_z += z[one] * faults[one];
                zz += z[one] * of_z[one];
            }
        }
        real largest = REAL(0.5) * (xx + yy) + SQRT(REAL(0.25) * square(xx - yy) + xy * xy);
        levels[HPL] = max_real(levels[HPL], hypot_(shift_x, shift_y) + s->horizontal_k * SQRT(largest));
        if (s->dim == 3) {
            levels[VPL] = max_real(levels[VPL], abs_real(shift_z) + s->vertical_k * SQRT(motion_covariance(s, 2, 2) +
                    zz));
        }
    }
}

/* The largest test of faults; without faults χ² with one degree of freedom for each anchor. */
INTERNAL real largest_test(State *s) {
    real largest = REAL(0.0);
    for (int32_t kind = 0; kind < FAULT_KINDS; kind++) {
        largest = max_real(largest, s->levels[FIRST_TEST + kind]);
    }
    return largest;
}

/* Whether the anchors determine on which side of their plane the tag is */

/* Fit the least-squares plane through the anchors; with a given height, the line on the floor plan. */
SKYLESS_EXPORT void skyless_fit_plane(State *s) {
    Status *status = &s->status;
    for (int32_t axis = 0; axis < AXES; axis++) {
        status->plane_normal[axis] = REAL(0.0);
        status->plane_m[axis] = REAL(0.0);
    }
    if (s->count < s->dim) {
        return;
    }
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
            status->plane_m[axis] += s->anchors[anchor].position_m[axis] / (real)s->count;
        }
    }
    for (int32_t one = 0, one_end = s->dim; one < one_end; one++) {
        for (int32_t other = 0, other_end = s->dim; other < other_end; other++) {
            s->work[one][other] = REAL(0.0);
        }
    }
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        real *position_m = s->anchors[anchor].position_m;
        for (int32_t one = 0, one_end = s->dim; one < one_end; one++) {
            for (int32_t other = 0, other_end = s->dim; other < other_end; other++) {
                s->work[one][other] += (position_m[one] - status->plane_m[one]) * (position_m[other] -
                        status->plane_m[other]);
            }
        }
    }
    find_least_axis(s, s->dim);
}

/* Write the eigenvector of the matrix in ``work`` with the smallest eigenvalue into the plane's normal.
 *
 * By Jacobi's method (1846). */
INTERNAL void find_least_axis(State *s, int32_t dim) {
    real (*M)[MAX_ANCHORS] = s->work;
    int32_t axes = AXES;
    for (int32_t one = 0; one < dim; one++) {
        for (int32_t other = 0; other < dim; other++) {
            M[axes + one][other] = one == other ? REAL(1.0) : REAL(0.0);
        }
    }
    for (int32_t time_1 = 0; time_1 < SWEEPS; time_1++) {
        for (int32_t one = 0; one < dim; one++) {
            for (int32_t other = 0; other < one; other++) {
                if (M[one][other] != REAL(0.0)) {
                    rotate(s, dim, one, other);
                }
            }
        }
    }
    int32_t least = 0;
    for (int32_t axis = 0; axis < dim; axis++) {
        if (M[axis][axis] < M[least][least]) {
            least = axis;
        }
    }
    for (int32_t axis = 0; axis < dim; axis++) {
        s->status.plane_normal[axis] = M[axes + axis][least];
    }
}

/* Rotate two axes of the matrix in ``work`` so that their off-diagonal element becomes zero. */
INTERNAL void rotate(State *s, int32_t dim, int32_t one, int32_t other) {
    real (*M)[MAX_ANCHORS] = s->work;
    real half = REAL(0.5) * (M[other][other] - M[one][one]) / M[one][other];
    real tangent = (half >= REAL(0.0) ? REAL(1.0) : -REAL(1.0)) / (abs_real(half) + SQRT(half * half + REAL(1.0)));
    real cosine = REAL(1.0) / SQRT(tangent * tangent + REAL(1.0));
    real sine = tangent * cosine;
    for (int32_t row = 0; row < AXES + dim; row++) {  /* columns, including those of the axes behind the matrix */
        if (row < dim || row >= AXES) {
            real kept = M[row][one];
            M[row][one] = cosine * kept - sine * M[row][other];
            M[row][other] = sine * kept + cosine * M[row][other];
        }
    }
    for (int32_t column = 0; column < dim; column++) {
        real kept = M[one][column];
        M[one][column] = cosine * kept - sine * M[other][column];
        M[other][column] = sine * kept + cosine * M[other][column];
    }
    M[other][one] = REAL(0.0);
    M[one][other] = REAL(0.0);
}

/* Whether the tag and its mirror image in the anchors' plane (2-D: line) explain the ranges about equally well.
 *
 * The tag's clock and a shift of the image absorb the difference by least squares; range errors must explain the rest.
 * Not if the tag cannot be where the image is, nor while a sensor measures the height. */
INTERNAL bool is_side_open(State *s) {
    Status *status = &s->status;
    Tuning *tuning = &s->tuning;
    EstimatorSettings *settings = &s->settings;
    int32_t dim = s->dim;
    if ((real)(status->epoch_ticks - status->height_ticks) * TICK_S < tuning->sensor_valid_s) {
        return false;
    }
    real *normal = status->plane_normal;
    real off_m = REAL(0.0);
    for (int32_t axis = 0; axis < dim; axis++) {
        off_m += normal[axis] * (s->x[axis] - status->plane_m[axis]);
    }
    real image_z_m = s->x[2] - REAL(2.0) * off_m * normal[2];
    bool is_near = off_m * off_m * square(normal[2]) <= s->P[at(2, 2)];
    if (dim == 3 && !((settings->lowest_m <= image_z_m && image_z_m <= settings->highest_m) || is_near)) {
        return false;
    }
    real variance = square(settings->range_std_m) + square(settings->survey_std_m) + settings->rx_variance_m2;
    return left_by_image(s, off_m, variance) < tuning->apart_chi2 * variance;
}

/* Sum of squares [m²] of the ranges' difference that the tag's clock and a shift of the image leave.
 *
 * ``off_m``: signed distance of the tag from the plane; ``variance``: of a range. */
INTERNAL real left_by_image(State *s, real off_m, real variance) {
    EstimatorSettings *settings = &s->settings;
    int32_t dim = s->dim;
    real *normal = s->status.plane_normal;
    real left = REAL(0.0);
    if (s->count <= dim) {
        return left;
    }
    real probe_m = max_real(abs_real(off_m), s->tuning.probe_m) * (off_m > REAL(0.0) ? REAL(1.0) : -REAL(1.0));
    real *information = s->work[dim + 1];
    real *seen = s->work[dim + 2];
    for (int32_t one = 0; one < dim + 2; one++) {
        for (int32_t other = 0; other < dim + 1; other++) {
            s->work[one][other] = REAL(0.0);
        }
    }
    for (int32_t one = 0; one < dim; one++) {
        s->work[one][one] = variance / square(s->tuning.shift_part * probe_m);
    }
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        real *position_m = s->anchors[anchor].position_m;
        real tag_m2 = dim == 3 ? REAL(0.0) : square(settings->height_m - position_m[2]);
        real image_m2 = tag_m2;
        for (int32_t axis = 0; axis < dim; axis++) {
            real foot_m = s->x[axis] - off_m * normal[axis] - position_m[axis];
            seen[axis] = foot_m - probe_m * normal[axis];
            tag_m2 += square(foot_m + probe_m * normal[axis]);
            image_m2 += square(foot_m - probe_m * normal[axis]);
        }
        real apart_m = SQRT(image_m2) - SQRT(tag_m2);
        real image_m = SQRT(image_m2);
        for (int32_t axis = 0; axis < dim; axis++) {
            seen[axis] /= image_m;
        }
        seen[dim] = REAL(1.0);
        left += apart_m * apart_m;
        for (int32_t one = 0; one < dim + 1; one++) {
            information[one] += seen[one] * apart_m;
            for (int32_t other = 0; other < one + 1; other++) {
                s->work[one][other] += seen[one] * seen[other];
            }
        }
    }
    whiten(s, dim + 1, 1);
    for (int32_t one = 0; one < dim + 1; one++) {
        left -= square(information[one]);
    }
    return left;
}

/* Whether a position can be relied on */

/* Whether the position's levels are reliable: ``SOUND``, ``OBSTRUCTED``, ``CONTRADICTED`` or ``UNAVAILABLE``. */
INTERNAL int32_t integrity_state(State *s) {
    Status *status = &s->status;
    Tuning *tuning = &s->tuning;
    int32_t state = SOUND;
    real range_m = REAL(0.0);
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        range_m += s->anchors[anchor].range_m / (real)s->count;
        if (s->anchors[anchor].is_obstructed || s->anchors[anchor].has_fault) {
            state = OBSTRUCTED;
        }
    }
    bool was_contradicted = status->fault_std_m[LASTING] > tuning->lasting_std_m;  /* then no anchor is selected */
    real limit = was_contradicted ? tuning->sure_chi2 : tuning->uncovered_chi2;
    real share = SQRT(s->P[at(0, 0)] + s->P[at(1, 1)]) / max_real(range_m, REAL(1e-06));  /* levels are a first-order approximation in this share */
    if (largest_test(s) > limit) {
        state = CONTRADICTED;
    }
    if (was_contradicted && (real)(status->epoch_ticks - status->start_ticks) * TICK_S < tuning->contradicted_start_s) {
        state = CONTRADICTED;
    }
    if (status->has_open_ranges && share > tuning->max_open_level_std) {
        state = CONTRADICTED;
    }
    bool is_new = s->count <= s->dim || !is_warm(s);
    if (is_new || share > tuning->curved_std || is_side_open(s)) {
        state = UNAVAILABLE;
    }
    return max_32(state, status->withheld);
}

/* The kinds of measurements. Each is linearised at the state, gated, and processed by one scalar update.
 *
 *     own reception    R − T  =  |p − a| + b + w + range errors + noise                  (the tag receives an anchor)
 *     relay            S − T  =  |aᵢ − aⱼ| + bⱼ − bᵢ + wⱼ + pair's constant + noise      (anchor i received anchor j)
 *     report           bₘ − bᵢ as anchor i knows it                                       (its clock against the master's)
 *     difference       |p − b| − |p − a| + range errors + noise                           (ready-made, of a pair)
 *     height           z                                                                  (a sensor of the tag's)
 *     zero velocity    v                                                                  (the tag stands still)
 *
 * with offsets b, TX noise w, all in metres. ``docs/maths.md`` section 6 derives them. */

/* Terms of a measurement */

/* Add a term: weight × state. */
INTERNAL void add_term(State *s, int32_t state, real weight) {
    s->h[s->terms] = weight;
    s->h_index[s->terms] = state;
    s->terms += 1;
}

/* Sum of h·x over the terms from ``begin`` on. */
INTERNAL real h_dot_x(State *s, int32_t begin) {
    real total = REAL(0.0);
    for (int32_t term = begin, term_end = s->terms; term < term_end; term++) {
        total += s->h[term] * s->x[s->h_index[term]];
    }
    return total;
}

/* Number of terms of a distance: position, survey error and, in 2-D, the height's error. */
INTERNAL int32_t direction_terms(State *s) {
    return s->dim + 3;
}

/* Add the distance to an anchor, linearised with the unit vector away from it. Returns the distance.
 *
 * The anchor's survey error follows with the opposite sign, and in 2-D the height's error: ``direction_terms`` in all.
 * The vector belongs to the held point, the surveyed anchor and the given height. If it followed the newest estimate,
 * that estimate's noise would seem to carry information on what the ranges leave open. */
INTERNAL real add_direction(State *s, int32_t anchor, real sign) {
    Anchor *a = &s->anchors[anchor];
    hold_direction(s, anchor);
    return add_direction_from(s, anchor, sign, a->held_m, a->held_range_m);
}

/* Like ``add_direction``, with the direction from the anchor to a given point at that range. */
INTERNAL real add_direction_from(State *s, int32_t anchor, real sign, real *point_m, real point_range_m) {
    Layout *where = &s->layout;
    Anchor *a = &s->anchors[anchor];
    int32_t survey = where->survey + s->dim * anchor;
    real squared = REAL(0.0);
    real up_m = REAL(0.0);
    if (s->dim == 2) {
        up_m = s->settings.height_m - a->position_m[2];
        squared += square(up_m + s->x[where->height]);
    }
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        squared += square(s->x[axis] - a->position_m[axis] - s->x[survey + axis]);
        add_term(s, axis, sign * (point_m[axis] - a->position_m[axis]) / point_range_m);
    }
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        add_term(s, survey + axis, -(sign * (point_m[axis] - a->position_m[axis]) / point_range_m));
    }
    if (s->dim == 2) {
        add_term(s, where->height, sign * up_m / point_range_m);
    }
    return max_real(SQRT(squared), REAL(1e-06));
}

/* Move the point at which ranges to an anchor are linearised to the estimate, once that is far enough away. */
INTERNAL void hold_direction(State *s, int32_t anchor) {
    Tuning *tuning = &s->tuning;
    Anchor *a = &s->anchors[anchor];
    real moved_m2 = REAL(0.0);
    real squared = REAL(0.0);
    real variance = REAL(0.0);
    if (s->dim == 2) {
        squared += square(s->settings.height_m - a->position_m[2]);
    }
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        moved_m2 += square(s->x[axis] - a->held_m[axis]);
        squared += square(s->x[axis] - a->position_m[axis]);
        variance += s->P[at(axis, axis)];
    }
    real step_m2 = max_real(min_real(square(tuning->suspect) * variance, square(tuning->held_max_m)),
            square(tuning->held_step_m));
    if (s->status.range_errors == NO_RANGE_ERRORS) {
        step_m2 = REAL(0.0);  /* ranges leave nothing open that noise could seem to measure */
    }
    if (a->held_range_m == REAL(0.0) || moved_m2 > step_m2) {
        for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
            a->held_m[axis] = s->x[axis];
        }
        a->held_range_m = max_real(SQRT(squared), REAL(1e-06));
    }
}

/* Add an anchor's range errors: changing part, constant part and slope. */
INTERNAL void add_range_errors(State *s, int32_t anchor, real sign) {
    Layout *where = &s->layout;
    real from_m = s->tuning.slope_from_m;
    add_term(s, where->change + anchor, sign);
    add_term(s, where->constant + anchor, sign);
    real far = min_real(max_real((s->anchors[anchor].held_range_m - from_m) / from_m, -REAL(1.0)), REAL(1.0));
    add_term(s, where->slope, sign * far);
}

/* Mean excess of the range over its linearisation: half the variance across the direction, over the range.
 *
 * The second term of the Taylor series, with the variance 2·bend² (Jazwinski 1970, section 9.3); 0 if negligible
 * against the variance of the stamps. The direction is in the first terms of ``h``. */
INTERNAL real find_curvature_m(State *s, real range_m, real variance) {
    real across = REAL(0.0);
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        across += s->P[at(axis, axis)];
    }
    real least = s->tuning.curvature_share * variance * range_m * range_m;
    if (REAL(0.5) * across * across >= least) {
        for (int32_t one = 0, one_end = s->dim; one < one_end; one++) {
            for (int32_t other = 0, other_end = s->dim; other < other_end; other++) {
                across -= s->h[one] * s->P[at(one, other)] * s->h[other];
            }
        }
    }
    return REAL(0.5) * across * across >= least ? REAL(0.5) * across / range_m : REAL(0.0);
}

/* The tag receives an anchor */

/* Write the tag's reception of an anchor into ``h``. Returns the distance. */
INTERNAL real reception_terms(State *s, int32_t anchor, bool has_tx_noise) {
    s->terms = 0;
    real range_m = add_direction(s, anchor, REAL(1.0));
    add_term(s, s->layout.offset + anchor, REAL(1.0));
    if (has_tx_noise) {
        add_term(s, s->layout.tx_noise + anchor, REAL(1.0));
    }
    add_range_errors(s, anchor, REAL(1.0));
    return range_m;
}

/* Process the tag's reception of an anchor's packet: ``USED``, ``UNUSED`` or ``CLOCK_JUMPED``.
 *
 * R − T = |p − a − δa| + b + w + change + constant + slope·far + noise. ``variance_factor`` is above 1 for a reception
 * whose path looks blocked; such a reception is late rather than noisy, so it is gated without the factor. */
INTERNAL int32_t own_reception(State *s, int32_t anchor, int64_t rx_ticks, int64_t tx_ticks, real variance_factor) {
    Tuning *tuning = &s->tuning;
    EstimatorSettings *settings = &s->settings;
    Status *status = &s->status;
    Layout *where = &s->layout;
    Anchor *a = &s->anchors[anchor];
    real elapsed_s = (real)(rx_ticks - a->rx_ticks) * TICK_S;
    relax_range_error(s, anchor, elapsed_s, status->walked_m - a->walked_m);
    real rx_variance = settings->rx_variance_m2;
    a->has_tx_noise = a->is_relayed;
    if (a->is_relayed) {
        reset_state(s, where->tx_noise + anchor, settings->tx_variance_m2);
    } else {
        rx_variance += settings->tx_variance_m2;
    }
    real range_m = reception_terms(s, anchor, a->is_relayed);
    real curvature_m = find_curvature_m(s, range_m, rx_variance);
    rx_variance += REAL(2.0) * curvature_m * curvature_m;
    real expected_m = range_m + curvature_m + h_dot_x(s, direction_terms(s));
    real innovation = (real)(rx_ticks - tx_ticks - a->offset_ticks) * TICK_M - expected_m;
    real innovation_variance = compute_ph(s) + rx_variance;
    a->range_m = range_m;
    if (judge_end(s, anchor, REAL(1.0), innovation, innovation_variance)) {
        innovation += end_obstruction(s, anchor);
        innovation_variance = compute_ph(s) + rx_variance;
    }
    if (!a->has_rate) {
        innovation_variance += (variance_factor - REAL(1.0)) * settings->rx_variance_m2;
        compute_fault_input(s, anchor);
        find_rate(s, anchor, innovation, innovation_variance, elapsed_s);
        carry_ticks(s, anchor);
        return USED;
    }
    a->innovation = innovation / SQRT(innovation_variance);
    if (!is_late_often(s)) {  /* late packets are no multipath */
        learn_place(s, anchor, innovation + s->x[where->change + anchor]);
    }
    if (is_warm(s) && is_common(s, a->innovation)) {
        status->walk_scale = tuning->max_walk_scale;
        a->outliers_in_row = 0;
    } else if (is_warm(s)) {
        note_outlier(s, anchor, innovation, innovation_variance);
        if (has_jumped(s, anchor)) {
            if (is_of_clock(s, anchor, innovation)) {
                return CLOCK_JUMPED;
            }
            /* the outliers counted as late; a jump shows that none of them was */
            status->late_share = max_real(status->late_share - tuning->slow_forgetting * (real)(a->outliers_in_row - 1),
                    REAL(0.0));
            innovation = jump(s, anchor, innovation, rx_variance);
            innovation_variance = compute_ph(s) + rx_variance;
            if (innovation < -settings->gate * SQRT(innovation_variance)) {
                return CLOCK_JUMPED;
            }
        }
    }
    bool is_used = use_reception(s, anchor, innovation, innovation_variance, variance_factor);
    if (is_used) {
        adapt_change_variance(s, anchor, elapsed_s);
    }
    carry_ticks(s, anchor);
    return is_used ? USED : UNUSED;
}

/* Queue the update by a reception, and adapt the process noise; False if it is beyond the gate. */
INTERNAL bool use_reception(State *s, int32_t anchor, real innovation, real innovation_variance, real variance_factor) {
    note_innovation(s, innovation, innovation_variance, false);
    real normalised = innovation / SQRT(innovation_variance);
    real scale = variance_scale(s, normalised, false);
    if (scale > REAL(0.0)) {
        adapt_change_noise(s, anchor, normalised);
        if (is_warm(s)) {
            adapt_process_noise(s, normalised / scale);
        }
        real used_variance = innovation_variance * scale + (variance_factor - REAL(1.0)) * s->settings.rx_variance_m2;
        compute_fault_input(s, anchor);
        update_later(s, innovation, used_variance, true);
    }
    return scale > REAL(0.0);
}

/* Move whole ticks of an offset state into ``offset_ticks``. */
INTERNAL void carry_ticks(State *s, int32_t anchor) {
    int32_t offset = s->layout.offset + anchor;
    int64_t steps = floor_real(s->x[offset] / TICK_M);
    s->anchors[anchor].offset_ticks += steps;
    s->x[offset] -= (real)steps * TICK_M;
}

/* End an obstruction, or a fault that existed since the anchor joined. Returns what its innovation grows by. */
INTERNAL real end_obstruction(State *s, int32_t anchor) {
    Anchor *a = &s->anchors[anchor];
    real before_m = h_dot_x(s, 0);
    if (a->is_obstructed) {
        reset_state(s, s->layout.change + anchor, clear_variance(s, anchor));
    } else {
        end_lasting_fault(s, anchor);
    }
    a->is_obstructed = false;
    a->outliers_in_row = 0;
    return before_m - h_dot_x(s, 0);
}

/* Handle a jump of an anchor's range error: back to the value before an obstruction, or to a new one.
 *
 * Obstacles make packets late. So an early jump of an anchor not known to be obstructed ends an obstruction that
 * existed since it joined, and all its earlier receptions are reconsidered.
 *
 * Returns the remaining innovation. If that is earlier than antennas explain and packets are often late, the range
 * error is not opened: the first packet, which initialised the anchor's clock, was late. */
INTERNAL real jump(State *s, int32_t anchor, real innovation, real rx_variance) {
    if (innovation < REAL(0.0)) {
        innovation += end_obstruction(s, anchor);
        if (innovation * innovation <= square(s->settings.gate) * (compute_ph(s) + rx_variance)) {
            return innovation;
        }
    }
    if (innovation > -s->tuning.lasting_std_m || !is_late_often(s)) {
        open_range_error(s, anchor, innovation);
    }
    return innovation;
}

/* Initialise an anchor's clock: the limit of an update of an unknown offset.
 *
 * The offset then contains all errors of position and range. Its rate follows (``find_rate``). If packets are often
 * late, the variance covers that this one may be. */
INTERNAL void first_reception(State *s, int32_t anchor, int64_t rx_ticks, int64_t tx_ticks, real variance_factor) {
    EstimatorSettings *settings = &s->settings;
    Layout *where = &s->layout;
    Anchor *a = &s->anchors[anchor];
    int32_t offset = where->offset + anchor;
    int32_t noise = where->tx_noise + anchor;
    reset_state(s, noise, settings->tx_variance_m2);
    reset_state(s, where->rate + anchor, REAL(0.0));
    a->mesh.is_known = false;
    a->own.is_known = false;
    a->has_rate = false;
    reset_state(s, offset, REAL(0.0));
    s->terms = 0;
    real range_m = add_direction(s, anchor, REAL(1.0));
    add_term(s, noise, REAL(1.0));
    add_range_errors(s, anchor, REAL(1.0));
    real variance = settings->rx_variance_m2;
    real curvature_m = find_curvature_m(s, range_m, variance);
    variance = variance * variance_factor + REAL(2.0) * curvature_m * curvature_m + compute_ph(s);
    if (is_late_often(s)) {
        variance += square(s->tuning.late_std_m);
    }
    open_state(s, offset, anchor, variance);
    a->offset_ticks = rx_ticks - tx_ticks - floor_real(range_m / TICK_M);
    real rest_m = (real)(rx_ticks - tx_ticks - a->offset_ticks) * TICK_M;
    s->x[offset] = rest_m - range_m - curvature_m - h_dot_x(s, direction_terms(s));
    a->has_tx_noise = true;
    a->range_m = range_m;
    a->noise_ticks = s->status.epoch_ticks;
}

/* Initialise the covariance of a state from a measurement: the limit of an update of an unknown state.
 *
 * The state then contains all errors of the measurement, of this variance. ``h`` holds every term but this state,
 * which has been reset; their P·h is the first of ``U``. ``own``: the anchor if the tag received it, or −1. */
INTERNAL void open_state(State *s, int32_t state, int32_t own, real variance) {
    compute_fault_input(s, own);
    for (int32_t other = 0, other_end = s->n; other < other_end; other++) {
        set_covariance(s, state, other, REAL(0.0) - s->U[0][other]);
    }
    s->P[at(state, state)] = variance;
    for (int32_t fault = 0, fault_end = s->rows; fault < fault_end; fault++) {
        s->V[state][fault] = s->G[0][fault];
    }
}

/* Initialise the rate of an anchor's clock from the first measurement of its offset after its first packet.
 *
 * The limit of an update of an unknown rate, in which the offset takes the whole innovation. With a large variance of
 * the rate in P instead, the result would be a difference of large numbers. The measurement's P·h and fault inputs are
 * the first of ``U`` and ``G``. */
INTERNAL void find_rate(State *s, int32_t anchor, real innovation, real innovation_variance, real elapsed_s) {
    int32_t offset = s->layout.offset + anchor;
    int32_t rate = s->layout.rate + anchor;
    real *opened = s->U[0];
    update(s, REAL(0.0), innovation_variance, REAL(1.0));
    for (int32_t state = 0, state_end = s->n; state < state_end; state++) {
        opened[state] = -opened[state];
    }
    opened[offset] += SQRT(innovation_variance);
    opened[rate] += SQRT(innovation_variance) / elapsed_s;
    open_direction(s, REAL(1.0), s->rows);
    s->x[offset] += innovation;
    s->x[rate] += innovation / elapsed_s;
    s->anchors[anchor].has_rate = true;
}

/* An anchor received another */

/* Write an anchor's reception of another anchor, ``age_s`` ago, into ``h``. */
INTERNAL void relay_terms(State *s, int32_t listener, int32_t sender, real age_s, bool has_tx_noise) {
    Layout *where = &s->layout;
    s->terms = 0;
    add_term(s, where->offset + sender, REAL(1.0));
    add_term(s, where->offset + listener, -REAL(1.0));
    add_term(s, where->rate + sender, -age_s);
    add_term(s, where->rate + listener, age_s);
    if (has_tx_noise) {
        add_term(s, where->tx_noise + sender, REAL(1.0));
    }
}

/* Variance of a relay: its RX stamp and the noise of two oscillators since. */
INTERNAL real relay_variance(State *s, int32_t listener, int32_t sender, real age_s) {
    EstimatorSettings *settings = &s->settings;
    real walk = settings->walk * max_real(s->anchors[listener].walk_scale, s->anchors[sender].walk_scale);
    if (has_order(s)) {
        return settings->rx_variance_m2 + noise_since(s, listener, age_s) + noise_since(s, sender, age_s);
    }
    return settings->rx_variance_m2 + REAL(2.0) * age_s * (settings->white + walk * age_s * age_s / REAL(3.0));
}

/* Variance of an anchor's clock by its noise that P contains of this time. */
INTERNAL real noise_since(State *s, int32_t anchor, real age_s) {
    real since_s = max_real(age_s - (real)(s->status.epoch_ticks - s->anchors[anchor].noise_ticks) * TICK_S, REAL(0.0));
    real walk = s->settings.walk * s->anchors[anchor].walk_scale;
    return since_s * (s->settings.white + walk * since_s * since_s / REAL(3.0));
}

/* Time since an anchor received a packet that the tag received too. */
INTERNAL real relay_age_s(State *s, int32_t listener, int32_t sender, int64_t packet_rx_ticks) {
    real flown_m = s->anchors[sender].range_m - find_distance_m(s, listener, sender);
    return (real)(s->status.epoch_ticks - packet_rx_ticks) * TICK_S + flown_m / SPEED_OF_LIGHT_MPS;
}

/* Process the reception, by ``listener``, of a packet of ``sender`` that the tag received too. True if used.
 *
 * S − T = |aᵢ − aⱼ| + bⱼ − bᵢ + wⱼ + constant of the pair + noise, when the packet reached anchor i. Both offsets are
 * extrapolated back to that moment by their rates; the noise of their oscillators since then is added. The pair's
 * constant, which contains the survey error, is estimated outside the filter: both directions of a pair contain it
 * with the same sign and the offsets with opposite signs, so neither depends on the other. */
INTERNAL bool relay(State *s, int32_t listener, int32_t sender, int64_t tx_ticks, int64_t packet_rx_ticks, int64_t
        rx_ticks) {
    Tuning *tuning = &s->tuning;
    EstimatorSettings *settings = &s->settings;
    Status *status = &s->status;
    Anchor *i = &s->anchors[listener];
    Anchor *j = &s->anchors[sender];
    Link *link = pair(s, listener, sender);
    real distance_m = find_distance_m(s, listener, sender);
    real age_s = (real)(status->epoch_ticks - packet_rx_ticks) * TICK_S + (j->range_m - distance_m) /
            SPEED_OF_LIGHT_MPS;
    bool has_tx_noise = j->tx_ticks == tx_ticks && j->has_tx_noise;
    relay_terms(s, listener, sender, age_s, has_tx_noise);
    real variance = relay_variance(s, listener, sender, age_s);
    if (!has_tx_noise) {
        variance += settings->tx_variance_m2;
    }
    int64_t whole = j->offset_ticks - i->offset_ticks;
    real innovation = (real)(rx_ticks - tx_ticks - whole) * TICK_M - distance_m - link->constant_m - h_dot_x(s, 0);
    real innovation_variance = compute_ph(s) + variance + link->variance_m2;
    real normalised = innovation / SQRT(innovation_variance);
    if (is_warm(s)) {
        real clipped = min_real(max_real(normalised, -settings->gate), settings->gate);
        adapt_clock_noise(s, sender, clipped);
        adapt_clock_noise(s, listener, -clipped);
    }
    j->is_relayed = true;
    Link *forth = &s->links[listener][sender];
    Link *back = &s->links[sender][listener];
    if (!(-settings->gate <= normalised && normalised <= settings->gate)) {
        status->relays_rejected += 1;
        status->relays_lately_rejected += REAL(1.0);
        link->outliers_in_row += 1;
        if ((real)link->outliers_in_row >= tuning->relays_in_row) {
            link->outliers_in_row = 0;
            link->variance_m2 += square(tuning->max_change_std_m);
            back->relays = 0;
            forth->relays = 0;
        }
        return false;
    }
    status->relays_used += 1;
    status->relays_lately_accepted += REAL(1.0);
    link->outliers_in_row = 0;
    real share = link->variance_m2 / innovation_variance;
    link->constant_m += share * innovation;
    link->variance_m2 -= share * link->variance_m2;
    use(s, innovation, innovation_variance);
    forth->relays += 1;
    if ((real)forth->relays == tuning->pair_relays && (real)back->relays >= tuning->pair_relays) {
        survey_pair(s, listener, sender);
    }
    return true;
}

/* The link of two anchors, kept in the row of the lower index. */
INTERNAL Link *pair(State *s, int32_t one, int32_t other) {
    return &s->links[min_32(one, other)][max_32(one, other)];
}

/* Distance between two anchors in the almanac. */
INTERNAL real find_distance_m(State *s, int32_t one, int32_t other) {
    real squared = REAL(0.0);
    for (int32_t axis = 0; axis < AXES; axis++) {
        squared += square(s->anchors[one].position_m[axis] - s->anchors[other].position_m[axis]);
    }
    return SQRT(squared);
}

/* Queue an update, and its evidence of faults, by the measurement in ``h``, which is no reception of the tag's. */
INTERNAL void use(State *s, real innovation, real innovation_variance) {
    compute_fault_input(s, -1);
    update_later(s, innovation, innovation_variance, true);
}

/* Use the measured range between two anchors for their survey; an anchor that contradicts most is misplaced. */
INTERNAL void survey_pair(State *s, int32_t one, int32_t other) {
    pair_range(s, one, other);
    int32_t contradicted = 0;
    int32_t rival = 0;
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        contradicted += (int32_t)pair(s, one, anchor)->contradicts;
        rival += (int32_t)pair(s, other, anchor)->contradicts;
    }
    int32_t most = max_32(contradicted, rival);
    if (contradicted == rival || (real)most < s->tuning.misplaced_pairs || !pair(s, one, other)->contradicts) {
        return;
    }
    finish_updates(s);
    int32_t misplaced = contradicted > rival ? one : other;
    Anchor *a = &s->anchors[misplaced];
    int32_t survey = s->layout.survey + s->dim * misplaced;
    make_uncertain(s, ALL_RANGE_ERRORS);
    if (a->is_obstructed) {  /* what seemed to be an obstacle */
        reset_state(s, s->layout.change + misplaced, clear_variance(s, misplaced));
        a->is_obstructed = false;
    }
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        s->P[at(survey + axis, survey + axis)] += square(s->tuning.lasting_std_m);
    }
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        if (pair(s, misplaced, anchor)->contradicts) {
            pair_range(s, misplaced, anchor);
        }
    }
}

/* Process |a + δa − a' − δa'| + constant as two anchors measured it, unless it contradicts the survey. */
INTERNAL void pair_range(State *s, int32_t one, int32_t other) {
    Link *link = pair(s, one, other);
    s->terms = 0;
    add_pair_survey(s, one, other);
    real innovation = link->constant_m - h_dot_x(s, 0);
    real innovation_variance = compute_ph(s) + square(s->settings.pair_std_m) + link->variance_m2;
    link->contradicts = innovation * innovation > square(s->tuning.suspect) * innovation_variance;
    if (!link->contradicts) {
        use(s, innovation, innovation_variance);
    }
}

/* Add the effect of survey errors on the distance of two anchors. */
INTERNAL void add_pair_survey(State *s, int32_t one, int32_t other) {
    Anchor *a = &s->anchors[one];
    Anchor *b = &s->anchors[other];
    real distance_m = find_distance_m(s, one, other);
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        real towards = (a->position_m[axis] - b->position_m[axis]) / distance_m;
        add_term(s, s->layout.survey + s->dim * one + axis, towards);
        add_term(s, s->layout.survey + s->dim * other + axis, -towards);
    }
}

/* An anchor's report of its clock against the master's */

/* Replace the filter's estimate of an anchor's clock against the master's by the anchor's own, if that is better.
 *
 * The anchor has received all packets of the master that were relayed to the tag, and more. Its error is therefore
 * uncorrelated with the difference of the two estimates, which has the variance P − q (P: the filter's, q: the
 * anchor's), and the other states change by P_xd/P times that difference. ``subticks``: the anchor's reading minus the
 * master's at the packet's TX stamp, modulo 2⁴⁸. */
INTERNAL void report(State *s, int32_t anchor, int32_t master, int64_t subticks, real variance_m2) {
    Anchor *a = &s->anchors[anchor];
    Status *status = &s->status;
    finish_updates(s);
    relay_terms(s, anchor, master, a->range_m / SPEED_OF_LIGHT_MPS, false);
    real own_variance = REAL(0.0);
    for (int32_t one = 0, one_end = s->terms; one < one_end; one++) {
        for (int32_t other = 0, other_end = s->terms; other < other_end; other++) {
            own_variance += s->h[one] * s->h[other] * s->P[at(s->h_index[one], s->h_index[other])];
        }
    }
    int64_t whole = (s->anchors[master].offset_ticks - a->offset_ticks) & TICK_MASK;
    int64_t off = (subticks - SUBTICKS * whole) & SUBTICK_MASK;
    if (off > floor_div_64(SUBTICK_MASK, 2)) {
        off -= SUBTICK_MASK + 1;
    }
    real innovation = (real)off * (TICK_M / (real)SUBTICKS) - h_dot_x(s, 0);
    if (!s->anchors[master].has_rate) {
        real elapsed_s = (real)(status->epoch_ticks - s->anchors[master].rx_ticks) * TICK_S;
        real innovation_variance = compute_ph(s) + variance_m2;
        compute_fault_input(s, -1);
        if (elapsed_s > SHORTEST_S) {
            find_rate(s, master, innovation, innovation_variance, elapsed_s);
            status->reports_used += 1;
        }
        return;
    }
    real wandering = max_real(a->walk_scale, s->anchors[master].walk_scale);
    if (own_variance <= variance_m2 || wandering > s->tuning.steady_walk_scale) {
        return;  /* the anchor's own filter has a fixed process noise: it lags behind clocks that wander more */
    }
    if (innovation * innovation > square(s->settings.gate) * (own_variance + variance_m2)) {
        status->reports_rejected += 1;
        return;
    }
    status->reports_used += 1;
    compute_ph(s);
    compute_fault_input(s, -1);
    /* K = P_xd/P for x and V; for the covariance the factor is (P − q)/P², that of an S of P²/(P − q) */
    real whole_s = own_variance * own_variance / (own_variance - variance_m2);
    update(s, innovation, whole_s, whole_s / own_variance);
}

/* A ready-made time difference */

/* Write a difference of ranges, to anchor b minus to anchor a, into ``h``. Returns the difference.
 *
 * Its gradient is in the first terms, like the direction of the other kinds. */
INTERNAL real difference_terms(State *s, int32_t a, int32_t b) {
    s->terms = 0;
    real far_m = add_direction(s, b, REAL(1.0));
    int32_t near = s->terms;
    real near_m = add_direction(s, a, -REAL(1.0));
    s->anchors[b].range_m = far_m;
    s->anchors[a].range_m = near_m;
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        s->h[axis] += s->h[near + axis];
        s->h[near + axis] = REAL(0.0);
    }
    add_range_errors(s, b, REAL(1.0));
    add_range_errors(s, a, -REAL(1.0));
    return far_m - near_m;
}

/* Process a ready-made difference of ranges, to anchor b minus to anchor a: ``USED`` or ``UNUSED``.
 *
 * d = |p − b| − |p − a| + range errors of b − those of a + noise. No clocks are estimated, as the
 * difference contains none. */
INTERNAL int32_t difference(State *s, int32_t a, int32_t b, int64_t rx_ticks, real difference_m) {
    EstimatorSettings *settings = &s->settings;
    real walked_m = s->status.walked_m;
    real a_elapsed_s = s->anchors[a].packets > 0 ? (real)(rx_ticks - s->anchors[a].rx_ticks) * TICK_S : REAL(0.0);
    real b_elapsed_s = s->anchors[b].packets > 0 ? (real)(rx_ticks - s->anchors[b].rx_ticks) * TICK_S : REAL(0.0);
    relax_range_error(s, a, a_elapsed_s, walked_m - s->anchors[a].walked_m);
    relax_range_error(s, b, b_elapsed_s, walked_m - s->anchors[b].walked_m);
    real expected_m = difference_terms(s, a, b);
    real innovation = difference_m - expected_m - h_dot_x(s, 2 * direction_terms(s));
    real innovation_variance = compute_ph(s) + square(settings->difference_std_m);
    for (int32_t far = 0; far < 2; far++) {
        int32_t anchor = far == 1 ? b : a;
        if (judge_end(s, anchor, REAL(2.0) * (real)far - REAL(1.0), innovation, innovation_variance)) {
            innovation += end_obstruction(s, anchor);
            innovation_variance = compute_ph(s) + square(settings->difference_std_m);
        }
    }
    note_innovation(s, innovation, innovation_variance, true);
    real normalised = innovation / SQRT(innovation_variance);
    real scale = variance_scale(s, normalised, true);
    if (scale == REAL(0.0)) {
        return UNUSED;
    }
    if (is_warm(s)) {
        adapt_process_noise(s, normalised / scale);
    }
    compute_fault_input(s, b);
    subtract_fault_input(s, a);
    update_later(s, innovation, innovation_variance * scale, true);
    finish_updates(s);
    bound_changes(s);
    adapt_change_noise(s, a, -normalised);
    adapt_change_noise(s, b, normalised);
    adapt_change_variance(s, a, a_elapsed_s);
    adapt_change_variance(s, b, b_elapsed_s);
    return USED;
}

/* Raise changing parts below their bound to it: the likeliest state if nothing can be earlier. */
INTERNAL void bound_changes(State *s) {
    for (int32_t change = s->layout.change, change_end = s->layout.constant; change < change_end; change++) {
        real missing_m = s->settings.earliest_m - s->x[change];
        if (missing_m > REAL(0.0)) {
            for (int32_t state = 0, state_end = s->n; state < state_end; state++) {
                s->x[state] += s->P[at(change, state)] / s->P[at(change, change)] * missing_m;
            }
        }
    }
}

/* The tag has a sensor of its height */

/* Process the reading of a height sensor: ``USED`` or ``UNUSED``.
 *
 * A given height is corrected by it. A barometer's zero is estimated too, from its first reading on. */
INTERNAL int32_t height(State *s, real height_m, real std_m, bool is_barometer) {
    EstimatorSettings *settings = &s->settings;
    Status *status = &s->status;
    Layout *where = &s->layout;
    real innovation = height_m - s->x[where->height];
    if (s->dim == 2) {
        innovation -= settings->height_m;
    }
    s->terms = 0;
    add_term(s, where->height, REAL(1.0));
    if (is_barometer) {
        int32_t zero = where->zero;
        if (s->P[at(zero, zero)] == REAL(0.0)) {
            s->x[zero] = innovation;
            make_uncertain(s, ALL_RANGE_ERRORS);
            s->P[at(zero, zero)] = s->tuning.zero_variance_m2;
        } else {
            s->P[at(zero, zero)] += settings->barometer_walk * ((real)(status->epoch_ticks - status->height_ticks) *
                    TICK_S);
        }
        innovation -= s->x[zero];
        add_term(s, zero, REAL(1.0));
    }
    real innovation_variance = compute_ph(s) + square(std_m);
    if (innovation * innovation > square(settings->gate) * innovation_variance) {
        return UNUSED;
    }
    use(s, innovation, innovation_variance);
    finish_updates(s);
    status->height_ticks = status->epoch_ticks;
    return USED;
}

/* The tag stands still */

/* Process a velocity of zero for a stationary tag, axis by axis. */
INTERNAL void zero_velocity(State *s) {
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        int32_t speed = s->layout.velocity + axis;
        s->terms = 0;
        add_term(s, speed, REAL(1.0));
        real variance = compute_ph(s) + square(s->tuning.stationary_std_mps);
        compute_fault_input(s, -1);
        update(s, -s->x[speed], variance, REAL(1.0));
    }
}

/* A motion sensor as an input of the time update: gyroscope and accelerometer carried by the tag.
 *
 * The gyroscope turns the accelerometer's specific force into a level frame, whose heading against the site is unknown and
 * drifts. The integrals of the force since the newest packet, V for velocity and S for position, move the state:
 *
 *     v ← v + c·V + d·t        p ← p + c·S + d·t²/2
 *
 * with c = cos ψ + i·sin ψ, x + i·y for vectors, and d for bias and tilt. Both are states, in which all of it is linear:
 * c begins as 0 ± 0.7, where the sensor has no effect, and finds the heading from the first metres of motion without a
 * search. What is known of c and d then moves into the attitude, and what returns of them into the gyroscope's bias. */

/* Samples */

/* Process a speed along x at a tag time, and a rate if no gyroscope gives one. Returns False if it is late. */
SKYLESS_EXPORT bool skyless_hear_wheels(State *s, int64_t ticks, real *rate_rps, real speed_mps) {
    Motion *m = &s->motion;
    if (m->speeds > 0 && (-s->tuning.longest_silence_s < (real)(ticks - m->speed_ticks) * TICK_S && (real)(ticks -
            m->speed_ticks) * TICK_S <= REAL(0.0))) {
        m->late += 1;
        return false;
    }
    m->speeds += 1;
    m->speed_ticks = ticks;
    m->speed_mps = speed_mps;
    if (abs_real(speed_mps) > s->tuning.speed_std_mps) {
        m->rest_s = REAL(0.0);
    }
    if (m->has_force && (real)abs_64(ticks - m->ticks) * TICK_S <= s->tuning.longest_gap_s) {
        return true;
    }
    m->up_mps2[0] = REAL(0.0);
    m->up_mps2[1] = REAL(0.0);
    m->up_mps2[2] = GRAVITY_MPS2;
    bool is_used = skyless_hear_motion(s, ticks, rate_rps, m->up_mps2);
    m->has_force = false;
    return is_used;
}

/* Process a sample of rate and specific force at a tag time. Returns False if it is late.
 *
 * After a gap or a shock, or on another scale of time, level and heading are looked for again. */
SKYLESS_EXPORT bool skyless_hear_motion(State *s, int64_t ticks, real *rate_rps, real *force_mps2) {
    Motion *m = &s->motion;
    Tuning *tuning = &s->tuning;
    real dt = (real)(ticks - m->ticks) * TICK_S;
    m->has_force = true;
    if (m->samples > 0 && (-tuning->longest_silence_s < dt && dt <= REAL(0.0))) {
        m->late += 1;
        return false;
    }
    real pushed = REAL(0.0);
    real turning = REAL(0.0);
    for (int32_t axis = 0; axis < AXES; axis++) {
        pushed += square(force_mps2[axis]);
        turning += square(rate_rps[axis]);
    }
    bool is_shocked = pushed > square(tuning->shock_mps2) || turning > square(tuning->shock_rps);
    if (m->samples == 0 || !(REAL(0.0) < dt && dt <= tuning->longest_gap_s) || is_shocked) {
        if (m->samples > 0) {
            m->gaps += 1;
        }
        m->is_level = false;
        m->level_s = REAL(0.0);
        dt = REAL(0.0);
        for (int32_t one = 0; one < 4; one++) {
            m->attitude[one] = one == 0 ? REAL(1.0) : REAL(0.0);
        }
        for (int32_t axis = 0; axis < AXES; axis++) {
            m->mean_mps2[axis] = REAL(0.0);
        }
    }
    m->samples += 1;
    m->ticks = ticks;
    step(m, rate_rps, force_mps2, dt);
    if (m->is_level) {
        rest(s, rate_rps, dt);
    } else {
        find_level(s, dt);
    }
    for (int32_t axis = 0; axis < AXES; axis++) {
        m->rate_rps[axis] = rate_rps[axis];
    }
    return true;
}

/* Average the specific force, which on average points upwards, and turn it to z at the end.
 *
 * Until then the attitude is against the first sample's. */
INTERNAL void find_level(State *s, real dt) {
    Motion *m = &s->motion;
    real *f = s->motion.mean_mps2;
    real *q = s->motion.attitude;
    for (int32_t axis = 0; axis < AXES; axis++) {
        f[axis] += m->force_mps2[axis] * dt;
    }
    m->level_s += dt;
    real length = SQRT(square(f[0]) + square(f[1]) + square(f[2]));
    if (m->level_s < s->tuning.level_s || length == REAL(0.0)) {
        return;
    }
    /* a half turn about the sum of the two directions swaps them; upside down any horizontal axis is right */
    real w = length + f[2];
    real x = f[1];
    real y = -f[0];
    if (w < REAL(1e-06) * length) {
        w = REAL(0.0);
        x = REAL(1.0);
        y = REAL(0.0);
    }
    real norm = SQRT(square(w) + square(x) + square(y));
    w = w / norm;
    x = x / norm;
    y = y / norm;
    m->level[0] = w;
    m->level[1] = x;
    m->level[2] = y;
    m->level[3] = REAL(0.0);
    multiply(q, w, x, y, REAL(0.0), q[0], q[1], q[2], q[3]);
    turned(m->force_mps2, m->level, m->force_mps2);
    for (int32_t axis = 0; axis < AXES; axis++) {
        m->mean_mps2[axis] = axis == 2 ? GRAVITY_MPS2 : REAL(0.0);
        m->velocity_mps[axis] = REAL(0.0);
        m->position_m[axis] = REAL(0.0);
    }
    m->is_level = true;
    m->rest_s = REAL(0.0);
    m->used_ticks = NEVER;
    if (m->has_states) {
        expect_motion(s);
    }
}

/* Integrate a sample over the time since the one before, by the mean rate and the mean force of both. */
INTERNAL void step(Motion *m, real *rate_rps, real *force_mps2, real dt) {
    real *q = m->attitude;
    real *b = m->bias_rps;
    real half = REAL(0.5) * dt;
    real x = REAL(0.5) * (rate_rps[0] + m->rate_rps[0]) - b[0];
    real y = REAL(0.5) * (rate_rps[1] + m->rate_rps[1]) - b[1];
    real z = REAL(0.5) * (rate_rps[2] + m->rate_rps[2]) - b[2];
    x = x * half;
    y = y * half;
    z = z * half;
    real angle2 = square(x) + square(y) + square(z);
    real w = REAL(1.0) - REAL(0.5) * angle2;
    real scale = REAL(1.0) - angle2 / REAL(6.0);
    multiply(q, q[0], q[1], q[2], q[3], w, scale * x, scale * y, scale * z);
    x = m->force_mps2[0];
    y = m->force_mps2[1];
    z = m->force_mps2[2];
    turned(m->force_mps2, q, force_mps2);
    push(m, 0, REAL(0.5) * (x + m->force_mps2[0]), dt);
    push(m, 1, REAL(0.5) * (y + m->force_mps2[1]), dt);
    push(m, 2, REAL(0.5) * (z + m->force_mps2[2]) - GRAVITY_MPS2, dt);
}

/* Advance the path along an axis with constant acceleration. */
INTERNAL void push(Motion *m, int32_t axis, real acceleration_mps2, real dt) {
    m->position_m[axis] += dt * (m->velocity_mps[axis] + REAL(0.5) * dt * acceleration_mps2);
    m->velocity_mps[axis] += dt * acceleration_mps2;
}

/* Write the product of the quaternions (a, b, c, d) and (w, x, y, z), of unit length. */
INTERNAL void multiply(real *to, real a, real b, real c, real d, real w, real x, real y, real z) {
    to[0] = a * w - b * x - c * y - d * z;
    to[1] = a * x + b * w + c * z - d * y;
    to[2] = a * y - b * z + c * w + d * x;
    to[3] = a * z + b * y - c * x + d * w;
    real norm = SQRT(square(to[0]) + square(to[1]) + square(to[2]) + square(to[3]));
    if (norm > REAL(0.0)) {
        for (int32_t one = 0; one < 4; one++) {
            to[one] /= norm;
        }
    }
}

/* Update the time since the sensor last showed motion, and at rest level and gyroscope's bias. */
INTERNAL void rest(State *s, real *rate_rps, real dt) {
    Motion *m = &s->motion;
    Tuning *tuning = &s->tuning;
    real turning = REAL(0.0);
    real pushed = REAL(0.0);
    for (int32_t axis = 0; axis < AXES; axis++) {
        real change = m->force_mps2[axis] - m->mean_mps2[axis];
        turning += square(rate_rps[axis]);
        pushed += square(change);
        m->mean_mps2[axis] += min_real(dt / tuning->level_s, REAL(1.0)) * change;
    }
    m->rest_s += dt;
    if (turning > square(tuning->rest_rps) || pushed > square(tuning->rest_mps2)) {
        m->rest_s = REAL(0.0);
    }
    if (m->rest_s > tuning->level_s && speed_squared(s) < square(tuning->rest_mps)) {
        for (int32_t axis = 0; axis < AXES; axis++) {
            m->bias_rps[axis] += dt / tuning->tilt_s * (rate_rps[axis] - m->bias_rps[axis]);
        }
        real share = dt / (tuning->tilt_s * GRAVITY_MPS2);
        tilt(s, share * m->mean_mps2[1], -share * m->mean_mps2[0]);
    } else if (m->has_force && !(m->has_states && is_heading_known(s))) {
        /* over a while even a tag in motion is on average not accelerated; later the positions show its level */
        real share = dt / (tuning->slow_tilt_s * GRAVITY_MPS2);
        real x = share * m->mean_mps2[1];
        real y = -share * m->mean_mps2[0];
        tilt(s, x, y);
        learn_bias(s, x, y, REAL(0.0));
    }
}

/* Let a turn of the level frame, which the gyroscope's bias has made necessary, reduce that bias. */
INTERNAL void learn_bias(State *s, real x, real y, real z) {
    Motion *m = &s->motion;
    m->shown_m[0] = x;
    m->shown_m[1] = y;
    m->shown_m[2] = z;
    turned_back(m->shown_mps, m->attitude, m->shown_m);
    for (int32_t axis = 0; axis < AXES; axis++) {
        m->bias_rps[axis] -= m->shown_mps[axis] / s->tuning.bias_s;
    }
}

/* Turn the level frame by small angles about x and y; the acceleration's error becomes what is left of it. */
INTERNAL void tilt(State *s, real x, real y) {
    Motion *m = &s->motion;
    real *q = s->motion.attitude;
    Layout *where = &s->layout;
    multiply(q, REAL(1.0), REAL(0.5) * x, REAL(0.5) * y, REAL(0.0), q[0], q[1], q[2], q[3]);
    tilt_vector(m->force_mps2, x, y);
    tilt_vector(m->mean_mps2, x, y);
    if (m->has_states) {
        real cos = s->x[where->heading];
        real sin = s->x[where->heading + 1];
        real across = y * GRAVITY_MPS2;
        real along = -x * GRAVITY_MPS2;
        s->x[where->acceleration] -= cos * across - sin * along;
        s->x[where->acceleration + 1] -= cos * along + sin * across;
    }
}

/* Turn a vector by small angles about x and y. */
INTERNAL void tilt_vector(real *vector, real x, real y) {
    real a = vector[0];
    real b = vector[1];
    real c = vector[2];
    vector[0] = a + y * c;
    vector[1] = b - x * c;
    vector[2] = c + x * b - y * a;
}

/* Write a vector of the level frame in the sensor's. */
INTERNAL void turned_back(real *to, real *attitude, real *vector) {
    attitude[0] = -attitude[0];
    turned(to, attitude, vector);
    attitude[0] = -attitude[0];
}

/* Write a vector of the sensor's frame in the level frame: v + 2·w·(u×v) + 2·u×(u×v) of the quaternion (w, u). */
INTERNAL void turned(real *to, real *attitude, real *vector) {
    real w = attitude[0];
    real x = attitude[1];
    real y = attitude[2];
    real z = attitude[3];
    real a = REAL(2.0) * (y * vector[2] - z * vector[1]);
    real b = REAL(2.0) * (z * vector[0] - x * vector[2]);
    real c = REAL(2.0) * (x * vector[1] - y * vector[0]);
    real d = vector[0] + w * a + y * c - z * b;
    real e = vector[1] + w * b + z * a - x * c;
    real f = vector[2] + w * c + x * b - y * a;
    to[0] = d;
    to[1] = e;
    to[2] = f;
}

/* Time update */

/* Before ``predict``: see whether the sensor shows the time up to then. */
INTERNAL void look_at_sensor(State *s, int64_t rx_ticks) {
    Motion *m = &s->motion;
    Tuning *tuning = &s->tuning;
    real ahead_s = (real)(rx_ticks - m->ticks) * TICK_S;
    bool is_ignored = 0 < m->ignored_ticks - rx_ticks && (real)(m->ignored_ticks - rx_ticks) < tuning->ignored_s *
            TICK_RATE_HZ;
    m->has_effect = m->is_level && !is_ignored && abs_real(ahead_s) <= tuning->longest_gap_s;
    m->is_used = m->has_effect && m->has_force && m->used_ticks == s->status.epoch_ticks && ahead_s <
            tuning->short_gap_s;
}

/* Add to ``predict`` what the sensor shows of the time since the newest packet before. */
INTERNAL void move(State *s, int64_t rx_ticks) {
    Motion *m = &s->motion;
    Tuning *tuning = &s->tuning;
    if (!m->has_effect) {
        m->used_ticks = NEVER;
        return;
    }
    use_motion(s);
    find_antenna(m);
    real ahead = (real)(rx_ticks - m->ticks) * TICK_S;
    real dt = m->used_ticks == NEVER ? REAL(0.0) : (real)(rx_ticks - m->used_ticks) * TICK_S;
    for (int32_t axis = 0; axis < AXES; axis++) {
        real a = m->force_mps2[axis] - (axis == 2 ? GRAVITY_MPS2 : REAL(0.0));
        m->shown_m[axis] = m->position_m[axis] + m->arm_m[axis] + ahead * (m->velocity_mps[axis] + REAL(0.5) * ahead *
                a);
        m->shown_mps[axis] = m->velocity_mps[axis] + m->arm_mps[axis] + ahead * a;
    }
    for (int32_t axis = 0; axis < AXES; axis++) {  /* the path begins again with the antenna's position and velocity at this packet */
        m->velocity_mps[axis] -= m->shown_mps[axis];
        m->position_m[axis] -= m->shown_m[axis] - ahead * m->shown_mps[axis];
    }
    m->used_ticks = rx_ticks;
    if (dt > REAL(0.0)) {
        check_agreement(s, dt);
        if (m->has_force) {
            add_path(s, dt);
        }
        add_drift(s, dt);
        settle_heading(s, dt);
        if (m->speeds > 0 && (real)abs_64(rx_ticks - m->speed_ticks) * TICK_S <= tuning->longest_gap_s) {
            measure_speed(s, dt);
        }
    }
}

/* Ignore a sensor for a while if innovations call for much process noise; its heading is then unknown again. */
INTERNAL void check_agreement(State *s, real dt) {
    Motion *m = &s->motion;
    Tuning *tuning = &s->tuning;
    bool is_wrong = s->status.q_scale > tuning->wrong_scale || m->speed_nis > tuning->wrong_speed_nis;
    m->wrong_s = is_wrong ? m->wrong_s + dt : max_real(m->wrong_s - dt, REAL(0.0));
    if (m->wrong_s > tuning->wrong_s) {
        m->speed_nis = REAL(0.0);
        m->wrong_s = REAL(0.0);
        m->contradictions += 1;
        m->ignored_ticks = m->used_ticks + floor_real(tuning->ignored_s * TICK_RATE_HZ);
        expect_motion(s);
    }
}

/* Write position and velocity of the antenna against the sensor, in the level frame. */
INTERNAL void find_antenna(Motion *m) {
    real *rate = m->rate_rps;
    real *lever = m->lever_m;
    m->shown_m[0] = rate[1] * lever[2] - rate[2] * lever[1];
    m->shown_m[1] = rate[2] * lever[0] - rate[0] * lever[2];
    m->shown_m[2] = rate[0] * lever[1] - rate[1] * lever[0];
    turned(m->arm_mps, m->attitude, m->shown_m);
    turned(m->arm_m, m->attitude, lever);
}

/* Move position and velocity by the path in ``shown_m`` and ``shown_mps``, by way of heading and acceleration. */
INTERNAL void add_path(State *s, real dt) {
    add_to(s, 0, s->motion.shown_m, REAL(0.5) * dt * dt);
    add_to(s, s->layout.velocity, s->motion.shown_mps, dt);
}

/* Add the process noise of heading and acceleration. */
INTERNAL void add_drift(State *s, real dt) {
    Layout *where = &s->layout;
    Tuning *tuning = &s->tuning;
    bool is_slow = speed_squared(s) < square(tuning->rest_mps);
    real kept = exp_(-dt / tuning->heading_memory_s);
    for (int32_t state = where->heading, state_end = where->acceleration; state < state_end; state++) {
        s->P[at(state, state)] += square(tuning->heading_walk) * s->status.q_scale * dt;
        if (is_slow && !is_heading_known(s)) {  /* a sensor's errors at rest look like a heading without effect */
            decay(s, state, kept, square(tuning->heading_std));
        }
    }
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        real walk = square(tuning->acceleration_walk) * s->status.q_scale * dt * (axis == 2 ? tuning->vertical_share :
                REAL(1.0));
        s->P[at(where->acceleration + axis, where->acceleration + axis)] += walk;
    }
}

/* Add c·path to the horizontal states from ``first`` on, its third element to the vertical one, and the error d. */
INTERNAL void add_to(State *s, int32_t first, real *path, real of_acceleration) {
    int32_t error = s->layout.acceleration;
    add_motion(s, first, path[0], -path[1], error, of_acceleration);
    add_motion(s, first + 1, path[1], path[0], error + 1, of_acceleration);
    if (s->dim == AXES) {
        add_motion(s, first + 2, REAL(0.0), REAL(0.0), error + 2, of_acceleration);
        s->x[first + 2] += path[2];
    }
}

/* Add a·cos + b·sin + c·error to a state, with covariances and sensitivities. */
INTERNAL void add_motion(State *s, int32_t target, real a, real b, int32_t error, real c) {
    int32_t cos = s->layout.heading;
    int32_t sin = s->layout.heading + 1;
    s->x[target] += a * s->x[cos] + b * s->x[sin] + c * s->x[error];
    real both = a * s->P[at(target, cos)] + b * s->P[at(target, sin)] + c * s->P[at(target, error)];
    real own = a * a * s->P[at(cos, cos)] + b * b * s->P[at(sin, sin)] + c * c * s->P[at(error, error)];
    own += REAL(2.0) * (a * b * s->P[at(cos, sin)] + a * c * s->P[at(cos, error)] + b * c * s->P[at(sin, error)]);
    for (int32_t other = 0, other_end = s->used; other < other_end; other++) {
        if (other != target) {
            real added = a * s->P[at(cos, other)] + b * s->P[at(sin, other)] + c * s->P[at(error, other)];
            set_covariance(s, target, other, s->P[at(target, other)] + added);
        }
    }
    s->P[at(target, target)] += REAL(2.0) * both + own;
    for (int32_t fault = 0, fault_end = s->rows; fault < fault_end; fault++) {
        s->V[target][fault] += a * s->V[cos][fault] + b * s->V[sin][fault] + c * s->V[error][fault];
    }
}

/* Heading */

/* Whether the heading is roughly known, so that its vector is about as long as it should be. */
INTERNAL bool is_heading_known(State *s) {
    real length2 = square(s->x[s->layout.heading]) + square(s->x[s->layout.heading + 1]);
    return length2 > square(s->tuning.heading_std) && heading_variance(s) < s->tuning.known_heading_variance;
}

/* Variance of the heading [rad²]: of its vector across its direction, over its length. */
INTERNAL real heading_variance(State *s) {
    int32_t first = s->layout.heading;
    real cos = s->x[first];
    real sin = s->x[first + 1];
    real across = cos * cos * s->P[at(first + 1, first + 1)] + sin * sin * s->P[at(first, first)];
    return (across - REAL(2.0) * cos * sin * s->P[at(first, first + 1)]) / max_real(square(cos * cos + sin * sin),
            REAL(1e-12));
}

/* Standard deviation of the heading; negative until it is known to five degrees. */
INTERNAL real heading_std_rad(State *s) {
    if (!s->motion.has_effect || !is_heading_known(s)) {
        return -REAL(1.0);
    }
    real variance = heading_variance(s);
    return variance < s->tuning.sure_heading_variance ? SQRT(variance) : -REAL(1.0);
}

/* Fill the rows of a fix with the rotation from the sensor's frame to the site's, if its heading is known. */
INTERNAL void fill_orientation(State *s) {
    Motion *m = &s->motion;
    real *q = s->motion.attitude;
    real std_rad = heading_std_rad(s);
    for (int32_t row = ORIENTATION; row < PROTECTED_ROWS; row++) {
        for (int32_t axis = 0; axis < AXES; axis++) {
            s->fix[row][axis] = REAL(0.0);
        }
    }
    if (std_rad >= REAL(0.0)) {
        real cos = s->x[s->layout.heading];
        real sin = s->x[s->layout.heading + 1];
        real length = SQRT(square(cos) + square(sin));
        real half = SQRT(max_real(REAL(0.5) + REAL(0.5) * cos / length, REAL(1e-12)));
        multiply(m->level, half, REAL(0.0), REAL(0.0), REAL(0.5) * sin / (half * length), q[0], q[1], q[2], q[3]);
        for (int32_t one = 0; one < 4; one++) {
            int32_t row = ORIENTATION + floor_div_32(one, AXES);
            int32_t axis = floor_mod_32(one, AXES);
            s->fix[row][axis] = m->level[one];
        }
        s->fix[ORIENTATION + 1][1] = std_rad;
    }
}

/* Turn the level frame into the site's, once the heading is roughly known. */
INTERNAL void settle_heading(State *s, real dt) {
    if (!is_heading_known(s)) {
        return;
    }
    Motion *m = &s->motion;
    Tuning *tuning = &s->tuning;
    Layout *where = &s->layout;
    real *q = s->motion.attitude;
    int32_t cos = where->heading;
    int32_t sin = where->heading + 1;
    real share = min_real(dt / tuning->tilt_s, REAL(1.0));
    real length = SQRT(square(s->x[cos]) + square(s->x[sin]));
    /* what has been learnt of tilt and heading moves into the attitude, and what had to move into the bias */
    real c = s->x[cos];
    real d = s->x[sin];
    real x = -share * (c * s->x[where->acceleration + 1] - d * s->x[where->acceleration]) / GRAVITY_MPS2;
    real y = share * (c * s->x[where->acceleration] + d * s->x[where->acceleration + 1]) / GRAVITY_MPS2;
    if (m->has_force) {
        tilt(s, x, y);
    }
    if (c < REAL(0.5) * length) {  /* at once */
        share = REAL(1.0);
    }
    c = REAL(1.0) - share + share * c / length;
    d = share * d / length;
    length = SQRT(square(c) + square(d));
    c = c / length;
    d = d / length;
    turn_states(s, cos, sin, c, d);
    real half = SQRT(max_real(REAL(0.5) + REAL(0.5) * c, REAL(1e-12)));
    multiply(q, half, REAL(0.0), REAL(0.0), REAL(0.5) * d / half, q[0], q[1], q[2], q[3]);
    turn_vector(m->force_mps2, c, d);
    turn_vector(m->mean_mps2, c, d);
    if (share < REAL(1.0) && heading_variance(s) < tuning->sure_heading_variance) {
        learn_bias(s, x, y, d);
    }
}

/* Turn a vector about z. */
INTERNAL void turn_vector(real *vector, real cos, real sin) {
    real a = vector[0];
    real b = vector[1];
    vector[0] = cos * a - sin * b;
    vector[1] = sin * a + cos * b;
}

/* Turn two states back by an angle, with covariances and sensitivities. */
INTERNAL void turn_states(State *s, int32_t one, int32_t other, real cos, real sin) {
    real a = s->x[one];
    real b = s->x[other];
    s->x[one] = cos * a + sin * b;
    s->x[other] = cos * b - sin * a;
    for (int32_t fault = 0, fault_end = s->rows; fault < fault_end; fault++) {
        a = s->V[one][fault];
        b = s->V[other][fault];
        s->V[one][fault] = cos * a + sin * b;
        s->V[other][fault] = cos * b - sin * a;
    }
    real first = s->P[at(one, one)];
    real both = s->P[at(one, other)];
    real second = s->P[at(other, other)];
    for (int32_t state = 0, state_end = s->used; state < state_end; state++) {
        a = s->P[at(one, state)];
        b = s->P[at(other, state)];
        set_covariance(s, one, state, cos * a + sin * b);
        set_covariance(s, other, state, cos * b - sin * a);
    }
    s->P[at(one, one)] = cos * cos * first + REAL(2.0) * cos * sin * both + sin * sin * second;
    s->P[at(other, other)] = cos * cos * second - REAL(2.0) * cos * sin * both + sin * sin * first;
    set_covariance(s, one, other, (cos * cos - sin * sin) * both + cos * sin * (second - first));
}

/* Wheels */

/* Measure v − c·u as 0, with the velocity u of the antenna in the level frame that wheels and turning show.
 *
 * Their errors last, so that a second of speeds counts as one. */
INTERNAL void measure_speed(State *s, real dt) {
    Motion *m = &s->motion;
    Tuning *tuning = &s->tuning;
    int32_t cos = s->layout.heading;
    int32_t sin = s->layout.heading + 1;
    int32_t velocity = s->layout.velocity;
    m->shown_m[0] = m->speed_mps;
    m->shown_m[1] = REAL(0.0);
    m->shown_m[2] = REAL(0.0);
    turned(m->shown_mps, m->attitude, m->shown_m);
    real x = m->shown_mps[0] + m->arm_mps[0];
    real y = m->shown_mps[1] + m->arm_mps[1];
    real noise = (square(tuning->speed_std_mps) + square(tuning->speed_share * m->speed_mps)) * max_real(REAL(1.0) / dt,
            REAL(1.0));
    for (int32_t axis = 0; axis < 2; axis++) {
        real of_cos = x;
        real of_sin = -y;
        if (axis == 1) {
            of_cos = y;
            of_sin = x;
        }
        s->terms = 0;
        add_term(s, velocity + axis, REAL(1.0));
        add_term(s, cos, -of_cos);
        add_term(s, sin, -of_sin);
        real innovation = s->x[cos] * of_cos + s->x[sin] * of_sin - s->x[velocity + axis];
        real predicted = compute_ph(s);
        real nis = min_real(square(innovation) / (predicted + noise), MOST_NIS);
        m->speed_nis += min_real(dt, REAL(1.0)) * (nis - m->speed_nis);
        real variance = predicted + noise * s->status.q_scale;
        if (innovation * innovation < square(tuning->suspect) * variance) {
            compute_fault_input(s, -1);
            update(s, innovation, variance, REAL(1.0));
        }
    }
}

/* Carrier phase: 20 times as precise as a stamp, but known only modulo a wavelength.
 *
 *     R − X  =  |p − a| + b + ambiguity + noise                 (mod λ)      (the tag receives an anchor)
 *     S − X  =  |aᵢ − aⱼ| + bⱼ − bᵢ + γᵢ − γⱼ + constant + noise (mod λ)     (anchor i receives anchor j)
 *
 * X is the sender's counter when the frame leaves: the carrier starts at a phase given by the counter, so the noise of the
 * TX stamp is not in it. An ambiguity contains what is constant while both radios keep their supply, and the effect of
 * reflections, which changes as the tag walks. It is estimated as a real number: as the tag walks, directions to the
 * anchors turn, and ranges known to millimetres up to a constant determine the position. ``docs/maths.md`` section 6.7.
 *
 * A wrong cycle in fast motion looks consistent and drags the position by metres. So a phase is used only together with a
 * stamp that was used. If it is not predicted to a tenth of a wavelength, it is taken at each possible cycle
 * (``hypotheses``); if these are too many, or phases often wrong, its ambiguity starts again, without any information. */

/* Process the phase, in [0, 1), of a reception of the tag's whose stamp was used. It falls as stamps grow. */
INTERNAL void own_phase(State *s, int32_t anchor, real phase_cycles) {
    Status *status = &s->status;
    Tuning *tuning = &s->tuning;
    Anchor *a = &s->anchors[anchor];
    finish_updates(s);
    use_phases(s);
    if (!a->has_rate || !may_count(s)) {
        a->own.is_known = false;
        return;
    }
    int32_t ambiguity = s->layout.ambiguity + anchor;
    measure_way(s);
    learn_least_walk(s);
    if (a->own.is_known) {
        real wander = max_real(tuning->phase_wander * status->phase_variance_m2, s->settings.phase_wander);
        s->P[at(ambiguity, ambiguity)] += wander * (status->way_m - a->phase_way_m);
    }
    a->phase_way_m = status->way_m;
    follow_line(s);
    real expected_m = phase_terms(s, anchor);
    real cycles = -phase_cycles - whole_cycles(s, a->offset_ticks);
    real innovation = innovation_m(s, cycles, expected_m);
    real variance = status->phase_variance_m2;
    real predicted = max_real(compute_ph(s), REAL(0.0));  /* rounding may make it negative */
    compute_fault_input(s, -1);
    if (a->own.is_known && square(s->settings.gate) * (predicted + variance) < square(wavelength_m(s))) {
        count_wild(s, innovation, predicted + variance);
    }
    bool is_used = use_phase(s, ambiguity, &a->own, innovation, predicted, variance);
    if (is_used && predicted <= certain_m2(s) && s->hypotheses.count == 1) {
        learn_noise(s, square(innovation) - predicted);
    }
}

/* Process the phase of an anchor's reception of another one, whose stamp was used.
 *
 * The clock that phases show of an anchor differs from that of its stamps by γ, which its first pair determines. All
 * other pairs have constants, which are estimated outside the filter. */
INTERNAL void relay_phase(State *s, int32_t listener, int32_t sender, int64_t packet_rx_ticks, real phase_cycles) {
    Anchor *i = &s->anchors[listener];
    Anchor *j = &s->anchors[sender];
    Link *link = &s->links[listener][sender];
    int32_t mesh = s->layout.mesh;
    if (!j->has_rate || !agree(s) || !has_mesh(s, sender)) {
        return;
    }
    real age_s = relay_age_s(s, listener, sender, packet_rx_ticks);
    relay_terms(s, listener, sender, age_s, false);
    real expected_m = find_distance_m(s, listener, sender) + h_dot_x(s, 0);
    add_term(s, mesh + sender, -REAL(1.0));
    add_term(s, mesh + listener, REAL(1.0));
    expected_m += s->x[mesh + listener] - s->x[mesh + sender] + link->phase_m;
    real innovation = innovation_m(s, -phase_cycles - whole_cycles(s, j->offset_ticks - i->offset_ticks), expected_m);
    real predicted = max_real(compute_ph(s), REAL(0.0));
    compute_fault_input(s, -1);
    real aged_m2 = relay_variance(s, listener, sender, age_s) - s->settings.rx_variance_m2;
    real variance = square(s->tuning.phase_mesh_std_m) + aged_m2;
    if (!i->mesh.is_known) {
        if (link->has_phase || !has_pairs(s, listener)) {
            link->has_phase = true;
            open(s, mesh + listener, &i->mesh, innovation, variance + link->phase_variance_m2);
        }
        return;
    }
    const spread_of_h_results results_1 = spread_of_h(s);
    real likely_m = results_1.item_0;
    real spread_m2 = results_1.item_1;
    real shown_m2 = predicted + spread_m2 + variance;
    real known_m2 = square(s->tuning.pair_share * wavelength_m(s));
    if (!link->has_phase || link->phase_variance_m2 > known_m2) {
        link->has_phase = true;
        link->phases_refused = 0;
        link->phase_m = link->phase_m + innovation - likely_m;
        link->phase_variance_m2 = shown_m2;
        return;
    }
    real expected_m2 = predicted + variance + link->phase_variance_m2;
    real limit_m = SQRT(limit_m2(s, predicted, expected_m2));
    if (!take_cycles(s, innovation, expected_m2, limit_m)) {
        s->status.phases_refused += 1;
        link->phases_refused += 1;
        if (link->phases_refused >= truncated(s->tuning.phases_in_row)) {
            forget_pair_phase(link);
        }
        return;
    }
    s->status.phases_used += 1;
    link->phases_refused = 0;
    if (shown_m2 < known_m2) {
        real share = link->phase_variance_m2 / (shown_m2 + link->phase_variance_m2);
        real shown_m = innovation - likely_m;
        link->phase_m += share * (shown_m - (real)floor_real(shown_m / wavelength_m(s) + REAL(0.5)) * wavelength_m(s));
        link->phase_variance_m2 -= share * link->phase_variance_m2;
    }
}

/* Whether the clock that phases show of an anchor is known; of the first one it is by definition that of stamps. */
INTERNAL bool has_mesh(State *s, int32_t anchor) {
    bool is_first = true;
    for (int32_t one = 0, one_end = s->count; one < one_end; one++) {
        is_first = is_first && !s->anchors[one].mesh.is_known;
    }
    if (is_first) {
        finish_updates(s);
        reset_state(s, s->layout.mesh + anchor, REAL(0.0));
        s->anchors[anchor].mesh.is_known = true;
    }
    return s->anchors[anchor].mesh.is_known;
}

/* Whether the constant of any pair of an anchor has been measured: its clock must then fit that. */
INTERNAL bool has_pairs(State *s, int32_t anchor) {
    bool has_pairs = false;
    for (int32_t other = 0, other_end = s->count; other < other_end; other++) {
        has_pairs = has_pairs || s->links[anchor][other].has_phase || s->links[other][anchor].has_phase;
    }
    return has_pairs;
}

/* Fractional cycles, in [0, 1), of a number of ticks. */
INTERNAL real whole_cycles(State *s, int64_t ticks) {
    return (real)floor_mod_64((ticks & (CYCLE_TICKS - 1)) * s->settings.carrier_cycles, CYCLE_TICKS) /
            (real)CYCLE_TICKS;
}

/* Largest variance of a prediction that determines the cycle. */
INTERNAL real certain_m2(State *s) {
    return square(s->tuning.phase_share * wavelength_m(s));
}

/* Difference between a phase and its prediction, to the nearest cycle. */
INTERNAL real innovation_m(State *s, real cycles, real expected_m) {
    real off = cycles - expected_m / wavelength_m(s);
    return (off - (real)floor_real(off + REAL(0.5))) * wavelength_m(s);
}

/* Process the phase in ``h``, whose last term is its ambiguity, the state of that index. Returns False if unused.
 *
 * ``predicted``: hᵀ·P·h, as ``compute_ph`` found it. */
INTERNAL bool use_phase(State *s, int32_t state, Ambiguity *own, real innovation, real predicted, real variance) {
    Status *status = &s->status;
    own->ticks = status->epoch_ticks;
    real within_m2 = limit_m2(s, predicted, predicted + variance);
    if (!own->is_known || !(predicted <= certain_m2(s) || are_few(s, within_m2))) {
        open(s, state, own, innovation, variance);
        return false;
    }
    if (!take_cycles(s, innovation, predicted + variance, SQRT(within_m2))) {
        status->phases_refused += 1;
        own->refused_in_row += 1;
        if (own->refused_in_row >= truncated(s->tuning.phases_in_row)) {
            open(s, state, own, innovation, variance);
        }
        return false;
    }
    own->refused_in_row = 0;
    status->phases_used += 1;
    return true;
}

/* Whether the cycles within a distance are few enough, and phases so reliable, that hypotheses are of use. */
INTERNAL bool are_few(State *s, real within_m2) {
    bool has_settled = s->status.walk_scale < s->tuning.phases_walk_scale;
    return has_settled && REAL(4.0) * within_m2 < square(s->tuning.most_cycles * wavelength_m(s)) &&
            are_phases_reliable(s);
}

/* Squared innovation beyond which a phase is not used: if its cycle is certain, where it is more likely random. */
INTERNAL real limit_m2(State *s, real predicted, real variance) {
    real gate_squared = square(s->settings.gate);
    if (predicted > certain_m2(s)) {
        return gate_squared * variance;
    }
    real odds = min_real(s->status.wild_share, REAL(0.5)) * SQRT(TWO_PI * variance) / wavelength_m(s);
    if (odds > REAL(1e-06)) {
        gate_squared = min_real(gate_squared, -REAL(2.0) * log_(odds));
    }
    return min_real(gate_squared * variance, square(s->tuning.phase_gate * wavelength_m(s)));
}

/* Update the share of wild phases by how likely the newest is one: all phases are then equally likely. */
INTERNAL void count_wild(State *s, real innovation, real variance) {
    Status *status = &s->status;
    real share = max_real(s->status.wild_share, s->tuning.least_wild);
    real wild = share * SQRT(TWO_PI * variance) / wavelength_m(s);
    real is_wild = wild / (wild + (REAL(1.0) - share) * likelihood(s, innovation, variance));
    status->wild_share += s->tuning.slow_forgetting * (is_wild - status->wild_share);
}

/* Adapt the variance of phases to innovations beyond their prediction: reflections differ in size. */
INTERNAL void learn_noise(State *s, real shown_m2) {
    Tuning *tuning = &s->tuning;
    Status *status = &s->status;
    status->phase_variance_m2 += tuning->slow_forgetting * (shown_m2 - status->phase_variance_m2);
    status->phase_variance_m2 = min_real(max_real(status->phase_variance_m2, square(s->settings.phase_std_m)),
            square(max_real(tuning->phase_max_std_m, s->settings.phase_std_m)));
}

/* Whether the tag's phases may be used: neither soon after the start nor while stamps contradict the state.
 *
 * If they contradict hypotheses, all of these may be wrong, and P is smaller than the position's error. */
INTERNAL bool may_count(State *s) {
    Status *status = &s->status;
    Tuning *tuning = &s->tuning;
    settle_hypotheses(s);
    if (!are_phases_reliable(s)) {
        give_up_hypotheses(s);
    }
    bool are_wrong = s->hypotheses.count > 1 && status->mean_nis > tuning->phases_nis;
    if (are_wrong) {
        for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
            s->P[at(axis, axis)] += square(tuning->slip_std_m);
        }
    }
    if (are_wrong || !agree(s)) {
        close_phases(s);
    }
    return agree(s) && (real)(status->epoch_ticks - status->start_ticks) * TICK_S >= tuning->phases_start_s;
}

/* Whether stamps do not contradict the state. */
INTERNAL bool agree(State *s) {
    return s->status.mean_nis <= s->tuning.wrong_nis;
}

/* Restart all ambiguities of the tag's receptions, which may be wrong by cycles. */
INTERNAL void close_phases(State *s) {
    give_up_hypotheses(s);
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        s->anchors[anchor].own.is_known = false;
    }
}

/* Add a step to the tag's way once it has moved by its length. */
INTERNAL void measure_way(State *s) {
    real squared = REAL(0.0);
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        squared += square(s->x[axis] - s->status.step_m[axis]);
    }
    if (squared > square(s->tuning.phase_step_m)) {
        s->status.way_m += SQRT(squared);
        for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
            s->status.step_m[axis] = s->x[axis];
        }
    }
}

/* Keep the point at which phases are linearised near the tag.
 *
 * The point moves as the tag does, but not with corrections of the estimate. At the newest estimate, corrections would
 * turn the directions to the anchors, and phases would seem to measure the position. */
INTERNAL void follow_line(State *s) {
    real away_m2 = REAL(0.0);
    bool is_in_use = false;
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        away_m2 += square(s->x[axis] - s->status.line_m[axis]);
    }
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        is_in_use = is_in_use || s->anchors[anchor].own.is_known;
    }
    if (is_in_use && away_m2 <= square(s->tuning.held_step_m)) {
        return;
    }
    if (away_m2 > square(s->tuning.held_max_m)) {
        close_phases(s);
    }
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        if (s->anchors[anchor].own.is_known) {
            turn(s, anchor, s->layout.ambiguity + anchor);
        }
    }
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        s->status.line_m[axis] = s->x[axis];
    }
}

/* Change the direction to which an ambiguity's error refers, from that of the line to that of the estimate.
 *
 * a ← a − (h' − h)·(p − δa): the information on the position itself does not change. */
INTERNAL void turn(State *s, int32_t anchor, int32_t ambiguity) {
    Anchor *a = &s->anchors[anchor];
    int32_t survey = s->layout.survey + s->dim * anchor;
    real old_m = line_range_m(s, anchor, s->status.line_m);
    real new_m = line_range_m(s, anchor, s->x);
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        real turned = (s->x[axis] - a->position_m[axis]) / new_m - (s->status.line_m[axis] - a->position_m[axis]) /
                old_m;
        subtract(s, ambiguity, axis, turned);
        subtract(s, ambiguity, survey + axis, -turned);
    }
}

/* Subtract ``weight`` times another state's error from a state's error. */
INTERNAL void subtract(State *s, int32_t state, int32_t other, real weight) {
    s->P[at(state, state)] -= weight * s->P[at(other, state)];
    for (int32_t one = 0, one_end = s->n; one < one_end; one++) {
        if (one != state) {
            set_covariance(s, state, one, s->P[at(state, one)] - weight * s->P[at(other, one)]);
        }
    }
    s->P[at(state, state)] -= weight * s->P[at(state, other)];
    for (int32_t fault = 0, fault_end = s->rows; fault < fault_end; fault++) {
        s->V[state][fault] -= weight * s->V[other][fault];
    }
}

/* Distance of a point, at the given height in 2-D, from an anchor. */
INTERNAL real line_range_m(State *s, int32_t anchor, real *point_m) {
    Anchor *a = &s->anchors[anchor];
    real squared = REAL(0.0);
    if (s->dim == 2) {
        squared += square(s->settings.height_m - a->position_m[2]);
    }
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        squared += square(point_m[axis] - a->position_m[axis]);
    }
    return max_real(SQRT(squared), REAL(1e-06));
}

/* Write a phase of the tag's into ``h``. Returns its prediction without whole ticks of the offset. */
INTERNAL real phase_terms(State *s, int32_t anchor) {
    s->terms = 0;
    real *line_m = s->status.line_m;
    real range_m = add_direction_from(s, anchor, REAL(1.0), line_m, line_range_m(s, anchor, line_m));
    int32_t first = s->terms;
    add_term(s, s->layout.offset + anchor, REAL(1.0));
    add_term(s, s->layout.ambiguity + anchor, REAL(1.0));
    return range_m + h_dot_x(s, first);
}

/* Start an ambiguity, the last term of ``h``, so that this phase agrees with it. */
INTERNAL void open(State *s, int32_t state, Ambiguity *one, real innovation, real variance) {
    finish_updates(s);
    s->status.phases_opened += 1;
    one->is_known = true;
    one->refused_in_row = truncated(s->tuning.phases_in_row) - 1;  /* if the next phase does not confirm this one, it was wrong */
    real ambiguity_m = s->x[state] + innovation;
    reset_state(s, state, REAL(0.0));
    s->terms -= 1;
    open_state(s, state, -1, variance + compute_ph(s));
    s->x[state] = ambiguity_m;
}

/* Covariance analysis */

/* Process a phase at the tag's true position with an innovation of zero, for a bound without cycles.
 *
 * ``walked_m``: since this anchor's last phase. Noise and wander are as stated. */
INTERNAL void known_phase(State *s, int32_t anchor, real walked_m) {
    int32_t ambiguity = s->layout.ambiguity + anchor;
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        s->status.line_m[axis] = s->x[axis];
    }
    s->P[at(ambiguity, ambiguity)] += s->settings.phase_wander * walked_m;
    phase_terms(s, anchor);
    Ambiguity *own = &s->anchors[anchor].own;
    real variance = s->status.phase_variance_m2;
    real predicted = compute_ph(s);
    if (own->is_known) {
        compute_fault_input(s, -1);
        update(s, REAL(0.0), predicted + variance, REAL(1.0));
    } else {
        open(s, ambiguity, own, REAL(0.0), variance);
    }
}

/* The predicted phase of a reception in cycles, for which ``own_phase`` has an innovation of zero. */
INTERNAL real expected_phase(State *s, int32_t anchor) {
    real expected_m = phase_terms(s, anchor);
    return -(expected_m / wavelength_m(s) + whole_cycles(s, s->anchors[anchor].offset_ticks));
}

/* Processing a packet, a ready-made difference or a height; and a batch of packets in one loop. */

/* Remove an anchor from the state, if it is there. */
SKYLESS_EXPORT void skyless_leave(State *s, int32_t identifier) {
    int32_t anchor = skyless_find_anchor(s, identifier);
    if (anchor >= 0) {
        remove_anchor(s, anchor);
        skyless_fit_plane(s);
    }
}

/* One packet */

/* Process a packet and its relays. Returns the outcome and fills ``levels`` and ``fix``. */
INTERNAL int32_t process(State *s, Packet *packet, Relays *relays) {
    int32_t outcome = process_packet(s, packet, relays);
    fill_fix(s);
    return outcome;
}

/* ``process`` with further relays, encoded as in a frame. */
SKYLESS_EXPORT int32_t skyless_process_frame(State *s, Packet *packet, Relays *relays, uint8_t *packed, int32_t
        packed_bytes) {
    take_relays(packet, relays, packed, packed_bytes);
    return process(s, packet, relays);
}

/* Append encoded relays to those of a packet, as far as there is space. */
INTERNAL void take_relays(Packet *packet, Relays *relays, uint8_t *packed, int32_t packed_bytes) {
    for (int32_t begin = 0; begin < packed_bytes; begin += 8) {
        if (relays->count < MAX_RELAYS) {
            Relay *relayed = &relays->rows[relays->count];
            relayed->listener = packet->place.anchor;
            relayed->anchor = two_bytes(packed, begin);
            relayed->sequence = packed[begin + 2];
            relayed->is_short = packet->relays_have_phases;
            relayed->has_phase = false;
            if (relayed->is_short) {
                int32_t code = packed[begin + HEARD_BYTES - 1];
                relayed->rx_ticks = unsigned_(packed, begin + 3, floor_div_32(SHORT_BITS, 8));
                relayed->has_phase = code >= PHASE_STEPS;
                relayed->phase_cycles = (real)floor_mod_32(code, PHASE_STEPS) / (real)PHASE_STEPS;
            } else {
                relayed->rx_ticks = nearest(unsigned_(packed, begin + 3, HEARD_BYTES - 3), packet->tx_ticks, 40);
            }
            relays->count += 1;
        }
    }
}

/* The unwrapped stamp of a relay.
 *
 * ``tx_ticks`` is the listener's stamp of a packet that the tag received ``elapsed`` after the relayed one. */
INTERNAL int64_t relay_rx_ticks(Relay *relayed, int64_t tx_ticks, int64_t elapsed) {
    return relayed->is_short ? nearest(relayed->rx_ticks, tx_ticks - elapsed, SHORT_BITS) : relayed->rx_ticks;
}

/* Process a packet. Its anchor joins if it is not in the state. */
INTERNAL int32_t process_packet(State *s, Packet *packet, Relays *relays) {
    Status *status = &s->status;
    Place *place = &packet->place;
    if (status->packets > 0 && packet->rx_ticks < status->epoch_ticks) {
        status->stale += 1;
        status->stale_in_row += 1;
        return STALE;
    }
    remove_silent(s, packet->rx_ticks);
    int32_t anchor = present(s, place);
    if (anchor < 0) {
        return REJECTED;
    }
    int32_t outcome = process_of(s, anchor, packet, relays);
    if (outcome == RESTARTED_CLOCK) {
        status->clock_restarts += 1;
        remove_anchor(s, anchor);
        anchor = present(s, place);
        outcome = process_of(s, anchor, packet, relays);
    }
    return outcome;
}

/* The index of an anchor, which is added or moved if needed; −1 if there is no room. */
INTERNAL int32_t present(State *s, Place *place) {
    int32_t anchor = skyless_find_anchor(s, place->anchor);
    bool is_new = false;
    if (anchor < 0 && s->count < MAX_ANCHORS) {
        anchor = skyless_add_anchor(s, place->anchor, place->position_m, place->std_m, place->is_open);
        is_new = true;
    }
    if (anchor >= 0) {
        for (int32_t axis = 0; axis < AXES; axis++) {
            is_new = is_new || s->anchors[anchor].position_m[axis] != place->position_m[axis];
            s->anchors[anchor].position_m[axis] = place->position_m[axis];
        }
    }
    if (is_new) {
        skyless_fit_plane(s);
    }
    return anchor;
}

/* Remove anchors that have been silent for too long. */
INTERNAL void remove_silent(State *s, int64_t rx_ticks) {
    for (int32_t anchor = s->count - 1; anchor > -1; anchor--) {
        Anchor *a = &s->anchors[anchor];
        if (a->packets > 0 && (real)(rx_ticks - a->rx_ticks) * TICK_S > s->settings.drop_s) {
            remove_anchor(s, anchor);
            skyless_fit_plane(s);
        }
    }
}

/* Process a packet of an anchor in the state. */
INTERNAL int32_t process_of(State *s, int32_t anchor, Packet *packet, Relays *relays) {
    Status *status = &s->status;
    Anchor *a = &s->anchors[anchor];
    int64_t rx_ticks = packet->rx_ticks;
    int64_t tx_ticks = packet->tx_ticks;
    real elapsed_s = (real)(rx_ticks - status->epoch_ticks) * TICK_S;
    int32_t outcome = admit(s, anchor, rx_ticks, tx_ticks);
    if (outcome == REJECTED || outcome == RESTARTED_CLOCK) {
        return outcome;
    }
    status->stale_in_row = 0;
    advance_to(s, rx_ticks);
    if (has_order(s)) {
        process_relays(s, packet, relays);
        add_clock_noise(s, anchor, rx_ticks);
    }
    if (outcome == JOINED) {
        first_reception(s, anchor, rx_ticks, tx_ticks, packet->variance_factor);
    } else {
        int32_t result = own_reception(s, anchor, rx_ticks, tx_ticks, packet->variance_factor);
        if (result == CLOCK_JUMPED) {
            return RESTARTED_CLOCK;
        }
        outcome = result == USED ? ACCEPTED : REJECTED;
        if (PHASE_STATES > 0 && packet->has_phase && s->settings.carrier_cycles > 0) {
            process_phase(s, anchor, packet->phase_cycles, result == USED);
        }
    }
    bool is_known = a->packets > 0;
    status->packets += 1;
    keep_packet(s, anchor, packet);
    if (is_known) {
        status->relays_lately_accepted *= REAL(1.0) - s->tuning.mean_gain;
        status->relays_lately_rejected *= REAL(1.0) - s->tuning.mean_gain;
        if (!has_order(s)) {
            process_relays(s, packet, relays);
        }
        if (packet->report_variance_m2 > REAL(0.0) && packet->master >= 0) {
            int32_t master = skyless_find_anchor(s, packet->master);
            if (master >= 0 && master != anchor) {
                report(s, anchor, master, packet->subticks, packet->report_variance_m2);
            }
        }
    }
    finish_updates(s);
    if (PHASE_STATES > 0) {
        settle_hypotheses(s);
    }
    check_motion_and_faults(s, elapsed_s);
    return outcome;
}

/* Time update to a tag time. */
INTERNAL void advance_to(State *s, int64_t rx_ticks) {
    if (MOTION_STATES > 0) {
        look_at_sensor(s, rx_ticks);
    }
    predict(s, rx_ticks);
    if (MOTION_STATES > 0) {
        move(s, rx_ticks);
    }
    fade_faults(s);
}

/* Return ``JOINED`` or ``ACCEPTED`` for a packet that can be processed; otherwise count and return its outcome. */
INTERNAL int32_t admit(State *s, int32_t anchor, int64_t rx_ticks, int64_t tx_ticks) {
    Anchor *a = &s->anchors[anchor];
    Status *status = &s->status;
    if (a->packets == 0) {
        return JOINED;
    }
    if (tx_ticks == a->tx_ticks || (real)(rx_ticks - a->rx_ticks) * TICK_S < SHORTEST_S) {
        status->impossible += 1;
        return REJECTED;
    }
    if (is_impossible(s, anchor, rx_ticks, tx_ticks)) {
        a->outliers_in_row += 1;
        status->rejected_in_row += 1;
        if ((real)a->outliers_in_row >= s->tuning.in_row) {
            return RESTARTED_CLOCK;
        }
        status->impossible += 1;
        return REJECTED;
    }
    return ACCEPTED;
}

/* Whether no clock can have got from the anchor's newest packet to this one. */
INTERNAL bool is_impossible(State *s, int32_t anchor, int64_t rx_ticks, int64_t tx_ticks) {
    Anchor *a = &s->anchors[anchor];
    int64_t elapsed = rx_ticks - a->rx_ticks;
    real change_m = (real)abs_64(elapsed - (tx_ticks - a->tx_ticks)) * TICK_M;
    return change_m > s->tuning.restart_m + MAX_RATE_MPS * (real)elapsed * TICK_S;
}

/* Keep what later packets of the anchor, and relays of this one, need. */
INTERNAL void keep_packet(State *s, int32_t anchor, Packet *packet) {
    Anchor *a = &s->anchors[anchor];
    KeptPacket *kept = &s->packets[anchor][floor_mod_32(packet->sequence, PACKETS_KEPT)];
    a->packets += 1;
    a->tx_ticks = packet->tx_ticks;
    a->rx_ticks = packet->rx_ticks;
    a->walked_m = s->status.walked_m;
    kept->sequence = packet->sequence;
    kept->tx_ticks = packet->tx_ticks;
    kept->rx_ticks = packet->rx_ticks;
}

/* Process the phase of a reception, if the stamp was used. */
INTERNAL void process_phase(State *s, int32_t anchor, real phase_cycles, bool is_used) {
    if (is_used) {
        own_phase(s, anchor, phase_cycles);
    } else if (s->anchors[anchor].outliers_in_row > 1) {
        close_phases(s);
    }
}

/* Process the relays of a packet: as listed, the newest first, or in order. */
INTERNAL void process_relays(State *s, Packet *packet, Relays *relays) {
    for (int32_t one = 0, one_end = relays->count; one < one_end; one++) {
        process_relay(s, packet, &relays->rows[has_order(s) ? relays->count - 1 - one : one]);
    }
    finish_updates(s);
}

/* Process a relay once, if the tag has received that packet. */
INTERNAL void process_relay(State *s, Packet *packet, Relay *relayed) {
    int32_t listener = skyless_find_anchor(s, relayed->listener);
    int32_t sender = skyless_find_anchor(s, relayed->anchor);
    if (listener < 0 || sender < 0 || sender == listener || !s->anchors[listener].has_rate) {
        return;
    }
    KeptPacket *kept = &s->packets[sender][floor_mod_32(relayed->sequence, PACKETS_KEPT)];
    Link *link = &s->links[listener][sender];
    bool is_young = (real)(s->status.epoch_ticks - kept->rx_ticks) * TICK_S < s->settings.relay_age_s;
    if (kept->sequence == relayed->sequence && kept->tx_ticks > link->tx_ticks && is_young) {
        link->tx_ticks = kept->tx_ticks;
        int64_t rx_ticks = relay_rx_ticks(relayed, packet->tx_ticks, packet->rx_ticks - kept->rx_ticks);
        if (has_order(s)) {
            add_clock_noise(s, sender, kept->rx_ticks);
            add_clock_noise(s, listener, kept->rx_ticks);
        }
        bool is_used = relay(s, listener, sender, kept->tx_ticks, kept->rx_ticks, rx_ticks);
        if (PHASE_STATES > 0 && is_used && relayed->has_phase && s->status.has_phases) {
            relay_phase(s, listener, sender, kept->rx_ticks, relayed->phase_cycles);
        }
    }
}

/* Check whether the tag is stationary and, once a round of packets, whether there are faults.
 *
 * An anchor whose clock is wrong leaves the state, to join again with its next packet. */
INTERNAL void check_motion_and_faults(State *s, real elapsed_s) {
    if (s->settings.stationary_s > REAL(0.0)) {
        update_stationary(s, elapsed_s);
        if (is_stationary(s)) {
            zero_velocity(s);
        }
    }
    int32_t count = s->count;
    if (floor_mod_64(s->status.packets, count) == 0) {
        open_faults(s);
        if (s->count < count) {
            skyless_fit_plane(s);
        }
    }
}

/* What a fix carries */

/* Fill the rows of a fix. */
INTERNAL void fill_fix(State *s) {
    int32_t velocity = s->layout.velocity;
    for (int32_t one = 0, one_end = s->dim; one < one_end; one++) {
        s->fix[POSITION][one] = s->x[one];
        s->fix[VELOCITY][one] = s->x[velocity + one];
        for (int32_t other = 0, other_end = s->dim; other < other_end; other++) {
            s->fix[POSITION + 1 + one][other] = motion_covariance(s, one, other);
            s->fix[VELOCITY + 1 + one][other] = motion_covariance(s, velocity + one, velocity + other);
        }
    }
    if (s->dim == 2) {
        s->fix[POSITION][2] = s->settings.height_m;
    }
    if (MOTION_STATES > 0) {
        fill_orientation(s);
    }
    if (PHASE_STATES > 0) {
        s->fix[ORIENTATION + 1][2] = (real)(follows_cycles(s) ? s->hypotheses.count : 0);
    }
    protect(s);
    s->fix[QUALITY][0] = s->status.mean_nis;
    s->fix[QUALITY][1] = s->status.mean_square_m2;
    s->fix[QUALITY][2] = largest_test(s);
    s->fix[PROTECTION][HPL] = s->levels[HPL];
    s->fix[PROTECTION][VPL] = s->levels[VPL];
    s->fix[PROTECTION][STATE] = (real)integrity_state(s);
}

/* Ready-made differences and heights */

/* Process a ready-made difference of ranges, to anchor b minus to anchor a, and fill the rows of a fix. */
SKYLESS_EXPORT int32_t skyless_process_difference(State *s, Place *a, Place *b, int64_t rx_ticks, real difference_m) {
    Status *status = &s->status;
    if (rx_ticks < status->epoch_ticks) {
        status->stale += 1;
        status->stale_in_row += 1;
        return STALE;
    }
    remove_silent(s, rx_ticks);
    if (present(s, a) < 0 || present(s, b) < 0) {
        return REJECTED;
    }
    int32_t near = skyless_find_anchor(s, a->anchor);
    int32_t far = skyless_find_anchor(s, b->anchor);
    status->stale_in_row = 0;
    real elapsed_s = (real)(rx_ticks - status->epoch_ticks) * TICK_S;
    advance_to(s, rx_ticks);
    int32_t outcome = difference(s, near, far, rx_ticks, difference_m) == USED ? ACCEPTED : REJECTED;
    status->packets += 1;
    note_difference(s, near, rx_ticks);
    note_difference(s, far, rx_ticks);
    check_motion_and_faults(s, elapsed_s);
    fill_fix(s);
    return outcome;
}

/* Record the use of an anchor in a difference. */
INTERNAL void note_difference(State *s, int32_t anchor, int64_t rx_ticks) {
    Anchor *a = &s->anchors[anchor];
    a->packets += 1;
    a->rx_ticks = rx_ticks;
    a->walked_m = s->status.walked_m;
}

/* Process a height sensor's reading, and fill the rows of a fix. */
SKYLESS_EXPORT int32_t skyless_process_height(State *s, real height_m, real std_m, bool is_barometer) {
    int32_t outcome = height(s, height_m, std_m, is_barometer) == USED ? ACCEPTED : REJECTED;
    fill_fix(s);
    return outcome;
}

/* Many packets in one loop */

/* Process a batch of packets, and write a row for each. */
SKYLESS_EXPORT void skyless_track(State *s, Place *places, BatchPacket *packets, Relay *relays, BatchRow *rows, int32_t
        count, bool has_levels) {
    Packet packet = {0};
    Relays taken = {0};
    packet.master = -1;
    int32_t begin = 0;
    for (int32_t one = 0; one < count; one++) {
        BatchPacket *given = &packets[one];
        packet.place = places[given->place];
        packet.sequence = given->sequence;
        packet.rx_ticks = given->rx_ticks;
        packet.tx_ticks = given->tx_ticks;
        packet.variance_factor = given->variance_factor;
        packet.has_phase = given->has_phase;
        packet.phase_cycles = given->phase_cycles;
        taken.count = min_32(given->end - begin, MAX_RELAYS);
        for (int32_t place = 0, place_end = taken.count; place < place_end; place++) {
            taken.rows[place] = relays[begin + place];
        }
        begin = given->end;
        rows[one].outcome = process_packet(s, &packet, &taken);
        fill_row(s, &rows[one], has_levels);
    }
}

/* Write a row of a batch. */
INTERNAL void fill_row(State *s, BatchRow *row, bool has_levels) {
    for (int32_t one = 0, one_end = s->dim; one < one_end; one++) {
        row->position_m[one] = s->x[one];
        row->velocity_mps[one] = s->x[s->layout.velocity + one];
        for (int32_t other = 0, other_end = s->dim; other < other_end; other++) {
            row->covariance_m2[one][other] = s->P[at(one, other)] + scatter(s, one, other);
        }
    }
    if (has_levels) {
        protect(s);
        for (int32_t level = 0; level < LEVELS; level++) {
            row->levels[level] = s->levels[level];
        }
        row->integrity = integrity_state(s);
    }
}

/* Covariance analysis: the filter's own steps without measurements, for planning and Cramér–Rao bounds.
 *
 * Computes what the filter will claim for a tag at rest at some place of a site: a superframe of messages is processed
 * with innovations of zero until the position's variance repeats. That variance includes the accelerations that the
 * filter allows for and that such a tag does not have. Their part follows from sensitivities: rows of V start, at moments
 * of a superframe, as a velocity unknown to the filter; the squares of their effect on the position, integrated over the
 * time after, are what accelerations add to P. Another row of V is the effect of the walls' delays.
 *
 * If only a share of an anchor's packets arrives, all its stamps carry correspondingly less information: their variances
 * are divided by the share, and those of relays by the share of all three packets involved. */

/* The position's variance, or a sum, counts as complete when it changes by less than this share between two looks. */

/* Find the steady state of a tag at the state's position.
 *
 * Ends after ``most`` superframes in any case; the sums are compared every ``step`` superframes. */
SKYLESS_EXPORT void skyless_find_steady_state(State *s, PlannedMessage *messages, PlannedRelay *relays, int32_t count,
        int32_t most, int32_t step, SteadyState *found) {
    s->rows = walls(s) + 1 + IMPULSES * s->dim;
    int64_t superframe = 0;
    for (int32_t one = 0; one < count; one++) {
        superframe += messages[one].gap_ticks;
    }
    int64_t now = 0;
    real before = REAL(0.0);
    for (int32_t number = 0; number < most; number++) {
        process_superframe(s, messages, relays, count, now, AFTER_ALL_TICKS, superframe, found);
        now += superframe;
        if (floor_mod_32(number, step) == step - 1) {
            real variance = found->variance_m2[0] + found->variance_m2[1] + found->variance_m2[2];
            if (abs_real(variance - before) <= COMPLETE_CHANGE * variance) {
                break;
            }
            before = variance;
        }
    }
    int64_t impulses_ticks = now;
    before = REAL(0.0);
    for (int32_t axis = 0; axis < AXES; axis++) {
        found->motion_m2[axis] = REAL(0.0);
    }
    for (int32_t number = 0; number < most; number++) {
        process_superframe(s, messages, relays, count, now, impulses_ticks, superframe, found);
        now += superframe;
        if (floor_mod_32(number, step) == step - 1) {
            real moved = found->motion_m2[0] + found->motion_m2[1] + found->motion_m2[2];
            if (number >= 1 && moved - before <= COMPLETE_CHANGE * moved) {
                break;
            }
            before = moved;
        }
    }
    for (int32_t axis = 0; axis < AXES; axis++) {
        found->motion_m2[axis] *= s->settings.qa * ((real)superframe * TICK_S) / ((real)IMPULSES * found->fixes);
    }
}

/* Find what the filter claims for a tag that rests for some superframes and then walks for others.
 *
 * ``found`` holds the fixes and variances of the last superframe. A state with phases gets one for each message of
 * which at least half arrive; the phases are as predicted, so cycles are ambiguous wherever they are for the filter.
 * Messages must not be late. */
SKYLESS_EXPORT void skyless_find_walked(State *s, PlannedMessage *messages, PlannedRelay *relays, int32_t count, int32_t
        at_rest, real *velocity_mps, int32_t walked, SteadyState *found) {
    int64_t superframe = 0;
    for (int32_t one = 0; one < count; one++) {
        superframe += messages[one].gap_ticks;
    }
    for (int32_t number = 0; number < at_rest + walked; number++) {
        if (number == at_rest) {
            for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
                s->x[s->layout.velocity + axis] = velocity_mps[axis];
            }
        }
        process_superframe(s, messages, relays, count, number * superframe, AFTER_ALL_TICKS, superframe, found);
    }
}

/* The row of V for the walls' delays; the rows of the impulses follow. */
INTERNAL int32_t walls(State *s) {
    return FAULT_KINDS * s->count;
}

/* Process a superframe from ``now`` on; impulses act in the one that begins at ``impulses_ticks``. */
INTERNAL void process_superframe(State *s, PlannedMessage *messages, PlannedRelay *relays, int32_t count, int64_t now,
        int64_t impulses_ticks, int64_t superframe, SteadyState *found) {
    int32_t begin = 0;
    found->square_bias_m2 = REAL(0.0);
    found->fixes = REAL(0.0);
    for (int32_t axis = 0; axis < AXES; axis++) {
        found->variance_m2[axis] = REAL(0.0);
    }
    for (int32_t one = 0; one < count; one++) {
        PlannedMessage *message = &messages[one];
        now += message->gap_ticks;
        if (message->anchor >= 0) {
            predict_with_impulses(s, now, impulses_ticks, superframe);
            receive(s, message, now);
            for (int32_t other = begin, other_end = message->end; other < other_end; other++) {
                if (relays[other].sender >= 0 && s->anchors[relays[other].sender].packets > 0) {
                    receive_relay(s, message, &relays[other]);
                }
            }
            finish_updates(s);
            add_fix(s, message->share, found);
        }
        begin = message->end;
    }
}

/* Add a fix to the sums. */
INTERNAL void add_fix(State *s, real share, SteadyState *found) {
    found->fixes += share;
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        found->variance_m2[axis] += share * (s->P[at(axis, axis)] + scatter(s, axis, axis));
        if (!s->status.has_phases) {  /* with phases these columns are hypotheses */
            found->square_bias_m2 += share * square(s->V[axis][walls(s)]);
            for (int32_t row = walls(s) + 1, row_end = s->rows; row < row_end; row++) {
                found->motion_m2[axis] += share * square(s->V[axis][row]);
            }
        }
    }
}

/* Time update; from each impulse on the tag has a velocity of 1 m/s that the filter does not know of. */
INTERNAL void predict_with_impulses(State *s, int64_t now, int64_t impulses_ticks, int64_t superframe) {
    int64_t before = s->status.epoch_ticks;
    predict(s, now);
    for (int32_t impulse = 0; impulse < IMPULSES; impulse++) {
        int64_t moment = impulses_ticks + floor_real(((real)impulse + REAL(0.5)) / (real)IMPULSES * (real)superframe +
                REAL(0.5));
        if (before < moment && moment <= now) {
            for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
                int32_t row = walls(s) + 1 + s->dim * impulse + axis;
                s->V[axis][row] = (real)(now - moment) * TICK_S;
                s->V[s->layout.velocity + axis][row] = REAL(1.0);
            }
        }
    }
}

/* Process the tag's reception of a message. */
INTERNAL void receive(State *s, PlannedMessage *message, int64_t rx_ticks) {
    Anchor *a = &s->anchors[message->anchor];
    Layout *where = &s->layout;
    if (a->packets == 0) {
        first_reception(s, message->anchor, rx_ticks, rx_ticks, REAL(1.0));
        s->V[where->offset + message->anchor][walls(s)] += message->late_m;
    } else {
        real elapsed_s = (real)(rx_ticks - a->rx_ticks) * TICK_S;
        relax_range_error(s, message->anchor, elapsed_s, s->status.walked_m - a->walked_m);
        reset_state(s, where->tx_noise + message->anchor, s->settings.tx_variance_m2 / message->share);
        reception_terms(s, message->anchor, true);
        real variance = compute_ph(s) + s->settings.rx_variance_m2 / message->share;
        compute_fault_input(s, message->anchor);
        s->G[s->waiting][walls(s)] += message->late_m;
        if (a->has_rate) {
            update(s, REAL(0.0), variance, REAL(1.0));
        } else {
            find_rate(s, message->anchor, REAL(0.0), variance, elapsed_s);
        }
        if (PHASE_STATES > 0 && s->status.has_phases && message->share >= REAL(0.5)) {
            own_phase(s, message->anchor, expected_phase(s, message->anchor));
        }
    }
    a->rx_ticks = rx_ticks;
    a->walked_m = s->status.walked_m;
    a->packets += 1;
}

/* Process a relay. */
INTERNAL void receive_relay(State *s, PlannedMessage *message, PlannedRelay *relayed) {
    relay_terms(s, message->anchor, relayed->sender, relayed->age_s, true);
    real variance = relay_variance(s, message->anchor, relayed->sender, relayed->age_s) / relayed->share;
    variance += compute_ph(s);
    compute_fault_input(s, -1);
    if (s->links[message->anchor][relayed->sender].variance_m2 == REAL(0.0)) {  /* else the pair's constant takes the delay */
        s->G[s->waiting][walls(s)] += relayed->late_m;
    }
    update_later(s, REAL(0.0), variance, true);
}

/* Cramér–Rao bounds */

/* Process a frame at the tag's true position, with innovations of zero.
 *
 * ``known``: whether each anchor's reception of it, and then the tag's, is known; anchors before ``first`` are left
 * out. ``elapsed_s``, ``walked_m``: since this anchor's previous frame that the tag received. */
SKYLESS_EXPORT void skyless_process_known(State *s, int32_t sender, int64_t rx_ticks, real *position_m, uint8_t *known,
        int32_t first, real elapsed_s, real walked_m) {
    predict(s, rx_ticks);
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        s->x[axis] = position_m[axis];
    }
    if (s->dim == 2) {
        s->settings.height_m = position_m[2];
    }
    reset_state(s, s->layout.tx_noise + sender, s->settings.tx_variance_m2);
    if (known[s->count] != 0) {
        relax_range_error(s, sender, elapsed_s, walked_m);
        s->anchors[sender].held_range_m = REAL(0.0);  /* linearise here, not at a held point */
        reception_terms(s, sender, true);
        update(s, REAL(0.0), compute_ph(s) + s->settings.rx_variance_m2, REAL(1.0));
        if (s->status.has_phases) {
            known_phase(s, sender, walked_m);
        }
    }
    for (int32_t listener = first, listener_end = s->count; listener < listener_end; listener++) {
        if (known[listener] != 0) {
            relay_terms(s, listener, sender, REAL(0.0), true);
            if (s->status.range_errors == ALL_RANGE_ERRORS) {
                add_pair_survey(s, listener, sender);
            }
            update(s, REAL(0.0), compute_ph(s) + s->settings.rx_variance_m2, REAL(1.0));
        }
    }
}

/* Search for the positions that explain a set of TDoAs: starting points, descent, distinct minima. */

/* Anchors are coplanar if they deviate from the plane by less than this fraction of the smallest TDoA sigma … */

/* Transform the anchors into axes with the reference at the origin, and choose the kind of problem.
 *
 * Without a given height, the axes are the principal axes of the anchors' figure, the longest first.
 * Returns False if the anchors are collinear. */
INTERNAL bool choose_axes(LocateProblem *p) {
    Columns m = {0};
    m.rows = p->anchors;
    m.columns = 3;
    for (int32_t k = 0; k < 3; k++) {
        p->origin_m[k] = p->anchors_m[0][k];
    }
    for (int32_t i = 0, i_end = p->anchors; i < i_end; i++) {
        for (int32_t k = 0; k < 3; k++) {
            p->anchors_m[i][k] -= p->origin_m[k];
            m.A[i][k] = p->knows_height && k == 2 ? REAL(0.0) : p->anchors_m[i][k];
        }
    }
    orthogonalise(&m);
    real square = REAL(0.0);
    real square_width = REAL(0.0);
    real thickness_m = REAL(0.0);
    for (int32_t i = 0, i_end = p->anchors; i < i_end; i++) {
        real *row = m.A[i];
        real square_across = row[1] * row[1] + row[2] * row[2];
        square = max_real(square, row[0] * row[0] + square_across);
        square_width = max_real(square_width, square_across);
        thickness_m = max_real(thickness_m, abs_real(row[2]));
    }
    if (!(square_width > COLLINEAR * COLLINEAR * square)) {
        return false;
    }
    p->extent_m = SQRT(square);
    bool is_flat = thickness_m <= max_real(FLAT * p->extent_m, THIN_SIGMAS * least_sigma_m(p));
    p->kind = p->knows_height ? HEIGHT : is_flat ? PLANE : FREE;
    p->dims = p->kind == HEIGHT ? 2 : 3;
    for (int32_t j = 0; j < 3; j++) {
        p->scale[j] = p->kind == PLANE && j == 2 ? p->extent_m * p->extent_m : p->extent_m;
        for (int32_t k = 0; k < 3; k++) {
            p->axes[j][k] = p->kind != HEIGHT ? m.V[k][j] : j == k ? REAL(1.0) : REAL(0.0);
        }
    }
    if (p->kind != HEIGHT) {
        for (int32_t i = 0, i_end = p->anchors; i < i_end; i++) {
            for (int32_t k = 0; k < 3; k++) {
                p->anchors_m[i][k] = p->kind == PLANE && k == 2 ? REAL(0.0) : m.A[i][k];
            }
        }
    }
    return true;
}

/* Standard deviation of a TDoA, from the factor of Σ. */
INTERNAL real sigma_m(LocateProblem *p, int32_t index_) {
    int32_t row = floor_div_32(index_ * (index_ + 1), 2);
    real total = REAL(0.0);
    for (int32_t k = 0; k < index_ + 1; k++) {
        total += p->covariance[row + k] * p->covariance[row + k];
    }
    return SQRT(total);
}

INTERNAL real least_sigma_m(LocateProblem *p) {
    real least_m = sigma_m(p, 0);
    for (int32_t i = 1, i_end = p->anchors - 1; i < i_end; i++) {
        least_m = min_real(least_m, sigma_m(p, i));
    }
    return least_m;
}

/* … or with a step that promises to lower the cost by less than this fraction: 10⁻⁷ sigma. */

/* Move the state to the nearest minimum. Returns how the iteration ended. */
INTERNAL int32_t descend(LocateProblem *p) {
    int32_t gradient = floor_div_32(p->dims * (p->dims + 1), 2);
    real cost = assemble(p, p->state, p->normal);
    real damping = REAL(0.0);
    real growth = REAL(2.0);
    for (int32_t j = 0; j < 3; j++) {
        p->trial[j] = p->state[j];
    }
    for (int32_t iteration = 1; iteration < MAX_ITERATIONS + 1; iteration++) {
        p->iterations = iteration;
        if (!find_damped_step(p, damping)) {
            if (damping > REAL(1.0)) {
                return UNDETERMINED;
            }
            damping = max_real(REAL(10.0) * damping, FIRST_DAMPING);
            continue;
        }
        real predicted = REAL(0.0);
        real longest = REAL(0.0);
        for (int32_t j = 0, j_end = p->dims; j < j_end; j++) {
            p->trial[j] = p->state[j] + p->step[j];
            predicted += p->step[j] * (p->normal[gradient + j] + damping * p->normal[floor_div_32(j * (j + 3), 2)] *
                    p->step[j]);
            longest = max_real(longest, abs_real(p->step[j]) / p->scale[j]);
        }
        bool is_small = longest <= STEP_TOLERANCE || predicted <= GAIN_TOLERANCE * cost;
        real next_cost = assemble(p, p->trial, p->next_normal);
        if (next_cost < cost) {
            damping = eased(damping, predicted > REAL(0.0) ? (cost - next_cost) / predicted : REAL(1.0));
            growth = REAL(2.0);
            cost = next_cost;
            for (int32_t j = 0, j_end = p->dims; j < j_end; j++) {
                p->state[j] = p->trial[j];
            }
            for (int32_t k = 0, k_end = gradient + p->dims; k < k_end; k++) {
                p->normal[k] = p->next_normal[k];
            }
        } else {
            damping = max_real(growth * damping, FIRST_DAMPING);
            growth = REAL(2.0) * growth;
        }
        if (is_small) {
            return CONVERGED;
        }
        if (is_far(p)) {
            return DIVERGED;
        }
    }
    return EXHAUSTED;
}

/* Linearise, whiten if weighted, and write systemᵀ·system into ``normal``. Returns the cost. */
INTERNAL real assemble(LocateProblem *p, real *state, real *normal) {
    linearise(p, state);
    if (p->is_weighted) {
        whiten_system(p);
    }
    int32_t element = 0;
    for (int32_t j = 0, j_end = p->dims + 1; j < j_end; j++) {
        for (int32_t k = 0; k < j + 1; k++) {
            real total = REAL(0.0);
            for (int32_t i = 0, i_end = p->anchors - 1; i < i_end; i++) {
                total += p->system[i][j] * p->system[i][k];
            }
            normal[element] = total;
            element += 1;
        }
    }
    return normal[element - 1];
}

/* Write ``system``. An anchor at the state itself has no direction; its derivatives are zero. */
INTERNAL void linearise(LocateProblem *p, real *state) {
    real reference_m = REAL(0.0);
    real reference_x = REAL(0.0);
    real reference_y = REAL(0.0);
    real reference_z = REAL(0.0);
    for (int32_t i = 0, i_end = p->anchors; i < i_end; i++) {
        real *anchor = p->anchors_m[i];
        real x = state[0] - anchor[0];
        real y = state[1] - anchor[1];
        real z = state[2] - anchor[2];
        real across = p->kind == PLANE ? state[2] : z * z;
        real distance_m = SQRT(max_real(x * x + y * y + across, NEAREST_M2));
        x /= distance_m;
        y /= distance_m;
        z = (p->kind == PLANE ? REAL(0.5) : z) / distance_m;
        if (i == 0) {
            reference_m = distance_m;
            reference_x = x;
            reference_y = y;
            reference_z = z;
        } else {
            real *row = p->system[i - 1];
            row[2] = z - reference_z;  /* overwritten by the residual below if the height is given */
            row[0] = x - reference_x;
            row[1] = y - reference_y;
            row[p->dims] = p->tdoa_m[i - 1] - (distance_m - reference_m);
        }
    }
}

/* Replace ``system`` by L⁻¹·system. */
INTERNAL void whiten_system(LocateProblem *p) {
    for (int32_t i = 0, i_end = p->anchors - 1; i < i_end; i++) {
        int32_t first = floor_div_32(i * (i + 1), 2);
        real *row = p->system[i];
        for (int32_t j = 0, j_end = p->dims + 1; j < j_end; j++) {
            real total = row[j];
            for (int32_t k = 0; k < i; k++) {
                total -= p->covariance[first + k] * p->system[k][j];
            }
            row[j] = total / p->covariance[first + i];
        }
    }
}

/* Solve (N + damping·diag N)·step = gradient. Returns False if the matrix is singular. */
INTERNAL bool find_damped_step(LocateProblem *p, real damping) {
    int32_t gradient = floor_div_32(p->dims * (p->dims + 1), 2);
    for (int32_t k = 0; k < gradient; k++) {
        p->factor[k] = p->normal[k];
    }
    for (int32_t j = 0, j_end = p->dims; j < j_end; j++) {
        p->factor[floor_div_32(j * (j + 3), 2)] *= REAL(1.0) + damping;
        p->step[j] = p->normal[gradient + j];
    }
    if (!factorise(p->factor, p->dims)) {
        return false;
    }
    solve(p->factor, p->dims, p->step);
    return true;
}

/* Whether the state has diverged or is NaN. */
INTERNAL bool is_far(LocateProblem *p) {
    for (int32_t j = 0, j_end = p->dims; j < j_end; j++) {
        real reach = abs_real(p->state[j]) / p->scale[j];
        if (!((p->kind == PLANE && j == 2 ? SQRT(reach) : reach) < FAR_EXTENTS)) {
            return true;
        }
    }
    return false;
}

/* Next damping after a success, from the ratio of the actual to the predicted gain (H. B. Nielsen 1999). */
INTERNAL real eased(real damping, real ratio) {
    if (ratio < REAL(0.5)) {
        damping = max_real(damping, FIRST_DAMPING);
    }
    real excess = REAL(2.0) * ratio - REAL(1.0);
    real eased = damping * max_real(REAL(1.0) / REAL(3.0), REAL(1.0) - excess * excess * excess);
    return eased > MIN_DAMPING ? eased : REAL(0.0);
}

/* The equations are not weighted. */

/* Add the closed-form solutions as starting points. */
INTERNAL void add_algebraic_starts(LocateProblem *p) {
    int32_t coordinates = p->kind == FREE ? 3 : 2;
    if (p->kind != PLANE) {
        add_intersections(p, coordinates);
    }
    if (p->anchors - 1 > coordinates) {
        add_interpolation(p, coordinates);
    }
    if (p->kind == FREE) {
        add_interpolation(p, 2);
    }
}

/* Add the points x = u − v·ρ for each non-negative root ρ of |x|² = ρ².
 *
 * If noise leaves no real root, the parabola's vertex is used. The roots are computed without cancellation. */
INTERNAL void add_intersections(LocateProblem *p, int32_t coordinates) {
    Equations e = {0};
    fill(p, &e, coordinates, false);
    if (!(least_squares(&e.left, e.right, e.u) && least_squares(&e.left, p->tdoa_m, e.v))) {
        return;
    }
    real height_m = given_height_m(p);
    real a = -REAL(1.0);
    real half_b = REAL(0.0);
    real c = height_m * height_m;
    for (int32_t k = 0; k < coordinates; k++) {
        a += e.v[k] * e.v[k];
        half_b -= e.u[k] * e.v[k];
        c += e.u[k] * e.u[k];
    }
    real discriminant = half_b * half_b - a * c;
    if (discriminant < REAL(0.0)) {
        add_at_distance(p, &e, -half_b / a);
    } else {
        real root = SQRT(discriminant);
        real larger = half_b >= REAL(0.0) ? -half_b - root : root - half_b;
        if (a != REAL(0.0)) {
            add_at_distance(p, &e, larger / a);
        }
        if (larger != REAL(0.0)) {
            add_at_distance(p, &e, c / larger);
        }
    }
}

INTERNAL void add_at_distance(LocateProblem *p, Equations *e, real distance_m) {
    if (distance_m >= REAL(0.0)) {
        real x = e->u[0] - e->v[0] * distance_m;
        real y = e->u[1] - e->v[1] * distance_m;
        add(p, x, y, p->kind == HEIGHT ? given_height_m(p) : e->u[2] - e->v[2] * distance_m);
    }
}

/* Add the solution for these coordinates and ρ; with two of three coordinates, both points at the distance ρ. */
INTERNAL void add_interpolation(LocateProblem *p, int32_t coordinates) {
    Equations e = {0};
    fill(p, &e, coordinates, true);
    if (!least_squares(&e.left, e.right, e.u)) {
        return;
    }
    real x = e.u[0];
    real y = e.u[1];
    real square_across = e.u[2] * e.u[2] - x * x - y * y;
    if (p->kind == HEIGHT) {
        add(p, x, y, given_height_m(p));
    } else if (p->kind == PLANE) {
        add(p, x, y, square_across);
    } else if (coordinates == 3) {
        add(p, x, y, e.u[2]);
    } else {
        real across_m = SQRT(max_real(square_across, REAL(0.0)));
        add(p, x, y, across_m);
        add(p, x, y, -across_m);
    }
}

/* Write the equations for these coordinates and, if ``has_distance``, for ρ. */
INTERNAL void fill(LocateProblem *p, Equations *e, int32_t coordinates, bool has_distance) {
    Columns *m = &e->left;
    m->rows = p->anchors - 1;
    m->columns = coordinates + (has_distance ? 1 : 0);
    for (int32_t i = 0, i_end = m->rows; i < i_end; i++) {
        real *anchor = p->anchors_m[i + 1];
        real square = anchor[0] * anchor[0] + anchor[1] * anchor[1] + anchor[2] * anchor[2];
        e->right[i] = REAL(0.5) * (square - p->tdoa_m[i] * p->tdoa_m[i]) - anchor[2] * given_height_m(p);
        m->A[i][coordinates] = p->tdoa_m[i];
        for (int32_t k = 0; k < coordinates; k++) {
            m->A[i][k] = anchor[k];
        }
    }
    orthogonalise(m);
}

/* The given height relative to the reference anchor; 0 if none is given. */
INTERNAL real given_height_m(LocateProblem *p) {
    return p->kind == HEIGHT ? p->height_m - p->origin_m[2] : REAL(0.0);
}

/* Add the anchors' centroid; if the height is unknown, shifted off their plane by half their extent. */
INTERNAL void add_central_starts(LocateProblem *p) {
    real x = REAL(0.0);
    real y = REAL(0.0);
    real z = REAL(0.0);
    real off_m = REAL(0.5) * p->extent_m;
    for (int32_t i = 0, i_end = p->anchors; i < i_end; i++) {
        x += p->anchors_m[i][0] / (real)p->anchors;
        y += p->anchors_m[i][1] / (real)p->anchors;
        z += p->anchors_m[i][2] / (real)p->anchors;
    }
    if (p->kind == FREE) {
        add(p, x, y, z + off_m);
        add(p, x, y, z - off_m);
    } else {
        add(p, x, y, p->kind == HEIGHT ? given_height_m(p) : off_m * off_m);
    }
}

/* Add the mirror image of the state in the anchors' least-squares line or plane; a given height stays. */
INTERNAL void add_image(LocateProblem *p) {
    Columns m = {0};
    m.rows = p->anchors;
    m.columns = p->dims;
    real off_m = REAL(0.0);
    for (int32_t k = 0, k_end = p->dims; k < k_end; k++) {
        real mean = REAL(0.0);
        for (int32_t i = 0, i_end = p->anchors; i < i_end; i++) {
            mean += p->anchors_m[i][k] / (real)p->anchors;
        }
        for (int32_t i = 0, i_end = p->anchors; i < i_end; i++) {
            m.A[i][k] = p->anchors_m[i][k] - mean;
        }
        p->trial[k] = p->state[k] - mean;
    }
    orthogonalise(&m);
    int32_t across = p->dims - 1;
    for (int32_t k = 0, k_end = p->dims; k < k_end; k++) {
        off_m += m.V[k][across] * p->trial[k];
    }
    for (int32_t k = 0, k_end = p->dims; k < k_end; k++) {
        p->trial[k] = p->state[k] - REAL(2.0) * off_m * m.V[k][across];
    }
    add(p, p->trial[0], p->trial[1], p->kind == HEIGHT ? p->state[2] : p->trial[2]);
}

INTERNAL void add(LocateProblem *p, real x, real y, real z) {
    real *start = p->starts[p->start_count];
    start[0] = x;
    start[1] = y;
    start[2] = z;
    p->start_count += 1;
}

/* Two minima are distinct if one lies outside the 3-sigma ellipsoid of the other. */

/* Fill ``minima``, the best first. Returns how the last failed iteration ended, ``CONVERGED`` if none failed.
 *
 * The closed-form starts depend on the reference and miss about one rival in a hundred. The anchors' centroid finds
 * most of these, and the mirror image of a minimum the rest, where anchors are nearly collinear or coplanar. */
INTERNAL int32_t find_minima(LocateProblem *p) {
    add_algebraic_starts(p);
    add_central_starts(p);
    int32_t status = CONVERGED;
    int32_t start = 0;
    while (start < p->start_count) {
        for (int32_t k = 0; k < 3; k++) {
            p->state[k] = p->starts[start][k];
        }
        start += 1;
        int32_t end = descend(p);
        if (end != CONVERGED) {
            status = end;
        } else if (!is_found(p)) {
            if (p->kind != PLANE && p->minimum_count == 0 && p->start_count < MAX_STARTS) {
                add_image(p);
            }
            assess(p);
        }
    }
    return status;
}

/* Whether the state is at a minimum that was found before. */
INTERNAL bool is_found(LocateProblem *p) {
    for (int32_t index_ = 0, index__end = p->minimum_count; index_ < index__end; index_++) {
        real apart = REAL(0.0);
        for (int32_t j = 0, j_end = p->dims; j < j_end; j++) {
            apart += abs_real(p->minima[index_].state[j] - p->state[j]) / p->scale[j];
        }
        if (apart < SAME_POINT) {
            return true;
        }
    }
    return false;
}

/* Insert the minimum at the state, unless it is singular.
 *
 * Its covariance is G·Σ·Gᵀ with the estimator's G: (HᵀΣ⁻¹H)⁻¹HᵀΣ⁻¹ or, unweighted, (HᵀH)⁻¹Hᵀ. */
INTERNAL void assess(LocateProblem *p) {
    Minimum found = {0};
    found.iterations = p->iterations;
    found.cost = assemble(p, p->state, p->normal);
    for (int32_t k = 0, k_end = floor_div_32(p->dims * (p->dims + 1), 2); k < k_end; k++) {
        p->factor[k] = p->normal[k];
    }
    if (!factorise(p->factor, p->dims)) {
        return;
    }
    for (int32_t j = 0; j < 3; j++) {
        found.state[j] = p->state[j];
    }
    for (int32_t i = 0, i_end = p->anchors - 1; i < i_end; i++) {
        find_gain(p, i);
        int32_t element = 0;
        for (int32_t j = 0, j_end = p->dims; j < j_end; j++) {
            for (int32_t k = 0; k < j + 1; k++) {
                found.covariance[element] += p->step[j] * p->step[k];
                element += 1;
            }
        }
    }
    if (!(found.covariance[floor_div_32(p->dims * (p->dims + 1), 2) - 1] > REAL(0.0))) {  /* underflow */
        return;
    }
    if (!p->is_weighted) {
        whiten_system(p);
    }
    for (int32_t i = 0, i_end = p->anchors - 1; i < i_end; i++) {
        found.chi2 += p->system[i][p->dims] * p->system[i][p->dims];
    }
    int32_t index_ = p->minimum_count;
    while (index_ > 0 && p->minima[index_ - 1].cost > found.cost) {
        p->minima[index_] = p->minima[index_ - 1];
        index_ -= 1;
    }
    p->minima[index_] = found;
    p->minimum_count += 1;
}

/* Write a column of G·L into ``step``; if weighted, ``system`` is L⁻¹·H. */
INTERNAL void find_gain(LocateProblem *p, int32_t index_) {
    for (int32_t j = 0, j_end = p->dims; j < j_end; j++) {
        if (p->is_weighted) {
            p->step[j] = p->system[index_][j];
        } else {
            p->step[j] = REAL(0.0);
            for (int32_t i = index_, i_end = p->anchors - 1; i < i_end; i++) {
                p->step[j] += p->system[i][j] * p->covariance[floor_div_32(i * (i + 1), 2) + index_];
            }
        }
    }
    solve(p->factor, p->dims, p->step);
}

/* Keep the best minimum and the distinct ones that explain the TDoAs about as well. */
INTERNAL void keep_rivals(LocateProblem *p) {
    int32_t kept = 1;
    Minimum *best = &p->minima[0];
    for (int32_t index_ = 1, index__end = p->minimum_count; index_ < index__end; index_++) {
        Minimum *other = &p->minima[index_];
        if (other->chi2 <= best->chi2 + RIVAL_MINIMUM_CHI2 && (is_outside(p, best, other->state) || is_outside(p, other,
                best->state))) {
            p->minima[kept] = p->minima[index_];
            kept += 1;
        }
    }
    p->minimum_count = kept;
}

/* Whether a state lies outside a minimum's error ellipsoid. */
INTERNAL bool is_outside(LocateProblem *p, Minimum *minimum, real *state) {
    for (int32_t k = 0, k_end = floor_div_32(p->dims * (p->dims + 1), 2); k < k_end; k++) {
        p->factor[k] = minimum->covariance[k];
    }
    for (int32_t j = 0, j_end = p->dims; j < j_end; j++) {
        p->step[j] = state[j] - minimum->state[j];
    }
    if (!factorise(p->factor, p->dims)) {
        return true;
    }
    solve_lower(p->factor, p->dims, p->step);
    real chi2 = REAL(0.0);
    for (int32_t j = 0, j_end = p->dims; j < j_end; j++) {
        chi2 += p->step[j] * p->step[j];
    }
    return !(chi2 <= DISTINCT_MINIMA_CHI2);
}

/* Position from one set of TDoAs: choice among the search's minima, and ``locate``, the Python function. */

/* Mirror images have merged if their squared distance from the plane is within these sigmas of zero. */

/* Locate a tag by finite TDoAs. Returns ``FOUND`` or the reason for no position.
 *
 * Needs 4 anchors, or 3 with a given height. Overwrites the problem. */
SKYLESS_EXPORT int32_t skyless_find_position(LocateProblem *p, Found *found) {
    p->start_count = 0;
    p->minimum_count = 0;
    if (!factorise(p->covariance, p->anchors - 1)) {
        return NO_COVARIANCE;
    }
    if (!choose_axes(p)) {
        return COLLINEAR_ANCHORS;
    }
    int32_t status = find_minima(p);
    if (p->minimum_count == 0) {
        return why_none(p, status);
    }
    Minimum *best = &p->minima[0];
    found->dof = p->anchors - 1 - p->dims;
    real below = p->kind == PLANE ? below_plane(best) : REAL(0.0);
    found->chi2 = best->chi2 + below;
    int32_t dof = max_32(found->dof + (below > REAL(0.0) ? 1 : 0), 1);  /* with no redundancy, residuals are zero unless nothing fits at all */
    if (chi2_tail(dof, found->chi2) < p->residual_tail) {
        return RESIDUALS;
    }
    if (p->kind == PLANE) {
        fill_residuals(p, found, best);
        unfold(p);
    } else {
        keep_rivals(p);
    }
    return decide(p, found);
}

/* The reason if no iteration ended in a minimum. */
INTERNAL int32_t why_none(LocateProblem *p, int32_t status) {
    for (int32_t i = 0, i_end = p->anchors - 1; i < i_end; i++) {
        real *anchor = p->anchors_m[i + 1];
        real baseline_m = SQRT(anchor[0] * anchor[0] + anchor[1] * anchor[1] + anchor[2] * anchor[2]);
        if (abs_real(p->tdoa_m[i]) > baseline_m + IMPOSSIBLE_SIGMAS * sigma_m(p, i)) {
            return IMPOSSIBLE;
        }
    }
    return status == EXHAUSTED ? UNSETTLED : SINGULAR;
}

/* Anchors in a plane */

/* Contribution of the constraint s ≥ 0 to chi2: s²/σ_s² if s is negative. */
INTERNAL real below_plane(Minimum *minimum) {
    real s = minimum->state[2];
    return s < REAL(0.0) ? s * s / minimum->covariance[5] : REAL(0.0);
}

/* Convert s = w² to w: two mirror images, or one point in the plane if s is not distinguishable from 0. */
INTERNAL void unfold(LocateProblem *p) {
    Minimum *best = &p->minima[0];
    Minimum *image = &p->minima[1];
    real s = best->state[2];
    real sigma = SQRT(best->covariance[5]);
    p->minimum_count = 1;
    if (s < MERGED_SIGMAS * sigma) {
        best->state[2] = REAL(0.0);
        best->covariance[3] = REAL(0.0);
        best->covariance[4] = REAL(0.0);
        best->covariance[5] = mean_if_positive(s, sigma);
        return;
    }
    real w = SQRT(s);
    best->state[2] = w;
    best->covariance[3] *= REAL(0.5) / w;
    best->covariance[4] *= REAL(0.5) / w;
    best->covariance[5] *= REAL(0.25) / s;
    p->minima[1] = p->minima[0];
    image->state[2] = -w;
    image->covariance[3] = -image->covariance[3];
    image->covariance[4] = -image->covariance[4];
    p->minimum_count = 2;
}

/* Decision */

/* Choose among rivals by the height bounds, and reject what stays ambiguous or too uncertain. */
INTERNAL int32_t decide(LocateProblem *p, Found *found) {
    int32_t chosen = 0;
    if (p->minimum_count > 1) {
        found->has_mirror = true;
        fill_position(p, &p->minima[0], found->position_m);
        fill_position(p, &p->minima[1], found->mirror_m);
        chosen = chosen_by_height(p);
        if (chosen < 0) {
            return MIRROR;
        }
        if (chosen > 0) {
            fill_position(p, &p->minima[0], found->mirror_m);
        }
    }
    Minimum *minimum = &p->minima[chosen];
    fill_position(p, minimum, found->position_m);
    real trace_m2 = REAL(0.0);
    real distance_m = REAL(0.0);
    for (int32_t a = 0; a < 3; a++) {
        for (int32_t b = 0; b < 3; b++) {
            found->covariance_m2[a][b] = site_covariance(p, minimum, a, b);
        }
        trace_m2 += found->covariance_m2[a][a];
        distance_m += abs_real(minimum->state[a]);
    }
    if (!(trace_m2 < (p->extent_m + distance_m) * (p->extent_m + distance_m))) {
        return UNCERTAIN;
    }
    if (p->kind != PLANE) {
        fill_residuals(p, found, minimum);
    }
    found->chi2 = minimum->chi2;
    found->iterations = minimum->iterations;
    return FOUND;
}

/* The only position within the height bounds, else the one that exceeds them least and by little; −1 if none. */
INTERNAL int32_t chosen_by_height(LocateProblem *p) {
    int32_t chosen = -1;
    int32_t equals = 0;
    real least_m = REAL(0.0);
    if (!p->has_bounds) {
        return chosen;
    }
    for (int32_t index_ = 0, index__end = p->minimum_count; index_ < index__end; index_++) {
        real z = site_coordinate(p, &p->minima[index_], 2);
        real excess_m = max_real(max_real(p->low_m - z, z - p->high_m), REAL(0.0));
        if (chosen < 0 || excess_m < least_m) {
            chosen = index_;
            equals = 1;
            least_m = excess_m;
        } else if (excess_m == least_m) {
            equals += 1;
        }
    }
    real variance_m2 = max_real(site_covariance(p, &p->minima[chosen], 2, 2), REAL(0.0));
    return equals > 1 || least_m > BOUND_SIGMAS * SQRT(variance_m2) ? -1 : chosen;
}

INTERNAL void fill_position(LocateProblem *p, Minimum *minimum, real *position_m) {
    for (int32_t k = 0; k < 3; k++) {
        position_m[k] = site_coordinate(p, minimum, k);
    }
}

/* A coordinate of a minimum in the site frame. */
INTERNAL real site_coordinate(LocateProblem *p, Minimum *minimum, int32_t k) {
    real total = p->origin_m[k];
    for (int32_t j = 0; j < 3; j++) {
        total += p->axes[j][k] * minimum->state[j];
    }
    return total;
}

/* An element of a minimum's covariance in the site frame. */
INTERNAL real site_covariance(LocateProblem *p, Minimum *minimum, int32_t a, int32_t b) {
    real total = REAL(0.0);
    for (int32_t j = 0; j < 3; j++) {
        for (int32_t k = 0; k < 3; k++) {
            int32_t one = max_32(j, k);
            int32_t other = min_32(j, k);
            total += p->axes[j][a] * minimum->covariance[floor_div_32(one * (one + 1), 2) + other] * p->axes[k][b];
        }
    }
    return total;
}

INTERNAL void fill_residuals(LocateProblem *p, Found *found, Minimum *minimum) {
    linearise(p, minimum->state);
    for (int32_t i = 0, i_end = p->anchors - 1; i < i_end; i++) {
        found->residuals_m[i] = p->system[i][p->dims];
    }
}

/* Cold start: the tag's first position, from packets alone and without an initial guess.
 *
 * When anchor i relays its reception of a packet of anchor j that the tag received too, the offset between the two
 * anchors' clocks at that moment is known up to noise. Along such links all TX times are converted to the clock of one
 * anchor. The tag's clock is up to 20 ppm off, so pseudoranges drift by tens of metres within one superframe. Two packets
 * of the same anchor measure that drift; the newest pseudoranges of all anchors are then propagated to a common time and
 * solved in closed form. */

/* Forget all packets. */
INTERNAL void forget_all(Acquisition *q) {
    q->link_count = 0;
    q->count = 0;
}

/* Forget an anchor's packets and links. */
INTERNAL void forget_packets(Acquisition *q, int32_t anchor) {
    int32_t place = find_heard(q, anchor);
    if (place >= 0) {
        remove_heard(q, place);
    }
    int32_t kept = 0;
    for (int32_t one = 0, one_end = q->link_count; one < one_end; one++) {
        if (q->links[one].listener != anchor && q->links[one].sender != anchor) {
            q->links[kept] = q->links[one];
            kept += 1;
        }
    }
    q->link_count = kept;
}

/* Add a packet and, if its anchor was heard before, try to start.
 *
 * Returns ``FOUND`` if ``q.start`` is a start, otherwise the reason why not. */
INTERNAL int32_t try_start(Acquisition *q, Packet *packet, Relays *relays) {
    int64_t now = packet->rx_ticks;
    int32_t anchor = packet->place.anchor;
    forget_old_packets(q, now);
    bool came_around = gather_packet(q, packet, relays);
    choose_pairs(q, now);
    put_on_one_scale(q, now);
    drop_impossible(q, now);
    int32_t needed = q->knows_height ? 3 : 4;
    if (q->pair_count < needed) {
        return q->count < needed ? TOO_FEW_ANCHORS : ACQUIRING;
    }
    bool is_first = anchor_of(q, 0) == anchor;
    if (!came_around || (q->pair_count == q->rival_count && !is_first)) {
        return q->rival_count > 0 ? MIRROR : ACQUIRING;
    }
    int32_t reason = solve_start(q, -1, now, q->tuning.start_tail);
    q->rival_count = reason == MIRROR ? q->pair_count : 0;
    if (reason == FOUND) {
        if (!is_wide(q)) {
            return FOUND;
        }
        if (!q->has_been_wide) {
            q->has_been_wide = true;
            q->wide_ticks = q->start.rx_ticks_tag;
        }
        return is_worth_waiting(q) ? ACQUIRING : FOUND;
    }
    if (reason == MIRROR || q->pair_count <= needed + 1 || !is_first) {
        return reason;
    }
    return solve_without_one(q, now);
}

/* Packets and links */

INTERNAL int32_t find_heard(Acquisition *q, int32_t anchor) {
    for (int32_t place = 0, place_end = q->count; place < place_end; place++) {
        if (q->heard[place].newer.packet.place.anchor == anchor) {
            return place;
        }
    }
    return -1;
}

INTERNAL void remove_heard(Acquisition *q, int32_t place) {
    q->count -= 1;
    for (int32_t one = place, one_end = q->count; one < one_end; one++) {
        q->heard[one] = q->heard[one + 1];
    }
}

INTERNAL void forget_old_packets(Acquisition *q, int64_t now) {
    for (int32_t place = q->count - 1; place > -1; place--) {
        if ((real)(now - q->heard[place].newer.packet.rx_ticks) * TICK_S > q->max_age_s) {
            remove_heard(q, place);
        }
    }
}

/* Keep a packet without trying to start. Returns True if two packets of its anchor were kept already.
 *
 * If the table is full, a new anchor replaces the one that has not fitted the others for longest. */
INTERNAL bool gather_packet(Acquisition *q, Packet *packet, Relays *relays) {
    add_links(q, packet, relays);
    int32_t place = find_heard(q, packet->place.anchor);
    if (place < 0) {
        if (q->count == MAX_ANCHORS) {
            remove_heard(q, longest_unfitting(q));
        }
        place = q->count;
        q->count += 1;
        q->heard[place].count = 0;
        q->heard[place].fitted_ticks = NEVER;
    }
    HeardAnchor *one = &q->heard[place];
    bool had_two = one->count == 2;
    if (one->count > 0) {
        one->older = one->newer;
    }
    one->newer.packet = *packet;
    one->newer.relay_count = min_32(relays->count, RELAYS_KEPT);
    for (int32_t relayed = 0, relayed_end = one->newer.relay_count; relayed < relayed_end; relayed++) {
        one->newer.relays[relayed] = relays->rows[relayed];
    }
    one->count = min_32(one->count + 1, 2);
    return had_two;
}

INTERNAL int32_t longest_unfitting(Acquisition *q) {
    int32_t longest = 0;
    for (int32_t place = 1, place_end = q->count; place < place_end; place++) {
        if (q->heard[place].fitted_ticks < q->heard[longest].fitted_ticks) {
            longest = place;
        }
    }
    return longest;
}

/* Keep the relays that concern packets the tag has received itself. */
INTERNAL void add_links(Acquisition *q, Packet *packet, Relays *relays) {
    for (int32_t index_ = 0, index__end = relays->count; index_ < index__end; index_++) {
        Relay *relayed = &relays->rows[index_];
        int32_t place = find_heard(q, relayed->anchor);
        if (place >= 0) {
            if (q->heard[place].newer.packet.sequence == relayed->sequence) {
                add_link(q, packet, &q->heard[place].newer.packet, relayed);
            } else if (q->heard[place].count == 2 && q->heard[place].older.packet.sequence == relayed->sequence) {
                add_link(q, packet, &q->heard[place].older.packet, relayed);
            }
        }
    }
}

INTERNAL void add_link(Acquisition *q, Packet *listener, Packet *sent, Relay *relayed) {
    int64_t rx_ticks = relay_rx_ticks(relayed, listener->tx_ticks, listener->rx_ticks - sent->rx_ticks);
    real total = REAL(0.0);
    for (int32_t axis = 0; axis < 3; axis++) {
        total += square(listener->place.position_m[axis] - sent->place.position_m[axis]);
    }
    int32_t index_ = 0;
    while (index_ < q->link_count && !(q->links[index_].listener == listener->place.anchor && q->links[index_].sender ==
            sent->place.anchor)) {
        index_ += 1;
    }
    if (index_ == MAX_LINKS) {
        index_ = oldest_link(q);
    }
    q->link_count = max_32(q->link_count, index_ + 1);
    ClockLink *link = &q->links[index_];
    link->listener = listener->place.anchor;
    link->sender = sent->place.anchor;
    link->rx_ticks_tag = sent->rx_ticks;
    const int64_t new_1 = rx_ticks - sent->tx_ticks;
    const real new_2 = -SQRT(total) / TICK_M;
    link->ticks = new_1;
    link->fraction_ticks = new_2;
}

INTERNAL int32_t oldest_link(Acquisition *q) {
    int32_t oldest = 0;
    for (int32_t index_ = 1, index__end = q->link_count; index_ < index__end; index_++) {
        if (q->links[index_].rx_ticks_tag < q->links[oldest].rx_ticks_tag) {
            oldest = index_;
        }
    }
    return oldest;
}

INTERNAL void forget_links_before(Acquisition *q, int64_t now) {
    int32_t kept = 0;
    for (int32_t one = 0, one_end = q->link_count; one < one_end; one++) {
        if ((real)(now - q->links[one].rx_ticks_tag) * TICK_S < REAL(2.0) * q->max_age_s) {
            q->links[kept] = q->links[one];
            kept += 1;
        }
    }
    q->link_count = kept;
}

/* Choose the anchors with two packets of which the newer is recent. */
INTERNAL void choose_pairs(Acquisition *q, int64_t now) {
    q->pair_count = 0;
    for (int32_t place = 0, place_end = q->count; place < place_end; place++) {
        real age_s = (real)(now - q->heard[place].newer.packet.rx_ticks) * TICK_S;
        if (q->heard[place].count == 2 && age_s < q->start_age_s) {
            q->pairs[q->pair_count] = place;
            q->pair_count += 1;
        }
    }
}

INTERNAL int32_t anchor_of(Acquisition *q, int32_t pair) {
    return q->heard[q->pairs[pair]].newer.packet.place.anchor;
}

/* One scale for all TX times */

/* Convert TX times to the clock of the anchor that reaches most others; leave the others out. */
INTERNAL void put_on_one_scale(Acquisition *q, int64_t now) {
    for (int32_t pair = 0, pair_end = q->pair_count; pair < pair_end; pair++) {
        HeardAnchor *one = &q->heard[q->pairs[pair]];
        measure_rate(q, pair, &one->older.packet, &one->newer.packet);
    }
    forget_links_before(q, now);
    q->best.count = 0;
    for (int32_t pair = 0, pair_end = q->pair_count; pair < pair_end; pair++) {
        if (q->best.count == 0 || q->best.is_reached[pair] == 0) {  /* it would reach the same anchors as before */
            reach_from(q, pair);
            if (q->reach.count > q->best.count) {
                q->best = q->reach;
            }
        }
    }
    int32_t kept = 0;
    for (int32_t pair = 0, pair_end = q->pair_count; pair < pair_end; pair++) {
        HeardAnchor *one = &q->heard[q->pairs[pair]];
        if (q->best.is_reached[pair] == 1) {
            convert(q, pair, &one->older);
            convert(q, pair, &one->newer);
            q->clock_rates_mps[kept] = clock_rate_mps(one);
            q->pairs[kept] = q->pairs[pair];
            kept += 1;
        }
    }
    q->pair_count = kept;
}

INTERNAL void measure_rate(Acquisition *q, int32_t pair, Packet *first, Packet *second) {
    int64_t elapsed = second->rx_ticks - first->rx_ticks;
    q->rate_variances[pair] = REAL(0.0);
    q->rates[pair] = REAL(0.0);
    if (elapsed > 0) {
        q->rates[pair] = (real)(second->tx_ticks - first->tx_ticks - elapsed) / (real)elapsed;
        q->rate_variances[pair] = REAL(2.0) * q->variance_m2 / square((real)elapsed * TICK_S);
    }
}

/* Build the tree of links from ``reference`` to every anchor it reaches, each by the fewest links. */
INTERNAL void reach_from(Acquisition *q, int32_t reference) {
    Reach *r = &q->reach;
    for (int32_t pair = 0, pair_end = q->pair_count; pair < pair_end; pair++) {
        r->is_reached[pair] = 0;
    }
    r->count = 1;
    r->order[0] = reference;
    r->is_reached[reference] = 1;
    r->parent[reference] = -1;
    int32_t next_one = 0;
    while (next_one < r->count) {
        int32_t known = r->order[next_one];
        int32_t anchor = anchor_of(q, known);
        for (int32_t index_ = 0, index__end = q->link_count; index_ < index__end; index_++) {
            ClockLink *link = &q->links[index_];
            bool is_listener = link->listener == anchor;
            if (is_listener || link->sender == anchor) {
                int32_t other = find_pair(q, is_listener ? link->sender : link->listener);
                if (other >= 0 && r->is_reached[other] == 0) {
                    r->is_reached[other] = 1;
                    r->parent[other] = known;
                    r->link[other] = index_;
                    r->sign[other] = is_listener ? 1 : -1;
                    r->order[r->count] = other;
                    r->count += 1;
                }
            }
        }
        next_one += 1;
    }
}

INTERNAL int32_t find_pair(Acquisition *q, int32_t anchor) {
    for (int32_t pair = 0, pair_end = q->pair_count; pair < pair_end; pair++) {
        if (anchor_of(q, pair) == anchor) {
            return pair;
        }
    }
    return -1;
}

/* Convert a packet's TX time to the reference clock; each link is propagated with the two clocks' rates. */
INTERNAL void convert(Acquisition *q, int32_t pair, HeardPacket *one) {
    Reach *r = &q->best;
    int64_t rx_ticks = one->packet.rx_ticks;
    int64_t ticks = one->packet.tx_ticks;
    real fraction = REAL(0.0);
    real variance_m2 = REAL(0.0);
    int32_t place = pair;
    while (r->parent[place] >= 0) {
        ClockLink *link = &q->links[r->link[place]];
        int32_t parent = r->parent[place];
        int64_t elapsed = rx_ticks - link->rx_ticks_tag;
        ticks += r->sign[place] * link->ticks;
        fraction += (real)r->sign[place] * link->fraction_ticks + (q->rates[parent] - q->rates[place]) * (real)elapsed;
        real rate_variance = q->rate_variances[parent] + q->rate_variances[place];
        variance_m2 += REAL(2.0) * q->variance_m2 + rate_variance * square((real)elapsed * TICK_S);
        place = parent;
    }
    int64_t whole = floor_real(fraction);
    one->scaled.ticks = ticks + whole;
    one->scaled.fraction_ticks = fraction - (real)whole;
    one->scaled.variance_m2 = variance_m2;
}

/* Rate of the tag's clock against the common scale in m/s, from two packets; c if they are out of order. */
INTERNAL real clock_rate_mps(HeardAnchor *one) {
    int64_t elapsed = one->newer.packet.rx_ticks - one->older.packet.rx_ticks;
    if (elapsed <= 0) {
        return SPEED_OF_LIGHT_MPS;
    }
    int64_t change_ticks = elapsed - (one->newer.scaled.ticks - one->older.scaled.ticks);
    real change_m = ((real)change_ticks - (one->newer.scaled.fraction_ticks - one->older.scaled.fraction_ticks)) *
            TICK_M;
    return change_m / ((real)elapsed * TICK_S);
}

/* Drop pairs of packets whose clock rate no crystal can have. */
INTERNAL void drop_impossible(Acquisition *q, int64_t now) {
    int32_t kept = 0;
    for (int32_t pair = 0, pair_end = q->pair_count; pair < pair_end; pair++) {
        if (abs_real(q->clock_rates_mps[pair]) <= MAX_DRIFT * SPEED_OF_LIGHT_MPS) {
            q->clock_rates_mps[kept] = q->clock_rates_mps[pair];
            q->pairs[kept] = q->pairs[pair];
            q->heard[q->pairs[kept]].fitted_ticks = now;
            kept += 1;
        }
    }
    q->pair_count = kept;
}

/* Positions */

/* Locate the tag from the newest packets of all pairs but ``left_out`` (−1: all). Returns ``FOUND`` or a reason. */
INTERNAL int32_t solve_start(Acquisition *q, int32_t left_out, int64_t now, real residual_tail) {
    if (q->pair_count < 3 + (left_out >= 0 ? 1 : 0)) {
        return TOO_FEW_ANCHORS;
    }
    Start *start = &q->start;
    int32_t count = 0;
    real shortest_s = q->max_age_s;
    for (int32_t pair = 0, pair_end = q->pair_count; pair < pair_end; pair++) {
        if (pair != left_out) {
            HeardAnchor *one = &q->heard[q->pairs[pair]];
            real rate_mps = clock_rate_mps(one);
            int32_t place = count;
            while (place > 0 && q->clock_rates_mps[place - 1] > rate_mps) {
                q->clock_rates_mps[place] = q->clock_rates_mps[place - 1];
                place -= 1;
            }
            q->clock_rates_mps[place] = rate_mps;
            shortest_s = min_real(shortest_s, (real)(one->newer.packet.rx_ticks - one->older.packet.rx_ticks) * TICK_S);
            start->used[count] = q->pairs[pair];
            count += 1;
        }
    }
    real median_mps = REAL(0.5) * (q->clock_rates_mps[floor_div_32(count, 2)] + q->clock_rates_mps[floor_div_32(count -
            1, 2)]);
    real rate_variance = REAL(2.0) * q->variance_m2 / square(shortest_s) + square(q->speed_std_mps);
    HeardPacket *reference = &q->heard[start->used[0]].newer;
    int64_t base_ticks = reference->packet.rx_ticks - reference->scaled.ticks;
    for (int32_t index_ = 0; index_ < count; index_++) {
        HeardPacket *newest = &q->heard[start->used[index_]].newer;
        real age_s = (real)(now - newest->packet.rx_ticks) * TICK_S;
        int64_t whole = newest->packet.rx_ticks - newest->scaled.ticks - base_ticks;
        q->ranges_m[index_] = ((real)whole - newest->scaled.fraction_ticks) * TICK_M + median_mps * age_s;
        real aged_m2 = square(age_s) * (rate_variance / (real)count + square(q->speed_std_mps));
        real stamps_m2 = newest->packet.variance_factor * q->variance_m2 + newest->scaled.variance_m2;
        q->variances_m2[index_] = stamps_m2 + q->error_variance_m2 + aged_m2;
    }
    int32_t reason = locate(q, count, residual_tail);
    if (reason == FOUND) {
        start->count = count;
        start->rx_ticks_tag = now;
        start->has_misfit = false;
        start->is_contradicted = false;
        for (int32_t axis = 0; axis < 3; axis++) {
            start->position_m[axis] = q->found.position_m[axis];
            for (int32_t other = 0; other < 3; other++) {
                start->covariance_m2[axis][other] = q->found.covariance_m2[axis][other];
            }
        }
    }
    return reason;
}

/* Locate the tag from differences to the first pseudorange, whose variance they share. */
INTERNAL int32_t locate(Acquisition *q, int32_t count, real residual_tail) {
    LocateProblem *p = &q->problem;
    p->anchors = count;
    p->knows_height = q->knows_height;
    p->height_m = q->height_m;
    p->is_weighted = true;
    p->has_bounds = q->has_bounds;
    p->low_m = q->low_m;
    p->high_m = q->high_m;
    p->residual_tail = residual_tail;
    for (int32_t i = 0; i < count; i++) {
        Place *place = &q->heard[q->start.used[i]].newer.packet.place;
        real difference_m = q->ranges_m[i] - q->ranges_m[0];
        bool is_usable = abs_real(difference_m) < LARGEST && (REAL(0.0) < q->variances_m2[i] && q->variances_m2[i] <
                LARGEST);
        for (int32_t axis = 0; axis < 3; axis++) {
            p->anchors_m[i][axis] = place->position_m[axis];
            is_usable = is_usable && abs_real(place->position_m[axis]) < LARGEST;
        }
        if (!is_usable) {
            return UNUSABLE;
        }
        if (i > 0) {
            p->tdoa_m[i - 1] = difference_m;
            int32_t row = floor_div_32((i - 1) * i, 2);
            for (int32_t j = 0; j < i; j++) {
                p->covariance[row + j] = q->variances_m2[0] + (j == i - 1 ? q->variances_m2[i] : REAL(0.0));
            }
        }
    }
    return skyless_find_position(p, &q->found);
}

/* Whether the curvature of the ranges within the start's standard deviation exceeds their noise.
 *
 * The linearised updates would then make the filter overconfident in a wrong position. */
INTERNAL bool is_wide(Acquisition *q) {
    Start *start = &q->start;
    int32_t dims = q->knows_height ? 2 : 3;
    real range_m = REAL(0.0);
    for (int32_t index_ = 0, index__end = start->count; index_ < index__end; index_++) {
        real total = REAL(0.0);
        for (int32_t axis = 0; axis < dims; axis++) {
            total += square(q->heard[start->used[index_]].newer.packet.place.position_m[axis] -
                    start->position_m[axis]);
        }
        range_m += SQRT(total) / (real)start->count;
    }
    real curvature_m = REAL(0.5) * (start->covariance_m2[0][0] + start->covariance_m2[1][1]) / range_m;
    return !(square(curvature_m) < q->variance_m2 + q->error_variance_m2);
}

/* Whether a wide start is withheld: more anchors may still be heard, or too few support it. */
INTERNAL bool is_worth_waiting(Acquisition *q) {
    Start *start = &q->start;
    int32_t dims = q->knows_height ? 2 : 3;
    real waited_s = (real)(start->rx_ticks_tag - q->wide_ticks) * TICK_S;
    return start->count <= dims + 1 || waited_s <= q->tuning.start_patience_s;
}

/* Exclude an anchor if it is the only one without which the others agree; enough must remain to detect a misfit.
 *
 * If there is no such anchor for ``start_patience_s``, start from all of them. */
INTERNAL int32_t solve_without_one(Acquisition *q, int64_t now) {
    if (!q->is_contradicted) {
        q->is_contradicted = true;
        q->contradicted_ticks = now;
    }
    int32_t starts = 0;
    for (int32_t pair = 0, pair_end = q->pair_count; pair < pair_end; pair++) {
        if (solve_start(q, pair, now, q->tuning.start_tail) == FOUND) {
            starts += 1;
            q->found_alone = q->start;
            const bool new_1 = true;
            const int32_t new_2 = anchor_of(q, pair);
            q->found_alone.has_misfit = new_1;
            q->found_alone.misfit = new_2;
        }
    }
    int32_t reason = FOUND;
    if (starts == 1) {
        q->start = q->found_alone;
    } else if ((real)(now - q->contradicted_ticks) * TICK_S < q->tuning.start_patience_s) {
        return RESIDUALS;
    } else {
        reason = solve_start(q, -1, now, REAL(0.0));
    }
    q->start.is_contradicted = reason == FOUND;
    return reason;
}

/* A tag from its first packet on: search for a start, filtering, and starting again when the tag is lost.
 *
 * The filter's state and the search are never used at the same time, so a board may keep both in the same memory
 * (``SHARES_MEMORY``): a new filter starts from copies of the search's results. */

/* A tag with a filter: the outcome of each packet, and when the tag must start again. */

/* Process a packet by ``process_frame`` while the tag has a filter. Returns the outcome. */
INTERNAL int32_t process_in_course(Course *c, State *s, FixTime *time, Packet *packet, Relays *relays, uint8_t *packed,
        int32_t packed_bytes) {
    int32_t outcome = skyless_process_frame(s, packet, relays, packed, packed_bytes);
    c->newest_ticks = max_64(c->newest_ticks, packet->rx_ticks);
    if (outcome == REJECTED || outcome == STALE) {
        return is_lost(s) ? LOST : OUTLIER;
    }
    if (judge_start(c, s, packet->rx_ticks)) {
        return START_CONTRADICTED;
    }
    use_anchor(c, &packet->place, packet->rx_ticks);
    return settle(c, s, time, packet->rx_ticks);
}

/* Return FIX or BAD_GEOMETRY: a 3-D fix needs a height standard deviation within the extent of the anchors. */
INTERNAL int32_t settle(Course *c, State *s, FixTime *time, int64_t rx_ticks) {
    if (s->dim == AXES && s->P[at(2, 2)] > square(c->extent_m)) {
        return BAD_GEOMETRY;
    }
    c->time_ticks = fix_time_ticks(time, rx_ticks, rx_ticks);
    return FIX;
}

/* Whether the last packet is recent enough for the filter to predict without a check. */
INTERNAL bool is_surely_in_reach(Course *c, int64_t rx_ticks) {
    return 0 <= rx_ticks - c->newest_ticks && rx_ticks - c->newest_ticks < SURELY_IN_REACH_TICKS;
}

/* Return True if relays or faults contradict the start, so that a new one is needed.
 *
 * Also records what the new start has to expect. */
INTERNAL bool judge_start(Course *c, State *s, int64_t rx_ticks) {
    Tuning *tuning = &s->tuning;
    if (c->start_was_contradicted && is_late_often(s)) {
        c->start_was_contradicted = false;  /* caused by single late packets */
        c->open_range_errors = false;
        return true;
    }
    real age_s = (real)(rx_ticks - c->started_ticks) * TICK_S;
    if (age_s >= tuning->new_start_s) {
        c->may_begin_again = true;
    } else if (c->may_begin_again && s->fix[QUALITY][0] > tuning->wrong_nis) {
        c->may_begin_again = false;  /* if a new start does not help, everything is noisier than stated */
        return true;
    }
    if (c->is_open && age_s > tuning->new_start_s && fits_settings(s)) {
        c->open_range_errors = false;
        return true;
    }
    real limit = c->start_was_contradicted ? tuning->sure_chi2 : tuning->uncovered_chi2;
    if (largest_test(s) > limit && (!c->is_open || age_s > tuning->new_start_s)) {
        c->open_range_errors = !is_late_often(s);
        return true;
    }
    if (!c->relays_may_contradict) {
        c->relays_may_contradict = relays_fit(s);
    } else if (relays_contradict(s)) {
        c->relays_may_contradict = false;  /* if a new start does not help, the anchors are wrong, not the position */
        return true;
    }
    return false;
}

/* Anchors in use */

/* Record an accepted packet of an anchor, and drop the anchors that have been silent for too long. */
INTERNAL void use_anchor(Course *c, Place *place, int64_t rx_ticks) {
    int32_t index_ = 0;
    while (index_ < c->count && c->used[index_].anchor != place->anchor) {
        index_ += 1;
    }
    bool is_new = index_ == c->count;
    if (is_new && c->count == MAX_ANCHORS) {
        index_ = longest_silent(c);
    }
    c->count = max_32(c->count, index_ + 1);
    UsedAnchor *used = &c->used[index_];
    bool has_changed = is_new;
    for (int32_t axis = 0; axis < AXES; axis++) {
        has_changed = has_changed || used->position_m[axis] != place->position_m[axis];
        used->position_m[axis] = place->position_m[axis];
    }
    used->anchor = place->anchor;
    used->rx_ticks = rx_ticks;
    if ((real)(rx_ticks - c->checked_ticks) * TICK_S > c->in_use_s) {
        c->checked_ticks = rx_ticks;
        int32_t before = c->count;
        forget_silent(c, rx_ticks);
        has_changed = has_changed || c->count < before;
    }
    if (has_changed) {
        c->changes += 1;
        for (int32_t axis = 0; axis < AXES; axis++) {
            widen(c, axis);
        }
    }
}

INTERNAL int32_t longest_silent(Course *c) {
    int32_t oldest = 0;
    for (int32_t index_ = 0, index__end = c->count; index_ < index__end; index_++) {
        if (c->used[index_].rx_ticks < c->used[oldest].rx_ticks) {
            oldest = index_;
        }
    }
    return oldest;
}

INTERNAL void forget_silent(Course *c, int64_t rx_ticks) {
    int32_t kept = 0;
    for (int32_t index_ = 0, index__end = c->count; index_ < index__end; index_++) {
        if ((real)(rx_ticks - c->used[index_].rx_ticks) * TICK_S <= c->in_use_s) {
            if (kept < index_) {
                c->used[kept] = c->used[index_];
            }
            kept += 1;
        }
    }
    c->count = kept;
}

/* Include the anchors' span along an axis in ``extent_m``. */
INTERNAL void widen(Course *c, int32_t axis) {
    real highest = c->used[0].position_m[axis];
    real lowest = c->used[0].position_m[axis];
    for (int32_t index_ = 1, index__end = c->count; index_ < index__end; index_++) {
        lowest = min_real(lowest, c->used[index_].position_m[axis]);
        highest = max_real(highest, c->used[index_].position_m[axis]);
    }
    c->extent_m = max_real(c->extent_m, highest - lowest);
}

/* Search for a start with the settings in ``c``, keeping the packets gathered so far. */
SKYLESS_EXPORT void skyless_begin_course(Course *c, Acquisition *q) {
    c->in_use_s = max_real(c->tuning.short_silence_s, REAL(1.5) * c->superframe_s);
    c->start_was_contradicted = false;
    c->is_open = false;
    c->open_range_errors = false;
    c->may_begin_again = true;
    c->relays_may_contradict = true;
    c->count = 0;
    c->heights_rejected = 0;
    c->checked_ticks = 0;
    c->newest_ticks = 0;
    c->started_ticks = 0;
    c->extent_m = REAL(0.0);
    c->late_share = REAL(0.0);
    c->misfit = NOBODY;
    c->changes += 1;
    begin_search(c, q);
}

/* Abandon the filter and search again. Only the share of late packets is kept. */
SKYLESS_EXPORT void skyless_begin_again(Course *c, State *s, Acquisition *q) {
    c->late_share = s->status.late_share;
    begin_search(c, q);
}

/* Set up the search. It keeps its packets only if no filter has run in between. */
INTERNAL void begin_search(Course *c, Acquisition *q) {
    EstimatorSettings *settings = &c->settings;
    Tuning *tuning = &c->tuning;
    if (!c->is_starting) {
        forget_all(q);
    }
    c->is_starting = true;
    q->tuning = *tuning;
    q->knows_height = c->dim < AXES;
    q->height_m = c->dim < AXES ? settings->height_m : REAL(0.0);
    q->has_bounds = settings->lowest_m > -LARGEST || settings->highest_m < LARGEST;
    q->low_m = settings->lowest_m;
    q->high_m = settings->highest_m;
    q->variance_m2 = settings->tx_variance_m2 + settings->rx_variance_m2;
    q->max_age_s = max_real(tuning->start_age_s, REAL(2.5) * c->superframe_s);
    q->start_age_s = max_real(tuning->start_age_s, c->superframe_s);
    q->speed_std_mps = settings->start_speed_std_mps;
    q->error_variance_m2 = square(settings->range_std_m) + square(settings->survey_std_m);
    q->rival_count = 0;
    q->is_contradicted = false;
    q->has_been_wide = false;
}

/* Process a packet whose further relays are still encoded (``packed``). Returns the outcome. */
SKYLESS_EXPORT int32_t skyless_follow(Course *c, State *s, Acquisition *q, FixTime *time, Packet *packet, Relays
        *relays, uint8_t *packed, int32_t packed_bytes) {
    int64_t rx_ticks = packet->rx_ticks;
    if (!c->is_starting && !is_surely_in_reach(c, rx_ticks) && is_out_of_reach(c, s, rx_ticks)) {
        skyless_begin_again(c, s, q);
    }
    if (!c->is_starting) {
        int32_t outcome = process_in_course(c, s, time, packet, relays, packed, packed_bytes);
        if (outcome == LOST || outcome == START_CONTRADICTED) {
            skyless_begin_again(c, s, q);
        }
        return outcome;
    }
    take_relays(packet, relays, packed, packed_bytes);
    int32_t found = try_start(q, packet, relays);
    if (found != FOUND) {
        return outcome_of(found);
    }
    if (q->start.is_contradicted && !q->start.has_misfit && was_late_often(c)) {
        return OUTLIER;  /* single packets are late; the next ones will not be */
    }
    if (c->superframe_s > c->tuning.longest_superframe_s) {
        fill_alone(c, q);
        c->time_ticks = fix_time_ticks(time, rx_ticks, rx_ticks);
        return START_FIX;
    }
    return begin_filter(c, s, q, relays) ? settle(c, s, time, rx_ticks) : SEARCHING;
}

INTERNAL int32_t outcome_of(int32_t found) {
    if (found == RESIDUALS || found == IMPOSSIBLE) {
        return OUTLIER;
    }
    if (found == TOO_FEW_ANCHORS) {
        return HAS_TOO_FEW;
    }
    if (found == MIRROR) {
        return IS_MIRRORED;
    }
    if (found == UNSETTLED) {
        return IS_UNSETTLED;
    }
    return found == ACQUIRING ? SEARCHING : BAD_GEOMETRY;
}

INTERNAL bool was_late_often(Course *c) {
    return c->late_share > c->tuning.late_often_share;
}

/* Whether the filter can continue */

/* Whether the filter cannot predict to this time: the silence is too long, or the tag's counter went back. */
INTERNAL bool is_out_of_reach(Course *c, State *s, int64_t rx_ticks) {
    Tuning *tuning = &c->tuning;
    real silent_s = (real)(rx_ticks - c->newest_ticks) * TICK_S;
    if (silent_s < -tuning->short_silence_s || silent_s > tuning->longest_silence_s) {
        return true;
    }
    if (silent_s < tuning->short_silence_s) {
        return false;
    }
    real part = c->superframe_s < tuning->slow_superframe_s ? tuning->curved_std : tuning->slow_curved_std;
    return SQRT(horizontal_variance_m2(s, silent_s)) > part * mean_range_m(c, s->x);
}

/* Mean distance from a position to the anchors in use. */
INTERNAL real mean_range_m(Course *c, real *position_m) {
    real total_m = REAL(0.0);
    for (int32_t index_ = 0, index__end = c->count; index_ < index__end; index_++) {
        total_m += distance_m(c, c->used[index_].position_m, position_m);
    }
    return total_m / (real)max_32(c->count, 1);
}

/* Distance between two points; horizontal only if the height is given. */
INTERNAL real distance_m(Course *c, real *one_m, real *other_m) {
    real total = REAL(0.0);
    for (int32_t axis = 0, axis_end = c->dim; axis < axis_end; axis++) {
        total += square(one_m[axis] - other_m[axis]);
    }
    return SQRT(total);
}

/* From a start to a filter */

/* Make the anchors of the start the only ones in use. */
INTERNAL void use_only(Course *c, Acquisition *q) {
    c->count = 0;
    c->extent_m = REAL(0.0);
    for (int32_t index_ = 0, index__end = q->start.count; index_ < index__end; index_++) {
        Packet *newest = &q->heard[q->start.used[index_]].newer.packet;
        use_anchor(c, &newest->place, newest->rx_ticks);
    }
}

/* Write a fix from the start alone: position, assumed speed, no protection level. */
INTERNAL void fill_alone(Course *c, Acquisition *q) {
    use_only(c, q);
    for (int32_t row = 0; row < PROTECTED_ROWS; row++) {
        for (int32_t axis = 0; axis < AXES; axis++) {
            c->alone[row][axis] = REAL(0.0);
        }
    }
    for (int32_t axis = 0, axis_end = c->dim; axis < axis_end; axis++) {
        c->alone[POSITION][axis] = q->start.position_m[axis];
        for (int32_t other = 0, other_end = c->dim; other < other_end; other++) {
            c->alone[POSITION + 1 + axis][other] = q->start.covariance_m2[axis][other];
        }
        c->alone[VELOCITY + 1 + axis][axis] = square(c->settings.start_speed_std_mps);
    }
    if (c->dim < AXES) {
        c->alone[POSITION][2] = c->settings.height_m;
    }
    c->alone[PROTECTION][STATE] = (real)UNAVAILABLE;
}

/* Start the filter at the start's position and process the packets behind it.
 *
 * Returns False if late anchors may have shifted the start by more than their distance; the start is useless then. */
INTERNAL bool begin_filter(Course *c, State *s, Acquisition *q, Relays *relays) {
    Beginning b = {0};
    b.start = q->start;
    Start *start = &b.start;
    Tuning *tuning = &c->tuning;
    choose_packets(c, q, &b);
    bool is_contradicted = start->is_contradicted && !was_late_often(c);
    bool is_open = c->open_range_errors || (is_contradicted && !start->has_misfit);
    real inflation = tuning->start_margin;
    if (is_open || is_contradicted) {
        inflation = REAL(1.0) + square(tuning->late_std_m) / (q->variance_m2 + q->error_variance_m2);
    }
    int64_t begin_ticks = b.packets[0].packet.rx_ticks;
    real speed_m2ps2 = square(c->settings.start_speed_std_mps);
    real moved_m2 = square((real)(start->rx_ticks_tag - begin_ticks) * TICK_S) * speed_m2ps2;
    use_only(c, q);
    real horizontal_m2 = inflation * (start->covariance_m2[0][0] + start->covariance_m2[1][1]) + REAL(2.0) * moved_m2;
    real part = c->superframe_s > tuning->slow_superframe_s ? tuning->slow_start_std : REAL(1.0);
    if (horizontal_m2 > square(part * mean_range_m(c, start->position_m))) {
        return false;
    }
    c->is_starting = false;
    c->started_ticks = b.packets[b.count - 1].packet.rx_ticks;
    c->newest_ticks = b.packets[b.count - 1].packet.rx_ticks;
    c->is_open = is_open;
    c->start_was_contradicted = is_open || is_contradicted;
    c->misfit = is_contradicted && start->has_misfit ? start->misfit : NOBODY;
    s->settings = c->settings;
    s->tuning = *tuning;
    s->dim = c->dim;
    s->horizontal_k = c->horizontal_k;
    s->vertical_k = c->vertical_k;
    skyless_restart(s, begin_ticks, c->late_share, c->start_was_contradicted ? tuning->late_std_m :
            tuning->lasting_std_m, is_open);
    for (int32_t axis = 0, axis_end = c->dim; axis < axis_end; axis++) {
        s->x[axis] = start->position_m[axis];
        for (int32_t other = 0, other_end = c->dim; other < other_end; other++) {
            s->P[at(axis, other)] = inflation * start->covariance_m2[axis][other] + (axis == other ? moved_m2 :
                    REAL(0.0));
        }
        s->P[at(c->dim + axis, c->dim + axis)] = speed_m2ps2;
    }
    for (int32_t index_ = 0, index__end = b.count; index_ < index__end; index_++) {
        HeardPacket *one = &b.packets[index_];
        one->packet.place.is_open = one->packet.place.anchor == c->misfit;
        relays->count = one->relay_count;
        for (int32_t relayed = 0, relayed_end = one->relay_count; relayed < relayed_end; relayed++) {
            relays->rows[relayed] = one->relays[relayed];
        }
        process(s, &one->packet, relays);
    }
    return true;
}

/* Choose the packets of each anchor that the filter starts with.
 *
 * The start's residuals belong to each anchor's newer packet. If earlier packets were inconsistent and these are not,
 * an older one may be late, so its variance is increased where relays determine the anchor's clock too. */
INTERNAL void choose_packets(Course *c, Acquisition *q, Beginning *b) {
    real factor = REAL(1.0);
    if (q->is_contradicted && !q->start.is_contradicted) {
        factor += square(c->tuning.lasting_std_m) / c->settings.rx_variance_m2;
    }
    for (int32_t place = 0, place_end = q->count; place < place_end; place++) {
        if (is_chosen(c, q, place)) {
            insert_packet(b, &q->heard[place].newer, REAL(1.0));
        }
    }
    for (int32_t place = 0, place_end = q->count; place < place_end; place++) {
        if (q->heard[place].count > 1 && is_chosen(c, q, place)) {
            insert_packet(b, &q->heard[place].older, factor);
        }
    }
}

/* Insert a packet in order of reception; ``factor`` scales its variance. */
INTERNAL void insert_packet(Beginning *b, HeardPacket *one, real factor) {
    int32_t place = b->count;
    while (place > 0 && b->packets[place - 1].packet.rx_ticks > one->packet.rx_ticks) {
        b->packets[place] = b->packets[place - 1];
        place -= 1;
    }
    b->packets[place] = *one;
    b->packets[place].packet.variance_factor *= factor;
    b->count += 1;
}

/* Whether the filter starts with the anchor at index ``place`` of ``heard``. */
INTERNAL bool is_chosen(Course *c, Acquisition *q, int32_t place) {
    Start *start = &q->start;
    bool is_slow = c->superframe_s > c->tuning.slow_superframe_s;  /* the start is from the anchors of half a second only */
    if (c->most_anchors == 0 || (is_slow && q->count <= c->most_anchors)) {
        return true;
    }
    if (start->has_misfit && q->heard[place].newer.packet.place.anchor == start->misfit) {
        return true;
    }
    real own_m = distance_m(c, q->heard[place].newer.packet.place.position_m, start->position_m);
    bool is_used = false;
    int32_t nearer = 0;
    for (int32_t index_ = 0, index__end = start->count; index_ < index__end; index_++) {
        real range_m = distance_m(c, q->heard[start->used[index_]].newer.packet.place.position_m, start->position_m);
        if (start->used[index_] == place) {
            is_used = true;
        } else if (range_m < own_m || (range_m == own_m && !is_used)) {
            nearer += 1;
        }
    }
    return is_used && nearer < c->most_anchors;
}

/* Which frames a tag accepts: those of its site whose stamps are possible on the sender's and on its own counter. */

/* Unwrap the tag's stamp of a frame and check its site. Returns ``ADMITTED`` or why it is rejected.
 *
 * ``host_s``: the host's time of reception, NaN if unknown. */
SKYLESS_EXPORT int32_t skyless_admit_sender(Admission *a, int32_t site, int32_t anchor, int64_t rx_counter, real host_s)
        {
    a->former = a->own;
    a->rx_ticks = unwrap(&a->own, rx_counter, host_s);
    Neighbours *t = &a->neighbours;
    bool went_back = a->went_back;
    bool is_possible = -LAST_TICKS <= a->rx_ticks && a->rx_ticks <= LAST_TICKS;
    a->went_back = t->has_newest && a->rx_ticks < t->newest_rx_ticks - COUNTER_JUMP_TICKS;
    if (is_possible && a->went_back && !went_back) {
        a->own = a->former;
        return OUT_OF_ORDER;
    }
    if (!is_possible || a->went_back) {
        a->went_back = false;
        forget_times(t);
        a->events = a->events | (is_possible ? COUNTER_JUMPED : HOST_JUMPED);
        restart_choice(&a->choice, is_possible ? a->rx_ticks : 0);
        if (!is_possible) {
            a->own.has_stamp = false;
            return IMPOSSIBLE_HOST_TIME;
        }
    }
    bool had_site = a->choice.site != NO_SITE;
    int32_t use = choose_site(&a->choice, site, anchor, a->rx_ticks);
    if (use == FOREIGN) {
        return FOREIGN_SITE;
    }
    if (use == CHANGED && had_site) {
        t->count = 0;
        t->has_newest = false;
        a->events = a->events | SITE_CHANGED;
    }
    return ADMITTED;
}

/* Unwrap the TX stamp of a frame of the site in use. Returns ``ADMITTED`` or why it is rejected. */
SKYLESS_EXPORT int32_t skyless_admit_stamp(Admission *a, int32_t anchor, int32_t sequence, int64_t tx_counter, int64_t
        period_ticks) {
    int32_t stamp = skyless_unwrap_stamp(&a->neighbours, anchor, sequence, tx_counter, a->rx_ticks, period_ticks);
    if (stamp == STAMP_FITS) {
        a->choice.heard_ticks = a->rx_ticks;
    } else {
        a->own = a->former;
    }
    return stamp;
}

/* Which anchors of a large site a tag uses: the strongest of those that other anchors receive too */

/* Update an anchor's mean power; NaN if the radio reports none. */
INTERNAL void add_power(Neighbour *n, real power_dbm) {
    if (abs_real(power_dbm) <= MAX_POWER_DBM) {
        n->power_dbm = n->has_power ? n->power_dbm + POWER_GAIN * (power_dbm - n->power_dbm) : power_dbm;
        n->has_power = true;
    }
}

/* Mark the anchors that a beacon relays as confirmed. */
INTERNAL void add_relays(Neighbours *t, BeaconFields *b, int64_t rx_ticks) {
    for (int32_t begin = 0, begin_end = b->relay_bytes; begin < begin_end; begin += 8) {
        int32_t anchor = two_bytes(b->relays, begin);
        int32_t row = neighbour_of(t, anchor, rx_ticks);
        t->rows[row].relayed_ticks = rx_ticks;
        t->rows[row].own_relays_ticks = NEVER;
    }
}

/* Number of relayed receptions consistent with the tag's own, which proves that the anchor really receives them.
 *
 * Only packets of anchors in use count. A reception fits if it precedes the anchor's own frame by as much on the
 * anchor's counter as on the tag's, to 1 µs (300 m) and the drift of crystals. */
INTERNAL int32_t fitting_relays(Neighbours *t, State *s, BeaconFields *b, int64_t rx_ticks) {
    int32_t fitting = 0;
    int32_t bits = b->has_phases ? SHORT_BITS : TICK_BITS;
    int64_t tx_ticks = t->rows[t->row].tx_ticks;
    for (int32_t begin = 0, begin_end = b->relay_bytes; begin < begin_end; begin += 8) {
        int32_t anchor = two_bytes(b->relays, begin);
        int32_t row = find_neighbour(t, anchor);
        if (row >= 0 && t->rows[row].frames > 0 && t->rows[row].sequence == b->relays[begin + 2]) {
            int64_t elapsed = rx_ticks - t->rows[row].rx_ticks;
            int64_t received_ticks = nearest(unsigned_(b->relays, begin + 3, floor_div_32(bits, 8)), tx_ticks - elapsed,
                    bits);
            if (skyless_find_anchor(s, anchor) >= 0 && may_elapse(tx_ticks - received_ticks, elapsed,
                    (real)FLIGHT_SLACK_TICKS)) {
                fitting += 1;
            }
        }
    }
    return fitting;
}

/* Index of the weakest anchor in use if the newest anchor should replace it, otherwise −1. */
INTERNAL int32_t replaced_by(Neighbours *t, State *s, int32_t *origin_mm) {
    int32_t weakest = -1;
    real least_dbm = power_dbm(&t->rows[t->row], s, origin_mm) - BETTER_DB;
    for (int32_t index_ = 0, index__end = s->count; index_ < index__end; index_++) {
        int32_t row = find_neighbour(t, s->anchors[index_].identifier);
        if (row >= 0 && t->rows[row].has_place && power_dbm(&t->rows[row], s, origin_mm) < least_dbm) {
            weakest = index_;
            least_dbm = power_dbm(&t->rows[row], s, origin_mm);
        }
    }
    return weakest;
}

/* The mean power of an anchor; if the radio reports none, a nominal one at its distance. */
INTERNAL real power_dbm(Neighbour *n, State *s, int32_t *origin_mm) {
    if (n->has_power) {
        return n->power_dbm;
    }
    real total = REAL(0.0);
    for (int32_t axis = 0, axis_end = s->dim; axis < axis_end; axis++) {
        total += square(place_m(n, origin_mm, axis) - s->x[axis]);
    }
    return NOMINAL_POWER_DBM - DB_PER_LOG * log_(max_real(SQRT(total), REAL(0.1)));
}

/* A coordinate of an anchor relative to the origin. */
INTERNAL real place_m(Neighbour *n, int32_t *origin_mm, int32_t axis) {
    return (real)(n->place.position_mm[axis] - origin_mm[axis]) / (real)MM_PER_M;
}

/* ``joint``: the estimator as a positioning method, with cold start, updates by packet, and restarts when lost. */

/* Relays of older packets are not used; the longer of the two counts. */

/* Fill in the settings that the pages state. */
INTERNAL void read_accuracy(EstimatorSettings *e, uint8_t *noise, uint8_t *accuracy) {
    fill_noise(e, float_at(noise, 1), float_at(noise, 5), float_at(noise, 9), float_at(noise, 13));
    e->survey_std_m = (real)two_bytes(accuracy, 1) / (real)STD_STEPS_PER_M;
    e->range_std_m = (real)two_bytes(accuracy, 3) / (real)STD_STEPS_PER_M;
    e->slope_std_m = (real)two_bytes(accuracy, 5) / (real)STD_STEPS_PER_M;
    e->place_std_m = (real)two_bytes(accuracy, 7) / (real)STD_STEPS_PER_M;
    e->place_distance_m = (real)two_bytes(accuracy, 9) / (real)STEPS_PER_M;
    e->place_time_s = (real)two_bytes(accuracy, 11) / (real)STEPS_PER_S;
}

/* Fill in the variances of stamps and oscillators (``NoisePage``). */
INTERNAL void fill_noise(EstimatorSettings *e, real tx_stamp_s, real rx_stamp_s, real white_fm, real random_walk_fm) {
    e->tx_variance_m2 = LIGHT_2 * square(tx_stamp_s);
    e->rx_variance_m2 = LIGHT_2 * (square(rx_stamp_s) + ROUNDING_S2);
    const real new_1 = LIGHT_2 * square(white_fm);
    const real new_2 = LIGHT_2 * square(random_walk_fm);
    e->white = new_1;
    e->walk = new_2;
}

/* Fill in the ages beyond which packets and anchors are dropped. */
INTERNAL void fill_ages(EstimatorSettings *e, real superframe_s) {
    e->drop_s = max_real(DROP_S, REAL(4.0) * superframe_s);
    e->relay_age_s = max_real(RELAY_AGE_S, RELAY_SUPERFRAMES * superframe_s);
}

/* Decode an IEEE 754 number from four bytes; checked pages hold only 0 and positive numbers below 1. */
INTERNAL real float_at(uint8_t *data, int32_t at) {
    int64_t bits = unsigned_(data, at, 4);
    int64_t halvings = 150 - (bits >> 23);
    real value = (real)((bits & 8388607) | 8388608);
    if (bits < 8388608 || bits >= INT64_C(2147483648)) {
        halvings = 149;
        value = (real)(bits & 8388607);
    }
    for (int64_t time_1 = 0; time_1 < halvings; time_1++) {
        value *= REAL(0.5);
    }
    return value;
}

/* A tag of protocol 2: from a frame's bytes to a fix. */

/* Start, wake, counter restarts */

/* Initialise a tag that listens to one site or, with ``NO_SITE``, to the one with most anchors.
 *
 * The other arguments are fields of ``EstimatorSettings``. */
SKYLESS_EXPORT void skyless_begin_tag(Tag *t, int32_t site, real qa, real lowest_m, real highest_m, real height_std_m,
        real integrity_risk, real alert_limit_m) {
    t->owner = (EstimatorSettings){.qa = REAL(0.5), .start_speed_std_mps = REAL(2.0), .white = REAL(3.6e-05), .walk =
            REAL(0.09), .tx_variance_m2 = REAL(0.0009), .rx_variance_m2 = REAL(0.0009), .gate = REAL(4.0), .height_m =
            (real)__builtin_nan(""), .height_std_m = REAL(0.0), .lowest_m = (real)-__builtin_inf(), .highest_m =
            (real)__builtin_inf(), .carrier_cycles = 13, .phase_std_m = REAL(0.0015), .phase_wander = REAL(3e-05),
            .drop_s = REAL(2.0), .relay_age_s = REAL(1.0), .survey_std_m = REAL(0.02), .range_std_m = REAL(0.03),
            .pair_std_m = REAL(0.02), .slope_std_m = REAL(0.05), .place_std_m = REAL(0.005), .place_distance_m =
            REAL(1.0), .place_time_s = REAL(100.0), .change_memory_s = REAL(0.0), .barometer_walk = REAL(0.00025),
            .least_change_std_m = REAL(0.05), .earliest_m = (real)-__builtin_inf(), .difference_std_m = REAL(0.12),
            .stationary_s = REAL(0.0), .integrity_risk = REAL(0.0001), .alert_limit_m = (real)__builtin_nan("")};
    t->admission = (Admission){.own = {.bits = 40, .last_host_s = (real)__builtin_nan("")}, .former = {.bits = 40,
            .last_host_s = (real)__builtin_nan("")}, .choice = {.only_site = -1, .site = -1}};
    t->pages = (SitePages){.issue = -1};
    t->course = (Course){.settings = {.qa = REAL(0.5), .start_speed_std_mps = REAL(2.0), .white = REAL(3.6e-05), .walk =
            REAL(0.09), .tx_variance_m2 = REAL(0.0009), .rx_variance_m2 = REAL(0.0009), .gate = REAL(4.0), .height_m =
            (real)__builtin_nan(""), .height_std_m = REAL(0.0), .lowest_m = (real)-__builtin_inf(), .highest_m =
            (real)__builtin_inf(), .carrier_cycles = 13, .phase_std_m = REAL(0.0015), .phase_wander = REAL(3e-05),
            .drop_s = REAL(2.0), .relay_age_s = REAL(1.0), .survey_std_m = REAL(0.02), .range_std_m = REAL(0.03),
            .pair_std_m = REAL(0.02), .slope_std_m = REAL(0.05), .place_std_m = REAL(0.005), .place_distance_m =
            REAL(1.0), .place_time_s = REAL(100.0), .change_memory_s = REAL(0.0), .barometer_walk = REAL(0.00025),
            .least_change_std_m = REAL(0.05), .earliest_m = (real)-__builtin_inf(), .difference_std_m = REAL(0.12),
            .stationary_s = REAL(0.0), .integrity_risk = REAL(0.0001), .alert_limit_m = (real)__builtin_nan("")},
            .tuning = {.restart_m = REAL(300.0), .start_walk_scale = REAL(100.0), .mean_gain = REAL(0.05), .noise_growth
            = REAL(1.2), .max_walk_scale = REAL(10000.0), .noise_loss = REAL(0.99), .common = REAL(1.5), .rate_s =
            REAL(0.5), .rate_changes = REAL(20.0), .least_walk_scale = REAL(0.02), .relays_in_row = REAL(8.0),
            .steady_walk_scale = REAL(4.0), .max_scale = REAL(100.0), .lag_limit = REAL(3.5), .sudden_lag = REAL(9.0),
            .walking_mps = REAL(4.0), .better_known = REAL(0.8), .stationary_noise_share = REAL(2e-07),
            .stationary_std_mps = REAL(0.01), .longest_gap_s = REAL(0.3), .shock_mps2 = REAL(100.0), .shock_rps =
            REAL(20.0), .short_gap_s = REAL(0.05), .wrong_scale = REAL(60.0), .wrong_speed_nis = REAL(5.0), .wrong_s =
            REAL(1.5), .ignored_s = REAL(20.0), .level_s = REAL(0.5), .rest_rps = REAL(0.1), .rest_mps2 = REAL(0.5),
            .rest_mps = REAL(0.2), .tilt_s = REAL(2.0), .slow_tilt_s = REAL(10.0), .bias_s = REAL(20.0), .heading_std =
            REAL(0.7), .heading_memory_s = REAL(20.0), .heading_walk = REAL(0.02), .acceleration_std_mps2 = REAL(1.0),
            .acceleration_walk = REAL(0.08), .vertical_share = REAL(0.02), .sensor_noise = REAL(0.01), .headless_noise =
            REAL(0.1), .known_heading_variance = REAL(0.05), .sure_heading_variance = REAL(0.0076), .speed_std_mps =
            REAL(0.02), .speed_share = REAL(0.02), .held_step_m = REAL(0.15), .held_max_m = REAL(0.4), .curvature_share
            = REAL(0.01), .slope_from_m = REAL(4.0), .forgetting = REAL(0.02), .wrong_nis = REAL(2.0), .slow_forgetting
            = REAL(0.005), .late_often_share = REAL(0.02), .reception_huber = REAL(1.5), .difference_huber = REAL(1.0),
            .max_relays_rejected = REAL(4.0), .lost_in_row = REAL(8.0), .lost_share = REAL(0.5), .suspect = REAL(3.0),
            .in_row = REAL(2.0), .in_row_where_late = REAL(5.0), .together = REAL(7.0), .first_change_scale =
            REAL(20.0), .ended_log_odds = REAL(7.0), .ended_std_m = REAL(0.05), .obstructed_walk = REAL(0.004),
            .obstruction_memory_s = REAL(10.0), .obstruction_return_m = REAL(0.2), .jump_rise = REAL(0.5), .recent_jumps
            = REAL(0.25), .obstructed_std_m = REAL(0.04), .obstructed_s = REAL(5.0), .place_step_m = REAL(0.1),
            .place_first = REAL(20.0), .place_samples = REAL(100.0), .place_memory = REAL(1000.0), .place_min_m2 =
            REAL(0.0012), .place_kept = REAL(0.1), .max_change_std_m = REAL(0.5), .lasting_std_m = REAL(0.3),
            .recent_std_m = REAL(0.08), .creeping_std_m = REAL(0.2), .recent_packets = REAL(16.0), .creeping_s =
            REAL(3.0), .late_std_m = REAL(1.0), .sure_chi2 = REAL(50.0), .early_weight = REAL(0.8), .open_pair_std_m =
            REAL(0.1), .pair_relays = REAL(12.0), .misplaced_pairs = REAL(2.0), .start_age_s = REAL(0.5), .curved_std =
            REAL(0.1), .start_patience_s = REAL(0.5), .start_tail = REAL(0.0001), .new_start_s = REAL(1.0),
            .start_margin = REAL(4.0), .short_silence_s = REAL(0.1), .longest_silence_s = REAL(5.0), .slow_superframe_s
            = REAL(0.2), .slow_curved_std = REAL(0.7), .slow_start_std = REAL(2.0), .longest_superframe_s = REAL(1.3),
            .heights_in_row = REAL(20.0), .open_survey_std_m = REAL(0.15), .fitting_chi2 = REAL(2.0), .most_late =
            REAL(2.0), .late_penalty = REAL(2.0), .staying_share = REAL(0.2), .window = REAL(60.0), .window_s =
            REAL(1.0), .moving_window = REAL(20.0), .moving_std_m = REAL(1.5), .moving_nis = REAL(1.5), .moving_apart =
            REAL(6.0), .median_difference_std_m = REAL(0.08), .late_start_std_m = REAL(0.14), .rival_m = REAL(0.5),
            .height_margin_m = REAL(1.0), .neighbourhood = REAL(1.5), .most_horizontal_std_m = REAL(3.0),
            .zero_variance_m2 = REAL(10000.0), .phases_start_s = REAL(2.0), .phase_start_std_m = REAL(0.003),
            .phase_max_std_m = REAL(0.006), .phase_mesh_std_m = REAL(0.0012), .phase_wander = REAL(25.0), .phase_gate =
            REAL(0.35), .phase_share = REAL(0.1), .phase_step_m = REAL(0.02), .pair_share = REAL(0.2), .phases_nis =
            REAL(1.6), .slip_std_m = REAL(0.05), .phases_walk_scale = REAL(8.0), .most_cycles = REAL(4.0), .start_wild =
            REAL(0.009), .least_wild = REAL(0.002), .most_wild = REAL(0.01), .unlikely_log_odds = REAL(10.0), .alike =
            REAL(0.15), .phase_walking_mps = REAL(0.75), .speed_memory_s = REAL(1.0), .phases_in_row = REAL(4.0),
            .uncovered_chi2 = REAL(240.0), .max_open_level_std = REAL(0.02), .contradicted_start_s = REAL(5.0), .probe_m
            = REAL(1.0), .shift_part = REAL(0.25), .apart_chi2 = REAL(20.0), .sensor_valid_s = REAL(1.0)}, .is_starting
            = true, .misfit = -1, .relays_may_contradict = true, .may_begin_again = true};
    t->owner.qa = qa;
    t->owner.lowest_m = lowest_m;
    t->owner.highest_m = highest_m;
    t->owner.height_std_m = height_std_m;
    t->owner.integrity_risk = integrity_risk;
    t->owner.alert_limit_m = alert_limit_m;
    t->admission.choice.only_site = site;
    t->course.most_anchors = MAX_ANCHORS_IN_USE;
    const real new_1 = horizontal_limit(integrity_risk);
    const real new_2 = vertical_limit(integrity_risk);
    t->course.horizontal_k = new_1;
    t->course.vertical_k = new_2;
    t->has_origin = false;
    t->has_settings = false;
    t->most_relays = MAX_HEARD;
    forget_moves(t);
}

/* Start again at the same site and near the same height after a sleep in which the tag's counter was lost.
 *
 * ``rx_counter`` is the counter's present reading. */
SKYLESS_EXPORT void skyless_wake(Tag *t, State *s, Acquisition *q, int64_t rx_counter, real slept_s) {
    Admission *a = &t->admission;
    Course *c = &t->course;
    bool had_height = !c->is_starting && c->dim == AXES;
    real height_m = REAL(0.0);
    real std_m = REAL(0.0);
    if (had_height) {
        height_m = s->x[2];
        std_m = SQRT(s->P[at(2, 2)]) + slept_s * c->settings.start_speed_std_mps;
    }
    wake_times(&a->neighbours, a->rx_ticks, rx_counter);
    restart_choice(&a->choice, rx_counter);
    a->went_back = false;
    a->own.has_stamp = false;
    a->time.first_ticks_master += rx_counter - a->time.last_ticks_master - floor_real(slept_s * TICK_RATE_HZ);
    a->time.last_rx_ticks_tag = rx_counter;
    a->time.last_ticks_master = rx_counter;
    forget_stamps(t, q);
    if (had_height) {
        q->has_bounds = true;
        q->low_m = height_m - c->settings.gate * std_m;
        q->high_m = height_m + c->settings.gate * std_m;
    }
}

/* Forget what the current beacon's events have made invalid. */
INTERNAL void handle_events(Tag *t, Acquisition *q) {
    t->events = t->admission.events;
    t->admission.events = 0;
    if ((t->events & SITE_CHANGED) != 0) {
        t->pages = (SitePages){.issue = -1};
        t->has_origin = false;
    }
    if (t->events != 0) {
        forget_stamps(t, q);
    }
}

/* Forget everything but the site's own data, because the tag's counter has restarted. */
INTERNAL void forget_stamps(Tag *t, Acquisition *q) {
    t->has_settings = false;
    t->pages.has_first = false;
    t->course.is_starting = true;
    forget_all(q);
    forget_moves(t);
    if (t->pages.issue != NO_ISSUE) {
        begin_here(t, q);
    }
}

/* The site's pages */

/* Derive the settings from the pages in use. */
INTERNAL void read_pages(Tag *t) {
    Course *c = &t->course;
    uint8_t *site = t->pages.used[SITE_KIND].contents;
    c->settings = t->owner;
    read_accuracy(&c->settings, t->pages.used[NOISE_KIND].contents, t->pages.used[ACCURACY_KIND].contents);
    c->superframe_s = (real)t->period_ticks * TICK_S;
    fill_ages(&c->settings, c->superframe_s);
    c->dim = AXES;
    if ((site[HEIGHT_FLAG_AT] & HEIGHT_GIVEN) != 0) {
        c->settings.height_m = (real)signed_(site, HEIGHT_FLAG_AT + 1) / (real)MM_PER_M;
        c->dim = AXES - 1;
    }
}

/* Start with the pages in use. */
INTERNAL void begin_here(Tag *t, Acquisition *q) {
    read_pages(t);
    skyless_begin_course(&t->course, q);
    t->has_settings = true;
}

/* Start with the pages in use and the longest period of the anchors that are present. */
INTERNAL void begin_with_pages(Tag *t, Acquisition *q) {
    int64_t newest_ticks = 0;
    Neighbours *neighbours = &t->admission.neighbours;
    for (int32_t row = 0, row_end = neighbours->count; row < row_end; row++) {
        if (neighbours->rows[row].frames > 0) {
            newest_ticks = max_64(newest_ticks, neighbours->rows[row].rx_ticks);
        }
    }
    t->period_ticks = 0;
    for (int32_t row = 0, row_end = neighbours->count; row < row_end; row++) {
        Neighbour *n = &neighbours->rows[row];
        if (n->frames > 0 && is_present(n, newest_ticks)) {
            t->period_ticks = max_64(t->period_ticks, period_ticks(n->period_code));
        }
    }
    if (t->course.is_starting) {
        forget_unconfirmed(t, q);
    }
    begin_here(t, q);
}

/* Forget the packets of anchors that no other anchor confirms. */
INTERNAL void forget_unconfirmed(Tag *t, Acquisition *q) {
    Neighbours *neighbours = &t->admission.neighbours;
    for (int32_t place = q->count - 1; place > -1; place--) {
        int32_t anchor = q->heard[place].newer.packet.place.anchor;
        int32_t row = find_neighbour(neighbours, anchor);
        if (row < 0 || !is_confirmed(&neighbours->rows[row], t->admission.rx_ticks)) {
            forget_packets(q, anchor);
        }
    }
}

/* Beacons that are more than the next one of an anchor in use */

/* Process the current beacon while something is new: page, anchor, position or start. Returns the outcome. */
INTERNAL int32_t process_rare(Tag *t, State *s, Acquisition *q, uint8_t *frame) {
    Admission *a = &t->admission;
    Course *c = &t->course;
    Neighbour *n = &a->neighbours.rows[a->neighbours.row];
    bool was_starting = c->is_starting;
    if (note_page(&t->pages, &a->neighbours, frame, t->beacon.page_at, a->rx_ticks) == OTHER_SETTINGS) {
        begin_with_pages(t, q);
    }
    if (t->has_moved) {
        separate_moved(t, s, q, n);
    }
    follow_moves(t, q, n);
    if (is_kept_apart(t, n)) {
        return MOVED_ANCHOR;
    }
    if (!t->has_settings) {
        if (n->has_place) {  /* other anchors may confirm this one before the pages are complete */
            take_relays(&t->packet, &t->relays, t->beacon.relays, t->beacon.relay_bytes);
            gather_packet(q, &t->packet, &t->relays);
        }
        return NO_PAGES;
    }
    if (!n->has_place) {
        return NO_POSITION;
    }
    int32_t outcome = join(t, s, n);
    if (outcome != JOINS) {
        return outcome;
    }
    outcome = skyless_follow(c, s, q, &a->time, &t->packet, &t->relays, t->beacon.relays, t->beacon.relay_bytes);
    if (was_starting && !c->is_starting) {  /* from now on only what anchors in use have received or relayed counts */
        for (int32_t row = 0, row_end = a->neighbours.count; row < row_end; row++) {
            Neighbour *other = &a->neighbours.rows[row];
            other->own_relays_ticks = NEVER;
            other->relayed_ticks = NEVER;
            other->is_misfit = other->anchor == c->misfit;
        }
    }
    return outcome;
}

/* Return ``JOINS`` if an anchor is in use or may be: others confirm it, and it is no weaker than those in use. */
INTERNAL int32_t join(Tag *t, State *s, Neighbour *n) {
    Course *c = &t->course;
    if (!c->is_starting && skyless_find_anchor(s, n->anchor) >= 0) {
        return JOINS;
    }
    if (!is_confirmed(n, t->admission.rx_ticks)) {
        return UNCONFIRMED_ANCHOR;
    }
    if (c->is_starting || s->count < MAX_ANCHORS_IN_USE) {
        return JOINS;
    }
    int32_t replaced = replaced_by(&t->admission.neighbours, s, t->origin_mm);
    if (replaced < 0) {
        return WEAKER_ANCHOR;
    }
    skyless_leave(s, s->anchors[replaced].identifier);
    return JOINS;
}

/* Anchors that have moved */

/* Use all anchors together again. */
INTERNAL void forget_moves(Tag *t) {
    t->is_moving = false;
    t->uses_moved = false;
    t->moved_ticks = NEVER;
    for (int32_t row = 0, row_end = t->admission.neighbours.count; row < row_end; row++) {
        t->admission.neighbours.rows[row].has_moved = false;
    }
}

/* Take an anchor that states another position out of use. If too few anchors are left, start again. */
INTERNAL void separate_moved(Tag *t, State *s, Acquisition *q, Neighbour *n) {
    if (t->uses_moved && n->has_moved) {  /* the anchors in use move a second time */
        forget_moves(t);
    }
    n->has_moved = true;
    t->is_moving = true;
    t->moved_ticks = max_64(t->moved_ticks, t->admission.rx_ticks);
    if (t->course.is_starting) {
        forget_packets(q, n->anchor);
    } else {
        skyless_leave(s, n->anchor);
        if (s->count < MIN_ANCHORS) {
            begin_with_pages(t, q);
        }
    }
}

/* End a move that is over, and start again with the moved anchors once they are the majority. */
INTERNAL void follow_moves(Tag *t, Acquisition *q, Neighbour *n) {
    int64_t calm_ticks = t->admission.rx_ticks - t->moved_ticks;
    if (t->is_moving && calm_ticks >= MOVE_TICKS) {
        forget_moves(t);
    } else if (t->is_moving && !t->uses_moved && n->has_moved && calm_ticks >= MOVED_HOLD_TICKS && have_most_moved(t)) {
        t->uses_moved = true;
        forget_all(q);
        if (t->has_settings) {
            begin_with_pages(t, q);
        }
    }
}

/* Whether an anchor states its position before a move while the anchors in use have moved, or the reverse. */
INTERNAL bool is_kept_apart(Tag *t, Neighbour *n) {
    return t->is_moving && n->has_moved != t->uses_moved;
}

/* Whether most of the present anchors with a position have moved. */
INTERNAL bool have_most_moved(Tag *t) {
    int32_t present = 0;
    int32_t moved = 0;
    for (int32_t row = 0, row_end = t->admission.neighbours.count; row < row_end; row++) {
        Neighbour *n = &t->admission.neighbours.rows[row];
        if (n->has_place && n->was_relayed && is_present(n, t->admission.rx_ticks)) {
            present += 1;
            moved += n->has_moved ? 1 : 0;
        }
    }
    return 2 * moved > present;
}

/* Process a frame from the air. Returns the outcome.
 *
 * That is one of ``DROP_COUNTERS``, of the outcomes in ``following.py`` or here, or ``MALFORMED`` plus a fault.
 * If unknown, ``host_s`` and the powers are NaN and the phase is negative. */
SKYLESS_EXPORT int32_t skyless_hear_frame(Tag *t, State *s, Acquisition *q, uint8_t *frame, int32_t length, int64_t
        rx_counter, real host_s, real rx_power_dbm, real first_path_power_dbm, real phase_cycles) {
    int32_t fault = skyless_read_frame(frame, length, &t->beacon);
    t->packet.report_variance_m2 = REAL(0.0);  /* only protocol 1 has reports */
    if (fault != INTACT) {
        return MALFORMED + fault;
    }
    return skyless_hear_fields(t, s, q, frame, rx_counter, host_s, rx_power_dbm, first_path_power_dbm, phase_cycles);
}

/* Process a beacon that has been decoded into ``t.beacon``, with its page in ``frame``. Returns the outcome. */
SKYLESS_EXPORT int32_t skyless_hear_fields(Tag *t, State *s, Acquisition *q, uint8_t *frame, int64_t rx_counter, real
        host_s, real rx_power_dbm, real first_path_power_dbm, real phase_cycles) {
    Admission *a = &t->admission;
    BeaconFields *b = &t->beacon;
    int32_t outcome = skyless_admit_sender(a, b->site, b->anchor, rx_counter, host_s);
    if (outcome == ADMITTED) {
        outcome = skyless_admit_stamp(a, b->anchor, b->sequence, b->tx_ticks, period_ticks(b->period_code));
    }
    handle_events(t, q);
    if (outcome != ADMITTED) {
        return outcome;
    }
    Neighbour *n = &a->neighbours.rows[a->neighbours.row];
    add_power(n, rx_power_dbm);
    n->was_relayed = confirm(t, s);
    n->almanac_issue = b->almanac_issue;
    n->period_code = b->period_code;
    t->has_moved = b->has_place && keep_place(n, &b->place);
    fill_packet(t, n, variance_factor(rx_power_dbm, first_path_power_dbm));
    t->packet.has_phase = phase_cycles >= REAL(0.0);
    t->packet.phase_cycles = phase_cycles;
    outcome = hear_admitted(t, s, q, n, frame);
    if (outcome == FIX || outcome == START_FIX) {
        note_fix(&a->choice, a->rx_ticks);
    }
    return outcome;
}

/* Process an admitted beacon. Returns the outcome. */
INTERNAL int32_t hear_admitted(Tag *t, State *s, Acquisition *q, Neighbour *n, uint8_t *frame) {
    Course *c = &t->course;
    BeaconFields *b = &t->beacon;
    bool is_new = t->has_moved || t->is_moving || b->almanac_issue != t->pages.issue || !n->has_place;
    if (c->is_starting || is_new || skyless_find_anchor(s, b->anchor) < 0) {
        return process_rare(t, s, q, frame);
    }
    n->used_ticks = t->admission.rx_ticks;
    int32_t relay_bytes = min_32(b->relay_bytes, t->most_relays * HEARD_BYTES);
    return skyless_follow(c, s, q, &t->admission.time, &t->packet, &t->relays, b->relays, relay_bytes);
}

/* Record the anchors this beacon confirms. Return True if its own sender is confirmed by others.
 *
 * Only then do its pages count for the majority and its relays confirm others. */
INTERNAL bool confirm(Tag *t, State *s) {
    BeaconFields *b = &t->beacon;
    Neighbours *rows = &t->admission.neighbours;
    int64_t rx_ticks = t->admission.rx_ticks;
    bool is_starting = t->course.is_starting;
    Neighbour *n = &rows->rows[rows->row];
    bool in_use = !is_starting && skyless_find_anchor(s, b->anchor) >= 0;
    bool by_others = is_relayed(n, rx_ticks) || (in_use && n->own_relays_ticks == NEVER);
    if (by_others || is_starting || has_too_few(s, rx_ticks)) {
        add_relays(rows, b, rx_ticks);
    } else if (fitting_relays(rows, s, b, rx_ticks) >= MIN_FITTING) {
        n->own_relays_ticks = rx_ticks;
    }
    return by_others;
}

/* Whether fewer anchors in use are still received than a fix needs, so that relays of any anchor confirm.
 *
 * This lets a tag go on where none of its anchors is received or receives the new ones, such as after a lift. */
INTERNAL bool has_too_few(State *s, int64_t rx_ticks) {
    int32_t heard = 0;
    for (int32_t anchor = 0, anchor_end = s->count; anchor < anchor_end; anchor++) {
        Anchor *a = &s->anchors[anchor];
        if (a->packets > 0 && (real)(rx_ticks - a->rx_ticks) * TICK_S <= s->settings.drop_s) {
            heard += 1;
        }
    }
    return heard < MIN_ANCHORS;
}

/* Keep the position that an anchor states. Return True if it is used from now on instead of another one.
 *
 * Another position is used once it has been stated twice in a row. */
INTERNAL bool keep_place(Neighbour *n, StatedPlace *place) {
    if (n->has_place && is_same(&n->place, place)) {
        n->has_other = false;
        return false;
    }
    bool has_moved = n->has_place && n->has_other && is_same(&n->other, place);
    if (has_moved || !n->has_place) {
        n->place = *place;
        n->has_place = true;
        n->has_other = false;
    } else {
        n->other = *place;
        n->has_other = true;
    }
    return has_moved;
}

INTERNAL bool is_same(StatedPlace *one, StatedPlace *other) {
    for (int32_t axis = 0; axis < AXES; axis++) {
        if (one->position_mm[axis] != other->position_mm[axis]) {
            return false;
        }
    }
    return one->std_mm == other->std_mm && one->floor_ == other->floor_ && one->zone == other->zone;
}

/* Fill ``t.packet`` from the current beacon, without its relays. */
INTERNAL void fill_packet(Tag *t, Neighbour *n, real factor) {
    Packet *packet = &t->packet;
    Place *place = &t->packet.place;
    if (HAS_ORIGIN && n->has_place && !t->has_origin) {
        t->has_origin = true;
        for (int32_t axis = 0; axis < 2; axis++) {
            t->origin_mm[axis] = floor_div_32(n->place.position_mm[axis], MM_PER_M) * MM_PER_M;
        }
    }
    place->anchor = n->anchor;
    place->std_m = (real)n->place.std_mm / (real)MM_PER_M;
    place->is_open = n->is_misfit;
    for (int32_t axis = 0; axis < AXES; axis++) {
        place->position_m[axis] = place_m(n, t->origin_mm, axis);
    }
    packet->sequence = n->sequence;
    packet->rx_ticks = t->admission.rx_ticks;
    packet->tx_ticks = n->tx_ticks;
    packet->variance_factor = factor;
    t->relays.count = 0;
    packet->relays_have_phases = t->beacon.has_phases;
}

#ifdef SKYLESS_BY_HAND
#include SKYLESS_BY_HAND
#endif
