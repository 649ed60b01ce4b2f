/* Checks of the records of an owner: E2E state, lost records, late records and duplicates.
 *
 * Each record is one check, and so is each cycle without a record. The counter decides whether a
 * record with a correct checksum is new; counters are modulo a power of two:
 *
 *     counter                                content for this counter  decision    E2E status
 *     last + 1                               any                       new         OK
 *     last + 2 .. last + max_delta           any                       new         OKSOMELOST
 *     last + max_delta + 1 .. last + most    any                       new, break  WRONGSEQUENCE
 *     last - span + 1 .. last                same as before            DUPLICATE   REPEATED
 *     last - span + 1 .. last                different: conflict       STALE       REPEATED
 *     any other                              same as before            DUPLICATE   WRONGSEQUENCE
 *     any other                              different, no restart     STALE       WRONGSEQUENCE
 *     any other                              different, restart        new, break  WRONGSEQUENCE
 *
 * `most` is what the sender can have sent since the last new record. A sender has restarted if no
 * new record came for a whole window of the state machine; or within it,
 *
 *     new      new      restart: the first two records are dropped; the owner is not VALID then
 *     41       42        0        1        2        3
 *     |--------|--------|--------|--------|--------|-----> time
 *                        STALE    STALE    new      new
 *
 *     new      new      late, held back by a gateway; the sender goes on
 *     41       42        30 31 32  43
 *     |--------|--------|||-------|-----> time
 *                        STALE    new
 */
#include "internal.h"

#if MAPLINES_RECEIVER

#define SHORT_PART 100     ///< a spacing below this part of the cycle is short
#define RESTART_RECORDS 3U ///< consecutive records behind the last new one that indicate it
#define JITTER_CYCLES 0.5  ///< a sender may be early by this much
#define MEAN_LINES 8.0     ///< the time between two lines is a mean over about this many
#define FASTEST 10.0       ///< a sender may be faster than the cycle time by this factor

/// What the records of an owner are checked by.
typedef struct {
    const maplines_e2e_config_t *e2e;
    int64_t cycle_ns;
    uint32_t mask; ///< bits of the counter
    uint8_t pages;
    bool is_authentic;
} rules_t;

static rules_t rules_of(const maplines_decoder_t *decoder, int owner)
{
    const maplines_record_t *layout = maplines_layout(decoder->dbc, owner);
    rules_t rules;
    rules.e2e = &decoder->settings.e2e[owner];
    rules.cycle_ns = decoder->settings.cycle_ns[owner];
    rules.mask = maplines_counter_mask(layout);
    rules.pages = layout->pages;
    rules.is_authentic =
        MAPLINES_SECOC && decoder->settings.authenticator != NULL && layout->fd_authentic > 0;
    return rules;
}

/* ---- rate of a sender --------------------------------------------------------------------------
 */

static uint8_t most_records(const maplines_pace_t *pace, uint8_t records)
{
#if MAPLINES_MIXTURES
    return pace->longest > records ? pace->longest : records;
#else
    (void)pace; // a line is one record
    (void)records;
    return 1;
#endif
}

/// How many lines a sender can have sent in a time: 1.3 is 1 or 2.
static double lines_within(const maplines_pace_t *pace, int64_t cycle_ns, int64_t waited_ns)
{
    double line_ns = (double)cycle_ns / FASTEST;
    line_ns = pace->line_ns > line_ns ? pace->line_ns : line_ns;
    line_ns = line_ns < (double)cycle_ns ? line_ns : (double)cycle_ns;
    const double lines = (double)waited_ns / line_ns;
    return lines + JITTER_CYCLES;
}

/// A line of so many records, by the counter and the time of the last one.
static void pace_delivered(maplines_pace_t *pace, uint32_t mask, uint32_t counter, int64_t t_ns,
                           uint8_t records)
{
    pace->longest = most_records(pace, records);
    const uint32_t step = (counter - pace->counter) & mask;
    if (pace->has_line && step == records)
    {
        const double interval_ns = (double)maplines_distance(t_ns, pace->last_ns);
        const double share_ns = (interval_ns - pace->line_ns) / MEAN_LINES;
        pace->line_ns = pace->line_ns + share_ns;
    }
    pace->has_line = true;
    pace->counter = counter;
    pace->last_ns = t_ns;
}

/* ---- the counter -------------------------------------------------------------------------------
 */

