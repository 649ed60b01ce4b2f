/* Cubics as lines: from their coefficients, through points by least squares, from another pose.
 *
 * It has the operations of model/lines.py in the same order.
 */
#include "internal.h"

#define MAPLINES_STEEPEST 0x1.72fd9ee590ffbp+2 ///< greatest slope of a line: 80 deg to the x axis
#define MAPLINES_END_WEIGHT 0.62 ///< of both ends in a fit; that of the other points is 1
#define MAPLINES_HALF_PI 0x1.921fb54442d18p+0

// Extrema of a Chebyshev polynomial, and what a fitted cubic leaves of T_4 there.
static const double cubic_nodes[MAPLINES_FIT_POINTS] = {
    0x1.0000000000000p+0,  0x1.f4cfc327a0080p-1,  0x1.d3bc3aeff7f95p-1,  0x1.9e3779b97f4a8p-1,
    0x1.5698496e20bd9p-1,  0x1.0000000000001p-1,  0x1.3c6ef372fe950p-2,  0x1.ac2609b3c576ap-4,
    -0x1.ac2609b3c5762p-4, -0x1.3c6ef372fe94ep-2, -0x1.ffffffffffffcp-2, -0x1.5698496e20bd5p-1,
    -0x1.9e3779b97f4a7p-1, -0x1.d3bc3aeff7f96p-1, -0x1.f4cfc327a0080p-1, -0x1.0000000000000p+0,
};
#if MAPLINES_HAS_QUARTIC
static const double cubic_quartic[MAPLINES_FIT_POINTS] = {
    0x1.e88cb3c9484e1p-1,  0x1.407eff5342356p-1,  -0x1.1f2f63cdee8cfp-3, -0x1.aadd5272f2913p-1,
    -0x1.fafe849559e76p-1, -0x1.0000000000003p-1, 0x1.46187216c0013p-2,  0x1.db35df2fb6827p-1,
    0x1.db35df2fb6828p-1,  0x1.46187216c0015p-2,  -0x1.ffffffffffff4p-2, -0x1.fafe849559e74p-1,
    -0x1.aadd5272f2917p-1, -0x1.1f2f63cdee8c3p-3, 0x1.407eff5342350p-1,  0x1.e88cb3c9484ddp-1,
};
#endif

/// Sum over the points of products of two factors, in the order of maplines_total.
static double sum_of_products(const double a[MAPLINES_FIT_POINTS],
                              const double b[MAPLINES_FIT_POINTS])
{
    double terms[MAPLINES_FIT_POINTS / 2];
    for (int i = 0; i < MAPLINES_FIT_POINTS / 2; ++i)
    {
        const int other = i + MAPLINES_FIT_POINTS / 2;
        const double first = a[i] * b[i];
        const double second = a[other] * b[other];
        terms[i] = first + second;
    }
    for (int i = 0; i < 4; ++i)
    {
        terms[i] = terms[i] + terms[i + 4];
    }
    return terms[0] + terms[2] + (terms[1] + terms[3]);
}

/// Coefficients of w^0 to w^3 of the cubic that is fitted to values at w; rest is overwritten.
///
/// By polynomials p that are orthogonal on the points, with the coefficients c.
static void fit_cubic(const double w[MAPLINES_FIT_POINTS], double rest[MAPLINES_FIT_POINTS],
                      double q[4])
{
    static const int last = MAPLINES_FIT_POINTS - 1;
    double p[MAPLINES_FIT_POINTS];
    double p_before[MAPLINES_FIT_POINTS];
    double weighted[MAPLINES_FIT_POINTS];
    double by_w[MAPLINES_FIT_POINTS];
    double c[4] = {1.0, 0.0, 0.0, 0.0};
    double c_before[4] = {0.0, 0.0, 0.0, 0.0};
    double norm_before = (double)INFINITY;
    for (int i = 0; i < MAPLINES_FIT_POINTS; ++i)
    {
        p[i] = 1.0;
        p_before[i] = 0.0;
    }
    memset(q, 0, 4 * sizeof(double));
    for (int degree = 0; degree < 4; ++degree)
    {
        memcpy(weighted, p, sizeof weighted);
        weighted[0] = MAPLINES_END_WEIGHT * p[0];
        weighted[last] = MAPLINES_END_WEIGHT * p[last];
        const double norm = sum_of_products(weighted, p);
        const double share = sum_of_products(weighted, rest) / norm;
        for (int i = 0; i < 4; ++i)
        {
            const double fitted = share * c[i];
            q[i] = q[i] + fitted;
        }
        if (degree == 3)
        {
            break;
        }
        for (int i = 0; i < MAPLINES_FIT_POINTS; ++i)
        {
            by_w[i] = w[i] * p[i];
        }
        const double a = sum_of_products(weighted, by_w) / norm;
        const double b = norm / norm_before;
        for (int i = 0; i < MAPLINES_FIT_POINTS; ++i)
        {
            const double fitted = share * p[i];
            const double raised = (w[i] - a) * p[i];
            const double lower = b * p_before[i];
            rest[i] = rest[i] - fitted;
            p_before[i] = p[i];
            p[i] = raised - lower;
        }
        double below = 0.0; // coefficient of the power before
        for (int i = 0; i < 4; ++i)
        {
            const double shifted = a * c[i];
            const double lower = b * c_before[i];
            const double raised = below - shifted;
            below = c[i];
            c_before[i] = c[i];
            c[i] = raised - lower;
        }
        norm_before = norm;
    }
}

