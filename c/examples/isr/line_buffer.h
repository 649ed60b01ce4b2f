/* The newest line of a slot from one task or interrupt to another, without a lock: a triple buffer.
 *
 *     writer            between            reader
 *     [ place 0 ]  <->  [ place 1 ]  <->  [ place 2 ]
 *
 * The writer fills its own place, and exchanges it for the one between. The reader does so if that
 * is new. An exchange is one atomic operation, so neither waits for the other, no line is read
 * while it is written, and the reader gets the newest. There is one writer and one reader.
 *
 * It needs C11 and an atomic exchange of `unsigned`, which is lock-free on a Cortex-M3 or later. On
 * a single core without one, such as a Cortex-M0, disable interrupts around the exchange instead.
 */
#ifndef LINE_BUFFER_H
#define LINE_BUFFER_H

#include "maplines.h"

#include <stdatomic.h>

#define LINE_BUFFER_PLACE 3U
#define LINE_BUFFER_NEW 4U ///< the place between was written since it was read

/// All zeros, but for the places: see line_buffer_init.
typedef struct {
    maplines_line_copy_t places[3];
    atomic_uint between; ///< number of this place, and LINE_BUFFER_NEW
    unsigned written;    ///< place of the writer; nobody else reads this
    unsigned read;       ///< place of the reader; nobody else reads this
} line_buffer_t;

/// Before writer and reader start.
static inline void line_buffer_init(line_buffer_t *buffer)
{
    *buffer = (line_buffer_t){.written = 0, .read = 2};
    atomic_init(&buffer->between, 1U);
}

/// Writer: where the next line goes. The writer may use it until it publishes.
static inline maplines_line_copy_t *line_buffer_next(line_buffer_t *buffer)
{
    return &buffer->places[buffer->written];
}

/// Writer: give the line away.
static inline void line_buffer_publish(line_buffer_t *buffer)
{
    const unsigned given = buffer->written | LINE_BUFFER_NEW;
    buffer->written =
        LINE_BUFFER_PLACE & atomic_exchange_explicit(&buffer->between, given, memory_order_acq_rel);
}

/// Reader: the newest line. The reader may use it until it asks again. Before the first, it is all
/// zeros: it has no line, and is not usable.
static inline const maplines_line_copy_t *line_buffer_newest(line_buffer_t *buffer)
{
    const unsigned between = atomic_load_explicit(&buffer->between, memory_order_relaxed);
    if ((between & LINE_BUFFER_NEW) != 0U)
    {
        buffer->read = LINE_BUFFER_PLACE & atomic_exchange_explicit(&buffer->between, buffer->read,
                                                                    memory_order_acq_rel);
    }
    return &buffer->places[buffer->read];
}

#endif
