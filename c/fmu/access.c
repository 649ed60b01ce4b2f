/* Variables of an FMU: a value reference is the first one of a type plus an index.
 *
 * The indices of each type begin with parameters, then tunable parameters, inputs and outputs, so
 * the end of each group says what may be set in a mode.
 */
#include "fmu.h"

#include <string.h>

/// One type of variables.
typedef struct {
    fmi3ValueReference first;
    size_t count;
    size_t fixed;    ///< parameters
    size_t tunable;  ///< these and tunable parameters
    size_t settable; ///< these and inputs
    const char *name;
} type_t;

static const type_t reals = {MAPLINES_FIRST_REAL,    MAPLINES_REALS,          MAPLINES_FIXED_REALS,
                             MAPLINES_TUNABLE_REALS, MAPLINES_SETTABLE_REALS, "Float64"};
static const type_t choices = {MAPLINES_FIRST_CHOICE,     MAPLINES_CHOICES,
                               MAPLINES_FIXED_CHOICES,    MAPLINES_TUNABLE_CHOICES,
                               MAPLINES_SETTABLE_CHOICES, "Int64"};
static const type_t counts = {MAPLINES_FIRST_COUNT,     MAPLINES_COUNTS,
                              MAPLINES_FIXED_COUNTS,    MAPLINES_TUNABLE_COUNTS,
                              MAPLINES_SETTABLE_COUNTS, "UInt64"};
static const type_t flags = {MAPLINES_FIRST_FLAG,    MAPLINES_FLAGS,          MAPLINES_FIXED_FLAGS,
                             MAPLINES_TUNABLE_FLAGS, MAPLINES_SETTABLE_FLAGS, "Boolean"};

/// Index of a variable; false, and logged, if there is none of this type.
static bool find(const maplines_instance_t *instance, const type_t *type,
                 fmi3ValueReference reference, size_t *index)
{
    *index = (size_t)reference - type->first;
    const bool is_found = reference >= type->first && *index < type->count;
    if (!is_found)
    {
        maplines_log(instance, fmi3Error, "there is no %s with the value reference %lu", type->name,
                     (unsigned long)reference);
    }
    return is_found;
}

/// Index of a variable that may be set now; false, and logged, if it may not.
static bool find_settable(const maplines_instance_t *instance, const type_t *type,
                          fmi3ValueReference reference, size_t *index)
{
    const maplines_mode_t mode = instance->state.mode;
    if (!find(instance, type, reference, index))
    {
        return false;
    }
    size_t first = type->settable; // of those that may be set
    if (mode == MAPLINES_INSTANTIATED || mode == MAPLINES_INITIALIZATION)
    {
        first = 0;
    }
    else if (mode == MAPLINES_EVENT)
    {
        first = type->fixed;
    }
    else if (mode == MAPLINES_STEP)
    {
        first = type->tunable;
    }
    const bool may = *index >= first && *index < type->settable;
    if (!may)
    {
        maplines_log(instance, fmi3Error, "the %s with the value reference %lu must not be set now",
                     type->name, (unsigned long)reference);
    }
    return may;
}

/// Whether values can be read or set: as many as references, of an instance.
static bool are_matched(const maplines_instance_t *instance, size_t references, size_t values)
{
    if (instance != NULL && references != values)
    {
        maplines_log(instance, fmi3Error, "%lu values for %lu scalar variables",
                     (unsigned long)values, (unsigned long)references);
    }
    return instance != NULL && references == values;
}

/// Compute the outputs, if time or state have changed since they were computed.
static void refresh(maplines_instance_t *instance)
{
    if (!instance->state.is_fresh)
    {
        maplines_refresh(instance);
        maplines_show_controller(instance);
        instance->state.is_fresh = true;
    }
}

/// Note that a variable is set: outputs depend on it, and so does what is sent.
static void note(maplines_instance_t *instance, const type_t *type, size_t index)
{
    instance->state.is_fresh = false;
    if (index >= type->tunable)
    {
        maplines_note_input(&instance->state.node, type->first, index);
    }
}

/* ---- read ------------------------------------------------------------------------------------ */

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                          size_t nValueReferences, fmi3Float64 values[], size_t nValues)
{
    maplines_instance_t *own = instance;
    bool is_right = are_matched(own, nValueReferences, nValues);
    for (size_t i = 0; is_right && i < nValues; i++)
    {
        size_t index = 0;
        if (valueReferences[i] == MAPLINES_TIME)
        {
            values[i] = own->state.now;
        }
        else if (find(own, &reals, valueReferences[i], &index))
        {
            refresh(own);
            values[i] = own->state.values.reals[index];
        }
        else
        {
            is_right = false;
        }
    }
    return is_right ? fmi3OK : fmi3Error;
}

fmi3Status fmi3GetInt64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                        size_t nValueReferences, fmi3Int64 values[], size_t nValues)
{
    maplines_instance_t *own = instance;
    bool is_right = are_matched(own, nValueReferences, nValues);
    for (size_t i = 0; is_right && i < nValues; i++)
    {
        size_t index = 0;
        is_right = find(own, &choices, valueReferences[i], &index);
        if (is_right)
        {
            refresh(own);
            values[i] = own->state.values.choices[index];
        }
    }
    return is_right ? fmi3OK : fmi3Error;
}

fmi3Status fmi3GetUInt64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, fmi3UInt64 values[], size_t nValues)
{
    maplines_instance_t *own = instance;
    bool is_right = are_matched(own, nValueReferences, nValues);
    for (size_t i = 0; is_right && i < nValues; i++)
    {
        size_t index = 0;
        is_right = find(own, &counts, valueReferences[i], &index);
        if (is_right)
        {
            refresh(own);
            values[i] = own->state.values.counts[index];
        }
    }
    return is_right ? fmi3OK : fmi3Error;
}

