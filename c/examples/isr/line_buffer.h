/* The newest line of a slot from one task or interrupt to another, without a lock: a triple buffer.
 *
 *     writer            between            reader
 *     [ place 0 ]  <->  [ place 1 ]  <->  [ place 2 ]
 *
 * The writer fills its own place, and exchanges it for the one between. The reader does so if that
 * is new. An exchange is one atomic operation, so neither waits for the other, no line is read
 * while it is written, and the reader gets the newest. There is one writer and one reader.
 *
 * It needs C11 or C++11, and an atomic exchange of `unsigned`, which is lock-free on a Cortex-M3 or
 * later. On a single core without one, such as a Cortex-M0, disable interrupts around the exchange
 * instead. The writer may be in C and the reader in C++, or the other way, where both have the same
 * atomic `unsigned`, as with gcc and clang; the check below is for the size.
 */
#ifndef LINE_BUFFER_H
#define LINE_BUFFER_H

#include "maplines.h"

#include <string.h>
#ifdef __cplusplus
#include <atomic>
#define LINE_BUFFER_STD std::
static_assert(sizeof(std::atomic_uint) == sizeof(unsigned), "C may have another atomic unsigned");
#elif defined(__STDC_VERSION__) && __STDC_VERSION__ >= 201112L && !defined(__STDC_NO_ATOMICS__)
#include <stdatomic.h>
#define LINE_BUFFER_STD
_Static_assert(sizeof(atomic_uint) == sizeof(unsigned), "C++ may have another atomic unsigned");
#else
#error "line_buffer.h needs C11 with atomics, or C++11: give -std=c11 or later"
#endif

#define LINE_BUFFER_PLACE 3U
#define LINE_BUFFER_NEW 4U ///< the place between was written since it was read

/// All zeros, but for the places: see line_buffer_init.
typedef struct line_buffer {
    maplines_line_copy_t places[3];
    LINE_BUFFER_STD atomic_uint between; ///< number of this place, and LINE_BUFFER_NEW
    unsigned written;                    ///< place of the writer; nobody else reads this
    unsigned read;                       ///< place of the reader; nobody else reads this
} line_buffer_t;

/// Give a place away for the one between, in one step.
static inline unsigned line_buffer_exchange(line_buffer_t *buffer, unsigned given)
{
    return LINE_BUFFER_PLACE & LINE_BUFFER_STD atomic_exchange_explicit(
                                   &buffer->between, given, LINE_BUFFER_STD memory_order_acq_rel);
}

/// Before writer and reader start.
static inline void line_buffer_init(line_buffer_t *buffer)
{
    memset(buffer->places, 0, sizeof buffer->places);
    buffer->written = 0;
    buffer->read = 2;
    LINE_BUFFER_STD atomic_store_explicit(&buffer->between, 1U,
                                          LINE_BUFFER_STD memory_order_relaxed);
}

/// Writer: where the next line goes. The writer may use it until it publishes.
static inline maplines_line_copy_t *line_buffer_next(line_buffer_t *buffer)
{
    return &buffer->places[buffer->written];
}

/// Writer: give the line away.
static inline void line_buffer_publish(line_buffer_t *buffer)
{
    buffer->written = line_buffer_exchange(buffer, buffer->written | LINE_BUFFER_NEW);
}

/// Reader: the newest line. The reader may use it until it asks again. Before the first, it is all
/// zeros: it has no line, and is not usable.
static inline const maplines_line_copy_t *line_buffer_newest(line_buffer_t *buffer)
{
    const unsigned between = LINE_BUFFER_STD atomic_load_explicit(
        &buffer->between, LINE_BUFFER_STD memory_order_relaxed);
    if ((between & LINE_BUFFER_NEW) != 0U)
    {
        buffer->read = line_buffer_exchange(buffer, buffer->read);
    }
    return &buffer->places[buffer->read];
}

#endif
