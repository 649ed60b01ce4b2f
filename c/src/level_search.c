/* Search for the levels of a line-specific covariance that cover a target at the least cost.
 *
 * The cost is the divergence from the true covariance plus the logarithm of the largest ratio of
 * variances of the lateral position or the direction of the line. For each spacing of the points
 * the least level of the points is searched; the cost of one above it, without the lateral
 * position, tells the best spacings. There the line is taken for a straight one, since the
 * covariances of a straight line are in the tables. For the best spacings some levels are tried,
 * with the covariances of the line itself, and some levels of the shape alone. Of candidates of
 * equal cost the first one is taken, in the order of maplines_can/model/level_search.py.
 *
 * All of this is done for each tilt of the lateral level, with covariances that are sheared: there
 * it is one of T_0 alone.
 *
 * A cost is no less than a bound by the variances of the direction, by definition. So what the
 * bound rules out need not be tried.
 */
#include "internal.h"

#if MAPLINES_SENDER && MAPLINES_SCENES

/// Places of raw levels.
#define LATERAL 0
#define POINTS 1
#define SHAPE 2
#define TILT 3

#define CHOSEN MAPLINES_CHOSEN_SPACINGS
#define TRIED 5      // levels that are tried, from the least one on
#define SEARCHED 256 // most spacings
#define TILTED 11    // each so many of them is tried with all tilts, before the best are chosen
#define DIRECTIONS 5 // variances of the direction that bound a cost
#define BUCKETS 32   // of spacings with nearly the same bounds
#define BUCKETS_PER_NAT 32.0

static const int64_t tried[TRIED] = {0, 1, 2, 3, 5};
/// Lower triangle of a (4, 4) matrix, row by row.
static const int entries[10] = {0, 4, 5, 8, 9, 10, 12, 13, 14, 15};

/// More than any level squared [m^2].
static const double beyond = 1e100;
/// Added to the variances that errors of points cause: those of points far apart may be singular.
static const double singular = 1e-6;
static const double natural_log_of_2 = 0x1.62e42fefa39efp-1;

/// Signal of levels, with the squares of those that were computed before.
typedef struct {
    const maplines_levels_t *levels;
    const maplines_signal_t *signal;
    double *squares; ///< 0 until they are computed
    int64_t kept;    ///< number of them
    double factor;   ///< of the logarithm to base 2 of levels
    double offset;
} squares_t;

/// What levels are to cover, in coefficients of T_0 .. T_3, sheared for a tilt. Only lower
/// triangles are used.
typedef struct {
    double tilt;
    double lacking[16]; ///< what the levels are to cover
    double common[16];  ///< what is added to their covariance
    double true_cov[16];
    double determinant;            ///< of the true covariance without row and column 0
    double directions[DIRECTIONS]; ///< inverse variances of the true covariance
} wanted_t;

/// Search for the levels of a line.
typedef struct {
    const maplines_dbc_t *dbc;
    const maplines_levels_t *levels;
    maplines_arc_t arc;
    int tilts; ///< number of them; the first one is 0
    wanted_t wanted[MAPLINES_TILTS];
    double shapes[4];
    maplines_reference_t reference;
    squares_t lateral;
    squares_t points;
    squares_t shape;
} search_t;

/// Raw values of the levels, their cost and their covariance.
typedef struct {
    int64_t raw[4];
    double cost;
    double cov[16];
} candidate_t;

/// Spacing that is among the best so far.
typedef struct {
    double cost;
    int64_t raw; ///< of the shape
} spacing_t;

/* ---- levels ---------------------------------------------------------------------------------- */

/// Compute the square of the level of a raw value, or of the greatest one.
static double compute_square(const squares_t *of, int64_t raw)
{
    const bool is_shape = of->signal == &of->levels->shape;
    const double level =
        is_shape ? maplines_shape_level(of->levels, raw) : maplines_level(of->signal, raw);
    const double square = level * level;
    if (raw < of->kept)
    {
        of->squares[raw] = square;
    }
    return square;
}

static inline double level_squared(const squares_t *of, int64_t raw)
{
    return raw < of->kept && of->squares[raw] > 0.0 ? of->squares[raw] : compute_square(of, raw);
}

/// Logarithm to base 2 of a positive number, linear between powers of two: up to 0.09 less.
static double rough_log2(double x)
{
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    return (double)bits * 0x1p-52 - 1023.0;
}

