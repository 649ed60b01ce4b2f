/// A node of a CAN bus for tests of the co-simulation: FMI 3.0 with FMI-LS-BUS 1.0.0, low cut.
/// It sends a frame of 8 bytes each period, and keeps what it received. It needs no headers.

#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { RX_DATA, TX_DATA, RX_CLOCK, TX_CLOCK, NOTIFICATIONS, PERIOD = 10, CAN_ID, GAIN, BIT_RATE };
enum { DISCARD = 14, FAIL_AT, CORRUPT, END_AT, NAME, KIND, RECEIVED = 20, LAST, LAST_AT };
enum { CONFIRMED = 23, LOST, ERRORS, STORE };
enum { OK = 0, ERROR = 3, SIZE = 2048 };

typedef struct {
    double now, next, period, gain, fail_at, end_at, last[8], last_at, store[2];
    uint32_t can_id, bit_rate, received, confirmed, lost, errors;
    bool notifications, discard, corrupt, tx_ticks, rx_ticks, interval_changed;
    int64_t kind;
    char name[32];
    uint8_t tx[SIZE], rx[SIZE];
    size_t tx_size, rx_size;
} Node;

static void put(Node* node, const void* data, size_t size)
{
    memcpy(node->tx + node->tx_size, data, size);
    node->tx_size += size;
}

static void put_u32(Node* node, uint32_t value) { put(node, &value, sizeof(value)); }

static void send_frame(Node* node)
{
    if (node->corrupt) {
        put_u32(node, 0x77);
        put_u32(node, 8);
        return;
    }
    put_u32(node, 0x10);
    put_u32(node, 24);
    put_u32(node, node->can_id);
    put(node, "\0\0\x08\0", 4);
    put(node, &node->gain, 8);
}

static void read_operations(Node* node)
{
    for (size_t at = 0; at + 8 <= node->rx_size;) {
        uint32_t code, length;
        memcpy(&code, node->rx + at, 4);
        memcpy(&length, node->rx + at + 4, 4);
        if (code == 0x10 && length == 24) {
            memmove(node->last + 1, node->last, 7 * sizeof(double));
            memcpy(node->last, node->rx + at + 16, 8);
            node->last_at = node->now;
        }
        node->received += code == 0x10 || code == 0x11;
        node->confirmed += code == 0x20;
        node->lost += code == 0x30;
        node->errors += code == 0x01;
        at += length;
    }
    node->rx_size = 0;
}

const char* fmi3GetVersion(void) { return "3.0"; }

void* fmi3InstantiateCoSimulation(const char* name, const char* token, const char* path, bool visible,
                                  bool log, bool events, bool early, const uint32_t* refs, size_t n,
                                  void* env, void* log_message, void* update)
{
    Node* node = calloc(1, sizeof(Node));
    (void)name, (void)path, (void)visible, (void)log, (void)early, (void)refs, (void)n, (void)env;
    (void)log_message, (void)update;
    if (strcmp(token, "test-node") != 0 || !events) {
        free(node);
        return NULL;
    }
    node->period = 0.1;
    node->can_id = 0x123;
    node->fail_at = node->end_at = 1e9;
    node->interval_changed = true;
    return node;
}

void fmi3FreeInstance(Node* node) { free(node); }

int fmi3ExitInitializationMode(Node* node)
{
    node->next = node->period;
    if (node->bit_rate != 0) {
        put_u32(node, 0x40);
        put_u32(node, 13);
        put(node, "\x01", 1);
        put_u32(node, node->bit_rate);
        put_u32(node, 0x40);
        put_u32(node, 10);
        put(node, node->discard ? "\x04\x02" : "\x04\x01", 2);
        node->tx_ticks = true;
    }
    return OK;
}

