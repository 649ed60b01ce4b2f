/* Frames to lines and scenes: a decoder whose results are rows, of one frame or of a block. */
#include "core.h"
#include "internal.h"

/* ---- covariances ------------------------------------------------------------------------------
 */

/// Share by which the variances of a scene are enlarged: that of maplines_can/model/scenes.py.
#define SCENE_ROUNDING 0x1p-42

/// Joint covariance (4 count, 4 count) of the parameters of lines of a scene from a place on.
static void joint_covariance(const maplines_scene_t *scene, int first, int count, double *cov)
{
    const int n = 4 * count;
    const double *spread = scene->spread[4 * first];
    maplines_gram(n, MAPLINES_COLUMNS, spread, cov);
    for (int place = 0; place < count; ++place)
    {
        const double *factor = scene->specific[first + place][0];
        double own[16];
        maplines_gram(4, 4, factor, own);
        for (int i = 0; i < 16; ++i)
        {
            double *entry = cov + (4 * place + i / 4) * n + 4 * place + i % 4;
            *entry = *entry + own[i];
            *entry = i % 5 == 0 ? *entry * (1.0 + SCENE_ROUNDING) : *entry;
        }
    }
}

/// Components, overall mean and covariance of the newest line of a slot, which is a mixture.
static void add_mixture(const maplines_decoder_t *decoder, int slot, int count,
                        maplines_rows_t *rows, maplines_line_row_t *row)
{
    double weights[MAPLINES_MAX_COMPONENTS];
    double means[MAPLINES_MAX_COMPONENTS][4];
    double covs[MAPLINES_MAX_COMPONENTS][16];
    double L[16];
    for (int i = 0; i < count; ++i)
    {
        maplines_gaussian_t gaussian;
        maplines_component_row_t *component = &rows->components[rows->component_count++];
        (void)maplines_component(decoder, (maplines_owner_t)slot, (uint8_t)i, &gaussian,
                                 &weights[i]);
        memcpy(means[i], gaussian.mean, sizeof means[i]);
        maplines_gram(4, 4, gaussian.factor[0], covs[i]);
        component->line = (int64_t)rows->line_count;
        component->weight = weights[i];
        memcpy(component->mean, means[i], sizeof means[i]);
        memcpy(component->cov, covs[i], sizeof covs[i]);
    }
    maplines_moments(count, weights, means, covs, row->mean, row->cov);
    if (!maplines_cholesky_factor(4, row->cov, L))
    {
        for (int i = 0; i < 4; ++i)
        {
            const double share = MAPLINES_DEFINITE_SHARE * row->cov[5 * i];
            row->cov[5 * i] = row->cov[5 * i] + share;
        }
    }
}

/* ---- rows ------------------------------------------------------------------------------------ */

/// State after the last check: that of an owner or, if this is VALID, of its pose error.
static maplines_e2e_state_t state_of(const maplines_decoder_t *decoder, int owner)
{
    const maplines_e2e_state_t state = decoder->checks[owner].machine.state;
    return state == MAPLINES_E2E_VALID
               ? decoder->checks[maplines_owner_of_pose(decoder, owner)].machine.state
               : state;
}

static bool has_two_senders(const maplines_decoder_t *decoder, int owner, int64_t t_ns)
{
    return !maplines_has_one_sender(decoder, owner, t_ns) ||
           !maplines_has_one_sender(decoder, maplines_owner_of_pose(decoder, owner), t_ns);
}

/// Members of a row that the line itself has, but its covariance.
static void read_line(const maplines_line_t *line, maplines_line_row_t *row)
{
    memset(row, 0, sizeof *row);
    row->t_ns = line->t_ns;
    row->x_min = line->x_min;
    row->x_max = line->x_max;
    row->age = line->age;
    memcpy(row->mean, line->gaussian.mean, sizeof row->mean);
    row->slot = (uint8_t)line->slot;
    row->kind = (uint8_t)line->kind;
    row->status = (uint8_t)line->status;
    row->components = line->components;
}

