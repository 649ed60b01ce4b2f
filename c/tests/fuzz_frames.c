/* Fuzzing of a receiver: frames and times in any order, damaged and intact, and all that a function
 * of the car computes with the lines that come of them.
 *
 * The input is a list of steps. Most bits on a bus fail the checksum, so there are also steps that
 * take any content and seal it as a sender would: then what the content means is decoded. After
 * each step, and at the end, the program aborts if something does not hold that holds for any
 * input.
 */
#include "fuzz.h"

static void check_all(maplines_decoder_t *decoder, int64_t now_ns)
{
    maplines_statistics_t sum;
    maplines_statistics(decoder, &sum);
    uint64_t frames = sum.line_frames + sum.pose_frames + sum.pending;
    for (int reason = 0; reason < MAPLINES_REASONS; ++reason)
    {
        frames += sum.counts[reason];
    }
    REQUIRE(frames == sum.frames);
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        maplines_slot_stats_t stats;
        (void)maplines_slot_stats(decoder, (maplines_owner_t)slot, now_ns, &stats);
        if (!decoder->dbc->messages[slot].is_present)
        {
            continue;
        }
        maplines_view_t view;
        maplines_latest(decoder, (maplines_owner_t)slot, now_ns, &view);
        if (view.line != NULL)
        {
            check_line(view.line);
        }
        REQUIRE(!view.is_usable || (view.line != NULL && is_a_number(view.age) && !view.is_stale));
    }
    if (decoder->dbc->has_pose)
    {
        maplines_scene_view_t view;
        maplines_latest_scene(decoder, now_ns, &view);
        REQUIRE(!view.is_usable || view.scene != NULL);
        for (int i = 0; view.scene != NULL && i < view.scene->count; ++i)
        {
            check_line(&view.scene->lines[i]);
        }
    }
}

static void feed(maplines_decoder_t *decoder, maplines_frame_t *frame, int64_t t_ns)
{
    const maplines_fed_t fed = maplines_feed(decoder, frame, t_ns);
    REQUIRE((fed.reason == MAPLINES_COMPLETE) == (fed.count > 0));
    for (int i = 0; i < fed.count; ++i)
    {
        const maplines_line_t *line = maplines_newest(decoder, fed.slots[i]);
        REQUIRE(line != NULL);
        check_line(line);
    }
}

/// Set the CAN ID of a message of an owner: classic, CAN FD, or authenticated.
static bool address(const maplines_dbc_t *dbc, int owner, int kind, maplines_frame_t *frame)
{
    const maplines_messages_t *messages = &dbc->messages[owner];
    const bool has[3] = {messages->has_classic, messages->has_fd, messages->has_secured};
    const uint32_t ids[3] = {messages->can_id, messages->fd_can_id, messages->secured_can_id};
    const bool extended[3] = {messages->is_extended, messages->fd_is_extended,
                              messages->secured_is_extended};
    frame->can_id = ids[kind];
    frame->is_extended = extended[kind];
    frame->is_fd = kind > 0;
    return messages->is_present && has[kind];
}

/// A frame of any content.
static void any_frame(maplines_decoder_t *decoder, input_t *input, int64_t t_ns)
{
    maplines_frame_t frame;
    memset(&frame, 0, sizeof frame);
    const uint8_t where = next(input);
    if (!address(decoder->dbc, where % MAPLINES_OWNERS, (where / MAPLINES_OWNERS) % 3, &frame))
    {
        frame.can_id = (uint32_t)next(input) << 3U;
        frame.is_extended = where > 200;
    }
    const uint8_t length = next(input);
    frame.length = length < 192 ? 8 : length % 65;
    for (int i = 0; i < frame.length; ++i)
    {
        frame.data[i] = next(input);
    }
    feed(decoder, &frame, t_ns);
}

