/* Encoder of scenes: the pose error, and the lines in the form that each of them needs.
 *
 * What a receiver decodes covers the scene plus the errors of the decoded means. Lines for which
 * levels cost too much send all entries; but not all lines of a scene do if there is one that
 * levels cover, so that a scene with its pose error takes no more frames than complete records. The
 * operations are those of maplines_can/model/scene_sender.py in the same order.
 */
#include "internal.h"

#if MAPLINES_SENDER && MAPLINES_SCENES

/// Factor on the covariance of the pose error that is covered: a line that is rounded depends on
/// the pose a little differently.
static const double pose_slack = 1.002;
/// More than the changes of form of all lines, each of which is left out after at most four.
#define MAX_PASSES (8 * MAPLINES_SLOTS)

/// Raw value of the least level from sigma on, or the greatest; 0 for 0.
static int64_t level_above(const maplines_signal_t *signal, double sigma)
{
    if (!(sigma > 0.0))
    {
        return 0;
    }
    const double exact = (maplines_log2(sigma) - signal->scale->offset) / signal->scale->factor;
    const double raw = ceil(exact - 1e-9);
    const double most = (double)maplines_raw_max(signal);
    const double least = raw > 1.0 ? raw : 1.0;
    return (int64_t)(least < most ? least : most);
}

/// Least raw value whose correlation time is not less than this one [s]; 0, unknown, if there is
/// none: a consumer would average away errors whose times are too short.
static int64_t raw_time(const maplines_signal_t *signal, double time)
{
    int64_t low = 0;
    int64_t high = maplines_raw_max(signal) + 1;
    while (high - low > 1)
    {
        const int64_t middle = (low + high) / 2;
        if (maplines_exp2(maplines_physical(signal, middle)) >= time)
        {
            high = middle;
        }
        else
        {
            low = middle;
        }
    }
    return high <= maplines_raw_max(signal) ? high : 0;
}

/// Encode the pose error, and decode it as a receiver does; false if it does not fit.
static bool encode_pose(const maplines_dbc_t *dbc, const maplines_scene_input_t *scene,
                        maplines_scene_workspace_t *space)
{
    const maplines_cholesky_t *code = &dbc->pose_covariance;
    double target[9];
    double least[4];
    double F[4][4];
    double cov[16];
    bool is_saturated;
    for (int i = 0; i < 9; ++i)
    {
        target[i] = pose_slack * scene->pose_cov[i / 3][i % 3];
    }
    maplines_least_variances(code, least);
    if (!maplines_encode_covariance(code, NULL, target, least, space->raw_pose, &is_saturated))
    {
        return false;
    }
    space->raw_offset = level_above(&dbc->map_offset, scene->offset_sigma);
    space->raw_heading = level_above(&dbc->map_heading, scene->heading_sigma);
    space->raw_time = raw_time(&dbc->correlation_time, scene->correlation_time);
    uint8_t record[MAPLINES_MAX_RECORD] = {0};
    maplines_put_covariance(code, record, space->raw_pose);
    maplines_decode_factor(code, record, F);
    maplines_gram(4, 4, F[0], cov);
    for (int i = 0; i < 9; ++i)
    {
        space->decoded_pose[i] = cov[4 * (i / 3) + i % 3];
    }
    space->offset_sigma = maplines_level(&dbc->map_offset, space->raw_offset);
    space->heading_sigma = maplines_level(&dbc->map_heading, space->raw_heading);
    return true;
}

/// Round the mean of a line, coarsely for the form with levels and finely for that with all
/// entries, if there is one.
static bool round_means(const maplines_dbc_t *dbc, maplines_scene_member_t *member)
{
    double L[16];
    maplines_rounding_factor(member->specific, member->stated_J, L);
    bool is_good = maplines_round_mean(dbc->mean, NULL, member->mean, L, member->raw_mean);
#if MAPLINES_LINE_RECORDS
    if (is_good && maplines_has_entries(dbc))
    {
        int64_t raw[4];
        is_good = maplines_round_mean(dbc->mean, dbc->fine, member->mean, L, raw);
        for (int i = 0; is_good && i < 4; ++i)
        {
            member->raw_refined[i] = maplines_split(&dbc->fine[i], raw[i], &member->raw_fine[i]);
        }
    }
#endif
    return is_good;
}

static int64_t nearest_limited(const maplines_signal_t *signal, double physical)
{
    return maplines_limited(signal, maplines_nearest_raw(signal, physical));
}

/// Distance of a line from the car, next to it or at the nearer end of the fit range [m].
static double distance_of(const maplines_scene_line_t *line)
{
    const double *mean = line->mean;
    const double after = line->fit_range[0] > 0.0 ? line->fit_range[0] : 0.0;
    const double x = line->fit_range[1] < after ? line->fit_range[1] : after;
    const double half_curvature = mean[2] / 2.0 + x * mean[3] / 6.0;
    return fabs(mean[0] + x * (maplines_tan(mean[1]) + x * half_curvature));
}

