/* Input of a sender with a map: a pose with its covariance.
 *
 * Setting an input of the pose publishes the lines of the map around it, as the operations of
 * maplines_can.map_lines and RouteLines.locate give them, in the same order. A line that cannot be
 * given is sent as it was, with an age that grows; slots in which the map has no line there, and
 * all if the pose is not valid or not on the route, send nothing.
 */
#include "fmu.h"
#include "route.h"

#include <float.h>
#include <math.h>
#include <string.h>

#define MAX_OFFSET 10.0    /* of a car that is on the route from its path [m] */
#define SEARCH_BEHIND 30.0 /* distances from the last place where the next one is sought [m] */
#define SEARCH_AHEAD 100.0
#define NO_LINE 6 /* after the reasons of maplines_omission_t: the slot has no line there */

/* ---- parameters ------------------------------------------------------------------------------ */

size_t maplines_scratch_size(void)
{
    // Paths with distances, stretches, what a refit needs; poses of the rule and their lines.
    return (MAPLINES_PATH_ARRAYS + 1 + 7) * maplines_route.most_points +
           (sizeof(maplines_other_pose_t) / sizeof(double) + 4) * maplines_route.rule.count;
}

const char *maplines_start_input(maplines_instance_t *instance)
{
    const double *reals = instance->state.values.reals;
    int64_t *reasons = &instance->state.values.choices[CHOICE_SLOTS + SLOT_CHOICE_LEFT_OUT];
    const char *wrong = NULL;
    if (!(reals[REAL_WINDOW_X_MIN] >= -MAPLINES_ROUTE_BEHIND &&
          reals[REAL_WINDOW_X_MIN] < reals[REAL_WINDOW_X_MAX] &&
          reals[REAL_WINDOW_X_MAX] <= MAPLINES_ROUTE_AHEAD))
    {
        wrong = "window.x_min must be at least -60 m, and window.x_max more, but at most 150 m";
    }
    else if (!(reals[REAL_MAX_MISFIT] > 0.0 && reals[REAL_MAX_SIGMA] > 0.0))
    {
        wrong = "max_misfit and max_sigma must be more than 0 m";
    }
    for (int i = 0; i < 3 && wrong == NULL; i++)
    {
        const double sigma = reals[REAL_MAP_POINT_SIGMA + i];
        if (!(sigma >= 0.0 && sigma < (double)INFINITY))
        {
            wrong = "the standard deviations of map_error must be 0 or more, and finite";
        }
    }
    for (int slot = 0; slot < MAPLINES_SLOTS; slot++)
    {
        reasons[SLOT_CHOICES * slot] = NO_LINE;
    }
    return wrong;
}

void maplines_note_input(maplines_node_t *node, fmi3ValueReference first, size_t index)
{
    (void)first;
    (void)index;
    node->set = 1;
}

/// Read the pose and the settings; false if the pose is no Gaussian.
static bool read_cycle(const maplines_values_t *values, maplines_cycle_t *cycle)
{
    const double *reals = values->reals;
    const double *entry = &reals[REAL_POSE_COV];
    double scratch[9];
    bool is_right = reals[REAL_POSE_AGE] >= 0.0;
    memset(cycle, 0, sizeof *cycle);
    for (int i = 0; i < 3; i++)
    {
        cycle->mean[i] = reals[REAL_POSE_MEAN + i];
        is_right = is_right && fabs(cycle->mean[i]) < (double)INFINITY;
        for (int j = 0; j <= i; j++)
        {
            cycle->cov[3 * i + j] = *entry;
            cycle->cov[3 * j + i] = *entry;
            entry++;
        }
    }
    cycle->window[0] = reals[REAL_WINDOW_X_MIN];
    cycle->window[1] = reals[REAL_WINDOW_X_MAX];
    cycle->max_sigma = reals[REAL_MAX_SIGMA];
    cycle->fit.max_misfit = reals[REAL_MAX_MISFIT];
    cycle->fit.point_sigma = reals[REAL_MAP_POINT_SIGMA];
    cycle->fit.offset_sigma = reals[REAL_MAP_OFFSET_SIGMA];
    cycle->fit.heading_sigma = reals[REAL_MAP_HEADING_SIGMA];
    cycle->fit.has_map_error =
        cycle->fit.point_sigma + cycle->fit.offset_sigma + cycle->fit.heading_sigma > 0.0;
    return is_right && maplines_is_covariance(3, cycle->cov, scratch);
}

