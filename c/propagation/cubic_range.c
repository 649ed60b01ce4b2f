/* Longest ranges in which cubics follow lines. */
#include "nodes.h"

#define STARTS 9 ///< of ranges that are tried
#define ENDS 4   ///< that are tried in a round of the search
#define ROUNDS 4
#define BEHIND 0.5    ///< a metre behind the car counts this share of a metre ahead
#define SHRINK 0.97   ///< of a range whose misfit is still too large
#define SHRINKS 10000 ///< most times; a range of 100 km is then shorter than a nanometre

/// Sum over values whose number is a power of 2; halves are added to each other.
static double sum_of_halves(size_t count, double *values)
{
    for (size_t half = count / 2; half > 0; half /= 2)
    {
        for (size_t i = 0; i < half; ++i)
        {
            values[i] = values[i] + values[half + i];
        }
    }
    return values[0];
}

/// Coefficients of w^0 .. w^3 of the cubic through values at nodes, by the rows of their fit.
static void cubic_of(size_t count, const double *rows, const double *y, double q[4])
{
    double terms[MAPLINES_NODES];
    for (size_t j = 0; j < 4; ++j)
    {
        const double *row = rows + j * count;
        for (size_t i = 0; i < count; ++i)
        {
            terms[i] = row[i] * y[i];
        }
        q[j] = sum_of_halves(count, terms);
    }
}

/// Value of a cubic.
static double cubic_at(const double q[4], double w)
{
    const double third = w * q[3];
    const double second = w * (q[2] + third);
    const double first = w * (q[1] + second);
    return q[0] + first;
}

static void include(double value, double *least, double *greatest)
{
    *least = value < *least ? value : *least;
    *greatest = value > *greatest ? value : *greatest;
}

/// Positions of nodes in a range.
static void at_nodes(double low, double high, size_t count, const double *nodes, double *x)
{
    const double centre = (low + high) / 2.0;
    const double half = (high - low) / 2.0;
    for (size_t i = 0; i < count; ++i)
    {
        const double offset = half * nodes[i];
        x[i] = centre + offset;
    }
}

/// Cubic in a range of a stretch.
static void fit_range(const maplines_stretches_t *seen, size_t line, const double x_range[2],
                      maplines_fitted_t *fitted)
{
    const maplines_stretch_t *stretch = &seen->stretch[line];
    const double low = x_range[0];
    const double high = x_range[1];
    const double centre = (low + high) / 2.0;
    const double half = (high - low) / 2.0;
    const double *nodes = maplines_nodes();
    double least = (double)INFINITY;
    double greatest = -(double)INFINITY;
    fitted->x_range[0] = low;
    fitted->x_range[1] = high;
    at_nodes(low, high, MAPLINES_NODES, nodes, fitted->x);
    maplines_lateral(seen, line, MAPLINES_NODES, fitted->x, fitted->y);
    cubic_of(MAPLINES_NODES, maplines_fit_rows, fitted->y, fitted->q);
    for (int i = 0; i < MAPLINES_NODES; ++i)
    {
        include(fitted->y[i] - cubic_at(fitted->q, nodes[i]), &least, &greatest);
    }
    for (size_t i = stretch->first; i < stretch->first + stretch->count; ++i)
    {
        const double w = (seen->x[i] - centre) / half;
        const double rest = seen->y[i] - cubic_at(fitted->q, w);
        include(fabs(w) >= 1.0 ? 0.0 : rest, &least, &greatest);
    }
    fitted->shift = (greatest + least) / 2.0;
    fitted->misfit = (greatest - least) / 2.0;
}

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

static double limited(double value, double low, double high)
{
    const double raised = value > low ? value : low;
    return raised < high ? raised : high;
}

/// Range that is tried: its start, and the interval that contains the end of the longest one.
typedef struct {
    double begin, inner, outer; ///< [m]
    double reach;               ///< of the longest range that was found; -infinity if none was
    bool is_found;
} candidate_t;

