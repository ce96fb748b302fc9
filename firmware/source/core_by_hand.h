/* The core's innermost loops for a Cortex-M4F, which skyless_core.c includes instead of its own: the same bits, for the
 * same numbers are added in the same order. What they compute says their Python (skyless/core/estimator/kalman.py); here
 * a load serves several rows, and a store several terms. What is left out, or more here, adds zeros. */

#if PHASE_STATES > 0
#error "inform here does not know updates that show no faults"
#endif
#pragma GCC optimize("O3")
#define INLINE static inline __attribute__((always_inline))
#define UNROLLED _Pragma("GCC unroll 8")
#define AT_ONCE 5 /* terms of a sum */
#define ROWS 3    /* of a matrix at once */
#define GROUP 4   /* updates that are summed before they are added */
#define SPACE ((int32_t)(sizeof((State *)0)->h / sizeof(real)) + MOST_WAITING + AT_ONCE)

/* A board serves its radio now and then while it computes. */
#ifdef SKYLESS_PAUSE
void SKYLESS_PAUSE(void);
#else
#define SKYLESS_PAUSE()
#endif

enum step { ALONG_ROWS, ALONG_COLUMNS, ALONG_BOTH };

/* sums[i] += Σ weight·(what each pointer points to), up to ``end``; rows of P go on as columns behind the diagonal. */
INLINE int32_t add_terms(real *sums, const real **at, const real *weight, const int32_t *index, const int32_t terms,
                         int32_t i, const int32_t end, const bool is_first, const enum step along)
{
    for (; i < end; i++) {
        real sum = is_first ? REAL(0.0) : sums[i];
        UNROLLED
        for (int32_t term = 0; term < terms; term++) {
            sum += weight[term] * *at[term];
            at[term] += along == ALONG_ROWS || (along == ALONG_BOTH && i < index[term]) ? 1 : i + 1;
        }
        sums[i] = sum;
    }
    return i;
}

/* The same of whole rows: of those ``at`` some places, of which there are ``terms``, and those of updates that wait. */
INLINE void add_rows(State *s, real *sums, const real **at, real *weight, int32_t terms, const real *waiting,
                     const int32_t stride, const int32_t size, const bool is_first)
{
    for (int32_t one = 0; one < s->waiting; one++) {
        weight[terms] = -h_dot(s, s->U[one]);
        at[terms++] = &waiting[one * stride];
    }
    for (int32_t k = 0; k < terms;) {
        if (terms - k >= AT_ONCE) {
            (void)add_terms(sums, &at[k], &weight[k], 0, AT_ONCE, 0, size, is_first && k == 0, ALONG_ROWS);
            k += AT_ONCE;
        } else if (terms - k >= 2) {
            (void)add_terms(sums, &at[k], &weight[k], 0, 2, 0, size, is_first && k == 0, ALONG_ROWS);
            k += 2;
        } else {
            (void)add_terms(sums, &at[k], &weight[k], 0, 1, 0, size, is_first && k == 0, ALONG_ROWS);
            k += 1;
        }
    }
}

INTERNAL real compute_ph(State *s)
{
    const real *at[SPACE];
    real weight[SPACE];
    int32_t index[SPACE];
    int32_t terms = 0;

    SKYLESS_PAUSE();
    if (s->waiting == MOST_WAITING) {
        finish_updates(s);
    }
    for (int32_t term = 0; term < s->terms; term++) {
        if (s->h_index[term] < s->n) {
            weight[terms] = s->h[term];
            index[terms++] = s->h_index[term];
        }
    }
    for (; terms == 0 || terms % AT_ONCE != 0; terms++) {
        weight[terms] = REAL(0.0);
        index[terms] = terms == 0 ? 0 : index[terms - 1];
    }
    real *ph = s->U[s->waiting];
    for (int32_t first = 0; first < terms; first += AT_ONCE) {
        const real *of = &weight[first];
        const bool is_first = first == 0;
        int32_t lowest = s->n, highest = 0;
        for (int32_t term = first; term < first + AT_ONCE; term++) {
            at[term] = &s->P[row_of(index[term])];
            lowest = min_32(lowest, index[term]);
            highest = max_32(highest, index[term]);
        }
        int32_t state = add_terms(ph, &at[first], of, &index[first], AT_ONCE, 0, lowest, is_first, ALONG_ROWS);
        state = add_terms(ph, &at[first], of, &index[first], AT_ONCE, state, highest, is_first, ALONG_BOTH);
        (void)add_terms(ph, &at[first], of, &index[first], AT_ONCE, state, s->n, is_first, ALONG_COLUMNS);
    }
    add_rows(s, ph, at, weight, 0, s->U[0], STATES, s->n, false);
    return h_dot(s, ph);
}

