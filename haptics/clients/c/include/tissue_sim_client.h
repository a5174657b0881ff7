/* Client of `tissue-sim serve`, protocol versions 3 and 2. C99 or C++; Linux, macOS, Windows (link ws2_32).
 *
 * As a library: link the target `tissue_sim_client` of CMakeLists.txt.
 * As one header: in exactly one source file write
 *     #define TISSUE_SIM_CLIENT_IMPLEMENTATION
 *     #include "tissue_sim_client.h"
 * and in all others only the #include. examples/ contains two programs; docs/client_c.md is the guide, and
 * docs/wire_protocol.md defines the fields.
 *
 * SI units. Frame: origin at the centre of the undeformed top face, z out of the tissue; forces are those on the tool.
 *
 * Copyright: the tissue_sim authors; Apache License 2.0.
 */
#ifndef TISSUE_SIM_CLIENT_H
#define TISSUE_SIM_CLIENT_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#if defined(_WIN32) && defined(TISSUE_SIM_CLIENT_SHARED)
#ifdef TISSUE_SIM_CLIENT_BUILD
#define TISSUE_SIM_API __declspec(dllexport)
#else
#define TISSUE_SIM_API __declspec(dllimport)
#endif
#else
#define TISSUE_SIM_API
#endif

/* Version with which tissue_sim_open starts: 3 or 2. Define it where the implementation is compiled, or set `version` of
 * the client after tissue_sim_open. */
#ifndef TISSUE_SIM_VERSION
#define TISSUE_SIM_VERSION 3
#endif
#define TISSUE_SIM_REQUEST_SIZE 96
#define TISSUE_SIM_REPLY_SIZE 760         /* of version 3, the largest one */
#define TISSUE_SIM_REPLY_SIZE_VERSION_2 728
#define TISSUE_SIM_MESSAGE_SIZE 200

/* Status of an answer. Below 100 the answer has a force, from 100 on it has none. */
enum {
    TISSUE_SIM_CONVERGED = 0, /* in equilibrium */
    TISSUE_SIM_LATE = 1,      /* the time budget ended: force and stiffness extrapolated from the last equilibrium */
    TISSUE_SIM_STOPPED = 2,   /* no equilibrium found: the same extrapolation; move back, or reset */
    TISSUE_SIM_REFUSED = 3,   /* pose or time beyond the limits of the scene: the last force; nothing changed */
    TISSUE_SIM_FADING = 4,    /* no equilibrium for too long: force and stiffness decrease to zero */
    TISSUE_SIM_RETURNING = 5, /* in equilibrium: force and stiffness increase along a ramp */
    TISSUE_SIM_FAILED = 6,    /* the step failed and the tissue was rebuilt: no force */
    TISSUE_SIM_BUSY = 100,          /* another client owns the tissue */
    TISSUE_SIM_STATUS_VERSION = 101, /* the server does not speak the version of the request */
    TISSUE_SIM_RELEASED = 102       /* answer to a goodbye */
};

/* Return values of the functions. After any other result than TISSUE_SIM_OK the answer is unchanged: no new force. */
enum {
    TISSUE_SIM_OK = 0,
    TISSUE_SIM_NO_REPLY = -1,      /* within the time-out; the next call tries again */
    TISSUE_SIM_BAD_ADDRESS = -2,   /* not a numeric IPv4 address, no socket, or an invalid time-out */
    TISSUE_SIM_NO_SERVER = -3,     /* nothing listens on that port, or the packet could not be sent */
    TISSUE_SIM_OTHER_VERSION = -4, /* the server speaks another version of the protocol */
    TISSUE_SIM_BAD_POSE = -5,      /* not finite, or the quaternion is not a unit quaternion; nothing was sent */
    TISSUE_SIM_BAD_REPLY = -6,     /* a force is not finite or above `largest_force` */
    TISSUE_SIM_NOT_A_REPLY = -7    /* tissue_sim_decode_reply: the bytes are not a reply */
};

