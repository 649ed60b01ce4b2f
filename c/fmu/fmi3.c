/* Functions of FMI for co-simulation: instances, modes, steps, clocks and states. */
#include "fmu.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MAX_TIME 4e9 /* of the simulation: that of the C core, 126 years [s] */

void maplines_log(const maplines_instance_t *instance, fmi3Status status, const char *format, ...)
{
    const char *const categories[] = {"logEvents", "logStatusWarning", "logStatusDiscard",
                                      "logStatusError", "logStatusFatal"};
    char text[256];
    if (instance->log == NULL || (status == fmi3OK && !instance->is_logging))
    {
        return;
    }
    va_list arguments;
    va_start(arguments, format);
    // clang-tidy does not see va_start of a system header.
    // NOLINTBEGIN(clang-analyzer-valist.*)
    (void)vsnprintf(text, sizeof text, format, arguments);
    va_end(arguments);
    // NOLINTEND(clang-analyzer-valist.*)
    instance->log(instance->environment, status, categories[status], text);
}

bool maplines_may_call(const maplines_instance_t *instance, unsigned modes, const char *function)
{
    if (instance == NULL)
    {
        return false;
    }
    const bool may = ((unsigned)instance->state.mode & modes) != 0;
    if (!may)
    {
        maplines_log(instance, fmi3Error, "%s must not be called in this mode", function);
    }
    return may;
}

/// Set an instance to its state after instantiation.
static void set_up(maplines_instance_t *instance)
{
    maplines_values_t *values = &instance->state.values;
    memset(&instance->state, 0, sizeof instance->state);
    instance->state.mode = MAPLINES_INSTANTIATED;
    memcpy(values->reals, maplines_start_reals, sizeof maplines_start_reals);
    memcpy(values->choices, maplines_start_choices, sizeof maplines_start_choices);
    memcpy(values->counts, maplines_start_counts, sizeof maplines_start_counts);
    memcpy(values->flags, maplines_start_flags, sizeof maplines_start_flags);
    maplines_start_controller(instance);
    (void)maplines_start(instance);
}

/* ---- instances ------------------------------------------------------------------------------- */

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean loggingOn, size_t nCategories,
                               const fmi3String categories[])
{
    maplines_instance_t *own = instance;
    bool has_events = nCategories == 0;
    for (size_t i = 0; i < nCategories; i++)
    {
        has_events = has_events || strcmp(categories[i], "logEvents") == 0;
    }
    if (has_events)
    {
        own->is_logging = loggingOn;
    }
    return fmi3OK;
}

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed,
    fmi3Boolean earlyReturnAllowed, const fmi3ValueReference requiredIntermediateVariables[],
    size_t nRequiredIntermediateVariables, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback logMessage, fmi3IntermediateUpdateCallback intermediateUpdate)
{
    (void)instanceName;
    (void)resourcePath;
    (void)visible;
    (void)earlyReturnAllowed;
    (void)requiredIntermediateVariables;
    (void)nRequiredIntermediateVariables;
    (void)intermediateUpdate;
    const size_t scratch = maplines_scratch_size() * sizeof(double);
    maplines_instance_t *own = calloc(1, sizeof *own + scratch);
    if (own == NULL)
    {
        return NULL;
    }
    own->scratch = (double *)(own + 1);
    own->environment = instanceEnvironment;
    own->log = logMessage;
    own->is_logging = loggingOn;
    set_up(own);
    const char *wrong = NULL;
    if (instantiationToken == NULL || strcmp(instantiationToken, maplines_token) != 0)
    {
        wrong = "the instantiation token is that of another FMU";
    }
    else if (!eventModeUsed)
    {
        wrong = "frames need the event mode: instantiate with eventModeUsed";
    }
    if (wrong != NULL)
    {
        maplines_log(own, fmi3Error, "%s", wrong);
        free(own);
        own = NULL;
    }
    return own;
}

void fmi3FreeInstance(fmi3Instance instance)
{
    free(instance);
}

