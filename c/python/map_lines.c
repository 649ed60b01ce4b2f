/* Lines and scenes of a map around an uncertain pose. */
#include "map_input.h"

#include <stdlib.h>

/// Read a cycle: mean (3,) and covariance (3, 3) of the pose, and the settings: window, misfit and
/// greatest standard deviation.
static bool read_cycle(PyObject *const *args, maplines_cycle_t *cycle)
{
    double settings[4];
    memset(cycle, 0, sizeof *cycle);
    if (!maplines_read_settings(args[2], 4, settings, &cycle->fit) ||
        !maplines_read_pose_gaussian(args, cycle->mean, cycle->cov))
    {
        return false;
    }
    memcpy(cycle->window, settings, sizeof cycle->window);
    cycle->fit.max_misfit = settings[2];
    cycle->max_sigma = settings[3];
    return -(double)INFINITY < cycle->window[0] && cycle->window[0] < cycle->window[1] &&
           cycle->window[1] < (double)INFINITY && cycle->fit.max_misfit > 0.0;
}

/// pose_view(mean, cov, settings) -> (place on the map from which lines are followed (2,), how far
/// along them, covariance of the pose in the ego frame (3, 3)), or None
static PyObject *pose_view(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    static const Py_ssize_t shape[2] = {3, 3};
    static const Py_ssize_t two = 2;
    maplines_cycle_t cycle;
    maplines_pose_view_t view;
    double start[2];
    double reach;
    if (count != 3 || !read_cycle(args, &cycle))
    {
        return maplines_none();
    }
    maplines_pose_view(&cycle, &view);
    maplines_look_start(&view.look, start, &reach);
    PyObject *place = maplines_array_of(maplines_numpy(module), 1, &two, start);
    PyObject *cov =
        place == NULL ? NULL : maplines_array_of(maplines_numpy(module), 2, shape, view.pose_cov);
    return Py_BuildValue("NdN", place, reach, cov);
}

/// What a cycle needs and gives.
typedef struct {
    const maplines_paths_t *lines;
    maplines_cycle_t cycle;
    maplines_held_rule_t held;
    maplines_work_t work;
    maplines_omission_t *left_out; ///< (lines)
    double *results;
} run_t;

static void free_run(run_t *run)
{
    maplines_release_all(3, run->held.views);
    maplines_free_stretches(&run->work.seen);
    free(run->work.refits);
    free(run->left_out);
}

/// Read the arguments (paths, mean, cov, settings, rule), and get memory. False with or without an
/// exception; nothing is held then.
static bool begin_run(PyObject *const *args, Py_ssize_t count, bool is_scene, run_t *run)
{
    memset(run, 0, sizeof *run);
    run->lines = count == 5 ? maplines_paths_of(args[0]) : NULL;
    if (run->lines == NULL)
    {
        return false;
    }
    const size_t lines = run->lines->count;
    if ((is_scene && lines > MAPLINES_SCENE_LINES) || !read_cycle(args + 1, &run->cycle) ||
        !maplines_hold_rule(args[4], &run->held))
    {
        return false;
    }
    const size_t points = run->lines->points;
    const size_t poses = run->held.rule.count;
    const size_t propagated = is_scene ? lines : 1;
    const size_t states = 4 * lines;
    const size_t matrix = is_scene ? states * states : 0;
    // Mean, covariance and range of each line; of a scene, also the fit range, the coefficient of
    // T_4 and the line-specific covariance, and the joint covariance.
    const size_t results = (is_scene ? 27 : 22) * lines + matrix;
    double *rest = maplines_new_stretches(
        lines, points, points + 3 * poses + 4 * poses * propagated + matrix + results,
        &run->work.seen);
    if (rest == NULL)
    {
        maplines_release_all(3, run->held.views);
        return false;
    }
    run->work.scratch = rest;
    run->work.poses = run->work.scratch + points;
    run->work.values = run->work.poses + 3 * poses;
    run->work.matrix = run->work.values + 4 * poses * propagated;
    run->results = run->work.matrix + matrix;
    run->work.refits = malloc((propagated + 1) * sizeof *run->work.refits);
    run->left_out = malloc((lines + 1) * sizeof *run->left_out);
    if (run->work.refits == NULL || run->left_out == NULL)
    {
        free_run(run);
        PyErr_NoMemory();
        return false;
    }
    return true;
}

/// Reasons of all lines, as bytes.
static PyObject *reasons_of(const run_t *run)
{
    PyObject *reasons = PyBytes_FromStringAndSize(NULL, (Py_ssize_t)run->lines->count);
    char *bytes = reasons == NULL ? NULL : PyBytes_AsString(reasons);
    for (size_t i = 0; bytes != NULL && i < run->lines->count; i++)
    {
        bytes[i] = (char)run->left_out[i];
    }
    return reasons;
}

