/* Deadlines of a sender, and the lines that are sent at them. */
#include "tx_queue.h"

#include <math.h>

#define AHEAD 0.1       /* longest time before its deadline that a line is taken [s] */
#define ALLOWANCE 0.004 /* lateness that the age includes [s] */

/// Offset of the deadlines of a slot, as a share of the period.
static double phase_of(int slot)
{
    return (double)slot / MAPLINES_SLOTS;
}

static double deadline_of(const maplines_tx_queue_t *queue, int slot, double cycle)
{
    return queue->t0 + (cycle + phase_of(slot)) * queue->period;
}

static double next_deadline(const maplines_tx_queue_t *queue, int slot)
{
    return deadline_of(queue, slot, queue->slots[slot].cycle);
}

/// Slot that is due first; -1 if there is none.
static int first_slot(const maplines_tx_queue_t *queue)
{
    int first = -1;
    for (int slot = 0; slot < MAPLINES_SLOTS; slot++)
    {
        if (queue->slots[slot].is_published &&
            (first < 0 || next_deadline(queue, slot) < next_deadline(queue, first)))
        {
            first = slot;
        }
    }
    return first;
}

/// State the age at `latest` [s], infinite if it exceeds the greatest one.
static void set_age(const maplines_tx_queue_t *queue, double latest, maplines_due_t *due)
{
    const double age = fmax(0.0, due->own.line.age + latest - due->own.at);
    due->latest = latest;
    due->line = due->own.line;
    due->line.age = age <= queue->max_age ? age : (double)INFINITY;
    due->is_expired = !(age <= queue->max_age);
}

/// Take the line of a slot as it is now, for a deadline.
static void take_ahead(maplines_tx_queue_t *queue, int slot, double deadline)
{
    maplines_queued_t *queued = &queue->slots[slot];
    queued->is_ahead = true;
    queued->is_new = false;
    queued->ahead.own = queued->own;
    queued->ahead.deadline = deadline;
    queued->ahead.skipped = 0;
    set_age(queue, deadline + ALLOWANCE, &queued->ahead);
}

/// Take the line of a slot that is due, and those of others that are due soon.
static void take_together(maplines_tx_queue_t *queue, int due, double deadline)
{
    for (int slot = 0; slot < MAPLINES_SLOTS; slot++)
    {
        const maplines_queued_t *queued = &queue->slots[slot];
        if (slot != due && queued->is_published && !queued->is_ahead)
        {
            const double then = next_deadline(queue, slot);
            const double until =
                queued->is_new ? queued->own.at + queue->period : deadline + queue->period / 2;
            if (then < fmin(until, deadline + AHEAD))
            {
                take_ahead(queue, slot, then);
            }
        }
    }
    take_ahead(queue, due, deadline);
}

void maplines_publish(maplines_tx_queue_t *queue, const maplines_input_t *line, double now)
{
    const int slot = (int)line->slot;
    maplines_queued_t *queued = &queue->slots[slot];
    if (!queue->has_t0)
    {
        queue->t0 = now - phase_of(slot) * queue->period;
        queue->has_t0 = true;
    }
    if (!queued->is_published)
    {
        // The tolerance of a millionth of a period covers rounding after months.
        queued->cycle = ceil((now - queue->t0) / queue->period - phase_of(slot) - 1e-6);
    }
    queued->is_published = true;
    queued->is_new = true;
    queued->own.line = *line;
    queued->own.at = now;
}

void maplines_drop(maplines_tx_queue_t *queue, int slot)
{
    queue->slots[slot].is_published = false;
    queue->slots[slot].is_ahead = false;
}

double maplines_first_deadline(const maplines_tx_queue_t *queue)
{
    const int first = first_slot(queue);
    return first < 0 ? (double)INFINITY : next_deadline(queue, first);
}

bool maplines_take(maplines_tx_queue_t *queue, double now, maplines_due_t *due)
{
    const int slot = first_slot(queue);
    if (slot < 0 || next_deadline(queue, slot) > now)
    {
        return false;
    }
    maplines_queued_t *queued = &queue->slots[slot];
    const double elapsed = (now - queue->t0) / queue->period - phase_of(slot);
    const double newest = trunc(fmax(elapsed, queued->cycle));
    const double deadline = deadline_of(queue, slot, newest);
    const double skipped = newest - queued->cycle;
    queued->cycle = newest + 1;
    if (!queued->is_ahead || queued->ahead.deadline < deadline)
    {
        queued->is_ahead = false; // if it was taken, then for a deadline that was missed
        take_together(queue, slot, deadline);
    }
    queued->is_ahead = false;
    *due = queued->ahead;
    due->skipped = (uint64_t)skipped;
    return true;
}

void maplines_renew(const maplines_tx_queue_t *queue, double now, maplines_due_t *due)
{
    set_age(queue, now + fmax(ALLOWANCE, now - due->deadline), due);
}
