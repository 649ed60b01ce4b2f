/* Cubics of lines, and the longest ranges in which they follow them. */
#include "nodes.h"

#define DAMPING 0.05 ///< of the inverse of M; the curvature of cubics is right to 0.1 %
#define BULGE 0.5    ///< of the sagittas that points show: most of a cubic between points
#define AVERAGE 4.0  ///< length over which what a cubic leaves is averaged [m]
#define NOISE_LIMIT 14.0
#define NARROW_LIMIT 25.0 ///< the same in the greatest rest of a cell
#define SHARED_POINTS 20.0
#define BY_KINKS 3e-4 ///< squared misfit of hidden kinks, by their intensity and the cubed length
#define STARTS 5      ///< of ranges that are tried
#define ENDS 6        ///< and ends of each
#define SOFT 0.2
#define BEHIND 0.5      ///< a metre behind the car counts this share of a metre ahead
#define LEAST_STEP 1e-6 ///< of the root of the misfit
#define NEARLY 8.0      ///< ranges whose reach is less than the best by up to this count, too [m]
#define SHRINK 0.998    ///< least shortening of a range whose misfit is still too large
#define SHRINKS 200     ///< most times

static double limited(double value, double low, double high)
{
    const double raised = value > low ? value : low;
    return raised < high ? raised : high;
}

/// Linear map from the coefficients of the chords of a line to those of its cubic: the chords of
/// w^2 and w^3 exceed them by what has these coefficients.
///
/// The curvature (q2, q3) solves M q = that of the chords. M is 1 for close points. Where few
/// points cannot tell the curvature, M is nearly singular, and the least curvature is taken.
static void set_fit(const double squares[MAPLINES_TERMS], const double cubes[MAPLINES_TERMS],
                    double fit[16])
{
    const double a = 1.0 + squares[2];
    const double b = cubes[2];
    const double c = squares[3];
    const double d = 1.0 + cubes[3];
    const double weight = DAMPING * DAMPING;
    const double aa = a * a + c * c + weight;
    const double ab = a * b + c * d;
    const double bb = b * b + d * d + weight;
    const double scale = (1.0 + weight) / (aa * bb - ab * ab);
    const double by_square[2] = {(bb * a - ab * b) * scale, (bb * c - ab * d) * scale};
    const double by_cube[2] = {(aa * b - ab * a) * scale, (aa * d - ab * c) * scale};
    for (int j = 0; j < 2; ++j)
    {
        for (int i = 0; i < 2; ++i)
        {
            fit[4 * i + j] = i == j ? 1.0 : 0.0;
            fit[4 * i + 2 + j] = -(squares[i] * by_square[j] + cubes[i] * by_cube[j]);
            fit[4 * (2 + i) + j] = 0.0;
        }
        fit[8 + 2 + j] = by_square[j];
        fit[12 + 2 + j] = by_cube[j];
    }
}

/// Cubic in a range by least squares.
///
/// Its chords between the points are fitted to those of the line. So it is exact where the points
/// lie on a cubic, however far apart they are.
static void fit_cells(const maplines_stretches_t *seen, size_t line, int count,
                      maplines_fitted_t *fitted, maplines_cells_t *cells)
{
    maplines_divide(seen, line, fitted->x_range, count, cells);
    maplines_set_terms(count, cells);
    const double *of_chords = cells->terms[0];
    const double *squares = cells->terms[1];
    const double *cubes = cells->terms[2];
    set_fit(squares, cubes, fitted->fit);
    double q[4];
    for (int i = 0; i < 4; ++i)
    {
        const double *row = fitted->fit + 4 * i;
        const double first = row[0] * of_chords[0];
        const double second = row[1] * of_chords[1];
        const double third = row[2] * of_chords[2];
        const double fourth = row[3] * of_chords[3];
        q[i] = first + second + third + fourth;
    }
    memcpy(fitted->q, q, sizeof q);
    for (int m = 0; m < 2; ++m)
    {
        const double by_curvature = q[2] * squares[4 + m] + q[3] * cubes[4 + m];
        fitted->modes[m] = of_chords[4 + m] - by_curvature;
    }
}