/// Greatest difference of the counter of a newer record from the last new one. With authentication
/// it is not limited by time: the freshness value excludes older records.
static uint32_t most_ahead(const maplines_check_t *check, const rules_t *rules, double lines,
                           uint8_t records)
{
    const uint32_t half = rules->mask / 2U; // half of the counters, less one
    if (rules->is_authentic)
    {
        return half;
    }
    const double most = ceil(lines) * (double)most_records(&check->pace, records);
    if (most >= (double)half)
    {
        return half;
    }
    const uint32_t by_time = (uint32_t)most;
    return by_time > rules->e2e->max_delta_counter ? by_time : rules->e2e->max_delta_counter;
}

/// Whether a newer record is ahead of what its sender should have sent by now.
static bool is_too_far_ahead(const maplines_check_t *check, double lines, uint32_t ahead,
                             uint8_t records)
{
    const double most = lines > 1.0 ? lines : 1.0;
    return (double)ahead > most * (double)most_records(&check->pace, records);
}

/// Whether the records behind the last new one are those of a restarted sender.
static bool is_restart(maplines_check_t *check, const rules_t *rules, uint32_t counter,
                       int64_t t_ns, bool is_other)
{
    maplines_history_t *history = &check->history;
    maplines_history_run(history, rules->mask, counter, t_ns, is_other);
    const int64_t grace = rules->cycle_ns + rules->cycle_ns / 2;
    if (history->run_records < RESTART_RECORDS ||
        maplines_distance(t_ns, history->run_since_ns) < grace)
    {
        return false;
    }
    if (!history->run_is_other || history->run_first >= rules->e2e->max_delta_counter)
    {
        return false;
    }
    maplines_conflict_retract(&check->conflict);
    return true;
}

/// Why a record `behind` the last new one is not delivered; MAPLINES_COMPLETE if it is new.
static maplines_reason_t why_not_new(maplines_check_t *check, const rules_t *rules,
                                     uint32_t counter, uint32_t content, uint32_t behind,
                                     int64_t t_ns)
{
    maplines_history_t *history = &check->history;
    maplines_conflict_t *conflict = &check->conflict;
    const uint32_t mask = rules->mask;
    const int64_t cycle_ns = rules->cycle_ns;
    const uint32_t max_delta = rules->e2e->max_delta_counter;
    const bool is_duplicate =
        maplines_history_is_duplicate(history, mask, counter, content, behind);
    if (!is_duplicate)
    {
        maplines_conflict_late(conflict, cycle_ns, t_ns);
    }
    // Farther back, it may be of a sender that restarted in a car that stands.
    else if (behind <= max_delta && maplines_history_mark_duplicated(history, mask, counter))
    {
        maplines_conflict_duplicate(conflict, t_ns);
    }
    else
    {
        // it was counted before
    }
    if (behind < check->span)
    {
        if (!is_duplicate)
        {
            maplines_conflict_reused(conflict, cycle_ns, t_ns);
        }
        return is_duplicate ? MAPLINES_DUPLICATE : MAPLINES_STALE;
    }
    const int64_t window_ns = rules->e2e->window_size_valid * cycle_ns;
    if (rules->is_authentic || maplines_distance(t_ns, check->new_ns) > window_ns)
    {
        return MAPLINES_COMPLETE;
    }
    if (is_duplicate)
    {
        return MAPLINES_DUPLICATE;
    }
    const bool has_other = maplines_history_has(history, mask, counter, behind);
    maplines_history_add_late(history, mask, counter, content, behind);
    if (has_other)
    {
        maplines_conflict_reused(conflict, cycle_ns, t_ns);
    }
    // too far behind to be merely delayed, and it fills no gap
    else if (behind > max_delta * most_records(&check->pace, 1) &&
             !maplines_history_fills_gap(history, mask, counter, behind))
    {
        maplines_conflict_count(conflict, cycle_ns, t_ns);
    }
    else
    {
        // it is delayed
    }
    return is_restart(check, rules, counter, t_ns, has_other) ? MAPLINES_COMPLETE : MAPLINES_STALE;
}

/// Take a new record, which has skipped so many counters.
static void accept_record(maplines_check_t *check, const rules_t *rules, uint32_t counter,
                          uint32_t content, int64_t t_ns, uint32_t skipped)
{
    maplines_history_add_new(&check->history, rules->mask, counter, content, skipped);
    maplines_conflict_new(&check->conflict);
    check->has_last = true;
    check->last = counter;
    check->new_ns = t_ns;
    check->span = 1;
}

