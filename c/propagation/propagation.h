/* Propagation of a cycle: map lines and an uncertain pose to lines with their covariances.
 *
 * The Python package and an FMU with a map have it from here. A car needs
 *
 *     maplines_prepare_path()     once for each line of the map
 *     maplines_map_lines()        in each cycle, or
 *     maplines_map_scene()        for the lines with their joint covariance
 *
 * Memory   The caller owns all of it; sizes are said with each structure. There is no allocation
 *          and no static state. Functions take up to 16 kB of stack.
 * Threads  Functions share nothing but what they are given.
 * Errors   A function returns false where a line has no value at a point of a transform, or the
 *          result is not finite or no covariance. Arguments are as the Python package checks them.
 * Units    Lengths are in metres, angles in radians, x points ahead and y to the left (ISO 8855).
 */
#ifndef MAPLINES_PROPAGATION_H
#define MAPLINES_PROPAGATION_H

#include "internal.h"

#define MAPLINES_CELLS 64  ///< of a range
#define MAPLINES_TERMS 6   ///< of a fit: w^0 .. w^3, and T_4 and T_5 of what these leave
#define MAPLINES_CHORDS 21 ///< that check the shape of a line
#define MAPLINES_DEGREE 6  ///< of the sums of the normal equations
#define MAPLINES_SUMS 10   ///< mean(u^k), k = 1 .. 6, and mean(v u^k), k = 0 .. 3

/// Reason for which a line is not given, in the order of LeftOut of the Python package.
typedef enum {
    MAPLINES_GIVEN = 0,
    MAPLINES_NOT_IN_WINDOW = 1,
    MAPLINES_ACROSS = 2,
    MAPLINES_TOO_SHORT = 3,
    MAPLINES_UNCERTAIN = 4,
    MAPLINES_FEW_POINTS = 5,
} maplines_omission_t;

/// Length of a vector. The relative error is at most 2^-52
/// from 1e-150 to 1e154; squares of what is longer overflow.
static inline double maplines_hypot(double x, double y)
{
    return sqrt(x * x + y * y);
}

/* ---- square_root.c ----------------------------------------------------------------------------
 */

/// Square root of an (n, n) positive semidefinite matrix, n up to 4.
void maplines_square_root(int n, const double *cov, double *L);

/* ---- stretches.c: what is seen of lines -------------------------------------------------------
 */

#define MAPLINES_PATH_ARRAYS 13 ///< arrays of a path, each of as many doubles as it has points

/// Line of a map, with what a query needs of it and does not depend on the pose.
typedef struct {
    size_t count;           ///< of points, 2 or more
    const double *x, *y;    ///< points [m]
    const double *distance; ///< arc length from the first point to each [m]
    const double *dx, *dy;  ///< step from each point to the next; the last one is 0 [m]
    const double *squared;  ///< length of the step [m^2], more than 0
    const double *cx, *cy;  ///< chord that gives the direction of the step [m]
    const double *chord;    ///< its length [m]
    /// Sums over the points before each: of the squared errors that the points show, and of their
    /// squared distances from the chords of their neighbours [m^2].
    const double *errors, *sagittas;
    /// The same of the squared errors that points far apart show [m^2], and of their distances [m].
    const double *coarse_errors, *coarse_distances;
    size_t coarse_ends[2]; ///< the first point of which they are known, and the one after the last
} maplines_path_t;

/// Where the car is, and what it looks at.
typedef struct {
    double pose[3];    ///< x, y [m] and heading [rad] in the frame of the map
    double window[2];  ///< ends of what is looked at, in the frame of the car [m]
    double max_turn;   ///< largest angle between a line and the x axis [rad]
    double max_unseen; ///< most that a line may bend between its points unseen, as a sigma [m]
} maplines_look_t;

/// Stretch of a line within a window: a function y(x) in the frame of the car.
typedef struct {
    size_t first, count; ///< points, which include those next to both ends of the range
    double x_range[2];   ///< [m]
    size_t line;         ///< of which line it is
    double error;        ///< variance of the errors of its points, as they show it [m^2]
    double widened;      ///< the same, as far as these points can tell it [m^2]
    double sagitta;      ///< mean square of the distances of points from chords [m^2]
    double bends;        ///< variance of the line between points, by the bends that they show [m^2]
    double unseen;       ///< the same in all [m^2]
    double kinks;        ///< that errors of its points hide: variance of its direction by length
} maplines_stretch_t;

