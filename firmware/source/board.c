#include "board.h"

#include <string.h>

#include "selftest.h"

/* Version of the firmware, in HELLO */
static const uint8_t VERSION[3] = {0u, 4u, 0u};

/* How long before its time a frame is handed to the chip: a reception that is being reported then (0.28 ms), what is
 * written over the SPI until it starts (0.14 ms; docs/hardware.md) and its preamble (0.14 ms). */
#define LEAD_US 600
/* This much longer where receptions are reported with their phases (0.30 ms). */
#define PHASE_US 40
/* A time closer than this is not checked again against the chip's counter. */
#define CLOSE_US 30
/* After its time a frame is cancelled if the chip has not reported that it was sent. */
#define OVERDUE_US 2000
/* How often the chip is polled without its interrupt line being high: one that has lost its settings raises none. */
#define POLL_US 50000u
/* The same where the line does not follow the chip's events: shorter than a slot less a frame. */
#define FAST_POLL_US 250u
/* This number of polls in a row that disagree with the interrupt line shows that it is stuck. */
#define DISAGREEMENTS 4u
/* So long after a reception was reported a slot of 2.1 ms was empty, and the next frame begins in 1.2 ms. Of slots from 2.7
 * to 4.1 ms it may not be one, which costs one reception. */
#define QUIET_US 2400u
/* Nothing long is begun in this time before a frame is due. */
#define CLEARANCE_US 5000
/* How often a chip is asked for its settings: after a failed supply it may receive nothing for ever and look normal. */
#define CHECK_US 200000u
/* How often temperature and supply are measured, which takes 1.1 ms without the receiver: in a free slot, */
#define MEASURE_US 10000000u
/* or wherever no frame is due, if there was no free slot for this time. */
#define MEASURE_ANYWHERE_US 60000000u
/* After this number of garbled lines in a row the line is restarted. */
#define GARBLED_IN_A_ROW 20u
/* Period of the light that blinks, as a bit of the clock: 0.52 s on, 0.52 s off. */
#define BLINK_BIT 0x80000u
#define READ_BYTES 64u
/* A chip that could not be started for a tag is tried again. */
#define RETRY_US 1000000u
/* A rate of the serial line that flash does not hold is given up when no record was understood at it for this time. */
#define RATE_TRIAL_US 3000000u

#ifndef PER_THREAD /* on a computer several boards run side by side */
#define PER_THREAD
#endif

/* The one whose estimator computes. */
static PER_THREAD struct board *computing;

static int32_t from_to(uint32_t earlier_us, uint32_t later_us)
{
    return (int32_t)(later_us - earlier_us);
}

/* To the host */

static bool is_tag(const struct board *board)
{
    return board->settings.mode == MODE_TAG;
}

/* Whether the chip is configured and awake. */
static bool has_chip(const struct board *board)
{
    return board->is_configured && !(is_tag(board) && (board->tag.receiver == RESTING));
}

static void send_hello(struct board *board)
{
    struct link_writer *writer = &board->writer;

    link_begin(writer, LINK_HELLO);
    link_append(writer, LINK_MAJOR, 1u);
    link_append(writer, LINK_MINOR, 1u);
    link_append_bytes(writer, VERSION, sizeof VERSION);
    link_append_bytes(writer, board->identity.device_id, LINK_IDENTITY_BYTES);
    link_append(writer, LINK_RATE_KHZ, 4u);
    link_append(writer, LINK_COUNTER_BITS, 1u);
    link_append(writer, LINK_HAS_PHASES | LINK_CAN_COMPUTE | (board->identity.can_transmit ? LINK_CAN_TRANSMIT : 0u), 1u);
    link_append(writer, board->identity.reset_cause, 1u);
    link_send(writer);
}

