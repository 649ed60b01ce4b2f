/* Objects of the package: Gaussians, lines and scenes.
 *
 * They are made without their constructors, whose checks they would pass: what is decoded is
 * finite, and its covariances are positive definite for any bits. An object has the attributes that
 * its constructor sets, in this order, so that it is pickled alike.
 */
#include "native.h"

/* ---- parts of objects -------------------------------------------------------------------------
 */

/// Object of a class, without a call of its constructor; NULL with an exception.
static PyObject *new_of(PyObject *class_)
{
    PyObject *none = PyTuple_New(0);
    if (none == NULL)
    {
        return NULL;
    }
    newfunc new_object = (newfunc)PyType_GetSlot((PyTypeObject *)class_, Py_tp_new);
    PyObject *made = new_object((PyTypeObject *)class_, none, NULL);
    Py_DECREF(none);
    return made;
}

/// Set an attribute of an object, and release it; NULL stands for a value that could not be made.
static bool set_to(PyObject *object, PyObject *name, PyObject *value)
{
    if (value == NULL)
    {
        return false;
    }
    const bool is_set = PyObject_GenericSetAttr(object, name, value) == 0;
    Py_DECREF(value);
    return is_set;
}

/// `object`, or NULL if an exception was raised while it was made.
static PyObject *checked(PyObject *object, bool is_made)
{
    if (!is_made)
    {
        Py_DECREF(object);
        return NULL;
    }
    return object;
}

PyObject *maplines_new_named(PyObject *class_, PyObject *values)
{
    PyObject *arguments = values == NULL ? NULL : PyTuple_New(1);
    if (arguments == NULL)
    {
        Py_XDECREF(values);
        return NULL;
    }
    (void)PyTuple_SetItem(arguments, 0, values);
    newfunc new_tuple = (newfunc)PyType_GetSlot(&PyTuple_Type, Py_tp_new);
    PyObject *named = new_tuple((PyTypeObject *)class_, arguments, NULL);
    Py_DECREF(arguments);
    return named;
}

/* ---- Gaussians and lines ----------------------------------------------------------------------
 */

PyObject *maplines_new_gaussian(PyObject *const *objects, int n, const double *mean,
                                const double *cov)
{
    const Py_ssize_t shape[2] = {n, n};
    const size_t size = (size_t)n * sizeof(double);
    PyObject *bytes = PyBytes_FromStringAndSize(NULL, (Py_ssize_t)(size * (size_t)(n + 1)));
    PyObject *gaussian = bytes == NULL ? NULL : new_of(objects[MAPLINES_OF_GAUSSIAN]);
    if (gaussian == NULL)
    {
        Py_XDECREF(bytes);
        return NULL;
    }
    char *values = PyBytes_AsString(bytes);
    memcpy(values, mean, size);
    memcpy(values + size, cov, size * (size_t)n);
    const bool is_made = set_to(gaussian, objects[MAPLINES_NAME_MEAN],
                                maplines_array_over(objects, 1, shape, bytes, 0)) &&
                         set_to(gaussian, objects[MAPLINES_NAME_COV],
                                maplines_array_over(objects, 2, shape, bytes, (Py_ssize_t)size));
    Py_DECREF(bytes);
    return checked(gaussian, is_made);
}

PyObject *maplines_new_mixture(PyObject *const *objects, int count, const double *weights,
                               PyObject *const *components)
{
    PyObject *mixture = new_of(objects[MAPLINES_OF_MIXTURE]);
    if (mixture == NULL)
    {
        return NULL;
    }
    PyObject *all = PyTuple_New(count);
    for (int i = 0; all != NULL && i < count; ++i)
    {
        (void)PyTuple_SetItem(all, i, Py_NewRef(components[i]));
    }
    const Py_ssize_t shape[1] = {count};
    PyObject *array = all == NULL ? NULL : maplines_array_of(objects, 1, shape, weights);
    if (array == NULL)
    {
        Py_XDECREF(all);
        return checked(mixture, false);
    }
    const bool has_weights = set_to(mixture, objects[MAPLINES_NAME_WEIGHTS], array);
    const bool has_components = set_to(mixture, objects[MAPLINES_NAME_COMPONENTS], all);
    return checked(mixture, has_weights && has_components);
}

PyObject *maplines_new_line(PyObject *const *objects, const maplines_line_t *line,
                            PyObject *gaussian, PyObject *mixture)
{
    PyObject *made = gaussian == NULL ? NULL : new_of(objects[MAPLINES_OF_MAP_LINE]);
    if (made == NULL)
    {
        Py_XDECREF(gaussian);
        Py_XDECREF(mixture);
        return NULL;
    }
    PyObject *slot = objects[MAPLINES_OF_SLOTS + (int)line->slot];
    PyObject *kind = objects[MAPLINES_OF_KINDS + (int)line->kind];
    PyObject *status = objects[MAPLINES_OF_STATUSES + (int)line->status];
    PyObject *shape = mixture == NULL ? Py_NewRef(Py_None) : mixture;
    const bool has_slot = set_to(made, objects[MAPLINES_NAME_SLOT], Py_NewRef(slot));
    const bool has_gaussian = set_to(made, objects[MAPLINES_NAME_GAUSSIAN], gaussian);
    const bool has_values =
        has_slot && has_gaussian && set_to(made, objects[MAPLINES_NAME_KIND], Py_NewRef(kind)) &&
        set_to(made, objects[MAPLINES_NAME_X_MIN], PyFloat_FromDouble((double)line->x_min)) &&
        set_to(made, objects[MAPLINES_NAME_X_MAX], PyFloat_FromDouble((double)line->x_max)) &&
        set_to(made, objects[MAPLINES_NAME_AGE], PyFloat_FromDouble((double)line->age)) &&
        set_to(made, objects[MAPLINES_NAME_STATUS], Py_NewRef(status)) &&
        set_to(made, objects[MAPLINES_NAME_T_NS], PyLong_FromLongLong(line->t_ns));
    const bool has_mixture = set_to(made, objects[MAPLINES_NAME_MIXTURE], shape);
    return checked(made, has_values && has_mixture);
}

