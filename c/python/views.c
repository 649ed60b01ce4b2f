/* Views of a receiver: the newest lines and scene, checks and counters, as plain values.
 *
 * `NativeDecoder` makes the named tuples of the package of them.
 */
#include "receiver.h"

/// Number of the last check, or None.
static PyObject *status_of(maplines_e2e_status_t status)
{
    return status == MAPLINES_E2E_NONE ? Py_NewRef(Py_None) : PyLong_FromLong((long)status);
}

/// Newest line of a slot that was returned, or None.
static PyObject *line_of(const maplines_receiver_t *receiver, int slot)
{
    PyObject *line = receiver->newest[slot];
    return Py_NewRef(line == NULL ? Py_None : line);
}

/// Check of an owner; NULL with an exception if the DBC does not have it.
static maplines_check_t *check_of(maplines_decoder_t *decoder, int owner)
{
    if ((unsigned)owner >= MAPLINES_OWNERS || !decoder->dbc->messages[owner].is_present)
    {
        PyErr_SetString(PyExc_ValueError, "the DBC has no such owner");
        return NULL;
    }
    return &decoder->checks[owner];
}

/// Check of the owner of (owner, time), and the time as the core takes it; NULL with an exception.
static maplines_check_t *check_at(PyObject *self, PyObject *arguments, int64_t *t_ns)
{
    int owner = 0;
    int64_t now_ns = 0;
    PyObject *time = NULL;
    if (PyArg_ParseTuple(arguments, "iO", &owner, &time) == 0 ||
        !maplines_read_time(time, "now_ns", &now_ns))
    {
        return NULL;
    }
    maplines_decoder_t *decoder = maplines_receiver_of(self); // after all that may run code
    *t_ns = maplines_limited_time(now_ns);
    return decoder == NULL ? NULL : check_of(decoder, owner);
}

/// (line, age, is stale, state, status, two senders) of a slot at a time.
PyObject *maplines_receiver_view(PyObject *self, PyObject *arguments)
{
    int slot = 0;
    double stale_cycles = 0.0;
    int64_t now_ns = 0;
    PyObject *time = NULL;
    maplines_view_t view;
    if (PyArg_ParseTuple(arguments, "iOd", &slot, &time, &stale_cycles) == 0 ||
        !maplines_read_time(time, "now_ns", &now_ns))
    {
        return NULL;
    }
    maplines_decoder_t *decoder = maplines_receiver_of(self);
    if (decoder == NULL || check_of(decoder, slot) == NULL)
    {
        return NULL;
    }
    decoder->settings.stale_cycles = stale_cycles;
    maplines_latest(decoder, (maplines_owner_t)slot, now_ns, &view);
    return Py_BuildValue("NdNiNN", line_of((maplines_receiver_t *)self, slot), view.age,
                         PyBool_FromLong(view.is_stale), (int)view.state, status_of(view.status),
                         PyBool_FromLong(view.two_senders));
}

/// Lines of a scene. One that is the newest of its slot is that object.
static PyObject *new_scene_lines(const maplines_receiver_t *receiver, const maplines_scene_t *scene)
{
    const maplines_decoder_t *decoder = receiver->decoder;
    PyObject *lines = PyTuple_New(scene->count);
    for (int place = 0; lines != NULL && place < scene->count; ++place)
    {
        const maplines_line_t *line = &scene->lines[place];
        PyObject *newest = receiver->newest[line->slot];
        // The newest one is a copy of a line of the scene, with all its bytes.
        const maplines_line_t *known = &decoder->newest[line->slot];
        const bool is_same = memcmp(known, line, sizeof *line) == 0; // NOLINT(bugprone-*,cert-*)
        const bool is_newest = decoder->dbc->is_conditional && newest != NULL && is_same;
        PyObject *made = is_newest ? Py_NewRef(newest)
                                   : maplines_new_scene_line(receiver->objects, scene, place);
        if (made == NULL || PyTuple_SetItem(lines, place, made) < 0)
        {
            Py_CLEAR(lines);
        }
    }
    return lines;
}

/// `ReceivedScene` of a scene.
static PyObject *new_received(const maplines_receiver_t *receiver, const maplines_scene_t *scene)
{
    PyObject *lines = new_scene_lines(receiver, scene);
    PyObject *made = lines == NULL ? NULL : maplines_new_scene(receiver->objects, scene, lines);
    if (made == NULL)
    {
        return NULL;
    }
    return maplines_new_named(receiver->objects[MAPLINES_OF_RECEIVED_SCENE],
                              Py_BuildValue("NkLd", made, (unsigned long)scene->counter,
                                            (long long)scene->t_ns, (double)scene->age));
}

/// The newest scene, or None.
PyObject *maplines_receiver_scene(PyObject *self, PyObject *unused)
{
    (void)unused;
    maplines_receiver_t *receiver = (maplines_receiver_t *)self;
    maplines_decoder_t *decoder = maplines_receiver_of(self);
    if (decoder == NULL)
    {
        return NULL;
    }
    if (receiver->received != NULL && decoder->epochs.is_built)
    {
        return Py_NewRef(receiver->received);
    }
    const maplines_scene_t *newest = decoder->dbc->has_pose ? maplines_newest_scene(decoder) : NULL;
    if (newest == NULL)
    {
        Py_RETURN_NONE;
    }
    const maplines_scene_t scene = *newest; // what is made may run code that feeds frames
    Py_CLEAR(receiver->received);
    PyObject *received = new_received(receiver, &scene);
    if (received != NULL && receiver->received == NULL)
    {
        receiver->received = Py_NewRef(received);
    }
    return received;
}

