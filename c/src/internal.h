/* What the sources of the core share. In the one file that is generated, all of it is static. */
#ifndef MAPLINES_INTERNAL_H
#define MAPLINES_INTERNAL_H

#include "maplines.h"

#ifndef MAPLINES_ASSERT
#include <assert.h>
#define MAPLINES_ASSERT(condition) assert(condition)
#endif
#include <math.h>
#include <string.h>

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__ != 0) ||      \
    defined(__ASSOCIATIVE_MATH__) || defined(__RECIPROCAL_MATH__) || defined(__NO_SIGNED_ZEROS__)
#error "maplines needs IEEE 754 arithmetic: compile it without -ffast-math and its parts"
#endif
/* An array of negative size is an error: so with -fsingle-precision-constant. */
typedef char maplines_types_have_32_and_64_bits[sizeof(float) == 4 && sizeof(double) == 8 ? 1 : -1];
typedef char maplines_constants_are_double[sizeof(1.0) == sizeof(double) ? 1 : -1];
/* 1 is that of s390x: float is computed as double and rounded by each assignment. 16 is that of
 * CPUs with half precision, which is not used here. 2 is the x87, which keeps more bits than double
 * has.
 */
#if defined(__FLT_EVAL_METHOD__) && (__FLT_EVAL_METHOD__ == 2 || __FLT_EVAL_METHOD__ < 0)
#error "maplines needs arithmetic in the precision of its types: on a 32-bit x86, -mfpmath=sse"
#endif
/* No multiplication is fused with an addition: that rounds once instead of twice. GCC does not know
 * the pragma of C99, and fuses unless -std=c99 or -ffp-contract=off is given.
 */
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("fp-contract=off")
#else
#pragma STDC FP_CONTRACT OFF
#endif

#ifndef MAPLINES_INTERNAL
#define MAPLINES_INTERNAL
#endif
/* A function that is not inlined, so that its memory is on the stack only while it runs, or its
 * code is there only once.
 */
#ifdef __GNUC__
#define MAPLINES_APART __attribute__((noinline))
#else
#define MAPLINES_APART
#endif

/* What the caller must see to: it is asserted, and is the value of the macro where the assertion
 * returns or is off. The condition is evaluated twice. What the bus sends is never required.
 */
#define MAPLINES_REQUIRE(condition) (MAPLINES_ASSERT(condition), (condition))

/* A decoder and an encoder have these numbers once they are initialised. */
#define MAPLINES_DECODER_MAGIC UINT32_C(0x6D6C6465)
#define MAPLINES_ENCODER_MAGIC UINT32_C(0x6D6C656E)

/* ---- elementary.c: functions whose results are the same to the last bit on any machine ---------
 */

MAPLINES_INTERNAL double maplines_exp2(double x);
MAPLINES_INTERNAL double maplines_log2(double x);
MAPLINES_INTERNAL void maplines_sin_cos(double x, double *sine, double *cosine);
MAPLINES_INTERNAL double maplines_tan(double x);
MAPLINES_INTERNAL double maplines_atan(double x);

/* ---- self_test.c -------------------------------------------------------------------------------
 */

/* ---- linalg.c: in the order of operations of values/fixed_order.py -----------------------------
 */

#define MAPLINES_STATES (4 * MAPLINES_SLOTS) ///< parameters of all lines of a scene

/// Sum of n products of entries that are so many places apart.
MAPLINES_INTERNAL double maplines_inner(int n, const double *a, int by_a, const double *b,
                                        int by_b);
MAPLINES_INTERNAL void maplines_product(int n, int k, int m, const double *A, const double *B,
                                        double *C);
MAPLINES_INTERNAL void maplines_product_transposed(int n, int k, int m, const double *A,
                                                   const double *B, double *C);
MAPLINES_INTERNAL void maplines_gram(int n, int k, const double *A, double *C);
MAPLINES_INTERNAL void maplines_symmetric(int n, double *A);
MAPLINES_INTERNAL void maplines_congruence(const double A[16], const double S[16], double C[16]);
MAPLINES_INTERNAL double maplines_total(int n, double *values);
MAPLINES_INTERNAL bool maplines_cholesky_factor(int n, const double *S, double *L);
MAPLINES_INTERNAL void maplines_lower_solution(int n, int m, const double *L, double *B);
MAPLINES_INTERNAL void maplines_upper_solution(int n, int m, const double *L, double *B);
MAPLINES_INTERNAL void maplines_inverse(const double A[16], double out[16]);
MAPLINES_INTERNAL void maplines_eigen(int n, double *A, double *values, double *V);

/* ---- signals.c: bits of a record, and the conversion between raw and physical values -----------
 */

/// Raw value of a signal of a record.
MAPLINES_INTERNAL int64_t maplines_get(const maplines_signal_t *signal, const uint8_t *record);
/// Write the low bits of a raw value; these bits of the record must be 0.
MAPLINES_INTERNAL void maplines_put(const maplines_signal_t *signal, uint8_t *record, int64_t raw);
/// Least raw value of a signal.
MAPLINES_INTERNAL int64_t maplines_raw_min(const maplines_signal_t *signal);
/// Greatest raw value of a signal; 0 if the DBC has no such signal.
MAPLINES_INTERNAL int64_t maplines_raw_max(const maplines_signal_t *signal);
/// Physical value of a raw value; 0 if the DBC has no such signal.
MAPLINES_INTERNAL double maplines_physical(const maplines_signal_t *signal, int64_t raw);
/// Physical value of a signal of a record, which the DBC has.
MAPLINES_INTERNAL double maplines_value(const maplines_signal_t *signal, const uint8_t *record);
/// Nearest raw value of a physical value, halves to even; not limited to the range. 0 if the DBC
/// has no such signal.
MAPLINES_INTERNAL double maplines_nearest_raw(const maplines_signal_t *signal, double physical);
/// A whole number, limited to a range.
MAPLINES_INTERNAL int64_t maplines_within(int64_t least, int64_t most, double raw);
/// A raw value, limited to the range.
MAPLINES_INTERNAL int64_t maplines_limited(const maplines_signal_t *signal, double raw);
/// Checksum of a record as in AUTOSAR E2E profile 5.
MAPLINES_INTERNAL uint16_t maplines_crc(const uint8_t *record, size_t length, uint16_t crc_byte,
                                        uint16_t data_id);

/* ---- records.c: pages, transfer IDs and checksum of a record ------------------------------------
 *
 * An owner of records is its place in arrays: in maplines_owner_t, less MAPLINES_FIRST_OWNER.
 */