/* ---- the place on the route ------------------------------------------------------------------ */

/// The place on the route that is nearest to a pose, of all or of those near the last one; false
/// if the pose is not on the route.
static bool find_place(const double pose[3], bool is_near, double last, double *s)
{
    const maplines_route_t *route = &maplines_route;
    double c;
    double sine;
    maplines_sin_cos(pose[2], &sine, &c);
    double least = (double)INFINITY;
    for (size_t i = 0; i + 1 < route->path_count; i++)
    {
        const double *distance = &route->distance[i];
        if (is_near && !(distance[1] >= last - SEARCH_BEHIND && distance[0] <= last + SEARCH_AHEAD))
        {
            continue;
        }
        const double *begin = route->path[i];
        const double dx = route->path[i + 1][0] - begin[0];
        const double dy = route->path[i + 1][1] - begin[1];
        const double square = dx * dx + dy * dy;
        double x = pose[0] - begin[0];
        double y = pose[1] - begin[1];
        double share = (x * dx + y * dy) / (square > DBL_MIN ? square : DBL_MIN);
        share = share > 0.0 ? share : 0.0;
        share = share < 1.0 ? share : 1.0;
        x -= share * dx;
        y -= share * dy;
        const double squared = x * x + y * y;
        if (dx * c + dy * sine > 0.0 && squared <= MAX_OFFSET * MAX_OFFSET && squared < least)
        {
            least = squared;
            *s = distance[0] + share * (distance[1] - distance[0]);
        }
    }
    return least < (double)INFINITY;
}

/// Find the section of the route where a car is, near its last place if it was on the route; false
/// if it is not on the route.
static bool locate(const double pose[3], bool was_on_route, maplines_node_t *node)
{
    const maplines_route_t *route = &maplines_route;
    double s = 0.0;
    node->is_on_route =
        (was_on_route && find_place(pose, true, node->s, &s)) || find_place(pose, false, 0.0, &s);
    node->s = s;
    node->section = 0;
    while (node->section + 1 < route->section_count &&
           route->sections[node->section + 1].start <= s)
    {
        node->section++;
    }
    return node->is_on_route;
}

/* ---- the lines around it --------------------------------------------------------------------- */

/// Lines around a pose.
typedef struct {
    size_t count;
    const maplines_route_line_t *lines;
    maplines_omission_t left_out[MAPLINES_SLOTS];
    double means[MAPLINES_SLOTS][4];
    double covs[MAPLINES_SLOTS][16];
    double x_ranges[MAPLINES_SLOTS][2];
} maplines_around_t;

/// Prepare a line; the memory behind it.
static double *prepare(const maplines_route_line_t *line, double *memory, maplines_path_t *path)
{
    const double(*points)[2] = &maplines_route.points[line->first];
    double *distance = memory;
    distance[0] = 0.0;
    for (size_t i = 1; i < line->count; i++)
    {
        const double dx = points[i][0] - points[i - 1][0];
        const double dy = points[i][1] - points[i - 1][1];
        distance[i] = distance[i - 1] + maplines_hypot(dx, dy);
    }
    memory += line->count;
    maplines_prepare_path(points[0], distance, line->count, memory, path);
    return memory + MAPLINES_PATH_ARRAYS * line->count;
}

/// Compute the lines of the section of the car; false if it is not possible.
static bool compute(maplines_instance_t *instance, const maplines_cycle_t *cycle,
                    maplines_around_t *around)
{
    const maplines_route_t *route = &maplines_route;
    const maplines_route_section_t *section = &route->sections[instance->state.node.section];
    const size_t most = route->most_points;
    maplines_path_t paths[MAPLINES_SLOTS];
    maplines_stretch_t stretches[MAPLINES_SLOTS];
    maplines_refit_t refit;
    double *memory = instance->scratch;
    around->count = section->count;
    around->lines = &route->lines[section->first];
    for (size_t i = 0; i < around->count; i++)
    {
        memory = prepare(&around->lines[i], memory, &paths[i]);
    }
    maplines_work_t work;
    memset(&work, 0, sizeof work);
    work.seen.stretch = stretches;
    work.seen.x = memory;
    work.seen.y = memory + most;
    work.seen.key = memory + 2 * most;
    work.seen.slope = memory + 3 * most;
    work.seen.area = memory + 4 * most;
    work.seen.square = memory + 5 * most;
    work.seen.cube = memory + 6 * most;
    work.values = memory + 7 * most;
    work.poses = (maplines_other_pose_t *)(void *)(work.values + 4 * route->rule.count);
    work.refits = &refit;
    return maplines_map_lines(paths, around->count, cycle, &route->rule, &work, around->left_out,
                              around->means, around->covs, around->x_ranges);
}

