#include "outputs.h"

#define MAX_DIGITS 24u
#define HALF 4294967296.0f /* 2^32 */
#define LARGEST 1e15f

static void put(struct text *text, char one)
{
    if (text->fill < OUTPUT_MAX_BYTES) {
        text->data[text->fill] = one;
        text->fill++;
    }
}

void text_put(struct text *text, const char *part)
{
    for (; *part != '\0'; part++) {
        put(text, *part);
    }
}

void text_padded(struct text *text, const char *before, int64_t value, uint32_t decimals, uint32_t digits)
{
    char found[MAX_DIGITS];
    uint32_t count = 0u;
    uint64_t rest = (value < 0) ? (0u - (uint64_t)value) : (uint64_t)value;

    do { /* a division of 64 bits costs ten of 32 */
        uint64_t tenth = (rest <= UINT32_MAX) ? ((uint32_t)rest / 10u) : (rest / 10u);

        found[count] = (char)('0' + (uint32_t)(rest - (10u * tenth)));
        rest = tenth;
        count++;
    } while ((rest > 0u) || (count < (decimals + digits)));
    text_put(text, before);
    text_put(text, (value < 0) ? "-" : "");
    for (; count > 0u; count--) {
        if (count == decimals) {
            put(text, '.');
        }
        put(text, found[count - 1u]);
    }
}

void text_number(struct text *text, const char *before, int64_t value, uint32_t decimals)
{
    text_padded(text, before, value, decimals, 1u);
}

int64_t text_rounded(float value)
{
    float size = (value < 0.0f) ? (0.5f - value) : (0.5f + value);

    size = (size < LARGEST) ? size : LARGEST;
    uint32_t high = (uint32_t)(size / HALF); /* two conversions by the processor's instruction */
    int64_t whole = ((int64_t)high << 32) + (uint32_t)(size - ((float)high * HALF));

    return (value < 0.0f) ? -whole : whole;
}

void text_real(struct text *text, const char *before, float value, uint32_t decimals)
{
    for (uint32_t at = 0u; at < decimals; at++) {
        value *= 10.0f;
    }
    if ((value > -LARGEST) && (value < LARGEST)) {
        text_number(text, before, text_rounded(value), decimals);
    } else {
        text_put(text, before);
        text_put(text, text->none);
    }
}
