/* Lines as functions of the pose from which they are seen.
 *
 * It has the operations of model/lines.py in the same order.
 */
#include "internal.h"

#if MAPLINES_SCENES

#define MAPLINES_MARGIN 3.0 ///< standard deviations of the pose error at an end of a range

/// As maplines_bases, for a line with this tangent of beta.
static void set_bases(double tangent, const double fit_range[2], double J[16])
{
    const double centre = maplines_middle(fit_range);
    const double half = maplines_half(fit_range);
    const double by_x = 1.0 / half;
    const double w = -centre * by_x; // at x = 0
    const double w_w = w * w;
    const double square = tangent * tangent;
    const double by_slope = by_x / (1.0 + square);
    const double twice = by_x * by_x;
    const double rows[4][4] = {
        {1.0, w, 2.0 * w_w - 1.0, w * (4.0 * w_w - 3.0)}, // T_k, and its derivatives
        {0.0, by_slope, by_slope * 4.0 * w, by_slope * (12.0 * w_w - 3.0)},
        {0.0, 0.0, 4.0 * twice, 24.0 * w * twice},
        {0.0, 0.0, 0.0, 24.0 * (twice * by_x)},
    };
    memcpy(J, rows, sizeof rows);
}

MAPLINES_INTERNAL void maplines_bases(const double mean[4], const double fit_range[2], double J[16])
{
    set_bases(maplines_tan(mean[1]), fit_range, J);
}

/* ---- lines seen from other poses --------------------------------------------------------------
 *
 * A car that is a further along, b further across and turned by t sees the point (x, y) of a line
 * at (x + u1 + u2, y + v1 + v2), with the terms of first and of second order
 *
 *     u1 = t y - a,     u2 = -t b - t^2 x / 2
 *     v1 = -t x - b,    v2 =  t a - t^2 y / 2
 *
 * The line is a cubic p, with the slope m and the second derivative k, and a rest r. From there,
 * the cubic is p + p1 + p2. With F(v) the fit of a cubic to values v at the points of the line, and
 * M(v) what moving the points along x by 1 m each changes of it, if v is left by a fit,
 *
 *     f1 = v1 - m u1,                                  p1 = F(f1) + M(u1 r)
 *     f2 = v2 - m u2 - k u1^2 / 2 - p1' u1,            p2 = F(f2) + M(u1 (f1 - p1))
 *
 * What moves r by second order is neglected. F is orthogonal on the roots of T_8.
 */

#define MAPLINES_ROOTS 8

/// Those of T_8 that are positive, from the greatest on; and T_2 and T_3 there.
static const double roots[3][MAPLINES_ROOTS / 2] = {
    {0x1.f6297cff75cb0p-1, 0x1.a9b66290ea1a3p-1, 0x1.1c73b39ae68c9p-1, 0x1.8f8b83c69a60cp-3},
    {0x1.d906bcf328d46p-1, 0x1.87de2a6aea964p-2, -0x1.87de2a6aea960p-2, -0x1.d906bcf328d46p-1},
    {0x1.a9b66290ea1a2p-1, -0x1.8f8b83c69a608p-3, -0x1.f6297cff75cb0p-1, -0x1.1c73b39ae68cap-1},
};

/// T_k, for k from 1 to 3, at root i of all, from 1 to -1.
static MAPLINES_APART double at_root(int k, int i)
{
    const int mirrored = MAPLINES_ROOTS - 1 - i;
    const bool is_mirrored = i > mirrored;
    const double value = roots[k - 1][is_mirrored ? mirrored : i];
    return is_mirrored && k % 2 == 1 ? -value : value;
}

/// Coefficients of T_0 .. T_3 of the cubic that is fitted to values at the roots, from 1 to -1.
static void project(const double values[MAPLINES_ROOTS], double coefficients[4])
{
    double sums[4] = {0.0, 0.0, 0.0, 0.0};
    for (int i = 0; i < MAPLINES_ROOTS / 2; ++i)
    {
        const double even = values[i] + values[MAPLINES_ROOTS - 1 - i];
        const double odd = values[i] - values[MAPLINES_ROOTS - 1 - i];
        const double terms[4] = {even, odd * roots[0][i], even * roots[1][i], odd * roots[2][i]};
        for (int k = 0; k < 4; ++k)
        {
            sums[k] = sums[k] + terms[k];
        }
    }
    for (int k = 0; k < 4; ++k)
    {
        coefficients[k] = sums[k] / (k == 0 ? 8.0 : 4.0);
    }
}

