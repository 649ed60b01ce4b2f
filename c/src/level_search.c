/* Search for the levels of a line-specific covariance that cover a target at the least cost.
 *
 * The cost is the divergence from the true covariance plus the logarithm of the largest ratio of
 * variances of the lateral position or the direction of the line. For each spacing of the points
 * the least level of the points is found by bisection; one above it is tried. There the line is
 * taken for a straight one if it nearly is, since the covariances of a straight line are in the
 * tables. For the best spacings some more are tried, with the covariances of the line itself, and
 * some levels of the shape alone. The candidates come one after the other, in the order of
 * wire/covariance/specific_levels.py; the first one of equal cost is taken.
 */
#include "internal.h"

#define CHOSEN 24 // spacings for which all levels are tried, as in maplines_sent_line_t
#define TRIED 5   // levels that are tried, from the least one on
#define KEPT 64   // levels whose squares are computed once

static const int64_t tried[TRIED] = {0, 1, 2, 3, 5};

/// More than any level squared [m^2].
static const double beyond = 1e100;
/// Added to the variances that errors of points cause: those of points far apart may be singular.
static const double singular = 1e-6;
static const double natural_log_of_2 = 0x1.62e42fefa39efp-1;
/// Ratio of the largest to the least stretch of a line that is nearly straight.
static const double nearly_straight = 1.1;

/// Squares of levels; 0 until they are computed.
typedef struct {
    const maplines_signal_t *signal;
    double squares[KEPT];
} squares_t;

/// What levels are to cover, in coefficients of T_0 .. T_3.
typedef struct {
    const maplines_dbc_t *dbc;
    const maplines_levels_t *levels;
    maplines_arc_t arc;
    double stretch_squared; ///< of a line that is nearly straight; else 0
    double lacking[16];     ///< what the levels are to cover
    double common[16];      ///< what is added to their covariance
    maplines_reference_t reference;
    squares_t lateral;
    squares_t points;
} search_t;

/// Raw values of the levels and their cost.
typedef struct {
    int64_t lateral;
    int64_t points;
    int64_t shape;
    double cost;
} candidate_t;

/// Spacing that is among the best so far.
typedef struct {
    double cost;
    int64_t raw; ///< of the shape
} spacing_t;

/// Square of the level of a raw value, or of the greatest one.
static double level_squared(squares_t *of, int64_t raw)
{
    const bool is_kept = raw < KEPT;
    if (is_kept && of->squares[raw] > 0.0)
    {
        return of->squares[raw];
    }
    const double level = maplines_level(of->signal, raw);
    const double square = level * level;
    if (is_kept)
    {
        of->squares[raw] = square;
    }
    return square;
}

static double shape_squared(const maplines_levels_t *levels, int64_t raw)
{
    const double level = maplines_shape_level(levels, raw);
    return level * level;
}

/// Pivots of the Cholesky factorization of a symmetric matrix without row and column 0.
typedef struct {
    double a;
    double d1;
    double e1;
    double f2;
} pivots_t;

static pivots_t pivots_of(const double M[16])
{
    const double a = M[5];
    const double b = M[9];
    const double c = M[13];
    const double d1 = M[10] - b * b / a;
    const double e1 = M[14] - b * c / a;
    const double rest = M[15] - c * c / a;
    const double f2 = rest - e1 * e1 / d1;
    const pivots_t pivots = {a, d1, e1, f2};
    return pivots;
}

static bool are_positive(const pivots_t *pivots)
{
    return pivots->a > 0.0 && pivots->d1 > 0.0 && pivots->f2 > 0.0;
}

/// What to add to entry (0, 0) of a matrix to make it semidefinite; beyond all levels if the rest
/// of it is not definite.
static double shortfall(const double M[16])
{
    const pivots_t p = pivots_of(M);
    const double b = M[9];
    const double c = M[13];
    const double g = M[4];
    const double h1 = M[8] - b * g / p.a;
    const double rest = M[12] - c * g / p.a;
    const double i2 = rest - p.e1 * h1 / p.d1;
    const double two = g * g / p.a + h1 * h1 / p.d1;
    const double three = two + i2 * i2 / p.f2;
    const double lacks = three - M[0];
    return are_positive(&p) && fabs(lacks) < (double)INFINITY ? lacks : beyond;
}

