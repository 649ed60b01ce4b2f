/* Decoder of received frames: frames in, lines and scenes out, everything else counted. */
#include "internal.h"

#if MAPLINES_RECEIVER

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

MAPLINES_INTERNAL bool maplines_is_decoder(const maplines_decoder_t *decoder)
{
    return decoder != NULL && decoder->magic == MAPLINES_DECODER_MAGIC;
}

MAPLINES_INTERNAL bool maplines_is_slot(const maplines_decoder_t *decoder, int slot)
{
    if (!decoder->is_ready || (unsigned)slot >= MAPLINES_SLOTS)
    {
        return false;
    }
#if MAPLINES_LINE_RECORDS
    return maplines_has_whole_scenes(decoder->dbc) || decoder->dbc->messages[slot].is_present;
#else
    return true;
#endif
}

/// Set all of a decoder but its settings; false, and a receiver for which every frame is FOREIGN,
/// without a DBC.
static bool clear_decoder(maplines_decoder_t *decoder, const maplines_dbc_t *dbc)
{
    memset(decoder, 0, sizeof(*decoder));
    if (!MAPLINES_REQUIRE(dbc != NULL))
    {
        return false;
    }
    decoder->magic = MAPLINES_DECODER_MAGIC;
    decoder->dbc = dbc;
    return true;
}

