/* What C uses of the package: its classes, members of its enumerations, and names of attributes. */
#include "native.h"

int maplines_add_names(PyObject *module)
{
    static const char *const names[MAPLINES_NAMES] = {
        [MAPLINES_NAME_AGE] = "age",
        [MAPLINES_NAME_COMPONENTS] = "components",
        [MAPLINES_NAME_CORRELATION_TIME] = "correlation_time",
        [MAPLINES_NAME_COV] = "cov",
        [MAPLINES_NAME_FIT_RANGES] = "fit_ranges",
        [MAPLINES_NAME_GAUSSIAN] = "gaussian",
        [MAPLINES_NAME_HEADING_SIGMA] = "heading_sigma",
        [MAPLINES_NAME_KIND] = "kind",
        [MAPLINES_NAME_LEFT_OUT] = "left_out",
        [MAPLINES_NAME_LINES] = "lines",
        [MAPLINES_NAME_MAP_ERROR] = "map_error",
        [MAPLINES_NAME_MEAN] = "mean",
        [MAPLINES_NAME_MIXTURE] = "mixture",
        [MAPLINES_NAME_OFFSET_SIGMA] = "offset_sigma",
        [MAPLINES_NAME_POINT_SIGMA] = "point_sigma",
        [MAPLINES_NAME_POSE] = "pose",
        [MAPLINES_NAME_POSE_ERROR] = "pose_error",
        [MAPLINES_NAME_QUARTICS] = "quartics",
        [MAPLINES_NAME_SLOT] = "slot",
        [MAPLINES_NAME_SPECIFIC_COVS] = "specific_covs",
        [MAPLINES_NAME_STATUS] = "status",
        [MAPLINES_NAME_T_NS] = "t_ns",
        [MAPLINES_NAME_WEIGHTS] = "weights",
        [MAPLINES_NAME_X_MAX] = "x_max",
        [MAPLINES_NAME_X_MIN] = "x_min",
    };
    PyObject **objects = maplines_module_state(module)->objects;
    for (int i = 0; i < MAPLINES_NAMES; ++i)
    {
        objects[i] = PyUnicode_InternFromString(names[i]);
        if (objects[i] == NULL)
        {
            return -1;
        }
    }
    return 0;
}

/// Store an attribute of a module at a place.
static int import_to(PyObject **place, const char *module, const char *name)
{
    PyObject *imported = PyImport_ImportModule(module);
    if (imported == NULL)
    {
        return -1;
    }
    *place = PyObject_GetAttrString(imported, name);
    Py_DECREF(imported);
    return *place == NULL ? -1 : 0;
}

/// Store the members of an enumeration, in the order of the class.
static int import_members(PyObject **places, int count, const char *module, const char *name)
{
    PyObject *enumeration = NULL;
    if (import_to(&enumeration, module, name) < 0)
    {
        return -1;
    }
    PyObject *members = PySequence_Tuple(enumeration);
    Py_DECREF(enumeration);
    if (members == NULL)
    {
        return -1;
    }
    const bool has_all = PyTuple_Size(members) == count;
    for (int i = 0; has_all && i < count; ++i)
    {
        places[i] = Py_NewRef(PyTuple_GetItem(members, i));
    }
    Py_DECREF(members);
    if (!has_all)
    {
        PyErr_Format(PyExc_ImportError, "%s.%s must have %d members", module, name, count);
    }
    return has_all ? 0 : -1;
}

static int import_classes(PyObject **objects)
{
    static const struct {
        int place;
        const char *module;
        const char *name;
    } classes[] = {
        {MAPLINES_OF_GAUSSIAN, "maplines_can.values.gaussian", "Gaussian"},
        {MAPLINES_OF_MIXTURE, "maplines_can.values.mixture", "GaussianMixture"},
        {MAPLINES_OF_MAP_LINE, "maplines_can.values.line", "MapLine"},
        {MAPLINES_OF_POSE_ERROR, "maplines_can.values.scene", "PoseError"},
        {MAPLINES_OF_MAP_ERROR, "maplines_can.values.map_error", "MapError"},
        {MAPLINES_OF_SCENE, "maplines_can.values.scene", "Scene"},
        {MAPLINES_OF_RECEIVED_SCENE, "maplines_can.wire.reception.scenes", "ReceivedScene"},
    };
    for (size_t i = 0; i < sizeof classes / sizeof classes[0]; ++i)
    {
        if (import_to(&objects[classes[i].place], classes[i].module, classes[i].name) < 0)
        {
            return -1;
        }
    }
    return 0;
}

/// Fill the places of the package; what is there after an error is released by the caller.
static bool import_all(PyObject **objects)
{
    static const char line[] = "maplines_can.values.line";
    return import_classes(objects) == 0 &&
           import_members(objects + MAPLINES_OF_SLOTS, MAPLINES_SLOTS, line, "Slot") == 0 &&
           import_members(objects + MAPLINES_OF_KINDS, MAPLINES_VIRTUAL + 1, line, "Kind") == 0 &&
           import_members(objects + MAPLINES_OF_STATUSES, MAPLINES_OUT_OF_RANGE + 1, line,
                          "Status") == 0 &&
           import_members(objects + MAPLINES_OF_REASONS, MAPLINES_REASONS,
                          "maplines_can.wire.reasons", "Reason") == 0;
}

PyObject *const *maplines_objects(PyObject *module)
{
    PyObject **objects = maplines_module_state(module)->objects;
    if (objects[MAPLINES_OBJECTS - 1] != NULL)
    {
        return objects;
    }
    PyObject *imported[MAPLINES_OBJECTS] = {NULL};
    const bool has_all = maplines_numpy(module) != NULL && import_all(imported);
    for (int i = MAPLINES_OF_GAUSSIAN; i < MAPLINES_OBJECTS; ++i)
    {
        PyObject *unused = imported[i];
        if (has_all)
        {
            unused = objects[i]; // of an import that this one has caused
            objects[i] = imported[i];
        }
        Py_XDECREF(unused);
    }
    return has_all ? objects : NULL;
}
