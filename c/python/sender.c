/* Lines to frames. What is unusual, and all that is wrong, is left to the Python package. */
#include "sender.h"

/* ---- frames ---------------------------------------------------------------------------------- */

bool maplines_has_form(const maplines_dbc_t *dbc, int owner, maplines_form_t form)
{
    const maplines_messages_t *messages = &dbc->messages[owner];
    const bool has_form = form == MAPLINES_AS_RECORD ||
                          (form == MAPLINES_AS_FD && messages->has_fd) ||
                          (form == MAPLINES_AS_PAGES && messages->has_classic);
    return messages->is_present && has_form;
}

/// Append an object to a list, and release it; false with an exception.
static bool append(PyObject *list, PyObject *object)
{
    const bool is_added = object != NULL && PyList_Append(list, object) == 0;
    Py_XDECREF(object);
    return is_added;
}

/// A Frame; NULL with an exception.
static PyObject *new_frame(const maplines_sender_t *sender, uint32_t can_id, const void *data,
                           size_t length, bool is_fd, bool is_extended)
{
    PyObject *frame = sender->new_frame(sender->frame, 4);
    PyObject *id = frame == NULL ? NULL : PyLong_FromUnsignedLong(can_id);
    PyObject *bytes = id == NULL ? NULL : PyBytes_FromStringAndSize(data, (Py_ssize_t)length);
    if (bytes == NULL)
    {
        Py_XDECREF(id);
        Py_XDECREF(frame);
        return NULL;
    }
    (void)PyTuple_SetItem(frame, 0, id);
    (void)PyTuple_SetItem(frame, 1, bytes);
    (void)PyTuple_SetItem(frame, 2, PyBool_FromLong(is_fd));
    (void)PyTuple_SetItem(frame, 3, PyBool_FromLong(is_extended));
    return frame;
}

bool maplines_add_frames(const maplines_sender_t *sender, int owner, const uint8_t *record,
                         size_t length, maplines_form_t form, PyObject *frames)
{
    const maplines_messages_t *messages = &sender->dbc->messages[owner];
    if (form == MAPLINES_AS_RECORD)
    {
        return append(frames, PyBytes_FromStringAndSize((const char *)record, (Py_ssize_t)length));
    }
    if (form == MAPLINES_AS_FD)
    {
        uint8_t data[MAPLINES_MAX_RECORD] = {0};
        memcpy(data, record, length);
        const size_t padded = length < messages->fd_length ? messages->fd_length : length;
        return append(frames, new_frame(sender, messages->fd_can_id, data, padded, true,
                                        messages->fd_is_extended));
    }
    bool is_added = true;
    for (size_t start = 0; is_added && start < length; start += 8)
    {
        is_added = append(frames, new_frame(sender, messages->can_id, record + start, 8, false,
                                            messages->is_extended));
    }
    return is_added;
}

bool maplines_read_counter(PyObject *counters, PyObject *owner, uint32_t *counter)
{
    PyObject *value = PyDict_GetItemWithError(counters, owner); // borrowed
    *counter = 0;
    if (value == NULL)
    {
        return PyErr_Occurred() == NULL;
    }
    if (!PyLong_Check(value))
    {
        return false;
    }
    *counter = (uint32_t)PyLong_AsUnsignedLongLongMask(value);
    return true;
}

bool maplines_set_counter(PyObject *counters, PyObject *owner, uint32_t counter)
{
    PyObject *value = PyLong_FromUnsignedLong(counter);
    const bool is_set = value != NULL && PyDict_SetItem(counters, owner, value) == 0;
    Py_XDECREF(value);
    return is_set;
}

/* ---- lines ----------------------------------------------------------------------------------- */

