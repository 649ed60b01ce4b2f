/* Join of pose errors and lines: epochs, and the scenes that are rebuilt from them.
 *
 * A line belongs to a pose error if the low bits of its counter are those that the pose error
 * states for its slot, and if its first frame came within a window about that of the pose error:
 *
 *     stated for the slot    5             6             7      (three bits)
 *     pose errors            P             P             P
 *     lines                   5             6       7     |     a line may come before its pose
 *     ---------------------------------------------------------------------------> time
 *                            |<---- window of line 5 and its pose ---->|
 *
 * If a line fits two pose errors, or a pose error has a line of the slot already, it joins none.
 * An epoch waits for lines until it has the slots of both epochs before, or the next pose error
 * has come.
 */
#include "internal.h"

#if MAPLINES_RECEIVER && MAPLINES_SCENES && MAPLINES_LINE_RECORDS

#define HOLD_CYCLES 3 ///< a line waits for its pose error for so long
#define KEEP_CYCLES 5 ///< an epoch waits for lines for so long
#define INTERVALS 5   ///< between pose errors, whose median is the cycle of a sender that is fast
#define NO_EPOCH (-1)

static bool is_open(const maplines_epochs_t *epochs, int epoch)
{
    for (unsigned i = 0; i < epochs->open_count; ++i)
    {
        if (epochs->open[i] == epoch)
        {
            return true;
        }
    }
    return false;
}

static void set_latest(maplines_decoder_t *decoder, int epoch)
{
    decoder->epochs.latest = (int8_t)epoch;
    decoder->is_built = false;
}

/// Take the newest epoch that waits for no line as the latest one.
static void choose_latest(maplines_decoder_t *decoder)
{
    const maplines_epochs_t *epochs = &decoder->epochs;
    unsigned start = 0;
    for (unsigned i = 0; i < epochs->open_count; ++i)
    {
        if ((int)epochs->open[i] == (int)epochs->latest)
        {
            start = i + 1U;
        }
    }
    for (unsigned i = start; i < epochs->open_count; ++i)
    {
        const uint32_t slots = epochs->epochs[epochs->open[i]].slots;
        uint32_t expected = 0;
        for (unsigned before = i > 2U ? i - 2U : 0U; before < i; ++before)
        {
            expected |= epochs->epochs[epochs->open[before]].slots;
        }
        const bool is_over = i + 1U < epochs->open_count;
        if (slots != 0 && (is_over || (expected & ~slots) == 0))
        {
            set_latest(decoder, epochs->open[i]);
        }
    }
}

static void close_oldest(maplines_epochs_t *epochs)
{
    --epochs->open_count;
    for (unsigned i = 0; i < epochs->open_count; ++i)
    {
        epochs->open[i] = epochs->open[i + 1U];
    }
}

/// Remove a slot from those that wait; false if it does not.
static bool stop_waiting(maplines_epochs_t *epochs, int slot)
{
    unsigned i = 0;
    while (i < epochs->wait_count && epochs->waits[i] != slot)
    {
        ++i;
    }
    if (i == epochs->wait_count)
    {
        return false;
    }
    --epochs->wait_count;
    for (; i < epochs->wait_count; ++i)
    {
        epochs->waits[i] = epochs->waits[i + 1U];
    }
    return true;
}

static void drop_waiting(maplines_decoder_t *decoder, int slot)
{
    if (stop_waiting(&decoder->epochs, slot))
    {
        decoder->statistics.counts[MAPLINES_NO_POSE] += decoder->epochs.waiting[slot].frames;
    }
}

/// Median of the intervals between pose errors [ns].
static double median_interval(const maplines_epochs_t *epochs)
{
    double sorted[INTERVALS] = {0.0};
    const unsigned n = epochs->interval_count;
    for (unsigned i = 0; i < n; ++i)
    {
        unsigned place = i;
        while (place > 0 && sorted[place - 1U] > epochs->intervals_ns[i])
        {
            sorted[place] = sorted[place - 1U];
            --place;
        }
        sorted[place] = epochs->intervals_ns[i];
    }
    return n % 2U == 1U ? sorted[n / 2U] : (sorted[n / 2U - 1U] + sorted[n / 2U]) / 2.0;
}

static void add_interval(maplines_epochs_t *epochs, double interval_ns)
{
    if (epochs->interval_count == INTERVALS)
    {
        --epochs->interval_count;
        for (unsigned i = 0; i < epochs->interval_count; ++i)
        {
            epochs->intervals_ns[i] = epochs->intervals_ns[i + 1U];
        }
    }
    epochs->intervals_ns[epochs->interval_count] = interval_ns;
    ++epochs->interval_count;
}

