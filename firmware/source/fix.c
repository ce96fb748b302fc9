#include "fix.h"

#define TICKS_PER_S 63897600000
#define LEAST_PIVOT 1e-5f /* against its element: a smaller one is rounding */

float fix_hpl_m(const struct fix *fix)
{
    return (fix->levels < ALERT_NOT_EXCLUDED) ? fix->hpl_m : __builtin_nanf("");
}

float fix_vpl_m(const struct fix *fix)
{
    return ((fix->levels < ALERT_NOT_EXCLUDED) && (fix->is_height_known == 0u)) ? fix->vpl_m : __builtin_nanf("");
}

uint32_t fix_alert(const struct fix *fix)
{
    bool is_exceeded = (fix->alert_limit_m > 0.0f) && (fix_hpl_m(fix) > fix->alert_limit_m);

    return is_exceeded ? (uint32_t)ALERT_LIMIT : fix->levels;
}

float fix_std_m(const struct fix *fix)
{
    return fix_root(fix->covariance_m2[0] + fix->covariance_m2[3] + fix->covariance_m2[5]);
}

int64_t fix_time_us(const struct fix *fix)
{
    return ((fix->time_ticks / 638976) * 10) + (((fix->time_ticks % 638976) * 10) / 638976);
}

bool fix_is_due(const struct fix *fix, uint32_t rate_hz, int64_t *slot)
{
    int64_t present = (rate_hz == 0u) ? fix->time_ticks : (fix->time_ticks / (TICKS_PER_S / rate_hz));
    bool is_due = present != *slot;

    *slot = present;
    return is_due;
}

/* Invert a positive definite matrix in place, by Gauss and Jordan's elimination; false for a singular one. */
static bool invert(float (*matrix)[4], uint32_t size)
{
    const float first[4] = {matrix[0][0], matrix[1][1], matrix[2][2], matrix[3][3]};

    for (uint32_t k = 0u; k < size; k++) {
        float pivot = matrix[k][k];

        if (!(pivot > (LEAST_PIVOT * first[k]))) {
            return false;
        }
        matrix[k][k] = 1.0f;
        for (uint32_t j = 0u; j < size; j++) {
            matrix[k][j] /= pivot;
        }
        for (uint32_t i = 0u; i < size; i++) {
            float factor = matrix[i][k];

            if (i != k) {
                matrix[i][k] = 0.0f;
                for (uint32_t j = 0u; j < size; j++) {
                    matrix[i][j] -= factor * matrix[k][j];
                }
            }
        }
    }
    return true;
}

struct fix_dops fix_dops(const struct fix *fix)
{
    float normal[4][4] = {{0.0f}}; /* of rows [1, unit vector]: the clock first */
    float infinite = __builtin_inff();

    for (uint32_t at = 0u; at < fix->anchor_count; at++) {
        float row[4] = {1.0f, 0.0f, 0.0f, 0.0f};
        float square = 0.0f;

        for (uint32_t axis = 0u; axis < 3u; axis++) {
            row[axis + 1u] = (float)fix->position_mm[axis] - (float)fix->anchors[at].position_mm[axis];
            square += row[axis + 1u] * row[axis + 1u];
        }
        for (uint32_t axis = 1u; axis < 4u; axis++) {
            row[axis] /= fix_root(square);
        }
        for (uint32_t i = 0u; i < 16u; i++) {
            normal[i / 4u][i % 4u] += row[i / 4u] * row[i % 4u];
        }
    }
    if (!invert(normal, (fix->is_height_known != 0u) ? 3u : 4u)) {
        return (struct fix_dops){infinite, infinite, infinite, infinite};
    }
    float vertical = (fix->is_height_known != 0u) ? 0.0f : normal[3][3];
    float horizontal = normal[1][1] + normal[2][2];

    return (struct fix_dops){fix_root(normal[0][0] + horizontal + vertical), fix_root(horizontal + vertical),
                             fix_root(horizontal), fix_root(vertical)};
}
