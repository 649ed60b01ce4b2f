/* A node of an FMU with any bytes on its bus, for the sanitizers: each line of the input is a value
 * of Rx_Data in hexadecimal digits. All variables are read after each, and the state is saved,
 * stored and restored. Printed are the number of bytes that the node sends, and a hash of these and
 * of its real variables: it is the same on each platform.
 */
#include "names.h"

#include "fmu.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define STEP 0.00625 /* [s] */

static void print_message(fmi3InstanceEnvironment environment, fmi3Status status,
                          fmi3String category, fmi3String message)
{
    (void)environment;
    (void)category;
    if (status == fmi3Error)
    {
        printf("error: %s\n", message);
    }
}

/// Exit if a function of FMI has failed.
static void check(fmi3Status status)
{
    if (status != fmi3OK)
    {
        exit(EXIT_FAILURE);
    }
}

static void update(fmi3Instance node)
{
    fmi3Boolean flags[5];
    fmi3Float64 next;
    check(fmi3UpdateDiscreteStates(node, &flags[0], &flags[1], &flags[2], &flags[3], &flags[4],
                                   &next));
}

/// FNV-1a of bytes, after others.
static uint64_t hash_more(uint64_t hash, const void *bytes, size_t size)
{
    const uint8_t *byte = bytes;
    for (size_t i = 0; i < size; i++)
    {
        hash = (hash ^ byte[i]) * UINT64_C(0x100000001B3);
    }
    return hash;
}

/// Let Tx_Clock tick; the number of bytes that are sent.
static size_t tick(fmi3Instance node, uint64_t *hash)
{
    const fmi3ValueReference clock = MAPLINES_TX_CLOCK;
    const fmi3ValueReference data = MAPLINES_TX_DATA;
    const fmi3Clock active = true;
    fmi3Binary value = NULL;
    size_t size = 0;
    fmi3Float64 interval = 0;
    fmi3IntervalQualifier qualifier = fmi3IntervalNotYetKnown;
    check(fmi3GetIntervalDecimal(node, &clock, 1, &interval, &qualifier));
    check(fmi3SetClock(node, &clock, 1, &active));
    check(fmi3GetBinary(node, &data, 1, &size, &value, 1));
    *hash = hash_more(*hash, value, size);
    update(node);
    return size;
}

static void receive(fmi3Instance node, const fmi3Byte *bytes, size_t size)
{
    const fmi3ValueReference clock = MAPLINES_RX_CLOCK;
    const fmi3ValueReference data = MAPLINES_RX_DATA;
    const fmi3Clock active = true;
    check(fmi3SetBinary(node, &data, 1, &size, &bytes, 1));
    check(fmi3SetClock(node, &clock, 1, &active));
    update(node);
}

/// Read all variables; publish all that are inputs again, and make all slots valid.
static void touch(fmi3Instance node, uint64_t *hash)
{
    for (fmi3ValueReference i = 0; i < MAPLINES_REALS; i++)
    {
        const fmi3ValueReference reference = MAPLINES_FIRST_REAL + i;
        fmi3Float64 value = 0;
        check(fmi3GetFloat64(node, &reference, 1, &value, 1));
        *hash = hash_more(*hash, &value, sizeof value);
        if (i >= MAPLINES_TUNABLE_REALS && i < MAPLINES_SETTABLE_REALS)
        {
            value += 1e-3;
            check(fmi3SetFloat64(node, &reference, 1, &value, 1));
        }
    }
    for (fmi3ValueReference i = 0; i < MAPLINES_CHOICES; i++)
    {
        const fmi3ValueReference reference = MAPLINES_FIRST_CHOICE + i;
        fmi3Int64 value = 0;
        check(fmi3GetInt64(node, &reference, 1, &value, 1));
    }
    for (fmi3ValueReference i = 0; i < MAPLINES_COUNTS; i++)
    {
        const fmi3ValueReference reference = MAPLINES_FIRST_COUNT + i;
        fmi3UInt64 value = 0;
        check(fmi3GetUInt64(node, &reference, 1, &value, 1));
    }
    for (fmi3ValueReference i = 0; i < MAPLINES_FLAGS; i++)
    {
        const fmi3ValueReference reference = MAPLINES_FIRST_FLAG + i;
        fmi3Boolean value = true;
        if (i >= MAPLINES_TUNABLE_FLAGS && i < MAPLINES_SETTABLE_FLAGS)
        {
            check(fmi3SetBoolean(node, &reference, 1, &value, 1));
        }
        check(fmi3GetBoolean(node, &reference, 1, &value, 1));
    }
}

/// Replace the state by what was stored of it.
static void store(fmi3Instance node)
{
    fmi3FMUState state = NULL;
    fmi3FMUState restored = NULL;
    size_t size = 0;
    check(fmi3GetFMUState(node, &state));
    check(fmi3SerializedFMUStateSize(node, state, &size));
    fmi3Byte *bytes = malloc(size);
    check(bytes == NULL ? fmi3Error : fmi3OK);
    check(fmi3SerializeFMUState(node, state, bytes, size));
    check(fmi3DeserializeFMUState(node, bytes, size, &restored));
    check(fmi3SetFMUState(node, restored));
    check(fmi3FreeFMUState(node, &state));
    check(fmi3FreeFMUState(node, &restored));
    free(bytes);
}

/// Bytes of a row of hexadecimal digits.
static size_t read_bytes(const char *row, fmi3Byte *bytes, size_t room)
{
    size_t size = 0;
    unsigned value = 0;
    while (size < room && sscanf(row + 2 * size, "%2x", &value) == 1)
    {
        bytes[size++] = (fmi3Byte)value;
    }
    return size;
}

int main(void)
{
    static char row[2 * MAPLINES_RX_SIZE + 2];
    static fmi3Byte bytes[MAPLINES_RX_SIZE];
    const fmi3ValueReference notifications = MAPLINES_FIRST_FLAG + FLAG_BUS_NOTIFICATIONS;
    const fmi3Boolean is_notified = true;
    size_t sent = 0;
    uint64_t hash = 0;
    double now = 0;
    fmi3Boolean flags[3];
    fmi3Instance node = fmi3InstantiateCoSimulation("node", maplines_token, "", false, false, true,
                                                    false, NULL, 0, NULL, print_message, NULL);
    check(node == NULL ? fmi3Error : fmi3OK);
    check(fmi3SetBoolean(node, &notifications, 1, &is_notified, 1));
    check(fmi3EnterInitializationMode(node, false, 0, 0, false, 0));
    check(fmi3ExitInitializationMode(node));
    while (fgets(row, sizeof row, stdin) != NULL)
    {
        const size_t size = read_bytes(row, bytes, sizeof bytes);
        fmi3Byte *exact = malloc(size + 1); // so that a sanitizer sees what is read behind it
        check(exact == NULL ? fmi3Error : fmi3OK);
        memcpy(exact, bytes, size);
        sent += tick(node, &hash);
        receive(node, exact, size);
        free(exact);
        touch(node, &hash);
        store(node);
        check(fmi3EnterStepMode(node));
        check(fmi3DoStep(node, now, STEP, true, &flags[0], &flags[1], &flags[2], &now));
        check(fmi3EnterEventMode(node));
    }
    check(fmi3Terminate(node));
    fmi3FreeInstance(node);
    printf("%lu %08lx%08lx\n", (unsigned long)sent, (unsigned long)(hash >> 32),
           (unsigned long)(hash & 0xFFFFFFFFU));
    return EXIT_SUCCESS;
}