/* ---- scenes -----------------------------------------------------------------------------------
 */

/// Share by which the variances of a scene are enlarged: that of wire/covariance/scene_code.py.
#define SCENE_ROUNDING 0x1p-42

/// Joint covariance of the parameters of lines, by rows.
static void joint_covariance(int count, const double (*spread)[7], const double (*specific)[4][4],
                             double *cov)
{
    const int n = 4 * count;
    maplines_product_transposed(n, 7, n, spread[0], spread[0], cov);
    for (int place = 0; place < count; ++place)
    {
        double own[16];
        maplines_product_transposed(4, 4, 4, specific[place][0], specific[place][0], own);
        for (int i = 0; i < 16; ++i)
        {
            double *entry = cov + (4 * place + i / 4) * n + 4 * place + i % 4;
            *entry = *entry + own[i];
            *entry = i % 5 == 0 ? *entry * (1.0 + SCENE_ROUNDING) : *entry;
        }
    }
}

void maplines_scene_covariance(const maplines_scene_t *scene, int place, double cov[16])
{
    joint_covariance(1, scene->spread + 4 * place, scene->specific + place, cov);
}

void maplines_all_covariances(const maplines_scene_t *scene, double *cov)
{
    joint_covariance(scene->count, scene->spread, scene->specific, cov);
}

static PyObject *new_joint_covariance(PyObject *const *objects, const maplines_scene_t *scene)
{
    const size_t n = 4U * scene->count;
    PyObject *bytes = PyBytes_FromStringAndSize(NULL, (Py_ssize_t)(n * n * sizeof(double)));
    if (bytes == NULL)
    {
        return NULL;
    }
    joint_covariance(scene->count, scene->spread, scene->specific,
                     (double *)(void *)PyBytes_AsString(bytes));
    const Py_ssize_t shape[2] = {(Py_ssize_t)n, (Py_ssize_t)n};
    PyObject *array = maplines_array_over(objects, 2, shape, bytes, 0);
    Py_DECREF(bytes);
    return array;
}

static PyObject *new_specific(PyObject *const *objects, const maplines_scene_t *scene)
{
    double covs[16 * MAPLINES_SLOTS];
    if (scene->count == 0)
    {
        return Py_NewRef(Py_None);
    }
    for (int place = 0; place < scene->count; ++place)
    {
        maplines_product_transposed(4, 4, 4, scene->specific[place][0], scene->specific[place][0],
                                    covs + 16 * place);
    }
    const Py_ssize_t shape[3] = {scene->count, 4, 4};
    return maplines_array_of(objects, 3, shape, covs);
}

static PyObject *new_pose_error(PyObject *const *objects, const maplines_scene_t *scene)
{
    static const Py_ssize_t shape[2] = {3, 3};
    double cov[9];
    PyObject *made = new_of(objects[MAPLINES_OF_POSE_ERROR]);
    if (made == NULL)
    {
        return NULL;
    }
    maplines_product_transposed(3, 3, 3, scene->pose_factor[0], scene->pose_factor[0], cov);
    const bool is_made =
        set_to(made, objects[MAPLINES_NAME_COV], maplines_array_of(objects, 2, shape, cov)) &&
        set_to(made, objects[MAPLINES_NAME_CORRELATION_TIME],
               PyFloat_FromDouble(scene->correlation_time));
    return checked(made, is_made);
}

static PyObject *new_map_error(PyObject *const *objects, const maplines_scene_t *scene)
{
    PyObject *made = new_of(objects[MAPLINES_OF_MAP_ERROR]);
    if (made == NULL)
    {
        return NULL;
    }
    const bool is_made =
        set_to(made, objects[MAPLINES_NAME_POINT_SIGMA], PyFloat_FromDouble(0.0)) &&
        set_to(made, objects[MAPLINES_NAME_OFFSET_SIGMA],
               PyFloat_FromDouble(scene->offset_sigma)) &&
        set_to(made, objects[MAPLINES_NAME_HEADING_SIGMA],
               PyFloat_FromDouble(scene->heading_sigma));
    return checked(made, is_made);
}

PyObject *maplines_new_scene(PyObject *const *objects, const maplines_scene_t *scene,
                             PyObject *lines)
{
    const Py_ssize_t shape[2] = {scene->count, 2};
    PyObject *made = new_of(objects[MAPLINES_OF_SCENE]);
    if (made == NULL)
    {
        Py_DECREF(lines);
        return NULL;
    }
    const bool is_made =
        set_to(made, objects[MAPLINES_NAME_LINES], lines) &&
        set_to(made, objects[MAPLINES_NAME_COV], new_joint_covariance(objects, scene)) &&
        set_to(made, objects[MAPLINES_NAME_POSE_ERROR], new_pose_error(objects, scene)) &&
        set_to(made, objects[MAPLINES_NAME_FIT_RANGES],
               maplines_array_of(objects, 2, shape, scene->fit_range[0])) &&
        set_to(made, objects[MAPLINES_NAME_MAP_ERROR], new_map_error(objects, scene)) &&
        set_to(made, objects[MAPLINES_NAME_LEFT_OUT], PyDict_New()) &&
        set_to(made, objects[MAPLINES_NAME_QUARTICS],
               maplines_array_of(objects, 1, shape, scene->quartic)) &&
        set_to(made, objects[MAPLINES_NAME_SPECIFIC_COVS], new_specific(objects, scene));
    return checked(made, is_made);
}