/// Whether a multiple of a covariance covers what levels are to cover, but for T_0.
static bool covers_rest(const search_t *search, double square, const double covariance[16])
{
    double M[16];
    for (int i = 1; i < 4; ++i)
    {
        for (int j = 1; j <= i; ++j)
        {
            const double whole = covariance[4 * i + j] + (i == j ? singular : 0.0);
            M[4 * i + j] = square * whole - search->lacking[4 * i + j];
        }
    }
    const pivots_t pivots = pivots_of(M);
    return are_positive(&pivots);
}

/// Least raw level, 1 or more, of the points or of the shape whose multiple of a covariance covers
/// what levels are to cover, but for T_0; one more than the greatest if none does.
static int64_t least_level(search_t *search, bool is_shape, const double covariance[16])
{
    const maplines_levels_t *levels = search->levels;
    int64_t low = 0;
    int64_t high = (is_shape ? levels->shape.raw_max : levels->points.raw_max) + 1;
    while (high - low > 1)
    {
        const int64_t middle = (low + high) / 2;
        const double square =
            is_shape ? shape_squared(levels, middle) : level_squared(&search->points, middle);
        if (covers_rest(search, square, covariance))
        {
            high = middle;
        }
        else
        {
            low = middle;
        }
    }
    return high;
}

/// Find the lateral level with which a covariance covers, and the cost of both.
static void assess(search_t *search, double square, const double covariance[16],
                   candidate_t *candidate)
{
    const maplines_signal_t *lateral = &search->levels->lateral;
    double own[16];
    double decoded[16];
    for (int i = 0; i < 16; ++i)
    {
        own[i] = square * covariance[i];
        decoded[i] = own[i] - search->lacking[i];
    }
    const double lacks = shortfall(decoded);
    candidate->lateral = 0;
    if (lacks > 0.0)
    {
        const double level = sqrt(lacks > 1e-30 ? lacks : 1e-30);
        const double raw = ceil((maplines_log2(level) - lateral->offset) / lateral->factor);
        const double limited = raw > 1.0 ? raw : 1.0;
        const double most = (double)lateral->raw_max + 1.0;
        candidate->lateral = (int64_t)(limited < most ? limited : most);
    }
    for (int i = 0; i < 16; ++i)
    {
        decoded[i] = search->common[i] + own[i];
    }
    decoded[0] = decoded[0] + level_squared(&search->lateral, candidate->lateral);
    const double ratio = maplines_largest_ratio(&search->reference, decoded);
    const double log_ratio = natural_log_of_2 * maplines_log2(ratio);
    const double cost = maplines_divergence(&search->reference, decoded) + log_ratio;
    const bool is_possible =
        candidate->lateral <= lateral->raw_max && fabs(cost) < (double)INFINITY;
    candidate->cost = is_possible ? cost : (double)INFINITY;
}

/// Assess a level of the points, with the covariance for the level 1.
static void assess_points(search_t *search, int64_t shape, int64_t points,
                          const double covariance[16], candidate_t *candidate)
{
    assess(search, level_squared(&search->points, points), covariance, candidate);
    candidate->points = points;
    candidate->shape = shape;
    if (points > search->levels->points.raw_max)
    {
        candidate->cost = (double)INFINITY;
    }
}

/// Insert a spacing into the best so far, after those that cost as much.
static void insert(spacing_t best[CHOSEN], int *count, const spacing_t *spacing)
{
    int place = *count;
    while (place > 0 && best[place - 1].cost > spacing->cost)
    {
        --place;
    }
    if (place < CHOSEN)
    {
        *count = *count < CHOSEN ? *count + 1 : CHOSEN;
        for (int i = *count - 1; i > place; --i)
        {
            best[i] = best[i - 1];
        }
        best[place] = *spacing;
    }
}

static void keep_better(candidate_t *best, const candidate_t *candidate)
{
    if (candidate->cost < best->cost)
    {
        *best = *candidate;
    }
}

/// Covariance for unit errors of points as `maplines_level_noise`, of a line that is taken for a
/// straight one if it nearly is.
static void near_noise(const search_t *search, int spacing, int64_t raw, double cov[16])
{
    if (!(search->stretch_squared > 0.0))
    {
        maplines_level_noise(search->levels, &search->arc, raw, cov);
        return;
    }
    const float *straight = search->dbc->straight[spacing];
    int entry = 0;
    for (int i = 0; i < 4; ++i)
    {
        for (int j = 0; j <= i; ++j)
        {
            const double scaled = search->stretch_squared * (double)straight[entry];
            cov[4 * i + j] = scaled;
            cov[4 * j + i] = scaled;
            ++entry;
        }
    }
    for (int i = 0; i < 4; ++i)
    {
        const double of_shape = (double)straight[entry] * maplines_shape(i);
        cov[5 * i] = cov[5 * i] + of_shape;
    }
}