/// Check the counter of a record; remember a new one.
static MAPLINES_APART maplines_reason_t check_counter(maplines_check_t *check, const rules_t *rules,
                                                      uint32_t counter, uint32_t content,
                                                      int64_t t_ns, uint8_t records,
                                                      maplines_e2e_status_t *status)
{
    const uint32_t mask = rules->mask;
    const uint32_t delta = check->has_last ? (counter - check->last) & mask : 1U;
    *status = maplines_e2e_check(delta, rules->e2e->max_delta_counter);
    if (*status == MAPLINES_E2E_OK)
    {
        maplines_conflict_next(&check->conflict);
        accept_record(check, rules, counter, content, t_ns, 0);
        check->ahead = 1;
        return MAPLINES_COMPLETE;
    }
    const double lines =
        lines_within(&check->pace, rules->cycle_ns, maplines_distance(t_ns, check->new_ns));
    const bool is_newer = delta > 0 && delta <= most_ahead(check, rules, lines, records);
    uint32_t skipped = delta - 1U;
    if (!is_newer)
    {
        const uint32_t behind = (check->last - counter) & mask;
        const uint8_t span = check->span;
        const maplines_reason_t reason = why_not_new(check, rules, counter, content, behind, t_ns);
        if (reason != MAPLINES_COMPLETE)
        {
            *status = behind < span ? MAPLINES_E2E_REPEATED : MAPLINES_E2E_WRONGSEQUENCE;
            return reason;
        }
        skipped = mask; // the history is that of another sequence
    }
    if (check->has_left && ((counter - check->left) & mask) == 1U)
    {
        // back to the sequence before the break
        maplines_conflict_count(&check->conflict, rules->cycle_ns, t_ns);
    }
    check->has_left = true;
    check->left = check->last;
    const bool is_gap = *status == MAPLINES_E2E_OKSOMELOST;
    if (is_gap && is_too_far_ahead(check, lines, delta, records))
    {
        maplines_conflict_ahead(&check->conflict, t_ns);
    }
    accept_record(check, rules, counter, content, t_ns, skipped);
    check->ahead = is_gap ? (uint8_t)delta : 0U; // a gap is at most max_delta_counter
    // A sender restarts at 0: nothing is lost then.
    check->lost += is_gap || (is_newer && counter != 0) ? skipped : 0U;
    return MAPLINES_COMPLETE;
}

/* ---- the checks of an owner --------------------------------------------------------------------
 */

static void step_with(maplines_check_t *check, const rules_t *rules, maplines_e2e_status_t status)
{
    check->status = status;
    maplines_machine_step(&check->machine, rules->e2e, status);
}

static MAPLINES_APART void step_without_data(maplines_check_t *check, const rules_t *rules,
                                             int64_t cycles)
{
    if (cycles == 0)
    {
        return;
    }
    check->no_new_data += (uint64_t)cycles;
    const int window = rules->e2e->window_size_valid;
    const int steps = cycles < window ? (int)cycles : window;
    for (int i = 0; i < steps; ++i)
    {
        step_with(check, rules, MAPLINES_E2E_NONEWDATA);
    }
}

static void record_arrived(maplines_check_t *check, const rules_t *rules, int64_t t_ns)
{
    maplines_conflict_elapse(&check->conflict, rules->cycle_ns, t_ns);
    step_without_data(check, rules,
                      maplines_deadline_record(&check->deadline, rules->cycle_ns, t_ns));
}

MAPLINES_INTERNAL void maplines_check_init(maplines_check_t *check, int64_t cycle_ns)
{
    memset(check, 0, sizeof(*check));
    check->status = MAPLINES_E2E_NONE;
    check->span = 1;
    check->pace.line_ns = (double)cycle_ns;
    check->pace.longest = 1;
    check->spaced_ns = MAPLINES_NEVER;
    maplines_machine_init(&check->machine);
    maplines_conflict_init(&check->conflict);
}

MAPLINES_INTERNAL bool maplines_check_spacing(maplines_check_t *check, int64_t cycle_ns,
                                              int64_t t_ns)
{
    const bool is_first = check->spaced_ns == MAPLINES_NEVER;
    const int64_t spacing_ns = is_first ? 0 : t_ns - check->spaced_ns;
    const bool is_short = spacing_ns > 0 && spacing_ns < cycle_ns / SHORT_PART;
    check->spaced_ns = t_ns;
    if (is_short && check->short_spacings < MAPLINES_SHORT_ROW)
    {
        ++check->short_spacings;
    }
    if (spacing_ns > 0 && !is_short)
    {
        check->short_spacings = 0;
    }
    return is_short;
}

