/* Levels of the line-specific covariance.
 *
 * It has the operations of maplines_can/model/levels.py in the same order.
 */
#include "internal.h"

#if MAPLINES_SCENES

#define MAPLINES_GOLDEN_RATIO 0x1.9e3779b97f4a8p+0

#define MAPLINES_HALF (MAPLINES_NODES / 2)

// From values at the first half of the nodes to the coefficients of T_0 .. T_3 of their cubic fit;
// those of the other half are the same, less the odd ones, in the opposite order.
static const double fit_columns[MAPLINES_HALF][4] = {
    {0x1.f07c1f07c1f0ap-7, -0x1.e9131abf0b769p-6, 0x1.f07c1f07c1f0ap-6, -0x1.e9131abf0b769p-6},
    {0x1.f0902bf1cbb72p-7, -0x1.e89eeba0c7884p-6, 0x1.edfa81c689216p-6, -0x1.e3753c6928e1dp-6},
    {0x1.f0cc1fac87798p-7, -0x1.e741c699f0afep-6, 0x1.e67c0a6f10d43p-6, -0x1.d2bbd9224045ep-6},
    {0x1.f12f61af9ac21p-7, -0x1.e4f9ea11275efp-6, 0x1.da13ca0ca7c25p-6, -0x1.b746dfccf8a95p-6},
    {0x1.f1b8f571c6b64p-7, -0x1.e1c47a9fb76c0p-6, 0x1.c8e151c7293d5p-6, -0x1.91b3d1a91d762p-6},
    {0x1.f2677ceb6b7aep-7, -0x1.dd9d9d86c0e9fp-6, 0x1.b310629290a8dp-6, -0x1.62da3d4e2129fp-6},
    {0x1.f3393c1117c6dp-7, -0x1.d8809cdbcc0e7p-6, 0x1.98d87ddd072b4p-6, -0x1.2bc6ed8bb1b53p-6},
    {0x1.f42c1d3d4ad61p-7, -0x1.d2681494ebea0p-6, 0x1.7a7c5856a5432p-6, -0x1.db6bcf78ce089p-7},
    {0x1.f53db67e2e5d3p-7, -0x1.cb4e27674d7cap-6, 0x1.5849303a345d4p-6, -0x1.5416b7c892a77p-7},
    {0x1.f66b4fb9ca1a0p-7, -0x1.c32cba3bd4e64p-6, 0x1.329608c6bcc19p-6, -0x1.892ebbf8c69fap-8},
    {0x1.f7b1e99910f12p-7, -0x1.b9fdb4d548c29p-6, 0x1.09c2ccdde1dd5p-6, -0x1.812ccfd568054p-10},
    {0x1.f90e45282d9d2p-7, -0x1.afbb46236b3ddp-6, 0x1.bc6eb5f498baap-7, 0x1.97a85ecd5674ep-9},
    {0x1.fa7cec18a7cebp-7, -0x1.a4602aa6fa6a1p-6, 0x1.60c4f9d60c58ap-7, 0x1.f473466b564e3p-8},
    {0x1.fbfa39905ed81p-7, -0x1.97e7f33c6d0fbp-6, 0x1.01719be849ffbp-7, 0x1.8974a1cac5839p-7},
    {0x1.fd82636ef0acfp-7, -0x1.8a4f4a9eb1104p-6, 0x1.3ece4887a986ep-8, 0x1.0831b386da205p-6},
    {0x1.ff1183f1f6b30p-7, -0x1.7b9437f84ffb3p-6, 0x1.dcf81c1299eabp-10, 0x1.45feb514309a6p-6},
    {0x1.0051d1cfc84bfp-6, -0x1.6bb65ce811b2cp-6, -0x1.47473f212fbc0p-10, 0x1.7cbd50d3823b1p-6},
    {0x1.011a61af01405p-6, -0x1.5ab72d7629632p-6, -0x1.1a61af0140644p-8, 0x1.ab31b75324610p-6},
    {0x1.01e0734f5c9d7p-6, -0x1.489a2097a6bfep-6, -0x1.e0734f5c9d76bp-8, 0x1.d04f5e28cfbe2p-6},
    {0x1.02a20ec16adb2p-6, -0x1.3564d8069300dp-6, -0x1.510760b56d96dp-7, 0x1.eb3f0175f58e4p-6},
    {0x1.035d476fb8c74p-6, -0x1.211f3e64e6f08p-6, -0x1.aea3b7dc63a63p-7, 0x1.fb6374d79c86fp-6},
    {0x1.041041041040fp-6, -0x1.0bd39ad65583fp-6, -0x1.041041041040dp-6, 0x1.002e941aed9f9p-5},
    {0x1.04b9342362d77p-6, -0x1.eb1d32ef14a6dp-7, -0x1.2e4d08d8b5e03p-6, 0x1.fa0c4c5246f83p-6},
    {0x1.055672f452e26p-6, -0x1.bcbe90af4d114p-7, -0x1.559cbd14b89aap-6, 0x1.e8918ad309d91p-6},
    {0x1.05e66d64d77bcp-6, -0x1.8cae11b22dc6ap-7, -0x1.799b5935def67p-6, 0x1.cc4d4daccb50dp-6},
    {0x1.0667b5241cdecp-6, -0x1.5b12eb3fc708ap-7, -0x1.99ed490737b60p-6, 0x1.a5dd9a099861bp-6},
    {0x1.06d9014683710p-6, -0x1.28187ae7c6164p-7, -0x1.b64051a0dc3edp-6, 0x1.761a8aef710a6p-6},
    {0x1.0739318a7a3d7p-6, -0x1.e7dbceed5e53ep-8, -0x1.ce4c629e8f5b8p-6, 0x1.3e117fc77baafp-6},
    {0x1.07875135e3b8dp-6, -0x1.7d8b5db42a88ep-8, -0x1.e1d44d78ee36ap-6, 0x1.fdfe34a43fab5p-7},
    {0x1.07c29984badfbp-6, -0x1.11aa463aba9c0p-8, -0x1.f0a6612eb7ee2p-6, 0x1.74905cc404a0dp-7},
    {0x1.07ea73a2c8860p-6, -0x1.494f641f7c0e9p-9, -0x1.fa9ce8b2217fbp-6, 0x1.c5c72f0490085p-8},
    {0x1.07fe7a2b62333p-6, -0x1.b7b0b363c9b0ap-11, -0x1.ff9e8ad88ccbbp-6, 0x1.30c47e2dc18c2p-9},
};

