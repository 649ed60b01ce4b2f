/* CAN controller of a node: operations of the bus, fault confinement, and what is sent.
 *
 * Error counters are those of ISO 11898-1, as far as a bus simulation tells of errors:
 *
 *     transmit errors   + 8 for an error of a frame of this node,  - 1 for a confirmed frame
 *     receive errors    + 8 for another error that this node detected, + 1 if it did not,
 *                       - 1 for a received frame (from more than 127, to 127)
 *     state             ERROR_PASSIVE from 128 of either on, BUS_OFF from 256 transmit errors on
 *
 * A node that is BUS_OFF sends nothing until fmi3Reset. Without the parameter BusNotifications, a
 * node waits for no notification, and ignores those that come.
 */
#include "fmu.h"

#include <math.h>
#include <string.h>

#define MAX_ECHO 1024 ///< bytes of a malformed operation that are sent back

static void count(maplines_instance_t *instance, size_t index)
{
    instance->state.values.counts[index]++;
}

void maplines_start_controller(maplines_instance_t *instance)
{
    const maplines_values_t *values = &instance->state.values;
    maplines_controller_t *controller = &instance->state.controller;
    memset(controller, 0, sizeof *controller);
    controller->announced = (double)NAN;
    controller->state = MAPLINES_ERROR_ACTIVE;
    (void)maplines_write_rate(&controller->tx, MAPLINES_CAN_RATE,
                              (uint32_t)values->counts[COUNT_BAUD_RATE]);
    if (values->counts[COUNT_FD_BAUD_RATE] > 0)
    {
        (void)maplines_write_rate(&controller->tx, MAPLINES_FD_RATE,
                                  (uint32_t)values->counts[COUNT_FD_BAUD_RATE]);
    }
    (void)maplines_write_arbitration(
        &controller->tx, (maplines_arbitration_t)values->choices[CHOICE_ARBITRATION_LOST]);
}

/// Set the state that follows from the error counters, and tell the bus when it changes.
static void confine(maplines_instance_t *instance)
{
    maplines_controller_t *controller = &instance->state.controller;
    const maplines_can_state_t before = controller->state;
    if (before == MAPLINES_BUS_OFF || controller->transmit_errors >= 256)
    {
        controller->state = MAPLINES_BUS_OFF;
    }
    else
    {
        const bool is_passive =
            controller->transmit_errors >= 128 || controller->receive_errors >= 128;
        controller->state = is_passive ? MAPLINES_ERROR_PASSIVE : MAPLINES_ERROR_ACTIVE;
    }
    if (controller->state != before)
    {
        (void)maplines_write_status(&controller->tx, controller->state);
    }
}

static void take_data(maplines_instance_t *instance, const maplines_operation_t *operation)
{
    maplines_controller_t *controller = &instance->state.controller;
    if (controller->receive_errors > 0)
    {
        controller->receive_errors =
            controller->receive_errors > 127 ? 127 : controller->receive_errors - 1;
    }
    if (!operation->is_remote)
    {
        maplines_take_frame(instance, &operation->frame);
    }
}

static void take_confirmation(maplines_instance_t *instance, const maplines_operation_t *operation)
{
    maplines_controller_t *controller = &instance->state.controller;
    count(instance, COUNT_CONFIRMED);
    if (controller->transmit_errors > 0)
    {
        controller->transmit_errors--;
    }
    maplines_take_notification(instance, operation->can_id, true);
}

static void take_bus_error(maplines_instance_t *instance, const maplines_operation_t *operation)
{
    maplines_controller_t *controller = &instance->state.controller;
    count(instance, COUNT_BUS_ERRORS);
    if (operation->is_sender)
    {
        controller->transmit_errors += 8;
        maplines_take_notification(instance, operation->can_id, false);
    }
    else
    {
        controller->receive_errors += operation->is_primary ? 8 : 1;
        controller->receive_errors =
            controller->receive_errors > 255 ? 255 : controller->receive_errors;
    }
}

static void take_operation(maplines_instance_t *instance, const maplines_operation_t *operation)
{
    const bool is_notified = instance->state.values.flags[FLAG_BUS_NOTIFICATIONS];
    switch (operation->code)
    {
    case MAPLINES_TRANSMIT:
    case MAPLINES_TRANSMIT_FD:
        take_data(instance, operation);
        break;
    case MAPLINES_CONFIRM:
        if (is_notified)
        {
            take_confirmation(instance, operation);
        }
        break;
    case MAPLINES_ARBITRATION_LOST:
        if (is_notified)
        {
            count(instance, COUNT_ARBITRATIONS_LOST);
            maplines_take_notification(instance, operation->can_id, false);
        }
        break;
    case MAPLINES_BUS_ERROR:
        if (is_notified)
        {
            take_bus_error(instance, operation);
        }
        break;
    case MAPLINES_FORMAT_ERROR:
        count(instance, COUNT_FORMAT_ERRORS);
        maplines_log(instance, fmi3Warning, "another participant received a malformed operation");
        break;
    default: // CAN XL, wake-ups, and what is for a bus simulation
        break;
    }
}

void maplines_receive(maplines_instance_t *instance)
{
    maplines_controller_t *controller = &instance->state.controller;
    maplines_operation_t operation;
    maplines_reading_t reading = MAPLINES_READ;
    size_t at = 0;
    while (reading != MAPLINES_END)
    {
        reading = maplines_read_operation(controller->rx, controller->rx_size, &at, &operation);
        if (reading == MAPLINES_READ)
        {
            take_operation(instance, &operation);
            confine(instance);
        }
        else if (reading == MAPLINES_MALFORMED)
        {
            const size_t length = operation.length < MAX_ECHO ? operation.length : MAX_ECHO;
            count(instance, COUNT_MALFORMED);
            maplines_log(instance, fmi3Warning, "a malformed bus operation of %lu bytes is dropped",
                         (unsigned long)operation.length);
            (void)maplines_write_format_error(&controller->tx, operation.bytes, length);
        }
    }
    controller->rx_size = 0;
    instance->state.is_fresh = false;
}

void maplines_fill(maplines_instance_t *instance)
{
    maplines_controller_t *controller = &instance->state.controller;
    if (controller->tx_clock && !controller->is_filled)
    {
        controller->is_filled = true;
        maplines_take_inputs(instance);
        maplines_send_due(instance);
        instance->state.is_fresh = false;
    }
}

bool maplines_send(maplines_instance_t *instance, const maplines_frame_t *frame)
{
    maplines_controller_t *controller = &instance->state.controller;
    if (controller->state == MAPLINES_BUS_OFF)
    {
        return false;
    }
    if (!maplines_write_frame(&controller->tx, frame))
    {
        maplines_log(instance, fmi3Warning, "a frame is dropped: more than %d bytes at a time",
                     MAPLINES_TX_SIZE);
        return false;
    }
    count(instance, COUNT_FRAMES_SENT);
    return true;
}

double maplines_next_tick(maplines_instance_t *instance)
{
    maplines_take_inputs(instance);
    const double due = maplines_next_due(instance);
    return instance->state.controller.tx.size > 0 ? instance->state.now : due;
}

void maplines_show_controller(maplines_instance_t *instance)
{
    const maplines_controller_t *controller = &instance->state.controller;
    maplines_values_t *values = &instance->state.values;
    values->choices[CHOICE_CAN_STATE] = (int64_t)controller->state;
    values->counts[COUNT_TRANSMIT_ERRORS] = controller->transmit_errors;
    values->counts[COUNT_RECEIVE_ERRORS] = controller->receive_errors;
}