/// Place of an owner in arrays.
#define MAPLINES_PLACE_OF(owner) ((int)(owner)-MAPLINES_FIRST_OWNER)
/// Place of the owner Scene; that of Scene2 is the next one.
#define MAPLINES_WHOLE_SCENE MAPLINES_LINE_OWNERS
/// The records of an owner are whole scenes.
#define MAPLINES_IS_WHOLE(owner) (MAPLINES_SCENE_RECORDS && (owner) >= MAPLINES_WHOLE_SCENE)
/// Kind of a place of a whole scene that has no line. That of a line that is left out follows, by
/// its reason.
#define MAPLINES_NO_LINE 8
/// The records of a DBC hold whole scenes.
MAPLINES_INTERNAL bool maplines_has_whole_scenes(const maplines_dbc_t *dbc);
/// The records of an owner are those of the pose error alone.
MAPLINES_INTERNAL bool maplines_is_pose(int owner);
/// Layout of the records of an owner.
MAPLINES_INTERNAL const maplines_record_t *maplines_layout(const maplines_dbc_t *dbc, int owner);
/// Bits of the counters of records.
MAPLINES_INTERNAL uint32_t maplines_counter_mask(const maplines_record_t *layout);
/// Counter of the record of an owner that follows the one with a counter.
MAPLINES_INTERNAL uint32_t maplines_next_counter(const maplines_dbc_t *dbc, int owner,
                                                 uint32_t counter);
/// How bad a status is: a mixture has that of its worst component.
MAPLINES_INTERNAL int maplines_severity(maplines_status_t status);
#if MAPLINES_RECEIVER && MAPLINES_LINE_RECORDS
/// MAPLINES_COMPLETE if a record of this length is intact; else LENGTH, MIXED or CRC.
MAPLINES_INTERNAL maplines_reason_t maplines_check_record(const maplines_dbc_t *dbc, int owner,
                                                          const uint8_t *record, size_t length);
#if MAPLINES_SCENES
/// CONTENT if a record that is conditional on the pose error holds a value that no sender sends.
MAPLINES_INTERNAL maplines_reason_t maplines_check_conditional(const maplines_dbc_t *dbc,
                                                               const uint8_t *record);
#endif
#endif
#if MAPLINES_SENDER
/// Write page numbers, transfer IDs, counter and checksum into a record that has all else.
MAPLINES_INTERNAL void maplines_seal(const maplines_dbc_t *dbc, int owner, uint8_t *record,
                                     size_t length, uint32_t counter);
#endif

/* ---- cholesky.c: a covariance as pivots, ratios and an inflation --------------------------------
 */

/// Square root of a decoded covariance; row i belongs to state i.
MAPLINES_INTERNAL void maplines_decode_factor(const maplines_cholesky_t *code,
                                              const uint8_t *record, double factor[4][4]);

#if MAPLINES_SENDER
/// Raw values (pivots, ratios, inflation) of a covariance that covers a (rows, rows) target, whose
/// states have the variances `resolution` at least. `powers` are those of 2 of all values of the
/// pivots, by row, and of the inflation, each from the least raw value on; where one is NULL, it is
/// computed.
/// Returns whether it is covered; if not, the values are those of the widest covariance.
MAPLINES_INTERNAL bool maplines_encode_covariance(const maplines_cholesky_t *code,
                                                  const double *const powers[5],
                                                  const double *target, const double *resolution,
                                                  int64_t raw[11], bool *is_saturated);
///
/// raw is the pivots of the rows, from 4 on the ratios in the order of `code->ratio`, and at 10 the
/// inflation.
MAPLINES_INTERNAL void maplines_put_covariance(const maplines_cholesky_t *code, uint8_t *record,
                                               const int64_t raw[11]);
/// Raw values of the widest covariance.
MAPLINES_INTERNAL void maplines_widest_covariance(const maplines_cholesky_t *code, int64_t raw[11]);
#endif

/* ---- gaussian.c: decoded Gaussians
 * --------------------------------------------------------------- */

#if MAPLINES_RECEIVER
/// Gaussian of a receiver with a mean and a factor, whose rows are triangular in this order of the
/// states. In single precision the factor is widened so that it covers what the rounding loses.
MAPLINES_INTERNAL void maplines_set_gaussian(const double mean[4], double (*factor)[4],
                                             const uint8_t order[4], maplines_gaussian_t *gaussian);
#endif
/// Share of the variances that is added to a covariance of a mixture that rounding has made
/// indefinite; that of 64 components errs by less.
#define MAPLINES_DEFINITE_SHARE 0x1p-40
/// Mean and covariance of a mixture; covs are (4, 4) and symmetric.
MAPLINES_INTERNAL void maplines_moments(int count, const double *weights, double (*means)[4],
                                        double (*covs)[16], double mean[4], double cov[16]);
#if MAPLINES_RECEIVER
/// Gaussian of a receiver with the mean and covariance of a mixture.
MAPLINES_INTERNAL void maplines_mixture_gaussian(int count, const double *weights,
                                                 const maplines_gaussian_t *components,
                                                 const uint8_t order[4],
                                                 maplines_gaussian_t *overall);
#endif

#if MAPLINES_RECEIVER && MAPLINES_LINE_RECORDS
/* ---- complete.c: records with a covariance of their own -----------------------------------------
 */

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
#endif // MAPLINES_RECEIVER && MAPLINES_LINE_RECORDS

#if MAPLINES_SENDER
/* ---- nearest_line.c
 * ------------------------------------------------------------------------------ */

/// The line within the ranges of signals that is nearest to one beyond them, in the longest part of
/// its range [m] near the car; false if there is none of the least length. `reach` are the greatest
/// standard deviations that a covariance can have.
MAPLINES_INTERNAL bool maplines_nearest_line(const maplines_signal_t signals[4],
                                             const double mean[4], const double x_range[2],
                                             double least, const double reach[4], double near[4],
                                             double near_range[2]);
/// Error of a direction whose effect of first order is that of the slopes [rad].
MAPLINES_INTERNAL double maplines_slope_error(double beta, double near);

#if MAPLINES_LINE_RECORDS
/* ---- repair.c: covariances of a caller
 * ------------------------------------------------------------ */

#define MAPLINES_COVARIANCE_ROUNDING 1e-9 ///< relative to the standard deviations
/// MAPLINES_SENT, or what is wrong with a (4, 4) covariance. One that is indefinite is not wrong.
MAPLINES_INTERNAL maplines_refusal_t maplines_check_covariance(const double S[16], double rounding);
/// A symmetric matrix is not positive semidefinite, up to rounding.
MAPLINES_INTERNAL bool maplines_is_indefinite(const double S[16], double rounding);
/// Nearest positive semidefinite matrix that covers a symmetric one.
MAPLINES_INTERNAL void maplines_nearest_covariance(const double S[16], double nearest[16]);
#endif

#if MAPLINES_MIXTURES
/* ---- mixture_weights.c
 * ---------------------------------------------------------------------------- */

