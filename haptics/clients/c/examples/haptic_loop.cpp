// Move a tool at 1 kHz against `tissue-sim serve`, and print round trip, force and status.
//
//     c++ -std=c++11 -O2 -I../include -o haptic_loop haptic_loop.cpp
//     ./haptic_loop PORT [SECONDS] [DEPTH_M]
//
// A step whose reply does not arrive in its millisecond is late: the force of the last reply is extrapolated with its
// stiffness for 20 ms, then it is zero. A server that ends and starts again is used again from its first reply on.
#ifndef TISSUE_SIM_CLIENT_LIBRARY
#define TISSUE_SIM_CLIENT_IMPLEMENTATION
#endif
#include "tissue_sim_client.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <thread>
#include <vector>

namespace {

using Clock = std::chrono::steady_clock;

const double period = 1e-3;           // s
const double longest_hold = 20e-3;    // time for which the last force is extrapolated, s
const double longest_outage = 60.0;   // time without a server after which the program ends, s

double seconds_since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

// Axial force at a depth, from the last answer and the time since it, N.
double held_force(const tissue_sim_answer &last, double last_depth, double depth, double since)
{
    if (since > longest_hold || last.stale_stiffness)
        return 0.0;
    return std::max(0.0, last.force[2] + last.stiffness[2][2] * (depth - last_depth));
}

double quantile(std::vector<double> sorted, double fraction)
{
    std::sort(sorted.begin(), sorted.end());
    return sorted[static_cast<std::size_t>(fraction * static_cast<double>(sorted.size() - 1))];
}

}  // namespace

int main(int argc, char **argv)
{
    if (argc < 2 || argc > 4) {
        std::fprintf(stderr, "usage: haptic_loop PORT [SECONDS] [DEPTH_M]\n");
        return 2;
    }
    const double duration = argc > 2 ? std::atof(argv[2]) : 5.0;
    const double deepest = argc > 3 ? std::atof(argv[3]) : 0.004;
    tissue_sim_client client;
    int code = tissue_sim_open(&client, "127.0.0.1", static_cast<uint16_t>(std::atoi(argv[1])), period);
    if (code != TISSUE_SIM_OK || (code = tissue_sim_connect(&client, 5.0)) != TISSUE_SIM_OK) {
        std::fprintf(stderr, "haptic_loop: %s\n", tissue_sim_message(&client));
        return 1;
    }

    tissue_sim_answer answer = {}, last = {};
    std::vector<double> round_trips;
    double last_time = -1.0, last_depth = 0.0, force = 0.0, largest = 0.0;
    long late = 0, outages = 0, starts = 0;
    const char *text = "";
    uint32_t flags = TISSUE_SIM_RESET;
    const Clock::time_point start = Clock::now();
    int result = 0;
    for (long k = 0;; k++) {
        const auto tick = std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(period * static_cast<double>(k)));
        std::this_thread::sleep_until(start + tick);
        const double time = seconds_since(start);
        if (time > duration)
            break;
        const double depth = deepest * std::pow(std::sin(3.0 * time), 2.0);
        const tissue_sim_pose pose = {{0.0, 0.0, -depth}, {1.0, 0.0, 0.0, 0.0}};
        const Clock::time_point sent = Clock::now();
        code = tissue_sim_step(&client, time, &pose, flags, &answer);
        if (code == TISSUE_SIM_OK && answer.status < 100) {
            round_trips.push_back(1e6 * seconds_since(sent));
            starts += answer.is_first;
            if (answer.is_first) {
                std::printf("%6.2f s  first step at this server\n", time);
                std::fflush(stdout);
            }
            force = answer.force[2];
            text = tissue_sim_text(static_cast<int>(answer.status));
            last = answer;
            last_time = time;
            last_depth = depth;
            if (answer.status != TISSUE_SIM_REFUSED && answer.status != TISSUE_SIM_FAILED)
                flags = 0; // the reset is done
        } else if (code == TISSUE_SIM_NO_REPLY || code == TISSUE_SIM_NO_SERVER) {
            (code == TISSUE_SIM_NO_REPLY ? late : outages)++;
            text = tissue_sim_message(&client);
            force = last_time < 0.0 ? 0.0 : held_force(last, last_depth, depth, time - last_time);
            if (time - std::max(last_time, 0.0) > longest_outage) {
                std::fprintf(stderr, "haptic_loop: %s\n", tissue_sim_message(&client));
                result = 1;
                break;
            }
        } else { // another client, another version, an invalid pose: waiting does not help
            force = 0.0;
            std::fprintf(stderr, "haptic_loop: %s\n", tissue_sim_message(&client));
            result = 1;
            break;
        }
        largest = std::max(largest, force); // a device gets `force` here
        if (k % 1000 == 0) {
            std::printf("%6.2f s  depth %5.2f mm  force %7.3f N  %s\n", time, 1e3 * depth, force, text);
            std::fflush(stdout);
        }
    }
    client.timeout = 0.5; // the goodbye is not part of the loop
    tissue_sim_close(&client);
    if (!round_trips.empty())
        std::printf("steps %zu, round trip p50 %.0f us, p99 %.0f us, largest force %.3f N, late %ld, without server %ld, "
                    "starts %ld\n", round_trips.size(), quantile(round_trips, 0.5), quantile(round_trips, 0.99), largest,
                    late, outages, starts);
    return result;
}