enum { TISSUE_SIM_RESET = 1 };                          /* flag: reset the tissue to its undeformed state before this step */
enum { TISSUE_SIM_STEP = 1, TISSUE_SIM_GOODBYE = 2 };   /* kind of a request */

typedef struct {
    double position[3];    /* x, y, z, m; depth is -z */
    double orientation[4]; /* unit quaternion w, x, y, z */
} tissue_sim_pose;

typedef struct {
    unsigned version;     /* 3 or 2 */
    unsigned kind;        /* TISSUE_SIM_STEP or TISSUE_SIM_GOODBYE */
    uint64_t sequence;    /* greater than that of every request before */
    double time;          /* on the client's clock, s */
    uint64_t session;     /* identifies the client */
    tissue_sim_pose pose;
    uint32_t flags;       /* TISSUE_SIM_RESET or 0 */
} tissue_sim_request;

typedef struct {
    unsigned status;        /* see above */
    uint64_t sequence;      /* of the request */
    double time;            /* of the request, s */
    double force[3];        /* on the tool, N */
    double torque[3];       /* on the tool about its tip, N m */
    double stiffness[6][6]; /* static: minus d(force, torque) / d(position, rotation vector), N/m, N, N m */
    double step_stiffness[6][6]; /* the same within this step, with the mass of the tissue where it counts */
    double age;             /* time since the last equilibrium, s */
    double compute_time;    /* of the step, s */
    double residual;        /* relative residual of the forces */
    double dt;              /* time step that was used, s */
    uint32_t iterations;    /* linear solves of the step */
    int inertial;           /* whether the mass of the tissue was included */
    int limited;            /* whether the force was cut to the server's largest one */
    int stale_stiffness;    /* whether the stiffness is too old for a coupling */
    uint64_t malformed, stale, skipped, turned_away; /* packets since the server started */
    /* The following fields belong to version 3. */
    int is_on_axis;         /* whether the tool is on the axis of an axisymmetric scene; 1 in version 2 */
    int has_force_error;    /* whether the error of the force is known; 0 in version 2 */
    double stiffness_age;   /* time since the stiffness was evaluated, s; 0 in version 2 */
    double force_error;     /* estimated error of the force, N; NaN if unknown, 0 in version 2 */
    double error_age;       /* time since this error was estimated, s; 0 in version 2 */
    double least_tool_mass; /* smallest tool mass of a stable explicit coupling, kg; 0 in version 2 */
    /* Head of the packet. */
    unsigned version;       /* of the reply */
    uint64_t session;       /* of the request */
    uint32_t flags;         /* all flags of the reply */
    /* Set by tissue_sim_step. */
    int is_first;           /* whether the server made no time step although time advanced: first step at this server,
                               also after its restart, or the tissue was reset or restored since the previous answer,
                               or an unanswered request was repeated with the same time */
} tissue_sim_answer;

typedef struct {
    intptr_t socket;
    uint64_t sequence;
    uint64_t session; /* identifies this client; random after tissue_sim_open. Set it for a server with --session */
    long polls;       /* number of polls for a reply, about 1 us each, before sleeping until it arrives; initially 0 */
    unsigned version; /* protocol version, 3 or 2; initially TISSUE_SIM_VERSION */
    double timeout;   /* longest wait for a reply, s, finite and above 0; otherwise a call returns BAD_ADDRESS */
    double largest_force; /* replies with a larger force are refused, N; initially 1000, above the limit of any server */
    double last_time; /* time of the last answered step, also of a late reply, s; initially the smallest double */
    int has_first;    /* whether a late or refused reply was the first of a server; the next answer states it */
    unsigned server_version; /* version of the last reply; 0: no reply yet */
    char message[TISSUE_SIM_MESSAGE_SIZE]; /* last error as one sentence */
} tissue_sim_client;