/// What a cubic leaves of its line in each cell.
static void set_rest(const maplines_stretch_t *stretch, int count, const maplines_fitted_t *fitted,
                     const maplines_cells_t *cells, double *rest)
{
    const double *q = fitted->q;
    const double shown = BULGE * sqrt(stretch->sagitta);
    const double half_cell = 1.0 / count;
    for (int k = 0; k < count; ++k)
    {
        const double w = (2 * k + 1) * half_cell - 1.0;
        const double square = w * w + half_cell * half_cell / 3.0;
        const double cube = w * (w * w + half_cell * half_cell);
        const double bulge = q[2] * cells->square[k] + q[3] * cells->cube[k];
        const double cubic = q[0] + q[1] * w + (q[2] * square + q[3] * cube);
        const double more = fabs(bulge) > shown ? fabs(bulge) - shown : 0.0;
        rest[k] = cells->y[k] - (cubic + bulge) + (bulge > 0.0 ? more : -more);
    }
}

double maplines_noise_share(double points)
{
    const double square = points * points;
    return square / (square + SHARED_POINTS * SHARED_POINTS);
}

/// Squared misfit of a cubic: the greatest mean over some metres or a cell, without what errors of
/// the points explain of it, or the modes; and that of kinks which these errors hide. Sets the sums
/// (count + 2) of what the cubic leaves.
static double squared_misfit(const maplines_stretch_t *stretch, int count,
                             const maplines_fitted_t *fitted, const maplines_cells_t *cells,
                             double *sums)
{
    double rest[MAPLINES_CELLS];
    const double points = cells->position[count] - cells->position[0];
    const double length = fitted->x_range[1] - fitted->x_range[0];
    const double width = limited(AVERAGE * count / length, 1.0, count / 4.0);
    const double noise = NOISE_LIMIT * maplines_noise_share(points) * stretch->error /
                         (1.0 + width * points / count);
    const double narrow =
        NARROW_LIMIT * maplines_noise_share(points) * stretch->error / (1.0 + points / count);
    const double step = (count - width) / (count - 1.0);
    const double scale = 1.0 / width;
    double widest = 0.0; // of sums over the width
    double own = 0.0;    // of rests of a cell
    set_rest(stretch, count, fitted, cells, rest);
    sums[0] = 0.0;
    for (int k = 0; k < count; ++k)
    {
        sums[k + 1] = sums[k] + rest[k];
    }
    sums[count + 1] = sums[count]; // of a place at the end
    for (int k = 0; k < count; ++k)
    {
        const double begin = k * step;
        const double sum = maplines_sum_to(sums, begin + width) - maplines_sum_to(sums, begin);
        widest = fabs(sum) > widest ? fabs(sum) : widest;
        own = fabs(rest[k]) > own ? fabs(rest[k]) : own;
    }
    const double mean = widest * scale;
    const double *modes = fitted->modes;
    double greatest = modes[0] * modes[0] + modes[1] * modes[1];
    greatest = mean * mean - noise > greatest ? mean * mean - noise : greatest;
    greatest = own * own - narrow > greatest ? own * own - narrow : greatest;
    return greatest + BY_KINKS * stretch->kinks * (length * length * length);
}

/// Cubic in its range, and the sums of what it leaves.
static void fit_range(const maplines_stretches_t *seen, size_t line, maplines_fitted_t *fitted,
                      maplines_cells_t *cells, double sums[MAPLINES_CELLS + 2])
{
    const maplines_stretch_t *stretch = &seen->stretch[line];
    fit_cells(seen, line, MAPLINES_CELLS, fitted, cells);
    fitted->misfit = sqrt(squared_misfit(stretch, MAPLINES_CELLS, fitted, cells, sums));
}

/* ---- the longest range ------------------------------------------------------------------------
 */

/// Move the ends of a range inwards to multiples of a step, if it is not 0 and the range is long.
static void make_whole(double step, double x_range[2])
{
    if (step == 0.0)
    {
        return;
    }
    const double low = ceil(x_range[0] / step) * step;
    const double high = floor(x_range[1] / step) * step;
    if (low + step <= high)
    {
        x_range[0] = low;
        x_range[1] = high;
    }
}

/// Root of the misfit in a range, in units of the greatest one; it grows as the square of the
/// range.
static double root_misfit(const maplines_stretches_t *seen, size_t line, double low, double high,
                          double max_misfit)
{
    maplines_fitted_t fitted = {{low, high}, {0.0}, {0.0}, 0.0, {0.0}};
    maplines_cells_t cells;
    double sums[MAPLINES_COARSE + 2];
    if (!(low < high))
    {
        return 0.0;
    }
    fit_cells(seen, line, MAPLINES_COARSE, &fitted, &cells);
    const double square =
        squared_misfit(&seen->stretch[line], MAPLINES_COARSE, &fitted, &cells, sums);
    return sqrt(sqrt(square)) / sqrt(max_misfit);
}