static void send_status(struct board *board)
{
    const struct dw1000 *chip = &board->chip;
    struct link_writer *writer = &board->writer;
    const uint32_t counts[6] = {chip->received, chip->errors, chip->sent, board->late,
                                board->unknown + board->reader.garbled, writer->unsent};

    link_begin(writer, LINK_STATUS);
    link_append(writer, has_chip(board) ? dw1000_now(&board->chip) : 0u, LINK_STAMP_BYTES);
    link_append(writer, (board->is_configured ? LINK_IS_CONFIGURED : 0u) | (board->is_receiving ? LINK_IS_RECEIVING : 0u) |
                            ((board->stage != NO_FRAME) ? LINK_HAS_FRAME_WAITING : 0u) |
                            (board->is_polled ? LINK_IS_POLLED : 0u), 1u);
    for (uint32_t at = 0u; at < 6u; at++) {
        link_append(writer, counts[at] & LINK_COUNT_MASK, 4u);
    }
    link_append(writer, (uint32_t)chip->temperature_cc, 2u);
    link_append(writer, chip->millivolts, 2u);
    link_send(writer);
}

static void refuse(struct board *board, uint32_t kind, uint32_t reason)
{
    link_begin(&board->writer, LINK_REFUSED);
    link_append(&board->writer, kind, 1u);
    link_append(&board->writer, reason, 1u);
    link_send(&board->writer);
}

/* The reason with how far the chip's start came. */
static void refuse_radio(struct board *board)
{
    const struct dw1000 *chip = &board->chip;

    link_begin(&board->writer, LINK_REFUSED);
    link_append(&board->writer, LINK_CONFIG, 1u);
    link_append(&board->writer, LINK_REFUSED_RADIO, 1u);
    link_append(&board->writer, (uint32_t)chip->start_step, 1u);
    link_append(&board->writer, chip->identifier, 4u);
    link_append(&board->writer, chip->status, LINK_STATUS_OCTETS);
    link_send(&board->writer);
}

static void report_late(struct board *board, uint64_t dx_ticks, uint32_t reason)
{
    board->late++;
    link_begin(&board->writer, LINK_TX_LATE);
    link_append(&board->writer, dx_ticks, LINK_STAMP_BYTES);
    link_append(&board->writer, reason, 1u);
    link_send(&board->writer);
}

/* RX_PHASE with a phase, RX without. */
static void report_reception(struct board *board)
{
    const struct dw1000 *chip = &board->chip;
    struct link_writer *writer = &board->writer;

    link_begin(writer, (chip->phase < 0) ? LINK_RX : LINK_RX_PHASE);
    link_append(writer, chip->rx_ticks, LINK_STAMP_BYTES);
    link_append(writer, (uint32_t)chip->rx_power_cdbm, 2u);
    link_append(writer, (uint32_t)chip->first_path_cdbm, 2u);
    link_append(writer, (uint32_t)chip->offset_ppb, 2u);
    link_append(writer, (uint32_t)chip->phase, (chip->phase < 0) ? 0u : 2u);
    link_append_bytes(writer, chip->frame, chip->frame_bytes);
    link_send(writer);
}

/* The chip */

/* The frame, if there is one, will not be sent. */
static void drop_frame(struct board *board, uint32_t reason)
{
    if (board->stage != NO_FRAME) {
        board->stage = NO_FRAME;
        report_late(board, board->dx_ticks, reason);
    }
}

/* The chip has lost its settings; after a HELLO the host asks for the state, and configures it again. */
static void on_lost(struct board *board)
{
    drop_frame(board, LINK_LATE_NOT_READY);
    board->is_configured = false;
    board->is_receiving = false;
    if (!is_tag(board)) {
        send_hello(board);
    }
}

/* Compare the interrupt line before a poll with what the poll has found: one that is high without an event, or low with
 * one, several times in a row, is stuck until it moves. */
static void judge_line(struct board *board, bool is_high, bool had_event)
{
    if ((is_high != board->line_was_high) || (is_high && had_event && !board->is_polled)) {
        board->disagreements = 0u;
    }
    if ((is_high != had_event) && (board->disagreements < DISAGREEMENTS)) {
        board->disagreements++;
    }
    board->line_was_high = is_high;
    board->is_polled = board->disagreements == DISAGREEMENTS;
}

/* Report what has happened at the chip; whether anything has. */
static bool poll(struct board *board, bool line_is_high)
{
    struct dw1000 *chip = &board->chip;
    uint32_t events = dw1000_poll(chip);

    judge_line(board, line_is_high, events != 0u);
    if (is_tag(board)) {
        tag_on_chip(&board->tag, events);
    } else if ((events & DW1000_RECEIVED) != 0u) {
        report_reception(board);
    }
    if (((events & DW1000_SENT) != 0u) && (board->stage == FRAME_HANDED_OVER)) {
        board->stage = NO_FRAME;
        board->is_own_slot = true;
        link_begin(&board->writer, LINK_TX_DONE);
        link_append(&board->writer, board->dx_ticks, LINK_STAMP_BYTES);
        link_append(&board->writer, chip->tx_ticks, LINK_STAMP_BYTES);
        link_send(&board->writer);
    }
    if ((events & DW1000_LOST) != 0u) {
        on_lost(board);
    }
    return events != 0u;
}

