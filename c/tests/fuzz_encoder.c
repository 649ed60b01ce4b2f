/* Fuzzing of a sender: lines, mixtures and scenes of any numbers are encoded. What is not refused
 * must reach a receiver, and what that decodes must cover what was given.
 */
#include "fuzz.h"

#define MAX_VALUES (4 * MAPLINES_SLOTS)
#define STEP_NS INT64_C(50000000) ///< cycle of the sender

/// Sender and receiver of all lines, and the signer of both.
typedef struct {
    maplines_encoder_t encoder;
    maplines_decoder_t decoder;
    maplines_signer_t signer;
    int64_t t_ns;
    maplines_frame_t frames[MAPLINES_MAX_FRAMES > MAPLINES_MAX_SCENE_FRAMES
                                ? MAPLINES_MAX_FRAMES
                                : MAPLINES_MAX_SCENE_FRAMES];
} link_t;

/// Time of the freshness values, which are few.
static int64_t now_us(void *context)
{
    (void)context;
    return 0;
}

static const maplines_authenticator_t authenticator = {fuzz_mac, now_us, NULL, 1000000, 0};
static const double scales[4] = {0.5, 0.02, 1e-3, 1e-5}; // of the parameters of a line

/* ---- what is encoded ---- */

/// Covariance of n states, with zeros, and some entries that are no covariances.
static void next_covariance(input_t *input, int n, const double *scale, double *cov)
{
    double F[16];
    const double wider = ldexp(0.1, (int8_t)next(input) / 8);
    for (int i = 0; i < n * n; ++i)
    {
        F[i] = i % n > i / n ? 0.0 : next_number(input, wider * scale[i / n]);
    }
    maplines_gram(n, n, F, cov);
    const uint8_t damage = next(input);
    if (damage >= 224 && !input->is_ordinary)
    {
        const int row = damage % n;
        const int column = next(input) % n;
        cov[n * row + column] = next_number(input, scale[row] * scale[column]);
        cov[n * column + row] = damage < 252 ? cov[n * row + column] : 0.0;
    }
}

static void next_mean(input_t *input, double mean[4])
{
    const double wider = ldexp(1.0, (int8_t)next(input) / 16);
    for (int i = 0; i < 4; ++i)
    {
        mean[i] = next_number(input, wider * scales[i]);
    }
}

/// Slots that the DBC has, in whole scenes all; returns their number.
static unsigned slots_of_dbc(maplines_owner_t slots[MAPLINES_SLOTS])
{
    unsigned count = 0;
    for (int slot = 0; slot < MAPLINES_SLOTS; ++slot)
    {
        if (harness_dbc.messages[slot].is_present || harness_dbc.scene.places > 0)
        {
            slots[count] = (maplines_owner_t)slot;
            ++count;
        }
    }
    return count;
}

static maplines_input_t next_line(input_t *input)
{
    maplines_owner_t slots[MAPLINES_SLOTS];
    maplines_input_t line;
    memset(&line, 0, sizeof line);
    const uint8_t status = next(input);
    const unsigned excess = input->is_ordinary ? 0U : 2U;
    const uint8_t slot = next(input);
    const unsigned present = slots_of_dbc(slots);
    line.slot = input->is_ordinary ? slots[slot % present]
                                   : (maplines_owner_t)(slot % (MAPLINES_SLOTS + excess));
    line.kind = (maplines_kind_t)(status % (8U + excess));
    line.status = status < 160 ? MAPLINES_FULL : (maplines_status_t)(status % (6U + excess));
    line.x_min = next_number(input, 10);
    line.x_max = line.x_min + fabs(next_number(input, 20));
    line.age = fabs(next_number(input, 0.05));
    line.has_age = true;
    next_mean(input, line.mean);
    return line;
}

/* ---- what must hold ---- */

/// Require that a decoded covariance is not less than the given one about the decoded mean, whose
/// error is known, in any direction: the difference is positive semidefinite, up to rounding.
static void require_cover(int n, const double *decoded, const double *given, const double *error)
{
    double rest[MAX_VALUES * MAX_VALUES];
    for (int i = 0; i < n * n; ++i)
    {
        const int row = i / n;
        const int column = i % n;
        const double scale = sqrt(decoded[(n + 1) * row]) * sqrt(decoded[(n + 1) * column]);
        const double excess = decoded[i] - given[i] - error[row] * error[column];
        rest[i] = excess / scale + (row == column ? 1e-9 : 0.0);
    }
    REQUIRE(maplines_cholesky_factor(n, rest, rest));
}

