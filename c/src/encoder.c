/* A sender: lines and mixtures to frames, with the counters of each slot. */
#include "internal.h"

#if MAPLINES_SENDER

#define WEIGHT_TOLERANCE 1e-5 // of the sum of weights

/// There is none, or it can sign.
static bool is_signer(const maplines_signer_t *signer)
{
    return signer == NULL || (signer->mac != NULL && signer->last_us >= 0);
}

MAPLINES_INTERNAL bool maplines_is_sender(const maplines_encoder_t *encoder)
{
    return encoder != NULL && encoder->magic == MAPLINES_ENCODER_MAGIC &&
           is_signer(encoder->signer);
}

void maplines_encoder_init(maplines_encoder_t *encoder, const maplines_dbc_t *dbc,
                           maplines_signer_t *signer)
{
    if (!MAPLINES_REQUIRE(encoder != NULL))
    {
        return;
    }
    memset(encoder, 0, sizeof *encoder);
    if (!MAPLINES_REQUIRE(dbc != NULL) || !MAPLINES_REQUIRE(is_signer(signer)))
    {
        return;
    }
    encoder->magic = MAPLINES_ENCODER_MAGIC;
    encoder->dbc = dbc;
    encoder->signer = signer;
}

MAPLINES_INTERNAL bool maplines_can_send(const maplines_encoder_t *encoder, int owner, bool is_fd)
{
    const maplines_messages_t *messages = &encoder->dbc->messages[owner];
    if (!messages->is_present)
    {
        return false;
    }
    if (encoder->signer != NULL)
    {
        return MAPLINES_SECOC && is_fd && messages->has_secured;
    }
    return is_fd ? messages->has_fd : messages->has_classic;
}

MAPLINES_INTERNAL size_t maplines_frames(const maplines_encoder_t *encoder, int owner,
                                         const uint8_t *record, size_t length, bool is_fd,
                                         int64_t now_us, maplines_frame_t *frames)
{
    const maplines_messages_t *messages = &encoder->dbc->messages[owner];
#if MAPLINES_SECOC
    if (encoder->signer != NULL)
    {
        memset(frames, 0, sizeof *frames);
        frames->can_id = messages->secured_can_id;
        frames->is_extended = messages->secured_is_extended;
        frames->is_fd = true;
        frames->length = (uint8_t)maplines_secured_pdu(maplines_layout(encoder->dbc, owner),
                                                       messages->secured_data_id, record, length,
                                                       now_us, encoder->signer, frames->data);
        return frames->length > 0U ? 1U : 0U;
    }
#else
    (void)now_us;
#endif
    if (is_fd)
    {
        memset(frames, 0, sizeof *frames);
        frames->can_id = messages->fd_can_id;
        frames->is_extended = messages->fd_is_extended;
        frames->is_fd = true;
        frames->length = messages->fd_length;
        memcpy(frames->data, record, length);
        return 1;
    }
    for (size_t page = 0; page < length / 8U; ++page)
    {
        maplines_frame_t *frame = &frames[page];
        memset(frame, 0, sizeof *frame);
        frame->can_id = messages->can_id;
        frame->is_extended = messages->is_extended;
        frame->length = 8;
        memcpy(frame->data, record + 8U * page, 8);
    }
    return length / 8U;
}

MAPLINES_INTERNAL maplines_refusal_t maplines_check_input(const maplines_input_t *line)
{
    const bool is_finite =
        fabs(line->x_min) < (double)INFINITY && fabs(line->x_max) < (double)INFINITY;
    if ((unsigned)line->kind > (unsigned)MAPLINES_VIRTUAL)
    {
        return MAPLINES_BAD_KIND;
    }
    if ((unsigned)line->status > (unsigned)MAPLINES_OUT_OF_RANGE)
    {
        return MAPLINES_BAD_STATUS;
    }
    if (!is_finite || line->x_min > line->x_max)
    {
        return MAPLINES_BAD_RANGE;
    }
    return !line->has_age || line->age >= 0.0 ? MAPLINES_SENT : MAPLINES_BAD_AGE;
}

#if MAPLINES_LINE_RECORDS
/// Whether a covariance is sent with this status.
static bool has_covariance(maplines_status_t status)
{
    return status != MAPLINES_UNKNOWN && status != MAPLINES_OUT_OF_RANGE;
}

