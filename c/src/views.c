/* What a consumer asks a decoder for: the newest line of a slot, the newest scene, and numbers. */
#include "internal.h"

#if MAPLINES_RECEIVER

/// The caller's time may be before a reception by this much [ns]: clocks that are synchronised
/// differ by less. By more, the caller's clock was set back, and no age is known.
#define CLOCK_JITTER_NS 1000000

/* ---- owners ------------------------------------------------------------------------------------
 */

MAPLINES_INTERNAL int maplines_owner_of_line(const maplines_decoder_t *decoder, int slot)
{
#if MAPLINES_SCENE_RECORDS && MAPLINES_LINE_RECORDS
    if (maplines_has_whole_scenes(decoder->dbc))
    {
        const bool has_line = (decoder->has_newest >> (unsigned)slot & 1U) != 0;
        return has_line ? decoder->brought_by[slot] : MAPLINES_WHOLE_SCENE;
    }
#else
    (void)decoder;
#endif
    return slot;
}

MAPLINES_INTERNAL int maplines_owner_of_pose(const maplines_decoder_t *decoder, int owner)
{
#if MAPLINES_SCENES && MAPLINES_LINE_RECORDS
    if (!MAPLINES_IS_WHOLE(owner) && decoder->dbc->is_conditional)
    {
        return (int)MAPLINES_POSE;
    }
#else
    (void)decoder;
#endif
    return owner;
}

#if MAPLINES_SCENES
MAPLINES_INTERNAL int maplines_owner_of_scene(const maplines_decoder_t *decoder)
{
    return maplines_has_whole_scenes(decoder->dbc) ? MAPLINES_WHOLE_SCENE : (int)MAPLINES_POSE;
}

MAPLINES_INTERNAL int maplines_owner_in_scene(const maplines_decoder_t *decoder, int slot)
{
#if MAPLINES_SCENE_RECORDS
    if (maplines_has_whole_scenes(decoder->dbc))
    {
        return maplines_whole_owner(decoder, slot);
    }
#else
    (void)decoder;
#endif
    return slot;
}
#endif

/* ---- views -------------------------------------------------------------------------------------
 */

/// Time since a reception.
typedef struct {
    double waited; ///< [s]; infinite if unknown
    bool is_long;  ///< longer than a number of cycles, or unknown
} waited_t;

static waited_t waited_since(const maplines_decoder_t *decoder, int owner, int64_t t_ns,
                             int64_t now_ns)
{
    const int64_t waited_ns = now_ns - t_ns;
    const double longest_ns =
        decoder->settings.stale_cycles * (double)decoder->settings.cycle_ns[owner];
    waited_t since = {HUGE_VAL, true};
    if (waited_ns >= -CLOCK_JITTER_NS)
    {
        since.waited = (double)(waited_ns > 0 ? waited_ns : 0) / 1e9;
        since.is_long = (double)waited_ns > longest_ns;
    }
    return since;
}

/// State of an owner at a time; if this clock was set back, no cycles have passed. `two_senders` is
/// set if there is a second one, or seems to be.
static maplines_e2e_state_t state_at(maplines_decoder_t *decoder, int owner, int64_t now_ns,
                                     double waited, bool *two_senders)
{
    const maplines_e2e_state_t state = waited < HUGE_VAL
                                           ? maplines_check_elapse(decoder, owner, now_ns)
                                           : decoder->checks[owner].machine.state;
    if (!maplines_has_one_sender(decoder, owner, now_ns))
    {
        *two_senders = true;
    }
    return state;
}

#if MAPLINES_LINE_RECORDS
const maplines_line_t *maplines_newest(const maplines_decoder_t *decoder, maplines_owner_t slot)
{
    if (!MAPLINES_REQUIRE(maplines_is_decoder(decoder)) ||
        !MAPLINES_REQUIRE((unsigned)slot < MAPLINES_SLOTS))
    {
        return NULL;
    }
    const bool is_known = maplines_is_slot(decoder, (int)slot);
    const bool has_line = is_known && (decoder->has_newest >> (unsigned)slot & 1U) != 0;
    return has_line ? &decoder->newest[slot] : NULL;
}