/* Poll a chip that may have something. */
static void poll_now(struct board *board)
{
    bool line_is_high = board->hardware->interrupt_line();

    if (line_is_high || board->is_polled) {
        (void)poll(board, line_is_high);
    }
}

static bool is_poll_due(const struct board *board, bool line_is_high, uint32_t now_us)
{
    return (line_is_high && !board->is_polled) ||
           ((now_us - board->polled_us) >= (board->is_polled ? FAST_POLL_US : POLL_US));
}

/* The frame to be sent */

static void hand_over(struct board *board)
{
    enum dw1000_queued result;

    poll_now(board); /* or a frame that has just come would be lost */
    if (board->stage != FRAME_HELD) {
        return;
    }
    if (!dw1000_check(&board->chip)) { /* or it would be sent with other settings, at another time */
        on_lost(board);
        return;
    }
    result = dw1000_transmit_at(&board->chip, board->dx_ticks, board->frame, board->frame_bytes);
    if (result == DW1000_QUEUED) {
        board->stage = FRAME_HANDED_OVER;
        board->due_us = board->hardware->now_us() + LEAD_US + PHASE_US + OVERDUE_US;
    } else {
        drop_frame(board, (uint32_t)result); /* the driver's reasons have the link's numbers */
    }
}

/* The frame is due by the board's clock: hand it over, or cancel it when it is overdue. That clock may be off by a few
 * per cent, so the time left is read from the chip until it is short. */
static void serve_frame(struct board *board)
{
    const struct hardware *hardware = board->hardware;
    int32_t lead_us = LEAD_US + (board->chip.reads_phases ? PHASE_US : 0);
    int32_t left_us;

    if (board->stage == FRAME_HANDED_OVER) {
        board->due_us = hardware->now_us() + OVERDUE_US;
        if (dw1000_cancel(&board->chip)) {
            drop_frame(board, LINK_LATE_FOR_RADIO);
        }
        return;
    }
    left_us = dw1000_micros_until(dw1000_now(&board->chip), board->dx_ticks) - lead_us;
    if (left_us > CLOSE_US) {
        board->due_us = hardware->now_us() + (uint32_t)(left_us - (left_us / 16));
    } else {
        hand_over(board);
    }
}

/* The host */

static void accept_frame(struct board *board, const uint8_t *record, uint32_t length)
{
    const uint8_t *frame = &record[LINK_TX_FRAME_AT];
    uint32_t frame_bytes = length - LINK_TX_FRAME_AT;
    bool is_ready = board->is_configured && board->identity.can_transmit && !is_tag(board);
    uint64_t dx_ticks;

    if ((length < (LINK_TX_FRAME_AT + DW1000_MIN_PSDU_BYTES)) || (frame_bytes > DW1000_MAX_PSDU_BYTES) ||
        (link_fcs(frame, frame_bytes - 2u) != link_number(&frame[frame_bytes - 2u], 2u))) {
        refuse(board, LINK_TX_AT, LINK_REFUSED_MALFORMED);
        return;
    }
    dx_ticks = link_number(&record[LINK_BODY_AT], LINK_STAMP_BYTES);
    if (!is_ready) {
        report_late(board, dx_ticks, LINK_LATE_NOT_READY);
    } else if (board->stage != NO_FRAME) {
        report_late(board, dx_ticks, LINK_LATE_BUSY);
    } else {
        board->dx_ticks = dx_ticks;
        board->frame_bytes = frame_bytes;
        (void)memcpy(board->frame, frame, frame_bytes);
        board->stage = FRAME_HELD;
        board->due_us = board->hardware->now_us(); /* its time is read in this turn */
    }
}

