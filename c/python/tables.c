/* Tables of a DBC from the mapping that maplines_can.wire.c_tables.content_of returns.
 *
 * A member that the mapping lacks, or that is None, stays 0. An error sets an exception; the
 * readers below return false then.
 */
#include "native.h"

#include <stdlib.h>

/// Value of a key, borrowed; NULL without an exception if there is none, or if it is None.
static PyObject *value_of(PyObject *mapping, const char *key)
{
    PyObject *name = PyUnicode_FromString(key);
    if (name == NULL)
    {
        return NULL;
    }
    PyObject *value = PyDict_GetItemWithError(mapping, name);
    Py_DECREF(name);
    return value == Py_None ? NULL : value;
}

/// Value of an index, borrowed; NULL without an exception if there is none, or if it is None.
static PyObject *item_of(PyObject *mapping, int index)
{
    PyObject *number = PyLong_FromLong(index);
    if (number == NULL)
    {
        return NULL;
    }
    PyObject *value = PyDict_GetItemWithError(mapping, number);
    Py_DECREF(number);
    return value == Py_None ? NULL : value;
}

/// Nested mapping of a key, borrowed; NULL if there is none.
static PyObject *mapping_of(PyObject *mapping, const char *key)
{
    PyObject *value = value_of(mapping, key);
    if (value != NULL && !PyDict_Check(value))
    {
        PyErr_Format(PyExc_TypeError, "%s must be a dict", key);
        return NULL;
    }
    return value;
}

static bool read_integer(PyObject *mapping, const char *key, int64_t least, int64_t most,
                         int64_t *number)
{
    PyObject *value = value_of(mapping, key);
    *number = 0;
    if (value == NULL)
    {
        return PyErr_Occurred() == NULL;
    }
    *number = PyLong_AsLongLong(value);
    if (*number == -1 && PyErr_Occurred() != NULL)
    {
        return false;
    }
    if (*number < least || *number > most)
    {
        PyErr_Format(PyExc_ValueError, "%s must be from %lld to %lld, got %lld", key,
                     (long long)least, (long long)most, (long long)*number);
        return false;
    }
    return true;
}

static bool read_u8(PyObject *mapping, const char *key, uint8_t *number)
{
    int64_t value = 0;
    const bool is_read = read_integer(mapping, key, 0, UINT8_MAX, &value);
    *number = (uint8_t)value;
    return is_read;
}

static bool read_u16(PyObject *mapping, const char *key, uint16_t *number)
{
    int64_t value = 0;
    const bool is_read = read_integer(mapping, key, 0, UINT16_MAX, &value);
    *number = (uint16_t)value;
    return is_read;
}

static bool read_u32(PyObject *mapping, const char *key, uint32_t *number)
{
    int64_t value = 0;
    const bool is_read = read_integer(mapping, key, 0, UINT32_MAX, &value);
    *number = (uint32_t)value;
    return is_read;
}

static bool read_bool(PyObject *mapping, const char *key, bool *is_so)
{
    int64_t value = 0;
    const bool is_read = read_integer(mapping, key, 0, 1, &value);
    *is_so = value != 0;
    return is_read;
}

/// Read the members of a signal: what c_tables.signal_values returns.
static bool read_signal_values(PyObject *values, maplines_signal_t *signal)
{
    long long raw_min = 0;
    long long raw_max = 0;
    unsigned short first = 0;
    unsigned char length = 0;
    int is_motorola = 0;
    int is_signed = 0;
    if (!PyTuple_Check(values))
    {
        PyErr_SetString(PyExc_TypeError, "a signal must be a tuple");
        return false;
    }
    if (!PyArg_ParseTuple(values, "ddLLHbpp", &signal->factor, &signal->offset, &raw_min, &raw_max,
                          &first, &length, &is_motorola, &is_signed))
    {
        return false;
    }
    if (length < 1 || length > 64 || first + length > 8 * MAPLINES_MAX_RECORD)
    {
        PyErr_SetString(PyExc_ValueError, "a signal must be within a record");
        return false;
    }
    signal->raw_min = raw_min;
    signal->raw_max = raw_max;
    signal->first = first;
    signal->length = length;
    signal->is_motorola = is_motorola != 0;
    signal->is_signed = is_signed != 0;
    return true;
}

