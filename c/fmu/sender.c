/* Sender as a node of an FMU: lines to frames, at their deadlines.
 *
 * Frames of a line are sent at once. If the bus notifies (BusNotifications), each is sent when the
 * one before is confirmed, and again when it was not sent; after a period, the rest of a line is
 * given up, as by the transmitter of the Python package whose queue stays full.
 */
#include "fmu.h"

#include <math.h>
#include <string.h>

#define TOLERANCE 1e-9 /* of the time at which the clock ticks [s] */

static void count(maplines_instance_t *instance, size_t index, uint64_t number)
{
    instance->state.values.counts[index] += number;
}

/* ---- the node -------------------------------------------------------------------------------- */

void maplines_bind(maplines_node_t *node)
{
    node->encoder.dbc = &MAPLINES_DBC;
}

void maplines_unbind(maplines_node_t *node)
{
    node->encoder.dbc = NULL;
}

/// Whether the DBC has a message of a line with CAN FD, or without.
static bool has_messages(bool is_fd)
{
    bool has = false;
    for (int slot = 0; slot < MAPLINES_SLOTS; slot++)
    {
        const maplines_messages_t *messages = &MAPLINES_DBC.messages[slot];
        has = has || (messages->is_present && (is_fd ? messages->has_fd : messages->has_classic));
    }
    return has;
}

const char *maplines_start(maplines_instance_t *instance)
{
    const maplines_values_t *values = &instance->state.values;
    maplines_node_t *node = &instance->state.node;
    const bool is_fd = values->flags[FLAG_FD];
    const char *wrong = NULL;
    maplines_encoder_init(&node->encoder, &MAPLINES_DBC, NULL);
    node->queue.period = values->reals[REAL_CYCLE_TIME];
    node->queue.max_age = values->reals[REAL_MAX_AGE];
    if (!(node->queue.period >= 0.001 && node->queue.period <= 3600.0))
    {
        wrong = "cycle_time must be in [0.001, 3600] s";
    }
    else if (!(node->queue.max_age > 0.0 &&
               node->queue.max_age <= maplines_start_reals[REAL_MAX_AGE]))
    {
        wrong = "max_age must be above 0 s and at most its start value, the greatest age that the "
                "DBC can state";
    }
    else if (!has_messages(is_fd))
    {
        wrong = is_fd ? "fd must be false: the DBC has no CAN FD messages"
                      : "fd must be true: the DBC has no classic messages";
    }
    else if (is_fd && values->counts[COUNT_FD_BAUD_RATE] == 0)
    {
        wrong = "fd needs CAN.fd_baud_rate";
    }
    return wrong != NULL ? wrong : maplines_start_input(instance);
}

/* ---- sending --------------------------------------------------------------------------------- */

void maplines_refuse(maplines_instance_t *instance, int slot, maplines_refusal_t refusal)
{
    count(instance, COUNT_REFUSED, 1);
    instance->state.values.choices[CHOICE_REFUSAL] = (int64_t)refusal;
    maplines_log(instance, fmi3Warning, "the line of slot %s is not sent: %s",
                 maplines_owner_name((maplines_owner_t)slot), maplines_refusal_name(refusal));
}

/// Encode the line that is due; false if it is refused.
static bool encode(maplines_instance_t *instance)
{
    maplines_node_t *node = &instance->state.node;
    maplines_sending_t *sending = &node->sending;
    const maplines_input_t *line = &sending->due.line;
    const maplines_sent_t sent = maplines_encode_line(
        &node->encoder, line, instance->state.values.flags[FLAG_FD], 0, sending->frames);
    sending->count = sent.count;
    sending->next = 0;
    if (sent.refusal != MAPLINES_SENT)
    {
        maplines_refuse(instance, (int)line->slot, sent.refusal);
    }
    return sent.refusal == MAPLINES_SENT;
}

/// Time until which lines are due [s]: that of a tick is a sum of intervals, so it may be early.
static double due_time(const maplines_instance_t *instance)
{
    const double first = maplines_first_deadline(&instance->state.node.queue);
    const double now = instance->state.now;
    return first <= now + TOLERANCE ? fmax(first, now) : now;
}

