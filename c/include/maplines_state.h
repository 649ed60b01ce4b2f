/* What maplines.h keeps: the tables of a DBC, the state of a receiver, and memory of a sender.
 *
 * The caller owns them, so their sizes are known to him. Their fields are no part of the interface.
 * maplines.h includes this file.
 */
#ifndef MAPLINES_STATE_H
#define MAPLINES_STATE_H

/* ---- tables of a DBC ---------------------------------------------------------------------------
 * `maplines generate c` writes them. Nothing else needs to read them.
 */

/// Conversion of the raw values of signals: physical = raw * factor + offset.
typedef struct {
    double factor;
    double offset;
} maplines_scale_t;

/// One signal of a record. Any bits are a raw value.
typedef struct {
    const maplines_scale_t *scale;
    uint16_t first; ///< lowest bit from that of byte 0; Motorola: highest from that of byte 0
    uint8_t length; ///< [bit]; 0: the DBC has no such signal
    bool is_motorola : 1;
    bool is_signed : 1;
} maplines_signal_t;

/// Cholesky code of a covariance of up to 4 states.
typedef struct {
    uint8_t rows;
    uint8_t order[4];            ///< state of each row
    maplines_signal_t pivot[4];  ///< log2 of L_ii, by row
    maplines_signal_t ratio[6];  ///< L_ij / L_ii: (1, 0), (2, 0), (2, 1), (3, 0), ...
    maplines_signal_t inflation; ///< log2 of a factor on the covariance
#if MAPLINES_SENDER
    double reachable[4]; ///< variance of each state beyond which nothing covers
#endif
} maplines_cholesky_t;

/// What all records of a layout share.
typedef struct {
    uint8_t pages;
    uint8_t short_pages;  ///< of a record without a covariance; fewer only if it is conditional
    uint16_t crc_byte;    ///< first byte of the checksum
    uint8_t fd_authentic; ///< authentic bytes of the authenticated message; 0: there is none
    uint8_t fd_freshness; ///< bytes of the truncated freshness value
    uint8_t fd_mac;       ///< bytes of the truncated MAC
#if MAPLINES_LINE_RECORDS || MAPLINES_SENDER
    maplines_signal_t page;           ///< in each page of 8 bytes
    maplines_signal_t transfer_id[2]; ///< in page 0, and in each other page of 8 bytes
#endif
    maplines_signal_t counter; ///< in the record
} maplines_record_t;

/// Levels of a line-specific covariance.
typedef struct {
    maplines_signal_t lateral;
    maplines_signal_t points;
    maplines_signal_t shape;
    maplines_signal_t tilt;       ///< of the lateral level; only in whole scenes
    maplines_signal_t quartic;    ///< not in whole scenes
    maplines_signal_t fit_behind; ///< only beside complete records
    maplines_signal_t fit_ahead;
    bool shape_is_octave; ///< the shape is an exponent of 2 of the spacing
} maplines_levels_t;

/// Messages of an owner.
typedef struct {
    bool is_present;
    bool has_classic, has_fd, has_secured;
    bool is_extended, fd_is_extended, secured_is_extended;
    uint8_t fd_length;        ///< [byte]
    uint16_t data_id;         ///< E2E data ID
    uint16_t secured_data_id; ///< SecOC data ID
    uint32_t can_id, fd_can_id, secured_can_id;
    uint32_t cycle_ms; ///< 0: the DBC has none
} maplines_messages_t;

#if MAPLINES_SCENE_RECORDS
/// Records of whole scenes: the pose error, and lines at equal distances. The signals of lines are
/// those of the first place; in a record, those of place i are `stride` i bytes further on.
typedef struct {
    uint8_t places;         ///< lines of a record; 0: the DBC has no such records
    uint8_t secured_places; ///< of an authenticated one, which is shorter
    uint8_t stride;         ///< [byte]
    /// 1 + the slot of each place of Scene and Scene2; 0: the record names it.
    uint8_t fixed[2][MAPLINES_MAX_PLACES];
    maplines_signal_t slot; ///< of a place without a fixed one
    maplines_signal_t join; ///< low bits of the counter of Scene, in both messages
} maplines_places_t;
#endif

