/* A receiver of whole scenes by hand, from maplines-scene.dbc alone: see docs/embedding.md.
 *
 *     cantools generate_c_source maplines-scene.dbc        signals, and their physical values
 *     cc -c whole_scene.c maplines_scene.c
 *
 * It has the covariance of the lines of a message. Sequence, state and age are E2E profile 5.
 */
#include "maplines_scene.h"

#include <math.h>
#include <string.h>

#define PI 3.14159265358979323846

typedef struct {
    int kind;        // 8: there is no line; more: it is left out
    double mean[4];  // YOff, Beta, C0, C1
    double range[2]; // of the fit, then the valid one; none is valid if it ends before it starts
    double lateral, points, tilt, spacing; // levels
    int shape;                             // raw value
    double A[4][7]; // root of what the pose error does, with the same columns for all lines
    double D[4][4]; // covariance of the line itself
} line_t;

typedef struct {
    double y, spread[7], own; // variance: spread * spread + own
} lateral_t;

/* E2E profile 5: a record is intact. */
bool is_intact(const uint8_t *record, int length, unsigned data_id)
{
    unsigned crc = 0xFFFF;
    for (int i = 2; i < length + 2; ++i)
    {
        crc ^= (i < length ? record[i] : data_id >> 8 * (i - length) & 0xFF) << 8;
        for (int bit = 0; bit < 8; ++bit)
            crc = (crc << 1 ^ (crc & 0x8000 ? 0x1021 : 0)) & 0xFFFF;
    }
    return crc == (record[0] | (unsigned)record[1] << 8);
}

/* Lateral position at x. */
lateral_t lateral_at(const line_t *line, double x)
{
    const double t = tan(line->mean[1]), *mean = line->mean;
    const double J[4] = {1, (1 + t * t) * x, x * x / 2, x * x * x / 6};
    lateral_t at = {mean[0] + x * (t + x * (mean[2] / 2 + x * mean[3] / 6)), {0}, 0};
    for (int i = 0; i < 4; ++i)
    {
        for (int k = 0; k < 7; ++k)
            at.spread[k] += J[i] * line->A[i][k];
        for (int j = 0; j < 4; ++j)
            at.own += J[i] * line->D[i][j] * J[j];
    }
    return at;
}

/* Sigma of the lateral position of a line, or of the distance from another one. */
double sigma_of(const line_t *line, const line_t *other, double x)
{
    const lateral_t a = lateral_at(line, x);
    const lateral_t b = other ? lateral_at(other, x) : (lateral_t){0};
    double variance = a.own + b.own;
    for (int k = 0; k < 7; ++k)
        variance += (a.spread[k] - b.spread[k]) * (a.spread[k] - b.spread[k]);
    return sqrt(variance);
}

/* T_0 to T_3 at w, and their derivatives. */
static void chebyshev(double w, double T[4], double dT[4])
{
    memcpy(T, (double[4]){1, w, 2 * w * w - 1, (4 * w * w - 3) * w}, 4 * sizeof *T);
    memcpy(dT, (double[4]){0, 1, 4 * w, 12 * w * w - 3}, 4 * sizeof *dT);
}

/* Coefficients of T_0 to T_3 for values at the roots of T_8. */
static void fit(const double values[8], double c[4])
{
    for (int n = 0; n < 4; ++n)
        for (int j = c[n] = 0; j < 8; ++j)
            c[n] += (n ? 0.25 : 0.125) * values[j] * cos(n * PI * (2 * j + 1) / 16);
}

/* Add the covariance of T_0 to T_3 for independent errors of points. */
static void add_points(const line_t *line, double middle, double half, double S[4][4])
{
    double w[64], along[64], stretch[64], knots[68][4] = {{0}}, T[4], dT[4];
    for (int i = 0; i < 64; ++i)
    {
        w[i] = -cos(PI * i / 63);
        const double x = middle + half * w[i];
        stretch[i] = hypot(1, tan(line->mean[1]) + x * (line->mean[2] + x * line->mean[3] / 2));
        along[i] = i ? along[i - 1] + (w[i] - w[i - 1]) * (stretch[i] + stretch[i - 1]) : 0;
    }
    for (int i = 0; i < 64; ++i)
    {
        const double phase = fmod(1.618033988749895 * line->shape, 1);
        const double place = 2 * along[i] / along[63] / line->spacing + phase;
        const int k = (int)place;
        chebyshev(w[i], T, dT);
        for (int n = 0; n < 4; ++n)
        {
            knots[k][n] += (1 - (place - k)) * stretch[i] * T[n];
            knots[k + 1][n] += (place - k) * stretch[i] * T[n];
        }
    }
    for (int k = 0; k < 68; ++k)
    { // least squares at the 64 places
        const double *s = knots[k];
        const double c[4] = {(32.5 * s[0] - s[2]) / 2079, (32.5 * s[1] - s[3]) / 1055.25,
                             (64 * s[2] - s[0]) / 2079, (32.5 * s[3] - s[1]) / 1055.25};
        for (int i = 0; i < 16; ++i)
            S[i / 4][i % 4] +=
                line->points * line->points * c[i / 4] * c[i % 4] * (i % 5 ? 1 : 1 + ldexp(1, -14));
    }
}