/// Integral from 0 of how good a range is: 1, and 0 if the root of its misfit is 1 or more.
static double goodness_to(double root)
{
    const double v = root - (1.0 - SOFT);
    const double w = v < SOFT ? v : SOFT;
    return v > 0.0 ? 1.0 - SOFT + (w - w * w / (2.0 * SOFT)) : root;
}

/// Mean goodness while the root of the misfit goes from one value to another.
static double goodness(double from, double to)
{
    const double step = to - from;
    const double at = limited((1.0 - from) / SOFT, 0.0, 1.0);
    return fabs(step) > LEAST_STEP ? (goodness_to(to) - goodness_to(from)) / step : at;
}

/// Range of a stretch with the longest reach.
///
/// All ends from the car on count by how good they are, and all starts by their reach. So the range
/// moves with the car.
static void search_range(const maplines_stretches_t *seen, size_t line, const maplines_fit_t *fit,
                         double x_range[2])
{
    static const double starts[STARTS] = {0.0, 0.15, 0.35, 0.65, 1.0};
    const double low = seen->stretch[line].x_range[0];
    const double high = seen->stretch[line].x_range[1];
    const double car = limited(-fit->room, low, high);
    double begins[STARTS];
    double ends[STARTS];
    double weights[STARTS];
    double best = -(double)INFINITY;
    for (int i = 0; i < STARTS; ++i)
    {
        const double begin = car + (low - car) * starts[i];
        double root = root_misfit(seen, line, begin, car, fit->max_misfit);
        begins[i] = begin;
        ends[i] = car;
        weights[i] = goodness(root, root);
        for (int k = 1; k <= ENDS; ++k)
        {
            const double end = k < ENDS ? car + (high - car) * ((double)k / ENDS) : high;
            const double next = root_misfit(seen, line, begin, end, fit->max_misfit);
            ends[i] = ends[i] + (high - car) / ENDS * goodness(root, next);
            root = next;
        }
        const double reach = ends[i] - BEHIND * begin;
        best = weights[i] > 0.0 && reach > best ? reach : best;
    }
    double begin = 0.0;
    double end = 0.0;
    double sum = 0.0;
    for (int i = 0; i < STARTS; ++i)
    {
        const double lack = (best - (ends[i] - BEHIND * begins[i])) / NEARLY;
        const double nearness = lack < 1.0 ? 1.0 - lack : 0.0;
        const double weight = weights[i] > 0.0 ? weights[i] * (nearness * nearness) : 0.0;
        begin = begin + weight * begins[i];
        end = end + weight * ends[i];
        sum = sum + weight;
    }
    x_range[0] = begin / sum;
    x_range[1] = end / sum;
}

bool maplines_longest_range(const maplines_stretches_t *seen, size_t line,
                            const maplines_fit_t *fit, maplines_fitted_t *fitted,
                            maplines_cells_t *cells, double sums[MAPLINES_CELLS + 2])
{
    const maplines_stretch_t *stretch = &seen->stretch[line];
    double *x_range = fitted->x_range;
    memcpy(x_range, stretch->x_range, sizeof fitted->x_range);
    make_whole(fit->step, x_range);
    fit_range(seen, line, fitted, cells, sums);
    if (fitted->misfit > fit->max_misfit)
    {
        search_range(seen, line, fit, x_range);
        make_whole(fit->step, x_range);
        fit_range(seen, line, fitted, cells, sums);
    }
    for (int i = 0; fitted->misfit > fit->max_misfit; ++i)
    {
        // What a cubic misses grows with the fourth power of a range.
        const double share = SHRINK * sqrt(sqrt(fit->max_misfit / fitted->misfit));
        const double car = limited(0.0, x_range[0], x_range[1]);
        if (i == SHRINKS)
        {
            return false;
        }
        x_range[0] = car + share * (x_range[0] - car);
        x_range[1] = car + share * (x_range[1] - car);
        make_whole(fit->step, x_range);
        fit_range(seen, line, fitted, cells, sums);
    }
    return fabs(fitted->misfit) < (double)INFINITY && x_range[0] < x_range[1];
}
