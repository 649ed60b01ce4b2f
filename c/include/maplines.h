/* maplines: the lines of a digital map on a CAN bus, with their uncertainty.
 *
 * This is the interface of a sender and a receiver in an ECU: CAN frames to lines with their
 * covariances, and back. All bits, factors and CAN IDs are in constant tables that
 * `maplines generate c` writes from a DBC; the code is the same for every DBC.
 *
 * To build it in, compile maplines.c and the tables (maplines_dbc.c) with a C99 compiler, and link
 * the mathematical library. Give gcc and clang -ffp-contract=off: a fused multiplication gives
 * other bits than the Python package, which is the model of this code. The source forbids it, too,
 * by a pragma, which clang's -ffp-contract=fast overrules.
 *
 *     #include "maplines_dbc.h"
 *     static maplines_decoder_t decoder;  // all memory: 1 to 51 kB, by what the program needs
 *
 *     maplines_decoder_init(&decoder, &maplines_dbc, NULL);
 *     ...
 *     maplines_feed(&decoder, &frame, t_ns);                      // each frame that is received
 *     maplines_view_t view;
 *     maplines_latest(&decoder, MAPLINES_EGO_LEFT, now_ns, &view);  // at any time
 *     if (view.is_usable && maplines_is_valid_at(view.line, 40))
 *     {
 *         steer(maplines_y(view.line, 40), maplines_y_sigma(view.line, 40));
 *     }
 *
 * Memory   The caller owns all of it. There is no allocation and no static state. A decoder and an
 *          encoder are structures of constant size; an assignment copies them.
 * Threads  Functions share nothing but the constant tables. One thread at a time may use a
 *          decoder or an encoder.
 * Time     is an argument [ns], of any clock that runs steadily.
 * Loops    are bounded by the constants below. There is no recursion.
 * Errors   What the bus sends is counted, and never asserted. A caller's mistake is asserted: NULL,
 *          a decoder or encoder that is not initialised, a frame of more than 64 bytes, a number
 *          that is no value of its enumeration. A number that is not finite or out of its range
 *          is refused by the result, and asserted only where no result can say so. The assertion is
 *          MAPLINES_ASSERT(condition), by default assert(); define it as another expression for
 *          all sources, such as -D'MAPLINES_ASSERT(c)=((c) ? (void)0 : on_mistake())'. Where it
 *          returns, or is off by NDEBUG, the function refuses: it returns NULL, false, NaN or a
 *          reason, or does nothing; a result that it can write to says that nothing is usable.
 * Needs    <math.h>: sqrt, sqrtf, fabs, floor, ceil, rint, ldexp, frexp and copysign, all of
 *          which are exact: IEEE 754 defines each bit of them. <string.h>: memcpy, memset, memcmp.
 *          <assert.h> unless MAPLINES_ASSERT is defined.
 *
 * Lengths are in metres, angles in radians, x points ahead and y to the left (ISO 8855).
 */
#ifndef MAPLINES_H
#define MAPLINES_H

#include <float.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Some compilers for small controllers have a double of 4 bytes, and an option for one of 8. */
#if FLT_RADIX != 2 || FLT_MANT_DIG != 24 || DBL_MANT_DIG != 53
#error "maplines needs float of 24 and double of 53 binary digits: compile with a 64-bit double"
#endif