static bool read_signal(PyObject *mapping, const char *key, maplines_signal_t *signal)
{
    PyObject *values = value_of(mapping, key);
    if (values == NULL)
    {
        return PyErr_Occurred() == NULL;
    }
    return read_signal_values(values, signal);
}

static bool read_signals(PyObject *mapping, const char *key, int count, maplines_signal_t *signals)
{
    PyObject *items = mapping_of(mapping, key);
    for (int i = 0; items != NULL && i < count; i++)
    {
        PyObject *values = item_of(items, i);
        if (values != NULL && !read_signal_values(values, &signals[i]))
        {
            return false;
        }
    }
    return PyErr_Occurred() == NULL;
}

static bool read_cholesky(PyObject *content, const char *key, maplines_cholesky_t *code)
{
    PyObject *mapping = mapping_of(content, key);
    if (mapping == NULL)
    {
        return PyErr_Occurred() == NULL;
    }
    PyObject *order = mapping_of(mapping, "order");
    for (int i = 0; order != NULL && i < 4; i++)
    {
        PyObject *item = item_of(order, i);
        code->order[i] = item == NULL ? 0 : (uint8_t)(PyLong_AsUnsignedLong(item) & 3);
    }
    PyObject *reachable = mapping_of(mapping, "reachable");
    for (int i = 0; reachable != NULL && i < 4; i++)
    {
        PyObject *item = item_of(reachable, i);
        code->reachable[i] = item == NULL ? 0.0 : PyFloat_AsDouble(item);
    }
    if (PyErr_Occurred() != NULL)
    {
        return false;
    }
    return read_u8(mapping, "rows", &code->rows) && code->rows <= 4 &&
           read_signals(mapping, "pivot", 4, code->pivot) &&
           read_signals(mapping, "ratio", 6, code->ratio) &&
           read_signal(mapping, "inflation", &code->inflation);
}

static bool read_record(PyObject *content, const char *key, maplines_record_t *record)
{
    PyObject *mapping = mapping_of(content, key);
    if (mapping == NULL)
    {
        return PyErr_Occurred() == NULL;
    }
    return read_u8(mapping, "pages", &record->pages) &&
           read_u8(mapping, "short_pages", &record->short_pages) &&
           read_u16(mapping, "crc_byte", &record->crc_byte) &&
           read_u8(mapping, "fd_authentic", &record->fd_authentic) &&
           read_u8(mapping, "fd_freshness", &record->fd_freshness) &&
           read_u8(mapping, "fd_mac", &record->fd_mac) && record->pages <= MAPLINES_MAX_PAGES &&
           record->short_pages <= record->pages && record->crc_byte <= 8 * MAPLINES_MAX_PAGES - 2 &&
           read_signal(mapping, "page", &record->page) &&
           read_signals(mapping, "transfer_id", 2, record->transfer_id) &&
           read_signal(mapping, "counter", &record->counter);
}

static bool read_levels(PyObject *mapping, maplines_levels_t *levels)
{
    return read_signal(mapping, "lateral", &levels->lateral) &&
           read_signal(mapping, "points", &levels->points) &&
           read_signal(mapping, "shape", &levels->shape) &&
           read_signal(mapping, "quartic", &levels->quartic) &&
           read_signal(mapping, "fit_behind", &levels->fit_behind) &&
           read_signal(mapping, "fit_ahead", &levels->fit_ahead) &&
           read_bool(mapping, "shape_is_octave", &levels->shape_is_octave);
}

