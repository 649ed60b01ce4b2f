/* Receiver and sender on a Cortex-M4 without an operating system: recorded frames to lines.
 *
 * For each line that the frames of recorded.h complete, it prints y(40 m) and its standard
 * deviation, and for each scene the width of the lane. A line that begins with # is a measurement:
 * instructions and stack of a call. The same program runs on a host, without these.
 */
#include "maplines_dbc.h"
#include "measure.h"
#include "recorded.h"

#define X 40 // where the lines are evaluated [m]

/// All memory of a receiver and of a sender.
static maplines_decoder_t decoder;
static maplines_encoder_t encoder;

/// Measurements of maplines_feed, by what a frame does.
static measurement_t pending, line_complete, pose_complete, others;
static measurement_t latest, latest_scene, y_sigma, width_sigma, prediction, encoding;

static measurement_t *kind_of(const maplines_fed_t *fed, const maplines_frame_t *frame)
{
    if (fed->reason != MAPLINES_COMPLETE)
    {
        return fed->reason == MAPLINES_PENDING ? &pending : &others;
    }
    const bool is_pose = frame->can_id == maplines_dbc.messages[MAPLINES_POSE].can_id;
    return is_pose ? &pose_complete : &line_complete;
}

static void use_line(maplines_owner_t slot, int64_t t_ns)
{
    maplines_view_t view;
    measure_begin(&latest);
    maplines_latest(&decoder, slot, t_ns, &view);
    measure_end(&latest);
    measure_begin(&y_sigma);
    const double y = (double)maplines_y(view.line, X);
    const double sigma = (double)maplines_y_sigma(view.line, X);
    measure_end(&y_sigma);
    const maplines_motion_t motion = {20, 0, (maplines_real_t)0.2, (maplines_real_t)0.01, 0};
    maplines_line_t now;
    measure_begin(&prediction);
    const int result = maplines_predict_to(view.line, t_ns, &motion, 0, &now);
    measure_end(&prediction);
    printf("%d %d %.17g %.17g %.17g\n", slot, view.state, y, sigma,
           result == MAPLINES_PREDICTED ? (double)maplines_y_sigma(&now, X) : -1.0);
}

/// Send a line that was received, as a gateway does.
static void send_line(maplines_owner_t slot)
{
    const maplines_line_t *line = maplines_newest(&decoder, slot);
    maplines_frame_t frames[MAPLINES_MAX_PAGES];
    maplines_real_t covariance[4][4];
    maplines_covariance(&line->gaussian, covariance);
    maplines_input_t input = {
        .slot = slot,
        .kind = line->kind,
        .status = line->status,
        .x_min = (double)line->x_min,
        .x_max = (double)line->x_max,
        .age = (double)line->age,
        .has_age = true,
    };
    for (int i = 0; i < 4; ++i)
    {
        input.mean[i] = (double)line->gaussian.mean[i];
        for (int j = 0; j < 4; ++j)
        {
            input.cov[i][j] = (double)covariance[i][j];
        }
    }
    measure_begin(&encoding);
    const maplines_sent_t sent = maplines_encode_line(&encoder, &input, false, 0, frames);
    measure_end(&encoding);
    printf("%d frames\n", sent.count);
}

static void use_scene(int64_t t_ns)
{
    maplines_scene_view_t view;
    maplines_estimate_t width;
    measure_begin(&latest_scene);
    maplines_latest_scene(&decoder, t_ns, &view);
    measure_end(&latest_scene);
    if (view.scene != NULL)
    {
        measure_begin(&width_sigma);
        (void)maplines_width(view.scene, MAPLINES_EGO_LEFT, MAPLINES_EGO_RIGHT, X, &width);
        measure_end(&width_sigma);
        printf("scene of %d %.17g %.17g\n", view.scene->count, (double)width.value,
               (double)width.sigma);
    }
}

int main(void)
{
    (void)maplines_decoder_init(&decoder, &maplines_dbc, NULL);
    maplines_encoder_init(&encoder, &maplines_dbc, NULL);
    printf("# state of a receiver: %lu bytes\n", (unsigned long)sizeof decoder);
    printf("# state of a sender: %lu bytes\n", (unsigned long)sizeof encoder);
    for (size_t i = 0; i < sizeof recorded / sizeof *recorded; ++i)
    {
        measurement_t feeding = {0};
        measure_begin(&feeding);
        const maplines_fed_t fed = maplines_feed(&decoder, &recorded[i].frame, recorded[i].t_ns);
        measure_end(&feeding);
        measure_add(kind_of(&fed, &recorded[i].frame), &feeding);
        for (int k = 0; k < fed.count; ++k)
        {
            use_line(fed.slots[k], recorded[i].t_ns);
            if (!maplines_dbc.is_conditional)
            {
                send_line(fed.slots[k]);
            }
        }
        if (recorded[i].is_last)
        {
            use_scene(recorded[i].t_ns);
        }
    }
    measure_print("feed, a frame that waits for others", &pending);
    measure_print("feed, a frame that completes a line", &line_complete);
    measure_print("feed, a frame that completes a pose error", &pose_complete);
    measure_print("feed, another frame", &others);
    measure_print("latest line", &latest);
    measure_print("latest scene, decoded", &latest_scene);
    measure_print("y and sigma at x", &y_sigma);
    measure_print("width and sigma at x", &width_sigma);
    measure_print("prediction by the motion of the car", &prediction);
    measure_print("encode a line", &encoding);
    return 0;
}
