/* Propagation: lines of a map and refits, for maplines_can/propagation/in_c.py.
 *
 * A function returns None where C does not do what the Python functions do: they raise an error or
 * warn, or an argument is not what C reads. Then they are called instead.
 */
#include "propagation.h"
#include "native.h"

#include <stdlib.h>

#define PATHS "maplines_can._native.paths"
#define REFIT "maplines_can._native.refit"

/// Read a pose (3,).
static bool read_pose(PyObject *array, double pose[3])
{
    static const Py_ssize_t three = 3;
    return maplines_read_doubles(array, PyBUF_C_CONTIGUOUS, 1, &three, pose);
}

/// Read the mean (3,) and the covariance (3, 3) of a pose.
static bool read_gaussian(PyObject *const arrays[2], double mean[3], double cov[9])
{
    static const Py_ssize_t shape[2] = {3, 3};
    return read_pose(arrays[0], mean) &&
           maplines_read_doubles(arrays[1], PyBUF_C_CONTIGUOUS, 2, shape, cov);
}

/// Read a number of each of some objects; false without an exception if one is none.
static bool read_numbers(PyObject *const *objects, Py_ssize_t count, double *numbers)
{
    for (Py_ssize_t i = 0; i < count; i++)
    {
        numbers[i] = PyFloat_AsDouble(objects[i]);
    }
    const bool is_read = PyErr_Occurred() == NULL;
    PyErr_Clear();
    return is_read;
}

/* ---- lines of a map ---------------------------------------------------------------------------
 */

/// Lines of a map, with their memory.
typedef struct {
    size_t count;
    size_t points; ///< of all lines
    maplines_path_t *paths;
    double *memory;
} paths_t;

static void free_paths(paths_t *lines)
{
    if (lines != NULL)
    {
        free(lines->paths);
        free(lines->memory);
        free(lines);
    }
}

static void delete_paths(PyObject *capsule)
{
    free_paths(PyCapsule_GetPointer(capsule, PATHS));
}

/// Prepare line `i` of (n, 2) points and (n,) arc lengths, with the memory from `*used` on.
static bool prepare(paths_t *lines, size_t i, PyObject *points, PyObject *distance, size_t *used)
{
    Py_buffer xy;
    Py_buffer s;
    if (!maplines_hold_doubles(points, 2, &xy))
    {
        return false;
    }
    const bool is_held = maplines_hold_doubles(distance, 1, &s);
    const size_t count = (size_t)xy.shape[0];
    const bool fits = is_held && xy.shape[1] == 2 && s.shape[0] == xy.shape[0] && count >= 2 &&
                      count <= lines->points - *used;
    const bool is_prepared =
        fits &&
        maplines_prepare_path(xy.buf, s.buf, count, lines->memory + *used * MAPLINES_PATH_ARRAYS,
                              &lines->paths[i]);
    *used += count;
    if (is_held)
    {
        PyBuffer_Release(&s);
    }
    PyBuffer_Release(&xy);
    return is_prepared;
}

/// Memory for the lines of a tuple of arrays; NULL with MemoryError.
static paths_t *new_paths(size_t count, size_t points)
{
    paths_t *lines = calloc(1, sizeof *lines);
    if (lines != NULL)
    {
        lines->count = count;
        lines->points = points;
        lines->paths = malloc((count + 1) * sizeof *lines->paths);
        lines->memory = malloc((points + 1) * MAPLINES_PATH_ARRAYS * sizeof *lines->memory);
        if (lines->paths != NULL && lines->memory != NULL)
        {
            return lines;
        }
        free_paths(lines);
    }
    PyErr_NoMemory();
    return NULL;
}

