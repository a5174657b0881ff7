/* Drive a needle along a path against `tissue-sim serve`, and print depth, force and status of every step.
 *
 *     cc -std=c99 -O2 -I../include -o drive_needle drive_needle.c
 *     ./drive_needle 47700 path.txt       lines of: time in s, depth in m
 *     ./drive_needle 47700 0.005 100      to 5 mm in 100 steps of 1 ms
 */
#ifndef TISSUE_SIM_CLIENT_LIBRARY
#define TISSUE_SIM_CLIENT_IMPLEMENTATION /* without the library, the header is the implementation */
#endif
#include "tissue_sim_client.h"

#include <stdio.h>
#include <stdlib.h>

/* Step to a depth and print the answer. `flags` is set to 0 as soon as an answer confirms the reset. */
static int step_to_depth(tissue_sim_client *client, double time, double depth, uint32_t *flags)
{
    tissue_sim_pose pose = {{0.0, 0.0, 0.0}, {1.0, 0.0, 0.0, 0.0}};
    tissue_sim_answer answer;
    int code;

    pose.position[2] = -depth;
    code = tissue_sim_step(client, time, &pose, *flags, &answer);
    if (code == TISSUE_SIM_OK && answer.status < 100) {
        printf("%.17g %.17g %u\n", depth, answer.force[2], answer.status);
        if (answer.status != TISSUE_SIM_REFUSED && answer.status != TISSUE_SIM_FAILED)
            *flags = 0;
        return 0;
    }
    fprintf(stderr, "drive_needle: %s\n", tissue_sim_message(client));
    return 1;
}

int main(int argc, char **argv)
{
    tissue_sim_client client;
    uint32_t flags = TISSUE_SIM_RESET; /* the first step starts from tissue at rest */
    int code, failed = 0;

    if (argc != 3 && argc != 4) {
        fprintf(stderr, "usage: drive_needle PORT PATH.txt, or drive_needle PORT DEPTH_M STEPS\n");
        return 2;
    }
    code = tissue_sim_open(&client, "127.0.0.1", (uint16_t)atoi(argv[1]), 5.0);
    if (code != TISSUE_SIM_OK) {
        fprintf(stderr, "drive_needle: %s\n", tissue_sim_text(code));
        return 1;
    }
    client.polls = 1000; /* a reply that comes within about 1 ms finds us awake */
    if (argc == 3) {
        double time, depth;
        FILE *path = fopen(argv[2], "r");
        if (path == NULL) {
            fprintf(stderr, "drive_needle: cannot read %s\n", argv[2]);
            tissue_sim_close(&client);
            return 2;
        }
        for (; !failed && fscanf(path, "%lf %lf", &time, &depth) == 2;)
            failed = step_to_depth(&client, time, depth, &flags);
        fclose(path);
    } else {
        int k, steps = atoi(argv[3]);
        for (k = 0; !failed && k <= steps; k++)
            failed = step_to_depth(&client, 1e-3 * k, atof(argv[2]) * k / (steps > 0 ? steps : 1), &flags);
    }
    tissue_sim_close(&client);
    return failed;
}
