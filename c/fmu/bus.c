/* Bus operations of FMI-LS-BUS for CAN, read and written byte by byte. */
#include "bus.h"

#include <string.h>

static uint32_t read_integer(const uint8_t *bytes, size_t count)
{
    uint32_t value = 0;
    for (size_t i = count; i > 0; i--)
    {
        value = (value << 8) | bytes[i - 1];
    }
    return value;
}

static uint8_t *write_integer(uint8_t *bytes, uint32_t value, size_t count)
{
    for (size_t i = 0; i < count; i++)
    {
        bytes[i] = (uint8_t)((value >> (8 * i)) & 0xFFU);
    }
    return bytes + count;
}

/* ---- read ------------------------------------------------------------------------------------ */

/// Read a transmission of CAN or CAN FD; false if it is malformed.
static bool read_transmission(maplines_operation_t *operation, bool is_fd)
{
    const size_t flags = is_fd ? 3 : 2; // bytes between the ID and the length of the data
    const size_t fixed = MAPLINES_OPERATION_HEADER + 4 + flags + 2;
    const uint8_t *bytes = operation->bytes + MAPLINES_OPERATION_HEADER;
    maplines_frame_t *frame = &operation->frame;
    if (operation->length < fixed)
    {
        return false;
    }
    const uint32_t length = read_integer(bytes + 4 + flags, 2);
    operation->is_remote = !is_fd && bytes[5] == 1;
    // A remote frame states the length that it asks for; nodes give it data, too, or none.
    const bool is_short = operation->is_remote && operation->length == fixed;
    bool is_right =
        length <= (is_fd ? 64U : 8U) && (is_short || operation->length == fixed + length);
    for (size_t i = 4; i < 4 + flags; i++)
    {
        is_right = is_right && bytes[i] <= 1;
    }
    frame->can_id = read_integer(bytes, 4);
    frame->is_extended = bytes[4] == 1;
    frame->is_fd = is_fd;
    if (!is_right || frame->can_id > (frame->is_extended ? 0x1FFFFFFFU : 0x7FFU))
    {
        return false;
    }
    frame->length = (uint8_t)length;
    memcpy(frame->data, operation->bytes + fixed, is_short ? 0 : length);
    return true;
}

/// Whether a configuration has the length of its parameter.
static bool is_configuration(const maplines_operation_t *operation)
{
    if (operation->length <= MAPLINES_OPERATION_HEADER)
    {
        return false;
    }
    const uint8_t parameter = operation->bytes[MAPLINES_OPERATION_HEADER];
    const size_t length = parameter == MAPLINES_ON_ARBITRATION_LOST ? 1 : 4;
    return parameter >= MAPLINES_CAN_RATE && parameter <= MAPLINES_ON_ARBITRATION_LOST &&
           operation->length == MAPLINES_OPERATION_HEADER + 1 + length;
}

/// Whether a frame of CAN XL, which no node here reads, has the length that it states.
static bool is_xl_transmission(const maplines_operation_t *operation)
{
    const size_t fixed = 22;
    return operation->length >= fixed &&
           operation->length == fixed + read_integer(operation->bytes + fixed - 2, 2);
}

/// Read the arguments of an operation whose code and length are known; false if it is malformed.
static bool read_arguments(maplines_operation_t *operation)
{
    const uint8_t *bytes = operation->bytes + MAPLINES_OPERATION_HEADER;
    const size_t arguments = operation->length - MAPLINES_OPERATION_HEADER;
    switch (operation->code)
    {
    case MAPLINES_FORMAT_ERROR:
        return arguments >= 2 && arguments == 2 + read_integer(bytes, 2);
    case MAPLINES_TRANSMIT:
    case MAPLINES_TRANSMIT_FD:
        return read_transmission(operation, operation->code == MAPLINES_TRANSMIT_FD);
    case MAPLINES_TRANSMIT_XL:
        return is_xl_transmission(operation);
    case MAPLINES_CONFIRM:
    case MAPLINES_ARBITRATION_LOST:
        operation->can_id = arguments == 4 ? read_integer(bytes, 4) : 0;
        return arguments == 4;
    case MAPLINES_BUS_ERROR:
        if (arguments != 7 || bytes[4] < 1 || bytes[4] > 6 || bytes[5] < 1 || bytes[5] > 2 ||
            bytes[6] > 1)
        {
            return false;
        }
        operation->can_id = read_integer(bytes, 4);
        operation->is_primary = bytes[5] == 1;
        operation->is_sender = bytes[6] == 1;
        return true;
    case MAPLINES_CONFIGURATION:
        return is_configuration(operation);
    case MAPLINES_STATUS:
        return arguments == 1 && bytes[0] >= MAPLINES_ERROR_ACTIVE && bytes[0] <= MAPLINES_BUS_OFF;
    case MAPLINES_WAKEUP:
        return arguments == 0;
    default:
        return false;
    }
}

