/* What a receiver makes of scenes, and the functions of which that consists.
 *
 * Input, case by case: one byte, then
 *   0  a scene: time of the pose error (i64), its record, number of lines (u8); of each: slot (u8),
 *      time (i64), record.
 *      Output: 0 if it is refused (u8); else 1, all of the pose error, and of each line.
 *   1  a line: mean (4 f64), fit range (2), quartic, covariance of the pose (9), a pose (3),
 *      line-specific covariance (16), sigma of the map's heading.
 *      Output: whether it is a function (u8), line from that pose (4 f64), bases (16), sigma points
 *      (21), valid range (2); then, each after 1, or 0 if there is none: line with extrapolation
 * (4), derivatives (12), rows of the spread (28). 2  levels: mean (4), fit range (2), raw levels:
 * lateral, points, shape (i64). Output: covariance (16). 3  a square root: size (u8), matrix.
 * Output: the root.
 */
#include "binary.h"
#include "harness_dbc.h"
#include "internal.h"

static void read_numbers(int count, double *values)
{
    for (int i = 0; i < count; ++i)
    {
        values[i] = read_f64();
    }
}

static void write_numbers(int count, const double *values)
{
    for (int i = 0; i < count; ++i)
    {
        write_f64(values[i]);
    }
}

static void write_reals(int count, const maplines_real_t *values)
{
    for (int i = 0; i < count; ++i)
    {
        write_f64((double)values[i]);
    }
}

/// Write whether there are values, and the values.
static void write_found(bool is_found, int count, const double *values)
{
    write_u8(is_found ? 1 : 0);
    if (is_found)
    {
        write_numbers(count, values);
    }
}

static void write_scene(const maplines_scene_t *scene)
{
    write_u8(scene->count);
    write_u32(scene->counter);
    write_i64(scene->t_ns);
    write_reals(9, scene->pose_factor[0]);
    write_reals(1, &scene->correlation_time);
    write_reals(1, &scene->offset_sigma);
    write_reals(1, &scene->heading_sigma);
    write_reals(1, &scene->age);
    for (int i = 0; i < scene->count; ++i)
    {
        const maplines_line_t *line = &scene->lines[i];
        write_u8((uint8_t)line->slot);
        write_u8((uint8_t)line->kind);
        write_u8((uint8_t)line->status);
        write_u8(line->components);
        write_i64(line->t_ns);
        write_reals(1, &line->x_min);
        write_reals(1, &line->x_max);
        write_reals(1, &line->age);
        write_reals(4, line->gaussian.mean);
        write_reals(16, line->gaussian.factor[0]);
        write_reals(28, scene->spread[4 * i]);
        write_reals(16, scene->specific[i][0]);
        write_reals(2, scene->fit_range[i]);
        write_reals(1, &scene->quartic[i]);
    }
}

static void scene_case(void)
{
    static maplines_scene_t scene;
    static maplines_member_t members[MAPLINES_SLOTS];
    uint8_t pose[MAPLINES_MAX_RECORD] = {0};
    const int64_t t_ns = read_i64();
    read_bytes(pose, 8U * harness_dbc.pose.pages);
    const int count = read_u8();
    for (int i = 0; i < count; ++i)
    {
        members[i].slot = read_u8();
        members[i].t_ns = read_i64();
        read_bytes(members[i].record, 8U * harness_dbc.line.pages);
    }
    const bool is_done = maplines_decode_scene(&harness_dbc, pose, t_ns, count, members, &scene);
    write_u8(is_done ? 1 : 0);
    if (is_done)
    {
        write_scene(&scene);
    }
}

static void line_case(void)
{
    maplines_curve_t curve;
    maplines_points_t points;
    double P[9], pose[3], cov[16], line[4], bases[16], range[2];
    double poses[MAPLINES_POSES][3], J[4][3], A[4][MAPLINES_POSES];
    read_numbers(4, curve.mean);
    read_numbers(2, curve.fit_range);
    read_numbers(1, &curve.quartic);
    read_numbers(9, P);
    read_numbers(3, pose);
    read_numbers(16, cov);
    const double heading_sigma = read_f64();
    maplines_points_of(&curve, &points);
    const bool is_line = maplines_is_function(&points);
    write_u8(is_line ? 1 : 0);
    maplines_refitted(&points, pose, line);
    write_numbers(4, line);
    maplines_bases(curve.mean, curve.fit_range, bases);
    write_numbers(16, bases);
    maplines_pose_points(P, poses);
    write_numbers(3 * MAPLINES_POSES, poses[0]);
    maplines_valid_range(&curve, P, cov, heading_sigma, range);
    write_numbers(2, range);
    write_found(is_line && maplines_seen(&points, pose, line), 4, line);
    write_found(is_line && maplines_pose_jacobian(&points, J), 12, J[0]);
    write_found(is_line && maplines_spread(&curve, poses, A), 4 * MAPLINES_POSES, A[0]);
}

static void levels_case(void)
{
    maplines_curve_t curve;
    double cov[16];
    memset(&curve, 0, sizeof curve);
    read_numbers(4, curve.mean);
    read_numbers(2, curve.fit_range);
    const int64_t lateral = read_i64();
    const int64_t points = read_i64();
    const int64_t shape = read_i64();
    maplines_decode_levels(maplines_levels_of(&harness_dbc), &curve, lateral, points, shape, cov);
    write_numbers(16, cov);
}

static void root_case(void)
{
    double S[16], L[16];
    const int n = read_u8();
    read_numbers(n * n, S);
    maplines_square_root(n, S, L);
    write_numbers(n * n, L);
}

int main(void)
{
    static void (*const cases[])(void) = {scene_case, line_case, levels_case, root_case};
    while (!at_end())
    {
        cases[read_u8() & 3U]();
    }
    return 0;
}
