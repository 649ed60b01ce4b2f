/* Weights of the components of a mixture as records have them, and what their rounding leaves.
 *
 * Weights are rounded to steps by their largest remainders (Hamilton's method), at least to one.
 * Each decoded component covers its own covariance, so the covariance of the decoded mixture is at
 * least B = sum w'_i (S_i + d_i d_i^T + (m'_i - m')(m'_i - m')^T). It must cover the true one about
 * the decoded mean, T = S + (m - m')(m - m')^T. The positive part of T - B, added to each
 * component, closes the gap.
 */
#include "internal.h"

#if MAPLINES_SENDER && MAPLINES_MIXTURES

#define MORE_THAN_GAP 1e-6 // of what is added, so that a check with another rounding passes

MAPLINES_INTERNAL void maplines_quantize_weights(int count, const double *weights, int64_t steps,
                                                 double *decoded)
{
    double exact[MAPLINES_MAX_COMPONENTS];
    int64_t multiples[MAPLINES_MAX_COMPONENTS];
    for (int i = 0; i < count; ++i)
    {
        exact[i] = weights[i] * (double)steps;
        multiples[i] = exact[i] >= 1.0 ? (int64_t)floor(exact[i]) : 1;
    }
    for (int trial = 0; trial < count; ++trial)
    {
        int64_t missing = steps;
        int most = 0;
        for (int i = 0; i < count; ++i)
        {
            missing -= multiples[i];
            const double rest = exact[i] - (double)multiples[i];
            most = rest > exact[most] - (double)multiples[most] ? i : most;
        }
        if (missing > 0)
        {
            ++multiples[most];
        }
        int greatest = 0; // excess of those that can lose a step
        for (int i = 1; i < count; ++i)
        {
            const double excess = (double)multiples[i] - exact[i];
            const bool is_greater =
                multiples[greatest] == 1 || excess > (double)multiples[greatest] - exact[greatest];
            greatest = multiples[i] > 1 && is_greater ? i : greatest;
        }
        if (missing < 0)
        {
            --multiples[greatest];
        }
    }
    for (int i = 0; i < count; ++i)
    {
        decoded[i] = (double)multiples[i] / (double)steps;
    }
}

MAPLINES_INTERNAL void maplines_deficit(int count, const double *weights, double (*means)[4],
                                        double (*covs)[16], const double *decoded_weights,
                                        double (*decoded_means)[4], double cover[16])
{
    double mean[4];
    double decoded_mean[4];
    double T[16];
    double gap[16];
    double V[16];
    double scaled[16];
    double scale[4];
    double values[4];
    bool is_finite = true;
    maplines_moments(count, weights, means, covs, mean, T);
    for (int k = 0; k < count; ++k)
    {
        for (int i = 0; i < 16; ++i)
        {
            const double row = means[k][i / 4] - decoded_means[k][i / 4];
            const double column = means[k][i % 4] - decoded_means[k][i % 4];
            covs[k][i] = covs[k][i] + row * column;
        }
    }
    maplines_moments(count, decoded_weights, decoded_means, covs, decoded_mean, gap);
    for (int i = 0; i < 16; ++i)
    {
        const double row = mean[i / 4] - decoded_mean[i / 4];
        const double column = mean[i % 4] - decoded_mean[i % 4];
        T[i] = T[i] + row * column;
        gap[i] = T[i] - gap[i];
    }
    for (int i = 0; i < 4; ++i)
    {
        const double sigma = sqrt(T[5 * i]);
        scale[i] = sigma > 0.0 && sigma < (double)INFINITY ? sigma : 1.0;
    }
    for (int i = 0; i < 16; ++i)
    {
        gap[i] = gap[i] / (scale[i / 4] * scale[i % 4]);
        is_finite = is_finite && fabs(gap[i]) < (double)INFINITY;
    }
    if (!is_finite) // some component is so far out of range that its record is OUT_OF_RANGE
    {
        memset(gap, 0, sizeof gap);
    }
    maplines_eigen(4, gap, values, V);
    for (int i = 0; i < 16; ++i)
    {
        const double value = values[i % 4];
        scaled[i] = V[i] * (value > 0.0 ? value * (1.0 + MORE_THAN_GAP) : 0.0);
    }
    maplines_product_transposed(4, 4, 4, scaled, V, cover);
    maplines_symmetric(4, cover);
    for (int i = 0; i < 16; ++i)
    {
        cover[i] = cover[i] * (scale[i / 4] * scale[i % 4]);
    }
}

#endif
