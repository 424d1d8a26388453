/* An exported controller under states that no robot has: each command is finite and within its limits, and a context
 * that was copied gives the same answers.  Built with sanitizers. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "ctl.h"

static unsigned long seed = 1;

static double number(void)
{
  seed = seed * 6364136223846793005ul + 1442695040888963407ul;
  return (double)(seed >> 11) / 9007199254740992.0 * 2.0 - 1.0;
}

static int within(const ctl_command *out, const ctl_params *p)
{
  int i;
  for (i = 0; i < CTL_CONTROLS; ++i) {
    const double room = 2e-6 * fmax(1.0, fabs(p->control_upper[i]));
    if (!(out->u[i] >= p->control_lower[i] - room && out->u[i] <= p->control_upper[i] + room)) {
      return 0;
    }
  }
  return 1;
}

int main(void)
{
  static const double absurd[] = {0.0, 1e200, -1e200, 1e-300, 1e7, 9e7};
  static ctl_context c, twin;
  static ctl_params p;
  static ctl_report report;
  ctl_command out, other;
  double q[CTL_NQ], v[CTL_NV], force[6], start[CTL_NQ];
  int k, i, seen[5] = {0};
  ctl_default_params(&p);
  if (ctl_init(&c, &p) != 0 || ctl_tick(&c, 0.0, p.posture_target, p.posture_target, NULL, &out) != CTL_UNSOLVED) {
    return 1;
  }
  memcpy(start, p.posture_target, sizeof start);
  memset(v, 0, sizeof v);
  if (ctl_reset(&c, start, v, &out) != 0) {
    return 2;
  }
  for (k = 0; k < 400; ++k) {
    memcpy(q, start, sizeof q);
    for (i = 0; i < CTL_NQ; ++i) {
      q[i] += (k % 4 ? 0.3 : 0.0) * number() * (i >= 3 && i < 7 && CTL_BASE ? 0.0 : 1.0);
    }
    for (i = 0; i < CTL_NV; ++i) {
      v[i] = (k % 5 ? 1.0 : 30.0) * number();
    }
    for (i = 0; i < 6; ++i) {
      force[i] = 20.0 * number();
    }
    switch (k % 8) {
    case 0:
      q[k % CTL_NQ] = NAN;
      break;
    case 1:
      v[k % CTL_NV] = absurd[k / 8 % 6];
      break;
    case 2:
      q[k % CTL_NQ] *= 1.5;
      break;
    case 3:
      force[k % 6] = k % 16 == 3 ? INFINITY : 1e5;
      break;
    case 4:
      c.target[0].position[0] = k % 16 == 4 ? NAN : 1e6;
      break;
    case 5:
      c.target[0].position[0] = 0.0;
      (void)ctl_brace(&c, 1e-3 * k);
      break;
    case 6:
      (void)ctl_move_to(&c, start, 0.01);
      (void)ctl_release(&c, k % 16 == 6 ? NAN : 1e-3 * (k + k % 3));
      break;
    default:
      break;
    }
    memcpy(&twin, &c, sizeof twin);
    ++seen[ctl_tick(&c, 1e-3 * k, q, v, k % 3 ? force : NULL, &out)];
    ctl_tick(&twin, 1e-3 * k, q, v, k % 3 ? force : NULL, &other);
    if (!within(&out, &p)) {
      printf("tick %d, status %d: a control is out of its limits\n", k, out.status);
      return 3;
    }
    if (memcmp(out.u, other.u, sizeof out.u) != 0) {
      printf("tick %d: a copy of the context has another answer\n", k);
      return 4;
    }
    ctl_last_report(&c, &report);
  }
  for (i = 0; i < 5; ++i) {
    printf("%d ", seen[i]);
  }
  return seen[CTL_NON_FINITE] > 0 && seen[CTL_SOLVED] + seen[CTL_RELAXED] > 0 ? 0 : 5;
}