bool maplines_read_input(const maplines_sender_t *sender, PyObject *line, maplines_input_t *input)
{
    PyObject *const *objects = sender->objects;
    int slot = 0;
    int kind = 0;
    int status = 0;
    memset(input, 0, sizeof *input);
    if (!maplines_read_enum_of(line, objects[MAPLINES_NAME_SLOT], MAPLINES_SLOTS - 1, &slot) ||
        !maplines_read_enum_of(line, objects[MAPLINES_NAME_KIND], MAPLINES_VIRTUAL, &kind) ||
        !maplines_read_enum_of(line, objects[MAPLINES_NAME_STATUS], MAPLINES_OUT_OF_RANGE,
                               &status) ||
        !maplines_read_double_of(line, objects[MAPLINES_NAME_X_MIN], &input->x_min) ||
        !maplines_read_double_of(line, objects[MAPLINES_NAME_X_MAX], &input->x_max) ||
        !maplines_read_double_of(line, objects[MAPLINES_NAME_AGE], &input->age))
    {
        return false;
    }
    input->slot = (maplines_owner_t)slot;
    input->kind = (maplines_kind_t)kind;
    input->status = (maplines_status_t)status;
    return maplines_check_input(input) == MAPLINES_SENT;
}

bool maplines_read_gaussian(const maplines_sender_t *sender, PyObject *gaussian, double *mean,
                            double *cov)
{
    static const Py_ssize_t shape[2] = {4, 4};
    if (gaussian == NULL ||
        !maplines_read_doubles_of(gaussian, sender->objects[MAPLINES_NAME_MEAN], 1, shape, mean) ||
        !maplines_read_doubles_of(gaussian, sender->objects[MAPLINES_NAME_COV], 2, shape, cov))
    {
        return false;
    }
    bool is_usual = true;
    for (int i = 0; i < 4; i++)
    {
        is_usual = is_usual && fabs(mean[i]) < (double)INFINITY && cov[5 * i] >= 0.0;
    }
    for (int i = 0; i < 16; i++)
    {
        const double mirrored = cov[4 * (i % 4) + i / 4];
        is_usual = is_usual && fabs(cov[i]) <= MAPLINES_GREATEST_COV && cov[i] >= mirrored &&
                   cov[i] <= mirrored;
    }
    return is_usual;
}

/// Append the frames of a record, and count it; false with an exception.
static bool send_draft(const maplines_sender_t *sender, const maplines_draft_t *draft,
                       maplines_form_t form, uint32_t *counter, PyObject *frames)
{
    const maplines_dbc_t *dbc = sender->dbc;
    const int slot = (int)draft->line->slot;
    const size_t length = 8U * (size_t)dbc->line.pages;
    const uint64_t mask = ((uint64_t)1 << dbc->line.counter.length) - 1U;
    uint8_t record[MAPLINES_MAX_RECORD] = {0};
    (void)maplines_write_complete(dbc, draft, record);
    maplines_seal(dbc, slot, record, length, (uint32_t)(*counter & mask));
    *counter = maplines_next_counter(dbc, slot, *counter);
    return maplines_add_frames(sender, slot, record, length, form, frames);
}

/// Append the frames of a line with one Gaussian; false if it is unusual, or with an exception.
static bool send_gaussian(const maplines_sender_t *sender, PyObject *line,
                          const maplines_input_t *input, maplines_form_t form, uint32_t *counter,
                          PyObject *frames)
{
    maplines_draft_t draft;
    double mean[4];
    memset(&draft, 0, sizeof draft);
    PyObject *gaussian = PyObject_GetAttr(line, sender->objects[MAPLINES_NAME_GAUSSIAN]);
    const bool is_read = maplines_read_gaussian(sender, gaussian, mean, draft.cov);
    Py_XDECREF(gaussian);
    draft.line = input;
    draft.mean = mean;
    draft.count = 1;
    draft.weight = 1.0;
    return is_read && send_draft(sender, &draft, form, counter, frames);
}

