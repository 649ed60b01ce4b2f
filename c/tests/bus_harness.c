/* Operations of bus.c beside those that the official headers of FMI-LS-BUS write: the same bytes,
 * and read back they are what they were.
 */
#include "bus.h"

#include "fmi3LsBusUtilCan.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const maplines_frame_t classic = {0x18FF1234, true, false, 3, {1, 2, 3}};
static const maplines_frame_t fd = {0x348, false, true, 12, {9, 8, 7, 6, 5, 4, 3, 2, 1, 0, 1, 2}};

static void check(bool is_right, const char *what)
{
    if (!is_right)
    {
        printf("%s differs\n", what);
        exit(EXIT_FAILURE);
    }
}

/// Write what nodes send; the number of operations.
static int write_own(maplines_operations_t *own)
{
    check(maplines_write_frame(own, &classic), "CAN");
    check(maplines_write_frame(own, &fd), "CAN FD");
    check(maplines_write_rate(own, MAPLINES_CAN_RATE, 500000), "rate");
    check(maplines_write_rate(own, MAPLINES_FD_RATE, 2000000), "FD rate");
    check(maplines_write_arbitration(own, MAPLINES_NOTIFY), "arbitration");
    check(maplines_write_status(own, MAPLINES_BUS_OFF), "status");
    check(maplines_write_format_error(own, fd.data, 5), "format error");
    return 7;
}

/// Write the same, and then what nodes only read, by the official headers.
static size_t write_official(fmi3Byte *bytes, size_t size)
{
    fmi3LsBusUtilBufferInfo info;
    FMI3_LS_BUS_BUFFER_INFO_INIT(&info, bytes, size);
    FMI3_LS_BUS_CAN_CREATE_OP_CAN_TRANSMIT(&info, 0x18FF1234, FMI3_LS_BUS_TRUE, FMI3_LS_BUS_FALSE,
                                           3, classic.data);
    FMI3_LS_BUS_CAN_CREATE_OP_CAN_FD_TRANSMIT(&info, 0x348, FMI3_LS_BUS_FALSE, FMI3_LS_BUS_TRUE,
                                              FMI3_LS_BUS_FALSE, 12, fd.data);
    FMI3_LS_BUS_CAN_CREATE_OP_CONFIGURATION_CAN_BAUDRATE(&info, 500000);
    FMI3_LS_BUS_CAN_CREATE_OP_CONFIGURATION_CAN_FD_BAUDRATE(&info, 2000000);
    FMI3_LS_BUS_CAN_CREATE_OP_CONFIGURATION_ARBITRATION_LOST_BEHAVIOR(
        &info, FMI3_LS_BUS_CAN_CONFIG_PARAM_ARBITRATION_LOST_BEHAVIOR_DISCARD_AND_NOTIFY);
    FMI3_LS_BUS_CAN_CREATE_OP_STATUS(&info, FMI3_LS_BUS_CAN_STATUS_PARAM_STATUS_KIND_BUS_OFF);
    FMI3_LS_BUS_CREATE_OP_FORMAT_ERROR(&info, 5, fd.data);
    FMI3_LS_BUS_CAN_CREATE_OP_CAN_XL_TRANSMIT(&info, 0x12, FMI3_LS_BUS_FALSE, FMI3_LS_BUS_FALSE, 1,
                                              2, 3, 12, fd.data);
    FMI3_LS_BUS_CAN_CREATE_OP_CONFIRM(&info, 0x348);
    FMI3_LS_BUS_CAN_CREATE_OP_ARBITRATION_LOST(&info, 0x349);
    FMI3_LS_BUS_CAN_CREATE_OP_BUS_ERROR(
        &info, 0x34A, FMI3_LS_BUS_CAN_BUSERROR_PARAM_ERROR_CODE_CRC_ERROR,
        FMI3_LS_BUS_CAN_BUSERROR_PARAM_ERROR_FLAG_PRIMARY_ERROR_FLAG, FMI3_LS_BUS_TRUE);
    FMI3_LS_BUS_CAN_CREATE_OP_WAKEUP(&info);
    FMI3_LS_BUS_CAN_CREATE_OP_CONFIGURATION_CAN_XL_BAUDRATE(&info, 10000000);
    check(info.status == fmi3True, "room");
    return (size_t)FMI3_LS_BUS_BUFFER_LENGTH(&info);
}

static void check_frame(const maplines_operation_t *operation, const maplines_frame_t *frame)
{
    const maplines_frame_t *read = &operation->frame;
    check(read->can_id == frame->can_id && read->is_extended == frame->is_extended &&
              read->is_fd == frame->is_fd && read->length == frame->length &&
              memcmp(read->data, frame->data, frame->length) == 0 && !operation->is_remote,
          "a frame that is read");
}

/// Check an operation that was read, by its place.
static void check_read(int place, const maplines_operation_t *operation)
{
    static const maplines_code_t codes[] = {
        MAPLINES_TRANSMIT,         MAPLINES_TRANSMIT_FD,   MAPLINES_CONFIGURATION,
        MAPLINES_CONFIGURATION,    MAPLINES_CONFIGURATION, MAPLINES_STATUS,
        MAPLINES_FORMAT_ERROR,     MAPLINES_TRANSMIT_XL,   MAPLINES_CONFIRM,
        MAPLINES_ARBITRATION_LOST, MAPLINES_BUS_ERROR,     MAPLINES_WAKEUP,
        MAPLINES_CONFIGURATION,
    };
    check(operation->code == codes[place], "a code that is read");
    if (place < 2)
    {
        check_frame(operation, place == 0 ? &classic : &fd);
    }
    if (place >= 8 && place <= 10)
    {
        check(operation->can_id == 0x340U + (uint32_t)place, "an ID that is read");
    }
    check(place != 10 || (operation->is_primary && operation->is_sender), "an error that is read");
}

int main(void)
{
    static maplines_operations_t own;
    static fmi3Byte official[4096];
    maplines_operation_t operation;
    size_t at = 0;
    int read = 0;
    const int written = write_own(&own);
    const size_t size = write_official(official, sizeof official);
    check(own.size < size && memcmp(own.bytes, official, own.size) == 0, "what is written");
    while (maplines_read_operation(official, size, &at, &operation) == MAPLINES_READ)
    {
        check_read(read, &operation);
        read++;
    }
    check(at == size, "the end");
    printf("%d written and %d read operations agree\n", written, read);
    return EXIT_SUCCESS;
}
