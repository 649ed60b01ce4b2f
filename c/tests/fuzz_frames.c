/* Fuzzing of a receiver: frames and times in any order, damaged and intact.
 *
 * The input is a list of steps. Most bits on a bus fail the checksum, so there are also steps that
 * take any content and seal it as a sender would: then what the content means is decoded. After
 * each step, and at the end, the program aborts if something does not hold that holds for any
 * input.
 *
 * With libFuzzer: clang -fsanitize=fuzzer,address,undefined. With -DREPLAY, the program takes the
 * names of files, or draws steps at random: replay COUNT SEED.
 */
#include "harness_dbc.h"
#include "internal.h"

#include <stdio.h>
#include <stdlib.h>

#define REQUIRE(condition)                                                                         \
    do                                                                                             \
    {                                                                                              \
        if (!(condition))                                                                          \
        {                                                                                          \
            (void)fprintf(stderr, "line %d: %s does not hold\n", __LINE__, #condition);            \
            abort();                                                                               \
        }                                                                                          \
    }                                                                                              \
    while (0)

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

/// Rest of the input; beyond its end it is zeros.
typedef struct {
    const uint8_t *data;
    size_t left;
} input_t;

static uint8_t next(input_t *input)
{
    if (input->left == 0)
    {
        return 0;
    }
    --input->left;
    return *input->data++;
}

static int64_t next_time(input_t *input, int64_t t_ns)
{
    const uint8_t kind = next(input);
    if (kind < 200) // up to two cycles of 50 ms later
    {
        return t_ns + (int64_t)kind * 500000;
    }
    if (kind < 240) // earlier or later by up to 2 s
    {
        return t_ns + ((int64_t)next(input) - 128) * 16000000;
    }
    uint64_t any = 0;
    for (int i = 0; i < 8; ++i)
    {
        any = any << 8U | next(input);
    }
    int64_t t;
    memcpy(&t, &any, sizeof t);
    return t;
}

static bool is_a_number(maplines_real_t x)
{
    return x - x == 0;
}

static void check_line(const maplines_line_t *line)
{
    REQUIRE(line->slot < MAPLINES_SLOTS);
    REQUIRE(line->components >= 1 && line->components <= MAPLINES_MAX_COMPONENTS);
    REQUIRE(line->x_min <= line->x_max);
    REQUIRE(line->age >= 0);
    for (int i = 0; i < 4; ++i)
    {
        REQUIRE(is_a_number(line->gaussian.mean[i]));
        bool is_zero = true;
        for (int j = 0; j < 4; ++j)
        {
            REQUIRE(is_a_number(line->gaussian.factor[i][j]));
            is_zero = is_zero && line->gaussian.factor[i][j] == 0;
        }
        REQUIRE(!is_zero); // each variance is positive
    }
    const maplines_real_t sigma = maplines_y_sigma(line, 40);
    REQUIRE(sigma > 0 || !is_a_number(maplines_y(line, 40)));
}

static void check_all(maplines_decoder_t *decoder, int64_t now_ns)
{
    maplines_statistics_t sum;
    maplines_statistics(decoder, &sum);
    uint64_t frames = sum.line_frames + sum.pose_frames + sum.pending;
    for (int reason = 0; reason < MAPLINES_REASONS; ++reason)
    {
        frames += sum.counts[reason];
    }
    REQUIRE(frames == sum.frames);
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        maplines_slot_stats_t stats;
        (void)maplines_slot_stats(decoder, (maplines_owner_t)slot, now_ns, &stats);
        if (!decoder->dbc->messages[slot].is_present)
        {
            continue;
        }
        maplines_view_t view;
        maplines_latest(decoder, (maplines_owner_t)slot, now_ns, &view);
        if (view.line != NULL)
        {
            check_line(view.line);
        }
        REQUIRE(!view.is_usable || (view.line != NULL && is_a_number(view.age) && !view.is_stale));
    }
    if (decoder->dbc->has_pose)
    {
        maplines_scene_view_t view;
        maplines_latest_scene(decoder, now_ns, &view);
        REQUIRE(!view.is_usable || view.scene != NULL);
        for (int i = 0; view.scene != NULL && i < view.scene->count; ++i)
        {
            check_line(&view.scene->lines[i]);
        }
    }
}

static void feed(maplines_decoder_t *decoder, maplines_frame_t *frame, int64_t t_ns)
{
    const maplines_fed_t fed = maplines_feed(decoder, frame, t_ns);
    REQUIRE((fed.reason == MAPLINES_COMPLETE) == (fed.count > 0));
    for (int i = 0; i < fed.count; ++i)
    {
        const maplines_line_t *line = maplines_newest(decoder, fed.slots[i]);
        REQUIRE(line != NULL);
        check_line(line);
    }
}

/// Set the CAN ID of a message of an owner: classic, CAN FD, or authenticated.
static bool address(const maplines_dbc_t *dbc, int owner, int kind, maplines_frame_t *frame)
{
    const maplines_messages_t *messages = &dbc->messages[owner];
    const bool has[3] = {messages->has_classic, messages->has_fd, messages->has_secured};
    const uint32_t ids[3] = {messages->can_id, messages->fd_can_id, messages->secured_can_id};
    const bool extended[3] = {messages->is_extended, messages->fd_is_extended,
                              messages->secured_is_extended};
    frame->can_id = ids[kind];
    frame->is_extended = extended[kind];
    frame->is_fd = kind > 0;
    return messages->is_present && has[kind];
}

