/* Frames and questions to what a receiver answers.
 *
 * Input: settings (see read_settings), then steps of a kind (u8) each:
 *     0  a frame: CAN ID (u32), extended (u8), length (u8), data, time (i64), clock [us] (i64)
 *     1  maplines_latest: slot (u8), now (i64)
 *     2  maplines_latest_scene: now (i64)
 *     3  maplines_expire: time (i64)
 *     4  all statistics: now (i64)
 *     5  other settings, of which nothing but their values is asked: as at the beginning
 *     6  maplines_component: slot (u8), index (u8)
 *     7  what is wrong with the default settings after a change: owner (u8), time-out, cycle (i64),
 *        greatest step (u8), whether there is a function of the MAC (u8) and a clock (u8)
 * Output: whether the settings are refused (u8), then for each step what it gives; the lines that a
 * frame completes follow its answer.
 */
#include "aes_cmac.h"
#include "binary.h"
#include "harness_dbc.h"
#include "internal.h"

#define MAX_KEYS 4

static maplines_decoder_t decoder;

/// Keys of the receiver, and its clock.
static struct {
    unsigned count;
    uint8_t id[MAX_KEYS];
    uint8_t key[MAX_KEYS][16];
    int64_t now_us;
} vault;

static bool mac_of_vault(void *context, uint8_t key_id, const uint8_t *data, size_t length,
                         uint8_t mac[16])
{
    (void)context;
    for (unsigned i = 0; i < vault.count; ++i)
    {
        if (vault.id[i] == key_id)
        {
            aes_cmac(vault.key[i], data, length, mac);
            return true;
        }
    }
    return false;
}

static int64_t now_of_vault(void *context)
{
    (void)context;
    return vault.now_us;
}

static void read_e2e(maplines_e2e_config_t *e2e)
{
    e2e->max_delta_counter = read_u8();
    e2e->window_size_init = read_u8();
    e2e->window_size_valid = read_u8();
    e2e->window_size_invalid = read_u8();
    e2e->min_ok_state_init = read_u8();
    e2e->min_ok_state_valid = read_u8();
    e2e->min_ok_state_invalid = read_u8();
    e2e->max_error_state_init = read_u8();
    e2e->max_error_state_valid = read_u8();
    e2e->max_error_state_invalid = read_u8();
    e2e->clear_to_invalid = read_u8() != 0;
}

/// Read time-out and cycle time [ms] (f64), stale cycles (f64), whether there are windows (u8) and
/// these, the number of keys (u8) and these, whether there is a clock (u8), its window [us] (i64),
/// and the bound of freshness values [us] (i64). Return what is wrong, or NULL.
static const char *read_settings(maplines_settings_t *settings,
                                 maplines_authenticator_t *authenticator)
{
    maplines_e2e_config_t e2e;
    const double timeout_ms = read_f64();
    const double cycle_ms = read_f64();
    const double stale_cycles = read_f64();
    const bool has_e2e = read_u8() != 0;
    if (has_e2e)
    {
        read_e2e(&e2e);
    }
    const char *problem =
        maplines_settings_for(&harness_dbc, timeout_ms, cycle_ms, has_e2e ? &e2e : NULL, settings);
    settings->stale_cycles = stale_cycles;
    vault.count = read_u8();
    for (unsigned i = 0; i < vault.count; ++i)
    {
        vault.id[i] = read_u8();
        read_bytes(vault.key[i], 16);
    }
    authenticator->mac = mac_of_vault;
    authenticator->now_us = read_u8() != 0 ? now_of_vault : NULL;
    authenticator->window_us = read_i64();
    authenticator->not_before_us = read_i64();
    settings->authenticator = vault.count > 0 ? authenticator : NULL;
    return problem;
}

/// Write the covariance F F^T of a factor F.
static void write_covariance(const maplines_gaussian_t *gaussian)
{
    double F[16];
    double cov[16];
    for (int i = 0; i < 16; ++i)
    {
        F[i] = (double)gaussian->factor[i / 4][i % 4];
    }
    maplines_product_transposed(4, 4, 4, F, F, cov);
    for (int i = 0; i < 16; ++i)
    {
        write_f64(cov[i]);
    }
}

