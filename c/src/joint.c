/* Joint covariances of lines, and what a sum of two lacks to cover a third.
 *
 * J are derivatives of lines with respect to coefficients of T_0 .. T_3 in their ranges, so that
 * all entries of a covariance of these are in metres squared. The operations are those of
 * maplines_can/model/joint.py in the same order.
 */
#include "internal.h"

#if MAPLINES_SENDER && MAPLINES_SCENES

/// Share of D_i by which a sum must exceed what it covers.
static const double joint_slack = 1e-6;
#ifndef MAPLINES_FACTORIZATIONS    // a test has fewer, to see what follows
#define MAPLINES_FACTORIZATIONS 64 // most of them for one direction that lacks
#endif
static const double first_excess = 0x1p-4;
static const double least_excess = 0x1p-40;
static const double farther = 16.0;
static const double nearer = 0x1p-6;
static const double joint_precision = 0x1p-8;
static const double ln_2 = 0x1.62e42fefa39efp-1;

static bool is_finite(int n, const double *values)
{
    for (int i = 0; i < n; ++i)
    {
        if (!(fabs(values[i]) < (double)INFINITY))
        {
            return false;
        }
    }
    return true;
}

/// Cholesky factor of a (4, 4) matrix, if all of it is finite.
static bool finite_factor(const double S[16], double L[16])
{
    return maplines_cholesky_factor(4, S, L) && is_finite(16, L);
}

MAPLINES_INTERNAL void maplines_factor_or_identity(const double S[16], double L[16])
{
    if (!finite_factor(S, L))
    {
        for (int i = 0; i < 16; ++i)
        {
            L[i] = i % 5 == 0 ? 1.0 : 0.0;
        }
    }
}

/// Whether bound I - S is positive definite; L becomes its Cholesky factor.
static bool is_below(int n, const double *S, double bound, double *L)
{
    for (int i = 0; i < n * n; ++i)
    {
        L[i] = -S[i];
    }
    for (int i = 0; i < n * n; i += n + 1)
    {
        L[i] = bound - S[i];
    }
    return maplines_cholesky_factor(n, L, L);
}

/// Sum of the products of the entries of two vectors.
static double dot(int n, const double *a, const double *b)
{
    double terms[MAPLINES_STATES];
    for (int i = 0; i < n; ++i)
    {
        terms[i] = a[i] * b[i];
    }
    return maplines_total(n, terms);
}

static void divide(int n, double *v, double divisor)
{
    for (int i = 0; i < n; ++i)
    {
        v[i] = v[i] / divisor;
    }
}

/// L^-1 e for the unit vector e for which it is the longest. What is above the diagonal of L
/// becomes the transpose of the rest of the inverse.
static void longest_column(int n, double *L, double *longest)
{
    double diagonal[MAPLINES_STATES];
    double largest = -1.0;
    for (int i = 0; i < n; ++i)
    {
        const double *row = L + i * n;
        diagonal[i] = 1.0 / row[i];
        for (int j = 0; j < i; ++j)
        {
            double *column = L + j * n;
            double rest = -(row[j] * diagonal[j]);
            for (int k = j + 1; k < i; ++k)
            {
                const double term = row[k] * column[k];
                rest = rest - term;
            }
            column[i] = rest / row[i];
        }
    }
    for (int i = 0; i < n; ++i)
    {
        double x[MAPLINES_STATES] = {0.0};
        x[i] = diagonal[i];
        memcpy(x + i + 1, L + i * n + i + 1, (size_t)(n - i - 1) * sizeof x[0]);
        const double size = dot(n, x, x);
        if (largest == largest && !(size <= largest)) // the first one; a NaN counts as the largest
        {
            largest = size;
            memcpy(longest, x, (size_t)n * sizeof x[0]);
        }
    }
}

