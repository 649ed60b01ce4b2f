/* Receiver as a node: its state. */
#ifndef MAPLINES_NODE_H
#define MAPLINES_NODE_H

#include "maplines.h"

/// State of a receiver.
typedef struct {
    maplines_decoder_t decoder;
} maplines_node_t;

#endif