MAPLINES_INTERNAL void maplines_derivatives(const double q[4], double centre, double half,
                                            double values[4])
{
    const double r = 1.0 / half;
    const double w = -centre * r;
    // Horner's scheme, repeated, gives the Taylor coefficients at w.
    const double q3_w = q[3] * w;
    const double value2 = q[2] + q3_w;
    const double w_value2 = w * value2;
    const double value1 = q[1] + w_value2;
    const double slope2 = value2 + q3_w;
    const double w_value1 = w * value1;
    const double w_slope2 = w * slope2;
    const double r2 = 2.0 * r * r;
    values[0] = q[0] + w_value1;
    values[1] = (value1 + w_slope2) * r;
    values[2] = (slope2 + q3_w) * r2;
    values[3] = q[3] * (3.0 * r2 * r);
}

MAPLINES_INTERNAL MAPLINES_APART double maplines_middle(const double range[2])
{
    return (range[0] + range[1]) / 2.0;
}

MAPLINES_INTERNAL MAPLINES_APART double maplines_half(const double range[2])
{
    return (range[1] - range[0]) / 2.0;
}

MAPLINES_INTERNAL double maplines_lateral(const double mean[4], double slope, double x)
{
    const double cubic = x * mean[3] / 6.0;
    const double square = x * (mean[2] / 2.0 + cubic);
    const double linear = x * (slope + square);
    return mean[0] + linear;
}

MAPLINES_INTERNAL void maplines_lateral_gradient(double slope, double x, double J[4])
{
    const double square = x * x;
    J[0] = 1.0;
    J[1] = (1.0 + slope * slope) * x;
    J[2] = square / 2.0;
    J[3] = square * x / 6.0;
}

MAPLINES_INTERNAL void maplines_points_of(const maplines_curve_t *curve, maplines_points_t *points)
{
    const double centre = maplines_middle(curve->fit_range);
    const double half = maplines_half(curve->fit_range);
    const double beta = curve->mean[1];
    const double slope = fabs(beta) < MAPLINES_HALF_PI ? maplines_tan(beta) : (double)NAN;
    for (int i = 0; i < MAPLINES_FIT_POINTS; ++i)
    {
        const double offset = half * cubic_nodes[i];
        const double x = centre + offset;
        points->x[i] = x;
        points->y[i] = maplines_lateral(curve->mean, slope, x);
#if MAPLINES_HAS_QUARTIC
        const double bend = curve->quartic * cubic_quartic[i];
        points->y[i] = points->y[i] + bend;
#endif
    }
}

MAPLINES_INTERNAL bool maplines_is_function(const maplines_points_t *points)
{
    const double length = points->x[MAPLINES_FIT_POINTS - 1] - points->x[0];
    const double sign = length > 0.0 ? 1.0 : -1.0;
    for (int i = 0; i + 1 < MAPLINES_FIT_POINTS; ++i)
    {
        const double advance = (points->x[i + 1] - points->x[i]) * sign;
        const double aside = fabs(points->y[i + 1] - points->y[i]);
        if (!(aside < MAPLINES_STEEPEST * advance)) // or NaN
        {
            return false;
        }
    }
    return true;
}

MAPLINES_INTERNAL void maplines_refitted(const maplines_points_t *points, const double pose[3],
                                         double line[4])
{
    double sine;
    double cosine;
    maplines_sin_cos(pose[2], &sine, &cosine);
    maplines_points_t seen;
    for (int i = 0; i < MAPLINES_FIT_POINTS; ++i)
    {
        const double s = points->x[i] - pose[0];
        const double t = points->y[i] - pose[1];
        const double c_s = cosine * s;
        const double d_t = sine * t;
        const double c_t = cosine * t;
        const double d_s = sine * s;
        seen.x[i] = c_s + d_t;
        seen.y[i] = c_t - d_s;
    }
    if (!maplines_is_function(&seen))
    {
        for (int i = 0; i < 4; ++i)
        {
            line[i] = (double)NAN;
        }
        return;
    }
    const double first = seen.x[0];
    const double last = seen.x[MAPLINES_FIT_POINTS - 1];
    const double centre = (first + last) / 2.0;
    const double half = fabs(first - last) / 2.0;
    for (int i = 0; i < MAPLINES_FIT_POINTS; ++i)
    {
        seen.x[i] = (seen.x[i] - centre) / half;
    }
    double q[4];
    fit_cubic(seen.x, seen.y, q);
    maplines_derivatives(q, centre, half, line);
    line[1] = maplines_atan(line[1]);
}
