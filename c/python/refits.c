/* Refits: lines of a map as functions of the pose. */
#include "map_input.h"

#include <stdlib.h>

#define REFIT "maplines_can._native.refit"

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

/// Read how lines are fitted: misfit, room and step.
static bool read_fit(PyObject *tuple, maplines_fit_t *fit)
{
    double settings[3];
    if (!maplines_read_settings(tuple, 3, settings, fit))
    {
        return false;
    }
    fit->max_misfit = settings[0];
    fit->room = settings[1];
    fit->step = settings[2];
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
    maplines_free_stretches(seen);
    if (made == NULL)
    {
        return PyErr_NoMemory();
    }
    PyObject *capsule = is_done ? PyCapsule_New(made, REFIT, delete_refits) : Py_NewRef(Py_None);
    if (!is_done || capsule == NULL)
    {
        free(made);
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
    const maplines_paths_t *lines = count == 4 ? maplines_paths_of(args[0]) : NULL;
    if (lines == NULL || !maplines_read_pose(args[1], pose) ||
        !maplines_read_tuple(args[2], 3, window) || !read_fit(args[3], &fit))
    {
        return maplines_none();
    }
    const maplines_look_t look = {{pose[0], pose[1], pose[2]}, {window[0], window[1]}, window[2]};
    bool is_finite = window[0] < window[1];
    for (int i = 0; i < 3; i++)
    {
        is_finite = is_finite && fabs(pose[i]) < (double)INFINITY;
        is_finite = is_finite && fabs(window[i]) < (double)INFINITY;
    }
    if (!is_finite)
    {
        return maplines_none();
    }
    maplines_stretches_t seen;
    maplines_omission_t *left_out = malloc((lines->count + 1) * sizeof *left_out);
    double *scratch = left_out == NULL ? NULL
                                       : maplines_new_stretches(lines->count, lines->points,
                                                                lines->points, &seen);
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
        maplines_free_stretches(&seen);
        return maplines_none();
    }
    return refits_of(&seen, scratch, pose, &fit);
}

/// Copy stretches from arrays x, y, first and x_range, and set all else; false if they do not fit.
static bool copy_stretches(const Py_buffer *views, maplines_stretches_t *seen)
{
    const double *first = views[2].buf;
    const double *x_range = views[3].buf;
    bool is_valid = first[0] == 0.0 && first[seen->lines] == (double)seen->points;
    memcpy(seen->x, views[0].buf, seen->points * sizeof *seen->x);
    memcpy(seen->y, views[1].buf, seen->points * sizeof *seen->y);
    for (size_t i = 0; is_valid && i < seen->lines; i++)
    {
        is_valid = first[i + 1] > first[i] && first[i + 1] <= (double)seen->points;
        if (is_valid)
        {
            const maplines_stretch_t stretch = {(size_t)first[i],
                                                (size_t)(first[i + 1] - first[i]),
                                                {x_range[2 * i], x_range[2 * i + 1]},
                                                i};
            seen->stretch[i] = stretch;
        }
    }
    if (is_valid)
    {
        maplines_index_stretches(seen);
    }
    return is_valid;
}

/// refit_of_stretches(x, y, first, x_range, pose, fit) -> capsule, or None; `first` are (L + 1,)
/// numbers: the index of the first point of each stretch, and the number of points
static PyObject *refit_of_stretches(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    static const int axes[4] = {1, 1, 1, 2};
    (void)module;
    Py_buffer views[4];
    double pose[3];
    maplines_fit_t fit;
    if (count != 6 || !maplines_read_pose(args[4], pose) || !read_fit(args[5], &fit) ||
        !maplines_hold_all(4, args, axes, views))
    {
        Py_RETURN_NONE;
    }
    maplines_stretches_t seen;
    seen.points = (size_t)views[0].shape[0];
    seen.lines = (size_t)views[3].shape[0];
    const bool fits = views[1].shape[0] == views[0].shape[0] &&
                      views[2].shape[0] == views[3].shape[0] + 1 && views[3].shape[1] == 2;
    double *scratch =
        fits ? maplines_new_stretches(seen.lines, seen.points, seen.points, &seen) : NULL;
    const bool is_valid = scratch != NULL && copy_stretches(views, &seen);
    if (scratch != NULL && !is_valid)
    {
        maplines_free_stretches(&seen);
    }
    maplines_release_all(4, views);
    return is_valid ? refits_of(&seen, scratch, pose, &fit) : maplines_none();
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
        return maplines_none();
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
    maplines_held_rule_t held;
    Py_buffer means;
    Py_buffer covs;
    bool is_done = false;
    if (own == NULL)
    {
        return maplines_none();
    }
    const Py_ssize_t lines = (Py_ssize_t)own->lines;
    if (!maplines_read_pose_gaussian(args + 1, mean, cov) || !maplines_hold_rule(args[3], &held))
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
    maplines_release_all(3, held.views);
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

static PyMethodDef functions[] = {
    {"refit", (PyCFunction)(void (*)(void))refit, METH_FASTCALL, NULL},
    {"refit_of_stretches", (PyCFunction)(void (*)(void))refit_of_stretches, METH_FASTCALL, NULL},
    {"refit_values", (PyCFunction)(void (*)(void))refit_values, METH_FASTCALL, NULL},
    {"refit_moments", (PyCFunction)(void (*)(void))refit_moments, METH_FASTCALL, NULL},
    {"refit_field", (PyCFunction)(void (*)(void))refit_field, METH_FASTCALL, NULL},
    {NULL, NULL, 0, NULL},
};

int maplines_add_refits(PyObject *module)
{
    return PyModule_AddFunctions(module, functions);
}