INTERNAL void compute_fault_input(State *s, int32_t own)
{
    const real *at[SPACE];
    real weight[SPACE];
    real *shares = s->G[s->waiting];

    for (int32_t term = 0; term < s->terms; term++) {
        weight[term] = -s->h[term];
        at[term] = s->V[s->h_index[term]];
    }
    add_rows(s, shares, at, weight, s->terms, s->G[0], SENSITIVITIES, s->rows, true);
    for (int32_t kind = 0; own >= 0 && kind < FAULT_KINDS; kind++) {
        shares[kind * s->count + own] += REAL(1.0);
    }
}

/* What updates do to ROWS rows: a number gains, for each GROUP of them, the sum of their factors for its row times what
 * they have for its column. Factors of the next row stand behind, those of the next update ``apart``. */
INLINE void add_number_of_updates(real *const *rows, const real *factors, const int32_t apart, const real sign,
                                  const real *with, const int32_t stride, const int32_t updates, const int32_t size)
{
    real factor[ROWS][MOST_WAITING];
    real *row[ROWS];

    UNROLLED
    for (int32_t one = 0; one < ROWS; one++) {
        row[one] = rows[one];
        UNROLLED
        for (int32_t k = 0; k < updates; k++) {
            factor[one][k] = sign * factors[k * apart + one];
        }
    }
    for (int32_t i = 0; i < size; i++) {
        real number[ROWS], sum[ROWS];
        UNROLLED
        for (int32_t one = 0; one < ROWS; one++) {
            number[one] = row[one][i];
        }
        UNROLLED
        for (int32_t k = 0; k < updates; k++) {
            const real has = with[k * stride + i];
            UNROLLED
            for (int32_t one = 0; one < ROWS; one++) {
                sum[one] = k % GROUP == 0 ? factor[one][k] * has : sum[one] + factor[one][k] * has;
                number[one] = k % GROUP == GROUP - 1 || k == updates - 1 ? number[one] + sum[one] : number[one];
            }
        }
        UNROLLED
        for (int32_t one = 0; one < ROWS; one++) {
            row[one][i] = number[one];
        }
    }
}

/* Each number of them has its own loop, with all factors in registers. */
INLINE void add_updates(real *const *rows, const real *factors, const int32_t apart, const real sign, const real *with,
                        const int32_t stride, const int32_t updates, const int32_t size)
{
#define CASE(number) case number: add_number_of_updates(rows, factors, apart, sign, with, stride, number, size); break
    switch (updates) {
        CASE(1);
        CASE(2);
        CASE(3);
        CASE(4);
        CASE(5);
        CASE(6);
#if MOST_WAITING > 6
        CASE(7);
        CASE(8);
#endif
    }
}

/* The same for rows of a triangle: the first, with the index ``begin``, up to its diagonal, and the others up to theirs. */
INLINE void add_to_triangle(real *const *rows, const int32_t begin, const real *with, const int32_t stride,
                            const real sign, const int32_t updates)
{
    real corner[ROWS][ROWS - 1];
    real *corners[ROWS];

    add_updates(rows, &with[begin], stride, sign, with, stride, updates, begin + 1);
    for (int32_t one = 0; one < ROWS; one++) {
        corners[one] = corner[one];
        for (int32_t column = 0; column < ROWS - 1; column++) {
            corner[one][column] = rows[one][begin + 1 + column];
        }
    }
    add_updates(corners, &with[begin], stride, sign, &with[begin + 1], stride, updates, ROWS - 1);
    for (int32_t one = 1; one < ROWS; one++) {
        for (int32_t column = 0; column < one; column++) {
            rows[one][begin + 1 + column] = corner[one][column];
        }
    }
}

/* Behind the last row others are written that nobody reads. */

INTERNAL void inform(State *s)
{
    const int32_t faults = FAULT_KINDS * s->count;
    real spare[FAULTS + ROWS];

    for (int32_t fault = 0; fault < faults; fault += ROWS) {
        real *rows[ROWS];
        for (int32_t one = 0; one < ROWS; one++) {
            rows[one] = fault + one < faults ? s->information[fault + one] : spare;
        }
        add_to_triangle(rows, fault, s->G[0], SENSITIVITIES, REAL(1.0), s->waiting);
    }
}

/* Up to two are applied one after the other, as in Python. */
INTERNAL void apply_updates(State *s)
{
    const int32_t updates = s->waiting > 2 ? s->waiting : 1;
    real spare[STATES + ROWS];

    for (int32_t begin = 0; begin < s->waiting; begin += updates) {
        for (int32_t state = 0; state < s->used; state += ROWS) {
            real *rows[ROWS], *effects[ROWS];
            SKYLESS_PAUSE();
            for (int32_t one = 0; one < ROWS; one++) {
                const bool is_there = state + one < s->used;
                rows[one] = is_there ? &s->P[row_of(state + one)] : spare;
                effects[one] = is_there ? s->V[state + one] : spare;
            }
            add_to_triangle(rows, state, s->U[begin], STATES, REAL(-1.0), updates);
            add_updates(effects, &s->U[begin][state], STATES, REAL(1.0), s->G[begin], SENSITIVITIES, updates, s->rows);
        }
    }
    s->waiting = 0;
}
