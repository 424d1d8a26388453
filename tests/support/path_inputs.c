/* Call the references along an exported path in any order with hostile numbers.  Each reference must be a posture with
 * finite velocity and acceleration.  Tests build this program with sanitizers.  Argument: number of calls.  The program
 * prints how often each phase was seen. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "ctl_path.h"
#include "hostile_numbers.h"

static double hostile(double value)
{
  const double absurd[] = {NAN, INFINITY, -INFINITY, 1e308, -1e308, 1e154, 1e-308, 4.9e-324, 0.0, -0.0, 1e18, 1e-9};
  return number() < 0.01 ? absurd[draw(12)] : value;
}

int main(int count, char **arguments)
{
  static ctl_path p;
  const long calls = count > 1 ? atol(arguments[1]) : 1000;
  long call, seen[CTL_PATH_HOLD + 1] = {0};
  double t = 0.0, q[CTL_NQ], v[CTL_NV];
  int i;
  seed = 1;
  ctl_path_init(&p);
  for (call = 0; call < calls; ++call) {
    const int kind = draw(2000);
    double size = 0.0;
    if (kind == 0) {
      ctl_path_init(&p);
      p.late = hostile(p.late);
      p.felt = hostile(p.felt);
      p.stopped = hostile(p.stopped);
      p.lag = hostile(p.lag);
    } else if (kind <= 2) {
      (void)ctl_path_start(&p, hostile(t), number() < 0.5 ? -INFINITY : hostile(t + number()));
    } else if (kind <= 4) {
      (void)ctl_path_expect(&p, hostile(t + 0.5));
    } else if (kind <= 6) {
      (void)ctl_path_return(&p, hostile(0.1 * number()));
    }
    memcpy(q, p.q, sizeof q);
    memcpy(v, p.v, sizeof v);
    q[draw(CTL_NQ)] += hostile(0.001);
    v[draw(CTL_NV)] += hostile(0.001);
    t += 0.004 * number();
    ++seen[ctl_path_tick(&p, hostile(t), q, number() < 0.5 ? NULL : v, number() < 0.002 ? hostile(10.0) : 0.0)];
    for (i = 0; i < CTL_NQ; ++i) {
      size += p.q[i] * p.q[i];
    }
    for (i = 0; i < CTL_NV; ++i) {
      size += 0.0 * p.v[i] + 0.0 * p.a[i];
    }
    if (!isfinite(size) || (CTL_BASE == 6 && fabs(p.q[3] * p.q[3] + p.q[4] * p.q[4] + p.q[5] * p.q[5] + p.q[6] * p.q[6]
                                                  - 1.0) > 1e-2)) {
      printf("call %ld: the reference of phase %d is not a posture\n", call, p.phase);
      return 1;
    }
  }
  for (i = CTL_PATH_IDLE; i <= CTL_PATH_HOLD; ++i) {
    printf("phase %d: %ld\n", i, seen[i]);
    if (CTL_PATH_STRIKES && calls >= 1000 && !seen[i]) {
      printf("the inputs do not reach this phase\n");
      return 1;
    }
  }
  return 0;
}