/* Create a client of a server; `host` is a numeric IPv4 address such as "127.0.0.1". Sends no packet.
 * `timeout_s`: longest wait of each later call for its reply, s, above 0. */
TISSUE_SIM_API int tissue_sim_open(tissue_sim_client *client, const char *host, uint16_t port, double timeout_s);

/* Wait until a server answers, for `longest_wait_s` at most: at the start, or after it was restarted. Asks every 20 ms.
 * Returns TISSUE_SIM_OK if the tissue is free, TISSUE_SIM_BUSY if another client owns it, or a negative value. A tissue
 * that this client owned is released: the next step starts with is_first. */
TISSUE_SIM_API int tissue_sim_connect(tissue_sim_client *client, double longest_wait_s);

/* Send a pose and wait for its force. `time` is the client's clock, s; it must not decrease.
 * After NO_REPLY or NO_SERVER call it again: it reaches the server as soon as that answers, also after a restart.
 * `answer` is written only if the result is TISSUE_SIM_OK. Send TISSUE_SIM_RESET again until the status is below 100
 * and neither TISSUE_SIM_REFUSED nor TISSUE_SIM_FAILED: the other answers do not confirm the reset. */
TISSUE_SIM_API int tissue_sim_step(tissue_sim_client *client, double time, const tissue_sim_pose *pose, uint32_t flags,
                                   tissue_sim_answer *answer);

/* Release the tissue for other clients, and close the socket. No effect on a client that is not open. */
TISSUE_SIM_API void tissue_sim_close(tissue_sim_client *client);

/* Return the meaning of a return value, or of the status of an answer. */
TISSUE_SIM_API const char *tissue_sim_text(int code);

/* Return the last error of a client as one sentence, which has both versions after TISSUE_SIM_OTHER_VERSION. */
TISSUE_SIM_API const char *tissue_sim_message(const tissue_sim_client *client);

/* Write the packet of a request. Its numbers are not checked. */
TISSUE_SIM_API void tissue_sim_encode_request(const tissue_sim_request *request,
                                              unsigned char packet[TISSUE_SIM_REQUEST_SIZE]);

/* Read a reply of version 2 or 3. Returns TISSUE_SIM_OK, TISSUE_SIM_NOT_A_REPLY (wrong first bytes or size), or
 * TISSUE_SIM_OTHER_VERSION (then only version, status, sequence and time are set). */
TISSUE_SIM_API int tissue_sim_decode_reply(const unsigned char *packet, size_t size, tissue_sim_answer *answer);

#ifdef __cplusplus
}
#endif
#endif /* TISSUE_SIM_CLIENT_H */

#ifdef TISSUE_SIM_CLIENT_IMPLEMENTATION
#undef TISSUE_SIM_CLIENT_IMPLEMENTATION

#include <float.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

#if DBL_MANT_DIG != 53 || DBL_MAX_EXP != 1024
#error "the protocol needs IEEE 754 doubles"
#endif

#ifdef _WIN32
#include <winsock2.h>
#include <ws2tcpip.h>
#define TISSUE_SIM_SOCKET_ SOCKET
#define TISSUE_SIM_IS_REFUSED_ (WSAGetLastError() == WSAECONNRESET)
#define TISSUE_SIM_IS_EMPTY_ (WSAGetLastError() == WSAEWOULDBLOCK)
#define TISSUE_SIM_LENGTH_(bytes) (bytes)
#define tissue_sim_close_socket_ closesocket
#else
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>
#define TISSUE_SIM_SOCKET_ int
#define TISSUE_SIM_IS_REFUSED_ (errno == ECONNREFUSED)
#define TISSUE_SIM_IS_EMPTY_ (errno == EAGAIN || errno == EWOULDBLOCK || errno == EINTR)
#define TISSUE_SIM_LENGTH_(bytes) ((size_t)(bytes))
#define tissue_sim_close_socket_ close
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* Encode byte by byte, independent of this machine's byte order and struct layout. */
static unsigned char *tissue_sim_put_(unsigned char *at, uint64_t value, int bytes)
{
    int k;
    for (k = 0; k < bytes; k++)
        at[k] = (unsigned char)(value >> (8 * k) & 0xff);
    return at + bytes;
}

