/* Each public function with what its caller must not give: a row each, which prints
 *
 *     function | mistake | what came of it | assertions that failed
 *
 * With an argument, only the row of this number. A row ends with "wrong" if the result is not the
 * one that the header promises. Assertions are counted with count_assertions.h.
 *
 * The rows are those of the build. A receiver without a sender takes the frames of sent_frames.h,
 * which a program with both writes with the argument "frames".
 */
#include "lines_dbc.h"
#if MAPLINES_SCENES
#include "pose_dbc.h"
#endif

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define ROUNDS 20
#define CYCLE_NS INT64_C(50000000)
#define BAD_SLOT ((maplines_owner_t)99)

static int failures; ///< assertions

#ifdef MAPLINES_ASSERT
void count_assertion(int holds)
{
    failures += holds == 0 ? 1 : 0;
}
#endif

/* ---- a good sender: a line, and a scene of two lines ------------------------------------------
 */

static const maplines_owner_t left = MAPLINES_EGO_LEFT;
static maplines_frame_t frames[MAPLINES_MAX_FRAMES + MAPLINES_MAX_PAGES * MAPLINES_OWNERS];
#if MAPLINES_SCENES
static const maplines_owner_t both[2] = {MAPLINES_EGO_LEFT, MAPLINES_EGO_RIGHT};
#endif

#if MAPLINES_SENDER
static const double variances[4] = {0.01, 1e-4, 1e-8, 1e-12};
static maplines_encoder_t encoder;
static maplines_input_t input;

static void set_line(void)
{
    memset(&input, 0, sizeof input);
    input.slot = left;
    input.kind = MAPLINES_SOLID;
    input.status = MAPLINES_FULL;
    input.x_max = 80;
    input.age = 0.02;
    input.has_age = true;
    for (int i = 0; i < 4; ++i)
    {
        input.cov[i][i] = variances[i];
    }
}
#if MAPLINES_MIXTURES
static maplines_component_t components[MAPLINES_MAX_COMPONENTS];

static void set_mixture(void)
{
    for (int k = 0; k < MAPLINES_MAX_COMPONENTS; ++k)
    {
        memset(&components[k], 0, sizeof components[k]);
        components[k].weight = k < 2 ? 0.5 : 0;
        memcpy(components[k].cov, input.cov, sizeof input.cov);
    }
}
#endif
#if MAPLINES_SCENES
static maplines_encoder_t scene_encoder;
static maplines_scene_input_t scene_input;
static maplines_scene_workspace_t workspace;

static void set_scene(void)
{
    memset(&scene_input, 0, sizeof scene_input);
    scene_input.count = 2;
    scene_input.pose_age = 0.02;
    scene_input.has_pose_age = true;
    scene_input.correlation_time = 10;
    scene_input.has_specific = true;
    for (int i = 0; i < 3; ++i)
    {
        scene_input.pose_cov[i][i] = i < 2 ? 0.01 : 1e-6;
    }
    for (int k = 0; k < 2; ++k)
    {
        maplines_scene_line_t *one = &scene_input.lines[k];
        one->slot = both[k];
        one->kind = MAPLINES_SOLID;
        one->status = MAPLINES_FULL;
        one->x_max = 80;
        one->age = 0.02;
        one->has_age = true;
        one->mean[0] = k == 0 ? 1.75 : -1.75;
        one->fit_range[1] = 80;
        one->specific[0][0] = 0.01;
        for (int m = 0; m < 2; ++m) // straight lines move with the pose: across, and by the heading
        {
            scene_input.cov[4 * k][4 * m] = k == m ? 0.02 : 0.01;
            scene_input.cov[4 * k + 1][4 * m + 1] = 1e-6;
        }
    }
}

static maplines_sent_scene_t encode_scene(void)
{
    return maplines_encode_scene(&scene_encoder, &scene_input, false, 0, &workspace, frames);
}

#endif

static void set_inputs(void)
{
    set_line();
#if MAPLINES_MIXTURES
    set_mixture();
#endif
#if MAPLINES_SCENES
    set_scene();
#endif
}
#endif // MAPLINES_SENDER

/* ---- results ----------------------------------------------------------------------------------
 */

static char text[200];

static const char *said(const char *what, bool is_promised)
{
    (void)snprintf(text, sizeof text, "%s%s", what, is_promised ? "" : " wrong");
    return text;
}

static const char *nothing(void)
{
    return said("nothing", true);
}

/* ---- rows -------------------------------------------------------------------------------------
 */

static int row_number, only;

static bool begins(void)
{
    ++row_number;
#if MAPLINES_SENDER
    set_inputs();
#endif
    failures = 0;
    return only == 0 || only == row_number;
}

/// The assertions must have counted the mistake, or must not count what has a refusal of its own.
static void ends(const char *function, const char *mistake, bool is_asserted, const char *outcome)
{
#ifdef MAPLINES_ASSERT
    const bool is_right = is_asserted ? failures > 0 : failures == 0;
#else
    const bool is_right = true;
#endif
    (void)printf("%s | %s | %s | %s%s\n", function, mistake, outcome,
                 is_asserted ? "asserted" : "refused", is_right ? "" : " wrong");
    (void)fflush(stdout);
}

