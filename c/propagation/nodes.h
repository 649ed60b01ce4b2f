/* Matrices from the means of a line in cells of a range to its cubic. */
#ifndef MAPLINES_PROPAGATION_NODES_H
#define MAPLINES_PROPAGATION_NODES_H

#include "propagation.h"

#define MAPLINES_COARSE 16 ///< cells of a range in the search for the longest one
#define MAPLINES_TERMS 6   ///< of a fit: w^0 .. w^3, and T_4 and T_5 of what these leave

/// Share of the mean in each cell in the coefficient of each term.
extern const double maplines_cell_rows[MAPLINES_CELLS][MAPLINES_TERMS];
extern const double maplines_coarse_rows[MAPLINES_COARSE][MAPLINES_TERMS];
/// What a cubic leaves of T_4 at maplines_nodes.
extern const double maplines_bend[MAPLINES_NODES];

#endif
