/* Parameters of map lines as functions of the pose. */
#include "nodes.h"

#define MIN_ADVANCE 0.17         ///< along the x axis, as a share of the length of a line
#define MIN_PROGRESS (1.0 / 3.0) ///< least share of the advance that does not run backwards
#define MIN_PIVOT 1e-13          ///< of the normal equations
#define POSE_STEP 1e-4           ///< for derivatives [m, rad]
#define CHORD_NODES 3            ///< nodes from the begin of a chord to its end
#define MOMENTS (MAPLINES_DEGREE + 1)
#define HALF (MAPLINES_NODES / 2)
#define HALVINGS 60 ///< of the distance to a pose from which a line is no function of x

/// Places of mean(u^k) and mean(v u^k) among the sums, which are in the order of their degrees.
static const int place_of_u[MAPLINES_DEGREE + 1] = {-1, 0, 2, 4, 6, 8, 9};
static const int place_of_v[4] = {1, 3, 5, 7};
/// Means of the powers of the nodes.
static const double moments_of_nodes[MOMENTS] = {1.0,        0x1.04p-54, 0x1.04p-1, 0x1.20p-54,
                                                 0x1.8a0p-2, 0x1.30p-54, 0x1.4b0p-2};

maplines_mean_pose_t maplines_mean_pose(const double pose[3])
{
    maplines_mean_pose_t from = {{pose[0], pose[1], pose[2]}, 0.0, 0.0};
    maplines_sin_cos(pose[2], &from.sine, &from.cosine);
    return from;
}

maplines_other_pose_t maplines_other_pose(const maplines_mean_pose_t *from, const double pose[3])
{
    const double east = pose[0] - from->pose[0];
    const double north = pose[1] - from->pose[1];
    maplines_other_pose_t other = {{pose[0], pose[1], pose[2]}, 0.0, 0.0, 0.0, 0.0};
    maplines_sin_cos(pose[2] - from->pose[2], &other.sine, &other.cosine);
    other.ahead = from->cosine * east + from->sine * north;
    other.aside = from->cosine * north - from->sine * east;
    return other;
}

void maplines_displace(const maplines_mean_pose_t *from, double pose[3])
{
    const double ahead[2] = {pose[0] * from->cosine, pose[0] * from->sine};
    const double aside[2] = {pose[1] * -from->sine, pose[1] * from->cosine};
    pose[0] = from->pose[0] + (ahead[0] + aside[0]);
    pose[1] = from->pose[1] + (ahead[1] + aside[1]);
    pose[2] = from->pose[2] + pose[2];
}

/* ---- sums of the normal equations -------------------------------------------------------------
 */

/// Mean of products at the nodes, in the order of maplines_total.
static double mean_of_products(const double a[MAPLINES_NODES], const double b[MAPLINES_NODES])
{
    double terms[HALF];
    for (int k = 0; k < HALF; ++k)
    {
        const double first = a[k] * b[k];
        const double second = a[HALF + k] * b[HALF + k];
        terms[k] = first + second;
    }
    for (int k = 0; k < HALF / 2; ++k)
    {
        terms[k] = terms[k] + terms[HALF / 2 + k];
    }
    for (int k = 0; k < HALF / 4; ++k)
    {
        terms[k] = terms[k] + terms[HALF / 4 + k];
    }
    for (int k = 0; k < HALF / 8; ++k)
    {
        terms[k] = terms[k] + terms[HALF / 8 + k];
    }
    return (terms[0] + terms[2] + (terms[1] + terms[3])) / MAPLINES_NODES;
}

/// Moments mean(a^i b^j) of the points, at [i][j] with i + j up to the degree; a are the nodes.
static void moments_of(const double b[MAPLINES_NODES], double moments[MOMENTS][MOMENTS])
{
    const double *nodes = maplines_nodes;
    double of_a[MAPLINES_DEGREE][MAPLINES_NODES];
    double of_b[MAPLINES_NODES];
    for (int k = 0; k < MAPLINES_NODES; ++k)
    {
        of_a[0][k] = 1.0;
        of_b[k] = b[k];
    }
    for (int i = 1; i < MAPLINES_DEGREE; ++i)
    {
        for (int k = 0; k < MAPLINES_NODES; ++k)
        {
            of_a[i][k] = of_a[i - 1][k] * nodes[k];
        }
    }
    for (int i = 0; i < MOMENTS; ++i)
    {
        moments[i][0] = moments_of_nodes[i];
    }
    for (int j = 1; j < MOMENTS; ++j)
    {
        for (int i = 0; i + j < MOMENTS; ++i)
        {
            moments[i][j] = mean_of_products(of_a[i], of_b);
        }
        for (int k = 0; k < MAPLINES_NODES; ++k)
        {
            of_b[k] = of_b[k] * b[k];
        }
    }
}

