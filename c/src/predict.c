/* Prediction of a line by the motion of the car, as propagation/prediction.py has it. */
#include "internal.h"

#define FIT_POINTS        32   ///< of a line, to which the predicted cubic is fitted
#define MIN_FIT_ADVANCE   0.17 ///< least advance along x, as a share of the length of the line
#define MAX_PREDICTION_NS 1e10 ///< longest time between pose and prediction [ns]
#define RANGE_MARGIN      3.0  ///< standard deviations by which the range is shortened at each end
#define MIN_FIT_WINDOW    1.0  ///< least length of the window in which a cubic is fitted [m]

/// Window of a line, in the old frame.
typedef struct
{
    double centre; ///< [m]
    double half;   ///< half of its length [m]
} fit_window_t;

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

/// Parameters of the cubic with coefficients q of w^0 to w^3, w = (u - centre) / half.
static void cubic_as_line(const double q[4], double centre, double half, double line[4])
{
    const double r = 1.0 / half;
    const double w = -centre * r;
    const double third = q[3] * w;
    const double value2 = q[2] + third;
    const double value1 = q[1] + w * value2;
    const double slope2 = value2 + third;
    line[0] = q[0] + w * value1;
    line[1] = maplines_atan((value1 + w * slope2) * r);
    line[2] = (slope2 + third) * (2.0 * r * r);
    line[3] = q[3] * (6.0 * r * r * r);
}

/// Line after a displacement: the state has both. False if it is no function of x.
static bool displaced(const double *state, const void *context, double *line)
{
    const fit_window_t *window = context;
    // Extreme points of T_31, on which 32 points of a window lie: cos(pi i / 31).
    static const double fit_nodes[FIT_POINTS] = {
        0x1.0000000000000p+0,  0x1.fd5f830f860f9p-1,  0x1.f584f2ce43b84p-1,  0x1.e884f0cc22cccp-1,
        0x1.d681a366a00fap-1,  0x1.bfaa5c136b224p-1,  0x1.a43b1b1379affp-1,  0x1.847bf1d5146cdp-1,
        0x1.60c045a2e972ap-1,  0x1.3965f49174d14p-1,  0x1.0ed45eea3b09fp-1,  0x1.c2f6af3928a92p-2,
        0x1.63a3fcfaca412p-2,  0x1.00ab0eb2d7d94p-2,  0x1.361fc440b4790p-3,  0x1.9eeb01776b5a5p-5,
        -0x1.9eeb01776b573p-5, -0x1.361fc440b4794p-3, -0x1.00ab0eb2d7d92p-2, -0x1.63a3fcfaca410p-2,
        -0x1.c2f6af3928a90p-2, -0x1.0ed45eea3b09fp-1, -0x1.3965f49174d10p-1, -0x1.60c045a2e9726p-1,
        -0x1.847bf1d5146cdp-1, -0x1.a43b1b1379affp-1, -0x1.bfaa5c136b224p-1, -0x1.d681a366a00fap-1,
        -0x1.e884f0cc22cccp-1, -0x1.f584f2ce43b84p-1, -0x1.fd5f830f860f8p-1, -0x1.0000000000000p+0,
    };
    double u[FIT_POINTS];
    double v[FIT_POINTS];
    double sine;
    double cosine;
    maplines_sin_cos(state[6], &sine, &cosine);
    const double slope = maplines_tan(state[1]);
    double low = (double)INFINITY;
    double high = -(double)INFINITY;
    for (int i = 0; i < FIT_POINTS; ++i)
    {
        const double x = window->centre + window->half * fit_nodes[i];
        const double y = state[0] + x * (slope + x * (state[2] / 2.0 + x * state[3] / 6.0));
        const double s = x - state[4];
        const double t = y - state[5];
        u[i] = cosine * s + sine * t;
        v[i] = cosine * t - sine * s;
        low = u[i] < low ? u[i] : low;
        high = u[i] > high ? u[i] : high;
    }
    const double sign = u[FIT_POINTS - 1] > u[0] ? 1.0 : -1.0;
    for (int i = 1; i < FIT_POINTS; ++i)
    {
        const double advance = sign * (u[i] - u[i - 1]);
        const double across = v[i] - v[i - 1];
        if (!(advance > MIN_FIT_ADVANCE * sqrt(advance * advance + across * across)))
        {
            return false;
        }
    }
    if (!(fabs(state[1]) < 0x1.921fb54442d18p+0))
    {
        return false;
    }
    // Least squares for T_0 to T_3, which are nearly orthogonal at these points.
    const double centre = (high + low) / 2.0;
    const double half = (high - low) / 2.0;
    double normal[16] = {0};
    double a[4] = {0};
    for (int i = 0; i < FIT_POINTS; ++i)
    {
        const double w = (u[i] - centre) / half;
        const double T[4] = {1.0, w, 2.0 * w * w - 1.0, w * (4.0 * w * w - 3.0)};
        for (int j = 0; j < 4; ++j)
        {
            a[j] += T[j] * v[i];
            for (int k = 0; k <= j; ++k)
            {
                normal[4 * j + k] += T[j] * T[k];
            }
        }
    }
    if (!maplines_cholesky_factor(4, normal, normal))
    {
        return false;
    }
    maplines_lower_solution(4, 1, normal, a);
    for (int j = 3; j >= 0; --j)
    {
        for (int k = j + 1; k < 4; ++k)
        {
            a[j] -= normal[4 * k + j] * a[k];
        }
        a[j] /= normal[4 * j + j];
    }
    const double q[4] = {a[0] - a[2], a[1] - 3.0 * a[3], 2.0 * a[2], 4.0 * a[3]};
    cubic_as_line(q, centre, half, line);
    return true;
}