maplines_reading_t maplines_read_operation(const uint8_t *bytes, size_t size, size_t *at,
                                           maplines_operation_t *operation)
{
    const size_t left = size - *at;
    if (left == 0)
    {
        return MAPLINES_END;
    }
    memset(operation, 0, sizeof *operation);
    operation->bytes = bytes + *at;
    operation->length = left;
    const uint32_t length =
        left < MAPLINES_OPERATION_HEADER ? 0 : read_integer(operation->bytes + 4, 4);
    if (length < MAPLINES_OPERATION_HEADER || length > left)
    {
        *at = size;
        return MAPLINES_MALFORMED;
    }
    operation->length = length;
    operation->code = (maplines_code_t)read_integer(operation->bytes, 4);
    *at += length;
    return read_arguments(operation) ? MAPLINES_READ : MAPLINES_MALFORMED;
}

/* ---- write ----------------------------------------------------------------------------------- */

/// Begin an operation with so many bytes of arguments; where they begin, or NULL without room.
static uint8_t *begin(maplines_operations_t *operations, maplines_code_t code, size_t arguments)
{
    const size_t length = MAPLINES_OPERATION_HEADER + arguments;
    if (length > MAPLINES_TX_SIZE - operations->size)
    {
        return NULL;
    }
    uint8_t *bytes = operations->bytes + operations->size;
    operations->size += length;
    bytes = write_integer(bytes, (uint32_t)code, 4);
    return write_integer(bytes, (uint32_t)length, 4);
}

bool maplines_write_frame(maplines_operations_t *operations, const maplines_frame_t *frame)
{
    const size_t flags = frame->is_fd ? 3 : 2;
    const maplines_code_t code = frame->is_fd ? MAPLINES_TRANSMIT_FD : MAPLINES_TRANSMIT;
    uint8_t *bytes = begin(operations, code, 4 + flags + 2 + frame->length);
    if (bytes == NULL)
    {
        return false;
    }
    bytes = write_integer(bytes, frame->can_id, 4);
    bytes = write_integer(bytes, frame->is_extended ? 1 : 0, 1);
    bytes = write_integer(bytes, frame->is_fd ? 1 : 0, 1); // rate switch, or no remote frame
    bytes = write_integer(bytes, 0, flags - 2);            // of CAN FD: error active
    bytes = write_integer(bytes, frame->length, 2);
    memcpy(bytes, frame->data, frame->length);
    return true;
}

bool maplines_write_rate(maplines_operations_t *operations, maplines_parameter_t parameter,
                         uint32_t bits_per_s)
{
    uint8_t *bytes = begin(operations, MAPLINES_CONFIGURATION, 5);
    if (bytes != NULL)
    {
        bytes = write_integer(bytes, (uint32_t)parameter, 1);
        (void)write_integer(bytes, bits_per_s, 4);
    }
    return bytes != NULL;
}

bool maplines_write_arbitration(maplines_operations_t *operations, maplines_arbitration_t what)
{
    uint8_t *bytes = begin(operations, MAPLINES_CONFIGURATION, 2);
    if (bytes != NULL)
    {
        bytes = write_integer(bytes, MAPLINES_ON_ARBITRATION_LOST, 1);
        (void)write_integer(bytes, (uint32_t)what, 1);
    }
    return bytes != NULL;
}

bool maplines_write_status(maplines_operations_t *operations, maplines_can_state_t status)
{
    uint8_t *bytes = begin(operations, MAPLINES_STATUS, 1);
    if (bytes != NULL)
    {
        (void)write_integer(bytes, (uint32_t)status, 1);
    }
    return bytes != NULL;
}

bool maplines_write_format_error(maplines_operations_t *operations, const uint8_t *bytes,
                                 size_t length)
{
    uint8_t *out =
        length > UINT16_MAX ? NULL : begin(operations, MAPLINES_FORMAT_ERROR, 2 + length);
    if (out != NULL)
    {
        out = write_integer(out, (uint32_t)length, 2);
        memcpy(out, bytes, length);
    }
    return out != NULL;
}
