/* Lines and scenes to frames: what the files of the sender share. */
#ifndef MAPLINES_SENDER_H
#define MAPLINES_SENDER_H

#include "native.h"

/* ---- attributes.c: values of Python objects; false, with or without an exception, if one is
 * unusual
 */

/// None, for the caller to take the path of Python, which has the messages; an exception that a
/// value raised is cleared. NULL if it is MemoryError, or no error of a program.
PyObject *maplines_unusual(void);
/// A float, or an integer. `value` may be NULL, with an exception; so with the next two.
bool maplines_read_double(PyObject *value, double *number);
/// An integer from 0 to `most`, such as a member of an IntEnum.
bool maplines_read_enum(PyObject *value, int most, int *number);
/* The same, of attributes of an object, and the array of double precision of one, in any order. */
bool maplines_read_double_of(PyObject *object, PyObject *name, double *number);
bool maplines_read_enum_of(PyObject *object, PyObject *name, int most, int *number);
bool maplines_read_doubles_of(PyObject *object, PyObject *name, int axes, const Py_ssize_t *shape,
                              double *values);

/* ---- sender.c: lines to frames */

/// Greatest entry of a covariance of a caller, and longest finite age [s].
#define MAPLINES_GREATEST_COV 1e307
#define MAPLINES_LONGEST_AGE 1e99

/// What is made of a record.
typedef enum {
    MAPLINES_AS_PAGES = 0,  ///< classic frames
    MAPLINES_AS_FD = 1,     ///< a CAN FD frame
    MAPLINES_AS_RECORD = 2, ///< its bytes, for an authenticator
} maplines_form_t;

/// Writer of the frames of a DBC, as a Python object: `_native.Sender`.
typedef struct {
    PyObject_HEAD PyObject *tables;
    const maplines_dbc_t *dbc;
    PyTypeObject *frame; ///< class Frame, a tuple
    allocfunc new_frame;
    PyTypeObject *scene;      ///< that of the module
    PyObject *const *objects; ///< those of the module, of which it uses the names
} maplines_sender_t;

/// A message of this form is there for the records of an owner.
bool maplines_has_form(const maplines_dbc_t *dbc, int owner, maplines_form_t form);
/// Append the frames of a sealed record to a list; false with an exception.
bool maplines_add_frames(const maplines_sender_t *sender, int owner, const uint8_t *record,
                         size_t length, maplines_form_t form, PyObject *frames);
/// Low bits of the counter of an owner in a dict, 0 without one; false if it is unusual.
bool maplines_read_counter(PyObject *counters, PyObject *owner, uint32_t *counter);
/// Set the counter of an owner; false with an exception.
bool maplines_set_counter(PyObject *counters, PyObject *owner, uint32_t counter);
/// Read all of a line but its Gaussian.
bool maplines_read_input(const maplines_sender_t *sender, PyObject *line, maplines_input_t *input);
/// Read a Gaussian of a line, 4 and (4, 4), whose covariance is exactly symmetric.
bool maplines_read_gaussian(const maplines_sender_t *sender, PyObject *gaussian, double *mean,
                            double *cov);

/* ---- scene_input.c: scenes as they are read */

/// A scene as it was read.
typedef struct {
    maplines_scene_input_t input;
    maplines_input_t lines[MAPLINES_SLOTS];
    double covs[MAPLINES_SLOTS][16]; ///< of the lines by themselves
} maplines_given_t;

/// Read a scene, and the slots of its lines as objects, for the caller to release in any case;
/// false if it is unusual.
bool maplines_read_scene(const maplines_sender_t *sender, PyObject *scene,
                         PyObject *slots[MAPLINES_SLOTS], maplines_given_t *given);

/* ---- scene.c */

/// Sender.prepare: a scene but for counters and ages.
PyObject *maplines_prepare_scene(PyObject *self, PyObject *const *args, Py_ssize_t count);

#endif
