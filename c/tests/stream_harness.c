/* A receiver of any build, for a comparison with the model: a step a line of the standard input,
 * and what comes of it a line of the standard output.
 *
 *     F t_ns can_id is_extended hex     a frame: its reason, and the lines that it completes
 *     L slot t_ns                       the newest line of a slot, and whether it may be used
 *     N t_ns                            the newest scene, and whether it may be used
 *     E t_ns                            expire
 *     S t_ns                            the checks of all owners
 *
 * After each step come all numbers of frames. Real numbers are printed as their bits.
 */
#include "harness_dbc.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static maplines_decoder_t decoder;

static void print_real(maplines_real_t value)
{
    const double wide = (double)value;
    uint64_t bits;
    memcpy(&bits, &wide, sizeof bits);
    printf(" %016" PRIx64, bits);
}

static void print_covariance(size_t count, const maplines_real_t *covariance)
{
    printf(" cov %zu", count);
    for (size_t i = 0; i < count; ++i)
    {
        print_real(covariance[i]);
    }
}

static void print_line(const maplines_line_t *line)
{
    maplines_real_t covariance[4][4];
    printf(" line %d %d %d %" PRId64, (int)line->slot, (int)line->kind, (int)line->status,
           line->t_ns);
    print_real(line->x_min);
    print_real(line->x_max);
    print_real(line->age);
    maplines_covariance(&line->gaussian, covariance);
    for (int i = 0; i < 4; ++i)
    {
        print_real(line->gaussian.mean[i]);
    }
    print_covariance(16, covariance[0]);
}

static void feed(const char *row)
{
    maplines_frame_t frame;
    int64_t t_ns;
    int is_extended, at;
    memset(&frame, 0, sizeof frame);
    if (sscanf(row, "F %" SCNd64 " %" SCNx32 " %d %n", &t_ns, &frame.can_id, &is_extended, &at) < 3)
    {
        exit(EXIT_FAILURE);
    }
    frame.is_extended = is_extended != 0;
    for (const char *hex = row + at; hex[0] > ' ' && hex[1] > ' '; hex += 2)
    {
        sscanf(hex, "%2hhx", &frame.data[frame.length]);
        ++frame.length;
    }
    const maplines_fed_t fed = maplines_feed(&decoder, &frame, t_ns);
    printf("%s", fed.reason == MAPLINES_COMPLETE ? "" : maplines_reason_name(fed.reason));
    for (int i = 0; i < fed.count; ++i)
    {
#if MAPLINES_LINE_RECORDS
        print_line(maplines_newest(&decoder, fed.slots[i]));
#else
        maplines_decoder_t other = decoder; // so that no cycles pass in this one
        maplines_line_copy_t copy;
        maplines_copy_line(&other, fed.slots[i], t_ns, &copy);
        print_line(&copy.line);
#endif
    }
}

static void latest(const char *row)
{
    int slot;
    int64_t t_ns;
    maplines_line_copy_t copy;
    if (sscanf(row, "L %d %" SCNd64, &slot, &t_ns) < 2)
    {
        exit(EXIT_FAILURE);
    }
    maplines_copy_line(&decoder, (maplines_owner_t)slot, t_ns, &copy);
    printf("view %s %s %d %d %d", maplines_e2e_state_name(copy.state),
           maplines_e2e_status_name(copy.status), copy.is_stale, copy.two_senders, copy.is_usable);
#if MAPLINES_SCENE_RECORDS
    printf(" %s", maplines_left_out_name(copy.left_out));
#endif
    print_real(copy.age);
    if (copy.has_line)
    {
        print_line(&copy.line);
    }
}

#if MAPLINES_SCENES
static void latest_scene(int64_t t_ns)
{
    static maplines_scene_copy_t copy;
    static maplines_real_t covariance[16 * MAPLINES_SLOTS * MAPLINES_SLOTS];
    maplines_owner_t slots[MAPLINES_SLOTS];
    const maplines_scene_t *scene = &copy.scene;
    maplines_copy_scene(&decoder, t_ns, &copy);
    printf("scene %s %s %d %d %d", maplines_e2e_state_name(copy.state),
           maplines_e2e_status_name(copy.status), copy.is_stale, copy.two_senders, copy.is_usable);
    print_real(copy.age);
    for (int i = 0; i < scene->count; ++i)
    {
        slots[i] = scene->lines[i].slot;
        printf(" %s", maplines_e2e_state_name(copy.slot_states[i]));
        print_line(&scene->lines[i]);
        print_real(scene->fit_range[i][0]);
        print_real(scene->fit_range[i][1]);
        print_real(scene->quartic[i]);
    }
    if (copy.has_scene)
    {
        printf(" %u %" PRId64, (unsigned)scene->counter, scene->t_ns);
        print_real(scene->correlation_time);
        print_real(scene->offset_sigma);
        print_real(scene->heading_sigma);
        if (!maplines_joint_covariance(scene, scene->count, slots, covariance))
        {
            exit(EXIT_FAILURE);
        }
        print_covariance((size_t)16 * scene->count * scene->count, covariance);
#if MAPLINES_SCENE_RECORDS
        for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
        {
            printf(" %s", maplines_left_out_name(scene->left_out[slot]));
        }
#endif
    }
}
#endif

static void checks(int64_t t_ns)
{
    for (int owner = MAPLINES_FIRST_OWNER; owner < MAPLINES_FIRST_OWNER + MAPLINES_OWNERS; ++owner)
    {
        maplines_slot_stats_t stats;
        if (maplines_slot_stats(&decoder, (maplines_owner_t)owner, t_ns, &stats))
        {
            printf(" check %s %s %s %d", maplines_owner_name((maplines_owner_t)owner),
                   maplines_e2e_state_name(stats.state), maplines_e2e_status_name(stats.status),
                   stats.two_senders);
            const uint64_t counts[] = {stats.ok,     stats.lost,           stats.repeated,
                                       stats.errors, stats.wrong_sequence, stats.no_new_data};
            for (size_t i = 0; i < sizeof counts / sizeof counts[0]; ++i)
            {
                printf(" %" PRIu64, counts[i]);
            }
        }
    }
}

static void print_numbers(void)
{
    maplines_statistics_t statistics;
    maplines_statistics(&decoder, &statistics);
    printf(" | %" PRIu64 " %" PRIu64 " %" PRIu64 " %" PRIu64 " %u", statistics.frames,
           statistics.lines, statistics.line_frames, statistics.lost, (unsigned)statistics.pending);
    for (int i = 0; i < MAPLINES_REASONS; ++i)
    {
        printf(" %" PRIu64, statistics.counts[i]);
    }
    printf("\n");
}

int main(void)
{
    static char row[512];
    maplines_decoder_init(&decoder, &harness_dbc, NULL);
    while (fgets(row, sizeof row, stdin) != NULL)
    {
        switch (row[0])
        {
        case 'F':
            feed(row);
            break;
        case 'L':
            latest(row);
            break;
#if MAPLINES_SCENES
        case 'N':
            latest_scene(strtoll(row + 2, NULL, 10));
            break;
#endif
#if MAPLINES_LINE_RECORDS
        case 'E':
            maplines_expire(&decoder, strtoll(row + 2, NULL, 10));
            break;
#endif
        default:
            checks(strtoll(row + 2, NULL, 10));
            break;
        }
        print_numbers();
    }
    return 0;
}
