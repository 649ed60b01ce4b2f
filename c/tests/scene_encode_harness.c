/* Scenes to frames.
 *
 * Input, case by case: whether the frames are CAN FD, and authenticated, and whether the sender is
 * that of the last case (u8); if not, the counter of each owner (11 u32); a scene, see
 * scene_input.h. Output: number of frames (u16), 0 if the scene is refused; of each CAN ID (u32),
 * whether it is extended and CAN FD (u8), its length (u8) and its bytes; then, if it is not
 * refused, of each line 0, or why it is not sent (u8).
 */
#include "aes_cmac.h"
#include "binary.h"
#include "harness_dbc.h"
#include "maplines.h"
#include "scene_input.h"

static maplines_scene_input_t scene;
static maplines_scene_workspace_t workspace;
static maplines_frame_t frames[MAPLINES_MAX_SCENE_FRAMES];

static bool mac_of(void *context, uint8_t key_id, const uint8_t *data, size_t length,
                   uint8_t mac[16])
{
    const uint8_t key[16] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    (void)context;
    (void)key_id;
    aes_cmac(key, data, length, mac);
    return true;
}

static void write_frame(const maplines_frame_t *frame)
{
    write_u32(frame->can_id);
    write_u8(frame->is_extended ? 1 : 0);
    write_u8(frame->is_fd ? 1 : 0);
    write_u8(frame->length);
    write_bytes(frame->data, frame->length);
}

int main(void)
{
    maplines_encoder_t encoder;
    maplines_signer_t signer;
    while (!at_end())
    {
        const uint8_t flags = read_u8();
        if ((flags & 4U) == 0U)
        {
            signer = (maplines_signer_t){mac_of, NULL, 1, 0};
            maplines_encoder_init(&encoder, &harness_dbc, (flags & 2U) != 0U ? &signer : NULL);
            for (size_t owner = 0; owner < MAPLINES_OWNERS; ++owner)
            {
                encoder.counter[owner] = read_u32();
            }
        }
        read_scene(&scene);
        const maplines_sent_scene_t sent = maplines_encode_scene(
            &encoder, &scene, (flags & 1U) != 0U, INT64_C(1000000000000000), &workspace, frames);
        write_u16(sent.count);
        for (size_t i = 0; i < sent.count; ++i)
        {
            write_frame(&frames[i]);
        }
        for (size_t i = 0; sent.count > 0U && i < scene.count; ++i)
        {
            write_u8(sent.is_sent[i] ? 0 : (uint8_t)sent.left_out[i]);
        }
    }
    return 0;
}
