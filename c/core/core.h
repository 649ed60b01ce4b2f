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

#ifdef __GNUC__
#pragma GCC visibility push(default)
#endif

#include "logs.h"
#include "maplines.h"

#if MAPLINES_FLOAT
#error "the library computes in double precision"
#endif

/* ---- tables.c: what both sides agree on -------------------------------------------------------
 */

/// Version of the sources.
const char *maplines_core_version(void);
/// Compiler that built the library.
const char *maplines_core_compiler(void);
/// Sizes of the structures that the Python package makes, in its order.
size_t maplines_core_size(size_t i);
/// Checksum of declarations.py, with which the library was built.
uint32_t maplines_core_declarations(void);
/// Whether tables are those of a DBC: no signal, page or index is beyond its record.
bool maplines_check_tables(const maplines_dbc_t *dbc);
/// Compute the covariances of a straight line at the spacings of a DBC: its table `straight`.
void maplines_straight_levels(const maplines_dbc_t *dbc, float *straight);

/* ---- batch.c: complete records, and back ------------------------------------------------------
 */

/// Put raw values (count, n) of signals into n records of `length` bytes, which are zero there.
void maplines_pack(size_t count, const maplines_signal_t *signals, size_t n, size_t length,
                   const int64_t *raw, uint8_t *records);
/// Get raw values (count, n) of signals from n records of `length` bytes.
void maplines_unpack(size_t count, const maplines_signal_t *signals, size_t n, size_t length,
                     const uint8_t *records, int64_t *raw);
/// Add page numbers, transfer IDs, counter and checksum to a record that is zero there.
void maplines_seal_record(const maplines_dbc_t *dbc, int owner, size_t length, uint32_t counter,
                          uint8_t *record);

/* Values beside mean and covariance are rows of two arrays:
 *
 *   integers (5, n)  counter, kind, status, component index and count
 *   reals (4, n)     component weight, start and end of the valid range [m], age [s]
 */

/// Whether all of n Gaussians may be sent: finite, symmetric but for rounding, and without negative
/// variances. It sets `symmetric` (n, 4, 4), and which are `indefinite` beyond rounding.
bool maplines_check_gaussians(size_t n, double rounding, const double *mean, const double *cov,
                              double *symmetric, uint8_t *indefinite);
/// Write n records of lines whose values were checked. `powers` are those of 2 of all values of the
/// pivots, by row, and of the inflation, each from the least raw value on, or NULL; `cover`
/// (n, 4, 4), or NULL, is what the decoded covariances must cover besides.
void maplines_encode_lines(const maplines_dbc_t *dbc, const double *const powers[5], size_t n,
                           const double *mean, const double *cov, const double *cover,
                           const uint8_t *indefinite, const int64_t *slot, const int64_t *integers,
                           const double *reals, uint8_t *records);
/// Decoded weights (n, k) of mixtures, and the deficit (n, 4, 4) that they leave. False if there
/// are more components than the core can hold.
bool maplines_cover_mixtures(const maplines_dbc_t *dbc, size_t n, size_t k, const double *weights,
                             const double *means, const double *covs, double *decoded,
                             double *cover);
/// Read n records. The last of the powers are those of the square roots of the inflation; verdicts
/// are 0, or 1 for mixed pages, 2 for the checksum, and 3 for values that no sender sends.
void maplines_decode_lines(const maplines_dbc_t *dbc, const double *const powers[5], size_t n,
                           const uint8_t *records, const uint16_t *data_ids, double *mean,
                           double *cov, int8_t *verdict, int64_t *integers, double *reals);

/* ---- receive.c: a decoder ---------------------------------------------------------------------
 * wire/reception/rows.py makes dtypes of the rows.
 */

