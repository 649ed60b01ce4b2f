/* Variances that cover what a cubic misses of its line: the operations of propagation/cubic_fit.py.
 */
#include "propagation.h"

#define GRID 129             ///< places of a range at which the rest is evaluated
#define INTERVALS (GRID - 1) ///< between them
#define MIN_SIGMA 0.01       ///< least level of the shape, and sigma of T_0 beside the misfit [m]
#define LATERAL_SHARE 0.2    ///< variance of T_0, in units of the squared misfit
#define MIN_SHAPE 0.1        ///< least level of the shape squared, in units of the squared misfit
#define SPACINGS 3           ///< distances over which second differences are covered
#define LIMIT 2.9            ///< standard deviations within which ...
#define SHARE 0.97           ///< ... this share of the second differences lies
#define NOISE_LIMIT 2.17     ///< the same for what errors of the points explain
#define SHOWN 4.0     ///< times the variance that points show is taken for that of their errors
#define MAX_SHOWN 2.0 ///< times the stated variance; beyond it is the shape of the road
#define MIN_POINTS 8  ///< that show a variance
#define MEDIAN 0.455  ///< of a squared standard normal variable
#define SHAPE_2 1.0   ///< variances of T_2 and T_3 by the level of the shape
#define SHAPE_3 2.0
#define MOST_BEYOND 5 ///< second differences beyond the share, of GRID

/* ---- errors of the points ---------------------------------------------------------------------
 */

/// The k-th smallest of values, which are reordered (Hoare's selection).
static double kth_smallest(size_t count, double *values, size_t k)
{
    size_t low = 0;
    size_t high = count - 1;
    while (low < high)
    {
        const double pivot = values[low + (high - low) / 2];
        size_t i = low;
        size_t j = high;
        while (i <= j)
        {
            while (values[i] < pivot)
            {
                ++i;
            }
            while (values[j] > pivot)
            {
                --j;
            }
            if (i <= j)
            {
                const double value = values[i];
                values[i] = values[j];
                values[j] = value;
                ++i;
                if (j == 0)
                {
                    break;
                }
                --j;
            }
        }
        if (k <= j)
        {
            high = j;
        }
        else if (k >= i)
        {
            low = i;
        }
        else
        {
            break;
        }
    }
    return values[k];
}

static double median_of(size_t count, double *values)
{
    const double upper = kth_smallest(count, values, count / 2);
    if (count % 2 == 1)
    {
        return upper;
    }
    double lower = values[0]; // the values before are not greater
    for (size_t i = 1; i < count / 2; ++i)
    {
        lower = values[i] > lower ? values[i] : lower;
    }
    return (lower + upper) / 2.0;
}

/// Variance of errors of the map's points that a line shows [m^2]: that of white noise with the
/// same median of the squared third differences of what the cubic leaves.
static double shown_noise(const maplines_stretches_t *seen, size_t line, const double x[GRID],
                          const double cubic[GRID], double *rest)
{
    const maplines_stretch_t *stretch = &seen->stretch[line];
    size_t count = 0;
    for (size_t i = stretch->first; i < stretch->first + stretch->count; ++i)
    {
        const double at = seen->x[i];
        if (at >= x[0] && at <= x[GRID - 1])
        {
            size_t low = 0;
            size_t high = GRID;
            while (high - low > 1)
            {
                const size_t middle = (low + high) / 2;
                low = x[middle] <= at ? middle : low;
                high = x[middle] <= at ? high : middle;
            }
            double value = cubic[low];
            if (low + 1 < GRID && at > x[low])
            {
                const double slope = (cubic[low + 1] - cubic[low]) / (x[low + 1] - x[low]);
                value = slope * (at - x[low]) + cubic[low];
            }
            rest[count] = seen->y[i] - value;
            ++count;
        }
    }
    if (count < MIN_POINTS)
    {
        return 0.0;
    }
    for (int order = 0; order < 3; ++order)
    {
        --count;
        for (size_t i = 0; i < count; ++i)
        {
            rest[i] = rest[i + 1] - rest[i];
        }
    }
    for (size_t i = 0; i < count; ++i)
    {
        rest[i] = rest[i] * rest[i];
    }
    return median_of(count, rest) / (20.0 * MEDIAN);
}

/// Variance of a second difference for unit errors of the points, of which each place has the
/// weighted mean of two.
static double second_difference_variance(const double place[3])
{
    static const double factors[3] = {1.0, -2.0, 1.0};
    double index[6];
    double weight[6];
    double variance = 0.0;
    for (int i = 0; i < 3; ++i)
    {
        index[i] = floor(place[i]);
        index[3 + i] = index[i] + 1.0;
        weight[i] = factors[i] * (1.0 - (place[i] - index[i]));
        weight[3 + i] = factors[i] * (place[i] - index[i]);
    }
    for (int i = 0; i < 6; ++i)
    {
        for (int j = 0; j < 6; ++j)
        {
            variance += index[i] == index[j] ? weight[i] * weight[j] : 0.0;
        }
    }
    return variance;
}