/// What an array is made of.
typedef struct {
    const double *values;
    int axes;
    Py_ssize_t shape[3];
} result_t;

/// Tuple of the reasons and of arrays.
static PyObject *results_of(PyObject *module, const run_t *run, int count, const result_t *results)
{
    PyObject *found = PyTuple_New(count + 1);
    PyObject *reasons = found == NULL ? NULL : reasons_of(run);
    if (reasons == NULL || PyTuple_SetItem(found, 0, reasons) < 0)
    {
        Py_XDECREF(found);
        return NULL;
    }
    for (int i = 0; i < count; i++)
    {
        const result_t *result = &results[i];
        PyObject *array =
            maplines_array_of(maplines_numpy(module), result->axes, result->shape, result->values);
        if (array == NULL || PyTuple_SetItem(found, i + 1, array) < 0)
        {
            Py_DECREF(found);
            return NULL;
        }
    }
    return found;
}

/// map_lines(paths, mean, cov, settings, rule) -> (reasons, means (K, 4), covs (K, 4, 4), x_ranges
/// (K, 2)) of the K lines that are given, or None
static PyObject *map_lines(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    run_t run;
    if (!begin_run(args, count, false, &run))
    {
        return maplines_none();
    }
    const size_t lines = run.lines->count;
    double(*means)[4] = (double(*)[4])run.results;
    double(*covs)[16] = (double(*)[16])(run.results + 4 * lines);
    double(*x_ranges)[2] = (double(*)[2])(run.results + 20 * lines);
    bool is_done = false;
    Py_BEGIN_ALLOW_THREADS;
    is_done = maplines_map_lines(run.lines->paths, lines, &run.cycle, &run.held.rule, &run.work,
                                 run.left_out, means, covs, x_ranges);
    Py_END_ALLOW_THREADS;
    Py_ssize_t given = 0;
    for (size_t i = 0; is_done && i < lines; i++)
    {
        if (run.left_out[i] == MAPLINES_GIVEN)
        {
            memmove(means[given], means[i], sizeof means[i]);
            memmove(covs[given], covs[i], sizeof covs[i]);
            memmove(x_ranges[given], x_ranges[i], sizeof x_ranges[i]);
            given++;
        }
    }
    const result_t results[3] = {
        {means[0], 2, {given, 4}}, {covs[0], 3, {given, 4, 4}}, {x_ranges[0], 2, {given, 2}}};
    PyObject *found = is_done ? results_of(module, &run, 3, results) : maplines_none();
    free_run(&run);
    return found;
}

/// map_scene(paths, mean, cov, settings, rule) -> (reasons, means (K, 4), cov (4 K, 4 K), x_ranges
/// (K, 2), fit_ranges (K, 2), quartics (K,), specific_covs (K, 4, 4)) of the K lines of the scene,
/// or None
static PyObject *map_scene(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    run_t run;
    if (!begin_run(args, count, true, &run))
    {
        return maplines_none();
    }
    const size_t lines = run.lines->count;
    double *means = run.results;
    double *x_ranges = means + 4 * lines;
    double *fit_ranges = x_ranges + 2 * lines;
    double *quartics = fit_ranges + 2 * lines;
    double *specific_covs = quartics + lines;
    double *cov = specific_covs + 16 * lines;
    maplines_joint_t joint = {
        0, means, cov, (double(*)[2])x_ranges, (double(*)[2])fit_ranges, quartics, specific_covs};
    bool is_done = false;
    Py_BEGIN_ALLOW_THREADS;
    is_done = maplines_map_scene(run.lines->paths, lines, &run.cycle, &run.held.rule, &run.work,
                                 run.left_out, &joint);
    Py_END_ALLOW_THREADS;
    const Py_ssize_t k = (Py_ssize_t)joint.lines;
    const result_t results[6] = {
        {means, 2, {k, 4}},      {cov, 2, {4 * k, 4 * k}}, {x_ranges, 2, {k, 2}},
        {fit_ranges, 2, {k, 2}}, {quartics, 1, {k}},       {specific_covs, 3, {k, 4, 4}},
    };
    PyObject *found = is_done ? results_of(module, &run, 6, results) : maplines_none();
    free_run(&run);
    return found;
}

static PyMethodDef functions[] = {
    {"pose_view", (PyCFunction)(void (*)(void))pose_view, METH_FASTCALL, NULL},
    {"map_lines", (PyCFunction)(void (*)(void))map_lines, METH_FASTCALL, NULL},
    {"map_scene", (PyCFunction)(void (*)(void))map_scene, METH_FASTCALL, NULL},
    {NULL, NULL, 0, NULL},
};

int maplines_add_map_lines(PyObject *module)
{
    return PyModule_AddFunctions(module, functions);
}