#ifdef __cplusplus
extern "C" {
#endif

#define MAPLINES_VERSION "0.1.0"

/* Number of the interface; a change that a program must know of increases it.
 * 2: functions of x give NaN outside of the valid range of a line.
 * 3: an age of a scene to be sent counts only if has_age, or has_pose_age, says so.
 */
#define MAPLINES_INTERFACE 3

/* ---- build -------------------------------------------------------------------------------------
 * What the library has, and the sizes of its structures. `maplines generate c` writes here what the
 * DBC and its options ask for. All files of a program need the same; others do not link.
 */
/* build: begin */
#ifndef MAPLINES_RECEIVER
#define MAPLINES_RECEIVER 1 ///< frames to lines
#endif
#ifndef MAPLINES_SENDER
#define MAPLINES_SENDER 1 ///< lines to frames
#endif
#ifndef MAPLINES_SCENES
#define MAPLINES_SCENES 1 ///< lines with the error of their pose
#endif
#ifndef MAPLINES_LINE_RECORDS
#define MAPLINES_LINE_RECORDS 1 ///< records of one line each, and of the pose error
#endif
#ifndef MAPLINES_SCENE_RECORDS
#define MAPLINES_SCENE_RECORDS MAPLINES_SCENES ///< records of whole scenes, one CAN FD frame each
#endif
#ifndef MAPLINES_SECOC
#define MAPLINES_SECOC 1 ///< authenticated frames
#endif
#ifndef MAPLINES_FLOAT
#define MAPLINES_FLOAT 0 ///< a receiver computes with float, for CPUs without double precision
#endif
#ifndef MAPLINES_SLOTS
#define MAPLINES_SLOTS 8 ///< lines around the car: the first ones of maplines_owner_t
#endif
#ifndef MAPLINES_MAX_PAGES
#define MAPLINES_MAX_PAGES 8 ///< pages of 8 bytes of a record
#endif
#ifndef MAPLINES_MAX_TRANSFER_IDS
#define MAPLINES_MAX_TRANSFER_IDS 16
#endif
#ifndef MAPLINES_MAX_COMPONENTS
#define MAPLINES_MAX_COMPONENTS 8 ///< components of a mixture; 1: there are no mixtures
#endif
#ifndef MAPLINES_TRANSFERS
#define MAPLINES_TRANSFERS MAPLINES_MAX_TRANSFER_IDS ///< of a slot that are remembered
#endif
#ifndef MAPLINES_HISTORY
#define MAPLINES_HISTORY 256 ///< records of a slot that are remembered, a power of 2
#endif
#ifndef MAPLINES_EPOCHS
#define MAPLINES_EPOCHS 8 ///< pose errors that lines may still join
#endif
#ifndef MAPLINES_WINDOW
#define MAPLINES_WINDOW 255 ///< longest window of an E2E state machine [checks]
#endif
/* build: end */

#include "maplines_build.h" // checks these sizes, and puts the build into the names of functions

/// Owners of records of lines: slots, and the pose error.
#define MAPLINES_LINE_OWNERS (MAPLINES_LINE_RECORDS * (MAPLINES_SLOTS + MAPLINES_SCENES))
/// Owners of all records: those, and the messages of whole scenes.
#define MAPLINES_OWNERS (MAPLINES_LINE_OWNERS + 2 * MAPLINES_SCENE_RECORDS)
/// The first one of maplines_owner_t that the build has: arrays by owner begin with it.
#define MAPLINES_FIRST_OWNER (MAPLINES_LINE_RECORDS ? 0 : MAPLINES_SLOTS + 1)
#define MAPLINES_MAX_RECORD (8 * MAPLINES_MAX_PAGES)                       ///< [byte]
#define MAPLINES_MAX_FRAMES (MAPLINES_MAX_PAGES * MAPLINES_MAX_COMPONENTS) ///< of a line
#define MAPLINES_MIXTURES (MAPLINES_MAX_COMPONENTS > 1)
#define MAPLINES_MAX_PLACES 8 ///< lines in a record of a whole scene

/* ---- values ---------------------------------------------------------------------------------- */

/// Number of the build, float or double. Only what a receiver computes with lines is in this type;
/// a sender is exact in either build.
typedef MAPLINES_REAL maplines_real_t;

/// Identity of a line around the car, and owner of records.
typedef enum {
    MAPLINES_EGO_LEFT = 0,
#if MAPLINES_SLOTS > 1
    MAPLINES_EGO_RIGHT = 1,
#endif
#if MAPLINES_SLOTS > 2
    MAPLINES_NEXT_LEFT = 2,
#endif
#if MAPLINES_SLOTS > 3
    MAPLINES_NEXT_RIGHT = 3,
#endif
#if MAPLINES_SLOTS > 4
    MAPLINES_CENTRE = 4,
#endif
#if MAPLINES_SLOTS > 5
    MAPLINES_EDGE_LEFT = 5,
#endif
#if MAPLINES_SLOTS > 6
    MAPLINES_EDGE_RIGHT = 6,
#endif
#if MAPLINES_SLOTS > 7
    MAPLINES_ROUTE = 7,
#endif
    MAPLINES_POSE = MAPLINES_SLOTS,       ///< no slot, but the pose error
    MAPLINES_SCENE = MAPLINES_SLOTS + 1,  ///< whole scenes: the ego lane, and lines beside it
    MAPLINES_SCENE2 = MAPLINES_SLOTS + 2, ///< their edges, and what has no place in the first
} maplines_owner_t;

/// Kind of marking or boundary.
typedef enum {
    MAPLINES_KIND_UNKNOWN = 0,
    MAPLINES_SOLID = 1,
    MAPLINES_DASHED = 2,
    MAPLINES_DOUBLE = 3,
    MAPLINES_ROAD_EDGE = 4,
    MAPLINES_KERB = 5,
    MAPLINES_BARRIER = 6,
    MAPLINES_VIRTUAL = 7,
} maplines_kind_t;

/// Quality of the covariance of a line.
typedef enum {
    MAPLINES_UNKNOWN = 0,      ///< only the mean was sent; the standard deviations are vague
    MAPLINES_FULL = 1,         ///< the covariance covers the sender's, including correlations
    MAPLINES_DIAGONAL = 2,     ///< the variances cover the sender's; correlations were not sent
    MAPLINES_REPAIRED = 3,     ///< as FULL; an indefinite matrix was replaced by one that covers it
    MAPLINES_SATURATED = 4,    ///< as FULL, but wider than necessary
    MAPLINES_OUT_OF_RANGE = 5, ///< use neither mean nor covariance
} maplines_status_t;

#if MAPLINES_SCENES
/// Why a line does not belong to the scene as it is sent. A record of a whole scene says so.
typedef enum {
    MAPLINES_IN_SCENE = 0,            ///< it does
    MAPLINES_LEFT_OUT_ACROSS = 1,     ///< it is across the car's x axis
    MAPLINES_LEFT_OUT_RANGE = 2,      ///< the message cannot state its range
    MAPLINES_LEFT_OUT_MEAN = 3,       ///< the message cannot state its parameters
    MAPLINES_LEFT_OUT_COVARIANCE = 4, ///< no covariance of the message covers it
    MAPLINES_LEFT_OUT_PLACE = 5,      ///< records of whole scenes have no place for it
} maplines_left_out_t;
#endif

/// CAN frame.
typedef struct {
    uint32_t can_id;
    bool is_extended; ///< the CAN ID has 29 bits
    bool is_fd;       ///< of a frame to be sent; a receiver goes by the CAN ID
    uint8_t length;   ///< [byte]
    uint8_t data[64];
} maplines_frame_t;

/* Structures that stand further below, or in maplines_state.h: the tables of a DBC, the state and
 * the settings of a receiver, and memory of a sender. Their sizes are known there; the caller owns
 * them.
 */
typedef struct maplines_dbc maplines_dbc_t;
typedef struct maplines_decoder maplines_decoder_t;
typedef struct maplines_settings maplines_settings_t;
typedef struct maplines_scene maplines_scene_t;
typedef struct maplines_scene_workspace maplines_scene_workspace_t;

#if MAPLINES_RECEIVER
/* ---- receive ---------------------------------------------------------------------------------
 * Every record passes the same stations; each may drop it, with a counted reason:
 *
 *     frame          MAC and freshness, with a verifier
 *       |            records of lines: all pages of one transfer, or none; time-outs
 *     record         length, page numbers, transfer IDs, CRC; values that no sender sends
 *       |            counter: duplicate, late or new; E2E status and state
 *     new record     mixtures: a line of all its components, or none
 *       |            epochs: lines of one pose error; records that wait for theirs
 *       |            whole scenes: two records of one pose error
 *     lines, scene   may they be used: E2E state, age, second sender
 *
 * The records of a DBC are either those of lines, each with its own counter, or whole scenes: a
 * frame with a pose error and up to MAPLINES_MAX_PLACES lines, which need nothing else. A library
 * for whole scenes only (MAPLINES_LINE_RECORDS 0) keeps records as they came, and decodes lines
 * when they are copied:
 *
 *     ask for            records of lines                         whole scenes only
 *     a line             maplines_latest, maplines_copy_line      maplines_copy_line
 *     a scene            maplines_latest_scene, _copy_scene       maplines_copy_scene
 *     of a mixture       maplines_component
 *
 * Of records of lines, three pages of each are sent one after the other, and the pose error before
 * them:
 *
 *     page    0 1 2    0 1 2   0 1 2   0 1 2   0   2            0 1 2
 *     of      pose     line A  line B  line C  line D           pose
 *     --------------------------------------------------------------------> time
 *                  |       |       |       |               |        |
 *             PENDING      A       B       C         TIMEOUT: 2 frames
 *                                                                   scene with A, B and C
 *
 * The counter of a record tells whether it is new, however late it comes:
 *
 *     counter  41       42       44       43       44       45
 *     -----------|--------|--------|--------|--------|--------|-----------> time
 *                new      new      new      STALE    DUPLICATE new
 *     E2E        OK       OK     OKSOMELOST WRONGSEQ. REPEATED OK
 */

/// Start a receiver of the messages of a DBC.
///
/// @param settings NULL for the default. They are copied; the authenticator that they point to is
///        the caller's, and is read with each authenticated frame.
/// @return NULL, or which setting is wrong: then every frame is FOREIGN.
const char *maplines_decoder_init(maplines_decoder_t *decoder, const maplines_dbc_t *dbc,
                                  const maplines_settings_t *settings);

/// Reason why a received frame does not complete a line, in the order of the Python package.
typedef enum {
    MAPLINES_COMPLETE = -1,        ///< none: it completes one line or more
    MAPLINES_PENDING = 0,          ///< held until the other pages of its transfer arrive
    MAPLINES_FOREIGN = 1,          ///< its CAN ID carries no map line
    MAPLINES_LENGTH = 2,           ///< its payload has the wrong length
    MAPLINES_PAGE = 3,             ///< its page number is not in the DBC
    MAPLINES_DUPLICATE = 4,        ///< its page or its line was already received
    MAPLINES_REPLACED = 5,         ///< another frame with its transfer ID was kept in its place
    MAPLINES_STALE = 6,            ///< a line of its slot that is as new or newer was delivered
    MAPLINES_INCOMPLETE = 7,       ///< a frame of another record came before its own was complete
    MAPLINES_TIMEOUT = 8,          ///< the rest of its transfer or line was not received in time
    MAPLINES_MIXED = 9,            ///< the pages of its record belong to different transfers
    MAPLINES_CRC = 10,             ///< the checksum of its record is wrong
    MAPLINES_CONTENT = 11,         ///< its record holds a value that no sender may send
    MAPLINES_NO_POSE = 12,         ///< the pose error of its record was not received in time
    MAPLINES_UNAUTHENTICATED = 13, ///< its message has no MAC, and this receiver requires one
    MAPLINES_KEY = 14,             ///< its MAC is of a key that this receiver does not have
    MAPLINES_MAC = 15,             ///< its MAC is wrong
    MAPLINES_REPLAY = 16,          ///< its freshness value is not newer than the last accepted one
    MAPLINES_AGE = 17,             ///< its freshness value is outside the window about now
    MAPLINES_SPACING = 18, ///< records of its owner follow each other far faster than its cycle
    MAPLINES_REASONS = 19, ///< number of reasons
} maplines_reason_t;

/// Result of maplines_feed.
typedef struct {
    maplines_reason_t reason; ///< MAPLINES_COMPLETE, or why the frame completes no line
    uint8_t count;            ///< number of lines that it completes
    maplines_owner_t slots[MAPLINES_SLOTS]; ///< of these, in this order
} maplines_fed_t;

/// Take a data frame that was received. Any one may come at any time; remote frames and error
/// frames are not for this function.
///
/// The reason is MAPLINES_PENDING, too, if the frame completes a pose error, a component of a
/// mixture, or a line that waits for its pose error, or is a whole scene without a line.
maplines_fed_t maplines_feed(maplines_decoder_t *decoder, const maplines_frame_t *frame,
                             int64_t t_ns);

/// Result of the E2E check of one record, numbered as in AUTOSAR E2E profile 5.
typedef enum {
    MAPLINES_E2E_OK = 0x00,
    MAPLINES_E2E_NONEWDATA = 0x01,
    MAPLINES_E2E_ERROR = 0x07,
    MAPLINES_E2E_REPEATED = 0x08,
    MAPLINES_E2E_OKSOMELOST = 0x20,
    MAPLINES_E2E_WRONGSEQUENCE = 0x40,
    MAPLINES_E2E_NONE = 0xFF, ///< no check yet
} maplines_e2e_status_t;

/// State of the records of an owner, numbered as in AUTOSAR.
typedef enum {
    MAPLINES_E2E_VALID = 0,
    MAPLINES_E2E_NODATA = 2,
    MAPLINES_E2E_INIT = 3,
    MAPLINES_E2E_INVALID = 4,
} maplines_e2e_state_t;

/// Gaussian over (y_off [m], beta [rad], c0 [1/m], c1 [1/m^2]).
typedef struct {
    maplines_real_t mean[4];
    /// Square root F of the covariance: F F^T. Row i belongs to parameter i. F is lower triangular
    /// with its rows in the order of the DBC (see maplines_cholesky_t); of a mixture, in this
    /// order.
    maplines_real_t factor[4][4];
} maplines_gaussian_t;

/// Line l(x) = y_off + tan(beta) x + c0/2 x^2 + c1/6 x^3, valid from x_min to x_max.
typedef struct {
    maplines_gaussian_t gaussian; ///< of a mixture: its mean and covariance
    maplines_real_t x_min;        ///< start of the valid range [m]
    maplines_real_t x_max;        ///< end of the valid range [m]
    maplines_real_t age;          ///< from the pose to the sending [s]; infinite if too old
    int64_t t_ns;                 ///< reception of the first frame [ns]
    maplines_owner_t slot;
    maplines_kind_t kind;
    maplines_status_t status;
    uint8_t components; ///< 1, or the number of components of a mixture: see maplines_component
} maplines_line_t;

/// State of a slot when the consumer asks.
typedef struct {
    const maplines_line_t *line; ///< the newest; NULL before the first. Valid until the next frame
    maplines_real_t age;         ///< from the pose of the line to now [s]; infinite if too old,
                                 ///< unknown, or without a line
    maplines_owner_t slot;
    maplines_e2e_state_t state;   ///< of the messages that brought the line: of its slot or whole
                                  ///< scene; if the line is conditional on a message of the pose
                                  ///< error, VALID only if that is, too
    maplines_e2e_status_t status; ///< of the last check of its slot or whole scene
#if MAPLINES_SCENE_RECORDS
    maplines_left_out_t left_out; ///< the newest whole scene that names the slot has no line of it,
                                  ///< for this reason; then `line` is older, or NULL
#endif
    bool is_stale;    ///< nothing newer came for some cycles, or the line comes after now
    bool two_senders; ///< detected in the last 256 cycles, or suspected, on these messages
    bool is_usable;   ///< a controller may use the line: VALID, not stale, one sender, a finite
                      ///< age, and not OUT_OF_RANGE
} maplines_view_t;

#if MAPLINES_LINE_RECORDS
/// The newest line of a slot, and whether it may be used.
///
/// @param now_ns current time on the clock of the frames' times. If it is before the reception of
///        the line by more than 1 ms, this clock was set back: the line is stale, and has no age.
///        The E2E state moves on to this time: cycles up to it without a record count as missed.
///
/// A slot that the DBC does not have is a caller's mistake; it has no line and no state.
void maplines_latest(maplines_decoder_t *decoder, maplines_owner_t slot, int64_t now_ns,
                     maplines_view_t *view);
#endif

/// What maplines_view_t says, with the line itself: nothing in it points into the decoder, so that
/// another task can have it. The components of a mixture stay in the decoder.
typedef struct {
    maplines_line_t line; ///< all zeros if there is none
    bool has_line;
    bool is_stale, two_senders, is_usable; ///< as in maplines_view_t, at `now_ns`
    maplines_owner_t slot;
    maplines_e2e_state_t state;
    maplines_e2e_status_t status;
#if MAPLINES_SCENE_RECORDS
    maplines_left_out_t left_out;
#endif
    maplines_real_t age; ///< from the pose of the line to `now_ns` [s]; it grows from then on
    int64_t now_ns;      ///< time of the copy: a reader must not use an old one
} maplines_line_copy_t;

/// Copy the newest line of a slot with its state; see maplines_latest, and docs/isr.md. In a
/// library for whole scenes only, that is the line of the newest Scene or Scene2, the later one of
/// the two: there is none if both have no line of the slot.
void maplines_copy_line(maplines_decoder_t *decoder, maplines_owner_t slot, int64_t now_ns,
                        maplines_line_copy_t *copy);

#if MAPLINES_LINE_RECORDS
/// The newest line of a slot, whatever its age; NULL before the first. Valid until the next frame.
const maplines_line_t *maplines_newest(const maplines_decoder_t *decoder, maplines_owner_t slot);

/// Component of the newest line of a slot. A line that is no mixture has one, of weight 1.
///
/// @param i from 0 to line->components - 1.
/// @return false if there is none; then nothing is written.
bool maplines_component(const maplines_decoder_t *decoder, maplines_owner_t slot, uint8_t i,
                        maplines_gaussian_t *gaussian, maplines_real_t *weight);

/// Drop the transfers, mixtures and waiting lines that have timed out.
void maplines_expire(maplines_decoder_t *decoder, int64_t t_ns);
#endif

/* ---- use a line ------------------------------------------------------------------------------ */

/// A quantity and its standard deviation, in the same unit.
typedef struct {
    maplines_real_t value;
    maplines_real_t sigma; ///< 0 or more; infinite if nothing is known; NaN if the value is NaN
} maplines_estimate_t;

/* A standard deviation is computed as the norm of F^T J, to first order in the parameters, and is
 * not less than the exact norm: what single or double precision rounds is added. With float this
 * is 1.5e-6 of the sum of |J_i| sigma_i for y(x), and a third more for each further term.
 *
 * A line is the best cubic over its range, and not the road at one place. Right are lateral
 * positions within the valid range, slopes over 10 m or more, and curvatures over 10 m or more.
 *
 * Outside of the valid range a line says nothing: a road that bends there is no mistake of the
 * sender. So values and standard deviations are NaN if they need the line at an x that is not
 * from x_min to x_max, or NaN; 1 mm is allowed for the rounding of x. So they are if the value is
 * not finite, as of a line that is made by hand. A comparison with NaN is false, so ask
 * maplines_is_valid_at first, or write tests that a NaN fails.
 */

/// Whether x is in the valid range of a line, x_min to x_max, and no NaN. No x is in a range that
/// ends before it starts.
bool maplines_is_valid_at(const maplines_line_t *line, maplines_real_t x);

/// Lateral position of the mean line at x [m]; NaN outside of its range.
maplines_real_t maplines_y(const maplines_line_t *line, maplines_real_t x);

/// Standard deviation of the lateral position at x [m]; NaN outside of the range.
maplines_real_t maplines_y_sigma(const maplines_line_t *line, maplines_real_t x);

/// Lateral position at any finite x [m], and what is known of it; NaN if the range of the line ends
/// before it starts.
///
/// In the range it is maplines_y with its standard deviation. At a distance of d [m] beyond an end,
/// the mean goes on with its second derivative at the end. The standard deviations there of
/// position, slope and second derivative, s_y, s_m and s_k, add up, and the road may turn as
/// tightly as a car can, on a radius of 5 m, which counts as three standard deviations:
///
///     sigma = s_y + s_m d + (s_k + (1 + slope^2)^(3/2) / (3 * 5 m)) d^2 / 2
///
/// It increases with d: by 0.8 m at 5 m, 3.3 m at 10 m and 53 m at 40 m on a straight line.
maplines_estimate_t maplines_y_extrapolated(const maplines_line_t *line, maplines_real_t x);

/// Slope over a distance of more than 0 m, of which x is the middle [1]. NaN if x - distance / 2 or
/// x + distance / 2 is outside of the range.
maplines_estimate_t maplines_slope(const maplines_line_t *line, maplines_real_t x,
                                   maplines_real_t distance);

/// Second difference over a distance of more than 0 m, of which x is the middle, as a curvature
/// [1/m]: (y(x - h) - 2 y(x) + y(x + h)) / h^2 with h half the distance. NaN if x - h or x + h is
/// outside of the range.
maplines_estimate_t maplines_curvature(const maplines_line_t *line, maplines_real_t x,
                                       maplines_real_t distance);

/// Covariance of the four parameters.
void maplines_covariance(const maplines_gaussian_t *gaussian, maplines_real_t covariance[4][4]);

/// One term of a weighted sum of lateral positions: weight * y(x) of the line of a slot.
typedef struct {
    maplines_owner_t slot;
    maplines_real_t x; ///< [m], in the valid range of the line
    maplines_real_t weight;
} maplines_term_t;

/// A lateral position that another sensor measures, with an independent error.
typedef struct {
    maplines_real_t x;     ///< [m]
    maplines_real_t y;     ///< [m]
    maplines_real_t sigma; ///< more than 0 [m]
} maplines_position_t;

#define MAPLINES_MAX_POSITIONS 8 ///< positions of maplines_mahalanobis

/// Mahalanobis distance of up to MAPLINES_MAX_POSITIONS measured lateral positions from a line. Its
/// square has a chi-square distribution of `count` degrees of freedom if line and measurement are
/// of the same thing. Infinite if a sigma is 0 or a value is not finite; NaN if the x of a position
/// is outside of the range of the line.
maplines_real_t maplines_mahalanobis(const maplines_line_t *line, size_t count,
                                     const maplines_position_t *positions);
#endif // MAPLINES_RECEIVER

#if MAPLINES_RECEIVER && MAPLINES_SCENES
/* ---- lines of one pose: a scene -------------------------------------------------------------- */

/// Lines of one pose, with a square root of their joint covariance.
///
/// The covariance of the 4 n parameters of n lines is A A^T + diag(F_0 F_0^T, F_1 F_1^T, ...) with
/// A the rows of `spread`, and F_i those of `specific`. The factor of each line is a root of its
/// block, with variances that are larger by a share of 2^-42, as all of them are in Python's
/// matrix: more than the rounding errors of a sum. In single precision A and F_i cover those in
/// double precision, with standard deviations that are 0.05 % larger.
struct maplines_scene {
    uint8_t count; ///< n
    maplines_line_t lines[MAPLINES_SLOTS];
    maplines_real_t spread[4 * MAPLINES_SLOTS][7];  ///< due to the pose error
    maplines_real_t specific[MAPLINES_SLOTS][4][4]; ///< line-specific
    maplines_real_t fit_range[MAPLINES_SLOTS][2];   ///< [m]
    maplines_real_t quartic[MAPLINES_SLOTS];        ///< coefficient of T_4 in this range [m]
    maplines_real_t pose_factor[3][3]; ///< square root of the covariance: along, across, heading
    maplines_real_t correlation_time;  ///< of the pose error [s]; infinite if unknown
    maplines_real_t offset_sigma;      ///< of the map [m]
    maplines_real_t heading_sigma;     ///< of the map [rad]
    maplines_real_t age;               ///< from the pose to the sending of the pose error [s]
    int64_t t_ns;                      ///< reception of the first frame of the pose error [ns]
    uint32_t counter;                  ///< of the pose error, or of the message Scene
#if MAPLINES_SCENE_RECORDS
    maplines_left_out_t
        left_out[MAPLINES_SLOTS]; ///< by slot: why the whole scene has not this line
#endif
};

/// The newest scene when the consumer asks.
typedef struct {
    const maplines_scene_t *scene; ///< NULL before the first. Valid until the next call
    maplines_real_t age;           ///< from the pose to now [s]; infinite if too old or unknown
    maplines_e2e_state_t state;    ///< of the pose error, or of the message Scene
    maplines_e2e_status_t status;  ///< of their last check
    /// Of each line of the scene: of its slot, or of the message Scene or Scene2 that brought it.
    maplines_e2e_state_t slot_states[MAPLINES_SLOTS];
    bool is_stale;    ///< its pose error came some cycles ago, or comes after now
    bool two_senders; ///< on the messages of the pose error, or of a line
    bool is_usable;   ///< all states are VALID, not stale, one sender each, and a finite age
} maplines_scene_view_t;

#if MAPLINES_LINE_RECORDS
/// The newest scene: lines of one pose, with their joint covariance.
///
/// The records of the lines of a cycle come one after the other. The scene before remains the
/// newest until lines of all slots of the last two scenes have come, or the next pose error.
/// Without a message of the pose error there is none.
///
/// A whole scene is the newest at once. The lines of Scene2 belong to it if they are of the same
/// pose error; a sender sends Scene2 first. What that has of the slot of a line of Scene is not
/// used.
void maplines_latest_scene(maplines_decoder_t *decoder, int64_t now_ns,
                           maplines_scene_view_t *view);
#endif

/// What maplines_scene_view_t says, with the scene itself; see maplines_line_copy_t.
typedef struct {
    maplines_scene_t scene; ///< all zeros if there is none
    bool has_scene;
    bool is_stale, two_senders, is_usable; ///< as in maplines_scene_view_t, at `now_ns`
    maplines_e2e_state_t state;
    maplines_e2e_status_t status;
    maplines_e2e_state_t slot_states[MAPLINES_SLOTS];
    maplines_real_t age; ///< from the pose to `now_ns` [s]; it grows from then on
    int64_t now_ns;      ///< time of the copy: a reader must not use an old one
} maplines_scene_copy_t;

/// Copy the newest scene with its state; see maplines_latest_scene, and docs/isr.md.
void maplines_copy_scene(maplines_decoder_t *decoder, int64_t now_ns, maplines_scene_copy_t *copy);

/// Line of a slot of a scene; NULL if the scene has none. For the functions above, and for those
/// below, which need the joint covariance: lines of one pose are not independent.
const maplines_line_t *maplines_scene_line(const maplines_scene_t *scene, maplines_owner_t slot);

/// Weighted sum of lateral positions of lines of a scene. False if the scene lacks one of them, or
/// if an x is outside of the range of its line; the sum and its standard deviation are NaN then. So
/// it is with the next two functions.
bool maplines_sum(const maplines_scene_t *scene, size_t count, const maplines_term_t *terms,
                  maplines_estimate_t *sum);

/// Lateral distance of two lines at x: the width of the lane [m].
bool maplines_width(const maplines_scene_t *scene, maplines_owner_t left, maplines_owner_t right,
                    maplines_real_t x, maplines_estimate_t *width);

/// Lateral position of the middle between two lines at x [m].
bool maplines_centre(const maplines_scene_t *scene, maplines_owner_t left, maplines_owner_t right,
                     maplines_real_t x, maplines_estimate_t *centre);

/// Range in which all lines of some slots are valid [m]. False if the scene lacks one of them, if
/// there is no slot, or if the range is empty.
bool maplines_common_range(const maplines_scene_t *scene, size_t count,
                           const maplines_owner_t *slots, maplines_real_t *x_min,
                           maplines_real_t *x_max);

/// Joint covariance of the parameters of the lines of some slots, in this order: an array of its
/// (4 count)^2 entries by rows. False if the scene lacks a line.
bool maplines_joint_covariance(const maplines_scene_t *scene, size_t count,
                               const maplines_owner_t *slots, maplines_real_t *covariance);
#endif // MAPLINES_RECEIVER && MAPLINES_SCENES

#if MAPLINES_RECEIVER
/* ---- predict by the motion of the car -------------------------------------------------------- */

/// Motion of the car at constant speed and yaw rate: an arc, tangent to the x axis at each point.
/// This is so if the origin is the centre of the rear axle.
typedef struct {
    maplines_real_t speed;          ///< forward [m/s]
    maplines_real_t yaw_rate;       ///< to the left [rad/s]
    maplines_real_t speed_sigma;    ///< [m/s]; with what an unknown acceleration adds
    maplines_real_t yaw_rate_sigma; ///< [rad/s]
    maplines_real_t correlation;    ///< of their errors, from -1 to 1
} maplines_motion_t;

/// Displacement of the car: its new pose in its old frame.
typedef struct {
    maplines_real_t mean[3];      ///< x [m], y [m], heading [rad]
    maplines_real_t factor[3][3]; ///< square root of the covariance, lower triangular
} maplines_displacement_t;

/// Result of a prediction.
typedef enum {
    MAPLINES_PREDICTED = 0,
    MAPLINES_NOT_USABLE = 1, ///< the line has the status OUT_OF_RANGE, a number of it is not
                             ///< finite, such as its age, or its range ends before it starts; NULL
    MAPLINES_TOO_FAR = 2,    ///< the time is more than 10 s from the pose of the line
    MAPLINES_BAD_MOTION = 3, ///< a value is not finite, a sigma negative, a correlation beyond 1,
                             ///< or the motion is NULL
    MAPLINES_ILL_POSED = 4,  ///< the line would not be a function of x in the new frame
} maplines_prediction_t;

/// Displacement in a time dt [s], negative for one into the past, with its standard deviation [s].
/// False if a value is not finite, a sigma is negative, or the correlation is beyond 1.
bool maplines_displacement(const maplines_motion_t *motion, maplines_real_t dt,
                           maplines_real_t time_sigma, maplines_displacement_t *displacement);

/// Predict a Gaussian over a line after a displacement; x_min and x_max are its valid range [m].
/// `predicted` may be `gaussian`, and is unchanged unless the result is MAPLINES_PREDICTED.
///
/// This is for the components of a mixture (maplines_component), which are predicted one by one;
/// maplines_overall gives the Gaussian of all of them. For other lines, call maplines_predict.
maplines_prediction_t maplines_predict_gaussian(const maplines_gaussian_t *gaussian,
                                                const maplines_displacement_t *displacement,
                                                maplines_real_t x_min, maplines_real_t x_max,
                                                maplines_gaussian_t *predicted);

/// Predict a line to the time t_ns [ns], by the displacement of the car since the pose of the line
/// (t_ns of the line less its age). Its range becomes that of the mean line in the new frame, less
/// three standard deviations of the displacement at each end; its age becomes 0. The prediction is
/// by 15 sigma points; the covariance of a line of status UNKNOWN stays as it is. A mixture is
/// predicted as the Gaussian of its mean and covariance, and has one component then. `predicted`
/// may be `line`, and is unchanged unless the result is MAPLINES_PREDICTED. So it is with lines of
/// a scene: each by itself, since the joint covariance is that of one pose.
maplines_prediction_t maplines_predict(const maplines_line_t *line, int64_t t_ns,
                                       const maplines_displacement_t *displacement,
                                       maplines_line_t *predicted);

/// Gaussian with the mean and covariance of a mixture. Weights are positive and finite; otherwise
/// it is NaN. `overall` may be one of the components.
void maplines_overall(size_t count, const maplines_gaussian_t *components,
                      const maplines_real_t *weights, maplines_gaussian_t *overall);

/// Predict a line to the time t_ns [ns], by the motion of the car. time_sigma is the standard
/// deviation of the time [s]: 0.005 covers the rounding of the age in the message.
maplines_prediction_t maplines_predict_to(const maplines_line_t *line, int64_t t_ns,
                                          const maplines_motion_t *motion,
                                          maplines_real_t time_sigma, maplines_line_t *predicted);

/* ---- what was received, and what was dropped ------------------------------------------------- */

/// Numbers of frames, records and lines, each modulo 2^64.
///
/// At any time, frames == line_frames + pose_frames + sum of counts + pending.
typedef struct {
    uint64_t counts[MAPLINES_REASONS]; ///< dropped frames by reason; none is MAPLINES_PENDING
    uint64_t frames;                   ///< received
    uint64_t lines;                    ///< delivered
    uint64_t line_frames;              ///< of the lines delivered; none of whole scenes
    uint64_t pose_errors;              ///< received, alone or in whole scenes
    uint64_t pose_frames;              ///< of these
    uint64_t lost; ///< records of lines or whole scenes missing between those received, by their
                   ///< counters
    /// Positive times between two lines of a slot, two pose errors, or two whole scenes, below a
    /// hundredth of the cycle. If there are almost as many as lines, times are in us or ms instead
    /// of ns; a few are of a gateway that held frames back.
    uint64_t short_spacings;
    uint32_t pending; ///< frames of transfers, mixtures and scenes that are not complete yet
} maplines_statistics_t;

/// E2E checks of an owner.
typedef struct {
    maplines_e2e_state_t state;
    maplines_e2e_status_t status; ///< of the last check
    uint64_t ok;                  ///< records accepted in sequence (OK or OKSOMELOST)
    uint64_t lost;                ///< records missing between those, according to their counters
    uint64_t repeated;
    uint64_t wrong_sequence;
    uint64_t errors;
    uint64_t no_new_data; ///< cycles without a record
    bool two_senders;     ///< detected in the last 256 cycles
} maplines_slot_stats_t;

/// E2E checks of a slot, of MAPLINES_POSE, or of MAPLINES_SCENE or MAPLINES_SCENE2; false if
/// nothing was received.
bool maplines_slot_stats(maplines_decoder_t *decoder, maplines_owner_t owner, int64_t now_ns,
                         maplines_slot_stats_t *stats);

/// Numbers of frames, records and lines.
void maplines_statistics(const maplines_decoder_t *decoder, maplines_statistics_t *statistics);

/* ---- settings of a receiver ------------------------------------------------------------------ */

/// Longest time from 0 [ns], 126 years. A time beyond it is limited to it, so that no difference
/// of two times overflows.
#define MAPLINES_MAX_TIME INT64_C(4000000000000000000)

/// Windows and bounds of an E2E state machine, with AUTOSAR's names.
typedef struct {
    uint8_t max_delta_counter; ///< greatest step of the counter that counts as lost records
    uint8_t window_size_init, window_size_valid, window_size_invalid;
    uint8_t min_ok_state_init, min_ok_state_valid, min_ok_state_invalid;
    uint8_t max_error_state_init, max_error_state_valid, max_error_state_invalid;
    bool clear_to_invalid;
} maplines_e2e_config_t;

/// Verifier of authenticated frames: an HSM computes the MAC.
typedef struct {
    /// Write the 16 bytes of AES-CMAC(key of key_id, data) to mac; return false without such a key.
    bool (*mac)(void *context, uint8_t key_id, const uint8_t *data, size_t length, uint8_t mac[16]);
    /// Time since 1970, or of any clock that increases over restarts [us]; NULL: there is no clock.
    int64_t (*now_us)(void *context);
    void *context;
    int64_t window_us;     ///< greatest difference from that clock, 1 or more
    int64_t not_before_us; ///< freshness values up to this one are not accepted; 0 or more
} maplines_authenticator_t;

/// Settings of a decoder. Start from maplines_default_settings().
struct maplines_settings {
    int64_t timeout_ns[MAPLINES_OWNERS]; ///< longest time between the frames of a transfer, if a
                                         ///< record has more than one
    int64_t cycle_ns[MAPLINES_OWNERS];   ///< time between records
    maplines_e2e_config_t e2e[MAPLINES_OWNERS];
    /// Cycles without a newer line after which one is stale: 3, or another number from 0 on.
    /// Infinite: never, so that only the E2E state tells of a slot without lines.
    double stale_cycles;
    const maplines_authenticator_t *authenticator; ///< NULL: frames without a MAC only
    /// After eight short spacings in a row (see maplines_statistics_t), records of the owner are
    /// dropped (MAPLINES_SPACING), and are errors of its E2E check, until a spacing is longer. A
    /// time that is equal to the last or before it, such as 0 of all frames, is no spacing.
    bool refuses_short_spacings;
};

/// AUTOSAR's windows as this project has them, for lines at 20 Hz.
maplines_e2e_config_t maplines_default_e2e(void);

/// Settings with the cycle times of the DBC and the time-outs that follow from them.
void maplines_default_settings(const maplines_dbc_t *dbc, maplines_settings_t *settings);

/// Settings with other times or windows; 0 and NULL are the default.
///
/// @param timeout_ms longest time between the frames of a transfer, and between the components of a
///        mixture; by default 1.5 cycles, and half a cycle of the DBC at least.
/// @param cycle_ms time between the lines of a slot; by default that of the DBC, or 100 ms.
/// @param e2e windows; for the pose error, limited to the counters of its record.
/// @return NULL, or what is wrong (then the settings are the default ones).
const char *maplines_settings_for(const maplines_dbc_t *dbc, double timeout_ms, double cycle_ms,
                                  const maplines_e2e_config_t *e2e, maplines_settings_t *settings);

/// The default settings fit into the history and the window of the build.
#define MAPLINES_HAS_DEFAULT (MAPLINES_HISTORY >= 32 && MAPLINES_WINDOW >= 10)

#if MAPLINES_HAS_DEFAULT
/// Start a receiver with the default settings. They need no check, so a linker leaves the checks of
/// settings and their texts, 1.2 kB, out of a program that does not call maplines_decoder_init.
void maplines_decoder_init_default(maplines_decoder_t *decoder, const maplines_dbc_t *dbc);
#endif
#endif // MAPLINES_RECEIVER

#if MAPLINES_SENDER
/* ---- send --------------------------------------------------------------------------------------
 */

/// Why nothing was sent: a caller's mistake. The counters have not changed then.
typedef enum {
    MAPLINES_SENT = 0,           ///< none: it was sent
    MAPLINES_NO_MESSAGE = 1,     ///< the DBC has no such message for the slot: classic, CAN FD, or
                                 ///< with a signer, authenticated CAN FD
    MAPLINES_NO_COVARIANCE = 2,  ///< the records of the DBC are conditional on the pose error: send
                                 ///< a scene
    MAPLINES_BAD_MEAN = 3,       ///< a mean is not finite
    MAPLINES_BAD_COVARIANCE = 4, ///< a covariance is not finite, or beyond 1e307
    MAPLINES_BAD_VARIANCE = 5,   ///< a variance is negative
    MAPLINES_ASYMMETRIC = 6,     ///< a covariance is not symmetric up to 1e-9 of its sigmas
    MAPLINES_BAD_RANGE = 7,      ///< x_min or x_max is not finite, or x_min is more than x_max
    MAPLINES_BAD_AGE = 8,        ///< an age is negative or NaN
    MAPLINES_BAD_KIND = 9,
    MAPLINES_BAD_STATUS = 10,
    MAPLINES_BAD_WEIGHTS = 11,  ///< weights are not positive, or do not add up to 1
    MAPLINES_BAD_COUNT = 12,    ///< no components, or more than the DBC can send
    MAPLINES_NO_SIGNATURE = 13, ///< the signer has no such key, or no further freshness value
    MAPLINES_INDEFINITE = 14,   ///< a covariance of a scene is not positive semidefinite
    MAPLINES_SAME_SLOT = 15,    ///< two lines of a scene have the same slot
    MAPLINES_BAD_POSE = 16, ///< the pose error does not fit the message, or its correlation time
                            ///< is not positive, or the error of the map is negative
    MAPLINES_UNSEEN = 17,   ///< what the pose error does to a line of a scene overflows
    MAPLINES_BAD_CALL = 18, ///< an argument is NULL, or the encoder is not initialised, or its
                            ///< signer has no function or a negative time
} maplines_refusal_t;

/// Line to be sent. All zeros is a line whose covariance is not sent, and whose age is unknown.
typedef struct {
    maplines_owner_t slot;
    maplines_kind_t kind;
    /// Requested: FULL; DIAGONAL for the variances only, UNKNOWN for the mean only; or that of a
    /// received line.
    maplines_status_t status;
    double x_min;   ///< start of the valid range [m]
    double x_max;   ///< end of the valid range [m], x_min or more
    double age;     ///< from the pose to the sending [s]; infinite if too old or unknown
    bool has_age;   ///< false: `age` is not read, and is sent as unknown, so nobody uses the line
    double mean[4]; ///< y_off [m], beta [rad], c0 [1/m], c1 [1/m^2]
    /// May be singular. An indefinite one is replaced by the nearest that covers it (REPAIRED). It
    /// is not read if the status is UNKNOWN or OUT_OF_RANGE.
    double cov[4][4];
} maplines_input_t;

/// Component of a mixture to be sent.
typedef struct {
    double weight;
    double mean[4];
    double cov[4][4];
} maplines_component_t;

/// What was sent.
typedef struct {
    maplines_refusal_t refusal;
    maplines_status_t status; ///< of the line; of a mixture, that of the worst component
    uint16_t count;           ///< number of frames; 0 if it was refused
} maplines_sent_t;

/// Key of a sender of authenticated frames, and its freshness values.
typedef struct {
    bool (*mac)(void *context, uint8_t key_id, const uint8_t *data, size_t length, uint8_t mac[16]);
    void *context;
    uint8_t key_id;
    int64_t last_us; ///< last freshness value that was sent: start with a stored one, or 0
} maplines_signer_t;

#if MAPLINES_SCENE_RECORDS
/// Places of lines in the messages of whole scenes, in the last cycle.
typedef struct {
    /// By message, Scene and Scene2, and place: 1 + the slot of the line; 0: none.
    uint8_t slots[2][MAPLINES_MAX_PLACES];
    bool sends_scene2; ///< it was needed once, so it is sent in each cycle
} maplines_chosen_places_t;
#endif

/// State of a sender. A restarted one may go on from a copy of `counter` and `places`.
typedef struct {
    uint32_t magic; ///< it is initialised
    const maplines_dbc_t *dbc;
    maplines_signer_t *signer; ///< NULL: frames have no MAC
    /// Of the next record of each owner, counted from MAPLINES_FIRST_OWNER, modulo its range.
    uint32_t counter[MAPLINES_OWNERS];
#if MAPLINES_SCENE_RECORDS
    maplines_chosen_places_t places;
#endif
} maplines_encoder_t;

/// Start a sender whose counters begin with 0.
///
/// @param signer NULL, or it signs all frames, which are then CAN FD.
void maplines_encoder_init(maplines_encoder_t *encoder, const maplines_dbc_t *dbc,
                           maplines_signer_t *signer);

#if MAPLINES_LINE_RECORDS
/// Encode a line into frames to be sent back to back, and advance the counter of its slot.
///
/// No value is clipped silently. A mean beyond the message is covered by a wider covariance, or
/// replaced by the nearest line in a shorter range (SATURATED); OUT_OF_RANGE if nothing covers it
/// or no valid range can be stated. What is received covers the line unless it is OUT_OF_RANGE: its
/// covariance minus that of the line, about the received mean, is positive semidefinite.
///
/// @param is_fd one CAN FD frame instead of the pages of the classic message.
/// @param now_us time for the freshness value, as maplines_authenticator_t has it [us]; not used
///        without a signer.
/// @param frames at least MAPLINES_MAX_PAGES.
maplines_sent_t maplines_encode_line(maplines_encoder_t *encoder, const maplines_input_t *line,
                                     bool is_fd, int64_t now_us, maplines_frame_t *frames);

#if MAPLINES_MIXTURES
/// Encode a line that is a Gaussian mixture: one record for each component.
///
/// The decoded mixture covers each component and the overall covariance of the mixture.
///
/// @param line all but mean and covariance.
/// @param frames at least MAPLINES_MAX_FRAMES.
maplines_sent_t maplines_encode_mixture(maplines_encoder_t *encoder, const maplines_input_t *line,
                                        const maplines_component_t *components, size_t count,
                                        bool is_fd, int64_t now_us, maplines_frame_t *frames);
#endif
#endif // MAPLINES_LINE_RECORDS
#endif // MAPLINES_SENDER

#if MAPLINES_SENDER && MAPLINES_SCENES
/* ---- send a scene ---------------------------------------------------------------------------- */

/// Line of a scene to be sent.
typedef struct {
    maplines_owner_t slot;
    maplines_kind_t kind;
    maplines_status_t status; ///< requested, of a record with a covariance of its own: FULL
    double x_min;             ///< start of the valid range [m]
    double x_max;             ///< end of the valid range [m], x_min or more
    double age;   ///< from the pose to the sending of such a record [s]; infinite if too old or
                  ///< unknown
    bool has_age; ///< false: `age` is not read, and is sent as unknown, so nobody uses such a line
    double mean[4];      ///< y_off [m], beta [rad], c0 [1/m], c1 [1/m^2]
    double fit_range[2]; ///< in which the cubic was fitted; contains the valid range [m]
    double quartic;      ///< coefficient of T_4 that the cubic leaves in this range, or 0 [m]
    /// Part of the covariance that is not due to the pose error, and independent of other lines. It
    /// is read if `has_specific`.
    double specific[4][4];
} maplines_scene_line_t;

/// Lines that are seen from one pose, to be sent. All zeros have no correlation time, and are
/// refused.
typedef struct {
    uint8_t count;
    maplines_scene_line_t lines[MAPLINES_SLOTS]; ///< each of another slot
    /// Joint covariance: the rows and columns 4 i to 4 i + 3 are of line i.
    double cov[4 * MAPLINES_SLOTS][4 * MAPLINES_SLOTS];
    bool has_specific;     ///< the line-specific covariances are known
    double pose_cov[3][3]; ///< of the pose error: along [m], across [m], heading [rad]
    double pose_age;       ///< from the pose to the sending of the pose error [s]; infinite if too
                           ///< old or unknown
    bool has_pose_age;     ///< false: `pose_age` is not read, and is sent as unknown, so nobody
                           ///< uses the scene
    double correlation_time; ///< of the pose error [s]; infinite if unknown
    double offset_sigma;     ///< common offset of the points of a line of the map, or 0 [m]
    double heading_sigma;    ///< common rotation of the points of a line of the map, or 0 [rad]
} maplines_scene_input_t;

/// What was sent of a scene.
typedef struct {
    maplines_refusal_t refusal;
    maplines_left_out_t left_out[MAPLINES_SLOTS]; ///< by line
    /// By line: a line that is left out is sent nevertheless if it has a covariance of its own.
    bool is_sent[MAPLINES_SLOTS];
    /// By line, if it is sent: that of its record, or FULL of a record that is conditional on the
    /// pose error, which has none.
    maplines_status_t status[MAPLINES_SLOTS];
    uint16_t count; ///< number of frames; 0 if the scene was refused
} maplines_sent_scene_t;

/// Frames of a scene at most: pages of the records of all lines, or Scene2 and Scene.
#define MAPLINES_MAX_SCENE_FRAMES                                                                  \
    (MAPLINES_LINE_RECORDS ? MAPLINES_MAX_PAGES * (MAPLINES_SLOTS + 1) : 2)

/// Encode the pose error and the lines of a scene into frames, and advance their counters.
///
/// What is received covers the scene: the joint covariance minus that of the lines, about the
/// received means, is positive semidefinite. If the records of the DBC are conditional on the pose
/// error, lines that do not fit are not sent. Other records have a covariance of their own: such a
/// line is sent, but does not belong to the scene.
///
/// With records of whole scenes, the frames are Scene2, if it is needed, and then Scene, both with
/// the pose error. The ego lines have fixed places in Scene, and the edges in Scene2. The other
/// lines have what is left, the nearest to the car first; the centre line, which follows from the
/// ego lines, is the last. Once Scene2 was needed it is sent in each cycle. A line that is left out
/// has its place, with the reason. What is left has none: MAPLINES_LEFT_OUT_PLACE.
///
/// A line-specific covariance is sent as levels. They hold the sum of
///
/// - an offset of the line: a variance of y_off (`lateral` of maplines_levels_t);
/// - either a misfit of the shape, with variances of the coefficients of T_0 .. T_3 in fit_range as
///   0 : 1/4 : 1 : 2, or independent errors of points along the line, with a part of such a misfit;
/// - offset_sigma and heading_sigma, which all lines have.
///
/// Any other covariance is covered by a wider one of this form; if there is none, the line is left
/// out. Records of a line that are conditional on the pose error can have all entries instead: on
/// classic CAN where levels are too wide, on CAN FD unless their signals have no room.
///
/// @param is_fd one CAN FD frame for each record instead of its pages. Whole scenes are CAN FD
/// only.
/// @param now_us time for the freshness value; not used without a signer.
/// @param workspace need not be initialised.
/// @param frames at least MAPLINES_MAX_SCENE_FRAMES. Those of the pose error come first; send
///        Scene2 before Scene.
maplines_sent_scene_t maplines_encode_scene(maplines_encoder_t *encoder,
                                            const maplines_scene_input_t *scene, bool is_fd,
                                            int64_t now_us, maplines_scene_workspace_t *workspace,
                                            maplines_frame_t *frames);
#endif // MAPLINES_SENDER && MAPLINES_SCENES

/* ---- self-test --------------------------------------------------------------------------------
 */

/// Test the arithmetic of this build and of the CPU in its present mode: quotients, sums and
/// products in their order, square roots, subnormal numbers, the elementary functions of the core,
/// and single precision. Call it once at start. It finds what no macro of the compiler tells, such
/// as clang's -freciprocal-math, fused multiplications, or a CPU that flushes subnormals to zero.
///
/// @return NULL, or the first operation that gives other bits than IEEE 754 defines, such as
///         "quotient": frames and lines then differ from those of other machines in last bits.
const char *maplines_self_test(void);

/* ---- names --------------------------------------------------------------------------------------
 * Names of values for a log, as the Python package has them, such as "EGO_LEFT" or "CRC"; "?" of a
 * number that is no value. MAPLINES_NO_POSE is "POSE" there.
 */

const char *maplines_owner_name(maplines_owner_t owner);
const char *maplines_kind_name(maplines_kind_t kind);
const char *maplines_status_name(maplines_status_t status);
#if MAPLINES_RECEIVER
const char *maplines_reason_name(maplines_reason_t reason);
const char *maplines_e2e_state_name(maplines_e2e_state_t state);
const char *maplines_e2e_status_name(maplines_e2e_status_t status);
const char *maplines_prediction_name(maplines_prediction_t prediction);
#endif
#if MAPLINES_SENDER
const char *maplines_refusal_name(maplines_refusal_t refusal);
#endif
#if MAPLINES_SCENES
const char *maplines_left_out_name(maplines_left_out_t left_out);
#endif

#include "maplines_state.h" // sizes of the structures; nothing there is to be called

#ifdef __cplusplus
}
#endif

#endif
