/* Lines of a scene as a message can state them, and the parts of their covariances.
 *
 * The operations are those of maplines_can/model/scene_sender.py in the same order.
 */
#include "internal.h"

#if MAPLINES_SENDER && MAPLINES_SCENES

/// Largest standard deviation of a line that is encoded: no D_i covers more, and none overflows.
static const double largest_sigma = 1e50;
/// Least valid range of a line that is sent in part [m].
static const double least_range = 1.0;
/// Steps of its signal that a parameter keeps from the end of its range, for the rounding.
static const double kept_steps = 8.0;

MAPLINES_INTERNAL maplines_curve_t maplines_curve_of(const double mean[4],
                                                     const double fit_range[2], double quartic)
{
    maplines_curve_t curve;
    memcpy(curve.mean, mean, sizeof curve.mean);
    memcpy(curve.fit_range, fit_range, sizeof curve.fit_range);
    curve.quartic = quartic;
    return curve;
}

MAPLINES_INTERNAL bool maplines_can_be_seen(const maplines_curve_t *curve)
{
    maplines_points_t points;
    maplines_points_of(curve, &points);
    return curve->fit_range[0] < curve->fit_range[1] && maplines_is_function(&points);
}

MAPLINES_INTERNAL bool maplines_has_entries(const maplines_dbc_t *dbc)
{
#if MAPLINES_LINE_RECORDS
    return dbc->has_covariance.length > 0U;
#else
    (void)dbc;
    return false;
#endif
}

/// The least positive semidefinite matrix that covers a symmetric one, in coefficients of T_0 ..
/// T_3.
static void positive_part(const double matrix[16], const double J[16], double part[16])
{
    double inverse[16];
    double values[4];
    double vectors[16];
    double root[16];
    maplines_inverse(J, inverse);
    maplines_congruence(inverse, matrix, root);
    maplines_eigen(4, root, values, vectors);
    for (int i = 0; i < 16; ++i)
    {
        const double value = values[i % 4];
        vectors[i] = vectors[i] * sqrt(value > 0.0 ? value : 0.0);
    }
    maplines_product(4, 4, 4, J, vectors, root);
    maplines_gram(4, 4, root, part);
}

/// A line is a function of x and has covariances that do not overflow.
static bool is_possible(const maplines_scene_input_t *scene, int place)
{
    const maplines_scene_line_t *line = &scene->lines[place];
    const double largest = largest_sigma * largest_sigma;
    for (int i = 0; i < 4; ++i)
    {
        const int row = 4 * place + i;
        const bool is_specific_large = scene->has_specific && line->specific[i][i] > largest;
        if (scene->cov[row][row] > largest || fabs(line->mean[i]) > largest_sigma ||
            is_specific_large)
        {
            return false;
        }
    }
    const maplines_curve_t curve = maplines_curve_of(line->mean, line->fit_range, line->quartic);
    return maplines_can_be_seen(&curve);
}

/// A line is within the ranges of the signals of its mean.
static bool is_within(const maplines_signal_t signals[4], const double mean[4])
{
    bool is_inside = true;
    for (int i = 0; i < 4; ++i)
    {
        const double step = kept_steps * signals[i].scale->factor;
        const double low = maplines_physical(&signals[i], maplines_raw_min(&signals[i])) + step;
        const double high = maplines_physical(&signals[i], maplines_raw_max(&signals[i])) - step;
        is_inside = is_inside && low <= mean[i] && mean[i] <= high;
    }
    return is_inside;
}

