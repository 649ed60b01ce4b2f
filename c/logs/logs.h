/* Readers of the ordinary records of logs, for the Python package: frames as arrays.
 *
 * Each reads records up to one that is not of its ordinary form, which is for the reader in Python
 * that knows all forms and what is an error. It returns the place of that record: the number of
 * bytes that were read.
 */
#ifndef MAPLINES_LOGS_H
#define MAPLINES_LOGS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define MAPLINES_LOG_DATA 64      // bytes of data of a frame
#define MAPLINES_LOG_CHANNELS 256 // of a log
#define MAPLINES_LOG_NAME 64      // characters of the name of a channel

/// Reader of a log: the frames of one call, and what it knows from one call to the next.
typedef struct {
    size_t capacity;      ///< of the arrays [frame]
    uint32_t *can_id;     ///< of each frame
    uint8_t *is_extended; ///< 0 or 1
    int64_t *t_ns;
    uint16_t *channel; ///< index in `names`
    uint8_t *length;   ///< bytes of data
    uint8_t *data;     ///< `MAPLINES_LOG_DATA` bytes of each frame, zero from its length on
    size_t frames;     ///< of the last call
    size_t rows;       ///< of text, of the last call
    size_t skipped[5]; ///< of BLF and pcap, what is no frame, of the last call, by kind
    int32_t times;     ///< kind of the stamps: 0 absolute, 1 from the start, 2 differences
    int64_t sum;       ///< of the stamps [ns]
    int64_t high;      ///< highest stamp of the recording [ns]
    size_t channels;   ///< number of `names`
    size_t last;       ///< channel of the last frame
    uint32_t number;   ///< of that channel, from 1; 0 if it was found by its name
    char names[MAPLINES_LOG_CHANNELS][MAPLINES_LOG_NAME + 1];
} maplines_log_t;

/// Interface of a capture.
typedef struct {
    uint32_t link_type; ///< of pcap
    uint32_t tick_ns;   ///< unit of the time stamps [ns]; 0 if it is another one
    int64_t offset_ns;  ///< added to them [ns], at most 2^62
    size_t name_length;
    char name[MAPLINES_LOG_NAME + 1];
} maplines_interface_t;

/// A file of pcap, or a section of pcapng.
typedef struct {
    uint8_t is_big_endian; ///< 0 or 1
    uint8_t is_ng;         ///< 0 or 1
    size_t count;          ///< of the interfaces
    maplines_interface_t interfaces[MAPLINES_LOG_CHANNELS];
} maplines_capture_t;

/// Read rows of candump -L.
size_t maplines_parse_candump(maplines_log_t *log, size_t size, const char *text);
/// Read rows of ASC, whose numbers have the radix 10 or 16.
size_t maplines_parse_asc(maplines_log_t *log, size_t size, const char *text, int radix);
/// Read the objects in a container of BLF; the log starts at `start_ns`, of at most 2^62.
size_t maplines_parse_blf(maplines_log_t *log, size_t size, const uint8_t *data, int64_t start_ns);
/// Read the records of pcap, or the blocks of pcapng.
size_t maplines_parse_pcap(maplines_log_t *log, size_t size, const uint8_t *data,
                           const maplines_capture_t *capture);

#endif
