/* Decoder of received frames: frames in, lines and scenes out, everything else counted. */
#include "internal.h"

#if MAPLINES_RECEIVER

/// The caller's time may be before a reception by this much [ns]: clocks that are synchronised
/// differ by less. By more, the caller's clock was set back, and no age is known.
#define CLOCK_JITTER_NS 1000000
#define MAX_ID UINT32_C(0x7FF) ///< greatest CAN ID of 11 bits, and of 29
#define MAX_EXTENDED_ID UINT32_C(0x1FFFFFFF)

/// Hash of a record (FNV-1a), to recognise duplicates.
static uint32_t hash_of(const uint8_t *record, size_t length)
{
    uint32_t hash = 0x811C9DC5U;
    for (size_t i = 0; i < length; ++i)
    {
        hash ^= record[i];
        hash *= 0x01000193U;
    }
    return hash;
}

static bool is_initialised(const maplines_decoder_t *decoder)
{
    return decoder != NULL && decoder->magic == MAPLINES_DECODER_MAGIC;
}

static bool is_slot(const maplines_decoder_t *decoder, int owner)
{
    return decoder->is_ready && (unsigned)owner < MAPLINES_SLOTS &&
           decoder->dbc->messages[owner].is_present;
}

const char *maplines_decoder_init(maplines_decoder_t *decoder, const maplines_dbc_t *dbc,
                                  const maplines_settings_t *settings)
{
    if (!MAPLINES_REQUIRE(decoder != NULL))
    {
        return "decoder must not be NULL";
    }
    if (!MAPLINES_REQUIRE(dbc != NULL))
    {
        memset(decoder, 0, sizeof(*decoder));
        return "dbc must not be NULL";
    }
    maplines_settings_t wanted;
    maplines_default_settings(dbc, &wanted);
    if (settings != NULL)
    {
        wanted = *settings; // before the decoder is cleared: they may be its own
    }
    memset(decoder, 0, sizeof(*decoder));
    decoder->magic = MAPLINES_DECODER_MAGIC;
    decoder->dbc = dbc;
    maplines_default_settings(dbc, &decoder->settings);
    const char *problem = maplines_settings_problem(dbc, &wanted);
    if (problem != NULL)
    {
        return problem;
    }
    decoder->settings = wanted;
    decoder->is_ready = true;
    for (int owner = 0; owner < MAPLINES_OWNERS; ++owner)
    {
        if (!dbc->messages[owner].is_present)
        {
            continue;
        }
        maplines_check_init(&decoder->checks[owner], decoder->settings.cycle_ns[owner]);
#if MAPLINES_SECOC
        const maplines_authenticator_t *authenticator = decoder->settings.authenticator;
        decoder->freshness_us[owner] =
            authenticator != NULL ? authenticator->not_before_us : INT64_C(0);
#endif
    }
#if MAPLINES_SCENES
    maplines_epochs_init(&decoder->epochs);
#endif
    return NULL;
}

/* ---- frames ------------------------------------------------------------------------------------
 */

static maplines_reason_t dropped_record(maplines_decoder_t *decoder, maplines_reason_t reason,
                                        uint32_t frames)
{
    decoder->statistics.counts[reason] += frames;
    return reason;
}

/// Count a line that a frame has completed, which is the newest of its slot.
static void deliver(maplines_decoder_t *decoder, int slot, uint32_t frames, uint8_t records,
                    maplines_fed_t *fed)
{
    maplines_check_delivered(decoder, slot, records);
    ++decoder->statistics.lines;
    decoder->statistics.line_frames += frames;
    decoder->has_newest |= (uint32_t)1 << (unsigned)slot;
    fed->reason = MAPLINES_COMPLETE;
    fed->slots[fed->count] = (maplines_owner_t)slot;
    ++fed->count;
}

