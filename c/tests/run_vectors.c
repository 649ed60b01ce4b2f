/* Run test vectors through the receiver of maplines.h: which cases fail.
 *
 *     maplines generate c --dbc my.dbc
 *     maplines generate vectors --dbc my.dbc
 *     cc -std=c99 -ffp-contract=off run_vectors.c maplines.c my_dbc.c -lm -o run_vectors
 *     ./run_vectors my.txt             all cases; the exit status is 1 if one fails
 *     ./run_vectors my.txt states      one case
 *
 * For a receiver of your own, replace what calls maplines_*: the rest reads the file. Each line of
 * it is a step, its words are separated by blanks:
 *
 *     case NAME                        a new receiver with its default settings
 *     about TEXT
 *     key ID SECRET WINDOW NOT_BEFORE  of the receiver: AES-128, [us], [us]; else it has none
 *     frame T CAN_ID DATA ANSWER       T [ns]; the ID in hex, x after it: of 29 bits; the answer is
 *                                      a reason, or COMPLETE and the slots of the lines
 *     expire T                         what has timed out is dropped
 *     view T SLOT STATE STATUS AGE IS_STALE TWO_SENDERS IS_USABLE LEFT_OUT
 *     scene T STATE STATUS AGE IS_STALE TWO_SENDERS IS_USABLE SLOTS SLOT=LEFT_OUT ...
 *                                      a line is left out of whole scenes for a reason, or NONE;
 *                                      other DBCs do not have this word
 *     stats T OWNER STATE STATUS OK LOST REPEATED WRONG_SEQUENCE ERRORS NO_NEW_DATA TWO_SENDERS
 *     counts FRAMES LINES PENDING REASON=FRAMES ...
 *     end CASES                        the last row: the number of all cases
 *
 * After a frame or a scene, lines of it:
 *
 *     line SLOT KIND STATUS COMPONENTS T X_MIN X_MAX AGE
 *     mean, cov, y, sigma              the mean; the upper triangle of the covariance by rows; the
 *                                      lateral position and its sigma at 0, 20, 40 and 80 m
 *     joint                            upper triangle of the joint covariance of a scene
 *
 * Numbers are equal if they have the same bits. Lateral positions and their sigmas, and covariances
 * of mixtures and scenes, may differ by what another order of operations explains; in single
 * precision, and with -DTOLERANCE, all of them. In single precision a covariance may be wider.
 */
#include "aes_cmac.h"
#include "harness_dbc.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define DBC harness_dbc
#define COUNT(array) (sizeof(array) / sizeof((array)[0]))
#define MAX_WORDS 1024

/// Greatest relative difference of numbers; of variances, relative to those of the parameters. The
/// core has each bit in double precision. For a receiver of your own, give -DTOLERANCE=1e-9.
#if MAPLINES_FLOAT
#define TOLERANCE 1e-6
#elif !defined(TOLERANCE)
#define TOLERANCE 0.0
#endif
/// The same of what is a sum in any order: lateral positions and their sigmas, and covariances of
/// mixtures and of scenes, which are computed from factors.
#define SUM_TOLERANCE (TOLERANCE > 1e-9 ? TOLERANCE : 1e-9)
/// A covariance in single precision covers that in double precision, and may be wider.
#if MAPLINES_FLOAT
#define MAX_WIDENING 4.0
#else
#define MAX_WIDENING 0.0
#endif

/// The receiver under test, and where its case is.
typedef struct {
    maplines_decoder_t decoder;
    maplines_authenticator_t authenticator;
    uint8_t key[16];
    uint8_t key_id;
    int64_t t_ns; ///< of the last frame
#if MAPLINES_SCENES
    maplines_scene_copy_t scene; ///< of the last step; none if that was a frame
#endif
#if !MAPLINES_LINE_RECORDS
    maplines_line_copy_t newest; ///< of the last word `line`, if it stands behind a frame
#endif
    const maplines_line_t *line; ///< of the last word `line`
    char name[64];
    unsigned long row; ///< of the file
    bool has_failed;
} run_t;