/// Stretches of lines. The points of all of them stand one after the other.
typedef struct {
    size_t lines;                ///< number of stretches
    size_t points;               ///< of all stretches
    double *x, *y;               ///< (points) in the frame of the car [m]
    double *key;                 ///< (points) x, ascending over all stretches
    double *slope;               ///< (points) dy / dkey to the next point
    double *area;                ///< (points) integral of y from the first point of the stretch
    double *square, *cube;       ///< (points) those of what chords of x^2 and x^3 exceed them by
    double step;                 ///< by which the keys of a stretch exceed those of the one before
    maplines_stretch_t *stretch; ///< (lines)
} maplines_stretches_t;

/// Prepare a line of (count, 2) points; memory is MAPLINES_PATH_ARRAYS * count doubles, which the
/// path uses. A step whose square overflows is far away from any car.
void maplines_prepare_path(const double *points, const double *distance, size_t count,
                           double *memory, maplines_path_t *path);
/// Squared errors (count) that the points of a line show [m^2]; 0 for two at each of its ends.
void maplines_shown_errors(const maplines_path_t *path, double *squares);
/// Place on the map from which lines are followed, and how far along them [m].
void maplines_look_start(const maplines_look_t *look, double start[2], double *reach);
/// Stretches of lines; the arrays of `seen` have room for all points of the lines, and left_out has
/// the reason of each line, or MAPLINES_GIVEN.
void maplines_see(const maplines_path_t *paths, size_t count, const maplines_look_t *look,
                  maplines_stretches_t *seen, maplines_omission_t *left_out);

/// Cells of equal length in a range of a stretch.
typedef struct {
    double y[MAPLINES_CELLS];            ///< means of the line [m]
    double square[MAPLINES_CELLS];       ///< of what chords between its points exceed w^2 by
    double cube[MAPLINES_CELLS];         ///< and w^3, w is -1 to 1 in the range
    double position[MAPLINES_CELLS + 1]; ///< of their ends: indices of points, with fractions
    double terms[3][MAPLINES_TERMS];     ///< of a fit to the means of y, square and cube
} maplines_cells_t;

/// Cells of a range of a stretch; up to MAPLINES_CELLS.
void maplines_divide(const maplines_stretches_t *seen, size_t line, const double x_range[2],
                     int count, maplines_cells_t *cells);

/* ---- cubic_range.c, misfit.c: the cubic of a line, and what it misses -------------------------
 */

/// How cubics are fitted.
typedef struct {
    double max_misfit;  ///< largest deviation of a cubic from its line [m]; may be infinite
    double room;        ///< distance behind the car at which a range begins at least [m]
    double step;        ///< of which the ends of ranges are multiples; 0 for any [m]
    bool has_map_error; ///< whether the next ones count
    double point_sigma, offset_sigma, heading_sigma; ///< [m], [m], [rad]
} maplines_fit_t;

/// Cubic of a line by least squares, in w = (x - centre) / half of its range.
typedef struct {
    double x_range[2]; ///< [m]
    double q[4];       ///< coefficients of w^0 .. w^3 [m]
    double modes[2];   ///< of T_4 and T_5, which it leaves of the line [m]
    double misfit;     ///< what it misses of the line at most, beside errors of its points [m]
    double fit[16];    ///< (4, 4): from the coefficients of chords between the points to q
} maplines_fitted_t;

/// Cubic in the longest range of a stretch with at most the greatest misfit, and the sums of what
/// it leaves of the line, from the first cell to the begin of each; false if there is none.
bool maplines_longest_range(const maplines_stretches_t *seen, size_t line,
                            const maplines_fit_t *fit, maplines_fitted_t *fitted,
                            maplines_cells_t *cells, double sums[MAPLINES_CELLS + 2]);
/// Share of what the points show of their errors that is taken for errors. The rest, and all of it
/// where points are few, may be the shape of the road.
double maplines_noise_share(double points);
/// The sum up to a place between cells.
static inline double maplines_sum_to(const double *sums, double place)
{
    const int k = (int)place;
    return sums[k] + (place - (double)k) * (sums[k + 1] - sums[k]);
}
/// Variances of the coefficients of T_0 .. T_3 that cover what a cubic misses [m^2].
void maplines_coefficient_variances(const maplines_stretch_t *stretch,
                                    const maplines_fitted_t *fitted, const maplines_cells_t *cells,
                                    const double sums[MAPLINES_CELLS + 2], double variances[4]);