/// Weights rounded to positive multiples of 1 / steps that add up to 1.
MAPLINES_INTERNAL void maplines_quantize_weights(int count, const double *weights, int64_t steps,
                                                 double *decoded);
/// Covariance to add to each component so that the whole mixture is covered; overwrites covs.
MAPLINES_INTERNAL void maplines_deficit(int count, const double *weights, double (*means)[4],
                                        double (*covs)[16], const double *decoded_weights,
                                        double (*decoded_means)[4], double cover[16]);
#endif

/* ---- complete_write.c
 * ----------------------------------------------------------------------------- */

#if MAPLINES_LINE_RECORDS
/// Content of one record of a line: all of it, or a component of its mixture.
typedef struct {
    const maplines_input_t *line; ///< all but mean, covariance
    const double *mean;
    double cov[16];   ///< exactly symmetric
    double cover[16]; ///< that the decoded covariance must cover besides
    bool is_indefinite;
    int index, count;
    double weight;
    const double *const *powers; ///< as of maplines_encode_covariance, or NULL
} maplines_draft_t;

/// Mean and valid range of a line as they are sent.
typedef struct {
    int64_t mean[4];
    int64_t ends[2];
    bool is_clipped; ///< the mean exceeds its signals
    bool is_cut;     ///< the range exceeds its signals
    bool is_outside; ///< no part of the range can be stated
} maplines_stated_t;

/// Mean and range as they are sent; of a mean that would be clipped, with `is_replaced` the nearest
/// line within the message.
MAPLINES_INTERNAL void maplines_state_line(const maplines_dbc_t *dbc, const double mean[4],
                                           const double x_range[2], bool is_replaced,
                                           maplines_stated_t *stated);
/// Write all of a record but what maplines_seal writes; returns its status.
MAPLINES_INTERNAL maplines_status_t maplines_write_complete(const maplines_dbc_t *dbc,
                                                            const maplines_draft_t *draft,
                                                            uint8_t *record);
#endif
/// Least raw value whose physical value is not less; not limited to the range.
MAPLINES_INTERNAL double maplines_raw_above(const maplines_signal_t *signal, double physical);

/* ---- encoder.c
 * ------------------------------------------------------------------------------------- */

/// The sender has a message for the records of an owner.
MAPLINES_INTERNAL bool maplines_can_send(const maplines_encoder_t *encoder, int owner, bool is_fd);
/// Frames of a sealed record, of which there is a message; their number, or 0 if it was not signed.
MAPLINES_INTERNAL size_t maplines_frames(const maplines_encoder_t *encoder, int owner,
                                         const uint8_t *record, size_t length, bool is_fd,
                                         int64_t now_us, maplines_frame_t *frames);
#if MAPLINES_MIXTURES
/// Decoded weights of the components of a mixture, and what each of them must cover besides its own
/// covariance.
MAPLINES_INTERNAL void maplines_cover_mixture(const maplines_dbc_t *dbc,
                                              const maplines_component_t *components, int count,
                                              double *decoded_weights, double cover[16]);
#endif
/// MAPLINES_SENT, or what is wrong with kind, status, range and age of a line.
/// Whether an encoder is initialised, and can sign if it has to.
MAPLINES_INTERNAL bool maplines_is_sender(const maplines_encoder_t *encoder);
MAPLINES_INTERNAL maplines_refusal_t maplines_check_input(const maplines_input_t *line);
#endif // MAPLINES_SENDER

/* ---- cubics.c: as model/lines.py
 * --------------------------------------------------------------- */

#define MAPLINES_FIT_POINTS 16 ///< points of a line to which a cubic is fitted from another pose

/// Line, as what is seen from any pose depends on it.
typedef struct {
    double mean[4];
    double fit_range[2]; ///< [m]
    double quartic;      ///< coefficient of T_4 in this range [m]
} maplines_curve_t;

/// Lines may have a quartic; those of a whole scene that is received have none.
#define MAPLINES_HAS_QUARTIC (MAPLINES_LINE_RECORDS || MAPLINES_SENDER)

/// Points of a line.
typedef struct {
    double x[MAPLINES_FIT_POINTS]; ///< [m]
    double y[MAPLINES_FIT_POINTS]; ///< [m]; NaN if the line points backwards
} maplines_points_t;

/// Value and derivatives at 0 of a cubic with coefficients q of w^0 to w^3, w = (u - centre) /
/// half.
MAPLINES_INTERNAL void maplines_derivatives(const double q[4], double centre, double half,
                                            double values[4]);
/// Middle of a range, and half of its length.
MAPLINES_INTERNAL double maplines_middle(const double range[2]);
MAPLINES_INTERNAL double maplines_half(const double range[2]);
/// Lateral position at x of a cubic with a mean, whose slope at 0 is that of beta.
MAPLINES_INTERNAL double maplines_lateral(const double mean[4], double slope, double x);
/// Its gradient with respect to the mean.
MAPLINES_INTERNAL void maplines_lateral_gradient(double slope, double x, double J[4]);
MAPLINES_INTERNAL void maplines_points_of(const maplines_curve_t *curve, maplines_points_t *points);
/// Whether a line through points is a function of x, and nowhere nearly perpendicular to it.
MAPLINES_INTERNAL bool maplines_is_function(const maplines_points_t *points);
/// Line through points, seen from a pose (x [m], y [m], heading [rad]); NaN if no function of x.
MAPLINES_INTERNAL void maplines_refitted(const maplines_points_t *points, const double pose[3],
                                         double line[4]);

#if MAPLINES_SCENES
/* ---- seen_lines.c: lines as functions of the pose, as model/lines.py
 * ------------------------ */

/// Derivatives of a line with respect to its coefficients of T_0 .. T_3; upper triangular.
MAPLINES_INTERNAL void maplines_bases(const double mean[4], const double fit_range[2],
                                      double J[16]);

/// How a line changes with the pose from which it is seen, to second order.
typedef struct {
    double J[16];   ///< derivatives of the line with respect to its coefficients of T_0 .. T_3
    double tangent; ///< of beta
    /// Factors of along, across, heading, and of heading^2, heading along, heading across and
    /// along^2 in the changes of these coefficients.
    double rows[7][4];
} maplines_changes_t;

MAPLINES_INTERNAL void maplines_changes_of(const maplines_curve_t *curve,
                                           maplines_changes_t *changes);
/// The same changes of the line itself, by rows.
MAPLINES_INTERNAL void maplines_line_changes(const maplines_changes_t *changes, double W[7][4]);

/// Root of the covariance of a pose error, and what seven sigma points make of its products
/// (heading^2, heading along, heading across, along^2). Let s_k be these of column k of the root,
/// and m their sum. The centre has the weights 0 in the mean and 2 in the covariance, so the
/// columns are (3 s_k - m) / sqrt(3) and sqrt(2) m.
typedef struct {
    double first[3][3]; ///< lower triangular
    double second[4][4];
} maplines_pose_root_t;

