/* What `skyless selftest` asks of a board: readings of chip and processor, and records that test the line. */
#ifndef SELFTEST_H
#define SELFTEST_H

#include "board.h"

/* Answer READ with VALUE; false where the record is malformed. */
bool selftest_read(struct board *board, const uint8_t *record, uint32_t length);

/* Count a TEST_LINE, and begin to send the records that it asks for; false where it is malformed. */
bool selftest_begin_line(struct board *board, const uint8_t *record, uint32_t length);

/* Send the next of these records if it is due; for how many microseconds none is. */
uint32_t selftest_turn(struct board *board, uint32_t now_us);

#endif
