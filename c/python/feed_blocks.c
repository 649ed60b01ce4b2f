/* Arrays of frames to rows of lines and scenes: `_native.Decoder.feed_arrays`.
 *
 * A row is a structure whose members are those of a dtype of `recordings/line_block.py`, in its
 * order. Python's threads run while the frames are decoded.
 */
#include "receiver.h"

#include <math.h>
#include <stdlib.h>

/* ---- rows ------------------------------------------------------------------------------------ */

/// Line that a frame has completed: `LINE_ROW`.
typedef struct {
    int64_t frame; ///< place of the frame
    int64_t t_ns;
    double x_min, x_max, age;
    double mean[4];
    double cov[16];
    uint32_t counter; ///< of its last record
    uint32_t ahead;   ///< of the record before; 0 after a sequence break
    uint8_t slot, kind, status, components;
    uint8_t state, e2e_status;
    uint8_t two_senders, is_usable;
} line_row_t;

/// Component of a mixture: `COMPONENT_ROW`.
typedef struct {
    int64_t line; ///< place of its line among those of the call
    double weight;
    double mean[4];
    double cov[16];
} component_row_t;

/// Scene: `SCENE_ROW`.
typedef struct maplines_scene_row {
    int64_t frame; ///< place of the last frame that has changed it
    int64_t t_ns;
    double age, correlation_time;
    uint32_t counter;
    uint8_t count, state, two_senders, is_usable;
    uint8_t slots[MAPLINES_SLOTS];
    double x_min[MAPLINES_SLOTS], x_max[MAPLINES_SLOTS];
    double mean[MAPLINES_SLOTS][4];
    double cov[4 * MAPLINES_SLOTS][4 * MAPLINES_SLOTS];
} scene_row_t;

/// Rows in memory that grows.
typedef struct {
    char *rows;
    size_t size; ///< of a row [byte]
    size_t count, capacity;
} table_t;

/// Zeroed memory for one more row; NULL if there is none.
static void *new_row(table_t *table)
{
    if (table->count == table->capacity)
    {
        const size_t capacity = table->capacity == 0 ? 256 : 2 * table->capacity;
        char *rows = realloc(table->rows, capacity * table->size);
        if (rows == NULL)
        {
            return NULL;
        }
        table->rows = rows;
        table->capacity = capacity;
    }
    char *row = table->rows + table->count++ * table->size;
    return memset(row, 0, table->size);
}

static PyObject *bytes_of(const table_t *table)
{
    return PyBytes_FromStringAndSize(table->rows, (Py_ssize_t)(table->count * table->size));
}

/* ---- a call ---------------------------------------------------------------------------------- */

/// Frames of a call, and what has come of them.
typedef struct {
    const uint32_t *can_ids;
    const uint8_t *are_extended;
    const int64_t *times_ns;
    const uint8_t *lengths;
    const uint8_t *data;
    size_t width; ///< of the data of a frame [byte]
    const int64_t *places;
    uint8_t *reasons;
    Py_ssize_t frames, count; ///< of the block, and among them those at `places`
    bool has_scenes;
    table_t lines, components, scenes;
    int64_t newest[MAPLINES_SLOTS]; ///< row of the newest line of each slot, or -1
} feeding_t;

/// State after the last check: that of the slot or, if this is VALID, of the pose error.
static maplines_e2e_state_t state_of(const maplines_decoder_t *decoder, int slot)
{
    const maplines_e2e_state_t state = decoder->checks[slot].machine.state;
    return state == MAPLINES_E2E_VALID && decoder->dbc->is_conditional
               ? decoder->checks[MAPLINES_POSE].machine.state
               : state;
}

static bool has_two_senders(const maplines_decoder_t *decoder, int slot, int64_t t_ns)
{
    return !maplines_has_one_sender(&decoder->checks[slot], t_ns) ||
           (decoder->dbc->is_conditional &&
            !maplines_has_one_sender(&decoder->checks[MAPLINES_POSE], t_ns));
}

