/* Client of `tissue-sim serve`, protocol version 3, in one header. C99 or C++; Linux, macOS, Windows (link ws2_32).
 *
 * In exactly one source file write
 *     #define TISSUE_SIM_CLIENT_IMPLEMENTATION
 *     #include "tissue_sim_client.h"
 * and in all others only the #include. For a server of version 2 write before both: #define TISSUE_SIM_VERSION 2
 * (the fields of version 3 then have their defaults). drive_needle.c is an example; docs/wire_protocol.md defines the fields.
 *
 * SI units. Frame: origin at the centre of the undeformed top face, z out of the tissue; forces are those on the tool.
 *
 * Copyright: the tissue_sim authors; Apache License 2.0.
 */
#ifndef TISSUE_SIM_CLIENT_H
#define TISSUE_SIM_CLIENT_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#ifndef TISSUE_SIM_VERSION
#define TISSUE_SIM_VERSION 3
#endif
#define TISSUE_SIM_REQUEST_SIZE 96
#if TISSUE_SIM_VERSION == 2
#define TISSUE_SIM_REPLY_SIZE 728
#else
#define TISSUE_SIM_REPLY_SIZE 760
#endif

/* Status of an answer. Below 100 the answer has a force, from 100 on it has none. */
enum {
    TISSUE_SIM_CONVERGED = 0, /* in equilibrium */
    TISSUE_SIM_LATE = 1,      /* the time budget ended: force and stiffness extrapolated from the last equilibrium */
    TISSUE_SIM_STOPPED = 2,   /* no equilibrium found: the same extrapolation; move back, or reset */
    TISSUE_SIM_REFUSED = 3,   /* pose or time invalid or beyond the limits of the scene: the last force; nothing changed */
    TISSUE_SIM_FADING = 4,    /* no equilibrium for too long: force and stiffness decrease to zero */
    TISSUE_SIM_RETURNING = 5, /* in equilibrium: force and stiffness increase along a ramp */
    TISSUE_SIM_FAILED = 6,    /* the step failed and the tissue was rebuilt: no force */
    TISSUE_SIM_BUSY = 100     /* another client owns the tissue */
};

/* Return values of the functions. */
enum {
    TISSUE_SIM_OK = 0,
    TISSUE_SIM_NO_REPLY = -1,      /* within the timeout */
    TISSUE_SIM_BAD_ADDRESS = -2,   /* not a numeric IPv4 address, or no socket */
    TISSUE_SIM_NO_SERVER = -3,     /* nothing listens on that port, or the packet could not be sent */
    TISSUE_SIM_OTHER_VERSION = -4  /* the server speaks another version of the protocol */
};

enum { TISSUE_SIM_RESET = 1 }; /* flag: reset the tissue to its undeformed state before this step */

typedef struct {
    double position[3];    /* x, y, z, m; depth is -z */
    double orientation[4]; /* unit quaternion w, x, y, z */
} tissue_sim_pose;

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
} tissue_sim_answer;

typedef struct {
    intptr_t socket;
    uint64_t sequence;
    uint64_t session; /* random number that identifies this client, set by tissue_sim_open */
    long polls; /* number of polls for a reply, about 1 us each, before sleeping until it arrives; initially 0 */
} tissue_sim_client;

/* Connect to a server; `host` is a numeric IPv4 address such as "127.0.0.1". Sends no packet. */
int tissue_sim_open(tissue_sim_client *client, const char *host, uint16_t port, double timeout_s);

/* Send a pose and wait for its force. `time` is the client's clock, s; it must not decrease. */
int tissue_sim_step(tissue_sim_client *client, double time, const tissue_sim_pose *pose, uint32_t flags,
                    tissue_sim_answer *answer);

/* Release the tissue for other clients, and close the socket. */
void tissue_sim_close(tissue_sim_client *client);

/* Return the meaning of a return value, or of the status of an answer. */
const char *tissue_sim_text(int code);

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
#define TISSUE_SIM_NOBODY_ (WSAGetLastError() == WSAECONNRESET)
#define TISSUE_SIM_LENGTH_(bytes) (bytes)
#define tissue_sim_close_socket_ closesocket
#else
#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>
#define TISSUE_SIM_SOCKET_ int
#define TISSUE_SIM_NOBODY_ (errno == ECONNREFUSED)
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

