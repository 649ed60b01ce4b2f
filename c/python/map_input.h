/* What the files of the propagation share: maps, poses and transforms as they are read.
 *
 * Their functions are for maplines_can/propagation/in_c.py. They return None where C does not do
 * what the Python functions do: these raise an error or warn, or an argument is not what C reads.
 * Then they are called instead.
 */
#ifndef MAPLINES_MAP_INPUT_H
#define MAPLINES_MAP_INPUT_H

#include "native.h"
#include "propagation.h"

#define MAPLINES_MOST_SETTINGS 4 ///< numbers of a fit or a cycle, but for those of the map error

/// Lines of a map, with their memory.
typedef struct {
    size_t count;
    size_t points; ///< of all lines
    maplines_path_t *paths;
    double *memory;
} maplines_paths_t;

/// Points and weights of a transform, and the arrays that have them.
typedef struct {
    maplines_rule_t rule;
    Py_buffer views[3];
} maplines_held_rule_t;

/// None; NULL if there is an exception.
PyObject *maplines_none(void);

/* The readers return false without an exception if an argument is something else. */

/// Read a tuple of so many numbers.
bool maplines_read_tuple(PyObject *tuple, Py_ssize_t count, double *numbers);
/// Read a tuple of so many settings, and of the three of a map error if they follow.
bool maplines_read_settings(PyObject *tuple, Py_ssize_t count, double *settings,
                            maplines_fit_t *fit);
/// Read a pose: (3,).
bool maplines_read_pose(PyObject *array, double pose[3]);
/// Read a Gaussian of a pose: a mean (3,) and a covariance (3, 3).
bool maplines_read_pose_gaussian(PyObject *const arrays[2], double mean[3], double cov[9]);

/// Hold arrays of so many axes each, as maplines_hold_doubles: all, or none.
bool maplines_hold_all(int count, PyObject *const *arrays, const int *axes, Py_buffer *views);
void maplines_release_all(int count, Py_buffer *views);
/// Hold the arrays of a rule: (N, 3) points, (N,) weights of mean and covariance. Release `views`.
bool maplines_hold_rule(PyObject *arrays, maplines_held_rule_t *held);

/// Lines of a capsule; NULL without an exception if it is something else.
const maplines_paths_t *maplines_paths_of(PyObject *capsule);

/// Memory of stretches of some lines, in one piece: `doubles` more are at the end, which it
/// returns. NULL with MemoryError.
double *maplines_new_stretches(size_t lines, size_t points, size_t doubles,
                               maplines_stretches_t *seen);
void maplines_free_stretches(maplines_stretches_t *seen);

#endif
