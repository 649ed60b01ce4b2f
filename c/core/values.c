/* Elementary functions of arrays, Gaussians of any size, places of a line, and lines seen from
 * other poses.
 */
#include "core.h"
#include "propagation.h"

/// Largest variance or covariance: values/linalg.py.
#define MAX_COV 1e307
/// Most halvings of the distance to a pose from which a line is no function of x.
#define HALVINGS 60

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
/// pivots of more than 0 only: values/linalg.py, indefinite.
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

bool maplines_factor_of(size_t n, const double *S, double *L)
{
    return maplines_cholesky_factor((int)n, S, L);
}

void maplines_root_of(size_t n, const double *cov, double *L)
{
    maplines_square_root((int)n, cov, L);
}

void maplines_eigen_of(size_t count, size_t n, double *S, double *values, double *V)
{
    for (size_t i = 0; i < count; i++)
    {
        maplines_eigen((int)n, S + n * n * i, values + n * i, V + n * n * i);
    }
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

void maplines_extrapolate(const maplines_line_t *line, size_t n, const double *x, double *y,
                          double *sigma)
{
    for (size_t i = 0; i < n; i++)
    {
        const maplines_estimate_t estimate = maplines_y_extrapolated(line, x[i]);
        y[i] = estimate.value;
        sigma[i] = estimate.sigma;
    }
}

/* ---- elementary functions -------------------------------------------------------------------- */

/// Distance from an interval, 0 in it.
static double outside(double value, double low, double high)
{
    const double beyond = value > high ? value - high : 0.0;
    return value < low ? low - value : beyond;
}

static double squared_to_box(const double box[4], double x, double y)
{
    const double across = outside(x, box[0], box[2]);
    const double along = outside(y, box[1], box[3]);
    return across * across + along * along;
}

/// Place where a segment is nearest to a point, as a share of it, and its squared distance.
static double squared_to_segment(const double *begin, double x, double y, double *share)
{
    const double step[2] = {begin[2] - begin[0], begin[3] - begin[1]};
    const double offset[2] = {x - begin[0], y - begin[1]};
    const double length = step[0] * step[0] + step[1] * step[1];
    const double along = offset[0] * step[0] + offset[1] * step[1];
    const double ratio = along > 0.0 ? along / length : 0.0;
    *share = ratio < 1.0 ? ratio : 1.0;
    const double aside[2] = {offset[0] - *share * step[0], offset[1] - *share * step[1]};
    return aside[0] * aside[0] + aside[1] * aside[1];
}

double maplines_nearest_place(size_t count, const double *points, const double *distance,
                              size_t length, const double *boxes, double x, double y)
{
    const size_t runs = (count - 2U) / length + 1U;
    double least = (double)INFINITY;
    double place = distance[0];
    size_t nearest = 0;
    for (size_t run = 0; run < runs; run++)
    {
        const double squared = squared_to_box(boxes + 4 * run, x, y);
        nearest = squared < least ? run : nearest;
        least = squared < least ? squared : least;
    }
    least = (double)INFINITY;
    for (size_t next = 0; next <= runs; next++) // the nearest box first: it excludes most others
    {
        const size_t run = next == 0 ? nearest : next - 1U;
        const size_t begin = run * length;
        const size_t end = begin + length < count - 1U ? begin + length : count - 1U;
        if (squared_to_box(boxes + 4 * run, x, y) < least)
        {
            for (size_t i = begin; i < end; i++)
            {
                double share;
                const double squared = squared_to_segment(points + 2 * i, x, y, &share);
                if (squared < least)
                {
                    least = squared;
                    place = distance[i] + share * (distance[i + 1U] - distance[i]);
                }
            }
        }
    }
    return place;
}

void maplines_elementary(int function, size_t n, const double *x, double *y, double *cosine)
{
    for (size_t i = 0; i < n; i++)
    {
        switch (function)
        {
        case 0:
            y[i] = maplines_exp2(x[i]);
            break;
        case 1:
            y[i] = maplines_log2(x[i]);
            break;
        case 2:
            y[i] = maplines_tan(x[i]);
            break;
        case 3:
            y[i] = maplines_atan(x[i]);
            break;
        default:
            maplines_sin_cos(x[i], &y[i], &cosine[i]);
            break;
        }
    }
}

/* ---- lines seen from other poses ------------------------------------------------------------- */

/// Line of a row: mean (4), fit range (2) [m], and coefficient of T_4 [m].
static maplines_curve_t curve_of(const double row[7])
{
    const maplines_curve_t curve = {{row[0], row[1], row[2], row[3]}, {row[4], row[5]}, row[6]};
    return curve;
}

static void points_of(const double row[7], maplines_points_t *points)
{
    const maplines_curve_t curve = curve_of(row);
    maplines_points_of(&curve, points);
}

bool maplines_are_functions(size_t lines, const double *curves)
{
    bool are_functions = true;
    for (size_t i = 0; i < lines; i++)
    {
        maplines_points_t points;
        points_of(curves + 7 * i, &points);
        are_functions = are_functions && maplines_is_function(&points);
    }
    return are_functions;
}

void maplines_bases_of(size_t lines, const double *means, const double *fit_ranges, double *J)
{
    for (size_t i = 0; i < lines; i++)
    {
        maplines_bases(means + 4 * i, fit_ranges + 2 * i, J + 16 * i);
    }
}

/// Line seen from a pose; extrapolated if it is no function of x there. False if that fails.
static bool seen_from(const maplines_points_t *points, const double pose[3], double line[4])
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
    for (int i = 0; i < HALVINGS; ++i)
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

bool maplines_see_curves(size_t lines, const double *curves, size_t n, const double *poses,
                         double *found)
{
    bool is_right = true;
    for (size_t i = 0; i < lines; i++)
    {
        maplines_points_t points;
        points_of(curves + 7 * i, &points);
        for (size_t k = 0; k < n; k++)
        {
            is_right &= seen_from(&points, poses + 3 * k, found + 4 * (k * lines + i));
        }
    }
    return is_right;
}

void maplines_transform_curves(size_t n, const double *curves, const double *poses, double *found)
{
    for (size_t i = 0; i < n; i++)
    {
        maplines_points_t points;
        points_of(curves + 7 * i, &points);
        maplines_refitted(&points, poses + 3 * i, found + 4 * i);
    }
}

/// How a line of a row changes with the pose.
static void line_changes(const double row[7], double W[7][4])
{
    const maplines_curve_t curve = curve_of(row);
    maplines_changes_t changes;
    maplines_changes_of(&curve, &changes);
    maplines_line_changes(&changes, W);
}

void maplines_curve_jacobians(size_t lines, const double *curves, double *J)
{
    for (size_t i = 0; i < lines; i++)
    {
        double W[7][4];
        line_changes(curves + 7 * i, W);
        for (int k = 0; k < 4; ++k)
        {
            const double row[3] = {W[0][k], W[1][k], W[2][k]};
            memcpy(J + 12 * i + 3 * k, row, sizeof row);
        }
    }
}

void maplines_centre_curves(size_t lines, double *curves, const double P[9])
{
    for (size_t i = 0; i < lines; i++)
    {
        double W[7][4];
        double *mean = curves + 7 * i;
        line_changes(mean, W);
        for (int k = 0; k < 4; ++k)
        {
            mean[k] -= W[3][k] * P[8] + W[4][k] * P[2] + W[5][k] * P[5] + W[6][k] * P[0];
        }
    }
}

bool maplines_spread_curves(size_t lines, const double *curves, const double P[9], double *A,
                            double *cov)
{
    maplines_pose_root_t root;
    const int rows = (int)(4 * lines);
    bool is_right = true;
    maplines_pose_root(P, &root);
    for (size_t i = 0; i < lines; i++)
    {
        const maplines_curve_t curve = curve_of(curves + 7 * i);
        maplines_changes_t changes;
        double(*own)[MAPLINES_COLUMNS] = (double(*)[MAPLINES_COLUMNS])A + 4 * i;
        maplines_changes_of(&curve, &changes);
        is_right &= maplines_spread(&changes, &root, own);
    }
    maplines_gram(rows, MAPLINES_COLUMNS, A, cov);
    for (int i = 0; i < rows * rows; ++i)
    {
        is_right = is_right && fabs(cov[i]) < (double)INFINITY;
    }
    return is_right;
}
