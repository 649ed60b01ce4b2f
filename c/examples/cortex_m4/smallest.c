/* What a linker takes of the library for a node of an ECU: its size is measured, it is not run. */
#include "maplines_dbc.h"

/// A driver: a frame and its time, and what the car does with a line.
extern volatile bool has_frame;
extern maplines_frame_t driver_frame;
extern volatile int64_t driver_ns;
volatile bool has_frame;
maplines_frame_t driver_frame;
volatile int64_t driver_ns;
volatile maplines_real_t steering[4];

#if MAPLINES_RECEIVER
static maplines_decoder_t decoder;

#if MAPLINES_LINE_RECORDS
static void cycle(int64_t now_ns)
{
    maplines_view_t view;
    maplines_latest(&decoder, MAPLINES_EGO_LEFT, now_ns, &view);
    if (view.is_usable)
    {
        steering[0] = maplines_y(view.line, 20);
        steering[1] = maplines_y_sigma(view.line, 20);
    }
#if MAPLINES_SCENES
    maplines_scene_view_t lane;
    maplines_estimate_t width;
    maplines_latest_scene(&decoder, now_ns, &lane);
    if (lane.is_usable &&
        maplines_width(lane.scene, MAPLINES_EGO_LEFT, MAPLINES_EGO_RIGHT, 20, &width))
    {
        steering[2] = width.value;
        steering[3] = width.sigma;
    }
#endif
}
#else
static void cycle(int64_t now_ns)
{
    static maplines_line_copy_t line;
    static maplines_scene_copy_t lane;
    maplines_estimate_t width;
    maplines_copy_line(&decoder, MAPLINES_EGO_LEFT, now_ns, &line);
    if (line.is_usable)
    {
        steering[0] = maplines_y(&line.line, 20);
        steering[1] = maplines_y_sigma(&line.line, 20);
    }
    maplines_copy_scene(&decoder, now_ns, &lane);
    if (lane.is_usable &&
        maplines_width(&lane.scene, MAPLINES_EGO_LEFT, MAPLINES_EGO_RIGHT, 20, &width))
    {
        steering[2] = width.value;
        steering[3] = width.sigma;
    }
}
#endif

int main(void)
{
    maplines_decoder_init_default(&decoder, &maplines_dbc);
    for (;;)
    {
        if (has_frame)
        {
            maplines_feed(&decoder, &driver_frame, driver_ns);
        }
        cycle(driver_ns);
    }
}
#else
static maplines_encoder_t encoder;
static maplines_frame_t frames[MAPLINES_MAX_PAGES];
extern maplines_input_t seen;
maplines_input_t seen;

int main(void)
{
    maplines_encoder_init(&encoder, &maplines_dbc, NULL);
    for (;;)
    {
        const maplines_sent_t sent = maplines_encode_line(&encoder, &seen, has_frame, 0, frames);
        steering[0] = sent.count;
    }
}
#endif
