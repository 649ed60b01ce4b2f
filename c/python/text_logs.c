/* Parsers of text logs: the ordinary rows of candump -L and of ASC, hexadecimal and decimal.
 *
 * A parser stops at the first row that is not of its strict form: the reader in Python, which knows
 * all forms and what is an error, takes that row.
 */
#include "frames_out.h"

bool maplines_hold_frames(maplines_arrays_t *arrays, PyObject *tuple, maplines_frames_t *frames)
{
    static const uint8_t sizes[] = {4, 1, 8, 2, 1, MAPLINES_MAX_DATA};
    void *held[6] = {NULL};
    PyObject *first = PyTuple_GetItem(tuple, 0);
    const Py_ssize_t n = first == NULL ? -1 : PyObject_Size(first);
    for (int i = 0; i < 6; i++)
    {
        PyObject *array = n < 0 ? NULL : PyTuple_GetItem(tuple, i);
        held[i] = array == NULL ? NULL : maplines_hold(arrays, array, sizes[i] * n, true);
        if (held[i] == NULL)
        {
            return false;
        }
    }
    *frames = (maplines_frames_t){
        held[0], held[1], held[2], held[3], held[4], held[5], n, 0,
    };
    return true;
}

void maplines_add_frame(maplines_frames_t *frames, uint32_t can_id, bool is_extended, int64_t t_ns,
                        uint16_t channel, const uint8_t *data, uint8_t length)
{
    const Py_ssize_t i = frames->count++;
    uint8_t *to = frames->data + MAPLINES_MAX_DATA * i;
    frames->can_ids[i] = can_id;
    frames->are_extended[i] = is_extended ? 1 : 0;
    frames->times_ns[i] = t_ns;
    frames->channels[i] = channel;
    frames->lengths[i] = length;
    memcpy(to, data, length);
    memset(to + length, 0, (size_t)MAPLINES_MAX_DATA - length);
}

/* ---- rows ------------------------------------------------------------------------------------ */

/// Place in a row. What is read is followed by a line feed, so that no reading passes the end.
typedef const char *place_t;

/// Value of a hexadecimal digit, or -1.
static int hex(char c)
{
    return c >= '0' && c <= '9'   ? c - '0'
           : c >= 'A' && c <= 'F' ? c - 'A' + 10
           : c >= 'a' && c <= 'f' ? c - 'a' + 10
                                  : -1;
}

/// Read bytes without anything between; their number, or -1 if there are more than 64 or half ones.
static int read_data(place_t *at, uint8_t *data)
{
    int count = 0;
    while (hex(**at) >= 0)
    {
        const int low = hex((*at)[1]);
        if (low < 0 || count == MAPLINES_MAX_DATA)
        {
            return -1;
        }
        data[count++] = (uint8_t)(16 * hex(**at) + low);
        *at += 2;
    }
    return count;
}

/// Read decimal digits, at most so many; their number.
static int read_digits(place_t *at, int most, uint64_t *value)
{
    int count = 0;
    *value = 0;
    while (**at >= '0' && **at <= '9' && count < most)
    {
        *value = 10 * *value + (uint64_t)(**at - '0');
        ++*at;
        ++count;
    }
    return count;
}

/// Read a byte of two hexadecimal digits, or of up to three decimal ones; false if it is none.
static bool read_byte(place_t *at, int radix, uint8_t *byte)
{
    uint64_t value = 0;
    if (radix == 10)
    {
        const bool is_read = read_digits(at, 3, &value) > 0 && value <= UINT8_MAX;
        *byte = (uint8_t)value;
        return is_read;
    }
    if (hex((*at)[0]) < 0 || hex((*at)[1]) < 0)
    {
        return false;
    }
    *byte = (uint8_t)(16 * hex((*at)[0]) + hex((*at)[1]));
    *at += 2;
    return true;
}

/// Read so many bytes, each after blanks; false if there are fewer.
static bool read_spaced_data(place_t *at, int radix, uint8_t *data, int count)
{
    for (int i = 0; i < count; i++)
    {
        place_t c = *at;
        while (*c == ' ')
        {
            c++;
        }
        if (c == *at || !read_byte(&c, radix, &data[i]) || (*c != ' ' && *c != '\n' && *c != '\r'))
        {
            return false;
        }
        *at = c;
    }
    return true;
}

static bool skip(place_t *at, char c)
{
    if (**at != c)
    {
        return false;
    }
    ++*at;
    return true;
}

static bool skip_blanks(place_t *at)
{
    const place_t before = *at;
    while (**at == ' ')
    {
        ++*at;
    }
    return *at != before;
}