/* ---- words of the file -------------------------------------------------------------------------
 */

/// A line of the file; a word that it lacks is empty.
typedef struct {
    const char *words[MAX_WORDS];
    size_t count;
} row_t;

static const char *word(const row_t *row, size_t i)
{
    return i < row->count ? row->words[i] : "";
}

static int64_t integer(const row_t *row, size_t i)
{
    return (int64_t)strtoll(word(row, i), NULL, 10);
}

/// Floating-point number, such as 0x1.8p+0, inf or nan.
static double number(const row_t *row, size_t i)
{
    return strtod(word(row, i), NULL);
}

static void check(run_t *run, bool is_right, const char *what, const char *expected)
{
    if (!is_right)
    {
        run->has_failed = true;
        (void)printf("%s: row %lu: %s is not %s\n", run->name, run->row, what, expected);
    }
}

static void check_word(run_t *run, const char *got, const row_t *row, size_t i, const char *what)
{
    check(run, strcmp(got, word(row, i)) == 0, what, word(row, i));
}

static void check_count(run_t *run, uint64_t got, const row_t *row, size_t i, const char *what)
{
    check(run, got == (uint64_t)integer(row, i), what, word(row, i));
}

/// A number whose rounding errors are relative to `scale`.
static void check_number(run_t *run, double got, double scale, double tolerance, const row_t *row,
                         size_t i, const char *what)
{
    const double expected = number(row, i);
    const bool is_right = isfinite(expected)
                              ? fabs(got - expected) <= tolerance * (fabs(expected) + scale)
                              : (isnan(expected) != 0) == (isnan(got) != 0) &&
                                    (isinf(expected) != 0) == (isinf(got) != 0);
    check(run, is_right, what, word(row, i));
}

/// A variance, or a covariance, which is none by itself; `scale` is the largest one.
static void check_variance(run_t *run, double got, double scale, bool is_variance, double tolerance,
                           const row_t *row, size_t i, const char *what)
{
    const double more = got - number(row, i);
    const double least = is_variance ? -tolerance * scale : -(tolerance + MAX_WIDENING) * scale;
    const bool is_right = more >= least && more <= (tolerance + MAX_WIDENING) * scale;
    check(run, is_right, what, word(row, i));
}

static int owner_of(const char *name)
{
    int owner = (int)MAPLINES_SCENE2;
    while (owner > 0 && strcmp(maplines_owner_name((maplines_owner_t)owner), name) != 0)
    {
        --owner;
    }
    return owner;
}

/// Bytes in hex; returns their number, at most `size`.
static size_t bytes_of(const char *hex, uint8_t *bytes, size_t size)
{
    size_t count = 0;
    while (count < size && hex[0] != '\0' && hex[1] != '\0')
    {
        const char pair[3] = {hex[0], hex[1], '\0'};
        bytes[count] = (uint8_t)strtoul(pair, NULL, 16);
        ++count;
        hex += 2;
    }
    return count;
}

/* ---- the receiver ------------------------------------------------------------------------------
 */

static bool mac_of(void *context, uint8_t key_id, const uint8_t *data, size_t length,
                   uint8_t mac[16])
{
    const run_t *run = context;
    if (key_id != run->key_id)
    {
        return false;
    }
    aes_cmac(run->key, data, length, mac);
    return true;
}

static int64_t now_of(void *context)
{
    const run_t *run = context;
    return run->t_ns / 1000;
}

static void start(run_t *run)
{
    run->line = NULL;
    const char *problem = maplines_decoder_init(&run->decoder, &DBC, NULL);
    check(run, problem == NULL, "the start", problem == NULL ? "" : problem);
}

static void start_with_key(run_t *run, const row_t *row)
{
    maplines_settings_t settings;
    maplines_default_settings(&DBC, &settings);
    run->key_id = (uint8_t)integer(row, 1);
    (void)bytes_of(word(row, 2), run->key, sizeof(run->key));
    run->authenticator = (maplines_authenticator_t){
        .mac = mac_of,
        .now_us = now_of,
        .context = run,
        .window_us = integer(row, 3),
        .not_before_us = integer(row, 4),
    };
    settings.authenticator = &run->authenticator;
    const char *problem = maplines_decoder_init(&run->decoder, &DBC, &settings);
    check(run, problem == NULL, "the start", problem == NULL ? "" : problem);
}

