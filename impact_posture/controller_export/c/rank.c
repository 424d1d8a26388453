/* Strict levels of any rank, as in LevelRank (level_rank.py): dependent rows are removed from the program, and nearly
 * dependent rows are damped. */

/* Typical size of a variable if accelerations have the size 1. */
static double ip_size(const ip_context *c, int k)
{
  return k < IP_NV + IP_SPARE ? 1.0 : c->m.M[0];
}

/* out = s (row - less) in units of ip_size; `less` may be null. */
static void ip_in_units(const ip_context *c, const double *row, const double *less, double s, double *out)
{
  int k;
  for (k = 0; k < IP_VARIABLES; ++k) {
    out[k] = (row[k] - (less ? less[k] : 0.0)) * s * ip_size(c, k);
  }
}

/* Decide whether the equations are independent.  As in LevelRank, all singular values of the scaled rows must be above
 * 0.02.  A singular value changes at most by the norm of the change of the matrix, so most ticks need no
 * decomposition. */
static void ip_measure_rank(ip_context *c)
{
#if IP_LEVELS
  enum { N = IP_EQUATIONS };
  const double least = IP_SINGULAR;
  double *G = c->scratch, *S = G + N * N, *B = S + N * N, moved[IP_VARIABLES], change = 0.0, low, high, trace = 0.0;
  int i, j, k;
  for (i = 0; i < N; ++i) {
    ip_in_units(c, c->rows[i], c->reference[i], 1.0 / c->length[i], moved);
    change += ip_dot(moved, moved, IP_VARIABLES);
  }
  if (change < c->space) {
    return;
  }
  memcpy(c->reference, c->rows, sizeof c->reference);
  c->space = 0.0;
  c->independent = 1;
  if (!isfinite(change)) {
    return;
  }
  for (i = 0; i < N; ++i) {
    ip_in_units(c, c->rows[i], NULL, 1.0 / c->length[i], B + i * IP_VARIABLES);
    for (j = 0; j <= i; ++j) {
      G[i * N + j] = G[j * N + i] = ip_dot(B + i * IP_VARIABLES, B + j * IP_VARIABLES, IP_VARIABLES);
    }
    trace += G[i * (N + 1)];
  }
  /* Squares of a lower and an upper bound on the least singular value of all rows. */
  low = least * least;
  high = trace / N;
  for (k = 0; k < 7; ++k) {
    const double middle = k ? sqrt(low * high) : low;
    memcpy(S, G, sizeof(double) * N * N);
    for (i = 0; i < N; ++i) {
      S[i * (N + 1)] -= middle;
    }
    if (ip_cholesky(S, N)) {
      low = middle;
    } else if (k) {
      high = middle;
    } else {
      c->independent = 0;
      return;
    }
  }
  c->space = (sqrt(low) - least) * (sqrt(low) - least);
#else
  c->independent = 1;
#endif
}

/* Set the scale of each equation to the length of the longest row of its level. */
static void ip_begin_rank(ip_context *c)
{
  double row[IP_VARIABLES];
  int r = IP_BLIND, i, k;
  for (i = 0; i < IP_EQUATIONS; ++i) {
    ip_in_units(c, c->rows[i], NULL, 1.0, row);
    c->length[i] = sqrt(ip_dot(row, row, IP_VARIABLES));
  }
  for (k = 0; k < IP_LEVELS; ++k) {
    double most = 0.0;
    for (i = r; i < r + ip_level_rows[k]; ++i) {
      most = fmax(most, c->length[i]);
    }
    for (i = r; i < r + ip_level_rows[k]; ++i) {
      c->length[i] = most;
    }
    r += ip_level_rows[k];
  }
  for (i = 0; i < IP_EQUATIONS; ++i) {
    c->length[i] = c->length[i] == 0.0 ? 1.0 : c->length[i];
  }
  c->space = -1.0;
  ip_measure_rank(c);
}

#if IP_LEVELS
/* Rotate the k rows of B, of n numbers each, until they are orthogonal (Hestenes 1958): B becomes U B with an
 * orthogonal U. Afterwards, the rows of U are the left singular vectors, and the rows of B are the right singular
 * vectors times the singular values. */
