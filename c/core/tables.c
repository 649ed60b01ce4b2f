/* What both sides of the shared library agree on: version, structures, and tables of a DBC. */
#include "core.h"
#include "internal.h"

#if defined(__clang__)
#define COMPILER __VERSION__ // begins with the name
#elif defined(__GNUC__)
#define COMPILER "GCC " __VERSION__
#elif defined(_MSC_VER)
#define COMPILER "Microsoft C"
#else
#define COMPILER "an unknown compiler"
#endif

const char *maplines_core_compiler(void)
{
    return COMPILER;
}

const char *maplines_core_version(void)
{
    return MAPLINES_VERSION;
}

#ifndef MAPLINES_DECLARATIONS
#define MAPLINES_DECLARATIONS 0U // not a build of the package
#endif

uint32_t maplines_core_declarations(void)
{
    return MAPLINES_DECLARATIONS;
}

size_t maplines_core_size(size_t i)
{
    static const size_t sizes[] = {sizeof(maplines_dbc_t),      sizeof(maplines_receiver_t),
                                   sizeof(maplines_settings_t), sizeof(maplines_block_t),
                                   sizeof(maplines_rows_t),     sizeof(maplines_log_t),
                                   sizeof(maplines_prepared_t), sizeof(maplines_given_scene_t)};
    return i < sizeof sizes / sizeof sizes[0] ? sizes[i] : 0U;
}

/// Whether signals are within a record of so many pages; those of no bits are not in the DBC.
static bool are_within(size_t count, const maplines_signal_t *signals, int pages)
{
    bool is_within = true;
    for (size_t i = 0; i < count; i++)
    {
        const maplines_signal_t *signal = &signals[i];
        is_within =
            is_within && (signal->length == 0 || (signal->length < 64 && signal->scale != NULL &&
                                                  signal->first + signal->length <= 64 * pages));
    }
    return is_within;
}

static bool is_cholesky(const maplines_cholesky_t *code, int pages)
{
    bool is_ordered = code->rows <= 4;
    for (int i = 0; i < 4; i++)
    {
        is_ordered = is_ordered && code->order[i] < 4;
    }
    return is_ordered && are_within(4, code->pivot, pages) && are_within(6, code->ratio, pages) &&
           are_within(1, &code->inflation, pages);
}

static bool is_record(const maplines_record_t *record)
{
    const int pages = record->pages;
    return pages <= MAPLINES_MAX_PAGES && record->short_pages <= pages &&
           (pages == 0 || record->crc_byte <= 8 * pages - 2) &&
           are_within(1, &record->page, pages) && are_within(2, record->transfer_id, pages) &&
           are_within(1, &record->counter, pages);
}

static bool are_levels(const maplines_levels_t *levels, int pages)
{
    return are_within(1, &levels->lateral, pages) && are_within(1, &levels->points, pages) &&
           are_within(1, &levels->shape, pages) && are_within(1, &levels->tilt, pages) &&
           are_within(1, &levels->quartic, pages) && are_within(1, &levels->fit_behind, pages) &&
           are_within(1, &levels->fit_ahead, pages);
}

/// Whether the lines of a whole scene are within its record, and name no other slots.
static bool are_places(const maplines_dbc_t *dbc)
{
    const maplines_places_t *scene = &dbc->scene;
    const int bits = 64 * dbc->pose.pages - 8 * scene->stride * (scene->places - 1);
    const maplines_signal_t line[] = {dbc->kind,         dbc->x_min,          dbc->x_max,
                                      dbc->mean[0],      dbc->mean[1],        dbc->mean[2],
                                      dbc->mean[3],      dbc->levels.lateral, dbc->levels.points,
                                      dbc->levels.shape, dbc->levels.tilt,    dbc->levels.quartic};
    bool is_good = scene->places <= MAPLINES_MAX_PLACES && scene->secured_places <= scene->places &&
                   scene->slot.length <= 3;
    for (size_t i = 0; i < sizeof line / sizeof line[0]; i++)
    {
        is_good = is_good && line[i].first + line[i].length <= bits;
    }
    for (int i = 0; i < 2 * MAPLINES_MAX_PLACES; i++)
    {
        is_good = is_good &&
                  scene->fixed[i / MAPLINES_MAX_PLACES][i % MAPLINES_MAX_PLACES] <= MAPLINES_SLOTS;
    }
    return is_good && are_within(1, &scene->join, dbc->pose.pages) &&
           are_within(1, &scene->slot, dbc->pose.pages);
}

bool maplines_check_tables(const maplines_dbc_t *dbc)
{
    const bool is_scene = dbc->scene.places > 0;
    const int pages = is_scene ? dbc->pose.pages : dbc->line.pages;
    const int of_pose = dbc->pose.pages;
    bool is_good = dbc->max_components <= MAPLINES_MAX_COMPONENTS && is_record(&dbc->line) &&
                   is_record(&dbc->pose) && pages > 0 && (of_pose > 0 || !dbc->has_pose) &&
                   (dbc->spacings == 0 || dbc->straight != NULL) && (!is_scene || are_places(dbc));
    const maplines_signal_t own[] = {
        dbc->kind,          dbc->x_min,           dbc->x_max,           dbc->status,
        dbc->age,           dbc->component_index, dbc->component_count, dbc->component_weight,
        dbc->has_covariance};
    const maplines_signal_t pose[] = {dbc->pose_age, dbc->correlation_time, dbc->map_offset,
                                      dbc->map_heading};
    is_good = is_good && are_within(sizeof own / sizeof own[0], own, pages) &&
              are_within(4, dbc->mean, pages) && are_within(4, dbc->fine, pages) &&
              are_levels(&dbc->levels, pages) && is_cholesky(&dbc->covariance, pages) &&
              are_within(sizeof pose / sizeof pose[0], pose, of_pose) &&
              is_cholesky(&dbc->pose_covariance, of_pose) &&
              are_within(MAPLINES_SLOTS, dbc->slot_counter, of_pose);
    for (int slot = 0; slot < MAPLINES_SLOTS; slot++)
    {
        is_good = is_good && are_levels(&dbc->slot_levels[slot], of_pose);
    }
    for (int owner = 0; owner < MAPLINES_OWNERS; owner++)
    {
        is_good = is_good && dbc->messages[owner].fd_length <= 64;
    }
    return is_good;
}

void maplines_straight_levels(const maplines_dbc_t *dbc, float *straight)
{
    const maplines_levels_t *levels = maplines_levels_of(dbc);
    const double mean[4] = {0.0, 0.0, 0.0, 0.0};
    const double fit_range[2] = {0.0, 1.0};
    const maplines_curve_t curve = maplines_curve_of(mean, fit_range, 0.0);
    maplines_arc_t arc;
    maplines_arc_of(&curve, &arc);
    for (int k = 0; k < (int)dbc->spacings; k++)
    {
        const int64_t raw = maplines_raw_min(&levels->shape) + (int64_t)k * dbc->spacing_step;
        double cov[16];
        straight[10] = (float)maplines_point_noise(levels, &arc, raw, cov);
        for (int i = 0; i < 4; i++)
        {
            for (int j = 0; j <= i; j++)
            {
                *straight++ = (float)cov[4 * i + j];
            }
        }
        straight++;
    }
}
