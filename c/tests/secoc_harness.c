/* Authenticated frames: what a receiver makes of them, and those of a sender.
 *
 * Input, case by case: a kind (u8), then
 *     0  data (u16 length, bytes); output: its AES-CMAC with the key of RFC 4493
 *     1  bytes of the authentic I-PDU, of the freshness value and of the MAC (3 u8), a clock (u8,
 *        i64 [us]), its window [us] (i64), last freshness value [us] (i64), a frame (u8 length,
 *        bytes); output: reason + 1 (u8), last freshness value (i64)
 *     2  the same three numbers, time [us] (i64), last freshness value [us] (i64), key ID (u8), a
 *        record (u8 length, bytes); output: done (u8), last freshness value (i64), frame (u8,
 *        bytes)
 *     3  a line by the encoder, with its mean only: time [us] (i64), slot (u8), y_off (f64), CAN FD
 *        (u8); output: refusal (u8), frame (u8 length, bytes)
 *     4  a mixture of so many equal components by the encoder, after this last freshness value
 *        (i64), or with 0 a scene of two lines: number (u8), time [us] (i64); output: refusal (u8),
 *        frames (u8), next counters of the route and of the pose error (2 u32)
 *     5  calls after which there is no MAC until the next 5 (u32)
 * Key IDs are 1 and 7; the key of 7 has each bit inverted.
 */
#include "aes_cmac.h"
#include "binary.h"
#include "harness_dbc.h"
#include "internal.h"

static const uint8_t rfc_key[16] = {
    0x2b, 0x7e, 0x15, 0x16, 0x28, 0xae, 0xd2, 0xa6, 0xab, 0xf7, 0x15, 0x88, 0x09, 0xcf, 0x4f, 0x3c,
};

static uint32_t calls_left = UINT32_MAX;

static bool mac_of_key(void *context, uint8_t key_id, const uint8_t *data, size_t length,
                       uint8_t mac[16])
{
    uint8_t key[16];
    (void)context;
    if (calls_left == 0)
    {
        return false; // the security module is busy
    }
    --calls_left;
    for (int i = 0; i < 16; ++i)
    {
        key[i] = key_id == 7 ? (uint8_t)~rfc_key[i] : rfc_key[i];
    }
    if (key_id != 1 && key_id != 7)
    {
        return false;
    }
    aes_cmac(key, data, length, mac);
    return true;
}

static int64_t now_of_clock(void *context)
{
    return *(const int64_t *)context;
}

static void read_layout(maplines_dbc_t *dbc)
{
    *dbc = harness_dbc;
    dbc->line.fd_authentic = read_u8();
    dbc->line.fd_freshness = read_u8();
    dbc->line.fd_mac = read_u8();
}

static void compute_mac(void)
{
    uint8_t data[256];
    uint8_t mac[16];
    const uint16_t length = read_u16();
    read_bytes(data, length);
    aes_cmac(rfc_key, data, length, mac);
    write_bytes(mac, sizeof mac);
}

static void verify_frame(void)
{
    maplines_dbc_t dbc;
    maplines_authenticator_t authenticator;
    maplines_frame_t frame;
    memset(&authenticator, 0, sizeof authenticator);
    memset(&frame, 0, sizeof frame);
    read_layout(&dbc);
    const bool has_clock = read_u8() != 0;
    int64_t now_us = read_i64();
    authenticator.mac = mac_of_key;
    authenticator.now_us = has_clock ? now_of_clock : NULL;
    authenticator.context = &now_us;
    authenticator.window_us = read_i64();
    int64_t last_us = read_i64();
    frame.length = read_u8();
    read_bytes(frame.data, frame.length);
    const maplines_reason_t reason =
        maplines_verify(&dbc, MAPLINES_EGO_LEFT, &authenticator, &frame, &last_us);
    write_u8((uint8_t)(reason + 1));
    write_i64(last_us);
}

static void secure_record(void)
{
    maplines_dbc_t dbc;
    maplines_signer_t signer = {mac_of_key, NULL, 0, 0};
    maplines_frame_t frame;
    uint8_t record[256];
    memset(&frame, 0, sizeof frame);
    read_layout(&dbc);
    const int64_t now_us = read_i64();
    signer.last_us = read_i64();
    signer.key_id = read_u8();
    const uint8_t length = read_u8();
    read_bytes(record, length);
    const bool done =
        maplines_secure(&dbc, MAPLINES_EGO_LEFT, record, length, now_us, &signer, &frame);
    write_u8(done);
    write_i64(signer.last_us);
    write_u8(frame.length);
    write_bytes(frame.data, frame.length);
}