#if MAPLINES_LINE_RECORDS
/// Find mean and range of a line as its record with a covariance of its own has them;
/// MAPLINES_IN_SCENE, or why it does not belong to the scene.
static maplines_left_out_t state_complete(const maplines_dbc_t *dbc,
                                          const maplines_scene_line_t *line,
                                          maplines_scene_member_t *member)
{
    const maplines_levels_t *levels = maplines_levels_of(dbc);
    const double x_range[2] = {line->x_min, line->x_max};
    maplines_stated_t stated;
    maplines_state_line(dbc, line->mean, x_range, false, &stated);
    memcpy(member->raw_mean, stated.mean, sizeof member->raw_mean);
    memcpy(member->raw_range, stated.ends, sizeof member->raw_range);
    const double low = maplines_physical(&dbc->x_min, stated.ends[0]);
    const double high = maplines_physical(&dbc->x_max, stated.ends[1]);
    member->raw_fit[0] = nearest_limited(&levels->fit_behind, low - member->range[0]);
    member->raw_fit[1] = nearest_limited(&levels->fit_ahead, member->range[1] - high);
    return stated.is_clipped || stated.is_cut || !(low < high) ? MAPLINES_LEFT_OUT_RANGE
                                                               : MAPLINES_IN_SCENE;
}
#endif

/// Find what is sent of a line in either form; MAPLINES_IN_SCENE, or why nothing is. False if the
/// line overflows by the pose error.
static bool prepare(const maplines_dbc_t *dbc, const maplines_scene_input_t *scene, int place,
                    maplines_scene_member_t *member)
{
    const maplines_scene_line_t *line = &scene->lines[place];
    member->slot = (int)line->slot;
    member->kind = line->kind;
    member->distance = distance_of(line);
    member->left_out = maplines_state_member(dbc, scene, place, member);
#if MAPLINES_LINE_RECORDS
    if (!dbc->is_conditional && member->left_out == MAPLINES_IN_SCENE)
    {
        member->left_out = state_complete(dbc, line, member);
    }
#endif
    if (member->left_out != MAPLINES_IN_SCENE)
    {
        return true;
    }
    if (!maplines_find_parts(scene, place, member))
    {
        return false;
    }
    member->raw_quartic = nearest_limited(&maplines_levels_of(dbc)->quartic, member->quartic);
    if (dbc->is_conditional)
    {
        member->raw_range[0] = (int64_t)maplines_nearest_raw(&dbc->x_min, member->range[0]);
        member->raw_range[1] = (int64_t)maplines_nearest_raw(&dbc->x_max, member->range[1]);
        if (!round_means(dbc, member))
        {
            member->left_out = MAPLINES_LEFT_OUT_MEAN;
        }
    }
    return true;
}

/// Decode a line as a receiver does; whether it is a function of x.
static bool decode_line(const maplines_dbc_t *dbc, const maplines_scene_line_t *given,
                        const maplines_scene_member_t *member, maplines_sent_line_t *line)
{
    const maplines_levels_t *levels = maplines_levels_of(dbc);
    for (int i = 0; i < 4; ++i)
    {
        const int64_t raw = member->is_full ? member->raw_refined[i] : member->raw_mean[i];
        line->mean[i] = maplines_physical(&dbc->mean[i], raw);
#if MAPLINES_LINE_RECORDS
        if (member->is_full)
        {
            line->mean[i] = line->mean[i] + maplines_physical(&dbc->fine[i], member->raw_fine[i]);
        }
#endif
        line->error[i] = given->mean[i] - line->mean[i];
    }
    line->fit_range[0] = maplines_physical(&dbc->x_min, member->raw_range[0]);
    line->fit_range[1] = maplines_physical(&dbc->x_max, member->raw_range[1]);
    if (!dbc->is_conditional)
    {
        const double behind = maplines_physical(&levels->fit_behind, member->raw_fit[0]);
        const double ahead = maplines_physical(&levels->fit_ahead, member->raw_fit[1]);
        line->fit_range[0] = line->fit_range[0] - behind;
        line->fit_range[1] = line->fit_range[1] + ahead;
    }
    line->quartic = maplines_physical(&levels->quartic, member->raw_quartic);
    const maplines_curve_t curve = maplines_curve_of(line->mean, line->fit_range, line->quartic);
    return maplines_can_be_seen(&curve);
}

/// Decode all lines that are left; whether all of them are functions of x.
static bool decode_lines(const maplines_dbc_t *dbc, const maplines_scene_input_t *scene,
                         maplines_scene_workspace_t *space)
{
    bool are_functions = true;
    for (int i = 0; i < space->count; ++i)
    {
        const int place = space->places[i];
        maplines_sent_line_t *line = &space->lines[i];
        line->is_covered = decode_line(dbc, &scene->lines[place], &space->members[place], line);
        are_functions = are_functions && line->is_covered;
    }
    return are_functions;
}