static void start_chip(struct board *board, uint32_t tx_delay_ticks, uint32_t rx_delay_ticks)
{
    board->writer.is_among_text = is_tag(board) && (board->settings.output != OUTPUT_RECORDS);
    board->chip.uses_both_buffers = is_tag(board);
    board->is_configured = dw1000_start(&board->chip, tx_delay_ticks, rx_delay_ticks);
    board->was_refused = !board->is_configured;
    board->is_receiving = is_tag(board) && board->is_configured;
    board->is_polled = false;
    board->disagreements = 0u;
    board->checked_us = board->hardware->now_us();
}

/* Configure the chip and begin to look for a position. */
static void start_tag(struct board *board)
{
    board->chip.reads_phases = false;
    start_chip(board, board->settings.tx_delay_ticks, board->settings.rx_delay_ticks);
    board->tried_us = board->checked_us;
    if (board->is_configured) {
        tag_begin(&board->tag);
    }
}

static void configure(struct board *board, const uint8_t *record, uint32_t length)
{
    if (length < LINK_CONFIG_BYTES) {
        refuse(board, LINK_CONFIG, LINK_REFUSED_MALFORMED);
        return;
    }
    if ((record[2] != 5u) || (record[3] != 64u) || (record[4] != 2u) || (record[5] != 9u) ||
        (link_number(&record[6], 2u) != 128u)) { /* channel, PRF in MHz, 6.8 Mbit/s, code, symbols */
        refuse(board, LINK_CONFIG, LINK_REFUSED_SETTING);
        return;
    }
    if (is_tag(board)) { /* until the next start */
        board->settings.mode = MODE_RADIO;
        board->is_in_flash = false;
    }
    drop_frame(board, LINK_LATE_NOT_READY);
    board->chip.reads_phases = (record[LINK_CONFIG_BYTES - 1u] & LINK_WANTS_PHASES) != 0u;
    start_chip(board, (uint32_t)link_number(&record[8], 2u), (uint32_t)link_number(&record[10], 2u));
    if (board->is_configured) {
        send_status(board);
    } else {
        refuse_radio(board);
    }
}

static void receive(struct board *board)
{
    if (board->is_configured) {
        board->is_receiving = true;
        dw1000_receive(&board->chip);
        send_status(board);
    } else {
        refuse(board, LINK_RX_ON, LINK_REFUSED_MALFORMED);
    }
}

static void send_settings(struct board *board)
{
    uint8_t packed[SETTINGS_BYTES];

    settings_pack(&board->settings, packed);
    link_begin(&board->writer, LINK_TAG_CONFIG);
    link_append(&board->writer, board->is_in_flash ? LINK_IN_FLASH : 0u, 1u);
    link_append_bytes(&board->writer, packed, sizeof packed);
    link_send(&board->writer);
}

/* What flash holds; false where it is nothing that a board can work with. */
static bool read_settings(const struct board *board, struct settings *settings)
{
    uint8_t kept[KEPT_BYTES] = {0u};

    board->hardware->read_settings(kept);
    return settings_unpack(kept, SETTINGS_BYTES, settings) && settings_check(settings);
}

/* Begin as a tag, or as a radio that waits for its host with its receiver off. */
static void use_settings(struct board *board)
{
    drop_frame(board, LINK_LATE_NOT_READY);
    dw1000_idle(&board->chip);
    board->is_configured = false;
    board->is_receiving = false;
    board->tests_left = 0u;
    if (is_tag(board)) {
        start_tag(board);
    }
}

static void change_settings(struct board *board, const uint8_t *record, uint32_t length)
{
    struct settings settings;
    uint8_t kept[KEPT_BYTES] = {0u};

    if ((length < (LINK_SETTINGS_AT + SETTINGS_BYTES)) ||
        !settings_unpack(&record[LINK_SETTINGS_AT], length - LINK_SETTINGS_AT, &settings)) {
        refuse(board, LINK_SET_TAG_CONFIG, LINK_REFUSED_MALFORMED);
    } else if (!settings_check(&settings)) {
        refuse(board, LINK_SET_TAG_CONFIG, LINK_REFUSED_SETTING);
    } else {
        board->settings = settings;
        board->is_in_flash = false;
        if ((record[LINK_BODY_AT] & LINK_IN_FLASH) != 0u) {
            settings_pack(&settings, kept);
            board->hardware->write_settings(kept);
            board->is_in_flash = read_settings(board, &settings);
        }
        send_settings(board);
        if (board->is_in_flash) {
            board->kept_baud = board->settings.baud;
        }
        board->understood_us = board->hardware->now_us();
        board->hardware->set_rate(board->settings.baud);
        use_settings(board);
    }
}