/// Add the line at a place of those that a frame has completed, each the newest of its slot.
static void add_line(const maplines_decoder_t *decoder, int slot, const maplines_scene_t *scene,
                     int place, int64_t frame, int64_t t_ns, maplines_rows_t *rows)
{
    const maplines_line_t *line = &decoder->newest[slot];
    const int owner = maplines_owner_of_line(decoder, slot);
    const maplines_check_t *check = &decoder->checks[owner];
    maplines_line_row_t *row = &rows->lines[rows->line_count];
    read_line(line, row);
    row->frame = frame;
    if (decoder->dbc->is_conditional)
    {
        joint_covariance(scene, place, 1, row->cov);
    }
    else if (line->components > 1)
    {
        add_mixture(decoder, slot, line->components, rows, row);
    }
    else
    {
        const double *factor = line->gaussian.factor[0];
        maplines_gram(4, 4, factor, row->cov);
    }
    row->counter = check->last;
    row->ahead = check->ahead;
    row->state = (uint8_t)state_of(decoder, owner);
    row->e2e_status = (uint8_t)check->status;
    row->two_senders = has_two_senders(decoder, owner, t_ns);
    row->usable = line->status != MAPLINES_OUT_OF_RANGE && isfinite(line->age) &&
                  row->state == (uint8_t)MAPLINES_E2E_VALID && !row->two_senders;
    ++rows->line_count;
    rows->newest[slot] = rows->line_count;
}

/// Number of lines that the last record of a whole scene leaves out.
static uint64_t count_left_out(const maplines_decoder_t *decoder)
{
    const maplines_whole_t *whole = &decoder->whole;
    const maplines_scene_record_t *scene = whole->is_second_last ? &whole->second : &whole->first;
    uint64_t count = 0;
    for (size_t place = 0; place < scene->places; ++place)
    {
        const uint8_t *line = scene->record + place * decoder->dbc->scene.stride;
        count += maplines_get(&decoder->dbc->kind, line) > MAPLINES_NO_LINE ? 1U : 0U;
    }
    return count;
}

/// Take a frame and add its lines.
static maplines_reason_t feed(maplines_receiver_t *receiver, const maplines_frame_t *frame,
                              int64_t t_ns, int64_t place, maplines_rows_t *rows)
{
    maplines_decoder_t *decoder = &receiver->decoder;
    maplines_scene_t scene;
    const uint64_t pose_errors = decoder->statistics.pose_errors;
    const maplines_fed_t fed = maplines_feed_with(decoder, frame, t_ns, &scene);
    if (maplines_has_whole_scenes(decoder->dbc) && decoder->statistics.pose_errors != pose_errors)
    {
        receiver->left_out += count_left_out(decoder);
    }
    for (int i = 0; i < fed.count; ++i)
    {
        add_line(decoder, (int)fed.slots[i], &scene, i, place, maplines_limited_time(t_ns), rows);
    }
    return fed.reason;
}