/// The deviations of a line from its cubic span at most `span` in a range.
static bool follows(const maplines_stretches_t *seen, size_t line, double low, double high,
                    double span)
{
    double x[MAPLINES_COARSE];
    double y[MAPLINES_COARSE];
    double q[4];
    double least = (double)INFINITY;
    double greatest = -(double)INFINITY;
    at_nodes(low, high, MAPLINES_COARSE, maplines_coarse_nodes, x);
    maplines_lateral(seen, line, MAPLINES_COARSE, x, y);
    cubic_of(MAPLINES_COARSE, maplines_coarse_rows, y, q);
    for (int i = 0; i < MAPLINES_COARSE; ++i)
    {
        include(y[i] - cubic_at(q, maplines_coarse_nodes[i]), &least, &greatest);
    }
    return greatest - least <= span;
}

/// Narrow the interval of a candidate to the part that has the end of its longest range.
static void narrow(const maplines_stretches_t *seen, size_t line, double span,
                   candidate_t *candidate)
{
    static const double shares[ENDS] = {0.25, 0.5, 0.75, 1.0};
    double ends[ENDS] = {0.0};
    const double length = candidate->outer - candidate->inner;
    for (int i = 0; i < ENDS; ++i)
    {
        const double part = length * shares[i];
        ends[i] = candidate->inner + part;
    }
    int farthest = ENDS - 1; // that is good
    while (farthest >= 0 && !follows(seen, line, candidate->begin, ends[farthest], span))
    {
        --farthest;
    }
    candidate->outer = ends[farthest + 1 < ENDS ? farthest + 1 : ENDS - 1];
    if (farthest >= 0)
    {
        candidate->inner = ends[farthest];
        candidate->is_found = true;
    }
    const double behind = BEHIND * candidate->begin;
    candidate->reach = candidate->is_found ? candidate->inner - behind : -(double)INFINITY;
}

/// Range of a stretch with the longest reach, about `room` behind the car.
static void search_range(const maplines_stretches_t *seen, size_t line, const maplines_fit_t *fit,
                         double x_range[2])
{
    static const double starts[STARTS] = {0.0, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0};
    const double low = seen->stretch[line].x_range[0];
    const double high = seen->stretch[line].x_range[1];
    const double car = limited(-fit->room, low, high);
    candidate_t candidates[STARTS];
    int count = STARTS;
    for (int i = 0; i < STARTS; ++i)
    {
        const double back = (low - car) * starts[i];
        candidates[i].begin = car + back;
        candidates[i].inner = car;
        candidates[i].outer = high;
        candidates[i].is_found = candidates[i].begin == car;
    }
    for (int round = 0; round < ROUNDS; ++round)
    {
        double best = -(double)INFINITY;
        int kept = 0;
        for (int i = 0; i < count; ++i)
        {
            narrow(seen, line, 2.0 * fit->max_misfit, &candidates[i]);
            best = candidates[i].reach > best ? candidates[i].reach : best;
        }
        for (int i = 0; i < count; ++i) // those that may become the best
        {
            const double behind = BEHIND * candidates[i].begin;
            if (candidates[i].outer - behind >= best)
            {
                candidates[kept] = candidates[i];
                ++kept;
            }
        }
        count = kept;
    }
    int chosen = 0; // the last one of the best
    for (int i = 1; i < count; ++i)
    {
        chosen = candidates[i].reach >= candidates[chosen].reach ? i : chosen;
    }
    x_range[0] = candidates[chosen].begin;
    x_range[1] = candidates[chosen].inner;
}

bool maplines_longest_range(const maplines_stretches_t *seen, size_t line,
                            const maplines_fit_t *fit, maplines_fitted_t *fitted)
{
    const maplines_stretch_t *stretch = &seen->stretch[line];
    double x_range[2] = {stretch->x_range[0], stretch->x_range[1]};
    make_whole(fit->step, x_range);
    fit_range(seen, line, x_range, fitted);
    if (fitted->misfit > fit->max_misfit)
    {
        search_range(seen, line, fit, x_range);
        make_whole(fit->step, x_range);
        fit_range(seen, line, x_range, fitted);
    }
    for (int i = 0; fitted->misfit > fit->max_misfit; ++i)
    {
        const double car = limited(0.0, x_range[0], x_range[1]);
        const double behind = SHRINK * (x_range[0] - car);
        const double ahead = SHRINK * (x_range[1] - car);
        if (i == SHRINKS)
        {
            return false;
        }
        x_range[0] = car + behind;
        x_range[1] = car + ahead;
        make_whole(fit->step, x_range);
        fit_range(seen, line, x_range, fitted);
    }
    return fabs(fitted->misfit) < (double)INFINITY && fitted->x_range[0] < fitted->x_range[1];
}
