/* Search for the levels of a line-specific covariance that cover a target at the least cost.
 *
 * The cost is the divergence from the true covariance plus the logarithm of the largest ratio of
 * variances of the lateral position or the direction of the line. For each spacing of the points
 * the least level of the points is found by bisection; one above it is tried. For the best spacings
 * some more are tried, and some levels of the shape alone. The candidates come one after the other,
 * in the order of wire/covariance/specific_levels.py; the first one of equal cost is taken.
 */
#include "internal.h"

#define CHOSEN 24 // spacings for which all levels are tried
#define TRIED 5   // levels that are tried, from the least one on

static const int64_t tried[TRIED] = {0, 1, 2, 3, 5};

/// More than any level squared [m^2].
static const double beyond = 1e100;
/// Added to the variances that errors of points cause: those of points far apart may be singular.
static const double singular = 1e-6;
static const double natural_log_of_2 = 0x1.62e42fefa39efp-1;

/// What levels are to cover, in coefficients of T_0 .. T_3.
typedef struct {
    const maplines_levels_t *levels;
    const maplines_curve_t *curve;
    double lacking[16]; ///< what the levels are to cover
    double common[16];  ///< what is added to their covariance
    maplines_reference_t reference;
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
    int64_t raw;   ///< of the shape
    int64_t least; ///< level of the points, raw
} spacing_t;

/// Square of the level of a raw value, or of the greatest one.
static double level_squared(const maplines_signal_t *signal, int64_t raw)
{
    const double level = maplines_level(signal, raw);
    return level * level;
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
static int64_t least_level(const search_t *search, bool is_shape, const double covariance[16])
{
    const maplines_levels_t *levels = search->levels;
    const maplines_signal_t *signal = is_shape ? &levels->shape : &levels->points;
    int64_t low = 0;
    int64_t high = signal->raw_max + 1;
    while (high - low > 1)
    {
        const int64_t middle = (low + high) / 2;
        const double square =
            is_shape ? shape_squared(levels, middle) : level_squared(signal, middle);
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
static void assess(const search_t *search, double square, const double covariance[16],
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
    decoded[0] = decoded[0] + level_squared(lateral, candidate->lateral);
    const double ratio = maplines_largest_ratio(&search->reference, decoded);
    const double log_ratio = natural_log_of_2 * maplines_log2(ratio);
    const double cost = maplines_divergence(&search->reference, decoded) + log_ratio;
    const bool is_possible =
        candidate->lateral <= lateral->raw_max && fabs(cost) < (double)INFINITY;
    candidate->cost = is_possible ? cost : (double)INFINITY;
}

/// Assess a level of the points, with the covariance for the level 1.
static void assess_points(const search_t *search, int64_t shape, int64_t points,
                          const double covariance[16], candidate_t *candidate)
{
    const maplines_signal_t *signal = &search->levels->points;
    assess(search, level_squared(signal, points), covariance, candidate);
    candidate->points = points;
    candidate->shape = shape;
    if (points > signal->raw_max)
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

/// Try all spacings with one level of the points; returns the number of the best that are kept.
static int spacings_tried(const search_t *search, spacing_t best[CHOSEN])
{
    const maplines_signal_t *shape = &search->levels->shape;
    int count = 0;
    for (int64_t raw = shape->raw_min; raw <= shape->raw_max; ++raw)
    {
        double noise[16];
        candidate_t candidate;
        maplines_level_noise(search->levels, search->curve, raw, noise);
        const int64_t least = least_level(search, false, noise);
        assess_points(search, raw, least + tried[1], noise, &candidate);
        const spacing_t spacing = {candidate.cost, raw, least};
        insert(best, &count, &spacing);
    }
    return count;
}

MAPLINES_INTERNAL bool maplines_search_levels(const maplines_levels_t *levels,
                                              const maplines_level_target_t *target, int64_t raw[3])
{
    search_t search;
    search.levels = levels;
    search.curve = target->curve;
    double inverse[16];
    double matrix[16];
    maplines_inverse(target->J, inverse);
    maplines_congruence(inverse, target->target, matrix);
    for (int i = 0; i < 16; ++i)
    {
        search.common[i] = target->common[i];
        search.lacking[i] = matrix[i] - target->common[i];
    }
    maplines_congruence(inverse, target->true_cov, matrix);
    maplines_compare_with(matrix, &search.reference);

    spacing_t spacings[CHOSEN];
    const int count = spacings_tried(&search, spacings);
    candidate_t best = {0, 0, 0, (double)INFINITY};
    candidate_t candidate;
    for (int i = 0; i < count; ++i)
    {
        double noise[16];
        maplines_level_noise(levels, target->curve, spacings[i].raw, noise);
        for (int k = 0; k < TRIED; ++k)
        {
            assess_points(&search, spacings[i].raw, spacings[i].least + tried[k], noise,
                          &candidate);
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