/// Roots for a positive semidefinite covariance P.
MAPLINES_INTERNAL void maplines_pose_root(const double P[9], maplines_pose_root_t *root);

#define MAPLINES_COLUMNS 7 ///< of the factor of a line due to the pose error

/// Rows A of a factor of the covariance of a line due to the pose error. False if it overflows.
MAPLINES_INTERNAL bool maplines_spread(const maplines_changes_t *changes,
                                       const maplines_pose_root_t *root,
                                       double A[4][MAPLINES_COLUMNS]);
/// Standard deviation that the coefficients of T_0 .. T_3 of a line with levels have at least [m].
#define MAPLINES_RESOLUTION 0x1p-9
/// Covariance of the coefficients of T_0 .. T_3 that all lines of a scene have: of the resolution
/// of the means, and of the map error.
MAPLINES_INTERNAL void maplines_common(const maplines_changes_t *changes, double offset_sigma,
                                       double heading_sigma, double cov[16]);
/// Valid range of a line, within its fit range [m].
MAPLINES_INTERNAL void maplines_valid_range(const maplines_curve_t *curve, const double P[9],
                                            const double specific_cov[16], double heading_sigma,
                                            double range[2]);

/* ---- levels.c: line-specific covariances as levels, of the coefficients of T_0 .. T_3
 * ------------- */

/// Nodes of a range, to which a cubic is fitted: the extrema of a Chebyshev polynomial.
#define MAPLINES_NODES 64

/// Length of a line, at the nodes of its range.
typedef struct {
    float stretch[MAPLINES_NODES]; ///< derivative of the length with respect to x
    float place[MAPLINES_NODES];   ///< length up to the node, in halves of the whole length
} maplines_arc_t;

/// Length of a line at the nodes of its range.
MAPLINES_INTERNAL void maplines_arc_of(const maplines_curve_t *curve, maplines_arc_t *arc);
/// Covariance for unit errors of points at a raw value of the shape, and by how much the shape adds
/// to it.
MAPLINES_INTERNAL double maplines_point_noise(const maplines_levels_t *levels,
                                              const maplines_arc_t *arc, int64_t shape,
                                              double cov[16]);
/// The sum of both.
MAPLINES_INTERNAL void maplines_level_noise(const maplines_levels_t *levels,
                                            const maplines_arc_t *arc, int64_t shape,
                                            double cov[16]);
/// Level of a raw value of the lateral level or that of the points [m].
MAPLINES_INTERNAL double maplines_level(const maplines_signal_t *signal, int64_t raw);
/// Binary logarithm of the level of the shape for the raw value 0 [m]; by how much it is more for
/// the greatest one, and from one to the next.
#define MAPLINES_SHAPE_OFFSET (-10.0)
#define MAPLINES_SHAPE_OCTAVES 10.2
MAPLINES_INTERNAL double maplines_shape_step(const maplines_levels_t *levels);
/// Level of a raw value of the shape, where there are no errors of points [m].
MAPLINES_INTERNAL double maplines_shape_level(const maplines_levels_t *levels, int64_t raw);
/// Variance of the coefficient of T_k of a line of uncertain shape, up to a common factor.
MAPLINES_INTERNAL double maplines_shape(int k);
#define MAPLINES_TILTS 4
/// By how much the lateral level of a raw tilt grows along the line: T_1 for each T_0. What is
/// beyond the last one is the last one.
MAPLINES_INTERNAL double maplines_tilt(int64_t raw);
/// Add the square of a lateral level with a tilt.
MAPLINES_INTERNAL void maplines_add_lateral(double square, double tilt, double cov[16]);
/// Covariance of raw levels: lateral, points, shape, tilt.
MAPLINES_INTERNAL void maplines_decode_levels(const maplines_levels_t *levels,
                                              const maplines_curve_t *curve, const int64_t raw[4],
                                              double cov[16]);

/* ---- scene_decode.c: lines and their joint covariance -------------------------------------------
 */

/// Factor of a line-specific covariance: that of levels, and what is common to all lines.
MAPLINES_INTERNAL void maplines_specific_factor(const double J[16], const double levels[16],
                                                const double common[16], double factor[4][4]);
/// Levels by which the record of a line, or of the pose error, is decoded.
MAPLINES_INTERNAL const maplines_levels_t *maplines_levels_of(const maplines_dbc_t *dbc);
#if MAPLINES_RECEIVER
/// Line of a pose error, to be decoded.
typedef struct {
    int slot;
    const uint8_t *record; ///< from which its signals are read
    int64_t t_ns;          ///< of its first frame
    maplines_line_t *line; ///< set to the line; NULL: it is only in the scene
} maplines_epoch_line_t;

/// Pose error and lines of it, wherever their records are.
typedef struct {
    const uint8_t *pose; ///< record of the pose error
    int64_t t_ns;        ///< of its first frame
    int count;
    maplines_epoch_line_t lines[MAPLINES_SLOTS];
#if MAPLINES_SCENE_RECORDS
    maplines_left_out_t left_out[MAPLINES_SLOTS]; ///< by slot
#endif
} maplines_epoch_view_t;

/// Begin without lines.
MAPLINES_INTERNAL void maplines_begin_view(const uint8_t *pose, int64_t t_ns,
                                           maplines_epoch_view_t *view);
MAPLINES_INTERNAL maplines_epoch_line_t *
maplines_add_to_view(int slot, const uint8_t *record, int64_t t_ns, maplines_epoch_view_t *view);
/// Set the factors of the line at a place of a scene: A due to the pose error, F line-specific. In
/// single precision they are widened so that they cover what the rounding loses of a scene of up to
/// `count` lines.
MAPLINES_INTERNAL void maplines_set_factors(const uint8_t order[4], int place, int count,
                                            const double mean[4], double A[4][MAPLINES_COLUMNS],
                                            double F[4][4], maplines_scene_t *scene);
/// Decode lines of a pose error, whose records are intact and checked, and a scene of them unless
/// it is NULL. A bit for each slot that was decoded: a line that is no function of x in its range,
/// which no sender sends, is not.
MAPLINES_INTERNAL uint32_t maplines_decode_epoch(const maplines_dbc_t *dbc,
                                                 const maplines_epoch_view_t *epoch,
                                                 maplines_scene_t *scene);
#if MAPLINES_SCENE_RECORDS
/// A line of a whole scene has a range in which it is a function of x.
MAPLINES_INTERNAL bool maplines_is_line(const maplines_dbc_t *dbc, const uint8_t *record);
#endif
#endif
#endif // MAPLINES_SCENES

#if MAPLINES_SENDER && MAPLINES_SCENES
/* ---- joint.c: joint covariances of lines
 * ---------------------------------------------------------- */

/// Variances of lateral position and direction of a line that are compared.
#define MAPLINES_VARIANCES 18