static void encode_line(maplines_encoder_t *encoder)
{
    maplines_input_t line;
    maplines_frame_t frames[MAPLINES_MAX_PAGES];
    memset(&line, 0, sizeof line);
    memset(frames, 0, sizeof frames);
    const int64_t now_us = read_i64();
    line.slot = (maplines_owner_t)read_u8();
    line.mean[0] = read_f64();
    line.x_max = 80.0;
    const bool is_fd = read_u8() != 0;
    const maplines_sent_t sent = maplines_encode_line(encoder, &line, is_fd, now_us, frames);
    write_u8((uint8_t)sent.refusal);
    write_u8(frames[0].length);
    write_bytes(frames[0].data, frames[0].length);
}

static maplines_refusal_t send_mixture(maplines_encoder_t *encoder, size_t count, int64_t now_us,
                                       maplines_frame_t *frames, uint16_t *sent_frames)
{
    maplines_input_t line;
    maplines_component_t components[MAPLINES_MAX_COMPONENTS];
    memset(&line, 0, sizeof line);
    memset(components, 0, sizeof components);
    line.slot = MAPLINES_ROUTE;
    line.status = MAPLINES_UNKNOWN;
    line.x_max = 80.0;
    for (size_t i = 0; i < count; ++i)
    {
        components[i].weight = 1.0 / (double)count;
    }
    const maplines_sent_t sent =
        maplines_encode_mixture(encoder, &line, components, count, true, now_us, frames);
    *sent_frames = sent.count;
    return sent.refusal;
}

static maplines_refusal_t send_scene(maplines_encoder_t *encoder, int64_t now_us,
                                     maplines_frame_t *frames, uint16_t *sent_frames)
{
    static maplines_scene_input_t scene;
    static maplines_scene_workspace_t workspace;
    memset(&scene, 0, sizeof scene);
    scene.count = 2;
    scene.correlation_time = 1.0;
    for (unsigned i = 0; i < 3; ++i)
    {
        scene.pose_cov[i][i] = 1e-4;
    }
    for (unsigned i = 0; i < 8; ++i)
    {
        scene.cov[i][i] = i % 4 == 0 ? 1e-2 : 1e-12;
    }
    for (unsigned i = 0; i < 2; ++i)
    {
        scene.lines[i].slot = i == 0 ? MAPLINES_EGO_LEFT : MAPLINES_ROUTE;
        scene.lines[i].status = MAPLINES_FULL;
        scene.lines[i].x_max = 60.0;
        scene.lines[i].fit_range[1] = 60.0;
    }
    const maplines_sent_scene_t sent =
        maplines_encode_scene(encoder, &scene, true, now_us, &workspace, frames);
    *sent_frames = sent.count;
    return sent.refusal;
}

static void encode_many(maplines_encoder_t *encoder)
{
    static maplines_frame_t frames[MAPLINES_MAX_SCENE_FRAMES];
    uint16_t sent_frames = 0;
    encoder->signer->last_us = read_i64();
    const size_t count = read_u8();
    const int64_t now_us = read_i64();
    const maplines_refusal_t refusal =
        count > 0 ? send_mixture(encoder, count, now_us, frames, &sent_frames)
                  : send_scene(encoder, now_us, frames, &sent_frames);
    write_u8((uint8_t)refusal);
    write_u8((uint8_t)sent_frames);
    write_u32(encoder->counter[MAPLINES_ROUTE]);
    write_u32(encoder->counter[MAPLINES_POSE]);
}

int main(void)
{
    maplines_signer_t signer = {mac_of_key, NULL, 1, 0};
    maplines_encoder_t encoder;
    maplines_encoder_init(&encoder, &harness_dbc, &signer);
    while (!at_end())
    {
        switch (read_u8())
        {
        case 0:
            compute_mac();
            break;
        case 1:
            verify_frame();
            break;
        case 2:
            secure_record();
            break;
        case 3:
            encode_line(&encoder);
            break;
        case 4:
            encode_many(&encoder);
            break;
        default:
            calls_left = read_u32();
            break;
        }
    }
    return 0;
}
