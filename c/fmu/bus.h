/* Bus operations of FMI-LS-BUS 1.0 for CAN: the binary values that nodes exchange.
 *
 *     operation   code (4) | length of all (4) | arguments            integers: lowest byte first
 *     CAN         0x10 | 16 + n | id (4) | extended (1) | remote (1) | n (2) | data (n)
 *                 of a remote frame also 0x10 | 16 | ... | n (2), without data
 *     CAN FD      0x11 | 17 + n | id (4) | extended (1) | rate switch (1) | error state (1) | n (2)
 *                               | data (n)
 *
 * A value holds any number of operations, one after the other. Whatever a value holds, reading it
 * ends, and reads nothing outside.
 */
#ifndef MAPLINES_BUS_H
#define MAPLINES_BUS_H

#include "maplines.h"

#define MAPLINES_OPERATION_HEADER 8 ///< [byte]
#define MAPLINES_TX_SIZE 8192       ///< room for operations that a node sends at a time [byte]

/// What an operation is.
typedef enum {
    MAPLINES_FORMAT_ERROR = 0x01, ///< a participant has received a malformed operation
    MAPLINES_TRANSMIT = 0x10,
    MAPLINES_TRANSMIT_FD = 0x11,
    MAPLINES_TRANSMIT_XL = 0x12,
    MAPLINES_CONFIRM = 0x20, ///< a frame was acknowledged
    MAPLINES_ARBITRATION_LOST = 0x30,
    MAPLINES_BUS_ERROR = 0x31,
    MAPLINES_CONFIGURATION = 0x40,
    MAPLINES_STATUS = 0x41,
    MAPLINES_WAKEUP = 0x42,
} maplines_code_t;

/// Parameter that a configuration sets.
typedef enum {
    MAPLINES_CAN_RATE = 1, ///< [bit/s]
    MAPLINES_FD_RATE = 2,  ///< [bit/s]
    MAPLINES_XL_RATE = 3,  ///< [bit/s]
    MAPLINES_ON_ARBITRATION_LOST = 4,
} maplines_parameter_t;

/// What a bus does with a frame that has lost the arbitration.
typedef enum {
    MAPLINES_RETRANSMIT = 1, ///< it keeps the frame, and sends it later
    MAPLINES_NOTIFY = 2,     ///< it drops the frame, and tells the node
} maplines_arbitration_t;

/// State of a CAN controller, as a status says it.
typedef enum {
    MAPLINES_ERROR_ACTIVE = 1,
    MAPLINES_ERROR_PASSIVE = 2,
    MAPLINES_BUS_OFF = 3,
} maplines_can_state_t;

/// One operation that was read.
typedef struct {
    maplines_code_t code;
    maplines_frame_t frame; ///< of transmissions of CAN and CAN FD
    bool is_remote;         ///< a remote frame; its length is that which it asks for
    uint32_t can_id;        ///< of a confirmation, a lost arbitration or a bus error
    bool is_primary;        ///< of a bus error: this node detected it
    bool is_sender;         ///< of a bus error: of a frame of this node
    const uint8_t *bytes;   ///< of the whole operation
    size_t length;          ///< [byte]
} maplines_operation_t;

/// Result of reading an operation.
typedef enum {
    MAPLINES_READ = 0,
    MAPLINES_END = 1,       ///< there are no more
    MAPLINES_MALFORMED = 2, ///< of `operation`, only bytes and length are set
} maplines_reading_t;

/// Operations to be sent.
typedef struct {
    uint8_t bytes[MAPLINES_TX_SIZE];
    size_t size;
} maplines_operations_t;

/// Read the next operation of a value, from byte `*at` on, and advance `*at`. A malformed one is
/// skipped; if its length is wrong, so is all that follows.
maplines_reading_t maplines_read_operation(const uint8_t *bytes, size_t size, size_t *at,
                                           maplines_operation_t *operation);

/* Append an operation; false, and nothing is appended, if there is no room. */

bool maplines_write_frame(maplines_operations_t *operations, const maplines_frame_t *frame);
bool maplines_write_rate(maplines_operations_t *operations, maplines_parameter_t parameter,
                         uint32_t bits_per_s);
bool maplines_write_arbitration(maplines_operations_t *operations, maplines_arbitration_t what);
bool maplines_write_status(maplines_operations_t *operations, maplines_can_state_t status);
/// `bytes` are those of the operation that was malformed.
bool maplines_write_format_error(maplines_operations_t *operations, const uint8_t *bytes,
                                 size_t length);

#endif