/* The next packet, or -1: sleeping takes no processor, and waking up some 10 us. */
static int tissue_sim_receive_(TISSUE_SIM_SOCKET_ own, unsigned char *packet, int room, long polls)
{
#ifdef MSG_DONTWAIT
    for (; polls > 0; polls--) {
        int size = (int)recv(own, (char *)packet, TISSUE_SIM_LENGTH_(room), MSG_DONTWAIT);
        if (size >= 0 || TISSUE_SIM_NOBODY_) /* an error is told once */
            return size;
    }
#else
    (void)polls;
#endif
    return (int)recv(own, (char *)packet, TISSUE_SIM_LENGTH_(room), 0);
}

/* Send one request and wait for its own reply; replies to requests that were given up are passed over. */
static int tissue_sim_ask_(tissue_sim_client *client, unsigned kind, double time, const tissue_sim_pose *pose,
                           uint32_t flags, tissue_sim_answer *answer)
{
    TISSUE_SIM_SOCKET_ own = (TISSUE_SIM_SOCKET_)client->socket;
    unsigned char packet[TISSUE_SIM_REPLY_SIZE + 1];
    unsigned char *end = packet;
    uint64_t sequence = client->sequence++;
    int tries;

    memcpy(end, "TSRQ", 4);
    end = tissue_sim_put_(end + 4, TISSUE_SIM_VERSION, 2);
    end = tissue_sim_put_(end, kind, 2);
    end = tissue_sim_put_(end, sequence, 8);
    end = tissue_sim_put_doubles_(end, &time, 1);
    end = tissue_sim_put_(end, client->session, 8);
    end = tissue_sim_put_doubles_(end, pose->position, 3);
    end = tissue_sim_put_doubles_(end, pose->orientation, 4);
    end = tissue_sim_put_(end, flags, 4);
    tissue_sim_put_(end, 0, 4);
    if (send(own, (const char *)packet, TISSUE_SIM_REQUEST_SIZE, 0) != TISSUE_SIM_REQUEST_SIZE)
        return TISSUE_SIM_NO_SERVER;
    for (tries = 0; tries < 64; tries++) {
        const unsigned char *at = packet + 4;
        unsigned version;
        uint32_t flags_back;
        int size = tissue_sim_receive_(own, packet, (int)sizeof packet, client->polls);
        if (size < 0) /* this machine knows when nothing listens, another one keeps silent */
            return TISSUE_SIM_NOBODY_ ? TISSUE_SIM_NO_SERVER : TISSUE_SIM_NO_REPLY;
        if (size < 24 || memcmp(packet, "TSRP", 4) != 0)
            continue;
        version = (unsigned)tissue_sim_get_(&at, 2);
        if (version != TISSUE_SIM_VERSION)
            return TISSUE_SIM_OTHER_VERSION;
        answer->status = (unsigned)tissue_sim_get_(&at, 2);
        answer->sequence = tissue_sim_get_(&at, 8);
        if (size != TISSUE_SIM_REPLY_SIZE || answer->sequence != sequence)
            continue;
        tissue_sim_get_doubles_(&at, &answer->time, 1);
        if (tissue_sim_get_(&at, 8) != client->session)
            continue;
        tissue_sim_get_doubles_(&at, answer->force, 3);
        tissue_sim_get_doubles_(&at, answer->torque, 3);
        tissue_sim_get_doubles_(&at, &answer->stiffness[0][0], 36);
        tissue_sim_get_doubles_(&at, &answer->step_stiffness[0][0], 36);
        tissue_sim_get_doubles_(&at, &answer->age, 1);
        tissue_sim_get_doubles_(&at, &answer->compute_time, 1);
        tissue_sim_get_doubles_(&at, &answer->residual, 1);
        tissue_sim_get_doubles_(&at, &answer->dt, 1);
        answer->iterations = (uint32_t)tissue_sim_get_(&at, 4);
        flags_back = (uint32_t)tissue_sim_get_(&at, 4);
        answer->inertial = (int)(flags_back & 1);
        answer->limited = (int)(flags_back >> 1 & 1);
        answer->stale_stiffness = (int)(flags_back >> 2 & 1);
        answer->malformed = tissue_sim_get_(&at, 8);
        answer->stale = tissue_sim_get_(&at, 8);
        answer->skipped = tissue_sim_get_(&at, 8);
        answer->turned_away = tissue_sim_get_(&at, 8);
        answer->is_on_axis = 1;
        answer->has_force_error = 0;
        answer->stiffness_age = answer->force_error = answer->error_age = answer->least_tool_mass = 0.0;
#if TISSUE_SIM_VERSION >= 3
        answer->is_on_axis = !(flags_back >> 3 & 1);
        tissue_sim_get_doubles_(&at, &answer->stiffness_age, 1);
        tissue_sim_get_doubles_(&at, &answer->force_error, 1);
        tissue_sim_get_doubles_(&at, &answer->error_age, 1);
        tissue_sim_get_doubles_(&at, &answer->least_tool_mass, 1);
        answer->has_force_error = answer->force_error == answer->force_error; /* not NaN */
#endif
        return TISSUE_SIM_OK;
    }
    return TISSUE_SIM_NO_REPLY;
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
#ifdef _WIN32
    DWORD timeout = (DWORD)(timeout_s * 1e3);
    WSADATA started;
    if (WSAStartup(MAKEWORD(2, 2), &started) != 0)
        return TISSUE_SIM_BAD_ADDRESS;
#else
    struct timeval timeout;
    timeout.tv_sec = (time_t)timeout_s;
    timeout.tv_usec = (suseconds_t)((timeout_s - (double)timeout.tv_sec) * 1e6);
#endif
    memset(&server, 0, sizeof server);
    server.sin_family = AF_INET;
    server.sin_port = htons(port);
    own = socket(AF_INET, SOCK_DGRAM, 0);
    if (inet_pton(AF_INET, host, &server.sin_addr) != 1 ||
        setsockopt(own, SOL_SOCKET, SO_RCVTIMEO, (const char *)&timeout, sizeof timeout) != 0 ||
        connect(own, (const struct sockaddr *)&server, sizeof server) != 0) {
        tissue_sim_close_socket_(own);
        return TISSUE_SIM_BAD_ADDRESS;
    }
    client->socket = (intptr_t)own;
    client->sequence = 0;
    client->session = tissue_sim_session_(client);
    client->polls = 0;
    return TISSUE_SIM_OK;
}

