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

/* ---- text_logs.c, blf_log.c: the ordinary records of logs -------------------------------------
 */

#define MAPLINES_LOG_DATA 64      // bytes of data of a frame
#define MAPLINES_LOG_CHANNELS 256 // of a log
#define MAPLINES_LOG_NAME 64      // characters of the name of a channel

/// Reader of a log: the frames of one call, and what it knows from one call to the next.
typedef struct {
    size_t capacity;      ///< of the arrays [frame]
    uint32_t *can_id;     ///< of each frame
    uint8_t *is_extended; ///< 0 or 1
    int64_t *t_ns;
    uint16_t *channel; ///< index in `names`
    uint8_t *length;   ///< bytes of data
    uint8_t *data;     ///< `MAPLINES_LOG_DATA` bytes of each frame, zero from its length on
    size_t frames;     ///< of the last call
    size_t rows;       ///< of text, of the last call
    size_t skipped[5]; ///< objects of BLF that are no frames, of the last call, by kind
    int32_t times;     ///< kind of the stamps: 0 absolute, 1 from the start, 2 differences
    int64_t sum;       ///< of the stamps [ns]
    int64_t high;      ///< highest stamp of the recording [ns]
    size_t channels;   ///< number of `names`
    size_t last;       ///< channel of the last frame
    uint32_t number;   ///< of that channel, from 1; 0 if it was found by its name
    char names[MAPLINES_LOG_CHANNELS][MAPLINES_LOG_NAME + 1];
} maplines_log_t;

/* Each reads records up to one that is not of its ordinary form, which is for the reader that
 * knows all forms and what is an error, and returns the place of that record: the number of bytes
 * that were read. */

/// Read rows of candump -L.
size_t maplines_parse_candump(maplines_log_t *log, size_t size, const char *text);
/// Read rows of ASC, whose numbers have the radix 10 or 16.
size_t maplines_parse_asc(maplines_log_t *log, size_t size, const char *text, int radix);
/// Read the objects in a container of BLF; the log starts at `start_ns`, of at most 2^62.
size_t maplines_parse_blf(maplines_log_t *log, size_t size, const uint8_t *data, int64_t start_ns);

#ifdef __GNUC__
#pragma GCC visibility pop
#endif

#endif
