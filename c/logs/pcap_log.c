/* Parser of the packets of pcap and pcapng: data frames of classic CAN and of CAN FD.
 *
 * Packets that are no data frames are counted by kind. It stops at the first record that is not
 * whole, or not of its usual form, such as the description of an interface: the reader in Python
 * takes that. The byte order of a file is that of the host that wrote it.
 */
#include "log_frames.h"

#include <string.h>

enum {
    LINUX_SLL = 113, // Linux cooked, of version 1
    CAN_SOCKETCAN = 227,
    LINUX_SLL2 = 276,
    SLL_CAN = 0x0C, // protocols of both Linux cooked ones
    SLL_CAN_FD = 0x0D,
    SECTION = 0x0A0D0D0A,
    INTERFACE = 1,
    OLD_PACKET = 2,
    SIMPLE_PACKET = 3,
    ENHANCED_PACKET = 6
};

/// What a packet is; the first ones are places in `skipped`.
typedef enum {
    REMOTE = 1,
    ERROR_FRAME = 2,
    OTHER = 4,
    FRAME,
    NO_PACKET, // a block that says something else, such as statistics
    UNUSUAL
} packet_kind_t;

#define PCAP_HEADER 16U
#define MIN_BLOCK 12U
#define BLOCK_SIZE 32U // of an enhanced packet without data [byte]
#define BLOCK_HEADER 28U
#define CAN_HEADER 8U
#define SLL_HEADER 16U
#define SLL2_HEADER 20U
#define CLASSIC_DATA 8U
#define FD_FLAG 0x04U
#define XL_FLAG 0x80U
#define EXTENDED (UINT32_C(1) << 31)
#define REMOTE_FLAG (UINT32_C(1) << 30)
#define ERROR_FLAG (UINT32_C(1) << 29)
#define ID_MASK UINT32_C(0x1FFFFFFF)
#define SECOND_NS INT64_C(1000000000)
#define MAX_TICKS_NS (UINT64_C(1) << 62)

/// A packet: its interface, its bytes that were captured, and its length on the bus.
typedef struct {
    const maplines_interface_t *interface;
    const uint8_t *data;
    uint32_t size;
    uint32_t original;
} packet_t;

static uint32_t big(const uint8_t *at)
{
    return (uint32_t)at[0] << 24 | (uint32_t)at[1] << 16 | (uint32_t)at[2] << 8 | (uint32_t)at[3];
}

static uint32_t u32(const uint8_t *at, bool is_big)
{
    return is_big ? big(at)
                  : (uint32_t)at[0] | (uint32_t)at[1] << 8 | (uint32_t)at[2] << 16 |
                        (uint32_t)at[3] << 24;
}

/// Read a frame of SocketCAN, whose CAN ID has this byte order.
static packet_kind_t read_socketcan(const packet_t *packet, bool is_big, maplines_logged_t *frame)
{
    const uint8_t *data = packet->data;
    if (packet->size < CAN_HEADER)
    {
        return UNUSUAL;
    }
    if ((data[4] & XL_FLAG) != 0U)
    {
        return OTHER;
    }
    const uint32_t can_id = u32(data, is_big);
    const uint32_t length = data[4];
    if ((can_id & (ERROR_FLAG | REMOTE_FLAG)) != 0U)
    {
        return (can_id & ERROR_FLAG) != 0U ? ERROR_FRAME : REMOTE;
    }
    // Older writers leave the flag of CAN FD 0; then the size tells the frame.
    const bool is_fd = (data[5] & FD_FLAG) != 0U || packet->original > CAN_HEADER + CLASSIC_DATA;
    if (length > (is_fd ? MAPLINES_LOG_DATA : CLASSIC_DATA) || length > packet->size - CAN_HEADER)
    {
        return UNUSUAL;
    }
    frame->can_id = can_id & ID_MASK;
    frame->is_extended = (can_id & EXTENDED) != 0U;
    frame->length = frame->there = length;
    frame->data = data + CAN_HEADER;
    return FRAME;
}

