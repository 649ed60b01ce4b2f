/* Scenes to frames: a prepared scene holds all but counters and ages. What is unusual, and all that
 * is wrong, is left to the Python package.
 */
#include "sender.h"

#include <stdlib.h>

/// Record of a line, without what changes with each cycle: page numbers, transfer IDs, counter,
/// checksum and age.
typedef struct {
    int slot;
    bool is_there; ///< it can be sent
    size_t length;
    uint8_t bytes[MAPLINES_MAX_RECORD];
} template_t;

/// A scene that was prepared, as a Python object: `_native.PreparedScene`.
typedef struct {
    PyObject_HEAD maplines_sender_t *sender;
    int count;                       ///< of the lines of the scene
    PyObject *slots[MAPLINES_SLOTS]; ///< of these
    template_t records[MAPLINES_SLOTS];
    maplines_scene_workspace_t space;
} prepared_t;

/* ---- prepare --------------------------------------------------------------------------------- */

/// Set all bits of a signal to 0.
static void clear_signal(const maplines_signal_t *signal, uint8_t *record, size_t length)
{
    uint8_t mask[MAPLINES_MAX_RECORD] = {0};
    maplines_put(signal, mask, -1);
    for (size_t i = 0; i < length; i++)
    {
        record[i] = (uint8_t)(record[i] & ~(unsigned)mask[i]);
    }
}

/// Write the records of the lines as far as they do not change.
static void write_records(const maplines_dbc_t *dbc, const maplines_given_t *given,
                          prepared_t *prepared)
{
    for (int i = 0; i < prepared->count; i++)
    {
        const maplines_scene_member_t *member = &prepared->space.members[i];
        const maplines_input_t *line = &given->lines[i];
        template_t *record = &prepared->records[i];
        record->slot = (int)line->slot;
        record->is_there = !dbc->is_conditional || member->left_out == MAPLINES_IN_SCENE;
        if (!record->is_there)
        {
            continue;
        }
        if (dbc->is_conditional)
        {
            record->length = maplines_write_conditional(dbc, line->kind, member, record->bytes);
            continue;
        }
        maplines_draft_t draft;
        memset(&draft, 0, sizeof draft);
        draft.line = line;
        draft.mean = line->mean;
        memcpy(draft.cov, given->covs[i], sizeof draft.cov);
        draft.count = 1;
        draft.weight = 1.0;
        record->length = 8U * (size_t)dbc->line.pages;
        (void)maplines_write_complete(dbc, &draft, record->bytes);
        clear_signal(&dbc->age, record->bytes, record->length);
    }
}

PyObject *maplines_prepare_scene(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    maplines_sender_t *sender = (maplines_sender_t *)self;
    int is_full = 0;
    if (count != 2 || !maplines_read_enum(args[1], 1, &is_full))
    {
        PyErr_SetString(PyExc_TypeError, "prepare takes a scene and a bool");
        return NULL;
    }
    if (!sender->dbc->has_pose)
    {
        Py_RETURN_NONE;
    }
    allocfunc allocate = (allocfunc)PyType_GetSlot(sender->scene, Py_tp_alloc);
    prepared_t *prepared = (prepared_t *)allocate(sender->scene, 0); // all zeros
    maplines_given_t *given = calloc(1, sizeof *given);
    if (prepared == NULL || given == NULL)
    {
        Py_XDECREF((PyObject *)prepared);
        free(given);
        return PyErr_NoMemory();
    }
    prepared->sender = (maplines_sender_t *)Py_NewRef(self);
    bool is_sent = maplines_read_scene(sender, args[0], prepared->slots, given);
    prepared->count = given->input.count;
    if (is_sent)
    {
        Py_BEGIN_ALLOW_THREADS; // all that is read now is a copy, or constant
        is_sent = maplines_encode_members(sender->dbc, &given->input, is_full != 0,
                                          &prepared->space) == MAPLINES_SENT;
        if (is_sent)
        {
            write_records(sender->dbc, given, prepared);
        }
        Py_END_ALLOW_THREADS;
    }
    free(given);
    if (!is_sent)
    {
        Py_DECREF((PyObject *)prepared);
        return maplines_unusual();
    }
    return (PyObject *)prepared;
}

