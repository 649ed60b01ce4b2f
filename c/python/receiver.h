/* What the files of `_native.Decoder` share. */
#ifndef MAPLINES_RECEIVER_H
#define MAPLINES_RECEIVER_H

#include "native.h"

/// Receiver: `_native.Decoder`.
typedef struct {
    PyObject_HEAD maplines_decoder_t *decoder; ///< NULL before it is initialised
    PyObject *tables;                          ///< those of `decoder`
    PyObject *module;                          ///< which owns `objects`
    PyObject *routes;                          ///< by (CAN ID, is extended): the same
    PyObject *const *objects;
    PyObject *newest[MAPLINES_SLOTS]; ///< newest line of each slot; NULL before the first
    struct maplines_scene_row *shown; ///< scene that feed_arrays has not returned yet, or NULL
    bool is_busy;       ///< a thread that does not hold the GIL uses `decoder` and `shown`
    PyObject *received; ///< newest scene as it was returned last; NULL before the first
} maplines_receiver_t;

/// Receiver in C; NULL with RuntimeError if it is not initialised, or if another thread uses it.
maplines_decoder_t *maplines_receiver_of(PyObject *self);

/// Read a time [ns] of any integral type, limited to what the core takes; false with an exception.
bool maplines_read_time(PyObject *value, const char *name, int64_t *t_ns);

/// Line of a scene with its block of the joint covariance.
PyObject *maplines_new_scene_line(PyObject *const *objects, const maplines_scene_t *scene,
                                  int place);

/* decoder.c */

/// Components of a mixture.
typedef struct {
    int count;      ///< 0: the line is no mixture
    double mean[4]; ///< of all
    double weights[MAPLINES_MAX_COMPONENTS];
    double means[MAPLINES_MAX_COMPONENTS][4];
    double covs[MAPLINES_MAX_COMPONENTS][16];
} maplines_components_t;

/// Covariance and components of the newest line of a slot, which was at a place of what a frame has
/// completed. `scene` is that of maplines_feed_with.
void maplines_line_moments(const maplines_decoder_t *decoder, int slot,
                           const maplines_scene_t *scene, int place, double cov[16],
                           maplines_components_t *components);

/// `MapLine` of a line, its covariance and its components.
PyObject *maplines_new_moments_line(PyObject *const *objects, const maplines_line_t *line,
                                    const double cov[16], const maplines_components_t *components);

PyObject *maplines_receiver_feed(PyObject *self, PyObject *const *arguments, Py_ssize_t count,
                                 PyObject *keywords);
PyObject *maplines_receiver_feed_all(PyObject *self, PyObject *frames);
PyObject *maplines_receiver_expire(PyObject *self, PyObject *time);

/* feed_blocks.c */

PyObject *maplines_receiver_feed_arrays(PyObject *self, PyObject *const *arguments,
                                        Py_ssize_t count);

/* views.c */

PyObject *maplines_receiver_view(PyObject *self, PyObject *arguments);
PyObject *maplines_receiver_scene(PyObject *self, PyObject *unused);
PyObject *maplines_receiver_scene_view(PyObject *self, PyObject *arguments);
PyObject *maplines_receiver_check(PyObject *self, PyObject *owner);
PyObject *maplines_receiver_elapse(PyObject *self, PyObject *arguments);
PyObject *maplines_receiver_senders(PyObject *self, PyObject *arguments);
PyObject *maplines_receiver_counts(PyObject *self, PyObject *unused);
PyObject *maplines_receiver_number(PyObject *self, void *offset);
PyObject *maplines_receiver_pending(PyObject *self, void *unused);

#endif