/* ---- modes ----------------------------------------------------------------------------------- */

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined,
                                       fmi3Float64 tolerance, fmi3Float64 startTime,
                                       fmi3Boolean stopTimeDefined, fmi3Float64 stopTime)
{
    maplines_instance_t *own = instance;
    (void)toleranceDefined;
    (void)tolerance;
    (void)stopTimeDefined;
    (void)stopTime;
    if (!maplines_may_call(own, MAPLINES_INSTANTIATED, "fmi3EnterInitializationMode"))
    {
        return fmi3Error;
    }
    if (!(fabs(startTime) <= MAX_TIME))
    {
        maplines_log(own, fmi3Error, "startTime must be in [%g, %g] s, got %g s", -MAX_TIME,
                     MAX_TIME, startTime);
        return fmi3Error;
    }
    own->state.now = startTime;
    own->state.mode = MAPLINES_INITIALIZATION;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    maplines_instance_t *own = instance;
    if (!maplines_may_call(own, MAPLINES_INITIALIZATION, "fmi3ExitInitializationMode"))
    {
        return fmi3Error;
    }
    const uint64_t *counts = own->state.values.counts;
    const char *wrong = NULL;
    if (counts[COUNT_BAUD_RATE] < 1 || counts[COUNT_BAUD_RATE] > UINT32_MAX ||
        counts[COUNT_FD_BAUD_RATE] > UINT32_MAX)
    {
        wrong = "baud_rate must be 1 bit/s or more, fd_baud_rate 0 or more, both below 2^32";
    }
    if (wrong == NULL)
    {
        maplines_start_controller(own);
        wrong = maplines_start(own);
    }
    if (wrong != NULL)
    {
        maplines_log(own, fmi3Error, "%s", wrong);
        return fmi3Error;
    }
    own->state.mode = MAPLINES_EVENT;
    own->state.is_fresh = false;
    return fmi3OK;
}

fmi3Status fmi3EnterEventMode(fmi3Instance instance)
{
    maplines_instance_t *own = instance;
    if (!maplines_may_call(own, MAPLINES_STEP, "fmi3EnterEventMode"))
    {
        return fmi3Error;
    }
    own->state.mode = MAPLINES_EVENT;
    return fmi3OK;
}

fmi3Status fmi3EnterStepMode(fmi3Instance instance)
{
    maplines_instance_t *own = instance;
    if (!maplines_may_call(own, MAPLINES_EVENT, "fmi3EnterStepMode"))
    {
        return fmi3Error;
    }
    own->state.mode = MAPLINES_STEP;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance instance)
{
    maplines_instance_t *own = instance;
    if (!maplines_may_call(own, MAPLINES_EVENT | MAPLINES_STEP, "fmi3Terminate"))
    {
        return fmi3Error;
    }
    own->state.mode = MAPLINES_TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance)
{
    maplines_instance_t *own = instance;
    if (own == NULL)
    {
        return fmi3Error;
    }
    set_up(own);
    return fmi3OK;
}

/* ---- events and steps ------------------------------------------------------------------------ */

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *discreteStatesNeedUpdate,
                                    fmi3Boolean *terminateSimulation,
                                    fmi3Boolean *nominalsOfContinuousStatesChanged,
                                    fmi3Boolean *valuesOfContinuousStatesChanged,
                                    fmi3Boolean *nextEventTimeDefined, fmi3Float64 *nextEventTime)
{
    maplines_instance_t *own = instance;
    if (!maplines_may_call(own, MAPLINES_EVENT, "fmi3UpdateDiscreteStates"))
    {
        return fmi3Error;
    }
    maplines_controller_t *controller = &own->state.controller;
    if (controller->tx_clock)
    {
        maplines_fill(own);      // unless what is sent was read already
        controller->tx.size = 0; // it is sent
        controller->tx_clock = false;
        controller->announced = (double)NAN;
    }
    if (controller->rx_clock)
    {
        maplines_receive(own);
        controller->rx_clock = false;
    }
    *discreteStatesNeedUpdate = fmi3False;
    *terminateSimulation = fmi3False;
    *nominalsOfContinuousStatesChanged = fmi3False;
    *valuesOfContinuousStatesChanged = fmi3False;
    *nextEventTimeDefined = fmi3False;
    *nextEventTime = 0.0;
    return fmi3OK;
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance instance)
{
    if (!maplines_may_call(instance, MAPLINES_EVENT, "fmi3EvaluateDiscreteStates"))
    {
        return fmi3Error;
    }
    maplines_fill(instance);
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint,
                      fmi3Float64 communicationStepSize,
                      fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                      fmi3Boolean *eventHandlingNeeded, fmi3Boolean *terminateSimulation,
                      fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime)
{
    maplines_instance_t *own = instance;
    (void)noSetFMUStatePriorToCurrentPoint;
    if (!maplines_may_call(own, MAPLINES_STEP, "fmi3DoStep"))
    {
        return fmi3Error;
    }
    const double end = currentCommunicationPoint + communicationStepSize;
    if (!(communicationStepSize > 0) || !(fabs(end) <= MAX_TIME))
    {
        maplines_log(own, fmi3Error,
                     "a step must be positive and end in [%g, %g] s, got %g s at "
                     "%g s",
                     -MAX_TIME, MAX_TIME, communicationStepSize, currentCommunicationPoint);
        return fmi3Error;
    }
    own->state.now = currentCommunicationPoint;
    const double next = maplines_next_tick(own);
    const double announced = own->state.controller.announced;
    own->state.now = end;
    own->state.is_fresh = false;
    // The importer asks for the time of a tick in the event mode only.
    *eventHandlingNeeded = next < (double)INFINITY && !(next >= announced && next <= announced);
    *terminateSimulation = fmi3False;
    *earlyReturn = fmi3False;
    *lastSuccessfulTime = end;
    return fmi3OK;
}

