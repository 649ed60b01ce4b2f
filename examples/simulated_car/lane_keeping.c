/* A lane keeping that believes the lines only as far as their uncertainty permits.
 *
 * It steers to the middle of the lane ahead (pure pursuit). It drives no faster than it can stop
 * within the distance over which the car surely has room on both sides: beyond the standard
 * deviations of the lines, a share of 1e-3 at most.
 */
#include <math.h>
#include <stdbool.h>

#define POSITIONS 4        /* at which the receiver gives the lines */
#define HALF_CAR 0.9       /* half of the width of the car [m] */
#define MARGIN 0.1         /* room that it keeps beside it [m] */
#define QUANTILE 3.29      /* standard deviations that 1e-3 of all errors exceed */
#define DECELERATION 2.5   /* with which it stops [m/s^2] */
#define REACTION 0.5       /* time until it brakes [s] */
#define PREVIEW 0.8        /* time ahead to which it steers [s] */
#define SHORTEST 6.0       /* distance ahead to which it steers [m] */
#define CURVATURE 0.2      /* most that the car can steer [1/m] */

/// Lines beside the car as the receiver has them.
typedef struct {
    bool is_usable;
    double x[POSITIONS];                               ///< [m], rising from 0
    double left[POSITIONS], left_sigma[POSITIONS];     ///< y of the left line and its sigma [m]
    double right[POSITIONS], right_sigma[POSITIONS];   ///< y of the right line and its sigma [m]
} lane_t;

/// Demands to the car, and why.
typedef struct {
    double curvature; ///< [1/m], to the left
    double speed;     ///< [m/s]
    double sure;      ///< distance over which there surely is room [m]
} demand_t;

/// Return the room on the narrower side of a car in the middle that is surely there [m].
static double room(const lane_t *lane, int i)
{
    const double width = lane->left[i] - lane->right[i];
    const double sigma = fmax(lane->left_sigma[i], lane->right_sigma[i]);
    return width / 2 - HALF_CAR - QUANTILE * sigma;
}

/// Return the distance over which the room surely suffices [m].
static double sure_distance(const lane_t *lane)
{
    double before = room(lane, 0);
    if (!lane->is_usable || !(before >= MARGIN)) {
        return 0.0;
    }
    for (int i = 1; i < POSITIONS; i++) {
        const double here = room(lane, i);
        if (!isfinite(here)) { // the line ends before
            return lane->x[i - 1];
        }
        if (here < MARGIN) {
            const double share = (before - MARGIN) / (before - here);
            return lane->x[i - 1] + share * (lane->x[i] - lane->x[i - 1]);
        }
        before = here;
    }
    return lane->x[POSITIONS - 1];
}

/// Return the middle of the lane at a distance within those that the receiver gives [m].
static double centre_at(const lane_t *lane, double x)
{
    int i = 1;
    while (i < POSITIONS - 1 && lane->x[i] < x) {
        i++;
    }
    const double share = (x - lane->x[i - 1]) / (lane->x[i] - lane->x[i - 1]);
    const double from = (lane->left[i - 1] + lane->right[i - 1]) / 2;
    const double to = (lane->left[i] + lane->right[i]) / 2;
    return from + share * (to - from);
}

/// Set the demands from the lines; without usable ones, brake and keep the curvature.
///
/// `speed` is that of the car, `wanted` the one that it may drive [m/s].
void lane_keeping(const lane_t *lane, double speed, double wanted, demand_t *demand)
{
    const double slowing = DECELERATION * REACTION;
    demand->sure = sure_distance(lane);
    const double fastest = sqrt(slowing * slowing + 2 * DECELERATION * demand->sure) - slowing;
    demand->speed = fmin(wanted, fastest);
    if (lane->is_usable) {
        const double ahead = fmin(fmax(PREVIEW * speed, SHORTEST), lane->x[POSITIONS - 1]);
        const double y = centre_at(lane, ahead);
        const double curvature = 2 * y / (ahead * ahead + y * y);
        demand->curvature = fmin(fmax(curvature, -CURVATURE), CURVATURE);
    }
}
