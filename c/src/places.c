/* Records of whole scenes: the place of each line, and what the record has there.
 *
 * Some places are those of a slot. The others are free, for the lines that matter most:
 *
 *     Scene     EGO_LEFT   EGO_RIGHT   the nearest, and the next one
 *     Scene2    EDGE_LEFT  EDGE_RIGHT  those that follow
 *
 * Slots must not go to and fro, so the choice has a hysteresis: Scene2 is sent in each cycle once
 * it was needed; a line that had a place counts as nearer, and keeps it. The operations are those
 * of maplines_can/model/places.py in the same order.
 */
#include "internal.h"

#if MAPLINES_SENDER && MAPLINES_SCENE_RECORDS

/// By how much a line counts as nearer that had a place in the last cycle [m].
static const double advantage = 1.0;

/// Line without a fixed place, and what orders such lines: the first is that with the least group,
/// then distance, then slot.
typedef struct {
    int slot;
    int group;       ///< 1: the centre, which follows from the ego lines; 2: it is left out
    double distance; ///< that counts [m]; 0 if it is left out
} ranked_line_t;

static bool has_slot(const uint8_t slots[MAPLINES_MAX_PLACES], int slot)
{
    bool is_there = false;
    for (int place = 0; place < MAPLINES_MAX_PLACES; ++place)
    {
        is_there = is_there || (int)slots[place] == slot + 1;
    }
    return is_there;
}

MAPLINES_INTERNAL bool maplines_has_place(const maplines_chosen_places_t *places, int slot)
{
    return has_slot(places->slots[0], slot) || has_slot(places->slots[1], slot);
}

static bool is_before(const ranked_line_t *a, const ranked_line_t *b)
{
    if (a->group != b->group)
    {
        return a->group < b->group;
    }
    if (a->distance < b->distance || a->distance > b->distance)
    {
        return a->distance < b->distance;
    }
    return a->slot < b->slot;
}

static int place_count(const maplines_dbc_t *dbc, const maplines_whole_cycle_t *cycle)
{
    return (int)(cycle->is_secured ? dbc->scene.secured_places : dbc->scene.places);
}

/// A line is to be sent; that of a slot that was retracted is not.
static bool is_wanted(const maplines_whole_cycle_t *cycle, int i)
{
    return (cycle->slots >> (unsigned)cycle->space->members[i].slot & 1U) != 0U;
}

/// Give lines without a place the fixed ones of a message.
static void fix_places(const maplines_dbc_t *dbc, const maplines_whole_cycle_t *cycle, int message,
                       maplines_chosen_places_t *places)
{
    for (int place = 0; place < place_count(dbc, cycle); ++place)
    {
        const uint8_t fixed = dbc->scene.fixed[message][place];
        for (int i = 0; i < cycle->count; ++i)
        {
            const int slot = cycle->space->members[i].slot;
            if (is_wanted(cycle, i) && (int)fixed == slot + 1 && !maplines_has_place(places, slot))
            {
                places->slots[message][place] = fixed;
            }
        }
    }
}

static ranked_line_t ranked_line(const maplines_scene_member_t *member, bool had_place)
{
    ranked_line_t line = {member->slot, 0, member->distance};
#if MAPLINES_SLOTS > 4
    if (member->slot == (int)MAPLINES_CENTRE)
    {
        line.group = 1;
    }
#endif
    if (had_place)
    {
        line.distance = line.distance - advantage;
    }
    if (member->left_out != MAPLINES_IN_SCENE)
    {
        line.group = 2;
        line.distance = 0.0;
    }
    return line;
}

/// Lines without a place that may have one in a message, in their order; their number.
static int rank(const maplines_whole_cycle_t *cycle, const maplines_chosen_places_t *places,
                int message, const maplines_chosen_places_t *last,
                ranked_line_t ranked[MAPLINES_SLOTS])
{
    int count = 0;
    for (int i = 0; i < cycle->count; ++i)
    {
        const maplines_scene_member_t *member = &cycle->space->members[i];
        if (!is_wanted(cycle, i) || maplines_has_place(places, member->slot))
        {
            continue;
        }
        const bool had_place = has_slot(last->slots[0], member->slot) ||
                               (message > 0 && has_slot(last->slots[1], member->slot));
        const ranked_line_t line = ranked_line(member, had_place);
        int at = count;
        while (at > 0 && is_before(&line, &ranked[at - 1]))
        {
            ranked[at] = ranked[at - 1];
            --at;
        }
        ranked[at] = line;
        ++count;
    }
    return count;
}

