/* What writer and reader of isr_harness.c share. */
#ifndef ISR_READER_H
#define ISR_READER_H

#include "../examples/isr/line_buffer.h"

#define CYCLE_NS INT64_C(50000000)

#ifdef __cplusplus
extern "C" {
#endif

extern line_buffer_t buffer;
extern LINE_BUFFER_STD atomic_uint reads; ///< lines that the reader has seen
extern unsigned usable;                   ///< of these

/// Lateral position of the line of a number [m].
double position_of(int64_t number);
/// Say what is wrong, and end.
void fail(const char *what, int64_t number);
/// Read the newest line; its number, or 0 before the first.
int64_t read_line(int64_t last);

#ifdef __cplusplus
}
#endif

#endif
