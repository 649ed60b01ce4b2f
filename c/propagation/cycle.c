/* Lines of a map from an uncertain pose, one by one or as a scene. */
#include "propagation.h"

#define MAX_TURN 0x1.226c3bcdbe7aep+0 ///< 65 deg: largest angle between a line and the x axis
#define MIN_TURN 0x1.657184ae74487p-2 ///< 20 deg: its least limit, however uncertain the heading
#define TURN_MARGIN 3.0               ///< sigmas of the heading for which it leaves room
#define ASIDE 10.0                    ///< lateral distance for which the window is widened [m]
#define MARGIN 3.0                    ///< sigmas of the pose error at an end of a range
#define HALF_PI 0x1.921fb54442d18p+0
#define MIN_RANGE 1.0  ///< of a line [m]
#define WHOLE_STEP 1.0 ///< of the ends of the fit ranges of scenes [m]
#define TRIALS 8       ///< most times that a line of a scene is fitted again

/* ---- what both share --------------------------------------------------------------------------
 */

/// Distance by which pose errors shorten the range of a line at the end (x, y) [m].
static double margin_at(const double P[9], double x, double y)
{
    const double turn = MARGIN * sqrt(P[8]);
    double sine;
    double cosine;
    const double by_both = 2.0 * y * P[2];
    const double by_heading = y * y * P[8];
    const double variance = P[0] - by_both + by_heading;
    const double sigma = sqrt(variance > 0.0 ? variance : 0.0);
    maplines_sin_cos(turn < HALF_PI ? turn : HALF_PI, &sine, &cosine);
    const double shortening = (1.0 - cosine) * fabs(x);
    return MARGIN * sigma + shortening;
}

void maplines_pose_view(const maplines_cycle_t *cycle, maplines_pose_view_t *view)
{
    view->from = maplines_mean_pose(cycle->mean);
    const double c = view->from.cosine;
    const double s = view->from.sine;
    const double R[9] = {c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0};
    double RS[9];
    maplines_product(3, 3, 3, R, cycle->cov, RS);
    maplines_product_transposed(3, 3, 3, RS, R, view->pose_cov);
    maplines_symmetric(3, view->pose_cov);
    const double turn = MAX_TURN - TURN_MARGIN * sqrt(view->pose_cov[8]);
    memcpy(view->cov, view->pose_cov, sizeof view->cov);
    if (cycle->fit.has_map_error) // it moves the ends of a line as the pose error does
    {
        const double shift = cycle->fit.offset_sigma * cycle->fit.offset_sigma;
        view->cov[0] += shift;
        view->cov[4] += shift;
        view->cov[8] += cycle->fit.heading_sigma * cycle->fit.heading_sigma;
    }
    const double behind = fabs(cycle->window[0]);
    const double ahead = fabs(cycle->window[1]);
    const double farthest = behind > ahead ? behind : ahead;
    const double right = margin_at(view->cov, farthest, -ASIDE);
    const double left = margin_at(view->cov, farthest, ASIDE);
    view->room = right > left ? right : left;
    view->look.max_turn = turn > MIN_TURN ? turn : MIN_TURN;
    view->look.max_unseen = cycle->fit.max_misfit;
    view->look.window[0] = cycle->window[0] - view->room;
    view->look.window[1] = cycle->window[1] + view->room;
    memcpy(view->look.pose, cycle->mean, sizeof view->look.pose);
}

/// Values of some lines at the poses of a cycle, one row of all lines for each pose.
static bool values_at(const maplines_pose_view_t *view, const maplines_rule_t *rule,
                      const maplines_refit_t *refits, size_t lines, const size_t *places,
                      maplines_work_t *work)
{
    for (size_t k = 0; k < rule->count; ++k)
    {
        for (size_t i = 0; i < lines; ++i)
        {
            double *line = work->values + 4 * (k * lines + i);
            if (!maplines_refit_extended(&refits[places[i]], &view->from, &work->poses[k], line))
            {
                return false;
            }
        }
    }
    return true;
}

static bool is_finite_array(size_t count, const double *values)
{
    for (size_t i = 0; i < count; ++i)
    {
        if (!(fabs(values[i]) < (double)INFINITY))
        {
            return false;
        }
    }
    return true;
}

static double clipped(double value, const double window[2])
{
    const double raised = value > window[0] ? value : window[0];
    return raised < window[1] ? raised : window[1];
}