static unsigned char *tissue_sim_put_doubles_(unsigned char *at, const double *values, int count)
{
    int k;
    for (k = 0; k < count; k++) {
        uint64_t bits;
        memcpy(&bits, &values[k], 8);
        at = tissue_sim_put_(at, bits, 8);
    }
    return at;
}

static uint64_t tissue_sim_get_(const unsigned char **at, int bytes)
{
    uint64_t value = 0;
    int k;
    for (k = 0; k < bytes; k++)
        value |= (uint64_t)(*at)[k] << (8 * k);
    *at += bytes;
    return value;
}

static void tissue_sim_get_doubles_(const unsigned char **at, double *values, int count)
{
    int k;
    for (k = 0; k < count; k++) {
        uint64_t bits = tissue_sim_get_(at, 8);
        memcpy(&values[k], &bits, 8);
    }
}

/* Independent of -ffast-math, which lets isfinite return true for NaN. */
static int tissue_sim_are_finite_(const double *values, int count)
{
    int k;
    for (k = 0; k < count; k++) {
        uint64_t bits;
        memcpy(&bits, &values[k], 8);
        if ((bits >> 52 & 0x7ff) == 0x7ff)
            return 0;
    }
    return 1;
}

/* Time on a clock of this machine, s; the monotonic one if the headers declare it. */
static double tissue_sim_now_(void)
{
#if defined(_WIN32)
    LARGE_INTEGER count, frequency;
    QueryPerformanceCounter(&count);
    QueryPerformanceFrequency(&frequency);
    return (double)count.QuadPart / (double)frequency.QuadPart;
#elif defined(CLOCK_MONOTONIC)
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    return (double)at.tv_sec + 1e-9 * (double)at.tv_nsec;
#else
    struct timeval at;
    gettimeofday(&at, NULL);
    return (double)at.tv_sec + 1e-6 * (double)at.tv_usec;
#endif
}

/* Sleep until a packet arrives, or for a time in s, at most one hour. A socket of -1 only sleeps. */
static void tissue_sim_sleep_(TISSUE_SIM_SOCKET_ own, int has_socket, double seconds)
{
    struct timeval longest;
    fd_set readable;
    if (!(seconds > 0.0))
        return;
    if (seconds > 3600.0) /* a greater number of seconds may exceed the fields of timeval */
        seconds = 3600.0;
#ifdef _WIN32
    if (!has_socket) { /* select without a socket is an error on Windows */
        Sleep((DWORD)(seconds * 1e3) + 1);
        return;
    }
    longest.tv_sec = (long)seconds;
    longest.tv_usec = (long)((seconds - (double)longest.tv_sec) * 1e6);
#else
    longest.tv_sec = (time_t)seconds;
    longest.tv_usec = (suseconds_t)((seconds - (double)longest.tv_sec) * 1e6);
#endif
    FD_ZERO(&readable);
    if (has_socket)
        FD_SET(own, &readable);
    (void)select(has_socket ? (int)own + 1 : 0, &readable, NULL, NULL, &longest);
}

/* Return the size of the next packet, or -1 if none arrives before a time on the clock. Sleeping uses no processor
 * time; waking up takes about 10 us. */
static int tissue_sim_receive_(TISSUE_SIM_SOCKET_ own, unsigned char *packet, int capacity, long polls, double end)
{
    for (;;) {
        double rest;
        int size = (int)recv(own, (char *)packet, TISSUE_SIM_LENGTH_(capacity), 0);
        if (size >= 0 || !TISSUE_SIM_IS_EMPTY_) /* the system reports an error once */
            return size;
        rest = end - tissue_sim_now_();
        if (rest <= 0.0) {
#ifdef _WIN32
            WSASetLastError(WSAEWOULDBLOCK);
#else
            errno = EAGAIN;
#endif
            return -1;
        }
        if (polls > 0)
            polls--;
        else
            tissue_sim_sleep_(own, 1, rest);
    }
}

