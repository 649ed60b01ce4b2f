/* Frames to lines, as the methods of `maplines_can.wire.reception.decoder.Decoder`.
 */
#include "receiver.h"

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
    if (!PyTuple_Check(known) || PyTuple_Size(known) != 2)
    {
        PyErr_SetString(PyExc_TypeError, "routes must be tuples of a CAN ID and a bool");
        return -1;
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

void maplines_line_moments(const maplines_decoder_t *decoder, int slot,
                           const maplines_scene_t *scene, int place, double cov[16],
                           maplines_components_t *components)
{
    const maplines_line_t *line = &decoder->newest[slot];
    components->count = 0;
    if (decoder->dbc->is_conditional)
    {
        maplines_scene_covariance(scene, place, cov);
        return;
    }
    if (line->components <= 1)
    {
        maplines_product_transposed(4, 4, 4, line->gaussian.factor[0], line->gaussian.factor[0],
                                    cov);
        return;
    }
    components->count = line->components;
    for (int i = 0; i < components->count; ++i)
    {
        maplines_gaussian_t gaussian;
        (void)maplines_component(decoder, line->slot, (uint8_t)i, &gaussian,
                                 &components->weights[i]);
        memcpy(components->means[i], gaussian.mean, sizeof components->means[i]);
        maplines_product_transposed(4, 4, 4, gaussian.factor[0], gaussian.factor[0],
                                    components->covs[i]);
    }
    double L[16];
    maplines_moments(components->count, components->weights, components->means, components->covs,
                     components->mean, cov);
    if (!maplines_cholesky_factor(4, cov, L))
    {
        for (int i = 0; i < 4; ++i)
        {
            const double share = MAPLINES_DEFINITE_SHARE * cov[5 * i];
            cov[5 * i] = cov[5 * i] + share;
        }
    }
}

PyObject *maplines_new_moments_line(PyObject *const *objects, const maplines_line_t *line,
                                    const double cov[16], const maplines_components_t *components)
{
    const int count = components->count;
    const double *mean = count > 0 ? components->mean : line->gaussian.mean;
    PyObject *mixture = NULL;
    if (count > 0)
    {
        PyObject *gaussians[MAPLINES_MAX_COMPONENTS] = {NULL};
        bool is_made = true;
        for (int i = 0; is_made && i < count; ++i)
        {
            gaussians[i] =
                maplines_new_gaussian(objects, 4, components->means[i], components->covs[i]);
            is_made = gaussians[i] != NULL;
        }
        mixture =
            is_made ? maplines_new_mixture(objects, count, components->weights, gaussians) : NULL;
        for (int i = 0; i < count; ++i)
        {
            Py_XDECREF(gaussians[i]);
        }
        if (mixture == NULL)
        {
            return NULL;
        }
    }
    return maplines_new_line(objects, line, maplines_new_gaussian(objects, 4, mean, cov), mixture);
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
        double cov[16];
        maplines_components_t components;
        maplines_line_moments(receiver->decoder, slot, scene, i, cov, &components);
        const maplines_line_t newest = receiver->decoder->newest[slot];
        PyObject *line = maplines_new_moments_line(receiver->objects, &newest, cov, &components);
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
    maplines_frame_t frame;
    maplines_scene_t scene;
    int64_t t_ns = 0;
    const int is_possible = read_frame(receiver->routes, values, &frame, &t_ns);
    // Only now: what is read may run code, and other threads meanwhile.
    maplines_decoder_t *decoder =
        is_possible < 0 ? NULL : maplines_receiver_of((PyObject *)receiver);
    if (decoder == NULL)
    {
        return NULL;
    }
    if (is_possible == 0)
    {
        ++decoder->statistics.frames;
        ++decoder->statistics.counts[MAPLINES_FOREIGN];
        return Py_NewRef(receiver->objects[MAPLINES_OF_REASONS + MAPLINES_FOREIGN]);
    }
    const maplines_fed_t fed = maplines_feed_with(decoder, &frame, t_ns, &scene);
    if (fed.reason != MAPLINES_COMPLETE)
    {
        return Py_NewRef(receiver->objects[MAPLINES_OF_REASONS + (int)fed.reason]);
    }
    return new_lines(receiver, &fed, &scene);
}

PyObject *maplines_receiver_feed(PyObject *self, PyObject *const *arguments, Py_ssize_t count,
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

PyObject *maplines_receiver_feed_all(PyObject *self, PyObject *frames)
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

PyObject *maplines_receiver_expire(PyObject *self, PyObject *time)
{
    int64_t t_ns = 0;
    maplines_decoder_t *decoder =
        maplines_read_time(time, "t_ns", &t_ns) ? maplines_receiver_of(self) : NULL;
    if (decoder == NULL)
    {
        return NULL;
    }
    maplines_expire(decoder, t_ns);
    Py_RETURN_NONE;
}
