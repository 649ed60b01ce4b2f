/* Receiver on SocketCAN: a row for each line and each scene that is received, and counters at the
 * end.
 *
 *     receiver_socketcan vcan0          until Ctrl-C
 *     receiver_socketcan vcan0 60       for 60 s
 *
 * The messages are those of maplines_dbc.h, which `maplines generate c` writes from any DBC: lines
 * and scenes are copied, as a library for whole scenes has them, too.
 */
#define _GNU_SOURCE

#include "maplines_dbc.h"
#include "socketcan.h"

#include <stdio.h>

#define X 40      /* where the lines are evaluated [m] */
#define X_SCENE 0 /* where the lane is [m] */

static void print_line(maplines_decoder_t *decoder, maplines_owner_t slot, int64_t t_ns)
{
    maplines_line_copy_t copy;
    const maplines_line_t *line = &copy.line;
    maplines_copy_line(decoder, slot, t_ns, &copy);
    printf("%-10s %-7s ", maplines_owner_name(slot), maplines_e2e_state_name(copy.state));
    if (line->status == MAPLINES_OUT_OF_RANGE || !maplines_is_valid_at(line, X))
    {
        printf("nothing at %d m\n", X);
        return;
    }
    printf("y(%d m) %9.6f m, sigma %.6f m, age %.0f ms\n", X, (double)maplines_y(line, X),
           (double)maplines_y_sigma(line, X), 1e3 * (double)copy.age);
}

/// Row of the newest scene, printed when the next one comes: until then, lines may join it.
static char row[160];

static void print_scene(void)
{
    fputs(row, stdout);
    row[0] = '\0';
}

/// Write the row with the width and the centre of the ego lane.
static void write_scene(maplines_decoder_t *decoder, int64_t t_ns, int64_t *last_ns)
{
    static const maplines_owner_t left = MAPLINES_EGO_LEFT, right = MAPLINES_EGO_RIGHT;
    static maplines_scene_copy_t copy;
    const maplines_scene_t *scene = &copy.scene;
    maplines_estimate_t width, centre;
    maplines_copy_scene(decoder, t_ns, &copy);
    if (!copy.has_scene)
    {
        return;
    }
    if (scene->t_ns != *last_ns)
    {
        print_scene();
        *last_ns = scene->t_ns;
    }
    if (maplines_width(scene, left, right, X_SCENE, &width) &&
        maplines_centre(scene, left, right, X_SCENE, &centre))
    {
        snprintf(row, sizeof row,
                 "scene      %-7s width %.6f m, sigma %.6f m; centre %.6f m, sigma %.6f m\n",
                 maplines_e2e_state_name(copy.state), (double)width.value, (double)width.sigma,
                 (double)centre.value, (double)centre.sigma);
    }
}

static void print_counters(maplines_decoder_t *decoder, int64_t t_ns)
{
    maplines_statistics_t total;
    maplines_slot_stats_t checks;
    maplines_statistics(decoder, &total);
    printf("%llu frames, %llu lines, %llu lost\n", (unsigned long long)total.frames,
           (unsigned long long)total.lines, (unsigned long long)total.lost);
    for (int i = 0; i < MAPLINES_REASONS; ++i)
    {
        if (total.counts[i] != 0)
        {
            printf("%llu dropped: %s\n", (unsigned long long)total.counts[i],
                   maplines_reason_name((maplines_reason_t)i));
        }
    }
    for (int i = MAPLINES_FIRST_OWNER; i < MAPLINES_FIRST_OWNER + MAPLINES_OWNERS; ++i)
    {
        if (maplines_slot_stats(decoder, (maplines_owner_t)i, t_ns, &checks))
        {
            printf("%-10s %-7s %llu ok, %llu lost%s\n", maplines_owner_name((maplines_owner_t)i),
                   maplines_e2e_state_name(checks.state), (unsigned long long)checks.ok,
                   (unsigned long long)checks.lost, checks.two_senders ? ", TWO SENDERS" : "");
        }
    }
}

int main(int count, char **arguments)
{
    static maplines_decoder_t decoder;
    maplines_frame_t frame;
    int64_t scene_ns = INT64_MIN;
    if (count < 2)
    {
        fprintf(stderr, "usage: %s INTERFACE [SECONDS]\n", arguments[0]);
        return EXIT_FAILURE;
    }
    const int bus = open_bus(arguments[1], &maplines_dbc);
    if (bus < 0)
    {
        perror(arguments[1]);
        return EXIT_FAILURE;
    }
    const int64_t end_ns =
        count > 2 ? now_ns(CLOCK_REALTIME) + (int64_t)(1e9 * atof(arguments[2])) : INT64_MAX;
    stop_at_signals();
    maplines_decoder_init(&decoder, &maplines_dbc, NULL);
    while (!is_stopped && now_ns(CLOCK_REALTIME) < end_ns)
    {
        int64_t t_ns;
        if (receive_frame(bus, &frame, &t_ns))
        {
            const maplines_fed_t fed = maplines_feed(&decoder, &frame, t_ns);
            for (int i = 0; i < fed.count; ++i)
            {
                print_line(&decoder, fed.slots[i], t_ns);
            }
            write_scene(&decoder, t_ns, &scene_ns);
        }
    }
    print_scene();
    print_counters(&decoder, now_ns(CLOCK_REALTIME));
    return close(bus) == 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}
