/* Encoder of the line-specific covariances D_i of a scene, in either of their forms.
 *
 * Each D_i covers what is specific to its line. If together they do not cover the scene, those of
 * the lines concerned are enlarged until they do. The operations are those of
 * maplines_can/model/scene_sender.py in the same order.
 */
#include "internal.h"

#if MAPLINES_SENDER && MAPLINES_SCENES

/// Largest divergence that levels may cost a line; beyond it all entries are sent [nat].
static const double levels_divergence = 0.01;
/// Largest ratio of a line-specific variance, with levels to without.
static const double levels_ratio = 1.1 * 1.1;
#ifndef MAPLINES_ENLARGEMENTS    // a test has fewer, to see what follows
#define MAPLINES_ENLARGEMENTS 12 // of D_i at most
#endif
/// Share of what the first trial lacks by which D_i are enlarged; each next one takes twice as
/// much.
static const double first_share = 0.5;

static void sum_of_two(const double a[16], const double b[16], double sum[16])
{
    for (int i = 0; i < 16; ++i)
    {
        sum[i] = a[i] + b[i];
    }
}

/// The greater of two numbers, or NaN if one of them is.
static double greater(double a, double b)
{
    return a != a || a > b ? a : b;
}

/// Covariance of the resolution of the mean.
static void resolution_of(const double J[16], double cov[16])
{
    maplines_gram(4, 4, J, cov);
    for (int i = 0; i < 16; ++i)
    {
        cov[i] = MAPLINES_RESOLUTION * MAPLINES_RESOLUTION * cov[i];
    }
}

/// What a line has of its own, with the error of its mean; and the resolution.
static void known_part(const maplines_scene_member_t *member, const maplines_sent_line_t *line,
                       double known[16], double resolution[16])
{
    for (int i = 0; i < 16; ++i)
    {
        const double square = line->error[i / 4] * line->error[i % 4];
        known[i] = member->specific[i] + square;
    }
    resolution_of(line->J, resolution);
}

/// Choose levels that cover a line alone plus `more`; whether there are any. `line->cost` is more
/// than 1 if they cost too much. Levels with less `more` stay as they are if they still cover,
/// since what covers more is no better. Spacings are chosen once: what they are chosen for is the
/// same in each pass.
static bool encode_levels(const maplines_dbc_t *dbc, maplines_scene_workspace_t *space, int i,
                          bool is_first)
{
    maplines_scene_member_t *member = &space->members[space->places[i]];
    maplines_sent_line_t *line = &space->lines[i];
    double known[16];
    double resolution[16];
    double wanted[16];
    double sum[16];
    double inverse[16];
    double decoded[16];
    const maplines_curve_t curve = maplines_curve_of(line->mean, line->fit_range, line->quartic);
    maplines_level_target_t target;
    maplines_reference_t reference;
    known_part(member, line, known, resolution);
    sum_of_two(known, space->more[i], wanted);
    sum_of_two(known, resolution, sum);
    target.curve = &curve;
    target.J = line->J;
    target.common = line->common;
    target.target = wanted;
    target.true_cov = sum;
    if (!is_first && maplines_levels_cover(&target, line->levels))
    {
        return true;
    }
    const bool is_covered =
        maplines_search_levels(dbc, &target, &space->squares, line, member->raw_levels);
    sum_of_two(line->levels, line->common, decoded);
    maplines_inverse(line->J, inverse);
    sum_of_two(member->specific, resolution, sum);
    maplines_congruence(inverse, sum, wanted);
    maplines_compare_with(wanted, &reference);
    const double ratio = maplines_largest_ratio(&reference, decoded);
    sum_of_two(member->due_to_pose, known, sum);
    sum_of_two(sum, resolution, sum);
    maplines_congruence(inverse, sum, wanted);
    maplines_compare_with(wanted, &reference);
    maplines_congruence(inverse, member->due_to_pose, sum);
    sum_of_two(sum, decoded, decoded);
    const double divergence = maplines_divergence(&reference, decoded);
    const double cost = greater(divergence / levels_divergence, ratio / levels_ratio);
    line->cost = 0.0;
    if (maplines_has_entries(dbc))
    {
        const double counted = member->is_spared ? 0.0 : cost;
        line->cost = is_covered ? counted : (double)INFINITY;
    }
    return is_covered;
}