static void obey(struct board *board, const uint8_t *record, uint32_t length)
{
    switch (record[0]) {
    case LINK_TX_AT:
        accept_frame(board, record, length);
        break;
    case LINK_ASK_STATUS:
        send_status(board);
        break;
    case LINK_ASK_HELLO:
        send_hello(board);
        break;
    case LINK_CONFIG:
        configure(board, record, length);
        break;
    case LINK_RX_ON:
        receive(board);
        break;
    case LINK_SET_TAG_CONFIG:
        change_settings(board, record, length);
        break;
    case LINK_ASK_TAG_CONFIG:
        send_settings(board);
        break;
    case LINK_SET_TIME:
        if (length >= (LINK_BODY_AT + 8u)) {
            tag_set_time(&board->tag, (int64_t)link_number(&record[LINK_BODY_AT], 8u));
        }
        break;
    case LINK_READ:
        if (!selftest_read(board, record, length)) {
            refuse(board, LINK_READ, LINK_REFUSED_MALFORMED);
        }
        break;
    case LINK_TEST_LINE:
        if (!selftest_begin_line(board, record, length)) {
            refuse(board, LINK_TEST_LINE, LINK_REFUSED_MALFORMED);
        }
        break;
    default:
        board->unknown++;
        break;
    }
}

/* Obey the commands in what has come; whether anything has. */
static bool serve_host(struct board *board)
{
    struct link_reader *reader = &board->reader;
    uint8_t data[READ_BYTES];
    uint32_t size = board->hardware->read_line(data, sizeof data);
    uint32_t at = 0u;

    while (at < size) {
        at += link_read(reader, &data[at], size - at);
        if (reader->length > 0u) {
            board->understood_until = reader->garbled;
            board->understood_us = board->hardware->now_us();
            obey(board, reader->record, reader->length);
            tag_on_host(&board->tag); /* which a tag that begins by this command remembers, too */
        }
    }
    if ((reader->garbled - board->understood_until) >= GARBLED_IN_A_ROW) {
        board->understood_until = reader->garbled;
        board->hardware->restart_line();
    }
    return size > 0u;
}

/* What can wait */

/* Whether the time of a measurement is free: the rest of the own slot, or of an empty one; never where a frame is on its
 * way out, nor shortly before one is due. */
static bool is_free(const struct board *board, uint32_t now_us)
{
    if ((board->stage == FRAME_HANDED_OVER) ||
        ((board->stage == FRAME_HELD) && (from_to(now_us, board->due_us) < CLEARANCE_US))) {
        return false;
    }
    return board->is_own_slot || ((now_us - board->busy_us) >= QUIET_US) ||
           ((now_us - board->measured_us) >= MEASURE_ANYWHERE_US);
}

/* Check and measure a chip that is configured; whether something was due. */
static bool do_chores(struct board *board, uint32_t now_us)
{
    bool measures = !is_tag(board) && ((now_us - board->measured_us) >= MEASURE_US) && is_free(board, now_us);
    bool checks = measures || ((now_us - board->checked_us) >= CHECK_US);

    if (checks) {
        board->checked_us = now_us;
        if (!dw1000_check(&board->chip)) {
            on_lost(board);
        } else if (measures) {
            board->measured_us = now_us;
            (void)dw1000_measure(&board->chip);
        }
    }
    return checks;
}

/* The whole */

static void show(const struct board *board, uint32_t now_us)
{
    bool is_ready = board->is_receiving || ((now_us & BLINK_BIT) != 0u);

    board->hardware->show((is_ready ? LIGHT_READY : 0u) | (((board->chip.received & 16u) != 0u) ? LIGHT_RECEIVED : 0u) |
                          (((board->chip.sent & 4u) != 0u) ? LIGHT_SENT : 0u) |
                          ((board->was_refused || board->is_polled) ? LIGHT_FAULT : 0u));
}

static uint32_t least(uint32_t one, uint32_t other)
{
    return (one < other) ? one : other;
}

