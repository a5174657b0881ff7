/* The library: the implementation that the header contains. */
#if !defined(_WIN32) && !defined(_POSIX_C_SOURCE)
#define _POSIX_C_SOURCE 200809L /* declares the monotonic clock in C99 */
#endif
#define TISSUE_SIM_CLIENT_IMPLEMENTATION
#include "tissue_sim_client.h"
