/* Bits of a record, the conversion between raw and physical values, and the checksum. */
#include "internal.h"

/* A record is a number of words of 8 bytes, and so is a page: a word with a bit of a signal can be
 * read and written as a whole. A signal lies in one word, or in two that follow each other, whose
 * bits are counted from the lowest; Motorola: from the highest. Compilers make one instruction of
 * the eight shifts of a word.
 */

static uint64_t intel_word(const uint8_t *bytes)
{
    return (uint64_t)bytes[0] | (uint64_t)bytes[1] << 8U | (uint64_t)bytes[2] << 16U |
           (uint64_t)bytes[3] << 24U | (uint64_t)bytes[4] << 32U | (uint64_t)bytes[5] << 40U |
           (uint64_t)bytes[6] << 48U | (uint64_t)bytes[7] << 56U;
}

static uint64_t motorola_word(const uint8_t *bytes)
{
    return (uint64_t)bytes[0] << 56U | (uint64_t)bytes[1] << 48U | (uint64_t)bytes[2] << 40U |
           (uint64_t)bytes[3] << 32U | (uint64_t)bytes[4] << 24U | (uint64_t)bytes[5] << 16U |
           (uint64_t)bytes[6] << 8U | (uint64_t)bytes[7];
}

static void add_to_intel_word(uint8_t *bytes, uint64_t bits)
{
    const uint64_t word = intel_word(bytes) | bits;
    bytes[0] = (uint8_t)(word & 0xFFU);
    bytes[1] = (uint8_t)(word >> 8U & 0xFFU);
    bytes[2] = (uint8_t)(word >> 16U & 0xFFU);
    bytes[3] = (uint8_t)(word >> 24U & 0xFFU);
    bytes[4] = (uint8_t)(word >> 32U & 0xFFU);
    bytes[5] = (uint8_t)(word >> 40U & 0xFFU);
    bytes[6] = (uint8_t)(word >> 48U & 0xFFU);
    bytes[7] = (uint8_t)(word >> 56U);
}

static void add_to_motorola_word(uint8_t *bytes, uint64_t bits)
{
    const uint64_t word = motorola_word(bytes) | bits;
    bytes[0] = (uint8_t)(word >> 56U);
    bytes[1] = (uint8_t)(word >> 48U & 0xFFU);
    bytes[2] = (uint8_t)(word >> 40U & 0xFFU);
    bytes[3] = (uint8_t)(word >> 32U & 0xFFU);
    bytes[4] = (uint8_t)(word >> 24U & 0xFFU);
    bytes[5] = (uint8_t)(word >> 16U & 0xFFU);
    bytes[6] = (uint8_t)(word >> 8U & 0xFFU);
    bytes[7] = (uint8_t)(word & 0xFFU);
}

MAPLINES_INTERNAL int64_t maplines_get(const maplines_signal_t *signal, const uint8_t *record)
{
    MAPLINES_ASSERT(signal->length > 0U);
    const uint8_t *bytes = record + (size_t)(signal->first / 64U) * 8U;
    const unsigned place = signal->first % 64U;
    const unsigned unused = 64U - signal->length;
    uint64_t top; // the signal in the highest bits
    if (signal->is_motorola)
    {
        top = motorola_word(bytes) << place;
        if (place > unused)
        {
            top |= motorola_word(bytes + 8) >> (64U - place);
        }
    }
    else
    {
        top = intel_word(bytes) >> place;
        if (place > unused)
        {
            top |= intel_word(bytes + 8) << (64U - place);
        }
        top <<= unused;
    }
    const bool is_negative = signal->is_signed && top >> 63U != 0U;
    const int64_t rest = (int64_t)((is_negative ? ~top : top) >> unused);
    return is_negative ? -rest - 1 : rest; // as two's complement
}