/// paths(lines: tuple of (points, distance), number of points of all) -> capsule, or None
static PyObject *paths(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (count != 2 || !PyTuple_Check(args[0]))
    {
        PyErr_SetString(PyExc_TypeError, "paths takes a tuple of lines and the number of points");
        return NULL;
    }
    const size_t points = PyLong_AsSize_t(args[1]);
    if (PyErr_Occurred() != NULL)
    {
        return NULL;
    }
    const Py_ssize_t number = PyTuple_Size(args[0]);
    paths_t *lines = new_paths((size_t)number, points);
    size_t used = 0;
    for (Py_ssize_t i = 0; lines != NULL && i < number; i++)
    {
        PyObject *line = PyTuple_GetItem(args[0], i);
        if (!PyTuple_Check(line) || PyTuple_Size(line) != 2 ||
            !prepare(lines, (size_t)i, PyTuple_GetItem(line, 0), PyTuple_GetItem(line, 1), &used))
        {
            free_paths(lines);
            return Py_NewRef(Py_None);
        }
    }
    PyObject *capsule = lines == NULL ? NULL : PyCapsule_New(lines, PATHS, delete_paths);
    if (capsule == NULL)
    {
        free_paths(lines);
    }
    return capsule;
}

/* ---- rules and memory -------------------------------------------------------------------------
 */

/// Points and weights of a transform, and the arrays that have them.
typedef struct {
    maplines_rule_t rule;
    Py_buffer views[3];
    int held;
} held_rule_t;

static void release_rule(held_rule_t *held)
{
    for (int i = 0; i < held->held; i++)
    {
        PyBuffer_Release(&held->views[i]);
    }
    held->held = 0;
}

/// Hold the arrays of a rule: (N, 3) points, (N,) weights of mean and covariance.
static bool hold_rule(PyObject *arrays, held_rule_t *held)
{
    held->held = 0;
    if (!PyTuple_Check(arrays) || PyTuple_Size(arrays) != 3)
    {
        return false;
    }
    for (int i = 0; i < 3; i++)
    {
        if (!maplines_hold_doubles(PyTuple_GetItem(arrays, i), i == 0 ? 2 : 1, &held->views[i]))
        {
            release_rule(held);
            return false;
        }
        held->held = i + 1;
    }
    const Py_ssize_t count = held->views[0].shape[0];
    if (count < 1 || held->views[0].shape[1] != 3 || held->views[1].shape[0] != count ||
        held->views[2].shape[0] != count)
    {
        release_rule(held);
        return false;
    }
    held->rule.count = (size_t)count;
    held->rule.z = held->views[0].buf;
    held->rule.mean_weights = held->views[1].buf;
    held->rule.cov_weights = held->views[2].buf;
    return true;
}

/// Memory of stretches of some lines, in one piece: `doubles` more are at the end.
static double *new_stretches(size_t lines, size_t points, size_t doubles,
                             maplines_stretches_t *seen)
{
    double *memory = malloc((4 * points + doubles + 1) * sizeof *memory);
    seen->stretch = malloc((lines + 1) * sizeof *seen->stretch);
    if (memory == NULL || seen->stretch == NULL)
    {
        free(memory);
        free(seen->stretch);
        PyErr_NoMemory();
        return NULL;
    }
    seen->x = memory;
    seen->y = seen->x + points;
    seen->key = seen->y + points;
    seen->slope = seen->key + points;
    return seen->slope + points;
}

static void free_stretches(maplines_stretches_t *seen)
{
    free(seen->x);
    free(seen->stretch);
}

/* ---- a cycle ----------------------------------------------------------------------------------
 */

#define SETTINGS 7 ///< numbers of a cycle: window, misfit, sigma, and three of the map error