/// v^T S v.
static double rayleigh(int n, const double *S, const double *v)
{
    double image[MAPLINES_STATES];
    for (int i = 0; i < n; ++i)
    {
        image[i] = dot(n, S + i * n, v);
    }
    return dot(n, v, image);
}

/// By how much the largest eigenvalue of an (n, n) matrix S exceeds a bound, and an eigenvector.
///
/// A factorization of s I - S decides whether s exceeds all eigenvalues. If it does, a step of
/// inverse iteration with it gives a vector whose Rayleigh quotient is near the largest one from
/// below. The excess is an upper bound, and before the call a guess. False if it is infinite.
static bool largest_eigenvalue(int n, const double *S, double bound, double *L, double *excess,
                               double *v)
{
    double guess = *excess;
    double low = 0.0;
    double high = (double)INFINITY;
    for (int i = 0; i < MAPLINES_FACTORIZATIONS; ++i)
    {
        if (!is_below(n, S, bound + guess, L))
        {
            low = guess;
            guess = high == (double)INFINITY ? farther * guess : (low + high) / 2.0;
            continue;
        }
        high = guess;
        // The column of the inverse with the largest diagonal entry is nearest to the eigenvector.
        longest_column(n, L, v);
        maplines_upper_solution(n, 1, L, v);
        divide(n, v, sqrt(dot(n, v, v)));
        maplines_lower_solution(n, 1, L, v);
        maplines_upper_solution(n, 1, L, v);
        divide(n, v, sqrt(dot(n, v, v)));
        const double quotient = rayleigh(n, S, v) - bound;
        low = quotient > low ? quotient : low;
        if (high - low <= joint_precision * high || high <= least_excess)
        {
            *excess = high;
            return true;
        }
        guess = low + nearer * (high - low);
    }
    return false;
}

/// diag(W) S diag(W)^T, exactly symmetric.
static void whitened(int lines, double (*W)[16], const double *S, double *out)
{
    const int n = 4 * lines;
    for (int i = 0; i < lines; ++i)
    {
        for (int j = 0; j < lines; ++j)
        {
            double A[16];
            double B[16];
            double C[16];
            for (int row = 0; row < 4; ++row)
            {
                memcpy(A + 4 * row, S + (4 * i + row) * n + 4 * j, 4 * sizeof A[0]);
            }
            maplines_product(4, 4, 4, W[i], A, C);
            maplines_product_transposed(4, 4, 4, C, W[j], B);
            for (int row = 0; row < 4; ++row)
            {
                memcpy(out + (4 * i + row) * n + 4 * j, B + 4 * row, 4 * sizeof B[0]);
            }
        }
    }
    maplines_symmetric(n, out);
}

/// Add what bounds amount v v^T to the blocks of the lines; v is in units of the factors L.
static void add_direction(int lines, double amount, const double *v, double (*L)[16],
                          double (*sizes)[16], double (*lacking)[16])
{
    double weights[MAPLINES_SLOTS];
    double all[MAPLINES_SLOTS];
    for (int i = 0; i < lines; ++i)
    {
        double share[4];
        memcpy(share, v + 4 * i, sizeof share);
        maplines_lower_solution(4, 1, sizes[i], share);
        weights[i] = sqrt(dot(4, share, share)) + 1e-9;
        all[i] = weights[i];
    }
    const double whole = amount * maplines_total(lines, all);
    for (int i = 0; i < lines; ++i)
    {
        double u[4];
        maplines_product(4, 4, 1, L[i], v + 4 * i, u);
        const double scale = whole / weights[i];
        for (int k = 0; k < 16; ++k)
        {
            const double term = scale * (u[k / 4] * u[k % 4]);
            lacking[i][k] = lacking[i][k] + term;
        }
    }
}

