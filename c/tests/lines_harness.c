/* Complete lines: records that are checked and read.
 *
 * Input, case by case: slot (u8), length (u8), record.
 * Output: reason, kind, status, index, count (u8), counter (u32), mean, factor, x_min, x_max, age
 * and weight (24 f64); zeros after the reason if the record is rejected.
 */
#include "binary.h"
#include "harness_dbc.h"
#include "internal.h"

static void write_zeros(size_t count)
{
    for (size_t i = 0; i < count; ++i)
    {
        write_u8(0);
    }
}

static void read_record(void)
{
    uint8_t record[256] = {0};
    maplines_complete_t content;
    const int slot = read_u8();
    const size_t length = read_u8();
    read_bytes(record, length);
    maplines_reason_t reason = maplines_check_record(&harness_dbc, slot, record, length);
    if (reason == MAPLINES_COMPLETE)
    {
        reason = maplines_read_complete(&harness_dbc, slot, record, 0, &content);
    }
    write_u8((uint8_t)reason);
    if (reason != MAPLINES_COMPLETE)
    {
        write_zeros(4 + 4 + 24 * 8);
        return;
    }
    write_u8((uint8_t)content.line.kind);
    write_u8((uint8_t)content.line.status);
    write_u8(content.index);
    write_u8(content.count);
    write_u32(content.counter);
    for (int i = 0; i < 4; ++i)
    {
        write_f64((double)content.line.gaussian.mean[i]);
    }
    for (int i = 0; i < 16; ++i)
    {
        write_f64((double)content.line.gaussian.factor[i / 4][i % 4]);
    }
    write_f64((double)content.line.x_min);
    write_f64((double)content.line.x_max);
    write_f64((double)content.line.age);
    write_f64(content.weight);
}

int main(void)
{
    while (!at_end())
    {
        read_record();
    }
    return 0;
}