/* From the root L of the pose error (along, across, heading) and the errors of the map to A and D
 * of a line. */
static void complete(line_t *line, double L[3][3], double map_offset, double map_heading)
{
    const double half = (line->range[1] - line->range[0]) / 2, middle = line->range[0] + half;
    const double tangent = tan(line->mean[1]), c0 = line->mean[2], c1 = line->mean[3];
    double f[7][8], c[7][4], T[4], dT[4], left[8], y[8], rest[4];
    for (int j = 0; j < 8; ++j)
    { // changes at the roots, by: along, across, heading, ...
        const double x = middle + half * cos(PI * (2 * j + 1) / 16);
        y[j] = line->mean[0] + x * (tangent + x * (c0 / 2 + x * c1 / 6));
        f[0][j] = f[5][j] = tangent + x * (c0 + x * c1 / 2);
        f[1][j] = -1;
        f[2][j] = -(x + f[0][j] * y[j]);
        f[3][j] = (f[0][j] * x - y[j] - (c0 + c1 * x) * y[j] * y[j]) / 2;
        f[6][j] = (c0 + c1 * x) / 2;
    }
    fit(f[2], c[2]);
    for (int j = 0; j < 8; ++j)
    { // ..., heading^2, heading along, heading across, along^2
        double slope = 0;
        left[j] = f[2][j];
        chebyshev(cos(PI * (2 * j + 1) / 16), T, dT);
        for (int n = 0; n < 4; ++n)
        {
            slope += c[2][n] * dT[n] / half;
            left[j] -= c[2][n] * T[n];
        }
        left[j] *= y[j];
        f[3][j] -= slope * y[j];
        f[4][j] = 1 + slope;
    }
    for (int i = 0; i < 7; ++i)
        fit(f[i], c[i]);
    fit(left, rest);
    for (int n = 1; n < 4; ++n)
        c[3][n] += (2 * n * rest[n - 1] + (n == 3 ? 6 * rest[0] : 0)) / half;

    // Derivatives of the line with respect to the coefficients; then changes of the line.
    const double w = -middle / half, cosine = cos(line->mean[1]);
    double J[4][4] = {{0},
                      {0},
                      {0, 0, 4 / (half * half), 24 * w / (half * half)},
                      {0, 0, 0, 24 / (half * half * half)}},
           G[7][4] = {{0}};
    chebyshev(w, J[0], J[1]);
    for (int n = 0; n < 4; ++n)
        J[1][n] *= cosine * cosine / half;
    for (int i = 0; i < 7; ++i)
        for (int n = 0; n < 16; ++n)
            G[i][n / 4] += J[n / 4][n % 4] * c[i][n % 4];
    const double turn = G[2][1], shift = G[0][1]; // Beta is the arc tangent of a slope
    G[3][1] -= tangent * turn * turn;
    G[4][1] -= tangent * 2 * turn * shift;
    G[6][1] -= tangent * shift * shift;
    for (int p = 0; p < 4; ++p)
    {
        double q[3], sum = 0;
        for (int k = 0; k < 3; ++k)
        {
            const double along = L[0][k], across = L[1][k], heading = L[2][k];
            line->A[p][k] = G[0][p] * along + G[1][p] * across + G[2][p] * heading;
            q[k] = heading * (heading * G[3][p] + along * G[4][p] + across * G[5][p]) +
                   along * along * G[6][p];
            sum += q[k];
        }
        for (int k = 0; k < 3; ++k)
            line->A[p][3 + k] = (3 * q[k] - sum) / sqrt(3);
        line->A[p][6] = sqrt(2) * sum;
    }

    double S[4][4] = {{0}}; // covariance of the coefficients, of the line itself
    const double uncertain[4] = {0, 0.25, 1, 2}, direction[4] = {1, line->tilt};
    const int remainder = line->shape % 6;
    const double ratio = remainder ? 0.5 * pow(1.8, remainder - 1) : 0;
    const double of_shape = line->points > 0 ? line->points * ratio * sqrt(line->spacing)
                            : line->shape    ? exp2(line->shape / 25.0 - 10)
                                             : 0;
    if (line->points > 0)
        add_points(line, middle, half, S);
    for (int i = 0; i < 4; ++i)
    {
        S[i][i] += ldexp(1, -18) + of_shape * of_shape * uncertain[i];
        for (int j = 0; j < 4; ++j)
            S[i][j] += line->lateral * line->lateral * direction[i] * direction[j] +
                       map_offset * map_offset * (c[0][i] * c[0][j] + c[1][i] * c[1][j]) +
                       map_heading * map_heading * c[2][i] * c[2][j];
    }
    memset(line->D, 0, sizeof line->D);
    for (int i = 0; i < 256; ++i)
        line->D[i / 64][i / 16 % 4] +=
            J[i / 64][i / 4 % 4] * S[i / 4 % 4][i % 4] * J[i / 16 % 4][i % 4];
}

