/* Prediction of a line by the motion of the car, as propagation/prediction.py has it.
 *
 * A predicted line is a cubic that is fitted to points of the line, as in scenes: to 16 points
 * here, and to 32 in Python. The fits differ by less than 0.1 mm after 1 s on a road.
 */
#include "internal.h"

#if MAPLINES_RECEIVER

#define MAX_PREDICTION_NS 1e10 ///< longest time between pose and prediction [ns]
#define RANGE_MARGIN 3.0       ///< standard deviations by which the range is shortened at each end
#define MIN_FIT_WINDOW 1.0     ///< least length of the window in which a cubic is fitted [m]

/* ---- the displacement of the car ------------------------------------------------------------- */

/// Displacement (x, y, heading) of a motion (speed, yaw rate, time).
static bool arc_of(const double *state, const void *context, double *value)
{
    (void)context;
    const double half = state[1] * state[2] / 2.0; // angle of the chord to the x axis
    double sine;
    double cosine;
    maplines_sin_cos(half, &sine, &cosine);
    const double chord = state[0] * state[2] * (fabs(half) > 1e-9 ? sine / half : 1.0);
    value[0] = chord * cosine;
    value[1] = chord * sine;
    value[2] = 2.0 * half;
    return true;
}

bool maplines_displacement(const maplines_motion_t *motion, maplines_real_t dt,
                           maplines_real_t time_sigma, maplines_displacement_t *displacement)
{
    if (!MAPLINES_REQUIRE(motion != NULL) || !MAPLINES_REQUIRE(displacement != NULL))
    {
        return false;
    }
    // A speed without an error correlates with nothing.
    const double correlation = motion->speed_sigma > 0 ? (double)motion->correlation : 0.0;
    const double rate_sigma = (double)motion->yaw_rate_sigma;
    const double mean[3] = {(double)motion->speed, (double)motion->yaw_rate, (double)dt};
    const double rest = 1.0 - correlation * correlation;
    const double infinity = (double)INFINITY;
    double value[3];
    double value_root[9];
    bool is_valid = motion->speed_sigma >= 0 && (double)motion->speed_sigma < infinity &&
                    rate_sigma >= 0.0 && rate_sigma < infinity && rest >= 0.0 &&
                    fabs((double)motion->correlation) <= 1.0 && time_sigma >= 0 &&
                    (double)time_sigma < infinity;
    for (int i = 0; i < 3; ++i)
    {
        is_valid = is_valid && fabs(mean[i]) < infinity;
    }
    if (!is_valid)
    {
        return false;
    }
    const double root[9] = {(double)motion->speed_sigma, 0.0, 0.0, correlation * rate_sigma,
                            sqrt(rest) * rate_sigma,     0.0, 0.0, 0.0,
                            (double)time_sigma};
    if (!maplines_unscented(arc_of, NULL, 3, mean, root, 3, value, value_root))
    {
        return false;
    }
    for (int i = 0; i < 3; ++i)
    {
        displacement->mean[i] = (maplines_real_t)value[i];
        for (int j = 0; j < 3; ++j)
        {
            displacement->factor[i][j] = (maplines_real_t)value_root[3 * i + j];
        }
    }
    return true;
}

/* ---- the line in the new frame --------------------------------------------------------------- */

/// Line after a displacement: the state has both, the context its window. False if it is no
/// function of x then.
static bool displaced(const double *state, const void *context, double *line)
{
    const double *window = (const double *)context; // C++ asks for it
    maplines_curve_t curve = {{0}, {window[0], window[1]}, 0.0};
    maplines_points_t points;
    memcpy(curve.mean, state, sizeof curve.mean);
    maplines_points_of(&curve, &points);
    maplines_refitted(&points, state + 4, line);
    return line[0] == line[0];
}

/// Whether a line says something: its numbers are finite, and its range does not end before it
/// starts. One that is made by hand may be otherwise.
static bool is_finite_line(const maplines_gaussian_t *gaussian, maplines_real_t x_min,
                           maplines_real_t x_max)
{
    const double infinity = (double)INFINITY;
    bool is_finite = fabs((double)x_min) < infinity && fabs((double)x_max) < infinity;
    for (int i = 0; i < 4; ++i)
    {
        is_finite = is_finite && fabs((double)gaussian->mean[i]) < infinity;
        for (int j = 0; j < 4; ++j)
        {
            is_finite = is_finite && fabs((double)gaussian->factor[i][j]) < infinity;
        }
    }
    return is_finite && x_min <= x_max;
}