/// Set the coefficients of c^(d - j) s^j in the sums of degree d of the rotated points, with
/// u = c a + s b and v = c b - s a, by the binomial theorem.
static void set_sums(double moments[MOMENTS][MOMENTS], maplines_refit_t *refit)
{
    static const double binomials[MOMENTS][MOMENTS] = {
        {1, 0, 0, 0, 0, 0, 0},   {1, 1, 0, 0, 0, 0, 0}, {1, 2, 1, 0, 0, 0, 0},
        {1, 3, 3, 1, 0, 0, 0},   {1, 4, 6, 4, 1, 0, 0}, {1, 5, 10, 10, 5, 1, 0},
        {1, 6, 15, 20, 15, 6, 1}};
    memset(refit->sums, 0, sizeof refit->sums);
    for (int k = 1; k <= MAPLINES_DEGREE; ++k)
    {
        for (int j = 0; j <= k; ++j)
        {
            refit->sums[j][place_of_u[k]] = binomials[k][j] * moments[k - j][j];
        }
    }
    for (int k = 0; k < 4; ++k)
    {
        for (int j = 0; j <= k + 1; ++j)
        {
            const double ahead = j <= k ? binomials[k][j] * moments[k - j][j + 1] : 0.0;
            const double aside = j >= 1 ? binomials[k][j - 1] * moments[k + 2 - j][j - 1] : 0.0;
            refit->sums[j][place_of_v[k]] = ahead - aside;
        }
    }
}

/// Sums of the points after a rotation with this cosine and sine.
static void rotate_sums(const maplines_refit_t *refit, double c, double s,
                        double sums[MAPLINES_SUMS])
{
    static const int degrees[MAPLINES_SUMS] = {1, 1, 2, 2, 3, 3, 4, 4, 5, 6};
    static const int firsts[MOMENTS] = {0, 0, 2, 4, 6, 8, 9}; // sum of each degree
    double of_c[MOMENTS] = {1.0};
    double of_s[MOMENTS] = {1.0};
    for (int k = 1; k < MOMENTS; ++k)
    {
        of_c[k] = of_c[k - 1] * c;
        of_s[k] = of_s[k - 1] * s;
    }
    for (int i = 0; i < MAPLINES_SUMS; ++i)
    {
        sums[i] = refit->sums[0][i] * of_c[degrees[i]];
    }
    for (int j = 1; j < MOMENTS; ++j)
    {
        for (int i = firsts[j]; i < MAPLINES_SUMS; ++i)
        {
            const double factor = of_c[degrees[i] - j] * of_s[j];
            const double term = refit->sums[j][i] * factor;
            sums[i] = sums[i] + term;
        }
    }
}

/// Solve the normal equations of the sums by elimination; false if a pivot is too small.
static bool solve_normal(const double sums[MAPLINES_SUMS], double q[4])
{
    const double m1 = sums[0];
    const double m2 = sums[2];
    const double m3 = sums[4];
    const double m4 = sums[6];
    const double m5 = sums[8];
    const double m6 = sums[9];
    // Row i of the symmetric matrix from its diagonal on, after i steps of the elimination.
    const double row11 = m2 - m1 * m1;
    const double row12 = m3 - m1 * m2;
    const double row13 = m4 - m1 * m3;
    const double factor2 = row12 / row11;
    const double factor3 = row13 / row11;
    double row22 = m4 - m2 * m2;
    double row23 = m5 - m2 * m3;
    row22 = row22 - factor2 * row12;
    row23 = row23 - factor2 * row13;
    const double factor = row23 / row22;
    double last = m6 - m3 * m3;
    last = last - factor3 * row13;
    last = last - factor * row23;
    q[0] = sums[1];
    q[1] = sums[3] - q[0] * m1;
    q[2] = sums[5] - q[0] * m2;
    q[3] = sums[7] - q[0] * m3;
    q[2] = q[2] - factor2 * q[1];
    q[3] = q[3] - factor3 * q[1];
    q[3] = q[3] - factor * q[2];
    q[3] = q[3] / last;
    q[2] = q[2] / row22 - factor * q[3];
    q[1] = q[1] / row11 - factor2 * q[2];
    q[1] = q[1] - factor3 * q[3];
    const double of_1 = m1 * q[1];
    const double of_2 = m2 * q[2];
    const double of_3 = m3 * q[3];
    q[0] = q[0] - (of_1 + of_2 + of_3);
    return row11 > MIN_PIVOT && row22 > MIN_PIVOT && last > MIN_PIVOT;
}

