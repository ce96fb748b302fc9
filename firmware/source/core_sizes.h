/* Sizes of the estimator's records on the board, before those of a computer (skyless/core/native/records.py). The compiler
 * includes this file before the core's; tests read it too. */
#ifndef CORE_SIZES_H
#define CORE_SIZES_H

#define MAX_ANCHORS 8
#define PACKETS_KEPT 8
#define MAX_RELAYS 13
#define PHASE_STATES 0
#define HYPOTHESES 0
#define MOTION_STATES 0
#define PLANNED_FAULTS 0
#define PACKED true
#ifndef MOST_WAITING /* a multiple of 4 without core_by_hand.h */
#define MOST_WAITING 6
#endif
#define MAX_NEIGHBOURS 16
#define MAX_SITES 2
#define MAX_COUNTED 12
#define MAX_ANCHORS_IN_USE 8
#define RELAYS_KEPT 3
#define MAX_PAGES 8
#define MAX_SENDERS 8
#define SHARES_MEMORY true
#define HAS_ORIGIN true

#endif