/// (age, is stale, state, status, states of the slots of its lines, two senders) of the newest
/// scene at a time.
PyObject *maplines_receiver_scene_view(PyObject *self, PyObject *arguments)
{
    double stale_cycles = 0.0;
    int64_t now_ns = 0;
    PyObject *time = NULL;
    maplines_scene_view_t view;
    if (PyArg_ParseTuple(arguments, "Od", &time, &stale_cycles) == 0 ||
        !maplines_read_time(time, "now_ns", &now_ns))
    {
        return NULL;
    }
    maplines_decoder_t *decoder = maplines_receiver_of(self);
    if (decoder == NULL)
    {
        return NULL;
    }
    decoder->settings.stale_cycles = stale_cycles;
    maplines_latest_scene(decoder, now_ns, &view);
    const int count = view.scene == NULL ? 0 : view.scene->count;
    PyObject *states = PyTuple_New(count);
    for (int i = 0; states != NULL && i < count; ++i)
    {
        PyObject *state = PyLong_FromLong((long)view.slot_states[i]);
        if (state == NULL || PyTuple_SetItem(states, i, state) < 0)
        {
            Py_CLEAR(states);
        }
    }
    return states == NULL
               ? NULL
               : Py_BuildValue("dNiNNN", view.age, PyBool_FromLong(view.is_stale), (int)view.state,
                               status_of(view.status), states, PyBool_FromLong(view.two_senders));
}

/* ---- checks and counters ----------------------------------------------------------------------
 */

/// (state, status, lost, ahead, two senders, checks by outcome) of an owner.
PyObject *maplines_receiver_check(PyObject *self, PyObject *owner)
{
    maplines_decoder_t *decoder = maplines_receiver_of(self);
    const int number = decoder == NULL ? -1 : (int)PyLong_AsLong(owner);
    const maplines_check_t *check = decoder == NULL ? NULL : check_of(decoder, number);
    if (check == NULL)
    {
        return NULL;
    }
    return Py_BuildValue(
        "iNKkNN(KKKKKK)", (int)check->machine.state, status_of(check->status),
        (unsigned long long)check->lost, (unsigned long)check->ahead,
        PyBool_FromLong(check->conflict.is_confirmed),
        check->has_last ? PyLong_FromUnsignedLong(check->last) : Py_NewRef(Py_None),
        (unsigned long long)check->ok, (unsigned long long)check->no_new_data,
        (unsigned long long)check->errors, (unsigned long long)check->repeated,
        (unsigned long long)check->some_lost, (unsigned long long)check->wrong_sequence);
}

/// State of an owner at a time.
PyObject *maplines_receiver_elapse(PyObject *self, PyObject *arguments)
{
    int64_t t_ns = 0;
    maplines_check_t *check = check_at(self, arguments, &t_ns);
    return check == NULL ? NULL : PyLong_FromLong((long)maplines_check_elapse(check, t_ns));
}

/// (an owner has one sender, a counter was reused) at a time.
PyObject *maplines_receiver_senders(PyObject *self, PyObject *arguments)
{
    int64_t t_ns = 0;
    const maplines_check_t *check = check_at(self, arguments, &t_ns);
    if (check == NULL)
    {
        return NULL;
    }
    return Py_BuildValue(
        "NN", PyBool_FromLong(maplines_has_one_sender(check, t_ns)),
        PyBool_FromLong(maplines_conflict_was_reused(&check->conflict, check->cycle_ns, t_ns)));
}

/// Dropped frames by reason.
PyObject *maplines_receiver_counts(PyObject *self, PyObject *unused)
{
    (void)unused;
    const maplines_receiver_t *receiver = (maplines_receiver_t *)self;
    const maplines_decoder_t *decoder = maplines_receiver_of(self);
    PyObject *counts = decoder == NULL ? NULL : PyDict_New();
    for (int i = 0; counts != NULL && i < MAPLINES_REASONS; ++i)
    {
        const uint64_t number = decoder->statistics.counts[i];
        if (number == 0)
        {
            continue;
        }
        PyObject *count = PyLong_FromUnsignedLongLong(number);
        if (count == NULL ||
            PyDict_SetItem(counts, receiver->objects[MAPLINES_OF_REASONS + i], count) < 0)
        {
            Py_CLEAR(counts);
        }
        Py_XDECREF(count);
    }
    return counts;
}

/// Numbers of a receiver; false with an exception.
static bool read_statistics(PyObject *self, maplines_statistics_t *numbers)
{
    const maplines_decoder_t *decoder = maplines_receiver_of(self);
    if (decoder != NULL)
    {
        maplines_statistics(decoder, numbers);
    }
    return decoder != NULL;
}

/// Number of maplines_statistics_t at an offset [byte], which is that of a uint64_t.
PyObject *maplines_receiver_number(PyObject *self, void *offset)
{
    maplines_statistics_t numbers;
    uint64_t number = 0;
    if (!read_statistics(self, &numbers))
    {
        return NULL;
    }
    memcpy(&number, (const char *)&numbers + (uintptr_t)offset, sizeof number);
    return PyLong_FromUnsignedLongLong(number);
}

/// Frames of transfers, mixtures and scenes that are not complete yet.
PyObject *maplines_receiver_pending(PyObject *self, void *unused)
{
    (void)unused;
    maplines_statistics_t numbers;
    return read_statistics(self, &numbers) ? PyLong_FromUnsignedLong(numbers.pending) : NULL;
}
