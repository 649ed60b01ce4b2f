/* Gaussians and lines: the checks of maplines_can.values.gaussian, and the band of a line. */
#include "native.h"

/// Greatest dimension of a Gaussian that is checked here: all lines of a scene.
#define MOST_VARIABLES MAPLINES_STATES
/// Largest variance or covariance, and rounding errors that count as such: values/linalg.py.
#define MAX_COV 1e307
#define ROUNDING 1e-9

/// An (n, n) matrix is a covariance, up to rounding; the checks of `Gaussian` in their order.
static bool is_covariance(int n, const double *S)
{
    double scale[MOST_VARIABLES];
    for (int i = 0; i < n * n; i++)
    {
        if (!(fabs(S[i]) <= MAX_COV))
        {
            return false;
        }
    }
    for (int i = 0; i < n; i++)
    {
        const double variance = S[n * i + i];
        if (variance < 0.0)
        {
            return false;
        }
        for (int j = 0; variance == 0.0 && j < n; j++)
        {
            if (S[n * i + j] != 0.0)
            {
                return false;
            }
        }
        scale[i] = variance > 0.0 ? sqrt(variance) : 1.0;
    }
    for (int i = 0; i < n; i++)
    {
        for (int j = 0; j < n; j++)
        {
            if (fabs(S[n * i + j] - S[n * j + i]) > ROUNDING * scale[i] * scale[j])
            {
                return false;
            }
        }
    }
    return true;
}

/// Cholesky's recursion on the correlation matrix with ROUNDING on its diagonal has a pivot of 0 or
/// less, as values/linalg.py: is_indefinite.
static bool is_indefinite(int n, const double *S)
{
    double scale[MOST_VARIABLES];
    double L[MOST_VARIABLES * MOST_VARIABLES];
    for (int i = 0; i < n; i++)
    {
        const double variance = S[n * i + i];
        scale[i] = variance > 0.0 ? sqrt(variance) : 1.0;
    }
    for (int i = 0; i < n; i++)
    {
        double squares = 0.0;
        for (int j = 0; j < i; j++)
        {
            double sum = 0.0;
            for (int k = 0; k < j; k++)
            {
                sum += L[n * i + k] * L[n * j + k];
            }
            const double rest = S[n * i + j] / (scale[i] * scale[j]) - sum;
            L[n * i + j] = rest / L[n * j + j];
            squares += L[n * i + j] * L[n * i + j];
        }
        const double pivot = S[n * i + i] / (scale[i] * scale[i]) + ROUNDING - squares;
        if (!(pivot > 0.0))
        {
            return true;
        }
        L[n * i + i] = sqrt(pivot);
    }
    return false;
}

static bool are_finite(int n, const double *values)
{
    for (int i = 0; i < n; i++)
    {
        if (!isfinite(values[i]))
        {
            return false;
        }
    }
    return true;
}

/// Numbers of a list or tuple; false if it has another length, or anything but floats and integers.
static bool read_row(PyObject *row, Py_ssize_t count, double *values)
{
    const bool is_list = PyList_CheckExact(row);
    if (!is_list && !PyTuple_CheckExact(row))
    {
        return false;
    }
    if ((is_list ? PyList_Size(row) : PyTuple_Size(row)) != count)
    {
        return false;
    }
    for (Py_ssize_t i = 0; i < count; i++)
    {
        PyObject *item = is_list ? PyList_GetItem(row, i) : PyTuple_GetItem(row, i);
        if (!PyFloat_CheckExact(item) && !PyLong_CheckExact(item))
        {
            return false;
        }
        values[i] = PyFloat_AsDouble(item);
        if (values[i] == -1.0 && PyErr_Occurred() != NULL)
        {
            PyErr_Clear(); // an integer beyond the floats
            return false;
        }
    }
    return true;
}

static Py_ssize_t length_of(PyObject *mean)
{
    const Py_ssize_t n = PyObject_Size(mean);
    if (n < 0)
    {
        PyErr_Clear();
    }
    return n;
}

/// Numbers of a list, a tuple or an array.
static bool read_numbers(PyObject *row, Py_ssize_t n, double *values)
{
    return read_row(row, n, values) ||
           maplines_read_doubles(row, PyBUF_C_CONTIGUOUS, 1, &n, values);
}

