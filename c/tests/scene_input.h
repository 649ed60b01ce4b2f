/* Scene of a test: number of lines (u8); of each line slot, kind and status (u8), x_min, x_max,
 * age, mean, fit range and quartic (10 f64); whether there are line-specific covariances (u8), and
 * these (16 f64 a line); the joint covariance row by row; covariance (9 f64), age and correlation
 * time of the pose error; offset and heading of the map.
 */
#ifndef MAPLINES_TESTS_SCENE_INPUT_H
#define MAPLINES_TESTS_SCENE_INPUT_H

#include "binary.h"
#include "maplines.h"

static inline void read_f64s(double *values, size_t count)
{
    for (size_t i = 0; i < count; ++i)
    {
        values[i] = read_f64();
    }
}

static inline void read_scene(maplines_scene_input_t *scene)
{
    memset(scene, 0, sizeof *scene);
    scene->count = read_u8();
    const size_t lines = scene->count;
    for (size_t i = 0; i < lines; ++i)
    {
        maplines_scene_line_t *line = &scene->lines[i];
        line->slot = (maplines_owner_t)read_u8();
        line->kind = (maplines_kind_t)read_u8();
        line->status = (maplines_status_t)read_u8();
        line->x_min = read_f64();
        line->x_max = read_f64();
        line->age = read_f64();
        line->has_age = true;
        read_f64s(line->mean, 4);
        read_f64s(line->fit_range, 2);
        line->quartic = read_f64();
    }
    scene->has_specific = read_u8() != 0;
    for (size_t i = 0; scene->has_specific && i < lines; ++i)
    {
        for (size_t row = 0; row < 4; ++row)
        {
            read_f64s(scene->lines[i].specific[row], 4);
        }
    }
    for (size_t row = 0; row < 4U * lines; ++row)
    {
        read_f64s(scene->cov[row], 4U * lines);
    }
    for (size_t row = 0; row < 3; ++row)
    {
        read_f64s(scene->pose_cov[row], 3);
    }
    scene->pose_age = read_f64();
    scene->has_pose_age = true;
    scene->correlation_time = read_f64();
    scene->offset_sigma = read_f64();
    scene->heading_sigma = read_f64();
}

#endif
