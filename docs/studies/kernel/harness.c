/* Measure the time of kernels with equal signatures, without Python in the loop.
 *
 * A pass calls the kernel once at each of `count` configurations, one after the other in memory.  The clock is the
 * processor time of the thread, which excludes the time of other programs.
 */
#define _POSIX_C_SOURCE 199309L
#include <time.h>

typedef int (*eval_t)(const double *q, const double *n, double *H, double *grad);
typedef int (*value_t)(const double *q, const double *n, double *H);
typedef int (*batch_t)(const double *q, const double *n, int count, double *H, double *grad);

static double now(void)
{
  struct timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* Return the seconds for each configuration.  Add to *failed the number of calls that do not return zero.  `kind` is
the kind of
 * f: e(val), v(alue), b(atch), or d(ifferences).  For differences, q contains each configuration, followed by two
 * configurations for each direction, moved by +step and -step.
 */
double time_pass(char kind, void *f, const double *q, const double *n, int nq, int nv, int count, double step,
                 double *H, double *grad, int *failed)
{
  const eval_t eval = (eval_t)f;
  const value_t value = (value_t)f;
  const double began = now();
  int k, i;
  if (kind == 'b') {
    *failed += ((batch_t)f)(q, n, count, H, grad) != 0;
  } else if (kind == 'e') {
    for (k = 0; k < count; ++k) {
      *failed += eval(q + k * nq, n + 3 * k, H + k, grad + k * nv) != 0;
    }
  } else if (kind == 'v') {
    for (k = 0; k < count; ++k) {
      *failed += value(q + k * nq, n + 3 * k, H + k) != 0;
    }
  } else {
    for (k = 0; k < count; ++k) {
      *failed += value(q, n + 3 * k, H + k) != 0;
      q += nq;
      for (i = 0; i < nv; ++i, q += 2 * nq) {
        double ahead = 0.0, behind = 0.0;
        *failed += (value(q, n + 3 * k, &ahead) != 0) + (value(q + nq, n + 3 * k, &behind) != 0);
        grad[k * nv + i] = (ahead - behind) / (2.0 * step);
      }
    }
  }
  return (now() - began) / count;
}