/// Errors of the points of a map at equal distances, one point after the other.
typedef struct {
    double cov[16];  ///< sum of the squares of the points before this one; its lower triangle
    double below[4]; ///< weights of errors of this point, by what is ahead of it
    double above[4]; ///< by what is behind it
    int64_t point;   ///< number of this point
} noise_t;

/// Add the square of a point, all of whose weights are known.
static void add_point(noise_t *noise)
{
    double weight[4];
    for (int i = 0; i < 4; ++i)
    {
        weight[i] = noise->below[i] + noise->above[i];
    }
    for (int i = 0; i < 4; ++i)
    {
        for (int j = 0; j <= i; ++j)
        {
            const double term = weight[i] * weight[j];
            noise->cov[4 * i + j] = noise->cov[4 * i + j] + term;
        }
    }
}

MAPLINES_INTERNAL const double *maplines_nodes(void)
{
    static const double nodes[MAPLINES_NODES] = {
        -0x1.0000000000000p+0, -0x1.ff5d113293ed5p-1, -0x1.fd74ac7d6a74bp-1, -0x1.fa4808b7d3c19p-1,
        -0x1.f5d92b177f354p-1, -0x1.f02ae5e74cf6dp-1, -0x1.e940d6bb98cc4p-1, -0x1.e11f642522d1bp-1,
        -0x1.d7cbbae40cfd1p-1, -0x1.cd4bca9cb5c70p-1, -0x1.c1a6421088999p-1, -0x1.b4e28add2b944p-1,
        -0x1.a708c4c4bfa72p-1, -0x1.9821c08233adep-1, -0x1.8836fa2cf5038p-1, -0x1.7752932f8fb65p-1,
        -0x1.657f4bd515e7cp-1, -0x1.52c87c7168e5bp-1, -0x1.3f3a0e28bedd0p-1, -0x1.2ae0735afda07p-1,
        -0x1.15c89fb7bda81p-1, -0x1.0000000000001p-1, -0x1.d328e2f5ac8a0p-2, -0x1.a5287244d9a81p-2,
        -0x1.761bf51e29c8dp-2, -0x1.46215d4c2c9ecp-2, -0x1.155734246e1e1p-2, -0x1.c7b90e3024580p-3,
        -0x1.63a1a7e0b7388p-3, -0x1.fd4fd30eca793p-4, -0x1.32182ebfb0feap-4, -0x1.9876e66ba0a77p-6,
        0x1.9876e66ba0a9bp-6,  0x1.32182ebfb0ff2p-4,  0x1.fd4fd30eca79bp-4,  0x1.63a1a7e0b738cp-3,
        0x1.c7b90e3024584p-3,  0x1.155734246e1e3p-2,  0x1.46215d4c2c9eep-2,  0x1.761bf51e29c8fp-2,
        0x1.a5287244d9a86p-2,  0x1.d328e2f5ac8a9p-2,  0x1.fffffffffffffp-2,  0x1.15c89fb7bda83p-1,
        0x1.2ae0735afda0ap-1,  0x1.3f3a0e28bedd2p-1,  0x1.52c87c7168e5ep-1,  0x1.657f4bd515e7dp-1,
        0x1.7752932f8fb65p-1,  0x1.8836fa2cf503ap-1,  0x1.9821c08233adep-1,  0x1.a708c4c4bfa74p-1,
        0x1.b4e28add2b945p-1,  0x1.c1a6421088998p-1,  0x1.cd4bca9cb5c71p-1,  0x1.d7cbbae40cfd0p-1,
        0x1.e11f642522d1cp-1,  0x1.e940d6bb98cc6p-1,  0x1.f02ae5e74cf6ep-1,  0x1.f5d92b177f354p-1,
        0x1.fa4808b7d3c19p-1,  0x1.fd74ac7d6a74bp-1,  0x1.ff5d113293ed5p-1,  0x1.0000000000000p+0,
    };
    return nodes;
}

