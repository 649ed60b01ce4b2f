/* Whole scenes: records of a pose error with lines, and which two of them are one scene.
 *
 * Each record has all that its lines need. A sender with more lines than places sends two, Scene2
 * before Scene; both are of one scene if they have the same pose error, state the same low bits of
 * the counter of Scene, and come within a cycle:
 *
 *     Scene2     5        6                  8        9
 *     Scene         5        6        7         8           10
 *     ------------------------------------------------------------> time
 *                   |        |        |         |           |
 *     scene         5 + 5    6 + 6    7         8 + 8       10
 *
 * A Scene2 waits for the next Scene, and joins the newest one at once if that has none yet.
 */
#include "internal.h"

#if MAPLINES_RECEIVER && MAPLINES_SCENE_RECORDS

#define NONE (-1)
/// Kind of a line that is left out for the last of its reasons.
#define KIND_LAST (MAPLINES_NO_LINE + (int)MAPLINES_LEFT_OUT_COVARIANCE)

/// Bytes from which the signals of the line at a place are read.
static const uint8_t *at_place(const maplines_dbc_t *dbc, const uint8_t *record, int place)
{
    return record + (size_t)place * dbc->scene.stride;
}

static int kind_at(const maplines_dbc_t *dbc, const uint8_t *record, int place)
{
    return (int)maplines_get(&dbc->kind, at_place(dbc, record, place));
}

/// Slot of a place of Scene (0) or Scene2 (1).
static int slot_at(const maplines_dbc_t *dbc, int message, const uint8_t *record, int place)
{
    const int fixed = dbc->scene.fixed[message][place];
    return fixed > 0 ? fixed - 1
                     : (int)maplines_get(&dbc->scene.slot, at_place(dbc, record, place));
}

/// What two records say of a slot.
typedef struct {
    int message;                  ///< that has a line of it: Scene (0) or Scene2 (1); NONE
    int place;                    ///< of the line
    maplines_left_out_t left_out; ///< by the first record that names the slot
} found_t;

/// Look for a slot in one of two records, and then in the other.
static found_t find_slot(const maplines_dbc_t *dbc, const maplines_scene_record_t *const scenes[2],
                         int first, int slot)
{
    found_t found = {NONE, 0, MAPLINES_IN_SCENE};
    bool is_named = false;
    for (int i = 0; i < 2; ++i)
    {
        const int message = i == 0 ? first : 1 - first;
        const uint8_t *record = scenes[message]->record;
        for (int place = 0; place < scenes[message]->places; ++place)
        {
            const int kind = kind_at(dbc, record, place);
            if (kind == MAPLINES_NO_LINE || slot_at(dbc, message, record, place) != slot)
            {
                continue;
            }
            if (kind < MAPLINES_NO_LINE && found.message == NONE)
            {
                found.message = message;
                found.place = place;
            }
            if (kind > MAPLINES_NO_LINE && !is_named)
            {
                found.left_out = (maplines_left_out_t)(kind - MAPLINES_NO_LINE);
            }
            is_named = true;
        }
    }
    return found;
}

/// Begin a view of a scene with the pose error of a record.
static void begin_view(const maplines_scene_record_t *scene, maplines_epoch_view_t *view)
{
    maplines_begin_view(scene->record, scene->t_ns, view);
}

/// Add the line at a place to a view.
static maplines_epoch_line_t *add_line(const maplines_dbc_t *dbc,
                                       const maplines_scene_record_t *scene, int place, int slot,
                                       maplines_epoch_view_t *view)
{
    return maplines_add_to_view(slot, at_place(dbc, scene->record, place), scene->t_ns, view);
}

MAPLINES_INTERNAL maplines_reason_t maplines_check_whole(const maplines_dbc_t *dbc,
                                                         const maplines_arrival_t *arrival)
{
    const uint8_t *record = arrival->record;
    const int message = arrival->owner - MAPLINES_WHOLE_SCENE;
    const maplines_signal_t *join = &dbc->scene.join;
    uint32_t named = 0;
    if (message == 0 && ((maplines_get(join, record) ^ maplines_get(&dbc->pose.counter, record)) &
                         maplines_raw_max(join)) != 0)
    {
        return MAPLINES_CONTENT;
    }
    for (int place = 0; place < arrival->places; ++place)
    {
        const int kind = kind_at(dbc, record, place);
        if (kind == MAPLINES_NO_LINE)
        {
            continue;
        }
        const uint32_t slot = (uint32_t)1 << (unsigned)slot_at(dbc, message, record, place);
        if (kind > KIND_LAST || (named & slot) != 0 ||
            (kind < MAPLINES_NO_LINE && !maplines_is_line(dbc, at_place(dbc, record, place))))
        {
            return MAPLINES_CONTENT;
        }
        named |= slot;
    }
    return MAPLINES_COMPLETE;
}

/// Whether the raw values of signals are the same in two records.
static bool are_same(size_t count, const maplines_signal_t *signals, const uint8_t *a,
                     const uint8_t *b)
{
    size_t i = 0;
    while (i < count &&
           (signals[i].length == 0 || maplines_get(&signals[i], a) == maplines_get(&signals[i], b)))
    {
        ++i;
    }
    return i == count;
}