/// Whether a line may be this much later than its pose error. With mixtures, whose components make
/// the counters of a slot wrap around faster, the window is narrower.
static bool fits_window(const maplines_decoder_t *decoder, int64_t late_ns)
{
    const maplines_epochs_t *epochs = &decoder->epochs;
    const double early = decoder->dbc->is_conditional ? 1.0 : 0.5;
    const double late = decoder->dbc->is_conditional ? 3.0 : 1.5;
    double cycle_ns = (double)decoder->settings.cycle_ns[MAPLINES_POSE];
    if (epochs->interval_count > 0)
    {
        const double median_ns = median_interval(epochs);
        cycle_ns = median_ns < cycle_ns ? median_ns : cycle_ns;
    }
    return -early * cycle_ns <= (double)late_ns && (double)late_ns <= late * cycle_ns;
}

/// The only epoch that a line fits; NO_EPOCH if there is none or more than one.
static int epoch_of(const maplines_decoder_t *decoder, int slot, uint32_t counter, int64_t t_ns)
{
    const maplines_epochs_t *epochs = &decoder->epochs;
    const maplines_signal_t *stated = &decoder->dbc->slot_counter[slot];
    const uint64_t low = counter & (((uint64_t)1 << stated->length) - 1U);
    const int64_t since_ns = epochs->since_ns[slot];
    int found = NO_EPOCH;
    for (unsigned i = 0; i < epochs->open_count; ++i)
    {
        const maplines_epoch_t *epoch = &epochs->epochs[epochs->open[i]];
        if ((uint64_t)maplines_get(stated, epoch->record) == low &&
            fits_window(decoder, t_ns - epoch->t_ns) &&
            (since_ns == MAPLINES_NEVER || epoch->t_ns >= since_ns))
        {
            if (found != NO_EPOCH)
            {
                return NO_EPOCH;
            }
            found = epochs->open[i];
        }
    }
    const bool is_taken =
        found != NO_EPOCH && (epochs->epochs[found].slots >> (unsigned)slot & 1U) != 0;
    return is_taken ? NO_EPOCH : found;
}

static void join_line(maplines_decoder_t *decoder, int epoch, int slot,
                      const maplines_joining_t *line, maplines_joined_t *joined)
{
    maplines_epochs_t *epochs = &decoder->epochs;
    epochs->epochs[epoch].lines[slot] = line->line;
    epochs->epochs[epoch].slots |= (uint32_t)1 << (unsigned)slot;
    if (epoch == epochs->latest)
    {
        decoder->is_built = false;
    }
    joined->epoch = epoch;
    joined->slot = slot;
    joined->frames = line->frames;
}

/// A place for a new epoch: neither open nor the latest.
static int free_epoch(const maplines_epochs_t *epochs)
{
    int epoch = 0;
    while (epoch == epochs->latest || is_open(epochs, epoch))
    {
        ++epoch;
    }
    return epoch;
}

static void restart_epochs(maplines_decoder_t *decoder)
{
    maplines_epochs_t *epochs = &decoder->epochs;
    epochs->open_count = 0;
    epochs->interval_count = 0;
    while (epochs->wait_count > 0)
    {
        drop_waiting(decoder, epochs->waits[0]);
    }
}

/// Whether the age of a pose error is greater than it can state.
static bool is_pose_too_old(const maplines_dbc_t *dbc, const uint8_t *record)
{
    return maplines_get(&dbc->pose_age, record) >= maplines_raw_max(&dbc->pose_age);
}

MAPLINES_INTERNAL void maplines_epochs_init(maplines_epochs_t *epochs)
{
    memset(epochs, 0, sizeof(*epochs));
    epochs->latest = NO_EPOCH;
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        epochs->since_ns[slot] = MAPLINES_NEVER;
    }
}