/// Find the part of a line that a message can state; MAPLINES_IN_SCENE, or why there is none.
static maplines_left_out_t state_part(const maplines_dbc_t *dbc, const maplines_scene_line_t *line,
                                      maplines_scene_member_t *member)
{
    double least = 0.0; // of the length of the range [m]
    if (!is_within(dbc->mean, line->mean))
    {
        const double behind = line->x_min - line->fit_range[0];
        const double ahead = line->fit_range[1] - line->x_max;
        const double room = (behind > 0.0 ? behind : 0.0) + (ahead > 0.0 ? ahead : 0.0);
        double reach[4];
        least = least_range + room;
        for (int i = 0; i < 4; ++i)
        {
            const bool has_bound = maplines_has_entries(dbc); // levels alone have none of their own
            reach[i] = has_bound ? sqrt(dbc->covariance.reachable[i]) : (double)INFINITY;
        }
        if (!maplines_nearest_line(dbc->mean, line->mean, line->fit_range, least, reach,
                                   member->mean, member->range))
        {
            return MAPLINES_LEFT_OUT_MEAN;
        }
    }
    const double first_min = maplines_physical(&dbc->x_min, maplines_raw_min(&dbc->x_min));
    const double first_max = maplines_physical(&dbc->x_min, maplines_raw_max(&dbc->x_min));
    const double last_min = maplines_physical(&dbc->x_max, maplines_raw_min(&dbc->x_max));
    const double last_max = maplines_physical(&dbc->x_max, maplines_raw_max(&dbc->x_max));
    const double begin = ceil(member->range[0]);
    const double end = floor(member->range[1]);
    member->range[0] = begin > first_min ? begin : first_min;
    member->range[1] = end < last_max ? end : last_max;
    const double length = member->range[1] - member->range[0];
    if (member->range[0] > first_max || member->range[1] < last_min || !(length > 0.0) ||
        length < least) // rounding inwards may leave too little
    {
        return MAPLINES_LEFT_OUT_RANGE;
    }
    const double shorter = length / (line->fit_range[1] - line->fit_range[0]);
    const double square = shorter * shorter;
    member->quartic = line->quartic * (square * square);
    return MAPLINES_IN_SCENE;
}

MAPLINES_INTERNAL maplines_left_out_t maplines_state_member(const maplines_dbc_t *dbc,
                                                            const maplines_scene_input_t *scene,
                                                            int place,
                                                            maplines_scene_member_t *member)
{
    const maplines_scene_line_t *line = &scene->lines[place];
    memcpy(member->mean, line->mean, sizeof member->mean);
    memcpy(member->range, line->fit_range, sizeof member->range);
    member->quartic = line->quartic;
    if (!is_possible(scene, place))
    {
        return MAPLINES_LEFT_OUT_ACROSS;
    }
    return dbc->is_conditional ? state_part(dbc, line, member) : MAPLINES_IN_SCENE;
}

MAPLINES_INTERNAL bool maplines_find_parts(const maplines_scene_input_t *scene, int place,
                                           maplines_scene_member_t *member)
{
    const maplines_scene_line_t *line = &scene->lines[place];
    const maplines_curve_t curve = maplines_curve_of(line->mean, member->range, member->quartic);
    double P[9];
    maplines_pose_root_t root;
    maplines_changes_t changes;
    double A[4][MAPLINES_COLUMNS];
    double error[4];
    memcpy(P, scene->pose_cov, sizeof P);
    maplines_pose_root(P, &root);
    maplines_changes_of(&curve, &changes);
    if (!maplines_spread(&changes, &root, A))
    {
        return false;
    }
    maplines_gram(4, MAPLINES_COLUMNS, A[0], member->due_to_pose);
    maplines_bases(member->mean, member->range, member->stated_J);
    if (scene->has_specific)
    {
        memcpy(member->specific, line->specific, sizeof member->specific);
    }
    else
    {
        double rest[16];
        for (int i = 0; i < 16; ++i)
        {
            const double whole = scene->cov[4 * place + i / 4][4 * place + i % 4];
            rest[i] = whole - member->due_to_pose[i];
        }
        positive_part(rest, member->stated_J, member->specific);
    }
    for (int i = 0; i < 4; ++i)
    {
        error[i] = line->mean[i] - member->mean[i];
    }
    error[1] = maplines_slope_error(line->mean[1], member->mean[1]);
    for (int i = 0; i < 16; ++i)
    {
        member->excess[i] = error[i / 4] * error[i % 4];
        member->specific[i] = member->specific[i] + member->excess[i];
    }
    return true;
}

MAPLINES_INTERNAL void maplines_joint_target(const maplines_scene_input_t *scene,
                                             maplines_scene_workspace_t *space)
{
    const int n = 4 * space->count;
    for (int i = 0; i < n; ++i)
    {
        const int of_i = space->places[i / 4];
        for (int j = 0; j < n; ++j)
        {
            const int of_j = space->places[j / 4];
            const double square =
                space->lines[i / 4].error[i % 4] * space->lines[j / 4].error[j % 4];
            const double common = space->rest[n * i + j];
            double entry = scene->cov[4 * of_i + i % 4][4 * of_j + j % 4] + square;
            if (of_i == of_j)
            {
                space->spread[i / 4][4 * (i % 4) + j % 4] = common;
                entry = entry + space->members[of_i].excess[4 * (i % 4) + j % 4];
            }
            space->rest[n * i + j] = entry - common;
        }
    }
}

#endif