/* ---- lines one by one -------------------------------------------------------------------------
 */

maplines_fit_t maplines_line_fit(const maplines_cycle_t *cycle, const maplines_pose_view_t *view)
{
    maplines_fit_t fit = cycle->fit;
    fit.room = view->room;
    fit.step = 0.0;
    return fit;
}

bool maplines_line_range(const maplines_cycle_t *cycle, const maplines_pose_view_t *view,
                         const maplines_refit_t *refit, double x_range[2])
{
    for (int end = 0; end < 2; ++end)
    {
        const int node = end == 0 ? 0 : MAPLINES_NODES - 1;
        const double margin = margin_at(view->cov, refit->x[node], refit->y[node]);
        const double x = refit->fitted.x_range[end] + (end == 0 ? margin : -margin);
        x_range[end] = clipped(x, cycle->window);
    }
    return x_range[1] - x_range[0] >= MIN_RANGE && !refit->is_across;
}

bool maplines_shorten_range(const double mean[4], const double cov[16], double max_sigma,
                            double x_range[2])
{
    double certain[2];
    maplines_certain_range(mean, cov, x_range, max_sigma, certain);
    if (certain[0] == x_range[0] && certain[1] == x_range[1])
    {
        return true;
    }
    x_range[0] = certain[0];
    x_range[1] = certain[1];
    return certain[1] - certain[0] >= MIN_RANGE; // not if it is NaN
}

/// Whether a mean and a covariance are those of a Gaussian, which has no covariances of a variance
/// of 0.
static bool is_gaussian(const double mean[4], const double cov[16])
{
    double scratch[16];
    bool is_right = is_finite_array(4, mean) && maplines_is_covariance(4, cov, scratch);
    for (int i = 0; i < 16; ++i)
    {
        is_right = is_right && (cov[5 * (i / 4)] > 0.0 || cov[i] == 0.0);
    }
    return is_right;
}

/// Mean and covariance of the line of a refit; false if they are none.
static bool set_line(const maplines_pose_view_t *view, const maplines_rule_t *rule,
                     const maplines_refit_t *refit, maplines_work_t *work, double mean[4],
                     double cov[16])
{
    static const size_t place = 0;
    if (!values_at(view, rule, refit, 1, &place, work))
    {
        return false;
    }
    double scratch[4];
    maplines_weighted_moments(rule, 4, 4, work->values, scratch, mean, cov);
    for (int i = 0; i < 16; ++i)
    {
        cov[i] += refit->noise_cov[i];
    }
    maplines_symmetric(4, cov);
    return is_gaussian(mean, cov);
}

bool maplines_map_lines(const maplines_path_t *paths, size_t count, const maplines_cycle_t *cycle,
                        const maplines_rule_t *rule, maplines_work_t *work,
                        maplines_omission_t *left_out, double (*means)[4], double (*covs)[16],
                        double (*x_ranges)[2])
{
    maplines_pose_view_t view;
    double root[9];
    maplines_pose_view(cycle, &view);
    const maplines_fit_t fit = maplines_line_fit(cycle, &view);
    maplines_square_root(3, cycle->cov, root);
    for (size_t k = 0; k < rule->count; ++k)
    {
        double pose[3];
        maplines_rule_point(rule, k, cycle->mean, root, pose);
        work->poses[k] = maplines_other_pose(&view.from, pose);
    }
    maplines_see(paths, count, &view.look, &work->seen, left_out);
    for (size_t i = 0; i < work->seen.lines; ++i)
    {
        const size_t line = work->seen.stretch[i].line;
        maplines_refit_t *refit = &work->refits[0];
        if (!maplines_refit(&work->seen, i, &view.from, &fit, refit) ||
            !maplines_line_range(cycle, &view, refit, x_ranges[line]))
        {
            left_out[line] = MAPLINES_TOO_SHORT;
        }
        else if (!set_line(&view, rule, refit, work, means[line], covs[line]))
        {
            return false;
        }
        else if (!maplines_shorten_range(means[line], covs[line], cycle->max_sigma, x_ranges[line]))
        {
            left_out[line] = MAPLINES_UNCERTAIN;
        }
    }
    return true;
}

/* ---- lines of a scene -------------------------------------------------------------------------
 */