void tissue_sim_encode_request(const tissue_sim_request *request, unsigned char packet[TISSUE_SIM_REQUEST_SIZE])
{
    unsigned char *end = packet;
    memcpy(end, "TSRQ", 4);
    end = tissue_sim_put_(end + 4, request->version, 2);
    end = tissue_sim_put_(end, request->kind, 2);
    end = tissue_sim_put_(end, request->sequence, 8);
    end = tissue_sim_put_doubles_(end, &request->time, 1);
    end = tissue_sim_put_(end, request->session, 8);
    end = tissue_sim_put_doubles_(end, request->pose.position, 3);
    end = tissue_sim_put_doubles_(end, request->pose.orientation, 4);
    end = tissue_sim_put_(end, request->flags, 4);
    tissue_sim_put_(end, 0, 4);
}

int tissue_sim_decode_reply(const unsigned char *packet, size_t size, tissue_sim_answer *answer)
{
    const unsigned char *at = packet + 4;
    uint64_t bits;

    memset(answer, 0, sizeof *answer);
    if (size < 24 || memcmp(packet, "TSRP", 4) != 0)
        return TISSUE_SIM_NOT_A_REPLY;
    answer->version = (unsigned)tissue_sim_get_(&at, 2);
    answer->status = (unsigned)tissue_sim_get_(&at, 2);
    answer->sequence = tissue_sim_get_(&at, 8);
    tissue_sim_get_doubles_(&at, &answer->time, 1);
    if (answer->version != 2 && answer->version != 3)
        return TISSUE_SIM_OTHER_VERSION;
    if (size != (answer->version == 2 ? TISSUE_SIM_REPLY_SIZE_VERSION_2 : TISSUE_SIM_REPLY_SIZE))
        return TISSUE_SIM_NOT_A_REPLY;
    answer->session = tissue_sim_get_(&at, 8);
    tissue_sim_get_doubles_(&at, answer->force, 3);
    tissue_sim_get_doubles_(&at, answer->torque, 3);
    tissue_sim_get_doubles_(&at, &answer->stiffness[0][0], 36);
    tissue_sim_get_doubles_(&at, &answer->step_stiffness[0][0], 36);
    tissue_sim_get_doubles_(&at, &answer->age, 1);
    tissue_sim_get_doubles_(&at, &answer->compute_time, 1);
    tissue_sim_get_doubles_(&at, &answer->residual, 1);
    tissue_sim_get_doubles_(&at, &answer->dt, 1);
    answer->iterations = (uint32_t)tissue_sim_get_(&at, 4);
    answer->flags = (uint32_t)tissue_sim_get_(&at, 4);
    answer->inertial = (int)(answer->flags & 1);
    answer->limited = (int)(answer->flags >> 1 & 1);
    answer->stale_stiffness = (int)(answer->flags >> 2 & 1);
    answer->malformed = tissue_sim_get_(&at, 8);
    answer->stale = tissue_sim_get_(&at, 8);
    answer->skipped = tissue_sim_get_(&at, 8);
    answer->turned_away = tissue_sim_get_(&at, 8);
    answer->is_on_axis = 1;
    if (answer->version >= 3) {
        answer->is_on_axis = !(answer->flags >> 3 & 1);
        tissue_sim_get_doubles_(&at, &answer->stiffness_age, 1);
        tissue_sim_get_doubles_(&at, &answer->force_error, 1);
        tissue_sim_get_doubles_(&at, &answer->error_age, 1);
        tissue_sim_get_doubles_(&at, &answer->least_tool_mass, 1);
        memcpy(&bits, &answer->force_error, 8);
        answer->has_force_error = (bits & 0x7fffffffffffffffu) <= 0x7ff0000000000000u; /* not NaN */
    }
    return TISSUE_SIM_OK;
}