/// Tables of a DBC.
struct maplines_dbc {
    const char *name; ///< of the DBC
    uint8_t max_components;
    bool is_conditional; ///< lines are conditional on a pose error
    bool has_pose;
    maplines_messages_t messages[MAPLINES_OWNERS]; ///< from MAPLINES_FIRST_OWNER on
    /* lines */
    maplines_signal_t mean[4];
    maplines_signal_t kind, x_min, x_max;
#if MAPLINES_LINE_RECORDS || MAPLINES_SENDER
    maplines_cholesky_t covariance; ///< in whole scenes, only the order of its rows
#else
    struct {
        uint8_t rows;
        uint8_t order[4]; ///< state of each row
    } covariance;
#endif
#if MAPLINES_LINE_RECORDS
    /* records of lines */
    maplines_record_t line;
    maplines_signal_t status, age;                                        // complete
    maplines_signal_t component_index, component_count, component_weight; // complete
#if MAPLINES_SCENES
    maplines_signal_t has_covariance, fine[4]; // conditional
    maplines_signal_t slot_counter[MAPLINES_SLOTS];
    maplines_levels_t slot_levels[MAPLINES_SLOTS]; // beside complete records
#endif
#endif
#if MAPLINES_SCENES
    maplines_levels_t levels; ///< of lines that are conditional
    /* pose error */
    maplines_record_t pose; ///< or whole scene
    maplines_signal_t pose_age, correlation_time, map_offset, map_heading;
    maplines_cholesky_t pose_covariance;
#if MAPLINES_SCENE_RECORDS
    maplines_places_t scene;
#endif
#if MAPLINES_SENDER
    uint16_t spacings;     ///< raw values of the shape that a sender tries
    uint16_t spacing_step; ///< from one of them to the next
    /// At each of them: covariance of a straight line for errors of points of 1 m, its lower
    /// triangle by rows, and by how much the shape adds to it [m^2]. 11 kB for 256 of them.
    const float (*straight)[11];
#endif
#endif
};

/// Bytes of a record and of its pages. Signals of the last line of a whole scene are read and
/// written as those of the first one, in words that may end behind the record.
#define MAPLINES_RECORD_ROOM (MAPLINES_MAX_RECORD + 8 * MAPLINES_SCENE_RECORDS)

#if MAPLINES_RECEIVER
/* ---- state of a receiver ----------------------------------------------------------------------
 */

/// Frames of one transfer that were received, or the last good record with its transfer ID.
typedef struct {
    uint8_t record[MAPLINES_MAX_RECORD];
    int64_t t_ns;   ///< of the first frame
    uint32_t pages; ///< one bit each; 0: none
    uint16_t id;
} maplines_transfer_t;

/// What was received of the records of one owner.
typedef struct {
    maplines_transfer_t incomplete[MAPLINES_TRANSFERS]; ///< each at its ID modulo their number
    maplines_transfer_t complete[MAPLINES_TRANSFERS];   ///< good ones, likewise
    uint16_t began[MAPLINES_TRANSFERS]; ///< places of incomplete ones, as they began
    uint16_t count;                     ///< of these
} maplines_inbox_t;

/// Cycles without a record.
typedef struct {
    int64_t due_ns; ///< when the next cycle is missed
    bool is_running;
    bool is_counted; ///< cycles up to due_ns were counted before a record came
} maplines_deadline_t;

/// E2E state machine. The window is in bits, the last check lowest.
typedef struct {
    uint32_t oks[(MAPLINES_WINDOW + 31) / 32];
    uint32_t errors[(MAPLINES_WINDOW + 31) / 32];
    maplines_e2e_state_t state;
} maplines_machine_t;

/// Records of the last counters, by the low bits of their counter.
typedef struct {
    uint32_t content[MAPLINES_HISTORY]; ///< hash of the record
    uint8_t flags[MAPLINES_HISTORY];    ///< 0: no record
    int64_t run_since_ns; ///< records behind the last new one: time of the first of the run
    uint32_t run_first;   ///< its counter
    uint32_t run_last;    ///< counter of the last
    uint8_t run_records;  ///< 0: there is no run
    bool run_is_other;    ///< a counter of the run came before with different content
} maplines_history_t;

/// Signs of a second sender. INT64_MIN is the time of what has not happened.
typedef struct {
    int64_t conflict_ns, confirmed_ns, reused_ns, ahead_ns;
    uint32_t conflicts, new_records, duplicates;
    bool is_followed;  ///< other records came since the one that was ahead
    bool is_blocked;   ///< no new record since the last conflict
    bool is_confirmed; ///< there are two senders
} maplines_conflict_t;

/// Rate of the records of a sender, as far as it is known.
typedef struct {
    double line_ns;  ///< mean time between two lines in sequence
    int64_t last_ns; ///< time and counter of the last line
    uint32_t counter;
    uint8_t longest; ///< greatest number of records of a line so far
    bool has_line;
} maplines_pace_t;