/// A row: what `call` gives after the mistake.
#define ROW(function, mistake, is_asserted, call)                                                  \
    if (begins())                                                                                  \
    {                                                                                              \
        ends(#function, mistake, is_asserted, call);                                               \
    }
/// The same for a function that returns nothing.
#define VOID_ROW(function, mistake, call)                                                          \
    if (begins())                                                                                  \
    {                                                                                              \
        call;                                                                                      \
        ends(#function, mistake, true, nothing());                                                 \
    }
/// The same after a statement.
#define ROW_AFTER(function, mistake, is_asserted, statement, call)                                 \
    if (begins())                                                                                  \
    {                                                                                              \
        statement;                                                                                 \
        ends(#function, mistake, is_asserted, call);                                               \
    }

#if MAPLINES_RECEIVER
/* ---- a good receiver --------------------------------------------------------------------------
 */

static const maplines_decoder_t zeroed;
static maplines_decoder_t decoder;
static maplines_settings_t settings;
static maplines_frame_t frame;
static maplines_view_t view;
static maplines_line_t line;
static maplines_statistics_t numbers;
static const maplines_real_t nan_value = (maplines_real_t)NAN;
static const maplines_real_t infinity = (maplines_real_t)INFINITY;
/// A distance whose inverse overflows [m].
static const maplines_real_t too_small = (maplines_real_t)(MAPLINES_FLOAT ? 1e-40 : 1e-320);

#if MAPLINES_SENDER
/// Frames of the line of a cycle; their number.
static int next_line(int cycle, bool is_fd)
{
    if (cycle == 0)
    {
        maplines_encoder_init(&encoder, &lines_dbc, NULL);
    }
    return maplines_encode_line(&encoder, &input, is_fd, 0, frames).count;
}

#if MAPLINES_SCENES
/// Frames of the scene of a cycle; their number.
static int next_scene(const maplines_dbc_t *dbc, int cycle)
{
    if (cycle == 0)
    {
        maplines_encoder_init(&scene_encoder, dbc, NULL);
    }
    return encode_scene().count;
}
#endif
#else
#include "sent_frames.h"

static int next_line(int cycle, bool is_fd)
{
    const int count = is_fd ? 1 : LINE_FRAMES;
    memcpy(frames, is_fd ? sent_fds[0] : sent_lines[cycle], (size_t)count * sizeof frames[0]);
    return count;
}

#if MAPLINES_SCENES
static int next_scene(const maplines_dbc_t *dbc, int cycle)
{
    (void)dbc;
    memcpy(frames, sent_scenes[cycle], sizeof sent_scenes[cycle]);
    return SCENE_FRAMES;
}
#endif
#endif

static void feed_all(maplines_decoder_t *of, int count, int64_t t_ns)
{
    for (int i = 0; i < count; ++i)
    {
        (void)maplines_feed(of, &frames[i], t_ns);
    }
}

/// Feed lines each so many units of time, which the caller takes for nanoseconds.
static void feed_lines(int64_t begin, int64_t spacing)
{
    (void)maplines_decoder_init(&decoder, &lines_dbc, &settings);
    for (int k = 0; k < ROUNDS; ++k)
    {
        feed_all(&decoder, next_line(k, false), begin + spacing * k);
    }
    maplines_latest(&decoder, left, begin + spacing * (ROUNDS - 1), &view);
    maplines_statistics(&decoder, &numbers);
}

#if MAPLINES_SCENES
static maplines_decoder_t scenes;
static maplines_scene_view_t scene_view;
static maplines_scene_t scene;
static maplines_term_t terms[2];

/// A scene that is sent in some cycles and received, by the tables of a DBC.
static void feed_scenes(const maplines_dbc_t *dbc)
{
    (void)maplines_decoder_init(&scenes, dbc, NULL);
    for (int k = 0; k < ROUNDS; ++k)
    {
        feed_all(&scenes, next_scene(dbc, k), CYCLE_NS * k);
    }
    maplines_latest(&scenes, left, CYCLE_NS * (ROUNDS - 1), &view);
    maplines_latest_scene(&scenes, CYCLE_NS * (ROUNDS - 1), &scene_view);
}
#endif

static void require(bool is_good)
{
    if (!is_good)
    {
        (void)printf("the good calls fail\n");
        exit(2);
    }
}

static void begin(void)
{
    maplines_default_settings(&lines_dbc, &settings);
    feed_lines(0, CYCLE_NS);
    require(view.is_usable);
    line = *view.line;
    (void)next_line(0, false);
    frame = frames[0];
#if MAPLINES_SCENES
    feed_scenes(&pose_dbc);
    require(scene_view.scene != NULL && scene_view.is_usable && view.is_usable);
    scene = *scene_view.scene;
    terms[0] = (maplines_term_t){both[0], 10, 1};
    terms[1] = (maplines_term_t){both[1], 10, -1};
#endif
}

static const char *number(double value, bool is_promised)
{
    (void)snprintf(text, sizeof text, "%g%s", value, is_promised ? "" : " wrong");
    return text;
}

static const char *nan_of(maplines_real_t value)
{
    return number((double)value, value != value);
}

static const char *unknown(maplines_estimate_t of)
{
    (void)snprintf(text, sizeof text, "%g, sigma %g%s", (double)of.value, (double)of.sigma,
                   of.value != of.value && !(of.sigma < infinity) ? "" : " wrong");
    return text;
}

static const char *refused(bool result)
{
    return said(result ? "true" : "false", !result);
}

static const char *problem(const char *what)
{
    return what != NULL ? said(what, true) : said("no problem", false);
}

static const char *fed_is(maplines_fed_t fed, maplines_reason_t reason)
{
    return said(maplines_reason_name(fed.reason), fed.reason == reason && fed.count == 0);
}

static const char *no_line(const maplines_line_t *found)
{
    return said(found == NULL ? "NULL" : "a line", found == NULL);
}

static const char *not_usable(bool has, bool is_usable)
{
    return said(has || is_usable ? "a line" : "no line, not usable", !has && !is_usable);
}

static const char *prediction_is(maplines_prediction_t result, maplines_prediction_t expected)
{
    return said(maplines_prediction_name(result), result == expected);
}

/* ---- rows of a receiver ------------------------------------------------------------------------
 */

static maplines_frame_t *with_length(uint8_t length)
{
    static maplines_frame_t long_frame;
    long_frame = frame;
    long_frame.length = length;
    return &long_frame;
}

/// A CAN FD frame with a line, of which the first bytes are sent.
static maplines_frame_t *with_fd(uint8_t length)
{
    static maplines_frame_t of_fd;
    (void)next_line(0, true);
    of_fd = frames[0];
    of_fd.length = length;
    return &of_fd;
}

static maplines_frame_t *with_id(uint32_t can_id)
{
    static maplines_frame_t other;
    other = frame;
    other.can_id = can_id;
    return &other;
}

static maplines_decoder_t *copy_of_zeroed(void)
{
    static maplines_decoder_t of;
    of = zeroed;
    return &of;
}

static void receiver_rows(void)
{
    maplines_line_copy_t copy;
    maplines_gaussian_t gaussian;
    maplines_real_t weight;
    maplines_slot_stats_t stats;
    ROW(decoder_init, "decoder NULL", true, problem(maplines_decoder_init(NULL, &lines_dbc, NULL)))
    ROW(decoder_init, "dbc NULL", true,
        problem(maplines_decoder_init(copy_of_zeroed(), NULL, NULL)))
    ROW_AFTER(decoder_init, "stale_cycles NaN", false, settings.stale_cycles = NAN,
              problem(maplines_decoder_init(copy_of_zeroed(), &lines_dbc, &settings)))
    maplines_default_settings(&lines_dbc, &settings);
    ROW_AFTER(decoder_init, "cycle_ns negative", false, settings.cycle_ns[0] = -1,
              problem(maplines_decoder_init(copy_of_zeroed(), &lines_dbc, &settings)))
    maplines_default_settings(&lines_dbc, &settings);
    ROW(feed, "decoder NULL", true, fed_is(maplines_feed(NULL, &frame, 0), MAPLINES_FOREIGN))
    ROW(feed, "decoder zeroed", true,
        fed_is(maplines_feed(copy_of_zeroed(), &frame, 0), MAPLINES_FOREIGN))
    ROW(feed, "frame NULL", true, fed_is(maplines_feed(&decoder, NULL, 0), MAPLINES_FOREIGN))
    ROW(feed, "frame of 65 bytes", true,
        fed_is(maplines_feed(&decoder, with_length(65), 0), MAPLINES_LENGTH))
    ROW(feed, "CAN FD frame of 65 bytes", true,
        fed_is(maplines_feed(&decoder, with_fd(65), 0), MAPLINES_LENGTH))
    ROW(feed, "frame of 255 bytes", true,
        fed_is(maplines_feed(&decoder, with_length(255), 0), MAPLINES_LENGTH))
    ROW(feed, "CAN ID with the flag of SocketCAN", true,
        fed_is(maplines_feed(&decoder, with_id(0x80000340U), 0), MAPLINES_FOREIGN))
    ROW(latest, "decoder NULL", true,
        (maplines_latest(NULL, MAPLINES_EGO_LEFT, 0, &view),
         not_usable(view.line != NULL, view.is_usable)))
    ROW(latest, "decoder zeroed", true,
        (maplines_latest(copy_of_zeroed(), MAPLINES_EGO_LEFT, 0, &view),
         not_usable(view.line != NULL, view.is_usable)))
    ROW(latest, "slot 99", true,
        (maplines_latest(&decoder, BAD_SLOT, 0, &view),
         not_usable(view.line != NULL, view.is_usable)))
    VOID_ROW(latest, "view NULL", maplines_latest(&decoder, MAPLINES_EGO_LEFT, 0, NULL))
    ROW(copy_line, "decoder NULL", true,
        (maplines_copy_line(NULL, MAPLINES_EGO_LEFT, 0, &copy),
         not_usable(copy.has_line, copy.is_usable)))
    ROW(copy_line, "decoder zeroed", true,
        (maplines_copy_line(copy_of_zeroed(), MAPLINES_EGO_LEFT, 0, &copy),
         not_usable(copy.has_line, copy.is_usable)))
    ROW(copy_line, "slot 99", true,
        (maplines_copy_line(&decoder, BAD_SLOT, 0, &copy),
         not_usable(copy.has_line, copy.is_usable)))
    VOID_ROW(copy_line, "copy NULL", maplines_copy_line(&decoder, MAPLINES_EGO_LEFT, 0, NULL))
    ROW(newest, "decoder NULL", true, no_line(maplines_newest(NULL, MAPLINES_EGO_LEFT)))
    ROW(newest, "decoder zeroed", true, no_line(maplines_newest(&zeroed, MAPLINES_EGO_LEFT)))
    ROW(newest, "slot 99", true, no_line(maplines_newest(&decoder, BAD_SLOT)))
    ROW(component, "decoder NULL", true,
        refused(maplines_component(NULL, MAPLINES_EGO_LEFT, 0, &gaussian, &weight)))
    ROW(component, "decoder zeroed", true,
        refused(maplines_component(&zeroed, MAPLINES_EGO_LEFT, 0, &gaussian, &weight)))
    ROW(component, "gaussian NULL", true,
        refused(maplines_component(&decoder, MAPLINES_EGO_LEFT, 0, NULL, &weight)))
    ROW(component, "weight NULL", true,
        refused(maplines_component(&decoder, MAPLINES_EGO_LEFT, 0, &gaussian, NULL)))
    ROW(component, "i beyond the components", false,
        refused(maplines_component(&decoder, MAPLINES_EGO_LEFT, 7, &gaussian, &weight)))
    VOID_ROW(expire, "decoder NULL", maplines_expire(NULL, 0))
    VOID_ROW(expire, "decoder zeroed", maplines_expire(copy_of_zeroed(), 0))
    ROW(slot_stats, "decoder NULL", true,
        refused(maplines_slot_stats(NULL, MAPLINES_EGO_LEFT, 0, &stats)))
    ROW(slot_stats, "decoder zeroed", true,
        refused(maplines_slot_stats(copy_of_zeroed(), MAPLINES_EGO_LEFT, 0, &stats)))
    ROW(slot_stats, "owner 99", true, refused(maplines_slot_stats(&decoder, BAD_SLOT, 0, &stats)))
    ROW(slot_stats, "stats NULL", true,
        refused(maplines_slot_stats(&decoder, MAPLINES_EGO_LEFT, 0, NULL)))
    ROW(statistics, "decoder NULL", true,
        (maplines_statistics(NULL, &numbers), number((double)numbers.frames, numbers.frames == 0)))
    ROW(statistics, "decoder zeroed", true,
        (maplines_statistics(&zeroed, &numbers),
         number((double)numbers.frames, numbers.frames == 0)))
    VOID_ROW(statistics, "statistics NULL", maplines_statistics(&decoder, NULL))
    VOID_ROW(default_settings, "dbc NULL", maplines_default_settings(NULL, &settings))
    VOID_ROW(default_settings, "settings NULL", maplines_default_settings(&lines_dbc, NULL))
    ROW(settings_for, "dbc NULL", true, problem(maplines_settings_for(NULL, 0, 0, NULL, &settings)))
    ROW(settings_for, "settings NULL", true,
        problem(maplines_settings_for(&lines_dbc, 0, 0, NULL, NULL)))
    ROW(settings_for, "timeout_ms NaN", false,
        problem(maplines_settings_for(&lines_dbc, NAN, 0, NULL, &settings)))
    ROW(settings_for, "cycle_ms infinite", false,
        problem(maplines_settings_for(&lines_dbc, 0, INFINITY, NULL, &settings)))
    ROW(settings_for, "cycle_ms negative", false,
        problem(maplines_settings_for(&lines_dbc, 0, -50, NULL, &settings)))
    VOID_ROW(decoder_init_default, "decoder NULL", maplines_decoder_init_default(NULL, &lines_dbc))
    VOID_ROW(decoder_init_default, "dbc NULL",
             maplines_decoder_init_default(copy_of_zeroed(), NULL))
}

/// Lines that nobody receives: of no numbers, or of a range that ends before it starts.
static maplines_line_t wrong_mean, wrong_factor, wrong_range, barely_wrong_range, no_range;

static void make_wrong_lines(void)
{
    wrong_mean = line;
    wrong_mean.gaussian.mean[0] = nan_value;
    wrong_factor = line;
    wrong_factor.gaussian.factor[0][0] = nan_value;
    wrong_range = line;
    wrong_range.x_min = 80;
    wrong_range.x_max = 0;
    barely_wrong_range = line;
    barely_wrong_range.x_min = 40 + (maplines_real_t)0.0005;
    barely_wrong_range.x_max = 40;
    no_range = line;
    no_range.x_min = nan_value;
}

static void line_rows(void)
{
    maplines_real_t covariance[4][4];
    maplines_position_t positions[MAPLINES_MAX_POSITIONS + 1];
    for (int i = 0; i < MAPLINES_MAX_POSITIONS + 1; ++i)
    {
        positions[i] = (maplines_position_t){10, 0, 1};
    }
    make_wrong_lines();
    ROW(y, "line NULL", true, nan_of(maplines_y(NULL, 10)))
    ROW(y, "x NaN", false, nan_of(maplines_y(&line, nan_value)))
    ROW(y, "x infinite", false, nan_of(maplines_y(&line, infinity)))
    ROW(y, "x beyond the range", false, nan_of(maplines_y(&line, 1000)))
    ROW(y, "mean NaN", false, nan_of(maplines_y(&wrong_mean, 10)))
    ROW(y, "x_min beyond x_max", false, nan_of(maplines_y(&wrong_range, 40)))
    ROW(is_valid_at, "x_min beyond x_max by less than 1 mm", false,
        refused(maplines_is_valid_at(&barely_wrong_range, 40)))
    ROW(is_valid_at, "line NULL", true, refused(maplines_is_valid_at(NULL, 10)))
    ROW(is_valid_at, "x NaN", false, refused(maplines_is_valid_at(&line, nan_value)))
    ROW(y_extrapolated, "line NULL", true, unknown(maplines_y_extrapolated(NULL, 10)))
    ROW(y_extrapolated, "x NaN", false, unknown(maplines_y_extrapolated(&line, nan_value)))
    ROW(y_extrapolated, "x infinite", false, unknown(maplines_y_extrapolated(&line, infinity)))
    ROW(y_extrapolated, "mean NaN", false, unknown(maplines_y_extrapolated(&wrong_mean, 10)))
    ROW(y_extrapolated, "mean NaN, beyond the range", false,
        unknown(maplines_y_extrapolated(&wrong_mean, 90)))
    ROW(y_extrapolated, "x_min beyond x_max", false,
        unknown(maplines_y_extrapolated(&wrong_range, 40)))
    ROW(y_extrapolated, "x_min NaN", false, unknown(maplines_y_extrapolated(&no_range, 90)))
    ROW(y_sigma, "mean NaN", false, nan_of(maplines_y_sigma(&wrong_mean, 10)))
    ROW(y_sigma, "factor NaN", false,
        number((double)maplines_y_sigma(&wrong_factor, 10),
               !(maplines_y_sigma(&wrong_factor, 10) < infinity)))
    ROW(y_sigma, "line NULL", true, nan_of(maplines_y_sigma(NULL, 10)))
    ROW(y_sigma, "x NaN", false, nan_of(maplines_y_sigma(&line, nan_value)))
    ROW(y_sigma, "x infinite", false, nan_of(maplines_y_sigma(&line, infinity)))
    ROW(slope, "line NULL", true, unknown(maplines_slope(NULL, 20, 10)))
    ROW(slope, "x NaN", false, unknown(maplines_slope(&line, nan_value, 10)))
    ROW(slope, "mean NaN", false, unknown(maplines_slope(&wrong_mean, 20, 10)))
    ROW(slope, "distance too small to divide by", false,
        unknown(maplines_slope(&line, 20, too_small)))
    ROW(slope, "distance 0", true, unknown(maplines_slope(&line, 20, 0)))
    ROW(slope, "distance negative", true, unknown(maplines_slope(&line, 20, -10)))
    ROW(slope, "distance NaN", true, unknown(maplines_slope(&line, 20, nan_value)))
    ROW(curvature, "line NULL", true, unknown(maplines_curvature(NULL, 20, 10)))
    ROW(curvature, "x NaN", false, unknown(maplines_curvature(&line, nan_value, 10)))
    ROW(curvature, "mean NaN", false, unknown(maplines_curvature(&wrong_mean, 20, 10)))
    ROW(curvature, "distance too small to divide by", false,
        unknown(maplines_curvature(&line, 20, too_small)))
    ROW(curvature, "distance 0", true, unknown(maplines_curvature(&line, 20, 0)))
    ROW(curvature, "distance negative", true, unknown(maplines_curvature(&line, 20, -10)))
    ROW(curvature, "distance NaN", true, unknown(maplines_curvature(&line, 20, nan_value)))
    ROW(covariance, "gaussian NULL", true,
        (maplines_covariance(NULL, covariance), nan_of(covariance[0][0])))
    VOID_ROW(covariance, "covariance NULL", maplines_covariance(&line.gaussian, NULL))
    ROW(mahalanobis, "line NULL", true, nan_of(maplines_mahalanobis(NULL, 1, positions)))
    ROW(mahalanobis, "positions NULL", true, nan_of(maplines_mahalanobis(&line, 1, NULL)))
    ROW(mahalanobis, "9 positions", true,
        number((double)maplines_mahalanobis(&line, MAPLINES_MAX_POSITIONS + 1, positions),
               !(maplines_mahalanobis(&line, MAPLINES_MAX_POSITIONS + 1, positions) < infinity)))
    ROW(mahalanobis, "mean NaN", false,
        number((double)maplines_mahalanobis(&wrong_mean, 1, positions),
               !(maplines_mahalanobis(&wrong_mean, 1, positions) < infinity)))
    ROW_AFTER(mahalanobis, "sigma 0", false, positions[0].sigma = 0,
              number((double)maplines_mahalanobis(&line, 1, positions),
                     !(maplines_mahalanobis(&line, 1, positions) < infinity)))
    ROW_AFTER(mahalanobis, "y NaN", false, (positions[0].sigma = 1, positions[0].y = nan_value),
              number((double)maplines_mahalanobis(&line, 1, positions),
                     !(maplines_mahalanobis(&line, 1, positions) < infinity)))
    positions[0].y = 0;
}

#if MAPLINES_SCENES
static void scene_rows(void)
{
    maplines_scene_copy_t scene_copy;
    maplines_estimate_t estimate;
    maplines_real_t low, high;
    maplines_real_t joint[64];
    const maplines_line_t good = scene.lines[0];
    ROW(latest_scene, "decoder NULL", true,
        (maplines_latest_scene(NULL, 0, &scene_view),
         not_usable(scene_view.scene != NULL, scene_view.is_usable)))
    ROW(latest_scene, "decoder zeroed", true,
        (maplines_latest_scene(copy_of_zeroed(), 0, &scene_view),
         not_usable(scene_view.scene != NULL, scene_view.is_usable)))
    VOID_ROW(latest_scene, "view NULL", maplines_latest_scene(&scenes, 0, NULL))
    ROW(copy_scene, "decoder NULL", true,
        (maplines_copy_scene(NULL, 0, &scene_copy),
         not_usable(scene_copy.has_scene, scene_copy.is_usable)))
    ROW(copy_scene, "decoder zeroed", true,
        (maplines_copy_scene(copy_of_zeroed(), 0, &scene_copy),
         not_usable(scene_copy.has_scene, scene_copy.is_usable)))
    VOID_ROW(copy_scene, "copy NULL", maplines_copy_scene(&scenes, 0, NULL))
    ROW(scene_line, "scene NULL", true, no_line(maplines_scene_line(NULL, MAPLINES_EGO_LEFT)))
    ROW(scene_line, "slot 99", false, no_line(maplines_scene_line(&scene, BAD_SLOT)))
    ROW(sum, "scene NULL", true,
        (maplines_sum(NULL, 2, terms, &estimate) ? said("true", false) : unknown(estimate)))
    ROW(sum, "terms NULL", true,
        (maplines_sum(&scene, 2, NULL, &estimate) ? said("true", false) : unknown(estimate)))
    ROW(sum, "sum NULL", true, refused(maplines_sum(&scene, 2, terms, NULL)))
    ROW_AFTER(sum, "slot 99", false, terms[0].slot = BAD_SLOT,
              (maplines_sum(&scene, 2, terms, &estimate) ? said("true", false) : unknown(estimate)))
    terms[0].slot = MAPLINES_EGO_LEFT;
    ROW_AFTER(sum, "x NaN", false, terms[0].x = nan_value,
              (maplines_sum(&scene, 2, terms, &estimate) ? said("true", false) : unknown(estimate)))
    terms[0].x = 10;
    ROW_AFTER(sum, "weight NaN", true, terms[0].weight = nan_value,
              (maplines_sum(&scene, 2, terms, &estimate) ? said("true", false) : unknown(estimate)))
    terms[0].weight = 1;
    scene.lines[0].gaussian.mean[0] = nan_value;
    ROW(sum, "a mean NaN", false,
        (maplines_sum(&scene, 2, terms, &estimate) ? said("true", false) : unknown(estimate)))
    ROW(width, "a mean NaN", false,
        (maplines_width(&scene, both[0], both[1], 10, &estimate) ? said("true", false)
                                                                 : unknown(estimate)))
    scene.lines[0] = good;
    scene.lines[0].x_min = nan_value;
    ROW(common_range, "an x_min NaN", false,
        refused(maplines_common_range(&scene, 2, both, &low, &high)))
    scene.lines[0] = good;
    ROW(width, "scene NULL", true, refused(maplines_width(NULL, both[0], both[1], 10, &estimate)))
    ROW(width, "width NULL", true, refused(maplines_width(&scene, both[0], both[1], 10, NULL)))
    ROW(width, "x NaN", false,
        refused(maplines_width(&scene, both[0], both[1], nan_value, &estimate)))
    ROW(centre, "scene NULL", true, refused(maplines_centre(NULL, both[0], both[1], 10, &estimate)))
    ROW(centre, "centre NULL", true, refused(maplines_centre(&scene, both[0], both[1], 10, NULL)))
    ROW(centre, "x NaN", false,
        refused(maplines_centre(&scene, both[0], both[1], nan_value, &estimate)))
    ROW(common_range, "scene NULL", true,
        refused(maplines_common_range(NULL, 2, both, &low, &high)))
    ROW(common_range, "slots NULL", true,
        refused(maplines_common_range(&scene, 2, NULL, &low, &high)))
    ROW(common_range, "x_min NULL", true,
        refused(maplines_common_range(&scene, 2, both, NULL, &high)))
    ROW(common_range, "x_max NULL", true,
        refused(maplines_common_range(&scene, 2, both, &low, NULL)))
    ROW(joint_covariance, "scene NULL", true,
        refused(maplines_joint_covariance(NULL, 2, both, joint)))
    ROW(joint_covariance, "slots NULL", true,
        refused(maplines_joint_covariance(&scene, 2, NULL, joint)))
    ROW(joint_covariance, "covariance NULL", true,
        refused(maplines_joint_covariance(&scene, 2, both, NULL)))
}
#endif

static void prediction_rows(void)
{
    const maplines_motion_t motion = {.speed = 20};
    const maplines_real_t weights[2] = {1, 0};
    maplines_motion_t bad_motion = motion;
    maplines_displacement_t displacement, bad;
    maplines_gaussian_t gaussian;
    maplines_line_t predicted;
    require(maplines_displacement(&motion, (maplines_real_t)0.1, 0, &displacement));
    bad = displacement;
    bad.mean[0] = nan_value;
    bad_motion.yaw_rate = nan_value;
    ROW(displacement, "motion NULL", true, refused(maplines_displacement(NULL, 1, 0, &bad)))
    ROW(displacement, "displacement NULL", true,
        refused(maplines_displacement(&motion, 1, 0, NULL)))
    ROW(displacement, "dt NaN", false, refused(maplines_displacement(&motion, nan_value, 0, &bad)))
    ROW(displacement, "dt infinite", false,
        refused(maplines_displacement(&motion, infinity, 0, &bad)))
    ROW(displacement, "time_sigma negative", false,
        refused(maplines_displacement(&motion, 1, -1, &bad)))
    ROW(displacement, "yaw rate NaN", false,
        refused(maplines_displacement(&bad_motion, 1, 0, &bad)))
    ROW(predict_gaussian, "gaussian NULL", true,
        prediction_is(maplines_predict_gaussian(NULL, &displacement, 0, 80, &gaussian),
                      MAPLINES_NOT_USABLE))
    ROW(predict_gaussian, "displacement NULL", true,
        prediction_is(maplines_predict_gaussian(&line.gaussian, NULL, 0, 80, &gaussian),
                      MAPLINES_BAD_MOTION))
    ROW(predict_gaussian, "predicted NULL", true,
        prediction_is(maplines_predict_gaussian(&line.gaussian, &displacement, 0, 80, NULL),
                      MAPLINES_NOT_USABLE))
    ROW(predict_gaussian, "x_min NaN", false,
        prediction_is(
            maplines_predict_gaussian(&line.gaussian, &displacement, nan_value, 80, &gaussian),
            MAPLINES_NOT_USABLE))
    ROW(predict_gaussian, "x_min beyond x_max", false,
        prediction_is(maplines_predict_gaussian(&line.gaussian, &displacement, 81, 80, &gaussian),
                      MAPLINES_NOT_USABLE))
    ROW(predict_gaussian, "mean NaN", false,
        prediction_is(
            maplines_predict_gaussian(&wrong_mean.gaussian, &displacement, 0, 80, &gaussian),
            MAPLINES_NOT_USABLE))
    ROW(predict_gaussian, "x_max infinite", false,
        prediction_is(
            maplines_predict_gaussian(&line.gaussian, &displacement, 0, infinity, &gaussian),
            MAPLINES_NOT_USABLE))
    ROW(predict_gaussian, "displacement NaN", false,
        prediction_is(maplines_predict_gaussian(&line.gaussian, &bad, 0, 80, &gaussian),
                      MAPLINES_BAD_MOTION))
    ROW(predict, "line NULL", true,
        prediction_is(maplines_predict(NULL, 0, &displacement, &predicted), MAPLINES_NOT_USABLE))
    ROW(predict, "displacement NULL", true,
        prediction_is(maplines_predict(&line, line.t_ns, NULL, &predicted), MAPLINES_BAD_MOTION))
    ROW(predict, "predicted NULL", true,
        prediction_is(maplines_predict(&line, line.t_ns, &displacement, NULL), MAPLINES_NOT_USABLE))
    ROW(predict, "mean NaN", false,
        prediction_is(maplines_predict(&wrong_mean, line.t_ns, &displacement, &predicted),
                      MAPLINES_NOT_USABLE))
    ROW(predict, "x_min beyond x_max", false,
        prediction_is(maplines_predict(&wrong_range, line.t_ns, &displacement, &predicted),
                      MAPLINES_NOT_USABLE))
    ROW(predict, "displacement NaN", false,
        prediction_is(maplines_predict(&line, line.t_ns, &bad, &predicted), MAPLINES_BAD_MOTION))
    VOID_ROW(overall, "components NULL", maplines_overall(1, NULL, weights, &gaussian))
    VOID_ROW(overall, "weights NULL", maplines_overall(1, &line.gaussian, NULL, &gaussian))
    VOID_ROW(overall, "overall NULL", maplines_overall(1, &line.gaussian, weights, NULL))
    ROW(overall, "weight 0", true,
        (maplines_overall(1, &line.gaussian, &weights[1], &gaussian),
         nan_of(gaussian.factor[0][0])))
    ROW(overall, "weight NaN", true,
        (maplines_overall(1, &line.gaussian, &nan_value, &gaussian), nan_of(gaussian.factor[0][0])))
    ROW(overall, "weight infinite", true,
        (maplines_overall(1, &line.gaussian, &infinity, &gaussian), nan_of(gaussian.factor[0][0])))
    ROW(overall, "no component", true,
        (maplines_overall(0, &line.gaussian, weights, &gaussian), nan_of(gaussian.mean[0])))
    ROW(predict_to, "line NULL", true,
        prediction_is(maplines_predict_to(NULL, 0, &motion, 0, &predicted), MAPLINES_NOT_USABLE))
    ROW(predict_to, "motion NULL", true,
        prediction_is(maplines_predict_to(&line, line.t_ns, NULL, 0, &predicted),
                      MAPLINES_BAD_MOTION))
    ROW(predict_to, "predicted NULL", true,
        prediction_is(maplines_predict_to(&line, line.t_ns, &motion, 0, NULL), MAPLINES_NOT_USABLE))
    ROW(predict_to, "factor NaN", false,
        prediction_is(maplines_predict_to(&wrong_factor, line.t_ns, &motion, 0, &predicted),
                      MAPLINES_NOT_USABLE))
    ROW(predict_to, "time_sigma NaN", false,
        prediction_is(maplines_predict_to(&line, line.t_ns, &motion, nan_value, &predicted),
                      MAPLINES_BAD_MOTION))
    ROW(predict_to, "time in us", false,
        prediction_is(maplines_predict_to(&line, line.t_ns + 20000000000, &motion, 0, &predicted),
                      MAPLINES_TOO_FAR))
}

/// What became of 20 lines at so many units of time from each other.
static const char *lines_each(int64_t spacing, bool refuses, unsigned expected, bool is_usable)
{
    settings.refuses_short_spacings = refuses;
    feed_lines(INT64_C(1000000000000), spacing);
    settings.refuses_short_spacings = false;
    const bool is_promised =
        numbers.lines == expected && view.is_usable == is_usable &&
        (numbers.short_spacings == ROUNDS - 1) == (spacing > 0 && spacing < CYCLE_NS / 100);
    (void)snprintf(text, sizeof text, "%u lines, %u short spacings, %s%s", (unsigned)numbers.lines,
                   (unsigned)numbers.short_spacings, view.is_usable ? "usable" : "not usable",
                   is_promised ? "" : " wrong");
    return text;
}

/// A line that never is stale, a second after the last one: the E2E state says so nevertheless.
static const char *never_stale(void)
{
    settings.stale_cycles = (double)INFINITY;
    feed_lines(0, CYCLE_NS);
    const bool was_usable = view.is_usable;
    maplines_latest(&decoder, MAPLINES_EGO_LEFT, CYCLE_NS * (ROUNDS + 20), &view);
    settings.stale_cycles = 3;
    return said(view.is_usable ? "usable" : maplines_e2e_state_name(view.state),
                was_usable && !view.is_stale && view.state == MAPLINES_E2E_INVALID &&
                    !view.is_usable);
}

static void time_rows(void)
{
    ROW(feed, "times in ns, refused if short", false, lines_each(CYCLE_NS, true, ROUNDS, true))
    ROW(feed, "times in us", false, lines_each(CYCLE_NS / 1000, false, ROUNDS, true))
    ROW(feed, "times in us, refused", false, lines_each(CYCLE_NS / 1000, true, 8, false))
    ROW(feed, "times in ms", false, lines_each(CYCLE_NS / 1000000, false, ROUNDS, true))
    ROW(feed, "times in ms, refused", false, lines_each(CYCLE_NS / 1000000, true, 8, false))
    ROW(feed, "no times, refused if short", false, lines_each(0, true, ROUNDS, true))
    ROW(latest, "stale_cycles infinite, and a second without a line", false, never_stale())
}
#endif // MAPLINES_RECEIVER

#if MAPLINES_SENDER
/* ---- rows of a sender --------------------------------------------------------------------------
 */

static const char *sent_is(maplines_sent_t sent, maplines_refusal_t refusal)
{
    return said(maplines_refusal_name(sent.refusal), sent.refusal == refusal && sent.count == 0);
}

static maplines_encoder_t *encoder_of_zeroed(void)
{
    static maplines_encoder_t of;
    memset(&of, 0, sizeof of);
    return &of;
}

static maplines_sent_t encode(void)
{
    return maplines_encode_line(&encoder, &input, false, 0, frames);
}

#if MAPLINES_RECEIVER
/// Age of a line that is sent and received [s]: unknown.
static const char *unknown_age(void)
{
    feed_lines(0, CYCLE_NS);
    return number((double)view.age, isinf((double)view.age) != 0 && !view.is_usable);
}
#endif

static void sender_rows(void)
{
    static maplines_signer_t signer; // without a function
    VOID_ROW(encoder_init, "encoder NULL", maplines_encoder_init(NULL, &lines_dbc, NULL))
    ROW(encoder_init, "dbc NULL", true,
        (maplines_encoder_init(&encoder, NULL, NULL), sent_is(encode(), MAPLINES_BAD_CALL)))
    ROW(encoder_init, "signer without a function", true,
        (maplines_encoder_init(&encoder, &lines_dbc, &signer),
         sent_is(encode(), MAPLINES_BAD_CALL)))
    maplines_encoder_init(&encoder, &lines_dbc, NULL);
    ROW(encode_line, "encoder NULL", true,
        sent_is(maplines_encode_line(NULL, &input, false, 0, frames), MAPLINES_BAD_CALL))
    ROW(encode_line, "encoder zeroed", true,
        sent_is(maplines_encode_line(encoder_of_zeroed(), &input, false, 0, frames),
                MAPLINES_BAD_CALL))
    ROW(encode_line, "line NULL", true,
        sent_is(maplines_encode_line(&encoder, NULL, false, 0, frames), MAPLINES_BAD_CALL))
    ROW(encode_line, "frames NULL", true,
        sent_is(maplines_encode_line(&encoder, &input, false, 0, NULL), MAPLINES_BAD_CALL))
#if MAPLINES_RECEIVER
    ROW_AFTER(encode_line, "line {0}: age of what is received", false,
              memset(&input, 0, sizeof input), unknown_age())
#endif
    ROW_AFTER(encode_line, "age -1", false, input.age = -1, sent_is(encode(), MAPLINES_BAD_AGE))
    ROW_AFTER(encode_line, "age NaN", false, input.age = NAN, sent_is(encode(), MAPLINES_BAD_AGE))
    ROW_AFTER(encode_line, "mean NaN", false, input.mean[0] = NAN,
              sent_is(encode(), MAPLINES_BAD_MEAN))
    ROW_AFTER(encode_line, "mean infinite", false, input.mean[3] = INFINITY,
              sent_is(encode(), MAPLINES_BAD_MEAN))
    ROW_AFTER(encode_line, "covariance NaN", false, input.cov[1][1] = NAN,
              sent_is(encode(), MAPLINES_BAD_COVARIANCE))
    ROW_AFTER(encode_line, "variance negative", false, input.cov[1][1] = -1,
              sent_is(encode(), MAPLINES_BAD_VARIANCE))
    ROW_AFTER(encode_line, "x_max NaN", false, input.x_max = NAN,
              sent_is(encode(), MAPLINES_BAD_RANGE))
    ROW_AFTER(encode_line, "x_min beyond x_max", false, input.x_min = 81,
              sent_is(encode(), MAPLINES_BAD_RANGE))
    ROW_AFTER(encode_line, "slot 99", false, input.slot = BAD_SLOT,
              sent_is(encode(), MAPLINES_NO_MESSAGE))
    ROW_AFTER(encode_line, "kind 99", false, input.kind = (maplines_kind_t)99,
              sent_is(encode(), MAPLINES_BAD_KIND))
    ROW_AFTER(encode_line, "status 99", false, input.status = (maplines_status_t)99,
              sent_is(encode(), MAPLINES_BAD_STATUS))
}

#if MAPLINES_MIXTURES
static maplines_sent_t encode_two(void)
{
    return maplines_encode_mixture(&encoder, &input, components, 2, false, 0, frames);
}

static void mixture_rows(void)
{
    ROW(encode_mixture, "encoder NULL", true,
        sent_is(maplines_encode_mixture(NULL, &input, components, 2, false, 0, frames),
                MAPLINES_BAD_CALL))
    ROW(encode_mixture, "encoder zeroed", true,
        sent_is(
            maplines_encode_mixture(encoder_of_zeroed(), &input, components, 2, false, 0, frames),
            MAPLINES_BAD_CALL))
    ROW(encode_mixture, "line NULL", true,
        sent_is(maplines_encode_mixture(&encoder, NULL, components, 2, false, 0, frames),
                MAPLINES_BAD_CALL))
    ROW(encode_mixture, "components NULL", true,
        sent_is(maplines_encode_mixture(&encoder, &input, NULL, 2, false, 0, frames),
                MAPLINES_BAD_CALL))
    ROW(encode_mixture, "frames NULL", true,
        sent_is(maplines_encode_mixture(&encoder, &input, components, 2, false, 0, NULL),
                MAPLINES_BAD_CALL))
    ROW(encode_mixture, "no component", false,
        sent_is(maplines_encode_mixture(&encoder, &input, components, 0, false, 0, frames),
                MAPLINES_BAD_COUNT))
    ROW(encode_mixture, "9 components", false,
        sent_is(maplines_encode_mixture(&encoder, &input, components, 9, false, 0, frames),
                MAPLINES_BAD_COUNT))
    ROW_AFTER(encode_mixture, "weight NaN", false, components[0].weight = NAN,
              sent_is(encode_two(), MAPLINES_BAD_WEIGHTS))
    ROW_AFTER(encode_mixture, "weight negative", false, components[0].weight = -0.5,
              sent_is(encode_two(), MAPLINES_BAD_WEIGHTS))
    ROW_AFTER(encode_mixture, "mean NaN", false, components[1].mean[2] = NAN,
              sent_is(encode_two(), MAPLINES_BAD_MEAN))
}
#endif

#if MAPLINES_SCENES
static const char *scene_is(maplines_sent_scene_t sent, maplines_refusal_t refusal)
{
    return said(maplines_refusal_name(sent.refusal), sent.refusal == refusal && sent.count == 0);
}

#if MAPLINES_RECEIVER
/// Ages of a scene, of which some are not set, and of a line of it [s], as they are received. What
/// has no age is not used; of lines that are conditional on the pose error, all of them.
static const char *scene_ages(const maplines_dbc_t *dbc, bool has_pose_age, bool has_age)
{
    scene_input.has_pose_age = has_pose_age;
    scene_input.lines[0].has_age = has_age;
    scene_input.pose_age = has_pose_age ? 0.02 : (double)NAN; // not read
    scene_input.lines[0].age = has_age ? 0.02 : (double)NAN;
    feed_scenes(dbc);
    const bool is_line_known = dbc->is_conditional ? has_pose_age : has_age;
    const bool is_promised =
        scene_view.scene != NULL && view.line != NULL && scene_view.is_usable == has_pose_age &&
        (isinf(scene_view.age) != 0) != has_pose_age && view.is_usable == is_line_known &&
        (isinf(view.age) != 0) != is_line_known;
    (void)snprintf(text, sizeof text, "scene %g, line %g%s", (double)scene_view.age,
                   (double)view.age, is_promised ? "" : " wrong");
    return text;
}
#endif

static void sent_scene_rows(void)
{
    maplines_encoder_init(&scene_encoder, &pose_dbc, NULL);
    ROW(encode_scene, "encoder NULL", true,
        scene_is(maplines_encode_scene(NULL, &scene_input, false, 0, &workspace, frames),
                 MAPLINES_BAD_CALL))
    ROW(encode_scene, "encoder zeroed", true,
        scene_is(
            maplines_encode_scene(encoder_of_zeroed(), &scene_input, false, 0, &workspace, frames),
            MAPLINES_BAD_CALL))
    ROW(encode_scene, "scene NULL", true,
        scene_is(maplines_encode_scene(&scene_encoder, NULL, false, 0, &workspace, frames),
                 MAPLINES_BAD_CALL))
    ROW(encode_scene, "workspace NULL", true,
        scene_is(maplines_encode_scene(&scene_encoder, &scene_input, false, 0, NULL, frames),
                 MAPLINES_BAD_CALL))
    ROW(encode_scene, "frames NULL", true,
        scene_is(maplines_encode_scene(&scene_encoder, &scene_input, false, 0, &workspace, NULL),
                 MAPLINES_BAD_CALL))
    ROW_AFTER(encode_scene, "scene {0}", false, memset(&scene_input, 0, sizeof scene_input),
              scene_is(encode_scene(), MAPLINES_BAD_POSE))
    ROW_AFTER(encode_scene, "pose_age -1", false, scene_input.pose_age = -1,
              scene_is(encode_scene(), MAPLINES_BAD_AGE))
    ROW_AFTER(encode_scene, "pose_age NaN", false, scene_input.pose_age = NAN,
              scene_is(encode_scene(), MAPLINES_BAD_AGE))
#if MAPLINES_RECEIVER
    ROW(encode_scene, "pose_age not set", false, scene_ages(&pose_dbc, false, true))
    ROW(encode_scene, "age of a line not set", false, scene_ages(&lines_dbc, true, false))
    ROW(encode_scene, "no age set", false, scene_ages(&lines_dbc, false, false))
    ROW(encode_scene, "all ages set", false, scene_ages(&lines_dbc, true, true))
#endif
    ROW_AFTER(encode_scene, "age of a line -1", false, scene_input.lines[1].age = -1,
              scene_is(encode_scene(), MAPLINES_BAD_AGE))
    ROW_AFTER(encode_scene, "age of a line NaN", false, scene_input.lines[1].age = NAN,
              scene_is(encode_scene(), MAPLINES_BAD_AGE))
    ROW_AFTER(encode_scene, "correlation_time NaN", false, scene_input.correlation_time = NAN,
              scene_is(encode_scene(), MAPLINES_BAD_POSE))
    ROW_AFTER(encode_scene, "offset_sigma negative", false, scene_input.offset_sigma = -1,
              scene_is(encode_scene(), MAPLINES_BAD_POSE))
    ROW_AFTER(encode_scene, "pose_cov NaN", false, scene_input.pose_cov[0][0] = NAN,
              scene_is(encode_scene(), MAPLINES_BAD_COVARIANCE))
    ROW_AFTER(encode_scene, "cov infinite", false, scene_input.cov[0][0] = INFINITY,
              scene_is(encode_scene(), MAPLINES_BAD_COVARIANCE))
    ROW_AFTER(encode_scene, "mean NaN", false, scene_input.lines[0].mean[0] = NAN,
              scene_is(encode_scene(), MAPLINES_BAD_MEAN))
    ROW_AFTER(encode_scene, "9 lines", false, scene_input.count = 9,
              scene_is(encode_scene(), MAPLINES_BAD_COUNT))
    ROW_AFTER(encode_scene, "slot 99", false, scene_input.lines[0].slot = BAD_SLOT,
              scene_is(encode_scene(), MAPLINES_NO_MESSAGE))
}
#endif
#endif // MAPLINES_SENDER

/* ---- names ----------------------------------------------------------------------------------
 */

static const char *name(const char *what)
{
    return said(what, strcmp(what, "?") == 0);
}

static void name_rows(void)
{
    ROW(owner_name, "99", false, name(maplines_owner_name(BAD_SLOT)))
    ROW(kind_name, "99", false, name(maplines_kind_name((maplines_kind_t)99)))
    ROW(status_name, "99", false, name(maplines_status_name((maplines_status_t)99)))
#if MAPLINES_RECEIVER
    ROW(reason_name, "-2", false, name(maplines_reason_name((maplines_reason_t)-2)))
    ROW(e2e_state_name, "99", false, name(maplines_e2e_state_name((maplines_e2e_state_t)99)))
    ROW(e2e_status_name, "99", false, name(maplines_e2e_status_name((maplines_e2e_status_t)99)))
    ROW(prediction_name, "99", false, name(maplines_prediction_name((maplines_prediction_t)99)))
#endif
#if MAPLINES_SENDER
    ROW(refusal_name, "99", false, name(maplines_refusal_name((maplines_refusal_t)99)))
#endif
#if MAPLINES_SCENES
    ROW(left_out_name, "99", false, name(maplines_left_out_name((maplines_left_out_t)99)))
#endif
}

#if MAPLINES_RECEIVER && MAPLINES_SENDER && MAPLINES_SCENES
/* ---- sent_frames.h -----------------------------------------------------------------------------
 */

static void print_frames(int count)
{
    (void)printf("    {\n");
    for (int i = 0; i < count; ++i)
    {
        const maplines_frame_t *sent = &frames[i];
        (void)printf("        {%luU, %d, %d, %d, {", (unsigned long)sent->can_id, sent->is_extended,
                     sent->is_fd, sent->length);
        for (int k = 0; k < sent->length; ++k)
        {
            (void)printf("%s%d", k > 0 ? ", " : "", sent->data[k]);
        }
        (void)printf("}},\n");
    }
    (void)printf("    },\n");
}

static void print_header(void)
{
    const int scene_frames = next_scene(&pose_dbc, 0);
    const int line_frames = next_line(0, false);
    (void)printf("#define LINE_FRAMES %d\n#define SCENE_FRAMES %d\n", line_frames, scene_frames);
    (void)printf("static const maplines_frame_t sent_fds[][1] = {\n");
    (void)next_line(0, true);
    print_frames(1);
    (void)printf("};\nstatic const maplines_frame_t sent_lines[%d][LINE_FRAMES] = {\n", ROUNDS);
    for (int k = 0; k < ROUNDS; ++k)
    {
        print_frames(next_line(k, false));
    }
    (void)printf("};\n#if MAPLINES_SCENES\n");
    (void)printf("static const maplines_frame_t sent_scenes[%d][SCENE_FRAMES] = {\n", ROUNDS);
    for (int k = 0; k < ROUNDS; ++k)
    {
        print_frames(next_scene(&pose_dbc, k));
    }
    (void)printf("};\n#endif\n");
}
#endif

int main(int count, char **arguments)
{
#if MAPLINES_SENDER
    set_inputs();
#endif
#if MAPLINES_RECEIVER && MAPLINES_SENDER && MAPLINES_SCENES
    if (count > 1 && strcmp(arguments[1], "frames") == 0)
    {
        print_header();
        return 0;
    }
#endif
    only = count > 1 ? atoi(arguments[1]) : 0;
#if MAPLINES_RECEIVER
    begin();
    receiver_rows();
    line_rows();
#if MAPLINES_SCENES
    scene_rows();
#endif
    prediction_rows();
    time_rows();
#endif
#if MAPLINES_SENDER
    sender_rows();
#if MAPLINES_MIXTURES
    mixture_rows();
#endif
#if MAPLINES_SCENES
    sent_scene_rows();
#endif
#endif
    name_rows();
    return only > row_number ? 3 : 0;
}