/// The points are a function of x after a rotation, and not nearly perpendicular to its axis.
static bool is_function_after(const maplines_refit_t *refit, double c, double s)
{
    const double net = fabs(c * refit->span[0] + s * refit->span[1]);
    if (!(net >= refit->least_advance))
    {
        return false;
    }
    if (c + s * refit->slopes[0] > 0.0 && c + s * refit->slopes[1] > 0.0)
    {
        return true; // all of it runs ahead
    }
    double advances[MAPLINES_CHORDS];
    for (int i = 0; i < MAPLINES_CHORDS; ++i)
    {
        advances[i] = fabs(c * refit->chords[0][i] + s * refit->chords[1][i]);
    }
    return net >= MIN_PROGRESS * maplines_total(MAPLINES_CHORDS, advances);
}

/* ---- the line seen from a pose ----------------------------------------------------------------
 */

bool maplines_refit_at(const maplines_refit_t *refit, const maplines_other_pose_t *pose,
                       double line[4])
{
    const double c = pose->cosine;
    const double s = pose->sine;
    double q[4];
    double sums[MAPLINES_SUMS];
    rotate_sums(refit, c, s, sums);
    if (!solve_normal(sums, q) || !is_function_after(refit, c, s))
    {
        for (int i = 0; i < 4; ++i)
        {
            line[i] = (double)NAN;
        }
        return false;
    }
    // Centre of the points as seen from the pose.
    const double x = refit->centre[0] - pose->ahead;
    const double y = refit->centre[1] - pose->aside;
    for (int i = 0; i < 4; ++i)
    {
        q[i] = q[i] * refit->half;
    }
    const double rise = c * y - s * x;
    q[0] = q[0] + rise;
    maplines_derivatives(q, c * x + s * y, refit->half, line);
    line[1] = maplines_atan(line[1]);
    return true;
}

bool maplines_refit_extended(const maplines_refit_t *refit, const maplines_mean_pose_t *from,
                             const maplines_other_pose_t *pose, double line[4])
{
    if (maplines_refit_at(refit, pose, line))
    {
        return true;
    }
    double share = 1.0;
    for (int halving = 0; halving < HALVINGS; ++halving)
    {
        double place[3];
        share = share / 2.0;
        for (int i = 0; i < 3; ++i)
        {
            const double part = share * (pose->pose[i] - from->pose[i]);
            place[i] = from->pose[i] + part;
        }
        const maplines_other_pose_t nearer = maplines_other_pose(from, place);
        if (maplines_refit_at(refit, &nearer, line))
        {
            for (int i = 0; i < 4; ++i)
            {
                const double slope = (line[i] - refit->mean[i]) / share;
                line[i] = refit->mean[i] + slope;
            }
            return line[0] == line[0];
        }
    }
    return false;
}

/* ---- errors of the map and of the fit ---------------------------------------------------------
 */

/// Add the outer product of a vector with itself to a (4, 4) matrix.
static void add_square(const double v[4], double S[16])
{
    for (int i = 0; i < 4; ++i)
    {
        for (int j = 0; j < 4; ++j)
        {
            const double term = v[i] * v[j];
            S[4 * i + j] = S[4 * i + j] + term;
        }
    }
}

