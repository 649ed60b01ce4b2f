/* A node on a CAN bus as an FMU: FMI 3.0 co-simulation with FMI-LS-BUS 1.0.
 *
 *     fmi3.c         instances, modes, steps and states: the functions of FMI
 *     access.c       its variables: which may be read and set, and when
 *     unsupported.c  functions of FMI that these FMUs do not have
 *     controller.c   the CAN controller of a node: what is received, errors, what is sent
 *     bus.c          the operations that nodes exchange
 *     receiver.c     a node: frames to lines, or
 *     sender.c       a node: lines to frames, at the deadlines of tx_queue.c; its inputs are
 *     line_input.c   lines, or
 *     pose_input.c   a pose, from which it computes the lines of a map along a route
 *
 * `maplines generate fmu` adds variables.h and .c, which list the variables of a node with their
 * start values, as modelDescription.xml does; the C core; the tables of a DBC; the headers of FMI;
 * and names.h, which each source includes first: it gives all global names a prefix.
 *
 * Memory   Only fmi3Instantiate... and fmi3GetFMUState allocate. All that changes is one structure
 *          of constant size, maplines_state_t: a copy of it is the state of an FMU. There is no
 *          static state, so a process may have any number of instances.
 * Time     That of the simulation, in seconds.
 * Clocks   Rx_Clock is triggered. Tx_Clock is a countdown: it is announced when a node will send,
 *          and what it sends is computed when the clock ticks.
 * Errors   What the bus sends is counted. A wrong call is logged, and returns fmi3Error.
 */
#ifndef MAPLINES_FMU_H
#define MAPLINES_FMU_H

#include "bus.h"
#include "fmi3Functions.h"
#include "node.h"
#include "variables.h"

#define MAPLINES_RX_SIZE 32768 ///< room for operations that a node receives at a time [byte]

/// Values of the variables, by type and index: see variables.h.
typedef struct {
    double reals[MAPLINES_REALS];
    int64_t choices[MAPLINES_CHOICES]; ///< values of enumerations
    uint64_t counts[MAPLINES_COUNTS];
    bool flags[MAPLINES_FLAGS];
} maplines_values_t;

/// CAN controller of a node.
typedef struct {
    uint8_t rx[MAPLINES_RX_SIZE];
    size_t rx_size;           ///< [byte]
    bool rx_clock;            ///< ticks now
    bool tx_clock;            ///< ticks now
    bool is_filled;           ///< tx holds all that is sent at this tick
    maplines_operations_t tx; ///< to be sent at the next tick
    double announced;         ///< time of the next tick that the importer knows [s]; NaN: none
    double interval;          ///< with which that was announced [s]
    maplines_can_state_t state;
    uint32_t transmit_errors, receive_errors; ///< the error counters of CAN
} maplines_controller_t;

/// Phase of the life of an instance, one bit each.
typedef enum {
    MAPLINES_INSTANTIATED = 1,
    MAPLINES_INITIALIZATION = 2,
    MAPLINES_EVENT = 4,
    MAPLINES_STEP = 8,
    MAPLINES_TERMINATED = 16,
} maplines_mode_t;

/// All that changes in an instance.
typedef struct {
    maplines_mode_t mode;
    double now;    ///< [s]
    bool is_fresh; ///< the outputs are those of `now`
    maplines_values_t values;
    maplines_controller_t controller;
    maplines_node_t node;
} maplines_state_t;

/// An instance: fmi3Instance points to one.
typedef struct {
    maplines_state_t state;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log; ///< may be NULL
    bool is_logging;            ///< events, too; warnings and errors are always logged
    double *scratch;            ///< maplines_scratch_size() of them; no call leaves anything there
} maplines_instance_t;

/* ---- fmi3.c ---------------------------------------------------------------------------------- */

/// Log a message as of printf.
void maplines_log(const maplines_instance_t *instance, fmi3Status status, const char *format, ...);
/// Whether a function may be called in the mode of the instance; if not, it is logged.
bool maplines_may_call(const maplines_instance_t *instance, unsigned modes, const char *function);

/* ---- controller.c ---------------------------------------------------------------------------- */

/// Start the controller; its configuration is the first that is sent.
void maplines_start_controller(maplines_instance_t *instance);
/// Take what was received at the tick of Rx_Clock.
void maplines_receive(maplines_instance_t *instance);
/// Complete what is sent at this tick of Tx_Clock.
void maplines_fill(maplines_instance_t *instance);
/// Send a frame; false without room, or in the state BUS_OFF.
bool maplines_send(maplines_instance_t *instance, const maplines_frame_t *frame);
/// Time of the next tick of Tx_Clock [s]; infinite if nothing is to be sent.
double maplines_next_tick(maplines_instance_t *instance);
/// Copy the counters of the controller to the outputs.
void maplines_show_controller(maplines_instance_t *instance);

/* ---- receiver.c or sender.c: the node -------------------------------------------------------- */

/// Point to the constant tables, in a state from wherever it comes.
void maplines_bind(maplines_node_t *node);
/// Forget the addresses of this process in a state that is to be stored.
void maplines_unbind(maplines_node_t *node);
/// Start the node with its parameters; NULL, or what is wrong with them.
const char *maplines_start(maplines_instance_t *instance);
/// Number of doubles that the node computes with.
size_t maplines_scratch_size(void);
/// Note that an input is set: that of an index, among those whose first value reference is given.
void maplines_note_input(maplines_node_t *node, fmi3ValueReference first, size_t index);
/// Take inputs that were set at this time.
void maplines_take_inputs(maplines_instance_t *instance);
/// Take a frame from the bus.
void maplines_take_frame(maplines_instance_t *instance, const maplines_frame_t *frame);
/// Take what a bus that notifies says of a frame of this ID: it was acknowledged, or was not sent.
void maplines_take_notification(maplines_instance_t *instance, uint32_t can_id,
                                bool is_acknowledged);
/// Send what is due now.
void maplines_send_due(maplines_instance_t *instance);
/// Time when the node sends next [s]; infinite if there is none.
double maplines_next_due(const maplines_instance_t *instance);
/// Compute the outputs at this time.
void maplines_refresh(maplines_instance_t *instance);

/* ---- sender.c, with line_input.c or pose_input.c ----------------------------------------------
 */

/// Start the inputs of a sender with its parameters; NULL, or what is wrong with them.
const char *maplines_start_input(maplines_instance_t *instance);
/// Note that a line is not sent, and why.
void maplines_refuse(maplines_instance_t *instance, int slot, maplines_refusal_t refusal);

#endif
