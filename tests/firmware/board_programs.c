/* In the place of the board's loop: one program, chosen by PROGRAM, on the real hardware functions of main.c. Results go
 * out on the serial line. */
#include <string.h>

#include "board.h"

#define LONG_SLEEP 1
#define SETTINGS 2
#define ADVERTISE 3
#define WINDOW 4

#ifndef MILLISECONDS
#define MILLISECONDS 1000u
#endif

static const struct hardware *hardware;
static uint32_t turns;

/* The slow crystal runs by then. */
#define RUNS_US 300000u

static void send_word(uint32_t word)
{
    uint8_t out[4];

    for (uint32_t at = 0u; at < 4u; at++) {
        out[at] = (uint8_t)(word >> (8u * at));
    }
    (void)hardware->write_line(out, sizeof out);
}

void board_init(struct board *board, const struct hardware *functions, const struct board_identity *identity)
{
    (void)memset(board, 0, sizeof *board);
    hardware = functions;
    hardware->set_rate(1000000u);
    board->identity = *identity;
}

#if PROGRAM == LONG_SLEEP
/* Send the time before and after each of two sleeps, and all bytes that come in between. */
void board_begin(struct board *board)
{
    (void)board;
}

uint32_t board_turn(struct board *board)
{
    uint8_t byte;

    (void)board;
    if (hardware->now_us() < RUNS_US) {
        return RUNS_US;
    }
    if (turns < 2u) {
        turns++;
        send_word(hardware->now_us());
        hardware->sleep_for(MILLISECONDS);
        send_word(hardware->now_us());
    }
    if (hardware->read_line(&byte, 1u) > 0u) {
        (void)hardware->write_line(&byte, 1u);
    }
    return 500000u;
}
#elif PROGRAM == SETTINGS
/* Send whether there are settings, and their tag; a byte that comes is the tag of those that are written. */
void board_begin(struct board *board)
{
    struct settings settings = {0};
    uint8_t kept[KEPT_BYTES];

    (void)board;
    hardware->read_settings(kept);
    kept[0] = settings_unpack(kept, SETTINGS_BYTES, &settings) ? 1u : 0u;
    kept[1] = (uint8_t)settings.tag;
    (void)hardware->write_line(kept, 2u);
}

uint32_t board_turn(struct board *board)
{
    struct settings settings = SETTINGS_DEFAULT;
    uint8_t kept[KEPT_BYTES] = {0};
    uint8_t tag;

    (void)board;
    if (hardware->read_line(&tag, 1u) > 0u) {
        settings.tag = tag;
        settings_pack(&settings, kept);
        hardware->write_settings(kept);
        (void)hardware->write_line(&tag, 1u);
    }
    return 500000u;
}
#elif PROGRAM == ADVERTISE
/* Advertise what is defined twice, the second time too early, and once more after 2 ms. */
static const uint8_t data[] = {DATA};

void board_begin(struct board *board)
{
    (void)board;
    send_word(hardware->advertise(data, sizeof data));
    send_word(hardware->advertise(data, sizeof data));
}

uint32_t board_turn(struct board *board)
{
    (void)board;
    turns++;
    if (hardware->now_us() > 3000u && turns < 100u) {
        turns = 100u;
        send_word(hardware->advertise(data, sizeof data));
    }
    return 2000u;
}
#elif PROGRAM == WINDOW
/* Start the chip, let it sleep, wake it, and listen in a window 3 ms later; send how long each took, then when the poll at
 * the interrupt came, and its result. */
static uint32_t asked_us;

static uint32_t since(uint32_t begin_us)
{
    return hardware->now_us() - begin_us;
}

void board_begin(struct board *board)
{
    (void)board;
}

static void run(struct dw1000 *chip)
{
    uint32_t begin_us = hardware->now_us();
    uint32_t took_us[4];

    dw1000_init(chip, hardware);
    (void)dw1000_start(chip, 16500u, 16300u);
    took_us[0] = since(begin_us);
    begin_us = hardware->now_us();
    dw1000_sleep(chip);
    took_us[1] = since(begin_us);
    hardware->sleep_for(MILLISECONDS);
    begin_us = hardware->now_us();
    (void)dw1000_wake(chip, 16500u, 16300u);
    took_us[2] = since(begin_us);
    asked_us = hardware->now_us();
    (void)dw1000_receive_at(chip, dw1000_now(chip) + (3000ull << 16), 400u);
    took_us[3] = since(asked_us);
    for (uint32_t at = 0u; at < 4u; at++) {
        send_word(took_us[at]);
    }
}

uint32_t board_turn(struct board *board)
{
    if (hardware->now_us() < RUNS_US) {
        return RUNS_US;
    }
    if (turns == 0u) {
        turns++;
        run(&board->chip);
    } else if (hardware->interrupt_line()) {
        send_word(since(asked_us));
        send_word(dw1000_poll(&board->chip));
    } else {
        /* it is not yet time */
    }
    return 500000u;
}
#endif