/// Set the window in which a line is fitted: its valid range, and 1 m or more.
static void set_window(double x_min, double x_max, double window[2])
{
    const double missing = MIN_FIT_WINDOW - (x_max - x_min);
    const double margin = missing > 0.0 ? missing / 2.0 : 0.0;
    window[0] = x_min - margin;
    window[1] = x_max + margin;
}

static bool is_finite_displacement(const maplines_displacement_t *displacement)
{
    for (int i = 0; i < 3; ++i)
    {
        bool is_finite = fabs((double)displacement->mean[i]) < (double)INFINITY;
        for (int j = 0; j < 3; ++j)
        {
            is_finite = is_finite && fabs((double)displacement->factor[i][j]) < (double)INFINITY;
        }
        if (!is_finite)
        {
            return false;
        }
    }
    return true;
}

maplines_prediction_t maplines_predict_gaussian(const maplines_gaussian_t *gaussian,
                                                const maplines_displacement_t *displacement,
                                                maplines_real_t x_min, maplines_real_t x_max,
                                                maplines_gaussian_t *predicted)
{
    double mean[MAPLINES_MAX_STATES];
    double root[MAPLINES_MAX_STATES * MAPLINES_MAX_STATES] = {0};
    double factor[16];
    double line_root[4][4];
    double line[4];
    static const uint8_t natural_order[4] = {0, 1, 2, 3};
    double window[2];
    if (!MAPLINES_REQUIRE(gaussian != NULL) || !MAPLINES_REQUIRE(predicted != NULL) ||
        !is_finite_line(gaussian, x_min, x_max))
    {
        return MAPLINES_NOT_USABLE;
    }
    if (!MAPLINES_REQUIRE(displacement != NULL) || !is_finite_displacement(displacement))
    {
        return MAPLINES_BAD_MOTION;
    }
    set_window((double)x_min, (double)x_max, window);
    for (int i = 0; i < 4; ++i)
    {
        mean[i] = (double)gaussian->mean[i];
        for (int j = 0; j < 4; ++j)
        {
            factor[4 * i + j] = (double)gaussian->factor[i][j];
        }
    }
    maplines_lower_root(4, 4, factor, &line_root[0][0]);
    for (int i = 0; i < 4; ++i)
    {
        memcpy(root + MAPLINES_MAX_STATES * i, line_root[i], 4 * sizeof(double));
    }
    for (int i = 0; i < 3; ++i)
    {
        mean[4 + i] = (double)displacement->mean[i];
        for (int j = 0; j < 3; ++j)
        {
            root[MAPLINES_MAX_STATES * (4 + i) + 4 + j] = (double)displacement->factor[i][j];
        }
    }
    if (!maplines_unscented(displaced, window, MAPLINES_MAX_STATES, mean, root, 4, line,
                            &line_root[0][0]))
    {
        return MAPLINES_ILL_POSED;
    }
    maplines_set_gaussian(line, line_root, natural_order, predicted);
    return MAPLINES_PREDICTED;
}

/// Place u of an end x of a line in the new frame, and its standard deviation [m].
static double end_of(const maplines_line_t *line, const maplines_displacement_t *displacement,
                     double x, double *sigma)
{
    double sine;
    double cosine;
    maplines_sin_cos((double)displacement->mean[2], &sine, &cosine);
    const double y = (double)maplines_cubic_at(&line->gaussian, (maplines_real_t)x);
    const double s = x - (double)displacement->mean[0];
    const double t = y - (double)displacement->mean[1];
    const double J[3] = {-cosine, -sine, cosine * t - sine * s};
    double variance = 0.0;
    for (int j = 0; j < 3; ++j)
    {
        double g = 0.0;
        for (int i = 0; i < 3; ++i)
        {
            g += (double)displacement->factor[i][j] * J[i];
        }
        variance += g * g;
    }
    *sigma = sqrt(variance);
    return cosine * s + sine * t;
}