/// Line that a frame has completed.
typedef struct {
    int64_t frame; ///< place of the frame
    int64_t t_ns;
    double x_min, x_max, age;
    double mean[4];
    double cov[16];
    uint32_t counter; ///< of its last record, or of its whole scene; so are the next and the checks
    uint32_t ahead;   ///< by which it is ahead of the record before; 0 after a sequence break
    uint8_t slot, kind, status, components;
    uint8_t state;      ///< E2E state after it; if VALID, of its pose error
    uint8_t e2e_status; ///< of the last check
    bool two_senders, usable;
} maplines_line_row_t;

/// Component of the mixture of a line.
typedef struct {
    int64_t line; ///< place of its line among the rows
    double weight;
    double mean[4];
    double cov[16];
} maplines_component_row_t;

/// Scene: of `count` lines, the first ones of each array.
typedef struct {
    int64_t frame; ///< place of the last frame that has changed it; -1: there is none
    int64_t t_ns;
    double age, correlation_time;
    uint32_t counter;
    uint8_t count, state;
    bool two_senders, usable;
    uint8_t slots[MAPLINES_SLOTS];
    uint8_t left_out[MAPLINES_SLOTS]; ///< by slot: why it has no line, maplines_left_out_t
    double x_min[MAPLINES_SLOTS], x_max[MAPLINES_SLOTS];
    double mean[MAPLINES_SLOTS][4];
    double cov[4 * MAPLINES_SLOTS][4 * MAPLINES_SLOTS];
} maplines_scene_row_t;

/// Memory for rows, and how many there are.
typedef struct {
    maplines_line_row_t *lines;
    maplines_component_row_t *components;
    maplines_scene_row_t *scenes;
    size_t max_lines, max_components, max_scenes;
    size_t line_count, component_count, scene_count;
    size_t newest[MAPLINES_SLOTS]; ///< of each slot: its newest line and those before; 0: none
    bool is_waiting;               ///< an authenticated frame is next, for which there is room
} maplines_rows_t;

/// Frames of a block, and those of a decoder among them.
typedef struct {
    size_t count;  ///< of the places
    size_t frames; ///< of the block
    size_t width;  ///< of the data of a frame, at most 64 [byte]
    const int64_t *places;
    const uint32_t *can_ids;
    const uint8_t *are_extended;
    const int64_t *times_ns;
    const uint8_t *lengths; ///< [byte]; at most `width` of them are read
    const uint8_t *data;    ///< (frames, width)
    uint8_t *reasons;       ///< of each frame; 255 if it has completed lines
} maplines_block_t;

/// The newest scene, and covariances that follow from its factors.
typedef struct {
    const maplines_scene_t *scene;      ///< of n lines; valid until the next frame
    uint8_t are_newest[MAPLINES_SLOTS]; ///< the line is the newest of its slot
    maplines_line_row_t lines[MAPLINES_SLOTS];
    double pose_cov[9];
    double specific[MAPLINES_SLOTS][16];
    double cov[16 * MAPLINES_SLOTS * MAPLINES_SLOTS]; ///< (4 n, 4 n)
} maplines_seen_scene_t;

/// Bytes of a frame that a MAC is of: data ID, authentic I-PDU and freshness value.
#define MAPLINES_MAC_DATA 74

/// Authentication of a frame: the core asks for a MAC, or for a second one of an older freshness
/// value, and goes on when it has it.
typedef struct {
    maplines_authenticator_t authenticator; ///< its MACs are the answers
    maplines_frame_t frame;
    int owner;
    int64_t t_ns, now_us;
    maplines_rows_t *rows; ///< of the block of the frame; NULL: it is fed alone
    int64_t place;         ///< in the block
    bool has_scenes;
    uint8_t asked, answered; ///< number of MACs
    uint8_t key_id;
    uint8_t size; ///< of the data of each [byte]
    uint8_t data[2][MAPLINES_MAC_DATA];
    uint8_t macs[2][16];
} maplines_authentication_t;

