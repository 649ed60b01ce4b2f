/* What the fuzzers share: the input as values, what holds for any line, and programs that replay.
 *
 * With libFuzzer: clang -DFUZZER -fsanitize=fuzzer,address,undefined,float-cast-overflow. Without
 * it, the program takes the names of files, or draws inputs at random: replay COUNT SEED.
 */
#ifndef FUZZ_H
#define FUZZ_H

#include "harness_dbc.h"
#include "internal.h"

#include <float.h>
#include <stdio.h>
#include <stdlib.h>

#define REQUIRE(condition)                                                                         \
    do                                                                                             \
    {                                                                                              \
        if (!(condition))                                                                          \
        {                                                                                          \
            (void)fprintf(stderr, "%s:%d: %s does not hold\n", __FILE__, __LINE__, #condition);    \
            abort();                                                                               \
        }                                                                                          \
    }                                                                                              \
    while (0)

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

/* ---- the input as values ---- */

/// Rest of the input; beyond its end it is zeros.
typedef struct {
    const uint8_t *data;
    size_t left;
    bool is_ordinary; ///< numbers are within their scales, and choices among those that there are
} input_t;

static inline uint8_t next(input_t *input)
{
    if (input->left == 0)
    {
        return 0;
    }
    --input->left;
    return *input->data++;
}

static inline uint64_t next_bits(input_t *input)
{
    uint64_t bits = 0;
    for (int i = 0; i < 8; ++i)
    {
        bits = bits << 8U | next(input);
    }
    return bits;
}

/// A number within 8 scales; unless all are ordinary, some are of any bits, or where something
/// ends.
static inline double next_number(input_t *input, double scale)
{
    static const double ends[] = {0,       -0.0,     NAN,   INFINITY, -INFINITY, DBL_MAX,
                                  DBL_MIN, 0x1p-537, 1e307, 0x1p31,   0x1p63,    -0x1p63};
    const uint8_t kind = next(input);
    if (kind < 240 || input->is_ordinary)
    {
        return ((double)kind - 128.0 + (double)next(input) / 256.0) / 16.0 * scale;
    }
    if (kind < 252)
    {
        return ends[kind - 240];
    }
    const uint64_t bits = next_bits(input);
    double number;
    memcpy(&number, &bits, sizeof number);
    return number;
}

static inline maplines_real_t next_real(input_t *input, double scale)
{
    const double number = next_number(input, scale);
#if MAPLINES_FLOAT
    return fabs(number) > (double)FLT_MAX ? (float)INFINITY : (float)number;
#else
    return number;
#endif
}

/// Any time, most of them up to two cycles of 50 ms later.
static inline int64_t next_time(input_t *input, int64_t t_ns)
{
    const uint8_t kind = next(input);
    if (kind < 200)
    {
        return t_ns + (int64_t)kind * 500000;
    }
    if (kind < 240) // earlier or later by up to 2 s
    {
        return t_ns + ((int64_t)next(input) - 128) * 16000000;
    }
    const uint64_t bits = next_bits(input);
    int64_t t;
    memcpy(&t, &bits, sizeof t);
    return t;
}

/* ---- what holds for any line ---- */

static inline bool is_a_number(maplines_real_t x)
{
    return x - x == 0;
}

static inline void check_line(const maplines_line_t *line)
{
    REQUIRE(line->slot < MAPLINES_SLOTS);
    REQUIRE(line->components >= 1 && line->components <= MAPLINES_MAX_COMPONENTS);
    REQUIRE(line->x_min <= line->x_max);
    REQUIRE(line->age >= 0);
    for (int i = 0; i < 4; ++i)
    {
        REQUIRE(is_a_number(line->gaussian.mean[i]));
        bool is_zero = true;
        for (int j = 0; j < 4; ++j)
        {
            REQUIRE(is_a_number(line->gaussian.factor[i][j]));
            is_zero = is_zero && line->gaussian.factor[i][j] == 0;
        }
        REQUIRE(!is_zero); // each variance is positive
    }
    const maplines_real_t y = maplines_y(line, 40);
    const maplines_real_t sigma = maplines_y_sigma(line, 40);
    REQUIRE(sigma > 0 || !is_a_number(y));
    REQUIRE(maplines_is_valid_at(line, 40) || (y != y && sigma != sigma));
}

/* ---- a MAC for DBCs with an authenticated message ---- */

/// A hash in place of AES-CMAC, which costs more and finds no more; there are two keys.
static inline bool fuzz_mac(void *context, uint8_t key_id, const uint8_t *data, size_t length,
                            uint8_t mac[16])
{
    uint64_t hash = 14695981039346656037U + key_id; // FNV-1a
    (void)context;
    for (size_t i = 0; i < length; ++i)
    {
        hash = (hash ^ data[i]) * 1099511628211U;
    }
    for (unsigned i = 0; i < 16; ++i)
    {
        mac[i] = (uint8_t)(hash >> 8U * (i % 8U));
    }
    return key_id < 2;
}

/* ---- the program without libFuzzer ---- */

#ifndef FUZZER
static void replay(const char *name)
{
    static uint8_t data[1 << 20];
    FILE *file = fopen(name, "rb");
    if (file == NULL)
    {
        (void)fprintf(stderr, "cannot open %s\n", name);
        exit(2);
    }
    const size_t size = fread(data, 1, sizeof data, file);
    (void)fclose(file);
    (void)LLVMFuzzerTestOneInput(data, size);
}

/// Draw `count` inputs of up to 4 kB from a seed (xorshift64*, Vigna 2016).
static void draw(unsigned long count, uint64_t seed)
{
    static uint8_t data[4096];
    uint64_t state = seed * 2685821657736338717U + 1U;
    for (unsigned long i = 0; i < count; ++i)
    {
        const size_t size = 16 + (size_t)(state % (sizeof data - 16));
        for (size_t k = 0; k < size; ++k)
        {
            state ^= state >> 12U;
            state ^= state << 25U;
            state ^= state >> 27U;
            data[k] = (uint8_t)(state * 2685821657736338717U >> 56U);
        }
        (void)LLVMFuzzerTestOneInput(data, size);
    }
}

int main(int argc, char **argv)
{
    char *end = NULL;
    const unsigned long count = argc == 3 ? strtoul(argv[1], &end, 10) : 0;
    if (count > 0 && *end == '\0')
    {
        draw(count, strtoul(argv[2], NULL, 10));
        return 0;
    }
    for (int i = 1; i < argc; ++i)
    {
        replay(argv[i]);
    }
    return 0;
}
#endif

#endif
