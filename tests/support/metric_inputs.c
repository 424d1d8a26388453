/* Call all functions of an exported metric with hostile inputs, in several threads.  Tests build this program with
 * sanitizers.  Each function must return the code that the header promises: 0 and finite outputs, or 1 or 2 and
 * unchanged outputs, or 3.  Arguments: number of inputs, number of threads. */
#include <float.h>
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "hostile_numbers.h"
#include "m.h"

enum { NQ = M_NQ, NV = M_NV, FREE = NQ > NV, BATCH = 13, MOST = NV > 9 ? NV : 9, THREADS = 8 };

/* Relative difference between a batch and a single call.  Single precision with supports keeps two digits. */
static const double NEAR = sizeof(m_real) == 4 ? 0.1 : 1e-8;

typedef m_real real;

typedef struct {
  uint64_t seed;
  long inputs, codes[4];
  int failed;
  pthread_t thread;
} run;

static void hostile(real *x, int count)
{
  const real most = sizeof(real) == 4 ? (real)FLT_MAX : (real)DBL_MAX, least = sizeof(real) == 4 ? (real)1e-45 : (real)5e-324;
  const real absurd[] = {(real)NAN, (real)INFINITY, (real)-INFINITY, most, -most, least, -least, 0, (real)-0.0, 1, (real)1e9,
                         (real)1e18, (real)-1e30, (real)1e-30};
  int k;
  for (k = draw(3); k > 0; --k) {
    x[draw(count)] = absurd[draw((int)(sizeof absurd / sizeof absurd[0]))];
  }
}

static int all_finite(const real *x, int count)
{
  int i;
  for (i = 0; i < count; ++i) {
    if (!isfinite(x[i])) {
      return 0;
    }
  }
  return 1;
}

/* Return whether a code and the outputs agree with the header; outputs were filled with 7 before the call. */
static int sound(run *r, int code, int refused, const real *one, int count, const real *other, int more)
{
  int i, kept = 1;
  if (code < 0 || code > 3) {
    return 0;
  }
  ++r->codes[code];
  for (i = 0; i < count; ++i) {
    kept &= one[i] == 7;
  }
  for (i = 0; i < more; ++i) {
    kept &= other[i] == 7;
  }
  if (refused != (code == 1) && !(refused && code == 2)) {
    return 0;
  }
  return code == 0 ? all_finite(one, count) && all_finite(other, more) : code == 3 || kept;
}

static void fill(real *x, int count)
{
  int i;
  for (i = 0; i < count; ++i) {
    x[i] = 7;
  }
}

/* Return 0, or the number of the first function whose code or outputs are wrong. */
static int abuse(run *r)
{
  real q[BATCH * NQ], n[BATCH * 3], H[BATCH], grad[BATCH * NV], a[MOST], G[2], same[NQ > NV ? NQ : NV];
  long input;
  int plain[BATCH], k, code, wrong, first;
  for (input = 0; input < r->inputs; ++input) {
    for (k = 0; k < BATCH; ++k) {
      memset(q + k * NQ, 0, sizeof(real) * NQ);
      for (code = FREE ? 7 : 0; code < NQ; ++code) {
        q[k * NQ + code] = (real)(number() - 0.5);
      }
      q[k * NQ + (FREE ? 6 : 0)] = 1;
      n[3 * k] = n[3 * k + 1] = 0;
      n[3 * k + 2] = 1;
      plain[k] = number() < 0.3;
      if (!plain[k]) {
        hostile(q + k * NQ, NQ);
        hostile(n + 3 * k, 3);
      }
    }
    wrong = !all_finite(q, NQ) || !all_finite(n, 3);
    fill(H, BATCH), fill(grad, BATCH * NV), fill(a, MOST), fill(G, 2);
    code = m_eval(q, n, H, grad);
    if (!sound(r, code, wrong, H, 1, grad, NV)) {
      return 1;
    }
    if (code == 0) {
      memcpy(same, q, sizeof(real) * NQ);
      if (m_eval(same, n, G, same) != 0 || memcmp(same, grad, sizeof(real) * NV) != 0 || G[0] != H[0]) {
        return 2;
      }
    }
    fill(H, BATCH), fill(grad, BATCH * NV), fill(G, 2);
    if (!sound(r, m_objective(q, H, grad), !all_finite(q, NQ), H, 1, grad, NV)) {
      return 3;
    }
    fill(H, BATCH);
    if (!sound(r, m_value(q, n, H), wrong, H, 1, G, 0)) {
      return 4;
    }
    if (!sound(r, m_jump(q, n, a, G, G + 1), wrong, a, NV, G, 2)) {
      return 5;
    }
    fill(a, MOST);
    if (!sound(r, m_ellipsoid(q, a), !all_finite(q, NQ), a, 9, G, 0)) {
      return 6;
    }
    fill(H, BATCH), fill(grad, BATCH * NV);
    if (m_eval_batch(q, n, 0, H, grad) != 0 || m_eval_batch(q, n, -1, H, grad) != 0 || H[0] != 7 || grad[0] != 7) {
      return 7;
    }
    first = m_eval_batch(q, n, BATCH, H, grad);
    for (k = wrong = 0; k < BATCH; ++k) {
      code = m_eval(q + k * NQ, n + 3 * k, G, a);
      /* The batch sums in another order, so only one of the two functions may overflow. */
      if ((code == 1 || code == 2) && (isfinite(H[k]) || all_finite(grad + k * NV, NV) || (wrong == 0 && first != code && first != 3))) {
        return 8;
      }
      if (code == 0 && plain[k] && fabs((double)(H[k] - G[0])) > NEAR * fabs((double)G[0])) {
        return 9;
      }
      wrong = wrong ? wrong : code;
    }
  }
  return 0;
}

static void *abused(void *r)
{
  seed = ((run *)r)->seed;
  ((run *)r)->failed = abuse(r);
  return NULL;
}

int main(int count, char **arguments)
{
  static run runs[THREADS];
  const int threads = count > 2 ? atoi(arguments[2]) : 1;
  int i, failed = 0;
  for (i = 0; i < threads && i < THREADS; ++i) {
    runs[i].seed = (uint64_t)i;
    runs[i].inputs = count > 1 ? atol(arguments[1]) : 100;
    if (pthread_create(&runs[i].thread, NULL, abused, runs + i) != 0) {
      return 10;
    }
  }
  for (i = 0; i < threads && i < THREADS; ++i) {
    pthread_join(runs[i].thread, NULL);
    failed = failed ? failed : runs[i].failed;
  }
  printf("check %d; codes", failed);
  for (i = 0; i < 4; ++i) {
    printf(" %ld", runs[0].codes[i]);
  }
  printf("\n");
  return failed;
}