/// An intact record of any content: in one CAN FD frame, with a MAC, or in its pages, some of which
/// are lost or come twice.
static void sealed_record(maplines_decoder_t *decoder, input_t *input, int64_t t_ns)
{
    const maplines_dbc_t *dbc = decoder->dbc;
    const uint8_t where = next(input);
    const int owner = where % MAPLINES_OWNERS;
    if (!dbc->messages[owner].is_present)
    {
        return;
    }
    const maplines_record_t *layout = maplines_layout(dbc, owner);
    const uint8_t counter = next(input);
    const uint8_t form = next(input);
    const size_t pages = (form & 1U) != 0 ? layout->short_pages : layout->pages;
    uint8_t record[MAPLINES_MAX_RECORD] = {0};
    for (size_t i = 0; i < 8 * pages; ++i)
    {
        record[i] = next(input);
    }
    maplines_seal(dbc, owner, record, 8 * pages, counter);
    maplines_frame_t frame;
    memset(&frame, 0, sizeof frame);
    if ((form & 2U) != 0 && address(dbc, owner, 1, &frame))
    {
        frame.length = dbc->messages[owner].fd_length;
        memcpy(frame.data, record, 8 * pages < frame.length ? 8 * pages : frame.length);
        feed(decoder, &frame, t_ns);
        return;
    }
    if ((form & 8U) != 0 && address(dbc, owner, 2, &frame))
    {
        maplines_signer_t signer = {fuzz_mac, NULL, form >> 6U, next_time(input, 0) / 1000};
        frame.length = (uint8_t)maplines_secured_pdu(layout, dbc->messages[owner].secured_data_id,
                                                     record, 8 * pages, 0, &signer, frame.data);
        if (frame.length > 0)
        {
            feed(decoder, &frame, t_ns);
        }
        return;
    }
    if (!address(dbc, owner, 0, &frame))
    {
        return;
    }
    frame.length = 8;
    const uint8_t lost = (form & 4U) != 0 ? next(input) : 0xFF;
    for (size_t page = 0; page < pages; ++page)
    {
        memcpy(frame.data, record + 8 * page, 8);
        for (int copies = page == lost % 16U ? lost / 64 : 1; copies > 0; --copies)
        {
            feed(decoder, &frame, t_ns);
        }
    }
}

/* ---- what a function of the car computes with lines ---- */

/// What is known has a standard deviation; what a line says nothing of is NaN.
static void check_estimate(maplines_estimate_t estimate, bool is_known)
{
    REQUIRE(is_known ? estimate.sigma >= 0
                     : estimate.value != estimate.value && estimate.sigma != estimate.sigma);
}

/// What holds for a Gaussian that is predicted, however far: rounding may leave no variance.
static void check_gaussian(const maplines_gaussian_t *gaussian)
{
    maplines_real_t covariance[4][4];
    maplines_covariance(gaussian, covariance);
    for (int i = 0; i < 4; ++i)
    {
        REQUIRE(is_a_number(gaussian->mean[i]));
        REQUIRE(covariance[i][i] >= 0);
    }
}

static maplines_motion_t next_motion(input_t *input)
{
    maplines_motion_t motion;
    motion.speed = next_real(input, 10);
    motion.yaw_rate = next_real(input, 0.1);
    motion.speed_sigma = next_real(input, 0.1);
    motion.yaw_rate_sigma = next_real(input, 0.01);
    motion.correlation = next_real(input, 0.2);
    return motion;
}

