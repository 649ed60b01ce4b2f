/* The receiver: frames to lines, as `maplines_can.wire.reception.decoder.Decoder` has it.
 *
 * `_native.Decoder` is a base class of `NativeDecoder`. It holds the receiver in C, and the lines
 * and the scene that it has returned, so that the same line is always the same object.
 */
#include "receiver.h"

#include <stdlib.h>

maplines_decoder_t *maplines_receiver_of(PyObject *self)
{
    maplines_decoder_t *decoder = ((maplines_receiver_t *)self)->decoder;
    if (decoder == NULL)
    {
        PyErr_SetString(PyExc_RuntimeError, "the decoder is not initialised");
    }
    return decoder;
}

/* ---- arguments --------------------------------------------------------------------------------
 */

/// A time [ns] of any integral type, limited to the range of the core.
bool maplines_read_time(PyObject *value, const char *name, int64_t *t_ns)
{
    int overflow = 0;
    PyObject *whole = NULL;
    if (PyLong_CheckExact(value))
    {
        whole = Py_NewRef(value);
    }
    else if (PyFloat_Check(value))
    {
        const double number = PyFloat_AsDouble(value);
        if (!(floor(number) == number) || isinf(number))
        {
            PyErr_Format(PyExc_ValueError, "%s must be whole [ns], got %R", name, value);
            return false;
        }
        whole = PyLong_FromDouble(number);
    }
    else
    {
        whole = PyNumber_Index(value);
    }
    if (whole == NULL)
    {
        return false;
    }
    const long long t = PyLong_AsLongLongAndOverflow(whole, &overflow);
    Py_DECREF(whole);
    *t_ns = overflow > 0 ? INT64_MAX : overflow < 0 ? INT64_MIN : t;
    return !(t == -1 && overflow == 0 && PyErr_Occurred() != NULL);
}

/// Message of a CAN ID that is no int, or of a flag that is no bool, by the rules of a dictionary:
/// 1 if it is known, 0 if not, -1 with an exception. `routes` has (CAN ID, is extended) of all.
static int find_route(PyObject *routes, PyObject *can_id, PyObject *is_extended,
                      maplines_frame_t *frame)
{
    PyObject *key = PyTuple_Pack(2, can_id, is_extended);
    if (key == NULL)
    {
        return -1;
    }
    PyObject *known = PyDict_GetItemWithError(routes, key);
    Py_DECREF(key);
    if (known == NULL)
    {
        return PyErr_Occurred() == NULL ? 0 : -1;
    }
    frame->can_id = (uint32_t)PyLong_AsUnsignedLong(PyTuple_GetItem(known, 0));
    frame->is_extended = PyObject_IsTrue(PyTuple_GetItem(known, 1)) > 0;
    return 1;
}

/// Read the CAN ID of a frame: 1 if it may be that of a message, 0 if not, -1 with an exception.
static int read_can_id(PyObject *routes, PyObject *can_id, PyObject *is_extended,
                       maplines_frame_t *frame)
{
    if (!PyLong_CheckExact(can_id) || (is_extended != Py_True && is_extended != Py_False))
    {
        return find_route(routes, can_id, is_extended, frame);
    }
    int overflow = 0;
    const long long id = PyLong_AsLongLongAndOverflow(can_id, &overflow);
    frame->can_id = (uint32_t)id;
    frame->is_extended = is_extended == Py_True;
    return overflow == 0 && 0 <= id && id <= UINT32_MAX;
}

/// Copy a payload; of one that is longer than any frame, its beginning. False with an exception.
static bool read_data(PyObject *data, maplines_frame_t *frame)
{
    PyObject *bytes = NULL;
    if (PyBytes_Check(data))
    {
        bytes = Py_NewRef(data);
    }
    else
    {
        if (PyObject_Size(data) < 0) // an int has no payload, though bytes() takes one
        {
            return false;
        }
        bytes = PyObject_CallFunctionObjArgs((PyObject *)&PyBytes_Type, data, NULL);
        if (bytes == NULL)
        {
            return false;
        }
    }
    const size_t size = (size_t)PyBytes_Size(bytes);
    frame->length = (uint8_t)(size < sizeof frame->data ? size : sizeof frame->data);
    memcpy(frame->data, PyBytes_AsString(bytes), frame->length);
    Py_DECREF(bytes);
    return true;
}

/* ---- lines ------------------------------------------------------------------------------------
 */

/// Line of a slot whose record has a covariance of its own.
static PyObject *new_complete_line(const maplines_receiver_t *receiver, int slot)
{
    const maplines_line_t line = receiver->decoder->newest[slot];
    double cov[16];
    maplines_product_transposed(4, 4, 4, line.gaussian.factor[0], line.gaussian.factor[0], cov);
    PyObject *gaussian = maplines_new_gaussian(receiver->objects, 4, line.gaussian.mean, cov);
    return maplines_new_line(receiver->objects, &line, gaussian, NULL);
}

