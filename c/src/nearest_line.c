/* The line within the ranges of a message that is nearest to one that exceeds them.
 *
 * To clip one parameter alone moves the line by up to tens of metres: the others have to make up
 * for it. In a short range they do so to a few centimetres, since there the parameters of a cubic
 * can be told apart only poorly.
 */
#include "internal.h"

#if MAPLINES_SENDER

#define MAX_DEVIATION 0.1 // [m]
#define SHORTER_RANGE 0.8
#define MAX_SHORTENED 24
#define STEEPEST_LINE 1.5 // [rad]
#define LIMIT_STEPS 8.0
#define SIGMA_SHARE 0.7
#define BOX_STEPS 32
#define FLAT_GRADIENT 1e-10
#define NODE_COUNT 16
#define WIDEST_ROW 5 // four parameters and a right side

/// Extrema of a Chebyshev polynomial.
static const double comparison_nodes[NODE_COUNT] = {
    -0x1.0000000000000p+0, -0x1.f4cfc327a0080p-1, -0x1.d3bc3aeff7f95p-1, -0x1.9e3779b97f4a8p-1,
    -0x1.5698496e20bd9p-1, -0x1.0000000000001p-1, -0x1.3c6ef372fe950p-2, -0x1.ac2609b3c577ap-4,
    0x1.ac2609b3c5762p-4,  0x1.3c6ef372fe94ep-2,  0x1.ffffffffffffcp-2,  0x1.5698496e20bd5p-1,
    0x1.9e3779b97f4a7p-1,  0x1.d3bc3aeff7f94p-1,  0x1.f4cfc327a007fp-1,  0x1.0000000000000p+0,
};

static double dot_product(int n, const double *a, const double *b)
{
    double total = a[0] * b[0];
    for (int i = 1; i < n; ++i)
    {
        const double term = a[i] * b[i];
        total = total + term;
    }
    return total;
}

/// Upper triangular (n, n) R with R^T R = A^T A, by modified Gram-Schmidt. The n columns of A, each
/// of m entries, are overwritten.
static void triangular_of(int m, int n, double columns[WIDEST_ROW][NODE_COUNT],
                          double R[WIDEST_ROW][WIDEST_ROW])
{
    memset(R, 0, WIDEST_ROW * WIDEST_ROW * sizeof(double));
    for (int j = 0; j < n; ++j)
    {
        double unit[NODE_COUNT] = {0.0};
        R[j][j] = sqrt(dot_product(m, columns[j], columns[j]));
        if (!(R[j][j] > 0.0))
        {
            continue;
        }
        for (int i = 0; i < m; ++i)
        {
            unit[i] = columns[j][i] / R[j][j];
        }
        for (int k = j + 1; k < n; ++k)
        {
            R[j][k] = dot_product(m, unit, columns[k]);
            for (int i = 0; i < m; ++i)
            {
                const double term = R[j][k] * unit[i];
                columns[k][i] = columns[k][i] - term;
            }
        }
    }
}

/// The u with the least |R u| whose entries that are not free are given.
static void free_solution(double R[WIDEST_ROW][WIDEST_ROW], const bool is_free[4],
                          const double u[4], double solution[4])
{
    double columns[WIDEST_ROW][NODE_COUNT] = {{0.0}};
    double T[WIDEST_ROW][WIDEST_ROW];
    double fixed[4];
    int free_ones[4] = {0};
    int count = 0;
    for (int i = 0; i < 4; ++i)
    {
        fixed[i] = is_free[i] ? 0.0 : u[i];
        solution[i] = u[i];
        if (is_free[i])
        {
            free_ones[count] = i;
            ++count;
        }
    }
    for (int row = 0; row < 4; ++row)
    {
        for (int j = 0; j < count; ++j)
        {
            columns[j][row] = R[row][free_ones[j]];
        }
        columns[count][row] = -dot_product(4, R[row], fixed);
    }
    triangular_of(4, count + 1, columns, T);
    for (int j = count - 1; j >= 0; --j)
    {
        double rest = T[j][count];
        for (int k = j + 1; k < count; ++k)
        {
            const double term = T[j][k] * solution[free_ones[k]];
            rest = rest - term;
        }
        solution[free_ones[j]] = T[j][j] > 0.0 ? rest / T[j][j] : u[free_ones[j]];
    }
}

/// The fixed parameter whose gradient points most into the box; -1 if none does.
static int released_parameter(double R[WIDEST_ROW][WIDEST_ROW], const bool is_free[4],
                              const double low[4], const double u[4])
{
    double rest[4];
    double steepest = 0.0;
    int released = -1;
    for (int row = 0; row < 4; ++row)
    {
        rest[row] = dot_product(4, R[row], u);
    }
    const double size = sqrt(dot_product(4, rest, rest));
    for (int i = 0; i < 4; ++i)
    {
        const double column[4] = {R[0][i], R[1][i], R[2][i], R[3][i]};
        if (is_free[i])
        {
            continue;
        }
        const double gradient = dot_product(4, column, rest);
        const double inwards = u[i] == low[i] ? -gradient : gradient;
        const double norm = sqrt(dot_product(4, column, column));
        if (inwards > FLAT_GRADIENT * norm * size && inwards / norm > steepest)
        {
            steepest = inwards / norm;
            released = i;
        }
    }
    return released;
}

static double limited_to(double value, double low, double high)
{
    const double raised = low > value ? low : value;
    return high < raised ? high : raised;
}

