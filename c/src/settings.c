/* Times of reception: their range, and the time-outs, cycle times and E2E windows of a decoder. */
#include "internal.h"

#if MAPLINES_RECEIVER

#define DEFAULT_CYCLE_MS 100.0
/// Default time-out of a transfer. A DBC has transfer IDs for two lines of the most components, so
/// one is used again after two cycles at the earliest. The sender may be early by half a cycle.
#define TIMEOUT_CYCLES 1.5
#define MS_NS 1e6
#define MAX_MS 3600000.0
/// Greatest step of a counter of AUTOSAR's profile 5; a larger one may as well be a step back.
#define MAX_DELTA_COUNTER 127

MAPLINES_INTERNAL MAPLINES_APART int64_t maplines_limited_time(int64_t t_ns)
{
    if (t_ns > MAPLINES_MAX_TIME)
    {
        return MAPLINES_MAX_TIME;
    }
    return t_ns < -MAPLINES_MAX_TIME ? -MAPLINES_MAX_TIME : t_ns;
}

MAPLINES_INTERNAL MAPLINES_APART int64_t maplines_distance(int64_t a_ns, int64_t b_ns)
{
    return a_ns > b_ns ? a_ns - b_ns : b_ns - a_ns;
}

maplines_e2e_config_t maplines_default_e2e(void)
{
    const maplines_e2e_config_t e2e = {
        .max_delta_counter = 16,
        .window_size_init = 10,
        .window_size_valid = 10,
        .window_size_invalid = 10,
        .min_ok_state_init = 6,
        .min_ok_state_valid = 6,
        .min_ok_state_invalid = 8,
        .max_error_state_init = 1,
        .max_error_state_valid = 2,
        .max_error_state_invalid = 0,
        .clear_to_invalid = true,
    };
    return e2e;
}

static int64_t whole_ns(double ms)
{
    const int64_t t_ns = (int64_t)(MS_NS * ms);
    return t_ns > 0 ? t_ns : 1;
}

/// Windows whose step is at most a quarter of the counters of an owner.
static maplines_e2e_config_t within_counters(const maplines_dbc_t *dbc, int owner,
                                             const maplines_e2e_config_t *e2e)
{
    maplines_e2e_config_t within = *e2e;
    const uint32_t half = maplines_counter_mask(maplines_layout(dbc, owner)) / 2U + 1U;
    const uint32_t most = half / 2U;
    if (within.max_delta_counter > most)
    {
        within.max_delta_counter = (uint8_t)most;
    }
    return within;
}

/// Settings of checked times [ms] and windows; 0 and NULL are the default.
static void set_all(const maplines_dbc_t *dbc, double timeout_ms, double cycle_ms,
                    const maplines_e2e_config_t *e2e, maplines_settings_t *settings)
{
    const maplines_e2e_config_t standard = maplines_default_e2e();
    const int first = maplines_has_whole_scenes(dbc) ? MAPLINES_WHOLE_SCENE : 0;
    const maplines_e2e_config_t of_lines =
        e2e != NULL ? *e2e : within_counters(dbc, first, &standard);
    memset(settings, 0, sizeof(*settings));
    settings->stale_cycles = 3.0;
    for (int owner = 0; owner < MAPLINES_OWNERS; ++owner)
    {
        const maplines_messages_t *messages = &dbc->messages[owner];
        if (!messages->is_present)
        {
            continue;
        }
        const double dbc_ms =
            messages->cycle_ms > 0 ? (double)messages->cycle_ms : DEFAULT_CYCLE_MS;
        const double chosen_ms = cycle_ms > 0.0 ? cycle_ms : dbc_ms;
#if MAPLINES_LINE_RECORDS
        const double by_cycle_ms = TIMEOUT_CYCLES * chosen_ms;
        const double by_dbc_ms = by_cycle_ms > dbc_ms / 2.0 ? by_cycle_ms : dbc_ms / 2.0;
        const double derived_ms = by_dbc_ms < MAX_MS ? by_dbc_ms : MAX_MS;
        settings->timeout_ns[owner] = whole_ns(timeout_ms > 0.0 ? timeout_ms : derived_ms);
#else
        (void)timeout_ms; // a record is a frame
#endif
        settings->cycle_ns[owner] = whole_ns(chosen_ms);
        settings->e2e[owner] =
            maplines_is_pose(owner) ? within_counters(dbc, owner, &of_lines) : of_lines;
    }
}

void maplines_default_settings(const maplines_dbc_t *dbc, maplines_settings_t *settings)
{
    if (!MAPLINES_REQUIRE(settings != NULL))
    {
        return;
    }
    memset(settings, 0, sizeof(*settings));
    if (!MAPLINES_REQUIRE(dbc != NULL))
    {
        return;
    }
    set_all(dbc, 0.0, 0.0, NULL, settings);
}

