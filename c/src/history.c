/* What the check of an owner remembers: its deadline, and its records. */
#include "internal.h"

#if MAPLINES_RECEIVER

/* ---- deadline ----------------------------------------------------------------------------------
 *
 *     record                  missed        missed       record
 *       |<----- 1.5 cycles ---->|<- 1 cycle ->|            |<----- 1.5 cycles ----> ...
 *
 * The first cycle without a record is missed 1.5 cycles after the last record, since the time of a
 * record may jitter by half a cycle. The result does not depend on how often one asks.
 */

static int64_t grace_ns(int64_t cycle_ns)
{
    return cycle_ns + cycle_ns / 2;
}

MAPLINES_INTERNAL int64_t maplines_deadline_elapse(maplines_deadline_t *deadline, int64_t cycle_ns,
                                                   int64_t t_ns)
{
    if (!deadline->is_running)
    {
        return 0;
    }
    if (t_ns >= deadline->due_ns)
    {
        const int64_t missed = (t_ns - deadline->due_ns) / cycle_ns + 1;
        deadline->due_ns += missed * cycle_ns;
        deadline->is_counted = true;
        return missed;
    }
    if (deadline->due_ns - t_ns > grace_ns(cycle_ns) + cycle_ns) // the clock was set back
    {
        deadline->due_ns = t_ns + grace_ns(cycle_ns);
        deadline->is_counted = false;
    }
    return 0;
}

MAPLINES_INTERNAL int64_t maplines_deadline_record(maplines_deadline_t *deadline, int64_t cycle_ns,
                                                   int64_t t_ns)
{
    const int64_t due_ns = t_ns + grace_ns(cycle_ns);
    int64_t missed = 0;
    if (deadline->is_running)
    {
        if (t_ns >= deadline->due_ns)
        {
            missed = maplines_deadline_elapse(deadline, cycle_ns, t_ns);
        }
        else if (deadline->is_counted && due_ns <= deadline->due_ns)
        {
            return 0; // read late: the cycles up to then were counted
        }
        else
        {
            // in time
        }
    }
    deadline->is_running = true;
    deadline->due_ns = due_ns;
    deadline->is_counted = false;
    return missed;
}

/* ---- records of the last counters --------------------------------------------------------------
 *
 * Each of the last MAPLINES_HISTORY counters has an entry, by its low bits; fewer if the counter
 * wraps around earlier. What a new record has skipped is forgotten, so that no entry is mistaken
 * for one of an earlier round of the counter.
 */

#define IS_TAKEN 1U
#define IS_NEW 2U         ///< accepted when it came
#define IS_IN_SEQUENCE 4U ///< new, or late and directly after one that is in sequence
#define IS_DUPLICATED 8U  ///< received again since
/// Records of a run that indicate a restart; more are not counted.
#define MAX_RUN 3U

static uint32_t history_length(uint32_t mask)
{
    return mask < MAPLINES_HISTORY ? mask + 1U : MAPLINES_HISTORY;
}

static size_t place_of(uint32_t mask, uint32_t counter)
{
    return counter & (MAPLINES_HISTORY - 1U) & mask;
}

/// Place of a counter `behind` the last new one, or MAPLINES_HISTORY if there is no record of it.
static size_t entry_of(const maplines_history_t *history, uint32_t mask, uint32_t counter,
                       uint32_t behind)
{
    const size_t place = place_of(mask, counter);
    const bool is_taken = behind < history_length(mask) && history->flags[place] != 0;
    return is_taken ? place : MAPLINES_HISTORY;
}

MAPLINES_INTERNAL void maplines_history_add_new(maplines_history_t *history, uint32_t mask,
                                                uint32_t counter, uint32_t content,
                                                uint32_t skipped)
{
    const uint32_t length = history_length(mask);
    for (uint32_t behind = 1; behind < length && behind <= skipped; ++behind)
    {
        history->flags[place_of(mask, counter - behind)] = 0;
    }
    const size_t place = place_of(mask, counter);
    history->content[place] = content;
    history->flags[place] = IS_TAKEN | IS_NEW | IS_IN_SEQUENCE;
    history->run_records = 0;
}

MAPLINES_INTERNAL void maplines_history_add_late(maplines_history_t *history, uint32_t mask,
                                                 uint32_t counter, uint32_t content,
                                                 uint32_t behind)
{
    const size_t place = place_of(mask, counter);
    if (behind < history_length(mask) && history->flags[place] == 0)
    {
        const bool fills = maplines_history_fills_gap(history, mask, counter, behind);
        history->content[place] = content;
        history->flags[place] = fills ? IS_TAKEN | IS_IN_SEQUENCE : IS_TAKEN;
    }
}

MAPLINES_INTERNAL void maplines_history_run(maplines_history_t *history, uint32_t mask,
                                            uint32_t counter, int64_t t_ns, bool is_other)
{
    const uint32_t step = (counter - history->run_last) & mask;
    if (history->run_records == 0 || step != 1)
    {
        history->run_first = counter;
        history->run_since_ns = t_ns;
        history->run_records = 0;
        history->run_is_other = false;
    }
    history->run_last = counter;
    if (history->run_records < MAX_RUN)
    {
        ++history->run_records;
    }
    history->run_is_other = history->run_is_other || is_other;
}

MAPLINES_INTERNAL bool maplines_history_has(const maplines_history_t *history, uint32_t mask,
                                            uint32_t counter, uint32_t behind)
{
    return entry_of(history, mask, counter, behind) < MAPLINES_HISTORY;
}

MAPLINES_INTERNAL bool maplines_history_is_duplicate(const maplines_history_t *history,
                                                     uint32_t mask, uint32_t counter,
                                                     uint32_t content, uint32_t behind)
{
    const size_t place = entry_of(history, mask, counter, behind);
    return place < MAPLINES_HISTORY && history->content[place] == content;
}

MAPLINES_INTERNAL bool maplines_history_mark_duplicated(maplines_history_t *history, uint32_t mask,
                                                        uint32_t counter)
{
    const size_t place = place_of(mask, counter);
    if ((history->flags[place] & (IS_NEW | IS_DUPLICATED)) != IS_NEW)
    {
        return false;
    }
    history->flags[place] |= IS_DUPLICATED;
    return true;
}

MAPLINES_INTERNAL bool maplines_history_fills_gap(const maplines_history_t *history, uint32_t mask,
                                                  uint32_t counter, uint32_t behind)
{
    const size_t place = entry_of(history, mask, counter - 1U, behind + 1U);
    return place < MAPLINES_HISTORY && (history->flags[place] & IS_IN_SEQUENCE) != 0;
}

#endif
