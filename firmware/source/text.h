/* Text out of integers. What does not fit is left out. */
#ifndef TEXT_H
#define TEXT_H

#include <stdint.h>

struct text {
    char *data;
    uint32_t size;
    uint32_t fill;
    const char *none; /* what stands for a number that there is not */
};

void text_put(struct text *text, const char *part);

/* A part, and behind it a number in units of 10^-decimals, of at least so many digits before the point. */
void text_padded(struct text *text, const char *before, int64_t value, uint32_t decimals, uint32_t digits);
void text_number(struct text *text, const char *before, int64_t value, uint32_t decimals);

/* The same with a float rounded to so many decimals; `none` for what is no number or no measurement. */
void text_real(struct text *text, const char *before, float value, uint32_t decimals);

/* The nearest whole number, of at most 10^15. */
int64_t text_rounded(float value);

#endif
