/* A sender of scenes: the record of the pose error and those of the lines, with their counters. */
#include "internal.h"

#if MAPLINES_SENDER && MAPLINES_SCENES

/// Largest variance or covariance; sums of such values stay within the floats.
static const double largest_entry = 1e307;
/// Asymmetry and indefiniteness up to this, relative to the standard deviations, are rounding.
static const double scene_rounding = 1e-9;

/// Standard deviation of an entry of a covariance, with 1 in place of 0.
static double scale_at(const double *cov, int stride, int i)
{
    const double variance = cov[(stride + 1) * i];
    return sqrt(variance > 0.0 ? variance : 1.0);
}

/// MAPLINES_SENT, or what is wrong with an (n, n) covariance whose rows are `stride` apart.
static maplines_refusal_t check_joint(const double *cov, int n, int stride, double *space)
{
    bool is_small = true;
    bool is_positive = true;
    bool is_symmetric = true;
    for (int i = 0; i < n; ++i)
    {
        const double scale_i = scale_at(cov, stride, i);
        is_positive = is_positive && cov[(stride + 1) * i] >= 0.0;
        for (int j = 0; j < n; ++j)
        {
            const double scale = scale_i * scale_at(cov, stride, j);
            const double entry = cov[stride * i + j];
            const double mirrored = cov[stride * j + i];
            is_small = is_small && fabs(entry) <= largest_entry;
            is_symmetric = is_symmetric && fabs(entry - mirrored) <= scene_rounding * scale;
            space[n * i + j] = entry / scale + (i == j ? scene_rounding : 0.0);
        }
    }
    if (!is_small)
    {
        return MAPLINES_BAD_COVARIANCE;
    }
    if (!is_positive)
    {
        return MAPLINES_BAD_VARIANCE;
    }
    if (!is_symmetric)
    {
        return MAPLINES_ASYMMETRIC;
    }
    return maplines_cholesky_factor(n, space, space) ? MAPLINES_SENT : MAPLINES_INDEFINITE;
}

/// Line as one with a covariance of its own.
static maplines_input_t input_of(const maplines_scene_line_t *line)
{
    maplines_input_t input;
    memset(&input, 0, sizeof input);
    input.slot = line->slot;
    input.kind = line->kind;
    input.status = line->status;
    input.x_min = line->x_min;
    input.x_max = line->x_max;
    input.age = line->age;
    input.has_age = line->has_age;
    memcpy(input.mean, line->mean, sizeof input.mean);
    return input;
}

/// MAPLINES_SENT, or what is wrong with a line.
static maplines_refusal_t check_scene_line(const maplines_scene_line_t *line)
{
    const maplines_input_t input = input_of(line);
    for (int i = 0; i < 4; ++i)
    {
        if (!(fabs(line->mean[i]) < (double)INFINITY))
        {
            return MAPLINES_BAD_MEAN;
        }
    }
    if (!(fabs(line->fit_range[0]) < (double)INFINITY) ||
        !(fabs(line->fit_range[1]) < (double)INFINITY) ||
        !(line->fit_range[0] < line->fit_range[1]) || !(fabs(line->quartic) < (double)INFINITY))
    {
        return MAPLINES_BAD_RANGE;
    }
    return maplines_check_input(&input);
}

/// MAPLINES_SENT, or what is wrong with the pose error.
static maplines_refusal_t check_pose(const maplines_scene_input_t *scene, double *space)
{
    const bool is_good = scene->correlation_time > 0.0 && scene->offset_sigma >= 0.0 &&
                         scene->offset_sigma < (double)INFINITY && scene->heading_sigma >= 0.0 &&
                         scene->heading_sigma < (double)INFINITY;
    if (!is_good)
    {
        return MAPLINES_BAD_POSE;
    }
    if (scene->has_pose_age && !(scene->pose_age >= 0.0))
    {
        return MAPLINES_BAD_AGE;
    }
    return check_joint(scene->pose_cov[0], 3, 3, space);
}

