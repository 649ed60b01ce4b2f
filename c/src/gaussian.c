/* A decoded Gaussian as numbers of the build. */
#include "internal.h"

#if MAPLINES_RECEIVER
#if MAPLINES_FLOAT

/* In single precision a receiver has another mean m + e and another factor than the sender allowed
 * for. Let T be the factor in double precision, whose T T^T covers the covariance S of the sender
 * about m, and let u = 2^-24 be the rounding error of a float. The factor s T is rounded to
 * s T + E with |E| <= u s |T|, so with X = (s T)^-1 E, |X| <= u |T^-1| |T|,
 *
 *     (s T + E)(s T + E)^T = s T (I + X)(I + X)^T s T^T  >=  s^2 (1 - u K)^2 T T^T,
 *
 * where K is the Frobenius norm of |T^-1| |T|. About m + e the sender's covariance grows by at most
 * the factor (1 + q)^2 with q = |T^-1 e|. So s = (1 + q) / (1 - u K) covers. For lines of
 * a road s - 1 is about a millionth.
 *
 * If K is too large for a float, or an entry too small or too large, the covariance is diagonal:
 * 4 times the diagonal of S covers S, since the correlation matrix has no larger eigenvalue.
 */

#define MAX_FLOAT_ROUNDING 0.25   // of u K
#define FLOAT_ROUNDING 0x1.01p-24 // u, and some for the roundings of double precision
#define SMALLEST_SIGMA 0x1p-80
#define LARGEST_SIGMA 0x1p60
#define LARGEST_FLOAT 0x1.fffffep127

/// Frobenius norm of |T^-1| |T|, for a lower triangular T.
static double amplification_of(const double T[16])
{
    double inverse[16];
    for (int i = 0; i < 16; ++i)
    {
        inverse[i] = i % 5 == 0 ? 1.0 : 0.0;
    }
    maplines_lower_solution(4, 4, T, inverse);
    double squares = 0.0;
    for (int i = 0; i < 4; ++i)
    {
        for (int j = 0; j < 4; ++j)
        {
            double sum = 0.0;
            for (int k = 0; k < 4; ++k)
            {
                sum = sum + fabs(inverse[4 * i + k]) * fabs(T[4 * k + j]);
            }
            squares = squares + sum * sum;
        }
    }
    return sqrt(squares);
}

/// Factor on T that covers the rounding to single precision; 0 if there is none.
static double rounding_factor(const double T[16], const double error[4])
{
    for (int i = 0; i < 16; ++i)
    {
        const bool is_small = i % 5 == 0 && T[i] < SMALLEST_SIGMA;
        if (is_small || !(fabs(T[i]) <= LARGEST_SIGMA))
        {
            return 0.0;
        }
    }
    const double rounding = FLOAT_ROUNDING * amplification_of(T);
    double z[4];
    memcpy(z, error, sizeof z);
    maplines_lower_solution(4, 1, T, z);
    const double q = sqrt(z[0] * z[0] + z[1] * z[1] + z[2] * z[2] + z[3] * z[3]);
    return rounding <= MAX_FLOAT_ROUNDING ? (1.0 + q) / (1.0 - rounding) : 0.0;
}

MAPLINES_INTERNAL void maplines_set_gaussian(const double mean[4], double (*factor)[4],
                                             const uint8_t order[4], maplines_gaussian_t *gaussian)
{
    double T[16];
    double error[4];
    for (int i = 0; i < 4; ++i)
    {
        const int state = order[i];
        gaussian->mean[state] = (float)mean[state];
        error[i] = (double)gaussian->mean[state] - mean[state];
        memcpy(T + 4 * i, factor[state], 4 * sizeof(double));
    }
    const double scale = rounding_factor(T, error);
    for (int i = 0; i < 4; ++i)
    {
        const int state = order[i];
        double square = 0.0;
        for (int j = 0; j < 4; ++j)
        {
            gaussian->factor[state][j] = (float)(T[4 * i + j] * scale);
            square = square + T[4 * i + j] * T[4 * i + j];
        }
        if (scale <= 0.0)
        {
            const double sigma = 2.001 * sqrt(square) + 2.001 * fabs(error[i]);
            const double limited = sigma < LARGEST_FLOAT ? sigma : LARGEST_FLOAT;
            memset(gaussian->factor[state], 0, sizeof gaussian->factor[state]);
            gaussian->factor[state][i] =
                limited < SMALLEST_SIGMA ? (float)SMALLEST_SIGMA : (float)limited;
        }
    }
}

#else

MAPLINES_INTERNAL void maplines_set_gaussian(const double mean[4], double (*factor)[4],
                                             const uint8_t order[4], maplines_gaussian_t *gaussian)
{
    (void)order;
    memcpy(gaussian->mean, mean, sizeof gaussian->mean);
    memcpy(gaussian->factor, factor, sizeof gaussian->factor);
}

#endif
#endif

MAPLINES_INTERNAL void maplines_moments(int count, const double *weights, double (*means)[4],
                                        double (*covs)[16], double mean[4], double cov[16])
{
    for (int i = 0; i < 4; ++i)
    {
        mean[i] = weights[0] * means[0][i];
        for (int k = 1; k < count; ++k)
        {
            const double term = weights[k] * means[k][i];
            mean[i] = mean[i] + term;
        }
    }
    for (int k = 0; k < count; ++k)
    {
        double d[4];
        for (int i = 0; i < 4; ++i)
        {
            d[i] = means[k][i] - mean[i];
        }
        for (int i = 0; i < 16; ++i)
        {
            const double square = d[i / 4] * d[i % 4];
            const double term = weights[k] * (covs[k][i] + square);
            cov[i] = k == 0 ? term : cov[i] + term;
        }
    }
}

#if MAPLINES_RECEIVER
/// Factor of a covariance with its rows in this order of the states.
static void factor_in_order(const double cov[16], const uint8_t order[4], double factor[4][4])
{
    double ordered[16];
    double L[16];
    for (int i = 0; i < 16; ++i)
    {
        ordered[i] = cov[4 * order[i / 4] + order[i % 4]];
    }
    if (!maplines_cholesky_factor(4, ordered, L))
    {
        for (int i = 0; i < 4; ++i)
        {
            const double share = MAPLINES_DEFINITE_SHARE * ordered[5 * i];
            ordered[5 * i] = ordered[5 * i] + share;
        }
        (void)maplines_cholesky_factor(4, ordered, L);
    }
    for (int i = 0; i < 4; ++i)
    {
        memcpy(factor[order[i]], L + 4 * i, 4 * sizeof(double));
    }
}

MAPLINES_INTERNAL void maplines_mixture_gaussian(int count, const double *weights,
                                                 const maplines_gaussian_t *components,
                                                 const uint8_t order[4],
                                                 maplines_gaussian_t *overall)
{
    double means[MAPLINES_MAX_COMPONENTS][4] = {{0.0}};
    double covs[MAPLINES_MAX_COMPONENTS][16] = {{0.0}};
    double mean[4];
    double cov[16];
    double factor[4][4];
    for (int k = 0; k < count; ++k)
    {
        double F[16];
        for (int i = 0; i < 4; ++i)
        {
            means[k][i] = (double)components[k].mean[i];
        }
        for (int i = 0; i < 16; ++i)
        {
            F[i] = (double)components[k].factor[i / 4][i % 4];
        }
        maplines_gram(4, 4, F, covs[k]);
    }
    maplines_moments(count, weights, means, covs, mean, cov);
    factor_in_order(cov, order, factor);
    maplines_set_gaussian(mean, factor, order, overall);
}
#endif
