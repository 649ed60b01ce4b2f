/* Sender as a node: its state. */
#ifndef MAPLINES_NODE_H
#define MAPLINES_NODE_H

#include "tx_queue.h"

/// Line whose frames are sent one by one, each when the bus has confirmed the one before.
typedef struct {
    maplines_due_t due;
    maplines_frame_t frames[MAPLINES_MAX_PAGES];
    uint32_t counter; ///< of its record
    uint16_t count;   ///< of the frames; 0: no line is sent
    uint16_t next;    ///< frame that is sent, or to be sent
    bool is_waiting;  ///< for the bus to confirm it
} maplines_sending_t;

/// State of a sender.
typedef struct {
    maplines_encoder_t encoder;
    maplines_tx_queue_t queue;
    maplines_sending_t sending;
    uint32_t set;     ///< slots of which an input was set, one bit each; 1 if the pose was
    bool is_on_route; ///< the last pose; of a sender with a map
    uint32_t section; ///< of the route, where it was
    double s;         ///< its position along the path of the route [m]
} maplines_node_t;

#endif
