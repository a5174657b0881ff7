/* Wall time of round trips to `tissue-sim serve`: of each, us beyond the step itself, us of the step, and its status.
 *
 *     cc -std=c99 -O2 -I../docs/client -o realtime_round_trip realtime_round_trip.c -lm
 *     ./realtime_round_trip PORT STEPS PERIOD_S POLLS       period 0: one after the other
 */
#define _POSIX_C_SOURCE 200809L
#define TISSUE_SIM_CLIENT_IMPLEMENTATION
#include "tissue_sim_client.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static double now(void)
{
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    return (double)at.tv_sec + 1e-9 * (double)at.tv_nsec;
}

int main(int argc, char **argv)
{
    tissue_sim_client client;
    tissue_sim_answer answer;
    tissue_sim_pose pose = {{0.0, 0.0, 0.0}, {1.0, 0.0, 0.0, 0.0}};
    double period, deadline;
    int k, steps, code = 0;

    if (argc != 5)
        return 2;
    if (tissue_sim_open(&client, "127.0.0.1", (uint16_t)atoi(argv[1]), 5.0) != TISSUE_SIM_OK)
        return 1;
    steps = atoi(argv[2]);
    period = atof(argv[3]);
    client.polls = atol(argv[4]);
    deadline = now();
    for (k = 0; k < steps; k++) {
        double sent, took, rest;
        deadline += period;
        rest = deadline - now();
        if (period > 0.0 && rest > 0.0) {
            struct timespec pause = {0, (long)(rest * 1e9)};
            nanosleep(&pause, NULL);
        }
        pose.position[2] = -0.005 * pow(sin(3e-3 * k), 2.0);
        sent = now();
        code = tissue_sim_step(&client, 1e-3 * k, &pose, k == 0 ? TISSUE_SIM_RESET : 0, &answer);
        took = now() - sent;
        if (code != TISSUE_SIM_OK)
            break;
        printf("%.2f %.2f %u\n", 1e6 * (took - answer.compute_time), 1e6 * answer.compute_time, answer.status);
    }
    if (code != TISSUE_SIM_OK)
        fprintf(stderr, "%s\n", tissue_sim_text(code));
    tissue_sim_close(&client);
    return code != TISSUE_SIM_OK;
}
