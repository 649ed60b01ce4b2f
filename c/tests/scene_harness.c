/* The newest scene of some frames, as a square root of its joint covariance.
 *
 * Input, for each scene: count of frames (u8), and of each CAN ID (u32), is_extended, length (u8)
 * and data. Output: count of lines (u8), and of each mean (4), spread (4 x 7), specific (4 x 4),
 * factor (4 x 4), fit range (2), all f64.
 */
#include "binary.h"
#include "harness_dbc.h"

static maplines_decoder_t decoder;

static void write_reals(const maplines_real_t *values, size_t count)
{
    for (size_t i = 0; i < count; ++i)
    {
        write_f64((double)values[i]);
    }
}

int main(void)
{
    while (!at_end())
    {
        static maplines_scene_copy_t copy;
        const maplines_scene_t *scene = &copy.scene;
        (void)maplines_decoder_init(&decoder, &harness_dbc, NULL);
        for (uint8_t left = read_u8(); left > 0; --left)
        {
            maplines_frame_t frame = {0};
            frame.can_id = read_u32();
            frame.is_extended = read_u8() != 0;
            frame.length = read_u8();
            read_bytes(frame.data, frame.length);
            (void)maplines_feed(&decoder, &frame, 0);
        }
        maplines_copy_scene(&decoder, 0, &copy);
        write_u8(scene->count);
        for (uint8_t i = 0; i < scene->count; ++i)
        {
            write_reals(scene->lines[i].gaussian.mean, 4);
            write_reals(scene->spread[(size_t)4 * i], 28);
            write_reals(scene->specific[i][0], 16);
            write_reals(scene->lines[i].gaussian.factor[0], 16);
            write_reals(scene->fit_range[i], 2);
        }
    }
    return 0;
}
