/* Lines of a map, refits and scenes: the functions of propagation.h over arrays of Python. */
#include "core.h"
#include "propagation.h"

/// Lines of a map, at the begin of their memory; their points follow.
typedef struct {
    size_t lines;
    size_t points; ///< of all lines
    maplines_path_t paths[];
} paths_t;

/// Lines as functions of the pose; there are no pointers, so the memory may be copied.
typedef struct {
    size_t lines;
    maplines_mean_pose_t from;
    maplines_refit_t refits[];
} refits_t;

/// Number of doubles that so many bytes take.
static size_t doubles_of(size_t bytes)
{
    return (bytes + sizeof(double) - 1U) / sizeof(double);
}

/* ---- lines of a map -------------------------------------------------------------------------- */

size_t maplines_paths_size(size_t lines, size_t points)
{
    return doubles_of(sizeof(paths_t) + lines * sizeof(maplines_path_t)) +
           MAPLINES_PATH_ARRAYS * points;
}

void maplines_prepare_paths(size_t lines, const size_t *count, const double *const *points,
                            const double *const *distance, double *memory)
{
    paths_t *own = (paths_t *)(void *)memory;
    double *rest = memory + maplines_paths_size(lines, 0);
    own->lines = lines;
    own->points = 0;
    for (size_t i = 0; i < lines; i++)
    {
        maplines_prepare_path(points[i], distance[i], count[i], rest, &own->paths[i]);
        rest += MAPLINES_PATH_ARRAYS * count[i];
        own->points += count[i];
    }
}

void maplines_point_errors(const double *paths, double *squares)
{
    const paths_t *own = (const paths_t *)(const void *)paths;
    for (size_t i = 0; i < own->lines; i++)
    {
        maplines_shown_errors(&own->paths[i], squares);
        squares += own->paths[i].count;
    }
}

size_t maplines_work_size(size_t lines, size_t points, size_t together, size_t poses)
{
    const size_t states = 4 * together;
    return doubles_of(lines * sizeof(maplines_stretch_t)) +
           doubles_of(lines * sizeof(maplines_omission_t)) +
           doubles_of(together * sizeof(maplines_refit_t)) +
           doubles_of(poses * sizeof(maplines_other_pose_t)) + 7 * points + states * poses +
           states * states;
}

/// Parts of the memory of that size, and the reasons of lines in it.
static maplines_work_t work_of(size_t lines, size_t points, size_t together, size_t poses,
                               double *memory, maplines_omission_t **reasons)
{
    maplines_work_t work;
    memset(&work, 0, sizeof work);
    work.seen.stretch = (maplines_stretch_t *)(void *)memory;
    memory += doubles_of(lines * sizeof(maplines_stretch_t));
    *reasons = (maplines_omission_t *)(void *)memory;
    memory += doubles_of(lines * sizeof(maplines_omission_t));
    work.refits = (maplines_refit_t *)(void *)memory;
    memory += doubles_of(together * sizeof(maplines_refit_t));
    work.poses = (maplines_other_pose_t *)(void *)memory;
    memory += doubles_of(poses * sizeof(maplines_other_pose_t));
    work.seen.x = memory;
    work.seen.y = work.seen.x + points;
    work.seen.key = work.seen.y + points;
    work.seen.slope = work.seen.key + points;
    work.seen.area = work.seen.slope + points;
    work.seen.square = work.seen.area + points;
    work.seen.cube = work.seen.square + points;
    work.values = work.seen.cube + points;
    work.matrix = work.values + 4 * together * poses;
    return work;
}

static void put_reasons(size_t lines, const maplines_omission_t *reasons, uint8_t *left_out)
{
    for (size_t i = 0; i < lines; i++)
    {
        left_out[i] = (uint8_t)reasons[i];
    }
}

/* ---- lines and scenes of a cycle ------------------------------------------------------------- */

/// Read the misfit and what follows of a fit.
static void read_map_error(const double sigmas[4], maplines_fit_t *fit)
{
    fit->has_map_error = sigmas[0] != 0.0;
    fit->point_sigma = sigmas[1];
    fit->offset_sigma = sigmas[2];
    fit->heading_sigma = sigmas[3];
}

