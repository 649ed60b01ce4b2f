/* CPU time of the core for lines: encode, decode, feed and sigma [ns].
 *
 * Input: rounds u32, then lines: mean and covariance, f64. Output: f64 each, the least of the
 * rounds.
 */
#include "binary.h"
#include "harness_dbc.h"
#include "internal.h"

#include <time.h>

enum {
    LINES = 256,
    REPEATED = 16
};

static maplines_input_t inputs[LINES];
static maplines_frame_t frames[LINES][MAPLINES_MAX_PAGES];
static uint16_t counts[LINES];
static maplines_complete_t contents[LINES];
static maplines_decoder_t decoder;
static double sink; // keeps the compiler from leaving the work out

static void encode(const maplines_dbc_t *dbc)
{
    maplines_encoder_t encoder;
    maplines_encoder_init(&encoder, dbc, NULL);
    for (int i = 0; i < LINES; ++i)
    {
        counts[i] = maplines_encode_line(&encoder, &inputs[i], false, 0, frames[i]).count;
    }
}

static void decode(const maplines_dbc_t *dbc)
{
    for (int i = 0; i < LINES; ++i)
    {
        uint8_t record[MAPLINES_MAX_RECORD];
        for (int page = 0; page < counts[i]; ++page)
        {
            memcpy(record + 8 * page, frames[i][page].data, 8);
        }
        const size_t length = 8U * (size_t)counts[i];
        if (maplines_check_record(dbc, MAPLINES_EGO_LEFT, record, length) == MAPLINES_COMPLETE)
        {
            (void)maplines_read_complete(dbc, MAPLINES_EGO_LEFT, record, 0, &contents[i]);
        }
        sink += (double)contents[i].line.gaussian.mean[0];
    }
}

static void feed(const maplines_dbc_t *dbc)
{
    (void)maplines_decoder_init(&decoder, dbc, NULL);
    for (int i = 0; i < LINES; ++i)
    {
        for (int page = 0; page < counts[i]; ++page)
        {
            sink += (double)maplines_feed(&decoder, &frames[i][page], 50000000LL * i).count;
        }
    }
}

static void sigma(const maplines_dbc_t *dbc)
{
    (void)dbc;
    for (int i = 0; i < LINES; ++i)
    {
        sink += (double)maplines_y_sigma(&contents[i].line, contents[i].line.x_max);
    }
}

/// Least time of one line over some rounds [ns].
static double least(void (*work)(const maplines_dbc_t *), uint32_t rounds)
{
    double least_ns = 1e300;
    for (uint32_t round = 0; round < rounds; ++round)
    {
        const clock_t begin = clock();
        for (int i = 0; i < REPEATED; ++i)
        {
            work(&harness_dbc);
        }
        const double seconds = (double)(clock() - begin) / (double)CLOCKS_PER_SEC;
        const double ns = 1e9 * seconds / (REPEATED * LINES);
        least_ns = ns < least_ns ? ns : least_ns;
    }
    return least_ns;
}

int main(void)
{
    const uint32_t rounds = read_u32();
    for (int i = 0; i < LINES; ++i)
    {
        memset(&inputs[i], 0, sizeof inputs[i]);
        inputs[i].status = MAPLINES_FULL;
        inputs[i].x_max = 80;
        for (int k = 0; k < 4; ++k)
        {
            inputs[i].mean[k] = read_f64();
        }
        for (int k = 0; k < 16; ++k)
        {
            inputs[i].cov[k / 4][k % 4] = read_f64();
        }
    }
    write_f64(least(encode, rounds));
    write_f64(least(decode, rounds));
    write_f64(least(feed, rounds));
    write_f64(least(sigma, rounds));
    return sink == 0.5 ? 1 : 0;
}
