/* Frames that a parser of logs gives: arrays of a call. */
#ifndef MAPLINES_FRAMES_OUT_H
#define MAPLINES_FRAMES_OUT_H

#include "native.h"

#define MAPLINES_MAX_DATA 64

/// Arrays of frames.
typedef struct {
    uint32_t *can_ids;
    uint8_t *are_extended;
    int64_t *times_ns;
    uint16_t *channels;
    uint8_t *lengths;
    uint8_t *data; ///< `MAPLINES_MAX_DATA` bytes of each frame, zero from its length on
    Py_ssize_t capacity, count;
} maplines_frames_t;

/// Hold the arrays of a tuple (can_id, is_extended, t_ns, channel, length, data), of equal length;
/// false with an exception.
bool maplines_hold_frames(maplines_arrays_t *arrays, PyObject *tuple, maplines_frames_t *frames);

/// Add a frame with no more than 64 bytes of data; there must be room.
void maplines_add_frame(maplines_frames_t *frames, uint32_t can_id, bool is_extended, int64_t t_ns,
                        uint16_t channel, const uint8_t *data, uint8_t length);

#endif
