/* Reassembly of records from frames: all pages of one transfer, or nothing.
 *
 * Pages are collected by transfer ID, each transfer by itself, until it is complete or times out.
 * Pages of a good record are remembered for one time-out; identical pages within it are duplicates:
 *
 *     page   0 1   2       0 1   3       2       0 1 2 3
 *     ID     7 7   7       8 8   7       8       7 7 7 7
 *     -----------------------------------------------------> time
 *            transfer 7 is complete: |           duplicates
 *            transfer 8 waits for page 3; it is dropped after the time-out
 *
 * A build may remember fewer transfers than there are IDs. Each then has its place at its ID modulo
 * their number, so it is the last ones that are remembered; one that is older is dropped.
 *
 * A transfer ID is used again after as many records as there are IDs. Of two transfers with one ID,
 * that with the newer counter is kept; and when a good record is complete, an incomplete transfer
 * whose ID is ahead of it by up to half of the IDs, but which began before, is of the last round:
 *
 *     ID     7 7   8 8 8 8  9 9 9 9  ...  15 15 15 15            7 7 7 7
 *     -----------------------------------------------------> time
 *            transfer 7 lost two pages    |
 *                                         it is 8 ahead of 15, but older: dropped
 */
#include "internal.h"

#if MAPLINES_RECEIVER && MAPLINES_LINE_RECORDS

#define PAGE_BYTES 8U

static uint32_t transfer_ids(const maplines_record_t *layout)
{
    return (uint32_t)1 << layout->transfer_id[0].length;
}

/// Transfers that are remembered.
static uint32_t places_of(uint32_t ids)
{
    return ids < MAPLINES_TRANSFERS ? ids : MAPLINES_TRANSFERS;
}

static uint32_t pages_mask(uint32_t pages)
{
    return (uint32_t)(((uint64_t)1 << pages) - 1U);
}

static uint32_t page_count(uint32_t pages)
{
    uint32_t count = 0;
    for (uint32_t rest = pages; rest != 0; rest &= rest - 1U)
    {
        ++count;
    }
    return count;
}

/// Whether a time is farther from now than the time-out. Frames may come slightly out of order; if
/// the clock is set back, everything is old.
static bool is_timed_out(const maplines_decoder_t *decoder, int owner, int64_t since_ns,
                         int64_t t_ns)
{
    return maplines_distance(t_ns, since_ns) > decoder->settings.timeout_ns[owner];
}

/// Drop the i-th transfer that began.
static void drop_transfer(maplines_decoder_t *decoder, int owner, unsigned i,
                          maplines_reason_t reason)
{
    maplines_inbox_t *inbox = &decoder->inboxes[owner];
    maplines_transfer_t *transfer = &inbox->incomplete[inbox->began[i]];
    decoder->statistics.counts[reason] += page_count(transfer->pages);
    transfer->pages = 0;
    --inbox->count;
    for (unsigned later = i; later < inbox->count; ++later)
    {
        inbox->began[later] = inbox->began[later + 1U];
    }
}

/// Which of the transfers that began is at a place.
static unsigned began_at(const maplines_inbox_t *inbox, uint32_t place)
{
    unsigned i = 0;
    while (i < inbox->count && inbox->began[i] != place)
    {
        ++i;
    }
    return i;
}

static void expire_inbox(maplines_decoder_t *decoder, int owner, int64_t t_ns)
{
    const maplines_inbox_t *inbox = &decoder->inboxes[owner];
    unsigned i = 0;
    while (i < inbox->count)
    {
        if (is_timed_out(decoder, owner, inbox->incomplete[inbox->began[i]].t_ns, t_ns))
        {
            drop_transfer(decoder, owner, i, MAPLINES_TIMEOUT);
        }
        else
        {
            ++i;
        }
    }
}