/* ---- encode ---------------------------------------------------------------------------------- */

/// One cycle of a scene that is sent.
typedef struct {
    maplines_pose_cycle_t pose;
    bool is_sent[MAPLINES_SLOTS]; ///< by place
    double ages[MAPLINES_SLOTS];  ///< by place [s]
} cycle_t;

/// Read the age of an owner from a number, or from a dict; false if it is unusual.
static bool read_age(PyObject *ages, PyObject *owner, double *age)
{
    PyObject *value = PyDict_Check(ages) ? PyDict_GetItemWithError(ages, owner) : ages; // borrowed
    return maplines_read_double(value, age) && *age >= 0.0 &&
           (*age <= MAPLINES_LONGEST_AGE || isinf(*age));
}

/// Find the lines that are sent, by their slots; false if the scene has no record of one.
static bool read_sent(const prepared_t *prepared, PyObject *slots, cycle_t *cycle)
{
    bool is_wanted[MAPLINES_SLOTS] = {false};
    bool is_usual = PyTuple_Check(slots) != 0;
    for (Py_ssize_t i = 0; is_usual && i < PyTuple_Size(slots); i++)
    {
        int slot = 0;
        is_usual = maplines_read_enum(PyTuple_GetItem(slots, i), MAPLINES_SLOTS - 1, &slot);
        is_wanted[is_usual ? slot : 0] = true;
    }
    for (int i = 0; is_usual && i < prepared->count; i++)
    {
        const template_t *record = &prepared->records[i];
        cycle->is_sent[i] = is_wanted[prepared->space.members[i].slot];
        is_usual = record->is_there || !cycle->is_sent[i];
        cycle->pose.is_member[record->slot] =
            cycle->is_sent[i] && prepared->space.members[i].left_out == MAPLINES_IN_SCENE;
    }
    return is_usual;
}

/// Read counters and ages, and advance the counters; false if one is unusual.
static bool read_cycle(const prepared_t *prepared, PyObject *ages, PyObject *counters,
                       cycle_t *cycle)
{
    const maplines_dbc_t *dbc = prepared->sender->dbc;
    PyObject *pose = prepared->sender->objects[MAPLINES_NAME_POSE];
    const int of_pose = (int)MAPLINES_POSE;
    bool is_usual = read_age(ages, pose, &cycle->pose.age) &&
                    maplines_read_counter(counters, pose, &cycle->pose.first[of_pose]);
    for (int slot = 0; is_usual && slot < MAPLINES_SLOTS; slot++)
    {
        PyObject *number = PyLong_FromLong(slot);
        is_usual =
            number != NULL && maplines_read_counter(counters, number, &cycle->pose.first[slot]);
        Py_XDECREF(number);
    }
    memcpy(cycle->pose.following, cycle->pose.first, sizeof cycle->pose.following);
    cycle->pose.following[of_pose] =
        maplines_next_counter(dbc, of_pose, cycle->pose.first[of_pose]);
    for (int i = 0; is_usual && i < prepared->count; i++)
    {
        const int slot = prepared->records[i].slot;
        if (cycle->is_sent[i])
        {
            is_usual = dbc->is_conditional || read_age(ages, prepared->slots[i], &cycle->ages[i]);
            cycle->pose.following[slot] = maplines_next_counter(dbc, slot, cycle->pose.first[slot]);
        }
    }
    return is_usual;
}

/// Put the frames of a record into a dict; false if there is no message, or with an exception.
static bool put_frames(const maplines_sender_t *sender, PyObject *sent, PyObject *key, int owner,
                       uint8_t *record, size_t length, uint32_t counter, maplines_form_t form)
{
    const maplines_dbc_t *dbc = sender->dbc;
    const uint64_t mask = ((uint64_t)1 << maplines_layout(dbc, owner)->counter.length) - 1U;
    if (!maplines_has_form(dbc, owner, form))
    {
        return false;
    }
    maplines_seal(dbc, owner, record, length, (uint32_t)(counter & mask));
    PyObject *frames = PyList_New(0);
    const bool is_put = frames != NULL &&
                        maplines_add_frames(sender, owner, record, length, form, frames) &&
                        PyDict_SetItem(sent, key, frames) == 0;
    Py_XDECREF(frames);
    return is_put;
}

