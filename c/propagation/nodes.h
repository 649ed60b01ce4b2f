/* Matrices from values at the nodes of fits to the coefficients, and the nodes of coarse fits. */
#ifndef MAPLINES_PROPAGATION_NODES_H
#define MAPLINES_PROPAGATION_NODES_H

#include "propagation.h"

#define MAPLINES_COARSE 32 ///< nodes of a fit in the search for the longest range

/// Rows: from the values at maplines_nodes to the coefficients of w^0 .. w^3.
extern const double maplines_fit_rows[4 * MAPLINES_NODES];
/// From the values at the nodes to the coefficient of T_4.
extern const double maplines_quartic_row[MAPLINES_NODES];
/// Extrema of a Chebyshev polynomial of lower degree, and the rows of their fit.
extern const double maplines_coarse_nodes[MAPLINES_COARSE];
extern const double maplines_coarse_rows[4 * MAPLINES_COARSE];

#endif