/// Add a new record with a covariance of its own to its mixture, and its line to a scene.
static void feed_component(maplines_decoder_t *decoder, const maplines_arrival_t *arrival,
                           maplines_fed_t *fed)
{
    const maplines_complete_t *content = &arrival->content;
#if MAPLINES_MIXTURES
    uint32_t frames = 0;
    if (content->count > 1 &&
        maplines_conflict_was_reused(&decoder->checks[arrival->owner].conflict,
                                     decoder->settings.cycle_ns[arrival->owner], arrival->t_ns))
    {
        maplines_drop_mixture(decoder, arrival->owner); // its components may come from two senders
        fed->reason = dropped_record(decoder, MAPLINES_INCOMPLETE, arrival->frames);
        return;
    }
    fed->reason = maplines_add_component(decoder, arrival, &frames);
    if (fed->reason != MAPLINES_COMPLETE)
    {
        return;
    }
#else
    const uint32_t frames = arrival->frames;
    decoder->newest[arrival->owner] = content->line;
#endif
#if MAPLINES_SCENES
    if (decoder->dbc->has_pose && content->count == 1 && content->line.x_min < content->line.x_max)
    {
        maplines_joining_t line;
        maplines_joined_t joined;
        memcpy(line.line.record, arrival->record, MAPLINES_MAX_RECORD);
        line.line.t_ns = arrival->t_ns;
        line.counter = content->counter;
        line.frames = 0; // they are counted as those of the line
        const bool is_break = decoder->checks[arrival->owner].ahead == 0;
        (void)maplines_add_line(decoder, arrival->owner, &line, is_break, &joined);
    }
#endif
    deliver(decoder, arrival->owner, frames, content->count, fed);
}

#if MAPLINES_SCENES
/// Deliver the lines of conditional records that have joined one pose error, decoded into `scene`,
/// too, unless it is NULL. What is no function of x is counted instead.
static void feed_joined(maplines_decoder_t *decoder, const maplines_joined_t *joined, int count,
                        maplines_fed_t *fed, maplines_scene_t *scene)
{
    const maplines_epoch_t *epoch = &decoder->epochs.epochs[joined[0].epoch];
    int slots[MAPLINES_SLOTS] = {0};
    for (int i = 0; i < count; ++i)
    {
        slots[i] = joined[i].slot;
    }
    const uint32_t found =
        maplines_decode_epoch(decoder->dbc, epoch, count, slots, decoder->newest, scene);
    for (int i = 0; i < count; ++i)
    {
        if ((found >> (unsigned)slots[i] & 1U) != 0)
        {
            deliver(decoder, slots[i], joined[i].frames, 1, fed);
        }
        else
        {
            fed->reason = dropped_record(decoder, MAPLINES_CONTENT, joined[i].frames);
        }
    }
    fed->reason = fed->count > 0 ? MAPLINES_COMPLETE : fed->reason;
}

/// Add a new pose error to the epochs, and deliver the lines that waited for it.
static void feed_pose(maplines_decoder_t *decoder, const maplines_arrival_t *arrival,
                      maplines_fed_t *fed, maplines_scene_t *scene)
{
    const uint32_t ahead = decoder->checks[MAPLINES_POSE].ahead;
    maplines_joined_t joined[MAPLINES_SLOTS];
    maplines_check_delivered(decoder, MAPLINES_POSE, 1);
    ++decoder->statistics.pose_errors;
    decoder->statistics.pose_frames += arrival->frames;
    const int count = maplines_add_pose(decoder, arrival->record, arrival->t_ns, ahead, joined);
    if (decoder->dbc->is_conditional && count > 0)
    {
        feed_joined(decoder, joined, count, fed, scene);
    }
    fed->reason = fed->count > 0 ? MAPLINES_COMPLETE : MAPLINES_PENDING;
}