static maplines_cycle_t cycle_of(const double query[20])
{
    maplines_cycle_t cycle;
    memset(&cycle, 0, sizeof cycle);
    memcpy(cycle.mean, query, sizeof cycle.mean);
    memcpy(cycle.cov, query + 3, sizeof cycle.cov);
    memcpy(cycle.window, query + 12, sizeof cycle.window);
    cycle.fit.max_misfit = query[14];
    cycle.max_sigma = query[15];
    read_map_error(query + 16, &cycle.fit);
    return cycle;
}

void maplines_query_view(const double query[20], double found[12])
{
    const maplines_cycle_t cycle = cycle_of(query);
    maplines_pose_view_t view;
    maplines_pose_view(&cycle, &view);
    maplines_look_start(&view.look, found, &found[2]);
    memcpy(found + 3, view.pose_cov, sizeof view.pose_cov);
}

bool maplines_propagate_lines(const double *paths, const double query[20], size_t poses,
                              const double *z, const double *mean_weights,
                              const double *cov_weights, double *memory, uint8_t *left_out,
                              double *found)
{
    const paths_t *own = (const paths_t *)(const void *)paths;
    const size_t lines = own->lines;
    const maplines_rule_t rule = {poses, z, mean_weights, cov_weights};
    maplines_omission_t *reasons;
    maplines_work_t work = work_of(lines, own->points, 1, poses, memory, &reasons);
    const maplines_cycle_t cycle = cycle_of(query);
    double(*means)[4] = (double(*)[4])found;
    double(*covs)[16] = (double(*)[16])(found + 4 * lines);
    double(*x_ranges)[2] = (double(*)[2])(found + 20 * lines);
    if (!maplines_map_lines(own->paths, lines, &cycle, &rule, &work, reasons, means, covs,
                            x_ranges))
    {
        return false;
    }
    size_t given = 0;
    for (size_t i = 0; i < lines; i++)
    {
        if (reasons[i] == MAPLINES_GIVEN)
        {
            memmove(means[given], means[i], sizeof means[i]);
            memmove(covs[given], covs[i], sizeof covs[i]);
            memmove(x_ranges[given], x_ranges[i], sizeof x_ranges[i]);
            given++;
        }
    }
    put_reasons(lines, reasons, left_out);
    return true;
}

bool maplines_propagate_scene(const double *paths, const double query[20], size_t poses,
                              const double *z, const double *mean_weights,
                              const double *cov_weights, double *memory, uint8_t *left_out,
                              double *found)
{
    const paths_t *own = (const paths_t *)(const void *)paths;
    const size_t lines = own->lines;
    const maplines_rule_t rule = {poses, z, mean_weights, cov_weights};
    maplines_omission_t *reasons;
    maplines_work_t work = work_of(lines, own->points, lines, poses, memory, &reasons);
    const maplines_cycle_t cycle = cycle_of(query);
    maplines_joint_t joint;
    joint.lines = 0;
    joint.means = found;
    joint.x_ranges = (double(*)[2])(joint.means + 4 * lines);
    joint.fit_ranges = joint.x_ranges + lines;
    joint.quartics = joint.fit_ranges[lines];
    joint.specific_covs = joint.quartics + lines;
    joint.cov = joint.specific_covs + 16 * lines;
    const bool is_done =
        maplines_map_scene(own->paths, lines, &cycle, &rule, &work, reasons, &joint);
    put_reasons(lines, reasons, left_out);
    return is_done;
}

/* ---- refits ---------------------------------------------------------------------------------- */

size_t maplines_refits_size(size_t lines)
{
    return doubles_of(sizeof(refits_t) + lines * sizeof(maplines_refit_t));
}

void maplines_refit_fields(const double *refits, double *fields)
{
    const refits_t *own = (const refits_t *)(const void *)refits;
    const size_t lines = own->lines;
    for (size_t i = 0; i < lines; i++)
    {
        const maplines_refit_t *refit = &own->refits[i];
        double *x_range = fields + 2 * i;
        double *one = fields + 2 * lines + i;
        double *noise_cov = fields + 5 * lines + 16 * i;
        double *points = fields + 21 * lines + (size_t)(2 * MAPLINES_NODES) * i;
        memcpy(x_range, refit->fitted.x_range, sizeof refit->fitted.x_range);
        one[0] = refit->fitted.misfit;
        one[lines] = refit->is_across ? 1.0 : 0.0;
        one[2 * lines] = refit->fitted.modes[0];
        memcpy(noise_cov, refit->noise_cov, sizeof refit->noise_cov);
        for (size_t k = 0; k < MAPLINES_NODES; k++)
        {
            points[2 * k] = refit->x[k];
            points[2 * k + 1] = refit->y[k];
        }
    }
}