MAPLINES_INTERNAL maplines_reason_t maplines_check_received(maplines_decoder_t *decoder, int owner,
                                                            uint32_t counter, uint32_t content,
                                                            int64_t t_ns, uint8_t records)
{
    maplines_check_t *check = &decoder->checks[owner];
    const rules_t rules = rules_of(decoder, owner);
    maplines_e2e_status_t status = MAPLINES_E2E_NONE;
    record_arrived(check, &rules, t_ns);
    const maplines_reason_t reason =
        check_counter(check, &rules, counter, content, t_ns, records, &status);
    if (reason == MAPLINES_COMPLETE)
    {
        check->duplicated_frames = 0;
        check->is_duplicated = false;
        if (check->ahead == 0)
        {
            maplines_machine_clear(&check->machine);
        }
    }
    switch (status)
    {
    case MAPLINES_E2E_REPEATED:
        ++check->repeated;
        break;
    case MAPLINES_E2E_WRONGSEQUENCE:
        ++check->wrong_sequence;
        break;
    case MAPLINES_E2E_OKSOMELOST:
        ++check->some_lost;
        break;
    default:
        ++check->ok;
        break;
    }
    step_with(check, &rules, status);
    return reason;
}

MAPLINES_INTERNAL void maplines_check_delivered(maplines_decoder_t *decoder, int owner,
                                                uint8_t records)
{
    maplines_check_t *check = &decoder->checks[owner];
    check->span = records;
    if (check->has_last)
    {
        pace_delivered(&check->pace, rules_of(decoder, owner).mask, check->last, check->new_ns,
                       records);
    }
}

static void count_error(maplines_check_t *check, const rules_t *rules, int64_t t_ns)
{
    record_arrived(check, rules, t_ns);
    ++check->errors;
    step_with(check, rules, MAPLINES_E2E_ERROR);
}

MAPLINES_INTERNAL void maplines_check_failed(maplines_decoder_t *decoder, int owner, int64_t t_ns)
{
    const rules_t rules = rules_of(decoder, owner);
    count_error(&decoder->checks[owner], &rules, t_ns);
}

/// A frame with a wrong page or length is an ERROR check, and `pages` duplicated frames are one
/// REPEATED check. What is not authentic does not reach the check.
MAPLINES_INTERNAL void maplines_check_dropped(maplines_decoder_t *decoder, int owner,
                                              maplines_reason_t reason, int64_t t_ns)
{
    maplines_check_t *check = &decoder->checks[owner];
    const rules_t rules = rules_of(decoder, owner);
    if (reason == MAPLINES_PAGE || (reason == MAPLINES_LENGTH && !rules.is_authentic))
    {
        count_error(check, &rules, t_ns);
        return;
    }
    if (reason != MAPLINES_DUPLICATE)
    {
        return;
    }
    ++check->duplicated_frames;
    if (check->duplicated_frames < rules.pages)
    {
        return;
    }
    record_arrived(check, &rules, t_ns);
    if (!check->is_duplicated)
    {
        maplines_conflict_duplicate(&check->conflict, t_ns);
    }
    check->duplicated_frames = 0;
    check->is_duplicated = true;
    ++check->repeated;
    step_with(check, &rules, MAPLINES_E2E_REPEATED);
}

MAPLINES_INTERNAL maplines_e2e_state_t maplines_check_elapse(maplines_decoder_t *decoder, int owner,
                                                             int64_t t_ns)
{
    maplines_check_t *check = &decoder->checks[owner];
    const rules_t rules = rules_of(decoder, owner);
    maplines_conflict_elapse(&check->conflict, rules.cycle_ns, t_ns);
    step_without_data(check, &rules,
                      maplines_deadline_elapse(&check->deadline, rules.cycle_ns, t_ns));
    return check->machine.state;
}

MAPLINES_INTERNAL bool maplines_has_one_sender(const maplines_decoder_t *decoder, int owner,
                                               int64_t t_ns)
{
    const maplines_conflict_t *conflict = &decoder->checks[owner].conflict;
    const int64_t cycle_ns = decoder->settings.cycle_ns[owner];
    return !conflict->is_confirmed && !maplines_conflict_is_suspected(conflict, cycle_ns, t_ns);
}

#endif
