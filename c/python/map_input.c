/* Maps, poses and transforms as they are read. */
#include "map_input.h"

#include <stdlib.h>

#define PATHS "maplines_can._native.paths"

PyObject *maplines_none(void)
{
    return PyErr_Occurred() != NULL ? NULL : Py_NewRef(Py_None);
}

/* ---- numbers and arrays ---------------------------------------------------------------------- */

bool maplines_read_tuple(PyObject *tuple, Py_ssize_t count, double *numbers)
{
    if (!PyTuple_Check(tuple) || PyTuple_Size(tuple) != count)
    {
        return false;
    }
    for (Py_ssize_t i = 0; i < count && PyErr_Occurred() == NULL; i++)
    {
        numbers[i] = PyFloat_AsDouble(PyTuple_GetItem(tuple, i));
    }
    const bool is_read = PyErr_Occurred() == NULL;
    PyErr_Clear();
    return is_read;
}

bool maplines_read_settings(PyObject *tuple, Py_ssize_t count, double *settings,
                            maplines_fit_t *fit)
{
    double numbers[MAPLINES_MOST_SETTINGS + 3] = {0.0};
    fit->has_map_error = maplines_read_tuple(tuple, count + 3, numbers);
    const bool is_read = fit->has_map_error || maplines_read_tuple(tuple, count, numbers);
    memcpy(settings, numbers, (size_t)count * sizeof *settings);
    fit->point_sigma = numbers[count];
    fit->offset_sigma = numbers[count + 1];
    fit->heading_sigma = numbers[count + 2];
    return is_read;
}

bool maplines_read_pose(PyObject *array, double pose[3])
{
    static const Py_ssize_t shape[1] = {3};
    return maplines_read_doubles(array, PyBUF_C_CONTIGUOUS, 1, shape, pose);
}

bool maplines_read_pose_gaussian(PyObject *const arrays[2], double mean[3], double cov[9])
{
    static const Py_ssize_t shape[2] = {3, 3};
    return maplines_read_pose(arrays[0], mean) &&
           maplines_read_doubles(arrays[1], PyBUF_C_CONTIGUOUS, 2, shape, cov);
}

bool maplines_hold_all(int count, PyObject *const *arrays, const int *axes, Py_buffer *views)
{
    for (int i = 0; i < count; i++)
    {
        if (!maplines_hold_doubles(arrays[i], axes[i], &views[i]))
        {
            maplines_release_all(i, views);
            return false;
        }
    }
    return true;
}

void maplines_release_all(int count, Py_buffer *views)
{
    for (int i = 0; i < count; i++)
    {
        PyBuffer_Release(&views[i]);
    }
}

bool maplines_hold_rule(PyObject *arrays, maplines_held_rule_t *held)
{
    static const int axes[3] = {2, 1, 1};
    if (!PyTuple_Check(arrays) || PyTuple_Size(arrays) != 3)
    {
        return false;
    }
    PyObject *const items[3] = {PyTuple_GetItem(arrays, 0), PyTuple_GetItem(arrays, 1),
                                PyTuple_GetItem(arrays, 2)};
    if (!maplines_hold_all(3, items, axes, held->views))
    {
        return false;
    }
    const Py_buffer *views = held->views;
    const Py_ssize_t count = views[0].shape[0];
    if (count < 1 || views[0].shape[1] != 3 || views[1].shape[0] != count ||
        views[2].shape[0] != count)
    {
        maplines_release_all(3, held->views);
        return false;
    }
    held->rule.count = (size_t)count;
    held->rule.z = views[0].buf;
    held->rule.mean_weights = views[1].buf;
    held->rule.cov_weights = views[2].buf;
    return true;
}

/* ---- lines of a map -------------------------------------------------------------------------- */

static void free_paths(maplines_paths_t *lines)
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

/// Prepare line `i` of ((n, 2) points, (n,) arc lengths), with the memory from `*used` on.
static bool prepare(maplines_paths_t *lines, size_t i, PyObject *line, size_t *used)
{
    static const int axes[2] = {2, 1};
    Py_buffer views[2];
    if (!PyTuple_Check(line) || PyTuple_Size(line) != 2)
    {
        return false;
    }
    PyObject *const arrays[2] = {PyTuple_GetItem(line, 0), PyTuple_GetItem(line, 1)};
    if (!maplines_hold_all(2, arrays, axes, views))
    {
        return false;
    }
    const size_t count = (size_t)views[0].shape[0];
    const bool is_prepared =
        views[0].shape[1] == 2 && views[1].shape[0] == views[0].shape[0] && count >= 2 &&
        count <= lines->points - *used &&
        maplines_prepare_path(views[0].buf, views[1].buf, count,
                              lines->memory + *used * MAPLINES_PATH_ARRAYS, &lines->paths[i]);
    *used += count;
    maplines_release_all(2, views);
    return is_prepared;
}

/// Memory for the lines of a tuple of arrays; NULL with MemoryError.
static maplines_paths_t *new_paths(size_t count, size_t points)
{
    maplines_paths_t *lines = calloc(1, sizeof *lines);
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
    maplines_paths_t *lines = new_paths((size_t)number, points);
    size_t used = 0;
    for (Py_ssize_t i = 0; lines != NULL && i < number; i++)
    {
        if (!prepare(lines, (size_t)i, PyTuple_GetItem(args[0], i), &used))
        {
            free_paths(lines);
            Py_RETURN_NONE;
        }
    }
    PyObject *capsule = lines == NULL ? NULL : PyCapsule_New(lines, PATHS, delete_paths);
    if (capsule == NULL)
    {
        free_paths(lines);
    }
    return capsule;
}

const maplines_paths_t *maplines_paths_of(PyObject *capsule)
{
    const maplines_paths_t *lines = PyCapsule_GetPointer(capsule, PATHS);
    PyErr_Clear();
    return lines;
}

double *maplines_new_stretches(size_t lines, size_t points, size_t doubles,
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

void maplines_free_stretches(maplines_stretches_t *seen)
{
    free(seen->x);
    free(seen->stretch);
}

static PyMethodDef functions[] = {
    {"paths", (PyCFunction)(void (*)(void))paths, METH_FASTCALL, NULL},
    {NULL, NULL, 0, NULL},
};

int maplines_add_paths(PyObject *module)
{
    return PyModule_AddFunctions(module, functions);
}