/// What is wrong with the windows and bounds of a state machine by AUTOSAR's constraints.
static const char *e2e_problem(const maplines_e2e_config_t *e2e)
{
    const uint8_t size[3] = {e2e->window_size_init, e2e->window_size_valid,
                             e2e->window_size_invalid};
    const uint8_t ok[3] = {e2e->min_ok_state_init, e2e->min_ok_state_valid,
                           e2e->min_ok_state_invalid};
    const uint8_t error[3] = {e2e->max_error_state_init, e2e->max_error_state_valid,
                              e2e->max_error_state_invalid};
    if (e2e->max_delta_counter < 1 || e2e->max_delta_counter > MAX_DELTA_COUNTER)
    {
        return "max_delta_counter must be from 1 to 127";
    }
    if (2U * e2e->max_delta_counter > MAPLINES_HISTORY)
    {
        return "max_delta_counter must be at most half of MAPLINES_HISTORY of the build";
    }
    for (int state = 0; state < 3; ++state)
    {
        if (size[state] < 1 || ok[state] < 1)
        {
            return "each window_size and min_ok_state must be 1 or more";
        }
        if (ok[state] + error[state] > size[state])
        {
            return "min_ok_state + max_error_state must fit into the window_size of its state";
        }
        if (size[state] > e2e->window_size_valid)
        {
            return "no window_size may exceed window_size_valid";
        }
#if MAPLINES_WINDOW < UINT8_MAX
        if (size[state] > MAPLINES_WINDOW)
        {
            return "no window_size may exceed MAPLINES_WINDOW of the build";
        }
#endif
    }
    if (ok[1] > ok[0] || ok[0] > ok[2])
    {
        return "min_ok_state_valid <= min_ok_state_init <= min_ok_state_invalid must hold";
    }
    if (error[2] > error[0] || error[0] > error[1])
    {
        return "max_error_state_invalid <= max_error_state_init <= max_error_state_valid must hold";
    }
    return NULL;
}

#if MAPLINES_SECOC
static const char *authenticator_problem(const maplines_dbc_t *dbc,
                                         const maplines_authenticator_t *authenticator)
{
    const int lines = maplines_has_whole_scenes(dbc) ? MAPLINES_WHOLE_SCENE : 0;
    if (maplines_layout(dbc, lines)->fd_authentic == 0)
    {
        return "authenticator: the DBC has no authenticated message of lines";
    }
    if (authenticator->mac == NULL)
    {
        return "authenticator: mac must be a function";
    }
    if (authenticator->window_us < 1)
    {
        return "authenticator: window_us must be 1 or more";
    }
    if (authenticator->not_before_us < 0)
    {
        return "authenticator: not_before_us must be 0 or more";
    }
    const maplines_record_t *const layouts[2] = {maplines_layout(dbc, lines),
                                                 maplines_layout(dbc, (int)MAPLINES_POSE)};
    for (int i = 0; i < 2; ++i)
    {
        const unsigned bytes = layouts[i]->fd_freshness;
        if (layouts[i]->fd_authentic == 0)
        {
            continue;
        }
        if (authenticator->now_us == NULL && bytes < 7)
        {
            return "authenticator: without a clock (now_us), Freshness needs 7 bytes in the DBC";
        }
        if (authenticator->now_us != NULL &&
            authenticator->window_us > (INT64_C(1) << (8U * bytes - 1U)) - 1)
        {
            return "authenticator: window_us must be less than half of what Freshness can count";
        }
    }
    return NULL;
}
#endif

MAPLINES_INTERNAL const char *maplines_settings_problem(const maplines_dbc_t *dbc,
                                                        const maplines_settings_t *settings)
{
    if (!(settings->stale_cycles >= 0.0))
    {
        return "stale_cycles must be 0 or more";
    }
    for (int owner = 0; owner < MAPLINES_OWNERS; ++owner)
    {
        if (!dbc->messages[owner].is_present)
        {
            continue;
        }
#if MAPLINES_LINE_RECORDS
        if (settings->timeout_ns[owner] < 1 || settings->timeout_ns[owner] > MAPLINES_MAX_PERIOD_NS)
        {
            return "timeout_ns must be from 1 ns to an hour for each owner of the DBC";
        }
#endif
        if (settings->cycle_ns[owner] < 1 || settings->cycle_ns[owner] > MAPLINES_MAX_PERIOD_NS)
        {
            return "cycle_ns must be from 1 ns to an hour for each owner of the DBC";
        }
        const maplines_e2e_config_t *e2e = &settings->e2e[owner];
        const char *problem = e2e_problem(e2e);
        if (problem != NULL)
        {
            return problem;
        }
        if (e2e->max_delta_counter > maplines_counter_mask(maplines_layout(dbc, owner)) / 2U)
        {
            return "max_delta_counter must be less than half the modulus of the DBC's Counter";
        }
    }
    if (settings->authenticator == NULL)
    {
        return NULL;
    }
#if MAPLINES_SECOC
    return authenticator_problem(dbc, settings->authenticator);
#else
    return "authenticator: this build has no SecOC";
#endif
}

const char *maplines_settings_for(const maplines_dbc_t *dbc, double timeout_ms, double cycle_ms,
                                  const maplines_e2e_config_t *e2e, maplines_settings_t *settings)
{
    if (!MAPLINES_REQUIRE(dbc != NULL) || !MAPLINES_REQUIRE(settings != NULL))
    {
        return "dbc and settings must not be NULL";
    }
    maplines_default_settings(dbc, settings);
    if (!(timeout_ms >= 0.0 && timeout_ms <= MAX_MS))
    {
        return "timeout_ms must be from 0 (the default) to an hour, 3600000 ms";
    }
    if (!(cycle_ms >= 0.0 && cycle_ms <= MAX_MS))
    {
        return "cycle_ms must be from 0 (the default) to an hour, 3600000 ms";
    }
    maplines_settings_t wanted;
    set_all(dbc, timeout_ms, cycle_ms, e2e, &wanted);
    const char *problem = maplines_settings_problem(dbc, &wanted);
    if (problem == NULL)
    {
        *settings = wanted;
    }
    return problem;
}

#endif
