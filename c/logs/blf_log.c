/* Parser of the objects in a container of a BLF file: data frames of classic CAN and of CAN FD.
 *
 * Objects that are no frames on the bus are counted by kind. It stops at the first object that is
 * not whole, or not of its usual size: the reader in Python takes that. All numbers are
 * little-endian.
 */
#include "log_frames.h"

#include <string.h>

enum {
    CAN_MESSAGE = 1,
    CAN_ERROR = 2,
    CAN_STATISTIC = 4,
    LOG_CONTAINER = 10,
    CAN_DRIVER_ERROR = 31,
    CAN_ERROR_EXT = 73,
    CAN_DRIVER_ERROR_EXT = 74,
    CAN_MESSAGE2 = 86,
    CAN_FD_MESSAGE = 100,
    CAN_FD_MESSAGE_64 = 101,
    CAN_FD_ERROR_64 = 104
};

/// What an object is; the order of those that are skipped is that of ``Skipped`` in Python.
typedef enum {
    REQUEST,
    REMOTE,
    ERROR_FRAME,
    STATE,
    OTHER,
    SKIPPED_COUNT,
    FRAME = SKIPPED_COUNT,
    UNUSUAL
} object_kind_t;

#define BASE_SIZE 16 // of the header of an object [byte]
#define EXTENDED (UINT32_C(1) << 31)
#define ID_MASK UINT32_C(0x1FFFFFFF)
#define DIRECTION 0x0F
#define REQUEST_DIRECTION 2
#define REMOTE_FLAG 0x80
#define REMOTE_FLAG_64 0x10
#define REQUEST_FLAG_64 0x80
#define ACKNOWLEDGED_FLAG_64 0x40
#define MAX_PADDING 7                 // between two objects [byte]
#define MAX_TICKS (UINT64_C(1) << 48) // times 10000, and with a date added, fit in 63 bits

static uint32_t u16(const uint8_t *at)
{
    return (uint32_t)at[0] | (uint32_t)at[1] << 8;
}

static uint32_t u32(const uint8_t *at)
{
    return u16(at) | u16(at + 2) << 16;
}

static uint64_t u64(const uint8_t *at)
{
    return (uint64_t)u32(at) | (uint64_t)u32(at + 4) << 32;
}

/// Set the fields of a data frame.
static void set_frame(maplines_logged_t *frame, uint32_t channel, uint32_t can_id,
                      const uint8_t *data, uint32_t length, uint32_t there)
{
    *frame = (maplines_logged_t){
        .can_id = can_id & ID_MASK,
        .is_extended = (can_id & EXTENDED) != 0U,
        .channel = channel,
        .length = length,
        .there = there,
        .data = data,
    };
}

/// Return what an object is by its direction and by whether it is a remote frame.
static object_kind_t kind_of(bool is_request, bool is_remote)
{
    return is_request ? REQUEST : is_remote ? REMOTE : FRAME;
}

/// Read a frame of classic CAN.
static object_kind_t read_classic(const uint8_t *body, uint32_t size, maplines_logged_t *frame)
{
    if (size < 16)
    {
        return UNUSUAL;
    }
    const uint32_t length = body[3] < 8 ? body[3] : 8;
    set_frame(frame, u16(body), u32(body + 4), body + 8, length, length);
    return kind_of((body[2] & DIRECTION) == REQUEST_DIRECTION, (body[2] & REMOTE_FLAG) != 0);
}

static object_kind_t read_fd(const uint8_t *body, uint32_t size, maplines_logged_t *frame)
{
    if (size < 84 || body[14] > MAPLINES_LOG_DATA)
    {
        return UNUSUAL;
    }
    set_frame(frame, u16(body), u32(body + 4), body + 20, body[14], body[14]);
    return kind_of((body[2] & DIRECTION) == REQUEST_DIRECTION, (body[2] & REMOTE_FLAG) != 0);
}