/// A decoder, and what its functions write: all that one of Python needs. It must not be moved.
typedef struct {
    maplines_decoder_t decoder;
    maplines_rows_t rows; ///< over the next two
    maplines_line_row_t lines[MAPLINES_SLOTS];
    maplines_component_row_t components[MAPLINES_MAX_COMPONENTS];
    maplines_scene_row_t shown; ///< newest scene of a block: a row when another follows
    uint64_t left_out;          ///< lines of which a record of a whole scene has said so
    maplines_seen_scene_t seen;
    maplines_authentication_t secoc;
} maplines_receiver_t;

/// Answer of a function that waits for the MAC of `secoc.data[secoc.answered]`.
#define MAPLINES_ASKS_MAC MAPLINES_REASONS

/// Start; return NULL, or what is wrong with the settings. A window of 1 us or more, about a clock
/// or without one, is that of authenticated frames; with 0, those are dropped.
const char *maplines_receiver_start(maplines_receiver_t *receiver, const maplines_dbc_t *dbc,
                                    maplines_settings_t *settings, int64_t window_us,
                                    bool has_clock);
/// Take a frame: the reason why it completes no line, or minus the number of lines, which are the
/// rows then. Bit 31 of the CAN ID says that it has 29 bits.
int maplines_receiver_feed(maplines_receiver_t *receiver, uint32_t can_id, int64_t t_ns,
                           const uint8_t *data, size_t length);
/// Take an authenticated frame of an owner, at a time of the clock and with the last freshness
/// value that was accepted. The answer is that of maplines_receiver_feed, or MAPLINES_ASKS_MAC.
int maplines_receiver_feed_secured(maplines_receiver_t *receiver, int owner, int64_t t_ns,
                                   const uint8_t *data, size_t length, int64_t now_us,
                                   int64_t last_us);
/// Go on with a MAC of 16 bytes, or with NULL if there is no such key; the answer is as before.
int maplines_receiver_give_mac(maplines_receiver_t *receiver, const uint8_t *mac);
/// Take the frames at the places from `first` on, as long as there is room for the rows of one
/// more, and add their rows; an authenticated frame ends it. It returns the place after the last
/// one.
size_t maplines_receiver_feed_block(maplines_receiver_t *receiver, const maplines_block_t *block,
                                    size_t first, maplines_rows_t *rows, bool has_scenes);
/// Write the newest scene: false if there is none, or it is as in the last call and `is_known`.
bool maplines_receiver_scene(maplines_receiver_t *receiver, bool is_known);
/// State of an owner at a time; whether it has one sender; whether a counter was reused.
int maplines_receiver_elapse(maplines_receiver_t *receiver, int owner, int64_t t_ns);
bool maplines_receiver_has_one_sender(const maplines_receiver_t *receiver, int owner, int64_t t_ns);

/* ---- propagate.c: lines of a map --------------------------------------------------------------
 *
 * Memory is of doubles: as many as the function of its name says. Paths have pointers into their
 * memory, so that stays where it is; that of refits may be copied. Of a transform, z (poses, 3) are
 * its points, with their weights of mean and covariance. Reasons of lines are those of LeftOut by
 * their numbers, from 1 on, or 0. A map error is 1 and the sigmas of points [m], offset [m] and
 * heading [rad], or 0 and any.
 *
 * A query is the mean and covariance of the pose (3), (3, 3) in the frame of the map, the window
 * (2) [m], the largest misfit [m], the largest standard deviation of a line [m], and the map error.
 */

/// Size of paths.
size_t maplines_paths_size(size_t lines, size_t points);
/// Prepare lines of (count, 2) points with their arc lengths [m].
void maplines_prepare_paths(size_t lines, const size_t *count, const double *const *points,
                            const double *const *distance, double *memory);
