/* SocketCAN for the examples: frames of a bus to and from those of maplines.h.
 *
 * An ECU has its own driver in place of this file.
 */
#ifndef MAPLINES_EXAMPLES_SOCKETCAN_H
#define MAPLINES_EXAMPLES_SOCKETCAN_H

#include "maplines.h"

#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <poll.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

static volatile sig_atomic_t is_stopped;

static void stop(int number)
{
    (void)number;
    is_stopped = 1;
}

/// Set is_stopped at Ctrl-C, and when the process shall end.
static inline void stop_at_signals(void)
{
    struct sigaction action;
    memset(&action, 0, sizeof action);
    action.sa_handler = stop;
    (void)sigaction(SIGINT, &action, NULL);
    (void)sigaction(SIGTERM, &action, NULL);
}

/// Time of a clock: CLOCK_REALTIME is that of receive_frame, CLOCK_MONOTONIC is never set [ns].
static inline int64_t now_ns(clockid_t clock)
{
    struct timespec now;
    (void)clock_gettime(clock, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

/// Wait until a time of CLOCK_MONOTONIC [ns], or a signal.
static inline void wait_until(int64_t t_ns)
{
    const struct timespec end = {(time_t)(t_ns / 1000000000), (long)(t_ns % 1000000000)};
    (void)clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &end, NULL);
}

/// Socket of an interface for classic and FD frames, of which it receives those of a DBC; NULL for
/// none. -1 with errno if there is no such interface.
static inline int open_bus(const char *name, const maplines_dbc_t *dbc)
{
    struct can_filter filters[3 * MAPLINES_OWNERS];
    size_t count = 0;
    for (int i = 0; dbc != NULL && i < MAPLINES_OWNERS; ++i)
    {
        const maplines_messages_t *m = &dbc->messages[i];
        const uint32_t ids[] = {m->can_id, m->fd_can_id, m->secured_can_id};
        const bool has[] = {m->has_classic, m->has_fd, m->has_secured};
        const bool is_extended[] = {m->is_extended, m->fd_is_extended, m->secured_is_extended};
        for (int k = 0; k < 3; ++k)
        {
            if (m->is_present && has[k])
            {
                filters[count].can_id = ids[k] | (is_extended[k] ? CAN_EFF_FLAG : 0U);
                filters[count].can_mask = CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_EFF_MASK;
                ++count;
            }
        }
    }
    const int on = 1;
    struct sockaddr_can address;
    memset(&address, 0, sizeof address);
    address.can_family = AF_CAN;
    address.can_ifindex = (int)if_nametoindex(name);
    const int bus = address.can_ifindex == 0 ? -1 : socket(PF_CAN, SOCK_RAW, CAN_RAW);
    const socklen_t size = (socklen_t)(count * sizeof *filters);
    if (bus >= 0 && (setsockopt(bus, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on) != 0 ||
                     setsockopt(bus, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &on, sizeof on) != 0 ||
                     setsockopt(bus, SOL_CAN_RAW, CAN_RAW_FILTER, filters, size) != 0 ||
                     bind(bus, (const struct sockaddr *)&address, sizeof address) != 0))
    {
        (void)close(bus);
        return -1;
    }
    return bus;
}

/// Wait for a frame, for 100 ms at most. False if there is none.
///
/// Its time is that of the kernel when it came [ns since 1970]: a receiver that is held up, and
/// reads late, must not take the frames for late.
static inline bool receive_frame(int bus, maplines_frame_t *frame, int64_t *t_ns)
{
    struct pollfd waiting = {bus, POLLIN, 0};
    struct canfd_frame received;
    struct timespec time;
    union {
        char bytes[CMSG_SPACE(sizeof time)];
        struct cmsghdr aligned;
    } control;
    struct iovec place = {&received, sizeof received};
    struct msghdr message;
    memset(&message, 0, sizeof message);
    message.msg_iov = &place;
    message.msg_iovlen = 1;
    message.msg_control = control.bytes;
    message.msg_controllen = sizeof control.bytes;
    if (poll(&waiting, 1, 100) <= 0)
    {
        return false;
    }
    if (recvmsg(bus, &message, 0) <= 0)
    {
        (void)poll(NULL, 0, 100); // the interface is down: poll returns at once
        return false;
    }
    const struct cmsghdr *stamp = CMSG_FIRSTHDR(&message);
    if (stamp == NULL || stamp->cmsg_type != SO_TIMESTAMPNS)
    {
        return false;
    }
    memcpy(&time, CMSG_DATA(stamp), sizeof time);
    *t_ns = (int64_t)time.tv_sec * 1000000000 + time.tv_nsec;
    memset(frame, 0, sizeof *frame);
    frame->is_extended = (received.can_id & CAN_EFF_FLAG) != 0;
    frame->can_id = received.can_id & CAN_EFF_MASK;
    frame->length = received.len;
    memcpy(frame->data, received.data, received.len);
    return true;
}

/// Send a frame; wait while the queue of the interface is full. False with errno if that fails.
static inline bool send_frame(int bus, const maplines_frame_t *frame)
{
    struct pollfd waiting = {bus, POLLOUT, 0};
    struct canfd_frame sent;
    memset(&sent, 0, sizeof sent);
    sent.can_id = frame->can_id | (frame->is_extended ? CAN_EFF_FLAG : 0U);
    sent.len = frame->length;
    sent.flags = frame->is_fd ? CANFD_BRS : 0;
    memcpy(sent.data, frame->data, frame->length);
    const size_t size = frame->is_fd ? CANFD_MTU : CAN_MTU;
    while (write(bus, &sent, size) != (ssize_t)size)
    {
        if ((errno != ENOBUFS && errno != EAGAIN) || is_stopped)
        {
            return false;
        }
        (void)poll(&waiting, 1, 10);
    }
    return true;
}

#endif