/// Cholesky factor of a (4, 4) matrix, or the identity if it has none that is finite.
MAPLINES_INTERNAL void maplines_factor_or_identity(const double S[16], double L[16]);
/// What to add to D_i (own) so that diag(D_1, ...) covers what a spread leaves of a target, a rest
/// of 4 `lines` rows; false if nothing is. Of the spread, blocks of the lines are given. J are
/// derivatives of lines with respect to T_0 .. T_3. It is NaN for a line whose D_i is not definite,
/// or for all lines if the sum cannot be compared.
MAPLINES_INTERNAL bool maplines_uncovered(int lines, const double *rest, double (*spread)[16],
                                          double (*own)[16], double (*J)[16],
                                          maplines_joint_space_t *space, double (*lacking)[16]);

/// A covariance of coefficients of T_0 .. T_3 with which others are compared.
typedef struct {
    bool is_definite;
    double factor[16];
    double variances[MAPLINES_VARIANCES];
} maplines_reference_t;

MAPLINES_INTERNAL void maplines_compare_with(const double cov[16], maplines_reference_t *reference);
/// Trace, less 4 and halved, and ratio of roots of determinants, which add up to the divergence
/// (KL) of a decoded covariance from the reference: the one plus the logarithm of the other. False
/// if a matrix is not definite.
MAPLINES_INTERNAL bool maplines_compared(const maplines_reference_t *reference,
                                         const double decoded[16], double *by_trace, double *ratio);
/// Divergence (KL) of a decoded covariance from the reference [nat]; infinite if one is not
/// definite.
MAPLINES_INTERNAL double maplines_divergence(const maplines_reference_t *reference,
                                             const double decoded[16]);
/// Largest ratio of the variances of a decoded covariance to those of the reference.
MAPLINES_INTERNAL double maplines_largest_ratio(const maplines_reference_t *reference,
                                                const double decoded[16]);

/* ---- rounding.c: means of lines
 * ------------------------------------------------------------------- */

/// Factor of what rounding errors of a line with D_i `own` are to be like.
MAPLINES_INTERNAL void maplines_rounding_factor(const double own[16], const double J[16],
                                                double L[16]);
/// Raw values of a mean, and whether they are within their ranges. With finer signals, they are
/// those of the sums of each signal and its finer one, in steps of the latter.
MAPLINES_INTERNAL bool maplines_round_mean(const maplines_signal_t signals[4],
                                           const maplines_signal_t *fine, const double mean[4],
                                           const double L[16], int64_t raw[4]);
/// Raw value of a signal, and of the finer one (`rest`), of their sum.
MAPLINES_INTERNAL int64_t maplines_split(const maplines_signal_t *fine, int64_t raw, int64_t *rest);

/* ---- level_search.c
 * ------------------------------------------------------------------------------- */

/// What levels of a line are to cover.
typedef struct {
    const maplines_curve_t *curve; ///< line as decoded
    const double *J;        ///< (4, 4) derivatives with respect to coefficients of T_0 .. T_3
    const double *common;   ///< (4, 4) covariance of these that is added to that of the levels
    const double *target;   ///< (4, 4) covariance of the parameters to be covered
    const double *true_cov; ///< (4, 4) that to which the sum is to be close
} maplines_level_target_t;

/// Raw levels (lateral, points, shape, tilt) that cover a target at the least cost, of those with
/// the spacings of a line; false if none do. If it has none yet, these spacings are chosen. The
/// covariance of the levels becomes that of the line.
MAPLINES_INTERNAL bool maplines_search_levels(const maplines_dbc_t *dbc,
                                              const maplines_level_target_t *target,
                                              maplines_level_squares_t *squares,
                                              maplines_sent_line_t *line, int64_t raw[4]);
/// Whether the covariance of levels covers a target; its true covariance is not used.
MAPLINES_INTERNAL bool maplines_levels_cover(const maplines_level_target_t *target,
                                             const double levels[16]);

/* ---- scene_parts.c, specific_encode.c, scene_encode.c
 * --------------------------------------------- */

MAPLINES_INTERNAL maplines_curve_t maplines_curve_of(const double mean[4],
                                                     const double fit_range[2], double quartic);
/// A line has a range and is a function of x.
MAPLINES_INTERNAL bool maplines_can_be_seen(const maplines_curve_t *curve);
/// Find the part of a line of a scene that can be stated; MAPLINES_IN_SCENE, or why there is none.
MAPLINES_INTERNAL maplines_left_out_t maplines_state_member(const maplines_dbc_t *dbc,
                                                            const maplines_scene_input_t *scene,
                                                            int place,
                                                            maplines_scene_member_t *member);
/// Find the parts of its covariance; false if what the pose error does to it overflows.
MAPLINES_INTERNAL bool maplines_find_parts(const maplines_scene_input_t *scene, int place,
                                           maplines_scene_member_t *member);
/// What the spread of the lines that are left, which is in `space->rest` before, leaves of their
/// joint covariance with the errors of their means.
MAPLINES_INTERNAL void maplines_joint_target(const maplines_scene_input_t *scene,
                                             maplines_scene_workspace_t *space);
/// Encode D_i of the lines that are left, so that they cover the joint target. Sets which lines are
/// covered, and the costs of levels.
MAPLINES_INTERNAL void maplines_cover(const maplines_dbc_t *dbc, maplines_scene_workspace_t *space);
/// Least variances that a code can decode to, for targets that are singular.
MAPLINES_INTERNAL void maplines_least_variances(const maplines_cholesky_t *code, double least[4]);
/// Encode a scene as raw values. MAPLINES_SENT, or why it cannot be sent.
MAPLINES_INTERNAL maplines_refusal_t maplines_encode_members(const maplines_dbc_t *dbc,
                                                             const maplines_scene_input_t *scene,
                                                             bool is_full,
                                                             maplines_scene_workspace_t *space);

/// The records of lines can have all entries of a line-specific covariance.
MAPLINES_INTERNAL bool maplines_has_entries(const maplines_dbc_t *dbc);

#if MAPLINES_SCENE_RECORDS
/* ---- places.c: records of whole scenes
 * ----------------------------------------------------------- */

/// One cycle of a whole scene.
typedef struct {
    const maplines_scene_workspace_t *space; ///< encoded
    int count;                               ///< of its lines
    uint32_t slots;                          ///< of the lines that are to be sent, one bit each
    bool is_secured;
    double age;       ///< from the pose to the sending [s]
    uint32_t counter; ///< of Scene
} maplines_whole_cycle_t;

/// Choose the places of lines, from those of the last cycle on.
MAPLINES_INTERNAL void maplines_choose_places(const maplines_dbc_t *dbc,
                                              const maplines_whole_cycle_t *cycle,
                                              maplines_chosen_places_t *places);
