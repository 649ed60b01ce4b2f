/* Assembly of Gaussian mixtures from the records of their components: all of them, or none.
 *
 * The components of a line have the same count, kind, valid range and age, and counters in the
 * order of their indices. If one of these differs, a component belongs to another line.
 */
#include "internal.h"

#if MAPLINES_RECEIVER && MAPLINES_MIXTURES

#define MAX_WEIGHT_ERROR 1e-9
static void drop_incomplete(maplines_decoder_t *decoder, int slot, maplines_reason_t reason)
{
    decoder->statistics.counts[reason] += decoder->incomplete[slot].frames;
    decoder->incomplete[slot].count = 0;
}

static bool is_mixture_old(const maplines_decoder_t *decoder, int slot, int64_t t_ns)
{
    return maplines_distance(t_ns, decoder->incomplete[slot].last_ns) >
           decoder->settings.timeout_ns[slot];
}

/// Counter of the first component of the line of a record.
static uint32_t first_counter(const maplines_decoder_t *decoder, const maplines_complete_t *content)
{
    return (content->counter - content->index) & maplines_counter_mask(&decoder->dbc->line);
}

/// Whether a record may be of the same line as those of a mixture.
static bool is_of_mixture(const maplines_mixture_t *mixture, const maplines_complete_t *content,
                          uint32_t first)
{
    const maplines_line_t *line = &content->line;
    return mixture->first == first && mixture->count == content->count &&
           mixture->kind == line->kind && mixture->x_min == line->x_min &&
           mixture->x_max == line->x_max && mixture->age == line->age;
}

/// Read the i-th component of a mixture again.
static void read_component(const maplines_dbc_t *dbc, int slot, const maplines_mixture_t *mixture,
                           unsigned i, maplines_complete_t *content)
{
    (void)maplines_read_complete(dbc, slot, mixture->records[i], mixture->t_ns[i], content);
}

/// Line of all components of a mixture; false if their weights do not add up to 1.
static bool assemble_line(const maplines_dbc_t *dbc, int slot, const maplines_mixture_t *mixture,
                          maplines_line_t *line)
{
    static const uint8_t order[4] = {0, 1, 2, 3};
    maplines_gaussian_t gaussians[MAPLINES_MAX_COMPONENTS];
    double weights[MAPLINES_MAX_COMPONENTS];
    maplines_complete_t content;
    maplines_line_t earliest;
    maplines_status_t status = MAPLINES_FULL;
    double sum = 0.0;
    memset(&earliest, 0, sizeof(earliest));
    for (unsigned i = 0; i < mixture->count; ++i)
    {
        read_component(dbc, slot, mixture, i, &content);
        gaussians[i] = content.line.gaussian;
        weights[i] = content.weight;
        sum = sum + content.weight;
        if (maplines_severity(content.line.status) > maplines_severity(status))
        {
            status = content.line.status;
        }
        if (i == 0 || content.line.t_ns < earliest.t_ns)
        {
            earliest = content.line;
        }
    }
    if (fabs(sum - 1.0) > MAX_WEIGHT_ERROR)
    {
        return false;
    }
    *line = earliest; // all components have its age, which is relative to t_ns
    line->status = status;
    line->components = mixture->count;
    maplines_mixture_gaussian(mixture->count, weights, gaussians, order, &line->gaussian);
    return true;
}

MAPLINES_INTERNAL maplines_reason_t maplines_add_component(maplines_decoder_t *decoder,
                                                           const maplines_arrival_t *arrival,
                                                           uint32_t *frames)
{
    const maplines_complete_t *content = &arrival->content;
    const int slot = arrival->owner;
    const uint32_t first = first_counter(decoder, content);
    maplines_mixture_t *mixture = &decoder->incomplete[slot];
    *frames = arrival->frames;
    if (mixture->count > 0)
    {
        if (is_mixture_old(decoder, slot, arrival->t_ns))
        {
            drop_incomplete(decoder, slot, MAPLINES_TIMEOUT);
        }
        else if (!is_of_mixture(mixture, content, first))
        {
            drop_incomplete(decoder, slot, MAPLINES_INCOMPLETE);
        }
        else
        {
            // one of its components
        }
    }
    if (content->count == 1)
    {
        decoder->newest[slot] = content->line;
        decoder->mixtures[slot].count = 0;
        return MAPLINES_COMPLETE;
    }
    if (mixture->count == 0)
    {
        mixture->first = first;
        mixture->count = content->count;
        mixture->kind = content->line.kind;
        mixture->x_min = content->line.x_min;
        mixture->x_max = content->line.x_max;
        mixture->age = content->line.age;
        mixture->received = 0;
        mixture->frames = 0;
    }
    const uint64_t bit = (uint64_t)1 << content->index;
    if ((mixture->received & bit) != 0)
    {
        decoder->statistics.counts[MAPLINES_DUPLICATE] += arrival->frames;
        return MAPLINES_DUPLICATE;
    }
    mixture->received |= bit;
    memcpy(mixture->records[content->index], arrival->record, MAPLINES_MAX_RECORD);
    mixture->t_ns[content->index] = arrival->t_ns;
    mixture->frames += arrival->frames;
    mixture->last_ns = arrival->t_ns;
    const uint64_t last = (uint64_t)1 << (content->count - 1U);
    if (mixture->received != (last | (last - 1U)))
    {
        return MAPLINES_PENDING;
    }
    if (!assemble_line(decoder->dbc, slot, mixture, &decoder->newest[slot]))
    {
        drop_incomplete(decoder, slot, MAPLINES_CONTENT);
        return MAPLINES_CONTENT;
    }
    *frames = mixture->frames;
    decoder->mixtures[slot] = *mixture;
    mixture->count = 0;
    return MAPLINES_COMPLETE;
}

MAPLINES_INTERNAL void maplines_drop_mixture(maplines_decoder_t *decoder, int slot)
{
    if (decoder->incomplete[slot].count > 0)
    {
        drop_incomplete(decoder, slot, MAPLINES_INCOMPLETE);
    }
}

MAPLINES_INTERNAL void maplines_drop_mixture_with(maplines_decoder_t *decoder, int slot,
                                                  uint32_t counter)
{
    const maplines_mixture_t *mixture = &decoder->incomplete[slot];
    const uint32_t mask = maplines_counter_mask(&decoder->dbc->line);
    if (((counter - mixture->first) & mask) < mixture->count)
    {
        drop_incomplete(decoder, slot, MAPLINES_INCOMPLETE); // two senders, or out of order
    }
}

MAPLINES_INTERNAL void maplines_expire_mixtures(maplines_decoder_t *decoder, int64_t t_ns)
{
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        if (decoder->incomplete[slot].count > 0 && is_mixture_old(decoder, slot, t_ns))
        {
            drop_incomplete(decoder, slot, MAPLINES_TIMEOUT);
        }
    }
}

MAPLINES_INTERNAL uint32_t maplines_pending_mixtures(const maplines_decoder_t *decoder)
{
    uint32_t pending = 0;
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        const maplines_mixture_t *mixture = &decoder->incomplete[slot];
        pending += mixture->count > 0 ? mixture->frames : 0U;
    }
    return pending;
}

#endif