/// Encode all entries of a D_i that covers a line alone plus `more`; whether it is covered.
static bool encode_entries(const maplines_cholesky_t *code, maplines_scene_member_t *member,
                           const maplines_sent_line_t *line, const double more[16])
{
    double target[16];
    double resolution[16];
    double least[4];
    bool is_saturated;
    known_part(member, line, target, resolution);
    sum_of_two(target, resolution, target);
    sum_of_two(target, more, target);
    maplines_least_variances(code, least);
    return maplines_encode_covariance(code, NULL, target, least, member->raw_covariance,
                                      &is_saturated);
}

MAPLINES_INTERNAL void maplines_least_variances(const maplines_cholesky_t *code, double least[4])
{
    for (int row = 0; row < (int)code->rows; ++row)
    {
        const maplines_signal_t *pivot = &code->pivot[row];
        least[code->order[row]] =
            maplines_exp2(2.0 * maplines_physical(pivot, maplines_raw_min(pivot)));
    }
}

/// D_i as a receiver decodes it.
static void decode_specific(const maplines_dbc_t *dbc, const maplines_scene_member_t *member,
                            const maplines_sent_line_t *line, double own[16])
{
    double F[4][4];
    if (member->is_full)
    {
        uint8_t record[MAPLINES_MAX_RECORD] = {0};
        maplines_put_covariance(&dbc->covariance, record, member->raw_covariance);
        maplines_decode_factor(&dbc->covariance, record, F);
    }
    else
    {
        maplines_specific_factor(line->J, line->levels, line->common, F);
    }
    maplines_gram(4, 4, F[0], own);
}

/// Encode each line alone plus `more`, which is 0 the first time; whether all are covered and
/// no levels cost too much.
static bool encode_alone(const maplines_dbc_t *dbc, maplines_scene_workspace_t *space,
                         bool is_first)
{
    bool is_good = true;
    for (int i = 0; i < space->count; ++i)
    {
        const int place = space->places[i];
        maplines_scene_member_t *member = &space->members[place];
        maplines_sent_line_t *line = &space->lines[i];
        if (member->is_full)
        {
            line->cost = 0.0;
            line->is_covered = encode_entries(&dbc->covariance, member, line, space->more[i]);
        }
        else
        {
            line->is_covered = encode_levels(dbc, space, i, is_first);
        }
        is_good = is_good && line->is_covered && !(line->cost > 1.0);
    }
    return is_good;
}

/// Whether all lines can be compared with the scene: else they are not covered.
static bool are_comparable(maplines_scene_workspace_t *space)
{
    bool are_all = true;
    for (int i = 0; i < space->count; ++i)
    {
        bool is_finite_line = true;
        for (int k = 0; k < 16; ++k)
        {
            is_finite_line = is_finite_line && fabs(space->lacking[i][k]) < (double)INFINITY;
        }
        space->lines[i].is_covered = is_finite_line;
        are_all = are_all && is_finite_line;
    }
    return are_all;
}

MAPLINES_INTERNAL void maplines_cover(const maplines_dbc_t *dbc, maplines_scene_workspace_t *space)
{
    double share = first_share;
    memset(space->more, 0, sizeof space->more);
    for (int trial = 0; trial < MAPLINES_ENLARGEMENTS; ++trial)
    {
        if (!encode_alone(dbc, space, trial == 0))
        {
            return;
        }
        for (int i = 0; i < space->count; ++i)
        {
            const maplines_scene_member_t *member = &space->members[space->places[i]];
            decode_specific(dbc, member, &space->lines[i], space->own[i]);
            memcpy(space->J[i], space->lines[i].J, sizeof space->J[i]);
        }
        if (!maplines_uncovered(space->count, space->rest, space->spread, space->own, space->J,
                                &space->joint, space->lacking) ||
            !are_comparable(space))
        {
            return;
        }
        for (int i = 0; i < space->count; ++i)
        {
            for (int k = 0; k < 16; ++k)
            {
                const double step = share * space->lacking[i][k];
                space->more[i][k] = space->more[i][k] + step;
            }
        }
        share = 2.0 * share;
    }
    for (int i = 0; i < space->count; ++i)
    {
        const bool has_levels = !space->members[space->places[i]].is_full;
        space->lines[i].is_covered = false;
        space->lines[i].cost = maplines_has_entries(dbc) && has_levels ? (double)INFINITY : 0.0;
    }
}

#endif
