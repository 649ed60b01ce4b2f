/* Gaussians of any size, and places of a line. */
#include "core.h"
#include "internal.h"

/// Largest variance or covariance: values/linalg.py.
#define MAX_COV 1e307

/// Values are finite, variances are 0 or more, and there is no covariance of a variance of 0. The
/// scale is the standard deviations, or 1 instead of 0.
static bool scale_of(size_t n, const double *S, double *scale)
{
    bool is_valid = true;
    for (size_t i = 0; i < n; i++)
    {
        const double variance = S[n * i + i];
        const double most = variance == 0.0 ? 0.0 : MAX_COV;
        is_valid = is_valid && variance >= 0.0;
        for (size_t j = 0; j < n; j++)
        {
            is_valid = is_valid && fabs(S[n * i + j]) <= most;
        }
        scale[i] = variance > 0.0 ? sqrt(variance) : 1.0;
    }
    return is_valid;
}

/// Make a matrix symmetric; false if it is not, up to rounding.
static bool make_symmetric(size_t n, double *S, double rounding, const double *scale)
{
    bool is_exact = true;
    for (size_t i = 0; i < n; i++)
    {
        for (size_t j = 0; j < i; j++)
        {
            const double difference = fabs(S[n * i + j] - S[n * j + i]);
            is_exact = is_exact && difference == 0.0;
            if (difference > rounding * scale[i] * scale[j] ||
                difference > rounding * scale[j] * scale[i])
            {
                return false;
            }
        }
    }
    for (size_t i = 0; !is_exact && i < n; i++)
    {
        for (size_t j = 0; j < i; j++)
        {
            const double mean = (S[n * i + j] + S[n * j + i]) / 2;
            S[n * i + j] = mean;
            S[n * j + i] = mean;
        }
    }
    return true;
}

/// Whether Cholesky's recursion on the correlation matrix, with the rounding on its diagonal, has
/// pivots of more than 0 only: values/linalg.py, is_indefinite.
static bool is_semidefinite(size_t n, const double *S, double rounding, const double *scale,
                            double *L)
{
    for (size_t i = 0; i < n; i++)
    {
        double *row = L + n * i;
        double squares = 0.0;
        for (size_t j = 0; j < i; j++)
        {
            const double *column = L + n * j;
            double products = 0.0;
            for (size_t k = 0; k < j; k++)
            {
                products += row[k] * column[k];
            }
            row[j] = (S[n * i + j] / (scale[i] * scale[j]) - products) / column[j];
            squares += row[j] * row[j];
        }
        const double pivot = S[n * i + i] / (scale[i] * scale[i]) + rounding - squares;
        if (!(pivot > 0.0))
        {
            return false;
        }
        row[i] = sqrt(pivot);
    }
    return true;
}

bool maplines_check_gaussian(size_t n, double rounding, const double *mean, double *cov,
                             double *memory)
{
    bool is_valid = true;
    for (size_t i = 0; i < n; i++)
    {
        is_valid = is_valid && fabs(mean[i]) < (double)INFINITY;
    }
    return is_valid && scale_of(n, cov, memory) && make_symmetric(n, cov, rounding, memory) &&
           is_semidefinite(n, cov, rounding, memory, memory + n);
}

double maplines_line_y(double y_off, double beta, double c0, double c1, double x)
{
    return y_off + x * (maplines_tan(beta) + x * (c0 / 2 + x * c1 / 6));
}

double maplines_line_sigma(double beta, const double cov[16], double x)
{
    const double slope = maplines_tan(beta);
    const double J[4] = {1.0, (1 + slope * slope) * x, x * x / 2, x * x * x / 6};
    double variance = 0.0;
    for (int i = 0; i < 4; i++)
    {
        const double *row = &cov[4 * i];
        variance += J[i] * (row[0] + J[1] * row[1] + J[2] * row[2] + J[3] * row[3]);
    }
    return sqrt(variance < 0.0 ? 0.0 : variance);
}