/// Put the frames of the pose error and of the lines that are sent; false as put_frames.
static bool put_scene(const prepared_t *prepared, const cycle_t *cycle, maplines_form_t form,
                      PyObject *sent)
{
    const maplines_sender_t *sender = prepared->sender;
    const maplines_dbc_t *dbc = sender->dbc;
    uint8_t bytes[MAPLINES_MAX_RECORD] = {0};
    const size_t length = maplines_write_pose(dbc, &prepared->space, &cycle->pose, bytes);
    const int pose = (int)MAPLINES_POSE;
    bool is_put = put_frames(sender, sent, sender->objects[MAPLINES_NAME_POSE], pose, bytes, length,
                             cycle->pose.first[pose], form);
    for (int i = 0; is_put && i < prepared->count; i++)
    {
        const template_t *record = &prepared->records[i];
        if (!cycle->is_sent[i])
        {
            continue;
        }
        memcpy(bytes, record->bytes, sizeof bytes);
        if (!dbc->is_conditional)
        {
            const double age = maplines_raw_above(&dbc->age, 1000.0 * cycle->ages[i]);
            maplines_put(&dbc->age, bytes, maplines_limited(&dbc->age, age));
        }
        is_put = put_frames(sender, sent, prepared->slots[i], record->slot, bytes, record->length,
                            cycle->pose.first[record->slot], form);
    }
    return is_put;
}

/// Set the counters that follow; false with an exception.
static bool set_counters(const prepared_t *prepared, const cycle_t *cycle, PyObject *counters)
{
    bool is_set = maplines_set_counter(counters, prepared->sender->objects[MAPLINES_NAME_POSE],
                                       cycle->pose.following[MAPLINES_POSE]);
    for (int i = 0; is_set && i < prepared->count; i++)
    {
        is_set = !cycle->is_sent[i] ||
                 maplines_set_counter(counters, prepared->slots[i],
                                      cycle->pose.following[prepared->records[i].slot]);
    }
    return is_set;
}

/// PreparedScene.encode(slots, ages, counters, form): frames by owner, and the counters advance;
/// None if something is unusual.
static PyObject *encode(PyObject *self, PyObject *const *args, Py_ssize_t count)
{
    const prepared_t *prepared = (const prepared_t *)self;
    int form = 0;
    if (count != 4 || !PyDict_Check(args[2]) ||
        !maplines_read_enum(args[3], MAPLINES_AS_RECORD, &form))
    {
        PyErr_SetString(PyExc_TypeError, "encode takes slots, ages, a dict of counters and a form");
        return NULL;
    }
    cycle_t cycle;
    memset(&cycle, 0, sizeof cycle);
    PyObject *sent = PyDict_New();
    if (sent == NULL || !read_sent(prepared, args[0], &cycle) ||
        !read_cycle(prepared, args[1], args[2], &cycle) ||
        !put_scene(prepared, &cycle, (maplines_form_t)form, sent) ||
        !set_counters(prepared, &cycle, args[2]))
    {
        Py_XDECREF(sent);
        return maplines_unusual();
    }
    return sent;
}

/* ---- what was encoded ------------------------------------------------------------------------ */

/// Tuple of raw values; NULL with an exception.
static PyObject *numbers(const int64_t *raw, Py_ssize_t count)
{
    PyObject *tuple = PyTuple_New(count);
    for (Py_ssize_t i = 0; tuple != NULL && i < count; i++)
    {
        PyObject *number = PyLong_FromLongLong(raw[i]);
        if (number == NULL || PyTuple_SetItem(tuple, i, number) < 0)
        {
            Py_CLEAR(tuple);
        }
    }
    return tuple;
}

/// PreparedScene.raw_pose(): raw values of the pose error: 4 pivots, 6 ratios, inflation, map
/// offset, map heading and correlation time.
static PyObject *raw_pose(PyObject *self, PyObject *Py_UNUSED(none))
{
    const maplines_scene_workspace_t *space = &((const prepared_t *)self)->space;
    int64_t raw[14];
    memcpy(raw, space->raw_pose, sizeof space->raw_pose);
    raw[11] = space->raw_offset;
    raw[12] = space->raw_heading;
    raw[13] = space->raw_time;
    return numbers(raw, 14);
}

