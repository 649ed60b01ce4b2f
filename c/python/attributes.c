/* Values of Python objects as numbers of C.
 *
 * The readers return false if a value is not of the usual class, with or without an exception: the
 * caller then leaves the work to the Python package, which knows all classes and has the messages.
 */
#include "sender.h"

PyObject *maplines_unusual(void)
{
    if (PyErr_Occurred() != NULL)
    {
        if (!PyErr_ExceptionMatches(PyExc_Exception) || PyErr_ExceptionMatches(PyExc_MemoryError))
        {
            return NULL;
        }
        PyErr_Clear();
    }
    Py_RETURN_NONE;
}

bool maplines_read_double(PyObject *value, double *number)
{
    if (value == NULL || !(PyFloat_Check(value) || PyLong_Check(value)))
    {
        return false;
    }
    *number = PyFloat_AsDouble(value);
    return *number != -1.0 || PyErr_Occurred() == NULL;
}

bool maplines_read_enum(PyObject *value, int most, int *number)
{
    if (value == NULL || !PyLong_Check(value))
    {
        return false;
    }
    const long found = PyLong_AsLong(value);
    *number = (int)found;
    return found >= 0 && found <= most;
}

bool maplines_read_double_of(PyObject *object, PyObject *name, double *number)
{
    PyObject *value = PyObject_GetAttr(object, name);
    const bool is_read = maplines_read_double(value, number);
    Py_XDECREF(value);
    return is_read;
}

bool maplines_read_enum_of(PyObject *object, PyObject *name, int most, int *number)
{
    PyObject *value = PyObject_GetAttr(object, name);
    const bool is_read = maplines_read_enum(value, most, number);
    Py_XDECREF(value);
    return is_read;
}

bool maplines_read_doubles_of(PyObject *object, PyObject *name, int axes, const Py_ssize_t *shape,
                              double *values)
{
    PyObject *value = PyObject_GetAttr(object, name);
    const bool is_read =
        value != NULL && maplines_read_doubles(value, PyBUF_STRIDES, axes, shape, values);
    Py_XDECREF(value);
    return is_read;
}
