/* Receiver as a node of an FMU: frames to lines, and what a car wants to know of them.
 *
 * What is not known has an infinite standard deviation: without a line, or at an x outside the
 * range in which the line is valid.
 */
#include "fmu.h"

#include <math.h>
#include <string.h>

static const double unknown = (double)INFINITY;

/// Time of the simulation in whole nanoseconds.
static int64_t nanoseconds(double t)
{
    return (int64_t)floor(t * 1e9 + 0.5);
}

/* ---- the node -------------------------------------------------------------------------------- */

void maplines_bind(maplines_node_t *node)
{
    node->decoder.dbc = &MAPLINES_DBC;
}

void maplines_unbind(maplines_node_t *node)
{
    node->decoder.dbc = NULL;
}

const char *maplines_start(maplines_instance_t *instance)
{
    const maplines_values_t *values = &instance->state.values;
    maplines_settings_t settings;
    const char *wrong =
        maplines_settings_for(&MAPLINES_DBC, 1e3 * values->reals[REAL_TIMEOUT],
                              1e3 * values->reals[REAL_CYCLE_TIME], NULL, &settings);
    (void)maplines_decoder_init(&instance->state.node.decoder, &MAPLINES_DBC, &settings);
    return wrong;
}

size_t maplines_scratch_size(void)
{
    return 0;
}

void maplines_note_input(maplines_node_t *node, fmi3ValueReference first, size_t index)
{
    (void)node; // a receiver has none but Rx_Data
    (void)first;
    (void)index;
}

void maplines_take_inputs(maplines_instance_t *instance)
{
    (void)instance;
}

void maplines_take_frame(maplines_instance_t *instance, const maplines_frame_t *frame)
{
    (void)maplines_feed(&instance->state.node.decoder, frame, nanoseconds(instance->state.now));
}

void maplines_take_notification(maplines_instance_t *instance, uint32_t can_id,
                                bool is_acknowledged)
{
    (void)instance; // a receiver sends no frames
    (void)can_id;
    (void)is_acknowledged;
}

void maplines_send_due(maplines_instance_t *instance)
{
    (void)instance;
}

double maplines_next_due(const maplines_instance_t *instance)
{
    (void)instance;
    return unknown;
}

/* ---- outputs --------------------------------------------------------------------------------- */

/// Show mean, covariance and range of a line, and its lateral positions at the x of the parameters.
static void show_line(const maplines_line_t *line, const double *x, double *reals)
{
    double cov[4][4];
    double *entry = &reals[SLOT_REAL_COV];
    maplines_covariance(&line->gaussian, cov);
    reals[SLOT_REAL_X_MIN] = line->x_min;
    reals[SLOT_REAL_X_MAX] = line->x_max;
    for (int i = 0; i < 4; i++)
    {
        reals[SLOT_REAL_MEAN + i] = line->gaussian.mean[i];
        for (int j = 0; j <= i; j++)
        {
            *entry = cov[i][j];
            entry++;
        }
    }
    for (int k = 0; k < MAPLINES_POSITIONS; k++)
    {
        const bool is_valid = maplines_is_valid_at(line, x[k]);
        reals[SLOT_REAL_Y + k] = is_valid ? maplines_y(line, x[k]) : 0.0;
        reals[SLOT_REAL_Y_SIGMA + k] = is_valid ? maplines_y_sigma(line, x[k]) : unknown;
    }
}

/// Show that there is no line.
static void show_no_line(double *reals)
{
    int entry = SLOT_REAL_COV;
    memset(reals, 0, SLOT_REALS * sizeof *reals);
    for (int i = 0; i < 4; i++)
    {
        reals[entry + i] = unknown; // a variance
        entry += i + 1;
    }
    for (int k = 0; k < MAPLINES_POSITIONS; k++)
    {
        reals[SLOT_REAL_Y_SIGMA + k] = unknown;
    }
}

/// Show the E2E checks of an owner of records, in the order of their variables.
static void show_checks(maplines_decoder_t *decoder, int owner, int64_t now_ns, uint64_t *counts)
{
    maplines_slot_stats_t stats;
    memset(&stats, 0, sizeof stats);
    (void)maplines_slot_stats(decoder, (maplines_owner_t)owner, now_ns, &stats);
    counts[0] = stats.ok;
    counts[1] = stats.lost;
    counts[2] = stats.repeated;
    counts[3] = stats.wrong_sequence;
    counts[4] = stats.errors;
    counts[5] = stats.no_new_data;
}