/// Squared errors that the points of all lines show [m^2]; 0 for two at both ends of each line.
void maplines_point_errors(const double *paths, double *squares);
/// Size of the memory of the functions below, of so many lines that are propagated together: all of
/// a scene, 1 of those one by one, 0 of refits.
size_t maplines_work_size(size_t lines, size_t points, size_t together, size_t poses);
/// Place on the map from which lines are followed (2), how far along them [m], and the covariance
/// of the pose in the frame of the car (3, 3).
void maplines_query_view(const double query[20], double found[12]);
/// Lines one by one. Of the K of `lines` that are given, `found` has the means (lines, 4), the
/// covariances (lines, 4, 4) and the valid ranges (lines, 2) [m], each with K rows that are set.
/// False if a line has no value at a pose, or no Gaussian.
bool maplines_propagate_lines(const double *paths, const double query[20], size_t poses,
                              const double *z, const double *mean_weights,
                              const double *cov_weights, double *memory, uint8_t *left_out,
                              double *found);
/// Lines of a scene, as above: means, valid ranges, fit ranges (lines, 2), coefficients of T_4
/// (lines), line-specific covariances (lines, 4, 4), and the joint covariance (4 K, 4 K). There are
/// at most as many lines as slots.
bool maplines_propagate_scene(const double *paths, const double query[20], size_t poses,
                              const double *z, const double *mean_weights,
                              const double *cov_weights, double *memory, uint8_t *left_out,
                              double *found);

/// Size of refits.
size_t maplines_refits_size(size_t lines);
/// Place on the map from which lines are followed (2), and how far along them [m]. A look is a pose
/// (3), a window (2) [m], and the largest turn [rad].
void maplines_look_from(const double look[6], double start[3]);
/// Refits of the lines that are seen, up to the first one that no cubic follows; their number.
/// Settings are misfit, room, step, and map error.
size_t maplines_refit_lines(const double *paths, const double look[6], const double settings[7],
                            double *memory, uint8_t *left_out, double *refits);
/// What refits have: the ranges (lines, 2), misfits (lines), whether lines are across (lines),
/// coefficients of T_4 (lines), covariances of the noise (lines, 4, 4), and points (lines, 64, 2).
void maplines_refit_fields(const double *refits, double *fields);
/// Lines (n, lines, 4) from poses (n, 3); NaN where they are no functions of x.
void maplines_refit_values(const double *refits, size_t n, const double *poses, double *values);
/// The same, extrapolated where they are none; false if one is none next to the mean pose. Poses
/// may be displacements in the frame of the car.
bool maplines_refit_extended_values(const double *refits, size_t n, const double *poses,
                                    bool are_displacements, double *values);

/// Stretches of the lines that are seen; their number. Of each, the number of its points, the range
/// (2) [m], and the points [m], which stand one after the other.
size_t maplines_see_lines(const double *paths, const double look[6], double *memory,
                          uint8_t *left_out, size_t *count, double *x_range, double *x, double *y);

/// Lines one by one for a caller that computes the moments: refits of the lines that are given, and
/// their ranges (lines, 2) [m]; their number.
size_t maplines_fit_lines(const double *paths, const double query[20], double *memory,
                          uint8_t *left_out, double *x_ranges, double *refits);
/// Shorten the range of a line to where it is certain enough; false if too little is left.
bool maplines_shorten_line(const double mean[4], const double cov[16], double max_sigma,
                           double x_range[2]);
/// Size of the search of a scene.
size_t maplines_search_size(void);
/// Begin a scene for a caller that computes the moments; memory is that of a scene of no poses.
void maplines_search_scene(const double *paths, const double query[20], double *memory,
                           double *search);
/// Refits of the lines that are kept; their number. If it is not 0, moments and settling follow.
size_t maplines_search_fit(double *search, uint8_t *left_out, double *refits);
/// Valid ranges (K, 2) [m] of the K lines with these means (K, 4) and joint covariance; false if
/// they are to be fitted again.
bool maplines_search_settle(double *search, double *means, double *cov, double *x_ranges);

/// Moments of values (n, outputs, m) at weighted points, of which the first is at the mean or next
/// to it: means (outputs, m) and covariances (outputs, m, m). The scratch is (m).
void maplines_moments_of(size_t n, size_t outputs, size_t m, const double *mean_weights,
                         const double *cov_weights, const double *values, double *scratch,
                         double *means, double *covs);

