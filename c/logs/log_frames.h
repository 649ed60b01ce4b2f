/* Frames that the readers of logs add to the arrays of a call. */
#ifndef MAPLINES_LOG_FRAMES_H
#define MAPLINES_LOG_FRAMES_H

#include "core.h"

/// A data frame of a log. Bytes that are not there are zero.
typedef struct {
    int64_t t_ns;
    uint32_t can_id;
    bool is_extended;
    uint32_t channel; ///< number from 1, where channels have no name
    uint32_t length;  ///< bytes of data, at most `MAPLINES_LOG_DATA`
    uint32_t there;   ///< those of `data`
    const uint8_t *data;
} maplines_logged_t;

/// Find the channel of the next frame by its name, or add it; false if the name is too long, or if
/// there are too many. The frames that follow are of this channel.
bool maplines_name_channel(maplines_log_t *log, const char *name, size_t length);
/// Likewise by its number, from 1: its name is that from 0.
bool maplines_number_channel(maplines_log_t *log, uint32_t number);
/// Add a frame; there must be room.
void maplines_add_logged(maplines_log_t *log, const maplines_logged_t *frame);

#endif