static void feed(run_t *run, const row_t *row)
{
    char *end = NULL;
    maplines_frame_t frame;
    memset(&frame, 0, sizeof(frame));
    frame.can_id = (uint32_t)strtoul(word(row, 2), &end, 16);
    frame.is_extended = *end == 'x';
    frame.length = (uint8_t)bytes_of(word(row, 3), frame.data, sizeof(frame.data));
#if MAPLINES_SCENES
    run->scene.has_scene = false;
#endif
    run->t_ns = integer(row, 1);
    const maplines_fed_t fed = maplines_feed(&run->decoder, &frame, run->t_ns);
    check_word(run, maplines_reason_name(fed.reason), row, 4, "the answer");
    check(run, row->count == 5U + fed.count, "the number of lines", "as stated");
    for (size_t i = 0; i < fed.count; ++i)
    {
        check_word(run, maplines_owner_name(fed.slots[i]), row, 5 + i, "the slot");
    }
}

#if MAPLINES_SCENE_RECORDS
/// Whether a line is left out for the reason of this name, such as RANGE.
static bool is_left_out(maplines_left_out_t left_out, const char *name)
{
    const char *got = maplines_left_out_name(left_out);
    return left_out == MAPLINES_IN_SCENE ? strcmp(name, "NONE") == 0 : strcmp(got, name) == 0;
}
#endif

static void view(run_t *run, const row_t *row)
{
    maplines_line_copy_t seen;
    const maplines_owner_t slot = (maplines_owner_t)owner_of(word(row, 2));
    maplines_copy_line(&run->decoder, slot, integer(row, 1), &seen);
    check_word(run, maplines_e2e_state_name(seen.state), row, 3, "the state");
    check_word(run, maplines_e2e_status_name(seen.status), row, 4, "the E2E status");
    check_number(run, (double)seen.age, 0, TOLERANCE, row, 5, "the age");
    check_count(run, seen.is_stale, row, 6, "is_stale");
    check_count(run, seen.two_senders, row, 7, "two_senders");
    check_count(run, seen.is_usable, row, 8, "is_usable");
#if MAPLINES_SCENE_RECORDS
    check(run, row->count < 10 || is_left_out(seen.left_out, word(row, 9)), "the reason",
          word(row, 9));
#endif
}

#if MAPLINES_SCENES
static void scene(run_t *run, const row_t *row)
{
    const maplines_scene_copy_t *seen = &run->scene;
    maplines_copy_scene(&run->decoder, integer(row, 1), &run->scene);
    check_word(run, maplines_e2e_state_name(seen->state), row, 2, "the state");
    check_word(run, maplines_e2e_status_name(seen->status), row, 3, "the E2E status");
    check_number(run, (double)seen->age, 0, TOLERANCE, row, 4, "the age");
    check_count(run, seen->is_stale, row, 5, "is_stale");
    check_count(run, seen->two_senders, row, 6, "two_senders");
    check_count(run, seen->is_usable, row, 7, "is_usable");
    size_t count = 8;
    for (size_t i = 0; i < seen->scene.count; ++i)
    {
        check_word(run, maplines_owner_name(seen->scene.lines[i].slot), row, count, "the slot");
        ++count;
    }
#if MAPLINES_SCENE_RECORDS
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        const maplines_left_out_t left_out = seen->scene.left_out[slot];
        const char *name = maplines_owner_name((maplines_owner_t)slot);
        const size_t length = strlen(name);
        if (left_out != MAPLINES_IN_SCENE)
        {
            const char *given = word(row, count);
            check(run,
                  strncmp(given, name, length) == 0 && given[length] == '=' &&
                      is_left_out(left_out, given + length + 1),
                  "a line that is left out", given);
            ++count;
        }
    }
