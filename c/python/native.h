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
    PyTypeObject *tables; ///< type of maplines_tables_t
} maplines_module_t;

/// State of the module.
maplines_module_t *maplines_module_state(PyObject *module);

/// Tables of a DBC of an argument; NULL with TypeError if it is something else.
const maplines_dbc_t *maplines_dbc_of(PyObject *module, PyObject *tables);

/// Add the functions and types of a file to the module; 0, or -1 with an exception.
int maplines_add_tables(PyObject *module);

#endif