/// Mean and covariance of a mixture, whose components have these covariances.
static PyObject *new_overall(PyObject *const *objects, int count, const double *weights,
                             double (*means)[4], double (*covs)[16])
{
    double mean[4];
    double cov[16];
    double L[16];
    maplines_moments(count, weights, means, covs, mean, cov);
    if (!maplines_cholesky_factor(4, cov, L))
    {
        for (int i = 0; i < 4; ++i)
        {
            const double share = MAPLINES_DEFINITE_SHARE * cov[5 * i];
            cov[5 * i] = cov[5 * i] + share;
        }
    }
    return maplines_new_gaussian(objects, 4, mean, cov);
}

/// Line of a slot that is a mixture.
static PyObject *new_mixture_line(const maplines_receiver_t *receiver, int slot)
{
    const maplines_line_t line = receiver->decoder->newest[slot];
    const int count = line.components;
    double weights[MAPLINES_MAX_COMPONENTS];
    double means[MAPLINES_MAX_COMPONENTS][4];
    double covs[MAPLINES_MAX_COMPONENTS][16];
    PyObject *components[MAPLINES_MAX_COMPONENTS] = {NULL};
    for (int i = 0; i < count; ++i)
    {
        maplines_gaussian_t gaussian;
        (void)maplines_component(receiver->decoder, line.slot, (uint8_t)i, &gaussian, &weights[i]);
        memcpy(means[i], gaussian.mean, sizeof means[i]);
        maplines_product_transposed(4, 4, 4, gaussian.factor[0], gaussian.factor[0], covs[i]);
    }
    bool is_made = true;
    for (int i = 0; is_made && i < count; ++i)
    {
        components[i] = maplines_new_gaussian(receiver->objects, 4, means[i], covs[i]);
        is_made = components[i] != NULL;
    }
    PyObject *mixture =
        is_made ? maplines_new_mixture(receiver->objects, count, weights, components) : NULL;
    for (int i = 0; i < count; ++i)
    {
        Py_XDECREF(components[i]);
    }
    if (mixture == NULL)
    {
        return NULL;
    }
    PyObject *overall = new_overall(receiver->objects, count, weights, means, covs);
    return maplines_new_line(receiver->objects, &line, overall, mixture);
}

PyObject *maplines_new_scene_line(PyObject *const *objects, const maplines_scene_t *scene,
                                  int place)
{
    const maplines_line_t *line = &scene->lines[place];
    double cov[16];
    maplines_scene_covariance(scene, place, cov);
    PyObject *gaussian = maplines_new_gaussian(objects, 4, line->gaussian.mean, cov);
    return maplines_new_line(objects, line, gaussian, NULL);
}

/// List of the lines that a frame has completed, each of which is the newest of its slot.
static PyObject *new_lines(maplines_receiver_t *receiver, const maplines_fed_t *fed,
                           const maplines_scene_t *scene)
{
    PyObject *lines = PyList_New(fed->count);
    for (int i = 0; lines != NULL && i < fed->count; ++i)
    {
        const int slot = (int)fed->slots[i];
        PyObject *line = NULL;
        if (receiver->decoder->dbc->is_conditional)
        {
            line = maplines_new_scene_line(receiver->objects, scene, i);
        }
        else if (receiver->decoder->newest[slot].components > 1)
        {
            line = new_mixture_line(receiver, slot);
        }
        else
        {
            line = new_complete_line(receiver, slot);
        }
        PyObject *before = receiver->newest[slot];
        receiver->newest[slot] = Py_XNewRef(line);
        Py_XDECREF(before);
        if (line == NULL || PyList_SetItem(lines, i, line) < 0)
        {
            Py_CLEAR(lines);
        }
    }
    return lines;
}

/* ---- frames -----------------------------------------------------------------------------------
 */

/// Read a frame: 1 if it may be of a message, 0 if not, -1 with an exception. What is of no message
/// is not looked at.
static int read_frame(PyObject *routes, PyObject *const values[4], maplines_frame_t *frame,
                      int64_t *t_ns)
{
    const int is_possible = read_can_id(routes, values[0], values[3], frame);
    if (is_possible <= 0 ||
        (read_data(values[1], frame) && maplines_read_time(values[2], "t_ns", t_ns)))
    {
        return is_possible;
    }
    PyObject *type = NULL;
    PyObject *error = NULL;
    PyObject *traceback = NULL;
    PyErr_Fetch(&type, &error, &traceback);
    if (find_route(routes, values[0], values[3], frame) != 0)
    {
        PyErr_Restore(type, error, traceback);
        return -1;
    }
    Py_XDECREF(type);
    Py_XDECREF(error);
    Py_XDECREF(traceback);
    return 0;
}

