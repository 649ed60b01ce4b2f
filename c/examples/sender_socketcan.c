/* Sender on SocketCAN: eight lines of a bend, seen by a car that weaves in its lane.
 *
 *     sender_socketcan vcan0                       20 times a second until Ctrl-C
 *     sender_socketcan vcan0 20 500                a cycle each 20 ms, 500 cycles
 *     sender_socketcan vcan0 20 500 scenes         with the error of the pose
 *     sender_socketcan vcan0 20 500 lines fd       CAN FD
 *
 * The messages are those of maplines_dbc.h, which `maplines generate c` writes from a DBC.
 */
#define _GNU_SOURCE

#include "maplines_dbc.h"
#include "socketcan.h"

#include <limits.h>
#include <math.h>
#include <stdio.h>

#define CURVATURE 0.002 /* of the road [1/m] */

/// Lateral positions of the lines from the middle of the lane [m], by slot.
static const double positions[MAPLINES_SLOTS] = {1.75, -1.75, 5.25, -5.25, 0.0, 7.0, -7.0, 0.4};

/// Standard deviations of the pose (along [m], across [m], heading [rad]), and of each line alone.
static const double pose_sigma[3] = {0.3, 0.1, 0.005};
static const double own_sigma[4] = {0.03, 0.001, 1e-4, 1e-6};

/* All memory of the sender. */
static maplines_encoder_t encoder;
static maplines_scene_input_t scene;
static maplines_scene_workspace_t workspace;
static maplines_frame_t frames[MAPLINES_MAX_SCENE_FRAMES];

/// Set the scene to what the car sees at a time [s].
static void see(double t)
{
    const double offset = 0.3 * sin(0.6 * t); // of the car from the middle of its lane
    const double slope = 0.01 * cos(0.6 * t);
    // Derivatives of the parameters of a line with respect to the pose.
    const double J[4][3] = {{-slope, -1, 0}, {CURVATURE, 0, -1}, {0, 0, 0}, {0, 0, 0}};
    memset(&scene, 0, sizeof scene);
    scene.count = MAPLINES_SLOTS;
    scene.has_specific = true;
    scene.pose_age = 0.01;
    scene.has_pose_age = true;
    scene.correlation_time = 10;
    for (int k = 0; k < 3; ++k)
    {
        scene.pose_cov[k][k] = pose_sigma[k] * pose_sigma[k];
    }
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        scene.lines[slot] = (maplines_scene_line_t){
            .slot = (maplines_owner_t)slot,
            .kind = MAPLINES_SOLID,
            .status = MAPLINES_FULL,
            .x_min = -8,
            .x_max = 80,
            .age = 0.01,
            .has_age = true,
            .mean = {positions[slot] - offset, -slope, CURVATURE, 0},
            .fit_range = {-8, 80},
        };
        for (int i = 0; i < 4; ++i)
        {
            scene.lines[slot].specific[i][i] = own_sigma[i] * own_sigma[i];
            scene.cov[4 * slot + i][4 * slot + i] = own_sigma[i] * own_sigma[i];
        }
    }
    for (int i = 0; i < 4 * MAPLINES_SLOTS; ++i)
    {
        for (int j = 0; j < 4 * MAPLINES_SLOTS; ++j)
        {
            for (int k = 0; k < 3; ++k)
            {
                scene.cov[i][j] += J[i % 4][k] * scene.pose_cov[k][k] * J[j % 4][k];
            }
        }
    }
}

#if MAPLINES_LINE_RECORDS
/// Encode a line of the scene, with its part of the covariance; the number of frames.
static int encode_line(const maplines_scene_line_t *line, bool is_fd)
{
    const int first = 4 * (int)line->slot;
    maplines_input_t input = {line->slot, line->kind,    line->status, line->x_min, line->x_max,
                              line->age,  line->has_age, {0},          {{0}}};
    memcpy(input.mean, line->mean, sizeof input.mean);
    for (int i = 0; i < 4; ++i)
    {
        memcpy(input.cov[i], &scene.cov[first + i][first], sizeof input.cov[i]);
    }
    return maplines_encode_line(&encoder, &input, is_fd, 0, frames).count;
}
#endif

/// Send frames; false if the bus fails, or if there are none.
static bool send_frames(int bus, int count)
{
    bool is_sent = count > 0;
    for (int i = 0; i < count && is_sent; ++i)
    {
        is_sent = send_frame(bus, &frames[i]);
    }
    return is_sent;
}

int main(int count, char **arguments)
{
    if (count < 2)
    {
        fprintf(stderr, "usage: %s INTERFACE [CYCLE_MS [CYCLES [lines|scenes [fd]]]]\n",
                arguments[0]);
        return EXIT_FAILURE;
    }
    const int64_t cycle_ns = count > 2 ? atoll(arguments[2]) * 1000000 : 50000000;
    const long cycles = count > 3 ? atol(arguments[3]) : LONG_MAX;
    const bool is_scene = count > 4 && strcmp(arguments[4], "scenes") == 0;
    const bool is_fd = count > 5 && strcmp(arguments[5], "fd") == 0;
    const int bus = open_bus(arguments[1], NULL);
    bool is_sent = bus >= 0;
    long lines = 0;
    errno = is_sent ? 0 : errno;
    stop_at_signals();
    maplines_encoder_init(&encoder, &maplines_dbc, NULL);
    const int64_t start_ns = now_ns(CLOCK_MONOTONIC);
    for (long k = 0; k < cycles && is_sent && !is_stopped; ++k)
    {
        wait_until(start_ns + k * cycle_ns);
        see(1e-9 * (double)(k * cycle_ns));
        if (is_scene)
        {
            is_sent = send_frames(
                bus, maplines_encode_scene(&encoder, &scene, is_fd, 0, &workspace, frames).count);
            lines += is_sent ? scene.count : 0;
        }
#if MAPLINES_LINE_RECORDS // else there are whole scenes only
        for (int i = 0; i < scene.count && !is_scene && is_sent; ++i)
        {
            is_sent = send_frames(bus, encode_line(&scene.lines[i], is_fd));
            lines += is_sent;
        }
#endif
    }
    if (!is_sent && !is_stopped)
    {
        fprintf(stderr, "%s: %s\n", arguments[1],
                errno != 0 ? strerror(errno) : "the DBC has no such message");
    }
    printf("%ld lines sent\n", lines);
    return is_sent || is_stopped ? EXIT_SUCCESS : EXIT_FAILURE;
}
