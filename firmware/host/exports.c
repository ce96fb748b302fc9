/* For Python (emulator/board_library.py, PLACES): sizes, and where in a board its parts are. */
#include <stddef.h>

#include "board.h"

extern const uint32_t host_places[];

const uint32_t host_places[] = {
    sizeof(struct board),           sizeof(struct dw1000),         offsetof(struct board, chip),
    offsetof(struct board, settings), offsetof(struct board, stage), offsetof(struct board, tag.unix_us),
};
