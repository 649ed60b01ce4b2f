/* Moments of functions of a Gaussian. */
#include "propagation.h"

#define MAX_COV 1e307 ///< largest variance or covariance
#define ROUNDING 1e-9 ///< of a covariance, relative to the standard deviations
#define N 4U          ///< parameters of a line

void maplines_rule_point(const maplines_rule_t *rule, size_t k, const double mean[3],
                         const double root[9], double point[3])
{
    const double *z = rule->z + 3 * k;
    for (size_t i = 0; i < 3; ++i)
    {
        const double first = root[3 * i] * z[0];
        const double second = root[3 * i + 1] * z[1];
        const double third = root[3 * i + 2] * z[2];
        point[i] = mean[i] + (first + second + third);
    }
}

static inline void moments(const maplines_rule_t *rule, size_t m, size_t stride,
                           const double *values, double *d, double *mean, double *cov)
{
    // The sums are over differences from the first point: this avoids cancellation.
    for (size_t i = 0; i < m; ++i)
    {
        mean[i] = 0.0;
    }
    for (size_t k = 1; k < rule->count; ++k)
    {
        const double *value = values + k * stride;
        for (size_t i = 0; i < m; ++i)
        {
            const double term = rule->mean_weights[k] * (value[i] - values[i]);
            mean[i] = mean[i] + term;
        }
    }
    for (size_t i = 0; i < m * m; ++i)
    {
        cov[i] = 0.0;
    }
    for (size_t k = 1; k < rule->count; ++k)
    {
        const double *value = values + k * stride;
        for (size_t i = 0; i < m; ++i)
        {
            d[i] = value[i] - values[i] - mean[i];
        }
        for (size_t i = 0; i < m; ++i)
        {
            const double weighted = rule->cov_weights[k] * d[i];
            for (size_t j = 0; j < m; ++j)
            {
                const double term = weighted * d[j];
                cov[m * i + j] = cov[m * i + j] + term;
            }
        }
    }
    for (size_t i = 0; i < m; ++i)
    {
        for (size_t j = 0; j < m; ++j)
        {
            const double term = rule->cov_weights[0] * mean[i] * mean[j];
            cov[m * i + j] = cov[m * i + j] + term;
        }
    }
    for (size_t i = 0; i < m; ++i)
    {
        mean[i] = values[i] + mean[i];
    }
}

void maplines_weighted_moments(const maplines_rule_t *rule, size_t m, size_t stride,
                               const double *values, double *scratch, double *mean, double *cov)
{
    if (m == N)
    {
        // Nothing else points to these, so that they stay in registers.
        double d[N];
        double own_mean[N];
        double own_cov[N * N];
        moments(rule, N, stride, values, d, own_mean, own_cov);
        (void)memcpy(mean, own_mean, sizeof(own_mean));
        (void)memcpy(cov, own_cov, sizeof(own_cov));
    }
    else
    {
        moments(rule, m, stride, values, scratch, mean, cov);
    }
}

bool maplines_is_covariance(size_t n, const double *cov, double *scratch)
{
    for (size_t i = 0; i < n * n; ++i)
    {
        if (!(fabs(cov[i]) <= MAX_COV))
        {
            return false;
        }
    }
    for (size_t i = 0; i < n; ++i)
    {
        const double variance = cov[(n + 1) * i];
        if (!(variance >= 0.0))
        {
            return false;
        }
        scratch[(n + 1) * i] = variance > 0.0 ? sqrt(variance) : 1.0;
    }
    for (size_t i = 0; i < n; ++i)
    {
        for (size_t j = 0; j < i; ++j)
        {
            const double scale = scratch[(n + 1) * i] * scratch[(n + 1) * j];
            scratch[n * i + j] = cov[n * i + j] / scale;
        }
    }
    for (size_t i = 0; i < n; ++i)
    {
        scratch[(n + 1) * i] = (cov[(n + 1) * i] > 0.0 ? 1.0 : 0.0) + ROUNDING;
    }
    return maplines_cholesky_factor((int)n, scratch, scratch);
}
