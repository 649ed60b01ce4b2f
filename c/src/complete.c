/* Lines from records with a covariance of their own. */
#include "internal.h"

#if MAPLINES_RECEIVER && MAPLINES_LINE_RECORDS

/// Standard deviations of a line whose covariance was not sent.
static const double vague_sigma[4] = {1000.0, 10.0, 10.0, 10.0};

/// Mean and covariance of a record with this status.
static void read_gaussian(const maplines_dbc_t *dbc, const uint8_t *record, int64_t status,
                          maplines_gaussian_t *gaussian)
{
    double mean[4];
    double factor[4][4];
    for (int i = 0; i < 4; ++i)
    {
        mean[i] = maplines_value(&dbc->mean[i], record);
    }
    if (status == (int64_t)MAPLINES_UNKNOWN || status == (int64_t)MAPLINES_OUT_OF_RANGE)
    {
        memset(factor, 0, sizeof factor);
        for (int i = 0; i < 4; ++i)
        {
            factor[dbc->covariance.order[i]][i] = vague_sigma[dbc->covariance.order[i]];
        }
    }
    else
    {
        maplines_decode_factor(&dbc->covariance, record, factor);
    }
    maplines_set_gaussian(mean, factor, dbc->covariance.order, gaussian);
}

MAPLINES_INTERNAL maplines_reason_t maplines_read_complete(const maplines_dbc_t *dbc, int slot,
                                                           const uint8_t *record, int64_t t_ns,
                                                           maplines_complete_t *content)
{
    const int64_t status = maplines_get(&dbc->status, record);
    const int64_t kind = maplines_get(&dbc->kind, record);
    const int64_t raw_age = maplines_get(&dbc->age, record);
    const int64_t index = maplines_get(&dbc->component_index, record);
    const double count = maplines_value(&dbc->component_count, record);
    const double weight = maplines_value(&dbc->component_weight, record); // any bits are a share
    const double x_min = maplines_value(&dbc->x_min, record);
    const double x_max = maplines_value(&dbc->x_max, record);
    if (status > (int64_t)MAPLINES_OUT_OF_RANGE || kind > (int64_t)MAPLINES_VIRTUAL)
    {
        return MAPLINES_CONTENT;
    }
    if ((double)index >= count || count > (double)MAPLINES_MAX_COMPONENTS)
    {
        return MAPLINES_CONTENT;
    }
    if (x_min > x_max && status != (int64_t)MAPLINES_OUT_OF_RANGE)
    {
        return MAPLINES_CONTENT;
    }
    maplines_line_t *line = &content->line;
    const double age = maplines_physical(&dbc->age, raw_age) / 1000.0;
    const bool is_too_old = raw_age >= maplines_raw_max(&dbc->age);
    read_gaussian(dbc, record, status, &line->gaussian);
    line->x_min = (maplines_real_t)(x_max < x_min ? x_max : x_min);
    line->x_max = (maplines_real_t)x_max;
    line->age = is_too_old ? (maplines_real_t)INFINITY : (maplines_real_t)age;
    line->t_ns = t_ns;
    line->slot = (maplines_owner_t)slot;
    line->kind = (maplines_kind_t)kind;
    line->status = (maplines_status_t)status;
    line->components = 1;
    content->index = (uint8_t)index;
    content->count = (uint8_t)count;
    content->weight = weight;
    content->counter = (uint32_t)maplines_get(&dbc->line.counter, record);
    return MAPLINES_COMPLETE;
}

#endif
