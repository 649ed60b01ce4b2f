/* Rounding of the means of lines to the steps of a message.
 *
 * Each parameter is rounded to its conditional mean given the errors of those before it, so that
 * the error of the lateral position is small all over the range, whatever the steps are. The
 * operations are those of maplines_can/model/scene_sender.py in the same order.
 */
#include "internal.h"

#if MAPLINES_SENDER && MAPLINES_SCENES

/// Order in which the parameters are rounded: C1, C0, YOff, Beta.
static const int rounding_order[4] = {3, 2, 0, 1};

MAPLINES_INTERNAL void maplines_rounding_factor(const double own[16], const double J[16],
                                                double L[16])
{
    const double largest = 0x1p-16; // the square of LARGEST [m^2]
    const double resolution = MAPLINES_RESOLUTION * MAPLINES_RESOLUTION; // [m^2]
    double A[16];
    double B[16];
    double root[16];
    double transposed[16];
    maplines_inverse(J, A);
    maplines_congruence(A, own, B);
    for (int i = 0; i < 16; ++i)
    {
        const double unit = i % 5 == 0 ? 1.0 : 0.0;
        A[i] = unit + B[i] / largest;
        root[i] = unit;
    }
    maplines_factor_or_identity(A, B);
    maplines_lower_solution(4, 4, B, root);
    for (int i = 0; i < 16; ++i)
    {
        transposed[i] = root[4 * (i % 4) + i / 4];
    }
    maplines_product(4, 4, 4, transposed, root, A);
    for (int i = 0; i < 16; ++i)
    {
        const double term = largest * A[i];
        A[i] = (i % 5 == 0 ? largest + resolution : 0.0) - term;
    }
    maplines_congruence(J, A, B);
    for (int i = 0; i < 16; ++i)
    {
        A[i] = B[4 * rounding_order[i / 4] + rounding_order[i % 4]];
    }
    maplines_factor_or_identity(A, L);
}

/// Raw values that a number is rounded to.
typedef struct {
    maplines_scale_t scale;
    int64_t least, most;
} steps_t;

static steps_t steps_of(const maplines_signal_t *signal)
{
    return (steps_t){*signal->scale, maplines_raw_min(signal), maplines_raw_max(signal)};
}

/// Raw values of the sum of two signals, in steps of the finer one.
static steps_t refined(const maplines_signal_t *signal, const maplines_signal_t *fine)
{
    const int64_t least = maplines_raw_min(fine);
    const int64_t most = maplines_raw_max(fine);
    const int64_t values = most - least + 1;
    return (steps_t){{fine->scale->factor, signal->scale->offset + fine->scale->offset},
                     values * maplines_raw_min(signal) + least,
                     values * maplines_raw_max(signal) + most};
}

MAPLINES_INTERNAL bool maplines_round_mean(const maplines_signal_t signals[4],
                                           const maplines_signal_t *fine, const double mean[4],
                                           const double L[16], int64_t raw[4])
{
    double errors[4] = {0.0, 0.0, 0.0, 0.0}; // so far, in terms of L
    bool fits = true;
    for (int row = 0; row < 4; ++row)
    {
        const int state = rounding_order[row];
        const maplines_signal_t *signal = &signals[state];
        const steps_t steps = fine == NULL ? steps_of(signal) : refined(signal, &fine[state]);
        double expected = 0.0;
        for (int column = 0; column < row; ++column)
        {
            const double term = L[4 * row + column] * errors[column];
            expected = expected + term;
        }
        const double nearest =
            rint((mean[state] + expected - steps.scale.offset) / steps.scale.factor);
        raw[state] = maplines_within(steps.least, steps.most, nearest);
        fits = fits && (double)raw[state] == nearest;
        const double scaled = (double)raw[state] * steps.scale.factor;
        const double error = scaled + steps.scale.offset - mean[state];
        errors[row] = (error - expected) / L[5 * row];
    }
    return fits;
}

MAPLINES_INTERNAL int64_t maplines_split(const maplines_signal_t *fine, int64_t raw, int64_t *rest)
{
    const int64_t least = maplines_raw_min(fine);
    const int64_t values = maplines_raw_max(fine) - least + 1;
    const int64_t above = raw - least;
    int64_t remainder = above % values;
    remainder = remainder < 0 ? remainder + values : remainder;
    *rest = remainder + least;
    return (above - remainder) / values;
}

#endif
