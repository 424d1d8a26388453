/* Time of each tick of an exported controller over recorded states: ticks.bin, NQ + NV numbers each.
 * Arguments: the file, and "cold" to flush the caches before each tick.  Prints nanoseconds, one a line. */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "ctl.h"

static char junk[16 << 20];

int main(int count, char **arguments)
{
  static ctl_context context;
  static ctl_params params;
  ctl_command command;
  double state[CTL_NQ + CTL_NV];
  FILE *file = count > 1 ? fopen(arguments[1], "rb") : NULL;
  struct timespec from, to;
  volatile long sink = 0;
  long tick;
  size_t k;
  ctl_default_params(&params);
  if (!file || ctl_init(&context, &params) != 0 || fread(state, sizeof state, 1, file) != 1
      || ctl_reset(&context, state, state + CTL_NQ, &command) != 0) {
    return 1;
  }
#if CTL_FLOW
  ctl_brace(&context);
#endif
  for (tick = 0; fread(state, sizeof state, 1, file) == 1; ++tick) {
    for (k = 0; count > 2 && k < sizeof junk; k += 64) {
      sink += junk[k]++;
    }
    clock_gettime(CLOCK_MONOTONIC, &from);
    ctl_tick(&context, 1e-3 * (double)tick, state, state + CTL_NQ, NULL, &command);
    clock_gettime(CLOCK_MONOTONIC, &to);
    printf("%ld %d %d\n", (to.tv_sec - from.tv_sec) * 1000000000L + to.tv_nsec - from.tv_nsec, command.status,
           command.iterations);
  }
  return 0;
}
