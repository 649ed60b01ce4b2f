/* Lines as functions of the pose from which they are seen.
 *
 * It has the operations of model/lines.py and model/matrices.py in the same order.
 */
#include "internal.h"

#if MAPLINES_SCENES

#define MAPLINES_MARGIN 3.0  ///< standard deviations of the pose error at an end of a range
#define MAPLINES_HALVINGS 60 ///< of the distance to a pose from which a line is no function of x
#define MAPLINES_STEP 1e-4   ///< of the pose, for derivatives [m, rad]

MAPLINES_INTERNAL void maplines_bases(const double mean[4], const double fit_range[2], double J[16])
{
    // Chebyshev polynomials T_0 .. T_3, in terms of w^0 .. w^3.
    static const double chebyshev[4][4] = {
        {1.0, 0.0, 0.0, 0.0}, {0.0, 1.0, 0.0, 0.0}, {-1.0, 0.0, 2.0, 0.0}, {0.0, -3.0, 0.0, 4.0}};
    const double centre = (fit_range[0] + fit_range[1]) / 2.0;
    const double half = (fit_range[1] - fit_range[0]) / 2.0;
    double sine;
    double cosine;
    maplines_sin_cos(mean[1], &sine, &cosine);
    for (int k = 0; k < 4; ++k)
    {
        double column[4];
        maplines_derivatives(chebyshev[k], centre, half, column);
        column[1] = column[1] * (cosine * cosine);
        for (int i = 0; i < 4; ++i)
        {
            J[4 * i + k] = column[i];
        }
    }
}

/* ---- square roots of matrices that may be singular ------------------------------------------- */

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
    double scale[4];
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

MAPLINES_INTERNAL void maplines_square_root(int n, const double *cov, double *L)
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

/* ---- lines seen from other poses --------------------------------------------------------------
 */

MAPLINES_INTERNAL void maplines_pose_points(const double P[9], double (*poses)[3])
{
    double L[9];
    maplines_square_root(3, P, L);
    memset(poses, 0, MAPLINES_POSES * sizeof *poses);
    const double length = sqrt(3.0);
    for (int k = 0; k < 3; ++k)
    {
        for (int i = 0; i < 3; ++i)
        {
            poses[1 + k][i] = length * L[3 * i + k];
            poses[4 + k][i] = -poses[1 + k][i];
        }
    }
}

MAPLINES_INTERNAL bool maplines_seen(const maplines_points_t *points, const double pose[3],
                                     double line[4])
{
    static const double origin[3] = {0.0, 0.0, 0.0};
    maplines_refitted(points, pose, line);
    if (line[0] == line[0])
    {
        return true;
    }
    double mean[4];
    maplines_refitted(points, origin, mean);
    double share = 1.0;
    for (int i = 0; i < MAPLINES_HALVINGS; ++i)
    {
        share = share / 2.0;
        const double nearer[3] = {share * pose[0], share * pose[1], share * pose[2]};
        maplines_refitted(points, nearer, line);
        for (int j = 0; j < 4; ++j)
        {
            const double slope = (line[j] - mean[j]) / share;
            line[j] = mean[j] + slope;
        }
        if (line[0] == line[0])
        {
            return true;
        }
    }
    return false;
}

MAPLINES_INTERNAL bool maplines_pose_jacobian(const maplines_points_t *points, double J[4][3])
{
    for (int k = 0; k < 3; ++k)
    {
        double pose[3] = {0.0, 0.0, 0.0};
        double ahead[4];
        double behind[4];
        pose[k] = MAPLINES_STEP;
        if (!maplines_seen(points, pose, ahead))
        {
            return false;
        }
        pose[k] = -MAPLINES_STEP;
        if (!maplines_seen(points, pose, behind))
        {
            return false;
        }
        for (int i = 0; i < 4; ++i)
        {
            J[i][k] = (ahead[i] - behind[i]) / (2.0 * MAPLINES_STEP);
        }
    }
    return true;
}