/// Number of the places of a message that a record may give to any line.
static int free_places(const maplines_dbc_t *dbc, const maplines_whole_cycle_t *cycle, int message)
{
    int count = 0;
    for (int place = 0; place < place_count(dbc, cycle); ++place)
    {
        count += dbc->scene.fixed[message][place] == 0U ? 1 : 0;
    }
    return count;
}

/// Give lines the free places of a message: that of the last cycle, else the first one.
static void fill_places(const maplines_dbc_t *dbc, const maplines_whole_cycle_t *cycle, int message,
                        const ranked_line_t *lines, int count, const maplines_chosen_places_t *last,
                        maplines_chosen_places_t *places)
{
    const uint8_t *fixed = dbc->scene.fixed[message];
    uint8_t *slots = places->slots[message];
    for (int i = 0; i < count; ++i)
    {
        for (int place = 0; place < place_count(dbc, cycle); ++place)
        {
            if (fixed[place] == 0U && (int)last->slots[message][place] == lines[i].slot + 1)
            {
                slots[place] = (uint8_t)(lines[i].slot + 1);
            }
        }
    }
    for (int i = 0; i < count; ++i)
    {
        for (int place = 0; !has_slot(slots, lines[i].slot) && place < place_count(dbc, cycle);
             ++place)
        {
            if (fixed[place] == 0U && slots[place] == 0U)
            {
                slots[place] = (uint8_t)(lines[i].slot + 1);
            }
        }
    }
}

MAPLINES_INTERNAL void maplines_choose_places(const maplines_dbc_t *dbc,
                                              const maplines_whole_cycle_t *cycle,
                                              maplines_chosen_places_t *places)
{
    const maplines_chosen_places_t last = *places;
    const maplines_messages_t *second = &dbc->messages[MAPLINES_PLACE_OF(MAPLINES_SCENE2)];
    const bool has_second =
        second->is_present && (cycle->is_secured ? second->has_secured : second->has_fd);
    ranked_line_t ranked[MAPLINES_SLOTS];
    memset(places, 0, sizeof *places);
    fix_places(dbc, cycle, 0, places);
    const bool is_full = rank(cycle, places, 0, &last, ranked) > free_places(dbc, cycle, 0);
    places->sends_scene2 = has_second && (last.sends_scene2 || is_full);
    if (places->sends_scene2)
    {
        fix_places(dbc, cycle, 1, places);
    }
    for (int message = 0; message <= (places->sends_scene2 ? 1 : 0); ++message)
    {
        const int count = rank(cycle, places, message, &last, ranked);
        const int most = free_places(dbc, cycle, message);
        fill_places(dbc, cycle, message, ranked, count < most ? count : most, &last, places);
    }
}

/// Write a line, or why there is none, as at the first place.
static void write_place(const maplines_dbc_t *dbc, const maplines_scene_member_t *member,
                        bool is_named, uint8_t *line)
{
    if (member == NULL)
    {
        maplines_put(&dbc->kind, line, MAPLINES_NO_LINE);
        return;
    }
    if (member->left_out == MAPLINES_IN_SCENE)
    {
        maplines_put_line(dbc, member, line);
    }
    else
    {
        maplines_put(&dbc->kind, line, MAPLINES_NO_LINE + (int64_t)member->left_out);
    }
    if (is_named)
    {
        maplines_put(&dbc->scene.slot, line, (int64_t)member->slot);
    }
}

MAPLINES_INTERNAL size_t maplines_write_whole(const maplines_dbc_t *dbc,
                                              const maplines_whole_cycle_t *cycle,
                                              const maplines_chosen_places_t *places, int message,
                                              uint8_t *record)
{
    const size_t length =
        cycle->is_secured ? (size_t)dbc->pose.fd_authentic - 1U : 8U * (size_t)dbc->pose.pages;
    uint8_t written[MAPLINES_RECORD_ROOM] = {0};
    maplines_put_pose(dbc, cycle->space, cycle->age, written);
    maplines_put(&dbc->scene.join, written, (int64_t)cycle->counter);
    for (int place = 0; place < place_count(dbc, cycle); ++place)
    {
        const maplines_scene_member_t *member = NULL;
        for (int i = 0; i < cycle->count; ++i)
        {
            if ((int)places->slots[message][place] == cycle->space->members[i].slot + 1)
            {
                member = &cycle->space->members[i];
            }
        }
        write_place(dbc, member, dbc->scene.fixed[message][place] == 0U,
                    written + (size_t)dbc->scene.stride * (size_t)place);
    }
    memcpy(record, written, length);
    return length;
}

#endif
