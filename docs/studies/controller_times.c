/* Measures each tick of an exported controller over the recorded states of a file (NQ + NV numbers each).
 * Arguments: the file; then "cold", which flushes the caches before each tick, or a number N, which switches on the
 * impact-robust term and evaluates its gradient in every N-th tick.  Prints a line for each tick: nanoseconds, status,
 * iterations and, with the term, the nanoseconds of its gradient. */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "ctl.h"
#if CTL_ROBUST
#include "ctl_metric.h"
#endif

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
  long tick, alone = 0;
  const int every = count > 2 ? atoi(arguments[2]) : 0;
  size_t k;
  ctl_default_params(&params);
#if CTL_ROBUST
  params.robust_every[0] = every ? every : 1;
  params.robust_ramp[0] = 1e-4;
#endif
  if (!file || ctl_init(&context, &params) != 0 || fread(state, sizeof state, 1, file) != 1
      || ctl_reset(&context, state, state + CTL_NQ, &command) != 0) {
    return 1;
  }
  if (every || CTL_FLOW) {
    (void)ctl_brace(&context, 0.0);
  }
  for (tick = 0; fread(state, sizeof state, 1, file) == 1; ++tick) {
    for (k = 0; count > 2 && !every && k < sizeof junk; k += 64) {
      sink += junk[k]++;
    }
    clock_gettime(CLOCK_MONOTONIC, &from);
    ctl_tick(&context, 1e-3 * (double)tick, state, state + CTL_NQ, NULL, &command);
    clock_gettime(CLOCK_MONOTONIC, &to);
    printf("%ld %d %d", (to.tv_sec - from.tv_sec) * 1000000000L + to.tv_nsec - from.tv_nsec, command.status,
           command.iterations);
#if CTL_ROBUST
    {
      double value, gradient[CTL_NV];
      clock_gettime(CLOCK_MONOTONIC, &from);
      ctl_metric_objective(state, &value, gradient);
      clock_gettime(CLOCK_MONOTONIC, &to);
      alone = (to.tv_sec - from.tv_sec) * 1000000000L + to.tv_nsec - from.tv_nsec;
    }
#endif
    printf(" %ld\n", alone);
  }
  return 0;
}