/* ---- refit.c: the line as a function of the pose ----------------------------------------------
 */

/// Line as a function of the pose, about the one from which it was selected; 5 kB.
typedef struct {
    maplines_fitted_t fitted;
    double x[MAPLINES_NODES], y[MAPLINES_NODES];     ///< points of the line [m]
    double centre[2], half;                          ///< of the points [m]
    double sums[MAPLINES_DEGREE + 1][MAPLINES_SUMS]; ///< coefficients of c^(d - j) s^j
    double chords[2][MAPLINES_CHORDS];               ///< [m]
    double span[2];                                  ///< sum of the chords [m]
    double slopes[2];                                ///< least and greatest of a chord
    double least_advance;                            ///< of all chords along the x axis [m]
    bool is_across;       ///< nearly perpendicular to the x axis of the mean pose
    double mean[4];       ///< line seen from the mean pose
    double noise_cov[16]; ///< of the map error and the misfit; 0 without both
} maplines_refit_t;

/// Pose from which lines are selected.
typedef struct {
    double pose[3];      ///< x, y [m] and heading [rad] in the frame of the map
    double cosine, sine; ///< of the heading
} maplines_mean_pose_t;

/// Another pose, and how it differs from the one from which lines are selected.
typedef struct {
    double pose[3];      ///< x, y [m] and heading [rad] in the frame of the map
    double cosine, sine; ///< of its turn
    double ahead, aside; ///< of its displacement in the frame of the car [m]
} maplines_other_pose_t;

maplines_mean_pose_t maplines_mean_pose(const double pose[3]);
maplines_other_pose_t maplines_other_pose(const maplines_mean_pose_t *from, const double pose[3]);
/// From a displacement in the frame of the car to the pose in the frame of the map.
void maplines_displace(const maplines_mean_pose_t *from, double pose[3]);
/// Refit of a stretch; false if no cubic follows it in any range.
bool maplines_refit(const maplines_stretches_t *seen, size_t line, const maplines_mean_pose_t *from,
                    const maplines_fit_t *fit, maplines_refit_t *refit);
/// Line (y_off, beta, c0, c1) seen from a pose; false, and NaN, if it is no function of x there.
bool maplines_refit_at(const maplines_refit_t *refit, const maplines_other_pose_t *pose,
                       double line[4]);
/// The same, extrapolated from the mean pose where the line is no function of x; false if it is
/// none next to the mean pose.
bool maplines_refit_extended(const maplines_refit_t *refit, const maplines_mean_pose_t *from,
                             const maplines_other_pose_t *pose, double line[4]);

/* ---- moments.c, certain_range.c ----------------------------------------------------------------
 */

/// Points of a transform: mean + root z, and their weights. The first one is at the mean, or next
/// to it.
typedef struct {
    size_t count;
    const double *z; ///< (count, 3)
    const double *mean_weights, *cov_weights;
} maplines_rule_t;

/// Point k of a rule, of a Gaussian with a lower triangular root.
void maplines_rule_point(const maplines_rule_t *rule, size_t k, const double mean[3],
                         const double root[9], double point[3]);
/// Mean (m) and covariance (m, m), symmetric but for rounding, of the (count, m) values at the
/// points of a rule, of which row i begins at values + i * stride; scratch is (m).
void maplines_weighted_moments(const maplines_rule_t *rule, size_t m, size_t stride,
                               const double *values, double *scratch, double *mean, double *cov);
/// Covariances (n, n) up to rounding; scratch is (n, n).
bool maplines_is_covariance(size_t n, const double *cov, double *scratch);
/// Part of a range where the standard deviation of the lateral position is at most max_sigma: the
/// one with the place nearest to the car. NaN if there is none.
void maplines_certain_range(const double mean[4], const double cov[16], const double x_range[2],
                            double max_sigma, double certain[2]);

/* ---- cycle.c: lines of a map ------------------------------------------------------------------
 */

/// What is asked for.
typedef struct {
    double mean[3];     ///< pose in the frame of the map [m, m, rad]
    double cov[9];      ///< its covariance there
    double window[2];   ///< that the ranges may extend to [m]
    maplines_fit_t fit; ///< all but room and step
    double max_sigma;   ///< largest standard deviation of a lateral position [m]
} maplines_cycle_t;