/// Read a cycle: mean (3,) and covariance (3, 3) of the pose, a tuple of the settings, of which the
/// last three are missing without a map error.
static bool read_cycle(PyObject *const *args, maplines_cycle_t *cycle)
{
    PyObject *numbers[SETTINGS];
    double settings[SETTINGS] = {0.0};
    if (!PyTuple_Check(args[2]))
    {
        return false;
    }
    const Py_ssize_t count = PyTuple_Size(args[2]);
    for (Py_ssize_t i = 0; i < SETTINGS && i < count; i++)
    {
        numbers[i] = PyTuple_GetItem(args[2], i);
    }
    memset(cycle, 0, sizeof *cycle);
    if ((count != SETTINGS && count != SETTINGS - 3) || !read_numbers(numbers, count, settings) ||
        !read_gaussian(args, cycle->mean, cycle->cov))
    {
        return false;
    }
    memcpy(cycle->window, settings, sizeof cycle->window);
    cycle->fit.max_misfit = settings[2];
    cycle->max_sigma = settings[3];
    cycle->fit.has_map_error = count == SETTINGS;
    cycle->fit.point_sigma = settings[4];
    cycle->fit.offset_sigma = settings[5];
    cycle->fit.heading_sigma = settings[6];
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
        return Py_NewRef(Py_None);
    }
    maplines_pose_view(&cycle, &view);
    maplines_start(&view.look, start, &reach);
    PyObject *place = maplines_array_of(maplines_numpy(module), 1, &two, start);
    PyObject *cov =
        place == NULL ? NULL : maplines_array_of(maplines_numpy(module), 2, shape, view.pose_cov);
    PyObject *found = cov == NULL ? NULL : Py_BuildValue("OdO", place, reach, cov);
    Py_XDECREF(place);
    Py_XDECREF(cov);
    return found;
}

/// What a cycle needs and gives.
typedef struct {
    const paths_t *lines;
    maplines_cycle_t cycle;
    held_rule_t held;
    maplines_work_t work;
    maplines_omission_t *left_out; ///< (lines)
    double *results;
    bool is_scene;
    bool is_done;
} run_t;

static void free_run(run_t *run)
{
    release_rule(&run->held);
    free_stretches(&run->work.seen);
    free(run->work.refits);
    free(run->left_out);
}

/// Read the arguments (paths, mean, cov, settings, rule), and get memory. False with or without an
/// exception; nothing is held then.
static bool begin_run(PyObject *const *args, Py_ssize_t count, bool is_scene, run_t *run)
{
    memset(run, 0, sizeof *run);
    run->is_scene = is_scene;
    run->lines = count == 5 ? PyCapsule_GetPointer(args[0], PATHS) : NULL;
    if (run->lines == NULL)
    {
        PyErr_Clear();
        return false;
    }
    const size_t lines = run->lines->count;
    if ((is_scene && lines > MAPLINES_SCENE_LINES) || !read_cycle(args + 1, &run->cycle) ||
        !hold_rule(args[4], &run->held))
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
    double *rest =
        new_stretches(lines, points, points + 3 * poses + 4 * poses * propagated + matrix + results,
                      &run->work.seen);
    if (rest == NULL)
    {
        release_rule(&run->held);
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

/// Tuple of the reasons and of arrays, whose axes, shapes and values are given.
static PyObject *results_of(PyObject *module, const run_t *run, int count, const int *axes,
                            Py_ssize_t (*shapes)[3], const double *const *values)
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
        PyObject *array = maplines_array_of(maplines_numpy(module), axes[i], shapes[i], values[i]);
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
        return PyErr_Occurred() != NULL ? NULL : Py_NewRef(Py_None);
    }
    const size_t lines = run.lines->count;
    double(*means)[4] = (double(*)[4])run.results;
    double(*covs)[16] = (double(*)[16])(run.results + 4 * lines);
    double(*x_ranges)[2] = (double(*)[2])(run.results + 20 * lines);
    Py_BEGIN_ALLOW_THREADS;
    run.is_done = maplines_map_lines(run.lines->paths, lines, &run.cycle, &run.held.rule, &run.work,
                                     run.left_out, means, covs, x_ranges);
    Py_END_ALLOW_THREADS;
    Py_ssize_t given = 0;
    for (size_t i = 0; run.is_done && i < lines; i++)
    {
        if (run.left_out[i] == MAPLINES_GIVEN)
        {
            memmove(means[given], means[i], sizeof means[i]);
            memmove(covs[given], covs[i], sizeof covs[i]);
            memmove(x_ranges[given], x_ranges[i], sizeof x_ranges[i]);
            given++;
        }
    }
    static const int axes[3] = {2, 3, 2};
    Py_ssize_t shapes[3][3] = {{given, 4, 0}, {given, 4, 4}, {given, 2, 0}};
    const double *const values[3] = {means[0], covs[0], x_ranges[0]};
    PyObject *found =
        run.is_done ? results_of(module, &run, 3, axes, shapes, values) : Py_NewRef(Py_None);
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
        return PyErr_Occurred() != NULL ? NULL : Py_NewRef(Py_None);
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
    Py_BEGIN_ALLOW_THREADS;
    run.is_done = maplines_map_scene(run.lines->paths, lines, &run.cycle, &run.held.rule, &run.work,
                                     run.left_out, &joint);
    Py_END_ALLOW_THREADS;
    static const int axes[6] = {2, 2, 2, 2, 1, 3};
    const Py_ssize_t k = (Py_ssize_t)joint.lines;
    Py_ssize_t shapes[6][3] = {{k, 4, 0}, {4 * k, 4 * k, 0}, {k, 2, 0},
                               {k, 2, 0}, {k, 0, 0},         {k, 4, 4}};
    const double *const values[6] = {means, cov, x_ranges, fit_ranges, quartics, specific_covs};
    PyObject *found =
        run.is_done ? results_of(module, &run, 6, axes, shapes, values) : Py_NewRef(Py_None);
    free_run(&run);
    return found;
}