int tissue_sim_step(tissue_sim_client *client, double time, const tissue_sim_pose *pose, uint32_t flags,
                    tissue_sim_answer *answer)
{
    return tissue_sim_ask_(client, 1, time, pose, flags, answer);
}

void tissue_sim_close(tissue_sim_client *client)
{
    tissue_sim_pose nowhere = {{0.0, 0.0, 0.0}, {1.0, 0.0, 0.0, 0.0}};
    tissue_sim_answer answer;
    (void)tissue_sim_ask_(client, 2, 0.0, &nowhere, 0, &answer);
    tissue_sim_close_socket_((TISSUE_SIM_SOCKET_)client->socket);
#ifdef _WIN32
    WSACleanup();
#endif
}

const char *tissue_sim_text(int code)
{
    switch (code) {
    case TISSUE_SIM_CONVERGED: return "in equilibrium at this pose";
    case TISSUE_SIM_LATE: return "time budget ended: the last equilibrium's force and stiffness, carried on";
    case TISSUE_SIM_STOPPED: return "no equilibrium found: the last one's force and stiffness, carried on";
    case TISSUE_SIM_REFUSED: return "the pose or the time is beyond what the scene holds: the last force";
    case TISSUE_SIM_FADING: return "no equilibrium for too long: force and stiffness go to zero";
    case TISSUE_SIM_RETURNING: return "in equilibrium: force and stiffness come back along a ramp";
    case TISSUE_SIM_FAILED: return "the step failed, and the tissue was made again: no force";
    case TISSUE_SIM_BUSY: return "another client has the tissue";
    case TISSUE_SIM_NO_REPLY: return "no reply within the timeout";
    case TISSUE_SIM_BAD_ADDRESS: return "the address is no numeric IPv4 address, or no socket is left";
    case TISSUE_SIM_NO_SERVER: return "nothing listens on that port; start tissue-sim serve";
    case TISSUE_SIM_OTHER_VERSION: return "the server speaks another version of the protocol";
    default: return "unknown status of a newer server";
    }
}

#ifdef __cplusplus
}
#endif
#endif /* TISSUE_SIM_CLIENT_IMPLEMENTATION */