/// Covariance of the coefficients of a cubic for independent errors of 1 m of the points, in any
/// direction. A cell has the errors of its chords, and a chord those of its two ends.
static void coefficient_covariance(const maplines_stretches_t *seen, const maplines_refit_t *refit,
                                   const maplines_cells_t *cells, double cov[16])
{
    const maplines_fitted_t *fitted = &refit->fitted;
    const double length = 2.0 * refit->half / MAPLINES_CELLS;
    double factors[MAPLINES_CELLS]; // of errors in x, which act by the slope
    double S[16] = {0.0};
    double before[4] = {0.0}; // effects of the errors of the point behind
    double after[4] = {0.0};  // and of the one ahead
    size_t i = (size_t)cells->position[0];
    for (int k = 0; k < MAPLINES_CELLS; ++k)
    {
        const double w = (2 * k + 1) / (double)MAPLINES_CELLS - 1.0;
        const double bend = 2.0 * fitted->q[2] + 3.0 * fitted->q[3] * w;
        const double slope = (fitted->q[1] + bend * w) / refit->half;
        factors[k] = sqrt(1.0 + slope * slope);
    }
    for (size_t k = 0; k < MAPLINES_CELLS; ++k)
    {
        double from = cells->position[k];
        const double to = cells->position[k + 1];
        while (from < to)
        {
            const double next = (double)(i + 1);
            const double until = to < next ? to : next;
            const double step = seen->key[i + 1] - seen->key[i];
            const double share = (until - from) * step / length * factors[k];
            const double ahead = share * ((from + until) / 2.0 - (double)i);
            for (size_t j = 0; j < 4; ++j)
            {
                const double row = maplines_cell_rows[k][j];
                before[j] = before[j] + row * (share - ahead);
                after[j] = after[j] + row * ahead;
            }
            from = until;
            if (until == next)
            {
                add_square(before, S);
                memcpy(before, after, sizeof before);
                memset(after, 0, sizeof after);
                ++i;
            }
        }
    }
    add_square(before, S);
    add_square(after, S);
    maplines_congruence(fitted->fit, S, cov);
}

/// Covariance of the line for independent errors of 1 m of the points of the map.
static void unit_covariance(const maplines_stretches_t *seen, const maplines_refit_t *refit,
                            const maplines_cells_t *cells, double unit[16])
{
    double S[16];
    double J[16];
    double sine;
    double cosine;
    maplines_sin_cos(refit->mean[1], &sine, &cosine);
    coefficient_covariance(seen, refit, cells, S);
    for (int k = 0; k < 4; ++k)
    {
        double q[4] = {0.0};
        double column[4];
        q[k] = 1.0;
        maplines_derivatives(q, refit->centre[0], refit->half, column);
        column[1] = column[1] * (cosine * cosine);
        for (int i = 0; i < 4; ++i)
        {
            J[4 * i + k] = column[i];
        }
    }
    maplines_congruence(J, S, unit);
}

/// Add the covariance due to what of the error of the map acts as a pose error, to first order.
static void add_drift(const maplines_mean_pose_t *from, const maplines_fit_t *fit,
                      maplines_refit_t *refit)
{
    const double sigmas[3] = {fit->offset_sigma, fit->offset_sigma, fit->heading_sigma};
    double J[12]; // (4, 3)
    for (int k = 0; k < 3; ++k)
    {
        double ahead[4];
        double behind[4];
        double place[3] = {from->pose[0], from->pose[1], from->pose[2]};
        place[k] = from->pose[k] + POSE_STEP;
        const maplines_other_pose_t one = maplines_other_pose(from, place);
        place[k] = from->pose[k] - POSE_STEP;
        const maplines_other_pose_t other = maplines_other_pose(from, place);
        (void)maplines_refit_at(refit, &one, ahead); // NaN is found later
        (void)maplines_refit_at(refit, &other, behind);
        for (int i = 0; i < 4; ++i)
        {
            J[3 * i + k] = (ahead[i] - behind[i]) / (2.0 * POSE_STEP) * sigmas[k];
        }
    }
    maplines_gram(4, 3, J, refit->noise_cov);
}

/// Add the covariance due to independent errors of the points.
static void add_noise(const maplines_stretches_t *seen, const maplines_cells_t *cells,
                      double variance, maplines_refit_t *refit)
{
    double unit[16];
    unit_covariance(seen, refit, cells, unit);
    for (int i = 0; i < 16; ++i)
    {
        const double own = variance * unit[i];
        refit->noise_cov[i] = refit->noise_cov[i] + own;
    }
}

/// Add the covariance that covers what the cubic misses.
static void add_misfit(const maplines_stretch_t *stretch, const maplines_cells_t *cells,
                       const double sums[MAPLINES_CELLS + 2], maplines_refit_t *refit)
{
    double J[16];
    double scaled[16];
    double cover[16];
    double variances[4];
    maplines_bases(refit->mean, refit->fitted.x_range, J);
    maplines_coefficient_variances(stretch, &refit->fitted, cells, sums, variances);
    for (int i = 0; i < 16; ++i)
    {
        scaled[i] = J[i] * variances[i % 4];
    }
    maplines_product_transposed(4, 4, 4, scaled, J, cover);
    for (int i = 0; i < 16; ++i)
    {
        refit->noise_cov[i] = refit->noise_cov[i] + cover[i];
    }
}

