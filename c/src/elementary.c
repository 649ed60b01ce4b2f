/* Elementary functions whose results are the same to the last bit on any machine.
 *
 * They have the operations of values/elementary.py in the same order. Of the mathematical library
 * the core takes what IEEE 754 defines to the last bit, which maplines.h lists.
 */
#include "internal.h"

#define TWO_PI 0x1.921fb54442d18p+2

static double polynomial(double x, const double *coefficients, int count)
{
    double total = coefficients[count - 1];
    for (int i = count - 2; i >= 0; --i)
    {
        total = total * x;
        total = total + coefficients[i];
    }
    return total;
}

/// 2^n for n from -1022 to 1023: the exponent of a double that has no other bits.
static double power_of_2(int n)
{
    const uint64_t bits = (uint64_t)(n + 1023) << 52U;
    double power;
    memcpy(&power, &bits, sizeof power);
    return power;
}

/// 2^x for x from -2000 to 2000; others are limited to these. NaN for NaN.
MAPLINES_INTERNAL double maplines_exp2(double x)
{
    static const double coefficients[] = {
        0x1.0000000000000p+0,  0x1.62e42fefa39efp-1,  0x1.ebfbdff82c58fp-3,  0x1.c6b08d704a0c0p-5,
        0x1.3b2ab6fba4e77p-7,  0x1.5d87fe78a6731p-10, 0x1.430912f86c787p-13, 0x1.ffcbfc588b0c7p-17,
        0x1.62c0223a5c824p-20, 0x1.b5253d395e7c4p-24, 0x1.e4cf5158b8ecap-28, 0x1.e8cac7351bb25p-32,
        0x1.c3bd650fc2986p-36, 0x1.816193166d0f9p-40,
    };
    if (x != x)
    {
        return x;
    }
    const double above = x < -2000.0 ? -2000.0 : x;
    const double limited = above > 2000.0 ? 2000.0 : above;
    const double whole = rint(limited);
    const double mantissa = polynomial(limited - whole, coefficients, 14);
    if (whole < -1021.0 || whole > 1023.0)
    {
        return ldexp(mantissa, (int)whole); // it may round, or be infinite
    }
    return mantissa * power_of_2((int)whole);
}

/// Logarithm to base 2; -infinity for 0 and below, NaN for NaN.
MAPLINES_INTERNAL double maplines_log2(double x)
{
    static const double coefficients[] = {
        0x1.71547652b82fep+1, 0x1.ec709dc3a03fdp-1, 0x1.2776c50ef9bfep-1, 0x1.a61762a7aded9p-2,
        0x1.484b13d7c02a9p-2, 0x1.0c9a84994022dp-2, 0x1.c68f568d31760p-3, 0x1.89f3b1694cffep-3,
        0x1.5b9ac9b743f0dp-3, 0x1.3703c1f4d0ffep-3, 0x1.1964ec6fc9491p-3, 0x1.00ecd7e080215p-3,
    };
    if (x <= 0.0)
    {
        return -(double)INFINITY;
    }
    if (!(x < (double)INFINITY))
    {
        return x; // infinite, or NaN
    }
    int exponent = 0;
    double m = frexp(x, &exponent);
    if (m < 0x1.6a09e667f3bcdp-1)
    {
        m = 2.0 * m;
        exponent = exponent - 1;
    }
    const double s = (m - 1.0) / (m + 1.0);
    const double series = s * polynomial(s * s, coefficients, 12);
    return (double)exponent + series;
}

/// Remainder of an angle after division by TWO_PI, with its sign: that of fmod, whose name has a
/// newer version in newer C libraries. No difference rounds: it is of numbers within a factor of 2.
static double without_turns(double x)
{
    double rest = fabs(x);
    double turns = TWO_PI;
    int doublings = 0;
    while (turns <= rest / 2.0)
    {
        turns = 2.0 * turns;
        ++doublings;
    }
    for (; doublings >= 0; --doublings)
    {
        rest = rest >= turns ? rest - turns : rest;
        turns = turns / 2.0;
    }
    return copysign(rest, x);
}

/// Sine and cosine of an angle [rad]; NaN if it is not finite.
MAPLINES_INTERNAL void maplines_sin_cos(double x, double *sine, double *cosine)
{
    static const double of_sine[] = {
        -0x1.5555555555555p-3,  0x1.1111111111111p-7,   -0x1.a01a01a01a01ap-13,
        0x1.71de3a556c734p-19,  -0x1.ae64567f544e4p-26, 0x1.6124613a86d09p-33,
        -0x1.ae7f3e733b81fp-41, 0x1.952c77030ad4ap-49,
    };
    static const double of_cosine[] = {
        -0x1.0000000000000p-1,  0x1.5555555555555p-5,   -0x1.6c16c16c16c17p-10,
        0x1.a01a01a01a01ap-16,  -0x1.27e4fb7789f5cp-22, 0x1.1eed8eff8d898p-29,
        -0x1.93974a8c07c9dp-37, 0x1.ae7f3e733b81fp-45,  -0x1.6827863b97d97p-53,
    };
    if (!(fabs(x) < (double)INFINITY))
    {
        *sine = (double)NAN;
        *cosine = (double)NAN;
        return;
    }
    const double near = fabs(x) > 1e5 ? without_turns(x) : x;
    const double turns = rint(near * 0x1.45f306dc9c883p-1);
    double r = near - turns * 0x1.921fb54400000p+0;
    r = r - turns * 0x1.0b4611a600000p-34;
    r = r - turns * 0x1.3198a2e037073p-69;
    const double r2 = r * r;
    const double cube = (r * r2) * polynomial(r2, of_sine, 8);
    const double s = r + cube;
    const double square = r2 * polynomial(r2, of_cosine, 9);
    const double c = 1.0 + square;
    switch ((int64_t)turns & 3)
    {
    case 0:
        *sine = s;
        *cosine = c;
        break;
    case 1:
        *sine = c;
        *cosine = -s;
        break;
    case 2:
        *sine = -s;
        *cosine = -c;
        break;
    default:
        *sine = -c;
        *cosine = s;
        break;
    }
}

/// Tangent of an angle [rad].
MAPLINES_INTERNAL double maplines_tan(double x)
{
    double sine, cosine;
    maplines_sin_cos(x, &sine, &cosine);
    return sine / cosine;
}

/// Angle of a tangent, from -pi/2 to pi/2 [rad].
MAPLINES_INTERNAL double maplines_atan(double x)
{
    static const double coefficients[] = {
        0x1.0000000000000p+0, -0x1.5555555555555p-2, 0x1.999999999999ap-3, -0x1.2492492492492p-3,
        0x1.c71c71c71c71cp-4, -0x1.745d1745d1746p-4, 0x1.3b13b13b13b14p-4, -0x1.1111111111111p-4,
        0x1.e1e1e1e1e1e1ep-5, -0x1.af286bca1af28p-5, 0x1.8618618618618p-5, -0x1.642c8590b2164p-5,
        0x1.47ae147ae147bp-5,
    };
    const double size = fabs(x);
    const bool is_steep = size > 1.0;
    double t = is_steep ? 1.0 / size : size;
    for (int i = 0; i < 2; ++i) // tan(a / 2) = tan a / (1 + sqrt(1 + tan^2 a))
    {
        const double secant = sqrt(1.0 + t * t);
        t = t / (1.0 + secant);
    }
    double angle = 4.0 * (t * polynomial(t * t, coefficients, 13));
    angle = is_steep ? 0x1.921fb54442d18p+0 - angle : angle;
    return copysign(angle, x);
}