/// A frame of any content.
static void any_frame(maplines_decoder_t *decoder, input_t *input, int64_t t_ns)
{
    maplines_frame_t frame;
    memset(&frame, 0, sizeof frame);
    const uint8_t where = next(input);
    if (!address(decoder->dbc, where % MAPLINES_OWNERS, (where / MAPLINES_OWNERS) % 3, &frame))
    {
        frame.can_id = (uint32_t)next(input) << 3U;
        frame.is_extended = where > 200;
    }
    const uint8_t length = next(input);
    frame.length = length < 192 ? 8 : length % 80;
    for (int i = 0; i < 64 && i < frame.length; ++i)
    {
        frame.data[i] = next(input);
    }
    feed(decoder, &frame, t_ns);
}

/// An intact record of any content, in one CAN FD frame or in its pages, some lost or twice.
static void sealed_record(maplines_decoder_t *decoder, input_t *input, int64_t t_ns)
{
    const maplines_dbc_t *dbc = decoder->dbc;
    const uint8_t where = next(input);
    const int owner = where % MAPLINES_OWNERS;
    if (!dbc->messages[owner].is_present)
    {
        return;
    }
    const maplines_record_t *layout = maplines_layout(dbc, owner);
    const uint8_t counter = next(input);
    const uint8_t form = next(input);
    const size_t pages = (form & 1U) != 0 ? layout->short_pages : layout->pages;
    uint8_t record[MAPLINES_MAX_RECORD] = {0};
    for (size_t i = 0; i < 8 * pages; ++i)
    {
        record[i] = next(input);
    }
    maplines_seal(dbc, owner, record, 8 * pages, counter);
    maplines_frame_t frame;
    memset(&frame, 0, sizeof frame);
    if ((form & 2U) != 0 && address(dbc, owner, 1, &frame))
    {
        frame.length = dbc->messages[owner].fd_length;
        memcpy(frame.data, record, 8 * pages < frame.length ? 8 * pages : frame.length);
        feed(decoder, &frame, t_ns);
        return;
    }
    if (!address(dbc, owner, 0, &frame))
    {
        return;
    }
    frame.length = 8;
    const uint8_t lost = (form & 4U) != 0 ? next(input) : 0xFF;
    for (size_t page = 0; page < pages; ++page)
    {
        memcpy(frame.data, record + 8 * page, 8);
        for (int copies = page == lost % 16U ? lost / 64 : 1; copies > 0; --copies)
        {
            feed(decoder, &frame, t_ns);
        }
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static maplines_decoder_t decoder; // too large for some stacks; begun anew each time
    input_t input = {data, size};
    REQUIRE(maplines_decoder_init(&decoder, &harness_dbc, NULL) == NULL);
    int64_t t_ns = 1000000000;
    while (input.left > 0)
    {
        const uint8_t step = next(&input);
        t_ns = next_time(&input, t_ns);
        if (step < 96)
        {
            any_frame(&decoder, &input, t_ns);
        }
        else if (step < 240)
        {
            sealed_record(&decoder, &input, t_ns);
        }
        else if (step < 248)
        {
            maplines_expire(&decoder, t_ns);
        }
        else
        {
            check_all(&decoder, t_ns);
        }
        t_ns = t_ns < -MAPLINES_MAX_TIME || t_ns > MAPLINES_MAX_TIME ? 0 : t_ns;
    }
    check_all(&decoder, t_ns);
    return 0;
}

#ifdef REPLAY
static void replay(const char *name)
{
    static uint8_t data[1 << 20];
    FILE *file = fopen(name, "rb");
    if (file == NULL)
    {
        (void)fprintf(stderr, "cannot open %s\n", name);
        exit(2);
    }
    const size_t size = fread(data, 1, sizeof data, file);
    (void)fclose(file);
    (void)LLVMFuzzerTestOneInput(data, size);
}

/// Draw `count` inputs of up to 4 kB from a seed (xorshift64*, Vigna 2016).
static void draw(unsigned long count, uint64_t seed)
{
    static uint8_t data[4096];
    uint64_t state = seed * 2685821657736338717U + 1U;
    for (unsigned long i = 0; i < count; ++i)
    {
        const size_t size = 16 + (size_t)(state % (sizeof data - 16));
        for (size_t k = 0; k < size; ++k)
        {
            state ^= state >> 12U;
            state ^= state << 25U;
            state ^= state >> 27U;
            data[k] = (uint8_t)(state * 2685821657736338717U >> 56U);
        }
        (void)LLVMFuzzerTestOneInput(data, size);
    }
}

int main(int argc, char **argv)
{
    char *end = NULL;
    const unsigned long count = argc == 3 ? strtoul(argv[1], &end, 10) : 0;
    if (count > 0 && *end == '\0')
    {
        draw(count, strtoul(argv[2], NULL, 10));
        return 0;
    }
    for (int i = 1; i < argc; ++i)
    {
        replay(argv[i]);
    }
    return 0;
}
#endif
