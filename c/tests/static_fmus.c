/* Two source FMUs in one program: a sender, whose names have the prefix of its own, and a receiver,
 * whose prefix the build states. Arguments are the instantiation tokens of both, the references of
 * the sender's EGO_LEFT.valid, .mean[1], .cov[1,1], .cov[2,2], .cov[3,3], .cov[4,4] and .x_max, and
 * of the receiver's EGO_LEFT.y[1] and .usable. The last two are printed after a second.
 */
#include "fmi3FunctionTypes.h"

#include <stdio.h>
#include <stdlib.h>

#define TX_CLOCK 4
#define TX_DATA 2
#define RX_CLOCK 3
#define RX_DATA 1
#define STEP 0.0125 /* [s] */

typedef struct {
    fmi3InstantiateCoSimulationTYPE *instantiate;
    fmi3EnterInitializationModeTYPE *enter_initialization;
    fmi3ExitInitializationModeTYPE *exit_initialization;
    fmi3EnterEventModeTYPE *enter_event;
    fmi3EnterStepModeTYPE *enter_step;
    fmi3DoStepTYPE *step;
    fmi3UpdateDiscreteStatesTYPE *update;
    fmi3GetIntervalDecimalTYPE *interval;
    fmi3SetClockTYPE *set_clock;
    fmi3GetBinaryTYPE *get_binary;
    fmi3SetBinaryTYPE *set_binary;
    fmi3SetBooleanTYPE *set_boolean;
    fmi3GetBooleanTYPE *get_boolean;
    fmi3SetFloat64TYPE *set_real;
    fmi3GetFloat64TYPE *get_real;
    fmi3FreeInstanceTYPE *end;
} node_t;

#define NODE(name, prefix)                                                                         \
    extern fmi3InstantiateCoSimulationTYPE prefix##fmi3InstantiateCoSimulation;                    \
    extern fmi3EnterInitializationModeTYPE prefix##fmi3EnterInitializationMode;                    \
    extern fmi3ExitInitializationModeTYPE prefix##fmi3ExitInitializationMode;                      \
    extern fmi3EnterEventModeTYPE prefix##fmi3EnterEventMode;                                      \
    extern fmi3EnterStepModeTYPE prefix##fmi3EnterStepMode;                                        \
    extern fmi3DoStepTYPE prefix##fmi3DoStep;                                                      \
    extern fmi3UpdateDiscreteStatesTYPE prefix##fmi3UpdateDiscreteStates;                          \
    extern fmi3GetIntervalDecimalTYPE prefix##fmi3GetIntervalDecimal;                              \
    extern fmi3SetClockTYPE prefix##fmi3SetClock;                                                  \
    extern fmi3GetBinaryTYPE prefix##fmi3GetBinary;                                                \
    extern fmi3SetBinaryTYPE prefix##fmi3SetBinary;                                                \
    extern fmi3SetBooleanTYPE prefix##fmi3SetBoolean;                                              \
    extern fmi3GetBooleanTYPE prefix##fmi3GetBoolean;                                              \
    extern fmi3SetFloat64TYPE prefix##fmi3SetFloat64;                                              \
    extern fmi3GetFloat64TYPE prefix##fmi3GetFloat64;                                              \
    extern fmi3FreeInstanceTYPE prefix##fmi3FreeInstance;                                          \
    static const node_t name = {                                                                   \
        prefix##fmi3InstantiateCoSimulation,                                                       \
        prefix##fmi3EnterInitializationMode,                                                       \
        prefix##fmi3ExitInitializationMode,                                                        \
        prefix##fmi3EnterEventMode,                                                                \
        prefix##fmi3EnterStepMode,                                                                 \
        prefix##fmi3DoStep,                                                                        \
        prefix##fmi3UpdateDiscreteStates,                                                          \
        prefix##fmi3GetIntervalDecimal,                                                            \
        prefix##fmi3SetClock,                                                                      \
        prefix##fmi3GetBinary,                                                                     \
        prefix##fmi3SetBinary,                                                                     \
        prefix##fmi3SetBoolean,                                                                    \
        prefix##fmi3GetBoolean,                                                                    \
        prefix##fmi3SetFloat64,                                                                    \
        prefix##fmi3GetFloat64,                                                                    \
        prefix##fmi3FreeInstance,                                                                  \
    }

NODE(sender, maplines_sender_);
NODE(receiver, stated_);

/// Exit if a function of FMI has failed.
static void check(fmi3Status status)
{
    if (status != fmi3OK)
    {
        exit(EXIT_FAILURE);
    }
}

static fmi3Instance start(const node_t *node, const char *token)
{
    fmi3Instance instance =
        node->instantiate("node", token, "", false, false, true, false, NULL, 0, NULL, NULL, NULL);
    check(instance == NULL ? fmi3Error : fmi3OK);
    check(node->enter_initialization(instance, false, 0, 0, false, 0));
    check(node->exit_initialization(instance));
    return instance;
}

static void update(const node_t *node, fmi3Instance instance)
{
    fmi3Boolean flags[5];
    fmi3Float64 next;
    check(node->update(instance, &flags[0], &flags[1], &flags[2], &flags[3], &flags[4], &next));
}

static void step(const node_t *node, fmi3Instance instance, double now)
{
    fmi3Boolean flags[3];
    check(node->enter_step(instance));
    check(node->step(instance, now, STEP, true, &flags[0], &flags[1], &flags[2], &now));
    check(node->enter_event(instance));
}

int main(int count, char **words)
{
    const double values[] = {1.75, 0.01, 1e-6, 1e-8, 1e-12, 80.0};
    const fmi3Boolean is_valid = true;
    const fmi3Clock active = true;
    fmi3ValueReference references[9];
    check(count == 12 ? fmi3OK : fmi3Error);
    for (int i = 0; i < 9; i++)
    {
        references[i] = (fmi3ValueReference)strtoul(words[i + 3], NULL, 10);
    }
    const fmi3ValueReference clocks[] = {RX_CLOCK, TX_CLOCK};
    const fmi3ValueReference data[] = {RX_DATA, TX_DATA};
    fmi3Instance from = start(&sender, words[1]);
    fmi3Instance to = start(&receiver, words[2]);
    for (int i = 0; i < 80; i++)
    {
        fmi3Binary bytes = NULL;
        size_t size = 0;
        fmi3Float64 interval = 0;
        fmi3IntervalQualifier qualifier = fmi3IntervalNotYetKnown;
        if (i % 4 == 0) // a new line
        {
            check(sender.set_boolean(from, &references[0], 1, &is_valid, 1));
            check(sender.set_real(from, &references[1], 6, values, 6));
        }
        check(sender.interval(from, &clocks[1], 1, &interval, &qualifier));
        check(sender.set_clock(from, &clocks[1], 1, &active));
        check(sender.get_binary(from, &data[1], 1, &size, &bytes, 1));
        check(receiver.set_binary(to, &data[0], 1, &size, &bytes, 1));
        check(receiver.set_clock(to, &clocks[0], 1, &active));
        update(&sender, from);
        update(&receiver, to);
        step(&sender, from, i * STEP);
        step(&receiver, to, i * STEP);
    }
    fmi3Float64 y = 0;
    fmi3Boolean is_usable = false;
    check(receiver.get_real(to, &references[7], 1, &y, 1));
    check(receiver.get_boolean(to, &references[8], 1, &is_usable, 1));
    printf("%.2f %d\n", y, is_usable);
    sender.end(from);
    receiver.end(to);
    return EXIT_SUCCESS;
}