/// Least raw value of which the square of the level is not less; one more than the greatest if
/// none is. Levels are powers of two at equal distances, so that there is nearly no search.
static int64_t raw_of_square(const squares_t *of, double square)
{
    const int64_t beyond_all = maplines_raw_max(of->signal) + 1;
    if (!(square > 0.0))
    {
        return square <= 0.0 ? 0 : beyond_all;
    }
    const double place = (rough_log2(square) / 2.0 - of->offset) / of->factor;
    const double most = (double)beyond_all;
    const double limited = place < most ? place : most;
    int64_t raw = limited > 1.0 ? (int64_t)limited : 1;
    while (raw > 1 && level_squared(of, raw - 1) >= square)
    {
        --raw;
    }
    while (raw < beyond_all && !(level_squared(of, raw) >= square))
    {
        ++raw;
    }
    return raw;
}

/// Shear a covariance so that a lateral level with a tilt becomes one of T_0 alone: the tilt times
/// the coefficient of T_0 is taken from that of T_1. Only the lower triangle is set.
static void shear(double tilt, double cov[16])
{
    if (tilt != 0.0) // so that no infinite entry becomes NaN
    {
        cov[5] = cov[5] - tilt * cov[4];
        cov[4] = cov[4] - tilt * cov[0];
        cov[5] = cov[5] - tilt * cov[4];
        cov[9] = cov[9] - tilt * cov[8];
        cov[13] = cov[13] - tilt * cov[12];
    }
}