/// MAPLINES_SENT, or what is wrong with a Gaussian.
static maplines_refusal_t check_gaussian(const double mean[4], const double cov[4][4],
                                         maplines_status_t status)
{
    for (int i = 0; i < 4; ++i)
    {
        if (!(fabs(mean[i]) < (double)INFINITY))
        {
            return MAPLINES_BAD_MEAN;
        }
    }
    return has_covariance(status) ? maplines_check_covariance(cov[0], MAPLINES_COVARIANCE_ROUNDING)
                                  : MAPLINES_SENT;
}

/// Draft of a record of a line with a Gaussian that was checked.
static void draft_record(const maplines_input_t *line, const double mean[4], const double cov[4][4],
                         maplines_draft_t *draft)
{
    memset(draft, 0, sizeof *draft);
    draft->line = line;
    draft->mean = mean;
    draft->count = 1;
    draft->weight = 1.0;
    if (has_covariance(line->status))
    {
        memcpy(draft->cov, cov[0], sizeof draft->cov);
        maplines_symmetric(4, draft->cov);
        draft->is_indefinite = maplines_is_indefinite(draft->cov, MAPLINES_COVARIANCE_ROUNDING);
    }
}

/// Frames of a record, whose counter is the next one of its slot; 0 if it was not signed.
static size_t send_record(maplines_encoder_t *encoder, const maplines_draft_t *draft, bool is_fd,
                          int64_t now_us, maplines_frame_t *frames, maplines_status_t *status)
{
    const int slot = (int)draft->line->slot;
    const size_t length = 8U * (size_t)encoder->dbc->line.pages;
    uint8_t record[MAPLINES_MAX_RECORD] = {0};
    *status = maplines_write_complete(encoder->dbc, draft, record);
    maplines_seal(encoder->dbc, slot, record, length, encoder->counter[slot]);
    const size_t count = maplines_frames(encoder, slot, record, length, is_fd, now_us, frames);
    if (count > 0U)
    {
        encoder->counter[slot] = maplines_next_counter(encoder->dbc, slot, encoder->counter[slot]);
    }
    return count;
}

/// MAPLINES_SENT, or why no line of a slot can be sent.
static maplines_refusal_t check_line(const maplines_encoder_t *encoder,
                                     const maplines_input_t *line, bool is_fd)
{
    if (encoder->dbc->is_conditional)
    {
        return MAPLINES_NO_COVARIANCE;
    }
    if ((unsigned)line->slot >= MAPLINES_SLOTS ||
        !maplines_can_send(encoder, (int)line->slot, is_fd))
    {
        return MAPLINES_NO_MESSAGE;
    }
    return maplines_check_input(line);
}

static maplines_sent_t refused(maplines_refusal_t refusal)
{
    const maplines_sent_t sent = {refusal, MAPLINES_OUT_OF_RANGE, 0};
    return sent;
}

maplines_sent_t maplines_encode_line(maplines_encoder_t *encoder, const maplines_input_t *line,
                                     bool is_fd, int64_t now_us, maplines_frame_t *frames)
{
    maplines_draft_t draft;
    maplines_sent_t sent = {MAPLINES_SENT, MAPLINES_OUT_OF_RANGE, 0};
    if (!MAPLINES_REQUIRE(maplines_is_sender(encoder)) || !MAPLINES_REQUIRE(line != NULL) ||
        !MAPLINES_REQUIRE(frames != NULL))
    {
        return refused(MAPLINES_BAD_CALL);
    }
    maplines_refusal_t refusal = check_line(encoder, line, is_fd);
    if (refusal == MAPLINES_SENT)
    {
        refusal = check_gaussian(line->mean, line->cov, line->status);
    }
    if (refusal != MAPLINES_SENT)
    {
        return refused(refusal);
    }
    draft_record(line, line->mean, line->cov, &draft);
    sent.count = (uint16_t)send_record(encoder, &draft, is_fd, now_us, frames, &sent.status);
    return sent.count > 0U ? sent : refused(MAPLINES_NO_SIGNATURE);
}