/// Add the line at a place of those that a frame has completed.
static bool add_line(feeding_t *feeding, const maplines_decoder_t *decoder,
                     const maplines_fed_t *fed, const maplines_scene_t *scene, int place,
                     int64_t frame)
{
    const int slot = (int)fed->slots[place];
    const maplines_line_t *line = &decoder->newest[slot];
    const maplines_check_t *check = &decoder->checks[slot];
    const int64_t t_ns = maplines_limited_time(feeding->times_ns[frame]);
    maplines_components_t components;
    line_row_t *row = new_row(&feeding->lines);
    if (row == NULL)
    {
        return false;
    }
    row->frame = frame;
    row->t_ns = line->t_ns;
    row->x_min = line->x_min;
    row->x_max = line->x_max;
    row->age = line->age;
    maplines_line_moments(decoder, slot, scene, place, row->cov, &components);
    memcpy(row->mean, components.count > 0 ? components.mean : line->gaussian.mean,
           sizeof row->mean);
    row->counter = check->last;
    row->ahead = check->ahead;
    row->slot = (uint8_t)slot;
    row->kind = (uint8_t)line->kind;
    row->status = (uint8_t)line->status;
    row->components = line->components;
    row->state = (uint8_t)state_of(decoder, slot);
    row->e2e_status = (uint8_t)check->status;
    row->two_senders = has_two_senders(decoder, slot, t_ns);
    row->is_usable = line->status != MAPLINES_OUT_OF_RANGE && isfinite(line->age) &&
                     row->state == (uint8_t)MAPLINES_E2E_VALID && row->two_senders == 0;
    feeding->newest[slot] = (int64_t)feeding->lines.count - 1;
    for (int i = 0; i < components.count; ++i)
    {
        component_row_t *component = new_row(&feeding->components);
        if (component == NULL)
        {
            return false;
        }
        component->line = feeding->newest[slot];
        component->weight = components.weights[i];
        memcpy(component->mean, components.means[i], sizeof component->mean);
        memcpy(component->cov, components.covs[i], sizeof component->cov);
    }
    return true;
}

static void read_scene(const maplines_decoder_t *decoder, const maplines_scene_t *scene,
                       int64_t frame, int64_t t_ns, scene_row_t *row)
{
    const maplines_check_t *of_pose = &decoder->checks[MAPLINES_POSE];
    bool are_valid = of_pose->machine.state == MAPLINES_E2E_VALID;
    double cov[16 * MAPLINES_SLOTS * MAPLINES_SLOTS];
    memset(row, 0, sizeof *row);
    row->frame = frame;
    row->t_ns = scene->t_ns;
    row->age = scene->age;
    row->correlation_time = scene->correlation_time;
    row->counter = scene->counter;
    row->count = scene->count;
    row->state = (uint8_t)of_pose->machine.state;
    row->two_senders = !maplines_has_one_sender(of_pose, t_ns);
    maplines_all_covariances(scene, cov);
    const int n = 4 * scene->count;
    for (int i = 0; i < n; ++i)
    {
        memcpy(row->cov[i], cov + i * n, (size_t)n * sizeof(double));
    }
    for (int place = 0; place < scene->count; ++place)
    {
        const maplines_line_t *line = &scene->lines[place];
        const maplines_check_t *check = &decoder->checks[line->slot];
        row->slots[place] = (uint8_t)line->slot;
        row->x_min[place] = line->x_min;
        row->x_max[place] = line->x_max;
        memcpy(row->mean[place], line->gaussian.mean, sizeof row->mean[place]);
        are_valid = are_valid && check->machine.state == MAPLINES_E2E_VALID;
        row->two_senders = row->two_senders != 0 || !maplines_has_one_sender(check, t_ns);
    }
    row->is_usable = are_valid && isfinite(row->age) && row->two_senders == 0;
}

/// Add the scene that is shown, if there is one.
static bool add_shown(feeding_t *feeding, maplines_receiver_t *receiver)
{
    if (receiver->shown == NULL)
    {
        return true;
    }
    scene_row_t *row = new_row(&feeding->scenes);
    if (row != NULL)
    {
        *row = *receiver->shown;
        free(receiver->shown);
        receiver->shown = NULL;
    }
    return row != NULL;
}