/// Require that a decoded Gaussian covers the given one as its status says.
static void require_line(const maplines_gaussian_t *gaussian, maplines_status_t status,
                         const double mean[4], const double *cov)
{
    maplines_real_t decoded[4][4];
    double error[4];
    maplines_covariance(gaussian, decoded);
    for (int i = 0; i < 4; ++i)
    {
        error[i] = mean[i] - gaussian->mean[i];
        if (status == MAPLINES_FULL || status == MAPLINES_UNKNOWN)
        {
            REQUIRE(fabs(error[i]) <= 0.51 * fabs(harness_dbc.mean[i].scale->factor));
        }
        if (status == MAPLINES_DIAGONAL)
        {
            REQUIRE(decoded[i][i] * (1 + 1e-9) >= cov[5 * i] + error[i] * error[i]);
        }
    }
    if (status == MAPLINES_FULL || status == MAPLINES_SATURATED || status == MAPLINES_REPAIRED)
    {
        require_cover(4, decoded[0], cov, error);
    }
}

/// Feed frames to a receiver, which must drop none of them; returns what the last one is.
static maplines_fed_t feed_all(maplines_decoder_t *decoder, const maplines_frame_t *frames,
                               size_t count, int64_t t_ns)
{
    maplines_fed_t fed = {MAPLINES_PENDING, 0, {MAPLINES_EGO_LEFT}};
    for (size_t i = 0; i < count; ++i)
    {
        fed = maplines_feed(decoder, &frames[i], t_ns);
        REQUIRE(fed.reason == MAPLINES_PENDING || fed.reason == MAPLINES_COMPLETE);
    }
    return fed;
}

/// Receive the line or mixture that was sent; NULL if it was refused.
static const maplines_line_t *receive(link_t *link, const maplines_encoder_t *before,
                                      const maplines_input_t *given, maplines_sent_t sent)
{
    if (sent.refusal != MAPLINES_SENT)
    {
        REQUIRE(sent.count == 0);
        REQUIRE(memcmp(before->counter, link->encoder.counter, sizeof before->counter) == 0);
        return NULL;
    }
    const maplines_fed_t fed = feed_all(&link->decoder, link->frames, sent.count, link->t_ns);
    REQUIRE(fed.reason == MAPLINES_COMPLETE && fed.count == 1 && fed.slots[0] == given->slot);
    const maplines_line_t *line = maplines_newest(&link->decoder, given->slot);
    check_line(line);
    REQUIRE(line->kind == given->kind && line->status == sent.status);
    REQUIRE(line->age >= given->age - 1e-9);
    if (sent.status != MAPLINES_OUT_OF_RANGE)
    {
        REQUIRE(line->x_min >= given->x_min && line->x_max <= given->x_max);
    }
    return line;
}

/* ---- the steps ---- */

static void send_line(link_t *link, input_t *input, bool is_fd)
{
    const maplines_encoder_t before = link->encoder;
    maplines_input_t given = next_line(input);
    next_covariance(input, 4, scales, given.cov[0]);
    const maplines_sent_t sent =
        maplines_encode_line(&link->encoder, &given, is_fd, 0, link->frames);
    const maplines_line_t *line = receive(link, &before, &given, sent);
    if (line != NULL)
    {
        require_line(&line->gaussian, line->status, given.mean, given.cov[0]);
    }
}

/// Mean and covariance of the given mixture, whose weights add up to 1 but for rounding.
static void moments_of(const maplines_component_t *components, size_t count, double mean[4],
                       double cov[4][4])
{
    double total = 0.0;
    memset(mean, 0, 4 * sizeof(double));
    memset(cov, 0, 16 * sizeof(double));
    for (size_t k = 0; k < count; ++k)
    {
        total += components[k].weight;
    }
    for (int i = 0; i < 4; ++i)
    {
        for (size_t k = 0; k < count; ++k)
        {
            mean[i] += components[k].weight / total * components[k].mean[i];
        }
    }
    for (int i = 0; i < 16; ++i)
    {
        for (size_t k = 0; k < count; ++k)
        {
            const maplines_component_t *part = &components[k];
            const double product =
                (part->mean[i / 4] - mean[i / 4]) * (part->mean[i % 4] - mean[i % 4]);
            cov[i / 4][i % 4] += part->weight / total * (part->cov[i / 4][i % 4] + product);
        }
    }
}

