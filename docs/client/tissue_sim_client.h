/* The C client is in haptics/clients/c; this file includes it for programs that still use the former folder. */
#include "../../haptics/clients/c/include/tissue_sim_client.h"