static maplines_look_t look_of(const double look[6])
{
    const maplines_look_t own = {
        {look[0], look[1], look[2]}, {look[3], look[4]}, look[5], (double)INFINITY};
    return own;
}

void maplines_look_from(const double look[6], double start[3])
{
    const maplines_look_t own = look_of(look);
    maplines_look_start(&own, start, &start[2]);
}

size_t maplines_refit_lines(const double *paths, const double look[6], const double settings[7],
                            double *memory, uint8_t *left_out, double *refits)
{
    const paths_t *own = (const paths_t *)(const void *)paths;
    refits_t *made = (refits_t *)(void *)refits;
    const maplines_look_t at = look_of(look);
    maplines_omission_t *reasons;
    maplines_work_t work = work_of(own->lines, own->points, 0, 0, memory, &reasons);
    maplines_fit_t fit;
    fit.max_misfit = settings[0];
    fit.room = settings[1];
    fit.step = settings[2];
    read_map_error(settings + 3, &fit);
    maplines_see(own->paths, own->lines, &at, &work.seen, reasons);
    put_reasons(own->lines, reasons, left_out);
    made->lines = 0;
    made->from = maplines_mean_pose(look);
    for (size_t i = 0; i < work.seen.lines; i++)
    {
        if (!maplines_refit(&work.seen, i, &made->from, &fit, &made->refits[made->lines]))
        {
            break;
        }
        made->lines++;
    }
    return made->lines;
}

void maplines_refit_values(const double *refits, size_t n, const double *poses, double *values)
{
    const refits_t *own = (const refits_t *)(const void *)refits;
    for (size_t k = 0; k < n; k++)
    {
        const maplines_other_pose_t pose = maplines_other_pose(&own->from, poses + 3 * k);
        for (size_t i = 0; i < own->lines; i++)
        {
            (void)maplines_refit_at(&own->refits[i], &pose, values + 4 * (k * own->lines + i));
        }
    }
}

bool maplines_refit_extended_values(const double *refits, size_t n, const double *poses,
                                    bool are_displacements, double *values)
{
    const refits_t *own = (const refits_t *)(const void *)refits;
    bool is_right = true;
    for (size_t k = 0; k < n; k++)
    {
        double place[3] = {poses[3 * k], poses[3 * k + 1], poses[3 * k + 2]};
        if (are_displacements)
        {
            maplines_displace(&own->from, place);
        }
        const maplines_other_pose_t pose = maplines_other_pose(&own->from, place);
        for (size_t i = 0; i < own->lines; i++)
        {
            is_right &= maplines_refit_extended(&own->refits[i], &own->from, &pose,
                                                values + 4 * (k * own->lines + i));
        }
    }
    return is_right;
}

/* ---- what is seen of lines ------------------------------------------------------------------- */

size_t maplines_see_lines(const double *paths, const double look[6], double *memory,
                          uint8_t *left_out, size_t *count, double *x_range, double *x, double *y)
{
    const paths_t *own = (const paths_t *)(const void *)paths;
    const maplines_look_t at = look_of(look);
    maplines_omission_t *reasons;
    maplines_work_t work = work_of(own->lines, own->points, 0, 0, memory, &reasons);
    maplines_see(own->paths, own->lines, &at, &work.seen, reasons);
    put_reasons(own->lines, reasons, left_out);
    for (size_t i = 0; i < work.seen.lines; i++)
    {
        const maplines_stretch_t *stretch = &work.seen.stretch[i];
        count[i] = stretch->count;
        memcpy(x_range + 2 * i, stretch->x_range, sizeof stretch->x_range);
    }
    memcpy(x, work.seen.x, work.seen.points * sizeof *x);
    memcpy(y, work.seen.y, work.seen.points * sizeof *y);
    return work.seen.lines;
}