MAPLINES_INTERNAL void maplines_arc_of(const maplines_curve_t *curve, maplines_arc_t *arc)
{
    const double centre = (curve->fit_range[0] + curve->fit_range[1]) / 2.0;
    const double half = (curve->fit_range[1] - curve->fit_range[0]) / 2.0;
    const double tangent = maplines_tan(curve->mean[1]);
    const double half_c1 = curve->mean[3] / 2.0;
    const double *nodes = maplines_nodes();
    double x_before = 0.0;
    for (int k = 0; k < MAPLINES_NODES; ++k)
    {
        const double offset = half * nodes[k];
        const double x = centre + offset;
        const double cubic = x * half_c1;
        const double quadratic = x * (curve->mean[2] + cubic);
        const double slope = tangent + quadratic;
        const double square = slope * slope;
        arc->stretch[k] = sqrt(1.0 + square);
        arc->place[k] = 0.0;
        if (k > 0)
        {
            const double step = (x - x_before) * (arc->stretch[k] + arc->stretch[k - 1]);
            arc->place[k] = k > 1 ? arc->place[k - 1] + step : step;
        }
        x_before = x;
    }
    const double scale = 2.0 / arc->place[MAPLINES_NODES - 1];
    for (int k = 0; k < MAPLINES_NODES; ++k)
    {
        arc->place[k] = arc->place[k] * scale;
    }
}

/// Covariance of the coefficients for unit errors of points with this spacing and phase.
static void point_noise(const maplines_arc_t *arc, double spacing, double phase, double cov[16])
{
    noise_t noise;
    memset(&noise, 0, sizeof noise);
    double above[4] = {0.0, 0.0, 0.0, 0.0}; // weights of errors of the next point
    const double density = 1.0 / spacing;
    for (int k = 0; k < MAPLINES_NODES; ++k)
    {
        const double distance = arc->place[k] * density;
        const double place = distance + phase;
        const int64_t below = (int64_t)place;
        const double share = place - (double)below;
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
        const double *column = fit_columns[is_behind ? MAPLINES_NODES - 1 - k : k];
        const double behind = arc->stretch[k] * share;
        const double before = arc->stretch[k] - behind;
        for (int i = 0; i < 4; ++i)
        {
            const double weight = is_behind && i % 2 == 1 ? -column[i] : column[i];
            const double of_before = weight * before;
            const double of_behind = weight * behind;
            noise.below[i] = noise.below[i] + of_before;
            above[i] = above[i] + of_behind;
        }
    }
    add_point(&noise);
    memset(noise.below, 0, sizeof noise.below);
    memcpy(noise.above, above, sizeof noise.above);
    add_point(&noise);
    for (int i = 0; i < 16; ++i)
    {
        cov[i] = noise.cov[i % 4 > i / 4 ? 4 * (i % 4) + i / 4 : i];
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
    point_noise(arc, spacing, phase, cov);
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

MAPLINES_INTERNAL void maplines_decode_levels(const maplines_levels_t *levels,
                                              const maplines_curve_t *curve, int64_t lateral,
                                              int64_t points, int64_t shape, double cov[16])
{
    const double a = maplines_level(&levels->lateral, lateral);
    const double p = maplines_level(&levels->points, points);
    const double b = maplines_shape_level(levels, shape);
    if (points == 0)
    {
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
    const double square = a * a;
    cov[0] = cov[0] + square;
}

#endif
