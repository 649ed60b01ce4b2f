/* Bits of a record, the conversion between raw and physical values, and the checksum. */
#include "internal.h"

/// Place of bit i of a signal, counted from its highest one: the byte and the bit in it.
static size_t byte_of(const maplines_signal_t *signal, unsigned i, unsigned *bit)
{
    if (signal->is_motorola)
    {
        const unsigned place = signal->first + i; // from the highest bit of byte 0
        *bit = 7U - place % 8U;
        return place / 8U;
    }
    const unsigned place = signal->first + signal->length - 1U - i;
    *bit = place % 8U;
    return place / 8U;
}

MAPLINES_INTERNAL int64_t maplines_get(const maplines_signal_t *signal, const uint8_t *record)
{
    uint64_t raw = 0;
    unsigned i = 0;
    while (i < signal->length)
    {
        unsigned bit;
        const size_t byte = byte_of(signal, i, &bit);
        unsigned count = bit + 1U; // down to the lowest bit of the byte, or of the signal
        count = count < signal->length - i ? count : signal->length - i;
        const unsigned piece = (unsigned)record[byte] >> (bit + 1U - count) & ((1U << count) - 1U);
        raw = raw << count | piece;
        i += count;
    }
    assert(signal->length > 0U);
    const uint64_t sign = (uint64_t)1 << (signal->length - 1U);
    if (signal->is_signed && (raw & sign) != 0)
    {
        return (int64_t)(raw - sign) - (int64_t)sign;
    }
    return (int64_t)raw;
}

MAPLINES_INTERNAL void maplines_put(const maplines_signal_t *signal, uint8_t *record, int64_t raw)
{
    const uint64_t value = (uint64_t)raw;
    unsigned i = 0;
    while (i < signal->length)
    {
        unsigned bit;
        const size_t byte = byte_of(signal, i, &bit);
        unsigned count = bit + 1U;
        count = count < signal->length - i ? count : signal->length - i;
        const unsigned below = signal->length - i - count; // bits of the signal after this piece
        const unsigned piece = (unsigned)(value >> below) & ((1U << count) - 1U);
        record[byte] = (uint8_t)(record[byte] | piece << (bit + 1U - count));
        i += count;
    }
}

MAPLINES_INTERNAL double maplines_physical(const maplines_signal_t *signal, int64_t raw)
{
    const double scaled = (double)raw * signal->factor;
    return scaled + signal->offset;
}

MAPLINES_INTERNAL double maplines_nearest_raw(const maplines_signal_t *signal, double physical)
{
    return rint((physical - signal->offset) / signal->factor);
}

MAPLINES_INTERNAL int64_t maplines_limited(const maplines_signal_t *signal, double raw)
{
    if (!(raw > (double)signal->raw_min)) // or NaN
    {
        return signal->raw_min;
    }
    return raw < (double)signal->raw_max ? (int64_t)raw : signal->raw_max;
}

static uint16_t crc_with(uint16_t crc, const uint8_t *data, size_t length)
{
    for (size_t i = 0; i < length; ++i)
    {
        crc = (uint16_t)(crc ^ (unsigned)data[i] << 8U);
        for (int bit = 0; bit < 8; ++bit)
        {
            crc = (uint16_t)((crc & 0x8000U) != 0 ? (unsigned)crc << 1U ^ 0x1021U
                                                  : (unsigned)crc << 1U);
        }
    }
    return crc;
}

MAPLINES_INTERNAL uint16_t maplines_crc(const uint8_t *record, size_t length, uint16_t crc_byte,
                                        uint16_t data_id)
{
    const uint8_t id[2] = {(uint8_t)(data_id & 0xFFU), (uint8_t)(data_id >> 8U)};
    uint16_t crc = crc_with(0xFFFF, record, crc_byte);
    crc = crc_with(crc, record + crc_byte + 2, length - crc_byte - 2U);
    return crc_with(crc, id, 2);
}