/// Place after the end of a row; NULL if it does not end here.
static place_t end_of_row(place_t at)
{
    at += *at == '\r' ? 1 : 0;
    return *at == '\n' ? at + 1 : NULL;
}

/* ---- times ----------------------------------------------------------------------------------- */

enum {
    ABSOLUTE = 0,
    ZERO = 1,
    DELTA = 2
};

/// Times of rows, as in log_times.py.
typedef struct {
    int kind;
    int64_t sum;  ///< of the stamps [ns]
    int64_t high; ///< highest stamp of the recording [ns]
} log_times_t;

#define MAX_DISORDER_NS INT64_C(100000000)

/// Read a time stamp, which ends with a character, in ns; false if it is not of the strict form.
static bool read_stamp(place_t *at, char end, int64_t *stamp)
{
    uint64_t seconds = 0;
    uint64_t fraction = 0;
    if (read_digits(at, 10, &seconds) == 0 || seconds > 9000000000U || !skip(at, '.'))
    {
        return false;
    }
    const int digits = read_digits(at, 9, &fraction);
    for (int i = digits; i < 9; i++)
    {
        fraction *= 10;
    }
    *stamp = (int64_t)(seconds * 1000000000U + fraction);
    return digits > 0 && skip(at, end);
}

/// Time of the next row; false if a recording may begin again here, or the time is too great.
static bool add_stamp(log_times_t *times, int64_t stamp, int64_t *t_ns)
{
    if (times->kind == DELTA ? times->sum > INT64_MAX - stamp
                             : times->kind == ZERO && times->high - stamp > MAX_DISORDER_NS)
    {
        return false;
    }
    times->sum += times->kind == DELTA ? stamp : 0;
    times->high = times->kind == ZERO && stamp > times->high ? stamp : times->high;
    *t_ns = times->kind == DELTA ? times->sum : stamp;
    return true;
}

/* ---- candump --------------------------------------------------------------------------------- */

/// Names of channels, in the order of their first frames.
typedef struct {
    PyObject *names;  ///< list of str
    const char *last; ///< name of the last frame, in the text
    size_t length;    ///< of it
    uint16_t number;
    uint64_t asc_number; ///< of the last frame in ASC; 0 before the first
} channels_t;

/// Number of a channel, which is new if it is not known; -1 if it cannot have one.
static int channel_of(channels_t *channels, const char *name, size_t length)
{
    if (channels->last != NULL && channels->length == length &&
        memcmp(channels->last, name, length) == 0)
    {
        return channels->number;
    }
    PyObject *text = PyUnicode_DecodeASCII(name, (Py_ssize_t)length, "strict");
    if (text == NULL)
    {
        PyErr_Clear();
        return -1;
    }
    Py_ssize_t number = PySequence_Index(channels->names, text);
    if (number < 0)
    {
        PyErr_Clear();
        number = PyList_Size(channels->names);
        if (number > UINT16_MAX || PyList_Append(channels->names, text) < 0)
        {
            PyErr_Clear();
            number = -1;
        }
    }
    Py_DECREF(text);
    if (number >= 0)
    {
        channels->last = name;
        channels->length = length;
        channels->number = (uint16_t)number;
    }
    return (int)number;
}

#define MAX_NAME 64

/// Read a row such as "(1.5) can0 340#1122334455667788"; the place after it, or NULL.
static place_t read_candump(place_t at, log_times_t *times, channels_t *channels,
                            maplines_frames_t *frames)
{
    int64_t stamp = 0;
    int64_t t_ns = 0;
    uint8_t data[MAPLINES_MAX_DATA];
    if (!skip(&at, '(') || !read_stamp(&at, ')', &stamp) || !skip(&at, ' '))
    {
        return NULL;
    }
    const char *name = at;
    while (*at > ' ' && *at < 0x7f)
    {
        at++;
    }
    const size_t name_length = (size_t)(at - name);
    if (name_length == 0 || name_length > MAX_NAME || !skip(&at, ' '))
    {
        return NULL;
    }
    uint32_t can_id = 0;
    int digits = 0;
    for (; digits < 9 && hex(*at) >= 0; digits++, at++)
    {
        can_id = 16 * can_id + (uint32_t)hex(*at);
    }
    if ((digits != 3 && digits != 8) || (can_id >> 29) != 0 || !skip(&at, '#'))
    {
        return NULL;
    }
    if (skip(&at, '#'))
    {
        if (hex(*at) < 0) // the flags of CAN FD
        {
            return NULL;
        }
        at++;
    }
    const int length = read_data(&at, data);
    if (length < 0)
    {
        return NULL;
    }
    if (*at == ' ')
    {
        at++;
        if (*at != 'T' && *at != 'R')
        {
            return NULL;
        }
        at++;
    }
    const place_t end = end_of_row(at);
    const int channel = end == NULL ? -1 : channel_of(channels, name, name_length);
    if (channel < 0 || !add_stamp(times, stamp, &t_ns))
    {
        return NULL;
    }
    maplines_add_frame(frames, can_id, digits == 8, t_ns, (uint16_t)channel, data, (uint8_t)length);
    return end;
}

