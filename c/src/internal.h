/* What the sources of the core share. In the one file that is generated, all of it is static. */
#ifndef MAPLINES_INTERNAL_H
#define MAPLINES_INTERNAL_H

#include "maplines.h"

#include <assert.h>
#include <math.h>
#include <string.h>

#ifdef __FAST_MATH__
#error "maplines needs IEEE 754 arithmetic: compile it without -ffast-math"
#endif
#if defined(__FLT_EVAL_METHOD__) && __FLT_EVAL_METHOD__ != 0
#error "maplines needs arithmetic in the precision of its types: give gcc -msse2 -mfpmath=sse"
#endif

#ifndef MAPLINES_INTERNAL
#define MAPLINES_INTERNAL
#endif

/* ---- elementary.c: functions whose results are the same to the last bit on any machine --------- */

MAPLINES_INTERNAL double maplines_exp2(double x);
MAPLINES_INTERNAL double maplines_log2(double x);
MAPLINES_INTERNAL void maplines_sin_cos(double x, double *sine, double *cosine);
MAPLINES_INTERNAL double maplines_tan(double x);
MAPLINES_INTERNAL double maplines_atan(double x);

/* ---- linalg.c: in the order of operations of values/fixed_order.py ----------------------------- */

#define MAPLINES_STATES (4 * MAPLINES_SLOTS) ///< parameters of all lines of a scene

MAPLINES_INTERNAL void maplines_product(int n, int k, int m, const double *A, const double *B,
                                        double *C);
MAPLINES_INTERNAL void maplines_product_transposed(int n, int k, int m, const double *A,
                                                   const double *B, double *C);
MAPLINES_INTERNAL void maplines_symmetric(int n, double *A);
MAPLINES_INTERNAL void maplines_congruence(const double A[16], const double S[16], double C[16]);
MAPLINES_INTERNAL double maplines_total(int n, double *values);
MAPLINES_INTERNAL bool maplines_cholesky_factor(int n, const double *S, double *L);
MAPLINES_INTERNAL void maplines_lower_solution(int n, int m, const double *L, double *B);
MAPLINES_INTERNAL void maplines_inverse(const double A[16], double out[16]);
MAPLINES_INTERNAL void maplines_eigen(int n, double *A, double *values, double *V);

/* ---- signals.c: bits of a record, and the conversion between raw and physical values ----------- */

/// Raw value of a signal of a record.
MAPLINES_INTERNAL int64_t maplines_get(const maplines_signal_t *signal, const uint8_t *record);
/// Write the low bits of a raw value; these bits of the record must be 0.
MAPLINES_INTERNAL void maplines_put(const maplines_signal_t *signal, uint8_t *record, int64_t raw);
/// Physical value of a raw value.
MAPLINES_INTERNAL double maplines_physical(const maplines_signal_t *signal, int64_t raw);
/// Nearest raw value of a physical value, halves to even; not limited to the range.
MAPLINES_INTERNAL double maplines_nearest_raw(const maplines_signal_t *signal, double physical);
/// A raw value, limited to the range.
MAPLINES_INTERNAL int64_t maplines_limited(const maplines_signal_t *signal, double raw);
/// Checksum of a record as in AUTOSAR E2E profile 5.
MAPLINES_INTERNAL uint16_t maplines_crc(const uint8_t *record, size_t length, uint16_t crc_byte,
                                        uint16_t data_id);

/* ---- records.c: pages, transfer IDs and checksum of a record ------------------------------------ */

/// Layout of the records of an owner.
MAPLINES_INTERNAL const maplines_record_t *maplines_layout(const maplines_dbc_t *dbc, int owner);
/// MAPLINES_COMPLETE if a record of this length is intact; else LENGTH, MIXED or CRC.
MAPLINES_INTERNAL maplines_reason_t maplines_check_record(const maplines_dbc_t *dbc, int owner,
                                                          const uint8_t *record, size_t length);
/// CONTENT if a record that is conditional on the pose error holds a value that no sender sends.
MAPLINES_INTERNAL maplines_reason_t maplines_check_conditional(const maplines_dbc_t *dbc,
                                                               const uint8_t *record);
/// Write page numbers, transfer IDs, counter and checksum into a record that has all else.
MAPLINES_INTERNAL void maplines_seal(const maplines_dbc_t *dbc, int owner, uint8_t *record,
                                     size_t length, uint32_t counter);

/* ---- cholesky.c: a covariance as pivots, ratios and an inflation -------------------------------- */

/// Square root of a decoded covariance; row i belongs to state i.
MAPLINES_INTERNAL void maplines_decode_factor(const maplines_cholesky_t *code, const uint8_t *record,
                                              double factor[4][4]);
/// Raw values (pivots, ratios, inflation) of a covariance that covers a (rows, rows) target.
/// Returns whether it is covered; if not, the values are those of the widest covariance.
MAPLINES_INTERNAL bool maplines_encode_covariance(const maplines_cholesky_t *code,
                                                  const double *target, const double *resolution,
                                                  int64_t raw[11], bool *is_saturated);
MAPLINES_INTERNAL void maplines_put_covariance(const maplines_cholesky_t *code, uint8_t *record,
                                               const int64_t raw[11]);

/* ---- complete.c: records with a covariance of their own ----------------------------------------- */

/// Content of a record with a covariance of its own: a line, or one component of a mixture.
typedef struct {
    maplines_line_t line;
    uint8_t index;    ///< of the component, from 0
    uint8_t count;    ///< number of components of the line
    double weight;    ///< of the component
    uint32_t counter; ///< E2E counter of the record
} maplines_complete_t;

/// Read an intact record: MAPLINES_COMPLETE, or CONTENT.
MAPLINES_INTERNAL maplines_reason_t maplines_read_complete(const maplines_dbc_t *dbc, int slot,
                                                           const uint8_t *record, int64_t t_ns,
                                                           maplines_complete_t *content);

/* ---- scene_decode.c: lines and their joint covariance ------------------------------------------- */

/// Record of a line of a scene.
typedef struct {
    int slot;
    int64_t t_ns; ///< of its first frame
    uint8_t record[MAPLINES_MAX_RECORD];
} maplines_member_t;

/// Scene of a record of the pose error and records of lines, all of them intact and checked.
/// False if a line is no function of x in its range; no sender sends such a line.
MAPLINES_INTERNAL bool maplines_decode_scene(const maplines_dbc_t *dbc, const uint8_t *pose_record,
                                             int64_t t_ns, int count,
                                             const maplines_member_t *members,
                                             maplines_scene_t *scene);

#endif