static void valid_range_of(const maplines_cycle_t *cycle, const maplines_pose_view_t *view,
                           const maplines_refit_t *refit, const double mean[4], double x_range[2])
{
    const double heading_sigma = cycle->fit.has_map_error ? cycle->fit.heading_sigma : 0.0;
    maplines_curve_t curve = {{mean[0], mean[1], mean[2], mean[3]},
                              {refit->fitted.x_range[0], refit->fitted.x_range[1]},
                              0.0};
    maplines_valid_range(&curve, view->pose_cov, refit->noise_cov, heading_sigma, x_range);
}

/// The line is to be in the scene, as far as it is known before the propagation.
static bool is_kept(const maplines_cycle_t *cycle, const maplines_pose_view_t *view,
                    const maplines_refit_t *refit, const maplines_trial_t *trial)
{
    const double *fit_range = refit->fitted.x_range;
    double x_range[2];
    if (trial->is_dropped || refit->is_across)
    {
        return false;
    }
    valid_range_of(cycle, view, refit, refit->mean, x_range);
    return x_range[1] - x_range[0] >= MIN_RANGE && floor(fit_range[0]) == fit_range[0] &&
           floor(fit_range[1]) == fit_range[1];
}

/// Range to be fitted for a line to be valid where it is certain. A line that is certain nowhere
/// may be so if less of it is fitted: half of what is ahead.
static void set_shorter(const double fit_range[2], const double x_range[2], const double certain[2],
                        double shorter[2])
{
    const double car = clipped(0.0, fit_range);
    for (int end = 0; end < 2; ++end)
    {
        const double half = (fit_range[end] - car) / 2.0;
        const double room = fit_range[end] - x_range[end];
        shorter[end] = certain[end] == certain[end] ? certain[end] + room : car + half;
    }
}

/// Joint moments of the lines that are kept.
static bool set_moments(const maplines_pose_view_t *view, const maplines_rule_t *rule,
                        const size_t *places, maplines_work_t *work, maplines_joint_t *joint)
{
    const size_t n = 4 * joint->lines;
    if (!values_at(view, rule, work->refits, joint->lines, places, work))
    {
        return false;
    }
    maplines_weighted_moments(rule, n, n, work->values, work->matrix, joint->means, joint->cov);
    for (size_t i = 0; i < n; ++i)
    {
        const double *own = work->refits[places[i / 4]].noise_cov + 4 * (i % 4);
        for (size_t j = 0; j < 4; ++j)
        {
            joint->cov[n * i + i / 4 * 4 + j] += own[j];
        }
    }
    maplines_symmetric((int)n, joint->cov);
    return is_finite_array(n, joint->means) && is_finite_array(n * n, joint->cov);
}

/// Covariance of a line of the scene.
static void block_of(const maplines_joint_t *joint, size_t line, double block[16])
{
    const size_t n = 4 * joint->lines;
    for (size_t i = 0; i < 4; ++i)
    {
        memcpy(block + 4 * i, joint->cov + n * (4 * line + i) + 4 * line, 4 * sizeof *block);
    }
}

/// Shorten the ranges of the lines that are uncertain at an end; whether there are any.
static bool shorten(const maplines_cycle_t *cycle, maplines_work_t *work, maplines_search_t *search,
                    const maplines_joint_t *joint)
{
    bool is_any = false;
    for (size_t i = 0; i < search->lines; ++i)
    {
        double block[16];
        double certain[2];
        double shorter[2] = {0.0, 0.0};
        const size_t place = search->places[i];
        maplines_trial_t *trial = &search->trials[place];
        maplines_stretch_t *stretch = &work->seen.stretch[place];
        const double *x_range = joint->x_ranges[i];
        block_of(joint, i, block);
        maplines_certain_range(joint->means + 4 * i, block, x_range, cycle->max_sigma, certain);
        if (certain[0] == x_range[0] && certain[1] == x_range[1])
        {
            continue;
        }
        is_any = true;
        set_shorter(work->refits[place].fitted.x_range, x_range, certain, shorter);
        trial->is_shorter = true;
        trial->is_dropped = trial->trials >= TRIALS || !(shorter[1] - shorter[0] >= MIN_RANGE);
        ++trial->trials;
        if (!trial->is_dropped)
        {
            trial->is_new = true;
            memcpy(stretch->x_range, shorter, sizeof shorter);
        }
    }
    return is_any;
}