/// A message has a place for the line of a slot.
MAPLINES_INTERNAL bool maplines_has_place(const maplines_chosen_places_t *places, int slot);
/// Write all of a record of Scene (0) or Scene2 (1) but what maplines_seal writes; returns its
/// length.
MAPLINES_INTERNAL size_t maplines_write_whole(const maplines_dbc_t *dbc,
                                              const maplines_whole_cycle_t *cycle,
                                              const maplines_chosen_places_t *places, int message,
                                              uint8_t *record);
#endif

/* ---- scene_send.c
 * -------------------------------------------------------------------------------- */

/// Write the pose error, its age and what is common to all lines into a record.
MAPLINES_INTERNAL void maplines_put_pose(const maplines_dbc_t *dbc,
                                         const maplines_scene_workspace_t *space, double age,
                                         uint8_t *record);
/// Write a line that is conditional on the pose error, with levels if it has them; in a whole scene
/// as that at the first place.
MAPLINES_INTERNAL void maplines_put_line(const maplines_dbc_t *dbc,
                                         const maplines_scene_member_t *member, uint8_t *record);
#if MAPLINES_LINE_RECORDS
/// One cycle of a scene: what the record of its pose error states of it.
typedef struct {
    double age;                          ///< from the pose to the sending of the pose error [s]
    uint32_t first[MAPLINES_OWNERS];     ///< counters before the cycle
    uint32_t following[MAPLINES_OWNERS]; ///< and after it
    bool is_member[MAPLINES_SLOTS];      ///< lines that are sent and belong to the pose error
} maplines_pose_cycle_t;

/// Write all of the record of the pose error but what maplines_seal writes; returns its length.
MAPLINES_INTERNAL size_t maplines_write_pose(const maplines_dbc_t *dbc,
                                             const maplines_scene_workspace_t *space,
                                             const maplines_pose_cycle_t *cycle, uint8_t *record);
/// Write all of a record that is conditional on the pose error but what maplines_seal writes;
/// returns its length.
MAPLINES_INTERNAL size_t maplines_write_conditional(const maplines_dbc_t *dbc,
                                                    const maplines_scene_member_t *member,
                                                    uint8_t *record);
#endif
#endif // MAPLINES_SENDER && MAPLINES_SCENES

#if MAPLINES_SECOC
/* ---- secoc.c ----------------------------------------------------------------------------------
 */

#if MAPLINES_RECEIVER
/// Check an authenticated frame: MAPLINES_COMPLETE if its MAC is valid and its freshness value is
/// new, which then becomes `last_us`; else LENGTH, KEY, MAC, REPLAY or AGE.
MAPLINES_INTERNAL maplines_reason_t maplines_verify(const maplines_dbc_t *dbc, int owner,
                                                    const maplines_authenticator_t *authenticator,
                                                    const maplines_frame_t *frame,
                                                    int64_t *last_us);
#endif
#if MAPLINES_SENDER
/// Write the secured I-PDU of a sealed record, with the next freshness value and a MAC, and return
/// its length. 0 without a key or a further freshness value; the signer does not change then.
MAPLINES_INTERNAL size_t maplines_secured_pdu(const maplines_record_t *layout, uint16_t data_id,
                                              const uint8_t *record, size_t length, int64_t now_us,
                                              maplines_signer_t *signer, uint8_t pdu[64]);
#endif
#endif

#if MAPLINES_RECEIVER
/* ---- reception ---------------------------------------------------------------------------------
 *
 * What a receiver can hold; the generator refuses other DBCs by name:
 *
 *     Counter          32 bits at most, in one page
 *     TransferId       16 bits at most, and 2^bits <= MAPLINES_MAX_TRANSFER_IDS
 *     pages            32 at most, and MAPLINES_MAX_PAGES
 *     ComponentCount   64 at most, and MAPLINES_MAX_COMPONENTS
 *     <Slot>Counter    32 bits at most (it is no longer than Counter)
 *
 * Functions of one station of reception; a station knows those before it only by these.
 */

/* settings.c */

/// Longest cycle time and time-out: an hour.
#define MAPLINES_MAX_PERIOD_NS INT64_C(3600000000000)
/// Time of what has not happened.
#define MAPLINES_NEVER INT64_MIN

/// A time of the caller within +-MAPLINES_MAX_TIME.
MAPLINES_INTERNAL int64_t maplines_limited_time(int64_t t_ns);
/// Time between two times in any order [ns]; both are limited ones.
MAPLINES_INTERNAL int64_t maplines_distance(int64_t a_ns, int64_t b_ns);
/// NULL, or what is wrong with settings for a DBC.
MAPLINES_INTERNAL const char *maplines_settings_problem(const maplines_dbc_t *dbc,
                                                        const maplines_settings_t *settings);

/* routing.c */

/// A complete record, read or rejected.
typedef struct {
    int owner;
    int64_t t_ns;             ///< of its first frame
    uint32_t frames;          ///< that carried it
    uint32_t length;          ///< [byte]
    maplines_reason_t reason; ///< MAPLINES_COMPLETE, or why its content is rejected
#if MAPLINES_LINE_RECORDS
    maplines_complete_t content; ///< of a good record with a covariance of its own
#endif
#if MAPLINES_SCENE_RECORDS
    uint8_t places; ///< of a whole scene: lines that it may have
#endif
    uint8_t record[MAPLINES_RECORD_ROOM];
} maplines_arrival_t;

/// Count dropped frames, and return the reason.
MAPLINES_INTERNAL maplines_reason_t maplines_dropped(maplines_decoder_t *decoder,
                                                     maplines_reason_t reason, uint32_t frames);
/// Take a frame: MAPLINES_COMPLETE if it completes a record, else why it does not.
/// `arrival->owner` is that of the frame unless it is FOREIGN.
MAPLINES_INTERNAL maplines_reason_t maplines_route_frame(maplines_decoder_t *decoder,
                                                         const maplines_frame_t *frame,
                                                         int64_t t_ns, maplines_arrival_t *arrival);

/* records.c */

/// Why a record of an arrival is rejected, or MAPLINES_COMPLETE.
MAPLINES_INTERNAL maplines_reason_t maplines_read_record(const maplines_dbc_t *dbc,
                                                         maplines_arrival_t *arrival);

#if MAPLINES_LINE_RECORDS
/* reassembly.c */

/// Add a page to its transfer: as maplines_route_frame.
MAPLINES_INTERNAL maplines_reason_t maplines_add_page(maplines_decoder_t *decoder,
                                                      const uint8_t *data, int64_t t_ns,
                                                      maplines_arrival_t *arrival);
/// Read a record; remember a good one, and forget those of the previous round of IDs.
MAPLINES_INTERNAL void maplines_complete_record(maplines_decoder_t *decoder,
                                                maplines_arrival_t *arrival);
