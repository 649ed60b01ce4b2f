/* Scenes: lines of one pose, with a factor of their joint covariance.
 *
 * It has the operations of maplines_can/model/scenes.py in the same order. Each line
 * needs the pose error and its own record only: its rows of the factor follow from how it changes
 * with the pose (seen_lines.c), and its own block is line-specific.
 */
#include "internal.h"

#if MAPLINES_SCENES

#define MAPLINES_ROUNDING 0x1p-42 ///< share by which variances are enlarged, so that it is definite
#define MAPLINES_RANGE_STEPS 10.0 ///< steps of the ends of the valid range [1/m]
#define MAPLINES_MIN_TURN 0.1     ///< least derivative of beta with respect to the heading

MAPLINES_INTERNAL const maplines_levels_t *maplines_levels_of(const maplines_dbc_t *dbc)
{
#if MAPLINES_LINE_RECORDS
    if (!dbc->is_conditional)
    {
        int slot = 0;
        while (slot < MAPLINES_SLOTS - 1 && dbc->slot_levels[slot].lateral.length == 0)
        {
            ++slot; // those of all slots are the same
        }
        return &dbc->slot_levels[slot];
    }
#endif
    return &dbc->levels;
}

MAPLINES_INTERNAL void maplines_specific_factor(const double J[16], const double levels[16],
                                                const double common[16], double factor[4][4])
{
    double own[16];
    for (int i = 0; i < 16; ++i)
    {
        own[i] = levels[i] + common[i];
        own[i] = i % 5 == 0 ? own[i] * (1.0 + MAPLINES_ROUNDING) : own[i];
    }
    (void)maplines_cholesky_factor(4, own, own); // definite for any bits
    maplines_product(4, 4, 4, J, own, factor[0]);
}

#if MAPLINES_RECEIVER
/// Pose error, in double precision.
typedef struct {
    double F[9]; ///< root of its covariance P
    double P[9];
    maplines_pose_root_t root;
    double offset_sigma;
    double heading_sigma;
    double largest_heading_sigma; ///< for which the level of the heading may stand
    double age;                   ///< [s]
    bool is_heading_limited;      ///< the level of the heading is the greatest one
} pose_error_t;

/// What the records say of a line.
typedef struct {
    maplines_curve_t curve;
    int64_t levels[4]; ///< of the line-specific covariance: lateral, points, shape, tilt
#if MAPLINES_LINE_RECORDS
    bool is_full; ///< the record has all entries of it instead
#endif
} member_t;

/// A line of a scene, in double precision.
typedef struct {
    member_t member;
    double A[4][MAPLINES_COLUMNS]; ///< factor due to the pose error
    double F[4][4];                ///< line-specific factor
} decoded_t;

/// Raw value of a signal; 0 if the DBC has none.
static int64_t raw_of(const maplines_signal_t *signal, const uint8_t *record)
{
    return signal->length > 0 ? maplines_get(signal, record) : 0;
}

/// Value of a level, 0 for the raw value 0.
static double level_of(const maplines_signal_t *signal, const uint8_t *record)
{
    return maplines_level(signal, maplines_get(signal, record));
}

/// Read the pose error, all of whose bits mean something.
static MAPLINES_APART void read_pose(const maplines_dbc_t *dbc, const uint8_t *record,
                                     pose_error_t *pose)
{
    double factor[4][4];
    maplines_decode_factor(&dbc->pose_covariance, record, factor);
    for (int i = 0; i < 9; ++i)
    {
        pose->F[i] = factor[i / 3][i % 3];
    }
    maplines_gram(3, 3, pose->F, pose->P);
    maplines_pose_root(pose->P, &pose->root);

    const int64_t raw_age = maplines_get(&dbc->pose_age, record);
    const bool is_too_old = raw_age >= maplines_raw_max(&dbc->pose_age);
    const double age = maplines_physical(&dbc->pose_age, raw_age) / 1000.0;
    pose->age = is_too_old ? (double)INFINITY : age;
    pose->offset_sigma = level_of(&dbc->map_offset, record);
    pose->heading_sigma = level_of(&dbc->map_heading, record);
    pose->largest_heading_sigma =
        pose->heading_sigma * maplines_exp2(dbc->map_heading.scale->factor);
    pose->is_heading_limited =
        maplines_get(&dbc->map_heading, record) == maplines_raw_max(&dbc->map_heading);
}