/// Uncertain pose, and what follows from it.
typedef struct {
    maplines_look_t look;
    maplines_mean_pose_t from;
    double pose_cov[9]; ///< in the frame of the car: along, across [m], heading [rad]
    double cov[9];      ///< with what of the map error acts as a pose error
    double room;        ///< that ranges leave at their ends, at most [m]
} maplines_pose_view_t;

/// Memory of a cycle.
typedef struct {
    maplines_stretches_t seen;
    maplines_refit_t *refits;     ///< (lines)
    maplines_other_pose_t *poses; ///< (rule->count)
    double *values;               ///< (rule->count, 4 lines)
    double *matrix;               ///< (4 lines, 4 lines), of scenes only
} maplines_work_t;

/// Lines of a scene, one after the other without those that are left out.
typedef struct {
    size_t lines;
    double *means;         ///< (lines, 4)
    double *cov;           ///< (4 lines, 4 lines)
    double (*x_ranges)[2]; ///< in which they are valid [m]
    double (*fit_ranges)[2];
    double *quartics;
    double *specific_covs; ///< (lines, 4, 4)
} maplines_joint_t;

#define MAPLINES_SCENE_LINES MAPLINES_SLOTS ///< most lines of a scene

/// Line of a scene while its range is sought.
typedef struct {
    bool is_new;     ///< its range has changed
    bool is_shorter; ///< it was fitted again, since it was uncertain
    bool is_dropped;
    int trials;
} maplines_trial_t;

/// Lines of a scene while their ranges are sought.
typedef struct {
    maplines_pose_view_t view;
    maplines_fit_t fit;
    maplines_trial_t trials[MAPLINES_SCENE_LINES];
    size_t lines;                        ///< that are kept
    size_t places[MAPLINES_SCENE_LINES]; ///< of these among the stretches
} maplines_search_t;

/// What follows from an uncertain pose.
void maplines_pose_view(const maplines_cycle_t *cycle, maplines_pose_view_t *view);

/// Lines one by one, of which each has a mean, a (4, 4) covariance and a valid range [m]; where
/// left_out has a reason, they are not set.
bool maplines_map_lines(const maplines_path_t *paths, size_t count, const maplines_cycle_t *cycle,
                        const maplines_rule_t *rule, maplines_work_t *work,
                        maplines_omission_t *left_out, double (*means)[4], double (*covs)[16],
                        double (*x_ranges)[2]);
/// How lines are fitted one by one.
maplines_fit_t maplines_line_fit(const maplines_cycle_t *cycle, const maplines_pose_view_t *view);
/// Range of a refit with room for the pose error; false if the line cannot be given.
bool maplines_line_range(const maplines_cycle_t *cycle, const maplines_pose_view_t *view,
                         const maplines_refit_t *refit, double x_range[2]);
/// Shorten the range of a line to where it is certain enough; false if too little is left.
bool maplines_shorten_range(const double mean[4], const double cov[16], double max_sigma,
                            double x_range[2]);

/// Lines with their joint covariance, of up to MAPLINES_SCENE_LINES lines.
bool maplines_map_scene(const maplines_path_t *paths, size_t count, const maplines_cycle_t *cycle,
                        const maplines_rule_t *rule, maplines_work_t *work,
                        maplines_omission_t *left_out, maplines_joint_t *joint);
/// The same step by step, for a caller that computes the moments itself: begin, then fit and
/// settle until nothing is left or all is settled.
void maplines_begin_scene(const maplines_path_t *paths, size_t count, const maplines_cycle_t *cycle,
                          maplines_work_t *work, maplines_omission_t *left_out,
                          maplines_search_t *search);
/// Fit lines whose ranges are new; false if no line is kept. The reasons of the others are set.
bool maplines_fit_scene(const maplines_cycle_t *cycle, maplines_work_t *work,
                        maplines_omission_t *left_out, maplines_search_t *search);
/// Set the valid ranges by the means and the covariance of the lines that are kept; false if lines
/// are to be fitted again or dropped.
bool maplines_settle_scene(const maplines_cycle_t *cycle, maplines_work_t *work,
                           maplines_search_t *search, maplines_joint_t *joint);

#endif
