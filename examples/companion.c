/* A companion computer for PX4: it reads ODOMETRY, and sends the thrust and the body rates of an exported policy.
       retrim export h --to c --out policy.h
       cc -std=c99 -O2 companion.c -o companion -lm
       ./companion 14540 0.49      (the UDP port to which PX4 sends, and the share of the full thrust at hover)
   The program does not arm: a pilot takes off, turns the nose to the east, holds the start of the task and selects
   offboard mode. The program exits if a state is late in offboard mode; PX4 then falls back by itself. Exit codes: 1
   wrong arguments or no port, 2 the self-test fails, 3 the watchdog. It needs a little-endian computer. */
#define _POSIX_C_SOURCE 200112L
#include <arpa/inet.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <time.h>
#include "policy.h"
#define STALE 0.1 /* [s]: age of a state, or lateness of a tick, at which the watchdog ends the flight */
enum { HEARTBEAT = 0, COMMAND = 76, ATTITUDE_TARGET = 82, ODOMETRY = 331, SET_INTERVAL = 511 };
enum { RATES_ONLY = 128, OFFBOARD = 6, PX4 = 12, ARMED = 128 };
typedef struct {
    int socket, is_offboard;
    struct sockaddr_in peer; /* the first autopilot that sends; all other senders are ignored */
    uint8_t system, component, sequence;
    float p[3], r[9], v[3]; /* world ENU, body forward-left-up */
    double received;        /* time of the newest state [s] */
} Link;

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static uint16_t checksum(const uint8_t *bytes, int n, uint8_t extra)
{
    unsigned sum = 0xffffu;
    for (int i = 0; i <= n; ++i) {
        sum ^= i < n ? bytes[i] : extra;
        for (int bit = 0; bit < 8; ++bit) sum = sum & 1u ? sum >> 1 ^ 0x8408u : sum >> 1;
    }
    return (uint16_t)sum;
}

static void send_message(Link *link, uint8_t number, uint8_t extra, const uint8_t *payload, uint8_t n)
{
    uint8_t frame[64] = {0xfd, n, 0, 0, link->sequence++, link->system, 191, number};
    memcpy(frame + 10, payload, n);
    const uint16_t sum = checksum(frame + 1, n + 9, extra);
    memcpy(frame + 10 + n, &sum, 2);
    if (link->peer.sin_port) sendto(link->socket, frame, n + 12u, 0, (struct sockaddr *)&link->peer, sizeof link->peer);
}

static void request(Link *link, int message, float interval) /* [us]; by itself, PX4 sends ODOMETRY at 30 Hz */
{
    const float parameters[2] = {(float)message, interval};
    uint8_t payload[33] = {0};
    memcpy(payload, parameters, sizeof parameters);
    payload[28] = SET_INTERVAL & 255, payload[29] = SET_INTERVAL >> 8;
    payload[30] = link->system, payload[31] = link->component;
    send_message(link, COMMAND, 152, payload, sizeof payload);
}

/* North, east, down and forward, right, down become east, north, up and forward, left, up. */
static void take_odometry(Link *link, const uint8_t *payload)
{
    float x[10]; /* position, quaternion w x y z, velocity */
    memcpy(x, payload + 8, sizeof x);
    const float w = x[3], a = x[4], b = x[5], c = x[6], norm = w * w + a * a + b * b + c * c;
    const int is_ned = payload[228] == 1 && payload[229] == 1; /* LOCAL_NED, as PX4 sends it; for velocities, too */
    if (!is_ned || !policy_finite(x, 10) || norm < 0.5f || norm > 2.0f) return;
    const float m[9] = {w * w + a * a - b * b - c * c, 2 * (a * b - w * c), 2 * (a * c + w * b),
                        2 * (a * b + w * c), w * w - a * a + b * b - c * c, 2 * (b * c - w * a),
                        2 * (a * c - w * b), 2 * (b * c + w * a), w * w - a * a - b * b + c * c};
    for (int i = 0; i < 3; ++i) {
        const int row = i == 2 ? 2 : 1 - i;
        const float sign = i == 2 ? -1.0f : 1.0f;
        for (int j = 0; j < 3; ++j) link->r[3 * i + j] = (j ? -sign : sign) * m[3 * row + j] / norm;
        link->p[i] = sign * x[row];
        link->v[i] = sign * x[7 + row];
    }
    link->received = now();
}

