/* The reader of isr_harness.c: in C, or compiled as C++. */
#include "isr_reader.h"

#include <math.h>

int64_t read_line(int64_t last)
{
    const maplines_line_copy_t *copy = line_buffer_newest(&buffer);
    const int64_t number = copy->line.t_ns / CYCLE_NS;
    if (!copy->has_line)
    {
        if (last != 0 || copy->is_usable)
        {
            fail("no line", last);
        }
        return 0;
    }
    if (copy->now_ns != copy->line.t_ns || number * CYCLE_NS != copy->now_ns ||
        fabs(copy->line.gaussian.mean[0] - position_of(number)) > 0.006)
    {
        fail("torn", number);
    }
    if (number < last)
    {
        fail("back in time", number);
    }
    if (number > last)
    {
        usable += copy->is_usable ? 1U : 0U;
        (void)LINE_BUFFER_STD atomic_fetch_add_explicit(&reads, 1U,
                                                        LINE_BUFFER_STD memory_order_relaxed);
    }
    return number;
}
