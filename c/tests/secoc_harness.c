/* Authenticated frames: what a receiver makes of them, and those of a sender.
 *
 * Input, case by case: a kind (u8), then
 *     0  data (u16 length, bytes); output: its AES-CMAC with the key of RFC 4493
 *     1  bytes of the authentic I-PDU, of the freshness value and of the MAC (3 u8), a clock (u8,
 *        i64 [us]), its window [us] (i64), last freshness value [us] (i64), a frame (u8 length,
 *        bytes); output: reason + 1 (u8), last freshness value (i64)
 *     2  the same three numbers, time [us] (i64), last freshness value [us] (i64), key ID (u8), a
 *        record (u8 length, bytes); output: done (u8), last freshness value (i64), frame (u8,
 * bytes) 3  a line by the encoder, with its mean only: time [us] (i64), slot (u8), y_off (f64);
 * output: refusal (u8), frame (u8 length, bytes) Key IDs are 1 and 7; the key of 7 has each bit
 * inverted.
 */
#include "aes_cmac.h"
#include "binary.h"
#include "harness_dbc.h"
#include "internal.h"

static const uint8_t rfc_key[16] = {
    0x2b, 0x7e, 0x15, 0x16, 0x28, 0xae, 0xd2, 0xa6, 0xab, 0xf7, 0x15, 0x88, 0x09, 0xcf, 0x4f, 0x3c,
};

static bool mac_of_key(void *context, uint8_t key_id, const uint8_t *data, size_t length,
                       uint8_t mac[16])
{
    uint8_t key[16];
    (void)context;
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
    const maplines_sent_t sent = maplines_encode_line(encoder, &line, true, now_us, frames);
    write_u8((uint8_t)sent.refusal);
    write_u8(frames[0].length);
    write_bytes(frames[0].data, frames[0].length);
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
        default:
            encode_line(&encoder);
            break;
        }
    }
    return 0;
}
