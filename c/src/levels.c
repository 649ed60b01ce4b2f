/* Levels of the line-specific covariance.
 *
 * It has the operations of maplines_can/model/levels.py in the same order.
 */
#include "internal.h"

#if MAPLINES_SCENES

#define MAPLINES_GOLDEN_RATIO 0x1.9e3779b97f4a8p+0

#define MAPLINES_HALF (MAPLINES_NODES / 2)

// From values at the first half of the nodes to the coefficients of T_0 .. T_3 of their cubic fit;
// those of the other half are the same in the opposite order, with the other sign for T_1 and T_3.
static const float fit_columns[MAPLINES_HALF][4] = {
    {0x1.f07c20p-7F, -0x1.e9131ap-6F, 0x1.f07c20p-6F, -0x1.e9131ap-6F},
    {0x1.f0902cp-7F, -0x1.e89eecp-6F, 0x1.edfa82p-6F, -0x1.e3753cp-6F},
    {0x1.f0cc20p-7F, -0x1.e741c6p-6F, 0x1.e67c0ap-6F, -0x1.d2bbdap-6F},
    {0x1.f12f62p-7F, -0x1.e4f9eap-6F, 0x1.da13cap-6F, -0x1.b746e0p-6F},
    {0x1.f1b8f6p-7F, -0x1.e1c47ap-6F, 0x1.c8e152p-6F, -0x1.91b3d2p-6F},
    {0x1.f2677cp-7F, -0x1.dd9d9ep-6F, 0x1.b31062p-6F, -0x1.62da3ep-6F},
    {0x1.f3393cp-7F, -0x1.d8809cp-6F, 0x1.98d87ep-6F, -0x1.2bc6eep-6F},
    {0x1.f42c1ep-7F, -0x1.d26814p-6F, 0x1.7a7c58p-6F, -0x1.db6bd0p-7F},
    {0x1.f53db6p-7F, -0x1.cb4e28p-6F, 0x1.584930p-6F, -0x1.5416b8p-7F},
    {0x1.f66b50p-7F, -0x1.c32cbap-6F, 0x1.329608p-6F, -0x1.892ebcp-8F},
    {0x1.f7b1eap-7F, -0x1.b9fdb4p-6F, 0x1.09c2ccp-6F, -0x1.812cd0p-10F},
    {0x1.f90e46p-7F, -0x1.afbb46p-6F, 0x1.bc6eb6p-7F, 0x1.97a85ep-9F},
    {0x1.fa7cecp-7F, -0x1.a4602ap-6F, 0x1.60c4fap-7F, 0x1.f47346p-8F},
    {0x1.fbfa3ap-7F, -0x1.97e7f4p-6F, 0x1.01719cp-7F, 0x1.8974a2p-7F},
    {0x1.fd8264p-7F, -0x1.8a4f4ap-6F, 0x1.3ece48p-8F, 0x1.0831b4p-6F},
    {0x1.ff1184p-7F, -0x1.7b9438p-6F, 0x1.dcf81cp-10F, 0x1.45feb6p-6F},
    {0x1.0051d2p-6F, -0x1.6bb65cp-6F, -0x1.474740p-10F, 0x1.7cbd50p-6F},
    {0x1.011a62p-6F, -0x1.5ab72ep-6F, -0x1.1a61b0p-8F, 0x1.ab31b8p-6F},
    {0x1.01e074p-6F, -0x1.489a20p-6F, -0x1.e07350p-8F, 0x1.d04f5ep-6F},
    {0x1.02a20ep-6F, -0x1.3564d8p-6F, -0x1.510760p-7F, 0x1.eb3f02p-6F},
    {0x1.035d48p-6F, -0x1.211f3ep-6F, -0x1.aea3b8p-7F, 0x1.fb6374p-6F},
    {0x1.041042p-6F, -0x1.0bd39ap-6F, -0x1.041042p-6F, 0x1.002e94p-5F},
    {0x1.04b934p-6F, -0x1.eb1d32p-7F, -0x1.2e4d08p-6F, 0x1.fa0c4cp-6F},
    {0x1.055672p-6F, -0x1.bcbe90p-7F, -0x1.559cbep-6F, 0x1.e8918ap-6F},
    {0x1.05e66ep-6F, -0x1.8cae12p-7F, -0x1.799b5ap-6F, 0x1.cc4d4ep-6F},
    {0x1.0667b6p-6F, -0x1.5b12ecp-7F, -0x1.99ed4ap-6F, 0x1.a5dd9ap-6F},
    {0x1.06d902p-6F, -0x1.28187ap-7F, -0x1.b64052p-6F, 0x1.761a8ap-6F},
    {0x1.073932p-6F, -0x1.e7dbcep-8F, -0x1.ce4c62p-6F, 0x1.3e1180p-6F},
    {0x1.078752p-6F, -0x1.7d8b5ep-8F, -0x1.e1d44ep-6F, 0x1.fdfe34p-7F},
    {0x1.07c29ap-6F, -0x1.11aa46p-8F, -0x1.f0a662p-6F, 0x1.74905cp-7F},
    {0x1.07ea74p-6F, -0x1.494f64p-9F, -0x1.fa9ce8p-6F, 0x1.c5c730p-8F},
    {0x1.07fe7ap-6F, -0x1.b7b0b4p-11F, -0x1.ff9e8ap-6F, 0x1.30c47ep-9F},
};