static void read_levels(const maplines_levels_t *levels, const uint8_t *record, int64_t raw[4])
{
    raw[0] = maplines_get(&levels->lateral, record);
    raw[1] = maplines_get(&levels->points, record);
    raw[2] = maplines_get(&levels->shape, record);
    raw[3] = raw_of(&levels->tilt, record);
}

/// Read a record that is conditional on the pose error.
static void read_conditional(const maplines_dbc_t *dbc, const uint8_t *record, member_t *member)
{
    const maplines_levels_t *levels = &dbc->levels;
    maplines_curve_t *curve = &member->curve;
    for (int i = 0; i < 4; ++i)
    {
        curve->mean[i] = maplines_value(&dbc->mean[i], record);
    }
#if MAPLINES_LINE_RECORDS
    member->is_full = raw_of(&dbc->has_covariance, record) == 1;
    for (int i = 0; i < 4 && member->is_full; ++i)
    {
        const int64_t fine = maplines_get(&dbc->fine[i], record);
        curve->mean[i] = curve->mean[i] + maplines_physical(&dbc->fine[i], fine);
    }
#endif
    curve->fit_range[0] = maplines_value(&dbc->x_min, record);
    curve->fit_range[1] = maplines_value(&dbc->x_max, record);
#if MAPLINES_HAS_QUARTIC
    curve->quartic = maplines_physical(&levels->quartic, raw_of(&levels->quartic, record));
#else
    curve->quartic = 0.0;
#endif
    read_levels(levels, record, member->levels);
}

#if MAPLINES_LINE_RECORDS
/// Physical value of a signal, as a scene has it that is rebuilt from a decoded line.
static double rebuilt(const maplines_signal_t *signal, double physical)
{
    const double raw = maplines_nearest_raw(signal, physical) * signal->scale->factor;
    return raw + signal->scale->offset;
}

/// Read a complete record, whose levels are in the record of the pose error.
static void read_with_levels(const maplines_dbc_t *dbc, const uint8_t *record, int slot,
                             const uint8_t *pose_record, member_t *member)
{
    const maplines_levels_t *own = &dbc->slot_levels[slot];
    const maplines_levels_t *levels = maplines_levels_of(dbc);
    maplines_curve_t *curve = &member->curve;
    member->is_full = false;
    for (int i = 0; i < 4; ++i)
    {
        const maplines_signal_t *signal = &dbc->mean[i];
        curve->mean[i] = rebuilt(signal, maplines_value(signal, record));
    }
    const double x_min = maplines_value(&dbc->x_min, record);
    const double x_max = maplines_value(&dbc->x_max, record);
    const int64_t raw_behind = maplines_get(&own->fit_behind, pose_record);
    const int64_t raw_ahead = maplines_get(&own->fit_ahead, pose_record);
    const double behind = maplines_physical(&levels->fit_behind, raw_behind);
    const double ahead = maplines_physical(&levels->fit_ahead, raw_ahead);
    curve->fit_range[0] = rebuilt(&dbc->x_min, x_min) - behind;
    curve->fit_range[1] = rebuilt(&dbc->x_max, x_max) + ahead;
    curve->quartic = maplines_physical(&levels->quartic, maplines_get(&own->quartic, pose_record));
    read_levels(own, pose_record, member->levels);
}
#endif

/// Age of a line [s], whose first frame came some time after that of its pose error.
static MAPLINES_APART double later(double age, int64_t passed_ns)
{
    if (!(age < (double)INFINITY))
    {
        return age;
    }
    const double age_ns = rint(1e9 * age) + (double)passed_ns;
    return (age_ns > 0.0 ? age_ns : 0.0) / 1e9;
}

/// Set the valid range of a line that is conditional on the pose error.
static MAPLINES_APART void set_valid_range(const pose_error_t *pose, const maplines_curve_t *curve,
                                           const maplines_changes_t *changes,
                                           const double specific_cov[16], maplines_line_t *line)
{
    double heading_sigma = pose->largest_heading_sigma;
    if (pose->is_heading_limited)
    {
        // It may be beyond the levels, but no more than the variance of beta has room for.
        double W[7][4];
        maplines_line_changes(changes, W);
        const double size = fabs(W[2][1]);
        const double turn = size > MAPLINES_MIN_TURN ? size : MAPLINES_MIN_TURN;
        const double possible = sqrt(specific_cov[5]) / turn;
        heading_sigma = possible > heading_sigma ? possible : heading_sigma;
    }
    double range[2];
    maplines_valid_range(curve, pose->P, specific_cov, heading_sigma, range);
    // The ends are moved inwards, so that the range does not exceed that of the sender.
    const double low = ceil(range[0] * MAPLINES_RANGE_STEPS) / MAPLINES_RANGE_STEPS + 0.0;
    const double high = floor(range[1] * MAPLINES_RANGE_STEPS) / MAPLINES_RANGE_STEPS;
    const double middle = maplines_middle(range);
    const double end = high > middle ? high : middle;
    line->x_min = (maplines_real_t)(low < middle ? low : middle);
    line->x_max = (maplines_real_t)(low <= high ? end : middle);
}