/// Add a new record that is conditional on a pose error.
static void feed_conditional(maplines_decoder_t *decoder, const maplines_arrival_t *arrival,
                             uint32_t counter, maplines_fed_t *fed, maplines_scene_t *scene)
{
    const bool is_break = decoder->checks[arrival->owner].ahead == 0;
    maplines_joining_t line;
    maplines_joined_t joined;
    memcpy(line.line.record, arrival->record, MAPLINES_MAX_RECORD);
    line.line.t_ns = arrival->t_ns;
    line.counter = counter;
    line.frames = (uint8_t)arrival->frames;
    if (maplines_add_line(decoder, arrival->owner, &line, is_break, &joined))
    {
        feed_joined(decoder, &joined, 1, fed, scene);
    }
}
#endif

maplines_fed_t maplines_feed(maplines_decoder_t *decoder, const maplines_frame_t *frame,
                             int64_t t_ns)
{
    maplines_fed_t fed;
    memset(&fed, 0, sizeof(fed));
    fed.reason = MAPLINES_FOREIGN;
    if (!MAPLINES_REQUIRE(is_initialised(decoder)) || !MAPLINES_REQUIRE(frame != NULL))
    {
        return fed;
    }
    if (!MAPLINES_REQUIRE(frame->can_id <= (frame->is_extended ? MAX_EXTENDED_ID : MAX_ID)))
    {
        ++decoder->statistics.frames;
        (void)dropped_record(decoder, MAPLINES_FOREIGN, 1);
        return fed;
    }
    if (!MAPLINES_REQUIRE(frame->length <= sizeof(frame->data)))
    {
        ++decoder->statistics.frames;
        fed.reason = dropped_record(decoder, MAPLINES_LENGTH, 1);
        return fed;
    }
    return maplines_feed_with(decoder, frame, t_ns, NULL);
}

MAPLINES_INTERNAL maplines_fed_t maplines_feed_with(maplines_decoder_t *decoder,
                                                    const maplines_frame_t *frame, int64_t t_ns,
                                                    maplines_scene_t *scene)
{
    maplines_fed_t fed;
    maplines_arrival_t arrival;
    memset(&fed, 0, sizeof(fed));
    memset(&arrival, 0, sizeof(arrival));
    ++decoder->statistics.frames;
    if (!decoder->is_ready)
    {
        fed.reason = dropped_record(decoder, MAPLINES_FOREIGN, 1);
        return fed;
    }
    const int64_t now_ns = maplines_limited_time(t_ns);
    fed.reason = maplines_reassemble(decoder, frame, now_ns, &arrival);
    const int owner = arrival.owner;
    if (fed.reason != MAPLINES_COMPLETE)
    {
        if (fed.reason != MAPLINES_FOREIGN)
        {
            maplines_check_dropped(decoder, owner, fed.reason, now_ns);
        }
        return fed;
    }
    if (arrival.reason != MAPLINES_COMPLETE)
    {
        maplines_check_failed(decoder, owner, arrival.t_ns);
        fed.reason = dropped_record(decoder, arrival.reason, arrival.frames);
        return fed;
    }
    const bool is_complete = !decoder->dbc->is_conditional && owner != MAPLINES_POSE;
    const maplines_record_t *layout = maplines_layout(decoder->dbc, owner);
    const uint32_t counter = (uint32_t)maplines_get(&layout->counter, arrival.record);
    const uint32_t content = hash_of(arrival.record, arrival.length);
    maplines_check_t *check = &decoder->checks[owner];
    const uint8_t records = is_complete ? arrival.content.count : 1U;
    if (!is_complete || arrival.content.index == 0) // components follow each other at once
    {
        const bool is_short =
            maplines_check_spacing(check, decoder->settings.cycle_ns[owner], arrival.t_ns);
        decoder->statistics.short_spacings += is_short ? 1U : 0U;
    }
    if (decoder->settings.refuses_short_spacings && check->short_spacings >= MAPLINES_SHORT_ROW)
    {
        maplines_check_failed(decoder, owner, arrival.t_ns);
        fed.reason = dropped_record(decoder, MAPLINES_SPACING, arrival.frames);
        return fed;
    }
    fed.reason = maplines_check_received(decoder, owner, counter, content, arrival.t_ns, records);
    if (fed.reason != MAPLINES_COMPLETE)
    {
#if MAPLINES_MIXTURES
        if (fed.reason == MAPLINES_STALE && is_complete)
        {
            maplines_drop_mixture_with(decoder, arrival.owner, counter);
        }
#endif
        (void)dropped_record(decoder, fed.reason, arrival.frames);
        return fed;
    }
    fed.reason = MAPLINES_PENDING;
#if MAPLINES_SCENES
    if (arrival.owner == MAPLINES_POSE)
    {
        feed_pose(decoder, &arrival, &fed, scene);
    }
    else if (decoder->dbc->is_conditional)
    {
        feed_conditional(decoder, &arrival, counter, &fed, scene);
    }
    else
    {
        feed_component(decoder, &arrival, &fed);
    }
#else
    (void)scene;
    feed_component(decoder, &arrival, &fed);
#endif
    return fed;
}