/// Window in which a line is fitted: its valid range, and 1 m or more.
static fit_window_t window_of(double x_min, double x_max)
{
    const double length = x_max - x_min;
    const fit_window_t window = {(x_min + x_max) / 2.0,
                                 (length > MIN_FIT_WINDOW ? length : MIN_FIT_WINDOW) / 2.0};
    return window;
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
    const fit_window_t window = window_of((double)x_min, (double)x_max);
    if (!is_finite_displacement(displacement))
    {
        return MAPLINES_BAD_MOTION;
    }
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
    if (!maplines_unscented(displaced, &window, MAPLINES_MAX_STATES, mean, root, 4, line,
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
    const double y = (double)maplines_y(line, (maplines_real_t)x);
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
    return line->status != MAPLINES_OUT_OF_RANGE && (double)line->age < (double)INFINITY;
}

maplines_prediction_t maplines_predict(const maplines_line_t *line, int64_t t_ns,
                                       const maplines_displacement_t *displacement,
                                       maplines_line_t *predicted)
{
    int64_t away_ns;
    maplines_line_t result = *line;
    maplines_prediction_t prediction = MAPLINES_PREDICTED;
    if (!is_predictable(line))
    {
        return MAPLINES_NOT_USABLE;
    }
    if (!time_from_pose(line, t_ns, &away_ns))
    {
        return MAPLINES_TOO_FAR;
    }
    if (!is_finite_displacement(displacement))
    {
        return MAPLINES_BAD_MOTION;
    }
    if (line->status == MAPLINES_UNKNOWN)
    {
        const fit_window_t window = window_of((double)line->x_min, (double)line->x_max);
        double state[MAPLINES_MAX_STATES];
        double mean[4];
        for (int i = 0; i < MAPLINES_MAX_STATES; ++i)
        {
            state[i] = i < 4 ? (double)line->gaussian.mean[i] : (double)displacement->mean[i - 4];
        }
        if (!displaced(state, &window, mean))
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
    if (!is_predictable(line))
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