MAPLINES_INTERNAL bool maplines_centre_line(maplines_curve_t *curve, maplines_points_t *points,
                                            double (*poses)[3])
{
    double given[4];
    memcpy(given, curve->mean, sizeof given);
    for (int trial = 0; trial < 2; ++trial)
    {
        double values[4][MAPLINES_POSES - 1];
        for (int k = 1; k < MAPLINES_POSES; ++k)
        {
            double line[4];
            if (!maplines_seen(points, poses[k], line))
            {
                return false;
            }
            for (int i = 0; i < 4; ++i)
            {
                values[i][k - 1] = line[i];
            }
        }
        maplines_curve_t centred = *curve;
        for (int i = 0; i < 4; ++i)
        {
            const double mean = maplines_total(MAPLINES_POSES - 1, values[i]) / 6.0;
            centred.mean[i] = given[i] - (mean - curve->mean[i]);
        }
        maplines_points_t moved;
        maplines_points_of(&centred, &moved);
        if (maplines_is_function(&moved)) // else it stays as it is: the pose error is so large
        {
            *curve = centred;
            *points = moved;
        }
    }
    return true;
}

MAPLINES_INTERNAL bool maplines_spread(const maplines_curve_t *curve, double (*poses)[3],
                                       double A[4][MAPLINES_POSES])
{
    maplines_curve_t centred = *curve;
    maplines_points_t points;
    maplines_points_of(&centred, &points);
    double first[4];
    if (!maplines_centre_line(&centred, &points, poses) || !maplines_seen(&points, poses[0], first))
    {
        return false;
    }
    for (int k = 1; k < MAPLINES_POSES; ++k)
    {
        double line[4];
        if (!maplines_seen(&points, poses[k], line))
        {
            return false;
        }
        for (int i = 0; i < 4; ++i)
        {
            A[i][k - 1] = line[i] - first[i];
        }
    }
    for (int i = 0; i < 4; ++i)
    {
        double d[MAPLINES_POSES - 1];
        memcpy(d, A[i], sizeof d);
        const double mean = maplines_total(MAPLINES_POSES - 1, d) / 6.0;
        for (int k = 0; k < MAPLINES_POSES - 1; ++k)
        {
            A[i][k] = (A[i][k] - mean) / sqrt(6.0);
        }
        // The centre has the weights 0 in the mean and 2 in the covariance.
        A[i][MAPLINES_POSES - 1] = sqrt(2.0) * mean;
    }
    return true;
}

/* ---- valid ranges -----------------------------------------------------------------------------
 */

MAPLINES_INTERNAL void maplines_valid_range(const maplines_curve_t *curve, const double P[9],
                                            const double specific_cov[16], double heading_sigma,
                                            double range[2])
{
    const double *mean = curve->mean;
    const double slope = maplines_tan(mean[1]);
    const double middle = (curve->fit_range[0] + curve->fit_range[1]) / 2.0;
    const double square = middle * middle;
    const double J[4] = {1.0, (1.0 + slope * slope) * middle, square / 2.0, square * middle / 6.0};
    double J_cov[4];
    double shift; // variance of the lateral position in the middle
    maplines_product(1, 4, 4, J, specific_cov, J_cov);
    maplines_product_transposed(1, 4, 1, J_cov, J, &shift);
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
        const double cubic = x * mean[3] / 6.0;
        const double quadratic = x * (mean[2] / 2.0 + cubic);
        const double linear = x * (slope + quadratic);
        const double y = mean[0] + linear;
        const double by_both = 2.0 * y * P[2];
        const double by_heading = y * y * heading;
        const double variance = along - by_both + by_heading;
        const double sigma = sqrt(variance > 0.0 ? variance : 0.0);
        const double margin = MAPLINES_MARGIN * sigma + shortening * fabs(x);
        range[end] = end == 0 ? x + margin : x - margin;
    }
}

#endif