MAPLINES_INTERNAL void maplines_put(const maplines_signal_t *signal, uint8_t *record, int64_t raw)
{
    if (signal->length == 0U)
    {
        return;
    }
    uint8_t *bytes = record + (size_t)(signal->first / 64U) * 8U;
    const unsigned place = signal->first % 64U;
    const unsigned unused = 64U - signal->length;
    const uint64_t top = (uint64_t)raw << unused;
    if (signal->is_motorola)
    {
        add_to_motorola_word(bytes, top >> place);
        if (place > unused)
        {
            add_to_motorola_word(bytes + 8, top << (64U - place));
        }
    }
    else
    {
        add_to_intel_word(bytes, top >> unused << place);
        if (place > unused)
        {
            add_to_intel_word(bytes + 8, top >> unused >> (64U - place));
        }
    }
}

MAPLINES_INTERNAL int64_t maplines_raw_min(const maplines_signal_t *signal)
{
    return signal->is_signed ? -((int64_t)1 << (signal->length - 1U)) : 0;
}

MAPLINES_INTERNAL int64_t maplines_raw_max(const maplines_signal_t *signal)
{
    const unsigned bits = signal->is_signed ? signal->length - 1U : signal->length;
    return ((int64_t)1 << bits) - 1;
}

MAPLINES_INTERNAL double maplines_physical(const maplines_signal_t *signal, int64_t raw)
{
    if (signal->length == 0U)
    {
        return 0.0;
    }
    const double scaled = (double)raw * signal->scale->factor;
    return scaled + signal->scale->offset;
}

MAPLINES_INTERNAL double maplines_value(const maplines_signal_t *signal, const uint8_t *record)
{
    return maplines_physical(signal, maplines_get(signal, record));
}

MAPLINES_INTERNAL double maplines_nearest_raw(const maplines_signal_t *signal, double physical)
{
    if (signal->length == 0U)
    {
        return 0.0;
    }
    return rint((physical - signal->scale->offset) / signal->scale->factor);
}

MAPLINES_INTERNAL int64_t maplines_within(int64_t least, int64_t most, double raw)
{
    if (!(raw > (double)least)) // or NaN
    {
        return least;
    }
    return raw < (double)most ? (int64_t)raw : most;
}

MAPLINES_INTERNAL int64_t maplines_limited(const maplines_signal_t *signal, double raw)
{
    return maplines_within(maplines_raw_min(signal), maplines_raw_max(signal), raw);
}

/* The remainder of v x^16 is r = v x^16 - q P, for the polynomial P = x^16 + x^12 + x^5 + 1 of the
 * checksum. The quotient q is v x^32 / P without what is below x^16, and
 *
 *     x^32 / P = x^16 + x^12 + x^8 + x^5 + x^4 + ...,
 *
 * so q is a sum of some v, shifted; and so is r = q (x^12 + x^5 + 1), without what is above x^15.
 * That is as fast as with tables, and takes no memory. Of a single byte, v is 8 bits shorter.
 */

static unsigned crc_of_quotient(unsigned q)
{
    return (q ^ q << 5U ^ q << 12U) & 0xFFFFU;
}

static unsigned crc_with(unsigned crc, const uint8_t *data, size_t length)
{
    size_t i = 0;
    if (length % 2U != 0U)
    {
        const unsigned v = crc >> 8U ^ data[0];
        crc = (crc << 8U & 0xFFFFU) ^ crc_of_quotient(v ^ v >> 4U);
        i = 1;
    }
    for (; i < length; i += 2U)
    {
        const unsigned v = crc ^ ((unsigned)data[i] << 8U | data[i + 1U]);
        crc = crc_of_quotient(v ^ v >> 4U ^ v >> 8U ^ v >> 11U ^ v >> 12U);
    }
    return crc;
}

MAPLINES_INTERNAL uint16_t maplines_crc(const uint8_t *record, size_t length, uint16_t crc_byte,
                                        uint16_t data_id)
{
    const uint8_t id[2] = {(uint8_t)(data_id & 0xFFU), (uint8_t)(data_id >> 8U)};
    unsigned crc = crc_with(0xFFFFU, record, crc_byte);
    crc = crc_with(crc, record + crc_byte + 2, length - crc_byte - 2U);
    return (uint16_t)crc_with(crc, id, 2);
}