/// Set what a scene has of its lines but their moments and valid ranges.
static bool set_scene(const size_t *places, maplines_work_t *work, maplines_joint_t *joint)
{
    double scratch[16];
    for (size_t i = 0; i < joint->lines; ++i)
    {
        const maplines_refit_t *refit = &work->refits[places[i]];
        memcpy(joint->fit_ranges[i], refit->fitted.x_range, sizeof joint->fit_ranges[i]);
        memcpy(joint->specific_covs + 16 * i, refit->noise_cov, sizeof refit->noise_cov);
        joint->quartics[i] = refit->fitted.modes[0];
        if (!maplines_is_covariance(4, joint->specific_covs + 16 * i, scratch))
        {
            return false;
        }
    }
    return is_finite_array(joint->lines, joint->quartics) &&
           maplines_is_covariance(4 * joint->lines, joint->cov, work->matrix);
}

void maplines_begin_scene(const maplines_path_t *paths, size_t count, const maplines_cycle_t *cycle,
                          maplines_work_t *work, maplines_omission_t *left_out,
                          maplines_search_t *search)
{
    memset(search, 0, sizeof *search);
    maplines_pose_view(cycle, &search->view);
    search->fit = cycle->fit;
    search->fit.room = search->view.room;
    search->fit.step = WHOLE_STEP;
    maplines_see(paths, count, &search->view.look, &work->seen, left_out);
    for (size_t i = 0; i < work->seen.lines; ++i)
    {
        search->trials[i].is_new = true;
    }
}

bool maplines_fit_scene(const maplines_cycle_t *cycle, maplines_work_t *work,
                        maplines_omission_t *left_out, maplines_search_t *search)
{
    search->lines = 0;
    for (size_t i = 0; i < work->seen.lines; ++i)
    {
        maplines_trial_t *trial = &search->trials[i];
        maplines_refit_t *refit = &work->refits[i];
        if (trial->is_new && !trial->is_dropped &&
            !maplines_refit(&work->seen, i, &search->view.from, &search->fit, refit))
        {
            trial->is_dropped = true;
        }
        trial->is_new = false;
        if (is_kept(cycle, &search->view, refit, trial))
        {
            search->places[search->lines] = i;
            ++search->lines;
        }
        else
        {
            left_out[work->seen.stretch[i].line] =
                trial->is_shorter ? MAPLINES_UNCERTAIN : MAPLINES_TOO_SHORT;
        }
    }
    return search->lines > 0;
}

bool maplines_settle_scene(const maplines_cycle_t *cycle, maplines_work_t *work,
                           maplines_search_t *search, maplines_joint_t *joint)
{
    bool has_ended = false;
    for (size_t i = 0; i < search->lines; ++i)
    {
        const size_t place = search->places[i];
        double *x_range = joint->x_ranges[i];
        valid_range_of(cycle, &search->view, &work->refits[place], joint->means + 4 * i, x_range);
        const bool ends = !(x_range[1] - x_range[0] >= MIN_RANGE);
        search->trials[place].is_dropped |= ends;
        has_ended |= ends;
    }
    return !has_ended && !shorten(cycle, work, search, joint);
}

bool maplines_map_scene(const maplines_path_t *paths, size_t count, const maplines_cycle_t *cycle,
                        const maplines_rule_t *rule, maplines_work_t *work,
                        maplines_omission_t *left_out, maplines_joint_t *joint)
{
    static const double origin[3] = {0.0, 0.0, 0.0};
    maplines_search_t search;
    double root[9];
    maplines_begin_scene(paths, count, cycle, work, left_out, &search);
    maplines_square_root(3, search.view.pose_cov, root);
    for (size_t k = 0; k < rule->count; ++k)
    {
        double pose[3];
        maplines_rule_point(rule, k, origin, root, pose);
        maplines_displace(&search.view.from, pose);
        work->poses[k] = maplines_other_pose(&search.view.from, pose);
    }
    // Each round but the last drops a line or is one of the trials of a line.
    for (int round = 0; round < MAPLINES_SCENE_LINES * (TRIALS + 3); ++round)
    {
        const bool has_lines = maplines_fit_scene(cycle, work, left_out, &search);
        joint->lines = search.lines;
        if (!has_lines)
        {
            return true;
        }
        if (!set_moments(&search.view, rule, search.places, work, joint))
        {
            return false;
        }
        if (maplines_settle_scene(cycle, work, &search, joint))
        {
            return set_scene(search.places, work, joint);
        }
    }
    return false;
}