fmi3Status fmi3GetBoolean(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                          size_t nValueReferences, fmi3Boolean values[], size_t nValues)
{
    maplines_instance_t *own = instance;
    bool is_right = are_matched(own, nValueReferences, nValues);
    for (size_t i = 0; is_right && i < nValues; i++)
    {
        size_t index = 0;
        is_right = find(own, &flags, valueReferences[i], &index);
        if (is_right)
        {
            refresh(own);
            values[i] = own->state.values.flags[index];
        }
    }
    return is_right ? fmi3OK : fmi3Error;
}

fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, size_t valueSizes[], fmi3Binary values[],
                         size_t nValues)
{
    maplines_instance_t *own = instance;
    bool is_right = are_matched(own, nValueReferences, nValues);
    for (size_t i = 0; is_right && i < nValues; i++)
    {
        maplines_controller_t *controller = &own->state.controller;
        if (valueReferences[i] == MAPLINES_TX_DATA)
        {
            maplines_fill(own);
            values[i] = controller->tx.bytes;
            valueSizes[i] = controller->tx_clock ? controller->tx.size : 0;
        }
        else if (valueReferences[i] == MAPLINES_RX_DATA)
        {
            values[i] = controller->rx;
            valueSizes[i] = controller->rx_size;
        }
        else
        {
            maplines_log(own, fmi3Error, "there is no Binary with the value reference %lu",
                         (unsigned long)valueReferences[i]);
            is_right = false;
        }
    }
    return is_right ? fmi3OK : fmi3Error;
}

/* ---- set ------------------------------------------------------------------------------------- */

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                          size_t nValueReferences, const fmi3Float64 values[], size_t nValues)
{
    maplines_instance_t *own = instance;
    bool is_right = are_matched(own, nValueReferences, nValues);
    for (size_t i = 0; is_right && i < nValues; i++)
    {
        size_t index = 0;
        is_right = find_settable(own, &reals, valueReferences[i], &index);
        if (is_right)
        {
            own->state.values.reals[index] = values[i];
            note(own, &reals, index);
        }
    }
    return is_right ? fmi3OK : fmi3Error;
}

fmi3Status fmi3SetInt64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                        size_t nValueReferences, const fmi3Int64 values[], size_t nValues)
{
    maplines_instance_t *own = instance;
    bool is_right = are_matched(own, nValueReferences, nValues);
    for (size_t i = 0; is_right && i < nValues; i++)
    {
        size_t index = 0;
        is_right = find_settable(own, &choices, valueReferences[i], &index);
        if (is_right && (values[i] < maplines_least_choices[index] ||
                         values[i] > maplines_greatest_choices[index]))
        {
            maplines_log(own, fmi3Error,
                         "the value of the enumeration with the value reference %lu must be in "
                         "[%d, %d], got %ld",
                         (unsigned long)valueReferences[i], (int)maplines_least_choices[index],
                         (int)maplines_greatest_choices[index], (long)values[i]);
            is_right = false;
        }
        if (is_right)
        {
            own->state.values.choices[index] = values[i];
            note(own, &choices, index);
        }
    }
    return is_right ? fmi3OK : fmi3Error;
}

fmi3Status fmi3SetUInt64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, const fmi3UInt64 values[], size_t nValues)
{
    maplines_instance_t *own = instance;
    bool is_right = are_matched(own, nValueReferences, nValues);
    for (size_t i = 0; is_right && i < nValues; i++)
    {
        size_t index = 0;
        is_right = find_settable(own, &counts, valueReferences[i], &index);
        if (is_right)
        {
            own->state.values.counts[index] = values[i];
            note(own, &counts, index);
        }
    }
    return is_right ? fmi3OK : fmi3Error;
}

fmi3Status fmi3SetBoolean(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                          size_t nValueReferences, const fmi3Boolean values[], size_t nValues)
{
    maplines_instance_t *own = instance;
    bool is_right = are_matched(own, nValueReferences, nValues);
    for (size_t i = 0; is_right && i < nValues; i++)
    {
        size_t index = 0;
        is_right = find_settable(own, &flags, valueReferences[i], &index);
        if (is_right)
        {
            own->state.values.flags[index] = values[i];
            note(own, &flags, index);
        }
    }
    return is_right ? fmi3OK : fmi3Error;
}

fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, const size_t valueSizes[],
                         const fmi3Binary values[], size_t nValues)
{
    const unsigned modes = MAPLINES_INSTANTIATED | MAPLINES_INITIALIZATION | MAPLINES_EVENT;
    maplines_instance_t *own = instance;
    bool is_right = are_matched(own, nValueReferences, nValues) &&
                    maplines_may_call(own, modes, "fmi3SetBinary");
    for (size_t i = 0; is_right && i < nValues; i++)
    {
        maplines_controller_t *controller = &own->state.controller;
        is_right = valueReferences[i] == MAPLINES_RX_DATA && valueSizes[i] <= MAPLINES_RX_SIZE;
        if (is_right)
        {
            controller->rx_size = valueSizes[i];
            if (valueSizes[i] > 0)
            {
                memcpy(controller->rx, values[i], valueSizes[i]);
            }
        }
        else
        {
            maplines_log(own, fmi3Error,
                         "fmi3SetBinary: only Rx_Data can be set, to %d bytes at most; got %lu "
                         "bytes for the value reference %lu",
                         MAPLINES_RX_SIZE, (unsigned long)valueSizes[i],
                         (unsigned long)valueReferences[i]);
        }
    }
    return is_right ? fmi3OK : fmi3Error;
}
