/* What a function of the car does with lines: lateral positions, sums of them, covariances.
 *
 * A line says nothing of what is outside of its valid range: there, values are NaN. Only
 * maplines_y_extrapolated says what can be said.
 *
 * Standard deviations are norms of F^T J, with F a square root of the covariance and J the gradient
 * of what is asked for. A sum of squares is never negative; J^T P J in single precision may be.
 */
#include "internal.h"

#if MAPLINES_RECEIVER

#if MAPLINES_FLOAT
#define UNIT_ROUNDOFF 0x1p-24F
#define ROOT_OF sqrtf
#define SIZE_OF(value) ((float)fabs((double)(value)))
#else
#define UNIT_ROUNDOFF 0x1p-53
#define ROOT_OF sqrt
#define SIZE_OF(value) fabs(value)
#endif

#define RANGE_TOLERANCE ((maplines_real_t)0x1p-10) ///< of x, for its rounding [m]
#define TIGHTEST_RADIUS 5                          ///< of a line: a car turns on 5 m [m]

/// Gradient of a sum of lateral positions of one line with respect to its four parameters.
typedef struct {
    maplines_real_t J[4];
    maplines_real_t size[4]; ///< sums of the absolute values of the terms of J
} gradient_t;

/// F^T J of one or several lines, and a bound on what its rounding is relative to.
typedef struct {
    maplines_real_t g[7 + 4 * MAPLINES_SLOTS];
    maplines_real_t size[7 + 4 * MAPLINES_SLOTS];
    size_t count;
} deviation_t;

/// Nothing is known.
static const maplines_estimate_t nothing = {(maplines_real_t)NAN, (maplines_real_t)NAN};

static maplines_real_t slope_of(const maplines_gaussian_t *gaussian)
{
    return (maplines_real_t)maplines_tan((double)gaussian->mean[1]);
}

static maplines_real_t lateral_of(const maplines_gaussian_t *gaussian, maplines_real_t slope,
                                  maplines_real_t x)
{
    const maplines_real_t *mean = gaussian->mean;
#if MAPLINES_FLOAT
    const maplines_real_t bend = mean[2] / 2 + x * mean[3] / 6;
    return mean[0] + x * (slope + x * bend);
#else
    return maplines_lateral(mean, slope, x);
#endif
}

static void gradient_of(maplines_real_t slope, maplines_real_t x, maplines_real_t J[4])
{
#if MAPLINES_FLOAT
    J[0] = 1;
    J[1] = (1 + slope * slope) * x;
    J[2] = x * x / 2;
    J[3] = x * x * x / 6;
#else
    maplines_lateral_gradient(slope, x, J);
#endif
}

static void add_gradient(maplines_real_t slope, maplines_real_t x, maplines_real_t weight,
                         gradient_t *gradient)
{
    maplines_real_t J[4];
    gradient_of(slope, x, J);
    for (int i = 0; i < 4; ++i)
    {
        const maplines_real_t entry = weight * J[i];
        gradient->J[i] += entry;
        gradient->size[i] += SIZE_OF(entry);
    }
}

/// Add the product of the transposed rows of four parameters with their gradient.
static void add_rows(const maplines_real_t *rows, size_t columns, const gradient_t *gradient,
                     maplines_real_t *g, maplines_real_t *size)
{
    for (size_t k = 0; k < columns; ++k)
    {
        for (size_t i = 0; i < 4; ++i)
        {
            const maplines_real_t entry = rows[i * columns + k];
            g[k] += entry * gradient->J[i];
            size[k] += SIZE_OF(entry) * gradient->size[i];
        }
    }
}

/// Norm of n values that does not overflow before its result does; NaN if one is NaN.
static maplines_real_t norm_of(const maplines_real_t *values, size_t n)
{
    maplines_real_t largest = 0;
    for (size_t i = 0; i < n; ++i)
    {
        const maplines_real_t size = SIZE_OF(values[i]);
        if (size != size)
        {
            return size;
        }
        largest = size > largest ? size : largest;
    }
    if (!(largest > 0))
    {
        return 0;
    }
    maplines_real_t sum = 0;
    for (size_t i = 0; i < n; ++i)
    {
        const maplines_real_t share = values[i] / largest;
        sum += share * share;
    }
    return largest * ROOT_OF(sum);
}

