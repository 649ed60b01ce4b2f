/* CPU time of the core for a scene: to its frames, and back to the scene [ns].
 *
 * Input: rounds u32, CAN FD u8, then a scene, see scene_input.h. Output: f64 each, the least of the
 * rounds.
 */
#include "harness_dbc.h"
#include "scene_input.h"

#include <time.h>

enum {
    REPEATED = 50
};

static maplines_scene_input_t scene;
static maplines_scene_workspace_t workspace;
static maplines_frame_t frames[REPEATED][MAPLINES_MAX_SCENE_FRAMES];
static uint16_t counts[REPEATED];
static bool is_fd;
static double sink; // keeps the compiler from leaving the work out

static void encode(void)
{
    maplines_encoder_t encoder;
    maplines_encoder_init(&encoder, &harness_dbc, NULL);
    for (int i = 0; i < REPEATED; ++i)
    {
        counts[i] = maplines_encode_scene(&encoder, &scene, is_fd, 0, &workspace, frames[i]).count;
    }
}

static void decode(void)
{
    static maplines_decoder_t decoder;
    static maplines_scene_copy_t copy;
    (void)maplines_decoder_init(&decoder, &harness_dbc, NULL);
    for (int i = 0; i < REPEATED; ++i)
    {
        const int64_t t_ns = INT64_C(50000000) * i;
        for (int k = 0; k < counts[i]; ++k)
        {
            (void)maplines_feed(&decoder, &frames[i][k], t_ns + 1000 * k);
        }
        maplines_copy_scene(&decoder, t_ns + 1000000, &copy);
        sink += (double)copy.scene.lines[0].gaussian.mean[0];
    }
}

/// Least time of one scene over some rounds [ns].
static double least(void (*work)(void), uint32_t rounds)
{
    double least_ns = 1e300;
    for (uint32_t round = 0; round < rounds; ++round)
    {
        const clock_t begin = clock();
        work();
        const double seconds = (double)(clock() - begin) / (double)CLOCKS_PER_SEC;
        const double ns = 1e9 * seconds / REPEATED;
        least_ns = ns < least_ns ? ns : least_ns;
    }
    return least_ns;
}

int main(void)
{
    const uint32_t rounds = read_u32();
    is_fd = read_u8() != 0;
    read_scene(&scene);
    write_f64(least(encode, rounds));
    write_f64(least(decode, rounds));
    return sink == 0.5 ? 1 : 0;
}