/// MAPLINES_SENT, or why a scene cannot be sent.
static maplines_refusal_t check_scene(const maplines_encoder_t *encoder,
                                      const maplines_scene_input_t *scene, bool is_fd,
                                      double *space)
{
    bool is_used[MAPLINES_SLOTS] = {false};
    const bool is_whole = maplines_has_whole_scenes(encoder->dbc);
    const int owner = MAPLINES_PLACE_OF(is_whole ? MAPLINES_SCENE : MAPLINES_POSE);
    if (!encoder->dbc->has_pose || !maplines_can_send(encoder, owner, is_fd))
    {
        return MAPLINES_NO_MESSAGE;
    }
    if (scene->count > MAPLINES_SLOTS)
    {
        return MAPLINES_BAD_COUNT;
    }
    maplines_refusal_t refusal = check_pose(scene, space);
    for (int i = 0; refusal == MAPLINES_SENT && i < (int)scene->count; ++i)
    {
        const maplines_scene_line_t *line = &scene->lines[i];
        const int slot = (int)line->slot;
        if ((unsigned)slot >= MAPLINES_SLOTS ||
            !(is_whole || maplines_can_send(encoder, slot, is_fd)))
        {
            return MAPLINES_NO_MESSAGE;
        }
        refusal = is_used[slot] ? MAPLINES_SAME_SLOT : check_scene_line(line);
        is_used[slot] = true;
        if (refusal == MAPLINES_SENT && scene->has_specific)
        {
            refusal = check_joint(line->specific[0], 4, 4, space);
        }
    }
    if (refusal == MAPLINES_SENT)
    {
        refusal = check_joint(scene->cov[0], 4 * (int)scene->count, MAPLINES_STATES, space);
    }
    return refusal;
}

static void put_levels(const maplines_levels_t *levels, uint8_t *record, const int64_t raw[4])
{
    maplines_put(&levels->lateral, record, raw[0]);
    maplines_put(&levels->points, record, raw[1]);
    maplines_put(&levels->shape, record, raw[2]);
    maplines_put(&levels->tilt, record, raw[3]);
}

MAPLINES_INTERNAL void maplines_put_line(const maplines_dbc_t *dbc,
                                         const maplines_scene_member_t *member, uint8_t *record)
{
    const int64_t *mean = member->is_full ? member->raw_refined : member->raw_mean;
    for (int i = 0; i < 4; ++i)
    {
        maplines_put(&dbc->mean[i], record, mean[i]);
    }
    maplines_put(&dbc->kind, record, (int64_t)member->kind);
    maplines_put(&dbc->x_min, record, member->raw_range[0]);
    maplines_put(&dbc->x_max, record, member->raw_range[1]);
    maplines_put(&dbc->levels.quartic, record, member->raw_quartic);
    if (!member->is_full)
    {
        put_levels(&dbc->levels, record, member->raw_levels);
    }
}

MAPLINES_INTERNAL void maplines_put_pose(const maplines_dbc_t *dbc,
                                         const maplines_scene_workspace_t *space, double age,
                                         uint8_t *record)
{
    const double raw_age = maplines_raw_above(&dbc->pose_age, 1000.0 * age);
    maplines_put(&dbc->pose_age, record, maplines_limited(&dbc->pose_age, raw_age));
    maplines_put(&dbc->correlation_time, record, space->raw_time);
    maplines_put(&dbc->map_offset, record, space->raw_offset);
    maplines_put(&dbc->map_heading, record, space->raw_heading);
    maplines_put_covariance(&dbc->pose_covariance, record, space->raw_pose);
}

#if MAPLINES_LINE_RECORDS
MAPLINES_INTERNAL size_t maplines_write_conditional(const maplines_dbc_t *dbc,
                                                    const maplines_scene_member_t *member,
                                                    uint8_t *record)
{
    maplines_put_line(dbc, member, record);
    if (!member->is_full)
    {
        return 8U * (size_t)dbc->line.short_pages;
    }
    maplines_put(&dbc->has_covariance, record, 1);
    for (int i = 0; i < 4; ++i)
    {
        maplines_put(&dbc->fine[i], record, member->raw_fine[i]);
    }
    maplines_put_covariance(&dbc->covariance, record, member->raw_covariance);
    return 8U * (size_t)dbc->line.pages;
}

/// Record of a line with a covariance of its own; returns its length.
static size_t write_line(const maplines_dbc_t *dbc, const maplines_scene_input_t *scene, int place,
                         uint8_t *record, maplines_status_t *status)
{
    const maplines_input_t input = input_of(&scene->lines[place]);
    maplines_draft_t draft;
    memset(&draft, 0, sizeof draft);
    draft.line = &input;
    draft.mean = input.mean;
    draft.count = 1;
    draft.weight = 1.0;
    for (int i = 0; i < 16; ++i)
    {
        draft.cov[i] = scene->cov[4 * place + i / 4][4 * place + i % 4];
    }
    maplines_symmetric(4, draft.cov);
    *status = maplines_write_complete(dbc, &draft, record);
    return 8U * (size_t)dbc->line.pages;
}