/* ---- values.c: Gaussians, and places of a line ------------------------------------------------
 */

/// Whether a mean (n) and a covariance (n, n) are those of a Gaussian, up to a relative rounding
/// error. It makes the covariance exactly symmetric; memory is n (n + 1) doubles.
bool maplines_check_gaussian(size_t n, double rounding, const double *mean, double *cov,
                             double *memory);
/// Lower triangular factor of an (n, n) matrix, n up to 32; false if a pivot is not positive.
bool maplines_factor_of(size_t n, const double *S, double *L);
/// Lower triangular square root of an (n, n) covariance, which may be singular, n <= 4.
void maplines_root_of(size_t n, const double *cov, double *L);
/// Eigenvalues (count, n) and eigenvectors of symmetric matrices (count, n, n), n up to 32. The
/// matrices are overwritten.
void maplines_eigen_of(size_t count, size_t n, double *S, double *values, double *V);
/// Lateral position of a line at x, and its standard deviation to first order [m].
double maplines_line_y(double y_off, double beta, double c0, double c1, double x);
double maplines_line_sigma(double beta, const double cov[16], double x);
/// maplines_y_extrapolated at n places.
void maplines_extrapolate(const maplines_line_t *line, size_t n, const double *x, double *y,
                          double *sigma);

/// Arc length [m] of the point of a line nearest to another one, if nothing overflows. Boxes
/// (runs, 4) are lower and upper corners around `length` successive segments each.
double maplines_nearest_place(size_t count, const double *points, const double *distance,
                              size_t length, const double *boxes, double x, double y);

/// Values of an elementary function by its number: exp2, log2, tan, atan, or sine and cosine.
void maplines_elementary(int function, size_t n, const double *x, double *y, double *cosine);

/// Lines seen from other poses. Curves (lines, 7) are means (4), fit ranges (2) [m] and
/// coefficients of T_4 [m]. Functions that return a boolean return false if a line is no function
/// of x where it must be one.
bool maplines_are_functions(size_t lines, const double *curves);
/// Derivatives (lines, 4, 4) with respect to the coefficients of T_0 .. T_3.
void maplines_bases_of(size_t lines, const double *means, const double *fit_ranges, double *J);
/// Lines (n, lines, 4) after displacements (n, 3).
bool maplines_see_curves(size_t lines, const double *curves, size_t n, const double *poses,
                         double *found);
/// Lines (n, 4), each after a displacement of its own (n, 3); NaN where they are no functions of x.
void maplines_transform_curves(size_t n, const double *curves, const double *poses, double *found);
/// Derivatives (lines, 4, 3) with respect to the displacement.
void maplines_curve_jacobians(size_t lines, const double *curves, double *J);
/// Move lines so that they are the means over a pose error with covariance P.
void maplines_centre_curves(size_t lines, double *curves, const double P[9]);
/// Joint covariance (4 lines, 4 lines) for a pose error, and its factor A (4 lines, 7).
bool maplines_spread_curves(size_t lines, const double *curves, const double P[9], double *A,
                            double *cov);

/* ---- send.c: lines and scenes to records ------------------------------------------------------
 */

/// Secured I-PDU to be sent.
typedef struct {
    maplines_record_t layout; ///< its fields of secured I-PDUs
    uint16_t data_id;
    maplines_signer_t signer;        ///< with key ID and last freshness value
    uint8_t size;                    ///< of the data [byte]
    uint8_t data[MAPLINES_MAC_DATA]; ///< that need a MAC
    const uint8_t *mac;              ///< that was given for the data; NULL: it is asked for
    uint8_t pdu[64];
} maplines_signing_t;

/// Line to be sent, but for its Gaussian.
typedef struct {
    int32_t slot, kind, status;
    double x_min, x_max, age;
} maplines_given_line_t;