/* ---- the level of the shape -------------------------------------------------------------------
 */

/// Keep the greatest values of those that were inserted, the greatest first.
static void insert(double greatest[MOST_BEYOND], double value)
{
    for (int i = 0; i < MOST_BEYOND; ++i)
    {
        if (value > greatest[i])
        {
            const double next = greatest[i];
            greatest[i] = value;
            value = next;
        }
    }
}

/// Least squared level for second differences over `steps` of the grid [m^2].
static double least_level(const double rest[GRID], int steps, const double *position, double noise)
{
    double greatest[MOST_BEYOND];
    double terms[GRID] = {0.0};
    double levels[GRID];
    double squares[GRID];
    double variances[GRID]; // of the second differences for the level 1
    const int count = GRID - 2 * steps;
    const double h = steps * 2.0 / INTERVALS;
    const double h2 = h * h;
    for (int i = 0; i < MOST_BEYOND; ++i)
    {
        greatest[i] = -(double)INFINITY;
    }
    for (int i = 0; i < count; ++i)
    {
        // Second differences of T_2 are 4 h^2, those of T_3 are 24 w h^2, with w in the middle.
        const double w = (i * (2.0 / INTERVALS) - 1.0) + h;
        const double of_cubic = 24.0 * w;
        const double second = rest[i] - 2.0 * rest[i + steps] + rest[i + 2 * steps];
        variances[i] = h2 * h2 * (16.0 * SHAPE_2 + of_cubic * of_cubic * SHAPE_3);
        squares[i] = second * second;
        terms[i] = squares[i] / variances[i];
        levels[i] = terms[i];
    }
    for (int i = 0; noise > 0.0 && i < count; ++i)
    {
        const double place[3] = {position[i], position[i + steps], position[i + 2 * steps]};
        const double explained = noise * second_difference_variance(place);
        terms[i] = (squares[i] - explained) / variances[i];
        levels[i] = (squares[i] - NOISE_LIMIT * NOISE_LIMIT * explained) / variances[i];
    }
    for (int i = 0; i < count; ++i)
    {
        if (levels[i] > greatest[MOST_BEYOND - 1])
        {
            insert(greatest, levels[i]);
        }
    }
    const int place = (int)ceil(SHARE * count) - 1;
    const double far = greatest[count - 1 - place] / (LIMIT * LIMIT);
    const double mean = maplines_total(GRID, terms) / count;
    return mean > far ? mean : far;
}

void maplines_coefficient_variances(const maplines_stretches_t *seen, size_t line,
                                    const maplines_fitted_t *fitted, double point_sigma,
                                    double *scratch, double variances[4])
{
    static const double spacings[SPACINGS] = {5.0, 10.0, 20.0};
    double x[GRID];
    double cubic[GRID];
    double rest[GRID];
    double position[GRID];
    const double centre = (fitted->x_range[0] + fitted->x_range[1]) / 2.0;
    const double half = (fitted->x_range[1] - fitted->x_range[0]) / 2.0;
    const double *q = fitted->q;
    for (int i = 0; i < GRID; ++i)
    {
        const double w = i * (2.0 / INTERVALS) - 1.0;
        const double offset = half * w;
        const double third = w * q[3];
        const double second = w * (q[2] + third);
        const double first = w * (q[1] + second);
        x[i] = centre + offset;
        cubic[i] = q[0] + first;
    }
    maplines_lateral(seen, line, GRID, x, rest);
    for (int i = 0; i < GRID; ++i)
    {
        rest[i] = rest[i] - cubic[i];
    }
    double noise = 0.0;
    if (point_sigma > 0.0)
    {
        const double stated = point_sigma * point_sigma;
        const double shown = shown_noise(seen, line, x, cubic, scratch);
        if (shown <= MAX_SHOWN * stated)
        {
            noise = SHOWN * shown < stated ? SHOWN * shown : stated;
        }
        maplines_positions(seen, line, GRID, x, position);
    }
    const double squared = fitted->misfit * fitted->misfit;
    double level = MIN_SHAPE * squared;
    level = level > MIN_SIGMA * MIN_SIGMA ? level : MIN_SIGMA * MIN_SIGMA;
    for (int k = 0; k < SPACINGS; ++k)
    {
        const double share = INTERVALS * spacings[k] / (fitted->x_range[1] - fitted->x_range[0]);
        if (2.0 * share <= INTERVALS + 2.0)
        {
            const int steps = (int)rint(share) > 1 ? (int)rint(share) : 1;
            const double least =
                2 * steps <= INTERVALS ? least_level(rest, steps, position, noise) : 0.0;
            level = least > level ? least : level;
        }
    }
    variances[0] = LATERAL_SHARE * squared + MIN_SIGMA * MIN_SIGMA;
    variances[1] = 0.25 * level;
    variances[2] = SHAPE_2 * level;
    variances[3] = SHAPE_3 * level;
}