/// The u between `low` and `high` with the least |R u|, by active sets.
static void box_solution(double R[WIDEST_ROW][WIDEST_ROW], const double low[4],
                         const double high[4], double u[4])
{
    bool is_free[4];
    for (int i = 0; i < 4; ++i)
    {
        u[i] = limited_to(0.0, low[i], high[i]);
        is_free[i] = u[i] == 0.0;
    }
    for (int step = 0; step < BOX_STEPS; ++step)
    {
        double target[4];
        double share = 1.0;
        int limit = -1;
        free_solution(R, is_free, u, target);
        for (int i = 0; i < 4; ++i)
        {
            const double end = target[i] < low[i] ? low[i] : high[i];
            if (is_free[i] && !(low[i] <= target[i] && target[i] <= high[i]))
            {
                const double part = (end - u[i]) / (target[i] - u[i]);
                if (part < share)
                {
                    share = part;
                    limit = i;
                }
            }
        }
        for (int i = 0; i < 4; ++i)
        {
            if (is_free[i])
            {
                const double way = share * (target[i] - u[i]);
                u[i] = limited_to(limit < 0 ? target[i] : u[i] + way, low[i], high[i]);
            }
        }
        if (limit >= 0)
        {
            u[limit] = target[limit] < low[limit] ? low[limit] : high[limit];
            is_free[limit] = false;
            continue;
        }
        const int released = released_parameter(R, is_free, low, u);
        if (released < 0)
        {
            break;
        }
        is_free[released] = true;
    }
}

/// Deviation from a line in a range is at most MAX_DEVIATION for parameters that differ by u of
/// their scales; u is the nearest between `low` and `high`.
static bool is_near(double start, double end, const double scale[4], const double low[4],
                    const double high[4], double u[4])
{
    double A[NODE_COUNT][4];
    double columns[WIDEST_ROW][NODE_COUNT] = {{0.0}};
    double R[WIDEST_ROW][WIDEST_ROW];
    const double middle = (start + end) / 2.0;
    const double half = (end - start) / 2.0;
    for (int i = 0; i < NODE_COUNT; ++i)
    {
        const double x = middle + half * comparison_nodes[i];
        const double square = x * x;
        A[i][0] = scale[0];
        A[i][1] = x * scale[1];
        A[i][2] = square / 2.0 * scale[2];
        A[i][3] = square * x / 6.0 * scale[3];
        for (int j = 0; j < 4; ++j)
        {
            columns[j][i] = A[i][j];
        }
    }
    triangular_of(NODE_COUNT, 4, columns, R);
    box_solution(R, low, high, u);
    for (int i = 0; i < NODE_COUNT; ++i)
    {
        if (!(fabs(dot_product(4, A[i], u)) <= MAX_DEVIATION))
        {
            return false;
        }
    }
    return true;
}

/// Least and greatest value of a parameter, some steps within its range.
static void limits_of(const maplines_signal_t *signal, double *low, double *high)
{
    const double first = maplines_physical(signal, maplines_raw_min(signal));
    const double last = maplines_physical(signal, maplines_raw_max(signal));
    const double room = LIMIT_STEPS * signal->scale->factor;
    *low = first + room;
    *high = last - room;
}

MAPLINES_INTERNAL bool maplines_nearest_line(const maplines_signal_t signals[4],
                                             const double mean[4], const double x_range[2],
                                             double least, const double reach[4], double near[4],
                                             double near_range[2])
{
    double low[4];
    double high[4];
    double line[4];
    double scale[4];
    double down[4];
    double up[4];
    for (int i = 0; i < 4; ++i)
    {
        const double away = SIGMA_SHARE * reach[i];
        limits_of(&signals[i], &low[i], &high[i]);
        low[i] = mean[i] - away > low[i] ? mean[i] - away : low[i];
        high[i] = mean[i] + away < high[i] ? mean[i] + away : high[i];
        line[i] = mean[i];
    }
    low[1] = maplines_tan(limited_to(low[1], -STEEPEST_LINE, STEEPEST_LINE));
    high[1] = maplines_tan(limited_to(high[1], -STEEPEST_LINE, STEEPEST_LINE));
    line[1] = maplines_tan(mean[1]);
    for (int i = 0; i < 4; ++i)
    {
        scale[i] = fabs(low[i]) > fabs(high[i]) ? fabs(low[i]) : fabs(high[i]);
        if (!(high[i] - low[i] > 1e-9 * scale[i]))
        {
            return false;
        }
        down[i] = (low[i] - line[i]) / scale[i];
        up[i] = (high[i] - line[i]) / scale[i];
    }
    const double car = limited_to(0.0, x_range[0], x_range[1]);
    double share = 1.0;
    for (int trial = 0; trial < MAX_SHORTENED; ++trial)
    {
        double u[4];
        near_range[0] = car + share * (x_range[0] - car);
        near_range[1] = car + share * (x_range[1] - car);
        if (near_range[1] - near_range[0] < least)
        {
            return false;
        }
        if (is_near(near_range[0], near_range[1], scale, down, up, u))
        {
            for (int i = 0; i < 4; ++i)
            {
                near[i] = limited_to(line[i] + u[i] * scale[i], low[i], high[i]);
            }
            near[1] = maplines_atan(near[1]);
            return true;
        }
        share = share * SHORTER_RANGE;
    }
    return false;
}

MAPLINES_INTERNAL double maplines_slope_error(double beta, double near)
{
    double sine;
    double cosine;
    maplines_sin_cos(near, &sine, &cosine);
    return (maplines_tan(beta) - sine / cosine) * (cosine * cosine);
}

#endif