int fmi3DoStep(Node* node, double now, double step, bool no_state, bool* events, bool* end,
               bool* early, double* last)
{
    (void)no_state;
    node->now = now + step;
    *end = node->now >= node->end_at;
    *early = false;
    *last = node->now;
    // The step may be a little too short by rounding.
    while (node->next <= node->now + 1e-9) {
        send_frame(node);
        node->next += node->period;
        node->interval_changed = true;
    }
    *events = node->tx_ticks = node->tx_size > 0;
    return node->now >= node->fail_at ? ERROR : OK;
}

int fmi3UpdateDiscreteStates(Node* node, bool* again, bool* end, bool* nominals, bool* states,
                             bool* next_defined, double* next)
{
    if (node->rx_ticks) {
        read_operations(node);
    }
    node->rx_ticks = node->tx_ticks = false;
    *again = *end = *nominals = *states = *next_defined = false;
    *next = 0.0;
    return OK;
}

int fmi3GetIntervalDecimal(Node* node, const uint32_t* refs, size_t n, double* intervals, int* kinds)
{
    (void)refs;
    for (size_t i = 0; i < n; i++) {
        intervals[i] = node->tx_size > 0 ? 0.0 : node->next - node->now;
        kinds[i] = node->interval_changed ? 2 : 1;
    }
    node->interval_changed = false;
    return OK;
}

int fmi3GetIntervalFraction(Node* node, const uint32_t* refs, size_t n, uint64_t* counters,
                            uint64_t* resolutions, int* kinds)
{
    double interval;
    (void)n;
    fmi3GetIntervalDecimal(node, refs, 1, &interval, kinds);
    counters[0] = (uint64_t)(interval * 1e9 + 0.5);
    resolutions[0] = 1000000000;
    return OK;
}

int fmi3GetBinary(Node* node, const uint32_t* refs, size_t n, size_t* sizes, uint8_t** values, size_t m)
{
    (void)refs, (void)n, (void)m;
    values[0] = node->tx;
    sizes[0] = node->tx_size;
    node->tx_size = 0;
    return OK;
}

int fmi3SetBinary(Node* node, const uint32_t* refs, size_t n, const size_t* sizes,
                  const uint8_t* const* values, size_t m)
{
    (void)n, (void)m;
    if (refs[0] != RX_DATA || !node->rx_ticks || sizes[0] > SIZE) {
        return ERROR;
    }
    memcpy(node->rx, values[0], sizes[0]);
    node->rx_size = sizes[0];
    return OK;
}

int fmi3GetClock(Node* node, const uint32_t* refs, size_t n, bool* values)
{
    (void)refs, (void)n;
    values[0] = node->tx_ticks;
    node->tx_ticks = false;
    return OK;
}

int fmi3SetClock(Node* node, const uint32_t* refs, size_t n, const bool* values)
{
    for (size_t i = 0; i < n; i++) {
        if (refs[i] == RX_CLOCK) {
            node->rx_ticks = values[i];
        }
    }
    return OK;
}

static void* place_of(Node* node, uint32_t reference)
{
    switch (reference) {
    case NOTIFICATIONS: return &node->notifications;
    case PERIOD: return &node->period;
    case CAN_ID: return &node->can_id;
    case GAIN: return &node->gain;
    case BIT_RATE: return &node->bit_rate;
    case DISCARD: return &node->discard;
    case FAIL_AT: return &node->fail_at;
    case CORRUPT: return &node->corrupt;
    case END_AT: return &node->end_at;
    case KIND: return &node->kind;
    case RECEIVED: return &node->received;
    case LAST: return node->last;
    case LAST_AT: return &node->last_at;
    case CONFIRMED: return &node->confirmed;
    case LOST: return &node->lost;
    case ERRORS: return &node->errors;
    case STORE: return node->store;
    default: return NULL;
    }
}

static size_t size_of(uint32_t reference)
{
    return reference == LAST || reference == STORE ? 2 : 1;
}