static bool read_cov(PyObject *cov, Py_ssize_t n, double *values)
{
    const bool is_list = PyList_CheckExact(cov);
    if (!is_list && !PyTuple_CheckExact(cov))
    {
        const Py_ssize_t shape[2] = {n, n}; // in C order only: Python keeps others
        return maplines_read_doubles(cov, PyBUF_C_CONTIGUOUS, 2, shape, values);
    }
    if ((is_list ? PyList_Size(cov) : PyTuple_Size(cov)) != n)
    {
        return false;
    }
    for (Py_ssize_t i = 0; i < n; i++)
    {
        PyObject *row = is_list ? PyList_GetItem(cov, i) : PyTuple_GetItem(cov, i);
        if (!read_numbers(row, n, &values[n * i]))
        {
            return false;
        }
    }
    return true;
}

/// checked_gaussian(mean, cov): both as arrays of a Gaussian, or None if Python has to decide: they
/// are wrong, or neither arrays of float64 nor lists of numbers.
static PyObject *checked_gaussian(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    double mean[MOST_VARIABLES];
    double cov[MOST_VARIABLES * MOST_VARIABLES];
    const Py_ssize_t n = count == 2 ? length_of(args[0]) : 0;
    if (n < 1 || n > MOST_VARIABLES || !read_numbers(args[0], n, mean) ||
        !read_cov(args[1], n, cov) || !are_finite((int)n, mean) || !is_covariance((int)n, cov))
    {
        Py_RETURN_NONE;
    }
    for (Py_ssize_t i = 0; i < n; i++)
    {
        for (Py_ssize_t j = 0; j < i; j++)
        {
            const double symmetric = (cov[n * i + j] + cov[n * j + i]) / 2;
            cov[n * i + j] = symmetric;
            cov[n * j + i] = symmetric;
        }
    }
    if (is_indefinite((int)n, cov))
    {
        Py_RETURN_NONE;
    }
    const Py_ssize_t shape[2] = {n, n};
    PyObject *const *objects = maplines_numpy(module);
    PyObject *pair = objects == NULL ? NULL : PyTuple_New(2);
    PyObject *first = pair == NULL ? NULL : maplines_array_of(objects, 1, shape, mean);
    PyObject *second = first == NULL ? NULL : maplines_array_of(objects, 2, shape, cov);
    if (second == NULL)
    {
        Py_XDECREF(first);
        Py_XDECREF(pair);
        return NULL;
    }
    PyTuple_SetItem(pair, 0, first);
    PyTuple_SetItem(pair, 1, second);
    return pair;
}

/// y_sigma(mean, cov, x): standard deviation of the lateral position of a line at x [m], as a
/// float; None if Python has to decide.
static PyObject *y_sigma(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    static const Py_ssize_t shape[2] = {4, 4};
    (void)module;
    double mean[4];
    double cov[16];
    if (count != 3 || !PyFloat_Check(args[2]) ||
        !maplines_read_doubles(args[0], PyBUF_C_CONTIGUOUS, 1, shape, mean) ||
        !maplines_read_doubles(args[1], PyBUF_C_CONTIGUOUS, 2, shape, cov))
    {
        Py_RETURN_NONE;
    }
    const double x = PyFloat_AsDouble(args[2]);
    const double slope = maplines_tan(mean[1]);
    const double J[4] = {1.0, (1 + slope * slope) * x, x * x / 2, x * x * x / 6};
    double variance = 0.0;
    for (int i = 0; i < 4; i++)
    {
        const double *row = &cov[4 * i];
        variance += J[i] * (row[0] + J[1] * row[1] + J[2] * row[2] + J[3] * row[3]);
    }
    return PyFloat_FromDouble(sqrt(variance < 0 ? 0.0 : variance));
}

/// y(mean, x): lateral position of a line at x [m], as a float; None if Python has to decide.
static PyObject *y(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    static const Py_ssize_t shape[1] = {4};
    (void)module;
    maplines_line_t line;
    memset(&line, 0, sizeof line);
    if (count != 2 || !PyFloat_Check(args[1]) ||
        !maplines_read_doubles(args[0], PyBUF_C_CONTIGUOUS, 1, shape, line.gaussian.mean))
    {
        Py_RETURN_NONE;
    }
    return PyFloat_FromDouble(maplines_y(&line, PyFloat_AsDouble(args[1])));
}

static PyMethodDef functions[] = {
    {"checked_gaussian", (PyCFunction)(void (*)(void))checked_gaussian, METH_FASTCALL, NULL},
    {"y", (PyCFunction)(void (*)(void))y, METH_FASTCALL, NULL},
    {"y_sigma", (PyCFunction)(void (*)(void))y_sigma, METH_FASTCALL, NULL},
    {NULL, NULL, 0, NULL},
};

int maplines_add_values(PyObject *module)
{
    return PyModule_AddFunctions(module, functions);
}
