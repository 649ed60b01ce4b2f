/* Records of whole scenes: the place of each line, and what the record has there.
 *
 * Some places are those of a slot. The others are for the lines that matter most:
 *
 *     Scene     EGO_LEFT   EGO_RIGHT   the nearest, the next one
 *     Scene2    EDGE_LEFT  EDGE_RIGHT  those that follow
 *
 * A choice that changes from cycle to cycle would make lines flicker, so it has a hysteresis: Scene2
 * is sent for ever once it was needed, a line in Scene counts as nearer, and a line keeps its place.
 * The operations are those of maplines_can/model/places.py in the same order.
 */
#include "internal.h"

#if MAPLINES_SENDER && MAPLINES_SCENE_RECORDS

/// By how much a line counts as nearer if it had a place in Scene in the last cycle [m].
static const double advantage = 1.0;

/// Line that may have a place.
typedef struct {
    int slot;
    bool is_left_out;
    double distance; ///< that counts [m]
} candidate_t;

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

/// The centre line follows from the ego lines.
static bool is_centre(int slot)
{
#if MAPLINES_SLOTS > 4
    return slot == (int)MAPLINES_CENTRE;
#else
    (void)slot;
    return false;
#endif
}

/// A line matters more than another one.
static bool is_before(const candidate_t *a, const candidate_t *b)
{
    if (a->is_left_out != b->is_left_out)
    {
        return b->is_left_out;
    }
    if (is_centre(a->slot) != is_centre(b->slot))
    {
        return is_centre(b->slot);
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

/// Lines without a place, the one that matters most first; their number.
static int rank(const maplines_whole_cycle_t *cycle, const maplines_chosen_places_t *places,
                const maplines_chosen_places_t *last, candidate_t ranked[MAPLINES_SLOTS])
{
    int count = 0;
    for (int i = 0; i < cycle->count; ++i)
    {
        const maplines_scene_member_t *member = &cycle->space->members[i];
        candidate_t line = {member->slot, member->left_out != MAPLINES_IN_SCENE, member->distance};
        if (!is_wanted(cycle, i) || maplines_has_place(places, line.slot))
        {
            continue;
        }
        if (has_slot(last->slots[0], line.slot))
        {
            line.distance = line.distance - advantage;
        }
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
                        const candidate_t *lines, int count, const maplines_chosen_places_t *last,
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
    candidate_t ranked[MAPLINES_SLOTS];
    memset(places, 0, sizeof *places);
    fix_places(dbc, cycle, 0, places);
    int count = rank(cycle, places, &last, ranked);
    int first = free_places(dbc, cycle, 0);
    places->sends_scene2 = has_second && (last.sends_scene2 || count > first);
    if (places->sends_scene2)
    {
        fix_places(dbc, cycle, 1, places);
        count = rank(cycle, places, &last, ranked);
    }
    first = count < first ? count : first;
    fill_places(dbc, cycle, 0, ranked, first, &last, places);
    if (places->sends_scene2)
    {
        const int most = free_places(dbc, cycle, 1);
        const int rest = count - first;
        fill_places(dbc, cycle, 1, &ranked[first], rest < most ? rest : most, &last, places);
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
        (void)maplines_write_conditional(dbc, member, line);
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
    maplines_put_pose(dbc, cycle->space, cycle->age, record);
    maplines_put(&dbc->scene.join, record, (int64_t)cycle->counter);
    for (int place = 0; place < place_count(dbc, cycle); ++place)
    {
        const size_t offset = (size_t)dbc->scene.stride * (size_t)place;
        const maplines_scene_member_t *member = NULL;
        uint8_t line[MAPLINES_MAX_RECORD] = {0};
        for (int i = 0; i < cycle->count; ++i)
        {
            if ((int)places->slots[message][place] == cycle->space->members[i].slot + 1)
            {
                member = &cycle->space->members[i];
            }
        }
        write_place(dbc, member, dbc->scene.fixed[message][place] == 0U, line);
        for (size_t i = offset; i < length; ++i)
        {
            record[i] = (uint8_t)(record[i] | line[i - offset]);
        }
    }
    return length;
}

#endif
