/* NumPy arrays of double precision: read through the buffer protocol, and made over bytes, which
 * cannot be changed.
 */
#include "native.h"

PyObject *const *maplines_numpy(PyObject *module)
{
    PyObject **objects = maplines_module_state(module)->objects;
    if (objects[MAPLINES_OF_FLOAT64] != NULL)
    {
        return objects;
    }
    PyObject *numpy = PyImport_ImportModule("numpy");
    PyObject *ndarray = numpy == NULL ? NULL : PyObject_GetAttrString(numpy, "ndarray");
    PyObject *float64 = ndarray == NULL ? NULL : PyObject_CallMethod(numpy, "dtype", "s", "f8");
    Py_XDECREF(numpy);
    if (float64 == NULL)
    {
        Py_XDECREF(ndarray);
        return NULL;
    }
    Py_XDECREF(objects[MAPLINES_OF_NDARRAY]); // of an import that this one has caused
    Py_XDECREF(objects[MAPLINES_OF_FLOAT64]);
    objects[MAPLINES_OF_NDARRAY] = ndarray;
    objects[MAPLINES_OF_FLOAT64] = float64;
    return objects;
}

/// Shape of an array as a tuple; NULL with an exception.
static PyObject *shape_of(int axes, const Py_ssize_t *shape)
{
    PyObject *lengths = PyTuple_New(axes);
    for (int i = 0; lengths != NULL && i < axes; i++)
    {
        PyObject *length = PyLong_FromSsize_t(shape[i]);
        if (length == NULL || PyTuple_SetItem(lengths, i, length) < 0)
        {
            Py_CLEAR(lengths);
        }
    }
    return lengths;
}

PyObject *maplines_array_over(PyObject *const *objects, int axes, const Py_ssize_t *shape,
                              PyObject *bytes, Py_ssize_t offset)
{
    PyObject *array = NULL;
    PyObject *lengths = objects == NULL ? NULL : shape_of(axes, shape);
    PyObject *start = lengths == NULL ? NULL : PyLong_FromSsize_t(offset);
    PyObject *arguments =
        start == NULL ? NULL : PyTuple_Pack(4, lengths, objects[MAPLINES_OF_FLOAT64], bytes, start);
    if (arguments != NULL)
    {
        PyTypeObject *type = (PyTypeObject *)objects[MAPLINES_OF_NDARRAY];
        newfunc new_array = (newfunc)PyType_GetSlot(type, Py_tp_new);
        array = new_array(type, arguments, NULL);
        Py_DECREF(arguments);
    }
    Py_XDECREF(start);
    Py_XDECREF(lengths);
    return array;
}

PyObject *maplines_array_of(PyObject *const *objects, int axes, const Py_ssize_t *shape,
                            const double *values)
{
    Py_ssize_t size = (Py_ssize_t)sizeof(double);
    for (int i = 0; i < axes; i++)
    {
        size *= shape[i];
    }
    PyObject *bytes = PyBytes_FromStringAndSize((const char *)(const void *)values, size);
    PyObject *array = bytes == NULL ? NULL : maplines_array_over(objects, axes, shape, bytes, 0);
    Py_XDECREF(bytes);
    return array;
}

/// Hold the buffer of an array of so many axes in an order.
static bool hold(PyObject *array, int order, int axes, Py_buffer *view)
{
    // What has no buffer, or another format, is for Python: this is no error here.
    if (PyObject_GetBuffer(array, view, order | PyBUF_FORMAT) < 0)
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

bool maplines_hold_doubles(PyObject *array, int axes, Py_buffer *view)
{
    return hold(array, PyBUF_C_CONTIGUOUS, axes, view);
}

bool maplines_read_doubles(PyObject *array, int order, int axes, const Py_ssize_t *shape,
                           double *values)
{
    Py_buffer view;
    if (!hold(array, order, axes, &view))
    {
        return false;
    }
    bool is_read = true;
    for (int i = 0; i < axes; i++)
    {
        is_read = is_read && view.shape[i] == shape[i];
    }
    if (is_read && PyBuffer_ToContiguous(values, &view, view.len, 'C') < 0)
    {
        PyErr_Clear();
        is_read = false;
    }
    PyBuffer_Release(&view);
    return is_read;
}

void maplines_release_arrays(maplines_arrays_t *arrays)
{
    for (int i = 0; i < arrays->count; i++)
    {
        PyBuffer_Release(&arrays->views[i]);
    }
    arrays->count = 0;
}

void *maplines_hold(maplines_arrays_t *arrays, PyObject *array, Py_ssize_t bytes, bool is_written)
{
    static char empty;
    Py_buffer *view = &arrays->views[arrays->count];
    if (PyObject_GetBuffer(array, view, is_written ? PyBUF_CONTIG : PyBUF_CONTIG_RO) < 0)
    {
        return NULL;
    }
    arrays->count++;
    if (view->len != bytes)
    {
        PyErr_Format(PyExc_ValueError, "an array must have %zd bytes, got %zd", bytes, view->len);
        return NULL;
    }
    return view->buf != NULL ? view->buf : &empty;
}