static void read_scene_row(const maplines_decoder_t *decoder, const maplines_scene_t *scene,
                           int64_t frame, int64_t t_ns, maplines_scene_row_t *row)
{
    const int owner = maplines_owner_of_scene(decoder);
    const maplines_check_t *of_pose = &decoder->checks[owner];
    bool are_valid = of_pose->machine.state == MAPLINES_E2E_VALID;
    double cov[16 * MAPLINES_SLOTS * MAPLINES_SLOTS];
    memset(row, 0, sizeof *row);
    row->frame = frame;
    row->t_ns = scene->t_ns;
    row->age = scene->age;
    row->correlation_time = scene->correlation_time;
    row->counter = scene->counter;
    row->count = scene->count;
    row->state = (uint8_t)of_pose->machine.state;
    row->two_senders = !maplines_has_one_sender(decoder, owner, t_ns);
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        row->left_out[slot] = (uint8_t)scene->left_out[slot];
    }
    joint_covariance(scene, 0, scene->count, cov);
    const int n = 4 * scene->count;
    for (int i = 0; i < n; ++i)
    {
        memcpy(row->cov[i], cov + i * n, (size_t)n * sizeof(double));
    }
    for (int place = 0; place < scene->count; ++place)
    {
        const maplines_line_t *line = &scene->lines[place];
        const int of_line = maplines_owner_in_scene(decoder, (int)line->slot);
        const maplines_check_t *check = &decoder->checks[of_line];
        row->slots[place] = (uint8_t)line->slot;
        row->x_min[place] = line->x_min;
        row->x_max[place] = line->x_max;
        memcpy(row->mean[place], line->gaussian.mean, sizeof row->mean[place]);
        are_valid = are_valid && check->machine.state == MAPLINES_E2E_VALID;
        row->two_senders = row->two_senders || !maplines_has_one_sender(decoder, of_line, t_ns);
    }
    row->usable = are_valid && isfinite(row->age) && !row->two_senders;
}

/// Show the newest scene, which a frame may have changed; the one before is complete.
static void see_scene(maplines_decoder_t *decoder, int64_t frame, int64_t t_ns,
                      maplines_rows_t *rows, maplines_scene_row_t *shown)
{
    const bool is_shown = shown->frame >= 0;
    if (is_shown && decoder->is_built)
    {
        return;
    }
    const maplines_scene_t *scene = maplines_newest_scene(decoder, NULL);
    if (scene == NULL)
    {
        return;
    }
    if (is_shown && (shown->counter != scene->counter || shown->t_ns != scene->t_ns))
    {
        rows->scenes[rows->scene_count++] = *shown;
    }
    read_scene_row(decoder, scene, frame, maplines_limited_time(t_ns), shown);
}

/* ---- frames ---------------------------------------------------------------------------------- */

#define IS_EXTENDED UINT32_C(0x80000000)

/// MAC that was given for data; without one it is asked for, if there is room.
static bool given_mac(void *context, uint8_t key_id, const uint8_t *data, size_t length,
                      uint8_t mac[16])
{
    maplines_authentication_t *secoc = context;
    for (unsigned i = 0; i < secoc->answered; ++i)
    {
        if (length == secoc->size && memcmp(secoc->data[i], data, length) == 0)
        {
            memcpy(mac, secoc->macs[i], sizeof secoc->macs[i]);
            return true;
        }
    }
    if (secoc->asked < 2U && length <= sizeof secoc->data[0])
    {
        secoc->key_id = key_id;
        secoc->size = (uint8_t)length;
        memcpy(secoc->data[secoc->asked], data, length);
        ++secoc->asked;
    }
    return false;
}

static int64_t given_time(void *context)
{
    return ((const maplines_authentication_t *)context)->now_us;
}

const char *maplines_receiver_start(maplines_receiver_t *receiver, const maplines_dbc_t *dbc,
                                    maplines_settings_t *settings, int64_t window_us,
                                    bool has_clock)
{
    maplines_authenticator_t *authenticator = &receiver->secoc.authenticator;
    authenticator->mac = given_mac;
    authenticator->now_us = has_clock ? given_time : NULL;
    authenticator->context = &receiver->secoc;
    authenticator->window_us = window_us;
    settings->authenticator = window_us > 0 ? authenticator : NULL;
    receiver->rows.lines = receiver->lines;
    receiver->rows.components = receiver->components;
    receiver->shown.frame = -1;
    return maplines_decoder_init(&receiver->decoder, dbc, settings);
}

/// Copy a payload; of one that is longer than any frame, its beginning, and a length that is wrong.
static void set_data(maplines_frame_t *frame, const uint8_t *data, size_t length)
{
    const size_t room = sizeof frame->data;
    frame->length = (uint8_t)(length <= room ? length : room + 1U);
    memcpy(frame->data, data, length <= room ? length : room);
}