#endif
    check(run, row->count == count, "the number of lines", "as stated");
}

#endif

static void stats(run_t *run, const row_t *row)
{
    maplines_slot_stats_t seen;
    memset(&seen, 0, sizeof(seen));
    const maplines_owner_t owner = (maplines_owner_t)owner_of(word(row, 2));
    const bool is_known = maplines_slot_stats(&run->decoder, owner, integer(row, 1), &seen);
    check(run, is_known, "the owner", "known");
    check_word(run, maplines_e2e_state_name(seen.state), row, 3, "the state");
    check_word(run, maplines_e2e_status_name(seen.status), row, 4, "the E2E status");
    check_count(run, seen.ok, row, 5, "ok");
    check_count(run, seen.lost, row, 6, "lost");
    check_count(run, seen.repeated, row, 7, "repeated");
    check_count(run, seen.wrong_sequence, row, 8, "wrong_sequence");
    check_count(run, seen.errors, row, 9, "errors");
    check_count(run, seen.no_new_data, row, 10, "no_new_data");
    check_count(run, seen.two_senders, row, 11, "two_senders");
}

static void counts(run_t *run, const row_t *row)
{
    maplines_statistics_t seen;
    maplines_statistics(&run->decoder, &seen);
    check_count(run, seen.frames, row, 1, "frames");
    check_count(run, seen.lines, row, 2, "lines");
    check_count(run, seen.pending, row, 3, "pending");
    uint64_t expected[MAPLINES_REASONS] = {0};
    for (size_t i = 4; i < row->count; ++i)
    {
        const char *equals = strchr(word(row, i), '=');
        for (int j = 0; equals != NULL && j < MAPLINES_REASONS; ++j)
        {
            const char *name = maplines_reason_name((maplines_reason_t)j);
            const size_t length = (size_t)(equals - word(row, i));
            if (strlen(name) == length && strncmp(name, word(row, i), length) == 0)
            {
                expected[j] = (uint64_t)strtoull(equals + 1, NULL, 10);
            }
        }
    }
    for (int j = 0; j < MAPLINES_REASONS; ++j)
    {
        check(run, seen.counts[j] == expected[j], "the number of frames that are",
              maplines_reason_name((maplines_reason_t)j));
    }
}

/* ---- values of a line --------------------------------------------------------------------------
 */

static double sigma_of(const maplines_line_t *line, int i)
{
    double variance = 0;
    for (int k = 0; k < 4; ++k)
    {
        const double entry = (double)line->gaussian.factor[i][k];
        variance += entry * entry;
    }
    return sqrt(variance);
}

/// Whether the last step was a scene.
static bool is_of_scene(const run_t *run)
{
#if MAPLINES_SCENES
    return run->scene.has_scene;
#else
    (void)run;
    return false;
#endif
}

static const maplines_line_t *scene_line(const run_t *run, maplines_owner_t slot)
{
#if MAPLINES_SCENES
    return maplines_scene_line(&run->scene.scene, slot);
#else
    (void)run;
    (void)slot;
    return NULL;
#endif
}

/// The line of a slot that the last frame has completed.
static const maplines_line_t *newest_line(run_t *run, maplines_owner_t slot)
{
#if MAPLINES_LINE_RECORDS
    return maplines_newest(&run->decoder, slot);
#else
    maplines_copy_line(&run->decoder, slot, run->t_ns, &run->newest);
    return run->newest.has_line ? &run->newest.line : NULL;
#endif
}

static void line(run_t *run, const row_t *row)
{
    const maplines_owner_t slot = (maplines_owner_t)owner_of(word(row, 1));
    run->line = is_of_scene(run) ? scene_line(run, slot) : newest_line(run, slot);
    check(run, run->line != NULL, "the line", "there");
    if (run->line == NULL)
    {
        return;
    }
    check_word(run, maplines_kind_name(run->line->kind), row, 2, "the kind");
    check_word(run, maplines_status_name(run->line->status), row, 3, "the status");
    check_count(run, run->line->components, row, 4, "the number of components");
    check(run, run->line->t_ns == integer(row, 5), "the time", word(row, 5));
    check_number(run, (double)run->line->x_min, 0, TOLERANCE, row, 6, "x_min");
    check_number(run, (double)run->line->x_max, 0, TOLERANCE, row, 7, "x_max");
    check_number(run, (double)run->line->age, 0, TOLERANCE, row, 8, "the age");
}