/* What is left of a period that began at `since_us`. */
static uint32_t left_of(uint32_t period_us, uint32_t since_us, uint32_t now_us)
{
    uint32_t passed_us = now_us - since_us;

    return (passed_us >= period_us) ? 0u : (period_us - passed_us);
}

/* Until something has to be done by the clock, of a board that has nothing to do now. */
static uint32_t idle_us(const struct board *board, uint32_t now_us)
{
    uint32_t left_us = BLINK_BIT - (now_us & (BLINK_BIT - 1u));

    if (board->is_configured) {
        left_us = least(left_us, left_of(board->is_polled ? FAST_POLL_US : POLL_US, board->polled_us, now_us));
        left_us = least(left_us, left_of(CHECK_US, board->checked_us, now_us));
        if ((now_us - board->measured_us) >= MEASURE_US) {
            uint32_t quiet_us = left_of(QUIET_US, board->busy_us, now_us);

            left_us = least(left_us, (quiet_us == 0u) ? POLL_US : quiet_us);
        }
    }
    if (board->stage != NO_FRAME) {
        left_us = least(left_us, (uint32_t)from_to(now_us, board->due_us));
    }
    return left_us;
}

void board_init(struct board *board, const struct hardware *hardware, const struct board_identity *identity)
{
    (void)memset(board, 0, sizeof *board);
    board->hardware = hardware;
    board->identity = *identity;
    board->writer.write_line = hardware->write_line;
    board->settings = SETTINGS_DEFAULT;
    board->tag.hardware = hardware;
    board->tag.settings = &board->settings;
    board->tag.chip = &board->chip;
    board->tag.writer = &board->writer;
    dw1000_init(&board->chip, hardware);
    board->measured_us = hardware->now_us() - MEASURE_US;
    board->chip.millivolts = LINK_NO_VOLTAGE;
}

void board_pause(void)
{
    if ((computing != NULL) && has_chip(computing)) {
        poll_now(computing);
    }
}

/* Let a tag do one thing, or start its chip; for how long nothing is to be done then. */
static uint32_t serve_tag(struct board *board, uint32_t now_us)
{
    uint32_t idle_us = RETRY_US;

    if (board->is_configured) {
        computing = board;
        idle_us = tag_turn(&board->tag);
        computing = NULL;
    } else if ((now_us - board->tried_us) >= RETRY_US) {
        start_tag(board);
    }
    return idle_us;
}

void board_begin(struct board *board)
{
    const uint8_t zero = 0u;

    board->is_in_flash = read_settings(board, &board->settings);
    if (!board->is_in_flash) {
        board->settings = SETTINGS_DEFAULT;
    }
    board->kept_baud = board->settings.baud;
    board->hardware->set_rate(board->settings.baud);
    (void)board->hardware->write_line(&zero, 1u);
    send_hello(board);
    use_settings(board);
}

uint32_t board_turn(struct board *board)
{
    uint32_t now_us = board->hardware->now_us();
    bool line_is_high = board->hardware->interrupt_line();
    bool is_busy = false;
    uint32_t tag_us = RETRY_US;
    uint32_t test_us;

    board->is_own_slot = false;
    if (has_chip(board) && is_poll_due(board, line_is_high, now_us)) {
        uint32_t received = board->chip.received;

        board->polled_us = now_us;
        is_busy = poll(board, line_is_high) || (line_is_high && !board->is_polled);
        if (board->chip.received != received) {
            board->reception_us = board->hardware->now_us() - now_us;
        }
    }
    is_busy = serve_host(board) || is_busy;
    if (is_busy) {
        now_us = board->hardware->now_us();
        board->busy_us = now_us;
    }
    if ((board->stage != NO_FRAME) && (from_to(board->due_us, now_us) >= 0)) {
        serve_frame(board);
        is_busy = true;
    } else if (has_chip(board)) {
        is_busy = do_chores(board, now_us) || is_busy;
    }
    if (is_tag(board)) {
        tag_us = serve_tag(board, now_us);
    }
    if ((board->settings.baud != board->kept_baud) && ((now_us - board->understood_us) >= RATE_TRIAL_US)) {
        board_begin(board);
    }
    test_us = selftest_turn(board, now_us);
    show(board, now_us);
    return is_busy ? 0u : least(least(tag_us, test_us), idle_us(board, now_us));
}