/* Store the sentence of an error, and return its code. */
static int tissue_sim_fail_(tissue_sim_client *client, int code)
{
    snprintf(client->message, sizeof client->message, "%s", tissue_sim_text(code));
    return code;
}

/* Return whether the server made no time step although time advanced, and store the time of the reply. */
static int tissue_sim_is_first_(tissue_sim_client *client, const tissue_sim_answer *answer)
{
    int is_first;
    if (answer->status >= 100 || answer->status == TISSUE_SIM_REFUSED)
        return 0;
    is_first = !(answer->dt > 0.0) && answer->time > client->last_time;
    client->last_time = answer->time;
    return is_first;
}

/* Send one request and wait for its own reply; of late replies to earlier requests only is_first is used. Every reply
 * is decoded into `answer`, which is valid only if the result is TISSUE_SIM_OK. */
static int tissue_sim_ask_(tissue_sim_client *client, unsigned kind, double time, const tissue_sim_pose *pose,
                           uint32_t flags, double timeout, tissue_sim_answer *answer)
{
    TISSUE_SIM_SOCKET_ own = (TISSUE_SIM_SOCKET_)client->socket;
    unsigned char packet[TISSUE_SIM_REPLY_SIZE + 1];
    tissue_sim_request request;
    double end;

    if (!tissue_sim_are_finite_(&timeout, 1) || !(timeout > 0.0))
        return tissue_sim_fail_(client, TISSUE_SIM_BAD_ADDRESS);
    end = tissue_sim_now_() + timeout;
    request.version = client->version;
    request.kind = kind;
    request.sequence = client->sequence++;
    request.time = time;
    request.session = client->session;
    request.pose = *pose;
    request.flags = flags;
    tissue_sim_encode_request(&request, packet);
    /* The first attempt may report that nothing listened at the time of an earlier packet. */
    if (send(own, (const char *)packet, TISSUE_SIM_REQUEST_SIZE, 0) != TISSUE_SIM_REQUEST_SIZE &&
        send(own, (const char *)packet, TISSUE_SIM_REQUEST_SIZE, 0) != TISSUE_SIM_REQUEST_SIZE)
        return tissue_sim_fail_(client, TISSUE_SIM_NO_SERVER);
    for (;;) {
        int code, size = tissue_sim_receive_(own, packet, (int)sizeof packet, client->polls, end);
        if (size < 0) /* this machine reports a closed port, another machine sends no reply */
            return tissue_sim_fail_(client, TISSUE_SIM_IS_REFUSED_ ? TISSUE_SIM_NO_SERVER : TISSUE_SIM_NO_REPLY);
        code = tissue_sim_decode_reply(packet, (size_t)size, answer);
        if (code != TISSUE_SIM_NOT_A_REPLY && answer->version != client->version) {
            client->server_version = answer->version;
            snprintf(client->message, sizeof client->message,
                     "the server uses protocol version %u, this client version %u; install the same tissue_sim on "
                     "both sides", answer->version, client->version);
            return TISSUE_SIM_OTHER_VERSION;
        }
        if (code == TISSUE_SIM_OK && answer->session == client->session) {
            client->server_version = answer->version;
            if (answer->sequence == request.sequence)
                return TISSUE_SIM_OK;
            if (answer->sequence < request.sequence && answer->time > client->last_time &&
                tissue_sim_is_first_(client, answer))
                client->has_first = 1;
        }
        if (tissue_sim_now_() > end)
            return tissue_sim_fail_(client, TISSUE_SIM_NO_REPLY);
    }
}

