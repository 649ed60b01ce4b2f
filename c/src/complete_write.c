/* Records with a covariance of their own, from lines. No value is clipped silently. */
#include "internal.h"

#if MAPLINES_SENDER

#define DIVISION_SLACK 1e-9  // of the division before directed rounding [steps]
#define MIN_STATED_RANGE 1.0 // least length of a range that is sent for a replaced line [m]

static double value_of(const maplines_signal_t *signal, double raw)
{
    const double scaled = raw * signal->scale->factor;
    return scaled + signal->scale->offset;
}

MAPLINES_INTERNAL double maplines_raw_above(const maplines_signal_t *signal, double physical)
{
    const double steps = (physical - signal->scale->offset) / signal->scale->factor;
    const double raw = ceil(steps - DIVISION_SLACK);
    return value_of(signal, raw) < physical ? raw + 1.0 : raw;
}

#if MAPLINES_LINE_RECORDS
static double raw_below(const maplines_signal_t *signal, double physical)
{
    const double steps = (physical - signal->scale->offset) / signal->scale->factor;
    const double raw = floor(steps + DIVISION_SLACK);
    return value_of(signal, raw) > physical ? raw - 1.0 : raw;
}

/// Nearest raw value within the range of a signal.
static int64_t nearest_within(const maplines_signal_t *signal, double physical)
{
    return maplines_limited(signal, maplines_nearest_raw(signal, physical));
}

/// Ends of a valid range, rounded inwards.
static void state_range(const maplines_dbc_t *dbc, const double x_range[2],
                        maplines_stated_t *stated)
{
    const double low = maplines_raw_above(&dbc->x_min, x_range[0]);
    const double high = raw_below(&dbc->x_max, x_range[1]);
    stated->ends[0] = maplines_limited(&dbc->x_min, low);
    stated->ends[1] = maplines_limited(&dbc->x_max, high);
    const double start = maplines_physical(&dbc->x_min, stated->ends[0]);
    const double end = maplines_physical(&dbc->x_max, stated->ends[1]);
    stated->is_outside = start < x_range[0] || start > end || end > x_range[1];
    stated->is_cut = (double)stated->ends[0] < low || (double)stated->ends[0] > low ||
                     (double)stated->ends[1] < high || (double)stated->ends[1] > high;
}

/// Send the nearest line within the message in the part of the range where it is near, if enough of
/// that can be stated.
static void replace_line(const maplines_dbc_t *dbc, const double mean[4], const double x_range[2],
                         maplines_stated_t *stated)
{
    double near[4];
    double near_range[2];
    double reach[4];
    maplines_stated_t shorter = *stated;
    for (int i = 0; i < 4; ++i)
    {
        reach[i] = sqrt(dbc->covariance.reachable[i]);
    }
    if (!maplines_nearest_line(dbc->mean, mean, x_range, MIN_STATED_RANGE, reach, near, near_range))
    {
        return;
    }
    state_range(dbc, near_range, &shorter);
    const double length = maplines_physical(&dbc->x_max, shorter.ends[1]) -
                          maplines_physical(&dbc->x_min, shorter.ends[0]);
    if (!shorter.is_outside && length >= MIN_STATED_RANGE)
    {
        for (int i = 0; i < 4; ++i)
        {
            shorter.mean[i] = nearest_within(&dbc->mean[i], near[i]);
        }
        *stated = shorter;
    }
}

MAPLINES_INTERNAL void maplines_state_line(const maplines_dbc_t *dbc, const double mean[4],
                                           const double x_range[2], bool is_replaced,
                                           maplines_stated_t *stated)
{
    stated->is_clipped = false;
    for (int i = 0; i < 4; ++i)
    {
        const double raw = maplines_nearest_raw(&dbc->mean[i], mean[i]);
        stated->mean[i] = maplines_limited(&dbc->mean[i], raw);
        const double limited = (double)stated->mean[i];
        stated->is_clipped = stated->is_clipped || limited < raw || limited > raw;
    }
    state_range(dbc, x_range, stated);
    if (is_replaced && stated->is_clipped && x_range[0] < x_range[1])
    {
        replace_line(dbc, mean, x_range, stated);
    }
}