bool maplines_component(const maplines_decoder_t *decoder, maplines_owner_t slot, uint8_t i,
                        maplines_gaussian_t *gaussian, maplines_real_t *weight)
{
    const maplines_line_t *line = maplines_newest(decoder, slot);
    if (!MAPLINES_REQUIRE(gaussian != NULL) || !MAPLINES_REQUIRE(weight != NULL) || line == NULL ||
        i >= line->components)
    {
        return false;
    }
    *gaussian = line->gaussian;
    *weight = (maplines_real_t)1.0;
#if MAPLINES_MIXTURES
    if (line->components > 1)
    {
        maplines_complete_t content;
        const maplines_mixture_t *mixture = &decoder->mixtures[slot];
        (void)maplines_read_complete(decoder->dbc, (int)slot, mixture->records[i], mixture->t_ns[i],
                                     &content);
        *gaussian = content.line.gaussian;
        *weight = (maplines_real_t)content.weight;
    }
#endif
    return true;
}

#endif

/// The newest line of a slot, and the owner of the records that brought it; NULL if there is none.
/// Where lines are decoded when they are asked for, it is in `room`.
static const maplines_line_t *line_of(const maplines_decoder_t *decoder, int slot,
                                      maplines_line_t *room, int *owner)
{
#if MAPLINES_LINE_RECORDS
    (void)room;
    *owner = maplines_owner_of_line(decoder, slot);
    return maplines_newest(decoder, (maplines_owner_t)slot);
#else
    return maplines_decode_newest(decoder, slot, owner, room) ? room : NULL;
#endif
}

/// View of the newest line of a slot.
static void see_line(maplines_decoder_t *decoder, maplines_owner_t slot, int64_t now_ns,
                     maplines_line_t *room, maplines_view_t *view)
{
    const int64_t t_ns = maplines_limited_time(now_ns);
    memset(view, 0, sizeof(*view));
    view->slot = slot;
    view->age = (maplines_real_t)HUGE_VAL;
    view->is_stale = true;
    view->state = MAPLINES_E2E_NODATA;
    view->status = MAPLINES_E2E_NONE;
    if (!MAPLINES_REQUIRE(maplines_is_decoder(decoder)) || !decoder->is_ready ||
        !MAPLINES_REQUIRE(maplines_is_slot(decoder, (int)slot)))
    {
        return;
    }
    int owner = 0;
    const maplines_line_t *line = line_of(decoder, (int)slot, room, &owner);
    double waited = 0.0;
    if (line != NULL)
    {
        const waited_t since = waited_since(decoder, owner, line->t_ns, t_ns);
        waited = since.waited;
        view->line = line;
        view->age = line->age + (maplines_real_t)waited;
        view->is_stale = since.is_long;
    }
    view->state = state_at(decoder, owner, t_ns, waited, &view->two_senders);
    view->status = decoder->checks[owner].status;
    const int of_pose = maplines_owner_of_pose(decoder, owner);
    if (of_pose != owner)
    {
        const maplines_e2e_state_t pose_state =
            state_at(decoder, of_pose, t_ns, waited, &view->two_senders);
        view->state = view->state == MAPLINES_E2E_VALID ? pose_state : view->state;
    }
#if MAPLINES_SCENE_RECORDS
    if (maplines_has_whole_scenes(decoder->dbc))
    {
        view->left_out = maplines_whole_left_out(decoder, (int)slot);
    }
#endif
    view->is_usable = line != NULL && line->status != MAPLINES_OUT_OF_RANGE &&
                      line->age < (maplines_real_t)HUGE_VAL && view->state == MAPLINES_E2E_VALID &&
                      !view->is_stale && !view->two_senders;
}