/// Set the Gaussian of a line: that of its block of the joint covariance.
static MAPLINES_APART void set_gaussian(const maplines_dbc_t *dbc, const decoded_t *decoded,
                                        const double specific_cov[16],
                                        maplines_gaussian_t *gaussian)
{
    double cov[16];
    double ordered[16];
    double factor[4][4];
    const uint8_t *order = dbc->covariance.order;
    maplines_gram(4, MAPLINES_COLUMNS, decoded->A[0], cov);
    for (int i = 0; i < 16; ++i)
    {
        cov[i] = cov[i] + specific_cov[i];
        cov[i] = i % 5 == 0 ? cov[i] * (1.0 + MAPLINES_ROUNDING) : cov[i];
    }
    for (int i = 0; i < 16; ++i)
    {
        ordered[i] = cov[4 * order[i / 4] + order[i % 4]];
    }
    (void)maplines_cholesky_factor(4, ordered, ordered); // definite for any bits
    for (int i = 0; i < 4; ++i)
    {
        memcpy(factor[order[i]], ordered + 4 * i, sizeof factor[0]);
    }
    maplines_set_gaussian(decoded->member.curve.mean, factor, order, gaussian);
}

/// Factor of the line-specific covariance.
static MAPLINES_APART void find_specific(const maplines_dbc_t *dbc, const pose_error_t *pose,
                                         const uint8_t *record, const member_t *member,
                                         const maplines_changes_t *changes, double F[4][4])
{
#if MAPLINES_LINE_RECORDS
    if (member->is_full)
    {
        maplines_decode_factor(&dbc->covariance, record, F);
        return;
    }
#else
    (void)record;
#endif
    double levels[16];
    double common[16];
    maplines_common(changes, pose->offset_sigma, pose->heading_sigma, common);
    maplines_decode_levels(maplines_levels_of(dbc), &member->curve, member->levels, levels);
    maplines_specific_factor(changes->J, levels, common, F);
}

/// Whether a curve has a range, in which it is a function of x.
static bool is_function(const maplines_curve_t *curve)
{
    maplines_points_t points;
    maplines_points_of(curve, &points);
    return curve->fit_range[0] < curve->fit_range[1] && maplines_is_function(&points);
}

/// Read the records of a line of an epoch; a complete one has most of the line itself.
static void read_member(const maplines_dbc_t *dbc, const maplines_epoch_view_t *epoch,
                        const maplines_epoch_line_t *given, member_t *member, maplines_line_t *line)
{
#if MAPLINES_LINE_RECORDS
    if (!dbc->is_conditional)
    {
        maplines_complete_t content; // a receiver has read it before, and found it good
        (void)maplines_read_complete(dbc, given->slot, given->record, given->t_ns, &content);
        *line = content.line;
        read_with_levels(dbc, given->record, given->slot, epoch->pose, member);
        return;
    }
#else
    (void)epoch;
#endif
    (void)line;
    read_conditional(dbc, given->record, member);
}

/// Decode a line of an epoch; false if it is no function of x in its range.
static bool decode_member(const maplines_dbc_t *dbc, const pose_error_t *pose,
                          const maplines_epoch_view_t *epoch, const maplines_epoch_line_t *given,
                          decoded_t *decoded, maplines_line_t *line)
{
    const maplines_curve_t *curve = &decoded->member.curve;
    read_member(dbc, epoch, given, &decoded->member, line);
    if (!is_function(curve))
    {
        return false;
    }

    maplines_changes_t changes;
    maplines_changes_of(curve, &changes);
    if (!maplines_spread(&changes, &pose->root, decoded->A))
    {
        return false;
    }
    find_specific(dbc, pose, given->record, &decoded->member, &changes, decoded->F);
    double specific_cov[16];
    maplines_gram(4, 4, decoded->F[0], specific_cov);
#if MAPLINES_LINE_RECORDS
    if (!dbc->is_conditional)
    {
        set_gaussian(dbc, decoded, specific_cov, &line->gaussian);
        const bool is_partial =
            line->status == MAPLINES_UNKNOWN || line->status == MAPLINES_DIAGONAL;
        line->status = is_partial ? MAPLINES_FULL : line->status;
        return true;
    }
#endif
    memset(line, 0, sizeof *line);
    set_gaussian(dbc, decoded, specific_cov, &line->gaussian);
    line->slot = (maplines_owner_t)given->slot;
    line->kind = (maplines_kind_t)maplines_get(&dbc->kind, given->record);
    line->status = MAPLINES_FULL;
    line->components = 1;
    line->t_ns = given->t_ns;
    line->age = (maplines_real_t)later(pose->age, given->t_ns - epoch->t_ns);
    set_valid_range(pose, curve, &changes, specific_cov, line);
    return true;
}

