/* The type `_native.Decoder`: a base class of `NativeDecoder`.
 *
 * It holds the receiver in C, and the lines and the scene that it has returned, so that the same
 * line is always the same object.
 */
#include "receiver.h"

#include <stdlib.h>

maplines_decoder_t *maplines_receiver_of(PyObject *self)
{
    const maplines_receiver_t *receiver = (maplines_receiver_t *)self;
    if (receiver->decoder == NULL)
    {
        PyErr_SetString(PyExc_RuntimeError, "the decoder is not initialised");
    }
    else if (receiver->is_busy)
    {
        PyErr_SetString(PyExc_RuntimeError,
                        "another thread feeds frames to the decoder, which is not thread-safe; "
                        "give each thread a decoder of its own, or hold a lock for each call");
        return NULL;
    }
    return receiver->decoder;
}

static bool read_unsigned(PyObject *value, uint8_t *number)
{
    const unsigned long read = PyLong_AsUnsignedLong(value);
    if (read == (unsigned long)-1 && PyErr_Occurred() != NULL)
    {
        return false;
    }
    *number = (uint8_t)read;
    return true;
}

/// Read the settings of an owner: time-out, cycle time [ns], and the members of `E2EConfig`.
static bool read_settings(PyObject *values, int owner, maplines_settings_t *settings)
{
    PyObject *e2e = NULL;
    long long timeout_ns = 0;
    long long cycle_ns = 0;
    maplines_e2e_config_t *config = &settings->e2e[owner];
    uint8_t *const members[] = {
        &config->max_delta_counter,     &config->window_size_init,
        &config->window_size_valid,     &config->window_size_invalid,
        &config->min_ok_state_init,     &config->min_ok_state_valid,
        &config->min_ok_state_invalid,  &config->max_error_state_init,
        &config->max_error_state_valid, &config->max_error_state_invalid,
    };
    const int count = (int)(sizeof members / sizeof members[0]);
    if (!PyArg_ParseTuple(values, "LLO!", &timeout_ns, &cycle_ns, &PyTuple_Type, &e2e))
    {
        return false;
    }
    if (PyTuple_Size(e2e) != count + 1)
    {
        PyErr_SetString(PyExc_ValueError, "an E2EConfig has 11 members");
        return false;
    }
    settings->timeout_ns[owner] = timeout_ns;
    settings->cycle_ns[owner] = cycle_ns;
    for (int i = 0; i < count; ++i)
    {
        if (!read_unsigned(PyTuple_GetItem(e2e, i), members[i]))
        {
            return false;
        }
    }
    config->clear_to_invalid = PyObject_IsTrue(PyTuple_GetItem(e2e, count)) > 0;
    return true;
}

/// Settings by owner number; those of other owners stay as they are.
static bool read_all_settings(PyObject *mapping, maplines_settings_t *settings)
{
    PyObject *key = NULL;
    PyObject *values = NULL;
    Py_ssize_t place = 0;
    while (PyDict_Next(mapping, &place, &key, &values) != 0)
    {
        const long owner = PyLong_AsLong(key);
        if (owner < 0 || owner >= MAPLINES_OWNERS || !PyTuple_Check(values))
        {
            PyErr_SetString(PyExc_ValueError, "settings must be tuples by owner number");
            return false;
        }
        if (!read_settings(values, (int)owner, settings))
        {
            return false;
        }
    }
    return true;
}

/// Initialise: `Decoder(tables, settings, routes)`.
static int receiver_init(PyObject *self, PyObject *arguments, PyObject *keywords)
{
    maplines_receiver_t *receiver = (maplines_receiver_t *)self;
    PyObject *tables = NULL;
    PyObject *wanted = NULL;
    PyObject *routes = NULL;
    if (keywords != NULL && PyDict_Size(keywords) > 0)
    {
        PyErr_SetString(PyExc_TypeError, "Decoder takes no keyword arguments");
        return -1;
    }
    if (!PyArg_ParseTuple(arguments, "OO!O!", &tables, &PyDict_Type, &wanted, &PyDict_Type,
                          &routes))
    {
        return -1;
    }
    if (receiver->decoder != NULL)
    {
        PyErr_SetString(PyExc_RuntimeError, "the decoder is initialised already");
        return -1;
    }
    PyObject *module = maplines_module_of(tables);
    const maplines_dbc_t *dbc = maplines_dbc_of(module, tables);
    PyObject *const *objects = dbc == NULL ? NULL : maplines_objects(module);
    if (objects == NULL)
    {
        return -1;
    }
    maplines_settings_t settings;
    maplines_default_settings(dbc, &settings);
    if (!read_all_settings(wanted, &settings))
    {
        return -1;
    }
    maplines_decoder_t *decoder = malloc(sizeof *decoder);
    if (decoder == NULL)
    {
        PyErr_NoMemory();
        return -1;
    }
    const char *problem = maplines_decoder_init(decoder, dbc, &settings);
    if (problem != NULL)
    {
        free(decoder);
        PyErr_SetString(PyExc_ValueError, problem);
        return -1;
    }
    receiver->tables = Py_NewRef(tables);
    receiver->module = Py_NewRef(module);
    receiver->routes = Py_NewRef(routes);
    receiver->objects = objects;
    receiver->decoder = decoder;
    return 0;
}

