/* Mistakes of a caller: the refusal names them, nothing is sent, and no counter advances.
 *
 * Input: nothing. Output: a row for each mistake that is not named. Of a DBC whose lines have a
 * covariance of their own, all are tried; of another one, those of a scene.
 */
#include "harness_dbc.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

enum {
    COUNTER = 255 ///< of each owner
};

#define MAX_COMPONENTS 64
#define MAX(a, b) ((a) > (b) ? (a) : (b))

static maplines_frame_t frames[MAX(MAPLINES_MAX_FRAMES, MAPLINES_MAX_SCENE_FRAMES)];
static maplines_encoder_t encoder;
static maplines_scene_workspace_t workspace;

static void begin(void)
{
    maplines_encoder_init(&encoder, &harness_dbc, NULL);
    for (int owner = 0; owner < MAPLINES_OWNERS; ++owner)
    {
        encoder.counter[owner] = COUNTER;
    }
}

static void check(const char *what, maplines_refusal_t expected, maplines_refusal_t found,
                  size_t count)
{
    bool is_right = found == expected && (count > 0) == (expected == MAPLINES_SENT);
    for (int owner = 0; owner < MAPLINES_OWNERS && expected != MAPLINES_SENT; ++owner)
    {
        is_right = is_right && encoder.counter[owner] == COUNTER;
    }
    if (!is_right)
    {
        (void)printf("%s: %s, not %s\n", what, maplines_refusal_name(found),
                     maplines_refusal_name(expected));
    }
}

/// Variances of the parameters of a line.
static void set_variances(double cov[4][4])
{
    static const double variances[4] = {1e-2, 1e-4, 1e-8, 1e-12};
    for (int i = 0; i < 4; ++i)
    {
        cov[i][i] = variances[i];
    }
}

/* ---- lines and mixtures ---- */

static maplines_input_t good_line(void)
{
    maplines_input_t line;
    memset(&line, 0, sizeof line);
    line.kind = MAPLINES_SOLID;
    line.status = MAPLINES_FULL;
    line.x_min = -8;
    line.x_max = 64;
    line.age = 0.04;
    set_variances(line.cov);
    return line;
}

static void check_line(const char *what, maplines_refusal_t expected, const maplines_input_t *line)
{
    begin();
    const maplines_sent_t sent = maplines_encode_line(&encoder, line, false, 0, frames);
    check(what, expected, sent.refusal, sent.count);
}

/// Try a mixture of components with the mean and covariance of a line.
static void check_mixture(const char *what, maplines_refusal_t expected,
                          const maplines_input_t *line, size_t count, const double *weights)
{
    maplines_component_t components[MAX_COMPONENTS];
    for (size_t i = 0; i < count; ++i)
    {
        components[i].weight = weights == NULL ? 1.0 / (double)count : weights[i];
        memcpy(components[i].mean, line->mean, sizeof line->mean);
        memcpy(components[i].cov, line->cov, sizeof line->cov);
    }
    begin();
    const maplines_sent_t sent =
        maplines_encode_mixture(&encoder, line, components, count, false, 0, frames);
    check(what, expected, sent.refusal, sent.count);
}