static PyObject *feed_frame(maplines_receiver_t *receiver, PyObject *const values[4])
{
    maplines_decoder_t *decoder = receiver->decoder;
    maplines_frame_t frame;
    maplines_scene_t scene;
    int64_t t_ns = 0;
    const int is_possible = read_frame(receiver->routes, values, &frame, &t_ns);
    if (is_possible <= 0)
    {
        ++decoder->statistics.frames;
        decoder->statistics.counts[MAPLINES_FOREIGN] += is_possible == 0 ? 1U : 0U;
        return is_possible < 0
                   ? NULL
                   : Py_NewRef(receiver->objects[MAPLINES_OF_REASONS + MAPLINES_FOREIGN]);
    }
    const maplines_fed_t fed = maplines_feed_with(decoder, &frame, t_ns, &scene);
    if (fed.reason != MAPLINES_COMPLETE)
    {
        return Py_NewRef(receiver->objects[MAPLINES_OF_REASONS + (int)fed.reason]);
    }
    return new_lines(receiver, &fed, &scene);
}

static PyObject *receiver_feed(PyObject *self, PyObject *const *arguments, Py_ssize_t count,
                               PyObject *keywords)
{
    static const maplines_parameters_t parameters = {
        .function = "Decoder.feed",
        .names = {"can_id", "data", "t_ns", "is_extended"},
        .count = 4,
        .positional = 3,
        .required = 3,
    };
    maplines_receiver_t *receiver = (maplines_receiver_t *)self;
    PyObject *values[4] = {NULL, NULL, NULL, Py_False};
    if (maplines_receiver_of(self) == NULL ||
        !maplines_read_arguments(&parameters, arguments, count, keywords, values))
    {
        return NULL;
    }
    return feed_frame(receiver, values);
}

static PyObject *receiver_feed_all(PyObject *self, PyObject *frames)
{
    if (maplines_receiver_of(self) == NULL)
    {
        return NULL;
    }
    PyObject *iterator = PyObject_GetIter(frames);
    PyObject *answers = iterator == NULL ? NULL : PyList_New(0);
    PyObject *item = NULL;
    while (answers != NULL && (item = PyIter_Next(iterator)) != NULL)
    {
        PyObject *frame = PySequence_Tuple(item);
        PyObject *answer = NULL;
        Py_DECREF(item);
        if (frame != NULL && PyTuple_Size(frame) != 4)
        {
            PyErr_Format(PyExc_TypeError, "a frame must be a ReceivedFrame, of 4 values, got %zd",
                         PyTuple_Size(frame));
        }
        else if (frame != NULL)
        {
            PyObject *values[4];
            for (int i = 0; i < 4; ++i)
            {
                values[i] = PyTuple_GetItem(frame, i);
            }
            answer = feed_frame((maplines_receiver_t *)self, values);
        }
        Py_XDECREF(frame);
        if (answer == NULL || PyList_Append(answers, answer) < 0)
        {
            Py_CLEAR(answers);
        }
        Py_XDECREF(answer);
    }
    Py_XDECREF(iterator);
    if (PyErr_Occurred() != NULL)
    {
        Py_CLEAR(answers);
    }
    return answers;
}

static PyObject *receiver_expire(PyObject *self, PyObject *time)
{
    int64_t t_ns = 0;
    maplines_decoder_t *decoder = maplines_receiver_of(self);
    if (decoder == NULL || !maplines_read_time(time, "t_ns", &t_ns))
    {
        return NULL;
    }
    maplines_expire(decoder, t_ns);
    Py_RETURN_NONE;
}

/* ---- the type ---------------------------------------------------------------------------------
 */

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
    PyObject *module = PyType_GetModule(Py_TYPE(tables));
    const maplines_dbc_t *dbc = module == NULL ? NULL : maplines_dbc_of(module, tables);
    PyObject *const *objects = dbc == NULL ? NULL : maplines_objects(maplines_module_state(module));
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
    free(receiver->decoder);
    Py_XDECREF(receiver->tables);
    Py_XDECREF(receiver->routes);
    Py_XDECREF(receiver->module);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(self);
    Py_DECREF(type);
}

static PyMethodDef receiver_methods[] = {
    {"feed", (PyCFunction)(void (*)(void))receiver_feed, METH_FASTCALL | METH_KEYWORDS, NULL},
    {"feed_all", receiver_feed_all, METH_O, NULL},
    {"expire", receiver_expire, METH_O, NULL},
    {"_view", maplines_receiver_view, METH_VARARGS, NULL},
    {"scene", maplines_receiver_scene, METH_NOARGS, NULL},
    {"_scene_view", maplines_receiver_scene_view, METH_VARARGS, NULL},
    {"_check", maplines_receiver_check, METH_O, NULL},
    {"_elapse", maplines_receiver_elapse, METH_VARARGS, NULL},
    {"_senders", maplines_receiver_senders, METH_VARARGS, NULL},
    {"_dropped_frames", maplines_receiver_counts, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

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