/// Standard deviation of a sum of n terms, never less than without rounding.
///
/// An entry of F^T J is off by at most 10 + 5 n roundings of the sum of the sizes of its products:
/// 8 of an entry of a gradient and n - 1 of their sum, one of the entry of F, one of the product,
/// and 4 n - 1 of the sum of these. The norm of 7 + 4 n entries adds half as many, and three. That
/// is less than 16 + 8 n. What overflows is infinite: nothing is known.
static maplines_real_t sigma_of(const deviation_t *deviation, size_t n)
{
    const maplines_real_t roundings = (maplines_real_t)(16 + 8 * n);
    const maplines_real_t rounding = roundings * UNIT_ROUNDOFF;
    const maplines_real_t sigma = norm_of(deviation->g, deviation->count) +
                                  rounding * norm_of(deviation->size, deviation->count);
    return sigma >= 0 ? sigma : (maplines_real_t)INFINITY;
}

/// Whether a line has a range: one that is made by hand may end before it starts, or be NaN.
static bool has_range(const maplines_line_t *line)
{
    return line->x_min <= line->x_max;
}

static bool is_number(maplines_real_t value)
{
    return value - value == 0;
}

/// A value with its standard deviation. A value that is not finite, as of a line of NaN or of one
/// that overflows, says nothing; neither does its standard deviation then.
static maplines_estimate_t estimate_of(maplines_real_t value, maplines_real_t sigma)
{
    return is_number(value) ? (maplines_estimate_t){value, sigma} : nothing;
}

bool maplines_is_valid_at(const maplines_line_t *line, maplines_real_t x)
{
    if (!MAPLINES_REQUIRE(line != NULL))
    {
        return false;
    }
    return has_range(line) && x >= line->x_min - RANGE_TOLERANCE &&
           x <= line->x_max + RANGE_TOLERANCE;
}

MAPLINES_INTERNAL maplines_real_t maplines_cubic_at(const maplines_gaussian_t *gaussian,
                                                    maplines_real_t x)
{
    return lateral_of(gaussian, slope_of(gaussian), x);
}

maplines_real_t maplines_y(const maplines_line_t *line, maplines_real_t x)
{
    if (!maplines_is_valid_at(line, x))
    {
        return nothing.value;
    }
    return estimate_of(maplines_cubic_at(&line->gaussian, x), 0).value;
}

/// Add the lateral position of a line to a value and its gradient; false where it has none.
static bool add_term(const maplines_line_t *line, const maplines_term_t *term,
                     maplines_real_t *value, gradient_t *gradient)
{
    if (!maplines_is_valid_at(line, term->x))
    {
        return false;
    }
    const maplines_real_t slope = slope_of(&line->gaussian);
    *value += term->weight * lateral_of(&line->gaussian, slope, term->x);
    add_gradient(slope, term->x, term->weight, gradient);
    return true;
}

/// Sum of lateral positions of a line; its slot in the terms does not matter.
static maplines_estimate_t sum_of(const maplines_line_t *line, size_t count,
                                  const maplines_term_t *terms)
{
    maplines_real_t value = 0;
    gradient_t gradient = {{0}, {0}};
    deviation_t deviation = {{0}, {0}, 4};
    if (!MAPLINES_REQUIRE(line != NULL))
    {
        return nothing;
    }
    for (size_t i = 0; i < count; ++i)
    {
        if (!add_term(line, &terms[i], &value, &gradient))
        {
            return nothing;
        }
    }
    add_rows(&line->gaussian.factor[0][0], 4, &gradient, deviation.g, deviation.size);
    return estimate_of(value, sigma_of(&deviation, count));
}

maplines_real_t maplines_y_sigma(const maplines_line_t *line, maplines_real_t x)
{
    const maplines_term_t term = {MAPLINES_EGO_LEFT, x, 1};
    return sum_of(line, 1, &term).sigma;
}