/* The noise of points is computed in single precision: levels are far coarser, and some CPUs have
 * only that in hardware. There are up to 130 points: two for each node, and two more. So an entry
 * of the sum of their squares w w^T errs by less than 130 x 2^-24 of the product of two standard
 * deviations, and with four rows an eigenvalue by less than four times as much, in units of the
 * variances. These are enlarged by 2^-14, so the sum stays positive semidefinite.
 */
#define MAPLINES_SUM_ROUNDING 0x1p-14

/// Errors of the points of a map at equal distances, one point after the other.
typedef struct {
    float cov[16];  ///< sum of the squares of the points before this one; its lower triangle
    float below[4]; ///< weights of errors of this point, by what is ahead of it
    float above[4]; ///< by what is behind it
    int32_t point;  ///< number of this point
} noise_t;

/// Add the square of a point, all of whose weights are known.
static void add_point(noise_t *noise)
{
    float weight[4];
    for (int i = 0; i < 4; ++i)
    {
        weight[i] = noise->below[i] + noise->above[i];
    }
    for (int i = 0; i < 4; ++i)
    {
        for (int j = 0; j <= i; ++j)
        {
            const float term = weight[i] * weight[j];
            noise->cov[4 * i + j] = noise->cov[4 * i + j] + term;
        }
    }
}

/// The first half of the nodes in single precision; the others are the same with another sign.
static const float half_nodes[MAPLINES_HALF] = {
    -0x1p+0F,        -0x1.ff5d12p-1F, -0x1.fd74acp-1F, -0x1.fa4808p-1F, -0x1.f5d92cp-1F,
    -0x1.f02ae6p-1F, -0x1.e940d6p-1F, -0x1.e11f64p-1F, -0x1.d7cbbap-1F, -0x1.cd4bcap-1F,
    -0x1.c1a642p-1F, -0x1.b4e28ap-1F, -0x1.a708c4p-1F, -0x1.9821cp-1F,  -0x1.8836fap-1F,
    -0x1.775294p-1F, -0x1.657f4cp-1F, -0x1.52c87cp-1F, -0x1.3f3a0ep-1F, -0x1.2ae074p-1F,
    -0x1.15c8ap-1F,  -0x1p-1F,        -0x1.d328e2p-2F, -0x1.a52872p-2F, -0x1.761bf6p-2F,
    -0x1.46215ep-2F, -0x1.155734p-2F, -0x1.c7b90ep-3F, -0x1.63a1a8p-3F, -0x1.fd4fd4p-4F,
    -0x1.32182ep-4F, -0x1.9876e6p-6F,
};