/// What the decoded covariance must cover: the mean square error about the decoded mean.
static void target_of(const maplines_draft_t *draft, const double decoded[4], bool is_clipped,
                      double error[16])
{
    const double *cov = draft->cov;
    double d[4];
    for (int i = 0; i < 4; ++i)
    {
        d[i] = draft->mean[i] - decoded[i];
    }
    for (int i = 0; i < 16; ++i)
    {
        const double square = d[i / 4] * d[i % 4];
        error[i] = cov[i] + square;
    }
    if (draft->is_indefinite)
    {
        double nearest[16];
        maplines_nearest_covariance(cov, nearest);
        for (int i = 0; i < 16; ++i)
        {
            error[i] = error[i] + (nearest[i] - cov[i]);
        }
    }
    if (draft->line->status == MAPLINES_DIAGONAL)
    {
        for (int i = 0; i < 16; ++i)
        {
            error[i] = error[i] + ((i % 5 == 0 ? cov[i] : 0.0) - cov[i]);
        }
    }
    if (is_clipped)
    {
        // The first-order sigma of the lateral position has to cover the difference of the
        // tangents, which grows faster than that of the angles.
        const double d_beta = maplines_slope_error(draft->mean[1], decoded[1]);
        const double more = d_beta * d_beta - d[1] * d[1];
        error[5] = error[5] + (more > 0.0 ? more : 0.0);
    }
    for (int i = 0; i < 16; ++i)
    {
        error[i] = error[i] + draft->cover[i];
    }
}

/// Raw covariance and status of a line with a covariance.
static maplines_status_t encode_error(const maplines_dbc_t *dbc, const maplines_draft_t *draft,
                                      const double decoded[4], bool is_clipped, int64_t raw[11])
{
    const maplines_status_t requested = draft->line->status;
    double error[16];
    double resolution[4];
    bool is_saturated;
    for (int i = 0; i < 4; ++i)
    {
        resolution[i] = dbc->mean[i].scale->factor * dbc->mean[i].scale->factor / 12.0;
    }
    target_of(draft, decoded, is_clipped, error);
    if (!maplines_encode_covariance(&dbc->covariance, draft->powers, error, resolution, raw,
                                    &is_saturated))
    {
        return MAPLINES_OUT_OF_RANGE;
    }
    // Most repaired matrices also saturate; REPAIRED takes precedence: it is more informative.
    if (draft->is_indefinite && requested != MAPLINES_DIAGONAL)
    {
        return MAPLINES_REPAIRED;
    }
    return requested == MAPLINES_FULL && (is_clipped || is_saturated) ? MAPLINES_SATURATED
                                                                      : requested;
}

/// Status of a line without a covariance: nothing makes up for a mean that is clipped.
static maplines_status_t status_of_mean(const maplines_dbc_t *dbc, const maplines_draft_t *draft,
                                        const double decoded[4])
{
    maplines_status_t status = draft->line->status;
    for (int i = 0; i < 4; ++i)
    {
        if (fabs(draft->mean[i] - decoded[i]) > 0.51 * fabs(dbc->mean[i].scale->factor))
        {
            status = MAPLINES_OUT_OF_RANGE;
        }
    }
    return status;
}

MAPLINES_INTERNAL maplines_status_t maplines_write_complete(const maplines_dbc_t *dbc,
                                                            const maplines_draft_t *draft,
                                                            uint8_t *record)
{
    const maplines_input_t *line = draft->line;
    const double x_range[2] = {line->x_min, line->x_max};
    maplines_stated_t stated;
    maplines_status_t status;
    double decoded[4];
    int64_t raw[11];
    maplines_state_line(dbc, draft->mean, x_range,
                        line->status == MAPLINES_FULL && draft->count == 1, &stated);
    for (int i = 0; i < 4; ++i)
    {
        decoded[i] = maplines_physical(&dbc->mean[i], stated.mean[i]);
        maplines_put(&dbc->mean[i], record, stated.mean[i]);
    }
    if (line->status == MAPLINES_UNKNOWN || line->status == MAPLINES_OUT_OF_RANGE)
    {
        maplines_widest_covariance(&dbc->covariance, raw);
        status = status_of_mean(dbc, draft, decoded);
    }
    else
    {
        status = encode_error(dbc, draft, decoded, stated.is_clipped, raw);
    }
    status = stated.is_outside ? MAPLINES_OUT_OF_RANGE : status;
    maplines_put_covariance(&dbc->covariance, record, raw);
    maplines_put(&dbc->x_min, record, stated.ends[0]);
    maplines_put(&dbc->x_max, record, stated.ends[1]);
    maplines_put(&dbc->status, record, (int64_t)status);
    maplines_put(&dbc->kind, record, (int64_t)line->kind);
    const double age = line->has_age ? line->age : (double)INFINITY;
    maplines_put(&dbc->age, record,
                 maplines_limited(&dbc->age, maplines_raw_above(&dbc->age, 1000.0 * age)));
    maplines_put(&dbc->component_index, record,
                 nearest_within(&dbc->component_index, (double)draft->index));
    maplines_put(&dbc->component_count, record,
                 nearest_within(&dbc->component_count, (double)draft->count));
    maplines_put(&dbc->component_weight, record,
                 nearest_within(&dbc->component_weight, draft->weight));
    return status;
}

#endif

#endif