void maplines_expire(maplines_decoder_t *decoder, int64_t t_ns)
{
    const int64_t now_ns = maplines_limited_time(t_ns);
    if (!MAPLINES_REQUIRE(is_initialised(decoder)) || !decoder->is_ready)
    {
        return;
    }
    maplines_expire_transfers(decoder, now_ns);
#if MAPLINES_MIXTURES
    maplines_expire_mixtures(decoder, now_ns);
#endif
#if MAPLINES_SCENES
    if (decoder->dbc->has_pose)
    {
        maplines_expire_epochs(decoder, now_ns);
    }
#endif
}

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

const maplines_line_t *maplines_newest(const maplines_decoder_t *decoder, maplines_owner_t slot)
{
    if (!MAPLINES_REQUIRE(is_initialised(decoder)) ||
        !MAPLINES_REQUIRE((unsigned)slot < MAPLINES_SLOTS))
    {
        return NULL;
    }
    const bool is_known = is_slot(decoder, (int)slot);
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

void maplines_latest(maplines_decoder_t *decoder, maplines_owner_t slot, int64_t now_ns,
                     maplines_view_t *view)
{
    const int64_t t_ns = maplines_limited_time(now_ns);
    if (!MAPLINES_REQUIRE(view != NULL))
    {
        return;
    }
    memset(view, 0, sizeof(*view));
    view->slot = slot;
    view->age = (maplines_real_t)HUGE_VAL;
    view->is_stale = true;
    view->state = MAPLINES_E2E_NODATA;
    view->status = MAPLINES_E2E_NONE;
    if (!MAPLINES_REQUIRE(is_initialised(decoder)) || !decoder->is_ready ||
        !MAPLINES_REQUIRE(is_slot(decoder, (int)slot)))
    {
        return;
    }
    const maplines_line_t *line = maplines_newest(decoder, slot);
    double waited = 0.0;
    if (line != NULL)
    {
        const waited_t since = waited_since(decoder, (int)slot, line->t_ns, t_ns);
        waited = since.waited;
        view->line = line;
        view->age = line->age + (maplines_real_t)waited;
        view->is_stale = since.is_long;
    }
    view->state = state_at(decoder, (int)slot, t_ns, waited, &view->two_senders);
    view->status = decoder->checks[slot].status;
#if MAPLINES_SCENES
    if (decoder->dbc->is_conditional)
    {
        const maplines_e2e_state_t pose_state =
            state_at(decoder, MAPLINES_POSE, t_ns, waited, &view->two_senders);
        view->state = view->state == MAPLINES_E2E_VALID ? pose_state : view->state;
    }
#endif
    view->is_usable = line != NULL && line->status != MAPLINES_OUT_OF_RANGE &&
                      line->age < (maplines_real_t)HUGE_VAL && view->state == MAPLINES_E2E_VALID &&
                      !view->is_stale && !view->two_senders;
}

void maplines_copy_line(maplines_decoder_t *decoder, maplines_owner_t slot, int64_t now_ns,
                        maplines_line_copy_t *copy)
{
    maplines_view_t view;
    if (!MAPLINES_REQUIRE(copy != NULL))
    {
        return;
    }
    memset(copy, 0, sizeof(*copy));
    maplines_latest(decoder, slot, now_ns, &view);
    if (view.line != NULL)
    {
        copy->line = *view.line;
        copy->has_line = true;
    }
    copy->is_stale = view.is_stale;
    copy->two_senders = view.two_senders;
    copy->is_usable = view.is_usable;
    copy->slot = view.slot;
    copy->state = view.state;
    copy->status = view.status;
    copy->age = view.age;
    copy->now_ns = now_ns;
}

#if MAPLINES_SCENES
void maplines_latest_scene(maplines_decoder_t *decoder, int64_t now_ns, maplines_scene_view_t *view)
{
    const int64_t t_ns = maplines_limited_time(now_ns);
    if (!MAPLINES_REQUIRE(view != NULL))
    {
        return;
    }
    memset(view, 0, sizeof(*view));
    view->age = (maplines_real_t)HUGE_VAL;
    view->is_stale = true;
    view->state = MAPLINES_E2E_NODATA;
    view->status = MAPLINES_E2E_NONE;
    if (!MAPLINES_REQUIRE(is_initialised(decoder)) || !decoder->is_ready || !decoder->dbc->has_pose)
    {
        return;
    }
    const maplines_scene_t *scene = maplines_newest_scene(decoder);
    if (scene == NULL)
    {
        view->state = maplines_check_elapse(decoder, MAPLINES_POSE, t_ns);
        view->status = decoder->checks[MAPLINES_POSE].status;
        return;
    }
    const waited_t since = waited_since(decoder, MAPLINES_POSE, scene->t_ns, t_ns);
    view->scene = scene;
    view->is_stale = since.is_long;
    if (!decoder->epochs.is_too_old)
    {
        view->age = scene->age + (maplines_real_t)since.waited;
    }
    view->state = state_at(decoder, MAPLINES_POSE, t_ns, since.waited, &view->two_senders);
    view->status = decoder->checks[MAPLINES_POSE].status;
    bool are_valid = view->state == MAPLINES_E2E_VALID;
    for (unsigned i = 0; i < scene->count; ++i)
    {
        const int slot = (int)scene->lines[i].slot;
        view->slot_states[i] = state_at(decoder, slot, t_ns, since.waited, &view->two_senders);
        are_valid = are_valid && view->slot_states[i] == MAPLINES_E2E_VALID;
    }
    view->is_usable =
        are_valid && view->age < (maplines_real_t)HUGE_VAL && !view->is_stale && !view->two_senders;
}

void maplines_copy_scene(maplines_decoder_t *decoder, int64_t now_ns, maplines_scene_copy_t *copy)
{
    maplines_scene_view_t view;
    if (!MAPLINES_REQUIRE(copy != NULL))
    {
        return;
    }
    memset(copy, 0, sizeof(*copy));
    maplines_latest_scene(decoder, now_ns, &view);
    if (view.scene != NULL)
    {
        copy->scene = *view.scene;
        copy->has_scene = true;
    }
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
    if (!MAPLINES_REQUIRE(is_initialised(decoder)) ||
        !MAPLINES_REQUIRE((unsigned)owner < MAPLINES_OWNERS) || !decoder->is_ready ||
        !decoder->dbc->messages[owner].is_present)
    {
        return false;
    }
    const maplines_check_t *check = &decoder->checks[owner];
    stats->state = maplines_check_elapse(decoder, (int)owner, maplines_limited_time(now_ns));
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
    if (!MAPLINES_REQUIRE(is_initialised(decoder)))
    {
        return;
    }
    *statistics = decoder->statistics;
    statistics->lost = 0;
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        statistics->lost += decoder->checks[slot].lost;
    }
    statistics->pending = maplines_pending_transfers(decoder);
#if MAPLINES_MIXTURES
    statistics->pending += maplines_pending_mixtures(decoder);
#endif
#if MAPLINES_SCENES
    statistics->pending += maplines_pending_lines(decoder);
#endif
}

#endif