/// Compute what the lines have in common; false if the pose error makes one of them overflow.
static bool find_spread(maplines_scene_workspace_t *space)
{
    double A[4 * MAPLINES_SLOTS][MAPLINES_COLUMNS];
    maplines_pose_root_t root;
    maplines_pose_root(space->decoded_pose, &root);
    for (int i = 0; i < space->count; ++i)
    {
        maplines_sent_line_t *line = &space->lines[i];
        const maplines_curve_t curve =
            maplines_curve_of(line->mean, line->fit_range, line->quartic);
        maplines_changes_t changes;
        maplines_changes_of(&curve, &changes);
        maplines_common(&changes, space->offset_sigma, space->heading_sigma, line->common);
        memcpy(line->J, changes.J, sizeof line->J);
        if (!maplines_spread(&changes, &root, &A[4 * i]))
        {
            return false;
        }
    }
    const int n = 4 * space->count;
    maplines_gram(n, MAPLINES_COLUMNS, A[0], space->rest);
    return true;
}

/// Let the line for which levels cost the least have them, if none has and they cover it.
static void spare_one(maplines_scene_workspace_t *space)
{
    maplines_scene_member_t *cheapest = &space->members[space->places[0]];
    bool are_full = cheapest->is_full;
    for (int i = 1; i < space->count; ++i)
    {
        maplines_scene_member_t *member = &space->members[space->places[i]];
        are_full = are_full && member->is_full;
        if (cheapest->cost == cheapest->cost && !(member->cost >= cheapest->cost))
        {
            cheapest = member; // the first one; a NaN counts as the least
        }
    }
    if (are_full && cheapest->cost > 0.0 && cheapest->cost < (double)INFINITY)
    {
        cheapest->is_full = false;
        cheapest->is_spared = true;
    }
}

/// Send all entries of the lines for which levels cost too much; whether there are any.
static bool need_entries(maplines_scene_workspace_t *space)
{
    bool is_any = false;
    for (int i = 0; i < space->count; ++i)
    {
        is_any = is_any || space->lines[i].cost > 1.0;
    }
    for (int i = 0; is_any && i < space->count; ++i)
    {
        maplines_scene_member_t *member = &space->members[space->places[i]];
        const double cost = space->lines[i].cost;
        member->cost = cost != cost || cost > member->cost ? cost : member->cost;
        member->is_full = member->is_full || cost > 1.0;
    }
    return is_any;
}

/// Send levels of lines that no entries cover; whether there are any.
///
/// Entries have ranges; what levels stand for has none in a range of a few metres.
static bool need_levels(maplines_scene_workspace_t *space)
{
    bool is_any = false;
    for (int i = 0; i < space->count; ++i)
    {
        maplines_scene_member_t *member = &space->members[space->places[i]];
        if (!space->lines[i].is_covered && member->is_full && !member->is_spared &&
            fabs(member->cost) < (double)INFINITY)
        {
            member->is_spared = true;
            member->is_full = false;
            is_any = true;
        }
    }
    return is_any;
}

/// Leave out the lines that are not covered.
static void leave_out(maplines_scene_workspace_t *space, maplines_left_out_t reason)
{
    int count = 0;
    for (int i = 0; i < space->count; ++i)
    {
        const int place = space->places[i];
        if (space->lines[i].is_covered)
        {
            space->places[count] = place;
            space->lines[count] = space->lines[i]; // with its spacings
            ++count;
        }
        else
        {
            space->members[place].left_out = reason;
        }
    }
    space->count = count;
}

/// Encode the lines in the form that each of them needs; false if one of them cannot be seen.
static bool encode_lines(const maplines_dbc_t *dbc, const maplines_scene_input_t *scene,
                         maplines_scene_workspace_t *space)
{
    for (int pass = 0; pass < MAX_PASSES && space->count > 0; ++pass)
    {
        spare_one(space);
        if (!decode_lines(dbc, scene, space))
        {
            leave_out(space, MAPLINES_LEFT_OUT_ACROSS);
            continue;
        }
        if (!find_spread(space))
        {
            return false;
        }
        maplines_joint_target(scene, space);
        maplines_cover(dbc, space);
        if (need_entries(space))
        {
            continue;
        }
        bool are_covered = true;
        for (int i = 0; i < space->count; ++i)
        {
            are_covered = are_covered && space->lines[i].is_covered;
        }
        if (are_covered)
        {
            return true;
        }
        if (!need_levels(space))
        {
            leave_out(space, MAPLINES_LEFT_OUT_COVARIANCE);
        }
    }
    return space->count == 0; // as always: each pass changes a form, or leaves a line out
}

MAPLINES_INTERNAL maplines_refusal_t maplines_encode_members(const maplines_dbc_t *dbc,
                                                             const maplines_scene_input_t *scene,
                                                             bool is_full,
                                                             maplines_scene_workspace_t *space)
{
    memset(space, 0, sizeof *space);
    for (int place = 0; place < (int)scene->count; ++place)
    {
        maplines_scene_member_t *member = &space->members[place];
        if (!prepare(dbc, scene, place, member))
        {
            return MAPLINES_UNSEEN;
        }
        member->is_full = is_full;
        if (member->left_out == MAPLINES_IN_SCENE)
        {
            space->places[space->count] = place;
            ++space->count;
        }
    }
    if (!encode_pose(dbc, scene, space))
    {
        return MAPLINES_BAD_POSE;
    }
    return encode_lines(dbc, scene, space) ? MAPLINES_SENT : MAPLINES_UNSEEN;
}

#endif
