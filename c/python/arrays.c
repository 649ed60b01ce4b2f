/* NumPy arrays of double precision: read through the buffer protocol, and made over bytes. */
#include "native.h"

/// Import the classes of NumPy, when the first array is made; false with an exception.
static bool import_numpy(maplines_module_t *state)
{
    if (state->float64 != NULL)
    {
        return true;
    }
    PyObject *numpy = PyImport_ImportModule("numpy");
    if (numpy == NULL)
    {
        return false;
    }
    Py_XDECREF(state->ndarray); // of an attempt that failed
    state->ndarray = PyObject_GetAttrString(numpy, "ndarray");
    state->float64 = state->ndarray == NULL ? NULL : PyObject_GetAttrString(numpy, "float64");
    Py_DECREF(numpy);
    return state->float64 != NULL;
}

PyObject *maplines_array_of(PyObject *module, int axes, const Py_ssize_t *shape,
                            const double *values)
{
    maplines_module_t *state = maplines_module_state(module);
    if (!import_numpy(state))
    {
        return NULL;
    }
    PyObject *lengths = PyTuple_New(axes);
    Py_ssize_t size = (Py_ssize_t)sizeof(double);
    for (int i = 0; lengths != NULL && i < axes; i++)
    {
        PyObject *length = PyLong_FromSsize_t(shape[i]);
        if (length == NULL || PyTuple_SetItem(lengths, i, length) < 0)
        {
            Py_CLEAR(lengths);
        }
        size *= shape[i];
    }
    if (lengths == NULL)
    {
        return NULL;
    }
    PyObject *bytes = PyBytes_FromStringAndSize((const char *)values, size);
    PyObject *array = NULL;
    if (bytes != NULL)
    {
        array = PyObject_CallFunctionObjArgs(state->ndarray, lengths, state->float64, bytes, NULL);
        Py_DECREF(bytes);
    }
    Py_DECREF(lengths);
    return array;
}

bool maplines_hold_doubles(PyObject *array, int axes, Py_buffer *view)
{
    // What has no buffer, or another format, is for Python: this is no error here.
    if (PyObject_GetBuffer(array, view, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) < 0)
    {
        PyErr_Clear();
        return false;
    }
    if (view->ndim == axes && view->format != NULL && strcmp(view->format, "d") == 0)
    {
        return true;
    }
    PyBuffer_Release(view);
    return false;
}

bool maplines_read_doubles(PyObject *array, int axes, Py_ssize_t count, double *values)
{
    Py_buffer view;
    if (!maplines_hold_doubles(array, axes, &view))
    {
        return false;
    }
    const bool has_length = view.len == count * (Py_ssize_t)sizeof(double);
    if (has_length)
    {
        memcpy(values, view.buf, (size_t)view.len);
    }
    PyBuffer_Release(&view);
    return has_length;
}
