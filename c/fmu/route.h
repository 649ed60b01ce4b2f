/* Lines of a map along a route, which `maplines generate fmu sender --map` writes into route.c. */
#ifndef MAPLINES_ROUTE_H
#define MAPLINES_ROUTE_H

#include "propagation.h"

#define MAPLINES_ROUTE_BEHIND 60.0 ///< reach of the lines behind and ahead of their section [m]
#define MAPLINES_ROUTE_AHEAD 150.0

/// Line of a section: points of the pool that follow each other.
typedef struct {
    uint32_t first, count;
    maplines_owner_t slot;
    maplines_kind_t kind;
} maplines_route_line_t;

/// Part of the route in which the slots have the same lines: a lane, or a part of one.
typedef struct {
    double start;          ///< position along the path [m]
    uint32_t first, count; ///< its lines
} maplines_route_section_t;

/// A route.
typedef struct {
    const double (*points)[2]; ///< pool of the points of lines [m]
    const maplines_route_line_t *lines;
    const maplines_route_section_t *sections;
    size_t section_count;    ///< 1 or more
    size_t most_points;      ///< of the lines of a section
    const double (*path)[2]; ///< points of the route [m]
    const double *distance;  ///< position of each along the path [m]
    size_t path_count;       ///< 2 or more
    maplines_rule_t rule;    ///< points of the transform of a pose
} maplines_route_t;

extern const maplines_route_t maplines_route;

#endif