/// What the sum of D_i and `spread` lacks, by directions; false if it cannot be compared.
static bool add_directions(int lines, double (*L)[16], double (*sizes)[16], double *excess,
                           double *space, double (*lacking)[16])
{
    const int n = 4 * lines;
    const double bound = 1.0 - joint_slack;
    double guess = first_excess;
    for (int i = 0; i < n; ++i)
    {
        double v[MAPLINES_STATES];
        if (!largest_eigenvalue(n, excess, bound, space, &guess, v))
        {
            return false;
        }
        const double amount = guess + joint_slack;
        add_direction(lines, amount, v, L, sizes, lacking);
        for (int row = 0; row < n; ++row)
        {
            const double scaled = amount * v[row];
            double *const entries = excess + row * n;
            for (int k = 0; k < n; ++k)
            {
                const double term = scaled * v[k];
                entries[k] = entries[k] - term;
            }
        }
        if (is_below(n, excess, bound, space))
        {
            break;
        }
    }
    return true;
}

MAPLINES_INTERNAL bool maplines_uncovered(int lines, const double *rest, double (*spread)[16],
                                          double (*own)[16], double (*J)[16],
                                          maplines_joint_space_t *space, double (*lacking)[16])
{
    const int n = 4 * lines;
    double L[MAPLINES_SLOTS][16];
    double W[MAPLINES_SLOTS][16];
    double sizes[MAPLINES_SLOTS][16];
    bool is_definite = true;
    for (int i = 0; i < lines; ++i)
    {
        double D[16];
        maplines_inverse(J[i], W[i]);
        maplines_congruence(W[i], own[i], D);
        const bool has_factor = finite_factor(D, L[i]);
        is_definite = is_definite && has_factor;
        for (int k = 0; k < 16; ++k)
        {
            lacking[i][k] = has_factor ? 0.0 : (double)NAN;
        }
    }
    if (!is_definite)
    {
        return true;
    }
    for (int i = 0; i < lines; ++i)
    {
        maplines_lower_solution(4, 4, L[i], W[i]);
    }
    whitened(lines, W, rest, space->excess);
    if (is_below(n, space->excess, 1.0 - joint_slack, space->factor))
    {
        return false;
    }
    for (int i = 0; i < lines; ++i)
    {
        double whole[16];
        maplines_congruence(W[i], spread[i], whole);
        for (int k = 0; k < 16; k += 5)
        {
            whole[k] = 1.0 + whole[k];
        }
        maplines_factor_or_identity(whole, sizes[i]); // a spread of 1e16 times D_i may have none
    }
    const bool is_comparable =
        add_directions(lines, L, sizes, space->excess, space->factor, lacking);
    for (int i = 0; i < lines; ++i)
    {
        double sum[16];
        memcpy(sum, lacking[i], sizeof sum);
        maplines_congruence(J[i], sum, lacking[i]);
        lacking[i][0] = is_comparable ? lacking[i][0] : (double)NAN;
    }
    return true;
}

/// Variances of the lateral position at nine places of the range, and of the direction there:
/// weights of the entries of the lower triangle, row by row.
static const double variance_weights[10][MAPLINES_VARIANCES] = {
    {1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0},
    {-2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0},
    {1.0, 0.5625, 0.25, 0.0625, 0.0, 0.0625, 0.25, 0.5625, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0,
     1.0, 1.0},
    {2.0, 0.25, -1.0, -1.75, -2.0, -1.75, -1.0, 0.25, 2.0, -0.0, -0.0, -0.0, -0.0, 0.0, 0.0, 0.0,
     0.0, 0.0},
    {-2.0, -0.1875, 0.5, 0.4375, -0.0, -0.4375, -0.5, 0.1875, 2.0, -8.0, -6.0, -4.0, -2.0, 0.0, 2.0,
     4.0, 6.0, 8.0},
    {1.0, 0.015625, 0.25, 0.765625, 1.0, 0.765625, 0.25, 0.015625, 1.0, 16.0, 9.0, 4.0, 1.0, 0.0,
     1.0, 4.0, 9.0, 16.0},
    {-2.0, 1.125, 2.0, 1.375, -0.0, -1.375, -2.0, -1.125, 2.0, 0.0, 0.0, 0.0, -0.0, -0.0, -0.0, 0.0,
     0.0, 0.0},
    {2.0, -0.84375, -1.0, -0.34375, -0.0, -0.34375, -1.0, -0.84375, 2.0, 18.0, 7.5, 0.0, -4.5, -6.0,
     -4.5, 0.0, 7.5, 18.0},
    {-2.0, 0.140625, -1.0, -1.203125, 0.0, 1.203125, 1.0, -0.140625, 2.0, -72.0, -22.5, -0.0, 4.5,
     -0.0, -4.5, 0.0, 22.5, 72.0},
    {1.0, 0.31640625, 1.0, 0.47265625, 0.0, 0.47265625, 1.0, 0.31640625, 1.0, 81.0, 14.0625, 0.0,
     5.0625, 9.0, 5.0625, 0.0, 14.0625, 81.0},
};

