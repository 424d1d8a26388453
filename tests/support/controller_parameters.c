/* Run an exported controller with hostile parameters.  ctl_init must refuse them, or each command must be finite and
 * within its limits.  Tests build this program with sanitizers.  Argument: number of parameter sets.  The program
 * prints how many sets were refused, how many led to a solved tick, and how many only repeated commands. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "ctl.h"
#include "hostile_numbers.h"

enum { PARAMETERS = sizeof(ctl_params) / sizeof(double), TICKS = 12 };

static double hostile(double value)
{
  const double absurd[] = {NAN, INFINITY, -INFINITY, 1e308, -1e308, 1e154, 1e-308, 4.9e-324, -4.9e-324, 0.0, -0.0, 1.0,
                           -1.0, 1e18, 1e9, 1e-9, 4294967296.0};
  const int kind = draw(3);
  if (kind == 0) {
    return absurd[draw(sizeof absurd / sizeof absurd[0])];
  }
  return kind == 1 ? value * pow(10.0, 40.0 * number() - 20.0) : value * (4.0 * number() - 2.0);
}

/* Return the status of a valid tick; print and stop if a command breaks its contract. */
static int judged(long set, int status, const ctl_command *out, const ctl_params *p)
{
  int i;
  for (i = 0; i < CTL_CONTROLS; ++i) {
    if (!isfinite(out->u[i]) || out->u[i] < p->control_lower[i] || out->u[i] > p->control_upper[i]) {
      printf("set %ld, status %d: control %d is %g, its limits are %g and %g\n", set, status, i, out->u[i],
             p->control_lower[i], p->control_upper[i]);
      exit(1);
    }
  }
  return status;
}

int main(int count, char **arguments)
{
  static ctl_context c;
  static ctl_params p, sound;
  static ctl_report report;
  ctl_command out;
  double q[CTL_NQ], v[CTL_NV] = {0}, a[CTL_NV] = {0};
  const long sets = count > 1 ? atol(arguments[1]) : 100;
  const long first = fuzzed_count ? PARAMETERS : 0;
  long set, counts[3] = {0, 0, 0};
  int i, k, solved;
  ctl_default_params(&sound);
  for (set = first; set < first + sets; ++set) {
    seed = (uint64_t)set;
    (void)number();
    p = sound;
    /* At first, one parameter is huge. */
    if (set < PARAMETERS) {
      ((double *)&p)[set] = 1e18;
    }
    for (i = set < PARAMETERS ? -1 : draw(4); i >= 0; --i) {
      double *value = (double *)&p + draw(PARAMETERS);
      *value = hostile(*value);
    }
    memset(&c, 0x5a, sizeof c);
    memcpy(q, sound.posture_target, sizeof q);
    memset(v, 0, sizeof v);
    if (ctl_init(&c, &p) != 0 || ctl_reset(&c, q, v, &out) != 0) {
      ++counts[0];
      continue;
    }
    judged(set, 0, &out, &p);
    for (k = solved = 0; k < TICKS; ++k) {
      for (i = CTL_BASE; i < CTL_NV; ++i) {
        q[i + CTL_NQ - CTL_NV] += 0.01 * (number() - 0.5);
        v[i] = number() - 0.5;
      }
      if (k == 4) {
        (void)ctl_brace(&c, draw(2) ? hostile(0.004) : -INFINITY);
        (void)ctl_move_to(&c, sound.posture_target, hostile(0.01));
      } else if (k == 8) {
        a[draw(CTL_NV)] = hostile(1.0);
        (void)ctl_lead_posture(&c, q, v, a);
        (void)ctl_contact(&c, hostile(0.008));
      } else if (k == 10) {
        ((double *)c.target)[draw((int)sizeof c.target / (int)sizeof(double))] = hostile(0.1);
      }
      solved |= judged(set, ctl_tick(&c, 0.001 * k, q, v, NULL, &out), &out, &p) <= CTL_RELAXED;
      ctl_last_report(&c, &report);
    }
    ++counts[solved ? 1 : 2];
  }
  printf("refused %ld, solved %ld, repeated %ld\n", counts[0], counts[1], counts[2]);
  return 0;
}