/// Checks of the records of one owner.
typedef struct {
    maplines_deadline_t deadline;
    maplines_history_t history;
    maplines_conflict_t conflict;
    maplines_pace_t pace;
    uint64_t ok, some_lost; ///< checks by outcome
    uint64_t repeated, wrong_sequence, errors, no_new_data;
    uint64_t lost;     ///< records
    int64_t spaced_ns; ///< time of the last line or pose error; INT64_MIN: none
    int64_t new_ns;    ///< time of the last new record
    uint32_t last;     ///< its counter
    uint32_t left;     ///< last counter before that, if there was a gap
    maplines_machine_t machine;
    maplines_e2e_status_t status;
    bool has_last, has_left;
    uint8_t ahead; ///< of the last new record against the one before; 0: a sequence break
    uint8_t span;  ///< records of the line delivered last; 1 while a later line is incomplete
    uint8_t short_spacings;    ///< in a row, at most eight
    uint8_t duplicated_frames; ///< since the last new record, or since the last REPEATED check
    bool is_duplicated;        ///< there was such a check since the last new record
} maplines_check_t;

#if MAPLINES_MIXTURES
/// Components of a mixture, as records.
typedef struct {
    uint8_t records[MAPLINES_MAX_COMPONENTS][MAPLINES_MAX_RECORD];
    int64_t t_ns[MAPLINES_MAX_COMPONENTS];
    uint64_t received; ///< one bit each
    int64_t last_ns;   ///< time of the component that came last
    uint32_t first;    ///< counter of the first component
    uint32_t frames;
    maplines_real_t x_min, x_max, age; ///< of all components
    maplines_kind_t kind;
    uint8_t count; ///< of components; 0: there is no mixture
} maplines_mixture_t;
#endif

#if MAPLINES_SCENES && MAPLINES_LINE_RECORDS
/// Record of a line that is conditional on a pose error.
typedef struct {
    uint8_t record[MAPLINES_MAX_RECORD];
    int64_t t_ns; ///< of its first frame
} maplines_line_record_t;

/// Line that waits for its pose error.
typedef struct {
    maplines_line_record_t line;
    uint32_t counter;
    uint8_t frames; ///< that count as pending while it waits
} maplines_joining_t;

/// Pose error, and the lines that belong to it.
typedef struct {
    uint8_t record[MAPLINES_MAX_RECORD];
    int64_t t_ns;   ///< of its first frame
    uint32_t slots; ///< one bit for each line
    maplines_line_record_t lines[MAPLINES_SLOTS];
} maplines_epoch_t;

/// Pose errors that lines may still join, lines that wait for theirs, and the newest scene.
typedef struct {
    maplines_epoch_t epochs[MAPLINES_EPOCHS + 1]; ///< one more, since the latest may be closed
    uint8_t open[MAPLINES_EPOCHS];                ///< those that lines may join, the oldest first
    uint8_t open_count;
    int8_t latest;                              ///< newest epoch that waits for no line; -1: none
    maplines_joining_t waiting[MAPLINES_SLOTS]; ///< by slot
    uint8_t waits[MAPLINES_SLOTS];              ///< slots of these lines, as they came
    uint8_t wait_count;
    int64_t since_ns[MAPLINES_SLOTS]; ///< sequence break of a slot; INT64_MIN: none
    double intervals_ns[5];           ///< between the last pose errors, the oldest first
    uint8_t interval_count;
    bool has_pose;
    int64_t pose_ns; ///< time of the last pose error
    bool is_too_old; ///< so is that
} maplines_epochs_t;
#endif

#if MAPLINES_SCENE_RECORDS
/// Record of a message of whole scenes.
typedef struct {
    uint8_t record[MAPLINES_RECORD_ROOM];
    int64_t t_ns;   ///< of its frame
    uint8_t places; ///< lines that it may have; 0: there is no record
} maplines_scene_record_t;

/// Newest whole scenes.
typedef struct {
    maplines_scene_record_t first;  ///< newest Scene
    maplines_scene_record_t joined; ///< Scene2 of the same pose error
    maplines_scene_record_t second; ///< newest Scene2
    bool is_early;                  ///< it may belong to the next Scene
    bool is_second_last;            ///< it came after that Scene
} maplines_whole_t;
#endif