maplines_estimate_t maplines_slope(const maplines_line_t *line, maplines_real_t x,
                                   maplines_real_t distance)
{
    const maplines_real_t weight = 1 / distance;
    const maplines_term_t terms[2] = {{MAPLINES_EGO_LEFT, x - distance / 2, -weight},
                                      {MAPLINES_EGO_LEFT, x + distance / 2, weight}};
    if (!MAPLINES_REQUIRE(distance > 0))
    {
        return nothing;
    }
    return sum_of(line, 2, terms);
}

maplines_estimate_t maplines_curvature(const maplines_line_t *line, maplines_real_t x,
                                       maplines_real_t distance)
{
    const maplines_real_t half = distance / 2;
    const maplines_real_t weight = 1 / (half * half);
    const maplines_term_t terms[3] = {{MAPLINES_EGO_LEFT, x - half, weight},
                                      {MAPLINES_EGO_LEFT, x, -2 * weight},
                                      {MAPLINES_EGO_LEFT, x + half, weight}};
    if (!MAPLINES_REQUIRE(distance > 0))
    {
        return nothing;
    }
    return sum_of(line, 3, terms);
}

/// Standard deviation of J^T p, with p the parameters.
static maplines_real_t sigma_along(const maplines_gaussian_t *gaussian, const maplines_real_t J[4])
{
    gradient_t gradient;
    deviation_t deviation = {{0}, {0}, 4};
    for (int i = 0; i < 4; ++i)
    {
        gradient.J[i] = J[i];
        gradient.size[i] = SIZE_OF(J[i]);
    }
    add_rows(&gaussian->factor[0][0], 4, &gradient, deviation.g, deviation.size);
    return sigma_of(&deviation, 1);
}

/// Lateral position at x beyond an end of the range.
///
/// The mean goes on with the second derivative that it has at the end. The standard deviations of
/// position, slope and second derivative at the end add up, whatever their correlations, so that
/// the sum increases with the distance d. The shape of a cubic says nothing of what comes: a road
/// may turn at once. A curvature that differs by k moves the line by k (1 + slope^2)^(3/2) d^2 / 2;
/// the tightest turn of a car counts as three standard deviations.
static maplines_estimate_t position_beyond(const maplines_gaussian_t *gaussian, maplines_real_t end,
                                           maplines_real_t x)
{
    const maplines_real_t *mean = gaussian->mean;
    const maplines_real_t tangent = slope_of(gaussian);
    const maplines_real_t square = 1 + tangent * tangent;
    const maplines_real_t J[3][4] = {
        {1, square * end, end * end / 2, end * end * end / 6}, // position
        {0, square, end, end * end / 2},                       // slope
        {0, 0, 1, end},                                        // second derivative
    };
    const maplines_real_t slope = tangent + end * (mean[2] + end * mean[3] / 2);
    const maplines_real_t bend = mean[2] + end * mean[3];
    const maplines_real_t step = x - end;
    const maplines_real_t d = SIZE_OF(step);
    const maplines_real_t steeper = 1 + slope * slope;
    const maplines_real_t turn = steeper * ROOT_OF(steeper) / (3 * TIGHTEST_RADIUS);
    const maplines_real_t value =
        lateral_of(gaussian, tangent, end) + step * (slope + step * bend / 2);
    const maplines_real_t sigma =
        sigma_along(gaussian, J[0]) +
        d * (sigma_along(gaussian, J[1]) + d / 2 * (sigma_along(gaussian, J[2]) + turn));
    return estimate_of(value, sigma >= 0 ? sigma : (maplines_real_t)INFINITY);
}

maplines_estimate_t maplines_y_extrapolated(const maplines_line_t *line, maplines_real_t x)
{
    const maplines_term_t term = {MAPLINES_EGO_LEFT, x, 1};
    if (!MAPLINES_REQUIRE(line != NULL) || !has_range(line) || !is_number(x))
    {
        return nothing;
    }
    if (x < line->x_min)
    {
        return position_beyond(&line->gaussian, line->x_min, x);
    }
    if (x > line->x_max)
    {
        return position_beyond(&line->gaussian, line->x_max, x);
    }
    return sum_of(line, 1, &term);
}