/// Publish a line of the map.
static void publish(maplines_instance_t *instance, const maplines_around_t *around, size_t i)
{
    maplines_input_t line;
    memset(&line, 0, sizeof line);
    line.slot = around->lines[i].slot;
    line.kind = around->lines[i].kind;
    line.status = MAPLINES_FULL;
    line.x_min = around->x_ranges[i][0];
    line.x_max = around->x_ranges[i][1];
    line.age = instance->state.values.reals[REAL_POSE_AGE];
    line.has_age = true;
    memcpy(line.mean, around->means[i], sizeof line.mean);
    memcpy(line.cov, around->covs[i], sizeof line.cov);
    maplines_publish(&instance->state.node.queue, &line, instance->state.now);
}

/// Publish lines, and say why others are not given; slots without a line send nothing.
static void publish_all(maplines_instance_t *instance, const maplines_around_t *around)
{
    int64_t *reasons = &instance->state.values.choices[CHOICE_SLOTS + SLOT_CHOICE_LEFT_OUT];
    uint32_t has_line = 0;
    for (size_t i = 0; i < around->count; i++)
    {
        const int slot = (int)around->lines[i].slot;
        has_line |= (uint32_t)1 << slot;
        reasons[SLOT_CHOICES * slot] = (int64_t)around->left_out[i];
        if (around->left_out[i] == MAPLINES_GIVEN)
        {
            publish(instance, around, i);
        }
    }
    for (int slot = 0; slot < MAPLINES_SLOTS; slot++)
    {
        if ((has_line >> slot & 1U) == 0)
        {
            reasons[SLOT_CHOICES * slot] = NO_LINE;
            maplines_drop(&instance->state.node.queue, slot);
        }
    }
}

/// Note that a pose has no lines, and why.
static void refuse_pose(maplines_instance_t *instance, const char *why)
{
    instance->state.values.counts[COUNT_NOT_COMPUTED]++;
    maplines_log(instance, fmi3Warning, "the pose is not used: %s", why);
}

/// Compute the lines around the pose that is set; false if there are none.
static bool take_pose(maplines_instance_t *instance, maplines_around_t *around)
{
    maplines_node_t *node = &instance->state.node;
    maplines_values_t *values = &instance->state.values;
    maplines_cycle_t cycle;
    const bool was_on_route = node->is_on_route;
    node->is_on_route = false;
    if (!values->flags[FLAG_POSE_VALID])
    {
        return false;
    }
    if (!read_cycle(values, &cycle))
    {
        refuse_pose(instance, "its age is negative, or it is no Gaussian");
        return false;
    }
    if (!locate(cycle.mean, was_on_route, node))
    {
        values->counts[COUNT_OFF_ROUTE]++;
        return false;
    }
    if (!compute(instance, &cycle, around))
    {
        refuse_pose(instance, "it is too uncertain for numbers of the lines");
        return false;
    }
    return true;
}

void maplines_take_inputs(maplines_instance_t *instance)
{
    maplines_node_t *node = &instance->state.node;
    maplines_values_t *values = &instance->state.values;
    maplines_around_t around;
    if (node->set == 0)
    {
        return;
    }
    node->set = 0;
    memset(&around, 0, sizeof around);
    if (!take_pose(instance, &around))
    {
        around.count = 0;
    }
    publish_all(instance, &around);
    values->flags[FLAG_ON_ROUTE] = node->is_on_route;
    values->reals[REAL_ROUTE_S] = node->is_on_route ? node->s : 0.0;
    values->counts[COUNT_SECTION] = node->is_on_route ? node->section + 1 : 0;
}