/// Receive with the settings of a decoder, which are good.
static void start_receiving(maplines_decoder_t *decoder)
{
    decoder->is_ready = true;
    for (int owner = 0; owner < MAPLINES_OWNERS; ++owner)
    {
        if (!decoder->dbc->messages[owner].is_present)
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
#if MAPLINES_SCENES && MAPLINES_LINE_RECORDS
    maplines_epochs_init(&decoder->epochs);
#endif
}

const char *maplines_decoder_init(maplines_decoder_t *decoder, const maplines_dbc_t *dbc,
                                  const maplines_settings_t *settings)
{
    if (!MAPLINES_REQUIRE(decoder != NULL))
    {
        return "decoder must not be NULL";
    }
    maplines_settings_t wanted;
    if (settings != NULL)
    {
        wanted = *settings; // before the decoder is cleared: they may be its own
    }
    if (!clear_decoder(decoder, dbc))
    {
        return "dbc must not be NULL";
    }
    maplines_default_settings(dbc, &decoder->settings);
    if (settings == NULL)
    {
        wanted = decoder->settings;
    }
    const char *problem = maplines_settings_problem(dbc, &wanted);
    if (problem == NULL)
    {
        decoder->settings = wanted;
        start_receiving(decoder);
    }
    return problem;
}

#if MAPLINES_HAS_DEFAULT
void maplines_decoder_init_default(maplines_decoder_t *decoder, const maplines_dbc_t *dbc)
{
    if (MAPLINES_REQUIRE(decoder != NULL) && clear_decoder(decoder, dbc))
    {
        maplines_default_settings(dbc, &decoder->settings);
        start_receiving(decoder);
    }
}
#endif

/* ---- frames ------------------------------------------------------------------------------------
 */

/// Count a line that the records of an owner have completed, which is the newest of its slot.
static void deliver(maplines_decoder_t *decoder, int owner, int slot, maplines_fed_t *fed)
{
    ++decoder->statistics.lines;
#if MAPLINES_LINE_RECORDS
    decoder->has_newest |= (uint32_t)1 << (unsigned)slot;
#if MAPLINES_SCENE_RECORDS
    decoder->brought_by[slot] = (uint8_t)owner;
#endif
#endif
    (void)owner;
    fed->reason = MAPLINES_COMPLETE;
    fed->slots[fed->count] = (maplines_owner_t)slot;
    ++fed->count;
}

#if MAPLINES_LINE_RECORDS
/// Count a line of its own records.
static void deliver_line(maplines_decoder_t *decoder, int slot, uint32_t frames, uint8_t records,
                         maplines_fed_t *fed)
{
    maplines_check_delivered(decoder, slot, records);
    decoder->statistics.line_frames += frames;
    deliver(decoder, slot, slot, fed);
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
        fed->reason = maplines_dropped(decoder, MAPLINES_INCOMPLETE, arrival->frames);
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
    deliver_line(decoder, arrival->owner, frames, content->count, fed);
}

#if MAPLINES_SCENES
/// Deliver the lines of conditional records that have joined one pose error, decoded into `scene`,
/// too, unless it is NULL. What is no function of x is counted instead.
static void feed_joined(maplines_decoder_t *decoder, const maplines_joined_t *joined, int count,
                        maplines_fed_t *fed, maplines_scene_t *scene)
{
    const maplines_epoch_t *epoch = &decoder->epochs.epochs[joined[0].epoch];
    maplines_epoch_view_t view;
    maplines_begin_view(epoch->record, epoch->t_ns, &view);
    for (int i = 0; i < count; ++i)
    {
        const int slot = joined[i].slot;
        const maplines_line_record_t *line = &epoch->lines[slot];
        maplines_add_to_view(slot, line->record, line->t_ns, &view)->line = &decoder->newest[slot];
    }
    const uint32_t found = maplines_decode_epoch(decoder->dbc, &view, scene);
    for (int i = 0; i < count; ++i)
    {
        if ((found >> (unsigned)joined[i].slot & 1U) != 0)
        {
            deliver_line(decoder, joined[i].slot, joined[i].frames, 1, fed);
        }
        else
        {
            fed->reason = maplines_dropped(decoder, MAPLINES_CONTENT, joined[i].frames);
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
#endif

#if MAPLINES_SCENE_RECORDS
/// Take a new record of a whole scene, and deliver its lines.
static void feed_whole(maplines_decoder_t *decoder, const maplines_arrival_t *arrival,
                       maplines_fed_t *fed, maplines_scene_t *scene)
{
    maplines_epoch_view_t lines;
    maplines_check_delivered(decoder, arrival->owner, 1);
    ++decoder->statistics.pose_errors;
    decoder->statistics.pose_frames += arrival->frames;
    maplines_add_whole(decoder, arrival, &lines);
#if MAPLINES_LINE_RECORDS
    decoder->is_built = false;
    for (int i = 0; i < lines.count; ++i)
    {
        lines.lines[i].line = &decoder->newest[lines.lines[i].slot];
    }
    const uint32_t found = maplines_decode_epoch(decoder->dbc, &lines, scene);
#else
    const uint32_t found = UINT32_MAX; // they are decoded when they are asked for
    (void)scene;
#endif
    for (int i = 0; i < lines.count; ++i)
    {
        if ((found >> (unsigned)lines.lines[i].slot & 1U) != 0)
        {
            deliver(decoder, arrival->owner, lines.lines[i].slot, fed);
        }
    }
}
#endif

maplines_fed_t maplines_feed(maplines_decoder_t *decoder, const maplines_frame_t *frame,
                             int64_t t_ns)
{
    maplines_fed_t fed;
    memset(&fed, 0, sizeof(fed));
    fed.reason = MAPLINES_FOREIGN;
    if (!MAPLINES_REQUIRE(maplines_is_decoder(decoder)) || !MAPLINES_REQUIRE(frame != NULL))
    {
        return fed;
    }
    if (!MAPLINES_REQUIRE(frame->can_id <= (frame->is_extended ? MAX_EXTENDED_ID : MAX_ID)))
    {
        ++decoder->statistics.frames;
        (void)maplines_dropped(decoder, MAPLINES_FOREIGN, 1);
        return fed;
    }
    if (!MAPLINES_REQUIRE(frame->length <= sizeof(frame->data)))
    {
        ++decoder->statistics.frames;
        fed.reason = maplines_dropped(decoder, MAPLINES_LENGTH, 1);
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
        fed.reason = maplines_dropped(decoder, MAPLINES_FOREIGN, 1);
        return fed;
    }
    const int64_t now_ns = maplines_limited_time(t_ns);
    fed.reason = maplines_route_frame(decoder, frame, now_ns, &arrival);
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
        fed.reason = maplines_dropped(decoder, arrival.reason, arrival.frames);
        return fed;
    }
#if MAPLINES_LINE_RECORDS
    const bool is_complete = !decoder->dbc->is_conditional && owner < MAPLINES_SLOTS;
    const uint8_t records = is_complete ? arrival.content.count : 1U;
    const bool is_first = !is_complete || arrival.content.index == 0; // others follow at once
#else
    const uint8_t records = 1;
    const bool is_first = true;
#endif
    const maplines_record_t *layout = maplines_layout(decoder->dbc, owner);
    const uint32_t counter = (uint32_t)maplines_get(&layout->counter, arrival.record);
    const uint32_t content = hash_of(arrival.record, arrival.length);
    maplines_check_t *check = &decoder->checks[owner];
    if (is_first)
    {
        const bool is_short =
            maplines_check_spacing(check, decoder->settings.cycle_ns[owner], arrival.t_ns);
        decoder->statistics.short_spacings += is_short ? 1U : 0U;
    }
    if (decoder->settings.refuses_short_spacings && check->short_spacings >= MAPLINES_SHORT_ROW)
    {
        maplines_check_failed(decoder, owner, arrival.t_ns);
        fed.reason = maplines_dropped(decoder, MAPLINES_SPACING, arrival.frames);
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
        (void)maplines_dropped(decoder, fed.reason, arrival.frames);
        return fed;
    }
    fed.reason = MAPLINES_PENDING;
#if MAPLINES_SCENE_RECORDS
    if (MAPLINES_IS_WHOLE(owner))
    {
        feed_whole(decoder, &arrival, &fed, scene);
        return fed;
    }
#endif
#if MAPLINES_LINE_RECORDS
#if MAPLINES_SCENES
    if (maplines_is_pose(owner))
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
#endif
    return fed;
}

#if MAPLINES_LINE_RECORDS
void maplines_expire(maplines_decoder_t *decoder, int64_t t_ns)
{
    const int64_t now_ns = maplines_limited_time(t_ns);
    if (!MAPLINES_REQUIRE(maplines_is_decoder(decoder)) || !decoder->is_ready)
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

#endif

#endif
