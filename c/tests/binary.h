/* Little-endian binary numbers from the standard input and to the standard output.
 *
 * A harness reads cases in this form and writes what the core makes of them, so that a test can
 * compare each bit with the Python package, on hosts of either byte order. A read beyond the end
 * of the input ends the program with status 2: a test has sent too little.
 */
#ifndef MAPLINES_TESTS_BINARY_H
#define MAPLINES_TESTS_BINARY_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/// Whether there is nothing more to read.
static inline bool at_end(void)
{
    const int next = getchar();
    if (next == EOF)
    {
        return true;
    }
    (void)ungetc(next, stdin);
    return false;
}

static inline void read_bytes(void *bytes, size_t length)
{
    if (length > 0 && fread(bytes, 1, length, stdin) != length)
    {
        (void)fprintf(stderr, "the input ends within a case\n");
        exit(2);
    }
}

static inline void write_bytes(const void *bytes, size_t length)
{
    if (length > 0 && fwrite(bytes, 1, length, stdout) != length)
    {
        exit(3);
    }
}

/// Read an unsigned integer of up to 8 bytes.
static inline uint64_t read_unsigned(size_t length)
{
    uint8_t bytes[8] = {0};
    read_bytes(bytes, length);
    uint64_t value = 0;
    for (size_t i = length; i > 0; --i)
    {
        value = value << 8U | bytes[i - 1];
    }
    return value;
}

static inline void write_unsigned(uint64_t value, size_t length)
{
    uint8_t bytes[8];
    for (size_t i = 0; i < length; ++i)
    {
        bytes[i] = (uint8_t)(value >> 8U * i & 0xFFU);
    }
    write_bytes(bytes, length);
}

static inline uint8_t read_u8(void)
{
    return (uint8_t)read_unsigned(1);
}

static inline uint16_t read_u16(void)
{
    return (uint16_t)read_unsigned(2);
}

static inline uint32_t read_u32(void)
{
    return (uint32_t)read_unsigned(4);
}

static inline uint64_t read_u64(void)
{
    return read_unsigned(8);
}

static inline int64_t read_i64(void)
{
    const uint64_t bits = read_unsigned(8);
    int64_t value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static inline double read_f64(void)
{
    const uint64_t bits = read_unsigned(8);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static inline void write_u8(uint8_t value)
{
    write_unsigned(value, 1);
}

static inline void write_u16(uint16_t value)
{
    write_unsigned(value, 2);
}

static inline void write_u32(uint32_t value)
{
    write_unsigned(value, 4);
}

static inline void write_u64(uint64_t value)
{
    write_unsigned(value, 8);
}

static inline void write_i64(int64_t value)
{
    write_unsigned((uint64_t)value, 8);
}

/// Write a double, or a float as the double of the same value.
static inline void write_f64(double value)
{
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    write_unsigned(bits, 8);
}

#endif
