/* Routing of frames: whose records a message carries and how, and records that are one frame. */
#include "internal.h"

#if MAPLINES_RECEIVER

#define PAGE_BYTES 8U

MAPLINES_INTERNAL MAPLINES_APART maplines_reason_t maplines_dropped(maplines_decoder_t *decoder,
                                                                    maplines_reason_t reason,
                                                                    uint32_t frames)
{
    decoder->statistics.counts[reason] += frames;
    return reason;
}

/// Bytes of the longest record of an owner.
static uint32_t record_bytes(const maplines_dbc_t *dbc, int owner)
{
    const uint32_t of_pages = maplines_layout(dbc, owner)->pages * PAGE_BYTES;
    const uint32_t of_frame = dbc->messages[owner].fd_length;
    return MAPLINES_IS_WHOLE(owner) ? of_frame : of_pages;
}

/// Take the record at the beginning of a payload that has room for the longest one. One that is
/// authenticated may have a whole scene of fewer places, which ends before the key ID.
static maplines_reason_t feed_record(maplines_decoder_t *decoder, const uint8_t *data,
                                     bool is_secured, int64_t t_ns, maplines_arrival_t *arrival)
{
    const maplines_dbc_t *dbc = decoder->dbc;
    arrival->t_ns = t_ns;
    arrival->frames = 1;
    arrival->length = record_bytes(dbc, arrival->owner);
#if MAPLINES_SCENE_RECORDS
    if (MAPLINES_IS_WHOLE(arrival->owner))
    {
        arrival->places = dbc->scene.places;
        if (is_secured)
        {
            arrival->places = dbc->scene.secured_places;
            arrival->length = dbc->pose.fd_authentic - 1U;
        }
        memcpy(arrival->record, data, arrival->length);
        arrival->reason = maplines_read_record(dbc, arrival);
        return MAPLINES_COMPLETE;
    }
#else
    (void)is_secured;
#endif
#if MAPLINES_LINE_RECORDS
#if MAPLINES_SCENES
    const maplines_record_t *layout = maplines_layout(dbc, arrival->owner);
    if (layout->short_pages < layout->pages && maplines_get(&dbc->has_covariance, data) == 0)
    {
        arrival->length = layout->short_pages * PAGE_BYTES;
    }
#endif
    memcpy(arrival->record, data, arrival->length);
    maplines_complete_record(decoder, arrival);
#endif
    return MAPLINES_COMPLETE;
}

/// How a message carries records.
typedef enum {
    ROUTE_NONE,
    ROUTE_PAGES,
    ROUTE_WHOLE,
    ROUTE_SECURED,
} route_t;

static route_t route_of(const maplines_messages_t *messages, const maplines_frame_t *frame)
{
    const uint32_t id = frame->can_id;
    const bool is_extended = frame->is_extended;
    if (!messages->is_present)
    {
        return ROUTE_NONE;
    }
    if (messages->has_classic && messages->can_id == id && messages->is_extended == is_extended)
    {
        return ROUTE_PAGES;
    }
    if (messages->has_fd && messages->fd_can_id == id && messages->fd_is_extended == is_extended)
    {
        return ROUTE_WHOLE;
    }
    if (messages->has_secured && messages->secured_can_id == id &&
        messages->secured_is_extended == is_extended)
    {
        return ROUTE_SECURED;
    }
    return ROUTE_NONE;
}

#if MAPLINES_SECOC
/// Check an authenticated frame, and take its record.
static maplines_reason_t feed_secured(maplines_decoder_t *decoder, const maplines_frame_t *frame,
                                      int64_t t_ns, maplines_arrival_t *arrival)
{
    const int owner = arrival->owner;
    const maplines_authenticator_t *authenticator = decoder->settings.authenticator;
    if (authenticator == NULL)
    {
        return maplines_dropped(decoder, MAPLINES_KEY, 1);
    }
    const maplines_reason_t reason =
        maplines_verify(decoder->dbc, owner, authenticator, frame, &decoder->freshness_us[owner]);
    if (reason != MAPLINES_COMPLETE)
    {
        return maplines_dropped(decoder, reason, 1);
    }
    return feed_record(decoder, frame->data, true, t_ns, arrival);
}
#endif

MAPLINES_INTERNAL maplines_reason_t maplines_route_frame(maplines_decoder_t *decoder,
                                                         const maplines_frame_t *frame,
                                                         int64_t t_ns, maplines_arrival_t *arrival)
{
    const maplines_dbc_t *dbc = decoder->dbc;
    route_t route = ROUTE_NONE;
    for (int owner = 0; owner < MAPLINES_OWNERS && route == ROUTE_NONE; ++owner)
    {
        route = route_of(&dbc->messages[owner], frame);
        arrival->owner = owner;
    }
    if (route == ROUTE_NONE)
    {
        return maplines_dropped(decoder, MAPLINES_FOREIGN, 1);
    }
#if MAPLINES_SECOC
    if (route == ROUTE_SECURED)
    {
        return feed_secured(decoder, frame, t_ns, arrival);
    }
    if (decoder->settings.authenticator != NULL &&
        maplines_layout(dbc, arrival->owner)->fd_authentic > 0)
    {
        return maplines_dropped(decoder, MAPLINES_UNAUTHENTICATED, 1);
    }
#else
    if (route == ROUTE_SECURED)
    {
        return maplines_dropped(decoder, MAPLINES_KEY, 1);
    }
#endif
    if (route == ROUTE_WHOLE)
    {
        if (frame->length < record_bytes(dbc, arrival->owner) ||
            frame->length > sizeof(frame->data))
        {
            return maplines_dropped(decoder, MAPLINES_LENGTH, 1);
        }
        return feed_record(decoder, frame->data, false, t_ns, arrival);
    }
#if MAPLINES_LINE_RECORDS
    if (frame->length == PAGE_BYTES)
    {
        return maplines_add_page(decoder, frame->data, t_ns, arrival);
    }
#endif
    return maplines_dropped(decoder, MAPLINES_LENGTH, 1);
}

#endif