static void send_mixture(link_t *link, input_t *input, bool is_fd)
{
    const maplines_encoder_t before = link->encoder;
    maplines_component_t components[MAPLINES_MAX_COMPONENTS];
    maplines_gaussian_t gaussian;
    maplines_real_t weight;
    maplines_input_t given = next_line(input);
    const size_t count = 1U + next(input) % MAPLINES_MAX_COMPONENTS;
    double left = 1.0;
    for (size_t k = 0; k < count; ++k)
    {
        const double share = ((double)next(input) + 0.5) / 256.0;
        components[k].weight = k + 1U == count ? left : left * share;
        left -= components[k].weight;
        next_mean(input, components[k].mean);
        next_covariance(input, 4, scales, components[k].cov[0]);
    }
    if (!input->is_ordinary && next(input) >= 128)
    {
        components[0].weight = next_number(input, 0.1);
    }
    const maplines_sent_t sent =
        maplines_encode_mixture(&link->encoder, &given, components, count, is_fd, 0, link->frames);
    const maplines_line_t *line = receive(link, &before, &given, sent);
    if (line == NULL || line->status == MAPLINES_OUT_OF_RANGE)
    {
        return;
    }
    REQUIRE(line->components == count);
    for (size_t k = 0; k < count; ++k)
    {
        REQUIRE(maplines_component(&link->decoder, line->slot, (uint8_t)k, &gaussian, &weight));
        require_line(&gaussian, line->status, components[k].mean, components[k].cov[0]);
    }
    if (line->status == MAPLINES_FULL)
    {
        moments_of(components, count, given.mean, given.cov);
        require_line(&line->gaussian, MAPLINES_SATURATED, given.mean, given.cov[0]);
    }
}

/// Lines of a scene whose covariance is due to the pose error and to each of them, and some of any
/// covariance.
static void next_scene(input_t *input, maplines_scene_input_t *scene)
{
    static const double pose_scales[3] = {0.5, 0.2, 0.01};
    double A[MAX_VALUES][3];
    memset(scene, 0, sizeof *scene);
    maplines_owner_t slots[MAPLINES_SLOTS];
    const unsigned present = slots_of_dbc(slots);
    const unsigned first = next(input);
    scene->count = (uint8_t)(first % ((input->is_ordinary ? present : MAPLINES_SLOTS) + 1U));
    scene->has_specific = first < 128;
    next_covariance(input, 3, pose_scales, scene->pose_cov[0]);
    scene->pose_age = fabs(next_number(input, 0.05));
    scene->has_pose_age = true;
    scene->correlation_time = fabs(next_number(input, 5));
    scene->offset_sigma = fabs(next_number(input, 0.02));
    scene->heading_sigma = fabs(next_number(input, 1e-3));
    for (unsigned i = 0; i < scene->count; ++i)
    {
        maplines_scene_line_t *line = &scene->lines[i];
        const maplines_input_t any = next_line(input);
        line->slot = input->is_ordinary ? slots[(first + i) % present] : any.slot;
        line->kind = any.kind;
        line->status = any.status;
        line->x_min = any.x_min;
        line->x_max = any.x_max;
        line->age = any.age;
        line->has_age = any.has_age;
        memcpy(line->mean, any.mean, sizeof line->mean);
        line->fit_range[0] = line->x_min - fabs(next_number(input, 1));
        line->fit_range[1] = line->x_max + fabs(next_number(input, 1));
        line->quartic = next_number(input, 0.002);
        next_covariance(input, 4, scales, line->specific[0]);
        const double J[4][3] = {{line->mean[1], -1, -line->mean[0] * line->mean[1]},
                                {line->mean[2], 0, -1},
                                {line->mean[3], 0, 0},
                                {0, 0, 0}};
        memcpy(A[4 * i], J[0], sizeof J);
    }
    const int n = 4 * scene->count;
    double AP[MAX_VALUES * 3];
    double cov[MAX_VALUES * MAX_VALUES];
    maplines_product(n, 3, 3, A[0], scene->pose_cov[0], AP);
    maplines_product_transposed(n, 3, n, AP, A[0], cov);
    for (int i = 0; i < n * n; ++i)
    {
        const int row = i / n;
        const int column = i % n;
        const bool is_own = row / 4 == column / 4;
        scene->cov[row][column] =
            cov[i] + (is_own ? scene->lines[row / 4].specific[row % 4][column % 4] : 0.0);
    }
    if (n > 0 && !input->is_ordinary && next(input) >= 128)
    {
        const int row = next(input) % n;
        scene->cov[row][row] = next_number(input, 1);
    }
}

