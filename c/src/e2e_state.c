/* AUTOSAR's E2E check of a counter (profile 5), and E2E state machine of the records of an owner.
 */
#include "internal.h"

#if MAPLINES_RECEIVER

#define WORDS ((MAPLINES_WINDOW + 31) / 32)

/// Window size, least OKs and most errors in a state.
typedef struct {
    unsigned size;
    unsigned min_ok;
    unsigned max_error;
} bounds_t;

MAPLINES_INTERNAL maplines_e2e_status_t maplines_e2e_check(uint32_t delta, uint32_t max_delta)
{
    if (delta == 1)
    {
        return MAPLINES_E2E_OK;
    }
    if (delta == 0)
    {
        return MAPLINES_E2E_REPEATED;
    }
    return delta <= max_delta ? MAPLINES_E2E_OKSOMELOST : MAPLINES_E2E_WRONGSEQUENCE;
}

/// Bounds in a state; in NODATA, those of INIT.
static bounds_t bounds_in(const maplines_e2e_config_t *config, maplines_e2e_state_t state)
{
    bounds_t bounds = {config->window_size_init, config->min_ok_state_init,
                       config->max_error_state_init};
    if (state == MAPLINES_E2E_VALID)
    {
        bounds.size = config->window_size_valid;
        bounds.min_ok = config->min_ok_state_valid;
        bounds.max_error = config->max_error_state_valid;
    }
    else if (state == MAPLINES_E2E_INVALID)
    {
        bounds.size = config->window_size_invalid;
        bounds.min_ok = config->min_ok_state_invalid;
        bounds.max_error = config->max_error_state_invalid;
    }
    else
    {
        // INIT and NODATA
    }
    return bounds;
}

/// Keep the last `size` checks.
static void limit_window(uint32_t window[WORDS], unsigned size)
{
    for (unsigned i = 0; i < WORDS; ++i)
    {
        const unsigned below = 32U * i; // bits of the words before
        if (size <= below)
        {
            window[i] = 0;
        }
        else if (size < below + 32U)
        {
            window[i] &= ((uint32_t)1 << (size - below)) - 1U;
        }
        else
        {
            // the whole word is in the window
        }
    }
}

static void push_check(uint32_t window[WORDS], bool bit, unsigned size)
{
    for (unsigned i = WORDS - 1U; i > 0; --i)
    {
        window[i] = window[i] << 1U | window[i - 1U] >> 31U;
    }
    window[0] = window[0] << 1U | (bit ? 1U : 0U);
    limit_window(window, size);
}

static unsigned bits_in(const uint32_t window[WORDS])
{
    unsigned count = 0;
    for (unsigned i = 0; i < WORDS; ++i)
    {
        for (uint32_t rest = window[i]; rest != 0; rest &= rest - 1U)
        {
            ++count;
        }
    }
    return count;
}

static void enter(maplines_machine_t *machine, const maplines_e2e_config_t *config,
                  maplines_e2e_state_t state)
{
    const bounds_t bounds = bounds_in(config, state);
    machine->state = state;
    limit_window(machine->oks, bounds.size);
    limit_window(machine->errors, bounds.size);
}

MAPLINES_INTERNAL void maplines_machine_init(maplines_machine_t *machine)
{
    maplines_machine_clear(machine);
    machine->state = MAPLINES_E2E_NODATA;
}

MAPLINES_INTERNAL void maplines_machine_clear(maplines_machine_t *machine)
{
    memset(machine->oks, 0, sizeof(machine->oks));
    memset(machine->errors, 0, sizeof(machine->errors));
}

/* in        when                                                          becomes
 * NODATA    a check other than ERROR and NONEWDATA; it does not count     INIT
 * INIT      errors <= max_error_state_init, OKs >= min_ok_state_init      VALID
 * INIT      errors > max_error_state_init                                 INVALID
 * VALID     errors > max_error_state_valid or OKs < min_ok_state_valid    INVALID
 * INVALID   errors <= max_error_state_invalid, OKs >= min_ok_..._invalid  VALID
 */
MAPLINES_INTERNAL void maplines_machine_step(maplines_machine_t *machine,
                                             const maplines_e2e_config_t *config,
                                             maplines_e2e_status_t status)
{
    const maplines_e2e_state_t state = machine->state;
    const bool is_error = status == MAPLINES_E2E_ERROR;
    if (state == MAPLINES_E2E_NODATA)
    {
        if (!is_error && status != MAPLINES_E2E_NONEWDATA)
        {
            enter(machine, config, MAPLINES_E2E_INIT);
        }
        return;
    }
    const bounds_t bounds = bounds_in(config, state);
    const bool is_ok = status == MAPLINES_E2E_OK || status == MAPLINES_E2E_OKSOMELOST;
    push_check(machine->oks, is_ok, bounds.size);
    push_check(machine->errors, is_error, bounds.size);
    const unsigned errors = bits_in(machine->errors);
    if (errors <= bounds.max_error && bits_in(machine->oks) >= bounds.min_ok)
    {
        if (state != MAPLINES_E2E_VALID)
        {
            enter(machine, config, MAPLINES_E2E_VALID);
        }
        return;
    }
    if (state == MAPLINES_E2E_VALID || (state == MAPLINES_E2E_INIT && errors > bounds.max_error))
    {
        if (config->clear_to_invalid)
        {
            maplines_machine_clear(machine);
        }
        enter(machine, config, MAPLINES_E2E_INVALID);
    }
}

#endif