MAPLINES_INTERNAL void maplines_expire_transfers(maplines_decoder_t *decoder, int64_t t_ns);
/// Frames of incomplete transfers.
MAPLINES_INTERNAL uint32_t maplines_pending_transfers(const maplines_decoder_t *decoder);
#endif

/* e2e_state.c */

/// E2E_P05Check of a counter `delta` after the last one, modulo its modulus.
MAPLINES_INTERNAL maplines_e2e_status_t maplines_e2e_check(uint32_t delta, uint32_t max_delta);
MAPLINES_INTERNAL void maplines_machine_init(maplines_machine_t *machine);
/// E2E_SMCheck: one step with the check of a record, or NONEWDATA.
MAPLINES_INTERNAL void maplines_machine_step(maplines_machine_t *machine,
                                             const maplines_e2e_config_t *config,
                                             maplines_e2e_status_t status);
MAPLINES_INTERNAL void maplines_machine_clear(maplines_machine_t *machine);

/* history.c */

/// Cycles missed before a record at a time; the deadline starts anew.
MAPLINES_INTERNAL int64_t maplines_deadline_record(maplines_deadline_t *deadline, int64_t cycle_ns,
                                                   int64_t t_ns);
/// Cycles missed up to a time and not returned before.
MAPLINES_INTERNAL int64_t maplines_deadline_elapse(maplines_deadline_t *deadline, int64_t cycle_ns,
                                                   int64_t t_ns);

/// Add a new record; those of the counters that it has skipped are forgotten. A counter is modulo
/// a power of two, of which `mask` has the bits.
MAPLINES_INTERNAL void maplines_history_add_new(maplines_history_t *history, uint32_t mask,
                                                uint32_t counter, uint32_t content,
                                                uint32_t skipped);
MAPLINES_INTERNAL void maplines_history_add_late(maplines_history_t *history, uint32_t mask,
                                                 uint32_t counter, uint32_t content,
                                                 uint32_t behind);
/// Add a record behind the last new one to the run of its counters.
MAPLINES_INTERNAL void maplines_history_run(maplines_history_t *history, uint32_t mask,
                                            uint32_t counter, int64_t t_ns, bool is_other);
/// There is a record with a counter.
MAPLINES_INTERNAL bool maplines_history_has(const maplines_history_t *history, uint32_t mask,
                                            uint32_t counter, uint32_t behind);
MAPLINES_INTERNAL bool maplines_history_is_duplicate(const maplines_history_t *history,
                                                     uint32_t mask, uint32_t counter,
                                                     uint32_t content, uint32_t behind);
/// Mark a record that there is as duplicated; true the first time a new record is duplicated.
MAPLINES_INTERNAL bool maplines_history_mark_duplicated(maplines_history_t *history, uint32_t mask,
                                                        uint32_t counter);
MAPLINES_INTERNAL bool maplines_history_fills_gap(const maplines_history_t *history, uint32_t mask,
                                                  uint32_t counter, uint32_t behind);

/* conflict.c; `cycle_ns` is the time between records */

MAPLINES_INTERNAL void maplines_conflict_init(maplines_conflict_t *conflict);
MAPLINES_INTERNAL void maplines_conflict_new(maplines_conflict_t *conflict);
MAPLINES_INTERNAL void maplines_conflict_duplicate(maplines_conflict_t *conflict, int64_t t_ns);
MAPLINES_INTERNAL void maplines_conflict_count(maplines_conflict_t *conflict, int64_t cycle_ns,
                                               int64_t t_ns);
MAPLINES_INTERNAL void maplines_conflict_reused(maplines_conflict_t *conflict, int64_t cycle_ns,
                                                int64_t t_ns);
MAPLINES_INTERNAL void maplines_conflict_ahead(maplines_conflict_t *conflict, int64_t t_ns);
MAPLINES_INTERNAL void maplines_conflict_next(maplines_conflict_t *conflict);
MAPLINES_INTERNAL void maplines_conflict_late(maplines_conflict_t *conflict, int64_t cycle_ns,
                                              int64_t t_ns);
MAPLINES_INTERNAL void maplines_conflict_retract(maplines_conflict_t *conflict);
MAPLINES_INTERNAL bool maplines_conflict_was_reused(const maplines_conflict_t *conflict,
                                                    int64_t cycle_ns, int64_t t_ns);
MAPLINES_INTERNAL bool maplines_conflict_is_suspected(const maplines_conflict_t *conflict,
                                                      int64_t cycle_ns, int64_t t_ns);
MAPLINES_INTERNAL void maplines_conflict_elapse(maplines_conflict_t *conflict, int64_t cycle_ns,
                                                int64_t t_ns);

/* sequence.c */

#define MAPLINES_SHORT_ROW 8 ///< short spacings in a row that mean times in another unit

MAPLINES_INTERNAL void maplines_check_init(maplines_check_t *check, int64_t cycle_ns);
/// Whether a line or pose error comes far sooner after the last than the cycle.
MAPLINES_INTERNAL bool maplines_check_spacing(maplines_check_t *check, int64_t cycle_ns,
                                              int64_t t_ns);
/// Check a record whose checksum is correct: MAPLINES_COMPLETE if it is new, DUPLICATE or STALE.
MAPLINES_INTERNAL maplines_reason_t maplines_check_received(maplines_decoder_t *decoder, int owner,
                                                            uint32_t counter, uint32_t content,
                                                            int64_t t_ns, uint8_t records);
/// The last new record completed a line of so many records.
MAPLINES_INTERNAL void maplines_check_delivered(maplines_decoder_t *decoder, int owner,
                                                uint8_t records);
/// A damaged record or frame is an ERROR check.
MAPLINES_INTERNAL void maplines_check_failed(maplines_decoder_t *decoder, int owner, int64_t t_ns);
/// Check a frame that is in no record, by the reason why it was dropped.
MAPLINES_INTERNAL void maplines_check_dropped(maplines_decoder_t *decoder, int owner,
                                              maplines_reason_t reason, int64_t t_ns);
/// State at a time: a NONEWDATA check for each cycle missed up to then.
MAPLINES_INTERNAL maplines_e2e_state_t maplines_check_elapse(maplines_decoder_t *decoder, int owner,
                                                             int64_t t_ns);
MAPLINES_INTERNAL bool maplines_has_one_sender(const maplines_decoder_t *decoder, int owner,
                                               int64_t t_ns);

#if MAPLINES_MIXTURES
/* mixtures.c */

/// Add a new record with a covariance of its own to the mixture of its slot. MAPLINES_COMPLETE if
/// it completes a line: that is the newest then; else PENDING, DUPLICATE or CONTENT.
MAPLINES_INTERNAL maplines_reason_t maplines_add_component(maplines_decoder_t *decoder,
                                                           const maplines_arrival_t *arrival,
                                                           uint32_t *frames);
