/* What a function of the car does with lines: lines, scenes and motions in, all results out. */
#include "binary.h"
#include "maplines.h"

static maplines_real_t read_real(void)
{
    return (maplines_real_t)read_f64();
}

static void read_reals(size_t n, maplines_real_t *values)
{
    for (size_t i = 0; i < n; ++i)
    {
        values[i] = read_real();
    }
}

static void write_reals(size_t n, const maplines_real_t *values)
{
    for (size_t i = 0; i < n; ++i)
    {
        write_f64((double)values[i]);
    }
}

static void write_estimate(maplines_estimate_t estimate)
{
    write_f64((double)estimate.value);
    write_f64((double)estimate.sigma);
}

static maplines_line_t read_line(void)
{
    maplines_line_t line;
    memset(&line, 0, sizeof line);
    line.slot = (maplines_owner_t)read_u8();
    line.status = (maplines_status_t)read_u8();
    line.components = read_u8();
    line.t_ns = read_i64();
    line.age = read_real();
    line.x_min = read_real();
    line.x_max = read_real();
    read_reals(4, line.gaussian.mean);
    read_reals(16, &line.gaussian.factor[0][0]);
    return line;
}

static void write_line(const maplines_line_t *line)
{
    write_u8((uint8_t)line->components);
    write_i64(line->t_ns);
    write_f64((double)line->age);
    write_f64((double)line->x_min);
    write_f64((double)line->x_max);
    write_reals(4, line->gaussian.mean);
    write_reals(16, &line->gaussian.factor[0][0]);
}

static void use_line(void)
{
    const maplines_line_t line = read_line();
    const size_t count = read_u8();
    for (size_t i = 0; i < count; ++i)
    {
        const maplines_real_t x = read_real();
        write_f64((double)maplines_y(&line, x));
        write_f64((double)maplines_y_sigma(&line, x));
        write_estimate(maplines_slope(&line, x, 10));
        write_estimate(maplines_curvature(&line, x, 10));
        write_estimate(maplines_y_extrapolated(&line, x));
        write_u8(maplines_is_valid_at(&line, x));
    }
    maplines_real_t covariance[4][4];
    maplines_covariance(&line.gaussian, covariance);
    write_reals(16, &covariance[0][0]);
}

static void use_position(void)
{
    const maplines_line_t line = read_line();
    maplines_position_t positions[255];
    const size_t count = read_u8();
    for (size_t i = 0; i < count; ++i)
    {
        positions[i].x = read_real();
        positions[i].y = read_real();
        positions[i].sigma = read_real();
    }
    write_f64((double)maplines_mahalanobis(&line, count, positions));
}

static maplines_owner_t read_slot(void)
{
    return (maplines_owner_t)read_u8();
}

static void use_scene(void)
{
    maplines_scene_t scene;
    memset(&scene, 0, sizeof scene);
    scene.count = read_u8();
    for (size_t i = 0; i < scene.count; ++i)
    {
        scene.lines[i] = read_line();
        read_reals(28, scene.spread[4 * i]);
        read_reals(16, &scene.specific[i][0][0]);
    }
    maplines_term_t terms[16];
    const size_t count = read_u8();
    for (size_t i = 0; i < count; ++i)
    {
        terms[i].slot = read_slot();
        terms[i].x = read_real();
        terms[i].weight = read_real();
    }
    maplines_owner_t slots[MAPLINES_SLOTS];
    const size_t chosen = read_u8();
    for (size_t i = 0; i < chosen; ++i)
    {
        slots[i] = read_slot();
    }
    const maplines_real_t x = read_real();
    maplines_estimate_t estimate;
    write_u8(maplines_sum(&scene, count, terms, &estimate));
    write_estimate(estimate);
    write_u8(maplines_width(&scene, MAPLINES_EGO_LEFT, MAPLINES_EGO_RIGHT, x, &estimate));
    write_estimate(estimate);
    write_u8(maplines_centre(&scene, MAPLINES_EGO_LEFT, MAPLINES_EGO_RIGHT, x, &estimate));
    write_estimate(estimate);
    maplines_real_t range[2];
    write_u8(maplines_common_range(&scene, chosen, slots, &range[0], &range[1]));
    write_reals(2, range);
    maplines_real_t covariance[16 * MAPLINES_SLOTS * MAPLINES_SLOTS];
    const bool has_all = maplines_joint_covariance(&scene, chosen, slots, covariance);
    write_u8(has_all);
    write_reals(has_all ? 16 * chosen * chosen : 0, covariance);
    for (size_t i = 0; i < MAPLINES_SLOTS; ++i)
    {
        write_u8(maplines_scene_line(&scene, (maplines_owner_t)i) != NULL);
    }
}

static maplines_motion_t read_motion(void)
{
    maplines_motion_t motion;
    motion.speed = read_real();
    motion.yaw_rate = read_real();
    motion.speed_sigma = read_real();
    motion.yaw_rate_sigma = read_real();
    motion.correlation = read_real();
    return motion;
}

static void use_motion(void)
{
    const maplines_motion_t motion = read_motion();
    const maplines_real_t dt = read_real();
    const maplines_real_t time_sigma = read_real();
    maplines_displacement_t displacement;
    memset(&displacement, 0, sizeof displacement);
    write_u8(maplines_displacement(&motion, dt, time_sigma, &displacement));
    write_reals(3, displacement.mean);
    write_reals(9, &displacement.factor[0][0]);
}

static void predict_by_motion(void)
{
    maplines_line_t line = read_line();
    const int64_t t_ns = read_i64();
    const maplines_motion_t motion = read_motion();
    const maplines_real_t time_sigma = read_real();
    write_u8((uint8_t)maplines_predict_to(&line, t_ns, &motion, time_sigma, &line));
    write_line(&line);
}

static void predict_by_displacement(void)
{
    maplines_line_t line = read_line();
    const int64_t t_ns = read_i64();
    maplines_displacement_t displacement;
    read_reals(3, displacement.mean);
    read_reals(9, &displacement.factor[0][0]);
    write_u8((uint8_t)maplines_predict(&line, t_ns, &displacement, &line));
    write_line(&line);
}

static void predict_component(void)
{
    maplines_line_t line = read_line();
    maplines_displacement_t displacement;
    read_reals(3, displacement.mean);
    read_reals(9, &displacement.factor[0][0]);
    write_u8((uint8_t)maplines_predict_gaussian(&line.gaussian, &displacement, line.x_min,
                                                line.x_max, &line.gaussian));
    write_line(&line);
}

static void use_mixture(void)
{
    maplines_gaussian_t components[8];
    maplines_real_t weights[8];
    const size_t count = read_u8();
    for (size_t i = 0; i < count; ++i)
    {
        weights[i] = read_real();
        read_reals(4, components[i].mean);
        read_reals(16, &components[i].factor[0][0]);
    }
    maplines_overall(count, components, weights, &components[0]);
    write_reals(4, components[0].mean);
    write_reals(16, &components[0].factor[0][0]);
}

int main(void)
{
    static void (*const commands[])(void) = {
        use_line,    use_position,      use_scene,
        use_motion,  predict_by_motion, predict_by_displacement,
        use_mixture, predict_component,
    };
    while (!at_end())
    {
        const unsigned command = read_u8();
        if (command >= sizeof commands / sizeof *commands)
        {
            return 4;
        }
        commands[command]();
    }
    return 0;
}
