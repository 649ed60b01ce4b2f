/* A receiver of any build, for a comparison with the model: a step a line of the standard input,
 * and what comes of it a line of the standard output.
 *
 *     F t_ns can_id is_extended hex     a frame: its reason, and the lines that it completes
 *     L slot t_ns                       the newest line of a slot, and whether it may be used
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
    printf(" cov");
    for (int i = 0; i < 16; ++i)
    {
        print_real(covariance[i / 4][i % 4]);
    }
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
        print_line(maplines_newest(&decoder, fed.slots[i]));
    }
}

static void latest(const char *row)
{
    int slot;
    int64_t t_ns;
    maplines_view_t view;
    if (sscanf(row, "L %d %" SCNd64, &slot, &t_ns) < 2)
    {
        exit(EXIT_FAILURE);
    }
    maplines_latest(&decoder, (maplines_owner_t)slot, t_ns, &view);
    printf("view %s %s %d %d %d", maplines_e2e_state_name(view.state),
           maplines_e2e_status_name(view.status), view.is_stale, view.two_senders, view.is_usable);
    print_real(view.age);
    if (view.line != NULL)
    {
        print_line(view.line);
    }
}

static void checks(int64_t t_ns)
{
    for (int owner = 0; owner < MAPLINES_OWNERS; ++owner)
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
        case 'E':
            maplines_expire(&decoder, strtoll(row + 2, NULL, 10));
            break;
        default:
            checks(strtoll(row + 2, NULL, 10));
            break;
        }
        print_numbers();
    }
    return 0;
}