#if MAPLINES_MIXTURES
/// MAPLINES_SENT, or what is wrong with the components of a mixture.
static maplines_refusal_t check_components(const maplines_encoder_t *encoder,
                                           const maplines_input_t *line,
                                           const maplines_component_t *components, size_t count)
{
    double total = 0.0;
    bool is_positive = true;
    if (count < 1U || count > encoder->dbc->max_components)
    {
        return MAPLINES_BAD_COUNT;
    }
    for (size_t i = 0; i < count; ++i)
    {
        const double weight = components[i].weight;
        is_positive = is_positive && weight > 0.0 && weight < 2.0;
        total = total + weight;
    }
    if (!is_positive || fabs(total - 1.0) > WEIGHT_TOLERANCE)
    {
        return MAPLINES_BAD_WEIGHTS;
    }
    for (size_t i = 0; i < count; ++i)
    {
        const maplines_refusal_t refusal =
            check_gaussian(components[i].mean, components[i].cov, line->status);
        if (refusal != MAPLINES_SENT)
        {
            return refusal;
        }
    }
    return MAPLINES_SENT;
}

MAPLINES_INTERNAL void maplines_cover_mixture(const maplines_dbc_t *dbc,
                                              const maplines_component_t *components, int count,
                                              double *decoded_weights, double cover[16])
{
    double weights[MAPLINES_MAX_COMPONENTS];
    double means[MAPLINES_MAX_COMPONENTS][4];
    double covs[MAPLINES_MAX_COMPONENTS][16];
    double decoded_means[MAPLINES_MAX_COMPONENTS][4];
    const int64_t steps = (int64_t)1 << dbc->component_weight.length;
    for (int k = 0; k < count; ++k)
    {
        weights[k] = components[k].weight;
        memcpy(covs[k], components[k].cov, sizeof covs[k]);
        maplines_symmetric(4, covs[k]);
        for (int i = 0; i < 4; ++i)
        {
            const maplines_signal_t *signal = &dbc->mean[i];
            const double raw = maplines_nearest_raw(signal, components[k].mean[i]);
            means[k][i] = components[k].mean[i];
            decoded_means[k][i] = maplines_physical(signal, maplines_limited(signal, raw));
        }
    }
    maplines_quantize_weights(count, weights, steps, decoded_weights);
    maplines_deficit(count, weights, means, covs, decoded_weights, decoded_means, cover);
}

maplines_sent_t maplines_encode_mixture(maplines_encoder_t *encoder, const maplines_input_t *line,
                                        const maplines_component_t *components, size_t count,
                                        bool is_fd, int64_t now_us, maplines_frame_t *frames)
{
    double weights[MAPLINES_MAX_COMPONENTS];
    double cover[16];
    maplines_sent_t sent = {MAPLINES_SENT, MAPLINES_FULL, 0};
    if (!MAPLINES_REQUIRE(maplines_is_sender(encoder)) || !MAPLINES_REQUIRE(line != NULL) ||
        !MAPLINES_REQUIRE(components != NULL) || !MAPLINES_REQUIRE(frames != NULL))
    {
        return refused(MAPLINES_BAD_CALL);
    }
    maplines_refusal_t refusal = check_line(encoder, line, is_fd);
    if (refusal == MAPLINES_SENT)
    {
        refusal = check_components(encoder, line, components, count);
    }
    if (refusal != MAPLINES_SENT)
    {
        return refused(refusal);
    }
    const uint32_t first = encoder->counter[line->slot];
    maplines_cover_mixture(encoder->dbc, components, (int)count, weights, cover);
    for (size_t i = 0; i < count; ++i)
    {
        maplines_draft_t draft;
        maplines_status_t status;
        draft_record(line, components[i].mean, components[i].cov, &draft);
        memcpy(draft.cover, cover, sizeof cover);
        draft.index = (int)i;
        draft.count = (int)count;
        draft.weight = weights[i];
        const size_t sent_now =
            send_record(encoder, &draft, is_fd, now_us, frames + sent.count, &status);
        if (sent_now == 0U)
        {
            encoder->counter[line->slot] = first;
            return refused(MAPLINES_NO_SIGNATURE);
        }
        sent.count = (uint16_t)(sent.count + sent_now);
        sent.status =
            maplines_severity(status) > maplines_severity(sent.status) ? status : sent.status;
    }
    return sent;
}

#endif

#endif // MAPLINES_LINE_RECORDS

#endif