MAPLINES_INTERNAL void maplines_arc_of(const maplines_curve_t *curve, maplines_arc_t *arc)
{
    const float centre = (float)maplines_middle(curve->fit_range);
    const float half = (float)maplines_half(curve->fit_range);
    const float tangent = (float)maplines_tan(curve->mean[1]);
    const float c0 = (float)curve->mean[2];
    const float half_c1 = (float)(curve->mean[3] / 2.0);
    float x_before = 0.0F;
    for (int k = 0; k < MAPLINES_NODES; ++k)
    {
        const float node = k < MAPLINES_HALF ? half_nodes[k] : -half_nodes[MAPLINES_NODES - 1 - k];
        const float offset = half * node;
        const float x = centre + offset;
        const float linear = x * half_c1;
        const float turn = c0 + linear;
        const float quadratic = x * turn;
        const float slope = tangent + quadratic;
        const float square = slope * slope;
        const float sum = 1.0F + square;
        arc->stretch[k] = sqrtf(sum);
        arc->place[k] = 0.0F;
        if (k > 0)
        {
            const float distance = x - x_before;
            const float twice = arc->stretch[k] + arc->stretch[k - 1];
            const float step = distance * twice;
            arc->place[k] = arc->place[k - 1] + step;
        }
        x_before = x;
    }
    const float scale = 2.0F / arc->place[MAPLINES_NODES - 1];
    for (int k = 0; k < MAPLINES_NODES; ++k)
    {
        arc->place[k] = arc->place[k] * scale;
    }
}

/// Covariance of the coefficients for unit errors of points with this spacing and phase.
static void point_noise(const maplines_arc_t *arc, float spacing, float phase, double cov[16])
{
    noise_t noise;
    memset(&noise, 0, sizeof noise);
    float above[4] = {0.0F, 0.0F, 0.0F, 0.0F}; // weights of errors of the next point
    const float density = 1.0F / spacing;      // 2^10 at most: the DBC was checked
    for (int k = 0; k < MAPLINES_NODES; ++k)
    {
        const float distance = arc->place[k] * density;
        const float place = distance + phase;
        const int32_t below = (int32_t)place;
        const float share = place - (float)below;
        if (below != noise.point)
        {
            add_point(&noise);
            memset(noise.below, 0, sizeof noise.below);
            memcpy(noise.above, above, sizeof noise.above);
            if (below != noise.point + 1)
            {
                add_point(&noise); // no node is between this one and the next
                memset(noise.above, 0, sizeof noise.above);
            }
            memset(above, 0, sizeof above);
            noise.point = below;
        }
        const bool is_behind = k >= MAPLINES_HALF;
        const float *column = fit_columns[is_behind ? MAPLINES_NODES - 1 - k : k];
        const float behind = arc->stretch[k] * share;
        const float before = arc->stretch[k] - behind;
        for (int i = 0; i < 4; ++i)
        {
            const float weight = is_behind && i % 2 == 1 ? -column[i] : column[i];
            const float of_before = weight * before;
            const float of_behind = weight * behind;
            noise.below[i] = noise.below[i] + of_before;
            above[i] = above[i] + of_behind;
        }
    }
    add_point(&noise);
    memset(noise.below, 0, sizeof noise.below);
    memcpy(noise.above, above, sizeof noise.above);
    add_point(&noise);
    for (int i = 0; i < 4; ++i)
    {
        for (int j = 0; j <= i; ++j)
        {
            const double entry = (double)noise.cov[4 * i + j];
            const double whole = i == j ? entry * (1.0 + MAPLINES_SUM_ROUNDING) : entry;
            cov[4 * i + j] = whole;
            cov[4 * j + i] = whole;
        }
    }
}

MAPLINES_INTERNAL double maplines_shape(int k)
{
    static const double shape[4] = {0.0, 0.25, 1.0, 2.0};
    return shape[k];
}

/// Raw value within the range of a signal that is not negative.
static int64_t clipped(const maplines_signal_t *signal, int64_t raw)
{
    return raw < maplines_raw_max(signal) ? raw : maplines_raw_max(signal);
}