#define LINE(expected, change)                                                                     \
    do                                                                                             \
    {                                                                                              \
        maplines_input_t line = good_line();                                                       \
        change;                                                                                    \
        check_line(#change, expected, &line);                                                      \
    }                                                                                              \
    while (0)

#define MIXTURE(expected, count, first, second, change)                                            \
    do                                                                                             \
    {                                                                                              \
        const double weights[2] = {first, second};                                                 \
        maplines_input_t line = good_line();                                                       \
        change;                                                                                    \
        check_mixture(#change " " #first " " #second, expected, &line, count,                      \
                      (count) == 2 ? weights : NULL);                                              \
    }                                                                                              \
    while (0)

static void try_lines(void)
{
    LINE(MAPLINES_SENT, (void)0);
    LINE(MAPLINES_NO_MESSAGE, line.slot = (maplines_owner_t)9);
    LINE(MAPLINES_NO_MESSAGE, line.slot = MAPLINES_POSE);
    LINE(MAPLINES_BAD_MEAN, line.mean[0] = NAN);
    LINE(MAPLINES_BAD_MEAN, line.mean[2] = -INFINITY);
    LINE(MAPLINES_BAD_COVARIANCE, line.cov[1][1] = NAN);
    LINE(MAPLINES_BAD_COVARIANCE, line.cov[3][0] = 2e307);
    LINE(MAPLINES_BAD_VARIANCE, line.cov[2][2] = -1e-300);
    LINE(MAPLINES_ASYMMETRIC, line.cov[0][1] = 1e-3 * 2e-9);
    LINE(MAPLINES_SENT, line.cov[0][1] = 1e-3 * 9e-10);
    LINE(MAPLINES_BAD_RANGE, line.x_min = NAN);
    LINE(MAPLINES_BAD_RANGE, line.x_max = INFINITY);
    LINE(MAPLINES_BAD_RANGE, line.x_min = 64.1);
    LINE(MAPLINES_SENT, line.x_min = 64);
    LINE(MAPLINES_BAD_AGE, line.age = -1e-9);
    LINE(MAPLINES_BAD_AGE, line.age = NAN);
    LINE(MAPLINES_SENT, line.age = INFINITY);
    LINE(MAPLINES_BAD_KIND, line.kind = (maplines_kind_t)8);
    LINE(MAPLINES_BAD_STATUS, line.status = (maplines_status_t)6);
    LINE(MAPLINES_SENT, line.status = MAPLINES_UNKNOWN; line.cov[1][1] = NAN);
    MIXTURE(MAPLINES_SENT, 2, 0.5, 0.5, (void)0);
    MIXTURE(MAPLINES_BAD_WEIGHTS, 2, 0.5, 0.6, (void)0);
    MIXTURE(MAPLINES_BAD_WEIGHTS, 2, 1.5, -0.5, (void)0);
    MIXTURE(MAPLINES_BAD_WEIGHTS, 2, NAN, 0.5, (void)0);
    MIXTURE(MAPLINES_BAD_WEIGHTS, 2, 2.0, -1.0, (void)0);
    MIXTURE(MAPLINES_BAD_COUNT, 9, 0, 0, (void)0);
    MIXTURE(MAPLINES_BAD_COUNT, 0, 0, 0, (void)0);
    MIXTURE(MAPLINES_NO_MESSAGE, 2, 0.5, 0.5, line.slot = MAPLINES_POSE);
    MIXTURE(MAPLINES_BAD_COVARIANCE, 2, 0.5, 0.5, line.cov[1][1] = INFINITY);
}

/* ---- scenes ---- */

static void good_scene(maplines_scene_input_t *scene)
{
    memset(scene, 0, sizeof *scene);
    scene->count = 2;
    scene->has_specific = true;
    for (int i = 0; i < 2; ++i)
    {
        maplines_scene_line_t *line = &scene->lines[i];
        line->slot = (maplines_owner_t)i;
        line->kind = MAPLINES_SOLID;
        line->status = MAPLINES_FULL;
        line->x_max = 80;
        line->age = 0.02;
        line->mean[0] = 1.75 - 3.5 * i;
        line->fit_range[0] = -4;
        line->fit_range[1] = 84;
        set_variances(line->specific);
        for (int k = 0; k < 4; ++k)
        {
            scene->cov[4 * i + k][4 * i + k] = 4 * line->specific[k][k];
        }
    }
    scene->pose_cov[0][0] = 0.01;
    scene->pose_cov[1][1] = 0.01;
    scene->pose_cov[2][2] = 1e-6;
    scene->correlation_time = 4;
}

#define SCENE(expected, change)                                                                    \
    do                                                                                             \
    {                                                                                              \
        maplines_scene_input_t scene;                                                              \
        good_scene(&scene);                                                                        \
        change;                                                                                    \
        begin();                                                                                   \
        const maplines_sent_scene_t sent =                                                         \
            maplines_encode_scene(&encoder, &scene, false, 0, &workspace, frames);                 \
        check(#change, expected, sent.refusal, sent.count);                                        \
    }                                                                                              \
    while (0)

static void try_scenes(void)
{
    SCENE(MAPLINES_SENT, (void)0);
    SCENE(MAPLINES_SENT, scene.count = 0);
    SCENE(MAPLINES_BAD_COUNT, scene.count = 9);
    SCENE(MAPLINES_BAD_MEAN, scene.lines[1].mean[1] = INFINITY);
    SCENE(MAPLINES_BAD_COVARIANCE, scene.cov[5][5] = NAN);
    SCENE(MAPLINES_BAD_VARIANCE, scene.cov[5][5] = -1e-9);
    SCENE(MAPLINES_ASYMMETRIC, scene.cov[0][5] = 1.0);
    SCENE(MAPLINES_INDEFINITE, scene.cov[0][1] = 1.0; scene.cov[1][0] = 1.0);
    SCENE(MAPLINES_BAD_VARIANCE, scene.lines[0].specific[2][2] = -1.0);
    SCENE(MAPLINES_BAD_VARIANCE, scene.pose_cov[1][1] = -1.0);
    SCENE(MAPLINES_BAD_POSE, scene.pose_cov[1][1] = 1e6);
    SCENE(MAPLINES_BAD_RANGE, scene.lines[0].fit_range[1] = -99.0);
    SCENE(MAPLINES_BAD_RANGE, scene.lines[0].fit_range[0] = -INFINITY);
    SCENE(MAPLINES_BAD_RANGE, scene.lines[0].fit_range[1] = INFINITY);
    SCENE(MAPLINES_BAD_RANGE, scene.lines[0].quartic = NAN);
    SCENE(MAPLINES_BAD_RANGE, scene.lines[0].x_min = 99.0);
    SCENE(MAPLINES_BAD_POSE, scene.offset_sigma = -1e-9);
    SCENE(MAPLINES_BAD_POSE, scene.offset_sigma = INFINITY);
    SCENE(MAPLINES_BAD_POSE, scene.heading_sigma = NAN);
    SCENE(MAPLINES_BAD_POSE, scene.heading_sigma = INFINITY);
    SCENE(MAPLINES_BAD_POSE, scene.correlation_time = 0.0);
    SCENE(MAPLINES_BAD_AGE, scene.pose_age = -1e-9);
    SCENE(MAPLINES_BAD_AGE, scene.pose_age = NAN);
    SCENE(MAPLINES_SAME_SLOT, scene.lines[0].slot = MAPLINES_EGO_RIGHT);
    SCENE(MAPLINES_NO_MESSAGE, scene.lines[0].slot = MAPLINES_POSE);
    SCENE(MAPLINES_BAD_KIND, scene.lines[1].kind = (maplines_kind_t)8);
    SCENE(MAPLINES_BAD_STATUS, scene.lines[1].status = (maplines_status_t)6);
}

int main(void)
{
    if (harness_dbc.is_conditional)
    {
        const maplines_input_t line = good_line();
        check_line("a line of its own", MAPLINES_NO_COVARIANCE, &line);
    }
    else
    {
        try_lines();
    }
    try_scenes();
    return 0;
}
