/* Covariances of a caller: what is wrong with one, and the nearest one if it is indefinite. The
 * operations are those of model/covariance.py in the same order.
 */
#include "internal.h"

#if MAPLINES_SENDER && MAPLINES_LINE_RECORDS

#define MAX_COVARIANCE 1e307

/// Standard deviations, with 1 in place of 0.
static void scale_of(const double S[16], double scale[4])
{
    for (int i = 0; i < 4; ++i)
    {
        scale[i] = sqrt(S[5 * i] > 0.0 ? S[5 * i] : 1.0);
    }
}

MAPLINES_INTERNAL maplines_refusal_t maplines_check_covariance(const double S[16], double rounding)
{
    double scale[4];
    for (int i = 0; i < 16; ++i)
    {
        if (!(fabs(S[i]) <= MAX_COVARIANCE))
        {
            return MAPLINES_BAD_COVARIANCE;
        }
    }
    for (int i = 0; i < 4; ++i)
    {
        if (S[5 * i] < 0.0)
        {
            return MAPLINES_BAD_VARIANCE;
        }
    }
    scale_of(S, scale);
    for (int i = 0; i < 4; ++i)
    {
        for (int j = 0; j < 4; ++j)
        {
            if (fabs(S[4 * i + j] - S[4 * j + i]) > rounding * scale[i] * scale[j])
            {
                return MAPLINES_ASYMMETRIC;
            }
        }
    }
    return MAPLINES_SENT;
}

MAPLINES_INTERNAL bool maplines_is_indefinite(const double S[16], double rounding)
{
    double scale[4];
    double L[4][4];
    bool is_bad = false;
    scale_of(S, scale);
    for (int i = 0; i < 4; ++i)
    {
        double squares = 0.0;
        for (int j = 0; j < i; ++j)
        {
            double sum = 0.0;
            for (int k = 0; k < j; ++k)
            {
                const double term = L[i][k] * L[j][k];
                sum = sum + term;
            }
            const double rest = S[4 * i + j] / (scale[i] * scale[j]) - sum;
            L[i][j] = rest / L[j][j];
        }
        for (int j = 0; j < i; ++j)
        {
            const double square = L[i][j] * L[i][j];
            squares = squares + square;
        }
        const double variance = S[5 * i] / (scale[i] * scale[i]);
        const double pivot = variance + rounding - squares;
        is_bad = is_bad || !(pivot > 0.0);
        L[i][i] = sqrt(pivot);
    }
    return is_bad;
}

/// Positive semidefinite matrix that covers S, nearest in units of a scale.
static void nearest_in_scale(const double S[16], const double scale[4], double nearest[16])
{
    double E[16];
    double V[16];
    double scaled[16];
    double values[4];
    double least = 0.0;
    for (int i = 0; i < 16; ++i)
    {
        E[i] = S[i] / (scale[i / 4] * scale[i % 4]);
    }
    maplines_eigen(4, E, values, V);
    for (int i = 0; i < 4; ++i)
    {
        least = values[i] < least ? values[i] : least;
    }
    if (!(least < 0.0))
    {
        memcpy(nearest, S, 16 * sizeof(double));
        return;
    }
    for (int i = 0; i < 16; ++i)
    {
        const double value = values[i % 4];
        scaled[i] = V[i] * (value > 0.0 ? value : 0.0);
    }
    maplines_product_transposed(4, 4, 4, scaled, V, nearest);
    maplines_symmetric(4, nearest);
    for (int i = 0; i < 16; ++i)
    {
        nearest[i] = nearest[i] * (scale[i / 4] * scale[i % 4]);
    }
}

/// As scale_of, but with a variable of zero variance in the scale of its covariances.
static void scale_of_any(const double S[16], double scale[4])
{
    double of_variances[4];
    scale_of(S, of_variances);
    for (int i = 0; i < 4; ++i)
    {
        double largest = 0.0;
        for (int j = 0; j < 4; ++j)
        {
            const double size = fabs(S[4 * i + j]);
            const double other = S[5 * j] > 0.0 ? of_variances[j] : sqrt(size);
            const double share = other > 0.0 ? size / other : 0.0;
            largest = share > largest ? share : largest;
        }
        scale[i] = S[5 * i] <= 0.0 && largest > 0.0 ? largest : of_variances[i];
    }
}

MAPLINES_INTERNAL void maplines_nearest_covariance(const double S[16], double nearest[16])
{
    double scale[4];
    bool is_hidden = false; // covariances of a zero variance, so small that rounding hides them
    scale_of(S, scale);
    nearest_in_scale(S, scale, nearest);
    for (int i = 0; i < 16; ++i)
    {
        const bool is_empty = !(nearest[5 * (i / 4)] > 0.0);
        is_hidden = is_hidden || (is_empty && (nearest[i] > 0.0 || nearest[i] < 0.0));
    }
    if (is_hidden)
    {
        scale_of_any(S, scale);
        nearest_in_scale(S, scale, nearest);
    }
    bool is_lost = false; // variances beside covariances many times larger than they admit
    for (int i = 0; i < 4; ++i)
    {
        is_lost = is_lost || nearest[5 * i] < S[5 * i] / 2.0;
    }
    if (is_lost)
    {
        for (int i = 0; i < 16; ++i)
        {
            double row[4];
            for (int j = 0; j < 4; ++j)
            {
                row[j] = fabs(S[4 * (i / 4) + j]);
            }
            nearest[i] = i % 5 == 0 ? maplines_total(4, row) : 0.0; // covers any row
        }
    }
}

#endif
