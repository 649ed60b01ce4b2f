/* Arguments of METH_FASTCALL | METH_KEYWORDS, with the errors of a function in Python. */
#include "native.h"

/// Place of a parameter with a name; -1 if there is none, and -2 with an exception.
static int place_of(const maplines_parameters_t *parameters, PyObject *name)
{
    for (int i = 0; i < parameters->count; ++i)
    {
        if (PyUnicode_CompareWithASCIIString(name, parameters->names[i]) == 0)
        {
            return i;
        }
    }
    return -1;
}

static bool read_keywords(const maplines_parameters_t *parameters, PyObject *const *arguments,
                          int count, PyObject *keywords, PyObject **values)
{
    for (Py_ssize_t k = 0; k < PyTuple_Size(keywords); ++k)
    {
        PyObject *name = PyTuple_GetItem(keywords, k);
        const int place = place_of(parameters, name);
        if (place < 0)
        {
            PyErr_Format(PyExc_TypeError, "%s() got an unexpected keyword argument '%U'",
                         parameters->function, name);
            return false;
        }
        if (place < count)
        {
            PyErr_Format(PyExc_TypeError, "%s() got multiple values for argument '%U'",
                         parameters->function, name);
            return false;
        }
        values[place] = arguments[count + k];
    }
    return true;
}

bool maplines_read_arguments(const maplines_parameters_t *parameters, PyObject *const *arguments,
                             Py_ssize_t count, PyObject *keywords, PyObject **values)
{
    if (count > parameters->positional)
    {
        PyErr_Format(PyExc_TypeError, "%s() takes %d positional arguments but %zd were given",
                     parameters->function, parameters->positional + 1, count + 1);
        return false;
    }
    for (int i = 0; i < count; ++i)
    {
        values[i] = arguments[i];
    }
    if (keywords != NULL && !read_keywords(parameters, arguments, (int)count, keywords, values))
    {
        return false;
    }
    for (int i = 0; i < parameters->required; ++i)
    {
        if (values[i] == NULL)
        {
            PyErr_Format(PyExc_TypeError, "%s() missing required argument: '%s'",
                         parameters->function, parameters->names[i]);
            return false;
        }
    }
    return true;
}