static int receiver_traverse(PyObject *self, visitproc visit, void *arg)
{
    maplines_receiver_t *receiver = (maplines_receiver_t *)self;
    Py_VISIT(Py_TYPE(self));
    Py_VISIT(receiver->tables);
    Py_VISIT(receiver->module);
    Py_VISIT(receiver->routes);
    Py_VISIT(receiver->received);
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        Py_VISIT(receiver->newest[slot]);
    }
    return 0;
}

/// Drop the objects that it has returned; what it needs to work stays.
static int receiver_clear(PyObject *self)
{
    maplines_receiver_t *receiver = (maplines_receiver_t *)self;
    Py_CLEAR(receiver->received);
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        Py_CLEAR(receiver->newest[slot]);
    }
    return 0;
}

static void receiver_dealloc(PyObject *self)
{
    maplines_receiver_t *receiver = (maplines_receiver_t *)self;
    PyTypeObject *type = Py_TYPE(self);
    PyObject_GC_UnTrack(self);
    (void)receiver_clear(self);
    free(receiver->shown);
    free(receiver->decoder);
    Py_XDECREF(receiver->tables);
    Py_XDECREF(receiver->routes);
    Py_XDECREF(receiver->module);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(self);
    Py_DECREF(type);
}

static PyMethodDef receiver_methods[] = {
    {"feed", (PyCFunction)(void (*)(void))maplines_receiver_feed, METH_FASTCALL | METH_KEYWORDS,
     NULL},
    {"feed_all", maplines_receiver_feed_all, METH_O, NULL},
    {"feed_arrays", (PyCFunction)(void (*)(void))maplines_receiver_feed_arrays, METH_FASTCALL,
     NULL},
    {"expire", maplines_receiver_expire, METH_O, NULL},
    {"_view", maplines_receiver_view, METH_VARARGS, NULL},
    {"scene", maplines_receiver_scene, METH_NOARGS, NULL},
    {"_scene_view", maplines_receiver_scene_view, METH_VARARGS, NULL},
    {"_check", maplines_receiver_check, METH_O, NULL},
    {"_elapse", maplines_receiver_elapse, METH_VARARGS, NULL},
    {"_senders", maplines_receiver_senders, METH_VARARGS, NULL},
    {"_dropped_frames", maplines_receiver_counts, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

// NOLINTBEGIN(performance-no-int-to-ptr): Python hands on any pointer
#define RECEIVER_NUMBER(name)                                                                      \
    {                                                                                              \
#name, maplines_receiver_number, NULL, NULL, (void *)offsetof(maplines_statistics_t, name) \
    }

static PyGetSetDef receiver_numbers[] = {
    RECEIVER_NUMBER(frames),
    RECEIVER_NUMBER(lines),
    RECEIVER_NUMBER(line_frames),
    RECEIVER_NUMBER(pose_errors),
    RECEIVER_NUMBER(pose_frames),
    RECEIVER_NUMBER(lost),
    {"pending", maplines_receiver_pending, NULL, NULL, NULL},
    {NULL, NULL, NULL, NULL, NULL},
};
// NOLINTEND(performance-no-int-to-ptr)

static PyType_Slot receiver_slots[] = {
    {Py_tp_init, (void *)receiver_init},
    {Py_tp_dealloc, (void *)receiver_dealloc},
    {Py_tp_traverse, (void *)receiver_traverse},
    {Py_tp_clear, (void *)receiver_clear},
    {Py_tp_methods, (void *)receiver_methods},
    {Py_tp_getset, (void *)receiver_numbers},
    {Py_tp_doc, (void *)"Receiver in C: a base class of NativeDecoder."},
    {0, NULL},
};

static PyType_Spec receiver_spec = {
    .name = "maplines_can._native.Decoder",
    .basicsize = sizeof(maplines_receiver_t),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC,
    .slots = receiver_slots,
};

int maplines_add_decoder(PyObject *module)
{
    PyObject *type = PyType_FromModuleAndSpec(module, &receiver_spec, NULL);
    const int added = type == NULL ? -1 : PyModule_AddType(module, (PyTypeObject *)type);
    Py_XDECREF(type);
    return added;
}
