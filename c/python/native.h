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
    PyObject_HEAD maplines_dbc_t dbc;
    float (*straight)[11];
    char *name;
} maplines_tables_t;

/// What the module holds.
typedef struct {
    PyObject *ndarray;    ///< numpy.ndarray
    PyObject *float64;    ///< numpy.float64
    PyTypeObject *tables; ///< type of maplines_tables_t
} maplines_module_t;

/// State of the module.
maplines_module_t *maplines_module_state(PyObject *module);

/// Tables of a DBC of an argument; NULL with TypeError if it is something else.
const maplines_dbc_t *maplines_dbc_of(PyObject *module, PyObject *tables);

/// Read-only array of double precision with a copy of the values; NULL with an exception.
PyObject *maplines_new_array(PyObject *module, int axes, const Py_ssize_t *shape,
                             const double *values);
/// Hold the buffer of an array of double precision of so many axes, in C order: release it after
/// use. False without an exception if it is something else.
bool maplines_hold_doubles(PyObject *array, int axes, Py_buffer *view);
/// Copy the values of such an array; false without an exception if it has not so many.
bool maplines_read_doubles(PyObject *array, int axes, Py_ssize_t count, double *values);

/// Add the functions and types of a file to the module; 0, or -1 with an exception.
int maplines_add_arrays(PyObject *module);
int maplines_add_batch(PyObject *module);
int maplines_add_tables(PyObject *module);
int maplines_add_values(PyObject *module);

#endif