/* ---- refits -----------------------------------------------------------------------------------
 */

/// Lines as functions of the pose.
typedef struct {
    size_t lines;
    maplines_mean_pose_t from;
    maplines_refit_t refits[];
} refits_t;

static void delete_refits(PyObject *capsule)
{
    free(PyCapsule_GetPointer(capsule, REFIT));
}

#define FIT_SETTINGS 6 ///< numbers of a fit: misfit, room, step, and three of the map error

static bool read_fit(PyObject *tuple, maplines_fit_t *fit)
{
    PyObject *numbers[FIT_SETTINGS];
    double settings[FIT_SETTINGS] = {0.0};
    const Py_ssize_t count = PyTuple_Check(tuple) ? PyTuple_Size(tuple) : 0;
    for (Py_ssize_t i = 0; i < FIT_SETTINGS && i < count; i++)
    {
        numbers[i] = PyTuple_GetItem(tuple, i);
    }
    if ((count != FIT_SETTINGS && count != FIT_SETTINGS - 3) ||
        !read_numbers(numbers, count, settings))
    {
        return false;
    }
    const maplines_fit_t read = {settings[0], settings[1], settings[2], count == FIT_SETTINGS,
                                 settings[3], settings[4], settings[5]};
    *fit = read;
    return fit->max_misfit > 0.0 && fabs(fit->room) < (double)INFINITY && fit->step >= 0.0 &&
           fit->step < (double)INFINITY;
}

/// Capsule of the refits of stretches, or None; frees the stretches.
static PyObject *refits_of(maplines_stretches_t *seen, double *scratch, const double pose[3],
                           const maplines_fit_t *fit)
{
    refits_t *made = malloc(sizeof *made + seen->lines * sizeof made->refits[0]);
    bool is_done = made != NULL;
    if (is_done)
    {
        made->lines = seen->lines;
        made->from = maplines_mean_pose(pose);
        Py_BEGIN_ALLOW_THREADS;
        for (size_t i = 0; is_done && i < seen->lines; i++)
        {
            is_done = maplines_refit(seen, i, &made->from, fit, scratch, &made->refits[i]);
        }
        Py_END_ALLOW_THREADS;
    }
    free_stretches(seen);
    PyObject *capsule = is_done ? PyCapsule_New(made, REFIT, delete_refits) : NULL;
    if (capsule == NULL)
    {
        const bool is_lost = made == NULL || is_done;
        free(made);
        if (is_lost)
        {
            return PyErr_Occurred() != NULL ? NULL : PyErr_NoMemory();
        }
        return Py_NewRef(Py_None);
    }
    return capsule;
}

