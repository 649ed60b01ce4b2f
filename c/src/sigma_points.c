/* The unscented transform in its square-root form, and the Gaussian of a mixture.
 *
 * The deviations of the points are the columns of a square root of the covariance, and reflections
 * make it a square matrix. The covariance itself is never formed, so nothing can be indefinite. All
 * of it is in double precision in either build: what is small is the difference of two points.
 */
#include "internal.h"

#if MAPLINES_RECEIVER

/// Square lower triangular root R of A A^T, for an (m, n) matrix A, which is overwritten.
///
/// Householder's reflections from the right. They do not depend on the units of the rows.
MAPLINES_INTERNAL void maplines_lower_root(int m, int n, double *A, double *R)
{
    for (int j = 0; j < m; ++j)
    {
        double *row = A + j * n;
        double largest = 0.0;
        for (int k = j; k < n; ++k)
        {
            largest = fabs(row[k]) > largest ? fabs(row[k]) : largest;
        }
        double norm = 0.0;
        for (int k = j; largest > 0.0 && k < n; ++k)
        {
            norm += (row[k] / largest) * (row[k] / largest);
        }
        norm = largest * sqrt(norm);
        if (norm > 0.0)
        {
            // The reflection by v takes the row to its norm, on the diagonal.
            double v[MAPLINES_SIGMA_POINTS] = {0};
            double length = 0.0;
            for (int k = j; k < n; ++k)
            {
                v[k] = row[k] / norm;
            }
            v[j] += row[j] < 0.0 ? -1.0 : 1.0;
            for (int k = j; k < n; ++k)
            {
                length += v[k] * v[k];
            }
            for (int i = j; i < m; ++i)
            {
                double along = 0.0;
                for (int k = j; k < n; ++k)
                {
                    along += A[i * n + k] * v[k];
                }
                for (int k = j; k < n; ++k)
                {
                    A[i * n + k] -= 2.0 * along / length * v[k];
                }
            }
        }
        const double sign = row[j] < 0.0 ? -1.0 : 1.0;
        for (int i = 0; i < m; ++i)
        {
            R[i * m + j] = i < j ? 0.0 : sign * A[i * n + j];
        }
    }
}

/// Mean (m) and lower triangular root (m, m) of a function of a Gaussian over n states with an
/// (n, n) root, by 2 n + 1 sigma points at sqrt(n) standard deviations (van der Merwe 2004, with
/// alpha 1, beta 2, kappa 0). False if the function has no value at one of them.
MAPLINES_INTERNAL bool maplines_unscented(maplines_function_t function, const void *context, int n,
                                          const double *mean, const double *root, int m,
                                          double *value, double *value_root)
{
    double deviations[4 * MAPLINES_SIGMA_POINTS] = {0}; // (m, 2 n + 1)
    double state[MAPLINES_MAX_STATES] = {0};
    double shift[4] = {0};
    double first[4] = {0};
    double other[4] = {0};
    const int points = 2 * n + 1;
    const double spread = sqrt((double)n);
    for (int point = 0; point < points; ++point)
    {
        for (int i = 0; i < n; ++i)
        {
            const double step = point == 0 ? 0.0 : root[i * n + (point - 1) / 2];
            state[i] = mean[i] + (point % 2 == 1 ? spread : -spread) * step;
        }
        if (!function(state, context, point == 0 ? first : other))
        {
            return false;
        }
        for (int i = 0; point > 0 && i < m; ++i)
        {
            const double d = other[i] - first[i];
            deviations[i * points + point] = d;
            shift[i] += d / (2.0 * (double)n);
        }
    }
    const double weight = sqrt(1.0 / (2.0 * (double)n));
    for (int i = 0; i < m; ++i)
    {
        value[i] = first[i] + shift[i];
        deviations[i * points] = sqrt(2.0) * shift[i];
        for (int point = 1; point < points; ++point)
        {
            deviations[i * points + point] = weight * (deviations[i * points + point] - shift[i]);
        }
    }
    maplines_lower_root(m, points, deviations, value_root);
    for (int i = 0; i < m; ++i)
    {
        for (int j = 0; j <= i; ++j)
        {
            if (!(fabs(value_root[i * m + j]) < (double)INFINITY))
            {
                return false;
            }
        }
    }
    return true;
}

/// Whether all weights are positive and finite: the sum of other ones is no probability.
static bool are_weights(size_t count, const maplines_real_t *weights)
{
    for (size_t k = 0; k < count; ++k)
    {
        if (!(weights[k] > 0 && weights[k] < (maplines_real_t)INFINITY))
        {
            return false;
        }
    }
    return true;
}

void maplines_overall(size_t count, const maplines_gaussian_t *components,
                      const maplines_real_t *weights, maplines_gaussian_t *overall)
{
    static const uint8_t natural_order[4] = {0, 1, 2, 3};
    double mean[4] = {0};
    double root[4][4] = {{0}};
    double total = 0.0;
    if (!MAPLINES_REQUIRE(overall != NULL))
    {
        return;
    }
    if (!MAPLINES_REQUIRE(count > 0) || !MAPLINES_REQUIRE(components != NULL) ||
        !MAPLINES_REQUIRE(weights != NULL) || !MAPLINES_REQUIRE(are_weights(count, weights)))
    {
        const maplines_real_t nan = (maplines_real_t)NAN;
        *overall = (maplines_gaussian_t){{nan, nan, nan, nan},
                                         {{nan, nan, nan, nan},
                                          {nan, nan, nan, nan},
                                          {nan, nan, nan, nan},
                                          {nan, nan, nan, nan}}};
        return;
    }
    for (size_t k = 0; k < count; ++k)
    {
        total += (double)weights[k];
        for (int i = 0; i < 4; ++i)
        {
            mean[i] += (double)weights[k] * (double)components[k].mean[i];
        }
    }
    for (int i = 0; i < 4; ++i)
    {
        mean[i] /= total;
    }
    for (size_t k = 0; k < count; ++k)
    {
        double columns[4 * 9] = {0}; // of the components so far, and of this one
        const double share = sqrt((double)weights[k] / total);
        for (int i = 0; i < 4; ++i)
        {
            for (int j = 0; j < 4; ++j)
            {
                columns[9 * i + j] = root[i][j];
                columns[9 * i + 4 + j] = share * (double)components[k].factor[i][j];
            }
            columns[9 * i + 8] = share * ((double)components[k].mean[i] - mean[i]);
        }
        maplines_lower_root(4, 9, columns, &root[0][0]);
    }
    maplines_set_gaussian(mean, root, natural_order, overall);
}

#endif
