/* A writer in a thread, and the reader of isr_reader.c, with the buffer of c/examples/isr between
 * them.
 *
 * Each line says its number three times: by its time, its lateral position and the time of its
 * copy. A line that is torn does not agree with itself. The numbers never go back, and after the
 * writer has ended the reader sees the last one.
 */
#include "isr_reader.h"

#include "harness_dbc.h"

#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>

#define LINES 3000

line_buffer_t buffer;
atomic_uint reads;
unsigned usable;

double position_of(int64_t number)
{
    return 0.05 * (double)(number % 100);
}

void fail(const char *what, int64_t number)
{
    (void)fprintf(stderr, "%s at line %lld\n", what, (long long)number);
    exit(1);
}

/// What an interrupt of the CAN controller does, and the task that it wakes.
static void *write_lines(void *unused)
{
    static maplines_encoder_t encoder;
    static maplines_decoder_t decoder;
    maplines_frame_t frames[MAPLINES_MAX_PAGES];
    maplines_input_t line = {.slot = MAPLINES_EGO_LEFT, .x_max = 80, .age = 0.02, .has_age = true};
    maplines_encoder_init(&encoder, &harness_dbc, NULL);
    (void)maplines_decoder_init(&decoder, &harness_dbc, NULL);
    for (int64_t number = 1; number <= LINES; ++number)
    {
        line.mean[0] = position_of(number);
        const maplines_sent_t sent = maplines_encode_line(&encoder, &line, false, 0, frames);
        for (int i = 0; i < sent.count; ++i)
        {
            (void)maplines_feed(&decoder, &frames[i], CYCLE_NS * number);
        }
        maplines_copy_line(&decoder, line.slot, CYCLE_NS * number, line_buffer_next(&buffer));
        const unsigned before = atomic_load_explicit(&reads, memory_order_relaxed);
        line_buffer_publish(&buffer);
        while (number % 100 == 50 && atomic_load_explicit(&reads, memory_order_relaxed) == before)
        {
            (void)sched_yield(); // so that the threads run beside each other
        }
    }
    return unused;
}

int main(void)
{
    pthread_t writer;
    int64_t last = 0;
    line_buffer_init(&buffer);
    if (pthread_create(&writer, NULL, write_lines, NULL) != 0)
    {
        return 2;
    }
    while (last < LINES)
    {
        last = read_line(last);
    }
    (void)pthread_join(writer, NULL);
    if (read_line(last) != LINES)
    {
        fail("not the newest", last);
    }
    (void)printf("%u %u\n", reads, usable);
    return 0;
}