/* A random number from the system if it has a source; otherwise a number that is unlikely to be in use by another client. */
static uint64_t tissue_sim_session_(const void *own)
{
    uint64_t session = (uint64_t)time(NULL) * 0x9e3779b97f4a7c15u ^ (uint64_t)clock() ^ (uint64_t)(uintptr_t)own;
    FILE *random = fopen("/dev/urandom", "rb");
    if (random != NULL) {
        unsigned char bytes[8];
        const unsigned char *at = bytes;
        if (fread(bytes, 1, sizeof bytes, random) == sizeof bytes)
            session ^= tissue_sim_get_(&at, 8);
        fclose(random);
    }
    return session | 1;
}

int tissue_sim_open(tissue_sim_client *client, const char *host, uint16_t port, double timeout_s)
{
    struct sockaddr_in server;
    TISSUE_SIM_SOCKET_ own;
    int is_open;
#ifdef _WIN32
    u_long nonblocking = 1;
    WSADATA started;
#endif
    memset(client, 0, sizeof *client);
    client->socket = -1;
    (void)tissue_sim_fail_(client, TISSUE_SIM_BAD_ADDRESS);
#ifdef _WIN32
    if (WSAStartup(MAKEWORD(2, 2), &started) != 0)
        return TISSUE_SIM_BAD_ADDRESS;
#endif
    memset(&server, 0, sizeof server);
    server.sin_family = AF_INET;
    server.sin_port = htons(port);
    own = socket(AF_INET, SOCK_DGRAM, 0);
#ifdef _WIN32
    is_open = own != INVALID_SOCKET && ioctlsocket(own, (long)FIONBIO, &nonblocking) == 0;
#else
    is_open = own >= 0 && own < FD_SETSIZE && fcntl(own, F_SETFL, O_NONBLOCK) == 0;
#endif
    if (!is_open || !tissue_sim_are_finite_(&timeout_s, 1) || !(timeout_s > 0.0) ||
        inet_pton(AF_INET, host, &server.sin_addr) != 1 ||
        connect(own, (const struct sockaddr *)&server, sizeof server) != 0) {
        tissue_sim_close_socket_(own);
#ifdef _WIN32
        WSACleanup();
#endif
        return TISSUE_SIM_BAD_ADDRESS;
    }
    client->socket = (intptr_t)own;
    client->session = tissue_sim_session_(client);
    client->version = TISSUE_SIM_VERSION;
    client->timeout = timeout_s;
    client->largest_force = 1000.0;
    client->last_time = -DBL_MAX;
    client->message[0] = '\0';
    return TISSUE_SIM_OK;
}

int tissue_sim_connect(tissue_sim_client *client, double longest_wait_s)
{
    static const tissue_sim_pose origin = {{0.0, 0.0, 0.0}, {1.0, 0.0, 0.0, 0.0}};
    const double end = tissue_sim_now_() + longest_wait_s;
    tissue_sim_answer answer;
    int code;

    for (;;) {
        code = tissue_sim_ask_(client, TISSUE_SIM_GOODBYE, 0.0, &origin, 0, client->timeout < 0.05 ? 0.05 : client->timeout,
                               &answer);
        if (code == TISSUE_SIM_OK) {
            client->last_time = -DBL_MAX;
            client->has_first = 0;
            return answer.status == TISSUE_SIM_BUSY ? tissue_sim_fail_(client, TISSUE_SIM_BUSY) : TISSUE_SIM_OK;
        }
        if ((code != TISSUE_SIM_NO_SERVER && code != TISSUE_SIM_NO_REPLY) || tissue_sim_now_() >= end)
            return code;
        tissue_sim_sleep_((TISSUE_SIM_SOCKET_)client->socket, 0, 0.02);
    }
}

