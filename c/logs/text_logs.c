/* Parsers of text logs: the ordinary rows of candump -L and of ASC, hexadecimal and decimal.
 *
 * A parser stops at the first row that is not of its strict form: the reader in Python, which knows
 * all forms and what is an error, takes that row.
 */
#include "log_frames.h"

#include <string.h>

bool maplines_name_channel(maplines_log_t *log, const char *name, size_t length)
{
    if (length > MAPLINES_LOG_NAME)
    {
        return false;
    }
    size_t i = log->channels > 0U && log->names[log->last][length] == '\0' &&
                       memcmp(log->names[log->last], name, length) == 0
                   ? log->last
                   : 0U;
    while (i < log->channels &&
           (log->names[i][length] != '\0' || memcmp(log->names[i], name, length) != 0))
    {
        i++;
    }
    if (i == MAPLINES_LOG_CHANNELS)
    {
        return false;
    }
    if (i == log->channels)
    {
        memcpy(log->names[i], name, length);
        log->names[i][length] = '\0';
        log->channels++;
    }
    log->last = i;
    return true;
}

bool maplines_number_channel(maplines_log_t *log, uint32_t number)
{
    if (number == log->number)
    {
        return true;
    }
    char digits[10];
    size_t begin = sizeof digits;
    uint32_t rest = number - 1U;
    do
    {
        digits[--begin] = (char)('0' + rest % 10U);
        rest /= 10U;
    }
    while (rest != 0U);
    const bool is_known = maplines_name_channel(log, digits + begin, sizeof digits - begin);
    log->number = is_known ? number : 0U;
    return is_known;
}

void maplines_add_logged(maplines_log_t *log, const maplines_logged_t *frame)
{
    const size_t i = log->frames++;
    uint8_t *to = log->data + MAPLINES_LOG_DATA * i;
    log->can_id[i] = frame->can_id;
    log->is_extended[i] = frame->is_extended ? 1U : 0U;
    log->t_ns[i] = frame->t_ns;
    log->channel[i] = (uint16_t)log->last;
    log->length[i] = (uint8_t)frame->length;
    memcpy(to, frame->data, frame->there);
    memset(to + frame->there, 0, MAPLINES_LOG_DATA - frame->there);
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
        if (low < 0 || count == MAPLINES_LOG_DATA)
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

/// Kinds of time stamps, as in log_times.py.
enum {
    ABSOLUTE = 0,
    ZERO = 1,
    DELTA = 2
};

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
static bool add_stamp(maplines_log_t *log, int64_t stamp, int64_t *t_ns)
{
    if (log->times == DELTA ? log->sum > INT64_MAX - stamp
                            : log->times == ZERO && log->high - stamp > MAX_DISORDER_NS)
    {
        return false;
    }
    log->sum += log->times == DELTA ? stamp : 0;
    log->high = log->times == ZERO && stamp > log->high ? stamp : log->high;
    *t_ns = log->times == DELTA ? log->sum : stamp;
    return true;
}

/* ---- candump --------------------------------------------------------------------------------- */

/// Read a row such as "(1.5) can0 340#1122334455667788"; the place after it, or NULL.
static place_t read_candump(maplines_log_t *log, place_t at)
{
    int64_t stamp = 0;
    uint8_t data[MAPLINES_LOG_DATA];
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
    if (name_length == 0 || name_length > MAPLINES_LOG_NAME || !skip(&at, ' '))
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
    maplines_logged_t frame = {
        .can_id = can_id,
        .is_extended = digits == 8,
        .length = (uint32_t)length,
        .there = (uint32_t)length,
        .data = data,
    };
    if (end == NULL || !maplines_name_channel(log, name, name_length) ||
        !add_stamp(log, stamp, &frame.t_ns))
    {
        return NULL;
    }
    maplines_add_logged(log, &frame);
    return end;
}

/* ---- ASC ------------------------------------------------------------------------------------- */

#define MAX_REST 4096 // characters behind the data

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
static place_t read_asc(maplines_log_t *log, place_t at, int radix)
{
    int64_t stamp = 0;
    uint64_t number = 0;
    maplines_logged_t frame = {0};
    uint8_t data[MAPLINES_LOG_DATA];
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
        length = radix == 16 && skip_direction(&at) &&
                         read_asc_id(&at, radix, &frame.can_id, &frame.is_extended)
                     ? read_fd(&at, data)
                     : -1;
    }
    else
    {
        length = read_asc_id(&at, radix, &frame.can_id, &frame.is_extended) && skip_direction(&at)
                     ? read_classic(&at, radix, data)
                     : -1;
    }
    if (length < 0)
    {
        return NULL;
    }
    for (int rest = 0; *at != '\n'; rest++, at++) // what else a row says
    {
        const bool is_plain = *at >= ' ' && *at < 0x7f;
        if (rest == MAX_REST || (!is_plain && end_of_row(at) == NULL))
        {
            return NULL;
        }
    }
    if (!maplines_number_channel(log, (uint32_t)number) || !add_stamp(log, stamp, &frame.t_ns))
    {
        return NULL;
    }
    frame.length = frame.there = (uint32_t)length;
    frame.data = data;
    maplines_add_logged(log, &frame);
    return at + 1;
}

/* ---- calls ----------------------------------------------------------------------------------- */

/// Parse rows up to the last line feed; the radix is 0 for those of candump.
static size_t parse_rows(maplines_log_t *log, size_t size, const char *text, int radix)
{
    size_t end = size;
    size_t place = 0;
    bool is_read = true;
    while (end > 0U && text[end - 1U] != '\n')
    {
        end--;
    }
    log->frames = log->rows = 0;
    while (is_read && place < end && log->frames < log->capacity)
    {
        const place_t row = text + place;
        const place_t next = radix == 0 ? read_candump(log, row) : read_asc(log, row, radix);
        is_read = next != NULL;
        place = is_read ? (size_t)(next - text) : place;
        log->rows += is_read ? 1U : 0U;
    }
    return place;
}

size_t maplines_parse_candump(maplines_log_t *log, size_t size, const char *text)
{
    return parse_rows(log, size, text, 0);
}

size_t maplines_parse_asc(maplines_log_t *log, size_t size, const char *text, int radix)
{
    return parse_rows(log, size, text, radix);
}