/// refit(paths, pose, (x_min, x_max, max_turn), fit) -> capsule, or None, also if a line cannot be
/// given
static PyObject *refit(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    double pose[3];
    double window[3];
    maplines_fit_t fit;
    const paths_t *lines = count == 4 ? PyCapsule_GetPointer(args[0], PATHS) : NULL;
    PyErr_Clear();
    if (lines == NULL || !read_pose(args[1], pose) || !PyTuple_Check(args[2]) ||
        PyTuple_Size(args[2]) != 3 || !read_fit(args[3], &fit))
    {
        return Py_NewRef(Py_None);
    }
    PyObject *const ends[3] = {PyTuple_GetItem(args[2], 0), PyTuple_GetItem(args[2], 1),
                               PyTuple_GetItem(args[2], 2)};
    const bool is_read = read_numbers(ends, 3, window);
    const maplines_look_t look = {
        {pose[0], pose[1], pose[2]}, {window[0], window[1]}, is_read ? window[2] : 0.0};
    bool is_finite = is_read && look.window[0] < look.window[1];
    for (int i = 0; i < 3; i++)
    {
        is_finite = is_finite && fabs(pose[i]) < (double)INFINITY;
        is_finite = is_finite && fabs(window[i]) < (double)INFINITY;
    }
    if (!is_finite)
    {
        return Py_NewRef(Py_None);
    }
    maplines_stretches_t seen;
    maplines_omission_t *left_out = malloc((lines->count + 1) * sizeof *left_out);
    double *scratch =
        left_out == NULL ? NULL : new_stretches(lines->count, lines->points, lines->points, &seen);
    if (scratch == NULL)
    {
        free(left_out);
        return PyErr_Occurred() != NULL ? NULL : PyErr_NoMemory();
    }
    Py_BEGIN_ALLOW_THREADS;
    maplines_see(lines->paths, lines->count, &look, &seen, left_out);
    Py_END_ALLOW_THREADS;
    free(left_out);
    if (seen.lines < lines->count)
    {
        free_stretches(&seen);
        return Py_NewRef(Py_None);
    }
    return refits_of(&seen, scratch, pose, &fit);
}

/// refit_of_stretches(x, y, first, x_range, pose, fit) -> capsule, or None; `first` are (L + 1,)
/// numbers: the index of the first point of each stretch, and the number of points
static PyObject *refit_of_stretches(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    Py_buffer views[4];
    int held = 0;
    double pose[3];
    maplines_fit_t fit;
    PyObject *made = NULL;
    bool is_held = count == 6 && read_pose(args[4], pose) && read_fit(args[5], &fit);
    while (is_held && held < 4)
    {
        is_held = maplines_hold_doubles(args[held], held < 3 ? 1 : 2, &views[held]);
        held += is_held ? 1 : 0;
    }
    if (is_held && views[0].shape[0] == views[1].shape[0] &&
        views[2].shape[0] == views[3].shape[0] + 1 && views[3].shape[1] == 2)
    {
        const size_t points = (size_t)views[0].shape[0];
        const size_t lines = (size_t)views[3].shape[0];
        const double *first = views[2].buf;
        const double *x_range = views[3].buf;
        maplines_stretches_t seen;
        double *scratch = new_stretches(lines, points, points, &seen);
        bool is_valid = scratch != NULL && first[0] == 0.0 && first[lines] == (double)points;
        if (is_valid)
        {
            seen.lines = lines;
            seen.points = points;
            memcpy(seen.x, views[0].buf, points * sizeof *seen.x);
            memcpy(seen.y, views[1].buf, points * sizeof *seen.y);
            for (size_t i = 0; i < lines; i++)
            {
                is_valid = is_valid && first[i + 1] > first[i];
                const double size = is_valid ? first[i + 1] - first[i] : 0.0;
                const maplines_stretch_t stretch = {is_valid ? (size_t)first[i] : 0,
                                                    (size_t)size,
                                                    {x_range[2 * i], x_range[2 * i + 1]},
                                                    i};
                seen.stretch[i] = stretch;
            }
        }
        if (is_valid)
        {
            maplines_index_stretches(&seen);
            made = refits_of(&seen, scratch, pose, &fit);
        }
        else if (scratch != NULL)
        {
            free_stretches(&seen);
        }
    }
    for (int i = 0; i < held; i++)
    {
        PyBuffer_Release(&views[i]);
    }
    return made != NULL || PyErr_Occurred() != NULL ? made : Py_NewRef(Py_None);
}