static bool read_messages(PyObject *mapping, maplines_messages_t *messages)
{
    return read_bool(mapping, "is_present", &messages->is_present) &&
           read_bool(mapping, "has_classic", &messages->has_classic) &&
           read_bool(mapping, "has_fd", &messages->has_fd) &&
           read_bool(mapping, "has_secured", &messages->has_secured) &&
           read_bool(mapping, "is_extended", &messages->is_extended) &&
           read_bool(mapping, "fd_is_extended", &messages->fd_is_extended) &&
           read_bool(mapping, "secured_is_extended", &messages->secured_is_extended) &&
           read_u8(mapping, "fd_length", &messages->fd_length) &&
           read_u16(mapping, "data_id", &messages->data_id) &&
           read_u16(mapping, "secured_data_id", &messages->secured_data_id) &&
           read_u32(mapping, "can_id", &messages->can_id) &&
           read_u32(mapping, "fd_can_id", &messages->fd_can_id) &&
           read_u32(mapping, "secured_can_id", &messages->secured_can_id) &&
           read_u32(mapping, "cycle_ms", &messages->cycle_ms);
}

/// Read the messages of all owners, and the levels of all slots.
static bool read_owners(PyObject *content, maplines_dbc_t *dbc)
{
    PyObject *messages = mapping_of(content, "messages");
    for (int owner = 0; messages != NULL && owner < MAPLINES_OWNERS; owner++)
    {
        PyObject *own = item_of(messages, owner);
        if (own != NULL && !read_messages(own, &dbc->messages[owner]))
        {
            return false;
        }
    }
    PyObject *levels = PyErr_Occurred() == NULL ? mapping_of(content, "slot_levels") : NULL;
    for (int slot = 0; levels != NULL && slot < MAPLINES_SLOTS; slot++)
    {
        PyObject *own = item_of(levels, slot);
        if (own != NULL && !read_levels(own, &dbc->slot_levels[slot]))
        {
            return false;
        }
    }
    return PyErr_Occurred() == NULL;
}

/// Copy the table of a straight line: an array of floats of shape (spacings, 11).
static bool read_straight(PyObject *content, maplines_tables_t *tables)
{
    PyObject *array = value_of(content, "straight");
    if (array == NULL)
    {
        return PyErr_Occurred() == NULL;
    }
    const size_t size = (size_t)tables->dbc.spacings * sizeof tables->straight[0];
    Py_buffer view;
    if (PyObject_GetBuffer(array, &view, PyBUF_C_CONTIGUOUS) < 0)
    {
        return false;
    }
    const bool has_size = view.len == (Py_ssize_t)size && size > 0;
    if (has_size)
    {
        tables->straight = malloc(size);
    }
    if (tables->straight != NULL)
    {
        memcpy(tables->straight, view.buf, size);
        tables->dbc.straight = (const float(*)[11])tables->straight;
    }
    PyBuffer_Release(&view);
    if (!has_size)
    {
        PyErr_SetString(PyExc_ValueError, "straight must be (spacings, 11) of float32");
    }
    else if (tables->straight == NULL)
    {
        PyErr_NoMemory();
    }
    return tables->straight != NULL;
}

static bool read_name(PyObject *content, maplines_tables_t *tables)
{
    PyObject *name = value_of(content, "name");
    PyObject *bytes = name == NULL ? NULL : PyUnicode_AsEncodedString(name, "utf-8", "replace");
    if (bytes == NULL)
    {
        return PyErr_Occurred() == NULL;
    }
    const size_t size = (size_t)PyBytes_Size(bytes) + 1;
    tables->name = malloc(size);
    if (tables->name == NULL)
    {
        PyErr_NoMemory();
    }
    else
    {
        memcpy(tables->name, PyBytes_AsString(bytes), size);
        tables->dbc.name = tables->name;
    }
    Py_DECREF(bytes);
    return tables->name != NULL;
}