/// PreparedScene.raw_line(place): raw values of a line of the scene: HasCovariance, 4 of the mean,
/// x_min, x_max, quartic, 2 of the fit range, 3 levels, 4 finer ones of the mean, and the
/// covariance as in raw_pose. None if the line is left out.
static PyObject *raw_line(PyObject *self, PyObject *number)
{
    const prepared_t *prepared = (const prepared_t *)self;
    int place = 0;
    if (!maplines_read_enum(number, prepared->count - 1, &place))
    {
        PyErr_SetString(PyExc_IndexError, "the scene has no such line");
        return NULL;
    }
    const maplines_scene_member_t *member = &prepared->space.members[place];
    if (member->left_out != MAPLINES_IN_SCENE)
    {
        Py_RETURN_NONE;
    }
    int64_t raw[28] = {0};
    raw[0] = member->is_full ? 1 : 0;
    memcpy(&raw[1], member->is_full ? member->raw_refined : member->raw_mean, 4 * sizeof raw[0]);
    memcpy(&raw[5], member->raw_range, sizeof member->raw_range);
    raw[7] = member->raw_quartic;
    memcpy(&raw[8], member->raw_fit, sizeof member->raw_fit);
    if (member->is_full)
    {
        memcpy(&raw[13], member->raw_fine, sizeof member->raw_fine);
        memcpy(&raw[17], member->raw_covariance, sizeof member->raw_covariance);
    }
    else
    {
        memcpy(&raw[10], member->raw_levels, sizeof member->raw_levels);
    }
    return numbers(raw, 28);
}

/// PreparedScene.left_out(): by line, why it does not belong to the scene; 0 if it does.
static PyObject *left_out(PyObject *self, PyObject *Py_UNUSED(none))
{
    const prepared_t *prepared = (const prepared_t *)self;
    int64_t reasons[MAPLINES_SLOTS];
    for (int i = 0; i < prepared->count; i++)
    {
        reasons[i] = (int64_t)prepared->space.members[i].left_out;
    }
    return numbers(reasons, prepared->count);
}

/* ---- the type -------------------------------------------------------------------------------- */

static void prepared_dealloc(PyObject *self)
{
    prepared_t *prepared = (prepared_t *)self;
    PyTypeObject *type = Py_TYPE(self);
    Py_XDECREF((PyObject *)prepared->sender);
    for (int i = 0; i < MAPLINES_SLOTS; i++)
    {
        Py_XDECREF(prepared->slots[i]);
    }
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(self);
    Py_DECREF(type);
}

static PyMethodDef prepared_methods[] = {
    {"encode", (PyCFunction)(void (*)(void))encode, METH_FASTCALL,
     "encode(slots, ages, counters, form): frames by owner, or None if something is unusual."},
    {"raw_pose", raw_pose, METH_NOARGS, "Raw values of the pose error."},
    {"raw_line", raw_line, METH_O, "Raw values of a line, or None if it is left out."},
    {"left_out", left_out, METH_NOARGS, "Why each line is left out; 0 if it is not."},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot prepared_slots[] = {
    {Py_tp_dealloc, (void *)prepared_dealloc},
    {Py_tp_methods, (void *)prepared_methods},
    {Py_tp_doc, (void *)"A scene but for counters and ages, from Sender.prepare."},
    {0, NULL},
};

static PyType_Spec prepared_spec = {
    .name = "maplines_can._native.PreparedScene",
    .basicsize = sizeof(prepared_t),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE | Py_TPFLAGS_DISALLOW_INSTANTIATION,
    .slots = prepared_slots,
};

int maplines_add_scene(PyObject *module)
{
    maplines_module_t *state = maplines_module_state(module);
    state->scene = (PyTypeObject *)PyType_FromModuleAndSpec(module, &prepared_spec, NULL);
    return state->scene == NULL ? -1 : PyModule_AddType(module, state->scene);
}
