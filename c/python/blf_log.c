/* Parser of the objects in a container of a BLF file: data frames of classic CAN and of CAN FD.
 *
 * It stops at the first object that is not one of these, whole and of its usual size: the reader in
 * Python takes that. All numbers are little-endian.
 */
#include "frames_out.h"

#include <math.h>

enum {
    CAN_MESSAGE = 1,
    CAN_MESSAGE2 = 86,
    CAN_FD_MESSAGE = 100,
    CAN_FD_MESSAGE_64 = 101
};

#define BASE_SIZE 16 // of the header of an object [byte]
#define EXTENDED (UINT32_C(1) << 31)
#define ID_MASK UINT32_C(0x1FFFFFFF)
#define REMOTE 0x80
#define REMOTE_64 0x10
#define MOST_TICKS (UINT64_C(1) << 53) // are exact as floating-point numbers

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

/// Read a frame of classic CAN.
static bool read_classic(const uint8_t *body, uint32_t size, blf_frame_t *frame)
{
    if (size < 16 || (body[2] & REMOTE) != 0 || body[3] > 8)
    {
        return false;
    }
    *frame = (blf_frame_t){u32(body + 4), u16(body), body + 8, body[3], body[3]};
    return true;
}

static bool read_fd(const uint8_t *body, uint32_t size, blf_frame_t *frame)
{
    if (size < 84 || (body[2] & REMOTE) != 0 || body[14] > MAPLINES_MAX_DATA)
    {
        return false;
    }
    *frame = (blf_frame_t){u32(body + 4), u16(body), body + 20, body[14], body[14]};
    return true;
}

/// Read a frame of CAN FD whose data may be shorter than they say.
static bool read_fd_64(const uint8_t *body, uint32_t size, uint32_t object_size,
                       uint32_t header_size, blf_frame_t *frame)
{
    if (size < 40 || (u32(body + 12) & REMOTE_64) != 0 || body[2] > MAPLINES_MAX_DATA)
    {
        return false;
    }
    const uint32_t extension = body[35];
    const uint32_t end = extension != 0 ? extension : object_size;
    if (end < header_size + 40)
    {
        return false;
    }
    const uint32_t room = end - header_size - 40;
    const uint32_t there = body[2] < room ? body[2] : room;
    *frame = (blf_frame_t){u32(body + 4), body[0], body + 40, body[2], there};
    return there <= size - 40;
}

/// Read an object; the place after it, or 0 if it is for Python.
static size_t read_object(const uint8_t *data, size_t place, size_t size, double start,
                          PyObject *names, long *last, maplines_frames_t *frames)
{
    size_t at = place;
    while (at + 4 <= size && at <= place + 4 && memcmp(data + at, "LOBJ", 4) != 0)
    {
        at++; // padding
    }
    if (at > place + 4 || size - at < BASE_SIZE + 24)
    {
        return 0;
    }
    const uint8_t *object = data + at;
    const uint32_t header_size = u16(object + 4);
    const uint32_t version = u16(object + 6);
    const uint32_t object_size = u32(object + 8);
    const uint32_t kind = u32(object + 12);
    const uint32_t header = BASE_SIZE + (version == 1 ? 16 : 24);
    if (version < 1 || version > 2 || object_size < header || object_size > size - at)
    {
        return 0;
    }
    const uint32_t flags = u32(object + 16);
    const uint64_t ticks = u64(object + 24);
    const uint8_t *body = object + header;
    const uint32_t body_size = object_size - header;
    blf_frame_t frame = {0};
    const bool is_read =
        kind == CAN_MESSAGE || kind == CAN_MESSAGE2 ? read_classic(body, body_size, &frame)
        : kind == CAN_FD_MESSAGE                    ? read_fd(body, body_size, &frame)
        : kind == CAN_FD_MESSAGE_64 ? read_fd_64(body, body_size, object_size, header_size, &frame)
                                    : false;
    // Both are exact, so that the quotient is the nearest to the decimal.
    const double seconds = (double)ticks / (flags == 1 ? 1e5 : 1e9) + start;
    if (!is_read || ticks >= MOST_TICKS || frame.channel == 0 || !(fabs(seconds) < 9e9))
    {
        return 0;
    }
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
    maplines_add_frame(frames, frame.can_id & ID_MASK, (frame.can_id & EXTENDED) != 0,
                       (int64_t)rint(seconds * 1e9), (uint16_t)last[1], padded,
                       (uint8_t)frame.length);
    return at + object_size;
}

PyDoc_STRVAR(parse_blf_doc,
             "parse_blf(data, place, start, names, arrays) -> frames, place.\n\n"
             "Read the data frames of the objects from a place on, up to an object of another\n"
             "kind, or one that is not whole. start is the time of the file [s].");

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
    const double start = PyFloat_AsDouble(args[2]);
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
    while (frames.count < frames.capacity)
    {
        const size_t next =
            read_object((const uint8_t *)data, place, size, start, args[3], last, &frames);
        if (next == 0)
        {
            break;
        }
        place = next;
    }
    maplines_release_arrays(&arrays);
    return Py_BuildValue("nn", frames.count, (Py_ssize_t)place);
}

static PyMethodDef functions[] = {
    {"parse_blf", (PyCFunction)(void (*)(void))parse_blf, METH_FASTCALL, parse_blf_doc},
    {NULL, NULL, 0, NULL},
};

int maplines_add_blf_log(PyObject *module)
{
    return PyModule_AddFunctions(module, functions);
}
