/* Scenes as they are read: copies of all numbers, before the lock of the interpreter is released.
 */
#include "sender.h"

/// Read the lines, and their slots as objects; false if one is unusual.
static bool read_lines(const maplines_sender_t *sender, PyObject *scene, PyObject **slots,
                       maplines_given_t *given)
{
    PyObject *lines = PyObject_GetAttr(scene, sender->objects[MAPLINES_NAME_LINES]);
    const Py_ssize_t count = lines != NULL && PyTuple_Check(lines) ? PyTuple_Size(lines) : -1;
    bool is_used[MAPLINES_SLOTS] = {false};
    bool is_usual = count >= 0 && count <= MAPLINES_SLOTS;
    for (int i = 0; is_usual && i < count; i++)
    {
        PyObject *object = PyTuple_GetItem(lines, i); // borrowed from a tuple that is held
        maplines_input_t *line = &given->lines[i];
        PyObject *mixture = PyObject_GetAttr(object, sender->objects[MAPLINES_NAME_MIXTURE]);
        PyObject *gaussian = NULL;
        if (mixture == Py_None) // no code runs after an exception
        {
            slots[i] = PyObject_GetAttr(object, sender->objects[MAPLINES_NAME_SLOT]);
        }
        if (slots[i] != NULL)
        {
            gaussian = PyObject_GetAttr(object, sender->objects[MAPLINES_NAME_GAUSSIAN]);
        }
        is_usual = gaussian != NULL && !PyLong_CheckExact(slots[i]) && // it is a key: a Slot
                   maplines_read_input(sender, object, line) &&
                   maplines_read_gaussian(sender, gaussian, line->mean, given->covs[i]) &&
                   sender->dbc->messages[line->slot].is_present && !is_used[line->slot];
        is_used[line->slot] = true;
        Py_XDECREF(gaussian);
        Py_XDECREF(mixture);
    }
    Py_XDECREF(lines);
    given->input.count = (uint8_t)(is_usual ? count : 0);
    return is_usual;
}

static bool are_finite(const double *numbers, size_t count)
{
    bool are = true;
    for (size_t i = 0; i < count; i++)
    {
        are = are && fabs(numbers[i]) <= MAPLINES_GREATEST_COV;
    }
    return are;
}

/// Read the arrays of the lines that are given; false if one is unusual.
static bool read_arrays(const maplines_sender_t *sender, PyObject *scene, maplines_given_t *given)
{
    const int n = given->input.count;
    const Py_ssize_t of_ranges[2] = {n, 2};
    const Py_ssize_t of_quartics[1] = {n};
    const Py_ssize_t of_cov[2] = {4 * (Py_ssize_t)n, 4 * (Py_ssize_t)n};
    const Py_ssize_t of_specific[3] = {n, 4, 4};
    double ranges[MAPLINES_SLOTS][2];
    double quartics[MAPLINES_SLOTS];
    double specific[MAPLINES_SLOTS][16] = {{0.0}};
    double cov[MAPLINES_STATES * MAPLINES_STATES];
    const size_t size = 16U * (size_t)n * (size_t)n;
    PyObject *const *objects = sender->objects;
    PyObject *known = PyObject_GetAttr(scene, objects[MAPLINES_NAME_SPECIFIC_COVS]);
    given->input.has_specific = known != Py_None;
    const bool is_read =
        known != NULL &&
        maplines_read_doubles_of(scene, objects[MAPLINES_NAME_FIT_RANGES], 2, of_ranges,
                                 ranges[0]) &&
        maplines_read_doubles_of(scene, objects[MAPLINES_NAME_QUARTICS], 1, of_quartics,
                                 quartics) &&
        maplines_read_doubles_of(scene, objects[MAPLINES_NAME_COV], 2, of_cov, cov) &&
        (known == Py_None ||
         maplines_read_doubles(known, PyBUF_STRIDES, 3, of_specific, specific[0])) &&
        are_finite(ranges[0], 2U * (size_t)n) && are_finite(quartics, (size_t)n) &&
        are_finite(cov, size) && are_finite(specific[0], 16U * (size_t)n);
    Py_XDECREF(known);
    bool is_usual = is_read;
    for (int i = 0; is_usual && i < n; i++)
    {
        maplines_scene_line_t *line = &given->input.lines[i];
        const maplines_input_t *of_line = &given->lines[i];
        line->slot = of_line->slot;
        line->kind = of_line->kind;
        line->status = of_line->status;
        line->x_min = of_line->x_min;
        line->x_max = of_line->x_max;
        line->quartic = quartics[i];
        memcpy(line->mean, of_line->mean, sizeof line->mean);
        memcpy(line->fit_range, ranges[i], sizeof line->fit_range);
        memcpy(line->specific[0], specific[i], sizeof line->specific);
        is_usual = ranges[i][0] < ranges[i][1];
    }
    for (int row = 0; is_usual && row < 4 * n; row++)
    {
        memcpy(given->input.cov[row], &cov[4 * n * row], 4U * (size_t)n * sizeof cov[0]);
    }
    return is_usual;
}

/// Read the errors of the pose and of the map; false if one is unusual.
static bool read_errors(const maplines_sender_t *sender, PyObject *scene,
                        maplines_scene_input_t *input)
{
    static const Py_ssize_t shape[2] = {3, 3};
    PyObject *const *objects = sender->objects;
    PyObject *pose = PyObject_GetAttr(scene, objects[MAPLINES_NAME_POSE_ERROR]);
    PyObject *map = pose == NULL ? NULL : PyObject_GetAttr(scene, objects[MAPLINES_NAME_MAP_ERROR]);
    bool is_usual =
        pose != NULL && map != NULL &&
        maplines_read_doubles_of(pose, objects[MAPLINES_NAME_COV], 2, shape, input->pose_cov[0]) &&
        are_finite(input->pose_cov[0], 9) &&
        maplines_read_double_of(pose, objects[MAPLINES_NAME_CORRELATION_TIME],
                                &input->correlation_time) &&
        input->correlation_time > 0.0;
    if (is_usual && map != Py_None)
    {
        is_usual = maplines_read_double_of(map, objects[MAPLINES_NAME_OFFSET_SIGMA],
                                           &input->offset_sigma) &&
                   maplines_read_double_of(map, objects[MAPLINES_NAME_HEADING_SIGMA],
                                           &input->heading_sigma) &&
                   input->offset_sigma >= 0.0 && input->offset_sigma < (double)INFINITY &&
                   input->heading_sigma >= 0.0 && input->heading_sigma < (double)INFINITY;
    }
    Py_XDECREF(map);
    Py_XDECREF(pose);
    return is_usual;
}

bool maplines_read_scene(const maplines_sender_t *sender, PyObject *scene,
                         PyObject *slots[MAPLINES_SLOTS], maplines_given_t *given)
{
    return read_lines(sender, scene, slots, given) && read_arrays(sender, scene, given) &&
           read_errors(sender, scene, &given->input);
}