/* ---- lines and scenes step by step ----------------------------------------------------------- */

size_t maplines_fit_lines(const double *paths, const double query[20], double *memory,
                          uint8_t *left_out, double *x_ranges, double *refits)
{
    const paths_t *own = (const paths_t *)(const void *)paths;
    refits_t *made = (refits_t *)(void *)refits;
    const maplines_cycle_t cycle = cycle_of(query);
    maplines_omission_t *reasons;
    maplines_work_t work = work_of(own->lines, own->points, 0, 0, memory, &reasons);
    maplines_pose_view_t view;
    maplines_pose_view(&cycle, &view);
    const maplines_fit_t fit = maplines_line_fit(&cycle, &view);
    maplines_see(own->paths, own->lines, &view.look, &work.seen, reasons);
    made->lines = 0;
    made->from = view.from;
    for (size_t i = 0; i < work.seen.lines; i++)
    {
        maplines_refit_t *refit = &made->refits[made->lines];
        if (maplines_refit(&work.seen, i, &view.from, &fit, refit) &&
            maplines_line_range(&cycle, &view, refit, x_ranges + 2 * made->lines))
        {
            made->lines++;
        }
        else
        {
            reasons[work.seen.stretch[i].line] = MAPLINES_TOO_SHORT;
        }
    }
    put_reasons(own->lines, reasons, left_out);
    return made->lines;
}

bool maplines_shorten_line(const double mean[4], const double cov[16], double max_sigma,
                           double x_range[2])
{
    return maplines_shorten_range(mean, cov, max_sigma, x_range);
}

/// Search of the ranges of a scene; its work is in memory of the caller.
typedef struct {
    maplines_cycle_t cycle;
    maplines_search_t search;
    maplines_work_t work;
    maplines_omission_t *reasons;
    size_t asked; ///< lines that are asked for
} scene_search_t;

size_t maplines_search_size(void)
{
    return doubles_of(sizeof(scene_search_t));
}

void maplines_search_scene(const double *paths, const double query[20], double *memory,
                           double *search)
{
    const paths_t *own = (const paths_t *)(const void *)paths;
    scene_search_t *state = (scene_search_t *)(void *)search;
    state->cycle = cycle_of(query);
    state->asked = own->lines;
    state->work = work_of(own->lines, own->points, own->lines, 0, memory, &state->reasons);
    maplines_begin_scene(own->paths, own->lines, &state->cycle, &state->work, state->reasons,
                         &state->search);
}

size_t maplines_search_fit(double *search, uint8_t *left_out, double *refits)
{
    scene_search_t *state = (scene_search_t *)(void *)search;
    refits_t *made = (refits_t *)(void *)refits;
    (void)maplines_fit_scene(&state->cycle, &state->work, state->reasons, &state->search);
    put_reasons(state->asked, state->reasons, left_out);
    made->lines = state->search.lines;
    made->from = state->search.view.from;
    for (size_t i = 0; i < made->lines; i++)
    {
        made->refits[i] = state->work.refits[state->search.places[i]];
    }
    return made->lines;
}

bool maplines_search_settle(double *search, double *means, double *cov, double *x_ranges)
{
    scene_search_t *state = (scene_search_t *)(void *)search;
    maplines_joint_t joint;
    memset(&joint, 0, sizeof joint);
    joint.lines = state->search.lines;
    joint.means = means;
    joint.cov = cov;
    joint.x_ranges = (double(*)[2])x_ranges;
    return maplines_settle_scene(&state->cycle, &state->work, &state->search, &joint);
}

/* ---- moments --------------------------------------------------------------------------------- */

void maplines_moments_of(size_t n, size_t outputs, size_t m, const double *mean_weights,
                         const double *cov_weights, const double *values, double *scratch,
                         double *means, double *covs)
{
    const maplines_rule_t rule = {n, NULL, mean_weights, cov_weights};
    for (size_t i = 0; i < outputs; i++)
    {
        maplines_weighted_moments(&rule, m, outputs * m, values + m * i, scratch, means + m * i,
                                  covs + m * m * i);
    }
}
