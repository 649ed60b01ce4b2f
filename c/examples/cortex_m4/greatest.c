/* Greatest counts of instructions, and stack, of single calls in cases that were searched.
 *
 * The argument is a file with a step a line; hex numbers but for times and flags:
 *
 *     N                                 a case begins: a receiver or sender that has just started
 *     F t_ns can_id is_extended data    a frame; each line that it completes is asked for
 *     S t_ns                            the newest scene is asked for: one of up to 4 lines if the
 *                                       case has frames of no more slots
 *     I slot status is_fd x_min x_max age mean covariance
 *                                       a line is sent: numbers by their bits, (4) and (4, 4)
 *
 * After each case, it prints a line for each kind of call: the number of the case, instructions,
 * stack [byte], and the kind.
 */
#include "maplines_dbc.h"
#include "measure.h"

#include <stdlib.h>
#include <string.h>

enum {
    FEED,
    LATEST,
    FEW,
    MANY,
    ENCODE,
    KINDS
};
static const char *const names[KINDS] = {"feed", "latest line", "latest scene of up to 4 lines",
                                         "latest scene of up to 8 lines", "encode a line"};
static measurement_t measured[KINDS];

static void print_case(unsigned number)
{
    for (int kind = 0; kind < KINDS; ++kind)
    {
        if (measured[kind].calls > 0)
        {
            printf("%u %lu %lu %s\n", number, (unsigned long)(measured[kind].ticks * TICK),
                   (unsigned long)measured[kind].stack, names[kind]);
        }
    }
    memset(measured, 0, sizeof measured);
}

#if MAPLINES_RECEIVER
static maplines_decoder_t decoder;
static unsigned slots_seen; // a bit for each slot of which the case has a frame

/// See of which slots a frame is, or which lines it has brought.
static void see(const maplines_frame_t *frame, const maplines_fed_t *fed)
{
    for (int i = 0; i < fed->count; ++i)
    {
        slots_seen |= 1U << (unsigned)fed->slots[i];
    }
#if MAPLINES_LINE_RECORDS
    for (unsigned slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        const maplines_messages_t *message = &maplines_dbc.messages[slot];
        if (frame->can_id == message->can_id || frame->can_id == message->fd_can_id)
        {
            slots_seen |= 1U << slot;
        }
    }
#else
    (void)frame;
#endif
}

static void feed(char *row)
{
    maplines_frame_t frame = {0};
    const int64_t t_ns = strtoll(row, &row, 10);
    frame.can_id = (uint32_t)strtoul(row, &row, 16);
    frame.is_extended = strtol(row, &row, 10) != 0;
    char byte[3] = {0};
    for (const char *hex = row + 1; hex[0] > ' ' && hex[1] > ' '; hex += 2)
    {
        memcpy(byte, hex, 2);
        frame.data[frame.length] = (uint8_t)strtoul(byte, NULL, 16);
        ++frame.length;
    }
    measure_begin(&measured[FEED]);
    const maplines_fed_t fed = maplines_feed(&decoder, &frame, t_ns);
    measure_end(&measured[FEED]);
    see(&frame, &fed);
    for (int i = 0; i < fed.count; ++i)
    {
        measure_begin(&measured[LATEST]);
#if MAPLINES_LINE_RECORDS
        maplines_view_t view;
        maplines_latest(&decoder, fed.slots[i], t_ns, &view);
#else
        static maplines_line_copy_t copy;
        maplines_copy_line(&decoder, fed.slots[i], t_ns, &copy);
#endif
        measure_end(&measured[LATEST]);
    }
}
#endif

#if MAPLINES_RECEIVER && MAPLINES_SCENES
static void ask_scene(char *row)
{
    int lines = 0;
    for (unsigned slots = slots_seen; slots != 0; slots >>= 1U)
    {
        lines += (int)(slots & 1U);
    }
    measurement_t *asking = &measured[lines <= 4 ? FEW : MANY];
    measure_begin(asking);
#if MAPLINES_LINE_RECORDS
    maplines_scene_view_t view;
    maplines_latest_scene(&decoder, strtoll(row, NULL, 10), &view);
#else
    static maplines_scene_copy_t copy;
    maplines_copy_scene(&decoder, strtoll(row, NULL, 10), &copy);
#endif
    measure_end(asking);
}
#endif

#if MAPLINES_SENDER && MAPLINES_LINE_RECORDS
static maplines_encoder_t encoder;

static double read_real(char **row)
{
    const uint64_t bits = strtoull(*row, row, 16);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static void send(char *row)
{
    maplines_frame_t frames[MAPLINES_MAX_PAGES];
    maplines_input_t line = {0};
    line.slot = (maplines_owner_t)strtol(row, &row, 16);
    line.status = (maplines_status_t)strtol(row, &row, 16);
    line.has_age = true;
    const bool is_fd = strtol(row, &row, 16) != 0;
    line.x_min = read_real(&row);
    line.x_max = read_real(&row);
    line.age = read_real(&row);
    for (int i = 0; i < 4; ++i)
    {
        line.mean[i] = read_real(&row);
    }
    for (int i = 0; i < 16; ++i)
    {
        line.cov[i / 4][i % 4] = read_real(&row);
    }
    measure_begin(&measured[ENCODE]);
    (void)maplines_encode_line(&encoder, &line, is_fd, 0, frames);
    measure_end(&measured[ENCODE]);
}
#endif

static void begin_case(void)
{
#if MAPLINES_RECEIVER
    maplines_decoder_init(&decoder, &maplines_dbc, NULL);
    slots_seen = 0;
#endif
#if MAPLINES_SENDER && MAPLINES_LINE_RECORDS
    maplines_encoder_init(&encoder, &maplines_dbc, NULL);
#endif
}

static void take(char *row)
{
#if MAPLINES_RECEIVER
    if (row[0] == 'F')
    {
        feed(row + 1);
    }
#endif
#if MAPLINES_RECEIVER && MAPLINES_SCENES
    if (row[0] == 'S')
    {
        ask_scene(row + 1);
    }
#endif
#if MAPLINES_SENDER && MAPLINES_LINE_RECORDS
    if (row[0] == 'I')
    {
        send(row + 1);
    }
#endif
}

int main(int argc, char **argv)
{
    static char row[1024];
    FILE *file = argc == 2 ? fopen(argv[1], "r") : NULL;
    if (file == NULL)
    {
        return EXIT_FAILURE;
    }
    unsigned number = 0;
    for (begin_case(); fgets(row, sizeof row, file) != NULL; take(row))
    {
        if (row[0] == 'N')
        {
            print_case(number);
            begin_case();
            ++number;
        }
    }
    print_case(number);
    return EXIT_SUCCESS;
}