/// Show the newest scene, which a frame may have changed; the one before is complete.
static bool see_scene(feeding_t *feeding, maplines_receiver_t *receiver, int64_t frame)
{
    maplines_decoder_t *decoder = receiver->decoder;
    if (receiver->shown != NULL && decoder->epochs.is_built)
    {
        return true;
    }
    const maplines_scene_t *scene = maplines_newest_scene(decoder);
    if (scene == NULL)
    {
        return true;
    }
    scene_row_t *shown = receiver->shown;
    if (shown != NULL && (shown->counter != scene->counter || shown->t_ns != scene->t_ns) &&
        !add_shown(feeding, receiver))
    {
        return false;
    }
    if (receiver->shown == NULL)
    {
        receiver->shown = malloc(sizeof *receiver->shown);
    }
    if (receiver->shown == NULL)
    {
        return false;
    }
    read_scene(decoder, scene, frame, maplines_limited_time(feeding->times_ns[frame]),
               receiver->shown);
    return true;
}

/// Decode all frames; false if there is no memory.
static bool feed_frames(feeding_t *feeding, maplines_receiver_t *receiver)
{
    maplines_decoder_t *decoder = receiver->decoder;
    maplines_frame_t frame;
    maplines_scene_t scene;
    memset(&frame, 0, sizeof frame);
    for (Py_ssize_t k = 0; k < feeding->count; ++k)
    {
        const int64_t i = feeding->places[k];
        if (i < 0 || i >= feeding->frames) // another thread has changed it
        {
            continue;
        }
        frame.can_id = feeding->can_ids[i];
        frame.is_extended = feeding->are_extended[i] != 0;
        const uint8_t length = feeding->lengths[i]; // another thread may have changed it
        frame.length = length <= feeding->width ? length : (uint8_t)feeding->width;
        const uint8_t *data = feeding->data + (size_t)i * feeding->width;
        for (size_t byte = 0; byte < feeding->width; ++byte)
        {
            frame.data[byte] = data[byte];
        }
        const maplines_fed_t fed =
            maplines_feed_with(decoder, &frame, feeding->times_ns[i], &scene);
        feeding->reasons[i] = (uint8_t)fed.reason; // -1 becomes 255
        bool is_added = true;
        for (int place = 0; is_added && place < fed.count; ++place)
        {
            is_added = add_line(feeding, decoder, &fed, &scene, place, i);
        }
        if (!is_added || (feeding->has_scenes && !see_scene(feeding, receiver, i)))
        {
            return false;
        }
    }
    return true;
}

/// Make the newest lines, as `feed` has them.
static bool renew_lines(const feeding_t *feeding, maplines_receiver_t *receiver)
{
    maplines_components_t components;
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        const int64_t place = feeding->newest[slot];
        if (place < 0 || feeding->lines.rows == NULL)
        {
            continue;
        }
        const line_row_t *row = (const line_row_t *)(const void *)feeding->lines.rows + place;
        const maplines_line_t line = receiver->decoder->newest[slot];
        components.count = 0;
        memcpy(components.mean, row->mean, sizeof components.mean);
        for (size_t i = 0; i < feeding->components.count; ++i)
        {
            const component_row_t *one =
                (const component_row_t *)(const void *)feeding->components.rows + i;
            if (one->line == place)
            {
                const int k = components.count++;
                components.weights[k] = one->weight;
                memcpy(components.means[k], one->mean, sizeof components.means[k]);
                memcpy(components.covs[k], one->cov, sizeof components.covs[k]);
            }
        }
        PyObject *made = maplines_new_moments_line(receiver->objects, &line, row->cov, &components);
        if (made == NULL)
        {
            return false;
        }
        PyObject *before = receiver->newest[slot];
        receiver->newest[slot] = made;
        Py_XDECREF(before);
    }
    return true;
}

