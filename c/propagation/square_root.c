/* Square roots of matrices that may be singular.
 *
 * It has the operations of model/matrices.py in the same order.
 */
#include "propagation.h"

/// Reflect an (n, n) matrix M from column k on, so that a row v of it ends in column k.
static void reflect(int n, double *M, int k, double *v, double norm)
{
    double squares[4];
    v[k] = v[k] + copysign(norm, v[k]);
    for (int l = k; l < n; ++l)
    {
        squares[l - k] = v[l] * v[l];
    }
    const double twice = 2.0 / maplines_total(n - k, squares);
    for (int i = 0; i < n; ++i)
    {
        double along[4];
        for (int l = k; l < n; ++l)
        {
            along[l - k] = M[i * n + l] * v[l];
        }
        const double share = maplines_total(n - k, along) * twice;
        for (int l = k; l < n; ++l)
        {
            const double term = share * v[l];
            M[i * n + l] = M[i * n + l] - term;
        }
    }
}

/// Square root of a singular matrix, from the eigenvalues above `tiny` of the correlation matrix.
static void semidefinite_root(int n, const double *cov, double tiny, double *L)
{
    double scale[4] = {1.0, 1.0, 1.0, 1.0};
    double correlation[16];
    double values[4];
    double M[16];
    for (int i = 0; i < n; ++i)
    {
        scale[i] = cov[i * (n + 1)] > 0.0 ? sqrt(cov[i * (n + 1)]) : 1.0;
    }
    for (int i = 0; i < n * n; ++i)
    {
        correlation[i] = cov[i] / (scale[i / n] * scale[i % n]);
        L[i] = 0.0;
    }
    maplines_eigen(n, correlation, values, M);
    for (int i = 0; i < n * n; ++i)
    {
        M[i] = M[i] * sqrt(values[i % n] > tiny ? values[i % n] : 0.0);
    }
    int k = 0; // column for the next row that does not depend on those before it; k <= j
    for (int j = 0; j < n; ++j)
    {
        double v[4];
        double squares[4] = {0.0};
        for (int l = k; l < n; ++l)
        {
            v[l] = M[j * n + l];
            squares[l - k] = v[l] * v[l];
        }
        const double norm = sqrt(maplines_total(n - k, squares));
        if (norm > tiny)
        {
            reflect(n, M, k, v, norm);
            const double sign = M[j * n + k] > 0.0 ? 1.0 : -1.0;
            for (int i = j; i < n; ++i)
            {
                L[i * n + j] = M[i * n + k] * sign;
            }
            ++k;
        }
    }
    for (int i = 0; i < n * n; ++i)
    {
        const double variance = cov[i / n * (n + 1)];
        L[i] = L[i] * sqrt(variance > 0.0 ? variance : 0.0); // zero variance: zero row
    }
}

void maplines_square_root(int n, const double *cov, double *L)
{
    const double tiny = 8.0 * n * 0x1p-52;
    bool is_regular = maplines_cholesky_factor(n, cov, L);
    for (int i = 0; is_regular && i < n; ++i)
    {
        const double pivot = L[i * (n + 1)];
        is_regular = pivot * pivot > tiny * cov[i * (n + 1)];
    }
    if (!is_regular)
    {
        semidefinite_root(n, cov, tiny, L);
    }
}