/// Square of the stretch of a line that is nearly straight, the geometric mean of the extremes;
/// else 0.
static double stretch_squared(const maplines_arc_t *arc)
{
    double least = arc->stretch[0];
    double most = least;
    for (int k = 1; k < MAPLINES_NODES; ++k)
    {
        least = arc->stretch[k] < least ? arc->stretch[k] : least;
        most = arc->stretch[k] > most ? arc->stretch[k] : most;
    }
    return most <= nearly_straight * least ? least * most : 0.0;
}

static void begin(search_t *search, const maplines_dbc_t *dbc,
                  const maplines_level_target_t *target)
{
    double inverse[16];
    double matrix[16];
    search->dbc = dbc;
    search->levels = maplines_levels_of(dbc);
    memset(&search->lateral, 0, sizeof search->lateral);
    memset(&search->points, 0, sizeof search->points);
    search->lateral.signal = &search->levels->lateral;
    search->points.signal = &search->levels->points;
    maplines_arc_of(target->curve, &search->arc);
    search->stretch_squared = stretch_squared(&search->arc);
    maplines_inverse(target->J, inverse);
    maplines_congruence(inverse, target->target, matrix);
    for (int i = 0; i < 16; ++i)
    {
        search->common[i] = target->common[i];
        search->lacking[i] = matrix[i] - target->common[i];
    }
    maplines_congruence(inverse, target->true_cov, matrix);
    maplines_compare_with(matrix, &search->reference);
}

MAPLINES_INTERNAL void maplines_choose_spacings(const maplines_dbc_t *dbc,
                                                const maplines_level_target_t *target,
                                                maplines_sent_line_t *line)
{
    search_t search;
    begin(&search, dbc, target);
    spacing_t spacings[CHOSEN];
    int count = 0;
    for (int i = 0; i < (int)dbc->spacings; ++i)
    {
        double noise[16];
        candidate_t candidate;
        const int64_t raw = search.levels->shape.raw_min + (int64_t)i * dbc->spacing_step;
        near_noise(&search, i, raw, noise);
        const int64_t least = least_level(&search, false, noise);
        assess_points(&search, raw, least + tried[1], noise, &candidate);
        const spacing_t spacing = {candidate.cost, raw};
        insert(spacings, &count, &spacing);
    }
    for (int i = 0; i < count; ++i)
    {
        line->spacings[i] = (uint16_t)spacings[i].raw;
    }
    line->spacing_count = (uint8_t)count;
}

MAPLINES_INTERNAL bool maplines_search_levels(const maplines_dbc_t *dbc,
                                              const maplines_level_target_t *target,
                                              const maplines_sent_line_t *line, int64_t raw[3])
{
    search_t search;
    begin(&search, dbc, target);
    const maplines_levels_t *levels = search.levels;
    candidate_t best = {0, 0, 0, (double)INFINITY};
    candidate_t candidate;
    for (int i = 0; i < (int)line->spacing_count; ++i)
    {
        double noise[16];
        const int64_t shape_raw = line->spacings[i];
        maplines_level_noise(levels, &search.arc, shape_raw, noise);
        const int64_t least = least_level(&search, false, noise);
        for (int k = 0; k < TRIED; ++k)
        {
            assess_points(&search, shape_raw, least + tried[k], noise, &candidate);
            keep_better(&best, &candidate);
        }
    }
    double shape[16] = {0.0};
    for (int i = 0; i < 4; ++i)
    {
        shape[5 * i] = maplines_shape(i);
    }
    const int64_t least = least_level(&search, true, shape);
    for (int k = 0; k < TRIED; ++k)
    {
        candidate.points = 0;
        candidate.shape = least + tried[k];
        assess(&search, shape_squared(levels, candidate.shape), shape, &candidate);
        if (candidate.shape <= levels->shape.raw_max)
        {
            keep_better(&best, &candidate);
        }
    }
    raw[0] = best.lateral;
    raw[1] = best.points;
    raw[2] = best.shape;
    return best.cost < (double)INFINITY;
}