/// Take a frame; its lines become the rows of the receiver.
static int feed_one(maplines_receiver_t *receiver, const maplines_frame_t *frame, int64_t t_ns)
{
    maplines_rows_t *rows = &receiver->rows;
    rows->line_count = 0;
    rows->component_count = 0;
    const maplines_reason_t reason = feed(receiver, frame, t_ns, 0, rows);
    return reason == MAPLINES_COMPLETE ? -(int)rows->line_count : (int)reason;
}

/// Take a frame of a block; its lines are added to the rows, and the scene before, if it is
/// complete.
static maplines_reason_t feed_at(maplines_receiver_t *receiver, const maplines_frame_t *frame,
                                 int64_t t_ns, int64_t place, maplines_rows_t *rows,
                                 bool has_scenes)
{
    maplines_decoder_t *decoder = &receiver->decoder;
    const maplines_reason_t reason = feed(receiver, frame, t_ns, place, rows);
    if (has_scenes && decoder->dbc->has_pose)
    {
        see_scene(decoder, place, t_ns, rows, &receiver->shown);
    }
    return reason;
}

int maplines_receiver_feed(maplines_receiver_t *receiver, uint32_t can_id, int64_t t_ns,
                           const uint8_t *data, size_t length)
{
    maplines_frame_t frame;
    memset(&frame, 0, sizeof frame);
    frame.can_id = can_id & ~IS_EXTENDED;
    frame.is_extended = (can_id & IS_EXTENDED) != 0;
    set_data(&frame, data, length);
    return feed_one(receiver, &frame, t_ns);
}

/// Take the frame, whose MACs were given, alone or as one of a block.
static int take_secured(maplines_receiver_t *receiver)
{
    const maplines_authentication_t *secoc = &receiver->secoc;
    if (secoc->rows == NULL)
    {
        return feed_one(receiver, &secoc->frame, secoc->t_ns);
    }
    return (int)feed_at(receiver, &secoc->frame, secoc->t_ns, secoc->place, secoc->rows,
                        secoc->has_scenes);
}

/// Verify the frame without a change of the decoder; take it when no MAC is missing.
static int go_on(maplines_receiver_t *receiver, int owner)
{
    maplines_authentication_t *secoc = &receiver->secoc;
    maplines_decoder_t *decoder = &receiver->decoder;
    int64_t last_us = decoder->freshness_us[owner];
    (void)maplines_verify(decoder->dbc, owner, &secoc->authenticator, &secoc->frame, &last_us);
    return secoc->asked > secoc->answered ? MAPLINES_ASKS_MAC : take_secured(receiver);
}

int maplines_receiver_feed_secured(maplines_receiver_t *receiver, int owner, int64_t t_ns,
                                   const uint8_t *data, size_t length, int64_t now_us,
                                   int64_t last_us)
{
    const maplines_messages_t *messages = &receiver->decoder.dbc->messages[owner];
    maplines_authentication_t *secoc = &receiver->secoc;
    receiver->decoder.freshness_us[owner] = last_us;
    secoc->frame.can_id = messages->secured_can_id;
    secoc->frame.is_extended = messages->secured_is_extended;
    set_data(&secoc->frame, data, length);
    secoc->owner = owner;
    secoc->t_ns = t_ns;
    secoc->now_us = now_us;
    secoc->asked = 0;
    secoc->answered = 0;
    return go_on(receiver, owner);
}

int maplines_receiver_give_mac(maplines_receiver_t *receiver, const uint8_t *mac)
{
    maplines_authentication_t *secoc = &receiver->secoc;
    if (mac == NULL) // nothing is asked for again
    {
        secoc->asked = 2;
        return take_secured(receiver);
    }
    if (secoc->answered < secoc->asked)
    {
        memcpy(secoc->macs[secoc->answered], mac, sizeof secoc->macs[0]);
        ++secoc->answered;
    }
    return go_on(receiver, secoc->owner);
}