/* ---- clocks ---------------------------------------------------------------------------------- */

fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                        size_t nValueReferences, const fmi3Clock values[])
{
    maplines_instance_t *own = instance;
    if (!maplines_may_call(own, MAPLINES_EVENT, "fmi3SetClock"))
    {
        return fmi3Error;
    }
    for (size_t i = 0; i < nValueReferences; i++)
    {
        if (valueReferences[i] == MAPLINES_RX_CLOCK)
        {
            own->state.controller.rx_clock = values[i];
        }
        else if (valueReferences[i] == MAPLINES_TX_CLOCK)
        {
            own->state.controller.tx_clock = values[i];
            own->state.controller.is_filled = false;
        }
        else
        {
            maplines_log(own, fmi3Error, "fmi3SetClock: %lu is not a clock",
                         (unsigned long)valueReferences[i]);
            return fmi3Error;
        }
    }
    return fmi3OK;
}

// The type of the values is that of FMI.
fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                        size_t nValueReferences, fmi3Clock values[]) // NOLINT(readability-*)
{
    maplines_instance_t *own = instance;
    (void)values;
    for (size_t i = 0; i < nValueReferences; i++)
    {
        maplines_log(own, fmi3Error, "fmi3GetClock: %lu is not an output clock",
                     (unsigned long)valueReferences[i]);
    }
    return nValueReferences == 0 ? fmi3OK : fmi3Error;
}

/// Time until the next tick of Tx_Clock [s], and whether the importer knows it already.
static fmi3Status ask_interval(maplines_instance_t *own, const char *function,
                               fmi3ValueReference clock, double *interval,
                               fmi3IntervalQualifier *qualifier)
{
    if (!maplines_may_call(own, MAPLINES_INITIALIZATION | MAPLINES_EVENT, function))
    {
        return fmi3Error;
    }
    if (clock != MAPLINES_TX_CLOCK)
    {
        maplines_log(own, fmi3Error, "%s: %lu is not a countdown clock", function,
                     (unsigned long)clock);
        return fmi3Error;
    }
    maplines_controller_t *controller = &own->state.controller;
    const double next =
        own->state.mode == MAPLINES_EVENT ? maplines_next_tick(own) : (double)INFINITY;
    const bool is_known =
        next >= controller->announced && next <= controller->announced; // not if that is NaN
    *qualifier = isnan(controller->announced) ? fmi3IntervalNotYetKnown : fmi3IntervalUnchanged;
    if (next < (double)INFINITY && !is_known)
    {
        *qualifier = fmi3IntervalChanged;
        controller->announced = next;
        controller->interval = fmax(next - own->state.now, 0.0);
    }
    // A tick that was announced comes, though there is nothing to send any more: FMI takes back
    // none. An unchanged interval is the value of the call before.
    *interval = *qualifier == fmi3IntervalNotYetKnown ? 0.0 : controller->interval;
    return fmi3OK;
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                  size_t nValueReferences, fmi3Float64 intervals[],
                                  fmi3IntervalQualifier qualifiers[])
{
    fmi3Status status = fmi3OK;
    for (size_t i = 0; i < nValueReferences && status == fmi3OK; i++)
    {
        status = ask_interval(instance, "fmi3GetIntervalDecimal", valueReferences[i], &intervals[i],
                              &qualifiers[i]);
    }
    return status;
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance instance,
                                   const fmi3ValueReference valueReferences[],
                                   size_t nValueReferences, fmi3UInt64 counters[],
                                   fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[])
{
    fmi3Status status = fmi3OK;
    for (size_t i = 0; i < nValueReferences && status == fmi3OK; i++)
    {
        double interval = 0.0;
        status = ask_interval(instance, "fmi3GetIntervalFraction", valueReferences[i], &interval,
                              &qualifiers[i]);
        counters[i] = (fmi3UInt64)ceil(interval * 1e9);
        resolutions[i] = 1000000000;
    }
    return status;
}