/// Take the next line that is due, and encode it; false if there is none.
static bool take_next(maplines_instance_t *instance)
{
    maplines_node_t *node = &instance->state.node;
    maplines_sending_t *sending = &node->sending;
    const double due = due_time(instance);
    bool is_taken = false;
    while (!is_taken && maplines_take(&node->queue, due, &sending->due))
    {
        if (due > sending->due.latest)
        {
            maplines_renew(&node->queue, due, &sending->due);
        }
        count(instance, COUNT_OVERRUNS, sending->due.skipped);
        sending->counter = node->encoder.counter[sending->due.line.slot];
        is_taken = encode(instance);
    }
    return is_taken;
}

/// End the line that is sent, and count it.
static void finish(maplines_instance_t *instance, bool is_sent)
{
    maplines_sending_t *sending = &instance->state.node.sending;
    count(instance, is_sent ? COUNT_LINES : COUNT_GIVEN_UP, 1);
    count(instance, COUNT_EXPIRED, is_sent && sending->due.is_expired ? 1 : 0);
    sending->count = 0;
    sending->next = 0;
    sending->is_waiting = false;
}

/// Time when the rest of the line that is sent is given up [s].
static double give_up_time(const maplines_node_t *node)
{
    return node->sending.due.deadline + node->queue.period;
}

/// Send the next frame of the line that is sent, and wait for the bus to confirm it.
static void send_next(maplines_instance_t *instance)
{
    maplines_node_t *node = &instance->state.node;
    maplines_sending_t *sending = &node->sending;
    bool is_right = true;
    if (sending->next == 0 && instance->state.now > sending->due.latest)
    {
        maplines_renew(&node->queue, instance->state.now, &sending->due);
        node->encoder.counter[sending->due.line.slot] = sending->counter;
        is_right = encode(instance);
    }
    if (is_right && maplines_send(instance, &sending->frames[sending->next]))
    {
        sending->is_waiting = true;
    }
    else
    {
        finish(instance, false);
    }
}

/// Send all frames of the lines that are due.
static void send_all(maplines_instance_t *instance)
{
    maplines_sending_t *sending = &instance->state.node.sending;
    while (take_next(instance))
    {
        bool is_sent = true;
        for (uint16_t i = 0; i < sending->count && is_sent; i++)
        {
            is_sent = maplines_send(instance, &sending->frames[i]);
        }
        finish(instance, is_sent);
    }
}

static bool is_off(const maplines_instance_t *instance)
{
    return instance->state.controller.state == MAPLINES_BUS_OFF;
}

/// Give up all lines that are due.
static void give_up_due(maplines_instance_t *instance)
{
    maplines_sending_t *sending = &instance->state.node.sending;
    if (sending->count > 0)
    {
        finish(instance, false);
    }
    while (maplines_take(&instance->state.node.queue, due_time(instance), &sending->due))
    {
        count(instance, COUNT_GIVEN_UP, 1 + sending->due.skipped);
    }
}

void maplines_send_due(maplines_instance_t *instance)
{
    maplines_node_t *node = &instance->state.node;
    maplines_sending_t *sending = &node->sending;
    if (is_off(instance))
    {
        give_up_due(instance);
        return;
    }
    if (!instance->state.values.flags[FLAG_BUS_NOTIFICATIONS])
    {
        send_all(instance);
        return;
    }
    if (sending->count > 0 && instance->state.now + TOLERANCE >= give_up_time(node))
    {
        finish(instance, false);
    }
    if (!sending->is_waiting && (sending->count > 0 || take_next(instance)))
    {
        send_next(instance);
    }
}

void maplines_take_notification(maplines_instance_t *instance, uint32_t can_id,
                                bool is_acknowledged)
{
    maplines_sending_t *sending = &instance->state.node.sending;
    if (!sending->is_waiting || sending->frames[sending->next].can_id != can_id)
    {
        return;
    }
    sending->is_waiting = false; // otherwise it is sent again
    if (is_acknowledged)
    {
        sending->next++;
        if (sending->next == sending->count)
        {
            finish(instance, true);
        }
    }
}

double maplines_next_due(const maplines_instance_t *instance)
{
    const maplines_node_t *node = &instance->state.node;
    if (is_off(instance))
    {
        return (double)INFINITY;
    }
    if (node->sending.is_waiting)
    {
        return give_up_time(node);
    }
    return node->sending.count > 0 ? instance->state.now : maplines_first_deadline(&node->queue);
}

void maplines_take_frame(maplines_instance_t *instance, const maplines_frame_t *frame)
{
    (void)instance; // a sender reads no frames
    (void)frame;
}

void maplines_refresh(maplines_instance_t *instance)
{
    if (is_off(instance)) // it announces no tick
    {
        give_up_due(instance);
    }
}
