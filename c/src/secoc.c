/* Authentication of records: AUTOSAR SecOC with AES-CMAC (RFC 4493).
 *
 * A secured I-PDU is
 *
 *     authentic I-PDU: record | padding | key ID
 *     truncated freshness value: its low bytes
 *     truncated MAC: its first bytes
 *
 * and the MAC is
 *
 *     AES-CMAC(key, data ID in 16 bits | authentic I-PDU | freshness value in 64 bits)
 *
 * All numbers are big-endian. A freshness value is the sender's time in microseconds, or the last
 * one plus one if that is greater: it increases with each frame, also over a restart.
 */
#include "internal.h"

#if MAPLINES_SECOC

#define MAC_BYTES 16
#define DATA_ID_BYTES 2U
#define FRESHNESS_BYTES 8U

typedef bool (*mac_function_t)(void *context, uint8_t key_id, const uint8_t *data, size_t length,
                               uint8_t mac[16]);

/// MAC of an authentic I-PDU with a freshness value; false without its key.
static bool mac_of(mac_function_t function, void *context, uint16_t data_id,
                   const uint8_t *authentic, size_t length, uint64_t freshness_us,
                   uint8_t mac[MAC_BYTES])
{
    uint8_t data[DATA_ID_BYTES + 64U + FRESHNESS_BYTES];
    data[0] = (uint8_t)(data_id >> 8U);
    data[1] = (uint8_t)(data_id & 0xFFU);
    memcpy(data + DATA_ID_BYTES, authentic, length);
    for (unsigned i = 0; i < FRESHNESS_BYTES; ++i)
    {
        data[DATA_ID_BYTES + length + i] = (uint8_t)(freshness_us >> (56U - 8U * i) & 0xFFU);
    }
    return function(context, authentic[length - 1U], data, DATA_ID_BYTES + length + FRESHNESS_BYTES,
                    mac);
}

#if MAPLINES_RECEIVER
/// Whether two MACs are the same; it takes the same time whatever they are.
static bool is_same_mac(const uint8_t *a, const uint8_t *b, unsigned length)
{
    unsigned differing = 0;
    for (unsigned i = 0; i < length; ++i)
    {
        differing |= (unsigned)a[i] ^ (unsigned)b[i];
    }
    return differing == 0;
}

/// Freshness value with these low bits: the least one above `floor`.
static uint64_t completed_freshness(uint64_t truncated, unsigned bits, uint64_t floor_us)
{
    const uint64_t value = (floor_us >> bits << bits) | truncated;
    return value > floor_us ? value : value + ((uint64_t)1 << bits);
}

/// Whether a freshness value is later than the window about now.
static bool is_after_window(uint64_t freshness_us, int64_t now_us, int64_t window_us)
{
    if (now_us < 0)
    {
        const int64_t end_us = now_us + window_us;
        return end_us < 0 || freshness_us > (uint64_t)end_us;
    }
    return freshness_us > (uint64_t)now_us + (uint64_t)window_us;
}

MAPLINES_INTERNAL maplines_reason_t maplines_verify(const maplines_dbc_t *dbc, int owner,
                                                    const maplines_authenticator_t *authenticator,
                                                    const maplines_frame_t *frame, int64_t *last_us)
{
    const maplines_record_t *layout = maplines_layout(dbc, owner);
    const unsigned authentic = layout->fd_authentic;
    const unsigned bits = 8U * layout->fd_freshness;
    const uint16_t data_id = dbc->messages[owner].secured_data_id;
    const uint8_t *trailer = frame->data + authentic;
    const uint8_t *received = trailer + layout->fd_freshness;
    if (frame->length != authentic + layout->fd_freshness + layout->fd_mac)
    {
        return MAPLINES_LENGTH;
    }
    uint64_t truncated = 0;
    for (unsigned i = 0; i < layout->fd_freshness; ++i)
    {
        truncated = truncated << 8U | trailer[i];
    }
    const int64_t window_us = authenticator->window_us;
    const bool has_clock = authenticator->now_us != NULL;
    const int64_t now_us = has_clock ? authenticator->now_us(authenticator->context) : 0;
    int64_t floor_us = *last_us;
    if (has_clock && now_us > window_us && now_us - window_us - 1 > floor_us)
    {
        floor_us = now_us - window_us - 1;
    }
    uint64_t freshness_us = completed_freshness(truncated, bits, (uint64_t)floor_us);
    uint8_t mac[MAC_BYTES];
    if (!mac_of(authenticator->mac, authenticator->context, data_id, frame->data, authentic,
                freshness_us, mac))
    {
        return MAPLINES_KEY;
    }
    if (is_same_mac(mac, received, layout->fd_mac))
    {
        if (freshness_us > (uint64_t)INT64_MAX ||
            (has_clock && is_after_window(freshness_us, now_us, window_us)))
        {
            return MAPLINES_AGE;
        }
        *last_us = (int64_t)freshness_us;
        return MAPLINES_COMPLETE;
    }
    // Never accepted, but the count should distinguish an old frame from a forged one.
    if (freshness_us < (uint64_t)1 << bits)
    {
        return MAPLINES_MAC;
    }
    freshness_us -= (uint64_t)1 << bits;
    if (!mac_of(authenticator->mac, authenticator->context, data_id, frame->data, authentic,
                freshness_us, mac) ||
        !is_same_mac(mac, received, layout->fd_mac))
    {
        return MAPLINES_MAC;
    }
    return freshness_us <= (uint64_t)*last_us ? MAPLINES_REPLAY : MAPLINES_AGE;
}
#endif

#if MAPLINES_SENDER
MAPLINES_INTERNAL size_t maplines_secured_pdu(const maplines_record_t *layout, uint16_t data_id,
                                              const uint8_t *record, size_t length, int64_t now_us,
                                              maplines_signer_t *signer, uint8_t pdu[64])
{
    const unsigned authentic = layout->fd_authentic;
    if (signer->last_us == INT64_MAX)
    {
        return 0;
    }
    const int64_t next_us = signer->last_us + 1;
    const int64_t freshness_us = now_us > next_us ? now_us : next_us;
    memset(pdu, 0, authentic);
    memcpy(pdu, record, length);
    pdu[authentic - 1U] = signer->key_id;
    uint8_t *trailer = pdu + authentic;
    for (unsigned i = 0; i < layout->fd_freshness; ++i)
    {
        const unsigned shift = 8U * (layout->fd_freshness - 1U - i);
        trailer[i] = (uint8_t)((uint64_t)freshness_us >> shift & 0xFFU);
    }
    uint8_t mac[MAC_BYTES];
    if (!mac_of(signer->mac, signer->context, data_id, pdu, authentic, (uint64_t)freshness_us, mac))
    {
        return 0;
    }
    memcpy(trailer + layout->fd_freshness, mac, layout->fd_mac);
    signer->last_us = freshness_us;
    return (size_t)authentic + layout->fd_freshness + layout->fd_mac;
}
#endif

#endif