/// Least raw level, 1 or more, whose multiple of a covariance covers all variances but that of T_0.
static int64_t least_by_variances(const wanted_t *wanted, const squares_t *of,
                                  const double covariance[16])
{
    double needed = 0.0;
    for (int i = 5; i < 16; i += 5)
    {
        const double quotient = wanted->lacking[i] / (covariance[i] + singular);
        needed = quotient > needed ? quotient : needed;
    }
    const int64_t raw = raw_of_square(of, needed);
    return raw > 1 ? raw : 1;
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
static bool covers_rest(const wanted_t *wanted, double square, const double covariance[16])
{
    double M[16];
    for (int i = 1; i < 4; ++i)
    {
        for (int j = 1; j <= i; ++j)
        {
            const double whole = covariance[4 * i + j] + (i == j ? singular : 0.0);
            M[4 * i + j] = square * whole - wanted->lacking[4 * i + j];
        }
    }
    const pivots_t pivots = pivots_of(M);
    return are_positive(&pivots);
}

/// Least raw level, 1 or more, whose multiple of a covariance covers what levels are to cover, but
/// for T_0; one more than the greatest if none does. It is searched from that on which covers the
/// variances, in steps that double, and then halved.
static int64_t least_level(const wanted_t *wanted, const squares_t *of, const double covariance[16])
{
    int64_t low = least_by_variances(wanted, of, covariance) - 1;
    int64_t high = maplines_raw_max(of->signal) + 1;
    int64_t step = 1;
    while (high - low > 1)
    {
        const int64_t half = (high - low) / 2;
        const int64_t middle = low + (step < half ? step : half);
        if (covers_rest(wanted, level_squared(of, middle), covariance))
        {
            high = middle;
        }
        else
        {
            low = middle;
        }
        step = 2 * step;
    }
    return high;
}

/* ---- costs ----------------------------------------------------------------------------------- */

/// Variances of the derivative of a line with respect to w at -1, 1, -1/2, 1/2 and 0.
static void directions_of(const double S[16], double variances[DIRECTIONS])
{
    const double inner = S[5] + 16.0 * S[10];
    const double outer = inner + 81.0 * S[15];
    const double at_ends = outer + 18.0 * S[13];
    const double end = 8.0 * S[9] + 72.0 * S[14];
    const double between = S[5] + 4.0 * S[10];
    const double half = 4.0 * S[9];
    const double centre = S[5] - 6.0 * S[13];
    variances[0] = at_ends - end;
    variances[1] = at_ends + end;
    variances[2] = between - half;
    variances[3] = between + half;
    variances[4] = centre + 9.0 * S[15];
}

/// What a multiple of a covariance decodes to, without row and column 0: the lower triangle.
static void decoded_rest(const wanted_t *wanted, double square, const double covariance[16],
                         double decoded[16])
{
    const double *common = wanted->common;
    decoded[5] = square * covariance[5] + common[5];
    decoded[9] = square * covariance[9] + common[9];
    decoded[10] = square * covariance[10] + common[10];
    decoded[13] = square * covariance[13] + common[13];
    decoded[14] = square * covariance[14] + common[14];
    decoded[15] = square * covariance[15] + common[15];
}

/// Largest ratio of variances of the direction to the true ones, if it is more than 1; else 1.
static double largest_direction(const wanted_t *wanted, const double decoded[16])
{
    double variances[DIRECTIONS];
    double r = 1.0;
    directions_of(decoded, variances);
    for (int i = 0; i < DIRECTIONS; ++i)
    {
        const double ratio = variances[i] * wanted->directions[i];
        r = ratio > r ? ratio : r;
    }
    return r;
}

/// Lower bound of the cost of a multiple of a covariance; 0 or NaN if there is none.
///
/// Let r be the largest ratio of its variances of the direction to the true ones. If it is more
/// than 1, the divergence is (1 / r - 1 + ln r) / 2 at least, and ln r is 2 (r - 1) / (r + 1) at
/// least.
static double least_cost(const wanted_t *wanted, double square, const double covariance[16])
{
    double decoded[16];
    decoded_rest(wanted, square, covariance, decoded);
    const double r = largest_direction(wanted, decoded);
    return (r - 1.0) * (5.0 * r - 1.0) / (2.0 * r * (r + 1.0));
}

/// Cofactors of a symmetric matrix without row and column 0, of its lower triangle row by row;
/// returns its determinant.
static double cofactors_of(const double M[16], double cofactors[6])
{
    cofactors[0] = M[10] * M[15] - M[14] * M[14];
    cofactors[1] = M[13] * M[14] - M[9] * M[15];
    cofactors[2] = M[5] * M[15] - M[13] * M[13];
    cofactors[3] = M[9] * M[14] - M[13] * M[10];
    cofactors[4] = M[9] * M[13] - M[5] * M[14];
    cofactors[5] = M[5] * M[10] - M[9] * M[9];
    const double two = M[5] * cofactors[0] + M[9] * cofactors[1];
    return two + M[13] * cofactors[3];
}

/// Cost of a multiple of a covariance for the direction of the line, whatever its lateral position:
/// the cost without T_0. It is `bound` at least.
static double direction_cost(const wanted_t *wanted, double square, const double covariance[16],
                             double bound)
{
    const double *T = wanted->true_cov;
    double decoded[16];
    double C[6];
    decoded_rest(wanted, square, covariance, decoded);
    const double determinant = cofactors_of(decoded, C);
    const double two = T[5] * C[0] + T[10] * C[2];
    const double diagonal = two + T[15] * C[5];
    const double other = T[9] * C[1] + T[13] * C[3];
    const double trace = diagonal + 2.0 * (other + T[14] * C[4]);
    const double r = largest_direction(wanted, decoded);
    const double ratio = determinant / wanted->determinant * r * r;
    const double by_trace = (trace / determinant - 3.0) / 2.0;
    const double cost = by_trace + natural_log_of_2 * maplines_log2(ratio) / 2.0;
    const double least = bound > cost ? bound : cost;
    return fabs(cost) < (double)INFINITY ? least : (double)INFINITY;
}

/// Find the lateral level with a tilt with which a multiple of a covariance covers, and the cost of
/// both, which is `bound` at least.
static void assess(const search_t *search, const wanted_t *wanted, double square,
                   const double covariance[16], double bound, candidate_t *candidate)
{
    double decoded[16];
    double by_trace;
    double ratio;
    memcpy(decoded, covariance, sizeof decoded);
    shear(wanted->tilt, decoded);
    for (int i = 0; i < 16; ++i)
    {
        decoded[i] = square * decoded[i] - wanted->lacking[i];
    }
    candidate->cost = (double)INFINITY;
    candidate->raw[LATERAL] = raw_of_square(&search->lateral, shortfall(decoded));
    if (candidate->raw[LATERAL] > maplines_raw_max(&search->levels->lateral))
    {
        return;
    }
    const double lateral = level_squared(&search->lateral, candidate->raw[LATERAL]);
    for (int i = 0; i < 16; ++i)
    {
        candidate->cov[i] = square * covariance[i];
        decoded[i] = search->wanted[0].common[i] + candidate->cov[i];
    }
    maplines_add_lateral(lateral, wanted->tilt, candidate->cov);
    maplines_add_lateral(lateral, wanted->tilt, decoded);
    if (maplines_compared(&search->reference, decoded, &by_trace, &ratio))
    {
        const double both = ratio * maplines_largest_ratio(&search->reference, decoded);
        const double cost = by_trace + natural_log_of_2 * maplines_log2(both);
        const double least = bound > cost ? bound : cost;
        candidate->cost = fabs(cost) < (double)INFINITY ? least : (double)INFINITY;
    }
}

/* ---- search ---------------------------------------------------------------------------------- */

/// Covariance for unit errors of points as `maplines_level_noise`, of a straight line that is
/// stretched as this one is on average.
static void near_noise(const search_t *search, double stretch_squared, int spacing, double cov[16])
{
    const float *straight = search->dbc->straight[spacing];
    const double of_shape = (double)straight[10];
    for (int i = 0; i < 10; ++i)
    {
        cov[entries[i]] = stretch_squared * (double)straight[i];
    }
    cov[5] = cov[5] + of_shape * search->shapes[1];
    cov[10] = cov[10] + of_shape * search->shapes[2];
    cov[15] = cov[15] + of_shape * search->shapes[3];
}

/// Square of the stretch of a line, the geometric mean of the extremes.
static double mean_stretch_squared(const maplines_arc_t *arc)
{
    float least = arc->stretch[0];
    float most = least;
    for (int k = 1; k < MAPLINES_NODES; ++k)
    {
        least = arc->stretch[k] < least ? arc->stretch[k] : least;
        most = arc->stretch[k] > most ? arc->stretch[k] : most;
    }
    return (double)least * (double)most;
}

/// Insert a spacing into the best so far; of those that cost as much, the least raw value is first.
static void insert(spacing_t best[CHOSEN], int *count, const spacing_t *spacing)
{
    int place = *count;
    while (place > 0 &&
           (best[place - 1].cost > spacing->cost ||
            (best[place - 1].cost == spacing->cost && best[place - 1].raw > spacing->raw)))
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

/// Number of tilts with which a spacing is tried: those of its neighbours suit it, too.
static int tilts_at(const search_t *search, int spacing)
{
    return spacing % TILTED == 0 ? search->tilts : 1;
}

/// Compute the cost of one level of the points at a spacing, with its best tilt, and keep it if it
/// is among the best.
static void try_spacing(const search_t *search, double stretch_squared, int i, double bound,
                        spacing_t best[CHOSEN], int *count)
{
    spacing_t spacing = {(double)INFINITY, maplines_raw_min(&search->levels->shape) +
                                               (int64_t)i * search->dbc->spacing_step};
    for (int t = 0; t < tilts_at(search, i); ++t)
    {
        const wanted_t *wanted = &search->wanted[t];
        double noise[16];
        near_noise(search, stretch_squared, i, noise);
        shear(wanted->tilt, noise);
        const int64_t points = least_level(wanted, &search->points, noise) + tried[1];
        if (points <= maplines_raw_max(&search->levels->points))
        {
            const double square = level_squared(&search->points, points);
            const double cost = direction_cost(wanted, square, noise, bound);
            spacing.cost = cost < spacing.cost ? cost : spacing.cost;
        }
    }
    insert(best, count, &spacing);
}

/// Lower bound of the cost of a spacing with its best tilt; 0 or NaN if there is none.
static double bound_of(const search_t *search, double stretch_squared, int i)
{
    double least = (double)INFINITY;
    for (int t = 0; t < tilts_at(search, i); ++t)
    {
        const wanted_t *wanted = &search->wanted[t];
        double noise[16];
        near_noise(search, stretch_squared, i, noise);
        shear(wanted->tilt, noise);
        const int64_t points = least_by_variances(wanted, &search->points, noise) + tried[1];
        const double square = level_squared(&search->points, points);
        const double bound = least_cost(wanted, square, noise);
        least = least != least || bound >= least ? least : bound; // a NaN remains
    }
    return least;
}

/// Order spacings by their bounds, roughly.
static void order_by_bounds(int count, const double bounds[SEARCHED], uint16_t order[SEARCHED])
{
    uint8_t buckets[SEARCHED];
    int begins[BUCKETS + 1] = {0};
    double least = (double)INFINITY;
    for (int i = 0; i < count; ++i)
    {
        least = bounds[i] < least ? bounds[i] : least;
    }
    for (int i = 0; i < count; ++i)
    {
        const double place = BUCKETS_PER_NAT * (bounds[i] - least);
        buckets[i] = place < BUCKETS - 1.0 ? (uint8_t)place : BUCKETS - 1; // the last one for NaN
        begins[buckets[i] + 1] += 1;
    }
    for (int i = 0; i < BUCKETS; ++i)
    {
        begins[i + 1] += begins[i];
    }
    for (int i = 0; i < count; ++i)
    {
        order[begins[buckets[i]]] = (uint16_t)i;
        begins[buckets[i]] += 1;
    }
}

/// Choose the spacings of a line with the least cost at one level of the points.
static void choose_spacings(const search_t *search, maplines_sent_line_t *line)
{
    const double stretch_squared = mean_stretch_squared(&search->arc);
    const int spacings = (int)search->dbc->spacings;
    double bounds[SEARCHED];
    uint16_t order[SEARCHED];
    spacing_t best[CHOSEN];
    int count = 0;
    MAPLINES_ASSERT(spacings <= SEARCHED);
    for (int i = 0; i < spacings; ++i)
    {
        bounds[i] = bound_of(search, stretch_squared, i);
    }
    order_by_bounds(spacings, bounds, order); // the best first, so that others are ruled out
    for (int i = 0; i < spacings; ++i)
    {
        const double limit = count < CHOSEN ? (double)INFINITY : best[CHOSEN - 1].cost;
        if (!(bounds[order[i]] > limit)) // a NaN bounds nothing
        {
            try_spacing(search, stretch_squared, order[i], bounds[order[i]], best, &count);
        }
    }
    for (int i = 0; i < count; ++i)
    {
        double noise[16];
        maplines_level_noise(search->levels, &search->arc, best[i].raw, noise);
        line->spacings[i] = (uint16_t)best[i].raw;
        for (int k = 0; k < 10; ++k)
        {
            line->noise[i][k] = noise[entries[k]];
        }
    }
    line->spacing_count = (uint8_t)count;
}

/// Try some levels of a covariance for the level 1, of POINTS or SHAPE, from the least one on. The
/// other levels are given, but for the lateral one.
static void try_levels(const search_t *search, int which, const int64_t raw[4],
                       const double covariance[16], candidate_t *best)
{
    const squares_t *of = which == POINTS ? &search->points : &search->shape;
    const wanted_t *wanted = &search->wanted[raw[TILT]];
    double sheared[16];
    memcpy(sheared, covariance, sizeof sheared);
    shear(wanted->tilt, sheared);
    const int64_t least = least_level(wanted, of, sheared);
    for (int k = 0; k < TRIED; ++k)
    {
        candidate_t candidate;
        const int64_t level = least + tried[k];
        const double square = level_squared(of, level);
        const double bound = least_cost(&search->wanted[0], square, covariance);
        if (level > maplines_raw_max(of->signal) || bound >= best->cost)
        {
            break; // higher levels cost no less
        }
        memcpy(candidate.raw, raw, sizeof candidate.raw);
        candidate.raw[which] = level;
        assess(search, wanted, square, covariance, bound, &candidate);
        *best = candidate.cost < best->cost ? candidate : *best;
    }
}

/// Set what levels with a tilt are to cover.
static void want(double tilt, const double lacking[16], const double common[16],
                 const double true_cov[16], wanted_t *wanted)
{
    double cofactors[6];
    wanted->tilt = tilt;
    memcpy(wanted->lacking, lacking, sizeof wanted->lacking);
    memcpy(wanted->common, common, sizeof wanted->common);
    memcpy(wanted->true_cov, true_cov, sizeof wanted->true_cov);
    shear(tilt, wanted->lacking);
    shear(tilt, wanted->common);
    shear(tilt, wanted->true_cov);
    directions_of(wanted->true_cov, wanted->directions);
    for (int i = 0; i < DIRECTIONS; ++i)
    {
        wanted->directions[i] = 1.0 / wanted->directions[i];
    }
    wanted->determinant = cofactors_of(wanted->true_cov, cofactors);
}

/// Prepare a search. Its target is that of a line.
static void begin(search_t *search, const maplines_dbc_t *dbc,
                  const maplines_level_target_t *target, maplines_level_squares_t *squares)
{
    double inverse[16];
    double lacking[16];
    double true_cov[16];
    const maplines_levels_t *levels = maplines_levels_of(dbc);
    const maplines_signal_t *a = &levels->lateral;
    const maplines_signal_t *p = &levels->points;
    const squares_t lateral = {
        levels, a, squares->lateral, MAPLINES_KEPT_LATERAL, a->scale->factor, a->scale->offset};
    const squares_t points = {
        levels, p, squares->points, MAPLINES_KEPT_POINTS, p->scale->factor, p->scale->offset};
    const squares_t shape = {levels,
                             &levels->shape,
                             squares->shape,
                             MAPLINES_KEPT_SHAPES,
                             maplines_shape_step(levels),
                             MAPLINES_SHAPE_OFFSET};
    search->dbc = dbc;
    search->levels = levels;
    search->lateral = lateral;
    search->points = points;
    search->shape = shape;
    maplines_inverse(target->J, inverse);
    maplines_congruence(inverse, target->target, lacking);
    for (int i = 0; i < 4; ++i)
    {
        search->shapes[i] = maplines_shape(i);
    }
    for (int i = 0; i < 16; ++i)
    {
        lacking[i] = lacking[i] - target->common[i];
    }
    maplines_congruence(inverse, target->true_cov, true_cov);
    maplines_compare_with(true_cov, &search->reference);
    const int64_t last = levels->tilt.length > 0U ? maplines_raw_max(&levels->tilt) : 0;
    search->tilts = last < MAPLINES_TILTS ? (int)last + 1 : MAPLINES_TILTS;
    for (int t = 0; t < search->tilts; ++t)
    {
        want(maplines_tilt(t), lacking, target->common, true_cov, &search->wanted[t]);
    }
}

/// Try the spacings of a line, and the shape alone, with a tilt.
static void try_tilt(const search_t *search, const maplines_sent_line_t *line, int64_t tilt,
                     candidate_t *best)
{
    int64_t raw[4] = {0, 0, 0, tilt};
    for (int i = 0; i < (int)line->spacing_count; ++i)
    {
        double noise[16];
        for (int k = 0; k < 10; ++k)
        {
            noise[4 * (entries[k] % 4) + entries[k] / 4] = line->noise[i][k];
            noise[entries[k]] = line->noise[i][k];
        }
        raw[SHAPE] = line->spacings[i];
        try_levels(search, POINTS, raw, noise, best);
    }
    double shape[16] = {0.0};
    for (int i = 0; i < 4; ++i)
    {
        shape[5 * i] = search->shapes[i];
    }
    try_levels(search, SHAPE, raw, shape, best);
}

MAPLINES_INTERNAL bool maplines_search_levels(const maplines_dbc_t *dbc,
                                              const maplines_level_target_t *target,
                                              maplines_level_squares_t *squares,
                                              maplines_sent_line_t *line, int64_t raw[4])
{
    search_t search;
    begin(&search, dbc, target, squares);
    candidate_t best;
    memset(&best, 0, sizeof best);
    best.cost = (double)INFINITY;
    if (line->spacing_count == 0)
    {
        maplines_arc_of(target->curve, &search.arc);
        choose_spacings(&search, line);
    }
    for (int t = 0; t < search.tilts; ++t)
    {
        try_tilt(&search, line, t, &best);
    }
    memcpy(raw, best.raw, sizeof best.raw);
    memcpy(line->levels, best.cov, sizeof line->levels);
    return best.cost < (double)INFINITY;
}

MAPLINES_INTERNAL bool maplines_levels_cover(const maplines_level_target_t *target,
                                             const double levels[16])
{
    double inverse[16];
    double wanted[16];
    maplines_inverse(target->J, inverse);
    maplines_congruence(inverse, target->target, wanted);
    for (int i = 0; i < 16; ++i)
    {
        const double lacking = wanted[i] - target->common[i];
        wanted[i] = levels[i] - lacking;
    }
    return shortfall(wanted) <= 0.0;
}

#endif
