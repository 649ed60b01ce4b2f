/* Checks of the records of an owner, with counters of any length.
 *
 * Input: bits of the counter, pages, is_authentic (3 u8), cycle time [ns] (i64), greatest step
 * (u8), then steps of a kind (u8) and a time (i64) each: 0  a record: counter (u32), content (u64),
 * records of its line (u32) 1  the last new record has completed a line: records (u32) 2  a damaged
 * record 3  a duplicated frame 4  the state at this time Output, step by step: reason + 1 (u8; 0
 * unless it is a record), state, status, second sender detected, one sender only (4 u8), step of
 * the counter (u32), lost records (u64).
 */
#include "binary.h"
#include "internal.h"

static maplines_check_t check;

int main(void)
{
    const uint8_t bits = read_u8();
    const uint8_t pages = read_u8();
    const bool is_authentic = read_u8() != 0;
    const int64_t cycle_ns = read_i64();
    maplines_e2e_config_t e2e = maplines_default_e2e();
    e2e.max_delta_counter = read_u8();
    maplines_check_init(&check, &e2e, cycle_ns, (uint64_t)1 << bits, pages, is_authentic);
    while (!at_end())
    {
        const uint8_t kind = read_u8();
        const int64_t t_ns = read_i64();
        int reason = -1;
        if (kind == 0)
        {
            const uint32_t counter = read_u32();
            const uint64_t content = read_u64();
            reason = (int)maplines_check_received(&check, counter, content, t_ns, read_u32());
        }
        else if (kind == 1)
        {
            maplines_check_delivered(&check, read_u32());
        }
        else if (kind == 2)
        {
            maplines_check_failed(&check, t_ns);
        }
        else if (kind == 3)
        {
            maplines_check_dropped(&check, MAPLINES_DUPLICATE, t_ns);
        }
        else
        {
            (void)maplines_check_elapse(&check, t_ns);
        }
        write_u8((uint8_t)(reason + 1));
        write_u8((uint8_t)check.machine.state);
        write_u8((uint8_t)check.status);
        write_u8(check.conflict.is_confirmed);
        write_u8(maplines_has_one_sender(&check, t_ns));
        write_u32(check.ahead);
        write_u64(check.lost);
    }
    return 0;
}
