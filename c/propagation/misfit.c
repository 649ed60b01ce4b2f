/* Variances that cover what a cubic misses of its line. */
#include "nodes.h"

#define MIN_SIGMA 0.004   ///< least level of the shape, and sigma of T_0 beside the misfit [m]
#define LATERAL_SHARE 0.2 ///< variance of T_0, in units of the squared misfit
#define MIN_SHAPE 0.1     ///< least level of the shape squared, in units of the squared misfit
#define SPACINGS 3        ///< distances over which second differences are covered
#define LIMIT 2.9         ///< standard deviations within which ...
#define SHARE 0.97        ///< ... this share of the second differences lies
#define MEAN_SQUARE 1.4   ///< of second differences, in units of their variances, at most
#define SHAPE_2 1.0       ///< variances of T_2 and T_3 by the level of the shape
#define SHAPE_3 2.0
#define MODES 2
#define MOST_BEYOND 3 ///< second differences beyond the share, of all cells

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

/// Least squared level for second differences over `steps` cells [m^2].
static double least_level(const double *rest, const double *position, size_t steps, double variance,
                          double far_noise, double mean_noise)
{
    const size_t width = (steps + 1) / 2;
    const size_t means = MAPLINES_CELLS + 1 - width;
    const size_t count = means - 2 * steps;
    const double h = (double)steps * 2.0 / MAPLINES_CELLS;
    const double scale = 1.0 / (h * h * (h * h));
    double mean[MAPLINES_CELLS];
    double noise[MAPLINES_CELLS];
    double greatest[MOST_BEYOND];
    double sum = 0.0;
    for (int i = 0; i < MOST_BEYOND; ++i)
    {
        greatest[i] = -(double)INFINITY;
    }
    for (size_t i = 0; i < means; ++i)
    {
        double part = 0.0;
        for (size_t k = i; k < i + width; ++k)
        {
            part = part + rest[k];
        }
        mean[i] = part / (double)width;
        noise[i] = variance / (1.0 + (position[i + width] - position[i]));
    }
    for (size_t i = 0; i < count; ++i)
    {
        // Second differences of T_2 are 4 h^2, those of T_3 are 24 w h^2, with w in the middle.
        const size_t j = i + steps;
        const size_t k = j + steps;
        const double w = (double)(2 * j + width) / MAPLINES_CELLS - 1.0;
        const double of_cubic = 24.0 * w;
        const double unit = scale / (16.0 * SHAPE_2 + of_cubic * of_cubic * SHAPE_3);
        const double second = mean[i] - 2.0 * mean[j] + mean[k];
        const double explained = noise[i] + 4.0 * noise[j] + noise[k];
        const double level = (second * second - far_noise * explained) * unit;
        sum = sum + (second * second - mean_noise * explained) * unit;
        if (level > greatest[MOST_BEYOND - 1])
        {
            insert(greatest, level);
        }
    }
    const size_t place = (size_t)ceil(SHARE * (double)count) - 1;
    const double far = greatest[count - 1 - place] / (LIMIT * LIMIT);
    const double near = sum / ((double)count * MEAN_SQUARE);
    return near > far ? near : far;
}

/// Least squared level for T_4 and T_5, which tell what is smooth from noise better [m^2].
static double level_of_modes(const maplines_fitted_t *fitted, double variance)
{
    // Mean squares of second derivatives of T_4 and T_5, each in units of its variance.
    static const double levels[MODES] = {2.6, 6.5};
    static const double explained[MODES] = {0.1, 0.8};   // variances of noise
    static const double variances[MODES] = {3.80, 3.62}; // of a mode, by errors of one point
    double level = 0.0;
    for (int m = 0; m < MODES; ++m)
    {
        const double noise = explained[m] * variances[m] * variance;
        const double square = fitted->modes[m] * fitted->modes[m] - noise;
        level = level + (square > 0.0 ? levels[m] * square / MEAN_SQUARE : 0.0);
    }
    return level;
}

void maplines_coefficient_variances(const maplines_stretch_t *stretch,
                                    const maplines_fitted_t *fitted, const maplines_cells_t *cells,
                                    const double rest[MAPLINES_CELLS], double variances[4])
{
    static const double spacings[SPACINGS] = {5.0, 10.0, 20.0};
    // Variances of noise that explain the largest second differences, and their mean square. Those
    // over short distances, which tell least of the shape, are hardest to tell from noise.
    static const double far_noise[SPACINGS] = {25.0, 12.0, 7.0};
    static const double mean_noise[SPACINGS] = {8.0, 6.0, 4.0};
    const double length = fitted->x_range[1] - fitted->x_range[0];
    const double points = cells->position[MAPLINES_CELLS] - cells->position[0];
    const double noise = maplines_noise_share(points) * stretch->error;
    const double squared = fitted->misfit * fitted->misfit;
    double level = level_of_modes(fitted, noise / points);
    level = level > MIN_SHAPE * squared ? level : MIN_SHAPE * squared;
    level = level > MIN_SIGMA * MIN_SIGMA ? level : MIN_SIGMA * MIN_SIGMA;
    for (int k = 0; k < SPACINGS; ++k)
    {
        const double apart = length / points; // less is not seen
        const double spacing = spacings[k] > apart ? spacings[k] : apart;
        const double share = rint(MAPLINES_CELLS * spacing / length);
        if (5.0 * share <= 2.0 * MAPLINES_CELLS)
        {
            const size_t steps = share > 1.0 ? (size_t)share : 1;
            const double least =
                least_level(rest, cells->position, steps, noise, far_noise[k], mean_noise[k]);
            level = least > level ? least : level;
        }
    }
    level = level + 2.0 * stretch->unseen;
    variances[0] = LATERAL_SHARE * (squared + stretch->unseen) + MIN_SIGMA * MIN_SIGMA;
    variances[1] = 0.25 * level;
    variances[2] = SHAPE_2 * level;
    variances[3] = SHAPE_3 * level;
}