static bool read_content(PyObject *content, maplines_tables_t *tables)
{
    maplines_dbc_t *dbc = &tables->dbc;
    PyObject *levels = mapping_of(content, "levels");
    return PyErr_Occurred() == NULL && (levels == NULL || read_levels(levels, &dbc->levels)) &&
           read_name(content, tables) && read_u8(content, "max_components", &dbc->max_components) &&
           dbc->max_components <= MAPLINES_MAX_COMPONENTS &&
           read_bool(content, "is_conditional", &dbc->is_conditional) &&
           read_bool(content, "has_pose", &dbc->has_pose) && read_owners(content, dbc) &&
           read_record(content, "line", &dbc->line) && read_record(content, "pose", &dbc->pose) &&
           read_signals(content, "mean", 4, dbc->mean) &&
           read_signal(content, "kind", &dbc->kind) && read_signal(content, "x_min", &dbc->x_min) &&
           read_signal(content, "x_max", &dbc->x_max) &&
           read_cholesky(content, "covariance", &dbc->covariance) &&
           read_signal(content, "status", &dbc->status) && read_signal(content, "age", &dbc->age) &&
           read_signal(content, "component_index", &dbc->component_index) &&
           read_signal(content, "component_count", &dbc->component_count) &&
           read_signal(content, "component_weight", &dbc->component_weight) &&
           read_signal(content, "has_covariance", &dbc->has_covariance) &&
           read_signals(content, "fine", 4, dbc->fine) &&
           read_signal(content, "pose_age", &dbc->pose_age) &&
           read_signal(content, "correlation_time", &dbc->correlation_time) &&
           read_signal(content, "map_offset", &dbc->map_offset) &&
           read_signal(content, "map_heading", &dbc->map_heading) &&
           read_cholesky(content, "pose_covariance", &dbc->pose_covariance) &&
           read_signals(content, "slot_counter", MAPLINES_SLOTS, dbc->slot_counter) &&
           read_u16(content, "spacings", &dbc->spacings) &&
           read_u16(content, "spacing_step", &dbc->spacing_step) && read_straight(content, tables);
}

static PyObject *tables_new(PyTypeObject *type, PyObject *args, PyObject *kwargs)
{
    static char *names[] = {"content", NULL};
    PyObject *content = NULL;
    if (!PyArg_ParseTupleAndKeywords(args, kwargs, "O!:Tables", names, &PyDict_Type, &content))
    {
        return NULL;
    }
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    maplines_tables_t *tables = (maplines_tables_t *)allocate(type, 0); // all zeros
    if (tables == NULL)
    {
        return NULL;
    }
    if (!read_content(content, tables))
    {
        if (PyErr_Occurred() == NULL)
        {
            PyErr_SetString(PyExc_ValueError, "content is not that of a DBC");
        }
        Py_DECREF(tables);
        return NULL;
    }
    return (PyObject *)tables;
}

static void tables_dealloc(PyObject *self)
{
    maplines_tables_t *tables = (maplines_tables_t *)self;
    PyTypeObject *type = Py_TYPE(self);
    free(tables->straight);
    free(tables->name);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(self);
    Py_DECREF(type);
}

static PyType_Slot tables_slots[] = {
    {Py_tp_new, (void *)tables_new},
    {Py_tp_dealloc, (void *)tables_dealloc},
    {Py_tp_doc, (void *)"Tables of a DBC, from what c_tables.content_of returns."},
    {0, NULL},
};

static PyType_Spec tables_spec = {
    .name = "maplines_can._native.Tables",
    .basicsize = sizeof(maplines_tables_t),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = tables_slots,
};

const maplines_dbc_t *maplines_dbc_of(PyObject *module, PyObject *tables)
{
    if (module == NULL || !PyObject_TypeCheck(tables, maplines_module_state(module)->tables))
    {
        PyErr_SetString(PyExc_TypeError, "tables must be _native.Tables");
        return NULL;
    }
    return &((maplines_tables_t *)tables)->dbc;
}

int maplines_add_tables(PyObject *module)
{
    maplines_module_t *state = maplines_module_state(module);
    state->tables = (PyTypeObject *)PyType_FromModuleAndSpec(module, &tables_spec, NULL);
    return state->tables == NULL ? -1 : PyModule_AddType(module, state->tables);
}
