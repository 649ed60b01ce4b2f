/* Matrices from the means of a line in cells of a range to its cubic. */
#ifndef MAPLINES_PROPAGATION_NODES_H
#define MAPLINES_PROPAGATION_NODES_H

#include "propagation.h"

#define MAPLINES_COARSE 16 ///< cells of a range in the search for the longest one

/// Share of the mean in each cell in the coefficient of each term.
extern const double maplines_cell_rows[MAPLINES_CELLS][MAPLINES_TERMS];
/// Nodes of a range: the extrema of a Chebyshev polynomial, from -1 to 1.
extern const double maplines_nodes[MAPLINES_NODES];
/// What a cubic leaves of T_4 at these.
extern const double maplines_bend[MAPLINES_NODES];
/// Set the coefficients of the terms of cells, whose number is MAPLINES_CELLS or MAPLINES_COARSE.
void maplines_set_terms(int count, maplines_cells_t *cells);

#endif