/// Scene to be sent.
typedef struct {
    size_t count; ///< n
    const maplines_given_line_t *lines;
    const double *gaussians;  ///< (n, 20) mean and covariance of each line by itself
    const double *fit_ranges; ///< (n, 2)
    const double *quartics;   ///< (n,)
    const double *cov;        ///< (4 n, 4 n)
    const double *specific;   ///< (n, 4, 4), or NULL
    const double *pose_cov;   ///< (3, 3)
    double correlation_time, offset_sigma, heading_sigma;
} maplines_given_scene_t;

/// Record of a line, without what changes from cycle to cycle.
typedef struct {
    uint8_t slot;
    uint8_t length; ///< [byte]
    bool is_there;  ///< it can be sent
    uint8_t bytes[MAPLINES_MAX_RECORD];
} maplines_template_t;

/// Scene but for counters and ages. Its memory begins with zeros.
typedef struct {
    uint8_t count; ///< of the lines
    maplines_template_t records[MAPLINES_SLOTS];
    maplines_scene_workspace_t space;
} maplines_prepared_t;

/// Write the secured I-PDU of a record and return its length; without a MAC, write the data that it
/// is asked for of, and return 0. 0 with a MAC: there is no further freshness value.
size_t maplines_sign(maplines_signing_t *signing, size_t length, const uint8_t *record,
                     int64_t now_us, const uint8_t *mac);
/// Write the records of n lines, m in all, and advance the counters of their slots. False if a line
/// cannot be sent; records and counters are then of no use.
///
/// `powers` are as in maplines_encode_lines, or NULL. `components` (n,) are those of each line,
/// with `weights` (m,) if it is a mixture of more than one; both are NULL if none is. `gaussians`
/// (m, 20) are mean and covariance of each component.
bool maplines_write_lines(const maplines_dbc_t *dbc, const double *const *powers, size_t n,
                          const maplines_given_line_t *lines, const int32_t *components,
                          const double *gaussians, const double *weights,
                          int64_t counters[MAPLINES_OWNERS], uint8_t *records);
/// Encode a scene but for counters and ages: MAPLINES_SENT, or why it cannot be sent; -1 if a value
/// is none that a scene has.
int maplines_prepare_scene(const maplines_dbc_t *dbc, const maplines_given_scene_t *scene,
                           bool is_full, maplines_prepared_t *prepared);
/// Write the records of the pose error and of the lines of n slots, one after the other, of up to
/// MAPLINES_MAX_RECORD each; slots are in the order of the scene. Counters advance. False if an age
/// is none, or a line has no record; records and counters are then of no use.
bool maplines_write_scene(const maplines_dbc_t *dbc, const maplines_prepared_t *prepared, size_t n,
                          const uint8_t *slots, const double ages[MAPLINES_OWNERS],
                          int64_t counters[MAPLINES_OWNERS], uint8_t lengths[MAPLINES_OWNERS],
                          uint8_t *records);
/// Write the records of a whole scene, those of Scene2 and of Scene, or of Scene alone, one after
/// the other, of up to MAPLINES_MAX_RECORD each; their number. `slots` has one bit for each line
/// that is to be sent. Counters and places advance. 0 if an age is none; nothing has changed then.
size_t maplines_write_whole_scene(const maplines_dbc_t *dbc, const maplines_prepared_t *prepared,
                                  uint32_t slots, bool is_secured,
                                  const double ages[MAPLINES_OWNERS],
                                  int64_t counters[MAPLINES_OWNERS],
                                  maplines_chosen_places_t *places, uint8_t lengths[2],
                                  uint8_t *records);
/// Choose the places of the lines of a scene, as when it is written.
void maplines_place_lines(const maplines_dbc_t *dbc, const maplines_prepared_t *prepared,
                          uint32_t slots, bool is_secured, maplines_chosen_places_t *places);

#ifdef __GNUC__
#pragma GCC visibility pop
#endif

#endif
