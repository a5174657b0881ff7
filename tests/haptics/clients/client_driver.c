/* Execute the commands of tests/haptics/test_clients.py, one a line. Doubles are 16 hexadecimal digits of their bits. */
#define TISSUE_SIM_CLIENT_IMPLEMENTATION
#include "tissue_sim_client.h"
#include "tissue_sim_unreal.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static char line[8192];
static tissue_sim_answer answer; /* of the last step */

static uint64_t next_integer(void)
{
    return strtoull(strtok(NULL, " \n"), NULL, 10);
}

static double next_double(void)
{
    const uint64_t bits = strtoull(strtok(NULL, " \n"), NULL, 16);
    double value;
    memcpy(&value, &bits, 8);
    return value;
}

static void next_doubles(double *values, int count)
{
    int k;
    for (k = 0; k < count; k++)
        values[k] = next_double();
}

static void print_doubles(const double *values, int count)
{
    int k;
    for (k = 0; k < count; k++) {
        uint64_t bits;
        memcpy(&bits, &values[k], 8);
        printf(" %016" PRIx64, bits);
    }
}

static const char *name_of(int code)
{
    switch (code) {
    case TISSUE_SIM_OK: return "ok";
    case TISSUE_SIM_NO_REPLY: return "no_reply";
    case TISSUE_SIM_NO_SERVER: return "no_server";
    case TISSUE_SIM_OTHER_VERSION: return "other_version";
    case TISSUE_SIM_BAD_POSE: return "bad_pose";
    case TISSUE_SIM_BAD_REPLY: return "bad_reply";
    case TISSUE_SIM_NOT_A_REPLY: return "not_a_reply";
    case TISSUE_SIM_BUSY: return "busy";
    default: return "other";
    }
}

static void encode(void)
{
    tissue_sim_request request;
    unsigned char packet[TISSUE_SIM_REQUEST_SIZE];
    int k;
    request.version = (unsigned)next_integer();
    request.kind = (unsigned)next_integer();
    request.sequence = next_integer();
    request.time = next_double();
    request.session = next_integer();
    next_doubles(request.pose.position, 3);
    next_doubles(request.pose.orientation, 4);
    request.flags = (uint32_t)next_integer();
    tissue_sim_encode_request(&request, packet);
    for (k = 0; k < TISSUE_SIM_REQUEST_SIZE; k++)
        printf("%02x", packet[k]);
}

static void decode(void)
{
    static unsigned char packet[4096];
    const char *text = strtok(NULL, " \n");
    const size_t size = strcmp(text, "-") == 0 ? 0 : strlen(text) / 2;
    tissue_sim_answer got;
    size_t k;
    int code;
    for (k = 0; k < size; k++) {
        const char digits[3] = {text[2 * k], text[2 * k + 1], 0};
        packet[k] = (unsigned char)strtoul(digits, NULL, 16);
    }
    code = tissue_sim_decode_reply(packet, size, &got);
    printf("%s", name_of(code));
    if (code == TISSUE_SIM_OTHER_VERSION)
        printf(" %u", got.version);
    if (code != TISSUE_SIM_OK)
        return;
    printf(" %u %u %" PRIu64, got.version, got.status, got.sequence);
    print_doubles(&got.time, 1);
    printf(" %" PRIu64, got.session);
    print_doubles(got.force, 3);
    print_doubles(got.torque, 3);
    print_doubles(&got.stiffness[0][0], 36);
    print_doubles(&got.step_stiffness[0][0], 36);
    print_doubles(&got.age, 1);
    print_doubles(&got.compute_time, 1);
    print_doubles(&got.residual, 1);
    print_doubles(&got.dt, 1);
    printf(" %" PRIu32 " %" PRIu32 " %" PRIu64 " %" PRIu64 " %" PRIu64 " %" PRIu64, got.iterations, got.flags,
           got.malformed, got.stale, got.skipped, got.turned_away);
    print_doubles(&got.stiffness_age, 1);
    print_doubles(&got.force_error, 1);
    print_doubles(&got.error_age, 1);
    print_doubles(&got.least_tool_mass, 1);
    printf(" %d%d%d%d%d", got.inertial, got.limited, got.stale_stiffness, got.is_on_axis, got.has_force_error);
}

static void step(tissue_sim_client *client)
{
    const double time = next_double();
    tissue_sim_pose pose;
    uint32_t flags;
    int code;
    next_doubles(pose.position, 3);
    next_doubles(pose.orientation, 4);
    flags = (uint32_t)next_integer();
    code = tissue_sim_step(client, time, &pose, flags, &answer);
    if (code == TISSUE_SIM_OK && answer.status < 100) {
        printf("ok %u %d", answer.status, answer.is_first);
        print_doubles(answer.force, 3);
        print_doubles(&answer.dt, 1);
    } else {
        printf("%s %s", code == TISSUE_SIM_OK ? name_of((int)answer.status) : name_of(code), tissue_sim_message(client));
    }
}

/* Pose and wrench of the scene in the engine, and the pose back in the scene. */
static void convert(void)
{
    double position[3], orientation[4], force[3], torque[3], location[3], quaternion[4], force_there[3], torque_there[3];
    next_doubles(position, 3);
    next_doubles(orientation, 4);
    next_doubles(force, 3);
    next_doubles(torque, 3);
    tissue_sim_pose_to_unreal(position, orientation, location, quaternion);
    tissue_sim_wrench_to_unreal(force, torque, force_there, torque_there);
    tissue_sim_pose_from_unreal(location, quaternion, position, orientation);
    printf("ok");
    print_doubles(location, 3);
    print_doubles(quaternion, 4);
    print_doubles(force_there, 3);
    print_doubles(torque_there, 3);
    print_doubles(position, 3);
    print_doubles(orientation, 4);
}

int main(void)
{
    tissue_sim_client client;
    int is_open = 0;
    memset(&client, 0, sizeof client);
    while (fgets(line, sizeof line, stdin) != NULL) {
        const char *command = strtok(line, " \n");
        if (strcmp(command, "encode") == 0) {
            encode();
        } else if (strcmp(command, "decode") == 0) {
            decode();
        } else if (strcmp(command, "convert") == 0) {
            convert();
        } else if (strcmp(command, "open") == 0) {
            const uint16_t port = (uint16_t)next_integer();
            const double timeout = next_double();
            const int code = tissue_sim_open(&client, "127.0.0.1", port, timeout);
            client.version = (unsigned)next_integer();
            is_open = code == TISSUE_SIM_OK;
            printf("%s", name_of(code));
        } else if (strcmp(command, "connect") == 0) {
            const int code = tissue_sim_connect(&client, next_double());
            printf("%s %s", name_of(code), code == TISSUE_SIM_OK ? "" : tissue_sim_message(&client));
        } else if (strcmp(command, "largest") == 0) {
            client.largest_force = next_double();
            printf("ok");
        } else if (strcmp(command, "timeout") == 0) {
            client.timeout = next_double();
            printf("ok");
        } else if (strcmp(command, "force") == 0) {
            printf("ok");
            print_doubles(answer.force, 3);
        } else if (strcmp(command, "step") == 0) {
            step(&client);
        } else if (strcmp(command, "close") == 0) {
            if (is_open)
                tissue_sim_close(&client);
            is_open = 0;
            printf("ok");
        }
        printf("\n");
        fflush(stdout);
    }
    return 0;
}