MAPLINES_INTERNAL double maplines_level(const maplines_signal_t *signal, int64_t raw)
{
    return raw == 0 ? 0.0 : maplines_exp2(maplines_physical(signal, clipped(signal, raw)));
}

MAPLINES_INTERNAL double maplines_shape_step(const maplines_levels_t *levels)
{
    const int64_t most = maplines_raw_max(&levels->shape);
    return MAPLINES_SHAPE_OCTAVES / (double)(most > 1 ? most : 1);
}

MAPLINES_INTERNAL double maplines_shape_level(const maplines_levels_t *levels, int64_t raw)
{
    const double exponent = maplines_shape_step(levels) * (double)clipped(&levels->shape, raw);
    return raw == 0 ? 0.0 : maplines_exp2(MAPLINES_SHAPE_OFFSET + exponent);
}

MAPLINES_INTERNAL double maplines_point_noise(const maplines_levels_t *levels,
                                              const maplines_arc_t *arc, int64_t shape,
                                              double cov[16])
{
    // Ratios r of the shape to the points, by the remainder of the raw value.
    static const double ratios[6] = {0.0,
                                     0x1.0000000000000p-1,
                                     0x1.ccccccccccccdp-1,
                                     0x1.9eb851eb851ecp+0,
                                     0x1.753f7ced91688p+1,
                                     0x1.4fec56d5cfaaep+2};
    const int64_t raw = clipped(&levels->shape, shape);
    const double physical = maplines_physical(&levels->shape, raw);
    const double spacing = levels->shape_is_octave ? maplines_exp2(physical) : physical;
    const double turns = (double)raw * MAPLINES_GOLDEN_RATIO;
    const double phase = turns - floor(turns);
    const double ratio = ratios[raw % 6];
    point_noise(arc, (float)spacing, (float)phase, cov);
    return ratio * ratio * spacing;
}

MAPLINES_INTERNAL void maplines_level_noise(const maplines_levels_t *levels,
                                            const maplines_arc_t *arc, int64_t shape,
                                            double cov[16])
{
    const double amount = maplines_point_noise(levels, arc, shape, cov);
    for (int i = 0; i < 4; ++i)
    {
        const double of_shape = amount * maplines_shape(i);
        cov[5 * i] = cov[5 * i] + of_shape;
    }
}

MAPLINES_INTERNAL double maplines_tilt(int64_t raw)
{
    static const double tilts[MAPLINES_TILTS] = {0.0, 1.0, -1.0, 6.0};
    return tilts[raw < MAPLINES_TILTS ? raw : MAPLINES_TILTS - 1];
}

MAPLINES_INTERNAL void maplines_add_lateral(double square, double tilt, double cov[16])
{
    const double mixed = square * tilt;
    const double of_slope = mixed * tilt;
    cov[0] = cov[0] + square;
    cov[1] = cov[1] + mixed;
    cov[4] = cov[4] + mixed;
    cov[5] = cov[5] + of_slope;
}

MAPLINES_INTERNAL void maplines_decode_levels(const maplines_levels_t *levels,
                                              const maplines_curve_t *curve, const int64_t raw[4],
                                              double cov[16])
{
    const int64_t shape = raw[2];
    const double a = maplines_level(&levels->lateral, raw[0]);
    const double p = maplines_level(&levels->points, raw[1]);
    if (raw[1] == 0)
    {
        const double b = maplines_shape_level(levels, shape);
        const double square = b * b;
        for (int i = 0; i < 16; ++i)
        {
            cov[i] = i % 5 == 0 ? square * maplines_shape(i / 5) : 0.0;
        }
    }
    else
    {
        const double square = p * p;
        maplines_arc_t arc;
        maplines_arc_of(curve, &arc);
        maplines_level_noise(levels, &arc, shape, cov);
        for (int i = 0; i < 16; ++i)
        {
            cov[i] = square * cov[i];
        }
    }
    maplines_add_lateral(a * a, maplines_tilt(raw[3]), cov);
}

#endif