/// Hold an array that is written.
static bool hold_written(PyObject *array, Py_ssize_t size, Py_buffer *view)
{
    if (PyObject_GetBuffer(array, view, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE) < 0)
    {
        PyErr_Clear();
        return false;
    }
    if (view->len == size * (Py_ssize_t)sizeof(double))
    {
        return true;
    }
    PyBuffer_Release(view);
    return false;
}

/// refit_values(refit, poses (N, 3), lines (N, L, 4)): set the lines seen from poses; NaN where
/// they are no functions of x. Returns whether the arrays are read.
static PyObject *refit_values(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    const refits_t *own = count == 3 ? PyCapsule_GetPointer(args[0], REFIT) : NULL;
    Py_buffer poses;
    Py_buffer values;
    if (own == NULL)
    {
        return PyErr_Occurred() != NULL ? NULL : Py_NewRef(Py_None);
    }
    if (!maplines_hold_doubles(args[1], 2, &poses))
    {
        return PyBool_FromLong(0);
    }
    const size_t number = (size_t)poses.shape[0];
    const bool is_held = poses.shape[1] == 3 &&
                         hold_written(args[2], (Py_ssize_t)(4 * number * own->lines), &values);
    if (is_held)
    {
        const double *pose = poses.buf;
        double *line = values.buf;
        Py_BEGIN_ALLOW_THREADS;
        for (size_t k = 0; k < number; k++)
        {
            for (size_t i = 0; i < own->lines; i++)
            {
                (void)maplines_refit_at(&own->refits[i], &own->from, pose + 3 * k,
                                        line + 4 * (k * own->lines + i));
            }
        }
        Py_END_ALLOW_THREADS;
        PyBuffer_Release(&values);
    }
    PyBuffer_Release(&poses);
    return PyBool_FromLong(is_held);
}

/// Moments of all lines of a refit; false if one has no value at a point.
static bool moments_of_lines(const refits_t *own, const maplines_rule_t *rule, const double mean[3],
                             const double cov[9], double *memory, double *means, double *covs)
{
    double root[9];
    double *poses = memory;
    double *values = memory + 3 * rule->count;
    maplines_square_root(3, cov, root);
    maplines_rule_points(rule, mean, root, poses);
    for (size_t i = 0; i < own->lines; i++)
    {
        for (size_t k = 0; k < rule->count; k++)
        {
            double *line = values + 4 * k;
            if (!maplines_refit_at(&own->refits[i], &own->from, poses + 3 * k, line) ||
                !(line[0] == line[0] && line[1] == line[1] && line[2] == line[2] &&
                  line[3] == line[3]))
            {
                return false;
            }
        }
        maplines_weighted_moments(rule, 4, 4, values, means + 4 * i, covs + 16 * i);
    }
    return true;
}