/// Add M of values at the roots; by_x is 1 over half of the length of the range [1/m].
static void add_moved(const double values[MAPLINES_ROOTS], double by_x, double coefficients[4])
{
    double c[4];
    project(values, c);
    // T_1' = T_0, T_2' = 4 T_1 and T_3' = 6 T_2 + 3 T_0; T_0 has twice the norm of the others.
    const double more[4] = {0.0, 2.0 * c[0], 4.0 * c[1], 6.0 * (c[2] + c[0])};
    for (int i = 1; i < 4; ++i)
    {
        const double term = more[i] * by_x;
        coefficients[i] = coefficients[i] + term;
    }
}

MAPLINES_INTERNAL MAPLINES_APART void maplines_changes_of(const maplines_curve_t *curve,
                                                          maplines_changes_t *changes)
{
    const double centre = maplines_middle(curve->fit_range);
    const double half = maplines_half(curve->fit_range);
    const double by_x = 1.0 / half;
    const double *mean = curve->mean;
    const double tangent = maplines_tan(mean[1]);
    const double sixth = mean[3] / 6.0;
    double y[MAPLINES_ROOTS];
    double along[MAPLINES_ROOTS];
    double heading[MAPLINES_ROOTS];         // f1
    double heading_squared[MAPLINES_ROOTS]; // f2
    double along_squared[MAPLINES_ROOTS];
    double left[MAPLINES_ROOTS]; // by a fit, times y
    for (int i = 0; i < MAPLINES_ROOTS; ++i)
    {
        const double offset = half * at_root(1, i);
        const double x = centre + offset;
        const double bend = x * mean[3];
        const double k = mean[2] + bend;
        const double to_m = x * (mean[2] + bend / 2.0);
        const double m = tangent + to_m;
        const double cubic = x * sixth;
        const double to_slope = x * (mean[2] / 2.0 + cubic);
        const double to_p = x * (tangent + to_slope);
        const double p = mean[0] + to_p;
        y[i] = p;
#if MAPLINES_HAS_QUARTIC
        const double square = at_root(2, i) * at_root(2, i);
        const double r = curve->quartic * (2.0 * square - 1.0); // T_4 = 2 T_2^2 - 1
        y[i] = y[i] + r;
        left[i] = r * y[i];
#endif
        const double m_y = m * y[i];
        const double m_x = m * x;
        const double k_y_y = k * y[i] * y[i];
        along[i] = m;
        heading[i] = -(x + m_y);
        heading_squared[i] = (m_x - y[i] - k_y_y) / 2.0;
        along_squared[i] = k / 2.0;
    }
    set_bases(tangent, curve->fit_range, changes->J);
    changes->tangent = tangent;
    double *c = changes->rows[2];
    project(along, changes->rows[0]);
    project(heading, c);
#if MAPLINES_HAS_QUARTIC
    add_moved(left, by_x, c);
#endif
    for (int i = 0; i < MAPLINES_ROOTS; ++i)
    {
        const double first = c[1] * at_root(1, i);
        const double second = c[2] * at_root(2, i);
        const double third = c[3] * at_root(3, i);
        const double odd = first + third;
        const double even = c[0] + second;
        const double slope_second = c[3] * (6.0 * at_root(2, i) + 3.0);
        const double slope_first = 4.0 * c[2] * at_root(1, i);
        const double slope_even = c[1] + slope_second;
        const double turned = (slope_even + slope_first) * by_x * y[i];
        heading_squared[i] = heading_squared[i] - turned;
        left[i] = (heading[i] - (even + odd)) * y[i];
    }
    project(heading_squared, changes->rows[3]);
    add_moved(left, by_x, changes->rows[3]);
    const double from_third = 3.0 * c[3];
    const double slope[4] = {(c[1] + from_third) * by_x, 4.0 * c[2] * by_x, 6.0 * c[3] * by_x, 0.0};
    project(along_squared, changes->rows[6]);
    for (int i = 0; i < 4; ++i)
    {
        changes->rows[1][i] = i == 0 ? -1.0 : 0.0;
        changes->rows[4][i] = i == 0 ? 1.0 + slope[0] : slope[i];
        changes->rows[5][i] = changes->rows[0][i];
    }
}

MAPLINES_INTERNAL void maplines_line_changes(const maplines_changes_t *changes, double W[7][4])
{
    for (int j = 0; j < 7; ++j)
    {
        for (int i = 0; i < 4; ++i)
        {
            // J is upper triangular
            W[j][i] = maplines_inner(4 - i, changes->J + 5 * i, 1, changes->rows[j] + i, 1);
        }
    }
    // The second derivative of atan, by the direction; it does not change with the place across.
    const double by_heading = changes->tangent * W[2][1];
    const double by_along = changes->tangent * W[0][1];
    const double squares[3] = {by_heading * W[2][1], by_heading * W[0][1], by_along * W[0][1]};
    W[3][1] = W[3][1] - squares[0];
    W[4][1] = W[4][1] - 2.0 * squares[1];
    W[6][1] = W[6][1] - squares[2];
}