/* ---- states ---------------------------------------------------------------------------------- */

/// What stands before a stored state.
typedef struct {
    char token[MAPLINES_TOKEN_SIZE];
    uint64_t hash;
} stored_t;

/// FNV-1a of the bytes of a state.
static uint64_t hash_of(const fmi3Byte *bytes, size_t size)
{
    uint64_t hash = UINT64_C(0xCBF29CE484222325);
    for (size_t i = 0; i < size; i++)
    {
        hash = (hash ^ bytes[i]) * UINT64_C(0x100000001B3);
    }
    return hash;
}

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *FMUState)
{
    const maplines_instance_t *own = instance;
    maplines_state_t *state = *FMUState == NULL ? malloc(sizeof *state) : *FMUState;
    if (state == NULL)
    {
        maplines_log(own, fmi3Error, "fmi3GetFMUState: there is no memory");
        return fmi3Error;
    }
    memcpy(state, &own->state, sizeof *state);
    *FMUState = state;
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState FMUState)
{
    maplines_instance_t *own = instance;
    if (FMUState == NULL)
    {
        maplines_log(own, fmi3Error, "fmi3SetFMUState: there is no state");
        return fmi3Error;
    }
    memcpy(&own->state, FMUState, sizeof own->state);
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *FMUState)
{
    (void)instance;
    free(*FMUState);
    *FMUState = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState FMUState, size_t *size)
{
    (void)instance;
    (void)FMUState;
    *size = sizeof(stored_t) + sizeof(maplines_state_t);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState FMUState,
                                 fmi3Byte serializedState[], size_t size)
{
    const maplines_instance_t *own = instance;
    const size_t state_size = sizeof(maplines_state_t);
    stored_t stored;
    if (FMUState == NULL || size != sizeof stored + state_size)
    {
        maplines_log(own, fmi3Error, "fmi3SerializeFMUState: no state, or a wrong size");
        return fmi3Error;
    }
    maplines_state_t *state = malloc(state_size);
    if (state == NULL)
    {
        maplines_log(own, fmi3Error, "fmi3SerializeFMUState: there is no memory");
        return fmi3Error;
    }
    memcpy(state, FMUState, state_size);
    maplines_unbind(&state->node);
    memset(&stored, 0, sizeof stored);
    memcpy(stored.token, maplines_token, sizeof stored.token);
    memcpy(serializedState + sizeof stored, state, state_size);
    stored.hash = hash_of(serializedState + sizeof stored, state_size);
    memcpy(serializedState, &stored, sizeof stored);
    free(state);
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte serializedState[],
                                   size_t size, fmi3FMUState *FMUState)
{
    const maplines_instance_t *own = instance;
    const size_t state_size = sizeof(maplines_state_t);
    stored_t stored;
    bool is_own = size == sizeof stored + state_size;
    if (is_own)
    {
        memcpy(&stored, serializedState, sizeof stored);
        is_own = memcmp(stored.token, maplines_token, sizeof stored.token) == 0 &&
                 stored.hash == hash_of(serializedState + sizeof stored, state_size);
    }
    maplines_state_t *state = is_own && *FMUState == NULL ? malloc(state_size) : *FMUState;
    if (!is_own || state == NULL)
    {
        maplines_log(own, fmi3Error, "fmi3DeserializeFMUState: %s",
                     is_own ? "there is no memory" : "these bytes are no state of this FMU");
        return fmi3Error;
    }
    memcpy(state, serializedState + sizeof stored, state_size);
    maplines_bind(&state->node);
    *FMUState = state;
    return fmi3OK;
}