/// Read a packet of any link type; the channel of its frame is the last one of the log.
static packet_kind_t read_packet(maplines_log_t *log, const packet_t *packet, bool is_big,
                                 maplines_logged_t *frame)
{
    const maplines_interface_t *interface = packet->interface;
    const bool is_sll = interface->link_type == LINUX_SLL;
    const bool is_sll2 = interface->link_type == LINUX_SLL2;
    packet_t inner = *packet;
    if (!is_sll && !is_sll2 && interface->link_type != CAN_SOCKETCAN)
    {
        return OTHER;
    }
    if (is_sll || is_sll2)
    {
        const uint32_t header = is_sll ? SLL_HEADER : SLL2_HEADER;
        if (packet->size < header || packet->original < header)
        {
            return UNUSUAL;
        }
        const uint8_t *protocol = packet->data + (is_sll ? 14 : 0);
        if (protocol[0] != 0U || (protocol[1] != SLL_CAN && protocol[1] != SLL_CAN_FD))
        {
            return OTHER;
        }
        inner.data += header;
        inner.size -= header;
        inner.original -= header;
    }
    const packet_kind_t kind = read_socketcan(&inner, is_big || !(is_sll || is_sll2), frame);
    if (kind != FRAME)
    {
        return kind;
    }
    const uint32_t index = is_sll2 ? big(packet->data + 4) : 0U;
    const bool has_channel =
        is_sll2 ? index != UINT32_MAX && maplines_number_channel(log, index + 1U)
                : maplines_name_channel(log, interface->name, interface->name_length);
    log->number = is_sll2 && has_channel ? index + 1U : 0U;
    return has_channel ? FRAME : UNUSUAL;
}

/// Find the packet of a record of pcap, and its time; the size of the record, or 0.
static size_t find_pcap(const maplines_capture_t *capture, size_t size, const uint8_t *data,
                        packet_t *packet, int64_t *t_ns)
{
    const bool is_big = capture->is_big_endian != 0U;
    if (size < PCAP_HEADER || u32(data + 8, is_big) > size - PCAP_HEADER)
    {
        return 0;
    }
    *packet = (packet_t){
        .interface = capture->interfaces,
        .data = data + PCAP_HEADER,
        .size = u32(data + 8, is_big),
        .original = u32(data + 12, is_big),
    };
    *t_ns = (int64_t)u32(data, is_big) * SECOND_NS +
            (int64_t)u32(data + 4, is_big) * (int64_t)capture->interfaces->tick_ns;
    return PCAP_HEADER + packet->size;
}

/// The same for a block of pcapng; the packet has no interface if the block is none.
static size_t find_block(const maplines_capture_t *capture, size_t size, const uint8_t *data,
                         packet_t *packet, int64_t *t_ns)
{
    const bool is_big = capture->is_big_endian != 0U;
    if (size < MIN_BLOCK)
    {
        return 0;
    }
    const uint32_t kind = u32(data, is_big);
    const uint32_t length = u32(data + 4, is_big);
    if (kind == SECTION || kind == INTERFACE || kind == OLD_PACKET || kind == SIMPLE_PACKET ||
        length < MIN_BLOCK || length % 4U != 0U || length > size ||
        u32(data + length - 4, is_big) != length)
    {
        return 0;
    }
    if (kind != ENHANCED_PACKET)
    {
        return length;
    }
    if (length < BLOCK_SIZE || u32(data + 8, is_big) >= capture->count)
    {
        return 0;
    }
    const uint32_t number = u32(data + 8, is_big);
    *packet = (packet_t){
        .interface = &capture->interfaces[number],
        .data = data + BLOCK_HEADER,
        .size = u32(data + 20, is_big),
        .original = u32(data + 24, is_big),
    };
    const uint64_t ticks = (uint64_t)u32(data + 12, is_big) << 32 | u32(data + 16, is_big);
    const uint32_t tick_ns = packet->interface->tick_ns;
    if (packet->size > length - BLOCK_SIZE || tick_ns == 0U || ticks > MAX_TICKS_NS / tick_ns)
    {
        return 0;
    }
    *t_ns = packet->interface->offset_ns + (int64_t)(ticks * tick_ns);
    return length;
}

/// Read a record, or count it; its size, or 0 if it is for Python.
static size_t read_record(maplines_log_t *log, const maplines_capture_t *capture, size_t size,
                          const uint8_t *data)
{
    packet_t packet = {0};
    maplines_logged_t frame = {0};
    const bool is_ng = capture->is_ng != 0U;
    const size_t length = is_ng ? find_block(capture, size, data, &packet, &frame.t_ns)
                                : find_pcap(capture, size, data, &packet, &frame.t_ns);
    packet_kind_t kind = NO_PACKET;
    if (length == 0U)
    {
        kind = UNUSUAL;
    }
    else if (packet.interface != NULL)
    {
        kind = read_packet(log, &packet, capture->is_big_endian != 0U, &frame);
    }
    if (kind == UNUSUAL)
    {
        return 0;
    }
    if (kind == FRAME)
    {
        maplines_add_logged(log, &frame);
    }
    else if (kind != NO_PACKET)
    {
        log->skipped[kind]++;
    }
    return length;
}

size_t maplines_parse_pcap(maplines_log_t *log, size_t size, const uint8_t *data,
                           const maplines_capture_t *capture)
{
    size_t place = 0;
    size_t length = 1;
    log->frames = 0;
    memset(log->skipped, 0, sizeof log->skipped);
    while (length != 0U && log->frames < log->capacity)
    {
        length = read_record(log, capture, size - place, data + place);
        place += length;
    }
    return place;
}