/* ---- refits -----------------------------------------------------------------------------------
 */

/// Set the chords that check the shape of the points.
static void set_chords_of(maplines_refit_t *refit)
{
    double lengths[MAPLINES_CHORDS];
    refit->slopes[0] = (double)INFINITY;
    refit->slopes[1] = -(double)INFINITY;
    for (int i = 0; i < MAPLINES_CHORDS; ++i)
    {
        const int begin = CHORD_NODES * i;
        const double dx = refit->x[begin + CHORD_NODES] - refit->x[begin];
        const double dy = refit->y[begin + CHORD_NODES] - refit->y[begin];
        const double slope = dy / dx;
        refit->chords[0][i] = dx;
        refit->chords[1][i] = dy;
        lengths[i] = maplines_hypot(dx, dy);
        refit->slopes[0] = slope < refit->slopes[0] ? slope : refit->slopes[0];
        refit->slopes[1] = slope > refit->slopes[1] ? slope : refit->slopes[1];
    }
    for (int axis = 0; axis < 2; ++axis)
    {
        double sums[MAPLINES_CHORDS];
        memcpy(sums, refit->chords[axis], sizeof sums);
        refit->span[axis] = maplines_total(MAPLINES_CHORDS, sums);
    }
    refit->least_advance = MIN_ADVANCE * maplines_total(MAPLINES_CHORDS, lengths);
    refit->is_across = 2.0 * refit->half < refit->least_advance;
}

/// Set the points of the line: those of its cubic, and of T_4.
static void set_points(maplines_refit_t *refit)
{
    const double *nodes = maplines_nodes;
    const maplines_fitted_t *fitted = &refit->fitted;
    const double *q = fitted->q;
    double low = (double)INFINITY;
    double high = -(double)INFINITY;
    refit->half = (fitted->x_range[1] - fitted->x_range[0]) / 2.0;
    refit->centre[0] = (fitted->x_range[0] + fitted->x_range[1]) / 2.0;
    for (int i = 0; i < MAPLINES_NODES; ++i)
    {
        const double w = nodes[i];
        const double offset = refit->half * w;
        const double third = w * q[3];
        const double second = w * (q[2] + third);
        const double first = w * (q[1] + second);
        const double bend = fitted->modes[0] * maplines_bend[i];
        refit->x[i] = refit->centre[0] + offset;
        refit->y[i] = (q[0] + first) + bend;
    }
    for (int i = 0; i < MAPLINES_NODES; ++i)
    {
        low = refit->y[i] < low ? refit->y[i] : low;
        high = refit->y[i] > high ? refit->y[i] : high;
    }
    refit->centre[1] = (low + high) / 2.0;
}

bool maplines_refit(const maplines_stretches_t *seen, size_t line, const maplines_mean_pose_t *from,
                    const maplines_fit_t *fit, maplines_refit_t *refit)
{
    const maplines_stretch_t *stretch = &seen->stretch[line];
    const bool is_covered = fit->max_misfit < (double)INFINITY;
    maplines_cells_t cells;
    double sums[MAPLINES_CELLS + 2];
    double scaled[MAPLINES_NODES];
    double moments[MOMENTS][MOMENTS];
    if (!maplines_longest_range(seen, line, fit, &refit->fitted, &cells, sums))
    {
        return false;
    }
    set_points(refit);
    for (int i = 0; i < MAPLINES_NODES; ++i)
    {
        scaled[i] = (refit->y[i] - refit->centre[1]) / refit->half;
    }
    moments_of(scaled, moments);
    set_sums(moments, refit);
    set_chords_of(refit);
    const maplines_other_pose_t same = maplines_other_pose(from, from->pose);
    (void)maplines_refit_at(refit, &same, refit->mean);
    memset(refit->noise_cov, 0, sizeof refit->noise_cov);
    const double stated = fit->point_sigma * fit->point_sigma;
    double variance = fit->has_map_error ? stated : 0.0;
    if (fit->has_map_error)
    {
        add_drift(from, fit, refit);
    }
    if (is_covered)
    {
        variance = stretch->widened > variance ? stretch->widened : variance;
        add_misfit(stretch, &cells, sums, refit);
    }
    if (variance > 0.0)
    {
        add_noise(seen, &cells, variance, refit);
    }
    return true;
}