static void ip_orthogonalize(double *B, double *U, int k, int n)
{
  int i, j, sweep, turned = 1;
  for (i = 0; i < k * k; ++i) {
    U[i] = i % (k + 1) == 0 ? 1.0 : 0.0;
  }
  for (sweep = 0; sweep < 30 && turned; ++sweep) {
    turned = 0;
    for (i = 0; i < k; ++i) {
      for (j = i + 1; j < k; ++j) {
        double *x = B + i * n, *y = B + j * n;
        const double xx = ip_dot(x, x, n), yy = ip_dot(y, y, n), xy = ip_dot(x, y, n), half = 0.5 * (yy - xx);
        double t, c, s;
        if (!(fabs(xy) > 1e-15 * sqrt(xx * yy)) || xy == 0.0) {
          continue;
        }
        turned = 1;
        t = xy / (fabs(half) + sqrt(half * half + xy * xy));
        t = half < 0.0 ? -t : t;
        c = 1.0 / sqrt(1.0 + t * t);
        s = t * c;
        ip_rotate(y, x, c, s, n);
        ip_rotate(U + j * k, U + i * k, c, s, k);
      }
    }
  }
}

/* Z = Z (I - share v v'/v'v) for a row v of length s. */
static void ip_remove(double *Z, const double *v, double s, double share, int n)
{
  int i;
  for (i = 0; i < n; ++i) {
    ip_add(Z + i * n, -share * ip_dot(Z + i * n, v, n) / (s * s), v, n);
  }
}

/* Replace the rows of the levels by independent rows.  Rows that are not equations get infinite bounds.  Damped rows
 * become terms of the cost, in the upper triangle of H and in g.  The linear term of the cost is -g. */
static void ip_reduce(ip_context *c, double *H, double *g)
{
  enum { N = IP_VARIABLES };
  double *Z = H + N * N, *B = Z + N * N, *U = B + IP_EQUATIONS * N, *turned = U + IP_EQUATIONS * IP_EQUATIONS;
  double wanted[IP_EQUATIONS];
  int i, j, k, l, r = IP_BLIND;
  for (i = 0; i < N; ++i) {
    for (j = 0; j < N; ++j) {
      Z[i * N + j] = i == j ? ip_size(c, i) : 0.0;
    }
  }
  for (i = 0; i < IP_BLIND; ++i) {
    ip_in_units(c, c->rows[i], NULL, 1.0 / c->length[i], B + i * N);
  }
  ip_orthogonalize(B, U, IP_BLIND, N);
  for (i = 0; i < IP_BLIND; ++i) {
    ip_remove(Z, B + i * N, sqrt(ip_dot(B + i * N, B + i * N, N)), 1.0, N);
  }
  for (k = 0; k < IP_LEVELS; r += ip_level_rows[k++]) {
    const int count = ip_level_rows[k];
    double top = 0.0, bottom = 0.0, weight;
    for (i = 0; i < count; ++i) {
      ip_combine(B + i * N, N, c->rows[r + i], 1, Z, N, N);
    }
    ip_orthogonalize(B, U, count, N);
    for (i = 0; i < count; ++i) {
      wanted[i] = ip_dot(U + i * count, c->low + IP_SIMPLE + r, count);
      ip_combine(turned + i * N, N, U + i * count, 1, c->rows[r], N, count);
    }
    /* Compute the mean weight of the cost over the directions that the earlier levels leave free. */
    for (i = 0; i < IP_NV; ++i) {
      for (j = i; j < IP_NV; ++j) {
        top += (i == j ? 1.0 : 2.0) * c->cost[i * IP_NV + j] * ip_dot(Z + i * N, Z + j * N, N);
      }
      bottom += ip_dot(Z + i * N, Z + i * N, N);
    }
    weight = top / bottom;
    for (i = 0; i < count; ++i) {
      const double *v = B + i * N, s = sqrt(ip_dot(v, v, N)), x = fmin(s / (IP_SINGULAR * c->length[r]), 1.0);
      const double alpha = ip_smooth(x), strength = weight * alpha / fmax(1.0 - alpha, IP_LEAST) / (s * s);
      memcpy(c->rows[r + i], turned + i * N, sizeof(double) * N);
      c->wanted_rows[r + i] = wanted[i];
      c->low[IP_SIMPLE + r + i] = x < 1.0 ? -INFINITY : wanted[i];
      c->high[IP_SIMPLE + r + i] = x < 1.0 ? INFINITY : wanted[i];
      if (x < 1.0 && x > IP_DROPPED) {
        double q[IP_NV];
        for (j = 0; j < IP_NV; ++j) {
          q[j] = ip_dot(Z + j * N, v, N) / s;
        }
        for (j = 0; j < N; ++j) {
          const double a = strength * turned[i * N + j];
          g[j] += a * wanted[i];
          for (l = j; l < N; ++l) {
            H[j * N + l] += a * turned[i * N + l] + (l < IP_NV ? weight * x * q[j < IP_NV ? j : 0] * q[l] : 0.0);
          }
        }
      }
      if (x > IP_DROPPED) {
        /* The products of Z and the other rows do not change, because the other rows are orthogonal to this row. */
        ip_remove(Z, v, s, 1.0 - sqrt(1.0 - alpha), N);
      }
    }
  }
}
#endif
