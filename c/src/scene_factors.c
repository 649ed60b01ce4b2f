/* Factors of the joint covariance of a scene as numbers of the build. */
#include "internal.h"

#if MAPLINES_RECEIVER && MAPLINES_SCENES

#if MAPLINES_FLOAT

/* In single precision the rows A_i of a line become s A_i + E_i, and its mean m_i + e_i. For any
 * share d between 0 and 1,
 *
 *     (s A + E)(s A + E)^T  >=  (1 - d) s^2 A A^T - (1 / d - 1) E E^T,
 *
 * and for n lines E E^T <= n diag(E_1 E_1^T, ...), likewise for e. So with s^2 = 1 / (1 - d), the
 * rounded factor covers if the line-specific covariances are
 *
 *     F_i F_i^T + n / d E_i E_i^T + n e_i e_i^T,
 *
 * the root of which maplines_set_gaussian rounds so that it covers, too. E_i is what the rounding
 * has lost, so what is added is tiny: the standard deviations grow by 0.05 %.
 */

#define ROUNDED_SHARE 0x1p-10 // d
#define ROUNDED_SCALE 1.00049 // s, rounded up
#define ROUNDED_COLUMNS (4 + MAPLINES_COLUMNS + 1)

MAPLINES_INTERNAL void maplines_set_factors(const uint8_t order[4], int place, int count,
                                            const double mean[4], double A[4][MAPLINES_COLUMNS],
                                            double F[4][4], maplines_scene_t *scene)
{
    const double n = (double)count;
    const double by_error = sqrt(n / ROUNDED_SHARE);
    maplines_gaussian_t gaussian;
    double columns[4 * ROUNDED_COLUMNS];
    double root[16];
    double ordered[4][4];
    for (int i = 0; i < 4; ++i)
    {
        const int state = order[i];
        double *row = columns + i * ROUNDED_COLUMNS;
        memcpy(row, F[state], 4 * sizeof(double));
        for (int k = 0; k < MAPLINES_COLUMNS; ++k)
        {
            const double exact = ROUNDED_SCALE * A[state][k];
            const float rounded = (float)exact;
            scene->spread[4 * place + state][k] = rounded;
            row[4 + k] = by_error * ((double)rounded - exact);
        }
        row[4 + MAPLINES_COLUMNS] = sqrt(n) * ((double)(float)mean[state] - mean[state]);
    }
    maplines_lower_root(4, ROUNDED_COLUMNS, columns, root);
    for (int i = 0; i < 4; ++i)
    {
        memcpy(ordered[order[i]], root + 4 * i, 4 * sizeof(double));
    }
    maplines_set_gaussian(mean, ordered, order, &gaussian);
    memcpy(scene->specific[place], gaussian.factor, sizeof gaussian.factor);
}

#else

MAPLINES_INTERNAL void maplines_set_factors(const uint8_t order[4], int place, int count,
                                            const double mean[4], double A[4][MAPLINES_COLUMNS],
                                            double F[4][4], maplines_scene_t *scene)
{
    (void)order;
    (void)count;
    (void)mean;
    memcpy(scene->spread[4 * place], A, sizeof scene->spread[0] * 4);
    memcpy(scene->specific[place], F, sizeof scene->specific[0]);
}

#endif

#endif
