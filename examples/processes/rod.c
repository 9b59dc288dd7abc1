/* Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0 */
/* A rod of two lumps, served to `pdeloop train --plant process:./rod`: cc -O2 -o rod rod.c */
#include <stdio.h>

int main(void)
{
    double z[2], a, seed;
    char line[4096];
    puts("{\"n_z\": 2, \"n_a\": 1, \"sample_time\": 0.1, \"horizon\": 40, \"target\": 0.5, \"action_low\": -2.0}");
    for (fflush(stdout); fgets(line, sizeof line, stdin); fflush(stdout)) {
        if (sscanf(line, "{\"reset\": %lf", &seed) == 1)
            z[0] = 1.0 + 1e-16 * seed, z[1] = 1.0;
        else if (sscanf(line, "{\"step\": [%lf", &a) == 1)
            z[1] += 0.1 * (z[0] - z[1]), z[0] += 0.1 * (a + z[1] - z[0]);
        printf("{\"z\": [%.17g, %.17g]}\n", z[0], z[1]);
    }
    return 0;
}