/// Set the range of a predicted line: that of the mean line, less the uncertainty.
static void set_range(const maplines_line_t *line, const maplines_displacement_t *displacement,
                      maplines_line_t *predicted)
{
    double first_sigma;
    double last_sigma;
    const double first = end_of(line, displacement, (double)line->x_min, &first_sigma);
    const double last = end_of(line, displacement, (double)line->x_max, &last_sigma);
    const bool turns = last < first; // the end comes first after a U-turn
    double x_min = turns ? last + RANGE_MARGIN * last_sigma : first + RANGE_MARGIN * first_sigma;
    double x_max = turns ? first - RANGE_MARGIN * first_sigma : last - RANGE_MARGIN * last_sigma;
    if (!(x_min <= x_max))
    {
        x_min = (first + last) / 2.0;
        x_max = x_min;
    }
    predicted->x_min = (maplines_real_t)x_min;
    predicted->x_max = (maplines_real_t)x_max;
}

/// Time from the pose of a line to a time [ns]; false if it is not within MAX_PREDICTION_NS.
static bool time_from_pose(const maplines_line_t *line, int64_t t_ns, int64_t *away_ns)
{
    const double age_ns = rint((double)line->age * 1e9);
    const double about = (double)t_ns - (double)line->t_ns + age_ns;
    if (!(age_ns < 0x1p62) || !(fabs(about) <= 2.0 * MAX_PREDICTION_NS))
    {
        return false;
    }
    // The sum is small, so it is right although its parts may wrap.
    const uint64_t away = (uint64_t)t_ns - (uint64_t)line->t_ns + (uint64_t)(int64_t)age_ns;
    *away_ns = away > INT64_MAX ? -(int64_t)(0U - away) : (int64_t)away;
    return fabs((double)*away_ns) <= MAX_PREDICTION_NS;
}

static bool is_predictable(const maplines_line_t *line)
{
    return line->status != MAPLINES_OUT_OF_RANGE && fabs((double)line->age) < (double)INFINITY &&
           is_finite_line(&line->gaussian, line->x_min, line->x_max);
}

maplines_prediction_t maplines_predict(const maplines_line_t *line, int64_t t_ns,
                                       const maplines_displacement_t *displacement,
                                       maplines_line_t *predicted)
{
    int64_t away_ns;
    maplines_prediction_t prediction = MAPLINES_PREDICTED;
    if (!MAPLINES_REQUIRE(line != NULL) || !MAPLINES_REQUIRE(predicted != NULL) ||
        !is_predictable(line))
    {
        return MAPLINES_NOT_USABLE;
    }
    maplines_line_t result = *line;
    if (!time_from_pose(line, t_ns, &away_ns))
    {
        return MAPLINES_TOO_FAR;
    }
    if (!MAPLINES_REQUIRE(displacement != NULL) || !is_finite_displacement(displacement))
    {
        return MAPLINES_BAD_MOTION;
    }
    if (line->status == MAPLINES_UNKNOWN)
    {
        double window[2];
        double state[MAPLINES_MAX_STATES];
        double mean[4];
        for (int i = 0; i < MAPLINES_MAX_STATES; ++i)
        {
            state[i] = i < 4 ? (double)line->gaussian.mean[i] : (double)displacement->mean[i - 4];
        }
        set_window((double)line->x_min, (double)line->x_max, window);
        if (!displaced(state, window, mean))
        {
            return MAPLINES_ILL_POSED;
        }
        for (int i = 0; i < 4; ++i)
        {
            result.gaussian.mean[i] = (maplines_real_t)mean[i];
        }
    }
    else
    {
        prediction = maplines_predict_gaussian(&line->gaussian, displacement, line->x_min,
                                               line->x_max, &result.gaussian);
    }
    if (prediction == MAPLINES_PREDICTED)
    {
        set_range(line, displacement, &result);
        result.t_ns = t_ns;
        result.age = 0;
        result.components = 1;
        *predicted = result;
    }
    return prediction;
}

maplines_prediction_t maplines_predict_to(const maplines_line_t *line, int64_t t_ns,
                                          const maplines_motion_t *motion,
                                          maplines_real_t time_sigma, maplines_line_t *predicted)
{
    int64_t away_ns;
    maplines_displacement_t displacement;
    if (!MAPLINES_REQUIRE(line != NULL) || !MAPLINES_REQUIRE(predicted != NULL) ||
        !is_predictable(line))
    {
        return MAPLINES_NOT_USABLE;
    }
    if (!time_from_pose(line, t_ns, &away_ns))
    {
        return MAPLINES_TOO_FAR;
    }
    const maplines_real_t dt = (maplines_real_t)((double)away_ns * 1e-9);
    if (!maplines_displacement(motion, dt, time_sigma, &displacement))
    {
        return MAPLINES_BAD_MOTION;
    }
    return maplines_predict(line, t_ns, &displacement, predicted);
}

#endif
