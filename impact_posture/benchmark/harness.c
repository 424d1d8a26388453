/* Times kernels of one signature without Python in the loop.
 *
 * A pass calls the kernel once at each of `count` configurations, one after the other in memory.  The kernels take
 * turns, so that a disturbance of the machine falls on all of them alike.  The clock is the thread's processor time:
 * what other processes of a busy machine take does not count.
 */
#define _POSIX_C_SOURCE 199309L
#include <time.h>

typedef int (*eval_t)(const double *q, const double *n, double *H, double *grad);
typedef int (*value_t)(const double *q, const double *n, double *H);

static double now(void)
{
  struct timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* Seconds a call of one pass; calls that return no zero add up in *failed. */
double time_eval(eval_t f, const double *q, const double *n, int nq, int nv, int count, double *H, double *grad,
                 int *failed)
{
  const double began = now();
  int k;
  for (k = 0; k < count; ++k) {
    *failed += f(q + k * nq, n + 3 * k, H + k, grad + k * nv) != 0;
  }
  return (now() - began) / count;
}

double time_value(value_t f, const double *q, const double *n, int nq, int count, double *H, int *failed)
{
  const double began = now();
  int k;
  for (k = 0; k < count; ++k) {
    *failed += f(q + k * nq, n + 3 * k, H + k) != 0;
  }
  return (now() - began) / count;
}

typedef int (*batch_t)(const double *q, const double *n, int count, double *H, double *grad);

double time_batch(batch_t f, const double *q, const double *n, int count, double *H, double *grad, int *failed)
{
  const double began = now();
  *failed += f(q, n, count, H, grad) != 0;
  return (now() - began) / count;
}

/* H and its gradient by central differences: at each configuration a call at q and two for each direction, the moved
 * configurations made before; seconds a configuration.
 */
double time_differences(value_t f, const double *moved, const double *n, int nq, int nv, int count, double step,
                        double *H, double *grad, int *failed)
{
  const double began = now();
  int k, i;
  for (k = 0; k < count; ++k) {
    *failed += f(moved, n + 3 * k, H + k) != 0;
    moved += nq;
    for (i = 0; i < nv; ++i, moved += 2 * nq) {
      double ahead = 0.0, behind = 0.0;
      *failed += f(moved, n + 3 * k, &ahead) != 0;
      *failed += f(moved + nq, n + 3 * k, &behind) != 0;
      grad[k * nv + i] = (ahead - behind) / (2.0 * step);
    }
  }
  return (now() - began) / count;
}