#if MAPLINES_LINE_RECORDS
void maplines_latest(maplines_decoder_t *decoder, maplines_owner_t slot, int64_t now_ns,
                     maplines_view_t *view)
{
    if (!MAPLINES_REQUIRE(view != NULL))
    {
        return;
    }
    see_line(decoder, slot, now_ns, NULL, view);
}
#endif

void maplines_copy_line(maplines_decoder_t *decoder, maplines_owner_t slot, int64_t now_ns,
                        maplines_line_copy_t *copy)
{
    maplines_view_t view;
    if (!MAPLINES_REQUIRE(copy != NULL))
    {
        return;
    }
    memset(copy, 0, sizeof(*copy));
    see_line(decoder, slot, now_ns, &copy->line, &view);
    copy->has_line = view.line != NULL;
#if MAPLINES_LINE_RECORDS
    if (copy->has_line)
    {
        copy->line = *view.line;
    }
#endif
    copy->is_stale = view.is_stale;
    copy->two_senders = view.two_senders;
    copy->is_usable = view.is_usable;
    copy->slot = view.slot;
    copy->state = view.state;
    copy->status = view.status;
#if MAPLINES_SCENE_RECORDS
    copy->left_out = view.left_out;
#endif
    copy->age = view.age;
    copy->now_ns = now_ns;
}

#if MAPLINES_SCENES
MAPLINES_INTERNAL const maplines_scene_t *maplines_newest_scene(maplines_decoder_t *decoder,
                                                                maplines_scene_t *room)
{
    maplines_epoch_view_t epoch;
#if MAPLINES_LINE_RECORDS
    (void)room;
    if (decoder->is_built)
    {
        return &decoder->scene;
    }
#if MAPLINES_SCENE_RECORDS
    decoder->is_built = maplines_has_whole_scenes(decoder->dbc)
                            ? maplines_newest_whole(decoder, &epoch)
                            : maplines_latest_epoch(decoder, &epoch);
#else
    decoder->is_built = maplines_latest_epoch(decoder, &epoch);
#endif
    if (!decoder->is_built)
    {
        return NULL;
    }
    (void)maplines_decode_epoch(decoder->dbc, &epoch, &decoder->scene);
    return &decoder->scene;
#else
    if (!maplines_newest_whole(decoder, &epoch))
    {
        return NULL;
    }
    (void)maplines_decode_epoch(decoder->dbc, &epoch, room);
    return room;
#endif
}

/// View of the newest scene.
static void see_scene(maplines_decoder_t *decoder, int64_t now_ns, maplines_scene_t *room,
                      maplines_scene_view_t *view)
{
    const int64_t t_ns = maplines_limited_time(now_ns);
    memset(view, 0, sizeof(*view));
    view->age = (maplines_real_t)HUGE_VAL;
    view->is_stale = true;
    view->state = MAPLINES_E2E_NODATA;
    view->status = MAPLINES_E2E_NONE;
    if (!MAPLINES_REQUIRE(maplines_is_decoder(decoder)) || !decoder->is_ready ||
        !decoder->dbc->has_pose)
    {
        return;
    }
    const int owner = maplines_owner_of_scene(decoder);
    const maplines_scene_t *scene = maplines_newest_scene(decoder, room);
    if (scene == NULL)
    {
        view->state = maplines_check_elapse(decoder, owner, t_ns);
        view->status = decoder->checks[owner].status;
        return;
    }
    const waited_t since = waited_since(decoder, owner, scene->t_ns, t_ns);
    view->scene = scene;
    view->is_stale = since.is_long;
    view->age = scene->age + (maplines_real_t)since.waited;
#if MAPLINES_LINE_RECORDS
    if (decoder->epochs.is_too_old) // the newest pose error, which may be that of the next scene
    {
        view->age = (maplines_real_t)HUGE_VAL;
    }
#endif
    view->state = state_at(decoder, owner, t_ns, since.waited, &view->two_senders);
    view->status = decoder->checks[owner].status;
    bool are_valid = view->state == MAPLINES_E2E_VALID;
    for (unsigned i = 0; i < scene->count; ++i)
    {
        const int of_line = maplines_owner_in_scene(decoder, (int)scene->lines[i].slot);
        view->slot_states[i] = state_at(decoder, of_line, t_ns, since.waited, &view->two_senders);
        are_valid = are_valid && view->slot_states[i] == MAPLINES_E2E_VALID;
    }
    view->is_usable =
        are_valid && view->age < (maplines_real_t)HUGE_VAL && !view->is_stale && !view->two_senders;
}