void maplines_covariance(const maplines_gaussian_t *gaussian, maplines_real_t covariance[4][4])
{
    if (!MAPLINES_REQUIRE(covariance != NULL))
    {
        return;
    }
    const bool is_given = MAPLINES_REQUIRE(gaussian != NULL);
    for (int i = 0; i < 4; ++i)
    {
        for (int j = 0; j < 4; ++j)
        {
            maplines_real_t sum = is_given ? 0 : nothing.value;
            for (int k = 0; is_given && k < 4; ++k)
            {
                sum += gaussian->factor[i][k] * gaussian->factor[j][k];
            }
            covariance[i][j] = sum;
        }
    }
}

maplines_real_t maplines_mahalanobis(const maplines_line_t *line, size_t count,
                                     const maplines_position_t *positions)
{
    double G[MAPLINES_MAX_POSITIONS][4] = {{0}}; // deviations of the line at the positions
    double S[MAPLINES_MAX_POSITIONS * MAPLINES_MAX_POSITIONS] = {0};
    double z[MAPLINES_MAX_POSITIONS] = {0};
    if (!MAPLINES_REQUIRE(line != NULL) || !MAPLINES_REQUIRE(positions != NULL || count == 0))
    {
        return nothing.value;
    }
    if (!MAPLINES_REQUIRE(count <= MAPLINES_MAX_POSITIONS))
    {
        return (maplines_real_t)INFINITY;
    }
    const maplines_real_t slope = slope_of(&line->gaussian);
    for (size_t i = 0; i < count; ++i)
    {
        gradient_t gradient = {{0}, {0}};
        deviation_t deviation = {{0}, {0}, 4};
        if (!maplines_is_valid_at(line, positions[i].x))
        {
            return nothing.value;
        }
        add_gradient(slope, positions[i].x, 1, &gradient);
        add_rows(&line->gaussian.factor[0][0], 4, &gradient, deviation.g, deviation.size);
        for (size_t k = 0; k < 4; ++k)
        {
            G[i][k] = (double)deviation.g[k];
        }
        z[i] = (double)(positions[i].y - lateral_of(&line->gaussian, slope, positions[i].x));
    }
    maplines_gram((int)count, 4, &G[0][0], S);
    for (size_t i = 0; i < count; ++i)
    {
        if (!(positions[i].sigma > 0))
        {
            return (maplines_real_t)INFINITY;
        }
        S[i * count + i] += (double)positions[i].sigma * (double)positions[i].sigma;
    }
    if (!maplines_cholesky_factor((int)count, S, S))
    {
        return (maplines_real_t)INFINITY;
    }
    maplines_lower_solution((int)count, 1, S, z);
    double sum = 0;
    for (size_t i = 0; i < count; ++i)
    {
        sum += z[i] * z[i];
    }
    return sum >= 0 ? (maplines_real_t)sqrt(sum) : (maplines_real_t)INFINITY; // also of a NaN
}

#if MAPLINES_SCENES
/* ---- lines of a scene ------------------------------------------------------------------------ */

static bool is_scene(const maplines_scene_t *scene)
{
    return scene != NULL && scene->count <= MAPLINES_SLOTS;
}

/// Place of the line of a slot in a scene; its count if it has none.
static size_t place_in_scene(const maplines_scene_t *scene, maplines_owner_t slot)
{
    size_t place = 0;
    while (place < scene->count && scene->lines[place].slot != slot)
    {
        ++place;
    }
    return place;
}

const maplines_line_t *maplines_scene_line(const maplines_scene_t *scene, maplines_owner_t slot)
{
    if (!MAPLINES_REQUIRE(is_scene(scene)))
    {
        return NULL;
    }
    const size_t place = place_in_scene(scene, slot);
    return place < scene->count ? &scene->lines[place] : NULL;
}