/* From the range of the fit to the valid one, which is within that of the sender. The heading of
 * the map was rounded down, so `map_heading` is one step more. */
static void limit_range(line_t *line, double L[3][3], double map_heading)
{
    const double middle = (line->range[0] + line->range[1]) / 2;
    double along = lateral_at(line, middle).own, both = 0, heading = map_heading * map_heading;
    for (int k = 0; k < 3; ++k)
    {
        along += L[0][k] * L[0][k];
        both += L[0][k] * L[2][k];
        heading += L[2][k] * L[2][k];
    }
    for (int end = 0; end < 2; ++end)
    {
        const double x = line->range[end], y = lateral_at(line, x).y;
        const double margin = 3 * sqrt(along - 2 * y * both + y * y * heading) +
                              fabs(x) * (1 - cos(fmin(3 * sqrt(heading), PI / 2)));
        line->range[end] = end ? floor(10 * (x - margin)) / 10 : ceil(10 * (x + margin)) / 10;
    }
}

/* Read a message Scene that is intact: its four lines. */
void read_scene(const uint8_t data[64], line_t lines[4])
{
    static const double tilts[4] = {0, 1, -1, 6};
    struct maplines_scene_scene_t m;
    (void)maplines_scene_scene_unpack(&m, data, 64);
#define VALUE(signal) maplines_scene_scene_##signal##_decode(m.signal)
#define LEVEL(signal) (m.signal > 0 ? exp2(VALUE(signal)) : 0)
#define LINE(P)                                                                                    \
    {                                                                                              \
        .kind = m.P##_kind,                                                                        \
        .mean = {VALUE(P##_y_off), VALUE(P##_beta), VALUE(P##_c0), VALUE(P##_c1)},                 \
        .range = {VALUE(P##_x_min), VALUE(P##_x_max)}, .lateral = LEVEL(P##_own_lateral),          \
        .tilt = tilts[m.P##_own_tilt], .points = LEVEL(P##_own_points),                            \
        .spacing = exp2(VALUE(P##_own_shape)), .shape = m.P##_own_shape                            \
    }
    const line_t read[4] = {LINE(ego_left), LINE(ego_right), LINE(line3), LINE(line4)};
    const double s[3] = {exp2(VALUE(pivot_along) + VALUE(inflation) / 2),
                         exp2(VALUE(pivot_across) + VALUE(inflation) / 2),
                         exp2(VALUE(pivot_heading) + VALUE(inflation) / 2)};
    double L[3][3] = {
        {s[0]},
        {VALUE(ratio_across_along) * s[1], s[1]},
        {VALUE(ratio_heading_along) * s[2], VALUE(ratio_heading_across) * s[2], s[2]}};
    const double map_heading = LEVEL(map_heading);
    m.map_heading += m.map_heading > 0;
    const double one_step_more = LEVEL(map_heading);
    for (int i = 0; i < 4; ++i)
    {
        lines[i] = read[i];
        if (lines[i].kind < 8)
        {
            complete(&lines[i], L, LEVEL(map_offset), map_heading);
            limit_range(&lines[i], L, one_step_more);
        }
    }
}
