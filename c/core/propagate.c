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

bool maplines_prepare_paths(size_t lines, const size_t *count, const double *const *points,
                            const double *const *distance, double *memory)
{
    paths_t *own = (paths_t *)(void *)memory;
    double *rest = memory + maplines_paths_size(lines, 0);
    bool is_prepared = true;
    own->lines = lines;
    own->points = 0;
    for (size_t i = 0; i < lines; i++)
    {
        is_prepared &=
            maplines_prepare_path(points[i], distance[i], count[i], rest, &own->paths[i]);
        rest += MAPLINES_PATH_ARRAYS * count[i];
        own->points += count[i];
    }
    return is_prepared;
}

size_t maplines_work_size(size_t lines, size_t points, size_t together, size_t poses)
{
    const size_t states = 4 * together;
    return doubles_of(lines * sizeof(maplines_stretch_t)) +
           doubles_of(lines * sizeof(maplines_omission_t)) +
           doubles_of(together * sizeof(maplines_refit_t)) + 5 * points + (3 + states) * poses +
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
    work.seen.x = memory;
    work.seen.y = work.seen.x + points;
    work.seen.key = work.seen.y + points;
    work.seen.slope = work.seen.key + points;
    work.scratch = work.seen.slope + points;
    work.poses = work.scratch + points;
    work.values = work.poses + 3 * poses;
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

/// Read a query; false if its window or its misfit is wrong.
static bool read_query(const double query[20], maplines_cycle_t *cycle)
{
    memset(cycle, 0, sizeof *cycle);
    memcpy(cycle->mean, query, sizeof cycle->mean);
    memcpy(cycle->cov, query + 3, sizeof cycle->cov);
    memcpy(cycle->window, query + 12, sizeof cycle->window);
    cycle->fit.max_misfit = query[14];
    cycle->max_sigma = query[15];
    read_map_error(query + 16, &cycle->fit);
    return -(double)INFINITY < cycle->window[0] && cycle->window[0] < cycle->window[1] &&
           cycle->window[1] < (double)INFINITY && cycle->fit.max_misfit > 0.0;
}

bool maplines_query_view(const double query[20], double found[12])
{
    maplines_cycle_t cycle;
    maplines_pose_view_t view;
    const bool is_read = read_query(query, &cycle);
    if (is_read)
    {
        maplines_pose_view(&cycle, &view);
        maplines_look_start(&view.look, found, &found[2]);
        memcpy(found + 3, view.pose_cov, sizeof view.pose_cov);
    }
    return is_read;
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
    maplines_cycle_t cycle;
    double(*means)[4] = (double(*)[4])found;
    double(*covs)[16] = (double(*)[16])(found + 4 * lines);
    double(*x_ranges)[2] = (double(*)[2])(found + 20 * lines);
    if (!read_query(query, &cycle) || !maplines_map_lines(own->paths, lines, &cycle, &rule, &work,
                                                          reasons, means, covs, x_ranges))
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
    maplines_cycle_t cycle;
    maplines_joint_t joint;
    joint.lines = 0;
    joint.means = found;
    joint.x_ranges = (double(*)[2])(joint.means + 4 * lines);
    joint.fit_ranges = joint.x_ranges + lines;
    joint.quartics = joint.fit_ranges[lines];
    joint.specific_covs = joint.quartics + lines;
    joint.cov = joint.specific_covs + 16 * lines;
    if (lines > MAPLINES_SCENE_LINES || !read_query(query, &cycle))
    {
        return false;
    }
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

/// Set what is read of the refits.
static void put_fields(const refits_t *own, double *fields)
{
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
        one[2 * lines] = maplines_refit_quartic(refit);
        memcpy(noise_cov, refit->noise_cov, sizeof refit->noise_cov);
        for (size_t k = 0; k < MAPLINES_NODES; k++)
        {
            points[2 * k] = refit->fitted.x[k];
            points[2 * k + 1] = refit->y[k];
        }
    }
}

/// Refits of stretches; false if a line has none.
static bool refit_all(const maplines_work_t *work, const double pose[3], const double settings[7],
                      double *refits, double *fields)
{
    refits_t *own = (refits_t *)(void *)refits;
    maplines_fit_t fit;
    bool is_done = true;
    fit.max_misfit = settings[0];
    fit.room = settings[1];
    fit.step = settings[2];
    read_map_error(settings + 3, &fit);
    own->lines = work->seen.lines;
    own->from = maplines_mean_pose(pose);
    is_done = fit.max_misfit > 0.0 && fabs(fit.room) < (double)INFINITY && fit.step >= 0.0 &&
              fit.step < (double)INFINITY;
    for (size_t i = 0; is_done && i < own->lines; i++)
    {
        is_done = maplines_refit(&work->seen, i, &own->from, &fit, work->scratch, &own->refits[i]);
    }
    if (is_done)
    {
        put_fields(own, fields);
    }
    return is_done;
}

static maplines_look_t look_of(const double look[6])
{
    const maplines_look_t own = {{look[0], look[1], look[2]}, {look[3], look[4]}, look[5]};
    return own;
}

void maplines_refit_start(const double look[6], double start[3])
{
    const maplines_look_t own = look_of(look);
    maplines_look_start(&own, start, &start[2]);
}

bool maplines_refit_lines(const double *paths, const double look[6], const double settings[7],
                          double *memory, uint8_t *left_out, double *refits, double *fields)
{
    const paths_t *own = (const paths_t *)(const void *)paths;
    const maplines_look_t at = look_of(look);
    maplines_omission_t *reasons;
    maplines_work_t work = work_of(own->lines, own->points, 0, 0, memory, &reasons);
    maplines_see(own->paths, own->lines, &at, &work.seen, reasons);
    put_reasons(own->lines, reasons, left_out);
    return work.seen.lines == own->lines && refit_all(&work, look, settings, refits, fields);
}

bool maplines_refit_stretches(size_t lines, size_t points, const double *x, const double *y,
                              const int64_t *first, const double *x_range, const double pose[3],
                              const double settings[7], double *memory, double *refits,
                              double *fields)
{
    maplines_omission_t *reasons;
    maplines_work_t work = work_of(lines, points, 0, 0, memory, &reasons);
    work.seen.lines = lines;
    work.seen.points = points;
    memcpy(work.seen.x, x, points * sizeof *x);
    memcpy(work.seen.y, y, points * sizeof *y);
    for (size_t i = 0; i < lines; i++)
    {
        const size_t begin = (size_t)first[i];
        const size_t end = i + 1 < lines ? (size_t)first[i + 1] : points;
        const maplines_stretch_t stretch = {
            begin, end - begin, {x_range[2 * i], x_range[2 * i + 1]}, i};
        work.seen.stretch[i] = stretch;
        if (begin >= end || end > points)
        {
            return false;
        }
    }
    maplines_index_stretches(&work.seen);
    return refit_all(&work, pose, settings, refits, fields);
}

void maplines_refit_values(const double *refits, size_t n, const double *poses, double *values)
{
    const refits_t *own = (const refits_t *)(const void *)refits;
    for (size_t k = 0; k < n; k++)
    {
        for (size_t i = 0; i < own->lines; i++)
        {
            (void)maplines_refit_at(&own->refits[i], &own->from, poses + 3 * k,
                                    values + 4 * (k * own->lines + i));
        }
    }
}

bool maplines_refit_moments(const double *refits, const double gaussian[12], size_t poses,
                            const double *z, const double *mean_weights, const double *cov_weights,
                            double *memory, double *means, double *covs)
{
    const refits_t *own = (const refits_t *)(const void *)refits;
    const maplines_rule_t rule = {poses, z, mean_weights, cov_weights};
    double *at = memory;
    double *values = at + 3 * poses;
    double root[9];
    maplines_square_root(3, gaussian + 3, root);
    maplines_rule_points(&rule, gaussian, root, at);
    for (size_t i = 0; i < own->lines; i++)
    {
        for (size_t k = 0; k < poses; k++)
        {
            double *line = values + 4 * k;
            if (!maplines_refit_at(&own->refits[i], &own->from, at + 3 * k, line) ||
                !(line[0] == line[0] && line[1] == line[1] && line[2] == line[2] &&
                  line[3] == line[3]))
            {
                return false;
            }
        }
        maplines_weighted_moments(&rule, 4, 4, values, means + 4 * i, covs + 16 * i);
    }
    return true;
}
