/* Detector of a second sender of an owner's records, tolerant of bus faults.
 *
 * A conflict is a record that the first sender cannot have sent: one that reuses a counter with
 * other content, or belongs to another counter sequence. A record that is ahead of what the first
 * sender can have sent is suspicious until the next one in sequence:
 *
 *     first       41       42           43           44           45
 *     second                  50                        51
 *     -----------|--------|--|---------|------------|--|---------|-----> time
 *                             suspected STALE        STALE        STALE
 *
 *     one sender  41, held back by a gateway; 42, 43 and 44 are lost
 *     --------------------------------41--45-------46----------------> time
 *                                         suspected|not any more
 */
#include "internal.h"

#if MAPLINES_RECEIVER

#define CONFLICTS 8U      ///< confirm two senders
#define NEAR_CYCLES 32    ///< longest time between consecutive conflicts
#define NEW_RECORDS 32U   ///< of so many consecutive new records,
#define DUPLICATES 29U    ///< so many that came twice confirm two senders
#define SUSPECT_CYCLES 10 ///< a second sender is suspected for so long
#define FORGET_CYCLES 256 ///< a second sender is forgotten after so long

static MAPLINES_APART bool is_recent(int64_t then_ns, int64_t cycle_ns, int64_t t_ns)
{
    return then_ns != MAPLINES_NEVER &&
           maplines_distance(t_ns, then_ns) <= SUSPECT_CYCLES * cycle_ns;
}

MAPLINES_INTERNAL void maplines_conflict_init(maplines_conflict_t *conflict)
{
    memset(conflict, 0, sizeof(*conflict));
    conflict->conflict_ns = MAPLINES_NEVER;
    conflict->confirmed_ns = MAPLINES_NEVER;
    conflict->reused_ns = MAPLINES_NEVER;
    conflict->ahead_ns = MAPLINES_NEVER;
    conflict->is_blocked = true;
}

MAPLINES_INTERNAL void maplines_conflict_new(maplines_conflict_t *conflict)
{
    conflict->is_blocked = false;
    ++conflict->new_records;
    if (conflict->new_records > NEW_RECORDS)
    {
        conflict->new_records = 1;
        conflict->duplicates = 0;
    }
}

/// Count a duplicated record, once: a stuck sender must not be mistaken for two.
MAPLINES_INTERNAL void maplines_conflict_duplicate(maplines_conflict_t *conflict, int64_t t_ns)
{
    ++conflict->duplicates;
    if (conflict->new_records >= NEW_RECORDS && conflict->duplicates >= DUPLICATES)
    {
        conflict->is_confirmed = true;
        conflict->confirmed_ns = t_ns;
    }
}

/// Count a record that another sender must have sent.
MAPLINES_INTERNAL void maplines_conflict_count(maplines_conflict_t *conflict, int64_t cycle_ns,
                                               int64_t t_ns)
{
    bool is_near = false;
    if (conflict->conflict_ns != MAPLINES_NEVER)
    {
        const int64_t since_ns = maplines_distance(t_ns, conflict->conflict_ns);
        if (since_ns < cycle_ns - since_ns) // less than half a cycle
        {
            return;
        }
        is_near = since_ns <= NEAR_CYCLES * cycle_ns;
    }
    if (conflict->is_blocked)
    {
        return;
    }
    conflict->conflicts = is_near ? conflict->conflicts + 1U : 1U;
    conflict->conflict_ns = t_ns;
    conflict->is_blocked = true;
    if (conflict->conflicts >= CONFLICTS)
    {
        conflict->is_confirmed = true;
        conflict->confirmed_ns = t_ns;
    }
}

/// Count a conflict by a reused counter, and suspect a second sender.
MAPLINES_INTERNAL void maplines_conflict_reused(maplines_conflict_t *conflict, int64_t cycle_ns,
                                                int64_t t_ns)
{
    conflict->reused_ns = t_ns;
    maplines_conflict_count(conflict, cycle_ns, t_ns);
}

/// Suspect a second sender: a new record is ahead of what the first can have sent.
MAPLINES_INTERNAL void maplines_conflict_ahead(maplines_conflict_t *conflict, int64_t t_ns)
{
    conflict->ahead_ns = t_ns;
    conflict->is_followed = false;
}

/// The next record in sequence: the sender of a record that was ahead goes on.
MAPLINES_INTERNAL void maplines_conflict_next(maplines_conflict_t *conflict)
{
    if (!conflict->is_followed)
    {
        conflict->ahead_ns = MAPLINES_NEVER;
    }
}

/// A late record: after one that was ahead, it is that of the first sender.
MAPLINES_INTERNAL void maplines_conflict_late(maplines_conflict_t *conflict, int64_t cycle_ns,
                                              int64_t t_ns)
{
    if (is_recent(conflict->ahead_ns, cycle_ns, t_ns))
    {
        conflict->ahead_ns = t_ns;
        conflict->is_followed = true;
    }
}

/// Discount the last conflict: its sequence was that of a sender that restarted.
MAPLINES_INTERNAL void maplines_conflict_retract(maplines_conflict_t *conflict)
{
    conflict->conflicts -= conflict->conflicts > 0 ? 1U : 0U;
    conflict->reused_ns = MAPLINES_NEVER;
    conflict->ahead_ns = MAPLINES_NEVER;
}

/// Whether a counter was reused in the last cycles.
MAPLINES_INTERNAL bool maplines_conflict_was_reused(const maplines_conflict_t *conflict,
                                                    int64_t cycle_ns, int64_t t_ns)
{
    return is_recent(conflict->reused_ns, cycle_ns, t_ns);
}

MAPLINES_INTERNAL bool maplines_conflict_is_suspected(const maplines_conflict_t *conflict,
                                                      int64_t cycle_ns, int64_t t_ns)
{
    return maplines_conflict_was_reused(conflict, cycle_ns, t_ns) ||
           is_recent(conflict->ahead_ns, cycle_ns, t_ns);
}

/// Forget evidence that is too old.
MAPLINES_INTERNAL void maplines_conflict_elapse(maplines_conflict_t *conflict, int64_t cycle_ns,
                                                int64_t t_ns)
{
    if (conflict->is_confirmed &&
        maplines_distance(t_ns, conflict->confirmed_ns) > FORGET_CYCLES * cycle_ns)
    {
        conflict->is_confirmed = false;
        conflict->conflicts = 0;
    }
}

#endif