#define ACCESS(Type, ctype)                                                                        \
    int fmi3Get##Type(Node* node, const uint32_t* refs, size_t n, ctype* values, size_t m)         \
    {                                                                                              \
        size_t at = 0;                                                                             \
        for (size_t i = 0; i < n; at += size_of(refs[i++])) {                                      \
            void* place = place_of(node, refs[i]);                                                 \
            if (place == NULL || at + size_of(refs[i]) > m) {                                      \
                return ERROR;                                                                      \
            }                                                                                      \
            memcpy(values + at, place, size_of(refs[i]) * sizeof(ctype));                          \
        }                                                                                          \
        return at == m ? OK : ERROR;                                                               \
    }                                                                                              \
    int fmi3Set##Type(Node* node, const uint32_t* refs, size_t n, const ctype* values, size_t m)   \
    {                                                                                              \
        void* place = place_of(node, refs[0]);                                                     \
        if (n != 1 || place == NULL || m != size_of(refs[0])) {                                    \
            return ERROR;                                                                          \
        }                                                                                          \
        memcpy(place, values, m * sizeof(ctype));                                                  \
        return OK;                                                                                 \
    }
ACCESS(Float64, double)
ACCESS(UInt32, uint32_t)
ACCESS(Int64, int64_t)
ACCESS(Boolean, bool)

int fmi3GetString(Node* node, const uint32_t* refs, size_t n, const char** values, size_t m)
{
    (void)refs, (void)n, (void)m;
    values[0] = node->name;
    return OK;
}

int fmi3SetString(Node* node, const uint32_t* refs, size_t n, const char** values, size_t m)
{
    (void)refs, (void)n, (void)m;
    strncpy(node->name, values[0], sizeof(node->name) - 1);
    return OK;
}

#define ALLOWED(name) int fmi3##name(void) { return OK; }
ALLOWED(EnterInitializationMode) ALLOWED(EnterEventMode) ALLOWED(EnterStepMode) ALLOWED(Terminate)
ALLOWED(EnterConfigurationMode) ALLOWED(ExitConfigurationMode)

// fmpy loads all functions of FMI 3.0.
#define REFUSED(name) int fmi3##name(void) { return ERROR; }
REFUSED(ActivateModelPartition) REFUSED(CompletedIntegratorStep) REFUSED(DeserializeFMUState)
REFUSED(EnterContinuousTimeMode) REFUSED(EvaluateDiscreteStates) REFUSED(FreeFMUState)
REFUSED(GetAdjointDerivative) REFUSED(GetContinuousStateDerivatives) REFUSED(GetContinuousStates)
REFUSED(GetDirectionalDerivative) REFUSED(GetEventIndicators) REFUSED(GetFMUState)
REFUSED(GetFloat32) REFUSED(GetInt16) REFUSED(GetInt32) REFUSED(GetInt8)
REFUSED(GetNominalsOfContinuousStates) REFUSED(GetNumberOfContinuousStates)
REFUSED(GetNumberOfEventIndicators) REFUSED(GetNumberOfVariableDependencies)
REFUSED(GetOutputDerivatives) REFUSED(GetShiftDecimal) REFUSED(GetShiftFraction) REFUSED(GetUInt16)
REFUSED(GetUInt64) REFUSED(GetUInt8) REFUSED(GetVariableDependencies)
REFUSED(InstantiateModelExchange) REFUSED(InstantiateScheduledExecution) REFUSED(Reset)
REFUSED(SerializeFMUState) REFUSED(SerializedFMUStateSize) REFUSED(SetContinuousStates)
REFUSED(SetDebugLogging) REFUSED(SetFMUState) REFUSED(SetFloat32) REFUSED(SetInt16)
REFUSED(SetInt32) REFUSED(SetInt8) REFUSED(SetIntervalDecimal) REFUSED(SetIntervalFraction)
REFUSED(SetShiftDecimal) REFUSED(SetShiftFraction) REFUSED(SetTime) REFUSED(SetUInt16)
REFUSED(SetUInt64) REFUSED(SetUInt8)