#define MAX_REST 4096

/* ---- ASC ------------------------------------------------------------------------------------- */

static const uint8_t fd_lengths[] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64};

/// Read a CAN ID, with "x" if it has 29 bits, and blanks.
static bool read_asc_id(place_t *at, int radix, uint32_t *can_id, bool *is_extended)
{
    int digits = 0;
    uint64_t value = 0;
    for (; digits < 9 && hex(**at) >= 0 && hex(**at) < radix; digits++, ++*at)
    {
        value = (uint64_t)radix * value + (uint64_t)hex(**at);
    }
    *is_extended = **at == 'x';
    *at += *is_extended ? 1 : 0;
    *can_id = (uint32_t)value;
    return digits > 0 && (value >> 29) == 0 && skip_blanks(at);
}

static bool skip_direction(place_t *at)
{
    if (((*at)[0] != 'R' && (*at)[0] != 'T') || (*at)[1] != 'x')
    {
        return false;
    }
    *at += 2;
    return skip_blanks(at);
}

/// Read what follows "Rx" of a classic frame: "d 8 11 22 ..."; its length, or -1.
static int read_classic(place_t *at, int radix, uint8_t *data)
{
    if (!skip(at, 'd') || !skip_blanks(at) || **at < '0' || **at > '8')
    {
        return -1;
    }
    const int length = **at - '0';
    ++*at;
    if (length == 0 ? **at != ' ' && **at != '\n' && **at != '\r'
                    : !read_spaced_data(at, radix, data, length))
    {
        return -1;
    }
    return length;
}

/// Read what follows the hexadecimal CAN ID of a frame of CAN FD, such as "1 0 f 64 11 22 ...";
/// its length, or -1.
static int read_fd(place_t *at, uint8_t *data)
{
    uint64_t flag = 0;
    uint64_t length = 0;
    for (int i = 0; i < 2; i++)
    {
        if (read_digits(at, 1, &flag) == 0 || !skip_blanks(at))
        {
            return -1;
        }
    }
    const int dlc = hex(**at);
    *at += dlc < 0 ? 0 : 1;
    if (dlc < 0 || !skip_blanks(at) || read_digits(at, 2, &length) == 0 || length == 0 ||
        length != fd_lengths[dlc] || !read_spaced_data(at, 16, data, (int)length))
    {
        return -1;
    }
    return (int)length;
}

/// Read a row such as "1.5 1 340 Rx d 2 11 22"; the place after it, or NULL.
static place_t read_asc(place_t at, int radix, log_times_t *times, channels_t *channels,
                        maplines_frames_t *frames)
{
    int64_t stamp = 0;
    int64_t t_ns = 0;
    uint64_t number = 0;
    uint32_t can_id = 0;
    bool is_extended = false;
    uint8_t data[MAPLINES_MAX_DATA];
    (void)skip_blanks(&at);
    if (!read_stamp(&at, ' ', &stamp))
    {
        return NULL;
    }
    (void)skip_blanks(&at);
    const bool is_fd = strncmp(at, "CANFD ", 6) == 0;
    if (is_fd)
    {
        at += 5;
        (void)skip_blanks(&at);
    }
    if (read_digits(&at, 4, &number) == 0 || number == 0 || !skip_blanks(&at))
    {
        return NULL;
    }
    int length = -1;
    if (is_fd)
    {
        length =
            radix == 16 && skip_direction(&at) && read_asc_id(&at, radix, &can_id, &is_extended)
                ? read_fd(&at, data)
                : -1;
    }
    else
    {
        length = read_asc_id(&at, radix, &can_id, &is_extended) && skip_direction(&at)
                     ? read_classic(&at, radix, data)
                     : -1;
    }
    if (length < 0)
    {
        return NULL;
    }
    if (number != channels->asc_number)
    {
        char name[8];
        const int digits = PyOS_snprintf(name, sizeof name, "%u", (unsigned)number - 1);
        const int known = channel_of(channels, name, (size_t)digits);
        channels->last = NULL; // `name` is gone when the next one is compared
        if (known < 0)
        {
            return NULL;
        }
        channels->asc_number = number;
    }
    for (int rest = 0; *at != '\n'; rest++, at++) // what else a row says
    {
        const bool is_plain = *at >= ' ' && *at < 0x7f;
        if (rest == MAX_REST || (!is_plain && end_of_row(at) == NULL))
        {
            return NULL;
        }
    }
    if (!add_stamp(times, stamp, &t_ns))
    {
        return NULL;
    }
    maplines_add_frame(frames, can_id, is_extended, t_ns, channels->number, data, (uint8_t)length);
    return at + 1;
}