static void take_datagram(Link *link, const uint8_t *data, int size, const struct sockaddr_in *from)
{
    for (int i = 0; i + 12 <= size; ++i) {
        const int n = data[i + 1], whole = 12 + n + (data[i + 2] & 1 ? 13 : 0);
        const int number = data[i + 7] | data[i + 8] << 8 | data[i + 9] << 16;
        uint8_t payload[256] = {0}; /* MAVLink 2 omits zeros at the end */
        uint16_t sum;
        if (data[i] != 0xfd || i + whole > size || (number != HEARTBEAT && number != ODOMETRY)) continue;
        memcpy(payload, data + i + 10, (size_t)n);
        memcpy(&sum, data + i + 10 + n, 2);
        if (sum != checksum(data + i + 1, n + 9, number == HEARTBEAT ? 50 : 91)) continue;
        if (!link->peer.sin_port && number == HEARTBEAT && payload[5] == PX4)
            link->peer = *from, link->system = data[i + 5], link->component = data[i + 6];
        if (from->sin_port != link->peer.sin_port || from->sin_addr.s_addr != link->peer.sin_addr.s_addr
            || data[i + 5] != link->system || data[i + 6] != link->component) continue;
        if (number == ODOMETRY) take_odometry(link, payload);
        if (number == HEARTBEAT) link->is_offboard = payload[2] == OFFBOARD && payload[6] & ARMED;
        i += whole - 1;
    }
}

static void receive(Link *link, double until)
{
    for (double rest = until - now(); rest > 0.0; rest = until - now()) {
        struct pollfd ready = {link->socket, POLLIN, 0};
        struct sockaddr_in from;
        socklen_t length = sizeof from;
        uint8_t data[2048];
        if (poll(&ready, 1, 1 + (int)(1e3 * rest)) < 1) continue;
        const ssize_t n = recvfrom(link->socket, data, sizeof data, 0, (struct sockaddr *)&from, &length);
        if (n > 0) take_datagram(link, data, (int)n, &from);
    }
}

int main(int count, char **words)
{
    Link link = {socket(AF_INET, SOCK_DGRAM, 0), 0, {0}, 0, 0, 0, {0}, {0}, {0}, 0.0};
    const float hover = count == 3 ? strtof(words[2], NULL) : 0.0f;
    struct sockaddr_in here = {.sin_family = AF_INET, .sin_port = htons((uint16_t)(count == 3 ? atoi(words[1]) : 0))};
    here.sin_addr.s_addr = htonl(INADDR_LOOPBACK); /* INADDR_ANY for an autopilot on another machine */
    const int failed = retrim_selftest();
    if (failed) return fprintf(stderr, "self-test: case %d fails, see policy.h\n", failed), 2;
    if (!(hover > 0.05f && hover < 0.9f)) return fprintf(stderr, "usage: companion PORT HOVER, e.g. 14540 0.49\n"), 1;
    if (bind(link.socket, (struct sockaddr *)&here, sizeof here)) return perror(words[1]), 1;
    policy_memory memory;
    double due = now();
    setvbuf(stdout, NULL, _IOLBF, BUFSIZ);
    for (int tick = 0, was_offboard = 0;; ++tick, was_offboard = link.is_offboard) {
        receive(&link, due += POLICY_DT);
        const double late = now() - due, age = now() - link.received;
        if (was_offboard && (late > STALE || age > STALE))
            return fprintf(stderr, "watchdog: state %.0f ms old, tick %.0f ms late\n", 1e3 * age, 1e3 * late), 3;
        if (late > STALE) due = now();
        if (!was_offboard) policy_reset(&memory); /* the flight begins with the history of a hover */
        if (tick % 25 == 0) send_message(&link, HEARTBEAT, 50, (const uint8_t[]){0, 0, 0, 0, 18, 8, 0, 4, 3}, 9);
        if (tick % 50 == 0) request(&link, ODOMETRY, 1e4f);
        float u[4];
        if (age > STALE || !policy_step(&memory, link.p, link.r, link.v, u)) continue; /* PX4 refuses offboard mode */
        const float target[4] = {u[1], -u[2], -u[3], fminf(u[0] / 9.81f * hover, 1.0f)};
        uint8_t payload[39] = {0};
        memcpy(payload + 20, target, sizeof target);
        payload[36] = link.system, payload[37] = link.component, payload[38] = RATES_ONLY;
        send_message(&link, ATTITUDE_TARGET, 49, payload, sizeof payload);
        if (tick % 50 == 0) printf("%s: %.2f %.2f %.2f m, %.2f m/s2, %.2f %.2f %.2f rad/s\n", was_offboard ? "policy"
               : "pilot", link.p[0], link.p[1], link.p[2], u[0], u[1], u[2], u[3]);
    }
}