static void write_mean(const maplines_gaussian_t *gaussian)
{
    for (int i = 0; i < 4; ++i)
    {
        write_f64((double)gaussian->mean[i]);
    }
}

/// Write a line, with its covariance if its record has a factor of that, else with the factor.
static void write_line(const maplines_line_t *line, bool is_of_scene)
{
    write_u8((uint8_t)line->slot);
    write_u8((uint8_t)line->kind);
    write_u8((uint8_t)line->status);
    write_u8(line->components);
    write_f64((double)line->x_min);
    write_f64((double)line->x_max);
    write_f64((double)line->age);
    write_i64(line->t_ns);
    write_mean(&line->gaussian);
    if (line->components == 1 && !is_of_scene)
    {
        write_covariance(&line->gaussian);
        return;
    }
    for (int i = 0; i < 16; ++i)
    {
        write_f64((double)line->gaussian.factor[i / 4][i % 4]);
    }
}

static void write_components(maplines_owner_t slot, uint8_t count)
{
    for (uint8_t i = 0; i < count; ++i)
    {
        maplines_gaussian_t gaussian;
        maplines_real_t weight;
        if (!maplines_component(&decoder, slot, i, &gaussian, &weight))
        {
            exit(4);
        }
        write_f64((double)weight);
        write_mean(&gaussian);
        write_covariance(&gaussian);
    }
}

static void feed_frame(void)
{
    maplines_frame_t frame;
    memset(&frame, 0, sizeof frame);
    frame.can_id = read_u32();
    frame.is_extended = read_u8() != 0;
    frame.length = read_u8();
    uint8_t data[256] = {0};
    read_bytes(data, frame.length);
    memcpy(frame.data, data, sizeof frame.data);
    const int64_t t_ns = read_i64();
    vault.now_us = read_i64();
    const maplines_fed_t fed = maplines_feed(&decoder, &frame, t_ns);
    write_u8((uint8_t)(fed.reason + 1));
    write_u8(fed.count);
    for (uint8_t i = 0; i < fed.count; ++i)
    {
        const maplines_line_t *line = maplines_newest(&decoder, fed.slots[i]);
        write_line(line, harness_dbc.is_conditional);
        if (line->components > 1)
        {
            write_components(fed.slots[i], line->components);
        }
    }
}

static void ask_latest(void)
{
    maplines_view_t view;
    const uint8_t slot = read_u8();
    maplines_latest(&decoder, (maplines_owner_t)slot, read_i64(), &view);
    write_u8(view.line != NULL);
    write_i64(view.line != NULL ? view.line->t_ns : 0);
    write_f64((double)view.age);
    write_u8((uint8_t)view.state);
    write_u8((uint8_t)view.status);
    write_u8(view.is_stale);
    write_u8(view.two_senders);
    write_u8(view.is_usable);
}

static void ask_scene(void)
{
    maplines_scene_view_t view;
    maplines_latest_scene(&decoder, read_i64(), &view);
    write_u8(view.scene != NULL);
    write_f64((double)view.age);
    write_u8((uint8_t)view.state);
    write_u8((uint8_t)view.status);
    write_u8(view.is_stale);
    write_u8(view.two_senders);
    write_u8(view.is_usable);
    if (view.scene == NULL)
    {
        return;
    }
    write_u32(view.scene->counter);
    write_i64(view.scene->t_ns);
    write_f64((double)view.scene->age);
    write_u8(view.scene->count);
    for (uint8_t i = 0; i < view.scene->count; ++i)
    {
        write_u8((uint8_t)view.slot_states[i]);
        write_line(&view.scene->lines[i], true);
    }
}

static void ask_statistics(void)
{
    const int64_t now_ns = read_i64();
    for (int owner = 0; owner < MAPLINES_OWNERS; ++owner)
    {
        maplines_slot_stats_t stats;
        const bool is_known =
            maplines_slot_stats(&decoder, (maplines_owner_t)owner, now_ns, &stats);
        write_u8(is_known);
        if (!is_known)
        {
            continue;
        }
        write_u8((uint8_t)stats.state);
        write_u8((uint8_t)stats.status);
        write_u64(stats.ok);
        write_u64(stats.lost);
        write_u64(stats.repeated);
        write_u64(stats.wrong_sequence);
        write_u64(stats.errors);
        write_u64(stats.no_new_data);
        write_u8(stats.two_senders);
    }
    maplines_statistics_t all;
    maplines_statistics(&decoder, &all);
    for (int reason = 0; reason < MAPLINES_REASONS; ++reason)
    {
        write_u64(all.counts[reason]);
    }
    write_u64(all.frames);
    write_u64(all.lines);
    write_u64(all.line_frames);
    write_u64(all.pose_errors);
    write_u64(all.pose_frames);
    write_u64(all.lost);
    write_u32(all.pending);
}