/// Put the counter of a slot, or if no line of it belongs to the pose error, one that no record of
/// the slot has near this cycle.
static void put_slot_counter(const maplines_dbc_t *dbc, int slot, bool is_member, uint32_t first,
                             uint32_t next, uint8_t *record)
{
    const maplines_signal_t *signal = &dbc->slot_counter[slot];
    if (signal->length > 0U)
    {
        const uint64_t modulus = (uint64_t)1 << signal->length;
        const uint64_t counter = is_member ? (uint64_t)first : (uint64_t)next + modulus / 2U;
        maplines_put(signal, record, (int64_t)(counter % modulus));
    }
}

MAPLINES_INTERNAL size_t maplines_write_pose(const maplines_dbc_t *dbc,
                                             const maplines_scene_workspace_t *space,
                                             const maplines_pose_cycle_t *cycle, uint8_t *record)
{
    maplines_put_pose(dbc, space, cycle->age, record);
    for (int i = 0; i < space->count; ++i)
    {
        const maplines_scene_member_t *member = &space->members[space->places[i]];
        if (!dbc->is_conditional && cycle->is_member[member->slot])
        {
            const maplines_levels_t *levels = &dbc->slot_levels[member->slot];
            put_levels(levels, record, member->raw_levels);
            maplines_put(&levels->quartic, record, member->raw_quartic);
            maplines_put(&levels->fit_behind, record, member->raw_fit[0]);
            maplines_put(&levels->fit_ahead, record, member->raw_fit[1]);
        }
    }
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        put_slot_counter(dbc, slot, cycle->is_member[slot], cycle->first[slot],
                         cycle->following[slot], record);
    }
    return 8U * (size_t)dbc->pose.pages;
}
#endif

/// Age of the pose [s]; infinite if it is unknown.
static double pose_age_of(const maplines_scene_input_t *scene)
{
    return scene->has_pose_age ? scene->pose_age : (double)INFINITY;
}

/// Seal a record and append its frames; false if it was not signed.
static bool append(maplines_encoder_t *encoder, int owner, uint8_t *record, size_t length,
                   uint32_t counter, bool is_fd, int64_t now_us, maplines_frame_t *frames,
                   uint16_t *count)
{
    maplines_seal(encoder->dbc, owner, record, length, counter);
    const size_t sent =
        maplines_frames(encoder, owner, record, length, is_fd, now_us, &frames[*count]);
    *count = (uint16_t)(*count + sent);
    return sent > 0U;
}

#if MAPLINES_LINE_RECORDS
/// Write the records of the pose error and of the lines; false if one was not signed.
static bool send_lines(maplines_encoder_t *encoder, const maplines_scene_input_t *scene, bool is_fd,
                       int64_t now_us, const maplines_scene_workspace_t *space,
                       maplines_frame_t *frames, maplines_sent_scene_t *sent)
{
    const maplines_dbc_t *dbc = encoder->dbc;
    maplines_pose_cycle_t cycle;
    const uint32_t *first = cycle.first;
    memset(&cycle, 0, sizeof cycle);
    cycle.age = pose_age_of(scene);
    memcpy(cycle.first, encoder->counter, sizeof cycle.first);
    for (int place = 0; place < (int)scene->count; ++place)
    {
        const int slot = (int)scene->lines[place].slot;
        sent->left_out[place] = space->members[place].left_out;
        cycle.is_member[slot] = sent->left_out[place] == MAPLINES_IN_SCENE;
        sent->is_sent[place] = !dbc->is_conditional || cycle.is_member[slot];
        if (sent->is_sent[place])
        {
            sent->status[place] = MAPLINES_FULL; // unless its record has another one
            encoder->counter[slot] = maplines_next_counter(dbc, slot, encoder->counter[slot]);
        }
    }
    memcpy(cycle.following, encoder->counter, sizeof cycle.following);
    uint8_t pose_record[MAPLINES_MAX_RECORD] = {0};
    const int pose = (int)MAPLINES_POSE;
    const size_t pose_length = maplines_write_pose(dbc, space, &cycle, pose_record);
    bool is_good = append(encoder, pose, pose_record, pose_length, first[pose], is_fd, now_us,
                          frames, &sent->count);
    encoder->counter[pose] = maplines_next_counter(dbc, pose, first[pose]);
    for (int place = 0; is_good && place < (int)scene->count; ++place)
    {
        const int slot = (int)scene->lines[place].slot;
        if (sent->is_sent[place])
        {
            uint8_t record[MAPLINES_MAX_RECORD] = {0};
            const size_t length =
                dbc->is_conditional
                    ? maplines_write_conditional(dbc, &space->members[place], record)
                    : write_line(dbc, scene, place, record, &sent->status[place]);
            is_good = append(encoder, slot, record, length, first[slot], is_fd, now_us, frames,
                             &sent->count);
        }
    }
    return is_good;
}
#endif

