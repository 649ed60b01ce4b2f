/* Self-test of the arithmetic: compilers have options, and CPUs modes, of which no macro tells.
 *
 * Each case computes with many numbers, and folds the bits of the results into one; these are those
 * that IEEE 754 defines. The numbers come from a generator whose loop is too long for a compiler to
 * evaluate, so that the CPU computes with them.
 */
#include "internal.h"

#define ROUNDS 160 // compilers evaluate loops of up to 100
#define SEED 1U
#define STRIDE 8 // rounds for one of those that are slow without an FPU

typedef enum {
    CASE_QUOTIENT,
    CASE_SUM,
    CASE_PRODUCT,
    CASE_ROOT,
    CASE_SMALL,
    CASE_EXP2,
    CASE_LOG2,
    CASE_SINE,
    CASE_TANGENT,
    CASE_ARC_TANGENT,
    CASE_FLOAT,
    CASES,
} number_t;

typedef struct {
    char name[20];
    uint64_t bits;
} case_t;

static const case_t cases[CASES] = {
    {"quotient", UINT64_C(0x21BB4775BAB8EEA4)},
    {"sum", UINT64_C(0xBC82129A6A732DC5)},
    {"product and sum", UINT64_C(0x0A69059142CEFEEE)},
    {"square root", UINT64_C(0xDF6840A2D043A769)},
    {"subnormal number", UINT64_C(0x5715BBD07A2CCC2A)},
    {"power of 2", UINT64_C(0x2E19D6FB0B53E144)},
    {"logarithm", UINT64_C(0xFB92186F5DF9CCB5)},
    {"sine and cosine", UINT64_C(0x56B29CF6063DCBF9)},
    {"tangent", UINT64_C(0x97FB5221558DD7E2)},
    {"arc tangent", UINT64_C(0x90976A313CF3851B)},
    {"float", UINT64_C(0xA93C971CA0000000)},
};

/// Fold the bits of a number into those of others of a case.
static void fold(uint64_t folded[CASES], number_t number, double value)
{
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    folded[number] = (folded[number] ^ bits) * UINT64_C(0x100000001B3);
}

/// Next number of a generator, from 1 to 2.
static double next(uint32_t *state)
{
    *state = *state * UINT32_C(1664525) + UINT32_C(1013904223);
    return 1.0 + (double)*state * 0x1p-32;
}

/// Numbers from 1 to 2, and some quotients of rounds before.
static void fold_operations(double x, double y, double z, const double quotients[8],
                            uint64_t folded[CASES])
{
    const double ratio = x / z; // three of one divisor, and one of a constant
    const double other = y / z;
    const double third = ratio / 3.0;
    fold(folded, CASE_QUOTIENT, ratio);
    fold(folded, CASE_QUOTIENT, other);
    fold(folded, CASE_QUOTIENT, 1.0 / z);
    fold(folded, CASE_QUOTIENT, third);
    double total = 0.0;
    for (int i = 0; i < 8; ++i)
    {
        total = total + quotients[i];
    }
    const double sum = x + ratio;
    const double back = sum - x;
    fold(folded, CASE_SUM, total);
    fold(folded, CASE_SUM, back);
    const double product = ratio * other;
    const double shifted = product - third;
    fold(folded, CASE_PRODUCT, shifted);
    const double root = sqrt(other);
    fold(folded, CASE_ROOT, root);
    fold(folded, CASE_ROOT, x / root);
    const double small = ratio * 0x1p-1000;
    fold(folded, CASE_SMALL, small * (other * 0x1p-40));
}

/// The same in single precision, with which a receiver of the build with float computes.
static void fold_floats(float x, float y, float z, uint64_t folded[CASES])
{
    const float ratio = x / z;
    const float other = y / z;
    const float third = ratio / 3.0F;
    const float sum = x + ratio;
    const float back = sum - x;
    const float product = ratio * other;
    const float shifted = product - third;
    fold(folded, CASE_FLOAT, (double)ratio);
    fold(folded, CASE_FLOAT, (double)other);
    fold(folded, CASE_FLOAT, (double)third);
    fold(folded, CASE_FLOAT, (double)back);
    fold(folded, CASE_FLOAT, (double)shifted);
#if MAPLINES_FLOAT
    fold(folded, CASE_FLOAT, (double)sqrtf(other));
#else
    fold(folded, CASE_FLOAT,
         (double)(float)sqrt((double)other)); // of a float, that rounds to the same
#endif
}

static void fold_functions(double x, double y, double z, uint64_t folded[CASES])
{
    double sine, cosine;
    maplines_sin_cos(16.0 * y - 24.0, &sine, &cosine);
    fold(folded, CASE_EXP2, maplines_exp2(64.0 * x - 96.0));
    fold(folded, CASE_LOG2, maplines_log2(x * x - 0.5));
    fold(folded, CASE_SINE, sine);
    fold(folded, CASE_SINE, cosine);
    fold(folded, CASE_TANGENT, maplines_tan(y - 1.5));
    fold(folded, CASE_ARC_TANGENT, maplines_atan(4.0 * z - 6.0));
}

const char *maplines_self_test(void)
{
    uint64_t folded[CASES] = {0};
    double quotients[8] = {0};
    uint32_t state = SEED;
    for (int i = 0; i < ROUNDS; ++i)
    {
        const double x = next(&state);
        const double y = next(&state);
        const double z = next(&state);
        quotients[i % 8] = x / y;
        fold_operations(x, y, z, quotients, folded);
        fold_floats((float)x, (float)y, (float)z, folded);
        if (i % STRIDE == 0)
        {
            fold_functions(x, y, z, folded);
        }
    }
    for (int i = 0; i < (int)CASES; ++i)
    {
        if (folded[i] != cases[i].bits)
        {
            return cases[i].name;
        }
    }
    return NULL;
}