/// Read a frame of CAN FD whose data may be shorter than they say.
static object_kind_t read_fd_64(const uint8_t *body, uint32_t size, uint32_t header,
                                maplines_logged_t *frame)
{
    if (size < 40 || body[2] > MAPLINES_LOG_DATA)
    {
        return UNUSUAL;
    }
    const uint32_t behind = body[35];
    const uint32_t end = behind != 0 ? behind : header + size;
    if (end < header + 40 || end > header + size)
    {
        return UNUSUAL;
    }
    const uint32_t room = end - header - 40;
    const uint32_t there = body[2] < room ? body[2] : room;
    set_frame(frame, body[0], u32(body + 4), body + 40, body[2], there);
    const uint32_t flags = u32(body + 12);
    const bool is_request = body[34] == REQUEST_DIRECTION ||
                            (flags & (REQUEST_FLAG_64 | ACKNOWLEDGED_FLAG_64)) == REQUEST_FLAG_64;
    return kind_of(is_request, (flags & REMOTE_FLAG_64) != 0);
}

/// Read an object, or count it; the place after it, or 0 if it is for Python.
static size_t read_object(maplines_log_t *log, size_t size, const uint8_t *data, size_t place,
                          int64_t start_ns)
{
    size_t at = place;
    while (at + 4 <= size && at <= place + MAX_PADDING && memcmp(data + at, "LOBJ", 4) != 0)
    {
        at++;
    }
    if (at > place + MAX_PADDING || size - at < BASE_SIZE)
    {
        return 0;
    }
    const uint8_t *object = data + at;
    const uint32_t version = u16(object + 6);
    const uint32_t object_size = u32(object + 8);
    if (object_size < BASE_SIZE || object_size > size - at)
    {
        return 0;
    }
    const uint32_t header = BASE_SIZE + (version == 1 ? 16 : 24);
    const bool has_body = version >= 1 && version <= 2 && object_size >= header;
    const uint8_t *body = object + (has_body ? header : 0);
    const uint32_t body_size = has_body ? object_size - header : 0;
    maplines_logged_t frame = {0};
    object_kind_t kind = OTHER;
    switch (u32(object + 12))
    {
    case CAN_MESSAGE:
    case CAN_MESSAGE2:
        kind = read_classic(body, body_size, &frame);
        break;
    case CAN_FD_MESSAGE:
        kind = read_fd(body, body_size, &frame);
        break;
    case CAN_FD_MESSAGE_64:
        kind = read_fd_64(body, body_size, header, &frame);
        break;
    case CAN_ERROR:
    case CAN_ERROR_EXT:
    case CAN_FD_ERROR_64:
        kind = ERROR_FRAME;
        break;
    case CAN_STATISTIC:
    case CAN_DRIVER_ERROR:
    case CAN_DRIVER_ERROR_EXT:
        kind = STATE;
        break;
    case LOG_CONTAINER:
        kind = UNUSUAL;
        break;
    default:
        break;
    }
    if (kind < SKIPPED_COUNT)
    {
        log->skipped[kind]++;
        return at + object_size;
    }
    const uint64_t ticks = kind == FRAME ? u64(object + 24) : 0U;
    if (kind == UNUSUAL || frame.channel == 0U || ticks >= MAX_TICKS ||
        !maplines_number_channel(log, frame.channel))
    {
        return 0;
    }
    frame.t_ns = start_ns + (int64_t)ticks * (u32(object + 16) == 1 ? 10000 : 1);
    maplines_add_logged(log, &frame);
    return at + object_size;
}

size_t maplines_parse_blf(maplines_log_t *log, size_t size, const uint8_t *data, int64_t start_ns)
{
    size_t place = 0;
    size_t next = 1;
    log->frames = 0;
    memset(log->skipped, 0, sizeof log->skipped);
    while (next != 0U && log->frames < log->capacity)
    {
        next = read_object(log, size, data, place, start_ns);
        place = next != 0U ? next : place;
    }
    return place;
}
