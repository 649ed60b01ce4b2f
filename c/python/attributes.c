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

/// The view is one of doubles with this shape.
static bool is_of_shape(const Py_buffer *view, int ndim, const Py_ssize_t *shape)
{
    bool is_so = view->ndim == ndim && view->format != NULL && strcmp(view->format, "d") == 0;
    for (int i = 0; is_so && i < ndim; i++)
    {
        is_so = view->shape[i] == shape[i];
    }
    return is_so;
}

bool maplines_read_array(PyObject *array, int ndim, const Py_ssize_t *shape, double *numbers)
{
    Py_buffer view;
    if (array == NULL || PyObject_GetBuffer(array, &view, PyBUF_STRIDES | PyBUF_FORMAT) < 0)
    {
        return false;
    }
    const bool is_so = is_of_shape(&view, ndim, shape);
    const Py_ssize_t count = is_so ? view.len / (Py_ssize_t)sizeof(double) : 0;
    if (is_so && PyBuffer_IsContiguous(&view, 'C'))
    {
        memcpy(numbers, view.buf, (size_t)view.len);
    }
    else
    {
        for (Py_ssize_t i = 0; i < count; i++)
        {
            const char *place = view.buf;
            Py_ssize_t rest = i;
            for (int axis = ndim - 1; axis >= 0; axis--)
            {
                place += rest % shape[axis] * view.strides[axis];
                rest /= shape[axis];
            }
            memcpy(&numbers[i], place, sizeof(double));
        }
    }
    PyBuffer_Release(&view);
    return is_so;
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

bool maplines_read_array_of(PyObject *object, PyObject *name, int ndim, const Py_ssize_t *shape,
                            double *numbers)
{
    PyObject *value = PyObject_GetAttr(object, name);
    const bool is_read = maplines_read_array(value, ndim, shape, numbers);
    Py_XDECREF(value);
    return is_read;
}