static void mean(run_t *run, const row_t *row)
{
    for (int i = 0; i < 4; ++i)
    {
        const double scale = sigma_of(run->line, i);
        check_number(run, (double)run->line->gaussian.mean[i], scale, TOLERANCE, row,
                     1U + (size_t)i, "a mean");
    }
}

static void covariance(run_t *run, const row_t *row)
{
    const bool is_sum = is_of_scene(run) || DBC.is_conditional || run->line->components > 1;
    const double tolerance = is_sum ? SUM_TOLERANCE : TOLERANCE;
    maplines_real_t C[4][4];
    maplines_covariance(&run->line->gaussian, C);
    size_t place = 1;
    for (int i = 0; i < 4; ++i)
    {
        for (int j = i; j < 4; ++j)
        {
            const double scale = sigma_of(run->line, i) * sigma_of(run->line, j);
            check_variance(run, (double)C[i][j], scale, i == j, tolerance, row, place,
                           "a covariance");
            ++place;
        }
    }
}

/// Standard deviation of a lateral position; its square has the rounding errors of a covariance.
static void check_sigma(run_t *run, double x, double spread, const row_t *row, size_t i)
{
    const double got = (double)maplines_y_sigma(run->line, (maplines_real_t)x);
    const double expected = number(row, i);
    const double more = (got - expected) * (got + expected);
    const double scale = spread * spread;
    const bool is_right = isnan(expected) ? isnan(got) != 0
                                          : more >= -SUM_TOLERANCE * scale &&
                                                more <= (SUM_TOLERANCE + MAX_WIDENING) * scale;
    check(run, is_right, "a sigma", word(row, i));
}

/// The lateral positions, or their standard deviations, at 0, 20, 40 and 80 m; NaN outside of the
/// range.
static void lateral(run_t *run, const row_t *row, bool is_sigma)
{
    static const double places[] = {0, 20, 40, 80};
    for (size_t i = 0; i < COUNT(places); ++i)
    {
        const double x = places[i];
        const double tangent = tan((double)run->line->gaussian.mean[1]);
        const double slope = 1 + tangent * tangent;
        const double J[4] = {1, x * slope, x * x / 2, x * x * x / 6};
        double size = 0;
        double spread = 0;
        for (int k = 0; k < 4; ++k)
        {
            size += J[k] * fabs((double)run->line->gaussian.mean[k]);
            spread += J[k] * sigma_of(run->line, k);
        }
        if (is_sigma)
        {
            check_sigma(run, x, spread, row, 1 + i);
        }
        else
        {
            const double got = (double)maplines_y(run->line, (maplines_real_t)x);
            check_number(run, got, size + spread, SUM_TOLERANCE, row, 1 + i, "a lateral position");
        }
    }
}

#if MAPLINES_SCENES
static void joint(run_t *run, const row_t *row)
{
    const maplines_scene_t *scene = &run->scene.scene;
    const size_t n = 4U * scene->count;
    maplines_owner_t slots[MAPLINES_SLOTS];
    maplines_real_t C[16 * MAPLINES_SLOTS * MAPLINES_SLOTS];
    for (size_t i = 0; i < scene->count; ++i)
    {
        slots[i] = scene->lines[i].slot;
    }
    check(run, maplines_joint_covariance(scene, scene->count, slots, C), "the joint", "there");
    size_t place = 1;
    for (size_t i = 0; i < n; ++i)
    {
        for (size_t j = i; j < n; ++j)
        {
            const double scale = sqrt((double)C[n * i + i]) * sqrt((double)C[n * j + j]);
            check_variance(run, (double)C[n * i + j], scale, i == j, SUM_TOLERANCE, row, place,
                           "a joint covariance");
            ++place;
        }
    }
}

