/* Certain range: how far the lateral position of a line is known.
 *
 * The variance of the lateral position is a polynomial of degree 6 in x. The zeros of each of its
 * derivatives separate those of the one before, so each is found between two of the next one.
 */
#include "propagation.h"

#define DEGREE 6
#define SAMPLES (DEGREE + 1)
#define NEWTON_STEPS 200 ///< most steps to a zero; each that is not Newton's halves the interval

/// Polynomial and its derivative in powers of w.
static double power_value(int degree, const double *a, double w, double *slope)
{
    double value = a[degree];
    *slope = 0.0;
    for (int i = degree - 1; i >= 0; --i)
    {
        *slope = *slope * w + value;
        value = value * w + a[i];
    }
    return value;
}

/// Zero of a polynomial between two places where its signs differ: Newton's method, or halving
/// where that leaves the interval or is slow.
static double zero_between(int degree, const double *a, double low, double high)
{
    double slope;
    const bool rises = power_value(degree, a, low, &slope) < 0.0;
    double w = (low + high) / 2.0;
    double before = high - low;
    double step = before;
    for (int i = 0; i < NEWTON_STEPS; ++i)
    {
        const double value = power_value(degree, a, w, &slope);
        if (value == 0.0)
        {
            break;
        }
        if ((value < 0.0) == rises)
        {
            low = w;
        }
        else
        {
            high = w;
        }
        const double next = w - value / slope;
        const bool is_newton = next > low && next < high && fabs(next - w) < fabs(before) / 2.0;
        const double chosen = is_newton ? next : low + (high - low) / 2.0;
        before = step;
        step = chosen - w;
        if (chosen == w || chosen == low || chosen == high)
        {
            w = chosen;
            break;
        }
        w = chosen;
    }
    return w;
}

/// Zeros of a polynomial from -1 to 1 at which it changes its sign, in ascending order; their
/// number.
static int zeros_of(const double a[SAMPLES], double zeros[DEGREE])
{
    double derivatives[SAMPLES][SAMPLES]; // row k: derivative of order k
    double bounds[DEGREE + 2];
    int count = 0; // zeros of the derivative of the order before
    memcpy(derivatives[0], a, sizeof derivatives[0]);
    for (int k = 1; k < SAMPLES; ++k)
    {
        for (int i = 0; i + k <= DEGREE; ++i)
        {
            derivatives[k][i] = (i + 1) * derivatives[k - 1][i + 1];
        }
    }
    for (int k = DEGREE - 1; k >= 0; --k)
    {
        const double *own = derivatives[k];
        double slope;
        int found = 0;
        bounds[0] = -1.0;
        memcpy(bounds + 1, zeros, (size_t)count * sizeof *zeros);
        bounds[count + 1] = 1.0;
        double value = power_value(DEGREE - k, own, -1.0, &slope);
        for (int i = 0; i <= count; ++i)
        {
            const double next = power_value(DEGREE - k, own, bounds[i + 1], &slope);
            if ((value < 0.0) != (next < 0.0))
            {
                zeros[found] = zero_between(DEGREE - k, own, bounds[i], bounds[i + 1]);
                ++found;
            }
            value = next;
        }
        count = found;
    }
    return count;
}

/// Variance of the lateral position at x.
static double variance_at(const double mean[4], const double cov[16], double x)
{
    const double slope = maplines_tan(mean[1]);
    const double J[4] = {1.0, (1.0 + slope * slope) * x, x * x / 2.0, x * x * x / 6.0};
    double variance = 0.0;
    for (int i = 0; i < 4; ++i)
    {
        double sum = 0.0;
        for (int j = 0; j < 4; ++j)
        {
            sum += J[j] * cov[4 * j + i];
        }
        variance += sum * J[i];
    }
    return variance;
}

/// Coefficients of T_0 .. T_6 in w, from -1 to 1 in a range, of the excess of the variance.
static void excess_of(const double mean[4], const double cov[16], double centre, double half,
                      double limit, double excess[SAMPLES])
{
    static const double nodes[SAMPLES] = {
        // zeros of T_7
        -0x1.f329c0558e969p-1, -0x1.904c37505de4bp-1, -0x1.bc4c04d71abc1p-2, 0.0,
        0x1.bc4c04d71abc1p-2,  0x1.904c37505de4bp-1,  0x1.f329c0558e969p-1};
    for (int j = 0; j < SAMPLES; ++j)
    {
        excess[j] = 0.0;
    }
    for (int k = 0; k < SAMPLES; ++k)
    {
        const double value = variance_at(mean, cov, centre + half * nodes[k]);
        double T[SAMPLES] = {1.0, nodes[k]};
        for (int j = 2; j < SAMPLES; ++j)
        {
            T[j] = 2.0 * nodes[k] * T[j - 1] - T[j - 2];
        }
        for (int j = 0; j < SAMPLES; ++j)
        {
            excess[j] += (j == 0 ? 1.0 : 2.0) / SAMPLES * value * T[j];
        }
    }
    excess[0] -= limit;
}

/// Coefficients of powers of w from those of Chebyshev polynomials.
static void powers_of(const double e[SAMPLES], double a[SAMPLES])
{
    a[0] = e[0] - e[2] + e[4] - e[6];
    a[1] = e[1] - 3.0 * e[3] + 5.0 * e[5];
    a[2] = 2.0 * e[2] - 8.0 * e[4] + 18.0 * e[6];
    a[3] = 4.0 * e[3] - 20.0 * e[5];
    a[4] = 8.0 * e[4] - 48.0 * e[6];
    a[5] = 16.0 * e[5];
    a[6] = 32.0 * e[6];
}

/// Value of a sum of Chebyshev polynomials, by Clenshaw's method.
static double chebyshev_value(const double e[SAMPLES], double w)
{
    double c0 = e[DEGREE - 1];
    double c1 = e[DEGREE];
    for (int i = DEGREE - 2; i >= 0; --i)
    {
        const double c = c0;
        c0 = e[i] - c1;
        c1 = c + c1 * (2.0 * w);
    }
    return c0 + c1 * w;
}

void maplines_certain_range(const double mean[4], const double cov[16], const double x_range[2],
                            double max_sigma, double certain[2])
{
    const double centre = (x_range[0] + x_range[1]) / 2.0;
    const double half = (x_range[1] - x_range[0]) / 2.0;
    double excess[SAMPLES];
    double greatest = 0.0;
    certain[0] = x_range[0];
    certain[1] = x_range[1];
    if (!(max_sigma < (double)INFINITY))
    {
        return;
    }
    excess_of(mean, cov, centre, half, max_sigma * max_sigma, excess);
    for (int j = 1; j < SAMPLES; ++j)
    {
        greatest += fabs(excess[j]);
    }
    if (!(excess[0] + greatest > 0.0)) // no Chebyshev polynomial exceeds 1
    {
        return;
    }
    const double behind = 0.0 > x_range[0] ? 0.0 : x_range[0];
    const double nearest = behind < x_range[1] ? behind : x_range[1];
    const double car = (nearest - centre) / half;
    if (chebyshev_value(excess, car) > 0.0)
    {
        certain[0] = (double)NAN;
        certain[1] = (double)NAN;
        return;
    }
    double powers[SAMPLES];
    double zeros[DEGREE] = {0.0};
    powers_of(excess, powers);
    const int count = zeros_of(powers, zeros);
    for (int i = 0; i < count; ++i)
    {
        const double x = centre + half * zeros[i];
        if (zeros[i] <= car && x > certain[0])
        {
            certain[0] = x;
        }
        if (zeros[i] >= car && x < certain[1])
        {
            certain[1] = x;
        }
    }
}
