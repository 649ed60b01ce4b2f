/* What the files of the extension module maplines_can._native share.
 *
 * It is a binding of the C core: it converts objects of Python to structures and back. Each file
 * adds its functions and types to the module.
 */
#ifndef MAPLINES_NATIVE_H
#define MAPLINES_NATIVE_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "internal.h"

/// Tables of a DBC, as a Python object: `_native.Tables`.
typedef struct {
    PyObject_HEAD const maplines_dbc_t *dbc;
    PyObject *owner; ///< of the memory
} maplines_tables_t;

/// Objects of Python that all files use: places in `maplines_module_t.objects`.
enum {
    /* names of attributes, and of the owner of the records of the pose error: always there */
    MAPLINES_NAME_AGE,
    MAPLINES_NAME_COMPONENTS,
    MAPLINES_NAME_CORRELATION_TIME,
    MAPLINES_NAME_COV,
    MAPLINES_NAME_FIT_RANGES,
    MAPLINES_NAME_GAUSSIAN,
    MAPLINES_NAME_HEADING_SIGMA,
    MAPLINES_NAME_KIND,
    MAPLINES_NAME_LEFT_OUT,
    MAPLINES_NAME_LINES,
    MAPLINES_NAME_MAP_ERROR,
    MAPLINES_NAME_MEAN,
    MAPLINES_NAME_MIXTURE,
    MAPLINES_NAME_OFFSET_SIGMA,
    MAPLINES_NAME_POINT_SIGMA,
    MAPLINES_NAME_POSE,
    MAPLINES_NAME_POSE_ERROR,
    MAPLINES_NAME_QUARTICS,
    MAPLINES_NAME_SLOT,
    MAPLINES_NAME_SPECIFIC_COVS,
    MAPLINES_NAME_STATUS,
    MAPLINES_NAME_T_NS,
    MAPLINES_NAME_WEIGHTS,
    MAPLINES_NAME_X_MAX,
    MAPLINES_NAME_X_MIN,
    MAPLINES_NAMES, ///< number of them
    /* of NumPy: there after maplines_numpy */
    MAPLINES_OF_NDARRAY = MAPLINES_NAMES,
    MAPLINES_OF_FLOAT64, ///< the dtype
    MAPLINES_OBJECTS
};

/// What the module holds.
typedef struct {
    PyTypeObject *tables;                ///< type of maplines_tables_t
    PyObject *objects[MAPLINES_OBJECTS]; ///< NULL before they are there
} maplines_module_t;

/// State of the module.
maplines_module_t *maplines_module_state(PyObject *module);

/// The module that an object of one of its types belongs to, borrowed; NULL without an exception if
/// it is of another module, or of none.
PyObject *maplines_module_of(PyObject *object);

/* arrays.c: NumPy arrays of double precision */

/// Objects of the module with those of NumPy; NULL with an exception if it cannot be imported.
PyObject *const *maplines_numpy(PyObject *module);

/// Read-only array over bytes, from an offset on [byte]; NULL with an exception, also if `objects`
/// is NULL.
PyObject *maplines_array_over(PyObject *const *objects, int axes, const Py_ssize_t *shape,
                              PyObject *bytes, Py_ssize_t offset);
/// The same, of a copy of values.
PyObject *maplines_array_of(PyObject *const *objects, int axes, const Py_ssize_t *shape,
                            const double *values);

/// Hold the buffer of an array of so many axes, in C order: release it after use. False without an
/// exception if it is something else.
bool maplines_hold_doubles(PyObject *array, int axes, Py_buffer *view);
/// Copy the values of an array of a shape in an order: PyBUF_C_CONTIGUOUS, or PyBUF_STRIDES for
/// any. False without an exception if it is something else.
bool maplines_read_doubles(PyObject *array, int order, int axes, const Py_ssize_t *shape,
                           double *values);

#define MAPLINES_MOST_ARRAYS 21

/// Arrays of a call, released together.
typedef struct {
    Py_buffer views[MAPLINES_MOST_ARRAYS];
    int count;
} maplines_arrays_t;

/// Pointer to the values of an array of so many bytes; NULL with an exception if it is another one,
/// or if it may not be written to. An empty array has a pointer, too.
void *maplines_hold(maplines_arrays_t *arrays, PyObject *array, Py_ssize_t bytes, bool is_written);
void maplines_release_arrays(maplines_arrays_t *arrays);

/// Tables of a DBC of an argument; NULL with TypeError if it is something else, or if `module` is
/// NULL.
const maplines_dbc_t *maplines_dbc_of(PyObject *module, PyObject *tables);

/// Add the functions and types of a file to the module; 0, or -1 with an exception.
int maplines_add_names(PyObject *module);
int maplines_add_tables(PyObject *module);

#endif