MAPLINES_INTERNAL void maplines_complete_record(maplines_decoder_t *decoder,
                                                maplines_arrival_t *arrival)
{
    const maplines_record_t *layout = maplines_layout(decoder->dbc, arrival->owner);
    maplines_inbox_t *inbox = &decoder->inboxes[arrival->owner];
    arrival->reason = maplines_read_record(decoder->dbc, arrival);
    if (arrival->reason != MAPLINES_COMPLETE)
    {
        return;
    }
    const uint32_t ids = transfer_ids(layout);
    const uint32_t own = (uint32_t)maplines_get(&layout->transfer_id[0], arrival->record);
    for (uint32_t place = 0; place < places_of(ids); ++place)
    {
        const uint32_t ahead = (inbox->complete[place].id - own) & (ids - 1U);
        if (ahead > 0 && ahead < ids / 2U)
        {
            inbox->complete[place].pages = 0;
        }
    }
    maplines_transfer_t *known = &inbox->complete[own % MAPLINES_TRANSFERS];
    memcpy(known->record, arrival->record, arrival->length);
    known->t_ns = arrival->t_ns;
    known->pages = pages_mask(arrival->length / PAGE_BYTES);
    known->id = (uint16_t)own;
    unsigned i = 0;
    while (i < inbox->count && inbox->incomplete[inbox->began[i]].id != own)
    {
        if (((inbox->incomplete[inbox->began[i]].id - own) & (ids - 1U)) <= ids / 2U)
        {
            drop_transfer(decoder, arrival->owner, i, MAPLINES_INCOMPLETE);
        }
        else
        {
            ++i;
        }
    }
}

/// Number of pages of a record as far as those of a transfer say it.
static uint32_t needed_pages(const maplines_dbc_t *dbc, const maplines_record_t *layout,
                             const maplines_transfer_t *transfer)
{
#if MAPLINES_SCENES
    if (layout->short_pages < layout->pages)
    {
        const uint32_t form = dbc->has_covariance.first / (8U * PAGE_BYTES);
        if ((transfer->pages >> form & 1U) != 0 &&
            maplines_get(&dbc->has_covariance, transfer->record) == 0)
        {
            return layout->short_pages;
        }
    }
#else
    (void)dbc;
    (void)transfer;
#endif
    return layout->pages;
}

/// By how much the counter in a page is ahead of that of a transfer, modulo the counters; 0 if the
/// page has no counter.
static uint32_t counter_ahead(const maplines_record_t *layout, uint32_t page, const uint8_t *data,
                              const maplines_transfer_t *transfer)
{
    if (page != layout->counter.first / (8U * PAGE_BYTES))
    {
        return 0;
    }
    uint8_t record[MAPLINES_MAX_RECORD];
    memcpy(record, transfer->record, sizeof(record));
    memcpy(record + PAGE_BYTES * page, data, PAGE_BYTES);
    const uint32_t counter = (uint32_t)maplines_get(&layout->counter, record);
    const uint32_t before = (uint32_t)maplines_get(&layout->counter, transfer->record);
    return (counter - before) & maplines_counter_mask(layout);
}

/// Whether a page is one of a good record that is not older than the time-out.
static bool is_known_page(const maplines_decoder_t *decoder, int owner, uint32_t id, uint32_t page,
                          const uint8_t *data, int64_t t_ns)
{
    const maplines_transfer_t *known = &decoder->inboxes[owner].complete[id % MAPLINES_TRANSFERS];
    if (known->id != id || (known->pages >> page & 1U) == 0 ||
        is_timed_out(decoder, owner, known->t_ns, t_ns))
    {
        return false;
    }
    return memcmp(known->record + PAGE_BYTES * page, data, PAGE_BYTES) == 0;
}

static maplines_transfer_t *begin_transfer(maplines_inbox_t *inbox, uint32_t id, int64_t t_ns)
{
    const uint32_t place = id % MAPLINES_TRANSFERS;
    maplines_transfer_t *transfer = &inbox->incomplete[place];
    memset(transfer, 0, sizeof(*transfer));
    transfer->t_ns = t_ns;
    transfer->id = (uint16_t)id;
    inbox->began[inbox->count] = (uint16_t)place;
    ++inbox->count;
    return transfer;
}