/// Read the components of a mixture that can be sent; their number, or 0 if it is unusual.
static int read_components(const maplines_sender_t *sender, PyObject *mixture,
                           maplines_component_t *components)
{
    const maplines_dbc_t *dbc = sender->dbc;
    double weights[MAPLINES_MAX_COMPONENTS];
    double total = 0.0;
    PyObject *given = PyObject_GetAttr(mixture, sender->objects[MAPLINES_NAME_COMPONENTS]);
    const Py_ssize_t count = given != NULL && PyTuple_Check(given) ? PyTuple_Size(given) : 0;
    bool is_usual = count >= 1 && count <= dbc->max_components &&
                    count <= MAPLINES_MAX_COMPONENTS && count - 1 <= dbc->component_index.raw_max &&
                    maplines_read_doubles_of(mixture, sender->objects[MAPLINES_NAME_WEIGHTS], 1,
                                             &count, weights);
    for (Py_ssize_t i = 0; is_usual && i < count; i++)
    {
        maplines_component_t *component = &components[i];
        component->weight = weights[i];
        total += weights[i];
        is_usual = weights[i] > 0.0 && weights[i] < 2.0 &&
                   maplines_read_gaussian(sender, PyTuple_GetItem(given, i), component->mean,
                                          component->cov[0]);
    }
    Py_XDECREF(given);
    return is_usual && fabs(total - 1.0) < 1e-8 ? (int)count : 0;
}

/// Append the frames of a mixture; false if it is unusual, or with an exception.
static bool send_mixture(const maplines_sender_t *sender, PyObject *mixture,
                         const maplines_input_t *input, maplines_form_t form, uint32_t *counter,
                         PyObject *frames)
{
    maplines_component_t components[MAPLINES_MAX_COMPONENTS];
    double weights[MAPLINES_MAX_COMPONENTS];
    double cover[16];
    const int count = read_components(sender, mixture, components);
    if (count == 0)
    {
        return false;
    }
    maplines_cover_mixture(sender->dbc, components, count, weights, cover);
    bool is_sent = true;
    for (int i = 0; is_sent && i < count; i++)
    {
        maplines_draft_t draft;
        memset(&draft, 0, sizeof draft);
        draft.line = input;
        draft.mean = components[i].mean;
        memcpy(draft.cov, components[i].cov, sizeof draft.cov);
        memcpy(draft.cover, cover, sizeof draft.cover);
        draft.index = i;
        draft.count = count;
        draft.weight = weights[i];
        is_sent = send_draft(sender, &draft, form, counter, frames);
    }
    return is_sent;
}

/// Frames of a line, and its counter set; NULL if it is unusual, or with an exception.
static PyObject *send_line(const maplines_sender_t *sender, PyObject *line, PyObject *counters,
                           maplines_form_t form)
{
    maplines_input_t input;
    uint32_t counter = 0;
    if (!maplines_read_input(sender, line, &input) ||
        !maplines_has_form(sender->dbc, (int)input.slot, form))
    {
        return NULL;
    }
    PyObject *slot = PyObject_GetAttr(line, sender->objects[MAPLINES_NAME_SLOT]);
    PyObject *mixture =
        slot == NULL ? NULL : PyObject_GetAttr(line, sender->objects[MAPLINES_NAME_MIXTURE]);
    PyObject *frames = mixture == NULL ? NULL : PyList_New(0);
    bool is_sent = frames != NULL && maplines_read_counter(counters, slot, &counter);
    if (is_sent && mixture == Py_None)
    {
        is_sent = send_gaussian(sender, line, &input, form, &counter, frames);
    }
    else if (is_sent)
    {
        is_sent = send_mixture(sender, mixture, &input, form, &counter, frames);
    }
    if (!is_sent || !maplines_set_counter(counters, slot, counter))
    {
        Py_CLEAR(frames);
    }
    Py_XDECREF(mixture);
    Py_XDECREF(slot);
    return frames;
}