MAPLINES_INTERNAL int maplines_add_pose(maplines_decoder_t *decoder, const uint8_t *record,
                                        int64_t t_ns, uint32_t ahead,
                                        maplines_joined_t joined[MAPLINES_SLOTS])
{
    maplines_epochs_t *epochs = &decoder->epochs;
    epochs->is_too_old = is_pose_too_old(decoder->dbc, record);
    maplines_expire_epochs(decoder, t_ns);
    if (ahead == 0)
    {
        restart_epochs(decoder);
    }
    else if (epochs->has_pose)
    {
        add_interval(epochs, (double)maplines_distance(t_ns, epochs->pose_ns) / (double)ahead);
    }
    else
    {
        // the first one
    }
    epochs->has_pose = true;
    epochs->pose_ns = t_ns;
    if (epochs->open_count == MAPLINES_EPOCHS)
    {
        close_oldest(epochs);
    }
    const int epoch = free_epoch(epochs);
    memcpy(epochs->epochs[epoch].record, record, MAPLINES_MAX_RECORD);
    epochs->epochs[epoch].t_ns = t_ns;
    epochs->epochs[epoch].slots = 0;
    epochs->open[epochs->open_count] = (uint8_t)epoch;
    ++epochs->open_count;
    int count = 0;
    unsigned i = 0;
    while (i < epochs->wait_count)
    {
        const int slot = epochs->waits[i];
        const maplines_joining_t *line = &epochs->waiting[slot];
        if (epoch_of(decoder, slot, line->counter, line->line.t_ns) == epoch)
        {
            (void)stop_waiting(epochs, slot);
            join_line(decoder, epoch, slot, line, &joined[count]);
            ++count;
        }
        else
        {
            ++i;
        }
    }
    choose_latest(decoder);
    return count;
}

MAPLINES_INTERNAL bool maplines_add_line(maplines_decoder_t *decoder, int slot,
                                         const maplines_joining_t *line, bool is_break,
                                         maplines_joined_t *joined)
{
    maplines_epochs_t *epochs = &decoder->epochs;
    maplines_expire_epochs(decoder, line->line.t_ns);
    if (is_break)
    {
        epochs->since_ns[slot] = line->line.t_ns;
    }
    drop_waiting(decoder, slot);
    const int epoch = epoch_of(decoder, slot, line->counter, line->line.t_ns);
    if (epoch != NO_EPOCH)
    {
        join_line(decoder, epoch, slot, line, joined);
        choose_latest(decoder);
        return true;
    }
    epochs->waiting[slot] = *line;
    epochs->waits[epochs->wait_count] = (uint8_t)slot;
    ++epochs->wait_count;
    return false;
}

MAPLINES_INTERNAL void maplines_expire_epochs(maplines_decoder_t *decoder, int64_t t_ns)
{
    maplines_epochs_t *epochs = &decoder->epochs;
    const int64_t cycle_ns = decoder->settings.cycle_ns[MAPLINES_POSE];
    unsigned i = 0;
    while (i < epochs->wait_count)
    {
        const int slot = epochs->waits[i];
        if (maplines_distance(t_ns, epochs->waiting[slot].line.t_ns) > HOLD_CYCLES * cycle_ns)
        {
            drop_waiting(decoder, slot);
        }
        else
        {
            ++i;
        }
    }
    while (epochs->open_count > 0 &&
           maplines_distance(t_ns, epochs->epochs[epochs->open[0]].t_ns) > KEEP_CYCLES * cycle_ns)
    {
        const int old = epochs->open[0];
        close_oldest(epochs);
        if (epochs->epochs[old].slots != 0 && old != epochs->latest &&
            !is_open(epochs, epochs->latest))
        {
            set_latest(decoder, old); // it has waited for long enough
        }
    }
}

MAPLINES_INTERNAL uint32_t maplines_pending_lines(const maplines_decoder_t *decoder)
{
    uint32_t pending = 0;
    for (unsigned i = 0; i < decoder->epochs.wait_count; ++i)
    {
        pending += decoder->epochs.waiting[decoder->epochs.waits[i]].frames;
    }
    return pending;
}

/* ---- scenes ------------------------------------------------------------------------------------
 */

MAPLINES_INTERNAL bool maplines_latest_epoch(const maplines_decoder_t *decoder,
                                             maplines_epoch_view_t *view)
{
    const maplines_epochs_t *epochs = &decoder->epochs;
    if (epochs->latest == NO_EPOCH)
    {
        return false;
    }
    const maplines_epoch_t *epoch = &epochs->epochs[epochs->latest];
    maplines_begin_view(epoch->record, epoch->t_ns, view);
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        if ((epoch->slots >> (unsigned)slot & 1U) != 0)
        {
            const maplines_line_record_t *line = &epoch->lines[slot];
            (void)maplines_add_to_view(slot, line->record, line->t_ns, view);
        }
    }
    return true;
}

#endif