/// refit_moments(refit, mean, cov, rule, means (L, 4), covs (L, 4, 4)): set the moments, without
/// the noise. Returns whether all lines have a value at all points.
static PyObject *refit_moments(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    const refits_t *own = count == 6 ? PyCapsule_GetPointer(args[0], REFIT) : NULL;
    double mean[3];
    double cov[9];
    held_rule_t held;
    Py_buffer means;
    Py_buffer covs;
    bool is_done = false;
    if (own == NULL)
    {
        return PyErr_Occurred() != NULL ? NULL : Py_NewRef(Py_None);
    }
    const Py_ssize_t lines = (Py_ssize_t)own->lines;
    if (!read_gaussian(args + 1, mean, cov) || !hold_rule(args[3], &held))
    {
        return PyBool_FromLong(0);
    }
    double *memory = malloc(7 * held.rule.count * sizeof *memory);
    if (memory == NULL)
    {
        PyErr_NoMemory();
    }
    else if (hold_written(args[4], 4 * lines, &means))
    {
        if (hold_written(args[5], 16 * lines, &covs))
        {
            Py_BEGIN_ALLOW_THREADS;
            is_done = moments_of_lines(own, &held.rule, mean, cov, memory, means.buf, covs.buf);
            Py_END_ALLOW_THREADS;
            PyBuffer_Release(&covs);
        }
        PyBuffer_Release(&means);
    }
    free(memory);
    release_rule(&held);
    return PyErr_Occurred() != NULL ? NULL : PyBool_FromLong(is_done);
}

/// What refit_field returns.
enum field {
    X_RANGE,
    MISFIT,
    POINTS,
    IS_ACROSS,
    NOISE_COV,
    QUARTIC,
    FIELDS
};

static void read_field(const maplines_refit_t *refit, int field, double *values)
{
    switch (field)
    {
    case X_RANGE:
        memcpy(values, refit->fitted.x_range, sizeof refit->fitted.x_range);
        break;
    case MISFIT:
        values[0] = refit->fitted.misfit;
        break;
    case POINTS:
        for (int i = 0; i < MAPLINES_NODES; i++)
        {
            values[2 * i] = refit->fitted.x[i];
            values[2 * i + 1] = refit->y[i];
        }
        break;
    case IS_ACROSS:
        values[0] = refit->is_across ? 1.0 : 0.0;
        break;
    case NOISE_COV:
        memcpy(values, refit->noise_cov, sizeof refit->noise_cov);
        break;
    default:
        values[0] = maplines_refit_quartic(refit);
        break;
    }
}

/// refit_field(refit, field) -> array (L, ...)
static PyObject *refit_field(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    static const Py_ssize_t shapes[FIELDS][2] = {{2, 1}, {1, 1}, {MAPLINES_NODES, 2},
                                                 {1, 1}, {4, 4}, {1, 1}};
    static const int axes[FIELDS] = {2, 1, 3, 1, 3, 1};
    const refits_t *own = count == 2 ? PyCapsule_GetPointer(args[0], REFIT) : NULL;
    const long field = own == NULL ? -1 : PyLong_AsLong(args[1]);
    if (field < 0 || field >= FIELDS)
    {
        if (PyErr_Occurred() == NULL)
        {
            PyErr_SetString(PyExc_ValueError, "refit_field takes a refit and a field");
        }
        return NULL;
    }
    const Py_ssize_t *shape = shapes[field];
    const size_t size = (size_t)(shape[0] * shape[1]);
    double *values = malloc((own->lines * size + 1) * sizeof *values);
    if (values == NULL)
    {
        return PyErr_NoMemory();
    }
    for (size_t i = 0; i < own->lines; i++)
    {
        read_field(&own->refits[i], (int)field, values + i * size);
    }
    const Py_ssize_t all[3] = {(Py_ssize_t)own->lines, shape[0], shape[1]};
    PyObject *array = maplines_array_of(maplines_numpy(module), axes[field], all, values);
    free(values);
    return array;
}

/* ---- the module -------------------------------------------------------------------------------
 */

int maplines_add_propagation(PyObject *module)
{
#define FUNCTION(name)                                                                             \
    {                                                                                              \
#name, (PyCFunction)(void (*)(void))name, METH_FASTCALL, NULL                              \
    }
    static PyMethodDef functions[] = {
        FUNCTION(paths),        FUNCTION(pose_view),     FUNCTION(map_lines),
        FUNCTION(map_scene),    FUNCTION(refit),         FUNCTION(refit_of_stretches),
        FUNCTION(refit_values), FUNCTION(refit_moments), FUNCTION(refit_field),
        {NULL, NULL, 0, NULL},
    };
#undef FUNCTION
    return PyModule_AddFunctions(module, functions);
}
