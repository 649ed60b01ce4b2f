/* Parser of the objects in a container of a BLF file: data frames of classic CAN and of CAN FD.
 *
 * Objects that are no frames on the bus are counted by kind. It stops at the first object that is
 * not whole, or not of its usual size: the reader in Python takes that. All numbers are
 * little-endian.
 */
#include "frames_out.h"

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

/// Data frame of an object.
typedef struct {
    uint32_t can_id;
    uint32_t channel; ///< from 1
    const uint8_t *data;
    uint32_t length, there; ///< bytes of data, and those that the object has; the others are zero
} blf_frame_t;

/// Return what an object is by its direction and by whether it is a remote frame.
static object_kind_t kind_of(bool is_request, bool is_remote)
{
    return is_request ? REQUEST : is_remote ? REMOTE : FRAME;
}

/// Read a frame of classic CAN.
static object_kind_t read_classic(const uint8_t *body, uint32_t size, blf_frame_t *frame)
{
    if (size < 16)
    {
        return UNUSUAL;
    }
    const uint32_t length = body[3] < 8 ? body[3] : 8;
    *frame = (blf_frame_t){u32(body + 4), u16(body), body + 8, length, length};
    return kind_of((body[2] & DIRECTION) == REQUEST_DIRECTION, (body[2] & REMOTE_FLAG) != 0);
}

static object_kind_t read_fd(const uint8_t *body, uint32_t size, blf_frame_t *frame)
{
    if (size < 84 || body[14] > MAPLINES_MAX_DATA)
    {
        return UNUSUAL;
    }
    *frame = (blf_frame_t){u32(body + 4), u16(body), body + 20, body[14], body[14]};
    return kind_of((body[2] & DIRECTION) == REQUEST_DIRECTION, (body[2] & REMOTE_FLAG) != 0);
}

/// Read a frame of CAN FD whose data may be shorter than they say.
static object_kind_t read_fd_64(const uint8_t *body, uint32_t size, uint32_t header,
                                blf_frame_t *frame)
{
    if (size < 40 || body[2] > MAPLINES_MAX_DATA)
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
    *frame = (blf_frame_t){u32(body + 4), body[0], body + 40, body[2], there};
    const uint32_t flags = u32(body + 12);
    const bool is_request = body[34] == REQUEST_DIRECTION ||
                            (flags & (REQUEST_FLAG_64 | ACKNOWLEDGED_FLAG_64)) == REQUEST_FLAG_64;
    return kind_of(is_request, (flags & REMOTE_FLAG_64) != 0);
}

/// Read an object, or count it; the place after it, or 0 if it is for Python.
static size_t read_object(const uint8_t *data, size_t place, size_t size, int64_t start_ns,
                          PyObject *names, long *last, Py_ssize_t *skipped,
                          maplines_frames_t *frames)
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
    blf_frame_t frame = {0};
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
        skipped[kind]++;
        return at + object_size;
    }
    if (kind == UNUSUAL || frame.channel == 0)
    {
        return 0;
    }
    const uint64_t ticks = u64(object + 24);
    if (ticks >= MAX_TICKS)
    {
        return 0;
    }
    const int64_t t_ns = start_ns + (int64_t)ticks * (u32(object + 16) == 1 ? 10000 : 1);
    if (*last != (long)frame.channel)
    {
        const long names_before = (long)PyList_Size(names);
        PyObject *name = PyUnicode_FromFormat("%u", (unsigned)(frame.channel - 1));
        Py_ssize_t number = name == NULL ? -1 : PySequence_Index(names, name);
        if (number < 0)
        {
            PyErr_Clear();
            if (name == NULL || names_before > UINT16_MAX || PyList_Append(names, name) < 0)
            {
                PyErr_Clear();
                Py_XDECREF(name);
                return 0;
            }
            number = names_before;
        }
        Py_DECREF(name);
        last[0] = (long)frame.channel;
        last[1] = (long)number;
    }
    uint8_t padded[MAPLINES_MAX_DATA] = {0};
    memcpy(padded, frame.data, frame.there);
    maplines_add_frame(frames, frame.can_id & ID_MASK, (frame.can_id & EXTENDED) != 0, t_ns,
                       (uint16_t)last[1], padded, (uint8_t)frame.length);
    return at + object_size;
}

PyDoc_STRVAR(parse_blf_doc,
             "parse_blf(data, place, start_ns, names, arrays) -> frames, place, skipped.\n\n"
             "Read the data frames of the objects from a place on, up to an object that is not\n"
             "whole or unusual. start_ns is the time of the file. skipped are the numbers of the\n"
             "others, by kind.");

static PyObject *parse_blf(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    maplines_arrays_t arrays = {.count = 0};
    maplines_frames_t frames;
    if (count != 5 || !PyList_Check(args[3]) || !PyTuple_Check(args[4]))
    {
        PyErr_SetString(PyExc_TypeError, "there must be 5 arguments, with a list and a tuple");
        return NULL;
    }
    const char *data = PyBytes_AsString(args[0]);
    const Py_ssize_t begin = PyLong_AsSsize_t(args[1]);
    const int64_t start_ns = PyLong_AsLongLong(args[2]);
    if (data == NULL || PyErr_Occurred() != NULL)
    {
        return NULL;
    }
    const size_t size = (size_t)PyBytes_Size(args[0]);
    if (begin < 0 || (size_t)begin > size)
    {
        PyErr_SetString(PyExc_ValueError, "the place must be in the data");
        return NULL;
    }
    size_t place = (size_t)begin;
    if (!maplines_hold_frames(&arrays, args[4], &frames))
    {
        maplines_release_arrays(&arrays);
        return NULL;
    }
    long last[2] = {-1, 0};
    Py_ssize_t skipped[SKIPPED_COUNT] = {0};
    while (frames.count < frames.capacity)
    {
        const size_t next = read_object((const uint8_t *)data, place, size, start_ns, args[3], last,
                                        skipped, &frames);
        if (next == 0)
        {
            break;
        }
        place = next;
    }
    maplines_release_arrays(&arrays);
    return Py_BuildValue("nn(nnnnn)", frames.count, (Py_ssize_t)place, skipped[REQUEST],
                         skipped[REMOTE], skipped[ERROR_FRAME], skipped[STATE], skipped[OTHER]);
}

static PyMethodDef functions[] = {
    {"parse_blf", (PyCFunction)(void (*)(void))parse_blf, METH_FASTCALL, parse_blf_doc},
    {NULL, NULL, 0, NULL},
};

int maplines_add_blf_log(PyObject *module)
{
    return PyModule_AddFunctions(module, functions);
}
