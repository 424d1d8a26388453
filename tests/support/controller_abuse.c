/* Run an exported controller at states that are impossible for a robot.  Each command must be finite and within its
 * limits, even if the limits permit almost nothing.  Copied contexts and contexts in threads must give equal commands.
 * The program prints the growth of memory and the statuses.  Tests build it with sanitizers or run it in valgrind.
 * Arguments: number of ticks, number of threads. */
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#ifdef __GLIBC__
#include <malloc.h>
#endif

#include "ctl.h"

enum { THREADS = 8 };

typedef struct {
  unsigned long seed;
  long ticks, before[2], after[2], seen[5];
  int failed;
  double sum;
  ctl_context c, copy;
  ctl_params p;
  ctl_report report;
  pthread_t thread;
} run;

static double number(run *r)
{
  r->seed = r->seed * 6364136223846793005ul + 1442695040888963407ul;
  return (double)(r->seed >> 11) / 9007199254740992.0 * 2.0 - 1.0;
}

static int within(const ctl_command *out, const ctl_params *p)
{
  int i;
  for (i = 0; i < CTL_CONTROLS; ++i) {
    if (!(out->u[i] >= p->control_lower[i] && out->u[i] <= p->control_upper[i])) {
      return 0;
    }
  }
  return 1;
}

/* Store the allocated bytes, and the largest memory of the process so far, kB. */
static void memory(long bytes[2])
{
  struct rusage usage;
  getrusage(RUSAGE_SELF, &usage);
  bytes[1] = usage.ru_maxrss;
  bytes[0] = 0;
#if defined(__GLIBC__) && (__GLIBC__ > 2 || __GLIBC_MINOR__ >= 33)
  bytes[0] = (long)mallinfo2().uordblks;
#endif
}

/* Start with limits that permit almost nothing. */
static int start_narrow(run *r, const double *still, ctl_command *out)
{
  int i;
  for (i = 0; i < CTL_CONTROLS; ++i) {
    const double range = r->p.control_upper[i] - r->p.control_lower[i];
    r->p.control_upper[i] = isfinite(range) ? r->p.control_lower[i] + 0.02 * range : r->p.control_upper[i];
  }
  for (i = CTL_BASE; i < CTL_NV; ++i) {
    r->p.joint_lower[i] = r->p.joint_upper[i] = 0.0;
  }
  return ctl_init(&r->c, &r->p) || ctl_reset(&r->c, r->p.posture_target, still, out);
}

/* Return 0, or the number of the failed check. */
static int abuse(run *r)
{
  static const double absurd[] = {0.0, 1e200, -1e200, 1e-300, 1e7, 9e7};
  ctl_command out, other;
  double q[CTL_NQ], v[CTL_NV], still[CTL_NV] = {0}, force[6];
  const double *start = r->p.posture_target;
  long k;
  int i;
  ctl_default_params(&r->p);
  if (ctl_init(&r->c, &r->p) != 0 || ctl_tick(&r->c, 0.0, start, start, NULL, &out) != CTL_UNSOLVED) {
    return 1;
  }
  if (ctl_reset(&r->c, start, still, &out) != 0) {
    return 2;
  }
  for (k = 0; k < r->ticks; ++k) {
    if (k == r->ticks / 4) {
      memory(r->before);
    }
    if (k == r->ticks / 2 && start_narrow(r, still, &out) != 0) {
      return 5;
    }
    memcpy(q, start, sizeof q);
    for (i = 0; i < CTL_NQ; ++i) {
      q[i] += (k % 4 ? 0.3 : 0.0) * number(r) * (i >= 3 && i < 7 && CTL_BASE ? 0.0 : 1.0);
    }
    for (i = 0; i < CTL_NV; ++i) {
      v[i] = (k % 5 ? 1.0 : 30.0) * number(r);
    }
    for (i = 0; i < 6; ++i) {
      force[i] = 20.0 * number(r);
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
      r->c.target[0].position[0] = k % 16 == 4 ? NAN : 1e6;
      break;
    case 5:
      r->c.target[0].position[0] = 0.0;
      (void)ctl_brace(&r->c, 1e-3 * k);
      break;
    case 6:
      (void)ctl_move_to(&r->c, start, 0.01);
      (void)ctl_release(&r->c, k % 16 == 6 ? NAN : 1e-3 * (k + k % 3));
      break;
    default:
      break;
    }
    memcpy(&r->copy, &r->c, sizeof r->copy);
    ++r->seen[ctl_tick(&r->c, 1e-3 * (double)k, q, v, k % 3 ? force : NULL, &out)];
    ctl_tick(&r->copy, 1e-3 * (double)k, q, v, k % 3 ? force : NULL, &other);
    if (!within(&out, &r->p)) {
      printf("tick %ld, status %d: a control is out of its limits\n", k, out.status);
      return 3;
    }
    if (memcmp(out.u, other.u, sizeof out.u) != 0) {
      printf("tick %ld: a copy of the context has another answer\n", k);
      return 4;
    }
    ctl_last_report(&r->c, &r->report);
    r->sum += out.u[k % CTL_CONTROLS];
  }
  memory(r->after);
  return r->seen[CTL_NON_FINITE] > 0 && r->seen[CTL_SOLVED] + r->seen[CTL_RELAXED] > 0 ? 0 : 6;
}

static void *abused(void *r)
{
  ((run *)r)->failed = abuse(r);
  return NULL;
}

int main(int count, char **arguments)
{
  static run runs[THREADS], again;
  const int threads = count > 2 ? atoi(arguments[2]) : 0;
  int i;
  again.seed = 1;
  again.ticks = count > 1 ? atol(arguments[1]) : 400;
  abused(&again);
  for (i = 0; i < threads && i < THREADS; ++i) {
    runs[i].seed = 1;
    runs[i].ticks = again.ticks;
    if (pthread_create(&runs[i].thread, NULL, abused, &runs[i]) != 0) {
      return 7;
    }
  }
  for (i = 0; i < threads && i < THREADS; ++i) {
    pthread_join(runs[i].thread, NULL);
    if (runs[i].failed != again.failed || memcmp(&runs[i].sum, &again.sum, sizeof again.sum) != 0) {
      printf("thread %d has other answers\n", i);
      return 8;
    }
  }
  printf("growth %ld B, %ld kB; statuses", again.after[0] - again.before[0], again.after[1] - again.before[1]);
  for (i = 0; i < 5; ++i) {
    printf(" %ld", again.seen[i]);
  }
  printf("\n");
  return again.failed;
}