int tissue_sim_step(tissue_sim_client *client, double time, const tissue_sim_pose *pose, uint32_t flags,
                    tissue_sim_answer *answer)
{
    const double *q = pose->orientation;
    const double square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    tissue_sim_answer received;
    int code;

    /* A length of 1 within 1e-3, as at the server. */
    if (!tissue_sim_are_finite_(&time, 1) || !tissue_sim_are_finite_(pose->position, 3) ||
        !tissue_sim_are_finite_(q, 4) || square < 0.999 * 0.999 || square > 1.001 * 1.001)
        return tissue_sim_fail_(client, TISSUE_SIM_BAD_POSE);
    code = tissue_sim_ask_(client, TISSUE_SIM_STEP, time, pose, flags, client->timeout, &received);
    if (code != TISSUE_SIM_OK)
        return code;
    if (received.status >= 100) {
        (void)tissue_sim_fail_(client, (int)received.status);
        *answer = received;
        return TISSUE_SIM_OK;
    }
    /* Stored before the force is checked: after BAD_REPLY the next answer states it. */
    if (tissue_sim_is_first_(client, &received))
        client->has_first = 1;
    if (!tissue_sim_are_finite_(received.force, 3) || !tissue_sim_are_finite_(received.torque, 3) ||
        !(received.force[0] * received.force[0] + received.force[1] * received.force[1] +
                  received.force[2] * received.force[2] <= client->largest_force * client->largest_force))
        return tissue_sim_fail_(client, TISSUE_SIM_BAD_REPLY);
    received.is_first = client->has_first;
    client->has_first = 0;
    *answer = received;
    return TISSUE_SIM_OK;
}

void tissue_sim_close(tissue_sim_client *client)
{
    static const tissue_sim_pose origin = {{0.0, 0.0, 0.0}, {1.0, 0.0, 0.0, 0.0}};
    tissue_sim_answer answer;

    if (client->socket == -1)
        return;
    (void)tissue_sim_ask_(client, TISSUE_SIM_GOODBYE, 0.0, &origin, 0, client->timeout, &answer);
    tissue_sim_close_socket_((TISSUE_SIM_SOCKET_)client->socket);
    client->socket = -1;
#ifdef _WIN32
    WSACleanup();
#endif
}

const char *tissue_sim_message(const tissue_sim_client *client)
{
    return client->message;
}

const char *tissue_sim_text(int code)
{
    switch (code) {
    case TISSUE_SIM_CONVERGED: return "in equilibrium at this pose";
    case TISSUE_SIM_LATE: return "the time budget ended: force and stiffness of the last equilibrium, extrapolated";
    case TISSUE_SIM_STOPPED: return "no equilibrium found: force and stiffness of the last one, extrapolated";
    case TISSUE_SIM_REFUSED: return "the pose or the time is beyond the limits of the scene: the last force";
    case TISSUE_SIM_FADING: return "no equilibrium for too long: force and stiffness decrease to zero";
    case TISSUE_SIM_RETURNING: return "in equilibrium: force and stiffness increase along a ramp";
    case TISSUE_SIM_FAILED: return "the step failed, and the tissue was rebuilt: no force";
    case TISSUE_SIM_BUSY: return "another client owns the tissue; try again after its goodbye or its silence";
    case TISSUE_SIM_STATUS_VERSION: return "the server uses the protocol version of this reply";
    case TISSUE_SIM_RELEASED: return "the client has said goodbye; the tissue is free for another client";
    case TISSUE_SIM_NO_REPLY: return "no reply within the time-out";
    case TISSUE_SIM_BAD_ADDRESS: return "the address must be a numeric IPv4 address and the time-out positive";
    case TISSUE_SIM_NO_SERVER: return "nothing listens on that port; start tissue-sim serve";
    case TISSUE_SIM_OTHER_VERSION: return "the server speaks another version of the protocol";
    case TISSUE_SIM_BAD_POSE: return "time and pose must be finite, and the orientation a unit quaternion";
    case TISSUE_SIM_BAD_REPLY: return "the force of the reply is not finite, or above the largest force of the client";
    case TISSUE_SIM_NOT_A_REPLY: return "the packet is not a reply";
    default: return "unknown status of a newer server";
    }
}

#ifdef __cplusplus
}
#endif
#endif /* TISSUE_SIM_CLIENT_IMPLEMENTATION */