/// Whether the newest Scene2 has the pose error of the newest Scene. Their ages differ.
static bool do_agree(const maplines_decoder_t *decoder)
{
    const maplines_whole_t *whole = &decoder->whole;
    const maplines_dbc_t *dbc = decoder->dbc;
    const maplines_cholesky_t *code = &dbc->pose_covariance;
    const uint8_t *a = whole->first.record;
    const uint8_t *b = whole->second.record;
    return maplines_distance(whole->first.t_ns, whole->second.t_ns) <=
               decoder->settings.cycle_ns[MAPLINES_WHOLE_SCENE] &&
           are_same(1, &dbc->scene.join, a, b) && are_same(4, code->pivot, a, b) &&
           are_same(6, code->ratio, a, b) && are_same(1, &code->inflation, a, b) &&
           are_same(1, &dbc->correlation_time, a, b) && are_same(1, &dbc->map_offset, a, b) &&
           are_same(1, &dbc->map_heading, a, b);
}

MAPLINES_INTERNAL void maplines_add_whole(maplines_decoder_t *decoder,
                                          const maplines_arrival_t *arrival,
                                          maplines_epoch_view_t *lines)
{
    maplines_whole_t *whole = &decoder->whole;
    const int message = arrival->owner - MAPLINES_WHOLE_SCENE;
    maplines_scene_record_t *scene = message == 0 ? &whole->first : &whole->second;
    const bool is_break = decoder->checks[arrival->owner].ahead == 0;
    memcpy(scene->record, arrival->record, sizeof(scene->record));
    scene->t_ns = arrival->t_ns;
    scene->places = arrival->places;
    whole->is_second_last = message == 1;
    bool may_join = !is_break;
    if (message == 0)
    {
        may_join = may_join && whole->is_early;
        whole->joined.places = 0;
        whole->is_early = false;
    }
    else
    {
        may_join = may_join && whole->first.places > 0 && whole->joined.places == 0;
        whole->is_early = true;
    }
    if (may_join && do_agree(decoder))
    {
        whole->joined = whole->second;
        whole->is_early = false;
    }
    begin_view(scene, lines);
    for (int place = 0; place < scene->places; ++place)
    {
        const int slot = slot_at(decoder->dbc, message, scene->record, place);
        if (kind_at(decoder->dbc, scene->record, place) < MAPLINES_NO_LINE && slot < MAPLINES_SLOTS)
        {
            (void)add_line(decoder->dbc, scene, place, slot, lines);
        }
    }
}

/// Scene that is the newest, and what has joined it.
static found_t find_in_scene(const maplines_decoder_t *decoder, int slot)
{
    const maplines_whole_t *whole = &decoder->whole;
    const maplines_scene_record_t *const scenes[2] = {&whole->first, &whole->joined};
    return find_slot(decoder->dbc, scenes, 0, slot);
}

/// Newest record that names a slot, or has its line.
static found_t find_newest(const maplines_decoder_t *decoder, int slot)
{
    const maplines_whole_t *whole = &decoder->whole;
    const maplines_scene_record_t *const scenes[2] = {&whole->first, &whole->second};
    return find_slot(decoder->dbc, scenes, whole->is_second_last ? 1 : 0, slot);
}

MAPLINES_INTERNAL bool maplines_newest_whole(const maplines_decoder_t *decoder,
                                             maplines_epoch_view_t *view)
{
    const maplines_whole_t *whole = &decoder->whole;
    begin_view(&whole->first, view);
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        const found_t found = find_in_scene(decoder, slot);
        if (found.message == NONE)
        {
            view->left_out[slot] = found.left_out;
        }
        else
        {
            const maplines_scene_record_t *scene =
                found.message == 0 ? &whole->first : &whole->joined;
            (void)add_line(decoder->dbc, scene, found.place, slot, view);
        }
    }
    return whole->first.places > 0;
}

MAPLINES_INTERNAL int maplines_whole_owner(const maplines_decoder_t *decoder, int slot)
{
    return MAPLINES_WHOLE_SCENE + (find_in_scene(decoder, slot).message == 1 ? 1 : 0);
}

MAPLINES_INTERNAL maplines_left_out_t maplines_whole_left_out(const maplines_decoder_t *decoder,
                                                              int slot)
{
    return find_newest(decoder, slot).left_out;
}

#if !MAPLINES_LINE_RECORDS
MAPLINES_INTERNAL bool maplines_decode_newest(const maplines_decoder_t *decoder, int slot,
                                              int *owner, maplines_line_t *line)
{
    const found_t found = find_newest(decoder, slot);
    const maplines_scene_record_t *scene =
        found.message == 1 ? &decoder->whole.second : &decoder->whole.first;
    maplines_epoch_view_t view;
    *owner = MAPLINES_WHOLE_SCENE + (found.message == 1 ? 1 : 0);
    if (found.message == NONE)
    {
        return false;
    }
    begin_view(scene, &view);
    add_line(decoder->dbc, scene, found.place, slot, &view)->line = line;
    return maplines_decode_epoch(decoder->dbc, &view, NULL) != 0;
}
#endif

#endif