MAPLINES_INTERNAL maplines_reason_t maplines_add_page(maplines_decoder_t *decoder,
                                                      const uint8_t *data, int64_t t_ns,
                                                      maplines_arrival_t *arrival)
{
    const int owner = arrival->owner;
    const maplines_record_t *layout = maplines_layout(decoder->dbc, owner);
    maplines_inbox_t *inbox = &decoder->inboxes[owner];
    const uint32_t page = (uint32_t)maplines_get(&layout->page, data);
    if (page >= layout->pages)
    {
        return maplines_dropped(decoder, MAPLINES_PAGE, 1);
    }
    const uint32_t id = (uint32_t)maplines_get(&layout->transfer_id[page == 0 ? 0 : 1], data);
    expire_inbox(decoder, owner, t_ns);
    const uint32_t place = id % MAPLINES_TRANSFERS;
    maplines_transfer_t *transfer = &inbox->incomplete[place];
    if (transfer->pages != 0 && transfer->id != id)
    {
        const uint32_t ids = transfer_ids(layout);
        if (((id - transfer->id) & (ids - 1U)) > ids / 2U) // older than what is at its place
        {
            return maplines_dropped(decoder, MAPLINES_INCOMPLETE, 1);
        }
        drop_transfer(decoder, owner, began_at(inbox, place), MAPLINES_INCOMPLETE);
    }
    if (transfer->pages == 0)
    {
        if (is_known_page(decoder, owner, id, page, data, t_ns))
        {
            return maplines_dropped(decoder, MAPLINES_DUPLICATE, 1);
        }
        transfer = begin_transfer(inbox, id, t_ns);
    }
    else if ((transfer->pages >> page & 1U) != 0)
    {
        if (memcmp(transfer->record + PAGE_BYTES * page, data, PAGE_BYTES) == 0)
        {
            return maplines_dropped(decoder, MAPLINES_DUPLICATE, 1);
        }
        const uint32_t ahead = counter_ahead(layout, page, data, transfer);
        if (ahead > maplines_counter_mask(layout) / 2U) // of an older transfer
        {
            return maplines_dropped(decoder, MAPLINES_REPLACED, 1);
        }
        if (ahead > 0)
        {
            drop_transfer(decoder, owner, began_at(inbox, place), MAPLINES_REPLACED);
            transfer = begin_transfer(inbox, id, t_ns);
        }
        else
        {
            ++decoder->statistics.counts[MAPLINES_REPLACED];
        }
    }
    else
    {
        // a page that the transfer does not have yet
    }
    memcpy(transfer->record + PAGE_BYTES * page, data, PAGE_BYTES);
    transfer->pages |= (uint32_t)1 << page;
    const uint32_t needed = needed_pages(decoder->dbc, layout, transfer);
    if ((~transfer->pages & pages_mask(needed)) != 0)
    {
        return MAPLINES_PENDING;
    }
    arrival->t_ns = transfer->t_ns;
    arrival->frames = needed;
    arrival->length = needed * PAGE_BYTES;
    memcpy(arrival->record, transfer->record, arrival->length);
    maplines_complete_record(decoder, arrival);
    transfer->pages &= ~pages_mask(needed); // what is left is of another record
    drop_transfer(decoder, owner, began_at(inbox, place), MAPLINES_INCOMPLETE);
    return MAPLINES_COMPLETE;
}

MAPLINES_INTERNAL void maplines_expire_transfers(maplines_decoder_t *decoder, int64_t t_ns)
{
    for (int owner = 0; owner < MAPLINES_LINE_OWNERS; ++owner)
    {
        expire_inbox(decoder, owner, t_ns);
    }
}

MAPLINES_INTERNAL uint32_t maplines_pending_transfers(const maplines_decoder_t *decoder)
{
    uint32_t pending = 0;
    for (int owner = 0; owner < MAPLINES_LINE_OWNERS; ++owner)
    {
        const maplines_inbox_t *inbox = &decoder->inboxes[owner];
        for (unsigned i = 0; i < inbox->count; ++i)
        {
            pending += page_count(inbox->incomplete[inbox->began[i]].pages);
        }
    }
    return pending;
}

#endif