#if MAPLINES_SCENE_RECORDS
/// Write the records of a whole scene, that of Scene last; false if one was not signed.
static bool send_whole(maplines_encoder_t *encoder, const maplines_scene_input_t *scene,
                       int64_t now_us, const maplines_scene_workspace_t *space,
                       maplines_frame_t *frames, maplines_sent_scene_t *sent)
{
    const maplines_dbc_t *dbc = encoder->dbc;
    const int first = MAPLINES_PLACE_OF(MAPLINES_SCENE);
    const maplines_whole_cycle_t cycle = {.space = space,
                                          .count = (int)scene->count,
                                          .slots = UINT32_MAX,
                                          .is_secured = encoder->signer != NULL,
                                          .age = pose_age_of(scene),
                                          .counter = encoder->counter[first]};
    maplines_choose_places(dbc, &cycle, &encoder->places);
    bool is_good = true;
    for (int message = encoder->places.sends_scene2 ? 1 : 0; is_good && message >= 0; --message)
    {
        const int owner = first + message;
        uint8_t record[MAPLINES_MAX_RECORD];
        const size_t length = maplines_write_whole(dbc, &cycle, &encoder->places, message, record);
        const uint32_t counter = encoder->counter[owner];
        is_good =
            append(encoder, owner, record, length, counter, true, now_us, frames, &sent->count);
        encoder->counter[owner] = maplines_next_counter(dbc, owner, counter);
    }
    for (int i = 0; i < (int)scene->count; ++i)
    {
        const maplines_scene_member_t *member = &space->members[i];
        const bool has_place = maplines_has_place(&encoder->places, member->slot);
        const bool fits = member->left_out == MAPLINES_IN_SCENE;
        sent->left_out[i] = fits && !has_place ? MAPLINES_LEFT_OUT_PLACE : member->left_out;
        sent->is_sent[i] = fits && has_place;
        sent->status[i] = sent->is_sent[i] ? MAPLINES_FULL : MAPLINES_UNKNOWN;
    }
    return is_good;
}
#endif

/// Write all records; false if one was not signed.
static bool send_records(maplines_encoder_t *encoder, const maplines_scene_input_t *scene,
                         bool is_fd, int64_t now_us, const maplines_scene_workspace_t *space,
                         maplines_frame_t *frames, maplines_sent_scene_t *sent)
{
#if MAPLINES_SCENE_RECORDS
    if (maplines_has_whole_scenes(encoder->dbc))
    {
        return send_whole(encoder, scene, now_us, space, frames, sent);
    }
#endif
#if MAPLINES_LINE_RECORDS
    return send_lines(encoder, scene, is_fd, now_us, space, frames, sent);
#else
    (void)is_fd;
    return false;
#endif
}

maplines_sent_scene_t maplines_encode_scene(maplines_encoder_t *encoder,
                                            const maplines_scene_input_t *scene, bool is_fd,
                                            int64_t now_us, maplines_scene_workspace_t *workspace,
                                            maplines_frame_t *frames)
{
    maplines_sent_scene_t sent;
    memset(&sent, 0, sizeof sent);
    if (!MAPLINES_REQUIRE(maplines_is_sender(encoder)) || !MAPLINES_REQUIRE(scene != NULL) ||
        !MAPLINES_REQUIRE(workspace != NULL) || !MAPLINES_REQUIRE(frames != NULL))
    {
        sent.refusal = MAPLINES_BAD_CALL;
        return sent;
    }
    const maplines_encoder_t before = *encoder;
    sent.refusal = check_scene(encoder, scene, is_fd, workspace->joint.factor);
    if (sent.refusal == MAPLINES_SENT)
    {
        const bool is_full = is_fd && maplines_has_entries(encoder->dbc);
        sent.refusal = maplines_encode_members(encoder->dbc, scene, is_full, workspace);
    }
    if (sent.refusal == MAPLINES_SENT &&
        !send_records(encoder, scene, is_fd, now_us, workspace, frames, &sent))
    {
        *encoder = before;
        memset(&sent, 0, sizeof sent);
        sent.refusal = MAPLINES_NO_SIGNATURE;
    }
    return sent;
}

#endif