MAPLINES_INTERNAL void maplines_begin_view(const uint8_t *pose, int64_t t_ns,
                                           maplines_epoch_view_t *view)
{
    memset(view, 0, sizeof *view);
    view->pose = pose;
    view->t_ns = t_ns;
}

MAPLINES_INTERNAL maplines_epoch_line_t *
maplines_add_to_view(int slot, const uint8_t *record, int64_t t_ns, maplines_epoch_view_t *view)
{
    maplines_epoch_line_t *line = &view->lines[view->count];
    line->slot = slot;
    line->record = record;
    line->t_ns = t_ns;
    ++view->count;
    return line;
}

/// Begin a scene without lines.
static void begin_scene(const maplines_dbc_t *dbc, const maplines_epoch_view_t *epoch,
                        const pose_error_t *pose, maplines_scene_t *scene)
{
    const double time = level_of(&dbc->correlation_time, epoch->pose);
    memset(scene, 0, sizeof *scene);
    scene->t_ns = epoch->t_ns;
    for (int i = 0; i < 9; ++i)
    {
        scene->pose_factor[i / 3][i % 3] = (maplines_real_t)pose->F[i];
    }
    scene->age = (maplines_real_t)pose->age;
    scene->correlation_time = (maplines_real_t)(time > 0.0 ? time : (double)INFINITY);
    scene->offset_sigma = (maplines_real_t)pose->offset_sigma;
    scene->heading_sigma = (maplines_real_t)pose->heading_sigma;
    scene->counter = (uint32_t)maplines_get(&dbc->pose.counter, epoch->pose);
#if MAPLINES_SCENE_RECORDS
    memcpy(scene->left_out, epoch->left_out, sizeof scene->left_out);
#endif
}

/// Add what there is of a line in a scene of up to `count` lines besides the line itself, which
/// stands behind the others.
static void add_to_scene(const maplines_dbc_t *dbc, int count, decoded_t *decoded,
                         maplines_scene_t *scene)
{
    const int place = scene->count;
    const maplines_curve_t *curve = &decoded->member.curve;
    maplines_set_factors(dbc->covariance.order, place, count, curve->mean, decoded->A, decoded->F,
                         scene);
    scene->fit_range[place][0] = (maplines_real_t)curve->fit_range[0];
    scene->fit_range[place][1] = (maplines_real_t)curve->fit_range[1];
    scene->quartic[place] = (maplines_real_t)curve->quartic;
    ++scene->count;
}

MAPLINES_INTERNAL uint32_t maplines_decode_epoch(const maplines_dbc_t *dbc,
                                                 const maplines_epoch_view_t *epoch,
                                                 maplines_scene_t *scene)
{
    pose_error_t pose;
    uint32_t found = 0;
    read_pose(dbc, epoch->pose, &pose);
    if (scene != NULL)
    {
        begin_scene(dbc, epoch, &pose, scene);
    }
    for (int i = 0; i < epoch->count; ++i)
    {
        const maplines_epoch_line_t *given = &epoch->lines[i];
        maplines_line_t *line = scene != NULL ? &scene->lines[scene->count] : given->line;
        decoded_t decoded;
        if (!decode_member(dbc, &pose, epoch, given, &decoded, line))
        {
            if (scene != NULL)
            {
                memset(line, 0, sizeof *line);
            }
            continue;
        }
        found |= (uint32_t)1 << (unsigned)given->slot;
        if (scene != NULL)
        {
            add_to_scene(dbc, epoch->count, &decoded, scene);
            if (given->line != NULL)
            {
                *given->line = *line;
            }
        }
    }
    return found;
}

#if MAPLINES_SCENE_RECORDS
MAPLINES_INTERNAL bool maplines_is_line(const maplines_dbc_t *dbc, const uint8_t *record)
{
    member_t member;
    read_conditional(dbc, record, &member);
    return is_function(&member.curve);
}
#endif

#endif

#endif