#endif

/* ---- the file ----------------------------------------------------------------------------------
 */

static void step(run_t *run, const row_t *row)
{
    const char *kind = word(row, 0);
    if (strcmp(kind, "key") == 0)
    {
        start_with_key(run, row);
    }
    else if (strcmp(kind, "frame") == 0)
    {
        feed(run, row);
    }
#if MAPLINES_LINE_RECORDS
    else if (strcmp(kind, "expire") == 0)
    {
        maplines_expire(&run->decoder, integer(row, 1));
    }
#endif
    else if (strcmp(kind, "view") == 0)
    {
        view(run, row);
    }
#if MAPLINES_SCENES
    else if (strcmp(kind, "scene") == 0)
    {
        scene(run, row);
    }
    else if (run->scene.has_scene && strcmp(kind, "joint") == 0)
    {
        joint(run, row);
    }
#endif
    else if (strcmp(kind, "stats") == 0)
    {
        stats(run, row);
    }
    else if (strcmp(kind, "counts") == 0)
    {
        counts(run, row);
    }
    else if (strcmp(kind, "line") == 0)
    {
        line(run, row);
    }
    else if (run->line != NULL && strcmp(kind, "mean") == 0)
    {
        mean(run, row);
    }
    else if (run->line != NULL && strcmp(kind, "cov") == 0)
    {
        covariance(run, row);
    }
    else if (run->line != NULL && strcmp(kind, "y") == 0)
    {
        lateral(run, row, false);
    }
    else if (run->line != NULL && strcmp(kind, "sigma") == 0)
    {
        lateral(run, row, true);
    }
    else
    {
        check(run, strcmp(kind, "about") == 0, "the step", "known");
    }
}

int main(int argc, char **argv)
{
    static run_t run;
    static char text[65536];
    static row_t row;
    FILE *file = argc > 1 ? fopen(argv[1], "r") : NULL;
    if (file == NULL)
    {
        (void)fprintf(stderr, "usage: %s VECTORS.txt [CASE]\n", argv[0]);
        return 2;
    }
    unsigned long all_cases = 0;
    unsigned long cases = 0;
    unsigned long failed = 0;
    unsigned long number_of_row = 0;
    bool is_in_case = false;
    bool is_wanted = false;
    bool is_whole = false; // the last row is that of the end
    while (fgets(text, sizeof(text), file) != NULL)
    {
        ++number_of_row;
        row.count = 0;
        for (char *found = strtok(text, " \r\n"); found != NULL && row.count < MAX_WORDS;
             found = strtok(NULL, " \r\n"))
        {
            row.words[row.count] = found;
            ++row.count;
        }
        if (strcmp(word(&row, 0), "case") == 0)
        {
            failed += is_in_case && run.has_failed ? 1U : 0U;
            is_wanted = argc < 3 || strcmp(word(&row, 1), argv[2]) == 0;
            is_in_case = is_wanted;
            cases += is_wanted ? 1U : 0U;
            ++all_cases;
            is_whole = false;
            memset(&run, 0, sizeof(run));
            (void)snprintf(run.name, sizeof(run.name), "%s", word(&row, 1));
            start(&run);
        }
        else if (strcmp(word(&row, 0), "end") == 0)
        {
            is_whole = strtoul(word(&row, 1), NULL, 10) == all_cases;
            is_wanted = false;
        }
        else if (is_wanted)
        {
            run.row = number_of_row;
            step(&run, &row);
        }
    }
    failed += is_in_case && run.has_failed ? 1U : 0U;
    (void)fclose(file);
    (void)printf("%lu cases of %s: %lu passed, %lu failed\n", cases, DBC.name, cases - failed,
                 failed);
    if (!is_whole)
    {
        (void)printf("%s is not whole: it has %lu cases, and no end that says so\n", argv[1],
                     all_cases);
    }
    return is_whole && failed == 0 && cases > 0 ? 0 : 1;
}