/// Drop the mixture of a slot, if there is one.
MAPLINES_INTERNAL void maplines_drop_mixture(maplines_decoder_t *decoder, int slot);
/// Drop the mixture of a slot if the counter of a rejected record falls in its range.
MAPLINES_INTERNAL void maplines_drop_mixture_with(maplines_decoder_t *decoder, int slot,
                                                  uint32_t counter);
MAPLINES_INTERNAL void maplines_expire_mixtures(maplines_decoder_t *decoder, int64_t t_ns);
/// Frames of incomplete mixtures.
MAPLINES_INTERNAL uint32_t maplines_pending_mixtures(const maplines_decoder_t *decoder);
#endif

#if MAPLINES_SCENES && MAPLINES_LINE_RECORDS
/* epochs.c */

/// Line that has joined a pose error.
typedef struct {
    int epoch;
    int slot;
    uint32_t frames; ///< that carried the line
} maplines_joined_t;

MAPLINES_INTERNAL void maplines_epochs_init(maplines_epochs_t *epochs);
/// Add a new pose error; return the number of waiting lines that belong to it.
/// `ahead` is by how much its counter is ahead of the last one; 0 after a sequence break.
MAPLINES_INTERNAL int maplines_add_pose(maplines_decoder_t *decoder, const uint8_t *record,
                                        int64_t t_ns, uint32_t ahead,
                                        maplines_joined_t joined[MAPLINES_SLOTS]);
/// Add a new line that is no mixture; whether it joins a pose error. Otherwise it waits, in place
/// of an older one of its slot, which is dropped.
MAPLINES_INTERNAL bool maplines_add_line(maplines_decoder_t *decoder, int slot,
                                         const maplines_joining_t *line, bool is_break,
                                         maplines_joined_t *joined);
MAPLINES_INTERNAL void maplines_expire_epochs(maplines_decoder_t *decoder, int64_t t_ns);
/// Frames of lines that wait for their pose error.
MAPLINES_INTERNAL uint32_t maplines_pending_lines(const maplines_decoder_t *decoder);
/// The newest epoch that waits for no line; false before the first.
MAPLINES_INTERNAL bool maplines_latest_epoch(const maplines_decoder_t *decoder,
                                             maplines_epoch_view_t *view);
#endif

#if MAPLINES_SCENE_RECORDS
/* whole_scenes.c */

/// CONTENT if an intact record holds a value that no sender sends.
MAPLINES_INTERNAL maplines_reason_t maplines_check_whole(const maplines_dbc_t *dbc,
                                                         const maplines_arrival_t *arrival);
/// Add a new record, and return its lines in the order of their places.
MAPLINES_INTERNAL void maplines_add_whole(maplines_decoder_t *decoder,
                                          const maplines_arrival_t *arrival,
                                          maplines_epoch_view_t *lines);
/// The newest scene, whose lines are in the order of slots; false before the first.
MAPLINES_INTERNAL bool maplines_newest_whole(const maplines_decoder_t *decoder,
                                             maplines_epoch_view_t *view);
/// Owner of the record that has brought a line of that scene.
MAPLINES_INTERNAL int maplines_whole_owner(const maplines_decoder_t *decoder, int slot);
/// Why the newest record that names a slot has no line of it; MAPLINES_IN_SCENE if it has.
MAPLINES_INTERNAL maplines_left_out_t maplines_whole_left_out(const maplines_decoder_t *decoder,
                                                              int slot);
#if !MAPLINES_LINE_RECORDS
/// Decode the line of a slot in the newest record that has one; false if none has. Sets the owner
/// of the record.
MAPLINES_INTERNAL bool maplines_decode_newest(const maplines_decoder_t *decoder, int slot,
                                              int *owner, maplines_line_t *line);
#endif
#endif

/* views.c */

#if MAPLINES_SCENES
/// The newest scene; NULL before the first. Where scenes are decoded when they are asked for, it is
/// in `room`.
MAPLINES_INTERNAL const maplines_scene_t *maplines_newest_scene(maplines_decoder_t *decoder,
                                                                maplines_scene_t *room);
#endif
/// Owner of the records that have brought the newest line of a slot.
MAPLINES_INTERNAL int maplines_owner_of_line(const maplines_decoder_t *decoder, int slot);
/// Owner of the records that have brought the pose error of lines of an owner: itself if they need
/// none, or bring it themselves.
MAPLINES_INTERNAL int maplines_owner_of_pose(const maplines_decoder_t *decoder, int owner);
#if MAPLINES_SCENES
/// Owner of the records that have brought the pose error, or a line, of the newest scene.
MAPLINES_INTERNAL int maplines_owner_of_scene(const maplines_decoder_t *decoder);
MAPLINES_INTERNAL int maplines_owner_in_scene(const maplines_decoder_t *decoder, int slot);
#endif

/* decoder.c */

/// A decoder that is there and initialised; has a DBC a slot?
MAPLINES_INTERNAL bool maplines_is_decoder(const maplines_decoder_t *decoder);
MAPLINES_INTERNAL bool maplines_is_slot(const maplines_decoder_t *decoder, int slot);
/// As maplines_feed. Lines that are conditional on the pose error are in `scene`, too, with their
/// parts of the joint covariance; it is not written without such lines, and may be NULL.
MAPLINES_INTERNAL maplines_fed_t maplines_feed_with(maplines_decoder_t *decoder,
                                                    const maplines_frame_t *frame, int64_t t_ns,
                                                    maplines_scene_t *scene);

/* ---- use.c: what the range of a line does not limit */

#if MAPLINES_RECEIVER
/// Lateral position of the mean cubic at any x [m]: also where the line says nothing.
MAPLINES_INTERNAL maplines_real_t maplines_cubic_at(const maplines_gaussian_t *gaussian,
                                                    maplines_real_t x);
#endif

/* ---- sigma_points.c
 * ------------------------------------------------------------------------------ */

#define MAPLINES_MAX_STATES 7 ///< of sigma points: a line and a displacement
#define MAPLINES_SIGMA_POINTS (2 * MAPLINES_MAX_STATES + 1)

/// Function of a state; false where it has no value.
typedef bool (*maplines_function_t)(const double *state, const void *context, double *value);

/// Square lower triangular root R of A A^T, for an (m, n) matrix A, m <= n <= 15; A is overwritten.
MAPLINES_INTERNAL void maplines_lower_root(int m, int n, double *A, double *R);
/// Mean (m) and lower triangular root (m, m), m <= 4, of a function of a Gaussian over n states
/// with an (n, n) root, by 2 n + 1 sigma points. False if the function has no value at one of them.
MAPLINES_INTERNAL bool maplines_unscented(maplines_function_t function, const void *context, int n,
                                          const double *mean, const double *root, int m,
                                          double *value, double *value_root);

#endif // MAPLINES_RECEIVER

#endif
