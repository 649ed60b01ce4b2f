/* The core as a shared library: what the Python package calls, beside maplines.h.
 *
 * These functions loop over arrays, and own memory where maplines.h leaves that to the caller. The
 * Python package declares them to itself from this file, and checks their arguments: sizes fit, and
 * arrays are in C order. Nothing here is known to an ECU.
 *
 * Threads  All functions may run at once in any threads: they share nothing that they write to.
 * Errors   A function returns false or NULL where its text says so, and never writes beyond the
 *          sizes that it is given.
 */
#ifndef MAPLINES_CORE_H
#define MAPLINES_CORE_H

#include "maplines.h"

#ifdef __GNUC__
#pragma GCC visibility push(default)
#endif

/* ---- tables.c: what both sides agree on -------------------------------------------------------
 */

/// Version of the sources.
const char *maplines_core_version(void);
/// Size of maplines_dbc_t.
size_t maplines_core_size(void);
/// Whether tables are those of a DBC: no signal, page or index is beyond its record.
bool maplines_check_tables(const maplines_dbc_t *dbc);

/* ---- batch.c: complete records, and back ------------------------------------------------------
 */

/* Values beside mean and covariance are rows of two arrays:
 *
 *   integers (5, n)  counter, kind, status, component index and count
 *   reals (4, n)     component weight, start and end of the valid range [m], age [s]
 */

/// Whether all of n Gaussians may be sent: as checked_gaussians of layout/validation.py. It sets
/// `symmetric` (n, 4, 4) and `indefinite`.
bool maplines_check_gaussians(size_t n, const double *mean, const double *cov, double *symmetric,
                              uint8_t *indefinite);
/// Write n records of lines whose values were checked: as CompleteWriter.write. `powers` are those
/// of 2 of all values of the pivots, by row, and of the inflation, each from the least raw value
/// on; `cover` (n, 4, 4), or NULL, is what the decoded covariances must cover besides.
void maplines_encode_lines(const maplines_dbc_t *dbc, const double *const powers[5], size_t n,
                           const double *mean, const double *cov, const double *cover,
                           const uint8_t *indefinite, const int64_t *slot, const int64_t *integers,
                           const double *reals, uint8_t *records);
/// Decoded weights (n, k) of mixtures, and the deficit (n, 4, 4) that they leave. False if there
/// are more components than the core can hold.
bool maplines_cover_mixtures(const maplines_dbc_t *dbc, size_t n, size_t k, int64_t steps,
                             const double *weights, const double *means, const double *covs,
                             double *decoded, double *cover);
/// Read n records: as CompleteFormat.read. The last of the powers are those of the square roots of
/// the inflation; verdicts are indices of VERDICTS of records/packer.py.
void maplines_decode_lines(const maplines_dbc_t *dbc, const double *const powers[5], size_t n,
                           const uint8_t *records, const uint16_t *data_ids, double *mean,
                           double *cov, int8_t *verdict, int64_t *integers, double *reals);

#ifdef __GNUC__
#pragma GCC visibility pop
#endif

#endif
