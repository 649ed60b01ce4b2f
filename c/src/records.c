/* Page numbers, transfer IDs and checksum of a record. */
#include "internal.h"

MAPLINES_INTERNAL const maplines_record_t *maplines_layout(const maplines_dbc_t *dbc, int owner)
{
#if MAPLINES_SCENES && MAPLINES_LINE_RECORDS
    return owner < (int)MAPLINES_POSE ? &dbc->line : &dbc->pose;
#elif MAPLINES_SCENES
    (void)owner;
    return &dbc->pose;
#else
    (void)owner;
    return &dbc->line;
#endif
}

MAPLINES_INTERNAL bool maplines_is_pose(int owner)
{
#if MAPLINES_SCENES && MAPLINES_LINE_RECORDS
    return owner == (int)MAPLINES_POSE;
#else
    (void)owner;
    return false;
#endif
}

MAPLINES_INTERNAL bool maplines_has_whole_scenes(const maplines_dbc_t *dbc)
{
#if MAPLINES_SCENE_RECORDS && MAPLINES_LINE_RECORDS
    return dbc->scene.places > 0U;
#else
    (void)dbc;
    return MAPLINES_SCENE_RECORDS;
#endif
}

MAPLINES_INTERNAL uint32_t maplines_counter_mask(const maplines_record_t *layout)
{
    return UINT32_MAX >> (32U - layout->counter.length);
}

MAPLINES_INTERNAL uint32_t maplines_next_counter(const maplines_dbc_t *dbc, int owner,
                                                 uint32_t counter)
{
    return (counter + 1U) & maplines_counter_mask(maplines_layout(dbc, owner));
}

MAPLINES_INTERNAL int maplines_severity(maplines_status_t status)
{
    // UNKNOWN, FULL, DIAGONAL, REPAIRED, SATURATED, OUT_OF_RANGE
    static const int order[6] = {4, 0, 3, 1, 2, 5};
    return order[status];
}

#if MAPLINES_RECEIVER
/// Checksum in a record.
static unsigned received_crc(const maplines_record_t *layout, const uint8_t *record)
{
    return (unsigned)record[layout->crc_byte] | (unsigned)record[layout->crc_byte + 1U] << 8U;
}

#if MAPLINES_LINE_RECORDS
/// Number of pages of a record, by its content.
static unsigned pages_of_content(const maplines_dbc_t *dbc, int owner, const uint8_t *record)
{
    const maplines_record_t *layout = maplines_layout(dbc, owner);
#if MAPLINES_SCENES
    if (owner != (int)MAPLINES_POSE && dbc->is_conditional &&
        maplines_get(&dbc->has_covariance, record) == 0)
    {
        return layout->short_pages;
    }
#else
    (void)record;
#endif
    return layout->pages;
}

MAPLINES_INTERNAL maplines_reason_t maplines_check_record(const maplines_dbc_t *dbc, int owner,
                                                          const uint8_t *record, size_t length)
{
    const maplines_record_t *layout = maplines_layout(dbc, owner);
    const size_t pages = length / 8U;
    if (length % 8U != 0U || (pages != layout->pages && pages != layout->short_pages))
    {
        return MAPLINES_LENGTH;
    }
    const int64_t counter = maplines_get(&layout->counter, record);
    const int64_t modulus = (int64_t)1 << layout->transfer_id[0].length;
    for (size_t page = 0; page < pages; ++page)
    {
        const uint8_t *data = record + 8U * page;
        const maplines_signal_t *transfer_id = &layout->transfer_id[page == 0U ? 0 : 1];
        if (maplines_get(&layout->page, data) != (int64_t)page ||
            maplines_get(transfer_id, data) != counter % modulus)
        {
            return MAPLINES_MIXED;
        }
    }
    const uint16_t crc =
        maplines_crc(record, length, layout->crc_byte, dbc->messages[owner].data_id);
    if (received_crc(layout, record) != crc)
    {
        return MAPLINES_CRC;
    }
    return pages_of_content(dbc, owner, record) == pages ? MAPLINES_COMPLETE : MAPLINES_LENGTH;
}

#if MAPLINES_SCENES
MAPLINES_INTERNAL maplines_reason_t maplines_check_conditional(const maplines_dbc_t *dbc,
                                                               const uint8_t *record)
{
    const maplines_levels_t *levels = &dbc->levels;
    const double x_min = maplines_value(&dbc->x_min, record);
    const double x_max = maplines_value(&dbc->x_max, record);
    if (maplines_get(&dbc->kind, record) > (int64_t)MAPLINES_VIRTUAL || x_min >= x_max)
    {
        return MAPLINES_CONTENT;
    }
    // A record has either a covariance or levels.
    const bool has_levels = maplines_get(&levels->lateral, record) != 0 ||
                            maplines_get(&levels->points, record) != 0 ||
                            maplines_get(&levels->shape, record) != 0;
    if (has_levels && maplines_get(&dbc->has_covariance, record) != 0)
    {
        return MAPLINES_CONTENT;
    }
    return MAPLINES_COMPLETE;
}
#endif
#endif

MAPLINES_INTERNAL maplines_reason_t maplines_read_record(const maplines_dbc_t *dbc,
                                                         maplines_arrival_t *arrival)
{
    const int owner = arrival->owner;
#if MAPLINES_SCENE_RECORDS
    if (MAPLINES_IS_WHOLE(owner))
    {
        const maplines_record_t *layout = &dbc->pose;
        const uint16_t crc = maplines_crc(arrival->record, arrival->length, layout->crc_byte,
                                          dbc->messages[owner].data_id);
        return received_crc(layout, arrival->record) == crc ? maplines_check_whole(dbc, arrival)
                                                            : MAPLINES_CRC;
    }
#endif
#if MAPLINES_LINE_RECORDS
    const maplines_reason_t reason =
        maplines_check_record(dbc, owner, arrival->record, arrival->length);
    if (reason != MAPLINES_COMPLETE || maplines_is_pose(owner))
    {
        return reason;
    }
#if MAPLINES_SCENES
    if (dbc->is_conditional)
    {
        return maplines_check_conditional(dbc, arrival->record);
    }
#endif
    return maplines_read_complete(dbc, owner, arrival->record, arrival->t_ns, &arrival->content);
#else
    return MAPLINES_COMPLETE;
#endif
}
#endif

#if MAPLINES_SENDER
MAPLINES_INTERNAL void maplines_seal(const maplines_dbc_t *dbc, int owner, uint8_t *record,
                                     size_t length, uint32_t counter)
{
    const maplines_record_t *layout = maplines_layout(dbc, owner);
    maplines_put(&layout->counter, record, (int64_t)counter);
    for (size_t page = 0; page < length / 8U; ++page)
    {
        uint8_t *data = record + 8U * page;
        maplines_put(&layout->page, data, (int64_t)page);
        maplines_put(&layout->transfer_id[page == 0U ? 0 : 1], data, (int64_t)counter);
    }
    const uint16_t crc =
        maplines_crc(record, length, layout->crc_byte, dbc->messages[owner].data_id);
    record[layout->crc_byte] = (uint8_t)(crc & 0xFFU);
    record[layout->crc_byte + 1U] = (uint8_t)(crc >> 8U);
}
#endif
