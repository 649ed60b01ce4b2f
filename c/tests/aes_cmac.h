/* AES-CMAC (RFC 4493) with AES-128, for tests and examples. An ECU has an HSM for it.
 *
 * It is written to be read: no tables but the S-box, one byte at a time. It is not protected
 * against an attacker who measures its time.
 */
#ifndef MAPLINES_TESTS_AES_CMAC_H
#define MAPLINES_TESTS_AES_CMAC_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

/// Product with x in GF(2^8).
static inline uint8_t aes_twice(uint8_t value)
{
    return (uint8_t)((unsigned)value << 1U ^ ((value & 0x80U) != 0 ? 0x1BU : 0U));
}

static inline uint8_t aes_rotated(uint8_t value, unsigned by)
{
    return (uint8_t)((unsigned)value << by | (unsigned)value >> (8U - by));
}

/// The S-box: the inverse in GF(2^8), found by walking through its powers, and an affine map.
static inline void aes_s_box(uint8_t box[256])
{
    uint8_t p = 1;
    uint8_t q = 1;
    do
    {
        p = (uint8_t)(p ^ aes_twice(p)); // times 3
        q = (uint8_t)(q ^ q << 1U);      // divided by 3
        q = (uint8_t)(q ^ q << 2U);
        q = (uint8_t)(q ^ q << 4U);
        q = (uint8_t)(q ^ ((q & 0x80U) != 0 ? 0x09U : 0U));
        box[p] = (uint8_t)(q ^ aes_rotated(q, 1) ^ aes_rotated(q, 2) ^ aes_rotated(q, 3) ^
                           aes_rotated(q, 4) ^ 0x63U);
    }
    while (p != 1);
    box[0] = 0x63;
}

/// Encrypt a block in place.
static inline void aes_encrypt(const uint8_t key[16], uint8_t block[16])
{
    uint8_t box[256];
    uint8_t round_key[16];
    uint8_t constant = 1;
    aes_s_box(box);
    memcpy(round_key, key, 16);
    for (int i = 0; i < 16; ++i)
    {
        block[i] ^= round_key[i];
    }
    for (int round = 1; round <= 10; ++round)
    {
        uint8_t rows[16];
        for (int i = 0; i < 16; ++i) // substitute, and shift the rows
        {
            rows[i] = box[block[(5 * i) % 16]];
        }
        for (int column = 0; column < 16 && round < 10; column += 4)
        {
            uint8_t *c = rows + column;
            const uint8_t first = c[0];
            const uint8_t all = (uint8_t)(c[0] ^ c[1] ^ c[2] ^ c[3]);
            c[0] = (uint8_t)(c[0] ^ all ^ aes_twice((uint8_t)(c[0] ^ c[1])));
            c[1] = (uint8_t)(c[1] ^ all ^ aes_twice((uint8_t)(c[1] ^ c[2])));
            c[2] = (uint8_t)(c[2] ^ all ^ aes_twice((uint8_t)(c[2] ^ c[3])));
            c[3] = (uint8_t)(c[3] ^ all ^ aes_twice((uint8_t)(c[3] ^ first)));
        }
        for (int i = 0; i < 4; ++i)
        {
            round_key[i] = (uint8_t)(round_key[i] ^ box[round_key[12 + (i + 1) % 4]]);
        }
        round_key[0] = (uint8_t)(round_key[0] ^ constant);
        constant = aes_twice(constant);
        for (int i = 4; i < 16; ++i)
        {
            round_key[i] = (uint8_t)(round_key[i] ^ round_key[i - 4]);
        }
        for (int i = 0; i < 16; ++i)
        {
            block[i] = (uint8_t)(rows[i] ^ round_key[i]);
        }
    }
}

/// Shift a block up by a bit; as a polynomial, times x.
static inline void cmac_double(uint8_t block[16])
{
    const uint8_t carry = block[0] & 0x80U;
    for (int i = 0; i < 15; ++i)
    {
        block[i] = (uint8_t)((unsigned)block[i] << 1U | (unsigned)block[i + 1] >> 7U);
    }
    block[15] = (uint8_t)((unsigned)block[15] << 1U ^ (carry != 0 ? 0x87U : 0U));
}

/// MAC of some data.
static inline void aes_cmac(const uint8_t key[16], const uint8_t *data, size_t length,
                            uint8_t mac[16])
{
    uint8_t subkey[16] = {0};
    aes_encrypt(key, subkey);
    cmac_double(subkey);
    memset(mac, 0, 16);
    while (length > 16)
    {
        for (int i = 0; i < 16; ++i)
        {
            mac[i] ^= data[i];
        }
        aes_encrypt(key, mac);
        data += 16;
        length -= 16;
    }
    uint8_t last[16] = {0};
    memcpy(last, data, length);
    if (length < 16)
    {
        last[length] = 0x80;
        cmac_double(subkey);
    }
    for (int i = 0; i < 16; ++i)
    {
        mac[i] = (uint8_t)(mac[i] ^ last[i] ^ subkey[i]);
    }
    aes_encrypt(key, mac);
}

#endif
