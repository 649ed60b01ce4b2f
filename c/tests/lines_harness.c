/* Complete lines: records to lines, and lines to frames.
 *
 * Input, case by case, after a command (u8):
 *   0  slot (u8), length (u8), record: check it and read it
 *   1  slot, kind, status, is_fd (u8 each), counter (u32), x_min, x_max, age (f64), count (u8);
 *      for each of count components, or for a line if it is 255: weight, 4 of the mean, 16 of the
 *      covariance (f64)
 * Output:
 *   0  reason, kind, status, index, count (u8), counter (u32), mean, factor, x_min, x_max, age and
 *      weight (24 f64); zeros after the reason if the record is rejected
 *   1  refusal, status, frames (u8), next counter (u32); of each frame CAN ID (u32), is_extended,
 *      is_fd, length (u8), data
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

static void encode(void)
{
    static maplines_frame_t frames[MAPLINES_MAX_FRAMES];
    static maplines_component_t components[256];
    maplines_encoder_t encoder;
    maplines_input_t line;
    maplines_sent_t sent;
    memset(&line, 0, sizeof line);
    line.slot = (maplines_owner_t)read_u8();
    line.kind = (maplines_kind_t)read_u8();
    line.status = (maplines_status_t)read_u8();
    const bool is_fd = read_u8() != 0;
    maplines_encoder_init(&encoder, &harness_dbc, NULL);
    const uint32_t counter = read_u32();
    for (int i = 0; i < MAPLINES_OWNERS; ++i)
    {
        encoder.counter[i] = counter;
    }
    line.x_min = read_f64();
    line.x_max = read_f64();
    line.age = read_f64();
    line.has_age = true;
    const size_t count = read_u8();
    const bool is_line = count == 255U;
    for (size_t k = 0; k < (is_line ? 1U : count); ++k)
    {
        components[k].weight = read_f64();
        for (int i = 0; i < 4; ++i)
        {
            components[k].mean[i] = read_f64();
        }
        for (int i = 0; i < 16; ++i)
        {
            components[k].cov[i / 4][i % 4] = read_f64();
        }
    }
    if (is_line)
    {
        memcpy(line.mean, components[0].mean, sizeof line.mean);
        memcpy(line.cov, components[0].cov, sizeof line.cov);
        sent = maplines_encode_line(&encoder, &line, is_fd, 0, frames);
    }
    else
    {
        sent = maplines_encode_mixture(&encoder, &line, components, count, is_fd, 0, frames);
    }
    write_u8((uint8_t)sent.refusal);
    write_u8((uint8_t)sent.status);
    write_u8((uint8_t)sent.count);
    write_u32(encoder.counter[line.slot < MAPLINES_POSE ? line.slot : MAPLINES_POSE]);
    for (size_t i = 0; i < sent.count; ++i)
    {
        write_u32(frames[i].can_id);
        write_u8(frames[i].is_extended);
        write_u8(frames[i].is_fd);
        write_u8(frames[i].length);
        write_bytes(frames[i].data, frames[i].length);
    }
}

int main(void)
{
    while (!at_end())
    {
        if (read_u8() == 0)
        {
            read_record();
        }
        else
        {
            encode();
        }
    }
    return 0;
}