/// Hold the arrays of a call; false with an exception.
static bool hold_frames(feeding_t *feeding, maplines_arrays_t *arrays, PyObject *const *values)
{
    const Py_ssize_t n = PyObject_Size(values[0]);
    const Py_ssize_t count = n < 0 ? -1 : PyObject_Size(values[5]);
    PyObject *width = count < 0 ? NULL : PyObject_GetAttrString(values[4], "nbytes");
    const Py_ssize_t bytes = width == NULL ? -1 : PyLong_AsSsize_t(width);
    Py_XDECREF(width);
    if (bytes < 0)
    {
        return false;
    }
    feeding->frames = n;
    feeding->count = count;
    feeding->width = n == 0 ? 0 : (size_t)(bytes / n);
    if ((feeding->can_ids = maplines_hold(arrays, values[0], 4 * n, false)) == NULL ||
        (feeding->are_extended = maplines_hold(arrays, values[1], n, false)) == NULL ||
        (feeding->times_ns = maplines_hold(arrays, values[2], 8 * n, false)) == NULL ||
        (feeding->lengths = maplines_hold(arrays, values[3], n, false)) == NULL ||
        (feeding->data = maplines_hold(arrays, values[4], (Py_ssize_t)feeding->width * n, false)) ==
            NULL ||
        (feeding->places = maplines_hold(arrays, values[5], 8 * count, false)) == NULL ||
        (feeding->reasons = maplines_hold(arrays, values[6], n, true)) == NULL)
    {
        return false;
    }
    if (feeding->width > sizeof((maplines_frame_t *)NULL)->data)
    {
        PyErr_SetString(PyExc_ValueError, "a frame has at most 64 bytes of data");
        return false;
    }
    for (Py_ssize_t k = 0; k < count; ++k)
    {
        const int64_t i = feeding->places[k];
        if (i < 0 || i >= n || feeding->lengths[i] > feeding->width)
        {
            PyErr_SetString(PyExc_ValueError, "places must be of frames, with all of their data");
            return false;
        }
    }
    return true;
}

/// feed_arrays(can_id, is_extended, t_ns, length, data, places, reasons, scenes) -> rows of lines,
/// components and scenes, as bytes. It writes the reason of each frame, and 255 if it has completed
/// lines. `scenes` is 0 for none, 1 for those that are complete, 2 for the last one, too.
PyObject *maplines_receiver_feed_arrays(PyObject *self, PyObject *const *arguments,
                                        Py_ssize_t count)
{
    maplines_receiver_t *receiver = (maplines_receiver_t *)self;
    maplines_arrays_t arrays = {.count = 0};
    feeding_t feeding = {
        .lines.size = sizeof(line_row_t),
        .components.size = sizeof(component_row_t),
        .scenes.size = sizeof(scene_row_t),
    };
    memset(feeding.newest, 0xff, sizeof feeding.newest); // -1 each
    if (maplines_receiver_of(self) == NULL)
    {
        return NULL;
    }
    if (count != 8)
    {
        PyErr_Format(PyExc_TypeError, "there must be 8 arguments, got %zd", count);
        return NULL;
    }
    const long scenes = PyLong_AsLong(arguments[7]);
    PyObject *rows = NULL;
    if (!(scenes == -1 && PyErr_Occurred() != NULL) && hold_frames(&feeding, &arrays, arguments) &&
        maplines_receiver_of(self) != NULL)
    {
        bool has_memory = true;
        feeding.has_scenes = scenes > 0 && receiver->decoder->dbc->has_pose;
        receiver->is_busy = true;
        Py_BEGIN_ALLOW_THREADS;
        has_memory = feed_frames(&feeding, receiver);
        Py_END_ALLOW_THREADS;
        receiver->is_busy = false;
        has_memory = has_memory && (scenes != 2 || add_shown(&feeding, receiver));
        if (!has_memory)
        {
            PyErr_NoMemory();
        }
        else if (renew_lines(&feeding, receiver))
        {
            rows = Py_BuildValue("NNN", bytes_of(&feeding.lines), bytes_of(&feeding.components),
                                 bytes_of(&feeding.scenes));
        }
    }
    maplines_release_arrays(&arrays);
    free(feeding.lines.rows);
    free(feeding.components.rows);
    free(feeding.scenes.rows);
    return rows;
}