static void predict(const maplines_decoder_t *decoder, input_t *input, const maplines_line_t *line,
                    int64_t t_ns)
{
    maplines_gaussian_t components[MAPLINES_MAX_COMPONENTS];
    maplines_real_t weights[MAPLINES_MAX_COMPONENTS];
    maplines_displacement_t displacement;
    maplines_line_t predicted;
    const maplines_motion_t motion = next_motion(input);
    if (maplines_predict_to(line, t_ns, &motion, next_real(input, 0.01), &predicted) ==
        MAPLINES_PREDICTED)
    {
        check_gaussian(&predicted.gaussian);
        REQUIRE(predicted.x_min <= predicted.x_max);
        REQUIRE(predicted.age == 0 && predicted.components == 1 && predicted.t_ns == t_ns);
    }
    if (maplines_displacement(&motion, next_real(input, 0.2), 0, &displacement) &&
        maplines_predict(line, t_ns, &displacement, &predicted) == MAPLINES_PREDICTED)
    {
        check_gaussian(&predicted.gaussian);
        REQUIRE(predicted.x_min <= predicted.x_max);
    }
    for (int i = 0; i < 3; ++i)
    {
        displacement.mean[i] = next_real(input, 1);
        for (int j = 0; j < 3; ++j)
        {
            displacement.factor[i][j] = j > i ? 0 : next_real(input, 0.1);
        }
    }
    bool are_predicted = line == maplines_newest(decoder, line->slot);
    for (uint8_t i = 0; are_predicted && i < line->components; ++i)
    {
        REQUIRE(maplines_component(decoder, line->slot, i, &components[i], &weights[i]));
        REQUIRE(weights[i] > 0);
        check_gaussian(&components[i]);
        are_predicted =
            maplines_predict_gaussian(&components[i], &displacement, line->x_min, line->x_max,
                                      &components[i]) == MAPLINES_PREDICTED;
    }
    if (are_predicted)
    {
        maplines_overall(line->components, components, weights, &components[0]);
        check_gaussian(&components[0]);
    }
}

static void use_line(const maplines_decoder_t *decoder, input_t *input, const maplines_line_t *line,
                     int64_t t_ns)
{
    maplines_position_t positions[MAPLINES_MAX_POSITIONS];
    const size_t count = next(input) % (MAPLINES_MAX_POSITIONS + 1U);
    bool are_inside = true;
    const maplines_real_t x = next_real(input, 20);
    const maplines_real_t any = next_real(input, 20);
    const maplines_real_t distance = any > 0 ? any : 10; // others are a mistake of the caller
    const bool are_valid = maplines_is_valid_at(line, x - distance / 2) &&
                           maplines_is_valid_at(line, x + distance / 2);
    check_estimate((maplines_estimate_t){maplines_y(line, x), maplines_y_sigma(line, x)},
                   maplines_is_valid_at(line, x));
    check_estimate(maplines_y_extrapolated(line, x), is_a_number(x));
    check_estimate(maplines_slope(line, x, distance), are_valid);
    check_estimate(maplines_curvature(line, x, distance), are_valid);
    check_gaussian(&line->gaussian);
    for (size_t i = 0; i < count; ++i)
    {
        positions[i].x = next_real(input, 20);
        positions[i].y = next_real(input, 2);
        positions[i].sigma = next_real(input, 0.1);
        are_inside = are_inside && maplines_is_valid_at(line, positions[i].x);
    }
    const maplines_real_t away = maplines_mahalanobis(line, count, positions);
    REQUIRE(are_inside ? away >= 0 : away != away);
    predict(decoder, input, line, t_ns);
}

static void use_scene(const maplines_decoder_t *decoder, input_t *input,
                      const maplines_scene_t *scene, int64_t t_ns)
{
    maplines_term_t terms[MAPLINES_SLOTS] = {{MAPLINES_EGO_LEFT, 0, 0}};
    maplines_owner_t slots[MAPLINES_SLOTS] = {MAPLINES_EGO_LEFT};
    maplines_real_t covariance[16 * MAPLINES_SLOTS * MAPLINES_SLOTS];
    maplines_real_t x_min;
    maplines_real_t x_max;
    maplines_estimate_t estimate;
    const size_t count = next(input) % (MAPLINES_SLOTS + 1U);
    for (size_t i = 0; i < count; ++i)
    {
        const uint8_t place = next(input);
        const bool is_any = place >= 240 || scene->count == 0;
        slots[i] =
            is_any ? (maplines_owner_t)(place % 12U) : scene->lines[place % scene->count].slot;
        const maplines_real_t x = next_real(input, 20);
        const maplines_real_t weight = next_real(input, 0.5);
        terms[i] = (maplines_term_t){slots[i], x, is_a_number(weight) ? weight : 1};
    }
    const bool is_known = maplines_sum(scene, count, terms, &estimate);
    check_estimate(estimate, is_known);
    if (maplines_joint_covariance(scene, count, slots, covariance))
    {
        for (size_t i = 0; i < 4 * count; ++i)
        {
            REQUIRE(covariance[i * (4 * count + 1)] > 0);
        }
    }
    if (maplines_common_range(scene, count, slots, &x_min, &x_max))
    {
        REQUIRE(x_min <= x_max);
        const maplines_owner_t last = slots[count - 1];
        REQUIRE(maplines_width(scene, slots[0], last, x_min, &estimate));
        check_estimate(estimate, true);
        REQUIRE(maplines_centre(scene, slots[0], last, x_max, &estimate));
        check_estimate(estimate, true);
        use_line(decoder, input, maplines_scene_line(scene, last), t_ns);
    }
}

