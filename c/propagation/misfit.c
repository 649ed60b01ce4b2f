/* Variances that cover what a cubic misses of its line. */
#include "nodes.h"

#define MIN_SIGMA 0.004   ///< least level of the shape, and sigma of T_0 beside the misfit [m]
#define LATERAL_SHARE 0.2 ///< variance of T_0, in units of the squared misfit
#define MIN_SHAPE 0.1     ///< least level of the shape squared, in units of the squared misfit
#define SPACINGS 3        ///< distances over which second differences are covered
#define LIMIT 2.3         ///< standard deviations within which second differences lie
#define MEAN_SQUARE 1.4   ///< of second differences, in units of their variances, at most
#define SHAPE_2 1.0       ///< variances of T_2 and T_3 by the level of the shape
#define SHAPE_3 2.0
#define SHAPE_BY_KINKS 7e-4 ///< of hidden kinks, by their intensity and the cubed length
#define MODES 2
#define PLACES 32   ///< of second differences in a range
#define LONGEST 0.4 ///< distance of second differences, as a share of the range

/// Least squared level for second differences over a distance in cells [m^2], of means over half of
/// it, of which errors of the points give each difference a variance of `noise`.
static double least_level(const double sums[MAPLINES_CELLS + 2], double distance, double noise,
                          double far_noise, double mean_noise)
{
    const double width = distance / 2.0;
    const double step = (MAPLINES_CELLS - width - 2.0 * distance) / (PLACES - 1);
    const double h = distance * 2.0 / MAPLINES_CELLS;
    const double scale = 1.0 / (h * h * (h * h));
    const double shrink = 1.0 / (width * width);
    double unit[PLACES];
    double greatest[2] = {-(double)INFINITY, -(double)INFINITY};
    double sum = 0.0;
    for (int i = 0; i < PLACES; ++i)
    {
        // Second differences of T_2 are 4 h^2, those of T_3 are 24 w h^2, with w in the middle.
        const double middle = i * step + distance;
        const double w = (2.0 * middle + width) / MAPLINES_CELLS - 1.0;
        const double of_cubic = 24.0 * w;
        unit[i] = scale / (16.0 * SHAPE_2 + of_cubic * of_cubic * SHAPE_3);
    }
    for (int i = 0; i < PLACES; ++i)
    {
        const double begin = i * step;
        const double middle = begin + distance;
        const double end = middle + distance;
        const double first = maplines_sum_to(sums, begin + width) - maplines_sum_to(sums, begin);
        const double second = maplines_sum_to(sums, middle + width) - maplines_sum_to(sums, middle);
        const double third = maplines_sum_to(sums, end + width) - maplines_sum_to(sums, end);
        const double difference = first - 2.0 * second + third;
        const double square = difference * difference * shrink;
        const double level = (square - far_noise * noise) * unit[i];
        const double less = level > greatest[0] ? greatest[0] : level;
        sum = sum + (square - mean_noise * noise) * unit[i];
        greatest[0] = level > greatest[0] ? level : greatest[0];
        greatest[1] = less > greatest[1] ? less : greatest[1];
    }
    const double far = greatest[1] / (LIMIT * LIMIT); // one of 32 may be beyond
    const double near = sum / (PLACES * MEAN_SQUARE);
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
                                    const double sums[MAPLINES_CELLS + 2], double variances[4])
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
        const double most = LONGEST * length;
        const double distance = MAPLINES_CELLS * (spacing < most ? spacing : most) / length;
        const double kept = 1.0 / (1.0 + distance / 2.0 * points / MAPLINES_CELLS);
        const double least =
            least_level(sums, distance, 6.0 * kept * noise, far_noise[k], mean_noise[k]);
        level = least > level ? least : level;
    }
    level = level + 2.0 * stretch->unseen;
    level = level + SHAPE_BY_KINKS * stretch->kinks * (length * length * length);
    variances[0] = LATERAL_SHARE * (squared + stretch->unseen) + MIN_SIGMA * MIN_SIGMA;
    variances[1] = 0.25 * level;
    variances[2] = SHAPE_2 * level;
    variances[3] = SHAPE_3 * level;
}