#if MAPLINES_LINE_RECORDS
void maplines_latest_scene(maplines_decoder_t *decoder, int64_t now_ns, maplines_scene_view_t *view)
{
    if (!MAPLINES_REQUIRE(view != NULL))
    {
        return;
    }
    see_scene(decoder, now_ns, NULL, view);
}
#endif

void maplines_copy_scene(maplines_decoder_t *decoder, int64_t now_ns, maplines_scene_copy_t *copy)
{
    maplines_scene_view_t view;
    if (!MAPLINES_REQUIRE(copy != NULL))
    {
        return;
    }
    memset(copy, 0, sizeof(*copy));
    see_scene(decoder, now_ns, &copy->scene, &view);
    copy->has_scene = view.scene != NULL;
#if MAPLINES_LINE_RECORDS
    if (copy->has_scene)
    {
        copy->scene = *view.scene;
    }
#endif
    copy->is_stale = view.is_stale;
    copy->two_senders = view.two_senders;
    copy->is_usable = view.is_usable;
    copy->state = view.state;
    copy->status = view.status;
    memcpy(copy->slot_states, view.slot_states, sizeof(copy->slot_states));
    copy->age = view.age;
    copy->now_ns = now_ns;
}
#endif

bool maplines_slot_stats(maplines_decoder_t *decoder, maplines_owner_t owner, int64_t now_ns,
                         maplines_slot_stats_t *stats)
{
    if (!MAPLINES_REQUIRE(stats != NULL))
    {
        return false;
    }
    memset(stats, 0, sizeof(*stats));
    stats->state = MAPLINES_E2E_NODATA;
    stats->status = MAPLINES_E2E_NONE;
    const int place = (int)owner - MAPLINES_FIRST_OWNER;
    if (!MAPLINES_REQUIRE(maplines_is_decoder(decoder)) ||
        !MAPLINES_REQUIRE((unsigned)place < MAPLINES_OWNERS) || !decoder->is_ready ||
        !decoder->dbc->messages[place].is_present)
    {
        return false;
    }
    const maplines_check_t *check = &decoder->checks[place];
    stats->state = maplines_check_elapse(decoder, place, maplines_limited_time(now_ns));
    stats->status = check->status;
    stats->ok = check->ok + check->some_lost;
    stats->lost = check->lost;
    stats->repeated = check->repeated;
    stats->wrong_sequence = check->wrong_sequence;
    stats->errors = check->errors;
    stats->no_new_data = check->no_new_data;
    stats->two_senders = check->conflict.is_confirmed;
    return check->status != MAPLINES_E2E_NONE;
}

void maplines_statistics(const maplines_decoder_t *decoder, maplines_statistics_t *statistics)
{
    if (!MAPLINES_REQUIRE(statistics != NULL))
    {
        return;
    }
    memset(statistics, 0, sizeof(*statistics));
    if (!MAPLINES_REQUIRE(maplines_is_decoder(decoder)))
    {
        return;
    }
    *statistics = decoder->statistics;
    statistics->lost = 0;
    for (int owner = 0; owner < MAPLINES_OWNERS; ++owner)
    {
        statistics->lost += maplines_is_pose(owner) ? 0 : decoder->checks[owner].lost;
    }
#if MAPLINES_LINE_RECORDS
    statistics->pending = maplines_pending_transfers(decoder);
#endif
#if MAPLINES_MIXTURES
    statistics->pending += maplines_pending_mixtures(decoder);
#endif
#if MAPLINES_SCENES && MAPLINES_LINE_RECORDS
    statistics->pending += maplines_pending_lines(decoder);
#endif
}

#endif