/// Show a slot.
static void show_slot(maplines_instance_t *instance, int slot, int64_t now_ns)
{
    maplines_values_t *values = &instance->state.values;
    maplines_decoder_t *decoder = &instance->state.node.decoder;
    double *reals = &values->reals[REAL_SLOTS + SLOT_REALS * slot];
    int64_t *choices = &values->choices[CHOICE_SLOTS + SLOT_CHOICES * slot];
    bool *flags = &values->flags[FLAG_SLOTS + SLOT_FLAGS * slot];
    maplines_view_t view;
    maplines_latest(decoder, (maplines_owner_t)slot, now_ns, &view);
    if (view.line == NULL)
    {
        show_no_line(reals);
    }
    else
    {
        show_line(view.line, &values->reals[REAL_X], reals);
    }
    reals[SLOT_REAL_AGE] = view.age;
    choices[SLOT_CHOICE_KIND] = view.line == NULL ? 0 : (int64_t)view.line->kind;
    choices[SLOT_CHOICE_STATUS] = view.line == NULL ? 0 : (int64_t)view.line->status;
    choices[SLOT_CHOICE_E2E_STATE] = (int64_t)view.state;
    choices[SLOT_CHOICE_E2E_STATUS] = (int64_t)view.status;
    flags[SLOT_FLAG_USABLE] = view.is_usable;
    flags[SLOT_FLAG_RECEIVED] = view.line != NULL;
    flags[SLOT_FLAG_STALE] = view.is_stale;
    flags[SLOT_FLAG_TWO_SENDERS] = view.two_senders;
#if MAPLINES_SCENE_RECORDS
    choices[SLOT_CHOICE_LEFT_OUT] = (int64_t)view.left_out;
#else
    show_checks(decoder, slot, now_ns,
                &values->counts[COUNT_SLOTS + SLOT_COUNTS * slot + SLOT_COUNT_OK]);
#endif
}

/// Show the scene, and the lane between two of its lines.
static void show_scene(maplines_instance_t *instance, int64_t now_ns)
{
    maplines_values_t *values = &instance->state.values;
    const maplines_owner_t sides[2] = {(maplines_owner_t)values->choices[CHOICE_LANE_LEFT],
                                       (maplines_owner_t)values->choices[CHOICE_LANE_RIGHT]};
    maplines_scene_view_t view;
    maplines_latest_scene(&instance->state.node.decoder, now_ns, &view);
    values->flags[FLAG_SCENE_USABLE] = view.is_usable;
    values->choices[CHOICE_SCENE_E2E_STATE] = (int64_t)view.state;
    values->counts[COUNT_SCENE_LINES] = view.scene == NULL ? 0 : view.scene->count;
    values->reals[REAL_SCENE_AGE] = view.age;
    for (int k = 0; k < MAPLINES_POSITIONS; k++)
    {
        const double x = values->reals[REAL_X + k];
        maplines_estimate_t width;
        maplines_estimate_t centre;
        if (view.scene == NULL || !maplines_width(view.scene, sides[0], sides[1], x, &width) ||
            !maplines_centre(view.scene, sides[0], sides[1], x, &centre))
        {
            width = centre = (maplines_estimate_t){0, unknown};
        }
        values->reals[REAL_WIDTH + k] = width.value;
        values->reals[REAL_WIDTH_SIGMA + k] = width.sigma;
        values->reals[REAL_CENTRE + k] = centre.value;
        values->reals[REAL_CENTRE_SIGMA + k] = centre.sigma;
    }
}

/// Show the counters of all slots.
static void show_statistics(maplines_instance_t *instance)
{
    uint64_t *counts = instance->state.values.counts;
    maplines_statistics_t statistics;
    maplines_statistics(&instance->state.node.decoder, &statistics);
    counts[COUNT_FRAMES] = statistics.frames;
    counts[COUNT_LINES] = statistics.lines;
    counts[COUNT_POSE_ERRORS] = statistics.pose_errors;
    counts[COUNT_LOST] = statistics.lost;
    counts[COUNT_PENDING] = statistics.pending;
    for (int reason = 1; reason < MAPLINES_REASONS; reason++)
    {
        counts[COUNT_DROPPED + reason - 1] = statistics.counts[reason];
    }
}

void maplines_refresh(maplines_instance_t *instance)
{
    const int64_t now_ns = nanoseconds(instance->state.now);
    maplines_expire(&instance->state.node.decoder, now_ns);
#if MAPLINES_SCENE_RECORDS
    for (int slot = 0; slot < MAPLINES_SLOTS; slot++)
    {
        show_slot(instance, slot, now_ns);
    }
    show_checks(&instance->state.node.decoder, (int)MAPLINES_SCENE, now_ns,
                &instance->state.values.counts[COUNT_SCENE]);
    show_checks(&instance->state.node.decoder, (int)MAPLINES_SCENE2, now_ns,
                &instance->state.values.counts[COUNT_SCENE2]);
#else
    for (int slot = 0; slot < MAPLINES_SLOTS; slot++)
    {
        if (MAPLINES_DBC.messages[slot].is_present)
        {
            show_slot(instance, slot, now_ns);
        }
    }
#endif
    if (MAPLINES_DBC.has_pose)
    {
        show_scene(instance, now_ns);
    }
    show_statistics(instance);
}