/// Sender.lines(lines, counters, form): list of the frames of each line, and the counters advance;
/// None if a line is unusual. The counters, a dict, are then of no use.
static PyObject *send_lines(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    const maplines_sender_t *sender = (const maplines_sender_t *)self;
    int form = 0;
    if (count != 3 || !PyDict_Check(args[1]) ||
        !maplines_read_enum(args[2], MAPLINES_AS_RECORD, &form))
    {
        PyErr_SetString(PyExc_TypeError, "lines takes lines, a dict of counters and a form");
        return NULL;
    }
    if (sender->dbc->is_conditional || !(PyList_Check(args[0]) || PyTuple_Check(args[0])))
    {
        Py_RETURN_NONE;
    }
    PyObject *lines = PySequence_Tuple(args[0]); // of our own: reading a line may run any code
    PyObject *sent = lines == NULL ? NULL : PyList_New(0);
    const Py_ssize_t number = sent == NULL ? 0 : PyTuple_Size(lines);
    for (Py_ssize_t i = 0; sent != NULL && i < number; i++)
    {
        if (!append(sent,
                    send_line(sender, PyTuple_GetItem(lines, i), args[1], (maplines_form_t)form)))
        {
            Py_CLEAR(sent);
        }
    }
    Py_XDECREF(lines);
    return sent == NULL ? maplines_unusual() : sent;
}

/* ---- the type -------------------------------------------------------------------------------- */

static PyObject *sender_new(PyTypeObject *type, PyObject *args, PyObject *kwargs)
{
    static char *names[] = {"tables", "frame", NULL};
    PyObject *tables = NULL;
    PyObject *frame = NULL;
    PyObject *module = PyType_GetModule(type);
    if (module == NULL || !PyArg_ParseTupleAndKeywords(args, kwargs, "OO!:Sender", names, &tables,
                                                       &PyType_Type, &frame))
    {
        return NULL;
    }
    const maplines_dbc_t *dbc = maplines_dbc_of(module, tables);
    if (dbc == NULL || !PyType_IsSubtype((PyTypeObject *)frame, &PyTuple_Type))
    {
        if (dbc != NULL)
        {
            PyErr_SetString(PyExc_TypeError, "frame must be a subclass of tuple");
        }
        return NULL;
    }
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    maplines_sender_t *sender = (maplines_sender_t *)allocate(type, 0); // all zeros
    if (sender == NULL)
    {
        return NULL;
    }
    sender->tables = Py_NewRef(tables);
    sender->dbc = dbc;
    sender->frame = (PyTypeObject *)Py_NewRef(frame);
    sender->new_frame = (allocfunc)PyType_GetSlot(sender->frame, Py_tp_alloc);
    sender->scene = maplines_module_state(module)->scene;
    sender->objects = maplines_module_state(module)->objects;
    return (PyObject *)sender;
}

static void sender_dealloc(PyObject *self)
{
    maplines_sender_t *sender = (maplines_sender_t *)self;
    PyTypeObject *type = Py_TYPE(self);
    Py_XDECREF(sender->tables);
    Py_XDECREF((PyObject *)sender->frame);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(self);
    Py_DECREF(type);
}

static PyMethodDef sender_methods[] = {
    {"lines", (PyCFunction)(void (*)(void))send_lines, METH_FASTCALL,
     "lines(lines, counters, form): frames of each line, or None if one is unusual."},
    {"prepare", (PyCFunction)(void (*)(void))maplines_prepare_scene, METH_FASTCALL,
     "prepare(scene, is_full): a scene but for counters and ages, or None if it is unusual."},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot sender_slots[] = {
    {Py_tp_new, (void *)sender_new},
    {Py_tp_dealloc, (void *)sender_dealloc},
    {Py_tp_methods, (void *)sender_methods},
    {Py_tp_doc, (void *)"Sender(tables, frame): lines and scenes to frames of a class."},
    {0, NULL},
};

static PyType_Spec sender_spec = {
    .name = "maplines_can._native.Sender",
    .basicsize = sizeof(maplines_sender_t),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = sender_slots,
};

int maplines_add_sender(PyObject *module)
{
    maplines_module_t *state = maplines_module_state(module);
    state->sender = (PyTypeObject *)PyType_FromModuleAndSpec(module, &sender_spec, NULL);
    return state->sender == NULL ? -1 : PyModule_AddType(module, state->sender);
}