bool maplines_sum(const maplines_scene_t *scene, size_t count, const maplines_term_t *terms,
                  maplines_estimate_t *sum)
{
    gradient_t gradients[MAPLINES_SLOTS] = {{{0}, {0}}};
    maplines_real_t value = 0;
    if (!MAPLINES_REQUIRE(sum != NULL))
    {
        return false;
    }
    *sum = nothing;
    if (!MAPLINES_REQUIRE(is_scene(scene)) || !MAPLINES_REQUIRE(terms != NULL || count == 0))
    {
        return false;
    }
    for (size_t i = 0; i < count; ++i)
    {
        if (!MAPLINES_REQUIRE(is_number(terms[i].weight)))
        {
            return false;
        }
        const size_t place = place_in_scene(scene, terms[i].slot);
        if (place == scene->count ||
            !add_term(&scene->lines[place], &terms[i], &value, &gradients[place]))
        {
            return false;
        }
    }
    deviation_t deviation = {{0}, {0}, 7};
    for (size_t i = 0; i < scene->count; ++i)
    {
        if (gradients[i].size[0] != 0)
        {
            const size_t place = deviation.count;
            add_rows(scene->spread[4 * i], MAPLINES_COLUMNS, &gradients[i], deviation.g,
                     deviation.size);
            add_rows(&scene->specific[i][0][0], 4, &gradients[i], deviation.g + place,
                     deviation.size + place);
            deviation.count += 4;
        }
    }
    *sum = estimate_of(value, sigma_of(&deviation, count));
    return is_number(value);
}

bool maplines_width(const maplines_scene_t *scene, maplines_owner_t left, maplines_owner_t right,
                    maplines_real_t x, maplines_estimate_t *width)
{
    const maplines_term_t terms[2] = {{left, x, 1}, {right, x, -1}};
    return maplines_sum(scene, 2, terms, width);
}

bool maplines_centre(const maplines_scene_t *scene, maplines_owner_t left, maplines_owner_t right,
                     maplines_real_t x, maplines_estimate_t *centre)
{
    const maplines_real_t half = (maplines_real_t)0.5;
    const maplines_term_t terms[2] = {{left, x, half}, {right, x, half}};
    return maplines_sum(scene, 2, terms, centre);
}

bool maplines_common_range(const maplines_scene_t *scene, size_t count,
                           const maplines_owner_t *slots, maplines_real_t *x_min,
                           maplines_real_t *x_max)
{
    if (!MAPLINES_REQUIRE(is_scene(scene)) || !MAPLINES_REQUIRE(slots != NULL || count == 0) ||
        !MAPLINES_REQUIRE(x_min != NULL) || !MAPLINES_REQUIRE(x_max != NULL))
    {
        return false;
    }
    *x_min = -(maplines_real_t)INFINITY;
    *x_max = (maplines_real_t)INFINITY;
    bool is_valid = count > 0;
    for (size_t i = 0; i < count; ++i)
    {
        const maplines_line_t *line = maplines_scene_line(scene, slots[i]);
        if (line == NULL || !has_range(line))
        {
            return false;
        }
        *x_min = line->x_min > *x_min ? line->x_min : *x_min;
        *x_max = line->x_max < *x_max ? line->x_max : *x_max;
        is_valid = *x_min <= *x_max;
    }
    return is_valid;
}

bool maplines_joint_covariance(const maplines_scene_t *scene, size_t count,
                               const maplines_owner_t *slots, maplines_real_t *covariance)
{
    if (!MAPLINES_REQUIRE(is_scene(scene)) || !MAPLINES_REQUIRE(slots != NULL || count == 0) ||
        !MAPLINES_REQUIRE(covariance != NULL || count == 0))
    {
        return false;
    }
    for (size_t a = 0; a < count; ++a)
    {
        const size_t place = place_in_scene(scene, slots[a]);
        if (place == scene->count)
        {
            return false;
        }
        for (size_t row = 4 * a; row < 4 * a + 4; ++row)
        {
            const maplines_real_t *spread = scene->spread[4 * place + row % 4];
            for (size_t column = 0; column <= row; ++column)
            {
                const size_t other = place_in_scene(scene, slots[column / 4]);
                maplines_real_t entry = 0;
                for (size_t k = 0; k < 7; ++k)
                {
                    entry += spread[k] * scene->spread[4 * other + column % 4][k];
                }
                for (size_t k = 0; other == place && k < 4; ++k)
                {
                    entry +=
                        scene->specific[place][row % 4][k] * scene->specific[place][column % 4][k];
                }
                covariance[row * 4 * count + column] = entry;
                covariance[column * 4 * count + row] = entry;
            }
        }
    }
    return true;
}
#endif

#endif