/// Variances of lateral position and direction at places of the range.
static void variances_of(const double cov[16], double variances[MAPLINES_VARIANCES])
{
    static const int entries[10] = {0, 4, 5, 8, 9, 10, 12, 13, 14, 15};
    for (int place = 0; place < MAPLINES_VARIANCES; ++place)
    {
        variances[place] = 0.0;
    }
    for (int i = 0; i < 10; ++i)
    {
        const double entry = cov[entries[i]];
        for (int place = 0; place < MAPLINES_VARIANCES; ++place)
        {
            const double term = variance_weights[i][place] * entry;
            variances[place] = variances[place] + term;
        }
    }
}

MAPLINES_INTERNAL void maplines_compare_with(const double cov[16], maplines_reference_t *reference)
{
    reference->is_definite = maplines_cholesky_factor(4, cov, reference->factor);
    variances_of(cov, reference->variances);
}

MAPLINES_INTERNAL bool maplines_compared(const maplines_reference_t *reference,
                                         const double decoded[16], double *by_trace, double *ratio)
{
    double L[16];
    if (!reference->is_definite || !maplines_cholesky_factor(4, decoded, L))
    {
        return false;
    }
    const double *G = reference->factor;
    double trace = 0.0;
    *ratio = 1.0;
    for (int j = 0; j < 4; ++j)
    {
        double Y[4];
        for (int i = j; i < 4; ++i)
        {
            double rest = G[4 * i + j];
            for (int k = j; k < i; ++k)
            {
                const double term = L[4 * i + k] * Y[k];
                rest = rest - term;
            }
            Y[i] = rest / L[5 * i];
            const double square = Y[i] * Y[i];
            trace = trace + square;
        }
        const double step = L[5 * j] / G[5 * j];
        *ratio = *ratio * step;
    }
    *by_trace = (trace - 4.0) / 2.0;
    return true;
}

MAPLINES_INTERNAL double maplines_divergence(const maplines_reference_t *reference,
                                             const double decoded[16])
{
    double by_trace;
    double ratio;
    if (!maplines_compared(reference, decoded, &by_trace, &ratio))
    {
        return (double)INFINITY;
    }
    const double divergence = by_trace + ln_2 * maplines_log2(ratio);
    return fabs(divergence) < (double)INFINITY ? divergence : (double)INFINITY;
}

MAPLINES_INTERNAL double maplines_largest_ratio(const maplines_reference_t *reference,
                                                const double decoded[16])
{
    double variances[MAPLINES_VARIANCES];
    variances_of(decoded, variances);
    double largest = variances[0] / reference->variances[0];
    for (int place = 1; place < MAPLINES_VARIANCES; ++place)
    {
        const double ratio = variances[place] / reference->variances[place];
        if (largest == largest && !(ratio <= largest)) // a NaN remains
        {
            largest = ratio;
        }
    }
    return largest;
}

#endif
