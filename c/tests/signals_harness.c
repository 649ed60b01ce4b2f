/* Records to the raw and physical values of all signals of the tables, and back.
 *
 * Input, case by case: 0 or 1 for a record of a line or of the pose error (u8), the record.
 * Output: for each signal of the record in the order of `of_line` or `of_pose`: its raw value
 * (i64) and physical value (f64); then a record of these raw values; then its checksum (u16).
 */
#include "binary.h"
#include "harness_dbc.h"
#include "internal.h"

#define CHOLESKY(code)                                                                             \
    &(code).pivot[0], &(code).pivot[1], &(code).pivot[2], &(code).pivot[3], &(code).ratio[0],      \
        &(code).ratio[1], &(code).ratio[2], &(code).ratio[3], &(code).ratio[4], &(code).ratio[5],  \
        &(code).inflation
#define LEVELS(levels)                                                                             \
    &(levels).lateral, &(levels).points, &(levels).shape, &(levels).quartic, &(levels).fit_behind, \
        &(levels).fit_ahead
#define D harness_dbc

static const maplines_signal_t *const of_line[] = {
    &D.line.page,
    &D.line.transfer_id[0],
    &D.line.counter,
    &D.mean[0],
    &D.mean[1],
    &D.mean[2],
    &D.mean[3],
    &D.kind,
    &D.x_min,
    &D.x_max,
    &D.status,
    &D.age,
    &D.component_index,
    &D.component_count,
    &D.component_weight,
    &D.has_covariance,
    &D.fine[0],
    &D.fine[1],
    &D.fine[2],
    &D.fine[3],
    CHOLESKY(D.covariance),
    LEVELS(D.levels),
};

static const maplines_signal_t *const of_pose[] = {
    &D.pose.page,
    &D.pose.transfer_id[0],
    &D.pose.counter,
    &D.pose_age,
    &D.correlation_time,
    &D.map_offset,
    &D.map_heading,
    CHOLESKY(D.pose_covariance),
    &D.slot_counter[0],
    &D.slot_counter[1],
    &D.slot_counter[2],
    &D.slot_counter[3],
    &D.slot_counter[4],
    &D.slot_counter[5],
    &D.slot_counter[6],
    &D.slot_counter[7],
    LEVELS(D.slot_levels[0]),
    LEVELS(D.slot_levels[1]),
    LEVELS(D.slot_levels[2]),
    LEVELS(D.slot_levels[3]),
    LEVELS(D.slot_levels[4]),
    LEVELS(D.slot_levels[5]),
    LEVELS(D.slot_levels[6]),
    LEVELS(D.slot_levels[7]),
};

int main(void)
{
    while (!at_end())
    {
        const bool is_pose = read_u8() != 0;
        const maplines_record_t *layout = is_pose ? &D.pose : &D.line;
        const maplines_signal_t *const *signals = is_pose ? of_pose : of_line;
        const size_t count =
            is_pose ? sizeof of_pose / sizeof of_pose[0] : sizeof of_line / sizeof of_line[0];
        const size_t length = 8U * layout->pages;
        uint8_t record[MAPLINES_MAX_RECORD] = {0};
        uint8_t written[MAPLINES_MAX_RECORD] = {0};
        read_bytes(record, length);
        for (size_t i = 0; i < count; ++i)
        {
            if (signals[i]->length == 0) // the DBC has no such signal
            {
                continue;
            }
            const int64_t raw = maplines_get(signals[i], record);
            write_i64(raw);
            write_f64(maplines_physical(signals[i], raw));
            maplines_put(signals[i], written, raw);
        }
        write_bytes(written, length);
        write_u16(maplines_crc(record, length, layout->crc_byte, 0x4D40));
    }
    return 0;
}