/// Use the newest line of a slot, or the newest scene.
static void use(maplines_decoder_t *decoder, input_t *input, int64_t t_ns)
{
    const int owner = next(input) % MAPLINES_OWNERS;
    if (owner < MAPLINES_SLOTS)
    {
        const maplines_line_t *line = maplines_newest(decoder, (maplines_owner_t)owner);
        if (line != NULL)
        {
            use_line(decoder, input, line, t_ns);
        }
    }
    else if (decoder->dbc->has_pose)
    {
        maplines_scene_view_t view;
        maplines_latest_scene(decoder, t_ns, &view);
        if (view.scene != NULL)
        {
            use_scene(decoder, input, view.scene, t_ns);
        }
    }
}

/* ---- the steps ---- */

static int64_t fuzz_now_us(void *context)
{
    (void)context;
    return 1000000;
}

/// Start a receiver. Half of them have the default settings; some verify MACs.
static void begin(maplines_decoder_t *decoder, input_t *input)
{
    static const maplines_authenticator_t authenticators[2] = {
        {fuzz_mac, NULL, NULL, 1, 0}, {fuzz_mac, fuzz_now_us, NULL, 1000000, 0}};
    maplines_settings_t settings;
    const uint8_t choice = next(input);
    maplines_default_settings(&harness_dbc, &settings);
    if ((choice & 1U) != 0)
    {
        maplines_e2e_config_t e2e = maplines_default_e2e();
        e2e.max_delta_counter = next(input);
        e2e.window_size_init = next(input);
        e2e.window_size_valid = next(input);
        e2e.min_ok_state_init = next(input);
        e2e.max_error_state_valid = next(input);
        e2e.clear_to_invalid = (choice & 2U) != 0;
        const double timeout_ms = next_number(input, 20);
        const double cycle_ms = next_number(input, 20);
        (void)maplines_settings_for(&harness_dbc, timeout_ms, cycle_ms,
                                    (choice & 4U) != 0 ? &e2e : NULL, &settings);
        settings.stale_cycles = next_number(input, 1);
    }
    settings.refuses_short_spacings = (choice & 8U) != 0;
    settings.authenticator = choice >= 64 ? NULL : &authenticators[choice & 1U];
    const char *problem = maplines_decoder_init(decoder, &harness_dbc, &settings);
    if (problem != NULL)
    {
        REQUIRE(choice < 64 || (choice & 1U) != 0);
        REQUIRE(maplines_decoder_init(decoder, &harness_dbc, NULL) == NULL);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static maplines_decoder_t decoder; // too large for some stacks; begun anew each time
    input_t input = {data, size, false};
    begin(&decoder, &input);
    int64_t t_ns = 1000000000;
    while (input.left > 0)
    {
        const uint8_t step = next(&input);
        t_ns = next_time(&input, t_ns);
        if (step < 80)
        {
            any_frame(&decoder, &input, t_ns);
        }
        else if (step < 208)
        {
            sealed_record(&decoder, &input, t_ns);
        }
        else if (step < 212)
        {
            maplines_expire(&decoder, t_ns);
        }
        else if (step < 216)
        {
            check_all(&decoder, t_ns);
        }
        else
        {
            input.is_ordinary = step % 2U == 0U;
            use(&decoder, &input, t_ns);
        }
        t_ns = t_ns < -MAPLINES_MAX_TIME || t_ns > MAPLINES_MAX_TIME ? 0 : t_ns;
    }
    check_all(&decoder, t_ns);
    return 0;
}