/// Root of a value that is not negative but for rounding; of NaN, NaN.
static double root_of(double square)
{
    return square < 0.0 ? 0.0 : sqrt(square);
}

MAPLINES_INTERNAL MAPLINES_APART void maplines_pose_root(const double P[9],
                                                         maplines_pose_root_t *root)
{
    static const uint8_t factors[4][2] = {{2, 2}, {2, 0}, {2, 1}, {0, 0}}; // of the second order
    memset(root, 0, sizeof *root);
    double(*L)[3] = root->first;
    for (int i = 0; i < 3; ++i)
    {
        for (int k = 0; k <= i; ++k)
        {
            double rest = P[3 * i + k];
            for (int j = 0; j < k; ++j)
            {
                const double term = L[i][j] * L[k][j];
                rest = rest - term;
            }
            if (k == i)
            {
                L[i][i] = root_of(rest);
            }
            else if (L[k][k] > 0.0)
            {
                L[i][k] = rest / L[k][k];
            }
            else
            {
                // the error of k has no share in that of i
            }
        }
    }
    const double share = 1.0 / sqrt(3.0);
    for (int i = 0; i < 4; ++i)
    {
        double *row = root->second[i];
        double sum = 0.0;
        for (int k = 0; k < 3; ++k)
        {
            row[k] = L[factors[i][0]][k] * L[factors[i][1]][k];
            sum = sum + row[k];
        }
        for (int k = 0; k < 3; ++k)
        {
            row[k] = (3.0 * row[k] - sum) * share;
        }
        row[3] = sqrt(2.0) * sum;
    }
}

MAPLINES_INTERNAL MAPLINES_APART bool maplines_spread(const maplines_changes_t *changes,
                                                      const maplines_pose_root_t *root,
                                                      double A[4][MAPLINES_COLUMNS])
{
    double W[7][4];
    bool is_finite = true;
    maplines_line_changes(changes, W);
    for (int i = 0; i < 4; ++i)
    {
        for (int k = 0; k < 3; ++k)
        {
            A[i][k] = maplines_inner(3 - k, &W[k][i], 4, &root->first[k][k], 3);
        }
        for (int k = 0; k < 4; ++k)
        {
            A[i][3 + k] = maplines_inner(4, &W[3][i], 4, &root->second[0][k], 4);
        }
        for (int k = 0; k < MAPLINES_COLUMNS; ++k)
        {
            is_finite = is_finite && fabs(A[i][k]) < (double)INFINITY;
        }
    }
    return is_finite;
}

MAPLINES_INTERNAL void maplines_common(const maplines_changes_t *changes, double offset_sigma,
                                       double heading_sigma, double cov[16])
{
    const double sigmas[3] = {offset_sigma, offset_sigma, heading_sigma};
    double K[12];
    for (int i = 0; i < 4; ++i)
    {
        for (int j = 0; j < 3; ++j)
        {
            K[3 * i + j] = changes->rows[j][i] * sigmas[j];
        }
    }
    maplines_gram(4, 3, K, cov);
    for (int i = 0; i < 16; i += 5)
    {
        cov[i] = cov[i] + MAPLINES_RESOLUTION * MAPLINES_RESOLUTION;
    }
}

/* ---- valid ranges -----------------------------------------------------------------------------
 */

MAPLINES_INTERNAL void maplines_valid_range(const maplines_curve_t *curve, const double P[9],
                                            const double specific_cov[16], double heading_sigma,
                                            double range[2])
{
    const double *mean = curve->mean;
    const double slope = maplines_tan(mean[1]);
    const double middle = maplines_middle(curve->fit_range);
    double J[4];
    double J_cov[4];
    maplines_lateral_gradient(slope, middle, J);
    maplines_product(1, 4, 4, J, specific_cov, J_cov);
    const double shift = maplines_inner(4, J_cov, 1, J, 1); // variance of y in the middle
    const double along = P[0] + shift;
    const double heading = P[8] + heading_sigma * heading_sigma;
    const double turn = MAPLINES_MARGIN * sqrt(heading);
    double sine;
    double cosine;
    maplines_sin_cos(turn < 0x1.921fb54442d18p+0 ? turn : 0x1.921fb54442d18p+0, &sine, &cosine);
    // A turned car sees the end of a line at x at about x cos(turn), which is nearer.
    const double shortening = 1.0 - cosine;
    for (int end = 0; end < 2; ++end)
    {
        const double x = curve->fit_range[end];
        const double y = maplines_lateral(mean, slope, x);
        const double by_both = 2.0 * y * P[2];
        const double by_heading = y * y * heading;
        const double variance = along - by_both + by_heading;
        const double sigma = sqrt(variance > 0.0 ? variance : 0.0);
        const double margin = MAPLINES_MARGIN * sigma + shortening * fabs(x);
        range[end] = end == 0 ? x + margin : x - margin;
    }
}

#endif