/// Whether a frame waits for its MAC.
static bool is_secured(const maplines_decoder_t *decoder, const maplines_frame_t *frame)
{
    bool is_found = false;
    for (int owner = 0; owner < MAPLINES_OWNERS && decoder->settings.authenticator != NULL; ++owner)
    {
        const maplines_messages_t *messages = &decoder->dbc->messages[owner];
        is_found = is_found || (messages->is_present && messages->has_secured &&
                                messages->secured_can_id == frame->can_id &&
                                messages->secured_is_extended == frame->is_extended);
    }
    return is_found;
}

static bool has_room(const maplines_rows_t *rows)
{
    return rows->line_count + MAPLINES_SLOTS <= rows->max_lines &&
           rows->component_count + MAPLINES_MAX_COMPONENTS <= rows->max_components &&
           rows->scene_count < rows->max_scenes;
}

size_t maplines_receiver_feed_block(maplines_receiver_t *receiver, const maplines_block_t *block,
                                    size_t first, maplines_rows_t *rows, bool has_scenes)
{
    maplines_frame_t frame;
    memset(&frame, 0, sizeof frame);
    rows->is_waiting = false;
    size_t k = first;
    while (k < block->count && has_room(rows))
    {
        const int64_t i = block->places[k];
        if (i < 0 || (size_t)i >= block->frames) // another thread has changed it
        {
            ++k;
            continue;
        }
        const uint8_t length = block->lengths[i];
        frame.can_id = block->can_ids[i];
        frame.is_extended = block->are_extended[i] != 0;
        if (is_secured(&receiver->decoder, &frame))
        {
            rows->is_waiting = true;
            break;
        }
        ++k;
        frame.length = length <= block->width ? length : (uint8_t)block->width;
        memcpy(frame.data, block->data + (size_t)i * block->width, block->width);
        block->reasons[i] = (uint8_t)feed_at(receiver, &frame, block->times_ns[i], i, rows,
                                             has_scenes); // -1 becomes 255
    }
    return k;
}

/* ---- scenes and checks -------------------------------------------------------------------------
 */

bool maplines_receiver_scene(maplines_receiver_t *receiver, bool is_known)
{
    maplines_decoder_t *decoder = &receiver->decoder;
    maplines_seen_scene_t *scene = &receiver->seen;
    const bool is_same = is_known && decoder->is_built;
    const maplines_scene_t *newest =
        is_same || !decoder->dbc->has_pose ? NULL : maplines_newest_scene(decoder, NULL);
    if (newest == NULL)
    {
        return false;
    }
    scene->scene = newest;
    maplines_product_transposed(3, 3, 3, newest->pose_factor[0], newest->pose_factor[0],
                                scene->pose_cov);
    joint_covariance(newest, 0, newest->count, scene->cov);
    for (int place = 0; place < newest->count; ++place)
    {
        const maplines_line_t *line = &newest->lines[place];
        const double *factor = newest->specific[place][0];
        read_line(line, &scene->lines[place]);
        joint_covariance(newest, place, 1, scene->lines[place].cov);
        maplines_gram(4, 4, factor, scene->specific[place]);
        // The newest one is a copy of a line of the scene, with all its bytes.
        const maplines_line_t *known = &decoder->newest[line->slot];
        const bool is_copy = memcmp(known, line, sizeof *line) == 0; // NOLINT(bugprone-*,cert-*)
        scene->are_newest[place] = decoder->dbc->is_conditional && is_copy;
    }
    return true;
}

int maplines_receiver_elapse(maplines_receiver_t *receiver, int owner, int64_t t_ns)
{
    return (int)maplines_check_elapse(&receiver->decoder, owner, maplines_limited_time(t_ns));
}

bool maplines_receiver_has_one_sender(const maplines_receiver_t *receiver, int owner, int64_t t_ns)
{
    return maplines_has_one_sender(&receiver->decoder, owner, maplines_limited_time(t_ns));
}