/// State of a receiver.
struct maplines_decoder {
    uint32_t magic; ///< it is initialised
    const maplines_dbc_t *dbc;
    bool is_ready; ///< the settings are right; otherwise every frame is FOREIGN
#if MAPLINES_SCENES && MAPLINES_LINE_RECORDS
    bool is_built; ///< `scene` is the newest one
#endif
    maplines_settings_t settings;
    maplines_statistics_t statistics; ///< without `lost` and `pending`
    maplines_check_t checks[MAPLINES_OWNERS];
#if MAPLINES_SECOC
    int64_t freshness_us[MAPLINES_OWNERS]; ///< last accepted freshness value
#endif
#if MAPLINES_MIXTURES
    maplines_mixture_t incomplete[MAPLINES_SLOTS];
    maplines_mixture_t mixtures[MAPLINES_SLOTS]; ///< of the newest lines that are mixtures
#endif
#if MAPLINES_SCENE_RECORDS
    maplines_whole_t whole;
#endif
#if MAPLINES_LINE_RECORDS
    maplines_inbox_t inboxes[MAPLINES_LINE_OWNERS];
#if MAPLINES_SCENES
    maplines_epochs_t epochs;
    maplines_scene_t scene;
#endif
    maplines_line_t newest[MAPLINES_SLOTS];
    uint32_t has_newest; ///< one bit for each slot
#if MAPLINES_SCENE_RECORDS
    uint8_t brought_by[MAPLINES_SLOTS]; ///< owners of the records of these
#endif
#endif
};

#endif // MAPLINES_RECEIVER

#if MAPLINES_SENDER && MAPLINES_SCENES
/* ---- memory in which a scene is encoded ---------------------------------------------------------
 */

/// Memory for a comparison of joint covariances.
typedef struct {
    double excess[16 * MAPLINES_SLOTS * MAPLINES_SLOTS];
    double factor[16 * MAPLINES_SLOTS * MAPLINES_SLOTS];
} maplines_joint_space_t;

/// Line of a scene while it is encoded: what can be stated of it, and its form.
typedef struct {
    int slot;
    maplines_kind_t kind;
    double distance; ///< from the car, next to it or at the nearer end of the fit range [m]
    maplines_left_out_t left_out;
    bool is_full;   ///< all entries of the line-specific covariance are sent, not levels
    bool is_spared; ///< levels are sent, whatever they cost
    double cost;    ///< of levels; more than 1 is too much
    double mean[4]; ///< that is stated
    double range[2];
    double quartic;
    double stated_J[16];
    double due_to_pose[16]; ///< parts of its covariance
    double specific[16];
    double excess[16]; ///< squares of the error of a mean that exceeds the message
    int64_t raw_mean[4];
    int64_t raw_refined[4]; ///< with all entries
    int64_t raw_fine[4];
    int64_t raw_range[2];
    int64_t raw_quartic;
    int64_t raw_fit[2];
    int64_t raw_levels[4]; ///< lateral, points, shape, tilt
    int64_t raw_covariance[11];
} maplines_scene_member_t;

#define MAPLINES_CHOSEN_SPACINGS 16
#define MAPLINES_KEPT_LATERAL 64
#define MAPLINES_KEPT_POINTS 128
#define MAPLINES_KEPT_SHAPES 256

/// Line of a scene as a receiver decodes it.
typedef struct {
    double mean[4];
    double fit_range[2];
    double quartic;
    double error[4];   ///< of the mean
    double J[16];      ///< derivatives with respect to coefficients of T_0 .. T_3
    double common[16]; ///< covariance of these that all lines have
    double cost;       ///< of levels; more than 1 is too much
    bool is_covered;
    uint8_t spacing_count;
    uint16_t spacings[MAPLINES_CHOSEN_SPACINGS]; ///< raw values of the shape that suit it best
    double noise[MAPLINES_CHOSEN_SPACINGS][10];  ///< lower triangles for unit errors of points
    double levels[16];                           ///< covariance of the levels that are sent
} maplines_sent_line_t;

/// Squares of the first levels of a DBC [m^2]; 0 until they are computed.
typedef struct {
    double lateral[MAPLINES_KEPT_LATERAL];
    double points[MAPLINES_KEPT_POINTS];
    double shape[MAPLINES_KEPT_SHAPES];
} maplines_level_squares_t;

/// Memory in which a scene is encoded: 54 kB. It takes up to 8 kB of stack besides.
struct maplines_scene_workspace {
    maplines_scene_member_t members[MAPLINES_SLOTS];
    int count;                  ///< of the lines that are not left out so far
    int places[MAPLINES_SLOTS]; ///< of these in the scene
    maplines_sent_line_t lines[MAPLINES_SLOTS];
    int64_t raw_pose[11];
    int64_t raw_offset, raw_heading, raw_time;
    double decoded_pose[9];
    double offset_sigma, heading_sigma;
    double own[MAPLINES_SLOTS][16];
    double J[MAPLINES_SLOTS][16];
    double more[MAPLINES_SLOTS][16];
    double lacking[MAPLINES_SLOTS][16];
    double spread[MAPLINES_SLOTS][16];                 ///< of each line, due to the pose error
    double rest[16 * MAPLINES_SLOTS * MAPLINES_SLOTS]; ///< what the lines must cover besides
    maplines_level_squares_t squares;
    maplines_joint_space_t joint;
};
#endif // MAPLINES_SENDER && MAPLINES_SCENES

#endif