/* ---- calls ----------------------------------------------------------------------------------- */

/// Text of a call from a place on, up to its last line feed.
typedef struct {
    place_t begin, at, end;
    Py_ssize_t rows;
} text_t;

static bool open_text(PyObject *bytes, PyObject *place, text_t *text)
{
    const char *all = PyBytes_AsString(bytes);
    const Py_ssize_t begin = PyLong_AsSsize_t(place);
    if (all == NULL || (begin == -1 && PyErr_Occurred() != NULL))
    {
        return false;
    }
    Py_ssize_t size = PyBytes_Size(bytes);
    if (begin < 0 || begin > size)
    {
        PyErr_SetString(PyExc_ValueError, "the place must be in the text");
        return false;
    }
    while (size > begin && all[size - 1] != '\n')
    {
        size--;
    }
    *text = (text_t){all, all + begin, all + size, 0};
    return true;
}

/// Parse rows with the arguments of a call; the radix is 0 for those of candump.
static PyObject *parse_rows(PyObject *const *args, int radix)
{
    maplines_arrays_t arrays = {.count = 0};
    maplines_frames_t frames;
    text_t text;
    int kind = 0;
    long long sum = 0;
    long long high = 0;
    if (!PyList_Check(args[3]) || !PyTuple_Check(args[2]) || !PyTuple_Check(args[4]))
    {
        PyErr_SetString(PyExc_TypeError, "times and arrays must be tuples, names a list");
        return NULL;
    }
    if (!open_text(args[0], args[1], &text) ||
        !PyArg_ParseTuple(args[2], "iLL", &kind, &sum, &high) ||
        !maplines_hold_frames(&arrays, args[4], &frames))
    {
        maplines_release_arrays(&arrays);
        return NULL;
    }
    log_times_t times = {kind, sum, high};
    channels_t channels = {.names = args[3], .last = NULL};
    while (text.at < text.end && frames.count < frames.capacity)
    {
        const place_t next = radix == 0 ? read_candump(text.at, &times, &channels, &frames)
                                        : read_asc(text.at, radix, &times, &channels, &frames);
        if (next == NULL)
        {
            break;
        }
        text.at = next;
        text.rows++;
    }
    maplines_release_arrays(&arrays);
    return Py_BuildValue("nnn(iLL)", frames.count, (Py_ssize_t)(text.at - text.begin), text.rows,
                         times.kind, (long long)times.sum, (long long)times.high);
}

PyDoc_STRVAR(parse_candump_doc,
             "parse_candump(text, place, times, names, arrays) -> frames, place, rows, times.\n\n"
             "Read rows of candump -L from a place on, up to one of another form. times is (kind,\n"
             "sum, high) of LogTimes.");

static PyObject *parse_candump(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (count != 5)
    {
        PyErr_SetString(PyExc_TypeError, "there must be 5 arguments");
        return NULL;
    }
    return parse_rows(args, 0);
}

PyDoc_STRVAR(
    parse_asc_doc,
    "parse_asc(text, place, times, names, arrays, radix) -> frames, place, rows, times.\n\n"
    "Read rows of ASC from a place on, up to one of another form; the radix of their\n"
    "numbers is 10 or 16. times is (kind, sum, high) of LogTimes.");

static PyObject *parse_asc(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    const long radix = count == 6 ? PyLong_AsLong(args[5]) : 0;
    if (radix != 10 && radix != 16)
    {
        if (PyErr_Occurred() == NULL)
        {
            PyErr_SetString(PyExc_TypeError, "there must be 6 arguments, with a radix of 10 or 16");
        }
        return NULL;
    }
    return parse_rows(args, (int)radix);
}

static PyMethodDef functions[] = {
    {"parse_candump", (PyCFunction)(void (*)(void))parse_candump, METH_FASTCALL, parse_candump_doc},
    {"parse_asc", (PyCFunction)(void (*)(void))parse_asc, METH_FASTCALL, parse_asc_doc},
    {NULL, NULL, 0, NULL},
};

int maplines_add_text_logs(PyObject *module)
{
    return PyModule_AddFunctions(module, functions);
}