/// Write whether settings are refused, and if not, all that follows from them.
static void ask_settings(void)
{
    maplines_settings_t settings;
    maplines_authenticator_t authenticator;
    const char *problem = read_settings(&settings, &authenticator);
    problem = problem != NULL ? problem : maplines_settings_problem(&harness_dbc, &settings);
    write_u8(problem != NULL);
    for (int owner = 0; problem == NULL && owner < MAPLINES_OWNERS; ++owner)
    {
        const maplines_e2e_config_t *e2e = &settings.e2e[owner];
        write_i64(settings.timeout_ns[owner]);
        write_i64(settings.cycle_ns[owner]);
        write_u8(e2e->max_delta_counter);
        write_u8(e2e->window_size_init);
        write_u8(e2e->window_size_valid);
        write_u8(e2e->window_size_invalid);
        write_u8(e2e->min_ok_state_init);
        write_u8(e2e->min_ok_state_valid);
        write_u8(e2e->min_ok_state_invalid);
        write_u8(e2e->max_error_state_init);
        write_u8(e2e->max_error_state_valid);
        write_u8(e2e->max_error_state_invalid);
        write_u8(e2e->clear_to_invalid);
    }
}

/// Write whether there is a component; if so, its weight and Gaussian.
static void ask_component(void)
{
    maplines_gaussian_t gaussian;
    maplines_real_t weight;
    const uint8_t slot = read_u8();
    const bool is_found =
        maplines_component(&decoder, (maplines_owner_t)slot, read_u8(), &gaussian, &weight);
    write_u8(is_found);
    if (is_found)
    {
        write_f64((double)weight);
        write_mean(&gaussian);
        write_covariance(&gaussian);
    }
}

/// Write what is wrong with changed settings (u8 length, text); nothing if they are good.
static void ask_problem(void)
{
    static maplines_decoder_t other;
    maplines_settings_t settings;
    maplines_authenticator_t authenticator;
    memset(&authenticator, 0, sizeof authenticator);
    maplines_default_settings(&harness_dbc, &settings);
    const uint8_t owner = read_u8();
    settings.timeout_ns[owner] = read_i64();
    settings.cycle_ns[owner] = read_i64();
    settings.e2e[owner].max_delta_counter = read_u8();
    authenticator.mac = read_u8() != 0 ? mac_of_vault : NULL;
    authenticator.now_us = read_u8() != 0 ? now_of_vault : NULL;
    authenticator.window_us = 1;
    settings.authenticator = harness_dbc.line.fd_authentic > 0 ? &authenticator : NULL;
    const char *problem = maplines_decoder_init(&other, &harness_dbc, &settings);
    const size_t length = problem != NULL ? strlen(problem) : 0;
    write_u8((uint8_t)length);
    write_bytes(problem, length);
}

int main(void)
{
    maplines_settings_t settings;
    maplines_authenticator_t authenticator;
    memset(&authenticator, 0, sizeof authenticator);
    const char *problem = read_settings(&settings, &authenticator);
    const char *refused = maplines_decoder_init(&decoder, &harness_dbc, &settings);
    problem = problem != NULL ? problem : refused;
    write_u8(problem != NULL);
    while (!at_end())
    {
        switch (read_u8())
        {
        case 0:
            feed_frame();
            break;
        case 1:
            ask_latest();
            break;
        case 2:
            ask_scene();
            break;
        case 3:
            maplines_expire(&decoder, read_i64());
            break;
        case 4:
            ask_statistics();
            break;
        case 5:
            ask_settings();
            break;
        case 6:
            ask_component();
            break;
        default:
            ask_problem();
            break;
        }
    }
    return 0;
}