/// Require that the newest scene covers the lines that were sent as parts of it.
static void require_scene(maplines_decoder_t *decoder, const maplines_scene_input_t *given,
                          const maplines_sent_scene_t *sent, int64_t t_ns)
{
    maplines_scene_view_t view;
    maplines_owner_t slots[MAPLINES_SLOTS];
    int places[MAPLINES_SLOTS];
    double least[MAX_VALUES * MAX_VALUES];
    double decoded[MAX_VALUES * MAX_VALUES];
    double error[MAX_VALUES];
    int count = 0;
    maplines_latest_scene(decoder, t_ns, &view);
    for (int i = 0; i < given->count; ++i)
    {
        if (sent->left_out[i] == MAPLINES_IN_SCENE)
        {
            REQUIRE(sent->is_sent[i]);
            slots[count] = given->lines[i].slot;
            places[count] = i;
            ++count;
        }
    }
    if (count == 0)
    {
        return;
    }
    REQUIRE(view.scene != NULL && view.scene->count == count);
    REQUIRE(maplines_joint_covariance(view.scene, (size_t)count, slots, decoded));
    for (int i = 0; i < 4 * count; ++i)
    {
        const maplines_line_t *line = maplines_scene_line(view.scene, slots[i / 4]);
        const int row = 4 * places[i / 4] + i % 4;
        error[i] = given->lines[places[i / 4]].mean[i % 4] - line->gaussian.mean[i % 4];
        for (int j = 0; j < 4 * count; ++j)
        {
            least[4 * count * i + j] = given->cov[row][4 * places[j / 4] + j % 4];
        }
    }
    require_cover(4 * count, decoded, least, error);
}

static void send_scene(link_t *link, input_t *input, bool is_fd)
{
    static maplines_scene_workspace_t workspace; // too large for some stacks
    static maplines_decoder_t decoder;           // begun anew, so that there is no scene before
    maplines_scene_input_t given;
    const maplines_encoder_t before = link->encoder;
    next_scene(input, &given);
    const maplines_sent_scene_t sent =
        maplines_encode_scene(&link->encoder, &given, is_fd, 0, &workspace, link->frames);
    if (sent.refusal != MAPLINES_SENT)
    {
        REQUIRE(sent.count == 0);
        REQUIRE(memcmp(before.counter, link->encoder.counter, sizeof before.counter) == 0);
        return;
    }
    REQUIRE(maplines_decoder_init(&decoder, &harness_dbc, &link->decoder.settings) == NULL);
    (void)feed_all(&decoder, link->frames, sent.count, link->t_ns);
    (void)feed_all(&link->decoder, link->frames, sent.count, link->t_ns);
    for (int i = 0; i < given.count; ++i)
    {
        const maplines_line_t *line = maplines_newest(&decoder, given.lines[i].slot);
        REQUIRE((line != NULL) == sent.is_sent[i]);
        if (line != NULL)
        {
            check_line(line);
            REQUIRE(line->kind == given.lines[i].kind && line->status == sent.status[i]);
        }
    }
    require_scene(&decoder, &given, &sent, link->t_ns);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static link_t link; // too large for some stacks; begun anew each time
    input_t input = {data, size, false};
    maplines_settings_t settings;
    maplines_default_settings(&harness_dbc, &settings);
    const bool has_secured = harness_dbc.line.fd_authentic > 0 || harness_dbc.pose.fd_authentic > 0;
    const bool is_signed = has_secured && next(&input) < 64;
    settings.authenticator = is_signed ? &authenticator : NULL;
    link.signer = (maplines_signer_t){fuzz_mac, NULL, 1, 0};
    link.t_ns = 1000000000;
    maplines_encoder_init(&link.encoder, &harness_dbc, is_signed ? &link.signer : NULL);
    REQUIRE(maplines_decoder_init(&link.decoder, &harness_dbc, &settings) == NULL);
    while (input.left > 0)
    {
        const uint8_t step = next(&input);
        const bool is_fd = is_signed || step % 2U == 1U;
        input.is_ordinary = step % 4U < 2U;
        link.t_ns += STEP_NS;
        if (step < 96)
        {
            send_line(&link, &input, is_fd);
        }
        else if (step < 160)
        {
            send_mixture(&link, &input, is_fd);
        }
        else
        {
            send_scene(&link, &input, is_fd);
        }
    }
    return 0;
}
