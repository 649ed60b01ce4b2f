/* Deadlines of a sender, and the lines that are sent at them: bus/tx_queue.py and bus/schedule.py
 * of the Python package, with the same operations in the same order, so that frames are the same.
 *
 *     slot s is due at   t0 + (k + s / 8) period,   k = 0, 1, ...
 *
 * The lines of a cycle are taken together. When one is due, so are those that are due soon and
 * unlikely to be replaced before: a new value, if its deadline is less than a period after it was
 * published; a repeated one, if its deadline is less than half a period away.
 */
#ifndef MAPLINES_TX_QUEUE_H
#define MAPLINES_TX_QUEUE_H

#include "maplines.h"

/// A line with the time when it was published.
typedef struct {
    maplines_input_t line; ///< with its age at that time
    double at;             ///< [s]
} maplines_published_t;

/// A line that is due.
typedef struct {
    maplines_input_t line; ///< with the age that is sent
    maplines_published_t own;
    double deadline;  ///< [s]
    double latest;    ///< until then, the age that is sent is not too small [s]
    uint64_t skipped; ///< deadlines of the slot that were missed before this one
    bool is_expired;  ///< the age is sent as "too old"
} maplines_due_t;

/// A slot of the queue.
typedef struct {
    bool is_published;
    bool is_new;   ///< published since it was last taken
    bool is_ahead; ///< taken with another one, not due yet
    double cycle;  ///< of the next deadline, a whole number
    maplines_published_t own;
    maplines_due_t ahead;
} maplines_queued_t;

/// Lines with their deadlines.
typedef struct {
    double period;  ///< [s]
    double max_age; ///< greatest age that is stated [s]
    double t0;      ///< start of cycle 0 [s]
    bool has_t0;
    maplines_queued_t slots[MAPLINES_SLOTS];
} maplines_tx_queue_t;

/// Publish a line at `now` [s] in place of the previous one of its slot.
void maplines_publish(maplines_tx_queue_t *queue, const maplines_input_t *line, double now);
/// Remove the line of a slot; there may be none.
void maplines_drop(maplines_tx_queue_t *queue, int slot);
/// The next deadline [s]; infinite if there is none.
double maplines_first_deadline(const maplines_tx_queue_t *queue);
/// Take a line that is due, once for each deadline; false if none is.
bool maplines_take(maplines_tx_queue_t *queue, double now, maplines_due_t *due);
/// State the age of a late line anew: that when it will be twice as late.
void maplines_renew(const maplines_tx_queue_t *queue, double now, maplines_due_t *due);

#endif
